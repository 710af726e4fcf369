"""The commands `appliance install` and `appliance uninstall`."""

from __future__ import annotations

import sys
import sysconfig
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from appliance.cli.console import CommandError

if TYPE_CHECKING:
    from appliance.ops.install import InstallStep, ServiceInstaller

RootOption = Annotated[
    Path,
    typer.Option("--root", metavar="DIR", envvar="DESTDIR", help="Install into this system image."),
]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Print what would be done, and do nothing.")
]


def install(
    robot: Annotated[
        str | None, typer.Option(help="The robot's name; default: this computer's name.")
    ] = None,
    user: Annotated[
        str | None,
        typer.Option(
            help="Run as this user: the user of the ROS nodes shares memory with them. Default: "
            "the user as before, or its own user, appliance."
        ),
    ] = None,
    start: Annotated[
        bool, typer.Option("--start/--no-start", help="Start the service now, or restart it.")
    ] = True,
    init: Annotated[
        bool,
        typer.Option(
            "--init/--no-init",
            help="Make keys and a first user where there are none; not for an image that is "
            "copied to several robots.",
        ),
    ] = True,
    dry_run: DryRunOption = False,
    root: RootOption = Path("/"),
    packaged: Annotated[bool, typer.Option("--packaged", hidden=True)] = False,
) -> None:
    """Install the appliance as a systemd service, or upgrade the installed one.

    The command goes to /usr/local/bin, configuration and keys to
    /etc/appliance, data to /var/lib/appliance. Existing configuration, keys
    and data are not changed. If the new version does not start, the previous
    one continues to run.
    """
    from appliance.access import AccessFileError
    from appliance.certs import CertificateError
    from appliance.config import ConfigError
    from appliance.ops.init import Credentials, InitError
    from appliance.ops.install import InstallError

    installation = _installation(root, dry_run, user or "")
    installation.robot = robot
    installation.start, installation.initialise = start, init
    installation.packaged = packaged
    try:
        if dry_run:
            typer.echo("Nothing is done. Without --dry-run this would be:")
        for step in installation.install():
            if isinstance(step, Credentials):
                typer.secho(
                    f"\nuser {step.user}, password {step.password}\n"
                    "This is the only time that it is shown.\n",
                    bold=True,
                )
            else:
                _say(step)
        if dry_run and not packaged:
            typer.echo(f"\nThe unit:\n\n{installation.unit()}", nl=False)
    except (
        AccessFileError,
        CertificateError,
        ConfigError,
        InitError,
        InstallError,
    ) as error:
        raise CommandError(str(error)) from None


def uninstall(
    purge: Annotated[
        bool,
        typer.Option("--purge", help="Also remove configuration, users, keys and all data."),
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before --purge.")] = False,
    dry_run: DryRunOption = False,
    root: RootOption = Path("/"),
) -> None:
    """Stop and remove the service; configuration, keys and data stay."""
    from appliance.ops.install import InstallError

    installation = _installation(root, dry_run)
    if purge and not yes and not dry_run:
        question = "Remove the configuration, all users, certificates with their keys, and all data"
        if not sys.stdin.isatty():
            raise CommandError("no terminal to ask on; --yes says that it is meant")
        typer.confirm(f"{question}? Nothing brings them back.", abort=True)
    try:
        steps = installation.uninstall(purge=purge)
        first = next(steps, None)
        if first is None:
            typer.echo("no service is installed, and nothing of one is left")
            return
        if dry_run:
            typer.echo("Nothing is done. Without --dry-run this would be:")
        for step in (first, *steps):
            _say(step)
    except InstallError as error:
        raise CommandError(str(error)) from None


def _say(step: InstallStep) -> None:
    typer.echo(f"{step.verb:<8}  {step.subject}: {step.text}")


def _installation(root: Path, dry_run: bool, user: str = "") -> ServiceInstaller:
    from appliance.ops.install import COMMAND, ServiceInstaller

    if hasattr(sys, "frozen"):
        return ServiceInstaller(COMMAND, Path(sys.executable), root, user, dry_run=dry_run)
    called = Path(sys.argv[0]).absolute()
    if called.name != "appliance":  # python -m appliance
        called = Path(sysconfig.get_path("scripts"), "appliance")
    return ServiceInstaller(called, None, root, user, dry_run=dry_run)
