"""What `appliance check` and `appliance doctor` report: one finding for each thing examined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

#: An error keeps `appliance run`, or a part of it, from working now. A warning may do so later, or
#: is for a person to judge.
Level: TypeAlias = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What was examined, its state, and what to do when that is not ok."""

    level: Level
    subject: str
    text: str
    advice: str = ""
