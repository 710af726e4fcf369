"""The whole appliance, in a process of its own: its start, its state, a reload, its stop."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
import uvloop
from appliance_process import ACL, ApplianceProcess
from waiting import PATIENCE

from appliance import config
from appliance.access import Passwords
from appliance.app import main
from appliance.app.main import App
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
    decode_packet,
)
from appliance.mqtt.reason import ReasonCode


class Peer:
    """A blocking MQTT 5 client of a few lines, over the plain listener."""

    def __init__(self, process: ApplianceProcess, user: str) -> None:
        self._socket = process.open(tls=False)
        self._socket.settimeout(PATIENCE)
        password = process.passwords[user].encode()
        self.send(Connect(f"{user}-peer", username=user, password=password))
        answer = self.read()
        assert isinstance(answer, Connack)
        assert answer.reason_code == ReasonCode.SUCCESS

    def send(self, packet: Packet) -> None:
        self._socket.sendall(packet.encode(5))

    def read(self) -> Packet | None:
        """The next packet; None when the connection has ended."""
        header = self._exactly(2)
        if len(header) < 2:
            return None
        assert header[1] < 0x80, "these tests send and receive little"
        return decode_packet(header[0], self._exactly(header[1]), 5)

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size and (chunk := self._socket.recv(size - len(data))):
            data += chunk
        return data

    def publish(self, topic: str) -> int:
        """The reason code of the PUBACK."""
        self.send(Publish(topic, b"1", 1, packet_id=1))
        answer = self.read()
        assert isinstance(answer, Puback)
        return answer.reason_code

    def subscribe(self, topic_filter: str) -> int:
        """The reason code of the SUBACK."""
        self.send(Subscribe(1, [Subscription(topic_filter, 1)]))
        answer = self.read()
        assert isinstance(answer, Suback)
        return answer.reason_codes[0]

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def process(tmp_path: Path):
    process = ApplianceProcess(
        tmp_path,
        users={"bob": "bobs password"},
        acl=ACL,
        broker={"limits": {"connect_timeout": f"{PATIENCE:g} s"}},
    )
    process.start()
    yield process
    process.stop()


def reload(process: ApplianceProcess, says: str) -> None:
    os.kill(process.pid, signal.SIGHUP)
    process.wait_for_log(says)


def test_it_says_that_it_is_online_and_refuses_what_is_the_brokers_own(process) -> None:
    alice = Peer(process, "alice")

    assert alice.subscribe("r2d2/_appliance/state") == ReasonCode.GRANTED_QOS_1
    state = alice.read()
    assert isinstance(state, Publish)
    assert (state.payload, state.retain) == (b"online", True)
    for topic in ("$SYS/broker/version", "r2d2/_appliance/state", "r2d2/_appliance/upstream/x"):
        assert alice.publish(topic) == ReasonCode.NOT_AUTHORIZED
    assert alice.publish("r2d2/_appliances") == ReasonCode.NO_MATCHING_SUBSCRIBERS
    alice.close()


def test_a_stop_tells_every_client_why(process) -> None:
    alice = Peer(process, "alice")
    process.stop()

    answer = alice.read()
    assert isinstance(answer, Disconnect)
    assert answer.reason_code == ReasonCode.SERVER_SHUTTING_DOWN
    assert alice.read() is None


def test_a_reload_takes_rights_and_users_away_from_those_who_are_connected(process) -> None:
    alice, bob = Peer(process, "alice"), Peer(process, "bob")
    assert alice.publish("r2d2/arm") == ReasonCode.NO_MATCHING_SUBSCRIBERS
    (process.directory / "acl.conf").write_text("user alice\ntopic read r2d2/#\n")
    users = Passwords.load(process.directory / "users.passwd")
    users.remove("bob")
    users.save()

    reload(process, "reload: reloaded: users removed: bob, access rules")

    assert alice.publish("r2d2/arm") == ReasonCode.NOT_AUTHORIZED
    farewell = bob.read()
    assert isinstance(farewell, Disconnect)
    assert farewell.reason_code == ReasonCode.ADMINISTRATIVE_ACTION
    alice.close()
    bob.close()


def test_a_broken_acl_leaves_the_one_in_force(process) -> None:
    alice = Peer(process, "alice")
    (process.directory / "acl.conf").write_text("user alice\ntopc write r2d2/#\ntopc x\n")

    reload(process, r"not reloaded.*acl\.conf:2[^\\]*; [^\\]*acl\.conf:3")

    assert alice.publish("r2d2/arm") == ReasonCode.NO_MATCHING_SUBSCRIBERS
    alice.close()


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        process = ApplianceProcess(tmp_path)
        text = process.config.read_text().replace("127.0.0.1:0", f"127.0.0.1:{port}", 1)
        process.config.write_text(text)
        with pytest.raises(
            AssertionError, match=rf"127\.0\.0\.1:{port} .*in use already; `appliance doctor`"
        ):
            process.start()


def hang_up(file: Path) -> None:
    os.kill(os.getpid(), signal.SIGHUP)


def edit(file: Path) -> None:
    file.write_text(file.read_text() + "log: {level: debug}\n")


def small(directory: Path) -> Path:
    """A configuration with all its files and nothing of the computer: no ROS, no known port."""
    file = directory / "appliance.yaml"
    file.write_text(
        "robot: r2d2\nbroker: {anonymous: true, listeners: [{bind: '127.0.0.1:0'}]}\n"
        "bridge: {bus: none}\n"
    )
    (directory / "acl.conf").write_text("topic #\n")
    (directory / "users.passwd").touch(0o600)
    return file


@pytest.mark.parametrize("ask", [hang_up, edit])
def test_a_reload_during_the_start_comes_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ask: Callable[[Path], None]
) -> None:
    file = small(tmp_path)
    own = App.start
    reloaded: list[object] = []

    async def start(app: App) -> None:
        ask(file)
        await own(app)

    async def reload(app: App) -> list[str]:
        reloaded.append(app.addresses)
        app.request_stop()
        return []

    monkeypatch.setattr(App, "start", start)
    monkeypatch.setattr(App, "reload", reload)
    uvloop.run(asyncio.wait_for(App(config.load(file)).run(), PATIENCE))
    assert len(reloaded) == 1 and reloaded[0]


def test_garbage_is_collected_from_the_end_of_the_start_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During the start it is not, whatever that restores; and not to go on would be a leak."""
    file = small(tmp_path)
    own = App.start
    during: list[bool] = []
    afterwards: list[bool] = []

    async def start(app: App) -> None:
        during.append(gc.isenabled())
        await own(app)
        asyncio.get_running_loop().call_later(0.05, ended, app)

    def ended(app: App) -> None:
        afterwards.append(gc.isenabled())
        app.request_stop()

    monkeypatch.setattr(App, "start", start)
    thresholds = gc.get_threshold()
    try:
        assert main.run(config.load(file)) == 0
    finally:
        gc.set_threshold(*thresholds)
    assert (during, afterwards) == ([False], [True])
    file.write_text(file.read_text().replace("127.0.0.1:0", "192.0.2.1:1"))  # nobody's address
    with pytest.raises(OSError, match=r"192\.0\.2\.1:1"):
        main.run(config.load(file))
    assert gc.isenabled()
