"""Shared subscriptions (5.0 section 4.8.2): connected, slow, absent and leaving members."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from time import thread_time

import pytest

from appliance.access import Acl
from appliance.broker import shared
from appliance.broker.broker import CHECKS_PER_COST_UNIT, Broker
from appliance.broker.counters import COST_PER_TURN
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.routing import CACHED_TOPIC
from appliance.broker.session import Session
from appliance.broker.shared import MAXIMUM_CHECKED, Share
from appliance.broker.values import Action, Decision, Identity
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Publish, Subscription
from appliance.store import MemoryStore

from .conftest import FakeAccess, Join, Peer, check_accounts, lasting


def publish(publisher, count: int, qos: int = 1) -> None:
    for number in range(count):
        publisher.publish("a", b"%d" % number, qos)


@pytest.mark.parametrize("qos", [0, 1, 2])
def test_members_take_turns(join: Join, version, qos):
    members = [join(f"m{n}", version=version) for n in range(3)]
    for member in members:
        assert member.subscribe("$share/g/a", qos) == qos
    publish(join("publisher"), 9, qos)
    heard = [[message.payload for message in member.drain()] for member in members]
    assert [len(payloads) for payloads in heard] == [3, 3, 3]
    assert sorted(payload for payloads in heard for payload in payloads) == [
        b"%d" % n for n in range(9)
    ]


def test_groups_and_plain_subscriptions_each_get_their_own(join: Join, broker: Broker):
    one, other, plain = join("one"), join("other"), join("plain")
    one.subscribe("$share/g/a/+")
    other.subscribe("$share/h/a/+")
    plain.subscribe("a/#")
    plain.subscribe("$share/g/a/+")
    assert broker.shared_subscription_count == 2
    publisher = join("publisher")
    for number in range(4):
        publisher.publish("a/b", b"%d" % number)
    assert len(other.payloads()) == 4
    # The plain subscription gets all, and half as a member of the group on top.
    assert len(one.payloads()) == 2 and len(plain.payloads()) == 6
    for member in (one, plain):
        member.unsubscribe("$share/g/a/+")
    assert broker.shared_subscription_count == 1


def test_a_member_that_is_slow_is_passed_over(join: Join):
    slow, fast = join("slow"), join("fast")
    for member in (slow, fast):
        member.subscribe("$share/g/a", 1)
    slow.slow()
    publish(join("publisher"), 6)
    assert len(fast.drain()) == 6
    slow.fast()
    assert slow.messages() == []


def test_a_member_that_does_not_acknowledge_is_passed_over(join: Join):
    silent = join("silent", properties={Property.RECEIVE_MAXIMUM: 1})
    busy = join("busy")
    for member in (silent, busy):
        member.subscribe("$share/g/a", 1)
    publisher = join("publisher")
    for number in range(6):
        publisher.publish("a", b"%d" % number, 1)
        busy.drain()
    assert len(silent.messages()) == 1


@pytest.mark.parametrize("qos", [1, 2])
def test_what_a_member_leaves_goes_to_the_others(join: Join, version, qos):
    """v5 [MQTT-4.8.2-4]: QoS 2 in flight stays with its member, whose session is kept"""
    leaving = join("leaving", version=version, **lasting(version))
    leaving.subscribe("$share/g/a", qos)
    publisher = join("publisher")
    publish(publisher, 25, qos)  # 20 are in flight, 5 wait
    sent = [message.payload for message in leaving.messages()]
    staying = join("staying")
    staying.subscribe("$share/g/a", qos)
    leaving.lose()
    taken = [message.payload for message in staying.drain()]
    back = join("leaving", version=version, **lasting(version))
    kept = [message.payload for message in back.drain()]
    if qos == 1:
        assert sorted(taken) == sorted(b"%d" % n for n in range(25)) and kept == []
    else:
        assert taken == [b"%d" % n for n in range(20, 25)] and kept == sent


def test_a_session_that_ends_leaves_its_messages_to_an_absent_member(join: Join):
    absent = join("absent", **lasting(5))
    absent.subscribe("$share/g/a", 1)
    absent.lose()
    leaving = join("leaving")
    leaving.subscribe("$share/g/a", 1)
    publish(join("publisher"), 3)
    assert len(leaving.messages()) == 3
    leaving.disconnect()
    assert len(join("absent", **lasting(5)).drain()) == 3


def test_unsubscribing_finishes_what_is_in_flight_and_leaves_the_rest(join: Join):
    """[MQTT-3.10.4-3]"""
    leaving = join("leaving", properties={Property.RECEIVE_MAXIMUM: 1})
    leaving.subscribe("$share/g/a", 1)
    publish(join("publisher"), 3)
    (first,) = leaving.messages()
    staying = join("staying")
    staying.subscribe("$share/g/a", 1)
    leaving.unsubscribe("$share/g/a")
    leaving.acknowledge(first)
    assert leaving.messages() == []
    assert [message.payload for message in staying.drain()] == [b"1", b"2"]


def test_an_absent_group_keeps_qos_1_and_not_qos_0(join: Join):
    member = join("member", **lasting(5))
    member.subscribe("$share/g/a", 1)
    member.lose()
    publisher = join("publisher")
    assert publisher.publish("a", b"kept", 1) == 0
    publisher.publish("a", b"gone", 0)
    assert [m.payload for m in join("member", **lasting(5)).drain()] == [b"kept"]


def test_members_without_the_right_to_read_get_nothing(join: Join, access: FakeAccess):
    access.deny("mallory", Action.RECEIVE, "a")
    eve, alice = join("eve", user="mallory"), join("alice")
    for member in (eve, alice):
        member.subscribe("$share/g/+", 1)
    publish(join("publisher"), 4)
    assert eve.messages() == [] and len(alice.drain()) == 4


def test_no_retained_messages_for_a_group(join: Join):
    join("publisher").publish("a", b"kept", 1, retain=True)
    member = join("member")
    member.subscribe("$share/g/a", 1)
    assert member.messages() == []


@pytest.mark.parametrize("limits", [Limits(queue_messages=2, inflight=2)])
@pytest.mark.parametrize("qos", [1, 2])
def test_a_group_without_room_is_told_to_the_publisher(join: Join, qos):
    members = [join(f"m{n}") for n in range(2)]
    for member in members:
        member.subscribe("$share/g/a", qos)
    publisher = join("publisher")
    codes = [publisher.publish("a", b"%d" % number, qos) for number in range(10)]
    assert codes == [0] * 8 + [0x97] * 2
    assert sum(len(member.drain()) for member in members) == 8


def _crowd(join: Join, count: int) -> list[Peer]:
    """So many members of one group that have one user."""
    crowd = [join(f"w{n}", user="fleet") for n in range(count)]
    for member in crowd:
        member.subscribe("$share/g/a/#", 1)
    return crowd


@pytest.mark.parametrize("topic", ["a/b", "a/" + 600 * "x"], ids=["short", "long"])
@pytest.mark.parametrize(("count", "reader"), [(100, 90), (600, 599), (600, 300), (600, 0)])
def test_a_message_finds_the_one_of_a_large_group_who_may_read_it(
    join: Join, broker: Broker, access: FakeAccess, count: int, reader: int, topic: str
):
    """One user, and rules by client id; the rules change meanwhile, and publishers."""
    crowd = _crowd(join, count)
    access.allow_only(f"w{reader}")
    publishers = [join("one"), join("two")]
    assert len(topic) > CACHED_TOPIC or topic == "a/b"
    for number in range(6):
        publisher = publishers[number % 2]
        for name in (topic, f"{topic}/{number}"):
            assert publisher.publish(name, b"%d" % number, 1) == 0
            publisher.go_on()
        if number % 3 == 1:
            access.epoch += 1
            broker.rules_changed()
    assert len(crowd[reader].drain()) == 12
    assert not any(member.drain() for member in crowd)


def test_who_may_read_from_now_on_is_found(join: Join, broker: Broker, access: FakeAccess):
    crowd = _crowd(join, 300)
    publisher = join("publisher")
    for reader in (0, 299, 150):
        access.allow_only(f"w{reader}")
        broker.rules_changed()
        publisher.publish("a/b", b"", 1)
        publisher.go_on()
        assert len(crowd[reader].drain()) == 1


@pytest.mark.parametrize("qos", [0, 1])
def test_a_message_finds_the_one_of_a_large_group_who_is_there(join: Join, qos: int):
    """Absent members are no receivers of QoS 0, be they ever so many."""
    for number in range(3 * MAXIMUM_CHECKED):
        absent = join(f"absent{number}", **lasting(5))
        absent.subscribe("$share/g/a", 0)
        absent.lose()
    here = join("here")
    here.subscribe("$share/g/a", qos)
    publish(join("publisher"), 5, 1)
    assert len(here.drain()) == 5


@pytest.mark.parametrize("limits", [Limits(queue_messages=1, inflight=1)])
def test_a_message_finds_the_one_of_a_large_group_who_has_room(join: Join):
    crowd = [join(f"m{number}") for number in range(2 * MAXIMUM_CHECKED)]
    for member in crowd:
        member.subscribe("$share/g/a", 1)
    publisher = join("publisher")
    room = 2 * len(crowd)
    codes = [publisher.publish("a", b"", 1) for _ in range(room + 1)]
    assert codes == [0] * room + [0x97]
    for member in (crowd[5], crowd[200]):
        member.drain()
        assert publisher.publish("a", b"", 1) == 0
        assert len(member.drain()) == 1


def test_who_has_the_rules_asked_about_many_members_waits_for_the_others(
    join: Join, broker: Broker, access: FakeAccess
):
    """Each is asked about once for a topic, and all of that is the publisher's cost."""
    count = 600
    assert count < COST_PER_TURN < 2 * count
    _crowd(join, count)
    access.allow_only("nobody")
    publisher = join("publisher")
    asked = _count_questions(access)
    cost = broker.counters.cost
    publisher.send(*(Publish(f"a/{topic}", b"", 0) for topic in "bcd"))
    for topic in "bcd":
        assert asked == {f"a/{topic}": count}, "one topic a turn"
        assert broker.counters.cost - cost >= 2 * count
        asked.clear()
        cost = broker.counters.cost
        publisher.go_on()
    publisher.send(Publish("a/b", b"again", 0))
    assert not asked


