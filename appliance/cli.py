"""The command `appliance`.

Imports are inside the commands, so that `--help` and `pub` do not wait for what they do not use.
Exit codes: 0 done, 1 refused or failed (the reason is on standard error), 2 wrong usage.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer

from appliance.call_command import call, goal, param_app
from appliance.cert_command import cert_app
from appliance.console import (
    CaOption,
    CertOption,
    ClientIdOption,
    ClientPasswordOption,
    CommandError,
    ConfigOption,
    GenerateOption,
    HostOption,
    InsecureOption,
    KeyOption,
    PasswordFileOption,
    PortOption,
    UserOption,
    VersionOption,
    connect_to,
    new_password,
)
from appliance.console import load as _load
from appliance.console import shown as _shown
from appliance.doctor.command import doctor
from appliance.install_command import install, uninstall
from appliance.routes_command import routes
from appliance.status_command import status

if TYPE_CHECKING:
    from appliance.access import Passwords
    from appliance.config import Settings

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="The robot's MQTT broker, with the bridge to ROS inside it.",
)
user_app = typer.Typer(no_args_is_help=True, help="Who may come in.")
acl_app = typer.Typer(no_args_is_help=True, help="Who may read and write what.")
store_app = typer.Typer(help="What outlives a restart.")
app.add_typer(store_app, name="store")
app.add_typer(user_app, name="user")
app.add_typer(acl_app, name="acl")
app.add_typer(cert_app, name="cert")
app.command()(status)
app.command()(doctor)
app.add_typer(param_app, name="param")


def main(arguments: list[str] | None = None) -> NoReturn:
    """Runs the command and exits with its code; what a user can mend is told in plain words."""
    given = sys.argv[1:] if arguments is None else arguments
    given, ros_arguments = _split_ros_arguments(given)
    try:
        app(args=given, prog_name="appliance", obj=ros_arguments)
    except CommandError as error:
        typer.secho(f"appliance: {error}", fg="red", err=True)
    except BrokenPipeError:  # `appliance sub … | head`: the reader has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except KeyboardInterrupt:
        sys.exit(130)
    except OSError as error:
        what = error.strerror or str(error)
        what = f"{error.filename}: {what}" if error.filename else what
        typer.secho(f"appliance: {what}", fg="red", err=True)
    sys.exit(1)


def _split_ros_arguments(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Those of the command, and those between `--ros-args` and `--`, as ROS tools add them."""
    ours: list[str] = []
    ros: list[str] = []
    to = ours
    for argument in arguments:
        if argument == "--ros-args":
            to = ros
        elif argument == "--" and to is ros:
            to = ours
        else:
            to.append(argument)
    return ours, ros


# Setting up, running, checking


@app.command()
def init(
    directory: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="Where everything goes.")
    ] = Path(),
    robot: Annotated[
        str | None, typer.Option(help="The robot's name; else this computer's.")
    ] = None,
    user: Annotated[str, typer.Option(help="The first user's name.")] = "operator",
    demo: Annotated[
        bool,
        typer.Option("--demo", help="With routes for the demo robot, and the password in a file."),
    ] = False,
) -> None:
    """Make certificates, a first user, access rules and appliance.yaml; keep what is there."""
    from appliance.access import AccessFileError
    from appliance.certs import CertificateError
    from appliance.config import ConfigError
    from appliance.init import Credentials, InitError, Step, initialise

    try:
        for step in initialise(directory, robot=robot, user=user, demo=demo):
            if isinstance(step, Step):
                typer.echo(f"{'made' if step.made else 'kept'}  {_shown(step.path)}: {step.text}")
            elif isinstance(step, Credentials):
                typer.secho(
                    f"\nuser {step.user}, password {step.password}\n"
                    "This is the only time that it is shown.\n",
                    bold=True,
                )
    except (AccessFileError, CertificateError, ConfigError, InitError) as error:
        raise CommandError(str(error)) from None


@app.command()
def run(
    context: typer.Context,
    config: ConfigOption = None,
    log_format: Annotated[
        Literal["human", "json"] | None, typer.Option(help="In place of log.format.")
    ] = None,
    log_level: Annotated[
        Literal["debug", "info", "warning", "error"] | None,
        typer.Option(help="In place of log.level."),
    ] = None,
) -> None:
    """Run the appliance until SIGINT or SIGTERM; ROS arguments come behind `--ros-args`."""
    settings = _load(config)
    from appliance import app, logs

    log = settings.log
    logs.setup(log_level or log.level, log.levels, log_format or log.format)
    with _start_errors():
        raise typer.Exit(app.run(settings, context.obj or ()))


