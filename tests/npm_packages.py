"""Packages of npm that tests use: MQTT.js as a client, axe, and those in the console."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

#: Where package-lock.json is, and node_modules.
DIRECTORY = Path(__file__).parent / "interop/mqttjs"

_INSTALL_TIMEOUT = 240.0  # seconds


def install() -> None:
    """What package-lock.json lists, in node_modules; from the registry when it is not there.

    Skips the test where there is no npm.
    """
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("there is no node and npm: apt-get install nodejs npm")
    lock = DIRECTORY / "package-lock.json"
    installed = DIRECTORY / "node_modules/.package-lock.json"  # npm writes it last
    if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
        subprocess.run(
            ["npm", "ci", "--silent", "--no-audit", "--no-fund"],
            cwd=DIRECTORY,
            check=True,
            timeout=_INSTALL_TIMEOUT,
        )
