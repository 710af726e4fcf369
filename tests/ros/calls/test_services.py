"""Calls and services on a FakeNode and the real broker."""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import math
import time

import pytest
from waiting import until

pytest.importorskip("std_srvs.srv")
from call_harness import AllTypes, CallHarness, call_routes, service

from appliance.broker.message import DatedMessage, DelayedMessage, Message
from appliance.broker.session import Session
from appliance.mqtt.codec import Property
from appliance.mqtt.reason import ReasonCode
from appliance.ros.bridge import Bridge
from appliance.ros.calls import dispatcher as calls
from appliance.ros.calls.dispatcher import CallLimits
from appliance.ros.node import FakeClient, FakeNode
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import load_description
from appliance.ros.payload.payloads import InputLimits

SET_BOOL, TRIGGER = "std_srvs/srv/SetBool", "std_srvs/srv/Trigger"
CONVERTERS = Converters(load_description)


def cdr(type_name, value):
    return CONVERTERS.get(type_name).from_dict(value)


def value(type_name, data):
    return CONVERTERS.get(type_name).to_dict(data)


@pytest.fixture
async def harness():
    harness = CallHarness(FakeNode(types=AllTypes()))
    yield harness
    await harness.stop()
    assert harness.node.clients == harness.node.own_services == []


class Switch:
    """A SetBool service; with `holds` the answers wait."""

    def __init__(self, harness, name="/switch"):
        self.asked = []
        self.waiting = []
        self.holds = False
        self.service = harness.node.add_service(name, SET_BOOL, self.on_request)

    def on_request(self, request, respond):
        data = value(f"{SET_BOOL}_Request", request)["data"]
        self.asked.append(data)
        self.waiting.append((respond, data))
        if not self.holds:
            self.answer()

    def answer(self):
        for respond, data in self.waiting:
            answer = {"success": data, "message": "on" if data else "off"}
            respond(cdr(f"{SET_BOOL}_Response", answer))
        self.waiting.clear()


CALL = "r2d2/switch/_call"


async def test_a_call_of_each_version(harness):
    harness.start(service("/switch"))
    Switch(harness)
    client = harness.client("alice")
    status, answer = await client.call(CALL, {"data": True})
    assert (status, answer) == ("ok", {"success": True, "message": "on"})
    (message,) = client.on("answers/alice")
    assert message.qos == 1 and not message.retain
    assert message.properties == {
        Property.CORRELATION_DATA: b"alice 1",
        Property.CONTENT_TYPE: "application/json",
        Property.USER_PROPERTY: [("status", "ok"), ("ros-type", f"{SET_BOOL}_Response")],
    }
    assert await client.call_311(CALL, {"data": True}) == {"success": True, "message": "on"}
    # An empty payload has every field's default.
    assert await client.call_311(CALL) == {"success": False, "message": "off"}
    counters = harness.counters()
    assert (counters.calls, counters.answers, counters.under_way) == (3, 3, 0)
    assert not counters.errors


