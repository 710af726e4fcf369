"""The commands `appliance user` and `appliance acl`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated

import typer

from appliance.cli.console import (
    CommandError,
    ConfigOption,
    GenerateOption,
    PasswordFileOption,
    load,
    new_password,
    shown,
)

if TYPE_CHECKING:
    from appliance.access import Passwords
    from appliance.config import Settings

user_app = typer.Typer(no_args_is_help=True, help="Users and their passwords.")
acl_app = typer.Typer(no_args_is_help=True, help="Access rules: who may read and write what.")


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
            help="Store the password for SCRAM-SHA-256, an MQTT 5 login that does not send it; "
            "logins that send it work as well.",
        ),
    ] = False,
    group: Annotated[
        list[str] | None, typer.Option(metavar="GROUP", help="A group of the user; repeatable.")
    ] = None,
) -> None:
    """Add a user; asks for the password unless an option provides it."""
    settings = load(config)
    with _users(settings, new=True) as users:
        if name in users.users():
            raise CommandError(
                f"there is a user {name!r} already; `appliance user passwd` changes it"
            )
        password = _set_password(users, name, password_file, generate, scram)
        if group:  # before the user can log in, and only if there are such groups
            _join(settings, name, group)
        users.save()
        _show(password, generate)
    typer.echo(f"user {name} added to {shown(users.path)}")
    _say_without_rules(settings, name)
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
            help="Store the password for SCRAM-SHA-256, or as argon2id; default: as before.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Change a user's password."""
    settings = load(config)
    with _users(settings) as users:
        if name not in users.users():
            raise CommandError(_no_user(name, users))
        password = _set_password(users, name, password_file, generate, scram)
        users.save()
        _show(password, generate)
    typer.echo(f"password of user {name} changed")
    _note(settings, "password changed", name)


@user_app.command("remove")
def user_remove(name: str, config: ConfigOption = None) -> None:
    """Remove a user, also from its groups."""
    from appliance.access import groups

    settings = load(config)
    acl = settings.broker.acl
    left: list[int] = []
    with _users(settings) as users:
        try:
            users.remove(name)
        except KeyError:
            raise CommandError(_no_user(name, users)) from None
        users.save()
        if acl.exists():  # plugins may stand in for it
            groups.leave(acl, settings.robot, name)
            left = groups.own_rules(acl, name)
    typer.echo(f"user {name} removed")
    if left:
        lines = ", ".join(map(str, left))
        whose = f"its own rules stay in {shown(acl)} (line {lines})"
        typer.echo(f"{whose}: a new user of that name would have these rights")
    _note(settings, "user removed", name)


@user_app.command("list")
def user_list(config: ConfigOption = None) -> None:
    """Print the users, one per line, and how each password is stored."""
    with _users(load(config)) as users:
        names = users.users()
        width = max(map(len, names), default=0)
        for name in names:
            typer.echo(f"{name:{width}}  {users.kind_of(name)}")


@contextmanager
def _users(settings: Settings, *, new: bool = False) -> Iterator[Passwords]:
    """The users file; errors in it, or in writing it, become a CommandError."""
    from appliance.access import AccessFileError, Passwords
    from appliance.host.owners import OwnerError, acting_for

    path = settings.broker.users
    try:
        with acting_for(settings.file, path):
            users = Passwords(path) if new and not path.exists() else Passwords.load(path)
            yield users
    except (AccessFileError, OwnerError) as error:
        raise CommandError(str(error)) from None


def _note(settings: Settings, what: str, user: str) -> None:
    """Record a change in the audit log, if there is one; a failure only prints a warning."""
    from appliance.host.owners import OwnerError, acting_for
    from appliance.ops.audit import note

    path = settings.broker.audit.path
    try:
        with acting_for(settings.file, path):
            note(path, what, user=user)
    except (OSError, OwnerError) as error:
        reason = getattr(error, "strerror", None) or error
        message = f"appliance: {path}: this is not in the audit log ({reason})"
        typer.secho(message, fg="yellow", err=True)


def _no_user(name: str, users: Passwords) -> str:
    return f"there is no user {name!r} in {shown(users.path)}"


def _join(settings: Settings, name: str, wanted: list[str]) -> None:
    from appliance.access import groups

    try:
        groups.join(settings.broker.acl, settings.robot, name, wanted)
    except ValueError as error:
        raise CommandError(str(error)) from None


def _say_without_rules(settings: Settings, name: str) -> None:
    """Tell that a user may do nothing, where no rule is for it alone; patterns are for all."""
    from appliance.access import AccessFileError, Acl, groups

    path = settings.broker.acl
    with suppress(AccessFileError, ValueError):  # there may be plugins instead
        if any(rule.user == name for rule in Acl.load(path, settings.robot).rules):
            return
        known = ", ".join(groups.groups(path))
        lines = f"`user {name}` and below it what it may do"
        more = f", for example `include {groups.FOLDER}/NAME.conf` of a group: {known}"
        typer.echo(
            f"It may do nothing yet, as no rule is for it. Add to {shown(path)}: "
            f"{lines}{more if known else ''}."
        )


def _set_password(
    users: Passwords, name: str, file: str | None, generate: bool, scram: bool | None
) -> str:
    """The new password, which is not saved yet."""
    password = new_password(name, file, generate)
    try:
        users.set(name, password, scram)
    except ValueError as error:
        raise CommandError(str(error)) from None
    return password


def _show(password: str, is_generated: bool) -> None:
    if is_generated:
        typer.echo(f"password {password}")


@acl_app.command("explain")
def acl_explain(
    user: Annotated[str, typer.Argument(help="The user name; '' for a client without one.")],
    topic: Annotated[str, typer.Argument(help="A topic, or a filter with + and #.")],
    client_id: Annotated[
        str, typer.Option(help="For rules with %c; default: an id that no rule names.")
    ] = "",
    config: ConfigOption = None,
) -> None:
    """Show what a user may do with a topic, and which rule of which file decides it."""
    settings = load(config)
    from appliance.access import AccessFileError, Acl, Passwords
    from appliance.broker.values import Identity

    try:
        acl = Acl.load(settings.broker.acl, settings.robot)
        explanation = acl.explain(Identity(user or None, client_id), topic)
    except AccessFileError as error:
        raise CommandError(str(error)) from None
    except ValueError as error:
        raise typer.BadParameter(f"{topic!r}: {error}") from None
    typer.echo(str(explanation))
    if topic.startswith(("$", f"{settings.robot}/_appliance/")) and not topic.startswith("$share/"):
        note = "note: nobody may publish there: what the appliance says of itself is its own"
        typer.secho(note, fg="yellow", err=True)
    with suppress(AccessFileError):
        users = Passwords.load(settings.broker.users)
        if user and user not in users.users():
            typer.secho(f"note: {_no_user(user, users)}", fg="yellow", err=True)
