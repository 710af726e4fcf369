"""An application message, and its bytes on the wire, encoded once for all who get the same."""

from __future__ import annotations

from appliance.mqtt.codec import (
    Properties,
    Property,
    encode_properties,
    encode_string,
    encode_varint,
)

#: What a queued message takes beside its payload, roughly: the objects around it, in bytes.
OVERHEAD = 512

#: And what a user property takes beside its bytes on the wire: a tuple and two strings.
PAIR_OVERHEAD = 160


class Message:
    """An application message; immutable by convention, shared by all sessions that it is owed to.

    `topic_wire` is the topic as it stands in a PUBLISH, its two length bytes included. `expires_at`
    is in seconds of the broker's clock (`Broker.now`), None when the message does not expire.
    """

    __slots__ = (
        "_heads",
        "_tail5",
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
        self._tail5: bytes | None = None
        #: Bytes that a queue counts for this message.
        self.size = len(payload) + len(self.topic_wire) + OVERHEAD
        if properties:
            pairs = properties.get(Property.USER_PROPERTY)
            self.size += len(encode_properties(properties))
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
            tail = self.tail(version)
            packet_id = 2 if first & 0x06 else 0
            size = len(self.topic_wire) + packet_id + len(tail)
            head = bytes((first,)) + encode_varint(size) + self.topic_wire
            if not packet_id:
                head += tail
            self._heads[key] = head
        return head

    def tail(self, version: int) -> bytes:
        """The packet's bytes behind the packet id: in MQTT 5 the properties, and the payload."""
        if version != 5:
            return self.payload
        if self._tail5 is None:
            self._tail5 = encode_properties(self.properties) + self.payload
        return self._tail5

    def encode_for(
        self, first: int, packet_id: int, subscription_ids: list[int] | None, now: float
    ) -> bytes:
        """A whole MQTT 5 packet with what differs a receiver: the slow way.

        Subscription identifiers of the receiver [MQTT-3.3.4-3], and the time that is left of the
        expiry interval [MQTT-3.3.2-6].
        """
        properties = dict(self.properties or {})
        if subscription_ids:
            properties[Property.SUBSCRIPTION_IDENTIFIER] = subscription_ids
        if self.expires_at is not None:
            properties[Property.MESSAGE_EXPIRY_INTERVAL] = max(0, round(self.expires_at - now))
        body = self.topic_wire
        if first & 0x06:
            body += packet_id.to_bytes(2, "big")
        body += encode_properties(properties) + self.payload
        return bytes((first,)) + encode_varint(len(body)) + body
