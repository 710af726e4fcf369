"""A phone's first key and certificate, as a PKCS #12 file: phones import such files, and make no
requests. The key is in no file of this computer.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

from async_timeout import timeout

from appliance import certs
from appliance.certs import CertificateError, packing
from appliance.certs.settings import authority_directory
from appliance.config import BrokerSection
from appliance.management.child import Child
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Caller, Verbs
from appliance.mqtt.codec import quote
from appliance.ros.calls.dispatcher import CallError

log = logging.getLogger(__name__)

#: The verb that makes the certificate.
SIGN: Final = "certificate_sign"

#: Seconds for the file: it takes half a second, and waits for those before it.
PACKING: Final = 60.0

#: The priority of the program that makes it, see nice(2).
_NICE: Final = 5


class PhoneCertificates:
    """Makes them, one at a time. What is wrong is told to phones: without this computer's paths."""

    def __init__(self, broker: Callable[[], BrokerSection], thread: VerbThread) -> None:
        """`broker` is the section of the configuration that is in force."""
        self._broker = broker
        self._thread = thread
        self._lock = asyncio.Lock()

    async def check(self, caller: Caller, name: str) -> None:
        """Raise CallError where `make` would be refused: a phone's owner could not mend that."""
        directory = self._directory()
        try:
            check = partial(certs.check_new_client, directory, name)
            await self._thread.run(caller.user, check)
        except CertificateError as error:
            raise CallError("rejected", _without(directory, str(error))) from None
        except OSError as error:
            raise CallError("failed", error.strerror or "its files cannot be read") from None

    async def make(self, verbs: Verbs, caller: Caller, name: str, password: str) -> bytes:
        """The file of a new key, which the password opens. Raises CallError."""
        await self.check(caller, name)
        directory = self._directory()
        key, request = certs.new_request(name)
        try:
            made: Any = await verbs.run(caller, SIGN, {"request": request.decode(), "name": name})
            given = packing.given(name, key, made["certificate"], made["ca"], password)
            async with timeout(PACKING):
                packed = await self._packed(given)
        except CallError as error:
            raise CallError(error.code, _without(directory, str(error))) from None
        except asyncio.TimeoutError:
            packed = b""
        if not 0 < len(packed) <= packing.LONGEST:
            log.warning("the .p12 of %s could not be made; revoke its certificate", quote(name))
            raise CallError("failed", "the .p12 could not be made; revoke its certificate")
        return packed

    async def _packed(self, given: bytes) -> bytes:
        async with self._lock:
            # Python looks for modules in the current directory first: never in a stranger's.
            child = Child(packing.COMMAND, packing.LONGEST, _NICE, directory="/")
            return await child.output(given)

    def _directory(self) -> Path:
        broker = self._broker()
        directory = authority_directory(broker)
        if directory is None:
            raise CallError("rejected", "the certificates are not of this appliance's own CA")
        if broker.tls.username_from == "san":
            raise CallError(
                "rejected",
                "here a certificate's alternative name says who logs in (username_from: san), and "
                "those made for phones have none",
            )
        return directory


def _without(directory: Path, text: str) -> str:
    return text.replace(f"{directory}/", "")
