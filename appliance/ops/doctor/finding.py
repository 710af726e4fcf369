"""What is said of one thing that was looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

Level: TypeAlias = Literal["ok", "warning", "problem"]


@dataclass(frozen=True, slots=True)
class Finding:
    """A thing, how it is, and what to do where it is not as it should be.

    A problem keeps something from working now; a warning may do so later, or is for somebody to
    judge.
    """

    level: Level
    subject: str
    text: str
    advice: str = ""
