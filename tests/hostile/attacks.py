"""The attacks. A docstring says what an attack does, `log_pattern` which line the log must have."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import math
import random
import socket
import ssl
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

from load import BOTH, PATIENCE, ROUND_TRIP, USER, Attack, Line, Load, WebLine, encode4, encode5
from witness import BINARY, CONTINUATION, PING, PONG, UPGRADE, Over, frame

from appliance.mqtt.codec import Property, encode_varint
from appliance.mqtt.framing import MAXIMUM_CONTROL
from appliance.mqtt.packets import (
    V311,
    Connect,
    Pingreq,
    Publish,
    Pubrec,
    Pubrel,
    Subscribe,
    Subscription,
    Unsubscribe,
    Will,
)

ATTACKS: dict[str, Attack] = {}

#: Where the attackers write and read; the healthy client's topic lies beside it.
AREA = "r2d2/mallory"
HEALTHY = "r2d2/healthy/echo"

#: An address as the log has it, and a client of the attacker's.
ADDRESS = r"127\.0\.0\.1:\d+"
CLIENT = rf"client '[^']*' \(user '{USER}'\)"

Run = Callable[[Load], Awaitable[None]]


def attack(
    log_pattern: str,
    *,
    at_least: float = 0.0,
    short: bool = True,
    logged_after: float = 0.0,
    p99: float = math.inf,
    worst: float = ROUND_TRIP,
    over: Over | None = None,
    **limits: Any,
) -> Callable[[Run], Run]:
    """Enter a function into ATTACKS under its name."""

    def enter(run: Run) -> Run:
        name = run.__name__.replace("_", "-")
        what = " ".join((run.__doc__ or "").split())
        bounds = p99, worst, over
        ATTACKS[name] = Attack(
            name, what, run, log_pattern, limits, at_least, short, logged_after, *bounds
        )
        return run

    return enter


# --- before the login


@attack(rf"{ADDRESS}: no complete CONNECT within", at_least=1.4)
async def slow_connects(load: Load) -> None:
    """A thousand strangers say their CONNECT byte by byte, and come again when they are cut."""
    packet = load.connect_packet("slow")

    async def drip(number: int) -> Line:
        line = await load.dial()
        line.send_nowait(packet[:1])
        return line

    async def keep_on() -> None:
        said = 1
        while load.on:
            lines = [line for line in load.lines if line.open]
            for line in lines:
                line.send_nowait(packet[said : said + 1])
            said = min(said + 1, len(packet) - 2)
            load.counts["bytes"] += len(lines)
            load.lines.intersection_update(lines)
            await asyncio.sleep(0.1)

    async def come() -> None:
        while load.on:
            await load.crowd(900 - len(load.lines), drip, 1.0)
            await asyncio.sleep(0.05)

    await load.together(keep_on(), come())


@attack(rf"{ADDRESS}(: no complete CONNECT within| broke the protocol)", at_least=1.4)
async def heavy_strangers(load: Load) -> None:
    """Strangers send almost all of the largest CONNECT there can be, and wait."""
    packet = load.connect_packet("heavy", will=_heavy_will(MAXIMUM_CONTROL - 200))[:-1]

    async def stay(number: int) -> Line:
        line = await load.dial()
        await line.send(packet)
        return line

    while load.on:
        await load.crowd(900, stay, 1.0)


@attack(rf"({ADDRESS} broke the protocol|user 'mallory'\) at 127\.0\.0\.1:\d+ refused)")
async def costly_strangers(load: Load) -> None:
    """CONNECTs that are long to take apart, full of user properties, with a wrong password."""
    pairs = [("", "")] * ((MAXIMUM_CONTROL - 400) // 5)
    will = Will(AREA, b"", properties={Property.USER_PROPERTY: pairs})
    packet = load.connect_packet("costly", password=b"wrong", will=will)

    async def send(number: int) -> Line:
        line = await load.dial()
        await line.send(packet)
        return line

    while load.on:
        await load.crowd(200, send, 1.0)


#: What the healthy client may have to wait while work is made that is large for its bytes.
BOUNDED: dict[str, float] = {"p99": 0.05, "worst": 0.25}

#: User Properties that a stranger's CONNECT may hold, and by default a packet behind the login.
STRANGERS_PAIRS = 64
PAIRS = 1000


async def _last_bytes(load: Load, packet: bytes, answer: int) -> None:
    """Crowds whose CONNECTs miss their last byte, which then comes from all in one moment."""

    async def wait(number: int) -> Line:
        line = await load.dial()
        await line.send(packet[:-1])
        return line

    async def expect_answer(line: Line) -> None:
        with contextlib.suppress(asyncio.TimeoutError):
            await line.receive(4)
        code = line.first[3] if len(line.first) > 3 else -1
        load.counts["answered" if code == answer else f"answered {code:#04x}"] += 1

    while load.on:
        lines = await load.crowd(245, wait, 1.0)
        await asyncio.sleep(0.3)  # for the broker to have read them
        for line in lines:
            line.send_nowait(packet[-1:])
        await asyncio.gather(*(expect_answer(line) for line in lines))
        for line in lines:
            line.abort()
            load.lines.discard(line)
    assert load.counts["answered"], f"nobody was answered with {answer:#04x}"


def _pairs(count: int, size: int) -> list[tuple[str, str]]:
    """So many User Properties of so many bytes, of characters that take four bytes in memory."""
    return [("", "x\U0001f916" + "é" * ((size - 10) // 2))] * count


@attack(
    r"\(0x97\)|more than \d+ User Properties",
    at_least=2.0,
    short=False,
    connect_timeout="10 s",
    **BOUNDED,
)
async def last_bytes(load: Load) -> None:
    """The last byte of 245 CONNECTs with 2 x 9,900 empty user properties, all in one moment."""
    pairs = [("", "")] * 9_900
    will = Will(AREA, b"", properties={Property.USER_PROPERTY: pairs})
    packet = load.connect_packet("last", will=will, properties={Property.USER_PROPERTY: pairs})
    await _last_bytes(load, packet, 0x97)


@attack(
    rf"{CLIENT}.*taken over",
    at_least=2.0,
    short=False,
    connect_timeout="10 s",
    **BOUNDED,
)
async def last_bytes_allowed(load: Load) -> None:
    """The same with as many user properties as are allowed, each of 1,500 bytes: all log in."""
    pairs = _pairs(STRANGERS_PAIRS // 2, 1500)
    will = Will(AREA, b"", properties={Property.USER_PROPERTY: pairs})
    packet = load.connect_packet("last", will=will, properties={Property.USER_PROPERTY: pairs})
    await _last_bytes(load, packet, 0)


@attack(r"refused: SCRAM-SHA-256: user .* may not act for another", connect_timeout="10 s")
async def scram_names(load: Load) -> None:
    """The last byte of 245 CONNECTs with two long names for SCRAM that are costly to prepare."""
    names = (letter * 85 for letter in ("\u0e01", "\u0e02"))
    data = "n,a={},n={},r=x".format(*names).encode()
    scram = {
        Property.AUTHENTICATION_METHOD: "SCRAM-SHA-256",
        Property.AUTHENTICATION_DATA: data,
    }
    packet = Connect("", version=5, clean_start=True, properties=scram).encode(5)
    await _last_bytes(load, packet, 0x87)


@attack(r"\(0x97\)|more than \d+ User Properties", at_least=1.0, **BOUNDED)
async def costly_connects(load: Load) -> None:
    """A hundred CONNECTs a second with 2 x 9,900 empty user properties."""
    pairs = [("", "")] * 9_900
    will = Will(AREA, b"", properties={Property.USER_PROPERTY: pairs})
    packet = load.connect_packet("costly", will=will, properties={Property.USER_PROPERTY: pairs})

    async def come(number: int) -> None:
        async for _ in load.rounds(0.1):
            line = await load.dial()
            await line.send(packet)
            if await line.receive(4):
                assert line.first[3] == 0x97, line.first.hex()
                load.counts["answered"] += 1
            line.abort()
            load.lines.discard(line)

    await load.together(*(come(number) for number in range(10)))
    assert load.counts["answered"]


async def _forbidden_properties(load: Load, pairs: list[tuple[str, str]], clients: int) -> None:
    """Messages full of user properties, of clients that come again when they are cut off."""
    packet = encode5(
        Publish(
            "r2d2/forbidden/x",
            b"",
            1,
            packet_id=1,
            properties={Property.USER_PROPERTY: pairs},
        )
    )

    async def send(number: int) -> None:
        async for turn in load.rounds():
            line = await load.join(f"pairs-{number}-{turn}")
            before = line.received
            await load.flood(line, packet, 1, "packets")
            load.counts["answered"] += line.received > before

    await load.together(*(send(number) for number in range(clients)))
    assert load.counts["packets"]


@attack(rf"{CLIENT}.*broke the protocol.*User Properties", **BOUNDED)
async def too_many_pairs(load: Load) -> None:
    """Twenty clients send messages with 9,900 user properties to where they may not write."""
    await _forbidden_properties(load, [("", "")] * 9_900, 20)


@attack(r"may not publish to 'r2d2/forbidden", **BOUNDED)
async def many_pairs(load: Load) -> None:
    """The same with as many user properties as are allowed, empty ones."""
    await _forbidden_properties(load, [("", "")] * PAIRS, 20)


@attack(r"may not publish to 'r2d2/forbidden", **BOUNDED)
async def long_pairs(load: Load) -> None:
    """The same, of 300 bytes each, in characters that take the most memory."""
    await _forbidden_properties(load, _pairs(PAIRS, 300), 20)


@attack(rf"{CLIENT}", at_least=2.0, over=Over.TLS, **BOUNDED)
async def tls_records(load: Load) -> None:
    """Twenty clients whose TLS records hold one byte each."""

    async def send(number: int) -> None:
        loop = asyncio.get_running_loop()
        incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        tls = load.target.context().wrap_bio(incoming, outgoing, server_hostname="localhost")
        with await load.raw(Over.TLS) as sock:

            async def expect_answer() -> None:
                data = await asyncio.wait_for(loop.sock_recv(sock, 65536), PATIENCE)
                if not data:
                    raise ConnectionError("the broker closed")
                incoming.write(data)

            while True:
                try:
                    tls.do_handshake()
                    break
                except ssl.SSLWantReadError:
                    await loop.sock_sendall(sock, outgoing.read())
                    await expect_answer()
            tls.write(load.connect_packet(f"records-{number}"))
            await loop.sock_sendall(sock, outgoing.read())
            answer = b""
            while len(answer) < 4:
                try:
                    answer += tls.read(65536)
                except ssl.SSLWantReadError:
                    await expect_answer()
            assert answer[3] == 0, answer.hex()
            load.counts["logins"] += 1
            ping = Pingreq().encode(5)

            async def send_pings(count: int) -> None:
                for _ in range(count):
                    tls.write(ping[:1])
                    tls.write(ping[1:])
                    load.counts["records"] += 2
                await asyncio.sleep(0)
                await loop.sock_sendall(sock, outgoing.read())

            await send_pings(1)  # to see it answered: the first 2,000 may take all of the time
            load.counts["bytes answered"] += len(await loop.sock_recv(sock, 65536))
            while load.on:
                await send_pings(2000)
                with contextlib.suppress(BlockingIOError):
                    load.counts["bytes answered"] += len(sock.recv(65536))

    await load.together(*(send(number) for number in range(20)))
    assert load.counts["bytes answered"], "no ping was answered"
    assert load.counts["records"] > 2 * load.counts["logins"], "nobody came to send many"


#: Logins a second with a wrong password.
GUESSES = 1000


async def _guess(load: Load) -> None:
    """Wrong passwords of every kind of user, some of them again and again, and one right one.

    That comes from another address, for a user that is guessed at and was not here before.
    """
    names = ["alice", USER, "root", "admin", "operator"]
    loop = asyncio.get_running_loop()
    pending: set[asyncio.Task[None]] = set()

    async def guess(number: int) -> None:
        password = b"123456" if number % 10 == 0 else b"guess %d" % number
        name = names[number % len(names)] if number % 3 else f"user{number}"
        packet = load.connect_packet(f"g{number}", username=name, password=password)
        with contextlib.suppress(OSError, asyncio.TimeoutError):
            line = await load.dial()
            try:
                line.send_nowait(packet)
                if await line.receive(4):
                    load.counts[f"answered 0x{line.first[3]:02x}"] += 1
            finally:
                line.transport.abort()
                load.lines.discard(line)

    async def flood() -> None:
        began = loop.time()
        number = 0
        while load.on:
            due = int((loop.time() - began) * GUESSES)
            while number < due:
                number += 1
                if len(pending) < 800:  # as many as may be connected, with room for others
                    task = asyncio.ensure_future(guess(number))
                    pending.add(task)
                    task.add_done_callback(pending.discard)
            await asyncio.sleep(0.005)

    async def log_in() -> None:
        await asyncio.sleep(0.5 * load.seconds)
        sock = socket.socket()
        sock.setblocking(False)
        sock.bind(("127.0.0.2", 0))
        began = loop.time()
        await loop.sock_connect(sock, ("127.0.0.1", load.target.plain_port))
        _, line = await loop.create_connection(lambda: Line(sock), sock=sock)
        line.send_nowait(load.connect_packet("owner"))
        assert await line.receive(4) and line.first[3] == 0, f"not let in: {line.first.hex()}"
        load.counts["ms for a right login"] = round((loop.time() - began) * 1000)
        line.abort()

    await load.together(flood(), log_in())
    for task in pending:
        task.cancel()


@attack(
    r"refused: (too many (logins|passwords)|wrong password|unknown user)", at_least=2.0, p99=0.05
)
async def wrong_logins(load: Load) -> None:
    """A thousand wrong logins a second, of which no limit of connections keeps any away."""
    await _guess(load)


@attack(
    r"127\.0\.0\.1\S* .*connection_rate",
    at_least=1.4,
    short=False,
    p99=0.05,
    connection_rate=100,
    connections_per_address=250,
    connect_timeout="10 s",
)
async def wrong_logins_by_default(load: Load) -> None:
    """The same, with the limits of connections as they are by default."""
    await _guess(load)


@attack(r"127\.0\.0\.1\S* .*connection_rate", connection_rate=100, connections_per_address=250)
async def connect_flood(load: Load) -> None:
    """Connections that are closed as soon as they are there, as fast as they can be made."""

    async def come_and_go() -> None:
        while load.on:
            try:
                (await load.raw()).close()
            except (OSError, asyncio.TimeoutError):
                await asyncio.sleep(0.001)

    await load.together(*(come_and_go() for _ in range(16)))


@attack(rf"{ADDRESS} broke the protocol")
async def garbage_flood(load: Load) -> None:
    """As many connections as can be made, each with bytes that are no MQTT."""
    rng = random.Random(1)
    garbage = [
        b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n",
        b"\x16\x03\x01\x02\0\x01\0\x01\xfc\x03\x03" + rng.randbytes(500),
        b"\x10\xff\xff\xff\xff\xff",
        b"\x10\x0c\0\x04MQTT\x09\0\0\0\0\0",
        b"\xc0\0",
        b"\0" * 1000,
        *(rng.randbytes(rng.randint(1, 2000)) for _ in range(50)),
    ]

    async def come_and_go() -> None:
        while load.on:
            try:
                line = await load.dial()
            except (OSError, asyncio.TimeoutError):
                await asyncio.sleep(0.001)
                continue
            line.send_nowait(rng.choice(garbage))
            await asyncio.sleep(0)
            if rng.random() < 0.5:
                line.abort()
            else:
                line.transport.close()
            load.lines.discard(line)

    await load.together(*(come_and_go() for _ in range(32)))


@attack(rf"{ADDRESS}: no TLS connection", over=Over.TLS)
async def tls_flood(load: Load) -> None:
    """TLS handshakes one behind the other, whole ones, and ones that end in the middle."""

    async def whole() -> None:
        while load.on:
            try:
                line = await load.dial(Over.TLS)
            except (OSError, asyncio.TimeoutError):
                await asyncio.sleep(0.001)
                continue
            load.counts["handshakes"] += 1
            line.abort()
            load.lines.discard(line)

    hello = _client_hello(load)

    async def half() -> None:
        loop = asyncio.get_running_loop()
        while load.on:
            try:
                sock = await load.raw(Over.TLS)
            except (OSError, asyncio.TimeoutError):
                await asyncio.sleep(0.001)
                continue
            try:
                await loop.sock_sendall(sock, hello)
                await asyncio.wait_for(loop.sock_recv(sock, 100), 5)
                load.counts["half handshakes"] += 1
            except (OSError, asyncio.TimeoutError):
                pass
            sock.close()

    await load.together(*(whole() for _ in range(12)), *(half() for _ in range(12)))


@attack(
    rf"{ADDRESS}: no (TLS connection|complete CONNECT)", at_least=1.4, short=False, over=Over.TLS
)
async def tls_half_open(load: Load) -> None:
    """Hundreds of TLS handshakes that stop after, or drip, their first message."""
    hello = _client_hello(load)
    loop = asyncio.get_running_loop()
    socks = []
    try:
        async for round_ in load.rounds(0.02):
            if len(socks) < 900 and load.within(0.8):
                for _ in range(20):
                    sock = await load.raw(Over.TLS)
                    socks.append(sock)
                    part = hello if round_ % 2 else hello[: len(hello) // 2]
                    await loop.sock_sendall(sock, part)
        load.counts["crowd"] = len(socks)
    finally:
        for sock in socks:
            sock.close()


@attack(r"(user|client) 'mallory.*refused: (wrong password|unknown user|too many passwords)")
async def wrong_passwords(load: Load) -> None:
    """Logins with wrong passwords and unknown names, as many as can be made."""

    async def guess(worker: int) -> None:
        async for number in load.rounds():
            try:
                line = await load.dial(Over.PLAIN if load.ways == BOTH else None)
            except (OSError, asyncio.TimeoutError):
                continue
            user = USER if number % 2 else f"{USER}{number}"
            secret = b"%d.%d" % (worker, number)
            line.send_nowait(load.connect_packet(f"{USER}-guess", username=user, password=secret))
            await line.receive(5)
            load.counts["guesses"] += 1
            line.abort()
            load.lines.discard(line)

    await load.together(*(guess(number) for number in range(100)))


# --- over WebSocket

#: What is asked of the attacks on what is below MQTT.
WEB: dict[str, Any] = {"over": Over.WEBSOCKET, **BOUNDED}


async def _web(load: Load, client_id: str) -> WebLine:
    line = await load.join(client_id)
    assert isinstance(line, WebLine)
    return line


async def _push_forever(load: Load, clients: int, data: bytes, count: int, what: str) -> None:
    """Clients that send the same frames again and again, and come again when they are cut off."""

    async def push(number: int) -> None:
        async for turn in load.rounds(0.02):
            line = await _web(load, f"web-{number}-{turn}")
            try:
                while load.on and line.open:
                    await line.push(data)
                    load.counts[what] += count
                    await asyncio.sleep(0)
            finally:
                load.counts["pongs"] += line.pongs

    await load.together(*(push(number) for number in range(clients)))
    assert load.counts[what]


async def _push_at_once(load: Load, chunks: list[bytes], pause: float, begin: bytes = b"") -> None:
    """245 clients that each send one of the chunks, all in one moment, again and again."""

    async def stay(number: int) -> Line:
        line = await _web(load, f"web-{number}")
        await line.push(begin)
        return line

    lines = await load.crowd(245, stay, 0.5)
    async for turn in load.rounds(pause):
        for line in lines:
            if line.open:
                line.transport.write(chunks[turn % len(chunks)])
        load.counts["chunks"] += len(lines)
    assert any(line.open for line in lines), "nobody is left"


@attack(rf"{CLIENT}", at_least=2.0, **WEB)
async def web_bytes(load: Load) -> None:
    """Twenty clients whose frames hold one byte each, as fast as they are read."""
    ping = Pingreq().encode(5)
    data = (frame(ping[:1]) + frame(ping[1:])) * 5000
    await _push_forever(load, 20, data, 10_000, "frames")


@attack(rf"{CLIENT}", at_least=2.5, **WEB)
async def web_bytes_at_once(load: Load) -> None:
    """245 clients that send 2,000 bytes of one-byte frames, all in one moment."""
    ping = Pingreq().encode(5)
    await _push_at_once(load, [(frame(ping[:1]) + frame(ping[1:])) * 142], 0.3)


@attack(rf"{CLIENT}", at_least=2.5, **WEB)
async def web_segments(load: Load) -> None:
    """245 clients whose frames come a byte at a time, in segments of their own."""
    data = frame(encode5(Publish(AREA, bytes(10), 1, packet_id=1)))
    await _push_at_once(load, [data[at : at + 1] for at in range(len(data))], 0.01)


@attack(rf"{CLIENT}", at_least=2.0, **WEB)
async def web_fragments(load: Load) -> None:
    """Twenty clients with one message of empty fragments, without an end."""
    data = frame(b"", BINARY, last=False) + frame(b"", CONTINUATION, last=False) * 10_000
    again = data + frame(b"", CONTINUATION)
    await _push_forever(load, 20, again, 10_000, "fragments")


@attack(rf"{CLIENT}", at_least=2.5, **WEB)
async def web_fragments_at_once(load: Load) -> None:
    """245 clients that each send 2,040 bytes of empty fragments, all in one moment."""
    chunk = frame(b"", CONTINUATION, last=False) * 340
    await _push_at_once(load, [chunk], 0.3, frame(b"", BINARY, last=False))


@attack(rf"{CLIENT}", at_least=4.0, **WEB)
async def web_pings(load: Load) -> None:
    """Twenty clients that send pings, empty ones and the largest, as fast as they are read."""
    data = frame(b"", PING) * 5000 + frame(bytes(125), PING) * 500
    await _push_forever(load, 20, data, 5500, "pings")
    assert load.counts["pongs"], "no ping was answered"


@attack(rf"{CLIENT}", at_least=2.5, **WEB)
async def web_pings_at_once(load: Load) -> None:
    """245 clients that each send 2,040 bytes of pings, or of pongs, all in one moment."""
    await _push_at_once(load, [frame(b"", PING) * 340, frame(b"", PONG) * 340], 0.3)


@attack(r"not the WebSocket protocol: a frame that is too large", at_least=2.0, **WEB)
async def web_giants(load: Load) -> None:
    """Frames that announce 2^63 bytes, or what is just allowed; those of the latter are dripped."""
    sizes = [1 << 63, (1 << 63) - 1, 1 << 31, 16 << 20]
    heads = [b"\x82\xff" + size.to_bytes(8, "big") + bytes(4) for size in sizes]

    async def come(number: int) -> Line:
        line = await _web(load, f"web-{number}")
        await line.push(heads[number % 4] + bytes(2000))
        load.counts["heads"] += 1
        return line

    while load.on:
        await load.crowd(245, come, 1.0)
        for line in list(load.lines):
            if line.open:
                line.transport.write(bytes(1000))
            else:
                load.lines.discard(line)
        await asyncio.sleep(0.05)


@attack(rf"{ADDRESS}: no complete CONNECT within", at_least=2.0, **WEB)
async def web_strangers(load: Load) -> None:
    """245 strangers who send all kinds of frames and never log in."""
    chunks = [
        frame(b"", PING) * 340,
        frame(b"", BINARY) * 340,
        frame(b"", BINARY, last=False) + frame(b"", CONTINUATION, last=False) * 338,
        frame(load.connect_packet("stranger")[:1]) + frame(bytes(125), PONG) * 15,
    ]

    async def come(number: int) -> Line:
        line = await load.dial()
        assert isinstance(line, WebLine)
        await line.push(chunks[number % 4])
        return line

    async for _ in load.rounds(0.2):
        await load.crowd(245 - len(load.lines), come, 1.0)
        for number, line in enumerate(list(load.lines)):
            if line.open:
                line.transport.write(chunks[number % 2])
                load.counts["chunks"] += 1
            else:
                load.lines.discard(line)


@attack(rf"{ADDRESS}: no complete CONNECT within", at_least=2.0, **WEB)
async def web_requests_dripped(load: Load) -> None:
    """245 strangers whose requests for a WebSocket come a byte at a time."""
    requests = itertools.cycle([UPGRADE, UPGRADE[:-2] + _headers(15_000)])
    loop = asyncio.get_running_loop()

    async def drip() -> None:
        while load.on:
            request = next(requests)
            with contextlib.suppress(OSError, asyncio.TimeoutError), await load.raw() as sock:
                for at in range(len(request)):
                    await loop.sock_sendall(sock, request[at : at + 1])
                    load.counts["bytes"] += 1
                    await asyncio.sleep(0.005)

    await load.together(*(drip() for _ in range(245)))


@attack(rf"{ADDRESS}: no WebSocket connection", at_least=2.0, connect_timeout="10 s", **WEB)
async def web_headers(load: Load) -> None:
    """The last byte of 245 requests with as many headers as may be, all in one moment."""
    loop = asyncio.get_running_loop()
    begin = UPGRADE[:-2]
    # All but the last byte, a line feed.
    requests = itertools.cycle(
        [
            begin + _headers(15_000) + b"\r",
            begin + _headers(15_000, 120) + b"\r",
            begin + b"Sec-WebSocket-Protocol: " + b"a," * 4000 + b"a\r\n\r",
            begin + b"Sec-WebSocket-Extensions: " + b"a;b=c," * 1300 + b"a\r\n\r",
            begin + b"Connection: " + b"a, " * 2600 + b"a\r\n\r",
            b"GET " + b"/" * 8000 + b" HTTP/1.1\r\n\r",
        ]
    )

    async def wait(_: int) -> Line:
        sock = await load.raw()
        _, line = await loop.create_connection(lambda: Line(sock), sock=sock)
        load.lines.add(line)
        await line.send(next(requests))
        return line

    await _finish_at_once(load, wait)


async def _finish_at_once(
    load: Load, wait: Callable[[int], Awaitable[Line]], count: int = 245
) -> None:
    """Send the last byte of so many requests, of which `wait` has sent the rest, over and over."""
    while load.on:
        lines = await load.crowd(count, wait, 1.0)
        await asyncio.sleep(0.1)  # for the broker to have read them
        for line in lines:
            line.send_nowait(b"\n")
        load.counts["requests"] += len(lines)
        await asyncio.sleep(0.2)
        for line in lines:
            load.counts["answered"] += line.received > 0
            load.counts["served"] += line.first.startswith(b"HTTP/1.1 200")
            line.abort()
            load.lines.discard(line)
    assert load.counts["answered"]


def _headers(size: int, count: int = 0) -> bytes:
    """So many bytes of headers: so many, or as many as there can be."""
    if not count:
        return b"a:\r\n" * (size // 4)
    return (b"a: " + b"b" * (size // count - 5) + b"\r\n") * count


# --- over HTTP


@attack(rf"{ADDRESS}: no HTTP request", at_least=2.0, over=Over.PLAIN, connect_timeout="10 s")
async def http_headers(load: Load) -> None:
    """The last byte of 245 requests with as many headers as may be, or one of many parts, all in
    one moment."""
    begin = b"GET / HTTP/1.1\r\nHost: localhost\r\n"
    # All but the last byte, a line feed.
    requests = itertools.cycle(
        [
            begin + _headers(15_000) + b"\r",
            begin + _headers(15_000, 120) + b"\r",
            begin + b"Accept-Encoding: " + b"," * 15_000 + b"\r\n\r",
            begin + b"Connection: " + b"a," * 7_500 + b"\r\n\r",
            begin + b"a: b\r\n" + b" c\r\n" * 3_500 + b"\r",
        ]
    )

    async def wait(_: int) -> Line:
        line = await load.http()
        await line.send(next(requests))
        return line

    await _finish_at_once(load, wait)


@attack(CLIENT, at_least=3.0, over=Over.PLAIN, connect_timeout="10 s")
async def http_bodies(load: Load) -> None:
    """Bodies of 1 MiB for the API that are nothing but empty lists."""
    body = b'{"topic": "%s", "payload": [%s[]]}' % (AREA.encode(), b"[]," * 340_000)
    await load.together(*(_post_forever(load, _post(load, len(body)) + body) for _ in range(4)))
    assert load.counts["answers"]


@attack(CLIENT, at_least=3.0, over=Over.PLAIN, connect_timeout="10 s")
async def http_bodies_at_once(load: Load) -> None:
    """The last byte of 20 bodies of up to 1 MiB for the API that are read slowly, in one moment."""
    begin = b'{"topic": "%s", "payload": ' % AREA.encode()
    names = b",".join(b'"%05d":1.5' % number for number in range(49_000))
    bodies = itertools.cycle(
        [
            begin + b"{" + names + b"}}\n",
            begin + b'"' + rb"\"" * 520_000 + b'"}\n',
            begin + b"[" + b",".join([b"1.234567"] * 99_000) + b"]}\n",
        ]
    )

    async def wait(_: int) -> Line:
        body = next(bodies)
        line = await load.http()
        await line.send(_post(load, len(body)) + body[:-1])
        return line

    await _finish_at_once(load, wait, 20)
    assert load.counts["served"]  # not refused before they were read


@attack(CLIENT, at_least=4.0, over=Over.PLAIN, connect_timeout="3 s")
async def http_bodies_dripped(load: Load) -> None:
    """200 bodies for the API that come a byte at a time, behind the first 100 KiB."""
    head = _post(load, 1_000_000)

    async def begin(_: int) -> Line:
        line = await load.http()
        await line.send(head + bytes(100_000))
        return line

    async for _ in load.rounds(0.2):
        await load.crowd(200 - len(load.lines), begin, 1.0)
        for line in list(load.lines):
            if line.open:
                line.send_nowait(b"x")
                load.counts["bytes"] += 1
            else:
                load.lines.discard(line)


def _post(load: Load, length: int) -> bytes:
    """The head of a request that publishes."""
    login = base64.b64encode(f"{USER}:{load.target.passwords[USER]}".encode())
    return (
        b"POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\nAuthorization: Basic %s\r\n"
        b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n" % (login, length)
    )


async def _post_forever(load: Load, request: bytes) -> None:
    while load.on:
        line = await load.http()
        await line.send(request)
        load.counts["answers"] += await line.receive(1)
        line.abort()
        load.lines.discard(line)


# --- behind a login: who does not listen


@attack(rf"{CLIENT}.*queue is full", logged_after=3.0)
async def never_acknowledging(load: Load) -> None:
    """Subscribers that acknowledge nothing of QoS 1 and 2, with a flood of both behind them."""

    async def stay(number: int) -> Line:
        expiry = {Property.SESSION_EXPIRY_INTERVAL: 3600} if number % 2 else None
        line = await load.join(f"silent-{number}", clean_start=False, properties=expiry)
        wanted = [Subscription(f"{AREA}/flood/#", 1 + number % 4 // 2)]
        line.send_nowait(encode5(Subscribe(1, wanted)))
        return line

    await load.crowd(200, stay, 0.4)
    await load.together(
        _publish_forever(load, "flood-1", 1, 100), _publish_forever(load, "flood-2", 2, 1000)
    )


@attack(rf"{CLIENT}.*(queue is full|does not read|slow|dropped)", logged_after=3.0)
async def never_reading_small(load: Load) -> None:
    """Subscribers with every QoS that never read, and a flood of small messages behind them."""
    await _never_reading(load, 200, 50)


@attack(rf"{CLIENT}.*(queue is full|does not read|slow|dropped)", logged_after=3.0)
async def never_reading_large(load: Load) -> None:
    """Subscribers with every QoS that never read, and a flood of large messages behind them."""
    await _never_reading(load, 200, 200_000)


@attack(rf"{CLIENT}.*(queue is full|does not read|slow|asks for more)", logged_after=5.0)
async def never_reading_qos0(load: Load) -> None:
    """Subscribers with QoS 0 that never read, for whom messages are replaced and dropped."""
    await _never_reading(load, 200, 2000, (0,))


async def _never_reading(
    load: Load, readers: int, size: int, levels: tuple[int, ...] = (0, 1, 2)
) -> None:
    async def stay(number: int) -> Line:
        line = await load.join(f"unread-{number}", receive_buffer=4096)
        qos = levels[number % len(levels)]
        line.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/flood/#", qos)])))
        line.stop_reading()
        return line

    await load.crowd(readers, stay, 0.4)
    await load.together(*(_publish_forever(load, f"flood-{qos}", qos, size) for qos in levels))


@attack(rf"{CLIENT}", short=False)
async def fan_out(load: Load) -> None:
    """Subscribers that read all, and so many small messages for each that it takes forever."""

    async def stay(number: int) -> Line:
        line = await load.join(f"reader-{number}", version=V311)
        line.send_nowait(encode4(Subscribe(1, [Subscription(f"{AREA}/flood/#")])))
        return line

    await load.crowd(100, stay, 0.4)
    await load.together(*(_publish_forever(load, f"flood-{n}", 0, 1) for n in range(3)))


@attack(rf"{CLIENT}.*(does not read|asks for more|slow)", logged_after=5.0)
async def ping_flood(load: Load) -> None:
    """PINGREQs without end, and nobody who reads the answers."""
    pings = Pingreq().encode(4) * 60_000

    async def stay(number: int) -> Line:
        line = await load.join(f"ping-{number}", version=V311, receive_buffer=4096)
        line.stop_reading()
        return line

    lines = await load.crowd(50, stay, 0.3)
    await load.together(*(load.flood(line, pings, 60_000, "pings") for line in lines))


@attack(rf"{CLIENT}")
async def small_packets(load: Load) -> None:
    """A hundred clients that send the smallest packets there are, as fast as they are read."""
    ids = range(1, 10_000)
    chunks = [
        Publish("r2d2/x", b"").encode(4) * 20_000,
        encode4(*(Pubrel(number) for number in ids)) + b"\x40\x02\x12\x34" * 10_000,
        encode4(*(Pubrec(number) for number in ids)) + b"\x70\x02\x12\x34" * 10_000,
        Pingreq().encode(4) * 20_000,
    ]

    async def stay(number: int) -> Line:
        return await load.join(f"small-{number}", version=V311)

    lines = await load.crowd(100, stay, 0.4)
    floods = (
        load.flood(line, chunks[number % 4], 20_000, "packets") for number, line in enumerate(lines)
    )
    await load.together(*floods)


@attack(rf"{CLIENT}")
async def costly_filters(load: Load) -> None:
    """SUBSCRIBE and UNSUBSCRIBE with as many filters as one packet can hold."""
    many = MAXIMUM_CONTROL // 4 - 100
    packets = [
        encode5(Subscribe(1, [Subscription("x", 0)] * many)),
        encode5(Unsubscribe(1, ["x"] * many)),
    ]
    await _send_often(load, packets)


@attack(rf"{CLIENT}")
async def costly_properties(load: Load) -> None:
    """Messages that are nothing but user properties, three million of them."""
    topic = len(AREA).to_bytes(2, "big") + AREA.encode()
    pairs = 3_000_000
    body = topic + encode_varint(pairs * 5) + b"\x26\0\0\0\0" * pairs
    await _send_often(load, [b"\x30" + encode_varint(len(body)) + body])


async def _send_often(load: Load, packets: list[bytes]) -> None:
    """Many clients that send one of the packets again and again, and come again when cut off."""

    async def send(number: int) -> None:
        async for turn in load.rounds():
            line = await load.join(f"costly-{number}-{turn}")
            await load.flood(line, packets[number % len(packets)], 1, "packets")

    await load.together(*(send(number) for number in range(8)))


# --- subscriptions


@attack(r"may not subscribe to .*limits\.(subscriptions|queue_bytes|(user\.)?memory)")
async def subscription_bomb(load: Load) -> None:
    """A hundred thousand filters, 1,000 a client and one more, in packets as large as may be."""

    async def subscribe(number: int) -> Line:
        line = await load.join(f"bomb-{number}")
        wanted = [Subscription(f"{AREA}/{number}/{index}/+") for index in range(1001)]
        await line.send(encode5(Subscribe(1, wanted)))
        load.counts["filters"] += len(wanted)
        return line

    # All take turns: when there are seconds, one of them comes to its one more without the others.
    await subscribe(100)
    await asyncio.sleep(0.1)
    await load.crowd(100, subscribe, 1.0)


@attack(r"client 'deep.*levels")
async def deep_filters(load: Load) -> None:
    """Filters of 200 levels that share none but the first ones, and of more levels than allowed."""

    async def subscribe(number: int) -> Line:
        line = await load.join(f"deep-{number}")
        for start in range(0, 1000, 250):
            wanted = [
                Subscription(f"{AREA}/{number}/{index}" + "/+" * 196)
                for index in range(start, start + 250)
            ]
            await line.send(encode5(Subscribe(1, wanted)))
            load.counts["filters"] += len(wanted)
        line.send_nowait(encode5(Subscribe(1, [Subscription(AREA + "/+" * 200)])))
        return line

    await load.crowd(200, subscribe, 1.0)


@attack(r"may not subscribe to .*limits\.(subscriptions|queue_bytes|(user\.)?memory)")
async def long_filters(load: Load) -> None:
    """Filters of 65,535 bytes, a thousand a client, one of their characters beyond the BMP."""

    async def subscribe(number: int) -> Line:
        line = await load.join(f"long-{number}")
        for index in range(1001):
            topic = f"{AREA}/\U0001f916{number}/{index}/"
            wanted = [Subscription(topic + "x" * (65535 - len(topic.encode())))]
            await line.send(encode5(Subscribe(1, wanted)))
            load.counts["filters"] += 1
        return line

    await load.crowd(50, subscribe, 1.0)


@attack(rf"{CLIENT}")
async def matching_filters(load: Load) -> None:
    """All filters that match one topic of 14 levels, and messages to ever new ones of these."""
    levels = 12
    combinations = [
        AREA + "".join("/+" if bits >> level & 1 else "/a" for level in range(levels))
        for bits in range(1 << levels)
    ]

    async def subscribe(number: int) -> Line:
        line = await load.join(f"match-{number}")
        mine = combinations[number * 1000 : (number + 1) * 1000]
        await line.send(encode5(Subscribe(1, [Subscription(text) for text in mine])))
        load.counts["filters"] += len(mine)
        return line

    await load.crowd(-(-len(combinations) // 1000), subscribe, 0.4)
    publisher = await load.join("match-publisher")
    async for number in load.rounds():
        # Each topic is a new one: nothing that was looked up for the last helps.
        topics = [f"{AREA}{'/a' * (levels - 1)}/{number}-{index}" for index in range(500)]
        await publisher.send(encode5(*(Publish(topic, b"") for topic in topics)))
        load.counts["messages"] += len(topics)


@attack(rf"{CLIENT}", short=False)
async def everybody_listens(load: Load) -> None:
    """Hundreds of clients that subscribe to the healthy client's topic in every way there is."""
    healthy = HEALTHY.split("/")
    ways = [
        "/".join("+" if bits >> level & 1 else name for level, name in enumerate(healthy))
        for bits in range(8)
    ]
    ways += ["#", "+/#", "+/+/#", "+/+/+/#", "r2d2/#", "r2d2/healthy/#", f"{HEALTHY}/#"]

    async def subscribe(number: int) -> Line:
        line = await load.join(f"listen-{number}")
        line.send_nowait(encode5(Subscribe(1, [Subscription(way, number % 3) for way in ways])))
        return line

    await load.crowd(300, subscribe, 0.8)
    async for _ in load.rounds(0.1):
        pass


