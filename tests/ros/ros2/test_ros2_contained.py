"""What escapes on ROS's side, with rclpy: it ends the one message or call, and is counted."""

from __future__ import annotations

import asyncio

import pytest
from ros2_harness import STRING, string
from saboteur import SabotageError, Saboteur
from waiting import until

from appliance.broker.faults import Faults
from appliance.net.callbacks import Entries
from appliance.ros.mailbox import LARGE
from appliance.ros.node import QosProfile
from appliance.ros.ros2 import node as ros2

pytestmark = pytest.mark.usefixtures("isolated_domain")

TRIGGER = "std_srvs/srv/Trigger"


class Node:
    """A node with two subscriptions, one of which the loop takes, and a service."""

    def __init__(self) -> None:
        self.faults = Faults()
        self.node = ros2.Ros2Node()
        self.on_thread: list[bytes] = []
        self.on_loop: list[bytes] = []
        self.asked = 0
        self.failures: list[str] = []
        self.answers: list[object] = []
        self._subscription = None

    def start(self) -> None:
        entries = Entries(asyncio.get_running_loop(), self.faults)
        self.node.start(self._look, self.failures.append, entries)

    def _look(self) -> None:
        if self._subscription is None:
            qos = QosProfile(depth=1000)
            self._subscription = self.node.subscribe_raw(
                "/loop",
                STRING,
                qos,
                lambda cdr, at=0: self.on_loop.append(cdr),
                on_loop=self._on_batch,
            )
            self.node.subscribe_raw("/thread", STRING, qos, lambda cdr: self.on_thread.append(cdr))
            self.node.create_service("/ask", TRIGGER, self._answer)

    def _on_batch(self, batch: list[tuple[bytes, int]], lost: int, is_late: bool) -> None:
        self.on_loop += [cdr for cdr, _ in batch]

    def _answer(self, request: bytes, respond) -> None:
        self.asked += 1
        respond(b"\0\1\0\0\1\0\0\0\1\0\0\0\0\0\0\0")

    def ask(self) -> None:
        """Call its own service, on the ROS thread."""

        def call() -> None:
            client = self.node.create_client("/ask", TRIGGER)
            client.call(b"\0\1\0\0\0", self.answers.append)

        self.node.call_soon(call)


@pytest.fixture
async def node():
    node = Node()
    yield node
    await asyncio.to_thread(node.node.stop)
    assert node.failures == []


async def test_each_entry_of_the_node_in_turn(node, peer, escaped):
    with pytest.MonkeyPatch.context() as patch:
        saboteur = Saboteur(patch)
        counted = node.faults.by_entry
        saboteur.arm("ros.listen")
        node.start()
        await until(lambda: counted.get("ros.listen"), "the subscription on the loop")
        for topic in ("/loop", "/thread"):
            await peer.do("advertise", topic, STRING)
            await peer.do("matched", topic)
        for taken, topic in ((node.on_loop, "/loop"), (node.on_thread, "/thread")):
            await arrives(peer, topic, taken)

        for entry, topic, taken, size in (
            ("ros.ring", "/loop", node.on_loop, 1),
            ("ros.take_back", "/loop", node.on_loop, LARGE + 1),
            ("ros.message", "/thread", node.on_thread, 1),
        ):
            saboteur.arm(entry)
            await peer.do("publish", topic, string("x" * size).hex())
            await until(lambda entry=entry: counted.get(entry), entry)
            await arrives(peer, topic, taken)
            for _ in range(20):  # small again
                await peer.do("publish", topic, string("").hex())

        saboteur.arm("ros.request")
        node.ask()
        await until(lambda: counted.get("ros.request"), "a request that fails")
        node.ask()
        await until(lambda: node.answers, "the answer to the next one")
        assert node.asked == 1

        def fail() -> None:
            raise SabotageError

        node.node.call_soon(fail)
        await until(lambda: counted.get("ros.task"), "a task of the ROS thread")
        saboteur.arm("ros.fault")
        node.node.call_soon(fail)
        await until(lambda: counted.get("ros.fault"), "a fault of which it could not be told")
        for taken, topic in ((node.on_loop, "/loop"), (node.on_thread, "/thread")):
            await arrives(peer, topic, taken)

        saboteur.arm("ros.close")
        node.node.call_soon(node._subscription.destroy)
        await until(lambda: counted.get("ros.close"), "the end of the subscription")
        await arrives(peer, "/thread", node.on_thread)
    escaped.clear()


async def arrives(peer, topic: str, taken: list[bytes]) -> None:
    """A message that is published from now on."""
    taken.clear()
    for _ in range(600):
        await peer.do("publish", topic, string("").hex())
        if taken:
            return
        await asyncio.sleep(0.05)
    raise AssertionError(f"nothing arrives on {topic}")
