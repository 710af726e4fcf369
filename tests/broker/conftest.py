"""A broker driven with bytes alone: no network, no event loop, and a clock that is an argument."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping

import pytest

from appliance.broker.accounts import Account
from appliance.broker.broker import Broker
from appliance.broker.client import ClientHandler
from appliance.broker.delivery import Delivery, UnreleasedPublish, held_size
from appliance.broker.limits import USUAL_TERMS, Limits, Terms, UserLimits
from appliance.broker.link import LOCAL_PEER, PeerStatus
from appliance.broker.message import Message
from appliance.broker.ports import Exchange
from appliance.broker.retained import retained_size
from appliance.broker.session import Session, subscription_size
from appliance.broker.values import Action, Decision, Identity, TlsInfo
from appliance.mqtt.codec import Properties, Property, decode_varint
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
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
    Will,
    decode_packet,
)
from appliance.mqtt.reason import ReasonCode
from appliance.mqtt.topics import matches
from appliance.store import MemoryStore

#: For tests of what all have together, with one user.
ALONE = UserLimits(
    memory=1 << 60, retained_messages=1 << 60, retained_bytes=1 << 60, stored=1 << 60
)


class FakeAccess:
    """Allows everything but what was denied: a user, an action and a filter."""

    def __init__(self) -> None:
        self.epoch = 0
        self._denied: set[tuple[str | None, Action, str]] = set()
        self._reader: str | None = None

    def deny(self, user: str | None, action: Action, topic_filter: str) -> None:
        self._denied.add((user, action, topic_filter))
        self.epoch += 1

    def allow_only(self, client_id: str) -> None:
        """A rule by client id: nobody else may receive anything."""
        self._reader = client_id
        self.epoch += 1

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        if action is Action.RECEIVE and self._reader not in (None, identity.client_id):
            return Decision(False, f"only {self._reader} may read")
        for user, denied, topic_filter in self._denied:
            if (user, denied) == (identity.username, action) and matches(topic_filter, topic):
                return Decision(False, f"{user} {action.value} {topic_filter} is denied")
        return Decision(True, "nothing denies it")


class FakeStore(MemoryStore):
    """Knows what is owed to whom, and can hold back its commit.

    With `holding`, what is staged waits for `commit`; else it counts as kept at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self.holding = self._failing = False
        self.sessions: set[str] = set()
        self.subscriptions: dict[tuple[str, str], int] = {}
        self.kept: dict[str, bytes] = {}
        self.owed: Counter[tuple[str, Message]] = Counter()
        self._known: set[tuple[str, int]] = set()

    def listen(self, callback: Callable[[bool], None]) -> None:
        self._tell = callback

    def _stage(self) -> None:
        if self.holding:
            self.fresh = True
            self.staged = not self._failing

    def commit(self, kept: bool = True) -> None:
        """The end of a batch; what is staged from now on is kept at once, unless it failed."""
        self.staged = False
        self.holding = self._failing = not kept
        if kept:
            self.committed = self.batch
        self.batch += 1
        self._tell(kept)

    def session_saved(self, session: Session) -> None:
        if session.persistent:
            self._stage()
            self.sessions.add(session.client_id)
        else:
            self.session_removed(session)

    def session_removed(self, session: Session) -> None:
        self.sessions.discard(session.client_id)
        self._known = {key for key in self._known if key[0] != session.client_id}
        for kept in (self.owed, self.subscriptions):
            for key in [key for key in kept if key[0] == session.client_id]:
                del kept[key]

    def subscribed(self, session: Session, subscription: Subscription) -> None:
        self._stage()
        self.subscriptions[session.client_id, subscription.filter] = subscription.qos

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        del self.subscriptions[session.client_id, topic_filter]

    def retained(self, message: Message, owner: Account) -> None:
        self._stage()
        self.kept[message.topic] = message.payload
        if not message.payload:
            del self.kept[message.topic]

    def queued(self, session: Session, delivery: Delivery) -> None:
        self._stage()
        key = session.client_id, id(delivery)
        assert key not in self._known
        self._known.add(key)
        self.owed[session.client_id, delivery[0]] += 1

    def sent(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        self._stage()
        if (session.client_id, id(delivery)) not in self._known:
            self.queued(session, delivery)

    def recorded(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        self._stage()
        self.settled(session, delivery)

    def held(self, session: Session, packet_id: int, held: UnreleasedPublish) -> None:
        self._stage()

    def unheld(self, session: Session, packet_id: int) -> None:
        self._stage()

    def settled(self, session: Session, delivery: Delivery) -> None:
        self._known.remove((session.client_id, id(delivery)))
        message = delivery[0]
        self.owed[session.client_id, message] -= 1
        if not self.owed[session.client_id, message]:
            del self.owed[session.client_id, message]


class FakeTransport:
    """A connection that takes everything; the test answers `authenticate`."""

    address = "192.0.2.1:40000"

    def __init__(self) -> None:
        self.asked: Connect | None = None
        self.written = bytearray()
        self.closed = False
        #: What `exchange` gives, by method, once each.
        self.exchanges: dict[str, Exchange] = {}
        #: Turns of the loop that were asked for and have not come.
        self.laters = 0
        #: Whether the network takes no more; then `caught_up` is the client's to be called.
        self.behind = False
        #: Whether it is not read until its next turn, and for how long it waits for that at most.
        self.stopped = False
        self.waits: float | None = None
        #: Bytes of it that are counted, as it was told.
        self.held = 0

    def authenticate(self, connect: Connect) -> None:
        self.asked = connect

    def exchange(self, method: str) -> Exchange | None:
        return self.exchanges.pop(method, None)

    def now(self) -> float:
        return 0.0

    def admit(self, account: Account) -> str:
        assert not self.closed
        return ""

    def tls_info(self) -> TlsInfo:
        return TlsInfo()

    def holds(self, size: int) -> None:
        self.held = size

    def is_behind(self) -> bool:
        return self.behind

    def later(self) -> None:
        self.laters += 1

    def peer_status(self) -> PeerStatus:
        return LOCAL_PEER

    def probe(self) -> None:
        pass

    def withhold(self, seconds: float) -> None:
        pass

    def stop_reading(self) -> None:
        self.stopped = True

    def wait(self, seconds: float) -> None:
        self.waits = seconds

    def proceed(self) -> None:
        self.laters += 1
        self.waits = None

    def write(self, chunks: list[bytes]) -> None:
        assert not self.closed, "written to after the close"
        self.written += b"".join(chunks)

    def close(self) -> None:
        self.closed = True

    abort = close


class Peer:
    """The client at the other end: says packets, and hears the packets that come back."""

    def __init__(self, broker: Broker, version: int = 5, terms: Terms = USUAL_TERMS) -> None:
        self.broker = broker
        self.version = version
        self.transport = FakeTransport()
        self.client = ClientHandler(broker, self.transport, terms)
        self._packet_id = 0

    @property
    def session(self) -> Session:
        assert self.client.session is not None
        return self.client.session

    def send(self, *packets: Packet | bytes) -> None:
        """All of them in one chunk."""
        self.client.receive(
            b"".join(p if isinstance(p, bytes) else p.encode(self.version) for p in packets)
        )
        self.broker.flush()

    def go_on(self) -> None:
        """Take the turn that was asked for, or is due."""
        self.transport.laters = 0
        self.transport.stopped = False
        self.client.send_on()
        self.broker.flush()

    def wait(self) -> None:
        """Let the time pass that what it published waits for its readers at most."""
        while self.transport.waits is not None:
            self.broker.accounting.now += self.transport.waits
            self.transport.waits = None
            self.go_on()

    def received(self) -> list[Packet]:
        """The packets that came since this was last asked."""
        return list(self._take())

    def _take(self) -> Iterator[Packet]:
        data = bytes(self.transport.written)
        self.transport.written.clear()
        pos = 0
        while pos < len(data):
            length, body = decode_varint(data, pos + 1)
            assert body + length <= len(data), "half a packet was written"
            yield decode_packet(data[pos], data[body : body + length], self.version)
            pos = body + length

    def only(self, kind: type[Packet]) -> Packet:
        """The one packet that came, which is of this kind."""
        (packet,) = self.received()
        assert type(packet) is kind, packet
        return packet

    def messages(self) -> list[Publish]:
        """The PUBLISH packets that came; nothing else did."""
        packets = self.received()
        assert all(isinstance(packet, Publish) for packet in packets), packets
        return packets  # type: ignore[return-value]

    def payloads(self) -> list[bytes]:
        return [message.payload for message in self.messages()]

    def next_id(self) -> int:
        self._packet_id = self._packet_id % 65535 + 1
        return self._packet_id

    # --- whole exchanges ------------------------------------------------------------------------

    def say_connect(
        self,
        client_id: str = "client",
        *,
        clean: bool = True,
        keep_alive: int = 0,
        user: str | None = "user",
        will: Will | None = None,
        properties: Properties | None = None,
    ) -> None:
        """CONNECT, without an answer to the question who it is."""
        self.user = user
        self.send(
            Connect(
                client_id,
                clean,
                keep_alive,
                self.version,
                user,
                b"secret" if user is not None else None,
                will,
                properties,
            )
        )

    def let_in(self) -> None:
        """The password was right."""
        self.client.accept(self.user)
        self.broker.flush()

    def connect(self, client_id: str = "client", **options: object) -> Connack:
        """CONNECT with the right password, and the CONNACK; what comes behind it stays unread."""
        self.say_connect(client_id, **options)  # type: ignore[arg-type]
        self.let_in()
        first, *rest = self._take()
        for packet in rest:
            self.transport.written += packet.encode(self.version)
        assert isinstance(first, Connack)
        return first

    def subscribe(
        self,
        topic_filter: str,
        qos: int = 0,
        *,
        properties: Properties | None = None,
        **options: int,
    ) -> int:
        """SUBSCRIBE to one filter; returns the code in the SUBACK, what is behind it is unread."""
        packet_id = self.next_id()
        subscription = Subscription(topic_filter, qos, **options)  # type: ignore[arg-type]
        self.send(Subscribe(packet_id, [subscription], properties))
        packets = self.received()
        (answer,) = (packet for packet in packets if isinstance(packet, Suback))
        for packet in packets:
            if packet is not answer:
                self.transport.written += packet.encode(self.version)
        assert answer.packet_id == packet_id  # v5 [MQTT-3.8.4-2]
        (code,) = answer.reason_codes
        return code

    def unsubscribe(self, *filters: str) -> Unsuback:
        self.send(Unsubscribe(self.next_id(), filters))
        packet = self.only(Unsuback)
        assert isinstance(packet, Unsuback)
        return packet

    def publish(
        self,
        topic: str,
        payload: bytes = b"payload",
        qos: int = 0,
        *,
        retain: bool = False,
        properties: Properties | None = None,
    ) -> int:
        """PUBLISH, and the exchange that its QoS asks for; returns the code of the answer."""
        packet_id = self.next_id() if qos else None
        self.send(Publish(topic, payload, qos, retain, False, packet_id, properties))
        self.wait()
        if not qos:
            return 0
        answers = [p for p in self.received() if isinstance(p, Puback | Pubrec) or self._keep(p)]
        (answer,) = answers
        assert type(answer) is (Puback if qos == 1 else Pubrec)
        assert answer.packet_id == packet_id
        if qos == 2 and answer.reason_code < 0x80:
            assert packet_id is not None
            self.send(Pubrel(packet_id))
            (done,) = [p for p in self.received() if isinstance(p, Pubcomp) or self._keep(p)]
            assert done.packet_id == packet_id
        return answer.reason_code

    def _keep(self, packet: Packet) -> bool:
        self.transport.written += packet.encode(self.version)
        return False

    def acknowledge(self, *packets: Packet) -> None:
        """Answer QoS 1 and 2 messages to the end of their exchange."""
        for packet in packets:
            if not isinstance(packet, Publish) or packet.packet_id is None:
                continue
            if packet.qos == 1:
                self.send(Puback(packet.packet_id))
            else:
                self.send(Pubrec(packet.packet_id))
                (answer,) = [p for p in self.received() if isinstance(p, Pubrel) or self._keep(p)]
                assert answer.packet_id == packet.packet_id
                self.send(Pubcomp(packet.packet_id))

    def drain(self) -> list[Publish]:
        """Read and acknowledge until nothing more comes; returns the messages."""
        messages: list[Publish] = []
        while packets := self.messages():
            messages += packets
            self.acknowledge(*packets)
        return messages

    def lose(self) -> None:
        """The network is gone."""
        self.client.lost()
        self.broker.flush()

    def disconnect(self, code: int = 0, properties: Properties | None = None) -> None:
        self.send(Disconnect(code, properties))
        assert self.transport.closed

    def slow(self) -> None:
        """The network takes nothing more."""
        self.client.output.writable = False

    def fast(self) -> None:
        """The network takes bytes again."""
        self.client.output.resume_writing()
        self.broker.flush()

    def farewell(self) -> ReasonCode:
        """The connection was closed, and what the DISCONNECT (5.0) said."""
        assert self.transport.closed
        packets = self.received()
        assert isinstance(packets[-1], Disconnect), packets
        return ReasonCode(packets[-1].reason_code)


def lasting(version: int, seconds: int = 3600) -> dict[str, object]:
    """Options of a CONNECT whose session outlives the connection."""
    if version == 5:
        return {"clean": False, "properties": {Property.SESSION_EXPIRY_INTERVAL: seconds}}
    return {"clean": False}


def drops(broker: Broker) -> dict[str, int]:
    """How many messages were dropped, by why."""
    return {reason: count for reason, count in broker.counters.dropped.items() if count}


def waiting_bytes(broker: Broker) -> int:
    """What the broker has counted for messages that wait: subscriptions and wills not among it."""
    rest = sum(
        sum(map(subscription_size, session.subscriptions))
        + (session.will.message.size if session.will is not None else 0)
        for session in broker.sessions.values()
    )
    return broker.accounting.queued_bytes - rest - broker.accounting.input_bytes


def held_bytes(session: Session) -> int:
    """All that the session holds, counted anew."""
    waiting = [delivery[0] for delivery in (*session.queue, *session.latest.values())]
    waiting += [delivery[0] for delivery in session.large.values()]
    waiting += [delivery[0] for delivery in session.inflight.values() if delivery is not None]
    if session.will is not None:
        waiting.append(session.will.message)
    rest = sum(map(subscription_size, session.subscriptions))
    rest += sum(held_size(held) for held in session.received.values())
    rest += sum(limit.size for limit in session.rate_limits.values())
    return sum(message.size for message in waiting) + rest


def check_accounts(
    broker: Broker, *, wires: int = 0, wires_of: Mapping[Account, int] | None = None
) -> None:
    """The sums that the broker keeps are those of what it holds.

    `wires` are the bytes that connections hold: of all, and as they are counted for each user.
    """
    total = 0
    for session in broker.sessions.values():
        assert session.bytes == held_bytes(session), session
        assert session.queue_bytes == sum(each[0].size for each in session.queue), session
        topic_bytes = sum(limit.topic_bytes for limit in session.rate_limits.values())
        assert session.topic_bytes == topic_bytes, session
        total += session.bytes + topic_bytes
    assert broker.accounting.queued_bytes == total + broker.accounting.input_bytes + wires
    retained = [message for _, message in broker.retained.find("#")]
    retained += [message for _, message in broker.retained.find("$SYS/#")]
    assert broker.retained.bytes == sum(retained_size(message) for message in retained)
    check_users(broker, retained, wires_of or {})


def check_users(broker: Broker, retained: list[Message], wires_of: Mapping[Account, int]) -> None:
    """And each user's part of them is what that user holds."""
    accounts = broker.accounting.accounts
    sessions, queued, kept = Counter[Account](), Counter(wires_of), Counter[Account]()
    topics = Counter[Account]()
    for session in broker.sessions.values():
        account = accounts.inside if session.is_inside else accounts.of(session.identity)
        assert session.account is account
        queued[account] += session.bytes + session.topic_bytes
        topics[account] += session.topic_bytes
        if not account.is_inside:
            assert (session in account.present) is (session.link is not None), session
            assert (session in account.absent) is (session.link is None), session
            sessions[account] += 1
    for client in broker.clients:
        assert isinstance(client, ClientHandler)
        queued[client.account] += client._held
    for message in retained:
        owner = broker.retained.owner(message.topic)
        kept[owner] += 1
        queued[owner] += 0
    users = {account for account in queued if not account.is_inside}
    for account in users | {accounts.inside}:
        if account is not accounts.strangers:
            assert account.bytes == queued[account], account
        assert account.topic_bytes == topics[account], account
        assert account.retained == kept[account], account
        if not account.is_inside:
            assert account.sessions == sessions[account], account
    assert accounts.sessions == sum(account.sessions for account in users)
    assert accounts.connections == sum(account.connections for account in users)
    assert accounts.retained == sum(account.retained for account in users)
    assert accounts.retained_bytes == sum(account.retained_bytes for account in users)
    owned = accounts.retained_bytes + accounts.inside.retained_bytes
    assert owned == broker.retained.bytes


@pytest.fixture
def access() -> FakeAccess:
    return FakeAccess()


@pytest.fixture
def store() -> FakeStore:
    return FakeStore()


@pytest.fixture
def limits() -> Limits:
    """The defaults; a test that needs others parametrizes this."""
    return Limits()


@pytest.fixture
def broker(access: FakeAccess, store: FakeStore, limits: Limits) -> Iterator[Broker]:
    """A broker whose accounts are checked at the end of every test."""
    broker = Broker(access, store, limits)
    broker.tick(1000.0)
    yield broker
    check_accounts(broker)
    for session in list(broker.sessions.values()):
        if session.link is not None and not session.is_inside:
            session.close_link(ReasonCode.ADMINISTRATIVE_ACTION, "")
    broker.tick(broker.now + 2 * broker.limits.session_expiry + 1)
    check_accounts(broker)
    if all(session.is_inside for session in broker.sessions.values()):
        assert broker.accounting.queued_bytes == broker.accounting.input_bytes


@pytest.fixture(params=[4, 5], ids=["3.1.1", "5.0"])
def version(request: pytest.FixtureRequest) -> int:
    return request.param  # type: ignore[no-any-return]


Join = Callable[..., Peer]


@pytest.fixture
def join(broker: Broker) -> Join:
    """Makes a connected client: `join("id", version=4, user=…, clean=…)`."""

    def join(client_id: str = "client", *, version: int = 5, **options: object) -> Peer:
        peer = Peer(broker, version)
        assert peer.connect(client_id, **options).reason_code == ReasonCode.SUCCESS
        return peer

    return join
