"""The way through an HTTP proxy: CONNECT (RFC 9110, section 9.3.6) with basic login (RFC 7617)."""

from __future__ import annotations

import asyncio
import base64
import re
import socket

from appliance.config.urls import ProxyUrl
from appliance.upstream.dial_error import DialError

#: The longest head of an answer, in bytes.
HEAD_LIMIT = 16 * 1024

# The libraries at hand refuse HTTP/1.0, in which tinyproxy answers.
_STATUS = re.compile(rb"HTTP/1\.[01] ([0-9]{3})(?: ([^\r\n]*))?\r?\n")


def request(proxy: ProxyUrl, authority: str) -> bytes:
    """What asks the proxy for a connection to `host:port`."""
    lines = [f"CONNECT {authority} HTTP/1.1", f"Host: {authority}"]
    if proxy.username is not None:
        login = f"{proxy.username}:{proxy.password or ''}".encode()
        lines.append(f"Proxy-Authorization: Basic {base64.b64encode(login).decode()}")
    return "\r\n".join([*lines, "", ""]).encode()


async def tunnel(connection: socket.socket, proxy: ProxyUrl, authority: str) -> None:
    """Have the proxy connect this connection to `host:port`. Raises DialError and OSError."""
    loop = asyncio.get_running_loop()
    await loop.sock_sendall(connection, request(proxy, authority))
    head = b""
    while b"\r\n\r\n" not in head:
        data = await loop.sock_recv(connection, 4096)
        head += data
        if not data or len(head) > HEAD_LIMIT or head[:7] != b"HTTP/1."[: len(head)]:
            raise DialError("proxy", refusal(head, proxy, authority))
    status = _STATUS.match(head)
    if status is None or not status[1].startswith(b"2"):
        raise DialError("proxy", refusal(head, proxy, authority))
    if not head.endswith(b"\r\n\r\n"):
        raise DialError("proxy", "the proxy sent more than its answer before anything was asked")


def refusal(head: bytes, proxy: ProxyUrl, authority: str) -> str:
    """Why the proxy does not connect, in words; never with the password."""
    at = f"the proxy {proxy.authority}"
    if not head:
        return f"{at} closed the connection without an answer"
    status = _STATUS.match(head)
    if status is None:
        return f"what answers at {proxy.authority} is not an HTTP proxy; check the key `proxy`"
    code = int(status[1])
    answer = (status[2] or b"").decode("ascii", "replace")
    said = f"(HTTP {code} {answer:.100})"
    if code == 407 and proxy.username is None:
        return f"{at} wants a user and a password: http://USER:PASSWORD@{proxy.authority} {said}"
    if code == 407 or (code == 401 and proxy.username is not None):
        return f"{at} does not accept the user and the password that it was given {said}"
    if code == 401:
        return f"{at} wants a user and a password: http://USER:PASSWORD@{proxy.authority} {said}"
    if code in (403, 405):
        return f"{at} does not allow connections to {authority}; whoever runs it has to {said}"
    if code in (500, 502, 503, 504):
        return f"{at} cannot connect to {authority}: is a broker listening there? {said}"
    return f"{at} does not connect to {authority} {said}"
