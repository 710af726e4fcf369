"""What is announced of an appliance, and under which names; pure."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

#: The types of services: MQTT over TLS, and the console.
SECURE_MQTT: Final = "_secure-mqtt._tcp.local."
HTTPS: Final = "_https._tcp.local."

#: The keys of a service's TXT record: the robot's name, and the SHA-256 of the CA's certificate.
ROBOT: Final = "robot"
CA: Final = "ca"

#: The most bytes of a label (RFC 1035, section 2.3.4), and of a string in a TXT record.
LABEL_SIZE: Final = 63
TEXT_SIZE: Final = 255


@dataclass(frozen=True)
class Service:
    """A port, and the addresses that it is open on; an empty one is all, `0.0.0.0` all of IPv4."""

    kind: str
    port: int
    hosts: tuple[str, ...]

    def addresses_of(
        self, link: Iterable[IPv4Address | IPv6Address]
    ) -> list[IPv4Address | IPv6Address]:
        """Those of a link's addresses that the port is open on."""
        every = {"": (4, 6), "0.0.0.0": (4,), "::": (6,)}
        versions = {version for host in self.hosts for version in every.get(host, ())}
        single = {ip_address(host) for host in self.hosts if host not in every}
        return [each for each in link if each.version in versions or each in single]


@dataclass(frozen=True)
class Announcement:
    """All that is announced. `host` is the beginning of the host names that it has for itself:
    they are of this run of the appliance alone, so that it knows its own records by them.
    """

    robot: str
    ca: str
    host: str
    services: tuple[Service, ...]

    def to_line(self) -> bytes:
        """The line by which the announcing program is told."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: bytes) -> Announcement:
        """Raises ValueError, KeyError or TypeError when it is no such line."""
        given = json.loads(line)
        services = tuple(
            Service(each["kind"], each["port"], tuple(each["hosts"])) for each in given["services"]
        )
        return cls(given["robot"], given["ca"], given["host"], services)

    def properties(self) -> dict[str, bytes]:
        """The TXT record."""
        robot = cut(self.robot, TEXT_SIZE - len(f"{ROBOT}="))
        found = {ROBOT: robot.encode()}
        return {**found, CA: self.ca.encode()} if self.ca else found


def label(robot: str, ending: str = "") -> str:
    """The name of a robot's service: one label, with the ending whole.

    A dot would end the label in some programs, so it becomes a hyphen; the TXT record has the
    robot's name as it is.
    """
    text = "".join(each for each in robot.replace(".", "-") if each.isprintable()).strip()
    return cut(text or "robot", LABEL_SIZE - len(ending.encode())) + ending


def cut(text: str, size: int) -> str:
    """As much of the text's beginning as has so many bytes in UTF-8."""
    return text.encode(errors="replace")[:size].decode(errors="ignore")