@attack(rf"{CLIENT}")
async def subscription_churn(load: Load) -> None:
    """Subscribe and unsubscribe without end, so that nothing that was looked up holds for long."""
    wanted = [Subscription(f"{AREA}/{index}/#", 1) for index in range(100)]
    names = [one.filter for one in wanted]
    chunk = encode5(Subscribe(1, wanted), Unsubscribe(2, names)) * 20

    async def stay(number: int) -> Line:
        return await load.join(f"churn-{number}")

    lines = await load.crowd(20, stay, 0.3)
    await load.together(*(load.flood(line, chunk, 4000, "changes") for line in lines))


# --- topics


@attack(r"may not publish to .*levels|(connection|limits)\.?_?topic_levels")
async def deep_topics(load: Load) -> None:
    """Topics of 200 levels, of 65,535 bytes, of more levels than allowed; never the same twice."""

    async def publish(number: int) -> None:
        line = await load.join(f"deep-{number}")
        async for turn in load.rounds():
            begin = f"{AREA}/{number}/{turn}"
            packets = [
                Publish(begin + "/a" * (200 - begin.count("/") - 1), b"x", 1, packet_id=1),
                Publish(begin + "/" + "x" * (65535 - len(begin) - 1), b"x", 1, packet_id=2),
                Publish(begin + "/" * 195 + "\U0001f916" * 8000, b"x", 1, packet_id=3),
            ]
            if not turn % 100:
                packets.append(Publish(begin + "/" * 60000, b"x", 1, packet_id=4))
            await line.send(encode5(*packets))
            load.counts["messages"] += len(packets)

    await load.together(*(publish(number) for number in range(50)))


