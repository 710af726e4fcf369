"""Rights that change while clients are connected: each takes effect, and nobody else notices."""

from __future__ import annotations

import itertools
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from raw_client import RawClient

from appliance.access import Passwords
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Connack,
    Disconnect,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    Will,
)
from appliance.mqtt.reason import ReasonCode

BEFORE = """\
user alice
topic readwrite {robot}/#

user bob
topic read {robot}/#
topic write {robot}/bob/#

user carol
topic read {robot}/#
"""

#: bob may read less, and write nothing any more.
AFTER = BEFORE.replace(
    "topic read {robot}/#\ntopic write {robot}/bob/#\n", "topic read {robot}/open/#\n"
)

KEPT = {Property.SESSION_EXPIRY_INTERVAL: 60}

_ids = itertools.count(1)


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[ApplianceProcess]:
    process = ApplianceProcess(tmp_path, users={"bob": "bob's", "carol": "carol's"}, acl=BEFORE)
    process.start()
    yield process
    process.stop()


def log_in(robot: ApplianceProcess, user: str, client_id: str = "", **fields: Any) -> RawClient:
    client = RawClient(robot, 5, tls=True)
    answer = client.decode(client.connect(client_id or user, user, **fields))
    assert isinstance(answer, Connack) and answer.reason_code == 0, answer
    return client


def subscribe(client: RawClient, *filters: str) -> list[int]:
    client.send(Subscribe(next(_ids), [Subscription(name, 1) for name in filters]))
    while not isinstance(answer := client.decode(client.receive()), Suback):
        pass
    return list(answer.reason_codes)


def publish(client: RawClient, *topics: str, retain: bool = False) -> list[int]:
    codes = []
    for topic in topics:
        packet_id = next(_ids)
        client.send(Publish(topic, topic.encode(), 1, retain, packet_id=packet_id))
        while not isinstance(answer := client.decode(client.receive()), Puback):
            pass
        codes.append(int(answer.reason_code))
    return codes


def topics(client: RawClient) -> list[str]:
    """What came since this was last asked, each acknowledged."""
    received = [packet for packet in client.drain() if isinstance(packet, Publish)]
    client.send(*(Puback(packet.packet_id) for packet in received if packet.packet_id))
    return [packet.topic for packet in received if "/_appliance/" not in packet.topic]


def reload(robot: ApplianceProcess, *, says: str = "reload: reloaded: ") -> None:
    assert robot._process is not None
    count = len([line for line in robot.log.splitlines() if says in line])
    robot._process.send_signal(signal.SIGHUP)
    robot.wait_for_log(says, count + 1)


@pytest.mark.timed
def test_a_narrowed_acl_takes_just_what_it_says(robot: ApplianceProcess, tmp_path: Path) -> None:
    alice, bob, carol = log_in(robot, "alice"), log_in(robot, "bob"), log_in(robot, "carol")
    for client in (bob, carol):
        assert subscribe(client, "r2d2/#", "$share/group/r2d2/shared/#") == [1, 1]
    absent = log_in(robot, "bob", "bob-absent", properties=KEPT)
    assert subscribe(absent, "r2d2/#") == [1]
    absent.kill()
    # What waits in a session for its will: it may be published no more when its time comes.
    doomed = log_in(
        robot,
        "bob",
        "bob-doomed",
        properties=KEPT,
        will=Will("r2d2/bob/gone", b"", 1, properties={Property.WILL_DELAY_INTERVAL: 1}),
    )
    doomed.kill()
    robot.wait_for_log("'bob-doomed' .*connection lost")
    both = ["r2d2/closed/x", "r2d2/open/x"]
    assert publish(alice, *both, retain=True) == [0, 0]
    assert publish(alice, *both) == [0, 0]
    assert sorted(topics(bob)) == sorted(topics(carol)) == sorted(both * 2)

    (tmp_path / "acl.conf").write_text(AFTER)
    began = time.monotonic()
    reload(robot)
    assert time.monotonic() - began < 2

    # The routes that were known are known no more, and nobody was disconnected.
    assert publish(alice, *both) == [0, 0]
    assert topics(bob) == ["r2d2/open/x"]
    assert topics(carol) == both
    assert publish(bob, "r2d2/bob/x") == [ReasonCode.NOT_AUTHORIZED]
    # Of a group, those who may read it get all of it.
    assert publish(alice, *["r2d2/shared/x"] * 6) == [0] * 6
    assert topics(bob) == []
    assert topics(carol) == ["r2d2/shared/x"] * 12  # six of the group, six of its own
    # Retained: not what may not be read, also by a subscription that stands.
    assert subscribe(bob, "r2d2/#") == [1]
    assert topics(bob) == ["r2d2/open/x"]
    assert subscribe(bob, "r2d2/closed/#", "r2d2/open/#") == [ReasonCode.NOT_AUTHORIZED, 1]
    topics(bob)
    # Queued before, asked for after.
    absent = log_in(robot, "bob", "bob-absent", clean=False, properties=KEPT)
    assert set(topics(absent)) == {"r2d2/open/x"}
    # The will was due meanwhile, or is in a moment.
    robot.wait_for_log("bob-doomed.* may not publish to 'r2d2/bob/gone'")
    assert "r2d2/bob/gone" not in topics(carol)

    (tmp_path / "acl.conf").write_text(BEFORE)
    reload(robot)
    assert publish(alice, *both) == [0, 0]
    assert topics(bob) == both  # the subscription that it had
    assert publish(bob, "r2d2/bob/x") == [0]
    for client in (alice, bob, carol, absent):
        client.kill()


