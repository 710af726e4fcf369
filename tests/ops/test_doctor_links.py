"""`appliance doctor` on links: how far each server is reached, without a login."""

from __future__ import annotations

import base64
import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from upstream.peers import FleetMosquitto
from waiting import until

from appliance import config
from appliance.ops.doctor import links as module
from appliance.ops.doctor.links import links
from appliance.ops.finding import Finding

#: Seconds for one step: a busy computer may stand still for some.
STEP = 10.0


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[FleetMosquitto]:
    with FleetMosquitto(tmp_path / "fleet") as broker:
        yield broker


@pytest.fixture
def silent() -> Iterator[int]:
    """A port that accepts, and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def examined(directory: Path, *sections: dict[str, Any]) -> list[Finding]:
    said = {"robot": "r2", "bridge": {"bus": "none"}, "upstreams": list(sections)}
    (directory / "appliance.yaml").write_text(yaml.safe_dump(said))
    return list(links(config.load(directory / "appliance.yaml"), None))


def test_each_server_is_reached_or_the_step_is_named(
    tmp_path: Path, fleet: FleetMosquitto, silent: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STEP_TIMEOUT", STEP)
    ca = {"ca": str(fleet.directory / "certs/ca.crt")}
    tls, plain = f"mqtts://127.0.0.1:{fleet.port}", f"mqtt://127.0.0.1:{fleet.plain_port}"
    began = time.monotonic()
    found = examined(
        tmp_path,
        {"name": "good", "servers": [tls, f"mqtt://127.0.0.1:{silent}", plain], "tls": ca},
        {"name": "stranger", "servers": [tls]},
        {"name": "mixed", "servers": [f"mqtts://127.0.0.1:{fleet.plain_port}"], "tls": ca},
        {"name": "late", "servers": [plain, f"ws://127.0.0.1:{silent}/mqtt"]},
        {"name": "proxy", "servers": [plain], "proxy": f"http://127.0.0.1:{silent}"},
    )
    assert time.monotonic() - began < 3 * STEP, "the silent ones are asked at once"
    told = [(each.subject.split()[1], each.level, each.text) for each in found]
    levels = [(name, level) for name, level, _ in told]
    assert levels == [
        *[("good", "ok")] * 3,
        ("stranger", "error"),
        ("mixed", "error"),
        ("late", "ok"),
        ("late", "warning"),  # the other one answers
        ("proxy", "error"),
    ]
    assert "TLSv1.3, its certificate is valid until" in told[0][2]
    for place, words in (
        (3, "of no authority"),
        (4, "is the port one for mqtt://"),
        (6, "does not answer to HTTP"),
        (7, "the proxy"),
    ):
        assert words in told[place][2]
    assert f"{tls}: at the step tls: " in told[3][2]
    # Nobody has logged in, and nobody has said anything.
    assert "New client connected" not in fleet.log


def test_all_of_it_takes_a_limited_time(
    tmp_path: Path, silent: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "TIMEOUT", 0.2)
    (found,) = examined(tmp_path, {"name": "a", "servers": [f"wss://127.0.0.1:{silent}/mqtt"]})
    assert (found.level, "not answered within 0.2 s" in found.text) == ("error", True)


def test_a_token_that_has_expired(tmp_path: Path, silent: int) -> None:
    claims = base64.urlsafe_b64encode(json.dumps({"exp": time.time() - 60}).encode()).decode()
    (tmp_path / "token").touch(0o600)
    (tmp_path / "token").write_text(f"x.{claims.rstrip('=')}.y")
    link = {"name": "a", "servers": [f"mqtt://127.0.0.1:{silent}"]}
    login = {"username": "r2", "token_file": "token"}
    assert [each.level for each in examined(tmp_path, {**link, "login": login})] == ["error", "ok"]


def test_without_links_nothing_is_dialled(tmp_path: Path) -> None:
    assert examined(tmp_path) == []


async def test_a_fault_in_a_turn_ends_nothing(escaped: list[str]) -> None:
    class Member:
        def take_turn(self) -> None:
            raise ZeroDivisionError

    alone = module._Alone()
    alone.queue_turn(Member())
    faults = alone.entries.faults
    await until(lambda: faults.by_entry == {"doctor.turn": 1})
    escaped.clear()