@attack(rf"{CLIENT}", at_least=2.0, **BOUNDED)
async def new_deep_topics(load: Load) -> None:
    """Twenty clients that publish to ever new topics of 100 levels, as fast as they are read."""

    async def publish(number: int) -> None:
        line = await load.join(f"new-{number}")
        async for turn in load.rounds():
            topics = (f"{AREA}/{number}/{turn}/{index}" + "/abcd" * 95 for index in range(20))
            await line.send(encode5(*(Publish(topic, b"x", 1, packet_id=1) for topic in topics)))
            await line.receive(line.received + 20 * 4)
            load.counts["messages"] += 20

    await load.together(*(publish(number) for number in range(20)))


@attack(rf"{CLIENT}", at_least=2.0, **BOUNDED)
async def little_chunks(load: Load) -> None:
    """A hundred clients that each send 15 kB to new topics, all in one moment, again and again."""

    def make(number: int) -> bytes:
        return encode5(*(Publish(f"{AREA}/{number}/{index}", b"") for index in range(600)))

    await _at_once(load, 100, 0.5, make)


@attack(rf"{CLIENT}", at_least=2.0, **BOUNDED)
async def near_misses(load: Load) -> None:
    """Twenty clients, each message of which passes two thousand filters that do not match."""
    levels = 11
    for number in range(3):
        line = await load.join(f"filters-{number}")
        await line.send(encode5(Subscribe(1, _near_misses(levels, number * 1000, 1000))))

    def make(number: int) -> bytes:
        topics = (f"{AREA}{'/a' * levels}/{number}-{index}" for index in range(5))
        return encode5(*(Publish(topic, b"") for topic in topics))

    await _at_once(load, 20, 0.3, make)


