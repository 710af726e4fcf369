"""The properties of a message as it is sent: those that were published, and what it says of itself.

They are put together as bytes, as every message that has waited needs it.
"""

from __future__ import annotations

from datetime import datetime, timezone
from math import floor, inf
from typing import Final, cast

from appliance.mqtt.codec import (
    PacketType,
    Properties,
    Property,
    decode_properties,
    decode_varint,
    encode_properties,
    encode_string,
    encode_varint,
)
from appliance.mqtt.topics import holds_control

#: User properties: what is the same each time a message is sent, and when it was published.
ID: Final = "id"
PUBLISHED_AT: Final = "published-at"

_USER_PROPERTY: Final = bytes((Property.USER_PROPERTY,))
_ID: Final = _USER_PROPERTY + encode_string(ID)
_EXPIRY: Final = bytes((Property.MESSAGE_EXPIRY_INTERVAL,))
#: Up to the time's text, whose length is always the same.
_PUBLISHED: Final = (
    _USER_PROPERTY
    + encode_string(PUBLISHED_AT)
    + encode_string("2000-01-01T00:00:00.000+00:00")[:2]
)

#: Bytes of properties, at most, that are kept for the next message.
LARGEST_KEPT: Final = 4096

#: Seconds by which a time is away from those of another millisecond: more than what is rounded.
_ROUNDED: Final = 2e-6


def printable(published: bytes) -> bytes:
    """The encoded properties, with their length in front, without those that hold control
    characters.

    A receiver may close the connection upon them (5.0 section 1.5.4), and mosquitto does, while our
    clients are let use them.
    """
    values, _ = decode_properties(published, 0, len(published), PacketType.PUBLISH)
    kept: Properties = {}
    for name, value in (values or {}).items():
        if name is Property.USER_PROPERTY:
            pairs = cast("list[tuple[str, str]]", value)
            pairs = [each for each in pairs if not any(map(holds_control, each))]
            if pairs:
                kept[name] = pairs
        elif not (isinstance(value, str) and holds_control(value)):
            kept[name] = value
    return published if kept == (values or {}) else encode_properties(kept)


class PublishProperties:
    """Puts properties together; what consecutive messages have in common is encoded once."""

    def __init__(self) -> None:
        self._second: int | None = None
        self._until_second = b""
        #: The last properties with nothing but a time added, what they were published with, and
        #: from when until when they are the same.
        self._dated = self._published_with = b""
        self._since = self._until = inf

    def encode(
        self, published: bytes, expiry: int | None, number: int | None, published_at: float | None
    ) -> bytes:
        """The properties with their length in front (5.0 section 2.2.2).

        `published` are those it was published with, encoded with their length and without an
        expiry. `expiry` is the Message Expiry Interval, `number` is told as `id`, and
        `published_at` is a time of the wall clock in seconds.
        """
        is_plain = expiry is None and number is None and len(published) <= LARGEST_KEPT
        if published_at is not None and is_plain:
            return self._encode_dated(published, published_at)
        inside = _without_length(published)
        if expiry is not None:
            inside += _EXPIRY + expiry.to_bytes(4, "big")
        if number is not None:
            inside += _ID + encode_string(f"{number:x}")
        if published_at is not None:
            inside += self._published(published_at)
        return _with_length(inside)

    def _encode_dated(self, published: bytes, at: float) -> bytes:
        """The properties with that time, which most often are those of the message before."""
        if not self._since <= at < self._until or published != self._published_with:
            self._dated = _with_length(_without_length(published) + self._published(at))
            self._published_with = published
            start = floor(at * 1000) / 1000
            self._since, self._until = start + _ROUNDED, start + 0.001 - _ROUNDED
            if not self._since <= at < self._until:
                self._until = -inf  # the next one may be of another millisecond
        return self._dated

    def _published(self, at: float) -> bytes:
        """The user property of a time as ISO 8601 has it, in UTC, with milliseconds.

        The text up to the second is kept: the whole of it costs 3 µs, and what waited was
        published in the same second as the message before it.
        """
        second = floor(at)  # also before 1970, where a computer's clock may start
        millisecond = round((at - second) * 1e6) // 1000
        if millisecond == 1000:
            second += 1
            millisecond = 0
        if second != self._second:
            self._second = second
            text = datetime.fromtimestamp(second, timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.")
            self._until_second = _PUBLISHED + text.encode()
        return b"%b%03d+00:00" % (self._until_second, millisecond)


def _without_length(properties: bytes) -> bytes:
    return properties[decode_varint(properties, 0)[1] if properties[0] >= 0x80 else 1 :]


def _with_length(properties: bytes) -> bytes:
    size = len(properties)
    return (bytes((size,)) if size < 0x80 else encode_varint(size)) + properties
