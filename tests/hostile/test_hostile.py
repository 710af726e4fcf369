"""Most attacks for a second; `python tests/hostile` is longer, and prints what it measures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from attacks import ATTACKS
from load import BOTH, Attack
from server import NOT_REACHED, Server

pytestmark = pytest.mark.timed

SECONDS = 0.7
SHORT = [attack for attack in ATTACKS.values() if attack.short]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("server"))
    yield server
    server.close()


@pytest.mark.parametrize("attack", SHORT, ids=lambda attack: attack.name)
def test_the_broker_withstands(server: Server, attack: Attack) -> None:
    ways = BOTH if attack.over is None else (attack.over,)
    for seconds in (SECONDS, 5 * SECONDS):  # attackers yield to all else on a busy computer
        outcome = server.run(attack, ways, seconds)
        if not any(problem.startswith(NOT_REACHED) for problem in outcome.problems):
            break
    if outcome.problems:
        pytest.fail("\n".join([attack.what, *outcome.problems]), pytrace=False)
