"""Commands to a running appliance, over its Unix socket."""

from __future__ import annotations

import asyncio
import json
import socket
import stat
from pathlib import Path

import pytest

from appliance.broker.faults import Faults
from appliance.ops import control
from appliance.ops.control import Control, ControlError, NotRunningError, ask


async def answer(arguments):
    return {"n": 1}


async def refuse(arguments):
    raise ControlError("the file is wrong")


@pytest.fixture(params=["short", "long"])
async def path(request, tmp_path: Path):
    place = tmp_path / ("x" * 120 if request.param == "long" else "s")
    place.mkdir()
    path = place / "control.sock"
    served = Control(path, {"answer": answer, "refuse": refuse}, Faults())
    await served.start()
    yield path
    await served.stop()
    await served.stop()
    assert not path.exists()


async def test_a_command_is_answered(path):
    assert await asyncio.to_thread(ask, path, "answer") == {"n": 1}
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


async def test_what_cannot_be_done_is_told(path):
    with pytest.raises(ControlError, match="the file is wrong"):
        await asyncio.to_thread(ask, path, "refuse")
    with pytest.raises(ControlError, match="unknown command; there are answer, refuse"):
        await asyncio.to_thread(ask, path, "dance")
    assert await asyncio.to_thread(ask, path, "answer") == {"n": 1}


@pytest.mark.usefixtures("no_collection")
@pytest.mark.parametrize(
    "request_line",
    [
        *(b"\n", b"{}\n", b"[]\n", b'{"command": 1}\n', b"\xff\n"),
        *(b"x" * 70000 + b"\n", b"[" * 60000 + b"\n"),
    ],
)
async def test_bad_requests_are_answered_and_harm_nothing(path, request_line):
    def talk() -> bytes:
        with control._short(path) as short, socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(short))
            connection.sendall(request_line)
            return connection.makefile("rb").readline()

    assert "error" in json.loads(await asyncio.to_thread(talk))
    assert await asyncio.to_thread(ask, path, "answer") == {"n": 1}


async def test_who_says_nothing_is_not_waited_for_for_ever(path, monkeypatch):
    monkeypatch.setattr(control, "REQUEST_TIMEOUT", 0.1)

    def wait() -> bytes:
        with control._short(path) as short, socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(short))
            return connection.makefile("rb").readline()

    assert b"no request" in await asyncio.to_thread(wait)


async def test_who_does_not_read_is_not_waited_for_for_ever(tmp_path, monkeypatch):
    monkeypatch.setattr(control, "REQUEST_TIMEOUT", 0.1)

    async def talk(arguments):
        return "x" * 10_000_000

    def open_files():
        return len(list(Path("/proc/self/fd").iterdir()))

    served = Control(tmp_path / "s", {"talk": talk}, Faults())
    await served.start()
    before = open_files()
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(tmp_path / "s"))
        connection.sendall(b'{"command": "talk"}\n')
        for _ in range(100):
            await asyncio.sleep(0.02)
            if open_files() == before + 1:
                break
        assert open_files() == before + 1, "this end alone"
    await served.stop()


async def test_a_second_appliance_does_not_take_the_place_of_the_first(path):
    with pytest.raises(OSError, match="another process listens"):
        await Control(path, {}, Faults()).start()
    assert await asyncio.to_thread(ask, path, "answer") == {"n": 1}


async def test_none_is_running(tmp_path):
    with pytest.raises(NotRunningError, match="no appliance is running"):
        ask(tmp_path / "control.sock", "answer")
    left = tmp_path / "left.sock"
    with socket.socket(socket.AF_UNIX) as gone:
        gone.bind(str(left))
    with pytest.raises(NotRunningError):
        ask(left, "answer")
    # What one that was killed has left is no obstacle.
    served = Control(left, {"answer": answer}, Faults())
    await served.start()
    assert await asyncio.to_thread(ask, left, "answer") == {"n": 1}
    await served.stop()
