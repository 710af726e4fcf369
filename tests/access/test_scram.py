"""SCRAM-SHA-256: the exchange by itself, with the users file, and on the wire of MQTT 5."""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
import secrets
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from command_line import run, set_up
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from raw_client import RawClient

from appliance.access import AccessFileError, FileAccess, Passwords
from appliance.access import scram as scram_module
from appliance.access.scram import METHOD, ScramExchange, Verifier, saslprep
from appliance.broker.values import Accepted, Identity, Refusal
from appliance.mqtt.codec import Properties, Property
from appliance.mqtt.packets import (
    Auth,
    Connack,
    Connect,
    Disconnect,
    Packet,
    Publish,
    Subscribe,
    Subscription,
    Will,
)
from appliance.mqtt.reason import ReasonCode

from .conftest import write

# RFC 7677, section 3.
RFC_NONCE = "%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0"
RFC_FIRST = b"n,,n=user,r=rOprNGfwEbeRWgbNEkqO"
RFC_SERVER_FIRST = (
    b"r=rOprNGfwEbeRWgbNEkqO%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0,s=W22ZaJ0SNY7soEsUEjb6gQ==,i=4096"
)
RFC_FINAL = (
    b"c=biws,r=rOprNGfwEbeRWgbNEkqO%hvYDpWUa2RaTCAfuxFIlj)hNlF$k0,"
    b"p=dHzbZapWIk4jUhN+Ute9ytag9zjfMHgsqmmiz7AndVQ="
)
RFC_SERVER_FINAL = b"v=6rriTRBi23WpRR/wtup+mMhUZUn/dB5nLTJRsjl95G4="


class ScramClient:
    """The client's side, written from RFC 5802 without a look at the server's."""

    def __init__(self, user: str, password: str, header: str = "n,,", extension: str = "") -> None:
        self.password = password.encode()
        self.header = header
        self.extension = extension
        self.nonce = base64.b64encode(secrets.token_bytes(12)).decode()
        escaped = user.replace("=", "=3D").replace(",", "=2C")
        self.bare = f"n={escaped},r={self.nonce}{extension}"
        self.server_signature = b""

    def first(self) -> bytes:
        return (self.header + self.bare).encode()

    def final(self, server_first: bytes) -> bytes:
        nonce, salt, iterations = (part[2:] for part in server_first.decode().split(","))
        assert nonce.startswith(self.nonce) and len(nonce) >= len(self.nonce) + 16
        block = hmac.new(self.password, base64.b64decode(salt) + b"\0\0\0\1", hashlib.sha256)
        last = salted = block.digest()
        for _ in range(int(iterations) - 1):
            last = hmac.new(self.password, last, hashlib.sha256).digest()
            salted = bytes(a ^ b for a, b in zip(salted, last, strict=True))

        def keyed(key: bytes, text: bytes) -> bytes:
            return hmac.new(key, text, hashlib.sha256).digest()

        client_key = keyed(salted, b"Client Key")
        header = base64.b64encode(self.header.encode()).decode()
        without_proof = f"c={header},r={nonce}{self.extension}".encode()
        message = self.bare.encode() + b"," + server_first + b"," + without_proof
        signature = keyed(hashlib.sha256(client_key).digest(), message)
        proof = bytes(a ^ b for a, b in zip(client_key, signature, strict=True))
        self.server_signature = keyed(keyed(salted, b"Server Key"), message)
        return without_proof + b",p=" + base64.b64encode(proof)

    def is_servers(self, server_final: bytes) -> bool:
        return server_final == b"v=" + base64.b64encode(self.server_signature)

    def log_in(self, exchange: ScramExchange) -> Accepted | Refusal:
        """Goes through all of it."""
        challenge = exchange.step(self.first())
        assert isinstance(challenge, bytes)
        outcome = exchange.step(self.final(challenge))
        assert not isinstance(outcome, bytes)
        if isinstance(outcome, Accepted):
            assert self.is_servers(outcome.data)
        return outcome


def stored(password: str, iterations: int = 4096, salt: bytes = b"0123456789abcdef") -> str:
    """As PostgreSQL has it; its documentation (pg_authid) is what this is written from."""
    salted = hashlib.pbkdf2_hmac("sha256", password.encode(), salt, iterations)
    client_key = hmac.digest(salted, b"Client Key", "sha256")
    keys = [hashlib.sha256(client_key).digest(), hmac.digest(salted, b"Server Key", "sha256")]
    encoded = [base64.b64encode(part).decode() for part in (salt, *keys)]
    return f"SCRAM-SHA-256${iterations}:{encoded[0]}${encoded[1]}:{encoded[2]}"


PENCIL = stored("pencil")
ARGON2ID = (  # of "pencil"
    "$argon2id$v=19$m=8,t=1,p=1$MDEyMzQ1Njc4OWFiY2RlZg$TNXVaepwoQBOVs70Xg+kbVgzd21gRaq+ul2VEICRv7g"
)


@pytest.fixture
def users(tmp_path: Path) -> Path:
    return write(tmp_path / "users.passwd", f"user:{PENCIL}\nother:{stored('o')}\nold:{ARGON2ID}\n")


@pytest.fixture
def access(users: Path) -> Iterator[FileAccess]:
    access = FileAccess(users, None, "r2d2")
    yield access
    access.close()


def content(path: Path) -> str:
    return path.read_text()


def begin(access: FileAccess) -> ScramExchange:
    exchange = access.exchange(METHOD, "::1")
    assert isinstance(exchange, ScramExchange)
    return exchange


def refused(outcome: bytes | Accepted | Refusal, reason: str) -> None:
    """It is, with the one code there is for it, and this in the log."""
    assert isinstance(outcome, Refusal)
    assert outcome.code == ReasonCode.NOT_AUTHORIZED
    assert reason in outcome.reason


# The exchange


def rfc_exchange() -> ScramExchange:
    verifier = Verifier.decode(stored("pencil", 4096, base64.b64decode("W22ZaJ0SNY7soEsUEjb6gQ==")))
    return ScramExchange({"user": verifier}.__getitem__, RFC_NONCE)


def test_the_example_of_rfc_7677() -> None:
    exchange = rfc_exchange()
    assert exchange.step(RFC_FIRST) == RFC_SERVER_FIRST
    assert exchange.step(RFC_FINAL) == Accepted("user", RFC_SERVER_FINAL)
    refused(exchange.step(RFC_FINAL), "the exchange is over")