async def test_many_calls_at_once_get_each_its_own_answer(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    switch.holds = True
    clients = [harness.client(f"c{i}") for i in range(10)]
    calls = [
        asyncio.ensure_future(client.call(CALL, {"data": bool(i % 2)}))
        for client in clients
        for i in range(10)
    ]
    await until(lambda: len(switch.asked) == 100, "the requests")
    assert harness.counters().under_way == 100
    switch.waiting.reverse()
    switch.answer()
    answers = await asyncio.gather(*calls)
    assert [answer["success"] for _, answer in answers] == [bool(i % 2) for i in range(10)] * 10


async def test_raw_cdr(harness):
    harness.start(service("/switch", encoding="cdr"))
    Switch(harness)
    await asyncio.sleep(0)  # the bridge sees it
    client = harness.client("alice")
    client.send(CALL, cdr(f"{SET_BOOL}_Request", {"data": True}), response_topic="answers/alice")
    client.send(CALL, b"\0\1\0\0", response_topic="answers/alice")
    await until(lambda: len(client.on("answers/alice")) == 2, "the answers")
    answers = {
        message.properties[Property.CONTENT_TYPE]: message.payload
        for message in client.on("answers/alice")
    }
    assert value(f"{SET_BOOL}_Response", answers["application/cdr"])["message"] == "on"
    assert json.loads(answers["application/json"])["error"]["code"] == "bad_request"


async def test_a_service_that_is_absent(harness):
    harness.start(service("/switch"), service("/typed", type=SET_BOOL))
    client = harness.client("alice")
    expected = ("unavailable", "there is no /switch on the bus")
    assert await client.error(CALL, {"data": True}) == expected
    assert await client.error("r2d2/typed/_call", {"data": True}) == (
        "unavailable",
        "there is no /typed on the bus",
    )
    answer = await client.call_311(CALL, {"data": True})
    assert answer["error"] == {"code": expected[0], "message": expected[1]}
    Switch(harness)
    await asyncio.sleep(0)
    harness.node.spin()
    await asyncio.sleep(0)
    assert (await client.call(CALL))[0] == "ok"


@pytest.mark.parametrize("ros", ["/switch", "/*"])
async def test_a_service_that_vanishes_during_the_call(harness, ros):
    harness.start(service(ros, mqtt="r2d2{ros}"))
    switch = Switch(harness)
    switch.holds = True
    client = harness.client("alice")
    await asyncio.sleep(0)  # a pattern has seen it
    calling = asyncio.ensure_future(client.error(CALL, {"data": True}))
    await until(lambda: switch.asked, "the request")
    switch.service.remove()
    assert await calling == ("vanished", "/switch went away before it answered")


async def test_no_answer_within_the_routes_time(harness):
    harness.start(service("/switch", timeout=0.05))
    switch = Switch(harness)
    switch.holds = True
    client = harness.client("alice")
    assert await client.error(CALL) == ("timeout", "no answer from /switch within 0.05 s")
    switch.answer()  # too late: it is not told a second time
    await asyncio.sleep(0.02)
    assert len(client.on("answers/alice")) == 1
    assert harness.counters().under_way == 0
    assert harness.counters().errors == {"timeout": 1}


@pytest.mark.parametrize(
    ("payload", "problem"),
    [
        (b'{"data": 1}', "data: expected true or false, got 1"),
        (b'{"date": true}', "date: unknown field; did you mean 'data'?"),
        (b"{", "not JSON"),
        (b"\xff\x00", "not JSON"),
    ],
)
async def test_a_payload_that_is_wrong_names_the_field(harness, payload, problem):
    harness.start(service("/switch"))
    switch = Switch(harness)
    code, message = await harness.client("alice").error(CALL, payload)
    assert code == "bad_request"
    assert problem in message
    assert switch.asked == []


async def test_a_type_that_is_not_installed(harness):
    harness.start(service("/switch"))
    harness.node.add_service("/switch", "no_pkg/srv/Thing", lambda request, respond: None)
    harness.node.spin()
    code, message = await harness.client("alice").error(CALL)
    assert code == "unknown_type"
    assert "no_pkg" in message


async def test_calls_are_limited_for_each_client_and_in_total(harness):
    harness.start()
    harness.bridge.calls.replace(call_routes(service("/switch"), limits=CallLimits(2, 5, 4)))
    switch = Switch(harness)
    switch.holds = True
    harness.node.spin()
    clients = [harness.client(name) for name in "abcd"]
    calls = [asyncio.ensure_future(c.call(CALL)) for c in clients[:2] for _ in range(2)]
    await until(lambda: len(switch.asked) == 4, "the requests")
    assert await clients[0].error(CALL) == (
        "too_many",
        "2 calls of this client are under way, as many as may be (bridge.limits.calls_per_client)",
    )
    calls.append(asyncio.ensure_future(clients[2].call(CALL)))
    await until(lambda: len(switch.asked) == 5, "the fifth")
    assert await clients[3].error(CALL) == (
        "too_many",
        "5 calls of all clients are under way, as many as may be (bridge.limits.calls)",
    )
    switch.answer()
    assert {status for status, _ in await asyncio.gather(*calls)} == {"ok"}
    switch.holds = False
    assert (await clients[0].call(CALL))[0] == "ok"  # all of their places are free again


async def test_a_call_without_a_reply_topic_is_not_carried_out(harness, caplog):
    harness.start(service("/switch"))
    switch = Switch(harness)
    client = harness.client("alice", "r2d2/switch/_reply/alice/#")
    client.send(CALL, {"data": True})
    await until(lambda: client.on("r2d2/switch/_reply/alice"), "the error")
    (answer,) = client.payloads("r2d2/switch/_reply/alice")
    assert answer["error"]["code"] == "no_response_topic"
    assert "r2d2/switch/_call/TOKEN" in answer["error"]["message"]
    assert switch.asked == []
    assert "no_response_topic" in caplog.text
    # A client id that cannot be in a topic: MQTT 5's way is left to it.
    strange = harness.client("a/b")
    strange.send(f"{CALL}/1", {"data": True})
    await asyncio.sleep(0.01)
    assert switch.asked == []
    assert harness.counters().errors == {"no_response_topic": 2}
    assert (await strange.call(CALL, {"data": True}, "answers/a/b"))[0] == "ok"


@pytest.mark.parametrize("size", [100, 40_000], ids=str)
async def test_a_reply_topic_that_would_be_too_long_is_rejected(harness, size):
    """Its own topic for answers would be longer than a string can be: refused, and no fault."""
    harness.start(service("/switch"))
    switch = Switch(harness)
    client = harness.client("a" * size)
    client.send(f"{CALL}/{'t' * (65_500 - min(size, 60))}", {"data": True})
    await asyncio.sleep(0.01)
    assert harness.counters().errors == {"no_response_topic": 1}
    assert not switch.asked and not harness.broker.faults.count
    assert (await harness.client("bob").call(CALL, {"data": True}))[0] == "ok"


async def test_a_caller_cannot_use_the_bridge_to_write_where_it_may_not(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    harness.rules.deny("mallory", "publish", "r2d2/cmd_vel")
    mallory = harness.client("mallory", "r2d2/#")
    victim = harness.client("victim", "r2d2/cmd_vel", "r2d2/arm", "$SYS/#")
    harness.broker.guards["r2d2/arm"] = []  # where commands are received that have rules
    for topic in ("r2d2/cmd_vel", "$SYS/broker/version", "r2d2/arm"):
        mallory.send(CALL, {"data": True}, response_topic=topic)
    await until(lambda: len(mallory.on("r2d2/switch/_reply/mallory")) == 3, "the refusals")
    codes = {a["error"]["code"] for a in mallory.payloads("r2d2/switch/_reply/mallory")}
    assert codes == {"not_authorized"}
    assert switch.asked == [] and victim.received == []
    # Where it may publish it could have written itself.
    assert (await mallory.call(CALL, response_topic="r2d2/elsewhere"))[0] == "ok"


async def test_the_replies_below_its_own_name_need_the_right_to_read_them(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    harness.rules.deny("alice", "publish", "r2d2/switch/_reply")
    harness.rules.deny("bob", "receive", "r2d2/switch/_reply")
    alice = harness.client("alice", "r2d2/switch/_reply/alice/#")
    status, _ = await alice.call(CALL, response_topic="r2d2/switch/_reply/alice/mine")
    assert status == "ok"
    # Another's is not its own, though it begins alike.
    alice.send(CALL, response_topic="r2d2/switch/_reply/alice2/x")
    await until(lambda: alice.on("r2d2/switch/_reply/alice"), "the refusal")
    before = len(switch.asked)
    harness.client("bob").send(f"{CALL}/1")
    await until(lambda: harness.counters().errors["not_authorized"] == 2, "the second refusal")
    assert len(switch.asked) == before


async def test_an_answer_is_no_call(harness):
    """A Response Topic that is a call topic, or a route's to ROS, does not go round."""
    harness.start(service("/switch"))
    switch = Switch(harness)
    await asyncio.sleep(0)  # the bridge sees it
    harness.client("alice").send(CALL, {"data": True}, response_topic=CALL)
    await until(lambda: harness.counters().answers, "the answer")
    await asyncio.sleep(0.02)
    assert switch.asked == [True]


async def test_a_retained_call_is_not_carried_out(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    client = harness.client("alice")
    client.send(CALL, {"data": True}, retain=True, response_topic="answers/alice")
    await until(lambda: client.on("answers/alice"), "the error")
    assert client.payloads("answers/alice")[0]["error"]["code"] == "bad_request"
    assert switch.asked == []


async def test_an_old_call_is_not_carried_out_nor_what_was_queued_behind_it(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    client = harness.client("alice")
    again = Message(CALL, b"", 1, properties={Property.RESPONSE_TOPIC: "answers/alice"})
    harness.broker.publish(DelayedMessage(again, 60.0), client.session)
    client.send(CALL, {"data": True}, response_topic="answers/alice")
    await until(lambda: len(client.on("answers/alice")) == 2, "the errors")
    codes = [answer["error"]["code"] for answer in client.payloads("answers/alice")]
    assert codes == ["expired", "expired"] and switch.asked == []
    late = DelayedMessage(again, 1.0)  # within its time
    harness.broker.publish(late, harness.client("bob").session)
    await until(lambda: switch.asked, "another client's call")


async def test_a_late_call_of_a_link_says_nothing_of_those_behind_it(harness):
    """They are of other clients of the fleet, and come in bursts, too."""
    harness.start(service("/switch"))
    switch = Switch(harness)
    harness.node.spin()
    await asyncio.sleep(0)
    link = harness.client("link")
    said = {Property.RESPONSE_TOPIC: "answers/link"}
    for payload, age in ((b"", 60.0), (b"", math.inf), *[(b'{"data": true}', 4.0)] * 5):
        call = DatedMessage(Message(CALL, payload, 1, properties=said), age)
        harness.broker.publish(call, link.session)
    await until(lambda: len(link.on("answers/link")) == 7, "the answers")
    answers = link.payloads("answers/link")
    assert [each["error"]["code"] for each in answers if "error" in each] == ["expired"] * 2
    assert switch.asked == [True] * 5


@pytest.mark.parametrize(
    ("ago", "code"), [(60.0, "expired"), (-60.0, "bad_request"), (0.0, None), (3.0, None)]
)
async def test_a_call_that_says_to_be_old_has_expired(harness, ago, code):
    """Also the first of a client that was never seen, which may have queued it."""
    harness.start(service("/switch"))
    switch = Switch(harness)
    harness.node.spin()
    await asyncio.sleep(0)
    said = {
        Property.RESPONSE_TOPIC: "answers/alice",
        Property.USER_PROPERTY: [("sent-at", str(time.time() - ago))],
    }
    client = harness.client("alice")
    harness.broker.publish(Message(CALL, b"", 1, properties=said), client.session)
    if code is None:
        await until(lambda: switch.asked, "the call")
        return
    await until(lambda: client.on("answers/alice"), "the error")
    assert client.payloads("answers/alice")[0]["error"]["code"] == code
    assert switch.asked == []


async def test_patterns_follow_the_bus(harness):
    harness.start(
        service(["/arm/*", "!/arm/secret"], type="std_srvs/srv/*"),
        service(["/absent", "/**", "!/arm/secret"]),
    )
    node = harness.node
    Switch(harness, "/arm/grip")
    other = Switch(harness, "/other")
    Switch(harness, "/arm/secret")
    Switch(harness, "/_hidden")
    node.add_service("/node/set_parameters", "rcl_interfaces/srv/SetParameters", None)
    node.spin()
    await asyncio.sleep(0)
    first, second = harness.bridge.calls.status()
    assert first.names == ("/arm/grip",)
    assert set(second.names) == {"/absent", "/other"}
    client = harness.client("alice")
    assert (await client.call("r2d2/arm/grip/_call"))[0] == "ok"
    routes = harness.retained("r2d2/_appliance/routes")
    assert {
        "ros": "/other",
        "mqtt": "r2d2/other/_call",
        "type": SET_BOOL,
        "direction": "service",
        "encoding": "json",
        "timeout": 5.0,
    } in routes
    other.service.remove()
    node.spin()
    await asyncio.sleep(0)
    assert harness.bridge.calls.status()[1].names == ("/absent",)
    assert [r["ros"] for r in harness.retained("r2d2/_appliance/routes")] == ["/arm/grip"]


async def test_routes_come_and_go_while_calls_are_under_way(harness):
    stays = service("/switch")
    harness.start(stays, service("/other"))
    switch, other = Switch(harness), Switch(harness, "/other")
    switch.holds = other.holds = True
    client = harness.client("alice")
    staying = asyncio.ensure_future(client.call(CALL))
    leaving = asyncio.ensure_future(client.call("r2d2/other/_call"))
    await until(lambda: switch.asked and other.asked, "the requests")
    harness.bridge.calls.replace(call_routes(stays, service("/new")))
    switch.answer()
    other.answer()  # what was asked before is answered yet
    assert (await staying)[0] == (await leaving)[0] == "ok"
    assert client.send("r2d2/other/_call") is ReasonCode.NO_MATCHING_SUBSCRIBERS
    Switch(harness, "/new")
    harness.node.spin()
    await asyncio.sleep(0)
    assert (await client.call("r2d2/new/_call"))[0] == "ok"
    assert harness.counters().calls == 1


async def test_calls_under_way_are_answered_when_the_appliance_stops_or_ros_ends(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    switch.holds = True
    client = harness.client("alice")
    calling = asyncio.ensure_future(client.error(CALL))
    await until(lambda: switch.asked, "the request")
    harness.node.fail("the node ended")
    assert await calling == ("ros_error", "the connection to ROS ended")
    assert (await client.error(CALL))[0] in ("unavailable", "ros_error")
    harness.node.running = True
    harness.node.spin()
    await asyncio.sleep(0)
    calling = asyncio.ensure_future(client.error(CALL))
    await until(lambda: len(switch.asked) == 2, "the request")
    await harness.bridge.stop()
    assert (await calling)[0] == "stopping"


async def test_requests_that_waited_are_sent_once_when_sending_one_raises(
    harness, monkeypatch, escaped
):
    harness.start(service("/switch"))
    Switch(harness)
    client = harness.client("alice")
    sent = []

    def call(_, request, done):
        sent.append(request)
        if len(sent) == 2:
            raise OSError("too many open files")
        return lambda: None

    with monkeypatch.context() as patch:
        patch.setattr(FakeClient, "is_ready", lambda _: False)
        patch.setattr(FakeClient, "call", call)
        await asyncio.sleep(0)
        for number in range(3):
            client.send(CALL, {"data": True}, response_topic=f"answers/{number}")
        await asyncio.sleep(0.01)
        assert sent == []
        patch.setattr(FakeClient, "is_ready", lambda _: True)
        for _ in range(4):
            harness.node.spin()
    assert sent == [cdr(f"{SET_BOOL}_Request", {"data": True})] * 3
    await asyncio.sleep(0)
    assert len(escaped) == 1
    escaped.clear()


async def test_the_calls_of_a_client_that_has_gone_are_removed(harness):
    harness.start(service("/switch"))
    Switch(harness)
    client = harness.client("alice")
    await client.call(CALL)
    for token in range(9):
        client.send(f"{CALL}/{token}")
    await until(lambda: harness.counters().answers == 10, "the answers")
    gc.collect()
    gc.disable()  # nobody looks for circles among what is old
    try:
        client.leave()
        del client
        await harness.client("bob").call(CALL)  # caches that it was in are made anew
        sessions = [one for one in gc.get_objects() if isinstance(one, Session)]
        assert not [one for one in sessions if one.client_id == "alice"]
    finally:
        gc.enable()


# ROS to MQTT


PROVIDED = service("/ask", to="mqtt", type=SET_BOOL, timeout=60)


class Asker:
    """A ROS client of /ask."""

    def __init__(self, harness):
        self.harness = harness
        self.responses = []

    def ask(self, data=True):
        def done(response):
            response = None if response is None else value(f"{SET_BOOL}_Response", response)
            self.responses.append(response)

        self.harness.node.ask("/ask", cdr(f"{SET_BOOL}_Request", {"data": data}), done)


async def test_a_ros_service_that_mqtt_answers(harness):
    harness.start(PROVIDED)
    asker = Asker(harness)
    client = harness.client("alice", "r2d2/ask/_request/+")
    asker.ask()
    await until(lambda: client.received, "the request")
    (request,) = client.received
    token = request.topic.rpartition("/")[2]
    assert json.loads(request.payload) == {"data": True}
    assert request.properties[Property.RESPONSE_TOPIC] == f"r2d2/ask/_response/{token}"
    assert request.properties[Property.CORRELATION_DATA] == token.encode()
    assert request.expires_at is not None
    client.send(f"r2d2/ask/_response/{token}", {"success": True, "message": "hi"})
    client.send(f"r2d2/ask/_response/{token}", {"success": False})  # the second is nobody's
    await until(lambda: asker.responses, "the response")
    await asyncio.sleep(0.01)
    assert asker.responses == [{"success": True, "message": "hi"}]
    counters = harness.counters()
    assert (counters.calls, counters.answers, counters.under_way) == (1, 1, 0)


NOBODY = '{"success": false, "message": "nobody"}'


async def test_ros_gets_the_routes_answer_when_mqtt_gives_none(harness):
    harness.start(service("/ask", to="mqtt", type=SET_BOOL, timeout=0.05, on_error=NOBODY))
    asker = Asker(harness)
    nobody = json.loads(NOBODY)
    asker.ask()  # nobody has subscribed: at once
    await until(lambda: asker.responses == [nobody], "the first", 1)
    client = harness.client("alice", "r2d2/ask/_request/+")
    asker.ask()  # no response
    await until(lambda: asker.responses == [nobody] * 2, "the second")
    assert client.received
    assert harness.counters().errors == {"unavailable": 1, "timeout": 1}


async def test_ros_gets_the_routes_answer_when_mqtts_is_none(harness):
    harness.start(service("/ask", to="mqtt", type=SET_BOOL, timeout=60, on_error=NOBODY))
    asker = Asker(harness)
    client = harness.client("alice", "r2d2/ask/_request/+")
    for number, (payload, properties) in enumerate(
        [
            (b'{"success": 7}', {}),
            (b"{", {}),
            (b'{"error": {"code": "x", "message": "y"}}', {}),
            (b"no", {"user_property": [("status", "error")]}),
        ],
        1,
    ):
        asker.ask()
        await until(lambda n=number: len(client.received) == n, "the request")
        topic = client.received[-1].properties[Property.RESPONSE_TOPIC]
        client.send(topic, payload, **properties)
        await until(lambda n=number: asker.responses == [json.loads(NOBODY)] * n, payload)
    assert harness.counters().errors == {"bad response": 2, "rejected": 2}


@pytest.mark.parametrize(
    "payload",
    [b"\0\1\0\0\1", b'{"error": {"code": "busy", "message": "no"}}'],
    ids=["cut", "error"],
)
async def test_an_answer_that_is_no_cdr_is_an_error(harness, payload):
    """It says that it is, and is too short, or an error as JSON."""
    on_error = '{"success": false, "message": "nobody"}'
    harness.start(service("/ask", to="mqtt", type=SET_BOOL, timeout=20, on_error=on_error))
    client = harness.client("alice", "r2d2/ask/_request/+")
    answers = []
    harness.node.ask("/ask", cdr(f"{SET_BOOL}_Request", {}), answers.append)
    await until(lambda: client.received, "the request")
    token = client.received[-1].topic.rpartition("/")[2]
    client.send(f"r2d2/ask/_response/{token}", payload, content_type="application/cdr")
    await until(lambda: answers, "the answer")
    assert value(f"{SET_BOOL}_Response", answers[0])["message"] == "nobody"


async def test_without_on_error_ros_gets_nothing(harness):
    harness.start(PROVIDED)
    asker = Asker(harness)
    asker.ask()
    await until(lambda: harness.counters().errors, "the failure")
    await asyncio.sleep(0.01)
    assert asker.responses == [None]


async def test_an_offered_service_goes_with_its_route(harness):
    harness.start(PROVIDED)
    assert [s.name for s in harness.node.own_services] == ["/ask"]
    harness.bridge.calls.replace(call_routes())
    assert harness.node.own_services == []
    harness.bridge.calls.replace(call_routes(PROVIDED))
    harness.node.spin()
    assert [s.name for s in harness.node.own_services] == ["/ask"]


async def test_a_removed_service_is_not_offered_by_a_node_that_joins_meanwhile(
    harness, monkeypatch
):
    harness.start(PROVIDED)
    harness.node.fail("the node ended")
    harness.replace_while_the_node_joins(monkeypatch)
    harness.node.spin()
    assert harness.node.own_services == []


async def test_bridges_without_calls_ask_nothing_of_the_graph(harness):
    harness.node.services = None  # would raise
    bridge = harness.start()
    assert isinstance(bridge, Bridge)
    harness.node.spin()


async def test_a_client_id_with_a_slash_gives_no_way_into_the_answers_of_another(harness):
    harness.start(service("/switch"))
    switch = Switch(harness)
    harness.rules.deny("alice/1", "publish", "r2d2/switch/_reply")
    alice = harness.client("alice", "r2d2/switch/_reply/alice/+")
    mallory = harness.client("alice/1")
    for topic in ("r2d2/switch/_reply/alice/1", "r2d2/switch/_reply/alice/1/2"):
        mallory.send(CALL, {"data": True}, response_topic=topic)
    await until(lambda: harness.counters().errors.total() == 2, "the refusals")
    await asyncio.sleep(0.02)
    assert harness.counters().errors == {"not_authorized": 2}
    assert switch.asked == [] and alice.received == []
    status, _ = await mallory.call(CALL, {"data": True})  # where it may publish, it has answers
    assert status == "ok"


async def test_of_two_services_at_one_topic_the_second_waits_for_it(harness, caplog):
    first, second = service("/switch"), service("/other", mqtt="r2d2/switch")
    harness.start(first)
    switch, other = Switch(harness), Switch(harness, "/other")
    client = harness.client("alice")
    harness.bridge.calls.replace(call_routes(first, second))
    assert "/other cannot be called: calls at r2d2/switch/_call are for /switch" in caplog.text
    await client.call(CALL, {"data": True})
    assert (switch.asked, other.asked) == ([True], [])
    harness.bridge.calls.replace(call_routes(second))
    await client.call(CALL, {"data": False})
    assert (switch.asked, other.asked) == ([True], [False])
    harness.bridge.calls.replace(call_routes())
    assert harness.bridge.calls.dispatcher._endpoints == {}


async def test_a_call_that_is_too_large(harness):
    harness.start(service("/switch"), service("/ask", to="mqtt", type=SET_BOOL, on_error="{}"))
    harness.bridge.calls.dispatcher.limits = CallLimits(input=InputLimits(payload=100))
    switch = Switch(harness)
    client = harness.client("alice", "r2d2/ask/_request/+")
    before = harness.broker.counters.cost
    code, text = await client.error(CALL, b'{"data": true}' + b" " * 87)
    assert (code, switch.asked) == ("too_large", [])
    assert "101 bytes" in text and "bridge.limits.payload" in text
    assert harness.broker.counters.cost > before + 101 // 16
    said = []
    harness.node.ask("/ask", cdr(f"{SET_BOOL}_Request", {}), said.append)
    await until(lambda: client.received[1:], "the request")
    request = client.received[-1].topic
    client.send(request.replace("_request", "_response"), b'{"success": true}' + b" " * 100)
    await until(lambda: said, "the response")
    assert value(f"{SET_BOOL}_Response", said[0])["success"] is False


async def test_calls_are_limited_in_bytes(harness, monkeypatch):
    monkeypatch.setattr(calls, "MAX_BYTES", 100)
    harness.start(service("/switch"))
    switch = Switch(harness)
    switch.holds = True
    await asyncio.sleep(0)  # the bridge sees it
    client = harness.client("alice")
    for token in (1, 2):
        client.send(f"{CALL}/{token}", b'{"data": true}' + b" " * 26)
    code, _ = await client.error(CALL, b'{"data": true}' + b" " * 26)
    assert code == "too_many"
    await until(lambda: len(switch.asked) == 2, "the calls")
    switch.answer()
    await until(lambda: harness.counters().under_way == 0, "the answers")
    switch.holds = False
    assert (await client.call(CALL, {"data": True}))[0] == "ok"


async def test_a_provided_service_that_is_removed_answers_the_requests_under_way(harness):
    on_error = '{"success": false, "message": "gone"}'
    harness.start(service("/ask", to="mqtt", type=SET_BOOL, on_error=on_error))
    harness.client("alice", "r2d2/ask/_request/+")
    said = []
    harness.node.ask("/ask", cdr(f"{SET_BOOL}_Request", {}), said.append)
    await until(lambda: harness.counters().under_way, "the request")
    harness.bridge.calls.replace(call_routes())
    await until(lambda: said, "the response")
    assert value(f"{SET_BOOL}_Response", said[0])["message"] == "gone"


async def test_a_service_of_another_type_than_the_route_says(harness):
    harness.start(service("/switch", type=TRIGGER, timeout=1.0))
    Switch(harness)
    client = harness.client("alice")
    code, text = await client.error(CALL)
    assert code == "unavailable"
    assert text == f"/switch is a {SET_BOOL} on the bus, not a {TRIGGER}"


async def test_a_service_that_no_node_offers_is_not_logged_as_callable(harness, caplog):
    caplog.set_level(logging.INFO)
    harness.start(service("/switch"))
    assert "can be called" not in caplog.text
    assert "/switch: no node offers it yet; it will be called at r2d2/switch/_call" in caplog.text
    switch = Switch(harness)
    harness.node.spin()
    await until(lambda: "/switch can be called at r2d2/switch/_call" in caplog.text)
    switch.service.remove()
    await until(lambda: "/switch cannot be called any more" in caplog.text)
    harness.node.spin()
    await asyncio.sleep(0)
    assert caplog.text.count("can be called") == 1
