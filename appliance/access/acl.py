"""The ACL file: mosquitto's grammar and meaning, and `include`, `{robot}` and SUBSCRIBE beyond."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import Flag
from itertools import zip_longest
from pathlib import Path
from typing import Final

from appliance.broker.ports import Action, Decision, Identity
from appliance.mqtt.topics import check_filter, check_topic, matches, overlaps, parse_shared

from .problems import AccessFileError, Problem, read_text

# What C's isspace() takes for white space, and mosquitto trims. Python's strip() takes more.
_BLANK: Final = " \t\n\v\f\r"
_KEYWORDS: Final = ("topic", "pattern", "user", "include")

# Bounds of what one file of rules, and all that it includes, can be: beyond these it is a mistake,
# such as a log that was named in its place. A rule takes some 500 bytes of memory.
_MAX_SIZE: Final = 4 * 1024 * 1024
_MAX_RULES: Final = 100_000
_MAX_DEPTH: Final = 16

# Mistakes that are told of: nobody reads more of them.
_MAX_PROBLEMS: Final = 100

_TOO_MANY: Final = (
    f"more than {_MAX_RULES} rules, those of files counted for each user that they are included "
    "for; use patterns with %u for what is the same for all"
)

_UNFIT: Final = "a name that is empty or holds +, # or / cannot be put in"

# Rules of which it is quicker to look at each than to search for the right ones.
_FEW: Final = 4

# A level that no rule can name, as no filter may hold U+0000 [MQTT-4.7.3-2].
_FRESH: Final = "\0"


class Permission(Flag):
    """What a rule gives; DENY takes."""

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

_ONLY: Final = {Permission.READ: "gives read only", Permission.WRITE: "gives write only"}

# What an action needs. To subscribe is to ask for what can be read.
_NEEDED: Final = {
    Action.PUBLISH: Permission.WRITE,
    Action.SUBSCRIBE: Permission.READ,
    Action.RECEIVE: Permission.READ,
}
_VERBS: Final = {
    Action.PUBLISH: "write",
    Action.SUBSCRIBE: "subscribe to",
    Action.RECEIVE: "read",
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
        """Whether it takes, and does not give."""
        return self.permission is Permission.DENY

    def gives(self, permission: Permission) -> bool:
        """Whether it gives this, READ or WRITE."""
        return self.permission is permission or self.permission is Permission.READWRITE

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.text}"


class _Level:
    """A level of the filters of rules: those that end with it, and what comes below."""

    __slots__ = ("below", "places")

    def __init__(self) -> None:
        self.below: dict[str, _Level] = {}
        self.places: list[int] = []


class _Group:
    """Rules in the order in which they count: what denies comes first.

    They are also a tree of their filters, so that of a long file only those few rules are looked at
    that may say something about a topic: a decision must not take longer the more rules there are.
    """

    def __init__(self, rules: Iterable[Rule] = ()) -> None:
        self.rules = sorted(rules, key=lambda rule: not rule.denies)  # It keeps the order else.
        self._root = _Level()
        self._always: list[int] = []
        for place, rule in enumerate(self.rules):
            levels = rule.filter.split("/")
            named = rule.pattern and ("%c" in levels or "%u" in levels)
            if named and rule.denies:  # With a name that cannot be put in it denies everything.
                self._always.append(place)
                continue
            level = self._root
            for name in levels:
                key = "+" if named and name in ("%c", "%u") else name
                level = level.below.setdefault(key, _Level())
            level.places.append(place)

    def about(self, filter: str) -> list[Rule]:
        """At least all rules that may match some topic of `filter`, or the topic that it is."""
        if len(self.rules) <= _FEW:
            return self.rules
        found = list(self._always)
        reached = [self._root]
        for name in filter.split("/"):
            if name == "#":
                while reached:
                    level = reached.pop()
                    found += level.places
                    reached += level.below.values()
                break
            above, reached = reached, []
            for level in above:
                below = level.below
                if "#" in below:
                    found += below["#"].places
                if name == "+":
                    reached += below.values()
                    continue
                if name in below:
                    reached.append(below[name])
                if "+" in below:
                    reached.append(below["+"])
        for level in reached:
            found += level.places
            if "#" in level.below:  # `a/#` matches `a` too.
                found += level.below["#"].places
        return [self.rules[place] for place in sorted(set(found))]


@dataclass(frozen=True, slots=True)
class _Applied:
    """A rule as it is for one client. `filter` is None when a name cannot be put into it.

    A rule that allows then allows nothing, and one that denies denies everything: what it was to
    protect cannot be told.
    """

    rule: Rule
    filter: str | None

    def matches(self, topic: str) -> bool:
        if self.filter is None:
            return self.rule.denies
        return matches(self.filter, topic)

    def overlaps(self, filter: str) -> bool:
        if self.filter is None:
            return self.rule.denies
        return overlaps(self.filter, filter)

    def __str__(self) -> str:
        return str(self.rule) if self.filter is not None else f"{self.rule} ({_UNFIT})"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is decided about one action, by which rule, and why the rules before it were not it.

    `rule` is None when no rule says anything: then it is refused.
    """

    action: Action
    allowed: bool
    rule: Rule | None
    reason: str
    passed_over: tuple[tuple[Rule, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Explanation:
    """What a client may do with a topic, or a filter, and why; printed as lines of text."""

    identity: Identity
    topic: str
    verdicts: tuple[Verdict, ...]

    def __str__(self) -> str:
        lines = [f"{_who(self.identity)}, {self.topic!r}:"]
        for verdict in self.verdicts:
            answer = "allowed" if verdict.allowed else "refused"
            verb = _VERBS[verdict.action].partition(" ")[0]
            lines.append(f"  {verb:<9}  {answer}  {verdict.reason}")
            if verdict.rule is not None and verdict.rule.via:
                lines.append(f"             included by  {', then '.join(verdict.rule.via)}")
            for rule, why in verdict.passed_over:
                lines.append(f"             passed over  {rule}  ({why})")
        return "\n".join(lines)


class Acl:
    """The rules of an ACL file and of those that it includes. It never changes once loaded.

    A client's own rules come first (those of its user, or of anonymous clients), then the
    patterns; of both, those that deny come first. The first that matches and says something about
    the action decides, and what none decides is refused.
    """

    def __init__(self, name: str, rules: Iterable[Rule]) -> None:
        """`name` is what the file is called in reasons."""
        self._name = name
        own: dict[str | None, list[Rule]] = {}
        patterns: list[Rule] = []
        for rule in rules:
            if rule.pattern:
                patterns.append(rule)
            else:
                own.setdefault(rule.user, []).append(rule)
        self._own = {user: _Group(group) for user, group in own.items()}
        self._patterns = _Group(patterns)

    @classmethod
    def load(cls, path: Path, robot: str) -> Acl:
        """The rules of the file at `path`, `{robot}` replaced by `robot`.

        AccessFileError names all that is wrong, in included files too; ValueError when `robot`
        cannot stand in a topic.
        """
        check_topic(robot)
        reader = _Reader(path.parent, robot)
        reader.read(path)
        if reader.problems:
            raise AccessFileError(reader.problems)
        return cls(path.name, reader.rules)

    @property
    def rules(self) -> list[Rule]:
        """All rules: each user's, then the patterns, what denies before what allows."""
        return [rule for group in (*self._own.values(), self._patterns) for rule in group.rules]

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Whether the client may do this; `topic` is valid, and a filter for SUBSCRIBE.

        A subscription is refused when no message could ever be delivered because of it. Of
        `$share/group/filter` the filter counts.
        """
        shared = parse_shared(topic) if action is Action.SUBSCRIBE else None
        rules = self._applied(identity, shared[1] if shared is not None else topic)
        verdict = self._verdict(identity, action, topic, rules)
        return Decision(verdict.allowed, verdict.reason)

    def explain(self, identity: Identity, topic: str) -> Explanation:
        """Why the client may or may not read, write and subscribe; of a filter only the last.

        ValueError when `topic` is neither a valid topic nor a valid filter.
        """
        if parse_shared(topic) is None:
            check_filter(topic)
        actions = [Action.SUBSCRIBE]
        if not topic.startswith("$share/") and "+" not in topic and "#" not in topic:
            actions[:0] = [Action.RECEIVE, Action.PUBLISH]
        verdicts = (
            self._verdict(identity, action, topic, self._applied(identity)) for action in actions
        )
        return Explanation(identity, topic, tuple(verdicts))

    def _verdict(
        self, identity: Identity, action: Action, topic: str, rules: Iterable[_Applied]
    ) -> Verdict:
        if action is Action.SUBSCRIBE:
            return self._subscribe(identity, topic, list(rules))
        needed = _NEEDED[action]
        passed: list[tuple[Rule, str]] = []
        for applied in rules:
            rule = applied.rule
            if not (rule.denies or rule.gives(needed)):
                passed.append((rule, _ONLY[rule.permission]))
            elif applied.matches(topic):
                return Verdict(action, not rule.denies, rule, str(applied), tuple(passed))
            else:
                passed.append((rule, "does not match" if applied.filter is not None else _UNFIT))
        return Verdict(action, False, None, self._silence(identity, action, topic), tuple(passed))

    def _subscribe(self, identity: Identity, filter: str, rules: Sequence[_Applied]) -> Verdict:
        action = Action.SUBSCRIBE
        shared = parse_shared(filter)
        wanted = shared[1] if shared is not None else filter
        denying = [deny for deny in rules if deny.rule.denies and deny.overlaps(wanted)]
        depth = max((deny.filter.count("/") + 1 for deny in denying if deny.filter), default=0)
        passed: list[tuple[Rule, str]] = []
        denied_by: _Applied | None = None
        for applied in rules:
            rule = applied.rule
            if rule.denies:
                continue
            if not rule.gives(Permission.READ):
                passed.append((rule, _ONLY[rule.permission]))
            elif applied.filter is None:
                passed.append((rule, _UNFIT))
            elif not applied.overlaps(wanted):
                passed.append((rule, "shares no topic with the filter"))
            else:
                for topic in _samples(wanted, applied.filter, depth + 1):
                    # The client's own rules come before the patterns that deny.
                    denied_by = next(
                        (
                            deny
                            for deny in denying
                            if (rule.pattern or not deny.rule.pattern) and deny.matches(topic)
                        ),
                        None,
                    )
                    if denied_by is None:
                        return Verdict(action, True, rule, str(rule), tuple(passed))
                passed.append((rule, f"all that it gives there is denied by {denied_by}"))
        if denied_by is not None:
            return Verdict(action, False, denied_by.rule, str(denied_by), tuple(passed))
        return Verdict(action, False, None, self._silence(identity, action, filter), tuple(passed))

    def _applied(self, identity: Identity, about: str | None = None) -> Iterator[_Applied]:
        """The rules for a client, in the order in which they count.

        With `about`, a topic or filter, those that have nothing to do with it may be left out.
        """
        own = self._own.get(identity.username)
        if own is not None:
            for rule in own.rules if about is None else own.about(about):
                yield _Applied(rule, rule.filter)
        patterns = self._patterns
        for rule in patterns.rules if about is None else patterns.about(about):
            if identity.username is None and "%u" in rule.filter:
                continue
            filter = _substitute(rule.filter, identity)
            # A client named $SYS gets nothing of $SYS from `%c/#`: `$` must be in the file.
            if filter is None or filter[0] != "$" or rule.filter[0] == "$":
                yield _Applied(rule, filter)

    def _silence(self, identity: Identity, action: Action, topic: str) -> str:
        return f"{self._name}: no rule lets {_who(identity)} {_VERBS[action]} {topic!r}"


def _who(identity: Identity) -> str:
    if identity.username is None:
        return "an anonymous client"
    return f"user {identity.username!r}"


def _substitute(filter: str, identity: Identity) -> str | None:
    """The filter of a pattern for one client; None when a name in it would change its levels."""
    if "%" not in filter:
        return filter
    names = {"%c": identity.client_id, "%u": identity.username}
    levels = filter.split("/")
    for index, level in enumerate(levels):
        if level in names:
            name = names[level]
            if not name or any(c in name for c in "+#/"):
                return None
            levels[index] = name
    return "/".join(levels)


def _samples(a: str, b: str, depth: int) -> Iterator[str]:
    """Topics for all that two overlapping filters share: one of each length up to `depth` levels.

    What a wildcard stands for is a level that no rule names. So a rule that matches a sample does
    so with wildcards, and matches all shared topics of that length; beyond the depth of the
    deepest rule one length is like the other.
    """
    levels_a, levels_b = a.split("/"), b.split("/")
    open_ended = levels_a[-1] == levels_b[-1] == "#"
    for levels in (levels_a, levels_b):
        if levels[-1] == "#":
            levels.pop()
    shared = [
        x if x != "+" else y if y != "+" else _FRESH
        for x, y in zip_longest(levels_a, levels_b, fillvalue="+")
    ]
    more = max(1, depth - len(shared)) if open_ended else 0
    for extra in range(more + 1):
        topic = "/".join(shared + [_FRESH] * extra)
        if topic:
            yield topic


class _LineError(ValueError):
    """What is wrong in a line, and in which column, from 0."""

    def __init__(self, column: int, message: str) -> None:
        super().__init__(message)
        self.column = column


@dataclass(frozen=True, slots=True)
class _Line:
    """A line that says something: a rule, the user that the next ones are for, or a file."""

    number: int
    keyword: str
    rest: str
    #: Where `rest` begins, from 0.
    column: int
    permission: Permission = Permission.DENY
    filter: str = ""
    text: str = ""


class _Reader:
    """Reads an ACL file and those that it includes: all rules, and all that is wrong."""

    def __init__(self, directory: Path, robot: str) -> None:
        """File names of rules are as seen from `directory`."""
        self.problems: list[Problem] = []
        self._directory = directory
        self._robot = robot
        self._told: set[Problem] = set()
        self._lines: dict[Path, list[_Line | Problem]] = {}
        #: By file, line and user, so that nothing counts twice however often it is included.
        self._rules: dict[tuple[Path, int, str | None], Rule] = {}
        self._read: set[tuple[Path, str | None]] = set()

    @property
    def rules(self) -> list[Rule]:
        """The rules in the order in which they were found."""
        return list(self._rules.values())

    def read(
        self,
        path: Path,
        user: str | None = None,
        including: tuple[Path, ...] = (),
        via: tuple[str, ...] = (),
    ) -> None:
        """Reads the file at `path`, for `user` up to its own first `user` line.

        That is how a file of rules is a group: each user that it is included for has its rules.
        The file that includes it goes on with the user that it had. `including` are the files that
        led here, and `via` the lines.
        """
        file = path.resolve()
        if (file, user) in self._read:
            return
        self._read.add((file, user))
        name = self._name(path)
        for line in self._parse(path, file):
            if isinstance(line, Problem):
                self._complain(line)
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
                self._complain(Problem(path, line.number, mistake.column + 1, str(mistake)))

    def _name(self, path: Path) -> str:
        below = path.is_relative_to(self._directory)
        return str(path.relative_to(self._directory) if below else path)

    def _complain(self, problem: Problem) -> None:
        # A group's file is gone through for each of its users.
        if problem not in self._told and len(self._told) < _MAX_PROBLEMS:
            self._told.add(problem)
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

    def _parse(self, path: Path, file: Path) -> list[_Line | Problem]:
        """The lines of a file, looked at once, however often it is included."""
        if file in self._lines:
            return self._lines[file]
        lines = self._lines[file] = []
        try:
            text = read_text(path, "make it, or name another in appliance.yaml", _MAX_SIZE)
        except AccessFileError as error:
            lines += error.problems
            return lines
        for number, raw in enumerate(text.split("\n"), 1):
            line = raw.rstrip(_BLANK)
            if not line or line[0] == "#":
                continue
            try:
                lines.append(self._parse_line(number, line))
            except _LineError as mistake:
                lines.append(Problem(path, number, mistake.column + 1, str(mistake)))
        return lines

    def _parse_line(self, number: int, line: str) -> _Line:
        column = _skip(line, 0)
        keyword = line[column:].partition(" ")[0]
        _check_keyword(keyword, column)
        start = _skip(line, column + len(keyword))
        rest = line[start:].lstrip(_BLANK)
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
        filter = rest.lstrip(_BLANK)
        if filter:
            permission = _PERMISSIONS.get(word)
            if permission is None:
                hint = "a filter with a space in it needs the access before it"
                raise _LineError(start, _unknown("access", word, _PERMISSIONS) + f"; {hint}")
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
            raise _LineError(column, f"{filter!r}: {error}") from None
        return permission, filter


def _skip(line: str, column: int) -> int:
    """The column of what follows the spaces at `column`."""
    return len(line) - len(line[column:].lstrip(" "))


def _check_keyword(keyword: str, column: int) -> None:
    if keyword in _KEYWORDS:
        return
    if "\t" in keyword:  # mosquitto takes no tab for a space either.
        raise _LineError(column + keyword.index("\t"), "a tab; put spaces between the words")
    if keyword.startswith("#"):
        raise _LineError(column, "a comment begins in the first column")
    raise _LineError(column, _unknown("keyword", keyword, _KEYWORDS))


def _unknown(what: str, word: str, known: Iterable[str]) -> str:
    known = list(known)
    near = difflib.get_close_matches(word.lower(), known, 1)
    advice = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
    return f"unknown {what} {word!r}; {advice}"
