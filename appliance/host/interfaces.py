"""The computer's network interfaces, and which of them are in one network."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Interface, IPv6Address, IPv6Interface
from pathlib import Path
from typing import Any, Final

import psutil

_IFA_F_TEMPORARY: Final = 0x01  # linux/if_addr.h


@dataclass(frozen=True)
class Interface:
    """An interface that multicast works on, with the addresses that others reach it by.

    Of IPv6 these are without link-local ones, which cannot be used without the name of the other
    computer's interface, and without temporary ones (RFC 8981), which change every day.
    """

    name: str
    index: int
    addresses: tuple[IPv4Interface | IPv6Interface, ...]

    @property
    def networks(self) -> frozenset[object]:
        """The networks that it is in, without those of link-local addresses, as all are in them."""
        return frozenset(each.network for each in self.addresses if not each.is_link_local)


@dataclass(frozen=True)
class Link:
    """Interfaces that lead to the same network, such as cable and Wi-Fi of one LAN."""

    interfaces: tuple[Interface, ...]

    @property
    def addresses(self) -> tuple[IPv4Address | IPv6Address, ...]:
        """All of them, IPv4 first."""
        found = {each.ip for interface in self.interfaces for each in interface.addresses}
        return tuple(sorted(found, key=lambda each: (each.version, each.packed)))

    def __str__(self) -> str:
        names = ", ".join(each.name for each in self.interfaces)
        return f"{names}: {', '.join(map(str, self.addresses))}"


def multicast_interfaces() -> list[Interface]:
    """The interfaces that are connected, can multicast and have an address, by their index.

    Not among them are loopback and tunnels, behind which is one computer and no network.
    """
    states, temporary = psutil.net_if_stats(), temporary_addresses()
    found = []
    for name, entries in psutil.net_if_addrs().items():
        flags = states[name].flags.split(",") if name in states and states[name].isup else ()
        if "multicast" not in flags or "loopback" in flags or "pointopoint" in flags:
            continue
        addresses = [each for each in map(_address, entries) if each is not None]
        usable = tuple(
            each
            for each in dict.fromkeys(addresses)
            if each.version == 4 or not (each.is_link_local or each.ip in temporary)
        )
        try:
            index = socket.if_nametoindex(name)
        except OSError:  # it has just gone
            continue
        if usable:
            found.append(Interface(name, index, usable))
    return sorted(found, key=lambda each: each.index)


def _address(entry: Any) -> IPv4Interface | IPv6Interface | None:
    if entry.family not in (socket.AF_INET, socket.AF_INET6):
        return None
    address = ipaddress.ip_address(entry.address.partition("%")[0])
    mask = int(ipaddress.ip_address(entry.netmask)) if entry.netmask else -1
    length = mask.bit_count() if mask >= 0 else address.max_prefixlen
    return ipaddress.ip_interface(f"{address}/{length}")


def links(interfaces: Iterable[Interface]) -> list[Link]:
    """The interfaces, put together where they are in one network."""
    found: list[tuple[set[object], list[Interface]]] = []
    for interface in interfaces:
        networks, members = set(interface.networks), [interface]
        for other in [each for each in found if each[0] & networks]:
            found.remove(other)
            networks, members = networks | other[0], other[1] + members
        found.append((networks, members))
    return [Link(tuple(members)) for _, members in found]


def temporary_addresses() -> set[IPv6Address]:
    """The temporary addresses (RFC 8981), which only Linux lists."""
    try:
        lines = Path("/proc/net/if_inet6").read_text().splitlines()
    except OSError:
        return set()
    fields = [line.split() for line in lines]
    return {IPv6Address(bytes.fromhex(f[0])) for f in fields if int(f[4], 16) & _IFA_F_TEMPORARY}
