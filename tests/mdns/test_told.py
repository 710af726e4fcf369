"""What `check`, `doctor` and `status` tell of the announcing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from command_line import run

from appliance import config
from appliance.cli.status import _mdns
from appliance.mdns.process import AnnouncerProcess
from appliance.ops.check import check
from appliance.ops.doctor import mdns as examined
from appliance.ops.doctor.mdns import mdns

OPEN = "robot: line.3\nbroker:\n  listeners: [{bind: '0.0.0.0:8883', tls: true}]\n"


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> config.Settings:
    monkeypatch.delenv("APPLIANCE_MDNS")
    file = tmp_path / "appliance.yaml"
    file.write_text(OPEN)
    return config.load(file)


def status(**values: Any) -> dict[str, Any]:
    return {"mdns": {**AnnouncerProcess().status(), "reason": None, "state": "starting", **values}}


def test_check(settings: config.Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    (found,) = (each for each in check(settings) if each.subject == "mDNS")
    assert found.level == "ok"
    assert "announced on the network as 'line-3' (_secure-mqtt 8883)" in found.text
    monkeypatch.setenv("APPLIANCE_MDNS", "off")
    (found,) = (each for each in check(settings) if each.subject == "mDNS")
    assert found.text == "not announced on the network: APPLIANCE_MDNS=off in the environment"


def test_doctor(settings: config.Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examined, "multicast_interfaces", lambda: ["eth0"])
    monkeypatch.setattr(examined, "links", lambda interfaces: ["eth0: 192.0.2.1"])
    monkeypatch.setattr(examined, "_is_kept_to_itself", lambda: False)
    (found,) = mdns(settings, None)
    assert (found.level, found.text) == ("ok", "can be announced on eth0: 192.0.2.1")
    (found,) = mdns(settings, status(state="announced", name="r2", links=["eth0: 192.0.2.1"]))
    assert (found.level, found.text) == ("ok", "announced as 'r2' on eth0: 192.0.2.1")
    (found,) = mdns(settings, status(state="off", reason="broker.mdns is false"))
    assert (found.level, found.text) == ("ok", "nothing is announced: broker.mdns is false")
    monkeypatch.setattr(examined, "_is_kept_to_itself", lambda: True)
    (found,) = mdns(settings, status(state="failed"))
    assert found.level == "warning" and "disallow-other-stacks=no" in found.advice
    monkeypatch.setattr(examined, "multicast_interfaces", list)
    (found,) = mdns(settings, None)
    assert found.level == "warning" and "nobody can find it" in found.text


def test_status(
    appliance: ApplianceProcess, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """The tests' own appliance announces nothing."""
    assert run("status", "-c", str(appliance.config)) == 0
    assert "mDNS          off: APPLIANCE_MDNS=off in the environment" in capsys.readouterr().out
    links = ["eth0: 192.0.2.1", "eth1: 198.51.100.1"]
    told = status(state="announced", name="r2", links=links)["mdns"]
    assert _mdns(told) == "announced as r2 on eth0: 192.0.2.1; eth1: 198.51.100.1"
    assert _mdns(status(state="waiting")["mdns"]) == "not announced: there is no network"
    assert _mdns(status(state="failed")["mdns"]) == "NOT announced"
    assert _mdns(status()["mdns"]) == "is being started"
