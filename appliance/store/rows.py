"""The rows of the database's tables, and how objects of the broker become rows.

Whatever reads rows reads them by name: a row that was read is a named tuple. Rows that are written
are plain tuples in the same order, because the data path makes several for each message and a named
tuple takes several times as long to make.

Times are seconds of the store's own clock, see `clock`. `offset` is how far that is ahead of the
broker's clock.
"""

from __future__ import annotations

import json
from array import array
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, TypeAlias, cast

from appliance.broker.accounts import Account
from appliance.broker.delivery import Delivery, UnreleasedPublish
from appliance.broker.message import OVERHEAD, Message
from appliance.broker.shared import Share
from appliance.broker.store import SessionState
from appliance.mqtt.codec import (
    NO_PROPERTIES,
    Property,
    decode_varint,
    encode_property_list,
    encode_varint,
)
from appliance.mqtt.packets import Subscription

#: What SQLite returns for a column. The database may be damaged, so a column may hold any of these.
Value: TypeAlias = "int | float | str | bytes | None"

#: The columns of a row in the order of its named tuple; its key comes first.
Row: TypeAlias = "tuple[Value, ...]"


class Table(IntEnum):
    """The tables, by the names that they have in the database, in the order of writing."""

    MESSAGE = 0
    SESSION = 1
    SUBSCRIPTION = 2
    OWED = 3
    RECEIVED = 4
    RETAINED = 5
    CLOCK = 6
    SEGMENT = 7
    BACKLOG = 8
    LATEST = 9


#: The tables that are read at the start: all except the records of backlogs, which may be many.
LOADED: tuple[Table, ...] = tuple(table for table in Table if table is not Table.BACKLOG)


class MessageRow(NamedTuple):
    """A message, which any number of the other rows refer to."""

    id: int
    topic: Value
    payload: Value
    qos: Value
    retain: Value
    properties: Value
    passed_on: Value
    expires_at: Value
    stored_at: Value


class SessionRow(NamedTuple):
    """A session; `will` is the key of a message."""

    id: int
    client_id: Value
    username: Value
    expiry: Value
    ends_at: Value
    will: Value
    will_delay: Value
    will_at: Value


class SubscriptionRow(NamedTuple):
    """A subscription of a session."""

    id: int
    session: Value
    filter: Value
    qos: Value
    no_local: Value
    retain_as_published: Value
    retain_handling: Value
    identifier: Value
    replaying: Value = 0
    max_rate: Value = 0.0


class OwedRow(NamedTuple):
    """A QoS 1 or 2 message that a session has not acknowledged, queued or inflight."""

    id: int
    session: Value
    message: Value
    qos: Value
    retain: Value
    subscription_ids: Value
    share: Value
    packet_id: Value
    sent: Value


class ReceivedRow(NamedTuple):
    """A QoS 2 message of a session's client that waits for its PUBREL."""

    id: int
    session: Value
    packet_id: Value
    message: Value
    no_room: Value


class RetainedRow(NamedTuple):
    """The retained message of a topic, and who published it."""

    id: int
    message: Value
    username: Value = None
    inside: Value = 0


class ClockRow(NamedTuple):
    """What the clocks said when the store was last written; the table has this one row."""

    id: int
    time: Value
    wall: Value
    counted: Value
    boot: Value


class SegmentRow(NamedTuple):
    """A segment of a link's journal: what is known of its records without reading them.

    One with a length of 0 was damaged: nothing refers to its records, which are deleted when the
    whole database has been checked.
    """

    id: int
    link: Value
    lane: Value
    length: Value
    size: Value
    done: Value
    first_at: Value
    last_at: Value


class BacklogRow(NamedTuple):
    """The records of a segment, and what is needed to restore the segment's row."""

    id: int
    link: Value
    lane: Value
    length: Value
    first_at: Value
    last_at: Value
    checksum: Value
    records: Value


#: The kinds of rows in the table `latest`: the latest record of its topic, and one set aside.
LATEST, SET_ASIDE = 0, 1

#: The lane of segments that are no journal's: a record of a link that is read by itself.
SINGLE_LANE = 1 << 40


class LatestRow(NamedTuple):
    """A record of a link that a newer one may replace; `kind` is LATEST or SET_ASIDE."""

    id: int
    link: Value
    kind: Value
    record: Value


