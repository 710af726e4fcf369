"""The routes of the bridge, from `bridge` in appliance.yaml."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import TypeVar

from appliance.config import Route, Settings, TopicRoute
from appliance.ros.bridge import TopicSettings
from appliance.ros.calls.routes import (
    ActionSettings,
    CallLimits,
    CallRoutes,
    ParameterSettings,
    ServiceSettings,
)
from appliance.ros.payload.payloads import InputLimits
from appliance.ros.topics.rules import CommandRules, OnSilence

RouteT = TypeVar("RouteT", bound=Route)


def routes(settings: Settings) -> list[TopicSettings]:
    """The ways between ROS and MQTT."""
    return [
        TopicSettings(
            ros=route.names[0] if len(names) == 1 else names,
            to=route.to,
            mqtt=route.topic(settings.robot),
            type=route.type,
            encoding=route.encoding,
            rate=route.rate,
            qos=route.qos,
            retain=route.retain,
            keep=route.keep,
            compression=route.compression,
            fields=tuple(route.fields),
            bytes_per_second=route.bytes_per_second,
            limits=_input_limits(settings),
            rules=_command_rules(route) if route.command_keys else None,
        )
        for route, names in _named(settings.bridge.topics)
    ]


def call_routes(settings: Settings) -> CallRoutes:
    """The services, actions and parameters that are called, and how many at a time."""
    bridge, robot = settings.bridge, settings.robot
    return CallRoutes(
        services=tuple(
            ServiceSettings(
                names=names,
                mqtt=route.topic(robot),
                to=route.to,
                type=route.type,
                timeout=route.timeout,
                encoding=route.encoding,
                on_error=None if route.on_error is None else json.dumps(route.on_error),
            )
            for route, names in _named(bridge.services)
        ),
        actions=tuple(
            ActionSettings(
                names=names,
                mqtt=route.topic(robot),
                type=route.type,
                timeout=route.timeout,
                encoding=route.encoding,
                keep_result=route.keep_result,
                cancel=route.cancel,
                cancel_on_disconnect=route.cancel_on_disconnect,
            )
            for route, names in _named(bridge.actions)
        ),
        parameters=tuple(
            ParameterSettings(
                names=names,
                mqtt=route.topic(robot),
                timeout=route.timeout,
                encoding=route.encoding,
            )
            for route, names in _named(bridge.parameters)
        ),
        limits=CallLimits(
            bridge.limits.calls_per_client,
            bridge.limits.calls,
            bridge.limits.calls_per_user,
            _input_limits(settings),
        ),
    )


def _input_limits(settings: Settings) -> InputLimits:
    limits = settings.bridge.limits
    return InputLimits(limits.payload, settings.broker.limits.packet_size, limits.items)


def _named(routes: Sequence[RouteT]) -> Iterator[tuple[RouteT, tuple[str, ...]]]:
    """The routes that want something, and their names; with what the section leaves out."""
    left_out = [name for route in routes if route.is_exclusion for name in route.names]
    for route in routes:
        if not route.is_exclusion:
            has_pattern = any("*" in name for name in route.names)
            yield route, (*route.names, *left_out) if has_pattern else route.names


def _command_rules(route: TopicRoute) -> CommandRules:
    silence = route.on_silence
    return CommandRules(
        expire=route.expire,
        take_retained=route.take_retained,
        exclusive=route.exclusive,
        lease=route.lease,
        on_silence=OnSilence(silence.after, json.dumps(silence.publish), silence.disconnect)
        if silence
        else None,
        clamp=tuple((path, low, high) for path, (low, high) in route.clamp.items()),
        allow=tuple((path, tuple(values)) for path, values in route.allow.items()),
    )
