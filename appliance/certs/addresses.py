"""The names and addresses under which clients reach this computer."""

from __future__ import annotations

import ipaddress
import re
import socket
import threading
from ipaddress import IPv4Address, IPv6Address
from typing import Final, TypeAlias

import psutil

from appliance.host.interfaces import temporary_addresses

Address: TypeAlias = IPv4Address | IPv6Address

DNS_NAME: Final = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?:\.[A-Za-z0-9_-]{1,63})*\.?")
_RESOLVER_PATIENCE: Final = 3.0  # seconds


def local_names() -> tuple[list[str], list[Address]]:
    """The names and addresses that go into a certificate of this computer.

    The names are the host's, the one that the resolver has for it (waiting at most 3 s), the
    multicast DNS name and `localhost`. The addresses are those of all interfaces, except link-local
    IPv6, which clients cannot use without the name of their interface, and temporary IPv6, which
    changes every day and which nobody dials.
    """
    hostname = socket.gethostname()
    short = hostname.partition(".")[0]
    names = [hostname, _full_name(hostname), f"{short}.local", "localhost"]
    names = [name.lower().rstrip(".") for name in names if DNS_NAME.fullmatch(name)]
    addresses: set[Address] = {IPv4Address("127.0.0.1"), IPv6Address("::1")}
    temporary = temporary_addresses()
    for entries in psutil.net_if_addrs().values():
        for entry in entries:
            if entry.family in (socket.AF_INET, socket.AF_INET6):
                address = ipaddress.ip_address(entry.address.partition("%")[0])
                if address.version == 4 or not (address.is_link_local or address in temporary):
                    addresses.add(address)
    return list(dict.fromkeys(names)), sorted(addresses, key=lambda a: (a.version, a.packed))


def _full_name(hostname: str) -> str:
    """The fully qualified name; `hostname` when DNS does not answer in time, as in a field."""
    found = [hostname]
    # getfqdn() has no timeout, and a daemon thread does not delay the end of the process.
    thread = threading.Thread(target=lambda: found.append(socket.getfqdn(hostname)), daemon=True)
    thread.start()
    thread.join(_RESOLVER_PATIENCE)
    return found[-1] if not found[-1].endswith(".arpa") else hostname
