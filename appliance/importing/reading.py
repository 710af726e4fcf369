"""Reads mosquitto.conf with the files of its include_dir: lines become checked statements."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path

from appliance.access.problems import AccessFileError, read_text
from appliance.importing.notes import ImportProblemsError, Notes, Place
from appliance.importing.options import OPTIONS, PLUGIN_PREFIXES, Kind, option_of

_MAX_SIZE = 1 << 20  # of a file: mosquitto's commented example has 40 KiB
_MAX_FILES = 1000
_MAX_LINE = 70_000  # more than a topic has, the longest value there is
_HEAD_SIZE = 4096
_FLAGS = {"true": True, "1": True, "false": False, "0": False}
_NUMBER_DIGITS = 15
#: Options whose file says who may do what: another computer's would be a mistake with results.
_OF_ACCESS = ("include_dir", "password_file", "acl_file")


@dataclass(frozen=True, slots=True)
class Statement:
    """A line: an option and its value, as `Kind` says."""

    place: Place
    name: str
    value: str

    @property
    def flag(self) -> bool:
        """The value of a flag."""
        return _FLAGS[self.value]

    @property
    def number(self) -> int:
        """The value of a number."""
        return int(self.value)


def locate(statement: Statement, directory: Path, notes: Notes) -> Path | None:
    """The file, or folder of an include_dir, that it names; None if there is none.

    Relative paths are relative to `directory`. A configuration that was copied from another
    computer or out of a container has whole paths of there: then it is what lies beside the
    configuration by the end of its path. Raises ImportProblemsError where this computer has one
    under the path as well: taken for the other, the rules would be somebody else's, or none.
    """
    path = Path(statement.value)
    whole = directory / path
    if not path.is_absolute():
        return whole if _is_there(whole, statement) else None
    parts = path.parts[1:]
    ends = (directory.joinpath(*parts[start:]) for start in range(len(parts)))
    beside = next((end for end in ends if _is_there(end, statement)), None)
    if not _is_there(whole, statement):
        return beside
    if whole.is_relative_to(directory) or (beside is not None and whole.samefile(beside)):
        return whole
    if beside is not None:
        text = (
            f"names {whole}, which this computer has, and beside the configuration there is "
            f"{beside}. If that is meant, write {beside.relative_to(directory)}; if not, move it"
        )
        raise ImportProblemsError([(statement.place, f"{statement.name} {text}")])
    if statement.name in _OF_ACCESS:
        text = f"is {whole} of this computer: is that the one of the imported broker?"
        notes.add(statement.place, statement.name, text, to_do=True)
    return whole


def _is_there(path: Path, statement: Statement) -> bool:
    """Whether that is there, as far as this user may know, and of the kind that is named."""
    try:
        return path.is_dir() if statement.name == "include_dir" else path.is_file()
    except OSError:
        return False


def _resolved(path: Path) -> Path:
    """The file that it is; itself where its links lead nowhere, which reading it will tell."""
    try:
        return path.resolve()
    except (OSError, RuntimeError):  # RuntimeError: a circle, before Python 3.13
        return path.absolute()


def _is_binary(path: Path) -> bool:
    """Whether a file that is no UTF-8 is no text at all."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return b"\0" in file.read(_HEAD_SIZE)
    except OSError:
        return False


