"""Calls in JSON, CBOR and CDR, and whose goals may be cancelled, on a FakeNode and the broker."""

from __future__ import annotations

import asyncio
import json
import math
import struct
from typing import ClassVar

import cbor2
import pytest
from waiting import until

pytest.importorskip("test_msgs.action")
from call_harness import AllTypes, CallHarness, action, call_routes, parameters, service

from appliance.mqtt.codec import Property
from appliance.ros.calls.goals import GOAL_INFO, STATUS, id_of, split_id, with_id
from appliance.ros.node import Durability, FakeNode, QosProfile
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import CDR, PACKED, load_description

CONVERTERS = Converters(load_description)
SET_BOOL, ARRAYS = "std_srvs/srv/SetBool", "test_msgs/srv/Arrays"
FIBONACCI, CANCEL = "test_msgs/action/Fibonacci", "action_msgs/srv/CancelGoal"
TYPES = {
    "json": "application/json",
    "cbor": "application/cbor",
    "cdr": "application/cdr",
}
every_encoding = pytest.mark.parametrize("encoding", TYPES)


def cdr(type_name, value):
    return CONVERTERS.get(type_name).from_dict(value)


def value(type_name, data):
    return CONVERTERS.get(type_name).to_dict(data)


def encode(encoding, type_name, fields):
    if encoding == "cdr":
        return cdr(type_name, fields)
    return cbor2.dumps(fields) if encoding == "cbor" else json.dumps(fields).encode()


def decode(message, type_name):
    """The value of a message, by what it says to be."""
    said = message.properties[Property.CONTENT_TYPE]
    if said == TYPES["cdr"]:
        return value(type_name, message.payload)
    return cbor2.loads(message.payload) if said == TYPES["cbor"] else json.loads(message.payload)


async def ask(client, topic, payload, content_type=None):
    """(status, the answer's message), by MQTT 5."""
    await asyncio.sleep(0)  # as through a network: what was set up before is there
    said = {} if content_type is None else {"content_type": content_type}
    before = len(client.on(f"answers/{client.name}"))
    client.send(topic, payload, response_topic=f"answers/{client.name}", **said)
    await until(lambda: len(client.on(f"answers/{client.name}")) > before, f"{topic}'s answer")
    message = client.on(f"answers/{client.name}")[-1]
    return dict(message.properties[Property.USER_PROPERTY])["status"], message


@pytest.fixture
async def harness():
    harness = CallHarness(FakeNode(types=AllTypes()))
    yield harness
    await harness.stop()


def echo(harness, name, type_name):
    """A service whose response has the request's fields."""

    def on_request(request, respond):
        respond(cdr(f"{type_name}_Response", value(f"{type_name}_Request", request)))

    harness.node.add_service(name, type_name, on_request)


def switch(harness, name="/switch"):
    def on_request(request, respond):
        data = value(f"{SET_BOOL}_Request", request)["data"]
        respond(cdr(f"{SET_BOOL}_Response", {"success": data, "message": "on" if data else "off"}))

    harness.node.add_service(name, SET_BOOL, on_request)


# Services

CALL = "r2d2/switch/_call"


@every_encoding
async def test_the_content_type_overrides_the_route(harness, encoding):
    for route in TYPES:
        harness.start(service("/switch", encoding=route))
        if not harness.node.remote_services:
            switch(harness)
        harness.node.spin()
        client = harness.client("alice")
        payload = encode(encoding, f"{SET_BOOL}_Request", {"data": True})
        for said in (TYPES[encoding], f"{TYPES[encoding].upper()}; charset=utf-8"):
            status, answer = await ask(client, CALL, payload, said)
            assert status == "ok" and answer.properties[Property.CONTENT_TYPE] == TYPES[encoding]
            fields = decode(answer, f"{SET_BOOL}_Response")
            assert fields == {"success": True, "message": "on"}
        client.leave()
        await harness.bridge.stop()


