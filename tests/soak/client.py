"""An MQTT client that may be cut anywhere, and tells the model all that it does and sees.

It keeps its own half of the protocol strictly: packet identifiers, QoS 2 on both sides, re-sending
with DUP after a session was continued, the server's Receive Maximum, acknowledgements in order. So
whatever does not fit is the broker's doing, and a violation.
"""

from __future__ import annotations

import asyncio
import random
from collections import deque
from collections.abc import Coroutine
from dataclasses import dataclass
from math import inf

from appliance.mqtt.codec import V5, Properties, Property
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Unsuback,
    Will,
    decode_packet,
)
from appliance.mqtt.reason import ProtocolError, ReasonCode
from soak.inbox import Acknowledged, Inbox
from soak.model import Model
from soak.outbox import Outbox
from soak.records import Message, Session
from soak.wire import Profile, Target, Wire

#: Seconds that an answer, or a connection's end, may take on a computer that is busy.
PATIENCE = 30.0

#: Seconds after its end until a session that has expired must really be gone.
EXPIRY_SLACK = 5.0


@dataclass(slots=True)
class Ping:
    """A PINGREQ, and what the broker has seen for certain when its answer is there."""

    sent_at: float
    #: How often the client had stopped to read; None when it did not read. If it does so before
    #: the answer, the time to it says nothing.
    pauses: int | None
    acknowledged: Acknowledged
    messages: list[Message]


