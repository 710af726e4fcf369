"""A relay that delays everything and limits nothing else, as a network with a long round trip.

Whatever arrives is passed on half a round trip later, as much as there is. The program prints its
port as a line of JSON, and ends with its input::

    python -m appliance.bench.delay --to 1883 --round-trip 0.1
"""

from __future__ import annotations

import argparse
import asyncio
import json
import socket
import sys
from collections import deque
from collections.abc import Sequence
from typing import cast

import uvloop


class DelayedEnd(asyncio.Protocol):
    """One end of a connection; what it receives goes to `other` after `delay` seconds."""

    def __init__(self, delay: float) -> None:
        self.other: DelayedEnd
        self._delay = delay
        self._loop = asyncio.get_running_loop()
        self._transport: asyncio.Transport | None = None
        self._coming: deque[tuple[float, bytes]] = deque()  # due when; nothing is the end
        self._is_due = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._transport = cast(asyncio.Transport, transport)
        self._transport.pause_reading()  # until both ends are there

    def start(self) -> None:
        """Pass on what arrives: the other end is there."""
        if self._transport is not None:
            self._transport.resume_reading()

    def data_received(self, data: bytes) -> None:
        self.other.pass_on(self._loop.time() + self._delay, data)

    def connection_lost(self, error: Exception | None) -> None:
        self._transport = None
        self.other.pass_on(self._loop.time() + self._delay, b"")

    def pass_on(self, due: float, data: bytes) -> None:
        """Send it when it is due."""
        self._coming.append((due, data))
        if not self._is_due:
            self._is_due = True
            self._loop.call_at(due, self._send)

    def _send(self) -> None:
        now, coming, ready = self._loop.time(), self._coming, []
        while coming and coming[0][0] <= now:
            ready.append(coming.popleft()[1])
        if self._transport is not None:
            self._transport.write(b"".join(ready))
            if ready and not ready[-1]:
                self._transport.close()
        self._is_due = bool(coming)
        if coming:
            self._loop.call_at(coming[0][0], self._send)


async def relay(port: int, round_trip: float) -> None:
    """Relay connections to that port of 127.0.0.1, until the input ends."""
    loop = asyncio.get_running_loop()
    under_way: set[asyncio.Task[object]] = set()

    def accept() -> DelayedEnd:
        near, far = DelayedEnd(round_trip / 2), DelayedEnd(round_trip / 2)
        near.other, far.other = far, near

        async def connect() -> None:
            try:
                await loop.create_connection(lambda: far, "127.0.0.1", port)
            except OSError:
                near.pass_on(loop.time(), b"")
                return
            near.start()
            far.start()

        task: asyncio.Task[object] = loop.create_task(connect())
        under_way.add(task)
        task.add_done_callback(under_way.discard)
        return near

    async with await loop.create_server(accept, "127.0.0.1", 0) as server:
        sys.stdout.write(json.dumps({"port": server.sockets[0].getsockname()[1]}) + "\n")
        sys.stdout.flush()
        await loop.run_in_executor(None, sys.stdin.read)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.delay", description="Delay connections to a local port."
    )
    parser.add_argument("--to", type=int, required=True, metavar="PORT")
    parser.add_argument("--round-trip", type=float, default=0.1, help="seconds")
    options = parser.parse_args(arguments)
    try:
        uvloop.run(relay(options.to, options.round_trip))
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