@pytest.mark.timed
@pytest.mark.parametrize("limits", [Limits(connections=20_000, sessions=20_000)])
@pytest.mark.parametrize("rules", ["", "pattern read a/%c/#"], ids=["no file", "file"])
def test_a_message_for_10_000_who_may_not_read_it_holds_nobody_up(
    join: Join, access: FakeAccess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rules: str
):
    """In seconds of this thread's CPU for one PUBLISH, of a topic that is kept and of one not."""
    _crowd(join, 10_000)
    access.allow_only("nobody")
    if rules:
        (tmp_path / "acl").write_text(f"pattern write #\n{rules}\n")
        monkeypatch.setattr(access, "decide", Acl.load(tmp_path / "acl", "robot").decide)
    publisher = join("publisher")
    asked = _count_questions(access)
    for topic in ("a/short", "a/" + 600 * "x"):
        took = []
        for number in range(5):
            begun = thread_time()
            publisher.send(Publish(f"{topic}/{number}", b"", 0))
            took.append(thread_time() - begun)
            publisher.go_on()
        assert asked.total() == 50_000
        asked.clear()
        print(f"{len(topic)} bytes: {[round(each * 1000) for each in took]} ms")
        assert median(took) < 0.25, took


def _count_questions(access: FakeAccess) -> Counter[str]:
    """How often the rules are asked who may receive a topic, from now on."""
    asked: Counter[str] = Counter()
    decide = access.decide

    def counted(identity: Identity, action: Action, topic: str) -> Decision:
        if action is Action.RECEIVE:
            asked[topic] += 1
        return decide(identity, action, topic)

    access.decide = counted  # type: ignore[method-assign]
    return asked


