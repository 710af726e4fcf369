"""The broker's ports: Protocols that its surroundings implement.

A session's own are in `link` and `store`, those of links to other brokers in `backlogs`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from appliance.broker.accounts import Account
from appliance.broker.link import PeerStatus
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.values import (
    Accepted,
    AccessQuery,
    Action,
    Decision,
    Identity,
    PublishRejection,
    Refusal,
    TlsInfo,
)

if TYPE_CHECKING:
    from appliance.mqtt.packets import Connect


class Exchange(Protocol):
    """One enhanced authentication in progress: an exchange of AUTH packets (5.0 section 4.12)."""

    def step(self, data: bytes) -> bytes | Accepted | Refusal:
        """Process the client's data; returns the next challenge or the outcome. Does no I/O."""


class Access(Protocol):
    """The access rules in force. `epoch` is incremented whenever they change."""

    epoch: int

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Decide immediately, without I/O; `topic` is a filter when `action` is SUBSCRIBE.

        Where that takes longer the more rules there are, the decision tells its `cost`.
        """


class PendingDecisions(Protocol):
    """Access rules that may have to wait for a plugin's answer before they decide."""

    @property
    def timeout(self) -> float:
        """Seconds that a packet waits for a decision."""

    def is_pending(self, question: AccessQuery, wake: Callable[[], None]) -> bool:
        """Whether the decision is outstanding; if so, `wake` is called when it may be known."""


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
