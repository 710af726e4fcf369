"""Masks known secrets in texts from elsewhere: errors, tracebacks, log lines."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable

from appliance.config.printing import MASK

#: Characters of the shortest secret that is masked by itself.
_SHORTEST_MASKED = 4


def redacted(text: str, secrets: Iterable[str]) -> str:
    """The text with every secret masked, also as it is encoded in a URL, in JSON or in a `repr`.

    A secret of fewer than four characters may be part of any word. Masking it would show where it
    is, so the whole text is withheld when it contains one.
    """
    for secret in sorted(filter(None, set(secrets)), key=len, reverse=True):
        form = re.compile("".join(map(_form, secret)), re.IGNORECASE)
        if len(secret) < _SHORTEST_MASKED and form.search(text):
            return "(not shown: it may hold a secret)"
        text = form.sub(MASK, text)
    return text


def _form(char: str) -> str:
    """A pattern for the forms that one character takes in URLs, JSON and `repr`."""
    encoded = "".join(f"%{byte:02x}" for byte in char.encode("utf-8", "surrogatepass"))
    forms = {char, encoded, json.dumps(char)[1:-1], repr(char)[1:-1], ascii(char)[1:-1]}
    if char == " ":
        forms.add("+")
    return f"(?:{'|'.join(map(re.escape, sorted(forms, key=len, reverse=True)))})"
