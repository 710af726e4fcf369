"""`/api/v1`: publish and call over HTTP, with the identity, the rules and the limits of MQTT."""

from __future__ import annotations

import asyncio
import base64
import json
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from both_loops import event_loop_policy as event_loop_policy
from http_client import answer, ask
from waiting import until
from web_app import WebApp

from appliance.access import Passwords
from appliance.broker.link import ReceivingLink
from appliance.broker.message import Message
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ReasonCode
from appliance.net import http
from appliance.web import api

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

ACL = """\
pattern read $CONTROL/appliance/v1/+/_reply/%c/#
user admin
topic write $CONTROL/appliance/v1/+/_call/#
topic readwrite r2d2/#
user viewer
topic read r2d2/#
"""
PASSWORD = "opensesame"


def basic(user: str = "admin", password: str = PASSWORD) -> dict[str, str]:
    pair = base64.b64encode(f"{user}:{password}".encode()).decode()
    return {"Authorization": f"Basic {pair}"}


@pytest.fixture
async def web(tmp_path: Path) -> AsyncIterator[WebApp]:
    web = WebApp(tmp_path)
    (tmp_path / "acl.conf").write_text(ACL)
    users = Passwords.load(tmp_path / "users.passwd")
    for name in ("admin", "viewer"):
        users.set(name, PASSWORD)
    users.save()
    await web.app.start()
    yield web
    assert not web.app.broker.faults.count
    await web.stop()


async def post(
    web: WebApp, path: str, body: object, **headers: str
) -> tuple[int, dict[str, str], Any]:
    """The answer to a POST, its body as JSON where it is that."""
    peer = await web.dial()
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    fields = {"Content-Type": "application/json", **basic(), **headers}
    fields |= {"Host": "localhost", "Content-Length": str(len(data))}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items() if value)
    await peer.send(f"POST /api/v1/{path} HTTP/1.1\r\n{lines}\r\n".encode() + data)
    status, found, content = await answer(peer)
    is_json = found["content-type"] == "application/json"
    return status, found, json.loads(content) if is_json else content.decode()


def listen(web: WebApp) -> list[Message]:
    """The messages below r2d2/ from now on."""
    messages: list[Message] = []
    session = web.app.broker.attach(
        "_test", ReceivingLink(lambda message, retain, ids: messages.append(message))
    )
    web.app.broker.subscribe(session, Subscription("r2d2/#", 0))
    return messages


async def test_status_and_routes(web: WebApp):
    status, headers, body = await web.get("/api/v1/status", **basic())
    assert status == 200 and headers["content-type"] == "application/json"
    assert json.loads(body)["version"]
    status, _, body = await web.get("/api/v1/routes", **basic())
    assert status == 503 and json.loads(body)["error"]["code"] == "unavailable"  # no bridge
    for path in ("status", "routes"):
        assert (await web.get(f"/api/v1/{path}", **basic("viewer")))[0] == 403
        assert (await web.get(f"/api/v1/{path}"))[0] == 401
    assert (await ask(await web.dial(), "POST /api/v1/status"))[1]["allow"] == "GET, HEAD"
    assert (await web.get("/api/v1/publish"))[1]["allow"] == "POST"
    assert (await web.get("/api/v1/"))[0] == (await web.get("/api/v2/status"))[0] == 404


async def test_publish(web: WebApp):
    messages = listen(web)
    wanted: dict[str, Any] = {"topic": "r2d2/a", "payload": {"n": 2**53 + 1, "ä": None}}
    status, _, body = await post(web, "publish", wanted)
    assert (status, body) == (200, {"code": 0, "reason": "success"})
    assert json.loads(messages[0].payload) == wanted["payload"]
    assert (messages[0].properties or {})[Property.CONTENT_TYPE] == "application/json"
    wanted = {
        "topic": "r2d2/b",
        "base64": base64.b64encode(b"\xff\x00").decode(),
        "retain": True,
        "expiry": 60,
        "content_type": "image/png",
        "sent_at": "2026-01-01T00:00:00Z",
    }
    assert (await post(web, "publish", wanted))[0] == 200
    sent, properties = messages[1], messages[1].properties or {}
    assert sent.payload == b"\xff\x00" and sent.retain and sent.expires_at is not None
    assert properties[Property.CONTENT_TYPE] == "image/png"
    assert ("sent-at", "2026-01-01T00:00:00Z") in properties[Property.USER_PROPERTY]  # type: ignore[operator]
    assert list(web.app.broker.retained.find("r2d2/b"))
    status, _, body = await post(web, "publish", {"topic": "r2d2/c", "payload": 1, "qos": 0})
    assert status == 202 and messages[2].payload == b"1"
    assert not any(not each.is_inside for each in web.app.broker.sessions.values())


