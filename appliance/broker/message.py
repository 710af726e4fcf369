"""An application message, and its bytes on the wire, encoded once for all who get the same."""

from __future__ import annotations

from typing import Protocol

from appliance.mqtt.codec import (
    Properties,
    Property,
    encode_property_list,
    encode_string,
    encode_varint,
)

#: What a queued message takes beside its payload, roughly: the objects around it, in bytes.
OVERHEAD = 512

#: And what a user property takes beside its bytes on the wire: a tuple and two strings.
PAIR_OVERHEAD = 160


#: The longest interval that a property can name, in seconds. More may be left of it than was asked
#: for, as the clock of a restored message may have gone back.
LONGEST_INTERVAL = 0xFFFF_FFFF

#: Payloads from this size on, in bytes, are not kept a second time while a message waits.
LARGE = 1024


class Message:
    """An application message; immutable by convention, shared by all sessions that it is owed to.

    `topic_wire` is the topic as it stands in a PUBLISH, its two length bytes included. `expires_at`
    is in seconds of the broker's clock (`Broker.now`), None when the message does not expire.
    """

    __slots__ = (
        "_heads",
        "_passed_on",
        "_properties_wire",
        "expires_at",
        "payload",
        "properties",
        "qos",
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
        passed_on: bytes | None = None,
    ) -> None:
        self.topic = topic
        self.payload = payload
        self.qos = qos
        self.retain = retain
        self.properties = properties
        self.expires_at = expires_at
        self.topic_wire = topic_wire or encode_string(topic)
        #: One encoded beginning (QoS 0: the whole packet), and what it is for: the packet as it
        #: came, most often, which most often goes out again as it is. `head` knows the others.
        self.wire_key = 0
        self.wire_head = b""
        self._heads: dict[int, bytes] | None = None
        #: The properties that all receivers get, as they stand in a packet, without their length.
        self._passed_on = passed_on
        self._properties_wire: bytes | None = None
        #: Bytes that a queue counts for this message; the topic is a string, and in its packets.
        self.size = len(payload) + 3 * len(self.topic_wire) + OVERHEAD
        if properties:
            pairs = properties.get(Property.USER_PROPERTY)
            self.size += len(encode_property_list(properties) if passed_on is None else passed_on)
            self.size += PAIR_OVERHEAD * len(pairs) if isinstance(pairs, list) else 0

    def head(self, version: int, first: int) -> bytes:
        """The packet's bytes up to the topic's end; for QoS 0 to the packet's end."""
        key = version << 8 | first
        if key == self.wire_key:
            return self.wire_head
        if self._heads is None:
            self._heads = {}
        head = self._heads.get(key)
        if head is None:
            packet_id = 2 if first & 0x06 else 0
            properties = self.properties_wire if version == 5 else b""
            size = len(self.topic_wire) + packet_id + len(properties) + len(self.payload)
            head = bytes((first,)) + encode_varint(size) + self.topic_wire
            if not packet_id:
                head += properties + self.payload
                if len(self.payload) >= LARGE:
                    return head
            self._heads[key] = head
        return head

    @property
    def age(self) -> float:
        """Seconds from its arrival until it was published, see `Late`."""
        return 0.0

    def dropped(self) -> None:
        """A session has given it up, whose client was too slow; see `Watched`."""

    @property
    def properties_wire(self) -> bytes:
        """The properties as they stand in an MQTT 5 packet, between packet id and payload."""
        if self._properties_wire is None:
            passed_on = self._properties_of_all()
            self._properties_wire = encode_varint(len(passed_on)) + passed_on
        return self._properties_wire

    @property
    def passed_on(self) -> bytes | None:
        """The properties that all receivers get in the publisher's order, where it is known."""
        return self._passed_on

    def _properties_of_all(self) -> bytes:
        if self._passed_on is None:
            properties = dict(self.properties or {})
            properties.pop(Property.MESSAGE_EXPIRY_INTERVAL, None)
            self._passed_on = encode_property_list(properties) if properties else b""
        return self._passed_on

    def is_like(self, other: Message) -> bool:
        """Whether it may be the same message, sent again."""
        return self.topic_wire == other.topic_wire and self.payload == other.payload

    def settle(self) -> None:
        """The message is going to wait: what can be encoded again is not kept, if it is large."""
        if len(self.payload) >= LARGE:
            if self.wire_key & 0x06 == 0:  # QoS 0: the whole packet
                self.wire_key = 0
                self.wire_head = b""
            self._heads = None

    def encode_for(
        self,
        first: int,
        packet_id: int,
        subscription_ids: list[int] | None,
        now: float,
        alias: int = 0,
        *,
        named: bool = True,
    ) -> bytes:
        """A whole MQTT 5 packet with what differs a receiver: the slow way.

        Subscription identifiers of the receiver [MQTT-3.3.4-3], its alias for the topic, which
        stands for the name when not `named`, and the time that is left of the expiry interval
        [MQTT-3.3.2-6]. The properties are in mosquitto's order.
        """
        before: Properties = {}
        if alias:
            before[Property.TOPIC_ALIAS] = alias
        if subscription_ids:
            before[Property.SUBSCRIPTION_IDENTIFIER] = subscription_ids
        properties = encode_property_list(before) + self._properties_of_all()
        if self.expires_at is not None:
            left = round(min(max(0.0, self.expires_at - now), LONGEST_INTERVAL))
            properties += encode_property_list({Property.MESSAGE_EXPIRY_INTERVAL: left})
        body = self.topic_wire if named else b"\0\0"
        if first & 0x06:
            body += packet_id.to_bytes(2, "big")
        body += encode_varint(len(properties)) + properties + self.payload
        return bytes((first,)) + encode_varint(len(body)) + body


class Watcher(Protocol):
    """Counts what slow clients are not sent."""

    skipped: int


class Watched(Message):
    """A message of a part of the appliance that counts what slow clients are not sent of it.

    Whoever makes one sets `watcher`.
    """

    __slots__ = ("watcher",)

    watcher: Watcher

    def dropped(self) -> None:
        self.watcher.skipped += 1


class Late(Message):
    """A message that was published some time after its client had sent it for the first time.

    `age` is that time in seconds, infinity where it is not known: what is sent again after a lost
    connection, a QoS 2 message that waited for its PUBREL. For most receivers it is as any other.
    """

    __slots__ = ("_age",)

    def __init__(self, message: Message, age: float) -> None:
        super().__init__(
            message.topic,
            message.payload,
            message.qos,
            message.retain,
            message.properties,
            message.expires_at,
            message.topic_wire,
            message._passed_on,
        )
        self._age = age

    @property
    def age(self) -> float:
        return self._age
