"""The half of a client that receives messages: what it owes the broker, and what it may be sent."""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from dataclasses import dataclass, field

from appliance.mqtt.codec import PacketType, Property
from appliance.mqtt.packets import Puback, Pubcomp, Publish, Pubrec, Pubrel
from appliance.mqtt.reason import ReasonCode
from soak.records import Message
from soak.wire import Speaker


@dataclass(slots=True)
class Acknowledged:
    """Acknowledgements that went out one behind the other."""

    pubacks: list[tuple[int, Message | None]] = field(default_factory=list)
    pubcomps: list[tuple[int, int]] = field(default_factory=list)


class Inbox:
    """QoS 1 and 2 as a receiver, strictly: every packet that does not fit is a violation."""

    def __init__(self, speaker: Speaker) -> None:
        self._speaker = speaker
        self._profile = speaker.profile
        # For as long as the session lives, by packet id: QoS 1 messages that may come again, QoS 2
        # messages until PUBREL, those that were declined, and ids whose PUBREL may come again.
        self._received: dict[int, Message | None] = {}
        self._unreleased: dict[int, Message | None] = {}
        self._declined: dict[int, Message | None] = {}
        self._released: dict[int, int] = {}
        self._serial = itertools.count(1)
        # On this connection: ids in use, ids that came, ids in the order of their PUBREC, the
        # acknowledgements that wait, those since the last PINGREQ, and topic aliases.
        self._unanswered: set[int] = set()
        self._seen: set[int] = set()
        self._recorded: deque[int] = deque()
        self._answers: deque[tuple[PacketType, int, int]] = deque()
        self._acknowledged = Acknowledged()
        self._topics: dict[int, str] = {}
        self._connections = 0

    def disconnected(self) -> None:
        """The connection is over."""
        self._connections += 1
        self._unanswered.clear()
        self._seen.clear()
        self._recorded.clear()
        self._answers.clear()
        self._acknowledged = Acknowledged()
        self._topics.clear()

    def forget(self) -> None:
        """The session is over."""
        for state in (self._received, self._unreleased, self._declined, self._released):
            state.clear()

    def take_acknowledged(self) -> Acknowledged:
        """What was acknowledged since this was asked last."""
        acknowledged, self._acknowledged = self._acknowledged, Acknowledged()
        return acknowledged

    def confirm(self, acknowledged: Acknowledged) -> None:
        """The broker has read them: from here on nothing of it may be repeated."""
        for packet_id, message in acknowledged.pubacks:
            if self._received.get(packet_id) is message:
                self._received.pop(packet_id, None)
        for packet_id, serial in acknowledged.pubcomps:
            if self._released.get(packet_id) == serial:
                del self._released[packet_id]

    def on_publish(self, packet: Publish) -> None:
        """A message came."""
        speaker = self._speaker
        session = speaker.session
        assert session is not None
        self._resolve(packet)
        message = speaker.identify(packet)
        packet_id = packet.packet_id
        if packet_id is None:
            if message is not None:
                speaker.model.delivered(session, packet, message)
            return
        if packet_id in self._unanswered:
            speaker.wrong("packet id", f"{packet}: the id is in use", message)
        if packet.dup and (not session.resumed or packet_id in self._seen):  # [MQTT-4.4.0-1]
            speaker.wrong("DUP", f"{packet}: it was not sent before", message)
        self._unanswered.add(packet_id)
        self._seen.add(packet_id)
        if len(self._unanswered) > self._profile.receive_maximum:  # [MQTT-3.3.4-9]
            speaker.wrong("receive maximum", f"{packet} is one too many", message)
        again = self._remember(packet, packet_id, message)
        if message is not None:
            speaker.model.delivered(session, packet, message, again=again)
        if speaker.spring(f"PUBLISH {packet.qos} received"):
            return
        code = ReasonCode.SUCCESS
        if self._profile.declines and speaker.random.random() < self._profile.declines:
            code = ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR
        self._answer(PacketType.PUBACK if packet.qos == 1 else PacketType.PUBREC, packet_id, code)

    def _remember(self, packet: Publish, packet_id: int, message: Message | None) -> bool:
        """Whether it repeats what an earlier connection has brought already."""
        if packet_id in self._unreleased:
            if packet.qos == 1 or not packet.dup or self._unreleased[packet_id] is not message:
                self._speaker.wrong("packet id", f"{packet}: another message has the id", message)
            return packet.qos == 2
        if packet.qos == 1:
            before = self._received.get(packet_id)
            self._received[packet_id] = message
        else:
            before = self._declined.pop(packet_id, None)
            self._unreleased[packet_id] = message
        return packet.dup and message is not None and before is message

    def _resolve(self, packet: Publish) -> None:
        """Put the topic in place of its alias."""
        alias = (packet.properties or {}).get(Property.TOPIC_ALIAS)
        if alias is None:
            return
        assert isinstance(alias, int)
        if alias > self._profile.aliases:  # [MQTT-3.1.2-26]
            text = f"{packet}: alias {alias} of {self._profile.aliases}"
            self._speaker.wrong("topic alias", text)
        if packet.topic:
            self._topics[alias] = packet.topic
        elif alias in self._topics:
            packet.topic = self._topics[alias]
        else:
            self._speaker.wrong("topic alias", f"{packet}: alias {alias} has no topic")

    def on_pubrel(self, packet: Pubrel) -> None:
        """The broker has seen PUBREC."""
        speaker = self._speaker
        packet_id = packet.packet_id
        if packet_id in self._recorded:
            if self._recorded[0] != packet_id:  # [MQTT-4.6.0-4]
                speaker.wrong("order", f"{packet} before that of {self._recorded[0]}")
            self._recorded.remove(packet_id)
        code = ReasonCode.SUCCESS
        if packet_id in self._unreleased:
            message = self._unreleased.pop(packet_id)
            if message is not None:
                note = f"{speaker.session}: PUBREL id={packet_id}"
                message.events.append((speaker.model.clock(), note))
        elif packet_id in self._released:
            code = ReasonCode.PACKET_IDENTIFIER_NOT_FOUND  # PUBCOMP got lost with a connection
        else:
            speaker.wrong("packet id", f"{packet} for what was never received")
        self._released[packet_id] = next(self._serial)
        if not speaker.spring("PUBREL received"):
            self._answer(PacketType.PUBCOMP, packet_id, code)

    def _answer(self, kind: PacketType, packet_id: int, code: int) -> None:
        """Acknowledge, at once or later, in the order received [MQTT-4.6.0-2..4]."""
        self._answers.append((kind, packet_id, code))
        if not self._profile.ack_delay:
            self._next_answer(self._connections)
            return
        loop = asyncio.get_running_loop()
        loop.call_later(self._profile.ack_delay, self._next_answer, self._connections)

    def _next_answer(self, connection: int) -> None:
        if connection != self._connections:
            return
        speaker = self._speaker
        kind, packet_id, code = self._answers.popleft()
        if kind is PacketType.PUBREC and not code:
            self._recorded.append(packet_id)
            speaker.send(Pubrec(packet_id, code))
        elif kind is PacketType.PUBREC:
            self._unanswered.discard(packet_id)
            self._declined[packet_id] = self._unreleased.pop(packet_id)
            speaker.send(Pubrec(packet_id, code))
        elif kind is PacketType.PUBACK:
            self._unanswered.discard(packet_id)
            self._acknowledged.pubacks.append((packet_id, self._received.get(packet_id)))
            speaker.send(Puback(packet_id, code))
        else:
            self._unanswered.discard(packet_id)
            self._acknowledged.pubcomps.append((packet_id, self._released[packet_id]))
            speaker.send(Pubcomp(packet_id, code))
        speaker.spring(f"{kind.name} sent")
