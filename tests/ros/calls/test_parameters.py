"""Parameters on a FakeNode: what is hard to bring about with a real one."""

from __future__ import annotations

import asyncio

import pytest
from waiting import PATIENCE, until

pytest.importorskip("rcl_interfaces.srv")
from call_harness import AllTypes, CallHarness, action, call_routes, parameters

import appliance.ros.calls.parameters
from appliance.ros.calls import parameter_events
from appliance.ros.calls.dispatcher import CallError
from appliance.ros.calls.parameter_events import EVENT, EVENTS
from appliance.ros.calls.parameters import LOOK, to_value
from appliance.ros.node import FakeNode
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import load_description

CONVERTERS = Converters(load_description)


class Declaring:
    """A node with parameters, all integers; it gives none of them when one is `unset`."""

    def __init__(self, harness, name="/arm", **values):
        self.name = name
        self.node = harness.node
        self.values = values
        self.unset = set()
        self.asked = []
        self.holds = []
        self.is_held = False
        for verb, kind, answer in (
            ("list_parameters", "ListParameters", self.on_list),
            ("get_parameters", "GetParameters", self.on_get),
        ):
            self.offer(verb, kind, answer)
        self.events = harness.node.add_publisher(EVENTS, EVENT)

    def offer(self, verb, kind, answer):
        type_name = f"rcl_interfaces/srv/{kind}"
        handler = self._handler(type_name, answer)
        self.node.add_service(f"{self.name}/{verb}", type_name, handler)

    def _handler(self, type_name, answer):
        def handle(cdr, respond):
            request = CONVERTERS.get(f"{type_name}_Request").to_dict(cdr)
            response = CONVERTERS.get(f"{type_name}_Response").from_dict(answer(request))
            if self.is_held:
                self.holds.append(lambda: respond(response))
            else:
                respond(response)

        return handle

    def on_list(self, request):
        self.asked.append("list")
        return {"result": {"names": [*self.values, *self.unset]}}

    def on_get(self, request):
        names = request["names"]
        if self.unset & set(names):
            return {"values": []}
        return {"values": [{"type": 2, "integer_value": self.values[name]} for name in names]}

    def change(self, name, value):
        self.values[name] = value
        one = {"name": name, "value": {"type": 2, "integer_value": value}}
        event = {"node": self.name, "changed_parameters": [one]}
        self.events.publish(CONVERTERS.get(EVENT).from_dict(event))

    def release(self):
        self.is_held = False
        while self.holds:
            self.holds.pop(0)()


@pytest.fixture
async def harness():
    harness = CallHarness(FakeNode(types=AllTypes()))
    yield harness
    await harness.stop()
    watcher = harness.client("watcher", "r2d2/+/_param/#")
    assert watcher.received == []  # what was retained has gone with the appliance


async def shown(harness, name, value):
    await until(lambda: harness.retained(f"r2d2/arm/_param/{name}") == value, f"{name} {value}")


async def test_a_change_while_the_values_are_read_is_not_lost(harness):
    harness.start(parameters("/arm/*"))
    arm = Declaring(harness, speed=1)
    arm.is_held = True
    harness.node.spin()
    await until(lambda: arm.holds, "the names are asked for")
    arm.holds.pop(0)()
    await until(lambda: arm.holds, "the values are asked for")
    arm.change("speed", 2)
    arm.release()  # the value of before comes after the change
    await shown(harness, "speed", 2)
    await asyncio.sleep(0.01)
    assert harness.retained("r2d2/arm/_param/speed") == 2


async def test_a_node_that_takes_the_place_of_one_that_was_killed(harness):
    harness.start(parameters("/arm/*"))
    arm = Declaring(harness, speed=1, old=1)
    harness.node.nodes = lambda: ["/bridge", "/arm"]
    harness.node.spin()
    await shown(harness, "old", 1)
    arm.values = {"speed": 2}
    harness.node.nodes = lambda: ["/bridge", "/arm", "/arm"]  # the killed one is not forgotten yet
    harness.node.spin()
    await shown(harness, "speed", 2)
    await shown(harness, "old", None)


async def test_a_flood_of_changes_has_the_node_read_anew(harness, monkeypatch):
    monkeypatch.setattr(parameter_events, "MAX_EVENTS", 20)
    harness.start(parameters("/arm/*"))
    arm = Declaring(harness, speed=1, other=1)
    harness.node.spin()
    await shown(harness, "speed", 1)
    for number in range(50):  # the loop has no turn meanwhile
        arm.change("speed", number)
    arm.change("other", 7)
    await shown(harness, "speed", 49)
    await shown(harness, "other", 7)
    assert arm.asked == ["list"] * 2


async def test_a_parameter_that_cannot_be_read_hides_no_others(harness):
    harness.start(parameters("/arm/*"))
    arm = Declaring(harness, speed=1, steps=2)
    arm.unset.add("void")
    harness.node.spin()
    await shown(harness, "steps", 2)
    await shown(harness, "speed", 1)
    assert harness.retained("r2d2/arm/_param/void") is None


