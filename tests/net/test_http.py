"""HTTP of a listener for the web, with real sockets and raw bytes."""

from __future__ import annotations

import asyncio
import logging
import subprocess
import sys
from collections import deque
from collections.abc import AsyncIterator, MutableSequence
from typing import Any

import pytest
from both_loops import event_loop_policy as event_loop_policy
from harness import Harness, Peer
from http_client import answer, ask
from waiting import PATIENCE, until
from websockets.asyncio.client import connect

from appliance.broker.accounts import Account
from appliance.mqtt.packets import Connack, Connect, decode_packet
from appliance.net import http
from appliance.net.http import HEAD_LIMIT, SECURITY_HEADERS, HttpRequest, HttpResponse, text
from appliance.net.listeners import Admission, Listeners, ListenerSettings
from appliance.net.scheduler import COST_BETWEEN_CHECKS, COST_BEYOND_ROUND, COST_PER_ROUND
from appliance.web.site import Resource, WebSite

# The way that is left to override it, and to have both loops, is too new for some computers.
pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

GET = b"GET /small HTTP/1.1\r\nHost: localhost\r\n\r\n"
LARGE = bytes(8 << 20)

#: What is sent in one iteration of the loop: of a round, beyond it, and in the turns.
MOST_COST = 2 * COST_PER_ROUND + COST_BETWEEN_CHECKS + COST_BEYOND_ROUND
MOST_ANSWERS = MOST_COST // http.ANSWER_COST + 3


class Payer:
    """A client that has logged in with a request, as its connection charges it."""

    def __init__(self, name: str) -> None:
        self.account = Account(name)


class WebHarness(Harness):
    """Two listeners for the web: plain, and with TLS."""

    #: Whose requests with a body are.
    payer: Any = Payer("alice")

    def make(
        self, connections: int = 100, connect_timeout: float = PATIENCE, **limits: float
    ) -> Listeners:
        self.requests: MutableSequence[HttpRequest] = []
        self.slow = asyncio.Event()
        self.payer = Payer("alice")
        self.bodies: list[int] = []
        site = WebSite(
            {
                "/small": Resource(self._small),
                "/slow": Resource(self._slow),
                "/large": Resource(self._large),
                "/broken": Resource(self._broken),
                "/echo": Resource(self._echo, ("POST",), takes_body=True),
            },
            lambda: {"localhost", "*.robots.example"},
            lambda tls: None,
        )
        self.listeners = Listeners(
            self.broker,
            self._ask,
            lambda method, address, tls, again: None,
            Admission(connections, connect_timeout, **limits),
            site=lambda: site,
        )
        return self.listeners

    async def start(
        self, connections: int = 100, connect_timeout: float = PATIENCE, **limits: float
    ) -> None:
        self.make(connections, connect_timeout, **limits)
        self.ports = await self.listeners.start(
            [
                ListenerSettings("127.0.0.1", 0, None, "web"),
                ListenerSettings("127.0.0.1", 0, lambda: self.context, "web"),
            ]
        )

    async def _small(self, request: HttpRequest) -> HttpResponse:
        self.requests.append(request)
        return text(200, f"small {request.query}")

    async def _slow(self, request: HttpRequest) -> HttpResponse:
        self.requests.append(request)
        if request.query:
            request.charge(self.payer)
        await self.slow.wait()
        return text(200, "slow")

    async def _large(self, request: HttpRequest) -> HttpResponse:
        self.requests.append(request)
        return HttpResponse(200, LARGE, "application/octet-stream", is_shared=True)

    async def _echo(self, request: HttpRequest) -> HttpResponse:
        """The body and as much again as is asked for, when the test lets it go."""
        request.charge(self.payer)
        body = await request.body(8 << 20)
        self.bodies.append(len(body))
        if request.query:
            await self.slow.wait()
        return HttpResponse(200, body + bytes(int(request.query or "0")))

    async def _broken(self, request: HttpRequest) -> HttpResponse:
        raise ZeroDivisionError("the test says so")


