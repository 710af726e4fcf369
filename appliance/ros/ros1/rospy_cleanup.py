"""Corrections of rospy: it stays in memory, does not end its servers and their threads, lets one
peer block all others, and accepts a length of 4 GB.

rospy is an argument here; only node.py imports it.
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

#: Seconds that a peer may take between two bytes of its TCPROS header, and how many peers may be
#: sending theirs at the same time.
HANDSHAKE_TIMEOUT = 5.0
MAX_HANDSHAKES = 200


def unload() -> None:
    """Unload a rospy that has ended, so that it can be imported again; nothing of it stays in
    memory."""
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
    """Shuts the two servers of a node down, with all their threads and connections.

    rospy closes the sockets on which the servers wait, which does not wake them, and leaves their
    connections open. And it reads the header of one peer at a time, so that a peer that sends
    nothing would block all others. Here each header is read on a thread of its own.
    """

    def __init__(self, rospy: Any) -> None:
        from rosgraph.xmlrpc import XmlRpcNode

        owners = [getattr(hook, "__self__", None) for hook in rospy.core._shutdown_hooks]
        node = next((owner for owner in owners if isinstance(owner, XmlRpcNode)), None)
        if node is None or node.server is None:  # has been shut down from outside
            return
        self._node = node
        self._connections: WeakSet[socket.socket] = WeakSet()
        self._process = node.server.process_request
        node.server.process_request = self._track_and_process
        base = rospy.impl.tcpros_base
        self._tcpros = base._tcpros_server
        #: Connections whose header is being read. A dict, whose single operations are atomic.
        self._handshakes: dict[socket.socket, None] = {}
        self._admit = self._tcpros._tcp_server_callback
        self._tcpros._tcp_server_callback = self._read_header_on_thread
        if self._tcpros.tcp_ros_server is not None:
            self._tcpros.tcp_ros_server.inbound_handler = self._read_header_on_thread
        self._read_header = base.read_ros_handshake_header
        base.read_ros_handshake_header = self._read_header_in_time
        rospy.core.add_preshutdown_hook(self._end)

    def _track_and_process(self, request: socket.socket, address: object) -> None:
        self._connections.add(request)
        self._process(request, address)

    def _read_header_on_thread(self, peer: socket.socket, address: object) -> None:
        def admit() -> None:
            try:
                self._admit(peer, address)
            finally:
                self._handshakes.pop(peer, None)

        if len(self._handshakes) >= MAX_HANDSHAKES:
            peer.close()
            return
        self._handshakes[peer] = None
        threading.Thread(target=admit, name="ros handshake", daemon=True).start()

    def _read_header_in_time(self, connection: socket.socket, *more: Any) -> Any:
        if connection not in self._handshakes:  # this node opened it
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
            with suppress(OSError):  # closed already
                connection.shutdown(socket.SHUT_RD)  # its present request is still answered
        tcp = self._tcpros.tcp_ros_server
        if tcp is not None:
            tcp.is_shutdown = True
            tcp.server_sock.shutdown(socket.SHUT_RDWR)  # wakes accept()
            tcp.server_sock.close()
        for peer in list(self._handshakes):
            with suppress(OSError):
                peer.shutdown(socket.SHUT_RDWR)


class _HeaderBuffer(BytesIO):
    """A buffer that refuses a TCPROS header longer than MAX_HEADER_SIZE."""

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
    """The length field at the start of a buffer."""
    with buffer.getbuffer() as data:
        return int.from_bytes(data[:4], "little")


def limit_receive_size(rospy: Any) -> None:
    """Discard messages whose announced length exceeds MAX_MESSAGE_SIZE.

    rospy buffers a message until it is complete, and a wrong length may be up to 4 GB.
    """
    base = rospy.impl.tcpros_base
    receive, read_header = base.recv_buff, base.read_ros_handshake_header

    def receive_bounded(peer: socket.socket, buffer: BytesIO, size: int) -> int:
        count = int(receive(peer, buffer, size))
        announced = _announced(buffer)
        if announced <= MAX_MESSAGE_SIZE:
            return count
        log.warning(
            "a message of %d bytes is dropped, at most %d are received", announced, MAX_MESSAGE_SIZE
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
        buffer.write(own.getvalue())  # bytes that arrived behind the header
        return header

    base.recv_buff = receive_bounded
    base.read_ros_handshake_header = read_header_bounded
