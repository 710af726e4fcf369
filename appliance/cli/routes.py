"""`appliance routes`: what is bridged between ROS and MQTT, and what is skipped."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from appliance.cli.console import ConfigOption, ask_running, print_table, warn

ARROWS = {"to_mqtt": "→", "to_ros": "←"}
HEAD = ("ROS", "", "MQTT", "TYPE", "AS")
METRICS = ("HZ", "BYTES", "LOST", "DROPPED", "SLOW", "THROTTLED", "REFUSED", "ERRORS", "MS")

#: Columns where the terminal is too narrow for all: the others are below each line.
SHORT_HEAD = ("ROS", "", "MQTT", "HZ", "BYTES", "MS")

#: Texts of the summary, by the value of `why`.
WHY = {
    "problem": "cannot be set up",
    "absent": "not there",
    "two_types": "of a second type",
    "left_out": "left out",
    "hidden": "hidden",
    "other_type": "of other types",
    "of_every_node": "that every node has",
}

#: Skipped entries that are listed without --all, and the reason that is then only counted.
SHOWN = 20
COUNTED = "of_every_node"


def routes(
    config: ConfigOption = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help="Print a line of JSON per entry; skipped entries only with --all."
        ),
    ] = False,
    show_all: Annotated[
        bool, typer.Option("--all", help=f"List all skipped entries, not only the first {SHOWN}.")
    ] = False,
) -> None:
    """Show what the running appliance bridges between ROS and MQTT, and what it skips and why."""
    bridged, mistake = ask_running(config, "routes")
    skipped, _ = ask_running(config, "skipped")
    warn(mistake)
    if as_json:
        entries = bridged + (skipped if show_all else [])
        typer.echo("".join(f"{json.dumps(entry)}\n" for entry in entries), nl=False)
        return
    if bridged:
        _print_bridged(sorted(bridged, key=lambda entry: (entry["ros"], entry["direction"])))
        _print_errors(bridged)
        if any(entry.get("lost") for entry in bridged):
            from appliance.ros.ros2.fastdds import LOST_IN_ROS

            typer.echo(f"\nLOST: {LOST_IN_ROS}")
    else:
        typer.echo("nothing is bridged now")
    if skipped:
        shown = [entry for entry in skipped if entry["why"] != COUNTED][:SHOWN]
        _print_skipped(skipped, skipped if show_all else shown)


def _print_bridged(bridged: list[dict[str, Any]]) -> None:
    """A line for each or, where the terminal is too narrow, two."""
    from appliance.cli.tables import GAP, fits, table, terminal_width, visible

    width = terminal_width()
    rows = [(*HEAD, *METRICS), *map(_row, bridged)]
    if width is None or fits(rows, width):
        print_table(rows)
        return
    head, *lines = table([SHORT_HEAD, *map(_short_row, bridged)], width)
    typer.echo(head)
    for entry, line in zip(bridged, lines, strict=True):
        typer.echo(line)
        details = [f"{entry['type']} as {entry['encoding']}", *_not_carried(entry)]
        for more in table([("", visible("; ".join(details)))], width - len(GAP)):
            typer.echo(f"{GAP}{more}")


def _short_row(entry: dict[str, Any]) -> tuple[str, ...]:
    row = dict(zip((*HEAD, *METRICS), _row(entry), strict=False))
    texts = (row.get(name, "").replace(" / ", "/") for name in SHORT_HEAD[2:])
    return (row["ROS"], row[""], *texts)


def _not_carried(entry: dict[str, Any]) -> Iterator[str]:
    """The counters that are not 0."""
    row = dict(zip((*HEAD, *METRICS), _row(entry), strict=False))
    for name in METRICS:
        if name not in SHORT_HEAD and row.get(name, "0") != "0":
            yield f"{name.lower()} {row[name]}"


def _row(entry: dict[str, Any]) -> tuple[str, ...]:
    way = entry["direction"]
    about = (entry["ros"], ARROWS.get(way, way), entry["mqtt"], entry["type"], entry["encoding"])
    if way not in ARROWS:  # services, actions and parameters have no metrics
        return about
    latency = entry["latency_ms"]
    counts = (entry[key] for key in ("size", "lost", "dropped", "skipped", "throttled"))
    return (
        *about,
        f"{entry['rate']:g}",
        *map(str, counts),
        str(entry["expired"] + entry["refused"]),
        str(entry["errors"]),
        f"{latency['p50']:g} / {latency['p99']:g}" if latency else "",
    )


def _print_errors(bridged: list[dict[str, Any]]) -> None:
    """The last error of each route."""
    failed = [entry for entry in bridged if entry.get("last_error")]
    for entry in sorted(failed, key=lambda entry: (entry["ros"], entry["direction"])):
        way = ARROWS.get(entry["direction"], entry["direction"])
        print_table([(f"{entry['ros']} {way}", f"last error: {entry['last_error']}")])


def _print_skipped(skipped: list[dict[str, str]], shown: list[dict[str, str]]) -> None:
    counts = Counter(entry["why"] for entry in skipped)
    typer.echo(
        "\nskipped: " + ", ".join(f"{count} {WHY.get(why, why)}" for why, count in counts.items())
    )
    print_table(
        (
            entry["ros"],
            ARROWS.get(entry["direction"], entry["direction"]),
            entry["type"],
            entry["reason"],
        )
        for entry in shown
    )
    if len(shown) < len(skipped):
        typer.echo(f"and {len(skipped) - len(shown)} more: appliance routes --all")
