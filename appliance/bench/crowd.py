"""A crowd: thousands of clients that connect at once, stay, and leave at once.

Each line on standard input starts a step and is answered when that is done: the first line lets the
clients connect, the second lets them leave. The program ends with its input::

    python -m appliance.bench.crowd --clients 5000 --port 8883 --tls --ca ca.crt --user NAME \
        --password-env VARIABLE
"""

from __future__ import annotations

import argparse
import gc
import os
import select
import socket
import ssl
import sys
import time
from collections import Counter
from collections.abc import Sequence

from appliance.bench.client import LoadError, LoadTarget, allow_files, connect_packet, reporting
from appliance.bench.load import percentile, pin
from appliance.bench.probe import print_answer

CONNECT_SECONDS = 30.0  # from the TCP connection to the CONNACK; the default of MQTT.js
OTHER_FILES = 64
NICENESS = 5  # real clients run elsewhere: the probe must not wait for these
_READ, _WRITE = select.EPOLLIN | select.EPOLLRDHUP, select.EPOLLOUT


class ConnectingClient:
    """One client that connects: TCP connection, TLS handshake, CONNECT, CONNACK."""

    def __init__(self, target: LoadTarget, client_id: str) -> None:
        self._target = target
        self._connect = connect_packet(client_id, target.username, target.password)
        self._answer = b""
        self._step = self._on_tcp
        self.began = time.perf_counter()
        self.took: float | None = None
        self.socket = socket.socket()
        self.socket.setblocking(False)
        self.socket.connect_ex((target.host, target.port))

    def advance(self) -> int:
        """Take the next step; returns the events to wait for.

        Raises LoadError and OSError (TLS errors among them) when it cannot connect.
        """
        return self._step()

    def _on_tcp(self) -> int:
        if error := self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(error, os.strerror(error))
        if self._target.tls is None:
            return self._send()
        self.socket = self._target.tls.wrap_socket(
            self.socket, do_handshake_on_connect=False, server_hostname=self._target.host
        )
        self._step = self._on_tls
        return self._on_tls()

    def _on_tls(self) -> int:
        assert isinstance(self.socket, ssl.SSLSocket)
        try:
            self.socket.do_handshake()
        except ssl.SSLWantReadError:
            return _READ
        except ssl.SSLWantWriteError:
            return _WRITE
        return self._send()

    def _send(self) -> int:
        self.socket.send(self._connect)  # the socket's buffer is empty: they always fit
        self._step = self._on_connack
        return self._on_connack()

    def _on_connack(self) -> int:
        try:
            data = self.socket.recv(4 - len(self._answer))
        except (BlockingIOError, ssl.SSLWantReadError):
            return _READ
        if not data:
            raise LoadError("closed before the CONNACK")
        self._answer += data
        if len(self._answer) == 4:
            if self._answer[0] != 0x20 or self._answer[3]:
                raise LoadError(f"answered with {self._answer.hex(' ')}")
            self.took = time.perf_counter() - self.began
            self._step = self._on_more
        return _READ

    def _on_more(self) -> int:
        """Read what TLS still sends, such as session tickets, or the end of the connection."""
        try:
            if not self.socket.recv(1):
                raise LoadError("closed after the CONNACK")
        except (BlockingIOError, ssl.SSLWantReadError):
            pass
        return _READ


class Crowd:
    """All clients, and the loop that serves them."""

    def __init__(self, target: LoadTarget) -> None:
        self._target = target
        self._poll = select.epoll()
        self._connecting: dict[int, ConnectingClient] = {}
        self._connected: dict[int, ConnectingClient] = {}
        self._took: list[float] = []  # seconds to connect, of each client that connected at all
        self._problems: Counter[str] = Counter()

    def connect(self, count: int) -> dict[str, object]:
        """Connect `count` clients at once; returns the outcome when all have, or time is up."""
        began = time.perf_counter()
        for number in range(count):
            client = ConnectingClient(self._target, f"bench-crowd-{os.getpid()}-{number}")
            self._connecting[client.socket.fileno()] = client
            self._poll.register(client.socket.fileno(), _WRITE)
        until = time.perf_counter() + CONNECT_SECONDS
        while self._connecting and time.perf_counter() < until:
            self._serve(0.1)
        took = self._took
        answer: dict[str, object] = {
            "failed": count - len(took),
            "timed_out": len(self._connecting),
            "seconds": time.perf_counter() - began,
            "problems": dict(self._problems.most_common(3)),
        }
        if took:
            answer["p50"] = percentile([(each, 1) for each in took], 0.50)
            answer["p99"] = percentile([(each, 1) for each in took], 0.99)
        return answer

    def stay(self) -> None:
        """Serve the connections until there is a line of input, or input ends."""
        self._poll.register(sys.stdin.fileno(), select.EPOLLIN)
        while not self._serve(None):
            pass
        self._poll.unregister(sys.stdin.fileno())

    def leave(self) -> dict[str, object]:
        """Close all connections without a DISCONNECT; returns how many there were."""
        stayed = len(self._connected)
        for client in (*self._connected.values(), *self._connecting.values()):
            client.socket.close()
        return {"stayed": stayed, "problems": dict(self._problems.most_common(3))}

    def _serve(self, seconds: float | None) -> bool:
        """Serve the clients with events; returns whether there is a line of input."""
        asked = False
        for descriptor, _ in self._poll.poll(seconds):
            client = self._connecting.get(descriptor) or self._connected.get(descriptor)
            if client is None:
                asked = True
                continue
            try:
                self._poll.modify(descriptor, client.advance())
            except (LoadError, OSError) as error:
                self._problems[getattr(error, "reason", None) or str(error)] += 1
                self._connecting.pop(descriptor, None)
                self._connected.pop(descriptor, None)
                client.socket.close()
            else:
                if client.took is not None and descriptor in self._connecting:
                    self._took.append(client.took)
                    self._connected[descriptor] = self._connecting.pop(descriptor)
        return asked


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.crowd", description="Connect many MQTT clients at once."
    )
    LoadTarget.add_options(parser)
    parser.add_argument("--clients", type=int, default=5000)
    options = parser.parse_args(arguments)
    gc.disable()
    allow_files(options.clients + OTHER_FILES)
    with reporting("crowd"):
        target = LoadTarget.of(options)
        crowd = Crowd(target)
        pin(target.pids)
        os.nice(NICENESS)
        print_answer({"ready": True})
        if sys.stdin.readline():
            print_answer(crowd.connect(options.clients))
            crowd.stay()
            if sys.stdin.readline():
                print_answer(crowd.leave())
                sys.stdin.readline()
    return 0


if __name__ == "__main__":
    sys.exit(main())
