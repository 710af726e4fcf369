"""The output of one network client: packets are encoded, and written once the store allows."""

from __future__ import annotations

from collections import deque
from typing import Final, Protocol, cast

from appliance.broker.broker import Broker
from appliance.broker.delivery import Delivery
from appliance.broker.link import PeerStatus
from appliance.broker.message import Message
from appliance.broker.ports import Transport
from appliance.broker.session import LARGE_MESSAGE, Session
from appliance.broker.values import PublishRejection
from appliance.mqtt.codec import Properties, Property, encode_property_list
from appliance.mqtt.packets import Connack, Disconnect, Packet, Puback, Pubrec, Suback
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: The limit of PUBLISH bytes between two flushes. Further messages stay in the session's queue
#: until the network has taken these, so that the network determines the client's rate.
OUTPUT_LIMIT: Final = 1024 * 1024

#: The longest topic, in bytes, that gets a topic alias: the topics are stored for each client.
LONGEST_ALIASED = 512

#: The packet classes of refusals with a reason string, by first byte.
_REFUSALS: dict[int, type[Puback] | type[Pubrec]] = {0x40: Puback, 0x50: Pubrec}

#: Why a message is refused while the store cannot take it.
CANNOT_KEEP = "it cannot be stored: see the log of the store"


#: Characters of a reason string: there may be a topic in it, as long as a string can be.
LONGEST_REASON = 256


def in_words(reason: str) -> Properties:
    """The reason string as properties; characters that MQTT strings may not contain are removed."""
    text = reason if len(reason) <= LONGEST_REASON else reason[: LONGEST_REASON - 1] + "…"
    return {Property.REASON_STRING: text.encode(errors="replace").decode().replace("\0", "")}


class OutputOwner(Protocol):
    """The owner of an output: the handler of its client."""

    def later(self) -> None:
        """Continue after the turns of the other clients."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Send the reason to the client, and close the connection."""

    def lost(self) -> None:
        """The connection ended without a DISCONNECT."""


