"""`appliance upstream`: the links to fleets' brokers, and what waits for them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Final

import typer

from appliance.cli.console import ConfigOption, ask_running, print_table, warn

HEAD = (
    "NAME",
    "SERVER",
    "STATE",
    "OUT",
    "IN",
    "WAITING",
    "BYTES",
    "OLDEST",
    "DROPPED",
    "ASIDE",
    "MS",
)

#: So many columns stay in a line where the terminal is too narrow for all.
SHORT: Final = 3

#: Of messages of which only the latest of a topic counts: the older ones are not lost.
REPLACED: Final = "replaced"


def upstream(
    config: ConfigOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the links to fleets' brokers: whether they are connected, and what waits for them.

    The exit code is 1 when one is not connected, or no appliance is running.
    """
    from appliance.ops.logs import VISIBLE, json_text

    links: list[dict[str, Any]]
    links, mistake = ask_running(config, "upstream")
    warn(mistake)
    code = 0 if all(link["connected"] for link in links) else 1
    if as_json:
        typer.echo(json_text(links, indent=2))
        raise typer.Exit(code)
    if not links:
        typer.echo("there is no link to a fleet's broker (upstreams in appliance.yaml)")
        return
    _print_links(links)
    for number, (name, is_warning, text) in enumerate(details(links)):
        if not number:
            typer.echo()
        typer.secho(f"{name}: ", fg="yellow" if is_warning else None, nl=False)
        typer.echo(text.translate(VISIBLE))
    raise typer.Exit(code)


def _print_links(links: list[dict[str, Any]]) -> None:
    """A line for each or, where the terminal is too narrow, two: the other columns below it."""
    from appliance.cli.tables import GAP, fits, table, terminal_width

    width = terminal_width()
    rows = [_row(link) for link in links]
    if width is None or fits([HEAD, *rows], width):
        print_table([HEAD, *rows])
        return
    head, *lines = table([HEAD[:SHORT], *(row[:SHORT] for row in rows)], width)
    typer.echo(head)
    for row, line in zip(rows, lines, strict=True):
        typer.echo(line)
        counts = zip(HEAD[SHORT:], row[SHORT:], strict=True)
        told = "; ".join(f"{name.lower()} {value}" for name, value in counts)
        for more in table([("", told)], width - len(GAP)):
            typer.echo(f"{GAP}{more}")


def details(links: list[dict[str, Any]]) -> Iterator[tuple[str, bool, str]]:
    """What a person should know of the links: the name of one, whether it is a warning, the text.

    The fleet's broker says a part of it: the caller makes control characters visible.
    """
    from appliance.config import format_duration
    from appliance.upstream.status import warnings_of

    for link in links:
        name = link["name"]
        for text in warnings_of(link):
            yield name, True, text
        if link["came"]:
            came = ", ".join(f"{count} of {rule}" for rule, count in link["came"].items())
            yield name, False, f"came from there: {came}"
        for rule, reasons in link["dropped"].items():
            lost = [f"{count} {reason}" for reason, count in reasons.items() if reason != REPLACED]
            if lost:
                yield name, False, f"dropped of {rule}: {', '.join(lost)}"
        for each in link["aside"]:
            ago = format_duration(max(1, round(each["age"])))
            yield name, False, f"set aside {ago} ago, {each['topic']}: {each['reason']}"


def _row(link: dict[str, Any]) -> tuple[str, ...]:
    from appliance.config import about_size

    dropped = sum(
        count
        for reasons in link["dropped"].values()
        for reason, count in reasons.items()
        if reason != REPLACED
    )
    trip = link["round_trip"]
    return (
        link["name"],
        link["server"],
        "connected" if link["connected"] else "not connected",
        str(link["sent"]),
        str(link["received"]),
        str(link["waiting"]),
        about_size(link["waiting_bytes"]),
        "-" if link["oldest"] is None else f"{link['oldest']:.0f} s",
        str(dropped),
        str(link["set_aside"]),
        "-" if trip is None else f"{trip * 1000:.0f}",
    )
