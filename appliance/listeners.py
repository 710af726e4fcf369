"""Listening: TCP, TLS, WebSocket and Unix sockets, and how many may come, and how fast."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import math
import os
import resource
import socket
import ssl
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from appliance.addresses import network
from appliance.broker.broker import Broker
from appliance.broker.ports import Exchange
from appliance.mqtt.reason import ReasonCode
from appliance.wire import FAREWELLS, Authenticate, ClientProtocol, Network

log = logging.getLogger(__name__)

#: Connections that wait to be accepted, as far as the system allows, and that are accepted in one
#: go: a TLS handshake takes a millisecond, and other clients want their turn.
BACKLOG = 4096
ACCEPTED_A_TURN = 16

#: Seconds until connections are accepted again after the system refused one.
ACCEPT_PAUSE = 0.5

#: TLS handshakes at a time; who comes meanwhile waits in the system's backlog, where waiting costs
#: nothing and no time limit of ours runs.
HANDSHAKES = 64

#: Seconds without one handshake ending after which those under way no longer keep others waiting:
#: it is the network that they wait for, or they are not meant to end.
HANDSHAKE_STALL = 0.25

#: Seconds that one address may open connections ahead of `limits.connection_rate`.
CONNECTION_BURST = 5.0

#: Addresses that are remembered before those are looked for that can be forgotten.
ADDRESSES = 1024

#: Seconds that clients get at the stop to read what was written to them.
STOP_TIMEOUT = 1.0

#: Files that the process opens beside its connections.
OTHER_FILES = FAREWELLS + 256


@dataclass(frozen=True, slots=True)
class ListenerSettings:
    """Where a listener listens: an address, or with `path` a Unix socket of that mode.

    `context` is None for a connection without TLS.
    """

    host: str
    port: int
    context: ssl.SSLContext | None
    protocol: Literal["mqtt", "websocket"] = "mqtt"
    path: Path | None = None
    mode: int = 0o660


class Listeners:
    """All listening sockets; `network` has the connections made to them.

    The limits are those of `broker.limits` in appliance.yaml, infinity for none.
    """

    def __init__(
        self,
        broker: Broker,
        authenticate: Authenticate,
        exchange: Callable[[str, str | None], Exchange | None],
        *,
        connections: int,
        connect_timeout: float,
        connections_per_address: float = math.inf,
        connection_rate: float = math.inf,
        publish_rate: float = math.inf,
    ) -> None:
        self.broker = broker
        self.connections = connections
        self.network = Network(
            broker,
            authenticate,
            exchange,
            self._ended,
            connect_timeout=connect_timeout,
            publish_rate=publish_rate,
        )
        self._addresses = _Addresses(connections_per_address, connection_rate)
        self._doors: list[_Door] = []
        self._handshakes: set[ClientProtocol] = set()
        self._stall: asyncio.TimerHandle | None = None

    async def start(self, settings: list[ListenerSettings]) -> list[tuple[str, int]]:
        """Listen; returns the addresses, with the port that the system chose where it was 0.

        Raises:
            OSError: an address cannot be listened on; nothing is left listening.
        """
        addresses: list[tuple[str, int]] = []
        _allow_files(self.connections + OTHER_FILES)
        try:
            for listener in settings:
                door = _Door(self, listener)
                self._doors.append(door)
                addresses.append(door.address)
                door.open()
        except BaseException:
            await self.stop()
            raise
        return addresses

    def admit(self, connection: socket.socket, peer: object, listener: ListenerSettings) -> None:
        """Begin a new connection, or close it when there are as many as allowed."""
        counters = self.broker.counters
        counters.sockets += 1
        now = asyncio.get_running_loop().time()
        refusal = host = ""
        if listener.path is not None:
            address = f"unix:{listener.path}"
        else:
            host, port = cast("tuple[str, int]", peer)[:2]
            address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        if len(self.network.open) >= self.connections:
            refusal = (
                f"{self.connections} connections, as many as allowed (broker.limits.connections)"
            )
        elif listener.path is None:
            refusal = self._addresses.admit(host, now)
        if refusal:
            connection.close()
            counters.connections_refused += 1
            self.broker.complaints.tell(now, refusal, "%s refused: %s", address, refusal)
            if self.broker.journal is not None:
                self.broker.journal.refused(address, refusal)
            return
        protocol = ClientProtocol(self.network, address, host)
        self.network.open.add(protocol)
        if listener.context is not None:
            self._handshakes.add(protocol)
        self.network.in_background(self._begin(protocol, connection, listener))

    async def _begin(
        self, protocol: ClientProtocol, connection: socket.socket, listener: ListenerSettings
    ) -> None:
        try:
            is_websocket = listener.protocol == "websocket"
            await protocol.begin(connection, listener.context, websocket=is_websocket)
        finally:
            self._handshakes.discard(protocol)
            if self._stall is not None:
                self._open_doors()

    def _ended(self, protocol: ClientProtocol) -> None:
        if protocol.host:
            self._addresses.leave(protocol.host)

    @property
    def crowded(self) -> bool:
        """Whether there are as many TLS handshakes as there may be at a time."""
        return len(self._handshakes) >= HANDSHAKES

    def wait_for_handshakes(self) -> None:
        """Open the doors again when a handshake has ended, or when none does for a while."""
        if self._stall is None:
            loop = asyncio.get_running_loop()
            self._stall = loop.call_later(HANDSHAKE_STALL, self._pass_stalled)

    def _pass_stalled(self) -> None:
        self._handshakes.clear()  # they go on, and are not counted any more
        self._open_doors()

    def _open_doors(self) -> None:
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None
        for door in self._doors:
            door.open()

    async def stop(self) -> None:
        """Listen no more and close what is open; may be called twice."""
        doors, self._doors = self._doors, []
        for door in doors:
            door.close()
        if self._stall is not None:
            self._stall.cancel()
        self.broker.close(
            lambda session: session.close_link(ReasonCode.SERVER_SHUTTING_DOWN, "shutting down")
        )
        await self.network.close(STOP_TIMEOUT)


class _Door:
    """One listening socket."""

    def __init__(self, listeners: Listeners, settings: ListenerSettings) -> None:
        self._listeners = listeners
        self._settings = settings
        self._loop = asyncio.get_running_loop()
        self._is_open = False
        if settings.path is not None:
            self._socket = _listen_on_path(settings.path, settings.mode)
            self._inode = settings.path.stat().st_ino
            self.address = (f"unix:{settings.path}", 0)
        else:
            self._socket = _listen(settings.host, settings.port)
            self.address = (settings.host, self._socket.getsockname()[1])

    def open(self) -> None:
        """Accept what comes; does nothing when it is open, or closed for good."""
        if not self._is_open and self._socket.fileno() >= 0:
            self._is_open = True
            self._loop.add_reader(self._socket, self._accept)

    def _shut(self) -> None:
        if self._is_open:
            self._is_open = False
            self._loop.remove_reader(self._socket)

    def _accept(self) -> None:
        for _ in range(ACCEPTED_A_TURN):
            if self._settings.context is not None and self._listeners.crowded:
                self._shut()
                self._listeners.wait_for_handshakes()
                return
            try:
                connection, peer = self._socket.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                # Out of file descriptors, most likely: it passes, and asking on would spin.
                log.error("no connection can be accepted: %s", error)
                self._shut()
                self._loop.call_later(ACCEPT_PAUSE, self.open)
                return
            self._listeners.admit(connection, peer, self._settings)

    def close(self) -> None:
        """Listen no more."""
        self._shut()
        self._socket.close()
        path = self._settings.path
        if path is not None:
            with contextlib.suppress(OSError):  # it may be gone, or another's by now
                if path.stat().st_ino == self._inode:
                    path.unlink()


@dataclass(slots=True)
class _Neighbour:
    """What is known of one address."""

    connections: int = 0
    #: When the connections that it opened are paid for at the rate allowed.
    paid_at: float = 0.0


class _Addresses:
    """How many connections each address has, and how fast it opens new ones."""

    def __init__(self, limit: float, rate: float) -> None:
        self._limit = limit
        self._rate = rate
        self._known: dict[bytes, _Neighbour] = {}
        self._many = ADDRESSES

    def admit(self, host: str, now: float) -> str:
        """Count a new connection; or, uncounted, why it is not allowed."""
        where = network(host)
        neighbour = self._known.get(where)
        if neighbour is None:
            if len(self._known) >= self._many:
                self._forget_idle(now)
            neighbour = self._known[where] = _Neighbour()
        if neighbour.connections >= self._limit:
            return (
                f"its address has {neighbour.connections} connections "
                "(broker.limits.connections_per_address)"
            )
        paid_at = max(neighbour.paid_at, now) + 1 / self._rate
        if paid_at > now + CONNECTION_BURST:
            return (
                f"its address opens more than {self._rate:g} connections a second "
                "(broker.limits.connection_rate)"
            )
        neighbour.paid_at = paid_at
        neighbour.connections += 1
        return ""

    def leave(self, host: str) -> None:
        """A connection from there ended."""
        self._known[network(host)].connections -= 1

    def _forget_idle(self, now: float) -> None:
        self._known = {
            where: neighbour
            for where, neighbour in self._known.items()
            if neighbour.connections or neighbour.paid_at > now
        }
        # Each is looked at once for every two that come: the work stays in proportion.
        self._many = max(ADDRESSES, 2 * len(self._known))


def _listen(host: str, port: int) -> socket.socket:
    """A listening socket; an empty host is every address, IPv6 ones too where there are any."""
    everywhere = not host
    dualstack = everywhere and socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if ":" in host or dualstack else socket.AF_INET
    try:
        sock = socket.create_server(
            (host, port), family=family, backlog=BACKLOG, dualstack_ipv6=dualstack
        )
    except OSError as error:
        raise _cannot_listen(f"{host or '*'}:{port}", error) from None
    sock.setblocking(False)
    return sock


def _listen_on_path(path: Path, mode: int) -> socket.socket:
    """A listening Unix socket, in place of one that nobody listens on any more."""
    sock = socket.socket(socket.AF_UNIX)
    try:
        sock.setblocking(False)
        _clear(path)
        os.fchmod(sock.fileno(), mode)  # before it has a name: it is at no time open to more
        sock.bind(str(path))
        path.chmod(mode)  # what the process's umask has taken away
        sock.listen(BACKLOG)
    except OSError as error:
        sock.close()
        raise _cannot_listen(f"unix:{path}", error) from None
    return sock


def _clear(path: Path) -> None:
    """Remove what an appliance that did not end well has left. OSError: it is something else."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise FileExistsError(errno.EEXIST, "there is a file that is no socket")
        with socket.socket(socket.AF_UNIX) as trial:
            trial.setblocking(False)
            trial.connect(str(path))
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        path.unlink(missing_ok=True)
        return
    except BlockingIOError:  # so many wait there that one more does not fit
        pass
    raise OSError(errno.EADDRINUSE, "another process listens there")


def _cannot_listen(where: str, error: OSError) -> OSError:
    reason = error.strerror or str(error)
    return OSError(error.errno, f"cannot listen on {where} (broker.listeners): {reason}")


def _allow_files(needed: int) -> None:
    """Let the process open so many files, as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    most = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    if most < needed:
        log.warning(
            "broker.limits.connections needs %d open files, and the system allows %d: raise its "
            "limit (ulimit -Hn, or LimitNOFILE= of the systemd unit) or lower the number",
            needed,
            most,
        )
