"""SCRAM-SHA-256 (RFC 5802 and 7677): what is stored of a password, and the server's exchange.

The library `scramp` (1.5) is not used: it needs Python 3.11, asks for the user only once, so that a
user changed between the two messages is not noticed, rejects an authzid and salts of less than 12
bytes, has no limit on messages and names, and leaves decoys to its caller.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import hmac
import re
import secrets
import stringprep
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final
from unicodedata import ucd_3_2_0

from appliance.broker.values import Accepted, Refusal
from appliance.mqtt.reason import ReasonCode

METHOD: Final = "SCRAM-SHA-256"

# The rule of thumb of RFC 7677, section 4. The client has to do this work, and within
# broker.limits.connect_timeout: a microcontroller takes seconds for what costs a guesser nothing.
# Long passwords, and a file that others cannot read, protect against guessing.
_ITERATIONS: Final = 15_000
# RFC 7677 asks for at least these; clients refuse to answer to fewer.
_MIN_ITERATIONS: Final = 4096
# A typing error in the file must not make logins take seconds.
_MAX_ITERATIONS: Final = 1_000_000
_SALT_SIZE: Final = 16
_MAX_SALT_SIZE: Final = 128

# A user name of 256 bytes, every one escaped, twice, and nonces of 256 characters.
_MAX_MESSAGE: Final = 2048

# The most bytes of a user name, in UTF-8. Strangers' names are prepared on the event loop.
_MAX_USERNAME: Final = 256

# Characters that are prepared at most: SASLprep examines each one. ASCII text may be longer.
_MAX_PREPARED: Final = 256

_STORED: Final = re.compile(
    r"SCRAM-SHA-256\$([0-9]{1,9}):([A-Za-z0-9+/]+={0,2})"
    r"\$([A-Za-z0-9+/]{43}=):([A-Za-z0-9+/]{43}=)"
)

# RFC 5802, section 7. Attributes that a client adds (extensions) are ignored, but are part of what
# the proof covers.
_NAME: Final = r"(?:[^\0,=]|=2C|=3D)+"
_NONCE: Final = r"[!-+\--~]+"
_EXTENSIONS: Final = r"(?:,[A-Za-z]=[^\0,]+)*"
_CLIENT_FIRST: Final = re.compile(
    rf"(?P<header>(?:n|y|(?P<bound>p=[A-Za-z0-9.-]+)),(?:a=(?P<authzid>{_NAME}))?,)"
    rf"(?P<bare>n=(?P<name>{_NAME}),r=(?P<nonce>{_NONCE}){_EXTENSIONS})"
)
_CLIENT_FINAL: Final = re.compile(
    rf"(?P<unproven>c=(?P<header>[A-Za-z0-9+/=]+),r=(?P<nonce>{_NONCE}){_EXTENSIONS})"
    r",p=(?P<proof>[A-Za-z0-9+/]{43}=)"
)


@dataclass(frozen=True, slots=True)
class Verifier:
    """What a proof is verified against; it does not suffice to log in as the user.

    `decoy` is the reason, for the log, why no proof is ever right; it is empty in a real verifier.
    """

    iterations: int
    salt: bytes
    stored_key: bytes = field(repr=False)
    server_key: bytes = field(repr=False)
    decoy: str = ""

    @classmethod
    def of(cls, password: str | bytes) -> Verifier:
        """A new verifier, with a new salt.

        ValueError says what is wrong with a password that clients may encode differently.
        """
        try:
            text = password if isinstance(password, str) else password.decode()
            prepared = saslprep(text).encode()
        except UnicodeDecodeError:
            raise ValueError(f"a password for {METHOD} must be text in UTF-8") from None
        except ValueError as error:
            raise ValueError(f"a password for {METHOD} {error}") from None
        return cls._derive(prepared, secrets.token_bytes(_SALT_SIZE), _ITERATIONS)

    @classmethod
    def _derive(cls, prepared: bytes, salt: bytes, iterations: int) -> Verifier:
        salted = hashlib.pbkdf2_hmac("sha256", prepared, salt, iterations)
        client_key = hmac.digest(salted, b"Client Key", "sha256")
        server_key = hmac.digest(salted, b"Server Key", "sha256")
        return cls(iterations, salt, hashlib.sha256(client_key).digest(), server_key)

    def encode(self) -> str:
        """The entry of the users file, which has PostgreSQL's format."""
        salt, stored_key, server_key = map(_base64, (self.salt, self.stored_key, self.server_key))
        return f"{METHOD}${self.iterations}:{salt}${stored_key}:{server_key}"

    @classmethod
    def decode(cls, stored: str) -> Verifier:
        """The inverse of `encode`; ValueError says what is wrong, without showing the entry."""
        match = _STORED.fullmatch(stored)
        try:
            if match is None:
                raise ValueError
            salt, stored_key, server_key = map(base64.b64decode, match.groups()[1:])
        except ValueError:
            raise ValueError(f"not a valid {METHOD} hash") from None
        iterations = int(match[1])
        if iterations > _MAX_ITERATIONS:
            raise ValueError("this hash costs more than one login may")
        if iterations < _MIN_ITERATIONS:
            raise ValueError(
                f"{METHOD} needs {_MIN_ITERATIONS} iterations at least, and here are {iterations}"
            )
        if len(salt) > _MAX_SALT_SIZE:
            raise ValueError(f"a salt of more than {_MAX_SALT_SIZE} bytes")
        return cls(iterations, salt, stored_key, server_key)

    def check(self, password: bytes) -> bool:
        """Whether this is the password. Takes milliseconds, the same for a wrong one."""
        try:
            prepared = saslprep(password.decode()).encode()
        except ValueError:
            prepared = password  # as PostgreSQL does, whose hashes may come from such passwords
        made = self._derive(prepared, self.salt, self.iterations)
        return hmac.compare_digest(made.stored_key, self.stored_key) and not self.decoy


