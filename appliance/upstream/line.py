"""Keeps one connection of a link: dials, and dials again when it has ended.

While a server that is not the first is connected, the first one is dialled from time to time beside
the connection. When it answers, the connection is ended in an orderly way, and the next one is with
the first server.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import random
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Protocol

from async_timeout import timeout

from appliance.config.urls import ServerUrl, parse_proxy
from appliance.mqtt.codec import V5, quote
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.upstream.agreement import ConnectSettings, EndedBy, Ending
from appliance.upstream.backoff import Backoff
from appliance.upstream.channel import Channel, ChannelOwner
from appliance.upstream.credentials import Credentials, read_credentials
from appliance.upstream.dial import dial, in_thread
from appliance.upstream.dial_error import DialError
from appliance.upstream.limits import KINDS, dialled_tls
from appliance.upstream.refusals import (
    ending_advice,
    subscription_advice,
    unanswered_filters,
)
from appliance.upstream.rules import UpstreamSettings
from appliance.upstream.transport import Surroundings, UpstreamTransport
from appliance.upstream.unanswered import UnansweredFilters
from appliance.upstream.versions import ServerVersions

log = logging.getLogger(__name__)

#: The least seconds between two renewals of the login, or looks for a newer token.
RENEWAL_INTERVAL: Final = 60.0

#: Seconds after a fault of the appliance until what has failed is tried again.
AGAIN: Final = 1.0

#: Seconds that the stop waits for a dial to be cancelled, at a time.
CANCEL_TIMEOUT: Final = 2.0

#: Reason codes of CONNACK that are about the will: the next CONNECT has another one.
OF_WILL: Final = frozenset((ReasonCode.RETAIN_NOT_SUPPORTED, ReasonCode.QOS_NOT_SUPPORTED))

#: Seconds in which both ends may acknowledge what is under way, before the connection is ended to
#: go back to the first server. The rest is sent again there.
LEAVING: Final = 5.0

#: What keeps a server from being dialled, or a file from being read.
_UNDIALLED: Final = (DialError, OSError, RuntimeError, ValueError)


class LineOwner(ChannelOwner, Protocol):
    """The link that a line belongs to. `is_kept` says for which of its connections it is asked."""

    settings: UpstreamSettings

    def client_id(self, *, is_kept: bool) -> str:
        """The client id that the connection asks for."""

    def connect_settings(
        self,
        version: int,
        credentials: Credentials,
        *,
        is_kept: bool,
        refused: Collection[ReasonCode],
    ) -> ConnectSettings:
        """What CONNECT asks for; the broker has `refused` the will because of these."""

    def subscriptions(self, version: int, *, is_kept: bool) -> list[Subscription]:
        """What the connection subscribes to."""

    def least_late(self, *, is_kept: bool) -> float | None:
        """The least age in seconds for which what comes on the connection is late; or None."""

    def surroundings(self) -> Surroundings:
        """For the transport."""

    def say_offline(self, channel: Channel) -> None:
        """Say on the channel that the robot is offline from now on."""


@dataclass(frozen=True, slots=True)
class _Dialled:
    """A connection to the server at a position in `servers`, on which nothing was sent yet."""

    position: int
    transport: UpstreamTransport
    credentials: Credentials


class Line:
    """One of a link's connections, over and over; a task of the event loop."""

    def __init__(self, link: LineOwner, *, is_kept: bool) -> None:
        self.is_kept = is_kept
        self.channel: Channel | None = None
        self.server = ""
        self.problem: str | None = None
        self.attempts = 0
        self.connections = 0
        self.refused_filters: list[str] = []
        #: What the present connection has not asked for yet, by filter: see `UnansweredFilters`.
        self._missing: dict[str, Subscription] = {}
        self._link = link
        self._settings = link.settings
        self._loop = link.entries.loop
        self._versions = ServerVersions(link.settings.version)
        self._unanswered = [UnansweredFilters() for _ in link.settings.servers]
        #: Why each server does not take the will as it was first.
        self._will_refused: list[set[ReasonCode]] = [set() for _ in link.settings.servers]
        self._backoff = Backoff(len(link.settings.servers), random.random)
        self._ending: asyncio.Future[Ending] | None = None
        self._task: asyncio.Task[None] | None = None
        self._restart: asyncio.TimerHandle | None = None
        self._is_stopping = False
        self._is_causeless = False
        #: What the link knows of how the last connection ended.
        self._advice = ""
        #: The first server, dialled while the present connection is with another one.
        self._next: _Dialled | None = None
        #: Set when the next dial is due before its time.
        self._at_once = asyncio.Event()

    def __str__(self) -> str:
        return (
            f"{self._link}, for the rules with offline: keep" if self.is_kept else str(self._link)
        )

    @property
    def position(self) -> int:
        """The position in `servers` of the one that is connected or dialled."""
        return self._backoff.server

    @property
    def _client_id(self) -> str:
        """The client id that it asks for."""
        return self._link.client_id(is_kept=self.is_kept)

    def start(self) -> None:
        """Begin to dial."""
        if not self._is_stopping:
            self._task = self._link.entries.task(
                "upstream.dial", self._run(), served=self._link, failed=self._start_again
            )

    def _start_again(self) -> None:
        """A fault has ended the task: go on a little later."""
        self._restart = self._link.entries.later(
            "upstream.restart", AGAIN, self.start, failed=self._start_again
        )

    async def stop(self) -> None:
        """Disconnect, and dial no more."""
        self._is_stopping = True
        if self._restart is not None:
            self._restart.cancel()
        channel = self.channel
        if channel is not None:
            self._say_offline(channel)
            channel.close(ReasonCode.SUCCESS, "the appliance stops")
        task = self._task
        while task is not None and not task.done():
            task.cancel()
            await asyncio.wait({task}, timeout=CANCEL_TIMEOUT)
        following, self._next = self._next, None
        if following is not None:
            following.transport.abort("the appliance stops")

    def _say_offline(self, channel: Channel) -> None:
        if channel.connection.granted is not None and not self.is_kept:
            self._link.say_offline(channel)

    async def _run(self) -> None:
        interval = KINDS[self._settings.kind].connect_interval
        while True:
            wait = await self._attempt()
            self._at_once.clear()
            await asyncio.sleep(interval)
            with contextlib.suppress(asyncio.TimeoutError):
                async with timeout(wait):
                    await self._at_once.wait()

    async def _attempt(self) -> float:
        """One connection, from its dial to its end; returns the seconds until the next."""
        dialled, self._next = self._next, None
        if dialled is not None:
            self._backoff.returned(self._loop.time())
        else:
            try:
                dialled = await self._dial(self._backoff.server)
            except _UNDIALLED as error:
                self._versions.failed(self._backoff.server)
                return self._failed(str(error))
        lost = dialled.transport.lost_reason
        if lost:  # while the connection before ended: it says nothing of MQTT
            self._tell_server(self._settings.servers[dialled.position])
            return self._failed(lost)
        channel, ending = await self._serve(dialled)
        return 0.0 if self._next is not None else self._after(channel, ending)

    async def _dial(self, position: int) -> _Dialled:
        """Read the files, and connect to a server. Raises what is in `_UNDIALLED`."""
        link, settings = self._link, self._settings
        server = settings.servers[position]
        self._tell_server(server)
        self.attempts += 1
        login = settings.login
        credentials = await in_thread(link.entries, partial(read_credentials, login))
        tls = dialled_tls(settings, server)
        proxy = None if settings.proxy is None else parse_proxy(settings.proxy)
        transport = await dial(server, tls, proxy, link.surroundings())
        return _Dialled(position, transport, credentials)

    def _tell_server(self, server: ServerUrl) -> None:
        if self.channel is None:
            self.server = str(server)

    async def _serve(self, dialled: _Dialled) -> tuple[Channel, Ending]:
        """The connection, and how it ended."""
        link = self._link
        self._tell_server(self._settings.servers[dialled.position])
        version = self._versions.of(dialled.position)
        unanswered = self._unanswered[dialled.position]
        self._missing = {
            each.filter: each for each in link.subscriptions(version, is_kept=self.is_kept)
        }
        subscriptions = [self._missing.pop(each) for each in unanswered.ask(list(self._missing))]
        channel = Channel(
            link,
            link.connect_settings(
                version,
                dialled.credentials,
                is_kept=self.is_kept,
                refused=self._will_refused[dialled.position],
            ),
            subscriptions,
            link.least_late(is_kept=self.is_kept),
            is_kept=self.is_kept,
            one_by_one=unanswered.one_by_one,
        )
        self.channel = channel
        ended = self._ending = self._loop.create_future()
        try:
            channel.begin(dialled.transport)
            return channel, await self._until_end(channel, ended, dialled.credentials)
        finally:
            code = (
                ReasonCode.SUCCESS
                if self._is_stopping
                else (ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR)
            )
            channel.close(code, "the appliance stops")
            self.channel = None
            dialled.transport.close("the appliance stops")

    async def _until_end(
        self, channel: Channel, ended: asyncio.Future[Ending], credentials: Credentials
    ) -> Ending:
        """Wait for the end; meanwhile the login is renewed, and the first server tried."""
        renew_at = self._in(credentials.renew_in())
        while True:
            due = min(renew_at, self._backoff.return_at or math.inf)
            wait = max(0.0, due - self._loop.time())
            done, _ = await asyncio.wait({ended}, timeout=None if due == math.inf else wait)
            if done:
                return ended.result()
            if self._backoff.is_return_due(self._loop.time()):
                await self._try_first(channel, ended)
            if ended.done() or self._loop.time() < renew_at:
                continue
            renew_at = self._in(RENEWAL_INTERVAL)
            try:
                newer = await in_thread(
                    self._link.entries, partial(read_credentials, self._settings.login)
                )
            except (OSError, ValueError, RuntimeError) as error:
                self._report_problem(str(error), 0.0)
                continue
            if newer.has_same_secret(credentials):
                self._report_problem("the token expires, and its file has no newer one", 0.0)
                continue
            credentials = newer
            renew_at = self._in(max(RENEWAL_INTERVAL, newer.renew_in() or 0.0))
            channel.renew_login(newer.data)

    def _in(self, seconds: float | None) -> float:
        """The loop's time after so many seconds; infinity for None."""
        return math.inf if seconds is None else self._loop.time() + seconds

    # --- back to the first server --------------------------------------------------------------

    async def _try_first(self, channel: Channel, ended: asyncio.Future[Ending]) -> None:
        """Dial the first server beside the connection; when it answers, end that one for it."""
        work = self._link.entries.task("upstream.return", self._dial_first(), served=self._link)
        either: set[asyncio.Future[Any]] = {work, ended}
        try:
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
        finally:
            work.cancel()
            await asyncio.wait({work}, timeout=CANCEL_TIMEOUT)
        if self._next is None:
            self._backoff.stayed(self._loop.time())
            return
        if ended.done():
            return
        log.info("%s: goes back to %s", self, self._settings.servers[0])
        self._say_offline(channel)  # it may be another broker, which hears no more of the robot
        channel.leave("goes back to the first server")
        await asyncio.wait({ended}, timeout=LEAVING)
        channel.close(ReasonCode.SUCCESS, "goes back to the first server")

    async def _dial_first(self) -> None:
        try:
            self._next = await self._dial(0)
        except _UNDIALLED as error:
            log.debug("%s: %s: %s", self, self._settings.servers[0], error)

    # --- what the connection tells -------------------------------------------------------------

    def clock_was_set(self) -> None:
        """Dial at once."""
        self._backoff.clock_was_set()
        self._at_once.set()

    def on_opened(self, channel: Channel) -> None:
        """CONNACK has come."""
        self._backoff.connected(self._loop.time())
        self._versions.answered(self._backoff.server, channel.version)
        self.connections += 1
        self.problem = None
        log.info("%s: connected to %s as %s", self, self.server, quote(channel.client_id))

    def on_ended(self, ending: Ending, *, is_causeless: bool, advice: str) -> None:
        """The connection has ended; without a cause, if the broker has closed it though nothing
        that it was sent can have been the reason. The link may have an advice."""
        self.channel = None
        self._is_causeless = is_causeless
        self._advice = advice
        if self._ending is not None and not self._ending.done():
            self._ending.set_result(ending)

    # --- after it ------------------------------------------------------------------------------

    def _after(self, channel: Channel, ending: Ending) -> float:
        """The seconds until the next dial, by how the connection ended."""
        server = self._backoff.server
        if ending.refuses_version and channel.version == V5:
            return self._fall_back(server)
        refused = self._will_refused[server]
        if ending.refused and ending.code in OF_WILL and ending.code not in refused:
            refused.add(ending.code)
            log.info("%s: %s: %s; trying another will", self, self.server, ending.text)
            return 0.0
        if ending.is_new and self._tries_old_version(channel, ending):
            log.info("%s: %s: %s; trying MQTT 3.1.1", self, self.server, ending.text)
            return 0.0
        if ending.by is EndedBy.US and ending.code < 0x80:
            return 0.0
        now = self._loop.time()
        says_so = ending.code == ReasonCode.SESSION_TAKEN_OVER and ending.by is EndedBy.BROKER
        if says_so:
            wait = self._backoff.taken_over(now)
        elif self._is_causeless:
            wait = self._backoff.closed(now)
        else:
            advice = self._advice or ending_advice(
                ending, self._settings, self._settings.servers[server], self._client_id
            )
            if ending.may_refuse and channel.unanswered:
                advice = unanswered_filters(channel.unanswered)
                self._leave_out(channel)
            return self._failed(f"{ending.text}; {advice}" if advice else ending.text)
        text = ending.text
        if self._backoff.is_contested(now):
            client_id = quote(self._client_id)
            if says_so:
                text = (
                    f"another client has the client id {client_id} as well, and takes "
                    f"the connection over again and again (waiting {wait:.0f} s); each needs a "
                    "client_id of its own"
                )
            else:
                text += (
                    " three times within a minute, and has said no reason (waiting "
                    f"{wait:.0f} s); has another client the client id {client_id} as well?"
                )
        return self._report_problem(text, wait)

    def _tries_old_version(self, channel: Channel, ending: Ending) -> bool:
        """The connection has ended before or by CONNACK; whether to dial with 3.1.1 at once."""
        server, version = self._backoff.server, channel.version
        if ending.refused and not ending.refuses_version:
            self._versions.answered(server, version)
        elif not ending.is_close or self._needs_5():
            self._versions.failed(server)
        else:
            return self._versions.closed(server, version)
        return False

    def _needs_5(self) -> str:
        """Why the link cannot go on with 3.1.1; empty if it can."""
        if self._settings.login.method is not None:
            return "login.method needs it"
        overlapping = self._settings.overlapping()
        if not overlapping:
            return ""
        out, inward = overlapping[0]
        return (
            f"with 3.1.1 the rules for {quote(out.local_filter)} and "
            f"{quote(inward.remote_filter)} would send messages in a circle"
        )

    def _leave_out(self, channel: Channel) -> None:
        """The broker has closed the connection upon SUBSCRIBE, perhaps again and again."""
        found = self._unanswered[self._backoff.server].closed(
            channel.unanswered,
            self._loop.time(),
            channel.answered,
            lived=channel.is_subscribed,
        )
        if found is not None:
            log.warning(
                "%s: the fleet's broker closes the connection upon the subscription to %s: %s",
                self,
                quote(found),
                subscription_advice(ReasonCode.NOT_AUTHORIZED, self._settings, found),
            )

    def on_subscribed(self, channel: Channel, refused: list[str]) -> None:
        """The broker has answered all subscriptions, and refused these."""
        self._unanswered[self._backoff.server].answered(channel.answered)
        self.refused_filters = (self.refused_filters if channel.is_subscribed else []) + refused

    @property
    def missing_filters(self) -> list[str]:
        """The filters that the present connection does not subscribe to, as the broker has closed
        it upon them before."""
        return [] if self.channel is None else list(self._missing)

    def tick(self) -> None:
        """Called every second: ask for what the connection has not asked for, once that is due."""
        channel = self.channel
        if channel is None or not channel.is_subscribed or channel.unanswered:
            return
        now = self._loop.time()
        unanswered = self._unanswered[self._backoff.server]
        due = unanswered.due(self._missing, now - channel.connected_at, now)
        if due:
            channel.subscribe([self._missing.pop(each) for each in due])

    def _fall_back(self, server: int) -> float:
        """The broker does not know MQTT 5."""
        why = self._needs_5()
        if why:
            return self._failed(f"the broker does not know MQTT 5, and {why}")
        self._versions.refused(server)
        log.info("%s: %s does not know MQTT 5, going on with 3.1.1", self, self.server)
        return 0.0

    def _failed(self, problem: str) -> float:
        return self._report_problem(problem, self._backoff.failed(self._loop.time()))

    def _report_problem(self, problem: str, wait: float) -> float:
        if problem != self.problem:
            self.problem = problem
            log.warning("%s: %s as %s: %s", self, self.server, quote(self._client_id), problem)
        return wait
