"""amqtt's events, fired for what happens in the broker."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from functools import partial
from typing import Any, Final, cast

from amqtt.broker import BrokerContext
from amqtt.events import BrokerEvents, Events, MQTTEvents
from amqtt.mqtt.connect import ConnectPacket, ConnectPayload, ConnectVariableHeader
from amqtt.plugins.manager import PluginManager
from amqtt.session import IncomingApplicationMessage

from appliance.broker.accounting import Accounting
from appliance.broker.accounts import Account, Quota
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.values import Identity
from appliance.mqtt.codec import V31
from appliance.mqtt.packets import Connect
from appliance.plugins.adapters import SessionViews, retained_message
from appliance.plugins.guard import PluginGuard

log = logging.getLogger(__name__)

#: The most events, and bytes of payload in them, that wait for plugins; of these a quarter is sure
#: to each user, see `Quota`.
MAX_EVENTS = 10_000
MAX_EVENT_BYTES = 64 * 1024 * 1024

#: The cost of making amqtt's objects of a message, see `Counters.cost`; and of a handler's task,
#: most of which comes in the next rounds of the loop.
MESSAGE_COST = 10
HANDLER_COST = 2

#: Seconds between two log lines about dropped events.
LOST_LOG_INTERVAL = 60.0

_LIFE_CYCLE = frozenset(
    {
        BrokerEvents.PRE_START,
        BrokerEvents.POST_START,
        BrokerEvents.PRE_SHUTDOWN,
        BrokerEvents.POST_SHUTDOWN,
    }
)
_MESSAGES = frozenset(
    {BrokerEvents.MESSAGE_RECEIVED, BrokerEvents.MESSAGE_BROADCAST, MQTTEvents.PACKET_RECEIVED}
)


class _Pending:
    """What waits for plugins: handlers of events, and bytes of payload in these."""

    __slots__ = ("bytes", "events")

    def __init__(self) -> None:
        self.events = 0
        self.bytes = 0

    def add(self, size: int) -> None:
        self.events += 1
        self.bytes += size

    def remove(self, size: int) -> None:
        self.events -= 1
        self.bytes -= size


_NOTHING: Final = _Pending()


class PluginEvents:
    """The broker's `Observer`: fires amqtt's events, those that a plugin has a handler for."""

    def __init__(
        self,
        plugins: PluginManager[BrokerContext],
        sessions: SessionViews,
        guard: PluginGuard,
        accounting: Accounting,
    ) -> None:
        self._plugins = plugins
        self._sessions = sessions
        self._guard = guard
        self._wanted = frozenset(plugins._event_plugin_callbacks)
        self._wants_messages = not self._wanted.isdisjoint(_MESSAGES)
        self._counters = accounting.counters
        self._inside = accounting.accounts.inside
        self._strangers = accounting.accounts.strangers
        self._events = Quota.of(MAX_EVENTS, None)
        self._bytes = Quota.of(MAX_EVENT_BYTES, None)
        self._pending = _Pending()
        #: The part of each user, by what is left of an account that ends meanwhile.
        self._pending_of: dict[tuple[str | None, bool], _Pending] = {}
        self._lost = 0
        self._lost_logged_at = float("-inf")
        #: The message that is being published, and its publisher.
        self._published: tuple[Message, Session] | None = None

    @property
    def observes_clients(self) -> bool:
        """Whether a plugin handles more than the four life-cycle events."""
        return not self._wanted <= _LIFE_CYCLE

    async def life_cycle(self, event: BrokerEvents) -> None:
        """Fire the event and wait for its handlers, up to the time limit."""
        tasks = self._fire(event, self._inside, 0, {})
        if tasks:
            _, late = await asyncio.wait(tasks, timeout=self._guard.timeout)
            if late:
                log.warning(
                    "amqtt plugins still work on %s after %g s", event.value, self._guard.timeout
                )

    def connect_received(self, connect: Connect) -> None:
        """A CONNECT was received, and is not authenticated yet."""
        if MQTTEvents.PACKET_RECEIVED not in self._wanted:
            return
        will = connect.will
        protocol = "MQIsdp" if connect.version == V31 else "MQTT"
        header = ConnectVariableHeader(0, connect.keep_alive, protocol, connect.version)
        header.clean_session_flag = connect.clean_start
        header.username_flag = connect.username is not None
        payload = ConnectPayload(connect.client_id, username=connect.username)
        if will is not None:
            header.will_flag, header.will_qos, header.will_retain_flag = True, will.qos, will.retain
            payload.will_topic, payload.will_message = will.topic, will.payload
        packet = ConnectPacket(variable_header=header, payload=payload)
        self._notify(MQTTEvents.PACKET_RECEIVED, self._strangers, packet=packet)

    def connected(self, session: Session) -> None:
        """A client has connected."""
        view = self._sessions.of(session)
        self._notify(
            BrokerEvents.CLIENT_CONNECTED,
            session.account,
            client_id=session.client_id,
            client_session=view,
        )

    def disconnected(self, session: Session) -> None:
        """A client has disconnected."""
        view = self._sessions.of(session)
        self._notify(
            BrokerEvents.CLIENT_DISCONNECTED,
            session.account,
            client_id=session.client_id,
            client_session=view,
        )

    def subscribed(self, session: Session, topic_filter: str, qos: int) -> None:
        """A client has subscribed."""
        if not session.is_inside:
            self._notify(
                BrokerEvents.CLIENT_SUBSCRIBED,
                session.account,
                client_id=session.client_id,
                topic=topic_filter,
                qos=int(qos),
            )

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """A client has unsubscribed."""
        if not session.is_inside:
            self._notify(
                BrokerEvents.CLIENT_UNSUBSCRIBED,
                session.account,
                client_id=session.client_id,
                topic=topic_filter,
            )

    def published(self, session: Session, message: Message) -> None:
        """A client's message is about to be delivered."""
        if session.is_inside:
            return
        if message.retain:
            self._published = message, session
        if self._wants_messages:
            self._notify_message(session, message, allowed=True)

    def refused(self, session: Session, message: Message) -> None:
        """A client's message is not allowed and dropped; amqtt fires that it was received."""
        if not session.is_inside and self._wants_messages:
            self._notify_message(session, message, allowed=False)

    def retained(self, message: Message) -> None:
        """A message was retained, or, if empty, deleted."""
        published, self._published = self._published, None
        if BrokerEvents.RETAINED_MESSAGE not in self._wanted or message.topic.startswith("$SYS/"):
            return
        self._counters.cost += MESSAGE_COST
        source, account = None, self._inside
        if published is not None and published[0] is message:
            source = self._sessions.of_identity(cast(Identity, published[1].identity))
            account = published[1].account
        self._notify(
            BrokerEvents.RETAINED_MESSAGE,
            account,
            len(message.payload),
            client_id=None,
            retained_message=retained_message(source, message),
        )

    def _notify_message(self, session: Session, message: Message, *, allowed: bool) -> None:
        self._counters.cost += MESSAGE_COST
        account, size = session.account, len(message.payload)
        received = IncomingApplicationMessage(
            None, message.topic, message.qos, message.payload, message.retain
        )
        received.publish_packet = received.build_publish_packet()
        if MQTTEvents.PACKET_RECEIVED in self._wanted:
            self._notify(
                MQTTEvents.PACKET_RECEIVED,
                account,
                size,
                packet=received.publish_packet,
                session=self._sessions.of_identity(cast(Identity, session.identity)),
            )
        client_id = session.client_id
        about = {"client_id": client_id, "message": received}
        self._notify(BrokerEvents.MESSAGE_RECEIVED, account, size, **about)
        if allowed:
            self._notify(BrokerEvents.MESSAGE_BROADCAST, account, size, **about)

    def _notify(self, event: Events, account: Account, size: int = 0, **arguments: object) -> None:
        """Fire the event, or drop it if too many are pending; `size` is its payload in bytes, and
        `account` that of the user who caused it."""
        if event not in self._wanted:
            return
        if self._has_room(account, size):
            self._fire(event, account, size, arguments)
            return
        self._lost += 1
        now = asyncio.get_running_loop().time()
        if now - self._lost_logged_at >= LOST_LOG_INTERVAL:
            self._lost_logged_at = now
            log.warning("amqtt plugins are too slow: %d events were dropped", self._lost)

    def _has_room(self, account: Account, size: int) -> bool:
        """Whether the user may have one more event pending."""
        own, total = self._pending_of.get(_key(account), _NOTHING), self._pending
        return self._events.allows(own.events, total.events, 1) and self._bytes.allows(
            own.bytes, total.bytes, size
        )

    def _fire(
        self, event: Events, account: Account, size: int, arguments: dict[str, Any]
    ) -> list[asyncio.Future[Any]]:
        """Let amqtt start the event's handlers; returns their tasks."""
        fired = self._plugins._fired_events
        before = len(fired)
        # This coroutine never suspends as long as it is not asked to wait for the handlers.
        with contextlib.suppress(StopIteration):
            self._plugins.fire_event(event, **arguments).send(None)
        tasks = fired[before:]
        self._counters.cost += HANDLER_COST * len(tasks)
        for task in tasks:
            self._pending.add(size)
            self._pending_of.setdefault(_key(account), _Pending()).add(size)
            task.add_done_callback(partial(self._done, event, account, size))
        return tasks

    def _done(self, event: Events, account: Account, size: int, task: asyncio.Future[Any]) -> None:
        self._pending.remove(size)
        own = self._pending_of[_key(account)]
        own.remove(size)
        if not own.events:
            del self._pending_of[_key(account)]
        if not task.cancelled():
            error = task.exception()
            if error is not None:
                self._guard.log_failure(f"an amqtt plugin's handler of {event.value}", error)


def _key(account: Account) -> tuple[str | None, bool]:
    return account.username, account.is_inside
