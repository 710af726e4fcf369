"""The properties of a message as it is sent: those that were published, and what it says of itself.

They are put together as bytes, as every message that has waited needs it.
"""

from __future__ import annotations

from datetime import datetime, timezone
from math import floor
from typing import Final

from appliance.mqtt.codec import Property, decode_varint, encode_string, encode_varint

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


class PublishProperties:
    """Puts properties together; what consecutive messages have in common is encoded once."""

    def __init__(self) -> None:
        self._second: int | None = None
        self._until_second = b""

    def encode(
        self, published: bytes, expiry: int | None, number: int | None, published_at: float | None
    ) -> bytes:
        """The properties with their length in front (5.0 section 2.2.2).

        `published` are those it was published with, encoded with their length and without an
        expiry. `expiry` is the Message Expiry Interval, `number` is told as `id`, and
        `published_at` is a time of the wall clock in seconds.
        """
        inside = published[decode_varint(published, 0)[1] if published[0] >= 0x80 else 1 :]
        if expiry is not None:
            inside += _EXPIRY + expiry.to_bytes(4, "big")
        if number is not None:
            inside += _ID + encode_string(f"{number:x}")
        if published_at is not None:
            inside += self._published(published_at)
        size = len(inside)
        return (bytes((size,)) if size < 0x80 else encode_varint(size)) + inside

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
