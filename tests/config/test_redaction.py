"""Secrets do not appear in texts of others, however these have encoded them."""

from __future__ import annotations

from appliance.config.redaction import redacted


def test_a_secret_is_masked_in_every_encoding() -> None:
    text = "url=http://h/?p=p%C3%A4ss+w%2Frd, 'p\\xe4ss', \"päss w/rd\""
    assert redacted(text, ["päss w/rd"]).count("*" * 8) == 2
    for written in ("p%C3%A4ss w/rd", "p%c3%a4ss+w%2Frd", "p\\u00e4ss%20w/rd", "p\\xe4ss w/rd"):
        assert redacted(f"a {written} b", ["päss w/rd"]) == "a ******** b"
    assert "abc" not in redacted("it said: abc", ["abc"])
