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


class NotConnectedError(CommandError):
    """Nobody answers there now; later somebody may."""


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
    running = RunningAppliance(config)
    return running.ask(command, arguments or {}), running.mistake


class RunningAppliance:
    """The running appliance of a configuration, asked over its control socket."""

    def __init__(self, config: Path | None) -> None:
        from appliance.config import load_control

        self._broken: CommandError | None = None
        try:
            self._control = load(config).control
        except CommandError as error:
            self._broken, self._control = error, load_control(config).control

    def ask(self, command: str, arguments: Mapping[str, Any]) -> Any:
        """What it answers.

        Raises:
            NotConnectedError: no appliance is running.
            CommandError: it has not answered.
        """
        from appliance.ops.control import ControlError, NotRunningError, ask

        try:
            return ask(self._control, command, arguments=arguments)
        except NotRunningError as error:
            raise NotConnectedError(str(self._broken or error)) from None
        except ControlError as error:
            raise CommandError(str(error)) from None

    @property
    def mistake(self) -> str:
        """What is wrong with the configuration file; empty when nothing is."""
        if self._broken is None:
            return ""
        told = str(self._broken).replace("\n", ": ", 1).replace("\n", "; ")
        return f"what is in force is older than the file: {told}"


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
    if generate:
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
    """Print columns that fit the terminal; nothing is cut off for programs that read them. What
    would control a terminal is escaped."""
    from appliance.cli.tables import table, terminal_width

    for line in table(rows, terminal_width()):
        typer.echo(line)
