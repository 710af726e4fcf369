"""The listeners with real sockets: TCP, TLS and Unix, on asyncio's loop and on uvloop's."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
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
import uvloop
import yaml
from house import Caller, House, make_contexts
from waiting import PATIENCE, until

from appliance import config
from appliance.app import wiring
from appliance.broker.accounts import Accounts
from appliance.broker.ports import Features, Limits
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
from appliance.net import lingering as farewell
from appliance.net import listeners, sockets
from appliance.net import scheduler as network
from appliance.net.listeners import Admission, ListenerSettings

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

MIB = 1 << 20


@pytest.fixture(
    scope="module",
    params=[asyncio.DefaultEventLoopPolicy(), uvloop.EventLoopPolicy()],
    ids=["asyncio", "uvloop"],
)
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    return request.param  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def contexts(tmp_path_factory: pytest.TempPathFactory) -> tuple[ssl.SSLContext, ssl.SSLContext]:
    """The server's and the client's settings for TLS."""
    return make_contexts(tmp_path_factory.mktemp("certs") / "certs")


@pytest.fixture
async def house(contexts) -> AsyncIterator[House]:
    house = House(*contexts)
    house.broker.tick(asyncio.get_running_loop().time())
    yield house
    await house.close()


both = pytest.mark.parametrize("tls", [False, True], ids=["tcp", "tls"])


@both
async def test_a_message_goes_from_one_client_to_another(house: House, tls):
    await house.start()
    subscriber, publisher = await house.join("sub", tls=tls), await house.join("pub", tls=not tls)
    await subscriber.say(Subscribe(1, [Subscription("a", 1)]))
    assert await subscriber.hear() == Suback(1, [1])
    for size in (0, 1, 10_000, 3_000_000):
        message = Publish("a", bytes(size), 1, packet_id=1 + size)
        message.packet_id = 7
        await publisher.say(message)
        assert await publisher.hear() == Puback(7)
        heard = await subscriber.hear()
        assert isinstance(heard, Publish) and len(heard.payload) == size
        await subscriber.say(Puback(heard.packet_id or 0))


@both
async def test_bytes_that_drip(house: House, tls):
    """Each byte a segment and a TLS record of its own."""
    await house.start()
    caller = await house.dial(tls)
    packets = [Connect("drip"), Subscribe(1, [Subscription("a")]), Publish("a", b"x" * 200)]
    for byte in b"".join(packet.encode(5) for packet in packets):
        await caller.say(bytes((byte,)))
        await asyncio.sleep(0)
    kinds = [type(await caller.hear()) for _ in range(3)]
    assert kinds == [Connack, Suback, Publish]


@both
async def test_packets_behind_connect_wait_for_the_login(house: House, tls):
    house.gate.clear()
    await house.start()
    caller = await house.dial(tls)
    await caller.say(Connect("quick"), Subscribe(1, [Subscription("a")]), Publish("a", b"x"))
    await until(lambda: house.network.tasks)
    await caller.say(Pingreq())
    assert not house.broker.sessions
    house.gate.set()
    kinds = [type(await caller.hear()) for _ in range(4)]
    assert kinds == [Connack, Suback, Publish, Pingresp]


async def test_packets_right_behind_the_tls_handshake(house: House):
    """The client's last flight of the handshake and its CONNECT in one segment."""
    await house.start()
    loop = asyncio.get_running_loop()
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    tls = house.client_context.wrap_bio(incoming, outgoing, server_hostname="localhost")
    with socket.socket() as sock:
        sock.setblocking(False)
        await loop.sock_connect(sock, house.ports[1])
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
async def test_a_refused_client_hears_why(house: House, tls):
    house.refused.add("bad")
    await house.start()
    caller = await house.dial(tls)
    await caller.say(Connect("bad"), Publish("a", b"x", retain=True))
    assert await caller.hear() == Connack(False, ReasonCode.NOT_AUTHORIZED)
    assert await caller.hear_the_end() == b""
    assert len(house.broker.retained) == 0
    await until(lambda: not house.network.open)


@pytest.mark.parametrize("said", [b"", b"\x10", b"\x10\x20\x00\x04MQTT"])
@both
async def test_who_does_not_connect_in_time_is_cut_off(house: House, tls, said, caplog):
    await house.start(connect_timeout=0.2)
    caller = await house.dial(tls)
    await caller.say(said)
    assert await caller.hear_the_end() == b""
    await until(lambda: not house.network.open)
    assert "no complete CONNECT within 0.2 s" in caplog.text


