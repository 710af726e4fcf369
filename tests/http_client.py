"""An HTTP client that hides nothing: what it sends are bytes, and what comes is looked at."""

from __future__ import annotations

import asyncio

from harness import Peer
from waiting import PATIENCE


async def answer(peer: Peer, *, body: bool = True) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of the next answer."""
    head = await asyncio.wait_for(peer.reader.readuntil(b"\r\n\r\n"), PATIENCE)
    first, *lines = head.decode("ascii").rstrip().split("\r\n")
    pairs = [line.partition(": ") for line in lines]
    headers = {name.lower(): value for name, _, value in pairs}
    assert len(headers) == len(pairs)
    size = int(headers["content-length"]) if body else 0
    return int(first.split()[1]), headers, await peer.reader.readexactly(size)


async def ask(peer: Peer, line: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    """The answer to a request."""
    fields = {"Host": "localhost", **headers}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items() if value)
    await peer.send(f"{line} HTTP/1.1\r\n{lines}\r\n".encode())
    return await answer(peer, body=not line.startswith("HEAD"))
