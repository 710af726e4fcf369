"""The half of a client that sends: messages until they are acknowledged, and subscriptions."""

from __future__ import annotations

import itertools
import zlib
from dataclasses import dataclass

from appliance.mqtt.codec import V5, Properties, Property
from appliance.mqtt.packets import (
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Unsuback,
    Unsubscribe,
)
from appliance.mqtt.reason import ReasonCode
from soak.records import Grant, Message
from soak.rights import SHARE
from soak.wire import Speaker

#: QoS 1 and 2 messages under way from a 3.1.1 client, which is told no limit.
_QUOTA_V311 = 20


@dataclass(slots=True)
class _Outgoing:
    """A QoS 1 or 2 message on its way to the broker; `released` once PUBREC came."""

    message: Message
    released: bool = False
    resent: bool = False


@dataclass(slots=True)
class _Asked:
    """A filter in a SUBSCRIBE or, without a grant, in an UNSUBSCRIBE that waits for its answer."""

    filter: str
    sent_at: float
    grant: Grant | None = None
    #: The broker certainly had the subscription.
    held: bool = False


class Outbox:
    """QoS 1 and 2 as a sender, strictly: every answer that does not fit is a violation."""

    def __init__(self, speaker: Speaker) -> None:
        self._speaker = speaker
        self._profile = speaker.profile
        self._is_v5 = speaker.profile.version == V5
        self._packet_ids = itertools.cycle(range(1, 65536))
        # For as long as the session lives.
        self._outgoing: dict[int, _Outgoing] = {}
        # On this connection.
        self._asked: dict[int, list[_Asked]] = {}
        self._quota = _QUOTA_V311
        self._alias_maximum = 0
        self._aliases: dict[str, int] = {}
        #: Sent since the last PINGREQ, with QoS 0.
        self._unanswered: list[Message] = []
        #: Sent on connections that are over: they may still be read.
        self._unread: list[Message] = []

    @property
    def empty(self) -> bool:
        """Whether nothing that was sent waits for an answer."""
        return not self._outgoing and not self._asked

    def disconnected(self, unanswered: list[Message]) -> None:
        """The connection is over; also these QoS 0 messages may not have been read."""
        self._asked.clear()
        self._aliases.clear()
        self._unread += unanswered
        self._unread += self.take_unanswered()

    def forget(self) -> None:
        """The session is over."""
        self._unread += (entry.message for entry in self._outgoing.values())
        self._outgoing.clear()

    def connected(self, properties: Properties) -> None:
        """A new connection: nothing that earlier ones have brought is still to be read."""
        for message in self._unread:
            self._speaker.model.closed(message, "has a new connection")
        self._unread.clear()
        if self._is_v5:
            quota = properties.get(Property.RECEIVE_MAXIMUM, 65535)
            aliases = properties.get(Property.TOPIC_ALIAS_MAXIMUM, 0)
            assert isinstance(quota, int) and isinstance(aliases, int)
            self._quota, self._alias_maximum = quota, aliases
        self._resend()

    def take_unanswered(self) -> list[Message]:
        """The QoS 0 messages that were sent since this was asked last."""
        unanswered, self._unanswered = self._unanswered, []
        return unanswered

    # --- messages ------------------------------------------------------------------------------

    def _resend(self) -> None:
        for packet_id, entry in self._outgoing.items():  # [MQTT-4.4.0-1], in the order of sending
            entry.resent = True
            if entry.released:
                self._speaker.send(Pubrel(packet_id))
                continue
            message = entry.message
            self._speaker.model.sent(message, f" again, id={packet_id} DUP")
            packet = Publish(
                message.topic,
                message.payload,
                message.qos,
                message.retain,
                dup=True,
                packet_id=packet_id,
                properties=_properties(message),
            )
            self._speaker.send(packet)

    def publish(
        self,
        topic: str,
        qos: int,
        *,
        retain: bool = False,
        size: int = 0,
        clears: bool = False,
        half: bool = False,
    ) -> None:
        """Publish, unless the broker's Receive Maximum is used up; `half` is cut on the way."""
        speaker = self._speaker
        model = speaker.model
        if qos and len(self._outgoing) >= self._quota:
            model.counts["held back"] += 1
            return
        message = model.message(
            self._profile.client_id,
            speaker.rights,
            topic,
            qos,
            retain=retain,
            size=size,
            clears=clears,
            labelled=self._is_v5 and speaker.random.random() < 0.3,
        )
        properties = _properties(message)
        if self._is_v5 and speaker.random.random() < 0.5 and not half:
            topic, properties = self._alias(topic, properties)
        packet_id = self._packet_id() if qos else None
        if packet_id is not None:
            self._outgoing[packet_id] = _Outgoing(message)
        packet = Publish(
            topic, message.payload, qos, retain, packet_id=packet_id, properties=properties
        )
        if half:
            speaker.cut_inside(packet)
            return
        model.sent(message, f", id={packet_id}" if qos else "")
        if not qos:
            self._unanswered.append(message)
        speaker.send(packet)
        speaker.spring(f"PUBLISH {qos} sent")

    def _packet_id(self) -> int:
        return next(
            number
            for number in self._packet_ids
            if number not in self._outgoing and number not in self._asked
        )

    def _alias(self, topic: str, properties: Properties | None) -> tuple[str, Properties | None]:
        known = self._aliases.get(topic)
        if known is None and len(self._aliases) >= self._alias_maximum:
            return topic, properties
        alias = self._aliases.setdefault(topic, len(self._aliases) + 1)
        properties = {**(properties or {}), Property.TOPIC_ALIAS: alias}
        return topic if known is None else "", properties

    def on_puback(self, packet: Puback) -> None:
        """A QoS 1 message is with the broker, or refused."""
        entry = self._outgoing.pop(packet.packet_id, None)
        if entry is None or entry.message.qos != 1:
            self._misplaced(packet, entry)
        else:
            self._outcome(entry.message, packet)

    def on_pubrec(self, packet: Pubrec) -> None:
        """A QoS 2 message is with the broker, or refused."""
        speaker = self._speaker
        entry = self._outgoing.get(packet.packet_id)
        if entry is None or entry.message.qos != 2 or entry.released:
            self._misplaced(packet, entry)
            return
        entry.message.events.append((speaker.model.clock(), f"{self._profile.client_id}: {packet}"))
        if packet.reason_code >= 0x80:
            del self._outgoing[packet.packet_id]
            self._outcome(entry.message, packet)
            return
        entry.released = True
        if not speaker.spring("PUBREC received"):
            speaker.send(Pubrel(packet.packet_id))
            speaker.spring("PUBREL sent")

    def on_pubcomp(self, packet: Pubcomp) -> None:
        """The exchange is over."""
        entry = self._outgoing.pop(packet.packet_id, None)
        if entry is None or not entry.released:
            self._misplaced(packet, entry)
            return
        if packet.reason_code and not entry.resent:
            text = f"{packet} for what PUBREC was sent for"
            self._speaker.wrong("packet id", text, entry.message)
        self._outcome(entry.message, packet)

    def _misplaced(self, packet: Puback | Pubrec | Pubcomp, entry: _Outgoing | None) -> None:
        message = entry.message if entry is not None else None
        self._speaker.wrong("packet id", f"{packet} for nothing under way", message)

    def _outcome(self, message: Message, packet: Puback | Pubrec | Pubcomp) -> None:
        """Whether the broker takes it, and whether that is right."""
        code = packet.reason_code
        wrong = self._speaker.wrong
        if code < 0x80 or isinstance(packet, Pubcomp):
            if self._is_v5 and not message.permitted:
                wrong("not permitted", f"{packet}", message)
            self._speaker.model.acknowledged(message, str(packet))
            return
        self._speaker.model.refused(message, code, packet.TYPE.name)
        if message.permitted and code != ReasonCode.QUOTA_EXCEEDED:
            wrong("refused", f"{packet}", message)
        elif not message.permitted and code != ReasonCode.NOT_AUTHORIZED:
            wrong("refused", f"{packet}, and 0x87 is right", message)

    # --- subscriptions -------------------------------------------------------------------------

    def subscribe(self, wanted: dict[str, int]) -> None:
        """Subscribe to the filters, with these QoS."""
        together: list[Subscription] = []
        for topic_filter, qos in wanted.items():
            subscription = self._subscription(topic_filter, qos)
            if subscription.identifier:  # which stands for all of its packet
                self._subscribe([subscription])
            else:
                together.append(subscription)
        if together:
            self._subscribe(together)

    def _subscription(self, topic_filter: str, qos: int) -> Subscription:
        """The filter with its options, which are always the same for this client."""
        subscription = Subscription(topic_filter, qos)
        if self._is_v5:
            dice = zlib.crc32(f"{self._profile.client_id} {topic_filter}".encode())
            subscription.no_local = dice % 8 == 0 and not topic_filter.startswith(SHARE)
            subscription.retain_handling = (0, 0, 1, 2)[dice >> 3 & 3]
            subscription.identifier = (dice >> 8 & 0xFF) + 1 if dice >> 5 & 1 else 0
        if self._profile.as_published:
            subscription.retain_as_published = True
            subscription.retain_handling = 2
        return subscription

    def _subscribe(self, subscriptions: list[Subscription]) -> None:
        speaker = self._speaker
        assert speaker.session is not None
        asked: list[_Asked] = []
        for subscription in subscriptions:
            grant = speaker.model.subscribing(speaker.session, subscription)
            asked.append(_Asked(subscription.filter, grant.sent_at, grant))
        packet_id = self._packet_id()
        self._asked[packet_id] = asked
        identifier = subscriptions[0].identifier
        properties: Properties = {Property.SUBSCRIPTION_IDENTIFIER: [identifier]}
        packet = Subscribe(packet_id, subscriptions, properties if identifier else None)
        speaker.note(str(packet))
        speaker.send(packet)
        speaker.spring("SUBSCRIBE sent")

    def unsubscribe(self, topic_filter: str) -> None:
        """Unsubscribe from a filter that was subscribed to in this session."""
        speaker = self._speaker
        model = speaker.model
        assert speaker.session is not None
        held = model.holds(speaker.session, topic_filter)
        model.unsubscribing(speaker.session, topic_filter)
        packet_id = self._packet_id()
        self._asked[packet_id] = [_Asked(topic_filter, model.clock(), held=held)]
        packet = Unsubscribe(packet_id, [topic_filter])
        speaker.note(str(packet))
        speaker.send(packet)

    def on_suback(self, packet: Suback | Unsuback) -> None:
        """The broker's word on each filter."""
        speaker = self._speaker
        asked = self._asked.pop(packet.packet_id, [])
        speaker.note(str(packet))
        codes = list(packet.reason_codes)
        if isinstance(packet, Unsuback) and not self._is_v5:
            codes = [0] * len(asked)
        if not asked or len(codes) != len(asked):
            speaker.wrong("protocol", f"{packet} for {len(asked)} filters")
        for one, code in zip(asked, codes, strict=False):
            if one.grant is None:
                self._unsubscribed(one, code)
            else:
                self._subscribed(one, one.grant, code)

    def _unsubscribed(self, asked: _Asked, code: int) -> None:
        speaker = self._speaker
        assert speaker.session is not None
        speaker.model.unsubscribed(speaker.session, asked.filter, asked.sent_at)
        if self._is_v5 and asked.held and code:
            speaker.wrong("subscription", f"0x{code:02X}, and {asked.filter} was there")

    def _subscribed(self, asked: _Asked, grant: Grant, code: int) -> None:
        speaker = self._speaker
        assert speaker.session is not None
        allowed = speaker.rights.may_subscribe(asked.filter)
        if code >= 0x80:
            speaker.model.not_subscribed(speaker.session, grant)
            if allowed:
                speaker.wrong("subscription", f"0x{code:02X} for {asked.filter}, which is allowed")
            return
        if not allowed:
            speaker.wrong("not permitted", f"0x{code:02X} for {asked.filter}")
        if code != grant.qos:
            text = f"QoS {code} for {asked.filter} with QoS {grant.qos}"
            speaker.wrong("subscription", text)
        speaker.model.subscribed(speaker.session, asked.filter, grant)


def _properties(message: Message) -> Properties | None:
    if not message.labelled:
        return None
    return {
        Property.MESSAGE_EXPIRY_INTERVAL: 86400,
        Property.USER_PROPERTY: [("number", str(message.number))],
    }