@every_encoding
async def test_without_a_content_type_the_route_s_encoding_is_used(harness, encoding):
    harness.start(service("/switch", encoding=encoding))
    switch(harness)
    harness.node.spin()
    client = harness.client("alice")
    payload = encode(encoding, f"{SET_BOOL}_Request", {"data": True})
    for sent, expected in ((payload, True), (b"", False)):
        status, answer = await ask(client, CALL, sent)
        assert status == "ok" and answer.properties[Property.CONTENT_TYPE] == TYPES[encoding]
        assert decode(answer, f"{SET_BOOL}_Response")["success"] is expected
        # As 3.1.1 does it.
        client.subscribe("r2d2/switch/_reply/alice/7")
        client.send(f"{CALL}/7", sent)
        await until(lambda: client.on("r2d2/switch/_reply/alice/7"), "the answer")
        reply = client.on("r2d2/switch/_reply/alice/7")[-1]
        assert reply.payload == answer.payload
        client.received.clear()


@every_encoding
async def test_errors_are_understood_in_each_encoding(harness, encoding):
    harness.start(service("/switch", encoding=encoding), service("/gone", encoding=encoding))
    switch(harness)
    harness.node.spin()
    client = harness.client("alice")
    broken = {"json": b"{", "cbor": b"\xa1\x64data", "cdr": b"\0\1\0\0"}[encoding]
    for topic, payload, code in (
        (CALL, broken, "bad_request"),
        ("r2d2/gone/_call", b"", "unavailable"),
        ("r2d2/gone/_call", broken, "unavailable"),
    ):
        for said in (None, TYPES[encoding]):
            status, answer = await ask(client, topic, payload, said)
            # CDR has no words for an error: it is JSON then, and says so.
            expected = "json" if encoding == "cdr" else encoding
            assert answer.properties[Property.CONTENT_TYPE] == TYPES[expected]
            assert status == "error"
            error = decode(answer, None)["error"]
            assert error["code"] == code and error["message"]


async def test_a_wrong_field_in_cbor_is_named_as_in_json(harness):
    harness.start(service("/switch"))
    switch(harness)
    harness.node.spin()
    client = harness.client("alice")
    _, answer = await ask(client, CALL, cbor2.dumps({"data": 1}), TYPES["cbor"])
    assert decode(answer, None)["error"]["message"].startswith("data: expected true or false")
    for hostile in (
        cbor2.dumps(cbor2.CBORTag(28, {"data": True})),  # a value to be referred to
        cbor2.dumps({"data": True}) + b"\0",
        b"\x9f" * 10_000,
        b"\xbb" + b"\xff" * 8,
    ):
        status, answer = await ask(client, CALL, hostile, TYPES["cbor"])
        assert status == "error"
        assert decode(answer, None)["error"]["code"] == "bad_request"


async def test_an_unknown_content_type_is_read_as_the_route_s(harness):
    harness.start(service("/switch"))
    switch(harness)
    harness.node.spin()
    client = harness.client("alice")
    status, _ = await ask(client, CALL, b'{"data": true}', "text/plain")
    assert status == "ok"
    _, answer = await ask(client, CALL, b"true", "text/pla\nin")
    message = decode(answer, None)["error"]["message"]
    assert message.endswith("(its content type 'text/pla\\nin' is unknown, it was read as json)")


async def test_numbers_and_bytes_keep_their_form_in_cbor(harness):
    harness.start(service("/arrays"))
    echo(harness, "/arrays", ARRAYS)
    harness.node.spin()
    client = harness.client("alice")
    numbers = struct.pack("<3d", 0.5, math.inf, -math.inf)
    fields = {
        "byte_values": b"\1\2\3",
        "float64_values": cbor2.CBORTag(86, numbers),
        "uint16_values": [1, 2, 65535],
    }
    status, answer = await ask(client, "r2d2/arrays/_call", cbor2.dumps(fields), TYPES["cbor"])
    assert status == "ok", answer.payload
    got = cbor2.loads(answer.payload)
    assert got["byte_values"] == b"\1\2\3"
    assert got["float64_values"] == cbor2.CBORTag(86, numbers)
    assert got["uint16_values"] == cbor2.CBORTag(69, b"\1\0\2\0\xff\xff")


