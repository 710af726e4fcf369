"""The verb `enrol`: a one-time code with which a phone sets its user's password.

A code is worth the right to add that user, or to change its password, and is given to nobody
without that right. When it is used, the same is asked again, and whether it could still be begun.
With a certificate, the phone gets a file for its MQTT apps as well, under the password that it has
chosen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final
from urllib.parse import quote

from pydantic import Field

from appliance import certs
from appliance.access import FileAccess, check_username
from appliance.access import groups as acl_groups
from appliance.access.enrolments import LIFETIME, Enrolment, Enrolments
from appliance.broker.broker import Broker
from appliance.broker.values import Identity
from appliance.certs import CertificateError
from appliance.management.certificates import TIMEOUT
from appliance.management.phone_certificates import PACKING, SIGN, PhoneCertificates
from appliance.management.topics import topic_of
from appliance.management.users import GroupNames, UserName
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Arguments, Caller, Verb, Verbs
from appliance.ros.calls.dispatcher import CallError

#: The most characters of a user's name that the URL says as well, for who looks at it.
_SHOWN: Final = 60

#: The verb that begins an enrolment.
_BEGIN: Final = "enrol"

#: Seconds that the use of a code takes at most: two changes with their reloads, and the file.
LONGEST_ENROLMENT: Final = 2 * TIMEOUT + PACKING

#: Scheme, host and port of the console, as the phone reaches it.
Origin = Annotated[str, Field(max_length=300, pattern=r"^https?://[A-Za-z0-9.:\[\]_-]+$")]


@dataclass(eq=False)
class Enrol(Arguments):
    """A user that is there, or with `groups` a new one; where its phone finds the console; and
    whether that gets a certificate of its own."""

    user: UserName
    origin: Origin
    groups: GroupNames | None = None
    certificate: bool = False


@dataclass(frozen=True, slots=True)
class Enrolled:
    """What the phone gets: with a certificate its file, or why there is none."""

    pkcs12: bytes | None = None
    problem: str = ""


class EnrolmentVerb:
    """Begins enrolments."""

    def __init__(
        self,
        broker: Broker,
        access: FileAccess,
        enrolments: Enrolments,
        phones: PhoneCertificates,
        thread: VerbThread,
    ) -> None:
        self._broker = broker
        self._access = access
        self._thread = thread
        self._enrolments = enrolments
        self._phones = phones

    def verbs(self) -> Iterator[Verb[Any]]:
        """The verb."""
        yield Verb(_BEGIN, Enrol, self._begin, changes="enrolment begun", changed=_named)

    async def _begin(self, caller: Caller, wanted: Enrol) -> dict[str, Any]:
        groups = None if wanted.groups is None else tuple(wanted.groups)
        revocations = self._enrolments.revocations
        if self._access.in_force.users_path is None:
            raise CallError("rejected", "there is no users file: a plugin knows the users")
        is_known = self._access.knows(wanted.user)
        if is_known and groups is not None:
            raise CallError("rejected", f"there is a user {wanted.user!r} already")
        if not is_known and groups is None:
            raise CallError("not_found", f"there is no user {wanted.user!r}")
        check_right(self._broker, caller.identity, _verb_for(groups))
        if groups is not None:
            await self._check_new(caller, wanted.user, groups)
        if wanted.certificate:
            check_right(self._broker, caller.identity, SIGN)
            await self._phones.check(caller, wanted.user)
        if revocations != self._enrolments.revocations:
            raise CallError("failed", "certificates were revoked meanwhile: begin it again")
        code = self._enrolments.begin(wanted.user, groups, caller.identity, wanted.certificate)
        if code is None:
            raise CallError("too_many", "too many enrolments wait for their phones")
        named = f"/{quote(wanted.user, safe='')}" if len(wanted.user) <= _SHOWN else ""
        url = f"{wanted.origin}/#/enrol/{code}{named}"
        return {"user": wanted.user, "url": url, "seconds": round(LIFETIME), "qr": _picture(url)}

    async def _check_new(self, caller: Caller, user: str, groups: tuple[str, ...]) -> None:
        """Raise CallError for what the phone would be refused: its owner could not mend that."""
        acl = self._access.in_force.acl_path
        known: list[str] = []
        if acl is not None:
            known = await self._thread.run(caller.user, partial(acl_groups.groups, acl))
        unknown = [name for name in groups if name not in known]
        if unknown:
            raise CallError("bad_request", f"there is no group {unknown[0]!r}")
        try:
            check_username(user)
        except ValueError as error:
            raise CallError("bad_request", str(error)) from None


async def carry_out(
    broker: Broker,
    verbs: Verbs,
    phones: PhoneCertificates,
    enrolment: Enrolment,
    password: str,
    address: str,
) -> Enrolled:
    """Set the password, as the one who has begun the enrolment; from the phone's address.

    Raises CallError, and then nothing has changed, or the change is not in force, as that says. A
    certificate that is refused is none of that: the password is set by then.
    """
    if enrolment.with_certificate:
        try:
            certs.check_password(password)
        except CertificateError as error:
            raise CallError("bad_request", str(error)) from None
    verb = _verb_for(enrolment.groups)
    for needed in (_BEGIN, verb):
        check_right(broker, enrolment.by, needed)
    values: dict[str, Any] = {"user": enrolment.username, "password": password}
    if enrolment.groups is not None:
        values["groups"] = list(enrolment.groups)
    caller = Caller(enrolment.by, address)
    await verbs.run(caller, verb, values)
    if not enrolment.with_certificate:
        return Enrolled()
    try:
        check_right(broker, enrolment.by, SIGN)
        return Enrolled(await phones.make(verbs, caller, enrolment.username, password))
    except CallError as error:
        return Enrolled(problem=str(error))


def check_right(broker: Broker, identity: Identity | None, verb: str) -> None:
    """Raise CallError where the rules in force do not let it call the verb; the control socket,
    which has no identity, may."""
    if identity is None:
        return
    decision = broker.router.may_publish(identity, topic_of(verb))
    if not decision.allowed:
        raise CallError("not_authorized", f"that takes the right to {verb}: {decision.reason}")


def _verb_for(groups: tuple[str, ...] | None) -> str:
    return "user_password" if groups is None else "user_add"


def _picture(url: str) -> dict[str, Any]:
    """The QR code as the path of an SVG: squares of 1 × 1, without the quiet zone around."""
    import segno

    code = segno.make(url, micro=False)
    runs = []
    for y, row in enumerate(code.matrix):
        x = 0
        while x < len(row):
            width = 1
            while x + width < len(row) and row[x + width] == row[x]:
                width += 1
            if row[x]:
                runs.append(f"M{x} {y}h{width}v1h-{width}z")
            x += width
    return {"size": len(code.matrix), "path": "".join(runs)}


def _named(wanted: Enrol) -> dict[str, Any]:
    groups = {} if wanted.groups is None else {"groups": ", ".join(wanted.groups)}
    certificate = {"certificate": "yes"} if wanted.certificate else {}
    return {"of": wanted.user, **groups, **certificate}
