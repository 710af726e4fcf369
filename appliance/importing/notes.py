"""What an import has to say: problems that end it, and notes on what is different here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

# Nobody reads more of them, or longer ones: a file may name a path of a megabyte.
_MAX_PROBLEMS = 50
_MAX_LENGTH = 400


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
        return _short(f"{self.place}: {self.subject}: {self.text}")


def _short(line: str) -> str:
    """A line without its middle, where it is longer than anybody reads."""
    if len(line) <= _MAX_LENGTH:
        return line
    half = _MAX_LENGTH // 2
    return f"{line[:half]} … {line[-half:]}"


class ImportProblemsError(Exception):
    """Nothing was imported; the message has a line for each mistake."""

    def __init__(self, problems: list[tuple[Place, str]]) -> None:
        """A list that is longer than anybody reads is cut, in the message."""
        self.problems = problems
        lines = [_short(f"{place}: {text}") for place, text in problems[:_MAX_PROBLEMS]]
        if len(problems) > _MAX_PROBLEMS:
            lines.append(f"and {len(problems) - _MAX_PROBLEMS} more")
        super().__init__("\n".join(lines))


@dataclass
class Notes:
    """The notes of an import, in the order in which they were found."""

    _found: dict[Note, None] = field(default_factory=dict)

    @property
    def found(self) -> list[Note]:
        """All of them."""
        return list(self._found)

    def add(self, place: Place, subject: str, text: str, *, to_do: bool = False) -> None:
        """Add a note, unless it has been said."""
        self._found.setdefault(Note(place, subject, text, to_do))
