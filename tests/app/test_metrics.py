"""`/metrics` of the whole appliance: who may read it, what it says, and what it costs."""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from both_loops import event_loop_policy as event_loop_policy
from http_client import ask
from prometheus_client.parser import text_string_to_metric_families
from ros.call_harness import AllTypes
from waiting import until
from web_app import WebApp

from appliance.access import Passwords
from appliance.app.metrics import Metrics
from appliance.broker.values import Decision
from appliance.ros.bridge import Bridge, TopicSettings
from appliance.ros.metrics import FlowCounters
from appliance.ros.node import FakeNode
from appliance.ros.status import RouteTotal
from appliance.upstream.status import LinkStatus

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

ACL = "user operator\ntopic read $SYS/metrics\nuser bob\ntopic read r2d2/#\n"
PASSWORDS = {"operator": "right", "bob": "bob's"}


def basic(user: str, password: str) -> dict[str, str]:
    pair = base64.b64encode(f"{user}:{password}".encode()).decode()
    return {"Authorization": f"Basic {pair}"}


RIGHT = basic("operator", "right")


def set_passwords(file: Path, **passwords: str) -> None:
    users = Passwords.load(file)
    for user, password in passwords.items():
        users.set(user, password)
    users.save()


@pytest.fixture
async def web(tmp_path: Path) -> AsyncIterator[WebApp]:
    web = WebApp(tmp_path)
    (tmp_path / "acl.conf").write_text(ACL)
    set_passwords(tmp_path / "users.passwd", **PASSWORDS)
    await web.app.start()
    yield web
    await web.stop()


def samples(text: bytes) -> dict[tuple[str, ...], float]:
    """By name and label values, as Prometheus reads it."""
    return {
        (each.name, *each.labels.values()): each.value
        for family in text_string_to_metric_families(text.decode())
        for each in family.samples
    }


async def scrape(web: WebApp, tls: bool = True) -> dict[tuple[str, ...], float]:
    status, headers, body = await web.get("/metrics", tls, **RIGHT)
    assert status == 200, body
    assert headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
    return samples(body)


async def test_who_may_read_it(web: WebApp):
    counters = web.app.broker.counters
    for given, status in (
        (RIGHT, 200),
        (basic("bob", "bob's"), 403),
        (basic("operator", "wrong"), 401),
        (basic("nobody", "right"), 401),
        (basic("operator", ""), 401),
        ({}, 401),
        ({"Authorization": "Bearer x"}, 401),
        ({"Authorization": "Digest x"}, 401),
    ):
        found, headers, body = await web.get("/metrics", **given)
        assert found == status, given
        assert "www-authenticate" not in headers
        assert status == 200 or len(body) < 200
    assert counters.logins_failed == 5  # the last one did not try
    peer = await web.dial()
    assert (await ask(peer, "HEAD /metrics", **RIGHT))[0] == 200
    assert (await ask(peer, "HEAD /metrics"))[0] == 401
    assert (await ask(peer, "POST /metrics", **RIGHT))[0] == 405


async def test_a_right_or_a_user_that_is_taken_away(web: WebApp):
    peer = await web.dial()
    assert (await ask(peer, "GET /metrics", **RIGHT))[0] == 200
    (web.directory / "acl.conf").write_text("user operator\ntopic read r2d2/#\n")
    await web.app.reload()
    assert (await ask(peer, "GET /metrics", **RIGHT))[0] == 403
    set_passwords(web.directory / "users.passwd", operator="another")
    await web.app.reload()
    assert (await ask(peer, "GET /metrics", **RIGHT))[0] == 401
    assert (await ask(peer, "GET /metrics", **basic("operator", "another")))[0] == 403


async def test_a_token_reads_it(web: WebApp):
    access = web.app._access
    token = await access.issue_token("operator", b"right", "127.0.0.1:1")
    bearer = {"Authorization": f"Bearer {token}"}
    status, _, body = await web.get("/metrics", **bearer)
    found = samples(body)
    assert status == 200
    assert found["appliance_tokens",] == found["appliance_tokens_issued_total",] == 1
    assert (await web.get("/metrics", **basic("operator", str(token))))[0] == 200
    assert (await web.get("/metrics", **basic("bob", str(token))))[0] == 401
    web.app._login._files._in_force = replace(access.in_force, anonymous=True)
    assert (await web.get("/metrics", Authorization="Bearer x"))[0] == 401  # not as anybody
    set_passwords(web.directory / "users.passwd", operator="another")
    await web.app.reload()
    assert (await web.get("/metrics", **bearer))[0] == 401


