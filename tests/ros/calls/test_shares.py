"""Calls and goals of one user do not exhaust the limits of another, on a FakeNode."""

from __future__ import annotations

import asyncio
import json
import math
from itertools import count

import pytest

pytest.importorskip("test_msgs.action")
from call_harness import AllTypes, CallHarness, action, call_routes, parameters, service, until
from hypothesis import given
from hypothesis import strategies as st

from appliance.broker.accounts import Account
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.faults import Faults
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.session import SessionAccounting
from appliance.broker.values import Identity
from appliance.net.callbacks import Entries
from appliance.ros.bridge import TopicSettings
from appliance.ros.calls import actions
from appliance.ros.calls.dispatcher import CallLimits
from appliance.ros.calls.fair_cache import FairCache
from appliance.ros.node import FakeNode
from appliance.ros.payload.converter import Converters
from appliance.ros.payload.definitions import load_description
from appliance.ros.payload.payloads import InputLimits
from appliance.ros.topics import conversions as turns
from appliance.store import MemoryStore

CONVERTERS = Converters(load_description)
SET_BOOL, ARRAYS = "std_srvs/srv/SetBool", "test_msgs/srv/Arrays"
FIBONACCI, CANCEL = "test_msgs/action/Fibonacci", "action_msgs/srv/CancelGoal"
STRING = "std_msgs/msg/String"
CALL, GOAL, STOP = "r2d2/slow/_call", "r2d2/walk/_goal", "r2d2/walk/_cancel"


@pytest.fixture
async def harness():
    harness = CallHarness(FakeNode(types=AllTypes()))
    yield harness
    await harness.stop()


def clients(harness, user, count):
    """So many of one user."""
    return [harness.client(f"{user}{number}", user=user) for number in range(count)]


class Slow:
    """A service that answers when it is told to, and an action whose goals go on until then."""

    def __init__(self, harness):
        self.harness = harness
        self.waiting = []
        self.results = {}
        #: Requests to cancel that are not answered yet.
        self.held = []
        self.holds_cancels = False
        node = harness.node
        node.add_service("/slow", SET_BOOL, lambda _, respond: self.waiting.append(respond))
        for name, type_name, handle in (
            ("send_goal", f"{FIBONACCI}_SendGoal", self.on_goal),
            ("get_result", f"{FIBONACCI}_GetResult", self.on_result),
            ("cancel_goal", CANCEL, self.on_cancel),
        ):
            node.add_service(f"/walk/_action/{name}", type_name, self.serve(type_name, handle))

    @staticmethod
    def serve(type_name, handle):
        def on_request(cdr, respond):
            request = CONVERTERS.get(f"{type_name}_Request").to_dict(cdr)
            response = CONVERTERS.get(f"{type_name}_Response")
            handle(request, lambda value: respond(response.from_dict(value)))

        return on_request

    def on_goal(self, request, answer):
        answer({"accepted": True})

    def on_result(self, request, answer):
        self.results[request["goal_id"]["uuid"]] = answer

    def on_cancel(self, request, answer):
        if self.holds_cancels:
            self.held.append((request, answer))
            return
        answer({"goals_canceling": [request["goal_info"]]})

    def finish(self):
        for answer in self.results.values():
            answer({"status": 4, "result": {"sequence": [1]}})
        self.results.clear()
        response = CONVERTERS.get(f"{SET_BOOL}_Response").from_dict({})
        for respond in self.waiting:
            respond(response)
        self.waiting.clear()


async def begin(harness, limits=None, **route):
    harness.start()
    harness.bridge.calls.replace(
        call_routes(
            service("/slow", timeout=60.0),
            action("/walk", timeout=60.0, **route),
            limits=limits or CallLimits(),
        )
    )
    slow = Slow(harness)
    await asyncio.sleep(0)
    harness.node.spin()
    return slow


