"""The decisions of an ACL file: mosquitto's semantics, extended to SUBSCRIBE."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Final

from appliance.access.rules import Permission, Rule, read_rules
from appliance.broker.values import Action, Decision, Identity
from appliance.mqtt.codec import quote
from appliance.mqtt.topics import check_filter, matches, overlaps, parse_shared

_UNFIT: Final = "a name that is empty or holds +, # or / cannot be put in"
_WILD: Final = "who has + or # in the user name or client id gets nothing from patterns"

# Up to so many rules a linear scan is faster than a search in the tree.
_FEW: Final = 4

# Levels of the trees below that are passed in the time of one unit of `Counters.cost`.
_LEVELS_PER_COST_UNIT: Final = 16

# A level that no rule can name, as no filter may hold U+0000 [MQTT-4.7.3-2].
_FRESH: Final = "\0"

# In a pattern the levels that are replaced by a client's names.
_NAMES: Final = ("%c", "%u")

_ONLY: Final = {Permission.READ: "gives read only", Permission.WRITE: "gives write only"}

# The permission that an action needs; a subscription needs the right to read.
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


class _Work:
    """What was looked at for a decision."""

    __slots__ = ("levels", "rules")

    def __init__(self) -> None:
        #: Rules that were looked at; one that two filters are compared for counts twice.
        self.rules = 0
        #: Levels of trees that were passed on the way to them.
        self.levels = 0

    @property
    def cost(self) -> int:
        """In units of `Counters.cost`."""
        return self.rules + self.levels // _LEVELS_PER_COST_UNIT


class _Level:
    """A node of the tree of filters: the rules that end here, and the levels below."""

    __slots__ = ("below", "places")

    def __init__(self) -> None:
        self.below: dict[str, _Level] = {}
        self.places: list[int] = []


class _Group:
    """Rules in the order in which they apply: those that deny come first.

    A tree of their filters finds the few rules that may match a topic, so that a decision does not
    take longer the more rules there are.
    """

    def __init__(self, rules: Iterable[Rule] = ()) -> None:
        self.rules = sorted(rules, key=lambda rule: not rule.denies)  # A stable sort.
        self._root = _Level()
        self._always: list[int] = []
        for place, rule in enumerate(self.rules):
            levels = rule.filter.split("/")
            named = rule.pattern and any(name in levels for name in _NAMES)
            if named and rule.denies:  # With an unfit name it denies everything.
                self._always.append(place)
                continue
            level = self._root
            for name in levels:
                key = "+" if named and name in _NAMES else name
                level = level.below.setdefault(key, _Level())
            level.places.append(place)

    def about(self, filter: str, work: _Work) -> list[Rule]:
        """A superset of the rules that match the topic, or some topic of the filter."""
        if len(self.rules) <= _FEW:
            return self.rules
        found = list(self._always)
        reached = [self._root]
        for name in filter.split("/"):
            if name == "#":
                while reached:
                    work.levels += 1
                    level = reached.pop()
                    found += level.places
                    reached += level.below.values()
                break
            above, reached = reached, []
            work.levels += len(above)
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
        work.levels += len(reached) + len(found)
        return [self.rules[place] for place in sorted(set(found))]


@dataclass(frozen=True, slots=True)
class _Applied:
    """A rule applied to one client. `filter` is None when a name cannot be substituted in it.

    A rule that allows then allows nothing, and a rule that denies denies everything, because it is
    unknown what it was to protect.
    """

    rule: Rule
    filter: str | None

    def matches(self, topic: str) -> bool:
        if self.filter is None:
            return self.rule.denies
        return matches(self.filter, topic)

    def why_passed(self, filter: str, otherwise: str) -> str:
        """Why the rule does not apply: the name only where another one could make it match."""
        if self.filter is not None:
            return otherwise
        if "%" not in self.rule.filter:
            return _WILD
        levels = self.rule.filter.split("/")
        could = "/".join("+" if name in _NAMES else name for name in levels)
        return _UNFIT if overlaps(could, filter) else otherwise

    def __str__(self) -> str:
        return str(self.rule) if self.filter is not None else f"{self.rule} ({_UNFIT})"


class _Denials:
    """Rules that deny, in the order in which they apply, for what is denied of a wide filter.

    They are a tree, so that each of many rules that allow is not compared with each of them.
    """

    def __init__(self, work: _Work) -> None:
        self._work = work
        self._rules: list[_Applied] = []
        self._root = _Level()
        #: The first of those that deny everything.
        self._everything: int | None = None

    def add(self, rule: _Applied) -> None:
        """Add a rule that denies, which applies after those that were added before."""
        place = len(self._rules)
        self._rules.append(rule)
        if rule.filter is None:
            if self._everything is None:
                self._everything = place
            return
        level = self._root
        for name in rule.filter.split("/"):
            below = level.below.get(name)
            if below is None:
                below = level.below[name] = _Level()
            level = below
        level.places.append(place)

    def of_all(self, a: str, b: str) -> _Applied | None:
        """The rule that denies the topics that two overlapping filters share; None if one of these
        topics is not denied.

        It is asked about one topic of each length. For a wildcard, that has a level that no rule
        names. So a rule that matches it does so with wildcards, and matches all shared topics of
        that length. Where no rule has so many levels, all greater lengths are equivalent; if
        different rules deny different lengths, the one that denies the greatest is returned.
        """
        shared, is_open_ended = _shared(a, b)
        nobody = len(self._rules)
        # The first rule that denies a topic which begins as those so far, of any greater length.
        lasting = nobody if self._everything is None else self._everything
        reached = [self._root]
        passed = 1 + 2 * len(shared)
        may_be_wild = not shared or shared[0][:1] != "$"  # [MQTT-4.7.2-1]
        for name in shared:
            above, reached = reached, []
            for level in above:
                below = level.below
                if name in below:
                    reached.append(below[name])
                if may_be_wild:
                    if "+" in below:
                        reached.append(below["+"])
                    if "#" in below and below["#"].places[0] < lasting:
                        lasting = below["#"].places[0]
            passed += len(reached)
            may_be_wild = True
        is_topic = shared not in ([], [""])  # a topic is never empty
        while True:
            denied_by = nobody
            for level in reached:
                if level.places and level.places[0] < denied_by:
                    denied_by = level.places[0]
                below = level.below
                if "#" in below and below["#"].places[0] < lasting:  # `a/#` matches `a` too.
                    lasting = below["#"].places[0]
            if lasting < denied_by:
                denied_by = lasting
            if denied_by == nobody and is_topic:
                break
            if not is_open_ended or (not reached and lasting < nobody):
                break
            # Longer by one level.
            reached = [level.below["+"] for level in reached if "+" in level.below]
            passed += 1 + len(reached)
            is_topic = True
        self._work.levels += passed
        return None if denied_by == nobody else self._rules[denied_by]


@dataclass(frozen=True, slots=True)
class ActionVerdict:
    """The decision about one action, the rule that made it, and why earlier rules did not apply.

    `rule` is None when no rule applies, and the action is refused.
    """

    action: Action
    allowed: bool
    rule: Rule | None
    reason: str
    passed_over: tuple[tuple[Rule, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Explanation:
    """What a client may do with a topic, or with a filter, and why; `str` gives lines of text."""

    identity: Identity
    topic: str
    verdicts: tuple[ActionVerdict, ...]

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


class _Received:
    """A cache of the decisions about receivers of one topic.

    A message may have thousands of receivers, and rules name a client only by a whole level of a
    topic. So the decision about one client of a user applies to all its clients whose ids are not a
    level of the topic, and separately to all whose ids cannot be substituted.
    """

    __slots__ = ("decisions", "levels", "topic")

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.levels = frozenset(topic.split("/"))
        #: By user, by whether the client id cannot be substituted, and whether that is for a
        #: wildcard in it.
        self.decisions: dict[tuple[str | None, bool, bool], Decision] = {}


class Acl:
    """The rules of an ACL file and its included files; immutable once loaded.

    A client's own rules come first (those of its user, or of anonymous clients), then the patterns;
    within both, rules that deny come first. The first rule that matches and concerns the action
    decides. Without one, the action is refused. Patterns give nothing to clients with + or # in a
    name, whether or not the name is put in, as in mosquitto.
    """

    def __init__(
        self, name: str, rules: Iterable[Rule], files: frozenset[Path] = frozenset()
    ) -> None:
        """`name` is the file's name in reasons, `files` are the file and its included files."""
        self._name = name
        self.files = files
        own: dict[str | None, list[Rule]] = {}
        patterns: list[Rule] = []
        for rule in rules:
            if rule.pattern:
                patterns.append(rule)
            else:
                own.setdefault(rule.user, []).append(rule)
        self._own = {user: _Group(group) for user, group in own.items()}
        self._patterns = _Group(patterns)
        self._received = _Received("")

    @classmethod
    def load(cls, path: Path, robot: str) -> Acl:
        """Load the file at `path`, with `{robot}` replaced by `robot`.

        AccessFileError lists all errors, also in included files; ValueError when `robot` cannot be
        part of a topic.
        """
        return cls(path.name, *read_rules(path, robot))

    @property
    def rules(self) -> list[Rule]:
        """All rules: each user's, then the patterns; in each group those that deny come first."""
        return [rule for group in (*self._own.values(), self._patterns) for rule in group.rules]

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """Whether the client may do this; `topic` is valid, and a filter for SUBSCRIBE.

        A subscription is refused when it could never deliver a message. Of `$share/group/filter`
        the filter is decided about.
        """
        if action is Action.RECEIVE:
            return self._decide_receive(identity, topic)
        return self._decide(identity, action, topic)

    def verdict(self, identity: Identity, action: Action, topic: str) -> ActionVerdict:
        """The decision with its rule; those that were passed over may be missing."""
        return self._quick_verdict(identity, action, topic, _Work())

    def _quick_verdict(
        self, identity: Identity, action: Action, topic: str, work: _Work
    ) -> ActionVerdict:
        shared = parse_shared(topic) if action is Action.SUBSCRIBE else None
        rules = self._applied(identity, work, shared[1] if shared is not None else topic)
        return self._verdict(identity, action, topic, rules, work)

    def _decide_receive(self, identity: Identity, topic: str) -> Decision:
        received = self._received
        if received.topic != topic:
            received = self._received = _Received(topic)
        client_id = identity.client_id
        is_unfit = _changes_levels(client_id)
        if not is_unfit and client_id in received.levels:  # a rule may name this client
            return self._decide(identity, Action.RECEIVE, topic)
        who = (identity.username, is_unfit, is_unfit and _has_wildcard(client_id))
        decision = received.decisions.get(who)
        if decision is None:
            decision = self._decide(identity, Action.RECEIVE, topic)
            # Who asks again has not caused its cost.
            received.decisions[who] = replace(decision, cost=0)
        return decision

    def _decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        work = _Work()
        verdict = self._quick_verdict(identity, action, topic, work)
        return Decision(verdict.allowed, verdict.reason, cost=work.cost)

    def allows_some(self, identity: Identity, action: Action, filter: str) -> bool:
        """Whether the client may do this with some topic that matches the valid filter."""
        work = _Work()
        rules = self._applied(identity, work, filter)
        return self._some(identity, action, filter, rules, work).allowed

    def explain(self, identity: Identity, topic: str) -> Explanation:
        """Why the client may or may not read, write and subscribe; for a filter only subscribe.

        ValueError when `topic` is neither a valid topic nor a valid filter.
        """
        if parse_shared(topic) is None:
            check_filter(topic)
        actions = [Action.SUBSCRIBE]
        if not topic.startswith("$share/") and "+" not in topic and "#" not in topic:
            actions[:0] = [Action.RECEIVE, Action.PUBLISH]
        work = _Work()
        verdicts = (
            self._verdict(identity, action, topic, self._applied(identity, work), work)
            for action in actions
        )
        return Explanation(identity, topic, tuple(verdicts))

    def _verdict(
        self, identity: Identity, action: Action, topic: str, rules: Iterable[_Applied], work: _Work
    ) -> ActionVerdict:
        if action is Action.SUBSCRIBE:
            return self._some(identity, action, topic, rules, work)
        needed = _NEEDED[action]
        passed: list[tuple[Rule, str]] = []
        for applied in rules:
            rule = applied.rule
            if not (rule.denies or rule.gives(needed)):
                passed.append((rule, _ONLY[rule.permission]))
            elif applied.matches(topic):
                return ActionVerdict(action, not rule.denies, rule, str(applied), tuple(passed))
            else:
                passed.append((rule, applied.why_passed(topic, "does not match")))
        return ActionVerdict(
            action, False, None, self._no_rule(identity, action, topic), tuple(passed)
        )

    def _some(
        self,
        identity: Identity,
        action: Action,
        filter: str,
        rules: Iterable[_Applied],
        work: _Work,
    ) -> ActionVerdict:
        """The decision about all topics that match the filter: the one that allows something."""
        needed = _NEEDED[action]
        shared = parse_shared(filter)
        wanted = shared[1] if shared is not None else filter
        denials = _Denials(work)
        passed: list[tuple[Rule, str]] = []
        denied_by: _Applied | None = None
        for applied in rules:
            rule = applied.rule
            if rule.denies:
                # Before the rules that it holds for: the client's own come before the patterns that
                # deny.
                denials.add(applied)
            elif not rule.gives(needed):
                passed.append((rule, _ONLY[rule.permission]))
            elif applied.filter is None or not _overlap(applied.filter, wanted, work):
                passed.append((rule, applied.why_passed(wanted, "shares no topic with the filter")))
            else:
                work.rules += 1
                denied_by = denials.of_all(wanted, applied.filter)
                if denied_by is None:
                    return ActionVerdict(action, True, rule, str(rule), tuple(passed))
                passed.append((rule, f"all that it gives there is denied by {denied_by}"))
        if denied_by is not None:
            return ActionVerdict(action, False, denied_by.rule, str(denied_by), tuple(passed))
        return ActionVerdict(
            action, False, None, self._no_rule(identity, action, filter), tuple(passed)
        )

    def _applied(
        self, identity: Identity, work: _Work, about: str | None = None
    ) -> Iterator[_Applied]:
        """The rules for a client, in the order in which they apply.

        With `about`, a topic or filter, rules that cannot match it may be left out. Each is counted
        when it is taken.
        """
        own = self._own.get(identity.username)
        if own is not None:
            for rule in own.rules if about is None else own.about(about, work):
                work.rules += 1
                yield _Applied(rule, rule.filter)
        patterns = self._patterns
        is_wild = _has_wildcard(identity.client_id) or _has_wildcard(identity.username or "")
        for rule in patterns.rules if about is None else patterns.about(about, work):
            work.rules += 1
            if identity.username is None and "%u" in rule.filter:
                continue
            if is_wild and not rule.denies:
                yield _Applied(rule, None)
                continue
            filter = _substitute(rule.filter, identity)
            # A client named $SYS gets nothing of $SYS from `%c/#`: `$` must be in the file.
            if filter is None or filter[0] != "$" or rule.filter[0] == "$":
                yield _Applied(rule, filter)

    def _no_rule(self, identity: Identity, action: Action, topic: str) -> str:
        # Shortened: it is logged, audited and kept with the topic's route, at a stranger's wish.
        return f"{self._name}: no rule lets {_who(identity)} {_VERBS[action]} {quote(topic)}"


