"""The verbs that read what was: the last lines of the log, and of the audit log."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field

from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Arguments, Caller, Verb
from appliance.ops import logs
from appliance.ros.calls.dispatcher import CallError

#: The most lines of an answer, and their most bytes: the newest are kept.
MOST_LINES: Final = 1000
LONGEST: Final = 256 * 1024

#: What colours the log where it is a terminal.
_COLOUR: Final = re.compile(r"\x1b\[\d*m")


@dataclass(eq=False)
class Tail(Arguments):
    """How many lines, the newest."""

    lines: Annotated[int, Field(ge=1, le=MOST_LINES)] = 100


class RecordVerbs:
    """The verbs about the log and the audit log."""

    def __init__(self, audit: Path | None, thread: VerbThread) -> None:
        """`audit` is the path of the audit log; None where there is none."""
        self._audit = audit
        self._thread = thread

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        yield Verb("log", Tail, self._log)
        yield Verb("audit", Tail, self._read_audit)

    async def _log(self, caller: Caller, wanted: Tail) -> dict[str, Any]:
        lines = newest(list(logs.recent), wanted.lines)
        return {"lines": [_COLOUR.sub("", line) for line in lines]}

    async def _read_audit(self, caller: Caller, wanted: Tail) -> dict[str, Any]:
        path = self._audit
        if path is None:
            raise CallError("rejected", "there is no audit log: broker.audit.path names none")
        try:
            entries = await self._thread.run(caller.user, partial(_tail, path, wanted.lines))
        except OSError as error:
            raise CallError("failed", f"the audit log cannot be read: {error.strerror}") from None
        return {"entries": entries}


def newest(lines: list[str], most: int) -> list[str]:
    """The newest lines, in their order, no more and no longer than an answer may be."""
    found: list[str] = []
    size = 0
    for line in reversed(lines):
        size += len(line.encode()) + 8
        if len(found) == most or size > LONGEST:
            break
        found.append(line)
    found.reverse()
    return found


def _tail(path: Path, most: int) -> list[Any]:
    """The last entries of the file: of the whole lines in its last bytes."""
    with path.open("rb") as file:
        start = max(0, os.fstat(file.fileno()).st_size - LONGEST)
        file.seek(start)
        data = file.read(LONGEST)
    lines = data.decode(errors="replace").split("\n")
    return _entries([line for line in lines[bool(start) :] if line], most)


def _entries(lines: list[str], most: int) -> list[Any]:
    found = []
    for line in newest(lines, most):
        try:
            found.append(json.loads(line))
        except (ValueError, RecursionError):  # cut off by a full disk, or somebody else's
            found.append({"event": "unreadable"})
    return found
