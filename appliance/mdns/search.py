"""Looks for appliances on the networks of this computer; what answers may be anybody.

A few questions are multicast, and what comes is read for some seconds. No answer is believed: each
has to be of the right form, and all of them together have a limit.
"""

from __future__ import annotations

import contextlib
import re
import selectors
import socket
import struct
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any, Final

from zeroconf import DNSIncoming  # type: ignore[attr-defined]  # it is there, and not exported

from appliance.host.interfaces import Interface
from appliance.mdns.announcement import CA, HTTPS, ROBOT, SECURE_MQTT
from appliance.mdns.sockets import GROUPS, PORT, multicast_socket, sending_socket, versions

#: The largest packet (RFC 6762, section 17).
PACKET_SIZE: Final = 9000

#: The most that is kept of what is answered: services, host names, and addresses of one; and the
#: bytes of the packets that they are read from. With more, somebody floods the network.
SERVICES: Final = 2000
HOSTS: Final = 4000
ADDRESSES: Final = 16
BYTES: Final = 4 << 20

#: When the questions are asked, in seconds from the beginning (RFC 6762, section 5.2), and the most
#: questions about single services that are missing something.
ASKED_AT: Final = (0.0, 1.0, 3.0, 7.0, 15.0, 31.0)
QUESTIONS: Final = 20

#: The CA's SHA-256 in a TXT record.
FINGERPRINT: Final = re.compile(r"[0-9A-F]{64}")

#: What a packet has in it that is worth decoding: a label, with its length.
_WORTH_IT: Final = (b"\x0c_secure-mqtt", b"\x06_https", b"appliance-")

_KINDS: Final = (SECURE_MQTT, HTTPS)
_PTR, _TXT, _SRV, _A, _AAAA, _ANY, _IN = 12, 16, 33, 1, 28, 255, 1

Address = IPv4Address | IPv6Address


@dataclass(frozen=True)
class FoundAppliance:
    """An appliance, as it says of itself: anybody on the network can say the same.

    `name` is that of its services, such as "r2d2 (2)"; `ca` the CA's fingerprint, empty when it has
    not said one.
    """

    robot: str
    name: str
    addresses: tuple[Address, ...]
    mqtt: tuple[int, ...]
    console: tuple[int, ...]
    ca: str


@dataclass
class _Service:
    port: int = 0
    host: str = ""
    text: dict[str, str] | None = None


@dataclass
class Answers:
    """What was answered so far."""

    services: dict[tuple[str, str], _Service] = field(default_factory=dict)
    hosts: dict[str, set[Address]] = field(default_factory=dict)
    size: int = 0
    is_full: bool = False

    def take(self, packet: bytes) -> None:
        """Read a packet, if it is one of these services'."""
        if (
            len(packet) < 12
            or not packet[2] & 0x80
            or not any(each in packet for each in _WORTH_IT)
        ):
            return
        self.is_full = self.is_full or self.size + len(packet) > BYTES
        if self.is_full:
            return
        self.size += len(packet)
        for record in DNSIncoming(packet).answers():
            self._take(record)

    def _take(self, record: Any) -> None:
        if record.type == _PTR and record.name.lower() in _KINDS:
            self._service(record.alias, bool(record.ttl))
        elif record.type == _SRV and (service := self._service(record.name, bool(record.ttl))):
            service.port, service.host = record.port, record.server.lower()
        elif record.type == _TXT and (service := self._service(record.name, bool(record.ttl))):
            service.text = texts(record.text)
        elif record.type in (_A, _AAAA) and record.ttl:
            addresses = self.hosts.get(record.name.lower())
            if addresses is None and len(self.hosts) < HOSTS:
                addresses = self.hosts[record.name.lower()] = set()
            if addresses is not None and len(addresses) < ADDRESSES:
                addresses.add(ip_address(record.address))

    def _service(self, name: str, is_there: bool) -> _Service | None:
        """The service of that name; None when it is of another kind, has gone, or is too many."""
        kind = next((each for each in _KINDS if name.lower().endswith(f".{each}")), "")
        if not kind:
            return None
        key = kind, name[: -len(kind) - 1]
        if not is_there:
            self.services.pop(key, None)
            return None
        if key not in self.services and len(self.services) >= SERVICES:
            self.is_full = True
            return None
        return self.services.setdefault(key, _Service())

    def missing(self) -> list[str]:
        """Names of which not everything is known yet."""
        return [
            service.host if service.host and service.text else f"{name}.{kind}"
            for (kind, name), service in self.services.items()
            if not (service.text and service.host in self.hosts)
        ][:QUESTIONS]

    def appliances(self) -> list[FoundAppliance]:
        """Those that have said all about themselves, by robot and address.

        Services are one appliance's where name, robot, CA and addresses are the same.
        """
        found: dict[tuple[Any, ...], dict[str, set[int]]] = {}
        for (kind, name), service in self.services.items():
            addresses = self.hosts.get(service.host)
            text = service.text or {}
            if not addresses or not text.get(ROBOT) or not service.port:
                continue
            ca = text.get(CA, "")
            ports = f" {service.port}"  # of a second service of one kind
            where = tuple(sorted(addresses, key=lambda each: (each.version, each.packed)))
            key = (
                text[ROBOT],
                name.removesuffix(ports),
                where,
                ca if FINGERPRINT.fullmatch(ca) else "",
            )
            found.setdefault(key, {each: set() for each in _KINDS})[kind].add(service.port)
        return [
            FoundAppliance(
                robot, name, where, tuple(sorted(by[SECURE_MQTT])), tuple(sorted(by[HTTPS])), ca
            )
            for (robot, name, where, ca), by in sorted(
                found.items(), key=lambda each: (each[0][0], [a.packed for a in each[0][2]])
            )
        ]


