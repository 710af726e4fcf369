"""The listeners with real sockets: TCP, TLS and Unix, on asyncio's loop and on uvloop's."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import random
import re
import resource
import socket
import ssl
import stat
import time
import tracemalloc
from collections.abc import AsyncIterator
from pathlib import Path
from unittest.mock import Mock

import pytest
import yaml
from both_loops import event_loop_policy as event_loop_policy
from harness import Harness, Peer, make_contexts
from waiting import PATIENCE, until

from appliance import config
from appliance.app import wiring
from appliance.broker.accounts import Accounts
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.limits import Features, Limits
from appliance.broker.link import InsideLink
from appliance.certs.settings import tls_contexts
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Pingreq,
    Pingresp,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
    Will,
)
from appliance.mqtt.reason import ReasonCode
from appliance.net import connection as wire
from appliance.net import lingering, listeners, scheduler, sockets
from appliance.net.listeners import Admission, ListenerSettings

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

MIB = 1 << 20


@pytest.fixture
async def harness(contexts) -> AsyncIterator[Harness]:
    harness = Harness(*contexts)
    harness.broker.tick(asyncio.get_running_loop().time())
    yield harness
    await harness.close()


both = pytest.mark.parametrize("tls", [False, True], ids=["tcp", "tls"])


@both
async def test_a_message_goes_from_one_client_to_another(harness: Harness, tls):
    await harness.start()
    subscriber, publisher = (
        await harness.log_in("sub", tls=tls),
        await harness.log_in("pub", tls=not tls),
    )
    await subscriber.send(Subscribe(1, [Subscription("a", 1)]))
    assert await subscriber.receive() == Suback(1, [1])
    for size in (0, 1, 10_000, 3_000_000):
        message = Publish("a", bytes(size), 1, packet_id=1 + size)
        message.packet_id = 7
        await publisher.send(message)
        assert await publisher.receive() == Puback(7)
        heard = await subscriber.receive()
        assert isinstance(heard, Publish) and len(heard.payload) == size
        await subscriber.send(Puback(heard.packet_id or 0))


@both
async def test_payloads_large_and_small_arrive_in_order(harness: Harness, tls):
    """Small ones are joined with what is around them, large ones are not."""
    await harness.start()
    subscriber = await harness.log_in("subscriber", tls=tls)
    await subscriber.send(Subscribe(1, [Subscription("a", 1)]))
    assert await subscriber.receive() == Suback(1, [1])
    large = 3 * wire.LARGE_PAYLOAD
    sizes = [0, 10, 5000, 10, large, 100_000, 100_000, 10, 0, 200_000, wire.WRITE_PORTION]
    said = [
        Publish("a", random.randbytes(size), 1, packet_id=number)
        for number, size in enumerate(sizes, 1)
    ]
    publisher = await harness.log_in("publisher", tls=tls)
    before = harness.broker.counters.bytes_sent
    for start in (0, 4, 6):
        await publisher.send(*said[start:])
        for packet in said[start:]:
            assert await publisher.receive() == Puback(packet.packet_id)
            heard = await subscriber.receive()
            assert isinstance(heard, Publish) and heard.payload == packet.payload
            await subscriber.send(Puback(heard.packet_id))
    sent = sum(len(packet.encode(5)) + 4 for start in (0, 4, 6) for packet in said[start:])
    assert harness.broker.counters.bytes_sent == before + sent


@both
async def test_bytes_that_drip(harness: Harness, tls):
    """Each byte a segment and a TLS record of its own."""
    await harness.start()
    peer = await harness.dial(tls)
    packets = [Connect("drip"), Subscribe(1, [Subscription("a")]), Publish("a", b"x" * 200)]
    for byte in b"".join(packet.encode(5) for packet in packets):
        await peer.send(bytes((byte,)))
        await asyncio.sleep(0)
    kinds = [type(await peer.receive()) for _ in range(3)]
    assert kinds == [Connack, Suback, Publish]


@both
async def test_packets_behind_connect_wait_for_the_login(harness: Harness, tls):
    harness.gate.clear()
    await harness.start()
    peer = await harness.dial(tls)
    await peer.send(Connect("quick"), Subscribe(1, [Subscription("a")]), Publish("a", b"x"))
    await until(lambda: harness.scheduler.tasks)
    await peer.send(Pingreq())
    assert not harness.broker.sessions
    harness.gate.set()
    kinds = [type(await peer.receive()) for _ in range(4)]
    assert kinds == [Connack, Suback, Publish, Pingresp]


async def test_packets_right_behind_the_tls_handshake(harness: Harness):
    """The client's last flight of the handshake and its CONNECT in one segment."""
    await harness.start()
    loop = asyncio.get_running_loop()
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    tls = harness.client_context.wrap_bio(incoming, outgoing, server_hostname="localhost")
    with socket.socket() as sock:
        sock.setblocking(False)
        await loop.sock_connect(sock, harness.ports[1])
        while True:
            try:
                tls.do_handshake()
                break
            except ssl.SSLWantReadError:
                await loop.sock_sendall(sock, outgoing.read())
                incoming.write(await asyncio.wait_for(loop.sock_recv(sock, 65536), PATIENCE))
        tls.write(Connect("quick").encode() + Subscribe(1, [Subscription("a")]).encode(5))
        tls.write(Publish("a", b"x").encode(5) + Disconnect().encode(5))
        await loop.sock_sendall(sock, outgoing.read())
        heard = b""
        with contextlib.suppress(ssl.SSLZeroReturnError):
            while True:
                try:
                    data = tls.read(65536)
                    heard += data
                    if not data:
                        break
                except ssl.SSLWantReadError:
                    data = await asyncio.wait_for(loop.sock_recv(sock, 65536), PATIENCE)
                    if not data:
                        break
                    incoming.write(data)
    assert [byte for byte in (0x20, 0x90, 0x30) if bytes((byte,)) in heard] == [0x20, 0x90, 0x30]
    assert heard.endswith(Publish("a", b"x").encode(5))


@both
async def test_a_refused_client_hears_why(harness: Harness, tls):
    harness.refused.add("bad")
    await harness.start()
    peer = await harness.dial(tls)
    await peer.send(Connect("bad"), Publish("a", b"x", retain=True))
    assert await peer.receive() == Connack(False, ReasonCode.NOT_AUTHORIZED)
    assert await peer.receive_rest() == b""
    assert len(harness.broker.retained) == 0
    await until(lambda: not harness.scheduler.connections)


