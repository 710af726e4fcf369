"""Retained messages of routes that there are no more: nobody would ever take them back."""

from __future__ import annotations

import re
from collections.abc import Iterable

from appliance.broker.message import Message
from appliance.mqtt.codec import Property
from appliance.ros.calls.routes import CallRoutes
from appliance.ros.patterns import Names
from appliance.ros.topics.flow import TopicSettings

_OF_ACTION = re.compile(r"/(_status|_result/[^/]+)\Z")
_PARAMETER = "/_param/"


def is_of_route(message: Message) -> bool:
    """Whether a message that the appliance has retained came over a route, once."""
    if "/_appliance/" in message.topic:
        return False
    told = (message.properties or {}).get(Property.USER_PROPERTY, [])
    entries = told if isinstance(told, list) else []
    names = [entry[0] for entry in entries if isinstance(entry, tuple)]
    return "ros-type" in names or _PARAMETER in message.topic


class TopicOwners:
    """The routes that there are now, and which topics may still be theirs."""

    def __init__(self, routes: Iterable[TopicSettings], calls: CallRoutes) -> None:
        self._topics = [
            _Template(route.mqtt, "{ros}", route.names)
            for route in routes
            if route.to != "ros" and route.retain is not False
        ]
        self._actions = [_Template(route.mqtt, "{ros}", route.names) for route in calls.actions]
        self._parameters = [
            (_Template(route.mqtt, "{node}"), Names(route.names)) for route in calls.parameters
        ]

    def has(self, topic: str) -> bool:
        """Whether it may be the topic of a route, be its ROS node there or not."""
        if any(template.name(topic) is not None for template in self._topics):
            return True
        above, is_action = _OF_ACTION.subn("", topic)
        if is_action and any(template.name(above) is not None for template in self._actions):
            return True
        base, _, parameter = topic.rpartition("/")
        for template, names in self._parameters:
            node = template.name(base)
            if node is not None and f"{node.rstrip('/')}/{parameter}" in names:
                return True
        return False


class _Template:
    """The MQTT topic of a route, in which a placeholder may stand for the ROS name."""

    def __init__(self, template: str, placeholder: str, names: tuple[str, ...] = ()) -> None:
        self._pattern = re.compile(re.escape(template).replace(re.escape(placeholder), "(.*)"))
        self._names = Names(names) if names else None
        self._only = names[0] if len(names) == 1 and "*" not in names[0] else None

    def name(self, topic: str) -> str | None:
        """The ROS name that the topic is for; None when it is of another route."""
        match = self._pattern.fullmatch(topic)
        if match is None:
            return None
        name = match[1] if match.re.groups else self._only or ""
        is_one = self._names is None or not match.re.groups or name in self._names
        return name if is_one else None
