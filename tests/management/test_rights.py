"""What questions about rights cost the others."""

from __future__ import annotations

import asyncio
import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from appliance.broker.values import Identity
from appliance.management.rights import Question, Questions, RightsVerbs
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Caller


async def test_the_loop_goes_on_between_questions_that_take_long(monkeypatch: pytest.MonkeyPatch):
    """As those about wide filters, with thousands of rules."""
    broker: Any = SimpleNamespace(counters=SimpleNamespace(cost=0))
    verbs = RightsVerbs(broker, cast(Any, None), VerbThread())
    monkeypatch.setattr(verbs, "_right", lambda *question: time.sleep(0.006))
    rounds = 0

    async def count() -> None:
        nonlocal rounds
        while True:
            rounds += 1
            await asyncio.sleep(0)

    counting = asyncio.create_task(count())
    questions = Questions([Question("subscribe", "r2d2/#")] * 10)
    answer = await verbs._rights(Caller(Identity("bob", "phone")), questions)
    counting.cancel()
    assert len(answer["rights"]) == 10 and rounds >= 9
    assert broker.counters.cost > 0
