"""Logins that amqtt's plugins decide: with time limit, throttle and cache, and so many at once."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import logging
import secrets
import ssl
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final, Protocol, TypeAlias, cast

from amqtt.broker import BrokerContext
from amqtt.plugins.authentication import AnonymousAuthPlugin
from amqtt.plugins.manager import PluginManager
from amqtt.session import Session as AmqttSession

from appliance.broker.broker import Broker
from appliance.broker.values import Identity, Refusal
from appliance.config.redaction import redacted
from appliance.mqtt.packets import Connect
from appliance.mqtt.reason import ReasonCode
from appliance.plugins.adapters import SessionViews, UnclaimedIdentity, view_of_login
from appliance.plugins.events import PluginEvents
from appliance.plugins.guard import PluginGuard, plugin_name
from appliance.plugins.threads import Threads

log = logging.getLogger(__name__)

#: Logins that plugins are asked about at a time; others wait, within the time limit.
MAX_LOGINS: Final = 64

#: The queue of the login throttle in which these logins wait, see `LoginThrottle`.
QUEUE: Final = "plugins"

_STOPPING: Final = Refusal(ReasonCode.SERVER_SHUTTING_DOWN, "the appliance is stopping")
_TRY_LATER: Final = Refusal(
    ReasonCode.SERVER_BUSY,
    "too many logins from its address were wrong, it has to come again "
    "(broker.limits.failed_logins)",
)


class Throttle(Protocol):
    """The login throttle, see `appliance.access.throttle`."""

    def reserve(self, address: str, queue: str = "", max_wait: float = ...) -> float | None:
        """Reserve the next check for this address; seconds until then, None when too many."""

    def user_delay(self, username: str) -> float:
        """Seconds that a login waits because of wrong ones for the same user."""

    def record_failure(self, address: str, username: str) -> None:
        """Count a wrong login."""


@dataclass(frozen=True, slots=True)
class CachePolicy:
    """How long acceptances and refusals of plugins are cached, in seconds, and how many of each
    kind.

    Messages wait for answers about topics: these are cached for a second at least.
    """

    keep: float = 10.0
    keep_refusals: float = 2.0
    size: int = 4096

    def topic_lifetime(self, *, allowed: bool) -> float:
        """Seconds for which an answer about a topic is cached."""
        return max(1.0, self.keep if allowed else self.keep_refusals)


#: The outcome of a login: who it is or why it is refused, and what plugins stored in their session.
_Outcome: TypeAlias = "tuple[Identity | Refusal, dict[str, Any], bool | None]"


class PluginLogins:
    """Asks the plugins that authenticate, and caches their answers for a short time.

    A change of the rules, visible by `epoch`, invalidates the cache. Timeouts and failures are not
    cached.
    """

    def __init__(
        self,
        broker: Broker,
        plugins: PluginManager[BrokerContext],
        sessions: SessionViews,
        events: PluginEvents,
        guard: PluginGuard,
        threads: Threads,
        throttle: Throttle,
        epoch: Callable[[], int],
        answers: CachePolicy,
        max_wait: float,
    ) -> None:
        self._broker = broker
        self._plugins = plugins
        self._sessions = sessions
        self._events = events
        self._guard = guard
        self._threads = threads
        self._throttle = throttle
        self._epoch = epoch
        self._answers = answers
        self._max_wait = max_wait
        self._key = secrets.token_bytes(32)
        self._known: OrderedDict[bytes, tuple[_Outcome, float, int]] = OrderedDict()
        self._asking: dict[tuple[bytes, int], asyncio.Task[_Outcome]] = {}
        self._free = asyncio.Semaphore(MAX_LOGINS)

    @property
    def authenticates(self) -> bool:
        """Whether one of the plugins authenticates clients."""
        return bool(self._plugins._auth_plugins)

    def connect_received(self, connect: Connect) -> None:
        """Fire the event of a CONNECT, where a plugin handles it."""
        if self._plugins.plugins:
            self._events.connect_received(connect)

    async def authenticate(
        self, connect: Connect, address: str, tls: ssl.SSLObject | None
    ) -> tuple[Identity | Refusal, object]:
        """Who the client is according to the plugins, and the session object that they were shown.

        It is admitted when at least one plugin accepts it and none refuses it: under the user name
        that it gave if a plugin vouches for that, and as anonymous if only `AnonymousAuthPlugin`
        accepts it.
        """
        try:
            text = None if connect.password is None else connect.password.decode()
        except UnicodeDecodeError:
            return Refusal(ReasonCode.NOT_AUTHORIZED, "its password is not UTF-8"), None
        login = view_of_login(connect, address, text, tls)
        return await self.ask(login, address), login

    def admitted(
        self,
        identity: Identity,
        connect: Connect,
        address: str,
        tls: ssl.SSLObject | None,
        noted: object,
    ) -> None:
        """Store the login for its connection, and hand an unclaimed session to its owner."""
        if self._events.observes_clients or self._plugins._topic_plugins:
            login = cast("AmqttSession | None", noted)
            if login is None:  # its password is none of the plugins' business
                login = view_of_login(connect, address, None, tls)
                login.username = identity.username
            self._sessions.remember_login(address, login)
        session = self._broker.sessions.get(identity.client_id)
        if session is not None and isinstance(session.identity, UnclaimedIdentity):
            log.info("the session that a plugin made is taken over by %s", identity)
            self._broker.claim(session, identity)
            self._broker.rules_changed()

    async def ask(self, login: AmqttSession, address: str) -> Identity | Refusal:
        """Who it is, or why it is refused; what plugins stored in their session is in `login` then.

        0x88 Server unavailable when they did not answer in time or failed, 0x89 Server busy when
        too many logins from its address were wrong.
        """
        key = self._digest(login)
        epoch = self._epoch()
        outcome = self._cached(key, epoch)
        if outcome is None:
            asking = self._asking.get((key, epoch))
            if asking is None:
                asking = asyncio.ensure_future(self._ask_throttled(login, address, key, epoch))
                self._asking[key, epoch] = asking
                asking.add_done_callback(lambda _: self._asking.pop((key, epoch), None))
            # Not awaited directly: a client that leaves must not cancel it for the same logins.
            await asyncio.wait([asking])
            if asking.cancelled():
                return _STOPPING
            outcome = asking.result()
        who, attributes, is_anonymous = outcome
        login.attributes = dict(attributes)
        login.is_anonymous = bool(is_anonymous)
        return who

    def close(self) -> None:
        """Cancel all questions."""
        for asking in list(self._asking.values()):
            asking.cancel()

    async def _ask_throttled(
        self, login: AmqttSession, address: str, key: bytes, epoch: int
    ) -> _Outcome:
        turn = self._throttle.reserve(address, QUEUE, self._max_wait)
        if turn is None:
            return _TRY_LATER, {}, None
        username = login.username or ""
        delay = max(turn, self._throttle.user_delay(username))
        if delay:
            await asyncio.sleep(delay)
        who = await self._ask(login)
        outcome = who, login.attributes, login.is_anonymous
        if isinstance(who, Identity):
            self._store(key, outcome, self._answers.keep, epoch)
        elif who.code == ReasonCode.NOT_AUTHORIZED:
            self._throttle.record_failure(address, username)
            self._store(key, outcome, self._answers.keep_refusals, epoch)
        return outcome

    async def _ask(self, login: AmqttSession) -> Identity | Refusal:
        names = ", ".join(map(plugin_name, self._plugins._auth_plugins))
        try:
            answers, vouched = await self._guard.run(self._ask_all(login))
        except asyncio.TimeoutError:
            reason = f"{names} said nothing within {self._guard.timeout:g} s"
            return Refusal(ReasonCode.SERVER_UNAVAILABLE, reason)
        except Exception as error:  # a plugin may raise anything
            password = [login.password] if login.password else []
            self._guard.log_failure(f"authentication by {names}", error, password)
            reason = redacted(repr(error), [*password, *self._guard.secrets])
            return Refusal(ReasonCode.SERVER_UNAVAILABLE, f"{names} failed: {reason}")
        answered = {plugin: yes for plugin, yes in answers.items() if yes is not None}
        if not answered:
            return Refusal(ReasonCode.NOT_AUTHORIZED, f"{names} do not know the client")
        refusing = ", ".join(plugin_name(plugin) for plugin, yes in answered.items() if not yes)
        if refusing:
            return Refusal(ReasonCode.NOT_AUTHORIZED, f"refused by {refusing}")
        return Identity(login.username if vouched else None, login.client_id or "")

    async def _ask_all(self, login: AmqttSession) -> tuple[dict[Any, Any], bool]:
        """Each plugin's answer, and whether one vouches for the user name."""
        # In two groups: from mixed answers it cannot be seen who vouches.
        plugins: list[Any] = list(self._plugins._auth_plugins)
        demanding = [plugin for plugin in plugins if not isinstance(plugin, AnonymousAuthPlugin)]
        undemanding = [plugin for plugin in plugins if plugin not in demanding]
        async with self._free:
            answers = await self._ask_each(demanding, login)
            vouched = not login.is_anonymous and any(answers.values())
            answers |= await self._ask_each(undemanding, login)
        return answers, vouched

    async def _ask_each(self, plugins: Iterable[Any], login: AmqttSession) -> dict[Any, Any]:
        plugins = list(plugins)
        asked = (
            self._threads.call(plugin, "authenticate", {"session": login}) for plugin in plugins
        )
        return dict(zip(plugins, await asyncio.gather(*asked), strict=True))

    # --- the cache -----------------------------------------------------------------------------

    def _cached(self, key: bytes, epoch: int) -> _Outcome | None:
        outcome, until, then = self._known.get(key, (None, 0.0, 0))
        if then != epoch or asyncio.get_running_loop().time() >= until:
            return None
        return outcome

    def _store(self, key: bytes, outcome: _Outcome, seconds: float, epoch: int) -> None:
        if not seconds or epoch != self._epoch():
            return
        self._known.pop(key, None)
        self._known[key] = outcome, asyncio.get_running_loop().time() + seconds, epoch
        if len(self._known) > self._answers.size:
            self._known.popitem(last=False)

    def _digest(self, login: AmqttSession) -> bytes:
        """The cache key: a keyed hash of all that plugins judge by, so no password is stored."""
        tls = login.ssl_object
        certificate = tls.getpeercert(binary_form=True) if tls is not None else None
        parts = [
            login.client_id,
            login.username,
            login.password,
            login.remote_address,
            hashlib.sha256(certificate).hexdigest() if certificate else None,
        ]
        return hmac.digest(self._key, repr(parts).encode("utf-8", "surrogatepass"), "sha256")
