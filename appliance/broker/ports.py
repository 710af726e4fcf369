"""The broker's ports: Protocols that others implement, and the values passed through them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from appliance.mqtt.codec import quote
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode

if TYPE_CHECKING:
    from appliance.broker.accounts import Account
    from appliance.broker.message import Message
    from appliance.broker.session import Delivery, Session, UnreleasedPublish
    from appliance.mqtt.packets import Connect


class Action(Enum):
    """An operation on a topic that needs permission; for SUBSCRIBE it is on a topic filter."""

    PUBLISH = "publish"
    SUBSCRIBE = "subscribe"
    RECEIVE = "receive"


@dataclass(frozen=True, slots=True)
class Identity:
    """The identity of an authenticated client; `username` is None for an anonymous one."""

    username: str | None
    client_id: str

    def __str__(self) -> str:
        user = "anonymous" if self.username is None else f"user {quote(self.username)}"
        return f"client {quote(self.client_id)} ({user})"


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether an operation is allowed; `reason` names the rule, for the log.

    A `pending` refusal is provisional: it holds until the answer of a plugin arrives.
    """

    allowed: bool
    reason: str
    pending: bool = False

    def __bool__(self) -> bool:
        return self.allowed


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a login is refused: `code` is sent to the client, `reason` is only logged.

    The code must not reveal whether the user exists: it is NOT_AUTHORIZED for a wrong password,
    an unknown user and a missing user name alike, as in mosquitto.
    """

    code: ReasonCode
    reason: str


@dataclass(frozen=True, slots=True)
class Accepted:
    """The success of an enhanced authentication; `data` goes into the last packet to the client."""

    username: str
    data: bytes


class Exchange(Protocol):
    """One enhanced authentication in progress: an exchange of AUTH packets (5.0 section 4.12)."""

    def step(self, data: bytes) -> bytes | Accepted | Refusal:
        """Process the client's data; returns the next challenge or the outcome. Does no I/O."""


class Access(Protocol):
    """The access rules in force. `epoch` is incremented whenever they change."""

    epoch: int

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Decide immediately, without I/O; `topic` is a filter when `action` is SUBSCRIBE."""


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """The state of the connection to a client's computer, as TCP knows it; times in seconds.

    `silence` is the time since anything arrived from that computer, TCP acknowledgements included;
    it is infinity where that is unknown. `has_unread` says that bytes have arrived and are not yet
    processed. `flowing` is for how long the client has sent without a pause. `held` is for how long
    what the client sends now may have waited here because its connection was not read.
    """

    round_trip: float = 0.0
    silence: float = 0.0
    has_unread: bool = False
    flowing: float = 0.0
    held: float = 0.0


#: The status of a peer on this computer: it is alive as long as its connection is open.
LOCAL_PEER = PeerStatus()

#: The arguments of `Access.decide`: a client's identity, the action, and the topic or filter.
AccessQuery: TypeAlias = "tuple[Identity, Action, str]"


class PendingDecisions(Protocol):
    """Access rules that may have to wait for a plugin's answer before they decide."""

    @property
    def timeout(self) -> float:
        """Seconds that a packet waits for a decision."""

    def is_pending(self, question: AccessQuery, wake: Callable[[], None]) -> bool:
        """Whether the decision is outstanding; if so, `wake` is called when it may be known."""


class Link(Protocol):
    """The outgoing side of a session: a network connection, or a part of the appliance.

    `Session.pump` is called when the link becomes writable again.
    """

    #: False while the receiver applies backpressure.
    writable: bool

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Send a PUBLISH; `packet_id` is 0 for QoS 0."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Forward a received QoS 0 PUBLISH unchanged; False if this receiver needs another packet.

        This is the fast path; `publish` always works.
        """

    def pubrel(self, packet_id: int) -> None:
        """Send a PUBREL."""

    def is_behind(self) -> bool:
        """Whether a large QoS 0 message must wait in the session until earlier output is sent.

        `Session.pump` is called when it is.
        """

    def later(self) -> None:
        """Call `Session.pump` again after the other clients have had their turn."""

    def peer_status(self) -> PeerStatus:
        """The state of the connection to the client's computer."""

    def probe(self) -> None:
        """Make the client's computer answer within two seconds, if it is alive."""

    def withhold(self, seconds: float) -> None:
        """Send nothing for this time, not even acknowledgements; 0 ends it."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Send the reason to the client, where the protocol can, and close the connection."""


