"""The benchmark: every cell gives sane figures on both brokers; speed itself is not asserted."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from waiting import PATIENCE

from appliance import bench
from appliance.bench import (
    cells,
    client,
    command,
    conversion,
    drain,
    ends,
    growth,
    load,
    peers,
    report,
)
from appliance.bench.cells import (
    CELLS,
    BridgeCell,
    Cell,
    ConversionCell,
    FloodCell,
    ImageCell,
    LoadCell,
)
from appliance.bench.client import LoadError, LoadTarget
from appliance.bench.comparison import compare
from appliance.bench.crowd import Crowd
from appliance.bench.growth import GROWTH, GrowthCell, grow
from appliance.bench.links import LINKS
from appliance.bench.load import Result
from appliance.bench.load_clients import (
    ExactlyOncePublisher,
    ExactlyOnceSubscriber,
    Load,
    LoadPublisher,
    LoadSubscriber,
    MessageFlow,
    topic_of,
)
from appliance.bench.peers import Peer, PeerError, Server, Site, find_peer
from appliance.mqtt.topics import check_filter, matches

PEERS: list[Peer] = []
with contextlib.suppress(PeerError):
    PEERS.append(find_peer())
needs_mosquitto = pytest.mark.skipif(not PEERS, reason="mosquitto is not installed")


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
    row = compare(cell, PEERS, 0.3, rounds=1)
    assert row.problem is None
    for figures in (row.ours, row.figures(row.against)):
        assert figures is not None
        if isinstance(cell, FloodCell):
            assert figures.beside_us is not None
        check_sane(figures)
    assert row.met is not None


@pytest.mark.timed
@needs_mosquitto
def test_a_time_without_a_delivery_is_measured_until_there_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = Site(tmp_path)
    site.prepare()
    with peers.mosquitto(PEERS[0], site) as server:
        (broker,) = map(psutil.Process, server.pids)
        pauses = [0.5, 1.5]

        def stand_still(run: load.LoadRun) -> None:
            broker.suspend()
            run.serve(time.perf_counter() + 0.2)  # what the broker has sent already
            run.flows[0].latencies = []
            threading.Timer(pauses.pop(0), broker.resume).start()

        monkeypatch.setattr(load.LoadRun, "reset_latencies", stand_still)
        result = load.run_messages("qos0-pair", server.target(tls=False), Load(), 0.1, spin=False)
        check_sane(result)
        assert 0.4 < result.seconds < 3

        monkeypatch.setattr(load, "STALL_SECONDS", 0.5)
        with pytest.raises(LoadError, match="nothing was delivered while measuring"):
            load.run_messages("qos0-pair", server.target(tls=False), Load(), 0.1, spin=False)


@needs_mosquitto
@pytest.mark.parametrize(
    "cell",
    [cell for cell in CELLS if isinstance(cell, (BridgeCell, ImageCell))],
    ids=lambda cell: cell.name,
)
def test_every_bridge_gives_sane_figures_on_both_sides(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    for pace in (500, 200, 100):  # on a busy computer the tutorial node's queue of ten may run over
        monkeypatch.setattr(cells, "PACES", [pace])
        row = compare(cell, PEERS, 1.0, rounds=1)
        if all(
            each is not None and each.lost < each.messages
            for each in (row.ours, row.figures(row.against))
        ):
            break
    assert row.problem is None and row.missing is None
    for figures in (row.ours, row.figures(row.against)):
        assert figures is not None and figures.lost < figures.messages
        check_sane(dataclasses.replace(figures, lost=0))
        assert figures.rate is not None and figures.rate < 2000


@needs_mosquitto
def test_a_link_gives_sane_figures_on_both_devices() -> None:
    cell = dataclasses.replace(LINKS[1], messages=2500, round_trip=0.02, fleet=PEERS[0])
    row = compare(cell, PEERS, 0.3, rounds=1)
    assert row.problem is None and row.missing is None
    for figures in (row.ours, row.figures(row.against)):
        check_sane(dataclasses.replace(figures, rate=figures.messages / figures.seconds))
        assert figures.messages == 2500
        assert figures.beside_us is not None and figures.beside_us < 30_000_000
    assert row.ours is not None and row.ours.p50_us > 10_000, "half a round trip at least"
    assert row.met is not None


def test_a_link_needs_a_broker_of_a_fleet() -> None:
    assert compare(LINKS[0], [], 0.3).missing == "needs mosquitto as the fleet's broker"


def test_conversion_gives_sane_figures_and_both_give_the_same_json() -> None:
    pytest.importorskip("rclpy")
    (cell,) = (cell for cell in CELLS if isinstance(cell, ConversionCell))
    row = compare(cell, [Peer("mosquitto", (2, 1, 0), "mosquitto 2.1.0")], 0.3, rounds=1)
    assert row.problem is None and row.missing is None
    for figures in (row.ours, row.figures(row.against)):
        assert figures is not None and figures.messages > 0
        assert figures.cpu_us is not None and 0.1 < figures.cpu_us < 10_000
    cdr = conversion.sample()
    assert json.loads(conversion.ours()(cdr)) == json.loads(conversion.rclpy()(cdr))


@needs_mosquitto
@pytest.mark.parametrize("cell", GROWTH, ids=lambda cell: cell.name)
def test_every_statement_about_growth_gets_its_figure_from_both_brokers(
    cell: GrowthCell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(growth, "RUNS", 1)
    monkeypatch.setattr(growth, "SETTLE_SECONDS", 0.1)
    size = 40 if cell.name == "growth-clients" else 1000
    row = grow(dataclasses.replace(cell, size=size), PEERS, 0.2)
    assert row.problem is None and row.missing is None
    assert list(row.peers) == [PEERS[0].name]
    for figures in (row.ours, *row.peers.values()):
        assert figures is not None
        for statement in cell.statements:
            assert 0 <= figures[statement.figure] < 100_000
            assert report.growth_figure(statement, figures)
            if statement.most == 0:
                assert figures[statement.figure] == 0
            if statement.unit == "ms":
                assert 0.01 < figures[statement.figure] < 20_000
    assert row.reached is not None


# The command


@needs_mosquitto
def test_json_for_machines(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["qos0-pair"], 0.2, None, True, rounds=1) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["appliance"].startswith("appliance")
    assert [each["name"] for each in printed["peers"]] == [PEERS[0].name]
    (row,) = printed["rows"]
    assert row["goals"] == {"cpu_us": 1.0}
    ours, peer = row["ours"]["median"], row["peers"][PEERS[0].name]
    assert peer["ratios"]["cpu_us"] == pytest.approx(peer["median"]["cpu_us"] / ours["cpu_us"])
    assert row["problem"] is None


@needs_mosquitto
def test_growth_in_json_for_machines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    cell = dataclasses.replace(GROWTH[2], size=20)
    monkeypatch.setattr(command, "GROWTH", (cell,))
    monkeypatch.setattr(growth, "SETTLE_SECONDS", 0.1)
    assert bench.main(["growth-clients"], 0.2, None, True) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] == []
    assert printed["limits"]["publish_rate"] > 1_000_000
    (row,) = printed["growth"]
    assert (row["cell"], row["size"], row["problem"]) == ("growth-clients", 20, None)
    told = {each["figure"]: each for each in row["statements"]}
    assert told["failed"]["at_most"] == row["ours"]["failed"] == 0
    assert row["peers"][PEERS[0].name]["failed"] == 0
    assert told["failed"]["reached"] is True
    assert told["failed"]["reached_by_peers"] == {PEERS[0].name: True}


@needs_mosquitto
def test_so_many_messages_wait_as_are_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(["upstream"], 1.0, None, True, 1999) == 2
    assert "at least 2000 messages" in capsys.readouterr().err
    assert bench.upstream_cells() == ["upstream", "upstream-100ms"]


def test_without_a_peer_ours_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def none() -> Peer:
        raise PeerError("mosquitto is not among the installed programs")

    monkeypatch.setattr(command, "find_peer", none)
    assert bench.main(["qos0-pair"], 0.2, None, False, rounds=1) == 0
    captured = capsys.readouterr()
    assert "apt install mosquitto" in captured.err
    assert "CPU µs a delivered message" in captured.out and "ratio" not in captured.out


@pytest.mark.parametrize(
    ("cells", "seconds", "peers", "told"),
    [
        (["qos3"], 1.0, None, "no such cell: qos3; there are qos0-pair,"),
        (None, 0.0, None, "must be more than 0"),
        (None, 1.0, ["/no/mosquitto"], "/no/mosquitto is not there"),
    ],
)
def test_what_is_wrong_with_the_arguments_is_told(
    cells: list[str] | None,
    seconds: float,
    peers: list[str] | None,
    told: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert bench.main(cells, seconds, peers, False) == 2
    assert told in capsys.readouterr().err.replace("\n", " ")


def test_no_round_is_no_measurement(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.main(None, 1.0, None, False, rounds=0) == 2
    assert "one round or more" in capsys.readouterr().err


@needs_mosquitto
@pytest.mark.timeout(600)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_it_leaves_nothing_behind(tmp_path: Path, number: signal.Signals) -> None:
    # A shell without job control lets what it starts in the background ignore SIGINT.
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from appliance import bench; raise SystemExit(bench.main(None, 60.0, None, False))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    children: list[psutil.Process] = []
    try:
        until = time.monotonic() + 2 * PATIENCE
        while len(children) < 3 and time.monotonic() < until:  # both brokers and the load
            assert process.poll() is None
            time.sleep(0.05)
            children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) == 3
        process.send_signal(number)
        output, _ = process.communicate(timeout=2 * PATIENCE)
        _, alive = psutil.wait_procs(children, timeout=PATIENCE)
        assert process.returncode == 130, output
        assert not alive
        assert not list(tmp_path.iterdir())
    finally:
        for each in children:
            if each.is_running():
                each.kill()
        process.kill()
        process.communicate()


# Links


def test_what_is_sent_through_the_relay_comes_late_complete_and_then_its_end() -> None:
    command = [sys.executable, "-m", "appliance.bench.delay", "--round-trip", "0.2", "--to"]
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(20)
        process = subprocess.Popen(
            [*command, str(listener.getsockname()[1])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        with process:
            assert process.stdout is not None
            port = json.loads(process.stdout.readline())["port"]
            began = time.monotonic()
            with socket.create_connection(("127.0.0.1", port), 20) as near:
                sent = os.urandom(300_000)
                near.sendall(sent)
                near.shutdown(socket.SHUT_WR)
                far, _ = listener.accept()
                with far:
                    far.settimeout(20)
                    received = far.recv(1)
                    took = time.monotonic() - began
                    while data := far.recv(1 << 16):
                        received += data
    assert received == sent
    assert took >= 0.1
    assert process.returncode == 0


def test_a_message_that_a_link_has_sent_twice_counts_once() -> None:
    events = drain.Events()
    events.expect(10, 3)
    events.arrived([b"00000009", b"00000010", b"00000011", b"00000010", b"00000013"])
    assert events.count == 2
    events.arrived([b"00000012"])
    assert events.count == 3


# The load generator


def test_packets() -> None:
    assert client.connect_packet("c", "u", b"p") == bytes.fromhex(
        "10 13 0004 4d515454 04 c2 0000 0001 63 0001 75 0001 70"
    )
    assert client.publish_packet("a/b", b"x") == bytes.fromhex("30 06 0003 612f62 78")
    assert client.publish_packet("a/b", b"x", 10) == bytes.fromhex("32 08 0003 612f62 000a 78")
    assert client.publish_packet("a", bytes(200))[:3] == bytes.fromhex("30 cb 01")


class BrokerEnd:
    """The broker's end of one connection."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.target = LoadTarget(port=self.listener.getsockname()[1])

    def accept(self) -> socket.socket:
        connection, _ = self.listener.accept()
        connection.settimeout(5)
        assert connection.recv(1000)[0] == 0x10
        return connection


