"""Closing a connection so that its last bytes arrive (a lingering close)."""

from __future__ import annotations

import socket
from collections.abc import Callable

from appliance.net.callbacks import Entries

#: Limits of one lingering close: seconds, and bytes that are received and discarded.
TIMEOUT = 2.0
BYTES = 64 * 1024 * 1024

_SCRATCH = bytearray(256 * 1024)


class LingeringClose:
    """A connection after its last byte was written, until the peer has closed it as well.

    Closing a socket that has unread input resets the connection, and a reset can discard what the
    peer has not read yet: the reason why it was disconnected. Therefore only the sending direction
    is shut down, and what still comes in is discarded until a limit is reached.
    """

    def __init__(
        self, connection: socket.socket, ended: Callable[[LingeringClose], None], entries: Entries
    ) -> None:
        self._socket = connection
        self._ended = ended
        self._left = BYTES
        self._entries = entries
        self._timeout = entries.later("lingering.timeout", TIMEOUT, self.end, failed=self.end)

    def listen(self) -> None:
        """Begin; it ends by itself."""
        try:
            self._socket.shutdown(socket.SHUT_WR)
            self._entries.reader("lingering.chunk", self._socket, self._discard, failed=self.end)
        except OSError:  # the peer has closed it already
            self.end()

    def _discard(self) -> None:
        try:
            size = self._socket.recv_into(_SCRATCH)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            size = 0
        self._left -= size
        if not size or self._left < 0:
            self.end()

    def end(self) -> None:
        """Close it; may be called twice."""
        self._timeout.cancel()
        if self._socket.fileno() >= 0:
            self._entries.loop.remove_reader(self._socket)
            self._socket.close()
        self._ended(self)
