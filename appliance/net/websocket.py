"""MQTT over WebSocket (section 6 of both versions): an RFC 6455 layer of a connection."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from typing import Any, Protocol, cast

from websockets.exceptions import NegotiationError, PayloadTooBig
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import Protocol as FrameProtocol
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.typing import Subprotocol

from appliance.net.callbacks import contained, contained_made
from appliance.net.layers import LayerHandler, LayerScheduler, MiddleLayer
from appliance.net.origin import REFUSAL, CertificateUser, misuses_certificate

#: The path, and the subprotocols: "mqtt" of the standard, the other one of clients before it.
PATH = "/mqtt"
SUBPROTOCOLS = ("mqtt", "mqttv3.1")

#: The largest head of an HTTP request, in bytes: a browser may send many cookies.
HEAD_LIMIT = 16 * 1024

#: Prefixes of the headers that ask for a WebSocket.
_OWN_HEADERS = ("sec-websocket-", "upgrade", "connection")

#: The most bytes in their values: the library takes a microsecond and more for each byte.
OWN_HEADERS_LIMIT = 1024

#: The cost of an upgrade request, see `Counters.cost`: it may have a hundred headers.
HEAD_COST = 100

#: Bytes of frames that are decoded at once: at worst two milliseconds' work, as frames may be
#: empty. And the cost of a frame, where a chunk has many.
PORTION = 2048
FRAME_COST = 3

#: Frames of one connection that are decoded in a turn.
FRAMES_A_TURN = 256

_NOTHING = memoryview(b"")

# The library logs every connection; what is of interest is logged here, with the address.
library_log = logging.getLogger(f"{__name__}.frames")
library_log.setLevel(logging.ERROR)


class WebSocketHandler(LayerHandler, Protocol):
    """The layer above a WebSocket."""

    def frame_limit(self) -> int:
        """The largest frame that may be received now, in bytes."""

    def count_partial_frame(self, size: int) -> None:
        """So many bytes of an incomplete frame are buffered."""


class WebSocketLayer(MiddleLayer):
    """The layer of a WebSocket, of either side.

    The protocol above reads and writes bytes, with the flow control of the transport below. It
    receives a message in the fragments in which it arrives, and none while it has paused reading.
    """

    _protocol: WebSocketHandler

    def __init__(
        self, protocol: WebSocketHandler, scheduler: LayerScheduler, frames: FrameProtocol
    ) -> None:
        super().__init__(protocol, scheduler)
        self._frames_left = FRAMES_A_TURN
        self._frames = frames
        #: The head of the HTTP request or response, until it is complete.
        self._head = bytearray()
        #: What was received and is not decoded yet.
        self._backlog = _NOTHING
        self._reading = True
        self._writing = True
        #: The pong for the last ping, while it cannot be written.
        self._pong = b""

    # --- towards the transport -----------------------------------------------------------------

    @contained_made("websocket.made")
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The connection is there; the protocol above may close it, and reads after the upgrade."""
        self._transport = cast(asyncio.Transport, transport)
        self._protocol.connection_made(self)

    @contained("websocket.chunk")
    def data_received(self, data: bytes) -> None:
        """Decode the frames in the chunk, now or in a turn."""
        self._backlog = memoryview(bytes(self._backlog) + data if self._backlog else data)
        is_small = len(self._backlog) <= PORTION
        if self._queued or self._scheduler.must_wait(self._protocol, is_small=is_small):
            self._take_later()
        else:
            self._take()
        self._count_backlog()

    def _count_backlog(self) -> None:
        """Report the memory of what is not decoded: of a chunk, all of it."""
        self._count_own(len(cast(bytes, self._backlog.obj)) + len(self._head))

    def _take(self) -> None:
        """Decode what is there, until the turn is over; reading is paused then."""
        self._frames_left = FRAMES_A_TURN
        while self._backlog and self._reading and not self._transport.is_closing():
            data = bytes(self._backlog[:PORTION])
            self._backlog = (
                self._backlog[PORTION:] or _NOTHING
            )  # an empty slice would keep the whole chunk alive
            if self._frames.state is State.CONNECTING:
                data = self._receive_head(data)
            if data:
                self._receive_frames(data)
            if self._backlog and self._frames_left <= 0:
                self._take_later()
                break

    def _take_later(self) -> None:
        """Decode in a later turn, when the others had theirs."""
        self._transport.pause_reading()
        self._protocol.input_paused()
        if not self._queued:
            self._queued = True
            self._scheduler.queue_turn(self)

    def take_turn(self) -> None:
        """Continue: the others have had their turn."""
        self._queued = False
        self._take()
        self._count_backlog()
        if not self._reading or self._transport.is_closing():
            return
        if self._frames.close_rcvd is not None:
            self._transport.close()
        elif not (self._backlog or self._queued):
            self._protocol.input_resumed()
            self._transport.resume_reading()

    def _receive_head(self, data: bytes) -> bytes:
        """Take the peer's HTTP head; returns the bytes behind it once it is complete and right."""
        raise NotImplementedError

    def _receive_frames(self, data: bytes) -> None:
        frames = self._frames
        frames.max_size = self._protocol.frame_limit()
        frames.receive_data(data)
        payload: list[bytes] = []
        is_text = False
        events = frames.events_received()
        self._frames_left -= len(events)
        if len(events) > 1:
            self._scheduler.count_cost(FRAME_COST * len(events), self._protocol)
        for frame in events:
            assert not isinstance(frame, Request | Response)
            if frame.opcode is Opcode.TEXT:  # [MQTT-6.0.0-1]
                is_text = True
                break
            if frame.opcode is Opcode.BINARY or frame.opcode is Opcode.CONT:
                payload.append(bytes(frame.data))  # unmasked ones are bytearrays
        if payload:  # [MQTT-6.0.0-2]
            self._protocol.data_received(payload[0] if len(payload) == 1 else b"".join(payload))
        self._answer(frames.data_to_send())
        buffered = len(frames.reader.buffer)
        if buffered and events:  # of the next one
            self._protocol.count_partial_frame(0)
        self._protocol.count_partial_frame(buffered)
        error = frames.parser_exc
        if is_text:
            self._fail(CloseCode.UNSUPPORTED_DATA, "a text frame; MQTT is in binary frames")
        elif isinstance(error, PayloadTooBig):
            self._fail(CloseCode.MESSAGE_TOO_BIG, f"a frame that is too large ({error})")
        elif error is not None:
            self._fail(CloseCode.PROTOCOL_ERROR, str(error))
        elif frames.close_rcvd is not None and self._reading:
            # Else the protocol above has not read all that came before, perhaps a CONNECT.
            self._transport.close()

    def _answer(self, writes: list[bytes]) -> None:
        """Send the pongs and the close frame that the library has prepared."""
        if self._writing or self._frames.state is not State.OPEN:
            self._send(writes)
        elif writes:
            # A client that pings without reading gets the last pong only (RFC 6455, 5.5.3).
            self._pong = writes[-1]

    def _fail(self, code: CloseCode, reason: str) -> None:
        self._protocol.log_refusal("not the WebSocket protocol", reason)
        if self._frames.state is State.OPEN:
            self._frames.send_close(code, reason)
            self._send(self._frames.data_to_send())
        self._protocol.close()

    def _send(self, writes: list[bytes]) -> None:
        if any(writes):
            self._transport.write(writes[0] if len(writes) == 1 else b"".join(writes))

    @contained("websocket.pause")
    def pause_writing(self) -> None:
        """The client reads more slowly than it is written to."""
        self._writing = False
        self._protocol.pause_writing()

    @contained("websocket.resume")
    def resume_writing(self) -> None:
        """It has caught up."""
        self._writing = True
        pong, self._pong = self._pong, b""
        if pong and self._frames.state is State.OPEN:
            self._transport.write(pong)
        self._protocol.resume_writing()

    @contained("websocket.eof")
    def eof_received(self) -> bool | None:
        """The client sends nothing more."""
        return self._protocol.eof_received()

    @contained("websocket.lost")
    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended, from either side."""
        self._free_frames()
        self._protocol.connection_lost(exc)

    def _free_frames(self) -> None:
        """Break the circles of what the library keeps; nothing is received any more."""
        frames = self._frames
        # The library's parser is a generator that refers to its owner, and so do the stack frames
        # of an exception: circles, which would be kept with what was received.
        frames.parser.close()
        _forget_traceback(frames.parser_exc)
        _forget_traceback(frames.handshake_exc)

    # --- towards the protocol ------------------------------------------------------------------

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send a binary frame; nothing is sent after the client's close frame."""
        if self._frames.state is State.OPEN:
            self._frames.send_binary(data)  # type: ignore[arg-type]
            self._send(self._frames.data_to_send())

    def close(self) -> None:
        """Send a close frame after what was written, and close."""
        if self._frames.state is State.OPEN and not self._transport.is_closing():
            self._frames.send_close(CloseCode.NORMAL_CLOSURE)
            self._send(self._frames.data_to_send())
        self._transport.close()

    def pause_reading(self) -> None:
        """Decode nothing until `resume_reading`."""
        self._reading = False
        self._transport.pause_reading()

    def resume_reading(self) -> None:
        """Continue with what was received meanwhile."""
        self._reading = True
        if self._backlog or self._frames.close_rcvd is not None:
            self._take_later()
        else:
            self._transport.resume_reading()

    def is_reading(self) -> bool:
        """Whether reading is not paused."""
        return self._reading

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """What the transport below knows. `has_unread` is whether either of the two buffers
        received bytes that were not handed on, such as a part of a frame."""
        if name == "has_unread" and (self._backlog or self._frames.reader.buffer):
            return True
        return super().get_extra_info(name, default)


