"""Every callback from outside is contained: a scan of the sources finds those that are not.

An entry is what somebody else than our own code calls: the event loop, another thread, a signal.
What follows looks for all of them in the sources, so that a new one that is not contained fails
here, and for one by the name of which nothing was ever raised in `test_containment.py`.
"""

from __future__ import annotations

import ast
import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from appliance.broker.faults import Faults
from appliance.net.callbacks import Entries, contained, contained_proxy

PACKAGE = Path(__file__).parents[2] / "appliance"

#: The one module that may hand callbacks to the loop.
ENTRIES = PACKAGE / "net/callbacks.py"

#: How a callback gets to a loop, or to a future of it.
TO_THE_LOOP = {
    "add_done_callback",
    "add_reader",
    "add_signal_handler",
    "add_writer",
    "call_at",
    "call_later",
    "call_soon",
    "call_soon_threadsafe",
    "create_task",
    "ensure_future",
}

#: What the loop calls of a connection.
OF_A_PROTOCOL = {
    "connection_lost",
    "connection_made",
    "data_received",
    "datagram_received",
    "eof_received",
    "error_received",
    "pause_writing",
    "resume_writing",
}

#: These are programs of their own, or clients: they have nobody else to harm.
PROGRAMS = ("bench/", "cli/", "mdns/announcer.py")

#: These know no loop.
PURE = ("broker/", "mqtt/")

#: Those that stay: what is called there cannot fail, or is contained where it is.
ALLOWED = {
    # Sets an event, and has to work before there is anything else.
    ("app/main.py", "add_signal_handler"),
    # Another object's, which hands it on to the ROS thread's executor and contains it there.
    ("ros/calls/*", "call_soon"),
    ("ros/ros1/*", "call_soon"),
    # A future that `hashing` settles itself; and one that the login waits for, and with it ends.
    ("access/hashing.py", "add_done_callback"),
    ("access/files.py", "create_task"),
    ("access/files.py", "add_done_callback"),
    # Waited for where they are made, or made so that nothing escapes: plugins may raise anything.
    ("plugins/guard.py", "ensure_future"),
    ("plugins/access.py", "ensure_future"),
    ("plugins/logins.py", "ensure_future"),
    ("plugins/logins.py", "add_done_callback"),
    ("plugins/events.py", "add_done_callback"),
    ("plugins/threads.py", "call_soon_threadsafe"),
    # Waited for where it is made.
    ("ros/calls/actions.py", "ensure_future"),
    # Awaited where it is made, which raises what it raises.
    ("mdns/process.py", "create_task"),
    # The executor's, and a Future of rclpy's: `run` contains it.
    ("ros/ros2/node.py", "create_task"),
    ("ros/ros2/node.py", "add_done_callback"),
}


def sources() -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if path != ENTRIES and not name.startswith(PROGRAMS):
            yield name, ast.parse(path.read_text(), str(path))


def is_allowed(name: str, what: str) -> bool:
    folder = f"{name.rpartition('/')[0]}/*"
    return (name, what) in ALLOWED or (folder, what) in ALLOWED


def test_nobody_hands_a_callback_to_the_loop_but_the_entries():
    found = [
        f"appliance/{name}:{node.lineno}: {node.func.attr}: use appliance.net.callbacks"
        for name, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in TO_THE_LOOP
        and not is_allowed(name, node.func.attr)
    ]
    assert not found, "\n".join(found)


def test_nobody_waits_in_a_way_that_loses_a_cancellation():
    """Before Python 3.12 `asyncio.wait_for` does when what it waits for ends in the same round."""
    found = [
        f"appliance/{name}:{node.lineno}: use async_timeout.timeout"
        for name, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and node.attr == "wait_for"
        and isinstance(node.value, ast.Name)
        and node.value.id == "asyncio"
    ]
    assert not found, "\n".join(found)


def is_contained(method: ast.FunctionDef) -> bool:
    """By its decorator, or as all of it is one `try` that catches every exception."""
    for decorator in method.decorator_list:
        name = getattr(decorator.func, "id", "") if isinstance(decorator, ast.Call) else ""
        if name in ("contained", "contained_made"):
            return True
    body = method.body[1:] if ast.get_docstring(method) else method.body
    if not body:
        return True  # it does nothing
    return (
        len(body) == 1
        and isinstance(body[0], ast.Try)
        and any(
            isinstance(handler.type, ast.Name) and handler.type.id == "Exception"
            for handler in body[0].handlers
        )
    )


