"""The codec and the framing, fed with damaged packets and streams of them."""

from __future__ import annotations

import random
from collections.abc import Iterable

from inputs import CLIENTS_OWN, Source, chunks, damage

from appliance.mqtt.client_protocol import ClientProtocol
from appliance.mqtt.codec import PacketType, Properties, Property, decode_string, decode_varint
from appliance.mqtt.connection import ServerProtocol
from appliance.mqtt.framing import ALIAS_SIZE, PacketFramer, RawPublish
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Packet,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode

MAXIMUM = 100_000
ALIASES = 10

#: Characters of a packet in a log line.
LINE = 1000

#: What a server sends behind CONNACK.
SERVERS_OWN = (
    PacketType.PUBLISH,
    PacketType.PUBLISH,
    PacketType.PUBACK,
    PacketType.PUBREC,
    PacketType.PUBREL,
    PacketType.PUBCOMP,
    PacketType.SUBACK,
    PacketType.UNSUBACK,
    PacketType.PINGRESP,
    PacketType.DISCONNECT,
)

_ACKNOWLEDGEMENTS = {cls.TYPE: cls for cls in (Puback, Pubrec, Pubrel, Pubcomp)}


class Found(Exception):  # noqa: N818 - it is what is looked for
    """What went wrong, and the bytes that did it."""

    def __init__(self, what: str, *data: bytes) -> None:
        super().__init__(what)
        self.data = data


def one_case(rng: random.Random) -> None:
    """A packet alone, or a stream of them. Raises Found."""
    version = rng.choice((4, 5))
    source = Source(rng)
    if rng.random() < 0.5:
        wire = _any_packet(source, version).encode(version)
        decode_one(wire, version)
        if rng.random() < 0.9:
            other = _any_packet(source, version).encode(version)
            decode_one(damage(rng, wire, other), rng.choice((4, 5)))
        return
    to_client = rng.random() < 0.4
    kinds = SERVERS_OWN if to_client else CLIENTS_OWN
    packets = [source.packet(version, kinds).encode(version) for _ in range(rng.randint(1, 6))]
    if rng.random() < 0.5:
        packets *= 2  # a client that repeats itself is recognised by that
    if rng.random() < 0.7:
        index = rng.randrange(len(packets))
        packets[index] = damage(rng, packets[index], rng.choice(packets))
    read_stream(b"".join(packets), version, rng, to_client=to_client)


def _any_packet(source: Source, version: int) -> Packet:
    kinds = [kind for kind in PacketType if version == 5 or kind is not PacketType.AUTH]
    return source.packet(version, kinds)


def decode_one(wire: bytes, version: int) -> None:
    """The body of a packet is decoded or refused; what was read can be said and read again."""
    if not wire:
        return
    try:
        _, start = decode_varint(wire, 1)
        body = wire[start:]
        packet = decode_packet(wire[0], body, version)
    except ProtocolError as error:
        if error.code < 0x80 or not str(error) or len(str(error)) > LINE:
            raise Found(f"a strange refusal: {error!r}", wire) from None
        return
    except Exception as error:
        raise Found(f"version {version}: {error!r}", wire) from error
    try:
        again = packet.encode(version)
        _, start = decode_varint(again, 1)
        same = decode_packet(again[0], again[start:], version)
        if same != packet:
            raise Found(f"version {version}: {packet} becomes {same}", wire)
        # The shortest form does not grow.
        if len(again[start:]) > len(body) or same.encode(version) != again:
            raise Found(f"version {version}: {wire.hex()} becomes {again.hex()}", wire)
        if len(str(packet)) > LINE:
            raise Found(f"a line of {len(str(packet))} characters", wire)
    except Found:
        raise
    except Exception as error:
        raise Found(f"version {version}, said again: {error!r}", wire) from error


def read_stream(wire: bytes, version: int, rng: random.Random, *, to_client: bool) -> None:
    """However the bytes are cut, they are the same packets and the same end."""
    whole = _read([wire], version, to_client)
    cut = _read(chunks(rng, wire), version, to_client)
    if whole != cut:
        raise Found(f"version {version}: whole it is {whole}, cut it is {cut}", wire)


def _client(version: int) -> ClientProtocol:
    """The client side of a connection, behind CONNACK."""
    aliases: Properties = {Property.TOPIC_ALIAS_MAXIMUM: ALIASES}
    client = ClientProtocol(Connect("client", version=version, properties=aliases), MAXIMUM)
    list(client.receive_data(Connack().encode(version)))
    return client


def _server(version: int) -> ServerProtocol:
    """The server side of a connection, behind the login."""
    server = ServerProtocol(MAXIMUM, ALIASES)
    connect = Source(random.Random(0)).packet(version, [PacketType.CONNECT])
    list(server.receive_data(connect.encode(version)))
    server.accept()
    return server


def _read(parts: Iterable[bytes], version: int, to_client: bool) -> tuple[list[Packet], int]:
    """The packets in it, and the code of the error that ended it, 0 for none."""
    connection: PacketFramer = _client(version) if to_client else _server(version)
    done = b""
    packets: list[Packet] = []
    try:
        for part in parts:
            done += part
            for event in connection.receive_data(part):
                if isinstance(event, tuple):
                    packets.append(_as_publish(event, version, connection))
                elif isinstance(event, int):
                    kind = PacketType(event >> 16 & 0xFF)
                    code = ReasonCode(event >> 24)
                    packets.append(_ACKNOWLEDGEMENTS[kind](event & 0xFFFF, code))
                else:
                    packets.append(event)
        # A topic alias takes more than its bytes: up to four a character, and what is around it.
        if connection.held > 4 * len(done) + ALIASES * (ALIAS_SIZE + 100):
            raise Found(f"{connection.held} bytes are kept", done)
    except ProtocolError as error:
        if list(connection.receive_data(b"\xc0\0")) or connection.held:
            raise Found("it goes on behind its end", done) from None
        return packets, error.code
    except Found:
        raise
    except Exception as error:
        raise Found(f"version {version}: {error!r}", done) from error
    return packets, 0


def _as_publish(event: RawPublish, version: int, connection: PacketFramer) -> Publish:
    """What the short form says; its topic is looked at by who takes it, which ends it here too."""
    first, topic_wire, packet_id, payload, head = event
    body = topic_wire + (packet_id.to_bytes(2, "big") if packet_id else b"")
    body += b"\0" * (version == 5) + payload
    try:
        packet = decode_packet(first, body, version)
    except ProtocolError:
        connection.close()
        raise
    assert isinstance(packet, Publish)
    if head[0] != first or decode_string(topic_wire, 0)[0] != packet.topic:
        raise Found(f"the short form of {packet} is {event}", body)
    return packet
