"""Names and patterns of routes: `/reset`, `/arm/*`, `/camera/**`, `!/camera/raw`."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Protocol, TypeVar

from appliance.ros.skipped import Skipped, SkipReason


def compile_pattern(text: str, *, hidden: bool = False) -> re.Pattern[str]:
    """Compile a pattern: `*` matches within a part of a name, `**` matches any path.

    A hidden name, with a part that begins with `_`, matches only if the pattern spells out such a
    part, or if `hidden` is set.
    """
    parts = re.split(r"(\*\*|\*)", text)
    wild = {"**": ".*", "*": "[^/]*"}
    visible = "" if hidden or "/_" in text else r"(?!.*/_)"
    return re.compile(visible + "".join(wild.get(part, re.escape(part)) for part in parts))


def is_plain(name: str) -> bool:
    """Whether it is a single name: neither a pattern nor an exclusion."""
    return "*" not in name and not name.startswith("!")


class Names:
    """A list of names and patterns; those that begin with `!` exclude names."""

    def __init__(self, patterns: Iterable[str]) -> None:
        every = list(patterns)
        wanted = [text for text in every if not text.startswith("!")]
        self._wanted = [compile_pattern(text) for text in wanted]
        self._mentioned = [compile_pattern(text, hidden=True) for text in wanted]
        self._excluded = [
            (text, compile_pattern(text[1:], hidden=True)) for text in every if text[0] == "!"
        ]

    def __contains__(self, name: str) -> bool:
        return any(pattern.fullmatch(name) for pattern in self._wanted) and not any(
            pattern.fullmatch(name) for _, pattern in self._excluded
        )

    def refusal(self, name: str) -> tuple[SkipReason, str] | None:
        """Why a name that matches a pattern is not included; None if it is, or matches none."""
        if name in self or not any(pattern.fullmatch(name) for pattern in self._mentioned):
            return None
        for text, pattern in self._excluded:
            if pattern.fullmatch(name):
                return "left_out", f"left out by {text}"
        return "hidden", "a part of its name begins with _, which the pattern does not spell out"


class NamedRoute(Protocol):
    """A route that has names and patterns."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names, patterns and exclusions."""


NamedRouteT = TypeVar("NamedRouteT", bound=NamedRoute)


def assign(
    routes: Sequence[NamedRouteT],
    found: Mapping[str, Sequence[str]],
    fits: Callable[[NamedRouteT, str], bool],
) -> dict[str, NamedRouteT]:
    """Assign a route to each name: the one that spells it out, whether it was found or not; for
    other found names, the first one with a pattern that matches and for which it `fits`."""
    assigned = {name: route for route in reversed(routes) for name in route.names if is_plain(name)}
    for route in routes:
        names = Names(route.names)
        for name in found:
            if name not in assigned and name in names and fits(route, name):
                assigned[name] = route
    return assigned


def refusals(
    routes: Iterable[NamedRouteT],
    found: Mapping[str, Sequence[str]],
    assigned: Container[str],
    direction: str,
    misfit: Callable[[NamedRouteT, str], tuple[SkipReason, str] | None],
) -> list[Skipped]:
    """The found names that match a pattern of a route and were not assigned to any route."""
    skips: dict[str, Skipped] = {}
    for route in routes:
        names = Names(route.names)
        for name, types in found.items():
            if name not in assigned and name not in skips:
                why = misfit(route, name) if name in names else names.refusal(name)
                if why is not None:
                    skips[name] = Skipped(name, direction, min(types), *why)
    return list(skips.values())
