"""Which names on the bus are meant: `/reset`, `/arm/*`, `/camera/**`, `!/camera/raw`."""

from __future__ import annotations

import re
from collections.abc import Iterable


def compile_pattern(text: str) -> re.Pattern[str]:
    """What matches the names that a pattern stands for: `*` is part of a name, `**` of a path.

    Hidden names, with a token that begins with `_`, have to be spelt out in the pattern.
    """
    parts = re.split(r"(\*\*|\*)", text)
    wild = {"**": ".*", "*": "[^/]*"}
    visible = "" if "/_" in text else r"(?!.*/_)"
    return re.compile(visible + "".join(wild.get(part, re.escape(part)) for part in parts))


class Names:
    """A list of names and patterns; one that begins with `!` takes names out again."""

    def __init__(self, patterns: Iterable[str]) -> None:
        every = list(patterns)
        self._wanted = [compile_pattern(text) for text in every if not text.startswith("!")]
        self._excluded = [compile_pattern(text[1:]) for text in every if text.startswith("!")]

    def __contains__(self, name: str) -> bool:
        return any(pattern.fullmatch(name) for pattern in self._wanted) and not any(
            pattern.fullmatch(name) for pattern in self._excluded
        )
