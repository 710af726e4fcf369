"""What the layers of a connection (TCP, TLS, HTTP or WebSocket, MQTT) require of each other.

All but MQTT are below `ClientConnection`. They report to the layer above them what they buffer, and
ask the scheduler before they decode much at once. `MiddleLayer` is what HTTP and WebSocket share.
"""

from __future__ import annotations

import asyncio
from typing import Any, Protocol

from appliance.broker.accounts import Account
from appliance.net.callbacks import Entries


class Schedulable(Protocol):
    """What can be queued for a turn: a connection, or a layer of one."""

    def take_turn(self) -> None:
        """Continue: the others have had their turn."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count an exception that escaped during the turn and end the connection; never raises."""


class UpperLayer(Protocol):
    """The layer above TLS or WebSocket: it accounts for their work and their buffers."""

    @property
    def account(self) -> Account:
        """The user that has logged in, or the account of strangers."""

    def count_buffered(self, size: int) -> None:
        """The layers below buffer so many received bytes that they have not decoded."""

    def input_paused(self) -> None:
        """Received bytes wait below for a turn, and no more are read."""

    def input_resumed(self) -> None:
        """Nothing waits below any more."""

    def partial_record(self, part: bool) -> None:
        """Whether a layer below buffers the beginning of an incomplete record."""


class LayerHandler(UpperLayer, Protocol):
    """The layer above HTTP or WebSocket: the `asyncio.Protocol` that is responsible for the
    connection."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See `asyncio.Protocol`."""

    def data_received(self, data: bytes) -> None:
        """See `asyncio.Protocol`."""

    def eof_received(self) -> bool | None:
        """See `asyncio.Protocol`."""

    def connection_lost(self, exc: Exception | None) -> None:
        """See `asyncio.Protocol`."""

    def pause_writing(self) -> None:
        """See `asyncio.Protocol`."""

    def resume_writing(self) -> None:
        """See `asyncio.Protocol`."""

    def log_refusal(self, what: str, why: str) -> None:
        """Log what was refused or ended."""

    def close(self) -> None:
        """Close the connection; the client was sent the reason."""

    def abort(self) -> None:
        """Close it at once."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count an exception that escaped and end the connection; never raises."""


class LayerScheduler(Protocol):
    """The scheduler as the layers see it: large input waits until others had a turn."""

    entries: Entries

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        """Add to `Counters.cost` what was done for this connection."""

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        """Whether a chunk has to wait for a turn, as this round's cost is used up.

        A small chunk waits only when its user has also used up its share beyond the round.
        """

    def queue_turn(self, member: Schedulable) -> None:
        """Call `take_turn` once, when it is the member's turn."""


class MiddleLayer(asyncio.Transport, asyncio.Protocol):
    """A protocol for the transport below, and the transport of the `protocol` above.

    What both sides say is passed on; a subclass does what is its own.
    """

    _transport: asyncio.Transport

    def __init__(self, protocol: LayerHandler, scheduler: LayerScheduler) -> None:
        super().__init__()
        self._protocol = protocol
        self._scheduler = scheduler
        #: Whether a turn is queued.
        self._queued = False
        #: Bytes that TLS below buffers, and that are buffered here in addition.
        self._below = 0
        self._buffered = 0

    # --- towards the transport -----------------------------------------------------------------

    def fault(self, entry: str, error: Exception) -> None:
        """End this connection because an unexpected exception escaped while it was served."""
        self._protocol.fault(entry, error)

    @property
    def account(self) -> Account:
        """The account that is charged for what TLS does below."""
        return self._protocol.account

    def count_buffered(self, size: int) -> None:
        """TLS below buffers so many bytes."""
        self._below = size
        self._protocol.count_buffered(size + self._buffered)

    def _count_own(self, size: int) -> None:
        """So many bytes are buffered here."""
        if size != self._buffered:
            self._buffered = size
            self._protocol.count_buffered(self._below + size)

    def input_paused(self) -> None:
        """Received bytes wait in TLS."""
        self._protocol.input_paused()

    def input_resumed(self) -> None:
        """Nothing waits in TLS any more."""
        self._protocol.input_resumed()

    def partial_record(self, part: bool) -> None:
        """Whether TLS buffers the beginning of a record."""
        self._protocol.partial_record(part)

    # --- towards the protocol ------------------------------------------------------------------

    def abort(self) -> None:
        """Close at once."""
        self._transport.abort()

    def is_closing(self) -> bool:
        """Whether the connection is closed, or closing."""
        return self._transport.is_closing()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Those of the transport below."""
        self._transport.set_write_buffer_limits(high, low)

    def get_write_buffer_size(self) -> int:
        """Bytes that wait in the transport below."""
        return self._transport.get_write_buffer_size()

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """What the transport below knows."""
        return self._transport.get_extra_info(name, default)