def decoy(username: str, shapes: Collection[tuple[int, int]], reason: str) -> Verifier:
    """A verifier for a user that has none, which no proof fits; `reason` is for the log.

    It looks like a real one: `shapes` are the iterations and salt sizes of those. It stays the same
    for a name, as long as there are users of its shape.
    """

    def made(what: str, size: int) -> bytes:
        text = f"{what}:{username}".encode()
        return hashlib.shake_256(_secret() + text).digest(size)

    # Rendezvous hashing: when shapes come or go, most names keep theirs.
    shape = max(shapes or [(_ITERATIONS, _SALT_SIZE)], key=lambda shape: made(f"{shape}", 8))
    iterations, size = shape
    keys = made("keys", 64)
    return Verifier(iterations, made(f"salt {shape}", size), keys[:32], keys[32:], reason)


@functools.cache
def _secret() -> bytes:
    """The secret from which this computer's decoys are derived.

    It should survive a restart: a salt that changes with a restart would reveal a decoy.
    machine-id(5) is made for this purpose: it never leaves the computer, and is hashed before use.
    """
    try:
        machine = Path("/etc/machine-id").read_bytes().strip()
    except OSError:
        machine = b""
    if len(machine) != 32:  # a container's may be empty
        return secrets.token_bytes(32)
    return hashlib.sha256(b"SCRAM decoys of the appliance on " + machine).digest()


@dataclass(frozen=True, slots=True)
class _Challenge:
    """The client-first-message and the server's answer to it."""

    username: str
    verifier: Verifier
    header: str
    nonce: str
    #: Both messages, which the proof covers.
    messages: str


class ScramExchange:
    """The server's side of one exchange: an `Exchange` of the broker.

    Every failure looks the same to the client, and an unknown user fails only at the proof, as a
    wrong password does: the exchange does not reveal who is a user. There is no channel binding:
    TLS certificates protect against somebody who relays the messages.
    """

    def __init__(
        self,
        verifier_of: Callable[[str], Verifier],
        nonce: str | None = None,
        *,
        admits: Callable[[], bool] = lambda: True,
        failed: Callable[[str], None] = lambda username: None,
        only: str | None = None,
    ) -> None:
        """`verifier_of` is called at both messages; a verifier that changes between them fails.

        `nonce` is the server's part of it, a random one unless a test brings its own. `admits` is
        asked before anything is revealed about a user, `failed` is called for a wrong proof of one.
        `only` is the one user that the client may be, if it has logged in and does so again.
        """
        self._only = only
        self._verifier_of = verifier_of
        self._admits = admits
        self._failed = failed
        self._nonce = nonce or _base64(secrets.token_bytes(18))
        self._next: Callable[[str], bytes | Accepted | Refusal] = self._begin

    def step(self, data: bytes) -> bytes | Accepted | Refusal:
        """Process the client's next message; hashes a few short texts, and no password."""
        take, self._next = self._next, self._over
        try:
            if len(data) > _MAX_MESSAGE:
                raise ValueError(f"a message of {len(data)} bytes, and not of {_MAX_MESSAGE}")
            return take(data.decode())
        except ValueError as error:
            return _refusal(f"{METHOD}: {error}")

    def _begin(self, message: str) -> bytes | Refusal:
        if message:
            return self._first(message)
        # A CONNECT without data: the client is asked for its first message, as in an example of
        # MQTT 5.0, section 4.12.
        self._next = self._first
        return b""

    def _first(self, message: str) -> bytes | Refusal:
        _check_extensions(message)
        match = _CLIENT_FIRST.fullmatch(message)
        if match is None:
            raise ValueError("not a client-first-message")
        if match["bound"]:
            raise ValueError("the client asks for channel binding, which is not offered")
        if not self._admits():
            return Refusal(
                ReasonCode.SERVER_BUSY,
                "too many logins from its address were wrong, it has to come again "
                "(broker.limits.failed_logins)",
            )
        name = prepared_name(_unescaped(match["name"]))
        other = match["authzid"]
        if other not in (None, match["name"]) and prepared_name(_unescaped(other)) != name:
            raise ValueError(f"user {name!r} may not act for another one")
        if self._only not in (None, name):
            raise ValueError("a client authenticates again as the user that it is")
        verifier = self._verifier_of(name)
        nonce = match["nonce"] + self._nonce
        answer = f"r={nonce},s={_base64(verifier.salt)},i={verifier.iterations}"
        messages = f"{match['bare']},{answer}"
        challenge = _Challenge(name, verifier, match["header"], nonce, messages)
        self._next = functools.partial(self._final, challenge)
        return answer.encode()

    def _final(self, challenge: _Challenge, message: str) -> Accepted | Refusal:
        _check_extensions(message)
        match = _CLIENT_FINAL.fullmatch(message)
        if match is None:
            raise ValueError("not a client-final-message")
        if match["header"] != _base64(challenge.header.encode()):
            raise ValueError("the client-final-message has another gs2-header (c=)")
        if match["nonce"] != challenge.nonce:
            raise ValueError("the client-final-message has another nonce")
        verifier = challenge.verifier
        messages = f"{challenge.messages},{match['unproven']}".encode()
        signature = hmac.digest(verifier.stored_key, messages, "sha256")
        proof = base64.b64decode(match["proof"])
        client_key = bytes(a ^ b for a, b in zip(proof, signature, strict=True))
        proven = hmac.compare_digest(hashlib.sha256(client_key).digest(), verifier.stored_key)
        changed = self._verifier_of(challenge.username) != verifier
        if verifier.decoy or not (changed or proven):
            self._failed(challenge.username)
        if verifier.decoy:
            return _refusal(verifier.decoy)
        if changed:
            return _refusal(f"user {challenge.username!r} was changed during the exchange")
        if not proven:
            return _refusal(f"wrong {METHOD} proof of user {challenge.username!r}")
        server_signature = hmac.digest(verifier.server_key, messages, "sha256")
        return Accepted(challenge.username, b"v=" + base64.b64encode(server_signature))

    def _over(self, message: str) -> Refusal:
        raise ValueError("the exchange is over")


