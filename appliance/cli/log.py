"""`appliance log`: the last lines of the running appliance's log, and of its audit log."""

from __future__ import annotations

import json
from typing import Annotated, Final

import typer

from appliance.cli.connection import ManagedAppliance, connecting

#: The most lines that the verbs answer with.
_MOST: Final = 1000


@connecting
def log(
    options: ManagedAppliance,
    lines: Annotated[
        int, typer.Option("--lines", "-n", min=1, max=_MOST, help="How many, the newest.")
    ] = 100,
    audit: Annotated[
        bool, typer.Option("--audit", help="The audit log, a line of JSON for each event.")
    ] = False,
) -> None:
    """Print the last lines of the running appliance's log, here or, with --user and --host, over
    MQTT."""
    from appliance.ops.logs import VISIBLE_IN_LINES

    answer = options.ask("audit" if audit else "log", {"lines": lines})
    found = map(json.dumps, answer["entries"]) if audit else answer["lines"]
    for line in found:
        typer.echo(line.translate(VISIBLE_IN_LINES))