async def test_nobody_has_subscribed(web: WebApp):
    status, _, body = await post(web, "publish", {"topic": "r2d2/a", "payload": 1})
    assert (status, body) == (200, {"code": 16, "reason": "no_matching_subscribers"})


async def test_what_the_rules_do_not_allow(web: WebApp):
    messages = listen(web)
    for topic in ("r2d2/a", "$SYS/a", "elsewhere", "r2d2/_appliance/state"):
        wanted = {"topic": topic, "payload": 1}
        status, headers, body = await post(web, "publish", wanted, **basic("viewer"))
        assert status == 403 and body["code"] == 0x87, topic
        assert body["error"]["code"] == "not_authorized"
        assert "www-authenticate" not in headers
    call = {"topic": "$CONTROL/appliance/v1/users/_call"}
    status, _, body = await post(web, "call", call, **basic("viewer"))
    assert status == 403
    status, _, body = await post(web, "call", {"topic": "r2d2/reset/_call"}, **basic("viewer"))
    assert status == 403
    assert not messages


async def test_who_may_not_come_in(web: WebApp):
    wanted = {"topic": "r2d2/a", "payload": 1}
    for given in (
        basic("admin", "wrong"),
        basic("nobody"),
        {"Authorization": ""},
        {"Authorization": "Bearer x"},
        {"Authorization": "Bearer appliance-token-" + "x" * 43},
        {"Authorization": "Basic x"},
    ):
        status, headers, body = await post(web, "publish", wanted, **given)
        assert status == 401 and "www-authenticate" not in headers, given
        assert body["error"]["message"]
    failed = web.app.broker.counters.logins_failed
    assert failed == 4  # the third without a name, and the last two of which one did not try


async def test_a_token(web: WebApp):
    status, _, body = await post(
        web,
        "call",
        {"topic": "$CONTROL/appliance/v1/token/_call", "payload": {"password": PASSWORD}},
    )
    assert status == 200
    bearer = {"Authorization": f"Bearer {body['token']}"}
    assert (await web.get("/api/v1/status", **bearer))[0] == 200
    assert (await post(web, "publish", {"topic": "r2d2/a", "payload": 1}, **bearer))[0] == 200
    end = {"topic": "$CONTROL/appliance/v1/token_end/_call", "payload": {"token": None}}
    assert (await post(web, "call", end, **bearer))[2] == {"ended": 1}
    assert (await web.get("/api/v1/status", **bearer))[0] == 401


async def test_a_client_certificate(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    """It is that of the connection with the request which says who asks."""
    monkeypatch.setattr(web.app._login, "_certificate_user", lambda tls: "admin")
    assert (await web.get("/api/v1/status", tls=True))[0] == 200
    assert (await web.get("/api/v1/status", tls=True, **basic("viewer")))[0] == 401
    assert (await web.get("/api/v1/status"))[0] == 401


async def test_calls(web: WebApp):
    def verb(name: str, **more: Any) -> dict[str, Any]:
        return {"topic": f"$CONTROL/appliance/v1/{name}/_call", **more}

    status, _, body = await post(web, "call", verb("users"))
    assert status == 200 and [each["user"] for each in body["users"]] == ["admin", "viewer"]
    for wanted, expected, code in (
        (verb("clients", payload={"limit": 0}), 400, "bad_request"),
        (verb("clients", payload={"search": "x" * 257}), 400, "bad_request"),
        (verb("disconnect", payload={"client": "x"}), 404, "not_found"),
        (verb("no-such-verb"), 403, "not_authorized"),
        ({"topic": "elsewhere/_call"}, 403, "not_authorized"),  # no right to read the answer
        ({"topic": "r2d2/reset/_call"}, 404, "no_matching_subscribers"),
    ):
        status, _, body = await post(web, "call", wanted)
        assert (status, body["error"]["code"]) == (expected, code)
    listen(web)  # somebody who does not answer
    status, _, body = await post(web, "call", {"topic": "r2d2/reset/_call", "timeout": 0.1})
    assert (status, body["error"]["code"]) == (504, "timeout")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (b'{"error": {"code": "rejected", "message": "no"}}', 409),
        (b'{"error": {"code": "its own"}}', 502),
        (b'{"error": {"code": []}}', 502),
        (b'{"error": {"code": null}}', 502),
        (b'{"error": []}', 502),
        (b"[]", 502),
        (b"{", 502),
        (b'{"error": {"code": "rejected"}}'.ljust(api.LONGEST_ERROR), 409),
        (b'{"error": {"code": "rejected"}}'.ljust(api.LONGEST_ERROR + 1), 502),
    ],
)
async def test_an_error_that_anybody_may_have_written(web: WebApp, error: bytes, expected: int):
    broker = web.app.broker
    loop = asyncio.get_running_loop()

    def refuse(asked: Message, retain: bool, ids: list[int] | None) -> None:
        reply = (asked.properties or {})[Property.RESPONSE_TOPIC]
        properties: Properties = {Property.USER_PROPERTY: [("status", "error")]}
        loop.call_soon(publish, Message(reply, error, 1, False, properties))

    def publish(answer: Message) -> None:
        broker.publish(answer, session)
        broker.flush()

    session = broker.attach("_test", ReceivingLink(refuse))
    broker.subscribe(session, Subscription("r2d2/x/_call", 0))
    peer = await web.dial()
    body = b'{"topic": "r2d2/x/_call"}'
    fields = {**basic(), "Content-Type": "application/json", "Content-Length": str(len(body))}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    head = f"POST /api/v1/call HTTP/1.1\r\nHost: localhost\r\n{lines}\r\n"
    await peer.send(head.encode() + body)
    status, _, content = await answer(peer)
    assert (status, content) == (expected, error)  # the fixture sees that nothing was a fault


