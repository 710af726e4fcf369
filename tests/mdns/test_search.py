"""`appliance find`: what is answered, by appliances and by strangers, and how it is shown."""

from __future__ import annotations

import json
import random
import socket
import struct
from collections.abc import Iterable
from pathlib import Path

import pytest
from command_line import run
from hypothesis import given
from hypothesis import strategies as st
from zeroconf import (  # type: ignore[attr-defined]
    DNSAddress,
    DNSIncoming,
    DNSOutgoing,
    DNSPointer,
    DNSService,
    DNSText,
)

from appliance import certs
from appliance.cli import find as command
from appliance.host import interfaces
from appliance.mdns import search
from appliance.mdns.announcement import HTTPS, SECURE_MQTT
from appliance.mdns.search import ADDRESSES, HOSTS, SERVICES, Answers, question, texts

PTR, TXT, SRV, A, AAAA, IN = 12, 16, 33, 1, 28, 1
CA = "AB" * 32


def text(**values: str) -> bytes:
    pairs = [f"{key}={value}".encode() for key, value in values.items()]
    return b"".join(bytes([len(pair)]) + pair for pair in pairs)


def packet(
    name: str = "r2d2",
    kind: str = SECURE_MQTT,
    port: int = 8883,
    host: str = "appliance-1-0.local.",
    addresses: Iterable[str] = ("192.0.2.1",),
    record: bytes | None = None,
    ttl: int = 120,
) -> bytes:
    """The answer of an appliance, or of who says that it is one."""
    out = DNSOutgoing(0x8400)
    full = f"{name}.{kind}"
    record = text(robot=name, ca=CA) if record is None else record
    answers = [
        DNSPointer(kind, PTR, IN, ttl, full),
        DNSService(full, SRV, IN, ttl, 0, 0, port, host),
        DNSText(full, TXT, IN, ttl, record),
    ]
    for each in addresses:
        family, type_ = (socket.AF_INET6, AAAA) if ":" in each else (socket.AF_INET, A)
        answers.append(DNSAddress(host, type_, IN, ttl, socket.inet_pton(family, each)))
    for answer in answers:
        out.add_answer_at_time(answer, 0)
    (found,) = out.packets()
    return found


def answers(*packets: bytes) -> Answers:
    found = Answers()
    for each in packets:
        found.take(each)
    return found


def test_an_appliance_and_its_console() -> None:
    both = ("192.0.2.1", "2001:db8::1")
    found = answers(
        packet(addresses=both),
        packet(kind=HTTPS, port=8443, host="appliance-1-1.local.", addresses=both),
        packet("r2d2 (2)", addresses=["192.0.2.9"], host="h.local.", record=text(robot="r2d2")),
        packet("printer", record=text(note="not an appliance")),
    )
    one, other = found.appliances()
    assert (one.robot, one.name, one.mqtt, one.console) == ("r2d2", "r2d2", (8883,), (8443,))
    assert [str(each) for each in one.addresses] == ["192.0.2.1", "2001:db8::1"]
    assert one.ca == CA
    assert (other.robot, other.name, other.mqtt, other.console) == ("r2d2", "r2d2 (2)", (8883,), ())
    assert other.ca == ""


def test_a_second_port_is_the_same_appliance() -> None:
    second = packet("r2d2 8884", port=8884, host="b.local.", record=text(robot="r2d2", ca=CA))
    (one,) = answers(packet(), second).appliances()
    assert (one.name, one.mqtt) == ("r2d2", (8883, 8884))


def test_the_same_name_elsewhere_is_another_row() -> None:
    """Who takes a robot's name, and its CA's fingerprint, is not put into its row."""
    forged = packet(kind=HTTPS, port=666, host="evil.local.", addresses=["192.0.2.66"])
    one, other = answers(packet(), forged).appliances()
    assert (one.console, other.console, other.mqtt) == ((), (666,), ())


def test_a_farewell() -> None:
    assert answers(packet(), packet(ttl=0)).appliances() == []


