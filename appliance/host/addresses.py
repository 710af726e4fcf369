"""Network prefixes, which limits of an address apply to, and this computer's own address."""

from __future__ import annotations

import socket


def network_prefix(address: str) -> bytes:
    """The key for limits of an address: an IPv4 address, an IPv6 /64, as a site has, or a Unix
    socket.

    `address` is a host, with its port or without: "127.0.0.1", "127.0.0.1:54321", "[::1]:54321";
    or a Unix socket and the connection's number, "unix:/run/mqtt.sock:17".
    """
    if address.startswith("unix:"):
        return address.rpartition(":")[0].encode()
    host = address.rpartition("]")[0][1:] if address.startswith("[") else address
    if host.count(":") < 2:
        return socket.inet_aton(host.partition(":")[0])
    packed = socket.inet_pton(socket.AF_INET6, host.partition("%")[0])
    if packed.startswith(bytes(10) + b"\xff\xff"):  # IPv4, on a listener for both
        return packed[12:]
    return packed[:8]


def own_address() -> str | None:
    """The IPv4 address that other computers most likely reach this one by: that of the interface
    with the default route. None without such a route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.connect(("192.0.2.1", 9))  # TEST-NET-1; a UDP socket that connects sends nothing
        except OSError:
            return None
        address: str = trial.getsockname()[0]
        return address
