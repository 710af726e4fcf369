"""`appliance demo`: from `init --demo` to a printed line that works, and a clean end."""

from __future__ import annotations

import asyncio
import os
import shlex
import shutil
import socket
import sys
from asyncio.subprocess import PIPE, Process
from pathlib import Path

import pytest
from waiting import PATIENCE

from appliance import config
from appliance.cli import demo as tour
from appliance.cli import main as cli


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A demo folder, the current one, whose configuration names free ports and no bus."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("APPLIANCE_PORT", "0")
    monkeypatch.setenv("APPLIANCE_PLAIN_PORT", "0")
    with pytest.raises(SystemExit) as ended:
        cli.main(["init", "--demo", "--dir", "run"])
    assert ended.value.code == 0
    file = tmp_path / "run/appliance.yaml"
    file.write_text(file.read_text().replace("bridge:\n", "bridge:\n  bus: none\n"))
    return tmp_path


async def lines_until(process: Process, last: str) -> list[str]:
    assert process.stdout
    lines: list[str] = []
    while not lines or last not in lines[-1]:
        line = await asyncio.wait_for(process.stdout.readline(), PATIENCE)
        assert line, "ended early"
        lines.append(line.decode())
    return lines


async def start(*arguments: str) -> Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "appliance", *arguments, stdout=PIPE
    )


async def output(command: list[str]) -> tuple[int | None, str]:
    process = await asyncio.create_subprocess_exec(*command, stdout=PIPE)
    text, _ = await asyncio.wait_for(process.communicate(), PATIENCE)
    return process.returncode, text.decode()


@pytest.mark.skipif(shutil.which("mosquitto_sub") is None, reason="no mosquitto-clients")
async def test_what_is_printed_can_be_typed(demo: Path) -> None:
    process = await start("demo", "-c", "run/appliance.yaml")
    try:
        printed = [line.strip() for line in await lines_until(process, "Ctrl-C")]
        see = next(line for line in printed if line.startswith("mosquitto_sub"))
        drive = next(line for line in printed if line.startswith("mosquitto_pub"))
        assert any(line.endswith("user.password /reset") for line in printed)
        ours = next(line for line in printed if "appliance sub" in line)

        state = "demo/_appliance/state"
        shell = ["sh", "-c"]
        once = see.replace("demo/odom", state) + " -C 1 -W 10"
        assert await output([*shell, once]) == (0, f"{state} online\n")
        assert await output([*shell, drive]) == (0, "")

        words = shlex.split(ours.replace("demo/odom", state))[1:]
        python = [sys.executable, "-m", "appliance"]
        assert await output([*python, *words, "-C", "1", "-W", "10"]) == (0, f"{state} online\n")
    finally:
        process.terminate()
        assert await asyncio.wait_for(process.wait(), PATIENCE) == 0


def test_a_port_that_is_taken(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("0.0.0.0", 0)) as other:
        monkeypatch.setenv("APPLIANCE_PORT", str(other.getsockname()[1]))
        settings = config.load(demo / "run/appliance.yaml")
        with pytest.raises(tour.DemoError, match="make run PORT="):
            tour.run(settings)


async def test_a_demo_that_runs_already(demo: Path) -> None:
    settings = config.load(demo / "run/appliance.yaml")
    first = tour.Demo(settings)
    await first.start()
    try:
        with pytest.raises(tour.DemoError, match=f"runs already, as process {os.getpid()}"):
            await asyncio.to_thread(tour.run, settings)
    finally:
        await first.stop()


def test_the_demo_needs_tls(demo: Path) -> None:
    settings = config.loads("broker: {listeners: [{bind: ':0'}]}", demo / "x.yaml", {})
    with pytest.raises(tour.DemoError, match="tls: true"):
        tour.run(settings)
