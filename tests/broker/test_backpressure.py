"""Backpressure: which publishers wait for slow readers, how long, and which do not wait.

The clients here are driven in steps of a fake clock: in each one they read what came, acknowledge
as much as they please, and publish as far as their window goes.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Sequence

import pytest

from appliance.broker.accounts import Quota
from appliance.broker.backpressure import (
    LEAST_COUNTED,
    MESSAGE_PATIENCE,
    PATIENCE,
    PUBLISHER_PATIENCE,
    Allowance,
)
from appliance.broker.broker import CHECKS_PER_COST_UNIT, Broker
from appliance.broker.limits import Limits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.host.clock import SpareClock
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import (
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
)
from appliance.mqtt.reason import ReasonCode

from .conftest import FakeStore, Join, Peer, lasting

STEP = 0.001  # seconds
ALL = 1_000_000


class Actor:
    """A client that reads, acknowledges `pace` messages a step, and publishes."""

    def __init__(
        self,
        peer: Peer,
        topics: Sequence[str] = (),
        count: int = 0,
        *,
        qos: int = 1,
        window: int = 50,
        pace: int = ALL,
    ) -> None:
        self.peer = peer
        self.topics = topics
        self.count = count
        self.qos = qos
        self.window = window
        self.pace = pace
        self.sent = 0
        self.acknowledged = 0
        self.codes: set[int] = set()
        self.got: list[bytes] = []
        #: Steps in which something of it was acknowledged.
        self.moved: list[int] = []
        self.due: float | None = None
        self._owed: deque[Packet] = deque()
        #: What goes out at once, of exchanges of QoS 2.
        self._steps: list[Packet] = []

    def act(self, step: int) -> None:
        for packet in self.peer.received():
            if isinstance(packet, Publish):
                self.got.append(packet.payload)
                if packet.packet_id is not None:
                    kind = Puback if packet.qos == 1 else Pubrec
                    self._owed.append(kind(packet.packet_id))
            elif isinstance(packet, Pubrec) and packet.reason_code < 0x80:
                self._steps.append(Pubrel(packet.packet_id))
            elif isinstance(packet, Pubrel):
                self._steps.append(Pubcomp(packet.packet_id))
            elif isinstance(packet, Puback | Pubcomp | Pubrec):
                self.codes.add(packet.reason_code)
                self.acknowledged += 1
                self.moved.append(step)
        if self.peer.transport.stopped or self.peer.transport.laters:
            return  # it is not read
        answers = [self._owed.popleft() for _ in range(min(self.pace, len(self._owed)))]
        room = min(self.window - (self.sent - self.acknowledged), self.count - self.sent)
        room = room if self.topics else 0
        steps, self._steps = self._steps, []
        self.peer.send(*steps, *answers, *(self._next() for _ in range(room)))

    def _next(self) -> Publish:
        topic = self.topics[self.sent % len(self.topics)]
        self.sent += 1
        packet_id = self.peer.next_id() if self.qos else None
        return Publish(topic, b"%d" % (self.sent - 1), self.qos, False, False, packet_id)

    def has_all(self) -> bool:
        """Whether all it is to publish is acknowledged."""
        return self.acknowledged == self.count

    @property
    def done(self) -> bool:
        """Whether that is so, and it has received all that waits for it."""
        return self.has_all() and not self._owed and not self.peer.session.queue


def play(
    broker: Broker, *actors: Actor, until: Callable[[], bool] | None = None, steps: int = 20_000
) -> int:
    """Let them act until all are done, or so many steps; returns how many steps that took."""
    promised = sum(actor.window for actor in actors if actor.qos == 2)
    for step in range(steps):
        broker.accounting.now += STEP
        before = [len(actor.got) for actor in actors]
        for actor in actors:
            actor.act(step)
            take_turn(actor)
        # A QoS 2 message that there was room for at its PUBREC is kept at its PUBREL.
        most = broker.limits.queue_messages + promised
        assert all(len(session.queue) <= most for session in broker.sessions.values())
        if until is not None:
            if until():
                return step
        elif all(actor.done for actor in actors) and before == [len(a.got) for a in actors]:
            return step
    return steps


def take_turn(actor: Actor) -> None:
    """The turn that it asked for, or for which it is time."""
    wire, now = actor.peer.transport, actor.peer.broker.now
    if wire.waits is not None:
        if actor.due is None:
            actor.due = now + wire.waits
    else:
        actor.due = None
    if wire.laters or (actor.due is not None and actor.due <= now):
        wire.waits = actor.due = None
        actor.peer.go_on()


def numbers(count: int) -> list[bytes]:
    return [b"%d" % number for number in range(count)]


COUNT = 3000


# --- nothing is lost between two that read


@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("window", [20, 50, 5000], ids="{} in flight".format)
def test_a_flood_loses_nothing(join: Join, broker: Broker, version: int, qos: int, window: int):
    if version == 5 and qos == 2:
        window = 20  # Receive Maximum
    reader = join("reader", version=version)
    reader.subscribe("a", qos)
    publisher = Actor(join("publisher", version=version), ["a"], COUNT, qos=qos, window=window)
    slower = Actor(reader, pace=7)
    play(broker, publisher, slower)
    assert slower.got == numbers(COUNT)
    assert publisher.codes == {0} and broker.counters.publish_dropped == 0
    assert broker.counters.publish_received == COUNT
    assert not broker.accounting.congested and not publisher.peer.client._behind


@pytest.mark.parametrize("limits", [Limits(queue_bytes=100_000, inflight=20)])
@pytest.mark.parametrize("rest", [0.0, 60.0], ids="{} s between them".format)
@pytest.mark.parametrize("ending", ["reads", "leaves"])
def test_a_wait_ends_with_the_congestion(join: Join, broker: Broker, rest: float, ending: str):
    """Bursts of four messages, of which three have room: what is waited for the fourth ends when
    the queue is empty, or nobody's, before the publisher tries again."""
    reader, publisher = join("reader", version=4), join("publisher", version=4)
    client = publisher.client
    for burst in range(100):
        if ending == "leaves" and burst:
            reader = join("reader", version=4)
        reader.subscribe("a", 1)
        publisher.send(*(Publish("a", bytes(30_000), 1, False, False, n) for n in range(1, 5)))
        assert client._allowance.awaited, f"burst {burst} was not waited for"
        congestions = client._allowance.awaited
        broker.accounting.now += 0.02
        if ending == "leaves":
            reader.lose()
        else:
            acknowledge_all(reader)
        publisher.go_on()
        if ending == "reads":
            assert acknowledge_all(reader) == 1, f"burst {burst} lost a message"
        assert len(publisher.received()) == 4
        assert not client._allowance.awaited and not any(each._waiting for each in congestions)
        assert not broker.accounting.congested
        broker.accounting.now += rest
    assert client._allowance.left > PUBLISHER_PATIENCE / 2
    assert broker.counters.publish_dropped == 0 or ending == "leaves"


