"""A message on its way: to a session, from one until its PUBREL, and as a will."""

from __future__ import annotations

import math
from typing import Final, NamedTuple, Protocol

from appliance.broker.message import Message

#: Bytes counted for a held QoS 2 message beside itself, and for each receiver without room.
HELD_SIZE: Final = 200
FULL_SIZE: Final = 64


class Group(Protocol):
    """A shared subscription, see `shared.Share`."""

    @property
    def filter(self) -> str:
        """The whole filter, `$share/{group}/{filter}`."""


class Delivery(NamedTuple):
    """A message on its way to one session.

    On the data path it is a plain tuple, made with `cast`, which costs a fifth. It still needs a
    class: mypyc would unpack a tuple that is passed between functions and create another one, but
    the store distinguishes deliveries by their identity.
    """

    message: Message
    qos: int
    retain: bool
    #: Of the subscriptions that matched.
    subscription_ids: list[int] | None
    #: The shared subscription that chose this session among others.
    share: Group | None


class UnreleasedPublish(NamedTuple):
    """A QoS 2 message that waits for PUBREL, and the receivers without room at its PUBREC."""

    message: Message
    #: Sessions, and the groups of shared subscriptions.
    full: frozenset[object]
    #: When it arrived, in seconds of `Transport.now`; unknown if it was sent on another connection.
    since: float = -math.inf


def held_size(held: UnreleasedPublish) -> int:
    """Bytes that are counted for a held QoS 2 message."""
    return held.message.size + HELD_SIZE + FULL_SIZE * len(held.full)


class PendingWill(NamedTuple):
    """A will, its delay after the end of the connection, and its expiry interval once published.

    Both times are in seconds; the expiry is None for a will that does not expire.
    """

    message: Message
    delay: int
    expiry: int | None = None