async def test_a_service_that_mqtt_answers_in_cbor(harness):
    harness.start(service("/ask", to="mqtt", type=SET_BOOL, timeout=60, encoding="cbor"))
    harness.node.spin()
    client = harness.client("alice", "r2d2/ask/_request/+")
    for said, make in ((None, "cbor"), ("application/json", "json"), ("application/cdr", "cdr")):
        got = []
        harness.node.ask("/ask", cdr(f"{SET_BOOL}_Request", {"data": True}), got.append)
        await until(lambda: client.received, "the request")
        (request,) = client.received
        client.received.clear()
        assert request.properties[Property.CONTENT_TYPE] == "application/cbor"
        assert cbor2.loads(request.payload) == {"data": True}
        answer = encode(make, f"{SET_BOOL}_Response", {"success": True, "message": make})
        more = {} if said is None else {"content_type": said}
        client.send(request.properties[Property.RESPONSE_TOPIC], answer, **more)
        await until(lambda got=got: got, "the response")
        assert value(f"{SET_BOOL}_Response", got[0]) == {"success": True, "message": make}
    harness.node.ask("/ask", cdr(f"{SET_BOOL}_Request", {"data": True}), got.append)
    await until(lambda: client.received, "the request")
    error = cbor2.dumps({"error": {"code": "no", "message": "not today"}})
    client.send(client.received[0].properties[Property.RESPONSE_TOPIC], error)
    await until(lambda: len(got) == 2, "the response")
    assert got[1] is None and harness.counters().errors["rejected"] == 1


# Actions


class Walks:
    """An action's server that accepts every goal, and ends it when it is told to."""

    STAMP: ClassVar = {"sec": 5, "nanosec": 6}

    def __init__(self, harness):
        self.node = harness.node
        self.goals = []
        self.cancelled = []
        self.results = {}
        for name, kind, handle in (
            ("send_goal", f"{FIBONACCI}_SendGoal", self.on_goal),
            ("get_result", f"{FIBONACCI}_GetResult", self.on_result),
            ("cancel_goal", CANCEL, self.on_cancel),
        ):
            self._serve(name, kind, handle)
        self.status = harness.node.add_publisher(
            "/walk/_action/status", STATUS, QosProfile(durability=Durability.TRANSIENT_LOCAL)
        )
        self.feedback = harness.node.add_publisher(
            "/walk/_action/feedback", f"{FIBONACCI}_FeedbackMessage"
        )

    def _serve(self, name, kind, handle):
        def on_request(request, respond):
            answer = handle(value(f"{kind}_Request", request), respond)
            if answer is not None:
                respond(cdr(f"{kind}_Response", answer))

        self.node.add_service(f"/walk/_action/{name}", kind, on_request)

    def on_goal(self, request, respond):
        self.goals.append((id_of(request["goal_id"]).hex(), request["goal"]["order"]))
        return {"accepted": True, "stamp": self.STAMP}

    def on_result(self, request, respond):
        self.results[id_of(request["goal_id"]).hex()] = respond

    def on_cancel(self, request, respond):
        info = request["goal_info"]
        self.cancelled.append((id_of(info["goal_id"]).hex(), info["stamp"]))
        return {"goals_canceling": [info]}

    def walk(self, goal):
        message = {"goal_id": {"uuid": bytes.fromhex(goal)}, "feedback": {"sequence": [1, 2]}}
        self.feedback.publish(cdr(f"{FIBONACCI}_FeedbackMessage", message))
        info = {"goal_id": {"uuid": bytes.fromhex(goal)}, "stamp": self.STAMP}
        one = {"goal_info": info, "status": 2}
        self.status.publish(cdr(STATUS, {"status_list": [one]}))

    def end(self, goal, status=4):
        response = {"status": status, "result": {"sequence": [1, 2, 3]}}
        self.results.pop(goal)(cdr(f"{FIBONACCI}_GetResult_Response", response))


GOAL, STOP = "r2d2/walk/_goal", "r2d2/walk/_cancel"