def acknowledge_all(reader: Peer) -> int:
    """Acknowledge the messages that it has received; returns how many these were."""
    messages = [packet for packet in reader.received() if isinstance(packet, Publish)]
    reader.send(*(Puback(message.packet_id) for message in messages))
    return len(messages)


@pytest.mark.parametrize("limits", [Limits(queue_messages=10, inflight=1)])
@pytest.mark.parametrize("policy", ["refuse", "drop-oldest", "disconnect"])
def test_every_policy_is_for_those_who_do_not_read(join: Join, broker: Broker, policy: str):
    broker.limits = Limits(queue_messages=10, queue_full=policy)
    broker.use(broker.limits, broker.features)
    reader = join("reader", properties={Property.RECEIVE_MAXIMUM: 1})
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 500)
    receiver = Actor(reader, pace=1)
    play(broker, publisher, receiver)
    assert receiver.got == numbers(500)


@pytest.mark.parametrize("limits", [Limits(queue_bytes=100_000, inflight=20)])
def test_a_queue_that_is_full_of_bytes_is_waited_for_as_well(join: Join, broker: Broker):
    """Large messages fill it while they are in flight, with nothing that is queued."""
    reader = join("reader")
    reader.subscribe("a", 1)
    publisher = join("publisher", version=4)
    receiver = Actor(reader, pace=1)
    sender = Actor(publisher)
    for number in range(40):
        publisher.send(Publish("a", b"%d" % number + bytes(30_000), 1, False, False, number + 1))
        sender.count = number + 1
        play(broker, sender, receiver, until=sender.has_all)
    play(broker, receiver, steps=100)
    assert [payload.rstrip(b"\0") for payload in receiver.got] == numbers(40)
    assert not broker.counters.publish_dropped