class _AsksAll:
    """The slow twin of what chooses who gets the messages that a member leaves."""

    def __init__(self, *, absent_too: bool) -> None:
        self.absent_too, self.checked = absent_too, 0

    def choose(self, share: Share, message: Message, may_receive: Callable[[Session, str], bool]):
        def may(session: Session, topic: str) -> bool:
            return (self.absent_too or session.link is not None) and may_receive(session, topic)

        return share.choose(share.targets(), message, may)


def _handed_over(seed: int) -> list[object]:
    """Who has which messages after members of groups have left again and again."""
    rng = random.Random(seed)
    access = FakeAccess()
    limits = Limits(
        queue_messages=rng.choice((4, 30)),
        queue_bytes=rng.choice((20_000, 60_000)),
        inflight=2,
        queue_full=rng.choice(("refuse", "drop-oldest")),
    )
    broker = Broker(access, MemoryStore(), limits)
    broker.tick(1.0)
    publisher = Peer(broker)
    publisher.connect("publisher")
    names = [f"m{number}" for number in range(rng.choice((2, 7, 40)))]
    for name in names:
        access.deny(name, Action.RECEIVE, f"a/{rng.randrange(6)}")
    # Sizes that differ by less than a quarter count as the same: see `Heirs`.
    sizes = rng.choice(((1,), (1, 4000), (1, 1500, 4000, 12_000)))
    peers: dict[str, Peer] = {}
    log: list[object] = []
    for _ in range(150):
        name = rng.choice(names)
        peer = peers.get(name)
        if peer is None:
            peer = peers[name] = Peer(broker)
            peer.connect(name, user=name, **lasting(5, rng.choice((0, 60))))
        match rng.randrange(10):
            case 0 | 1:
                for group in "gh":
                    wanted = Subscription(f"$share/{group}/a/#", rng.randint(0, 2))
                    broker.subscribe(peer.session, wanted)
            case 2:
                broker.unsubscribe(peer.session, f"$share/{rng.choice('gh')}/a/#")
            case 3:
                peers.pop(name).lose()
            case 4:
                rng.choice((peer.slow, peer.fast))()
            case 5:
                for packet_id, delivery in list(peer.session.inflight.items()):
                    if delivery is not None and delivery[1] == 1:
                        peer.session.puback(packet_id)
            case _:
                for _ in range(rng.choice((1, 20))):
                    message = Message(
                        f"a/{rng.randrange(6)}",
                        b"%d" % len(log) * rng.choice(sizes),
                        rng.randint(1, 2),
                    )
                    broker.publish(message, publisher.session)
                broker.flush()
        for each, session in broker.sessions.items():
            waiting = [d[0].payload for d in (*session.queue, *session.latest.values())]
            sent = [d and d[0].payload for d in session.inflight.values()]
            log.append((each, waiting, sent, session.bytes))
        log.append({name: share._next for name, share in broker.router.shares.items()})
    check_accounts(broker)
    assert not broker.faults.count
    return log


