"""HTTP/1.1 (RFC 9112) of a listener for the web: a layer of a connection, with h11's protocol.

What is asked for is answered by an `HttpSite`. A request for a WebSocket on `/mqtt` ends this
layer: the connection is that of an MQTT client from there on, as on a listener for WebSocket.

A request is taken when the one before it was answered and its answer was read; until then nothing
is read from the client. A request has a body where the site takes one, and says how long it is; it
is read when whoever answers asks for it. A large body that is complete waits for a turn, which
counts what reading it will cost. An answer that is ready waits for a turn if the round is used up:
what many requests wait for may come for all of them at once.

A request's body and its answer are memory of a user's: that of strangers, or of whoever has logged
in with the request, see `Exchange.charge`.

A connection is a guest of its listener for all its life: it makes room when there are too many, see
`Listeners`.

h11 is imported here and nowhere else, and this module only where a listener for the web is wanted.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Coroutine, Iterable
from dataclasses import dataclass, field
from email.utils import formatdate
from http import HTTPStatus
from typing import Final, Protocol, cast

import h11

from appliance.broker.accounts import Account
from appliance.broker.limits import Terms
from appliance.net.callbacks import contained, contained_made
from appliance.net.layers import LayerScheduler, MiddleLayer, UpperLayer
from appliance.net.websocket import HEAD_COST, HEAD_LIMIT, PATH, WebSocket, WebSocketHandler

Headers = tuple[tuple[str, str], ...]

#: On every answer. Nothing is loaded from elsewhere, framed, sniffed, or read by another site's
#: pages. No HSTS: where the CA is our own, it would take the browser's "proceed" away.
SECURITY_HEADERS: Final[Headers] = (
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "worker-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
)

#: Seconds that a connection is kept for another request: Prometheus asks every 15 s to 60 s.
IDLE_TIMEOUT = 75.0

#: A chunk of at most this many bytes is small, and may be taken although others wait for a turn.
SMALL_CHUNK = 2048

#: The cost of an answer, see `Counters.cost`: its head. And the bytes of its body for a unit more.
ANSWER_COST = 50
BODY_PER_COST_UNIT = 16 * 1024

#: The bytes of a request's body for a unit of cost: 25 ms a MiB, where much is made of few bytes.
READ_PER_COST_UNIT = 170

#: Bytes of a body that are handed to the transport at once. The rest waits until they are read: it
#: is the site's own memory, the same for all who are sent the same.
BODY_PORTION = 64 * 1024

#: Times that the bytes of a body are in memory at once: as they came, decoded, as they are sent on,
#: and where that is received, which counts them, too, when they have come so far.
COPIES = 4

#: The limits that a user's memory has.
MEMORY_LIMITS = "broker.limits.memory, broker.limits.user.memory"

#: Seconds after which to try again what has failed for want of something that others hold now.
RETRY_AFTER = 5

#: The most lines of a request's head: each takes microseconds, however short it is.
HEAD_LINES = 128

#: Empty lines that a client may send before a request (RFC 9112, section 2.2), in bytes.
EMPTY_LINES = 64


class HttpError(Exception):
    """Why a request is not served: the status of the answer, its words and headers."""

    def __init__(self, status: int, words: str, *headers: tuple[str, str]) -> None:
        super().__init__(words)
        self.status = status
        self.headers = headers

    @property
    def response(self) -> HttpResponse:
        """The answer that says so."""
        return text(self.status, str(self), *self.headers)


class Exchange(Protocol):
    """A request that is being answered, as who answers sees it."""

    async def receive(self, length: int) -> bytes:
        """The request's body, which has this length; once. Raises HttpError."""

    def allow(self, seconds: float) -> None:
        """Let the answer take so long from now on."""

    def charge(self, client: UpperLayer) -> None:
        """Count the body and the answer for this client's user, which has logged in."""


