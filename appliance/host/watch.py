"""Files that are told of when they change: edited, replaced, made or removed."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path

from watchfiles import Change, awatch

log = logging.getLogger(__name__)

#: Milliseconds without a further change before a change is told of, as files that belong together
#: are seldom written at once; and the longest that it is held back.
QUIET = 200
LONGEST = 1000


async def watch(
    files: Callable[[], Iterable[Path]], changed: Callable[[], Awaitable[None]]
) -> None:
    """Call `changed` whenever one of the files has changed; runs until it is cancelled.

    Which files is asked for anew after each call. A file need not be there; its folder must be, or
    it is not looked for until the next call.
    """
    while True:
        wanted = _with_targets(files())
        folders = {path.parent for path in wanted if path.parent.is_dir()}

        def is_wanted(change: Change, path: str, wanted: set[Path] = wanted) -> bool:
            return Path(path) in wanted

        # A folder and not a file is watched: editors put a new file in the place of the old.
        changes = awatch(
            *sorted(folders), watch_filter=is_wanted, step=QUIET, debounce=LONGEST, recursive=False
        )
        async for _ in changes:
            await changed()
            if _with_targets(files()) != wanted:
                break


def _with_targets(files: Iterable[Path]) -> set[Path]:
    """The files, and what links among them lead to."""
    wanted = {path.absolute() for path in files}
    return wanted | {path.resolve() for path in wanted}