def test_no_byte_of_the_example_may_be_another() -> None:
    for index in range(len(RFC_FINAL)):
        for bit in (1, 32, 128):
            exchange = rfc_exchange()
            exchange.step(RFC_FIRST)
            changed = bytearray(RFC_FINAL)
            changed[index] ^= bit
            refused(exchange.step(bytes(changed)), "")
            refused(exchange.step(RFC_FINAL), "the exchange is over")


@pytest.mark.parametrize("header", ["n,,", "y,,", "n,a=user,", "y,a=user,"])
@pytest.mark.parametrize("extension", ["", ",x=ignored,y=="])
def test_what_a_client_may_say(access: FileAccess, header: str, extension: str) -> None:
    outcome = ScramClient("user", "pencil", header, extension).log_in(begin(access))
    assert isinstance(outcome, Accepted) and outcome.username == "user"


def test_a_client_that_waits_to_be_asked(access: FileAccess) -> None:
    exchange = begin(access)
    assert exchange.step(b"") == b""
    assert isinstance(ScramClient("user", "pencil").log_in(exchange), Accepted)
    exchange = begin(access)
    exchange.step(b"")
    refused(exchange.step(b""), "not a client-first-message")


@pytest.mark.parametrize("name", ["a,b", "a=b", "=2C", "=3D,=3D2C", "böb the builder", "x" * 256])
def test_names_that_need_care(users: Path, name: str) -> None:
    write(users, f"{name}:{PENCIL}\n")
    access = FileAccess(users, None, "r2d2")
    outcome = ScramClient(name, "pencil", f"n,a={_escaped(name)},").log_in(begin(access))
    assert isinstance(outcome, Accepted) and outcome.username == name
    access.close()


def _escaped(name: str) -> str:
    return name.replace("=", "=3D").replace(",", "=2C")


def test_a_name_is_prepared(users: Path) -> None:
    write(users, f"b\u00f6b 4:{PENCIL}\n")
    access = FileAccess(users, None, "r2d2")
    # o and a combining diaeresis, a soft hyphen, a no-break space, a superscript
    outcome = ScramClient("bo\u0308b\u00ad\u00a0\u2074", "pencil").log_in(begin(access))
    assert isinstance(outcome, Accepted) and outcome.username == "b\u00f6b 4"
    access.close()


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (b"p=tls-unique,,n=user,r=abc", "channel binding, which is not offered"),
        (b"p=tls-exporter,,n=user,r=abc", "channel binding, which is not offered"),
        (b"n,a=other,n=user,r=abc", "user 'user' may not act for another one"),
        (b"n,,m=1,n=user,r=abc", "an extension that is not known here"),
        (b"n,,n=user,r=abc,m=1", "an extension that is not known here"),
        (b"n,,n=us=er,r=abc", "not a client-first-message"),
        (b"n,,n=us=2cer,r=abc", "not a client-first-message"),
        (b"n,,n=,r=abc", "not a client-first-message"),
        (b"n,,n=user,r=", "not a client-first-message"),
        (b"n,,n=user,r=a c", "not a client-first-message"),
        (b"n,,n=user,r=abc,", "not a client-first-message"),
        (b"n,,n=user,r=abc\n", "not a client-first-message"),
        (b"n,,n=us\0er,r=abc", "not a client-first-message"),
        (b"n,,r=abc,n=user", "not a client-first-message"),
        (b"n,n=user,r=abc", "not a client-first-message"),
        (b"x,,n=user,r=abc", "not a client-first-message"),
        (b"n=user,r=abc", "not a client-first-message"),
        (RFC_FINAL, "not a client-first-message"),
        (b"n,,n=\xff,r=abc", "utf-8"),
        (b"n,,n=\x07,r=abc", "a user name must not hold control characters"),
        ("n,,n=\u00ad,r=abc".encode(), "a user name must not be empty"),
        ("n,,n=\u06271,r=abc".encode(), "must not mix writing directions"),
        ("n,,n=" + "\u00e4" * 129 + ",r=abc", "must not be longer than 256 bytes"),
        ("n,,n=" + "\ufdfa" * 20 + ",r=abc", "must not be longer than 256 characters"),
        (b"n,,n=" + b"x" * 2048 + b",r=abc", "a message of 2059 bytes, and not of 2048"),
    ],
)
def test_first_messages_that_are_wrong(
    access: FileAccess, message: bytes | str, reason: str
) -> None:
    exchange = begin(access)
    refused(exchange.step(message.encode() if isinstance(message, str) else message), reason)
    refused(exchange.step(b"n,,n=user,r=abc"), "the exchange is over")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda final: b"", "not a client-final-message"),
        (lambda final: final.replace(b"c=biws", b"c=eSws"), "another gs2-header"),
        (lambda final: final.replace(b"c=biws", b"c=biwsbiws"), "another gs2-header"),
        (lambda final: final.replace(b",r=", b",r=x"), "another nonce"),
        (lambda final: final.replace(b",p=", b"x,p="), "another nonce"),
        (lambda final: final.replace(b",p=", b",m=x,p="), "an extension that is not known"),
        (lambda final: final.replace(b",p=", b",x=y,p="), "wrong SCRAM-SHA-256 proof of user"),
        (lambda final: final.partition(b",p=")[0], "not a client-final-message"),
        (lambda final: final.partition(b",p=")[0] + b",p=", "not a client-final-message"),
        (lambda final: final + b",x=y", "not a client-final-message"),
        (lambda final: final[:-4] + b"=", "not a client-final-message"),
        (lambda final: final.partition(b",p=")[0] + b",p=" + b"A" * 43 + b"=", "wrong SCRAM"),
        (lambda final: final + b"," + b"x" * 2048, "bytes, and not of 2048"),
    ],
)
def test_final_messages_that_are_wrong(
    access: FileAccess, change: Callable[[bytes], bytes], reason: str
) -> None:
    exchange, client = begin(access), ScramClient("user", "pencil")
    challenge = exchange.step(client.first())
    assert isinstance(challenge, bytes)
    final = client.final(challenge)
    refused(exchange.step(change(final)), reason)
    refused(exchange.step(final), "the exchange is over")


def test_a_proof_is_good_for_one_exchange(access: FileAccess) -> None:
    first, second, client = begin(access), begin(access), ScramClient("user", "pencil")
    challenges = [first.step(client.first()), second.step(client.first())]
    assert challenges[0] != challenges[1]
    assert isinstance(challenges[0], bytes)
    refused(second.step(client.final(challenges[0])), "another nonce")


def test_a_wrong_password(access: FileAccess) -> None:
    refused(ScramClient("user", "Pencil").log_in(begin(access)), "proof of user 'user'")
    refused(ScramClient("user", "").log_in(begin(access)), "proof of user 'user'")
    refused(ScramClient("user", "o").log_in(begin(access)), "proof of user 'user'")


