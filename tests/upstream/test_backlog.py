"""What waits for a link: order, lanes, the latest of a topic, what is dropped, and restarts."""

from __future__ import annotations

import math
import random
from collections import Counter

import pytest

from appliance.broker.backlogs import RecordsLostError
from appliance.mqtt.codec import NO_PROPERTIES
from appliance.upstream import backlog as module
from appliance.upstream import live_messages, read_ahead
from appliance.upstream.backlog import (
    MOST_LATER,
    Backlog,
)
from appliance.upstream.backlog_counts import BacklogCounts, DropReason
from appliance.upstream.disk_room import UNWRITTEN_AWAITED, UNWRITTEN_FROM_ROS, UNWRITTEN_SIZE
from appliance.upstream.eviction import MOST_AT_ONCE
from appliance.upstream.live_messages import DROP_COST, LATEST_SIZE, LIVE_SIZE
from appliance.upstream.rule_queue import LOADED_OVERHEAD, Entry
from appliance.upstream.rules import BacklogLimits, KeepRule, OutRule, Priority
from appliance.upstream.set_aside import ASIDE_SIZE
from upstream.plain_backlogs import PlainBacklogs


def rule(
    topic: str = "#",
    keep: KeepRule = "auto",
    priority: Priority = "normal",
    rate: float | None = None,
) -> OutRule:
    return OutRule(topic, "r/", "fleet/", keep, priority, rate)


class Link:
    """A backlog, and what its link does with it by hand."""

    def __init__(
        self,
        *rules: OutRule,
        backlogs: PlainBacklogs | None = None,
        online: bool = True,
        rate: float | None = None,
        bytes_per_second: float | None = None,
        **limits: object,
    ) -> None:
        self.rules = rules or (rule(),)
        self.backlogs = backlogs or PlainBacklogs()
        self.limits = BacklogLimits(**limits)  # type: ignore[arg-type]
        self.rates = {"rate": rate, "bytes_per_second": bytes_per_second}
        self.woken = 0
        self.backlog = self.start()
        if online:
            self.backlog.connected()

    def start(self) -> Backlog:
        now = self.backlogs.time
        return Backlog("f", self.backlogs, self.rules, self.limits, now, self.wake, **self.rates)

    def wake(self) -> None:
        self.woken += 1

    def restart(self) -> None:
        """The process is killed and starts again."""
        self.backlogs = self.backlogs.restarted()
        self.backlogs.time += 1
        self.backlog = self.start()
        self.backlog.connected()

    def offer(
        self,
        payload: bytes | str = b"",
        topic: str = "t",
        qos: int = 1,
        *,
        of: int = 0,
        retain: bool = False,
        expires_in: float | None = None,
        is_acknowledged: bool = True,
        user: str | None = None,
    ) -> str | None:
        data = payload.encode() if isinstance(payload, str) else payload
        now = self.backlogs.time
        expires_at = None if expires_in is None else now + expires_in
        return self.backlog.offer(
            self.rules[of],
            topic,
            data,
            qos,
            retain,
            NO_PROPERTIES,
            expires_at,
            now,
            is_acknowledged=is_acknowledged,
            user=user,
        )

    def next(self) -> Entry | None:
        """The next entry; what has to be read is read."""
        while True:
            entry = self.backlog.next(self.backlogs.time)
            if entry is not None or not self.backlogs.rounds:
                return entry
            self.backlogs.turn()

    def take(self, most: int = 1 << 30) -> list[Entry]:
        found: list[Entry] = []
        while len(found) < most and (entry := self.next()) is not None:
            found.append(entry)
        return found

    def drain(self) -> list[str]:
        """Send and settle all; returns the payloads."""
        sent: list[str] = []
        while found := self.take(100):
            for entry in found:
                sent.append(entry.record.payload.decode())
                self.backlog.settle(entry)
        return sent

    def counts(self) -> BacklogCounts:
        counts = self.backlog.counts()
        dropped = sum(counts.dropped.values())
        assert counts.offered + counts.restored == (
            counts.sent + dropped + counts.set_aside + counts.waiting
        )
        assert (counts.waiting == 0) == (counts.bytes == 0) == (counts.oldest_at is None)
        return counts

    def dropped(self) -> dict[str, int]:
        """By the value of the reason."""
        found: Counter[str] = Counter()
        for (_, reason), number in self.counts().dropped.items():
            found[reason.value] += number
        return dict(found)


def payloads(entries: list[Entry]) -> list[str]:
    return [entry.record.payload.decode() for entry in entries]


def test_a_message_is_handed_out_as_it_was_offered() -> None:
    link = Link(rule("events/#"))
    link.backlog.offer(link.rules[0], "fleet/a", b"data", 2, True, b"\x02\x01\x01", 1010.5, 1000.0)
    entry = link.next()
    assert entry is not None
    record = entry.record
    assert (record.rule, record.topic, record.payload) == ("r/events/#", "fleet/a", b"data")
    assert (record.qos, record.retain, record.properties_wire) == (2, True, b"\x02\x01\x01")
    assert (entry.qos, entry.expiry, entry.published_at, entry.attempts) == (1, 11, None, 1)
    assert link.counts().in_flight == 1
    link.backlog.settle(entry)
    link.backlog.settle(entry)
    assert link.next() is None
    assert link.counts().sent == 1


def test_all_are_sent_in_order_however_they_are_settled() -> None:
    backlogs = PlainBacklogs(segment_size=300)
    link = Link(backlogs=backlogs)
    for number in range(100):
        link.offer(str(number))
        if number % 7 == 0:
            backlogs.commit()
    entries = link.take()
    assert payloads(entries) == [str(number) for number in range(100)]
    random.Random(1).shuffle(entries)
    for entry in entries:
        link.backlog.settle(entry)
    backlogs.commit()
    assert not backlogs.journals[0].list and link.counts().waiting == 0


def test_rewind_repeats_what_was_in_flight_in_order() -> None:
    link = Link()
    for number in range(10):
        link.offer(str(number))
    entries = link.take(6)
    for entry in (entries[1], entries[4]):
        link.backlog.settle(entry)
    link.backlog.rewind()
    link.backlog.settle(entries[0])  # an acknowledgement on a connection that ended
    assert link.counts().in_flight == 0
    link.backlog.connected()
    again = link.take(2)
    assert payloads(again) == ["0", "2"] and [each.attempts for each in again] == [2, 2]
    link.backlog.rewind()
    assert link.drain() == ["0", "2", "3", "5", "6", "7", "8", "9"]
    assert link.counts().sent == 10


def test_a_number_is_the_same_each_time_and_none_is_used_twice() -> None:
    link = Link()
    numbers: dict[str, set[int]] = {}
    for run in range(5):
        for each in range(10):
            link.offer(f"{run} {each}")
        link.backlogs.commit()
        for entry in link.take():
            numbers.setdefault(entry.record.payload.decode(), set()).add(entry.record.number)
        link.restart()
    assert all(len(found) == 1 for found in numbers.values())
    assert len(set.union(*numbers.values())) == 50


def test_after_a_kill_all_that_was_committed_and_not_settled_is_sent() -> None:
    link = Link(backlogs=PlainBacklogs(segment_size=400))
    for number in range(20):
        link.offer(str(number))
        if number == 9:
            link.backlogs.commit()
    for entry in link.take(14):
        link.backlog.settle(entry)
    link.backlogs.commit()
    link.offer("lost: nobody was told that it is stored")
    link.restart()
    assert link.counts().restored == 6
    link.offer("20")
    assert link.drain() == [str(number) for number in range(14, 21)]


