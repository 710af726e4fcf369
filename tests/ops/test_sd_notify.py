"""The conversation with systemd, on a real notify socket and with a real process."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from raw_client import RawClient
from service.supervisor import NotifySocket, Supervised
from waiting import eventually, until

from appliance.broker.faults import Faults
from appliance.net.callbacks import Entries
from appliance.ops.control import ask
from appliance.ops.sd_notify import Notifier

WATCHDOG = 1.0

#: Of one that may stand still for seconds, on a busy computer, with signs of life in time yet.
PATIENT_WATCHDOG = 12.0


def entries(loop: asyncio.AbstractEventLoop | None = None) -> Entries:
    return Entries(loop or asyncio.get_running_loop(), Faults())


@pytest.fixture(params=["abstract", "path"])
def notify(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[NotifySocket]:
    with NotifySocket(tmp_path / "notify" if request.param == "path" else None) as notify:
        yield notify


def test_what_systemd_is_told(tmp_path: Path, notify: NotifySocket) -> None:
    appliance = Supervised(tmp_path / "house")
    appliance.supervise(notify, PATIENT_WATCHDOG)
    appliance.start()
    try:
        with RawClient(appliance, 5, tls=True) as client:  # MQTT answers as soon as it is ready
            client.connect("first")
        assert notify.all("STATUS") == ["0 clients, without ROS"]

        notify.wait(lambda: len(notify.all("WATCHDOG")) >= 4, "signs of life")
        beats = [when for when, fields in notify.messages if "WATCHDOG" in fields]
        assert all(b - a < 0.9 * PATIENT_WATCHDOG for a, b in itertools.pairwise(beats))

        for reloading in (
            lambda: ask(tmp_path / "house/state/control.sock", "reload"),
            lambda: os.kill(appliance.pid, signal.SIGHUP),
        ):
            notify.messages.clear()
            before = time.monotonic_ns() // 1000
            reloading()
            notify.wait(lambda: notify.all("READY"), "READY=1 after the reload")
            first = next(fields for _, fields in notify.messages if "WATCHDOG" not in fields)
            assert first["RELOADING"] == "1"
            assert before < int(first["MONOTONIC_USEC"]) <= time.monotonic_ns() // 1000

        appliance.config.write_text("robot: [")  # a reload that fails has an end, too
        notify.messages.clear()
        os.kill(appliance.pid, signal.SIGHUP)
        notify.wait(lambda: notify.all("READY"), "READY=1 after the reload")
        appliance.wait_for_log("not reloaded")
    finally:
        appliance.stop()
    # The datagrams of an ended process are still to be read.
    notify.wait(lambda: notify.all("STOPPING"), "STOPPING=1")
    said = [fields for _, fields in notify.messages if "WATCHDOG" not in fields]
    assert said[-1] == {"STOPPING": "1", "STATUS": "stopping"}


#: Has the event loop wait for good at the first client. A process that SIGSTOP holds is no such
#: one: its threads go on with SIGCONT, and walking the frames of a thread that runs can crash.
HANGING = """\
import time
from pathlib import Path
from amqtt.plugins.base import BasePlugin

class Hanging(BasePlugin):
    async def on_broker_client_connected(self, **_):
        Path(__file__).with_name("hangs").touch()
        time.sleep(3600)