def texts(record: bytes) -> dict[str, str]:
    """The values of a TXT record (RFC 6763, section 6): of a key that comes again, the first."""
    found: dict[str, str] = {}
    while record:
        size, record = record[0], record[1:]
        key, is_pair, value = record[:size].partition(b"=")
        record = record[size:]
        if is_pair and key:
            found.setdefault(key.decode(errors="replace").lower(), value.decode(errors="replace"))
    return found


def question(names: Iterable[tuple[str, int]], number: int = 0) -> bytes:
    """A query for records of these names and types (RFC 1035, section 4), with that id."""
    asked = b""
    count = 0
    for name, kind in names:
        labels = _labels(name)
        if labels:
            asked += labels + struct.pack("!HH", kind, _IN)
            count += 1
    return struct.pack("!HHHHHH", number, 0, count, 0, 0, 0) + asked


def _labels(name: str) -> bytes:
    """A name in its labels; empty when it cannot be one. That of a service may have dots in it."""
    kind = next((each for each in _KINDS if name.endswith(f".{each}")), "")
    parts = [name[: -len(kind) - 1], *kind.split(".")] if kind else name.split(".")
    found = b""
    for part in filter(None, parts):
        text = part.encode()
        if len(text) > 63:
            return b""
        found += bytes([len(text)]) + text
    return found + b"\0" if found else b""


def search(
    interfaces: Sequence[Interface],
    seconds: float,
    tell: Callable[[Answers], None] = lambda answers: None,
) -> Answers:
    """Ask on these interfaces, and listen for so many seconds; `tell` gets what there is so far.

    It ends earlier with more answers than are taken. Raises OSError when no socket can be opened.
    """
    answers = Answers()
    with contextlib.ExitStack() as stack:
        sockets = _open(interfaces, stack)
        selector = stack.enter_context(selectors.DefaultSelector())
        for sock, _ in sockets:
            selector.register(sock, selectors.EVENT_READ)
        began = time.monotonic()
        asked = 0
        while (passed := time.monotonic() - began) < seconds and not answers.is_full:
            if asked < len(ASKED_AT) and passed >= ASKED_AT[asked]:
                asked += 1
                _ask(sockets, answers)
            tell(answers)
            due = ASKED_AT[asked] if asked < len(ASKED_AT) else seconds
            for key, _ in selector.select(max(0.0, min(due, seconds, passed + 0.5) - passed)):
                with contextlib.suppress(OSError):
                    answers.take(key.fileobj.recv(PACKET_SIZE))  # type: ignore[union-attr]
    return answers


def _ask(sockets: Sequence[tuple[socket.socket, str]], answers: Answers) -> None:
    wanted = [[(kind, _PTR) for kind in _KINDS]]
    missing = answers.missing()
    if missing:
        wanted.append([(name, _ANY) for name in missing])
    for number, (sock, group) in enumerate(sockets):
        for names in wanted:
            # Each with a number of its own: responders ignore what comes again at once.
            with contextlib.suppress(OSError):  # an interface that has just gone
                sock.sendto(question(names, number), (group, PORT))


def _open(
    interfaces: Sequence[Interface], stack: contextlib.ExitStack
) -> list[tuple[socket.socket, str]]:
    """Sockets for each interface and version of IP, and the group that they send to.

    One has the port of multicast DNS: firewalls let in what comes there, and it is answered by
    multicast, up to a second later where another has just asked the same. The other has a port of
    its own, to which the answer comes at once (RFC 6762, section 6.7).
    """
    found: list[tuple[socket.socket, str]] = []
    failed: OSError | None = None
    for interface in interfaces:
        for version in versions(interface):
            for make in (multicast_socket, sending_socket):
                try:
                    sock = stack.enter_context(make(interface, version))
                except OSError as error:
                    failed = error
                else:
                    found.append((sock, GROUPS[version]))
    if not found and failed is not None:
        raise failed
    return found
