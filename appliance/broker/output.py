"""What one network client is sent: encoded for it, and written once what it depends on is kept."""

from __future__ import annotations

from collections import deque
from typing import Protocol, cast

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.ports import PeerStatus, PublishRejection, Transport
from appliance.broker.session import LARGE_MESSAGE, Delivery, Session
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Connack, Disconnect, Packet, Puback, Pubrec, Suback
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: Bytes that a client is sent before the next flush. What waits in its session waits on, until the
#: network has taken these: it is the network that says how fast a client is.
OUTPUT_LIMIT = 1024 * 1024

#: The longest topic, in bytes, that is given a number: the names are kept for each client.
LONGEST_ALIASED = 512

#: What a refusal is sent as when it has a reason string, by its first byte.
_REFUSALS: dict[int, type[Puback] | type[Pubrec]] = {0x40: Puback, 0x50: Pubrec}

#: Why a message is refused while the store cannot take it.
CANNOT_KEEP = "it cannot be stored: see the log of the store"


#: Characters of a reason string: there may be a topic in it, as long as a string can be.
LONGEST_REASON = 256


def in_words(reason: str) -> Properties:
    """The reason string of an answer; what no string of MQTT may have in it is left out."""
    text = reason if len(reason) <= LONGEST_REASON else reason[: LONGEST_REASON - 1] + "…"
    return {Property.REASON_STRING: text.encode(errors="replace").decode().replace("\0", "")}


class OutputOwner(Protocol):
    """The conversation that the output is one side of."""

    def later(self) -> None:
        """Let the other clients have their turn, then go on."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Tell the client why, and end the connection."""

    def lost(self) -> None:
        """The connection ended without a DISCONNECT."""


