"""`appliance top`: what it shows in any window, here and from afar, its keys and its end."""

from __future__ import annotations

import asyncio
import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import Any

import pytest
from cli.test_tables import entry
from command_line import run
from management.managed import PASSWORD, Site
from rich.cells import cell_len
from waiting import PATIENCE, eventually

from appliance.cli.top_view import Snapshot, key_of, lines, losses


def client(name: str, **more: Any) -> dict[str, Any]:
    about = {"client": name, "user": None, "address": "10.0.0.7:1", "mqtt": "5"}
    return {**about, "subscription_count": 1, "queued": 0, "queued_bytes": 0, **more}


STATUS: dict[str, Any] = {
    "robot": "r2d2",
    "uptime": 3661,
    "clients": 2,
    "messages": {
        "received_a_second": 10,
        "sent_a_second": 20,
        "from_ros_a_second": 30,
        "to_ros_a_second": 0,
    },
    "memory": {"process": 64 << 20},
    "ros": {"bus": "ros2", "state": "joined", "node": "/appliance", "nodes_seen": 3},
    "warnings": ["the disk is full\x1b[2J", *["more is wrong " * 9] * 9],
}
ROUTES = [entry(f"/topic/number_{n}", rate=n, lost=100 - n) for n in range(50)]
CLIENTS = [client(f"c{n}") for n in range(50)]
CLIENTS[7].update(client("slow\x1b]0;x\x07\u202e", queued=9, queued_bytes=2048))
FULL = Snapshot(2.0, STATUS, ROUTES, CLIENTS, losses={key_of(ROUTES[3]): 5.0})


@pytest.mark.parametrize("width", [1, 7, 20, 40, 60, 80, 200])
@pytest.mark.parametrize("height", [0, 1, 3, 5, 10, 24, 60])
def test_it_fits_any_window(width: int, height: int) -> None:
    found = lines(FULL, "rate", width, height)
    assert len(found) <= height
    assert max((cell_len(line.text) for line in found), default=0) <= width
    text = "\n".join(line.text for line in found)
    assert not [each for each in text if each in "\x1b\x07\u202e"]
    if width >= 60 and height >= 24:
        assert "CLIENT" in text and "ROS " in text and "r2d2" in text and "slow\\x1b" in text
        assert "disk is full\\x1b" in text and len(found) == height


def test_what_there_is_room_for_is_shown() -> None:
    few = Snapshot(2.0, {**STATUS, "warnings": []}, ROUTES[:3], CLIENTS[:30])
    text = [line.text for line in lines(few, "rate", 80, 24)]
    assert len(text) == 24 and text[-1] == "and 14 more"
    assert [line.split()[0] for line in text[2:6]] == [
        "ROS",
        *(f"/topic/number_{n}" for n in (2, 1, 0)),
    ]
    assert text[7].startswith("slow\\x1b]0;x\\x07\\u202e")


@pytest.mark.parametrize(("sort", "first"), [("rate", 49), ("loss", 3), ("name", 0)])
def test_the_order_of_the_routes(sort: Any, first: int) -> None:
    head, row = [line.text for line in lines(FULL, sort, None, None)][12:14]
    assert head.split()[:2] == ["ROS", "MQTT"] and row.split()[0] == f"/topic/number_{first}"
    assert ("5.0" in row.split()) is (first == 3)


def test_losses_a_second() -> None:
    later = [{**ROUTES[0], "lost": 110}, {**ROUTES[1], "lost": 0}, entry("/new", lost=9)]
    assert losses(FULL, later, 4.0) == {key_of(ROUTES[0]): 5.0}  # one began anew, one is new
    assert losses(FULL, later, 2.0) == {}


async def test_once_here_and_from_afar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    site = Site(tmp_path, tls=True)
    began = time.monotonic()
    await site.app.start()
    monkeypatch.setenv("APPLIANCE_PASSWORD", PASSWORD)
    ca, config, port = tmp_path / "certs/ca.crt", str(site.file), site.app.addresses[1][1]
    afar = ("--host", "localhost", "--port", str(port), "--ca", str(ca))

    async def told(*arguments: str) -> tuple[int, str]:
        code = await asyncio.to_thread(run, "top", *arguments)
        shown = capsys.readouterr()
        return code, shown.out + shown.err

    try:
        await site.join("tablet\u202e", "viewer")
        code, text = await told("--once", "--config", config)
        up = re.match(r"r2d2  up 0:(\d\d):(\d\d)\b", text)
        assert code == 0 and up, text
        assert int(up[1]) * 60 + int(up[2]) <= round(time.monotonic() - began)
        assert "there is no bridge (bridge.bus is none)" in text and "tablet\\u202e" in text
        code, text = await told("--once", "--user", "admin", *afar)
        assert code == 0 and "tablet\\u202e" in text
        code, text = await told("--once", "--user", "viewer", *afar)
        assert code == 1 and "topic write $CONTROL/appliance/v1/status/_call/#" in text
        code, text = await told("--config", config)
        assert code == 1 and "standard output is no terminal; `appliance top --once`" in text
    finally:
        await site.stop()
    code, text = await told("--once", "--config", config)
    assert code == 1 and "Traceback" not in text


class Window:
    """A terminal of 60 × 12 cells with `appliance top` in it."""

    def __init__(self, config: Path) -> None:
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 12, 60, 0, 0))
        self.modes = termios.tcgetattr(slave)
        self.slave = slave
        self.text = ""
        command = [sys.executable, "-m", "appliance", "top", "--config", str(config)]
        environment = {**os.environ, "TERM": "xterm"}
        self.process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=slave, env=environment
        )
        os.set_blocking(self.master, False)

    def shows(self, text: str) -> bool:
        """Whether it has been written since the last look that found something."""
        try:
            while chunk := os.read(self.master, 65536):
                self.text += chunk.decode(errors="replace")
        except BlockingIOError:
            pass
        found = text in self.text
        self.text = "" if found else self.text
        return found

    def type(self, key: str) -> None:
        os.write(self.master, key.encode())

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


async def test_keys_and_a_restart(tmp_path: Path) -> None:
    site = Site(tmp_path)
    await site.app.start()
    window = Window(site.file)

    async def sees(text: str) -> None:
        await asyncio.to_thread(eventually, lambda: window.shows(text), text)

    try:
        await sees("(rate)")
        window.type("l")
        await sees("(loss)")
        window.type("x")
        fcntl.ioctl(window.slave, termios.TIOCSWINSZ, struct.pack("HHHH", 3, 20, 0, 0))
        await sees("q quit")
        fcntl.ioctl(window.slave, termios.TIOCSWINSZ, struct.pack("HHHH", 20, 100, 0, 0))
        await site.stop()
        await sees("no answer, asked again")
        window.type("q")
        assert await asyncio.to_thread(window.process.wait, PATIENCE) == 0
        assert termios.tcgetattr(window.slave) == window.modes
    finally:
        window.close()
        await site.stop()
