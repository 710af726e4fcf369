"""`appliance clients`: over the control socket, and over MQTT from afar."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import pytest
from command_line import run
from management.managed import PASSWORD, Site

from appliance.cli.clients import HEAD
from appliance.mqtt.packets import Disconnect
from appliance.mqtt.reason import ReasonCode


async def test_here_and_from_afar(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    site = Site(tmp_path, tls=True)
    await site.app.start()
    ca, config = str(tmp_path / "certs/ca.crt"), str(site.file)
    monkeypatch.setenv("APPLIANCE_PASSWORD", PASSWORD)
    port = str(site.app.addresses[1][1])
    afar = ("--host", "localhost", "--port", port, "--ca", ca, "--config", config)
    try:
        tablet = await site.join("tablet\u202e", "viewer")

        async def told(*arguments: str) -> tuple[int, str]:
            code = await asyncio.to_thread(run, *arguments)
            shown = capsys.readouterr()
            return code, shown.out + shown.err

        code, text = await told("clients", "--config", config)
        head, row = text.splitlines()
        assert code == 0 and head.split() == [*HEAD]
        assert row.startswith("tablet\\u202e  viewer  127.0.0.1:")
        code, text = await told("clients", "--json", "--of", "admin", "--user", "admin", *afar)
        (own,) = map(json.loads, text.splitlines())
        assert code == 0 and own["user"] == "admin" and own["tls"] == "TLSv1.3"
        code, text = await told("clients", "kick", "tablet", "--user", "viewer", *afar)
        assert code == 1 and "topic write $CONTROL/appliance/v1/disconnect/_call/#" in text
        kick = ("clients", "kick", "tablet\u202e", "--user", "admin", *afar, "-V", "311")
        assert await told(*kick) == (0, "disconnected\n")
        assert (await tablet.wait_for(Disconnect)).reason_code == ReasonCode.ADMINISTRATIVE_ACTION
        # Options of the list do not reach a command behind them: it would be done here.
        code, text = await told("clients", *afar, "kick", "tablet")
        assert code == 2 and "behind" in text
        code, text = await told("clients", "--of", "mallory", "--config", config)
        assert (code, text) == (0, "nobody is connected as user mallory\n")
        code, text = await told("clients", "delete", "nobody", "--config", config)
        assert code == 1 and text == "appliance: there is no client 'nobody'\n"
    finally:
        await site.stop()