GOOD = {"topic": "r2d2/a", "payload": 1}
DEEP = b'{"topic": "r2d2/a", "payload": ' + b"[" * 10_000 + b"]" * 10_000 + b"}"
BAD: dict[str, tuple[object, int]] = {
    "nothing": (b"", 400),
    "no JSON": (b"{", 400),
    "no object": ([], 400),
    "no UTF-8": (b'{"topic": "r2d2/\xff", "payload": 1}', 400),
    "deep": (DEEP, 400),
    "NaN": (b'{"topic": "r2d2/a", "payload": NaN}', 400),
    "no topic": ({"payload": 1}, 400),
    "a filter": ({**GOOD, "topic": "r2d2/#"}, 400),
    "a zero": ({**GOOD, "topic": "r2d2/\0"}, 400),
    "a surrogate": (b'{"topic": "r2d2/\\ud800", "payload": 1}', 400),
    "a long topic": ({**GOOD, "topic": "r2d2/" + "x" * 65536}, 400),
    "a topic that is a number": ({**GOOD, "topic": 1}, 400),
    "no payload": ({"topic": "r2d2/a"}, 400),
    "two payloads": ({**GOOD, "base64": ""}, 400),
    "no base64": ({"topic": "r2d2/a", "base64": "!"}, 400),
    "QoS 2": ({**GOOD, "qos": 2}, 400),
    "QoS true": ({**GOOD, "qos": True}, 400),
    "a retain of 1": ({**GOOD, "retain": 1}, 400),
    "an old expiry": ({**GOOD, "expiry": -1}, 400),
    "a far expiry": ({**GOOD, "expiry": 1 << 32}, 400),
    "a long content type": ({**GOOD, "content_type": "x" * 257}, 400),
    "an unknown key": ({**GOOD, "quality": 1}, 400),
    "too much": ({**GOOD, "payload": "x" * api.LONGEST}, 413),
}


async def test_bad_bodies(web: WebApp):
    messages = listen(web)
    for name, (body, expected) in BAD.items():
        status, headers, error = await post(web, "publish", body)
        assert status == expected and error["error"]["message"], name
        assert error["error"]["code"] == ("too_large" if status == 413 else "bad_request"), name
        assert (headers.get("connection") == "close") is (status == 413), name
    assert not messages
    assert (await post(web, "publish", GOOD))[0] == 200


async def test_a_call_whose_answer_has_no_topic(web: WebApp):
    for size, expected in ((65_500, 400), (api.LONGEST_CALLED - 1, 400), (65_300, 403)):
        status, _, error = await post(web, "call", {"topic": "a" * size + "/x"})
        assert status == expected, size  # the fixture sees that nothing was a fault
        assert ("at most" in error["error"]["message"]) is (expected == 400)