def test_no_step_hashes_a_password(access: FileAccess, monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[int] = []

    def pbkdf2(name: str, password: bytes, salt: bytes, iterations: int) -> bytes:
        hashed.append(iterations)
        return bytes(32)

    monkeypatch.setattr(scram_module.hashlib, "pbkdf2_hmac", pbkdf2)
    assert isinstance(ScramClient("user", "pencil").log_in(begin(access)), Accepted)
    for user in ("user", "old", "nobody"):
        assert isinstance(ScramClient(user, "x").log_in(begin(access)), Refusal)
    assert not hashed


pieces = b"n,|y,|,|p=x|a=user|n=user|n=|r=abc|m=x|c=biws|=2C|\xff|\0|\xc2\xad|\xd8\xa7".split(b"|")
messages = st.one_of(
    st.binary(max_size=64),
    st.sampled_from([RFC_FIRST, RFC_FINAL[:-4] + b"AAA="]),
    st.lists(st.sampled_from(pieces), max_size=12).map(b"".join),
)


@given(st.lists(messages, max_size=3))
def test_anything_is_answered_and_nothing_accepted(said: list[bytes]) -> None:
    verifier = Verifier.decode(PENCIL)
    exchange = ScramExchange(lambda username: verifier, RFC_NONCE)
    over = False
    for message in said:
        answer = exchange.step(message)
        if over or isinstance(answer, Refusal):
            refused(answer, "")
            over = True
        else:
            assert isinstance(answer, bytes) and len(answer) < 2048 + 100


@examples(50)
@given(st.text(min_size=1, max_size=40), st.text(max_size=40))
def test_whoever_has_the_password_gets_in(name: str, password: str) -> None:
    try:
        prepared, word = saslprep(name), saslprep(password)
    except ValueError:
        return
    assert saslprep(prepared) == prepared
    verifier = Verifier.decode(stored(word))
    outcome = ScramClient(name, word).log_in(ScramExchange({prepared: verifier}.__getitem__))
    assert isinstance(outcome, Accepted) and outcome.username == prepared
    assert verifier.check(password.encode())


@pytest.mark.parametrize(
    ("text", "prepared"),
    [  # RFC 4013, section 3
        ("I\u00adX", "IX"),
        ("user", "user"),
        ("USER", "USER"),
        ("\u00aa", "a"),
        ("\u2168", "IX"),
        ("\u0627\u0628", "\u0627\u0628"),
        ("\u06271\u0628", "\u06271\u0628"),
    ],
)
def test_saslprep(text: str, prepared: str) -> None:
    assert saslprep(text) == prepared


@pytest.mark.parametrize(
    "text",
    ["", "\u00ad", "\x07", "a\x7f", "\u06271", "\u0627a\u0628", "\U0001f600", "\ud800", "\ufffd"],
)
def test_what_saslprep_prohibits(text: str) -> None:
    with pytest.raises(ValueError, match="must not"):
        saslprep(text)


# The users file


def test_a_password_is_kept_for_scram(tmp_path: Path) -> None:
    passwords = Passwords(tmp_path / "users.passwd")
    passwords.set("alice", "geheim", True)
    passwords.set("bob", b"b", for_scram=True)
    passwords.set("carol", "c")
    passwords.save()
    text = passwords.path.read_text()
    assert text.startswith("alice:SCRAM-SHA-256$15000:")
    loaded = Passwords.load(passwords.path)
    assert [loaded.kind_of(user) for user in loaded.users()] == [METHOD, METHOD, "argon2id"]
    outcome = ScramClient("alice", "geheim").log_in(ScramExchange(loaded.verifier))
    assert isinstance(outcome, Accepted)
    # And sent as it is, without being kept as argon2id from then on.
    assert loaded.verify("alice", b"geheim")
    assert not loaded.verify("alice", b"Geheim")
    assert not loaded.verify("alice", b"\xff")
    assert passwords.path.read_text() == text

    loaded.set("alice", "new")
    loaded.set("bob", "new", for_scram=False)
    loaded.set("carol", "new", for_scram=True)
    assert [loaded.kind_of(user) for user in loaded.users()] == [METHOD, "argon2id", METHOD]
    assert isinstance(ScramClient("alice", "new").log_in(ScramExchange(loaded.verifier)), Accepted)
    loaded.remove("alice")
    refused(ScramClient("alice", "new").log_in(ScramExchange(loaded.verifier)), "unknown user")


def test_salts_differ(tmp_path: Path) -> None:
    passwords = Passwords(tmp_path / "users.passwd")
    passwords.set("alice", "x", for_scram=True)
    passwords.set("bob", "x", for_scram=True)
    assert passwords.hash_of("alice") != passwords.hash_of("bob")
    assert passwords.verifier("alice").salt != passwords.verifier("bob").salt


@pytest.mark.parametrize(
    ("name", "password", "reason"),
    [
        ("alice", b"\xff", "a password for SCRAM-SHA-256 must be text in UTF-8"),
        ("alice", "a\tb", "a password for SCRAM-SHA-256 must not hold control characters, emoji"),
        ("alice", "\U0001f600", "must not hold control characters, emoji"),
        ("alice", "\u00ad", "a password for SCRAM-SHA-256 must not be empty"),
        ("alice", "\u00e4" * 257, "must not be longer than 256 characters"),
        ("\u2168", "x", "has to be named as clients send it, 'IX'"),
        ("\U0001f600", "x", "a user name must not hold control characters, emoji"),
    ],
)
def test_what_scram_cannot_have(
    tmp_path: Path, name: str, password: str | bytes, reason: str
) -> None:
    passwords = Passwords(tmp_path / "users.passwd")
    with pytest.raises(ValueError, match=reason):
        passwords.set(name, password, for_scram=True)
    assert passwords.users() == []
    passwords.set(name, password)


def test_a_password_as_postgresql_may_have_stored_it(tmp_path: Path) -> None:
    password = "tab\tand emoji \U0001f600"
    path = write(tmp_path / "users.passwd", f"alice:{stored(password)}\n")
    passwords = Passwords.load(path)
    assert passwords.verify("alice", password.encode())
    assert not passwords.verify("alice", b"tab\tand emoji")


def test_what_is_wrong_with_a_hash_is_told(tmp_path: Path) -> None:
    keys = PENCIL.partition("$")[2].partition("$")[2]
    long_salt = base64.b64encode(bytes(129)).decode()
    path = write(
        tmp_path / "users.passwd",
        f"a:{PENCIL}\n"
        "bob:SCRAM-SHA-256$\n"
        f"c:SCRAM-SHA-256$4095:MDEyMw==${keys}\n"
        f"d:SCRAM-SHA-256$1000001:MDEyMw==${keys}\n"
        f"e:SCRAM-SHA-256$4096:MDEyM===${keys}\n"
        f"f:SCRAM-SHA-256$4096:${keys}\n"
        f"g:{PENCIL}x\n"
        f"h:SCRAM-SHA-1{PENCIL[13:]}\n"
        f"i:SCRAM-SHA-256$4096:{long_salt}${keys}\n"
        f"j:SCRAM-SHA-256$1000000:MDEyMw==${keys}\n",
    )
    with pytest.raises(AccessFileError) as caught:
        Passwords.load(path)
    assert [str(problem).removeprefix(str(path)) for problem in caught.value.problems] == [
        ":2:5: not a valid SCRAM-SHA-256 hash; "
        "set a password with: appliance user passwd bob --scram",
        ":3:3: SCRAM-SHA-256 needs 4096 iterations at least, and here are 4095; "
        "set a password with: appliance user passwd c --scram",
        ":4:3: this hash costs more than one login may; "
        "set a password with: appliance user passwd d --scram",
        ":5:3: not a valid SCRAM-SHA-256 hash; "
        "set a password with: appliance user passwd e --scram",
        ":6:3: not a valid SCRAM-SHA-256 hash; "
        "set a password with: appliance user passwd f --scram",
        ":7:3: not a valid SCRAM-SHA-256 hash; "
        "set a password with: appliance user passwd g --scram",
        ":8:3: a kind of hash that is not read here ($argon2id$, SCRAM-SHA-256$, $7$, $6$); "
        "set a password with: appliance user passwd h",
        ":9:3: a salt of more than 128 bytes; set a password with: appliance user passwd i --scram",
    ]


def test_the_methods_that_are_offered(access: FileAccess) -> None:
    assert access.exchange("SCRAM-SHA-256", "::1") is not None
    for method in ("SCRAM-SHA-256-PLUS", "SCRAM-SHA-1", "scram-sha-256", "PLAIN", ""):
        assert access.exchange(method, "::1") is None
    nobody = FileAccess(None, None, "r2d2")
    assert nobody.exchange("SCRAM-SHA-256", "::1") is None
    nobody.close()


async def test_a_login_that_sends_the_password(access: FileAccess, users: Path) -> None:
    before = content(users)
    for _ in range(2):
        who = await access.authenticate("user", b"pencil", "c", "::1")
        assert who == Identity("user", "c")
        outcome = await access.authenticate("user", b"wrong", "c", "::1")
        assert outcome == Refusal(ReasonCode.NOT_AUTHORIZED, "wrong password for user 'user'")
    assert content(users) == before
    assert isinstance(ScramClient("user", "pencil").log_in(begin(access)), Accepted)


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ("", "user 'user' was changed during the exchange"),
        (f"user:{stored('new')}\n", "was changed during the exchange"),
        (f"user:{stored('pencil', salt=b'another salt')}\n", "was changed during the exchange"),
        (f"user:{ARGON2ID}\n", "was changed during the exchange"),
        (f"user:{PENCIL}\nothers:{stored('new')}\n", None),
    ],
)
def test_a_reload_in_the_middle(
    access: FileAccess, users: Path, lines: str, reason: str | None
) -> None:
    exchange, client = begin(access), ScramClient("user", "pencil")
    challenge = exchange.step(client.first())
    assert isinstance(challenge, bytes)
    write(users, lines)
    access.reload()
    outcome = exchange.step(client.final(challenge))
    if reason is None:
        assert isinstance(outcome, Accepted)
    else:
        refused(outcome, reason)


