"""What is on the bus, or named by a route, but not bridged, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

#: The reasons, the most important one first.
SkipReason: TypeAlias = Literal[
    "problem",  # it cannot be opened: its type is not installed, its node does not answer …
    "absent",  # a route names it, and it is not there
    "two_types",  # another type that is on the same name is bridged
    "left_out",  # a route excludes it by `!`
    "hidden",  # a part of its name begins with `_`
    "other_type",  # a route's pattern is for other types
    "of_every_node",  # every node has it, and patterns do not include it
]
_ORDER: tuple[SkipReason, ...] = (
    "problem",
    "absent",
    "two_types",
    "left_out",
    "hidden",
    "other_type",
    "of_every_node",
)

#: The most entries in a summary: a bus may have any number of names.
MAX_ENTRIES = 100


@dataclass(frozen=True, slots=True)
class Skipped:
    """A name that is not bridged.

    `direction` is as in `BridgedTopic`, or `service`, `provided`, `action` or `parameters`. `type`
    is empty if it is not known.
    """

    ros: str
    direction: str
    type: str
    why: SkipReason
    reason: str


def ordered(skips: Iterable[Skipped]) -> list[Skipped]:
    """The most important reasons first, without duplicates."""
    return sorted(set(skips), key=lambda one: (_ORDER.index(one.why), one.ros, one.direction))


def summary(skips: list[Skipped]) -> dict[str, Any]:
    """The content of `{robot}/_appliance/skipped`: the counts, and the first entries."""
    return {
        "count": len(skips),
        "by_reason": dict(Counter(one.why for one in skips)),
        "skipped": [asdict(one) for one in skips[:MAX_ENTRIES]],
    }
