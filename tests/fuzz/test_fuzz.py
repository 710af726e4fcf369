"""Seconds of what `python tests/fuzz` does for minutes, with other seeds."""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Callable
from pathlib import Path

import codec
import pytest
import sessions
import states
import strangers
from codec import Found

SECONDS = 4.0


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> None:
    """What is refused is told in the log, by the ten thousand."""
    caplog.set_level(logging.CRITICAL, "appliance")  # until the test ends


@pytest.mark.parametrize("one_case", [codec.one_case, states.one_case], ids=["codec", "states"])
def test_in_this_process(one_case: Callable[[random.Random], None]) -> None:
    end = time.monotonic() + SECONDS
    seed = 0
    while time.monotonic() < end:
        try:
            one_case(random.Random(seed))
        except Found as found:
            pytest.fail(f"seed {seed}: {found}\n" + "\n".join(map(repr, found.data)))
        seed += 1


@pytest.mark.parametrize("kind", [sessions.Siege, strangers.Strangers])
def test_sessions(kind: type[sessions.Siege], tmp_path: Path) -> None:
    for seconds in (SECONDS, 4 * SECONDS):  # a busy computer makes fewer
        siege = kind(tmp_path / str(seconds))
        try:
            siege.run(random.Random(0), seconds)
        except Found as found:
            pytest.fail(f"{found}\n" + "\n\n".join(data.decode() for data in found.data[-5:]))
        if siege.count > 100 and siege.canary.heard > 100:
            break
    assert siege.count > 100
    assert siege.canary.heard == siege.canary.sent > 100
