"""The parser of ACL files: mosquitto's grammar, extended by `include` and `{robot}`."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import Flag
from pathlib import Path
from typing import Final

from appliance.access.problems import AccessFileError, FileProblem, read_text
from appliance.mqtt.topics import check_filter, check_topic

_log = logging.getLogger(__name__)

# The white space of C's isspace(), which mosquitto trims. Python's strip() trims more.
BLANK: Final = " \t\n\v\f\r"
_KEYWORDS: Final = ("topic", "pattern", "user", "include")

# Limits of one file of rules with its included files: beyond these it is a mistake, such as the
# path of a log file. A rule takes some 500 bytes of memory.
_MAX_SIZE: Final = 4 * 1024 * 1024
_MAX_RULES: Final = 100_000
_MAX_DEPTH: Final = 16

# The most errors that are reported: nobody reads more of them.
_MAX_PROBLEMS: Final = 100

_TOO_MANY: Final = (
    f"more than {_MAX_RULES} rules, those of files counted for each user that they are included "
    "for; use patterns with %u for what is the same for all"
)


class Permission(Flag):
    """What a rule permits."""

    DENY = 0
    READ = 1
    WRITE = 2
    READWRITE = 3


_PERMISSIONS: Final = {
    "read": Permission.READ,
    "write": Permission.WRITE,
    "readwrite": Permission.READWRITE,
    "deny": Permission.DENY,
}


@dataclass(frozen=True, slots=True)
class Rule:
    """One `topic` or `pattern` line.

    `file` is named as seen from the directory of the ACL file, `text` is the line with `{robot}`
    replaced, and `user` is None in a pattern and in a rule for anonymous clients. `via` are the
    lines that include its file, the outermost first.
    """

    file: str
    line: int
    text: str
    permission: Permission
    filter: str
    user: str | None = None
    pattern: bool = False
    via: tuple[str, ...] = ()

    @property
    def denies(self) -> bool:
        """Whether the rule denies access."""
        return self.permission is Permission.DENY

    def gives(self, permission: Permission) -> bool:
        """Whether the rule gives this permission, READ or WRITE."""
        return self.permission is permission or self.permission is Permission.READWRITE

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text}"


def read_rules(path: Path, robot: str) -> tuple[list[Rule], frozenset[Path]]:
    """The rules of the file at `path` and of its included files, and the set of these files.

    `{robot}` is replaced. AccessFileError lists all errors; ValueError when `robot` cannot be part
    of a topic.
    """
    check_topic(robot)
    reader = _AclReader(path.parent, robot)
    reader.read(path)
    if reader.problems:
        raise AccessFileError(reader.problems)
    return reader.rules, frozenset(reader.files)


class _LineError(ValueError):
    """An error in a line, and its column, from 0."""

    def __init__(self, column: int, message: str) -> None:
        super().__init__(message)
        self.column = column


@dataclass(frozen=True, slots=True)
class _Line:
    """A line with a rule, with the user of the following rules, or with an included file."""

    number: int
    keyword: str
    rest: str
    #: The column of `rest`, from 0.
    column: int
    permission: Permission = Permission.DENY
    filter: str = ""
    text: str = ""


class _AclReader:
    """Reads an ACL file and its included files: collects all rules, and all errors."""

    def __init__(self, directory: Path, robot: str) -> None:
        """File names in rules are relative to `directory`."""
        self.problems: list[FileProblem] = []
        self.files: set[Path] = set()
        self._directory = directory
        self._robot = robot
        self._reported: set[FileProblem] = set()
        self._lines: dict[Path, list[_Line | FileProblem]] = {}
        #: By file, line and user, so that a rule counts once however often it is included.
        self._rules: dict[tuple[Path, int, str | None], Rule] = {}
        self._read: set[tuple[Path, str | None]] = set()

    @property
    def rules(self) -> list[Rule]:
        """The rules in the order in which they were read."""
        return list(self._rules.values())

    def read(
        self,
        path: Path,
        user: str | None = None,
        including: tuple[Path, ...] = (),
        via: tuple[str, ...] = (),
    ) -> None:
        """Read the file at `path`, for `user` up to its own first `user` line.

        This makes a file of rules a group: each user for whom it is included has its rules. The
        including file then continues with its own user. `including` are the files of the chain of
        includes, and `via` their lines.
        """
        self.files.add(path)
        file = path.resolve()
        if (file, user) in self._read:
            return
        self._read.add((file, user))
        name = self._name(path)
        for line in self._parse(path, file):
            if isinstance(line, FileProblem):
                self._report(line)
                continue
            try:
                if line.keyword == "user":
                    user = line.rest
                elif line.keyword == "include":
                    where = f"{name}:{line.number}"
                    self._include(path, line, user, (*including, path), (*via, where))
                else:
                    self._add(file, name, line, user, via)
            except _LineError as mistake:
                self._report(FileProblem(path, line.number, mistake.column + 1, str(mistake)))

    def _name(self, path: Path) -> str:
        below = path.is_relative_to(self._directory)
        return str(path.relative_to(self._directory) if below else path)

    def _report(self, problem: FileProblem) -> None:
        # A group's file is read for each of its users.
        if problem not in self._reported and len(self._reported) < _MAX_PROBLEMS:
            self._reported.add(problem)
            self.problems.append(problem)

    def _add(
        self, file: Path, name: str, line: _Line, user: str | None, via: tuple[str, ...]
    ) -> None:
        pattern = line.keyword == "pattern"
        key = file, line.number, None if pattern else user
        if key in self._rules:
            return
        if len(self._rules) >= _MAX_RULES:
            if not any(problem.message == _TOO_MANY for problem in self.problems):
                raise _LineError(0, _TOO_MANY)
            return
        self._rules[key] = Rule(
            name,
            line.number,
            line.text,
            line.permission,
            line.filter,
            None if pattern else user,
            pattern,
            via,
        )

    def _include(
        self,
        path: Path,
        line: _Line,
        user: str | None,
        including: tuple[Path, ...],
        via: tuple[str, ...],
    ) -> None:
        included = path.parent / line.rest
        if not included.is_file():
            raise _LineError(line.column, f"there is no file {included} to include")
        if included.resolve() in (file.resolve() for file in including):
            way = " → ".join(file.name for file in (*including, included))
            raise _LineError(line.column, f"a file must not include itself: {way}")
        if len(including) > _MAX_DEPTH:
            way = " → ".join(file.name for file in (*including, included))
            raise _LineError(line.column, f"files include each other too deep: {way}")
        self.read(included, user, including, via)

    def _parse(self, path: Path, file: Path) -> list[_Line | FileProblem]:
        """The lines of a file, parsed once however often it is included."""
        if file in self._lines:
            return self._lines[file]
        lines = self._lines[file] = []
        try:
            advice = "make it, as `appliance init` does, or name another in appliance.yaml"
            text = read_text(path, advice, _MAX_SIZE)
        except AccessFileError as error:
            lines += error.problems
            return lines
        with suppress(OSError):
            if path.stat().st_mode & 0o002:
                _log.warning(
                    "%s can be changed by every user of this computer; close it with: chmod o-w %s",
                    path,
                    path,
                )
        for number, raw in enumerate(text.split("\n"), 1):
            line = raw.rstrip(BLANK)
            if not line or line[0] == "#":
                continue
            try:
                lines.append(self._parse_line(number, line))
            except _LineError as mistake:
                lines.append(FileProblem(path, number, mistake.column + 1, str(mistake)))
        return lines

    def _parse_line(self, number: int, line: str) -> _Line:
        column = _skip(line, 0)
        keyword = line[column:].partition(" ")[0]
        _check_keyword(keyword, column)
        start = _skip(line, column + len(keyword))
        rest = line[start:].lstrip(BLANK)
        if not rest:
            what = {"user": "a user name", "include": "a file"}.get(keyword, "a filter")
            raise _LineError(start, f"{what} is missing after {keyword!r}")
        if keyword in ("user", "include"):
            return _Line(number, keyword, rest, start)
        permission, filter = self._clause(line, start, keyword == "pattern")
        text = line.strip(" ").replace("{robot}", self._robot)
        return _Line(number, keyword, rest, start, permission, filter, text)

    def _clause(self, line: str, start: int, pattern: bool) -> tuple[Permission, str]:
        """What follows `topic` or `pattern` from column `start` on: [access] filter."""
        word, _, rest = line[start:].partition(" ")
        filter = rest.lstrip(BLANK)
        if filter:
            permission = _PERMISSIONS.get(word)
            if permission is None:
                text = _unknown("access", word, _PERMISSIONS)
                if not _near(word, _PERMISSIONS):
                    text += "; a filter with a space in it needs the access before it"
                raise _LineError(start, text)
        else:
            permission, filter = Permission.READWRITE, word
        column = len(line) - len(filter)
        if pattern:
            for level in filter.split("/"):
                if level not in ("%c", "%u") and ("%c" in level or "%u" in level):
                    raise _LineError(
                        column, f"%c and %u must be alone in their level, not {level!r}"
                    )
                column += len(level) + 1
            column = len(line) - len(filter)
        filter = filter.replace("{robot}", self._robot)
        try:
            check_filter(filter)
        except ValueError as error:
            text = f"{filter!r}: {error}"
            if " #" in filter:
                text += "; a comment needs a line of its own"
            raise _LineError(column, text) from None
        return permission, filter


def _skip(line: str, column: int) -> int:
    """The column of what follows the spaces at `column`."""
    return len(line) - len(line[column:].lstrip(" "))


def _check_keyword(keyword: str, column: int) -> None:
    if keyword in _KEYWORDS:
        return
    if "\t" in keyword:  # mosquitto does not take a tab for a space either.
        raise _LineError(column + keyword.index("\t"), "a tab; put spaces between the words")
    if keyword.startswith("#"):
        raise _LineError(column, "a comment begins in the first column")
    raise _LineError(column, _unknown("keyword", keyword, _KEYWORDS))


def _near(word: str, known: Iterable[str]) -> list[str]:
    """The one of them that was meant, if any."""
    return difflib.get_close_matches(word.lower(), known, 1)


def _unknown(what: str, word: str, known: Iterable[str]) -> str:
    known = list(known)
    near = _near(word, known)
    advice = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
    return f"unknown {what} {word!r}; {advice}"