@pytest.fixture
async def harness(contexts) -> AsyncIterator[WebHarness]:
    harness = WebHarness(*contexts)
    harness.broker.tick(asyncio.get_running_loop().time())
    yield harness
    await harness.close()


@pytest.mark.parametrize("tls", [False, True])
async def test_requests_of_one_connection(harness: WebHarness, tls: bool):
    await harness.start()
    peer = await harness.dial(tls)
    status, headers, body = await ask(peer, "GET /small?a=1")
    assert (status, body) == (200, b"small a=1\n")
    for name, value in SECURITY_HEADERS:
        assert headers[name.lower()] == value
    assert headers["cache-control"] == "no-store" and headers["date"].endswith("GMT")
    assert not {"strict-transport-security", "access-control-allow-origin", "server"} & {*headers}
    status, without, _ = await ask(peer, "HEAD /small?a=1")
    assert status == 200
    assert {**without, "date": ""} == {**headers, "date": ""}  # and its length
    status, headers, _ = await ask(peer, "POST /small")
    assert (status, headers["allow"]) == (405, "GET, HEAD")
    assert "content-security-policy" in headers
    assert (await ask(peer, "BREW /small"))[0] == 405
    assert (await ask(peer, "OPTIONS /"))[0] == 404
    for path in (
        "/",
        "/smal",
        "/small/",
        "/../small",
        "/%2e%2e/etc/passwd",
        "//small",
        "/small%00",
    ):
        status, headers, _ = await ask(peer, f"GET {path}")
        assert (status, headers["x-content-type-options"]) == (404, "nosniff")
    assert (await ask(peer, "GET http://localhost/small?b", Host="other"))[2] == b"small b\n"
    request = harness.requests[0]
    assert (request.peer, request.tls is not None) == ("127.0.0.1", tls)
    assert (await ask(peer, "GET /small", Connection="close"))[1]["connection"] == "close"
    assert await peer.receive_rest() == b""


