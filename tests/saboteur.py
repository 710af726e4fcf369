"""Fault injection for `test_containment.py`: an entry of the appliance raises when next passed.

It raises before its work or after it, because the state differs. Entries that go through
`appliance.net.callbacks` and `Faults.run` are found by their names. For an entry with a `try` of
its own, INLINE names what is called in there, and the caller.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Coroutine, Generator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from appliance.broker.faults import Faults
from appliance.net import callbacks as entries
from appliance.ros.fault_containment import FaultContainment

PACKAGE = Path(__file__).parents[1] / "appliance"

#: The calls whose first argument is an entry's name.
NAMED = {
    "_later",
    "_abandon",
    "_contained",
    "_report_fault",
    "at",
    "caught",
    "contained",
    "contained_made",
    "every",
    "fault",
    "from_thread",
    "later",
    "reader",
    "run",
    "contained_proxy",
    "signal",
    "soon",
    "task",
    "when_done",
}
ENTRY = re.compile(r"[a-z_]+(\.[a-z_]+)?")

#: By entry: module, class (or none) and name of what is called in its `try`, and the caller.
INLINE = {
    "actions.look": ("ros.calls.action_topics", "ActionSubscriptions", "poll_graph", "poll_graph"),
    "app.certificates": ("app.main", "", "keep_server_certificate", ""),
    "app.reload": ("app.main", "App", "reload", "_try_reload"),
    "bridge.look": ("ros.topics.follower", "TopicFollower", "poll_graph", ""),
    "bridge.message": ("broker.broker", "Broker", "publish", "ros/bridge.py:_publish"),
    "bridge.receive": ("ros.topics.to_ros", "ToRos", "receive", "_hand_over"),
    "broker.delivery": ("broker.session", "Session", "deliver", "publish_to"),
    "broker.end": ("broker.client", "ClientHandler", "fault", "fault"),
    "broker.will": ("broker.broker", "Broker", "_publish_late", "_publish_will"),
    "calls.handle": ("ros.calls.requests", "Requests", "ask", "_ask"),
    "calls.take": ("ros.calls.services", "ServiceRoutes", "_type", "_handle"),
    "calls.look": ("ros.calls.service_server", "ServiceServers", "poll_graph", "poll_graph"),
    "client.cut_off": ("broker.client", "ClientHandler", "_make_sure", "cut_off"),
    "client.shut": ("broker.client", "ClientHandler", "_shut", "cut_off"),
    "clock.keep_alive": ("broker.client", "ClientHandler", "tick", "tick"),
    "clock.session": ("broker.broker", "Broker", "_fall_due", "tick"),
    "commands.stop": ("ros.topics.stop_message", "StopMessage", "cdr", "_publish_stop"),
    "commit.release": ("broker.output", "Output", "release", "_committed"),
    "commit.resume": ("broker.client", "ClientHandler", "resume", "_recover"),
    "connection.begin": ("net.tls", "", "accept", "begin"),
    "connection.certificate": ("net.connection", "ClientConnection", "check_certificate", ""),
    "connection.chunk": ("broker.client", "ClientHandler", "receive", "data_received"),
    "connection.last_chunk": ("broker.client", "ClientHandler", "receive", "connection_lost"),
    "connection.last_turn": ("broker.client", "ClientHandler", "send_on", "_leave"),
    "connection.login": ("net.connection", "ClientConnection", "_resume_input", "_log_in"),
    "connection.turn": ("net.connection", "ClientConnection", "take_turn", "_run_turns"),
    "control.command": ("app.management", "ApplianceVerbs", "_status", ""),
    "control.connection": ("ops.control", "Control", "_answer", "_serve"),
    "flush": ("broker.output", "Output", "flush", "broker/broker.py:flush"),
    "flush.wait": ("broker.output", "Output", "wait", "_hold_back"),
    "http.respond": ("net.http", "HttpLayer", "_answer_counted", "_respond"),
    "listener.admit": ("net.listeners", "Listeners", "admit", "_accept"),
    "listener.open": ("net.listeners", "_ListeningSocket", "open", "_open_sockets"),
    "session.replay": ("broker.retained", "RetainedMessages", "find_in_steps", "_find_retained"),
    "session.send": ("broker.output", "Output", "publish", "_send"),
    "tls.chunk": ("net.tls", "TlsTransport", "_take", "data_received"),
}


def all_entries() -> set[str]:
    """The names of all entries in the sources."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            # `self._post(faults.caught, "entry", …)`: on the loop's thread.
            arguments = node.args[1:2] if name == "_post" else node.args[:1]
            if name in NAMED or name == "_post":
                found |= {
                    each.value
                    for each in arguments
                    if isinstance(each, ast.Constant)
                    and isinstance(each.value, str)
                    and ENTRY.fullmatch(each.value)
                }
    return found


def owner_of(module: str, kind: str, name: str) -> Any:
    """The class or module that has what INLINE names. Raises ImportError or AttributeError."""
    owner: Any = importlib.import_module(f"appliance.{module}")
    owner = getattr(owner, kind) if kind else owner
    getattr(owner, name)
    return owner


class SabotageError(Exception):
    """The injected fault."""


