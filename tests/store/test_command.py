"""`appliance store`, on the database of an appliance that runs, and of one that does not."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from appliance_process import ACL, ApplianceProcess
from raw_client import RawClient

from appliance.cli import main as cli
from appliance.mqtt.packets import Puback, Publish, Subscribe, Subscription
from appliance.store import inspection, schema


@pytest.fixture
def process(tmp_path: Path) -> Iterator[ApplianceProcess]:
    process = ApplianceProcess(tmp_path, acl=ACL)
    process.start()
    for name in ("first", "second"):
        with RawClient(process, 4) as client:
            client.connect(name, clean=False)
            client.send(Subscribe(1, [Subscription("r2d2/a", 1)]))
            client.receive()
    with RawClient(process, 4) as client:
        client.connect("publisher")
        for number, payload in enumerate((b"text", b"\xff\0"), 1):
            client.send(Publish("r2d2/a", payload, 1, number == 1, packet_id=number))
            assert isinstance(client.decode(client.receive()), Puback)
    yield process
    process.stop()


@dataclass
class Told:
    returncode: int
    stdout: str
    stderr: str


def store(process: ApplianceProcess, *arguments: str) -> Told:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            cli.main(["store", *arguments, "-c", str(process.config)])
        except SystemExit as end:
            return Told(int(end.code or 0), out.getvalue(), err.getvalue())


def entries(process: ApplianceProcess) -> dict[str, dict[str, object]]:
    lines = map(json.loads, store(process, "export").stdout.splitlines())
    return {line["session"]: line for line in lines if "session" in line}


def test_what_is_kept_is_shown_and_exported_while_it_runs(process: ApplianceProcess) -> None:
    shown = store(process)
    assert shown.returncode == 0
    assert "2 sessions, 2 retained messages" in shown.stdout and "'first'" in shown.stdout
    lines = [json.loads(line) for line in store(process, "export").stdout.splitlines()]
    first = next(line for line in lines if line.get("session") == "first")
    assert first["user"] == "alice" and first["expiry"] == 7 * 86400 and first["ends_at"]
    assert first["subscriptions"] == [
        {"filter": "r2d2/a", "qos": 1, "identifier": 0, "max_rate": None}
    ]
    text, binary = first["messages"]
    assert text["payload"] == "text" and binary["payload_base64"] == "/wA="
    retained = {line["retained"]["topic"] for line in lines if "retained" in line}
    assert retained == {"r2d2/a", "r2d2/_appliance/state"}


def test_it_is_pruned_when_the_appliance_is_stopped(process: ApplianceProcess) -> None:
    refused = store(process, "prune", "--client", "first")
    assert refused.returncode == 1 and "stop the appliance first" in refused.stderr
    process.stop()
    missing = store(process, "prune", "--client", "nobody")
    assert missing.returncode == 1 and "no session of 'nobody'" in missing.stderr
    assert "0 sessions and 0 messages" in store(process, "prune", "--older-than", "1 h").stdout
    done = store(process, "prune", "--client", "first", "--older-than", "0 s")
    assert "0 sessions and 2 messages" in done.stdout
    assert [len(each["messages"]) for each in entries(process).values()] == [0, 2]  # type: ignore[arg-type]
    assert "1 sessions and 0 messages" in store(process, "prune", "--client", "first").stdout
    assert set(entries(process)) == {"second"}
    assert store(process, "prune").returncode == 2
    nothing = store(process, "prune", "--upstream", "fleet")
    assert nothing.returncode == 1 and "nothing waits for an upstream 'fleet'" in nothing.stderr
    assert store(process, "prune", "--retained", "r2d2/#/x").returncode == 2
    assert "0 retained" in store(process, "prune", "--retained", "elsewhere/#").stdout
    assert "1 retained messages deleted" in store(process, "prune", "--retained", "+/a").stdout
    left = [json.loads(line) for line in store(process, "export").stdout.splitlines()]
    topics = [each["retained"]["topic"] for each in left if "retained" in each]
    assert topics == ["r2d2/_appliance/state"]
    process.start()
    with RawClient(process, 4) as client:
        assert client.connect("second", clean=False)[2] == 1
        assert len([packet for packet in client.drain() if isinstance(packet, Publish)]) == 2


class WithoutRoom:
    """A connection to a database on a disk that has no room for VACUUM."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection

    def __getattr__(self, name: str) -> object:
        return getattr(self._connection, name)

    def execute(self, statement: str, *values: object) -> sqlite3.Cursor:
        if statement == "VACUUM":
            raise sqlite3.OperationalError("database or disk is full")
        return self._connection.execute(statement, *values)


def test_what_is_pruned_is_gone_also_on_a_full_disk(
    process: ApplianceProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RawClient(process, 4) as client:
        client.connect("publisher")
        client.send(Publish("r2d2/a", b"confidential" * 5000, 1, packet_id=1))
        assert isinstance(client.decode(client.receive()), Puback)
    process.stop()
    database = process.directory / "state/store.db"
    assert b"confidential" in database.read_bytes()
    monkeypatch.setattr(inspection, "connect", lambda path: WithoutRoom(schema.connect(path)))
    for name in ("first", "second"):
        assert store(process, "prune", "--client", name).returncode == 0
    for path in database.parent.glob("store.db*"):
        assert b"confidential" not in path.read_bytes()


def test_what_is_pruned_is_in_no_figure_any_more(process: ApplianceProcess) -> None:
    with RawClient(process, 4) as client:
        client.connect("publisher")
        client.send(Publish("r2d2/a", bytes(500_000), 1, packet_id=1))
        assert isinstance(client.decode(client.receive()), Puback)
    process.stop()
    database = process.directory / "state/store.db"
    before = store(process).stdout.splitlines()[-1]
    assert before.startswith("2 sessions, 2 retained"), before
    assert "all 4 messages have 500" in before, before
    assert database.stat().st_size > 500_000
    for name in ("first", "second"):
        store(process, "prune", "--client", name)
    after = store(process).stdout.splitlines()[-1]
    assert after.startswith("0 sessions, 2 retained messages of "), after
    kept = after.partition("retained messages of ")[2].partition(" bytes")[0]
    # The one that is owed to nobody is gone, and the retained ones are all there is.
    assert f"; all 2 messages have {kept} bytes" in after, after
    assert database.stat().st_size < 500_000
    store(process, "prune", "--retained", "#")
    assert "0 sessions, 0 retained messages of 0 bytes; all 0 messages have 0 bytes" in (
        store(process).stdout
    )


def test_nothing_is_cut_off_in_a_pipe(process: ApplianceProcess) -> None:
    name = "a-client-of-a-fleet-" + "x" * 300
    with RawClient(process, 4) as client:
        client.connect(name, clean=False)
    lines = store(process).stdout.splitlines()
    assert lines[0].split() == [
        *("CLIENT", "ID", "USER", "SUBSCRIPTIONS", "MESSAGES", "BYTES", "OLDEST", "ENDS")
    ]
    (line,) = [each for each in lines if name in each]
    assert "'alice'" in line and "…" not in line


def test_nothing_stored_yet_is_told(process: ApplianceProcess) -> None:
    process.stop()
    shutil.rmtree(process.directory / "state")
    told = store(process)
    assert told.returncode == 1 and "nothing has been stored yet" in told.stderr
