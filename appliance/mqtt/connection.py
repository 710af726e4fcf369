"""The server side of one MQTT connection: which packets a client may send when, and how large.

`ServerProtocol` takes received bytes and yields events, see `PacketFramer`.
"""

from __future__ import annotations

from appliance.mqtt.codec import V31, V311, PacketType, Property
from appliance.mqtt.framing import (
    DEFAULT_PAIRS,
    MAXIMUM_CONNECT,
    MAXIMUM_CONTROL,
    UNAUTHENTICATED_PAIRS,
    PacketFramer,
    State,
    check_type,
)
from appliance.mqtt.packets import Connect, Packet
from appliance.mqtt.reason import ProtocolError, ReasonCode

#: How the variable header of a CONNECT of MQTT 5 begins.
_MQTT_5 = b"\0\4MQTT\5"

# The packets that a client may send in each state; any other is a protocol error (0x82).
# [MQTT-3.1.0-1], [MQTT-3.1.0-2]
_LEGAL: dict[State, frozenset[PacketType]] = {
    State.NEW: frozenset({PacketType.CONNECT}),
    # [MQTT-3.1.2-30]
    State.AUTHENTICATING: frozenset({PacketType.AUTH, PacketType.DISCONNECT}),
    State.CONNECTED: frozenset(
        {
            PacketType.PUBLISH,
            PacketType.PUBACK,
            PacketType.PUBREC,
            PacketType.PUBREL,
            PacketType.PUBCOMP,
            PacketType.SUBSCRIBE,
            PacketType.UNSUBSCRIBE,
            PacketType.PINGREQ,
            PacketType.DISCONNECT,
            PacketType.AUTH,
        }
    ),
    State.CLOSED: frozenset(),
}


#: The required flags of the fixed header, where they are not 0 (section 2.2.2).
_FLAGS_OF_V311 = {
    int(kind): 2 for kind in (PacketType.PUBREL, PacketType.SUBSCRIBE, PacketType.UNSUBSCRIBE)
}

_FLAGLESS = frozenset({PacketType.SUBACK, PacketType.UNSUBACK, PacketType.PINGRESP})


class ServerProtocol(PacketFramer):
    """The server side of one MQTT connection, without I/O.

    `maximum_packet_size` is the limit of a whole packet, in bytes, after the login;
    `topic_alias_maximum` is the value that CONNACK announces to a version 5 client;
    `user_properties` is the limit of User Properties in a packet after the login. These are not
    decoded here.
    """

    def __init__(
        self,
        maximum_packet_size: int,
        topic_alias_maximum: int,
        user_properties: int = DEFAULT_PAIRS,
    ) -> None:
        super().__init__(
            State.NEW,
            maximum_packet_size,
            topic_alias_maximum,
            user_properties,
            with_identifiers=False,
        )
        #: Whether it is MQTT 3.1, where the first byte of any packet may contain DUP and QoS.
        self._is_v31 = False
        #: Whether its CONNECT has an authentication method, so that AUTH is allowed.
        self.authenticates = False

    def forget_connect(self) -> None:
        """The login is over: what is stored of the CONNECT is counted elsewhere."""
        self._connecting = 0

    def accept(self) -> None:
        """The client has logged in; `receive_data(b"")` yields the events of the buffered input."""
        self.state = State.CONNECTED
        self._reading = True
        self._connecting = 0

    def _check(self, first: int, size: int) -> None:
        """Raise ProtocolError if a packet of this type or size is not allowed now."""
        check_type(first)
        kind = PacketType(first >> 4)
        if self.state is State.NEW and first == 0x16:
            raise ProtocolError(
                ReasonCode.MALFORMED_PACKET,
                "what it sends is TLS; is it meant for the listener with tls: true?",
            )
        if self.state is State.NEW and first == 0x47:  # the G of GET
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR,
                "what it sends is HTTP; is it meant for a listener with protocol: websocket?",
            )
        if kind in _FLAGLESS and first & 0x0F:
            # Checked before the packet type is, as in mosquitto.
            raise ProtocolError(ReasonCode.MALFORMED_PACKET, f"a {kind.name} with reserved flags")
        if kind not in _LEGAL[self.state] or (
            kind is PacketType.AUTH and not self.authenticates  # [MQTT-4.12.0-7]
        ):
            raise ProtocolError(
                ReasonCode.PROTOCOL_ERROR, f"a {kind.name} may not come {self.state.value}"
            )
        if size > self.maximum_packet_size:
            raise ProtocolError(
                ReasonCode.PACKET_TOO_LARGE,
                f"a packet of {size} bytes, more than the limit of "
                f"{self.maximum_packet_size} (broker.limits.packet_size)",
            )
        limit = MAXIMUM_CONNECT if kind is PacketType.CONNECT else MAXIMUM_CONTROL
        self._check_size(kind, size, limit)

    def _decode(self, first: int, body: bytes) -> Packet:
        if first >> 4 == PacketType.PUBLISH:
            return self._publish(first, body)
        if first >> 4 == PacketType.CONNECT and body[:7] == _MQTT_5:
            self.version = 5  # so that an error in the rest can be answered
        if self._is_v31:
            first = first & 0xF0 | _FLAGS_OF_V311.get(first >> 4, 0)
        most = self.user_properties if self.state is State.CONNECTED else UNAUTHENTICATED_PAIRS
        packet = self._decode_packet(first, body, most)
        if isinstance(packet, Connect):
            self._is_v31 = packet.version == V31
            self.version = V311 if self._is_v31 else packet.version
            self.state = State.AUTHENTICATING
            self._connecting = len(body)
            self.authenticates = Property.AUTHENTICATION_METHOD in (packet.properties or {})
        return packet