class Client:
    """A client id with its session state, over all of its connections."""

    def __init__(self, model: Model, target: Target, profile: Profile, seed: str) -> None:
        self.model = model
        self.target = target
        self.profile = profile
        self.rights = model.rights[profile.user]
        self.random = random.Random(seed)
        self.wire: Wire | None = None
        self.session: Session | None = None
        #: Set while there is no connection, for who waits for its end.
        self.gone = asyncio.Event()
        self.gone.set()
        #: The moment in the protocol at which the connection is cut, once.
        self.trap: str | None = None
        #: Seconds from PINGREQ to PINGRESP.
        self.round_trips: list[float] = []
        #: The next CONNECT must be with Clean Start: whether there is a session is not known.
        self.must_be_clean = False
        #: What the broker says of shared subscriptions in MQTT 5.
        self.shared_available = True
        self._connack: asyncio.Future[None]
        self._clean = False
        # The session at the broker: how long it is kept, and when the connection ended at the
        # earliest and at the latest; None while there is none.
        self._kept = 0.0
        self._left: tuple[float, float] | None = None
        self._connecting_at = 0.0
        self._will: Message | None = None
        #: Wills that may have been published, and whether they must have been.
        self._due_wills: list[tuple[Message, bool]] = []
        self.inbox = Inbox(self)
        self.outbox = Outbox(self)
        self._pings: deque[Ping] = deque()
        self._tasks: set[asyncio.Task[None]] = set()

    # --- connecting ----------------------------------------------------------------------------

    def note(self, what: str) -> None:
        """See `Speaker`, as for the others that its halves call."""
        if self.session is not None:
            self.session.events.append((self.model.clock(), what))

    def wrong(self, kind: str, text: str, message: Message | None = None) -> None:
        text = f"{self.profile.client_id}: {text}"
        self.model.violation(kind, text, message, self.session)

    async def connect(self, *, clean: bool, will_qos: int | None, stop: str | None = None) -> bool:
        """Connect, in place of the connection that there may be.

        `stop` cuts it on the way: "open" before CONNECT, "half" inside it, "sent" behind it.
        Returns whether it is connected.
        """
        clean = clean or self.must_be_clean
        wire = Wire(self)
        try:
            await asyncio.wait_for(wire.open(self.target, self.profile), PATIENCE)
        except (OSError, asyncio.TimeoutError) as error:
            self.wrong("no connection", repr(error))
            return False
        will = self._new_will(will_qos)
        data = self._connect_packet(clean, will).encode()
        if stop == "half":
            wire.break_off(data, self.random.randrange(1, len(data)))
        if stop in ("open", "half"):
            await asyncio.sleep(self.random.uniform(0, 0.01))
            wire.cut(reset=self.random.random() < 0.5)
            return False
        old = self.wire
        if old is not None:
            self.model.counts["take-overs"] += 1
            self._leave("takes over", will="due")
        if clean and self.session is not None:
            self.model.give_up(self.session)
        self._connecting_at = self.model.clock()
        self.note(f"CONNECT{' clean' if clean else ''}{' ' + stop if stop else ''}")
        if stop == "sent":
            wire.write(data)
            await asyncio.sleep(self.random.uniform(0, 0.02))
            wire.cut(reset=self.random.random() < 0.5)
            if old is not None:
                old.cut(reset=False)
            self._not_known(clean, will)
            return False
        self._clean = clean
        self._will = will
        self._connack = asyncio.get_running_loop().create_future()
        self.wire = wire
        self.gone.clear()
        wire.write(data)
        try:
            await asyncio.wait_for(asyncio.shield(self._connack), PATIENCE)
        except asyncio.TimeoutError:
            self.wrong("no answer", f"no CONNACK within {PATIENCE:g} s")
            self.cut("gives up", reset=True)
        if old is not None:
            self._in_background(self._expect_end(old))
        return self.wire is wire

    def _connect_packet(self, clean: bool, will: Message | None) -> Connect:
        profile = self.profile
        properties: Properties = {}
        if profile.version == V5:
            if profile.expiry:
                properties[Property.SESSION_EXPIRY_INTERVAL] = int(profile.expiry)
            if profile.receive_maximum < 65535:
                properties[Property.RECEIVE_MAXIMUM] = profile.receive_maximum
            if profile.aliases:
                properties[Property.TOPIC_ALIAS_MAXIMUM] = profile.aliases
        return Connect(
            profile.client_id,
            clean_start=clean,
            keep_alive=60,
            version=profile.version,
            username=profile.user,
            password=self.target.passwords[profile.user].encode(),
            will=Will(will.topic, will.payload, will.qos) if will is not None else None,
            properties=properties or None,
        )

    def _new_will(self, qos: int | None) -> Message | None:
        if qos is None:
            return None
        topic = f"r2d2/soak/will/{self.profile.client_id}"
        return self.model.message(self.profile.client_id, self.rights, topic, qos, size=80)

    def _keeps(self, clean: bool) -> float:
        """Seconds that the session of such a CONNECT outlives the connection."""
        return 0.0 if clean and self.profile.version != V5 else self.profile.expiry

    def _not_known(self, clean: bool, will: Message | None) -> None:
        """CONNECT was cut, and may or may not have been seen."""
        now = self.model.clock()
        if will is not None:
            self.model.sent(will, " with a CONNECT that is cut")
            self._due_wills.append((will, False))
        if clean or self._left is None or now - self._left[0] >= self._kept:
            if self._keeps(clean) or self._left is not None:
                self.must_be_clean = True
        else:
            self._left = (self._left[0], now)

    def _present(self, now: float) -> bool | None:
        """Whether CONNACK must say session present; None when it may or may not."""
        if self._clean or self._left is None:
            return False
        if now - self._left[0] < self._kept:
            return True
        if self._connecting_at - self._left[1] > self._kept + EXPIRY_SLACK:
            return False
        return None

    def _on_connack(self, packet: Connack) -> None:
        model = self.model
        if self._connack.done():
            self.wrong("protocol", "a second CONNACK")
            return
        self._connack.set_result(None)
        if packet.reason_code:
            self.wrong("refused", f"{packet}")
            self.cut("was refused", reset=True)
            return
        present = packet.session_present
        expected = self._present(model.clock())
        if expected is not None and present != expected:
            self.wrong("session present", f"CONNACK says {present}, and {expected} is right")
        if present and self.session is not None and not self._clean:
            self.session.resumed += 1
            self.model.counts["sessions continued"] += 1
        else:
            if self.session is not None:
                model.end(self.session)
            self._forget()
            self.session = model.begin(
                self.profile.client_id, self.rights, as_published=self.profile.as_published
            )
        self.note(f"CONNACK, session present {present:d}")
        for will, certain in self._due_wills:
            if certain:
                model.acknowledged(will, "CONNACK of its next connection")
            else:
                model.closed(will, "has a new connection")
        self._due_wills.clear()
        self.must_be_clean = False
        self._kept = self._keeps(self._clean)
        self._left = (inf, inf)
        model.counts["connects"] += 1
        properties = packet.properties or {}
        self.shared_available = bool(properties.get(Property.SHARED_SUBSCRIPTION_AVAILABLE, 1))
        self.outbox.connected(properties)

    def _forget(self) -> None:
        """A session that is gone takes all protocol state with it."""
        self.outbox.forget()
        self.inbox.forget()

    async def _expect_end(self, wire: Wire) -> None:
        """The broker has to end a connection that was taken over, and to say so in MQTT 5."""
        closed = await self._is_closed(wire, "take-over", "the old connection is still there after")
        expected = ReasonCode.SESSION_TAKEN_OVER if self.profile.version == V5 else wire.reason
        if closed and wire.reason != expected:
            how = f"{wire.error!r} after {wire.pauses} pauses, TLS: {self.profile.tls}"
            self.wrong("take-over", f"the old connection ended with {wire.reason!r}: {how}")

    async def _is_closed(self, wire: Wire, kind: str, otherwise: str) -> bool:
        """Whether the broker closes it in time; else that is a fault, and it is cut."""
        wire.resume()
        try:
            await asyncio.wait_for(wire.closed.wait(), PATIENCE)
        except asyncio.TimeoutError:
            self.wrong(kind, f"{otherwise} {PATIENCE:g} s")
            wire.cut(reset=True)
            return False
        return True

    def _in_background(self, work: Coroutine[object, object, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # --- the connection's end ------------------------------------------------------------------

    def cut(self, why: str, *, reset: bool) -> None:
        """End the connection without a word."""
        wire = self.wire
        if wire is None:
            return
        self.model.counts["cuts"] += 1
        self._leave(f"{why}: {'reset' if reset else 'closed'}", will="due")
        wire.cut(reset=reset)

    def cut_inside(self, packet: Packet) -> None:
        """Send the beginning of a packet that asks for nothing new, then be gone."""
        assert self.wire is not None
        data = packet.encode(self.profile.version)
        self.wire.break_off(data, self.random.randrange(1, len(data)))
        self._cut_soon(f"cuts inside {packet}")

    def _cut_soon(self, why: str) -> None:
        """Cut it when what was written has had, or has not quite had, the time to leave."""
        wire = self.wire
        reset = self.random.random() < 0.7

        def cut() -> None:
            if self.wire is wire:
                self.cut(why, reset=reset)

        asyncio.get_running_loop().call_later(self.random.uniform(0, 0.005), cut)

    async def disconnect(self, *, expiry: int | None = None, with_will: bool = False) -> None:
        """Leave with DISCONNECT, and see that the broker closes."""
        wire = self.wire
        assert wire is not None
        packet = Disconnect()
        if self.profile.version == V5:
            if with_will:
                packet.reason_code = ReasonCode.DISCONNECT_WITH_WILL_MESSAGE
            if expiry is not None and self._kept:
                packet.properties = {Property.SESSION_EXPIRY_INTERVAL: expiry}
                self._kept = float(expiry)
        self.model.counts["disconnects"] += 1
        self.send(packet)
        due = packet.reason_code != ReasonCode.NORMAL_DISCONNECTION
        self._leave(f"{packet} expiry={expiry}", will="due" if due else "dropped")
        await self._is_closed(wire, "no answer", "not closed after DISCONNECT and")
        if self._left is not None:  # the broker may have seen it only now
            self._left = (self._left[0], self.model.clock())

    def _leave(self, why: str, *, will: str) -> None:
        """The connection is over as far as the client goes."""
        model = self.model
        now = model.clock()
        self.note(why)
        self.wire = None
        self.gone.set()
        self.trap = None
        if self._will is not None and will == "due":
            model.sent(self._will, f" as a will: {why}")
            self._due_wills.append((self._will, True))
        self._will = None
        self.inbox.disconnected()
        self.outbox.disconnected([message for ping in self._pings for message in ping.messages])
        self._pings.clear()
        self._left = (now, now)
        if self.session is not None:
            model.left(self.session)
            if not self._kept:
                model.end(self.session)
                self.session = None
                self._forget()
        if not self._kept:
            self._left = None

    def lost(self, wire: Wire) -> None:
        """A connection ended; one that was in use should not have."""
        if wire is not self.wire:
            return
        self.wrong("closed", f"the broker closed the connection ({wire.reason!r})")
        if not self._connack.done():
            self._connack.set_result(None)
        self._leave("was closed by the broker", will="due")

    # --- sending -------------------------------------------------------------------------------

    def send(self, packet: Packet) -> None:
        assert self.wire is not None
        self.wire.write(packet.encode(self.profile.version))

    def ping(self) -> None:
        """Ask whether the broker is there; its answer also says how far it has come."""
        assert self.wire is not None
        if self._pings and self.model.clock() - self._pings[0].sent_at > PATIENCE:
            self.wrong("no answer", f"no PINGRESP within {PATIENCE:g} s")
            self.cut("has waited too long", reset=True)
            return
        now = self.model.clock()
        acknowledged = self.inbox.take_acknowledged()
        messages = self.outbox.take_unanswered()
        pauses = None if self.wire.paused else self.wire.pauses
        self._pings.append(Ping(now, pauses, acknowledged, messages))
        self.send(Pingreq())

    # --- receiving -----------------------------------------------------------------------------

    def received(self, wire: Wire, data: bytes) -> None:
        """A whole packet came in."""
        start = next(index for index in range(1, 5) if data[index] < 0x80) + 1
        try:
            packet = decode_packet(data[0], data[start:], self.profile.version)
        except ProtocolError as error:
            self.wrong("protocol", f"received {data[:100].hex()}: {error}")
            return
        if isinstance(packet, Disconnect):
            wire.reason = ReasonCode(packet.reason_code)
            if self.profile.version != V5:
                self.wrong("protocol", f"received {packet}")
            return
        if wire is not self.wire:
            return  # Given up: as good as lost on the way.
        if isinstance(packet, Connack):
            self._on_connack(packet)
        elif not self._connack.done():
            self.wrong("protocol", f"received {packet} before CONNACK")
        elif isinstance(packet, Publish):
            self.inbox.on_publish(packet)
        elif isinstance(packet, Puback):
            self.outbox.on_puback(packet)
        elif isinstance(packet, Pubrec):
            self.outbox.on_pubrec(packet)
        elif isinstance(packet, Pubrel):
            self.inbox.on_pubrel(packet)
        elif isinstance(packet, Pubcomp):
            self.outbox.on_pubcomp(packet)
        elif isinstance(packet, Suback | Unsuback):
            self.outbox.on_suback(packet)
        elif isinstance(packet, Pingresp):
            self._on_pingresp()
        else:
            self.wrong("protocol", f"received {packet}")

    def identify(self, packet: Publish) -> Message | None:
        """The model's message; overridden by who receives what is not in the model."""
        assert self.session is not None
        return self.model.identify(self.session, packet)

    def _on_pingresp(self) -> None:
        if not self._pings:
            self.wrong("protocol", "PINGRESP without PINGREQ")
            return
        ping = self._pings.popleft()
        assert self.wire is not None
        if ping.pauses == self.wire.pauses:
            self.round_trips.append(self.model.clock() - ping.sent_at)
        # The broker has read what was sent before: from here on none of it may be repeated.
        self.inbox.confirm(ping.acknowledged)
        for message in ping.messages:
            self.model.closed(message, "PINGRESP")

    def spring(self, stage: str) -> bool:
        """The trap, when the protocol has come to it; whether the client is gone at once."""
        if self.trap != stage:
            return False
        self.trap = None
        self.model.counts[f"cut: {stage}"] += 1
        if stage.endswith("received"):
            self.cut(f"cuts: {stage}", reset=self.random.random() < 0.7)
            return True
        self._cut_soon(f"cuts: {stage}")
        return False