class InsideLink:
    """The link of a session inside the appliance; it never applies backpressure.

    This class drops all messages, which is enough for a session that only publishes. A session that
    subscribes overrides `publish`, and subscribes with QoS 0 and without retained messages.
    """

    writable = True

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Take a message that matches a subscription."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """Ask for `publish`: inside, messages are taken, not packets."""
        return False

    def pubrel(self, packet_id: int) -> None:
        """Do nothing: QoS 2 is not used inside."""

    def is_behind(self) -> bool:
        """Never: every message is taken immediately."""
        return False

    def later(self) -> None:
        """Do nothing: no retained messages are replayed inside."""

    def peer_status(self) -> PeerStatus:
        """Always alive."""
        return LOCAL_PEER

    def probe(self) -> None:
        """Do nothing: it is in this process."""

    def withhold(self, seconds: float) -> None:
        """Do nothing: nothing is acknowledged."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Do nothing: there is no connection."""

    def rules_changed(self) -> None:
        """The access rules may have changed: subscriptions are neither ended nor granted anew.

        What the session may publish and receive is decided by the new rules already.
        """


class ReceivingLink(InsideLink):
    """Calls `receive` with each message, whether it is a retained one, and the identifiers of the
    subscriptions that it matches."""

    def __init__(self, receive: Callable[[Message, bool, list[int] | None], None]) -> None:
        self._receive = receive

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        """Take a message."""
        self._receive(message, retain, subscription_ids)