@pytest.mark.parametrize("said", [b"", b"\x10", b"\x10\x20\x00\x04MQTT"])
@both
async def test_who_does_not_connect_in_time_is_cut_off(harness: Harness, tls, said, caplog):
    seconds = 3.0 if tls else 0.2  # in which also the handshake is
    await harness.start(connect_timeout=seconds)
    peer = await harness.dial(tls)
    await peer.send(said)
    assert await peer.receive_rest() == b""
    await until(lambda: not harness.scheduler.connections)
    assert f"no complete CONNECT within {seconds:g} s" in caplog.text


async def test_who_does_not_shake_hands_in_time_is_cut_off(harness: Harness):
    await harness.start(connect_timeout=0.2)
    harness.ports[0] = harness.ports[1]
    peer = await harness.dial()  # and not a byte of TLS
    assert await peer.receive_rest() == b""
    await until(lambda: not harness.scheduler.connections and not harness.scheduler.tasks)


async def test_what_is_not_tls_is_told_in_the_log(harness: Harness, caplog):
    await harness.start()
    harness.ports[0] = harness.ports[1]
    peer = await harness.dial()
    await peer.send(Connect("plain"))
    await peer.receive_rest()
    await until(lambda: not harness.scheduler.connections)
    assert "not TLS" in caplog.text
    assert not harness.broker.sessions


async def test_a_slow_login_is_part_of_the_time_to_connect(harness: Harness):
    harness.gate.clear()
    await harness.start(connect_timeout=0.2)
    peer = await harness.dial()
    await peer.send(Connect("slow"))
    assert await peer.receive_rest() == b""
    harness.gate.set()
    await until(lambda: not harness.scheduler.tasks)
    assert not harness.broker.sessions


@both
async def test_connections_over_the_limit_are_refused(harness: Harness, tls, caplog):
    harness.broker.use(Limits(connections=2), Features())
    await harness.start(connections=2)
    first, second = await harness.log_in("1", tls=tls), await harness.log_in("2", tls=tls)
    for _ in range(20):
        assert await _is_refused(harness, tls=tls)
    assert harness.broker.counters.connects_refused == 20
    assert "(broker.limits.connections)" in caplog.text
    first.hang_up()
    await until(lambda: len(harness.scheduler.connections) == 1)
    third = await harness.log_in("3", tls=tls)
    for peer in (second, third):
        await peer.send(Pingreq())
        assert isinstance(await peer.receive(), Pingresp)


@both
async def test_a_slow_reader_is_bounded_and_delays_nobody(harness: Harness, tls):
    """Rule 3 of the design: 100 MB for someone who does not read."""
    await harness.start()
    slow = await harness.log_in("slow", tls=tls, receive_buffer=8192)
    quick = await harness.log_in("quick", tls=tls)
    for peer in (slow, quick):
        await peer.send(Subscribe(1, [Subscription("a")]))
        await peer.receive()
    publisher = await harness.log_in("pub")
    protocol = harness.protocol("slow")
    largest = 0
    for n in range(100):
        await publisher.send(Publish("a", b"%04d" % n + bytes(MIB)), Pingreq())
        assert isinstance(await publisher.receive(), Pingresp)
        heard = await quick.receive()
        assert isinstance(heard, Publish) and heard.payload[:4] == b"%04d" % n
        largest = max(largest, protocol._output_size())
    assert largest < 4 * MIB
    assert len(protocol._client.session.large) == 1  # type: ignore[union-attr]
    numbers = []
    while not numbers or numbers[-1] != 99:
        heard = await slow.receive()
        assert isinstance(heard, Publish)
        numbers.append(int(heard.payload[:4]))
    assert numbers == sorted(set(numbers)) and len(numbers) < 30


@both
async def test_who_asks_and_does_not_read_the_answers_is_bounded(
    harness: Harness, tls, monkeypatch
):
    """Rule 3: it is not listened to until it reads."""
    monkeypatch.setattr(wire, "OUTPUT_HIGH_WATER", 65536)
    await harness.start()
    peer = await harness.log_in("mute", tls=tls)
    protocol = harness.protocol("mute")
    assert protocol._transport is not None
    for end in (protocol._transport, peer.writer):  # little in the system's buffers
        sock = end.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    chunk = Unsubscribe(1, ["x" * 100]).encode(5) * 160
    said = 0
    with contextlib.suppress(asyncio.TimeoutError):
        while said < 1000:
            peer.writer.write(chunk)
            said += 1
            await asyncio.wait_for(peer.writer.drain(), 0.5)
    assert said < 1000, "it was listened to all the time"
    assert protocol._output_size() < MIB
    expected = Unsuback(1, [ReasonCode.NO_SUBSCRIPTION_EXISTED]).encode(5) * (said * 160)
    assert await asyncio.wait_for(peer.reader.readexactly(len(expected)), PATIENCE) == expected
    await peer.send(Subscribe(1, [Subscription("a")]))
    assert isinstance(await peer.receive(), Suback)


@both
async def test_retained_messages_wait_for_a_slow_reader(harness: Harness, tls):
    """Rule 3: a small chunk of SUBSCRIBEs asks for a thousand times a megabyte."""
    await harness.start()
    publisher = await harness.log_in("pub")
    for n in range(20):
        await publisher.send(Publish(f"a/{n}", bytes(MIB), 0, retain=True))
    await publisher.send(Pingreq())
    await publisher.receive()
    greedy = await harness.log_in("greedy", tls=tls, receive_buffer=8192)
    await greedy.send(*[Subscribe(1, [Subscription("a/#")])] * 1000)
    for _ in range(50):
        await publisher.send(Pingreq())
        await publisher.receive()
        assert harness.protocol("greedy")._output_size() < 6 * MIB
    heard = []
    while len(set(heard)) < 20:
        packet = await greedy.receive()
        if isinstance(packet, Publish):
            heard.append(packet.topic)
    assert len(heard) < 60


async def test_a_stranger_is_not_listened_to_during_the_login(harness: Harness):
    """Rule 3: nothing is buffered for who has not logged in, however large the chunks are."""
    harness.gate.clear()
    await harness.start()
    peer = await harness.dial()
    await until(
        lambda: (
            harness.scheduler.connections
            and any(p._transport for p in harness.scheduler.connections)
        )
    )
    (protocol,) = harness.scheduler.connections
    assert protocol._transport is not None
    # One large chunk, as a fast network gives it: after these, reading is paused in any case.
    protocol.data_received(Connect("flood").encode() + bytes(MIB))
    peer.writer.write(bytes(100 * MIB))
    for _ in range(50):
        await asyncio.sleep(0)
        assert not protocol._transport.is_reading()
    assert protocol._client.protocol.held <= MIB
    peer.hang_up()
    harness.gate.set()
    await until(lambda: not harness.scheduler.connections)