async def test_guesses_are_throttled_with_those_of_mqtt(
    web: WebApp, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    access = web.app._login._files
    began = time.monotonic()
    monkeypatch.setattr(access.throttle, "_clock", lambda: began)  # a failure drains in two seconds
    assert (await web.get("/metrics", **RIGHT))[0] == 200
    for number in range(3):
        assert (await web.get("/metrics", **basic("operator", f"swordfish-{number}")))[0] == 401
    failures = access.throttle._networks
    assert [each.level for each in failures.values()] == [3]
    monkeypatch.setattr(access.throttle, "reserve", lambda *arguments: None)
    status, headers, _ = await web.get("/metrics", **basic("operator", "swordfish"))
    assert (status, headers["retry-after"]) == (503, "5")
    assert (await web.get("/metrics", **RIGHT))[0] == 200  # a known password is no guess
    told = [record.getMessage() for record in caplog.records]
    assert any("HTTP (user 'operator') at 127.0.0.1" in text for text in told)
    assert not any("swordfish" in text for text in told)


async def test_hashing_does_not_hold_up_the_loop(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    begun, end = asyncio.Event(), asyncio.Event()

    async def run(queue: bytes, check: object) -> None:
        begun.set()
        await end.wait()

    monkeypatch.setattr(web.app._login._files._hashing, "run", run)
    asking = asyncio.create_task(web.get("/metrics", **RIGHT))
    await begun.wait()
    assert (await web.get("/healthz"))[0] == 200
    end.set()
    assert (await asking)[0] == 401  # what `run` returns is no hash


@pytest.mark.patches
async def test_the_answer_of_a_plugin_is_waited_for(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    router = web.app.broker.router
    decisions = [Decision(False, "", pending=True), Decision(True, "")]
    wakes: list[Any] = []

    def is_pending(question: object, wake: Any) -> bool:
        wakes.append(wake)
        return True

    monkeypatch.setattr(router, "decide", lambda *question: decisions[len(wakes) > 0])
    asked = SimpleNamespace(timeout=60.0, is_pending=is_pending)
    monkeypatch.setattr(router, "pending_decisions", asked)
    asking = asyncio.create_task(web.get("/metrics", **RIGHT))
    await until(lambda: wakes, "the plugin to be asked")
    assert not asking.done()
    wakes[0]()
    assert (await asking)[0] == 200
    wakes.clear()
    asked.timeout = 0.0
    assert (await web.get("/metrics", **RIGHT))[0] == 403


async def test_what_it_says_of_the_broker(web: WebApp):
    found = await scrape(web)
    assert found["appliance_sessions", "connected"] == found["appliance_clients",] == 0
    assert found["appliance_ros_joined",] == 0 and found["appliance_errors_total",] == 0
    assert found["appliance_store_failing",] == 0 and found["appliance_store_limit_bytes",] > 0
    assert found["appliance_reload_success",] == 1
    assert abs(found["appliance_reload_timestamp_seconds",] - time.time()) < 3600
    for what in ("server", "ca"):
        name = "appliance_certificate_expiry_timestamp_seconds"
        assert found[name, what] > time.time() + 86400
    assert found["process_resident_memory_bytes",] > 1 << 20
    assert found["process_open_fds",] < found["process_max_fds",]
    assert found["appliance_build_info", "0.1.0"] == 1
    before = found["appliance_messages_received_total", "client"]
    web.app.broker.counters.publish_received += 5
    web.app.broker.counters.refuse(0x87)
    web.app.broker.counters.drop("too_large")
    await web.get("/metrics", **basic("operator", "wrong"))
    found = await scrape(web, tls=False)
    assert found["appliance_messages_received_total", "client"] == before + 5
    assert found["appliance_connects_refused_total", "not_authorized"] == 1
    assert found["appliance_messages_dropped_total", "too_large"] == 1
    assert found["appliance_messages_dropped_total", "queue_full"] == 0
    assert found["appliance_logins_failed_total",] == 1
    await until(lambda: sum(web.app._lag.counts), "a tick of the clock")
    assert (await scrape(web))["appliance_loop_lag_seconds_count",] >= 1


#: The names that the appliance promises, and that alert rules may use.
BROKER = """
build_info clients sessions subscriptions connects_total connects_refused_total logins_failed_total
packets_received_total packets_sent_total messages_received_total messages_sent_total
message_bytes_received_total message_bytes_sent_total network_bytes_received_total
network_bytes_sent_total messages_dropped_total messages_throttled_total messages_refused_total
retained_messages tokens tokens_issued_total
retained_bytes queued_bytes memory_limit_bytes loop_lag_seconds_bucket errors_total
store_commits_total store_commit_seconds_bucket store_lag_seconds store_bytes store_limit_bytes
store_failing certificate_expiry_timestamp_seconds reload_success reload_timestamp_seconds
ros_joined ros_nodes route_topics route_messages_total route_bytes_total route_dropped_total
route_lost_total route_throttled_total route_skipped_total route_errors_total route_expired_total
route_refused_total route_clamped_total route_stops_total route_latency_seconds_bucket calls_total
call_seconds_bucket goals upstream_connected upstream_backlog_messages upstream_backlog_bytes
upstream_backlog_age_seconds upstream_sent_total upstream_received_total upstream_dropped_total
"""
PROCESS = "cpu_seconds_total resident_memory_bytes virtual_memory_bytes start_time_seconds open_fds"


def total(name: str, mqtt: str = "{robot}{ros}", direction: Any = "to_mqtt") -> RouteTotal:
    settings = TopicSettings(name, "mqtt" if direction == "to_mqtt" else "ros", mqtt)
    counters = FlowCounters(1, 2, 3, messages=7, bytes=700, stops=10)
    counters.latency.observe(0.003)
    return RouteTotal(settings, direction, 1, counters)


async def fake(web: WebApp, monkeypatch: pytest.MonkeyPatch, routes: list[RouteTotal]) -> Metrics:
    """The metrics of an appliance with these routes, a call and a link."""
    from appliance.ros.calls.dispatcher import CallCounters
    from appliance.ros.calls.routes import CallStatus, ServiceSettings

    counters = CallCounters(calls=3, answers=2)
    counters.errors["timeout"] += 1
    counters.duration.observe(0.1)
    called = CallStatus(ServiceSettings(("/reset",), "r2d2/reset"), (), counters)
    bridge = Bridge(FakeNode(), web.app.broker, (), asyncio.get_running_loop(), "r2d2")
    bridge.peers = 4
    monkeypatch.setattr(bridge, "totals", lambda: routes)
    monkeypatch.setattr(bridge.calls, "status", lambda: [called])
    link = LinkStatus("fleet", "mqtt", True, waiting=3, sent=11, received=12)
    link.dropped = {"a/#": {"expired": 2}}
    monkeypatch.setattr(web.app, "bridge", bridge)
    monkeypatch.setattr(web.app, "upstreams", [SimpleNamespace(status=lambda: link)])
    site: Any = web.app._listeners._site
    cells = [cell.cell_contents for cell in site._resources["/metrics"].respond.__closure__]
    return next(each.__self__ for each in cells if hasattr(each, "__self__"))


async def test_every_name_is_there(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    routes = [
        total("/odom"),
        total("/cmd_vel", direction="to_ros"),
        total("/tf", "other/{ros}/x"),
        total("/tf", "other/{ros}/x"),
    ]
    found = samples(await (await fake(web, monkeypatch, routes)).render())
    names = {name for name, *_ in found}
    wanted = {f"appliance_{name}" for name in BROKER.split()}
    wanted |= {f"process_{name}" for name in PROCESS.split()}
    assert wanted <= names, wanted - names
    extra = {name for name in names - wanted if not name.endswith(("_sum", "_count", "_max_fds"))}
    assert not extra
    assert found["appliance_route_messages_total", "/odom", "to_mqtt"] == 7
    assert found["appliance_route_stops_total", "/cmd_vel", "to_ros"] == 10
    assert found["appliance_route_lost_total", "/tf other/{ros}/x", "to_mqtt"] == 1
    assert found["appliance_route_lost_total", "/tf other/{ros}/x (2)", "to_mqtt"] == 1
    assert found["appliance_route_latency_seconds_count", "/odom", "to_mqtt"] == 1
    assert found["appliance_messages_received_total", "ros"] == 21
    assert found["appliance_messages_received_total", "upstream"] == 12
    assert found["appliance_calls_total", "service", "answered"] == 2
    assert found["appliance_calls_total", "service", "timeout"] == 1
    assert found["appliance_call_seconds_count", "service"] == 1
    assert found["appliance_upstream_dropped_total", "fleet", "a/#", "expired"] == 2
    assert found["appliance_ros_nodes",] == 4


@pytest.mark.timed
async def test_what_a_hundred_routes_cost(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    metrics = await fake(web, monkeypatch, [])
    node, loop = FakeNode(types=AllTypes()), asyncio.get_running_loop()
    routes = [TopicSettings(f"/topic/number_{n}", "mqtt", "{robot}{ros}") for n in range(100)]
    bridge = Bridge(node, web.app.broker, routes, loop, "r2d2")
    bridge.start()
    try:
        for route in routes:
            node.add_publisher(route.ros, "std_msgs/msg/String")
        node.spin()
        await until(lambda: len(bridge.topics()) == 100, "the topics")
        monkeypatch.setattr(web.app, "bridge", bridge)
        await metrics.render()  # the dates of certificates are cached now
        took = []
        for _ in range(30):
            began = time.process_time()
            text = await metrics.render()
            took.append(time.process_time() - began)
        assert samples(text)["appliance_route_topics", "/topic/number_99", "to_mqtt"] == 1
        print(f"{min(took) * 1000:.2f} ms at least, {sorted(took)[15] * 1000:.2f} ms in the median")
        # The budget is 2 ms, of which 1.5 ms are used on a quiet computer; this one may be slower.
        assert min(took) < 0.004
    finally:
        await bridge.stop()