def test_a_message_with_properties_waits_like_any_other(join: Join, broker: Broker):
    reader = join("reader")
    reader.subscribe("a", 1)
    publisher = join("publisher")
    sender, receiver = Actor(publisher), Actor(reader, pace=20)
    properties = {Property.CONTENT_TYPE: "text/plain"}
    for start in range(0, 3000, 20):
        publisher.send(
            *(
                Publish("a", b"%d" % (start + n), 1, False, False, n + 1, dict(properties))
                for n in range(20)
            )
        )
        sender.count = start + 20
        play(broker, sender, receiver, until=sender.has_all)
    play(broker, receiver, steps=200)
    assert receiver.got == numbers(3000) and not broker.counters.publish_dropped


@pytest.mark.parametrize("topic_filter", ["#", "+/x", "$share/group/+/x"])
def test_many_topics_and_wildcards_and_groups(join: Join, broker: Broker, topic_filter: str):
    readers = [join(f"reader{n}", version=4) for n in range(2 if "share" in topic_filter else 1)]
    for reader in readers:
        reader.subscribe(topic_filter, 1)
    topics = [f"{number}/x" for number in range(2000)]
    publisher = Actor(join("publisher", version=4), topics, 4000)
    receivers = [Actor(reader, pace=6) for reader in readers]
    play(broker, publisher, *receivers)
    assert sorted(int(payload) for each in receivers for payload in each.got) == list(range(4000))
    assert not broker.counters.publish_dropped


def test_many_publishers_to_one_reader_take_turns(join: Join, broker: Broker):
    reader = join("reader", version=4)
    reader.subscribe("+", 1)
    publishers = [
        Actor(join(f"publisher{n}", version=4), [f"{n}"], 400, window=20) for n in range(30)
    ]
    receiver = Actor(reader, pace=20)
    play(broker, *publishers, receiver)
    assert len(receiver.got) == 30 * 400 and not broker.counters.publish_dropped
    ends = [publisher.moved[-1] for publisher in publishers]
    assert min(ends) > 0.5 * max(ends), "nobody is done long before the others"


def test_the_store_may_be_behind(join: Join, broker: Broker, store: FakeStore):
    """PUBACK and what a persistent session is sent wait for commits, three steps each."""
    reader = join("reader", **lasting(5))
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4, **lasting(4)), ["a"], COUNT)
    receiver = Actor(reader)
    clock = 0

    def commit() -> bool:
        nonlocal clock
        clock += 1
        if clock % 3 == 0:
            store.commit()
        store.holding = True
        return publisher.done and len(receiver.got) == COUNT

    play(broker, publisher, receiver, until=commit)
    assert receiver.got == numbers(COUNT)
    assert not broker.counters.publish_dropped
    store.commit()


class SlowStore:
    """Commits once in so many steps, as on a slow disk, and in none of those in which it stalls."""

    def __init__(self, store: FakeStore, steps: int, stalls: range = range(0)) -> None:
        self.store = store
        self.steps = steps
        self.stalls = stalls
        self.passed = 0
        store.holding = True

    def step(self) -> None:
        self.passed += 1
        if self.passed % self.steps == 0 and self.passed not in self.stalls:
            self.store.commit()
            self.store.holding = True


@pytest.mark.lengthy
@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("size", [1, 3], ids=["to itself", "a ring of three"])
@pytest.mark.parametrize(
    ("steps", "stalls"),
    [(30, range(0)), (3, range(100, 2100))],
    ids=["each commit takes 30 ms", "one takes 2 s"],
)
def test_a_slow_disk_is_not_the_readers_fault(
    join: Join, broker: Broker, store: FakeStore, steps: int, stalls: range, size: int, qos: int
):
    """A reader that has acknowledged all it was given waits for the store as others do for it."""
    actors = []
    for number in range(size):
        peer = join(f"client{number}", version=4, **lasting(4))
        peer.subscribe(f"{number}", qos)
        target = f"{(number + 1) % size}"
        actors.append(Actor(peer, [target], COUNT, qos=qos, window=1000))
    disk = SlowStore(store, steps, stalls)

    def act() -> bool:
        disk.step()
        return all(actor.done and len(actor.got) >= COUNT for actor in actors)

    play(broker, *actors, until=act)
    assert not broker.counters.publish_dropped
    assert [actor.acknowledged for actor in actors] == [COUNT] * size
    assert all(actor.got == numbers(COUNT) for actor in actors)
    store.commit()


