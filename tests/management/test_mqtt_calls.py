"""Verbs as MQTT calls, over a real socket in both versions: who may, who may not, bad arguments."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from both_loops import event_loop_policy as event_loop_policy
from waiting import until

from appliance.app.management import ApplianceVerbs
from appliance.management.mqtt_calls import LIMITS, LONGEST
from appliance.management.topics import TOPICS, topic_of
from appliance.mqtt.codec import V5, Property
from appliance.mqtt.packets import Disconnect, Puback, Publish
from appliance.mqtt.reason import ReasonCode
from appliance.ops.control import ask
from management.managed import BOTH, CallError, Site

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')


@pytest.mark.parametrize("version", BOTH)
async def test_who_is_connected(site: Site, version: int):
    admin = await site.join("a", version=version)
    viewer = await site.join("v", "viewer", properties={Property.SESSION_EXPIRY_INTERVAL: 60})
    await viewer.subscribe("r2d2/odom", 1)
    answer = await admin.call("clients")
    assert answer["next"] is None
    own, other = answer["clients"]
    assert (own["client"], own["user"], own["mqtt"]) == (
        "a",
        "admin",
        "5" if version == V5 else "3.1.1",
    )
    assert other["address"].startswith("127.0.0.1:") and other["tls"] is None
    assert other["subscriptions"] == [{"filter": "r2d2/odom", "qos": 1}]
    viewer.hang_up()
    await until(lambda: site.app.broker.sessions["v"].link is None, "the viewer to leave")
    (away,) = (await admin.call("clients", {"connected": False}))["clients"]
    assert away["client"] == "v" and not away["connected"] and 0 < away["ends_in"] <= 60
    for text, found in (("", ["a", "v"]), ("VIEW", ["v"]), ("127.0.0.1:", ["a"]), ("x", [])):
        listed = (await admin.call("clients", {"search": text}))["clients"]
        assert [each["client"] for each in listed] == found, text
    # The control socket has the same verbs.
    local = await asyncio.to_thread(
        ask, site.app.settings.control, "clients", 30.0, {"user": "viewer"}
    )
    assert [each["client"] for each in local["clients"]] == ["v"]


async def test_pages(site: Site):
    admin = await site.join("a")
    for name in ("b", "c", "d"):
        await site.join(name)
    seen: list[str] = []
    after: dict[str, Any] = {}
    while True:
        page = await admin.call("clients", {"limit": 3, **after})
        seen += [each["client"] for each in page["clients"]]
        if page["next"] is None:
            break
        after = {"after": page["next"]}
    assert seen == ["a", "b", "c", "d"]
    # However long the filters are, an answer is bounded.
    long = await site.join("e")
    for number in range(20):
        await long.subscribe(f"r2d2/{number}/{'x' * 30_000}")
    (first,) = (await admin.call("clients", {"client": "e"}))["clients"]
    assert first["subscription_count"] == 20 and 5 < len(first["subscriptions"]) < 10


@pytest.mark.parametrize("version", BOTH)
async def test_disconnect(site: Site, version: int):
    admin = await site.join("a", version=version)
    other = await site.join("other", "viewer")
    assert await admin.call("disconnect", {"client": "other"}) == {
        "client": "other",
        "disconnected": True,
    }
    told = await other.wait_for(Disconnect)
    assert told.reason_code == ReasonCode.ADMINISTRATIVE_ACTION == 0x98
    with pytest.raises(CallError, match="there is no client 'other'") as refused:
        await admin.call("disconnect", {"client": "other"})
    assert refused.value.code == "not_found"
    with pytest.raises(CallError):  # a part of the appliance
        await admin.call("disconnect", {"client": "_appliance"})
    await until(lambda: len(site.audited()) == 3, "the audit log")
    done, failed, _ = site.audited()
    assert done["what"] == "client disconnected" and done["of"] == "other"
    assert done["by"] == {"client": "a", "user": "admin"}
    assert done["address"].startswith("127.0.0.1:")
    assert failed["what"] == "nothing: client disconnected" and "no client" in failed["error"]


async def test_delete_a_session(site: Site):
    admin = await site.join("a")
    lasting = {Property.SESSION_EXPIRY_INTERVAL: 600}
    other = await site.join("other", "viewer", clean_start=False, properties=lasting)
    await admin.call("disconnect", {"client": "other"})
    assert "other" in site.app.broker.sessions
    answer = await admin.call("delete_session", {"client": "other"})
    assert not answer["disconnected"] and "other" not in site.app.broker.sessions
    other = await site.join("other", "viewer", clean_start=False, properties=lasting)
    await admin.call("delete_session", {"client": "other"})
    assert (await other.wait_for(Disconnect)).reason_code == ReasonCode.ADMINISTRATIVE_ACTION
    assert "other" not in site.app.broker.sessions


@pytest.mark.parametrize("version", BOTH)
async def test_what_may_i_do(site: Site, version: int):
    viewer = await site.join("v", "viewer", version)
    questions = [
        {"action": "publish", "topic": "r2d2/cmd_vel"},
        {"action": "receive", "topic": "r2d2/odom"},
        {"action": "receive", "topic": "r2d2/secret"},
        {"action": "subscribe", "topic": "$share/g/other/#"},
        {"action": "publish", "topic": "r2d2/_appliance/state"},
        {"action": "publish", "topic": topic_of("disconnect")},
        {"action": "publish", "topic": topic_of("rights")},
        {"action": "receive", "topic": topic_of("rights")},
    ]
    drive, see, secret, share, own, kick, rights, spy = (
        await viewer.call("rights", {"questions": questions})
    )["rights"]
    assert not drive["allowed"] and drive["line"] == "topic write r2d2/cmd_vel"
    assert see["allowed"] and "topic read r2d2/#" in see["reason"] and "line" not in see
    assert not secret["allowed"] and "topic deny r2d2/secret" in secret["reason"]
    assert "line" not in secret  # none would help
    assert share["line"] == "topic read other/#"
    assert not own["allowed"] and "line" not in own
    assert kick["line"] == f"topic write {topic_of('disconnect')}"
    assert rights["allowed"] and not spy["allowed"]
    admin = await site.join("a", version=version)
    for topic, line in (("other", "topic write other"), ("r2d2/_appliance/state", None)):
        verdicts = (await admin.call("explain", {"user": "viewer", "topic": topic}))["verdicts"]
        (publish,) = (each for each in verdicts if each["action"] == "publish")
        assert not publish["allowed"] and publish.get("line") == line


@pytest.mark.parametrize("version", BOTH)
async def test_nothing_is_granted_by_default(site: Site, version: int):
    """Who has no right to a verb's topic is refused, and its call goes nowhere."""
    viewer = await site.join("v", "viewer", version)
    other = await site.join("other")
    await viewer.listen("disconnect")
    refused = await viewer.post("disconnect", {"client": "other"})
    if version == V5:
        assert refused.reason_code == ReasonCode.NOT_AUTHORIZED
    assert site.app.broker.sessions["other"].link is not None
    # Nor is a topic that only looks like a verb's open to whoever may write everything there.
    site.rules(f"user admin\ntopic readwrite {TOPICS}/#\ntopic readwrite $SYS/#\n")
    await site.app.reload()
    for topic in (f"{TOPICS}/clients", f"{TOPICS}/clients/_reply/v/1", f"{TOPICS}/nothing/_call"):
        await other.send(Publish(topic, b"{}", 1, packet_id=60_001))
        assert (await other.wait_for(Puback)).reason_code == ReasonCode.NOT_AUTHORIZED