@pytest.mark.patches
@pytest.mark.parametrize("seed", range(12))
def test_what_a_member_leaves_goes_to_those_whom_the_slow_way_finds(
    monkeypatch: pytest.MonkeyPatch, seed: int
):
    quick = _handed_over(seed)
    monkeypatch.setattr("appliance.broker.broker.Heirs", _AsksAll)
    assert quick == _handed_over(seed)


@pytest.mark.patches
@pytest.mark.parametrize("limits", [Limits(queue_messages=100, inflight=1)])
@pytest.mark.parametrize("room", [False, True], ids=["full", "busy"])
@pytest.mark.parametrize("sizes", [[10], range(4000, 0, -40)], ids=["alike", "shrinking"])
def test_to_leave_takes_members_and_messages_and_not_their_product(
    join: Join, broker: Broker, monkeypatch: pytest.MonkeyPatch, sizes: Sequence[int], room: bool
):
    """Whether none of many members has room, or each has and can send nothing at once."""
    leaving = join("leaving")
    leaving.subscribe("$share/g/a", 1)
    publisher = join("publisher")
    messages = 100
    for number in range(messages + 1):
        size = sizes[number % len(sizes)]
        assert publisher.publish("a", bytes(size), 1) == 0
    members = [join(f"m{number}") for number in range(MAXIMUM_CHECKED)]
    for member in members:
        member.subscribe("$share/g/a", 1)
        for _ in range(1 if room else 101):
            member.session.deliver(Message("own", b"", 1), 1, False, None)
    looked = Counter[str]()
    rank = shared._rank

    def counted(session: Session, qos: int) -> int:
        looked["members"] += 1
        return rank(session, qos)

    monkeypatch.setattr(shared, "_rank", counted)
    begun = broker.counters.cost
    assert broker.unsubscribe(leaving.session, "$share/g/a") == 0
    assert len(leaving.session.queue) == (0 if room else messages)
    kinds = 1 if len(sizes) == 1 else 20  # sizes that are told apart
    assert looked["members"] <= 2 * kinds * len(members) + messages < len(members) * messages
    assert messages <= broker.counters.cost - begun <= 2 * messages + kinds * len(members)


def _leaver(join: Join, groups: int) -> Peer:
    """A client in so many groups, which has a message of each and has acknowledged none."""
    leaving = join("leaving", **lasting(5))
    for number in range(groups):
        leaving.subscribe(f"$share/g{number}/a", 1)
    assert join("publisher").publish("a", b"x", 1) == 0
    session = leaving.session
    assert len(session.queue) + len(session.inflight) == groups
    return leaving


