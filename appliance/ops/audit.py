"""The audit log: who connected, was refused, changed what; JSON, one object a line, in files.

The event loop puts events into a bounded queue and a thread writes them, so that a slow disk delays
nobody. Lines that a full disk loses are counted; the file says how many as soon as it can be
written again. Floods of similar events are rate-limited: the rest is counted and summarised.
"""

from __future__ import annotations

import contextlib
import getpass
import json
import logging
import os
import queue
import stat
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from appliance.broker.values import Action, Identity, TlsInfo
from appliance.mqtt.codec import VERSION_NAMES
from appliance.mqtt.reason import ReasonCode

if TYPE_CHECKING:
    from appliance.broker.session import Session

log = logging.getLogger(__name__)

#: Events in the queue; more are lost, and counted.
QUEUE_LIMIT: Final = 10_000

#: The rate limit: events of one kind from one source (an address or a user) that are written in an
#: interval, and its seconds. More are counted. A change by a client is of a kind by what it was.
BURST: Final = 100
INTERVAL: Final = 10.0
#: Kinds and sources that the rate limit remembers; beyond that it evicts the least recent.
SOURCES: Final = 1024

#: Characters of one value: client ids and topics are up to 64 KiB.
LONGEST: Final = 256

#: Seconds between two tries while the file cannot be written.
RETRY: Final = 1.0

#: Seconds that `close` waits for the last lines.
CLOSE_TIMEOUT: Final = 2.0

#: The keys and values of one line, in their order.
Fields: TypeAlias = dict[str, Any]

#: What the rate limit counts together: the event, of a change what it was, and the address or user.
_Source: TypeAlias = tuple[str, str, str]


class AuditError(ValueError):
    """The audit log cannot be written; the message says why and what to do."""


@dataclass(slots=True)
class _Flood:
    """Events of one kind from one source in an interval."""

    since: float
    written: int = 0
    suppressed: int = 0
    last: Fields | None = None


