"""What docs/prometheus has for the metrics: with Debian's Prometheus, against a real appliance."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import waiting
import yaml
from app.test_metrics import RIGHT, fake, samples, set_passwords, total
from appliance_process import free_ports
from pages import PROJECT
from waiting import PATIENCE
from web_app import WebApp

from appliance.app.reload import ReloadError

PROMETHEUS, PROMTOOL = shutil.which("prometheus"), shutil.which("promtool")
with_prometheus = pytest.mark.skipif(
    PROMETHEUS is None or PROMTOOL is None, reason="no prometheus: apt-get install prometheus"
)

FILES = PROJECT / "docs/prometheus"
ALERTS = FILES / "alerts.yaml"
RULES = [rule for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]]
DASHBOARD = json.loads((FILES / "dashboard.json").read_text())
TARGETS = [each for panel in DASHBOARD["panels"] for each in panel.get("targets", ())]

#: What Prometheus itself adds.
ADDED = {"up", "instance", "job", "le", "robot"}


@pytest.fixture
async def web(tmp_path: Path) -> AsyncIterator[WebApp]:
    web = WebApp(tmp_path)
    for user in ("operator", "prometheus"):
        with (tmp_path / "acl.conf").open("a") as file:
            file.write(f"user {user}\ntopic read $SYS/metrics\n")
    set_passwords(tmp_path / "users.passwd", operator="right", prometheus="scrapes")
    await web.app.start()
    yield web
    await web.stop()


def names(expression: str) -> set[str]:
    """The metrics of an expression."""
    return {*re.findall(r"\b(?:appliance|process)_[a-z_]+|\bup\b", expression)}


def label_names(text: str) -> Iterator[str]:
    """The labels that it groups by, selects by or shows."""
    for group in re.findall(r"\b(?:by|on) \(([^)]*)\)", text):
        yield from group.split(", ")
    yield from re.findall(r"[{,]\s*([a-z]+)(?:!=|=~|=)\"", text)
    yield from re.findall(r"\$labels\.([a-z]+)", text)
    yield from re.findall(r"{{([a-z]+)}}", text)


async def test_what_is_asked_for_is_there(web: WebApp, monkeypatch: pytest.MonkeyPatch) -> None:
    routes = [total("/odom"), total("/cmd_vel", direction="to_ros")]
    text = await (await fake(web, monkeypatch, routes)).render()
    there = {name for name, *_ in samples(text)} | ADDED
    known = {*re.findall(r'[{,]([a-z]+)="', text.decode())} | ADDED
    asked = [rule["expr"] for rule in RULES] + [target["expr"] for target in TARGETS]
    assert len(asked) > 50
    for expression in asked:
        assert names(expression) and names(expression) <= there, expression
    shown = [*asked, *(target["legendFormat"] for target in TARGETS)]
    shown += [text for rule in RULES for text in rule["annotations"].values()]
    for each in shown:
        assert {*label_names(each)} <= known, each


def test_the_dashboard_is_one() -> None:
    panels = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(panels) == len({*panels})
    places = [tuple(panel["gridPos"][key] for key in "xy") for panel in DASHBOARD["panels"]]
    assert len(places) == len({*places})
    assert all(panel["gridPos"]["x"] + panel["gridPos"]["w"] <= 24 for panel in DASHBOARD["panels"])
    variables = {each["name"] for each in DASHBOARD["templating"]["list"]}
    used = {*re.findall(r"\$\{?([a-z]\w*)", json.dumps(DASHBOARD))}
    assert used == variables


@with_prometheus
async def test_promtool_finds_nothing_wrong(web: WebApp, monkeypatch: pytest.MonkeyPatch) -> None:
    routes = [total("/odom"), total("/cmd_vel", direction="to_ros")]
    made = await (await fake(web, monkeypatch, routes)).render()
    _, _, served = await web.get("/metrics", **RIGHT)
    for arguments, given in (
        (["rules", "--lint-fatal", str(ALERTS)], b""),
        (["config", "--syntax-only", str(FILES / "prometheus.yaml")], b""),
        (["metrics"], made),
        (["metrics"], served),
    ):
        command = [str(PROMTOOL), "check", *arguments]
        told = await asyncio.to_thread(
            subprocess.run, command, input=given, capture_output=True, timeout=PATIENCE
        )
        assert told.returncode == 0, (told.stdout + told.stderr).decode()


class Prometheus:
    """Debian's Prometheus with the files of docs/prometheus; asked over its API."""

    def __init__(self, directory: Path, web: WebApp) -> None:
        directory.mkdir()
        (self.port,) = free_ports(1)
        settings = yaml.safe_load((FILES / "prometheus.yaml").read_text())
        # A scrape has as long as there is between two, and hashes a password at first.
        settings["global"] = {"scrape_interval": "3s", "evaluation_interval": "1s"}
        (job,) = settings["scrape_configs"]
        (targets,) = job["static_configs"]
        targets["targets"] = [f"localhost:{web.app.addresses[1][1]}"]
        (directory / "prometheus.yaml").write_text(yaml.safe_dump(settings))
        (directory / "password").write_text("scrapes\n")
        shutil.copy(ALERTS, directory)
        shutil.copy(web.directory / "certs/ca.crt", directory)
        self._log = (directory / "log").open("w+")
        self._process = subprocess.Popen(
            [
                str(PROMETHEUS),
                f"--config.file={directory}/prometheus.yaml",
                f"--storage.tsdb.path={directory}/data",
                f"--web.listen-address=127.0.0.1:{self.port}",
            ],
            stdout=self._log,
            stderr=subprocess.STDOUT,
        )

    def ask(self, path: str, **query: str) -> Any:
        """What it answers; None while it does not."""
        url = f"http://127.0.0.1:{self.port}/api/v1/{path}?{urllib.parse.urlencode(query)}"
        try:
            with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
                return json.load(answer)["data"]
        except urllib.error.URLError:
            assert self._process.poll() is None, self.log()
            return None

    def value(self, expression: str) -> float | None:
        """The value of an expression that has one."""
        found = (self.ask("query", query=expression) or {"result": []})["result"]
        return float(found[0]["value"][1]) if found else None

    def rules(self) -> dict[str, dict[str, Any]]:
        """The alert rules by name, as it has evaluated them."""
        groups = (self.ask("rules") or {"groups": []})["groups"]
        return {rule["name"]: rule for group in groups for rule in group["rules"]}

    def log(self) -> str:
        self._log.seek(0)
        return self._log.read()

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait(PATIENCE)
        self._log.close()


