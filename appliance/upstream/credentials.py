"""The login of a link: files that are read at each connection, and tokens that expire."""

from __future__ import annotations

import base64
import binascii
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from appliance.upstream.rules import UpstreamLogin

#: Seconds before its end at which a token is replaced; of a short-lived one a tenth of its life.
MARGIN: Final = 60.0

#: The largest file, in bytes: the largest password that CONNECT can have.
LARGEST: Final = 65_535


@dataclass(frozen=True, slots=True)
class Credentials:
    """What CONNECT has: a password, or the data of a method; `expires_at` is by the wall clock."""

    password: bytes | None = field(default=None, repr=False)
    data: bytes | None = field(default=None, repr=False)
    expires_at: float | None = None
    read_at: float = field(default_factory=time.time)

    def renew_in(self) -> float | None:
        """Seconds until the token is to be replaced; None when it does not expire."""
        if self.expires_at is None:
            return None
        margin = min(MARGIN, (self.expires_at - self.read_at) / 10)
        return max(1.0, self.expires_at - margin - time.time())

    def has_same_secret(self, other: Credentials) -> bool:
        """Whether the files have not changed."""
        return (self.password, self.data) == (other.password, other.data)


def read_credentials(login: UpstreamLogin) -> Credentials:
    """Read the files of a login; not in the event loop.

    Raises:
        ValueError: a file cannot be read, or its first line is empty or too long; the text says
            which.
    """
    token = None if login.token_file is None else _read("token_file", login.token_file)
    password = None if login.password_file is None else _read("password_file", login.password_file)
    if token is None:
        return Credentials(password)
    expires_at = token_expiry(token)
    if login.method is not None:
        return Credentials(password, token, expires_at)
    return Credentials(token, None, expires_at)


def first_line(path: Path) -> bytes:
    """The first line of a file, where its secret is, without white space around it. One that is
    too long is cut off, to one that is still too long. Raises OSError."""
    with path.open("rb") as file:
        return file.readline(LARGEST + 2).strip()


def _read(key: str, path: Path) -> bytes:
    try:
        content = first_line(path)
    except OSError as error:
        raise ValueError(f"{path} (login.{key}) cannot be read: {error.strerror}") from None
    if not content:
        raise ValueError(f"{path} (login.{key}) has nothing in its first line")
    if len(content) > LARGEST:
        raise ValueError(f"{path} (login.{key}) is longer than {LARGEST} bytes")
    return content


def token_expiry(token: bytes) -> float | None:
    """When a JSON Web Token expires (RFC 7519, section 4.1.4: `exp`), by the wall clock; None when
    it is none, or does not say so. Its signature is the broker's business."""
    parts = token.split(b".")
    if len(parts) != 3:
        return None
    try:
        claims = json.loads(base64.urlsafe_b64decode(parts[1] + b"=" * (-len(parts[1]) % 4)))
    except (binascii.Error, ValueError):
        return None
    expiry = claims.get("exp") if isinstance(claims, dict) else None
    if isinstance(expiry, bool) or not isinstance(expiry, int | float):
        return None
    try:
        return float(expiry)
    except OverflowError:
        return None
