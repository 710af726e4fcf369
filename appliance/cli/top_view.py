"""What `appliance top` shows: lines for any width and height, from what the appliance answers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any, Final, Literal, TypeAlias

from appliance.cli.tables import cut, table, visible
from appliance.config import about_size

ARROWS: Final = {"to_mqtt": "→", "to_ros": "←"}

#: The counters of what a route should have carried and has not.
NOT_CARRIED: Final = ("lost", "dropped", "skipped", "errors", "expired", "refused")

#: Warnings have one of so many lines, and clients, where the routes need the rest.
_WARNINGS: Final = 4
_CLIENTS: Final = 3


#: The order of the routes: what carries or loses most first, or by name.
Sort: TypeAlias = Literal["rate", "loss", "name"]

#: Rich's styles of lines.
_TITLE: Final = "bold"
_HEAD: Final = "reverse"
_WARNING: Final = "yellow"


@dataclass(frozen=True, slots=True)
class Line:
    """A line of the screen."""

    text: str
    style: str = ""


@dataclass(frozen=True)
class Snapshot:
    """What the appliance has answered at `time` (monotonic, seconds); what it has not, `problems`
    explain."""

    time: float
    status: dict[str, Any] | None = None
    routes: Sequence[dict[str, Any]] = ()
    clients: Sequence[dict[str, Any]] = ()
    problems: Sequence[str] = ()
    #: Messages that were not carried, a second, by `key_of` a route.
    losses: dict[tuple[str, ...], float] = field(default_factory=dict)


def topics_of(answer: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those of the bridged that are topics: calls have no rates."""
    return [entry for entry in answer if entry["direction"] in ARROWS]


def key_of(route: dict[str, Any]) -> tuple[str, ...]:
    """What distinguishes a bridged topic."""
    return route["ros"], route["mqtt"], route["direction"]


def loss_of(route: dict[str, Any]) -> int:
    """Messages that were not carried since the topic came."""
    return sum(route[name] for name in NOT_CARRIED)


def losses(before: Snapshot, routes: Sequence[dict[str, Any]], now: float) -> dict[Any, float]:
    """What routes have lost a second since `before`."""
    seconds = now - before.time
    known = {key_of(route): loss_of(route) for route in before.routes}
    found = {}
    for route in routes:
        grown = loss_of(route) - known.get(key_of(route), loss_of(route))
        if grown > 0 and seconds > 0:  # it is smaller when the topic or the appliance began anew
            found[key_of(route)] = grown / seconds
    return found


def lines(snapshot: Snapshot, sort: Sort, width: int | None, height: int | None) -> list[Line]:
    """All that is shown, in so many cells and lines at most; without limits, all of it."""
    status = snapshot.status or {}
    title = [Line(text, _TITLE) for text in _title(status)] if status else []
    told = (*snapshot.problems, *status.get("warnings", ()))
    warnings = [Line(text, _WARNING) for text in told]
    routes = _table([ROUTE_HEAD, *_routes(snapshot, sort)], width, ROUTE_WIDTHS)
    clients = _table([CLIENT_HEAD, *_clients(snapshot)], width, CLIENT_WIDTHS)
    if height is not None:
        left = height - len(title)
        warnings = _clipped(warnings, max(left // _WARNINGS, 1))
        left -= len(warnings)
        routes = _clipped(
            routes, left - min(len(clients), max(left // _CLIENTS, left - len(routes)))
        )
        clients = _clipped(clients, left - len(routes))
    shown = [*title, *warnings, *routes, *clients][:height]
    return [_visible(line, width) for line in shown]


def _visible(line: Line, width: int | None) -> Line:
    text = visible(line.text)
    return Line(text if width is None else cut(text, width), line.style)


def _clipped(found: list[Line], room: int) -> list[Line]:
    """As many as there is room for; the last one says how many there are beside them."""
    if len(found) <= room:
        return found
    kept = found[: max(room - 1, 0)]
    return [*kept, Line(f"and {len(found) - len(kept)} more")][: max(room, 0)]


def _title(status: dict[str, Any]) -> Iterator[str]:
    messages, memory, ros = status["messages"], status["memory"], status["ros"]
    yield (
        f"{status['robot']}  up {timedelta(seconds=status['uptime'])}  "
        f"{status['clients']} clients  {messages['received_a_second']:g}/s in  "
        f"{messages['sent_a_second']:g}/s out  {about_size(memory['process'])}"
    )
    if ros["bus"] == "none":
        yield "ROS off"
    elif ros["state"] == "joined":
        yield (
            f"ROS as {ros['node']}  {ros['nodes_seen']} other nodes  "
            f"{messages['from_ros_a_second']:g}/s from ROS  "
            f"{messages['to_ros_a_second']:g}/s to ROS"
        )
    else:
        yield "ROS is not there"


def _table(rows: list[tuple[str, ...]], width: int | None, widths: Sequence[int]) -> list[Line]:
    """Without rows nothing; in a narrow terminal without the columns that need a wider one."""
    if len(rows) == 1:
        return []
    kept = [i for i, least in enumerate(widths) if width is None or width >= least]
    head, *others = table([[row[i] for i in kept] for row in rows], width)
    return [Line(head, _HEAD), *map(Line, others)]


ROUTE_HEAD: Final = ("ROS", "", "MQTT", "AS", "HZ", "LOSS/S", "LOSS", "MS")
#: The cells of the screen from which on there is each column.
ROUTE_WIDTHS: Final = (0, 20, 60, 80, 0, 30, 40, 70)


def _routes(snapshot: Snapshot, sort: Sort) -> Iterator[tuple[str, ...]]:
    for route in sorted(snapshot.routes, key=lambda route: _order(snapshot, sort, route)):
        latency, lost = route["latency_ms"], snapshot.losses.get(key_of(route), 0.0)
        yield (
            route["ros"],
            ARROWS[route["direction"]],
            route["mqtt"],
            route["encoding"],
            f"{route['rate']:g}",
            f"{lost:.1f}" if lost else "",
            f"{loss_of(route) or ''}",
            f"{latency['p50']:g}/{latency['p99']:g}" if latency else "",
        )


def _order(snapshot: Snapshot, sort: Sort, route: dict[str, Any]) -> tuple[Any, ...]:
    key = key_of(route)
    if sort == "rate":
        return -route["rate"], key
    if sort == "loss":
        return -snapshot.losses.get(key, 0.0), -loss_of(route), key
    return (key,)


CLIENT_HEAD: Final = ("CLIENT", "USER", "ADDRESS", "MQTT", "SUBSCRIBED", "QUEUED", "BYTES")
CLIENT_WIDTHS: Final = (0, 40, 70, 90, 80, 20, 50)


def _clients(snapshot: Snapshot) -> Iterator[tuple[str, ...]]:
    """Those for whom most waits first."""
    for client in sorted(
        snapshot.clients, key=lambda each: (-each["queued_bytes"], -each["queued"], each["client"])
    ):
        yield (
            client["client"],
            "(none)" if client["user"] is None else client["user"],
            client.get("address", ""),
            client.get("mqtt", ""),
            str(client["subscription_count"]),
            f"{client['queued'] or ''}",
            about_size(client["queued_bytes"]) if client["queued_bytes"] else "",
        )
