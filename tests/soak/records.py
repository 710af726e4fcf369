"""What the model knows of messages, subscriptions and sessions."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import inf

from soak.rights import Rights


@dataclass(eq=False, slots=True)
class Message:
    """One message. `number` counts all messages of its publisher, in the order of sending."""

    publisher: str
    number: int
    topic: str
    qos: int
    retain: bool
    size: int
    #: An empty payload: it deletes what is retained, and cannot be told from another when received.
    clears: bool
    permitted: bool
    #: A user property says the number, too.
    labelled: bool
    #: When the first of its packets was handed to the network as a whole; None before.
    sent_at: float | None = None
    sends: int = 0
    #: When it was known that the broker does nothing more because of it.
    closed_at: float = inf
    outcome: str = "open"
    #: When it was known not to be its topic's retained message any more.
    superseded_at: float = inf
    #: Subscriptions that were there when it was sent, and how often each had been interrupted.
    audience: list[tuple[Coverage, int]] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)

    @property
    def payload(self) -> bytes:
        if self.clears:
            return b""
        head = f"{self.publisher} {self.number} {self.qos} {self.topic}\n"
        return head.encode().ljust(self.size, b".")

    def __str__(self) -> str:
        kind = " retained" if self.retain else ""
        return f"message {self.number} of {self.publisher} to {self.topic} (QoS {self.qos}{kind})"


@dataclass(slots=True)
class Grant:
    """One version of a subscription, from SUBSCRIBE to the moment it was known to be gone."""

    qos: int
    sent_at: float
    gone_at: float = inf
    #: The client has unsubscribed, or is about to end the session.
    given_up: bool = False
    #: What was certainly retained when it was sent, and is to come.
    retained: list[Message] = field(default_factory=list)
    #: What it asks for, if it asks for retained messages.
    replay: Replay | None = None


@dataclass(eq=False, slots=True)
class Coverage:
    """All that a session ever subscribed under one filter."""

    session: Session
    filter: str
    no_local: bool
    identifier: int
    grants: list[Grant] = field(default_factory=list)
    #: The broker certainly has the subscription, with one or the other QoS.
    held: bool = False
    #: How often it was, or may have been, interrupted.
    breaks: int = 0

    def least_qos(self, since: float) -> int:
        """The lowest QoS that it may have had from then until now."""
        return min(grant.qos for grant in self.grants if grant.gone_at >= since)


@dataclass(slots=True)
class Replay:
    """The SUBSCRIBEs under one filter that ask for retained messages."""

    count: int = 0
    #: When the last one was sent that the broker has answered. Before its answer what comes may
    #: have been sent for an earlier one.
    sent_at: float = 0.0


@dataclass(slots=True)
class Owed:
    """A message that a session must receive; `exact` when it can only be with this QoS."""

    qos: int
    exact: bool


@dataclass(eq=False, slots=True)
class Session:
    """A session as the client knows it, from the CONNACK that began it."""

    client: str
    number: int
    rights: Rights
    #: All its subscriptions are Retain As Published and without retained messages.
    as_published: bool
    coverages: dict[str, Coverage] = field(default_factory=dict)
    owed: dict[Message, Owed] = field(default_factory=dict)
    #: Retained messages that must come, by topic and filter.
    owed_retained: dict[tuple[str, str], Message] = field(default_factory=dict)
    live: Counter[Message] = field(default_factory=Counter)
    replayed: Counter[Message] = field(default_factory=Counter)
    replays: dict[str, Replay] = field(default_factory=dict)
    newest: dict[tuple[str, str, int, int], int] = field(default_factory=dict)
    #: Connections that continued it.
    resumed: int = 0
    ended: bool = False
    events: list[tuple[float, str]] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.client}#{self.number}"


@dataclass(eq=False, slots=True)
class Group:
    """A shared subscription: its members together are owed each message once."""

    members: list[Coverage] = field(default_factory=list)
    owed: dict[Message, int] = field(default_factory=dict)
    received: dict[Message, list[tuple[Session, int]]] = field(default_factory=dict)
    #: When a member's connection, and when a member's session ended last.
    left_at: float = -inf
    lost_at: float = -inf
