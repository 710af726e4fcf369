"""Deletes retained messages of routes that were removed: nobody else ever would."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Property
from appliance.net.callbacks import Entries
from appliance.ros.calls.routes import CallRoutes
from appliance.ros.home_assistant import Shown, shown_by
from appliance.ros.patterns import Names
from appliance.ros.topics.route import TopicSettings

log = logging.getLogger(__name__)

_OF_ACTION = re.compile(r"/(_status|_result/[^/]+)\Z")
_PARAMETER = "/_param/"


def is_of_route(message: Message) -> bool:
    """Whether a message that the appliance has retained came from a route."""
    if "/_appliance/" in message.topic:
        return False
    pairs = (message.properties or {}).get(Property.USER_PROPERTY, [])
    entries = pairs if isinstance(pairs, list) else []
    names = [entry[0] for entry in entries if isinstance(entry, tuple)]
    return "ros-type" in names or _PARAMETER in message.topic


class TopicOwners:
    """Knows which topics the present routes may publish on."""

    def __init__(
        self, routes: Sequence[TopicSettings], calls: CallRoutes, home_assistant: bool = False
    ) -> None:
        """`home_assistant`: whether it is told of the routes."""
        self._topics = [
            _Template(route.mqtt, "{ros}", route.names)
            for route in routes
            if route.to != "ros" and route.retain is not False
        ]
        self._actions = [_Template(route.mqtt, "{ros}", route.names) for route in calls.actions]
        self._parameters = [
            (_Template(route.mqtt, "{node}"), Names(route.names)) for route in calls.parameters
        ]
        #: Of what Home Assistant has entities, by whether it is a service.
        self._shown: dict[bool, list[_Template]] = {False: [], True: []}
        if home_assistant:
            self._shown = {
                False: [_Template(r.mqtt, "{ros}", r.names) for r in routes if r.to != "ros"],
                True: [
                    _Template(r.mqtt, "{ros}", r.names) for r in calls.services if r.to == "ros"
                ],
            }

    def has(self, topic: str) -> bool:
        """Whether it may be the topic of a route, whether or not its ROS node is there."""
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

    def has_entity(self, shown: Shown) -> bool:
        """Whether Home Assistant may have an entity of it."""
        return any(each.name(shown.topic) is not None for each in self._shown[shown.is_service])


class RetainedCleanup:
    """Deletes the retained messages that no route owns any more; for the loop's thread.

    The retained messages are gone through in steps, so that other callbacks have their turn.
    """

    def __init__(self, broker: Broker, entries: Entries) -> None:
        self._broker = broker
        self._entries = entries
        self._owners: TopicOwners | None = None

    def start(self, session: Session, owners: TopicOwners) -> None:
        """Delete what is not theirs; a cleanup that is still going on for other owners ends."""
        self._owners = owners
        self._step(session, owners, self._broker.retained.find_in_steps("#"), 0)

    def stop(self) -> None:
        """Delete nothing any more."""
        self._owners = None

    def _step(
        self,
        session: Session,
        owners: TopicOwners,
        steps: Iterator[tuple[str, Message] | None],
        count: int,
    ) -> None:
        if owners is not self._owners:  # the routes have changed again
            return
        retained = self._broker.retained
        orphans = []
        has_more = False
        for found in steps:
            if found is None:
                has_more = True
                break
            topic, message = found
            if not retained.owner(topic).is_inside:
                continue
            shown = shown_by(message)
            if shown is not None:
                is_orphan = not owners.has_entity(shown)
            else:
                is_orphan = is_of_route(message) and not owners.has(topic)
            if is_orphan:
                orphans.append(topic)
        for topic in orphans:  # not while iterating over the retained messages
            self._broker.publish(Message(topic, b"", 0, True), session)
        count += len(orphans)
        if has_more:
            self._entries.soon("bridge.sweep", self._step, session, owners, steps, count)
        elif count:
            log.info("retained messages of routes that are gone, taken back: %d", count)
        self._broker.flush()


class _Template:
    """The MQTT topic of a route, in which a placeholder may stand for the ROS name."""

    def __init__(self, template: str, placeholder: str, names: tuple[str, ...] = ()) -> None:
        self._pattern = re.compile(re.escape(template).replace(re.escape(placeholder), "(.*)"))
        self._names = Names(names) if names else None
        self._only = names[0] if len(names) == 1 and "*" not in names[0] else None

    def name(self, topic: str) -> str | None:
        """The ROS name that the topic is for; None when it belongs to another route."""
        match = self._pattern.fullmatch(topic)
        if match is None:
            return None
        name = match[1] if match.re.groups else self._only or ""
        is_one = self._names is None or not match.re.groups or name in self._names
        return name if is_one else None
