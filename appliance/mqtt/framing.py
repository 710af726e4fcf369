"""What both sides of an MQTT connection share: framing, the data path, size limits, topic aliases.

`PacketFramer` takes received bytes and yields events; `ServerProtocol` (connection.py) and
`ClientProtocol` (client_protocol.py) say which packets their peer may send when. It does no I/O
and has no clock. There are three kinds of event:

* a `Packet`, decoded;
* a `RawPublish`, a PUBLISH without properties that is taken apart but not wrapped: the data path;
* an `int`, ``type << 16 | packet id``: an acknowledgement without reason code or properties.

The two short forms save creating an object and a property table for each message. They are used
only where properties and reason code are absent; `tests/mqtt/test_connection.py` compares them with
the full decoder.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import Enum
from typing import Final, TypeAlias

from appliance.mqtt.codec import PacketType, Property, decode_varint, text_size
from appliance.mqtt.packets import Packet, Publish, decode_packet
from appliance.mqtt.reason import ContentError, ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic

#: header byte, topic with its two length bytes, packet id (0 for QoS 0), payload,
#: and the bytes from the header to the end of the topic (QoS 0: to the end of the packet).
RawPublish: TypeAlias = tuple[int, bytes, int, bytes, bytes]
Event: TypeAlias = "Packet | RawPublish | int"

#: The largest packets other than PUBLISH, in bytes. A CONNECT is not authenticated yet: there is
#: room for a will and some properties, as in mosquitto. Other packets are long lists of filters:
#: thousands are accepted, but not millions, which would make all other clients wait.
MAXIMUM_CONNECT = 100_000
MAXIMUM_CONTROL = 384 * 1024

#: The limit of User Properties in a packet before the login.
UNAUTHENTICATED_PAIRS = 64

#: The default limit of User Properties in a packet after the login.
DEFAULT_PAIRS = 1000

PUBACK: Final = 4 << 16
PUBREC: Final = 5 << 16
PUBREL: Final = 6 << 16
PUBCOMP: Final = 7 << 16


#: A buffered chunk below this size, in bytes, is joined with the next one immediately.
SMALL_CHUNK: Final = 4096

#: A PUBLISH of at least this size, in bytes, is not joined before its payload is cut out.
LARGE_PACKET: Final = 16 * 1024

#: The memory of a topic alias beside its topic, in bytes.
ALIAS_SIZE = 150

#: The size of an empty User Property, in bytes.
SHORTEST_PAIR = 5

# The index of the properties in the body of a packet other than PUBLISH; CONNECT has properties in
# two places.
_PROPERTIES_AT: dict[int, int] = {
    PacketType.PUBACK: 3,
    PacketType.PUBREC: 3,
    PacketType.PUBREL: 3,
    PacketType.PUBCOMP: 3,
    PacketType.SUBSCRIBE: 2,
    PacketType.UNSUBSCRIBE: 2,
    PacketType.DISCONNECT: 1,
    PacketType.AUTH: 1,
}


class State(Enum):
    """Where a connection is in its life."""

    NEW = "before CONNECT"
    AUTHENTICATING = "before CONNACK"
    CONNECTED = "after CONNACK"
    CLOSED = "after the end"


class PacketFramer:
    """The receiving half of one MQTT connection, without I/O: bytes in, events out.

    `maximum_packet_size` is the limit of a whole packet, in bytes, once the connection is open;
    `topic_alias_maximum` is the value that the peer was told; `user_properties` is the limit of
    User Properties in a packet once the connection is open. These are not decoded here.
    `with_identifiers` says whether the peer may send Subscription Identifiers in PUBLISH.
    """

    def __init__(
        self,
        state: State,
        maximum_packet_size: int,
        topic_alias_maximum: int,
        user_properties: int,
        *,
        with_identifiers: bool,
    ) -> None:
        self.maximum_packet_size = maximum_packet_size
        self.topic_alias_maximum = topic_alias_maximum
        self.user_properties = user_properties
        #: The cost of checking the properties of the last `Packet`, see `Counters.cost`.
        self.cost = 0
        self.state = state
        self.version = 0
        self._with_identifiers = with_identifiers
        #: False while no event may be yielded: while paused, and when closed.
        self._reading = True
        #: Received, unparsed bytes; the chunks are joined when `_need` bytes have arrived.
        self._chunks: list[bytes] = []
        self._have = 0
        self._need = 0
        self._aliases: dict[int, str] = {}
        #: Bytes of a CONNECT whose login is not finished.
        self._connecting = 0
        #: Bytes of memory of the topic aliases.
        self._aliased = 0
        #: The last PUBLISH of the data path: its bytes from the header to the end of the topic, and
        #: their decoded values. Most peers repeat topic and size: comparing these bytes then
        #: saves parsing them again.
        self._head_first = -1
        self._head = b""
        self._head_topic = b""
        self._head_size = 0

    @property
    def held(self) -> int:
        """Bytes of memory: unparsed input, a CONNECT until the end of its login, and aliases."""
        return self._have + self._connecting + self._aliased

    @property
    def unfinished(self) -> bool:
        """Whether the buffered bytes are exactly one partial packet."""
        return self._have > 0 and self._reading

    @property
    def has_unparsed(self) -> bool:
        """Whether bytes are buffered that no event has been made of."""
        return self._have > 0

    @property
    def paused(self) -> bool:
        """Whether input is buffered until `accept` or `resume`."""
        return not self._reading and self.state is not State.CLOSED

    def pause(self) -> None:
        """Buffer all input until `accept` or `resume`."""
        self._reading = False

    def resume(self) -> None:
        """Continue; `receive_data(b"")` yields the events of the buffered input."""
        self._reading = True

    def close(self) -> None:
        """Yield no further events, and free all buffers."""
        self.state = State.CLOSED
        self._reading = False
        self._chunks.clear()
        self._have = 0
        self._aliases.clear()
        self._aliased = self._connecting = 0

    def receive_data(self, data: bytes) -> Iterable[Event]:
        """The events that `data` completes, together with the bytes before it.

        It is parsed during the iteration, so that a change by one packet (refused, paused, closed)
        applies to the next; the iteration must not be abandoned.

        Raises:
            ProtocolError: the bytes or their order are wrong; the connection is closed.
        """
        # A chunk that is one acknowledgement, or one PUBLISH like the last, needs no generator: for
        # clients that send one packet at a time that would be a fifth of the cost.
        size = len(data)
        if size >= 4 and not self._have and self._reading and self.state is State.CONNECTED:
            first = data[0]
            # The numbers are here and not in a set: compiled they are compared, not looked up.
            if size == 4 and data[1] == 2 and first in (0x40, 0x50, 0x62, 0x70):
                if data[2] or data[3]:
                    return (first >> 4 << 16 | data[2] << 8 | data[3],)
            elif size == self._head_size and data.startswith(self._head):
                event = self._repeated(data, 0, size)
                if event is not None:
                    return (event,)
        return self._parse(data)

    def _parse(self, data: bytes) -> Iterator[Event]:
        """The general form of `receive_data`."""
        pos = 0
        if self._have:
            # The chunks of a packet are joined once, when it is complete: joining at every chunk
            # would copy a 16 MiB packet a hundred times. Small chunks are joined immediately,
            # because each object takes many times its bytes.
            if len(self._chunks[-1]) < SMALL_CHUNK:
                self._chunks[-1] += data
            else:
                self._chunks.append(data)
            self._have += len(data)
            if self._have < self._need or not self._reading:
                return
            scattered = self._scattered()
            if scattered is not None:
                # What the last chunk has behind the packet is parsed where it is.
                buf = self._chunks[-1]
                pos = len(buf) - (self._have - self._need)
            else:
                buf = b"".join(self._chunks)
            self._chunks.clear()
            self._have = 0
            if scattered is not None:
                yield scattered
        else:
            buf = data
        end = len(buf)
        need = 2  # bytes of the packet at `pos`, as far as known
        try:
            while end - pos >= 2 and self._reading:
                first = buf[pos]
                if first == self._head_first and buf.startswith(self._head, pos):
                    stop = pos + self._head_size
                    if stop > end:
                        need = self._head_size
                        break
                    event = self._repeated(buf, pos, stop)
                    if event is not None:
                        yield event
                        pos = stop
                        continue
                length = buf[pos + 1]
                body = pos + 2
                if (
                    length == 2
                    and first in (0x40, 0x50, 0x62, 0x70)
                    and end - pos >= 4
                    and (buf[body] or buf[body + 1])
                    and self.state is State.CONNECTED
                ):
                    yield first >> 4 << 16 | buf[body] << 8 | buf[body + 1]
                    pos += 4
                    continue
                if length > 0x7F:
                    check_type(first)
                    try:
                        length, body = _remaining_length(buf, pos)
                    except IndexError:
                        break
                stop = body + length
                if stop - pos > 127 or self.state is not State.CONNECTED:
                    self._check(first, stop - pos)
                if stop > end:
                    need = stop - pos
                    break
                if 0x30 <= first <= 0x3D and length > 4:
                    event = None
                    if self._learn(buf, pos, body, stop):
                        event = self._repeated(buf, pos, stop)
                    yield event if event is not None else self._publish(first, buf[body:stop])
                else:
                    self._check(first, stop - pos)
                    yield self._decode(first, buf[body:stop])
                pos = stop
            if pos < end and self._reading:
                check_type(buf[pos])
        except ProtocolError:
            self.close()
            raise
        if pos < end and self.state is not State.CLOSED:
            self._chunks.append(buf[pos:] if pos else buf)
            self._have = end - pos
            self._need = need

    def _learn(self, buf: bytes, pos: int, body: int, stop: int) -> bool:
        """Note the header and topic of a PUBLISH for `_repeated`; False if it needs the full
        decoder.

        The data path: it is parsed by index. One with properties, without a topic or with invalid
        flags goes to the full decoder. Its bytes must be there up to its payload.
        """
        first = buf[pos]
        topic_end = body + 2 + (buf[body] << 8 | buf[body + 1])
        payload = topic_end + (2 if first & 6 else 0) + (self.version == 5)
        if (
            payload > stop
            or (self.version == 5 and buf[payload - 1])
            or topic_end == body + 2
            or first & 6 == 6
            or first & 14 == 8
        ):
            return False
        self._head_first = first
        self._head = buf[pos:topic_end]
        self._head_topic = buf[body:topic_end]
        self._head_size = stop - pos
        return True

    def _repeated(self, buf: bytes, pos: int, stop: int) -> RawPublish | None:
        """A PUBLISH with the header and topic of the last; None if it needs the full decoder."""
        head = self._head
        first = self._head_first
        payload = pos + len(head)
        packet_id = 0
        if first & 6:
            packet_id = buf[payload] << 8 | buf[payload + 1]
            if not packet_id:
                return None
            payload += 2
        if self.version == 5:
            if buf[payload]:
                return None
            payload += 1
        return (
            first,
            self._head_topic,
            packet_id,
            buf[payload:stop],
            head if packet_id else buf[pos:stop],
        )

    def _scattered(self) -> RawPublish | None:
        """The large PUBLISH that the buffered chunks complete; None if it takes another way.

        Its payload is joined out of the chunks. To join the chunks first, and cut the payload out
        of that, would copy each byte once more, and with it what is behind the packet.
        """
        chunks, size = self._chunks, self._need
        buf, last = chunks[0], chunks[-1]
        behind = self._have - size  # bytes of the last chunk
        first = buf[0]
        if size < LARGE_PACKET or len(chunks) == 1 or behind >= len(last) or first >> 4 != 3:
            return None
        if size != self._head_size or not buf.startswith(self._head):
            body = decode_varint(buf, 1)[1]
            known = len(buf) - body - 5  # most bytes of a topic of which all is there
            if known < 0 or known < buf[body] << 8 | buf[body + 1]:
                return None
            if not self._learn(buf, 0, body, size):
                return None
        start = len(self._head) + (2 if first & 6 else 0) + (self.version == 5)
        event = self._repeated(buf, 0, start) if len(buf) >= start else None
        if event is None:
            return None
        parts: list[bytes | memoryview] = [memoryview(buf)[start:], *chunks[1:-1]]
        parts.append(memoryview(last)[: len(last) - behind])
        payload = b"".join(parts)
        _, topic, packet_id, _, head = event
        return first, topic, packet_id, payload, head if packet_id else head + payload

    def _check(self, first: int, size: int) -> None:
        """Raise ProtocolError if a packet of this type or size is not allowed now."""
        raise NotImplementedError

    def _decode(self, first: int, body: bytes) -> Packet | int:
        """Decode a packet that `_check` has allowed, and note what it changes."""
        raise NotImplementedError

    def _publish(self, first: int, body: bytes) -> Publish:
        """Decode a PUBLISH fully, resolve its topic alias and check its topic."""
        most = self.user_properties
        self.cost = cost_of(most, len(body))
        packet = decode_packet(first, body, self.version, most)
        assert isinstance(packet, Publish)
        self.cost = cost_of(most, len(packet.passed_on))
        properties = packet.properties
        if (
            properties
            and Property.SUBSCRIPTION_IDENTIFIER in properties
            and not self._with_identifiers  # [MQTT-3.3.4-6]
        ):
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, "only a server sends subscription identifiers"
            )
        alias = properties.pop(Property.TOPIC_ALIAS, None) if properties else None
        if isinstance(alias, int):
            is_given = packet.topic != ""
            packet.topic = self._resolve(alias, packet.topic)
            if not is_given:  # it was checked when it was given
                return packet
        try:
            check_topic(packet.topic)  # [MQTT-3.3.2-2], [MQTT-4.7.3-1]
        except ValueError as error:
            raise ContentError(ReasonCode.MALFORMED_PACKET, str(error)) from None
        return packet

    def _resolve(self, alias: int, topic: str) -> str:
        """The topic that the alias stands for; it is given one if there is any. ProtocolError."""
        if not 0 < alias <= self.topic_alias_maximum:  # [MQTT-3.1.2-26] [MQTT-3.3.2-8, -9]
            raise ProtocolError(
                ReasonCode.TOPIC_ALIAS_INVALID,
                f"topic alias {alias}, more than the {self.topic_alias_maximum} allowed",
            )
        before = self._aliases.get(alias)
        if topic:
            self._aliased += text_size(topic)
            self._aliased += -text_size(before) if before is not None else ALIAS_SIZE
            self._aliases[alias] = topic
            return topic
        if before is None:
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, f"topic alias {alias} was never given a topic"
            )
        return before

    def _check_size(self, kind: PacketType, size: int, limit: int) -> None:
        """Raise ProtocolError if a packet other than PUBLISH is larger than `limit` bytes."""
        if size > limit and kind is not PacketType.PUBLISH:
            raise ProtocolError(
                ReasonCode.QUOTA_EXCEEDED,
                f"a {kind.name} of {size} bytes, more than the limit of {limit}",
                notify_peer=kind is not PacketType.CONNECT,
            )

    def _decode_packet(self, first: int, body: bytes, most: int) -> Packet:
        """Decode a packet other than PUBLISH, with at most `most` User Properties."""
        self.cost = cost_of(most, len(body))  # remains if decoding raises
        packet = decode_packet(first, body, self.version, most)
        self.cost = cost_of(most, _properties_size(first >> 4, body, self.version))
        return packet


def cost_of(most: int, size: int) -> int:
    """The cost of checking properties of `size` bytes with at most `most` User Properties."""
    return min(most, size // SHORTEST_PAIR) // 2 + (size >> 9)


def _properties_size(kind: int, body: bytes, version: int) -> int:
    """Bytes of properties, at most, in a valid packet other than PUBLISH."""
    if version != 5:
        return 0
    begin = _PROPERTIES_AT.get(kind)
    if begin is None:
        return len(body)
    return decode_varint(body, begin)[0] if begin < len(body) else 0


def check_type(first: int) -> None:
    """Raise ProtocolError if `first` begins no packet at all."""
    if first < 0x10:  # section 2.2.1; 5.0 section 2.1.2
        raise ProtocolError(ReasonCode.PROTOCOL_ERROR, "packet type 0 is reserved")


def _remaining_length(buf: bytes, pos: int) -> tuple[int, int]:
    """The length of a packet and the index of its body; IndexError if bytes are missing."""
    # [MQTT-1.5.5-1]: at most four bytes. The available ones are checked before more arrive.
    if len(buf) - pos < 5 and all(byte & 0x80 for byte in buf[pos + 1 :]):
        raise IndexError
    try:
        return decode_varint(buf, pos + 1)
    except ProtocolError as error:
        error.notify_peer = False
        raise