class Reader:
    """Reads the main file and those that it includes; collects all mistakes."""

    def __init__(self, main: Path, notes: Notes) -> None:
        """Names in places are relative to the directory of `main`."""
        self.directory = main.parent
        self.statements: list[Statement] = []
        self.problems: list[tuple[Place, str]] = []
        self._main = main
        self._notes = notes
        self._included: set[Path] = set()

    def read(self) -> list[Statement]:
        """All statements in mosquitto's order. Raises ImportProblemsError."""
        self._read(self._main, is_main=True)
        if self.problems:
            raise ImportProblemsError(self.problems)
        return self.statements

    def _read(self, path: Path, is_main: bool) -> None:
        place = Place(self._name(path), 0)
        if path.is_dir():
            self.problems.append((place, "is a directory; name the file in it"))
            return
        try:
            text = read_text(path, "name mosquitto's configuration file", _MAX_SIZE)
        except AccessFileError as error:
            if _is_binary(path):
                self.problems.append((place, "is a binary file, and no configuration"))
                return
            found = [(Place(place.file, each.line), each.message) for each in error.problems]
            self.problems += found
            return
        if "\0" in text:
            self.problems.append((place, "is a binary file, and no configuration"))
            return
        for number, line in enumerate(text.split("\n"), 1):
            if line.startswith("#"):
                continue
            if len(line) > _MAX_LINE:
                text = f"the line has {len(line)} characters, and no option is so long"
                self.problems.append((Place(place.file, number), text))
            else:
                self._statement(Place(place.file, number), line.rstrip("\r"), is_main)

    def _statement(self, place: Place, line: str, is_main: bool) -> None:
        name, _, rest = line.strip(" ").partition(" ")
        if not name.strip():
            return
        option = option_of(name)
        if option is None:
            self.problems.append((place, _unknown(name)))
            return
        try:
            value = _value(option.kind, rest)
            if option.choices and value not in option.choices:
                raise ValueError(f"is one of {', '.join(option.choices)}")
        except ValueError as error:
            self.problems.append((place, f"{name} {error}"))
            return
        statement = Statement(place, name, value)
        self.statements.append(statement)
        if name == "include_dir":
            self._include(statement, is_main)

    def _include(self, statement: Statement, is_main: bool) -> None:
        place = statement.place
        if not is_main:
            text = "mosquitto 2.0 does not read it here, only in the main file; nor is it read now"
            self._notes.add(place, "include_dir", text)
            return
        try:
            folder = locate(statement, self.directory, self._notes)
            if folder is None:
                text = (
                    f"include_dir: there is no folder {statement.value} here, and what it has may "
                    "say who is let in: copy it beside the file, or take this line out"
                )
                self.problems.append((place, text))
                return
            found = [each for each in folder.iterdir() if each.name.endswith(".conf")]
        except ImportProblemsError as error:
            self.problems += error.problems
            return
        except OSError as error:
            self.problems.append((place, f"include_dir cannot be read: {error.strerror}"))
            return
        if not found:
            text = f"{folder} has no file that ends in .conf, so nothing is read from there"
            if not folder.is_relative_to(self.directory):
                text += ": copy the imported broker's beside the file, or take this line out"
                self.problems.append((place, f"include_dir {text}"))
            self._notes.add(place, "include_dir", text)
        for file in sorted(
            found, key=lambda each: [(letter.lower(), letter) for letter in each.name]
        ):
            resolved = _resolved(file)
            if resolved == self._main.resolve():
                text = f"has {file.name} in it, which would include itself: move that file"
                self.problems.append((place, f"include_dir {text}"))
            elif resolved in self._included:
                self.problems.append((place, f"{self._name(file)} is included a second time"))
            elif len(self._included) >= _MAX_FILES:
                self.problems.append((place, f"include_dir has more than {_MAX_FILES} files"))
                return
            else:
                self._included.add(resolved)
                self._read(file, is_main=False)

    def _name(self, path: Path) -> str:
        try:
            return str(path.relative_to(self.directory))
        except ValueError:
            return str(path)


def _value(kind: Kind, rest: str) -> str:
    """The checked value. Raises ValueError with what follows the option's name."""
    value = rest.strip(" \t")
    if not value:
        raise ValueError("has no value")
    if kind in ("text", "secret"):
        return value
    first = value.split()[0]
    if kind == "flag" and first not in _FLAGS:
        raise ValueError(f"is true or false, not {first!r}")
    if kind == "number":
        if not re.fullmatch(r"-?[0-9]+", first):
            raise ValueError(f"is a number, not {first!r}")
        if len(first) > _NUMBER_DIGITS:
            raise ValueError("is too large a number")
    return first


def words(text: str) -> list[str]:
    """The words before a comment."""
    found = text.split()
    end = next((index for index, word in enumerate(found) if word.startswith("#")), len(found))
    return found[:end]


def _unknown(name: str) -> str:
    """What to say of an option that mosquitto does not have; it may be somebody's text."""
    shown = name if len(name) <= 40 and name.isprintable() else f"{name[:40]!r}…"
    if name.startswith("#"):
        return "a comment has its # in the first column"
    close = difflib.get_close_matches(name, OPTIONS, 1)
    hint = f"; did you mean {close[0]}?" if close else ""
    if name.startswith(PLUGIN_PREFIXES):
        hint = ""
    return f"mosquitto has no option {shown}{hint}"