"""


def test_a_hung_one_leaves_all_threads_tracebacks(tmp_path: Path) -> None:
    (tmp_path / "hanging.py").write_text(HANGING)
    with NotifySocket() as notify:
        _hang(tmp_path / "house", notify)


def _hang(house: Path, notify: NotifySocket) -> None:
    appliance = Supervised(house)
    appliance.supervise(notify, WATCHDOG)
    appliance.environment["PYTHONPATH"] = str(house.parent)
    config = yaml.safe_load(appliance.config.read_text())
    config.setdefault("broker", {})["plugins"] = {"hanging.Hanging": {}}
    appliance.config.write_text(yaml.safe_dump(config))
    try:
        appliance.start()
        with RawClient(appliance, 5, tls=True) as client:
            client.socket.sendall(client.connect_packet("any"))
            eventually((house.parent / "hangs").exists, "the plugin to hang")
            assert appliance.watch() == -signal.SIGABRT
        appliance.start()
        (line,) = appliance.wait_for_log("the last run crashed on .*Fatal Python error: Aborted")
        path = Path(line.rpartition(" ")[2])
        assert notify.all("STATUS")[-1].endswith(f"; began after a crash, see {path}")
    finally:
        appliance.stop()
    report = path.read_text()
    assert path.parent == house / "state/crashes" and path.stat().st_mode & 0o777 == 0o600
    # Of the event loop, and where it hangs, and of the store.
    assert "robot: r2d2" in report and report.count("hread 0x") > 1
    assert 'hanging.py", line' in report
    assert 'appliance/app/main.py", line' in report and 'store/writer.py", line' in report
    assert list(path.parent.iterdir()) == [path], "nothing else is left by a clean end"


def test_a_watchdog_for_another_process_is_not_ours() -> None:
    with NotifySocket() as notify:
        for pid, watchdog in (("", 2.5), (str(os.getpid()), 2.5), (str(os.getppid()), None)):
            environment = {
                "NOTIFY_SOCKET": notify.address,
                "WATCHDOG_USEC": "2500000",
                "WATCHDOG_PID": pid,
                "HOME": "/",
            }
            notifier = Notifier.from_environment(environment)
            assert notifier.watchdog == watchdog
            assert environment == {"HOME": "/"}, "children do not inherit them"
            notifier.close()


@pytest.mark.parametrize(
    "address", ["/nowhere/notify", "@nobody", "vsock:2:1", "relative", "", "@"]
)
async def test_nobody_listens(address: str) -> None:
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "many"})
    notifier.start(entries(), lambda: "fine", lambda: True)
    with notifier.reloading():
        notifier.stopping()
    notifier.close()
    notifier.close()


async def test_no_status_spoils_what_systemd_is_told(tmp_path: Path) -> None:
    """It may have in it what a node on the network says. systemd ends lines at `\\r` as well, and
    takes nothing of a datagram with a NUL or with more than 4096 bytes."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(5)
        notifier = Notifier(str(tmp_path / "notify"))
        status = "no ROS:\rMAINPID=1\nWATCHDOG=trigger\0 \ud800" + "€" * 5000
        notifier.start(entries(), lambda: status, lambda: True)
        said = listening.recv(65536)
        notifier.close()
    assert len(said) < 4096 and b"\0" not in said
    names = [line.partition(b"=")[0] for line in said.splitlines()]
    assert names == [b"READY", b"STATUS"]


@pytest.mark.timed
async def test_systemd_does_not_read(tmp_path: Path) -> None:
    """A sign of life that does not fit into the socket's queue holds up nothing."""
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    listening.bind(str(tmp_path / "notify"))
    notifier = Notifier(str(tmp_path / "notify"), 0.002)
    notifier.start(entries(), lambda: "fine", lambda: True)
    began = time.monotonic()
    await asyncio.sleep(0.3)
    assert time.monotonic() - began < 0.8
    notifier.close()
    listening.close()


async def test_what_systemd_did_not_take_is_told_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it waits for READY=1, and ends a service that has long been ready."""
    monkeypatch.setattr("appliance.ops.sd_notify.PATIENCE", 0.01)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            with pytest.raises(BlockingIOError):
                while True:
                    other.sendto(b"X=1", str(tmp_path / "notify"))
        notifier = Notifier(str(tmp_path / "notify"), 0.1)
        notifier.start(entries(), lambda: "fine", lambda: True)
        heard = []
        for _ in range(100):
            with contextlib.suppress(BlockingIOError):
                while True:
                    heard.append(listening.recv(100))
            if b"READY=1" in heard:
                break
            await asyncio.sleep(0.01)
        notifier.close()
        assert b"READY=1" in heard


async def test_a_status_that_fails_does_not_end_the_signs_of_life(
    monkeypatch: pytest.MonkeyPatch, escaped: list[str]
) -> None:
    monkeypatch.setattr("appliance.ops.sd_notify.STATUS_INTERVAL", 0.02)
    own = entries()
    texts = iter(["fine"])
    with NotifySocket() as notify:
        notifier = Notifier(notify.address, 0.1)
        notifier.start(own, lambda: next(texts), lambda: True)
        await until(lambda: own.faults.count > 2 and len(notify.all("WATCHDOG")) > 5)
        notifier.close()
    escaped.clear()


async def test_without_a_sign_of_life_systemd_is_told_none() -> None:
    asked: list[bool] = []

    def is_alive() -> bool:
        asked.append(len(asked) < 2)
        return asked[-1]

    with NotifySocket() as notify:
        notifier = Notifier(notify.address, 0.1)
        notifier.start(entries(), lambda: "fine", is_alive)
        await until(lambda: len(asked) > 6 and len(notify.all("WATCHDOG")) >= 2)
        notifier.close()
        assert len(notify.all("WATCHDOG")) == 2


def test_a_status_is_one_line() -> None:
    with NotifySocket() as notify:
        notifier = Notifier(notify.address)
        loop = asyncio.new_event_loop()
        notifier.start(entries(loop), lambda: "fine\nWATCHDOG=trigger", lambda: True)
        eventually(lambda: notify.messages, "READY=1")
        assert notify.messages[0][1] == {"READY": "1", "STATUS": "fine WATCHDOG=trigger"}
        notifier.close()
        loop.close()
