"""All that `appliance doctor` examines, in its order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

from appliance import config
from appliance.config import ConfigError, Settings
from appliance.ops import check
from appliance.ops.control import ControlError, NotRunningError, ask
from appliance.ops.doctor.computer import clock, disk, files, memory
from appliance.ops.doctor.links import links
from appliance.ops.doctor.mdns import mdns
from appliance.ops.doctor.ports import ports
from appliance.ops.doctor.ros import ros
from appliance.ops.doctor.secrets import certificates, permissions
from appliance.ops.finding import Finding
from appliance.ros.ros2.fastdds import LOST_IN_ROS

#: Seconds that the running appliance has to respond.
PATIENCE = 5.0

#: A part of the examination; it is given the settings and the status of the running appliance.
Part: TypeAlias = Callable[[Settings, "dict[str, Any] | None"], Iterator[Finding]]


def examine(path: Path | None) -> Iterator[Finding]:
    """Examine everything and change nothing; the configuration may be missing or invalid.

    What takes longest comes last, because each finding is shown as soon as it is made.
    """
    try:
        settings = config.load(path)
    except ConfigError as error:
        settings = None
        for problem in error.problems:
            yield Finding("error", "configuration", str(problem))
        text = "what follows is with the defaults, and without the files that it would name"
        yield Finding("warning", "configuration", text)
    known = settings or config.load_control(path)
    running: dict[str, Any] | None = None
    try:
        running = ask(known.control, "status", PATIENCE)
    except NotRunningError:
        yield Finding("ok", "appliance", "not running")
    except ControlError as error:
        yield Finding("error", "appliance", str(error), "its log says more")
    if running is not None:
        yield from _running(running)
    if settings is not None:
        yield from check.check(settings)
    parts: list[Part] = [ports, mdns, clock, disk, memory, files]
    if settings is not None:
        parts[3:3] = [certificates, permissions]
        parts.append(links)
    for part in (*parts, ros):
        try:
            yield from part(known, running)
        except Exception as error:
            # Computers differ in ways that nobody foresees; the other parts still run.
            text = f"could not be examined: {type(error).__name__}: {error}"
            yield Finding("warning", part.__name__, text)


def _running(status: dict[str, Any]) -> Iterator[Finding]:
    text = f"{status['version']} is running, pid {status['pid']}, {status['clients']} clients"
    yield Finding("ok", "appliance", text)
    # Of a link that is not connected the status has the reason among the warnings.
    broken = {
        f"upstream {link['name']}: {link['problem']}": f"upstream {link['name']}"
        for link in status.get("upstreams", ())
        if link["problem"]
    }
    for warning in status["warnings"]:
        if warning not in broken:
            yield Finding("warning", "appliance", warning)
    for link in status.get("upstreams", ()):
        if link["problem"] or not link["connected"]:
            state = "has a problem" if link["connected"] else "is not connected"
            why = link["problem"] or "it is being dialled"
            yield Finding("error", f"upstream {link['name']}", f"the running link {state}: {why}")
    for sick in status["routes"]["sick"]:
        advice = LOST_IN_ROS if sick["lost"] else ""
        yield Finding("warning", f"route {sick['route']}", sick["problem"], advice)