@pytest.mark.parametrize("gap", ["\n\nAAAAAA", "\n\r\nAA", "\n\n" + "A" * 8000])
async def test_a_head_that_ends_earlier_for_the_library(web: WebApp, gap: str):
    """What is between would be read twice, and the rest as the next request."""
    peer = await web.dial()
    fields = {**basic(), "Content-Type": "application/json", "Content-Length": "40000"}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    head = f"POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\n{lines}"
    await peer.send(head.removesuffix("\r\n").encode() + gap.encode() + b"\r\n\r\n")
    status, headers, _ = await answer(peer)
    assert (status, headers["connection"]) == (400, "close")
    assert await peer.receive_rest() == b""


async def test_values_that_are_more_work_than_their_bytes(web: WebApp):
    """All others would wait for a tenth of a second while they are read."""
    lists = b'{"topic": "r2d2/a", "payload": [%s[]]}' % (b"[]," * 300_000)
    text = b'{"topic": "r2d2/a", "payload": "%s"}' % (b"[]," * 300_000)
    deep = b'{"topic": "r2d2/a", "payload": %s%s}' % (b"[" * 100_000, b"]" * 100_000)
    for path in ("publish", "call"):
        assert (await post(web, path, lists))[0] == 413
        assert (await post(web, path, deep))[0] == 413
    assert (await post(web, "publish", text))[0] == 200


async def test_json_that_is_nested_deeply(web: WebApp):
    """What can be read cannot always be written again."""
    body = b'{"topic": "r2d2/a", "payload": %s%s}' % (b"[" * 600, b"]" * 600)
    for path in ("publish", "call"):
        assert (await post(web, path, body))[0] == 400


async def test_a_message_larger_than_a_packet_may_be(web: WebApp):
    limits = web.app.broker.limits
    web.app.broker.use(replace(limits, packet_size=4096), web.app.broker.features)
    for qos in (0, 1):
        for size in (5_000, 900_000):
            body = {"topic": "r2d2/a", "payload": "x" * size, "qos": qos}
            assert (await post(web, "publish", body))[0] == 413, (qos, size)
    assert (await post(web, "publish", GOOD))[0] == 200


async def test_a_client_that_is_ended_while_its_body_comes(web: WebApp):
    assert (await post(web, "publish", GOOD))[0] == 200  # its password is known from now on
    await until(lambda: not web.app.broker.clients, "the client to leave")
    peer = await web.dial()
    body = json.dumps({**GOOD, "payload": "x" * 100_000}).encode()
    fields = {**basic(), "Content-Type": "application/json", "Content-Length": str(len(body))}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    await peer.send(f"POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\n{lines}\r\n".encode())
    await until(lambda: web.app.broker.clients, "the client to come")
    for session in list(web.app.broker.sessions.values()):
        if not session.is_inside:
            session.close_link(ReasonCode.ADMINISTRATIVE_ACTION, "ended")
    web.app.broker.flush()
    await until(lambda: not web.app.broker.clients, "the client to leave")
    await peer.send(body)
    assert (await answer(peer))[0] == 503


async def test_the_memory_of_a_body_is_of_who_has_logged_in(web: WebApp):
    assert (await post(web, "publish", GOOD))[0] == 200  # its password is known from now on
    account = web.app.broker.accounting.accounts.of_user("admin")
    peer = await web.dial()
    body = json.dumps({**GOOD, "payload": "x" * 500_000}).encode()
    fields = {**basic(), "Content-Type": "application/json", "Content-Length": str(len(body))}
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    await peer.send(f"POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\n{lines}\r\n".encode())
    await until(lambda: account.bytes == http.COPIES * len(body), "the body to be counted")
    await peer.send(body)
    assert (await answer(peer))[0] == 200
    await until(lambda: not account.bytes, "nothing to be counted")


async def test_bad_calls(web: WebApp):
    call = {"topic": "$CONTROL/appliance/v1/users/_call"}
    for more in ({"timeout": 0}, {"timeout": 61}, {"timeout": "1"}, {"qos": 1}, {"topic": "a/+"}):
        assert (await post(web, "call", {**call, **more}))[0] == 400


async def test_other_content_types(web: WebApp):
    """A page of another site can have a browser send these without asking first."""
    for given in ("text/plain", "application/x-www-form-urlencoded", ""):
        status, headers, _ = await post(web, "publish", GOOD, **{"Content-Type": given})
        assert status == 415 and headers["connection"] == "close"


