"""`appliance demo`: from `init --demo` to a printed line that works, and a clean end."""

from __future__ import annotations

import asyncio
import os
import shlex
import shutil
import socket
import ssl
import sys
import urllib.request
from asyncio.subprocess import PIPE, Process
from pathlib import Path

import pytest
from waiting import PATIENCE

from appliance import config
from appliance.cli import demo as tour
from appliance.cli import main as cli
from appliance.ops.init import initialise

#: The variables with the ports of its listeners.
PORTS = ("APPLIANCE_PORT", "APPLIANCE_PLAIN_PORT", "APPLIANCE_WEB_PORT")


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A demo folder, the current one, whose configuration names free ports and no bus."""
    monkeypatch.chdir(tmp_path)
    for name in PORTS:
        monkeypatch.setenv(name, "0")
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


def status_of(url: str, ca: Path) -> int:
    """The status of the page at that URL."""
    with urllib.request.urlopen(url, context=ssl.create_default_context(cafile=ca)) as answer:
        return int(answer.status)


@pytest.mark.skipif(shutil.which("mosquitto_sub") is None, reason="no mosquitto-clients")
async def test_what_is_printed_can_be_typed(demo: Path) -> None:
    process = await start("demo", "-c", "run/appliance.yaml")
    try:
        printed = [line.strip() for line in await lines_until(process, "Ctrl-C")]
        see = next(line for line in printed if line.startswith("mosquitto_sub"))
        drive = next(line for line in printed if line.startswith("mosquitto_pub"))
        ours_to_drive = next(line for line in printed if "appliance pub" in line)
        url = next(line for line in printed if line.startswith("https://"))
        assert not any("/reset" in line or "odom" in line for line in printed)  # nobody has them
        ours = next(line for line in printed if "appliance sub" in line)

        state = "demo/_appliance/state"
        shell = ["sh", "-c"]
        once = see.replace("demo/#", state) + " -C 1 -W 10"
        assert await output([*shell, once]) == (0, f"{state} online\n")
        assert await output([*shell, drive]) == (0, "")
        assert await output([*shell, ours_to_drive]) == (0, "")
        assert await asyncio.to_thread(status_of, url, demo / "run/certs/ca.crt") == 200

        words = shlex.split(ours.replace("demo/#", state))[1:]
        python = [sys.executable, "-m", "appliance"]
        assert await output([*python, *words, "-C", "1", "-W", "10"]) == (0, f"{state} online\n")
    finally:
        process.terminate()
        assert await asyncio.wait_for(process.wait(), PATIENCE) == 0


@pytest.mark.parametrize("name", PORTS)
def test_a_port_that_is_taken(demo: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    with socket.create_server(("0.0.0.0", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setenv(name, str(port))
        settings = config.load(demo / "run/appliance.yaml")
        with pytest.raises(tour.DemoError, match=rf":{port} cannot .* make run PORT=.* WEB_PORT="):
            tour.run(settings)
        monkeypatch.delenv("APPLIANCE_PLAIN_PORT")
        monkeypatch.setenv("APPLIANCE_PORT", str(port))
        if name == "APPLIANCE_PORT":  # by hand, and not by `make run`
            settings = config.load(demo / "run/appliance.yaml")
            with pytest.raises(tour.DemoError, match=r"in broker\.listeners of .*appliance\.yaml"):
                tour.run(settings)


def test_with_its_robot_it_says_how_to_see_and_drive_it(demo: Path) -> None:
    settings = config.load(demo / "run/appliance.yaml")
    told = tour.instructions(settings, ("0.0.0.0", 8883), ("0.0.0.0", 8443))
    lines = [line.strip() for line in told.splitlines()]
    assert any(line.endswith("user.password /reset") for line in lines)
    assert any(line.startswith("mosquitto_sub") and "-t 'demo/odom'" in line for line in lines)
    assert any("appliance sub" in line and "-v 'demo/odom'" in line for line in lines)
    assert "Topics has the\nodometry, demo/odom, and Drive moves the robot." in told
    alone = tour.instructions(settings, ("0.0.0.0", 8883), ("0.0.0.0", 8443), has_robot=False)
    assert "odom" not in alone and "/reset" not in alone and "-t 'demo/#'" in alone


def test_a_demo_of_before_the_console_has_no_url(demo: Path) -> None:
    settings = config.load(demo / "run/appliance.yaml")
    told = tour.instructions(settings, ("0.0.0.0", 8883))
    assert "https" not in told and "Ready.\n\nIn another terminal" in told


def test_who_signs_in_is_the_first_user(demo: Path) -> None:
    """Whose password is in the file; another may come before in the alphabet."""
    settings = config.load(demo / "run/appliance.yaml")
    users = settings.broker.users
    line = users.read_text()
    users.write_text(line + line.replace("operator:", "alice:"))
    told = tour.instructions(settings, ("0.0.0.0", 8883), ("0.0.0.0", 8443))
    assert "Sign in as operator;" in told
    assert "alice" not in told


def test_where_the_console_is(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = config.load(demo / "run/appliance.yaml")
    monkeypatch.setattr(tour, "own_address", lambda: "10.0.0.7")
    told = tour.instructions(settings, ("0.0.0.0", 8883), ("0.0.0.0", 8443))
    assert "https://localhost:8443/" in told and "https://10.0.0.7:8443/" in told
    assert "Sign in as operator; its password is in run/user.password" in told
    here = tour.instructions(settings, ("127.0.0.1", 8883), ("127.0.0.1", 8443))
    assert "10.0.0.7" not in here
    monkeypatch.setattr(tour, "own_address", lambda: None)
    assert told.count("https://") - 1 == tour.instructions(
        settings, ("0.0.0.0", 8883), ("0.0.0.0", 8443)
    ).count("https://")


async def test_a_demo_that_runs_already(demo: Path) -> None:
    settings = config.load(demo / "run/appliance.yaml")
    first = tour.Demo(settings)
    await first.start()
    try:
        with pytest.raises(tour.DemoError, match=f"runs already, as process {os.getpid()}"):
            await asyncio.to_thread(tour.run, settings)
    finally:
        await first.stop()


def test_a_configuration_that_is_not_the_demos(tmp_path: Path) -> None:
    list(initialise(tmp_path))
    settings = config.load(tmp_path / "appliance.yaml")
    with pytest.raises(tour.DemoError, match=r"no route for .* /odom: .*appliance init --demo"):
        tour.run(settings)
    file = tmp_path / "appliance.yaml"
    others = file.read_text().replace("topics: []\n", "topics: [{ros: /chatter, to: mqtt}]\n")
    file.write_text(others)
    settings = config.load(file)
    assert settings.bridge.topics
    with pytest.raises(tour.DemoError, match="no route for"):
        tour.run(settings)


def test_the_demo_needs_tls(demo: Path) -> None:
    settings = config.loads("broker: {listeners: [{bind: ':0'}]}", demo / "x.yaml", {})
    with pytest.raises(tour.DemoError, match="tls: true"):
        tour.run(settings)
