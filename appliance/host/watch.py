"""Watches files for changes: edited, replaced, created or removed."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path

from watchfiles import Change, awatch

log = logging.getLogger(__name__)

#: Milliseconds without a further change before a change is reported, as files that belong together
#: are seldom written at once; and the longest delay.
QUIET = 200
LONGEST = 1000


async def watch(
    files: Callable[[], Iterable[Path]], changed: Callable[[], Awaitable[None]]
) -> None:
    """Call `changed` whenever one of the files has changed; runs until it is cancelled.

    The files are listed anew after each call. A file need not exist; its folder must, or the file
    is not watched until the next call.
    """
    while True:
        wanted = _with_targets(files())
        folders = {path.parent for path in wanted if path.parent.is_dir()}

        def is_wanted(change: Change, path: str, wanted: set[Path] = wanted) -> bool:
            return Path(path) in wanted

        # Folders are watched, not files: editors replace a file by a new one.
        changes = awatch(
            *sorted(folders), watch_filter=is_wanted, step=QUIET, debounce=LONGEST, recursive=False
        )
        async for _ in changes:
            await changed()
            if _with_targets(files()) != wanted:
                break


def _with_targets(files: Iterable[Path]) -> set[Path]:
    """The files, and the targets of links among them."""
    wanted = {path.absolute() for path in files}
    return wanted | {path.resolve() for path in wanted}
