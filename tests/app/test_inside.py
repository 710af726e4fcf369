"""A session inside the appliance that has a user, in what reports and reloads say about users."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

from appliance.access import Changes
from appliance.app.reload import Reload, ReloadParts, _of_users
from appliance.app.status import Status, StatusParts
from appliance.broker.broker import Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.delivery import PendingWill
from appliance.broker.limits import Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.ports import Access
from appliance.broker.values import Decision, Identity
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.net.listeners import Admission, Listeners
from appliance.store import MemoryStore


class AllAllowed:
    epoch = 0

    def decide(self, *_: object) -> Decision:
        return Decision(True, "everything is")


class Link(InsideLink):
    """Keeps what it was closed with."""

    def __init__(self) -> None:
        self.closed: list[ReasonCode] = []

    def close(self, reason: ReasonCode, message: str) -> None:
        self.closed.append(reason)


def with_listeners(broker: Broker) -> Reload:
    """A reload that knows the broker and its connections."""
    admission = Admission(100, 5.0)
    listeners = Listeners(broker, cast(Any, None), lambda *_: None, admission)
    return Reload(cast(ReloadParts, SimpleNamespace(broker=broker, listeners=listeners)))


async def close_removed(reload: Reload, *names: str) -> None:
    task = reload._close_removed([*names])
    assert task is not None
    await task


async def test_a_user_who_is_removed_ends_logins_and_nothing_that_has_not_logged_in() -> None:
    """What an upstream's user may do is in the access rules, which a reload applies as well."""
    broker = Broker(cast(Access, AllAllowed()), MemoryStore())
    link, other, inside = Link(), Link(), Link()
    broker.connect(link, Identity("eve", "client"), clean_start=True, expiry=0, will=None)
    broker.connect(other, Identity("bob", "other"), clean_start=True, expiry=0, will=None)
    broker.attach("_upstream.fleet", inside, Identity("eve", "_upstream.fleet"))
    reload = with_listeners(broker)
    assert reload._close_removed([]) is None
    await close_removed(reload, "eve")
    assert link.closed == [ReasonCode.ADMINISTRATIVE_ACTION]
    assert not inside.closed and not other.closed
    assert _of_users(Changes([], ["eve"], [], False)) == ["users removed: eve"]


async def test_connections_that_are_logging_in_are_told_who_is_removed() -> None:
    told: list[set[str]] = []
    reload = with_listeners(Broker(cast(Access, AllAllowed()), MemoryStore()))
    connection = Mock(users_removed=told.append)
    reload._parts.listeners.scheduler.connections.add(connection)
    await close_removed(reload, "eve")
    assert told == [{"eve"}]


class Leaving(Link):
    """A connection with a will that costs, as of a thousand who hear it; it may not close."""

    def __init__(self, broker: Broker, number: int, *, fails: bool = False) -> None:
        super().__init__()
        self.broker, self.fails = broker, fails
        identity = Identity("eve", f"c{number}")
        self.session, _ = broker.connect(
            self, identity, clean_start=True, expiry=60, will=PendingWill(Message("w", b"", 0), 0)
        )

    def close(self, reason: ReasonCode, message: str) -> None:
        super().close(reason, message)
        if self.fails:
            raise RuntimeError("the test says so")
        self.broker.disconnect(self.session, self, publish_will=True)


async def test_many_connections_of_a_user_who_is_removed_are_closed_in_pieces(
    escaped: list[str],
) -> None:
    """And each of them is looked at when its turn comes; who has logged in since stays."""
    broker = Broker(cast(Access, AllAllowed()), MemoryStore(), Limits(connections=10_000))
    heard = 300
    for number in range(heard):
        reader = broker.attach(f"reader{number}", Link())
        assert broker.subscribe(reader, Subscription("w", 0))[0] == 0
    count = 40
    links = [Leaving(broker, number, fails=number == 7) for number in range(count)]
    task = with_listeners(broker)._close_removed(["eve"])
    assert task is not None
    pieces = []
    again = Link()
    while not task.done():
        begun = broker.counters.cost
        await asyncio.sleep(0)
        pieces.append(broker.counters.cost - begun)
        if len(pieces) == 2:  # the last of them is taken over, by a login after the removal
            session = links[-1].session
            broker.disconnect(session, links[-1], publish_will=False)
            broker.connect(
                again, links[-1].session.identity, clean_start=False, expiry=60, will=None
            )
    # A piece ends with the close that brings it beyond a turn's cost, and that is one will.
    assert max(pieces) < COST_PER_TURN + heard + 100
    assert len(pieces) >= (count - 2) * heard // COST_PER_TURN
    assert [link.closed for link in links[:-1]] == [[ReasonCode.ADMINISTRATIVE_ACTION]] * (
        count - 1
    )
    assert not links[-1].closed and not again.closed and links[-1].session.link is again
    assert len(escaped) == 1 and "reload.close" in escaped.pop()


def test_it_is_no_client_in_the_status() -> None:
    broker = Broker(cast(Access, AllAllowed()), MemoryStore())
    broker.attach("_upstream.fleet", Link(), Identity("eve", "_upstream.fleet"))
    parts: Any = SimpleNamespace(broker=broker)
    status = Status.__new__(Status)
    status._parts = cast(StatusParts, parts)
    assert status._clients()["sessions"] == 0