class Audit:
    """Writes the audit log: the broker's `AuditLog`, and `changed` for changes of its settings.

    All methods run on the event loop, except `_write_all` and what it calls.
    """

    def __init__(self, path: Path, size: int, keep: int) -> None:
        """Open the file; `size` in bytes is its limit, `keep` the number of rotated files.

        Raises:
            AuditError: it cannot be written there.
        """
        self._file = _File(path, size, keep)
        self._queue: queue.Queue[Fields | None] = queue.Queue(QUEUE_LIMIT)
        self._overflowed = 0  # events that the full queue refused, counted by the event loop
        self._counted = 0  # how many of these the thread has added to `_lost`
        self._lost = 0  # lines that are missing in the file, which does not say so yet
        self._is_failing = False
        self._is_closing = threading.Event()
        self._floods: OrderedDict[_Source, _Flood] = OrderedDict()
        self._thread = threading.Thread(target=self._write_all, name="audit", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Write what is queued, within two seconds, and close the file; may be called twice."""
        if not self._thread.is_alive():
            return
        self._is_closing.set()
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=CLOSE_TIMEOUT)
        self._thread.join(CLOSE_TIMEOUT)

    # --- events --------------------------------------------------------------------------------

    def connected(self, session: Session, address: str, version: int, tls_info: TlsInfo) -> None:
        """A client connected."""
        self._put(
            "connected",
            **_identity(session.identity),
            address=address,
            mqtt=VERSION_NAMES[version],
            **_tls(tls_info),
        )

    def refused(
        self,
        address: str,
        reason: str,
        code: int = 0,
        client_id: str | None = None,
        username: str | None = None,
        tls_info: TlsInfo | None = None,
    ) -> None:
        """A connection, or the client on it, was refused; its names are its own claim."""
        claimed: Fields = {}
        if client_id is not None:
            claimed = {"client": client_id, "user": username}
        tls = _tls(tls_info) if tls_info is not None else {}
        self._put("refused", **claimed, address=address, **tls, **_code(code), reason=reason)

    def denied(self, session: Session, action: Action, topic: str, reason: str) -> None:
        """The access rules did not let a client publish or subscribe."""
        self._put(
            "denied",
            **_identity(session.identity),
            action=action.value,
            topic=topic,
            reason=reason,
        )

    def disconnected(self, session: Session, address: str, reason: str) -> None:
        """A client's connection ended."""
        self._put("disconnected", **_identity(session.identity), address=address, reason=reason)

    def changed(self, what: str, **details: Any) -> None:
        """Users, rules, certificates or settings were changed, or could not be: see `details`."""
        self._put("changed", what=what, **details)

    def began(self) -> None:
        """The appliance started."""
        self._put("started", pid=os.getpid())

    def ended(self) -> None:
        """The appliance stops."""
        self._put("stopped", pid=os.getpid())

    def _put(self, event: str, **fields: Any) -> None:
        # Cut here already: a full queue of whole topics would be gigabytes.
        try:
            self._queue.put_nowait(_cut({"time": _now(), "event": event, **fields}))
        except queue.Full:
            self._overflowed += 1

    # --- the thread ----------------------------------------------------------------------------

    def _write_all(self) -> None:
        ending = False
        while not ending:
            events: list[Fields] = []
            with contextlib.suppress(queue.Empty):
                event = self._queue.get(timeout=1.0 if self._floods or self._lost else None)
                while event is not None:
                    events.append(event)
                    if len(events) == 1000:
                        break
                    event = self._queue.get_nowait()
                ending = event is None
            now = time.monotonic()
            lines = [line for event in events for line in self._admit(event, now)]
            lines += self._summaries(now, everything=ending)
            self._write(lines)
        with contextlib.suppress(OSError):
            self._file.close()

    def _admit(self, event: Fields, now: float) -> list[Fields]:
        """The lines to write for an event: none when its source has reached the rate limit."""
        source = _source(event)
        if source is None:
            return [event]
        flood = self._floods.get(source)
        written: list[Fields] = []
        if flood is None or now - flood.since >= INTERVAL:
            if flood is not None:
                written += _summary(source, flood)
            flood = self._floods[source] = _Flood(now)
            if len(self._floods) > SOURCES:
                written += _summary(*self._floods.popitem(last=False))
        self._floods.move_to_end(source)
        if flood.written < BURST:
            flood.written += 1
            return [*written, event]
        flood.suppressed += 1
        flood.last = event
        return written

    def _summaries(self, now: float, *, everything: bool) -> list[Fields]:
        written: list[Fields] = []
        for source, flood in list(self._floods.items()):
            if everything or now - flood.since >= INTERVAL:
                written += _summary(source, flood)
                del self._floods[source]
        return written

    def _write(self, lines: list[Fields]) -> None:
        overflowed = self._overflowed
        self._lost += overflowed - self._counted
        self._counted = overflowed
        left = len(lines)
        try:
            if self._lost:
                self._file.write(_encode({"time": _now(), "event": "lost", "count": self._lost}))
                self._lost = 0
            for line in lines:
                self._file.write(_encode(line))
                left -= 1
        except OSError as error:
            self._lost += left
            if not self._is_failing:
                self._is_failing = True
                log.error(
                    "%s: cannot be written (%s); events until then are counted, not stored",
                    self._file.path,
                    error.strerror,
                )
            self._is_closing.wait(RETRY)
        else:
            if self._is_failing:
                self._is_failing = False
                log.warning("%s: can be written again", self._file.path)


class _File:
    """A file that lines are appended to, and that is rotated when it is full."""

    def __init__(self, path: Path, size: int, keep: int) -> None:
        self.path = path
        self._size = size
        self._keep = keep
        self._ends_within_line = False
        self._descriptor = -1
        self._open()
        if not os.access(path.parent, os.W_OK):
            raise AuditError(
                f"{path} (broker.audit.path): its directory cannot be written, which it must be "
                "to keep the file small; let the appliance's user own it"
            )

    def _open(self) -> None:
        try:
            # O_NONBLOCK: if it is a pipe, do not wait for its reader.
            flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
            self._descriptor = os.open(self.path, flags, 0o600)
            status = os.fstat(self._descriptor)
        except OSError as error:
            raise AuditError(
                f"{self.path} (broker.audit.path) cannot be written ({error.strerror}); name a "
                "file in a directory that is there and belongs to the appliance's user"
            ) from error
        if not stat.S_ISREG(status.st_mode):
            self.close()
            raise AuditError(f"{self.path} (broker.audit.path) is not a regular file")
        if status.st_mode & 0o077:
            log.warning(
                "%s can be read by others than its owner; close it with: chmod 600 %s",
                self.path,
                self.path,
            )

    def write(self, line: bytes) -> None:
        """Append a line. OSError: it was not written, or only a part of it."""
        if self._ends_within_line:
            line = b"\n" + line
        if self._was_moved():
            self._reopen()
        elif os.fstat(self._descriptor).st_size + len(line) > self._size:
            self._rotate()
        written = os.write(self._descriptor, line)
        if written < len(line):
            self._ends_within_line = True
            raise OSError(0, "there is no room")
        self._ends_within_line = False

    def _was_moved(self) -> bool:
        """Whether another program has moved or deleted the file, most likely logrotate."""
        try:
            return not os.path.samestat(self.path.stat(), os.fstat(self._descriptor))
        except FileNotFoundError:
            return True

    def _rotate(self) -> None:
        for number in range(self._keep - 1, 0, -1):
            with contextlib.suppress(FileNotFoundError):
                self._numbered(number).rename(self._numbered(number + 1))
        self.path.rename(self._numbered(1))
        self._reopen()

    def _numbered(self, number: int) -> Path:
        return self.path.with_name(f"{self.path.name}.{number}")

    def _reopen(self) -> None:
        before = self._descriptor
        try:
            self._open()
        except AuditError as error:
            raise OSError(0, str(error)) from error
        os.close(before)

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)


