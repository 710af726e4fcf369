"""Values that the broker and its surroundings pass to each other: who, what and why."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TypeAlias

from appliance.mqtt.codec import quote
from appliance.mqtt.reason import ReasonCode


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

    A `pending` refusal is provisional: it holds until the answer of a plugin arrives. `cost` is the
    work of this decision beyond that of any other, in units of `Counters.cost`; who asks adds it.
    """

    allowed: bool
    reason: str
    pending: bool = False
    cost: int = field(default=0, compare=False)

    def __bool__(self) -> bool:
        return self.allowed


#: The arguments of `Access.decide`: a client's identity, the action, and the topic or filter.
AccessQuery: TypeAlias = "tuple[Identity, Action, str]"


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a login is refused: `code` is sent to the client, `reason` is only logged.

    The code must not reveal whether the user exists: it is NOT_AUTHORIZED for a wrong password,
    an unknown user and a missing user name alike, as in mosquitto.
    """

    code: ReasonCode
    reason: str


#: Codes of a `Refusal` because of who it is or says to be; with others it may come again.
WRONG_LOGIN = (ReasonCode.NOT_AUTHORIZED, ReasonCode.BAD_USER_NAME_OR_PASSWORD)


@dataclass(frozen=True, slots=True)
class Accepted:
    """The success of an enhanced authentication; `data` goes into the last packet to the client."""

    username: str
    data: bytes


@dataclass(frozen=True, slots=True)
class PublishRejection:
    """Why a part of the appliance could not use a message, for the acknowledgement."""

    code: ReasonCode
    reason: str


@dataclass(frozen=True, slots=True)
class TlsInfo:
    """The TLS version of a connection, and the name in the client's certificate; empty for none."""

    version: str = ""
    certificate: str = ""


#: The prefix of the client ids of sessions inside the appliance; clients may not use it.
INSIDE = "_"
