"""The frame: an `amqtt.broker.Broker` with our data path in the place of its own."""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import logging
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any, Protocol, cast, get_type_hints

import amqtt.broker
from amqtt.contexts import BrokerConfig, ListenerConfig
from amqtt.errors import BrokerError, PluginError, PluginLoadError
from amqtt.events import BrokerEvents
from amqtt.mqtt.protocol.broker_handler import BrokerProtocolHandler
from amqtt.plugins.base import BaseAuthPlugin, BaseTopicPlugin
from amqtt.session import Session as AmqttSession
from amqtt.utils import import_string
from dacite import Config as DaciteConfig
from dacite import from_dict
from dacite.exceptions import DaciteFieldError, MissingValueError
from transitions import MachineError

from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.ports import Access
from appliance.broker.session import Session
from appliance.config.plugins import PluginSettingsError
from appliance.config.redaction import redacted
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic
from appliance.net.callbacks import Entries, PeriodicCallback, contained_proxy
from appliance.plugins.access import PluginAccess
from appliance.plugins.adapters import RetainedMessageViews, SessionViews, UnclaimedIdentity
from appliance.plugins.events import PluginEvents
from appliance.plugins.guard import PLUGIN_TIMEOUT, PluginGuard, plugin_name
from appliance.plugins.logins import CachePolicy, PluginLogins, Throttle
from appliance.plugins.threads import Threads

log = logging.getLogger(__name__)


#: The default: no answer is cached.
_ANSWERS = CachePolicy(keep=0.0, keep_refusals=0.0)


class FileRules(Access, Protocol):
    """The users file and the ACL file, as far as plugins need them."""

    @property
    def throttle(self) -> Throttle:
        """The login throttle."""


def plugin_kinds(plugins: Iterable[str]) -> tuple[bool, bool]:
    """Whether a plugin authenticates clients, and whether one decides about topics.

    Raises:
        PluginSettingsError: there is no such plugin.
    """
    try:
        classes = [import_string(path) for path in plugins]
    except ImportError as error:
        raise PluginSettingsError(f"broker.plugins: {error}") from error
    classes = [plugin for plugin in classes if isinstance(plugin, type)]
    return (
        any(issubclass(plugin, BaseAuthPlugin) for plugin in classes),
        any(issubclass(plugin, BaseTopicPlugin) for plugin in classes),
    )


def configuration(
    listeners: Iterable[tuple[str, bool]],
    connections: int,
    plugins: Mapping[str, Mapping[str, Any]],
) -> BrokerConfig:
    """amqtt's configuration object for our settings; a listener is its address, and whether it has
    TLS.

    Only the given plugins are loaded, none of amqtt's default ones. Certificates are left out, as
    our own listeners have them.
    """
    config = BrokerConfig(
        listeners={"default": ListenerConfig(bind=None)},
        plugins={path: _typed(path, settings) for path, settings in plugins.items()},
    )
    # Added afterwards: BrokerConfig fills what equals a default from the listener "default".
    for bind, tls in listeners:
        config.listeners[bind] = ListenerConfig(bind=bind, ssl=tls, max_connections=connections)
    return config


def check_plugin_settings(path: str, settings: Mapping[str, Any]) -> None:
    """Check that a plugin takes these settings. Nothing is started, and no value is revealed.

    Raises:
        PluginSettingsError: there is no such plugin, or it does not take these settings.
    """
    try:
        kind = import_string(path)
    except ImportError as error:
        raise PluginSettingsError(str(error)) from error
    wanted = getattr(kind, "Config", None)
    if not isinstance(wanted, type) or not is_dataclass(wanted):
        if settings:
            raise PluginSettingsError(f"takes no settings; there are {', '.join(settings)}")
        return
    known = [each.name for each in fields(wanted) if each.init]
    for key in settings:
        if key not in known:
            close = difflib.get_close_matches(key, known, n=1)
            advice = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
            raise PluginSettingsError(f"unknown setting {key!r}; {advice}")
    try:
        from_dict(wanted, _typed(path, settings), DaciteConfig(strict=True))
    except DaciteFieldError as error:
        what = (
            "is needed" if isinstance(error, MissingValueError) else "has a value of a wrong type"
        )
        raise PluginSettingsError(f"{error.field_path} {what}") from None
    except Exception as error:  # a plugin may check its settings itself
        reason = f"does not take its settings ({type(error).__name__})"
        raise PluginSettingsError(reason) from None