async def begin(harness, **route):
    harness.start(action("/walk", **route))
    walks = Walks(harness)
    await asyncio.sleep(0)
    harness.node.spin()
    return walks


@every_encoding
async def test_a_goal_from_its_beginning_to_its_end(harness, encoding):
    walks = await begin(harness, encoding=encoding)
    client = harness.client("alice", "r2d2/walk/_feedback/+", "r2d2/walk/_result/+")
    client.subscribe("r2d2/walk/_status")
    payload = encode(encoding, f"{FIBONACCI}_Goal", {"order": 7})
    status, answer = await ask(client, GOAL, payload)
    assert status == "ok" and answer.properties[Property.CONTENT_TYPE] == TYPES[encoding]
    said = decode(answer, GOAL_INFO)
    assert said["stamp"] == Walks.STAMP
    ((goal, order),) = walks.goals
    assert order == 7
    assert (id_of(said["goal_id"]).hex() if encoding == "cdr" else said["goal_id"]) == goal
    await until(lambda: goal in walks.results, "the result is asked for")
    walks.walk(goal)
    walks.end(goal)
    topic = f"r2d2/walk/_result/{goal}"
    await until(lambda: client.on(topic), "the result")
    await until(lambda: client.on(f"r2d2/walk/_feedback/{goal}"), "the feedback")
    await until(lambda: any(m.payload for m in client.on("r2d2/walk/_status")), "the status")

    def newest(topic, type_name):
        message = client.on(topic)[-1]
        assert message.properties[Property.CONTENT_TYPE] == TYPES[encoding]
        assert ("ros-type", type_name) in message.properties[Property.USER_PROPERTY]
        return message

    feedback = newest(f"r2d2/walk/_feedback/{goal}", f"{FIBONACCI}_Feedback")
    sequence = decode(feedback, f"{FIBONACCI}_Feedback")["sequence"]
    assert plain(sequence) == [1, 2]
    kind = "GetResult_Response" if encoding == "cdr" else "Result"
    result = decode(newest(topic, f"{FIBONACCI}_{kind}"), f"{FIBONACCI}_{kind}")
    assert result["status"] == (4 if encoding == "cdr" else "succeeded")
    assert plain(result["result"]["sequence"]) == [1, 2, 3]
    goals = decode(newest("r2d2/walk/_status", STATUS), STATUS)
    if encoding == "cdr":
        assert [one["status"] for one in goals["status_list"]] == [2]
    else:
        assert goals == [{"goal_id": goal, "status": "executing", "stamp": Walks.STAMP}]


def plain(numbers):
    """A typed array of int32, as this is tested without the code that reads it elsewhere."""
    if isinstance(numbers, cbor2.CBORTag):
        assert numbers.tag == 78
        data = numbers.value
        return [int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4)]
    return numbers


@pytest.mark.parametrize("name", ["Fibonacci", "NestedMessage"])
def test_an_id_goes_before_a_goal_and_feedback_without_converting_them(name):
    type_name, id_ = f"test_msgs/action/{name}", bytes(range(16))
    fields = {
        "Fibonacci": {"order": 7},
        "NestedMessage": {
            "nested_field_no_pkg": {"duration_value": {"sec": 1, "nanosec": 2}},
            "nested_field": {"bool_value": True, "float64_value": 0.5, "int64_value": -1},
        },
    }[name]
    goal = cdr(f"{type_name}_Goal", fields)
    whole = cdr(f"{type_name}_SendGoal_Request", {"goal_id": {"uuid": id_}, "goal": fields})
    assert with_id(goal, id_, CDR) == whole
    assert split_id(whole, CDR) == (id_, goal)


def test_an_id_goes_before_a_goal_of_ros_1():
    assert with_id(b"goal", bytes(range(16)), PACKED) == bytes(range(16)) + b"goal"
    assert split_id(bytes(range(16)) + b"goal", PACKED) == (bytes(range(16)), b"goal")


