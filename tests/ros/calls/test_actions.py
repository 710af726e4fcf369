"""Actions on a FakeNode: cases that are hard to cause with a real robot."""

from __future__ import annotations

import asyncio
import time

import pytest
from waiting import until

pytest.importorskip("test_msgs.action")
from call_harness import AllTypes, CallHarness, action, call_routes

from appliance.ros.calls import actions as module
from appliance.ros.calls import service_clients
from appliance.ros.calls.goals import STATUS, id_of
from appliance.ros.node import Durability, FakeNode, QosProfile
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import load_description

FIBONACCI, CANCEL = "test_msgs/action/Fibonacci", "action_msgs/srv/CancelGoal"
CONVERTERS = Converters(load_description)
GOAL, STOP = "r2d2/walk/_goal", "r2d2/walk/_cancel"


class WalkServer:
    """An action's server, which answers on demand."""

    def __init__(self, harness):
        self.harness = harness
        self.accepting = True
        self.late = []
        self.cancelled = []
        self.results = {}
        self.services = [
            self._serve("send_goal", f"{FIBONACCI}_SendGoal", self.on_goal),
            self._serve("get_result", f"{FIBONACCI}_GetResult", self.on_result),
            self._serve("cancel_goal", CANCEL, self.on_cancel),
        ]
        self.status = harness.node.add_publisher("/walk/_action/status", STATUS)

    def _serve(self, name, type_name, handle):
        def on_request(cdr, respond):
            request = CONVERTERS.get(f"{type_name}_Request").to_dict(cdr)

            def answer(response):
                respond(CONVERTERS.get(f"{type_name}_Response").from_dict(response))

            handle(request, answer)

        return self.harness.node.add_service(f"/walk/_action/{name}", type_name, on_request)

    def on_goal(self, request, answer):
        if self.accepting:
            answer({"accepted": True})
        else:
            self.late.append(answer)

    def on_result(self, request, answer):
        self.results[request["goal_id"]["uuid"]] = answer

    def on_cancel(self, request, answer):
        self.cancelled.append(request["goal_info"]["goal_id"]["uuid"])
        if self.late:
            answer({"return_code": 2})
            return
        answer({"goals_canceling": [request["goal_info"]]})

    def finish(self, status=4):
        for answer in self.results.values():
            answer({"status": status, "result": {"sequence": [1]}})
        self.results.clear()

    def vanish(self):
        for one in (*self.services, self.status):
            one.remove()


@pytest.fixture
async def harness():
    harness = CallHarness(FakeNode(types=AllTypes()))
    yield harness
    await harness.stop()
    assert harness.node.clients == [] and harness.node.subscriptions == []


async def begin(harness, **route):
    harness.start(action("/walk", **route))
    walks = WalkServer(harness)
    await asyncio.sleep(0)
    harness.node.spin()
    client = harness.client("alice", "r2d2/walk/_result/+")
    return walks, client


def results(client):
    return [m for m in client.received if m.topic.startswith("r2d2/walk/_result/")]


async def test_a_goal_that_is_accepted_too_late_is_cancelled(harness):
    walks, client = await begin(harness, timeout=0.05)
    walks.accepting = False
    assert (await client.error(GOAL, {"order": 3}))[0] == "timeout"
    await until(lambda: walks.cancelled, "the goal is cancelled")
    walks.late.pop()({"accepted": True})
    await asyncio.sleep(0.01)
    assert walks.results == {}
    assert harness.counters().under_way == 0


async def test_a_client_that_leaves_right_behind_its_goal(harness):
    walks, client = await begin(harness, cancel_on_disconnect=True)
    client.send(f"{GOAL}/1", {"order": 3})
    client.leave()
    await asyncio.sleep(0.02)
    assert walks.results == {} and harness.counters().errors["rejected"] == 1


async def test_a_server_that_was_replaced_does_not_know_the_goal(harness):
    walks, client = await begin(harness)
    goal = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
    await until(lambda: walks.results, "the result is asked for")
    walks.results.clear()
    # Another takes its place at once: its services were never seen to be away.
    harness.node.add_publisher("/walk/_action/status", STATUS)
    await until(lambda: walks.results, "the other is asked")
    walks.finish(status=0)
    await until(lambda: results(client), "the result")
    (answer,) = client.payloads(f"r2d2/walk/_result/{goal}")
    assert (answer["status"], answer["error"]["code"]) == ("unknown", "vanished")