def note(path: Path | None, what: str, **details: Any) -> None:
    """Append one change, made by a command, to the audit log of an appliance that may be running.

    The file is not created, because the appliance could not write a file of another user. A link is
    not followed. OSError: it cannot be written.
    """
    if path is None:
        return
    try:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
        descriptor = os.open(path, flags)
    except FileNotFoundError:
        return
    line = {"time": _now(), "event": "changed", "what": what, **details, "by": _typist()}
    try:
        os.write(descriptor, _encode(line))
    finally:
        os.close(descriptor)


def _typist() -> str:
    """The user who typed the command, with sudo as "alice as root"."""
    user = getpass.getuser()
    caller = os.environ.get("SUDO_USER", user)
    return user if caller == user else f"{caller} as {user}"


def _now() -> str:
    moment = datetime.now(timezone.utc)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _identity(identity: Identity | None) -> Fields:
    if identity is None:
        return {}
    return {"client": identity.client_id, "user": identity.username}


def _tls(tls_info: TlsInfo) -> Fields:
    if not tls_info.version:
        return {"tls": None}
    return {"tls": tls_info.version, "certificate": tls_info.certificate or None}


def _code(code: int) -> Fields:
    if not code:
        return {}
    name = ReasonCode(code).name.replace("_", " ").capitalize()
    return {"code": f"0x{code:02X} {name}"}


def _source(event: Fields) -> _Source | None:
    """What the event is counted with in the rate limit; None if there is no limit.

    Changes by clients are counted by what they did and whether it was done, so that many of a kind
    hide none of another. All others are few: this computer's own, or consequences of those.
    """
    by = event.get("by")
    if isinstance(by, dict):
        return event["event"], event["what"], by["user"] or ""
    if event["event"] in ("changed", "started", "stopped"):
        return None
    # Clients choose their ids, so without an address the source is the user.
    origin = event["address"].rpartition(":")[0] if "address" in event else event["user"]
    return event["event"], "", origin or ""


def _summary(source: _Source, flood: _Flood) -> list[Fields]:
    if not flood.suppressed:
        return []
    event, _, origin = source
    more = {"time": _now(), "event": "more", "of": event, "from": origin}
    return [{**more, "count": flood.suppressed, "last": flood.last}]


def _encode(line: Fields) -> bytes:
    # In ASCII, so that no name that a stranger chose controls the terminal that shows the file.
    return json.dumps(_cut(line)).encode() + b"\n"


def _cut(value: Any) -> Any:
    if isinstance(value, str):
        return value if len(value) <= LONGEST else f"{value[:LONGEST]}…"
    if isinstance(value, dict):
        return {key: _cut(inner) for key, inner in value.items()}
    return value
