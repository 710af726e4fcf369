"""The handler of one network client: it processes received packets and answers them.

Like the rest of the broker it does no I/O: input is passed to `receive`, and an `Output` collects
what is sent.
"""

from __future__ import annotations

import logging
import math
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, TypeAlias

from appliance.broker.backpressure import Allowance, PublisherAllowance
from appliance.broker.broker import DELAYED_AFTER, HELD_COST, Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.delivery import UnreleasedPublish
from appliance.broker.handshake import (
    Agreement,
    agree,
    connack_properties,
    is_text,
    maximum_packet_size,
    pending_will,
    refusal_of_connect,
    too_large,
)
from appliance.broker.inflow import Inflow
from appliance.broker.limits import USUAL_TERMS, Terms
from appliance.broker.message import OVERHEAD, DelayedMessage, Message
from appliance.broker.output import CANNOT_KEEP, LONGEST_REASON, Output, in_words
from appliance.broker.ports import Exchange, Transport
from appliance.broker.routing import Fanout
from appliance.broker.session import Session
from appliance.broker.subscribing import AwaitingDecision, Step, answers, subscribe, unsubscribe
from appliance.broker.values import (
    INSIDE,
    WRONG_LOGIN,
    AccessQuery,
    Identity,
    PublishRejection,
    Refusal,
)
from appliance.mqtt.codec import (
    V5,
    V31,
    V311,
    VERSION_NAMES,
    Properties,
    Property,
    encode_string,
    quote,
    text_size,
)
from appliance.mqtt.connection import ServerProtocol
from appliance.mqtt.framing import PUBACK, PUBREC, PUBREL, Event, RawPublish
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Subscribe,
    Unsubscribe,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode

log = logging.getLogger(__name__)

#: The cost of a packet that is not of the data path.
PACKET_COST: Final = 5

#: How many acknowledgements make room before the window is filled again.
ROOM_FILLED_AT_ONCE: Final = 32

#: Bytes of a partial packet, such as a CONNECT before its login, that there is always memory for.
SMALL_PACKET = 1024

#: The cost of ending a connection that violated the protocol.
FAILURE_COST = 50

#: Seconds that a publisher waits at a time for decisions on what others may receive, and the share
#: of its time that it waits in the long run: too short to make a command old, so that subscribers
#: cannot stop a publisher.
RIGHTS_PATIENCE = DELAYED_AFTER / 2
RIGHTS_SHARE = 0.1

#: The shortest time, in seconds, until a waiting message is checked again.
RECHECK = 0.01

#: What is queued behind a waiting message: a packet, or an undecoded PUBLISH.
Arrived: TypeAlias = "Packet | RawPublish"

#: Lines in one `rate_limited_log.INTERVAL` about one host and one kind of mistake: behind a host
#: there may be many clients.
HOST_BURST = 100


#: What the ids begin with that the broker gives.
_ASSIGNED: Final = "auto-"

_NO_TEXT: Final = "the payload is marked as UTF-8 text and is not"


def _size(arrived: Arrived) -> int:
    """Bytes that are counted for a packet that is queued behind a waiting message."""
    if isinstance(arrived, tuple):
        return len(arrived[1]) + len(arrived[3]) + len(arrived[4]) + OVERHEAD
    if isinstance(arrived, Publish):
        return text_size(arrived.topic) + len(arrived.payload) + len(arrived.passed_on) + OVERHEAD
    return OVERHEAD


def _guarded(route: Fanout) -> PublishRejection:
    """Why a guard of the topic, such as a lease on ROS, refuses what the access rules allow."""
    return PublishRejection(ReasonCode.NOT_AUTHORIZED, route.reason[:LONGEST_REASON])


#: CONNACK codes that may have a reason string: they do not reveal which users exist.
_EXPLAINED: Final = frozenset(
    (
        ReasonCode.BAD_AUTHENTICATION_METHOD,
        ReasonCode.PAYLOAD_FORMAT_INVALID,
        ReasonCode.QOS_NOT_SUPPORTED,
        ReasonCode.QUOTA_EXCEEDED,
        ReasonCode.RETAIN_NOT_SUPPORTED,
        ReasonCode.TOPIC_NAME_INVALID,
        ReasonCode.UNSUPPORTED_PROTOCOL_VERSION,
    )
)