async def test_the_calls_of_one_user_leave_room_for_another(harness):
    """25 clients with 20 slow calls each: before, the operator's calls failed, and cancels too."""
    slow = await begin(harness)
    crowd = clients(harness, "mallory", 25)
    operator = harness.client("operator")
    _, goal = await operator.call(GOAL, {"order": 3})
    for client in crowd:
        for number in range(20):
            client.send(f"{CALL}/{number}", {"data": True})
    await until(lambda: len(slow.waiting) == 125, "a quarter of the calls is under way")
    assert await crowd[24].error(CALL) == (
        "too_many",
        "125 calls of the user 'mallory' are under way, as many as may be "
        "(bridge.limits.calls_per_user)",
    )
    calls = [asyncio.ensure_future(operator.call(CALL, {"data": True})) for _ in range(20)]
    await until(lambda: len(slow.waiting) == 145, "the operator's calls")
    # Its own 20 calls are under way, too: cancelling is not one of them.
    assert (await operator.error(CALL))[0] == "too_many"
    status, answer = await operator.call(STOP, {"goal_id": goal["goal_id"]})
    assert (status, answer) == ("ok", {"goals_canceling": [goal["goal_id"]]})
    slow.finish()
    await asyncio.gather(*calls)
    await until(lambda: harness.counters().under_way == 0, "all are answered")
    assert (await asyncio.gather(operator.call(CALL), _later(slow)))[0][0] == "ok"


async def _later(slow):
    await until(lambda: slow.waiting, "the call")
    slow.finish()


async def test_many_cancels_of_one_user_do_not_block_those_of_another(harness):
    slow = await begin(harness, CallLimits(client=2, total=8))
    operator = harness.client("operator")
    goal = (await operator.call(GOAL, {"order": 3}))[1]["goal_id"]
    slow.holds_cancels = True
    for user in "abcde":  # more users than share the places of calls
        (client,) = clients(harness, user, 1)
        own = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
        for number in range(2):
            client.send(f"{STOP}/{number}", {"goal_id": own})
        await until(lambda: len(slow.held) % 2 == 0 and slow.held, "they are under way")
        assert (await client.error(STOP, {"goal_id": own})) == (
            "too_many",
            "2 calls that cancel goals of this client are under way, as many as may be "
            "(bridge.limits.calls_per_client)",
        )
    assert len(slow.held) == 10
    slow.holds_cancels = False
    assert (await operator.call(STOP, {"goal_id": goal}))[0] == "ok"
    for request, answer in slow.held:
        answer({"goals_canceling": [request["goal_info"]]})


async def test_the_clients_without_a_user_are_one_user(harness):
    slow = await begin(harness, CallLimits(client=2, total=8))
    crowd = [harness.client(f"nobody{number}") for number in range(3)]
    for client in crowd:
        client.session.identity = Identity(None, client.session.client_id)
    for client in crowd[:2]:
        client.send(f"{CALL}/1", {"data": True})
    await until(lambda: len(slow.waiting) == 2, "the calls")
    code, text = await crowd[2].error(CALL)
    assert code == "too_many"
    assert text.startswith("2 calls of the clients without a user are under way")
    slow.finish()


async def test_the_goals_of_one_user_leave_room_for_another(harness):
    slow = await begin(harness, CallLimits(client=3, total=16))
    crowd = clients(harness, "mallory", 3)
    for client in crowd[:2]:
        for _ in range(2):
            assert (await client.call(GOAL, {"order": 3}))[0] == "ok"
    code, text = await crowd[2].error(GOAL, {"order": 3})
    assert code == "too_many" and "4 goals of the user 'mallory'" in text
    operator = harness.client("operator")
    for _ in range(3):
        assert (await operator.call(GOAL, {"order": 3}))[0] == "ok"
    assert "3 goals of this client" in (await operator.error(GOAL, {"order": 3}))[1]
    await until(lambda: len(slow.results) == 7, "the results are asked for")
    slow.finish()
    await until(lambda: not harness.bridge.calls._actions.goals.slots._total, "they end")
    assert (await crowd[2].call(GOAL, {"order": 3}))[0] == "ok"


