"""The login throttle: guesses are delayed, and never lock out who has the right password."""

from __future__ import annotations

import asyncio
import math
import os
import threading
import time
from itertools import pairwise
from pathlib import Path
from statistics import median

import pytest
from waiting import PATIENCE, until

from appliance.access import FileAccess, Passwords
from appliance.access import hashing as hashing_module
from appliance.access import passwords as passwords_module
from appliance.access import throttle as throttle_module
from appliance.access.hashing import HashingPool
from appliance.access.throttle import LoginThrottle, RecentKeys
from appliance.broker.values import Accepted, Identity, Refusal
from appliance.mqtt.reason import ReasonCode

from .conftest import count_checks
from .test_scram import ScramClient

ALICE_C = Identity("alice", "c")


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_an_address_that_guesses_is_slowed_more_and_more_and_forgiven() -> None:
    clock = Clock()
    throttle = LoginThrottle(6, clock)
    waits = []
    for _ in range(16):
        wait = throttle.reserve("10.0.0.1:1")
        assert wait is not None
        waits.append(wait)
        clock.now += wait
        throttle.record_failure("10.0.0.1:2", "alice")
    assert waits[:7] == [0.0] * 7
    assert all(0 < first < second for first, second in pairwise(waits[8:12]))
    assert max(waits) <= throttle_module.LONGEST_DELAY
    assert throttle.reserve("10.0.0.1:3", max_wait=0.0) is None
    assert throttle.reserve("10.0.0.1:3", "another line", max_wait=0.0) == 0.0
    assert throttle.reserve("10.0.0.2:1", max_wait=0.0) == 0.0
    clock.now += 200
    assert [throttle.reserve("10.0.0.1:3") for _ in range(3)] == [0.0] * 3
    assert throttle.user_delay("alice") == 0.0


def test_a_user_that_many_guess_at_is_held_up_for_a_bounded_time() -> None:
    throttle = LoginThrottle(6, Clock())
    for number in range(100):
        throttle.record_failure(f"10.0.0.{number}", "alice")
    assert throttle.user_delay("alice") == throttle_module.MAX_USER_DELAY
    # Beside each other: the second does not wait for the first.
    assert throttle.user_delay("alice") == throttle_module.MAX_USER_DELAY
    assert throttle.user_delay("bob") == 0.0
    assert throttle.reserve("10.0.0.200", max_wait=0.0) == 0.0


def test_what_is_remembered_of_guessers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(throttle_module, "MAX_ENTRIES", 100)
    throttle = LoginThrottle(6, Clock())
    for number in range(1000):
        throttle.record_failure(f"10.0.{number // 250}.{number % 250}", "x" * 60_000 + str(number))
    assert len(throttle._networks) == len(throttle._users) == 100
    assert sum(map(len, throttle._users)) == 100 * 16
    recent = RecentKeys(10)
    for number in range(100):
        recent.add(b"%d" % number)
    assert b"99" in recent and b"90" in recent and b"89" not in recent


def guessing(access: FileAccess, address: str, username: str = "alice") -> None:
    """Make as if so many guesses had failed that the next ones wait for minutes."""
    for _ in range(60):
        access.throttle.record_failure(address, username)
    for line in ("", "SCRAM-SHA-256"):
        while access.throttle.reserve(address, line, max_wait=60.0) is not None:
            pass


def code_of(answer: Identity | Refusal) -> ReasonCode:
    return answer.code if isinstance(answer, Refusal) else ReasonCode.SUCCESS


