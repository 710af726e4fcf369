"""Rows and what they stand for: messages, sessions and what is owed to them."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar, cast

from appliance.broker.accounts import Account
from appliance.broker.message import Message
from appliance.broker.ports import Identity
from appliance.broker.saved_sessions import PendingDelivery, SavedSession
from appliance.broker.session import Delivery, PendingWill, Session, UnreleasedPublish
from appliance.broker.shared import Share
from appliance.mqtt.codec import (
    MAXIMUM_PAIRS,
    NO_PROPERTIES,
    CheckedProperties,
    PacketType,
    Property,
    check_properties,
    decode_varint,
    encode_property_list,
    encode_varint,
)
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError
from appliance.mqtt.topics import check_filter, check_topic, parse_shared
from appliance.store.database import Rows
from appliance.store.schema import Row, Table

log = logging.getLogger("appliance.store")

_T = TypeVar("_T")

#: A key beyond this was not given out by us, who could not count so far.
LARGEST_KEY = 1 << 53

#: Seconds since 1970 that are beyond every date that was stored; nor is it infinity, or no number.
LATEST = 1e12


# --- to rows: `offset` is what the store's time is ahead of the broker's, in seconds --------------


def message_row(
    key: int, message: Message, offset: float, now: float, expiry: int | None = None
) -> Row:
    """The row of a message that is stored at `now`, by the store's time.

    `expiry` is that of a will, in seconds from its being published.
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


def session_row(key: int, session: Session, will: int | None, offset: float) -> Row:
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
    )


def owed_row(
    key: int,
    session: int,
    message: int | None,
    delivery: Delivery,
    packet_id: int | None,
    sent: int | None,
) -> Row:
    """The row of what is owed to a session; `sent` grows in the order of sending."""
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


# --- and back ------------------------------------------------------------------------------------


@dataclass(slots=True)
class LoadedSession:
    """A session, and the keys of its rows, in the same order as what they stand for."""

    key: int
    kept: SavedSession
    filters: dict[str, int] = field(default_factory=dict)
    inflight: list[int] = field(default_factory=list)
    queue: list[int] = field(default_factory=list)
    received: dict[int, int] = field(default_factory=dict)


class Owned(NamedTuple):
    """A retained message and whose client has published it: a user's, or the appliance itself."""

    message: Message
    username: str | None
    is_inside: bool


@dataclass(slots=True)
class Loaded:
    """All that was kept; `useless` are rows that nothing refers to, or that mean nothing."""

    sessions: dict[int, LoadedSession] = field(default_factory=dict)
    messages: dict[int, Message] = field(default_factory=dict)
    #: By the key of a message that was stored as a will: the seconds that it is good for.
    expiries: dict[int, int] = field(default_factory=dict)
    retained: dict[int, Owned] = field(default_factory=dict)
    useless: list[tuple[Table, int]] = field(default_factory=list)
    last_key: int = 0


class _WrongRowError(Exception):
    """A row does not mean anything."""


def load(rows: Rows, offset: float) -> Loaded:
    """What the rows stand for; those that are wrong are left out, and counted in the log."""
    loaded = Loaded()
    keys = [key for table in rows for key in table if key < LARGEST_KEY]
    orders = [row[8] for row in rows[Table.OWED].values() if isinstance(row[8], int)]
    loaded.last_key = max(0, *keys, *(order for order in orders if order < LARGEST_KEY), 0)
    wrong = 0

    def each(table: Table, take: Callable[[Row], None]) -> None:
        nonlocal wrong
        for key in sorted(rows[table]):
            try:
                _within(key, 1, LARGEST_KEY)
                take(rows[table][key])
            except (
                _WrongRowError,
                TypeError,
                ValueError,
                KeyError,
                IndexError,
                ProtocolError,
            ) as error:
                log.debug("a row of %s is wrong: %s", table.name.lower(), error)
                wrong += 1
                loaded.useless.append((table, key))

    def take_message(row: Row) -> None:
        key = cast(int, row[0])
        loaded.messages[key], expiry = _message(row, offset)
        if expiry is not None:
            loaded.expiries[key] = expiry

    def take_session(row: Row) -> None:
        session = _session(row, offset, loaded)
        loaded.sessions[session.key] = session

    each(Table.MESSAGE, take_message)
    each(Table.SESSION, take_session)
    _drop_doubles(loaded)
    each(Table.SUBSCRIPTION, lambda row: _take_subscription(row, loaded))
    each(Table.OWED, lambda row: _take_owed(row, loaded))
    _put_in_order(loaded, rows)
    each(Table.RECEIVED, lambda row: _take_received(row, loaded))
    each(Table.RETAINED, lambda row: _take_retained(row, loaded))
    if wrong:
        log.warning("%d rows of the store mean nothing, and were left out", wrong)
    return loaded


def _drop_doubles(loaded: Loaded) -> None:
    newest: dict[str, int] = {}
    for key, session in list(loaded.sessions.items()):
        client_id = session.kept.identity.client_id
        if client_id in newest:
            del loaded.sessions[newest[client_id]]
            loaded.useless.append((Table.SESSION, newest[client_id]))
        newest[client_id] = key


def _put_in_order(loaded: Loaded, rows: Rows) -> None:
    """What is in flight, in the order in which it was sent."""
    for session in loaded.sessions.values():
        flying = zip(session.inflight, session.kept.inflight.items(), strict=True)
        ordered = sorted(flying, key=lambda each: cast(int, rows[Table.OWED][each[0]][8]))
        session.inflight = [key for key, _ in ordered]
        session.kept.inflight = dict(item for _, item in ordered)


def _of(kind: type[_T], value: object) -> _T:
    if type(value) is not kind:
        raise _WrongRowError(f"{value!r:.40} where {kind.__name__} belongs")
    return value


