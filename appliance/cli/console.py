"""Shared by the commands: errors, common options, passwords and tables."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from appliance.config import Settings

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE",
        help="The configuration; default: ./appliance.yaml, then that in /etc/appliance.",
    ),
]
PasswordFileOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE", help="Read the password from the first line of this file; - is stdin."
    ),
]
GenerateOption = Annotated[
    bool, typer.Option("--generate", help="Generate a random password, and show it once.")
]


#: Limit on the line that a password is read from; MQTT allows at most 65,535 bytes.
MAX_PASSWORD_LENGTH = 65_536


class CommandError(Exception):
    """Its message is printed as it is; the command ends with exit code 1."""


def load(config: Path | None) -> Settings:
    """The settings. Raises CommandError when they are invalid."""
    from appliance.config import ConfigError
    from appliance.config import load as load_settings

    try:
        return load_settings(config)
    except ConfigError as error:
        raise CommandError(f"the configuration cannot be used\n{error}") from None


def ask_running(
    config: Path | None, command: str, arguments: Mapping[str, Any] | None = None
) -> tuple[Any, str]:
    """What the running appliance answers, and what is wrong with the configuration file: empty when
    nothing is. It goes on with the configuration that it has.

    Raises:
        CommandError: it has not answered.
    """
    from appliance.config import load_control
    from appliance.ops.control import ControlError, NotRunningError, ask

    broken: CommandError | None = None
    try:
        settings = load(config)
    except CommandError as error:
        broken, settings = error, load_control(config)
    try:
        answer = ask(settings.control, command, arguments=arguments)
    except NotRunningError as error:
        raise broken or CommandError(str(error)) from None
    except ControlError as error:
        raise CommandError(str(error)) from None
    if broken is None:
        return answer, ""
    told = str(broken).replace("\n", ": ", 1).replace("\n", "; ")
    return answer, f"what is in force is older than the file: {told}"


def warn(text: str) -> None:
    """Print a warning beside what the command prints; an empty one is none."""
    from appliance.ops.logs import VISIBLE

    if text:
        typer.secho("warning: ", fg="yellow", nl=False, err=True)
        typer.echo(text.translate(VISIBLE), err=True)


def new_password(whose: str, file: str | None, generate: bool) -> str:
    """A new password: generated, read from a file or asked for, never from the command line."""
    if generate and file:
        raise typer.BadParameter("--generate and --password-file exclude each other")
    from appliance.host.owners import acting_as_caller

    if generate:
        with acting_as_caller():  # Python may be in a directory that only root can read
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
            line = opened.readline(MAX_PASSWORD_LENGTH + 1)
    except UnicodeDecodeError:
        raise CommandError(f"{file}: this is no password: it is not UTF-8 text") from None
    if len(line) > MAX_PASSWORD_LENGTH:
        raise CommandError(f"{file}: its first line is too long for a password: is it the file?")
    return line.rstrip("\r\n")


def shown(path: Path) -> str:
    """The path, relative to the current directory if it is inside."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def print_table(rows: Iterable[tuple[str, ...]]) -> None:
    """Print columns as wide as necessary: nothing is cut off for programs that read them."""
    lines = list(rows)
    columns = max(map(len, lines), default=0)
    padded = [(*row, *[""] * (columns - len(row))) for row in lines]
    widths = [max(map(len, column)) for column in zip(*padded, strict=True)]
    for row in padded:
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        typer.echo(line.rstrip())
