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
    """The routes of topics."""
    return [
        route.build(
            TopicSettings,
            ros=route.names[0] if len(names) == 1 else names,
            mqtt=route.topic(settings.robot),
            fields=tuple(route.fields),
            limits=_input_limits(settings),
            rules=_command_rules(route) if route.command_keys else None,
        )
        for route, names in _named(settings.bridge.topics)
    ]


def call_routes(settings: Settings) -> CallRoutes:
    """The routes of services, actions and parameters, and the limits on calls."""
    bridge, robot = settings.bridge, settings.robot
    return CallRoutes(
        services=tuple(
            route.build(
                ServiceSettings,
                names=names,
                mqtt=route.topic(robot),
                on_error=None if route.on_error is None else json.dumps(route.on_error),
            )
            for route, names in _named(bridge.services)
        ),
        actions=tuple(
            route.build(ActionSettings, names=names, mqtt=route.topic(robot))
            for route, names in _named(bridge.actions)
        ),
        parameters=tuple(
            route.build(ParameterSettings, names=names, mqtt=route.topic(robot))
            for route, names in _named(bridge.parameters)
        ),
        limits=CallLimits(
            client=bridge.limits.calls_per_client,
            total=bridge.limits.calls,
            user=bridge.limits.calls_per_user,
            input=_input_limits(settings),
        ),
    )


def _input_limits(settings: Settings) -> InputLimits:
    limits = settings.bridge.limits
    return limits.build(InputLimits, packet=settings.broker.limits.packet_size)


def _named(routes: Sequence[RouteT]) -> Iterator[tuple[RouteT, tuple[str, ...]]]:
    """Each route with its names; patterns also get the exclusions of their section."""
    left_out = [name for route in routes if route.is_exclusion for name in route.names]
    for route in routes:
        if not route.is_exclusion:
            has_pattern = any("*" in name for name in route.names)
            yield route, (*route.names, *left_out) if has_pattern else route.names


def _command_rules(route: TopicRoute) -> CommandRules:
    silence = route.on_silence
    return route.build(
        CommandRules,
        on_silence=silence and silence.build(OnSilence, publish=json.dumps(silence.publish)),
        clamp=tuple((path, low, high) for path, (low, high) in route.clamp.items()),
        allow=tuple((path, tuple(values)) for path, values in route.allow.items()),
    )
