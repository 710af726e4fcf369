"""The broker that a command connects to, and the robot that it means: the options that say so."""

from __future__ import annotations

import inspect
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from appliance.cli.console import CommandError, ConfigOption, load, read_password

if TYPE_CHECKING:
    from appliance.cli.mqtt_client import ConnectionSettings

_HERE = "localhost"


@dataclass(frozen=True)
class ConnectionOptions:
    """The options of a command that connects; what none says is the configuration's, if any."""

    host: Annotated[str, typer.Option("--host", "-H", help="The broker's name or address.")] = _HERE
    port: Annotated[
        int | None,
        typer.Option(
            "--port", "-p", min=1, max=65535, help="Else the TLS listener's of the configuration."
        ),
    ] = None
    ca: Annotated[
        Path | None,
        typer.Option("--ca", metavar="FILE", help="The robot's ca.crt; else the configuration's."),
    ] = None
    cert: Annotated[
        Path | None,
        typer.Option(
            "--cert", metavar="FILE", help="A client certificate, with its key in it or in:"
        ),
    ] = None
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="FILE", help="The key of the client certificate."),
    ] = None
    user: Annotated[
        str | None, typer.Option("--user", "-u", envvar="APPLIANCE_USER", help="Who to be.")
    ] = None
    password_file: Annotated[
        str | None,
        typer.Option(
            "--password-file",
            metavar="FILE",
            help="Its first line is the password; else APPLIANCE_PASSWORD; else it is asked for.",
        ),
    ] = None
    client_id: Annotated[
        str, typer.Option("--id", "-i", help="The client id; else a random one.")
    ] = ""
    mqtt_version: Annotated[
        Literal["5", "311"], typer.Option("--mqtt-version", "-V", help="MQTT 5 or 3.1.1.")
    ] = "5"
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure", help="Do not check who the broker is. Never with a real password."
        ),
    ] = False
    config: ConfigOption = None

    def target(self) -> ConnectionSettings:
        """Where to connect and as whom; asks for the password if it has to. Raises CommandError."""
        from paho.mqtt.enums import MQTTProtocolVersion

        from appliance.cli.mqtt_client import ConnectionSettings

        port, ca = self.port, self.ca
        # Of an appliance on this computer the configuration says the rest. Without one it is a
        # client on some other computer: the options say everything.
        is_own = ca is None and (port is None or self.host == _HERE) and _is_configured()
        if self.config or is_own:
            broker = load(self.config).broker
            ports = [listener.bind.port for listener in broker.listeners if listener.is_mqtts]
            port = port or (ports[0] if ports else None)
            ca = ca or broker.tls.ca
        return ConnectionSettings(
            self.host,
            port or 8883,
            ca,
            self.user,
            self._password(),
            self.client_id,
            MQTTProtocolVersion.MQTTv5
            if self.mqtt_version == "5"
            else MQTTProtocolVersion.MQTTv311,
            self.insecure,
            self.cert,
            self.key,
        )

    def _password(self) -> str | None:
        if self.user is None:
            return None
        if self.password_file:
            return read_password(self.password_file)
        if "APPLIANCE_PASSWORD" in os.environ:
            return os.environ["APPLIANCE_PASSWORD"]
        if sys.stdin.isatty():
            password: str = typer.prompt(f"Password of {self.user}", hide_input=True)
            return password
        raise CommandError("no password; use --password-file or APPLIANCE_PASSWORD")


@dataclass(frozen=True)
class CallTarget(ConnectionOptions):
    """The options of a command that is about a robot."""

    robot: Annotated[
        str | None,
        typer.Option(help="The robot, the first level of its topics; else the configuration's."),
    ] = None

    def topic(self, name: str) -> str:
        """Where a service, an action or a node is on MQTT: `/arm/grip` is `r2d2/arm/grip`."""
        if not name.startswith("/"):
            return name
        # Of ROS 1, parameters may be at the top: those of /.
        return f"{self.robot or self._configured()}{name.rstrip('/')}"

    def _configured(self) -> str:
        if self.config is None and not _is_configured():
            raise CommandError(
                "which robot? Say --robot NAME, or give the MQTT topic: r2d2/arm/grip for /arm/grip"
            )
        return load(self.config).robot


def _is_configured() -> bool:
    from appliance.config import SEARCH_PATH

    return any(path.is_file() for path in SEARCH_PATH)


def connecting(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the options that its first argument, a `ConnectionOptions`, is made of."""
    first, *own = inspect.signature(command, eval_str=True).parameters.values()
    options = inspect.signature(first.annotation, eval_str=True).parameters

    def run(**given: Any) -> None:
        connection = first.annotation(**{name: given.pop(name) for name in options})
        command(connection, **given)

    every = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in (*own, *options.values())]
    run.__dict__["__signature__"] = inspect.Signature(every)
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    return run
