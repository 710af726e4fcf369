"""Random operations on a backlog, against a naive one: a list a rule."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import pytest

from appliance.upstream import backlog as module
from appliance.upstream import eviction, live_messages, read_ahead
from appliance.upstream.backlog_counts import DropReason
from appliance.upstream.rule_queue import ENTRY_OVERHEAD, GONE, Entry
from appliance.upstream.rules import OutRule
from upstream.plain_backlogs import PlainBacklogs
from upstream.test_backlog import Link, rule

MIXED = (
    rule("a"),
    rule("b", priority="high"),
    rule("c", keep="latest"),
    rule("d", keep="none", priority="high"),
    rule("e", keep="all", priority="low", rate=50.0),
    rule("f", priority="low"),
)

#: Each has one kind, so that it is known which of its messages is the oldest.
PLAIN = (
    rule("a", keep="all"),
    rule("b", keep="all", priority="high"),
    rule("c", keep="latest"),
    rule("d", keep="all", priority="low"),
    rule("e", keep="latest", priority="low"),
    rule("f", keep="all", priority="low"),
)


@dataclass(eq=False)
class Sent:
    """A message, as the twin knows it."""

    name: str
    of: int
    topic: str
    kind: str
    qos: int
    retain: bool
    at: float
    size: int = 0
    expires_at: float | None = None
    is_stored: bool = False
    retried: bool = False


@dataclass
class Waiting:
    """What the twin knows of a rule."""

    again: list[Sent] = field(default_factory=list)
    all: list[Sent] = field(default_factory=list)
    latest: dict[str, Sent] = field(default_factory=dict)
    live: list[Sent] = field(default_factory=list)

    def first(self) -> list[Sent]:
        """Those that may be next."""
        found = (self.again or self.all)[:1] + self.live[:1]
        return found + list(self.latest.values())[:1]

    def every(self) -> list[Sent]:
        return self.again + self.all + self.live + list(self.latest.values())


class Twin:
    """A backlog and its naive twin, which does the same and looks at each step."""

    def __init__(self, seed: int, rules: tuple[OutRule, ...], **limits: object) -> None:
        self.choose = random.Random(seed)
        self.rules = rules
        self.link = Link(*rules, backlogs=PlainBacklogs(self.choose.choice([200, 1000])), **limits)
        self.waiting = [Waiting() for _ in rules]
        self.flying: dict[Entry, Sent] = {}
        self.later: dict[Entry, Sent] = {}
        self.online = True
        self.serial = 0
        #: Spaces behind what is sent; and whether what a message displaces goes in pieces.
        self.padding = [0, 0, 10, 100]
        self.in_pieces = False
        self.owed = 0
        #: Values that memory had no room for.
        self.on_disk = 0
        self.seen_drops: dict[tuple[str, DropReason], int] = {}
        #: By rule and topic: the newest message handed out that counts as the latest one.
        self.newest: dict[tuple[int, str], int] = {}
        #: What a kill may bring back: since the last commit, settled or dropped.
        self.revived: set[str] = set()
        #: What a kill does not lose.
        self.committed: set[str] = set()

    @property
    def now(self) -> float:
        return self.link.backlogs.time

    # --- operations -----------------------------------------------------------------------------

    def offer(self) -> None:
        choose = self.choose
        of = choose.randrange(len(self.rules))
        qos = choose.randrange(3)
        retain = choose.random() < 0.2
        self.serial += 1
        name = f"{self.serial}" + " " * choose.choice(self.padding)
        topic = f"{self.rules[of].topic}/{choose.randrange(4)}"
        keep = self.rules[of].keep
        kind = keep if keep != "auto" else "latest" if retain or not qos else "all"
        expires = choose.choice([None, None, None, 0.3, 5.0])
        waiting = self.waiting[of]
        sent = Sent(name, of, topic, kind, qos, retain, self.now)
        sent.expires_at = None if expires is None else self.now + expires
        if kind == "none" and not self.online:
            assert self.link.offer(name, topic, qos, of=of, retain=retain) is None
            self.expect(of, DropReason.OFFLINE)
            return
        self.link.offer(name, topic, qos, of=of, retain=retain, expires_in=expires)
        self.take_drops(but=sent)
        if sent.size < 0:
            return
        if kind == "all":
            waiting.all.append(sent)
            sent.is_stored = True
        elif kind == "latest":
            before = waiting.latest.get(topic)
            unsettled = [each for each in self.unsettled(of) if each.kind == "latest"]
            unsettled = [each for each in unsettled if each.topic == topic]
            sent.is_stored = qos > 0 or retain
            if before is not None:
                self.expect(of, DropReason.REPLACED)
                sent.is_stored |= before.is_stored
            elif unsettled:
                newest = unsettled[-1]
                sent.is_stored |= newest.is_stored
                newest.is_stored = False
                if newest in waiting.again:
                    waiting.again.remove(newest)
                    self.expect(of, DropReason.REPLACED)
                for entry in [each for each, value in self.later.items() if value is newest]:
                    del self.later[entry]
                    self.expect(of, DropReason.REPLACED)
            waiting.latest[topic] = sent
            value = self.link.backlog._queues.by_name[self.rules[of].local_filter].latest.get(topic)
            assert value is not None and (value.key is not None or not sent.is_stored)
            sent.is_stored = value.key is not None  # also where memory has no room for it
            self.on_disk += value.single is not None
        else:
            waiting.live.append(sent)
        self.owed += self.link.backlog.is_owing
        while self.link.backlog.is_owing and choose.random() < 0.9:
            self.link.backlog.drop_more()
        self.take_drops()

    def unsettled(self, of: int) -> list[Sent]:
        """What was handed out of a rule, in the order of its publication."""
        found = [*self.flying.values(), *self.later.values(), *self.waiting[of].again]
        return sorted((each for each in found if each.of == of), key=lambda each: int(each.name))

    def next(self) -> None:
        entry = self.link.next()
        if entry is None:
            self.take_drops()
            ready = [each for each in self.waiting if each.first()]
            limited = {"e"} | {
                each.topic
                for of, each in enumerate(self.rules)
                if self.flying or self.is_refused(of)
            }
            assert all(
                self.rules[self.waiting.index(each)].topic in limited or self.is_outdated(each)
                for each in ready
            ), ready
            return
        name = entry.record.payload.decode()
        sent = next((each for each in self.later.values() if each.name == name), None)
        if sent is not None:
            del self.later[entry]
            self.take_drops()
        else:
            of = [each.local_filter for each in self.rules].index(entry.record.rule)
            waiting = self.waiting[of]
            self.take_drops()
            heads = {each.name: each for each in [*waiting.first(), *waiting.latest.values()]}
            if self.is_refused(of):
                heads = {each.name: each for each in waiting.again[:1]}
            assert name in heads, (name, heads)
            sent = heads[name]
            for queue in (waiting.again, waiting.all, waiting.live):
                if queue[:1] == [sent]:
                    del queue[0]
            if waiting.latest.get(sent.topic) is sent:
                del waiting.latest[sent.topic]
            for each in (*waiting.again, *waiting.all, *waiting.latest.values()):
                if each.topic == sent.topic and each.qos and sent.qos and not each.retried:
                    assert int(each.name) > int(sent.name), "an older one of its topic waits"
        if sent.kind == "latest":
            # Whatever came in between: nothing follows that is older than what was sent.
            assert int(sent.name) >= self.newest.get((sent.of, sent.topic), 0)
            assert entry.qos == (1 if sent.retain else min(1, sent.qos))
        record = entry.record
        assert (record.topic, record.qos, record.retain) == (sent.topic, sent.qos, sent.retain)
        assert record.expires_at == sent.expires_at
        assert sent.expires_at is None or sent.expires_at > self.now
        self.flying[entry] = sent
        if sent.kind == "latest":
            key = sent.of, sent.topic
            self.newest[key] = max(self.newest.get(key, 0), int(sent.name))

    def is_refused(self, of: int) -> bool:
        """Whether so many of a rule are to be tried again that no new one is sent."""
        return sum(each.of == of for each in self.later.values()) >= module.MOST_LATER

    def is_outdated(self, waiting: Waiting) -> bool:
        return all(each.expires_at is not None for each in waiting.first())

    def settle(self) -> None:
        if self.flying:
            entry = self.choose.choice(list(self.flying))
            sent = self.flying.pop(entry)
            self.revived.add(sent.name)
            self.link.backlog.settle(entry)

    def retry(self) -> None:
        if self.flying and len(self.later) < 10:
            entry = self.choose.choice(list(self.flying))
            sent = self.flying.pop(entry)
            self.link.backlog.retry_later(entry, self.now)
            if sent.kind == "latest" and self.is_replaced(sent):
                self.expect(sent.of, DropReason.REPLACED)
            else:
                sent.retried = True
                self.later[entry] = sent

    def is_replaced(self, sent: Sent) -> bool:
        newest = self.newest.get((sent.of, sent.topic), 0)
        return int(sent.name) < newest or sent.topic in self.waiting[sent.of].latest

    def aside(self) -> None:
        if self.flying:
            entry = self.choose.choice(list(self.flying))
            sent = self.flying.pop(entry)
            self.revived.add(sent.name)
            self.link.backlog.set_aside(entry, "poison", self.now)

    def rewind(self) -> None:
        self.online = False
        before: dict[int, list[Sent]] = {}
        flying = list(self.flying.values())
        for sent in flying:
            if sent.kind == "none":
                self.expect(sent.of, DropReason.OFFLINE)
            elif sent.kind == "latest" and self.is_replaced(sent):
                self.expect(sent.of, DropReason.REPLACED)
            else:
                before.setdefault(sent.of, []).append(sent)
        self.flying.clear()
        for entry, sent in list(self.later.items()):
            if sent.kind == "none":
                del self.later[entry]
                self.expect(sent.of, DropReason.OFFLINE)
        for of, found in before.items():
            self.waiting[of].again[:0] = found
        for of, waiting in enumerate(self.waiting):
            for _ in waiting.live:
                self.expect(of, DropReason.OFFLINE)
            waiting.live.clear()
        self.link.backlog.rewind()

    def connect(self) -> None:
        self.online = True
        self.link.backlog.connected()

    def commit(self) -> None:
        self.link.backlogs.commit()
        self.revived.clear()
        self.committed = {each.name for each in self.every() if each.is_stored}

    def restart(self) -> None:
        """The appliance stops in peace. What was handed out is settled: otherwise it is repeated
        with what was settled behind it."""
        if self.later or any(waiting.again for waiting in self.waiting):
            return
        while self.flying:
            self.settle()
        self.commit()
        self.link.restart()
        self.online = True
        self.seen_drops.clear()
        for waiting in self.waiting:
            waiting.live.clear()
            kept = [each for each in waiting.latest.values() if each.is_stored]
            kept.sort(key=lambda each: int(each.name))
            waiting.latest = {each.topic: each for each in kept}

    def merge(self) -> None:
        for journal in self.link.backlogs.journals.values():
            journal.merge()

    def wait(self) -> None:
        self.link.backlogs.time += self.choose.choice([0.01, 0.1, 1.0])
        self.link.backlog.tick(self.now)
        self.take_drops()

    # --- drops ----------------------------------------------------------------------------------

    def expect(self, of: int, reason: DropReason) -> None:
        """One more is dropped."""
        key = self.rules[of].local_filter, reason
        self.seen_drops[key] = self.seen_drops.get(key, 0) + 1

    def take_drops(self, but: Sent | None = None) -> None:
        """Follow what the backlog has dropped by itself: the oldest, or what has expired."""
        dropped = self.link.backlog.counts().dropped
        full_rules = [of for of in range(len(self.rules)) if self.unseen(of, DropReason.FULL)]
        for of, each in enumerate(self.rules):
            outdated = self.unseen(of, DropReason.EXPIRED) + self.unseen(of, DropReason.AGE)
            full = self.unseen(of, DropReason.FULL)
            while outdated or full:
                queue = self.waiting[of]
                if outdated and (found := self.outdated(of)) is not None:
                    self.remove(of, found)
                    outdated -= 1
                    continue
                assert full, (queue, dropped)
                full -= 1
                if queue.first():
                    self.remove(of, min(queue.first(), key=lambda each: each.at))
                else:
                    assert but is not None and but.of == of
                    but.size = -1
            for reason in (DropReason.EXPIRED, DropReason.AGE, DropReason.FULL):
                key = each.local_filter, reason
                self.seen_drops[key] = dropped[key]
        for of in full_rules:
            self.check_lower(of)

    def unseen(self, of: int, reason: DropReason) -> int:
        key = self.rules[of].local_filter, reason
        return self.link.backlog.counts().dropped[key] - self.seen_drops.get(key, 0)

    def check_lower(self, of: int) -> None:
        """Nothing less urgent was left when this one was dropped."""
        lane = self.rules[of].lane
        for other, each in zip(self.rules, self.waiting, strict=True):
            assert other.lane <= lane or not each.every(), (other, each)

    def outdated(self, of: int) -> Sent | None:
        """One that has expired: a latest one that is not there any more, or one at a front."""
        queue = self.waiting[of]
        there = self.link.backlog._queues.by_name[self.rules[of].local_filter].latest
        found = [each for topic, each in queue.latest.items() if topic not in there]
        found += [each for entry, each in self.later.items() if entry.state == GONE]
        found += (queue.again or queue.all)[:1] + queue.live[:1]
        for each in found:
            if each.of == of and each.expires_at is not None and each.expires_at <= self.now:
                return each
        return None

    def remove(self, of: int, sent: Sent) -> None:
        queue = self.waiting[of]
        self.revived.add(sent.name)
        for waiting in (queue.again, queue.all, queue.live):
            if sent in waiting:
                waiting.remove(sent)
        if queue.latest.get(sent.topic) is sent:
            del queue.latest[sent.topic]
        for entry in [each for each, value in self.later.items() if value is sent]:
            del self.later[entry]

    def every(self) -> list[Sent]:
        return [
            *self.flying.values(),
            *self.later.values(),
            *(sent for waiting in self.waiting for sent in waiting.every()),
        ]

    def check(self) -> None:
        counts = self.link.counts()
        assert counts.waiting == len(self.every())
        assert counts.in_flight == len(self.flying)
        seen = {key: number for key, number in self.seen_drops.items() if number}
        assert dict(counts.dropped) == seen
        assert counts.bytes <= self.link.limits.size * (2 if self.in_pieces else 1)

    # --- the ends -------------------------------------------------------------------------------

    def drain(self) -> None:
        """All that waits is sent, in the order of each rule."""
        self.connect()
        while self.link.counts().waiting:
            self.next()
            while self.flying:
                self.settle()
            self.link.backlogs.time += 0.05
            self.check()
        self.commit()
        assert not any(journal.list for journal in self.link.backlogs.journals.values())
        rows = self.link.backlogs.latest_records.rows.values()
        assert [row for row in rows if row[:1] != b"N"] == []
        assert not self.link.backlogs.single_records.rows

    def kill(self) -> None:
        """What was committed is there, in order; nothing else but what a commit did not take."""
        alive = {each.name: each for each in self.every() if each.is_stored}
        topics: dict[tuple[int, str], list[str]] = {}
        for each in alive.values():
            topics.setdefault((each.of, each.topic), []).append(each.name)
        self.link.restart()
        found: list[str] = []
        while self.link.counts().waiting:
            found += self.link.drain()
            self.link.backlogs.time += 0.05
        assert len(set(found)) == len(found)
        missing = self.committed - set(found) - self.revived
        for name in missing:
            each = alive.get(name)
            expired = each is None or (each.expires_at is not None)
            assert expired, (name, each)


OPERATIONS = ["offer"] * 12 + ["next"] * 10 + ["settle"] * 8 + ["commit", "merge", "rewind"]
OPERATIONS += ["connect", "connect", "wait", "retry", "aside", "restart", "restart"]


@pytest.fixture
def little_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of what waits is only on disk."""
    monkeypatch.setattr(read_ahead, "LOADED_SIZE", 1500)
    monkeypatch.setattr(read_ahead, "LOADED_SHARE", 300)
    monkeypatch.setattr(live_messages, "LATEST_SIZE", 1200)
    monkeypatch.setattr(live_messages, "VALUES_SIZE", 300)


