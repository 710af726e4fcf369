"""How much of what links keep may be in memory because it is not on the disk yet.

The disk may be slow, or stand still. What is dropped then is what nobody was acknowledged for.
"""

from __future__ import annotations

from typing import Final

from appliance.broker.backlogs import Backlogs

MIB: Final = 1 << 20

#: Bytes that may wait to be written for all links, by lane. With more, no message of QoS 0 is
#: stored; none of QoS 1 that nobody is acknowledged for, such as one from ROS; and the publishers
#: of others wait (`must_wait`). Beyond that comes what clients had been acknowledged for already,
#: or what is retained: the broker has it in memory in any case.
UNWRITTEN_SIZE: Final = (16 * MIB, 12 * MIB, 8 * MIB)
UNWRITTEN_FROM_ROS: Final = (24 * MIB, 20 * MIB, 16 * MIB)
UNWRITTEN_AWAITED: Final = (32 * MIB, 28 * MIB, 24 * MIB)


class DiskRoom:
    """What may be stored now. While nothing can be written at all, messages are refused."""

    def __init__(self, backlogs: Backlogs) -> None:
        self._backlogs = backlogs

    @property
    def is_behind(self) -> bool:
        """Whether `must_wait` is true of some lane."""
        backlogs = self._backlogs
        return backlogs.unwritten >= UNWRITTEN_AWAITED[-1] and not backlogs.failing

    def must_wait(self, lane: int) -> bool:
        """Whether the publisher of a message that is to be stored should wait with it, where it is
        acknowledged."""
        backlogs = self._backlogs
        return backlogs.unwritten >= UNWRITTEN_AWAITED[lane] and not backlogs.failing

    def must_drop(self, lane: int, qos: int) -> bool:
        """Whether a message that is to be stored is dropped, where nobody is acknowledged."""
        backlogs = self._backlogs
        limits = UNWRITTEN_FROM_ROS if qos else UNWRITTEN_SIZE
        return backlogs.unwritten >= limits[lane] and not backlogs.failing

    @property
    def may_store_again(self) -> bool:
        """Whether what is on the disk may be written there once more, in another place."""
        backlogs = self._backlogs
        return not backlogs.failing and backlogs.unwritten < UNWRITTEN_SIZE[-1]
