"""The verbs about certificates of the appliance's own CA; a thread reads and writes files."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from cryptography.hazmat.primitives.serialization import Encoding
from pydantic import Field

from appliance import certs
from appliance.certs import CertificateError
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Arguments, Caller, Verb
from appliance.mqtt.codec import quote
from appliance.ros.calls.dispatcher import CallError

#: Seconds for a change, with the reload behind it.
TIMEOUT: Final = 60.0

#: The most certificates of an answer.
_MOST: Final = 500

_NAME: Final = 256

T = TypeVar("T")


@dataclass(eq=False)
class ListCertificates(Arguments):
    """Those in use and revoked, or `all`: also expired and replaced ones."""

    all: bool = False
    after: Annotated[int, Field(ge=0, le=1_000_000)] = 0


@dataclass(eq=False)
class SignRequest(Arguments):
    """A request (PKCS #10, PEM), and the client's name if it is not the request's common name."""

    request: Annotated[str, Field(min_length=1, max_length=certs.REQUEST_SIZE)]
    name: Annotated[str, Field(min_length=1, max_length=_NAME)] | None = None


@dataclass(eq=False)
class Revoke(Arguments):
    """A client's name, or a serial number as `certificates` lists it."""

    certificate: Annotated[str, Field(min_length=1, max_length=_NAME)]


class CertificateVerbs:
    """The verbs about certificates."""

    def __init__(
        self,
        directory: Callable[[], Path | None],
        thread: VerbThread,
        reload: Callable[[], Awaitable[object]],
    ) -> None:
        """`directory` is that of the CA, None where it is another's; `reload` puts changed files
        in force."""
        self._directory = directory
        self._thread = thread
        self._reload = reload
        self._lock = asyncio.Lock()

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        yield Verb("certificates", ListCertificates, self._list)
        yield Verb(
            "certificate_sign", SignRequest, self._sign, TIMEOUT, "certificate made", _of_name
        )
        yield Verb(
            "certificate_revoke", Revoke, self._revoke, TIMEOUT, "certificate revoked", _of_revoked
        )

    async def _list(self, caller: Caller, wanted: ListCertificates) -> dict[str, Any]:
        directory = self._own()
        found = await self._in_thread(caller, lambda: certs.list_certificates(directory))
        shown = [each for each in found if wanted.all or each.state in ("valid", "revoked")]
        page = shown[wanted.after : wanted.after + _MOST]
        end = wanted.after + len(page)
        listed = [{**each.as_json(), "file": each.file and each.file.name} for each in page]
        return {"certificates": listed, "next": end if end < len(shown) else None}

    async def _sign(self, caller: Caller, wanted: SignRequest) -> dict[str, Any]:
        directory = self._own()

        def sign() -> dict[str, Any]:
            made = certs.sign(directory, wanted.request.encode(), wanted.name)
            return {
                "name": made.stem,
                "certificate": _pem(made),
                "ca": _pem(directory / "ca.crt"),
            }

        async with self._lock:
            return await self._in_thread(caller, sign)

    async def _revoke(self, caller: Caller, wanted: Revoke) -> dict[str, Any]:
        directory, what = self._own(), wanted.certificate

        def revoke() -> list[str]:
            # Only by what is listed, letter by letter: never by a file of this computer.
            named = [
                each
                for each in certs.list_certificates(directory)
                if what in (each.name, each.serial_text)
            ]
            if not named:
                raise CallError("not_found", f"there is no certificate {quote(what)}")
            if any(each.purpose != "client" for each in named):
                raise CallError("rejected", "only certificates of clients are revoked from here")
            return [each.name for each in certs.revoke(directory, what)]

        async with self._lock:
            names = await self._in_thread(caller, revoke)
            await self._reload()
        return {"revoked": names}

    def _own(self) -> Path:
        directory = self._directory()
        if directory is None:
            raise CallError("rejected", "the certificates are not of this appliance's own CA")
        return directory

    async def _in_thread(self, caller: Caller, work: Callable[[], T]) -> T:
        try:
            return await self._thread.run(caller.user, work)
        except CertificateError as error:
            raise CallError("rejected", str(error)) from None
        except OSError as error:
            where = "" if error.filename is None else f"{error.filename}: "
            raise CallError("failed", f"{where}{error.strerror}") from None


def _pem(file: Path) -> str:
    """Its certificates, without what people write between them."""
    return b"".join(
        each.public_bytes(Encoding.PEM) for each in certs.load_certificates(file)
    ).decode()


def _of_name(wanted: SignRequest) -> dict[str, Any]:
    return {"of": wanted.name or "the request's name"}


def _of_revoked(wanted: Revoke) -> dict[str, Any]:
    return {"of": wanted.certificate}