def test_a_user_that_comes_in_the_middle(access: FileAccess, users: Path) -> None:
    exchange, client = begin(access), ScramClient("late", "pencil")
    challenge = exchange.step(client.first())
    assert isinstance(challenge, bytes)
    write(users, f"late:{PENCIL}\n")
    access.reload()
    refused(exchange.step(client.final(challenge)), "unknown user 'late'")
    assert isinstance(ScramClient("late", "pencil").log_in(begin(access)), Accepted)


# Who is a user is nobody's business


def shown(access: FileAccess, user: str) -> tuple[bytes, int]:
    """The salt and the iterations that a stranger is told."""
    challenge = begin(access).step(f"n,,n={user},r=abc".encode())
    assert isinstance(challenge, bytes)
    _, salt, iterations = challenge.decode().split(",")
    assert salt[:2] == "s=" and iterations[:2] == "i="
    return base64.b64decode(salt[2:], validate=True), int(iterations[2:])


def test_strangers_and_users_of_other_kinds_look_like_users(access: FileAccess) -> None:
    seen = {user: shown(access, user) for user in ("user", "old", "nobody", "x" * 256)}
    assert {(len(salt), iterations) for salt, iterations in seen.values()} == {(16, 4096)}
    assert len({salt for salt, _ in seen.values()}) == len(seen)
    assert all(shown(access, user) == value for user, value in seen.items())
    # The right password of one whose hash is of another kind is as good as none.
    refusals = [ScramClient(user, "pencil").log_in(begin(access)) for user in ("old", "nobody")]
    refused(
        refusals[0], "'old' is not stored for SCRAM-SHA-256; set it with: appliance user passwd"
    )
    refused(refusals[1], "unknown user 'nobody'")
    wrong = ScramClient("user", "wrong").log_in(begin(access))
    assert isinstance(wrong, Refusal)
    assert {refusal.code for refusal in refusals if isinstance(refusal, Refusal)} == {wrong.code}


def test_messages_fail_for_strangers_where_they_do_for_users(access: FileAccess) -> None:
    def ends(user: str, header: str, final: bytes) -> list[str]:
        exchange = begin(access)
        answers = [exchange.step(f"{header}n={user},r=abc".encode()), exchange.step(final)]
        return [type(answer).__name__ for answer in answers]

    for header in ("n,,", "y,,", "n,a=other,", "p=x,,"):
        for final in (b"", b"c=biws,r=abc,p=" + b"A" * 43 + b"=", RFC_FINAL):
            assert len({tuple(ends(user, header, final)) for user in ("user", "old", "no")}) == 1