#: Bytes that a message takes in the database beside its topic, payload and properties, roughly,
#: including the rows of what it is delivered to.
MESSAGE_OVERHEAD = 120

#: The condition on rows of `owed` that may be read later: queued, and not obviously damaged.
MAY_WAIT = (
    "packet_id IS NULL AND id BETWEEN 1 AND 4503599627370496 "
    "AND typeof(session) = 'integer' AND typeof(message) = 'integer' "
    "AND message BETWEEN 1 AND 4503599627370496"
)

#: Bytes of a message in the database.
SIZE = (
    f"length(CAST(topic AS BLOB)) + 2 + length(payload) + {MESSAGE_OVERHEAD} "
    f"+ coalesce(length(properties), {len(NO_PROPERTIES)})"
)

#: The keys of all messages, and their bytes.
SIZES = f"SELECT id, coalesce({SIZE}, 0) FROM message"

#: How many messages there are, and their bytes.
STORED = f"SELECT count(*), total({SIZE}) FROM message"

#: What has to be known of each queue before its rows are read: the keys, the bytes in the store,
#: and about what `Message.size` has for each, too (a topic that is not ASCII takes two bytes a
#: character). The limit keeps SQLite from sorting the payloads in place of their lengths. To group
#: the rows SQLite sorts them: an order inside would be a second sort, and twice the time.
QUEUES = f"""
    SELECT session, group_concat(id), group_concat(message), max(is_shared), total(size),
        total(size + text)
    FROM (
        SELECT waiting.id, session, waiting.message, share IS NOT NULL AS is_shared,
            {SIZE} AS size,
            {OVERHEAD - MESSAGE_OVERHEAD} + length(CAST(topic AS BLOB)) + 4 + length(topic)
            + CASE length(topic) WHEN length(CAST(topic AS BLOB)) THEN 0 ELSE 76 + length(topic) END
            AS text
        FROM (SELECT id, session, message, share FROM owed WHERE {MAY_WAIT}) AS waiting
        LEFT JOIN message ON message.id = waiting.message
        LIMIT -1
    )
    GROUP BY session
"""

#: The messages of some rows, each with its bytes; what is selected follows.
MESSAGES_OF = f"""
    SELECT owed.id, message.id, {SIZE}
    FROM owed JOIN message ON message.id = owed.message WHERE owed.id
"""

#: The named tuple of each table. A column that an older version of the tables does not have is at
#: the end and has a default.
ROW_TYPES: dict[Table, type[NamedTuple]] = {
    Table.MESSAGE: MessageRow,
    Table.SESSION: SessionRow,
    Table.SUBSCRIPTION: SubscriptionRow,
    Table.OWED: OwedRow,
    Table.RECEIVED: ReceivedRow,
    Table.RETAINED: RetainedRow,
    Table.CLOCK: ClockRow,
    Table.SEGMENT: SegmentRow,
    Table.BACKLOG: BacklogRow,
    Table.LATEST: LatestRow,
}

COLUMNS: dict[Table, tuple[str, ...]] = {table: ROW_TYPES[table]._fields for table in Table}


class UnreadRows:
    """What is known of the rows of a session's queue without reading them."""

    __slots__ = ("bytes", "is_shared", "keys", "next", "size")

    def __init__(self, keys: array[int], *, is_shared: bool, size: int, queued: int) -> None:
        #: In their order.
        self.keys = keys
        #: The index of the first one that was not read yet.
        self.next = 0
        #: Whether any has a group.
        self.is_shared = is_shared
        #: Bytes of the messages in the store, and about what the broker counts for them.
        self.size = size
        self.bytes = queued

    def __len__(self) -> int:
        return len(self.keys) - self.next


@dataclass(slots=True)
class UnreadContents:
    """The queues of sessions whose rows are read later, and the messages that they refer to."""

    #: By the keys of the sessions.
    queues: dict[int, UnreadRows] = field(default_factory=dict)
    #: By the keys of messages: how many of the rows refer to it.
    references: Counter[int] = field(default_factory=Counter)
    #: Bytes of all messages in the store, with those that are read at the start.
    stored: int = 0
    #: The keys of messages that nothing refers to, which only damage can leave there.
    unreferenced: list[int] = field(default_factory=list)
    #: The largest key of a row or a message.
    last_key: int = 0

    def add(self, found: Iterable[Row]) -> None:
        """Take what `QUEUES` selects."""
        for session, keys, messages, is_shared, size, queued in found:
            # One after the other most often already, but SQLite does not promise it.
            own = array("q", sorted(map(int, cast(str, keys).split(","))))
            referred = list(map(int, cast(str, messages).split(",")))
            self.references.update(referred)
            self.last_key = max(self.last_key, own[-1], *referred)
            self.queues[cast(int, session)] = UnreadRows(
                own,
                is_shared=bool(is_shared),
                size=int(cast(float, size)),
                queued=int(cast(float, queued)),
            )


