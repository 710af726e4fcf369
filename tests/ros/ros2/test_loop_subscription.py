"""Messages that the event loop's thread takes itself, on real ROS 2."""

from __future__ import annotations

import asyncio
import itertools
import struct
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from waiting import until

pytest.importorskip("rclpy")
from ros2_harness import BYTES, STRING, route, string

from appliance.broker.faults import Faults
from appliance.net.callbacks import Entries
from appliance.ros.bridge import Bridge
from appliance.ros.mailbox import LARGE
from appliance.ros.node import QosProfile
from appliance.ros.payload.converter import compile_converter
from appliance.ros.payload.definitions import load_description
from appliance.ros.ros2 import loop_subscription as ros2_loop
from appliance.ros.ros2 import node as ros2

pytestmark = pytest.mark.usefixtures("isolated_domain")

JOINTS = "sensor_msgs/msg/JointState"


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


class Taker:
    """A node with one subscription, and who was called with what of it."""

    def __init__(self, type_name=STRING, depth=1000):
        self.node = ros2.Ros2Node()
        self.taken = []
        self.batches = []
        self.lost = 0
        self.failures = []
        self._type = type_name
        self._qos = QosProfile(depth=depth)
        self.subscription = None

    def start(self):
        entries = Entries(asyncio.get_running_loop(), Faults())
        self.node.start(self._look, self.failures.append, entries)

    def _look(self):
        if self.subscription is None:
            self.subscription = self.node.subscribe_raw(
                "/a", self._type, self._qos, self._on_message, on_loop=self._on_batch
            )

    def _on_message(self, cdr, published_at=0):
        self.taken.append((threading.current_thread().name, cdr))

    def _on_batch(self, batch, lost, is_late):
        self.batches.append(len(batch))
        self.lost += lost
        for cdr, _ in batch:
            self._on_message(cdr)

    async def advertised(self, peer):
        """Both ends have found each other: the publisher alone knowing it is not enough."""
        await peer.do("advertise", "/a", self._type)
        await peer.do("matched", "/a")
        probe = string("")

        async def arrives():
            await peer.do("publish", "/a", probe.hex())
            return self.taken

        for _ in range(200):
            if await arrives():
                break
            await asyncio.sleep(0.05)
        # The topic is in order: behind this one no probe is on its way.
        known = string("known")
        await peer.do("publish", "/a", known.hex())
        await until(lambda: self.taken and self.taken[-1][1].startswith(known), "the last probe")
        self.taken.clear()
        self.batches.clear()


@pytest.fixture
async def taker():
    takers = []

    def start(*args, **kw):
        takers.append(Taker(*args, **kw))
        takers[-1].start()
        return takers[-1]

    yield start
    for each in takers:
        await asyncio.to_thread(each.node.stop)
        assert each.failures == []


async def test_small_messages_are_taken_on_the_loops_thread(taker, peer):
    taker = taker()
    await taker.advertised(peer)
    for number in range(20):
        await peer.do("publish", "/a", string(f"{number:03d}").hex())
    await until(lambda: len(taker.taken) == 20, "all")
    here = threading.current_thread().name
    assert taker.taken == [(here, string(f"{number:03d}")) for number in range(20)]


async def test_large_messages_go_to_the_ros_thread_in_order(taker, peer):
    taker = taker(BYTES)
    await taker.advertised(peer)
    small, large = 10, LARGE + 1
    sizes = [small] * 3 + [large] + [small] * (ros2_loop.SMALL_IN_A_ROW + 3) + [large, large]
    for number, size in enumerate(sizes):
        await peer.do("publish_image", "/a", size, 1, 10_000)
        if size == small:  # they are not taken in one go
            await until(lambda number=number: len(taker.taken) == number + 1, "the message")
    await until(lambda: len(taker.taken) == len(sizes), "all")
    assert [len(cdr) > LARGE for _, cdr in taker.taken] == [size == large for size in sizes]
    here, there = threading.current_thread().name, "ros"
    names = [name for name, _ in taker.taken]
    back = 4 + ros2_loop.SMALL_IN_A_ROW
    assert names[:3] == [here] * 3
    assert names[3:back] == [there] * (back - 3)
    assert names[back:] == [here] * 3 + [there] * 2


