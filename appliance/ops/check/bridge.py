"""What the bridge is told: types, fields, stop messages and limits, held against what is installed.

Nothing is started, and no ROS has to run: types are imported, or read from their definitions.
"""

from __future__ import annotations

import difflib
import functools
import os
import re
from collections.abc import Callable, Iterator

from appliance.config import Settings
from appliance.ops.check.commands import commands, stop_message
from appliance.ops.finding import Finding
from appliance.ros import settings as ros_settings
from appliance.ros.bridge import TopicSettings
from appliance.ros.calls.routes import CallRoutes
from appliance.ros.payload.converter import ConversionError, Converters
from appliance.ros.payload.definitions import UnknownTypeError, describe
from appliance.ros.payload.encodings.registry import ENCODINGS
from appliance.ros.ros1 import node as ros1
from appliance.ros.ros2 import discovery, installation
from appliance.ros.ros2 import node as ros2
from appliance.ros.topics.commands import check_rules
from appliance.ros.topics.rules import CommandRules


def bridge(settings: Settings) -> Iterator[Finding]:
    """What there is to say of the bridge and its routes."""
    said = settings.bridge
    if said.bus == "none":
        yield Finding("ok", "bridge", "off: a broker alone")
        return
    is_ros1 = said.bus == "ros1"
    is_available, reason = (ros1.available if is_ros1 else ros2.available)()
    if not is_available:
        text = f"{reason}; the broker runs without, and what routes say was not checked here"
        yield Finding("warning", "bridge", text)
    else:
        called = (*said.services, *said.actions, *said.parameters)
        routes = sum(not route.is_exclusion for route in (*said.topics, *called))
        found = ros1.found() if is_ros1 else installation.find()
        yield Finding("ok", "bridge", f"{found}; routes: {routes}")
    if is_ros1:
        yield Finding("warning", "bridge", discovery.OPEN_ROS1)
        if is_available:
            text = "types, fields and stop messages of routes are not checked for ROS 1"
            yield Finding("ok", "bridge", text)
        yield from commands(settings)
        return
    yield from _bus(settings)
    yield from commands(settings)
    if is_available:
        yield from _topics(ros_settings.routes(settings))
        yield from _calls(ros_settings.call_routes(settings))


def _bus(settings: Settings) -> Iterator[Finding]:
    """Who else is on it."""
    said, subject = settings.bridge.discovery, "bridge.discovery"
    environment = dict(os.environ)
    unheeded = discovery.use(said, environment)
    if unheeded:
        yield Finding("warning", subject, unheeded)
    if said == "localhost" or (said == "environment" and discovery.is_local(environment)):
        yield Finding("ok", subject, "ROS nodes of this computer only")
    elif discovery.is_secured(environment):
        yield Finding("ok", subject, "ROS nodes that have keys, by SROS 2")
    else:
        yield Finding("warning", subject, f"{discovery.OPEN}; {discovery.OPEN_ADVICE}")


def _topics(routes: list[TopicSettings]) -> Iterator[Finding]:
    converters = Converters(lambda name: describe(ros2.load_message(name), ros2.load_message))
    for route in routes:
        type_name = route.type
        if type_name is None or "*" in type_name:
            if route.fields or (route.rules is not None and route.rules.needs_type):
                text = "its fields and stop message are checked only where the route has its type"
                yield Finding("ok", ", ".join(route.names), text)
            continue

        subject = ", ".join(route.names)
        told = list(_looked_at(subject, type_name, functools.partial(converters.get, type_name)))
        if not told:  # that there is none would be told by each
            for look in _looks(route, type_name, converters):
                told += _looked_at(subject, type_name, look)
        yield from dict.fromkeys(told)
        if route.rules is not None and not told:
            text = stop_message(route.rules, converters.get(type_name))
            if text:
                yield Finding("warning", f"route {subject}", text)


def _looks(
    route: TopicSettings, type_name: str, converters: Converters
) -> Iterator[Callable[[], object]]:
    """What raises an error for a mistake in the route, each for one."""
    encoding = ENCODINGS[route.encoding]
    if encoding.serialization is None or route.rules is not None:
        for field in route.fields:
            yield functools.partial(converters.get, type_name, (field,))
        for direction in ("mqtt", "ros"):
            if route.to in (direction, "both"):
                converter = converters.get(type_name)
                yield functools.partial(encoding.check, converter, to_ros=direction == "ros")
    if route.rules is not None:
        converter, rules = converters.get(type_name), route.rules
        parts = [CommandRules(clamp=(one,)) for one in rules.clamp]
        parts += [CommandRules(allow=(one,)) for one in rules.allow]
        for part in (*parts, CommandRules(on_silence=rules.on_silence)):
            yield functools.partial(check_rules, part, converter)


def _calls(routes: CallRoutes) -> Iterator[Finding]:
    converters = Converters(lambda name: describe(ros2.load_message(name), ros2.load_message))
    for service in routes.services:
        type_name = service.type
        if type_name is None:
            continue

        def look_at_service(
            type_name: str = type_name, on_error: str | None = service.on_error
        ) -> None:
            ros2.import_service(type_name)
            if on_error is not None:
                try:
                    converters.get(f"{type_name}_Response").from_json(on_error.encode())
                except ConversionError as error:
                    raise ConversionError("on_error", str(error)) from None

        yield from _looked_at(", ".join(service.names), type_name, look_at_service)
    for action in routes.actions:
        if action.type is not None:
            look = functools.partial(ros2.import_service, f"{action.type}_SendGoal")
            yield from _looked_at(", ".join(action.names), action.type, look)


def _looked_at(subject: str, type_name: str, look: Callable[[], object]) -> Iterator[Finding]:
    try:
        look()
    except UnknownTypeError as error:
        package = type_name.partition("/")[0]
        told = re.sub(rf"({re.escape(type_name)})(_SendGoal)?_Request", r"\1", str(error))
        text = f"{told}{_did_you_mean(type_name)}"
        # What is not installed here may be where it runs.
        is_here = package in ros2.interfaces()
        yield Finding("error" if is_here else "warning", f"route {subject}", text)
    except ConversionError as error:
        yield Finding("error", f"route {subject}", str(error))


def _did_you_mean(type_name: str) -> str:
    known = ros2.interfaces()
    package, _, name = type_name.partition("/")
    if package not in known:
        near = [f"{each}/{name}" for each in difflib.get_close_matches(package, known, n=3)]
        close = [each for each in near if each in known[each.partition("/")[0]]]
    else:
        close = difflib.get_close_matches(type_name, known[package], n=1)
    return f"; did you mean {close[0]}?" if close and close[0] != type_name else ""
