"""What `broker.listeners` in appliance.yaml restricts, from the file to the client."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
import yaml
from waiting import PATIENCE

from appliance import config
from appliance.app.main import App
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Connack, Connect, Publish, decode_packet

RESTRICTED = {
    "bind": "127.0.0.1:0",
    "anonymous": True,
    "max_qos": 1,
    "retain": False,
    "protocol_versions": [5],
    "client_id_prefixes": ["arm-"],
}
OPEN = {"bind": "127.0.0.1:0", "anonymous": True}


def settings_of(directory: Path, **broker: Any) -> config.Settings:
    for name in ("users.passwd", "acl.conf"):
        (directory / name).write_text("pattern readwrite #\n" if name == "acl.conf" else "")
    path = directory / "appliance.yaml"
    path.write_text(yaml.safe_dump({"broker": broker, "bridge": {"bus": "none"}}))
    return config.load(path)


async def answer(port: int, client_id: str, version: int, *packets: bytes) -> bytes:
    """What the broker says to CONNECT and what is behind it, until it closes or pauses."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(Connect(client_id, version=version).encode())
    writer.write(b"".join(packets))
    writer.write_eof()
    try:
        return await asyncio.wait_for(reader.read(), PATIENCE)
    finally:
        writer.close()


async def test_a_listener_restricts_its_own_clients(tmp_path: Path) -> None:
    app = App(settings_of(tmp_path, listeners=[RESTRICTED, OPEN], limits={"payload_size": "3 B"}))
    await app.start()
    try:
        restricted, other = (port for _, port in app.addresses)
        assert await answer(restricted, "arm-1", 4) == b"\x20\x02\x00\x01"
        assert await answer(restricted, "leg-1", 5) == b"\x20\x03\x00\x85\x00"
        said = await answer(restricted, "arm-1", 5)
        connack = decode_packet(said[0], said[2:], 5)
        assert isinstance(connack, Connack)
        properties = connack.properties or {}
        assert properties[Property.MAXIMUM_QOS] == 1
        assert properties[Property.RETAIN_AVAILABLE] == 0
        retained = Publish("a", b"x", 0, True).encode(5)
        assert (await answer(restricted, "arm-1", 5, retained)).endswith(b"\xe0\x01\x9a")
        large = Publish("a", b"four", 1, False, False, 7).encode(5)
        assert (await answer(restricted, "arm-1", 5, large)).endswith(b"\x40\x03\x00\x07\x97")
        for version in (3, 4, 5):
            assert (await answer(other, "leg-1", version))[3] == 0
        twice = Publish("a", b"x", 2, True, False, 7).encode(4)
        assert (await answer(other, "leg-1", 4, twice)).endswith(b"\x50\x02\x00\x07")
    finally:
        await app.stop()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("max_qos", 3),
        ("max_qos", -1),
        ("max_qos", True),
        ("retain", "no"),
        ("protocol_versions", []),
        ("protocol_versions", ["4"]),
        ("protocol_versions", [3.2]),
        ("client_id_prefixes", [""]),
        ("client_id_prefixes", "arm-"),
        ("anonymous", "never"),
    ],
)
def test_what_is_no_restriction_is_an_error(tmp_path: Path, key: str, value: object) -> None:
    with pytest.raises(config.ConfigError) as raised:
        settings_of(tmp_path, listeners=[{"bind": ":1", key: value}])
    assert f"broker.listeners[0].{key}" in str(raised.value)


@pytest.mark.parametrize("size", ["0 B", "10", "much"])
def test_a_payload_has_some_size(tmp_path: Path, size: object) -> None:
    with pytest.raises(config.ConfigError, match="payload_size"):
        settings_of(tmp_path, limits={"payload_size": size})


def test_versions_need_no_quotes(tmp_path: Path) -> None:
    listener = {"bind": ":1", "protocol_versions": [3.1, "3.1.1", 5]}
    (found,) = settings_of(tmp_path, listeners=[listener]).broker.listeners
    assert found.terms().versions == {3, 4, 5}
