"""Whose turn it is: what the layers of a connection know of all the other connections."""

from __future__ import annotations

from typing import Protocol

from appliance.broker.accounts import Account
from appliance.net.callbacks import Entries


class Schedulable(Protocol):
    """Who waits for a turn: a connection, or a layer of one."""

    def take_turn(self) -> None:
        """The others have had their turn."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count what escaped while it was served, and end it; never raises."""


class UpperLayer(Protocol):
    """Who is charged for what a layer below it does, and for what that keeps."""

    @property
    def account(self) -> Account:
        """The user it has logged in as, or that of strangers."""

    def count_buffered(self, size: int) -> None:
        """The layers below keep so many bytes that were received and not taken apart yet."""

    def input_paused(self) -> None:
        """What has come waits below for a turn, and nothing more is read."""

    def input_resumed(self) -> None:
        """It waits no longer."""

    def partial_record(self, part: bool) -> None:
        """Whether a layer below keeps the beginning of a record that has not come whole."""


class LayerScheduler(Protocol):
    """What all connections share: who has much to do waits until others have had their turn."""

    entries: Entries

    def count_cost(self, cost: int, charged: UpperLayer) -> None:
        """So much was done for it, see `Counters.cost`."""

    def must_wait(self, charged: UpperLayer, *, is_small: bool) -> bool:
        """Whether a chunk is to be taken apart in a turn, as so much else was done in this round.

        A little one has to wait only when its user has had a share beyond the end of the round.
        """

    def queue_turn(self, member: Schedulable) -> None:
        """Call `take_turn` when it is the member's."""
