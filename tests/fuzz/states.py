"""The state table: packets in any order, from many clients, against a broker in this process.

After each step what must hold is looked at, and in all that time a client of another user keeps
what it has, whatever the others do.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from broker.conftest import FakeAccess, FakeStore, Peer, check_accounts
from codec import Found
from inputs import CLIENTS_OWN, METHOD, Source, damage

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits
from appliance.broker.session import Session
from appliance.broker.values import Accepted, Action, Refusal
from appliance.mqtt.codec import PacketType, Property
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Packet,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
)
from appliance.mqtt.reason import ReasonCode

#: Small, so that all of them are reached.
LIMITS = Limits(
    packet_size=200_000,
    memory=60_000,
    queue_messages=8,
    queue_bytes=20_000,
    inflight=4,
    subscriptions=12,
    topic_levels=20,
    retained_messages=10,
    retained_bytes=20_000,
    sessions=12,
    session_expiry=1000,
)

KINDS = (*CLIENTS_OWN, *(PacketType.PUBLISH, PacketType.SUBSCRIBE) * 3)
CLIENT_IDS = ("a", "b", "c", "d", "", "victim")  # the last is not theirs to have
STEPS = 60


#: What may be brought to its end by an acknowledgement.
_DONE_BY: dict[type, tuple[str, ...]] = {
    Puback: ("QoS 1",),
    Pubrec: ("QoS 2",),  # with a code that refuses the message
    Pubcomp: ("PUBREC was said", "PUBREL came"),
}


@dataclass
class Known:
    """A client, and what it knows of the messages that it was sent."""

    number: int
    peer: Peer
    user: str
    connected: bool = False
    lost: bool = False
    #: Whether what it has said is known.
    predictable: bool = True
    #: Sent by the server with QoS 1 or 2 on this connection and not acknowledged to the end.
    open_ids: dict[int, str] = field(default_factory=dict)

    @property
    def closed(self) -> bool:
        return self.lost or self.peer.transport.closed

    def has_said(self, packet: Packet) -> None:
        """Take in what the packet means for the messages that it was sent."""
        if not isinstance(packet, Puback | Pubrec | Pubcomp):
            return
        stage = self.open_ids.get(packet.packet_id)
        if isinstance(packet, Pubrec) and packet.reason_code < 0x80:
            if stage == "QoS 2":
                self.open_ids[packet.packet_id] = "PUBREC was said"
        elif stage in _DONE_BY[type(packet)]:
            del self.open_ids[packet.packet_id]


class Riddle:
    """An enhanced authentication that ends sooner or later, one way or the other."""

    def __init__(self, rng: random.Random, user: str) -> None:
        self._rng = rng
        self._user = user

    def step(self, data: bytes) -> bytes | Accepted | Refusal:
        outcome = self._rng.random()
        if outcome < 0.4:
            return b"and now?"
        if outcome < 0.9:
            return Accepted(self._user, b"welcome")
        return Refusal(ReasonCode.NOT_AUTHORIZED, "wrong answer")


class World:
    """A broker, its clients, and the one that is left alone."""

    def __init__(self, rng: random.Random, policy: str) -> None:
        self.rng = rng
        self.source = Source(rng)
        self.access = FakeAccess()
        self.store = FakeStore()
        limits = Limits(**{name: getattr(LIMITS, name) for name in Limits.__slots__})
        object.__setattr__(limits, "queue_full", policy)
        self.broker = Broker(self.access, self.store, limits)
        self.broker.tick(1000.0)
        self.access.deny("mallory", Action.PUBLISH, "fuzz/c/#")
        self.clients: list[Known] = []
        self.came = 0
        #: What was said, for who looks into a failure.
        self.said: list[str] = []
        self.victim = Peer(self.broker, 5)
        self.victim.connect("victim", user="victim", clean=False, **_KEPT)
        self.victim.subscribe("safe/#", 2)
        self.victim.subscribe("safe/held/#", 1)
        self.victim.send(Publish("safe/held/x", b"kept", 2, packet_id=77))
        self.victim.send(Publish("safe/echo", b"unacknowledged", 1, packet_id=78))
        self.victim.received()

    def step(self) -> None:
        """Something happens. Raises Found, with what was said until then."""
        before = _snapshot(self.victim.session)
        try:
            self._happen()
            self._look()
            after = _snapshot(self.victim.session)
            assert after == before, f"the other client had {before}, and has {after}"
        except Exception as error:
            raise Found(f"{error!r}", "\n".join(self.said).encode()) from error

    def _happen(self) -> None:
        rng = self.rng
        there = [client for client in self.clients if not client.closed]
        if not there or (len(there) < 6 and rng.random() < 0.15):
            self.clients = [*there, self._come()]
            return
        client = rng.choice(there)
        peer = client.peer
        what = rng.random()
        if what < 0.02:
            self._note(client, "is lost")
            peer.lose()
            client.lost = True
        elif what < 0.06:
            self._note(client, "is slow")
            peer.slow()
        elif what < 0.12:
            self._note(client, "is fast again")
            if not client.closed:
                peer.fast()
        elif what < 0.16:
            now = self.broker.now + rng.choice((0.1, 1, 2, 100))
            self._note(None, f"it is {now:g}")
            self.broker.tick(now)
        elif what < 0.18 and not self.store.holding:
            self._note(None, "the store takes its time")
            self.store.holding = True
        elif what < 0.3 and self.store.holding:
            kept = rng.random() < 0.9
            self._note(None, f"the store has committed: {kept}")
            self.store.commit(kept)
        elif what < 0.31:
            self._note(None, "the rules have changed")
            self.access.epoch += 1
            self.broker.rules_changed()
        elif what < 0.33:
            for _ in range(peer.transport.laters):
                peer.transport.laters -= 1
                peer.client.output.resume_writing()
            self.broker.flush()
        elif client.open_ids and what < 0.6:
            self._answer(client)
        else:
            self._say(client)

    def _come(self) -> Known:
        rng = self.rng
        version = rng.choice((4, 5))
        self.came += 1
        user = rng.choice(("mallory", "trudy"))
        client = Known(self.came, Peer(self.broker, version), user)
        client.peer.transport.exchanges[METHOD] = Riddle(rng, client.user)
        if rng.random() < 0.1:
            self._note(client, "says nothing right")
            client.peer.send(damage(rng, self.source.packet(version).encode(version)))
            return client
        packet = self.source.connect(version, rng.choice(CLIENT_IDS), client.user, b"secret")
        client.peer.user = client.user
        if packet.properties and Property.AUTHENTICATION_METHOD in packet.properties:
            packet.properties[Property.AUTHENTICATION_METHOD] = METHOD
        self._note(client, f"{packet} {packet.will} {packet.properties}")
        wire = packet.encode()
        if rng.random() < 0.2:  # what comes behind CONNECT waits for the login
            wire += self.source.packet(version, KINDS).encode(version)
        client.peer.send(wire)
        if client.peer.transport.asked is not None:
            decision = rng.random()
            if decision < 0.1:
                client.peer.client.refuse(ReasonCode.NOT_AUTHORIZED, "the test says so")
                self.broker.flush()
            elif decision < 0.95:
                client.peer.let_in()
        return client

    def _say(self, client: Known) -> None:
        rng = self.rng
        version = client.peer.version
        packets = [self.source.packet(version, KINDS) for _ in range(rng.choice((1, 1, 2, 4)))]
        if rng.random() < 0.02:
            packets.append(self.source.packet(version, list(PacketType)[:14]))
        packets = [one for one in packets if not (_ends(one) and rng.random() < 0.8)]
        wire = b"".join(packet.encode(version) for packet in packets)
        for packet in packets:
            client.has_said(packet)
        if rng.random() < 0.03:
            wire = damage(rng, wire)
            client.predictable = False
        self._note(client, f"{' '.join(map(str, packets))} = {wire.hex()[:2000]}")
        client.peer.send(wire)

    def _answer(self, client: Known) -> None:
        """What a client that keeps to the protocol says next."""
        packet_id = self.rng.choice(list(client.open_ids))
        answers = {"QoS 1": Puback, "QoS 2": Pubrec, "PUBREL came": Pubcomp}
        answer = answers.get(client.open_ids[packet_id])
        if answer is not None:
            packet = answer(packet_id)
            self._note(client, str(packet))
            client.has_said(packet)
            client.peer.send(packet)

    def _look(self) -> None:
        broker = self.broker
        check_accounts(broker)
        assert not broker.faults.count, (
            broker.faults.last
        )  # what was contained is found all the same
        limits = broker.limits
        # What there was room for at its PUBREC is delivered though there is none left at PUBREL.
        assert broker.accounting.queued_bytes <= 2 * limits.memory
        assert broker.retained.bytes <= limits.retained_bytes
        assert len(broker.sessions) <= limits.sessions
        for session in broker.sessions.values():
            assert len(session.queue) <= limits.queue_messages + 6 * limits.inflight, session
            assert len(session.subscriptions) <= limits.subscriptions, session
            assert session.link is not None or session.ends_at is not None, f"{session} for ever"
        connected = {
            session.link for session in broker.sessions.values() if session.link is not None
        }
        assert {client.output for client in broker.clients} == connected, (
            "who is connected has a session, and the other way round"
        )
        filters = [name for session in broker.sessions.values() for name in session.subscriptions]
        shared = {name for name in filters if name.startswith("$share/")}
        alone = sum(1 for name in filters if name not in shared)
        assert broker.subscription_count == alone + len(shared)
        for client in self.clients:
            self._hear(client)

    def _hear(self, client: Known) -> None:
        """What came is right: packets that may come, ids that are free, and no more than wanted."""
        for packet in client.peer.received():
            if isinstance(packet, Connack):
                assert not client.connected, "CONNACK twice"
                client.connected = not packet.reason_code
                continue
            if isinstance(packet, Auth):
                continue
            assert client.connected or client.closed, f"{packet} before CONNACK"
            if isinstance(packet, Publish) and packet.qos:
                assert packet.packet_id is not None
                if client.predictable:
                    assert packet.packet_id not in client.open_ids, f"{packet}: its id is in use"
                client.open_ids[packet.packet_id] = f"QoS {packet.qos}"
            elif isinstance(packet, Pubrel) and packet.packet_id in client.open_ids:
                client.open_ids[packet.packet_id] = "PUBREL came"

    def last(self) -> None:
        """Behind all that the victim is served as ever."""
        self._note(None, "the end")
        try:
            self.store.commit()
            for client in self.clients:
                if not client.closed:
                    client.peer.lose()
            self.victim.drain()
            self.victim.send(Publish("safe/last", b"hello", 1, packet_id=79))
            received = self.victim.received()
            (answer,) = (one for one in received if isinstance(one, Puback))
            heard = [one.payload for one in received if isinstance(one, Publish)]
            # The others may have used up the memory for all; then it is told so.
            if heard or answer.reason_code != ReasonCode.QUOTA_EXCEEDED:
                assert heard == [b"hello"], received
            self._look()
        except Exception as error:
            raise Found(f"at the end: {error!r}", "\n".join(self.said).encode()) from error

    def _note(self, client: Known | None, what: str) -> None:
        name = f"{client.number:2} (v{client.peer.version})" if client else "       "
        self.said.append(f"{name}: {what}")


_KEPT: dict[str, object] = {"properties": {Property.SESSION_EXPIRY_INTERVAL: 900}}


def _ends(packet: Packet) -> bool:
    return packet.TYPE in (PacketType.DISCONNECT, PacketType.AUTH)


def _snapshot(session: Session) -> object:
    return (
        session.link,
        dict(session.subscriptions),
        dict(session.inflight),
        list(session.queue),
        dict(session.received),
        session.bytes,
        session.expiry,
        session.will,
    )


def one_case(rng: random.Random) -> None:
    """A sequence of steps. Raises Found."""
    world = World(rng, rng.choice(("refuse", "drop-oldest", "disconnect")))
    for _ in range(STEPS):
        world.step()
    world.last()
