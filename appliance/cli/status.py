"""`appliance status`: the state of the running appliance, as text or JSON."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from appliance.cli.console import ConfigOption, ask_running

#: Names of certificates.
_WHAT = {"server": "the server's certificate", "ca": "the CA", "crl": "the revocation list"}


def status(
    config: ConfigOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Show the state of the running appliance; exit code 1 when none is running."""
    from appliance.ops.logs import VISIBLE, json_text

    report, mistake = ask_running(config, "status")
    if mistake:
        report["warnings"].append(mistake)
    if as_json:
        typer.echo(json_text(report, indent=2))
        return
    for name, text in _lines(report):
        typer.echo(f"{name:<14}{text.translate(VISIBLE)}")
    for text in report["warnings"]:
        typer.secho("warning       ", fg="yellow", nl=False)
        typer.echo(text.translate(VISIBLE))


def _lines(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The lines of the report, as names and texts."""
    since = datetime.fromisoformat(report["since"]).astimezone()
    uptime = timedelta(seconds=report["uptime"])
    yield "appliance", f"{report['version']}, robot {report['robot']}, pid {report['pid']}"
    yield "up since", f"{since:%Y-%m-%d %H:%M:%S}, for {uptime}"
    yield "configuration", report["configuration"]
    for number, listener in enumerate(report["listeners"]):
        kind = "TLS" if listener["tls"] else "without TLS"
        kind += {"websocket": ", WebSocket", "web": ", web"}.get(listener["protocol"], "")
        yield "" if number else "listening on", f"{listener['bind']} ({kind})"
    yield (
        "clients",
        f"{report['clients']} connected, {report['sessions']} sessions, "
        f"{report['subscriptions']} subscriptions",
    )
    messages = report["messages"]
    text = (
        f"{messages['received_a_second']:g} a second in, {messages['sent_a_second']:g} out; "
        f"{messages['received']} and {messages['sent']} so far"
    )
    if report["ros"]["bus"] != "none":
        text += (
            f"; {messages['from_ros_a_second']:g} a second from ROS, "
            f"{messages['to_ros_a_second']:g} to ROS"
        )
    for what in ("dropped", "refused"):
        text += f", {messages[what]} {what}" if messages[what] else ""
    yield "messages", text
    yield (
        "kept",
        f"{report['waiting']} messages wait for clients, {report['retained']} are retained",
    )
    yield "store", _store(report["store"])
    memory = report["memory"]
    yield (
        "memory",
        f"{_size(memory['process'])}; in queues {_size(memory['queued'])} of "
        f"{_size(memory['limit'])}",
    )
    yield "ROS", _ros(report["ros"])
    yield "mDNS", _mdns(report["mdns"])
    routes = report["routes"]
    yield "routes", f"{routes['count']}, which carry {routes['bridged']} topics and calls now"
    for sick in routes["sick"]:
        yield "", f"{sick['route']}: {sick['problem']}"
    for number, link in enumerate(report["upstreams"]):
        yield "" if number else "upstreams", _upstream(link)
    yield "last reload", _reload(report["reload"])
    for number, each in enumerate(report["certificates"]):
        left = f"{each['days']} days left" if each["days"] >= 0 else "has run out"
        text = f"{_WHAT[each['what']]}: {left} ({Path(each['file']).name})"
        yield "" if number else "certificates", text


def _store(report: dict[str, Any] | None) -> str:
    if report is None:
        return "off: nothing outlives a restart"
    text = f"{_size(report['bytes'])} of {_size(report['limit'])} in {report['path']}"
    return text + (" CANNOT BE WRITTEN" if report["failing"] else "")


def _ros(report: dict[str, Any]) -> str:
    if report["bus"] == "none":
        return "off: a broker alone"
    if report["state"] == "joined":
        seen = report["nodes_seen"]
        others = "no other node seen yet" if not seen else f"other nodes seen: {seen}"
        return f"joined as {report['node']}, {others}"
    if report["problem"] is None:
        return "is being joined"
    state = "was lost" if report["state"] == "lost" else "is not there yet"
    return f"{state}, and tried again: {report['problem']}"


def _mdns(report: dict[str, Any]) -> str:
    if report["state"] == "off":
        return f"off: {report['reason']}"
    if report["state"] == "announced":
        return f"announced as {report['name']} on {'; '.join(report['links'])}"
    if report["state"] == "waiting":
        return "not announced: there is no network"
    return "is being started" if report["state"] == "starting" else "NOT announced"


def _upstream(link: dict[str, Any]) -> str:
    state = "connected to" if link["connected"] else "NOT connected to"
    text = f"{link['name']}: {state} {link['server']}"
    if link["waiting"]:
        oldest = "" if link["oldest"] is None else f", the oldest for {link['oldest']:.0f} s"
        text += f"; {link['waiting']} messages wait ({_size(link['waiting_bytes'])}{oldest})"
    return text


def _reload(report: dict[str, Any] | None) -> str:
    if report is None:
        return "none since the start"
    at = datetime.fromisoformat(report["at"]).astimezone()
    result = "" if report["done"] else "refused, what was in force stays so: "
    return f"{at:%Y-%m-%d %H:%M:%S}: {result}{report['text']}"


def _size(value: float) -> str:
    from appliance.config import about_size

    return about_size(value)