def test_what_is_missing_is_asked_for() -> None:
    found = answers(packet(addresses=[]))
    assert found.appliances() == []
    assert found.missing() == ["appliance-1-0.local."]
    asked = DNSIncoming(question([("a.b.c._https._tcp.local.", 255), (SECURE_MQTT, PTR)], 7))
    assert asked.id == 7 and asked.is_query()
    assert [each.name for each in asked.questions] == ["a.b.c._https._tcp.local.", SECURE_MQTT]
    # A name with dots in it is one label, and one that cannot be a name is not asked for.
    assert question([("a.b._https._tcp.local.", 255)])[12:16] == b"\x03a.b"
    assert question([("x" * 64 + ".local.", 255), ("", 255)])[4:6] == b"\0\0"


@pytest.mark.parametrize(
    ("record", "found"),
    [
        (b"", {}),
        (b"\0", {}),
        (b"\x05a=b", {"a": "b"}),  # cut off
        (b"\x03a=b\x03A=c", {"a": "b"}),
        (b"\x01a\x02=b\x02a=", {"a": ""}),
        (b"\x04a=\xff\xfe", {"a": "\ufffd\ufffd"}),
    ],
)
def test_texts(record: bytes, found: dict[str, str]) -> None:
    assert texts(record) == found


@given(st.binary(max_size=300))
def test_any_bytes(given: bytes) -> None:
    found = answers(given, b"\0\0\x84\0" + given, packet()[:40] + given, given + packet())
    assert len(found.appliances()) <= 1


@given(st.integers(0, 2**32))
def test_damaged_packets(seed: int) -> None:
    chance = random.Random(seed)
    damaged = bytearray(packet())
    for _ in range(chance.randrange(1, 6)):
        damaged[chance.randrange(len(damaged))] = chance.randrange(256)
    found = answers(bytes(damaged[: chance.randrange(len(damaged) + 1)]))
    found.appliances()
    found.missing()


def test_as_much_as_is_taken() -> None:
    many = answers(packet(addresses=[f"192.0.2.{n}" for n in range(1, 40)]))
    assert len(many.appliances()[0].addresses) == ADDRESSES
    flood = answers(*(packet(f"r{n}", host=f"appliance-{n}.local.") for n in range(SERVICES + 5)))
    assert flood.is_full and len(flood.services) == SERVICES and len(flood.hosts) <= HOSTS
    assert len(flood.appliances()) == SERVICES
    large = answers(*[packet(record=text(robot="r" * 200) * 6) for _ in range(4000)])
    assert large.is_full and large.size <= search.BYTES
    # What is of others does not count.
    assert not answers(*[b"\0\0\x84\0" + bytes(8000)] * 1000).size


def test_a_search_ends_in_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    near.setblocking(False)
    far.setblocking(False)
    monkeypatch.setattr(search, "_open", lambda *_: [(near, "")])
    monkeypatch.setattr(search, "_ask", lambda *_: None)
    sent = 0

    def flood(answers: Answers) -> None:
        nonlocal sent
        sent += 1
        far.send(packet(f"r{sent}", host=f"h{sent}.local."))

    with near, far:
        assert search.search([], 60, flood).is_full
        far.send(packet())
        assert not search.search([], 0.1).is_full


# --- the command -----------------------------------------------------------------------------