@with_prometheus
async def test_prometheus_scrapes_and_alerts(web: WebApp, tmp_path: Path) -> None:
    prometheus = Prometheus(tmp_path / "prometheus", web)

    async def eventually(what: Callable[[], object], about: str) -> None:
        await asyncio.to_thread(waiting.eventually, what, about)

    try:
        await eventually(lambda: prometheus.value("up") == 1, "the scrape")
        await eventually(lambda: prometheus.value("appliance_store_failing") == 0, "its figures")
        await eventually(
            lambda: {rule["health"] for rule in prometheus.rules().values()} == {"ok"}, "the rules"
        )
        rules = await asyncio.to_thread(prometheus.rules)
        assert {*rules} == {rule["alert"] for rule in RULES}
        await eventually(
            lambda: {rule["state"] for rule in prometheus.rules().values()} == {"inactive"},
            "nothing to be wrong",
        )
        web.file.write_text("robot: [no name]\n")
        with pytest.raises(ReloadError):
            await web.app.reload()
        await eventually(
            lambda: prometheus.rules()["ApplianceReloadRefused"]["state"] == "firing", "the alert"
        )
        (alert,) = (await asyncio.to_thread(prometheus.rules))["ApplianceReloadRefused"]["alerts"]
        assert alert["annotations"]["summary"].startswith("localhost:")
        await web.app.stop()
        await eventually(
            lambda: prometheus.rules()["ApplianceDown"]["state"] == "pending", "its end"
        )
    finally:
        await asyncio.to_thread(prometheus.stop)
