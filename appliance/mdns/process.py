"""The announcing program as a process of the appliance: started, watched, started again, ended."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import sys
from asyncio.subprocess import PIPE, STDOUT, Process
from collections.abc import Sequence
from typing import Any, Final

from async_timeout import timeout

from appliance.mdns.announcement import Announcement

log = logging.getLogger(__name__)

COMMAND: Final = (sys.executable, "-m", "appliance.mdns.announcer")

#: The program reads what strangers send, so that what it prints counts as a stranger's: the most
#: bytes of a line, and of a text in it, and the most links. It is ended when it prints more.
LINE_SIZE: Final = 16 << 10
TEXT_SIZE: Final = 500
LINKS: Final = 16

#: Seconds between two of its lines that are read; what it prints faster waits, and so does it.
LINE_INTERVAL: Final = 0.1

#: Seconds until it is started again, the first time and at most; and for how long it has to have
#: run for the next end to be a first one.
FIRST_DELAY: Final = 1.0
LONGEST_DELAY: Final = 300.0
STEADY: Final = 600.0

#: Seconds in which it says farewell to the network, before it is killed.
FAREWELL: Final = 0.6


class AnnouncerProcess:
    """Announces what `announce` was given last, by the program; runs on the event loop."""

    def __init__(self, command: Sequence[str] = COMMAND, delay: float = FIRST_DELAY) -> None:
        self._command = command
        self._first_delay = delay
        self._wanted: Announcement | str = "not started"
        self._changed = asyncio.Event()
        self._process: Process | None = None
        #: Whether its input was ended, as nothing was to be announced.
        self._is_ending = False
        #: What it has said last: its name, links and problem.
        self._said: dict[str, Any] = {}
        #: Why it has ended; empty while it runs.
        self._failure = ""
        #: How often it was started again.
        self.restarts = 0

    def announce(self, wanted: Announcement | str) -> None:
        """Announce that from now on; a text is the reason why nothing is announced."""
        if wanted == self._wanted:
            return
        self._wanted = wanted
        self._changed.set()
        if self._process is not None:
            self._hand_over(self._process)

    @property
    def pid(self) -> int | None:
        """Its process id while it runs."""
        return self._process.pid if self._process is not None else None

    def status(self) -> dict[str, Any]:
        """What is announced, for `appliance status`."""
        if isinstance(self._wanted, str):
            state, problem, said = "off", "", {}
        else:
            said = self._said
            problem = self._failure or said.get("problem", "")
            waits = "waiting" if said and not problem else "starting"
            state = "failed" if self._failure else "announced" if said.get("name") else waits
        return {
            "state": state,
            "reason": self._wanted if isinstance(self._wanted, str) else None,
            "name": said.get("name") or None,
            "links": said.get("links", []),
            "problem": problem or None,
            "restarts": self.restarts,
        }

    async def run(self) -> None:
        """Run the program whenever there is something to announce; until it is cancelled."""
        loop = asyncio.get_running_loop()
        delay = self._first_delay
        while True:
            self._changed.clear()
            if isinstance(self._wanted, str):
                await self._changed.wait()
                continue
            began = loop.time()
            try:
                why = await self._run_once()
            except OSError as error:
                why = f"cannot be started: {error.strerror or error}"
            if not why:
                continue
            if loop.time() - began > STEADY:
                delay = self._first_delay
            self._failure = f"the announcing program {why}"
            log.warning("mDNS: %s; it is started again in %g s", self._failure, delay)
            with contextlib.suppress(asyncio.TimeoutError):
                async with timeout(delay):
                    await self._changed.wait()
            delay = min(2 * delay, LONGEST_DELAY)
            self.restarts += 1

    async def _run_once(self) -> str:
        """Run it until its end; returns why that was, empty when it was ended."""
        self._is_ending = False
        process = await asyncio.create_subprocess_exec(
            *self._command,
            stdin=PIPE,
            stdout=PIPE,
            stderr=STDOUT,
            limit=LINE_SIZE,
            start_new_session=True,  # Ctrl-C is not for it
        )
        self._process = process
        try:
            self._hand_over(process)
            last = await self._read(process)
        finally:
            self._process, self._said = None, {}
            await _end(process)
        if self._is_ending:
            return ""
        return f"ended with {process.returncode}{f': {last}' if last else ''}"

    def _hand_over(self, process: Process) -> None:
        """Tell it what is to be announced; the end of its input when nothing is."""
        assert process.stdin is not None
        if isinstance(self._wanted, str):
            self._said, self._is_ending = {}, True
            process.stdin.close()
        elif not self._is_ending:
            process.stdin.write(self._wanted.to_line())

    async def _read(self, process: Process) -> str:
        """Read what it says until its end; returns the last that was no report, such as an
        error."""
        assert process.stdout is not None
        last = ""
        while True:
            try:
                line = await process.stdout.readline()
            except ValueError:
                return f"it printed a line of more than {LINE_SIZE} bytes"
            if not line:
                return last
            said = report_of(line)
            if said is None:
                last = line.decode(errors="replace").strip()[:TEXT_SIZE]
                log.debug("the announcing program: %s", last)
            elif not isinstance(self._wanted, str):
                self._hear(said)
            await asyncio.sleep(LINE_INTERVAL)

    def _hear(self, said: dict[str, Any]) -> None:
        before, self._said, self._failure = self._said, said, ""
        if said["problem"] and said["problem"] != before.get("problem"):
            log.warning("mDNS: %s", said["problem"])
        if said["name"] and said != before:
            log.info("announced as %r on %s", said["name"], "; ".join(said["links"]))
        elif not said["name"] and not said["problem"]:
            log.info("mDNS: no network to be announced on")


def report_of(line: bytes) -> dict[str, Any] | None:
    """What a line of the program says, with as much of it as is allowed; None for anything else."""
    try:
        given = json.loads(line)
        name, there, problem = given["name"], given["links"], given["problem"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    texts = [name, problem, *there] if isinstance(there, list) else [None]
    if not all(isinstance(each, str) for each in texts):
        return None
    shown = [each[:TEXT_SIZE] for each in there[:LINKS]]
    return {"name": name[:TEXT_SIZE], "links": shown, "problem": problem[:TEXT_SIZE]}


async def _end(process: Process) -> None:
    """End its input, on which it says farewell; kill it when it does not end."""
    assert process.stdin is not None
    process.stdin.close()
    try:
        await _ended(process)
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    await _ended(process)


async def _ended(process: Process) -> None:
    """Wait for its end, for a while; it is not seen before all that it has printed is read."""
    assert process.stdout is not None
    with contextlib.suppress(asyncio.TimeoutError):
        async with timeout(FAREWELL):
            while await process.stdout.read(LINE_SIZE):
                pass
            await process.wait()
