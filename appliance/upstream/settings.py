"""The links of an appliance, from `upstreams` in appliance.yaml."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from appliance.config import Settings, TopicRoute, UpstreamSection
from appliance.config.settings import InSection, ProfileSection
from appliance.mqtt.codec import V5, V311
from appliance.upstream.rules import (
    BacklogLimits,
    CallTopics,
    CommandTopics,
    InRule,
    OutRule,
    RosTopics,
    UpstreamLogin,
    UpstreamSettings,
    UpstreamTls,
    Vehicle,
)


def upstreams(settings: Settings) -> list[UpstreamSettings]:
    """The links, in the order of the file."""
    ros = RosTopics(tuple(command_topics(settings)), tuple(call_topics(settings)))
    return [_upstream(section, settings.robot, ros) for section in settings.upstreams]


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


def call_topics(settings: Settings) -> Iterator[CallTopics]:
    """The topics of calls to ROS, with their timeouts. Cancellations never expire."""
    bridge = settings.bridge
    if bridge.bus == "none":
        return
    robot = settings.robot
    for service in bridge.services:
        if service.to == "ros":
            for name in _included(service.names):
                yield CallTopics(_below(service.mqtt, robot, name, "_call"), service.timeout)
    for action in bridge.actions:
        for name in _included(action.names):
            yield CallTopics(_below(action.mqtt, robot, name, "_goal"), action.timeout)
    for route in bridge.parameters:
        for name in _included(route.names):
            node = name.rpartition("/")[0]
            yield CallTopics(_below(route.mqtt, robot, node, "#"), route.timeout)


def _included(names: Sequence[str]) -> list[str]:
    return [name for name in names if not name.startswith("!")]


def _below(template: str, robot: str, name: str, call: str) -> str:
    """The filter for a call below a ROS name, and for the token that MQTT 3.1.1 clients append."""
    topic = template.replace("{robot}", robot)
    for part in ("{ros}", "{node}"):
        topic = topic.replace(part, _ros_filter(name))
    return _filter(f"{topic}/{call}/#")


def command_filters(route: TopicRoute, robot: str) -> list[str]:
    """Filters of the topics that the route takes; what it leaves out is among them."""
    topic = route.topic(robot)
    names = _included(route.names)
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


def _upstream(section: UpstreamSection, robot: str, ros: RosTopics) -> UpstreamSettings:
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
                late=_late(rule, robot, ros),
                judged_by=ros.judged_by(rule.local_filter(robot)),
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


def _late(rule: InSection, robot: str, ros: RosTopics) -> float | None:
    if rule.late is not None:
        return rule.late
    if rule.offline == "keep":  # what has been queued while the link was down is late on purpose
        return None
    return ros.default_late(rule.local_filter(robot))
