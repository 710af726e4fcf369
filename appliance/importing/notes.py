"""What an import has to say: problems that end it, and notes on what is different here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

# Nobody reads more of them.
_MAX_PROBLEMS = 50


class Place(NamedTuple):
    """A line of a file, which is named as seen from the main file's directory."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


@dataclass(frozen=True, slots=True)
class Note:
    """Something that is not here as it is in mosquitto; `to_do` is what waits for a person."""

    place: Place
    subject: str
    text: str
    to_do: bool = False

    def __str__(self) -> str:
        return f"{self.place}: {self.subject}: {self.text}"


class ImportProblemsError(Exception):
    """Nothing was imported; the message has a line for each mistake."""

    def __init__(self, problems: list[tuple[Place, str]]) -> None:
        """A list that is longer than anybody reads is cut."""
        lines = [f"{place}: {text}" for place, text in problems[:_MAX_PROBLEMS]]
        if len(problems) > _MAX_PROBLEMS:
            lines.append(f"and {len(problems) - _MAX_PROBLEMS} more")
        super().__init__("\n".join(lines))


@dataclass
class Notes:
    """The notes of an import, in the order in which they were found."""

    found: list[Note] = field(default_factory=list)

    def add(self, place: Place, subject: str, text: str, *, to_do: bool = False) -> None:
        """Add a note, unless it has been said."""
        note = Note(place, subject, text, to_do)
        if note not in self.found:
            self.found.append(note)
