"""The links of an appliance, from `upstreams` in appliance.yaml."""

from __future__ import annotations

import math
from collections.abc import Iterator

from appliance.config import Settings, TopicRoute, UpstreamSection
from appliance.config.settings import InSection, ProfileSection
from appliance.mqtt.codec import V5, V311
from appliance.upstream.rules import (
    BacklogLimits,
    CommandTopics,
    InRule,
    OutRule,
    UpstreamLogin,
    UpstreamSettings,
    UpstreamTls,
    Vehicle,
    default_late,
)


def upstreams(settings: Settings) -> list[UpstreamSettings]:
    """The links, in the order of the file."""
    commands = list(command_topics(settings))
    return [_upstream(section, settings.robot, commands) for section in settings.upstreams]


def command_topics(settings: Settings) -> Iterator[CommandTopics]:
    """The topics of routes to ROS, with the times after which commands are old."""
    if settings.bridge.bus == "none":
        return
    for route in settings.bridge.topics:
        if route.is_exclusion or route.to == "mqtt":
            continue
        silence = None if route.on_silence is None else route.on_silence.after
        for filter in command_filters(route, settings.robot):
            yield CommandTopics(filter, route.expire, silence)


def command_filters(route: TopicRoute, robot: str) -> list[str]:
    """Filters of the topics that the route takes; what it leaves out is among them."""
    topic = route.topic(robot)
    names = [name for name in route.names if not name.startswith("!")]
    return [_filter(topic.replace("{ros}", _ros_filter(name))) for name in names]


def _ros_filter(name: str) -> str:
    """A ROS name or pattern with MQTT's wildcards: `**` may be any number of parts."""
    return name.replace("**", "#").replace("*", "+")


def _filter(topic: str) -> str:
    """A valid filter for a topic with wildcards anywhere, which matches at least as much."""
    levels: list[str] = []
    for level in topic.split("/"):
        if "#" in level:
            return "/".join([*levels, "#"])
        levels.append("+" if "+" in level else level)
    return "/".join(levels)


def _upstream(
    section: UpstreamSection, robot: str, commands: list[CommandTopics]
) -> UpstreamSettings:
    def named(text: str) -> str:
        return text.replace("{robot}", robot)

    login, tls = section.login, section.tls
    username = None if login.username is None else named(login.username)
    return section.build(
        UpstreamSettings,
        robot=robot,
        servers=tuple(section.servers),
        version=V5 if section.version == "5" else V311,
        client_id=named(section.client_id),
        prefix=named(section.prefix),
        login=login.build(UpstreamLogin, username=username),
        tls=tls.build(UpstreamTls, alpn=tuple(tls.alpn)),
        keep_alive=math.ceil(section.keep_alive),
        backlog=section.backlog.build(BacklogLimits),
        out=tuple(
            rule.build(
                OutRule,
                local_prefix=named(rule.local_prefix),
                remote_prefix=rule.prefix_there(robot, section.prefix),
            )
            for rule in section.out
        ),
        inward=tuple(
            rule.build(
                InRule,
                local_prefix=named(rule.local_prefix),
                remote_prefix=rule.prefix_there(robot, section.prefix),
                late=_late(rule, robot, commands),
            )
            for rule in section.inward
        ),
        vehicle=None if section.profile is None else _vehicle(section.profile, robot),
    )


def _vehicle(profile: ProfileSection, robot: str) -> Vehicle:
    said = profile.vda5050
    return Vehicle(
        said.version if said.version.count(".") == 2 else f"{said.version}.0",
        said.manufacturer.replace("{robot}", robot),
        said.serial_number.replace("{robot}", robot),
    )


def _late(rule: InSection, robot: str, commands: list[CommandTopics]) -> float | None:
    if rule.late is not None:
        return rule.late
    if rule.offline == "keep":  # what has been queued while the link was down is late on purpose
        return None
    return default_late(rule.local_filter(robot), commands)
