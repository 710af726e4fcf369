"""The verb `doctor`: a process of its own examines the computer, one at a time."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from appliance.management.child import Child
from appliance.management.verbs import Arguments, Caller, Verb
from appliance.ros.calls.dispatcher import CallError

#: Seconds for the examination, of ROS too.
TIMEOUT: Final = 120.0

#: The most bytes of its findings.
LONGEST: Final = 256 * 1024

#: The priority of the process, see nice(2): it has a third of what the appliance has. At 15 it had
#: not ended in TIMEOUT where other programs keep the computer busy, which is when it is wanted.
_NICE: Final = 5


class DoctorVerb:
    """The examination of the computer that the appliance runs on."""

    def __init__(self, configuration: Path) -> None:
        self._command = (
            *(sys.executable, "-m", "appliance", "doctor", "--json"),
            *("--config", str(configuration)),
        )
        self._lock = asyncio.Lock()

    def verbs(self) -> Iterator[Verb[Any]]:
        """The verb."""
        yield Verb("doctor", Arguments, self._examine, TIMEOUT, is_local=False)

    async def _examine(self, caller: Caller, _: Arguments) -> dict[str, Any]:
        if self._lock.locked():
            raise CallError("too_many", "an examination is under way")
        async with self._lock:
            # With 1 it says that something is wrong with what it has examined.
            output = await Child(self._command, LONGEST, _NICE, codes=(0, 1)).output()
        return {"findings": _findings(output)}


def _findings(output: bytes) -> list[Any]:
    if len(output) > LONGEST:
        raise CallError("failed", f"the examination has more than {LONGEST} bytes of findings")
    if not output:
        raise CallError("failed", "the examination has failed; the log says with which exit code")
    try:
        return [json.loads(line) for line in output.splitlines()]
    except ValueError:
        raise CallError("failed", "the examination has not printed its findings") from None
