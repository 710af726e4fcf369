"""A program that does what would hold the event loop up; its output is read in a thread."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import subprocess
from collections.abc import Sequence

from appliance.ros.calls.dispatcher import CallError

log = logging.getLogger(__name__)


class Child:
    """One run of a program, in a process group of its own."""

    def __init__(
        self,
        command: Sequence[str],
        longest: int,
        nice: int,
        *,
        codes: Sequence[int] = (0,),
        directory: str | None = None,
    ) -> None:
        """`longest` is the most bytes of output, behind which it is ended; for `nice` see nice(2).
        It has failed when its exit code is none of `codes`."""
        self._command = command
        self._longest = longest
        self._nice = nice
        self._codes = codes
        self._directory = directory
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ended = False

    async def output(self, given: bytes = b"") -> bytes:
        """What it prints, a byte more than the longest at most, and nothing when it fails. It has
        to read all that it is `given` before it prints. Raises CallError when it cannot be started.

        Cancelled, as a call that takes too long is, it ends the program, and what that has started.
        """
        try:
            return await asyncio.to_thread(self._run, given)
        except asyncio.CancelledError:
            self._is_ended = True
            if self._process is not None:
                _kill(self._process)
            raise

    def _run(self, given: bytes) -> bytes:
        try:
            self._process = subprocess.Popen(
                self._command,
                cwd=self._directory,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            raise CallError("failed", f"no process can be started: {error.strerror}") from None
        with self._process as process:
            if self._is_ended:
                _kill(process)
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, self._nice)
            assert process.stdin is not None and process.stdout is not None
            with contextlib.suppress(BrokenPipeError), process.stdin as stdin:
                stdin.write(given)
            output = process.stdout.read(self._longest + 1)
            if len(output) > self._longest:
                _kill(process)
                return output
        if process.returncode in self._codes:
            return output
        if not self._is_ended:
            log.warning("%s ended with %d", " ".join(self._command), process.returncode)
        return b""


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End it and its children; it is reaped in its thread, and so its number still its own."""
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
