"""PUBACKs to the fleet's broker: in the order of arrival, and after the commits they depend on."""

from __future__ import annotations

from collections import deque
from typing import Protocol

from appliance.broker.broker import Broker


class AckLink(Protocol):
    """The connection that the messages came on, and no other one."""

    def acknowledge(self, packet_id: int, code: int) -> None:
        """Send a PUBACK; in MQTT 3.1.1, without the code."""

    def abandon(self) -> None:
        """End the connection without sending anything more."""


class Acknowledgements:
    """The acknowledgements of one connection; `Broker.flush` and the commits of the store call it.

    As in `broker.output.Output`, an acknowledgement that depends on stored rows waits for their
    batch, and so do those behind it. If the commit fails, nothing that waits is sent.
    """

    def __init__(self, broker: Broker, link: AckLink) -> None:
        self._broker = broker
        #: None after the end of the connection.
        self._link: AckLink | None = link
        #: Since the last flush, and the batch of the store that they depend on.
        self._out: list[tuple[int, int]] = []
        self._batch = 0
        #: Those that wait, by batch.
        self._waiting: deque[tuple[int, list[tuple[int, int]]]] = deque()

    def __str__(self) -> str:
        return f"acknowledgements to {self._link}"

    def add(self, packet_id: int, code: int) -> None:
        """Acknowledge a message, with what was staged for it just now."""
        store = self._broker.store
        if store.fresh:
            store.fresh = False
            self._batch = store.batch
        if not self._out:
            self._broker.unflushed.append(self)
        self._out.append((packet_id, code))

    def close(self) -> None:
        """The connection has ended: what was not acknowledged on it never is."""
        self._link = None
        self._out.clear()
        self._waiting.clear()

    # --- Flushing, see broker.broker -----------------------------------------------------------

    def flush(self) -> None:
        """Send what depends on nothing that is not stored."""
        out, self._out = self._out, []
        self._send(out)

    def wait(self, committed: int) -> bool:
        """Hold them back if they depend on a later batch than `committed`."""
        waiting, batch = self._waiting, self._batch  # which only grows, so the order is preserved
        if batch <= committed or self._link is None:
            return False
        out, self._out = self._out, []
        if waiting and waiting[-1][0] == batch:
            waiting[-1][1].extend(out)
        else:
            waiting.append((batch, out))
        return True

    def release(self, committed: int) -> bool:
        """Send those that waited for this batch; True when others wait for a later one."""
        waiting = self._waiting
        while waiting and waiting[0][0] <= committed:
            self._send(waiting.popleft()[1])
        return bool(waiting)

    def abandon(self) -> None:
        """End the connection: what they acknowledge was not stored."""
        link = self._link
        self.close()
        if link is not None:
            link.abandon()

    def _send(self, acknowledgements: list[tuple[int, int]]) -> None:
        for packet_id, code in acknowledgements:
            if self._link is None:
                return
            self._link.acknowledge(packet_id, code)
