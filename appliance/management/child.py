"""A program that does what would hold the event loop up; its output is read in a thread."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
from collections.abc import Sequence

from appliance.ros.calls.dispatcher import CallError


class Child:
    """One run of a program."""

    def __init__(self, command: Sequence[str], longest: int, nice: int) -> None:
        """`longest` is the most bytes of output, behind which it is ended; `nice` see nice(2)."""
        self._command = command
        self._longest = longest
        self._nice = nice
        self._process: subprocess.Popen[bytes] | None = None
        self._is_ended = False

    async def output(self, given: bytes = b"") -> bytes:
        """What it prints when it is `given` that, of 64 KiB at most, which a pipe holds; a byte
        more than the longest at most, and nothing when it fails. Raises CallError when it cannot
        be started.

        Cancelled, as a call that takes too long is, it ends the program.
        """
        try:
            return await asyncio.to_thread(self._run, given)
        except asyncio.CancelledError:
            self._is_ended = True
            if self._process is not None:
                self._process.kill()
            raise

    def _run(self, given: bytes) -> bytes:
        try:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        except OSError as error:
            raise CallError("failed", f"no process can be started: {error.strerror}") from None
        with self._process as process:
            if self._is_ended:
                process.kill()
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, process.pid, self._nice)
            assert process.stdin is not None and process.stdout is not None
            with contextlib.suppress(BrokenPipeError), process.stdin as stdin:
                stdin.write(given)
            output = process.stdout.read(self._longest + 1)
            if len(output) > self._longest:
                process.kill()
        return output