class ClientHandler:
    """Handles the packets of one network connection; `output` encodes and sends the answers.

    `terms` are those of its listener. They, and the sizes in the limits, hold for as long as the
    connection: the client is told them once.
    """

    def __init__(self, broker: Broker, transport: Transport, terms: Terms = USUAL_TERMS) -> None:
        self.broker = broker
        self.transport = transport
        self._terms = terms
        limits = broker.limits
        self._payload_size = limits.payload_size
        self._refused_flags = terms.refused_flags
        self.protocol = ServerProtocol(
            limits.packet_size, limits.topic_alias, limits.user_properties
        )
        self.output = Output(broker, transport, self)
        self.session: Session | None = None
        #: Tracks when the client's messages arrived.
        self.inflow = Inflow()
        self._router = broker.router
        self._accounting = broker.accounting
        self._counters = broker.counters
        self._store = broker.store
        #: Packet ids of PUBRELs that wait until the store can store the released message.
        self._postponed: dict[int, None] = {}
        #: Packet ids of the last refused QoS 2 messages: some clients send PUBREL all the same.
        self._refused: dict[int, None] = {}
        #: The rest of the work on a packet that takes several turns.
        self._work: Iterator[Step] | None = None
        #: Whether that waits for a pending decision instead of its next turn.
        self._is_awaiting = False
        #: Whether the PUBLISH that is processed has already waited for a pending decision.
        self._has_waited = False
        self._connect: Connect | None = None
        self._held = 0  # bytes of buffered input that are counted in `accounting`
        #: The account that they are counted for; until the login that of all unknown clients.
        self.account = broker.accounting.accounts.strangers
        self._keep_alive_timeout = 0.0  # seconds; 0 for none
        self._last_packet_at = 0.0
        self._method = ""  # of its enhanced authentication
        self._exchange: Exchange | None = None
        self._unfinished_maximum = 0
        self._version = 0
        self._closed = False
        #: A message that waits for its receivers, and the packets behind it; with arrival times.
        self._behind: deque[tuple[Arrived, float]] = deque()
        self._behind_size = 0  # bytes
        #: The latest possible arrival time of the delayed packet being processed; 0 if not delayed.
        self._arrived_at = 0.0
        #: Since when input waits for a pending decision; 0 when none does.
        self._awaits_since = 0.0
        #: When the first bytes arrived that `protocol` buffers while it is paused; 0 for none.
        self._buffered_since = 0.0
        self._allowance = PublisherAllowance()
        #: The allowance for decisions on which others may receive its messages.
        self._rights_allowance = Allowance(RIGHTS_PATIENCE)
        self._asked_at = 0.0
        self._congested = broker.accounting.congested
        self._hurries = False
        #: Whether a call of `send_on` is already scheduled.
        self._later = False

    def __str__(self) -> str:
        name = str(self.session) if self.session else "client"
        return f"{name} at {self.transport.address}"

    # --- input ---------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Process bytes that arrived from the network."""
        counters = self._counters
        counters.bytes_received += len(data)
        now = self._accounting.now
        protocol = self.protocol
        cost = counters.cost + COST_PER_TURN
        inflow = self.inflow
        if inflow.is_watched:
            inflow.chunk_received(data, now)
        room = 0  # messages that were acknowledged, and the window not filled since
        try:
            events: Iterable[Event]
            if inflow.unfinished and now - inflow.unfinished > DELAYED_AFTER:
                events = self._completing(data, cost)
            elif self._behind:
                events = self._passing(data, cost)
            else:
                events = protocol.receive_data(data)
            for event in events:
                self._last_packet_at = now  # for keep alive only complete packets count
                session = self.session
                if type(event) is int and event < PUBREC and session is not None:  # PUBACK
                    counters.cost += 1
                    counters.control_received += 1
                    if session.acknowledged(event & 0xFFFF):
                        # A reader of a full queue acknowledges many in a chunk: to fill the window
                        # once for them takes a sixth less than once for each. A few at a time, as
                        # each may make room for a message of any cost.
                        room += 1
                        if room == ROOM_FILLED_AT_ONCE:
                            room = 0
                            session.fill_window()
                else:
                    if room and session is not None:
                        # What comes now finds the queue as these acknowledgements leave it.
                        room = 0
                        session.fill_window()
                    if type(event) is tuple:
                        self._on_raw_publish(event)
                    elif type(event) is int:
                        counters.cost += 1
                        self._on_acknowledgement(event & 0xFF_0000, event & 0xFFFF, 0)
                    else:
                        counters.cost += PACKET_COST + protocol.cost
                        self._on_packet(event)  # type: ignore[arg-type]
                if counters.cost > cost and not protocol.paused:
                    # The rest of the chunk waits until the other clients have had their turn.
                    protocol.pause()
                    self.later()
        except ProtocolError as error:
            counters.cost += FAILURE_COST + protocol.cost
            self.fail(error)
        if room and self.session is not None:
            self.session.fill_window()
        if self._behind and protocol.paused and not self._later and self._work is None:
            if self._has_place_behind():
                self.receive(b"")
                return
            self.transport.stop_reading()
        if self._store.fresh:
            self._depend()
        held = protocol.held
        if held or inflow.unfinished or self._buffered_since:
            self._note_unfinished(data, now)
        if held + self._behind_size != self._held:
            self._count_held()

    def _note_unfinished(self, data: bytes, now: float) -> None:
        """Update when the first bytes of a partial packet, or of buffered input, arrived."""
        inflow, protocol = self.inflow, self.protocol
        has_completed = self._last_packet_at == now
        arrived_at = now if data else self._buffered_since or now
        if protocol.paused:  # it may buffer a partial packet, or more than that
            if has_completed:
                inflow.unfinished = 0.0
                self._buffered_since = arrived_at
            self._buffered_since = self._buffered_since or arrived_at
            return
        self._buffered_since = 0.0
        if not protocol.unfinished:
            inflow.unfinished = 0.0
        elif not inflow.unfinished or has_completed:
            inflow.unfinished = arrived_at

    def _completing(self, data: bytes, cost: int) -> Iterator[Event]:
        """The events of `data`; a packet that arrived in parts is as old as its first part."""
        arrived_at, self._arrived_at = self._arrived_at, self.inflow.unfinished
        protocol = self.protocol
        for event in self._passing(data, cost) if self._behind else protocol.receive_data(data):
            yield event
            self._arrived_at = arrived_at
        self._arrived_at = arrived_at

    def _depend(self) -> None:
        """Make the answers that were just sent depend on the changes that were just staged."""
        self._store.fresh = False
        self.output.batch = self._store.batch

    def _count_held(self) -> None:
        """Count the memory of unprocessed input, which is limited like that of all queues."""
        accounting = self._accounting
        grown = self.protocol.held + self._behind_size - self._held
        self._held += grown
        accounting.take(self.account, grown)
        accounting.input_bytes += grown
        self.transport.holds(self._held)
        if (
            grown > 0
            and self._held > max(accounting.reserve, SMALL_PACKET)
            and not accounting.fits(self.account, 0)
        ):
            self.fail(
                ProtocolError(
                    ReasonCode.QUOTA_EXCEEDED,
                    f"no memory for {self._held} bytes of unfinished packets and topic aliases "
                    "(broker.limits.memory, broker.limits.user.memory)",
                )
            )

    def _on_raw_publish(self, event: RawPublish) -> None:
        """The data path: a PUBLISH without properties."""
        first, topic_wire, packet_id, payload, head = event
        router = self._router
        session = self.session
        assert session is not None
        counters = self._counters
        size = len(payload)
        counters.publish_received += 1
        counters.publish_bytes_received += size
        # A cached route has the topic decoded and checked, which saves this for each message.
        if session.epoch == router.epoch and topic_wire in session.routes:
            route: Fanout = session.routes[topic_wire]
        else:
            route = router.route(session, topic_wire)
            if route.undecided and self._hold(route, size, self._on_raw_publish, event):
                return
        if size > self._payload_size and route.allowed:
            counters.cost += PACKET_COST
            if first & self._refused_flags:
                raise self._unsupported(first)
            self._refuse_size(session, route.topic, first >> 1 & 3, packet_id, payload)
            return
        targets = route.targets
        if first == 0x30 and route.allowed and self.broker.observer is None:
            counters.cost += 1 + len(targets)
            # A plain QoS 0 message is forwarded unchanged to receivers of the same version, without
            # creating a Message. The remaining targets are those that need the slow path.
            targets = [
                target
                for target in targets
                if target[3]
                or target[0].link is None
                or not target[0].link.mirror(head, self._version, size)
            ]
            if not targets and route.is_plain:
                return
        # Not before: what goes the way above has no such flag.
        if first & self._refused_flags:
            raise self._unsupported(first)
        qos = first >> 1 & 3
        message = Message(route.topic, payload, qos, first & 1 == 1, None, None, topic_wire)
        if first & 8 or (self._arrived_at and self._is_old()):
            message = DelayedMessage(message, math.inf if first & 8 else self._age())
        else:
            # A receiver with the same version, QoS and flags gets the header as it arrived,
            # which saves encoding it.
            message.wire_key = self._version << 8 | first
            message.wire_head = head
        if qos and self._congested and self._must_wait(event, message, route):
            return
        if qos == 2:
            self._on_publish_qos2(session, packet_id, message, route)
            return
        code = self.broker.publish_to(targets, route, message, session)
        if not qos:
            return
        if code or message.rejection is not None:
            self._answer(packet_id, code, route, message)
        else:
            self.output.acknowledge(0x40, packet_id, 0)

    def _on_publish(self, packet: Publish) -> None:
        """Process a PUBLISH from the full decoder; most likely it has properties."""
        session = self.session
        assert session is not None
        broker = self.broker
        counters = self._counters
        counters.publish_received += 1
        counters.publish_bytes_received += len(packet.payload)
        flags = packet.qos << 1 | packet.retain
        if flags & self._refused_flags:
            raise self._unsupported(flags)
        message = Message(
            packet.topic,
            packet.payload,
            packet.qos,
            packet.retain,
            None,
            self._expires_at(packet.properties),
            properties_wire=packet.passed_on,
        )
        if packet.dup or (self._arrived_at and self._is_old()):
            message = DelayedMessage(message, math.inf if packet.dup else self._age())
        route = self._router.route(session, message.topic_wire)
        if route.undecided and self._hold(route, len(packet.payload), self._on_publish, packet):
            return
        packet_id = packet.packet_id or 0
        if packet.qos and self._congested and self._must_wait(packet, message, route):
            return
        if len(packet.payload) > self._payload_size and route.allowed:
            self._refuse_size(session, packet.topic, packet.qos, packet_id, packet.payload)
        elif (
            route.allowed  # checked before anything costly
            and broker.features.check_payload_format
            and not is_text(message.payload, packet.properties)
        ):
            code, reason = ReasonCode.PAYLOAD_FORMAT_INVALID, _NO_TEXT
            self._refuse_payload(session, packet.topic, packet.qos, packet_id, code, reason)
        elif packet.qos == 2:
            self._on_publish_qos2(session, packet_id, message, route)
        elif self._arrived_at and route.allowed and self._accounting.has_expired(message):
            if packet.qos:  # it has expired: it is acknowledged, not delivered [MQTT-3.3.2-5]
                self.output.acknowledge(0x40, packet_id, ReasonCode.SUCCESS)
        else:
            code = broker.publish_to(route.targets, route, message, session)
            if packet.qos:
                self._answer(packet_id, code, route, message)

    def _answer(self, packet_id: int, code: int, route: Fanout, message: Message) -> None:
        """Acknowledge a message of QoS 1 that was published, or refused."""
        if message.rejection is not None:
            rejection, message.rejection = message.rejection, None
            self.output.reject_publish(0x40, packet_id, rejection)
        elif route.is_guarded:
            self.output.reject_publish(0x40, packet_id, _guarded(route))
        else:
            reason = self._reason(code, route, message) if code >= 0x80 else ""
            self.output.acknowledge(0x40, packet_id, code, reason)

    def _reason(self, code: int, route: Fanout, message: Message) -> str:
        """Why a message was refused, as a text; empty if the client gets no reason strings."""
        session = self.session
        if session is None or self._version != 5 or not self.output.explains:
            return ""
        if code == ReasonCode.NOT_AUTHORIZED:
            return route.reason
        if self._accounting.failing:
            return CANNOT_KEEP
        return self.broker.shortage(route, message, session)

    def _hold(
        self, route: Fanout, size: int, publish: Callable[[Any], None], packet: object
    ) -> bool:
        """Let a PUBLISH, and what follows it, wait for the pending decisions on its route.

        It waits for decisions on its own user. For decisions on who else may receive it, it waits
        only for a moment; an undecided receiver then misses it. Returns False when the PUBLISH has
        already waited, or need not.
        """
        session = self.session
        asked = self._router.pending_decisions
        if asked is None or self._has_waited or session is None:
            return False
        allowance, now = self._rights_allowance, self._accounting.now
        allowance.change((now - self._asked_at) * RIGHTS_SHARE)
        self._asked_at = now
        if allowance.used_up and not self._is_asked_about(route):
            return False
        until = now + asked.timeout
        arrived_at = self._arrived_at or now
        topic_wire = encode_string(route.topic)
        self._counters.publish_received -= 1  # it is counted again when it is processed
        self._counters.publish_bytes_received -= size

        def questions() -> list[AccessQuery]:
            return self._router.route(session, topic_wire).undecided

        def own() -> list[AccessQuery]:
            found = self._router.route(session, topic_wire)
            return found.undecided if self._is_asked_about(found) else []

        def work() -> Iterator[Step]:
            yield from answers(self.broker, own, self._wake, until)
            since = self._accounting.now
            if not allowance.used_up and questions():
                soon = since + allowance.left
                for step in answers(self.broker, questions, self._wake, soon):
                    self.transport.wait(max(soon - self._accounting.now, RECHECK))
                    yield step
                allowance.change(since - self._accounting.now)
            self._asked_at = self._accounting.now
            self._has_waited = True
            self._arrived_at = arrived_at
            try:
                publish(packet)
            finally:
                self._has_waited = False
                self._arrived_at = 0.0

        self._begin(work())
        return True

    def _is_asked_about(self, route: Fanout) -> bool:
        """Whether a decision is pending on this client, or another client of its user."""
        identity = self.session.identity if self.session is not None else None
        return identity is not None and any(
            other == identity
            or (other.username is not None and other.username == identity.username)
            for other, _, _ in route.undecided
        )

    def _is_old(self) -> bool:
        """Whether the packet has waited so long that its message counts as delayed."""
        return self._accounting.now - self._arrived_at > DELAYED_AFTER

    def _age(self) -> float:
        """The age of the message being processed; infinity if it may have waited unread."""
        return self._accounting.now - self._arrived_at if self.inflow.unfinished else math.inf

    def _wake(self) -> None:
        """A pending decision that a packet waits for has been made."""
        if not self._closed:
            self.later()

    # --- backpressure, see backpressure.py -----------------------------------------------------

    def _must_wait(self, arrived: Arrived, message: Message, route: Fanout) -> bool:
        """Let the message wait if receivers have no room for it now, but soon will, or if the disk
        is behind."""
        broker, session, now = self.broker, self.session, self._accounting.now
        assert session is not None
        congestions = broker.congestions(route, message) if route.allowed else []
        allowance = self._allowance
        if congestions and not allowance.used_up and not self._hurries:
            self.transport.wait(max(allowance.wait(self, congestions, now), RECHECK))
        else:
            allowance.end_wait(self)
            if (
                broker.disk not in self._congested  # asked here too, which saves a call
                or not route.allowed
                or not broker.must_wait_for_disk(route, message, session)
            ):
                return False
            if self._hurries:  # its client has left, and was not told that it had come
                self._counters.drop("not_stored")
                return True
            self.transport.wait(broker.disk.wait(self))
        # It is counted when it is processed again.
        self._counters.publish_received -= 1
        self._counters.publish_bytes_received -= len(message.payload)
        self._behind.appendleft((arrived, self._arrived_at or now))
        self._behind_size += _size(arrived)
        self.protocol.pause()
        return True

    def proceed(self) -> None:
        """A receiver that it waits for has room again."""
        self.transport.proceed()

    def _has_place_behind(self) -> bool:
        """Whether more packets may be queued behind the waiting message: as many bytes as a queue.

        No packet is queued behind one that is not a PUBLISH, because that may change its meaning.
        """
        accounting = self._accounting
        grown = self._behind_size + self.protocol.held - self._held
        return (
            self._behind_size < accounting.queue_bytes
            and isinstance(self._behind[-1][0], tuple | Publish)
            and (
                accounting.queued_bytes + grown <= accounting.unrestricted_memory
                or accounting.fits(self.account, grown)
            )
        )

    def _passing(self, data: bytes, limit: int) -> Iterator[Event]:
        """The events that need not wait behind a waiting message; the others are queued.

        Acknowledgements, for which others wait, and pings pass: all input that the client may have
        on its way is searched for them. `limit` is the cost at which the client's turn ends.
        """
        protocol, counters = self.protocol, self._counters
        if protocol.paused and self._has_place_behind():
            protocol.resume()
        for event in protocol.receive_data(data):
            if isinstance(event, int | Puback | Pubrec | Pubrel | Pubcomp | Pingreq):
                yield event
                continue
            self._last_packet_at = self._accounting.now
            self._behind.append((event, self._arrived_at or self._accounting.now))
            self._behind_size += _size(event)
            counters.cost += 1 if isinstance(event, tuple) else PACKET_COST + protocol.cost
            if not self._has_place_behind():
                protocol.pause()
            elif counters.cost > limit:
                protocol.pause()
                self.later()

    def _try_again(self) -> None:
        """Publish the waiting message, if any, and process the packets behind it."""
        behind = self._behind
        if not behind:
            return
        limit = self._counters.cost + COST_PER_TURN
        self._allowance.spend(self._accounting.now)
        try:
            while behind and self._work is None:
                if self._counters.cost > limit:
                    self.later()
                    break
                left = len(behind) - 1
                arrived, self._arrived_at = behind.popleft()
                self._behind_size -= _size(arrived)
                if isinstance(arrived, tuple):
                    self._on_raw_publish(arrived)
                else:
                    self._counters.cost += PACKET_COST
                    self._on_packet(arrived)
                if len(behind) > left:
                    break  # it waits again
                if self._allowance.awaited:  # without any congestion `_must_wait` was not called
                    self._allowance.end_wait(self)
        except ProtocolError as error:
            self.fail(error)
        self._arrived_at = 0.0
        if self._store.fresh:
            self._depend()
        if self.protocol.held + self._behind_size != self._held:
            self._count_held()

    def hurry(self) -> None:
        """The connection is lost: process the received packets without waiting for receivers."""
        self._hurries = True
        if not self._behind:
            return  # other work, such as a login, still waits
        self._try_again()  # what exceeds the limit of this turn is done in later turns
        if not self._behind and self._work is None and self.protocol.paused:
            self.protocol.resume()

    def _expires_at(self, properties: Properties | None) -> float | None:
        interval = (properties or {}).get(Property.MESSAGE_EXPIRY_INTERVAL)
        arrived_at = self._arrived_at or self._accounting.now
        return arrived_at + interval if isinstance(interval, int) else None

    def _unsupported(self, flags: int) -> ProtocolError:
        """The error of a PUBLISH with flags that the listener's terms exclude.

        [MQTT-3.2.2-11] and [MQTT-3.2.2-14] forbid it to a client of MQTT 5, which was told. One of
        3.1.1 has no other way to learn it than the end of its connection.
        """
        qos = flags >> 1 & 3
        if qos > self._terms.max_qos:
            text = f"QoS {qos}, more than its listener's max_qos of {self._terms.max_qos}"
            return ProtocolError(ReasonCode.QOS_NOT_SUPPORTED, text)
        text = "a message to be retained, which its listener does not take (retain: false)"
        return ProtocolError(ReasonCode.RETAIN_NOT_SUPPORTED, text)

    def _refuse_size(
        self, session: Session, topic: str, qos: int, packet_id: int, payload: bytes
    ) -> None:
        reason = too_large(payload, self._payload_size)
        self._refuse_payload(session, topic, qos, packet_id, ReasonCode.QUOTA_EXCEEDED, reason)

    def _refuse_payload(
        self, session: Session, topic: str, qos: int, packet_id: int, code: ReasonCode, reason: str
    ) -> None:
        """Refuse a message that the rules allow; with QoS 0, and in 3.1.1, it is lost silently."""
        self._counters.publish_refused += 1
        self.broker.log_rate_limited(session, "may not publish to %s: %s", quote(topic), reason)
        if qos == 1:
            self.output.acknowledge(0x40, packet_id, code, reason)
        elif qos:
            self._refuse_qos2(packet_id, code, reason)

    def _on_publish_qos2(
        self, session: Session, packet_id: int, message: Message, route: Fanout
    ) -> None:
        """Hold the message until PUBREL [MQTT-4.3.3-10]; it is published only then."""
        self._counters.cost += HELD_COST
        code, reason = ReasonCode.SUCCESS, ""
        held = session.received.get(packet_id)
        if (
            self._accounting.failing
            and route.allowed
            and self.broker.must_store(route, message, session)
        ):
            session.unhold(packet_id)
            self._counters.drop("not_stored")
            self._refuse_qos2(packet_id, ReasonCode.QUOTA_EXCEEDED, CANNOT_KEEP)
            return
        if held is not None and not held.message.is_like(message):
            # A client that has lost its state reuses packet ids, and will never release the old
            # message. mosquitto does the same.
            session.unhold(packet_id)
            held = None
        if held is not None:
            pass  # a duplicate: PUBREC is sent again [MQTT-4.3.3-12]
        elif not route.allowed:
            self.broker.refuse_publish(session, route, message)
            # 3.1.1 cannot refuse: the exchange continues, and the message is not delivered.
            if route.is_guarded and self._version == 5:
                self._note_refused(packet_id)
                self.output.reject_publish(0x50, packet_id, _guarded(route))
                return
            code = ReasonCode.NOT_AUTHORIZED
        elif self._version == 5 and len(session.received) >= self._unfinished_maximum:
            raise ProtocolError(  # [MQTT-3.3.4-7]
                ReasonCode.RECEIVE_MAXIMUM_EXCEEDED,
                f"more than {self.broker.limits.inflight} unfinished QoS 2 messages",
            )
        else:
            self.broker.announce(message, session)
            # 3.1.1 cannot refuse: the message may be rejected when it is published.
            rejection = self.broker.inspect(message, session) if self._version == 5 else None
            if rejection is not None:
                self._counters.publish_refused += 1
                self._note_refused(packet_id)
                self.output.reject_publish(0x50, packet_id, rejection)
                return
            full, everybody = self.broker.without_room(route, message)
            refuses = self._version == 5 and self.broker.limits.queue_full == "refuse"
            if everybody and refuses:
                code = ReasonCode.QUOTA_EXCEEDED
                self._counters.drop("queue_full")
            elif not session.hold(
                packet_id, UnreleasedPublish(message, full, self.transport.now())
            ):
                code = ReasonCode.QUOTA_EXCEEDED
                shortage = session.shortage(message.size)
                reason = f"no room for its unfinished QoS 2 messages: {shortage}"
                if self._version != 5:
                    raise ProtocolError(code, reason)
        if code:
            self._refuse_qos2(packet_id, code, reason or self._reason(code, route, message))
        else:
            self.output.acknowledge(0x50, packet_id, code)

    def _note_refused(self, packet_id: int) -> None:
        self._refused[packet_id] = None
        if len(self._refused) > self.broker.limits.inflight:
            del self._refused[next(iter(self._refused))]

    def _refuse_qos2(self, packet_id: int, code: ReasonCode, reason: str) -> None:
        self._note_refused(packet_id)
        self.output.acknowledge(0x50, packet_id, code, reason)

    def _on_acknowledgement(self, kind: int, packet_id: int, code: int) -> None:
        session = self.session
        assert session is not None
        self._counters.control_received += 1
        if kind == PUBACK:
            if not session.puback(packet_id):
                log.debug("%s: PUBACK %d for nothing in flight", self, packet_id)
        elif kind == PUBREC:
            known = session.pubrec(packet_id, code)
            if not known:
                log.debug("%s: PUBREC %d for nothing in flight", self, packet_id)
            if code < 0x80 and not (self._accounting.failing and session.expiry):
                # An unknown id is answered, too, or a client that missed our restart would wait
                # forever. 0x92 is left out: the client does not need it, and mosquitto does so.
                self.output.acknowledge(0x62, packet_id, ReasonCode.SUCCESS)
        elif kind == PUBREL:
            if self._accounting.failing and self._must_postpone(session, packet_id):
                return
            held = session.unhold(packet_id)
            answer = ReasonCode.SUCCESS
            if held is not None:
                self.broker.release(held, session, self.transport.now() - held.since)
            elif self._refused and packet_id in self._refused:
                # paho-mqtt ignores a refusing PUBREC, and would report success.
                del self._refused[packet_id]
                answer = ReasonCode.PACKET_IDENTIFIER_NOT_FOUND
            self.output.acknowledge(0x70, packet_id, answer)
        elif not session.pubcomp(packet_id):
            log.debug("%s: PUBCOMP %d for nothing in flight", self, packet_id)

    def _must_postpone(self, session: Session, packet_id: int) -> bool:
        """Whether a PUBREL, which cannot be refused, has to wait until the store works again."""
        held = session.received.get(packet_id)
        if held is None:
            # Its PUBCOMP may depend on a change that is not committed yet.
            postpone = session.persistent
        else:
            route = self._router.route(session, held.message.topic_wire)
            postpone = self.broker.must_store(route, held.message, session)
        if postpone:
            self._postponed[packet_id] = None
        return postpone

    def resume(self) -> None:
        """The store works again: process the PUBRELs that waited for it."""
        postponed, self._postponed = self._postponed, {}
        try:
            for packet_id in postponed:
                self._on_acknowledgement(PUBREL, packet_id, 0)
        except ProtocolError as error:
            self.fail(error)
        if self._store.fresh:
            self._depend()

    def _on_packet(self, packet: Packet) -> None:
        if isinstance(packet, Publish):
            self._on_publish(packet)
            return
        if isinstance(packet, Puback | Pubrec | Pubrel | Pubcomp):
            self._on_acknowledgement(packet.TYPE << 16, packet.packet_id, packet.reason_code)
            return
        self._counters.control_received += 1
        session = self.session
        if isinstance(packet, Pingreq):
            self._send(Pingresp())  # [MQTT-3.12.4-1]
        elif isinstance(packet, Subscribe) and session is not None:
            self._begin(
                subscribe(
                    self.broker,
                    session,
                    packet,
                    self._wake,
                    max_qos=self._terms.max_qos,
                    explains=self.output.explains,
                    may_explain=self.output.may_explain,
                )
            )
        elif isinstance(packet, Unsubscribe) and session is not None:
            self._begin(unsubscribe(self.broker, session, packet))
        elif isinstance(packet, Disconnect):
            self._on_disconnect(packet)
        elif isinstance(packet, Connect):
            self._on_connect(packet)
        elif isinstance(packet, Auth):
            self._on_auth(packet)

    def _begin(self, work: Iterator[Step]) -> None:
        """Work on a packet that may be costly, until a step asks for a pause."""
        for answer in work:
            if answer is None or isinstance(answer, AwaitingDecision):
                # Later packets wait until this one is done.
                self._work = work
                self._is_awaiting = answer is not None
                self._awaits_since = self._awaits_since or self._arrived_at or self._accounting.now
                self.protocol.pause()
                if answer is None:
                    self.later()
                return
            self._send(answer)
            if self._closed:
                return
        self._work = None

    def _go_on(self, work: Iterator[Step]) -> None:
        """Continue the work that the last turn was too short for."""
        self._is_awaiting = False
        self._last_packet_at = self._accounting.now  # its packets are not read meanwhile
        try:
            self._begin(work)
        except ProtocolError as error:
            self.fail(error)
        if self._store.fresh:
            self._depend()

    def _on_disconnect(self, packet: Disconnect) -> None:
        expiry = (packet.properties or {}).get(Property.SESSION_EXPIRY_INTERVAL)
        session = self.session
        if session is None:  # it gives up during its authentication
            self._shut()
            return
        if isinstance(expiry, int) and expiry and not session.expiry:  # [MQTT-3.14.2-2]
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, "a session expiry in DISCONNECT, but none in CONNECT"
            )
        log.info("%s disconnected", self)
        self._leave(
            "it disconnected",
            publish_will=packet.reason_code != ReasonCode.NORMAL_DISCONNECTION,  # [MQTT-3.14.4-3]
            expiry=expiry if isinstance(expiry, int) else None,
        )

    # --- CONNECT -------------------------------------------------------------------------------

    def _on_connect(self, packet: Connect) -> None:
        self._connect = packet
        self._version = self.output.version = max(packet.version, V311)
        self.output.maximum_packet_size = maximum_packet_size(packet)
        properties = packet.properties or {}
        longest = self.broker.limits.client_id_length
        size = len(packet.client_id.encode())
        if size > longest:  # [MQTT-3.1.3-9], 3.1.1 [MQTT-3.1.3-9]
            reason = (
                f"its id has {size} bytes, more than {longest} (broker.limits.client_id_length)"
            )
            self.refuse(ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, reason)
            return
        is_nameless = not packet.client_id and packet.version != V5
        if is_nameless and not packet.clean_start:
            # [MQTT-3.1.3-8]: a persistent session needs a client id
            self.refuse(ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, "no client id, but clean session 0")
            return
        if is_nameless and packet.version == V31:
            self.refuse(ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, "no client id, needed in MQTT 3.1")
            return
        if packet.client_id.startswith(INSIDE):
            reason = f"client ids that begin with {INSIDE} are the appliance's own"
            self.refuse(ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, reason)
            return
        refusal = refusal_of_connect(
            packet, packet.client_id or _ASSIGNED, self._payload_size, self._terms
        )
        if refusal is not None:
            self.refuse(*refusal)
            return
        will = packet.will
        excess = self._router.excess(will.topic) if will is not None else ""
        if excess:
            self.refuse(ReasonCode.TOPIC_NAME_INVALID, f"its will's topic has {excess}")
            return
        checked = self.broker.features.check_payload_format
        if will is not None and checked and not is_text(will.payload, will.properties):
            reason = "its will is marked as text and is not"
            self.refuse(ReasonCode.PAYLOAD_FORMAT_INVALID, reason)
            return
        method = properties.get(Property.AUTHENTICATION_METHOD)
        if isinstance(method, str):
            self._method = method
            self._exchange = self.transport.exchange(method)
            if self._exchange is None:  # [MQTT-4.12.0-1]
                reason = f"it wants to authenticate with {quote(method)}, which is not offered"
                self.refuse(ReasonCode.BAD_AUTHENTICATION_METHOD, reason)
                return
            self._authenticate(self._exchange, properties)
            return
        # Bytes behind a CONNECT are processed only after the login.
        self.protocol.pause()
        self.transport.authenticate(packet)

    def _on_auth(self, packet: Auth) -> None:
        """Process a step of an enhanced authentication (5.0 section 4.12)."""
        properties = packet.properties or {}
        code = packet.reason_code
        if not self._method:  # [MQTT-4.12.0-7]
            problem = "AUTH, but no authentication method in CONNECT"
        elif properties.get(Property.AUTHENTICATION_METHOD) != self._method:  # [MQTT-4.12.0-5]
            problem = "AUTH with another authentication method than CONNECT"
        elif code == ReasonCode.RE_AUTHENTICATE and self.session and not self._exchange:
            self._exchange = self.transport.exchange(self._method)
            problem = "" if self._exchange else "its authentication method is not offered any more"
        elif code == ReasonCode.CONTINUE_AUTHENTICATION and self._exchange:
            problem = ""
        else:
            problem = f"AUTH 0x{code:02X} {'in' if self._exchange else 'without'} an authentication"
        if problem or self._exchange is None:
            raise ProtocolError(ReasonCode.PROTOCOL_ERROR, problem)
        self._authenticate(self._exchange, properties)

    def _authenticate(self, exchange: Exchange, properties: Properties) -> None:
        data = properties.get(Property.AUTHENTICATION_DATA, b"")
        assert isinstance(data, bytes)
        if not data.isascii():  # names in it are examined character by character
            self._counters.cost += len(data) // 3
        outcome = exchange.step(data)
        if isinstance(outcome, bytes):
            answer = self._authentication(outcome)
            self._send(Auth(ReasonCode.CONTINUE_AUTHENTICATION, answer))  # [MQTT-4.12.0-2]
            return
        self._exchange = None
        session = self.session
        if isinstance(outcome, Refusal):
            if session is None:  # [MQTT-4.12.0-4]
                self.refuse(outcome.code, outcome.reason)
            else:  # [MQTT-4.12.1-2]
                self.close(outcome.code, f"it did not authenticate again: {outcome.reason}")
        elif session is None:
            self.accept(outcome.username, self._authentication(outcome.data))
        elif session.identity is None or session.identity.username != outcome.username:
            self.close(ReasonCode.NOT_AUTHORIZED, "it authenticated again as somebody else")
        else:
            self._send(Auth(ReasonCode.SUCCESS, self._authentication(outcome.data)))

    def _authentication(self, data: bytes) -> Properties:
        properties: Properties = {Property.AUTHENTICATION_METHOD: self._method}
        if data:
            properties[Property.AUTHENTICATION_DATA] = data
        return properties

    def refuse(self, code: ReasonCode, reason: str) -> None:
        """Answer CONNECT with the code and close; bytes behind the CONNECT are discarded."""
        if self._closed:
            return
        user = self._connect.username if self._connect else None
        name = self._connect.client_id if self._connect else ""
        self._log_rate_limited(
            "client %s (%s) at %s refused: %s",
            quote(name),
            f"user {quote(user)}" if user is not None else "no user name",
            self.transport.address,
            reason,
        )
        if self.broker.audit_log is not None:
            address, tls_info = self.transport.address, self.transport.tls_info()
            self.broker.audit_log.refused(address, reason, code, name, user, tls_info)
        self._counters.refuse(code)
        self._counters.logins_failed += code in WRONG_LOGIN
        explains = code in _EXPLAINED and self.broker.features.reason_strings
        words = in_words(reason) if explains else None
        self._send(Connack(False, code, words))  # [MQTT-3.2.2-6], v3.1.1 [MQTT-3.2.2-4]
        self._shut()

    def accept(self, username: str | None, authentication: Properties | None = None) -> None:
        """The login succeeded: open the session, send CONNACK, continue reading.

        `authentication` goes into the CONNACK: the last data of an enhanced authentication.
        """
        packet, self._connect = self._connect, None
        if self._closed or packet is None:
            return
        self.protocol.forget_connect()
        self._count_held()
        assigned = None if packet.client_id else _ASSIGNED + str(uuid.uuid4()).upper()
        identity = Identity(username, assigned or packet.client_id)
        try:
            agreement = agree(packet, self.broker.limits)
            refusal = self.transport.admit(self._accounting.accounts.of(identity))
            if refusal:
                raise ProtocolError(ReasonCode.QUOTA_EXCEEDED, refusal)
            session, present = self.broker.connect(
                self.output,
                identity,
                clean_start=packet.clean_start,
                expiry=agreement.expiry,
                will=pending_will(packet),
            )
        except ProtocolError as error:
            self._connect = packet
            self.refuse(error.code, str(error))
            return
        try:
            self._open(session, identity, present, packet, agreement, authentication)
        except Exception:
            # Treat it as not logged in: it is the CONNECT that is refused.
            self.broker.disconnect(session, self.output, publish_will=False)
            self.session = None
            raise
        if self._closed:
            return
        log.info(
            "%s connected: MQTT %s, keep alive %d s%s",
            self,
            VERSION_NAMES[packet.version],
            agreement.keep_alive,
            ", session continued" if present else "",
        )
        if self.broker.audit_log is not None:
            address, tls_info = self.transport.address, self.transport.tls_info()
            self.broker.audit_log.connected(session, address, packet.version, tls_info)
        self.broker.connected(session)
        self.receive(b"")  # what came behind CONNECT

    def _open(
        self,
        session: Session,
        identity: Identity,
        present: bool,
        packet: Connect,
        agreement: Agreement,
        authentication: Properties | None,
    ) -> None:
        """Attach to the session, and send CONNACK."""
        session.open_window(agreement.window)
        # A client's send quota begins anew with each connection (section 4.9).
        self._unfinished_maximum = self.broker.limits.inflight + len(session.received)
        session.reconnected()
        self.session = session
        self._accounting.take(self.account, -self._held)
        self.account = session.account
        self._accounting.take(self.account, self._held)
        self.output.may_explain = agreement.explain
        explains = agreement.explain and self.broker.features.reason_strings
        self.output.open(session, agreement.aliases, explains=explains)
        self._keep_alive_timeout = (
            1.5 * agreement.keep_alive
        )  # [MQTT-3.1.2-22], 3.1.1 [MQTT-3.1.2-24]
        self._last_packet_at = self._accounting.now
        self.protocol.accept()
        counters = self._counters
        counters.connects += 1
        self.broker.clients.add(self)
        counters.clients_maximum = max(counters.clients_maximum, len(self.broker.clients))
        properties = connack_properties(
            packet,
            agreement,
            identity,
            self.broker.limits,
            self.broker.features,
            self._terms,
            authentication or {},
        )
        # In 3.1 the byte of Session Present is reserved.
        self._send(Connack(present and packet.version != V31, ReasonCode.SUCCESS, properties))

    # --- turns, and output ---------------------------------------------------------------------

    def later(self) -> None:
        """Schedule `send_on` after the turns of the other clients."""
        if not self._later:
            self._later = True
            self.transport.later()

    def send_on(self) -> None:
        """Continue where the last turn ended: with queued messages, and with received packets."""
        self._later = False
        if self.session is not None and self.session.link is self.output:
            self.session.take_turn()
            if self._work is not None:
                self._go_on(self._work)
            if self._work is None and not self._later:
                self._try_again()
            if self._work is None and self.protocol.paused:
                if not self._behind:
                    self.protocol.resume()
                # What arrived meanwhile may be as old as the wait.
                self._arrived_at = self._awaits_since
                self.receive(b"")
                self._arrived_at = 0.0
                if not self.protocol.paused:
                    self._awaits_since = 0.0

    def _send(self, packet: Packet) -> None:
        if self.output.send(packet):
            return
        if self.session is None or isinstance(packet, Connack):
            # No packet can tell the client so [MQTT-3.14.0-1].
            self._log_rate_limited("%s: its Maximum Packet Size is too small for %s", self, packet)
            self._leave(f"its Maximum Packet Size is too small for {packet}", publish_will=False)
        elif not isinstance(packet, Disconnect):
            reason = f"its Maximum Packet Size is too small for a {packet.TYPE.name}"
            self.close(ReasonCode.PACKET_TOO_LARGE, reason)

    # --- the end -------------------------------------------------------------------------------

    def fail(self, error: ProtocolError) -> None:
        """The client violated the protocol: send it the reason code, if possible, and close."""
        self._log_rate_limited("%s broke the protocol: %s (0x%02X)", self, error, error.code)
        if self.session is None:
            if self.broker.audit_log is not None:
                self.broker.audit_log.refused(self.transport.address, str(error), error.code)
            # A CONNECT of an unknown version is refused in the format of 3.1.1 [MQTT-3.1.2-2], an
            # invalid one of 5.0 in that of 5.0; before CONNECT there is no packet to answer with.
            unknown = error.code == ReasonCode.UNSUPPORTED_PROTOCOL_VERSION
            if error.notify_peer and (unknown or self.protocol.version == 5):
                self.output.version = self.protocol.version
                self._send(Connack(False, error.code))
            self._shut()
        elif error.notify_peer:
            self._end(error.code, str(error))
        else:
            self._leave(str(error), publish_will=True)

    def fault(self) -> None:
        """An internal error occurred: send its code (0x83) to the client, and close."""
        if self._closed:
            self._make_sure()
            self.output.end()  # this call may be what has failed
            return
        code = ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR
        if self.session is not None:
            self._end(code, "a fault in the appliance")
            return
        if self.protocol.version == 5:
            self.output.version = 5
            self._send(Connack(False, code))
        self._shut()

    def cut_off(self) -> None:
        """Abort the connection because even closing it failed, and remove all references to it."""
        try:
            self._shut()
        except Exception as error:
            self.broker.faults.caught("client.shut", error, self)
        try:
            self._make_sure()
        except Exception as error:
            self.broker.faults.caught("client.cut_off", error, self)
            if self.session is not None and self.session.link is self.output:
                self.session.link = None
        self.transport.abort()

    def _make_sure(self) -> None:
        """Make sure that the session is disconnected, even if an error interrupted the close."""
        self.broker.clients.discard(self)
        if self.session is not None:
            self.broker.disconnect(self.session, self.output, publish_will=True)

    def close(self, reason: ReasonCode, message: str) -> None:
        """Close with a reason code in DISCONNECT [MQTT-4.13.1-1]; the will is due."""
        log.info("%s: connection closed: %s", self, message)
        self._end(reason, message)

    def _end(self, reason: ReasonCode, message: str) -> None:
        if self._version == 5:
            self._send(Disconnect(reason, in_words(message) if self.output.explains else None))
        self._leave(message, publish_will=True)

    def _log_rate_limited(self, message: str, *args: object) -> None:
        """Log a warning about the client's address, rate limited for each host."""
        host, _, _ = self.transport.address.rpartition(":")
        now = self._accounting.now
        self.broker.rate_limited_log.warning(
            log, now, (host, message), message, *args, burst=HOST_BURST
        )

    def lost(self) -> None:
        """The connection ended without a DISCONNECT."""
        if not self._closed:
            if self.session is not None:
                log.info("%s: connection lost", self)
            self._leave("connection lost", publish_will=True)
        else:
            self._make_sure()

    def let_go(self, transport: Transport) -> None:
        """Release the closed connection: `transport` replaces it."""
        self.transport = self.output.transport = transport

    def tick(self, now: float) -> bool:
        """Disconnect a client that was silent for one and a half times its keep alive."""
        if self._behind:
            self._last_packet_at = now  # it is not read while a message waits
        if (
            not self._keep_alive_timeout
            or self._is_awaiting
            or now - self._last_packet_at <= self._keep_alive_timeout
        ):
            return False
        self.close(ReasonCode.KEEP_ALIVE_TIMEOUT, f"silent for {now - self._last_packet_at:.0f} s")
        return True

    def _leave(self, why: str, *, publish_will: bool, expiry: int | None = None) -> None:
        session, audit_log = self.session, self.broker.audit_log
        try:
            self._shut()
            if session is not None and audit_log is not None:
                audit_log.disconnected(session, self.transport.address, why)
        finally:
            if session is not None:
                self.broker.disconnect(
                    session, self.output, publish_will=publish_will, expiry=expiry
                )

    def _shut(self) -> None:
        """Process no further input, and free what is held; may be called twice."""
        self._closed = True
        self._work = None
        try:
            self._accounting.take(self.account, -self._held)
            self._accounting.input_bytes -= self._held
            self._held = 0
            self.broker.clients.discard(self)
            self._allowance.stop_waiting(self)
            self.broker.disk.forget(self)
            self._behind.clear()
            self._behind_size = 0
            self.protocol.close()
        finally:  # without it the peer would be disconnected only after a timeout
            self.output.end()
