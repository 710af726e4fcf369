"""The program that announces the appliance: `python -m appliance.mdns.announcer`.

It is a process of its own, with the lowest priority, because anybody on the network can send it as
much as they like: in the appliance's process, 70,000 packets a second delayed the messages of
clients by 56 ms.

Each line of its input is an `Announcement`, which takes the place of the one before; the end of the
input ends it, which comes also when the appliance is killed. Each line of its output is a JSON
object that says what is announced where.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import resource
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from typing import Any, Final, NoReturn

from async_timeout import timeout
from zeroconf import (  # type: ignore[attr-defined]  # the record types are there, and not exported
    DNSOutgoing,
    DNSQuestion,
    Error,
    ServiceInfo,
    _core,
    current_time_millis,
)
from zeroconf.asyncio import AsyncZeroconf

from appliance.host.interfaces import Link, links, multicast_interfaces
from appliance.mdns.announcement import LABEL_SIZE, Announcement, Service, cut, label
from appliance.mdns.sockets import multicast_socket, versions

#: The most links and addresses of one that are announced: a packet has to have room for them.
LINKS: Final = 16
ADDRESSES: Final = 8

#: Seconds between two looks at the interfaces, and at the names that others announce.
POLL: Final = 2.0

#: Probes of a name, and the seconds between them (RFC 6762, section 8.1).
PROBES: Final = 3
PROBE_INTERVAL: Final = 0.25

#: The names that are tried: the robot's, then "name (2)" and so on. Who claims all of them could
#: otherwise keep this program probing for ever, and the robot from being found.
NAMES: Final = 9

#: The looks at which another may have the same name, though it should give way (RFC 6762, section
#: 8.2): then this one does.
PATIENCE: Final = 5

#: Seconds for the farewell that makes others forget the services at once.
FAREWELL: Final = 0.5

#: The most memory in bytes: what strangers send is kept for a while, up to 10,000 records.
MEMORY: Final = 128 << 20

_CORE: Any = _core
_QUERY, _SRV, _ANY, _IN = 0, 33, 255, 1


class LinkAnnouncer:
    """The services of an announcement on one link."""

    def __init__(self, wanted: Announcement, link: Link) -> None:
        """Open its sockets. Raises OSError or RuntimeError."""
        self._wanted = wanted
        self.link = link
        with contextlib.ExitStack() as opened:
            sockets = [
                opened.enter_context(multicast_socket(interface, version))
                for interface in link.interfaces
                for version in versions(interface)
            ]
            self._mdns = _mdns_on(sockets)
            opened.pop_all()

    async def start(self) -> None:
        """Send and receive from now on."""
        await self._mdns.zeroconf.async_wait_for_start()

    def services(self, name: str) -> list[ServiceInfo]:
        """The services as they are announced here, by that name of the robot."""
        found: list[ServiceInfo] = []
        seen: set[str] = set()
        for number, service in enumerate(self._wanted.services):
            addresses = service.addresses_of(self.link.addresses)[:ADDRESSES]
            # A second port of one kind is another service.
            own = _with_port(name, service) if service.kind in seen else name
            seen.add(service.kind)
            if addresses:
                found.append(
                    ServiceInfo(
                        service.kind,
                        f"{own}.{service.kind}",
                        service.port,
                        properties=dict(self._wanted.properties()),
                        server=f"{self._wanted.host}-{number}.local.",
                        parsed_addresses=[str(each) for each in addresses],
                    )
                )
        return found

    def probe(self, name: str) -> None:
        """Ask whether somebody has the name, and say that it is wanted here."""
        for info in self.services(name):
            packet = DNSOutgoing(_QUERY)
            # Not for answers to this address (QU): another responder of this computer may have
            # the same port, and get them.
            packet.add_question(DNSQuestion(info.name, _ANY, _IN))
            packet.authorities.append(info.dns_service())  # type: ignore[arg-type]
            self._mdns.zeroconf.async_send(packet)

    def rival(self, name: str) -> str:
        """The host that has announced a service of that name, other than this; empty for none."""
        now = current_time_millis()
        for info in self.services(name):
            for record in self._mdns.zeroconf.cache.get_all_by_details(info.name, _SRV, _IN):
                server = str(getattr(record, "server", "")).lower()
                if not record.is_expired(now) and not server.startswith(self._wanted.host):
                    return server or "?"
        return ""

    async def announce(self, name: str) -> None:
        """Announce the services, from now on."""
        # `cooperating_responders`: the names were probed.
        register = self._mdns.async_register_service
        sent = [await register(each, cooperating_responders=True) for each in self.services(name)]
        await asyncio.gather(*sent)

    def repeat(self, name: str) -> None:
        """Announce them again: what others have in their caches by that name is replaced."""
        for each in self.services(name):
            zeroconf = self._mdns.zeroconf
            zeroconf.async_send(zeroconf.generate_service_broadcast(each, None))

    async def close(self, name: str) -> None:
        """Close the sockets, and say farewell to all who know the services by that name.

        Not where another has the name as well: the farewell would be taken for that one's.
        """
        zeroconf = self._mdns.zeroconf
        if self.rival(name):
            zeroconf.registry.async_remove(zeroconf.registry.async_get_service_infos())
        with contextlib.suppress(asyncio.TimeoutError):
            async with timeout(FAREWELL):
                await self._mdns.async_unregister_all_services()
        await self._mdns.async_close()


def _mdns_on(sockets: list[socket.socket]) -> AsyncZeroconf:
    """Zeroconf on these sockets. Those that it makes hear all links: it would answer questions of
    one with the addresses of another."""
    make = _CORE.create_sockets
    _CORE.create_sockets = lambda *_, **__: (None, sockets)
    try:
        return AsyncZeroconf(interfaces=[])
    finally:
        _CORE.create_sockets = make


def _with_port(name: str, service: Service) -> str:
    ending = f" {service.port}"
    return cut(name, LABEL_SIZE - len(ending)) + ending


class Announcer:
    """Announces what `lines` say, and follows the interfaces. `tell` gets what has changed."""

    def __init__(self, lines: asyncio.StreamReader, tell: Callable[[dict[str, Any]], None]) -> None:
        self._lines = lines
        self._tell = tell
        self._told: dict[str, Any] | None = None
        self._reading: asyncio.Task[bytes] | None = None
        #: The number of the name that is tried first, and the name that is announced.
        self._first = 1
        self._name = ""

    async def run(self) -> None:
        """Until the lines end."""
        wanted = await self._next_line(None)
        while wanted:
            wanted = await self._serve(Announcement.from_line(wanted)) or b""

    async def _next_line(self, timeout: float | None) -> bytes | None:
        """The next line, empty at their end; None when there is none in that time."""
        if self._reading is None:
            self._reading = asyncio.create_task(self._lines.readline())
        await asyncio.wait({self._reading}, timeout=timeout)
        if not self._reading.done():
            return None
        line, self._reading = self._reading.result(), None
        return line

    async def _serve(self, wanted: Announcement) -> bytes | None:
        """Announce it until another line comes, which is returned; None asks for the same again."""
        line: bytes | None = None
        self._first = 1
        while line is None:
            there = _links(wanted)
            announcers: list[LinkAnnouncer] = []
            try:
                for link in there:
                    announcers.append(LinkAnnouncer(wanted, link))
                    await announcers[-1].start()
                line = await self._announce(wanted, there, announcers)
            except (Error, OSError, RuntimeError) as error:
                # Such as an interface that has just gone, or a port 5353 that nobody else may use.
                self._say("", (), f"{type(error).__name__}: {error}")
                line = await self._next_line(POLL)
            finally:
                closing = [each.close(self._name) for each in announcers]
                await asyncio.gather(*closing, return_exceptions=True)
        return line

    async def _announce(
        self, wanted: Announcement, there: Sequence[Link], announcers: Sequence[LinkAnnouncer]
    ) -> bytes | None:
        """Announce it on these links; returns when these, or the names of others, have changed."""
        number, name = await self._free_name(wanted, announcers)
        self._name = name
        await asyncio.gather(*(each.announce(name) for each in announcers))
        problem = ""
        if number > NAMES:
            problem = (
                f"all of the names {label(wanted.robot)!r} to {_name(wanted, NAMES)!r} are "
                "announced by others on the network: probably somebody claims every name"
            )
        self._say(name if there else "", there, problem)
        disputes = 0
        while True:
            line = await self._next_line(POLL)
            if line is not None:
                return line
            if _links(wanted) != there:
                self._first = 1  # on another network the name may be free
                return None
            rival = max((each.rival(name) for each in announcers), default="")
            disputes = disputes + 1 if rival else 0
            if number <= NAMES and rival and (rival > wanted.host or disputes > PATIENCE):
                self._first = number + 1
                return None
            if rival:
                for each in announcers:
                    each.repeat(name)

    async def _free_name(
        self, wanted: Announcement, announcers: Sequence[LinkAnnouncer]
    ) -> tuple[int, str]:
        """The first name that nobody else has on any of the links, and its number."""
        for number in range(self._first, NAMES + 1):
            name = _name(wanted, number)
            if not announcers or await self._is_free(name, announcers):
                return number, name
        return NAMES + 1, _name(wanted, NAMES + 1)

    async def _is_free(self, name: str, announcers: Sequence[LinkAnnouncer]) -> bool:
        for _ in range(PROBES):
            for each in announcers:
                each.probe(name)
            await asyncio.sleep(PROBE_INTERVAL)
            if any(each.rival(name) for each in announcers):
                return False
        return True

    def _say(self, name: str, there: Sequence[Link], problem: str) -> None:
        told = {"name": name, "links": [str(each) for each in there], "problem": problem}
        if told != self._told:
            self._told = told
            self._tell(told)


def _name(wanted: Announcement, number: int) -> str:
    """The name with that number; behind the last one is that of this appliance alone."""
    if number > NAMES:
        return label(wanted.robot, f" {wanted.host}")
    return label(wanted.robot, f" ({number})" if number > 1 else "")


def _links(wanted: Announcement) -> list[Link]:
    """The links on which a service has an address."""
    return [
        link
        for link in links(multicast_interfaces())
        if any(service.addresses_of(link.addresses) for service in wanted.services)
    ][:LINKS]


def _tell(told: dict[str, Any]) -> None:
    try:
        print(json.dumps(told), flush=True)  # noqa: T201
    except BrokenPipeError:  # the appliance has gone
        os._exit(0)


def _end(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> NoReturn:
    """A fault, or no more memory: the appliance starts another one."""
    error = context.get("exception")
    print(f"{type(error).__name__}: {error or context.get('message')}", flush=True)  # noqa: T201
    os._exit(1)


async def _run() -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(_end)
    lines = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    await Announcer(lines, _tell).run()


def main() -> None:
    """Run until the input ends."""
    # The end of a service, and Ctrl-C, are meant for the appliance, which ends the input.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(19)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    # What it logs is about what strangers send.
    logging.getLogger("zeroconf").setLevel(logging.CRITICAL)
    asyncio.run(_run())
    os._exit(0)  # what Python does at its end takes seconds with this priority on a busy computer


if __name__ == "__main__":
    main()