def _who(identity: Identity) -> str:
    if identity.username is None:
        return "an anonymous client"
    return f"user {quote(identity.username)}"


def _substitute(filter: str, identity: Identity) -> str | None:
    """A pattern's filter for one client; None when a substituted name would change its levels."""
    if "%" not in filter:
        return filter
    names = {"%c": identity.client_id, "%u": identity.username}
    levels = filter.split("/")
    for index, level in enumerate(levels):
        if level in names:
            name = names[level]
            if name is None or _changes_levels(name):
                return None
            levels[index] = name
    return "/".join(levels)


def _has_wildcard(name: str) -> bool:
    return "+" in name or "#" in name


def _overlap(a: str, b: str, work: _Work) -> bool:
    """Whether two filters share a topic."""
    work.levels += min(a.count("/"), b.count("/")) + 1
    return overlaps(a, b)


def _changes_levels(name: str) -> bool:
    """Whether substituting the name would change the levels of a filter."""
    return not name or "/" in name or _has_wildcard(name)


def _shared(a: str, b: str) -> tuple[list[str], bool]:
    """The levels of the shortest topic that two overlapping filters share, and whether they share
    all longer ones that begin like it; a wildcard of both becomes a level that no rule names."""
    levels_a, levels_b = a.split("/"), b.split("/")
    is_open_ended = levels_a[-1] == levels_b[-1] == "#"
    for levels in (levels_a, levels_b):
        if levels[-1] == "#":
            levels.pop()
    shared = [
        x if x != "+" else y if y != "+" else _FRESH
        for x, y in zip_longest(levels_a, levels_b, fillvalue="+")
    ]
    return shared, is_open_ended