async def test_the_owner_of_a_running_goal_is_remembered(harness, monkeypatch):
    """10,118 short goals of another client made it so that its owner could not cancel it."""
    monkeypatch.setattr(actions, "MAX_ENDED", 50)
    slow = await begin(harness)
    for user in ("operator", "mallory"):
        harness.rules.deny(user, "publish", "r2d2/walk/_cancel_any")
    operator, mallory = harness.client("operator"), harness.client("mallory")
    goal = (await operator.call(GOAL, {"order": 3}))[1]["goal_id"]
    await until(lambda: slow.results, "its result is asked for")
    held, slow.results = slow.results, {}
    ended = (await operator.call(GOAL, {"order": 3}))[1]["goal_id"]
    await until(lambda: slow.results, "its result is asked for")
    slow.finish()
    for _ in range(60):
        assert (await mallory.call(GOAL, {"order": 3}))[0] == "ok"
        await until(lambda: slow.results, "its result is asked for")
        slow.finish()
    table = harness.bridge.calls._actions.goals.ended
    await until(lambda: len(table) == 50, "it is full")
    assert (await mallory.error(STOP, {"goal_id": goal}))[0] == "not_authorized"
    assert (await operator.call(STOP, {"goal_id": goal}))[0] == "ok"
    # Of what has ended mallory has most: nothing of the operator's was forgotten for that.
    assert (await operator.call(STOP, {"goal_id": ended}))[0] == "ok"
    slow.results = held
    slow.finish()


async def test_the_results_of_one_user_do_not_evict_those_of_another(harness, monkeypatch):
    monkeypatch.setattr(actions, "MAX_RESULTS", 4)
    slow = await begin(harness)
    operator, mallory = harness.client("operator"), harness.client("mallory")

    async def result_of(client):
        goal = (await client.call(GOAL, {"order": 3}))[1]["goal_id"]
        await until(lambda: slow.results, "its result is asked for")
        slow.finish()
        topic = f"r2d2/walk/_result/{goal}"
        await until(lambda: harness.retained(topic), "the result")
        return topic

    own = await result_of(operator)
    others = [await result_of(mallory) for _ in range(6)]
    assert harness.retained(own) is not None
    assert [harness.retained(topic) is not None for topic in others] == [False] * 3 + [True] * 3


async def test_retained_results_are_limited_in_bytes(harness, monkeypatch):
    monkeypatch.setattr(actions, "MAX_RESULT_BYTES", 100)  # of 43 bytes or so each
    slow = await begin(harness)
    client = harness.client("alice")
    for _ in range(5):
        await client.call(GOAL, {"order": 3})
        await until(lambda: slow.results, "its result is asked for")
        slow.finish()
        await until(lambda: not harness.bridge.calls._actions.goals.slots._total, "it has ended")
    assert len(list(harness.broker.retained.find("r2d2/walk/_result/+"))) == 2


async def test_a_call_that_cancels_is_limited_in_size(harness):
    await begin(harness)
    client = harness.client("alice")
    code, text = await client.error(STOP, b'{"all": true}' + b" " * 2000)
    assert code == "too_large" and "takes 1024 at most" in text


async def test_errors_of_size_name_the_limit(harness):
    harness.start(service("/arrays"), parameters("/arm/*"))
    limits = CallLimits(input=InputLimits(payload=400_000, items=1000))
    harness.bridge.calls.dispatcher.limits = limits
    asked = []
    harness.node.add_service("/arrays", ARRAYS, lambda cdr, respond: asked.append(cdr))
    harness.node.add_service(
        "/arm/get_parameters", "rcl_interfaces/srv/GetParameters", asked.append
    )
    await asyncio.sleep(0)
    harness.node.spin()
    client = harness.client("alice")
    for topic, payload, expected in (
        ("arrays/_call", {"string_values": ["a"] * 2000}, "than 1000 (bridge.limits.items)"),
        ("arrays/_call", b"[" * 400_001, "at most 400000 are converted (bridge.limits.payload)"),
        ("arm/_param/_set", {"a": [""] * 2000}, "than 1000 (bridge.limits.items)"),
        ("arm/_param/a/set", [""] * 30_000, "takes 65536 at most"),
        ("arm/_param/_set", {f"p{n}": 1 for n in range(201)}, "at most 200 are set at once"),
    ):
        code, text = await client.error(f"r2d2/{topic}", payload)
        assert (code, expected in text) == ("too_large", True), text
    assert asked == [] or len(asked) == 1  # the look at the parameters


async def test_a_rejected_call_is_not_converted(harness):
    slow = await begin(harness, CallLimits(client=1))
    harness.rules.deny("alice", "publish", "forbidden")
    client = harness.client("alice")
    nonsense = b"not JSON" * 1000
    code, _ = await client.error(CALL, nonsense)
    assert code == "bad_request"
    client.send(f"{CALL}/1", {"data": True})
    await until(lambda: slow.waiting, "the call")
    assert (await client.error(CALL, nonsense))[0] == "too_many"
    before = harness.counters().errors["not_authorized"]
    client.send(CALL, nonsense, response_topic="forbidden")
    assert harness.counters().errors["not_authorized"] == before + 1
    slow.finish()


