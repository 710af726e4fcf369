"""What verbs compute: in one thread, users in turn."""

from __future__ import annotations

import asyncio
import sys
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from waiting import PATIENCE, until

from appliance import config
from appliance.access import Acl, Passwords
from appliance.access import groups as acl_groups
from appliance.app import main
from appliance.app import reload as reload_module
from appliance.app import status as status_module
from appliance.app.main import App
from appliance.management import records
from appliance.management.verb_thread import VerbThread
from appliance.ros.calls.dispatcher import CallError
from management.managed import Site


@pytest.fixture
async def thread() -> AsyncIterator[VerbThread]:
    thread = VerbThread()
    yield thread
    await thread.close()


async def test_verbs_compute_in_one_thread(site: Site, monkeypatch: pytest.MonkeyPatch):
    """And no two at once: each takes the interpreter's lock from the event loop."""
    computed: dict[str, set[int]] = {}

    def watch(where: Any, name: str) -> None:
        real: Callable[..., Any] = getattr(where, name)

        def watched(*given: Any) -> Any:
            computed.setdefault(name, set()).add(threading.get_native_id())
            return real(*given)

        monkeypatch.setattr(where, name, watched)

    watch(Acl, "explain")
    watch(acl_groups, "members")
    watch(Passwords, "save")
    watch(records, "_entries")
    watch(status_module, "endings")
    watch(reload_module, "_read")
    admin = await site.join("a")
    await admin.call("explain", {"user": "viewer", "topic": "secret"})
    await admin.call("users")
    await admin.call("user_password", {"user": "viewer", "password": "another"})
    await admin.call("audit")
    await admin.call("status")
    await admin.call("reload")
    others = computed.pop("_read")
    assert len(computed) == 5
    (number,) = set.union(*computed.values())
    assert number != threading.get_native_id()
    assert number not in others


async def test_a_reload_waits_for_no_verb(site: Site, monkeypatch: pytest.MonkeyPatch):
    """Such as one that waits for a lock of a file: it is a reload that takes rights away."""
    go_on, begun = threading.Event(), threading.Event()

    def wait(*given: Any) -> dict[str, Any]:
        begun.set()
        go_on.wait(PATIENCE)
        return {}

    monkeypatch.setattr(acl_groups, "members", wait)
    admin = await site.join("a")
    hung = asyncio.create_task(admin.call("users"))
    await until(begun.is_set, "the verb to hang")
    try:
        await site.app.reload()
    finally:
        go_on.set()
    await hung


async def test_what_waits_at_the_end_is_told(thread: VerbThread):
    begun, go_on = threading.Event(), threading.Event()

    def work() -> bool:
        begun.set()
        return go_on.wait(PATIENCE)

    first = asyncio.create_task(thread.run("a", work))
    second = asyncio.create_task(thread.run("b", lambda: None))
    await until(begun.is_set, "the first")
    closing = asyncio.create_task(thread.close())
    await asyncio.sleep(0)
    go_on.set()
    await closing
    assert await first
    with pytest.raises(CallError, match="the appliance stops"):
        await second


async def test_it_ends_with_the_appliance(tmp_path: Path):
    site = Site(tmp_path)
    await site.app.start()
    admin = await site.join("a")
    await admin.call("users")
    assert _threads()
    await site.stop()
    assert not _threads()


def _threads() -> list[threading.Thread]:
    return [each for each in threading.enumerate() if each.name.startswith("verbs")]


async def _held(thread: VerbThread) -> tuple[threading.Event, asyncio.Task[bool]]:
    """A work of user "a" that has begun, and what lets it go on."""
    begun, go_on = threading.Event(), threading.Event()

    def work() -> bool:
        begun.set()
        return go_on.wait(PATIENCE)

    held = asyncio.create_task(thread.run("a", work))
    await until(begun.is_set, "the work that is held")
    return go_on, held


async def test_users_take_turns(thread: VerbThread):
    """The work of one, however much it is, does not keep another's waiting."""
    done: list[str] = []
    go_on, held = await _held(thread)
    works = [
        asyncio.create_task(thread.run(user, lambda user=user: done.append(user)))  # type: ignore[misc]
        for user in ("a", "a", "a", "b", "c", "a", "b")
    ]
    await asyncio.sleep(0)
    go_on.set()
    await asyncio.gather(held, *works)
    assert done == ["a", "b", "c", "a", "b", "a", "a"]


async def test_work_whose_call_has_ended_is_left_out(thread: VerbThread):
    """One that has begun goes on, and the next one follows it."""
    done: list[int] = []
    go_on, held = await _held(thread)
    works = [
        asyncio.create_task(thread.run("a", lambda n=n: done.append(n)))  # type: ignore[misc]
        for n in range(4)
    ]
    await asyncio.sleep(0)
    works[0].cancel()
    held.cancel()
    await asyncio.sleep(0)
    # It is the turn of the second one, which does not know it yet: it runs in the next step.
    assert held.done() and not works[1].done()
    works[1].cancel()
    go_on.set()
    await asyncio.gather(*works, return_exceptions=True)
    assert done == [2, 3]
    assert await asyncio.wait_for(thread.run("b", lambda: 1), 10) == 1


async def test_an_error_is_that_of_its_work(thread: VerbThread):
    def fail() -> None:
        raise KeyError

    with pytest.raises(KeyError):
        await thread.run(None, fail)
    await thread.run(None, lambda: None)


async def test_close_waits_for_what_has_begun():
    thread = VerbThread()
    begun, go_on, ended = threading.Event(), threading.Event(), threading.Event()

    def work() -> None:
        begun.set()
        go_on.wait()
        ended.set()

    running = asyncio.create_task(thread.run(None, work))
    await until(begun.is_set, "the work")
    closing = asyncio.create_task(thread.close())
    await asyncio.sleep(0.01)
    assert not closing.done()
    go_on.set()
    await closing
    assert ended.is_set()
    await running
    await thread.close()


def test_a_thread_that_computes_gives_way_soon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """The loop waits for the interpreter beside it: 14 ms in the median with Python's interval."""
    intervals: list[float] = []

    async def look(app: App) -> None:
        intervals.append(sys.getswitchinterval())

    before = sys.getswitchinterval()
    monkeypatch.setattr(App, "run", look)
    monkeypatch.setattr(main, "_tune_garbage_collector", lambda: None)
    monkeypatch.setattr(main.signal, "signal", lambda *_: None)
    file = tmp_path / "appliance.yaml"
    file.write_text("robot: r2d2\n")
    try:
        main.run(config.load(file))
    finally:
        sys.setswitchinterval(before)
    assert intervals == [pytest.approx(0.001)]