@pytest.mark.timed
async def test_guesses_do_not_keep_out_who_was_here_before_nor_another_address(
    access: FileAccess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(throttle_module, "MAX_USER_DELAY", 0.1)
    guessing(access, "10.0.0.1:1")
    checks = count_checks(monkeypatch)
    # Nothing is hashed for who guesses on, and it learns nothing about users.
    for username in ("alice", "eve"):
        answer = await access.authenticate(username, b"guess", "c", "10.0.0.1:2")
        assert code_of(answer) == ReasonCode.SERVER_BUSY
    assert not checks
    # alice was never here, and comes in from elsewhere, after the time that she can be held up.
    began = time.monotonic()
    assert await access.authenticate("alice", b"geheim", "c", "10.0.0.2:1") == ALICE_C
    assert 0.1 <= time.monotonic() - began < 1
    # And now even from where it is guessed, at once.
    began = time.monotonic()
    assert await access.authenticate("alice", b"geheim", "c", "10.0.0.1:3") == ALICE_C
    assert time.monotonic() - began < 0.1
    assert len(checks) == 1


async def test_who_comes_again_does_not_wait_behind_those_who_guess(
    access: FileAccess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(throttle_module, "MAX_USER_DELAY", 0.0)
    guessing(access, "10.0.0.1:1", "eve")
    right = "alice", b"geheim", "c", "10.0.0.1:1"
    assert code_of(await access.authenticate(*right)) == ReasonCode.SERVER_BUSY
    for number in range(2000):  # two seconds of a flood
        guess = b"%d" % number
        answer = await access.authenticate("alice", guess, "c", "10.0.0.1:1")
        assert code_of(answer) == ReasonCode.SERVER_BUSY
    assert await access.authenticate(*right) == ALICE_C


async def test_a_device_with_a_wrong_password_costs_one_hash_and_slows_nobody(
    access: FileAccess, monkeypatch: pytest.MonkeyPatch
) -> None:
    checks = count_checks(monkeypatch)
    wrong = "alice", b"old password", "c", "10.0.0.1:1"
    for _ in range(100):
        assert code_of(await access.authenticate(*wrong)) == ReasonCode.NOT_AUTHORIZED
    assert len(checks) == 1
    assert access.throttle.address_delay("10.0.0.1") == access.throttle.user_delay("alice") == 0.0


async def test_a_password_that_was_wrong_may_be_right_after_a_reload(
    access: FileAccess, files: tuple[Path, Path]
) -> None:
    new = "alice", b"new", "c", "::1"
    assert code_of(await access.authenticate(*new)) == ReasonCode.NOT_AUTHORIZED
    passwords = Passwords.load(files[0])
    passwords.set("alice", "new")
    passwords.save()
    access.reload()
    assert await access.authenticate(*new) == ALICE_C


async def test_a_proof_is_a_guess_too(files: tuple[Path, Path]) -> None:
    passwords = Passwords.load(files[0])
    passwords.set("sally", "geheim", for_scram=True)
    passwords.save()
    access = FileAccess(*files, "r2d2", failed_logins=5)
    access.throttle = LoginThrottle(5, Clock())  # however long the passwords take

    def log_in(
        password: str, address: str, user: str = "sally", again: str | None = None
    ) -> ReasonCode | None:
        exchange = access.exchange("SCRAM-SHA-256", address, again)
        assert exchange is not None
        client = ScramClient(user, password)
        outcome = exchange.step(client.first())
        if isinstance(outcome, bytes):
            outcome = exchange.step(client.final(outcome))
        assert isinstance(outcome, Accepted | Refusal)
        return outcome.code if isinstance(outcome, Refusal) else None

    codes = [log_in("wrong", "10.0.0.1:1", user) for user in ["sally", "eve"] * 5]
    assert codes[:5] == [ReasonCode.NOT_AUTHORIZED] * 5
    assert codes[-2:] == [ReasonCode.SERVER_BUSY] * 2  # for who is a user and who is not
    assert log_in("geheim", "10.0.0.1:1") == ReasonCode.SERVER_BUSY
    assert log_in("geheim", "10.0.0.2:1") is None
    assert log_in("geheim", "10.0.0.1:1", again="sally") is None  # she is there already
    access.close()


async def test_each_address_has_its_turn_and_its_place(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    access = FileAccess(*files, "r2d2", max_waiting=20)
    go = threading.Event()

    def check(stored: str, password: bytes) -> bool:
        go.wait(PATIENCE)
        return password == b"geheim"

    monkeypatch.setattr(passwords_module, "check_password", check)
    ended: list[str] = []

    async def log_in(password: bytes, address: str) -> ReasonCode:
        answer = code_of(await access.authenticate("alice", password, "c", address))
        ended.append(address)
        return answer

    flood = [asyncio.ensure_future(log_in(b"%d" % n, "10.0.0.1")) for n in range(25)]
    turned_away = 25 - 20 - access._hashing._workers
    await until(lambda: len(ended) == turned_away, "those without a place")
    owner = asyncio.ensure_future(log_in(b"geheim", "10.0.0.2"))
    turned_away += 1
    await until(lambda: len(ended) == turned_away, "the one who makes room")
    go.set()
    assert await owner == ReasonCode.SUCCESS
    # One of the flood gave up its place, and no more than those with a thread came before.
    assert ended.index("10.0.0.2") <= turned_away + access._hashing._workers + 1
    codes = await asyncio.gather(*flood)
    assert codes.count(ReasonCode.SERVER_BUSY) == turned_away
    access.close()


@pytest.mark.timed
async def test_a_stranger_cannot_tell_by_the_time_who_is_a_user(access: FileAccess) -> None:
    """A wrong password takes as long for a user as for nobody, also when it comes again."""

    async def seconds(username: str, password: bytes, address: str) -> float:
        began = time.perf_counter()
        assert isinstance(await access.authenticate(username, password, "c", address), Refusal)
        return time.perf_counter() - began

    access._hashing._prompt_from = math.inf  # whoever asks: that is by the time since the last
    first: dict[str, list[float]] = {"alice": [], "nobody": []}
    for number in range(12):
        for username, times in first.items():
            times.append(await seconds(username, b"%d" % number, f"10.0.0.{number}"))
    known, unknown = (median(times) for times in first.values())
    assert 0.5 < known / unknown < 2


def _priority() -> int:
    return os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


async def test_many_passwords_are_hashed_behind_everything_else() -> None:
    pool: HashingPool[int] = HashingPool(2, 100)
    normal = os.getpriority(os.PRIO_PROCESS, os.getpid())
    low = min(19, normal + hashing_module.NICE)
    found = await asyncio.gather(*(pool.run(b"%d" % number, _priority) for number in range(20)))
    assert sorted(found) == [normal] + [low] * 19  # the first came alone
    pool.close()


async def test_now_and_then_one_that_comes_alone_is_hashed_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where other programs keep the processor busy, a sign-in would take a minute otherwise."""
    pool: HashingPool[tuple[bool, int]] = HashingPool(2, 100)
    loop, clock = asyncio.get_running_loop(), Clock()
    monkeypatch.setattr(loop, "time", clock)
    normal = os.getpriority(os.PRIO_PROCESS, os.getpid())
    low = min(19, normal + hashing_module.NICE)

    def check() -> tuple[bool, int]:
        clock.now += 0.5
        return threading.current_thread().name.startswith("prompt"), _priority()

    assert await pool.run(b"", check) == (True, normal)
    # One that comes by one now takes 5 % of the time at most from the others.
    found = [await pool.run(b"", check) for _ in range(30)]
    assert found == [(False, low)] * 19 + [(True, normal)] + [(False, low)] * 10
    pool.close()