class Output:
    """Encodes packets for one network client; the `Link` of its session after the login.

    Packets are buffered, and passed to the `Transport` at the flush.
    """

    def __init__(self, broker: Broker, transport: Transport, client: OutputOwner) -> None:
        self.transport = transport
        self.writable = True
        self.session: Session | None = None
        #: The protocol version and the Maximum Packet Size (0: no limit) of the client's CONNECT.
        self.version = 0
        self.maximum_packet_size = 0
        #: Whether each PUBLISH is checked for its size, and for older messages that it overtakes.
        self._checks_each = False
        #: Whether the client accepts reason strings, and whether it gets those of rules and limits.
        self.may_explain = False
        self.explains = False
        #: The batch of the store that the answers depend on, and the packets that wait, by batch.
        self.batch = 0
        self._waiting: deque[tuple[int, list[bytes]]] = deque()
        self._broker = broker
        self._accounting = broker.accounting
        self._counters = broker.counters
        self._header_cache = broker.header_cache
        #: Set to None at the end to break the reference cycle.
        self._client: OutputOwner | None = client
        self._out: list[bytes] = []
        self._out_size = 0  # bytes of the PUBLISH packets in it
        self._full = False  # not writable until the flush, because of OUTPUT_LIMIT
        #: The topic aliases of the client; None when it accepts none.
        self._aliases: dict[str, int] | None = None
        self._alias_maximum = 0
        #: The subscription identifiers of the last message that had some, and as they are encoded.
        self._identifiers: list[int] | None = None
        self._identifiers_wire = b""
        #: Whether a packet from another client may be forwarded unchanged.
        self._mirrors = True
        self._closed = False

    def __str__(self) -> str:
        return str(self._client or self.session or "a client")

    def open(self, session: Session, aliases: int, *, explains: bool) -> None:
        """The client has logged in: send the session's messages, with `aliases` topic aliases."""
        self.session = session
        self._alias_maximum = aliases
        self._aliases = {} if aliases else None
        self.explains = explains
        self._set_checks(False)

    def _set_checks(self, has_waiting: bool) -> None:
        """With `has_waiting`, check for each PUBLISH whether it overtakes a large message."""
        self._checks_each = has_waiting or bool(self.maximum_packet_size)
        self._mirrors = not (self._checks_each or self._alias_maximum)

    # --- the Link of the session ---------------------------------------------------------------

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Send a PUBLISH; its header, packet id and payload are joined only at the flush."""
        first = 0x30 | qos << 1 | retain
        if dup:
            first |= 8
        version = self.version
        if self._checks_each and self._is_refused(first, message, subscription_ids):
            self._counters.drop("too_large")
            if qos and self.session is not None:  # [MQTT-3.1.2-25]: as if it were acknowledged
                self.session.give_up(packet_id)
            return
        out = self._out
        if not out:
            self._broker.unflushed.append(self)
        if version == 5 and (
            subscription_ids or message.expires_at is not None or self._aliases is not None
        ):
            if message.size > LARGE_MESSAGE and self._wait_for_its_turn(
                message, first, subscription_ids
            ):
                return
            head = self._encode(first, packet_id, message, subscription_ids)
            out.append(head)
            out.append(message.payload)
            self._out_size += len(head)
        else:
            if message.wire_key == version << 8 | first:
                out.append(message.wire_head)
            else:
                if message.size > LARGE_MESSAGE and self._wait_for_its_turn(message, first, None):
                    return
                out.append(self._header_cache.get(message, version, first))
            if qos:
                out.append(packet_id.to_bytes(2, "big"))
                if version == 5:
                    out.append(message.properties_wire)
                out.append(message.payload)
        self._out_size += len(out[-1])
        if self._out_size > OUTPUT_LIMIT:
            self._full = True
            self.writable = False
        counters = self._counters
        counters.publish_sent += 1
        counters.publish_bytes_sent += len(message.payload)

    def is_behind(self) -> bool:
        """Whether the network has not yet taken earlier output, or will not at the flush."""
        if self._out_size > LARGE_MESSAGE:
            self._full = True
        elif not self.transport.is_behind():
            return False
        self._set_checks(True)
        return True

    def _wait_for_its_turn(
        self, message: Message, first: int, subscription_ids: list[int] | None
    ) -> bool:
        """Return a large QoS 0 message to the session's queue when the client is behind.

        Newer and smaller messages may then overtake it.
        """
        session = self.session
        # With `keep` the order of the queue is preserved.
        if first & 0x06 or session is None or self._accounting.limits.keep or not self.is_behind():
            return False
        session.keep_latest(cast(Delivery, (message, 0, bool(first & 1), subscription_ids, None)))
        return True

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Forward a QoS 0 PUBLISH unchanged, if this client can take it so."""
        if version != self.version or not self.writable or not self._mirrors:
            return False
        out = self._out
        if not out:
            self._broker.unflushed.append(self)
        out.append(packet)
        counters = self._counters
        counters.publish_sent += 1
        counters.publish_bytes_sent += payload_size
        return True

    def _encode(
        self, first: int, packet_id: int, message: Message, subscription_ids: list[int] | None
    ) -> bytes:
        """Encode an MQTT 5 packet with this client's own properties: the slow path."""
        alias, named = 0, True
        aliases = self._aliases
        if aliases is not None:
            alias = aliases.get(message.topic, 0)
            if alias:
                named = False
            elif (
                len(aliases) < self._alias_maximum
                and len(message.topic_wire) <= LONGEST_ALIASED
                and (
                    not self.maximum_packet_size
                    or (message.size < self.maximum_packet_size and not subscription_ids)
                )
            ):
                alias = aliases[message.topic] = len(aliases) + 1
        identifiers = self._encode_identifiers(subscription_ids) if subscription_ids else b""
        return message.encode_head_for(
            first, packet_id, identifiers, self._accounting.now, alias, named=named
        )

    def _encode_identifiers(self, ids: list[int]) -> bytes:
        """The property of subscription identifiers: a client may have given a thousand.

        Those of the last message are known, and the list is the same as long as its route is: a
        thousand take half a millisecond.
        """
        if ids is not self._identifiers:
            self._counters.cost += len(ids) >> 3
            self._identifiers = ids
            self._identifiers_wire = encode_property_list({Property.SUBSCRIPTION_IDENTIFIER: ids})
        return self._identifiers_wire

    def _is_refused(self, first: int, message: Message, subscription_ids: list[int] | None) -> bool:
        """Whether the message exceeds the client's Maximum Packet Size.

        A message that is sent replaces a waiting older one of its topic [MQTT-4.6.0-6].
        """
        if self.maximum_packet_size and self._too_large(first, message, subscription_ids):
            return True
        session = self.session
        if session is not None and not first & 0x07:  # a retained message may be the older one
            session.overtake(message.topic)
            if not session.large:
                self._set_checks(False)
        return False

    def _too_large(self, first: int, message: Message, subscription_ids: list[int] | None) -> bool:
        limit = self.maximum_packet_size
        if message.size <= limit and not subscription_ids:
            return False
        # A message near the limit assigns no new topic alias, see `_encode`.
        alias = self._aliases.get(message.topic, 0) if self._aliases else 0
        identifiers = self._encode_identifiers(subscription_ids) if subscription_ids else b""
        head = message.encode_head_for(
            first, 1, identifiers, self._accounting.now, alias, named=not alias
        )
        return len(head) + len(message.payload) > limit

    def pubrel(self, packet_id: int) -> None:
        """Send a PUBREL."""
        self.acknowledge(0x62, packet_id, ReasonCode.SUCCESS)

    def later(self) -> None:
        """Continue after the turns of the other clients."""
        if self._client is not None:
            self._client.later()

    def peer_status(self) -> PeerStatus:
        """The state of the connection to the client's computer."""
        return self.transport.peer_status()

    def probe(self) -> None:
        """Make the client's computer answer, if it is alive."""
        self.transport.probe()

    def withhold(self, seconds: float) -> None:
        """Send nothing for this time."""
        self.transport.withhold(seconds)

    def close(self, reason: ReasonCode, message: str) -> None:
        """Close the connection with a reason code in DISCONNECT; the will is due."""
        if self._client is not None:
            self._client.close(reason, message)

    # --- packets of all kinds ------------------------------------------------------------------

    def acknowledge(self, first: int, packet_id: int, code: int, reason: str = "") -> None:
        """Send PUBACK, PUBREC, PUBREL or PUBCOMP in its shortest form.

        `reason` is sent with a refusal to clients that get reason strings.
        """
        # As one number: first byte, the length 2, packet id. Compiled it takes half of a join.
        packet = (first << 24 | 2 << 16 | packet_id).to_bytes(4, "big")
        if code:
            if self.version == 5:
                if code >= 0x80 and self.explains and reason:
                    self.send(_REFUSALS[first](packet_id, code, in_words(reason)))
                    return
                packet = bytes((first, 3, packet_id >> 8, packet_id & 0xFF, code))
            elif code == ReasonCode.QUOTA_EXCEEDED and self._accounting.failing:
                # 3.1.1 cannot refuse, and an acknowledged message must be stored.
                raise ProtocolError(ReasonCode.QUOTA_EXCEEDED, CANNOT_KEEP)
        out = self._out
        if not out:
            self._broker.unflushed.append(self)
        out.append(packet)
        self._counters.control_sent += 1

    def reject_publish(self, first: int, packet_id: int, rejection: PublishRejection) -> None:
        """Acknowledge a message with the reason why it could not be used, such as ROS's.

        Clients of 3.1.1 get a normal acknowledgement.
        """
        if self.version == 5 and self.may_explain:
            words: Properties = {Property.REASON_STRING: rejection.reason}
            self.send(_REFUSALS[first](packet_id, rejection.code, words))
        else:
            self.acknowledge(first, packet_id, rejection.code)

    def send(self, packet: Packet) -> bool:
        """Send any packet; False if it is too large for the client even without reason string."""
        data = packet.encode(self.version or 4)
        limit = self.maximum_packet_size
        if limit and len(data) > limit:  # [MQTT-3.1.2-24]
            if (
                isinstance(packet, Connack | Puback | Pubrec | Suback | Disconnect)
                and packet.properties
                and Property.REASON_STRING in packet.properties  # the only property
            ):
                # [MQTT-3.2.2-19], [MQTT-3.4.2-2], [MQTT-3.5.2-2], [MQTT-3.9.2-1], [MQTT-3.14.2-3]
                packet.properties = None
                return self.send(packet)
            return False
        if not self._out:
            self._broker.unflushed.append(self)
        self._out.append(data)
        self._counters.control_sent += 1
        return True

    def end(self) -> None:
        """Accept no further packets; the flush writes the last ones, and closes the connection.

        Like all packets these wait until the changes that they acknowledge are stored.
        """
        self._closed = True
        self._client = None
        self.writable = False
        if not self._out:
            self._broker.unflushed.append(self)

    # --- the flush, and the network ------------------------------------------------------------

    def flush(self) -> None:
        """Write the packets since the last flush, and close the connection after `end`."""
        out = self._out
        if out:
            self._out = []
            self._out_size = 0
            if self._full:
                self.writable = not self._closed
            self.transport.write(out)
            session = self.session
            if session is not None and session.congestion is not None:
                session.congestion.written(self._broker.store.committed)
        if self._closed:
            self.transport.close()
        elif self._full:
            self._full = False
            if self.writable:  # the network has not asked for a pause
                self.resume_writing()

    def wait(self, committed: int) -> bool:
        """Hold the packets since the last flush back if they depend on a later batch than this."""
        batch = self.batch
        session = self.session
        if session is not None and session.batch > batch:
            batch = session.batch
        waiting = self._waiting
        if waiting and waiting[-1][0] > batch:
            batch = waiting[-1][0]  # the order is preserved
        if batch <= committed:
            return False
        out, self._out = self._out, []
        if waiting and waiting[-1][0] == batch:
            waiting[-1][1].extend(out)
        else:
            waiting.append((batch, out))
        if session is not None and session.congestion is not None:
            session.congestion.held_back(batch)
        return True

    def release(self, committed: int) -> bool:
        """Write the packets that waited for this batch; True when others wait for a later one."""
        waiting = self._waiting
        if self._full and not self._out:
            self.writable = not self._closed
        while waiting and waiting[0][0] <= committed:
            chunks = waiting.popleft()[1]
            if chunks:
                self.transport.write(chunks)
        session = self.session
        if session is not None and session.congestion is not None:
            session.congestion.written(committed)
        if waiting:
            return True
        if not self._out:
            self._out_size = 0
            self.flush()
        return False

    def abandon(self) -> None:
        """Close without sending held packets: the changes that they acknowledge were not stored."""
        self._waiting.clear()
        self._out.clear()
        try:
            if self._client is not None:
                self._client.lost()
        finally:
            self.transport.close()

    def resume_writing(self) -> None:
        """The network takes bytes again: send queued messages."""
        self.writable = True
        if self.session is not None and self.session.link is self:
            self.session.pump()

    def caught_up(self) -> None:
        """The network has taken all output: send the large messages that waited for that."""
        if self.writable and self.session is not None and self.session.link is self:
            self.session.pump()
