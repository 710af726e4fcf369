"""What a fleet's broker refuses is said in words, with the key of the section that it is about."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
import uvloop
from waiting import until

from appliance.mqtt.codec import V5, V311
from appliance.mqtt.reason import ReasonCode
from appliance.upstream.agreement import EndedBy, Ending
from appliance.upstream.refusals import ending_advice, reason_words, subscription_advice
from upstream.links import link
from upstream.peers import USER, FleetMosquitto
from upstream.uplink_rig import Rig, running

LOGIN = "login: {username: r2, password_file: /pw}"


@pytest.fixture(scope="module")
def event_loop_policy() -> asyncio.AbstractEventLoopPolicy:
    return uvloop.EventLoopPolicy()


def said(code: ReasonCode, keys: str = "", *, refused: bool = True) -> str:
    settings = link(keys)
    ending = Ending(EndedBy.BROKER, code, "", refused, refused)
    return ending_advice(ending, settings, settings.servers[0], "r2-keep")


@pytest.mark.parametrize(
    ("code", "keys", "words"),
    [
        (ReasonCode.NOT_AUTHORIZED, "", "set login.username and login.password_file"),
        (ReasonCode.NOT_AUTHORIZED, LOGIN, "/pw (login.password_file)"),
        (ReasonCode.NOT_AUTHORIZED, LOGIN, "client id 'r2-keep'"),
        (ReasonCode.BAD_USER_NAME_OR_PASSWORD, LOGIN, "'r2' (login.username)"),
        (ReasonCode.NOT_AUTHORIZED, "tls: {certificate: /c, key: /k}", "/c (tls.certificate)"),
        (ReasonCode.BAD_AUTHENTICATION_METHOD, "", "login.method"),
        (ReasonCode.CLIENT_IDENTIFIER_NOT_VALID, "", "set client_id"),
        (ReasonCode.UNSUPPORTED_PROTOCOL_VERSION, 'version: "3.1.1"', 'version: "5"'),
        (ReasonCode.TOPIC_NAME_INVALID, "", "(prefix)"),
    ],
)
def test_a_refused_login_names_the_keys_that_it_is_about(code, keys, words) -> None:
    assert words in said(code, keys)


def test_all_that_a_broker_may_say_at_the_end_has_advice() -> None:
    failures = [code for code in ReasonCode if code >= 0x80]
    assert all(said(code) and said(code, refused=False) for code in failures)
    assert "client_id" in said(ReasonCode.SESSION_TAKEN_OVER, refused=False)


def test_codes_are_named_as_in_the_standard() -> None:
    assert reason_words(0x87) == "0x87 Not authorized"
    assert reason_words(0x9B) == "0x9b QoS not supported"
    assert reason_words(ReasonCode.NOT_AUTHORIZED, V311) == "Not authorized (return code 5)"
    assert reason_words(0xFE, V5) == "0xfe"


def test_a_refused_subscription_says_what_does_not_come() -> None:
    settings = link(LOGIN)
    assert "let the user 'r2' read it" in subscription_advice(0x87, settings, "fleet/r2/cmd")
    assert "calls" in subscription_advice(0x87, settings, "fleet/r2/_answers/+")


async def test_a_newcomers_mistakes_are_named(
    tmp_path: Path, fleet: FleetMosquitto, caplog: pytest.LogCaptureFixture
) -> None:
    """One appliance with a link for each mistake, at a real broker with a port of each kind."""
    for name, text in (("bad", "wrong"), ("good", fleet.passwords[USER])):
        (tmp_path / name).touch(0o600)
        (tmp_path / name).write_text(text)
    plain, tls = fleet.plain_port, fleet.port
    ca = {"ca": str(fleet.directory / "certs/ca.crt")}
    good = {"username": USER, "password_file": "good"}
    kept = {"in": [{"topic": "m/#", "offline": "keep"}]}
    mistakes = {
        "none": (f"mqtt://127.0.0.1:{plain}", {}, "the section has no login"),
        "wrong": (
            f"mqtt://127.0.0.1:{plain}",
            {"login": {**good, "password_file": "bad"}, "version": "3.1.1"},
            f"the password in {tmp_path}/bad (login.password_file)",
        ),
        "plain": (f"mqtt://127.0.0.1:{tls}", {"login": good}, "port one for TLS (mqtts://)"),
        "tls": (f"mqtts://127.0.0.1:{plain}", {"tls": ca}, "is the port one for mqtt://"),
        "ws": (f"ws://127.0.0.1:{plain}", {}, "is the port one for mqtt://"),
        "wss": (f"wss://127.0.0.1:{tls}", {"tls": ca}, "is the port one for mqtts://"),
        "kept": (f"mqtt://127.0.0.1:{plain}", kept, "the section has no login"),
    }
    links = [
        {"name": name, "servers": [url], "client_id": name, **keys}
        for name, (url, keys, _) in mistakes.items()
    ]
    async with running(Rig(tmp_path, plain, links=links)) as rig:
        for uplink in rig.app.upstreams:
            words = mistakes[uplink.settings.name][2]
            await until(
                lambda uplink=uplink, words=words: words in str(uplink.status().problem),
                f"{uplink.settings.name} to say {words}",
            )
        about_kept = "upstream 'kept', for the rules with offline: keep"
        await until(lambda: f"{about_kept}: mqtt://127.0.0.1:{plain} as 'kept-keep'" in caplog.text)