@dataclass(slots=True)
class Rows:
    """All rows of the tables in `LOADED` by their keys; the fields are named as the tables."""

    message: dict[int, MessageRow] = field(default_factory=dict)
    session: dict[int, SessionRow] = field(default_factory=dict)
    subscription: dict[int, SubscriptionRow] = field(default_factory=dict)
    owed: dict[int, OwedRow] = field(default_factory=dict)
    received: dict[int, ReceivedRow] = field(default_factory=dict)
    retained: dict[int, RetainedRow] = field(default_factory=dict)
    clock: dict[int, ClockRow] = field(default_factory=dict)
    segment: dict[int, SegmentRow] = field(default_factory=dict)
    latest: dict[int, LatestRow] = field(default_factory=dict)
    #: What is read later is in none of these.
    unread: UnreadContents = field(default_factory=UnreadContents)

    def of(self, table: Table) -> dict[int, Row]:
        """The rows of one table."""
        return cast("dict[int, Row]", getattr(self, table.name.lower()))


def message_row(
    key: int, message: Message, offset: float, now: float, expiry: int | None = None
) -> Row:
    """The row of a message that is stored at `now`, by the store's clock.

    `expiry` is the message expiry interval of a will, in seconds from its publication.
    """
    properties = message.properties_wire
    if expiry is not None:
        own = properties[decode_varint(properties, 0)[1] :]
        own += encode_property_list({Property.MESSAGE_EXPIRY_INTERVAL: expiry})
        properties = encode_varint(len(own)) + own
    return (
        key,
        message.topic,
        message.payload,
        message.qos,
        int(message.retain),
        properties if properties != NO_PROPERTIES else None,
        None,
        None if message.expires_at is None else message.expires_at + offset,
        now,
    )


def session_row(key: int, session: SessionState, will: int | None, offset: float) -> Row:
    """The row of a session; `will` is the key of its message."""
    identity = session.identity
    assert identity is not None
    return (
        key,
        session.client_id,
        identity.username,
        session.expiry,
        None if session.ends_at is None else session.ends_at + offset,
        will,
        session.will.delay if session.will is not None else 0,
        None if session.will_at is None else session.will_at + offset,
    )


def subscription_row(key: int, session: int, subscription: Subscription, *, replaying: bool) -> Row:
    """The row of a subscription, `replaying` while its retained messages are being sent."""
    return (
        key,
        session,
        subscription.filter,
        int(subscription.qos),
        int(subscription.no_local),
        int(subscription.retain_as_published),
        int(subscription.retain_handling),
        subscription.identifier,
        int(replaying),
        subscription.max_rate,
    )


def owed_row(
    key: int,
    session: int,
    message: int | None,
    delivery: Delivery,
    packet_id: int | None,
    sent: int | None,
) -> Row:
    """The row of a delivery to a session; `sent` grows in the order of sending."""
    _, qos, retain, subscription_ids, share = delivery
    return (
        key,
        session,
        message,
        qos,
        int(retain),
        json.dumps(subscription_ids) if subscription_ids else None,
        share.filter if share is not None else None,
        packet_id,
        sent,
    )


def retained_row(key: int, message: int, owner: Account) -> Row:
    """The row of a retained message in the owner's account."""
    return key, message, owner.username, int(owner.is_inside)


def received_row(
    key: int, session: int, packet_id: int, message: int, held: UnreleasedPublish, full: list[int]
) -> Row:
    """The row of a QoS 2 message that waits for PUBREL; `full` are the sessions without room."""
    no_room = None
    if held.full:
        shares = [receiver.filter for receiver in held.full if isinstance(receiver, Share)]
        no_room = json.dumps([full, shares])
    return key, session, packet_id, message, no_room