@pytest.mark.parametrize("manner", ["nothing", "one a commit", "all but one"])
def test_who_does_not_read_is_not_excused_by_a_slow_disk(
    join: Join, broker: Broker, store: FakeStore, manner: str
):
    """… nor who acknowledges what is on its way still, to be found waiting for the store."""
    reader = join("reader", version=4, **lasting(4))
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 20_000, window=1200)
    disk = SlowStore(store, 30)
    got: list[int] = []

    def act() -> bool:
        disk.step()
        got.extend(p.packet_id or 0 for p in reader.received() if isinstance(p, Publish))
        inflight = reader.session.inflight
        if manner == "one a commit" and not disk.passed % 30 and inflight:
            reader.send(Puback(next(reversed(inflight))))
        elif manner == "all but one":
            reader.send(*(Puback(i) for i in tuple(inflight)[1:]))
            congestion = reader.session.congestion
            assert congestion is None or congestion._has_unacknowledged or not got, (
                "the first is not acknowledged"
            )
        return publisher.done

    play(broker, publisher, until=act, steps=6000)
    assert longest_pause(publisher) <= 2 * (PATIENCE + 0.03)
    if manner != "all but one":  # that one drains its queue
        assert broker.counters.publish_dropped > 10_000
    store.commit()


# --- nobody waits for himself


@pytest.mark.lengthy
@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("window", [50, 100, 200, 1000], ids="{} in flight".format)
@pytest.mark.parametrize("size", [1, 2, 3], ids=["to itself", "two", "a ring of three"])
def test_who_publish_to_each_other_do_not_wait_for_each_other(
    join: Join, broker: Broker, qos: int, size: int, window: int
):
    """What they acknowledge is taken in, while what they publish waits."""
    actors = []
    for number in range(size):
        peer = join(f"client{number}", version=4)
        peer.subscribe(f"{number}", qos)
        target = f"{(number + 1) % size}"
        actors.append(Actor(peer, [target], COUNT, qos=qos, window=window, pace=10))
    steps = play(broker, *actors)
    assert all(actor.got == numbers(COUNT) for actor in actors)
    assert not broker.counters.publish_dropped
    assert steps < 2000, "nobody waited for a time to be up"


@pytest.mark.lengthy
@pytest.mark.parametrize("qos", [1, 2])
@pytest.mark.parametrize("window", [50, 200, 1000], ids="{} in flight".format)
def test_all_may_publish_to_all(join: Join, broker: Broker, qos: int, window: int):
    actors = []
    for number in range(5):
        peer = join(f"client{number}", version=4)
        peer.subscribe("+", qos)
        actors.append(Actor(peer, [f"{number}"], 1200, qos=qos, window=window, pace=20))
    play(broker, *actors)
    assert [len(actor.got) for actor in actors] == [5 * 1200] * 5
    assert not broker.counters.publish_dropped


@pytest.mark.lengthy
def test_a_ring_of_clients_that_send_without_end_goes_on(join: Join, broker: Broker):
    """More is on the way than is looked at: then it is the time that ends the waiting."""
    broker.use(Limits(queue_bytes=1024 * 1024), broker.features)
    actors = []
    for number in range(3):
        peer = join(f"client{number}", version=4)
        peer.subscribe(f"{number}", 1)
        actors.append(Actor(peer, [f"{(number + 1) % 3}"], 20_000, window=10_000, pace=10))
    play(broker, *actors)
    assert all(actor.acknowledged == 20_000 for actor in actors)
    for actor in actors:
        received = [int(payload) for payload in actor.got]
        assert received == sorted(set(received)), "in order, and none twice"


# --- who does not read


def longest_pause(actor: Actor) -> float:
    """Seconds in which nothing of the actor was acknowledged."""
    return max(later - earlier for earlier, later in itertools.pairwise(actor.moved)) * STEP


def test_who_stops_reading_is_waited_for_once(join: Join, broker: Broker):
    """… and not again until it has read all that waited for it."""
    reader = join("reader", version=4)
    reader.subscribe("#", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 20_000)
    steps = play(broker, publisher, until=lambda: publisher.done)
    pauses = [later - earlier for earlier, later in itertools.pairwise(publisher.moved)]
    paused = [pause for pause in pauses if pause > 2]
    assert len(paused) == 1 and 0.2 < paused[0] * STEP <= PATIENCE
    assert steps * STEP < 20_000 / 50 * STEP + PATIENCE + 0.1
    assert broker.counters.publish_dropped == 20_000 - 1000 - 20
    assert not broker.accounting.congested, "it costs others nothing more"
    # It reads again: all that was kept, and then it is waited for as before.
    publisher.count = 23_000
    receiver = Actor(reader)
    play(broker, receiver, steps=100)
    receiver.pace = 10
    play(broker, publisher, receiver)
    assert receiver.got[-3000:] == numbers(23_000)[-3000:]


