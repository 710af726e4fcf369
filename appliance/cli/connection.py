"""Options of commands that connect to a broker, or that call a robot."""

from __future__ import annotations

import inspect
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from appliance.cli.console import (
    CommandError,
    ConfigOption,
    NotConnectedError,
    RunningAppliance,
    ask_running,
    load,
    read_password,
    warn,
)

if TYPE_CHECKING:
    from appliance.cli.mqtt_client import ConnectionSettings

#: Asks a verb with its arguments.
Ask: TypeAlias = Callable[[str, Mapping[str, Any]], Any]

_HERE = "localhost"

#: Seconds to wait for an answer of the appliance itself over MQTT.
_ANSWER_TIMEOUT = 30.0


@dataclass(frozen=True)
class ConnectionOptions:
    """Options of a command that connects; the configuration has the defaults, if there is one."""

    host: Annotated[str, typer.Option("--host", "-H", help="The broker's name or address.")] = _HERE
    port: Annotated[
        int | None,
        typer.Option(
            "--port", "-p", min=1, max=65535, help="Default: the TLS listener of the configuration."
        ),
    ] = None
    ca: Annotated[
        Path | None,
        typer.Option(
            "--ca", metavar="FILE", help="The robot's ca.crt; default: from the configuration."
        ),
    ] = None
    cert: Annotated[
        Path | None,
        typer.Option(
            "--cert",
            metavar="FILE",
            help="A client certificate; its key is in the same file or in --key.",
        ),
    ] = None
    key: Annotated[
        Path | None,
        typer.Option("--key", metavar="FILE", help="The key of the client certificate."),
    ] = None
    user: Annotated[
        str | None, typer.Option("--user", "-u", envvar="APPLIANCE_USER", help="The user name.")
    ] = None
    password_file: Annotated[
        str | None,
        typer.Option(
            "--password-file",
            metavar="FILE",
            help="File whose first line is the password; default: APPLIANCE_PASSWORD, or a prompt.",
        ),
    ] = None
    client_id: Annotated[
        str, typer.Option("--id", "-i", help="The client id; default: a random one.")
    ] = ""
    mqtt_version: Annotated[
        Literal["5", "311"], typer.Option("--mqtt-version", "-V", help="MQTT 5 or 3.1.1.")
    ] = "5"
    insecure: Annotated[
        bool,
        typer.Option(
            "--insecure", help="Do not verify the broker's certificate. Never with a real password."
        ),
    ] = False
    config: ConfigOption = None

    def target(self) -> ConnectionSettings:
        """The connection settings; asks for the password if necessary. Raises CommandError."""
        from paho.mqtt.enums import MQTTProtocolVersion

        from appliance.cli.mqtt_client import ConnectionSettings

        port, ca = self.port, self.ca
        # The configuration of an appliance on this computer has the defaults. Without one this is
        # a client on another computer, and only the options count.
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
    """Options of a command that calls a robot."""

    robot: Annotated[
        str | None,
        typer.Option(
            help="The robot, the first level of its topics; default: from the configuration. "
            "Through a fleet's broker with what stands before it there: fleet/r2d2."
        ),
    ] = None

    def topic(self, name: str) -> str:
        """The MQTT topic of a service, an action or a node: `/arm/grip` is `r2d2/arm/grip`."""
        if not name.startswith("/"):
            return name
        # In ROS 1, parameters may be at the top level: those of /.
        return f"{self.robot or self._configured()}{name.rstrip('/')}"

    def _configured(self) -> str:
        if self.config is None and not _is_configured():
            raise CommandError(
                "which robot? Say --robot NAME, or give the MQTT topic: r2d2/arm/grip for /arm/grip"
            )
        return load(self.config).robot


@dataclass(frozen=True)
class ManagedAppliance(ConnectionOptions):
    """The appliance that is asked: the one of the configuration over its control socket, or one
    over MQTT where an option says who logs in or where."""

    @property
    def is_remote(self) -> bool:
        """Whether it is asked over MQTT."""
        is_login = self.user is not None or self.cert is not None
        return is_login or self.port is not None or self.host != _HERE

    @cached_property
    def _settings(self) -> ConnectionSettings:
        return self.target()  # it may ask for the password: once

    def prepare(self) -> None:
        """Read or ask for all that a connection needs. Raises CommandError."""
        if self.is_remote:
            _ = self._settings

    def ask(self, verb: str, arguments: Mapping[str, Any]) -> Any:
        """What it answers. Raises CommandError."""
        if self.is_remote:
            with self.asking() as ask:
                return ask(verb, arguments)
        answer, mistake = ask_running(self.config, verb, arguments)
        warn(mistake)
        return answer

    @contextmanager
    def asking(self) -> Iterator[Ask]:
        """What asks it, as `ask` does, again and again and over one connection.

        Raises NotConnectedError, as what it yields does when this connection is of no more use.
        """
        if not self.is_remote:
            yield RunningAppliance(self.config).ask
            return
        from appliance.cli.mqtt_client import ClientError, RefusedError
        from appliance.cli.rpc_client import CallFailedError, RpcClient
        from appliance.management.topics import topic_of

        def ask(verb: str, arguments: Mapping[str, Any]) -> Any:
            payload = json.dumps(arguments).encode()
            try:
                return json.loads(client.call(topic_of(verb), payload, _ANSWER_TIMEOUT))
            except (CallFailedError, RefusedError) as error:
                raise CommandError(str(error)) from None
            except ClientError as error:
                raise NotConnectedError(str(error)) from None

        try:
            client = RpcClient(self._settings)
        except ClientError as error:
            raise NotConnectedError(str(error)) from None
        try:
            yield ask
        finally:
            client.close()


def _is_configured() -> bool:
    from appliance.config import SEARCH_PATH

    return any(path.is_file() for path in SEARCH_PATH)


def connecting(command: Callable[..., None]) -> Callable[..., None]:
    """Replace the first argument, a `ConnectionOptions`, by the options that it consists of."""
    first, *own = inspect.signature(command, eval_str=True).parameters.values()
    options = inspect.signature(first.annotation, eval_str=True).parameters

    def run(**given: Any) -> None:
        connection = first.annotation(**{name: given.pop(name) for name in options})
        command(connection, **given)

    every = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in (*own, *options.values())]
    run.__dict__["__signature__"] = inspect.Signature(every)
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    return run
