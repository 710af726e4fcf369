"""Topic names and filters (section 4.7 of both standards): validation, matching and search trees.

A topic is split at `/` into levels; an empty level is a level like any other. In a filter, `+`
matches one level, and a final `#` matches the level above it and everything below.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator
from typing import Final, Generic, TypeVar

V = TypeVar("V")

MAX_TOPIC: Final = 65_535
"""The maximum length, in bytes, of a topic or a filter: that of an MQTT string."""

_SHARE: Final = "$share/"

STEP: Final = 16
"""Nodes of a tree that are visited in one step of a search."""

LISTED_PER_STEP: Final = 128
"""Children of a node that are listed for wildcards in the time of one."""


# Control characters and non-characters: the standard leaves them to the receiver (section 1.5.3;
# 5.0 section 1.5.4). A name that cannot be printed is useless, and misleading in a log.
_CONTROL: Final = re.compile("[\x01-\x1f\x7f-\x9f\ufdd0-\ufdef\ufffe\uffff]")


def holds_control(text: str) -> bool:
    """Whether the text contains characters that are not allowed in names here."""
    return _CONTROL.search(text) is not None


def check_topic(topic: str) -> None:
    """Raises a ValueError with the reason if `topic` is not a valid topic name (section 4.7)."""
    _check_string(topic, "topic")
    if "+" in topic or "#" in topic:  # [MQTT-3.3.2-2] [MQTT-4.7.1-1] v5 [MQTT-4.7.0-1]
        raise ValueError("a topic must not hold + or #")


def check_filter(filter: str) -> None:
    """Raises a ValueError with the reason if `filter` is not a valid topic filter (section 4.7).

    For a shared subscription call `parse_shared` first: `$share/…` is not parsed here.
    """
    _check_string(filter, "topic filter")
    if "+" not in filter and "#" not in filter:
        return
    levels = filter.split("/")
    last = len(levels) - 1
    for index, level in enumerate(levels):
        if "#" in level and (level != "#" or index != last):  # [MQTT-4.7.1-2] v5 [MQTT-4.7.1-1]
            raise ValueError("# must be a whole level, and the last one")
        if "+" in level and level != "+":  # [MQTT-4.7.1-3] v5 [MQTT-4.7.1-2]
            raise ValueError("+ must be a whole level")


def _check_string(text: str, what: str) -> None:
    if not text:  # [MQTT-4.7.3-1]
        raise ValueError(f"a {what} must not be empty")
    if "\0" in text:  # [MQTT-4.7.3-2]
        raise ValueError(f"a {what} must not hold U+0000")
    if holds_control(text):
        raise ValueError(f"a {what} must not hold control characters")
    # No character takes more than four bytes, so a short text need not be encoded to be measured.
    if len(text) > MAX_TOPIC // 4 and len(text.encode()) > MAX_TOPIC:  # [MQTT-4.7.3-3]
        raise ValueError(f"a {what} must not be longer than {MAX_TOPIC} bytes")


def parse_shared(filter: str) -> tuple[str, str] | None:
    """The group and the filter of `$share/{group}/{filter}`; None for any other filter.

    Raises a ValueError if it is an invalid shared subscription (5.0 section 4.8.2).
    """
    if not filter.startswith(_SHARE):
        return None
    group, slash, inner = filter[len(_SHARE) :].partition("/")
    if not group:  # v5 [MQTT-4.8.2-1]
        raise ValueError("a shared subscription needs a group: $share/{group}/{filter}")
    if "+" in group or "#" in group:  # v5 [MQTT-4.8.2-2]
        raise ValueError("the group of a shared subscription must not hold + or #")
    if not slash:  # v5 [MQTT-4.8.2-2]
        raise ValueError("a shared subscription needs a filter: $share/{group}/{filter}")
    check_filter(inner)
    return group, inner


def matches(filter: str, topic: str) -> bool:
    """Whether a valid `filter` matches a valid `topic` (section 4.7)."""
    if filter == topic:
        return True
    if topic[:1] == "$" and filter[:1] in ("+", "#"):  # [MQTT-4.7.2-1]
        return False
    wanted = filter.split("/")
    levels = topic.split("/")
    if wanted[-1] == "#":
        wanted.pop()  # What is left must match the beginning: `a/#` matches `a` too.
        if len(levels) < len(wanted):
            return False
    elif len(levels) != len(wanted):
        return False
    return all(want in ("+", level) for want, level in zip(wanted, levels, strict=False))


def overlaps(a: str, b: str) -> bool:
    """Whether some topic matches both filters `a` and `b`, both valid."""
    if _dollar_apart(a, b) or _dollar_apart(b, a):
        return False
    levels_a, open_a = _shape(a)
    levels_b, open_b = _shape(b)
    if len(levels_a) > len(levels_b) and not open_b:
        return False
    if len(levels_b) > len(levels_a) and not open_a:
        return False
    return all(x == y or "+" in (x, y) for x, y in zip(levels_a, levels_b, strict=False))


def _dollar_apart(wild: str, other: str) -> bool:
    """`wild` begins with a wildcard and `other` with `$`: they share no topic [MQTT-4.7.2-1]."""
    return wild[:1] in ("+", "#") and other[:1] == "$"


def _shape(filter: str) -> tuple[list[str], bool]:
    """The levels that a matching topic must have at least, and whether it may have more.

    A topic is never empty, so `#` requires one level, and `/#` (whose parent is the empty topic)
    requires two: `+/#` and `#` match the same topics, and so do `/#` and `/+/#`.
    """
    levels = filter.split("/")
    if levels[-1] != "#":
        return levels, False
    levels.pop()
    if levels in ([], [""]):
        levels.append("+")
    return levels, True


class _FilterNode(Generic[V]):
    __slots__ = ("children", "values")

    def __init__(self) -> None:
        self.children: dict[str, _FilterNode[V]] = {}
        self.values: dict[Hashable, V] = {}


class SubscriptionTree(Generic[V]):
    """Maps filters to values by key, and finds the values for a topic: a trie with levels as edges.

    A lookup visits each node that matches a prefix of the topic, once. With filters that contain
    `+` these may be many, even if none matches in the end; `visited` is their number. Filters and
    topics must be valid.
    """

    def __init__(self) -> None:
        self._root: _FilterNode[V] = _FilterNode()
        self._size = 0
        #: The levels and nodes that the last `match` visited.
        self.visited = 0

    def __len__(self) -> int:
        """The number of pairs of filter and key."""
        return self._size

    def add(self, filter: str, key: Hashable, value: V) -> bool:
        """Sets the value of `key` under `filter`; returns whether there was none before."""
        node = self._root
        for level in filter.split("/"):
            child = node.children.get(level)
            if child is None:
                child = node.children[level] = _FilterNode()
            node = child
        new = key not in node.values
        node.values[key] = value
        self._size += new
        return new

    def remove(self, filter: str, key: Hashable) -> bool:
        """Removes `key` from `filter`; returns whether it was there."""
        path: list[tuple[_FilterNode[V], str]] = []
        node = self._root
        for level in filter.split("/"):
            path.append((node, level))
            child = node.children.get(level)
            if child is None:
                return False
            node = child
        if key not in node.values:
            return False
        del node.values[key]
        self._size -= 1
        while path and not node.values and not node.children:
            node, level = path.pop()
            del node.children[level]
        return True

    def match(self, topic: str) -> list[V]:
        """The values of all filters that match `topic`; a key with two of them occurs twice."""
        found: list[V] = []
        # The nodes reached so far; each has one parent, so none is reached twice.
        nodes = [self._root]
        wild = topic[:1] != "$"  # [MQTT-4.7.2-1]: no wildcard for the first level of a $ topic.
        levels = topic.split("/")
        visited = len(levels)
        for level in levels:
            reached: list[_FilterNode[V]] = []
            for node in nodes:
                visited += 1
                children = node.children
                child = children.get(level)
                if child is not None:
                    reached.append(child)
                if wild:
                    child = children.get("+")
                    if child is not None:
                        reached.append(child)
                    child = children.get("#")
                    if child is not None:
                        found.extend(child.values.values())
            nodes = reached
            if not nodes:
                break
            wild = True
        self.visited = visited + len(nodes)
        for node in nodes:
            found.extend(node.values.values())
            child = node.children.get("#")  # `a/#` matches `a` too.
            if child is not None:
                found.extend(child.values.values())
        return found


class _TopicNode(Generic[V]):
    __slots__ = ("children", "entry", "listing")

    def __init__(self) -> None:
        self.children: dict[str, _TopicNode[V]] = {}
        self.entry: tuple[str, V] | None = None
        self.listing: tuple[_TopicNode[V], ...] | None = None

    def is_empty(self) -> bool:
        return self.entry is None and not self.children


class TopicTree(Generic[V]):
    """Maps topics to one value each, and finds those that match a filter: for retained messages.

    Topics and filters must be valid.
    """

    def __init__(self) -> None:
        self._root: _TopicNode[V] = _TopicNode()
        self._size = 0

    def __len__(self) -> int:
        """The number of topics with a value."""
        return self._size

    def set(self, topic: str, value: V) -> None:
        """Sets the value of `topic`."""
        node = self._root
        for level in topic.split("/"):
            child = node.children.get(level)
            if child is None:
                child = node.children[level] = _TopicNode()
                node.listing = None
            node = child
        self._size += node.entry is None
        node.entry = (topic, value)

    def get(self, topic: str) -> V | None:
        """The value of `topic`, or None."""
        node = self._root
        for level in topic.split("/"):
            child = node.children.get(level)
            if child is None:
                return None
            node = child
        return node.entry[1] if node.entry is not None else None

    def delete(self, topic: str) -> bool:
        """Deletes the value of `topic`; returns whether it had one."""
        path: list[tuple[_TopicNode[V], str]] = []
        node = self._root
        for level in topic.split("/"):
            path.append((node, level))
            child = node.children.get(level)
            if child is None:
                return False
            node = child
        if node.entry is None:
            return False
        node.entry = None
        self._size -= 1
        while path and node.is_empty():
            node, level = path.pop()
            del node.children[level]
            node.listing = None
        return True

    def find(self, filter: str) -> Iterator[tuple[str, V]]:
        """Yields the topics that match `filter` with their values.

        The tree may change during the iteration; whether the rest contains topics that were set or
        deleted meanwhile is then undefined.
        """
        for found in self.find_in_steps(filter):
            if found is not None:
                yield found

    def find_in_steps(self, filter: str) -> Iterator[tuple[str, V] | None]:
        """Like `find`, but yields None now and then, so that a long search can be suspended."""
        levels = filter.split("/")
        # The nodes to be visited, and the number of filter levels that lead to them.
        stack: list[tuple[Iterator[_TopicNode[V]], int]] = [(iter((self._root,)), 0)]
        visited = 0
        while stack:
            nodes, depth = stack[-1]
            node = next(nodes, None)
            if node is None:
                stack.pop()
                continue
            visited += 1
            if not visited % STEP:
                yield None
            if depth == len(levels):
                if node.entry is not None:
                    yield node.entry
                continue
            level = levels[depth]
            if node.listing is None and level in ("#", "+"):
                # As many steps as it takes to list them, which is done anew after each new topic.
                for _ in range(len(node.children) // LISTED_PER_STEP):
                    yield None
            if level == "#":
                if node.entry is not None:
                    yield node.entry
                stack.append((iter(self._listing(node)), depth))  # good for all levels below
            elif level == "+":
                stack.append((iter(self._listing(node)), depth + 1))
            else:
                child = node.children.get(level)
                if child is not None:
                    stack.append((iter((child,)), depth + 1))

    def _listing(self, node: _TopicNode[V]) -> tuple[_TopicNode[V], ...]:
        """The children that wildcards match, cached: thousands of searches may be in progress."""
        if node.listing is None:
            hides_dollar = node is self._root  # [MQTT-4.7.2-1]
            node.listing = tuple(
                child
                for name, child in node.children.items()
                if not (hides_dollar and name.startswith("$"))
            )
        return node.listing
