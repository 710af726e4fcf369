"""The project's documentation: README, CONTRIBUTING and the pages in docs/."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PROJECT = Path(__file__).parent.parent

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.M | re.S)
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^(#+) (.+)$", re.M)


@dataclass(frozen=True)
class Page:
    """A page; `name` is its path as seen from the project's folder."""

    name: str
    text: str

    @property
    def path(self) -> Path:
        return PROJECT / self.name

    @property
    def prose(self) -> str:
        """The text without its blocks of code."""
        return _FENCE.sub("", self.text)

    def blocks(self, language: str) -> list[str]:
        """The blocks of code in that language."""
        return [text for said, text in _FENCE.findall(self.text) if said == language]

    def headings(self, level: int) -> list[str]:
        return [text for marks, text in _HEADING.findall(self.prose) if len(marks) == level]

    def anchors(self) -> set[str]:
        """What links to its headings have behind the `#`, as GitHub makes them."""
        return {anchor(text) for _, text in _HEADING.findall(self.prose)}

    def links(self) -> list[str]:
        """Where its links lead to, without those to other sites."""
        return [link for link in _LINK.findall(self.prose) if "://" not in link]

    def commands(self) -> Iterator[str]:
        """Lines that are typed into a shell, in the page's order.

        One that goes on in the next line is one.
        """
        for language, block in _FENCE.findall(self.text):
            lines = block.replace("\\\n", " ").splitlines()
            if language == "sh":
                yield from lines
            elif language == "console":
                yield from (line[2:] for line in lines if line.startswith("$ "))

    def quoted(self) -> list[str]:
        """What stands between backticks in the prose."""
        return [" ".join(text.split()) for text in re.findall(r"`([^`]+)`", self.prose)]


def anchor(heading: str) -> str:
    """The name by which a link leads to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def pages() -> list[Page]:
    """All of them, README first."""
    files = [PROJECT / "README.md", PROJECT / "CONTRIBUTING.md", *(PROJECT / "docs").glob("*.md")]
    return [Page(str(each.relative_to(PROJECT)), each.read_text()) for each in files]
