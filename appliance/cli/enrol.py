"""`appliance user enrol`: a QR code with which a phone sets its user's password."""

from __future__ import annotations

import socket
import sys
from typing import Annotated

import typer

from appliance.cli.connection import ManagedAppliance, connecting
from appliance.cli.console import CommandError, load

#: Where the console is, unless the configuration says otherwise.
_PORT = 8443


@connecting
def user_enrol(
    options: ManagedAppliance,
    name: str,
    new: Annotated[
        bool, typer.Option("--new", help="The user is made when the code is used.")
    ] = False,
    group: Annotated[
        list[str] | None, typer.Option(metavar="GROUP", help="A group of the new user; repeatable.")
    ] = None,
    certificate: Annotated[
        bool,
        typer.Option("--certificate", help="The phone gets a certificate too, as a .p12 file."),
    ] = False,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="The console as the phone reaches it; default: https, this computer's address and "
            "the port of the listener for the web.",
        ),
    ] = None,
) -> None:
    """Show a QR code with which a phone sets the password of its user, once, within 10 minutes.

    Of the running appliance, here or, with --user and --host, over MQTT.
    """
    if group and not new:
        raise typer.BadParameter("--group is for a --new user")
    arguments: dict[str, object] = {"user": name, "origin": origin or _origin(options)}
    if new:
        arguments["groups"] = group or []
    if certificate:
        arguments["certificate"] = True
    answer = options.ask("enrol", arguments)
    import segno

    segno.make(answer["url"], micro=False).terminal(sys.stdout, compact=True)
    typer.echo(answer["url"])
    typer.echo(f"Once, within {answer['seconds'] // 60} minutes; whoever has it sets the password.")


def _origin(options: ManagedAppliance) -> str:
    if options.is_remote:
        return f"https://{options.host}:{_PORT}"
    from appliance.host.addresses import own_address

    listeners = load(options.config).broker.listeners
    ports = [each.bind.port for each in listeners if each.is_web_over_tls]
    if not ports or not ports[0]:
        raise CommandError("where is the console? Say --origin https://NAME:PORT")
    return f"https://{own_address() or socket.gethostname()}:{ports[0]}"