def test_lanes() -> None:
    """The highest first, but each of the others gets at least one in 16."""
    link = Link(rule("h", priority="high"), rule("n"), rule("l", priority="low"))
    for number in range(64):
        for of in range(3):
            link.offer("hnl"[of] + str(number), of=of)
    order = [each[0] for each in link.drain()]
    for start in range(64 - 16):
        window = order[start : start + 16]
        assert window.count("n") >= 1 and window.count("l") >= 1, window
        assert window.count("h") >= 13, window
    assert order[:5] == ["h"] * 5
    assert Counter(order) == {"h": 64, "n": 64, "l": 64}


def test_where_nothing_waits_in_other_lanes_a_turn_is_one_run() -> None:
    link = Link(rule("a"), rule("b", priority="low"), rule("c", priority="high"))
    for number in range(100):
        link.offer(f"{number}", of=0)
    now = link.backlogs.time
    assert len(link.backlog.take(now, 64, 1 << 20)) == 64
    link.offer("low", of=1)
    order = [each.record.payload for each in link.backlog.take(now, 64, 1 << 20) + link.take()]
    assert order.index(b"low") < 16 and len(order) == 37


def test_rules_of_a_lane_are_sent_in_the_order_of_publishing() -> None:
    link = Link(rule("a"), rule("b"), rule("c"))
    expected = []
    choose = random.Random(3)
    for number in range(50):
        link.offer(str(number), of=choose.randrange(3))
        expected.append(str(number))
    assert link.drain() == expected


def test_the_latest_of_a_topic() -> None:
    link = Link(online=False)
    for number in range(50):
        link.offer(f"a{number}", "a", qos=0)
        link.offer(f"b{number}", "b", qos=1, retain=True)
    link.offer("", "b", retain=True)
    assert link.counts().waiting == 2
    assert link.dropped() == {"replaced": 99}
    found = {entry.record.topic: entry for entry in link.take()}
    assert found["a"].record.payload == b"a49" and found["a"].qos == 0
    assert found["b"].record.payload == b"" and found["b"].record.retain and found["b"].qos == 1


def test_a_newer_one_is_sent_after_the_one_in_flight() -> None:
    link = Link(rule(keep="latest"))
    link.offer("1")
    (first,) = link.take()
    link.offer("2")
    link.offer("3")
    (third,) = link.take()
    assert third.record.payload == b"3"
    link.backlog.settle(third)
    link.backlog.settle(first)
    link.backlogs.commit()
    assert len(link.backlogs.latest_records.rows) == 0
    assert link.counts().sent == 2


def test_an_older_one_is_not_sent_again_after_a_newer_one() -> None:
    link = Link(rule(keep="latest"))
    link.offer("1")
    link.take()
    link.offer("2")
    link.take()
    link.backlog.rewind()
    assert link.dropped() == {"replaced": 1}
    link.offer("3")  # while "2" waits to be sent again
    assert link.drain() == ["3"]
    link.offer("4")
    link.take()
    link.offer("5")
    link.backlog.rewind()
    link.backlogs.commit()
    link.restart()
    assert link.drain() == ["5"]


@pytest.mark.parametrize("qos", [0, 1])
def test_the_latest_one_survives_a_kill(qos: int) -> None:
    """Retained or with QoS 1. One of QoS 0 that replaces it is stored as well."""
    link = Link(rule(keep="latest"))
    link.offer("1", qos=qos, retain=True)
    link.take()
    link.offer("2", qos=0)
    link.offer("forgotten", "u", qos=0)
    link.backlogs.commit()
    link.restart()
    assert link.drain() == ["2"]
    link.backlogs.commit()
    link.restart()
    assert link.drain() == []


def test_the_latest_of_qos_0_survives_an_orderly_stop_and_is_in_memory_again() -> None:
    link = Link(rule(keep="latest"), online=False)
    link.offer("0", "before", qos=0)
    link.offer("1", "sent", qos=0)
    link.offer("2", "retained", qos=0, retain=True)
    link.backlog.store()
    link.backlogs.commit()
    link.restart()
    assert link.counts().restored == 3
    link.offer("3", "before", qos=0)  # in memory, as long as the appliance runs
    assert link.drain() == ["3", "1", "2"]
    link.backlogs.commit()
    link.restart()
    assert link.drain() == []
    link.offer("4", "lost", qos=0)
    link.backlogs.failing = True
    link.backlog.store()
    link.backlogs.failing = False
    link.backlogs.commit()
    link.restart()
    assert link.drain() == []


def test_the_latest_does_not_overtake_what_came_before_of_its_topic() -> None:
    """With `auto` a topic may have both: retained messages, and others."""
    link = Link(online=False)
    link.offer("1", "t")
    link.offer("x", "u", retain=True)
    link.offer("2", "t", retain=True)
    link.offer("3", "t", retain=True)
    link.offer("y", "u", retain=True)
    link.offer("4", "t")
    link.offer("z", "u")
    sent = link.drain()
    assert [each for each in sent if each.isdigit()] == ["1", "3", "4"]
    assert [each for each in sent if not each.isdigit()] == ["y", "z"]
    assert link.dropped() == {"replaced": 2}
    link.offer("5", "t", retain=True)
    link.offer("6", "t", retain=True)
    assert link.drain() == ["6"]


def test_live_messages_do_not_wait_for_a_backlog() -> None:
    link = Link()
    for number in range(100):
        link.offer(str(number))
    link.offer("now", qos=0)
    assert link.drain().index("now") <= 1


def test_none_forgets_while_offline() -> None:
    link = Link(rule(keep="none"), online=False)
    link.offer("1")
    link.backlog.connected()
    for payload in "2345":
        link.offer(payload)
    first, second = link.take(2)
    link.backlog.settle(first)
    link.backlog.retry_later(second, link.backlogs.time)
    link.take(1)
    link.backlog.rewind()
    assert link.counts().waiting == 0
    assert link.dropped() == {"offline": 4}
    assert (first.qos, link.counts().sent) == (1, 1)


def test_expired_and_aged_messages_are_not_sent() -> None:
    link = Link(rule(), rule("l", keep="latest"), age=60.0)
    link.offer("expires", expires_in=10.0)
    link.offer("ages", "a")
    link.offer("expires", of=1, expires_in=10.0)
    (entry,) = link.take(1)
    assert (entry.expiry, entry.published_at) == (10, None)
    link.backlog.rewind()
    link.backlogs.time += 5.5
    (entry,) = link.take(1)
    assert (entry.expiry, entry.published_at) == (5, 1000.0)
    link.backlog.rewind()
    link.backlogs.time += 5
    assert payloads(link.take(1)) == ["ages"]
    assert link.dropped() == {"expired": 1}
    link.backlog.rewind()
    link.backlog.tick(link.backlogs.time)
    assert link.dropped() == {"expired": 2}
    link.backlogs.time += 60
    assert link.next() is None
    assert link.dropped() == {"expired": 2, "age": 1}


def test_what_is_on_disk_ages() -> None:
    backlogs = PlainBacklogs(segment_size=1000)
    link = Link(backlogs=backlogs, age=100.0)
    for number in range(100):
        link.offer(str(number))
        backlogs.commit()
        backlogs.time += 1
    link.restart()
    backlogs = link.backlogs
    backlogs.time += 49
    link.backlog.tick(backlogs.time)
    assert link.dropped() == {"age": 51}
    assert link.drain() == [str(number) for number in range(51, 100)]
    assert link.counts().oldest_at is None


