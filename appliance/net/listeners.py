"""Listeners: TCP, TLS, WebSocket and Unix sockets, and the limits on new connections."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, cast

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.limits import USUAL_TERMS, VERSIONS, Terms
from appliance.host.addresses import network_prefix
from appliance.mqtt.reason import ReasonCode
from appliance.net.connection import ClientConnection
from appliance.net.layers import UpperLayer
from appliance.net.scheduler import (
    LINGERING_CLOSES,
    Authenticate,
    BeginExchange,
    CertificatePolicy,
    ScheduledConnection,
    Scheduler,
)
from appliance.net.sockets import allow_files, listen, listen_on_path
from appliance.net.websocket import WebSocket

if TYPE_CHECKING:
    from appliance.net.http import HttpSite

log = logging.getLogger(__name__)

#: Connections that are accepted in one turn: a TLS handshake takes a millisecond, and other clients
#: wait.
ACCEPTED_A_TURN = 16

#: Seconds until connections are accepted again after the system refused one.
ACCEPT_PAUSE = 0.5

#: TLS handshakes at a time. Further connections wait in the system's backlog, where they cost
#: nothing and no time limit of ours runs.
HANDSHAKES = 64

#: Seconds in which no handshake has ended, after which those in progress no longer delay others:
#: they wait for the network, or are not meant to end.
HANDSHAKE_STALL = 0.25

#: Seconds by which one address may exceed `limits.connection_rate` in a burst.
CONNECTION_BURST = 5.0

#: The address of all Unix sockets.
UNIX = b""

#: Evict idle addresses when the table exceeds this size.
ADDRESSES = 1024

#: Seconds that clients have at shutdown to read what was written to them.
STOP_TIMEOUT = 1.0

#: Guests: connections that have not logged in, or are closing. So many may exist beside the
#: clients.
GUESTS = 256

#: Files that the process opens beside its clients' connections.
OTHER_FILES = GUESTS + LINGERING_CLOSES + 256


@dataclass(frozen=True, slots=True)
class Admission:
    """Limits on connections, of `broker.limits` in appliance.yaml; infinity for no limit."""

    connections: int
    connect_timeout: float
    connections_per_address: float = math.inf
    connection_rate: float = math.inf
    publish_rate: float = math.inf


@dataclass(frozen=True, slots=True)
class ListenerSettings:
    """Where a listener listens: an address, or with `path` a Unix socket of that mode.

    `context` is called at each connection for its TLS settings, so that these can be replaced; None
    means no TLS.
    """

    host: str
    port: int
    context: Callable[[], ssl.SSLContext] | None
    protocol: Literal["mqtt", "websocket", "web"] = "mqtt"
    path: Path | None = None
    mode: int = 0o660
    terms: Terms = USUAL_TERMS

    @property
    def place(self) -> tuple[str, int, Path | None]:
        """The address, which no two listeners can share."""
        return self.host, self.port, self.path


#: What is said in the log of a listener that is not for MQTT as it is.
_KINDS = {"mqtt": "", "websocket": " for WebSocket", "web": " for the web"}

#: Makes what is between a connection and TCP or TLS; None for nothing.
_Layer: TypeAlias = "Callable[[ClientConnection], asyncio.Protocol] | None"


class Listeners:
    """All listening sockets; `scheduler` has the connections made to them.

    `site` makes what listeners for the web serve; it is called when there is the first of them.
    """

    def __init__(
        self,
        broker: Broker,
        authenticate: Authenticate,
        exchange: BeginExchange,
        admission: Admission,
        certificates: CertificatePolicy | None = None,
        site: Callable[[], HttpSite] | None = None,
    ) -> None:
        self.broker = broker
        self.admission = admission
        self._certificate_user = certificates.username if certificates is not None else None
        self._make_site = site
        self._site: HttpSite | None = None
        self._addresses = _AddressLimits(admission)
        self.scheduler = Scheduler(
            broker,
            authenticate,
            exchange,
            self._addresses,
            connect_timeout=admission.connect_timeout,
            publish_rate=admission.publish_rate,
            certificates=certificates,
        )
        self._sockets: list[_ListeningSocket] = []
        self._handshakes: set[ClientConnection] = set()
        self._stall: asyncio.TimerHandle | None = None

    @property
    def addresses(self) -> list[tuple[str, int]]:
        """The addresses, with the port that the system chose where it was 0."""
        return [sock.address for sock in self._sockets]

    def sockets(self) -> list[tuple[str, ListenerSettings]]:
        """Each listener's address, as the log shows it, and its settings."""
        return [(str(sock), sock.settings) for sock in self._sockets]

    def bound(self) -> list[tuple[str, int, ListenerSettings]]:
        """The address, not a name for it, the port and the settings of each TCP listener; an empty
        address is all of this computer's."""
        return [sock.bound for sock in self._sockets if sock.settings.path is None]

    def prepare(self, settings: list[ListenerSettings]) -> list[_ListeningSocket]:
        """Open the sockets for these settings, for `take`; sockets that exist are reused.

        Raises:
            OSError: an address cannot be listened on; nothing has changed then.
        """
        leaving = list(self._sockets)
        reused: list[_ListeningSocket | None] = []
        for listener in settings:
            # Of several with a port chosen by the system, the order decides.
            same = (sock for sock in leaving if sock.settings.place == listener.place)
            reused.append(next(same, None))
            if reused[-1] is not None:
                leaving.remove(reused[-1])
        sockets: list[_ListeningSocket] = []
        try:
            for listener, sock in zip(settings, reused, strict=True):
                sockets.append(sock or _ListeningSocket(self, listener, leaving))
        except BaseException:
            self.drop(sockets)
            raise
        return sockets

    def drop(self, sockets: list[_ListeningSocket]) -> None:
        """Close prepared sockets that are not taken after all."""
        for sock in sockets:
            if sock not in self._sockets:
                sock.close()

    def take(
        self,
        sockets: list[_ListeningSocket],
        settings: list[ListenerSettings],
        admission: Admission,
    ) -> None:
        """Put prepared sockets into service and close the others; open connections stay."""
        self.admission = admission
        if self._site is None and any(listener.protocol == "web" for listener in settings):
            assert self._make_site is not None
            self._site = self._make_site()
        self._addresses.use(admission)
        self.scheduler.use(admission.connect_timeout, admission.publish_rate)
        allow_files(admission.connections + OTHER_FILES)
        before, self._sockets = self._sockets, sockets
        for sock in before:
            if sock not in sockets:
                sock.close()
                log.info("closed the listener on %s", sock)
        for sock, listener in zip(sockets, settings, strict=True):
            sock.use(listener)
            sock.open()
            if sock not in before:
                log.info("listening%s on %s", _KINDS[listener.protocol], sock)

    async def start(self, settings: list[ListenerSettings]) -> list[tuple[str, int]]:
        """Start to listen; returns the addresses, with the port that was chosen where it was 0.

        Raises:
            OSError: an address cannot be listened on; nothing is left listening.
        """
        self.take(self.prepare(settings), settings, self.admission)
        return self.addresses

    def admit(self, connection: socket.socket, peer: object, listener: ListenerSettings) -> None:
        """Begin an accepted connection, or close it if the limits refuse it."""
        self.broker.counters.sockets += 1
        host = ""
        if listener.path is not None:
            # In the place of a port, a number that no other open connection has.
            address = f"unix:{listener.path}:{connection.fileno()}"
        else:
            host, port = cast("tuple[str, int]", peer)[:2]
            address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        if self._refuse(address, host):
            connection.close()
            return
        protocol = ClientConnection(self.scheduler, address, host, listener.terms)
        self.scheduler.connections.add(protocol)
        self._addresses.add_guest(protocol)
        context = None
        if listener.context is not None:
            context = listener.context()
            self._handshakes.add(protocol)
        layer = self._layer(listener)
        self.scheduler.in_background(self._begin(protocol, connection, context, layer))

    def _refuse(self, address: str, host: str) -> str:
        """Why the limits refuse a new connection, which is counted and logged; empty if not."""
        now = asyncio.get_running_loop().time()
        refusal = (self._addresses.reserve(host, now) if host else "") or self._make_room()
        if refusal:
            self.broker.counters.connections_refused += 1
            self.broker.rate_limited_log.warning(
                log, now, refusal, "%s refused: %s", address, refusal
            )
            if self.broker.audit_log is not None:
                self.broker.audit_log.refused(address, refusal)
        return refusal

    def carry(
        self, address: str, host: str, tls: ssl.SSLObject | None, terms: Terms
    ) -> tuple[socket.socket, UpperLayer] | None:
        """The client's end of a new connection within this process, and its other end, with the
        account of who has logged in; None if the limits refuse it.

        Who asks from there over another protocol is a client of MQTT by it: with all limits, and
        the identity that its own connection's `tls` gives. The version and the client id are not
        the sender's, and no listener is asked about them.
        """
        if self._refuse(address, host):
            return None
        ours, theirs = socket.socketpair()
        for end in (ours, theirs):
            end.setblocking(False)
        terms = replace(terms, versions=VERSIONS, client_id_prefixes=())
        protocol = ClientConnection(self.scheduler, address, host, terms, tls)
        self.scheduler.connections.add(protocol)
        self._addresses.add_guest(protocol)
        self.scheduler.in_background(self._begin(protocol, ours, None, None))
        return theirs, protocol

    def _layer(self, listener: ListenerSettings) -> _Layer:
        if listener.protocol == "websocket":
            user = self._certificate_user
            return partial(WebSocket, scheduler=self.scheduler, certificate_user=user)
        if listener.protocol == "web":
            # Not before: it takes time and memory at the start.
            from appliance.net.http import HttpLayer

            timeout = self.scheduler.connect_timeout
            assert self._site is not None
            return partial(HttpLayer, scheduler=self.scheduler, site=self._site, timeout=timeout)
        return None

    async def _begin(
        self,
        protocol: ClientConnection,
        connection: socket.socket,
        context: ssl.SSLContext | None,
        layer: _Layer,
    ) -> None:
        try:
            await protocol.begin(connection, context, layer)
        finally:
            self._handshakes.discard(protocol)
            if self._stall is not None:
                self._open_sockets()

    def _make_room(self) -> str:
        """Make room for one more connection; or return why there is none.

        Only guests make room here: among users the broker decides that, once the login says who
        comes. Of the address with most guests the oldest one is closed, so that strangers cannot
        keep anybody out, however many come and from wherever.
        """
        limit = self.admission.connections
        if len(self.scheduler.connections) < max(
            limit, self.broker.accounting.accounts.connections + GUESTS
        ):
            return ""
        guest = self._addresses.oldest_guest()
        if guest is None:
            return f"{limit} connections, as many as allowed (broker.limits.connections)"
        guest.make_room()
        return ""

    @property
    def crowded(self) -> bool:
        """Whether as many TLS handshakes are in progress as allowed."""
        return len(self._handshakes) >= HANDSHAKES

    def wait_for_handshakes(self) -> None:
        """Accept again when a handshake has ended, or when none does for a while."""
        if self._stall is None:
            self._stall = self.scheduler.entries.later(
                "listener.stall", HANDSHAKE_STALL, self._pass_stalled, failed=self._open_sockets
            )

    def _pass_stalled(self) -> None:
        self._handshakes.clear()  # they continue, and no longer count
        self._open_sockets()

    def _open_sockets(self) -> None:
        if self._stall is not None:
            self._stall.cancel()
            self._stall = None
        for sock in self._sockets:
            try:
                sock.open()
            except Exception as error:
                self.broker.faults.caught("listener.open", error, sock)
                sock.pause()

    async def check_certificates(self) -> None:
        """Close connections whose client's certificate is not, or no longer, accepted."""

        def check(member: ScheduledConnection) -> None:
            try:
                member.check_certificate()
            except Exception as error:
                member.fault("connection.certificate", error)

        await self.scheduler.in_pieces(list(self.scheduler.connections), check)

    async def stop(self) -> None:
        """Close all listeners and connections; may be called twice."""
        sockets, self._sockets = self._sockets, []
        for sock in sockets:
            sock.close()
        if self._stall is not None:
            self._stall.cancel()
        self.broker.close(
            lambda session: session.close_link(ReasonCode.SERVER_SHUTTING_DOWN, "shutting down")
        )
        await self.scheduler.close(STOP_TIMEOUT)


