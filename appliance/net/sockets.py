"""TCP and Unix sockets: listening, file limits, and what the system knows about a connection."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import math
import os
import resource
import socket
import stat
import struct
import termios
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from appliance.broker.link import PeerStatus

log = logging.getLogger(__name__)

#: The backlog of connections that wait to be accepted, as far as the system allows.
BACKLOG = 4096

#: Why a port is not available, and what to do.
_REASONS = {
    errno.EADDRINUSE: "it is in use already; `appliance doctor` says who has it",
    errno.EADDRNOTAVAIL: "this computer does not have this address; 0.0.0.0 is for all that it has",
    errno.EACCES: "ports as low as this one are for root; `appliance doctor` says what else to do",
}

#: The configuration key of the listeners.
_LISTENERS = "broker.listeners"


def listen(host: str, port: int, leaving: Sequence[socket.socket] = ()) -> socket.socket:
    """A listening socket; an empty host is every address, those of IPv6 included.

    It may take over the port of sockets that are `leaving`, such as `0.0.0.0` that of `127.0.0.1`.
    """
    everywhere = not host
    dualstack = everywhere and socket.has_dualstack_ipv6()
    family = socket.AF_INET6 if ":" in host or dualstack else socket.AF_INET
    try:
        with _shared_ports(leaving):
            sock = socket.create_server(
                (host, port),
                family=family,
                backlog=BACKLOG,
                reuse_port=bool(leaving),
                dualstack_ipv6=dualstack,
            )
    except OSError as error:
        error.strerror = _REASONS.get(error.errno or 0, error.strerror)
        if error.errno is not None and error.errno < 0:  # of getaddrinfo(3)
            error.strerror = f"there is no address for {host!r}; name one, or 0.0.0.0 for all"
        raise _cannot_listen(f"{host or '*'}:{port}", error) from None
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)
    sock.setblocking(False)
    return sock


@contextlib.contextmanager
def _shared_ports(sockets: Sequence[socket.socket]) -> Iterator[None]:
    """Meanwhile other sockets with SO_REUSEPORT (socket(7)) may listen on the same ports."""
    for sock in sockets:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    try:
        yield
    finally:
        for sock in sockets:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 0)


def listen_on_path(path: Path, mode: int, key: str = _LISTENERS) -> socket.socket:
    """A listening Unix socket; one that nobody listens on any more is replaced.

    `key` is the configuration key that an error names.
    """
    sock = socket.socket(socket.AF_UNIX)
    try:
        sock.setblocking(False)
        _clear(path)
        os.fchmod(sock.fileno(), mode)  # before it has a name: it is never open to more
        sock.bind(str(path))
        path.chmod(mode)  # bits that the umask has cleared
        sock.listen(BACKLOG)
    except OSError as error:
        sock.close()
        raise _cannot_listen(f"unix:{path}", error, key) from None
    return sock


def _clear(path: Path) -> None:
    """Remove the socket of an appliance that has crashed. OSError: it is something else."""
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
    except BlockingIOError:  # somebody listens there, and the backlog is full
        pass
    raise OSError(errno.EADDRINUSE, "another process listens there")


def _cannot_listen(where: str, error: OSError, key: str = _LISTENERS) -> OSError:
    reason = error.strerror or str(error)
    return OSError(error.errno, f"cannot listen on {where} ({key}): {reason}")


def allow_files(needed: int) -> None:
    """Raise the process's limit of open files, as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    most = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    if most < needed:
        log.warning(
            "broker.limits.connections needs %d open files, and the system allows %d: raise its "
            "limit (LimitNOFILE= of the systemd unit, --ulimit nofile= of a container, or ulimit "
            "-Hn) or lower the number",
            needed,
            most,
        )


#: Where `tcpi_last_data_recv`, `tcpi_last_ack_recv` (milliseconds), `tcpi_rtt` (microseconds) and
#: `tcpi_bytes_received` are in Linux's `struct tcp_info`, and the first bytes of it, with all of
#: them; Linux before 4.1 lacks the last one.
_LAST_DATA, _LAST_ACK, _ROUND_TRIP, _RECEIVED = 52, 56, 68, 128
_TCP_INFO_SIZE = 136

#: `SO_MEMINFO`; its first two numbers are the memory that unread bytes take, and its limit.
_MEMORY = 55
_MEMORY_SIZE = 36

#: Unread bytes from which on a buffer of unknown size counts as full.
_MUCH = 4096

#: Seconds of silence before the first probe, and between two probes: the least that is possible.
_PROBE_AFTER = 1


def peer_status(connection: socket.socket) -> PeerStatus:
    """What the system knows about the peer's computer; that of a Unix socket is this one."""
    try:
        unread = _unread(connection)
        if connection.family == socket.AF_UNIX:
            return PeerStatus(has_unread=unread > 0)
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_SIZE)
        data, ack, round_trip = (
            struct.unpack_from("=I", info, at)[0] for at in (_LAST_DATA, _LAST_ACK, _ROUND_TRIP)
        )
    except (OSError, ValueError, AttributeError, struct.error):  # closed, or this is no Linux
        return PeerStatus(silence=math.inf)
    return PeerStatus(round_trip / 1e6, min(data, ack) / 1e3, unread > 0)


class ReceiveBuffer(NamedTuple):
    """The state of a socket's receive buffer, as `Inflow.look` takes it."""

    unread: bool
    full: bool
    received: int
    round_trip: float


def receive_buffer(connection: socket.socket) -> ReceiveBuffer:
    """How much is unread, and whether the buffer is so full that the peer may hold back more: its
    TCP window is much smaller than it may be."""
    try:
        waits = _unread(connection)
        if connection.family == socket.AF_UNIX:
            return ReceiveBuffer(waits > 0, waits > _MUCH, 0, 0.0)
        info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_SIZE)
        (round_trip,) = struct.unpack_from("=I", info, _ROUND_TRIP)
        (received,) = struct.unpack_from("=Q", info.ljust(_TCP_INFO_SIZE, b"\0"), _RECEIVED)
    except (OSError, ValueError, AttributeError, struct.error):  # closed, or this is no Linux
        return ReceiveBuffer(unread=False, full=False, received=0, round_trip=0.0)
    try:
        memory = connection.getsockopt(socket.SOL_SOCKET, _MEMORY, _MEMORY_SIZE)
        taken, most = struct.unpack_from("=II", memory)
        full = 4 * taken > most
    except (OSError, struct.error):  # before 4.12
        full = waits > _MUCH
    return ReceiveBuffer(waits > 0, full, received, round_trip / 1e6)


def _unread(connection: socket.socket) -> int:
    (size,) = struct.unpack("i", fcntl.ioctl(connection.fileno(), termios.FIONREAD, b"\0" * 4))
    return int(size)


class Probe:
    """TCP keep-alive probes, which the peer's system answers by itself, from now until `end`."""

    _SHORT = (("TCP_KEEPIDLE", _PROBE_AFTER), ("TCP_KEEPINTVL", _PROBE_AFTER))

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._before: list[tuple[int, int]] = []
        if connection.family == socket.AF_UNIX:
            return
        with contextlib.suppress(OSError, AttributeError):
            for name, seconds in self._SHORT:
                option = getattr(socket, name)
                self._before.append((option, connection.getsockopt(socket.IPPROTO_TCP, option)))
                connection.setsockopt(socket.IPPROTO_TCP, option, seconds)

    def end(self) -> None:
        """Restore the probes' intervals."""
        with contextlib.suppress(OSError):
            for option, value in self._before:
                self._connection.setsockopt(socket.IPPROTO_TCP, option, value)