def _typed(path: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings, with values converted to the enumerations that the plugin declares.

    amqtt accepts only members of an enumeration, which a file cannot contain.
    """
    typed = dict(settings)
    try:
        kinds = get_type_hints(getattr(import_string(path), "Config", None))
    except (ImportError, NameError, TypeError):  # amqtt reports the error better
        return typed
    for key, value in settings.items():
        kind = kinds.get(key)
        if isinstance(kind, type) and issubclass(kind, Enum) and isinstance(value, str):
            with contextlib.suppress(ValueError):
                typed[key] = kind(value)
    return typed


class ApplianceBroker(amqtt.broker.Broker):
    """An `amqtt.broker.Broker` whose data path is ours, for `App` to start and stop.

    `listen` and `hang_up` start and stop the listeners, where amqtt would its own. `files` stay
    in force: plugins can admit clients that the files do not know, and refuse what these allow.
    `plugin_timeout` is in seconds. `logins` is their part in a login.
    """

    def __init__(
        self,
        broker: Broker,
        files: FileRules,
        config: BrokerConfig,
        listen: Callable[[], Awaitable[None]],
        hang_up: Callable[[], Awaitable[None]],
        plugin_timeout: float = PLUGIN_TIMEOUT,
        *,
        answers: CachePolicy = _ANSWERS,
        secrets: Iterable[str] = (),
        max_wait: float = PLUGIN_TIMEOUT,
    ) -> None:
        """Load the plugins; to be called on the event loop.

        `secrets` are strings of their settings that are masked in the log. `max_wait` is the most
        seconds that a login may be delayed after wrong ones from its address.

        Raises:
            PluginSettingsError: one cannot be loaded.
        """
        self.broker = broker
        self._files = files
        self._listen = listen
        self._hang_up = hang_up
        self._guard = PluginGuard(plugin_timeout, secrets)
        self._threads = Threads()
        self._answers = answers
        self._views = SessionViews(broker)
        self._inside: Session | None = None
        self._timer: PeriodicCallback | None = None
        try:
            super().__init__(config)
        except (PluginError, PluginLoadError) as error:
            reasons = [str(error), str(error.__cause__ or "")]
            raise PluginSettingsError(
                f"broker.plugins ({', '.join(cast(dict[str, Any], config.plugins))}): "
                + redacted(": ".join(filter(None, reasons)), self._guard.secrets)
            ) from None
        manager = self.plugins_manager
        self._events = PluginEvents(manager, self._views, self._guard, broker.accounting)
        self._access = PluginAccess(
            files, broker, manager, self._views, self._guard, self._threads, answers
        )
        self.logins = PluginLogins(
            broker,
            manager,
            self._views,
            self._events,
            self._guard,
            self._threads,
            files.throttle,
            lambda: files.epoch,
            answers,
            max_wait,
        )
        # BrokerContext reads and writes these: they are views of our broker.
        self._sessions = cast(Any, self._views)
        self._retained_messages = cast(Any, RetainedMessageViews(broker, self._retain_quietly))

    # --- life cycle ----------------------------------------------------------------------------

    async def start(self) -> None:
        """Start as amqtt's broker does, when new or stopped, and fire the life-cycle events.

        Raises:
            BrokerError: it is running, or a start has failed.
            Exception: what `listen` raised; nothing runs then.
        """
        try:
            self.transitions.start()
        except MachineError as error:
            raise BrokerError(f"Broker instance can't be started: {error}") from error
        self._inside = self.broker.attach("_amqtt", InsideLink())
        if self.plugins_manager.plugins:
            self.broker.access = self.broker.router.pending_decisions = self._access
            if self._events.observes_clients:
                faults = self.broker.faults
                self.broker.observer = contained_proxy("plugins.observer", faults, self._events)
            interval = self._answers.topic_lifetime(allowed=True)
            entries = Entries(asyncio.get_running_loop(), self.broker.faults)
            self._timer = entries.every("plugins.tick", interval, self._tick, 0)
        try:
            await self._events.life_cycle(BrokerEvents.PRE_START)
            await self._start_listeners()
        except BaseException:
            self.transitions.starting_fail()
            await self._close()
            raise
        self.transitions.starting_success()
        await self._events.life_cycle(BrokerEvents.POST_START)
        log.debug(
            "amqtt plugins: %s", ", ".join(map(plugin_name, self.plugins_manager.plugins)) or "none"
        )

    async def _start_listeners(self) -> None:
        """Start our listeners instead of amqtt's."""
        await self._listen()

    async def shutdown(self) -> None:
        """Stop as amqtt's broker does; sessions and retained messages stay.

        Raises:
            MachineError: it is not running.
        """
        self.transitions.shutdown()
        await self._events.life_cycle(BrokerEvents.PRE_SHUTDOWN)
        await self._hang_up()
        await self._finish("the last events", self.plugins_manager.wait_fired_events())
        await self._events.life_cycle(BrokerEvents.POST_SHUTDOWN)
        await self._close()
        self.transitions.stopping_success()

    async def _close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._access.close()
        self.logins.close()
        self._threads.close()
        await self._finish("close", self.plugins_manager.close())
        self.broker.observer = None
        self.broker.access = self._files
        self.broker.router.pending_decisions = None
        if self._inside is not None:
            self.broker.detach(self._inside)
            self._inside = None

    async def _finish(self, what: str, work: Coroutine[Any, Any, None]) -> None:
        try:
            await self._guard.run(work)
        except asyncio.TimeoutError:
            log.warning("amqtt plugins still work on %s after %g s", what, self._guard.timeout)
        except Exception as error:  # a plugin may raise anything, and all else is to stop too
            self._guard.log_failure(f"an amqtt plugin at {what}", error)

    def _tick(self) -> None:
        """Remove views of what has ended, and let topic plugins change their answers."""
        self._views.purge()
        if self.plugins_manager._topic_plugins:
            self._access.changed()

    # --- what BrokerContext does ---------------------------------------------------------------

    @property
    def subscriptions(self) -> dict[str, list[tuple[AmqttSession, int]]]:
        """The subscriptions of all network clients by topic filter, as they are now."""
        found: dict[str, list[tuple[AmqttSession, int]]] = {}
        for session in self.broker.sessions.values():
            if not session.is_inside:
                for topic_filter, subscription in session.subscriptions.items():
                    entry = self._views.of(session), int(subscription.qos)
                    found.setdefault(topic_filter, []).append(entry)
        return found

    async def internal_message_broadcast(
        self, topic: str, data: bytes, qos: int | None = None
    ) -> None:
        """Publish on behalf of the broker; without `qos` with the QoS of each subscription.

        Raises:
            BrokerError: the topic is not valid, or the broker is not running.
        """
        if self._inside is None:
            raise BrokerError("the broker is not running")
        message = Message(topic, bytes(data), 2 if qos is None else qos)
        try:
            self.broker.publish(message, self._inside)
        except ProtocolError as error:
            raise BrokerError(f"'{topic}' cannot be published to: {error}") from error
        self.broker.flush()

    async def retain_message(
        self,
        source_session: AmqttSession | None,
        topic_name: str | None,
        data: bytes | bytearray | None,
        qos: int | None = None,
    ) -> None:
        """Retain a message without delivering it; with no data, delete the topic's.

        Raises:
            BrokerError: the topic is not valid.
        """
        if topic_name is not None:
            self._retain(topic_name, bytes(data or b""), qos)

    def _retain(self, topic: str, data: bytes, qos: int | None) -> None:
        try:
            check_topic(topic)
        except ValueError as error:
            raise BrokerError(f"nothing can be retained for '{topic}': {error}") from error
        if data or self.broker.retained.get(topic) is not None:
            message = Message(topic, data, 2 if qos is None else qos, True)
            self.broker.retained.keep(message, self.broker.accounting.accounts.inside)
            self.broker.flush()

    def _retain_quietly(self, topic: str, data: bytes, qos: int | None) -> None:
        with self._unobserved():
            self._retain(topic, data, qos)

    async def add_subscription(self, subscription: tuple[str, int], session: AmqttSession) -> int:
        """Subscribe a client's session; returns the granted QoS, or 0x80 for a refusal.

        Raises:
            BrokerError: there is no such session.
        """
        topic_filter, qos = subscription
        ours = self.broker.sessions.get(session.client_id or "")
        if ours is None or ours.is_inside:
            raise BrokerError(f"there is no session '{session.client_id}'")
        with self._unobserved():
            code, _ = self.broker.subscribe(ours, Subscription(topic_filter, qos))
        return int(code) if code <= ReasonCode.GRANTED_QOS_2 else 0x80

    def create_offline_session(self, client_id: str) -> tuple[BrokerProtocolHandler, AmqttSession]:
        """Create a session for a client that is not there; the first to log in becomes its owner.

        Raises:
            BrokerError: it would not outlive its connection, or cannot be created.
        """
        link = InsideLink()
        expiry = self.broker.limits.session_expiry
        if not expiry:
            raise BrokerError("no session outlives its connection (broker.limits.session_expiry)")
        try:
            with self._unobserved():
                session, _ = self.broker.connect(
                    link,
                    UnclaimedIdentity(None, client_id),
                    clean_start=False,
                    expiry=expiry,
                    will=None,
                )
                self.broker.disconnect(session, link, publish_will=False)
        except ProtocolError as error:
            raise BrokerError(f"no session '{client_id}' can be made: {error}") from error
        return cast(BrokerProtocolHandler, None), self._views.of(session)

    @contextlib.contextmanager
    def _unobserved(self) -> Iterator[None]:
        """Suppress events about what plugins do themselves."""
        observer, self.broker.observer = self.broker.observer, None
        try:
            yield
        finally:
            self.broker.observer = observer
