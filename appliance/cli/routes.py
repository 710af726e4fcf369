"""`appliance routes`: what is carried between ROS and MQTT, and what is not."""

from __future__ import annotations

import json
from collections import Counter
from typing import Annotated, Any

import typer

from appliance.cli.console import CommandError, ConfigOption, load, print_table

ARROWS = {"to_mqtt": "→", "to_ros": "←"}
HEAD = ("ROS", "", "MQTT", "TYPE", "AS")
FIGURES = ("HZ", "BYTES", "LOST", "DROPPED", "SLOW", "THROTTLED", "REFUSED", "ERRORS", "MS")

#: In the summary, by what `why` says.
WHY = {
    "problem": "cannot be set up",
    "absent": "not there",
    "two_types": "of a second type",
    "left_out": "left out",
    "hidden": "hidden",
    "other_type": "of other types",
    "of_every_node": "that every node has",
}

#: Lines of what is skipped, unless all are asked for; and what is then only counted.
SHOWN = 20
COUNTED = "of_every_node"


def routes(
    config: ConfigOption = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="A line of JSON an entry; of what is skipped only with --all."),
    ] = False,
    show_all: Annotated[
        bool, typer.Option("--all", help=f"All that is skipped, not the first {SHOWN} only.")
    ] = False,
) -> None:
    """Show what the running appliance carries between ROS and MQTT, and what not and why."""
    settings = load(config)
    from appliance.ops.control import ControlError, ask

    try:
        bridged = ask(settings.control, "routes")
        skipped = ask(settings.control, "skipped")
    except ControlError as error:
        raise CommandError(str(error)) from None
    if as_json:
        entries = bridged + (skipped if show_all else [])
        typer.echo("".join(f"{json.dumps(entry)}\n" for entry in entries), nl=False)
        return
    if bridged:
        rows = map(_row, sorted(bridged, key=lambda entry: (entry["ros"], entry["direction"])))
        print_table([(*HEAD, *FIGURES), *rows])
        _print_errors(bridged)
        if any(entry.get("lost") for entry in bridged):
            from appliance.ros.ros2.fastdds import LOST_IN_ROS

            typer.echo(f"\nLOST: {LOST_IN_ROS}")
    else:
        typer.echo("nothing is bridged now")
    if skipped:
        shown = [entry for entry in skipped if entry["why"] != COUNTED][:SHOWN]
        _print_skipped(skipped, skipped if show_all else shown)


def _row(entry: dict[str, Any]) -> tuple[str, ...]:
    way = entry["direction"]
    about = (entry["ros"], ARROWS.get(way, way), entry["mqtt"], entry["type"], entry["encoding"])
    if way not in ARROWS:  # services, actions and parameters have no figures
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
    """What was wrong with the last message of each route that was not carried."""
    told = [entry for entry in bridged if entry.get("last_error")]
    for entry in sorted(told, key=lambda entry: (entry["ros"], entry["direction"])):
        way = ARROWS.get(entry["direction"], entry["direction"])
        typer.echo(f"{entry['ros']} {way}  last error: {entry['last_error']}")


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
