"""`appliance clients`: who is connected, disconnect one, delete its session."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from appliance.cli.connection import ManagedAppliance, connecting
from appliance.cli.console import print_table

clients_app = typer.Typer(
    help="Clients of the running appliance, here or, with --user and --host, over MQTT."
)

HEAD = ("CLIENT", "USER", "ADDRESS", "TLS", "MQTT", "QUEUED", "SUBSCRIPTIONS")

ClientArgument = Annotated[str, typer.Argument(metavar="ID", help="The client id.")]


@clients_app.callback(invoke_without_command=True)
@connecting
def list_clients(
    options: ManagedAppliance,
    context: typer.Context,
    of: Annotated[str | None, typer.Option(metavar="USER", help="Only this user's.")] = None,
    show_all: Annotated[
        bool, typer.Option("--all", help="Also sessions whose client is not connected.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON per client.")
    ] = False,
) -> None:
    """Clients of the running appliance, here or, with --user and --host, over MQTT.

    Without a command it lists them.
    """
    if context.invoked_subcommand is not None:
        given = [name for name in context.params if _is_typed(context, name)]
        if given:  # they would be lost, and the command be about another appliance
            raise typer.BadParameter(
                f"options are to be put behind the command {context.invoked_subcommand}"
            )
        return
    found = list(_clients(options, {"user": of, "connected": None if show_all else True}))
    if as_json:
        typer.echo("".join(f"{json.dumps(each)}\n" for each in found), nl=False)
    elif found:
        print_table([HEAD, *map(_row, found)])
    else:
        whose = "" if of is None else f" as user {of}"
        typer.echo(f"there is no session{whose}" if show_all else f"nobody is connected{whose}")


@clients_app.command("disconnect", hidden=True)  # as the verb is called
@clients_app.command("kick")
@connecting
def kick(options: ManagedAppliance, client: ClientArgument) -> None:
    """Disconnect a client (0x98); it may come again."""
    answer = options.ask("disconnect", {"client": client})
    typer.echo("disconnected" if answer["disconnected"] else "it is not connected")


@clients_app.command("delete")
@connecting
def delete(options: ManagedAppliance, client: ClientArgument) -> None:
    """Disconnect a client, and delete its session with all that waits for it."""
    options.ask("delete_session", {"client": client})
    typer.echo("deleted")


def _is_typed(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _clients(options: ManagedAppliance, wanted: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All pages."""
    after = None
    while True:
        page = options.ask("clients", {**wanted, "after": after})
        yield from page["clients"]
        after = page["next"]
        if after is None:
            return


def _row(client: dict[str, Any]) -> tuple[str, ...]:
    user = client["user"]
    queued = f"{client['queued']}" if client["queued"] else ""
    return (
        client["client"],
        "(none)" if user is None else user,
        client.get("address", "not connected"),
        client.get("tls") or "",
        client.get("mqtt", ""),
        queued,
        str(client["subscription_count"]),
    )