async def test_pages_of_other_sites(web: WebApp):
    messages = listen(web)
    for origin in ("https://evil.example", "null", "http://localhost:1", "http://localhost.evil"):
        status, headers, _ = await post(web, "publish", GOOD, Origin=origin)
        assert status == 403 and "access-control-allow-origin" not in headers
    assert not messages
    for origin in ("http://localhost", "https://localhost"):  # the second one behind a proxy
        assert (await post(web, "publish", GOOD, Origin=origin))[0] == 200


async def test_a_body_is_wanted_only_of_who_may_come_in(web: WebApp):
    peer = await web.dial()
    head = "POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\nExpect: 100-continue\r\n"
    head += "Content-Type: application/json\r\nContent-Length: 34\r\n"
    await peer.send(f"{head}\r\n".encode())
    assert (await answer(peer))[0] == 401
    assert await peer.receive_rest() == b""
    peer = await web.dial()
    await peer.send(f"{head}Authorization: {basic()['Authorization']}\r\n\r\n".encode())
    assert await peer.reader.readuntil(b"\r\n\r\n") == b"HTTP/1.1 100 \r\n\r\n"
    body = json.dumps(GOOD).ljust(34).encode()
    for part in (body[:7], body[7:] + b"GET /readyz HTTP/1.1\r\nHost: localhost\r\n\r\n"):
        await peer.send(part)
        await asyncio.sleep(0)
    assert [(await answer(peer))[0] for _ in range(2)] == [200, 200]


async def test_a_chunked_body(web: WebApp):
    peer = await web.dial()
    coded = {**basic(), "Transfer-Encoding": "chunked"}
    assert (await ask(peer, "POST /api/v1/publish", **coded))[0] == 411


async def test_a_body_that_does_not_come(web: WebApp):
    length = {**basic(), "Content-Type": "application/json", "Content-Length": "100"}
    assert (await post(web, "publish", GOOD))[0] == 200  # its password is known from now on
    web.app._listeners.scheduler.connect_timeout = 2.0
    peer = await web.dial()
    assert (await ask(peer, "POST /api/v1/publish", **length))[0] == 408
    assert await peer.receive_rest() == b""
    peer = await web.dial()
    lines = "".join(f"{name}: {value}\r\n" for name, value in length.items())
    await peer.send(f"POST /api/v1/publish HTTP/1.1\r\nHost: localhost\r\n{lines}\r\n{{".encode())
    peer.hang_up()
    await until(lambda: not web.app.broker.clients, "the client to leave")


async def test_the_limits_of_connections(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    peer = await web.dial()
    addresses = web.app._listeners._addresses
    monkeypatch.setattr(addresses, "reserve", lambda host, now: "too many")
    status, headers, _ = await ask(peer, "GET /api/v1/status", **basic())
    assert (status, headers["retry-after"]) == (503, "5")


async def test_as_mqtt_it_is_audited_and_counted(web: WebApp):
    connects = web.app.broker.counters.connects
    assert (await post(web, "publish", GOOD))[0] == 200
    assert web.app.broker.counters.connects == connects + 1
    await until(lambda: not web.app.broker.clients, "the client to leave")


async def test_clients_that_go_in_the_middle_leave_nothing(web: WebApp):
    """Two hundred at once: within the head, the body, the login and a call, and after all of it."""
    assert (await post(web, "publish", GOOD))[0] == 200  # its password is known from now on
    await until(lambda: not web.app.broker.clients, "the first client to leave")
    scheduler = web.app._listeners.scheduler
    kept = set(scheduler.connections)  # that of the first request
    body = json.dumps({"topic": "$CONTROL/appliance/v1/status/_call"}).encode()
    fields = {"Host": "localhost", "Content-Type": "application/json", **basic()}
    fields["Content-Length"] = str(len(body))
    lines = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    request = f"POST /api/v1/call HTTP/1.1\r\n{lines}\r\n".encode() + body
    sent = [len(request), len(request) - 1, len(request) - len(body), 20]

    async def begin(number: int) -> None:
        peer = await web.dial()
        await peer.send(request[: sent[number % len(sent)]])
        for _ in range(number % 9):
            await asyncio.sleep(0)
        peer.hang_up()

    await asyncio.gather(*(begin(number) for number in range(200)))
    await until(lambda: scheduler.connections == kept, "all others to end")
    await until(lambda: not web.app.broker.clients, "the clients to leave")
    assert web.app.broker.accounting.accounts.connections == 0
    assert (await post(web, "publish", GOOD))[0] == 200
