"""Which interfaces others reach this computer by, and which of them are one network."""

from __future__ import annotations

import socket
from ipaddress import ip_interface
from types import SimpleNamespace

import psutil
import pytest

from appliance.host import interfaces
from appliance.host.interfaces import Interface, links, multicast_interfaces


def interface(name: str, index: int, *addresses: str) -> Interface:
    return Interface(name, index, tuple(map(ip_interface, addresses)))


ETH = interface("eth0", 2, "192.0.2.1/24", "2001:db8:1::1/64")
WLAN = interface("wlan0", 3, "192.0.2.7/24")
OTHER = interface("eth1", 4, "198.51.100.1/24")
SIX = interface("eth2", 5, "2001:db8:1::9/64")


def test_interfaces_of_one_network_are_one_link() -> None:
    assert [link.interfaces for link in links([ETH, OTHER, WLAN])] == [(OTHER,), (ETH, WLAN)]
    assert [link.interfaces for link in links([WLAN, SIX, ETH])] == [(SIX, WLAN, ETH)]
    (link,) = links([ETH, WLAN])
    assert str(link) == "eth0, wlan0: 192.0.2.1, 192.0.2.7, 2001:db8:1::1"
    assert links([]) == []


def test_all_have_a_link_local_address() -> None:
    """So that it says nothing about the network."""
    two = [interface("a", 1, "169.254.1.1/16"), interface("b", 2, "169.254.1.2/16")]
    assert len(links(two)) == 2


def test_those_that_others_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    def entry(address: str, netmask: str | None = "255.255.255.0") -> SimpleNamespace:
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        return SimpleNamespace(family=family, address=address, netmask=netmask)

    up = "up,broadcast,running,multicast"
    states = {
        "lo": (True, "up,loopback,running,multicast"),
        "tun0": (True, "up,pointopoint,running,multicast"),
        "can0": (True, "up,running"),
        "eth0": (True, up),
        "eth1": (False, up),  # without a cable
        "eth2": (True, up),  # without an address that others can use
        "gone": (True, up),
    }
    found = {name: [entry("192.0.2.1")] for name in states}
    found["eth0"] += [
        entry("fe80::1%eth0", "ffff:ffff:ffff:ffff::"),
        entry("2001:db8::1", "ffff:ffff:ffff:ffff::"),
        entry("2001:db8::2", None),
        entry("2001:db8::7", "ffff:ffff:ffff:ffff::"),
        SimpleNamespace(family=psutil.AF_LINK, address="02:00:00:00:00:01", netmask=None),
    ]
    found["eth2"] = [entry("fe80::2%eth2", "ffff:ffff:ffff:ffff::")]
    found["new"] = [entry("192.0.2.1")]  # since its state was asked for
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: found)
    monkeypatch.setattr(
        psutil,
        "net_if_stats",
        lambda: {k: SimpleNamespace(isup=is_up, flags=f) for k, (is_up, f) in states.items()},
    )
    temporary = {ip_interface("2001:db8::7").ip}
    monkeypatch.setattr(interfaces, "temporary_addresses", lambda: temporary)

    def index(name: str) -> int:
        if name == "gone":
            raise OSError("no interface with this name")
        return 7

    monkeypatch.setattr(socket, "if_nametoindex", index)
    wanted = map(ip_interface, ("192.0.2.1/24", "2001:db8::1/64", "2001:db8::2/128"))
    assert multicast_interfaces() == [Interface("eth0", 7, tuple(wanted))]
