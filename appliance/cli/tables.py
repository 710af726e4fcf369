"""Tables as wide as a terminal, and texts that cannot control it."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from rich.cells import cell_len, set_cell_size

from appliance.ops.logs import VISIBLE

#: Cells between two columns.
GAP: Final = "  "

_ELLIPSIS: Final = "…"


def visible(text: str) -> str:
    """The text, which may be a stranger's, without characters that control a terminal."""
    return text.translate(VISIBLE)


def terminal_width() -> int | None:
    """The cells of a line of standard output; None where it is no terminal, and a program reads."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def shortened(text: str, width: int) -> str:
    """The text in so many cells at most: what is left out is its middle, as names of one robot
    begin alike and those of one message end alike."""
    if cell_len(text) <= width:
        return text
    if width <= 0:
        return ""
    before, after = -(-(width - 1) // 2), (width - 1) // 2
    head = text[: _fitting(text, before)]
    tail = text[-after:] if after else ""
    while cell_len(tail) > after:
        tail = tail[1:]
    return f"{head}{_ELLIPSIS}{tail}"


def cut(text: str, width: int) -> str:
    """The beginning of a sentence, in so many cells at most."""
    if cell_len(text) <= width:
        return text
    return f"{text[: _fitting(text, width - 1)]}{_ELLIPSIS}" if width > 0 else ""


def table(rows: Iterable[Sequence[str]], width: int | None = None) -> Iterator[str]:
    """The lines of a table: columns as wide as necessary or, in so many cells, as possible.

    In a table that is too wide the widest columns give way, and sentences in the last one go on in
    further lines.
    """
    lines = [[visible(cell) for cell in row] for row in rows]
    columns = max(map(len, lines), default=0)
    lines = [[*row, *[""] * (columns - len(row))] for row in lines]
    widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
    if width is not None:
        widths = fitted(widths, width - len(GAP) * (columns - 1))
    for row in lines:
        yield from _row(row, widths)


def fits(rows: Iterable[Sequence[str]], width: int) -> bool:
    """Whether the table needs no more cells."""
    return all(cell_len(line) <= width for line in table(rows))


def fitted(widths: Sequence[int], room: int) -> list[int]:
    """The widths of columns in so much room: all above a limit get that."""
    if sum(widths) <= room:
        return list(widths)
    low, high = 1, max(widths)
    while low < high:  # the highest limit that fits
        middle = -(-(low + high) // 2)
        if sum(min(each, middle) for each in widths) <= room:
            low = middle
        else:
            high = middle - 1
    return [min(each, low) for each in widths]


def _row(cells: list[str], widths: list[int]) -> Iterator[str]:
    *first, last = (shortened(cell, width) for cell, width in zip(cells, widths, strict=True))
    texts = [last]
    if cell_len(cells[-1]) > widths[-1] and " " in cells[-1]:
        texts = list(_wrapped(cells[-1], widths[-1]))
    before = ""
    for cell, width in zip(first, widths[:-1], strict=True):
        before += set_cell_size(cell, width) + GAP
    for text in texts:
        yield f"{before}{text}".rstrip()
        before = " " * cell_len(before)


def _wrapped(text: str, width: int) -> Iterator[str]:
    line = ""
    for word in text.split():
        longer = f"{line} {word}" if line else word
        if line and cell_len(longer) > width:
            yield line
            longer = word
        line = longer
        while cell_len(line) > width:
            end = max(_fitting(line, width), 1)  # a wide character in a single cell: go on
            yield shortened(line[:end], width)
            line = line[end:]
    if line:
        yield line


def _fitting(text: str, width: int) -> int:
    """How many characters at the text's beginning fit."""
    used = 0
    for number, character in enumerate(text):
        used += cell_len(character)
        if used > width:
            return number
    return len(text)
