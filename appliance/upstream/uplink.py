"""A link to a fleet's broker: it dials, sends what waits, receives, and reports how it is.

An `Uplink` lives as long as its section in appliance.yaml, connected or not. Its backlog and its
session for what is sent exist all the time, a `Channel` while a connection does. Rules with
`offline: keep` have a connection of their own, whose session the fleet's broker keeps.
"""

from __future__ import annotations

import asyncio
import logging
import weakref
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Final

import orjson

from appliance.broker.backlogs import Backlogs
from appliance.broker.broker import Broker
from appliance.broker.message import Message
from appliance.broker.meter import Meter
from appliance.mqtt.codec import MAXIMUM_PAIRS, V5, Properties, Property, quote
from appliance.mqtt.packets import Subscription, Will
from appliance.mqtt.reason import ReasonCode
from appliance.net.callbacks import Entries, PeriodicCallback
from appliance.net.layers import LayerScheduler
from appliance.upstream.agreement import ConnectSettings, Ending
from appliance.upstream.answers import Answers, reply_filter
from appliance.upstream.backlog import Backlog
from appliance.upstream.channel import Channel
from appliance.upstream.credentials import Credentials
from appliance.upstream.in_session import InCounters, InSession
from appliance.upstream.limits import KINDS
from appliance.upstream.line import AGAIN, Line
from appliance.upstream.loops import MOST_ADDED
from appliance.upstream.out_session import OutSession
from appliance.upstream.presence import Presence
from appliance.upstream.readiness import Readiness
from appliance.upstream.refusals import reason_words, subscription_advice
from appliance.upstream.rule_queue import Entry
from appliance.upstream.rules import LinkRules, UpstreamSettings
from appliance.upstream.sender import Sender
from appliance.upstream.state_report import StateReport
from appliance.upstream.status import LinkStatus, bottleneck
from appliance.upstream.transport import Surroundings

log = logging.getLogger(__name__)

#: Seconds between two looks at what has become too old, and between two reports of the metrics.
TICK: Final = 1.0
REPORT_INTERVAL: Final = 10.0

#: The resolution of the event loop's clock, in seconds: no round trip is known to be shorter.
CLOCK_STEP: Final = 0.001

#: Seconds for which the fleet's broker is asked to keep the session of rules with `offline: keep`.
KEPT_EXPIRY: Final = 7 * 86400

#: Seconds for which acknowledgements are gathered while the window is full: read one by one they
#: would cost a round of the event loop each. Commands on the same connection come as much later.
GATHER: Final = 0.002

#: Windows that are smaller are filled again at each acknowledgement: with these and a short round
#: trip two milliseconds would count.
LEAST_GATHERED: Final = 256

#: What CONNECT announces. Explicitly, because mosquitto otherwise has no more than 20 messages in
#: flight; and so large, because mosquitto exceeds a smaller one when a session is resumed. What is
#: read at once is bounded by `InSession`, which pauses reading.
RECEIVE_MAXIMUM: Final = 65_534

_JSON: Final[Properties] = {Property.CONTENT_TYPE: "application/json"}


@dataclass(frozen=True, slots=True)
class UplinkParts:
    """What a link needs of the appliance."""

    broker: Broker
    entries: Entries
    backlogs: Backlogs
    scheduler: LayerScheduler


