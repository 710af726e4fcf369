"""The store's own time, in seconds: it goes on through restarts, and never jumps.

What expires is stored with the time at which it does. By the wall clock it would expire at once, or
never, on a computer that starts in 1970, or whose clock is set by hand. So the store counts: it
begins with the wall clock's time, and then goes on by the clock that only counts, which does so for
as long as the computer runs, whoever sets the other one. How long the computer was switched off
only the wall clock can tell, and it is believed when that can be true.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from appliance.host.clock import RELEASED
from appliance.store.schema import Row

#: The key of the one row of its table.
KEY = 1

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class Clocks:
    """What the computer's clocks say at one moment, in seconds, and since which boot."""

    wall: float
    counted: float
    boot: str


@dataclass(frozen=True, slots=True)
class Stamp:
    """The store's time at a moment, and what the computer's clocks said."""

    time: float
    clocks: Clocks

    @property
    def shift(self) -> float:
        """What the wall clock is ahead of the store's time."""
        return self.clocks.wall - self.time

    def later(self, now: Clocks) -> float:
        """The store's time now, after a restart of the process or of the computer."""
        then = self.clocks
        if now.boot and now.boot == then.boot and now.counted >= then.counted:
            return self.time + now.counted - then.counted
        if then.wall < RELEASED.timestamp():  # it had never been set
            return self.time
        return self.time + max(0.0, now.wall - then.wall)

    def row(self) -> Row:
        """The row that it is kept as."""
        return KEY, self.time, self.clocks.wall, self.clocks.counted, self.clocks.boot


def stamp_of(row: Row | None) -> Stamp | None:
    """The stamp in a row; None when there is none, as in a store of before there were any."""
    if row is None:
        return None
    _, time, wall, counted, boot = row
    moments = [each for each in (time, wall, counted) if isinstance(each, float)]
    if len(moments) < 3 or not all(map(isfinite, moments)) or not isinstance(boot, str):
        return None
    return Stamp(moments[0], Clocks(moments[1], moments[2], boot))


def boot_id() -> str:
    """What tells this boot of the computer from all others; empty where nothing does."""
    try:
        return _BOOT_ID.read_text().strip()
    except OSError:
        return ""
