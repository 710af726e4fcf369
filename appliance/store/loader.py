"""Turns the rows of the database into messages, sessions and their pending deliveries.

A row may be damaged, so every value is checked before it is used. A row that is wrong, or refers to
a row that is missing, is left out, counted in the log, and deleted with the first batch.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, cast

from appliance.broker.backlogs import Segment
from appliance.broker.delivery import PendingWill
from appliance.broker.max_rate import FASTEST_RATE, SLOWEST_RATE
from appliance.broker.message import Message
from appliance.broker.saved_sessions import PendingDelivery, SavedSession
from appliance.broker.values import Identity
from appliance.mqtt.codec import (
    MAXIMUM_PAIRS,
    NO_PROPERTIES,
    CheckedProperties,
    PacketType,
    Property,
    check_properties,
    encode_string,
    encode_varint,
)
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError
from appliance.mqtt.topics import check_filter, check_topic, parse_shared
from appliance.store.rows import (
    LOADED,
    SET_ASIDE,
    LatestRow,
    MessageRow,
    OwedRow,
    ReceivedRow,
    RetainedRow,
    Rows,
    SegmentRow,
    SessionRow,
    SubscriptionRow,
    Table,
    UnreadRows,
)

log = logging.getLogger("appliance.store")

_T = TypeVar("_T")
_RowT = TypeVar("_RowT")

#: Keys are given out from 1 on and never reach this one: a larger key is damage.
LARGEST_KEY = 1 << 53

#: Seconds since 1970, later than every time that is stored: a larger number is damage.
LATEST = 1e12

#: Topics of messages that are known to be valid, with their encoding.
KNOWN_TOPICS = 10_000


@dataclass(slots=True)
class LoadedSession:
    """A session, and the keys of its rows in the same order as what they stand for."""

    key: int
    saved: SavedSession
    filters: dict[str, int] = field(default_factory=dict)
    inflight: list[int] = field(default_factory=list)
    queue: list[int] = field(default_factory=list)
    #: The rows of its queue, if they are read later.
    unread: UnreadRows | None = None
    received: dict[int, int] = field(default_factory=dict)


class OwnedMessage(NamedTuple):
    """A retained message and whose client published it: a user's, or the appliance itself."""

    message: Message
    username: str | None
    is_inside: bool


@dataclass(slots=True)
class LoadedBacklogs:
    """The segments of each link and lane, and the records of each link and kind, by their keys."""

    segments: dict[tuple[str, int], list[Segment]] = field(default_factory=dict)
    records: dict[tuple[str, int], dict[int, bytes]] = field(default_factory=dict)


@dataclass(slots=True)
class Loaded:
    """All that the rows stand for; `useless` are rows to delete."""

    sessions: dict[int, LoadedSession] = field(default_factory=dict)
    messages: dict[int, Message] = field(default_factory=dict)
    #: The message expiry intervals of wills, by the keys of their messages.
    expiries: dict[int, int] = field(default_factory=dict)
    retained: dict[int, OwnedMessage] = field(default_factory=dict)
    backlogs: LoadedBacklogs = field(default_factory=LoadedBacklogs)
    useless: list[tuple[Table, int]] = field(default_factory=list)
    #: Queues of sessions that are not there.
    orphans: list[UnreadRows] = field(default_factory=list)
    last_key: int = 0


class _WrongRowError(Exception):
    """A row does not mean anything."""


#: What is raised where a row is damaged.
WRONG = (_WrongRowError, TypeError, ValueError, KeyError, IndexError, ProtocolError)


