"""What a sender makes of what its backlog hands out."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from appliance.broker.rate_limited_log import BURST, INTERVAL
from appliance.mqtt.codec import V5, PacketType, Property, decode_properties
from appliance.upstream import sender as module
from appliance.upstream.limits import FleetLimits
from appliance.upstream.rule_queue import Entry
from appliance.upstream.rules import KeepRule, OutRule
from appliance.upstream.sender import Sender
from upstream.links import link as settings_of
from upstream.test_backlog import Link

#: A compiled sender takes no other connection than its own.
pytestmark = pytest.mark.patches


class Connection:
    """Takes what it is sent: topic, QoS and user properties."""

    settings = SimpleNamespace(version=V5)
    room, waiting, inflight = 100, 0, 0

    def __init__(self) -> None:
        self.sent: list[tuple[str, int, object]] = []

    def publish(
        self, entry: Entry, topic: str, payload: bytes, qos: int, retain: bool, properties: bytes
    ) -> int:
        found, _ = decode_properties(properties, 0, len(properties), PacketType.PUBLISH)
        self.sent.append((topic, qos, (found or {}).get(Property.USER_PROPERTY)))
        return 0


def sender_of(link: Link) -> Sender:
    return Sender(settings_of(), link.backlog, lambda: link.backlogs.time, FleetLimits())


def send(
    link: Link, sender: Sender | None = None, limits: FleetLimits | None = None
) -> list[tuple[str, int, object]]:
    sender = sender or sender_of(link)
    sender.begin(limits or FleetLimits())
    connection = Connection()
    while sender.send(connection) or link.backlogs.rounds:  # type: ignore[arg-type]
        link.backlogs.turn()
    return connection.sent


@pytest.mark.parametrize(
    ("wall", "expected"),
    [
        (1_800_000_000.0, [("published-at", "2027-01-15T07:59:55.000+00:00")]),
        (3.0, None),  # the computer has started in 1970, and nobody knows the time
    ],
)
def test_published_at_is_left_out_where_the_wall_clock_was_not_set(
    wall: float, expected: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = Link()
    link.offer("x")
    link.backlogs.time += 5
    monkeypatch.setattr(module, "time", SimpleNamespace(time=lambda: wall))
    assert send(link) == [("t", 1, expected)]


@pytest.mark.parametrize("keep", ["auto", "all", "latest"])
@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("held", [False, True])
def test_a_rule_with_qos_0_is_sent_with_qos_0(keep: KeepRule, restarted: bool, held: bool) -> None:
    """An acknowledged message waits as the publisher's QoS says, and is settled when it is sent."""
    link = Link(OutRule("#", "r/", "fleet/", keep, qos=0))
    assert link.offer("1", "event") is None
    assert link.offer("2", "event") is None
    if held and keep != "latest":
        for entry in link.take():
            assert link.backlog.hold(entry, 10, link.backlogs.time)
        link.backlog.rewind()
        link.backlog.connected()
    link.backlogs.commit()
    if restarted:
        link.restart()
    assert send(link) == [("event", 0, None)] * (1 if keep == "latest" else 2)
    assert link.counts().waiting == 0


def test_a_rule_in_memory_with_qos_0_is_sent_with_qos_0() -> None:
    link = Link(OutRule("#", "r/", "fleet/", "none", qos=0))
    link.offer("1")
    assert send(link) == [("t", 0, None)]


def test_only_short_topics_are_remembered() -> None:
    """1,024 of 64 KiB with a character of four bytes in each would take 256 MiB."""
    link = Link()
    topics = [end.ljust(size, "x") for size in (9, 200, 60_000) for end in ("", "\U0001f916")]
    for topic in topics:
        link.offer("1", topic)
    sender = sender_of(link)
    assert [topic for topic, *_ in send(link, sender)] == topics
    assert list(sender._topics) == topics[:4]


def test_what_is_too_large_is_not_written_anew_with_each_limit_that_is_a_byte_more() -> None:
    link = Link(OutRule("#", "r/", "fleet/", "all", qos=0))
    for size in (3_000, 2_000, 10):
        link.offer("x" * size, f"{size}")
    sender, backlog = sender_of(link), link.backlog
    held: list[str] = []
    hold = backlog.hold

    def noted(entry: Entry, packet_size: int, now: float) -> bool:
        held.append(entry.record.topic)
        return hold(entry, packet_size, now)

    backlog.hold = noted  # type: ignore[method-assign]

    def sent(limit: int) -> list[str]:
        backlog.rewind()
        backlog.connected(limit)
        return [topic for topic, *_ in send(link, sender, FleetLimits(packet_size=limit))]

    assert sent(1_000) == ["10"] and held == ["3000", "2000"]
    for limit in range(1_001, 2_001, 37):
        assert sent(limit) == []
    assert held == ["3000", "2000"]
    assert sent(2_100) == ["2000"] and held == ["3000", "2000", "3000"]
    assert sent(2_200) == [] and len(held) == 3
    assert sent(3_100) == ["3000"] and len(held) == 3


def test_a_flood_that_is_refused_is_not_a_flood_of_lines(caplog: pytest.LogCaptureFixture) -> None:
    link = Link(OutRule("a", "r/", "fleet/"), OutRule("b", "r/", "fleet/"))
    for number in range(100):
        link.offer("1", f"a/{number}", of=0)
    link.offer("1", "b/0", of=1)
    sender = sender_of(link)
    sender.acknowledged(link.take(), 0x87, "")
    assert sum("fleet's broker refuses it" in each for each in caplog.messages) == BURST + 1
    assert "a message for 'b/0' is set aside" in caplog.text
    link.backlogs.time += INTERVAL
    sender.tick()
    assert f"{100 - BURST} more of this kind, the last: upstream 'fleet'" in caplog.messages[-1]
    assert link.counts().set_aside == 101


@pytest.mark.parametrize(("code", "tries", "aside"), [(0x83, 15, 1), (0x80, 15, 1), (0x97, 40, 0)])
def test_what_is_refused_again_and_again_is_set_aside(code: int, tries: int, aside: int) -> None:
    """But for want of room, which there may be later."""
    link = Link()
    link.offer("x")
    sender = sender_of(link)
    sender.begin(FleetLimits())
    for _ in range(30):  # connections that end do not count
        assert len(link.take()) == 1
        link.backlog.rewind()
        link.backlog.connected()
    tried = 0
    for _ in range(40):
        link.backlogs.time += 100
        for entry in link.take():
            tried += 1
            sender.acknowledged([entry], code, "")
    counts = link.backlog.counts()
    assert (tried, counts.aside, counts.waiting) == (tries, aside, 1 - aside)


def test_topics_that_mosquitto_would_close_upon_are_set_aside() -> None:
    link = Link()
    link.offer("x", "/" * 201)
    link.offer("x", "/" * 200)
    assert [topic for topic, _, _ in send(link)] == ["/" * 200]
    (aside,) = link.backlog.aside()
    assert "a topic with 201 slashes, and 200 is the most" in aside.reason
