"""A session inside the appliance that has a user, in what reports and reloads say about users."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from appliance.access import Changes
from appliance.app.reload import Reload, ReloadParts
from appliance.app.status import Status, StatusParts
from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink
from appliance.broker.ports import Access
from appliance.broker.values import Decision, Identity
from appliance.mqtt.reason import ReasonCode
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


def test_a_user_who_is_removed_ends_logins_and_nothing_that_has_not_logged_in() -> None:
    """What an upstream's user may do is in the access rules, which a reload applies as well."""
    broker = Broker(cast(Access, AllAllowed()), MemoryStore())
    link, inside = Link(), Link()
    broker.connect(link, Identity("eve", "client"), clean_start=True, expiry=0, will=None)
    broker.attach("_upstream.fleet", inside, Identity("eve", "_upstream.fleet"))
    reload = Reload(cast(ReloadParts, SimpleNamespace(broker=broker)))
    assert reload._take_access(Changes([], ["eve"], [], False)) == ["users removed: eve"]
    assert link.closed == [ReasonCode.ADMINISTRATIVE_ACTION] and not inside.closed


def test_it_is_no_client_in_the_status() -> None:
    broker = Broker(cast(Access, AllAllowed()), MemoryStore())
    broker.attach("_upstream.fleet", Link(), Identity("eve", "_upstream.fleet"))
    parts: Any = SimpleNamespace(broker=broker)
    status = Status.__new__(Status)
    status._parts = cast(StatusParts, parts)
    assert status._clients()["sessions"] == 0
