"""An application message, and its encoding, which receivers of the same packet share."""

from __future__ import annotations

from typing import Final, Protocol

from appliance.broker.values import PublishRejection
from appliance.mqtt.codec import (
    NO_PROPERTIES,
    PacketType,
    Properties,
    Property,
    decode_properties,
    decode_varint,
    encode_properties,
    encode_property_list,
    encode_string,
    encode_varint,
    text_size,
)

#: The approximate memory of a queued message beside its own bytes: the objects around it.
OVERHEAD: Final = 512

#: The longest interval that a property can encode, in seconds. The remaining time can exceed it
#: because the clock of a restored message may have gone back.
LONGEST_INTERVAL = 0xFFFF_FFFF

#: While a message is queued, its encoding is not cached if the payload has at least this size.
LARGE: Final = 1024


def _passed_on(properties: Properties) -> bytes:
    """The properties for the receivers, encoded."""
    expiry = Property.MESSAGE_EXPIRY_INTERVAL  # sent to each receiver with its remaining time
    return encode_properties({name: properties[name] for name in properties if name != expiry})


class MessagePublisher(Protocol):
    """The session that publishes a message, see `session.publisher_of`."""

    @property
    def client_id(self) -> str:
        """Its client id."""


class Message:
    """An application message, shared by all sessions that it is delivered to.

    By convention nothing changes it but its delivery, see `publisher` and `rejection`.
    `topic_wire` is the encoded topic, its two length bytes included. `expires_at` is in seconds of
    the broker's clock (`Broker.now`), None when the message does not expire. `properties_wire` are
    the properties for all receivers, encoded as in an MQTT 5 packet between packet id and payload;
    no decoded form of them is stored.

    `publisher` is the session that publishes it, while it is delivered: links inside the appliance
    read it. It is None before and after, as a message may outlive the session by days.
    `rejection` is set by such a link when it could not use the message; the acknowledgement
    reports it to the publisher.
    """

    __slots__ = (
        "expires_at",
        "payload",
        "properties_wire",
        "publisher",
        "qos",
        "rejection",
        "retain",
        "size",
        "topic",
        "topic_wire",
        "wire_head",
        "wire_key",
    )

    def __init__(
        self,
        topic: str,
        payload: bytes,
        qos: int = 0,
        retain: bool = False,
        properties: Properties | None = None,
        expires_at: float | None = None,
        topic_wire: bytes | None = None,
        properties_wire: bytes = NO_PROPERTIES,
    ) -> None:
        self.topic = topic
        self.payload = payload
        self.qos = qos
        self.retain = retain
        self.expires_at = expires_at
        self.publisher: MessagePublisher | None = None
        self.rejection: PublishRejection | None = None
        self.topic_wire = topic_wire or encode_string(topic)
        self.properties_wire = _passed_on(properties) if properties else properties_wire
        #: One encoded header (QoS 0: the whole packet), and the version and first byte that it is
        #: for. Most often it is the header as it came in, which most often goes out unchanged.
        #: `HeaderCache` has the others.
        self.wire_key = 0
        self.wire_head = b""
        #: Bytes that a queue counts for this message; the topic is in memory as a string, and twice
        #: encoded.
        wire = len(self.topic_wire)
        text = wire if topic.isascii() else text_size(topic)
        self.size = len(payload) + 2 * wire + text + len(self.properties_wire) + OVERHEAD

    @property
    def properties(self) -> Properties | None:
        """The properties for all receivers, decoded at each call; None when there are none.

        The Message Expiry Interval is not among them, see `expires_at`.
        """
        wire = self.properties_wire
        return decode_properties(wire, 0, len(wire), PacketType.PUBLISH)[0]

    def encode_head(self, version: int, first: int) -> bytes:
        """Encode the packet up to the end of its topic; for QoS 0 the whole packet."""
        packet_id = 2 if first & 0x06 else 0
        properties = self.properties_wire if version == 5 else b""
        size = len(self.topic_wire) + packet_id + len(properties) + len(self.payload)
        head = bytes((first,)) + encode_varint(size) + self.topic_wire
        return head if packet_id else head + properties + self.payload

    @property
    def age(self) -> float:
        """Seconds between its arrival and its publication, see `DelayedMessage`."""
        return 0.0

    @property
    def is_dated(self) -> bool:
        """Whether its own age is all that there is to know, see `DatedMessage`."""
        return False

    def dropped(self) -> None:
        """Note that a session dropped it because the client was too slow, see `CountedMessage`."""

    def is_like(self, other: Message) -> bool:
        """Whether the other may be the same message, sent again."""
        return self.topic_wire == other.topic_wire and self.payload == other.payload

    def settle(self) -> None:
        """Prepare for being queued: drop a large cached encoding, which can be made again."""
        if len(self.payload) >= LARGE and self.wire_key & 0x06 == 0:  # QoS 0: the whole packet
            self.wire_key = 0
            self.wire_head = b""

    def encode_head_for(
        self,
        first: int,
        packet_id: int,
        identifiers: bytes,
        now: float,
        alias: int = 0,
        *,
        named: bool = True,
    ) -> bytes:
        """Encode an MQTT 5 packet for one receiver up to its payload: the slow path.

        It contains the receiver's subscription identifiers [MQTT-3.3.4-3], which are encoded, its
        topic alias, which replaces the topic unless `named`, and the time that is left of the
        expiry interval [MQTT-3.3.2-6]. The properties are in mosquitto's order.
        """
        before = encode_property_list({Property.TOPIC_ALIAS: alias}) if alias else b""
        own = self.properties_wire
        properties = before + identifiers + own[decode_varint(own, 0)[1] :]
        if self.expires_at is not None:
            left = round(min(max(0.0, self.expires_at - now), LONGEST_INTERVAL))
            properties += encode_property_list({Property.MESSAGE_EXPIRY_INTERVAL: left})
        body = self.topic_wire if named else b"\0\0"
        if first & 0x06:
            body += packet_id.to_bytes(2, "big")
        body += encode_varint(len(properties)) + properties
        return bytes((first,)) + encode_varint(len(body) + len(self.payload)) + body


