"""The store's own clock, in seconds: it continues through restarts and never jumps.

Sessions and messages are stored with the time at which they expire. By the wall clock they would
expire at once, or never, on a computer that starts in 1970 or whose clock is set by hand. So the
store's clock starts with the time of the wall clock, and then follows the monotonic clock, which
runs for as long as the computer does and which nobody sets. How long the computer was switched off
only the wall clock can tell; it is believed unless it went backwards or was never set.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from appliance.host.clock import NUDGE, RELEASED, StepWatch
from appliance.store.rows import ClockRow

log = logging.getLogger("appliance.store")

#: The key of the only row in the table `clock`.
KEY = 1

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class Clocks:
    """The computer's clocks at one moment, in seconds."""

    wall: float
    #: The monotonic clock, which starts anew with each boot.
    counted: float
    boot: str


@dataclass(frozen=True, slots=True)
class Stamp:
    """The store's time at one moment, and the computer's clocks at that moment."""

    time: float
    clocks: Clocks

    @property
    def shift(self) -> float:
        """Seconds that the wall clock is ahead of the store's."""
        return self.clocks.wall - self.time

    def later(self, now: Clocks) -> float:
        """The store's time now, after a restart of the process or of the computer."""
        then = self.clocks
        if now.boot and now.boot == then.boot and now.counted >= then.counted:
            return self.time + now.counted - then.counted
        if then.wall < RELEASED.timestamp():  # it was never set, so it says nothing
            return self.time
        return self.time + max(0.0, now.wall - then.wall)

    def row(self) -> ClockRow:
        """The row that stores it."""
        return ClockRow(KEY, self.time, self.clocks.wall, self.clocks.counted, self.clocks.boot)


def stamp_of(rows: dict[int, ClockRow]) -> Stamp | None:
    """The stamp in the table; None when it is damaged, or an older appliance stored none."""
    row = rows.get(KEY)
    if row is None:
        return None
    moments = [each for each in (row.time, row.wall, row.counted) if isinstance(each, float)]
    if len(moments) < 3 or not all(map(isfinite, moments)) or not isinstance(row.boot, str):
        return None
    return Stamp(moments[0], Clocks(moments[1], moments[2], row.boot))


def boot_id() -> str:
    """The kernel's id of this boot; empty where it has none."""
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""


class StoreClock:
    """The store's clock while the appliance runs: the event loop's, ahead by `offset` seconds."""

    def __init__(self, wall: Callable[[], float], boot: Callable[[], str]) -> None:
        self.offset = 0.0
        self._wall = wall
        self._boot = boot
        self._counted: Callable[[], float]
        self._steps: StepWatch

    def start(self, counted: Callable[[], float], stamp: Stamp | None) -> None:
        """Continue from what was stored; `counted` is the event loop's clock."""
        self._counted = counted
        clocks = self._clocks()
        self._steps = StepWatch(clocks.counted, self._wall)
        self.offset = (clocks.wall if stamp is None else stamp.later(clocks)) - clocks.counted
        if stamp is not None and clocks.wall < stamp.clocks.wall - NUDGE:
            log.warning(
                "this computer's clock is behind that of the last run by %.0f s: sessions and "
                "messages expire as if it had not been switched off since",
                stamp.clocks.wall - clocks.wall,
            )

    def now(self) -> float:
        """The store's time."""
        return self._counted() + self.offset

    def stamp(self) -> Stamp:
        """The time to be stored, with the computer's clocks."""
        clocks = self._clocks()
        return Stamp(clocks.counted + self.offset, clocks)

    def was_set(self) -> bool:
        """Whether somebody has set the wall clock since the last call, or the computer slept."""
        return self._steps.look(self._counted()) != 0

    def _clocks(self) -> Clocks:
        return Clocks(self._wall(), self._counted(), self._boot())