@pytest.mark.parametrize("pace", [1, 2, 3])
def test_who_reads_too_slowly_is_waited_for_a_little_longer(join: Join, broker: Broker, pace: int):
    """A pace of 4 a step is the least with which a queue of 1,000 drains in 250 ms."""
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 20_000)
    receiver = Actor(reader, pace=pace)
    steps = play(broker, publisher, receiver, until=lambda: publisher.done)
    assert longest_pause(publisher) <= PATIENCE * 4 / (4 - pace)
    # Without any waiting these were 400 steps.
    assert steps * STEP < 0.4 + PATIENCE * 4 / (4 - pace) + 0.1
    assert broker.counters.publish_dropped > 10_000


@pytest.mark.lengthy
def test_who_recovers_is_waited_for_again(join: Join, broker: Broker):
    """A reader that stood still for a moment loses what came then, and nothing later."""
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], ALL)
    receiver = Actor(reader, pace=0)
    play(broker, publisher, receiver, steps=600)
    assert broker.counters.publish_dropped
    receiver.pace = 30
    play(broker, publisher, receiver, steps=200)
    dropped = broker.counters.publish_dropped
    play(broker, publisher, receiver, steps=1000)
    assert broker.counters.publish_dropped == dropped


def test_time_in_which_the_broker_works_is_not_the_readers(join: Join, broker: Broker):
    """With many floods at a time each reader gets its part of the processor only."""
    broker.accounting.client_time = lambda: 0.05 * broker.now
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], COUNT)
    receiver = Actor(reader, pace=1)
    play(broker, publisher, receiver)
    assert receiver.got == numbers(COUNT) and not broker.counters.publish_dropped


@pytest.mark.parametrize("load", [0, 2], ids="{} others want the processor".format)
def test_a_computer_under_load_is_not_the_readers_fault(join: Join, broker: Broker, load: int):
    """Where the broker has to wait for the processor, the reader has to as well."""
    clock = SpareClock()
    broker.accounting.client_time = lambda: clock.grow(
        1 + broker.now, 0.1 * broker.now, load * 0.1 * broker.now, 0
    )
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], COUNT)
    receiver = Actor(reader, pace=2)
    play(broker, publisher, receiver)
    assert bool(broker.counters.publish_dropped) == (not load)


def test_readers_that_conspire_cannot_stop_a_publisher(join: Join, broker: Broker):
    """Whatever they invent, to be waited for without end: each message gives it time back."""
    broker.accounting.client_time = lambda: 0.0  # and the time of none of them is counted
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], ALL)
    play(broker, publisher, steps=10_000)
    assert longest_pause(publisher) <= PUBLISHER_PATIENCE / LEAST_COUNTED + 5 * STEP
    seconds = 10_000 * STEP - 2 * PUBLISHER_PATIENCE / LEAST_COUNTED
    assert publisher.acknowledged - 1020 > seconds / MESSAGE_PATIENCE * LEAST_COUNTED


@pytest.mark.lengthy
def test_to_come_back_is_not_to_read(join: Join, broker: Broker):
    """What was left of the patience with a reader is left when it comes back."""
    reader = join("reader", **lasting(5))
    reader.subscribe("a", 1)
    reader.lose()
    publisher = Actor(join("publisher", version=4), ["a"], 2000)
    play(broker, publisher)
    steps = []
    for _ in range(5):
        reader = join("reader", **lasting(5))
        publisher.count += 100
        steps.append(play(broker, publisher))
        reader.lose()
    assert PATIENCE / STEP <= steps[0] < PATIENCE / STEP + 10 and max(steps[1:]) < 10
    receiver = Actor(join("reader", **lasting(5)), pace=20)
    publisher.count = ALL
    play(broker, publisher, receiver, steps=200)
    dropped = broker.counters.publish_dropped
    play(broker, publisher, receiver, steps=500)
    assert broker.counters.publish_dropped == dropped


def test_an_allowance_that_is_used_up_has_to_be_half_full_again():
    allowance = Allowance(1.0)
    allowance.change(-0.9)
    assert not allowance.used_up
    allowance.change(-0.2)
    assert allowance.used_up and allowance.left == 0
    allowance.change(0.4)
    assert allowance.used_up
    allowance.change(0.1)
    assert not allowance.used_up
    allowance.change(7)
    assert allowance.left == 1.0


