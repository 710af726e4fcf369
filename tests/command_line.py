"""The command `appliance` in the process of a test."""

from __future__ import annotations

from pathlib import Path

import pytest

from appliance.cli import main as cli


def run(*arguments: str) -> int:
    """The exit code of `appliance` with these arguments."""
    with pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert isinstance(ended.value.code, int)
    return ended.value.code


def set_up(directory: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make it the current folder, set up with `init`; without colours in what is printed."""
    monkeypatch.chdir(directory)
    monkeypatch.setenv("NO_COLOR", "1")
    assert run("init", "--robot", "r2", "--user", "alice") == 0
    return directory