async def test_commands_and_calls_of_a_client_stay_in_order(harness):
    routes = [TopicSettings(f"/{name}", "ros", f"r2d2/{name}", STRING) for name in ("a", "b")]
    harness.start(service("/slow", timeout=60.0), topics=routes)
    slow = Slow(harness)
    peers = [harness.node.add_subscriber(f"/{name}", STRING) for name in ("a", "b")]
    await until(lambda: len(harness.bridge.topics()) == 2, "the routes")
    alice, bob = harness.client("alice"), harness.client("bob")
    bob.send("r2d2/b", {"data": "b" * 5000})  # it has its turn now, and the others wait
    for number in range(3):
        alice.send("r2d2/a", {"data": f"{number}" + "a" * 5000})
    alice.send("r2d2/a", {"data": "little"})
    alice.send(f"{CALL}/1", {"data": True})
    bob.send("r2d2/b", {"data": "little, too"})
    assert [len(peer.received) for peer in peers] == [0, 2]
    assert harness.broker.accounting.queued_bytes > 15_000
    texts = CONVERTERS.get(STRING)
    await until(lambda: len(peers[0].received) == 4, "all commands")
    order = [texts.to_dict(cdr)["data"][:2] for cdr in peers[0].received]
    assert order == ["0a", "1a", "2a", "li"]
    await until(lambda: slow.waiting, "the call that was behind them")
    slow.finish()
    assert alice.session.account.bytes < 5000


async def test_a_message_that_exceeds_the_conversion_queue_is_rejected(harness, monkeypatch):
    monkeypatch.setattr(turns, "WAITING_OF_USER", 20_000)
    harness.start(topics=[TopicSettings("/a", "ros", "r2d2/a", STRING)])
    peer = harness.node.add_subscriber("/a", STRING)
    await until(lambda: harness.bridge.topics(), "the route")
    alice = harness.client("alice")
    for _ in range(6):
        message = Message("r2d2/a", json.dumps({"data": "a" * 5000}).encode(), 1)
        route = harness.broker.router.route(alice.session, message.topic_wire)
        harness.broker.publish_to(route.targets, route, message, alice.session)
    rejection = message.rejection
    assert rejection.code == 0x97 and "waits to be converted" in rejection.reason
    await until(lambda: len(peer.received) == 4, "those that had room")
    assert harness.bridge.topics()[0].errors == 2


# the cache


@given(
    st.lists(
        st.tuples(st.sampled_from("abc"), st.integers(0, 30), st.integers(0, 20)), max_size=80
    ),
    st.integers(1, 12),
    st.integers(1, 60) | st.just(math.inf),
)
def test_the_fair_cache_evicts_from_the_largest_user(puts, entries, size):
    cache = FairCache(entries, size)
    known = {}  # in the order of their coming
    for user, key, weight in puts:
        known.pop(key, None)
        known[key] = user, weight, key
        for dropped, value in cache.put(user, key, key, weight):
            assert value == dropped
            gone, lost, _ = known.pop(dropped)
            # Nobody loses an entry to a user with more.
            mine = [w for u, w, _ in known.values() if u == gone]
            for other in "abc":
                theirs = [w for u, w, _ in known.values() if u == other]
                if len(known) + 1 > entries and sum(w for _, w, _ in known.values()) + lost <= size:
                    assert len(theirs) <= len(mine) + 1
        assert [key for key, _ in cache.items()] == list(known)
        assert len(cache) == len(known) <= max(entries, 1)
        assert sum(w for _, w, _ in known.values()) <= size or len(known) == 1
    for key in list(known):
        assert key in cache and cache.get(key) == key
        cache.remove(key)
    assert len(cache) == 0 and cache._size == 0 and cache._users == {}


# turns


class Clock:
    """A loop whose rounds are made by hand."""

    time = staticmethod(lambda: 0.0)

    def __init__(self):
        self.soon = []

    def call_soon(self, callback, *args):
        self.soon.append((callback, args))

    def round(self):
        soon, self.soon = self.soon, []
        for callback, args in soon:
            callback(*args)


