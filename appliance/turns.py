"""Whose turn it is: what the layers of a connection know of all the other connections."""

from __future__ import annotations

from typing import Protocol

from appliance.entries import Entries


class Turn(Protocol):
    """Who waits for a turn: a connection, or a layer of one."""

    def take_turn(self) -> None:
        """The others have had their turn."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count what escaped while it was served, and end it; never raises."""


class Turns(Protocol):
    """What all connections share: who has much to do waits until others have had their turn."""

    entries: Entries

    def count(self, effort: int) -> None:
        """So much was done, see `Counters.effort`."""

    def is_busy(self) -> bool:
        """Whether as much was done as one round of the event loop is for."""

    def queue_turn(self, member: Turn) -> None:
        """Call `take_turn` when it is the member's."""
