"""The benchmark: every cell gives sane figures on both brokers; speed itself is not asserted."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from appliance import bench
from appliance.bench import cells, client, command, ends, load, report
from appliance.bench.cells import CELLS, BridgeCell, Cell, LoadCell, Row, compare, median
from appliance.bench.client import LoadError, Target
from appliance.bench.load import Flow, Load, Publisher, Result, Subscriber
from appliance.bench.peers import find_mosquitto

MOSQUITTO = find_mosquitto(None)
needs_mosquitto = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")


def check_sane(result: Result | None) -> None:
    assert result is not None
    if result.memory_kib is not None:
        assert 1 < result.memory_kib < 10_000
        return
    assert result.messages > 0
    assert result.lost == 0
    assert result.rate == pytest.approx(result.messages / result.seconds)
    assert result.cpu_us is not None and 0.1 < result.cpu_us < 100_000
    assert result.p50_us is not None and result.p99_us is not None
    assert 1 < result.p50_us <= result.p99_us < 30_000_000
    assert result.broker_busy is not None and result.broker_busy > 0


# Cells


@needs_mosquitto
@pytest.mark.parametrize(
    "cell", [cell for cell in CELLS if isinstance(cell, LoadCell)], ids=lambda cell: cell.name
)
def test_every_load_gives_sane_figures_on_both_brokers(cell: Cell) -> None:
    row = compare(cell, MOSQUITTO, 0.3, repeats=1)
    assert row.problem is None
    check_sane(row.ours)
    check_sane(row.peer)
    assert row.met is not None


@needs_mosquitto
@pytest.mark.parametrize(
    "cell", [cell for cell in CELLS if isinstance(cell, BridgeCell)], ids=lambda cell: cell.name
)
def test_every_bridge_gives_sane_figures_on_both_sides(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    monkeypatch.setattr(cells, "PACES", [500])
    row = compare(cell, MOSQUITTO, 1.0, repeats=1)
    assert row.problem is None and row.missing is None
    for figures in (row.ours, row.peer):
        # On a busy computer the tutorial node's queue of ten may run over.
        assert figures is not None and figures.lost < figures.messages
        check_sane(dataclasses.replace(figures, lost=0))
        assert figures.rate is not None and figures.rate < 2000


def test_a_broker_that_ends_is_told_with_its_last_words(tmp_path: Path) -> None:
    broken = tmp_path / "mosquitto"
    broken.write_text("#!/bin/sh\necho out of order >&2\nexit 3\n")
    broken.chmod(0o755)
    row = compare(CELLS[0], str(broken), 0.2, repeats=1)
    assert row.problem == "mosquitto does not start; mosquitto ended with 3: out of order"
    check_sane(row.ours)
    assert row.peer is None and row.met is None


def test_ratios_and_goals() -> None:
    cell = Cell("c", "a cell", {"cpu_us": 1.5})
    ours, peer = Result("c", False, 1.0, cpu_us=2.0), Result("c", False, 1.0, cpu_us=3.0)
    assert Row(cell, ours, peer).ratio("cpu_us") == 1.5
    assert Row(cell, ours, peer).met is True
    assert Row(cell, peer, peer).met is False
    assert Row(cell, ours).met is None


def test_medians_but_every_loss() -> None:
    runs = [Result("c", True, 1.0, lost=1, cpu_us=cpu, memory_kib=None) for cpu in (9.0, 1.0, 2.0)]
    assert median(runs) == Result("c", True, 1.0, lost=3, cpu_us=2.0)


# The command


@needs_mosquitto
def test_json_for_machines(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["qos0-pair"], 0.2, None, True) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["peer"].startswith("mosquitto ")
    (row,) = printed["rows"]
    assert row["goals"] == {"cpu_us": 1.0}
    assert row["ratios"]["cpu_us"] == pytest.approx(row["peer"]["cpu_us"] / row["ours"]["cpu_us"])
    assert row["problem"] is None


def test_without_a_peer_ours_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "find_mosquitto", lambda command: None)
    assert bench.main(["qos0-pair"], 0.2, None, False) == 0
    captured = capsys.readouterr()
    assert "apt install mosquitto" in captured.err
    assert "CPU µs a message" in captured.out and "ratio" not in captured.out


@pytest.mark.parametrize(
    ("cells", "seconds", "peer", "told"),
    [
        (["qos3"], 1.0, None, "no such cell: qos3; there are qos0-pair,"),
        (None, 0.0, None, "must be more than 0"),
        (None, 1.0, "/no/mosquitto", "/no/mosquitto is not there"),
    ],
)
def test_what_is_wrong_with_the_arguments_is_told(
    cells: list[str] | None,
    seconds: float,
    peer: str | None,
    told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench.main(cells, seconds, peer, False) == 2
    assert told in capsys.readouterr().err.replace("\n", " ")


@needs_mosquitto
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_it_leaves_nothing_behind(tmp_path: Path, number: signal.Signals) -> None:
    code = "from appliance import bench; raise SystemExit(bench.main(None, 60.0, None, False))"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    children: list[psutil.Process] = []
    try:
        until = time.monotonic() + 30
        while len(children) < 3 and time.monotonic() < until:  # both brokers and the load
            assert process.poll() is None
            time.sleep(0.05)
            children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) == 3
        process.send_signal(number)
        output, _ = process.communicate(timeout=30)
        _, alive = psutil.wait_procs(children, timeout=5)
        assert process.returncode == 130, output
        assert not alive
        assert not list(tmp_path.iterdir())
    finally:
        for each in children:
            if each.is_running():
                each.kill()
        process.kill()
        process.communicate()


def test_the_table_says_what_was_not_reached(capsys: pytest.CaptureFixture[str]) -> None:
    cell = Cell("c", "a cell", {"cpu_us": 1.5})
    ours = Result("c", False, 1.0, messages=9, lost=1, cpu_us=3.0, rate=1000.0)
    report.show([Row(cell, ours, dataclasses.replace(ours, lost=0, rate=500.0))], "mosquitto 2")
    lines = capsys.readouterr().out.splitlines()
    words = [" ".join(line.replace("|", " ").split()) for line in lines]
    assert "a cell CPU µs a message 3.0 3.0 1.00 ≥ 1.5 not met" in words
    assert "messages/s 1,000 500 2.00" in words
    assert "lost by appliance 1 of 10" in words


# The load generator


def test_packets() -> None:
    assert client.connect_packet("c", "u", b"p") == bytes.fromhex(
        "10 13 0004 4d515454 04 c2 0000 0001 63 0001 75 0001 70"
    )
    assert client.publish_packet("a/b", b"x") == bytes.fromhex("30 06 0003 612f62 78")
    assert client.publish_packet("a/b", b"x", 10) == bytes.fromhex("32 08 0003 612f62 000a 78")
    assert client.publish_packet("a", bytes(200))[:3] == bytes.fromhex("30 cb 01")


class Wire:
    """The broker's end of one connection."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.target = Target(port=self.listener.getsockname()[1])

    def accept(self) -> socket.socket:
        connection, _ = self.listener.accept()
        connection.settimeout(5)
        assert connection.recv(1000)[0] == 0x10
        return connection