async def test_who_does_not_shake_hands_in_time_is_cut_off(house: House):
    await house.start(connect_timeout=0.2)
    house.ports[0] = house.ports[1]
    caller = await house.dial()  # and not a byte of TLS
    assert await caller.hear_the_end() == b""
    await until(lambda: not house.network.open and not house.network.tasks)


async def test_what_is_not_tls_is_told_in_the_log(house: House, caplog):
    await house.start()
    house.ports[0] = house.ports[1]
    caller = await house.dial()
    await caller.say(Connect("plain"))
    await caller.hear_the_end()
    await until(lambda: not house.network.open)
    assert "not TLS" in caplog.text
    assert not house.broker.sessions


async def test_a_slow_login_is_part_of_the_time_to_connect(house: House):
    house.gate.clear()
    await house.start(connect_timeout=0.2)
    caller = await house.dial()
    await caller.say(Connect("slow"))
    assert await caller.hear_the_end() == b""
    house.gate.set()
    await until(lambda: not house.network.tasks)
    assert not house.broker.sessions


@both
async def test_connections_over_the_limit_are_refused(house: House, tls, caplog):
    house.broker.use(Limits(connections=2), Features())
    await house.start(connections=2)
    first, second = await house.join("1", tls=tls), await house.join("2", tls=tls)
    for _ in range(20):
        assert await _is_refused(house, tls=tls)
    assert house.broker.counters.connects_refused == 20
    assert "(broker.limits.connections)" in caplog.text
    first.hang_up()
    await until(lambda: len(house.network.open) == 1)
    third = await house.join("3", tls=tls)
    for caller in (second, third):
        await caller.say(Pingreq())
        assert isinstance(await caller.hear(), Pingresp)


@both
async def test_a_slow_reader_is_bounded_and_delays_nobody(house: House, tls):
    """Rule 3 of the design: 100 MB for someone who does not read."""
    await house.start()
    slow = await house.join("slow", tls=tls, receive_buffer=8192)
    quick = await house.join("quick", tls=tls)
    for caller in (slow, quick):
        await caller.say(Subscribe(1, [Subscription("a")]))
        await caller.hear()
    publisher = await house.join("pub")
    protocol = house.protocol("slow")
    largest = 0
    for n in range(100):
        await publisher.say(Publish("a", b"%04d" % n + bytes(MIB)), Pingreq())
        assert isinstance(await publisher.hear(), Pingresp)
        heard = await quick.hear()
        assert isinstance(heard, Publish) and heard.payload[:4] == b"%04d" % n
        largest = max(largest, protocol._output_size())
    assert largest < 4 * MIB
    assert len(protocol._client.session.large) == 1  # type: ignore[union-attr]
    numbers = []
    while not numbers or numbers[-1] != 99:
        heard = await slow.hear()
        assert isinstance(heard, Publish)
        numbers.append(int(heard.payload[:4]))
    assert numbers == sorted(set(numbers)) and len(numbers) < 30


@both
async def test_who_asks_and_does_not_read_the_answers_is_bounded(house: House, tls, monkeypatch):
    """Rule 3: it is not listened to until it reads."""
    monkeypatch.setattr(wire, "OUTPUT_HIGH_WATER", 65536)
    await house.start()
    caller = await house.join("mute", tls=tls)
    protocol = house.protocol("mute")
    assert protocol._transport is not None
    for end in (protocol._transport, caller.writer):  # little in the system's buffers
        sock = end.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 65536)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    chunk = Unsubscribe(1, ["x" * 100]).encode(5) * 160
    said = 0
    with contextlib.suppress(asyncio.TimeoutError):
        while said < 1000:
            caller.writer.write(chunk)
            said += 1
            await asyncio.wait_for(caller.writer.drain(), 0.5)
    assert said < 1000, "it was listened to all the time"
    assert protocol._output_size() < MIB
    expected = Unsuback(1, [ReasonCode.NO_SUBSCRIPTION_EXISTED]).encode(5) * (said * 160)
    assert await asyncio.wait_for(caller.reader.readexactly(len(expected)), PATIENCE) == expected
    await caller.say(Subscribe(1, [Subscription("a")]))
    assert isinstance(await caller.hear(), Suback)


@both
async def test_retained_messages_wait_for_a_slow_reader(house: House, tls):
    """Rule 3: a small chunk of SUBSCRIBEs asks for a thousand times a megabyte."""
    await house.start()
    publisher = await house.join("pub")
    for n in range(20):
        await publisher.say(Publish(f"a/{n}", bytes(MIB), 0, retain=True))
    await publisher.say(Pingreq())
    await publisher.hear()
    greedy = await house.join("greedy", tls=tls, receive_buffer=8192)
    await greedy.say(*[Subscribe(1, [Subscription("a/#")])] * 1000)
    for _ in range(50):
        await publisher.say(Pingreq())
        await publisher.hear()
        assert house.protocol("greedy")._output_size() < 6 * MIB
    heard = []
    while len(set(heard)) < 20:
        packet = await greedy.hear()
        if isinstance(packet, Publish):
            heard.append(packet.topic)
    assert len(heard) < 60