@both
async def test_a_client_that_has_no_more_to_say(harness: Harness, tls):
    """Half closed: what it said is done, then the connection ends, and the will is due."""
    await harness.start()
    watcher = await harness.log_in("watcher")
    await watcher.send(Subscribe(1, [Subscription("#")]))
    await watcher.receive()
    peer = await harness.dial(tls)
    await peer.send(
        Connect("brief", will=Will("w", b"gone")), Publish("a", b"x"), Publish("b", b"y" * MIB)
    )
    if tls:
        peer.writer.close()
    else:
        peer.writer.write_eof()
        assert isinstance(await peer.receive(), Connack)
        assert await peer.receive_rest() == b""
    heard = [await watcher.receive() for _ in range(3)]
    assert [packet.topic for packet in heard] == ["a", "b", "w"]  # type: ignore[union-attr]
    await until(lambda: len(harness.scheduler.connections) == 1)


@both
async def test_a_connection_that_breaks(harness: Harness, tls):
    """A reset, at any moment, is a lost connection and nothing else."""
    await harness.start()
    watcher = await harness.log_in("watcher")
    await watcher.send(Subscribe(1, [Subscription("w/#")]))
    await watcher.receive()
    for n, packets in enumerate([[], [Subscribe(1, [Subscription("#")])], [b"\x30\x7f\x00"]]):
        peer = await harness.dial(tls)
        await peer.send(Connect(f"c{n}", will=Will(f"w/{n}", b"gone")))
        await peer.receive()
        await peer.send(*packets)
        peer.writer.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0"
        )
        peer.hang_up()
        heard = await watcher.receive()
        assert isinstance(heard, Publish) and heard.topic == f"w/{n}"
    await until(lambda: len(harness.scheduler.connections) == 1)


def break_packets(protocol: wire.ClientConnection) -> None:
    """Let something that nobody expected escape while the client's next packet is worked on."""
    protocol._client._on_packet = Mock(side_effect=ZeroDivisionError)  # type: ignore[method-assign]


async def overwhelm(harness: Harness, receive_buffer: int) -> Peer:
    """A client, `deaf`, that more was sent to than fits on its way."""
    await harness.start()
    deaf = await harness.log_in("deaf", receive_buffer=receive_buffer)
    await deaf.send(Subscribe(1, [Subscription("a")]))
    await deaf.receive()
    publisher = await harness.log_in("pub")
    for _ in range(10):
        await publisher.send(Publish("a", bytes(MIB)))
    return deaf


@pytest.mark.patches
@pytest.mark.parametrize("why", ["wrong bytes", "a fault"])
async def test_who_does_not_read_the_last_bytes_is_cut_off(
    harness: Harness, monkeypatch, escaped, why
):
    """A closed connection does not stay because its output cannot be written."""
    monkeypatch.setattr(wire, "CLOSE_TIMEOUT", 0.2)
    peer = await overwhelm(harness, receive_buffer=8192)
    await until(lambda: not harness.protocol("deaf")._client.output.writable)
    protocol = harness.protocol("deaf")
    if why == "wrong bytes":
        await peer.send(b"\0\0")
    else:
        break_packets(protocol)
        await peer.send(Pingreq())
        await until(lambda: harness.broker.faults.count)
    await until(lambda: protocol._transport is None, "its connection to be cut")
    await until(lambda: len(harness.scheduler.connections) == 1)
    escaped.clear()


@both
async def test_stop_with_open_clients(harness: Harness, tls):
    await harness.start()
    peers = [await harness.log_in(f"c{n}", tls=tls) for n in range(3)]
    silent = await harness.dial(tls)
    deaf = await harness.log_in("deaf", tls=tls, receive_buffer=8192)
    await deaf.send(Subscribe(1, [Subscription("a")]))
    await deaf.receive()
    for _ in range(10):
        await peers[0].send(Publish("a", bytes(MIB)))
    await peers[0].send(Pingreq())  # all of it has been read, or a reset would be the answer
    assert isinstance(await peers[0].receive(), Pingresp)
    assert not harness.protocol("deaf")._client.output.writable
    await asyncio.wait_for(harness.listeners.stop(), PATIENCE)
    for peer in peers:
        assert await peer.receive() == Disconnect(ReasonCode.SERVER_SHUTTING_DOWN)
        assert await peer.receive_rest() == b""
    assert await silent.receive_rest() == b""
    assert not harness.scheduler.connections and not harness.scheduler.tasks
    with pytest.raises(OSError):
        await harness.dial()
    await harness.listeners.stop()  # again


async def test_stop_during_a_login(harness: Harness):
    harness.gate.clear()
    await harness.start()
    peer = await harness.dial()
    await peer.send(Connect("late"))
    await until(lambda: harness.scheduler.tasks)
    await asyncio.wait_for(harness.listeners.stop(), PATIENCE)
    assert await peer.receive_rest() == b""
    assert not harness.broker.sessions


@pytest.mark.patches
@pytest.mark.parametrize("is_decided", [False, True])
async def test_a_user_who_is_removed_during_the_login(harness: Harness, monkeypatch, is_decided):
    """Its connection is not in a session yet, and was decided by what is no longer so."""
    harness.gate.clear()
    await harness.start()
    peer, other = await harness.dial(), await harness.dial()
    # A login that is decided waits for its turn while the others have much to do.
    monkeypatch.setattr(type(harness.scheduler), "is_busy", lambda _: is_decided)
    monkeypatch.setattr(wire.ClientConnection, "_resume_input_later", lambda _: None)
    await peer.send(Connect("a", username="eve", password=b"secret"))
    await until(lambda: any(each._logging_in for each in harness.scheduler.connections))
    if is_decided:
        harness.gate.set()
        await until(lambda: not any(each._logging_in for each in harness.scheduler.connections))
    for connection in list(harness.scheduler.connections):
        connection.users_removed({"eve"})
    harness.gate.set()
    assert await peer.receive_rest() == b""
    assert not harness.broker.sessions
    assert len(harness.scheduler.connections) == 1, "who has not begun to log in stays"
    other.hang_up()


