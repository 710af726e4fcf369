"""Checks the bridge's settings: types, fields, stop messages and limits, against what is installed.

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
from appliance.ros.topics.rules import CommandRules
from appliance.ros.topics.stop_message import check_rules


def bridge(settings: Settings) -> Iterator[Finding]:
    """Findings about the bridge and its routes."""
    section = settings.bridge
    if section.bus == "none":
        yield Finding("ok", "bridge", "off: a broker alone")
        return
    is_ros1 = section.bus == "ros1"
    is_available, reason = (ros1.available if is_ros1 else ros2.available)()
    if not is_available:
        text = f"{reason}; the broker runs without, and what routes say was not checked here"
        yield Finding("warning", "bridge", text)
    else:
        called = (*section.services, *section.actions, *section.parameters)
        routes = sum(not route.is_exclusion for route in (*section.topics, *called))
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
    """Findings about which other nodes can be on the bus."""
    scope, subject = settings.bridge.discovery, "bridge.discovery"
    environment = dict(os.environ)
    ignored = discovery.use(scope, environment)
    if ignored:
        yield Finding("warning", subject, ignored)
    if scope == "localhost" or (scope == "environment" and discovery.is_local(environment)):
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
        errors = list(_try(subject, type_name, functools.partial(converters.get, type_name)))
        if not errors:  # without the type, each check would report that it is missing
            for check in _checks(route, type_name, converters):
                errors += _try(subject, type_name, check)
        yield from dict.fromkeys(errors)
        if route.rules is not None and not errors:
            text = stop_message(route.rules, converters.get(type_name))
            if text:
                yield Finding("warning", f"route {subject}", text)


def _checks(
    route: TopicSettings, type_name: str, converters: Converters
) -> Iterator[Callable[[], object]]:
    """Functions each of which raises an error for one kind of mistake in the route."""
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

        def check_service(
            type_name: str = type_name, on_error: str | None = service.on_error
        ) -> None:
            ros2.import_service(type_name)
            if on_error is not None:
                try:
                    converters.get(f"{type_name}_Response").from_json(on_error.encode())
                except ConversionError as error:
                    raise ConversionError("on_error", str(error)) from None

        yield from _try(", ".join(service.names), type_name, check_service)
    for action in routes.actions:
        if action.type is not None:
            check = functools.partial(ros2.import_service, f"{action.type}_SendGoal")
            yield from _try(", ".join(action.names), action.type, check)


def _try(subject: str, type_name: str, check: Callable[[], object]) -> Iterator[Finding]:
    """The error of a check as a finding."""
    try:
        check()
    except UnknownTypeError as error:
        package = type_name.partition("/")[0]
        problem = re.sub(rf"({re.escape(type_name)})(_SendGoal)?_Request", r"\1", str(error))
        text = f"{problem}{_did_you_mean(type_name)}"
        # A package that is not installed here may be installed where the appliance runs.
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