def test_full_the_oldest_of_the_lowest_lane_goes(caplog: pytest.LogCaptureFixture) -> None:
    link = Link(rule("h", priority="high"), rule("n"), rule("l", priority="low"), size=10_000)
    for of in (0, 2):
        for number in range(30):
            link.offer(f"{of} {number:100}", of=of)
    for number in range(20):
        link.offer(f"1 {number:100}", of=1)
    assert link.counts().bytes <= 10_000
    sent = link.drain()
    kept = [sum(each.startswith(f"{of} ") for each in sent) for of in range(3)]
    assert kept[0] == 30 and kept[1] == 20 and 0 < kept[2] < 30
    low = [int(each[2:]) for each in sent if each.startswith("2 ")]
    assert low == list(range(30 - kept[2], 30))
    assert link.counts().dropped == {("r/l", DropReason.FULL): 30 - kept[2]}
    link.backlog.tick(0.0)
    told = [each.getMessage() for each in caplog.records]
    assert len(told) == 2 and "is full" in told[0]
    assert f"room again; {30 - kept[2]} messages" in told[1]


def test_full_of_what_is_more_urgent_the_message_itself_goes() -> None:
    link = Link(rule("h", priority="high"), rule("l", priority="low"), size=5_000)
    while not link.dropped():
        link.offer("x" * 100, of=0)
    waiting = link.counts().waiting
    assert link.offer("x" * 100, of=1) is None
    assert link.counts().dropped["r/l", DropReason.FULL] == 1
    assert link.offer("x" * 6_000, of=0) is None
    assert link.counts().waiting == waiting
    assert link.counts().dropped["r/h", DropReason.FULL] == 2


def _drop_on(link: Link) -> int:
    """Let the backlog drop what is displaced, in later turns; returns how many that takes."""
    turns = 0
    while link.backlog.is_owing:
        before, work = sum(link.dropped().values()), link.backlog.work
        link.backlog.drop_more()
        dropped = sum(link.dropped().values()) - before
        assert DROP_COST * dropped <= link.backlog.work - work <= MOST_AT_ONCE + DROP_COST
        turns += 1
    return turns


def _full(*rules: OutRule) -> Link:
    """A link to which 3,000 small states of the second rule wait, which fill it."""
    link = Link(*rules, size=1_000_000, online=False)
    for number in range(3_000):
        link.offer(f"{number:285}", f"{number}", qos=0, of=1)
    assert 990_000 < link.counts().bytes <= 1_000_000 and not link.backlog.work
    return link


def test_full_what_a_large_message_displaces_goes_in_pieces() -> None:
    link = _full(rule("h", priority="high"), rule(keep="latest"))
    assert link.offer("x" * 500_000) is None
    first = link.dropped()["full"]
    assert 0 < DROP_COST * first <= link.backlog.work <= MOST_AT_ONCE
    # What comes meanwhile has room as ever: it makes that for itself.
    assert link.offer("urgent") is None
    assert link.offer("3000", "3000", qos=0, of=1) is None
    assert link.dropped()["full"] <= first + 3
    assert link.counts().bytes > 1_000_000
    assert _drop_on(link) >= 2
    assert link.counts().bytes <= 1_000_000
    dropped = link.dropped()["full"]
    assert 1_400 < dropped < 1_700  # not more than needed
    link.backlog.connected()
    sent = [each.strip() for each in link.drain()]
    assert sent[:2] == ["x" * 500_000, "urgent"]
    rest = [int(each) for each in sent if each.isdigit()]
    assert rest == list(range(dropped, 3_001))


def test_full_the_clock_drops_on_too() -> None:
    link = _full(rule("h", priority="high"), rule(keep="latest"))
    link.offer("x" * 500_000)
    for _ in range(5):
        link.backlog.tick(link.backlogs.time)
    assert not link.backlog.is_owing and link.counts().bytes <= 1_000_000


def test_full_little_more_than_the_size_may_wait_meanwhile() -> None:
    link = _full(rule("h", priority="high"), rule(keep="latest"))
    for number in range(3):  # of which one after the other displaces more than goes in one piece
        assert link.offer(f"{number}" * 400_000) is None
    assert link.counts().dropped["r/h", DropReason.FULL] == 2
    assert link.counts().bytes < 1_400_000
    _drop_on(link)
    assert link.offer("3" * 400_000) is None
    _drop_on(link)
    assert link.counts().bytes <= 1_000_000
    link.backlog.connected()
    assert [each[0] for each in link.drain() if len(each) > 300] == ["0", "3"]


def test_full_of_what_is_more_urgent_a_large_message_goes_in_the_end() -> None:
    rules = rule("h", priority="high"), rule(keep="latest", priority="low"), rule("l")
    link = _full(*rules)
    for _ in range(70):
        link.offer("x" * 10_000)
    assert DROP_COST * link.counts().lanes[2] > MOST_AT_ONCE
    assert link.offer("y" * 500_000, of=2) is None and link.counts().lanes[1] == 1
    _drop_on(link)
    assert link.counts().lanes == (70, 0, 0)
    assert link.counts().dropped["r/l", DropReason.FULL] == 1


@pytest.mark.parametrize("size", [2_000_000, 5_000_000])
def test_what_is_forgotten_is_displaced_in_pieces(size: int) -> None:
    link = Link(rule(keep="none"))
    number = 0
    while not link.dropped():
        link.offer(f"{number}".ljust(10))
        number += 1
    assert link.counts().waiting > 20_000
    work = link.backlog.work
    link.offer("x" * size)
    first = link.dropped()["full"] - 1
    assert 0 < DROP_COST * first <= link.backlog.work - work <= MOST_AT_ONCE
    link.offer("y" * size)  # one more has no room meanwhile
    assert _drop_on(link) > 10
    sent = link.drain()
    assert sent[-1] == "x" * size
    assert [int(each) for each in sent[:-1]] == list(range(number - len(sent) + 1, number))
    assert (len(sent) == 1) == (size > LIVE_SIZE)


@pytest.mark.parametrize("keep", ["all", "latest", "none"])
def test_what_is_too_old_goes_in_pieces(keep: KeepRule) -> None:
    link = Link(rule(keep=keep))
    for number in range(5_000):
        link.offer("old", f"{number}", expires_in=1.0)
    link.offer("kept", "kept")
    link.backlogs.time += 1
    link.backlog.tick(link.backlogs.time)
    assert (
        0 < DROP_COST * link.dropped()["expired"] <= link.backlog.work <= MOST_AT_ONCE + DROP_COST
    )
    link.offer("newer", "newer")  # meanwhile
    assert _drop_on(link) >= 8
    assert link.dropped() == {"expired": 5_000}
    assert link.drain() == ["kept", "newer"]


def test_latest_ones_that_were_replaced_meanwhile_stay() -> None:
    link = Link(rule(keep="latest"))
    for number in range(2_000):
        link.offer("old", f"{number}", expires_in=1.0)
    link.backlogs.time += 1
    link.backlog.tick(link.backlogs.time)
    link.offer("new", "1999", expires_in=5.0)
    _drop_on(link)
    assert link.dropped() == {"expired": 1_999, "replaced": 1}
    link.backlogs.time += 5
    link.backlog.tick(link.backlogs.time)
    assert link.dropped() == {"expired": 2_000, "replaced": 1}


def test_full_of_what_is_too_old_nothing_else_goes() -> None:
    link = Link(rule("h", "none", "high"), rule("l", priority="low"), size=1_000_000)
    for number in range(2_900):
        link.offer(f"{number:285}", f"{number}", expires_in=1.0)
    link.offer("low", of=1)
    link.backlogs.time += 1
    assert link.offer("x" * 900_000) is None  # displaces more than goes in one piece
    assert link.counts().bytes > 1_000_000 and link.backlog.work <= MOST_AT_ONCE
    _drop_on(link)
    assert link.dropped() == {"expired": 2_900}
    assert link.drain() == ["x" * 900_000, "low"]


