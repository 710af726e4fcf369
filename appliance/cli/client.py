"""The commands `appliance pub` and `appliance sub`."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from appliance.cli.connection import ConnectionOptions, connecting
from appliance.cli.console import CommandError

if TYPE_CHECKING:
    from appliance.cli.mqtt_client import RefusedError

_EXPLAINED = "On the robot, `appliance acl explain USER TOPIC` says which rule decides it."


def _explained(error: RefusedError, user: str | None) -> CommandError:
    """The refusal with the lines that would allow it or, where these are unknown, who tells."""
    from appliance.cli.mqtt_client import lines_needed

    advice = lines_needed(user, error.lines) if error.lines else _EXPLAINED
    return CommandError(str(error.advised(advice)))


def _say_silent() -> None:
    typer.secho(
        "nothing came yet; on the robot, `appliance routes` shows what is bridged, and to which "
        "topics; `appliance sub -v '#'` prints all that this user may read",
        fg="yellow",
        err=True,
    )


@connecting
def pub(
    connection: ConnectionOptions,
    topic: str,
    message: Annotated[
        str | None, typer.Option("--message", "-m", help="The payload; default: standard input.")
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option("--file", "-f", metavar="FILE", help="Read the payload from this file."),
    ] = None,
    lines: Annotated[
        bool,
        typer.Option("--lines", "-l", help="Publish each line of standard input as a message."),
    ] = False,
    repeat: Annotated[
        int, typer.Option(min=1, help="Publish it so many times, as a client that drives does.")
    ] = 1,
    repeat_delay: Annotated[float, typer.Option(min=0, help="Seconds between two of them.")] = 0.0,
    qos: Annotated[
        int, typer.Option("--qos", "-q", min=0, max=2, help="With 1 and 2 a refusal is reported.")
    ] = 1,
    retain: Annotated[
        bool, typer.Option("--retain", "-r", help="Let the broker retain the message.")
    ] = False,
) -> None:
    """Publish a message."""
    if (message is not None) + (file is not None) + lines > 1:
        raise typer.BadParameter("--message, --file and --lines exclude each other")
    payloads: Iterable[bytes]
    if lines:
        payloads = (line.rstrip(b"\r\n") for line in sys.stdin.buffer)
    elif file is not None:
        payloads = [file.read_bytes()]
    else:
        payloads = [sys.stdin.buffer.read() if message is None else message.encode()]
    if repeat > 1:
        if lines:
            raise typer.BadParameter("--lines and --repeat exclude each other")
        payloads = [*payloads] * repeat
    from appliance.cli import mqtt_client as client

    try:
        client.publish(connection.target(), topic, payloads, qos, retain, delay=repeat_delay)
    except client.RefusedError as error:
        raise _explained(error, connection.user) from None
    except client.ClientError as error:
        raise CommandError(str(error)) from None


@connecting
def sub(
    connection: ConnectionOptions,
    filters: Annotated[list[str], typer.Argument(metavar="FILTER...")],
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print the topic before each payload.")
    ] = False,
    count: Annotated[
        int | None, typer.Option("--count", "-C", min=1, help="End after so many messages.")
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(
            "--timeout",
            "-W",
            min=0,
            help="End after so many seconds; exit code 1 if messages are missing.",
        ),
    ] = None,
    qos: Annotated[int, typer.Option("--qos", "-q", min=0, max=2)] = 0,
    rate: Annotated[
        bool,
        typer.Option(
            "--rate", help="Print before each payload when it came, and the rate of its topic."
        ),
    ] = False,
) -> None:
    """Subscribe, and print received messages, one per line."""
    from appliance.cli import mqtt_client as client

    try:
        received = client.subscribe(
            connection.target(),
            filters,
            qos,
            sys.stdout.buffer,
            verbose=verbose,
            rate=rate,
            count=count,
            timeout=timeout,
            on_silence=_say_silent if sys.stderr.isatty() else None,
        )
    except client.RefusedError as error:
        raise _explained(error, connection.user) from None
    except client.ClientError as error:
        raise CommandError(str(error)) from None
    if count is not None and received < count:
        raise CommandError(f"{received} of {count} messages came within {timeout:g} s")
