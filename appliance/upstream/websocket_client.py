"""MQTT over WebSocket, the client's side (RFC 6455; section 6 of both versions of MQTT)."""

from __future__ import annotations

import asyncio
import re
from typing import cast

from websockets.client import ClientProtocol as FrameClient
from websockets.protocol import State
from websockets.typing import Subprotocol
from websockets.uri import WebSocketURI

from appliance.config.urls import ServerUrl
from appliance.net.callbacks import contained
from appliance.net.layers import LayerScheduler
from appliance.net.websocket import (
    HEAD_COST,
    HEAD_LIMIT,
    EachFrame,
    WebSocketLayer,
    library_log,
)
from appliance.upstream.transport import UpstreamTransport

_STATUS = re.compile(rb"HTTP/1\.[01] ([0-9]{3})(?: ([^\r\n]*))?\r?\n")
_LOCATION = re.compile(rb"\r\nlocation:[ \t]*([!-~]{1,200})", re.IGNORECASE)


class _Frames(EachFrame, FrameClient):
    """The protocol of the `websockets` library, without I/O."""


class WebSocketClient(WebSocketLayer):
    """The layer between TCP or TLS and an `UpstreamTransport`."""

    _frames: _Frames

    def __init__(
        self, protocol: UpstreamTransport, scheduler: LayerScheduler, server: ServerUrl
    ) -> None:
        path, _, query = server.path.partition("?")
        uri = WebSocketURI(server.tls, server.host, server.port, path, query)
        frames = _Frames(uri, subprotocols=[Subprotocol("mqtt")], logger=library_log)
        super().__init__(protocol, scheduler, frames)
        self._server = server
        #: Done when the server has answered; its result is why it refuses, empty if it does not.
        self.upgraded: asyncio.Future[str] = scheduler.entries.loop.create_future()

    def send_request(self) -> None:
        """Ask the server for a WebSocket; the connection is there."""
        self._frames.send_request(self._frames.connect())
        self._send(self._frames.data_to_send())

    def _receive_head(self, data: bytes) -> bytes:
        """Take the response; returns the bytes behind it once it is complete and right."""
        if self.upgraded.done():  # and refused
            return b""
        head = self._head
        head += data
        end = head.find(b"\r\n\r\n", max(0, len(head) - len(data) - 3)) + 4
        if head[:7] != b"HTTP/1."[: len(head)]:
            self._settle(
                f"what answers at {self._server.authority} is not HTTP: is the port one without "
                "WebSocket?"
            )
        elif end > 3:
            self._scheduler.count_cost(HEAD_COST, self._protocol)
            refusal = self._refusal(bytes(head[:end]))
            behind = bytes(head[end:])
            head.clear()
            self._settle(refusal)
            return b"" if refusal else behind
        elif len(head) > HEAD_LIMIT:
            self._settle(f"the head of the broker's answer is longer than {HEAD_LIMIT} bytes")
        return b""

    def _settle(self, refusal: str) -> None:
        if not self.upgraded.done():
            self.upgraded.set_result(refusal)
        if refusal:
            self.abort()

    def _refusal(self, head: bytes) -> str:
        """Why there is no WebSocket after this response; empty when there is one."""
        status = _STATUS.match(head)
        if status is None:
            return "the broker's answer is not HTTP 1.1"
        code = int(status[1])
        if code != 101:
            answer = (status[2] or b"").decode("ascii", "replace")
            return self._status_refusal(code, f"(HTTP {code} {answer:.100})", head)
        self._frames.receive_data(head)
        self._frames.events_received()
        error = self._frames.handshake_exc
        if error is not None or self._frames.state is not State.OPEN:
            why = (error and error.__cause__) or error
            return f"the broker's answer is not that of a WebSocket: {why}"
        return ""

    def _status_refusal(self, code: int, said: str, head: bytes) -> str:
        path, host = self._server.path, self._server.authority
        location = _LOCATION.search(head)
        if 300 <= code < 400 and location is not None:
            return f"{host} says that it is elsewhere: {location[1].decode()} {said}"
        if code == 404:
            return f"{host} has no WebSocket at {path}: is the path right? {said}"
        if code in (401, 403):
            return f"{host} does not allow a WebSocket at {path} {said}"
        if code in (502, 503, 504):
            return f"{host} does not reach its broker {said}"
        return f"{host} has no WebSocket at {path} {said}"

    @contained("websocket.lost")
    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended, from either side."""
        if not self.upgraded.done():
            others = "mqtts://" if self._server.tls else "mqtt://, or one with TLS (wss://)"
            self.upgraded.set_result(
                "the broker closed the connection instead of an answer; is the port one for "
                f"{others}?"
            )
        protocol = cast(UpstreamTransport, self._protocol)
        closed = self._frames.close_rcvd
        if closed is not None:
            reason = f"{int(closed.code)} {closed.reason}".strip()
            self._protocol.log_refusal("the broker has closed the WebSocket", reason)
            if self._frames.close_rcvd_then_sent is not False:
                protocol.was_closed = True  # as by a FIN
        self._free_frames()
        protocol.connection_lost(exc)