class Saboteur:
    """After `arm`, each of these entries raises once when it is next passed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        #: The entries that fail before their work, and those that fail after it.
        self._armed: set[str] = set()
        self._armed_behind: set[str] = set()
        #: Caught errors that were not injected, with their entries.
        self.others: list[str] = []
        self._patch_entries(monkeypatch)
        places: dict[tuple[str, str, str], dict[str, str]] = {}
        for entry, (module, kind, name, by) in INLINE.items():
            places.setdefault((module, kind, name), {})[entry] = by
        for place, callers in places.items():
            self._patch_inline(monkeypatch, place, callers)

    def arm(self, *names: str, behind: str = "") -> None:
        """Let `names` fail before their work, and `behind` after its work."""
        self._armed = set(names)
        self._armed_behind = {behind} if behind else set()

    def _strike(self, entry: str) -> None:
        if entry in self._armed:
            self._armed.discard(entry)
            raise SabotageError(f"before {entry}")

    def _strike_behind(self, entry: str) -> None:
        if entry in self._armed_behind:
            self._armed_behind.discard(entry)
            raise SabotageError(f"behind {entry}")

    def _struck(self, entry: str, callback: Callable[..., object], *args: Any, **more: Any) -> Any:
        self._strike(entry)
        result = callback(*args, **more)
        if entry in self._armed_behind:
            if inspect.iscoroutine(result):
                return self._struck_task(entry, result)
            if inspect.isgenerator(result):
                return self._struck_steps(entry, result)
            self._strike_behind(entry)
        return result

    async def _struck_task(self, entry: str, work: Coroutine[Any, Any, Any]) -> Any:
        try:
            self._strike(entry)
        except SabotageError:
            work.close()
            raise
        result = await work
        self._strike_behind(entry)
        return result

    def _struck_steps(self, entry: str, steps: Generator[Any, Any, Any]) -> Any:
        result = yield from steps
        self._strike_behind(entry)
        return result

    def _patch_entries(self, monkeypatch: pytest.MonkeyPatch) -> None:
        caught = Faults.caught

        def noted(own: Faults, entry: str, error: BaseException, served: object = "") -> None:
            # Errors that the loop reports may be those of the test's clients, which share it.
            theirs = entry == "loop" and isinstance(error, EOFError | OSError)
            if not isinstance(error, SabotageError) and not theirs:
                self.others.append("".join(traceback.format_exception(error)) + f"at {entry}")
            caught(own, entry, error, served)

        monkeypatch.setattr(Faults, "caught", noted)
        run, task, repeat = (
            entries.Entries.run,
            entries.Entries.task,
            entries.PeriodicCallback.__init__,
        )
        once, shield = Faults.run, entries._ContainedProxy.__init__
        struck = self._struck

        def entered(own, entry, served, failed, callback, args):
            run(own, entry, served, failed, partial(struck, entry, callback), args)

        def begun(own, entry, work, **more):
            return task(own, entry, self._struck_task(entry, work), **more)

        def repeated(own, all_entries, entry, interval, callback, delay):
            repeat(own, all_entries, entry, interval, partial(struck, entry, callback), delay)

        def ran(own, entry, work, *args, otherwise):
            return once(own, entry, partial(struck, entry, work), *args, otherwise=otherwise)

        class Struck:
            def __init__(self, entry: str, told: object) -> None:
                self._entry, self._told = entry, told

            def __getattr__(self, name: str) -> object:
                return partial(struck, self._entry, getattr(self._told, name))

        def shielded(own, entry, faults, told):
            shield(own, entry, faults, Struck(entry, told))

        contained = FaultContainment._contained

        def of_the_node(own, entry, callback):
            return contained(own, entry, partial(struck, entry, callback))

        monkeypatch.setattr(FaultContainment, "_contained", of_the_node)
        monkeypatch.setattr(entries.Entries, "run", entered)
        monkeypatch.setattr(entries.Entries, "task", begun)
        monkeypatch.setattr(entries.PeriodicCallback, "__init__", repeated)
        monkeypatch.setattr(entries._ContainedProxy, "__init__", shielded)
        monkeypatch.setattr(Faults, "run", ran)
        names = ("net.connection", "net.http", "net.tls", "net.websocket")
        for name in (*names, "upstream.transport", "upstream.websocket_client"):
            module = importlib.import_module(f"appliance.{name}")
            for kind in vars(module).values():
                if isinstance(kind, type) and kind.__module__ == module.__name__:
                    for method in vars(kind).values():
                        self._patch_contained(monkeypatch, method)

    def _patch_contained(self, monkeypatch: pytest.MonkeyPatch, method: object) -> None:
        """`@contained` knows its method, and the entry's name, by its closure."""
        code, closure = getattr(method, "__code__", None), getattr(method, "__closure__", None)
        if not closure or code.co_filename != entries.__file__:
            return
        cells = dict(zip(code.co_freevars, closure, strict=True))
        entry, own = cells["entry"].cell_contents, cells["method"].cell_contents
        monkeypatch.setattr(cells["method"], "cell_contents", partial(self._struck, entry, own))

    def _patch_inline(
        self, monkeypatch: pytest.MonkeyPatch, place: tuple[str, str, str], callers: dict[str, str]
    ) -> None:
        owner, name = owner_of(*place), place[2]
        own = getattr(owner, name)

        def entered(*args: Any, **more: Any) -> Any:
            for entry in (self._armed | self._armed_behind) & callers.keys():
                file, _, caller = callers[entry].rpartition(":")
                code = sys._getframe(1).f_code
                if not caller or (code.co_name == caller and code.co_filename.endswith(file)):
                    return self._struck(entry, own, *args, **more)
            return own(*args, **more)

        monkeypatch.setattr(owner, name, entered)