@every_encoding
async def test_a_missing_result_is_reported_as_json_or_cbor(harness, encoding):
    walks = await begin(harness, encoding=encoding)
    client = harness.client("alice", "r2d2/walk/_result/+")
    await ask(client, GOAL, b"")
    ((goal, _),) = walks.goals
    await until(lambda: goal in walks.results, "the result is asked for")
    walks.end(goal, status=0)
    await until(lambda: client.on(f"r2d2/walk/_result/{goal}"), "the result")
    result = decode(client.on(f"r2d2/walk/_result/{goal}")[0], None)
    assert result["status"] == "unknown" and result["error"]["code"] == "vanished"


@every_encoding
async def test_a_goal_s_answer_cancels_that_goal_alone(harness, encoding):
    walks = await begin(harness)
    client = harness.client("alice")
    payload = encode(encoding, f"{FIBONACCI}_Goal", {"order": 7})
    _, answer = await ask(client, GOAL, payload, TYPES[encoding])
    ((goal, _),) = walks.goals
    status, done = await ask(client, STOP, answer.payload, TYPES[encoding])
    assert status == "ok", done.payload
    # Without its stamp: with it, ROS would cancel all goals that were accepted before, too.
    assert walks.cancelled == [(goal, {"sec": 0, "nanosec": 0})]
    said = decode(done, f"{CANCEL}_Response")
    (one,) = said["goals_canceling"]
    assert (id_of(one["goal_id"]).hex() if encoding == "cdr" else one) == goal


NONE = "00" * 16


async def test_cancelling_all_and_all_before_a_time(harness):
    walks = await begin(harness, cancel="any")
    client = harness.client("alice")
    nobody, start = {"goal_id": NONE}, {"sec": 0, "nanosec": 0}
    for payload, stamp in (
        ({"all": True}, start),
        ({**nobody, "stamp": start}, start),
        ({**nobody, "stamp": {"sec": 9, "nanosec": 1}}, {"sec": 9, "nanosec": 1}),
        ({"stamp": {"sec": 9}}, {"sec": 9, "nanosec": 0}),
    ):
        assert (await client.call(STOP, payload))[0] == "ok"
        assert walks.cancelled.pop() == (NONE, stamp)
    for payload in ({}, b"", [], "x", {"goal_id": "12"}, {"goal_id": "zz" * 16}, {"goal_id": 7}):
        assert (await client.error(STOP, payload))[0] == "bad_request", payload
    for payload in ({"stamp": 7}, {"stamp": {"sec": "x"}}, {"all": True, "goal_id": NONE}):
        assert (await client.error(STOP, payload))[0] == "bad_request", payload
    work = {"all": [[]] * 20_000}  # for the time of which everybody would wait
    assert (await client.error(STOP, work))[0] == "too_large"
    assert walks.cancelled == []


async def test_a_client_may_cancel_its_own_goals_without_further_rights(harness):
    walks = await begin(harness)
    harness.rules.deny("bob", "publish", "r2d2/walk/_cancel_any")
    alice, bob = harness.client("alice"), harness.client("bob")
    hers = (await alice.call(GOAL, {"order": 1}))[1]["goal_id"]
    his = (await bob.call(GOAL, {"order": 2}))[1]["goal_id"]
    stranger = "11" * 16  # as of a ROS node
    for payload in ({"goal_id": hers}, {"goal_id": stranger}, {"all": True}, {"stamp": "now"}):
        code, message = await bob.error(STOP, payload)
        assert code == "not_authorized" and "r2d2/walk/_cancel_any" in message
    assert walks.cancelled == []
    assert (await bob.call(STOP, {"goal_id": his}))[1] == {"goals_canceling": [his]}
    # Also when it has ended, and by whichever of the user's clients.
    walks.end(his)
    bob.leave()
    again = harness.client("bob")
    assert (await again.call(STOP, {"goal_id": his}))[0] == "ok"
    # Who may write to _cancel_any, or everyone where the route says so, may cancel them all.
    assert (await alice.call(STOP, {"goal_id": his}))[0] == "ok"
    assert (await alice.call(STOP, {"goal_id": stranger}))[0] == "ok"
    harness.bridge.calls.replace(call_routes(action("/walk", cancel="any")))
    assert (await again.call(STOP, {"all": True}))[0] == "ok"
    assert [goal for goal, _ in walks.cancelled] == [his, his, his, stranger, NONE]


