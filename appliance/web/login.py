"""Who asks, by HTTP's Basic or Bearer authentication: login and access rules are those of MQTT."""

from __future__ import annotations

import asyncio
import base64
import binascii
import logging
import ssl
from collections.abc import Callable, Coroutine
from typing import Protocol

from async_timeout import timeout

from appliance.broker.broker import Broker
from appliance.broker.limits import Anonymous
from appliance.broker.values import WRONG_LOGIN, Action, Decision, Identity, Refusal, TlsInfo
from appliance.mqtt.codec import quote
from appliance.net import tls
from appliance.net.http import RETRY_AFTER, HttpRequest, HttpResponse, text

log = logging.getLogger(__name__)


class Login(Protocol):
    """Decides who somebody is."""

    def identify(
        self,
        username: str | None,
        password: bytes | None,
        address: str,
        tls: ssl.SSLObject | None = None,
        anonymous: Anonymous = None,
    ) -> Coroutine[object, object, Identity | Refusal]:
        """Who it is, or why it is refused."""


class WebLogin:
    """Finds out who sent a request, and what its sender may read.

    There is no `WWW-Authenticate`: a browser would ask for the password itself, keep it, and send
    it along with whatever another site's page asks for.
    """

    def __init__(self, broker: Broker, login: Login, clock: Callable[[], float]) -> None:
        self._broker = broker
        self._login = login
        self._clock = clock

    async def identify(self, request: HttpRequest) -> Identity | HttpResponse:
        """Who sent the request, or the answer if that is refused."""
        try:
            username, password = credentials(request)
        except ValueError as error:
            return text(401, str(error))
        who = await self._login.identify(
            username, password, request.address, request.tls, request.terms.anonymous
        )
        if isinstance(who, Identity):
            if who.username is None and password is not None:
                return text(401, "this is no token")  # and nobody either, where that is enough
            return who
        self.note(request, username, who)
        if who.code in WRONG_LOGIN:
            if username is None and password is None:
                return text(401, "a user name and its password are needed")
            # The same for a user who is not known: nobody finds out who is.
            return text(401, "the user name or the password is wrong, or the token has ended")
        return text(503, "the login cannot be checked now", ("Retry-After", str(RETRY_AFTER)))

    async def may_read(self, request: HttpRequest, topic: str) -> HttpResponse | None:
        """Why the sender may not read what the right to this topic is for; None if it may."""
        who = await self.identify(request)
        if isinstance(who, HttpResponse):
            return who
        decision = await self._decide(who, topic)
        if decision:
            return None
        return text(403, f"the right to read {topic} is needed (broker.acl)")

    async def _decide(self, who: Identity, topic: str) -> Decision:
        """Whether it may read the topic; a plugin's answer is waited for."""
        router = self._broker.router
        decision = router.decide(who, Action.RECEIVE, topic)
        asked = router.pending_decisions
        if asked is None or not decision.pending:
            return decision
        until = self._clock() + asked.timeout
        while decision.pending and (left := until - self._clock()) > 0:
            answered = asyncio.Event()
            if asked.is_pending((who, Action.RECEIVE, topic), answered.set):
                try:
                    async with timeout(left):
                        await answered.wait()
                except asyncio.TimeoutError:
                    break
            decision = router.decide(who, Action.RECEIVE, topic)
        return decision

    def note(self, request: HttpRequest, username: str | None, refusal: Refusal) -> None:
        """Count a login that failed, and log it as MQTT's."""
        broker = self._broker
        broker.counters.logins_failed += refusal.code in WRONG_LOGIN
        user = "no user name" if username is None else f"user {quote(username)}"
        broker.rate_limited_log.warning(
            log,
            self._clock(),
            (request.peer, "http login"),
            "HTTP (%s) at %s refused: %s",
            user,
            request.address,
            refusal.reason,
        )
        if broker.audit_log is not None:
            info = TlsInfo()
            if request.tls is not None:
                info = TlsInfo(request.tls.version() or "", tls.name_in(request.tls.getpeercert()))
            broker.audit_log.refused(
                request.address, refusal.reason, refusal.code, None, username, info
            )


def credentials(request: HttpRequest) -> tuple[str | None, bytes | None]:
    """User name and password of the request; None without them. Raises ValueError.

    Basic (RFC 7617) has both. Bearer (RFC 6750) has a token alone, which stands for a password.
    """
    given = [value for name, value in request.headers if name == "authorization"]
    if not given:
        return None, None
    scheme, _, encoded = given[0].partition(" ")
    if len(given) == 1 and scheme.lower() == "bearer":
        return None, encoded.strip().encode()
    if len(given) > 1 or scheme.lower() != "basic":
        raise ValueError("Basic authentication is taken here, or a token as Bearer")
    try:
        decoded = base64.b64decode(encoded.strip(), validate=True)
        name, colon, password = decoded.partition(b":")
        username = name.decode()
    except (binascii.Error, ValueError):  # also what is not ASCII, or not UTF-8
        raise ValueError("this is not Basic authentication, base64 of USER:PASSWORD") from None
    if not colon or "\0" in username:
        raise ValueError("this is not Basic authentication, base64 of USER:PASSWORD")
    return username, password
