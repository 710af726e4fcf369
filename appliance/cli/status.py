"""`appliance status`: what the running appliance says of itself, for people and for machines."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from appliance.cli.console import CommandError, ConfigOption
from appliance.cli.console import load as load_settings

#: What certificates are called here.
_WHAT = {"server": "the server's certificate", "ca": "the CA", "crl": "the revocation list"}


def status(
    config: ConfigOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Ask the running appliance how it is; exit code 1 when none is running."""
    from appliance.config import load_control
    from appliance.ops.control import ControlError, NotRunningError, ask
    from appliance.ops.logs import VISIBLE, json_text

    broken: CommandError | None = None
    try:
        settings = load_settings(config)
    except CommandError as error:
        broken, settings = error, load_control(config)
    try:
        told = ask(settings.control, "status")
    except NotRunningError as error:
        raise broken or CommandError(str(error)) from None
    except ControlError as error:
        raise CommandError(str(error)) from None
    if broken is not None:
        told["warnings"].append(str(broken))
    if as_json:
        typer.echo(json_text(told, indent=2))
        return
    for name, text in _lines(told):
        typer.echo(f"{name:<14}{text.translate(VISIBLE)}")
    for text in told["warnings"]:
        typer.secho("warning       ", fg="yellow", nl=False)
        typer.echo(text.translate(VISIBLE))


def _lines(told: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """What is told, as names and texts."""
    since = datetime.fromisoformat(told["since"]).astimezone()
    uptime = timedelta(seconds=told["uptime"])
    yield "appliance", f"{told['version']}, robot {told['robot']}, pid {told['pid']}"
    yield "up since", f"{since:%Y-%m-%d %H:%M:%S}, for {uptime}"
    yield "configuration", told["configuration"]
    for number, listener in enumerate(told["listeners"]):
        kind = "TLS" if listener["tls"] else "without TLS"
        if listener["protocol"] == "websocket":
            kind += ", WebSocket"
        yield "" if number else "listening on", f"{listener['bind']} ({kind})"
    yield (
        "clients",
        f"{told['clients']} connected, {told['sessions']} sessions, "
        f"{told['subscriptions']} subscriptions",
    )
    messages = told["messages"]
    text = (
        f"{messages['received_a_second']:g} a second in, {messages['sent_a_second']:g} out; "
        f"{messages['received']} and {messages['sent']} so far"
    )
    if told["ros"]["bus"] != "none":
        text += (
            f"; {messages['from_ros_a_second']:g} a second from ROS, "
            f"{messages['to_ros_a_second']:g} to ROS"
        )
    for what in ("dropped", "refused"):
        text += f", {messages[what]} {what}" if messages[what] else ""
    yield "messages", text
    yield (
        "kept",
        f"{told['waiting']} messages wait for clients, {told['retained']} are retained",
    )
    yield "store", _store(told["store"])
    memory = told["memory"]
    yield (
        "memory",
        f"{_size(memory['process'])}; in queues {_size(memory['queued'])} of "
        f"{_size(memory['limit'])}",
    )
    yield "ROS", _ros(told["ros"])
    routes = told["routes"]
    yield "routes", f"{routes['count']}, which carry {routes['bridged']} topics and calls now"
    for sick in routes["sick"]:
        yield "", f"{sick['route']}: {sick['problem']}"
    yield "last reload", _reload(told["reload"])
    for number, each in enumerate(told["certificates"]):
        left = f"{each['days']} days left" if each["days"] >= 0 else "has run out"
        text = f"{_WHAT[each['what']]}: {left} ({Path(each['file']).name})"
        yield "" if number else "certificates", text


def _store(told: dict[str, Any] | None) -> str:
    if told is None:
        return "off: nothing outlives a restart"
    text = f"{_size(told['bytes'])} of {_size(told['limit'])} in {told['path']}"
    return text + (" CANNOT BE WRITTEN" if told["failing"] else "")


def _ros(told: dict[str, Any]) -> str:
    if told["bus"] == "none":
        return "off: a broker alone"
    if told["state"] == "joined":
        seen = told["nodes_seen"]
        others = "no other node seen yet" if not seen else f"other nodes seen: {seen}"
        return f"joined as {told['node']}, {others}"
    if told["problem"] is None:
        return "is being joined"
    state = "was lost" if told["state"] == "lost" else "is not there yet"
    return f"{state}, and tried again: {told['problem']}"


def _reload(told: dict[str, Any] | None) -> str:
    if told is None:
        return "none since the start"
    at = datetime.fromisoformat(told["at"]).astimezone()
    result = "" if told["done"] else "refused, what was in force stays so: "
    return f"{at:%Y-%m-%d %H:%M:%S}: {result}{told['text']}"


def _size(value: float) -> str:
    from appliance.config import about_size

    return about_size(value)