@pytest.mark.parametrize("step", [1, 7, 79, 80, 81, 1000])
def test_a_subscriber_acknowledges_every_identifier_however_the_bytes_are_cut(step: int) -> None:
    broker, flow = BrokerEnd(), MessageFlow(Load(qos=1, window=50))
    identifiers = [1, 2, 300, 65535, 1, 77, 256, 255, 9]
    packets = b"".join(client.publish_packet("t", bytes(64), each) for each in identifiers)
    subscriber = LoadSubscriber(broker.target, "s", flow, "t")
    with broker.listener, broker.accept() as peer:
        publisher = LoadPublisher(broker.target, "p", flow, "t")
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


class CutStream:
    """In a connection's place: gives what it has received in pieces, and keeps what is sent."""

    has_unsent = has_more = False

    def __init__(self, received: bytes, step: int) -> None:
        self.pieces = [received[start : start + step] for start in range(0, len(received), step)]
        self.sent = b""

    def recv_into(self, buffer: memoryview) -> int:
        piece = self.pieces.pop(0)
        buffer[: len(piece)] = piece
        return len(piece)

    def send(self, data: memoryview) -> int:
        self.sent += data[:3]  # a socket that is full takes a part
        return len(data[:3])


def answer(first: int, identifier: int) -> bytes:
    return bytes([first, 2]) + identifier.to_bytes(2, "big")


