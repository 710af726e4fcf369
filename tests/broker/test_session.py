"""Sessions: random events compared with a naive model, and unit tests without a client."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field

import pytest
from examples import examples
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from appliance.broker.broker import Broker
from appliance.broker.delivery import UnreleasedPublish
from appliance.broker.limits import Limits
from appliance.broker.message import OVERHEAD, CountedMessage, HeaderCache, Message
from appliance.broker.session import Session, SessionAccounting
from appliance.broker.values import Identity
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Packet, Puback, Pubcomp, Publish, Pubrec, Pubrel, Will
from appliance.mqtt.topics import matches
from appliance.store import MemoryStore

from .conftest import (
    FakeAccess,
    FakeStore,
    Join,
    Peer,
    check_accounts,
    drops,
    lasting,
    waiting_bytes,
)

NAMES = {"four": 4, "five": 5, "cinq": 5}
TOPICS = ["t/1", "t/2", "u", "w"]
FILTERS = ["t/+", "#", "t/1", "u", "w/#"]
WINDOW = 3

names = st.sampled_from(sorted(NAMES))
topics = st.sampled_from(TOPICS)
qos_levels = st.integers(0, 2)


@dataclass
class Known:
    """What the model knows of one client id: the standard's session, and what the client saw."""

    version: int
    peer: Peer | None = None
    there: bool = False  # a session exists
    kept_for: int = 0
    ends_at: float | None = None
    will: tuple[str, bytes, int] | None = None
    slow: bool = False
    #: filter -> QoS, No Local
    subscriptions: dict[str, tuple[int, bool]] = field(default_factory=dict)
    #: QoS 1 and 2 that are owed, ever, and that arrived, each once, in order
    owed: list[tuple[str, bytes, int]] = field(default_factory=list)
    seen: list[tuple[str, bytes, int]] = field(default_factory=list)
    #: QoS 0: what may come, and by topic the last that must
    live: list[tuple[str, bytes]] = field(default_factory=list)
    newest: dict[str, bytes] = field(default_factory=dict)
    #: the client's own state: QoS 2 that waits for PUBREL, what it has not answered yet
    receiving: dict[int, bytes] = field(default_factory=dict)
    unanswered: list[Packet] = field(default_factory=list)
    #: QoS 2 that the client published and has not released
    publishing: dict[int, tuple[str, bytes]] = field(default_factory=dict)

    def forget(self) -> None:
        """The session is over."""
        self.there = False
        self.ends_at = None
        for part in (self.subscriptions, self.owed, self.seen, self.receiving, self.publishing):
            part.clear()


