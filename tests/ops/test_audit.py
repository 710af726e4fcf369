"""The audit log: what is in it, what a flood and a full disk do to it, and what is never in it."""

from __future__ import annotations

import contextlib
import getpass
import json
import logging
import os
import re
import resource
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from raw_client import RawClient
from waiting import PATIENCE, eventually

from appliance.broker.limits import Limits
from appliance.broker.session import Session, SessionAccounting
from appliance.broker.values import Action, Identity, TlsInfo
from appliance.cli import main as cli
from appliance.mqtt.packets import Connack, Disconnect, Publish, Subscribe, Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.ops import audit as audit_module
from appliance.ops.audit import Audit, AuditError, note
from appliance.store.memory import MemoryStore

WRONG = "a wrong password, never to be seen"


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its end waits for all that is to be written, on however slow a computer."""
    monkeypatch.setattr(audit_module, "CLOSE_TIMEOUT", PATIENCE)


def session_of(user: str | None, client_id: str) -> Session:
    accounting = SessionAccounting(Limits(), MemoryStore())
    return Session(client_id, Identity(user, client_id), accounting)


def entries(*paths: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for path in paths for line in path.read_text().splitlines()]


def events(path: Path, event: str) -> list[dict[str, Any]]:
    return [entry for entry in entries(path) if entry["event"] == event]


@contextlib.contextmanager
def open_audit(path: Path, size: int = 1 << 20, keep: int = 3) -> Iterator[Audit]:
    audit = Audit(path, size, keep)
    try:
        yield audit
    finally:
        audit.close()
        audit.close()


# --- the file ------------------------------------------------------------------------------------


def test_what_a_line_holds(tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    before = datetime.now(timezone.utc)
    with open_audit(path) as audit:
        alice = session_of("alice", "tablet")
        audit.connected(alice, "10.0.0.1:1", 5, TlsInfo("TLSv1.3", "tablet.local"))
        audit.refused("10.0.0.1:2", "unknown user 'eve'", 0x87, "c", "eve", TlsInfo())
        audit.refused("10.0.0.1:3", "no TLS connection: nonsense")
        audit.denied(alice, Action.PUBLISH, "a/b", "acl.conf:3: topic read a/#")
        audit.disconnected(alice, "10.0.0.1:1", "connection lost")
        audit.changed("users and access rules", users_removed=["bob"])
    written = entries(path)
    for entry in written:
        told = datetime.fromisoformat(entry.pop("time").replace("Z", "+00:00"))
        assert abs((told - before).total_seconds()) < 5
    who = {"client": "tablet", "user": "alice"}
    assert written == [
        {
            "event": "connected",
            **who,
            "address": "10.0.0.1:1",
            "mqtt": "5",
            "tls": "TLSv1.3",
            "certificate": "tablet.local",
        },
        {
            "event": "refused",
            "client": "c",
            "user": "eve",
            "address": "10.0.0.1:2",
            "tls": None,
            "code": "0x87 Not authorized",
            "reason": "unknown user 'eve'",
        },
        {"event": "refused", "address": "10.0.0.1:3", "reason": "no TLS connection: nonsense"},
        {
            "event": "denied",
            **who,
            "action": "publish",
            "topic": "a/b",
            "reason": "acl.conf:3: topic read a/#",
        },
        {"event": "disconnected", **who, "address": "10.0.0.1:1", "reason": "connection lost"},
        {"event": "changed", "what": "users and access rules", "users_removed": ["bob"]},
    ]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_names_of_strangers_forge_nothing_and_are_cut(tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    with open_audit(path) as audit:
        name = '\n{"event": "changed"}\x1b[2J\u2028' + "x" * 60_000
        audit.refused("10.0.0.1:2", "unknown user", 0x87, name, name)
    text = path.read_bytes()
    assert text.count(b"\n") == 1 and b"\x1b" not in text and text.isascii()
    assert len(text) < 3000


def test_events_are_cut_before_they_wait(tmp_path: Path) -> None:
    audit = Audit(tmp_path / "audit.log", 1 << 20, 3)
    audit.close()  # nothing is taken from the queue any more
    audit.denied(session_of("alice", "c" * 1000), Action.PUBLISH, "t" * 60_000, "r" * 60_000)
    event = audit._queue.get_nowait()
    assert event is not None and event["topic"] == "t" * 256 + "…"
    assert max(map(len, event.values())) == 257


def test_it_is_rotated_by_size_and_so_many_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    with open_audit(path, size=2000, keep=3) as audit:
        for number in range(200):
            audit.changed("x", number=number)
    names = sorted(file.name for file in tmp_path.iterdir())
    assert names == ["audit.log", "audit.log.1", "audit.log.2", "audit.log.3"]
    order = [path.with_name(name) for name in reversed(names)]
    numbers = [entry["number"] for entry in entries(*order)]
    assert numbers == list(range(numbers[0], 200)) and len(numbers) > 60
    assert all(file.stat().st_size <= 2000 for file in order)
    assert all(stat.S_IMODE(file.stat().st_mode) == 0o600 for file in order)


def test_a_file_that_was_moved_away_is_begun_anew(tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    with open_audit(path) as audit:
        audit.changed("first")
        eventually(lambda: path.stat().st_size, "the line is written")
        path.rename(tmp_path / "elsewhere")
        audit.changed("second")
    assert entries(tmp_path / "elsewhere")[0]["what"] == "first"
    assert entries(path)[0]["what"] == "second"


def test_a_flood_is_told_in_part_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    with open_audit(path) as audit:
        for number in range(2000):
            audit.refused(f"10.0.0.1:{number}", "wrong password", 0x87, f"c{number}", "alice")
            time.sleep(0 if number % 100 else 0.002)
        for number in range(1000):  # of one user under many names
            session = session_of("mallory", f"client-{number}")
            audit.denied(session, Action.SUBSCRIBE, "a/#", "no rule")
        audit.refused("10.0.0.2:1", "wrong password", 0x87, "c", "bob")
        audit.changed("certificates")
    refused = events(path, "refused")
    more = events(path, "more")
    assert len(refused) == audit_module.BURST + 1
    assert refused[-1]["user"] == "bob"
    assert [entry["count"] for entry in more] == [2000 - audit_module.BURST, 900]
    assert more[1]["from"] == "mallory"
    assert more[0]["from"] == "10.0.0.1" and more[0]["last"]["client"] == "c1999"
    assert len(events(path, "changed")) == 1


def test_a_flood_of_changes_is_told_in_part_and_hides_no_others(tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    mallory, alice = ({"client": name, "user": name} for name in ("mallory", "alice"))
    with open_audit(path) as audit:
        for number in range(2000):
            who = {"client": f"c{number}", "user": "mallory"}
            audit.changed(
                "client disconnected", id=str(number), by=who, address=f"10.0.0.1:{number}"
            )
            time.sleep(0 if number % 100 else 0.002)
        audit.changed("user added", of="eve", by=mallory, address="10.0.0.1:1")
        audit.changed("client disconnected", id="x", by=alice, address="10.0.0.1:2")
        audit.changed("client disconnected", id="y", by="the control socket")
        audit.changed("users and access rules", users_added=["eve"])
    told = events(path, "changed")
    assert len(told) == audit_module.BURST + 4
    assert [entry.get("by") for entry in told[-4:]] == [mallory, alice, "the control socket", None]
    (more,) = events(path, "more")
    assert (more["of"], more["from"]) == ("changed", "mallory")
    assert more["count"] == 2000 - audit_module.BURST
    assert (more["last"]["what"], more["last"]["id"]) == ("client disconnected", "1999")


def test_what_waits_is_bounded_and_what_is_lost_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit_module, "QUEUE_LIMIT", 100)
    monkeypatch.setattr(audit_module, "RETRY", 0.01)
    monkeypatch.setattr(audit_module, "BURST", 10_000)
    path = tmp_path / "audit.log"
    real, on = os.write, [False]

    def write(descriptor: int, data: bytes) -> int:
        if on[0]:
            return real(descriptor, data)
        time.sleep(0.001)
        raise OSError(28, "No space left on device")

    with open_audit(path) as audit:
        monkeypatch.setattr(os, "write", write)
        for number in range(5000):
            audit.changed("x", number=number)
        eventually(lambda: audit._queue.empty() and audit._lost, "all of it was tried")
        on[0] = True
        audit.changed("last")
    lines = entries(path)
    lost = [entry["count"] for entry in lines if entry["event"] == "lost"]
    assert sum(lost) + len(lines) - len(lost) == 5001
    assert lines[-1]["what"] == "last"


def test_half_a_line_spoils_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(audit_module, "RETRY", 0.01)
    path = tmp_path / "audit.log"
    real, torn = os.write, [True]

    def write(descriptor: int, data: bytes) -> int:
        if torn[0]:
            torn[0] = False
            return real(descriptor, data[: len(data) // 2])
        return real(descriptor, data)

    with open_audit(path) as audit:
        monkeypatch.setattr(os, "write", write)
        audit.changed("torn")
        eventually(lambda: audit._lost or not torn[0], "it was tried")
        audit.changed("whole")
    torn_line, *whole = path.read_text().splitlines()
    with pytest.raises(json.JSONDecodeError):
        json.loads(torn_line)
    assert [json.loads(line).get("what", "lost") for line in whole] == ["lost", "whole"]


def a_directory(path: Path) -> Path:
    path.mkdir()
    return path


def a_pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def in_no_folder(path: Path) -> Path:
    return path / "absent/audit.log"


@pytest.mark.parametrize(
    "make", [a_directory, a_pipe, in_no_folder], ids=lambda make: make.__name__
)
def test_a_path_that_cannot_be(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    with pytest.raises(AuditError, match=r"broker\.audit\.path"):
        Audit(make(tmp_path / "audit"), 1000, 1)


def test_a_file_open_to_others_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "audit.log"
    path.touch(0o644)
    with open_audit(path):
        pass
    assert "chmod 600" in caplog.text


# --- the appliance -------------------------------------------------------------------------------


ACL = """\
user alice
topic readwrite {robot}/#
topic deny {robot}/secret/#

