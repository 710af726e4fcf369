"""A process's own wall clock, which can be set while it runs; this computer's is left alone."""

from __future__ import annotations

from pathlib import Path

import pytest

LIBRARIES = "*/faketime/libfaketimeMT.so.1"

HOUR = 3600.0
YEAR = 365.25 * 24 * HOUR


class WallClock:
    """What `environment` lets a process see in place of the time: it is off by so many seconds.

    The clock that only counts goes on as it does.
    """

    def __init__(self, file: Path) -> None:
        library = next(Path("/usr/lib").glob(LIBRARIES), None)
        if library is None:
            pytest.skip("there is no libfaketime (Debian: faketime)")
        self._file = file
        self.environment = {
            "LD_PRELOAD": str(library),
            "FAKETIME_TIMESTAMP_FILE": str(file),
            "FAKETIME_NO_CACHE": "1",
            "DONT_FAKE_MONOTONIC": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        }
        self.set(0)

    def set(self, ahead: float) -> None:
        """Set it, so many seconds ahead of the right time."""
        draft = self._file.with_suffix(".draft")
        draft.write_text(f"{ahead:+.0f}\n")
        draft.replace(self._file)