class Conversations(RuleBasedStateMachine):
    """A few clients that come, go, publish, subscribe, answer late or not at all."""

    def __init__(self) -> None:
        super().__init__()
        self.numbers = itertools.count()

    @initialize()
    def begin(self) -> None:
        self.store = FakeStore()
        self.broker = Broker(FakeAccess(), self.store, Limits(inflight=WINDOW))
        self.broker.tick(1.0)
        self.known = {name: Known(version) for name, version in NAMES.items()}

    def payload(self) -> bytes:
        return b"%d" % next(self.numbers)

    # --- what the standard says ----------------------------------------------------------------

    def routed(self, topic: str, payload: bytes, qos: int, origin: str) -> None:
        """A message was published: who is owed it?"""
        for name, known in self.known.items():
            granted = [
                granted
                for topic_filter, (granted, no_local) in known.subscriptions.items()
                if matches(topic_filter, topic) and not (no_local and name == origin)
            ]
            if not known.there or not granted:
                continue
            if reached := min(qos, max(granted)):
                known.owed.append((topic, payload, reached))
            elif known.peer is not None:
                known.live.append((topic, payload))
                known.newest[topic] = payload

    def gone(self, name: str, *, will: bool, kept_for: int | None = None) -> None:
        """The connection ended."""
        known = self.known[name]
        known.peer = None
        known.unanswered.clear()
        known.live.clear()
        known.newest.clear()
        known.slow = False
        if kept_for is not None:
            known.kept_for = kept_for
        testament, known.will = known.will, None
        if known.kept_for:
            known.ends_at = self.broker.now + known.kept_for
        else:
            known.forget()
        if will and testament is not None:
            self.routed(*testament, name)

    def heard(self, name: str) -> None:
        """The client reads what has come, and holds it against what may come."""
        known = self.known[name]
        assert known.peer is not None
        for packet in known.peer.received():
            if isinstance(packet, Pubrel):
                known.receiving.pop(packet.packet_id, None)
                known.unanswered.append(packet)
                continue
            assert isinstance(packet, Publish), packet
            assert not packet.retain
            if not packet.qos:
                assert not packet.dup and packet.packet_id is None
                self.heard_live(known, packet)
                continue
            assert packet.packet_id
            known.unanswered.append(packet)
            what = (packet.topic, packet.payload, packet.qos)
            if packet.qos == 2 and packet.packet_id in known.receiving:
                assert packet.dup and known.receiving[packet.packet_id] == packet.payload
            elif packet.qos == 1 and what in known.seen:
                assert packet.dup, "again, and it does not say so"
            else:
                # Exactly the next one that is owed: nothing is lost, doubled or out of order.
                assert what == known.owed[len(known.seen)]
                known.seen.append(what)
                if packet.qos == 2:
                    known.receiving[packet.packet_id] = packet.payload

    @staticmethod
    def heard_live(known: Known, packet: Publish) -> None:
        """QoS 0 comes in order for each topic; what a slow client missed stays away."""
        of_topic = [what for what in known.live if what[0] == packet.topic]
        what = (packet.topic, packet.payload)
        assert what in of_topic
        for missed in of_topic[: of_topic.index(what) + 1]:
            known.live.remove(missed)

    # --- what may happen -----------------------------------------------------------------------

    @rule(
        name=names,
        clean=st.booleans(),
        seconds=st.sampled_from([0, 10, 100]),
        will=st.none() | st.tuples(topics, qos_levels),
        reads=st.booleans(),
    )
    def connect(self, name, clean, seconds, will, reads):
        known = self.known[name]
        if known.peer is not None:
            if reads:
                self.heard(name)
            self.gone(name, will=True)  # taken over
        if clean:
            known.forget()
        peer = Peer(self.broker, known.version)
        options = lasting(known.version, seconds)
        if known.version == 4:
            seconds = 0 if clean else self.broker.limits.session_expiry
        options["clean"] = clean
        testament = None
        if will is not None:
            topic, qos = will
            testament = (topic, self.payload(), qos)
            options["will"] = Will(testament[0], testament[1], qos)
        answer = peer.connect(name, **options)
        assert answer.reason_code == 0
        assert answer.session_present == known.there
        known.peer = peer
        known.there = True
        known.kept_for = seconds
        known.ends_at = None
        known.will = testament
        self.heard(name)

    def online(self, name: str) -> Peer | None:
        return self.known[name].peer

    @rule(name=names, topic_filter=st.sampled_from(FILTERS), qos=qos_levels, local=st.booleans())
    def subscribe(self, name, topic_filter, qos, local):
        peer = self.online(name)
        if peer is None:
            return
        self.heard(name)
        no_local = not local and peer.version == 5
        assert peer.subscribe(topic_filter, qos, no_local=no_local) == qos
        self.known[name].subscriptions[topic_filter] = (qos, no_local)

    @rule(name=names, topic_filter=st.sampled_from(FILTERS))
    def unsubscribe(self, name, topic_filter):
        peer = self.online(name)
        if peer is None:
            return
        self.heard(name)
        answer = peer.unsubscribe(topic_filter)
        was_there = self.known[name].subscriptions.pop(topic_filter, None) is not None
        if peer.version == 5:
            assert list(answer.reason_codes) == [0 if was_there else 0x11]

    @rule(name=names, topic=topics, qos=qos_levels, times=st.integers(1, 4))
    def publish(self, name, topic, qos, times):
        peer = self.online(name)
        if peer is None or (qos == 2 and len(self.known[name].publishing) >= WINDOW):
            return
        for _ in range(times):
            payload = self.payload()
            packet_id = 1000 + int(payload) if qos else None
            self.heard(name)
            self.routed(topic, payload, qos, name)
            peer.send(Publish(topic, payload, qos, packet_id=packet_id))
            if qos:
                self.answered(name, Puback if qos == 1 else Pubrec, packet_id)
            if qos == 2:
                peer.send(Pubrel(packet_id))
                self.answered(name, Pubcomp, packet_id)
            self.heard(name)

    def answered(self, name: str, kind: type, packet_id: int) -> None:
        """Take the answer from among what has come."""
        peer = self.known[name].peer
        assert peer is not None
        packets = peer.received()
        (answer,) = [p for p in packets if type(p) is kind and p.packet_id == packet_id]
        assert answer.reason_code < 0x80
        for packet in packets:
            if packet is not answer:
                peer.transport.written += packet.encode(peer.version)

    @rule(name=names, topic=topics)
    def publish_half_of_qos_2(self, name, topic):
        peer = self.online(name)
        known = self.known[name]
        if peer is None or len(known.publishing) >= WINDOW:
            return
        self.heard(name)
        payload = self.payload()
        packet_id = 1000 + int(payload)
        known.publishing[packet_id] = (topic, payload)
        peer.send(Publish(topic, payload, 2, packet_id=packet_id))
        self.answered(name, Pubrec, packet_id)

    @rule(name=names, sends_again=st.booleans())
    def publish_the_other_half(self, name, sends_again):
        peer = self.online(name)
        known = self.known[name]
        if peer is None or not known.publishing:
            return
        self.heard(name)
        packet_id = next(iter(known.publishing))
        topic, payload = known.publishing.pop(packet_id)
        if sends_again:
            peer.send(Publish(topic, payload, 2, dup=True, packet_id=packet_id))
            self.answered(name, Pubrec, packet_id)
        self.routed(topic, payload, 2, name)
        peer.send(Pubrel(packet_id))
        self.answered(name, Pubcomp, packet_id)
        self.heard(name)

    @rule(name=names, most=st.integers(1, 5))
    def acknowledge(self, name, most):
        peer = self.online(name)
        known = self.known[name]
        if peer is None:
            return
        self.heard(name)
        for packet in known.unanswered[:most]:
            if isinstance(packet, Pubrel):
                peer.send(Pubcomp(packet.packet_id))
            elif isinstance(packet, Publish) and packet.packet_id:
                peer.send((Puback if packet.qos == 1 else Pubrec)(packet.packet_id))
        del known.unanswered[:most]
        self.heard(name)

    @rule(name=names, reads=st.booleans())
    def lose(self, name, reads):
        peer = self.online(name)
        if peer is None:
            return
        if reads:
            self.heard(name)
        peer.lose()
        self.gone(name, will=True)

    @rule(name=names, seconds=st.none() | st.sampled_from([0, 50]))
    def disconnect(self, name, seconds):
        peer = self.online(name)
        known = self.known[name]
        if peer is None:
            return
        if peer.version == 4 or not known.kept_for:
            seconds = None
        peer.disconnect(0, None if seconds is None else {Property.SESSION_EXPIRY_INTERVAL: seconds})
        self.gone(name, will=False, kept_for=seconds)

    @rule(name=names)
    def slow(self, name):
        if peer := self.online(name):
            self.heard(name)
            peer.slow()
            self.known[name].slow = True

    @rule(name=names)
    def fast(self, name):
        known = self.known[name]
        if peer := self.online(name):
            peer.fast()
            known.slow = False
            self.heard(name)
            assert not {topic for topic, _ in known.live}, "the newest of each topic has come"

    @rule(seconds=st.sampled_from([1, 9, 60]))
    def tick(self, seconds):
        self.broker.tick(self.broker.now + seconds)
        for known in self.known.values():
            if known.ends_at is not None and known.ends_at <= self.broker.now:
                known.forget()

    @precondition(lambda self: hasattr(self, "broker"))
    @invariant()
    def accounts(self):
        check_accounts(self.broker)
        there = {name for name, known in self.known.items() if known.there}
        assert set(self.broker.sessions) == there
        assert self.store.sessions == {n for n in there if self.known[n].kept_for}
        owed = {}
        for name, session in self.broker.sessions.items():
            assert len(session.inflight) <= WINDOW
            assert set(session.received) == set(self.known[name].publishing)
            if session.persistent:
                waiting = [*session.queue, *filter(None, session.inflight.values())]
                for message, *_ in waiting:
                    owed[name, message] = 1
        assert self.store.owed == owed
        assert self.broker.subscription_count == sum(
            len(known.subscriptions) for known in self.known.values()
        )
        for known in self.known.values():
            if known.peer is not None and not known.slow:
                assert known.peer.transport.written or not known.live

    def teardown(self):
        """In the end everyone is back, reads and answers: all that is owed has come."""
        if not hasattr(self, "broker"):
            return
        for name, known in self.known.items():
            if known.peer is None:
                self.connect(name, False, 100, None, True)
            self.fast(name)
            while known.publishing:
                self.publish_the_other_half(name, True)
        for name, known in self.known.items():
            self.heard(name)
            while known.unanswered:
                self.acknowledge(name, 100)
            assert known.seen == known.owed
            assert not known.live and not known.receiving
            assert not self.broker.sessions[name].inflight
        assert waiting_bytes(self.broker) == 0
        assert not self.store.owed
        for known in self.known.values():
            assert known.peer is not None
            known.peer.disconnect()
        self.broker.tick(self.broker.now + self.broker.limits.session_expiry)
        assert not self.broker.sessions and self.broker.accounting.queued_bytes == 0