@pytest.fixture
def lan(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """What is answered to the command."""
    packets: list[bytes] = []
    monkeypatch.setattr(
        interfaces, "multicast_interfaces", lambda: [interfaces.Interface("eth0", 2, ())]
    )
    monkeypatch.setattr(search, "search", lambda *_: answers(*packets))
    return packets


def test_a_table(lan: list[bytes], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    lan += [packet(), packet(kind=HTTPS, port=8443)]
    assert run("find") == 0
    heads, row = capsys.readouterr().out.splitlines()
    assert heads.split() == ["ROBOT", "ADDRESS", "MQTT", "CONSOLE", "CA"]
    half = ":".join(["AB"] * 16)
    assert row.split() == ["r2d2", "192.0.2.1", "8883", "8443", half, half]
    assert run("find", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "robot": "r2d2",
        "name": "r2d2",
        "addresses": ["192.0.2.1"],
        "mqtt": [8883],
        "console": [8443],
        "ca": CA,
    }


def test_the_fingerprint_is_compared(
    lan: list[bytes], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    certs.create_authority(tmp_path)
    ca = tmp_path / "ca.crt"
    lan.append(packet())
    assert run("find", "--ca", str(ca)) == 1
    told = capsys.readouterr()
    assert "ANOTHER: AB:AB" in told.out and "none of them says that it has the CA" in told.err
    own = certs.fingerprints(ca)[0].replace(":", "")
    lan.append(packet("c3po", record=text(robot="c3po", ca=own)))
    assert run("find", "--ca", str(ca)) == 0
    assert "c3po   192.0.2.1  8883  -        the same" in capsys.readouterr().out
    assert run("find", "--ca", str(tmp_path / "none.crt")) == 1
    assert "there is no file" in capsys.readouterr().err


def test_none_is_found(
    lan: list[bytes], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run("find", "--json") == 1
    told = capsys.readouterr()
    assert told.out == "" and "no appliance was found within 3 s" in told.err
    assert "UDP port 5353" in told.err and "appliance status" in told.err
    monkeypatch.setattr(interfaces, "multicast_interfaces", list)
    assert run("find") == 1
    assert "no interface with an address" in capsys.readouterr().err
    assert run("find", "--timeout", "0") == 2


def test_a_long_name_leaves_the_table_narrow(
    lan: list[bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    lan.append(packet("x", record=text(robot="x" * 240)))
    assert run("find") == 0
    assert capsys.readouterr().out.splitlines()[1].split()[0] == "x" * 39 + "…"


def test_a_flood_is_said(lan: list[bytes], capsys: pytest.CaptureFixture[str]) -> None:
    lan += [packet(f"r{n}") for n in range(SERVICES + 1)]
    assert run("find") == 0
    assert "the list is not complete" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("r2  10.0.0.9  8883", r"r2\x20\x2010.0.0.9\x20\x208883"),
        ("a\x1b[2Jb\r\n", r"a\x1b[2Jb\x0d\x0a"),
        ("\u202eb\u200b", r"\u202eb\u200b"),
        ("a\u2800\u3000\xa0b", r"a\u2800\u3000\xa0b"),
        ("größer🤖", "größer🤖"),
        ("r2d2\ufe00", r"r2d2\ufe00"),
    ],
)
def test_a_name_is_one_word(
    lan: list[bytes], capsys: pytest.CaptureFixture[str], name: str, shown: str
) -> None:
    lan.append(packet("x", record=b"".join([text(robot=name)])))
    assert run("find") == 0
    assert capsys.readouterr().out.splitlines()[1].split()[0] == shown
    assert command.one_word(name) == shown
    assert run("find", "--json") == 0
    told = capsys.readouterr().out
    assert json.loads(told)["robot"] == name and "\x1b" not in told and "\u202e" not in told


def test_a_fingerprint_is_one(lan: list[bytes], capsys: pytest.CaptureFixture[str]) -> None:
    for forged in ("the same", "AB" * 31 + "A ", "ab" * 32, "AB" * 33):
        lan[:] = [packet(record=text(robot="r2", ca=forged))]
        assert run("find") == 0
        assert capsys.readouterr().out.splitlines()[1].split()[-1] == "-"


def test_a_packet_that_points_to_itself() -> None:
    loop = struct.pack("!HHHHHH", 0, 0x8400, 0, 1, 0, 0) + b"\x0c_secure-mqtt\xc0\x0c"
    assert answers(loop + struct.pack("!HHIH", PTR, IN, 120, 2) + b"\xc0\x0c").appliances() == []