async def test_a_stranger_is_not_listened_to_during_the_login(house: House):
    """Rule 3: nothing is buffered for who has not logged in, however large the chunks are."""
    house.gate.clear()
    await house.start()
    caller = await house.dial()
    await until(lambda: house.network.open and any(p._transport for p in house.network.open))
    (protocol,) = house.network.open
    assert protocol._transport is not None
    # One large chunk, as a fast network gives it: after these, reading is paused in any case.
    protocol.data_received(Connect("flood").encode() + bytes(MIB))
    caller.writer.write(bytes(100 * MIB))
    for _ in range(50):
        await asyncio.sleep(0)
        assert not protocol._transport.is_reading()
    assert protocol._client.connection.held <= MIB
    caller.hang_up()
    house.gate.set()
    await until(lambda: not house.network.open)


@both
async def test_a_client_that_has_no_more_to_say(house: House, tls):
    """Half closed: what it said is done, then the connection ends, and the will is due."""
    await house.start()
    watcher = await house.join("watcher")
    await watcher.say(Subscribe(1, [Subscription("#")]))
    await watcher.hear()
    caller = await house.dial(tls)
    await caller.say(
        Connect("brief", will=Will("w", b"gone")), Publish("a", b"x"), Publish("b", b"y" * MIB)
    )
    if tls:
        caller.writer.close()
    else:
        caller.writer.write_eof()
        assert isinstance(await caller.hear(), Connack)
        assert await caller.hear_the_end() == b""
    heard = [await watcher.hear() for _ in range(3)]
    assert [packet.topic for packet in heard] == ["a", "b", "w"]  # type: ignore[union-attr]
    await until(lambda: len(house.network.open) == 1)


@both
async def test_a_connection_that_breaks(house: House, tls):
    """A reset, at any moment, is a lost connection and nothing else."""
    await house.start()
    watcher = await house.join("watcher")
    await watcher.say(Subscribe(1, [Subscription("w/#")]))
    await watcher.hear()
    for n, packets in enumerate([[], [Subscribe(1, [Subscription("#")])], [b"\x30\x7f\x00"]]):
        caller = await house.dial(tls)
        await caller.say(Connect(f"c{n}", will=Will(f"w/{n}", b"gone")))
        await caller.hear()
        await caller.say(*packets)
        caller.writer.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0"
        )
        caller.hang_up()
        heard = await watcher.hear()
        assert isinstance(heard, Publish) and heard.topic == f"w/{n}"
    await until(lambda: len(house.network.open) == 1)


def break_packets(protocol: wire.ClientConnection) -> None:
    """Let something that nobody expected escape while the client's next packet is worked on."""
    protocol._client._on_packet = Mock(side_effect=ZeroDivisionError)  # type: ignore[method-assign]


@pytest.mark.parametrize("why", ["wrong bytes", "a fault"])
async def test_who_does_not_read_the_last_bytes_is_cut_off(house: House, monkeypatch, escaped, why):
    """A closed connection does not stay because its output cannot be written."""
    monkeypatch.setattr(wire, "CLOSE_TIMEOUT", 0.2)
    await house.start()
    caller = await house.join("deaf", receive_buffer=8192)
    await caller.say(Subscribe(1, [Subscription("a")]))
    await caller.hear()
    publisher = await house.join("pub")
    for _ in range(10):
        await publisher.say(Publish("a", bytes(MIB)))
    await until(lambda: not house.protocol("deaf")._client.output.writable)
    protocol = house.protocol("deaf")
    if why == "wrong bytes":
        await caller.say(b"\0\0")
    else:
        break_packets(protocol)
        await caller.say(Pingreq())
        await until(lambda: house.broker.faults.count)
    await until(lambda: protocol._transport is None, "its connection to be cut")
    await until(lambda: len(house.network.open) == 1)
    escaped.clear()


