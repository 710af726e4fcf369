"""The rows of messages: each is stored once, and deleted when nothing refers to it any more."""

from __future__ import annotations

from collections.abc import Callable

from appliance.broker.accounts import Account
from appliance.broker.message import Message
from appliance.store.clock import StoreClock
from appliance.store.committer import Committer
from appliance.store.rows import MESSAGE_OVERHEAD, Table, message_row
from appliance.store.state import StoreState


class _StoredMessage:
    """The row of a message, and how many rows refer to it."""

    __slots__ = ("expires_at", "key", "references", "size", "stored_at")

    def __init__(self, key: int, message: Message, stored_at: float) -> None:
        self.key = key
        self.references = 0
        self.size = len(message.topic_wire) + len(message.payload) + MESSAGE_OVERHEAD
        self.size += len(message.properties_wire)
        self.expires_at = message.expires_at
        self.stored_at = stored_at


class StoredMessages:
    """All stored messages, with the number of references to each.

    Their bytes are counted in the store's state, once for each message, and in the account of each
    session or owner that refers to it.
    """

    def __init__(self, state: StoreState, committer: Committer, clock: StoreClock) -> None:
        self._state = state
        self._committer = committer
        self._clock = clock
        #: The oldest first, as keys grow, when `_is_in_order`.
        self._messages: dict[Message, _StoredMessage] = {}
        self._is_in_order = True

    def __len__(self) -> int:
        return len(self._messages)

    def load(self, key: int, message: Message, stored_at: float) -> None:
        """Add a message that is in the database; the rows that refer to it are added after it."""
        self._messages[message] = stored = _StoredMessage(key, message, stored_at)
        self._state.bytes += stored.size

    def refer(self, message: Message, account: Account) -> None:
        """Count one more row that refers to a stored message."""
        stored = self._messages[message]
        stored.references += 1
        account.stored += stored.size

    def hold(self, message: Message) -> None:
        """Keep a stored message until `let_go`: rows refer to it that were not read yet."""
        self._messages[message].references += 1

    def let_go(self, message: Message) -> None:
        """The opposite of `hold`."""
        self._let_go(message, self._messages[message])

    def size(self, message: Message) -> int:
        """Bytes that are counted for a stored message."""
        return self._messages[message].size

    def lose_order(self) -> None:
        """Messages were loaded in another order than that of their keys."""
        self._is_in_order = False

    def put(self, message: Message, account: Account, expiry: int | None = None) -> int:
        """Count one more row that refers to the message, which is stored if it was not.

        Returns the key of its row. `expiry` is the message expiry interval of a will.
        """
        stored = self._messages.get(message)
        if stored is None:
            stored = _StoredMessage(next(self._committer.keys), message, self._clock.now())
            self._messages[message] = stored
            self._state.bytes += stored.size
            self._committer.open.messages += 1
            self._put_row(message, stored, expiry)
        elif stored.expires_at is not message.expires_at:  # a will that is published
            self._put_row(message, stored)
        stored.references += 1
        account.stored += stored.size
        return stored.key

    def _put_row(self, message: Message, stored: _StoredMessage, expiry: int | None = None) -> None:
        stored.expires_at = message.expires_at
        row = message_row(stored.key, message, self._clock.offset, stored.stored_at, expiry)
        self._committer.open.put(Table.MESSAGE, stored.key, row)

    def key(self, message: Message) -> int:
        """The key of a stored message."""
        return self._messages[message].key

    def release(self, message: Message, account: Account) -> None:
        """Count one row less that refers to the message, and delete it after the last."""
        stored = self._messages[message]
        account.stored -= stored.size
        self._let_go(message, stored)

    def _let_go(self, message: Message, stored: _StoredMessage) -> None:
        stored.references -= 1
        if not stored.references:
            self._delete(message)

    def delete_unreferenced(self) -> None:
        """Delete the messages that were loaded and that nothing refers to."""
        for message, stored in list(self._messages.items()):
            if not stored.references:
                self._delete(message)

    def _delete(self, message: Message) -> None:
        stored = self._messages.pop(message)
        self._state.bytes -= stored.size
        self._committer.open.remove(Table.MESSAGE, stored.key)

    def older_than(self, seconds: float) -> Callable[[Message], bool] | None:
        """A test for messages that were stored before so many seconds; None when there are none."""
        if not self._is_in_order:
            in_order = sorted(self._messages.items(), key=lambda item: item[1].key)
            self._messages = dict(in_order)
            self._is_in_order = True
        limit = self._clock.now() - seconds
        oldest = next(iter(self._messages.values()), None)
        if oldest is None or oldest.stored_at >= limit:
            return None

        def is_old(message: Message) -> bool:
            stored = self._messages.get(message)
            return stored is not None and stored.stored_at < limit

        return is_old
