"""What Home Assistant is told: each entity by its documentation, with values of real messages."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import replace
from typing import Any

import jinja2
import jsonschema
import orjson
import pytest
from bridge_harness import Harness, to_mqtt, to_ros
from call_harness import AllTypes, call_routes, service
from waiting import until

from appliance.broker.message import Message
from appliance.mqtt.topics import check_topic
from appliance.ros import home_assistant
from appliance.ros.bridge import Bridge
from appliance.ros.home_assistant import FILTER, entities_of_call, entities_of_topic
from appliance.ros.node import FakeNode
from appliance.ros.payload.definitions import import_message
from appliance.ros.topics.route import BridgedTopic

pytest.importorskip("rclpy")
from rclpy.serialization import serialize_message

BATTERY, BOOL, STRING = "sensor_msgs/msg/BatteryState", "std_msgs/msg/Bool", "std_msgs/msg/String"

#: What the documentation of Home Assistant's MQTT integration (2026.1) says of every entity.
COMMON: dict[str, Any] = {
    "name": {"type": "string", "minLength": 1},
    "unique_id": {"type": "string", "minLength": 1},
    "availability_topic": {"const": "r2d2/_appliance/state"},
    "device": {
        "type": "object",
        "properties": {"identifiers": {"type": "array", "minItems": 1}, "name": {"const": "r2d2"}},
        "required": ["identifiers", "name"],
        "additionalProperties": False,
    },
    "origin": {
        "type": "object",
        "properties": {"name": {"type": "string"}},
        "required": ["name"],
        "additionalProperties": False,
    },
    "entity_category": {"enum": ["config", "diagnostic"]},
}
TOPIC: dict[str, Any] = {"type": "string", "pattern": "^[^+#]+$"}
TEXT: dict[str, Any] = {"type": "string", "minLength": 1}
STATE = {"state_topic": TOPIC, "value_template": TEXT}
#: The units that Home Assistant takes for a device class of sensors.
UNITS = {
    "battery": "%",
    "voltage": "V",
    "temperature": "°C",
    "humidity": "%",
    "pressure": "Pa",
    "illuminance": "lx",
    "distance": "m",
}
COMPONENTS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "sensor": (
        {
            **STATE,
            "device_class": {"enum": list(UNITS)},
            "unit_of_measurement": {"enum": list(UNITS.values())},
            "state_class": {"enum": ["measurement", "total", "total_increasing"]},
        },
        ["state_topic"],
    ),
    "binary_sensor": (
        {
            **STATE,
            "device_class": {"enum": ["battery_charging", "problem"]},
            "off_delay": {"type": "integer", "minimum": 1},
        },
        ["state_topic"],
    ),
    "device_tracker": (
        {
            "json_attributes_topic": TOPIC,
            "json_attributes_template": TEXT,
            "source_type": {"enum": ["bluetooth", "bluetooth_le", "gps", "router"]},
        },
        ["json_attributes_topic"],
    ),
    "camera": ({"topic": TOPIC}, ["topic"]),
    "switch": (
        {
            "command_topic": TOPIC,
            "payload_on": TEXT,
            "payload_off": TEXT,
            "optimistic": {"type": "boolean"},
            "qos": {"enum": [0, 1, 2]},
        },
        ["command_topic"],
    ),
    "button": (
        {"command_topic": TOPIC, "payload_press": TEXT, "qos": {"enum": [0, 1, 2]}},
        ["command_topic"],
    ),
}


def check(topic: str, config: dict[str, Any]) -> None:
    """That Home Assistant takes it."""
    prefix, component, *ids, end = topic.split("/")
    assert (prefix, len(ids), end) == ("homeassistant", 2, "config")
    check_topic(topic)
    for id_ in ids:
        assert id_.replace("_", "").replace("-", "").isalnum()
        assert id_.isascii()
    properties, required = COMPONENTS[component]
    jsonschema.validate(
        config,
        {
            "type": "object",
            "properties": {**COMMON, **properties},
            "required": ["name", "unique_id", "availability_topic", "device", "origin", *required],
            "additionalProperties": False,
        },
    )
    if "device_class" in config and component == "sensor":
        assert config["unit_of_measurement"] == UNITS[config["device_class"]]


def entities(ros: str, type_name: str, **options: Any) -> dict[str, dict[str, Any]]:
    settings = to_mqtt(ros, **options)
    bridged = BridgedTopic(ros, f"r2d2{ros}", type_name, "to_mqtt", settings.encoding)
    found = dict(entities_of_topic("r2d2", bridged, settings))
    for topic, config in found.items():
        check(topic, config)
    return found


def rendered(config: dict[str, Any], payload: bytes, **this: str) -> str:
    """What Home Assistant shows after a message: `value_json` is there where it is JSON, and `this`
    where the entity has been added."""
    template = config.get("value_template") or config["json_attributes_template"]
    value = payload.decode()
    names: dict[str, Any] = {"value": value, **({"this": this} if this else {})}
    with contextlib.suppress(ValueError):
        names["value_json"] = json.loads(value)
    return jinja2.Environment(autoescape=False).from_string(template).render(names)


@pytest.fixture
async def there() -> Any:
    """A bridge that tells Home Assistant, with all types; `there.start(routes)`."""
    harness = Harness()
    harness.node = FakeNode(types=AllTypes())
    harness.client.subscribe("homeassistant/#")

    def start(*routes: Any, on: bool = True, calls: Any = None) -> None:
        harness.bridge = Bridge(
            harness.node,
            harness.broker,
            routes,
            asyncio.get_running_loop(),
            "r2d2",
            calls,
            home_assistant=on,
        )
        harness.bridge.start()

    harness.start = start
    yield harness
    await harness.bridge.stop()


def told(harness: Harness) -> dict[str, dict[str, Any]]:
    """The entities that are retained, by their topics without what is in front of all."""
    found = {}
    for topic, message in harness.broker.retained.find(FILTER):
        config = json.loads(message.payload)
        check(topic, config)
        found[topic.removeprefix("homeassistant/").removesuffix("/config")] = config
    return found


async def shown(harness: Harness, ros: str, type_name: str, **fields: Any) -> dict[str, str]:
    """What each entity shows after a message on ROS, by its id."""
    message = import_message(type_name)(**fields)
    publisher = harness.node.add_publisher(ros, type_name)
    await until(lambda: told(harness), f"entities of {ros}")
    publisher.publish(serialize_message(message))
    await until(lambda: harness.client.payloads(f"r2d2{ros}"), f"a message of {ros}")
    payload = harness.client.payloads(f"r2d2{ros}")[-1]
    return {
        topic.rpartition("/")[2]: rendered(config, payload)
        for topic, config in told(harness).items()
        if f"r2d2{ros}" in config.values()
    }


@pytest.mark.parametrize(
    ("type_name", "fields", "expected"),
    [
        (
            BATTERY,
            {"percentage": 0.5, "voltage": 24.5, "power_supply_status": 1},
            {"x": "50.0", "x--voltage": "24.5", "x--charging": "ON"},
        ),
        (
            BATTERY,
            {"percentage": float("nan"), "voltage": 12.0, "power_supply_status": 2},
            {"x": "None", "x--voltage": "12.0", "x--charging": "OFF"},
        ),
        ("sensor_msgs/msg/Temperature", {"temperature": 21.5}, {"x": "21.5"}),
        ("sensor_msgs/msg/RelativeHumidity", {"relative_humidity": 0.4}, {"x": "40.0"}),
        ("sensor_msgs/msg/FluidPressure", {"fluid_pressure": 101325.0}, {"x": "101325.0"}),
        ("sensor_msgs/msg/Illuminance", {"illuminance": 300.0}, {"x": "300.0"}),
        ("sensor_msgs/msg/Range", {"range": float("inf")}, {"x": "None"}),
        (
            "sensor_msgs/msg/NavSatFix",
            {"latitude": 48.5, "longitude": 9.25},
            {"x": '{"latitude": 48.5, "longitude": 9.25}'},
        ),
        ("sensor_msgs/msg/NavSatFix", {"latitude": float("nan")}, {"x": "{}"}),  # no fix
        (BOOL, {"data": True}, {"x": "ON"}),
        (BOOL, {"data": False}, {"x": "OFF"}),
        ("std_msgs/msg/Int64", {"data": -(1 << 53) - 1}, {"x": "-9007199254740993"}),
        (STRING, {"data": "{{ states }}" + 300 * "x"}, {"x": "{{ states }}" + 243 * "x"}),
    ],
)
async def test_what_is_shown(there: Any, type_name: str, fields: Any, expected: Any) -> None:
    there.start(to_mqtt("/x"))
    assert await shown(there, "/x", type_name, **fields) == expected


@pytest.mark.parametrize(("level", "array", "status"), [(0, "", "OFF"), (2, "ON", "ON")])
async def test_diagnostics(there: Any, level: int, array: str, status: str) -> None:
    from diagnostic_msgs.msg import DiagnosticStatus

    there.start(to_mqtt("/all"), to_mqtt("/top"))
    one = DiagnosticStatus(level=bytes([level]), name="motor")
    names = await shown(there, "/top", "diagnostic_msgs/msg/DiagnosticStatus", level=one.level)
    assert names == {"top": status}
    found = await shown(there, "/all", "diagnostic_msgs/msg/DiagnosticArray", status=[one])
    assert found == {"all": array}
    # Its state when Home Assistant has heard of none; `this` is the entity.
    (config,) = entities("/all", "diagnostic_msgs/msg/DiagnosticArray").values()
    payload = there.client.payloads("r2d2/all")[-1]
    assert rendered(config, payload, state="unknown") == (array or "OFF")
    assert rendered(config, payload, state="on") == array


@pytest.mark.parametrize(
    ("type_name", "payload", "expected"),
    [
        (BOOL, b"true", "ON"),
        (BOOL, b"false", "OFF"),
        ("std_msgs/msg/Float32", b"1.5", "1.5"),
        ("std_msgs/msg/Float32", b"nan", "None"),
        (STRING, b"12 apples", "12 apples"),
        (STRING, b"true", "true"),
    ],
)
def test_text(type_name: str, payload: bytes, expected: str) -> None:
    (config,) = entities("/x", type_name, encoding="text").values()
    assert rendered(config, payload) == expected


@pytest.mark.parametrize(
    ("type_name", "options", "count"),
    [
        ("geometry_msgs/msg/Twist", {}, 0),
        (BATTERY, {"encoding": "cbor"}, 0),
        (BATTERY, {"encoding": "cdr"}, 0),
        (BATTERY, {"compression": "zstd"}, 0),
        (BATTERY, {"fields": ("voltage", "header.stamp")}, 1),
        ("diagnostic_msgs/msg/DiagnosticArray", {"fields": ("header",)}, 0),
        ("sensor_msgs/msg/Image", {"encoding": "jpeg"}, 1),
        ("sensor_msgs/msg/Image", {"encoding": "png"}, 1),
        ("sensor_msgs/msg/Image", {}, 0),
        ("sensor_msgs/msg/CompressedImage", {"encoding": "binary"}, 1),
        ("std_msgs/msg/UInt8MultiArray", {"encoding": "binary"}, 0),
        ("sensor_msgs/BatteryState", {}, 3),  # ROS 1
    ],
)
def test_what_has_a_counterpart(type_name: str, options: Any, count: int) -> None:
    assert len(entities("/x", type_name, **options)) == count


def test_what_goes_to_ros_has_none() -> None:
    bridged = BridgedTopic("/x", "r2d2/x", BOOL, "to_ros", "json")
    assert not list(entities_of_topic("r2d2", bridged, to_ros("/x")))


def test_ids_are_those_of_one_thing() -> None:
    names = ["/a/b", "/a_b", "/a/_b", "/a_/b", "/battery", "/battery/voltage", "/battery_/voltage"]
    topics = [topic for name in names for topic in entities(name, BATTERY)]
    assert len({*topics}) == len(topics) == 3 * len(names)


@pytest.mark.parametrize("robot", ["r.2", "R_2-a", "a..b"])
def test_names_of_robots(robot: str) -> None:
    bridged = BridgedTopic("/x", f"{robot}/x", BOOL, "to_mqtt", "json")
    ((topic, _),) = entities_of_topic(robot, bridged, to_mqtt("/x"))
    assert topic.split("/")[2].replace("_", "").replace("-", "").isalnum()


@pytest.mark.parametrize("ros", ["/a-b", "/a b", "x", "/", "/a//b", "/1a", "/" + "x" * 247])
def test_names_that_ros_2_does_not_allow_have_none(ros: str) -> None:
    """The Master of ROS 1 takes any; two of them could have one id, or a topic that is too long."""
    bridged = BridgedTopic(ros, f"r2d2{ros}", BOOL, "to_mqtt", "json")
    assert not list(entities_of_topic("r2d2", bridged, to_mqtt("/x")))
    assert not list(entities_of_call("r2d2", call("std_srvs/srv/Trigger", ros=ros)))


def call(type_name: str, **other: Any) -> dict[str, Any]:
    entry = {"ros": "/x", "mqtt": "r2d2/x/_call", "type": type_name, "direction": "service"}
    return {**entry, "encoding": "json", **other}


def test_services() -> None:
    found = {}
    for type_name in ("std_srvs/srv/SetBool", "std_srvs/srv/Trigger", "std_srvs/Empty"):
        ((topic, config),) = entities_of_call("r2d2", call(type_name))
        check(topic, config)
        found[type_name] = topic.split("/")[1], config["command_topic"]
    assert found == {
        "std_srvs/srv/SetBool": ("switch", "r2d2/x/_call/homeassistant"),
        "std_srvs/srv/Trigger": ("button", "r2d2/x/_call/homeassistant"),
        "std_srvs/Empty": ("button", "r2d2/x/_call/homeassistant"),
    }
    for other in (
        call("std_srvs/srv/SetBool", encoding="cbor"),
        call("std_srvs/srv/SetBool", direction="provided"),
        call("nav_msgs/srv/GetMap"),
        call(""),
    ):
        assert not list(entities_of_call("r2d2", other))


async def test_a_switch_calls_its_service(there: Any) -> None:
    there.node.add_service("/light", "std_srvs/srv/SetBool", _answer_set_bool)
    there.start(calls=call_routes(service("/light", type="std_srvs/srv/SetBool")))
    await until(lambda: told(there), "the switch")
    config = told(there)["switch/r2d2/light"]
    there.client.send(config["command_topic"], config["payload_on"].encode(), 1)
    await until(lambda: CALLED, "a call")
    assert CALLED == [True]


CALLED: list[bool] = []


def _answer_set_bool(request: bytes, respond: Any) -> None:
    from rclpy.serialization import deserialize_message
    from std_srvs.srv import SetBool

    CALLED.append(deserialize_message(request, SetBool.Request).data)
    respond(serialize_message(SetBool.Response(success=True)))


async def test_it_is_off_without_the_key(there: Any) -> None:
    there.start(to_mqtt("/x"), on=False)
    there.node.add_publisher("/x", BOOL)
    await until(lambda: there.routes(), "what is bridged")
    await there.settle()
    assert told(there) == {}


async def test_what_is_there_is_told_once(there: Any) -> None:
    there.start(to_mqtt("/x"), to_mqtt("/y"))
    there.node.add_publisher("/x", BOOL)
    await until(lambda: len(told(there)) == 1)
    there.node.add_publisher("/y", BOOL)
    await until(lambda: len(told(there)) == 2)
    for _ in range(3):
        there.bridge._announce()
        await there.settle()
    sent = [m for m, _ in there.client.received if m.topic.startswith("homeassistant/")]
    assert len(sent) == 2


async def test_a_node_that_is_away_keeps_its_entities_and_a_route_does_not(there: Any) -> None:
    there.start(to_mqtt("/a/*"), to_mqtt("/b/*"))
    publishers = [there.node.add_publisher(name, BOOL) for name in ("/a/x", "/b/y")]
    await until(lambda: len(told(there)) == 2)
    for publisher in publishers:
        publisher.remove()
    await until(lambda: not there.routes(), "nothing is bridged")
    await there.settle()
    assert len(told(there)) == 2
    there.bridge.replace([to_mqtt("/b/*")])
    there.node.spin()
    await until(lambda: [*told(there)] == ["binary_sensor/r2d2/b-y"])


async def test_off_and_on_by_a_reload(there: Any) -> None:
    there.start(to_mqtt("/x"))
    there.node.add_publisher("/x", BOOL)
    await until(lambda: told(there))
    for is_on in (False, True):
        there.bridge.tell_home_assistant(is_on)
        there.bridge.replace([to_mqtt("/x")])
        there.bridge.clean_up_retained()
        there.node.spin()
        await until(lambda is_on=is_on: bool(told(there)) == is_on)


async def test_it_is_switched_off_meanwhile(there: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(home_assistant, "TURN", 1)
    there.start(to_mqtt("/x"), to_mqtt("/y"), on=False)
    for name in ("/x", "/y"):
        there.node.add_publisher(name, BOOL)
    await until(lambda: len(there.routes()) == 2)
    there.bridge._home_assistant.use(True)
    work = there.bridge._home_assistant.work(
        [
            (BridgedTopic(name, f"r2d2{name}", BOOL, "to_mqtt", "json"), to_mqtt(name))
            for name in ("/x", "/y")
        ],
        [],
        there.bridge._session,
    )
    while not told(there):
        next(work)
    there.bridge._home_assistant.use(False)
    there.bridge.clean_up_retained()
    await there.settle()
    assert list(work) == []
    assert told(there) == {}


async def test_another_type_has_other_entities(there: Any) -> None:
    there.start(to_mqtt("/x*"))
    publisher = there.node.add_publisher("/x", BOOL)
    await until(lambda: [*told(there)] == ["binary_sensor/r2d2/x"])
    publisher.remove()
    await until(lambda: not there.routes())
    there.node.add_publisher("/x", STRING)
    await until(lambda: [*told(there)] == ["sensor/r2d2/x"])


async def test_of_users_nothing_is_deleted(there: Any) -> None:
    alice = there.broker.accounting.accounts.of_user("alice")
    own = home_assistant._properties("r2d2/x")
    topic = "homeassistant/light/r2d2/x/config"
    there.broker.retained.keep(Message(topic, b"{}", 1, True, own), alice)
    there.start(to_mqtt("/x"))
    there.node.add_publisher("/x", BOOL)
    await until(lambda: there.broker.retained.get("homeassistant/binary_sensor/r2d2/x/config"))
    await there.settle()
    assert there.broker.retained.get(topic) is not None


async def test_there_is_a_limit(
    there: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(home_assistant, "MOST", 3)
    monkeypatch.setattr(home_assistant, "TURN", 2)
    there.start(*(to_mqtt(f"/x{number}") for number in range(7)))
    for number in range(7):
        there.node.add_publisher(f"/x{number}", BOOL)
    await until(lambda: len(there.routes()) == 7)
    there.bridge._announce()
    await until(lambda: "told of 3 entities of 7" in caplog.text)
    await until(lambda: len(told(there)) == 3, "those three")
    await there.settle()
    assert len(told(there)) == 3


async def test_those_of_topics_that_are_away_count_too(
    there: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that changes the names of its topics does not fill what may be retained."""
    monkeypatch.setattr(home_assistant, "MOST", 3)
    there.start(to_mqtt("/**"))
    for number in range(7):
        publisher = there.node.add_publisher(f"/x{number}", BOOL)
        name = f"binary_sensor/r2d2/x{number}"
        await until(lambda name=name: name in told(there), name)
        assert len(told(there)) == min(number + 1, 3)
        publisher.remove()
        await until(lambda: not there.routes())