def exchange(each: LoadPublisher | LoadSubscriber, received: bytes, step: int) -> bytes:
    """What a client sends after it has received this, cut in pieces."""
    stream = CutStream(received, step)
    each.transport = stream  # type: ignore[assignment]
    while stream.pieces:
        each.receive()
    before = None
    while before != stream.sent:
        before = stream.sent
        each.flush()
    return stream.sent


@pytest.mark.parametrize("step", [1, 3, 4, 79, 80, 83, 84, 85, 1000])
def test_a_subscriber_of_qos_2_answers_each_packet_however_the_bytes_are_cut(step: int) -> None:
    broker, flow = BrokerEnd(), MessageFlow(Load(qos=2, window=50))
    publisher = ExactlyOncePublisher(broker.target, "p", flow, "t")
    subscriber = ExactlyOnceSubscriber(broker.target, "s", flow, "t")
    flow.start(publisher)

    def publish(identifier: int) -> bytes:
        return client.publish_packet("t", bytes(64), identifier, qos=2)

    received = [publish(1), publish(0x6262), answer(0x62, 1), publish(65535), answer(0x62, 0x6262)]
    sent = exchange(subscriber, b"".join(received), step)
    assert sent == (
        answer(0x50, 1)
        + answer(0x50, 0x6262)
        + answer(0x70, 1)
        + answer(0x50, 65535)
        + answer(0x70, 0x6262)
    )
    assert flow.deliveries == 3
    with pytest.raises(LoadError, match="expected PUBLISH or PUBREL, got 0x40"):
        exchange(subscriber, answer(0x40, 1), step)
    publisher.close()
    subscriber.close()
    broker.listener.close()


