"""The mailbox between the ROS thread and the loop's: bounds, order, wake-ups."""

from __future__ import annotations

import threading

from appliance.broker.message import Message
from appliance.ros.mailbox import Lane, Mailbox
from appliance.ros.metrics import FlowCounters


def payloads(taken):
    return [message.payload for _, message in taken[0]]


def fill(box, lane, *items):
    for item in items:
        box.put(lane, Message("t", item))


def test_keep_latest_replaces_and_counts():
    box, lane = Mailbox(lambda: None), Lane(1, FlowCounters())
    fill(box, lane, b"1", b"2", b"3")
    assert payloads(box.take(10)) == [b"3"]
    assert lane.dropped == 2


def test_keep_n_drops_the_oldest():
    box, lane = Mailbox(lambda: None), Lane(3, FlowCounters())
    fill(box, lane, b"1", b"2", b"3", b"4", b"5")
    assert payloads(box.take(10)) == [b"3", b"4", b"5"]
    assert lane.dropped == 2


def test_lanes_take_turns():
    box, one, two = Mailbox(lambda: None), Lane(9, FlowCounters()), Lane(9, FlowCounters())
    fill(box, one, b"a1", b"a2", b"a3")
    fill(box, two, b"b1")
    assert payloads(box.take(3)) == [b"a1", b"b1", b"a2"]
    assert payloads(box.take(3)) == [b"a3"]


def test_wakes_once_until_empty():
    wakes = []
    box, lane = Mailbox(lambda: wakes.append(1)), Lane(9, FlowCounters())
    fill(box, lane, b"1", b"2", b"3")
    assert len(wakes) == 1
    assert box.take(2)[1]  # there is more: the taker comes again by itself
    fill(box, lane, b"4")
    assert len(wakes) == 1
    assert payloads(box.take(9)) == [b"3", b"4"]
    fill(box, lane, b"5")
    assert len(wakes) == 2


def test_bounded_in_messages():
    box, one, two = (
        Mailbox(lambda: None, max_messages=3),
        Lane(9, FlowCounters()),
        Lane(9, FlowCounters()),
    )
    fill(box, one, b"a1", b"a2")
    fill(box, two, b"b1", b"b2")
    assert payloads(box.take(9)) == [b"a2", b"b1", b"b2"]
    assert (one.dropped, two.dropped) == (1, 0)


def test_bounded_in_bytes_but_one_message_always_fits():
    box, lane = Mailbox(lambda: None, max_bytes=10), Lane(9, FlowCounters())
    fill(box, lane, b"x" * 6, b"y" * 6)
    assert payloads(box.take(9)) == [b"y" * 6]
    fill(box, lane, b"z" * 100)
    assert payloads(box.take(9)) == [b"z" * 100]
    fill(box, lane, b"1", b"2")
    assert payloads(box.take(9)) == [b"1", b"2"]
    assert lane.dropped == 1


def test_a_lane_emptied_by_the_bound_is_out_of_turn():
    box, one, two = (
        Mailbox(lambda: None, max_messages=1),
        Lane(9, FlowCounters()),
        Lane(9, FlowCounters()),
    )
    fill(box, one, b"a")
    fill(box, two, b"b")
    fill(box, one, b"c")
    assert payloads(box.take(9)) == [b"c"]


def test_two_threads_lose_nothing_uncounted():
    ready = threading.Event()
    box, lane = Mailbox(ready.set), Lane(50, FlowCounters())
    total = 20_000
    sender = threading.Thread(
        target=lambda: fill(box, lane, *(str(n).encode() for n in range(total)))
    )
    taken = []
    sender.start()
    while sender.is_alive() or ready.is_set():
        if ready.wait(0.05):
            ready.clear()
            while (batch := box.take(64))[1]:
                taken += payloads(batch)
            taken += payloads(batch)
    sender.join()
    numbers = [int(payload) for payload in taken]
    assert numbers == sorted(set(numbers))
    assert len(numbers) + lane.dropped == total
    assert numbers[-1] == total - 1


def test_small_before_large_and_few_large_at_a_time():
    box, images, states = Mailbox(lambda: None), Lane(9, FlowCounters()), Lane(9, FlowCounters())
    image = b"i" * 600_000
    fill(box, images, image, image, image)
    fill(box, states, b"1", b"2")
    assert payloads(box.take(9)) == [b"1", b"2", image, image]
    fill(box, states, b"3")
    assert payloads(box.take(9)) == [b"3", image]


def test_a_topic_keeps_its_order_whatever_the_sizes():
    box, lane, other = Mailbox(lambda: None), Lane(3, FlowCounters()), Lane(9, FlowCounters())
    large = b"l" * 40_000
    fill(box, lane, large, b"1", large, b"2")  # the first is dropped, and the lane is small now
    fill(box, other, b"x")
    assert payloads(box.take(9)) == [b"1", b"x", large, b"2"]
    assert lane.dropped == 1


def test_what_is_replaced_keeps_its_turn():
    box, often, others = Mailbox(lambda: None), Lane(1, FlowCounters()), Lane(9, FlowCounters())
    fill(box, often, b"1")
    fill(box, others, b"x")
    fill(box, often, b"2")
    assert payloads(box.take(1)) == [b"2"]
