"""Says at the fleet's broker whether the robot is online, as far as that broker takes it.

The state is sent before the messages of a connection and is answered before they are sent, so that
an end of the connection is not taken for that of a message. Some brokers answer a state that the
login may not publish by closing the connection: RabbitMQ, others as they are set up. There it is
left out once that is sure, as a filter is upon which they close, and sent again later.
"""

from __future__ import annotations

import logging
import math

from appliance.mqtt.codec import quote
from appliance.mqtt.reason import ReasonCode
from appliance.upstream.agreement import Ending
from appliance.upstream.channel import Channel
from appliance.upstream.limits import KINDS
from appliance.upstream.presence import Presence, presence_messages
from appliance.upstream.refusals import reason_words, state_advice, unanswered_state
from appliance.upstream.rules import UpstreamSettings
from appliance.upstream.unanswered import LIVED, UnansweredFilters

log = logging.getLogger(__name__)


class StateReport:
    """The state of one link there, over its connections; times in seconds of the loop's clock.

    Servers are positions in `servers`.
    """

    def __init__(self, settings: UpstreamSettings) -> None:
        self._settings = settings
        self._presence = presence_messages(settings)
        self._topic = settings.state_there
        self._tries = [UnansweredFilters() for _ in settings.servers]
        #: Why the broker did not take it the last time; None if it did.
        self.refusal: str | None = None
        #: On the present connection: whether messages may be sent, as the broker has answered the
        #: state or is not to be sent it.
        self.is_settled = False
        #: It is to be sent; it is left out; it was left out at the beginning; when it was refused.
        self._is_due = self._is_missing = self._was_missing = False
        self._refused_at = -math.inf

    def payload(self, presence: Presence) -> bytes:
        """What is published for it."""
        return self._presence.payload(presence)

    @property
    def is_refused(self) -> bool:
        """Whether the present connection was sent it, and the broker has refused it."""
        return self._refused_at > -math.inf

    def opened(self) -> None:
        """There is a new connection."""
        self.is_settled = self._is_due = self._is_missing = self._was_missing = False
        self._refused_at = -math.inf

    def subscribed(self, server: int) -> None:
        """The broker has answered the subscriptions of the connection."""
        self._is_due = bool(self._tries[server].ask([self._topic]))
        self.is_settled = self._is_missing = self._was_missing = not self._is_due

    def tick(self, channel: Channel, server: int, now: float) -> None:
        """Called every second on a connection: what was left out may be tried again."""
        if not (self._is_missing and self.is_settled and channel.is_subscribed):
            return
        # Alone, without a subscription or a message that the broker may close upon as well.
        lived = now - channel.connected_at
        if not channel.unanswered and self._tries[server].due([self._topic], lived, now):
            self._is_due, self.is_settled = True, False
            channel.send_on()

    def send(self, channel: Channel) -> None:
        """Say that the robot is online, if that is due and nothing else is under way."""
        if self._is_due and not channel.connection.inflight and channel.connection.room:
            self._is_due = False
            self._publish(channel, Presence.ONLINE)

    def leave(self, channel: Channel) -> None:
        """Say that the robot is offline from now on, before the connection ends."""
        if not self._is_missing:
            self._publish(channel, Presence.OFFLINE)

    def _publish(self, channel: Channel, presence: Presence) -> None:
        connection = channel.connection
        granted = connection.granted
        if granted is None:
            return
        limits = KINDS[self._settings.kind]
        # With QoS 0 where the window has no room: before the end, nothing else will follow.
        qos = min(1, granted.maximum_qos, connection.room)
        retain = granted.retain and limits.retain
        code = connection.publish(None, self._topic, self.payload(presence), qos, retain)
        if code:
            what = f"the fleet's broker cannot be sent {quote(self._topic)}: {reason_words(code)}"
            self._refuse(what, code)
        if code or not qos:
            self.is_settled = True

    def acknowledged(self, server: int, code: int, now: float) -> None:
        """The broker has answered."""
        self.is_settled = True
        self._is_missing = False
        if code < 0x80:
            self._tries[server].answered([self._topic])
            self.refusal = None
            return
        self._refused_at = now
        self._refuse(f"the fleet's broker refuses {quote(self._topic)}: {reason_words(code)}", code)

    def ended(
        self, channel: Channel, ending: Ending, server: int, now: float, *, is_answered: bool
    ) -> str:
        """The connection has ended, on which `is_answered` says that the subscriptions were;
        returns what a person can do about it, empty if the state was not the reason."""
        if not is_answered:
            return ""
        is_upon = ending.may_refuse and not (self.is_settled or self._is_due)
        # mosquitto 2.0 with `max_queued_messages 0` closes behind a refused message.
        is_behind = ending.is_close and now < self._refused_at + LIVED
        if not (is_upon or is_behind):
            if self.is_refused:
                self._tries[server].answered([self._topic])
            return ""
        tries = self._tries[server]
        if tries.closed([self._topic], now, [], lived=self._was_missing) is not None:
            what = f"the fleet's broker ends the connection upon {quote(self._topic)}"
            self._refuse(what, ReasonCode.NOT_AUTHORIZED)
        return unanswered_state(self._settings) if is_upon else ""

    def _refuse(self, what: str, code: int) -> None:
        text = f"{what}; {state_advice(code, self._settings)}"
        if text != self.refusal:
            self.refusal = text
            log.warning("upstream '%s': %s", self._settings.name, text)
