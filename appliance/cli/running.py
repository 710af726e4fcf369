"""The commands `appliance init`, `run`, `reload`, `check`, `demo` and `bench`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer

from appliance.cli.console import CommandError, ConfigOption, load, shown


def init(
    directory: Annotated[
        Path, typer.Option("--dir", metavar="DIR", help="The directory for all files.")
    ] = Path(),
    robot: Annotated[
        str | None, typer.Option(help="The robot's name; default: this computer's name.")
    ] = None,
    user: Annotated[str, typer.Option(help="The first user's name.")] = "operator",
    demo: Annotated[
        bool,
        typer.Option(
            "--demo", help="Add routes for the demo robot, and write the password to a file."
        ),
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="The directory for what it stores when it runs; default: state, in that of --dir.",
        ),
    ] = None,
    name: Annotated[
        list[str] | None,
        typer.Option(
            metavar="DNS_NAME",
            help="A further name that clients connect to, beside this computer's own. Repeatable.",
        ),
    ] = None,
    upstream: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Add a link to the broker of a fleet: mqtts://HOST, or mqtts://USER@HOST.",
        ),
    ] = None,
    vda5050: Annotated[
        str | None,
        typer.Option(
            metavar="MANUFACTURER",
            help="The link speaks VDA 5050, as a robot of this manufacturer.",
        ),
    ] = None,
) -> None:
    """Make certificates, a first user, access rules and appliance.yaml; existing files stay."""
    from appliance.access import AccessFileError
    from appliance.certs import CertificateError
    from appliance.config import ConfigError
    from appliance.host.owners import OwnerError, acting_for
    from appliance.ops.init import Credentials, InitError, InitStep, NextSteps, initialise

    try:
        with acting_for(directory / "appliance.yaml"):
            steps = initialise(
                directory,
                robot=robot,
                user=user,
                demo=demo,
                data=data,
                names=name or [],
                upstream=upstream,
                manufacturer=vda5050,
            )
            for step in steps:
                if isinstance(step, InitStep):
                    verb = "made" if step.made else "kept"
                    typer.echo(f"{verb}  {shown(step.path)}: {step.text}")
                elif isinstance(step, Credentials):
                    typer.secho(
                        f"\nuser {step.user}, password {step.password}\n"
                        "This is the only time that it is shown.\n",
                        bold=True,
                    )
                elif isinstance(step, NextSteps):
                    typer.echo("Next:")
                    for number, text in enumerate(step.texts, 1):
                        typer.echo(f"{number}. {text}")
    except (AccessFileError, CertificateError, ConfigError, InitError, OwnerError) as error:
        raise CommandError(str(error)) from None


def run(
    context: typer.Context,
    config: ConfigOption = None,
    log_format: Annotated[
        Literal["human", "json"] | None, typer.Option(help="Overrides log.format.")
    ] = None,
    log_level: Annotated[
        Literal["debug", "info", "warning", "error"] | None,
        typer.Option(help="Overrides log.level."),
    ] = None,
) -> None:
    """Run the appliance until SIGINT or SIGTERM; ROS arguments follow `--ros-args`."""
    settings = load(config)
    from appliance.app.stores import store_of
    from appliance.ops import logs

    if context.obj and settings.bridge.bus == "ros2":
        from appliance.ros.ros2.node import fault_of_arguments

        if text := fault_of_arguments(context.obj):
            raise CommandError(f"ROS arguments (behind --ros-args): {text}")

    log = settings.log
    logs.setup(log_level or log.level, log.levels, log_format or log.format)
    store = store_of(settings.broker.store)
    store.begin_opening()  # the rest is imported meanwhile
    from appliance.app import main as app

    with _start_errors():
        raise typer.Exit(app.run(settings, context.obj or (), store))


@contextmanager
def _start_errors() -> Iterator[None]:
    """Turn errors of the start that a user can fix into a CommandError."""
    from appliance.app.main import START_ERRORS

    try:
        yield
    except OSError:  # main reports it
        raise
    except START_ERRORS as error:
        raise CommandError(str(error)) from None


def reload(config: ConfigOption = None) -> None:
    """Make the running appliance apply its changed files: all of them, or none."""
    settings = load(config)
    from appliance.ops.control import ControlError, ask

    try:
        changed = ask(settings.control, "reload")
    except ControlError as error:
        raise CommandError(str(error)) from None
    typer.echo("\n".join(changed) if changed else "nothing has changed")


def check(
    config: ConfigOption = None,
    show: Annotated[
        bool,
        typer.Option("--show", help="Also print all settings, with defaults; secrets are masked."),
    ] = False,
) -> None:
    """Check all files that `run` uses, without changing anything."""
    settings = load(config)
    from appliance.config import describe
    from appliance.ops.check import check as find

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


def demo(config: ConfigOption = None) -> None:
    """Run the appliance with a demo robot, and print the commands to see and drive it.

    `appliance init --demo` writes the configuration for it.
    """
    settings = load(config)
    from appliance.cli import demo as demo_appliance
    from appliance.ops import logs

    logs.setup(settings.log.level, settings.log.levels, settings.log.format)
    try:
        with _start_errors():
            raise typer.Exit(demo_appliance.run(settings))
    except demo_appliance.DemoError as error:
        raise CommandError(str(error)) from None


def bench(
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    cell: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this cell. Repeatable.")
    ] = None,
    broker: Annotated[
        bool, typer.Option("--broker", help="Only the comparison of the broker alone: ten cells.")
    ] = False,
    bridge: Annotated[bool, typer.Option("--bridge", help="Only the cells of the bridge.")] = False,
    upstream: Annotated[
        bool, typer.Option("--upstream", help="Only the cells of a link to a fleet's broker.")
    ] = False,
    seconds: Annotated[float, typer.Option(help="Seconds that each cell is measured.")] = 3.0,
    messages: Annotated[
        int | None, typer.Option(help="Messages that wait for a link.", show_default="100,000")
    ] = None,
    rounds: Annotated[
        int, typer.Option(help="Rounds over all cells; the medians count, with their spread.")
    ] = 3,
    peer: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PATH",
            help="A mosquitto executable, 2.0 or later, to compare with. Repeatable.",
            show_default="the installed one",
        ),
    ] = None,
) -> None:
    """Measure this broker, and mosquitto for comparison: the installed one or those of --peer."""
    from appliance import bench

    cells = [*(cell or ()), *(bench.broker_cells() if broker else ())]
    cells += bench.bridge_cells() if bridge else ()
    cells += bench.upstream_cells() if upstream else ()
    raise typer.Exit(bench.main(cells or None, seconds, peer, as_json, messages, rounds))