def test_strangers_look_like_any_of_the_users(users: Path) -> None:
    kinds = {(16, 4096), (16, 15000), (8, 5000)}
    lines = [
        f"u{size}-{iterations}:{stored('x', iterations, bytes(size))}"
        for size, iterations in sorted(kinds)
    ]
    write(users, "\n".join(lines) + "\n")
    access = FileAccess(users, None, "r2d2")
    before = {name: shown(access, name) for name in map(str, range(60))}
    assert {(len(salt), iterations) for salt, iterations in before.values()} == kinds
    # More users of the same kinds change nothing; a new kind takes over some, and only these.
    write(users, "\n".join([*lines, f"more:{PENCIL}"]) + "\n")
    access.reload()
    assert all(shown(access, name) == value for name, value in before.items())
    write(users, "\n".join([*lines, f"more:{stored('x', 6000)}"]) + "\n")
    access.reload()
    changed = [shown(access, name) for name in before if shown(access, name) != before[name]]
    assert 0 < len(changed) < 30
    assert {(len(salt), iterations) for salt, iterations in changed} == {(16, 6000)}
    access.close()


def test_without_users_of_scram_everyone_has_what_new_ones_get(users: Path) -> None:
    write(users, f"old:{ARGON2ID}\n")
    access = FileAccess(users, None, "r2d2")
    assert {shown(access, user)[1] for user in ("old", "nobody")} == {15000}
    assert {len(shown(access, user)[0]) for user in ("old", "nobody")} == {16}
    access.close()


@pytest.mark.parametrize(
    ("machine_id", "outlives"),
    [("0123456789abcdef" * 2 + "\n", True), ("", False), ("uninitialized\n", False), (None, False)],
)
def test_a_restart_does_not_tell_strangers_from_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, machine_id: str | None, outlives: bool
) -> None:
    file = tmp_path / "machine-id"
    if machine_id is not None:
        file.write_text(machine_id)
    monkeypatch.setattr(scram_module, "Path", lambda path: file)

    def salt_after_restart() -> bytes:
        scram_module._secret.cache_clear()
        return scram_module.decoy("nobody", [], "").salt

    try:
        assert (salt_after_restart() == salt_after_restart()) is outlives
        before = salt_after_restart()
        file.write_text("fedcba9876543210" * 2)
        assert salt_after_restart() != before
    finally:
        scram_module._secret.cache_clear()


# The command line


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return set_up(tmp_path, monkeypatch)


def test_the_commands(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "word").write_text("first\n")

    def kinds() -> list[str]:
        capsys.readouterr()
        assert run("user", "list") == 0
        return capsys.readouterr().out.splitlines()

    assert run("user", "add", "bob", "--scram", "--password-file", "word") == 0
    assert kinds() == ["alice  argon2id", "bob    SCRAM-SHA-256"]
    assert run("check") == 0
    assert "users: alice, bob" in capsys.readouterr().out

    def accepted(user: str, password: str) -> bool:
        passwords = Passwords.load(here / "users.passwd")
        outcome = ScramClient(user, password).log_in(ScramExchange(passwords.verifier))
        return isinstance(outcome, Accepted)

    assert accepted("bob", "first")
    (here / "word").write_text("second\n")
    assert run("user", "passwd", "bob", "--password-file", "word") == 0
    assert accepted("bob", "second") and not accepted("bob", "first")
    assert run("user", "passwd", "alice", "--scram", "--password-file", "word") == 0
    assert accepted("alice", "second")
    assert run("user", "passwd", "bob", "--no-scram", "--generate") == 0
    assert kinds() == ["alice  SCRAM-SHA-256", "bob    argon2id"]
    (here / "word").write_text("\u00ad\n")
    assert run("user", "add", "carol", "--scram", "--password-file", "word") == 1
    assert "a password for SCRAM-SHA-256 must not be empty" in capsys.readouterr().err
    assert kinds() == ["alice  SCRAM-SHA-256", "bob    argon2id"]