class _ListeningSocket:
    """One listening socket; it may take over the port of one that is `leaving` (to be closed)."""

    def __init__(
        self, listeners: Listeners, settings: ListenerSettings, leaving: list[_ListeningSocket]
    ) -> None:
        self._listeners = listeners
        self.settings = settings
        self._entries = listeners.scheduler.entries
        self._is_open = False
        if settings.path is not None:
            self._socket = listen_on_path(settings.path, settings.mode)
            self._inode = settings.path.stat().st_ino
            self.address = (f"unix:{settings.path}", 0)
        else:
            same = [sock._socket for sock in leaving if sock.address[1] == settings.port > 0]
            self._socket = listen(settings.host, settings.port, same)
            self.address = (settings.host, self._socket.getsockname()[1])

    def __str__(self) -> str:
        host, port = self.address
        return host if self.settings.path is not None else f"{host or '*'}:{port}"

    @property
    def bound(self) -> tuple[str, int, ListenerSettings]:
        """See `Listeners.bound`."""
        host, port = self._socket.getsockname()[:2]
        return host if self.settings.host else "", port, self.settings

    def use(self, settings: ListenerSettings) -> None:
        """Apply these settings to connections that are accepted from now on."""
        if settings.path is not None and settings.mode != self.settings.mode:
            with contextlib.suppress(OSError):  # it may be gone
                settings.path.chmod(settings.mode)
        self.settings = settings

    def open(self) -> None:
        """Accept connections; does nothing when it is open already, or closed for good."""
        if not self._is_open and self._socket.fileno() >= 0:
            self._is_open = True
            self._entries.reader(
                "listener.accept", self._socket, self._accept, served=self, failed=self.pause
            )

    def _shut(self) -> None:
        if self._is_open:
            self._is_open = False
            self._entries.loop.remove_reader(self._socket)

    def pause(self) -> None:
        """Accept nothing for `ACCEPT_PAUSE` seconds."""
        self._shut()
        self._entries.later(
            "listener.reopen", ACCEPT_PAUSE, self.open, served=self, failed=self.pause
        )

    def _accept(self) -> None:
        for _ in range(ACCEPTED_A_TURN):
            if self.settings.context is not None and self._listeners.crowded:
                self._shut()
                self._listeners.wait_for_handshakes()
                return
            try:
                connection, peer = self._socket.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError as error:
                # Most likely out of file descriptors: that passes, and trying again at once would
                # spin.
                log.error("no connection can be accepted: %s", error)
                self.pause()
                return
            try:
                self._listeners.admit(connection, peer, self.settings)
            except Exception as error:
                self._listeners.broker.faults.caught("listener.admit", error, self)
                connection.close()

    def close(self) -> None:
        """Stop listening."""
        self._shut()
        self._socket.close()
        path = self.settings.path
        if path is not None:
            with contextlib.suppress(OSError):  # it may be gone, or another's by now
                if path.stat().st_ino == self._inode:
                    path.unlink()


