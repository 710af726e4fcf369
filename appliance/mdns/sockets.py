"""Sockets for multicast DNS, each of one interface and one version of IP."""

from __future__ import annotations

import contextlib
import socket
import struct
from typing import Final, TypeAlias

from appliance.host.interfaces import Interface

PORT: Final = 5353
GROUPS: Final = {4: "224.0.0.251", 6: "ff02::fb"}

# linux/in.h and linux/in6.h: 0 is to hear only what comes on the socket's own interface.
_IP_MULTICAST_ALL: Final = 49
_IPV6_MULTICAST_ALL: Final = 29

_Options: TypeAlias = list[tuple[int, int, int | bytes]]


def versions(interface: Interface) -> list[int]:
    """The versions of IP that an interface has addresses of."""
    return sorted({each.version for each in interface.addresses})


def sending_socket(interface: Interface, version: int) -> socket.socket:
    """A UDP socket whose multicasts leave on that interface. Raises OSError."""
    index = interface.index
    if version == 4:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        options: _Options = [
            (socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 255),
            (socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("@4x4xi", index)),
        ]
    else:
        sock = socket.socket(socket.AF_INET6, socket.SOCK_DGRAM)
        options = [
            (socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1),
            (socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, 255),
            (socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_IF, struct.pack("@I", index)),
        ]
    _set(sock, options)
    sock.setblocking(False)
    return sock


def multicast_socket(interface: Interface, version: int) -> socket.socket:
    """A socket that also hears what is multicast on that interface, and nothing else.

    Its own address is the group's: so it takes no packet from another responder of this computer,
    such as avahi. Nor has it SO_REUSEPORT: of the sockets with it, the kernel gives a multicast to
    one, of whichever interface. Raises OSError.
    """
    sock = sending_socket(interface, version)
    group, index = GROUPS[version], struct.pack("@I", interface.index)
    options: _Options = [(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)]
    if version == 4:
        member = socket.inet_aton(group) + bytes(4) + index  # struct ip_mreqn of ip(7)
        options += [
            (socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0),
            (socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member),
        ]
    else:
        member = socket.inet_pton(socket.AF_INET6, group) + index
        options.append((socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, member))
    _set(sock, options)
    if version == 6:
        with contextlib.suppress(OSError):  # before Linux 4.20
            sock.setsockopt(socket.IPPROTO_IPV6, _IPV6_MULTICAST_ALL, 0)
    try:
        sock.bind((group, PORT) if version == 4 else (group, PORT, 0, interface.index))
    except OSError:
        sock.close()
        raise
    return sock


def _set(sock: socket.socket, options: _Options) -> None:
    try:
        for level, name, value in options:
            sock.setsockopt(level, name, value)
    except OSError:
        sock.close()
        raise