@pytest.mark.patches
@pytest.mark.parametrize("qos", [0, 1, 2, None], ids=["0", "1", "2", "mixed"])
@pytest.mark.parametrize("state", ["ready", "busy", "full", "absent", "forbidden"])
@pytest.mark.parametrize("ends", [False, True], ids=["leaves", "ends"])
def test_to_leave_many_groups_examines_who_is_in_all_of_them_once(
    join: Join,
    broker: Broker,
    access: FakeAccess,
    monkeypatch: pytest.MonkeyPatch,
    qos: int | None,
    state: str,
    ends: bool,
):
    """Whoever can have the messages: it took groups and members once, and their product before."""
    groups, count = 200, 40
    leaving = _leaver(join, groups)
    members = [join(f"m{n}", user=f"m{n}", **lasting(5)) for n in range(count)]
    for index, member in enumerate(members):
        if state == "forbidden":
            access.deny(f"m{index}", Action.RECEIVE, "a")
        for number in range(groups):
            wanted = index % 3 if qos is None else qos
            broker.subscribe(member.session, Subscription(f"$share/g{number}/a", wanted))
        waiting = {"busy": member.session.window + 1, "full": broker.limits.queue_messages * 2}
        for _ in range(waiting.get(state, 0)):
            member.session.deliver(Message("own", b"", 1), 1, False, None)
        if state == "absent":
            member.lose()
    looked = Counter[str]()
    rank, decide = shared._rank, broker.router.may_receive
    monkeypatch.setattr(shared, "_rank", lambda *a: (looked.update(["members"]), rank(*a))[1])
    monkeypatch.setattr(
        broker.router, "may_receive", lambda *a: (looked.update(["rules"]), decide(*a))[1]
    )
    held = len(leaving.session.queue) + len(leaving.session.inflight)
    begun = broker.counters.cost
    if ends:
        join("leaving")  # anew
    else:
        leaving.lose()
    cost = broker.counters.cost - begun
    passes = 1 + ends
    # Each message costs something, and a look at the group's list of ranks; QoS 0 and 1 are apart.
    assert looked["members"] <= passes * 2 * (groups + 2 * count) < groups * count // 4
    assert looked["rules"] <= passes * (groups + count)
    each = 2 + 2 * count // shared.LISTED_PER_CHECK // CHECKS_PER_COST_UNIT
    assert cost <= passes * (groups * (each + 3) + 4 * count) < groups * count // 2
    if ends:
        return
    left = len(leaving.session.queue) + len(leaving.session.inflight)
    nobody = state in ("absent", "forbidden") or (state == "full" and qos in (1, 2))
    assert left == (held if nobody else 0)


def test_what_many_groups_leave_is_neither_lost_nor_doubled_nor_reordered(
    join: Join,
):
    """Of each group each message comes once, in its order, whoever gets it, and it is stored."""
    groups = 50
    leaving = join("leaving", **lasting(5))
    for number in range(groups):
        leaving.subscribe(f"$share/g{number}/a/{number}", 1)
    publisher = join("publisher")
    for text in (b"1", b"2", b"3"):
        for number in range(groups):
            assert publisher.publish(f"a/{number}", text, 1) == 0
    members = [join(f"m{number}", **lasting(5)) for number in range(3)]
    for member in members:
        for number in range(groups):
            member.subscribe(f"$share/g{number}/a/{number}", 1)
    leaving.lose()
    assert not leaving.session.queue and not leaving.session.inflight
    heard = {member.client.session: member.drain() for member in members}
    count = Counter((each.topic, each.payload) for came in heard.values() for each in came)
    assert len(count) == 3 * groups and set(count.values()) == {1}
    for came in heard.values():
        assert len(came) >= groups - members[0].session.window, "who can send at once has more"
        for number in range(groups):
            texts = [each.payload for each in came if each.topic == f"a/{number}"]
            assert texts == sorted(texts)


@pytest.mark.patches
@pytest.mark.parametrize("forbidden", [1, 31, 60])
def test_each_message_finds_one_who_may_read_it_however_many_may_not(
    monkeypatch: pytest.MonkeyPatch, join: Join, access: FakeAccess, forbidden: int
) -> None:
    """Also when so many answers were no that only a few members are asked about each message."""
    monkeypatch.setattr(shared, "MAXIMUM_FORBIDDEN", 20)
    topics = [f"a/{number}" for number in range(40)]
    leaving = join("leaving", **lasting(5))
    leaving.subscribe("$share/g/a/+", 1)
    publisher = join("publisher")
    for topic in topics:
        assert publisher.publish(topic, b"", 1) == 0
    for index in range(forbidden):
        member = join(f"m{index}", user=f"m{index}", **lasting(5))
        for topic in topics:
            access.deny(f"m{index}", Action.RECEIVE, topic)
        member.subscribe("$share/g/a/+", 1)
    readers = [join(f"r{index}", **lasting(5)) for index in range(4)]
    for reader in readers:
        reader.subscribe("$share/g/a/+", 1)
    leaving.lose()
    came = Counter(each.topic for reader in readers for each in reader.drain())
    if forbidden < shared.FEW_CHECKED:
        assert came == Counter(topics)
    else:  # of a crowd not all are asked, and those who were are passed by the next message
        assert came.keys() <= set(topics) and set(came.values()) == {1} and len(came) > 20
