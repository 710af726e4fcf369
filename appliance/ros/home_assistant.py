"""Tells Home Assistant what is bridged, so that its entities are there without being configured.

Each entity is a retained message of its own below `homeassistant/`, in the form that its MQTT
integration reads: https://www.home-assistant.io/integrations/mqtt/#mqtt-discovery

What an entity shows is read from the messages that the bridge publishes anyway. So only topics that
carry JSON, text or pictures have entities. The templates are constants: no name and no value of ROS
becomes a part of one.

Home Assistant forgets an entity, and what its user has made of it, when its message is deleted. So
that stays while a node is away, and is deleted when no route can be its own any more:
`retained_cleanup` does that.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple, cast

import orjson

from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Properties, Property
from appliance.ros.payload.encodings.registry import CONTENT_TYPE
from appliance.ros.topics.route import BridgedTopic, TopicSettings

log = logging.getLogger(__name__)

#: In front of all topics, as Home Assistant has it if nobody changes it.
PREFIX: Final = "homeassistant"

#: The topics of entities.
FILTER: Final = f"{PREFIX}/+/+/+/config"

#: Entities that are retained, those of topics that are away included: a robot may have thousands
#: of topics, or change their names, and Home Assistant subscribes to each.
MOST: Final = 1000

#: Entities that are made in one turn of the event loop: less than a millisecond.
TURN: Final = 25

#: The user property that names the topic of the route that an entity is for.
_OF: Final = "bridged-at"

#: Names as ROS 2 allows them; the Master of ROS 1 takes any.
_NAME: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_LONGEST_NAME: Final = 247

#: The end of the topic of calls: Home Assistant sends no Response Topic, see docs/calls.md.
_CALLER: Final = "homeassistant"


class _Reading(NamedTuple):
    """What an entity reads of a message: `template` of one in JSON, `text` of one in text.

    `part` tells the entities of one topic apart; the first has none. `needs` are the fields that
    the templates read, and `extra` is what Home Assistant has to know beside them.
    """

    component: str
    needs: tuple[str, ...]
    template: str
    extra: Mapping[str, object]
    part: str = ""
    text: str = ""


def _number(
    field: str, unit: str = "", device_class: str = "", part: str = "", percent: bool = False
) -> _Reading:
    """A sensor that shows a number; a fraction is shown in percent."""
    value = f"value_json.{field}"
    shown = f"({value} * 100) | round(1)" if percent else value
    named = {"unit_of_measurement": unit, "device_class": device_class}
    extra = {"state_class": "measurement", **{key: name for key, name in named.items() if name}}
    template = f"{{{{ {shown} if {value} is number else None }}}}"
    text = template.replace(value, "value_json") if field == "data" else ""
    return _Reading("sensor", (field,), template, extra, part, text)


def _flag(
    field: str, condition: str, device_class: str = "", part: str = "", **extra: object
) -> _Reading:
    """A binary sensor that is on while the condition holds for the field."""
    value = f"value_json.{field}"
    template = f"{{{{ 'ON' if {value}{condition} else 'OFF' }}}}"
    named = {"device_class": device_class} if device_class else {}
    text = template.replace(value, "value_json") if field == "data" else ""
    return _Reading("binary_sensor", (field,), template, {**named, **extra}, part, text)


_PLAIN: Final = (_number("data"),)

#: Seconds without an error after which a robot whose nodes publish diagnostics has no problem.
_OFF_DELAY: Final = 15

#: The types that have a counterpart in Home Assistant.
_READINGS: Final[Mapping[str, tuple[_Reading, ...]]] = {
    "sensor_msgs/BatteryState": (
        _number("percentage", "%", "battery", percent=True),
        _number("voltage", "V", "voltage", "voltage"),
        _flag("power_supply_status", " == 1", "battery_charging", "charging"),
    ),
    "sensor_msgs/Temperature": (_number("temperature", "°C", "temperature"),),
    "sensor_msgs/RelativeHumidity": (_number("relative_humidity", "%", "humidity", percent=True),),
    "sensor_msgs/FluidPressure": (_number("fluid_pressure", "Pa", "pressure"),),
    "sensor_msgs/Illuminance": (_number("illuminance", "lx", "illuminance"),),
    "sensor_msgs/Range": (_number("range", "m", "distance"),),
    "sensor_msgs/NavSatFix": (
        _Reading(
            "device_tracker",
            ("latitude", "longitude"),
            # Without a fix it stays where it was last.
            "{{ {'latitude': value_json.latitude, 'longitude': value_json.longitude} | tojson "
            "if value_json.latitude is number and value_json.longitude is number else '{}' }}",
            {"source_type": "gps"},
        ),
    ),
    "diagnostic_msgs/DiagnosticStatus": (
        _flag("level", " >= 2", "problem", entity_category="diagnostic"),
    ),
    # Each node tells its own: one without an error says nothing of the others.
    "diagnostic_msgs/DiagnosticArray": (
        _Reading(
            "binary_sensor",
            ("status",),
            "{{ 'ON' if value_json.status | selectattr('level', 'ge', 2) | list "
            "else 'OFF' if this is defined and this.state == 'unknown' else '' }}",
            {
                "device_class": "problem",
                "entity_category": "diagnostic",
                "off_delay": _OFF_DELAY,
            },
        ),
    ),
    "std_msgs/Bool": (_flag("data", ""),),
    "std_msgs/String": (
        # Home Assistant refuses longer states.
        _Reading("sensor", ("data",), "{{ value_json.data[:255] }}", {}, text="{{ value[:255] }}"),
    ),
    **{
        f"std_msgs/{name}": _PLAIN
        for name in (
            *("Float32", "Float64", "Int8", "Int16", "Int32", "Int64"),
            *("UInt8", "UInt16", "UInt32", "UInt64"),
        )
    },
}

#: What else a configuration of an entity has, by the type of a service.
_SERVICES: Final[Mapping[str, tuple[str, Mapping[str, object]]]] = {
    # Nothing tells in which state it is: Home Assistant shows what was said last.
    "std_srvs/SetBool": (
        "switch",
        {"payload_on": '{"data":true}', "payload_off": '{"data":false}', "optimistic": True},
    ),
    "std_srvs/Trigger": ("button", {"payload_press": "{}"}),
    "std_srvs/Empty": ("button", {"payload_press": "{}"}),
}

#: The components of services; all others are those of topics.
_OF_SERVICES: Final = frozenset(component for component, _ in _SERVICES.values())

#: Encodings whose payload is a picture, and the type of the message where it has to be one.
_PICTURES: Final = {"jpeg": None, "png": None, "binary": "sensor_msgs/CompressedImage"}


class Shown(NamedTuple):
    """What an entity is for: a service or a topic to MQTT, and the topic of its route. Both may
    have the same."""

    is_service: bool
    topic: str


def entities_of_topic(
    robot: str, topic: BridgedTopic, settings: TopicSettings
) -> Iterator[tuple[str, dict[str, object]]]:
    """The topic and the configuration of each entity that shows something of a bridged topic."""
    if topic.direction != "to_mqtt" or settings.compression != "none" or not _is_name(topic.ros):
        return
    kind = _without_kind(topic.type)
    if topic.encoding in _PICTURES:
        if _PICTURES[topic.encoding] in (None, kind):
            yield _entity(robot, "camera", topic.ros, "", {"topic": topic.mqtt})
        return
    if topic.encoding not in ("json", "text"):
        return
    for reading in _READINGS.get(kind, ()):
        template = reading.template if topic.encoding == "json" else reading.text
        if not template or not _are_in(settings.fields, reading.needs):
            continue
        if reading.component == "device_tracker":
            shown = {"json_attributes_topic": topic.mqtt, "json_attributes_template": template}
        else:
            shown = {"state_topic": topic.mqtt, "value_template": template}
        own = {**shown, **reading.extra}
        yield _entity(robot, reading.component, topic.ros, reading.part, own)


def entities_of_call(
    robot: str, call: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, object]]]:
    """The same for an entry of `{robot}/_appliance/routes` that is a service."""
    found = _SERVICES.get(_without_kind(call["type"]))
    if call["direction"] != "service" or call["encoding"] != "json" or found is None:
        return
    if not _is_name(call["ros"]):
        return
    component, extra = found
    command = {"command_topic": f"{call['mqtt']}/{_CALLER}", "qos": 1, **extra}
    yield _entity(robot, component, call["ros"], "", command)


def shown_by(message: Message) -> Shown | None:
    """What a retained message is an entity of; None if it is none."""
    prefix, _, rest = message.topic.partition("/")
    if prefix != PREFIX:
        return None
    pairs = (message.properties or {}).get(Property.USER_PROPERTY, [])
    topic = dict(cast("list[tuple[str, str]]", pairs)).get(_OF)
    return None if topic is None else Shown(rest.partition("/")[0] in _OF_SERVICES, topic)


class HomeAssistant:
    """Publishes the entities of what is bridged; for the loop's thread."""

    def __init__(self, broker: Broker, robot: str, is_on: bool) -> None:
        self._broker = broker
        self._robot = robot
        self._is_on = is_on
        #: What the entities were made of that were published last.
        self._made_of: object = None
        #: Counts changes of what is wanted: what was being published then is outdated.
        self._changes = 0
        self._is_following = False
        self._has_told = False

    @property
    def is_on(self) -> bool:
        """Whether it is told of anything."""
        return self._is_on

    def use(self, is_on: bool) -> None:
        """Whether from the next announcement on; `retained_cleanup` deletes what is not wanted."""
        if is_on != self._is_on:
            self._is_on = is_on
            self._changes += 1
            self._made_of = None

    def routes_change(self) -> None:
        """Routes were replaced: tell nothing of what is bridged until it is by the new ones."""
        self._is_following = True
        self._changes += 1

    def routes_followed(self) -> None:
        """What is bridged is by the new routes now."""
        self._is_following = False

    def work(
        self,
        topics: Iterable[tuple[BridgedTopic, TopicSettings]],
        calls: Iterable[Mapping[str, Any]],
        session: Session,
    ) -> Iterator[None]:
        """Publish the entities of all that is bridged where they have changed, turn by turn."""
        if not self._is_on or self._is_following:
            return
        topics = list(topics)
        services = [call for call in calls if call["direction"] == "service"]
        made_of = (topics, services)
        if made_of == self._made_of:
            return
        changes = self._changes
        wanted: dict[str, tuple[str, bytes]] = {}
        for count, (of, topic, config) in enumerate(self._entities(topics, services), 1):
            wanted[topic] = of, orjson.dumps(config)
            if not count % TURN:
                yield
        if len(wanted) > MOST and not self._has_told:
            self._has_told = True
            log.warning("Home Assistant is told of %d entities of %d", MOST, len(wanted))
        for topic in [*wanted][MOST:]:
            del wanted[topic]
        there = {Shown(False, topic.mqtt) for topic, _ in topics if topic.direction == "to_mqtt"}
        there |= {Shown(True, _base(service)) for service in services}
        yield from self._delete_others(wanted, there, session)
        is_all = True
        for count, (topic, (of, payload)) in enumerate(wanted.items(), 1):
            if not count % TURN:
                yield
            if changes != self._changes:  # what there was may be deleted already
                return
            is_all &= self._tell(topic, of, payload, session)
        # What there was no room for is tried again, with the next announcement.
        self._made_of = made_of if is_all else None

    def _tell(self, topic: str, of: str, payload: bytes, session: Session) -> bool:
        """Retain an entity, unless it is; returns whether it is now."""
        retained = self._broker.retained
        before = retained.get(topic)
        # Somebody else's with the same payload would not be deleted with the route.
        if before is not None and before.payload == payload and retained.owner(topic).is_inside:
            return True
        message = Message(topic, payload, 0, True, _properties(of))
        return self._broker.publish(message, session) < 0x80

    def _entities(
        self,
        topics: Iterable[tuple[BridgedTopic, TopicSettings]],
        services: Iterable[Mapping[str, Any]],
    ) -> Iterator[tuple[str, str, dict[str, object]]]:
        for bridged, settings in topics:
            for topic, config in entities_of_topic(self._robot, bridged, settings):
                yield bridged.mqtt, topic, config
        for service in services:
            for topic, config in entities_of_call(self._robot, service):
                yield _base(service), topic, config

    def _delete_others(
        self, wanted: Mapping[str, object], there: set[Shown], session: Session
    ) -> Iterator[None]:
        """Delete the entities of what is there now that are not wanted: its type is another one.

        What is away keeps its entities, as long as there are not too many. Others may retain any
        number of messages there, so they are gone through in steps.
        """
        retained = self._broker.retained
        others: list[str] = []
        away: list[str] = []
        for found in retained.find_in_steps(FILTER):
            if found is None:
                yield
                continue
            topic, message = found
            # Whose it is comes first: properties of others are not looked through.
            if topic in wanted or not retained.owner(topic).is_inside:
                continue
            shown = shown_by(message)
            if shown is not None:
                (others if shown in there else away).append(topic)
        others += away[: max(0, len(wanted) + len(away) - MOST)]
        for topic in others:  # not while iterating over the retained messages
            if retained.get(topic) is not None and retained.owner(topic).is_inside:
                self._broker.publish(Message(topic, b"", 0, True), session)