TestConversations = Conversations.TestCase
TestConversations.settings = examples(120, stateful_step_count=50)


# --- a session alone


class Recorder:
    """A link that keeps what it is given."""

    def __init__(self) -> None:
        self.writable = True
        self.behind = False
        self.sent: list[tuple[bytes, int, int, bool]] = []
        self.released: list[int] = []

    def publish(self, message, qos, packet_id, dup, retain, subscription_ids) -> None:
        self.sent.append((message.payload, qos, packet_id, dup))

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        return False

    def is_behind(self) -> bool:
        return self.behind

    def pubrel(self, packet_id: int) -> None:
        self.released.append(packet_id)

    def close(self, reason, message) -> None: ...


@pytest.fixture
def session() -> Session:
    limits = Limits(inflight=2, queue_messages=3, queue_bytes=100_000)
    session = Session(
        "client", Identity("user", "client"), SessionAccounting(limits, MemoryStore())
    )
    session.link = Recorder()
    return session


def test_a_message_counts_all_that_it_holds():
    """Rule 3 of the design: bounds in bytes are bounds of memory."""
    assert Message("ab", b"payload").size >= 4 + 7 + OVERHEAD
    properties = {Property.USER_PROPERTY: [("k", "v")] * 100, Property.CONTENT_TYPE: "x" * 1000}
    plain, rich = Message("a", b""), Message("a", b"", properties=properties)
    assert rich.size > plain.size + 100 * 7 + 1000