def test_who_leaves_is_not_waited_for(join: Join, broker: Broker):
    reader = join("reader", **lasting(5))
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 1100)
    play(broker, publisher, until=lambda: publisher.peer.transport.waits is not None)
    reader.lose()
    assert publisher.peer.transport.laters, "at once"
    play(broker, publisher)
    assert broker.counters.publish_dropped == 1100 - 1000 - 20
    assert not broker.accounting.congested


def test_an_absent_reader_is_not_waited_for(join: Join, broker: Broker):
    """queue_full decides for it at once, as it always did."""
    reader = join("reader", **lasting(5))
    reader.subscribe("a", 1)
    reader.lose()
    publisher = Actor(join("publisher"), ["a"], 2000, window=20)
    assert play(broker, publisher) < 200
    assert publisher.codes == {0, ReasonCode.QUOTA_EXCEEDED}


# --- everybody else goes on


@pytest.mark.lengthy
def test_only_who_publishes_to_the_slow_one_waits(join: Join, broker: Broker):
    """Of 50 readers one is slow: the others have everything, and another publisher goes on."""
    readers = [join(f"reader{number}", version=4) for number in range(50)]
    for reader in readers:
        reader.subscribe("a", 1)
    readers[0].subscribe("b", 0)
    other_reader = join("other reader", version=4)
    other_reader.subscribe("b", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 1500)
    receivers = [Actor(reader, pace=ALL if index else 0) for index, reader in enumerate(readers)]
    waits = publisher.peer.transport
    play(broker, publisher, *receivers, until=lambda: waits.waits is not None)
    other = Actor(join("other", version=4), ["b"], 500)
    other_receiver = Actor(other_reader)
    assert play(broker, other, other_receiver) < 0.2 / STEP
    assert waits.waits is not None, "it still waits"
    assert other_receiver.got == numbers(500)
    play(broker, publisher, *receivers)
    assert all(receiver.got == numbers(1500) for receiver in receivers[1:])


@pytest.mark.parametrize("topic_filter", ["b", "$share/group/b"])
def test_to_look_for_readers_that_are_full_costs(
    waiting: Peer, broker: Broker, join: Join, topic_filter: str
):
    """While one reader is congested they are looked through for each message of anybody."""
    for number in range(200):
        join(f"reader {number}", version=4).subscribe(topic_filter, 1)
    other = join("other", version=4)
    (session,) = broker.accounting.congested
    costs = []
    for congested in ({}, {session: None}):
        broker.accounting.congested.clear()
        broker.accounting.congested.update(congested)
        for packet_id in (2 * len(costs) + 1, 2 * len(costs) + 2):  # the first finds the route
            begun = broker.counters.cost
            other.send(Publish("b", b"", 1, False, False, packet_id))
        costs.append(broker.counters.cost - begun)
    assert costs[1] - costs[0] == 200 // CHECKS_PER_COST_UNIT


@pytest.fixture
def waiting(join: Join, broker: Broker) -> Peer:
    """A publisher that waits, with a message to "a"; packet ids from 10,000 on are free."""
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], 1020)
    play(broker, publisher, until=lambda: publisher.done)
    publisher.peer.send(Publish("a", b"waits", 1, False, False, 10_000))
    assert publisher.peer.received() == []
    assert publisher.peer.transport.waits is not None and publisher.peer.transport.waits <= PATIENCE
    return publisher.peer


def test_pings_and_acknowledgements_do_not_wait(waiting: Peer, broker: Broker, join: Join):
    waiting.send(Pingreq(), Publish("b", b"behind", 1, False, False, 10_001), Pingreq())
    assert waiting.received() == [Pingresp(), Pingresp()]
    waiting.wait()
    assert waiting.received() == [Puback(10_000), Puback(10_001)]


def test_what_may_change_the_message_waits_behind_it(waiting: Peer):
    """A SUBSCRIBE that comes later has not the message; a DISCONNECT is not the end of it."""
    waiting.send(
        Subscribe(10_001, [Subscription("a", 1)]),
        Publish("b", b"behind", 1, False, False, 10_002),
        Disconnect(),
    )
    assert waiting.received() == [] and waiting.transport.stopped, "nothing is read behind it"
    waiting.wait()
    packets = waiting.received()
    assert [type(packet) for packet in packets] == [Puback, Suback, Puback]
    assert waiting.transport.closed


