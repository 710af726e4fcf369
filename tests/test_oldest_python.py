"""Nothing of a newer Python than the oldest that the appliance is for is used."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from pages import PROJECT

VERMIN = "import vermin; vermin.main()"


def newer_than_3_10(*paths: Path) -> str:
    """What vermin finds, which knows since when each module, function and keyword is there."""
    options = ("-t=3.10-", "--no-tips", "--violations", "--quiet")
    done = subprocess.run(
        [sys.executable, "-c", VERMIN, *options, *paths], capture_output=True, text=True
    )
    assert done.returncode in (0, 1), done.stderr
    return done.stdout if done.returncode else ""


@pytest.mark.timeout(600)
def test_the_code_is_for_python_3_10() -> None:
    assert newer_than_3_10(PROJECT / "appliance", PROJECT / "setup.py") == ""


def test_it_is_seen_when_something_is_newer(tmp_path: Path) -> None:
    file = tmp_path / "newer.py"
    file.write_text("import math\n\nmath.exp2(3)\n")
    assert "math.exp2" in newer_than_3_10(file)