@pytest.mark.parametrize("step", [1, 2, 3, 4, 5, 7, 1000])
def test_a_publisher_of_qos_2_releases_what_was_received_and_counts_what_is_complete(
    step: int,
) -> None:
    broker, flow = BrokerEnd(), MessageFlow(Load(qos=2, window=3))
    publisher = ExactlyOncePublisher(broker.target, "p", flow, "t")
    flow.start(publisher)
    flow.deliver(3)
    received = answer(0x50, 1) + answer(0x50, 2) + answer(0x70, 1) + answer(0x50, 0x7070)
    sent = exchange(publisher, received, step)
    releases = [answer(0x62, each) for each in (1, 2, 0x7070)]
    fourth = client.publish_packet("t", bytes(range(64)), 4, qos=2)
    assert flow.acknowledged == 1
    assert len(sent) == len(b"".join(releases)) + len(fourth)
    assert sent.replace(fourth, b"") == b"".join(releases), "no packet lies inside another"
    with pytest.raises(LoadError, match="expected PUBREC or PUBCOMP, got 0x40"):
        exchange(publisher, answer(0x40, 1), step)
    publisher.close()
    broker.listener.close()


class Recorder:
    """In a publisher's place: what it is told to send."""

    def __init__(self) -> None:
        self.sent: list[int] = []

    def send(self, count: int) -> None:
        self.sent.append(count)


