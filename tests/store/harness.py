"""A broker with its store on disk in the event loop of a test, and their state, for comparison."""

from __future__ import annotations

import asyncio
import shutil
import time
from pathlib import Path
from typing import Any

from broker.conftest import FakeAccess, Peer
from waiting import PATIENCE

from appliance.broker.broker import Broker
from appliance.broker.delivery import FULL_SIZE, Delivery, UnreleasedPublish
from appliance.broker.limits import Limits
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.shared import Share
from appliance.store import SqliteStore


class Harness:
    """Starts a broker with what is in the directory; times are those of the event loop."""

    def __init__(self, directory: Path, limits: Limits | None = None, **options: Any) -> None:
        self.path = directory / "state/store.db"
        self.limits = limits or Limits()
        self.options = options
        #: Whether a start reads what it could leave for later.
        self.reads_all = True

    def start(self) -> Harness:
        self.store = SqliteStore(self.path, **{"durability": "process", **self.options})
        self.store.open()
        self.access = FakeAccess()
        self.broker = Broker(self.access, self.store, self.limits)
        self.tick()
        self.store.restore(self.broker)
        if self.reads_all:
            for session in list(self.broker.sessions.values()):
                session.read_all()
        return self

    def tick(self, ahead: float = 0.0) -> None:
        self.broker.tick(asyncio.get_running_loop().time() + ahead)

    def peer(self, version: int = 5) -> Peer:
        return Peer(self.broker, version)

    async def join(self, client_id: str, version: int = 5, **options: Any) -> Peer:
        peer = self.peer(version)
        peer.say_connect(client_id, **options)
        peer.client.accept(peer.user)
        self.broker.flush()
        await self.written()
        return peer

    async def written(self) -> None:
        """Wait until all that was staged is committed."""
        store = self.store
        deadline = time.monotonic() + PATIENCE
        while not store._committer.is_idle:
            assert time.monotonic() < deadline, f"not written in {PATIENCE:g} s"
            store.hurry()
            await asyncio.sleep(0.002)

    async def stop(self) -> None:
        await self.store.close()

    def copy(self, directory: Path) -> Harness:
        """Not started, with what would be stored if the process had been killed now."""
        copy = Harness(directory, self.limits, **self.options)
        copy.reads_all = self.reads_all
        copy.path.parent.mkdir(parents=True)
        for name in (self.path.name, f"{self.path.name}-wal"):
            if (self.path.parent / name).exists():
                shutil.copyfile(self.path.parent / name, copy.path.parent / name)
        return copy

    def twin(self, directory: Path) -> Harness:
        """A second broker, started from a copy."""
        return self.copy(directory).start()


def state(broker: Broker) -> dict[str, Any]:
    """Everything of the broker that outlives a restart."""
    return {
        "sessions": {
            name: _session(broker, session)
            for name, session in broker.sessions.items()
            if session.identity is not None and session.persistent
        },
        "retained": {topic: _message(message) for topic, message in broker.retained.find("#")},
        "bytes": broker.retained.bytes,
    }


def _session(broker: Broker, session: Session) -> dict[str, Any]:
    # Shared subscriptions without persistent members do not outlive a restart.
    groups = {
        name
        for name, share in broker.router.shares.items()
        if any(member.persistent for member in share.members)
    }

    def delivery(owed: Delivery | None) -> Any:
        if owed is None:
            return None
        message, qos, retain, ids, share = owed
        group = share.filter if share and share.filter in groups else None
        return _message(message), qos, retain, ids or None, group

    def full(held: UnreleasedPublish) -> set[str]:
        """The names of those that outlive a restart."""
        names = {each.filter for each in held.full if isinstance(each, Share)}
        return (names & groups) | {
            each.client_id
            for each in broker.sessions.values()
            if each in held.full and each.persistent
        }

    # The others are not restored, so their bytes are not counted.
    forgotten = sum(len(held.full) - len(full(held)) for held in session.received.values())
    # Nor are messages that wait for a subscription's rate: they have QoS 0.
    rated = sum(limit.size for limit in session.rate_limits.values())
    will = session.will
    return {
        "identity": session.identity,
        "expiry": session.expiry,
        "ends_at": session.ends_at,
        "will": (_message(will.message), will.delay) if will is not None else None,
        "will_at": session.will_at,
        "subscriptions": session.subscriptions,
        "replays": {name for name in session.replays if session.subscriptions[name].qos},
        "inflight": [(number, delivery(each)) for number, each in session.inflight.items()],
        "queue": [delivery(each) for each in session.queue],
        "received": {
            number: (_message(held.message), full(held))
            for number, held in session.received.items()
        },
        "bytes": session.bytes - forgotten * FULL_SIZE - rated,
    }


def _message(message: Message) -> Any:
    return (
        message.topic,
        message.payload,
        message.qos,
        message.retain,
        message.properties or None,
        message.properties_wire,
        message.expires_at,
    )


def difference(before: Any, after: Any, path: str = "") -> list[str]:
    """The differences between two states, for people."""
    if isinstance(before, dict) and isinstance(after, dict):
        found = []
        for key in {**before, **after}:
            found += difference(before.get(key), after.get(key), f"{path}/{key}")
        return found
    if isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        found = []
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            found += difference(one, other, f"{path}/{number}")
        return found
    return [] if _same(before, after) else [f"{path}: {before!r} before, {after!r} after"]


def _same(one: Any, other: Any) -> bool:
    """Whether they are equal; times only nearly, because they were converted to the wall clock."""
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) < 0.1
    if isinstance(one, tuple | list) and isinstance(other, tuple | list):
        return len(one) == len(other) and all(map(_same, one, other))
    return bool(one == other)
