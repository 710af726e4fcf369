from __future__ import annotations

import asyncio
import itertools
import logging
import os
import random
import shutil
import socket
import stat
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import paho.mqtt.client as paho
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

from appliance.access import (
    AccessFileError,
    Acl,
    FileAccess,
    Passwords,
    Permission,
    Refusal,
    Rule,
    check_password,
    check_username,
)
from appliance.access import passwords as passwords_module
from appliance.access import rules as rules_module
from appliance.broker.values import Action, Identity
from appliance.mqtt.reason import ReasonCode
from appliance.mqtt.topics import matches

from .conftest import count_checks, write

# Made by mosquitto_passwd 2.0.11; the password is "geheim".
SHA512 = (
    "$6$lJVgcY017kDyVj1Z$uUXEGwuVuGMZ9AO0gKfvzWRL6kObeFmzbn2+9Ds9tFlq6GuzIEPmtvd31sTspaazXhspiUMg"
    "+6i1HBbj8fUbSQ=="
)
PBKDF2 = (
    "$7$101$F8SwI96dfKBGiAOn$EKvIFTRB7Q5YqDFkk3HGn35J9+VE0CbTdT18rnjAcwPauI4LbDK11ecMf+JO6zVqPLVN"
    "63gVKGW7zOVHd9vkUQ=="
)


# Passwords


@pytest.fixture
def users_file(tmp_path: Path) -> Path:
    return tmp_path / "users.passwd"


def problems_of(path: Path) -> list[str]:
    with pytest.raises(AccessFileError) as caught:
        Passwords.load(path)
    return [str(problem).removeprefix(str(path)) for problem in caught.value.problems]


def test_a_password_is_set_saved_loaded_and_verified(users_file: Path) -> None:
    passwords = Passwords(users_file)
    passwords.set("alice", "geheim")
    passwords.set("böb the builder", b"\xff\x00")
    passwords.save()
    assert stat.S_IMODE(users_file.stat().st_mode) == 0o600
    assert users_file.read_text().startswith("alice:$argon2id$v=19$m=19456,t=2,p=1$")

    loaded = Passwords.load(users_file)
    assert loaded.users() == ["alice", "böb the builder"]
    assert loaded.verify("alice", b"geheim")
    assert loaded.verify("böb the builder", b"\xff\x00")
    assert not loaded.verify("alice", b"Geheim")
    assert not loaded.verify("alice", b"")
    assert not loaded.verify("nobody", b"geheim")


def test_a_user_is_removed(users_file: Path) -> None:
    write(users_file, f"# ours\nalice:{SHA512}\n\nbob:{PBKDF2}\n")
    passwords = Passwords.load(users_file)
    passwords.remove("alice")
    passwords.save()
    assert users_file.read_text() == f"# ours\n\nbob:{PBKDF2}\n"
    with pytest.raises(KeyError):
        passwords.remove("alice")


def test_saving_keeps_what_others_wrote_meanwhile(users_file: Path) -> None:
    write(users_file, f"alice:{SHA512}\n")
    first, second = Passwords.load(users_file), Passwords.load(users_file)
    first.set("bob", "b")
    first.save()
    second.set("carol", "c")
    second.save()
    assert Passwords.load(users_file).users() == ["alice", "bob", "carol"]


def test_saving_keeps_the_groups_right_to_read_and_no_other(users_file: Path) -> None:
    write(users_file, f"alice:{SHA512}\n")
    users_file.chmod(0o664)
    passwords = Passwords.load(users_file)
    passwords.set("alice", "new")
    passwords.save()
    assert stat.S_IMODE(users_file.stat().st_mode) == 0o640


def test_saving_through_a_symbolic_link_replaces_the_file(users_file: Path) -> None:
    target = write(users_file.with_name("target"), f"alice:{SHA512}\n")
    users_file.symlink_to(target)
    passwords = Passwords.load(users_file)
    passwords.set("bob", "b")
    passwords.save()
    assert users_file.is_symlink()
    assert Passwords.load(target).users() == ["alice", "bob"]