def test_check_names_the_place(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(here / "users.passwd", f"alice:{PENCIL}\nbob:SCRAM-SHA-256$1\n")
    assert run("check") == 1
    assert "users.passwd:2:5: not a valid SCRAM-SHA-256 hash" in capsys.readouterr().out


# On the wire: enhanced authentication, MQTT 5.0 section 4.12

ACL = "user user\ntopic readwrite r2d2/#\n\nuser alice\ntopic readwrite r2d2/#\n"
CONTINUE, AGAIN = ReasonCode.CONTINUE_AUTHENTICATION, ReasonCode.RE_AUTHENTICATE
#: CONNACK with nothing but the reason: what a client that is refused is told.
REFUSED = {code: bytes((0x20, 3, 0, code, 0)) for code in (0x82, 0x87, 0x8C)}
#: Seconds from the connection to the end of the login.
CONNECT_TIMEOUT = 10


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    yield from running(tmp_path_factory.mktemp("robot"))


@pytest.fixture
def quiet_robot(tmp_path: Path) -> Iterator[ApplianceProcess]:
    """One of its own for a test that reads the log, which does not repeat itself for ever."""
    yield from running(tmp_path)


def running(directory: Path) -> Iterator[ApplianceProcess]:
    broker = {"limits": {"connect_timeout": f"{CONNECT_TIMEOUT} s"}}
    process = ApplianceProcess(directory, acl=ACL, broker=broker)
    users = process.directory / "users.passwd"
    write(users, f"{users.read_text()}user:{PENCIL}\nother:{stored('o')}\n")
    process.passwords |= {"user": "pencil", "other": "o"}
    process.start()
    yield process
    process.stop()


@pytest.fixture
def dial(robot: ApplianceProcess) -> Iterator[Callable[..., RawClient]]:
    clients: list[RawClient] = []

    def dial(version: int = 5, *, tls: bool = False) -> RawClient:
        clients.append(RawClient(robot, version, tls=tls))
        return clients[-1]

    yield dial
    for client in clients:
        client.socket.close()


Dial = Callable[..., RawClient]


def properties(data: bytes | None, method: str = METHOD) -> Properties:
    found: Properties = {Property.AUTHENTICATION_METHOD: method}
    if data is not None:
        found[Property.AUTHENTICATION_DATA] = data
    return found


def connect(client_id: str, data: bytes | None, method: str = METHOD, **fields: object) -> Connect:
    fields.setdefault("clean_start", True)
    return Connect(client_id, version=5, properties=properties(data, method), **fields)  # type: ignore[arg-type]


def auth(code: ReasonCode, data: bytes | None, method: str = METHOD) -> Auth:
    return Auth(code, properties(data, method))


def challenged(client: RawClient) -> bytes:
    """The data of the AUTH that comes next, which asks for more."""
    packet = client.decode(client.receive())
    assert isinstance(packet, Auth), packet
    assert packet.reason_code == CONTINUE  # [MQTT-4.12.0-2]
    assert packet.properties is not None  # [MQTT-4.12.0-5]
    assert packet.properties[Property.AUTHENTICATION_METHOD] == METHOD
    data = packet.properties.get(Property.AUTHENTICATION_DATA, b"")
    assert isinstance(data, bytes)
    return data


def log_in(client: RawClient, scram: ScramClient, client_id: str, **fields: object) -> bytes:
    """Goes through the exchange; what it is answered at the end."""
    client.send(connect(client_id, scram.first(), **fields))
    client.send(auth(CONTINUE, scram.final(challenged(client))))
    return client.receive()


def logged_in(client: RawClient, client_id: str, **fields: object) -> RawClient:
    """A client whose login as user succeeded."""
    answer = client.decode(log_in(client, ScramClient("user", "pencil"), client_id, **fields))
    assert isinstance(answer, Connack) and answer.reason_code == 0, answer
    return client


def disconnected(client: RawClient, code: ReasonCode) -> None:
    packet = client.decode(client.receive())
    assert isinstance(packet, Disconnect), packet
    assert packet.reason_code == code
    assert client.receive() == b""


def watch(dial: Dial, topic: str) -> RawClient:
    """A client that receives what is published there."""
    watcher = dial()
    assert watcher.connect(f"watch {topic}", "user", "pencil")[0] == 0x20
    watcher.send(Subscribe(1, [Subscription(topic, 0)]))
    watcher.drain()
    return watcher


@pytest.mark.statement("5.0", "MQTT-4.12.0-2", "MQTT-4.12.0-3", "MQTT-4.12.0-5")
@pytest.mark.parametrize("tls", [True, False], ids=["tls", "plain"])
def test_the_right_password(robot: ApplianceProcess, dial: Dial, tls: bool) -> None:
    client, scram = dial(tls=tls), ScramClient("user", "pencil")
    answer = client.decode(log_in(client, scram, f"right {tls}"))
    assert isinstance(answer, Connack) and answer.reason_code == 0
    assert answer.properties is not None
    assert answer.properties[Property.AUTHENTICATION_METHOD] == METHOD  # [MQTT-4.12.0-5]
    assert scram.is_servers(answer.properties[Property.AUTHENTICATION_DATA])  # type: ignore[arg-type]
    robot.wait_for_log(f"client 'right {tls}' \\(user 'user'\\).* connected: MQTT 5")
    client.send(Subscribe(1, [Subscription("r2d2/x", 0), Subscription("not/his", 0)]))
    client.send(Publish("r2d2/x", b"hello"))
    suback, publish = client.drain()
    assert suback.reason_codes == [0, 0x87]  # type: ignore[attr-defined]
    assert isinstance(publish, Publish) and publish.payload == b"hello"


def test_a_connect_without_data(dial: Dial) -> None:
    client, scram = dial(), ScramClient("user", "pencil")
    client.send(connect("no data", None))
    assert challenged(client) == b""
    client.send(auth(CONTINUE, scram.first()))
    client.send(auth(CONTINUE, scram.final(challenged(client))))
    assert client.receive()[:4:3] == b"\x20\0"


def test_a_large_connect(dial: Dial) -> None:
    will = Will("r2d2/will", bytes(65535), 0, False, {Property.USER_PROPERTY: [("x", "x" * 30000)]})
    client = logged_in(dial(), "large", will=will)
    assert client.drain() == []


@pytest.mark.statement("5.0", "MQTT-4.12.0-6")
@pytest.mark.parametrize("version", [4, 5], ids=["v311", "v5"])
def test_the_password_as_it_is(dial: Dial, version: int) -> None:
    client = dial(version)
    answer = client.decode(client.connect(f"sent {version}", "user", "pencil"))
    assert isinstance(answer, Connack) and answer.reason_code == 0
    assert Property.AUTHENTICATION_METHOD not in (answer.properties or {})
    assert client.drain() == []
    refusal = dial(version).connect(f"wrong {version}", "user", "Pencil")
    assert refusal == (b"\x20\x02\x00\x05" if version == 4 else REFUSED[0x87])


@pytest.mark.statement("5.0", "MQTT-4.12.0-4")
def test_a_refusal_is_the_same_for_everyone(robot: ApplianceProcess, dial: Dial) -> None:
    # alice has an argon2id hash, and this is her password.
    users = {"user": "Pencil", "alice": robot.passwords["alice"], "nobody": "pencil"}
    for user, password in users.items():
        client = dial()
        assert log_in(client, ScramClient(user, password), f"no {user}") == REFUSED[0x87]
        assert client.receive() == b""


def test_the_log_says_who_was_refused_and_why(quiet_robot: ApplianceProcess) -> None:
    reasons = {
        ("user", "Pencil"): "wrong SCRAM-SHA-256 proof of user 'user'$",
        ("alice", "x"): "the password of user 'alice' is not stored for SCRAM-SHA-256; set it",
        ("nobody", "x"): "unknown user 'nobody'$",
        ("no\nline", "x"): "SCRAM-SHA-256: a user name must not hold control characters",
    }
    for (user, password), reason in reasons.items():
        with RawClient(quiet_robot, 5) as client:
            scram = ScramClient(user, password)
            client.send(connect("tablet", scram.first()))
            if user.isprintable():
                client.send(auth(CONTINUE, scram.final(challenged(client))))
            assert client.receive() == REFUSED[0x87]
            quiet_robot.wait_for_log(f"client 'tablet' .* at {client.address} refused: {reason}")
    with RawClient(quiet_robot, 5) as client:
        logged_in(client, "tablet").send(auth(AGAIN, b"nonsense"))
        disconnected(client, ReasonCode.NOT_AUTHORIZED)
        quiet_robot.wait_for_log("client 'tablet' \\(user 'user'\\).*: not a client-first-message")


@pytest.mark.parametrize("data", [b"nonsense", b"\xff" * 60000, b"p=tls-unique,,n=user,r=x"])
def test_a_first_message_that_is_wrong(dial: Dial, data: bytes) -> None:
    client = dial()
    client.send(connect("wrong first", data))
    assert client.receive() == REFUSED[0x87]
    assert client.receive() == b""


@pytest.mark.statement("5.0", "MQTT-4.12.0-1")
@pytest.mark.parametrize("method", ["SCRAM-SHA-1", "SCRAM-SHA-256-PLUS", "x\u202ey", ""])
def test_a_method_that_is_not_offered(dial: Dial, method: str) -> None:
    client = dial()
    client.send(connect("method", RFC_FIRST, method))
    assert client.receive() == REFUSED[0x8C]
    assert client.receive() == b""


def test_nothing_behind_a_refused_exchange_has_an_effect(dial: Dial) -> None:
    watcher = watch(dial, "r2d2/behind")
    client, scram = dial(), ScramClient("user", "wrong")
    client.send(connect("behind", scram.first()))
    final = auth(CONTINUE, scram.final(challenged(client)))
    client.send(final, Publish("r2d2/behind", b"x", retain=True))
    assert client.receive() == REFUSED[0x87]
    assert client.receive() == b""
    assert watcher.drain() == []


def test_a_stranger_touches_nothing_before_its_proof(dial: Dial) -> None:
    owner = logged_in(dial(), "owned")
    owner.send(Subscribe(1, [Subscription("r2d2/owned", 0)]))
    client, scram = dial(), ScramClient("user", "wrong")
    client.send(connect("owned", scram.first(), will=Will("r2d2/owned", b"x")))
    challenge = challenged(client)
    assert len(owner.drain()) == 1
    client.send(auth(CONTINUE, scram.final(challenge)))
    assert client.receive() == REFUSED[0x87]
    assert owner.drain() == []
    # Another user may not have the session either.
    assert log_in(dial(), ScramClient("other", "o"), "owned")[:4:3] == b"\x20\x85"
    assert owner.drain() == []


@pytest.mark.statement("5.0", "MQTT-3.1.2-30")
@pytest.mark.parametrize(
    "packet",
    [
        Publish("r2d2/middle", b"x", retain=True),
        Subscribe(1, [Subscription("#", 0)]),
        connect("middle", RFC_FIRST),
        auth(CONTINUE, RFC_FINAL, "SCRAM-SHA-1"),  # [MQTT-4.12.0-5]
        auth(AGAIN, RFC_FIRST),
        Auth(ReasonCode.SUCCESS, properties(b"x")),
    ],
    ids=["PUBLISH", "SUBSCRIBE", "CONNECT", "another method", "AUTH 0x19", "AUTH 0x00"],
)
def test_what_may_not_come_in_the_middle(
    robot: ApplianceProcess, dial: Dial, packet: Packet
) -> None:
    watcher = watch(dial, "r2d2/middle")
    client, scram = dial(), ScramClient("user", "pencil")
    client.send(connect("middle", scram.first()))
    final = auth(CONTINUE, scram.final(challenged(client)))
    client.send(packet, final)  # [MQTT-3.1.2-30]
    assert client.receive() == REFUSED[0x82]
    assert client.receive() == b""
    assert watcher.drain() == []


def test_a_client_that_changes_its_mind(dial: Dial) -> None:
    watcher = watch(dial, "r2d2/will")
    client = dial()
    client.send(connect("leaves", b"n,,n=user,r=abc", will=Will("r2d2/will", b"x")))
    challenged(client)
    client.send(Disconnect(ReasonCode.DISCONNECT_WITH_WILL_MESSAGE))
    assert client.receive() == b""
    client = dial()
    client.send(connect("leaves", b"n,,n=user,r=abc", will=Will("r2d2/will", b"x")))
    challenged(client)
    client.kill()
    assert watcher.drain() == []
    logged_in(dial(), "leaves")


def test_a_client_that_stops_in_the_middle(robot: ApplianceProcess, dial: Dial) -> None:
    done = logged_in(dial(), "done")
    silent, dripping = dial(), dial()
    silent.send(connect("silent", b"n,,n=user,r=abc", keep_alive=1))
    challenged(silent)
    dripping.send(connect("dripping", None))
    assert challenged(dripping) == b""
    # AUTH packets, as far as they are allowed, do not prolong it.
    dripping.send(auth(CONTINUE, b"n,,n=user,r=abc"))
    challenged(dripping)
    for client in (silent, dripping):
        assert client.receive() == b""
        robot.wait_for_log(f"{client.address}: no complete CONNECT within {CONNECT_TIMEOUT} s")
    assert done.drain() == []  # who has logged in may take its time


def test_exchanges_at_once(dial: Dial) -> None:
    logins = [
        (dial(), ScramClient(user, password))
        for user, password in [("user", "pencil"), ("user", "wrong"), ("user", "pencil")] * 3
    ]
    for number, (client, scram) in enumerate(logins):
        client.send(connect(f"at once {number}", scram.first()))
    finals = [scram.final(challenged(client)) for client, scram in logins]
    for (client, _), final in reversed(list(zip(logins, finals, strict=True))):
        client.send(auth(CONTINUE, final))
    answers = [client.receive()[3] for client, _ in logins]
    assert answers == [0, 0x87, 0] * 3
    # Nobody comes in with what another one was challenged for.
    client = dial()
    client.send(connect("replayed", logins[0][1].first()))
    challenged(client)
    client.send(auth(CONTINUE, finals[0]))
    assert client.receive() == REFUSED[0x87]


@pytest.mark.statement("5.0", "MQTT-4.12.1-1")
def test_authentication_again(robot: ApplianceProcess, dial: Dial) -> None:
    client = logged_in(dial(), "again")
    client.send(Subscribe(1, [Subscription("r2d2/again", 0)]))
    client.drain()
    for _ in range(2):
        scram = ScramClient("user", "pencil")
        client.send(auth(AGAIN, scram.first()))  # [MQTT-4.12.1-1]
        challenge = challenged(client)
        client.send(Publish("r2d2/again", b"meanwhile"))  # which it may
        (publish,) = client.drain()
        assert isinstance(publish, Publish) and publish.payload == b"meanwhile"
        client.send(auth(CONTINUE, scram.final(challenge)))
        answer = client.decode(client.receive())
        assert isinstance(answer, Auth) and answer.reason_code == ReasonCode.SUCCESS
        assert answer.properties is not None
        assert answer.properties[Property.AUTHENTICATION_METHOD] == METHOD
        assert scram.is_servers(answer.properties[Property.AUTHENTICATION_DATA])  # type: ignore[arg-type]
    client.send(Publish("r2d2/again", b"afterwards"))
    (publish,) = client.drain()
    assert isinstance(publish, Publish) and publish.payload == b"afterwards"


@pytest.mark.statement("5.0", "MQTT-4.12.1-2")
@pytest.mark.parametrize(
    ("user", "password", "reason"),
    [
        ("user", "wrong", "wrong SCRAM-SHA-256 proof of user 'user'"),
        ("nobody", "pencil", "again as the user that it is"),
        ("other", "o", "again as the user that it is"),
    ],
)
def test_authentication_again_that_fails(
    robot: ApplianceProcess, dial: Dial, user: str, password: str, reason: str
) -> None:
    watcher = watch(dial, "r2d2/gone")
    will = Will("r2d2/gone", b"his will")
    client = logged_in(dial(), f"again {user}", will=will)
    scram = ScramClient(user, password)
    client.send(auth(AGAIN, scram.first()))
    if user == "user":
        client.send(auth(CONTINUE, scram.final(challenged(client))))
    client.send(Publish("r2d2/gone", b"too late"))
    disconnected(client, ReasonCode.NOT_AUTHORIZED)
    robot.wait_for_log(f"client 'again {user}' .* {reason}")
    (publish,) = watcher.drain()
    assert isinstance(publish, Publish) and publish.payload == b"his will"


@pytest.mark.statement("5.0", "MQTT-4.12.1-1")
@pytest.mark.parametrize(
    "packets",
    [
        [auth(CONTINUE, RFC_FIRST)],
        [Auth(ReasonCode.SUCCESS, properties(b"x"))],
        [auth(AGAIN, b"n,,n=user,r=a"), auth(AGAIN, b"n,,n=user,r=a")],
        [auth(AGAIN, b"n,,n=user,r=a", "SCRAM-SHA-1")],  # [MQTT-4.12.1-1]
        [Auth(AGAIN)],
    ],
    ids=["none begun", "success", "two at once", "another method", "no method"],
)
def test_authentication_again_that_is_not_one(dial: Dial, packets: list[Packet]) -> None:
    client = logged_in(dial(), "not one")
    client.send(*packets)
    if len(packets) > 1:
        challenged(client)
    disconnected(client, ReasonCode.PROTOCOL_ERROR)


@pytest.mark.statement("5.0", "MQTT-3.15.2-1")
@pytest.mark.parametrize("code", [0x01, 0x17, 0x1A, 0x80, 0xFF])
def test_auth_with_a_reason_that_it_does_not_have(dial: Dial, code: int) -> None:
    client = logged_in(dial(), "reason")
    body = bytes((code, 0))
    client.socket.sendall(bytes((0xF0, len(body))) + body)
    packet = client.decode(client.receive())
    assert isinstance(packet, Disconnect)
    assert packet.reason_code in (ReasonCode.MALFORMED_PACKET, ReasonCode.PROTOCOL_ERROR)
    assert client.receive() == b""


@pytest.mark.statement("5.0", "MQTT-3.15.2-2", "MQTT-3.15.2-3")
def test_auth_says_no_more_than_it_has_to(dial: Dial) -> None:
    client = dial()
    client.send(limited("short", 110))
    data = client.receive()
    assert len(data) <= 110
    challenge = client.decode(data)
    assert isinstance(challenge, Auth) and challenge.properties is not None
    assert set(challenge.properties) == set(properties(b""))


@pytest.mark.statement("5.0", "MQTT-3.1.2-24")
def test_an_auth_that_is_too_large_for_the_client_is_not_sent(dial: Dial) -> None:
    client = dial()
    client.send(limited("small", 20))
    assert len(client.receive()) <= 20
    assert client.receive() == b""


def limited(client_id: str, size: int) -> Connect:
    """A CONNECT that begins an exchange, with a Maximum Packet Size."""
    packet = connect(client_id, b"n,,n=user,r=fyko+d2lbbFgONRv9qkxdawL")
    assert packet.properties is not None
    packet.properties[Property.MAXIMUM_PACKET_SIZE] = size
    return packet


@pytest.mark.statement("5.0", "MQTT-4.12.0-7")
@pytest.mark.parametrize("code", [CONTINUE, AGAIN])
def test_auth_of_a_client_that_sent_its_password(dial: Dial, code: ReasonCode) -> None:
    client = dial()
    assert client.connect("sent", "user", "pencil")[3] == 0
    client.send(auth(code, RFC_FIRST))
    disconnected(client, ReasonCode.PROTOCOL_ERROR)


def test_auth_before_connect(dial: Dial) -> None:
    client = dial()
    client.send(auth(CONTINUE, RFC_FIRST))
    assert client.receive() == b""


def test_a_user_that_is_removed_in_the_middle(robot: ApplianceProcess, dial: Dial) -> None:
    users = robot.directory / "users.passwd"
    before = users.read_text()
    client, scram = dial(), ScramClient("user", "pencil")
    client.send(connect("removed", scram.first()))
    final = scram.final(challenged(client))
    try:
        write(users, before.replace(f"user:{PENCIL}\n", ""))
        os.kill(robot.pid, signal.SIGHUP)
        robot.wait_for_log("reload: reloaded: ")
        client.send(auth(CONTINUE, final))
        assert client.receive() == REFUSED[0x87]
    finally:
        write(users, before)
        os.kill(robot.pid, signal.SIGHUP)
        robot.wait_for_log("reload: reloaded: ", 2)
    logged_in(dial(), "removed")


def test_a_client_authenticates_again_only_as_who_it_is() -> None:
    """Otherwise each exchange would be a guess at another's password that nobody counts."""
    passwords = {"alice": Verifier.decode(stored("geheim"))}
    asked: list[str] = []

    def verifier_of(username: str) -> Verifier:
        asked.append(username)
        return passwords[username]

    outcome = ScramClient("alice", "geheim").log_in(ScramExchange(verifier_of, only="alice"))
    assert isinstance(outcome, Accepted)
    asked.clear()
    for name in ("bob", "admin"):
        exchange = ScramExchange(verifier_of, only="alice")
        refused(exchange.step(ScramClient(name, "x").first()), "again as the user that it is")
    assert not asked  # so that the answer is the same for users that are and that are not


def test_names_are_prepared_only_of_who_may_try(monkeypatch: pytest.MonkeyPatch) -> None:
    """And of no more than a user name may have, and once: it is done on the event loop."""
    prepared: list[str] = []

    def count(text: str) -> str:
        prepared.append(text)
        return saslprep(text)

    monkeypatch.setattr(scram_module, "saslprep", count)
    thai = "\u0e01" * 85
    verifier = Verifier.decode(stored("geheim"))

    def first(name: str, header: str = "n,,", **options: Any) -> Any:
        client = ScramClient(name, "geheim", header=header)
        return ScramExchange(lambda username: verifier, **options).step(client.first())

    assert isinstance(first(thai, f"n,a={thai},"), bytes)
    assert prepared == [thai]
    prepared.clear()
    refused(first(thai + "\u0e01"), "must not be longer than 256 bytes")
    outcome = first(thai, admits=lambda: False)
    assert isinstance(outcome, Refusal) and outcome.code is ReasonCode.SERVER_BUSY
    assert not prepared
