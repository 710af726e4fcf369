"""Enrolments, from the verb to the login with the password that a phone has set over HTTP."""

from __future__ import annotations

import asyncio
import base64
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from both_loops import event_loop_policy as event_loop_policy
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import pkcs12
from http_client import ask
from web_app import WebApp

from appliance import certs
from appliance.access import Passwords
from appliance.app import enrolment
from appliance.broker.values import Identity
from appliance.management import phone_certificates
from appliance.management.verbs import LOCAL, Caller
from appliance.net.http import HttpRequest
from appliance.ros.calls.dispatcher import CallError

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy"')

ORIGIN = "https://robot.local:8443"
RULES = """\
user admin
topic write $CONTROL/appliance/v1/+/_call/#
user helper
topic write $CONTROL/appliance/v1/enrol/_call
topic write $CONTROL/appliance/v1/user_add/_call
"""
ADMIN = Caller(Identity("admin", "a"), "192.0.2.1:5")
HELPER = Caller(Identity("helper", "h"))


@pytest.fixture
async def web(tmp_path: Path) -> AsyncIterator[WebApp]:
    web = WebApp(tmp_path)
    (tmp_path / "acl.conf").write_text(RULES)
    (tmp_path / "groups").mkdir()
    (tmp_path / "groups/viewers.conf").write_text("topic read r2d2/#\n")
    users = Passwords(tmp_path / "users.passwd")
    users.set("bob", "bob's")
    users.save()
    await web.app.start()
    yield web
    await web.stop()


async def call(web: WebApp, verb: str, caller: Caller = ADMIN, **values: Any) -> Any:
    assert web.app._verbs is not None
    return await web.app._verbs.run(caller, verb, values)


async def begin(web: WebApp, user: str, caller: Caller = ADMIN, **values: Any) -> str:
    """The code."""
    answer = await call(web, "enrol", caller, user=user, origin=ORIGIN, **values)
    assert answer["seconds"] == 600 and answer["url"].startswith(f"{ORIGIN}/#/enrol/")
    assert answer["qr"]["path"].startswith("M0 0h7v1h-7z") and answer["qr"]["size"] >= 21
    return str(answer["url"].split("/")[5])


def given(code: str, password: str = "chosen") -> dict[str, str]:
    return {"Authorization": f"Basic {base64.b64encode(f'{code}:{password}'.encode()).decode()}"}


async def use(web: WebApp, code: str, password: str = "chosen", **headers: str) -> tuple[int, str]:
    """Status and body of what the phone is answered."""
    peer = await web.dial(tls=True)
    status, _, body = await ask(peer, "POST /enrol", **{**given(code, password), **headers})
    return status, body.decode()


async def test_a_new_user(web: WebApp):
    code = await begin(web, "carol/ä", groups=["viewers"])
    assert not web.app._access.knows("carol/ä")
    results = await asyncio.gather(*(use(web, code) for _ in range(4)))
    assert sorted(status for status, _ in results) == [200, 403, 403, 403]
    (body,) = (body for status, body in results if status == 200)
    assert json.loads(body) == {"user": "carol/ä", "mqtt_port": None}
    who = await web.app._access.authenticate("carol/ä", b"chosen", "c", "192.0.2.9")
    assert isinstance(who, Identity)
    listed = {each["user"]: each["groups"] for each in (await call(web, "users"))["users"]}
    assert listed["carol/ä"] == ["viewers"]
    assert web.app.broker.counters.logins_failed == 3


