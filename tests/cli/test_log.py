"""`appliance log`: over the control socket, and over MQTT from afar."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from command_line import run
from management.managed import PASSWORD, Site

from appliance.ops import logs


async def test_here_and_from_afar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(logs, "recent", ["first", "second\u202e\x1b[2J", "Traceback\n  at last"])
    monkeypatch.setenv("APPLIANCE_PASSWORD", PASSWORD)
    site = Site(tmp_path, tls=True)
    await site.app.start()
    here = ("--config", str(site.file))
    port = str(site.app.addresses[1][1])
    ca = str(tmp_path / "certs/ca.crt")
    afar = ("--user", "admin", "--host", "localhost", "--port", port, "--ca", ca, *here)

    async def told(*arguments: str) -> tuple[int, str]:
        code = await asyncio.to_thread(run, "log", *arguments)
        shown = capsys.readouterr()
        return code, shown.out + shown.err

    try:
        for where in (here, afar):
            code, text = await told("-n", "2", *where)
            assert code == 0 and text == "second\\u202e\\x1b[2J\nTraceback\n  at last\n"
            code, text = await told("--audit", *where)
            assert code == 0 and all("event" in json.loads(line) for line in text.splitlines())
        viewer = ("--user", "viewer", *afar[2:])
        code, text = await told(*viewer)
        assert code == 1 and "topic write $CONTROL/appliance/v1/log/_call" in text
        assert (await told("-n", "0", *here))[0] == (await told("-n", "1001", *here))[0] == 2
    finally:
        await site.stop()
