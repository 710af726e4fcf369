"""What a link to another broker needs of a store: records beside what clients store."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias

#: Bytes of records after which a segment is closed. One record may be larger: it is then alone.
SEGMENT_SIZE = 256 * 1024


@dataclass(slots=True, eq=False)
class Segment:
    """Consecutive records of a journal, which are stored and read together.

    Only the journal changes the attributes. Times are the journal's.
    """

    #: Grows in the order of the records, and is not reused in the journal.
    key: int
    #: Records, those included that are settled, and their bytes.
    count: int
    size: int
    #: So many at its beginning are settled.
    done: int
    #: When its first and its last record were appended.
    first_at: float
    last_at: float


class RecordsLostError(Exception):
    """A segment's records were damaged on the disk; it has been reported and removed."""


#: What `Journal.read` calls with the segment's records, or with the reason why there are none.
RecordsRead: TypeAlias = "Callable[[list[bytes] | Exception], None]"


class Journal(Protocol):
    """An append-only queue of records, in the transactions of the store.

    A segment is *held* from `append` or `read` until `release`: the user has its records in memory,
    or sends them. Others may be merged with their neighbours. Then `segments` contains a new
    segment in their place; methods ignore a segment that is not there any more.
    """

    def now(self) -> float:
        """Seconds of the store's clock, which continues through restarts and never jumps back."""

    def segments(self) -> Sequence[Segment]:
        """All segments, the oldest first; a live view. The last one may still grow."""

    def append(self, record: bytes, *, awaited: bool = True) -> Segment:
        """Stage a record; its index is then `count - 1` of the returned segment.

        That is the last one or a new one: a segment ends with its batch, and at `SEGMENT_SIZE`.
        When `awaited` is False, no packet waits for the commit of the record.
        """

    def settle(self, segment: Segment, done: int) -> None:
        """Note that the first `done` records need not be sent again.

        A segment that is settled completely is removed, unless it may still grow. This is committed
        within a second, or with what is committed before that.
        """

    def drop(self, segment: Segment) -> None:
        """Remove the segment, whether it is settled or not."""

    def read(self, segment: Segment, callback: RecordsRead) -> None:
        """Pass all `count` records to the callback, in a later round of the event loop.

        They are read in a thread; what is not committed yet comes from memory. For a segment that
        may still grow, the records of this moment are passed; of one that is not among `segments`
        any more, none. With `RecordsLostError` the segment was removed; after any other exception,
        reading may succeed later. After the store is closed, nothing is called any more.
        """

    def release(self, segment: Segment) -> None:
        """End to hold the segment: its records are only on disk, and are read before they are sent.

        It is a hint which keeps the list of segments short, and changes nothing else.
        """


#: The first byte of a record of `LatestRecords` that is no message, and not to be counted as one.
NO_MESSAGE: Final = b"N"


class LatestRecords(Protocol):
    """Records that are replaced by newer ones, in the transactions of the store.

    They are all read at the start, so that there should be few, of few bytes.
    """

    def load(self) -> list[tuple[int, bytes]]:
        """All keys and records, in the order of their keys."""

    def put(self, key: int | None, record: bytes, *, awaited: bool = True) -> int:
        """Stage the record under that key, or under a new one; returns the key.

        When `awaited` is False, no packet waits for its commit.
        """

    def remove(self, key: int) -> None:
        """Remove the record, within a second; a key that is not there is ignored."""


class SingleRecords(Protocol):
    """Records that are read one by one, in the transactions of the store. Only keys are in memory.

    What they are is to be stored elsewhere, such as in `LatestRecords`.
    """

    def load(self) -> list[int]:
        """The keys of all records, in their order."""

    def put(self, record: bytes, *, awaited: bool = True) -> int:
        """Stage a record; returns its key, a new one.

        When `awaited` is False, no packet waits for its commit.
        """

    def remove(self, key: int) -> None:
        """Remove the record, within a second; a key that is not there is ignored."""

    def read(self, key: int, callback: RecordsRead) -> None:
        """Pass the record, as the only one, to the callback in a later round of the event loop.

        Outcomes are those of `Journal.read`.
        """


class Backlogs(Protocol):
    """The records of the links to other brokers, by the links' names, beside what clients store.

    They do not count in `Store.bytes`; their user has a limit of its own.
    """

    @property
    def failing(self) -> bool:
        """Whether nothing can be stored now: whatever is appended stays in memory until it can."""

    @property
    def unwritten(self) -> int:
        """Bytes of records that are in memory because they are not on disk yet."""

    def journal(self, link: str, lane: int) -> Journal:
        """The link's journal of that lane; the same object each time."""

    def latest(self, link: str) -> LatestRecords:
        """The latest records of the link's topics; the same object each time."""

    def single(self, link: str) -> SingleRecords:
        """Records of the link that are read one by one; the same object each time."""

    def aside(self, link: str) -> LatestRecords:
        """The records that the link has set aside; the same object each time."""

    def waiting_links(self) -> list[str]:
        """The names of the links of which messages wait to be sent, sorted."""

    def forget(self, link: str) -> None:
        """Remove everything of a link; none of its records may be in use."""
