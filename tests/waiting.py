"""Waiting for what is about to happen, on however slow a computer, and saying what did not."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import Callable

#: Seconds for what takes milliseconds, on one core that busy programs share with the test.
PATIENCE = 60.0

#: Characters that a failure says of each thing that the condition looked at.
LONGEST_VALUE = 300


def missing(condition: Callable[[], object], what: str, timeout: float) -> str:
    """What was waited for, and what there was instead: the condition's own words and variables."""
    closure = inspect.getclosurevars(condition)
    had = [f"{name} = {value!r:.{LONGEST_VALUE}}" for name, value in closure.nonlocals.items()]
    try:
        words = " ".join(inspect.getsource(condition).split())
    except (OSError, TypeError):  # it was not written as a function in a file
        words = repr(condition)
    return "\n  ".join([f"not within {timeout:g} s: {what or words}", words, *had])


async def until(condition: Callable[[], object], what: str = "", timeout: float = PATIENCE) -> None:
    """Return when the condition holds; AssertionError says what did not come true."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, missing(condition, what, timeout)
        await asyncio.sleep(0.005)


def eventually(condition: Callable[[], object], what: str = "", timeout: float = PATIENCE) -> None:
    """`until`, where there is no event loop."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, missing(condition, what, timeout)
        time.sleep(0.01)