@pytest.mark.parametrize("step", [1, 7, 79, 80, 81, 1000])
def test_a_subscriber_acknowledges_every_identifier_however_the_bytes_are_cut(step: int) -> None:
    wire, flow = Wire(), Flow(Load(qos=1, window=50))
    identifiers = [1, 2, 300, 65535, 1, 77, 256, 255, 9]
    packets = b"".join(client.publish_packet("t", bytes(64), each) for each in identifiers)
    subscriber = Subscriber(wire.target, "s", flow, "t")
    with wire.listener, wire.accept() as peer:
        publisher = Publisher(wire.target, "p", flow, "t")
        flow.start(publisher)
        for start in range(0, len(packets), step):
            peer.sendall(packets[start : start + step])
            received = 0
            while received < len(packets[start : start + step]):
                before = flow.deliveries * subscriber._size + subscriber._filled
                subscriber.receive()
                received += flow.deliveries * subscriber._size + subscriber._filled - before
        answer = b""
        while len(answer) < 4 * len(identifiers):
            answer += peer.recv(1000)
        subscriber.close()
        publisher.close()
    assert answer == b"".join(b"\x40\x02" + each.to_bytes(2, "big") for each in identifiers)
    assert flow.deliveries == len(identifiers)


class Recorder:
    """In a publisher's place: what it is told to send."""

    def __init__(self) -> None:
        self.sent: list[int] = []

    def send(self, count: int) -> None:
        self.sent.append(count)


def test_the_window_counts_what_is_neither_delivered_nor_acknowledged() -> None:
    flow, publisher = Flow(Load(qos=1, window=3)), Recorder()
    flow.start(publisher)  # type: ignore[arg-type]
    flow.deliver(2)
    assert publisher.sent == [3]
    flow.acknowledge(1)
    assert publisher.sent == [3, 1]
    flow.acknowledge(3)
    assert publisher.sent == [3, 1, 1]
    assert flow.on_the_way == 3
    assert sum(count for _, count in flow.latencies) == 2


def test_one_at_a_time_waits_for_every_subscriber() -> None:
    flow, publisher = Flow(Load(subscribers=3)), Recorder()
    flow.start(publisher)  # type: ignore[arg-type]
    flow.deliver(2)
    assert publisher.sent == [1]
    flow.deliver(1)
    assert publisher.sent == [1, 1]
    with pytest.raises(LoadError, match="more messages than were sent"):
        flow.deliver(4)


def test_percentiles_are_weighted() -> None:
    assert load.percentile([(5.0, 1), (1.0, 98), (9.0, 1)], 0.50) == 1.0
    assert load.percentile([(5.0, 1), (1.0, 98), (9.0, 1)], 0.99) == 5.0
    with pytest.raises(LoadError, match="nothing was delivered"):
        load.percentile([], 0.5)


def test_cpu_time_is_that_of_the_process() -> None:
    before, own = load.cpu_seconds([os.getpid()]), time.process_time()
    while time.process_time() - own < 0.05:
        pass
    assert 0.04 < load.cpu_seconds([os.getpid()]) - before < 1


def test_a_refused_connection_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    assert load.main(["qos0-pair", "--port", str(port), "--no-pin"]) == 1
    assert "qos0-pair: " in capsys.readouterr().err


# The ends of a bridge


def test_the_meter_counts_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = 1_000_000_000
    monkeypatch.setattr("time.monotonic_ns", lambda: clock)
    meter = ends.Meter("bridge", [], 1.0)
    with pytest.raises(LoadError, match="nothing comes through"):
        meter.result()
    for number in range(2500):
        data = ends.text(number)
        clock += 1_000_000
        if number % 10 != 3:
            meter.add(data.encode() if number % 2 else data)
    result = meter.result()
    assert len(data) == ends.TEXT_BYTES
    assert (result.messages, result.lost) == (900, 100)
    assert result.p50_us == pytest.approx(1000)