@both
async def test_stop_with_open_clients(house: House, tls):
    await house.start()
    callers = [await house.join(f"c{n}", tls=tls) for n in range(3)]
    silent = await house.dial(tls)
    deaf = await house.join("deaf", tls=tls, receive_buffer=8192)
    await deaf.say(Subscribe(1, [Subscription("a")]))
    await deaf.hear()
    for _ in range(10):
        await callers[0].say(Publish("a", bytes(MIB)))
    await callers[0].say(Pingreq())  # all of it has been read, or a reset would be the answer
    assert isinstance(await callers[0].hear(), Pingresp)
    assert not house.protocol("deaf")._client.output.writable
    await asyncio.wait_for(house.listeners.stop(), PATIENCE)
    for caller in callers:
        assert await caller.hear() == Disconnect(ReasonCode.SERVER_SHUTTING_DOWN)
        assert await caller.hear_the_end() == b""
    assert await silent.hear_the_end() == b""
    assert not house.network.open and not house.network.tasks
    with pytest.raises(OSError):
        await house.dial()
    await house.listeners.stop()  # again


async def test_stop_during_a_login(house: House):
    house.gate.clear()
    await house.start()
    caller = await house.dial()
    await caller.say(Connect("late"))
    await until(lambda: house.network.tasks)
    await asyncio.wait_for(house.listeners.stop(), PATIENCE)
    assert await caller.hear_the_end() == b""
    assert not house.broker.sessions


async def test_an_address_in_use(house: House):
    """Nothing is left listening, and the message names the key."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=rf"127\.0\.0\.1:{port} \(broker\.listeners\)"):
            await house.listeners.start(
                [ListenerSettings("127.0.0.1", 0, None), ListenerSettings("127.0.0.1", port, None)]
            )
    assert not house.listeners._doors


async def test_a_port_moves_to_all_addresses_and_back(house: House):
    """What listens on the port until then does not keep its successor from it, others do."""

    def use(*wanted: ListenerSettings):
        listeners.take(listeners.prepare([*wanted]), [*wanted], listeners.admission)

    listeners = house.listeners
    ((_, port),) = await listeners.start([ListenerSettings("127.0.0.1", 0, None)])
    house.ports = [("127.0.0.1", port)]
    early = await house.join("early")
    for host in ("", "0.0.0.0", "127.0.0.1"):
        use(ListenerSettings(host, port, None))
        assert listeners.addresses == [(host, port)]
        await house.join(f"by {host or 'any'}")
        with pytest.raises(OSError, match="in use already"):
            sockets.listen(host, port)
    with socket.create_server(("127.0.0.2", port)), pytest.raises(OSError, match="in use already"):
        use(ListenerSettings("", port, None))
    assert listeners.addresses == [("127.0.0.1", port)]
    await house.join("late")
    await early.say(Pingreq())
    assert isinstance(await early.hear(), Pingresp)


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


async def test_every_address(house: House):
    """An empty host listens on IPv4, and on IPv6 where there is any."""
    ((host, port),) = await house.listeners.start([ListenerSettings("", 0, None)])
    assert host == ""
    house.ports = [("127.0.0.1", port)]
    await house.join("four")
    if socket.has_dualstack_ipv6():
        with contextlib.suppress(OSError):  # no loopback address of IPv6 on this computer
            reader, writer = await asyncio.open_connection("::1", port)
            caller = Caller(reader, writer)
            await caller.say(Connect("six"))
            assert isinstance(await caller.hear(), Connack)


async def test_a_take_over_by_the_network(house: House, caplog):
    caplog.set_level(logging.INFO)
    await house.start()
    first = await house.join("same")
    second = await house.join("same", tls=True)
    assert await first.hear() == Disconnect(ReasonCode.SESSION_TAKEN_OVER)
    assert await first.hear_the_end() == b""
    await second.say(Pingreq())
    assert isinstance(await second.hear(), Pingresp)


# --- the end of a connection ---------------------------------------------------------------------


@both
async def test_the_reason_reaches_who_is_still_sending(house: House, tls):
    """Closed with unread input, a connection is reset: the last packet would be lost."""
    await house.start()
    caller = await house.join("wrong", tls=tls)
    # Of small packets that may come, many are behind the one that may not.
    caller.writer.write(Connect("again").encode(5) + Pingreq().encode(5) * MIB)
    await asyncio.sleep(0.1)  # a client that is busy with sending
    assert await caller.hear() == Disconnect(ReasonCode.PROTOCOL_ERROR)
    assert await asyncio.wait_for(caller.reader.read(-1), PATIENCE) == b""  # and no reset
    await until(lambda: not house.network.open)
    caller.hang_up()
    await until(lambda: not house.network._farewells)


async def test_a_farewell_is_bounded(house: House, monkeypatch):
    """Who neither closes its end nor stops sending is not listened to for long."""
    monkeypatch.setattr(farewell, "TIMEOUT", 0.2)
    monkeypatch.setattr(network, "FAREWELLS", 2)
    await house.start()
    callers = [await house.join(f"c{n}") for n in range(4)]
    for caller in callers:
        await caller.say(Connect("again"))
        assert await caller.hear() == Disconnect(ReasonCode.PROTOCOL_ERROR)
    await until(lambda: not house.network.open)
    assert len(house.network._farewells) <= 2
    await until(lambda: not house.network._farewells)
    monkeypatch.setattr(farewell, "TIMEOUT", PATIENCE)
    monkeypatch.setattr(farewell, "BYTES", MIB)
    caller = await house.join("loud")
    await caller.say(Connect("again"))
    with pytest.raises(ConnectionError):
        for _ in range(100):
            await caller.say(bytes(MIB))


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


async def test_what_was_said_before_an_abrupt_end_is_done(house: House):
    """uvloop's TLS transport drops what it has received when the connection ends."""
    await house.start()
    data = Publish("a", bytes(100)).encode(5) * 20_000 + Disconnect().encode(5)
    port = house.ports[1][1]
    await asyncio.to_thread(_leave_abruptly, port, house.client_context, data)
    await until(lambda: not house.network.open)
    assert house.broker.counters.publish_received == 20_000  # and no will


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
    listeners = wiring.listener_settings(settings, wiring.tls(settings))
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
        ("{bind: ':1', protocol: ws}", "protocol: must be mqtt or websocket"),
        ("{bind: 'unix:x'}, {bind: 'unix:./x'}", "bind: broker.listeners[0] listens there already"),
    ],
)
def test_what_is_no_listener(listener, problem, tmp_path):
    with pytest.raises(config.ConfigError) as refused:
        config.loads(f"broker: {{listeners: [{listener}]}}", tmp_path / "appliance.yaml", {})
    assert problem in str(refused.value)