def test_the_window_counts_what_is_neither_delivered_nor_acknowledged() -> None:
    flow, publisher = MessageFlow(Load(qos=1, window=3)), Recorder()
    flow.start(publisher)  # type: ignore[arg-type]
    flow.deliver(2)
    assert publisher.sent == [3]
    flow.acknowledge(1)
    assert publisher.sent == [3, 1]
    flow.acknowledge(3)
    assert publisher.sent == [3, 1, 1]
    assert flow.in_flight == 3
    assert sum(count for _, count in flow.latencies) == 2


def test_one_at_a_time_waits_for_every_subscriber() -> None:
    flow, publisher = MessageFlow(Load(subscribers=3)), Recorder()
    flow.start(publisher)  # type: ignore[arg-type]
    flow.deliver(2)
    assert publisher.sent == [1]
    flow.deliver(1)
    assert publisher.sent == [1, 1]
    with pytest.raises(LoadError, match="more messages than were sent"):
        flow.deliver(4)


def test_each_of_many_topics_has_its_turn_and_the_wildcard_has_all() -> None:
    broker, flow = BrokerEnd(), MessageFlow(Load(topics=5000))
    publisher = LoadPublisher(broker.target, "p", flow, "bench/t")
    publisher.close()
    broker.listener.close()
    size = len(client.publish_packet(topic_of("bench/t", flow.load, 0), bytes(64)))
    ring = bytes(publisher._ring)
    assert len(ring) % size == 0
    packets = [ring[start : start + size] for start in range(0, len(ring), size)]
    topics = [packet[4 : 4 + packet[3]].decode() for packet in packets[:5000]]
    assert len(set(topics)) == 5000
    assert all(matches("bench/t/+", topic) for topic in topics)


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
    with pytest.raises(SystemExit, match="1"):
        load.main(["qos0-pair", "--port", str(port), "--no-pin"])
    assert "qos0-pair: " in capsys.readouterr().err


# Growth


def test_other_subscriptions_are_other_ones() -> None:
    filters = [growth.other_filter(number) for number in range(10_000)]
    assert len(set(filters)) == 10_000
    assert sum("+" in each or "#" in each for each in filters) == 3000
    published = ["bench/load/00", topic_of("bench/load/00", Load(topics=9), 7)]
    for each in filters:
        check_filter(each)
        assert not any(matches(each, topic) for topic in published)
    kept = [growth.retained_topic(number) for number in range(10_000)]
    assert len(set(kept)) == 10_000 and len(set(map(len, kept))) == 1