async def test_an_address_in_use(harness: Harness):
    """Nothing is left listening, and the message names the key."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=rf"127\.0\.0\.1:{port} \(broker\.listeners\)"):
            await harness.listeners.start(
                [ListenerSettings("127.0.0.1", 0, None), ListenerSettings("127.0.0.1", port, None)]
            )
    assert not harness.listeners._sockets


async def test_a_port_moves_to_all_addresses_and_back(harness: Harness):
    """What listens on the port until then does not keep its successor from it, others do."""

    def use(*wanted: ListenerSettings):
        listeners.take(listeners.prepare([*wanted]), [*wanted], listeners.admission)

    listeners = harness.listeners
    ((_, port),) = await listeners.start([ListenerSettings("127.0.0.1", 0, None)])
    harness.ports = [("127.0.0.1", port)]
    early = await harness.log_in("early")
    for host in ("", "0.0.0.0", "127.0.0.1"):
        use(ListenerSettings(host, port, None))
        assert listeners.addresses == [(host, port)]
        await harness.log_in(f"by {host or 'any'}")
        with pytest.raises(OSError, match="in use already"):
            sockets.listen(host, port)
    with socket.create_server(("127.0.0.2", port)), pytest.raises(OSError, match="in use already"):
        use(ListenerSettings("", port, None))
    assert listeners.addresses == [("127.0.0.1", port)]
    await harness.log_in("late")
    await early.send(Pingreq())
    assert isinstance(await early.receive(), Pingresp)


def test_where_nobody_can_listen(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(OSError) as refused:
        sockets.listen("192.0.2.1", 8883)
    assert refused.value.strerror == (
        "cannot listen on 192.0.2.1:8883 (broker.listeners): this computer does not have this "
        "address; 0.0.0.0 is for all that it has"
    )
    unknown = socket.gaierror(socket.EAI_NONAME, "Name or service not known")
    monkeypatch.setattr(socket, "create_server", Mock(side_effect=unknown))
    with pytest.raises(OSError, match="there is no address for 'robot'; name one"):
        sockets.listen("robot", 8883)


async def test_every_address(harness: Harness):
    """An empty host listens on IPv4, and on IPv6 where there is any."""
    ((host, port),) = await harness.listeners.start([ListenerSettings("", 0, None)])
    assert host == ""
    harness.ports = [("127.0.0.1", port)]
    await harness.log_in("four")
    if socket.has_dualstack_ipv6():
        with contextlib.suppress(OSError):  # no loopback address of IPv6 on this computer
            reader, writer = await asyncio.open_connection("::1", port)
            peer = Peer(reader, writer)
            await peer.send(Connect("six"))
            assert isinstance(await peer.receive(), Connack)


async def test_a_take_over_by_the_network(harness: Harness, caplog):
    caplog.set_level(logging.INFO)
    await harness.start()
    first = await harness.log_in("same")
    second = await harness.log_in("same", tls=True)
    assert await first.receive() == Disconnect(ReasonCode.SESSION_TAKEN_OVER)
    assert await first.receive_rest() == b""
    await second.send(Pingreq())
    assert isinstance(await second.receive(), Pingresp)


# --- the end of a connection ---------------------------------------------------------------------


@both
async def test_the_reason_reaches_who_is_still_sending(harness: Harness, tls, monkeypatch):
    """Closed with unread input, a connection is reset: the last packet would be lost."""
    monkeypatch.setattr(lingering, "TIMEOUT", PATIENCE)
    await harness.start()
    peer = await harness.log_in("wrong", tls=tls)
    # Of small packets that may come, many are behind the one that may not.
    peer.writer.write(Connect("again").encode(5) + Pingreq().encode(5) * MIB)
    await asyncio.sleep(0.1)  # a client that is busy with sending
    assert await peer.receive() == Disconnect(ReasonCode.PROTOCOL_ERROR)
    assert await asyncio.wait_for(peer.reader.read(-1), PATIENCE) == b""  # and no reset
    await until(lambda: not harness.scheduler.connections)
    peer.hang_up()
    await until(lambda: not harness.scheduler._lingering)


async def test_a_lingering_close_is_bounded(harness: Harness, monkeypatch):
    """Who neither closes its end nor stops sending is not listened to for long."""
    monkeypatch.setattr(lingering, "TIMEOUT", 0.2)
    monkeypatch.setattr(scheduler, "LINGERING_CLOSES", 2)
    await harness.start()
    peers = [await harness.log_in(f"c{n}") for n in range(4)]
    for peer in peers:
        await peer.send(Connect("again"))
        assert await peer.receive() == Disconnect(ReasonCode.PROTOCOL_ERROR)
    await until(lambda: not harness.scheduler.connections)
    assert len(harness.scheduler._lingering) <= 2
    await until(lambda: not harness.scheduler._lingering)
    monkeypatch.setattr(lingering, "TIMEOUT", PATIENCE)
    monkeypatch.setattr(lingering, "BYTES", MIB)
    peer = await harness.log_in("loud")
    await peer.send(Connect("again"))
    with pytest.raises(ConnectionError):
        for _ in range(100):
            await peer.send(bytes(MIB))


def _leave_abruptly(port: int, context: ssl.SSLContext, data: bytes) -> None:
    """Log in, send, and close without waiting for anything, as mosquitto_pub does."""
    with socket.create_connection(("127.0.0.1", port), PATIENCE) as plain:
        connection = context.wrap_socket(plain, server_hostname="localhost")
        connection.sendall(Connect("brief", will=Will("w", b"gone")).encode(5))
        connection.recv(100)
        connection.sendall(data)
        connection.setblocking(False)
        with contextlib.suppress(ssl.SSLWantReadError):
            connection.unwrap()
        connection.close()


async def test_what_was_said_before_an_abrupt_end_is_done(harness: Harness):
    """uvloop's TLS transport drops what it has received when the connection ends."""
    await harness.start()
    data = Publish("a", bytes(100)).encode(5) * 20_000 + Disconnect().encode(5)
    port = harness.ports[1][1]
    await asyncio.to_thread(_leave_abruptly, port, harness.client_context, data)
    await until(lambda: not harness.scheduler.connections)
    assert harness.broker.counters.publish_received == 20_000  # and no will


# --- what appliance.yaml says ---------------------------------------------------------------------