# Parameters


class Node:
    """A node with two parameters, one of them of bytes."""

    def __init__(self, harness):
        self.set = []
        for verb, kind, handle in (
            ("list_parameters", "ListParameters", self.on_list),
            ("get_parameters", "GetParameters", self.on_get),
            ("describe_parameters", "DescribeParameters", self.on_describe),
            ("set_parameters", "SetParameters", self.on_set),
            ("set_parameters_atomically", "SetParametersAtomically", self.on_set),
        ):
            self._serve(harness.node, f"/arm/{verb}", f"rcl_interfaces/srv/{kind}", handle)

    def _serve(self, node, name, kind, handle):
        def on_request(request, respond):
            answer = handle(value(f"{kind}_Request", request))
            respond(cdr(f"{kind}_Response", answer))

        node.add_service(name, kind, on_request)

    def on_list(self, request):
        return {"result": {"names": ["speed", "key"]}}

    def on_get(self, request):
        known = {
            "speed": {"type": 3, "double_value": 0.5},
            "key": {"type": 5, "byte_array_value": b"\1\2"},
        }
        return {"values": [known[name] for name in request["names"]]}

    def on_describe(self, request):
        types = {"speed": 3, "key": 5}
        return {"descriptors": [{"name": n, "type": types[n]} for n in request["names"]]}

    def on_set(self, request):
        self.set += [(one["name"], one["value"]) for one in request["parameters"]]
        results = [{"successful": True} for _ in request["parameters"]]
        return {"results": results} if len(results) == 1 else {"result": results[0]}


async def test_parameters_in_cbor(harness):
    harness.start(parameters("/arm/*", encoding="cbor"))
    node = Node(harness)
    harness.node.spin()
    client = harness.client("alice", "r2d2/arm/_param/+")
    await until(lambda: client.on("r2d2/arm/_param/key"), "the values")
    key = client.on("r2d2/arm/_param/key")[0]
    assert key.properties[Property.CONTENT_TYPE] == "application/cbor"
    assert cbor2.loads(key.payload) == b"\1\2"
    assert cbor2.loads(client.on("r2d2/arm/_param/speed")[0].payload) == 0.5
    for topic, payload, said in (
        ("key/set", cbor2.dumps(b"\3"), None),
        ("speed/set", b"1", "application/json"),
        ("_set", cbor2.dumps({"speed": 2, "key": b"\4"}), "application/cbor"),
    ):
        status, answer = await ask(client, f"r2d2/arm/_param/{topic}", payload, said)
        assert (status, decode(answer, None)) == ("ok", {"successful": True, "reason": ""})
        assert answer.properties[Property.CONTENT_TYPE] == (said or "application/cbor")
    assert [(name, v["double_value"], v["byte_array_value"]) for name, v in node.set] == [
        ("key", 0.0, "Aw=="),
        ("speed", 1.0, ""),
        ("speed", 2.0, ""),
        ("key", 0.0, "BA=="),
    ]
    for payload, said, what in (
        (cbor2.dumps(b"\3"), "application/cbor", "speed: expected a double, got b'\\x03'"),
        (cbor2.dumps({1: 2}), "application/cbor", "not CBOR: "),
        (cbor2.dumps({"x": b"y"}), "application/cbor", "speed: expected a double, got {'x': b'y'}"),
        (
            b"\0\1\0\0",
            "application/cdr",
            "a call of the parameters of /arm may be json or cbor, not cdr",
        ),
    ):
        status, answer = await ask(client, "r2d2/arm/_param/speed/set", payload, said)
        error = decode(answer, None)["error"]
        assert (status, error["code"]) == ("error", "bad_request")
        assert error["message"].startswith(what)
    status, answer = await ask(client, "r2d2/arm/_param/_set", cbor2.dumps({b"x": 2}))
    assert decode(answer, None)["error"]["message"].startswith("expected parameters and values")
