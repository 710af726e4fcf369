"""The command `appliance store`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from appliance.cli.console import CommandError, ConfigOption, load, print_table, shown

HEAD = ("CLIENT ID", "USER", "SUBSCRIPTIONS", "MESSAGES", "BYTES", "OLDEST", "ENDS")

UPSTREAM_HEAD = ("UPSTREAM", "LANE", "MESSAGES", "BYTES", "OLDEST")

store_app = typer.Typer(help="Sessions and messages that outlive a restart.")


@store_app.callback(invoke_without_command=True)
def store_show(context: typer.Context, config: ConfigOption = None) -> None:
    """Show what outlives a restart: sessions, their queued messages, retained messages, and what
    waits for upstreams."""
    if context.invoked_subcommand is not None:
        return
    path, _ = _store_path(config)
    from datetime import datetime

    from appliance.config import format_size
    from appliance.store import StoreError
    from appliance.store.inspection import summarise

    try:
        summary = summarise(path)
    except StoreError as error:
        raise CommandError(str(error)) from None

    def when(moment: float | None) -> str:
        return "" if moment is None else f"{datetime.fromtimestamp(moment):%Y-%m-%d %H:%M:%S}"

    rows = [
        (
            repr(session.client_id),
            "" if session.username is None else repr(session.username),
            str(session.subscriptions),
            str(session.messages),
            str(session.size),
            when(session.oldest),
            when(session.ends_at) or "connected",
        )
        for session in summary.sessions
    ]
    if rows:
        print_table([HEAD, *rows])
        typer.echo()
    waiting = [
        (each.link, str(each.lane), str(each.messages), str(each.size), when(each.oldest))
        for each in summary.backlogs
    ]
    if waiting:
        print_table([UPSTREAM_HEAD, *waiting])
        typer.echo()
    kept = sum(each.messages for each in summary.backlogs)
    upstream = f", beside {kept} for upstreams" if kept else ""
    typer.echo(
        f"{len(summary.sessions)} sessions, {summary.retained} retained messages of "
        f"{summary.retained_size} bytes; all {summary.messages} messages have "
        f"{summary.payload_size} bytes{upstream}, "
        f"{shown(path)} has {format_size(summary.file_size)}"
    )


@store_app.command("export")
def store_export(config: ConfigOption = None) -> None:
    """Print all of it as JSON, one session, retained message or upstream per line."""
    path, _ = _store_path(config)
    from appliance.ops.logs import json_text
    from appliance.store import StoreError
    from appliance.store.inspection import export

    try:
        for entry in export(path):
            typer.echo(json_text(entry))
    except StoreError as error:
        raise CommandError(str(error)) from None


@store_app.command("prune")
def store_prune(
    older_than: Annotated[
        str | None,
        typer.Option(metavar="DURATION", help="Delete messages queued for longer, such as 7 d."),
    ] = None,
    client: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ID", help="Only of this client; alone: its whole session. Repeatable."
        ),
    ] = None,
    retained: Annotated[
        list[str] | None,
        typer.Option(metavar="FILTER", help="Retained messages: r2d2/old, or r2d2/#. Repeatable."),
    ] = None,
    upstream: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="All that waits for this upstream. Repeatable."),
    ] = None,
    config: ConfigOption = None,
) -> None:
    """Delete sessions, messages queued for too long, retained messages, or what waits for an
    upstream, while the appliance is stopped.

    The appliance itself deletes retained messages of removed routes.
    """
    if older_than is None and not client and not retained and not upstream:
        text = "say what: --older-than, --client, both, --retained, or --upstream"
        raise typer.BadParameter(text)
    path, file = _store_path(config)
    import sqlite3

    from appliance.config import parse_duration
    from appliance.host.owners import OwnerError, acting_for
    from appliance.store import StoreError
    from appliance.store.inspection import prune, prune_retained, prune_upstream

    try:
        age = None if older_than is None else parse_duration(older_than)
    except ValueError as error:
        raise typer.BadParameter(f"--older-than {error}") from None
    try:
        with acting_for(file, path):
            if retained:
                count = prune_retained(path, retained)
                typer.echo(f"{count} retained messages deleted")
            for link in upstream or []:
                count = prune_upstream(path, link)
                typer.echo(f"{count} messages for {link} deleted")
            if age is not None or client:
                sessions, messages = prune(path, age, client or [])
                typer.echo(f"{sessions} sessions and {messages} messages deleted")
    except ValueError as error:
        raise typer.BadParameter(f"--retained {error}") from None
    except (OwnerError, StoreError, sqlite3.Error) as error:
        raise CommandError(str(error)) from None


def _store_path(config: Path | None) -> tuple[Path, Path | None]:
    """The database, and the configuration file that names it."""
    settings = load(config)
    store = settings.broker.store
    if store.durability == "off":
        raise CommandError("nothing is stored: broker.store.durability is off")
    return store.path, settings.file
