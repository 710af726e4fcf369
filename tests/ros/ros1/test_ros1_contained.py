"""A fault on ROS 1's threads ends what it was in, is counted, and keeps nobody waiting."""

from __future__ import annotations

import asyncio
import threading
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import until

from appliance.broker.faults import Faults
from appliance.net.callbacks import Entries
from appliance.ros.ros1 import endpoints as ros1_ends
from appliance.ros.ros1.node import Ros1Node


def fail(*_: object) -> None:
    raise ArithmeticError("nobody expected this")


@pytest.fixture
def faults() -> Faults:
    return Faults()


@pytest.fixture
async def node(faults: Faults) -> Ros1Node:
    """One that has its thread's work done by the test."""
    node = Ros1Node()
    node._entries = Entries(asyncio.get_running_loop(), faults)
    node._is_running = True
    return node


async def test_a_fault_in_a_task_is_counted_and_the_next_is_done(
    node: Ros1Node, faults: Faults, escaped: list[str]
) -> None:
    done: list[str] = []
    node.call_soon(fail)
    node.call_soon(lambda: done.append("the next"))
    await asyncio.to_thread(node._do_work, 0.0)
    assert done == ["the next"]
    await until(lambda: faults.by_entry.get("ros.task") == 1, "the fault to be counted")
    escaped.clear()


async def test_a_message_behind_one_that_failed_is_delivered(
    node: Ros1Node, faults: Faults, escaped: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    monkeypatch.setattr(
        "appliance.ros.ros1.node.Ros1Subscription", lambda *arguments: made.append(arguments[-1])
    )
    monkeypatch.setattr(node, "_definition", lambda type_name: None)
    qos: Any = SimpleNamespace(durability=None)
    node.subscribe_raw("/down", "std_msgs/msg/String", qos, fail)
    await asyncio.to_thread(made[0], b"message")
    await until(lambda: faults.by_entry.get("ros.message") == 1, "the fault to be counted")
    escaped.clear()


async def test_a_caller_gets_an_error_when_its_request_fails(
    node: Ros1Node, faults: Faults, escaped: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class ServiceError(Exception):
        """As rospy has one."""

    monkeypatch.setattr(ros1_ends, "message_class", lambda rospy, definition: None)
    monkeypatch.setattr(ros1_ends, "_service_class", lambda rospy, definition: None)
    rospy = SimpleNamespace(ServiceException=ServiceError, Service=lambda *_: None)
    definition: Any = SimpleNamespace(response=None)
    service = ros1_ends.Ros1Service(rospy, "/srv", definition, fail, node.call_soon)
    told: list[str] = []

    def ask() -> None:
        try:
            service._serve(SimpleNamespace(_buff=b""))
        except ServiceError as error:
            told.append(str(error))

    asker = threading.Thread(target=ask, daemon=True)
    asker.start()
    await until(lambda: not node._work.empty(), "the request")
    await asyncio.to_thread(node._do_work, 0.0)
    await until(lambda: told, "the answer")
    assert told == ["nobody on MQTT answered"]
    await until(lambda: faults.by_entry.get("ros.task") == 1, "the fault to be counted")
    escaped.clear()
