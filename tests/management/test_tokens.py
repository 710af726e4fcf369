"""The verbs with which users stay signed in."""

from __future__ import annotations

import pytest
from waiting import until

from appliance.access import is_token
from appliance.access.tokens import PREFIX
from appliance.mqtt.codec import V5
from appliance.mqtt.packets import Disconnect
from appliance.mqtt.reason import ReasonCode
from management.managed import BOTH, PASSWORD, RULES, Caller, CallError, Site

UNKNOWN = PREFIX + "x" * 43


async def is_let_in(site: Site, token: str, user: str | None = "admin", version: int = V5) -> bool:
    """Whether a client with the token is."""
    caller = Caller("another", version)
    try:
        await caller.connect(site.app.addresses[0], user, password=token.encode())
    except AssertionError:
        return False
    finally:
        caller.hang_up()
    return True


@pytest.mark.parametrize("version", BOTH)
async def test_a_token_and_its_end(site: Site, version: int):
    admin = await site.join("a", version=version)
    given = await admin.call("token", {"password": PASSWORD})
    token = given.pop("token")
    assert is_token(token.encode()) and given == {"user": "admin", "seconds": 12 * 3600}
    assert await is_let_in(site, token, version=version)
    assert not await is_let_in(site, token, "viewer", version)
    assert await admin.call("token_end", {"token": UNKNOWN}) == {"ended": 0}
    assert await admin.call("token_end", {"token": token}) == {"ended": 1}
    assert not await is_let_in(site, token, version=version)
    for _ in range(2):
        await admin.call("token", {"password": PASSWORD})
    assert await admin.call("token_end", {"token": None}) == {"ended": 2}
    await until(lambda: len(site.audited()) == 6, "the audit log")
    lines = [each["what"] for each in site.audited()]
    assert lines == ["token issued", "token ended", "token ended"] + ["token issued"] * 2 + [
        "token ended"
    ]
    assert site.audited()[0]["by"] == {"client": "a", "user": "admin"}
    text = (site.directory / "audit.log").read_text()
    assert token not in text and PASSWORD not in text


async def test_who_gets_none(site: Site, caplog: pytest.LogCaptureFixture):
    admin, viewer = await site.join("a"), await site.join("v", "viewer")
    token = (await admin.call("token", {"password": PASSWORD}))["token"]
    failed = site.app.broker.counters.logins_failed
    for arguments, code in (
        ({"password": "wrong"}, "not_authorized"),
        ({"password": token}, "not_authorized"),  # else a stolen one would last for ever
        ({"password": ""}, "bad_request"),
        ({"password": "x" * 1025}, "bad_request"),
        ({"password": 1}, "bad_request"),
        ({}, "bad_request"),
        ({"password": PASSWORD, "user": "viewer"}, "bad_request"),
    ):
        with pytest.raises(CallError) as refused:
            await admin.call("token", arguments)
        assert refused.value.code == code
        assert token not in str(refused.value) and PASSWORD not in str(refused.value)
    assert site.app.broker.counters.logins_failed == failed + 2
    refusal = await viewer.post("token", {"password": PASSWORD})  # the rules decide that
    assert refusal.reason_code == ReasonCode.NOT_AUTHORIZED
    assert token not in caplog.text and PASSWORD not in caplog.text


async def test_a_token_is_its_user_s(site: Site):
    site.rules(
        RULES.replace(
            "topic write $CONTROL/appliance/v1/rights",
            "topic write $CONTROL/#\ntopic write $CONTROL/appliance/v1/rights",
        )
    )
    await site.app.reload()
    admin, viewer = await site.join("a"), await site.join("v", "viewer")
    token = (await admin.call("token", {"password": PASSWORD}))["token"]
    assert await viewer.call("token_end", {"token": token}) == {"ended": 0}
    assert await viewer.call("token_end", {"token": None}) == {"ended": 0}
    assert await is_let_in(site, token)
    for wrong in ({}, {"token": 1}, {"token": "x" * 129}):
        with pytest.raises(CallError, match="token"):
            await viewer.call("token_end", wrong)


async def test_a_user_that_is_removed(site: Site):
    """Who came with a token goes as who came with the password; a new password ends the token."""
    admin = await site.join("a")
    for name in ("bob", "carol"):
        await admin.call("user_add", {"user": name, "password": PASSWORD})
    tokens = {
        name: await site.app._access.issue_token(name, PASSWORD.encode(), "127.0.0.1:1")
        for name in ("bob", "carol")
    }
    assert all(isinstance(token, str) for token in tokens.values())
    bob = Caller("b", V5)
    await bob.connect(site.app.addresses[0], "bob", password=str(tokens["bob"]).encode())
    await admin.call("user_remove", {"user": "bob"})
    assert (await bob.wait_for(Disconnect)).reason_code == ReasonCode.ADMINISTRATIVE_ACTION
    await admin.call("user_password", {"user": "carol", "password": "another"})
    for name, token in tokens.items():
        assert not await is_let_in(site, str(token), name)
    bob.hang_up()


async def test_a_client_without_a_name(site: Site):
    """Of MQTT 5 a token alone is enough, and an unknown one lets nobody in."""
    admin = await site.join("a")
    token = (await admin.call("token", {"password": PASSWORD}))["token"]
    assert await is_let_in(site, token, None)
    assert not await is_let_in(site, UNKNOWN, None)