class Pretender:
    """A broker of one thread that does what a test says with each of its connections."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.target = LoadTarget(port=self.listener.getsockname()[1])
        self.pauses: list[float] = []  # each before one PUBLISH is sent back
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def server(self, directory: Path) -> Server:
        return Server("pretender", Site(directory), self.target.port, self.target.port, ())

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self.listener.accept()
            except OSError:
                return
            self._threads.append(threading.Thread(target=self._serve, args=[connection]))
            self._threads[-1].start()

    def _serve(self, connection: socket.socket) -> None:
        with connection:
            connection.settimeout(10)
            data = connection.recv(1000)
            if data.endswith(b"-1"):
                return  # of a crowd, number 1 is closed before its CONNACK
            refused = data.endswith(b"-2")
            connection.sendall(b"\x20\x02\0" + (b"\x05" if refused else b"\0"))
            if data.endswith(b"-3"):
                return  # and number 3 behind it
            with contextlib.suppress(ConnectionError):  # the other end is closed in a hurry
                while data := connection.recv(1000):
                    if data[0] == 0x82:
                        connection.sendall(b"\x90\x03\0\1\0")
                    else:
                        time.sleep(self.pauses.pop() if self.pauses else 0)
                        connection.sendall(data)

    def close(self) -> None:
        # A thread in accept() is not woken up by a close.
        self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        for each in self._threads:
            each.join(10)


@pytest.fixture
def pretender() -> Iterator[Pretender]:
    broker = Pretender()
    yield broker
    broker.close()


@pytest.mark.timed
def test_the_probe_sees_how_long_a_broker_stands_still(
    pretender: Pretender, tmp_path: Path
) -> None:
    with growth.probing(pretender.server(tmp_path)) as probe:
        time.sleep(0.1)
        assert 0 < probe.ask()["longest"] < 0.4
        pretender.pauses.append(0.5)
        time.sleep(1.5)
        answer = probe.ask()
        assert 0.5 <= answer["longest"] < 5
        assert answer["median"] < 0.4
        time.sleep(0.1)
        assert probe.ask()["longest"] < 0.4  # since the last question only


def test_a_crowd_counts_who_could_not_connect_and_who_did_not_stay(pretender: Pretender) -> None:
    crowd = Crowd(pretender.target)
    with contextlib.ExitStack() as stack:
        stack.callback(crowd.leave)
        came = crowd.connect(6)
        assert (came["failed"], came["timed_out"]) == (2, 0)
        assert 0 < came["p50"] <= came["p99"] <= came["seconds"]  # type: ignore[operator]
        until = time.monotonic() + 10
        while "closed after the CONNACK" not in crowd._problems and time.monotonic() < until:
            crowd._serve(0.1)
        assert crowd.leave() == {
            "stayed": 3,
            "problems": {
                "closed before the CONNACK": 1,
                "answered with 20 02 00 05": 1,
                "closed after the CONNACK": 1,
            },
        }


def test_who_gets_no_answer_has_timed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("appliance.bench.crowd.CONNECT_SECONDS", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        crowd = Crowd(LoadTarget(port=listener.getsockname()[1]))
        came = crowd.connect(3)
        assert (came["failed"], came["timed_out"]) == (3, 3)
        assert "p50" not in came
        assert crowd.leave()["stayed"] == 0


def test_a_program_that_ends_is_told_with_its_last_words(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    server = Server("nobody", Site(tmp_path), port, port, ())
    with (
        pytest.raises(PeerError, match=r"the probe ended.*Connection refused"),
        growth.probing(server),
    ):
        pass


# The ends of a bridge


@pytest.mark.parametrize("payload", [0, 100, 200, 20_000, 3_000_000])
def test_the_size_of_a_packet_is_read_off_its_head(payload: int) -> None:
    packet = client.publish_packet("bench/camera", bytes(payload))
    assert ends.packet_size(memoryview(packet.ljust(5, b"x"))) == len(packet)


def test_what_is_no_packet_is_told() -> None:
    with pytest.raises(LoadError, match="no MQTT"):
        ends.packet_size(memoryview(b"\x30" + b"\xff" * 4))


def test_the_meter_counts_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = 1_000_000_000
    monkeypatch.setattr("time.monotonic_ns", lambda: clock)
    meter = ends.LatencyMeter("bridge", [], 1.0)
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