@attack(rf"{CLIENT}", short=False)
async def invented_topics(load: Load) -> None:
    """Each client publishes to a thousand topics of its own, so that all of them are remembered."""
    filler = "x" * 440

    async def publish(number: int) -> Line:
        line = await load.join(f"many-{number}")
        line.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/none/{number}/#")])))
        for start in range(0, 1000, 100):
            topics = (f"{AREA}/{number}/{start + index}/{filler}" for index in range(100))
            await line.send(encode5(*(Publish(topic, b"") for topic in topics)))
        load.counts["topics"] += 1000
        return line

    await load.crowd(400, publish, 1.0)


@attack(r"topic alias (11|0|7)|TOPIC_ALIAS must not be")
async def topic_aliases(load: Load) -> None:
    """All the aliases there are, each for a topic of 65,535 bytes; and ones that there are not."""

    async def keep(number: int) -> Line:
        line = await load.join(f"alias-{number}")
        for alias in range(1, 11):
            begin = f"{AREA}/\U0001f916{number}/{alias}/"
            topic = begin + "x" * (65535 - len(begin.encode()))
            await line.send(encode5(Publish(topic, b"", properties={Property.TOPIC_ALIAS: alias})))
        load.counts["aliases"] += 10
        return line

    async def abuse() -> None:
        async for number in load.rounds(0.01):
            line = await load.join(f"alias-abuse-{number % 50}")
            alias = (0, 7, 11, 65535)[number % 4]
            topic = "" if alias == 7 else AREA
            line.send_nowait(encode5(Publish(topic, b"", properties={Property.TOPIC_ALIAS: alias})))
            await line.closed.wait()
            load.lines.discard(line)
            load.counts["wrong aliases"] += 1

    async def crowd() -> None:
        await load.crowd(400, keep, 1.0)

    await load.together(crowd(), abuse())


