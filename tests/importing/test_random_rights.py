"""A few random configurations with mosquitto beside the appliance; random_rights.py has more."""

from __future__ import annotations

import pytest

from appliance.importing import Imported, NewFile, Note
from appliance.importing.notes import Place
from importing.random_files import ROBOT, Case, Login, Sent
from importing.random_rights import MOSQUITTO, Result, Seen, judge, run

#: A few of each kind: by listener and in general, with TLS and without, with rules and without.
SEEDS = (24, 27, 49, 71)

LOGIN = Login(1883, False, 5, "c1", "alice", "one", None)
OTHER = Login(1883, False, 5, "c2", "bob", "two", None)


@pytest.mark.skipif(MOSQUITTO is None, reason="there is no mosquitto: apt-get install mosquitto")
def test_nothing_is_allowed_that_mosquitto_does_not_allow() -> None:
    faults, less, same = run(SEEDS, print)
    assert faults == []
    assert same > 800, less


def judged(theirs: Seen, ours: Seen, *notes: str) -> Result:
    settings = f"robot: {ROBOT}\nbroker: {{listeners: [{{bind: '127.0.0.1:1883'}}]}}\n"
    file = NewFile("appliance.yaml", settings, "")
    told = tuple(Note(Place("mosquitto.conf", 1), "x", note) for note in notes)
    case = Case(logins=[LOGIN, OTHER], sent=[[Sent("a", 1, False, 0)]] * 2)
    return judge(case, theirs, ours, Imported((file,), told, 0, 0))


def seen(code: int = 0, granted: int = 0, answer: str = "taken", *heard: str) -> Seen:
    message = {(topic, f"message of {OTHER}: ".encode()) for topic in heard}
    return Seen(
        codes={0: code, 1: 0},
        granted={(0, "a"): granted},
        answers={(0, "a"): answer},
        heard={0: message},
        retained={0: message},
    )


@pytest.mark.parametrize(
    ("theirs", "ours", "said"),
    [
        (seen(0x87), seen(), "0x87 of mosquitto, 0x0 here"),
        (seen(granted=0x87), seen(), "a: 0x87 of mosquitto, 0x0"),
        (seen(granted=1), seen(granted=2), "a: 0x1 of mosquitto, 0x2"),
        (seen(answer="refused"), seen(), "PUBLISH a: refused by mosquitto, taken"),
        (seen(answer="ended"), seen(answer="unknown"), "PUBLISH a: ended by mosquitto, unknown"),
        (seen(), seen(0, 0, "taken", "b"), "heard 'b'"),
        (seen(), seen(0, 0, "taken", "b"), "retained 'b'"),
    ],
)
def test_what_is_allowed_here_alone_is_a_fault(theirs: Seen, ours: Seen, said: str) -> None:
    found = judged(theirs, ours).faults
    assert [each for each in found if each.startswith("allowed here alone: ") and said in each]
    assert judged(theirs, theirs).faults == judged(ours, ours).faults == []


def test_what_is_refused_here_alone_is_a_fault_unless_it_is_told() -> None:
    said = "names: who gives a user name is checked here"
    (fault,) = judged(seen(), seen(0x87)).faults
    assert fault.startswith("refused here, and nothing says so")
    told = judged(seen(), seen(0x87), said)
    assert told.faults == []
    assert told.less == {"names are checked": 1}
    (fault,) = judged(seen(), seen(answer="refused"), said).faults
    assert "PUBLISH a: taken by mosquitto, refused" in fault
    assert len(judged(seen(0, 0, "taken", "b"), seen()).faults) == 2