@dataclass(slots=True)
class _AddressState:
    """The connections of one address."""

    #: Connections that have not logged in, or are closing, oldest first.
    guests: dict[ScheduledConnection, None] = field(default_factory=dict)
    #: Connections that have logged in, counted by user.
    clients: dict[Account, int] = field(default_factory=dict)
    #: When the connections that it has opened are covered by the allowed rate (a virtual clock).
    paid_at: float = 0.0


class _AddressLimits:
    """The `AdmissionPolicy`: limits the connections of each address, and how fast it opens them.

    The connections of each user, and those before the login, are counted separately: a user cannot
    keep out others who share its address. All Unix sockets are one address, without a limit.
    """

    def __init__(self, admission: Admission) -> None:
        self.use(admission)
        self._known: dict[bytes, _AddressState] = {}
        self._evict_at = ADDRESSES

    def use(self, admission: Admission) -> None:
        """Apply these limits from now on."""
        self._limit = admission.connections_per_address
        self._rate = admission.connection_rate

    def reserve(self, host: str, now: float) -> str:
        """Count a new connection against the rate; or return why it is refused, uncounted."""
        where = network_prefix(host)
        state = self._known.get(where)
        if state is None:
            if len(self._known) >= self._evict_at:
                self._evict_idle(now)
            state = self._known[where] = _AddressState()
        if len(state.guests) >= self._limit:
            return (
                f"its address has {len(state.guests)} connections that have not logged in "
                "(broker.limits.connections_per_address)"
            )
        paid_at = max(state.paid_at, now) + 1 / self._rate
        if paid_at > now + CONNECTION_BURST:
            return (
                f"its address opens more than {self._rate:g} connections a second "
                "(broker.limits.connection_rate)"
            )
        state.paid_at = paid_at
        return ""

    def _of(self, member: ScheduledConnection) -> _AddressState:
        where = network_prefix(member.host) if member.host else UNIX
        return self._known.setdefault(where, _AddressState())

    def add_guest(self, member: ScheduledConnection) -> None:
        """Count a connection that was accepted, as a guest."""
        self._of(member).guests[member] = None

    def admit(self, member: ScheduledConnection, account: Account) -> str:
        """See `AdmissionPolicy.admit`."""
        state = self._of(member)
        count = state.clients.get(account, 0)
        if member.host and count >= self._limit:
            return (
                f"its address has {count} connections of its user "
                "(broker.limits.connections_per_address)"
            )
        state.guests.pop(member, None)
        state.clients[account] = count + 1
        return ""

    def closing(self, member: ScheduledConnection) -> None:
        """See `AdmissionPolicy`."""
        self._of(member).guests[member] = None

    def ended(self, member: ScheduledConnection) -> None:
        """See `AdmissionPolicy`."""
        state = self._of(member)
        state.guests.pop(member, None)
        count = state.clients.get(member.account, 0)
        if count > 1:
            state.clients[member.account] = count - 1
        else:
            state.clients.pop(member.account, None)

    def oldest_guest(self) -> ScheduledConnection | None:
        """The oldest guest of the address that has most guests."""
        most = max(self._known.values(), key=lambda each: len(each.guests), default=None)
        return next(iter(most.guests), None) if most is not None else None

    def _evict_idle(self, now: float) -> None:
        self._known = {
            where: state
            for where, state in self._known.items()
            if state.guests or state.clients or state.paid_at > now
        }
        # The table has to double before the next eviction, so the work per arrival is constant.
        self._evict_at = max(ADDRESSES, 2 * len(self._known))