def _within(value: object, low: int, high: int) -> int:
    number = _of(int, value)
    if not low <= number <= high:
        raise _WrongRowError(f"{number} is out of range")
    return number


def _time(value: object, offset: float) -> float | None:
    if value is None:
        return None
    moment = _of(float, value)
    if not abs(moment) < LATEST:
        raise _WrongRowError(f"{moment} is no time")
    return moment - offset


def _message(row: Row, offset: float) -> tuple[Message, int | None]:
    """The message, and the seconds that it is good for if it is a will."""
    _, topic, payload, qos, retain, properties, passed_on, expires_at, stored_at = row
    check_topic(_of(str, topic))
    wire, expiry = NO_PROPERTIES, None
    if properties is not None:
        checked = _properties(_of(bytes, properties))
        wire = checked.passed_on
        expiry = cast("int | None", checked.values.get(Property.MESSAGE_EXPIRY_INTERVAL))
    if passed_on is not None:  # an older appliance kept their order here
        wire = encode_varint(len(_of(bytes, passed_on))) + _of(bytes, passed_on)
        wire = _properties(wire).passed_on
    _of(float, stored_at)
    message = Message(
        _of(str, topic),
        _of(bytes, payload),
        _within(qos, 0, 2),
        _within(retain, 0, 1) == 1,
        None,
        _time(expires_at, offset),
        properties_wire=wire,
    )
    return message, expiry


def _properties(wire: bytes) -> CheckedProperties:
    checked, end = check_properties(wire, 0, len(wire), PacketType.PUBLISH, MAXIMUM_PAIRS)
    if end != len(wire):
        raise _WrongRowError("properties with something behind them")
    return checked or CheckedProperties({}, NO_PROPERTIES, 0)


def _session(row: Row, offset: float, loaded: Loaded) -> LoadedSession:
    key, client_id, username, expiry, ends_at, will, will_delay, will_at = row
    pending = None
    if will is not None:
        message = loaded.messages[_of(int, will)]
        delay = _within(will_delay, 0, 0xFFFF_FFFF)
        pending = PendingWill(message, delay, loaded.expiries.get(_of(int, will)))
    identity = Identity(None if username is None else _of(str, username), _of(str, client_id))
    kept = SavedSession(
        identity,
        _within(expiry, 0, 0xFFFF_FFFF),
        _time(ends_at, offset),
        pending,
        _time(will_at, offset),
    )
    return LoadedSession(_of(int, key), kept)


def _take_subscription(row: Row, loaded: Loaded) -> None:
    key, owner, topic_filter, qos, no_local, as_published, handling, identifier, *replaying = row
    session = loaded.sessions[_of(int, owner)]
    check_filter(_of(str, topic_filter))
    parse_shared(_of(str, topic_filter))
    subscription = Subscription(
        _of(str, topic_filter),
        _within(qos, 0, 2),
        _within(no_local, 0, 1) == 1,
        _within(as_published, 0, 1) == 1,
        _within(handling, 0, 2),
        _within(identifier, 0, 268_435_455),
    )
    if subscription.filter in session.filters:
        raise _WrongRowError("a second subscription with one filter")
    session.filters[subscription.filter] = _of(int, key)
    session.kept.subscriptions.append(subscription)
    if replaying and _within(replaying[0], 0, 1):
        session.kept.replaying.append(subscription)


def _take_owed(row: Row, loaded: Loaded) -> None:
    key, owner, message, qos, retain, subscription_ids, share, packet_id, sent = row
    session = loaded.sessions[_of(int, owner)]
    kept = session.kept
    if packet_id is not None and _within(packet_id, 1, 0xFFFF) in kept.inflight:
        raise _WrongRowError("a second message with one packet id")
    if packet_id is not None:
        _within(sent, 1, LARGEST_KEY)
    if message is None:
        kept.inflight[_within(packet_id, 1, 0xFFFF)] = None
        session.inflight.append(_of(int, key))
        return
    ids = None if subscription_ids is None else json.loads(_of(str, subscription_ids))
    if ids is not None:
        ids = [_within(number, 1, 268_435_455) for number in _of(list, ids)]
    owed = PendingDelivery(
        loaded.messages[_of(int, message)],
        _within(qos, 1, 2),
        _within(retain, 0, 1) == 1,
        ids,
        None if share is None else _of(str, share),
    )
    if packet_id is None:
        kept.queue.append(owed)
        session.queue.append(_of(int, key))
    else:
        kept.inflight[_of(int, packet_id)] = owed
        session.inflight.append(_of(int, key))


def _take_received(row: Row, loaded: Loaded) -> None:
    key, owner, packet_id, message, no_room = row
    session = loaded.sessions[_of(int, owner)]
    number = _within(packet_id, 1, 0xFFFF)
    if number in session.received:
        raise _WrongRowError("a second message with one packet id")
    sessions, shares = json.loads(_of(str, no_room)) if no_room is not None else ([], [])
    full = [loaded.sessions[key] for key in _of(list, sessions) if key in loaded.sessions]
    names = [each.kept.identity.client_id for each in full]
    filters = [_of(str, name) for name in _of(list, shares)]
    session.kept.received[number] = (loaded.messages[_of(int, message)], names, filters)
    session.received[number] = _of(int, key)


def _take_retained(row: Row, loaded: Loaded) -> None:
    key, number, *owner = row
    message = loaded.messages[_of(int, number)]
    username, is_inside = owner or (None, 0)  # an older appliance has not kept whose it is
    loaded.retained[_of(int, key)] = Owned(
        message,
        None if username is None else _of(str, username),
        _within(is_inside, 0, 1) == 1,
    )