async def test_who_is_there_gets_another_password(web: WebApp):
    code = await begin(web, "bob")
    assert (await use(web, code, ""))[0] == 400  # the code can still be used
    assert (await use(web, code, "new"))[0] == 200
    who = await web.app._access.authenticate("bob", b"new", "c", "192.0.2.9")
    assert isinstance(who, Identity)
    local = await begin(web, "bob", LOCAL)
    assert (await use(web, local, "newer"))[0] == 200


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ({"user": "nobody"}, "not_found"),
        ({"user": "bob", "groups": []}, "rejected"),
        ({"user": "new", "groups": ["nothing"]}, "bad_request"),
        ({"user": "a:b", "groups": []}, "bad_request"),
        ({"user": "x" * 257, "groups": []}, "bad_request"),
        ({"user": "bob", "origin": "javascript:alert(1)"}, "bad_request"),
        ({"user": "bob", "origin": "https://a/b"}, "bad_request"),
        ({"user": "bob", "origin": f"https://{'x' * 300}"}, "bad_request"),
    ],
)
async def test_what_is_not_begun(web: WebApp, values: dict[str, Any], code: str):
    with pytest.raises(CallError) as refused:
        await call(web, "enrol", **{"origin": ORIGIN, **values})
    assert refused.value.code == code, str(refused.value)


async def test_a_code_gives_no_right_that_its_maker_has_not(web: WebApp):
    """The helper may make users, and change no passwords; what it loses, its codes lose."""
    with pytest.raises(CallError, match="user_password/_call") as refused:
        await begin(web, "bob", HELPER)
    assert refused.value.code == "not_authorized"
    code = await begin(web, "carol", HELPER, groups=[])
    rules = web.directory / "acl.conf"
    rules.write_text(RULES.replace("topic write $CONTROL/appliance/v1/user_add/_call\n", ""))
    await web.app.reload()
    status, body = await use(web, code)
    assert status == 403 and "user_add" in body
    assert not web.app._access.knows("carol")


async def test_a_code_of_who_is_no_user_any_more(web: WebApp):
    """The rules of its maker still stand in the file."""
    await call(web, "user_add", user="helper", password="helper's")
    code = await begin(web, "carol", HELPER, groups=[])
    await call(web, "user_remove", user="helper")
    assert (await use(web, code))[0] == 403
    assert not web.app._access.knows("carol")


async def test_a_user_that_came_meanwhile(web: WebApp):
    code = await begin(web, "carol", groups=[])
    await call(web, "user_add", user="carol", password="first")
    assert (await use(web, code))[0] == 409
    who = await web.app._access.authenticate("carol", b"first", "c", "192.0.2.9")
    assert isinstance(who, Identity)


async def test_what_is_no_enrolment(web: WebApp):
    code = await begin(web, "bob")
    peer = await web.dial(tls=True)
    for headers, status in (
        ({}, 400),
        ({"Authorization": "Basic !"}, 400),
        ({"Authorization": f"Basic {base64.b64encode(b'x:' + bytes([255])).decode()}"}, 400),
        (given(""), 400),
        (given(code) | {"Origin": "https://elsewhere.example"}, 403),
        (given(code) | {"Origin": "null"}, 403),
        (given(code) | {"Origin": "http://localhost"}, 403),
        (given("x" * 5000), 403),
        (given(code.swapcase()), 403),
    ):
        assert (await ask(peer, "POST /enrol", **headers))[0] == status, headers
    assert (await ask(peer, "GET /enrol", **given(code)))[0] == 405
    assert (await use(web, code, Origin="https://localhost"))[0] == 200
    # Over plain HTTP from another computer.
    request = HttpRequest(
        "POST", "/enrol", "", "localhost", (), "192.0.2.1:1", "192.0.2.1", None, None
    )
    site = web.app._listeners._site
    assert site is not None
    answer = await site.respond(request)
    assert answer.status == 403 and b"TLS" in answer.body