def _compare(twin: Twin, seed: int, operations: list[str]) -> None:
    for _ in range(300):
        operation = twin.choose.choice(operations)
        if operation != "next" or twin.online:
            getattr(twin, operation)()
            twin.check()
    assert twin.on_disk
    if seed % 2:
        twin.drain()
    else:
        twin.kill()


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("seed", range(20))
def test_like_a_list(seed: int) -> None:
    _compare(Twin(seed, MIXED), seed, OPERATIONS)


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("seed", range(20))
def test_like_a_full_list(seed: int) -> None:
    _compare(Twin(seed, PLAIN, size=4_000), seed, OPERATIONS + ["offer"] * 10)


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("seed", range(20))
def test_like_a_full_list_of_which_little_is_dropped_at_once(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eviction, "MOST_AT_ONCE", 7)
    monkeypatch.setattr(eviction, "OWED_SHARE", 1.0)
    twin = Twin(seed, PLAIN, size=8_000)
    twin.padding, twin.in_pieces = [0, 0, 10, 100, 3_000], True
    _compare(twin, seed, OPERATIONS + ["offer"] * 10)
    assert twin.owed


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("seed", range(10))
def test_like_a_list_of_which_much_is_refused(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rule with many that are to be tried again waits, and no other does."""
    monkeypatch.setattr(module, "MOST_LATER", 2)
    monkeypatch.setattr(read_ahead, "MOST_LATER", 2)
    _compare(Twin(seed, MIXED), seed, OPERATIONS + ["retry"] * 8)


@pytest.mark.parametrize("seed", range(20))
def test_what_is_too_large_for_one_server_goes_to_another(seed: int) -> None:
    """On a connection that is not cut short all that is not too large for it is sent."""
    choose = random.Random(seed)
    link = Link(rule("a"), rule("b", priority="low"), online=False)
    waiting: list[int] = []
    for _ in range(100):
        for _ in range(choose.randrange(4)):
            size = choose.randrange(1, 50)
            waiting.append(size)
            link.offer("x" * size, of=choose.randrange(2))
        if choose.random() < 0.1:
            link.backlogs.commit()
            link.restart()
        limit, left = choose.choice([5, 10, 20, 30, 40]), choose.choice([0, 3, 1000, 1000])
        link.backlog.connected(limit)
        while left and (entry := link.next()) is not None:
            left -= 1
            size = len(entry.record.payload)
            if size <= limit:
                waiting.remove(size)
                link.backlog.settle(entry)
            elif choose.random() < 0.9:
                assert link.backlog.hold(entry, limit, link.backlogs.time)
            else:
                left = 0  # the connection ends before
        link.backlog.rewind()
        if left:
            assert not waiting or min(waiting) > limit
        assert link.counts().waiting == len(waiting)
    link.backlog.connected(50)
    assert len(link.drain()) == len(waiting)


# Several at once, against one by one.

LANES = (rule("a"), rule("b", keep="all", priority="high"), rule("f", keep="all", priority="low"))


def _state(entry: Entry) -> tuple[object, ...]:
    told = (entry.qos, entry.expiry, entry.published_at, entry.attempts, entry.index, entry.size)
    return entry.record, told


class Pair:
    """Two backlogs with the same life, but that the second is asked for one message at a time."""

    def __init__(self, seed: int, rules: tuple[OutRule, ...], **limits: object) -> None:
        self.choose = random.Random(seed)
        self.rules = rules
        size = self.choose.choice([200, 1000, 100_000])
        self.links = [Link(*rules, backlogs=PlainBacklogs(size), **limits) for _ in range(2)]
        self.flying: list[tuple[Entry, Entry]] = []
        self.runs = 0

    def offer(self) -> None:
        choose = self.choose
        of, qos = choose.randrange(len(self.rules)), choose.choice([0, 1, 1, 1, 2])
        retain, expires = choose.random() < 0.05, choose.choice([None] * 8 + [0.3, 5.0])
        payload, topic = b"x" * choose.choice([0, 10, 100]), f"{choose.randrange(4)}"
        for _ in range(choose.choice([1, 1, 30])):
            for link in self.links:
                link.offer(payload, topic, qos, of=of, retain=retain, expires_in=expires)

    def take(self) -> None:
        fast, slow = self.links
        most, size = self.choose.randint(1, 40), self.choose.choice([1, 300, 1 << 30])
        while not (found := fast.backlog.take(fast.backlogs.time, most, size)):
            if not fast.backlogs.rounds:
                break
            fast.backlogs.turn()
        assert len(found) <= most
        assert sum(entry.size for entry in found[:-1]) < size
        self.runs += len(found) > 1
        for entry in found:
            other = slow.next()
            assert other is not None
            assert _state(entry) == _state(other)
            self.flying.append((entry, other))
        if not found:
            assert slow.next() is None

    def settle(self) -> None:
        count = self.choose.choice([1, 3, 20, 100])
        found, self.flying = self.flying[:count], self.flying[count:]
        if self.choose.random() < 0.1:
            self.choose.shuffle(found)
        self.links[0].backlog.settle_all([one for one, _ in found])
        for _, other in found:
            self.links[1].backlog.settle(other)

    def settle_again(self) -> None:
        for link, entry in zip(self.links, self.flying[0] if self.flying else (), strict=False):
            link.backlog.settle(entry)
        if self.flying:
            self.links[0].backlog.settle_all([self.flying.pop(0)[0]])

    def put_back(self) -> None:
        count = self.choose.randint(0, min(3, len(self.flying)))
        found = self.flying[len(self.flying) - count :]
        del self.flying[len(self.flying) - count :]
        for number, link in enumerate(self.links):
            link.backlog.put_back([each[number] for each in found])

    def retry(self) -> None:
        if self.flying:
            place = self.choose.randrange(len(self.flying))
            for link, entry in zip(self.links, self.flying.pop(place), strict=True):
                link.backlog.retry_later(entry, link.backlogs.time)

    def aside(self) -> None:
        if self.flying:
            for link, entry in zip(self.links, self.flying.pop(), strict=True):
                link.backlog.set_aside(entry, "poison", link.backlogs.time)

    def rewind(self) -> None:
        self.flying.clear()
        for link in self.links:
            link.backlog.rewind()
            link.backlog.connected()

    def wait(self) -> None:
        seconds = self.choose.choice([0.01, 0.1, 1.5])
        for link in self.links:
            link.backlogs.time += seconds
            link.backlog.tick(link.backlogs.time)

    def commit(self) -> None:
        for link in self.links:
            link.backlogs.commit()

    def check(self) -> None:
        fast, slow = (link.counts() for link in self.links)
        assert fast == slow
        assert fast.in_flight == len(self.flying)
        stored = [
            [
                [segment.done for segment in journal.list]
                for journal in link.backlogs.journals.values()
            ]
            for link in self.links
        ]
        assert stored[0] == stored[1]
        for each in (link.backlog for link in self.links):
            again = [entry for queue in each._queues.by_name.values() for entry in queue.again]
            again += list(each._retries)
            waiting = [entry.size + ENTRY_OVERHEAD for entry in again if entry.state != GONE]
            assert each._again_size == sum(waiting)
            later = list(each._retries)
            assert each._retries.size == sum(entry.size + ENTRY_OVERHEAD for entry in later)
            assert sum(queue.later for queue in each._queues.by_name.values()) == len(later)
        sizes = [
            (each._flying_size, each._again_size, each._live.memory)
            for each in (link.backlog for link in self.links)
        ]
        assert sizes[0] == sizes[1]


def _live(pair: Pair) -> None:
    names = ["offer"] * 4 + ["take"] * 8 + ["settle"] * 6 + ["wait", "commit"]
    rare = ["settle_again", "put_back", "retry", "aside", "rewind"]
    for _ in range(400):
        name = pair.choose.choice(rare if pair.choose.random() < 0.05 else names)
        getattr(pair, name)()
        pair.check()
    assert pair.runs > 1


@pytest.mark.parametrize("seed", range(10))
def test_several_at_once_are_those_that_come_one_by_one(seed: int) -> None:
    _live(Pair(seed, MIXED if seed % 2 else LANES))


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("seed", range(10))
def test_several_at_once_with_little_memory(seed: int) -> None:
    _live(Pair(seed, LANES, size=20_000, age=3.0))