@contextmanager
def _start_errors() -> Iterator[None]:
    """What keeps the appliance from starting and a user can mend, as a CommandError."""
    from appliance.app import START_ERRORS

    try:
        yield
    except OSError:  # told by main
        raise
    except START_ERRORS as error:
        raise CommandError(str(error)) from None


@app.command()
def reload(config: ConfigOption = None) -> None:
    """Have the running appliance take over its files as they are now: all of them, or none."""
    settings = _load(config)
    from appliance.control import ControlError, ask

    try:
        changed = ask(settings.control, "reload")
    except ControlError as error:
        raise CommandError(str(error)) from None
    typer.echo("\n".join(changed) if changed else "nothing has changed")


app.command()(routes)


@app.command()
def check(
    config: ConfigOption = None,
    show: Annotated[
        bool, typer.Option("--show", help="Also print every setting in force, secrets masked.")
    ] = False,
) -> None:
    """Read everything that `run` would use, say what is found, and change nothing."""
    settings = _load(config)
    from appliance.check import check as find
    from appliance.config import describe

    colours = {"ok": "green", "warning": "yellow", "error": "red"}
    failed = False
    for finding in find(settings):
        typer.secho(f"{finding.level:<8}", fg=colours[finding.level], nl=False)
        typer.echo(f"{finding.subject}: {finding.text}")
        failed |= finding.level == "error"
    if show:
        import yaml

        typer.echo("\n" + yaml.safe_dump(describe(settings), sort_keys=False), nl=False)
    raise typer.Exit(1 if failed else 0)


@app.command()
def demo(config: ConfigOption = None) -> None:
    """Run the appliance beside a demo robot, and print what to type to see and drive it."""
    settings = _load(config)
    from appliance import logs, tour

    logs.setup(settings.log.level, settings.log.levels, settings.log.format)
    try:
        with _start_errors():
            raise typer.Exit(tour.run(settings))
    except tour.TourError as error:
        raise CommandError(str(error)) from None


@app.command()
def bench(
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    cell: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this cell; may be repeated.")
    ] = None,
    bridge: Annotated[bool, typer.Option("--bridge", help="Only the cells of the bridge.")] = False,
    seconds: Annotated[float, typer.Option(help="How long each cell is measured.")] = 3.0,
    peer: Annotated[
        str | None, typer.Option(metavar="PATH", help="The mosquitto to compare with.")
    ] = None,
) -> None:
    """Measure this broker, and mosquitto beside it where it is installed."""
    from appliance import bench

    cells = [*(cell or ()), *(bench.bridge_cells() if bridge else ())]
    raise typer.Exit(bench.main(cells or None, seconds, peer, as_json))


app.command()(install)
app.command()(uninstall)


# What is stored


@store_app.callback(invoke_without_command=True)
def store_show(context: typer.Context, config: ConfigOption = None) -> None:
    """What outlives a restart: sessions, what waits for them, retained messages."""
    if context.invoked_subcommand is not None:
        return
    path = _store_path(config)
    from datetime import datetime

    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from appliance.config import format_size
    from appliance.mqtt.codec import quote
    from appliance.store import StoreError
    from appliance.store.inspection import summarise

    try:
        summary = summarise(path)
    except StoreError as error:
        raise CommandError(str(error)) from None

    def when(moment: float | None) -> str:
        return "" if moment is None else f"{datetime.fromtimestamp(moment):%Y-%m-%d %H:%M:%S}"

    table = Table("client id", "user", "subscriptions", "messages", "bytes", "oldest", "ends")
    for session in summary.sessions:
        table.add_row(
            escape(quote(session.client_id)),
            "" if session.username is None else escape(quote(session.username)),
            str(session.subscriptions),
            str(session.messages),
            str(session.size),
            when(session.oldest),
            when(session.ends_at) or "connected",
        )
    if summary.sessions:
        Console().print(table)
    typer.echo(
        f"{len(summary.sessions)} sessions, {summary.retained} retained messages of "
        f"{summary.retained_size} bytes; all {summary.messages} messages have "
        f"{summary.payload_size} bytes, {_shown(path)} has {format_size(summary.file_size)}"
    )


@store_app.command("export")
def store_export(config: ConfigOption = None) -> None:
    """Print all of it as JSON, one session or retained message a line."""
    path = _store_path(config)
    import json

    from appliance.store import StoreError
    from appliance.store.inspection import export

    try:
        for entry in export(path):
            typer.echo(json.dumps(entry, ensure_ascii=False))
    except StoreError as error:
        raise CommandError(str(error)) from None


