"""What the layers of a connection (TCP, TLS, WebSocket, MQTT) require of each other.

TLS and WebSocket are below `ClientConnection`. They report to the layer above them what they
buffer, and ask the scheduler before they decode much at once.
"""

from __future__ import annotations

from typing import Protocol

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
