"""What is on the bus, or named by a route, and not bridged; and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

#: In the order in which somebody wants to know of them.
SkipReason: TypeAlias = Literal[
    "problem",  # it cannot be set up: its type is not installed, its node does not answer …
    "absent",  # a route names it, and it is not there
    "two_types",  # another type that is on the same name is bridged
    "left_out",  # a route leaves it out by `!`
    "hidden",  # a part of its name begins with `_`
    "other_type",  # a route's pattern is for other types
    "of_every_node",  # every node has it, and patterns do not take it
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

#: Entries of a retained message: a bus may have any number of names.
MOST_TOLD = 100


@dataclass(frozen=True, slots=True)
class Skipped:
    """A name that is not bridged in a direction, as in `BridgedTopic`, or as `service`, `action` or
    `parameters`. `type` is empty where it is not known."""

    ros: str
    direction: str
    type: str
    why: SkipReason
    reason: str


def ordered(skips: Iterable[Skipped]) -> list[Skipped]:
    """What matters most first, and once each."""
    return sorted(set(skips), key=lambda one: (_ORDER.index(one.why), one.ros, one.direction))


def summary(skips: list[Skipped]) -> dict[str, Any]:
    """What `{robot}/_appliance/skipped` says: how many there are, and the first of them."""
    return {
        "count": len(skips),
        "by_reason": dict(Counter(one.why for one in skips)),
        "skipped": [asdict(one) for one in skips[:MOST_TOLD]],
    }