def test_listeners_of_the_configuration(tmp_path):
    certs = tmp_path / "certs"
    make_contexts(certs)
    text = """
broker:
  listeners:
    - {bind: "127.0.0.1:0", tls: true}
    - {bind: "[::1]:0"}
    - {bind: "127.0.0.1:0", tls: true, protocol: websocket}
    - {bind: "unix:run/mqtt.sock", mode: 0600}
    - {bind: "unix:/run/web.sock", protocol: websocket}
"""
    settings = config.loads(text, tmp_path / "appliance.yaml", {})
    listeners = wiring.listener_settings(settings, tls_contexts(settings.broker))
    tls, plain, web, private, shared = listeners
    assert (plain.host, plain.context, plain.protocol, plain.path) == ("::1", None, "mqtt", None)
    assert tls.context is not None and tls.context().verify_mode == ssl.CERT_OPTIONAL
    # Asked for a certificate that it does not have, a browser gives up.
    assert web.context is not None and web.context().verify_mode == ssl.CERT_NONE
    assert web.protocol == "websocket"
    assert (private.path, private.mode) == (tmp_path / "run/mqtt.sock", 0o600)
    assert (shared.path, shared.mode) == (Path("/run/web.sock"), 0o660)
    assert [str(listener.bind) for listener in settings.broker.listeners][3:] == [
        f"unix:{tmp_path}/run/mqtt.sock",
        "unix:/run/web.sock",
    ]
    assert all(listener.bind.loopback for listener in settings.broker.listeners)
    assert config.loads(yaml.safe_dump(config.describe(settings)), settings.file or tmp_path, {})


@pytest.mark.parametrize(
    ("listener", "problem"),
    [
        ("{bind: 'unix:x', tls: true}", "tls: must be false for a Unix socket"),
        ("{bind: 'unix:x', mode: 660}", "mode: must be 0600, 0660 or 0666"),
        ("{bind: 'unix:x', mode: '0777'}", "mode: must be 0600, 0660 or 0666"),
        ("{bind: 'unix:x', mode: true}", "mode: must be 0600, 0660 or 0666"),
        ("{bind: 'unix:'}", 'bind: must be "host:port"'),
        ("{bind: ':1', protocol: ws}", "protocol: must be mqtt, websocket or web"),
        ("{bind: 'unix:x'}, {bind: 'unix:./x'}", "bind: broker.listeners[0] listens there already"),
    ],
)
def test_what_is_no_listener(listener, problem, tmp_path):
    with pytest.raises(config.ConfigError) as refused:
        config.loads(f"broker: {{listeners: [{listener}]}}", tmp_path / "appliance.yaml", {})
    assert problem in str(refused.value)


# --- Unix sockets --------------------------------------------------------------------------------


async def _dial_path(harness: Harness, path: Path) -> Peer:
    peer = Peer(*await asyncio.open_unix_connection(path))
    harness.peers.append(peer)
    return peer