async def test_a_server_that_ends_before_it_could_be_asked_for_the_result(harness):
    walks, client = await begin(harness)
    walks.accepting = False
    calling = asyncio.create_task(client.call(GOAL, {"order": 3}))
    await until(lambda: walks.late, "the goal")
    walks.services[1].remove()
    walks.late.pop()({"accepted": True})
    goal = (await calling)[1]["goal_id"]
    harness.node.spin()
    await until(lambda: results(client), "the result")
    (answer,) = client.payloads(f"r2d2/walk/_result/{goal}")
    assert (answer["status"], answer["error"]["code"]) == ("unknown", "vanished")


@pytest.mark.parametrize("part", ["send_goal", "get_result", "cancel_goal"])
async def test_an_action_is_available_when_all_its_services_are(harness, part):
    walks, client = await begin(harness)
    (missing,) = (service for service in walks.services if service.name.endswith(part))
    missing.remove()
    await asyncio.sleep(0)
    code, why = await client.error(GOAL, {"order": 3})
    assert (code, why) == ("unavailable", "there is no action /walk on the bus")
    harness.node.add_service(missing.name, missing.type, missing.handler)
    await asyncio.sleep(0)
    assert (await client.call(GOAL, {"order": 3}))[0] == "ok"


async def test_the_status_is_published_again_when_a_missing_service_of_the_action_is_back(harness):
    walks, _ = await begin(harness)
    said = {"status_list": [{"goal_info": {"goal_id": {"uuid": bytes(range(16))}}, "status": 2}]}
    latched = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)
    status = harness.node.add_publisher("/walk/_action/status", STATUS, latched)
    status.publish(CONVERTERS.get(STATUS).from_dict(said))

    def shown():
        return harness.broker.retained.get("r2d2/walk/_status")

    await until(shown, "the status")
    missing = walks.services[1]
    missing.remove()
    await until(lambda: shown() is None, "the action is not whole")
    harness.node.add_service(missing.name, missing.type, missing.handler)
    await asyncio.sleep(0)
    harness.node.spin()
    await until(shown, "the status, which its publisher does not send again")
    subscriptions = list(harness.node.subscriptions)
    harness.node.spin()
    assert harness.node.subscriptions == subscriptions


@pytest.mark.parametrize("is_lost", [True, False], ids=["the bus ends", "the route is removed"])
async def test_a_queued_status_is_cleared_with_its_route_or_bus(harness, is_lost):
    await begin(harness)
    said = {"status_list": [{"goal_info": {"goal_id": {"uuid": bytes(range(16))}}, "status": 2}]}
    latched = QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)
    status = harness.node.add_publisher("/walk/_action/status", STATUS, latched)
    status.publish(CONVERTERS.get(STATUS).from_dict(said))
    assert harness.broker.retained.get("r2d2/walk/_status") is None, "it waits for its turn"
    if is_lost:
        harness.node.fail("the node ended")
    else:
        harness.bridge.calls.replace(call_routes())
    await asyncio.sleep(0.1)
    assert harness.broker.retained.get("r2d2/walk/_status") is None


async def test_an_action_is_of_one_type(harness):
    """Others may offer services by the same names, of which ROS takes those of one type for one."""
    walks, client = await begin(harness)
    other = harness.node.add_service("/walk/_action/send_goal", "acme/action/Crawl_SendGoal", None)
    harness.node.add_service("/walk/_action/get_result", "std_srvs/srv/Trigger", None)
    await asyncio.sleep(0)
    assert (await client.call(GOAL, {"order": 3}))[0] == "ok"
    result = walks.services[1]
    result.remove()
    await asyncio.sleep(0)
    assert (await client.error(GOAL, {"order": 3}))[0] == "unavailable"
    other.remove()
    await asyncio.sleep(0)
    assert (await client.error(GOAL, {"order": 3}))[0] == "unavailable"
    harness.node.add_service(result.name, result.type, result.handler)
    await asyncio.sleep(0)
    assert (await client.call(GOAL, {"order": 3}))[0] == "ok"


async def test_ros_ends_while_goals_are_under_way(harness):
    _, client = await begin(harness)
    goal = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
    harness.node.fail("the node ended")
    await until(lambda: results(client), "the result")
    (answer,) = client.payloads(f"r2d2/walk/_result/{goal}")
    assert (answer["status"], answer["error"]["code"]) == ("unknown", "ros_error")


async def test_goals_and_retained_results_are_limited(harness, monkeypatch):
    monkeypatch.setattr(module, "MAX_RESULTS", 3)
    walks, client = await begin(harness)
    for _ in range(20):
        assert (await client.call(GOAL, {"order": 3}))[0] == "ok"
    assert (await client.error(GOAL, {"order": 3}))[0] == "too_many"
    await until(lambda: len(walks.results) == 20, "the results are asked for")
    walks.finish()
    await until(lambda: len(results(client)) >= 20, "the results")
    await asyncio.sleep(0.01)
    late = harness.client("late", "r2d2/walk/_result/+")
    assert len(late.received) == 3
    assert (await client.call(GOAL, {"order": 3}))[0] == "ok"