async def test_a_busy_loop_takes_batches_and_loses_nothing_that_the_queue_holds(taker, peer):
    taker = taker(depth=1000)
    await taker.advertised(peer)
    await peer.do_beside_a_busy_loop("publish", "/a", string("one").hex(), 300, 2000)
    await until(lambda: len(taker.taken) == 300, "all")
    assert max(taker.batches) == ros2_loop.BATCH
    assert taker.lost == 0


async def test_other_callbacks_run_between_two_batches(taker, peer):
    taker = taker(depth=2000)
    await taker.advertised(peer)
    publishing = asyncio.create_task(peer.do("publish", "/a", string("one").hex(), 1500, 10_000))
    turns = []
    while len(taker.taken) < 1500:
        before = len(taker.batches)
        await asyncio.sleep(0)
        turns.append(len(taker.batches) - before)
        if not publishing.done():
            time.sleep(0.05)  # noqa: ASYNC251 - the loop has other things to do
    await publishing
    assert taker.lost == 0
    assert max(turns) == 1


async def test_two_threads_never_take_at_the_same_time(monkeypatch, taker, peer):
    taker = taker(BYTES, depth=2000)
    await taker.advertised(peer)
    given = []
    hand_over, take_back = (
        getattr(ros2_loop.LoopSubscription, name) for name in ("_hand_over", "_take_back")
    )

    def count_over(self, batch):
        given.append(+1)
        hand_over(self, batch)

    def count_back(self, lost):
        given.append(-1)
        take_back(self, lost)

    monkeypatch.setattr(ros2_loop.LoopSubscription, "_hand_over", count_over)
    monkeypatch.setattr(ros2_loop.LoopSubscription, "_take_back", count_back)
    publishing = []
    for _ in range(10):
        small = peer.do("publish_image", "/a", 10, 400, 100_000)
        large = peer.do("publish_image", "/a", LARGE + 1, 1, 100_000)
        publishing += [asyncio.create_task(small), asyncio.create_task(large)]
    while not all(task.done() for task in publishing):
        time.sleep(0.02)  # noqa: ASYNC251 - as before
        await asyncio.sleep(0)
    await asyncio.gather(*publishing)
    # A fast publisher gets further ahead than the depth: what had to make room is counted.
    await until(lambda: len(taker.taken) + taker.lost == 4010, "each is taken, or counted as lost")
    await until(lambda: sum(given) == 0, "the loop's thread has it again")
    assert given and set(itertools.accumulate(given)) == {0, 1}


async def bridged(harness, peer, type_name):
    harness.start(route("/a", "mqtt", "cdr"))
    await peer.do("advertise", "/a", type_name)
    await until(harness.bridged, "/a")
    await peer.do("matched", "/a")


async def test_a_burst_of_small_messages_is_carried_whole(harness, peer):
    await bridged(harness, peer, STRING)
    await peer.do_beside_a_busy_loop("publish", "/a", string("one").hex(), 500, 5000)
    await until(lambda: len(harness.payloads("r2d2/a")) == 500, "all")
    assert harness.bridge.status()[0].dropped == 0


async def test_a_burst_of_the_states_of_joints_is_carried_whole(harness, peer):
    await bridged(harness, peer, JOINTS)
    cdr = compile_converter(load_description(JOINTS)).from_dict({"position": [0.5] * 7})
    await peer.do_beside_a_busy_loop("publish", "/a", cdr.hex(), 90, 5000)
    await until(lambda: len(harness.payloads("r2d2/a")) == 90, "all")
    assert harness.bridge.status()[0].dropped == 0


