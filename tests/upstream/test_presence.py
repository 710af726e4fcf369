"""What a link says of the robot at the fleet's broker, by itself and as VDA 5050 has it."""

from __future__ import annotations

import json
from datetime import datetime, timedelta, timezone

import jsonschema
import pytest

from appliance.upstream.presence import Presence, Vda5050Presence, presence_messages
from appliance.upstream.rules import Vehicle
from upstream.links import link

AT = datetime(2026, 3, 1, 23, 59, 59, 999_499, timezone(timedelta(hours=2)))


def messages(version: str) -> Vda5050Presence:
    return Vda5050Presence(Vehicle(version, "acme", "0001"), lambda: AT)


def schema(*states: str) -> dict[str, object]:
    """The topic `connection`, from the tables of the standard: 2.0 sections 6.4 and 6.14, 2.1 the
    same, 3.0 sections 6.5 and 7.2."""
    text = {"type": "string", "minLength": 1}
    fields: dict[str, object] = {
        "headerId": {"type": "integer", "minimum": 0, "maximum": 0xFFFF_FFFF},
        "timestamp": {
            "type": "string",
            "pattern": r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z$",
        },
        "version": {"type": "string", "pattern": r"^\d+\.\d+\.\d+$"},
        "manufacturer": text,
        "serialNumber": text,
        "connectionState": {"enum": list(states)},
    }
    return {
        "type": "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }


OF_2 = schema("ONLINE", "OFFLINE", "CONNECTIONBROKEN")
OF_3 = schema("ONLINE", "OFFLINE", "HIBERNATING", "CONNECTION_BROKEN")


@pytest.mark.parametrize(
    ("version", "valid", "broken"),
    [
        ("2.0.0", OF_2, "CONNECTIONBROKEN"),
        ("2.1.0", OF_2, "CONNECTIONBROKEN"),
        ("3.0.0", OF_3, "CONNECTION_BROKEN"),
    ],
)
def test_each_state_is_a_message_of_the_standard(
    version: str, valid: dict[str, object], broken: str
) -> None:
    say = messages(version)
    told = [json.loads(say.payload(each)) for each in Presence]
    for message in told:
        jsonschema.validate(message, valid)
        assert (message["version"], message["manufacturer"]) == (version, "acme")
        assert message["serialNumber"] == "0001"
        assert message["timestamp"] == "2026-03-01T21:59:59.999Z"
    assert [each["connectionState"] for each in told] == ["ONLINE", "OFFLINE", broken]
    assert [each["headerId"] for each in told] == [0, 1, 2]


def test_numbers_are_of_32_bits() -> None:
    say = messages("2.1.0")
    say._next_id = 0xFFFF_FFFF
    told = [json.loads(say.payload(Presence.ONLINE))["headerId"] for _ in range(2)]
    assert told == [0xFFFF_FFFF, 0]


def test_without_a_profile_it_is_a_word() -> None:
    say = presence_messages(link())
    assert [say.payload(each) for each in Presence] == [b"online", b"offline", b"offline"]


def test_the_day_of_a_link_is_that_of_the_computer() -> None:
    say = presence_messages(link("profile: {vda5050: {manufacturer: acme}}"))
    told = json.loads(say.payload(Presence.ONLINE))["timestamp"]
    now = datetime.now(timezone.utc)
    assert abs(now - datetime.fromisoformat(told.replace("Z", "+00:00"))) < timedelta(minutes=1)
