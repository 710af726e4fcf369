"""What the broker needs from outside, as Protocols, and the values that cross the border."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Protocol, TypeAlias

from appliance.mqtt.codec import quote
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode

if TYPE_CHECKING:
    from appliance.broker.accounts import Account
    from appliance.broker.message import Message
    from appliance.broker.session import Delivery, Session, UnreleasedPublish
    from appliance.mqtt.packets import Connect


class Action(Enum):
    """What a client wants to do with a topic, or, for SUBSCRIBE, with a topic filter."""

    PUBLISH = "publish"
    SUBSCRIBE = "subscribe"
    RECEIVE = "receive"


@dataclass(frozen=True, slots=True)
class Identity:
    """Who an authenticated client is; `username` is None for an anonymous one."""

    username: str | None
    client_id: str

    def __str__(self) -> str:
        user = "anonymous" if self.username is None else f"user {quote(self.username)}"
        return f"client {quote(self.client_id)} ({user})"


@dataclass(frozen=True, slots=True)
class Decision:
    """Whether something is allowed; `reason` names the rule, for the log.

    A refusal that is `pending` holds only until those who decide have answered.
    """

    allowed: bool
    reason: str
    pending: bool = False

    def __bool__(self) -> bool:
        return self.allowed


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a client does not come in: `code` for the client, `reason` only for the log.

    The client is not told whether the user exists, so its code is NOT_AUTHORIZED for a wrong
    password, an unknown user and none at all, as mosquitto does.
    """

    code: ReasonCode
    reason: str


@dataclass(frozen=True, slots=True)
class Accepted:
    """An enhanced authentication succeeded; `data` is the last that the client is sent."""

    username: str
    data: bytes


class Exchange(Protocol):
    """One enhanced authentication under way (5.0 section 4.12): AUTH packets to and fro."""

    def step(self, data: bytes) -> bytes | Accepted | Refusal:
        """Take what the client sent; returns the next challenge, or how it ended. No I/O."""


class Access(Protocol):
    """The access rules in force. `epoch` grows by one whenever they change."""

    epoch: int

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Decide at once, without I/O; `topic` is a filter when `action` is SUBSCRIBE."""


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """How a client's computer answers, whatever the client says; times in seconds.

    `silence` is how long nothing has come from it, not even an acknowledgement of the network's;
    infinity where that cannot be known. `has_unread`: bytes have come that were not looked at yet.
    `flowing` is for how long it has sent without a pause, `held` for how long what it sends now may
    have waited in here, as it was not read.
    """

    round_trip: float = 0.0
    silence: float = 0.0
    has_unread: bool = False
    flowing: float = 0.0
    held: float = 0.0


#: What is on this computer is there as long as its connection is.
LOCAL_PEER = PeerStatus()

#: A client's identity, what it wants to do, and the topic or filter: what rules are asked.
AccessQuery: TypeAlias = "tuple[Identity, Action, str]"


class PendingDecisions(Protocol):
    """Those who may have to ask somebody else before they decide."""

    @property
    def timeout(self) -> float:
        """For how many seconds a packet waits for them."""

    def is_pending(self, question: AccessQuery, wake: Callable[[], None]) -> bool:
        """Whether there is no answer yet; `wake` is then called when there may be one."""


class Link(Protocol):
    """The way to the client of a session: a network connection, or the bridge."""

    #: False while the other side takes nothing more; `Session.pump` is called when it does again.
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
        """Send a QoS 0 PUBLISH as it came in; False, and nothing sent, when it cannot stay so.

        The short cut of the data path; `publish` is the way that always works.
        """

    def pubrel(self, packet_id: int) -> None:
        """Send a PUBREL."""

    def is_behind(self) -> bool:
        """Whether a large message of QoS 0 has to wait in the session, as what was sent before has
        not gone out; `Session.pump` is called when it has."""

    def later(self) -> None:
        """Call `Session.pump` once more when the other clients have had their turn."""

    def peer_status(self) -> PeerStatus:
        """How the client's computer answers."""

    def probe(self) -> None:
        """Have the client's computer answer, within two seconds, if it can: `peer_status` tells."""

    def withhold(self, seconds: float) -> None:
        """Let nothing out for so long, acknowledgements included; with 0, no longer."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """Tell the client why, where the protocol can, and end the connection."""


class InsideLink:
    """The link of a session that a part of the appliance has: it takes everything at once.

    As it is it takes nothing, which is enough for who only publishes. Whoever subscribes overrides
    `publish`, and does so with QoS 0 and without asking for retained messages.
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
        """A message that was subscribed to."""

    def mirror(self, packet: bytes, version: int, payload_size: int) -> bool:
        """It takes messages, not packets."""
        return False

    def pubrel(self, packet_id: int) -> None:
        """It has no QoS 2."""

    def is_behind(self) -> bool:
        """It takes everything at once."""
        return False

    def later(self) -> None:
        """It has no retained messages to go on with."""

    def peer_status(self) -> PeerStatus:
        """It is here."""
        return LOCAL_PEER

    def probe(self) -> None:
        """It is here."""

    def withhold(self, seconds: float) -> None:
        """Nothing is acknowledged."""

    def close(self, reason: ReasonCode, message: str) -> None:
        """There is no connection to close."""


