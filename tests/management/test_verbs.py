"""How a change is run: to its end, one way or the other, and noted."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from waiting import until

from appliance.broker.faults import Faults
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import LOCAL, Arguments, Caller, Verb, Verbs
from appliance.net.callbacks import Entries
from appliance.ros.calls.dispatcher import CallError


class Change:
    """A verb that waits for the test."""

    def __init__(self) -> None:
        self.begun, self.go_on = asyncio.Event(), asyncio.Event()
        self.error: Exception | None = None
        self.noted: list[str] = []
        self.verbs = Verbs(
            [Verb("change", Arguments, self._run, changes="changed")],
            Entries(asyncio.get_running_loop(), Faults()),
            VerbThread(),
            lambda what, **details: self.noted.append(what),
        )

    async def _run(self, caller: Caller, _: Arguments) -> str:
        self.begun.set()
        await self.go_on.wait()
        if self.error is not None:
            raise self.error
        return "done"

    async def begin(self) -> asyncio.Task[Any]:
        call = asyncio.create_task(self.verbs.run(LOCAL, "change", {}))
        await self.begun.wait()
        return call


async def test_it_is_finished_when_the_time_of_its_call_is_over():
    change = Change()
    call = await change.begin()
    call.cancel()
    with pytest.raises(asyncio.CancelledError):
        await call
    assert change.noted == []
    change.go_on.set()
    await until(lambda: change.noted == ["changed"], "the change")


@pytest.mark.parametrize(
    ("error", "noted"),
    [(None, "changed"), (CallError("failed", "no"), "nothing: changed"), (KeyError(), "perhaps: ")],
)
async def test_it_is_noted_whatever_becomes_of_it(error: Exception | None, noted: str):
    change = Change()
    change.error = error
    call = await change.begin()
    change.go_on.set()
    if error is None:
        assert await call == "done"
    else:
        with pytest.raises(type(error)):
            await call
    assert change.noted[0].startswith(noted)


async def test_a_stop_cuts_it_off_and_that_is_noted():
    change = Change()
    call = await change.begin()
    await change.verbs.stop()
    with pytest.raises(asyncio.CancelledError):
        await call
    assert change.noted == ["perhaps: changed"]
    await change.verbs.stop()