@store_app.command("prune")
def store_prune(
    older_than: Annotated[
        str | None,
        typer.Option(metavar="DURATION", help="Messages that wait for longer, such as 7 d."),
    ] = None,
    client: Annotated[
        list[str] | None,
        typer.Option(metavar="ID", help="Of this client only; else its whole session. Repeatable."),
    ] = None,
    config: ConfigOption = None,
) -> None:
    """Delete sessions, or what has waited too long for them, while the appliance is stopped."""
    if older_than is None and not client:
        raise typer.BadParameter("say what: --older-than, --client, or both")
    path = _store_path(config)
    import sqlite3

    from appliance.config import parse_duration
    from appliance.store import StoreError
    from appliance.store.inspection import prune

    try:
        age = None if older_than is None else parse_duration(older_than)
    except ValueError as error:
        raise typer.BadParameter(f"--older-than {error}") from None
    try:
        sessions, messages = prune(path, age, client or [])
    except (StoreError, sqlite3.Error) as error:
        raise CommandError(str(error)) from None
    typer.echo(f"{sessions} sessions and {messages} messages deleted")


def _store_path(config: Path | None) -> Path:
    store = _load(config).broker.store
    if store.durability == "off":
        raise CommandError("nothing is stored: broker.store.durability is off")
    return store.path


# Users


@user_app.command("add")
def user_add(
    name: str,
    config: ConfigOption = None,
    password_file: PasswordFileOption = None,
    generate: GenerateOption = False,
    scram: Annotated[
        bool,
        typer.Option(
            "--scram",
            help="Keep the password for SCRAM-SHA-256, MQTT 5's login that does not send it; one "
            "that sends it works too.",
        ),
    ] = False,
) -> None:
    """Add a user; the password is asked for unless an option says where it comes from."""
    settings = _load(config)
    with _users(settings, new=True) as users:
        if name in users.users():
            raise CommandError(
                f"there is a user {name!r} already; `appliance user passwd` changes it"
            )
        _set_password(users, name, password_file, generate, scram)
    typer.echo(f"user {name} added to {_shown(users.path)}")
    _note(settings, "user added", name)


