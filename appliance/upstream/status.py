"""How a link is: for `appliance upstream`, `appliance status`, and the topics that tell it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(slots=True)
class LinkStatus:
    """The state of a link; times in seconds, sizes in bytes.

    `problem` is why it is not connected, or what is wrong although it is. `waiting` messages are
    not acknowledged by the fleet's broker yet; the oldest is `oldest` seconds old. `dropped` is by
    rule and reason, both ways. Of what came, which `came` counts by the filters of rules there,
    `held_back` messages wait for their receivers here, and `unacknowledged` ones are not
    acknowledged to the fleet's broker. `forgotten` ones were lost at reloads. `refused_filters` are
    of subscriptions that it refuses, `missing_filters` of those upon which it closes the
    connection. `denied` says why the access rules here do not let it read a filter, and
    `denied_inward` why they do not let it publish what came. `state_refusal` is why the fleet does
    not see whether the robot is online.
    """

    name: str
    kind: str
    connected: bool = False
    server: str = ""
    version: str = ""
    client_id: str = ""
    since: float | None = None
    problem: str | None = None
    attempts: int = 0
    connections: int = 0
    round_trip: float | None = None
    window: int = 0
    inflight: int = 0
    waiting: int = 0
    waiting_bytes: int = 0
    oldest: float | None = None
    sent: int = 0
    sent_a_second: float = 0.0
    offered: int = 0
    offered_a_second: float = 0.0
    received: int = 0
    delivered: int = 0
    came: dict[str, int] = field(default_factory=dict)
    refused: int = 0
    unacknowledged: int = 0
    held_back: int = 0
    dropped: dict[str, dict[str, int]] = field(default_factory=dict)
    set_aside: int = 0
    too_large: int = 0
    forgotten: int = 0
    refused_filters: list[str] = field(default_factory=list)
    missing_filters: list[str] = field(default_factory=list)
    denied: dict[str, str] = field(default_factory=dict)
    denied_inward: dict[str, str] = field(default_factory=dict)
    state_refusal: str | None = None
    advice: str | None = None

    def count_dropped(self, rule: str, reason: str, count: int) -> None:
        """So many messages of a rule were dropped; one in the other direction may have its name."""
        reasons = self.dropped.setdefault(rule, {})
        reasons[reason] = reasons.get(reason, 0) + count

    def as_json(self) -> dict[str, Any]:
        """All of it as JSON values."""
        return asdict(self)


def warnings_of(status: dict[str, Any]) -> Iterator[str]:
    """What a person should know of a link, from its status as JSON values."""
    if status["problem"]:
        yield status["problem"]
    if status["state_refusal"]:
        yield status["state_refusal"]
    if status["advice"]:
        yield status["advice"]
    for name, reason in status["denied"].items():
        yield f"the access rules do not let it read {name}: {reason}"
    for name, reason in status["denied_inward"].items():
        yield f"the access rules do not let it publish here what comes on {name}: {reason}"
    for name in status["refused_filters"]:
        yield f"the fleet's broker refuses the subscription to {name}"
    for name in status["missing_filters"]:
        yield (
            f"the link has not subscribed to {name}: the fleet's broker has closed the connection "
            "upon that; it is tried again later"
        )
    if status["too_large"]:
        yield (
            "messages that are larger than the fleet's broker takes now (Maximum Packet Size) wait "
            f"until it takes more: {status['too_large']}"
        )
    if status["forgotten"]:
        yield (
            "messages of QoS 0 that waited in memory were lost when its section was reloaded, as "
            "nothing could be stored: "
            f"{status['forgotten']}"
        )
    if status["set_aside"]:
        yield f"messages that the fleet's broker never takes were set aside: {status['set_aside']}"


def bottleneck(status: LinkStatus) -> str | None:
    """Why the link cannot carry all that comes, if the window is the reason."""
    if not (status.connected and status.window and status.round_trip):
        return None
    allowed = status.window / status.round_trip
    if status.inflight < status.window or status.offered_a_second <= allowed:
        return None
    return (
        f"Receive Maximum {status.window} at {status.round_trip * 1000:.0f} ms allows "
        f"{allowed:.0f} a second; {status.offered_a_second:.0f} come"
    )
