"""Watches files for changes: edited, replaced, created or removed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterable
from pathlib import Path
from typing import Final, TypeAlias

from watchfiles import Change, awatch

#: Milliseconds without a further change before a change is reported, as files that belong together
#: are seldom written at once; the longest delay; and between two looks without being told.
QUIET: Final = 200
LONGEST: Final = 1000
LOOK: Final = 2000

#: Seconds by which the time of a change can be before that of the clock: a tick of the kernel.
TICK: Final = 0.01

#: What changes when a file does; None where there is no file.
_Stamp: TypeAlias = "tuple[int, ...] | None"

#: Of a file that has changed after it was read: no file has it.
_CHANGED: Final = ()


async def watch(
    files: Callable[[], Iterable[Path]], changed: Callable[[], Awaitable[None]], since: float
) -> None:
    """Call `changed` whenever one of the files has changed; runs until it is cancelled.

    `since` is when they were read, in seconds of `time.time`: what has changed later, before this
    was called, is told too. The files are listed anew after each call. A file need not exist.
    """
    seen: dict[Path, _Stamp] = {}
    while True:
        wanted = _with_targets(files())
        seen = {path: seen[path] if path in seen else _as_read(path, since) for path in wanted}
        folders = {path.parent for path in wanted if path.parent.is_dir()}

        def is_wanted(change: Change, path: str, wanted: set[Path] = wanted) -> bool:
            return Path(path) in wanted

        # Folders are watched, not files: editors replace a file by a new one. What is not told, as
        # it came before the folder was watched or the file system tells nothing, is looked for.
        async for _ in awatch(
            *sorted(folders),
            watch_filter=is_wanted,
            step=QUIET,
            debounce=LONGEST,
            rust_timeout=LOOK,
            yield_on_timeout=True,
            recursive=False,
        ):
            # In a thread, as a file system may hang, and everybody would wait with it.
            found = await asyncio.to_thread(_stamps, wanted)
            if found == seen:
                continue
            seen, since = found, time.time()
            await changed()
            if _with_targets(files()) != wanted:
                break


def _stamps(paths: Iterable[Path]) -> dict[Path, _Stamp]:
    return {path: _stamp(path) for path in paths}


def _stamp(path: Path) -> _Stamp:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _as_read(path: Path, since: float) -> _Stamp:
    """The stamp with which a file was read after `since`."""
    stamp = _stamp(path)
    return _CHANGED if stamp is not None and stamp[-1] > (since - TICK) * 1e9 else stamp


def _with_targets(files: Iterable[Path]) -> set[Path]:
    """The files, and the targets of links among them."""
    wanted = {path.absolute() for path in files}
    return wanted | {path.resolve() for path in wanted}
