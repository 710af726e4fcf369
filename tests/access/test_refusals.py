"""Refusals: the bytes that a client gets, the line in the log, and the state that is unchanged.

Each on the wire of a running appliance, in both versions, through TLS and without.
"""

from __future__ import annotations

import socket
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
from appliance_process import HOST, ApplianceProcess
from raw_client import RawClient
from waiting import PATIENCE, eventually

from appliance.mqtt.codec import Property
from appliance.mqtt.packets import (
    Disconnect,
    Packet,
    Puback,
    Publish,
    Pubrel,
    Subscribe,
    Subscription,
    Will,
)

ACL = """\
user alice
topic read {robot}/#
topic deny {robot}/secret/#
topic write {robot}/cmd_vel/#

user bob
topic readwrite {robot}/#
"""

#: CONNACK "not authorized", by version.
NOT_AUTHORIZED = {4: b"\x20\x02\x00\x05", 5: b"\x20\x03\x00\x87\x00"}
#: CONNACK "client identifier not valid".
NOT_YOUR_ID = {4: b"\x20\x02\x00\x02", 5: b"\x20\x03\x00\x85\x00"}

QOS = [0, 1, 2]
both_versions = pytest.mark.parametrize("version", [4, 5], ids=["v311", "v5"])
both_ways = pytest.mark.parametrize("tls", [True, False], ids=["tls", "plain"])


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    process = ApplianceProcess(
        tmp_path_factory.mktemp("robot"),
        users={"bob": "b"},
        acl=ACL,
        broker={"limits": {"connect_timeout": f"{PATIENCE:g} s"}},
    )
    process.start()
    yield process
    process.stop()


Open = Callable[..., RawClient]


@pytest.fixture
def client(robot: ApplianceProcess, version: int, tls: bool) -> Iterator[Open]:
    """Makes clients of this version and kind; with an id, they have been let in."""
    opened: list[RawClient] = []

    def open_client(client_id: str | None = None, user: str = "alice", **fields: Any) -> RawClient:
        opened.append(RawClient(robot, version, tls=tls))
        if client_id is not None:
            answer = opened[-1].connect(client_id, user, **fields)
            assert answer[3] == 0, answer
        return opened[-1]

    yield open_client
    for one in opened:
        one.socket.close()


def watch(client: Open, name: str, topic_filter: str) -> RawClient:
    """bob, who sees everything."""
    watcher = client(f"watcher-{name}", "bob")
    watcher.send(Subscribe(1, [Subscription(topic_filter, 2)]))
    assert watcher.receive()[0] == 0x90
    return watcher


def acknowledge(client: RawClient, packets: list[Packet]) -> list[tuple[str, bytes]]:
    """topic and payload of the messages among the packets, which are all of QoS 0 or 1."""
    told = []
    for packet in packets:
        assert isinstance(packet, Publish), packet
        told.append((packet.topic, packet.payload))
        if packet.packet_id:
            client.send(Puback(packet.packet_id))
    return told


def publish(client: RawClient, topic: str, payload: bytes, retain: bool = False) -> None:
    """Publish with QoS 1, and see it accepted."""
    packet_id = next(client.packet_ids)
    client.send(Publish(topic, payload, 1, retain, packet_id=packet_id))
    answer = client.decode(client.receive())
    assert isinstance(answer, Puback) and answer.reason_code < 0x80


# --- CONNECT


@pytest.mark.statement("3.1.1", "MQTT-3.2.2-4", "MQTT-3.2.2-5")
@both_versions
@both_ways
@pytest.mark.parametrize(
    ("user", "password", "who", "why"),
    [
        ("alice", "wrong", "user 'alice'", "wrong password for user 'alice'"),
        ("alice", "", "user 'alice'", "wrong password for user 'alice'"),
        ("alice", "b", "user 'alice'", "wrong password for user 'alice'"),  # it is bob's
        ("mallory", "x", "user 'mallory'", "unknown user 'mallory'"),
        (None, None, "no user name", "no user name, and anonymous is off"),
    ],
)
def test_who_is_not_let_in(
    robot: ApplianceProcess,
    client: Open,
    version: int,
    name: str,
    user: str | None,
    password: str | None,
    who: str,
    why: str,
) -> None:
    stranger = client()
    assert stranger.connect(name, user, password) == NOT_AUTHORIZED[version]
    assert stranger.receive() == b""
    (line,) = robot.wait_for_log(f"client '{name}'")
    assert line.endswith(f"client '{name}' ({who}) at {stranger.address} refused: {why}")
    assert " WARNING " in line