def load(rows: Rows, offset: float) -> Loaded:
    """What the rows stand for, with times of the broker's clock; `offset` is as in `rows`."""
    loaded = Loaded()
    keys = [key for table in LOADED for key in rows.of(table)]
    orders = [row.sent for row in rows.owed.values() if isinstance(row.sent, int)]
    keys.append(rows.unread.last_key)
    loaded.last_key = max((key for key in (*keys, *orders) if 0 < key < LARGEST_KEY), default=0)
    wrong = 0

    def each(table: Table, found: dict[int, _RowT], take: Callable[[_RowT], None]) -> None:
        nonlocal wrong
        for key in sorted(found):
            try:
                _within(key, 1, LARGEST_KEY)
                take(found[key])
            except WRONG as error:
                log.debug("a row of %s is wrong: %s", table.name.lower(), error)
                wrong += 1
                loaded.useless.append((table, key))

    topics: dict[str, bytes] = {}

    def take_message(row: MessageRow) -> None:
        loaded.messages[row.id], expiry = message_of(row, offset, topics)
        if expiry is not None:
            loaded.expiries[row.id] = expiry

    def take_session(row: SessionRow) -> None:
        loaded.sessions[row.id] = _session(row, offset, loaded)

    each(Table.MESSAGE, rows.message, take_message)
    each(Table.SESSION, rows.session, take_session)
    _drop_duplicates(loaded)
    each(Table.SUBSCRIPTION, rows.subscription, lambda row: _take_subscription(row, loaded))
    each(Table.OWED, rows.owed, lambda row: _take_owed(row, loaded))
    _sort_inflight(loaded, rows)
    each(Table.RECEIVED, rows.received, lambda row: _take_received(row, loaded))
    each(Table.RETAINED, rows.retained, lambda row: _take_retained(row, loaded))
    loaded.useless += [(Table.MESSAGE, key) for key in rows.unread.unreferenced]
    for key, unread in rows.unread.queues.items():
        if key in loaded.sessions:
            loaded.sessions[key].unread = unread
        else:
            wrong += len(unread)
            loaded.orphans.append(unread)
    damaged = [key for key, row in rows.segment.items() if row.length == 0]
    for key in damaged:
        del rows.segment[key]
        loaded.useless.append((Table.SEGMENT, key))
    each(Table.SEGMENT, rows.segment, lambda row: _take_segment(row, loaded.backlogs))
    each(Table.LATEST, rows.latest, lambda row: _take_latest(row, loaded.backlogs))
    # Segments' rows are useless without their records, and the other way round.
    loaded.useless += [
        (Table.BACKLOG, key) for table, key in loaded.useless if table is Table.SEGMENT
    ]
    if wrong:
        log.warning("%d rows of the store mean nothing, and were left out", wrong)
    return loaded


def _drop_duplicates(loaded: Loaded) -> None:
    """Keep the newest of several sessions with one client id."""
    newest: dict[str, int] = {}
    for key, session in list(loaded.sessions.items()):
        client_id = session.saved.identity.client_id
        if client_id in newest:
            del loaded.sessions[newest[client_id]]
            loaded.useless.append((Table.SESSION, newest[client_id]))
        newest[client_id] = key


def _sort_inflight(loaded: Loaded, rows: Rows) -> None:
    """Sort what is inflight in the order of sending."""
    for session in loaded.sessions.values():
        inflight = zip(session.inflight, session.saved.inflight.items(), strict=True)
        ordered = sorted(inflight, key=lambda each: cast(int, rows.owed[each[0]].sent))
        session.inflight = [key for key, _ in ordered]
        session.saved.inflight = dict(item for _, item in ordered)


def _of(kind: type[_T], value: object) -> _T:
    if type(value) is not kind:
        raise _WrongRowError(f"{value!r:.40} where {kind.__name__} belongs")
    return value


def _within(value: object, low: int, high: int) -> int:
    if type(value) is not int or not low <= value <= high:
        raise _WrongRowError(f"{value!r:.40} where a number from {low} to {high} belongs")
    return value


def _rate(value: object) -> float:
    number = _of(float, value)
    if number and not SLOWEST_RATE <= number <= FASTEST_RATE:
        raise _WrongRowError(f"{number} is no rate")
    return number


def _time(value: object, offset: float) -> float | None:
    if value is None:
        return None
    moment = _of(float, value)
    if not abs(moment) < LATEST:
        raise _WrongRowError(f"{moment} is no time")
    return moment - offset


def message_of(
    row: MessageRow, offset: float, topics: dict[str, bytes]
) -> tuple[Message, int | None]:
    """The message, and its message expiry interval if it was stored as a will; raises `WRONG`.

    Most messages have the topic of another one: `topics` saves to check and to encode it again.
    """
    topic = _of(str, row.topic)
    topic_wire = topics.get(topic)
    if topic_wire is None:
        check_topic(topic)
        if len(topics) >= KNOWN_TOPICS:
            topics.clear()
        topic_wire = topics[topic] = encode_string(topic)
    wire, expiry = NO_PROPERTIES, None
    if row.properties is not None:
        checked = _properties(_of(bytes, row.properties))
        wire = checked.passed_on
        expiry = cast("int | None", checked.values.get(Property.MESSAGE_EXPIRY_INTERVAL))
    if row.passed_on is not None:  # an older appliance stored the publisher's order here
        passed_on = _of(bytes, row.passed_on)
        wire = _properties(encode_varint(len(passed_on)) + passed_on).passed_on
    _of(float, row.stored_at)
    message = Message(
        topic,
        _of(bytes, row.payload),
        _within(row.qos, 0, 2),
        _within(row.retain, 0, 1) == 1,
        None,
        _time(row.expires_at, offset),
        topic_wire,
        wire,
    )
    return message, expiry


def _properties(wire: bytes) -> CheckedProperties:
    checked, end = check_properties(wire, 0, len(wire), PacketType.PUBLISH, MAXIMUM_PAIRS)
    if end != len(wire):
        raise _WrongRowError("bytes after the properties")
    return checked or CheckedProperties({}, NO_PROPERTIES, 0)