class HeaderCache:
    """Caches the encoded headers of the message that is being delivered.

    The next message replaces them: cached for each queued message, they would take more memory than
    the message itself.
    """

    def __init__(self) -> None:
        self._message: Message | None = None
        self._known: dict[int, bytes] = {}

    def get(self, message: Message, version: int, first: int) -> bytes:
        """`Message.encode_head`, encoded once for all receivers of the same packet."""
        if message is not self._message:
            self._known.clear()
            self._message = message
        key = version << 8 | first
        head = self._known.get(key)
        if head is None:
            head = message.encode_head(version, first)
            if first & 0x06 or len(message.payload) < LARGE:
                self._known[key] = head
        return head

    def clear(self) -> None:
        """Drop the reference to the message, and its headers."""
        self._known.clear()
        self._message = None


class SkipCounter(Protocol):
    """Counts messages that were dropped because a client was slow."""

    skipped: int


class CountedMessage(Message):
    """A message that counts how often it is dropped because a client is slow.

    Its creator must set `skip_counter`.
    """

    __slots__ = ("skip_counter",)

    skip_counter: SkipCounter

    def dropped(self) -> None:
        self.skip_counter.skipped += 1


class DelayedMessage(Message):
    """A message that is published some time after its client first sent it.

    `age` is that time in seconds; it is infinity where it is unknown. Examples are a message that
    is sent again after a lost connection, and a QoS 2 message that waited for its PUBREL. Only
    receivers that reject old messages, such as command routes, look at the age.
    """

    __slots__ = ("_age",)

    def __init__(self, message: Message, age: float) -> None:
        super().__init__(
            message.topic,
            message.payload,
            message.qos,
            message.retain,
            None,
            message.expires_at,
            message.topic_wire,
            message.properties_wire,
        )
        self._age = age

    @property
    def age(self) -> float:
        return self._age


class DatedMessage(DelayedMessage):
    """A message that came over a link, whose `age` is the most that it can be.

    It says nothing of what comes behind it: a link carries the messages of many clients.
    """

    __slots__ = ()

    @property
    def is_dated(self) -> bool:
        return True
