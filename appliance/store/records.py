"""The records of a segment of a backlog, as they are stored: joined, with a checksum."""

from __future__ import annotations

import struct
import zlib
from itertools import accumulate, pairwise
from typing import NamedTuple

from appliance.store.rows import Row


class UnwrittenSegment(NamedTuple):
    """A segment's row in the table `backlog`, with the records not joined yet."""

    key: int
    link: str
    lane: int
    first_at: float
    last_at: float
    records: list[bytes]

    def row(self) -> Row:
        """The row. It is made in the writer's thread, because joining takes time."""
        count = len(self.records)
        joined = join(self.records)
        moments = self.first_at, self.last_at
        return (self.key, self.link, self.lane, count, *moments, zlib.crc32(joined), joined)


def damaged_row(key: int) -> Row:
    """The row in the table `segment` of one whose records were damaged."""
    return key, "", 0, 0, 0, 0, 0.0, 0.0


def join(records: list[bytes]) -> bytes:
    """The records behind their lengths."""
    lengths = struct.pack(f"<{len(records)}I", *map(len, records))
    return b"".join((lengths, *records))


def split(length: int, joined: bytes, checksum: int) -> list[bytes]:
    """The records that were joined.

    Raises:
        ValueError, TypeError: they were damaged.
    """
    if length < 1 or zlib.crc32(joined) != checksum or len(joined) < 4 * length:
        raise ValueError("the checksum is wrong")
    lengths = struct.unpack_from(f"<{length}I", joined)
    ends = list(accumulate(lengths, initial=4 * length))
    if ends[-1] != len(joined):
        raise ValueError("the lengths are wrong")
    return [joined[start:end] for start, end in pairwise(ends)]