def test_what_waits_is_bounded(waiting: Peer, broker: Broker):
    """In bytes, as is what waits for the client: as many packets as that takes."""
    accounting, client = broker.accounting, waiting.client
    accounting.queue_bytes = 100_000
    packets = [Publish("b", bytes(1000), 1, False, False, 10_001 + n) for n in range(100)]
    sent = 0
    while not waiting.transport.stopped:
        waiting.send(packets[sent])
        sent += 1
    assert 60 < sent < 70 and 100_000 <= client._behind_size < 102_000
    waiting.send(packets[sent], Pingreq())
    assert waiting.received() == [], "what comes all the same is kept as bytes"
    assert accounting.input_bytes >= client._behind_size + 1000
    waiting.wait()
    assert len(waiting.received()) == sent + 3
    assert accounting.input_bytes == 0


def test_what_waits_no_more_is_counted_for_nobody(join: Join, broker: Broker):
    """Not only once something else comes from the client: it may keep silent for hours."""
    broker.use(Limits(queue_messages=10, inflight=1), broker.features)
    reader, publisher = join("reader", version=4), join("publisher", version=4)
    reader.subscribe("a", 1)
    client, before = publisher.client, broker.accounting.input_bytes
    publisher.send(*(Publish("a", bytes(20_000), 1, False, False, n) for n in range(1, 41)))
    assert broker.accounting.input_bytes - before > 20 * 20_000
    for _ in range(1000):
        broker.accounting.now += STEP
        acknowledge_all(reader)
        if publisher.transport.laters:
            publisher.go_on()
            counted = client.protocol.held + client._behind_size
            assert client._held == counted == publisher.transport.held
        if not client._behind:
            break
    assert not client._behind and not client._held
    assert broker.accounting.input_bytes == before


def test_what_waits_takes_no_memory_that_there_is_not(waiting: Peer, broker: Broker):
    """Nobody is disconnected for it: what does not fit is not read."""
    accounting = broker.accounting
    accounting.unrestricted_memory = accounting.queued_bytes
    accounting.quotas.memory = Quota.of(accounting.queued_bytes + 50_000, None)
    for number in range(100):
        waiting.send(Publish("b", bytes(1000), 1, False, False, 10_001 + number))
        if waiting.transport.stopped:
            break
    assert waiting.transport.stopped and not waiting.transport.closed
    assert 0 < accounting.input_bytes < 20_000


def test_what_waits_is_counted_with_its_topic_and_properties(
    waiting: Peer, broker: Broker, join: Join
):
    waiting.send(Publish("b/" + "x" * 30_000, b"", 1, False, False, 10_001))
    assert 60_000 < broker.accounting.input_bytes < 65_000, "the topic, and the head that it is in"
    other = join("other")
    pairs: Properties = {Property.USER_PROPERTY: [("k" * 1000, "v" * 29_000)]}
    other.send(
        Publish("a", b"", 1, False, False, 10_001),
        Publish("b", b"", 1, False, False, 10_002, pairs),
    )
    assert broker.accounting.input_bytes > 90_000


def test_much_that_comes_behind_it_is_taken_in_turns(waiting: Peer, broker: Broker):
    """… while it comes, and when it is done after the connection was lost."""
    packets = [Publish("b", b"", 1, False, False, 10_001 + n) for n in range(5000)]
    waiting.send(*packets)
    for _ in range(10):
        begun = broker.counters.cost
        assert waiting.transport.laters
        waiting.go_on()
        assert broker.counters.cost - begun < 1100
        if not waiting.transport.laters:
            break
    assert len(waiting.client._behind) == 5001
    begun = broker.counters.cost
    waiting.client.hurry()
    assert broker.counters.cost - begun < 1100 and waiting.client._behind
    while waiting.transport.laters:
        waiting.go_on()
    assert not waiting.client._behind
    assert len(waiting.received()) == 5001


def test_a_large_message_may_be_behind_it(waiting: Peer):
    waiting.send(
        Publish("b", bytes(100_000), 1, False, False, 10_001),
        Publish("b", b"", 1, False, False, 10_002),
    )
    assert not waiting.transport.stopped and len(waiting.client._behind) == 3
    waiting.wait()
    assert waiting.received() == [Puback(10_000), Puback(10_001), Puback(10_002)]