@dataclass(frozen=True, slots=True)
class HttpRequest:
    """A request: `path` as it was sent, without the query; names of `headers` in lower case.

    `address` is the client's with its port, `peer` without (empty for a Unix socket), and `terms`
    are those of its listener.
    """

    method: str
    path: str
    query: str
    #: The authority that it is meant for: the Host header, or that of the target.
    host: str
    #: With a password, perhaps.
    headers: Headers = field(repr=False)
    address: str
    peer: str
    tls: ssl.SSLObject | None
    terms: Terms

    #: The length of its body in bytes, as stated, and the exchange that it comes by.
    length: int = 0
    exchange: Exchange | None = field(default=None, repr=False)

    async def body(self, most: int) -> bytes:
        """The body, of `most` bytes at most. Raises HttpError."""
        if self.exchange is None or not self.length:
            return b""
        if self.length > most:
            raise HttpError(413, f"a body has {most} bytes at most here")
        return await self.exchange.receive(self.length)

    def allow(self, seconds: float) -> None:
        """Let the answer take so long from now on."""
        if self.exchange is not None:
            self.exchange.allow(seconds)

    def charge(self, client: UpperLayer) -> None:
        """Count the body and the answer for this client's user, which has logged in."""
        if self.exchange is not None:
            self.exchange.charge(client)

    def get(self, name: str) -> str | None:
        """The header of that name in lower case; None if there is none, or more than one."""
        found = [value for key, value in self.headers if key == name]
        return found[0] if len(found) == 1 else None


@dataclass(frozen=True, slots=True)
class HttpResponse:
    """An answer; SECURITY_HEADERS, the length and the date are added. HEAD leaves the body out."""

    status: int
    body: bytes = b""
    content_type: str = "text/plain; charset=utf-8"
    headers: Headers = ()
    #: The body is the site's own memory, the same for all who are sent it.
    is_shared: bool = False


def text(status: int, words: str, *headers: tuple[str, str]) -> HttpResponse:
    """An answer in words."""
    return HttpResponse(status, f"{words}\n".encode(), headers=headers)


class HttpSite(Protocol):
    """What is there for HTTP."""

    def respond(self, request: HttpRequest) -> Awaitable[HttpResponse]:
        """Answer a request; an exception ends the connection."""

    def takes_body(self, request: HttpRequest) -> bool:
        """Whether the request may have a body."""

    def objection(self, request: HttpRequest) -> HttpResponse | None:
        """Why the request may not become a WebSocket; None if it may."""


class HttpHandler(WebSocketHandler, Protocol):
    """The layer above: a connection that may become an MQTT client's."""

    address: str
    host: str
    terms: Terms

    def suspend_login_limit(self) -> None:
        """The layer below limits the time."""

    def limit_login(self) -> None:
        """A complete CONNECT has to come in time from now on."""


class HttpScheduler(LayerScheduler, Protocol):
    """The scheduler as this layer sees it."""

    def in_background(self, work: Coroutine[object, object, None]) -> object:
        """Run it as a task; it must not raise."""

    def has_room(self, account: Account, size: int) -> bool:
        """Whether so much more may wait for a client of the account."""

    def take(self, account: Account, size: int) -> None:
        """Count so many more bytes (fewer, if negative) that wait for a client of the account."""