@both_versions
@both_ways
def test_no_password(robot: ApplianceProcess, client: Open, version: int, name: str) -> None:
    stranger = client()
    connect = bytearray.fromhex("00044d515454") + bytes((version, 0x82, 0, 0))  # no password flag
    connect += b"\0" * (version == 5)
    for text in (name, "alice"):
        connect += len(text).to_bytes(2, "big") + text.encode()
    stranger.socket.sendall(bytes((0x10, len(connect))) + connect)
    assert stranger.receive() == NOT_AUTHORIZED[version]
    assert stranger.receive() == b""
    (line,) = robot.wait_for_log(f"client '{name}'")
    assert line.endswith("refused: no password for user 'alice'")


@both_ways
@pytest.mark.parametrize("version", [5])
def test_a_password_without_a_user(
    robot: ApplianceProcess, client: Open, version: int, name: str
) -> None:
    stranger = client()
    password = robot.passwords["alice"]
    assert stranger.connect(name, None, password) == NOT_AUTHORIZED[5]  # 3.1.1 has no such CONNECT
    robot.wait_for_log(f"client '{name}' \\(no user name\\).* anonymous is off")


@pytest.mark.parametrize("maximum", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
@pytest.mark.parametrize("trusts", ["nobody", "another name"])
def test_without_the_authority(
    robot: ApplianceProcess, maximum: ssl.TLSVersion, trusts: str
) -> None:
    context = robot.tls_context() if trusts == "another name" else ssl.create_default_context()
    context.maximum_version = maximum
    dialled = "robot.example" if trusts == "another name" else HOST
    with socket.create_connection((HOST, robot.port), PATIENCE) as connection:
        host, port = connection.getsockname()[:2]
        with pytest.raises(ssl.SSLCertVerificationError):
            context.wrap_socket(connection, server_hostname=dialled)
    (line,) = robot.wait_for_log(f"{host}:{port}: no TLS connection")
    assert "the client does not trust our certificate; does it have ca.crt?" in line


def test_what_is_not_meant_for_this_port(robot: ApplianceProcess) -> None:
    with RawClient(robot, 4) as plain:
        plain.socket.close()
        plain.socket = socket.create_connection((HOST, robot.port), PATIENCE)
        plain.socket.sendall(plain.connect_packet("x"))
        robot.wait_for_log(f"{plain.address}: no TLS connection: what it sent is not TLS")
    with socket.create_connection((HOST, robot.plain_port), PATIENCE) as connection:
        host, port = connection.getsockname()[:2]
        with pytest.raises((ssl.SSLError, ConnectionError)):
            robot.tls_context().wrap_socket(connection, server_hostname=HOST)
        robot.wait_for_log(f"{host}:{port} ")


# --- PUBLISH and SUBSCRIBE


@pytest.mark.statement("3.1.1", "MQTT-3.3.5-2")
@both_versions
@both_ways
@pytest.mark.parametrize("qos", QOS)
@pytest.mark.parametrize(
    ("level", "why"),
    [
        ("odom", r"acl\.conf: no rule lets user 'alice' (write|publish to) '{}'"),
        ("secret", r"acl\.conf:3: topic deny r2d2/secret/#"),
    ],
)
def test_a_refused_publish(
    robot: ApplianceProcess,
    client: Open,
    version: int,
    name: str,
    qos: int,
    level: str,
    why: str,
) -> None:
    topic = f"r2d2/{level}/{name}"
    watcher = watch(client, name, topic)
    alice = client(f"alice-{name}")
    alice.send(Publish(topic, b"x", qos, retain=True, packet_id=7 if qos else None))
    if qos:
        first = 0x40 if qos == 1 else 0x50
        answer = bytes((first, 2, 0, 7)) if version == 4 else bytes((first, 3, 0, 7, 0x87))
        assert alice.receive() == answer
    if qos == 2 and version == 4:  # 3.1.1 cannot refuse: the exchange goes on, to nothing
        alice.send(Pubrel(7))
        assert alice.receive() == b"\x70\x02\x00\x07"
    assert alice.drain() == []
    assert watcher.drain() == []
    assert watch(client, f"late-{name}", topic).drain() == []  # nor is it retained
    (line,) = robot.wait_for_log(
        f"client 'alice-{name}' \\(user 'alice'\\).* may not publish to '{topic}': "
        + why.format(topic)
    )
    assert " WARNING " in line


@both_versions
@both_ways
def test_an_allowed_publish_beside_refused_ones(client: Open, version: int, name: str) -> None:
    watcher = watch(client, name, f"r2d2/+/{name}")
    alice = client(f"alice-{name}")
    for number, level in enumerate(("odom", "cmd_vel", "odom", "secret", "cmd_vel"), 1):
        topic = f"r2d2/{level}/{name}"
        alice.send(Publish(topic, bytes((number,)), 1, packet_id=number))
    codes = [packet.reason_code for packet in alice.drain() if isinstance(packet, Puback)]
    assert codes == ([0] * 5 if version == 4 else [0x87, 0, 0x87, 0x87, 0])
    received = acknowledge(watcher, watcher.drain())
    assert received == [(f"r2d2/cmd_vel/{name}", b"\2"), (f"r2d2/cmd_vel/{name}", b"\5")]


@both_versions
@both_ways
def test_a_refused_subscribe(
    robot: ApplianceProcess, client: Open, version: int, name: str
) -> None:
    alice, bob = client(f"alice-{name}"), client(f"bob-{name}", "bob")
    allowed, silent, denied = f"r2d2/+/{name}", f"other/{name}", f"r2d2/secret/{name}"
    publish(bob, denied, b"retained", retain=True)
    filters = [Subscription(text, 1) for text in (silent, allowed, denied)]
    alice.send(Subscribe(9, filters))
    if version == 4:
        assert alice.receive() == b"\x90\x05\x00\x09\x80\x01\x80"
    else:
        assert alice.receive() == b"\x90\x06\x00\x09\x00\x87\x01\x87"
    publish(bob, denied, b"live")
    publish(bob, f"r2d2/odom/{name}", b"odom")
    # What is denied does not come by way of a wider filter either.
    assert acknowledge(alice, alice.drain()) == [(f"r2d2/odom/{name}", b"odom")]
    who = f"client 'alice-{name}' \\(user 'alice'\\).*"
    robot.wait_for_log(
        f"{who} may not subscribe to '{silent}': acl.conf: no rule lets user 'alice' "
        f"(subscribe to|read) '{silent}'"
    )
    (line,) = robot.wait_for_log(f"{who} may not subscribe to '{denied}': ")
    assert "acl.conf:3: topic deny r2d2/secret/#" in line
    publish(bob, denied, b"", retain=True)


@both_versions
@both_ways
def test_a_refused_will(robot: ApplianceProcess, client: Open, version: int, name: str) -> None:
    watcher = watch(client, name, f"r2d2/+/{name}")
    for level in ("odom", "cmd_vel"):  # the second is allowed, and comes after the first
        dying = client(f"{level}-{name}", will=Will(f"r2d2/{level}/{name}", b"gone", 1))
        dying.kill()
        robot.wait_for_log(f"client '{level}-{name}'.*connection lost")
    assert acknowledge(watcher, watcher.drain()) == [(f"r2d2/cmd_vel/{name}", b"gone")]
    robot.wait_for_log(f"client 'odom-{name}'.* may not publish to 'r2d2/odom/{name}'")


@both_versions
@pytest.mark.parametrize("tls", [False], ids=["plain"])
def test_a_will_on_a_topic_of_the_appliance_itself(
    robot: ApplianceProcess, client: Open, version: int, name: str
) -> None:
    own, allowed = f"r2d2/_appliance/{name}", f"r2d2/cmd_vel/{name}"
    watcher = watch(client, name, f"r2d2/+/{name}")
    for number, topic in enumerate((own, allowed)):  # bob may write both by the rules
        client(f"{number}-{name}", "bob", will=Will(topic, b"gone", 1)).kill()
        robot.wait_for_log(f"client '{number}-{name}'.*connection lost")
    came: list[tuple[str, bytes]] = []

    def has_come() -> bool:
        came.extend(acknowledge(watcher, watcher.drain()))
        return bool(came)

    eventually(has_come, "the will that is allowed")
    assert came == [(allowed, b"gone")]
    robot.wait_for_log(f"client '0-{name}'.* may not publish to '{own}': .* the broker's own")


def test_explain_names_the_file_and_the_line(robot: ApplianceProcess) -> None:
    def explain(user: str, topic: str) -> list[str]:
        command = [sys.executable, "-m", "appliance", "acl", "explain", user, topic]
        command += ["-c", str(robot.config)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=PATIENCE)
        return [" ".join(line.split()) for line in done.stdout.splitlines()]

    lines = explain("alice", "r2d2/secret/x")
    assert lines[0] == "user 'alice', 'r2d2/secret/x':"
    denied = "refused acl.conf:3: topic deny r2d2/secret/#"
    for verb in ("read", "write", "subscribe"):
        assert any(line.startswith(f"{verb} {denied}") for line in lines), lines
    lines = explain("alice", "r2d2/cmd_vel/x")
    assert any(line.startswith("write allowed acl.conf:4: topic write r2d2") for line in lines)
    assert any(line.startswith("read allowed acl.conf:2: topic read r2d2/#") for line in lines)
    lines = explain("bob", "elsewhere")
    assert any("no rule lets user 'bob'" in line for line in lines)


# --- Another's client id


class Stranger(NamedTuple):
    """Somebody who is not alice, and the CONNACK for them by version."""

    user: str | None
    password: str | None
    refusal: dict[int, bytes]


strangers = pytest.mark.parametrize(
    "stranger",
    [
        Stranger("alice", "wrong", NOT_AUTHORIZED),
        Stranger("mallory", "x", NOT_AUTHORIZED),
        Stranger(None, None, NOT_AUTHORIZED),
        Stranger("bob", None, NOT_YOUR_ID),  # with his right password
    ],
    ids=["wrong-password", "unknown-user", "no-user", "another-user"],
)


class Victim:
    """alice with a session that lasts, a subscription and a will."""

    def __init__(self, client: Open, version: int, name: str) -> None:
        self.client = client
        self.name = name
        self.client_id = f"victim-{name}"
        self.topic = f"r2d2/odom/{name}"
        self.will = Will(f"r2d2/cmd_vel/{name}", b"the victim's", 1)
        expiry = {Property.SESSION_EXPIRY_INTERVAL: 600}
        self.lasting: dict[str, Any] = {
            "clean": False,
            "properties": expiry if version == 5 else None,
        }

    def connect(self) -> RawClient:
        return self.client(self.client_id, will=self.will, **self.lasting)

    def subscribed(self) -> RawClient:
        connection = self.connect()
        connection.send(Subscribe(1, [Subscription(self.topic, 1)]))
        assert connection.receive()[0] == 0x90
        return connection

    def attack(self, stranger: Stranger) -> None:
        """CONNECTs that would end, take over or change the session."""
        user, password, refusal = stranger
        will = Will(f"r2d2/cmd_vel/{self.name}", b"the stranger's", 1)
        for clean in (True, False):
            client = self.client()
            fields = {**self.lasting, "clean": clean, "will": will}
            answer = client.connect(self.client_id, user, password, **fields)
            assert answer == refusal[client.version]
            assert client.receive() == b""


@pytest.fixture
def victim(client: Open, version: int, name: str) -> Victim:
    return Victim(client, version, name)


@both_versions
@both_ways
@strangers
def test_a_stranger_does_not_touch_a_connected_client(
    robot: ApplianceProcess, client: Open, name: str, victim: Victim, stranger: Stranger
) -> None:
    connection = victim.subscribed()
    watcher = watch(client, name, f"r2d2/cmd_vel/{name}")
    victim.attack(stranger)
    assert connection.drain() == []
    publish(watcher, victim.topic, b"still here")
    assert acknowledge(connection, connection.drain()) == [(victim.topic, b"still here")]
    assert watcher.drain() == []  # no will, neither the victim's nor the stranger's
    connection.kill()
    robot.wait_for_log(f"client '{victim.client_id}'.*connection lost")
    received = acknowledge(watcher, watcher.drain())
    assert received == [(f"r2d2/cmd_vel/{name}", b"the victim's")]
    lines = robot.wait_for_log(f"client '{victim.client_id}'.* refused: ", 2)
    if stranger.user == "bob":
        belongs = (
            f"client id '{victim.client_id}' belongs to client '{victim.client_id}' (user 'alice')"
        )
        assert all(line.endswith(belongs) for line in lines)


@both_versions
@both_ways
@strangers
def test_a_stranger_does_not_touch_an_absent_client(
    client: Open, name: str, victim: Victim, stranger: Stranger
) -> None:
    bob = client(f"bob-{name}", "bob")
    connection = victim.subscribed()
    publish(bob, victim.topic, b"in flight")
    (packet,) = connection.drain()  # and not acknowledged
    connection.send(Disconnect())
    assert connection.receive() == b""
    publish(bob, victim.topic, b"before")
    victim.attack(stranger)
    publish(bob, victim.topic, b"after")
    back = victim.client()
    answer = back.connect(victim.client_id, will=victim.will, **victim.lasting)
    assert answer[2:4] == b"\1\0"  # session present
    received = back.drain()
    first = received[0]
    assert isinstance(packet, Publish) and isinstance(first, Publish)
    assert first.dup and first.packet_id == packet.packet_id
    texts = [b"in flight", b"before", b"after"]
    assert acknowledge(back, received) == [(victim.topic, text) for text in texts]
    publish(bob, victim.topic, b"live")
    assert acknowledge(back, back.drain()) == [(victim.topic, b"live")]


@strangers
@pytest.mark.parametrize("version", [5])
@pytest.mark.parametrize("tls", [True], ids=["tls"])
def test_a_stranger_does_not_hold_up_a_delayed_will(
    client: Open, name: str, victim: Victim, stranger: Stranger
) -> None:
    victim.will.properties = {Property.WILL_DELAY_INTERVAL: 1}
    watcher = watch(client, name, f"r2d2/cmd_vel/{name}")
    victim.connect().kill()
    victim.attack(stranger)
    will = watcher.decode(watcher.receive())
    assert isinstance(will, Publish) and will.payload == b"the victim's"


@both_versions
@both_ways
def test_a_client_id_belongs_to_nobody_when_its_session_has_ended(
    client: Open, version: int, name: str
) -> None:
    alice = client(name)
    alice.send(Disconnect())
    assert alice.receive() == b""
    bob = client(name, "bob")
    assert bob.drain() == []


# --- What comes behind a refused CONNECT


@pytest.mark.statement("3.1.1", "MQTT-3.1.4-5")
@both_versions
@both_ways
@pytest.mark.parametrize("size", [10, 200_000])
@strangers
def test_what_comes_behind_a_refused_connect_has_no_effect(
    client: Open, version: int, name: str, victim: Victim, size: int, stranger: Stranger
) -> None:
    connection = victim.subscribed()
    topic = f"r2d2/cmd_vel/{name}"
    watcher = watch(client, name, topic)
    attacker = client()
    behind: list[Packet] = [
        Publish(topic, b"x" * size, 0, retain=True),
        Publish(topic, b"x" * size, 1, packet_id=1),
        Publish(topic, b"x" * size, 2, packet_id=2),
        Pubrel(2),
        Subscribe(3, [Subscription("r2d2/#", 1)]),
    ]
    data = attacker.connect_packet(victim.client_id, stranger.user, stranger.password)
    data += b"".join(packet.encode(version) for packet in behind)
    data += attacker.connect_packet(victim.client_id)  # this would be right
    try:
        attacker.socket.sendall(data)
        assert attacker.receive() == stranger.refusal[version]
        assert attacker.receive() == b""
    except (ConnectionError, ssl.SSLError):
        # It was closed upon while it was still sending: then the answer may be lost on its way.
        assert size > 10
    assert watcher.drain() == []
    assert connection.drain() == []
    assert watch(client, f"late-{name}", topic).drain() == []


@both_versions
@both_ways
def test_what_comes_behind_an_accepted_connect_is_done(
    client: Open, version: int, name: str
) -> None:
    topic = f"r2d2/cmd_vel/{name}"
    alice = client()
    subscribe = Subscribe(1, [Subscription(topic, 0)])
    data = alice.connect_packet(name) + subscribe.encode(version)
    alice.socket.sendall(data + Publish(topic, b"x" * 200_000).encode(version))
    assert alice.receive()[3] == 0
    assert alice.receive()[0] == 0x90
    message = alice.decode(alice.receive())
    assert isinstance(message, Publish) and len(message.payload) == 200_000
    assert alice.drain() == []


@pytest.mark.statement("3.1.1", "MQTT-3.1.0-1")
@both_versions
@both_ways
def test_nothing_comes_before_connect(
    robot: ApplianceProcess, client: Open, version: int, name: str
) -> None:
    topic = f"r2d2/cmd_vel/{name}"
    watcher = watch(client, name, topic)
    stranger = client()
    stranger.socket.sendall(
        Publish(topic, b"x", retain=True).encode(version) + stranger.connect_packet(name)
    )
    assert stranger.receive() == b""
    assert watcher.drain() == []
    robot.wait_for_log(f"{stranger.address} broke the protocol: a PUBLISH may not come before")