async def test_without_an_acl_file_nobody_manages(site: Site):
    access = site.app._access
    access.adopt(
        access.in_force.__class__(None, None, "r2d2", False, access.in_force.passwords, None)
    )
    admin = await site.join("a")
    assert (await admin.post("clients")).reason_code == ReasonCode.NOT_AUTHORIZED


async def test_nobody_else_reads_a_call_and_none_is_kept(site: Site):
    """There may be a password in it."""
    spy = await site.join("spy")
    for topic_filter in ("$CONTROL/#", f"{TOPICS}/+/_call/#", topic_of("explain")):
        await spy.subscribe(topic_filter)
    admin = await site.join("a")
    with pytest.raises(CallError, match="must not be retained"):
        await admin.call("explain", {"user": "viewer", "topic": "secret"}, retain=True)
    await admin.call("explain", {"user": "viewer", "topic": "secret"})
    # Answers are for whom the rules let read them.
    seen = [(await spy.wait_for(Publish)).topic for _ in range(2)]
    assert all(topic.startswith(f"{TOPICS}/explain/_reply/a/") for topic in seen)
    assert not list(site.app.broker.retained.find("$CONTROL/#"))


BAD = [
    ("clients", b"{", "not JSON"),
    ("clients", [], "should be an object"),
    ("clients", {"limit": 0}, "'limit': Input should be greater than or equal to 1"),
    ("clients", {"limit": "3"}, "'limit'"),
    ("clients", {"limit": 10**30}, ""),
    ("clients", {"__proto__": 1, **{f"k{n}": n for n in range(20)}}, "and 16 more"),
    ("clients", {"x" * 60_000: 1}, "Unexpected keyword argument"),
    ("disconnect", {}, "'client': Field required"),
    ("disconnect", {"client": None}, "'client'"),
    ("clients", b"[" * 1_000, "not JSON"),
    ("rights", {"questions": [{"action": "publish", "topic": "a/#"}]}, "'a/#'"),
    ("rights", {"questions": [{"action": "subscribe", "topic": "a/#/b"}]}, "a/#/b"),
    ("rights", {"questions": [{"action": "fly", "topic": "a"}]}, "questions.0.action"),
    ("rights", {"questions": [{"action": "publish", "topic": ""}]}, "''"),
    ("rights", {"questions": [{"action": "receive", "topic": "a"}] * 201}, "at most 200"),
    ("explain", {"user": None, "topic": "a/#/b"}, "a/#/b"),
]


async def test_bad_arguments(site: Site):
    admin = await site.join("a")
    for verb, arguments, told in BAD:
        with pytest.raises(CallError) as refused:
            await admin.call(verb, arguments)
        assert refused.value.code == "bad_request" and told in str(refused.value), arguments
        assert len(str(refused.value)) < 2500
    assert not site.app.broker.faults.count


async def test_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    async def hang(*_: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(ApplianceVerbs, "_status", hang)
    site = Site(tmp_path)
    await site.app.start()
    admin = await site.join("a")
    with pytest.raises(CallError, match=f"takes {LONGEST} at most") as refused:
        await admin.call("clients", b" " * (LONGEST + 1))
    assert refused.value.code == "too_large"
    with pytest.raises(CallError, match="too many values") as refused:
        await admin.call("rights", b'{"questions": [%s[]]}' % (b"[]," * 20_000))
    assert refused.value.code == "too_large"
    await admin.listen("status")
    for _ in range(LIMITS.client + 1):
        assert not (await admin.post("status", {})).reason_code
    error = json.loads((await admin.wait_for(Publish)).payload)["error"]
    assert error["code"] == "too_many" and "bridge.limits" not in error["message"]
    stop = asyncio.ensure_future(site.app.stop())
    for _ in range(LIMITS.client):  # whoever waits when it stops is told so
        error = json.loads((await admin.wait_for(Publish)).payload)["error"]
        assert error["code"] == "stopping"
    await stop
    await site.stop()
