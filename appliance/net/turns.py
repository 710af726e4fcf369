"""Whose turn it is: what the layers of a connection know of all the other connections."""

from __future__ import annotations

from typing import Protocol

from appliance.broker.accounts import Account
from appliance.net.callbacks import Entries


class Turn(Protocol):
    """Who waits for a turn: a connection, or a layer of one."""

    def take_turn(self) -> None:
        """The others have had their turn."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count what escaped while it was served, and end it; never raises."""


class Charged(Protocol):
    """Who is charged for what a layer below it does, and for what that keeps."""

    @property
    def account(self) -> Account:
        """The user it has logged in as, or that of strangers."""

    def set_apart(self, size: int) -> None:
        """The layers below keep so many bytes that were received and not taken apart yet."""

    def is_not_read(self) -> None:
        """What has come waits below for a turn, and nothing more is read."""

    def is_read(self) -> None:
        """It waits no longer."""

    def has_part(self, part: bool) -> None:
        """Whether a layer below keeps the beginning of a record that has not come whole."""


class Turns(Protocol):
    """What all connections share: who has much to do waits until others have had their turn."""

    entries: Entries

    def count(self, cost: int, charged: Charged) -> None:
        """So much was done for it, see `Counters.cost`."""

    def has_to_wait(self, charged: Charged, *, is_little: bool) -> bool:
        """Whether a chunk is to be taken apart in a turn, as so much else was done in this round.

        A little one has to wait only when its user has had a share beyond the end of the round.
        """

    def queue_turn(self, member: Turn) -> None:
        """Call `take_turn` when it is the member's."""