# --- Unix sockets --------------------------------------------------------------------------------


async def _dial_path(house: House, path: Path) -> Caller:
    caller = Caller(*await asyncio.open_unix_connection(path))
    house.callers.append(caller)
    return caller


async def test_a_unix_socket(house: House, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    path = tmp_path / "mqtt.sock"
    house.make(connections_per_address=1)
    umask = os.umask(0o077)
    try:
        addresses = await house.listeners.start([ListenerSettings("", 0, None, path=path)])
    finally:
        os.umask(umask)
    assert addresses == [(f"unix:{path}", 0)]
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    callers = [await _dial_path(house, path) for _ in range(3)]  # not counted an address
    for number, caller in enumerate(callers):
        await caller.say(Connect(f"c{number}"), Subscribe(1, [Subscription("a")]))
        assert isinstance(await caller.hear(), Connack)
        assert isinstance(await caller.hear(), Suback)
    await callers[0].say(Publish("a", b"x" * MIB))
    for caller in callers:
        heard = await caller.hear()
        assert isinstance(heard, Publish) and len(heard.payload) == MIB
    # Each is told apart by a number in the place of a port.
    where = re.findall(rf"client 'c\d' \(anonymous\) at unix:{path}:(\d+) connected", caplog.text)
    assert len(set(where)) == 3
    for caller in callers:
        caller.hang_up()
    await house.listeners.stop()
    assert not path.exists()


async def test_the_mode_of_a_unix_socket(house: House, tmp_path):
    path = tmp_path / "mqtt.sock"
    await house.listeners.start([ListenerSettings("", 0, None, path=path, mode=0o600)])
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


async def test_a_unix_socket_that_was_left_is_replaced(house: House, tmp_path):
    path = tmp_path / "mqtt.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
        left.listen()
    await house.listeners.start([ListenerSettings("", 0, None, path=path)])
    caller = await _dial_path(house, path)
    await caller.say(Connect("here"))
    assert isinstance(await caller.hear(), Connack)


async def test_a_unix_socket_in_use_is_left_alone(house: House, tmp_path):
    path = tmp_path / "mqtt.sock"
    wanted = [ListenerSettings("", 0, None, path=path)]
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(OSError, match=rf"unix:{path} \(broker\.listeners\): another process"):
            await house.listeners.start(wanted)
        assert path.exists()
    path.unlink()
    path.write_text("precious")
    with pytest.raises(OSError, match="a file that is no socket"):
        await house.listeners.start(wanted)
    assert path.read_text() == "precious"
    with pytest.raises(OSError, match="No such file or directory"):
        nowhere = ListenerSettings("", 0, None, path=tmp_path / "nowhere/mqtt.sock")
        await house.listeners.start([nowhere])


async def test_another_ones_unix_socket_is_not_removed(house: House, tmp_path):
    path = tmp_path / "mqtt.sock"
    await house.listeners.start([ListenerSettings("", 0, None, path=path)])
    path.unlink()
    path.write_text("another's")
    await house.listeners.stop()
    assert path.read_text() == "another's"


# --- limits of connections -----------------------------------------------------------------------


async def _is_refused(house: House, user: str | None = None, *, tls: bool = False) -> bool:
    try:
        caller = await house.dial(tls)
        await caller.say(Connect("one-more", username=user))
        answer = await caller.hear()
        caller.hang_up()
        assert isinstance(answer, Connack)
        return answer.reason_code == ReasonCode.QUOTA_EXCEEDED
    except (OSError, asyncio.IncompleteReadError):
        return True


async def test_connections_from_one_address(house: House, caplog):
    await house.start(connections_per_address=2)
    callers = [await house.join(f"c{n}") for n in range(2)]
    assert await _is_refused(house)
    assert house.broker.counters.connects_refused == 1
    assert "refused: its address has 2 connections of its user" in caplog.text
    assert "broker.limits.connections_per_address" in caplog.text
    callers[0].hang_up()
    await until(lambda: len(house.network.open) == 1)
    assert not await _is_refused(house)


async def test_a_fault_before_a_commit_leaves_no_guest_for_ever(house: House, escaped):
    """The last bytes are written at the commit, when the fault is long over; or not at all."""
    await house.start(connections_per_address=2)
    store = house.broker.store
    store.hurry = lambda: None  # type: ignore[method-assign]
    for n in range(3):
        caller = await house.join(f"c{n}")
        protocol = house.protocol(f"c{n}")
        break_packets(protocol)
        store.staged, store.batch, store.committed = True, 5, 4
        protocol._client.output.batch = 5
        await caller.say(Pingreq())
        await until(lambda count=n + 1: house.broker.faults.count == count)
        if n == 2:
            protocol._forget()  # it has ended already
        store.committed, store.staged = 5, False
        house.broker._committed(True)
        caller.hang_up()
        await until(lambda: not house.network.open)
        assert house.listeners._addresses.oldest_guest() is None
    escaped.clear()


async def _say_who(caller: Caller, client_id: str, user: str) -> None:
    await caller.say(Connect(client_id, username=user))
    answer = await caller.hear()
    assert isinstance(answer, Connack) and answer.reason_code == ReasonCode.SUCCESS


async def test_what_a_user_has_from_one_address_keeps_no_other_out(house: House):
    await house.start(connections_per_address=2)
    for number in range(2):
        await _say_who(await house.dial(), f"m{number}", "mallory")
    assert await _is_refused(house, "mallory")
    await until(lambda: len(house.network.open) == 2)
    await _say_who(await house.dial(), "alice", "alice")


async def test_what_a_user_has_of_all_connections_keeps_no_other_out(house: House):
    house.broker.use(Limits(connections=3), Features())
    await house.start(connections=3)
    crowd = [await house.dial() for _ in range(3)]
    for number, caller in enumerate(crowd):
        await _say_who(caller, f"m{number}", "mallory")
    assert await _is_refused(house, "mallory")
    await _say_who(await house.dial(), "alice", "alice")
    farewell = await crowd[2].hear()
    assert isinstance(farewell, Disconnect) and farewell.reason_code == ReasonCode.QUOTA_EXCEEDED
    await crowd[0].say(Pingreq())
    assert isinstance(await crowd[0].hear(), Pingresp)


@both
async def test_strangers_keep_nobody_out(house: House, monkeypatch, caplog, tls):
    """Neither those who say nothing, nor those in the middle of their TLS handshake."""
    monkeypatch.setattr(listeners, "GUESTS", 4)
    monkeypatch.setattr(listeners, "HANDSHAKES", 1000)
    await house.start(connections=2)
    for _ in range(3):  # more than there is room for
        for _ in range(4):
            sock = socket.socket()
            sock.setblocking(False)
            house.strangers.append(sock)
            await asyncio.get_running_loop().sock_connect(sock, house.ports[tls])
        await until(lambda: house.network.open)
        (await house.join("alice", tls=tls)).hang_up()
        await until(lambda: not house.broker.clients)
    assert len(house.network.open) <= 5
    assert "makes room for others" in caplog.text
    await until(lambda: len(house.network.tasks) <= 5)


async def test_new_connections_from_one_address(house: House, caplog):
    """Bursts of five times the rate, then no more than the rate."""
    await house.start(connection_rate=4)
    allowed, began = 0, time.monotonic()
    while not await _is_refused(house):
        allowed += 1
        assert allowed < 100, "it is never refused"
    assert 20 <= allowed <= 21 + 4 * (time.monotonic() - began)
    assert "opens more than 4 connections a second" in caplog.text
    assert "broker.limits.connection_rate" in caplog.text
    refused = house.broker.counters.connections_refused
    assert refused >= 1
    await asyncio.sleep(0.3)
    assert not await _is_refused(house)


class Neighbour:
    """A connection, as far as the addresses look at it."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.account = Accounts().strangers


def come(addresses: listeners._Addresses, host: str, now: float) -> Neighbour | None:
    """A connection that has not logged in; None when it is refused."""
    if addresses.come(host, now):
        return None
    member = Neighbour(host)
    addresses.came(member)
    return member


def test_what_counts_as_one_address():
    addresses = listeners._Addresses(Admission(9, 9, 1, 100))
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
    addresses, accounts = listeners._Addresses(Admission(9, 9, 2, 1000)), Accounts()
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
        addresses.leaves(member)
    assert addresses.oldest_guest() is members[0]
    for member in members:
        addresses.ended(member)
    addresses._forget_idle(1000.0)
    assert not addresses._known


def test_idle_addresses_are_forgotten():
    addresses = listeners._Addresses(Admission(9, 9, 10, 10))
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


async def test_strangers_in_a_handshake_do_not_keep_others_out(house: House, monkeypatch):
    """They hold every place that there is, and say nothing."""
    monkeypatch.setattr(listeners, "HANDSHAKES", 4)
    await house.start(connect_timeout=600)
    silent = [await asyncio.open_connection(*house.ports[1]) for _ in range(10)]
    caller = await house.join("honest", tls=True)
    await caller.say(Pingreq())
    assert isinstance(await caller.hear(), Pingresp)
    for _, writer in silent:
        writer.transport.abort()


async def test_handshakes_at_a_time(house: House, monkeypatch):
    """More than that wait to be accepted, and all of them get in."""
    monkeypatch.setattr(listeners, "HANDSHAKES", 3)
    most = 0
    await house.start()
    begin = house.listeners._begin

    async def count(*arguments) -> None:
        nonlocal most
        most = max(most, len(house.listeners._handshakes))
        await begin(*arguments)

    monkeypatch.setattr(house.listeners, "_begin", count)
    callers = await asyncio.gather(*(house.join(f"c{n}", tls=True) for n in range(30)))
    assert most == 3
    assert len(house.broker.clients) == 30
    plain = await house.join("plain")
    for caller in (*callers, plain):
        caller.hang_up()


# --- limits of what is sent ----------------------------------------------------------------------


@both
async def test_publishes_over_the_rate_are_read_later(house: House, tls):
    """None is lost, nobody is cut off, and others are not slowed."""
    await house.start(publish_rate=400)
    loop = asyncio.get_running_loop()
    subscriber, eager = await house.join("sub"), await house.join("eager", tls=tls)
    await subscriber.say(Subscribe(1, [Subscription("a")]))
    await subscriber.hear()
    calm = await house.join("calm", tls=tls)
    began = loop.time()
    await eager.say(*(Publish("a", b"%d" % number) for number in range(1000)))
    for number in range(1000):
        heard = await subscriber.hear()
        assert isinstance(heard, Publish) and heard.payload == b"%d" % number
        if number == 700:
            await calm.say(Publish("b", b"", 1, packet_id=1))
            assert isinstance(await calm.hear(), Puback)
    # A second's worth may come at once.
    assert 0.6 < loop.time() - began < 6


async def test_a_rate_holds_for_the_smallest_messages(house: House):
    """Thousands are in one chunk: they are not taken as one."""
    await house.start(publish_rate=100)
    caller = await house.join("tiny")
    counters = house.broker.counters
    await caller.say(Publish("a", b"").encode(5) * 5000)
    await asyncio.sleep(0.3)
    assert 0 < counters.publish_received <= 250
    await asyncio.sleep(0.5)
    assert counters.publish_received <= 300
    caller.hang_up()


async def test_what_is_cut_in_portions_stays_in_order(house: House, monkeypatch):
    monkeypatch.setattr(network, "LARGEST_PORTION", 16)
    await house.start()
    caller = await house.join("self")
    await caller.say(Subscribe(1, [Subscription("#")]))
    await caller.hear()
    sizes = [0, 5, 100, 3, 2000, 1, 70_000, 8, 8, 8, 300_000, 0]
    await caller.say(*(Publish(f"a/{n}", bytes(size)) for n, size in enumerate(sizes)))
    for n, size in enumerate(sizes):
        heard = await caller.hear()
        assert isinstance(heard, Publish)
        assert (heard.topic, len(heard.payload)) == (f"a/{n}", size)


@both
async def test_a_flood_of_small_packets_leaves_others_their_turn(house: House, tls):
    await house.start()
    flood, other = await house.join("flood", tls=tls), await house.join("other", tls=tls)
    count = 50_000
    flood.writer.write(Publish("a", b"").encode(5) * count)
    received = house.broker.counters
    await until(lambda: received.publish_received)
    answers = 0
    while received.publish_received < count:
        await other.say(Pingreq())
        assert isinstance(await other.hear(), Pingresp)
        answers += 1
    assert answers > 10  # in chunks as they are received, it would be two or three


# --- memory --------------------------------------------------------------------------------------


@pytest.fixture
async def small_house(contexts) -> AsyncIterator[House]:
    house = House(*contexts, Limits(memory=8 * MIB))
    house.broker.tick(asyncio.get_running_loop().time())
    yield house
    await house.close()


@both
async def test_the_output_of_slow_readers_is_counted(small_house: House, tls):
    """And it is bounded in all: not a megabyte for each of them."""
    house = small_house
    await house.start()
    readers = [await house.join(f"r{n}", tls=tls, receive_buffer=4096) for n in range(20)]
    for number, reader in enumerate(readers):
        protocol = house.protocol(f"r{number}")
        assert protocol._transport is not None
        protocol._transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, 4096
        )
        await reader.say(Subscribe(1, [Subscription("a")]))
        await reader.hear()
    publisher = await house.join("pub")
    for _ in range(150):
        await publisher.say(Publish("a", bytes(20_000)), Pingreq())
        assert isinstance(await publisher.hear(), Pingresp)
    accounting = house.broker.accounting
    protocols = [house.protocol(f"r{number}") for number in range(20)]
    waiting = sum(protocol._output_size() for protocol in protocols)
    assert house.network.output >= waiting > 0
    assert accounting.queued_bytes >= waiting
    assert waiting < 3 * MIB
    for reader in readers:
        reader.hang_up()


@both
async def test_a_large_message_is_not_copied_for_everyone(house: House, tls):
    await house.start()
    readers = [await house.join(f"r{n}", tls=tls, receive_buffer=4096) for n in range(20)]
    for reader in readers:
        await reader.say(Subscribe(1, [Subscription("a", 1)]))
        await reader.hear()
    publisher = await house.join("pub")
    tracemalloc.start()
    try:
        message = Publish("a", bytes(8 * MIB), 1, packet_id=1)
        await publisher.say(message, Publish("a", b"and a small one"))
        assert isinstance(await publisher.hear(), Puback)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert 8 * MIB <= house.network.output < 15 * MIB
    assert most < 60 * MIB  # our own end, the stream's buffer and the chunks, joined
    for reader in readers[1:]:
        reader.hang_up()
    heard = await readers[0].hear()
    assert isinstance(heard, Publish) and len(heard.payload) == 8 * MIB
    heard = await readers[0].hear()
    assert isinstance(heard, Publish) and heard.payload == b"and a small one"


async def test_publishers_are_slowed_while_memory_is_short(small_house: House, caplog):
    """Nobody is cut off, and a publisher that is slowed still gets its answers."""
    house = small_house
    await house.start()
    publisher = await house.join("pub")
    accounting = house.broker.accounting
    loop = asyncio.get_running_loop()

    async def publish(count: int, size: int) -> float:
        began = loop.time()
        for number in range(count):
            await publisher.say(Publish("a", bytes(size), 1, packet_id=1 + number))
            assert isinstance(await publisher.hear(), Puback)
        return loop.time() - began

    await publish(10, 20_000)
    accounting.queued_bytes += 7 * MIB
    try:
        assert await publish(10, 20_000) > 9 * wire.SHORT_OF_MEMORY_PAUSE
        assert await publish(5 * network.FEW_MESSAGES, 5) > 4 * wire.SHORT_OF_MEMORY_PAUSE
        assert "is slowed" in caplog.text and "broker.limits.memory" in caplog.text
        reader = await house.join("reader")
        began = loop.time()
        for _ in range(50):
            await reader.say(Pingreq())
            await reader.hear()
        assert loop.time() - began < 25 * wire.SHORT_OF_MEMORY_PAUSE
    finally:
        accounting.queued_bytes -= 7 * MIB


async def test_who_stays_slow_is_told_in_the_log(house: House, monkeypatch, caplog):
    monkeypatch.setattr(wire, "SLOW_AFTER", 0.05)
    await house.start()
    deaf = await house.join("deaf", receive_buffer=4096)
    await deaf.say(Subscribe(1, [Subscription("a")]))
    await deaf.hear()
    publisher = await house.join("pub")
    for _ in range(10):
        await publisher.say(Publish("a", bytes(MIB)))
    await until(lambda: "client 'deaf' (anonymous)" in caplog.text)
    assert "does not read" in caplog.text
    deaf.hang_up()
