"""What a link says at the fleet's broker of whether the robot is online.

It is one topic, retained: the last will, and what is published there when the link is up and before
it ends in good order.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timezone
from enum import Enum
from typing import Protocol

import orjson

from appliance.upstream.rules import UpstreamSettings, Vehicle

_UINT32 = 0xFFFF_FFFF


class Presence(Enum):
    """Whether the robot is there; the will says BROKEN."""

    ONLINE = "online"
    OFFLINE = "offline"
    BROKEN = "broken"


class PresenceMessages(Protocol):
    """Makes the payloads."""

    def payload(self, presence: Presence) -> bytes:
        """What is published now."""


class PlainPresence:
    """`online` or `offline`."""

    def payload(self, presence: Presence) -> bytes:
        """See `PresenceMessages`."""
        return b"online" if presence is Presence.ONLINE else b"offline"


class Vda5050Presence:
    """The messages of VDA 5050's topic `connection` (2.1 section 6.14, 3.0 section 6.5).

    `clock` returns the time of day. Numbers begin anew with the process; that of the will is lower
    than the one of the message that follows it, although it is published later, by the standard.
    """

    def __init__(self, vehicle: Vehicle, clock: Callable[[], datetime]) -> None:
        self._vehicle = vehicle
        self._clock = clock
        self._next_id = 0
        broken = "CONNECTIONBROKEN" if vehicle.version < "3" else "CONNECTION_BROKEN"
        self._states = {
            Presence.ONLINE: "ONLINE",
            Presence.OFFLINE: "OFFLINE",
            Presence.BROKEN: broken,
        }

    def payload(self, presence: Presence) -> bytes:
        """See `PresenceMessages`."""
        number, self._next_id = self._next_id, self._next_id + 1 & _UINT32
        now = self._clock().astimezone(timezone.utc).replace(tzinfo=None)
        vehicle = self._vehicle
        message = {
            "headerId": number,
            "timestamp": now.isoformat(timespec="milliseconds") + "Z",
            "version": vehicle.version,
            "manufacturer": vehicle.manufacturer,
            "serialNumber": vehicle.serial_number,
            "connectionState": self._states[presence],
        }
        return orjson.dumps(message)


def presence_messages(settings: UpstreamSettings) -> PresenceMessages:
    """Those of a link."""
    if settings.vehicle is None:
        return PlainPresence()
    return Vda5050Presence(settings.vehicle, lambda: datetime.now(timezone.utc))