async def test_the_host_is_one_of_ours(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    for host in ("LocalHost:80", "localhost.", "127.0.0.1:1", "[::1]:8443", "a.robots.example"):
        assert (await ask(peer, "GET /small", Host=host))[0] == 200, host
    for host in ("evil.example", "robots.example", "a.b.robots.example", "localhost.evil.example"):
        assert (await ask(peer, "GET /small", Host=host))[0] == 421, host
        assert (await ask(peer, "POST /nothing", Host=host))[0] == 421, host
    for host in ("localhost:x", "u@localhost", "localhost/", "localhost?", "[::1", ":", "x" * 9000):
        assert (await ask(peer, "GET /small", Host=host))[0] == 421, host


#: What is no request that can be served, and the status of the answer; None for none at all.
BAD: dict[str, tuple[bytes, int | None]] = {
    "no Host": (b"GET /small HTTP/1.1\r\n\r\n", 400),
    "no Host in 1.0": (b"GET /small HTTP/1.0\r\n\r\n", 421),
    "two Hosts": (b"GET /small HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n", 400),
    "a body": (GET[:-2] + b"Content-Length: 5\r\n\r\nhello", 413),
    "a huge body": (GET[:-2] + b"Content-Length: 99999999999999999\r\n\r\n", 413),
    "a chunked body": (GET[:-2] + b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 413),
    "both": (GET[:-2] + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n", 413),
    "other codings": (GET[:-2] + b"Transfer-Encoding: gzip\r\n\r\n", 501),
    "lengths that differ": (GET[:-2] + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n", 400),
    "a negative length": (GET[:-2] + b"Content-Length: -1\r\n\r\n", 400),
    "who waits with its body": (
        b"POST" + GET[3:-2] + b"Content-Length: 5\r\nExpect: 100-continue\r\n\r\n",
        413,
    ),
    "a huge header": (GET[:-2] + b"X: " + b"x" * HEAD_LIMIT + b"\r\n\r\n", 431),
    "many headers": (GET[:-2] + b"X: x\r\n" * 4000 + b"\r\n", 431),
    "many short headers": (GET[:-2] + b"a:\r\n" * 4000 + b"\r\n", 431),
    "an endless head": (b"GET /" + b"x" * 3 * HEAD_LIMIT, 431),
    "no path": (b"GET small HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
    "a proxy's": (b"CONNECT localhost:1 HTTP/1.1\r\nHost: localhost:1\r\n\r\n", 400),
    "the server itself": (b"OPTIONS * HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
    "a folded header": (b"GET /small HTTP/1.1\r\n Host: localhost\r\n\r\n", 400),
    "a space in a name": (GET[:-2] + b"X : x\r\n\r\n", 400),
    "a zero byte": (GET[:-2] + b"X: \0\r\n\r\n", 400),
    "what is not ASCII": (b"GET /\xc3\xa4 HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
    "another version": (b"GET /small HTTP/3.7\r\nHost: localhost\r\n\r\n", 505),
    "HTTP/2": (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 505),
    "lines without CR": (b"GET /small HTTP/1.1\nHost: localhost\n\nGET / HTTP/1.1\r\n\r\n", 413),
    "TLS": (bytes.fromhex("1603010200010001fc0303") + bytes(100), None),
    "MQTT": (Connect("client").encode(5), None),
    "nonsense": (b"\xff\xfe\xfd" * 100, None),
    "empty lines": (b"\r\n" * 100, None),
}


@pytest.mark.parametrize("name", BAD)
async def test_what_is_no_request(
    harness: WebHarness, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    data, status = BAD[name]
    await harness.start()
    healthy = await harness.dial()
    for step in (len(data), 7):  # at once, and in pieces
        peer = await harness.dial()
        for start in range(0, min(len(data), 2000), step):
            await peer.send(data[start : start + step])
        await peer.send(data[2000:] if step == 7 else b"")
        if status is None:
            assert await peer.receive_rest() == b""
        else:
            found, headers, _ = await answer(peer)
            assert found == status
            assert "content-security-policy" in headers
            if status != 421:
                assert headers["connection"] == "close"
                assert await peer.receive_rest() == b""
        assert (await ask(healthy, "GET /small"))[0] == 200
    assert not harness.broker.faults.count
    if status != 421:
        assert any("no HTTP" in record.getMessage() for record in caplog.records)


async def test_empty_lines_before_a_request(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    await peer.send(b"\r\n\r\n" + GET)
    assert (await answer(peer))[0] == 200


async def test_http_1_0_ends_with_its_answer(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    await peer.send(b"GET /small HTTP/1.0\r\nHost: localhost\r\n\r\n")
    assert (await answer(peer))[0] == 200
    assert await peer.receive_rest() == b""


async def test_requests_behind_each_other(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    lines = [f"GET /small?{n} HTTP/1.1\r\nHost: localhost\r\n\r\n" for n in range(300)]
    await peer.send("".join(lines).encode())
    for n in range(300):
        assert (await answer(peer))[2] == f"small {n}\n".encode()


async def test_a_request_is_taken_when_the_one_before_is_answered(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    await peer.send(GET.replace(b"small", b"slow") * 2)
    await until(lambda: harness.requests, "the first request")
    await peer.send(GET)
    for _ in range(20):
        await asyncio.sleep(0)
    assert len(harness.requests) == 1
    harness.slow.set()
    assert [(await answer(peer))[2] for _ in range(3)] == [b"slow\n", b"slow\n", b"small \n"]


async def test_who_sends_nothing_more_is_answered(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    await peer.send(GET.replace(b"small", b"slow") + GET + GET[:10])
    peer.writer.write_eof()
    await until(lambda: harness.requests, "the request")
    harness.slow.set()
    assert [(await answer(peer))[0] for _ in range(2)] == [200, 200]
    assert await peer.receive_rest() == b""


@pytest.mark.parametrize("tls", [False, True])
async def test_slow_heads_and_silent_connections_end(
    harness: WebHarness, tls: bool, caplog: pytest.LogCaptureFixture
) -> None:
    await harness.start(connect_timeout=3.0)
    silent, slow = await harness.dial(tls), await harness.dial(tls)
    await slow.send(GET[:1])

    async def drip() -> None:
        for n in range(1, 10_000):
            slow.writer.write(b"X" if n > 4 else GET[n : n + 1])
            await asyncio.sleep(0.05)

    dripping = asyncio.create_task(drip())
    assert (await answer(slow))[0] == 408
    dripping.cancel()
    assert await slow.receive_rest() == b""
    caplog.clear()
    assert await silent.receive_rest() == b""
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


async def test_idle_connections_end(harness: WebHarness, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(http, "IDLE_TIMEOUT", 0.2)
    await harness.start()
    peer = await harness.dial()
    assert (await ask(peer, "GET /small"))[0] == 200
    assert await peer.receive_rest() == b""
    await until(lambda: not harness.scheduler.connections, "the connection to be gone")


@pytest.mark.parametrize("tls", [False, True])
async def test_a_reader_that_stops(harness: WebHarness, tls: bool):
    """It is read no more, its memory is bounded and counted, and it ends."""
    await harness.start(connect_timeout=3.0)
    peer = await harness.dial(tls, receive_buffer=4096)
    peer.writer.transport.pause_reading()
    await peer.send(GET.replace(b"small", b"large") * 100)
    await until(lambda: harness.requests, "the request")
    await until(lambda: harness.scheduler.output, "its output to be counted")
    assert harness.scheduler.output <= 2 * http.BODY_PORTION
    assert harness.broker.accounting.accounts.strangers.output == harness.scheduler.output
    await until(lambda: not harness.scheduler.connections, "the connection to be gone")
    assert len(harness.requests) == 1
    await until(lambda: not harness.scheduler.output, "its output to be given back")


@pytest.mark.parametrize("tls", [False, True])
async def test_who_is_slow_to_read_gets_all_of_it(harness: WebHarness, tls: bool):
    await harness.start()
    peer = await harness.dial(tls, receive_buffer=4096)
    await peer.send(GET.replace(b"small", b"large") + GET)
    status, _, body = await answer(peer)
    assert (status, body == LARGE) == (200, True)
    assert (await answer(peer))[0] == 200


@pytest.mark.parametrize("whose", ["strangers", "a user's"])
async def test_answers_that_many_wait_for_are_sent_in_several_rounds(
    harness: WebHarness, whose: str
) -> None:
    """And not all in the iteration of the loop in which what they wait for comes."""
    await harness.start(connections=300)
    peers = [await harness.dial() for _ in range(100)]
    for peer in peers:
        await peer.send(GET.replace(b"small", b"slow" if whose == "strangers" else b"slow?1"))
    await until(lambda: len(harness.requests) == len(peers), "the requests")
    sent: list[int] = []
    own = http.HttpLayer._answer

    def count(layer: http.HttpLayer, *args: Any) -> None:
        sent[-1] += 1
        own(layer, *args)

    counters = harness.broker.counters
    before = counters.cost
    with pytest.MonkeyPatch.context() as counting:
        counting.setattr(http.HttpLayer, "_answer", count)
        harness.slow.set()
        while sum(sent) < len(peers):
            sent.append(0)
            await asyncio.sleep(0)
    assert max(sent) <= MOST_ANSWERS, sent
    assert counters.cost - before >= len(peers) * http.ANSWER_COST
    assert {(await answer(peer))[2] for peer in peers} == {b"slow\n"}


def post(length: int, more: str = "") -> bytes:
    head = f"POST /echo{more} HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n"
    return head.encode() + bytes(length)


async def send_at_once(harness: WebHarness, count: int) -> list[Peer]:
    """Clients whose bodies, each as much as a round may cost, are complete in one moment."""
    length = 2 * COST_PER_ROUND * http.READ_PER_COST_UNIT
    request = post(length)
    peers = [await harness.dial() for _ in range(count)]
    for peer in peers:
        await peer.send(request[:-1])
    connections = harness.scheduler.connections
    await until(
        lambda: (
            sum(each._below_size for each in connections) == 0  # type: ignore[attr-defined]
            and harness.payer.account.bytes == count * length * http.COPIES
        ),
        "their users to be charged",
    )
    await asyncio.sleep(0.1)  # all but one byte of each is there
    for peer in peers:
        peer.writer.write(request[-1:])
    return peers


async def test_bodies_that_are_complete_at_once_are_read_in_several_rounds(harness: WebHarness):
    """Reading one is as much as a round may be, and is counted before it is done."""
    await harness.start(connections=300)
    before = harness.broker.counters.cost
    peers = await send_at_once(harness, 10)
    read: list[int] = []
    while len(harness.bodies) < len(peers):
        already = len(harness.bodies)
        await asyncio.sleep(0)
        read.append(len(harness.bodies) - already)
    assert max(read) <= 2, read  # the first may be read at once, and one in the turns
    assert harness.broker.counters.cost - before >= 2 * COST_PER_ROUND * len(peers)
    for peer in peers:
        assert (await answer(peer))[0] == 200


async def test_connections_that_end_while_their_bodies_wait_for_a_turn(harness: WebHarness):
    """As when they make room for others; that is no fault, and nothing stays counted."""
    await harness.start(connections=300)
    await send_at_once(harness, 10)
    while not harness.bodies:  # noqa: ASYNC110 - the very next iteration of the loop counts
        await asyncio.sleep(0)
    for connection in list(harness.scheduler.connections):
        connection.make_room()
    await until(lambda: not harness.scheduler.connections, "them to be gone")
    await asyncio.sleep(0.05)
    assert len(harness.bodies) < 10
    assert harness.broker.faults.by_entry == {}
    assert harness.payer.account.bytes == harness.broker.accounting.queued_bytes == 0


async def test_a_complete_body_that_waits_for_its_turn_is_not_late(
    harness: WebHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting: list[http.HttpLayer] = []
    monkeypatch.setattr(http.HttpLayer, "_take_body", lambda layer: waiting.append(layer))
    await harness.start()
    peer = await harness.dial()
    await peer.send(post(10))
    await until(lambda: waiting, "the body")
    waiting[0]._limit(0.1)  # for nothing else: a busy computer takes longer
    await asyncio.sleep(0.5)
    waiting[0]._hand_over_body()
    assert (await answer(peer))[0] == 200


async def test_what_comes_behind_a_body_is_counted(harness: WebHarness):
    await harness.start()
    strangers = harness.broker.accounting.accounts.strangers
    peer = await harness.dial()
    await peer.send(post(60, "?0") + GET * 1000)
    await until(lambda: harness.bodies, "the body")
    assert harness.payer.account.bytes == 60 * (http.COPIES - 1)
    assert strangers.bytes > len(GET) * 1000 // 4
    harness.slow.set()
    for _ in range(1001):
        assert (await answer(peer))[0] == 200
    assert (harness.payer.account.bytes, strangers.bytes) == (0, 0)


@pytest.mark.parametrize("sent", ["at once", "behind its head"])
@pytest.mark.parametrize("tls", [False, True])
async def test_a_body_and_its_answer_are_memory_of_their_user(
    harness: WebHarness, tls: bool, sent: str
) -> None:
    await harness.start(connect_timeout=PATIENCE)
    account, strangers = harness.payer.account, harness.broker.accounting.accounts.strangers
    request = post(100_000, "?6000000")
    peer = await harness.dial(tls, receive_buffer=4096)
    peer.writer.transport.pause_reading()
    if sent == "behind its head":
        await peer.send(request[:-100_000])
        await until(
            lambda: account.bytes == 100_000 * http.COPIES,
            "the body that is to come to be counted",
        )
        request = request[-100_000:]
    await peer.send(request)
    await until(lambda: harness.bodies, "the body")
    assert account.bytes == 100_000 * (http.COPIES - 1)
    assert strangers.bytes == 0
    harness.slow.set()
    await until(lambda: account.bytes == 6_100_000, "the answer to be counted")
    assert strangers.output <= 2 * http.BODY_PORTION  # what the transport has
    peer.writer.transport.resume_reading()
    assert len((await answer(peer))[2]) == 6_100_000
    assert (account.bytes, strangers.bytes) == (0, 0)
    harness.slow.clear()
    await peer.send(post(5, "?1"))
    await until(lambda: account.bytes == 5 * (http.COPIES - 1), "another body")
    peer.writer.transport.abort()  # type: ignore[attr-defined]
    harness.slow.set()
    await until(lambda: not harness.scheduler.connections, "its end to be noticed")
    assert (account.bytes, strangers.bytes, harness.broker.accounting.queued_bytes) == (0, 0, 0)


async def test_no_memory_for_a_body_or_an_answer(harness: WebHarness):
    await harness.start()
    accounting, account = harness.broker.accounting, harness.payer.account
    others = accounting.quotas.memory.own - 12_000_000
    accounting.take(account, others)
    peer = await harness.dial()
    await peer.send(post(4_000_000))
    status, headers, body = await answer(peer)
    assert (status, headers["connection"], headers["retry-after"]) == (503, "close", "5")
    assert body.startswith(b"no memory for a body of 4000000 bytes now (broker.limits.memory, ")
    peer = await harness.dial()
    harness.slow.set()
    await peer.send(post(2_000_000, "?11000000"))
    status, _, body = await answer(peer)
    assert (status, body[:32]) == (507, b"what was asked for is done, but ")
    assert b"13000000 bytes is lost for want of memory (broker.limits.memory, " in body
    await peer.send(post(2_000_000))
    assert (await answer(peer))[0] == 200
    accounting.take(account, 12_000_000)
    await peer.send(post(100))
    assert (await answer(peer))[0] == 200  # a little is always possible
    assert account.bytes == accounting.quotas.memory.own
    accounting.take(account, -account.bytes)


async def test_a_fault_ends_one_connection(harness: WebHarness, escaped: list[str]):
    await harness.start()
    peer, other = await harness.dial(), await harness.dial()
    await peer.send(GET.replace(b"small", b"broken"))
    assert await peer.receive_rest() == b""
    assert harness.broker.faults.by_entry == {"http.respond": 1}
    escaped.clear()
    assert (await ask(other, "GET /small"))[0] == 200


async def test_http_connections_count_for_admission(harness: WebHarness):
    await harness.start(connections_per_address=3)
    peers = [await harness.dial() for _ in range(3)]
    for peer in peers:
        assert (await ask(peer, "GET /small"))[0] == 200  # idle ones, too
    assert await (await harness.dial()).receive_rest() == b""
    assert harness.broker.counters.connections_refused == 1


async def test_an_idle_one_makes_room(harness: WebHarness, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("appliance.net.listeners.GUESTS", 2)
    await harness.start(connections=1)
    first, second = await harness.dial(), await harness.dial()
    assert (await ask(first, "GET /small"))[0] == (await ask(second, "GET /small"))[0] == 200
    third = await harness.dial()
    assert (await ask(third, "GET /small"))[0] == 200
    assert await first.receive_rest() == b""


# --- WebSocket -----------------------------------------------------------------------------------


async def talk(harness: WebHarness, tls: bool = False, **options: Any) -> Any:
    scheme = "wss" if tls else "ws"
    return await connect(
        f"{scheme}://localhost:{harness.ports[tls][1]}/mqtt",
        ssl=harness.client_context if tls else None,
        subprotocols=["mqtt"],
        **options,
    )


@pytest.mark.parametrize("tls", [False, True])
async def test_mqtt_is_at_its_path(harness: WebHarness, tls: bool):
    await harness.start()
    connection = await talk(harness, tls)
    await connection.send(Connect("browser").encode(5))
    data = await asyncio.wait_for(connection.recv(), PATIENCE)
    assert isinstance(decode_packet(data[0], data[2:], 5), Connack)
    assert harness.protocol("browser").tls_info().version == ("TLSv1.3" if tls else "")
    await connection.close()


UPGRADE = (
    b"GET /mqtt HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: mqtt\r\n\r\n"
)


@pytest.mark.parametrize("tls", [False, True])
async def test_a_websocket_behind_requests_with_its_connect_at_once(
    harness: WebHarness, tls: bool
) -> None:
    await harness.start(connect_timeout=3.0)
    peer = await harness.dial(tls)
    packet = Connect("hasty").encode(5)
    frame = bytes((0x82, 0x80 | len(packet))) + bytes(4) + packet
    await peer.send(GET + GET + UPGRADE + frame)
    assert [(await answer(peer))[0] for _ in range(2)] == [200, 200]
    status, _, _ = await answer(peer, body=False)
    assert status == 101
    head = await asyncio.wait_for(peer.reader.readexactly(2), PATIENCE)
    data = await peer.reader.readexactly(head[1])
    assert isinstance(decode_packet(data[0], data[2:], 5), Connack)
    await asyncio.sleep(3.2)  # no time limit of HTTP holds for it
    assert harness.protocol("hasty")


async def test_a_websocket_that_never_logs_in_ends(harness: WebHarness):
    await harness.start(connect_timeout=3.0)
    peer = await harness.dial()
    await peer.send(UPGRADE)
    assert (await answer(peer, body=False))[0] == 101
    await peer.receive_rest()
    await until(lambda: not harness.scheduler.connections, "the connection to be gone")


async def test_what_is_no_websocket_for_mqtt(harness: WebHarness):
    await harness.start()
    peer = await harness.dial()
    await peer.send(UPGRADE.replace(b"localhost", b"evil.example"))  # DNS rebinding
    assert (await answer(peer))[0] == 421
    status, headers, _ = await ask(peer, "GET /mqtt")
    assert (status, headers["upgrade"]) == (426, "websocket")
    assert (await ask(peer, "POST /mqtt"))[0] == 405


# --- what it costs where it is not wanted --------------------------------------------------------


def test_nothing_of_it_is_imported_before_it_is_wanted():
    code = (
        "import sys, appliance.app.main, appliance.cli.main; "
        "print([name for name in ('h11', 'appliance.net.http', 'appliance.web') "
        "if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE
    )
    assert done.stdout.strip() == "[]"


ENDS = {
    "nothing": b"",
    "a part of a head": GET[:-2],
    "no HTTP": b"\x10\x0c",
    "a wrong head": b"GET /small HTTP/9.9\r\nHost\r\n\r\n",
    "an answer": GET,
    "a part of a large answer": b"GET /large HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "a part of a body": b"POST /body HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\nab",
    "a WebSocket": UPGRADE,
    "half a WebSocket": UPGRADE.partition(b"Sec-")[0] + b"\r\n",
}


@pytest.mark.parametrize("tls", [False, True])
@pytest.mark.parametrize("said", ENDS)
async def test_the_memory_of_a_connection_is_free_at_once(harness: WebHarness, tls, said):
    await harness.start()
    harness.requests = deque(maxlen=0)  # a request knows its connection
    await harness.expect_free_memory(ENDS[said], tls)