async def test_both_ways_and_a_service_of_the_same_name(there: Any) -> None:
    """What is away keeps its entities, although something else with its topic is there."""
    both = [replace(to_mqtt("/light"), to="both", type=BOOL)]
    light = there.node.add_service("/light", "std_srvs/srv/SetBool", _answer_set_bool)
    there.start(*both, calls=call_routes(service("/light", type="std_srvs/srv/SetBool")))
    publisher = there.node.add_publisher("/light", BOOL)
    wanted = {"binary_sensor/r2d2/light", "switch/r2d2/light"}
    await until(lambda: {*told(there)} == wanted, "both")
    publisher.remove()
    light.remove()
    there.node.spin()
    for _ in range(3):
        there.bridge._announce()
        await there.settle()
    assert {*told(there)} == wanted
    # Without its route the switch goes, and what else has the topic keeps its own.
    there.bridge.replace(both)
    there.bridge.calls.replace(call_routes())
    there.bridge.clean_up_retained()
    there.node.spin()
    await until(lambda: [*told(there)] == ["binary_sensor/r2d2/light"])


async def test_a_removed_route_is_not_told_of_behind_its_cleanup(
    there: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(home_assistant, "TURN", 1)
    there.start(to_mqtt("/x"), to_mqtt("/y"), on=False)
    for name in ("/x", "/y"):
        there.node.add_publisher(name, BOOL)
    await until(lambda: len(there.routes()) == 2)
    there.bridge.tell_home_assistant(True)
    topics = [
        (BridgedTopic(name, f"r2d2{name}", BOOL, "to_mqtt", "json"), to_mqtt(name))
        for name in ("/x", "/y")
    ]
    work = there.bridge._home_assistant.work(topics, [], there.bridge._session)
    while not told(there):
        next(work)
    there.bridge.replace([to_mqtt("/x")])
    assert list(work) == []
    # Nor by another announcement, until the new routes are followed.
    assert list(there.bridge._home_assistant.work(topics, [], there.bridge._session)) == []
    assert [*told(there)] == ["binary_sensor/r2d2/x"]


@pytest.mark.patches
async def test_what_could_not_be_retained_is_told_again(
    there: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = there.broker.publish

    def refuse(message: Message, session: Any) -> int:
        is_entity = message.topic.startswith("homeassistant/")
        return 0x97 if is_entity else publish(message, session)

    monkeypatch.setattr(there.broker, "publish", refuse)
    there.start(to_mqtt("/x"))
    there.node.add_publisher("/x", BOOL)
    await until(lambda: there.routes(), "what is bridged")
    await there.settle()
    monkeypatch.undo()
    there.bridge._announce()
    await until(lambda: told(there), "the entity")


async def test_a_users_copy_is_replaced_by_its_own(there: Any) -> None:
    """Else nothing would delete it with the route."""
    topic, config = next(iter(entities("/x", BOOL).items()))
    alice = there.broker.accounting.accounts.of_user("alice")
    copy = Message(topic, orjson.dumps(config), 1, True)
    there.broker.retained.keep(copy, alice)
    there.start(to_mqtt("/x"))
    there.node.add_publisher("/x", BOOL)
    await until(lambda: there.broker.retained.owner(topic).is_inside, "its own")
