"""Codes of enrolments: each is used once, in time, and they are few."""

from __future__ import annotations

from appliance.access.enrolments import LIFETIME, MOST, MOST_OF_MAKER, Enrolments
from appliance.broker.values import Identity

ADMIN = Identity("admin", "a")


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_a_code_is_used_once_and_in_time():
    clock = Clock()
    enrolments = Enrolments({}.get, clock)
    code = enrolments.begin("bob", ("viewers",), ADMIN)
    assert code is not None and len(code) == 32  # 192 bits
    assert code.encode() not in b"".join(enrolments._pending)
    for wrong in ("", code[:-1], code.upper(), code + "=", "\u202e"):
        assert enrolments.take(wrong) is None
    found = enrolments.take(code)
    assert found is not None
    assert (found.username, found.groups, found.by) == ("bob", ("viewers",), ADMIN)
    assert enrolments.take(code) is None
    enrolments.put_back(code, found)
    clock.now += LIFETIME - 1
    assert enrolments.take(code) == found
    enrolments.put_back(code, found)
    clock.now += 1
    assert enrolments.take(code) is None


def test_codes_are_bounded():
    clock = Clock()
    enrolments = Enrolments({}.get, clock)
    first = enrolments.begin("0", None, None)
    assert first is not None
    assert enrolments.begin("0", None, None) not in (None, first)
    assert enrolments.take(first) is None  # the later one took its place
    assert all(enrolments.begin(str(number), None, None) for number in range(1, MOST))
    assert enrolments.begin("one more", None, None) is None
    assert enrolments.begin("0", None, None) is not None
    clock.now += LIFETIME
    assert enrolments.begin("one more", None, None) is not None
    assert len(enrolments._pending) == 1


def test_nobody_takes_all_the_places():
    enrolments = Enrolments({}.get, Clock())
    begun = [enrolments.begin(str(number), None, ADMIN) for number in range(MOST_OF_MAKER + 1)]
    assert all(begun[:-1]) and begun[-1] is None
    assert enrolments.begin("0", None, ADMIN)  # in the place of the earlier one
    assert enrolments.begin("more", None, Identity("helper", "a"))
    assert enrolments.begin("and more", None, None)
    here = enrolments.begin("hers", None, None)
    assert enrolments.begin("hers", None, ADMIN) is None
    assert here and enrolments.take(here) is not None


def test_only_codes_of_this_computer_outlive_a_revocation():
    enrolments = Enrolments({}.get, Clock())
    from_afar, here = (enrolments.begin(name, None, by) for name, by in (("a", ADMIN), ("b", None)))
    enrolments.end_others()
    assert from_afar and enrolments.take(from_afar) is None
    assert here and enrolments.take(here) is not None


def test_a_code_that_is_being_used_when_certificates_are_revoked():
    enrolments = Enrolments({}.get, Clock())
    for by, is_left in ((ADMIN, False), (None, True)):
        code = enrolments.begin("a", None, by) or ""
        used = enrolments.take(code)
        assert used is not None
        enrolments.end_others()
        enrolments.put_back(code, used)
        assert (enrolments.take(code) is not None) is is_left


def test_another_password_or_a_removal_ends_a_code():
    """Of its user, who may be another one of that name, and of who has made it."""
    hashes = {"bob": "1", "admin": "2"}
    enrolments = Enrolments(hashes.get, Clock())
    for name in ("bob", "admin"):
        for now in ("another", None):
            code = enrolments.begin("bob", None, ADMIN) or ""
            before = hashes.pop(name)
            hashes |= {name: now} if now else {}
            assert enrolments.take(code) is None, (name, now)
            hashes[name] = before
    code = enrolments.begin("bob", None, ADMIN) or ""
    hashes["carol"] = "3"
    assert enrolments.take(code) is not None


def test_a_code_that_is_put_back_makes_no_second_one():
    enrolments = Enrolments({}.get, Clock())
    first = enrolments.begin("bob", None, ADMIN) or ""
    found = enrolments.take(first)
    assert found is not None
    later = enrolments.begin("bob", None, ADMIN) or ""  # while the first one's password is refused
    enrolments.put_back(first, found)
    assert enrolments.take(first) is None and enrolments.take(later) is not None
