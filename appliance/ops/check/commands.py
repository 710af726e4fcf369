"""Checks routes to ROS for what would let the robot drive on although nobody can have meant it."""

from __future__ import annotations

from collections.abc import Iterator

from appliance.config import Settings, TopicRoute
from appliance.ops.finding import Finding
from appliance.ros.payload.converter import ConversionError, Converter
from appliance.ros.topics.rules import CommandRules
from appliance.ros.topics.stop_message import check_rules

#: Message types that are a velocity: the robot drives on with the last one until zero stops it.
_VELOCITIES = {"Twist", "TwistStamped", "AckermannDrive", "AckermannDriveStamped"}
#: Those of them whose other fields are no velocities: acceleration and steering.
_BY_SPEED = {"AckermannDrive", "AckermannDriveStamped"}
#: Fields of the others, in which every number is a velocity.
_TWIST = {"linear", "angular", "twist"}
_VELOCITY_TOPIC = "cmd_vel"

#: Seconds of a client's silence, or of a command's age, that are long for a robot that moves.
_LONG = 10.0

_EXAMPLE = "on_silence: {after: 500 ms}"


def commands(settings: Settings) -> Iterator[Finding]:
    """Findings about routes that can be made without their message types."""
    for route in settings.bridge.topics:
        if route.is_exclusion or route.to == "mqtt":
            continue
        subject = f"route {', '.join(route.names)}"
        moves = _moves(route)
        if "lease" in route.model_fields_set and not route.exclusive:
            text = "lease has no effect without exclusive: true beside it"
            yield Finding("warning", subject, text)
        if moves and route.on_silence is None:
            text = (
                "it seems to drive the robot, and nothing stops that when its driver falls silent "
                f"or is gone; add: {_EXAMPLE}"
            )
            yield Finding("warning", subject, text)
            if route.expire is None:
                text = "it carries out commands however old they are; add: expire: 500 ms"
                yield Finding("warning", subject, text)
        for key, seconds in _long(route):
            yield Finding("warning", subject, f"{key}: the robot may drive on for {seconds:g} s")
        if moves and route.on_silence is not None:
            yield from _driving_stop(route, route.on_silence.publish, subject)


def stop_message(rules: CommandRules, converter: Converter) -> str:
    """Why the route's own limits change or reject its stop message; empty when they do not."""
    if rules.on_silence is None:
        return ""
    try:
        limits, stop = check_rules(rules, converter)
        if limits is None or stop is None:
            return ""
        _, has_changed = limits.apply(stop.example)
    except ConversionError as error:
        problem = str(error)
    else:
        problem = "it would be changed" if has_changed else ""
    if not problem:
        return ""
    return (
        f"clamp or allow is against the route's own stop message ({problem}), which is published "
        "as it is, also for clients that send it"
    )


def _moves(route: TopicRoute) -> bool:
    if route.type is not None and "*" not in route.type:
        return route.type.rpartition("/")[2] in _VELOCITIES
    return any(name.rpartition("/")[2] == _VELOCITY_TOPIC for name in route.names)


def _long(route: TopicRoute) -> Iterator[tuple[str, float]]:
    if route.on_silence is not None and route.on_silence.after > _LONG:
        yield "on_silence.after", route.on_silence.after
    if route.expire is not None and route.expire > _LONG and _moves(route):
        yield "expire", route.expire


def _driving_stop(route: TopicRoute, stop: object, subject: str) -> Iterator[Finding]:
    """A finding if the stop message of a route that drives the robot is not standstill."""
    name = "" if route.type is None else route.type.rpartition("/")[2]
    if name in _BY_SPEED:
        # How hard it brakes and where the wheels point is no motion.
        drive = stop.get("drive") if isinstance(stop, dict) and "Stamped" in name else stop
        speed = drive.get("speed") if isinstance(drive, dict) else None
        if _is_motion(speed):
            text = "on_silence.publish: this stop message drives: its speed is not 0"
            yield Finding("error", subject, text)
    elif _is_motion(stop):
        text = "on_silence.publish: this stop message drives: its numbers are not all 0"
        is_twist = name in _VELOCITIES or (isinstance(stop, dict) and _TWIST.intersection(stop))
        yield Finding("error" if is_twist else "warning", subject, text)


def _is_motion(value: object) -> bool:
    """Whether the value has a number other than 0, outside of its header."""
    if isinstance(value, dict):
        return any(_is_motion(part) for name, part in value.items() if name != "header")
    if isinstance(value, list):
        return any(map(_is_motion, value))
    return isinstance(value, (int, float)) and value != 0
