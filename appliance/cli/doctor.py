"""The command `appliance doctor`: prints findings, one per line, as text or JSON."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict
from typing import Annotated

import typer

from appliance.cli.console import ConfigOption

_COLOURS = {"ok": "green", "warning": "yellow", "problem": "red"}

#: The word that this command prints for each level of a finding.
_WORDS = {"ok": "ok", "warning": "warning", "error": "problem"}


def doctor(
    config: ConfigOption = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON per finding.")
    ] = False,
) -> None:
    """Check all that the appliance needs, without changing anything, and advise.

    Checks ports, clock, certificates, disk, permissions, memory and ROS. The
    exit code is 1 when there is a problem.
    """
    from appliance.ops.doctor.examination import examine

    counts: Counter[str] = Counter()
    for finding in examine(config):
        level = _WORDS[finding.level]
        counts[level] += 1
        if as_json:
            typer.echo(json.dumps({**asdict(finding), "level": level}, ensure_ascii=False))
            continue
        typer.secho(f"{level:<8}", fg=_COLOURS[level], nl=False)
        typer.echo(f"{finding.subject}: {finding.text}")
        if finding.advice:
            typer.echo(f"{'':8}what to do: {finding.advice}")
    if not as_json:
        typer.echo(f"\nproblems: {counts['problem']}, warnings: {counts['warning']}")
    raise typer.Exit(1 if counts["problem"] else 0)
