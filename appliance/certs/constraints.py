"""For which names and addresses our own authority may sign (RFC 5280, section 4.2.1.10).

People install it in their phones and browsers. Without constraints whoever gets hold of its key
could pose as every site of the world; with them, as machines of private networks only, and under
the names that this computer had when the authority was made.

The extension is not marked critical, as the standard wants it: stacks of microcontrollers (mbedTLS)
do not know it and would refuse the certificate, while those that do know it (OpenSSL, GnuTLS, Go,
Chromium, Firefox, Apple's) obey it all the same.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Sequence
from ipaddress import IPv4Network, IPv6Network
from typing import Final

from cryptography import x509

from appliance.certs.addresses import Address

#: Names that are nobody's in the world's DNS: RFC 6761, 6762 and 8375, ICANN's decision of 2024;
#: `lan` is what home routers call their network.
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

# A subject of these characters with a dot in it is to OpenSSL a DNS name, when there is no other.
_LIKE_DNS: Final = re.compile(r"[A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+)+")


def constraints(names: Iterable[str], addresses: Iterable[Address]) -> x509.NameConstraints:
    """Private names and networks, these names and what is below them, and these addresses; of a
    public IPv6 address its network of 64 bits, in which a computer has several."""
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
    """Those of the names and addresses for which the authority may not sign."""
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
    """Whether TLS stacks take a client's name for a DNS name that the authority may not sign."""
    return bool(_LIKE_DNS.fullmatch(common_name) and outside(authority, [common_name]))
