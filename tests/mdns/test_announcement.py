"""What is announced: names, addresses, texts, and which listeners."""

from __future__ import annotations

from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance import certs, config
from appliance.config import Bind, Settings
from appliance.mdns.announcement import (
    HTTPS,
    SECURE_MQTT,
    Announcement,
    Service,
    cut,
    label,
)
from appliance.mdns.search import texts
from appliance.mdns.settings import Listening, announcement, new_host

LINK = [ip_address(each) for each in ("192.0.2.1", "192.0.2.7", "2001:db8::1")]
WANTED = Announcement("r2d2", "AB" * 32, "appliance-0", (Service(SECURE_MQTT, 8883, ("",)),))


@pytest.mark.parametrize(
    ("robot", "ending", "name"),
    [
        ("r2d2", "", "r2d2"),
        ("r2d2", " (2)", "r2d2 (2)"),
        ("line.3.agv", "", "line-3-agv"),
        ("x" * 64, "", "x" * 63),
        ("x" * 64, " (12)", "x" * 58 + " (12)"),
        ("ü" * 40, "", "ü" * 31),  # 63 bytes would end in the middle of one
        ("🤖" * 20, " (2)", "🤖" * 14 + " (2)"),
        ("a\x07b\u202ec\n", "", "abc"),
        ("\x00", "", "robot"),
    ],
)
def test_the_name_of_a_service(robot: str, ending: str, name: str) -> None:
    assert label(robot, ending) == name


@given(st.text(max_size=80), st.integers(0, 70))
def test_a_cut_text_is_a_beginning(text: str, size: int) -> None:
    assert len(cut(text, size).encode()) <= size
    assert text.encode(errors="replace").startswith(cut(text, size).encode())
    assert 0 < len(label(text, " (2)").encode()) <= 63


@pytest.mark.parametrize(
    ("hosts", "addresses"),
    [
        (("",), [0, 1, 2]),
        (("0.0.0.0",), [0, 1]),
        (("::",), [2]),
        (("0.0.0.0", "::"), [0, 1, 2]),
        (("192.0.2.7",), [1]),
        (("192.0.2.7", "2001:db8::1"), [1, 2]),
        (("203.0.113.1",), []),  # on another link
    ],
)
def test_the_addresses_of_a_listener(hosts: tuple[str, ...], addresses: list[int]) -> None:
    found = Service(SECURE_MQTT, 8883, hosts).addresses_of(LINK)
    assert found == [LINK[number] for number in addresses]


def test_there_and_back() -> None:
    assert WANTED.to_line().count(b"\n") == 1
    assert Announcement.from_line(WANTED.to_line()) == WANTED


def test_the_texts_fit() -> None:
    long = Announcement("ü" * 300, "", "h", ())
    assert long.properties() == {"robot": b"\xc3\xbc" * 124}  # 254 bytes with the key
    assert WANTED.properties() == {"robot": b"r2d2", "ca": b"AB" * 32}
    record = b"".join(
        bytes([len(pair)]) + pair
        for pair in (key.encode() + b"=" + value for key, value in WANTED.properties().items())
    )
    assert texts(record) == {"robot": "r2d2", "ca": "AB" * 32}


def settings_of(tmp_path: Path, text: str) -> Settings:
    file = tmp_path / "appliance.yaml"
    file.write_text(text)
    return config.load(file)


def listening(*listeners: tuple[str, int, bool, Any]) -> list[Listening]:
    return [Listening(Bind(host, port), tls, kind) for host, port, tls, kind in listeners]


def test_which_listeners_are_announced(tmp_path: Path) -> None:
    certs.create_authority(tmp_path / "certs")
    ca = tmp_path / "certs/ca.crt"
    settings = settings_of(tmp_path, "robot: r2d2\n")
    found = announcement(
        settings,
        listening(
            ("0.0.0.0", 8883, True, "mqtt"),
            ("::", 8883, True, "mqtt"),
            ("127.0.0.1", 1883, False, "mqtt"),
            ("192.0.2.1", 1884, False, "mqtt"),
            ("", 8443, True, "web"),
            ("", 9443, True, "websocket"),
            ("::1", 8884, True, "mqtt"),
        ),
        ca.read_bytes() * 2,
        "appliance-0",
        {},
    )
    assert isinstance(found, Announcement)
    assert found.services == (
        Service(SECURE_MQTT, 8883, ("0.0.0.0", "::")),
        Service(HTTPS, 8443, ("",)),
    )
    assert (found.robot, found.host) == ("r2d2", "appliance-0")
    assert found.ca == certs.fingerprints(ca)[0].replace(":", "")
    assert new_host() != new_host()


@pytest.mark.parametrize(
    ("text", "listeners", "environment", "reason"),
    [
        ("", [("127.0.0.1", 8883, True, "mqtt"), ("::1", 1, True, "web")], {}, "this computer"),
        ("", [("localhost", 8883, True, "mqtt")], {}, "this computer"),
        ("", [("0.0.0.0", 1883, False, "mqtt")], {}, "over TLS"),
        ("", [("0.0.0.0", 8443, True, "websocket")], {}, "over TLS"),
        ("broker: {mdns: false}", [("", 8883, True, "mqtt")], {}, "broker.mdns is false"),
        ("", [("", 8883, True, "mqtt")], {"APPLIANCE_MDNS": "off"}, "APPLIANCE_MDNS=off"),
    ],
)
def test_when_nothing_is_announced(
    tmp_path: Path, text: str, listeners: Any, environment: dict[str, str], reason: str
) -> None:
    settings = settings_of(tmp_path, text)
    found = announcement(settings, listening(*listeners), b"", "h", environment)
    assert isinstance(found, str) and reason in found


def test_a_wrong_setting(tmp_path: Path) -> None:
    with pytest.raises(config.ConfigError, match=r"broker\.mdns"):
        settings_of(tmp_path, "broker:\n  mdns: maybe\n")
