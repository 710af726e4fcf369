"""What the broker calls: stages the rows of sessions, deliveries and retained messages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from appliance.broker.accounts import Account
from appliance.broker.delivery import Delivery, UnreleasedPublish
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.store import SessionState
from appliance.broker.values import Identity
from appliance.mqtt.packets import Subscription
from appliance.store.backlogs import StoredBacklogs
from appliance.store.clock import StoreClock
from appliance.store.committer import Committer
from appliance.store.messages import StoredMessages
from appliance.store.rows import (
    Table,
    owed_row,
    received_row,
    retained_row,
    session_row,
    subscription_row,
)
from appliance.store.schema import Durability
from appliance.store.state import StoreState


class StoredSession:
    """The keys of a session's rows, and the account that its messages are counted in."""

    __slots__ = (
        "account",
        "drop_unread",
        "filters",
        "key",
        "owed",
        "received",
        "recorded",
        "will",
    )

    def __init__(self, key: int, account: Account) -> None:
        self.key = key
        self.account = account
        #: The keys of its subscriptions.
        self.filters: dict[str, int] = {}
        #: By the delivery's identity: the key, the delivery, and its place in the order of sending.
        self.owed: dict[int, tuple[int, Delivery, int | None]] = {}
        #: By packet id: the keys of deliveries after their PUBREC.
        self.recorded: dict[int, int] = {}
        #: By packet id: QoS 2 messages that wait for PUBREL.
        self.received: dict[int, tuple[int, Message]] = {}
        self.will: Message | None = None
        #: Deletes the rows of its queue that were not read since the start, if there were any.
        self.drop_unread: Callable[[], None] | None = None


