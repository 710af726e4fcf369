"""Verbs share the event loop: one works in an iteration, in pieces, and users take turns."""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest
from ros.call_harness import AllTypes
from waiting import until

from appliance.app import management
from appliance.app.management import ApplianceVerbs
from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink
from appliance.broker.session import Session
from appliance.broker.values import Identity
from appliance.management import clients
from appliance.management.clients import ClientVerbs, ListClients
from appliance.management.topics import TOPICS, topic_of
from appliance.management.verbs import LOCAL, Arguments, Caller
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish
from appliance.ros import announcements
from appliance.ros.bridge import Bridge, TopicSettings
from appliance.ros.node import FakeNode
from appliance.ros.status import topic_status
from management.managed import RULES, Site
from management.managed import Caller as Client

TOPICS_BRIDGED = 60


@pytest.fixture
async def bridge(site: Site) -> AsyncIterator[Bridge]:
    """One that bridges some topics."""
    routes = [TopicSettings(f"/topic/{n}", "mqtt", "{robot}{ros}") for n in range(TOPICS_BRIDGED)]
    node, loop = FakeNode(types=AllTypes()), asyncio.get_running_loop()
    bridge = Bridge(node, site.app.broker, routes, loop, "r2d2")
    bridge.start()
    for route in routes:
        node.add_publisher(route.ros, "std_msgs/msg/String")
    node.spin()
    await until(lambda: len(bridge.topics()) == TOPICS_BRIDGED, "the topics")
    yield bridge
    await bridge.stop()


class Turns:
    """A client that counts its turns."""

    def __init__(self) -> None:
        self.count = 0
        self.caller = Caller(Identity("admin", "a"), "", self.turn)

    async def turn(self) -> None:
        self.count += 1


async def test_routes_are_listed_in_pieces(bridge: Bridge):
    parts: Any = SimpleNamespace(bridge=bridge)
    turns = Turns()
    answer = await ApplianceVerbs(parts)._routes(turns.caller, Arguments())
    assert turns.count == TOPICS_BRIDGED // announcements.TURN == 2
    assert len(answer) == TOPICS_BRIDGED
    assert {entry["ros"] for entry in answer} == {topic.ros for topic in bridge.topics()}
    assert answer == json.loads(json.dumps(answer))


async def test_an_answer_that_is_too_large_is_not_made_to_its_end(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch
):
    made = 0

    def counted(*given: Any) -> Any:
        nonlocal made
        made += 1
        return topic_status(*given)

    monkeypatch.setattr(management, "topic_status", counted)
    monkeypatch.setattr(management, "LONGEST_ANSWER", 1000)
    parts: Any = SimpleNamespace(bridge=bridge)
    with pytest.raises(management.CallError, match="more than 1000 bytes") as refused:
        await ApplianceVerbs(parts)._routes(Turns().caller, Arguments())
    assert refused.value.code == "too_large" and made < 5
    # `appliance routes` shows all of them.
    assert len(await ApplianceVerbs(parts)._routes(LOCAL, Arguments())) == TOPICS_BRIDGED


async def test_clients_are_looked_for_in_pieces(site: Site, monkeypatch: pytest.MonkeyPatch):
    broker: Broker = site.app.broker
    monkeypatch.setattr(clients, "_LOOKED_PER_TURN", 10)
    for number in range(100):
        broker.sessions[f"c{number:02}"] = _session(broker, f"c{number:02}")
    turns = Turns()
    verbs = ClientVerbs(broker)
    page = await verbs._list(turns.caller, ListClients(limit=30))
    assert [each["client"] for each in page["clients"]] == [f"c{n:02}" for n in range(30)]
    assert page["next"] == "c29" and turns.count >= 10
    rest = await verbs._list(turns.caller, ListClients(limit=80, after="c29"))
    assert len(rest["clients"]) == 70 and rest["next"] is None


def _session(broker: Broker, name: str) -> Session:
    session = broker.attach(name, InsideLink())
    session.is_inside, session.identity = False, Identity("bob", name)
    return session


async def post_all(client: Client, verb: str, count: int) -> None:
    """Send so many calls in one chunk."""
    replies = [f"{TOPICS}/{verb}/_reply/{client.name}/{number}" for number in range(count)]
    packets = [
        Publish(topic_of(verb), b"{}", 0, properties={Property.RESPONSE_TOPIC: reply})
        for reply in replies
    ]
    await client._peer.send(*packets)


class Iterations:
    """Counts the iterations of the event loop."""

    def __init__(self) -> None:
        self.count = 0
        self._go_on()

    def _go_on(self) -> None:
        self.count += 1
        self._next = asyncio.get_running_loop().call_soon(self._go_on)

    def stop(self) -> None:
        self._next.cancel()


async def test_one_verb_works_in_an_iteration(site: Site):
    """However many have come at once."""
    worked: list[int] = []

    async def work(*_: object) -> dict[str, Any]:
        worked.append(iterations.count)
        return {}

    _replace(site, "status", work)
    admins = [await site.join(name) for name in ("a", "b")]
    iterations = Iterations()
    await admins[0].call("status")
    worked.clear()
    for admin in admins:
        await post_all(admin, "status", 5)
    await until(lambda: len(worked) == 10, "the calls")
    iterations.stop()
    # The iteration between two of them is for everybody else.
    assert all(later - earlier >= 2 for earlier, later in itertools.pairwise(worked))


def _replace(site: Site, name: str, run: Any) -> None:
    assert site.app._verbs is not None
    object.__setattr__(site.app._verbs.by_name[name], "run", run)


async def test_users_take_turns(site: Site):
    """The calls of one, which take many turns each, do not keep another's waiting."""
    pieces: list[str | None] = []

    async def work(caller: Caller, _: Arguments) -> dict[str, Any]:
        for _piece in range(1000):
            pieces.append(caller.identity.username if caller.identity is not None else None)
            if caller.identity is not None and caller.identity.username == "viewer":
                break
            await caller.turn()
        return {}

    _replace(site, "status", work)
    site.rules(RULES.replace("user viewer\n", f"user viewer\ntopic write {topic_of('status')}/#\n"))
    await site.app.reload()
    flooding = [await site.join(name) for name in ("a", "b")]
    viewer = await site.join("v", "viewer")
    await viewer.call("status")
    pieces.clear()
    for admin in flooding:
        await post_all(admin, "status", 5)
    await until(lambda: len(pieces) > 10, "the flood")
    await viewer.call("status")
    assert pieces.index("viewer") < 5000  # some went on while its call was on its way
    await until(lambda: len(pieces) == 10 * 1000 + 1, "the end of the flood")


async def test_what_cancels_a_goal_does_not_wait_behind_verbs(bridge: Bridge, site: Site):
    """Calls of ROS have a queue of their own, also of the same client."""
    ended: list[str] = []

    async def work(caller: Caller, _: Arguments) -> dict[str, Any]:
        for _piece in range(100):
            ended.append("piece")
            await caller.turn()
        return {}

    _replace(site, "status", work)
    admin = await site.join("a")
    await admin.call("status")
    ended.clear()
    await post_all(admin, "status", 5)
    await until(lambda: len(ended) > 5, "the verbs")
    before = len(ended)
    await bridge.calls.dispatcher.turn(site.app.broker.sessions["a"])
    assert len(ended) == before
    await until(lambda: len(ended) == 500, "the end of the verbs")