class WebSocket(WebSocketLayer):
    """The server's side.

    The Origin header counts only where a client's certificate is its login: no browser adds an MQTT
    password by itself. What is the `certificate_user` is in `origin`; None for no check.
    """

    _frames: _Frames

    def __init__(
        self,
        protocol: WebSocketHandler,
        scheduler: LayerScheduler,
        certificate_user: CertificateUser | None = None,
    ) -> None:
        super().__init__(protocol, scheduler, _Frames(logger=library_log))
        self._certificate_user = certificate_user

    def _receive_head(self, data: bytes) -> bytes:
        """Answer the HTTP request once it is complete; returns the bytes behind it."""
        head = self._head
        head += data
        end = head.find(b"\r\n\r\n", max(0, len(head) - len(data) - 3)) + 4
        if not head[:1].isupper():
            self._refuse(None, "what it sent is not HTTP; is it meant for a listener without it?")
        elif end > 3:
            self._scheduler.count_cost(HEAD_COST, self._protocol)
            # The library would read frames before it answers the request, so it gets them
            # afterwards.
            self._frames.receive_data(bytes(head[:end]))
            behind = bytes(head[end:])
            head.clear()
            if self._upgrade():
                return behind
        elif len(head) > HEAD_LIMIT:
            self._refuse(431, f"the request's head is longer than {HEAD_LIMIT} bytes")
        return b""

    def _upgrade(self) -> bool:
        frames = self._frames
        events = frames.events_received()
        if not events:
            error = frames.handshake_exc and frames.handshake_exc.__cause__
            self._refuse(400, f"not a WebSocket request: {error}")
            return False
        request = cast(Request, events[0])
        if request.path.partition("?")[0] != PATH:
            self._refuse(404, f"nothing is here; MQTT over WebSocket is at {PATH}", request.path)
            return False
        if self._is_foreign(request):
            self._refuse(403, REFUSAL)
            return False
        size = 0
        for name, value in request.headers.raw_items():
            if not name.lower().startswith(_OWN_HEADERS):
                continue
            # The library fails on what is not ASCII in these headers.
            if not value.isascii():
                self._refuse(400, f"not a WebSocket request: {name} holds what is not ASCII")
                return False
            size += len(value)
            if size > OWN_HEADERS_LIMIT:
                what = f"{name} and the like hold more than {OWN_HEADERS_LIMIT} bytes"
                self._refuse(400, f"not a WebSocket request: {what}")
                return False
        response = frames.accept(request)
        if response.status_code != 101:
            self._send_refusal(response, str(frames.handshake_exc))
            return False
        frames.send_response(response)
        self._send(frames.data_to_send())
        return True

    def _is_foreign(self, request: Request) -> bool:
        origins = request.headers.get_all("Origin")
        user = self._certificate_user
        if user is None or not origins:
            return False
        host = ", ".join(request.headers.get_all("Host"))
        return misuses_certificate(origins, host, self.get_extra_info("ssl_object"), user)

    def _refuse(self, status: int | None, reason: str, path: str | None = None) -> None:
        response = None if status is None else self._frames.reject(status, f"{reason}\n")
        self._send_refusal(response, reason if path is None else f"{path!r}: {reason}")

    def _send_refusal(self, response: Response | None, reason: str) -> None:
        self._protocol.log_refusal("no WebSocket connection", reason)
        if response is not None:
            self._transport.write(response.serialize())
        self._protocol.close()


class EachFrame(FrameProtocol):
    """Hands on each frame; no message is assembled, and so the size limit is per frame."""

    def recv_frame(self, frame: Frame) -> None:
        """Receive a frame."""
        super().recv_frame(frame)
        if self.cur_size:
            self.cur_size = 0


class _Frames(EachFrame, ServerProtocol):
    """The protocol of the `websockets` library, without I/O."""

    def select_subprotocol(self, subprotocols: Sequence[Subprotocol]) -> Subprotocol:
        """The first of the client's offers that is known [MQTT-6.0.0-3]."""
        for subprotocol in subprotocols:
            if subprotocol in SUBPROTOCOLS:
                return subprotocol
        raise NegotiationError(f"offer the subprotocol {' or '.join(SUBPROTOCOLS)}")


def _forget_traceback(error: BaseException | None) -> None:
    while error is not None:
        error.__traceback__ = None
        error = error.__cause__ or error.__context__
