"""Topic filters and access rules in the simplest form: what the broker is held against."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache

SHARE = "$share/"


@cache
def _pattern(topic_filter: str) -> re.Pattern[str]:
    if topic_filter.startswith(SHARE):
        topic_filter = topic_filter.split("/", 2)[2]
    pattern = re.escape(topic_filter).replace(r"\+", "[^/]*")
    if topic_filter == "#":
        pattern = ".*"
    elif topic_filter.endswith("/#"):
        pattern = pattern[: -len(r"/\#")] + "(/.*)?"
    if topic_filter[0] in "+#":
        pattern = r"(?!\$)" + pattern
    return re.compile(pattern, re.DOTALL)


def matches(topic_filter: str, topic: str) -> bool:
    """Whether the filter, or that of the shared subscription, matches the topic (section 4.7)."""
    return _pattern(topic_filter).fullmatch(topic) is not None


@dataclass(frozen=True)
class Rights:
    """What a user may do: filters allowed, less filters denied; each denied one ends in /#."""

    read: tuple[str, ...]
    write: tuple[str, ...]
    deny: tuple[str, ...] = ()

    def may_read(self, topic: str) -> bool:
        return self._allows(self.read, topic)

    def may_write(self, topic: str) -> bool:
        return self._allows(self.write, topic)

    def may_subscribe(self, topic_filter: str) -> bool:
        """False for a filter that nothing could ever be delivered under."""
        return not any(topic_filter.startswith(denied[:-1]) for denied in self.deny)

    def _allows(self, filters: Iterable[str], topic: str) -> bool:
        if any(matches(denied, topic) for denied in self.deny):
            return False
        return any(matches(allowed, topic) for allowed in filters)


def acl(rights: Mapping[str, Rights]) -> str:
    """The rights as an ACL file."""
    lines: list[str] = []
    for user, allowed in rights.items():
        lines.append(f"user {user}")
        lines += (f"topic deny {name}" for name in allowed.deny)
        lines += (f"topic read {name}" for name in allowed.read)
        lines += (f"topic write {name}" for name in allowed.write)
    return "\n".join(lines) + "\n"