def test_what_the_loop_calls_of_a_connection_is_contained():
    found = []
    for name, tree in sources():
        for kind in ast.walk(tree):
            if not isinstance(kind, ast.ClassDef) or name.startswith(PURE):
                continue
            if any(getattr(base, "id", "") == "Protocol" for base in kind.bases):
                continue  # says only what there is to be
            found += [
                f"appliance/{name}:{method.lineno}: {kind.name}.{method.name} is not contained"
                for method in kind.body
                if isinstance(method, ast.FunctionDef)
                and method.name in OF_A_PROTOCOL
                and not is_contained(method)
            ]
    assert not found, "\n".join(found)


# --- the entries themselves ----------------------------------------------------------------------


class BrokenError(Exception):
    """What nobody expected."""


def fail(*args: object) -> None:
    raise BrokenError("on purpose")


@pytest.fixture
async def entries() -> Entries:
    return Entries(asyncio.get_running_loop(), Faults())


async def turns(count: int = 3) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


async def test_a_callback_that_fails_is_counted_and_ends_what_it_served(entries, escaped):
    ended: list[str] = []
    entries.soon("soon", fail, served="x", failed=lambda: ended.append("soon"))
    entries.later("later", 0, fail, failed=lambda: ended.append("later"))
    entries.at("at", entries.time(), fail, failed=lambda: ended.append("at"))
    await asyncio.to_thread(
        entries.from_thread, "thread", fail, failed=lambda: ended.append("thread")
    )
    entries.soon("twice", fail, failed=fail)
    done = asyncio.Event()
    entries.later("done", 0.05, done.set)  # behind them all
    await asyncio.wait_for(done.wait(), 60)
    assert sorted(ended) == ["at", "later", "soon", "thread"]
    assert entries.faults.by_entry == {
        **dict.fromkeys(("soon", "later", "at", "thread", "twice", "twice, at its end"), 1)
    }
    escaped.clear()


async def test_a_task_that_fails_is_counted_whoever_waits_for_it(entries, escaped):
    async def work(fails: bool) -> int:
        if fails:
            fail()
        return 7

    ended: list[str] = []
    assert await entries.task("task", work(False)) == 7
    with pytest.raises(BrokenError):
        await entries.task("task", work(True), failed=lambda: ended.append("task"))
    cancelled = entries.task("task", work(True))
    cancelled.cancel()
    await turns()
    assert ended == ["task"] and entries.faults.count == 1 and not entries._tasks
    escaped.clear()


async def test_what_is_repeated_goes_on_when_it_fails(entries, escaped):
    calls = 0
    done = asyncio.Event()

    def call() -> float | None:
        nonlocal calls
        calls += 1
        if calls == 2:
            return entries.time()
        if calls == 4:
            done.set()
        raise BrokenError

    repeated = entries.every("clock", 0.001, call, 0)
    await asyncio.wait_for(done.wait(), 10)
    repeated.cancel()
    repeated.cancel()
    await turns()
    assert calls == 4 and entries.faults.by_entry["clock"] == 3
    escaped.clear()


async def test_what_is_repeated_may_end_itself(entries):
    repeated = entries.every("clock", 0, lambda: repeated.cancel(), 0)
    await asyncio.sleep(0.01)
    assert repeated._timer is None


async def test_a_method_of_a_connection(escaped):
    class Connection:
        def __init__(self) -> None:
            self.faults: list[tuple[str, Exception]] = []

        def fault(self, entry: str, error: Exception) -> None:
            self.faults.append((entry, error))

        @contained("made")
        def connection_made(self, number: int) -> int:
            return 1 // number

    connection = Connection()
    assert connection.connection_made(1) == 1
    assert connection.connection_made(0) is None
    ((entry, error),) = connection.faults
    assert entry == "made" and isinstance(error, ZeroDivisionError)


def test_who_is_told_harms_nobody(escaped):
    class Observer:
        def told(self, what: str) -> str:
            return what

        refused = fail

    faults = Faults()
    observer = contained_proxy("observer", faults, Observer())
    assert observer.told("x") == "x" and observer.refused("y") is None
    assert faults.by_entry == {"observer": 1}
    escaped.clear()
