"""What each part is told of appliance.yaml."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from appliance.amqtt_broker import plugin_kinds
from appliance.broker.ports import Features, Limits, UserLimits
from appliance.certs import TlsContexts
from appliance.certs.settings import listener_name, tls_files, tls_policies
from appliance.config import Route, Settings, TopicRoute
from appliance.listeners import Admission, ListenerSettings
from appliance.ros.bridge import RouteSettings
from appliance.ros.graph import (
    ActionSettings,
    CallLimits,
    CallRoutes,
    ParameterSettings,
    ServiceSettings,
)
from appliance.ros.payloads import InputLimits
from appliance.ros.rules import CommandRules, OnSilence

RouteT = TypeVar("RouteT", bound=Route)


def access_files(settings: Settings) -> tuple[Path | None, Path | None]:
    """The users file and the ACL file; None where plugins do its work and it is missing."""
    broker = settings.broker
    authenticating, ruling = plugin_kinds(broker.plugins)
    return (
        None if authenticating and not broker.users.exists() else broker.users,
        None if ruling and not broker.acl.exists() else broker.acl,
    )


def broker_limits(settings: Settings) -> Limits:
    """What a client can make grow."""
    limits = settings.broker.limits
    return Limits(
        connections=limits.connections,
        packet_size=limits.packet_size,
        memory=limits.memory,
        queue_messages=limits.queue_messages,
        queue_bytes=limits.queue_bytes,
        queue_full=limits.queue_full,
        keep=0 if limits.keep == "latest" else limits.keep,
        inflight=limits.inflight,
        sessions=limits.sessions,
        subscriptions=limits.subscriptions,
        client_id_length=limits.client_id_length,
        topic_length=limits.topic_length,
        topic_levels=limits.topic_levels,
        retained_messages=limits.retained_messages,
        retained_bytes=limits.retained_bytes,
        session_expiry=round(limits.session_expiry),
        topic_alias=limits.topic_alias,
        user_properties=limits.user_properties,
        keep_alive=round(limits.keep_alive),
        user=UserLimits(**dict(limits.user)),
    )


def features(settings: Settings) -> Features:
    """What the standard leaves to the operator."""
    return Features(
        check_payload_format=settings.broker.check_payload_format,
        reason_strings=settings.broker.reason_strings,
        response_information=settings.broker.response_information or "",
    )


def admission(settings: Settings) -> Admission:
    """How many clients may come, and how fast."""
    limits = settings.broker.limits
    return Admission(
        limits.connections,
        limits.connect_timeout,
        limits.connections_per_address,
        limits.connection_rate,
        limits.publish_rate,
    )


def tls(settings: Settings) -> TlsContexts | None:
    """The TLS of the listeners, by their place in the configuration; None when none has it.

    Raises:
        CertificateError: a file is missing or wrong.
    """
    broker = settings.broker
    policies = tls_policies(broker)
    if not policies:
        return None
    return TlsContexts(tls_files(broker), policies, broker.tls.username_from)


def listener_settings(settings: Settings, tls: TlsContexts | None) -> list[ListenerSettings]:
    """Where is listened, with the TLS that holds when a client comes."""
    return [
        ListenerSettings(
            listener.bind.host,
            listener.bind.port,
            tls.source(listener_name(index)) if listener.tls and tls else None,
            listener.protocol,
            listener.bind.path,
            listener.mode,
            listener.anonymous,
        )
        for index, listener in enumerate(settings.broker.listeners)
    ]


def routes(settings: Settings) -> list[RouteSettings]:
    """The ways between ROS and MQTT."""
    return [
        RouteSettings(
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