async def test_a_value_is_set_before_all_services_of_its_node_are_discovered(harness, monkeypatch):
    monkeypatch.setattr(appliance.ros.calls.parameters, "DISCOVERY", PATIENCE)
    harness.start(parameters("/arm/*"))
    arm = Declaring(harness, speed=1)
    harness.node.spin()
    await shown(harness, "speed", 1)
    client = harness.client("alice")
    call = asyncio.create_task(client.call("r2d2/arm/_param/speed/set", b"2"))
    await asyncio.sleep(4 * LOOK)
    assert not call.done()
    for verb, kind, answer in (
        ("describe_parameters", "DescribeParameters", {"descriptors": [{"type": 2}]}),
        ("set_parameters", "SetParameters", {"results": [{"successful": True}]}),
    ):
        arm.offer(verb, kind, lambda request, answer=answer: answer)
        await asyncio.sleep(2 * LOOK)
        harness.node.spin()
    assert await call == ("ok", {"successful": True, "reason": ""})


async def test_a_service_that_a_node_does_not_have_is_not_waited_for_long(harness, monkeypatch):
    monkeypatch.setattr(appliance.ros.calls.parameters, "DISCOVERY", 0.1)
    harness.start(parameters("/arm/*"))
    Declaring(harness, speed=1)
    harness.node.spin()
    await shown(harness, "speed", 1)
    code, message = await harness.client("alice").error("r2d2/arm/_param/speed/set", b"2")
    assert (code, message) == ("unavailable", "there is no /arm/describe_parameters on the bus")


async def test_the_appliance_stops_just_when_a_node_cannot_be_read(harness, monkeypatch):
    monkeypatch.setattr(appliance.ros.calls.parameters, "DISCOVERY", 0.0)
    harness.start(parameters("/mute/*"))
    kind = "rcl_interfaces/srv/GetParameters"
    harness.node.add_service("/mute/get_parameters", kind, lambda request, respond: None)
    for turns in range(12):  # one of these is between the failure and the task's hearing of it
        harness.node.spin()
        for _ in range(turns):
            await asyncio.sleep(0)
        await asyncio.wait_for(harness.bridge.stop(), 5)
        harness.bridge = None
        harness.start(parameters("/mute/*"))


async def test_routes_that_change_while_they_run(harness):
    harness.start(parameters("/arm/sp*"))
    Declaring(harness, speed=1, spin=3, steps=2)
    harness.node.spin()
    await shown(harness, "speed", 1)
    assert harness.retained("r2d2/arm/_param/steps") is None
    routes = parameters(["/arm/s*", "/arm/none", "!/arm/sp*", "/*/mode"])
    harness.bridge.calls.replace(call_routes(routes))
    await shown(harness, "steps", 2)
    assert harness.retained("r2d2/arm/_param/speed") is None
    assert harness.retained("r2d2/arm/_param/spin") is None


async def test_values_that_a_killed_run_has_left_retained_are_cleared(harness):
    before = harness.client("before")
    left = ["r2d2/arm/_param/speed", "r2d2/arm/left/_param/a/b", "r2d2/walk/_status"]
    others = ["r2d2/arm/speed", "r2d2/_param/x", "r2d2/walk/_result/1", "r2d2/run/_status"]
    for topic in (*left, *others):
        before.send(topic, 1, retain=True)
    harness.start(parameters("/**/*"), action("/walk", mqtt="r2d2/walk"))
    assert [topic for topic in left if harness.retained(topic) is not None] == []
    assert [topic for topic in others if harness.retained(topic) is None] == []


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (1, True, {"bool_value": True}),
        (2, -5, {"integer_value": -5}),
        (3, 1, {"double_value": 1.0}),
        (4, "a", {"string_value": "a"}),
        (5, "AQI=", {"byte_array_value": b"\1\2"}),
        (5, [1, 2], {"byte_array_value": b"\1\2"}),
        (6, [True], {"bool_array_value": [True]}),
        (7, [], {"integer_array_value": []}),
        (8, [1, 2.5], {"double_array_value": [1.0, 2.5]}),
        (9, ["a"], {"string_array_value": ["a"]}),
    ],
)
def test_values_take_the_declared_type(kind, value, expected):
    assert to_value("x", value, {"type": kind}) == {"type": kind, **expected}


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (1, 1),
        (2, True),
        (2, 1.5),
        (2, 2**63),
        (3, "1"),
        (4, 1),
        (5, "%"),
        (5, [256]),
        (6, [1]),
        (7, 1),
        (7, [1.5]),
        (8, ["1"]),
        (9, [None]),
        (0, {}),
        (0, []),
        (0, None),
    ],
)
def test_values_of_another_type_are_refused(kind, value):
    with pytest.raises(CallError, match=r"^x: ") as raised:
        to_value("x", value, {"type": kind})
    assert raised.value.code == "bad_request"


def test_a_parameter_of_dynamic_type_takes_the_type_of_the_value():
    free = {"type": 2, "dynamic_typing": True}
    assert to_value("x", 1.5, free) == {"type": 3, "double_value": 1.5}
    assert to_value("x", ["a"], {}) == {"type": 9, "string_array_value": ["a"]}


async def test_names_that_are_no_topics_hide_no_others(harness):
    harness.start(parameters("/arm/*"))
    arm = Declaring(harness, **{"a+b": 1, "a\nb": 1, "\ufffe": 1, "x" * 70_000: 1, "speed": 1})
    harness.node.spin()
    await shown(harness, "speed", 1)
    for name in ("y" * 70_000, "tab\tbed", "speed"):
        arm.change(name, 2)
    await shown(harness, "speed", 2)
    assert not harness.bridge.calls._parameters.source.queue