class Output:
    """The way to one network client; the `Link` of its session once it has logged in.

    What it is sent is collected, and goes to the `Transport` at the flush.
    """

    def __init__(self, broker: Broker, transport: Transport, client: OutputOwner) -> None:
        self.transport = transport
        self.writable = True
        self.session: Session | None = None
        #: That of the client's CONNECT, and what else was agreed with it.
        self.version = 0
        self.maximum_packet_size = 0
        #: Whether what is published has to be looked at: for its size, or for what it passes.
        self._looks = False
        #: Whether it wants to be told why; and whether it is, of what rules and limits decide.
        self.may_explain = False
        self.explains = False
        #: The batch of the store that what it is answered depends on, and what waits for which.
        self.batch = 0
        self._waiting: deque[tuple[int, list[bytes]]] = deque()
        self._broker = broker
        self._accounting = broker.accounting
        self._counters = broker.counters
        self._header_cache = broker.header_cache
        #: None at the end: the two know each other, and nobody looks for such circles.
        self._client: OutputOwner | None = client
        self._out: list[bytes] = []
        self._out_size = 0  # of the PUBLISH packets in there, from their sessions
        self._full = False  # not writable until the flush, for OUTPUT_LIMIT
        #: Numbers of the topic names that the client was sent; None when it takes none.
        self._aliases: dict[str, int] | None = None
        self._alias_maximum = 0
        #: Whether a packet may go out as it came in from another client.
        self._mirrors = True
        self._closed = False

    def __str__(self) -> str:
        return str(self._client or self.session or "a client")

    def open(self, session: Session, aliases: int, *, explains: bool) -> None:
        """The client has logged in: send it what its session has, with so many topic aliases."""
        self.session = session
        self._alias_maximum = aliases
        self._aliases = {} if aliases else None
        self.explains = explains
        self._look_at_all(False)

    def _look_at_all(self, has_waiting: bool) -> None:
        """`has_waiting`: large messages wait, and newer ones are not to pass them unseen."""
        self._looks = has_waiting or bool(self.maximum_packet_size)
        self._mirrors = not (self._looks or self._alias_maximum)

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
        """Send a PUBLISH; its head, packet id and payload are joined only at the flush."""
        first = 0x30 | qos << 1 | retain
        if dup:
            first |= 8
        version = self.version
        if self._looks and self._is_refused(first, message, subscription_ids):
            self._counters.publish_dropped += 1
            if qos and self.session is not None:  # [MQTT-3.1.2-25]: as if it were sent and done
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
            out.append(self._encode(first, packet_id, message, subscription_ids))
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
        """Whether the network has yet to take what it was given, or will be at the flush."""
        if self._out_size > LARGE_MESSAGE:
            self._full = True
        elif not self.transport.is_behind():
            return False
        self._look_at_all(True)
        return True

    def _wait_for_its_turn(
        self, message: Message, first: int, subscription_ids: list[int] | None
    ) -> bool:
        """Give a large message of QoS 0 back to the session when the client is behind.

        What comes then, and is newer or smaller, is not behind it.
        """
        session = self.session
        # With `keep` there is a queue, which nothing may pass.
        if first & 0x06 or session is None or self._accounting.limits.keep or not self.is_behind():
            return False
        session.keep_latest(cast(Delivery, (message, 0, bool(first & 1), subscription_ids, None)))
        return True

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Send a PUBLISH of QoS 0 as it came in, unless something stands against it."""
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
        """An MQTT 5 packet with what is this client's own: the slow way."""
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
        return message.encode_for(
            first, packet_id, subscription_ids, self._accounting.now, alias, named=named
        )

    def _is_refused(self, first: int, message: Message, subscription_ids: list[int] | None) -> bool:
        """Whether the client does not take a message of that size. One that is sent takes the place
        of an older one of its topic that waits [MQTT-4.6.0-6]."""
        if self.maximum_packet_size and self._too_large(first, message, subscription_ids):
            return True
        session = self.session
        if session is not None and not first & 0x07:  # what is retained may be the older of the two
            session.overtake(message.topic)
            if not session.large:
                self._look_at_all(False)
        return False

    def _too_large(self, first: int, message: Message, subscription_ids: list[int] | None) -> bool:
        limit = self.maximum_packet_size
        if message.size <= limit and not subscription_ids:
            return False
        # A topic gets no new alias from a message that is near the limit, see `_encode`.
        alias = self._aliases.get(message.topic, 0) if self._aliases else 0
        packet = message.encode_for(
            first, 1, subscription_ids, self._accounting.now, alias, named=not alias
        )
        return len(packet) > limit

    def pubrel(self, packet_id: int) -> None:
        """Send a PUBREL."""
        self.acknowledge(0x62, packet_id, ReasonCode.SUCCESS)

    def later(self) -> None:
        """Let the other clients have their turn."""
        if self._client is not None:
            self._client.later()

    def peer_status(self) -> PeerStatus:
        """How the client's computer answers."""
        return self.transport.peer_status()

    def probe(self) -> None:
        """Have the client's computer answer, if it can."""
        self.transport.probe()

    def withhold(self, seconds: float) -> None:
        """Let nothing out for so long."""
        self.transport.withhold(seconds)

    def close(self, reason: ReasonCode, message: str) -> None:
        """End the connection with a DISCONNECT that says why; its will is due."""
        if self._client is not None:
            self._client.close(reason, message)

    # --- packets of all kinds ------------------------------------------------------------------

    def acknowledge(self, first: int, packet_id: int, code: int, reason: str = "") -> None:
        """Send PUBACK, PUBREC, PUBREL or PUBCOMP in its shortest form.

        `reason` is for a refusal, and for clients that are to be told.
        """
        packet = bytes((first, 2, packet_id >> 8, packet_id & 0xFF))
        if code:
            if self.version == 5:
                if code >= 0x80 and self.explains and reason:
                    self.send(_REFUSALS[first](packet_id, code, in_words(reason)))
                    return
                packet = bytes((first, 3, packet_id >> 8, packet_id & 0xFF, code))
            elif code == ReasonCode.QUOTA_EXCEEDED and self._accounting.failing:
                # 3.1.1 cannot refuse, and what is acknowledged must be kept.
                raise ProtocolError(ReasonCode.QUOTA_EXCEEDED, CANNOT_KEEP)
        out = self._out
        if not out:
            self._broker.unflushed.append(self)
        out.append(packet)
        self._counters.control_sent += 1

    def reject_publish(self, first: int, packet_id: int, rejection: PublishRejection) -> None:
        """Acknowledge with what ROS has against a message: its publisher alone can mend that.

        To 3.1.1 it is acknowledged as any other.
        """
        if self.version == 5 and self.may_explain:
            words: Properties = {Property.REASON_STRING: rejection.reason}
            self.send(_REFUSALS[first](packet_id, rejection.code, words))
        else:
            self.acknowledge(first, packet_id, rejection.code)

    def send(self, packet: Packet) -> bool:
        """Send any packet; False when it is larger than the client takes, also without words."""
        data = packet.encode(self.version or 4)
        limit = self.maximum_packet_size
        if limit and len(data) > limit:  # [MQTT-3.1.2-24]
            if (
                isinstance(packet, Connack | Puback | Pubrec | Suback | Disconnect)
                and packet.properties
                and Property.REASON_STRING in packet.properties  # nothing else is with it
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
        """Send nothing more; the flush writes the last bytes, and closes the connection.

        Like all bytes they wait for what they acknowledge to be kept.
        """
        self._closed = True
        self._client = None
        self.writable = False
        if not self._out:
            self._broker.unflushed.append(self)

    # --- the flush, and the network ------------------------------------------------------------

    def flush(self) -> None:
        """Write what was sent since the last flush, and close if it was the last."""
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
        """Keep what was sent since the last flush, if it depends on a later batch than this."""
        batch = self.batch
        session = self.session
        if session is not None and session.batch > batch:
            batch = session.batch
        waiting = self._waiting
        if waiting and waiting[-1][0] > batch:
            batch = waiting[-1][0]  # nothing passes what waits
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
        """Write what waited for this batch; True when something waits for a later one."""
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
        """Close without sending what waits: what it would acknowledge could not be kept."""
        self._waiting.clear()
        self._out.clear()
        try:
            if self._client is not None:
                self._client.lost()
        finally:
            self.transport.close()

    def resume_writing(self) -> None:
        """The network takes bytes again: send what waited."""
        self.writable = True
        if self.session is not None and self.session.link is self:
            self.session.pump()

    def caught_up(self) -> None:
        """The network has taken all it was given: send the large messages that waited for that."""
        if self.writable and self.session is not None and self.session.link is self:
            self.session.pump()