def _session(row: SessionRow, offset: float, loaded: Loaded) -> LoadedSession:
    will = None
    if row.will is not None:
        key = _of(int, row.will)
        delay = _within(row.will_delay, 0, 0xFFFF_FFFF)
        will = PendingWill(loaded.messages[key], delay, loaded.expiries.get(key))
    username = None if row.username is None else _of(str, row.username)
    saved = SavedSession(
        Identity(username, _of(str, row.client_id)),
        _within(row.expiry, 0, 0xFFFF_FFFF),
        _time(row.ends_at, offset),
        will,
        _time(row.will_at, offset),
    )
    return LoadedSession(row.id, saved)


def _take_subscription(row: SubscriptionRow, loaded: Loaded) -> None:
    session = loaded.sessions[_of(int, row.session)]
    topic_filter = _of(str, row.filter)
    check_filter(topic_filter)
    parse_shared(topic_filter)
    subscription = Subscription(
        topic_filter,
        _within(row.qos, 0, 2),
        _within(row.no_local, 0, 1) == 1,
        _within(row.retain_as_published, 0, 1) == 1,
        _within(row.retain_handling, 0, 2),
        _within(row.identifier, 0, 268_435_455),
        _rate(row.max_rate),
    )
    if topic_filter in session.filters:
        raise _WrongRowError("a second subscription with one filter")
    session.filters[topic_filter] = row.id
    session.saved.subscriptions.append(subscription)
    if _within(row.replaying, 0, 1):
        session.saved.replaying.append(subscription)


def _take_owed(row: OwedRow, loaded: Loaded) -> None:
    session = loaded.sessions[_of(int, row.session)]
    saved = session.saved
    packet_id = row.packet_id
    if packet_id is not None:
        packet_id = _within(packet_id, 1, 0xFFFF)
        if packet_id in saved.inflight:
            raise _WrongRowError("a second message with one packet id")
        _within(row.sent, 1, LARGEST_KEY)
    if row.message is None:
        saved.inflight[_within(packet_id, 1, 0xFFFF)] = None
        session.inflight.append(row.id)
        return
    pending = pending_of(row, loaded.messages[_of(int, row.message)])
    if packet_id is None:
        saved.queue.append(pending)
        session.queue.append(row.id)
    else:
        saved.inflight[packet_id] = pending
        session.inflight.append(row.id)


def pending_of(row: OwedRow, message: Message) -> PendingDelivery:
    """A message on its way to a session; raises `WRONG`."""
    ids = None if row.subscription_ids is None else json.loads(_of(str, row.subscription_ids))
    if ids is not None:
        ids = [_within(number, 1, 268_435_455) for number in _of(list, ids)]
    return PendingDelivery(
        message,
        _within(row.qos, 1, 2),
        _within(row.retain, 0, 1) == 1,
        ids,
        None if row.share is None else _of(str, row.share),
    )


def _take_received(row: ReceivedRow, loaded: Loaded) -> None:
    session = loaded.sessions[_of(int, row.session)]
    packet_id = _within(row.packet_id, 1, 0xFFFF)
    if packet_id in session.received:
        raise _WrongRowError("a second message with one packet id")
    no_room = json.loads(_of(str, row.no_room)) if row.no_room is not None else ([], [])
    sessions, shares = no_room
    full = [loaded.sessions[key] for key in _of(list, sessions) if key in loaded.sessions]
    names = [each.saved.identity.client_id for each in full]
    filters = [_of(str, name) for name in _of(list, shares)]
    session.saved.received[packet_id] = (loaded.messages[_of(int, row.message)], names, filters)
    session.received[packet_id] = row.id


def _take_retained(row: RetainedRow, loaded: Loaded) -> None:
    loaded.retained[row.id] = OwnedMessage(
        loaded.messages[_of(int, row.message)],
        None if row.username is None else _of(str, row.username),
        _within(row.inside, 0, 1) == 1,
    )


def _take_segment(row: SegmentRow, backlogs: LoadedBacklogs) -> None:
    count = _within(row.length, 1, LARGEST_KEY)
    moments = _time(row.first_at, 0.0), _time(row.last_at, 0.0)
    segment = Segment(
        row.id,
        count,
        _within(row.size, 0, LARGEST_KEY),
        _within(row.done, 0, count),
        *(_of(float, moment) for moment in moments),
    )
    place = _of(str, row.link), _within(row.lane, 0, LARGEST_KEY)
    backlogs.segments.setdefault(place, []).append(segment)


def _take_latest(row: LatestRow, backlogs: LoadedBacklogs) -> None:
    place = _of(str, row.link), _within(row.kind, 0, SET_ASIDE)
    backlogs.records.setdefault(place, {})[row.id] = _of(bytes, row.record)