class Who:
    def __init__(self, user):
        self.account = Account(user)
        self.identity = Identity(user, "client")


LARGE = turns.LITTLE + 1


def conversion_queue(memory=1 << 20):
    clock = Clock()
    accounting = SessionAccounting(Limits(memory=memory), MemoryStore())
    return clock, turns.ConversionQueue(Entries(clock, Faults()), accounting)


def test_one_is_done_at_once_and_the_others_one_a_turn():
    clock, queue = conversion_queue()
    done = []
    for user in "abc":
        queue.do(Who(user), LARGE, lambda user=user: done.append(user))
    assert done == ["a"]
    seen = []
    while clock.soon:
        clock.round()
        seen.append("".join(done))
    # A round in between is for what others have sent meanwhile.
    assert seen == ["a", "ab", "ab", "abc", "abc", "abc"]


def test_users_take_turns_then_their_clients_and_each_client_s_is_in_order():
    clock, queue = conversion_queue()
    done = []
    first, second, other = Who("a"), Who("a"), Who("b")
    queue.do(Who("c"), LARGE, lambda: None)
    for number in range(3):
        for name, who in (("first", first), ("second", second)):
            queue.do(who, LARGE, lambda text=f"{name} {number}": done.append(text))
    queue.do(other, LARGE, lambda: done.append("other 0"))
    queue.do(first, 1, lambda: done.append("first, little"))
    queue.do(Who("a"), 1, lambda: done.append("at once"))
    assert done == ["at once"]
    while clock.soon:
        clock.round()
    assert done[1:3] == ["first 0", "other 0"]
    for name in ("first", "second"):
        own = [text for text in done if text.startswith(name)]
        assert own[:3] == [f"{name} {number}" for number in range(3)]
    assert done[-1] == "first, little"
    assert not queue.waits(first) and queue._accounting.queued_bytes == 0
    assert first.account.bytes == 0


def test_a_little_payload_that_takes_long_is_charged(monkeypatch):
    """A kilobyte of empty objects takes milliseconds; it is done at once, whatever is queued."""
    clock, queue = conversion_queue()
    seconds = count()
    monkeypatch.setattr(turns, "thread_time", lambda: 0.004 * next(seconds))
    queue.do(None, 1, lambda: None)
    cost = queue._accounting.counters.cost
    assert cost == pytest.approx(1000, abs=1) == pytest.approx(COST_PER_TURN, abs=1)
    assert queue.little(lambda: "its result") == "its result"
    assert queue._accounting.counters.cost == pytest.approx(2 * cost, abs=1)
    assert not queue.is_busy and not clock.soon


def test_a_failed_conversion_does_not_stop_the_queue(escaped):
    clock, queue = conversion_queue()
    done = []

    def fail():
        raise RuntimeError("a fault")

    queue.do(None, LARGE, fail)
    queue.do(None, LARGE, fail)
    queue.do(None, LARGE, lambda: done.append(1))
    while clock.soon:
        clock.round()
    assert done == [1] and queue._entries.faults.count == 2
    escaped.clear()


def test_an_immediate_conversion_delays_the_queued_ones():
    clock, queue = conversion_queue()
    done = []
    for _ in range(5):
        queue.now(lambda: done.append("now"))
    queue.do(None, LARGE, lambda: done.append("then"))
    assert done == ["now"] * 5
    clock.round()
    clock.round()
    assert done[5:] == ["then"]


def test_queued_payloads_count_against_their_user(monkeypatch):
    clock, queue = conversion_queue(memory=800_000)
    a, b = Who("a"), Who("b")
    queue.do(a, LARGE, lambda: None)
    count = 0
    while queue.has_room(a, 10_000):
        queue.do(a, 10_000, lambda: None)
        count += 1
    assert a.account.bytes == count * (10_000 + turns.OVERHEAD) == queue._accounting.queued_bytes
    assert 10 < count < 60
    assert queue.has_room(b, 10_000)
    monkeypatch.setattr(turns, "WAITING_OF_USER", 30_000)
    assert queue.has_room(b, 100_000)  # one alone
    while queue.has_room(b, 10_000):
        queue.do(b, 10_000, lambda: None)
    assert b.account.bytes == 2 * (10_000 + turns.OVERHEAD)
    while clock.soon:
        clock.round()
    assert a.account.bytes == queue._accounting.queued_bytes == 0