@user_app.command("passwd")
def user_passwd(
    name: str,
    config: ConfigOption = None,
    password_file: PasswordFileOption = None,
    generate: GenerateOption = False,
    scram: Annotated[
        bool | None,
        typer.Option(
            "--scram/--no-scram",
            help="Keep the password for SCRAM-SHA-256, or as argon2id; else as it is kept now.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Change a user's password."""
    settings = _load(config)
    with _users(settings) as users:
        if name not in users.users():
            raise CommandError(_no_user(name, users))
        _set_password(users, name, password_file, generate, scram)
    typer.echo(f"password of user {name} changed")
    _note(settings, "password changed", name)


@user_app.command("remove")
def user_remove(name: str, config: ConfigOption = None) -> None:
    """Remove a user."""
    settings = _load(config)
    with _users(settings) as users:
        try:
            users.remove(name)
        except KeyError:
            raise CommandError(_no_user(name, users)) from None
        users.save()
    typer.echo(f"user {name} removed")
    _note(settings, "user removed", name)


@user_app.command("list")
def user_list(config: ConfigOption = None) -> None:
    """Print the users' names, one a line, and how each one's password is kept."""
    with _users(_load(config)) as users:
        names = users.users()
        width = max(map(len, names), default=0)
        for name in names:
            typer.echo(f"{name:{width}}  {users.kind_of(name)}")


@contextmanager
def _users(settings: Settings, *, new: bool = False) -> Iterator[Passwords]:
    """The users file; what is wrong with it, or with writing it, is a CommandError."""
    from appliance.access import AccessFileError, Passwords

    path = settings.broker.users
    try:
        users = Passwords(path) if new and not path.exists() else Passwords.load(path)
        yield users
    except AccessFileError as error:
        raise CommandError(str(error)) from None


def _note(settings: Settings, what: str, user: str) -> None:
    """Have a change in the audit log, if there is one; it is done whether that works or not."""
    from appliance.audit import note

    path = settings.broker.audit.path
    try:
        note(path, what, user=user)
    except OSError as error:
        message = f"appliance: {path}: this is not in the audit log ({error.strerror})"
        typer.secho(message, fg="yellow", err=True)


def _no_user(name: str, users: Passwords) -> str:
    return f"there is no user {name!r} in {_shown(users.path)}"


def _set_password(
    users: Passwords, name: str, file: str | None, generate: bool, scram: bool | None
) -> None:
    password = new_password(name, file, generate)
    try:
        users.set(name, password, scram)
    except ValueError as error:
        raise CommandError(str(error)) from None
    users.save()
    if generate:
        typer.echo(f"password {password}")


# Access


@acl_app.command("explain")
def acl_explain(
    user: Annotated[str, typer.Argument(help="The user's name; '' for a client without one.")],
    topic: Annotated[str, typer.Argument(help="A topic, or a filter with + and #.")],
    client_id: Annotated[
        str, typer.Option(help="For rules with %c; else one that no rule speaks of.")
    ] = "",
    config: ConfigOption = None,
) -> None:
    """Say what a user may do with a topic, and which rule of which file decides it."""
    settings = _load(config)
    from appliance.access import AccessFileError, Acl
    from appliance.broker.ports import Identity

    try:
        acl = Acl.load(settings.broker.acl, settings.robot)
        explanation = acl.explain(Identity(user or None, client_id), topic)
    except AccessFileError as error:
        raise CommandError(str(error)) from None
    except ValueError as error:
        raise typer.BadParameter(f"{topic!r}: {error}") from None
    typer.echo(str(explanation))


# Client


@app.command()
def pub(
    topic: str,
    message: Annotated[
        str | None, typer.Option("--message", "-m", help="The payload; else standard input.")
    ] = None,
    file: Annotated[
        Path | None, typer.Option("--file", "-f", metavar="FILE", help="The payload's file.")
    ] = None,
    lines: Annotated[
        bool, typer.Option("--lines", "-l", help="Each line of standard input is a message.")
    ] = False,
    qos: Annotated[
        int, typer.Option("--qos", "-q", min=0, max=2, help="From 1 on, a refusal is told.")
    ] = 1,
    retain: Annotated[bool, typer.Option("--retain", "-r", help="Keep it on the broker.")] = False,
    host: HostOption = "localhost",
    port: PortOption = None,
    ca: CaOption = None,
    cert: CertOption = None,
    key: KeyOption = None,
    user: UserOption = None,
    password_file: ClientPasswordOption = None,
    client_id: ClientIdOption = "",
    mqtt_version: VersionOption = "5",
    insecure: InsecureOption = False,
    config: ConfigOption = None,
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
    target = connect_to(
        config, host, port, ca, user, password_file, client_id, mqtt_version, insecure, cert, key
    )
    from appliance import client

    try:
        client.publish(target, topic, payloads, qos, retain)
    except client.ClientError as error:
        raise CommandError(str(error)) from None


@app.command()
def sub(
    filters: Annotated[list[str], typer.Argument(metavar="FILTER...")],
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="The topic before each payload.")
    ] = False,
    count: Annotated[
        int | None, typer.Option("--count", "-C", min=1, help="End after so many messages.")
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", "-W", min=0, help="End after so many seconds (1 if too few)."),
    ] = None,
    qos: Annotated[int, typer.Option("--qos", "-q", min=0, max=2)] = 0,
    host: HostOption = "localhost",
    port: PortOption = None,
    ca: CaOption = None,
    cert: CertOption = None,
    key: KeyOption = None,
    user: UserOption = None,
    password_file: ClientPasswordOption = None,
    client_id: ClientIdOption = "",
    mqtt_version: VersionOption = "5",
    insecure: InsecureOption = False,
    config: ConfigOption = None,
) -> None:
    """Subscribe, and print what comes, a message a line."""
    target = connect_to(
        config, host, port, ca, user, password_file, client_id, mqtt_version, insecure, cert, key
    )
    from appliance import client

    try:
        received = client.subscribe(
            target,
            filters,
            qos,
            sys.stdout.buffer,
            verbose=verbose,
            count=count,
            timeout=timeout,
        )
    except client.ClientError as error:
        raise CommandError(str(error)) from None
    if count is not None and received < count:
        raise CommandError(f"{received} of {count} messages came within {timeout:g} s")


app.command()(call)
app.command()(goal)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.machinery import ExtensionFileLoader
        from importlib.metadata import PackageNotFoundError, version
        from importlib.util import find_spec

        try:
            text = f"appliance {version('ros-mqtt-appliance')}"
        except PackageNotFoundError:
            text = "appliance, run from its source without being installed"
        broker = find_spec("appliance.broker.broker")
        if broker is not None and isinstance(broker.loader, ExtensionFileLoader):
            text += ", compiled"
        typer.echo(text)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of `appliance` itself."""