user bob
topic readwrite {robot}/#
"""


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[ApplianceProcess]:
    process = ApplianceProcess(
        tmp_path,
        users={"bob": "bob's password"},
        acl=ACL,
        broker={"audit": {"path": "audit.log"}},
    )
    process.start()
    yield process
    process.stop()


def call(robot: ApplianceProcess, client_id: str, user: str, password: str, tls: bool) -> RawClient:
    client = RawClient(robot, 5, tls=tls)
    client.socket.sendall(client.connect_packet(client_id, user, password))
    return client


def read(client: RawClient) -> Any:
    return client.decode(client.receive())


def log_in(robot: ApplianceProcess, client_id: str, user: str, tls: bool = True) -> RawClient:
    client = call(robot, client_id, user, robot.passwords[user], tls)
    answer = read(client)
    assert isinstance(answer, Connack) and answer.reason_code == 0
    return client


def test_who_came_was_refused_and_left(robot: ApplianceProcess, tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    client = log_in(robot, "tablet", "alice")
    client.send(Subscribe(1, [Subscription("elsewhere/#")]))
    read(client)
    client.send(Publish("r2d2/secret/x", b"payload", 1, packet_id=2))
    read(client)
    client.send(Disconnect())
    client.kill()
    lost = log_in(robot, "phone", "bob", tls=False)
    lost.kill()
    wrong = call(robot, "stranger", "alice", WRONG, True)
    assert read(wrong).reason_code == ReasonCode.NOT_AUTHORIZED
    with robot.open(tls=False) as garbage:
        garbage.sendall(b"GET / HTTP/1.1\r\n\r\n")
        garbage.recv(100)
    eventually(lambda: len(entries(path)) >= 9, "everything is in the file")
    told = {
        (entry["event"], entry.get("client")): entry for entry in entries(path) if "event" in entry
    }
    assert told["connected", "tablet"]["tls"] == "TLSv1.3"
    assert told["connected", "tablet"]["user"] == "alice"
    assert told["connected", "phone"]["tls"] is None
    assert re.fullmatch(r"127\.0\.0\.1:\d+", told["connected", "phone"]["address"])
    actions = [(entry["action"], entry["topic"]) for entry in events(path, "denied")]
    assert actions == [("subscribe", "elsewhere/#"), ("publish", "r2d2/secret/x")]
    assert "acl.conf" in events(path, "denied")[1]["reason"]
    assert told["disconnected", "tablet"]["reason"] == "it disconnected"
    assert told["disconnected", "phone"]["reason"] == "connection lost"
    assert told["refused", "stranger"]["reason"] == "wrong password for user 'alice'"
    assert told["refused", "stranger"]["code"] == "0x87 Not authorized"
    assert told["refused", None]["address"].startswith("127.0.0.1:")
    robot.stop()
    assert [entries(path)[0]["event"], entries(path)[-1]["event"]] == ["started", "stopped"]


def test_what_was_changed_and_by_whom(robot: ApplianceProcess, tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    bob = log_in(robot, "phone", "bob")

    def appliance(*arguments: str) -> None:
        with pytest.raises(SystemExit) as ended:
            cli.main([*arguments, "-c", str(robot.config)])
        assert not ended.value.code

    appliance("user", "add", "carol", "--generate")
    appliance("user", "remove", "bob")
    assert robot._process is not None
    robot._process.send_signal(signal.SIGHUP)
    robot.wait_for_log("reloaded")
    assert isinstance(read(bob), Disconnect)
    (tmp_path / "acl.conf").write_text("topic nonsense\n\nbroken")
    robot._process.send_signal(signal.SIGHUP)
    robot.wait_for_log("not reloaded")
    eventually(lambda: len(events(path, "changed")) == 4, "all changes are in the file")
    added, removed, reloaded, failed = events(path, "changed")
    assert (added["what"], added["user"]) == ("user added", "carol")
    assert (removed["what"], removed["user"]) == ("user removed", "bob")
    assert getpass.getuser() in removed["by"]
    assert reloaded["users_added"] == ["carol"] and reloaded["users_removed"] == ["bob"]
    assert not reloaded["rules_changed"]
    assert "acl.conf:3:1" in failed["error"]
    assert events(path, "disconnected")[0]["reason"] == "the user was removed"


def test_a_disk_that_is_full_stops_nothing(robot: ApplianceProcess, tmp_path: Path) -> None:
    path = tmp_path / "audit.log"
    log_in(robot, "before", "alice").kill()
    eventually(lambda: events(path, "disconnected"), "the first is in the file")
    free = resource.prlimit(robot.pid, resource.RLIMIT_FSIZE, (1, resource.RLIM_INFINITY))
    for number in range(3):
        log_in(robot, f"full-{number}", "alice").kill()
    robot.wait_for_log("audit.log: cannot be written")
    log_in(robot, "after", "alice").kill()
    resource.prlimit(robot.pid, resource.RLIMIT_FSIZE, free)
    robot.wait_for_log("audit.log: can be written again")
    log_in(robot, "free", "alice").kill()
    eventually(lambda: events(path, "connected")[-1]["client"] == "free", "it is written again")
    assert sum(entry["count"] for entry in events(path, "lost")) >= 1
    robot.wait_for_log("cannot be written", 1)
    assert robot.log.count("cannot be written") <= 2


def test_a_broken_path_keeps_it_from_starting(tmp_path: Path) -> None:
    process = ApplianceProcess(tmp_path, broker={"audit": {"path": "no/such/audit.log"}})
    done = subprocess.run(
        [sys.executable, "-m", "appliance", "run", "-c", process.config],
        capture_output=True,
        text=True,
        timeout=30,
    )
    assert done.returncode == 1
    assert "broker.audit.path" in done.stderr and "Traceback" not in done.stderr


def test_a_command_makes_no_file_that_the_appliance_could_not_write(tmp_path: Path) -> None:
    note(tmp_path / "audit.log", "user added", user="bob")
    note(None, "user added", user="bob")
    assert not list(tmp_path.iterdir())


def test_without_a_path_there_is_no_file_and_nothing_is_told(tmp_path: Path) -> None:
    process = ApplianceProcess(tmp_path)
    process.start()
    log_in(process, "c", "alice").kill()
    process.stop()
    assert not list(tmp_path.glob("audit*"))


def test_no_secret_is_in_the_log_the_audit_log_or_an_error(
    robot: ApplianceProcess, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    for user, password in [("alice", WRONG), ("nobody", WRONG), (WRONG[:10], WRONG)]:
        for tls in (True, False):
            assert read(call(robot, "c", user, password, tls)).reason_code == 0x87
    log_in(robot, "c", "alice").kill()
    robot.stop()
    hashes = [line.partition(":")[2] for line in (tmp_path / "users.passwd").read_text().split()]
    told = robot.log + (tmp_path / "audit.log").read_text()
    for secret in [WRONG, *robot.passwords.values(), *filter(None, hashes)]:
        assert secret not in told
    assert "PRIVATE KEY" not in told
