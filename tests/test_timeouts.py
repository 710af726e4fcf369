"""A test that hangs fails, whatever event loop it is on: else the whole run would hang."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent
HANGING = """
import asyncio, pytest, uvloop

@pytest.fixture(params=[asyncio.DefaultEventLoopPolicy, uvloop.EventLoopPolicy])
def event_loop_policy(request):
    return request.param()

async def test_silent():
    await asyncio.Event().wait()

async def test_busy():
    async def tick():
        while True:
            await asyncio.sleep(0.0001)

    ticking = asyncio.ensure_future(tick())
    await asyncio.Event().wait()

def test_next():
    pass
"""


def test_a_test_that_hangs_fails_and_the_next_runs(tmp_path: Path) -> None:
    file = tmp_path / "test_hanging.py"
    file.write_text(HANGING)
    project = TESTS.parent / "pyproject.toml"
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-c", project, "-p", "conftest", "--timeout", "4", file],
        env={**os.environ, "PYTHONPATH": str(TESTS)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "4 failed, 2 passed" in done.stdout, done.stdout + done.stderr
