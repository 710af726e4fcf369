"""One connection to a fleet's broker, from CONNECT to DISCONNECT: no I/O, and time is an argument.

`FleetConnection` is given what the network receives and the time, and returns events; what it sends
is collected until the owner takes it, once a round of its loop. All limits of CONNACK are in
`Granted`, and hold for what is published and subscribed. How the connection ended is in `ended`.

Messages go out with QoS 0 or 1. The owner waits for nothing else than `Acknowledged`, which has its
own tokens: packet identifiers do not leave this module on the way out. On the way in `Arrived` has
one, for `acknowledge`, which answers in the order of arrival whatever the order of the calls.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Generic, TypeVar, cast

from appliance.mqtt.client_protocol import ClientProtocol, read_topic
from appliance.mqtt.codec import (
    MAX_LENGTH,
    MAX_VARINT,
    NO_PROPERTIES,
    V5,
    V311,
    Properties,
    Property,
    encode_string,
    encode_varint,
    quote,
)
from appliance.mqtt.framing import PUBACK, PUBREC, PUBREL, RawPublish
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    UnusablePublish,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode
from appliance.mqtt.topics import parse_shared
from appliance.upstream.agreement import (
    LONGEST_REASON,
    ConnectSettings,
    EndedBy,
    Ending,
    Granted,
    granted_by,
    reason_string,
)
from appliance.upstream.late import Freshness
from appliance.upstream.link_events import (
    Acknowledged,
    Arrived,
    Challenged,
    FleetEvent,
    Opened,
    Reauthenticated,
    Subscribed,
    Unsubscribed,
)
from appliance.upstream.receipts import Receipts
from appliance.upstream.refusals import reason_words

T = TypeVar("T")
U = TypeVar("U")

#: Seconds that the broker may take to answer CONNECT, PUBLISH, SUBSCRIBE and AUTH, and to accept
#: any bytes at all. They count from when the packet has left.
PATIENCE: Final = 30.0

#: The part of the keep alive after which a quiet connection is checked, and the part that the
#: answer may take: together less than the 1.5 after which the broker would close it.
PING_AFTER: Final = 0.9
ANSWER_WITHIN: Final = 0.5

#: A call of `tick` that comes later than due, in seconds, says that this process was held up: the
#: answers may be waiting to be read.
LATE_TICK: Final = 1.0

#: PINGREQs without an answer, at most.
MAXIMUM_PINGS: Final = 1000

#: Entries of each table of encoded topics and headers; a full one is emptied. Longer topics, in
#: bytes, are not in them.
CACHED: Final = 1024
LONGEST_CACHED: Final = 256

#: Bytes of a SUBSCRIBE beside its filters: header, packet identifier, subscription identifier.
_PACKET_ROOM: Final = 16

#: The largest SUBSCRIBE, in bytes, of more than one filter.
_LARGEST_BATCH: Final = 65_535

_MAX_ID: Final = 65_535

#: The packet type in an event of an acknowledgement.
_TYPE: Final = 0xFF0000

_PINGREQ: Final = Pingreq().encode(V5)


class _Round:
    """What was taken together: when, and the bytes of the connection up to its end."""

    __slots__ = ("at", "end")

    def __init__(self) -> None:
        self.at = math.inf
        self.end = math.inf


@dataclass(slots=True)
class _Request:
    """A SUBSCRIBE or UNSUBSCRIBE that is not answered yet."""

    subscriptions: Sequence[Subscription]
    filters: Sequence[str]
    round: _Round


class FleetConnection(Generic[T]):
    """One connection to a fleet's broker; `T` is the type of the owner's tokens for its messages.

    The owner calls `start`, then `receive` and `tick`, and writes what `take` returns once a round.
    After each of them it looks at `ended`; then it writes the rest and closes the transport.
    """

    def __init__(self, settings: ConnectSettings) -> None:
        self.settings = settings
        #: Set by CONNACK.
        self.granted: Granted | None = None
        self.ended: Ending | None = None
        #: Seconds from the sending of the last answered PINGREQ to its answer.
        self.round_trip: float | None = None
        #: After which time what arrives now has left the broker.
        self._freshness = Freshness()
        connect = settings.connect()
        self._connect = connect
        self._protocol = ClientProtocol(
            connect, settings.maximum_packet_size, settings.user_properties
        )
        self._is_v5 = settings.version == V5
        self._version = V5 if self._is_v5 else V311
        # What is granted, as `publish` needs it.
        self._window = 0
        self._maximum_packet_size = 1 + 4 + MAX_VARINT
        self._maximum_body = MAX_VARINT
        self._forbidden = 0  # bits of the first byte
        self._topics: dict[str, bytes] = {}
        self._headers: dict[int, bytes] = {}
        self._heard: dict[bytes, str] = {}
        self._last_id = 0
        self._inflight: dict[int, tuple[T, _Round]] = {}
        self._requests: dict[int, _Request] = {}
        self._pings: deque[_Round] = deque()
        self._connecting = self._authenticating = _Round()
        self._receipts = Receipts(settings.receive_maximum if self._is_v5 else None)
        self._out: list[bytes] = []
        self._out_size = 0
        self._round = self._connecting
        #: Bytes that were taken, and of these the ones that the network has taken.
        self._taken = 0
        self._left = 0
        # Times: of the last bytes sent and received, of progress on the network, of the last late
        # tick, of the last tick at which the oldest packet without an answer had not left, and of
        # the last one at which the owner was not reading.
        self._sent_at = self._received_at = self._left_at = -math.inf
        self._held_up_at = self._blocked_at = self._unread_at = -math.inf
        self._due = math.inf

    def __str__(self) -> str:
        return f"connection as {quote(self.settings.client_id)}"

    # --- what the owner asks -------------------------------------------------------------------

    @property
    def not_before(self) -> float:
        """No message of QoS 0 that arrives now left the broker before this time: when the last
        answered PINGREQ, or CONNECT, was sent. See `Freshness` for QoS 1."""
        return self._freshness.left_after(0)

    @property
    def window(self) -> int:
        """Messages of QoS 1 that may be in flight; 0 before CONNACK and after the end."""
        return self._window

    @property
    def room(self) -> int:
        """Messages of QoS 1 that may be sent now."""
        return max(0, self._window - len(self._inflight))

    @property
    def inflight(self) -> int:
        """Messages that are sent and not acknowledged."""
        return len(self._inflight)

    @property
    def unacknowledged(self) -> int:
        """Received messages that wait for `acknowledge`, or for the broker's PUBREL."""
        return len(self._receipts)

    @property
    def waiting(self) -> int:
        """Bytes that wait for `take`."""
        return self._out_size

    @property
    def held(self) -> int:
        """Bytes of memory: unparsed input, topic aliases, and what waits for `take`."""
        return self._protocol.held + self._out_size

    def unsettled(self) -> list[T]:
        """The tokens of the messages that are sent and not acknowledged, in their order."""
        return [token for token, _ in self._inflight.values()]

    # --- what the owner does -------------------------------------------------------------------

    def start(self, now: float) -> None:
        """Send CONNECT. Raises ValueError for settings that it cannot express."""
        data = self._connect.encode()
        self._received_at = self._left_at = now
        self._send(data)

    def take(self, now: float) -> list[bytes]:
        """What is to be written now, in order."""
        out = self._out
        if not out:
            return out
        self._taken += self._out_size
        self._round.at = self._sent_at = now
        self._round.end = float(self._taken)
        self._round = _Round()
        self._out = []
        self._out_size = 0
        return out

    def publish(
        self,
        token: T,
        topic: str,
        payload: bytes,
        qos: int = 1,
        retain: bool = False,
        properties: bytes = NO_PROPERTIES,
    ) -> int:
        """Send a message; 0, or the reason code why this broker cannot be sent it.

        `properties` are encoded, with their length. The token of a QoS 1 message comes back in
        `Acknowledged`. Without `room` for a QoS 1 message it is Receive Maximum exceeded.

        Raises:
            ValueError: the topic cannot be encoded, or the QoS is neither 0 nor 1.
        """
        if qos not in (0, 1):
            raise ValueError(f"nothing is sent with QoS {qos}")
        wire = self._topics.get(topic)
        if wire is None:
            wire = self._encode_topic(topic)
        first = 0x30 | qos << 1 | retain
        size = len(wire) + len(payload) + (qos << 1)
        if self._is_v5:
            size += len(properties)
        if first & self._forbidden or size > self._maximum_body:
            return self._refusal(first, size)
        header = self._headers.get(first << 28 | size)
        if header is None:
            header = self._encode_header(first, size)
        out = self._out
        if qos:
            inflight = self._inflight
            if len(inflight) >= self._window:
                return ReasonCode.RECEIVE_MAXIMUM_EXCEEDED  # [MQTT-3.3.4-7]
            packet_id = self._last_id + 1
            if packet_id > _MAX_ID or packet_id in inflight or packet_id in self._requests:
                packet_id = self._free_id()
            self._last_id = packet_id
            inflight[packet_id] = (token, self._round)
            if self._is_v5:
                out += (header, wire, packet_id.to_bytes(2, "big"), properties, payload)
            else:
                out += (header, wire, packet_id.to_bytes(2, "big"), payload)
        elif self.granted is None or self.ended is not None:
            return ReasonCode.RECEIVE_MAXIMUM_EXCEEDED
        elif self._is_v5:
            out += (header, wire, properties, payload)
        else:
            out += (header, wire, payload)
        self._out_size += len(header) + size
        return 0

    def acknowledge(self, packet_id: int, code: int = 0) -> None:
        """Acknowledge a received message; the answers leave in the order of arrival.

        Nothing is sent after the end. 3.1.1 has no reason codes.

        Raises:
            ValueError: no message with this identifier waits for it, or PUBACK has no such code.
        """
        if self.ended is not None:
            return
        for first, arrived_id, found in self._receipts.acknowledge(packet_id, code):
            self._freshness.message_acknowledged()
            self._answer(first, arrived_id, found)

    def subscribe(self, subscriptions: Iterable[Subscription]) -> list[tuple[Subscription, int]]:
        """Subscribe; returns those that this broker cannot be asked for, with a reason code each.

        The answers to the others come in `Subscribed`. A packet has as many filters as it may,
        all with the same subscription identifier. The topic filters are not checked here.
        """
        refused: list[tuple[Subscription, int]] = []
        accepted: list[tuple[Subscription, int, int]] = []
        for subscription in subscriptions:
            size = len(subscription.filter.encode()) + 3
            code = self._subscription_refusal(subscription, size)
            if code:
                refused.append((subscription, code))
            else:
                accepted.append((subscription, size, subscription.identifier))
        for batch in self._batches(accepted):
            packet_id = self._request_id()
            self._requests[packet_id] = _Request(batch, (), self._round)
            identifier = batch[0].identifier
            properties: Properties | None = None
            if identifier:
                properties = {Property.SUBSCRIPTION_IDENTIFIER: [identifier]}
            self._send(Subscribe(packet_id, batch, properties).encode(self._version))
        return refused

    def unsubscribe(self, filters: Iterable[str]) -> None:
        """End subscriptions; the answers come in `Unsubscribed`."""
        if self.ended is not None or self.granted is None:
            return
        for batch in self._batches([(each, len(each.encode()) + 2, 0) for each in filters]):
            packet_id = self._request_id()
            self._requests[packet_id] = _Request((), batch, self._round)
            self._send(Unsubscribe(packet_id, batch).encode(self._version))

    def ping(self) -> None:
        """Send a PINGREQ, beside those that the keep alive needs; they bound `not_before`."""
        if self.ended is None and self.granted is not None and len(self._pings) < MAXIMUM_PINGS:
            self._pings.append(self._round)
            self._freshness.ping_sent()
            self._send(_PINGREQ)

    def woke(self, now: float) -> None:
        """The computer has slept: until a new PINGREQ is answered, all that comes may be old."""
        self._freshness.woke(now)
        self.ping()

    def answer(self, data: bytes | None) -> None:
        """Answer `Challenged` (5.0 section 4.12) [MQTT-4.12.0-3]."""
        self._authenticate(ReasonCode.CONTINUE_AUTHENTICATION, data)

    def reauthenticate(self, data: bytes | None) -> None:
        """Authenticate again with the method of CONNECT (5.0 section 4.12.1).

        Raises:
            ValueError: CONNECT had no method, or an earlier one is not answered yet.
        """
        if self.settings.method is None or not self._is_v5 or self._protocol.reauthenticating:
            raise ValueError("no authentication method, or it is under way")
        if self.ended is None and self.granted is not None:
            self._protocol.reauthenticating = True
            self._authenticate(ReasonCode.RE_AUTHENTICATE, data)

    def close(self, code: ReasonCode = ReasonCode.SUCCESS, text: str = "closed") -> None:
        """End the connection with DISCONNECT; a code other than 0x00 makes the will due.

        In 3.1.1 every DISCONNECT removes the will, so only 0x00 is sent.
        """
        self._end(Ending(EndedBy.US, code, text, self.granted is None), notify=True)

    def lost(self, text: str, *, is_close: bool = False) -> None:
        """The network has ended the connection; `is_close` if the other end has closed it (FIN)."""
        if self.ended is None and self._protocol.unfinished:
            text += ", inside a packet"
            is_close = False
        code = ReasonCode.UNSPECIFIED_ERROR
        ending = Ending(EndedBy.NETWORK, code, text, is_new=self.granted is None, is_close=is_close)
        self._end(ending, notify=False)

    # --- what comes ----------------------------------------------------------------------------

    def receive(self, data: bytes, now: float) -> list[FleetEvent[T]]:
        """The events of received bytes. Wrong bytes end the connection, with what came before."""
        events: list[FleetEvent[T]] = []
        if self.ended is not None:
            return events
        self._received_at = now
        inflight = self._inflight
        tokens: list[T] = []
        last = -1  # the acknowledgement that `tokens` belongs to
        try:
            packet_ids, code, data = self._protocol.take_pubacks(data)
            if packet_ids:
                last = code
                events.append(Acknowledged(tokens, last))
                for packet_id in packet_ids:
                    entry = inflight.pop(packet_id, None)
                    if entry is None:
                        raise _unknown("PUBACK", packet_id)
                    tokens.append(entry[0])
            for event in self._protocol.receive_data(data):
                if isinstance(event, int):
                    if event & _TYPE == PUBACK:
                        entry = inflight.pop(event & 0xFFFF, None)
                        if entry is None:
                            raise _unknown("PUBACK", event & 0xFFFF)
                        if event >> 24 != last:
                            last = event >> 24
                            tokens = []
                            events.append(Acknowledged(tokens, last))
                        tokens.append(entry[0])
                    else:
                        self._on_acknowledgement(event)
                    continue
                last = -1
                if isinstance(event, tuple):
                    arrived = self._on_raw_publish(event)
                    if arrived is not None:
                        events.append(arrived)
                else:
                    self._on_packet(event, now, events)
                    if self._has_ended():
                        break
        except ProtocolError as error:
            self._fail(error.code, str(error))
        return events

    def tick(self, now: float, unsent: int = 0, *, is_reading: bool = True) -> float:
        """Send a PINGREQ if one is due, or end a connection that is silent; when it is due next.

        `unsent` are the taken bytes that the network has not taken yet. While the owner is not
        reading, for reasons of its own, no answer of the broker's is missed. It is also to be
        called after a `take` that returned something: what was sent has deadlines of its own.
        """
        if self.ended is not None or not (self._taken or self._out):
            return math.inf
        if now > self._due + LATE_TICK:
            self._held_up_at = now
        if not is_reading:
            self._unread_at = now
        left = self._taken - unsent
        if left != self._left or not unsent:
            self._left, self._left_at = left, now
        due = self._patience(now)
        if not self._has_ended():
            due = min(due, self._keep_alive(now))
        self._due = math.inf if self._has_ended() else due
        return self._due

    def _patience(self, now: float) -> float:
        """End a connection on which something has no answer; when that would be next."""
        due = math.inf
        if self._left < self._taken:
            due = max(self._left_at, self._held_up_at) + PATIENCE
            if due <= now:
                self._give_up(f"the broker has read nothing for {PATIENCE:.0f} s")
                return due
        for what, waiting in self._oldest():
            deadline = self._since(waiting, now) + PATIENCE
            if deadline <= now:
                self._give_up(f"no {what} within {PATIENCE:.0f} s")
                return deadline
            due = min(due, deadline)
        return due

    def _oldest(self) -> Iterable[tuple[str, _Round]]:
        """The oldest of each kind of packet that the broker has to answer."""
        if self.granted is None:
            yield "CONNACK", self._connecting
        elif self._protocol.reauthenticating:
            yield "AUTH", self._authenticating
        if self._inflight:
            yield "PUBACK", next(iter(self._inflight.values()))[1]
        if self._requests:
            request = next(iter(self._requests.values()))
            yield "SUBACK" if request.subscriptions else "UNSUBACK", request.round

    def _since(self, waiting: _Round, now: float) -> float:
        """When the broker could have begun to answer what was taken in that round."""
        if waiting.end > self._left:
            self._blocked_at = now
            return now
        return max(waiting.at, self._blocked_at, self._held_up_at, self._unread_at)

    def _keep_alive(self, now: float) -> float:
        """Send a PINGREQ if one is due, or end a silent connection; when that would be next."""
        granted = self.granted
        if granted is None:
            return math.inf
        # [MQTT-3.1.2-20]; without a keep alive of the broker's it is still checked.
        interval = granted.keep_alive or self.settings.keep_alive
        if not interval:
            return math.inf
        due = math.inf if self._out else self._sent_at + interval * PING_AFTER
        if not self._pings:
            due = min(due, self._received_at + interval * PING_AFTER)
        if due <= now:
            self.ping()
            due = now + interval * PING_AFTER
        if not self._pings:
            return due
        since = self._since(self._pings[0], now)
        deadline = max(since, self._received_at) + interval * ANSWER_WITHIN
        # They may all have waited behind one large message.
        is_full = len(self._pings) >= MAXIMUM_PINGS and since + PATIENCE <= now
        if deadline <= now or is_full:
            self._give_up(f"no PINGRESP, and silent for {now - self._received_at:.1f} s")
        return min(due, deadline)

    # --- received packets ----------------------------------------------------------------------

    def _on_packet(self, packet: Packet, now: float, events: list[FleetEvent[T]]) -> None:
        if isinstance(packet, Publish):
            arrived = self._on_publish(packet)
            if arrived is not None:
                events.append(arrived)
        elif isinstance(packet, Puback):
            entry = self._inflight.pop(packet.packet_id, None)
            if entry is None:
                raise _unknown("PUBACK", packet.packet_id)
            reason = reason_string(packet.properties)
            events.append(Acknowledged([entry[0]], packet.reason_code, reason))
        elif isinstance(packet, Pubrec | Pubrel | Pubcomp):
            self._on_acknowledgement(packet.TYPE << 16 | packet.packet_id)
        elif isinstance(packet, Pingresp):
            self._on_pingresp(now)
        elif isinstance(packet, Suback):
            events.append(self._on_suback(packet))
        elif isinstance(packet, Unsuback):
            events.append(self._on_unsuback(packet))
        elif isinstance(packet, Connack):
            self._on_connack(packet, events)
        elif isinstance(packet, Auth):
            self._on_auth(packet, events)
        elif isinstance(packet, Disconnect):
            self._on_disconnect(packet)

    def _on_connack(self, packet: Connack, events: list[FleetEvent[T]]) -> None:
        if self._connecting.at == math.inf:
            raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "a CONNACK before CONNECT")
        properties = packet.properties or {}
        if packet.reason_code:
            self._refused("refuses the connection", packet.reason_code, properties, refused=True)
            return
        granted = self.granted = granted_by(self.settings, packet)
        if not packet.session_present:
            self._freshness.session_began(self._connecting.at)
        self._window = granted.window
        if granted.maximum_packet_size is not None:
            self._maximum_packet_size = granted.maximum_packet_size
            self._maximum_body = _largest_body(granted.maximum_packet_size)
        self._forbidden = 0 if granted.retain else 0x01
        if not granted.maximum_qos:
            self._forbidden |= 0x06
        events.append(Opened(granted))

    def _on_auth(self, packet: Auth, events: list[FleetEvent[T]]) -> None:
        properties = packet.properties or {}
        data = cast("bytes | None", properties.get(Property.AUTHENTICATION_DATA))
        if packet.reason_code == ReasonCode.SUCCESS:
            events.append(Reauthenticated(data))
        else:
            events.append(Challenged(data, reason_string(properties)))

    def _on_disconnect(self, packet: Disconnect) -> None:
        self._refused("disconnects", packet.reason_code, packet.properties or {}, refused=False)

    def _refused(self, what: str, code: int, properties: Properties, *, refused: bool) -> None:
        """The broker has ended the connection with a reason."""
        text = f"the broker {what}: {reason_words(code, self._version)}"
        reason = reason_string(properties)
        if reason:
            text += f", {quote(reason)}"
        reference = cast("str | None", properties.get(Property.SERVER_REFERENCE))
        if reference is not None:
            text += f", go to {quote(reference)}"
        self._end(
            Ending(
                EndedBy.BROKER,
                ReasonCode(code),
                text,
                self.granted is None,
                refused,
                reference,
            ),
            notify=False,
        )

    def _on_pingresp(self, now: float) -> None:
        if not self._pings or self._pings[0].at == math.inf:
            raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "a PINGRESP without a PINGREQ")
        sent_at = self._pings.popleft().at
        self.round_trip = now - sent_at
        self._freshness.ping_answered(sent_at)

    def _on_suback(self, packet: Suback) -> Subscribed:
        request = self._requests.pop(packet.packet_id, None)
        if request is None or not request.subscriptions:
            raise _unknown("SUBACK", packet.packet_id)
        subscriptions, codes = request.subscriptions, packet.reason_codes
        if len(codes) != len(subscriptions):  # [MQTT-3.8.4-5] v5 [MQTT-3.8.4-6]
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR,
                f"a SUBACK with {len(codes)} reason codes for {len(subscriptions)} filters",
            )
        complete = not any(request.subscriptions for request in self._requests.values())
        results = list(zip(subscriptions, map(int, codes), strict=True))
        return Subscribed(results, complete, reason_string(packet.properties))

    def _on_unsuback(self, packet: Unsuback) -> Unsubscribed:
        request = self._requests.pop(packet.packet_id, None)
        if request is None or not request.filters:
            raise _unknown("UNSUBACK", packet.packet_id)
        codes: Sequence[int] = packet.reason_codes if self._is_v5 else [0] * len(request.filters)
        if len(codes) != len(request.filters):  # v5 [MQTT-3.11.3-1]
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR,
                f"an UNSUBACK with {len(codes)} reason codes for {len(request.filters)} filters",
            )
        results = list(zip(request.filters, map(int, codes), strict=True))
        return Unsubscribed(results, reason_string(packet.properties))

    def _on_acknowledgement(self, event: int) -> None:
        """PUBREL; no message leaves with QoS 2, so PUBREC and PUBCOMP are errors."""
        packet_id = event & 0xFFFF
        if event & _TYPE != PUBREL:
            raise _unknown("PUBREC" if event & _TYPE == PUBREC else "PUBCOMP", packet_id)
        self._answer(0x70, packet_id, self._receipts.release(packet_id))

    def _on_raw_publish(self, publish: RawPublish) -> Arrived | None:
        first, topic_wire, packet_id, payload, _ = publish
        topic = self._heard.get(topic_wire)
        flaw = ""
        if topic is None:
            topic, flaw = read_topic(topic_wire, self._version)
            if len(self._heard) >= CACHED:
                self._heard.clear()
            if len(topic_wire) <= LONGEST_CACHED and not flaw:
                self._heard[topic_wire] = topic
        qos = first >> 1 & 3
        dup = first >= 0x38
        not_before = self._freshness.left_after(qos)
        if qos and not self._expects(packet_id, qos, dup):
            return None
        return Arrived(
            topic,
            payload,
            qos,
            bool(first & 1),
            dup,
            packet_id,
            None,
            NO_PROPERTIES,
            not_before,
            flaw,
        )

    def _on_publish(self, packet: Publish) -> Arrived | None:
        packet_id = packet.packet_id or 0
        not_before = self._freshness.left_after(packet.qos)
        if packet.qos and not self._expects(packet_id, packet.qos, packet.dup):
            return None
        return Arrived(
            packet.topic,
            packet.payload,
            packet.qos,
            packet.retain,
            packet.dup,
            packet_id,
            packet.properties or None,
            packet.passed_on,
            not_before,
            packet.flaw if isinstance(packet, UnusablePublish) else "",
        )

    def _expects(self, packet_id: int, qos: int, dup: bool) -> bool:
        """Note a QoS 1 or 2 message; False if it was received on this connection before."""
        is_new = self._receipts.expects(packet_id, qos, dup)
        if is_new:
            self._freshness.message_received()
        elif self._receipts.is_unreleased(packet_id):
            self._answer(0x50, packet_id, ReasonCode.SUCCESS)
        return is_new

    # --- what is sent --------------------------------------------------------------------------

    def _send(self, data: bytes) -> None:
        self._out.append(data)
        self._out_size += len(data)

    def _answer(self, first: int, packet_id: int, code: int) -> None:
        """Send PUBACK, PUBREC or PUBCOMP in its shortest form."""
        if code and self._is_v5:
            self._send(bytes((first, 3, packet_id >> 8, packet_id & 0xFF, code)))
        else:
            self._send(bytes((first, 2, packet_id >> 8, packet_id & 0xFF)))

    def _authenticate(self, code: ReasonCode, data: bytes | None) -> None:
        if self.settings.method is None or not self._is_v5:
            raise ValueError("CONNECT has no authentication method")  # [MQTT-4.12.0-7]
        if self.ended is not None:
            return
        properties: Properties = {Property.AUTHENTICATION_METHOD: self.settings.method}
        if data is not None:
            properties[Property.AUTHENTICATION_DATA] = data
        self._authenticating = self._round
        self._send(Auth(code, properties).encode(V5))

    def _batches(self, items: list[tuple[U, int, int]]) -> Iterable[list[U]]:
        """What goes into one packet each of items with their size in bytes and identifier."""
        limit = min(self._maximum_packet_size, _LARGEST_BATCH) - _PACKET_ROOM
        batch: list[U] = []
        total = current = 0
        for item, size, identifier in items:
            if batch and (
                len(batch) >= self.settings.filters_per_packet
                or total + size > limit
                or identifier != current
            ):
                yield batch
                batch, total = [], 0
            batch.append(item)
            total += size
            current = identifier
        if batch:
            yield batch

    def _subscription_refusal(self, subscription: Subscription, size: int) -> int:
        """Why this broker cannot be asked for a subscription of `size` bytes; 0 if it can."""
        granted = self.granted
        if granted is None or self.ended is not None:
            return ReasonCode.UNSPECIFIED_ERROR
        topic_filter = subscription.filter
        if size + _PACKET_ROOM > self._maximum_packet_size or size > MAX_LENGTH + 3:
            return ReasonCode.PACKET_TOO_LARGE  # [MQTT-3.2.2-15]
        try:
            is_shared = parse_shared(topic_filter) is not None
        except ValueError:
            return ReasonCode.TOPIC_FILTER_INVALID
        if is_shared and not granted.shared:
            return ReasonCode.SHARED_SUBSCRIPTIONS_NOT_SUPPORTED
        if not granted.wildcards and ("+" in topic_filter or "#" in topic_filter):
            return ReasonCode.WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED
        if subscription.identifier and not granted.identifiers:
            return ReasonCode.SUBSCRIPTION_IDENTIFIERS_NOT_SUPPORTED
        return 0

    def _refusal(self, first: int, size: int) -> int:
        """Why a PUBLISH with `size` bytes after the header cannot be sent; 0 if it can."""
        granted = self.granted
        if granted is None:
            return ReasonCode.RECEIVE_MAXIMUM_EXCEEDED
        if not granted.retain and first & 0x01:  # [MQTT-3.2.2-14]
            return ReasonCode.RETAIN_NOT_SUPPORTED
        if first >> 1 & 3 > granted.maximum_qos:  # [MQTT-3.2.2-11]
            return ReasonCode.QOS_NOT_SUPPORTED
        return ReasonCode.PACKET_TOO_LARGE  # [MQTT-3.2.2-15]

    def _encode_topic(self, topic: str) -> bytes:
        wire = encode_string(topic)
        if len(self._topics) >= CACHED:
            self._topics.clear()
        if len(wire) <= LONGEST_CACHED:
            self._topics[topic] = wire
        return wire

    def _encode_header(self, first: int, size: int) -> bytes:
        header = bytes((first,)) + encode_varint(size)
        if len(self._headers) >= CACHED:
            self._headers.clear()
        self._headers[first << 28 | size] = header
        return header

    def _request_id(self) -> int:
        packet_id = self._last_id = self._free_id()
        return packet_id

    def _free_id(self) -> int:
        """The next packet identifier that is not in use (section 2.3.1; 5.0 section 2.2.1)."""
        packet_id = self._last_id % _MAX_ID + 1
        while packet_id in self._inflight or packet_id in self._requests:
            packet_id = packet_id % _MAX_ID + 1
        return packet_id

    # --- the end -------------------------------------------------------------------------------

    def _fail(self, code: ReasonCode, text: str) -> None:
        """The broker has violated the protocol (5.0 section 4.13)."""
        ending = Ending(EndedBy.US, code, text, self.granted is None, is_violation=True)
        self._end(ending, notify=True)

    def _give_up(self, text: str) -> None:
        """The broker does not answer. No DISCONNECT: nobody reads it, and the will is due."""
        code = ReasonCode.UNSPECIFIED_ERROR
        ending = Ending(EndedBy.NETWORK, code, text, self.granted is None, is_silent=True)
        self._end(ending, notify=False)

    def _has_ended(self) -> bool:
        """Asked after a call that may end it: mypyc takes what was known of `ended` before the call
        for certain."""
        return self.ended is not None

    def _end(self, ending: Ending, *, notify: bool) -> None:
        if self.ended is not None:
            return
        self.ended = ending
        self._window = 0
        self._protocol.close()
        if not notify or not (self._taken or self._out):
            return
        if not self._is_v5:
            # Only after a normal end: DISCONNECT would remove the will [MQTT-3.14.4-3].
            if ending.code == ReasonCode.NORMAL_DISCONNECTION:
                self._send(Disconnect().encode(V311))
            return
        packet = Disconnect(ending.code)
        if ending.code >= 0x80:
            text = ending.text.encode(errors="replace").decode().replace("\0", "")
            packet.properties = {Property.REASON_STRING: text[:LONGEST_REASON]}
        data = packet.encode(V5)
        if len(data) > self._maximum_packet_size:  # [MQTT-3.14.2-3]
            data = Disconnect(ending.code).encode(V5)
        self._send(data)


def _largest_body(packet_size: int) -> int:
    """The largest Remaining Length, in bytes, of a packet of at most that size."""
    return max(min(packet_size - 1 - digits, (1 << 7 * digits) - 1) for digits in range(1, 5))


def _unknown(packet: str, packet_id: int) -> ProtocolError:
    return ProtocolError(
        ReasonCode.PROTOCOL_ERROR, f"a {packet} for {packet_id}, which nothing waits for"
    )
