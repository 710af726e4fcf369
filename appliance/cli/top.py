"""`appliance top`: routes, clients and warnings of the running appliance, once a second."""

from __future__ import annotations

import os
import sys
from typing import Annotated, Literal

import typer

from appliance.cli.connection import ManagedAppliance, connecting
from appliance.cli.console import CommandError


@connecting
def top(
    options: ManagedAppliance,
    sort: Annotated[
        Literal["rate", "loss", "name"], typer.Option(help="Which routes are first.")
    ] = "rate",
    once: Annotated[
        bool, typer.Option("--once", help="Print it once, complete and without a terminal.")
    ] = False,
) -> None:
    """Watch routes, clients and warnings, here or, with --user and --host, over MQTT.

    Keys: r, l and n sort the routes by rate, loss and name; q quits.
    """
    from appliance.cli import top_screen as screen
    from appliance.cli.top_view import lines

    is_screen = sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    if not once and not is_screen:
        raise CommandError("standard output is no terminal; `appliance top --once` needs none")
    options.prepare()
    watch = screen.Watch(options)
    watch.look()  # nobody there, or no right: said before the screen is cleared
    if once:
        for line in lines(watch.snapshot, sort, None, None):
            typer.echo(line.text)
        return
    with watch.going_on(), screen.keyboard():
        screen.show(watch, sort)
