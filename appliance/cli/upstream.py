"""`appliance upstream`: the links to fleets' brokers, and what waits for them."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from appliance.cli.console import CommandError, ConfigOption, load, print_table

HEAD = ("NAME", "SERVER", "STATE", "WAITING", "BYTES", "OLDEST", "DROPPED", "ASIDE", "MS")


def upstream(
    config: ConfigOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the links to fleets' brokers: whether they are connected, and what waits for them."""
    settings = load(config)
    from appliance.ops.control import ControlError, ask
    from appliance.ops.logs import VISIBLE, json_text

    try:
        links: list[dict[str, Any]] = ask(settings.control, "upstream")
    except ControlError as error:
        raise CommandError(str(error)) from None
    if as_json:
        typer.echo(json_text(links, indent=2))
        return
    if not links:
        typer.echo("there is no link to a fleet's broker (upstreams in appliance.yaml)")
        return
    from appliance.upstream.status import warnings_of

    print_table([HEAD, *map(_row, links)])
    for link in links:
        for text in warnings_of(link):
            typer.secho(f"\n{link['name']}: ", fg="yellow", nl=False)
            typer.echo(text.translate(VISIBLE), nl=False)
        for rule, reasons in link["dropped"].items():
            counts = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
            typer.echo(
                f"\n{link['name']}: dropped of {rule}: {counts}".translate(VISIBLE), nl=False
            )
        for each in link["aside"]:
            text = f"\n{link['name']}: set aside, {each['topic']}: {each['reason']}"
            typer.echo(text.translate(VISIBLE), nl=False)
    typer.echo()


def _row(link: dict[str, Any]) -> tuple[str, ...]:
    from appliance.config import about_size

    dropped = sum(sum(reasons.values()) for reasons in link["dropped"].values())
    trip = link["round_trip"]
    return (
        link["name"],
        link["server"],
        "connected" if link["connected"] else "not connected",
        str(link["waiting"]),
        about_size(link["waiting_bytes"]),
        "-" if link["oldest"] is None else f"{link['oldest']:.0f} s",
        str(dropped),
        str(link["set_aside"]),
        "-" if trip is None else f"{trip * 1000:.0f}",
    )