class HttpLayer(MiddleLayer):
    """The layer of HTTP.

    `timeout` is in seconds: that long a request may take to come, to be answered, and its answer to
    be read; each for itself.
    """

    _protocol: HttpHandler
    _scheduler: HttpScheduler

    def __init__(
        self, protocol: HttpHandler, scheduler: HttpScheduler, site: HttpSite, timeout: float
    ) -> None:
        super().__init__(protocol, scheduler)
        self._site = site
        self._timeout = self._allowed = timeout
        self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=HEAD_LIMIT)
        #: Of the request that is answered; empty for what could not be read.
        self._method = ""
        #: What was received and not taken yet, and from where on the end of a head is looked for.
        self._received = bytearray()
        self._searched = 0
        #: Bytes of empty lines before the request.
        self._empty = 0
        #: Nothing has come behind the last answer yet.
        self._is_idle = False
        #: The answer that waits for a turn.
        self._response: HttpResponse | None = None
        #: The body that is being sent, and how many bytes of it the transport has.
        self._body = b""
        self._sent = 0
        #: Who answers waits for the request's body, of this length.
        self._awaited: asyncio.Future[None] | None = None
        self._length = 0
        #: Whose the request is, and the bytes that are counted for that user.
        self._payer: UpperLayer = protocol
        self._charged = 0
        #: A request is being answered, or its answer is not read yet.
        self._busy = False
        self._writing = True
        self._paused = False
        self._deadline: asyncio.TimerHandle | None = None

    # --- towards the transport -----------------------------------------------------------------

    @contained_made("http.made")
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there, its TLS handshake done."""
        self._transport = cast(asyncio.Transport, transport)
        self._protocol.suspend_login_limit()
        self._protocol.connection_made(self)
        self._limit(self._timeout)

    @contained("http.chunk")
    def data_received(self, data: bytes) -> None:
        """Take the request if it is complete, now or in a turn."""
        if self._transport.is_closing():
            return
        if self._is_idle:
            self._is_idle = False
            self._limit(self._timeout)
        self._received += data
        if not self._busy:
            is_small = len(self._received) <= SMALL_CHUNK
            if self._queued or self._scheduler.must_wait(self._protocol, is_small=is_small):
                self._take_later()
            else:
                self._take()
        elif self._awaited is not None and len(self._received) >= self._length:
            self._take_body()
        self._count_received()

    def _count_received(self) -> None:
        """Count what was received, without the body that its user is charged for."""
        self._count_own(max(len(self._received) - self._length, 0))

    def _limit(self, seconds: float) -> None:
        """Restart the time limit."""
        self._allowed = seconds
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = self._scheduler.entries.later(
            "http.timeout", seconds, self._too_late, served=self._protocol, failed=self.abort
        )

    def _too_late(self) -> None:
        if self._transport.is_closing():
            return
        if self._awaited is not None and len(self._received) >= self._length:
            self._limit(self._allowed)  # it waits for its turn
        elif self._awaited is not None:
            self._end_body(HttpError(408, f"no complete request within {self._timeout:g} s"))
        elif self._busy or not self._writing:
            what = "ready" if self._http.our_state is h11.SEND_RESPONSE else "read"
            self._protocol.log_refusal("no HTTP answer", f"none was {what} in {self._allowed:g} s")
            self._protocol.abort()
        elif self._received:
            self._refuse(408, f"no complete request within {self._timeout:g} s")
        else:
            self._protocol.close()

    def _take(self) -> None:
        """Take a request from what was received, if it is complete."""
        received = self._received
        empty = len(received) - len(received.lstrip(b"\r\n"))
        if empty:
            del received[:empty]
            self._searched = 0
            self._empty += empty
        end = received.find(b"\r\n\r\n", self._searched) + 4
        self._searched = max(0, len(received) - 3)
        if self._empty > EMPTY_LINES or (received and not received[:1].isupper()):
            what = "TLS, which this listener has not" if received[:1] == b"\x16" else "not HTTP"
            self._protocol.log_refusal("no HTTP connection", f"what it sent is {what}")
            self._protocol.close()
        elif end > HEAD_LIMIT or (end < 4 and len(received) > HEAD_LIMIT):
            self._refuse(431, f"the request's head is longer than {HEAD_LIMIT} bytes")
        elif received.count(b"\n", 0, max(end, 0)) > HEAD_LINES:
            self._refuse(431, f"the request's head has more than {HEAD_LINES} lines")
        elif end >= 4:
            head = bytes(received[:end])
            del received[:end]
            self._searched = self._empty = 0
            self._scheduler.count_cost(HEAD_COST, self._protocol)
            self._receive_head(head)
        else:
            self._read_on()

    def _take_later(self) -> None:
        """Go on with the request in a later turn, when the others had theirs."""
        self._pause()
        if not self._queued:
            self._queued = True
            self._scheduler.queue_turn(self)

    def take_turn(self) -> None:
        """Continue: the others have had their turn."""
        self._queued = False
        response, self._response = self._response, None
        if self._transport.is_closing():
            return
        if response is not None:
            self._answer_counted(response)
        elif self._awaited is not None:
            self._hand_over_body()
        elif not self._busy:
            self._take()
            self._count_received()

    def _pause(self) -> None:
        if not self._paused:
            self._paused = True
            self._protocol.input_paused()
            self._transport.pause_reading()

    def _read_on(self) -> None:
        if self._paused:
            self._paused = False
            self._protocol.input_resumed()
            self._transport.resume_reading()

    # --- requests and answers ------------------------------------------------------------------

    def _receive_head(self, head: bytes) -> None:
        http = self._http
        self._method = ""
        http.receive_data(head)
        try:
            event = http.next_event()
            following = http.next_event()
        except h11.RemoteProtocolError as error:
            # h11 raises it out of a frame that refers to it: a circle, which nobody would break.
            error.__traceback__ = None
            self._refuse(error.error_status_hint, str(error))
            return
        if type(event) is not h11.Request:
            self._refuse(400, "not a request")
            return
        self._method = event.method.decode("ascii")
        if type(following) is h11.Data:
            # h11 has found the end of the head earlier, behind a bare LF.
            self._refuse(400, "a head has CRLF at the end of each line")
        elif not event.http_version.startswith(b"1."):
            self._refuse(505, "HTTP/1.1 is spoken here")
        else:
            request = self._request(event)
            has_body = type(following) is not h11.EndOfMessage or bool(http.trailing_data[0])
            if request is None:
                self._refuse(400, "not a request for a path of this server")
            elif has_body and not self._site.takes_body(request):
                self._refuse(413, "requests have no body here")
            elif has_body and not request.length:
                self._refuse(411, "a body has a Content-Length here")
            elif _is_upgrade(request):
                self._upgrade(request, head)
            else:
                self._begin(request)

    def _request(self, event: h11.Request) -> HttpRequest | None:
        """The request; None if it is not for a path."""
        # h11 has checked that the target is of printable ASCII, and that there is one Host.
        target = event.target.decode("ascii")
        headers = [(bytes(k).decode("ascii"), bytes(v).decode("latin-1")) for k, v in event.headers]
        host = next((value for name, value in headers if name == "host"), "")
        scheme, mark, rest = target.partition("://")
        if mark and scheme.lower() in ("http", "https"):  # RFC 9112, section 3.2.2
            host, slash, path = rest.partition("/")
            target = slash + path or "/"
        if not target.startswith("/"):
            return None
        path, _, query = target.partition("?")
        is_coded = any(name == "transfer-encoding" for name, _ in headers)
        protocol = self._protocol
        return HttpRequest(
            self._method,
            path,
            query,
            host,
            tuple(headers),
            protocol.address,
            protocol.host,
            cast("ssl.SSLObject | None", self._transport.get_extra_info("ssl_object")),
            protocol.terms,
            # h11 has checked that it is one number; it means nothing beside a coding.
            0 if is_coded else int(next((v for k, v in headers if k == "content-length"), "0")),
            self,
        )

    def _begin(self, request: HttpRequest) -> None:
        """Have the request answered; nothing is read meanwhile."""
        self._busy = True
        self._pause()
        self._limit(self._timeout)
        self._scheduler.in_background(self._respond(request))

    async def receive(self, length: int) -> bytes:
        """The body of the request that is answered; see `Exchange`."""
        http = self._http
        if self._transport.is_closing():
            raise HttpError(400, "the body is cut off")
        if not self._has_room(COPIES * length):
            words = f"no memory for a body of {length} bytes now ({MEMORY_LIMITS})"
            raise HttpError(503, words, ("Retry-After", str(RETRY_AFTER)))
        self._charge(COPIES * length)
        self._length = length
        self._count_received()
        self._limit(self._timeout)
        awaited = self._awaited = asyncio.get_running_loop().create_future()
        if len(self._received) >= length:
            self._take_body()
        else:
            if http.they_are_waiting_for_100_continue:
                go_on = h11.InformationalResponse(status_code=100, headers=[])
                self._transport.write(http.send(go_on))
            self._read_on()
        try:
            await awaited
        finally:
            self._awaited = None
            self._length = 0
        if len(self._received) < length:
            raise HttpError(400, "the body is cut off")
        body = bytes(self._received[:length])
        del self._received[:length]
        self._charge((COPIES - 1) * length)
        self._count_received()
        http.receive_data(body)
        while type(http.next_event()) is h11.Data:
            pass
        return body

    def _take_body(self) -> None:
        """The body is complete: let it be read, now or in a turn."""
        self._pause()
        self._limit(self._timeout)
        is_small = self._length <= SMALL_CHUNK
        if self._queued or self._scheduler.must_wait(self._payer, is_small=is_small):
            self._take_later()
        else:
            self._hand_over_body()

    def _hand_over_body(self) -> None:
        """Count what reading the body costs, before that is done: it ends the round for others."""
        self._scheduler.count_cost(self._length // READ_PER_COST_UNIT, self._payer)
        self._limit(self._timeout)  # also against a limit that ends in this very iteration
        self._end_body(None)

    def _end_body(self, error: HttpError | None) -> None:
        """Nobody waits for the body any more: it is there, or it will not come."""
        awaited, self._awaited = self._awaited, None
        if awaited is None or awaited.done():
            return
        if error is None:
            awaited.set_result(None)
        else:
            awaited.set_exception(error)

    def allow(self, seconds: float) -> None:
        """Let the answer take so long from now on; see `Exchange`."""
        if not self._transport.is_closing():
            self._limit(seconds)

    def charge(self, client: UpperLayer) -> None:
        """Count the body and the answer for this client's user; see `Exchange`."""
        self._charge(0)
        self._payer = client

    def _charge(self, size: int) -> None:
        """So many bytes wait for the client, of a body or of an answer."""
        if size != self._charged:
            self._scheduler.take(self._payer.account, size - self._charged)
            self._charged = size

    def _has_room(self, size: int) -> bool:
        """Whether so many bytes may wait for the client, whoever it is."""
        return self._scheduler.has_room(self._payer.account, size)

    async def _respond(self, request: HttpRequest) -> None:
        try:
            try:
                response = await self._site.respond(request)
            except HttpError as error:
                response = error.response
            # As a small chunk, not behind all others: `/healthz` answers also without any turns.
            if self._scheduler.must_wait(self._payer, is_small=True):
                self._response = response
                self._take_later()
            else:
                self._answer_counted(response)
        except Exception as error:
            self.fault("http.respond", error)

    def _answer_counted(self, response: HttpResponse) -> None:
        """Send the answer, and count what that costs, unless the client has gone."""
        if self._transport.is_closing():
            return
        self._charge(0)  # for the body that was answered
        # Strangers are sent little, such as metrics, which are wanted most when memory is short.
        is_free = response.is_shared or self._payer is self._protocol
        if not (is_free or self._has_room(len(response.body))):
            words = f"what was asked for is done, but its answer of {len(response.body)} bytes is"
            response = text(507, f"{words} lost for want of memory ({MEMORY_LIMITS})")
        self._charge(0 if response.is_shared else len(response.body))
        cost = ANSWER_COST + len(response.body) // BODY_PER_COST_UNIT
        self._scheduler.count_cost(cost, self._payer)
        self._answer(response)

    def _answer(self, response: HttpResponse, *more: tuple[str, str]) -> None:
        """Send the answer; go on when it was read."""
        http = self._http
        if http.their_state is h11.SEND_BODY:  # what comes yet is no request
            more = (("Connection", "close"),)
        headers: Iterable[tuple[str, str]] = (
            ("Date", formatdate(usegmt=True)),
            ("Content-Type", response.content_type),
            ("Content-Length", str(len(response.body))),
            *SECURITY_HEADERS,
            *response.headers,
            *more,
        )
        names = {name.lower() for name, _ in response.headers}
        caching = () if "cache-control" in names else (("Cache-Control", "no-store"),)
        head = h11.Response(
            status_code=response.status,
            headers=[*headers, *caching],
            reason=HTTPStatus(response.status).phrase,
        )
        self._limit(self._timeout)
        self._busy = True
        self._pause()
        self._body = b"" if self._method == "HEAD" else response.body
        self._sent = 0
        self._transport.write(http.send(head) + self._next_portion())
        self._write_on()

    def _next_portion(self) -> bytes:
        portion = self._body[self._sent : self._sent + BODY_PORTION]
        self._sent += len(portion)
        return self._http.send(h11.Data(data=portion))

    def _write_on(self) -> None:
        """Write more of the body, until the client does not read as fast; go on after its end."""
        while self._writing and self._sent < len(self._body):
            self._transport.write(self._next_portion())
        if self._sent < len(self._body):
            return
        self._body, self._sent = b"", 0
        self._charge(0)  # what the transport has of it is counted there
        self._http.send(h11.EndOfMessage())
        if self._http.our_state is not h11.DONE:
            self._protocol.close()
        elif self._writing:
            self._next()

    def _next(self) -> None:
        """The answer was taken by the network: go on with the next request."""
        if not self._busy or self._transport.is_closing():
            return
        self._busy = False
        self._payer = self._protocol
        self._http.start_next_cycle()
        if self._received:
            self._limit(self._timeout)
            self._take_later()
        else:
            self._is_idle = True
            self._limit(IDLE_TIMEOUT)
            self._read_on()

    def _refuse(self, status: int, reason: str) -> None:
        """Answer what is not a request that can be served, and close."""
        self._protocol.log_refusal("no HTTP request", reason)
        if self._http.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            self._answer(text(status, reason), ("Connection", "close"))
        self._protocol.close()

    def _upgrade(self, request: HttpRequest, head: bytes) -> None:
        """Hand the connection to a WebSocket, which answers the request; or refuse that."""
        response = self._site.objection(request)
        if response is not None:
            self._answer(response)
            return
        rest = bytes(self._received)
        self._received.clear()
        self._count_received()
        if self._deadline is not None:
            self._deadline.cancel()
        protocol, transport = self._protocol, self._transport
        protocol.limit_login()
        self._read_on()
        websocket = WebSocket(protocol, self._scheduler)
        transport.set_protocol(websocket)
        websocket.connection_made(transport)
        websocket.count_buffered(self._below)
        websocket.data_received(head + rest)

    # --- what the transport says ---------------------------------------------------------------

    @contained("http.pause")
    def pause_writing(self) -> None:
        """The client reads more slowly than it is written to."""
        self._writing = False
        self._protocol.pause_writing()

    @contained("http.resume")
    def resume_writing(self) -> None:
        """It has read most of the answer."""
        self._writing = True
        self._protocol.resume_writing()
        if self._http.our_state is h11.SEND_BODY:
            self._write_on()
        elif self._http.our_state is h11.DONE:
            self._next()

    @contained("http.eof")
    def eof_received(self) -> bool | None:
        """The client sends nothing more. Reading is paused until all is answered that it has asked
        for, and so is this."""
        return self._protocol.eof_received()

    @contained("http.lost")
    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended, from either side."""
        if self._deadline is not None:
            self._deadline.cancel()
        self._end_body(HttpError(400, "the body is cut off"))
        self._received.clear()
        self._body = b""
        self._charge(0)
        self._payer = self._protocol
        self._protocol.connection_lost(exc)

    # --- the transport of the protocol above ---------------------------------------------------

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """MQTT is not spoken here yet: nothing is to be written."""

    def close(self) -> None:
        """Close when what was written is read."""
        self._transport.close()

    def pause_reading(self) -> None:
        """Take nothing more: the connection closes."""
        self._transport.pause_reading()

    def resume_reading(self) -> None:
        """The protocol above need not wait; this layer may have to."""
        if not self._paused:
            self._transport.resume_reading()


def _is_upgrade(request: HttpRequest) -> bool:
    """Whether it asks for MQTT over WebSocket; WebSocket checks the rest."""
    asked = (request.get("upgrade") or "").lower()
    return request.path == PATH and request.method == "GET" and "websocket" in asked
