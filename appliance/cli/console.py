"""What the commands share: their errors, options that several have, and secrets that are typed."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from appliance.config import Settings

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE",
        help="The configuration; else ./appliance.yaml, else that in /etc/appliance.",
    ),
]
PasswordFileOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Take the password from this file's first line; - is stdin."),
]
GenerateOption = Annotated[
    bool, typer.Option("--generate", help="Make a random password, and show it once.")
]


#: Of the line that a password is read from: in MQTT it has at most 65,535 bytes.
LONGEST_PASSWORD = 65_536


class CommandError(Exception):
    """Told to the user as it is; the command ends with exit code 1."""


def load(config: Path | None) -> Settings:
    """The settings; CommandError when they cannot be used."""
    from appliance.config import ConfigError
    from appliance.config import load as load_settings

    try:
        return load_settings(config)
    except ConfigError as error:
        raise CommandError(f"the configuration cannot be used\n{error}") from None


def new_password(whose: str, file: str | None, generate: bool) -> str:
    """A password that is to be: made, read from a file or asked for, never on the command line."""
    if generate and file:
        raise typer.BadParameter("--generate and --password-file exclude each other")
    from appliance.host.owners import acting_as_caller

    if generate:
        with acting_as_caller():  # Python may be where only root can read
            from appliance.ops.init import generate_password

        return generate_password()
    if file:
        return read_password(file)
    if sys.stdin.isatty():
        prompt = f"Password of {whose}"
        password: str = typer.prompt(prompt, hide_input=True, confirmation_prompt=True)
        return password
    raise CommandError("no terminal to ask on; use --generate or --password-file")


def read_password(file: str) -> str:
    """The first line of the file; - is standard input."""
    from appliance.host.owners import acting_as_caller

    try:
        with (
            acting_as_caller(),
            nullcontext(sys.stdin) if file == "-" else Path(file).open(encoding="utf-8") as opened,
        ):
            line = opened.readline(LONGEST_PASSWORD + 1)
    except UnicodeDecodeError:
        raise CommandError(f"{file}: this is no password: it is not UTF-8 text") from None
    if len(line) > LONGEST_PASSWORD:
        raise CommandError(f"{file}: its first line is too long for a password: is it the file?")
    return line.rstrip("\r\n")


def shown(path: Path) -> str:
    """The path as a user of this folder would type it."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def print_table(rows: Iterable[tuple[str, ...]]) -> None:
    """In columns as wide as they have to be: a program that reads them misses nothing."""
    lines = list(rows)
    columns = max(map(len, lines), default=0)
    padded = [(*row, *[""] * (columns - len(row))) for row in lines]
    widths = [max(map(len, column)) for column in zip(*padded, strict=True)]
    for row in padded:
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        typer.echo(line.rstrip())