def test_a_message_is_encoded_once_for_all_who_get_the_same():
    message, header_cache = Message("a/b", b"payload", 1), HeaderCache()
    for version in (4, 5):
        for first in (0x30, 0x31, 0x32, 0x3B, 0x34):
            head = header_cache.get(message, version, first)
            assert header_cache.get(message, version, first) is head
            qos = first >> 1 & 3
            expected = Publish(
                "a/b", b"payload", qos, bool(first & 1), first >= 0x38, 7 if qos else None
            )
            whole = head + b"\0\7" + b"\0" * (version == 5) + b"payload" if qos else head
            assert whole == expected.encode(version)


def test_window_queue_and_drops(session: Session):
    link = session.link
    assert isinstance(link, Recorder)
    taken = [session.deliver(Message("a", b"%d" % n), 1, False, None) for n in range(7)]
    assert taken == [True] * 5 + [False] * 2
    assert [sent[0] for sent in link.sent] == [b"0", b"1"]
    assert session.accounting.counters.publish_dropped == 2
    first, second = (sent[2] for sent in link.sent)
    assert session.puback(first) and not session.puback(first)
    assert [sent[0] for sent in link.sent] == [b"0", b"1", b"2"]
    assert session.puback(second)
    session.clear()
    assert session.bytes == session.accounting.queued_bytes == 0


def test_no_room_means_no_room_even_with_an_open_window(session: Session):
    assert not session.deliver(Message("a", bytes(200_000)), 1, False, None)
    assert not session.hold(1, UnreleasedPublish(Message("a", bytes(200_000)), frozenset()))
    assert session.deliver(Message("a", bytes(200_000)), 0, False, None)  # it passes through
    session.link.writable = False  # type: ignore[union-attr]
    assert not session.deliver(Message("a", bytes(200_000)), 0, False, None)
    assert session.bytes == 0


def test_a_message_that_is_released_twice_is_released_once(session: Session):
    held = UnreleasedPublish(Message("a", b"x", 2), frozenset())
    assert session.hold(5, held)
    assert session.unhold(5) is held
    assert session.unhold(5) is None
    assert session.accounting.queued_bytes == 0


def test_an_absent_client_gets_no_qos_0(session: Session):
    """[MQTT-3.1.2-5] leaves it open; messages of the past are of no use to a machine that moves."""
    session.link = None
    assert not session.deliver(Message("a", b"x"), 0, False, None)
    assert session.deliver(Message("a", b"x"), 1, False, None)
    session.pump()  # to nobody
    assert len(session.queue) == 1


# --- large messages to a slow client

LARGE = bytes(40_000)