@pytest.mark.timed
def test_a_user_removed_is_gone_and_its_password_with_it(
    robot: ApplianceProcess, tmp_path: Path
) -> None:
    alice, carol = log_in(robot, "alice"), log_in(robot, "carol")
    bobs = [log_in(robot, "bob", f"bob-{number}") for number in range(3)]
    subscribe(carol, "r2d2/#")
    users = Passwords.load(tmp_path / "users.passwd")
    users.remove("bob")
    users.save()
    began = time.monotonic()
    reload(robot)
    for bob in bobs:
        packet = bob.decode(bob.receive())
        assert isinstance(packet, Disconnect)
        assert packet.reason_code == ReasonCode.ADMINISTRATIVE_ACTION
        assert bob.receive() == b""
    assert time.monotonic() - began < 2
    again = RawClient(robot, 5, tls=True)
    refused = again.decode(again.connect("bob-0", "bob"))
    assert isinstance(refused, Connack) and refused.reason_code == ReasonCode.NOT_AUTHORIZED
    assert publish(alice, "r2d2/x") == [0]
    assert topics(carol) == ["r2d2/x"]
    for client in (alice, carol, again, *bobs):
        client.kill()


def test_a_new_password_leaves_who_is_there_and_refuses_the_old_one(
    robot: ApplianceProcess, tmp_path: Path
) -> None:
    bob = log_in(robot, "bob")
    users = Passwords.load(tmp_path / "users.passwd")
    users.set("bob", "another")
    users.save()
    reload(robot)
    assert subscribe(bob, "r2d2/#") == [1]  # as with mosquitto it is asked for at the next login
    old = RawClient(robot, 5, tls=True)
    refused = old.decode(old.connect("other", "bob", "bob's"))
    assert isinstance(refused, Connack) and refused.reason_code == ReasonCode.NOT_AUTHORIZED
    robot.passwords["bob"] = "another"
    new = log_in(robot, "bob", "new")
    for client in (bob, old, new):
        client.kill()


def test_a_broken_file_changes_nothing_for_anybody(robot: ApplianceProcess, tmp_path: Path) -> None:
    alice, bob = log_in(robot, "alice"), log_in(robot, "bob")
    subscribe(bob, "r2d2/#")
    users = Passwords.load(tmp_path / "users.passwd")
    users.remove("bob")
    users.save()
    (tmp_path / "acl.conf").write_text(AFTER + "user\n")
    reload(robot, says="not reloaded")
    assert f"{tmp_path}/acl.conf:9:5: a user name is missing" in robot.log
    assert publish(alice, "r2d2/closed/x") == [0]
    assert topics(bob) == ["r2d2/closed/x"]
    for client in (alice, bob):
        client.kill()
