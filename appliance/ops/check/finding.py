"""What is said of one thing that was looked at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """What was looked at and what is to be said about it; an error keeps `run`, or a part of it,
    from working."""

    level: Literal["ok", "warning", "error"]
    subject: str
    text: str
