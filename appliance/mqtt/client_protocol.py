"""The client side of one MQTT connection: which packets a server may send when, and how large.

`ClientProtocol` takes received bytes and yields events, see `PacketFramer`. An `int` is an
acknowledgement without properties here: ``reason code << 24 | type << 16 | packet id``, because
some brokers answer each message that nobody subscribes to with No matching subscribers.
"""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence

from appliance.mqtt.codec import (
    V5,
    V311,
    PacketType,
    Property,
    decode_binary,
    decode_packet_id,
    find_topic_alias,
)
from appliance.mqtt.framing import (
    DEFAULT_PAIRS,
    MAXIMUM_CONNECT,
    MAXIMUM_CONTROL,
    PUBACK,
    PUBCOMP,
    PUBREC,
    PUBREL,
    UNAUTHENTICATED_PAIRS,
    PacketFramer,
    State,
    check_type,
    cost_of,
)
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    UnusablePublish,
)
from appliance.mqtt.reason import ContentError, ProtocolError, ReasonCode
from appliance.mqtt.topics import check_topic

# The packets that a server may send in each state; any other is a protocol error (0x82).
# DISCONNECT and AUTH exist in version 5 only, AUTH only after an authentication method. The
# standard allows no DISCONNECT before CONNACK; what it says is more useful than an error.
# [MQTT-3.2.0-1], [MQTT-3.2.0-2]
_LEGAL: dict[State, frozenset[PacketType]] = {
    State.NEW: frozenset(),
    State.AUTHENTICATING: frozenset({PacketType.CONNACK, PacketType.AUTH, PacketType.DISCONNECT}),
    State.CONNECTED: frozenset(
        {
            PacketType.PUBLISH,
            PacketType.PUBACK,
            PacketType.PUBREC,
            PacketType.PUBREL,
            PacketType.PUBCOMP,
            PacketType.SUBACK,
            PacketType.UNSUBACK,
            PacketType.PINGRESP,
            PacketType.DISCONNECT,
            PacketType.AUTH,
        }
    ),
    State.CLOSED: frozenset(),
}

# What the first byte is when the peer does not speak MQTT at all, and what the user can do.
_STRANGERS = {
    0x15: "what it sends is TLS: is the port one for mqtts:// or wss://?",
    0x16: "what it sends is TLS: is the port one for mqtts:// or wss://?",
    0x48: "what it sends is HTTP: is the port one for ws://?",  # the H of HTTP/1.1
}

# First byte of an acknowledgement -> its event without the packet id, and its reason codes.
_ACKNOWLEDGEMENTS: dict[int, tuple[int, frozenset[ReasonCode]]] = {
    0x40: (PUBACK, Puback.REASONS),
    0x50: (PUBREC, Pubrec.REASONS),
    0x62: (PUBREL, Pubrel.REASONS),
    0x70: (PUBCOMP, Pubcomp.REASONS),
}

#: What follows the packet id in a PUBACK, by its first two bytes: nothing, or the reason code No
#: matching subscribers, also with the length of no properties.
_PUBACKS = {b"\x40\x02": b"", b"\x40\x03": b"\x10", b"\x40\x04": b"\x10\x00"}

#: The largest acknowledgement without properties, in bytes: smaller than any packet size limit that
#: is of use.
_SHORT = 6


#: Properties beside User Properties that a PUBLISH may have, at the least.
MOST_OTHERS = 16


def read_topic(wire: bytes, version: int) -> tuple[str, str]:
    """The topic of a received message from its bytes with their length, and what is wrong with it;
    that is empty where nothing is.

    What is wrong is not the server's fault, which may pass on what it was sent.

    Raises:
        ProtocolError: there is no topic, or it is not UTF-8 and 3.1.1 is spoken.
    """
    raw, _ = decode_binary(wire, 0)
    if not raw:
        raise ProtocolError(ReasonCode.MALFORMED_PACKET, "a topic must not be empty")
    try:
        topic = raw.decode()
    except UnicodeDecodeError:
        flaw = "a topic must be UTF-8"
        if version != V5:  # [MQTT-1.5.3-1]
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, flaw) from None
        return raw.decode(errors="replace"), flaw
    try:
        check_topic(topic)
    except ValueError as error:
        return topic, str(error)
    return topic, ""


