"""Name constraints: for which names and addresses our own CA may sign (RFC 5280, 4.2.1.10).

People install the CA in their phones and browsers. Without constraints, whoever steals its key
could pose as every site of the world. With them, only as machines of private networks, and as the
names that this computer had when the CA was made.

The standard wants the extension marked critical. It is not, because TLS stacks of microcontrollers
(mbedTLS) do not know it and would refuse the certificate. Those that know it (OpenSSL, GnuTLS, Go,
Chromium, Firefox, Apple's) obey it in any case.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Sequence
from ipaddress import IPv4Network, IPv6Network
from typing import Final

from cryptography import x509

from appliance.certs.addresses import Address

#: Names that nobody owns in the public DNS: RFC 6761, 6762 and 8375, and ICANN's decision of 2024.
#: `lan` is the name that home routers give to their network.
PRIVATE_NAMES: Final = ("localhost", "local", "home.arpa", "internal", "lan")

#: Loopback, link-local, private (RFC 1918, 4193) and shared addresses (RFC 6598: VPNs).
PRIVATE_NETWORKS: Final = tuple(
    ipaddress.ip_network(text)
    for text in (
        "127.0.0.0/8",
        "10.0.0.0/8",
        "100.64.0.0/10",
        "169.254.0.0/16",
        "172.16.0.0/12",
        "192.168.0.0/16",
        "::1/128",
        "fc00::/7",
        "fe80::/10",
    )
)

# OpenSSL takes a common name like this for a DNS name when the certificate has no other name.
_LIKE_DNS: Final = re.compile(r"[A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+)+")


def constraints(names: Iterable[str], addresses: Iterable[Address]) -> x509.NameConstraints:
    """Constraints that permit private names and networks, and these names, their subdomains and
    these addresses. A public IPv6 address permits its /64, in which a computer has several."""
    dns = dict.fromkeys([*PRIVATE_NAMES, *(name.lower().rstrip(".") for name in names)])
    found: list[IPv4Network | IPv6Network] = list(PRIVATE_NETWORKS)
    for address in addresses:
        if not any(address in each for each in found):
            bits = 32 if address.version == 4 else 64
            found.append(ipaddress.ip_network((address, bits), strict=False))
    permitted: list[x509.GeneralName] = [x509.DNSName(name) for name in dns]
    permitted += [x509.IPAddress(network) for network in found]
    return x509.NameConstraints(permitted, None)


def outside(authority: x509.Certificate, subjects: Sequence[str | Address]) -> list[str]:
    """The names and addresses for which the authority may not sign."""
    try:
        found = authority.extensions.get_extension_for_class(x509.NameConstraints).value
    except x509.ExtensionNotFound:
        return []
    permitted = found.permitted_subtrees or []
    names = [each.value.lower() for each in permitted if isinstance(each, x509.DNSName)]
    networks = [
        ipaddress.ip_network(str(each.value))
        for each in permitted
        if isinstance(each, x509.IPAddress)
    ]

    def is_permitted(subject: str | Address) -> bool:
        if not isinstance(subject, str):
            return not networks or any(subject in network for network in networks)
        name = subject.lower().rstrip(".")
        return not names or any(name == each or name.endswith(f".{each}") for each in names)

    return [str(subject) for subject in subjects if not is_permitted(subject)]


def misleading(authority: x509.Certificate, common_name: str) -> bool:
    """Whether TLS stacks take a client's name for a DNS name for which the CA may not sign."""
    return bool(_LIKE_DNS.fullmatch(common_name) and outside(authority, [common_name]))
