"""The screen of `appliance top`: asks once a second, draws, and reads keys."""

from __future__ import annotations

import os
import select
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from appliance.cli.connection import Ask, ManagedAppliance
from appliance.cli.console import CommandError, NotConnectedError
from appliance.cli.top_view import Line, Snapshot, Sort, lines, losses, topics_of

#: Seconds between two questions, and between two looks at the keyboard and the window's size.
INTERVAL: Final = 1.0
_STEP: Final = 0.2

#: The most clients that are asked for.
CLIENTS: Final = 100

#: The keys, beside q.
KEYS: Final[dict[str, Sort]] = {"r": "rate", "l": "loss", "n": "name"}


class Watch:
    """Asks the appliance once a second, on a thread of its own: an answer may take long, and the
    keys must not wait for it."""

    def __init__(self, options: ManagedAppliance) -> None:
        self._options = options
        self._stopping = threading.Event()
        self.snapshot = Snapshot(time.monotonic())

    def look(self) -> None:
        """Ask once. Raises CommandError when nothing is answered."""
        with self._options.asking() as ask:
            self.snapshot = self._asked(ask)

    @contextmanager
    def going_on(self) -> Iterator[None]:
        """Ask again and again meanwhile."""
        thread = threading.Thread(target=self._go_on, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._stopping.set()
            thread.join(INTERVAL)  # so that it disconnects; one that waits for an answer is left

    def _go_on(self) -> None:
        while not self._stopping.wait(INTERVAL):
            try:
                with self._options.asking() as ask:
                    while True:
                        self.snapshot = self._asked(ask)
                        if self._stopping.wait(INTERVAL):
                            return
            except CommandError as error:
                last = self.snapshot
                problem = f"no answer, asked again: {error}"
                self.snapshot = Snapshot(
                    last.time, last.status, last.routes, last.clients, (problem,)
                )

    def _asked(self, ask: Ask) -> Snapshot:
        """What it answers now. Raises CommandError when it answers nothing."""
        answers, problems = {}, []
        for verb, arguments in (
            ("status", {}),
            ("routes", {}),
            ("clients", {"connected": True, "limit": CLIENTS}),
        ):
            try:
                answers[verb] = ask(verb, arguments)
            except NotConnectedError:
                raise
            except CommandError as error:  # no right to this one, or no bridge
                problems.append(f"{verb}: {error}")
        if not answers:
            raise CommandError("; ".join(problems))
        now, routes = time.monotonic(), topics_of(answers.get("routes", []))
        clients = answers.get("clients", {"clients": []})["clients"]
        grown = losses(self.snapshot, routes, now)
        return Snapshot(now, answers.get("status"), routes, clients, problems, grown)


def show(watch: Watch, sort: Sort) -> None:
    """Draw until somebody quits."""

    def text(line: Line) -> Text:
        return Text(line.text, line.style, no_wrap=True, overflow="crop")

    console = Console()
    drawn = None
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            wanted = (watch.snapshot, sort, console.size)
            if wanted != drawn:
                width, height = console.size
                shown = lines(watch.snapshot, sort, width, height - 1)
                shown += [Line("")] * (height - 1 - len(shown))
                shown.append(Line(f"q quit  sort: r rate  l loss  n name  ({sort})"[:width]))
                live.update(Group(*map(text, shown)), refresh=True)
                drawn = wanted
            key = _key()
            if key == "q":
                return
            sort = KEYS.get(key, sort)


@contextmanager
def keyboard() -> Iterator[None]:
    """Keys are read one by one meanwhile, and not shown, if standard input is a terminal."""
    if not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _key() -> str:
    """The key that is typed within a moment, or an empty string."""
    if not sys.stdin.isatty():
        time.sleep(_STEP)
        return ""
    ready, _, _ = select.select([sys.stdin], [], [], _STEP)
    if not ready:
        return ""
    typed = os.read(sys.stdin.fileno(), 1)
    return typed.decode("ascii", "replace") if typed else "q"  # the terminal has gone