class ClientProtocol(PacketFramer):
    """The client side of one MQTT connection, without I/O, after `connect` was sent.

    `maximum_packet_size` is the limit of a whole packet, in bytes; in version 5 `connect` announces
    it. The limit of topic aliases is the one that `connect` announces. `user_properties` is the
    limit of User Properties in a packet after CONNACK. These are not decoded here.
    """

    def __init__(
        self, connect: Connect, maximum_packet_size: int, user_properties: int = DEFAULT_PAIRS
    ) -> None:
        announced = (connect.properties or {}) if connect.version == V5 else {}
        aliases = announced.get(Property.TOPIC_ALIAS_MAXIMUM, 0)
        assert isinstance(aliases, int)
        super().__init__(
            State.AUTHENTICATING,
            maximum_packet_size,
            aliases,
            user_properties,
            with_identifiers=True,
        )
        self.version = V5 if connect.version == V5 else V311
        self._clean_start = connect.clean_start
        self._is_named = bool(connect.client_id)
        self._method = announced.get(Property.AUTHENTICATION_METHOD)
        #: Whether the client has sent AUTH with Re-authenticate, and has no answer to it yet.
        self.reauthenticating = False
        #: By topic alias, what is wrong with the topic that it stands for.
        self._flaws: dict[int, str] = {}

    def take_pubacks(self, data: bytes) -> tuple[Sequence[int], int, bytes]:
        """The packet ids of the PUBACKs of one form that come first, their reason code, and the
        rest of `data`, which is for `receive_data`.

        The events would be the same. But a server that is sent many messages answers with nothing
        else, Success or No matching subscribers, and these are taken apart all at once.
        """
        nothing = (), 0, data
        if not self._reading or self.state is not State.CONNECTED or self._have >= _SHORT:
            return nothing
        whole = b"".join([*self._chunks, data]) if self._have else data
        head = whole[:2]
        tail = _PUBACKS.get(head)
        if tail is None or (tail and self.version != V5):
            return nothing
        size = 4 + len(tail)
        if self._have >= size:
            return nothing
        total = count = len(whole) // size
        end = total * size
        for place, byte in ((0, head[:1]), (1, head[1:]), (4, tail[:1]), (5, tail[1:])):
            if byte:
                count = min(count, total - len(whole[place:end:size].lstrip(byte)))
        end = count * size
        joined = bytearray(2 * count)
        joined[0::2], joined[1::2] = whole[2:end:size], whole[3:end:size]
        packet_ids = array("H", bytes(joined))
        if sys.byteorder == "little":
            packet_ids.byteswap()
        if not packet_ids or 0 in packet_ids:
            return nothing
        self._chunks.clear()
        self._have = 0
        return packet_ids, tail[0] if tail else 0, whole[end:]

    def _check(self, first: int, size: int) -> None:
        """Raise ProtocolError if a packet of this type or size is not allowed now."""
        if first in _ACKNOWLEDGEMENTS and size <= _SHORT and self.state is State.CONNECTED:
            return
        if self.state is State.AUTHENTICATING and first in _STRANGERS:
            raise ProtocolError(ReasonCode.PROTOCOL_ERROR, _STRANGERS[first])
        check_type(first)
        kind = PacketType(first >> 4)
        if (
            kind not in _LEGAL[self.state]
            or (kind is PacketType.DISCONNECT and self.version != V5)
            or (kind is PacketType.AUTH and self._method is None)  # [MQTT-4.12.0-6]
        ):
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, f"a {kind.name} may not come {self.state.value}"
            )
        if size > self.maximum_packet_size:  # [MQTT-3.1.2-24]
            raise ProtocolError(
                ReasonCode.PACKET_TOO_LARGE,
                f"a packet of {size} bytes, more than the limit of {self.maximum_packet_size}",
            )
        is_new = self.state is State.AUTHENTICATING
        self._check_size(kind, size, MAXIMUM_CONNECT if is_new else MAXIMUM_CONTROL)

    def _decode(self, first: int, body: bytes) -> Packet | int:
        size = len(body)
        if first in _ACKNOWLEDGEMENTS and self.version == V5:
            kind, codes = _ACKNOWLEDGEMENTS[first]
            if (size == 3 or (size == 4 and not body[3])) and body[2] in codes:
                packet_id = body[0] << 8 | body[1]
                if packet_id:
                    return body[2] << 24 | kind | packet_id
        if first >> 4 == PacketType.PUBLISH:
            return self._publish(first, body)
        if first == 0x20 and size == 2 and 1 <= body[1] <= 5 and self.version == V5:
            # A server of 3.1.1 refuses version 5 in its own version: 3.1.1 [MQTT-3.1.2-2].
            self.close()
            return Connack.decode(0, body, V311)
        is_new = self.state is State.AUTHENTICATING
        packet = self._decode_packet(
            first, body, UNAUTHENTICATED_PAIRS if is_new else self.user_properties
        )
        if isinstance(packet, Connack):
            self._on_connack(packet)
        elif isinstance(packet, Auth):
            self._on_auth(packet)
        elif isinstance(packet, Disconnect):
            self.close()  # [MQTT-3.14.4-1]: it sends nothing after it
        return packet

    def _publish(self, first: int, body: bytes) -> Publish:
        try:
            return super()._publish(first, body)
        except ContentError as error:
            return self._unusable(first, body, str(error))

    def _unusable(self, first: int, body: bytes, flaw: str) -> UnusablePublish:
        """A message with a ContentError: an end would let its publisher cut off who reads it."""
        wire, pos = decode_binary(body, 0)
        packet_id = None
        if first & 6:
            packet_id, pos = decode_packet_id(PacketType.PUBLISH, body, pos)
        alias = self._alias_of(body, pos) if self.version == V5 else None
        if not wire and alias is None:
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, "a topic must not be empty")
        topic, topic_flaw = read_topic(body[: 2 + len(wire)], self.version) if wire else ("", "")
        if alias is not None:
            topic = super()._resolve(alias, topic)
            if topic_flaw:
                self._flaws[alias] = topic_flaw
        return UnusablePublish(
            topic, b"", first >> 1 & 3, bool(first & 1), first >= 0x38, packet_id, flaw=flaw
        )

    def _alias_of(self, body: bytes, pos: int) -> int | None:
        """The topic alias of a message that is not decoded; None where it has none."""
        most = self.user_properties + MOST_OTHERS
        self.cost = cost_of(most, len(body))
        try:
            return find_topic_alias(body, pos, len(body), most)
        except ContentError:
            # It may be given a topic behind all these. Messages that use one it had before must not
            # be taken for those of that topic: they end the connection.
            self._aliases.clear()
            self._flaws.clear()
            self._aliased = 0
            return None

    def _resolve(self, alias: int, topic: str) -> str:
        found = super()._resolve(alias, topic)
        if topic:
            self._flaws.pop(alias, None)
        elif alias in self._flaws:
            raise ContentError(ReasonCode.MALFORMED_PACKET, self._flaws[alias])
        return found

    def _on_connack(self, connack: Connack) -> None:
        if connack.reason_code:
            self.close()  # [MQTT-3.2.2-7]: the server closes the connection
            return
        if connack.session_present and self._clean_start:  # [MQTT-3.2.2-1] v5 [MQTT-3.2.2-4]
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, "CONNACK with a session after a clean start"
            )
        properties = connack.properties or {}
        if self.version == V5:
            self._check_method("CONNACK", properties.get(Property.AUTHENTICATION_METHOD))
            if not self._is_named and Property.ASSIGNED_CLIENT_IDENTIFIER not in properties:
                raise ProtocolError(  # [MQTT-3.2.2-16]
                    ReasonCode.PROTOCOL_ERROR, "CONNACK without the client identifier it assigns"
                )
        self.state = State.CONNECTED

    def _on_auth(self, auth: Auth) -> None:
        properties = auth.properties or {}
        self._check_method("AUTH", properties.get(Property.AUTHENTICATION_METHOD))
        if self.state is State.AUTHENTICATING:
            expected = auth.reason_code == ReasonCode.CONTINUE_AUTHENTICATION  # [MQTT-4.12.0-2]
        else:
            # 5.0 section 4.12.1: only the client begins to authenticate again.
            expected = self.reauthenticating and auth.reason_code != ReasonCode.RE_AUTHENTICATE
        if not expected:
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR,
                f"an AUTH with 0x{auth.reason_code:02x} may not come {self.state.value}",
            )
        if auth.reason_code == ReasonCode.SUCCESS:
            self.reauthenticating = False

    def _check_method(self, packet: str, method: object) -> None:
        """Raise ProtocolError if it is not the authentication method of CONNECT."""
        if method != self._method:  # [MQTT-4.12.0-5] [MQTT-4.12.0-6]
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR,
                f"{packet} with another authentication method than CONNECT",
            )
