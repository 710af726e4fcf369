"""Connects to a broker: name, TCP, proxy, TLS, WebSocket; each step within a time limit.

A failure says what a person can do about it (`DialError`). A dial can be cancelled at any time, and
leaves nothing open.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import ipaddress
import socket
import ssl
import threading
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias, TypeVar, cast

from aiohappyeyeballs import start_connection

from appliance.config.urls import ProxyUrl, ServerUrl
from appliance.net import tls as net_tls
from appliance.net.callbacks import Entries
from appliance.upstream.dial_error import DialError, DialStep
from appliance.upstream.proxy import tunnel
from appliance.upstream.rules import UpstreamTls
from appliance.upstream.tls_client import (
    expected_name,
    is_other_name,
    make_context,
    name_refusal,
    names_in,
    tls_refusal,
)
from appliance.upstream.transport import Surroundings, UpstreamTransport, tune
from appliance.upstream.websocket_client import WebSocketClient

T = TypeVar("T")

#: Seconds for each step: a mobile network that has to wake up takes some.
STEP_TIMEOUT = 15.0

#: Seconds after which the next address of a name is tried beside the last one (RFC 8305).
NEXT_ADDRESS = 0.25

#: The most addresses of a name that are tried.
ADDRESSES = 16

AddressInfo: TypeAlias = "tuple[int, int, int, str, tuple[Any, ...]]"

#: Why a connection is not made, by the error of the system.
_CONNECT_REFUSALS = {
    errno.ECONNREFUSED: "{at} refuses connections: is {what} listening there?",
    errno.ENETUNREACH: "there is no way to {at}: is this computer connected to a network?",
    errno.EHOSTUNREACH: "there is no way to {at}: is its computer on, and the address right?",
    errno.ENETDOWN: "the network is down: is this computer connected to one?",
    errno.ECONNRESET: "{at} reset the connection at once: does a firewall allow it?",
    errno.EACCES: "this computer does not allow connections to {at}: does a firewall?",
    errno.EPERM: "this computer does not allow connections to {at}: does a firewall?",
}


async def dial(
    server: ServerUrl,
    tls: UpstreamTls,
    proxy: ProxyUrl | None,
    surroundings: Surroundings,
    timeout: float = STEP_TIMEOUT,
) -> UpstreamTransport:
    """Connect to the broker; each step may take `timeout` seconds. Raises DialError.

    Files of certificates are read anew. The caller has to `begin` the transport, or to abort it.
    """
    return await _Dial(server, tls, proxy, surroundings, timeout).run()


class _Dial:
    """One attempt to connect to a broker."""

    def __init__(
        self,
        server: ServerUrl,
        tls: UpstreamTls,
        proxy: ProxyUrl | None,
        surroundings: Surroundings,
        timeout: float,
    ) -> None:
        self._server = server
        self._tls = tls
        self._proxy = proxy
        self._surroundings = surroundings
        self._entries = surroundings.scheduler.entries
        self._timeout = timeout

    async def run(self) -> UpstreamTransport:
        context = await self._context() if self._server.tls else None
        connection = await self._connect()
        try:
            return await self._over(connection, context)
        except ssl.SSLError as error:
            if is_other_name(error):
                names = await self._names()
                why = name_refusal(expected_name(self._server, self._tls), names)
            else:
                why = tls_refusal(error, self._server, self._tls)
            raise DialError("tls", why) from None

    async def _context(self, *, check_name: bool = True) -> ssl.SSLContext:
        load = functools.partial(make_context, self._tls, check_name=check_name)
        late = "the files of certificates could not be read in time"
        return await self._limited("files", late, lambda: in_thread(self._entries, load))

    async def _connect(self) -> socket.socket:
        """A connection to the server, through the proxy if there is one."""
        first: ServerUrl | ProxyUrl = self._proxy or self._server
        host, port = first.host, first.port
        what = "a broker" if self._proxy is None else "a proxy"
        found = await self._limited(
            "name",
            f"there is no answer where {host} is: does this computer reach a DNS server?",
            lambda: resolve(self._entries, host, port),
        )
        try:
            connection = await self._limited(
                "connection",
                f"{first.authority} does not answer within {self._timeout:g} s: is the address "
                "right, and does a firewall allow it?",
                lambda: start_connection(
                    cast(Any, found[:ADDRESSES]), happy_eyeballs_delay=NEXT_ADDRESS
                ),
                socket.socket.close,
            )
        except (OSError, RuntimeError) as error:  # uvloop raises the latter
            raise DialError("connection", connect_refusal(error, first.authority, what)) from None
        try:
            tune(connection)
            if self._proxy is not None:
                await self._tunnel(connection, self._proxy)
        except BaseException:
            connection.close()
            raise
        return connection

    async def _tunnel(self, connection: socket.socket, proxy: ProxyUrl) -> None:
        authority = self._server.authority
        late = f"the proxy {proxy.authority} has not connected to {authority} in time"
        try:
            await self._limited("proxy", late, lambda: tunnel(connection, proxy, authority))
        except OSError as error:
            why = f"the proxy {proxy.authority} closed the connection ({error.strerror or error})"
            raise DialError("proxy", why) from None

    async def _over(
        self, connection: socket.socket, context: ssl.SSLContext | None
    ) -> UpstreamTransport:
        """The layers above a connection, which this closes if it fails. Raises ssl.SSLError."""
        transport = UpstreamTransport(self._surroundings, str(self._server))
        transport.explain = lambda error: tls_refusal(error, self._server, self._tls)
        try:
            top: UpstreamTransport | WebSocketClient = transport
            if self._server.websocket:
                scheduler = self._surroundings.scheduler
                top = WebSocketClient(transport, scheduler, self._server)
            await self._shake_hands(connection, context, cast(asyncio.Protocol, top))
            if isinstance(top, WebSocketClient):
                await self._upgrade(top)
        except BaseException:
            transport.abort()
            connection.close()
            raise
        return transport

    async def _shake_hands(
        self, connection: socket.socket, context: ssl.SSLContext | None, top: asyncio.Protocol
    ) -> None:
        if context is None:
            loop = self._entries.loop
            await loop.connect_accepted_socket(lambda: top, connection)
            return
        name = expected_name(self._server, self._tls)
        scheduler = self._surroundings.scheduler
        late = (
            f"{self._server.authority} does not answer to TLS within {self._timeout:g} s: is the "
            f"port one for {self._server.scheme}://?"
        )
        try:
            await self._limited(
                "tls",
                late,
                # The time limit is the one around it.
                lambda: net_tls.connect(
                    connection, context, top, 2 * self._timeout, scheduler, name
                ),
            )
        except ssl.SSLError:
            raise
        except (OSError, ValueError) as error:  # ValueError: a name that TLS cannot send
            why = tls_refusal(error, self._server, self._tls)
            raise DialError("tls", why) from None

    async def _upgrade(self, websocket: WebSocketClient) -> None:
        async def answered() -> str:
            return await asyncio.shield(websocket.upgraded)

        websocket.send_request()
        late = (
            f"{self._server.authority} does not answer to HTTP within {self._timeout:g} s: is the "
            f"port one for {self._server.scheme}://?"
        )
        refusal = await self._limited("websocket", late, answered)
        if refusal:
            raise DialError("websocket", refusal)

    async def _names(self) -> list[str]:
        """For whom the server's certificate is, by a second connection on which nothing is sent.

        When it is refused for its name, OpenSSL does not show it. It is verified otherwise.
        """
        plain = _Dial(
            self._server._replace(scheme="mqtts"),
            self._tls,
            self._proxy,
            self._surroundings,
            self._timeout,
        )
        try:
            context = await plain._context(check_name=False)
            transport = await plain._over(await plain._connect(), context)
        except (DialError, OSError):
            return []
        found = cast("ssl.SSLObject | None", transport.info("ssl_object"))
        names = names_in(found.getpeercert() if found is not None else None)
        transport.abort()
        return names

    async def _limited(
        self,
        step: DialStep,
        late: str,
        work: Callable[[], Awaitable[T]],
        dispose: Callable[[T], object] = lambda result: None,
    ) -> T:
        """The result of a step; DialError when it takes too long.

        The step is a task of its own, so that what it has opened is disposed of when nobody takes
        it: a cancellation can come together with its end.
        """
        entries = self._entries
        task = entries.task("dial.step", _outcome(work), served=str(self._server))
        try:
            await asyncio.wait({task}, timeout=self._timeout)
        except BaseException:
            _abandon(entries, task, dispose)
            raise
        if not task.done():
            _abandon(entries, task, dispose)
            raise DialError(step, late)
        if task.cancelled() or task.exception() is not None:
            raise DialError(step, "a fault in the appliance; its log has it")
        result, error = task.result()
        if error is not None:
            raise error.with_traceback(None)
        return cast(T, result)


async def _outcome(work: Callable[[], Awaitable[T]]) -> tuple[T | None, Exception | None]:
    """The result of the work, or what went wrong outside; other exceptions are faults."""
    try:
        return await work(), None
    except (DialError, OSError, RuntimeError, ValueError) as error:
        return None, error


def _abandon(
    entries: Entries,
    task: asyncio.Task[tuple[T | None, Exception | None]],
    dispose: Callable[[T], object],
) -> None:
    """Cancel a step; what it returns nevertheless is disposed of."""

    def ended() -> None:
        if not task.cancelled() and task.exception() is None:
            result, error = task.result()
            if error is None:
                dispose(cast(T, result))

    if task.done():
        ended()
    else:
        task.cancel()
        entries.when_done("dial.abandoned", task, ended)


async def in_thread(entries: Entries, work: Callable[[], T]) -> T:
    """The result of work in a thread of its own, which nobody waits for when it is cancelled.

    The loop's executor would be waited for when the process ends, and a DNS server that does not
    answer takes half a minute.
    """
    future: asyncio.Future[tuple[T | None, Exception | None]] = entries.loop.create_future()

    def settle(result: T | None, error: Exception | None) -> None:
        if not future.done():
            future.set_result((result, error))

    def failed() -> None:
        settle(None, RuntimeError("a fault in the appliance; its log has it"))

    def run() -> None:
        result, problem = None, None
        try:
            result = work()
        except Exception as error:
            problem = error
        with contextlib.suppress(RuntimeError):  # the loop is closed
            entries.from_thread("dial.thread", settle, result, problem, failed=failed)

    threading.Thread(target=run, name="dial", daemon=True).start()
    result, error = await future
    if error is not None:
        raise error
    return cast(T, result)


async def resolve(entries: Entries, host: str, port: int) -> list[AddressInfo]:
    """The addresses of a host, as `getaddrinfo` has them. Raises DialError."""
    look_up = functools.partial(
        socket.getaddrinfo, host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP
    )
    try:
        ipaddress.ip_address(host)
        found = look_up(flags=socket.AI_NUMERICHOST)
    except ValueError:
        pass
    except OSError as error:
        raise DialError("name", name_problem(host, error)) from None
    else:
        return cast("list[AddressInfo]", found)
    try:
        return cast("list[AddressInfo]", await in_thread(entries, look_up))
    except (OSError, UnicodeError) as error:
        raise DialError("name", name_problem(host, error)) from None


def name_problem(host: str, error: Exception) -> str:
    """Why a name has no address, in words."""
    code = error.errno if isinstance(error, socket.gaierror) else None
    if code == socket.EAI_AGAIN:
        return (
            f"the name {host} cannot be looked up now: is this computer connected to a network, "
            "and does it reach a DNS server?"
        )
    if code in (socket.EAI_NONAME, getattr(socket, "EAI_NODATA", None)):
        return f"the name {host} does not resolve: is it written right, and known to DNS here?"
    why = getattr(error, "strerror", None) or error
    return f"the name {host} does not resolve: {why}"


def connect_refusal(error: Exception, authority: str, what: str) -> str:
    """Why a TCP connection was not made, in words."""
    number = getattr(error, "errno", None) or 0
    text = _CONNECT_REFUSALS.get(number)
    if text is not None:
        return text.format(at=authority, what=what)
    if number == errno.ETIMEDOUT:
        return f"{authority} does not answer: is the address right, and does a firewall allow it?"
    why = getattr(error, "strerror", None) or str(error)
    return f"{authority} cannot be connected to: {why}"