@attack(r"may not publish to 'r2d2/forbidden", at_least=2.0, **BOUNDED)
async def long_refusals(load: Load) -> None:
    """Refused messages to a topic of 64 KB that a log line quotes, each time by new client ids."""
    topic = f"r2d2/forbidden/{chr(0xE0001) * 16_370}"
    first = Publish(topic, b"", properties={Property.TOPIC_ALIAS: 1})
    again = Publish("", b"", properties={Property.TOPIC_ALIAS: 1})
    data = encode5(first, *[again] * 6)

    async def publish(number: int) -> None:
        async for turn in load.rounds(0.05):
            line = await load.join(f"refused-{number}-{turn}")
            await line.send(data)
            load.counts["refused messages"] += 7
            await asyncio.sleep(0.02)
            line.abort()
            load.lines.discard(line)

    await load.together(*(publish(number) for number in range(20)))


# --- retained messages


@attack(r"no room to retain", logged_after=3.0)
async def retained_flood(load: Load) -> None:
    """Retained messages, small ones to ever new topics and large ones, beyond the limit."""

    async def publish(number: int) -> None:
        line = await load.join(f"retain-{number}")
        size = (10, 100, 100_000)[number % 3]
        async for turn in load.rounds():
            packets = [
                Publish(f"{AREA}/{number}/{turn}-{index}", b"x" * size, retain=True)
                for index in range(max(1, min(100, 100_000 // size)))
            ]
            await line.send(encode5(*packets))
            load.counts["messages"] += len(packets)

    await load.together(*(publish(number) for number in range(6)))


@attack(r"no room to retain|may not publish")
async def retained_deep(load: Load) -> None:
    """Retained messages of one byte to ever new topics of 200 levels."""

    async def publish(number: int) -> None:
        line = await load.join(f"retain-{number}")
        async for turn in load.rounds():
            packets = [
                Publish(f"{AREA}/{number}/{turn}/{index}" + "/a" * 194, b"x", retain=True)
                for index in range(50)
            ]
            await line.send(encode5(*packets))
            load.counts["messages"] += len(packets)

    await load.together(*(publish(number) for number in range(6)))


async def _retain(load: Load, share: float, packets: Iterator[Publish]) -> None:
    """As many of them as that share of the time allows."""
    publisher = await load.join("retain")
    while load.within(share) and (some := list(itertools.islice(packets, 500))):
        await publisher.send(encode5(*some))
        load.counts["retained"] += len(some)


@attack(rf"{CLIENT}")
async def retained_replays(load: Load) -> None:
    """Clients that ask for all retained messages again and again, with every QoS."""
    await _retain(
        load, 0.4, (Publish(f"{AREA}/{n % 10}/{n}", b"x" * 50, retain=True) for n in range(10_000))
    )

    async def ask(number: int) -> None:
        line = await load.join(f"replay-{number}")
        if number % 2:
            line.stop_reading()
        wanted = [Subscription(way, number % 3) for way in ("#", "+/#", "r2d2/#", "+/+/+/+")]
        packet = encode5(Subscribe(1, wanted))
        async for _ in load.rounds(0.02):
            await line.send(packet)
            load.counts["subscriptions"] += len(wanted)

    await load.together(*(ask(number) for number in range(20)))


@attack(rf"{CLIENT}")
async def retained_needles(load: Load) -> None:
    """Filters whose search goes through all retained messages and finds none."""
    await _retain(load, 0.5, (Publish(f"{AREA}/{n}/a/b", b"x", retain=True) for n in range(15_000)))

    async def ask(number: int) -> None:
        line = await load.join(f"needle-{number}")
        wanted = [Subscription(f"{AREA}/+/a/+/{index}") for index in range(100)]
        packet = encode5(Subscribe(1, wanted))
        async for _ in load.rounds(0.01):
            await line.send(packet)
            load.counts["searches"] += len(wanted)

    await load.together(*(ask(number) for number in range(10)))


# --- large packets


@attack(r"client '.*more than the limit of")
async def announced_giants(load: Load) -> None:
    """Packets that announce 256 MB and drip; and ones that announce what is just allowed."""
    huge = b"\x30" + encode_varint(268_435_455)
    allowed = b"\x32" + encode_varint((16 << 20) - 5)
    topic = len(AREA).to_bytes(2, "big") + AREA.encode()

    async def announce(number: int) -> Line:
        line = await load.join(f"giant-{number}")
        line.send_nowait((allowed if number % 4 else huge) + topic)
        return line

    await load.crowd(400, announce, 0.6)
    async for _ in load.rounds(0.05):
        lines = [line for line in load.lines if line.open]
        for line in lines:
            line.send_nowait(b"x" * 10)
        load.counts["drips"] += len(lines)


@attack(rf"{CLIENT}")
async def unfinished_giants(load: Load) -> None:
    """Many clients that send packets of 16 MB but for the last byte, all at the same time."""
    body = len(AREA).to_bytes(2, "big") + AREA.encode() + b"\0"
    size = (16 << 20) - 5
    packet = b"\x30" + encode_varint(size) + body + bytes(size - len(body) - 1)

    async def stay(number: int) -> Line:
        return await load.join(f"giant-{number}")

    lines = await load.crowd(50, stay, 0.3)

    async def send(line: Line) -> None:
        for start in range(0, len(packet), 1 << 18):
            await line.send(packet[start : start + (1 << 18)])
            load.counts["MiB"] = round(load.counts["bytes"] / (1 << 20))
            load.counts["bytes"] += 1 << 18

    await load.together(*(send(line) for line in lines))


@attack(rf"{CLIENT}")
async def giants(load: Load) -> None:
    """Messages of 16 MB, many at the same time, to receivers of which most do not read."""
    packet = encode5(Publish(f"{AREA}/giant", bytes((16 << 20) - 100)))

    async def receive(number: int) -> Line:
        line = await load.join(f"giant-reader-{number}", receive_buffer=65536)
        line.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/giant", number % 3)])))
        if number % 4:
            line.stop_reading()
        return line

    async def stay(number: int) -> Line:
        return await load.join(f"giant-{number}")

    await load.crowd(20, receive, 0.3)
    lines = await load.crowd(10, stay, 0.4)
    await load.together(*(load.flood(line, packet, 1, "messages") for line in lines))


# --- packet ids, QoS 2


@attack(r"client '.*(no room for its unfinished|unfinished QoS 2|packet ids)", logged_after=3.0)
async def packet_ids(load: Load) -> None:
    """65,535 messages of QoS 2 that are never released, of 3.1.1 clients and of 5.0 ones."""
    every = [
        encode4(
            *(Publish(AREA, b"x", 2, packet_id=number) for number in range(start, start + 4369))
        )
        for start in range(1, 65536, 4369)
    ]
    fives = encode5(*(Publish(AREA, b"x", 2, packet_id=number) for number in range(1, 100)))

    async def exhaust(number: int) -> None:
        async for turn in load.rounds():
            line = await load.join(f"ids-{number}-{turn}", version=V311, clean_start=False)
            for chunk in every:
                await line.send(chunk)
                load.counts["ids"] += 4369
            five = await load.join(f"ids5-{number}-{turn}")
            await five.send(fives)
            await five.closed.wait()

    await load.together(*(exhaust(number) for number in range(5)))


@attack(rf"{CLIENT}", at_least=2.0, **BOUNDED)
async def unreleased(load: Load) -> None:
    """Twenty clients of 3.1.1 that send 180 kB of the smallest messages of QoS 2 in one moment."""
    chunk = encode4(*(Publish("r2d2/q2", b"", 2, packet_id=1 + n) for n in range(14_000)))
    await _at_once(load, 20, 0.7, lambda number: chunk, version=V311)


@attack(rf"{CLIENT}")
async def never_completing(load: Load) -> None:
    """Subscribers that answer a QoS 2 message with PUBREC and never with PUBCOMP."""

    async def stay(number: int) -> Line:
        line = await load.join(f"half-{number}")
        line.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/flood/#", 2)])))
        line.send_nowait(encode5(*(Pubrec(packet_id) for packet_id in range(1, 21))))
        return line

    lines = await load.crowd(50, stay, 0.4)

    async def half() -> None:
        answer = encode5(*(Pubrec(packet_id) for packet_id in range(1, 21)))
        async for _ in load.rounds(0.05):
            for line in lines:
                line.send_nowait(answer)

    await load.together(half(), _publish_forever(load, "flood", 2, 1000))


# --- connections that are not what they seem


@attack(rf"{CLIENT}.*(connection lost|closed)")
async def half_closed(load: Load) -> None:
    """Clients that end their half of the connection and stay, before the login and behind it."""

    async def close(number: int) -> Line:
        if number % 3:
            line = await load.join(f"half-{number}", receive_buffer=4096)
            line.send_nowait(encode5(Subscribe(1, [Subscription(HEALTHY, 1)])))
        else:
            line = await load.dial()
            line.send_nowait(load.connect_packet(f"half-{number}")[:20])
        line.stop_reading()
        line.half_close()
        return line

    while load.on:
        await load.crowd(300, close, 1.0)


@attack(rf"{CLIENT}.*silent for", at_least=4.0)
async def dripping_keep_alive(load: Load) -> None:
    """Clients that drip the bytes of one long packet so as to be kept alive for ever."""
    packet = encode5(Publish(AREA, bytes(10_000)))

    async def stay(number: int) -> Line:
        return await load.join(f"drip-{number}", keep_alive=1)

    lines = await load.crowd(300, stay, 0.3)
    async for number in load.rounds(0.1):
        for line in lines:
            line.send_nowait(packet[number : number + 1])
    alive = sum(line.open for line in lines)
    assert not alive, f"{alive} of {len(lines)} clients are still there"


@attack(rf"{CLIENT}.*connection lost")
async def wills(load: Load) -> None:
    """Clients with the largest wills, all gone in one moment, and again; some of them listen."""
    large = load.connect_packet("will-000000", will=_heavy_will(MAXIMUM_CONTROL - 300))
    watcher = await load.join("will-watcher")
    watcher.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/#", 1)])))
    watcher.stop_reading()

    async def stay(number: int) -> Line:
        if number % 2:
            packet = large.replace(b"will-000000", b"will-%06d" % number)
            return await load.join("", packet=packet)
        small = Will(f"{AREA}/will/{number}", b"gone", 1, retain=True)
        return await load.join(f"will-{number}", will=small)

    while load.on:
        lines = await load.crowd(500, stay, 0.9)
        for line in lines:
            line.abort()
        load.counts["wills"] += len(lines)
        await asyncio.sleep(0.2)


@attack(rf"{CLIENT}", at_least=3.0, **BOUNDED)
async def costly_wills(load: Load) -> None:
    """Hundreds of wills that are due in one moment, each to a topic whose search is long."""
    levels = 11
    topic = AREA + "/a" * levels
    for number in range(2):
        line = await load.join(f"filters-{number}")
        await line.send(encode5(Subscribe(1, _near_misses(levels, number * 1000, 1000))))

    async def leave(number: int) -> Line:
        delay = {Property.WILL_DELAY_INTERVAL: 1}
        return await load.join(
            f"will-{number}",
            will=Will(f"{topic}/{number}", b"gone", properties=delay),
            properties={Property.SESSION_EXPIRY_INTERVAL: 60},
        )

    while load.on:
        lines = await load.crowd(300, leave, 1.0)
        for line in lines:
            line.abort()
            load.lines.discard(line)
        load.counts["wills"] += len(lines)
        await asyncio.sleep(1.2)


@attack(
    r"makes room for user 'alice'",
    at_least=6.0,
    connections=60,
    sessions=200,
    retained_messages=300,
)
async def hoarder(load: Load) -> None:
    """All sessions, connections, memory and retained messages for one user; others come and go."""

    async def stay(number: int) -> Line:
        line = await load.join(f"stays-{number}")
        line.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/#", 1)])))
        line.stop_reading()
        return line

    async def leave(number: int) -> Line:
        line = await load.join(
            f"leaves-{number}", properties={Property.SESSION_EXPIRY_INTERVAL: 604800}
        )
        await line.send(encode5(Subscribe(1, [Subscription(f"{AREA}/#", 1)])))
        await line.receive(line.received + 5)
        line.abort()
        load.lines.discard(line)
        load.counts["sessions"] += 1
        return line

    async def fill() -> None:
        publisher = await load.join("fills")
        async for turn in load.rounds(0.02):
            if not publisher.open:
                publisher = await load.join("fills")
            numbers = range(20 * turn, 20 * turn + 20)
            await publisher.send(
                encode5(
                    *(Publish(f"{AREA}/{n}", bytes(2000), 1, True, packet_id=1) for n in numbers)
                )
            )
            load.counts["messages"] += 20

    async def again_and_again(count: int, make: Callable[[int], Awaitable[Line]]) -> None:
        while load.on:
            await load.crowd(count, make, 1.0)
            await asyncio.sleep(0.05)

    async def alice() -> None:
        """With a session of her own, which is to be there each time, and a retained message."""
        password = load.target.passwords["alice"].encode()
        who: dict[str, Any] = {"username": "alice", "password": password}
        kept = {"clean_start": False, "properties": {Property.SESSION_EXPIRY_INTERVAL: 604800}}
        news, plan = "r2d2/alice/news", "r2d2/alice/plan"
        present = False
        async for turn in load.rounds(0.05):
            line = await load.join("alice-keeps", **who, **kept)
            assert line.first[2] == present, "alice's session was gone"
            heard = line.received
            line.send_nowait(encode5(Subscribe(1, [Subscription(news, 1, retain_handling=2)])))
            assert await line.receive(heard + 6), "alice's SUBSCRIBE was not answered"
            line.abort()
            present = True
            other = await load.join(f"alice-{turn}", **who)
            heard = other.received
            publish = Publish(plan, b"%d" % turn, 1, True, packet_id=1)
            other.send_nowait(encode5(publish, Publish(news, b"%d" % turn, 1, packet_id=2)))
            # A PUBACK with a reason code other than success is longer.
            assert await other.receive(heard + 8), "alice's messages were not acknowledged"
            answer = bytes(other.first[heard : heard + 12])
            assert 0x97 not in answer, f"alice's messages were refused: {answer.hex()}"
            other.abort()
            load.lines -= {line, other}
            load.counts["visits of alice"] += 1

    visits = asyncio.ensure_future(alice())
    await load.together(fill(), again_and_again(100, stay), again_and_again(400, leave))
    if not visits.done():
        visits.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await visits
    assert load.counts["visits of alice"] >= 2, "alice hardly came"


@attack(
    r"client '.*limits\.(user\.)?(sessions|memory)",
    logged_after=3.0,
    sessions=300,
)
async def session_bomb(load: Load) -> None:
    """Ever new client ids, each with a session to be kept for days, with all that may be in it."""
    long = "\U0001f916" + "x" * 60_000

    async def leave(number: int) -> Line:
        # Every other id is as long as may be.
        client_id = f"session-{number}" + (long if number % 2 else "")
        line = await load.join(
            client_id,
            clean_start=False,
            properties={Property.SESSION_EXPIRY_INTERVAL: 604800},
            will=Will(AREA, bytes(60_000), properties={Property.WILL_DELAY_INTERVAL: 604800}),
        )
        wanted = [Subscription(f"{AREA}/{number}/{index}/#", 1) for index in range(100)]
        await line.send(encode5(Subscribe(1, wanted)))
        await line.receive(line.received + 50)
        line.abort()
        load.lines.discard(line)
        load.counts["sessions"] += 1
        return line

    while load.on:
        await load.crowd(2000, leave, 1.0)


@attack(rf"{CLIENT}.*taken over")
async def take_overs(load: Load) -> None:
    """Many connections at a time for one client id, with a full queue to be sent to each."""
    kept = {"clean_start": False, "properties": {Property.SESSION_EXPIRY_INTERVAL: 600}}
    first = await load.join("one", **kept)
    first.send_nowait(encode5(Subscribe(1, [Subscription(f"{AREA}/flood/#", 1)])))

    async def take() -> None:
        while load.on:
            line = await load.dial()
            line.send_nowait(load.connect_packet("one", **kept))
            load.counts["take-overs"] += 1
            await line.receive(4)
            load.lines.discard(line)

    await load.together(
        *(take() for _ in range(20)), _publish_forever(load, "take-flood", 1, 50_000)
    )


# --- what is refused, and logged


@attack(r"client 'forbidden.*may not publish|may not publish.*forbidden", at_least=2.0)
async def refused_publishes(load: Load) -> None:
    """Messages that the rules refuse, thousands a second, to the same topic and to new ones."""

    async def publish(number: int) -> None:
        line = await load.join(f"forbidden-{number}")
        async for turn in load.rounds():
            topics = (f"r2d2/forbidden/{turn}/{index // 10}" for index in range(500))
            packets = [Publish(topic, b"x", 1, packet_id=1) for topic in topics]
            packets.append(Publish("r2d2/forbidden/" + "long" * 15_000, b"x"))
            packets.append(Publish("$SYS/broker/version", b"x", 1, packet_id=2))
            await line.send(encode5(*packets))
            load.counts["messages"] += len(packets)

    await load.together(*(publish(number) for number in range(10)))


@attack(r"client 'curious.*may not subscribe", at_least=2.0)
async def refused_subscriptions(load: Load) -> None:
    """Filters that the rules refuse, thousands a second, and ones that are wrong."""
    wrong = [AREA + "/a#b", "$share//x", "$share/g", "a+/b"]

    async def subscribe(number: int) -> None:
        line = await load.join(f"curious-{number}")
        async for turn in load.rounds():
            wanted = [Subscription(f"c3po/{turn}/{index}") for index in range(500)]
            wanted += [Subscription("c3po/" + "long" * 15_000)]
            await line.send(encode5(Subscribe(1, wanted)))
            load.counts["filters"] += len(wanted)

    async def blunder() -> None:
        async for turn in load.rounds(0.01):
            line = await load.join("blunder")
            line.send_nowait(encode5(Subscribe(1, [Subscription(wrong[turn % 4])])))
            await line.closed.wait()
            load.lines.discard(line)

    await load.together(blunder(), *(subscribe(number) for number in range(10)))


@attack(r"x{50}")
async def long_names(load: Load) -> None:
    """Client ids and user names of 60,000 bytes, which every line about the client would hold."""
    name = "x" * 60_000

    async def come(number: int) -> None:
        async for turn in load.rounds():
            line = await load.dial()
            if turn % 2:
                line.send_nowait(load.connect_packet(f"{number}-{turn}-{name}"))
            else:
                line.send_nowait(load.connect_packet("", username=name))
            await line.receive(4)
            line.abort()
            load.lines.discard(line)
            load.counts["names"] += 1

    await load.together(*(come(number) for number in range(10)))


@attack(r"127\.0\.0\.1.*connections_per_address", connections_per_address=50, connection_rate=1000)
async def one_address(load: Load) -> None:
    """More connections from one address than it may have: only so many are let in."""
    lines = await load.crowd(200, lambda number: load.join(f"crowd-{number}"), 0.7)
    await asyncio.sleep(0.1)
    there = sum(line.open for line in lines)
    assert 20 <= there <= 50, f"{there} of 200 connections are there; the healthy one is another"


@attack(r"127\.0\.0\.1.*connection_rate", connection_rate=20, short=False)
async def one_address_in_haste(load: Load) -> None:
    """More connections a second from one address than it may make."""
    lines = await load.crowd(1000, lambda number: load.join(f"crowd-{number}"), 0.9)
    allowed = 5 * 20 + 20 * load.seconds  # a burst is five times the rate
    assert len(lines) <= allowed + 10, f"{len(lines)} connections, and {allowed} are allowed"


# --- parts


def _near_misses(levels: int, start: int, count: int) -> list[Subscription]:
    """Filters that a search for a topic of so many levels `a` passes, and that none matches."""
    return [
        Subscription(
            AREA + "".join("/+" if bits >> level & 1 else "/a" for level in range(levels)) + "/none"
        )
        for bits in range(start, min(start + count, 1 << levels))
    ]


async def _at_once(
    load: Load, clients: int, pause: float, make: Callable[[int], bytes], **fields: Any
) -> None:
    """Clients that each send what is made for them, all in one moment, again and again."""

    async def stay(number: int) -> Line:
        return await load.join(f"burst-{number}", **fields)

    lines = await load.crowd(clients, stay, 0.4)
    async for turn in load.rounds(pause):
        for number, line in enumerate(lines):
            line.send_nowait(make(turn * clients + number))
        load.counts["bursts"] += 1
        assert any(line.open for line in lines), "nobody is left"


def _heavy_will(size: int) -> Will:
    """A will that makes a CONNECT of about so many bytes, most of them in user properties."""
    pairs = [("", "")] * ((size - 65_000) // 5)
    return Will(f"{AREA}/will", bytes(64_000), 1, properties={Property.USER_PROPERTY: pairs})


def _client_hello(load: Load) -> bytes:
    outgoing = ssl.MemoryBIO()
    tls = load.target.context().wrap_bio(ssl.MemoryBIO(), outgoing, server_hostname="localhost")
    try:
        tls.do_handshake()
    except ssl.SSLWantReadError:
        return outgoing.read()
    raise AssertionError("a handshake without the other side")


async def _publish_forever(load: Load, client_id: str, qos: int, size: int) -> None:
    """A flood of messages to a hundred topics under flood/, each exchange brought to its end."""
    line = await load.join(client_id, version=V311)
    count = max(1, min(1000, (1 << 18) // (size + 50)))
    chunk = b""
    for index in range(count):
        topic = f"{AREA}/flood/{client_id}/{index % 100}"
        packet_id = index + 1 if qos else None
        chunk += encode4(Publish(topic, bytes(size), qos, packet_id=packet_id))
        if qos == 2:
            assert packet_id is not None
            chunk += encode4(Pubrel(packet_id))
    await load.flood(line, chunk, count, "messages")