def saslprep(text: str) -> str:
    """`text` normalised by SASLprep (RFC 4013), so that what looks the same is the same.

    ValueError says what is wrong with it, worded to follow a subject ("a password ...").
    """
    if not text.isascii():
        _check_prepared(text)
        mapped = (
            " " if stringprep.in_table_c12(c) else c for c in text if not stringprep.in_table_b1(c)
        )
        text = ucd_3_2_0.normalize("NFKC", "".join(mapped))
    if not text:
        raise ValueError("must not be empty")
    if text.isascii():
        if not text.isprintable():
            raise ValueError(_PROHIBITED)
        return text
    _check_prepared(text)  # One character can have become eighteen.
    if any(is_in(c) for c in text for is_in in _PROHIBITED_TABLES):
        raise ValueError(_PROHIBITED)
    # RFC 3454, section 6: right to left is not mixed with left to right, and is at both ends.
    if any(map(stringprep.in_table_d1, text)) and (
        any(map(stringprep.in_table_d2, text))
        or not (stringprep.in_table_d1(text[0]) and stringprep.in_table_d1(text[-1]))
    ):
        raise ValueError("must not mix writing directions as SASLprep (RFC 4013) prohibits")
    return text


def _check_prepared(text: str) -> None:
    if len(text) > _MAX_PREPARED:
        raise ValueError(f"must not be longer than {_MAX_PREPARED} characters")


_PROHIBITED: Final = (
    "must not hold control characters, emoji and others that SASLprep (RFC 4013) prohibits"
)
_PROHIBITED_TABLES: Final = (
    stringprep.in_table_a1,  # unassigned in Unicode 3.2
    stringprep.in_table_c12,
    stringprep.in_table_c21_c22,
    stringprep.in_table_c3,
    stringprep.in_table_c4,
    stringprep.in_table_c5,
    stringprep.in_table_c6,
    stringprep.in_table_c7,
    stringprep.in_table_c8,
    stringprep.in_table_c9,
)


def prepared_name(username: str) -> str:
    """The user name as clients send it; ValueError says why it cannot be one."""
    check_length(username)
    try:
        return saslprep(username)
    except ValueError as error:
        raise ValueError(f"a user name {error}") from None


def check_length(username: str) -> None:
    """Raise a ValueError that says that the user name is too long."""
    if len(username.encode("utf-8", "surrogatepass")) > _MAX_USERNAME:
        raise ValueError(f"a user name must not be longer than {_MAX_USERNAME} bytes")


def _unescaped(name: str) -> str:
    return name.replace("=2C", ",").replace("=3D", "=")


def _check_extensions(message: str) -> None:
    """Reject the attribute m=: who does not know that extension must not continue."""
    if ",m=" in message:  # no value holds a comma
        raise ValueError("the client asks for an extension that is not known here")


def _refusal(reason: str) -> Refusal:
    return Refusal(ReasonCode.NOT_AUTHORIZED, reason)


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