def _base(service: Mapping[str, Any]) -> str:
    """The topic of a service's route."""
    return str(service["mqtt"]).removesuffix("/_call")


def _properties(of: str) -> Properties:
    return {
        Property.CONTENT_TYPE: CONTENT_TYPE["json"],
        Property.USER_PROPERTY: [(_OF, of)],
    }


def _without_kind(type_name: str) -> str:
    """`std_msgs/Bool` of `std_msgs/msg/Bool`, as ROS 1 says it."""
    package, _, rest = type_name.partition("/")
    return f"{package}/{rest.rpartition('/')[2]}"


def _is_name(ros: str) -> bool:
    return len(ros) <= _LONGEST_NAME and _NAME.fullmatch(ros) is not None


def _are_in(fields: tuple[str, ...], needs: tuple[str, ...]) -> bool:
    """Whether a route with these `fields` carries all that is needed."""
    return not fields or all(
        any(need == field or need.startswith(f"{field}.") for field in fields) for need in needs
    )


def _entity(
    robot: str, component: str, ros: str, part: str, own: Mapping[str, object]
) -> tuple[str, dict[str, object]]:
    """The topic and the configuration of one entity.

    Ids are letters, digits, `_` and `-`. ROS has no `-` in its names, and no two `/` in a row: two
    names have two ids.
    """
    name = ros.strip("/")
    id_ = name.replace("/", "-") + (f"--{part}" if part else "")
    node = robot.replace(".", "--")
    config = {
        "name": f"{name} {part}".strip(),
        "unique_id": f"{robot}/{component}/{id_}",
        **own,
        "availability_topic": f"{robot}/_appliance/state",
        "device": {"identifiers": [f"appliance/{robot}"], "name": robot},
        "origin": {"name": "ros-mqtt-appliance"},
    }
    return f"{PREFIX}/{component}/{node}/{id_}/config", config