class Uplink:
    """One link; on the event loop's thread."""

    def __init__(
        self, settings: UpstreamSettings, parts: UplinkParts, before: Uplink | None = None
    ) -> None:
        """`before` is the stopped link of the same name that this one follows."""
        self.settings = settings
        self.broker = parts.broker
        self.entries = parts.entries
        self._scheduler = parts.scheduler
        self._loop = parts.entries.loop
        self._rules = LinkRules(settings)
        self._state = StateReport(settings)
        # Who waits for an answer to a call under way waits for one from this link.
        self._answers = Answers(settings)
        if before is not None and before._answer_topics == self._answer_topics:
            self._answers = before._answers
            self._answers.use(settings)
        self._journal_clock = parts.backlogs.journal(settings.name, 0).now
        limits = KINDS[settings.kind]
        rate, size = limits.rates(settings.rate, settings.bytes_per_second)
        self._backlog = Backlog(
            settings.name,
            parts.backlogs,
            (*settings.out, self._rules.answers),
            settings.backlog,
            self._journal_clock(),
            _weakly(self._wake),
            rate=rate,
            bytes_per_second=size,
        )
        #: Messages of QoS 0 that the link before had in memory.
        self._forgotten = 0
        if before is not None:
            waiting = before._backlog.counts().waiting - self._backlog.counts().waiting
            self._forgotten = before._forgotten + max(0, waiting)
        self._sender = Sender(settings, self._backlog, self._journal_clock, limits)
        self._out = OutSession(
            self.broker,
            settings,
            self._rules,
            self._answers,
            self._backlog,
            self._journal_clock,
            _weakly(self._offer_later),
        )
        self._in_counters = InCounters()
        self._readiness = Readiness()
        # It is owned by nothing else than who has made it: see `app/main.py`, cycles are not freed.
        link = weakref.proxy(self)
        self._lines = [Line(link, is_kept=False)]
        if any(rule.offline == "keep" for rule in settings.inward):
            self._lines.append(Line(link, is_kept=True))
        self._offered, self._sent = Meter(), Meter()
        self._clock: PeriodicCallback | None = None
        self._send_timer: asyncio.TimerHandle | None = None
        self._send_at = 0.0
        self._offer_timer: asyncio.Handle | None = None
        self._reported: bytes = b""
        self._reported_at = 0.0

    def __str__(self) -> str:
        return f"upstream '{self.settings.name}'"

    @property
    def _answer_topics(self) -> tuple[str, str]:
        return self.settings.answers_here, self.settings.answers_there

    # --- its life ------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin to take messages, and to connect."""
        self._out.attach()
        self._out.take_turn()
        self.broker.flush()
        self._clock = self.entries.every("upstream.clock", TICK, self._tick)
        for line in self._lines:
            line.start()
        self._report()

    async def stop(self, *, is_last: bool = False, is_named: bool = True) -> None:
        """Say that the robot is offline, and disconnect; what waits stays in the backlog.

        Its status stays retained here, unless it `is_last` of this name, and the state of its
        client id unless no other link `is_named` so.
        """
        if self._clock is not None:
            self._clock.cancel()
        await asyncio.gather(*(line.stop() for line in self._lines))
        for timer in (self._send_timer, self._offer_timer):
            if timer is not None:
                timer.cancel()
        self._clock = self._send_timer = self._offer_timer = None
        self._report()
        if is_last or not is_named:
            self._publish_here(b"" if is_last else self._reported, b"" if not is_named else b"0")
        self._out.detach()
        self._backlog.store()
        self.broker.flush()

    def _tick(self) -> None:
        self._backlog.tick(self._journal_clock())
        self._out.has_dropped()
        self._sender.tick()
        counts = self._backlog.counts()
        now = self._loop.time()
        online = self._lines[0]
        for line in self._lines:
            if line is not online or self._state.is_settled:  # an end has one reason
                line.tick()
        if online.channel is not None:
            self._state.tick(online.channel, online.position, now)
        self._offered.tick(now, counts.offered)
        self._sent.tick(now, counts.sent)
        if now >= self._reported_at + REPORT_INTERVAL:
            self._report()

    # --- out -----------------------------------------------------------------------------------

    def _offer_later(self) -> None:
        if self._offer_timer is None:
            self._offer_timer = self.entries.soon(
                "upstream.offer", self._offer_more, failed=self._offer_again
            )

    def _offer_again(self) -> None:
        """A fault: go on a little later."""
        self._offer_timer = self.entries.later(
            "upstream.offer", AGAIN, self._offer_more, failed=self._offer_again
        )

    def _offer_more(self) -> None:
        self._offer_timer = None
        self._out.take_turn()
        self.broker.flush()

    def _wake(self) -> None:
        """The backlog has something to send again."""
        self._send_later(0.0)

    def _send_later(self, seconds: float) -> None:
        when = self._loop.time() + seconds
        if self._send_timer is not None:
            if self._send_at <= when:
                return
            self._send_timer.cancel()
        self._send_at = when
        self._send_timer = self.entries.at(
            "upstream.send", when, self._send, failed=self._send_again
        )

    def _send_again(self) -> None:
        """A fault: go on a little later."""
        self._send_timer = None
        self._send_later(AGAIN)

    def _send(self) -> None:
        self._send_timer = None
        channel = self._lines[0].channel
        if channel is not None:
            channel.send_on()

    def send_more(self, channel: Channel) -> None:
        """See `ChannelOwner`."""
        connection = channel.connection
        # Without room an acknowledgement is what it waits for, and not the network.
        if channel is not self._lines[0].channel or not connection.room or not channel.can_send:
            return
        self._state.send(channel)
        if not self._state.is_settled:
            return  # so that an end of the connection is not taken for that of a message
        if self._sender.send(connection):
            self._send_later(0.0)
            return
        if not connection.room:
            if connection.window >= LEAST_GATHERED:
                channel.gather(GATHER)
            return  # an acknowledgement makes room
        due = self._sender.due()
        if due is not None:
            self._send_later(due)

    def acknowledged(self, entries: list[Entry | None], code: int, reason: str) -> None:
        """See `ChannelOwner`."""
        if None in entries:  # the state
            self._state.acknowledged(self._lines[0].position, code, self._loop.time())
        self._sender.acknowledged(entries, code, reason)

    # --- the connections -----------------------------------------------------------------------

    def receive(self, channel: Channel) -> InSession:
        """See `ChannelOwner`."""
        answering = self._out.answering
        assert answering is not None
        return InSession(
            self.broker,
            self.settings,
            self._rules,
            self._answers,
            answering,
            channel,
            self._in_counters,
            self._readiness,
            is_kept=self._line_of(channel).is_kept,
        )

    def opened(self, channel: Channel) -> None:
        """See `ChannelOwner`."""
        line = self._line_of(channel)
        line.on_opened(channel)
        if line.is_kept:
            return
        self._state.opened()
        granted = channel.connection.granted
        assert granted is not None
        self._out.version = channel.version
        limits = KINDS[self.settings.kind]
        self._sender.begin(limits.announced(granted.properties, channel.version))

    def subscribed(self, channel: Channel, refused: list[tuple[Subscription, int]]) -> None:
        """See `ChannelOwner`."""
        line = self._line_of(channel)
        line.on_subscribed(channel, [each.filter for each, _ in refused])
        for each, code in refused:
            log.warning(
                "%s: the fleet's broker refuses the subscription to %s: %s; %s",
                self,
                quote(each.filter),
                reason_words(code),
                subscription_advice(code, self.settings, each.filter),
            )
        if not line.is_kept and not channel.is_subscribed:
            self._state.subscribed(line.position)
        self._report()

    def ended(self, channel: Channel, ending: Ending) -> None:
        """See `ChannelOwner`."""
        line = self._line_of(channel)
        is_answered = channel.is_subscribed and not channel.unanswered
        is_causeless, advice = ending.is_close and is_answered, ""
        try:
            if not line.is_kept:
                state, now = self._state, self._loop.time()
                inflight = channel.connection.unsettled()
                was_settled = state.is_settled and is_answered
                is_stuck = self._sender.end(ending, inflight, was_settled=was_settled)
                is_causeless = is_causeless and state.is_settled and not is_stuck
                is_causeless = is_causeless and not state.is_refused
                advice = state.ended(channel, ending, line.position, now, is_answered=is_answered)
        finally:
            line.on_ended(ending, is_causeless=is_causeless, advice=advice)
        self._report()

    def _line_of(self, channel: Channel) -> Line:
        return self._lines[channel.is_kept]

    def say_offline(self, channel: Channel) -> None:
        """See `LineOwner`."""
        self._state.leave(channel)

    def client_id(self, *, is_kept: bool) -> str:
        """The client id there of one of the connections."""
        return self.settings.client_id + ("-keep" if is_kept else "")

    def connect_settings(
        self,
        version: int,
        credentials: Credentials,
        *,
        is_kept: bool,
        refused: Collection[ReasonCode],
    ) -> ConnectSettings:
        """What CONNECT asks for; the broker has `refused` the will because of these."""
        settings = self.settings
        limits = KINDS[settings.kind]
        will = None
        if not is_kept:
            state = self._state.payload(Presence.BROKEN)
            qos = 0 if ReasonCode.QOS_NOT_SUPPORTED in refused else min(1, limits.qos)
            retain = limits.retain and ReasonCode.RETAIN_NOT_SUPPORTED not in refused
            will = Will(settings.state_there, state, qos, retain)
        return ConnectSettings(
            client_id=self.client_id(is_kept=is_kept),
            version=version,
            clean_start=not is_kept,
            session_expiry=KEPT_EXPIRY if is_kept else 0,
            keep_alive=limits.keep_alive(settings.keep_alive),
            username=settings.login.username,
            password=credentials.password,
            will=will,
            method=settings.login.method if version == V5 and limits.auth else None,
            authentication_data=credentials.data if version == V5 else None,
            window=min(settings.window, limits.window),
            receive_maximum=RECEIVE_MAXIMUM,
            maximum_packet_size=self.broker.limits.packet_size,
            user_properties=min(MAXIMUM_PAIRS, self.broker.limits.user_properties + MOST_ADDED),
            filters_per_packet=limits.filters or 100,
        )

    def subscriptions(self, version: int, *, is_kept: bool) -> list[Subscription]:
        """What a connection subscribes to there."""
        filters = self._rules.in_filters("keep" if is_kept else "drop")
        if not is_kept:
            if version == V5:
                filters.append(self.settings.answers_there + "+")
            else:
                replies = (reply_filter(rule.remote_filter) for rule in self.settings.out)
                filters += [each for each in replies if each is not None]
        is_v5 = version == V5
        return [
            Subscription(each, 1, no_local=is_v5, retain_as_published=is_v5)
            for each in dict.fromkeys(filters)
        ]

    def least_late(self, *, is_kept: bool) -> float | None:
        """The least age for which what comes on a connection is refused as late."""
        if is_kept:  # by a session that is kept, all of it may be
            return None
        rules = [rule for rule in self.settings.inward if rule.offline == "drop"]
        return min((age for rule in rules if (age := rule.least_age) is not None), default=None)

    def surroundings(self) -> Surroundings:
        """For the transport."""
        broker = self.broker
        account = broker.accounting.accounts.of_user(self.settings.user)
        return Surroundings(
            self._scheduler,
            account,
            partial(broker.accounting.take, account),
            broker.limits.packet_size,
        )

    # --- status --------------------------------------------------------------------------------

    @property
    def is_connected(self) -> bool:
        """Whether the fleet's broker has accepted it, for all rules."""
        channels = [line.channel for line in self._lines]
        return all(each is not None and each.connection.granted is not None for each in channels)

    def status(self) -> LinkStatus:
        """How the link is now."""
        settings, line = self.settings, self._lines[0]
        counts = self._backlog.counts()
        status = LinkStatus(settings.name, settings.kind, client_id=settings.client_id)
        status.problem = line.problem
        kept = self._lines[-1]
        if status.problem is None and kept.problem is not None:
            status.problem = f"the connection for the rules with offline: keep: {kept.problem}"
        status.attempts, status.connections = line.attempts, line.connections
        status.server = line.server
        channel = line.channel
        if channel is not None and channel.connection.granted is not None:
            connection = channel.connection
            status.connected = True
            status.version = "5" if channel.version == V5 else "3.1.1"
            status.since = round(self._loop.time() - channel.connected_at, 1)
            if connection.round_trip is not None:
                status.round_trip = max(connection.round_trip, CLOCK_STEP)
            status.window = connection.window
            status.inflight = connection.inflight
        status.waiting, status.waiting_bytes = counts.waiting, counts.bytes
        if counts.oldest_at is not None:
            status.oldest = round(max(0.0, self._journal_clock() - counts.oldest_at), 3)
        status.offered, status.sent = counts.offered, counts.sent
        status.offered_a_second = round(self._offered.rates[0], 1)
        status.sent_a_second = round(self._sent.rates[0], 1)
        status.received = self._in_counters.received
        came = self._in_counters.came
        status.came = {rule.remote_filter: came[rule.remote_filter] for rule in settings.inward}
        status.delivered = self._in_counters.delivered
        status.refused = self._in_counters.refused
        for channel in filter(None, (line.channel for line in self._lines)):
            status.unacknowledged += channel.connection.unacknowledged
            status.held_back += channel.inward.waiting if channel.inward is not None else 0
        for (rule, reason), count in counts.dropped.items():
            status.count_dropped(rule.lstrip("\0"), reason.value, count)
        for (rule, verdict), count in self._in_counters.dropped.items():
            status.count_dropped(rule, verdict.value, count)
        status.set_aside, status.too_large = counts.aside, counts.held
        status.refused_filters = [each for line in self._lines for each in line.refused_filters]
        status.missing_filters = [each for line in self._lines for each in line.missing_filters]
        status.forgotten = self._forgotten
        status.denied = dict(self._out.denied)
        status.denied_inward = dict(self._in_counters.denied)
        status.state_refusal = self._state.refusal
        status.advice = bottleneck(status)
        return status

    def aside(self) -> list[dict[str, object]]:
        """The messages that were set aside, the oldest first, with their age in seconds."""
        now = self._journal_clock()
        return [
            {
                "rule": each.rule,
                "topic": each.topic,
                "size": each.size,
                "reason": each.reason,
                "age": round(now - each.at, 1),
            }
            for each in self._backlog.aside()
        ]

    def clock_was_set(self) -> None:
        """The wall clock was set: certificates may be valid now."""
        for line in self._lines:
            line.clock_was_set()

    def _report(self) -> None:
        """Publish the status here, where it has changed."""
        self._reported_at = self._loop.time()
        status = self.status()
        payload = orjson.dumps(status.as_json())
        if payload != self._reported:
            self._reported = payload
            self._publish_here(payload, b"1" if status.connected else b"0")

    def _publish_here(self, status: bytes, state: bytes) -> None:
        """Publish both topics that tell here how the link is, retained; empty deletes them."""
        session = self._out.answering
        if session is None:
            return
        about = self.settings.status_here, f"$SYS/broker/connection/{self.settings.client_id}/state"
        self.broker.publish(Message(about[0], status, 0, True, _JSON), session)
        self.broker.publish(Message(about[1], state, 0, True), session)
        self.broker.flush()


def _weakly(method: Callable[[], None]) -> Callable[[], None]:
    """Calls the method as long as its object is there; does not keep that."""
    found = weakref.WeakMethod(method)

    def call() -> None:
        bound = found()
        if bound is not None:
            bound()

    return call
