"""The verb `doctor`: a process of its own examines the computer, one at a time."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

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
            process = _Process(self._command)
            try:
                output = await asyncio.to_thread(process.run)
            except asyncio.CancelledError:  # it takes too long, or the appliance stops
                process.kill()
                raise
        return {"findings": _findings(output)}


class _Process:
    """A process whose output is read in a thread."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ended = False

    def run(self) -> bytes:
        """What it prints, a byte more than LONGEST at most. Raises CallError."""
        try:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        except OSError as error:
            raise CallError("failed", f"no process can be started: {error.strerror}") from None
        with self._process as process:
            if self._is_ended:
                process.kill()
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
            assert process.stdout is not None
            output = process.stdout.read(LONGEST + 1)
            if len(output) > LONGEST:
                process.kill()
        return output

    def kill(self) -> None:
        """End it; from the event loop's thread."""
        self._is_ended = True
        if self._process is not None:
            self._process.kill()


def _findings(output: bytes) -> list[Any]:
    if len(output) > LONGEST:
        raise CallError("failed", f"the examination has more than {LONGEST} bytes of findings")
    try:
        return [json.loads(line) for line in output.splitlines()]
    except ValueError:
        raise CallError("failed", "the examination has not printed its findings") from None
