"""What is known of the computer at the other end of a connection, on real sockets."""

from __future__ import annotations

import asyncio
import math
import socket
import time

import pytest
from house import House

from appliance.broker.ports import HERE, Contact
from appliance.mqtt.packets import Pingreq, Pingresp, Subscribe, Subscription
from appliance.sockets import Probe, contact

pytestmark = pytest.mark.skipif(not hasattr(socket, "TCP_INFO"), reason="only Linux tells")

__all__ = ["House"]


@pytest.fixture
async def house(tmp_path_factory):
    from house import make_contexts

    house = House(*make_contexts(tmp_path_factory.mktemp("certs")))
    await house.start()
    yield house
    await house.close()


@pytest.mark.parametrize("tls", [False, True])
async def test_a_probe_is_answered_by_the_computer_and_not_by_the_client(house, tls):
    """The client itself reads nothing and says nothing."""
    await house.join("a", tls=tls)
    wire = house.protocol("a")
    begun = time.monotonic()
    while wire.contact().silence < 0.3:
        assert time.monotonic() < begun + 20, f"it is never silent: {wire.contact()}"
        await asyncio.sleep(0.05)
    asked = time.monotonic()
    wire.probe()
    while wire.contact().silence + 0.02 >= time.monotonic() - asked:
        assert time.monotonic() < asked + 20, f"there is no answer: {wire.contact()}"
        await asyncio.sleep(0.05)
    connection = wire._transport.get_extra_info("socket")
    wire._end_probe()
    assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) > 60
    assert 0 <= wire.contact().round_trip < 5


async def test_what_is_withheld_comes_in_its_order(house):
    caller = await house.join("a")
    wire = house.protocol("a")
    wire.withhold(60)
    await caller.say(Pingreq(), Subscribe(1, [Subscription("x")]))
    await until_waiting(wire)
    wire.resume_writing()  # the network takes more, and that is no reason
    assert wire._waiting
    wire.withhold(0)
    assert isinstance(await caller.hear(), Pingresp)
    assert (await caller.hear()).packet_id == 1
    wire.withhold(0.01)
    await caller.say(Pingreq())
    assert isinstance(await caller.hear(), Pingresp)
    assert not wire._paused


async def test_who_leaves_or_is_closed_while_something_is_withheld(house):
    gone, closed = await house.join("gone"), await house.join("closed")
    for name, caller in (("gone", gone), ("closed", closed)):
        wire = house.protocol(name)
        wire.withhold(0.2)
        await caller.say(Pingreq())
        await until_waiting(wire)
    house.protocol("closed").close()
    gone.writer.transport.abort()
    assert isinstance(await closed.hear(), Pingresp)
    with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
        await closed.hear()


async def until_waiting(wire):
    deadline = time.monotonic() + 20
    while not wire._waiting:
        assert time.monotonic() < deadline, "nothing was answered"
        await asyncio.sleep(0.005)


def test_bytes_that_nobody_has_read():
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(server.getsockname())
        far, _ = server.accept()
        with near, far:
            assert not contact(near).has_unread
            far.send(b"x")
            deadline = time.monotonic() + 20
            while not contact(near).has_unread:
                assert time.monotonic() < deadline, "the byte does not come"
        assert contact(near) == Contact(silence=math.inf)  # it is closed
        Probe(near).end()


def test_a_unix_socket_is_on_this_computer():
    near, far = socket.socketpair()
    with near, far:
        assert contact(near) == HERE
        far.send(b"x")
        assert contact(near).has_unread
        Probe(near).end()