def test_a_lost_connection_ends_the_waiting(waiting: Peer, broker: Broker, join: Join):
    """What came over it is delivered: who publishes and leaves does not wait for the PUBACK."""
    other = join("other")
    other.subscribe("#", 1)
    waiting.send(
        Publish("b", b"behind", 1, False, False, 10_001),
        Disconnect(),
    )
    waiting.client.hurry()
    waiting.client.receive(b"")
    waiting.lose()
    assert other.payloads() == [b"waits", b"behind"]
    assert "publisher" not in broker.sessions


def test_a_connection_lost_in_the_login_brings_nothing_in(broker: Broker):
    """Nothing that came behind CONNECT is looked at, as nobody knows who sent it."""
    stranger = Peer(broker)
    stranger.say_connect("stranger", **lasting(5))
    stranger.client.hurry()
    stranger.send(Subscribe(1, [Subscription("a", 1)]))
    stranger.lose()
    stranger.let_in()
    assert stranger.received() == [] and not broker.sessions


def test_a_publisher_that_is_cut_off_is_forgotten(waiting: Peer, broker: Broker):
    (congested,) = broker.accounting.congested
    waiting.client.close(ReasonCode.ADMINISTRATIVE_ACTION, "")
    broker.flush()
    assert congested.congestion is not None and not congested.congestion._waiting
    assert broker.accounting.input_bytes == 0


def test_wrong_bytes_behind_it_end_the_connection(waiting: Peer, broker: Broker):
    waiting.send(b"\x00\x00")
    assert waiting.transport.closed and not waiting.client._behind
    waiting.go_on()


def test_keep_alive_is_for_those_who_are_read(join: Join, broker: Broker):
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4, keep_alive=1), ["a"], 1021)
    play(broker, publisher, until=lambda: publisher.peer.transport.waits is not None)
    broker.tick(broker.now + 2)
    assert not publisher.peer.transport.closed
    publisher.peer.wait()
    broker.tick(broker.now + 2)
    assert publisher.peer.transport.closed, "it is silent now"


def test_what_the_appliance_publishes_itself_never_waits(join: Join, broker: Broker):
    """The bridge has queues of its own, and ROS does not wait."""
    reader = join("reader", version=4)
    reader.subscribe("a", 1)
    bridge = broker.attach("_bridge", InsideLink())
    codes = [broker.publish(Message("a", b"", 1), bridge) for _ in range(1200)]
    broker.flush()
    assert codes == [0] * 1020 + [ReasonCode.QUOTA_EXCEEDED] * 180


@pytest.mark.parametrize("properties", [None, {Property.CONTENT_TYPE: "text/plain"}])
def test_what_has_waited_is_old_for_who_does_not_carry_out_what_is_old(
    waiting: Peer, broker: Broker, properties: dict[Property, str] | None
):
    """Such as a route to ROS; for clients it is as any other."""
    ages = {}

    class Route(InsideLink):
        def publish(self, message, qos, packet_id, dup, retain, subscription_ids) -> None:
            ages[message.payload] = message.age

    bridge = broker.attach("_bridge", Route())
    broker.subscribe(bridge, Subscription("#", 0))
    waiting.send(Publish("b", b"behind", 1, False, False, 10_001, properties), Publish("b", b"0"))
    waiting.wait()
    waiting.send(Publish("b", b"later", 1, False, False, 10_002, properties))
    assert ages == {b"waits": math.inf, b"behind": math.inf, b"0": math.inf, b"later": 0}
    broker.detach(bridge)


def test_qos_0_waits_behind_what_came_before(waiting: Peer, join: Join):
    other = join("other")
    other.subscribe("#", 0)
    waiting.send(Publish("b", b"behind"))
    assert other.payloads() == []
    waiting.wait()
    assert other.payloads() == [b"waits", b"behind"]


def test_a_session_that_moves_to_another_connection_is_waited_for(join: Join, broker: Broker):
    """A reader that is taken over in the middle of a flood."""
    reader = join("reader", version=4, **lasting(4))
    reader.subscribe("a", 1)
    publisher = Actor(join("publisher", version=4), ["a"], COUNT)
    receiver = Actor(reader, pace=5)
    play(broker, publisher, receiver, steps=150)
    again = Actor(join("reader", version=4, **lasting(4)), pace=5)
    play(broker, publisher, again)
    got = set(receiver.got) | set(again.got)
    missing = COUNT - len(got)
    assert missing <= 1, "the message that waited at that moment"
    assert broker.sessions["reader"].congestion is None