def test_a_save_that_fails_says_so_and_leaves_the_file(
    users_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(users_file, f"alice:{SHA512}\n")
    passwords = Passwords.load(users_file)
    passwords.set("alice", "new")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(passwords_module.os, "fsync", full)
    with pytest.raises(AccessFileError, match=r"cannot be written \(No space left on device\)"):
        passwords.save()
    monkeypatch.undo()
    assert users_file.read_text() == f"alice:{SHA512}\n"
    assert [path.name for path in users_file.parent.iterdir()] == [users_file.name]
    passwords.save()
    assert Passwords.load(users_file).verify("alice", b"new")


@pytest.mark.parametrize("stored", [SHA512, PBKDF2])
def test_mosquittos_hashes_are_read_and_replaced_at_the_next_login(
    users_file: Path, stored: str
) -> None:
    write(users_file, f"# ours\nalice:{stored}\nbob:{SHA512}\n")
    passwords = Passwords.load(users_file)
    assert not passwords.verify("alice", b"wrong")
    assert passwords.hash_of("alice") == stored
    assert passwords.verify("alice", b"geheim")
    new = passwords.hash_of("alice")
    assert new is not None and new.startswith("$argon2id$")
    assert users_file.read_text() == f"# ours\nalice:{new}\nbob:{SHA512}\n"
    assert passwords.verify("alice", b"geheim")
    assert not passwords.verify("alice", b"wrong")


def test_a_rehash_does_not_undo_a_new_password(users_file: Path) -> None:
    write(users_file, f"alice:{SHA512}\n")
    running = Passwords.load(users_file)
    command = Passwords.load(users_file)
    command.set("alice", "new")
    command.save()
    assert running.verify("alice", b"geheim")  # Not yet reloaded.
    assert Passwords.load(users_file).verify("alice", b"new")


def test_a_rehash_that_cannot_be_saved_is_logged_and_the_login_good(
    users_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(users_file, f"alice:{SHA512}\n")
    passwords = Passwords.load(users_file)
    shutil.rmtree(users_file.parent)
    assert passwords.verify("alice", b"geheim")
    assert "the new hash of user 'alice' is not saved" in caplog.text
    assert "geheim" not in caplog.text and "$6$" not in caplog.text


@pytest.mark.skipif(shutil.which("mosquitto_passwd") is None, reason="mosquitto is not installed")
@pytest.mark.parametrize("password", ["geheim", "päss wörd", "x" * 500])
@pytest.mark.parametrize("kind", ["sha512", "sha512-pbkdf2"])
def test_hashes_of_the_real_mosquitto_passwd(users_file: Path, kind: str, password: str) -> None:
    command = ["mosquitto_passwd", "-H", kind, "-c", "-b", str(users_file), "alice", password]
    subprocess.run(command, check=True, capture_output=True, timeout=10)
    users_file.chmod(0o600)
    passwords = Passwords.load(users_file)
    stored = passwords.hash_of("alice")
    assert stored is not None and stored.startswith("$6$" if kind == "sha512" else "$7$")
    assert not check_password(stored, password.encode() + b"x")
    assert passwords.verify("alice", password.encode())


def test_all_that_is_wrong_with_a_users_file_is_told_at_once(users_file: Path) -> None:
    write(
        users_file,
        "# comment\n"
        "alice:secret-in-clear\n"
        f"bob:{SHA512}\n"
        "\n"
        "carol\n"
        f"bob:{PBKDF2}\n"
        f":{SHA512}\n"
        "dave:\n"
        "erin:$6$AAAA$AAAA\n"
        "frank:$7$0$AAAA$" + SHA512.rpartition("$")[2] + "\n"
        "grace:$2b$12$abcdefghijklmnopqrstuv\n"
        "heidi:$argon2id$v=19$m=99999999,t=2,p=1$" + "A" * 22 + "$" + "A" * 43 + "\n"
        "ivan:$argon2id$v=19$m=1,t\n",
    )
    assert problems_of(users_file) == [
        ":2:7: a plain password is not accepted; set a password with: appliance user passwd alice",
        ":5:1: not user:hash; add users with: appliance user add NAME",
        ":6:1: user 'bob' is in line 3 already; remove one of them",
        ":7:1: a user name must not be empty",
        ":8:6: the user has no password; set a password with: appliance user passwd dave",
        ":9:6: not a valid $6$ hash of mosquitto's (salted SHA-512); "
        "set a password with: appliance user passwd erin",
        ":10:7: not a valid $7$ hash of mosquitto's (PBKDF2-SHA512); "
        "set a password with: appliance user passwd frank",
        ":11:7: a kind of hash that is not read here ($argon2id$, SCRAM-SHA-256$, $7$, $6$); "
        "set a password with: appliance user passwd grace",
        ":12:7: this hash costs more than one login may; "
        "set a password with: appliance user passwd heidi",
        ":13:6: not a valid argon2id hash; set a password with: appliance user passwd ivan",
    ]


def test_files_that_cannot_be_read(users_file: Path, tmp_path: Path) -> None:
    message = ": there is no such file; add a first user with: appliance user add NAME"
    assert problems_of(users_file) == [message]
    users_file.write_bytes(b"a\nb\xffc")
    assert problems_of(users_file) == [":2:2: not UTF-8; save the file in that encoding"]
    [problem] = problems_of(tmp_path)
    assert problem.startswith(": cannot be read (Is a directory); ")


def test_a_users_file_open_to_others_is_told(
    users_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(users_file, f"alice:{SHA512}\n").chmod(0o644)
    Passwords.load(users_file)
    assert f"chmod o= {users_file}" in caplog.text


@pytest.mark.parametrize(
    "name",
    ["", "a:b", "a\nb", "a\x7f", " a", "a ", "#a", "x" * 257, "ä" * 129, "a\u2028b", "\ufeffa"],
)
def test_user_names_that_the_files_cannot_hold(users_file: Path, name: str) -> None:
    with pytest.raises(ValueError, match="user name"):
        check_username(name)
    with pytest.raises(ValueError, match="user name"):
        Passwords(users_file).set(name, "x")


def test_an_empty_password_is_not_set(users_file: Path) -> None:
    with pytest.raises(ValueError, match="empty"):
        Passwords(users_file).set("alice", "")


@pytest.mark.parametrize("with_scram", [False, True])
@pytest.mark.parametrize("user", ["nobody", "modern", "old", "scram"])
def test_every_refusal_costs_one_hash_of_each_slow_kind_in_the_file(
    users_file: Path, monkeypatch: pytest.MonkeyPatch, user: str, with_scram: bool
) -> None:
    passwords = Passwords(users_file)
    passwords.set("modern", "x")
    if with_scram:
        passwords.set("scram", "x", for_scram=True)
    passwords._hashes["old"] = SHA512
    checked: list[str] = []

    def check(stored: str, password: bytes) -> bool:
        checked.append(stored)
        return check_password(stored, password)

    monkeypatch.setattr(passwords_module, "check_password", check)
    assert not passwords.verify(user, b"wrong")
    argon2id = "$argon2id$v=19$m=19456,t=2,p=1$"
    assert sum(stored.startswith(argon2id) for stored in checked) == 1
    assert sum(stored.startswith("SCRAM-SHA-256$15000:") for stored in checked) == with_scram


# The ACL


def acl_of(tmp_path: Path, text: str, robot: str = "r2d2") -> Acl:
    return Acl.load(write(tmp_path / "acl.conf", text), robot)


ALICE = Identity("alice", "tablet")
BOB = Identity("bob", "phone")
NOBODY = Identity(None, "stranger")

EXAMPLE = """\
# for anonymous clients
topic read public/#

user alice
topic read {robot}/#
topic deny {robot}/secret/#
topic write {robot}/cmd_vel
topic read $SYS/#
topic readwrite two words/and more

user bob
topic notes

pattern write clients/%c/state
pattern users/%u/#
pattern deny users/%u/locked
"""


@pytest.mark.parametrize(
    ("identity", "action", "topic", "allowed", "reason"),
    [
        (ALICE, Action.RECEIVE, "r2d2/odom", True, "acl.conf:5: topic read r2d2/#"),
        (ALICE, Action.RECEIVE, "r2d2", True, "acl.conf:5: topic read r2d2/#"),
        (ALICE, Action.RECEIVE, "r2d2/secret/x", False, "acl.conf:6: topic deny r2d2/secret/#"),
        (ALICE, Action.PUBLISH, "r2d2/cmd_vel", True, "acl.conf:7: topic write r2d2/cmd_vel"),
        (
            ALICE,
            Action.PUBLISH,
            "r2d2/odom",
            False,
            "acl.conf: no rule lets user 'alice' write 'r2d2/odom'",
        ),
        (ALICE, Action.RECEIVE, "$SYS/broker/uptime", True, "acl.conf:8: topic read $SYS/#"),
        (ALICE, Action.RECEIVE, "public/x", False, None),
        (ALICE, Action.PUBLISH, "two words/and more", True, None),
        (BOB, Action.PUBLISH, "notes", True, "acl.conf:12: topic notes"),
        (BOB, Action.RECEIVE, "notes", True, "acl.conf:12: topic notes"),
        (BOB, Action.PUBLISH, "clients/phone/state", True, None),
        (BOB, Action.PUBLISH, "clients/tablet/state", False, None),
        (BOB, Action.RECEIVE, "clients/phone/state", False, None),
        (BOB, Action.PUBLISH, "users/bob/x/y", True, "acl.conf:15: pattern users/%u/#"),
        (BOB, Action.PUBLISH, "users/alice/x", False, None),
        (BOB, Action.RECEIVE, "users/bob/locked", False, None),
        (NOBODY, Action.RECEIVE, "public/x", True, "acl.conf:2: topic read public/#"),
        (NOBODY, Action.RECEIVE, "users//x", False, None),
        (NOBODY, Action.RECEIVE, "users/%u/x", False, None),
        (NOBODY, Action.PUBLISH, "clients/stranger/state", True, None),
        (Identity("mallory", "m"), Action.RECEIVE, "public/x", False, None),
        (NOBODY, Action.PUBLISH, "public/x", False, None),
    ],
)
def test_decisions(
    tmp_path: Path,
    identity: Identity,
    action: Action,
    topic: str,
    allowed: bool,
    reason: str | None,
) -> None:
    decision = acl_of(tmp_path, EXAMPLE).decide(identity, action, topic)
    assert bool(decision) is allowed
    if reason is not None:
        assert decision.reason == reason


def test_the_reason_for_an_anonymous_client(tmp_path: Path) -> None:
    decision = acl_of(tmp_path, EXAMPLE).decide(NOBODY, Action.SUBSCRIBE, "x/#")
    assert decision.reason == "acl.conf: no rule lets an anonymous client subscribe to 'x/#'"


@pytest.mark.parametrize("action", Action)
def test_a_reason_shows_of_a_long_topic_the_beginning(tmp_path: Path, action: Action) -> None:
    topic = "y" + "\U000e0001" * 16_000
    acl = acl_of(tmp_path, EXAMPLE)
    reason = acl.decide(Identity("b" * 60_000, "c"), action, topic).reason
    assert len(reason) < 1_500 and "'y\\U000e0001" in reason and reason.endswith("…")
    assert repr(topic) in str(acl.explain(NOBODY, topic))


@pytest.mark.parametrize(
    ("rules", "topic", "allowed"),
    [
        ("topic #", "$SYS/x", False),
        ("topic +/x", "$SYS/x", False),
        ("topic $SYS/#", "$SYS/x", True),
        ("topic $SYS/+", "$SYS/x", True),
        ("topic $SYS/#", "SYS/x", False),
        ("topic #\ntopic deny +/x", "$SYS/x", False),
        ("topic $SYS/#\ntopic deny #", "$SYS/x", True),
        ("pattern %c/#", "$SYS/x", False),
        ("pattern $SYS/#", "$SYS/x", True),
    ],
)
def test_topics_that_begin_with_a_dollar_sign(
    tmp_path: Path, rules: str, topic: str, allowed: bool
) -> None:
    identity = Identity(None, "$SYS")
    assert bool(acl_of(tmp_path, rules).decide(identity, Action.RECEIVE, topic)) is allowed


@pytest.mark.parametrize("name", ["+", "#", "a+b", "a/b", "a#", "/"])
@pytest.mark.parametrize("letter", ["c", "u"])
def test_a_name_with_a_wildcard_or_slash_is_never_put_into_a_pattern(
    tmp_path: Path, name: str, letter: str
) -> None:
    identity = Identity("u", name) if letter == "c" else Identity(name, "c")
    acl = acl_of(tmp_path, f"pattern a/%{letter}\npattern b/#")
    for topic in ("a/x", f"a/{name}", "a/", f"a/%{letter}"):
        assert not acl.decide(identity, Action.PUBLISH, topic)
    # mosquitto lets no pattern give anything to a name with a wildcard, whether it is in it or not.
    is_served = "+" not in name and "#" not in name
    for filter in ("a/#", "a/+", "#"):
        allowed = bool(acl.decide(identity, Action.SUBSCRIBE, filter))
        assert allowed is (filter == "#" and is_served)
    for action in (Action.PUBLISH, Action.RECEIVE):
        assert bool(acl.decide(identity, action, "b/x")) is is_served
    if not is_served:
        assert "who has + or #" in str(acl.explain(identity, "b/x"))


def test_a_wildcard_in_an_id_leaves_others_their_rights(tmp_path: Path) -> None:
    """Decisions about receivers are kept by kind of id."""
    acl = acl_of(tmp_path, "pattern b/#\nuser u\ntopic own")
    for _ in range(2):
        for client_id, allowed in (("a/b", True), ("a+b", False), ("ab", True), ("a/+", False)):
            identity = Identity("u", client_id)
            assert bool(acl.decide(identity, Action.RECEIVE, "b/x")) is allowed
            assert acl.decide(identity, Action.RECEIVE, "own")


def test_a_pattern_that_denies_holds_for_names_that_cannot_be_put_in(tmp_path: Path) -> None:
    acl = acl_of(tmp_path, "pattern #\npattern deny +/%c\nuser u\ntopic own/#")
    identity = Identity("u", "a/b")
    decision = acl.decide(identity, Action.PUBLISH, "x/y")
    assert not decision
    assert decision.reason.startswith("acl.conf:2: pattern deny +/%c (a name that ")
    assert not acl.decide(identity, Action.SUBSCRIBE, "x/#")
    assert acl.decide(identity, Action.PUBLISH, "own/x")
    assert acl.decide(Identity("u", "ab"), Action.PUBLISH, "x/y")


@pytest.mark.parametrize(
    ("rules", "filter", "allowed"),
    [
        ("topic read a/#", "a/b", True),
        ("topic read a/#", "#", True),
        ("topic read a/#", "+", True),
        ("topic read a/#", "+/b/+", True),
        ("topic read a/#", "b/#", False),
        ("topic read a/#", "$SYS/#", False),
        ("topic read a/#", "$share/g/a/b", True),
        ("topic read a/#", "$share/g/b", False),
        ("topic write a/#", "a/b", False),
        ("topic read #\ntopic deny a/#", "a/b/#", False),
        ("topic read #\ntopic deny a/#", "a", False),
        ("topic read #\ntopic deny a/#", "+/b", True),
        ("topic read a/#\ntopic deny a/b/#", "+/b/#", False),
        ("topic read a/b\ntopic deny +/b", "#", False),
        ("topic read a/b\ntopic deny +/+", "#", False),
        ("topic read a/#\ntopic deny a\ntopic deny a/+\ntopic deny a/+/#", "#", False),
        ("topic read a/#\ntopic deny a\ntopic deny a/+/#", "a/#", False),
        ("topic read a/#\ntopic deny a\ntopic deny a/+", "a/#", True),
        ("topic read a/#\ntopic deny a\ntopic deny a/+", "+/+", False),
        ("topic read a/b\ntopic read c\ntopic deny a/#", "#", True),
        ("topic read #\ntopic deny #", "#", False),
        ("topic read #\ntopic deny +/#", "#", False),
        ("topic read /#\ntopic deny /#", "/#", False),
        # A client's own lines come before the patterns.
        ("topic read a\npattern deny a", "a", True),
        ("topic deny a\npattern read a", "a", False),
        ("pattern read %c/x", "me/+", True),
        ("pattern read %c/x", "you/+", False),
        ("pattern read +/x\npattern deny %c/x", "me/x", False),
        ("pattern read +/x\npattern deny %c/x", "+/x", True),
    ],
)
def test_a_subscription_is_refused_when_nothing_could_be_delivered(
    tmp_path: Path, rules: str, filter: str, allowed: bool
) -> None:
    acl = acl_of(tmp_path, rules)
    assert bool(acl.decide(Identity(None, "me"), Action.SUBSCRIBE, filter)) is allowed


def test_the_reason_of_a_refused_subscription_is_the_line_that_denies(tmp_path: Path) -> None:
    acl = acl_of(tmp_path, "topic read a/#\ntopic deny a/b/#")
    reason = acl.decide(NOBODY, Action.SUBSCRIBE, "+/b/#").reason
    assert reason == "acl.conf:2: topic deny a/b/#"


LEVELS = ["a", "b", ""]
TOPICS = ["/".join(t) for n in range(1, 5) for t in itertools.product([*LEVELS, "z"], repeat=n)]
TOPICS = [topic for topic in TOPICS if topic]


@st.composite
def filters(draw: st.DrawFn) -> str:
    levels = draw(st.lists(st.sampled_from([*LEVELS, "+", "+"]), min_size=0, max_size=3))
    if not levels or draw(st.booleans()):
        levels.append("#")
    return "/".join(levels) or "a"


def rules(pattern: bool) -> st.SearchStrategy[Rule]:
    deny, read, write = Permission.DENY, Permission.READ, Permission.WRITE
    permissions = st.sampled_from([deny, deny, deny, read, read, write])
    return st.builds(
        lambda permission, filter: Rule("f", 1, filter, permission, filter, None, pattern),
        permissions,
        filters(),
    )


@examples(150)
@given(st.lists(rules(False), max_size=5), st.lists(rules(True), max_size=4), filters())
def test_a_subscription_is_allowed_exactly_when_some_topic_could_be_delivered(
    own: list[Rule], patterns: list[Rule], filter: str
) -> None:
    acl = Acl("acl.conf", [*own, *patterns])
    # Rules have four levels at most and `z` is in none, so these topics stand for all topics;
    # five levels are wanted for filters with `#` that are denied up to four.
    topics = [*TOPICS, *(f"{topic}/z" for topic in TOPICS if topic.count("/") == 3)]
    wanted = [topic for topic in topics if matches(filter, topic)]
    possible = {
        action: any(acl.decide(NOBODY, action, topic) for topic in wanted)
        for action in (Action.RECEIVE, Action.PUBLISH)
    }
    assert bool(acl.decide(NOBODY, Action.SUBSCRIBE, filter)) is possible[Action.RECEIVE]
    assert {each: acl.allows_some(NOBODY, each, filter) for each in possible} == possible


NAMES = ["a", "b", "c", "$SYS", ""]
PERMISSIONS = [Permission.DENY, Permission.READ, Permission.WRITE, Permission.READWRITE]


LINES = st.lists(
    st.tuples(
        st.sampled_from(PERMISSIONS),
        st.lists(st.sampled_from([*NAMES, "+", "%c", "%u"]), min_size=1, max_size=4),
        st.booleans(),
        st.sampled_from(["own", "pattern"]),
    ),
    min_size=12,
    max_size=24,
)


def acl_with(lines: list[tuple[Permission, list[str], bool, str]]) -> Acl:
    return Acl(
        "acl.conf",
        [
            Rule("f", number, "", permission, name, None, kind == "pattern")
            for number, (permission, levels, open_ended, kind) in enumerate(lines)
            if (name := "/".join([*levels, "#"] if open_ended else levels))
        ],
    )


@examples(150)
@given(
    LINES,
    st.sampled_from([NOBODY, Identity(None, "a"), Identity(None, "a/b"), Identity(None, "$SYS")]),
    filters(),
)
def test_what_is_decided_quickly_is_what_all_rules_say(
    lines: list[tuple[Permission, list[str], bool, str]], identity: Identity, filter: str
) -> None:
    acl = acl_with(lines)
    for topic in (filter, filter.replace("+", "a").replace("#", "b"), "$SYS/a", "a/c/d/e/f"):
        for verdict in acl.explain(identity, topic).verdicts:
            decision = acl.decide(identity, verdict.action, topic)
            assert (decision.allowed, decision.reason) == (verdict.allowed, verdict.reason)


CLIENTS = [
    Identity(user, client_id)
    for user in (None, "a", "b", "a/b", "$SYS")
    for client_id in ("a", "b", "c", "n", "m", "a/b", "+", "#", "", "$SYS", "$n", "%u", "%c")
]


@examples(150)
@given(LINES, st.permutations(CLIENTS), filters())
def test_what_is_decided_about_many_clients_is_what_the_rules_say_about_each(
    lines: list[tuple[Permission, list[str], bool, str]], clients: list[Identity], filter: str
) -> None:
    """Whoever was asked about before, and whatever the topic then."""
    acl = acl_with(lines)
    for topic in (filter.replace("+", "a").replace("#", "b"), "$SYS/a", "$n", "a/b", "%u/%c"):
        for identity in clients:
            decision = acl.decide(identity, Action.RECEIVE, topic)
            verdict = acl.explain(identity, topic).verdicts[0]
            assert verdict.action is Action.RECEIVE
            assert (decision.allowed, decision.reason) == (verdict.allowed, verdict.reason)


@pytest.mark.parametrize("name", ["w{}", "w/{}"], ids=["fit", "unfit"])
def test_the_rules_are_looked_at_once_for_all_clients_of_a_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A message may be for thousands of them, see `Router`: only w7 is named by the topic."""
    acl = acl_of(tmp_path, "pattern read a/%c/#\npattern read a/%u/#\npattern read b")
    looks: list[Identity] = []
    applied = Acl._applied
    monkeypatch.setattr(
        Acl, "_applied", lambda acl, *about: (looks.append(about[0]), applied(acl, *about))[1]
    )
    may = [
        identity.client_id
        for identity in (Identity(user, name.format(n)) for n in range(50) for user in ("x", "y"))
        if acl.decide(identity, Action.RECEIVE, "a/w7/b")
    ]
    is_fit = name == "w{}"
    assert may == (["w7", "w7"] if is_fit else [])
    assert len(looks) == (4 if is_fit else 2)


def test_an_acl_is_quick_where_it_is_long(tmp_path: Path) -> None:
    lines = [f"topic deny denied/{i}/#\ntopic read {i}/+/x" for i in range(300)]
    acl = acl_of(tmp_path, "\n".join(lines))
    started = time.process_time()
    assert not acl.decide(NOBODY, Action.RECEIVE, "nothing/of/x/at/all")
    assert acl.decide(NOBODY, Action.SUBSCRIBE, "#")
    assert time.process_time() - started < 0.5  # It takes some 2 ms.


def wide_rules(count: int) -> str:
    return "\n".join([*(f"topic read r{i}/#" for i in range(count)), "topic deny +/secret/#"])


def test_a_decision_tells_what_it_takes(tmp_path: Path) -> None:
    """It grows with the rules that a wide filter has to be compared with, and only with these."""
    acl = acl_of(tmp_path, wide_rules(300))
    wide = acl.decide(NOBODY, Action.SUBSCRIBE, "+/secret/x")
    assert not wide and 300 <= wide.cost <= 4 * 300
    assert acl.decide(NOBODY, Action.SUBSCRIBE, "$share/g/+/secret/x").cost == wide.cost
    assert acl.decide(NOBODY, Action.SUBSCRIBE, "r7/a").cost <= 4
    assert acl.decide(NOBODY, Action.SUBSCRIBE, "#").cost < 100  # r0/# is enough; all are passed
    assert acl.decide(NOBODY, Action.PUBLISH, "r7/a").cost <= 4
    few = acl_of(tmp_path, wide_rules(3)).decide(NOBODY, Action.SUBSCRIBE, "+/secret/x")
    assert not few and few.cost < 10


def test_who_asks_again_is_not_charged_for_a_known_decision(tmp_path: Path) -> None:
    acl = acl_of(tmp_path, "\n".join(f"topic write {'+/' * i}#" for i in range(9)))
    topic = "/".join("x" * 9)
    costs = [acl.decide(NOBODY, Action.RECEIVE, topic).cost for _ in range(2)]
    assert costs[0] >= 9 and costs[1] == 0


@pytest.mark.parametrize(
    "lines",
    [
        [f"topic deny r{i}/#\ntopic read r{i}/#" for i in range(1000)],
        # Of all lengths up to the deepest rule's.
        [
            "topic deny +/#\ntopic deny " + "/".join("a" * 200),
            *(f"topic {i}/#" for i in range(1000)),
        ],
    ],
    ids=["pairs", "deep"],
)
def test_rules_that_deny_are_not_compared_with_each_that_allows(
    tmp_path: Path, lines: list[str]
) -> None:
    acl = acl_of(tmp_path, "\n".join(lines))
    started = time.process_time()
    decision = acl.decide(NOBODY, Action.SUBSCRIBE, "#")
    assert time.process_time() - started < 0.5  # It takes some 15 ms.
    assert not decision and "deny" in decision.reason
    assert decision.cost < 5 * 1000


def test_include(tmp_path: Path) -> None:
    (tmp_path / "conf.d").mkdir()
    write(tmp_path / "conf.d" / "bob.conf", "user bob\ntopic b\n")
    write(tmp_path / "conf.d" / "more.conf", "include bob.conf\ntopic read more\n")
    acl = acl_of(
        tmp_path,
        "user alice\ninclude conf.d/bob.conf\ninclude  conf.d/more.conf \ntopic a\n",
    )
    # The section of a user goes on behind an include, and a file's rules for its own users count
    # once.
    assert acl.decide(ALICE, Action.PUBLISH, "a").reason == "acl.conf:4: topic a"
    assert acl.decide(BOB, Action.PUBLISH, "b").reason == "conf.d/bob.conf:2: topic b"
    assert acl.decide(ALICE, Action.RECEIVE, "more").reason == "conf.d/more.conf:2: topic read more"
    assert not acl.decide(NOBODY, Action.RECEIVE, "more")
    assert not acl.decide(BOB, Action.PUBLISH, "a")
    assert len(acl.rules) == 3


def test_a_file_of_rules_is_a_group(tmp_path: Path) -> None:
    write(
        tmp_path / "drivers.conf",
        "# who drives\ninclude watchers.conf\ntopic write {robot}/cmd_vel\n"
        "pattern read {robot}/%u/inbox\n\nuser chief\ntopic {robot}/#\n",
    )
    write(tmp_path / "watchers.conf", "topic read {robot}/odom\ntopic deny {robot}/odom/raw\n")
    acl = acl_of(
        tmp_path,
        "include watchers.conf\n\nuser alice\ninclude drivers.conf\n\n"
        "user bob\ninclude drivers.conf\ntopic read extra\n",
    )
    for identity in (ALICE, BOB):
        assert acl.decide(identity, Action.PUBLISH, "r2d2/cmd_vel")
        assert acl.decide(identity, Action.RECEIVE, "r2d2/odom")
    assert not acl.decide(NOBODY, Action.PUBLISH, "r2d2/cmd_vel")
    assert acl.decide(NOBODY, Action.RECEIVE, "r2d2/odom")  # included before the first user
    assert acl.decide(Identity("chief", "c"), Action.PUBLISH, "r2d2/anything")
    assert not acl.decide(ALICE, Action.PUBLISH, "r2d2/anything")
    assert acl.decide(BOB, Action.RECEIVE, "extra") and not acl.decide(
        ALICE, Action.RECEIVE, "extra"
    )
    # 2 rules of the watchers for three, 1 of the drivers for two, a pattern, the chief's, and one.
    assert len(acl.rules) == 6 + 2 + 1 + 1 + 1
    said = str(acl.explain(BOB, "r2d2/odom")).splitlines()
    at = said.index("  read       allowed  watchers.conf:1: topic read r2d2/odom")
    assert said[at + 1] == "             included by  acl.conf:7, then drivers.conf:2"


def test_what_is_wrong_in_a_group_is_told_once(tmp_path: Path) -> None:
    write(tmp_path / "group.conf", "topic raed x\ninclude absent.conf\n")
    with pytest.raises(AccessFileError) as caught:
        acl_of(tmp_path, "".join(f"user u{n}\ninclude group.conf\n" for n in range(5)))
    assert [(p.file.name, p.line, p.column) for p in caught.value.problems] == [
        ("group.conf", 1, 7),
        ("group.conf", 2, 9),
    ]


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(AccessFileError, match=r"pipe: is no file, but a pipe"):
        Acl.load(tmp_path / "pipe", "r2d2")
    with pytest.raises(AccessFileError, match=r"pipe: is no file, but a pipe"):
        Passwords.load(tmp_path / "pipe")


def test_files_that_are_too_large_too_many_and_too_deep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (tmp_path / "huge.conf").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(AccessFileError, match=r"huge\.conf: larger than 4 MiB"):
        acl_of(tmp_path, "include huge.conf\n")
    monkeypatch.setattr(rules_module, "_MAX_RULES", 1000)
    write(tmp_path / "group.conf", "topic read x\n" * 100)
    users = "".join(f"user u{n}\ninclude group.conf\n" for n in range(50))
    with pytest.raises(AccessFileError, match=r"group\.conf:1:1: more than") as caught:
        acl_of(tmp_path, users)
    assert len(caught.value.problems) == 1
    for number in range(30):
        write(tmp_path / f"{number}.conf", f"include {number + 1}.conf\n")
    with pytest.raises(AccessFileError, match=r"16\.conf:1:9: files include each other too deep"):
        acl_of(tmp_path, "include 1.conf\n")


def test_includes_that_multiply_are_read_once(tmp_path: Path) -> None:
    """Each file includes the next one twice: two to the fifteenth ways to the last."""
    for number in range(15):
        write(tmp_path / f"{number}.conf", f"include {number + 1}.conf\n" * 2)
    write(tmp_path / "15.conf", "topic read x\n")
    started = time.process_time()
    assert len(acl_of(tmp_path, "user alice\ninclude 1.conf\n").rules) == 1
    assert time.process_time() - started < 1


def test_a_file_that_includes_itself_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "b.conf", "\n include acl.conf")
    with pytest.raises(AccessFileError) as caught:
        acl_of(tmp_path, "include b.conf")
    assert str(caught.value) == (
        f"{tmp_path}/b.conf:2:10: a file must not include itself: acl.conf → b.conf → acl.conf"
    )


def test_all_that_is_wrong_with_an_acl_is_told_at_once(tmp_path: Path) -> None:
    write(tmp_path / "more.conf", "topic read a/#/b\n")
    text = (
        "topci read x\n"
        "topic raed x\n"
        "topic\n"
        "topic read a+/x\n"
        "  # not a comment\n"
        "include more.conf\n"
        "user\n"
        "pattern write a/%uz/b\n"
        "include no.conf\n"
        "topic two words\n"
        "topic\tread x\n"
        "allow x\n"
        "topic {robot}/# \n"
    )
    with pytest.raises(AccessFileError) as caught:
        acl_of(tmp_path, text)
    assert [str(p).removeprefix(f"{tmp_path}/") for p in caught.value.problems] == [
        "acl.conf:1:1: unknown keyword 'topci'; did you mean 'topic'?",
        "acl.conf:2:7: unknown access 'raed'; did you mean 'read'?",
        "acl.conf:3:6: a filter is missing after 'topic'",
        "acl.conf:4:12: 'a+/x': + must be a whole level",
        "acl.conf:5:3: a comment begins in the first column",
        "more.conf:1:12: 'a/#/b': # must be a whole level, and the last one",
        "acl.conf:7:5: a user name is missing after 'user'",
        "acl.conf:8:17: %c and %u must be alone in their level, not '%uz'",
        f"acl.conf:9:9: there is no file {tmp_path}/no.conf to include",
        "acl.conf:10:7: unknown access 'two'; known are read, write, readwrite, deny; "
        "a filter with a space in it needs the access before it",
        "acl.conf:11:6: a tab; put spaces between the words",
        "acl.conf:12:1: unknown keyword 'allow'; known are topic, pattern, user, include",
    ]


def test_line_ends_and_white_space_are_mosquittos(tmp_path: Path) -> None:
    path = tmp_path / "acl.conf"
    path.write_bytes(
        (
            "\ufeffuser  alice smith \r\n\r\n"
            "  topic   read   a b/c \t\r\n"
            "topic read d\u2028user eve"
        ).encode()
    )
    acl = Acl.load(path, "r2d2")
    alice = Identity("alice smith", "c")
    assert acl.decide(alice, Action.RECEIVE, "a b/c")
    assert acl.decide(alice, Action.RECEIVE, "d\u2028user eve")
    assert {rule.user for rule in acl.rules} == {"alice smith"}


def test_a_robot_with_wildcards_cannot_widen_the_rules(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must not hold"):
        acl_of(tmp_path, "topic {robot}/x", robot="+")


def test_explain(tmp_path: Path) -> None:
    acl = acl_of(tmp_path, EXAMPLE)
    assert str(acl.explain(ALICE, "r2d2/cmd_vel")).splitlines() == [
        "user 'alice', 'r2d2/cmd_vel':",
        "  read       allowed  acl.conf:5: topic read r2d2/#",
        "             passed over  acl.conf:6: topic deny r2d2/secret/#  (does not match)",
        "  write      allowed  acl.conf:7: topic write r2d2/cmd_vel",
        "             passed over  acl.conf:6: topic deny r2d2/secret/#  (does not match)",
        "             passed over  acl.conf:5: topic read r2d2/#  (gives read only)",
        "  subscribe  allowed  acl.conf:5: topic read r2d2/#",
    ]
    [subscribe] = acl.explain(ALICE, "r2d2/secret/#").verdicts
    assert not subscribe.allowed
    assert subscribe.rule is not None
    assert (subscribe.rule.file, subscribe.rule.line) == ("acl.conf", 6)
    assert {rule.line: why for rule, why in subscribe.passed_over}[5] == (
        "all that it gives there is denied by acl.conf:6: topic deny r2d2/secret/#"
    )
    patterns = acl_of(tmp_path, "pattern read a/%c/#\n")
    for topic, named in (
        ("r2d2/odom", False),
        ("a/tablet/x", True),
        ("a/+/x", True),
        ("b/#", False),
    ):
        for verdict in patterns.explain(Identity("alice", ""), topic).verdicts:
            told = [why for _, why in verdict.passed_over if "gives" not in why]
            assert verdict.action is Action.PUBLISH or ["cannot be put in" in told[0]] == [named]
    read, write, subscribe = acl.explain(NOBODY, "x").verdicts
    assert (read.rule, write.rule, subscribe.rule) == (None, None, None)
    with pytest.raises(ValueError, match="whole level"):
        acl.explain(ALICE, "a+")


# mosquitto is the oracle of what an ACL file means


def random_acl(random: random.Random, users: list[str]) -> str:
    def filter() -> str:
        levels = [random.choice(["a", "b", "+", "+"]) for _ in range(random.randint(1, 3))]
        if random.random() < 0.3:
            levels[-1] = "#"
        if random.random() < 0.1:
            levels[0] = "$dev"
        return "/".join(levels)

    def access() -> str:
        return random.choice(["", "", "read ", "write ", "readwrite ", "deny "])

    lines: list[str] = []
    for user in ["", *users]:
        lines += [f"user {user}"] if user else []
        lines += [f"topic {access()}{filter()}" for _ in range(random.randint(0, 5))]
        if random.random() < 0.2:
            letter = random.choice("cu")
            lines.append(f"pattern {access()}{random.choice(['+/', ''])}%{letter}/{filter()}")
    lines += ["pattern deny b/b", "pattern read b/+", "user admin", "topic #", "topic $dev/#"]
    return "\n".join(lines) + "\n"


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[int]:
    program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    if not Path(program).exists():
        pytest.skip("mosquitto is not installed")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    configuration = tmp_path / "mosquitto.conf"
    configuration.write_text(
        f"listener {port} 127.0.0.1\nallow_anonymous true\nacl_file {tmp_path}/acl.conf\n"
        "user root\n"
    )
    process = subprocess.Popen(
        [program, "-c", str(configuration)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        deadline = time.monotonic() + 10
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), timeout=1).close()
                break
            except ConnectionRefusedError:
                assert process.poll() is None and time.monotonic() < deadline
                time.sleep(0.02)
        yield port
    finally:
        process.terminate()
        process.wait(10)


class Client:
    """A client that publishes every topic, and receives what it may."""

    def __init__(self, port: int, username: str | None, client_id: str) -> None:
        self.identity = Identity(username, client_id)
        self.refused: dict[int, bool] = {}
        self.received: set[str] = set()
        self.subscribed, self.answered = threading.Event(), threading.Event()
        self.expected = 0
        self.paho = paho.Client(
            paho.CallbackAPIVersion.VERSION2, client_id, protocol=paho.MQTTProtocolVersion.MQTTv5
        )
        if username is not None:
            self.paho.username_pw_set(username, "x")
        self.paho.max_inflight_messages_set(0)
        self.paho.on_subscribe = lambda *_: self.subscribed.set()
        self.paho.on_publish = self._on_publish
        self.paho.on_message = self._on_message
        self.paho.connect("127.0.0.1", port)
        self.paho.loop_start()

    def _on_publish(self, client, userdata, mid, reason_code, properties) -> None:
        self.refused[mid] = reason_code.is_failure
        if len(self.refused) == self.expected:
            self.answered.set()

    def _on_message(self, client, userdata, message) -> None:
        self.received.add(message.topic)

    def subscribe(self) -> None:
        """Subscribes to everything; what was published before has been received afterwards."""
        self.subscribed.clear()
        self.paho.subscribe([("#", 0), ("$dev/#", 0)])
        assert self.subscribed.wait(10)

    def close(self) -> None:
        self.paho.disconnect()
        self.paho.loop_stop()


@pytest.mark.parametrize("seed", [1, 2])
def test_decisions_are_those_of_the_real_mosquitto(
    tmp_path: Path, seed: int, request: pytest.FixtureRequest
) -> None:
    users = [f"u{i}" for i in range(8)] + ["a"]
    write(tmp_path / "acl.conf", random_acl(random.Random(seed), users)).chmod(0o644)
    acl = Acl.load(tmp_path / "acl.conf", "r2d2")
    port = request.getfixturevalue("mosquitto")
    names = ["a", "b", "u1", "c2"]
    topics = ["/".join(t) for n in (1, 2, 3) for t in itertools.product(names, repeat=n)]
    topics = [*random.Random(seed).sample(topics, 50), "$dev/a", "$dev/a/b", "$dev"]
    clients: list[Client] = []
    try:
        for number, user in enumerate([*users, None]):
            clients.append(Client(port, user, "b" if user is None else f"c{number}"))
        admin = Client(port, "admin", "admin")
        clients.append(admin)
        for client in clients[:-1]:
            client.subscribe()
        admin.expected = len(topics)
        for topic in topics:
            admin.paho.publish(topic, b"", qos=1)
        assert admin.answered.wait(10)
        checked = set()
        for client in clients[:-1]:
            client.subscribe()
            for topic in topics:
                decision = acl.decide(client.identity, Action.RECEIVE, topic)
                assert bool(decision) is (topic in client.received), (client.identity, topic)
                checked.add((bool(decision), decision.reason.partition(" ")[2][:7]))
        for client in clients[:-1]:
            client.expected = len(topics)
            mids = {topic: client.paho.publish(topic, b"", qos=1).mid for topic in topics}
            assert client.answered.wait(10)
            for topic, mid in mids.items():
                decision = acl.decide(client.identity, Action.PUBLISH, topic)
                assert bool(decision) is not client.refused[mid], (client.identity, topic)
        assert len(checked) >= 4  # Topics and patterns that allow and that deny were among them.
    finally:
        for client in clients:
            client.close()


# FileAccess


async def test_logins(access: FileAccess) -> None:
    assert await access.authenticate("alice", b"geheim", "c", "::1") == Identity("alice", "c")
    for username, password, reason in [
        ("alice", b"wrong", "wrong password for user 'alice'"),
        ("eve", b"geheim", "unknown user 'eve'"),
        ("e\nve", b"geheim", "unknown user 'e\\nve'"),
        ("", b"", "unknown user ''"),
        ("alice", None, "no password for user 'alice'"),
        (None, None, "no user name, and anonymous is off"),
        (None, b"geheim", "no user name, and anonymous is off"),
    ]:
        refusal = await access.authenticate(username, password, "c", "::1")
        assert refusal == Refusal(ReasonCode.NOT_AUTHORIZED, reason)


async def test_anonymous_clients_only_when_asked_for(files: tuple[Path, Path]) -> None:
    access = FileAccess(*files, "r2d2", anonymous=True)
    assert await access.authenticate(None, None, "c", "::1") == Identity(None, "c")
    assert isinstance(await access.authenticate("alice", b"wrong", "c", "::1"), Refusal)
    access.close()


async def test_a_login_that_was_right_is_not_hashed_again(
    access: FileAccess, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = count_checks(monkeypatch)
    for _ in range(3):
        assert isinstance(await access.authenticate("alice", b"geheim", "c", "::1"), Identity)
    assert len(checks) == 1
    for wrong in (b"wrong", b"worse"):
        assert isinstance(await access.authenticate("alice", wrong, "c", "::1"), Refusal)
    assert len(checks) == 3


async def test_clients_that_come_at_once_with_one_password_share_a_hash(
    access: FileAccess, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = count_checks(monkeypatch)
    logins = [access.authenticate("alice", b"geheim", f"c{i}", "::1") for i in range(500)]
    answers = await asyncio.gather(*logins)
    assert answers == [Identity("alice", f"c{i}") for i in range(500)]
    assert len(checks) == 1


async def test_one_that_leaves_does_not_cancel_the_check_for_others(access: FileAccess) -> None:
    leaves = asyncio.ensure_future(access.authenticate("alice", b"geheim", "1", "::1"))
    stays = asyncio.ensure_future(access.authenticate("alice", b"geheim", "2", "::1"))
    await asyncio.sleep(0)
    leaves.cancel()
    assert await stays == Identity("alice", "2")
    assert leaves.cancelled()


async def test_too_many_that_wait_are_refused(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    access = FileAccess(*files, "r2d2", max_waiting=3)
    assert await access.authenticate("alice", b"geheim", "c", "::1") == Identity("alice", "c")
    go = threading.Event()

    def check(stored: str, password: bytes) -> bool:
        return go.wait(10) and check_password(stored, password)

    monkeypatch.setattr(passwords_module, "check_password", check)
    attack = [
        asyncio.ensure_future(access.authenticate("alice", b"%d" % i, "c", "::1"))
        for i in range(20)
    ]
    await asyncio.sleep(0)
    busy = ReasonCode.SERVER_BUSY
    answer = await access.authenticate("bob", b"x", "c", "::1")
    assert isinstance(answer, Refusal) and answer.code == busy
    # Those who were here before come in all the same.
    assert await access.authenticate("alice", b"geheim", "c", "::1") == Identity("alice", "c")
    go.set()
    codes = [answer.code for answer in await asyncio.gather(*attack)]  # type: ignore[union-attr]
    in_turn = access._hashing._workers + 3
    assert codes.count(busy) == 20 - in_turn
    assert codes.count(ReasonCode.NOT_AUTHORIZED) == in_turn
    assert isinstance(await access.authenticate("bob", b"x", "c", "::1"), Refusal)
    assert access._hashing.idle and not access._checking
    access.close()


async def test_the_loop_goes_on_while_passwords_are_hashed(access: FileAccess) -> None:
    login = asyncio.ensure_future(access.authenticate("alice", b"wrong", "c", "::1"))
    turns = 0
    while not login.done():
        await asyncio.sleep(0)
        turns += 1
    assert turns > 5


async def test_one_password_of_each_user_is_remembered_and_not_as_it_is(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"user{number}" for number in range(200)]
    stored = files[0].read_text().partition(":")[2].strip()
    write(files[0], "".join(f"{name}:{stored}\n" for name in names))
    access = FileAccess(*files, "r2d2")
    monkeypatch.setattr(passwords_module, "check_password", lambda stored, password: True)
    for password in (b"before", b"geheim"):
        for name in names:
            await access.authenticate(name, password, "c", "::1")
    assert sorted(access._verified) == sorted(names)
    assert "geheim" not in repr(access._verified)
    monkeypatch.setattr(passwords_module, "check_password", lambda stored, password: False)
    for number, name in enumerate(names):
        # Not one of them was forgotten, and none is let in with the one before.
        address = f"10.0.0.{number}:1"
        assert isinstance(await access.authenticate(name, b"geheim", "c", address), Identity)
        assert isinstance(await access.authenticate(name, b"before", "c", address), Refusal)
    write(files[0], f"user7:{stored}\n")
    access.reload()
    assert list(access._verified) == ["user7"]
    access.close()


async def test_a_new_password_counts_from_the_reload_on(
    access: FileAccess, files: tuple[Path, Path]
) -> None:
    assert isinstance(await access.authenticate("alice", b"geheim", "c", "::1"), Identity)
    passwords = Passwords.load(files[0])
    passwords.set("alice", "new")
    passwords.save()
    epoch = access.epoch
    access.reload()
    assert access.epoch == epoch + 1
    assert isinstance(await access.authenticate("alice", b"geheim", "c", "::1"), Refusal)
    assert isinstance(await access.authenticate("alice", b"new", "c", "::1"), Identity)


async def test_a_user_removed_while_its_password_is_checked_stays_out(
    access: FileAccess, files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()

    def check(stored: str, password: bytes) -> bool:
        return go.wait(10) and check_password(stored, password)

    monkeypatch.setattr(passwords_module, "check_password", check)
    login = asyncio.ensure_future(access.authenticate("alice", b"geheim", "c", "::1"))
    await asyncio.sleep(0)
    write(files[0], "")
    access.reload()
    go.set()
    assert await login == Refusal(ReasonCode.NOT_AUTHORIZED, "unknown user 'alice'")


async def test_a_rehash_at_login_is_remembered(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    write(files[0], f"alice:{PBKDF2}\n")
    access = FileAccess(*files, "r2d2")
    checks = count_checks(monkeypatch)
    assert isinstance(await access.authenticate("alice", b"geheim", "c", "::1"), Identity)
    assert files[0].read_text().startswith("alice:$argon2id$")
    access.reload()
    assert isinstance(await access.authenticate("alice", b"geheim", "c", "::1"), Identity)
    assert len(checks) == 1
    access.close()


def test_a_reload_is_all_or_nothing(access: FileAccess, files: tuple[Path, Path]) -> None:
    users, acl = files
    write(acl, "user alice\ntopic read b/#\n")
    write(users, "alice:plain\n")
    with pytest.raises(AccessFileError):
        access.reload()
    assert access.epoch == 0
    assert access.decide(ALICE, Action.RECEIVE, "a/x")
    assert not access.decide(ALICE, Action.RECEIVE, "b/x")
    write(acl, "nonsense")
    with pytest.raises(AccessFileError) as caught:
        access.reload()
    assert [problem.file for problem in caught.value.problems] == [users, acl]
    assert access.users() == ["alice"]


def test_without_an_acl_everything_is_allowed_and_told(
    files: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    access = FileAccess(files[0], None, "r2d2")
    assert access.decide(ALICE, Action.PUBLISH, "x")
    access.reload()
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    access.close()


async def test_closing_refuses_those_who_wait(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    access = FileAccess(*files, "r2d2")
    begun, never = threading.Event(), threading.Event()

    def check(stored: str, password: bytes) -> bool:
        begun.set()
        never.wait(0.05)
        return check_password(stored, password)

    monkeypatch.setattr(passwords_module, "check_password", check)
    logins = [
        asyncio.ensure_future(access.authenticate("alice", b"%d" % i, "c", "::1"))
        for i in range(10)
    ]
    assert await asyncio.to_thread(begun.wait, 5)  # the first is with its thread
    access.close()
    access.close()
    codes = {answer.code for answer in await asyncio.gather(*logins)}  # type: ignore[union-attr]
    assert codes == {ReasonCode.NOT_AUTHORIZED, ReasonCode.SERVER_SHUTTING_DOWN}
    answer = await access.authenticate("alice", b"geheim", "c", "::1")
    assert isinstance(answer, Refusal) and answer.code == ReasonCode.SERVER_SHUTTING_DOWN