def test_full_of_what_is_too_old_nothing_is_refused() -> None:
    link = Link(rule(keep="none"), size=1_000_000, when_full="refuse")
    for number in range(2_900):
        link.offer(f"{number:285}", f"{number}", expires_in=1.0)
    assert link.offer("x" * 900_000) is not None
    link.backlogs.time += 1
    assert link.offer("x" * 900_000) is None
    _drop_on(link)
    assert link.dropped() == {"expired": 2_900, "refused": 1}
    assert link.counts().bytes <= 1_000_000
    assert link.offer("y" * 900_000) is not None


@pytest.mark.parametrize("room", range(2, 14))
@pytest.mark.parametrize("behind", range(4))
def test_what_is_on_the_way_into_memory_is_not_merged_on_the_disk(
    room: int, behind: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is slow: batches come while one is read and behind that, and memory has room for a
    part of them."""
    for during in range(1, 5):
        link = Link(rule(keep="all"))
        offered = [f"{number:03}" for number in range(3 + 2 * during + 2 * behind)]
        wanted = iter(offered)

        def batch(count: int) -> None:
            for _ in range(count):
                link.offer(next(wanted))  # noqa: B023
            link.backlogs.commit()  # noqa: B023

        batch(3)
        size = link.counts().bytes // 3 + LOADED_OVERHEAD
        monkeypatch.setattr(read_ahead, "LOADED_SIZE", room * size)
        monkeypatch.setattr(read_ahead, "LOADED_SHARE", 0)
        link.restart()
        assert link.backlog.next(link.backlogs.time) is None and link.backlogs.rounds  # it is read
        for _ in range(during):
            batch(2)
        if behind:
            link.backlogs.turn()
        for _ in range(behind):
            batch(2)
        for journal in link.backlogs.journals.values():
            journal.merge()
        assert link.drain() == offered
        assert link.counts().waiting == 0


@pytest.mark.parametrize("more", [0, 4])
@pytest.mark.parametrize("room", range(3, 9))
def test_the_rest_of_a_segment_is_damaged_of_which_a_part_is_in_memory(
    room: int, more: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = Link(rule(keep="all"))
    for number in range(10 + more):
        link.offer(f"{number:03}")
        if number in (9, 9 + more):
            link.backlogs.commit()
    size = link.counts().bytes // (10 + more) + LOADED_OVERHEAD
    monkeypatch.setattr(read_ahead, "LOADED_SIZE", room * size)
    monkeypatch.setattr(read_ahead, "LOADED_SHARE", 0)
    link.restart()
    assert link.backlog.next(link.backlogs.time) is None
    link.backlogs.turn()
    sent = [link.backlog.next(link.backlogs.time)]
    link.backlogs.failures.append(RecordsLostError("for the test"))
    while (entry := link.backlog.next(link.backlogs.time)) is not None or link.backlogs.rounds:
        link.backlogs.turn()
        if entry is not None:
            sent.append(entry)
    found = [entry.record.payload.decode() for entry in sent if entry is not None]
    assert found == sorted(found)
    assert found[len(found) - more :] == [f"{10 + each:03}" for each in range(more)]
    lost = link.dropped()["unreadable"]
    assert len(found) + lost == 10 + more and lost >= 1
    for entry in reversed(sent):
        assert entry is not None
        link.backlog.settle(entry)
    assert link.counts().waiting == link.counts().bytes == 0
    link.backlogs.commit()
    link.restart()
    assert link.counts().waiting == 0


def test_full_and_refuse(caplog: pytest.LogCaptureFixture) -> None:
    link = Link(rule(), rule("l", keep="latest"), size=5_000, when_full="refuse", age=60.0)
    assert link.offer("y" * 100, of=1) is None
    accepted = 0
    while (problem := link.offer(f"{accepted:100}")) is None:
        accepted += 1
    assert problem == "the backlog of f is full"
    assert link.offer("z" * 100, of=1) is None  # in place of the one that waits
    assert link.dropped() == {"refused": 1, "replaced": 1}
    assert len(caplog.records) == 1
    link.backlogs.time += 61
    assert link.offer("new") is None
    assert link.drain() == ["new"]


def test_full_and_refuse_leaves_room_for_what_is_more_urgent() -> None:
    link = Link(
        rule("alarms/#", priority="high"),
        rule("logs/#", priority="low"),
        size=80_000,
        when_full="refuse",
    )
    said = [link.offer(bytes(1000), of=1) for _ in range(100)]
    most = 80_000 - 80_000 // 8
    assert most - 1200 < link.counts().bytes <= most and said[0] is None and said[-1]
    said = [link.offer(bytes(1000)) for _ in range(20)]
    assert said[0] is None and said[-1], "all of it is for alarms"
    assert 80_000 - 1200 < link.counts().bytes <= 80_000


def test_full_and_refuse_takes_a_newer_value_in_place_of_an_older_one() -> None:
    """What more urgent messages have taken of its room is no reason to send the older one."""
    link = Link(
        rule("alarms/#", priority="high"),
        rule("battery", keep="latest", priority="low"),
        online=False,
        size=80_000,
        when_full="refuse",
    )
    assert link.offer("80 %", of=1) is None
    while link.offer(bytes(1000)) is None:
        pass
    assert link.offer("5 % ", of=1) is None
    assert link.offer("much more than before", of=1), "that needs room"
    link.backlog.connected()
    assert [each for each in link.drain() if each[0] != "\0"] == ["5 % "]


def test_what_cannot_be_stored_is_refused() -> None:
    link = Link()
    link.backlogs.failing = True
    assert link.offer("1") == "the backlog of f cannot be stored"
    assert link.offer("2", retain=True) == "the backlog of f cannot be stored"
    assert link.offer("3", qos=0) is None
    assert link.drain() == ["3"]
    assert link.dropped() == {"store": 2}


def test_no_more_of_qos_0_is_taken_than_the_disk_takes(caplog: pytest.LogCaptureFixture) -> None:
    """What is acknowledged waits for the disk; of the rest, a higher lane may have more wait."""
    rules = rule(keep="all"), rule("l", "all", "low"), rule("t", "latest")
    link = Link(*rules, online=False)
    link.offer("before", qos=0)
    link.backlogs.unwritten = UNWRITTEN_SIZE[2]
    link.offer("low", qos=0, of=1)
    link.offer("normal", qos=0)
    link.backlogs.unwritten = UNWRITTEN_SIZE[1]
    link.offer("normal as well", qos=0)
    link.offer("acknowledged", qos=1, of=1)
    link.offer("in memory", qos=0, of=2)
    large = "x" * LATEST_SIZE
    link.offer(large, "large", qos=0, of=2)
    assert link.dropped() == {"disk": 3}
    assert len(caplog.records) == 3 and "the disk is too slow for r/l" in caplog.text  # one a rule
    link.backlogs.unwritten = 0
    link.offer(large, "large", qos=0, of=2)
    link.backlog.connected()
    sent = link.drain()
    assert sorted(sent) == sorted(["before", "normal", "acknowledged", "in memory", large])


def test_what_waits_for_the_disk_is_bounded_and_leaves_room_for_what_is_acknowledged() -> None:
    """By lane: messages from ROS are dropped, publishers that are acknowledged wait."""
    rules = rule("h", priority="high"), rule("n"), rule("l", priority="low"), rule("t", "latest")
    link = Link(*rules, rule("x", "none"))
    large = LATEST_SIZE + 1

    def waiting(size: int = 10, qos: int = 1, retain: bool = False) -> str:
        asked = zip("hnltx", link.rules, strict=True)
        return "".join(
            name
            for name, each in asked
            if link.backlog.must_wait(each, "fleet/t", qos, retain, size)
        )

    for lane in range(3):
        link.backlogs.unwritten = UNWRITTEN_FROM_ROS[lane] - 1
        assert not waiting() and link.offer("kept", of=lane, is_acknowledged=False) is None
        link.backlogs.unwritten += 1
        assert link.offer("dropped", of=lane, is_acknowledged=False) is None
        link.offer("acknowledged", of=lane)
    assert link.dropped() == {"disk": 3} and link.drain().count("acknowledged") == 3
    waits = []
    for size in reversed(UNWRITTEN_AWAITED):
        link.backlogs.unwritten = size - 1
        waits.append(waiting())
    assert waits == ["", "l", "nl"]
    link.backlogs.unwritten = UNWRITTEN_AWAITED[0]
    assert link.backlog.is_behind_disk and waiting(qos=2) == "hnl"
    assert waiting(retain=True) == ""  # as the latest one of its topic it is in memory
    assert waiting(large) == "hnlt" and waiting(large, retain=True) == "hnlt"
    link.backlogs.failing = True  # then it is refused
    assert not waiting() and not link.backlog.is_behind_disk


@pytest.mark.parametrize("trouble", ["failing", "slow"])
def test_nothing_is_stored_in_another_place_while_the_disk_is_behind(trouble: str) -> None:
    link = Link(rule(), rule("later"))
    link.backlog.connected(10)
    link.offer("too large")
    link.offer("refused", of=1)
    link.backlogs.commit()
    link.backlogs.failing = trouble == "failing"
    link.backlogs.unwritten = 0 if link.backlogs.failing else UNWRITTEN_SIZE[2]
    records = {lane: len(each.records) for lane, each in link.backlogs.journals.items()}
    rows = dict(link.backlogs.latest_records.rows)
    for _ in range(5):
        for entry in link.take():
            if entry.record.payload == b"refused":
                link.backlog.retry_later(entry, link.backlogs.time)
            else:
                assert link.backlog.hold(entry, 10, link.backlogs.time)
        assert link.next() is None
        link.backlogs.time = link.backlog.due(link.backlogs.time) or math.inf
    assert records == {lane: len(each.records) for lane, each in link.backlogs.journals.items()}
    assert rows == link.backlogs.latest_records.rows
    assert (link.counts().held, link.counts().waiting) == (0, 2)
    link.backlogs.commit()
    link.restart()  # both are still there
    assert sorted(link.drain()) == ["refused", "too large"]
    link.offer("too large")
    (entry,) = link.take()
    assert link.backlog.hold(entry, 10, link.backlogs.time)
    assert link.counts().held == 1


def test_values_that_were_read_hold_up_no_larger_one_before_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A large state comes in place of a small one that had been read with those behind it."""
    monkeypatch.setattr(live_messages, "LATEST_SIZE", 0)
    link = Link(rule(keep="latest"))
    link.offer("small", "a")
    link.offer("b", "b")
    assert link.backlog.next(link.backlogs.time) is None
    link.backlogs.turn()
    large = "x" * live_messages.VALUES_SIZE
    link.offer(large, "a")
    assert link.drain() == [large, "b"]


@pytest.mark.parametrize("commits", [2, 7, 1000])
def test_an_outage_keeps_exactly_the_newest(commits: int) -> None:
    backlogs = PlainBacklogs(segment_size=4096)
    link = Link(rule(), rule("low", priority="low"), backlogs=backlogs, size=30_000, online=False)
    for number in range(1_000):
        link.offer(f"{number:200}")
        if number % commits == 0:
            backlogs.commit()
            for journal in backlogs.journals.values():
                journal.merge()
        assert link.counts().bytes <= 30_000
    assert backlogs.reads == 0  # nothing is read to be dropped
    waiting = link.counts().waiting
    assert link.counts().bytes >= 30_000 - 4096 - 300
    assert link.dropped() == {"full": 1_000 - waiting}
    assert [int(each) for each in link.drain()] == list(range(1_000 - waiting, 1_000))


def test_a_retry_does_not_block_what_follows() -> None:
    link = Link()
    for number in range(5):
        link.offer(str(number))
    first, second = link.take(2)
    link.backlog.retry_later(first, 1000.0)
    assert link.drain() == ["2", "3", "4"]
    link.backlog.settle(second)
    assert link.backlog.due(1000.0) == 1001.0
    link.backlogs.time = 1001.0
    (again,) = link.take()
    assert again is first and again.attempts == 2
    link.backlog.retry_later(again, 1001.0)
    assert link.backlog.due(1001.0) == 1003.0
    link.backlogs.commit()
    link.restart()  # nothing but this one is repeated
    assert link.drain() == ["0"]
    link.backlogs.commit()
    link.restart()
    assert link.drain() == []


def test_many_retries_hold_up_the_rest() -> None:
    """The fleet's broker takes nothing: it is not asked for each message."""
    link = Link()
    for number in range(10 * MOST_LATER):
        link.offer(str(number))
    for _ in range(2 * MOST_LATER):
        entry = link.next()
        if entry is None:
            break
        link.backlog.retry_later(entry, link.backlogs.time)
    assert link.counts().waiting == 10 * MOST_LATER
    assert link.next() is None
    due = link.backlog.due(link.backlogs.time)
    assert due == 1001.0
    while link.counts().waiting:
        link.drain()
        link.backlogs.time = link.backlog.due(link.backlogs.time) or link.backlogs.time + 1


@pytest.mark.parametrize("size", [10, 100_000])
def test_a_rule_that_is_refused_holds_up_itself_alone(size: int) -> None:
    """One user's topics are refused: those of others go on, however large what waits is."""
    link = Link(rule("low", "all", "low"), rule("alarms", "all", "high"), rule("x", priority="low"))
    for number in range(3 * MOST_LATER):
        link.offer(f"{number}".ljust(size))
    for _ in range(4):  # whole windows are refused, and a connection ends in between
        for _, entry in zip(range(MOST_LATER), iter(link.next, None), strict=False):
            link.backlog.retry_later(entry, link.backlogs.time)
        link.backlog.rewind()
        link.backlog.connected()
    assert link.next() is None
    assert link.backlog._again_size < module.IN_FLIGHT_SIZE + module.IN_FLIGHT_RESERVE + 2 * size
    for number in range(10):
        assert link.offer(f"alarm {number}", of=1) is None
        assert link.offer(f"{number}", of=2, qos=number % 2) is None
        sent = link.drain()
        assert sent == [f"alarm {number}", f"{number}"]
    assert link.counts().waiting == 3 * MOST_LATER


def test_large_messages_that_wait_hold_up_no_large_one_of_another_rule() -> None:
    """With many rules each may have little in memory; nor is the same read again and again."""
    others = [rule(f"r{number}") for number in range(40)]
    link = Link(rule("low", "all", "low"), rule("alarms", "all", "high"), *others)
    link.backlog.connected(50_000)

    def first() -> Entry | None:
        for _ in range(200):
            entry = link.backlog.next(link.backlogs.time)
            if entry is not None or not link.backlogs.rounds:
                return entry
            link.backlogs.turn()
        raise AssertionError(f"{link.backlogs.reads} reads")

    for number in range(20):
        link.offer(f"{number}".ljust(100_000))
    while (entry := first()) is not None:
        assert link.backlog.hold(entry, 50_000, link.backlogs.time)
    link.backlog.rewind()
    link.backlog.connected(50_000)
    assert first() is None  # they are too large for this connection as well
    link.offer("alarm".ljust(40_000), of=1)
    entry = first()
    assert entry is not None and entry.record.payload.startswith(b"alarm")
    assert link.backlogs.reads < 100


def test_a_latest_one_is_not_tried_again_after_a_newer_one() -> None:
    link = Link(rule(keep="latest"))
    link.offer("1")
    (first,) = link.take()
    link.backlog.retry_later(first, 1000.0)
    link.offer("2")
    assert link.drain() == ["2"]
    link.offer("3")
    (third,) = link.take()
    link.offer("4")
    (fourth,) = link.take()
    link.backlog.retry_later(third, 1000.0)
    link.backlog.settle(fourth)
    link.backlogs.time += 100
    assert link.drain() == []
    assert link.dropped() == {"replaced": 2}


def test_set_aside() -> None:
    link = Link()
    for number in range(1005):
        link.offer(str(number))
    for entry in link.take():
        link.backlog.set_aside(entry, "Not authorized (0x87)", link.backlogs.time)
    assert link.counts().set_aside == 1005 and link.counts().aside == 1000
    assert link.counts().waiting == 0
    link.backlogs.commit()
    link.restart()
    found = link.backlog.aside()
    assert len(found) == len(link.backlogs.aside_records.rows) == 1000
    assert (found[0].topic, found[0].reason, found[0].size) == ("t", "Not authorized (0x87)", 1)
    assert (found[0].rule, found[0].at) == ("r/#", 1000.0)
    assert link.drain() == []


@pytest.mark.parametrize("size", [1, 100_000])
def test_a_rule_with_many_set_aside_leaves_those_of_others(size: int) -> None:
    link = Link(rule("a"), rule("b"))
    link.offer("b", of=1)
    link.offer("last", of=1)
    for number in range(1005 if size == 1 else 200):
        link.offer("x" * size, topic=f"{number}")
    for entry in iter(link.next, None):
        link.backlog.set_aside(entry, "no", link.backlogs.time)
    link.backlogs.commit()
    found = link.backlog.aside()
    assert [each.rule for each in found[:3]] == ["r/b", "r/b", "r/a"]
    assert found[-1].topic == f"{number}"
    stored = sum(each.stored for each in found)
    assert len(found) == 1000 if size == 1 else stored <= ASIDE_SIZE < stored + found[-1].stored
    link.restart()
    assert link.backlog.aside() == found
    link.offer("x" * (ASIDE_SIZE + 1), topic="large", of=1)  # is kept, as the newest
    (entry,) = link.take()
    link.backlog.set_aside(entry, "no", link.backlogs.time)
    assert [each.topic for each in link.backlog.aside()] == ["large"]


def test_of_a_topic_whose_latest_counts_the_latest_is_set_aside() -> None:
    link = Link(rule(keep="latest"), rule("a", keep="all"))
    for of in (0, 0, 0, 1, 1):
        link.offer("x", of=of)
        (entry,) = link.take()
        link.backlog.set_aside(entry, "no", link.backlogs.time)
    link.backlogs.commit()
    assert link.counts().set_aside == 5 and link.counts().aside == 3
    assert len(link.backlogs.aside_records.rows) == 3


def test_rates() -> None:
    link = Link(rule("slow", rate=10.0), rule("fast"), rate=100.0)
    for number in range(300):
        link.offer(f"s{number}", of=0)
        link.offer(f"f{number}", of=1)
    sent: list[tuple[float, str]] = []
    now = link.backlogs.time
    while link.counts().waiting and now < 1100:
        for payload in link.drain():
            sent.append((now, payload))
        due = link.backlog.due(now)
        if due is None:
            break
        assert due > now
        link.backlogs.time = now = due
    assert len(sent) == 600
    fast = [at for at, payload in sent if payload[0] == "f"]
    slow = [at for at, payload in sent if payload[0] == "s"]
    assert fast[-1] - fast[0] == pytest.approx(300 / 90, rel=0.05)
    assert slow[-1] - slow[0] == pytest.approx(30, rel=0.05)


def test_bytes_per_second() -> None:
    link = Link(bytes_per_second=10_000)
    for _ in range(100):
        link.offer("x" * 950)
    size = link.counts().bytes
    while link.counts().waiting:
        link.drain()
        link.backlogs.time = link.backlog.due(link.backlogs.time) or link.backlogs.time
    assert link.backlogs.time - 1000.0 == pytest.approx(size / 10_000, rel=0.05)


def test_other_rules_are_followed() -> None:
    """What waits for a rule that is no more is sent; a rule may get another lane."""
    link = Link(rule("old"), rule("kept", priority="low"))
    link.offer("1", of=0)
    link.offer("2", of=1)
    link.rules = (rule("kept", priority="high"), rule("new"))
    link.backlog.replace_rules(link.rules, BacklogLimits(size=500), 1000.0)
    link.offer("3", of=0)
    link.offer("4", of=1)
    assert link.drain() == ["2", "3", "1", "4"]
    link.backlog.tick(1000.0)
    link.offer("5", of=1)
    link.offer("x" * 500, of=1)
    assert link.dropped() == {"full": 1}
    link.backlogs.commit()
    link.rules = (rule("none of these"),)
    link.restart()
    assert link.drain() == ["5"]


def test_journals_of_rules_that_are_no_more_are_reused() -> None:
    link = Link(rule("0"))
    for number in range(1, 20):
        link.offer("x")
        assert link.drain() == ["x"]
        link.rules = (rule(str(number)),)
        link.backlog.replace_rules(link.rules, link.limits, 1000.0)
    assert len(link.backlogs.journals) == 1


def test_a_read_that_fails_is_repeated() -> None:
    link = Link()
    link.offer("1")
    link.backlogs.commit()
    link.restart()
    link.backlogs.failures.append(OSError("disk I/O error"))
    assert link.next() is None
    due = link.backlog.due(link.backlogs.time)
    assert due is not None and due > link.backlogs.time
    link.backlogs.time = due
    assert link.drain() == ["1"]


def test_damaged_records_are_counted() -> None:
    backlogs = PlainBacklogs(segment_size=300)
    link = Link(backlogs=backlogs)
    for number in range(12):
        link.offer(str(number))
    backlogs.commit()
    link.restart()
    first = link.backlogs.journals[0].list[0]
    journal = link.backlogs.journals[0]
    records = journal.records[journal.list[1].key]
    records[0] = b"\xff" + records[0][1:]  # of a newer version, say
    link.backlogs.failures.append(RecordsLostError("damaged"))
    sent = link.drain()
    lost = first.count + 1
    assert link.dropped() == {"unreadable": lost}
    assert len(sent) == 12 - lost


def test_wakes_once_when_there_is_something_again() -> None:
    link = Link()
    assert link.woken == 0
    link.offer("1")
    link.offer("2")
    assert link.woken == 1
    link.drain()
    link.offer("3")
    assert link.woken == 2
    link.backlogs.commit()
    link.restart()
    assert link.backlog.next(link.backlogs.time) is None
    link.backlogs.turn()
    assert link.woken == 3
    assert link.backlog.next(link.backlogs.time) is not None


def test_rows_of_another_version_are_removed() -> None:
    link = Link()
    link.backlogs.latest_records.put(None, b"")
    link.backlogs.latest_records.put(None, b"Lnonsense")
    link.backlogs.latest_records.put(None, b"N[1]")
    link.backlogs.aside_records.put(None, b"nonsense")
    link.backlogs.commit()
    link.restart()
    assert not link.backlogs.latest_records.rows and not link.backlogs.aside_records.rows
    link.offer("1")
    assert link.drain() == ["1"]


@pytest.mark.parametrize("when_full", ["drop-oldest", "refuse"])
def test_the_latest_of_more_topics_than_memory_has_room_for(when_full: str) -> None:
    link = Link(rule(keep="latest"), online=False, when_full=when_full)
    topics = [f"t{number}" for number in range(12)]
    for turn in range(4):
        for topic in topics:
            assert link.offer(f"{topic} {turn}".ljust(500_000), topic) is None
        link.backlogs.commit()
    # What a newer one has replaced does not stay on disk: of 24 MB the latest 6, and what is read.
    assert link.counts().bytes < 14_000_000
    sent = [each.rstrip() for each in link.drain()]
    assert sorted(sent) == sorted(f"{topic} 3" for topic in topics)
    assert link.dropped() == {"replaced": 36}
    assert link.counts().waiting == link.counts().bytes == 0
    # It is over: the next ones wait in memory again.
    link.offer("a", "t0")
    link.offer("b", "t0")
    assert link.drain() == ["b"]


def test_refuse_refuses_the_latest_and_drops_none() -> None:
    link = Link(rule(keep="latest"), online=False, size=5_000_000, when_full="refuse")
    found = [link.offer("x".ljust(500_000), f"t{number}") for number in range(12)]
    assert found[:9] == [None] * 9
    assert all(str(each).endswith("is full") for each in found[9:]) and len(found[9:]) == 3
    assert len(link.drain()) == 9


def test_after_a_restart_the_latest_does_not_overtake_an_older_one() -> None:
    link = Link(rule(keep="latest"), online=False)
    for number in range(12):
        link.offer(f"old {number}".ljust(500_000), f"t{number}")
    link.backlogs.commit()
    link.restart()
    for number in range(12):
        link.offer(f"new {number}", f"t{number}")
    sent = [each.rstrip() for each in link.drain()]
    for number in range(12):
        of_topic = [each for each in sent if each.split()[1] == str(number)]
        assert of_topic in ([f"new {number}"], [f"old {number}", f"new {number}"])


def test_what_is_too_large_for_now_waits_for_a_connection_that_takes_it() -> None:
    link = Link(rule(), rule("l", keep="latest"))

    def visit(limit: int) -> list[str]:
        """Send what is not longer than `limit`, on a connection that takes no more."""
        link.backlog.connected(limit)
        sent: list[str] = []
        while (entry := link.next()) is not None:
            name = entry.record.payload.decode()
            if len(name) > limit and link.backlog.hold(entry, limit, link.backlogs.time):
                continue
            assert len(name) <= limit
            sent.append(name.rstrip())
            link.backlog.settle(entry)
        link.backlog.rewind()
        link.backlogs.commit()
        return sent

    large = [str(number).ljust(200 + number % 2 * 1000) for number in range(3000)]
    for name in large:
        link.offer(name)
        link.offer("small")
    assert visit(100) == ["small"] * 3000
    assert (link.counts().held, link.counts().waiting) == (3000, 3000)
    link.offer("more")
    assert visit(100) == ["more"]  # they are not tried again
    assert visit(500) == [str(number) for number in range(0, 3000, 2)]
    assert visit(500) == []
    link.restart()
    assert link.counts().held == 1500
    assert visit(500) == []
    assert visit(5000) == [str(number) for number in range(1, 3000, 2)]
    assert link.counts().waiting == 0 and not link.dropped()
    link.offer("x", of=1)  # of which only the latest counts
    link.backlog.connected(0)
    entry = link.next()
    assert entry is not None and not link.backlog.hold(entry, 0, link.backlogs.time)


def test_what_was_held_and_in_flight_is_sent_again_on_a_connection_that_takes_no_more() -> None:
    link = Link()
    link.backlog.connected(10)
    link.offer("x" * 50)
    entry = link.next()
    assert entry is not None and link.backlog.hold(entry, 10, link.backlogs.time)
    assert link.next() is None
    link.backlog.rewind()
    for _ in range(2):
        link.backlog.connected(100)
        again = link.next()
        assert again is not None and link.next() is None
        link.backlog.rewind()


@pytest.mark.parametrize("is_journalled", [False, True])
def test_what_was_put_off_and_then_was_too_large_is_sent_where_it_fits(is_journalled: bool) -> None:
    """It was stored by itself when the fleet had no room; what was so may be in a journal, too."""
    link = Link()
    link.offer("first")
    link.offer("large")
    first, large = link.take(2)
    link.backlog.retry_later(large, link.backlogs.time)
    if not is_journalled:
        link.backlog.settle(first)
    link.backlogs.commit()
    link.restart()
    entry = link.next()
    assert entry is not None and entry.record.payload == b"large"
    assert link.backlog.hold(entry, 10, link.backlogs.time)
    link.backlog.rewind()
    link.backlog.connected(1 << 20)
    assert sorted(link.drain()) == ["first", "large"][not is_journalled :]
    assert not link.dropped() and link.counts().waiting == 0


@pytest.mark.parametrize("is_held_again", [False, True])
def test_what_is_held_and_in_its_journal_after_a_restart_counts_once(is_held_again: bool) -> None:
    """It was settled there out of order, which is not stored."""
    link = Link()
    for payload in ("first", "large", "last"):
        link.offer(payload)
    _, large = link.take(2)
    assert link.backlog.hold(large, 10, link.backlogs.time)
    link.backlogs.commit()
    link.restart()
    assert link.counts().waiting == 4
    if is_held_again:
        link.backlog.rewind()
        link.backlog.connected(10)
        for entry in link.take():
            if entry.record.payload == b"large":
                assert link.backlog.hold(entry, 10, link.backlogs.time)
        link.backlog.rewind()
        link.backlog.connected(1 << 20)
    entries = link.take()
    assert sorted(entry.record.payload for entry in entries) == [b"first", b"large", b"last"]
    for entry in entries:
        link.backlog.settle(entry)
    assert link.next() is None
    counts = link.counts()
    assert (counts.waiting, counts.in_flight, counts.bytes) == (0, 0, 0)
    assert counts.restored == counts.sent == 3


@pytest.mark.parametrize("restarts", [False, True])
def test_what_is_held_is_the_first_to_be_dropped(restarts: bool) -> None:
    """Of a rule of normal priority: what cannot be sent now goes before what can."""
    link = Link(rule("a"), rule("b"), size=4000)
    waiting = ["y" * 600] * 6
    link.offer(waiting[0])
    link.offer("x" * 500, of=1)
    _, entry = link.take(2)
    assert link.backlog.hold(entry, 10, link.backlogs.time)
    link.backlog.rewind()
    link.backlogs.commit()
    if restarts:
        link.restart()
    for payload in waiting[1:]:
        link.offer(payload)
    assert link.counts().held == 0 and link.dropped() == {"full": 1}
    assert link.drain() == waiting


def test_many_at_once_leave_out_what_was_replaced_or_is_held() -> None:
    link = Link(rule(keep="latest"), online=False)
    for number in range(12):
        link.offer("x".ljust(500_000), f"big{number}")
    link.drain()  # what is in memory
    for number in range(12):
        link.offer("x".ljust(500_000), f"big{number}")
    for text in ("old", "new"):
        link.offer(text, "t")
    found: list[str] = []
    while entries := link.backlog.take(link.backlogs.time, 100, 1 << 30) or link.take(1):
        for entry in entries:
            found.append(entry.record.payload.decode().rstrip())
            link.backlog.settle(entry)
    assert [each for each in found if each != "x"] == ["new"]


def test_what_too_many_are_too_large_for_is_not_kept() -> None:
    """Such messages do not fill the backlog: the others have room."""
    link = Link(size=40_000, when_full="refuse")
    link.backlog.connected(100)
    held = 0
    for _ in range(100):
        assert link.offer("x" * 900) is None
        entry = link.next()
        assert entry is not None
        if link.backlog.hold(entry, 100, link.backlogs.time):
            held += 1
        else:
            link.backlog.set_aside(entry, "too large", link.backlogs.time)
    assert held == link.counts().held == 10
    assert link.counts().set_aside == 90


def test_what_is_too_large_is_tried_on_each_connection_that_takes_more() -> None:
    link = Link(online=False)

    def visit(limit: int, most: int = 100) -> list[int]:
        link.backlog.connected(limit)
        sent: list[int] = []
        while most and (entry := link.next()) is not None:
            most -= 1
            size = len(entry.record.payload)
            if size > limit:
                assert link.backlog.hold(entry, limit, link.backlogs.time)
            else:
                sent.append(size)
                link.backlog.settle(entry)
        link.backlog.rewind()
        return sent

    link.offer("x" * 3000)
    assert visit(2000) == []
    link.offer("x" * 600)
    assert visit(500) == []  # another server
    assert visit(2000) == [600]
    assert visit(2000) == [] and link.counts().held == 1
    link.offer("x" * 600)
    link.offer("x" * 700)
    assert visit(500) == []
    assert visit(1000, most=2) == [600]  # the connection ends before all were tried
    assert visit(1000) == [700]
    assert visit(3000) == [3000]


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("topics", [1, 20_000])
def test_states_do_not_drop_events(restarted: bool, topics: int) -> None:
    """Of one rule, while the link is down: of the states one a topic waits."""
    size = 1 << 20 if topics == 1 else 24 << 20
    link = Link(online=False, size=size)
    link.offer("0", "event")
    link.backlogs.commit()
    if restarted:
        link.restart()
        link.backlog.rewind()
    for number in range(2 * topics + 20_000):
        retain = number % 4 == 0
        link.offer(f"{number}".ljust(200), f"state/{number % topics}", retain, retain=retain)
        if number % 100 == 0:
            link.offer(f"{number}", "event")
        if number % 5000 == 0:
            link.backlogs.commit()
    events = 1 + len(range(0, 2 * topics + 20_000, 100))
    assert set(link.dropped()) == {"replaced"}
    assert link.counts().waiting == topics + events
    link.backlog.connected()
    sent: list[tuple[str, str]] = []
    while (entry := link.next()) is not None:
        sent.append((entry.record.topic, entry.record.payload.decode().rstrip()))
        link.backlog.settle(entry)
    assert len([text for topic, text in sent if topic == "event"]) == events
    if topics > 1:
        last = {topic: int(text) for topic, text in sent}
        del last["event"]
        assert sorted(last.values()) == list(range(topics + 20_000, 2 * topics + 20_000))


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("qos", [0, 1])
def test_what_memory_had_no_room_for_does_not_come_back_after_a_newer_one(
    restarted: bool, qos: int
) -> None:
    link = Link(rule(keep="latest"), online=False)
    for number in range(12):
        link.offer("x".ljust(500_000), f"big{number}", qos)
    link.offer("old".ljust(500_000), "t", qos)
    link.backlogs.commit()
    if restarted:
        link.restart()
    link.backlog.connected()
    flying = link.take()
    for entry in flying:
        if entry.record.topic != "t":
            link.backlog.settle(entry)
    flying += link.take()
    assert "t" in [entry.record.topic for entry in flying]
    link.offer("new", "t", qos)
    link.backlog.rewind()
    link.backlog.connected()
    assert [each for each in link.drain() if each[0] != "x"] == ["new"]
    assert not link.backlogs.single_records.rows


def test_more_topics_than_there_is_memory_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest of the lowest lane go, of all rules of the link; or the publisher is told."""
    monkeypatch.setattr(live_messages, "LATEST_SIZE", 5_000)
    monkeypatch.setattr(live_messages, "TOPICS_SIZE", 10_000)
    rules = rule(keep="latest"), rule("b", keep="latest"), rule("h", "latest", "high")
    link = Link(*rules, online=False)
    for number in range(100):
        link.offer(f"{number}", f"t{number}", of=number % 2)
    link.offer("high", "high", of=2)
    waiting = link.counts().waiting
    assert 15 < waiting < 30 and link.dropped() == {"full": 101 - waiting}
    assert link.backlog.work >= DROP_COST * (101 - waiting)
    expected = {"high", *(f"{number}" for number in range(101 - waiting, 100))}
    assert set(link.drain()) == expected
    link = Link(*rules, online=False, when_full="refuse")
    told = [link.offer(f"{number}", f"t{number}", of=number % 2) for number in range(100)]
    assert told.index(next(each for each in told if each)) == waiting
    assert link.counts().waiting == waiting


@pytest.mark.parametrize("scarce", ["size", "topics", "memory"])
def test_the_states_of_one_user_do_not_take_away_those_of_others(
    monkeypatch: pytest.MonkeyPatch, scarce: str
) -> None:
    limits = {"size": 1 << 28}
    if scarce == "size":
        limits["size"] = 1_000_000
    elif scarce == "topics":
        monkeypatch.setattr(live_messages, "LATEST_SIZE", 5_000)
        monkeypatch.setattr(live_messages, "TOPICS_SIZE", 100_000)
    rules = rule(keep="latest"), rule("b", keep="latest"), rule("all", keep="all")
    link = Link(*rules, online=False, **limits)
    small, large = "s".ljust(1000), "l".ljust(10_000 if scarce == "size" else 100_000)
    if scarce == "topics":
        small, large = "s", "l"

    def state(number: int, user: str | None, *, of: int = 0) -> None:
        link.offer(small, f"{user}/{number}", qos=number % 2, of=of, user=user)

    for number in range(10):
        state(number, "alice", of=number % 2)
        state(number, None)
    for number in range(10):
        link.offer(small, f"all {number}", of=2, user="alice")
    for number in range(500):
        link.offer(large, f"flood/{number}", qos=0, of=number % 2, user="mallory")
    if scarce == "memory":
        link.backlogs.unwritten = UNWRITTEN_SIZE[0]  # and what is for the disk has no room
    for number in range(10):
        state(number, "bob", of=number % 2)
        state(number, "alice", of=number % 2)
    link.backlogs.unwritten = 0
    link.backlog.connected()
    sent: Counter[str] = Counter()
    while found := link.take(100):
        for entry in found:
            sent[entry.record.topic.partition("/")[0].partition(" ")[0]] += 1
            link.backlog.settle(entry)
    flood = sent.pop("flood")
    assert sent == {"alice": 10, "None": 10, "all": 10, "bob": 10}
    assert flood > 20 and (scarce == "memory" or flood < 400)
    assert not link.backlog._live._shares.largest() and link.counts().waiting == 0


def test_a_user_alone_may_take_all_the_room_and_the_one_with_more_yields() -> None:
    link = Link(rule(keep="latest"), online=False, size=1_000_000)
    for number in range(99):
        link.offer("x".ljust(9_900), f"a/{number}", user="a")
    assert link.dropped() == {}
    for number in range(30):
        link.offer("x".ljust(9_900), f"b/{number}", user="b")
    link.backlog.connected()
    left = Counter(entry.record.topic[0] for entry in link.take(1000))
    assert left == {"a": 70, "b": 30}


def test_a_value_that_cannot_be_read_is_read_again_and_a_damaged_one_is_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    link = Link(rule(keep="latest"), online=False)
    for number in range(8):
        link.offer(f"{number}".ljust(900_000), f"t{number}")
    assert len(link.backlogs.single_records.rows) == 5
    link.backlogs.failures.extend([OSError("disk"), RecordsLostError("damaged")])
    link.backlog.connected()
    sent = link.drain()
    assert len(sent) == 3
    due = link.backlog.due(link.backlogs.time)
    assert due is not None
    link.backlogs.time = due
    sent += link.drain()
    assert len(sent) == 7 and link.dropped() == {"unreadable": 1}
    assert "cannot be read: disk" in caplog.text
    assert not link.backlogs.single_records.rows
