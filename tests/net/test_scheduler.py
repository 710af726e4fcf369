"""The scheduler: a client that sends little is served in each round, whatever others send."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from harness import Harness, Peer, check_scheduler, make_contexts

from appliance.broker.counters import COST_PER_TURN
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Pingreq,
    Pingresp,
    Puback,
    Publish,
    Subscribe,
    Subscription,
    Will,
)
from appliance.net.connection import SMALL_CHUNK, ClientConnection
from appliance.net.scheduler import COST_BETWEEN_CHECKS, COST_BEYOND_ROUND, COST_PER_ROUND

CROWD = 40

#: What one round may come to: the last chunk of each of the three parts may be a whole turn's.
MOST = COST_BETWEEN_CHECKS + COST_PER_ROUND + COST_BEYOND_ROUND + 3 * COST_PER_TURN


async def until(holds: Callable[[], bool], what: Callable[[], object]) -> None:
    for _ in range(20_000):
        if holds():
            return
        await asyncio.sleep(0.001)
    pytest.fail(f"waited in vain, and have {what()}")


async def crowd(harness: Harness, will: Will | None = None) -> list[tuple[Peer, ClientConnection]]:
    """Clients of one user."""
    there = []
    for number in range(CROWD):
        peer = await harness.dial()
        await peer.send(Connect(f"p{number}", username="mallory", will=will))
        answer = await peer.receive()
        assert isinstance(answer, Connack) and answer.reason_code == 0
        there.append((peer, harness.protocol(f"p{number}")))
    return there


@pytest.fixture
async def harness(tmp_path: Path) -> AsyncIterator[Harness]:
    harness = Harness(*make_contexts(tmp_path / "certs"))
    harness.broker.tick(asyncio.get_running_loop().time())
    yield harness
    await harness.close()


def new_topics(number: int) -> bytes:
    """As many messages as a little chunk holds, each to a topic that nobody knows yet."""
    count = SMALL_CHUNK // 60
    chunk = b"".join(Publish(f"{number}/{n}" + "/abc" * 10, b"").encode(5) for n in range(count))
    assert len(chunk) <= SMALL_CHUNK
    return chunk


async def test_little_chunks_of_many_are_no_more_than_a_round(harness: Harness):
    await harness.start()
    counters = harness.broker.counters
    other = await harness.log_in("other")
    others = harness.protocol("other")
    there = await crowd(harness)
    await asyncio.sleep(0)
    begun, received = counters.cost, counters.publish_received
    for number, (_, protocol) in enumerate(there):
        protocol.data_received(new_topics(number))
    assert counters.cost - begun <= MOST
    others.data_received(Pingreq().encode(5))  # of another user: no turn of theirs comes before it
    assert isinstance(await other.receive(), Pingresp)
    sent = CROWD * (SMALL_CHUNK // 60)
    assert counters.publish_received - received < sent / 2, "the rest waits for its turn"
    await until(
        lambda: counters.publish_received - received == sent,
        lambda: f"{counters.publish_received - received} messages of {sent}",
    )


async def test_chunks_that_cost_little_do_not_wait_for_a_turn(harness: Harness):
    await harness.start()
    there = await crowd(harness)
    await asyncio.sleep(0)
    harness.scheduler.is_round_over()
    harness.broker.counters.cost += 2 * COST_PER_ROUND
    served = 0
    for _, protocol in there[:8]:
        protocol.data_received(Pingreq().encode(5))
        served += not protocol._turn_queued
    assert served == 8
    for peer, _ in there[:8]:
        assert isinstance(await peer.receive(), Pingresp)


async def test_many_that_go_at_once_are_no_more_than_a_round(harness: Harness):
    await harness.start()
    counters = harness.broker.counters
    watcher = await harness.log_in("watcher")
    wanted = [Subscription("/".join("+" * depth) + "/#") for depth in range(1, 10)]
    await watcher.send(Subscribe(1, wanted))
    await watcher.receive()
    readers = [await harness.log_in(f"reader{number}") for number in range(30)]
    for reader in readers:
        await reader.send(Subscribe(1, wanted))
        await reader.receive()
    there = await crowd(harness, Will("/".join("abcdefghij"), b"gone"))
    await asyncio.sleep(0)
    begun = counters.cost
    for peer, protocol in there:
        assert protocol._transport is not None
        protocol._transport.pause_reading()
        protocol.connection_lost(None)
        peer.hang_up()
    assert counters.cost - begun <= MOST
    assert len(harness.broker.clients) > 31
    await until(
        lambda: len(harness.broker.clients) == 31,
        lambda: f"{len(harness.broker.clients)} clients",
    )
    for _ in there:
        heard = await watcher.receive()
        assert isinstance(heard, Publish) and heard.payload == b"gone"


@pytest.mark.parametrize("end", ["taken in", "lost"])
async def test_what_was_received_and_waits_is_counted_for_its_user(harness: Harness, end: str):
    await harness.start()
    accounting = harness.broker.accounting
    there = await crowd(harness)
    (peer, protocol), *_ = there
    await asyncio.sleep(0)
    before = accounting.queued_bytes
    chunk = Publish("a", bytes(1000)).encode(5) * 100
    harness.scheduler.is_round_over()
    harness.broker.counters.cost += 2 * COST_PER_ROUND
    protocol.data_received(chunk)
    assert protocol._backlog and accounting.queued_bytes - before >= len(chunk)
    assert protocol.account.bytes >= len(chunk)
    if end == "lost":
        protocol.connection_lost(None)
        peer.hang_up()
    await until(
        lambda: not protocol._backlog and accounting.queued_bytes == before,
        lambda: f"{accounting.queued_bytes - before} bytes that are counted",
    )


@pytest.mark.parametrize("portion", [SMALL_CHUNK, 1000], ids=["taken in", "waits"])
async def test_what_came_behind_connect_is_the_users_once_it_is_known(
    harness: Harness, portion: int
):
    await harness.start()
    harness.scheduler.portion = portion
    harness.gate.clear()
    peer = await harness.dial()
    begun = Publish("a", bytes(3000), 1, packet_id=1).encode(5)
    await peer.send(Connect("b", username="mallory"), begun[:2000])
    strangers = harness.broker.accounting.accounts.strangers
    await until(lambda: strangers.bytes >= 2000, lambda: f"{strangers.bytes} bytes of strangers")
    check_scheduler(harness.scheduler)
    harness.gate.set()
    assert isinstance(await peer.receive(), Connack)
    user = harness.protocol("b").account
    assert user is not strangers and not strangers.bytes and user.bytes >= 2000
    check_scheduler(harness.scheduler)
    await peer.send(begun[2000:])
    assert isinstance(await peer.receive(), Puback)
    assert not user.bytes
    check_scheduler(harness.scheduler)


async def test_the_last_byte_of_a_large_packet_is_not_little(harness: Harness):
    await harness.start()
    (peer, protocol), (other, others), *_ = await crowd(harness)
    large = Publish("a", bytes(SMALL_CHUNK + 1000), 1, packet_id=1).encode(5)
    small = Publish("a", bytes(SMALL_CHUNK - 1000), 1, packet_id=1).encode(5)
    for who, packet in ((peer, large), (other, small)):
        await who.send(packet[:-1])
    await until(
        lambda: protocol._client._held > SMALL_CHUNK and others._client._held > SMALL_CHUNK - 1000,
        lambda: (protocol._client._held, others._client._held),
    )
    await asyncio.sleep(0)
    received = harness.broker.counters.publish_received
    harness.scheduler.is_round_over()
    harness.broker.counters.cost += 2 * COST_PER_ROUND
    for client, last in ((protocol, large), (others, small)):
        client.data_received(last[-1:])
    assert protocol._turn_queued and protocol._backlog, "it waits for its turn"
    assert not others._backlog and harness.broker.counters.publish_received == received + 1
    for who in (peer, other):
        assert isinstance(await who.receive(), Puback)
    harness.scheduler.is_round_over()
    harness.broker.counters.cost += 2 * COST_PER_ROUND
    protocol.data_received(Pingreq().encode(5))
    assert not protocol._backlog, "what comes then is little again"
    assert isinstance(await peer.receive(), Pingresp)