async def test_results_that_are_not_retained(harness):
    walks, client = await begin(harness, keep_result=0)
    await client.call(GOAL, {"order": 3})
    await until(lambda: walks.results, "the result is asked for")
    walks.finish()
    await until(lambda: results(client), "the result")
    assert harness.client("late", "r2d2/walk/_result/+").received == []


async def test_the_appliance_stops_with_goals_under_way(harness):
    walks, client = await begin(harness, cancel_on_disconnect=True)
    goal = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
    await harness.bridge.stop()
    assert [id_of({"uuid": uuid}).hex() for uuid in walks.cancelled] == [goal]


async def test_a_goal_that_outlives_its_route_ends_with_its_client_all_the_same(harness):
    walks, client = await begin(harness, cancel_on_disconnect=True)
    goal = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
    await until(lambda: walks.results, "the result is asked for")
    changed = action("/walk", cancel_on_disconnect=True, keep_result=1)
    harness.bridge.calls.replace(call_routes(changed))
    client.leave()
    await until(lambda: walks.cancelled, "the goal is cancelled")
    assert [id_of({"uuid": uuid}).hex() for uuid in walks.cancelled] == [goal]


async def test_a_removed_action_is_not_subscribed_to_by_a_node_that_joins_meanwhile(
    harness, monkeypatch
):
    await begin(harness)
    assert harness.node.subscriptions
    harness.node.fail("the node ended")
    harness.replace_while_the_node_joins(monkeypatch)
    harness.node.spin()
    assert harness.node.subscriptions == []


async def test_the_appliance_stops_with_a_goal_whose_route_is_gone(harness):
    walks, client = await begin(harness, cancel_on_disconnect=True)
    await client.call(GOAL, {"order": 3})
    harness.bridge.calls.replace(call_routes())
    await harness.bridge.stop()
    assert len(walks.cancelled) == 1


async def test_a_goal_that_begins_after_its_cancelling_is_cancelled_then(harness):
    """A server that is busy with accepting it knows of no such goal yet."""
    walks, client = await begin(harness, timeout=0.05)
    walks.accepting = False
    assert (await client.error(GOAL, {"order": 3}))[0] == "timeout"
    await until(lambda: walks.cancelled, "the goal is cancelled, in vain")
    latched = harness.node.add_publisher(
        "/walk/_action/status", STATUS, QosProfile(durability=Durability.TRANSIENT_LOCAL)
    )
    walks.late.pop()({"accepted": True})
    status = {
        "goal_info": {"goal_id": {"uuid": walks.cancelled[0]}},
        "status": 2,
    }
    latched.publish(CONVERTERS.get(STATUS).from_dict({"status_list": [status]}))
    await until(lambda: len(walks.cancelled) == 2, "the goal is cancelled")
    latched.publish(CONVERTERS.get(STATUS).from_dict({"status_list": [status]}))
    await asyncio.sleep(0.01)
    assert len(set(walks.cancelled)) == 1 and len(walks.cancelled) == 2


async def test_the_server_of_a_goal_vanishes_after_the_last_route(harness, monkeypatch):
    monkeypatch.setattr(service_clients, "IDLE_POLLS", 2)
    walks, client = await begin(harness)
    await client.call(GOAL, {"order": 3})
    await until(lambda: walks.results, "the result is asked for")
    harness.bridge.calls.replace(call_routes())
    walks.vanish()
    await until(lambda: results(client), "the result")
    assert client.payloads(results(client)[0].topic)[0]["error"]["code"] == "vanished"
    for _ in range(4):
        harness.node.spin()
    assert harness.node.clients == []


@pytest.mark.parametrize("sent_at", ["-6", "+0.4", "+3600", "yesterday"])
async def test_a_cancel_is_carried_out_whatever_age_it_claims(harness, sent_at):
    """It is how an action is stopped."""
    walks, client = await begin(harness)
    goal = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
    text = sent_at if sent_at.isalpha() else str(time.time() + float(sent_at))
    client.send(
        STOP,
        {"goal_id": goal},
        response_topic=f"answers/{client.name}",
        correlation_data=b"c",
        user_property=[("sent-at", text)],
    )
    await until(lambda: walks.cancelled, "the goal is cancelled")
    walks.finish()
    await until(lambda: harness.counters().under_way == 0, "it has ended")