class Counted:
    skipped = 0


def watched(topic: str, payload: bytes, counted: Counted, retain: bool = False) -> CountedMessage:
    message = CountedMessage(topic, payload, 0, retain)
    message.skip_counter = counted
    return message


def test_a_large_message_waits_while_the_network_is_behind_and_a_small_one_does_not(
    broker: Broker, join: Join, version: int
):
    peer, origin, counted = join(version=version), broker.attach("inside", Recorder()), Counted()
    peer.subscribe("#")
    peer.transport.behind = True
    for payload in (LARGE + b"1", LARGE + b"2"):
        broker.publish(watched("image", payload, counted), origin)
    broker.publish(Message("state", b"s"), origin)
    broker.flush()
    assert peer.payloads() == [b"s"]
    assert counted.skipped == 1 and drops(broker) == {"replaced": 1}
    peer.transport.behind = False
    peer.client.output.caught_up()
    broker.flush()
    assert peer.payloads() == [LARGE + b"2"]


@pytest.mark.parametrize("keep", [None, 10])
def test_a_large_message_does_not_come_behind_a_newer_one_of_its_topic(
    broker: Broker, join: Join, version: int, keep: int | None
):
    broker.accounting.limits = dataclasses.replace(broker.accounting.limits, keep=keep or 0)
    peer, publisher = join(version=version), join("publisher")
    peer.subscribe("#")
    peer.transport.behind = True
    origin, counted = broker.attach("inside", Recorder()), Counted()
    broker.publish(watched("a", LARGE, counted), origin)
    broker.publish(Message("b", LARGE), origin)
    publisher.send(Publish("a", b"1"))
    broker.publish(Message("a", b"2"), origin)
    broker.flush()
    peer.transport.behind = False
    peer.client.output.caught_up()
    broker.publish(Message("a", b"3"), origin)
    broker.flush()
    if keep:
        assert peer.payloads() == [LARGE, LARGE, b"1", b"2", b"3"]
    else:
        assert peer.payloads() == [b"1", b"2", LARGE, b"3"]
        assert counted.skipped == 1 and drops(broker) == {"replaced": 1}
    check_accounts(broker)


def test_one_that_waited_for_a_pause_to_end_does_not_either(broker: Broker, join: Join):
    peer, origin = join(), broker.attach("inside", Recorder())
    peer.subscribe("#")
    peer.slow()
    broker.publish(Message("a", LARGE), origin)
    peer.transport.behind = True
    peer.fast()
    broker.publish(Message("a", b"1"), origin)
    peer.transport.behind = False
    peer.client.output.caught_up()
    broker.flush()
    assert peer.payloads() == [b"1"]
    check_accounts(broker)


def test_large_messages_go_one_by_one_and_behind_small_ones(broker: Broker, join: Join):
    peer, origin = join(), broker.attach("inside", Recorder())
    peer.subscribe("#")
    peer.slow()
    for topic, payload in (("a", LARGE), ("b", LARGE), ("state", b"1"), ("state", b"2")):
        broker.publish(Message(topic, payload), origin)
    broker.flush()
    peer.fast()
    assert peer.payloads() == [b"2", LARGE, LARGE]  # the network has taken each at once
    peer.slow()
    for topic in ("a", "b"):
        broker.publish(Message(topic, LARGE), origin)
    peer.transport.behind = True
    peer.fast()
    assert peer.payloads() == []
    peer.transport.behind = False
    peer.client.output.caught_up()
    broker.flush()
    assert peer.payloads() == [LARGE, LARGE]


def test_retained_messages_that_are_large_are_all_sent(broker: Broker, join: Join):
    origin = broker.attach("inside", Recorder())
    for number in range(20):
        broker.publish(Message(f"map/{number}", LARGE, 0, True), origin)
    peer = join()
    peer.transport.behind = True
    peer.subscribe("map/#")
    assert peer.payloads() == []
    peer.transport.behind = False
    peer.client.output.caught_up()
    broker.flush()
    assert len(peer.payloads()) == 20
    assert broker.counters.publish_dropped == 0


def test_a_client_that_leaves_takes_what_waits_for_it_along(broker: Broker, join: Join):
    peer, origin = join(), broker.attach("inside", Recorder())
    peer.subscribe("#")
    peer.transport.behind = True
    broker.publish(Message("image", LARGE), origin)
    broker.flush()
    assert waiting_bytes(broker) > len(LARGE)
    peer.lose()
    assert waiting_bytes(broker) == 0
