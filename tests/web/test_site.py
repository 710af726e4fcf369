"""Who may ask what: hosts, and pages of other sites where a certificate is the login."""

from __future__ import annotations

import ssl

import pytest

from appliance.net.http import Headers, HttpRequest
from appliance.web.site import WebSite, is_named


def tls_object() -> ssl.SSLObject:
    return ssl.create_default_context().wrap_bio(ssl.MemoryBIO(), ssl.MemoryBIO())


def upgrade(*headers: tuple[str, str], host: str = "robot:8443", tls: bool = True) -> HttpRequest:
    named: Headers = (("host", host), ("upgrade", "websocket"), *headers)
    secure = tls_object() if tls else None
    return HttpRequest("GET", "/mqtt", "", host, named, "192.0.2.1:5", "192.0.2.1", secure, None)


def objection(request: HttpRequest, user: str | Exception | None = "operator") -> int:
    def certificate_user(tls: ssl.SSLObject) -> str | None:
        if isinstance(user, Exception):
            raise user
        return user

    found = WebSite({}, lambda: {"robot"}, certificate_user).objection(request)
    return 0 if found is None else found.status


@pytest.mark.parametrize(
    ("origins", "status"),
    [
        ((), 0),  # not a browser
        (("https://robot:8443",), 0),
        (("https://Robot:8443",), 0),
        (("https://evil.example",), 403),
        (("http://robot:8443",), 403),
        (("https://robot",), 403),
        (("null",), 403),
        (("",), 403),
        (("https://robot:8443", "https://evil.example"), 403),
    ],
)
def test_pages_of_other_sites_do_not_use_a_certificate(
    origins: tuple[str, ...], status: int
) -> None:
    request = upgrade(*(("origin", origin) for origin in origins))
    assert objection(request) == status
    # Where a password is the login, no browser adds it by itself.
    assert objection(request, None) == 0
    assert objection(request, ValueError("it names none")) == 0


def test_a_host_is_looked_at_first():
    assert objection(upgrade(host="evil.example", tls=False)) == 421
    assert objection(upgrade(host="192.0.2.9:8443", tls=False)) == 0


def test_a_password_is_not_in_the_log():
    assert "c2VjcmV0" not in repr(upgrade(("authorization", "Basic c2VjcmV0")))


@pytest.mark.parametrize(
    ("host", "named"),
    [
        ("robot", True),
        ("a.example", True),
        ("example", False),
        ("b.a.example", False),
        ("robot.example", True),
        ("obot", False),
        ("*.example", True),
    ],
)
def test_names_of_a_certificate(host: str, named: bool):
    assert is_named(host, {"robot", "*.example"}) is named