async def test_guesses_are_throttled(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    """As wrong passwords of that address; and the right code of another address is not."""
    throttle = web.app._access.throttle
    now = 1000.0
    monkeypatch.setattr(throttle, "_clock", lambda: now)
    monkeypatch.setattr(enrolment, "MAX_WAIT", 0.0)
    code = await begin(web, "bob")
    while (await use(web, "guess"))[0] == 403:
        pass
    status, body = await use(web, code)
    assert status == 503 and "too many wrong codes" in body
    assert throttle.reserve("192.0.2.1", "enrol", 0.0) == 0.0
    assert throttle.address_delay("127.0.0.1") > 0  # of passwords as well
    now += 60
    assert (await use(web, code))[0] == 200


async def test_changes_are_noted_without_the_secrets(web: WebApp, caplog: pytest.LogCaptureFixture):
    caplog.set_level("INFO")
    code = await begin(web, "carol", groups=["viewers"])
    assert (await use(web, code, "a secret"))[0] == 200
    assert "enrolment begun" in caplog.text and "user added" in caplog.text
    assert "user 'admin'" in caplog.text
    assert code not in caplog.text and "a secret" not in caplog.text


async def test_a_certificate_for_the_phone(web: WebApp):
    """The key is in the file that the phone gets, and in none of this computer."""
    code = await begin(web, "carol", groups=[], certificate=True)
    status, body = await use(web, code, "short")
    assert status == 400 and "8 characters" in body and not web.app._access.knows("carol")
    status, body = await use(web, code, "null\0null\0null")
    assert status == 400 and "null character" in body and not web.app._access.knows("carol")
    status, body = await use(web, code, "long enough")
    assert status == 200
    answer = json.loads(body)
    assert answer["problem"] == ""
    packed = base64.b64decode(answer["p12"])
    with pytest.raises(ValueError):
        pkcs12.load_pkcs12(packed, b"short")
    opened = pkcs12.load_pkcs12(packed, b"long enough")
    assert opened.key is not None and opened.cert is not None
    assert isinstance(opened.key, ec.EllipticCurvePrivateKey)
    directory = web.directory / "certs"
    listed = {each.name: each for each in certs.list_certificates(directory)}
    assert listed["carol"].state == "valid"
    certificate = opened.cert.certificate
    assert certs.username_of(certificate, "subject") == "carol"
    assert certificate.public_key() == opened.key.public_key()
    assert [each.certificate for each in opened.additional_certs] == certs.load_certificates(
        directory / "ca.crt"
    )
    assert [path.name for path in (directory / "clients").iterdir()] == ["carol.crt"]
    with pytest.raises(CallError, match="revoke that first"):
        await begin(web, "carol", certificate=True)
    await call(web, "certificate_revoke", certificate="carol")
    again = json.loads(
        (await use(web, await begin(web, "carol", certificate=True), "again_" * 2))[1]
    )
    assert again["problem"] == "" and again["p12"] != answer["p12"]


async def test_a_certificate_takes_the_right_to_sign(web: WebApp):
    """It is asked twice; whoever loses it in between leaves the password, and no certificate."""
    with pytest.raises(CallError, match="certificate_sign/_call"):
        await begin(web, "carol", HELPER, groups=[], certificate=True)
    rules = web.directory / "acl.conf"
    rules.write_text(RULES + "topic write $CONTROL/appliance/v1/certificate_sign/_call\n")
    await web.app.reload()
    code = await begin(web, "carol", HELPER, groups=[], certificate=True)
    rules.write_text(RULES)
    await web.app.reload()
    status, body = await use(web, code, "long enough")
    answer = json.loads(body)
    assert status == 200 and answer["p12"] is None and "certificate_sign" in answer["problem"]
    assert web.app._access.knows("carol")
    assert not (web.directory / "certs/clients").exists()


async def test_names_that_no_certificate_can_have(web: WebApp):
    for name in ("carol/ä", "x" * 65, "server"):
        with pytest.raises(CallError, match="cannot name a client's certificate"):
            await begin(web, name, groups=[], certificate=True)


async def test_the_certificates_of_another_authority(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(phone_certificates, "authority_directory", lambda settings: None)
    with pytest.raises(CallError, match="not of this appliance's own CA"):
        await begin(web, "carol", groups=[], certificate=True)


async def take_users_from(web: WebApp, source: str) -> None:
    """Have clients' certificates say who they are."""
    settings = yaml.safe_load(web.file.read_text())
    settings["broker"]["tls"]["username_from"] = source
    settings["broker"]["listeners"][1]["client_certificates"] = "optional"
    web.file.write_text(yaml.safe_dump(settings))
    await web.app.reload()


async def test_certificates_that_would_name_no_user(web: WebApp):
    await take_users_from(web, "san")
    with pytest.raises(CallError, match="username_from: san"):
        await begin(web, "carol", groups=[], certificate=True)


@pytest.mark.parametrize("is_new", [True, False])
async def test_what_becomes_of_a_code_whose_certificate_cannot_be_made(web: WebApp, is_new: bool):
    """It is found before there is a code, or told to the phone without this computer's paths."""
    directory = web.directory / "certs"
    hidden = directory / "hidden.key"
    (directory / "ca.key").rename(hidden)
    with pytest.raises(CallError, match=r"^there is no ca\.key"):
        await begin(web, "carol", groups=[], certificate=True)
    hidden.rename(directory / "ca.key")
    code = await begin(web, "carol", groups=[], certificate=True)
    if is_new:
        (directory / "ca.key").rename(hidden)
    else:
        certs.issue_client(directory, "carol")
    status, body = await use(web, code, "long enough")
    answer = json.loads(body)
    wanted = "there is no ca.key" if is_new else "has a certificate, of another key"
    assert status == 200 and answer["p12"] is None and wanted in answer["problem"]
    assert str(directory) not in body


async def test_a_name_like_a_host_s(web: WebApp):
    with pytest.raises(CallError, match="looks like a DNS name"):
        await begin(web, "john.smith", groups=[], certificate=True)


async def test_a_ca_with_words_beside_it(web: WebApp):
    file = web.directory / "certs/ca.crt"
    file.write_text(f"# die Behörde, 認証局\n{file.read_text()}")
    code = await begin(web, "carol", groups=[], certificate=True)
    answer = json.loads((await use(web, code, "long enough"))[1])
    assert answer["problem"] == "" and answer["p12"]


async def test_a_revocation_ends_the_codes_of_others(web: WebApp):
    """Whoever has begun an enrolment may have logged in with that certificate."""
    await take_users_from(web, "subject")
    certs.issue_client(web.directory / "certs", "lost")
    from_afar = await begin(web, "carol", groups=[])
    here = await begin(web, "dave", LOCAL, groups=[])
    await call(web, "certificate_revoke", certificate="lost")
    assert (await use(web, from_afar))[0] == 403 and not web.app._access.knows("carol")
    assert (await use(web, here))[0] == 200


async def test_the_right_to_enrol_is_asked_again(web: WebApp):
    code = await begin(web, "carol", HELPER, groups=[])
    rules = web.directory / "acl.conf"
    rules.write_text(RULES.replace("topic write $CONTROL/appliance/v1/enrol/_call\n", ""))
    await web.app.reload()
    status, body = await use(web, code)
    assert status == 403 and "right to enrol" in body and not web.app._access.knows("carol")


async def test_the_file_is_made_elsewhere(web: WebApp, monkeypatch: pytest.MonkeyPatch):
    """It holds the interpreter's lock for long; a program that fails makes no file."""

    def held(*_: object) -> bytes:
        raise AssertionError("in the appliance itself")

    monkeypatch.setattr(certs.export, "serialize_key_and_certificates", held)
    code = await begin(web, "carol", groups=[], certificate=True)
    answer = json.loads((await use(web, code, "long enough"))[1])
    assert answer["problem"] == "" and answer["p12"]
    monkeypatch.setattr(certs.packing, "COMMAND", ("false",))
    code = await begin(web, "dave", groups=[], certificate=True)
    answer = json.loads((await use(web, code, "long enough"))[1])
    assert answer["p12"] is None and "revoke its certificate" in answer["problem"]
