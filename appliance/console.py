"""What the commands share: their errors, options that several have, and secrets that are typed."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

if TYPE_CHECKING:
    from appliance.client import Target
    from appliance.config import Settings

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        metavar="FILE",
        help="The configuration; else ./appliance.yaml, else /etc/appliance/appliance.yaml.",
    ),
]
PasswordFileOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="Take the password from this file's first line; - is stdin."),
]
GenerateOption = Annotated[
    bool, typer.Option("--generate", help="Make a random password, and show it once.")
]

# Of the commands that connect to a broker

HostOption = Annotated[str, typer.Option("--host", "-H", help="The broker's name or address.")]
PortOption = Annotated[
    int | None, typer.Option("--port", "-p", help="Else the TLS listener's of the configuration.")
]
CaOption = Annotated[
    Path | None,
    typer.Option("--ca", metavar="FILE", help="The robot's ca.crt; else the configuration's."),
]
CertOption = Annotated[
    Path | None,
    typer.Option("--cert", metavar="FILE", help="A client certificate, with its key in it or in:"),
]
KeyOption = Annotated[
    Path | None, typer.Option("--key", metavar="FILE", help="The key of the client certificate.")
]
UserOption = Annotated[
    str | None, typer.Option("--user", "-u", envvar="APPLIANCE_USER", help="Who to be.")
]
ClientPasswordOption = Annotated[
    str | None,
    typer.Option(
        "--password-file",
        metavar="FILE",
        help="Its first line is the password; else APPLIANCE_PASSWORD; else it is asked for.",
    ),
]
VersionOption = Annotated[
    Literal["5", "311"], typer.Option("--mqtt-version", "-V", help="MQTT 5 or 3.1.1.")
]
InsecureOption = Annotated[
    bool,
    typer.Option("--insecure", help="Do not check who the broker is. Never with a real password."),
]
ClientIdOption = Annotated[
    str, typer.Option("--id", "-i", help="The client id; else a random one.")
]


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
    if generate:
        from appliance.init import generate_password

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
    text = sys.stdin.read() if file == "-" else Path(file).read_text(encoding="utf-8")
    return text.split("\n", 1)[0].rstrip("\r")


def connect_to(
    config: Path | None,
    host: str,
    port: int | None,
    ca: Path | None,
    user: str | None,
    password_file: str | None,
    client_id: str,
    version: Literal["5", "311"],
    insecure: bool,
    cert: Path | None = None,
    key: Path | None = None,
) -> Target:
    """Where to connect and as whom; what no option says is taken from the configuration, if any."""
    from paho.mqtt.enums import MQTTProtocolVersion

    from appliance.client import Target
    from appliance.config import SEARCH_PATH

    # Without a configuration it is a client on some other computer: the options say everything.
    if config or (port is None and ca is None and any(path.is_file() for path in SEARCH_PATH)):
        broker = load(config).broker
        ports = [listener.bind.port for listener in broker.listeners if listener.is_mqtts]
        port = port or (ports[0] if ports else None)
        ca = ca or broker.tls.ca
    if user is None:
        password = None
    elif password_file:
        password = read_password(password_file)
    elif "APPLIANCE_PASSWORD" in os.environ:
        password = os.environ["APPLIANCE_PASSWORD"]
    elif sys.stdin.isatty():
        password = typer.prompt(f"Password of {user}", hide_input=True)
    else:
        raise CommandError("no password; use --password-file or APPLIANCE_PASSWORD")
    protocol = MQTTProtocolVersion.MQTTv5 if version == "5" else MQTTProtocolVersion.MQTTv311
    address = (host, port or 8883)
    return Target(*address, ca, user, password, client_id, protocol, insecure, cert, key)


def shown(path: Path) -> str:
    """The path as a user of this folder would type it."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
