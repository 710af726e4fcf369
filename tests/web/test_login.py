"""Basic and Bearer authentication: what is taken from a request, and what is not."""

from __future__ import annotations

import base64

import pytest

from appliance.net.http import HttpRequest
from appliance.web.login import credentials


def request(*authorizations: str) -> HttpRequest:
    headers = tuple(("authorization", each) for each in authorizations)
    return HttpRequest("GET", "/", "", "robot", headers, "192.0.2.1:5", "192.0.2.1", None, None)


def basic(pair: bytes) -> str:
    return f"Basic {base64.b64encode(pair).decode()}"


@pytest.mark.parametrize(
    ("pair", "found"),
    [
        (b"alice:secret", ("alice", b"secret")),
        (b"alice:a:b", ("alice", b"a:b")),
        (b":", ("", b"")),
        ("Ä:ß".encode(), ("Ä", "ß".encode())),
        (b"alice:\xff", ("alice", b"\xff")),
    ],
)
def test_a_user_and_its_password(pair: bytes, found: tuple[str, bytes]):
    assert credentials(request(basic(pair))) == found
    assert credentials(request(basic(pair).replace("Basic", "bASIC"))) == found


def test_nobody():
    assert credentials(request()) == (None, None)


@pytest.mark.parametrize(
    "given",
    [
        "",
        "Basic",
        "Basic !!!",
        "Basic YWxpY2U",
        "Basic YWxpY2U=",  # without a colon
        "Basic ä",
        basic(b"\xff:x"),
        basic(b"a\0b:x"),
        "Digest YWxpY2U6c2VjcmV0",
        basic(b"a:b") + ", " + basic(b"c:d"),
    ],
)
def test_what_is_not_one(given: str):
    with pytest.raises(ValueError, match="Basic authentication"):
        credentials(request(given))


def test_a_token():
    assert credentials(request("Bearer appliance-token-x ")) == (None, b"appliance-token-x")
    assert credentials(request("bEARER x")) == (None, b"x")


def test_two_are_none():
    with pytest.raises(ValueError, match="Basic"):
        credentials(request(basic(b"a:b"), basic(b"a:b")))
    with pytest.raises(ValueError, match="Basic"):
        credentials(request("Bearer x", "Bearer x"))