class Store(Protocol):
    """Persistence of sessions and retained messages across restarts.

    Each method stages a change. Changes are committed in batches, which are numbered from 1. A
    packet that acknowledges a change is sent only when the change's batch is committed.
    """

    #: True while a change that a packet may depend on is not committed, or while a packet waits
    #: for a batch, whatever that contains.
    staged: bool

    #: True when such a change was staged since this was last set to False.
    fresh: bool

    #: The batch that changes are staged in now, and the last one that is committed.
    batch: int
    committed: int

    #: Bytes of the stored messages, and their limit.
    bytes: int
    size: int

    def listen(self, callback: Callable[[bool], None]) -> None:
        """Call back after each batch: with True when it is committed, with False when that failed.

        A failed batch is retried, together with what is staged meanwhile, until it succeeds. Until
        then `staged` is False although nothing is stored.
        """

    def hurry(self) -> None:
        """Commit soon: packets wait for it."""

    def session_saved(self, session: Session) -> None:
        """The session was created, or its owner, its expiry or its will changed."""

    def session_removed(self, session: Session) -> None:
        """The session ended, with everything that belongs to it."""

    def subscribed(self, session: Session, subscription: Subscription) -> None:
        """A subscription was added or replaced, or its replay of retained messages changed."""

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """A subscription was removed."""

    def retained(self, message: Message, owner: Account) -> None:
        """The message was retained; one with an empty payload deleted its topic's message.

        `owner` is the account of the publisher.
        """

    def queued(self, session: Session, delivery: Delivery) -> None:
        """A QoS 1 or 2 message was queued for the session."""

    def sent(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """A message was sent under that packet id, whether it was queued before or not."""

    def settled(self, session: Session, delivery: Delivery) -> None:
        """A queued or sent message was acknowledged, expired or dropped."""

    def recorded(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """PUBREC arrived for a QoS 2 message: only its PUBREL is left to be sent."""

    def completed(self, session: Session, packet_id: int) -> None:
        """PUBCOMP arrived."""

    def held(self, session: Session, packet_id: int, held: UnreleasedPublish) -> None:
        """A QoS 2 message from the session's client waits for its PUBREL."""

    def unheld(self, session: Session, packet_id: int) -> None:
        """It does not wait any more."""


#: Bytes of records after which a segment is closed. One record may be larger: it is then alone.
SEGMENT_SIZE = 256 * 1024


@dataclass(slots=True, eq=False)
class Segment:
    """Consecutive records of a journal, which are stored and read together.

    Only the journal changes the attributes. Times are the journal's.
    """

    #: Grows in the order of the records, and is not reused in the journal.
    key: int
    #: Records, those included that are settled, and their bytes.
    count: int
    size: int
    #: So many at its beginning are settled.
    done: int
    #: When its first and its last record were appended.
    first_at: float
    last_at: float


class RecordsLostError(Exception):
    """A segment's records were damaged on the disk; it has been reported and removed."""


#: What `Journal.read` calls with the segment's records, or with the reason why there are none.
RecordsRead: TypeAlias = "Callable[[list[bytes] | Exception], None]"


class Journal(Protocol):
    """An append-only queue of records, in the transactions of the store.

    A segment is *held* from `append` or `read` until `release`: the user has its records in memory,
    or sends them. Others may be merged with their neighbours. Then `segments` contains a new
    segment in their place; methods ignore a segment that is not there any more.
    """

    def now(self) -> float:
        """Seconds of the store's clock, which continues through restarts and never jumps back."""

    def segments(self) -> Sequence[Segment]:
        """All segments, the oldest first; a live view. The last one may still grow."""

    def append(self, record: bytes, *, awaited: bool = True) -> Segment:
        """Stage a record; its index is then `count - 1` of the returned segment.

        That is the last one or a new one: a segment ends with its batch, and at `SEGMENT_SIZE`.
        When `awaited` is False, no packet waits for the commit of the record.
        """

    def settle(self, segment: Segment, done: int) -> None:
        """Note that the first `done` records need not be sent again.

        A segment that is settled completely is removed, unless it may still grow. This is committed
        within a second, or with what is committed before that.
        """

    def drop(self, segment: Segment) -> None:
        """Remove the segment, whether it is settled or not."""

    def read(self, segment: Segment, callback: RecordsRead) -> None:
        """Pass all `count` records to the callback, in a later round of the event loop.

        They are read in a thread; what is not committed yet comes from memory. For a segment that
        may still grow, the records of this moment are passed; of one that is not among `segments`
        any more, none. With `RecordsLostError` the segment was removed; after any other exception,
        reading may succeed later. After the store is closed, nothing is called any more.
        """

    def release(self, segment: Segment) -> None:
        """End to hold the segment: its records are only on disk, and are read before they are sent.

        It is a hint which keeps the list of segments short, and changes nothing else.
        """


#: The first byte of a record of `LatestRecords` that is no message, and not to be counted as one.
NO_MESSAGE: Final = b"N"


class LatestRecords(Protocol):
    """Records that are replaced by newer ones, in the transactions of the store.

    They are all read at the start, so that there should be few, of few bytes.
    """

    def load(self) -> list[tuple[int, bytes]]:
        """All keys and records, in the order of their keys."""

    def put(self, key: int | None, record: bytes, *, awaited: bool = True) -> int:
        """Stage the record under that key, or under a new one; returns the key.

        When `awaited` is False, no packet waits for its commit.
        """

    def remove(self, key: int) -> None:
        """Remove the record, within a second; a key that is not there is ignored."""


class SingleRecords(Protocol):
    """Records that are read one by one, in the transactions of the store. Only keys are in memory.

    What they are is to be stored elsewhere, such as in `LatestRecords`.
    """

    def load(self) -> list[int]:
        """The keys of all records, in their order."""

    def put(self, record: bytes, *, awaited: bool = True) -> int:
        """Stage a record; returns its key, a new one.

        When `awaited` is False, no packet waits for its commit.
        """

    def remove(self, key: int) -> None:
        """Remove the record, within a second; a key that is not there is ignored."""

    def read(self, key: int, callback: RecordsRead) -> None:
        """Pass the record, as the only one, to the callback in a later round of the event loop.

        Outcomes are those of `Journal.read`.
        """


class Backlogs(Protocol):
    """The records of the links to other brokers, by the links' names, beside what clients store.

    They do not count in `Store.bytes`; their user has a limit of its own.
    """

    @property
    def failing(self) -> bool:
        """Whether nothing can be stored now: whatever is appended stays in memory until it can."""

    def journal(self, link: str, lane: int) -> Journal:
        """The link's journal of that lane; the same object each time."""

    def latest(self, link: str) -> LatestRecords:
        """The latest records of the link's topics; the same object each time."""

    def single(self, link: str) -> SingleRecords:
        """Records of the link that are read one by one; the same object each time."""

    def aside(self, link: str) -> LatestRecords:
        """The records that the link has set aside; the same object each time."""

    def links(self) -> list[str]:
        """The names of the links of which something is stored, sorted."""

    def forget(self, link: str) -> None:
        """Remove everything of a link; none of its records may be in use."""


@dataclass(frozen=True, slots=True)
class PublishRejection:
    """Why a part of the appliance could not use a message, for the acknowledgement."""

    code: ReasonCode
    reason: str


class PublishGuard(Protocol):
    """A part of the appliance that restricts who may publish to its topic, beside the rules."""

    @property
    def takes_retained(self) -> bool:
        """Whether a retained message is a command for it."""

    def decide(self, session: Session) -> Decision:
        """Whether the session may publish; the decision holds until `Broker.guards_changed`."""

    def announced(self, message: Message, session: Session) -> None:
        """A QoS 2 message has arrived; it will be published at its PUBREL."""

    def inspect(self, message: Message, session: Session) -> PublishRejection | None:
        """Why a QoS 2 message cannot be used, if so: only MQTT 5 can refuse it, and only before
        its PUBREL."""

    def refused(self, session: Session) -> None:
        """A message of the session was refused, by this guard, another one or the access rules."""


class Observer(Protocol):
    """Notified of events in the broker: amqtt's plugins are called from here."""

    def connected(self, session: Session) -> None:
        """A client was authenticated and has its session."""

    def disconnected(self, session: Session) -> None:
        """The client's connection ended."""

    def subscribed(self, session: Session, topic_filter: str, qos: int) -> None:
        """A subscription was granted."""

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """The client unsubscribed."""

    def published(self, session: Session, message: Message) -> None:
        """A client's message was accepted and is about to be delivered."""

    def refused(self, session: Session, message: Message) -> None:
        """A client's message was not allowed and is not delivered."""

    def retained(self, message: Message) -> None:
        """A message was retained, or, with an empty payload, deleted one."""


@dataclass(frozen=True, slots=True)
class TlsInfo:
    """The TLS version of a connection, and the name in the client's certificate; empty for none."""

    version: str = ""
    certificate: str = ""


class Transport(Protocol):
    """The network connection of a `ClientHandler`, as the listeners implement it."""

    #: The client's address, for the log: "127.0.0.1:54321".
    address: str

    def authenticate(self, connect: Connect) -> None:
        """Check the login in the background, then call `ClientHandler.accept` or `.refuse`."""

    def exchange(self, method: str) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered."""

    def now(self) -> float:
        """Seconds of a monotonic clock that is finer than the broker's."""

    def admit(self, account: Account) -> str:
        """Why that user may not log in from this address; empty if it may.

        This ends the time limit for the login.
        """

    def holds(self, size: int) -> None:
        """Note that `size` bytes of partial packets are buffered: even a small chunk may complete
        them, and be costly."""

    def tls_info(self) -> TlsInfo:
        """The TLS version, and the name in the client's certificate."""

    def later(self) -> None:
        """Call `ClientHandler.send_on` in a later turn, after the other clients."""

    def stop_reading(self) -> None:
        """Stop reading until the next `ClientHandler.send_on`."""

    def wait(self, seconds: float) -> None:
        """Call `ClientHandler.send_on` after this time at the latest; keep reading until then."""

    def proceed(self) -> None:
        """The client need not wait any longer: call `ClientHandler.send_on` in a later turn."""

    def write(self, chunks: list[bytes]) -> None:
        """Write the chunks in this order."""

    def is_behind(self) -> bool:
        """Whether written bytes are still buffered here because the network is slow.

        When they have been sent, `Output.caught_up` or `Output.resume_writing` is called.
        """

    def peer_status(self) -> PeerStatus:
        """The state of the connection to the client's computer."""

    def probe(self) -> None:
        """Make that computer answer within two seconds if it is alive."""

    def withhold(self, seconds: float) -> None:
        """Write nothing for so long; with 0, no longer."""

    def close(self) -> None:
        """Write what was written so far, then close."""

    def abort(self) -> None:
        """Close at once; never raises."""


class AuditLog(Protocol):
    """Notified of logins, refusals and ends of connections, for the audit log; not of messages."""

    def connected(self, session: Session, address: str, version: int, tls_info: TlsInfo) -> None:
        """A client logged in, with this version of MQTT."""

    def refused(
        self,
        address: str,
        reason: str,
        code: int = 0,
        client_id: str | None = None,
        username: str | None = None,
        tls_info: TlsInfo | None = None,
    ) -> None:
        """A connection or a login was refused; id and user name are the client's own claims."""

    def denied(self, session: Session, action: Action, topic: str, reason: str) -> None:
        """The access rules denied a PUBLISH or SUBSCRIBE."""

    def disconnected(self, session: Session, address: str, reason: str) -> None:
        """A client's connection ended."""


@dataclass(frozen=True, slots=True)
class Features:
    """Options that the standard leaves to the server's operator; `broker` in appliance.yaml."""

    check_payload_format: bool = False
    reason_strings: bool = False
    #: With %c and %u for the client id and the user name; empty for none.
    response_information: str = ""


#: The prefix of the client ids of sessions inside the appliance; clients may not use it.
INSIDE = "_"

#: The largest packet, in bytes, that is accepted where CONNACK announces no limit.
USUAL_PACKET_SIZE = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class UserLimits:
    """Limits of one user, see `accounts`; None lets a user have more while others leave room."""

    connections: int | None = None
    sessions: int | None = None
    memory: int | None = None
    retained_messages: int | None = None
    retained_bytes: int | None = None
    #: Of `Store.size`.
    stored: int | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of everything that clients can make grow; see `broker.limits` in appliance.yaml."""

    connections: int = 1000
    packet_size: int = USUAL_PACKET_SIZE
    memory: int = 256 * 1024 * 1024
    queue_messages: int = 1000
    queue_bytes: int = 16 * 1024 * 1024
    queue_full: str = "refuse"
    #: QoS 0 messages that are queued for a slow client; 0: only the latest of each topic.
    keep: int = 0
    inflight: int = 20
    subscriptions: int = 1000
    client_id_length: int = 1024
    topic_length: int = 65535
    topic_levels: int = 201
    retained_messages: int = 100_000
    retained_bytes: int = 64 * 1024 * 1024
    session_expiry: int = 7 * 24 * 3600
    topic_alias: int = 10
    user_properties: int = 1000
    keep_alive: int = 65535
    sessions: int = 10_000
    user: UserLimits = UserLimits()