async def test_a_loop_that_cannot_keep_up_carries_the_newest(monkeypatch, harness, peer):
    monkeypatch.setattr(ros2_loop, "BEHIND_AFTER", 0.2)
    ages, stamps = [], [0.0]

    def slow(batch):
        for _, message in batch:
            stamps.append(struct.unpack_from("<d", message.payload, 20)[0])
            ages.append(time.time() - stamps[-1])
            time.sleep(0.005)

    monkeypatch.setattr(Bridge, "_publish", lambda self, batch: slow(batch))
    topics = {"latest": "/a", 2000: "/b"}
    harness.start(*(replace(route(ros, "mqtt", "cdr"), keep=keep) for keep, ros in topics.items()))
    oldest = {}
    for count, (keep, ros) in enumerate(topics.items(), 1):
        await peer.do("advertise", ros, "geometry_msgs/msg/Vector3")
        await until(lambda count=count: len(harness.bridged()) == count, ros)
        await peer.do("matched", ros)
        ages.clear()
        await peer.do("publish_times", ros, 1000, 1000)
        last = time.time()
        await peer.do("publish_times", ros, 1, 1000)
        await until(lambda last=last: stamps[-1] >= last, "the last message")
        oldest[keep] = max(ages)
    dropped = [status.dropped for status in harness.bridge.status()]
    # One second's worth in five and more: the queue grows to its end, on any computer.
    assert oldest["latest"] < oldest[2000] / 2
    assert dropped[0] > 300 and dropped[1] == 0


async def test_what_a_busy_loop_misses_is_counted(harness, peer):
    await bridged(harness, peer, BYTES)  # which may be pictures: not many of them are held
    for _ in range(5):
        await peer.do_beside_a_busy_loop("publish_image", "/a", 10, 100, 2000)
    await peer.do("publish_image", "/a", 100, 1, 2000)
    await until(lambda: any(len(each) > 100 for each in harness.payloads("r2d2/a")), "the last")
    arrived = len(harness.payloads("r2d2/a"))
    assert arrived < 400
    assert harness.bridge.status()[0].dropped == 501 - arrived


async def test_subscriptions_come_and_go_while_messages_come(harness, peer):
    routes = [route("/a", "mqtt", "text"), route("/b", "mqtt", "text")]
    harness.start(*routes)
    for topic in ("/a", "/b"):
        await peer.do("advertise", topic, STRING)
    await until(lambda: len(harness.bridged()) == 2, "both")

    def names():
        return {topic for topic in ("/a", "/b") if harness.node.count(topic)[1]}

    files = open_files()
    publishing = asyncio.create_task(peer.do("publish", "/a", string("one").hex(), 12_000, 2000))
    loops = 0
    while not publishing.done():
        harness.bridge.replace(routes[1:])
        await until(lambda: "/a" not in names(), "the end of /a")
        seen = len(harness.payloads("r2d2/a"))
        await asyncio.sleep(0.05)
        assert len(harness.payloads("r2d2/a")) == seen
        harness.bridge.replace(routes)
        await until(lambda: len(harness.bridged()) == 2, "/a again")
        loops += 1
        if publishing.done() and loops <= 3:  # a busy computer has made few
            again = peer.do("publish", "/a", string("one").hex(), 4000, 2000)
            publishing = asyncio.create_task(again)
    await publishing
    assert loops > 3
    assert open_files() == files


async def test_the_ros_thread_takes_all_where_the_loop_cannot(monkeypatch, taker, peer):
    def refuse(pointer):
        raise ros2_loop.UnavailableError("not here")

    monkeypatch.setattr(ros2_loop, "Doorbell", refuse)
    taker = taker()
    await taker.advertised(peer)
    await peer.do("publish", "/a", string("one").hex())
    await until(lambda: taker.taken, "the message")
    assert taker.taken == [("ros", string("one"))]
    assert taker.batches == []