class Store(Protocol):
    """Keeps sessions and retained messages through a restart.

    Each method stages a change. Changes are committed in batches, which are numbered from 1 on.
    What depends on a change is sent only when its batch is committed.
    """

    #: True while there are changes that something may depend on, and that are not committed, or
    #: somebody waits for a batch, whatever is in it.
    staged: bool

    #: True when such a change was staged since this was last set to False.
    fresh: bool

    #: The batch that changes go into now, and the last one that is committed.
    batch: int
    committed: int

    #: Bytes of the messages that are kept, and the most that these may be.
    bytes: int
    size: int

    def listen(self, callback: Callable[[bool], None]) -> None:
        """Call back whenever a batch is done with: with True when it is kept.

        With False when it could not be: then it is tried again, with all that is staged meanwhile,
        for as long as it takes, and `staged` is False until that succeeds, though nothing is kept.
        """

    def hurry(self) -> None:
        """Commit soon: somebody waits."""

    def session_saved(self, session: Session) -> None:
        """The session was made, or its owner, its expiry or its will changed."""

    def session_removed(self, session: Session) -> None:
        """The session and all that belongs to it ended."""

    def subscribed(self, session: Session, subscription: Subscription) -> None:
        """The session subscribed, or anew, or its `replays` of that filter begin or end."""

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """The session unsubscribed."""

    def retained(self, message: Message, owner: Account) -> None:
        """The message is its topic's retained message now; an empty payload deletes it.

        `owner` is whose client has published it.
        """

    def queued(self, session: Session, delivery: Delivery) -> None:
        """A QoS 1 or 2 message is owed to the session, and waits."""

    def sent(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """A message is on its way under that packet id, whether it was queued before or not."""

    def settled(self, session: Session, delivery: Delivery) -> None:
        """A message that was owed is acknowledged, expired or dropped."""

    def recorded(self, session: Session, delivery: Delivery, packet_id: int) -> None:
        """PUBREC came for a QoS 2 message: PUBREL is all that is left of it."""

    def completed(self, session: Session, packet_id: int) -> None:
        """PUBCOMP came."""

    def held(self, session: Session, packet_id: int, held: UnreleasedPublish) -> None:
        """A QoS 2 message of the session's client waits for its PUBREL."""

    def unheld(self, session: Session, packet_id: int) -> None:
        """It does not any more."""


@dataclass(frozen=True, slots=True)
class PublishRejection:
    """Why a part of the appliance could not use a message, as its publisher is told."""

    code: ReasonCode
    reason: str


class PublishGuard(Protocol):
    """A part of the appliance that has a say in who publishes to its topic."""

    def decide(self, session: Session) -> Decision:
        """Whether the session may; it holds until `Broker.guards_changed`."""

    def announced(self, message: Message, session: Session) -> None:
        """A QoS 2 message has come, which will be published with its PUBREL."""

    def inspect(self, message: Message, session: Session) -> PublishRejection | None:
        """What is wrong with a QoS 2 message, which can be refused before its PUBREL only, and in
        MQTT 5 only."""

    def refused(self, session: Session) -> None:
        """A message of the session was refused, by this guard, another or the access rules."""


class Observer(Protocol):
    """Told of what happens in the broker: amqtt's plugins listen here."""

    def connected(self, session: Session) -> None:
        """A client was authenticated and its session is there."""

    def disconnected(self, session: Session) -> None:
        """The client's connection ended."""

    def subscribed(self, session: Session, topic_filter: str, qos: int) -> None:
        """A subscription was granted."""

    def unsubscribed(self, session: Session, topic_filter: str) -> None:
        """A subscription ended on the client's wish."""

    def published(self, session: Session, message: Message) -> None:
        """A client's message was accepted and is about to be delivered."""

    def refused(self, session: Session, message: Message) -> None:
        """A client's message was not allowed and goes nowhere."""

    def retained(self, message: Message) -> None:
        """A retained message was kept, or, with an empty payload, deleted."""


@dataclass(frozen=True, slots=True)
class TlsInfo:
    """How a connection is secured: the version of TLS, and the name in the client's certificate.

    Both are empty where there is none.
    """

    version: str = ""
    certificate: str = ""


class Transport(Protocol):
    """The connection under a client, as a listener implements it."""

    #: Where the client is, for the log: "127.0.0.1:54321".
    address: str

    def authenticate(self, connect: Connect) -> None:
        """Find out who it is, in the background; `Client.accept` or `Client.refuse` ends it."""

    def exchange(self, method: str) -> Exchange | None:
        """Begin an enhanced authentication; None when the method is not offered."""

    def now(self) -> float:
        """Seconds of a clock that never goes back, finer than the broker's."""

    def admit(self, account: Account) -> str:
        """The client logs in as that user: why it may not from where it is, or nothing.

        With that the time limit for the login is over.
        """

    def holds(self, size: int) -> None:
        """So many bytes came and wait for more: the next chunk, however small, may be costly."""

    def tls_info(self) -> TlsInfo:
        """What protects the connection, and who its certificate says that the client is."""

    def later(self) -> None:
        """Call `Client.send_on` in a later turn of the loop, when others had theirs."""

    def stop_reading(self) -> None:
        """Read nothing more until the next `Client.send_on`."""

    def wait(self, seconds: float) -> None:
        """Call `Client.send_on` after so many seconds, if not before; read on until then."""

    def proceed(self) -> None:
        """What it waits for is there: call `Client.send_on` when others had their turn."""

    def write(self, chunks: list[bytes]) -> None:
        """Write the chunks, one behind the other."""

    def is_behind(self) -> bool:
        """Whether some of it waits here, as the network takes no more; when it does,
        `Output.caught_up` is called, or `Output.resume_writing`."""

    def peer_status(self) -> PeerStatus:
        """How the computer at the other end answers."""

    def probe(self) -> None:
        """Have it answer within two seconds, if it can."""

    def withhold(self, seconds: float) -> None:
        """Write nothing for so long; with 0, no longer."""

    def close(self) -> None:
        """Write what was written so far, then close."""

    def abort(self) -> None:
        """Close at once; never raises."""


class AuditLog(Protocol):
    """Told of who comes, who is refused, and who leaves: an audit log. Not of messages."""

    def connected(self, session: Session, address: str, version: int, tls_info: TlsInfo) -> None:
        """A client came in, with this version of MQTT."""

    def refused(
        self,
        address: str,
        reason: str,
        code: int = 0,
        client_id: str | None = None,
        username: str | None = None,
        tls_info: TlsInfo | None = None,
    ) -> None:
        """A connection, or the client on it, did not come in; who it is, it said itself."""

    def denied(self, session: Session, action: Action, topic: str, reason: str) -> None:
        """The rules do not let a client publish or subscribe."""

    def disconnected(self, session: Session, address: str, reason: str) -> None:
        """A client's connection ended."""


@dataclass(frozen=True, slots=True)
class Features:
    """What the standard leaves to the server's operator; see `broker` in appliance.yaml."""

    check_payload_format: bool = False
    reason_strings: bool = False
    #: With %c and %u for the client id and the user name; empty for none.
    response_information: str = ""


#: What client ids of sessions inside the appliance begin with, and no client's.
INSIDE = "_"

#: The largest packet that a client can count on without being told, in bytes.
USUAL_PACKET_SIZE = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class UserLimits:
    """What one user may have of what all share, see `accounts`; None is as others leave room."""

    connections: int | None = None
    sessions: int | None = None
    memory: int | None = None
    retained_messages: int | None = None
    retained_bytes: int | None = None
    #: Of `Store.size`.
    stored: int | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds of everything that a client can make grow; see `broker.limits` in appliance.yaml."""

    connections: int = 1000
    packet_size: int = USUAL_PACKET_SIZE
    memory: int = 256 * 1024 * 1024
    queue_messages: int = 1000
    queue_bytes: int = 16 * 1024 * 1024
    queue_full: str = "refuse"
    #: QoS 0 messages that wait for a slow client; 0: the latest of each topic.
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
