"""The command `appliance import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from appliance.cli.console import CommandError, shown

if TYPE_CHECKING:
    from appliance.importing import Imported


# Nobody reads more: with a password file of thousands of users it may be one line for each.
_MAX_LINES = 500


def import_mosquitto(
    file: Annotated[
        Path, typer.Argument(metavar="MOSQUITTO_CONF", help="mosquitto's configuration file.")
    ],
    directory: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="The directory for all files.")
    ] = Path(),
    robot: Annotated[
        str | None, typer.Option(help="The robot's name; default: this computer's name.")
    ] = None,
) -> None:
    """Make appliance.yaml, users and access rules of mosquitto's configuration.

    No file is replaced. What has no counterpart here is listed, with its
    line and what to do.
    """
    import socket

    from appliance.config import ConfigError
    from appliance.host.owners import OwnerError, acting_for
    from appliance.importing import ImportProblemsError
    from appliance.importing import import_mosquitto as convert
    from appliance.ops.init import robot_name

    name = robot_name(robot or socket.gethostname().partition(".")[0])
    try:
        imported = convert(file, name)
        with acting_for(directory / "appliance.yaml"):
            _write(imported, directory)
    except ImportProblemsError as error:
        raise CommandError(f"nothing is imported\n{error}") from None
    except ConfigError as error:
        text = "nothing is imported: the appliance would not start with what it makes of it"
        raise CommandError(f"{text}\n{error}") from None
    except OwnerError as error:
        raise CommandError(str(error)) from None
    _report(imported, directory)


def _write(imported: Imported, directory: Path) -> None:
    """Write all files, or none of them where one is there or the settings would not be valid."""
    from appliance.config import loads
    from appliance.ops.init import write_new

    for file in imported.files:
        if (directory / file.name).exists():
            raise CommandError(
                f"{shown(directory / file.name)} is there already, and no file is replaced: name "
                "another directory with --dir"
            )
    settings = imported.files[-1]
    loads(settings.text, directory / settings.name)
    directory.mkdir(parents=True, exist_ok=True)
    for file in imported.files:
        path = directory / file.name
        if not write_new(path, file.text, mode=0o600 if file.is_secret else 0o644):
            raise CommandError(f"{shown(path)} was made by another program meanwhile")
        typer.echo(f"made  {shown(path)}: {file.what}")


def _report(imported: Imported, directory: Path) -> None:
    from appliance.ops.logs import VISIBLE

    to_do = [str(note) for note in imported.notes if note.to_do]
    different = [str(note) for note in imported.notes if not note.to_do]
    for title, lines in (("To be done:", to_do), ("Different here:", different)):
        if lines:
            typer.secho(f"\n{title}", bold=True)
        for line in lines[:_MAX_LINES]:
            typer.echo(line.translate(VISIBLE))
        if len(lines) > _MAX_LINES:
            typer.echo(f"and {len(lines) - _MAX_LINES} more")
    typer.echo(
        f"\nOf {imported.options} options {imported.carried} are carried over without a change.\n"
        f"Next: appliance check -c {shown(directory / 'appliance.yaml')}"
    )
