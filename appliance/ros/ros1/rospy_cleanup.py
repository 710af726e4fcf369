"""What rospy leaves undone: it stays in memory, its servers and their threads do not end, one
caller keeps away all others, and it believes a length of 4 GB.

It is given here as a module, and imported in ros1.py alone.
"""

from __future__ import annotations

import atexit
import logging
import socket
import sys
import threading
from contextlib import suppress
from io import BytesIO
from typing import Any
from weakref import WeakSet

from appliance.ros.ros1.endpoints import forget_classes
from appliance.ros.ros1.peers import MAX_HEADER_SIZE
from appliance.ros.ros1.types import MAX_MESSAGE_SIZE

log = logging.getLogger(__name__)

#: Seconds that a caller of ours may take between two bytes of what it is for, and how many may do
#: so at a time.
HANDSHAKE_TIMEOUT = 5.0
MAX_HANDSHAKES = 200


def unload() -> None:
    """Let go of a rospy that has ended, to import it anew; nothing of it stays in memory."""
    core = sys.modules.get("rospy.core")
    if core is not None:
        forget_classes()
        atexit.unregister(core._ros_atexit)
        logger = logging.getLogger("rospy")
        for handler in list(logger.handlers):
            if isinstance(handler, core.NullHandler):
                logger.removeHandler(handler)
    for name in [name for name in sys.modules if name.partition(".")[0] == "rospy"]:
        del sys.modules[name]


class ServerShutdown:
    """The two servers of a node, to be ended with all their threads. rospy closes the sockets that
    these wait at, which they do not notice, and keeps the connections, and others their ends. And
    it hears one caller at a time out: one that says nothing would keep away all others."""

    def __init__(self, rospy: Any) -> None:
        from rosgraph.xmlrpc import XmlRpcNode

        owners = [getattr(hook, "__self__", None) for hook in rospy.core._shutdown_hooks]
        node = next((owner for owner in owners if isinstance(owner, XmlRpcNode)), None)
        if node is None or node.server is None:  # shut down from outside already
            return
        self._node = node
        self._connections: WeakSet[socket.socket] = WeakSet()
        self._process = node.server.process_request
        node.server.process_request = self._note_and_process
        base = rospy.impl.tcpros_base
        self._tcpros = base._tcpros_server
        #: Connections of which it is not known yet what they are for; a dict for its lock.
        self._callers: dict[socket.socket, None] = {}
        self._admit = self._tcpros._tcp_server_callback
        self._tcpros._tcp_server_callback = self._hear_out
        if self._tcpros.tcp_ros_server is not None:
            self._tcpros.tcp_ros_server.inbound_handler = self._hear_out
        self._read_header = base.read_ros_handshake_header
        base.read_ros_handshake_header = self._read_header_in_time
        rospy.core.add_preshutdown_hook(self._end)

    def _note_and_process(self, request: socket.socket, address: object) -> None:
        self._connections.add(request)
        self._process(request, address)

    def _hear_out(self, caller: socket.socket, address: object) -> None:
        def admit() -> None:
            try:
                self._admit(caller, address)
            finally:
                self._callers.pop(caller, None)

        if len(self._callers) >= MAX_HANDSHAKES:
            caller.close()
            return
        self._callers[caller] = None
        threading.Thread(target=admit, name="ros caller", daemon=True).start()

    def _read_header_in_time(self, connection: socket.socket, *more: Any) -> Any:
        if connection not in self._callers:  # one of our own
            return self._read_header(connection, *more)
        connection.settimeout(HANDSHAKE_TIMEOUT)
        try:
            return self._read_header(connection, *more)
        finally:
            connection.settimeout(None)

    def _end(self, _reason: str) -> None:
        self._node.is_shutdown = True
        self._node.server.shutdown()
        for connection in list(self._connections):
            with suppress(OSError):  # one that has ended
                connection.shutdown(socket.SHUT_RD)  # what it has asked for is answered
        tcp = self._tcpros.tcp_ros_server
        if tcp is not None:
            tcp.is_shutdown = True
            tcp.server_sock.shutdown(socket.SHUT_RDWR)  # wakes accept()
            tcp.server_sock.close()
        for caller in list(self._callers):
            with suppress(OSError):
                caller.shutdown(socket.SHUT_RDWR)


class _HeaderBuffer(BytesIO):
    """What has come of a TCPROS header, and then of what is behind it."""

    _is_bounded = False

    def write(self, data: Any) -> int:
        from rosgraph.network import ROSHandshakeException

        size = super().write(data)
        if not self._is_bounded and self.tell() >= 4:
            self._is_bounded = True
            if _announced(self) > MAX_HEADER_SIZE:
                raise ROSHandshakeException(f"a header of {_announced(self)} bytes")
        return size


def _announced(buffer: BytesIO) -> int:
    """The length that is before what is in a buffer."""
    with buffer.getbuffer() as data:
        return int.from_bytes(data[:4], "little")


def limit_receive_size(rospy: Any) -> None:
    """Pass over what is announced to be larger than anything is: rospy keeps what has come of a
    message until it is complete, and a wrong length may say 4 GB."""
    base = rospy.impl.tcpros_base
    receive, read_header = base.recv_buff, base.read_ros_handshake_header

    def receive_bounded(peer: socket.socket, buffer: BytesIO, size: int) -> int:
        count = int(receive(peer, buffer, size))
        announced = _announced(buffer)
        if announced <= MAX_MESSAGE_SIZE:
            return count
        log.warning(
            "a message of %d bytes, the most are %d, is left out", announced, MAX_MESSAGE_SIZE
        )
        left = 4 + announced - buffer.tell()
        while left:
            buffer.seek(0)
            buffer.truncate()
            left -= int(receive(peer, buffer, min(size, left)))
        buffer.seek(0)
        buffer.truncate()
        return count

    def read_header_bounded(peer: socket.socket, buffer: BytesIO, size: int) -> Any:
        own = _HeaderBuffer()
        header = read_header(peer, own, size)
        buffer.write(own.getvalue())  # what came behind it
        return header

    base.recv_buff = receive_bounded
    base.read_ros_handshake_header = read_header_bounded
