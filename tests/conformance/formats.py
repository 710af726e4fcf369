"""What both versions' tests of the format of packets try."""

from __future__ import annotations

import pytest
from _pytest.mark import ParameterSet
from client_v311 import Client, Wire, wire

from appliance.mqtt.packets import Puback, Publish, Pubrec

statement = pytest.mark.statement

#: Bytes that are no UTF-8 of MQTT.
ILL_FORMED = {
    "no first byte": "61 80 62",
    "no second byte": "61 c3",
    "no such byte": "ff",
    "longer than it needs to be": "c0 af",
    "U+0000 in two bytes": "c0 80",
    "U+D800": "ed a0 80",
    "U+DFFF": "ed bf bf",
    "above U+10FFFF": "f4 90 80 80",
}

packet_ids = pytest.mark.parametrize("packet_id", ["0001", "0100", "ffff"])


def packets_of(connect: Wire, subscribe: Wire, unsubscribe: Wire) -> dict[str, tuple[int, bytes]]:
    """What a client sends, by its name: the first byte, and the rest."""
    packets: dict[str, Wire] = {
        "CONNECT": connect,
        "PUBACK": "40 02 0001",
        "PUBREC": "50 02 0001",
        "PUBREL": "62 02 0001",
        "PUBCOMP": "70 02 0001",
        "SUBSCRIBE": subscribe,
        "UNSUBSCRIBE": unsubscribe,
        "PINGREQ": "c0 00",
        "DISCONNECT": "e0 00",
    }
    return {name: (wire(packet)[0], wire(packet)[1:]) for name, packet in packets.items()}


def packet_names(version: str) -> list[str | ParameterSet]:
    """The names of `packets_of`, with the statements on the flags of each in this version."""
    return [
        "CONNECT",
        "PUBACK",
        "PUBREC",
        pytest.param("PUBREL", marks=statement(version, "MQTT-3.6.1-1")),
        "PUBCOMP",
        pytest.param("SUBSCRIBE", marks=statement(version, "MQTT-3.8.1-1")),
        pytest.param("UNSUBSCRIBE", marks=statement(version, "MQTT-3.10.1-1")),
        "PINGREQ",
        pytest.param("DISCONNECT", marks=statement(version, "MQTT-3.14.1-1")),
    ]


def check_identifiers(receiver: Client, sender: Client) -> None:
    """An identifier is used again only after the last acknowledgement, and then each of them is."""
    receiver.subscribe("#", 2)
    held = []
    for name in ("no PUBACK", "no PUBREC", "no PUBCOMP"):
        sender.publish("a", b"", 1 if name == "no PUBACK" else 2)
        (message,) = receiver.messages()
        held.append(message.packet_id)
        if name == "no PUBCOMP":
            assert receiver.say(Pubrec(3).encode(receiver.version)) == wire("62 02 0003")
    assert held == [1, 2, 3]
    used = set(held)
    for _ in range(65535 // 15 + 1):  # once around
        sender.send(*[Publish("a", b"", 1, packet_id=1)] * 15)
        ids = [message.packet_id for message in receiver.messages()]
        assert len(set(ids)) == 15 and not {0, *held}.intersection(ids)
        receiver.send(*map(Puback, ids))
        used.update(ids)
    assert used == set(range(1, 65536))