async def test_a_unix_socket(harness: Harness, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    path = tmp_path / "mqtt.sock"
    harness.make(connections_per_address=1)
    umask = os.umask(0o077)
    try:
        addresses = await harness.listeners.start([ListenerSettings("", 0, None, path=path)])
    finally:
        os.umask(umask)
    assert addresses == [(f"unix:{path}", 0)]
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    peers = [await _dial_path(harness, path) for _ in range(3)]  # not counted an address
    for number, peer in enumerate(peers):
        await peer.send(Connect(f"c{number}"), Subscribe(1, [Subscription("a")]))
        assert isinstance(await peer.receive(), Connack)
        assert isinstance(await peer.receive(), Suback)
    await peers[0].send(Publish("a", b"x" * MIB))
    for peer in peers:
        heard = await peer.receive()
        assert isinstance(heard, Publish) and len(heard.payload) == MIB
    # Each is told apart by a number in the place of a port.
    where = re.findall(rf"client 'c\d' \(anonymous\) at unix:{path}:(\d+) connected", caplog.text)
    assert len(set(where)) == 3
    for peer in peers:
        peer.hang_up()
    await harness.listeners.stop()
    assert not path.exists()


async def test_the_mode_of_a_unix_socket(harness: Harness, tmp_path):
    path = tmp_path / "mqtt.sock"
    await harness.listeners.start([ListenerSettings("", 0, None, path=path, mode=0o600)])
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


async def test_a_unix_socket_that_was_left_is_replaced(harness: Harness, tmp_path):
    path = tmp_path / "mqtt.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
        left.listen()
    await harness.listeners.start([ListenerSettings("", 0, None, path=path)])
    peer = await _dial_path(harness, path)
    await peer.send(Connect("here"))
    assert isinstance(await peer.receive(), Connack)


async def test_a_unix_socket_in_use_is_left_alone(harness: Harness, tmp_path):
    path = tmp_path / "mqtt.sock"
    wanted = [ListenerSettings("", 0, None, path=path)]
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(OSError, match=rf"unix:{path} \(broker\.listeners\): another process"):
            await harness.listeners.start(wanted)
        assert path.exists()
    path.unlink()
    path.write_text("precious")
    with pytest.raises(OSError, match="a file that is no socket"):
        await harness.listeners.start(wanted)
    assert path.read_text() == "precious"
    with pytest.raises(OSError, match="No such file or directory"):
        nowhere = ListenerSettings("", 0, None, path=tmp_path / "nowhere/mqtt.sock")
        await harness.listeners.start([nowhere])


async def test_another_ones_unix_socket_is_not_removed(harness: Harness, tmp_path):
    path = tmp_path / "mqtt.sock"
    await harness.listeners.start([ListenerSettings("", 0, None, path=path)])
    path.unlink()
    path.write_text("another's")
    await harness.listeners.stop()
    assert path.read_text() == "another's"


# --- limits of connections -----------------------------------------------------------------------


async def _is_refused(harness: Harness, user: str | None = None, *, tls: bool = False) -> bool:
    try:
        peer = await harness.dial(tls)
        await peer.send(Connect("one-more", username=user))
        answer = await peer.receive()
        peer.hang_up()
        assert isinstance(answer, Connack)
        return answer.reason_code == ReasonCode.QUOTA_EXCEEDED
    except (OSError, asyncio.IncompleteReadError):
        return True


async def test_connections_from_one_address(harness: Harness, caplog):
    await harness.start(connections_per_address=2)
    peers = [await harness.log_in(f"c{n}") for n in range(2)]
    assert await _is_refused(harness)
    assert harness.broker.counters.connects_refused == 1
    assert "refused: its address has 2 connections of its user" in caplog.text
    assert "broker.limits.connections_per_address" in caplog.text
    peers[0].hang_up()
    await until(lambda: len(harness.scheduler.connections) == 1)
    assert not await _is_refused(harness)


@pytest.mark.patches
async def test_a_fault_before_a_commit_leaves_no_guest_for_ever(harness: Harness, escaped):
    """The last bytes are written at the commit, when the fault is long over; or not at all."""
    await harness.start(connections_per_address=2)
    store = harness.broker.store
    store.hurry = lambda: None  # type: ignore[method-assign]
    for n in range(3):
        peer = await harness.log_in(f"c{n}")
        protocol = harness.protocol(f"c{n}")
        break_packets(protocol)
        store.staged, store.batch, store.committed = True, 5, 4
        protocol._client.output.batch = 5
        await peer.send(Pingreq())
        await until(lambda count=n + 1: harness.broker.faults.count == count)
        if n == 2:
            protocol._forget()  # it has ended already
        store.committed, store.staged = 5, False
        harness.broker._committed(True)
        peer.hang_up()
        await until(lambda: not harness.scheduler.connections)
        assert harness.listeners._addresses.oldest_guest() is None
    escaped.clear()


async def _say_who(peer: Peer, client_id: str, user: str) -> None:
    await peer.send(Connect(client_id, username=user))
    answer = await peer.receive()
    assert isinstance(answer, Connack) and answer.reason_code == ReasonCode.SUCCESS


async def test_what_a_user_has_from_one_address_keeps_no_other_out(harness: Harness):
    await harness.start(connections_per_address=2)
    for number in range(2):
        await _say_who(await harness.dial(), f"m{number}", "mallory")
    assert await _is_refused(harness, "mallory")
    await until(lambda: len(harness.scheduler.connections) == 2)
    await _say_who(await harness.dial(), "alice", "alice")


async def test_what_a_user_has_of_all_connections_keeps_no_other_out(harness: Harness):
    harness.broker.use(Limits(connections=3), Features())
    await harness.start(connections=3)
    crowd = [await harness.dial() for _ in range(3)]
    for number, peer in enumerate(crowd):
        await _say_who(peer, f"m{number}", "mallory")
    assert await _is_refused(harness, "mallory")
    await _say_who(await harness.dial(), "alice", "alice")
    lingering = await crowd[2].receive()
    assert isinstance(lingering, Disconnect) and lingering.reason_code == ReasonCode.QUOTA_EXCEEDED
    await crowd[0].send(Pingreq())
    assert isinstance(await crowd[0].receive(), Pingresp)


@both
async def test_strangers_keep_nobody_out(harness: Harness, monkeypatch, caplog, tls):
    """Neither those who say nothing, nor those in the middle of their TLS handshake."""
    monkeypatch.setattr(listeners, "GUESTS", 4)
    monkeypatch.setattr(listeners, "HANDSHAKES", 1000)
    await harness.start(connections=2)
    for _ in range(3):  # more than there is room for
        for _ in range(4):
            sock = socket.socket()
            sock.setblocking(False)
            harness.raw_sockets.append(sock)
            await asyncio.get_running_loop().sock_connect(sock, harness.ports[tls])
        await until(lambda: harness.scheduler.connections)
        (await harness.log_in("alice", tls=tls)).hang_up()
        await until(lambda: not harness.broker.clients)
    assert len(harness.scheduler.connections) <= 5
    assert "makes room for others" in caplog.text
    await until(lambda: len(harness.scheduler.tasks) <= 5)


async def test_new_connections_from_one_address(harness: Harness, caplog):
    """Bursts of five times the rate, then no more than the rate."""
    await harness.start(connection_rate=4)
    allowed, began = 0, time.monotonic()
    while not await _is_refused(harness):
        allowed += 1
        assert allowed < 100, "it is never refused"
    assert 20 <= allowed <= 21 + 4 * (time.monotonic() - began)
    assert "opens more than 4 connections a second" in caplog.text
    assert "broker.limits.connection_rate" in caplog.text
    refused = harness.broker.counters.connections_refused
    assert refused >= 1
    await asyncio.sleep(0.3)
    assert not await _is_refused(harness)


class Neighbour:
    """A connection, as far as the addresses look at it."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.account = Accounts().strangers


def come(addresses: listeners._AddressLimits, host: str, now: float) -> Neighbour | None:
    """A connection that has not logged in; None when it is refused."""
    if addresses.reserve(host, now):
        return None
    member = Neighbour(host)
    addresses.add_guest(member)
    return member


def test_what_counts_as_one_address():
    addresses = listeners._AddressLimits(Admission(9, 9, 1, 100))
    assert come(addresses, "192.0.2.1", 0)
    assert not come(addresses, "192.0.2.1", 0)
    assert not come(addresses, "::ffff:192.0.2.1", 0)  # the same, on a listener for both
    assert come(addresses, "192.0.2.2", 0)
    assert come(addresses, "::ffff:192.0.2.3", 0)
    member = come(addresses, "2001:db8:1:2::1", 0)
    assert member is not None
    assert not come(addresses, "2001:db8:1:2:ffff::5", 0)  # the same network of 64 bits
    assert come(addresses, "2001:db8:1:3::1", 0)
    assert come(addresses, "fe80::1%eth0", 0)
    addresses.ended(member)
    assert come(addresses, "2001:db8:1:2:ffff::5", 0)


def test_each_user_is_counted_for_itself():
    addresses, accounts = listeners._AddressLimits(Admission(9, 9, 2, 1000)), Accounts()
    members = []
    for user, allowed in (("mallory", [1, 1, 0]), ("alice", [1, 1, 0]), (None, [1, 1, 0])):
        account = accounts.of_user(user)
        for may in allowed:
            member = come(addresses, "192.0.2.1", 0)
            assert member is not None
            assert (not addresses.admit(member, account)) == may
            if may:
                member.account = account
                members.append(member)
            else:
                addresses.ended(member)
    for member in members:
        addresses.closing(member)
    assert addresses.oldest_guest() is members[0]
    for member in members:
        addresses.ended(member)
    addresses._evict_idle(1000.0)
    assert not addresses._known


def test_idle_addresses_are_forgotten():
    addresses = listeners._AddressLimits(Admission(9, 9, 10, 10))
    for number in range(100_000):
        host = f"2001:db8:{number >> 16:x}:{number & 0xFFFF:x}::1"
        member = come(addresses, host, number * 0.001)
        assert member is not None
        addresses.ended(member)
    assert len(addresses._known) <= 2 * listeners.ADDRESSES
    # And those that are not idle stay: 500 connections, each of an address that has had its share.
    for number in range(500):
        for _ in range(10):
            come(addresses, f"10.0.{number >> 8}.{number & 255}", 200.0)
    for number in range(10_000):
        member = come(addresses, f"2001:db8:{number:x}::1", 200.0 + number)
        assert member is not None
        addresses.ended(member)
    for number in range(500):
        assert not come(addresses, f"10.0.{number >> 8}.{number & 255}", 20_000.0)


def test_files_that_may_be_open(monkeypatch, caplog):
    limits = [(1024, 4096)]
    monkeypatch.setattr(resource, "getrlimit", lambda what: limits[-1])
    monkeypatch.setattr(resource, "setrlimit", lambda what, pair: limits.append(pair))
    sockets.allow_files(1000)
    assert limits == [(1024, 4096)]
    sockets.allow_files(2000)
    assert limits[-1] == (2000, 4096) and not caplog.text
    sockets.allow_files(10_000)
    assert limits[-1] == (4096, 4096)
    assert "needs 10000 open files, and the system allows 4096" in caplog.text
    limits.append((1024, resource.RLIM_INFINITY))
    sockets.allow_files(10_000)
    assert limits[-1] == (10_000, resource.RLIM_INFINITY)


# --- TLS handshakes ------------------------------------------------------------------------------


async def test_strangers_in_a_handshake_do_not_keep_others_out(harness: Harness, monkeypatch):
    """They hold every place that there is, and say nothing."""
    monkeypatch.setattr(listeners, "HANDSHAKES", 4)
    await harness.start(connect_timeout=600)
    silent = [await asyncio.open_connection(*harness.ports[1]) for _ in range(10)]
    peer = await harness.log_in("honest", tls=True)
    await peer.send(Pingreq())
    assert isinstance(await peer.receive(), Pingresp)
    for _, writer in silent:
        writer.transport.abort()


async def test_handshakes_at_a_time(harness: Harness, monkeypatch):
    """More than that wait to be accepted, and all of them get in."""
    monkeypatch.setattr(listeners, "HANDSHAKES", 3)
    most = 0
    await harness.start()
    begin = harness.listeners._begin

    async def count(*arguments) -> None:
        nonlocal most
        most = max(most, len(harness.listeners._handshakes))
        await begin(*arguments)

    monkeypatch.setattr(harness.listeners, "_begin", count)
    peers = await asyncio.gather(*(harness.log_in(f"c{n}", tls=True) for n in range(30)))
    assert most == 3
    assert len(harness.broker.clients) == 30
    plain = await harness.log_in("plain")
    for peer in (*peers, plain):
        peer.hang_up()


# --- limits of what is sent ----------------------------------------------------------------------


@both
async def test_publishes_over_the_rate_are_read_later(harness: Harness, tls):
    """None is lost, nobody is cut off, and others are not slowed."""
    await harness.start(publish_rate=400)
    loop = asyncio.get_running_loop()
    subscriber, eager = await harness.log_in("sub"), await harness.log_in("eager", tls=tls)
    await subscriber.send(Subscribe(1, [Subscription("a")]))
    await subscriber.receive()
    calm = await harness.log_in("calm", tls=tls)
    began = loop.time()
    await eager.send(*(Publish("a", b"%d" % number) for number in range(1000)))
    for number in range(1000):
        heard = await subscriber.receive()
        assert isinstance(heard, Publish) and heard.payload == b"%d" % number
        if number == 700:
            await calm.send(Publish("b", b"", 1, packet_id=1))
            assert isinstance(await calm.receive(), Puback)
    # A second's worth may come at once.
    assert 0.6 < loop.time() - began < 6


async def test_a_rate_holds_for_the_smallest_messages(harness: Harness):
    """Thousands are in one chunk: they are not taken as one."""
    await harness.start(publish_rate=100)
    peer = await harness.log_in("tiny")
    counters = harness.broker.counters
    began = time.monotonic()
    await peer.send(Publish("a", b"").encode(5) * 5000)
    await until(lambda: counters.publish_received)
    for _ in range(8):
        assert counters.publish_received <= 200 + 100 * (time.monotonic() - began)
        await asyncio.sleep(0.1)
    peer.hang_up()


async def test_what_is_cut_in_portions_stays_in_order(harness: Harness, monkeypatch):
    monkeypatch.setattr(scheduler, "LARGEST_PORTION", 16)
    await harness.start()
    peer = await harness.log_in("self")
    await peer.send(Subscribe(1, [Subscription("#")]))
    await peer.receive()
    sizes = [0, 5, 100, 3, 2000, 1, 70_000, 8, 8, 8, 300_000, 0]
    await peer.send(*(Publish(f"a/{n}", bytes(size)) for n, size in enumerate(sizes)))
    for n, size in enumerate(sizes):
        heard = await peer.receive()
        assert isinstance(heard, Publish)
        assert (heard.topic, len(heard.payload)) == (f"a/{n}", size)


@both
async def test_a_flood_of_small_packets_leaves_others_their_turn(harness: Harness, tls):
    await harness.start()
    flood, other = await harness.log_in("flood", tls=tls), await harness.log_in("other", tls=tls)
    count = 50_000
    flood.writer.write(Publish("a", b"").encode(5) * count)
    received = harness.broker.counters
    await until(lambda: received.publish_received)
    answers = 0
    while received.publish_received < count:
        await other.send(Pingreq())
        assert isinstance(await other.receive(), Pingresp)
        answers += 1
    assert answers > 10  # in chunks as they are received, it would be two or three


# --- memory --------------------------------------------------------------------------------------


@pytest.fixture
async def small_house(contexts) -> AsyncIterator[Harness]:
    harness = Harness(*contexts, Limits(memory=8 * MIB))
    harness.broker.tick(asyncio.get_running_loop().time())
    yield harness
    await harness.close()


@both
async def test_the_output_of_slow_readers_is_counted(small_house: Harness, tls):
    """And it is bounded in all: not a megabyte for each of them."""
    harness = small_house
    await harness.start()
    readers = [await harness.log_in(f"r{n}", tls=tls, receive_buffer=4096) for n in range(20)]
    for number, reader in enumerate(readers):
        protocol = harness.protocol(f"r{number}")
        assert protocol._transport is not None
        protocol._transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, 4096
        )
        await reader.send(Subscribe(1, [Subscription("a")]))
        await reader.receive()
    publisher = await harness.log_in("pub")
    for _ in range(150):
        await publisher.send(Publish("a", bytes(20_000)), Pingreq())
        assert isinstance(await publisher.receive(), Pingresp)
    accounting = harness.broker.accounting
    protocols = [harness.protocol(f"r{number}") for number in range(20)]
    waiting = sum(protocol._output_size() for protocol in protocols)
    assert harness.scheduler.output >= waiting > 0
    assert accounting.queued_bytes >= waiting
    assert waiting < 3 * MIB
    for reader in readers:
        reader.hang_up()


@both
async def test_a_large_message_is_not_copied_for_everyone(harness: Harness, tls):
    await harness.start()
    readers = [await harness.log_in(f"r{n}", tls=tls, receive_buffer=4096) for n in range(20)]
    for reader in readers:
        await reader.send(Subscribe(1, [Subscription("a", 1)]))
        await reader.receive()
    publisher = await harness.log_in("pub")
    tracemalloc.start()
    try:
        message = Publish("a", bytes(8 * MIB), 1, packet_id=1)
        await publisher.send(message, Publish("a", b"and a small one"))
        assert isinstance(await publisher.receive(), Puback)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 8 * MIB <= harness.scheduler.output < 15 * MIB
    assert most < 60 * MIB  # our own end, the stream's buffer and the chunks, joined
    for reader in readers[1:]:
        reader.hang_up()
    heard = await readers[0].receive()
    assert isinstance(heard, Publish) and len(heard.payload) == 8 * MIB
    heard = await readers[0].receive()
    assert isinstance(heard, Publish) and heard.payload == b"and a small one"


async def test_publishers_are_slowed_while_memory_is_short(small_house: Harness, caplog):
    """Nobody is cut off, and a publisher that is slowed still gets its answers."""
    harness = small_house
    await harness.start()
    publisher = await harness.log_in("pub")
    accounting = harness.broker.accounting
    loop = asyncio.get_running_loop()

    async def publish(count: int, size: int) -> float:
        began = loop.time()
        for number in range(count):
            await publisher.send(Publish("a", bytes(size), 1, packet_id=1 + number))
            assert isinstance(await publisher.receive(), Puback)
        return loop.time() - began + 0.001  # uvloop counts in milliseconds

    await publish(10, 20_000)
    accounting.queued_bytes += 7 * MIB
    try:
        assert await publish(10, 20_000) > 9 * wire.SHORT_OF_MEMORY_PAUSE
        assert await publish(5 * scheduler.FEW_MESSAGES, 5) > 4 * wire.SHORT_OF_MEMORY_PAUSE
        assert "is slowed" in caplog.text and "broker.limits.memory" in caplog.text
        reader = await harness.log_in("reader")
        took = []
        for _ in range(3):  # a busy computer may stand still in one of them
            began = loop.time()
            for _ in range(50):
                await reader.send(Pingreq())
                await reader.receive()
            took.append(loop.time() - began)
        assert min(took) < 25 * wire.SHORT_OF_MEMORY_PAUSE
    finally:
        accounting.queued_bytes -= 7 * MIB


async def test_who_stays_slow_is_told_in_the_log(harness: Harness, monkeypatch, caplog):
    monkeypatch.setattr(wire, "SLOW_AFTER", 0.05)
    deaf = await overwhelm(harness, receive_buffer=4096)
    await until(lambda: "client 'deaf' (anonymous)" in caplog.text)
    assert "does not read" in caplog.text
    deaf.hang_up()


@pytest.mark.parametrize("tls", [False, True])
@pytest.mark.parametrize(
    "said",
    [
        b"",
        Connect("a").encode(5)[:-2],
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x10\xff\xff\xff\xff\x7f",
        Connect("a").encode(5),
        Connect("a").encode(5) + b"\x30\x05\x00",
        Connect("a").encode(5) + b"\x30\x02\x00\x01",
        Connect("a").encode(5) + Disconnect(0).encode(5),
        Connect("refused").encode(5),
    ],
    ids=[
        "nothing",
        "a part of a CONNECT",
        "HTTP",
        "no length",
        "a client",
        "a part of a packet",
        "a wrong packet",
        "a client that leaves",
        "a refused one",
    ],
)
async def test_the_memory_of_a_connection_is_free_at_once(harness: Harness, tls: bool, said: bytes):
    harness.refused.add("refused")
    await harness.start()
    await harness.expect_free_memory(said, tls)


async def test_clients_whose_certificates_are_refused_are_closed_in_pieces(harness: Harness):
    """By what that costs, such as their wills: sixteen at once, as it was, took 70 ms."""
    await harness.start()
    for number in range(COST_PER_TURN):
        reader = harness.broker.attach(f"reader{number}", InsideLink())
        assert harness.broker.subscribe(reader, Subscription("w", 0))[0] == 0
    count = 6
    names = [f"c{number}" for number in range(count)]
    peers = []
    for name in names:
        peers.append(await harness.dial(tls=True))
        await peers[-1].send(Connect(name, will=Will("w", b"")))
        assert isinstance(await peers[-1].receive(), Connack)
    harness.scheduler.certificates = Mock(refusal=lambda tls: "revoked")
    costs = []
    task = harness.scheduler.in_background(harness.listeners.check_certificates())
    while not task.done():
        begun = harness.broker.counters.cost
        await asyncio.sleep(0)
        costs.append(harness.broker.counters.cost - begun)
    assert max(costs) < 2.5 * COST_PER_TURN and sum(costs) > count * COST_PER_TURN
    for peer in peers:
        assert (await peer.receive()).reason_code == ReasonCode.NOT_AUTHORIZED
    for number in range(COST_PER_TURN):
        harness.broker.detach(harness.broker.sessions[f"reader{number}"])


async def test_to_check_certificates_costs(harness: Harness):
    await harness.start()
    for number in range(3):
        await harness.log_in(f"c{number}", tls=True)
    await harness.log_in("plain")
    harness.scheduler.certificates = Mock(refusal=lambda tls: "")
    begun = harness.broker.counters.cost
    await harness.listeners.check_certificates()
    assert (
        3 * wire.CERTIFICATE_COST
        <= harness.broker.counters.cost - begun
        < 4 * wire.CERTIFICATE_COST
    )
