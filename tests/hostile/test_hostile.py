"""Most attacks for a second; `python tests/hostile` is longer, and prints what it measures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from arena import Arena
from attacks import ATTACKS
from combat import BOTH, Attack

pytestmark = pytest.mark.timed

SECONDS = 0.7
SHORT = [attack for attack in ATTACKS.values() if attack.short]


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arena]:
    arena = Arena(tmp_path_factory.mktemp("arena"))
    yield arena
    arena.close()


@pytest.mark.parametrize("attack", SHORT, ids=lambda attack: attack.name)
def test_the_broker_withstands(arena: Arena, attack: Attack) -> None:
    ways = BOTH if attack.over is None else (attack.over,)
    outcome = arena.run(attack, ways, SECONDS)
    if outcome.problems:
        pytest.fail("\n".join([attack.what, *outcome.problems]), pytrace=False)