class StagingStore(StoreState):
    """The port `Store`: turns each call into rows of the open batch.

    It remembers only what the database contains: which rows there are for each session and message.
    """

    def __init__(self, path: Path, durability: Durability, size: int, clock: StoreClock) -> None:
        super().__init__(size)
        self._clock = clock
        self._committer = Committer(self, path, durability)
        self._messages = StoredMessages(self, self._committer, clock)
        self.backlogs = StoredBacklogs(self._committer, clock)
        self._sessions: dict[SessionState, StoredSession] = {}
        #: By topic: the key, the message and its owner.
        self._retained: dict[str, tuple[int, Message, Account]] = {}

    def listen(self, callback: Callable[[bool], None]) -> None:
        """See `Store`."""
        self._committer.listen(callback)

    def hurry(self) -> None:
        """See `Store`."""
        self._committer.hurry()

    # --- sessions ------------------------------------------------------------------------------

    def session_saved(self, session: SessionState) -> None:
        """See `Store`; a session without expiry is stored while it has a will, for the will."""
        if not session.expiry:
            session.read_all()  # its client gets them, and they are no longer stored
        if not session.expiry and session.will is None:
            self.session_removed(session)
            return
        if type(session.identity) is not Identity:
            return  # the client has not logged in yet
        stored = self._sessions.get(session)
        is_new = stored is None
        if stored is None:
            stored = StoredSession(next(self._committer.keys), session.account)
            self._sessions[session] = stored
        will = session.will.message if session.will is not None else None
        if will is not stored.will:
            if session.will is not None:
                self._messages.put(session.will.message, stored.account, session.will.expiry)
            if stored.will is not None:
                self._messages.release(stored.will, stored.account)
            stored.will = will
        self._put_session(session, stored)
        if not session.expiry:
            self._drop_contents(stored)
        elif is_new:
            self._put_contents(session)
        if session.link is not None:
            self._committer.stage()
        else:
            self._committer.stage_lazily()

    def _put_session(self, session: SessionState, stored: StoredSession) -> None:
        will = self._messages.key(stored.will) if stored.will is not None else None
        row = session_row(stored.key, session, will, self._clock.offset)
        self._committer.open.put(Table.SESSION, stored.key, row)

    def _put_contents(self, session: SessionState) -> None:
        """Store what a session has had before it is stored for the first time."""
        for subscription in session.subscriptions.values():
            self.subscribed(session, subscription)
        for packet_id, delivery in session.inflight.items():
            if delivery is not None:
                self.sent(session, delivery, packet_id)
        for delivery in session.queue:
            self.queued(session, delivery)
        for packet_id, held in session.received.items():
            self.held(session, packet_id, held)

    def _drop_contents(self, stored: StoredSession) -> None:
        """Delete everything of a session except itself and its will."""
        batch = self._committer.open
        if stored.drop_unread is not None:
            stored.drop_unread()
        for key in stored.filters.values():
            batch.remove(Table.SUBSCRIPTION, key)
        for key, delivery, _ in stored.owed.values():
            batch.remove(Table.OWED, key)
            self._messages.release(delivery[0], stored.account)
        for key in stored.recorded.values():
            batch.remove(Table.OWED, key)
        for key, message in stored.received.values():
            batch.remove(Table.RECEIVED, key)
            self._messages.release(message, stored.account)
        for rows in (stored.filters, stored.owed, stored.recorded, stored.received):
            rows.clear()

    def session_removed(self, session: SessionState) -> None:
        """See `Store`."""
        stored = self._sessions.pop(session, None)
        if stored is None:
            return
        self._drop_contents(stored)
        if stored.will is not None:
            self._messages.release(stored.will, stored.account)
        self._committer.open.remove(Table.SESSION, stored.key)
        self._committer.stage()

    def subscribed(self, session: SessionState, subscription: Subscription) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        if stored is None:
            return
        key = stored.filters.get(subscription.filter)
        if key is None:
            key = stored.filters[subscription.filter] = next(self._committer.keys)
        replaying = subscription.qos > 0 and subscription.filter in session.replays
        row = subscription_row(key, stored.key, subscription, replaying=replaying)
        self._committer.open.put(Table.SUBSCRIPTION, key, row)
        self._committer.stage()

    def unsubscribed(self, session: SessionState, topic_filter: str) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        key = stored.filters.pop(topic_filter, None) if stored is not None else None
        if key is not None:
            self._committer.open.remove(Table.SUBSCRIPTION, key)
            self._committer.stage()

    # --- retained messages ---------------------------------------------------------------------

    def retained(self, message: Message, owner: Account) -> None:
        """See `Store`; topics of the broker itself are not stored, as every run creates them."""
        topic = message.topic
        if topic.startswith("$"):
            return
        batch = self._committer.open
        before = self._retained.pop(topic, None)
        if message.payload:
            key = before[0] if before is not None else next(self._committer.keys)
            row = retained_row(key, self._messages.put(message, owner), owner)
            batch.put(Table.RETAINED, key, row)
            self._retained[topic] = key, message, owner
        elif before is not None:
            batch.remove(Table.RETAINED, before[0])
        if before is not None:
            self._messages.release(*before[1:])
        if message.qos:
            self._committer.stage()
        else:
            self._committer.stage_lazily()

    # --- deliveries ----------------------------------------------------------------------------

    def queued(self, session: SessionState, delivery: Delivery) -> None:
        """See `Store`."""
        self._put_owed(session, delivery, None)

    def sent(self, session: SessionState, delivery: Delivery, packet_id: int) -> None:
        """See `Store`."""
        self._put_owed(session, delivery, packet_id)

    def _put_owed(self, session: SessionState, delivery: Delivery, packet_id: int | None) -> None:
        stored = self._sessions.get(session)
        if stored is None:
            return
        committer = self._committer
        entry = stored.owed.get(id(delivery))
        if entry is None:
            key = next(committer.keys)
            message = self._messages.put(delivery[0], stored.account)
        else:
            key = entry[0]
            message = self._messages.key(delivery[0])
        sent = next(committer.keys) if packet_id is not None else None
        stored.owed[id(delivery)] = key, delivery, sent
        row = owed_row(key, stored.key, message, delivery, packet_id, sent)
        committer.open.put(Table.OWED, key, row)
        committer.stage()

    def settled(self, session: SessionState, delivery: Delivery) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        entry = stored.owed.pop(id(delivery), None) if stored is not None else None
        if entry is not None:
            self._committer.open.remove(Table.OWED, entry[0])
            self._messages.release(delivery[0], session.account)
            self._committer.stage_lazily()

    def recorded(self, session: SessionState, delivery: Delivery, packet_id: int) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        entry = stored.owed.pop(id(delivery), None) if stored is not None else None
        if stored is not None and entry is not None:
            key, _, sent = entry
            stored.recorded[packet_id] = key
            row = owed_row(key, stored.key, None, delivery, packet_id, sent)
            self._committer.open.put(Table.OWED, key, row)
            self._messages.release(delivery[0], stored.account)
            self._committer.stage()

    def completed(self, session: SessionState, packet_id: int) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        key = stored.recorded.pop(packet_id, None) if stored is not None else None
        if key is not None:
            self._committer.open.remove(Table.OWED, key)
            self._committer.stage_lazily()

    # --- QoS 2 messages of clients -------------------------------------------------------------

    def held(self, session: SessionState, packet_id: int, held: UnreleasedPublish) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        if stored is None:
            return
        key = next(self._committer.keys)
        stored.received[packet_id] = key, held.message
        message = self._messages.put(held.message, stored.account)
        full = [
            self._sessions[each].key
            for each in held.full
            if isinstance(each, Session) and each in self._sessions
        ]
        row = received_row(key, stored.key, packet_id, message, held, full)
        self._committer.open.put(Table.RECEIVED, key, row)
        self._committer.stage()

    def unheld(self, session: SessionState, packet_id: int) -> None:
        """See `Store`."""
        stored = self._sessions.get(session)
        entry = stored.received.pop(packet_id, None) if stored is not None else None
        if entry is not None:
            self._committer.open.remove(Table.RECEIVED, entry[0])
            self._messages.release(entry[1], session.account)
            self._committer.stage()
