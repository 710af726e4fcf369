"""One round of the event loop: who sends little is served in it, whatever the others send."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from house import Caller, House, check_network, make_contexts

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
from appliance.net.connection import LITTLE, ClientConnection
from appliance.net.scheduler import COST_BEYOND_ROUND, COST_PER_ROUND, UNLOOKED

CROWD = 40

#: What one round may come to: the last chunk of each of the three parts may be a whole turn's.
MOST = UNLOOKED + COST_PER_ROUND + COST_BEYOND_ROUND + 3 * COST_PER_TURN


async def until(holds: Callable[[], bool], what: Callable[[], object]) -> None:
    for _ in range(20_000):
        if holds():
            return
        await asyncio.sleep(0.001)
    pytest.fail(f"waited in vain, and have {what()}")


async def crowd(house: House, will: Will | None = None) -> list[tuple[Caller, ClientConnection]]:
    """Clients of one user."""
    there = []
    for number in range(CROWD):
        caller = await house.dial()
        await caller.say(Connect(f"p{number}", username="mallory", will=will))
        answer = await caller.hear()
        assert isinstance(answer, Connack) and answer.reason_code == 0
        there.append((caller, house.protocol(f"p{number}")))
    return there


@pytest.fixture
async def house(tmp_path: Path) -> AsyncIterator[House]:
    house = House(*make_contexts(tmp_path / "certs"))
    house.broker.tick(asyncio.get_running_loop().time())
    yield house
    await house.close()


def new_topics(number: int) -> bytes:
    """As many messages as a little chunk holds, each to a topic that nobody knows yet."""
    count = LITTLE // 60
    chunk = b"".join(Publish(f"{number}/{n}" + "/abc" * 10, b"").encode(5) for n in range(count))
    assert len(chunk) <= LITTLE
    return chunk


async def test_little_chunks_of_many_are_no_more_than_a_round(house: House):
    await house.start()
    counters = house.broker.counters
    other = await house.join("other")
    others = house.protocol("other")
    there = await crowd(house)
    await asyncio.sleep(0)
    begun, received = counters.cost, counters.publish_received
    for number, (_, protocol) in enumerate(there):
        protocol.data_received(new_topics(number))
    assert counters.cost - begun <= MOST
    others.data_received(Pingreq().encode(5))  # of another user: no turn of theirs comes before it
    assert isinstance(await other.hear(), Pingresp)
    sent = CROWD * (LITTLE // 60)
    assert counters.publish_received - received < sent / 2, "the rest waits for its turn"
    await until(
        lambda: counters.publish_received - received == sent,
        lambda: f"{counters.publish_received - received} messages of {sent}",
    )


async def test_chunks_that_cost_little_do_not_wait_for_a_turn(house: House):
    await house.start()
    there = await crowd(house)
    await asyncio.sleep(0)
    house.network.is_round_over()
    house.broker.counters.cost += 2 * COST_PER_ROUND
    served = 0
    for _, protocol in there[:8]:
        protocol.data_received(Pingreq().encode(5))
        served += not protocol._turn_over
    assert served == 8
    for caller, _ in there[:8]:
        assert isinstance(await caller.hear(), Pingresp)


async def test_many_that_go_at_once_are_no_more_than_a_round(house: House):
    await house.start()
    counters = house.broker.counters
    watcher = await house.join("watcher")
    wanted = [Subscription("/".join("+" * depth) + "/#") for depth in range(1, 10)]
    await watcher.say(Subscribe(1, wanted))
    await watcher.hear()
    readers = [await house.join(f"reader{number}") for number in range(30)]
    for reader in readers:
        await reader.say(Subscribe(1, wanted))
        await reader.hear()
    there = await crowd(house, Will("/".join("abcdefghij"), b"gone"))
    await asyncio.sleep(0)
    begun = counters.cost
    for caller, protocol in there:
        assert protocol._transport is not None
        protocol._transport.pause_reading()
        protocol.connection_lost(None)
        caller.hang_up()
    assert counters.cost - begun <= MOST
    assert len(house.broker.clients) > 31
    await until(
        lambda: len(house.broker.clients) == 31,
        lambda: f"{len(house.broker.clients)} clients",
    )
    for _ in there:
        heard = await watcher.hear()
        assert isinstance(heard, Publish) and heard.payload == b"gone"


@pytest.mark.parametrize("end", ["taken in", "lost"])
async def test_what_was_received_and_waits_is_counted_for_its_user(house: House, end: str):
    await house.start()
    accounting = house.broker.accounting
    there = await crowd(house)
    (caller, protocol), *_ = there
    await asyncio.sleep(0)
    before = accounting.queued_bytes
    chunk = Publish("a", bytes(1000)).encode(5) * 100
    house.network.is_round_over()
    house.broker.counters.cost += 2 * COST_PER_ROUND
    protocol.data_received(chunk)
    assert protocol._held and accounting.queued_bytes - before >= len(chunk)
    assert protocol.account.bytes >= len(chunk)
    if end == "lost":
        protocol.connection_lost(None)
        caller.hang_up()
    await until(
        lambda: not protocol._held and accounting.queued_bytes == before,
        lambda: f"{accounting.queued_bytes - before} bytes that are counted",
    )


@pytest.mark.parametrize("portion", [LITTLE, 1000], ids=["taken in", "waits"])
async def test_what_came_behind_connect_is_the_users_once_it_is_known(house: House, portion: int):
    await house.start()
    house.network.portion = portion
    house.gate.clear()
    caller = await house.dial()
    begun = Publish("a", bytes(3000), 1, packet_id=1).encode(5)
    await caller.say(Connect("b", username="mallory"), begun[:2000])
    strangers = house.broker.accounting.accounts.strangers
    await until(lambda: strangers.bytes >= 2000, lambda: f"{strangers.bytes} bytes of strangers")
    check_network(house.network)
    house.gate.set()
    assert isinstance(await caller.hear(), Connack)
    user = house.protocol("b").account
    assert user is not strangers and not strangers.bytes and user.bytes >= 2000
    check_network(house.network)
    await caller.say(begun[2000:])
    assert isinstance(await caller.hear(), Puback)
    assert not user.bytes
    check_network(house.network)


async def test_the_last_byte_of_a_large_packet_is_not_little(house: House):
    await house.start()
    (caller, protocol), (other, others), *_ = await crowd(house)
    large = Publish("a", bytes(LITTLE + 1000), 1, packet_id=1).encode(5)
    small = Publish("a", bytes(LITTLE - 1000), 1, packet_id=1).encode(5)
    for who, packet in ((caller, large), (other, small)):
        await who.say(packet[:-1])
    await until(
        lambda: protocol._client._held > LITTLE and others._client._held > LITTLE - 1000,
        lambda: (protocol._client._held, others._client._held),
    )
    await asyncio.sleep(0)
    received = house.broker.counters.publish_received
    house.network.is_round_over()
    house.broker.counters.cost += 2 * COST_PER_ROUND
    for client, last in ((protocol, large), (others, small)):
        client.data_received(last[-1:])
    assert protocol._turn_over and protocol._held, "it waits for its turn"
    assert not others._held and house.broker.counters.publish_received == received + 1
    for who in (caller, other):
        assert isinstance(await who.hear(), Puback)
    house.network.is_round_over()
    house.broker.counters.cost += 2 * COST_PER_ROUND
    protocol.data_received(Pingreq().encode(5))
    assert not protocol._held, "what comes then is little again"
    assert isinstance(await caller.hear(), Pingresp)
