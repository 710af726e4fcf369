"""The web of the whole appliance: what is there without a login, and to whom."""

from __future__ import annotations

import json
import ssl
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from both_loops import event_loop_policy as event_loop_policy
from harness import make_contexts
from http_client import answer, ask
from web_app import SETTINGS, WebApp

from appliance import config
from appliance.app.main import App
from appliance.net.http import HttpRequest
from appliance.ops import watchdog
from appliance.web.authority import ca_certificate

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')


@pytest.fixture
async def web(tmp_path: Path) -> AsyncIterator[WebApp]:
    web = WebApp(tmp_path)
    await web.app.start()
    yield web
    await web.stop()


async def test_it_is_well(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    status, _, body = await web.get("/healthz")
    assert (status, body) == (200, b"ok\n")
    peer = await web.dial()
    assert (await ask(peer, "HEAD /healthz"))[0] == 200
    assert (await ask(peer, "POST /healthz"))[1]["allow"] == "GET, HEAD"
    # One turn serves all who ask at once, and the watchdog's own question is another one.
    asked = [await web.dial() for _ in range(5)]
    for each in asked:
        await each.send(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert {(await answer(each))[0] for each in asked} == {200}
    assert web.app._pulse.is_alive()


@pytest.mark.patches
async def test_it_is_not_well(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    """As the watchdog: what counts is work that is done, not that the loop answers."""
    pulse, scheduler = web.app._pulse, web.app._listeners.scheduler
    with monkeypatch.context() as stuck:
        stuck.setattr(watchdog, "TURN_PATIENCE", 0.05)
        stuck.setattr(scheduler, "queue_turn", lambda member: None)
        status, _, body = await web.get("/healthz")
        assert (status, body) == (503, b"no message has gone through a turn\n")
    pulse._is_queued = False
    assert (await web.get("/healthz"))[0] == 200
    with monkeypatch.context() as late:
        late.setattr(web.app.broker, "ticked_at", web.app.broker.ticked_at - 10)
        late.setattr(web.app.broker, "tick", lambda now: now + 1)
        status, _, body = await web.get("/healthz")
        assert (status, body) == (503, b"the broker's clock stands still\n")


async def test_what_is_ready(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    status, headers, body = await web.get("/readyz")
    assert status == 200 and headers["content-type"] == "application/json"
    ready = {"mqtt": "ready", "store": "ready", "ros": "off", "upstream": "off"}
    assert json.loads(body) == ready

    class Part:
        state = "waiting"
        is_connected = False
        failing = True
        path = "x"

    for place, name, what in (
        ("bridge", Part(), "ros"),
        ("upstreams", [Part()], "upstream"),
        ("_store", Part(), "store"),
    ):
        with monkeypatch.context() as broken:
            broken.setattr(web.app, place, name)
            if what == "store":
                parts = web.app._listeners._make_site()  # type: ignore[misc]
                broken.setattr(web.app._listeners, "_site", parts)
            status, _, body = await web.get("/readyz")
            assert (status, json.loads(body)) == (503, {**ready, what: "not ready"})


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/", "/ca.crt"])
async def test_nothing_open_says_a_version(web: WebApp, path: str):
    _, headers, body = await web.get(path)
    told = json.dumps(headers) + (body.decode() if path != "/ca.crt" else "")
    for word in ("appliance", "0.1", "h11", "python", "server"):
        assert word not in told.lower().replace("content-security", "")


async def test_the_console(web: WebApp):
    """Its page, and a file that the page names; read when the first browser asks."""
    status, headers, page = await web.get("/", tls=True)
    assert status == 200 and headers["cache-control"] == "no-store"
    assert headers["content-security-policy"].startswith("default-src 'none'; script-src 'self'")
    path = page.decode().partition('<script type="module" src="')[2].partition('"')[0]
    status, headers, body = await web.get(path, **{"Accept-Encoding": "gzip"})
    assert status == 200 and headers["content-encoding"] == "gzip"
    assert headers["content-type"] == "text/javascript; charset=utf-8"
    assert headers["cache-control"] == "public, max-age=31536000, immutable" and body
    assert (await web.get("/console/../etc/passwd"))[0] == 404


async def test_the_certificate_of_the_ca(web: WebApp):
    pem = (web.directory / "certs/ca.crt").read_bytes()
    for tls in (False, True):  # both from this computer
        status, headers, body = await web.get("/ca.crt", tls)
        assert status == 200 and headers["content-type"] == "application/x-x509-ca-cert"
        assert headers["content-disposition"] == 'attachment; filename="ca.crt"'
        assert body.split() == pem.split()


@pytest.mark.parametrize(
    ("peer", "is_tls", "status"),
    [
        ("192.0.2.1", False, 403),
        ("192.0.2.1", True, 200),
        ("::ffff:192.0.2.1", False, 403),
        ("fe80::1%eth0", False, 403),
        ("::1", False, 200),
        ("::ffff:127.0.0.1", False, 200),
        ("127.9.9.9", False, 200),
        ("", False, 200),
    ],
)
async def test_the_certificate_goes_where_nobody_can_replace_it(
    peer: str, is_tls: bool, status: int
) -> None:
    tls = ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), ssl.MemoryBIO())
    request = HttpRequest(
        "GET", "/ca.crt", "", "robot", (), f"{peer}:1", peer, tls if is_tls else None, None
    )
    assert (await ca_certificate(lambda: b"pem").respond(request)).status == status
    if status == 200:
        assert (await ca_certificate(bytes).respond(request)).status == 404


async def test_a_certificate_of_somebody_else_s_ca(tmp_path: Path):
    """`broker.tls.ca` is who signs clients; what is served is who signed the server."""
    web = WebApp(tmp_path)
    make_contexts(tmp_path / "other")
    other = (tmp_path / "other/ca.crt").read_bytes()
    (tmp_path / "certs/ca.crt").write_bytes(other)
    await web.app.start()
    try:
        assert (await web.get("/ca.crt"))[0] == 404
    finally:
        await web.stop()


async def test_the_names_are_those_of_the_certificate(web: WebApp):
    assert "localhost" in web.app._tls.names  # type: ignore[union-attr]
    assert (await web.get("/healthz", Host="robot.example"))[0] == 421
    assert (await web.get("/healthz", Host="192.0.2.7"))[0] == 200


async def test_a_listener_for_the_web_comes_and_goes_with_a_reload(tmp_path: Path):
    web = WebApp(tmp_path)
    both = SETTINGS["broker"]["listeners"]

    def write(*listeners: dict[str, Any]) -> None:
        broker = {**SETTINGS["broker"], "listeners": list(listeners)}
        web.file.write_text(yaml.safe_dump({**SETTINGS, "broker": broker}))

    plain = {"bind": "unix:mqtt.sock"}
    write(plain, {**both[1], "protocol": "mqtt"})
    web.app = App(config.load(web.file))
    await web.app.start()
    try:
        assert web.app._listeners._site is None
        write(plain, {**both[1], "bind": "127.0.0.1:0"}, both[0])
        await web.app.reload()
        web.app.addresses = web.app._listeners.addresses[2:]
        assert (await web.get("/healthz"))[0] == 200
        peer = await web.dial()
        write(plain, {**both[1], "protocol": "mqtt"})
        await web.app.reload()
        with pytest.raises(OSError):
            await web.dial()
        assert (await ask(peer, "GET /readyz"))[0] == 200  # open connections stay
    finally:
        await web.stop()
