"""The command: runs every cell in turn and prints the report.

Both brokers are started with equal settings on this computer and driven in turn from a separate
process. They are compared by CPU time a delivered message first, as it varies least on a computer
that has other work, then by messages a second and latency. Growth cells have a table of their own
and goals for each broker by itself.
"""

from __future__ import annotations

import signal
import sys
import threading
from dataclasses import replace
from types import FrameType

from rich.console import Console
from rich.markup import escape

from appliance.bench import report
from appliance.bench.cells import CELLS, REPEATS, Cell, Row, compare
from appliance.bench.growth import GROWTH, GrowthCell, GrowthRow, grow
from appliance.bench.links import LEAST_MESSAGES, LINKS, LinkCell
from appliance.bench.peers import find_mosquitto, mosquitto_version

INTERRUPTED = 130  # the exit status that shells use for SIGINT


def main(
    cells: list[str] | None,
    seconds: float,
    peer: str | None,
    as_json: bool,
    messages: int | None = None,
) -> int:
    """See `appliance.bench.main`."""
    console = Console(stderr=True)
    every: tuple[Cell | GrowthCell, ...] = (*CELLS, *LINKS, *GROWTH)
    known = {cell.name: cell for cell in every}
    if unknown := [name for name in cells or () if name not in known]:
        console.print(f"no such cell: {', '.join(unknown)}; there are {', '.join(known)}")
        return 2
    if seconds <= 0:
        console.print("the seconds to measure must be more than 0")
        return 2
    if messages is not None and messages < LEAST_MESSAGES:
        console.print(f"at least {LEAST_MESSAGES} messages have to wait for a link")
        return 2
    command = find_mosquitto(peer)
    if command is None and peer is not None:
        console.print(f"{peer} is not there, or cannot be run")
        return 2
    if command is None:
        console.print(
            "mosquitto is not installed (apt install mosquitto): measuring the appliance alone"
        )
    # Those of links only where they are asked for: they take minutes.
    chosen = [known[name] for name in cells or known if cells or known[name] not in LINKS]
    for place, each in enumerate(chosen):
        if isinstance(each, LinkCell):
            chosen[place] = replace(each, fleet=command, messages=messages or each.messages)
    rows: list[Row] = []
    grown: list[GrowthRow] = []
    status = 0
    with _InterruptOnSigterm(), console.status("") as shown:
        try:
            for number, cell in enumerate(chosen, 1):
                where = f"{number} of {len(chosen)}: {cell.title}"
                if not console.is_terminal:
                    console.print(where, highlight=False)

                def progress(text: str, where: str = where) -> None:
                    shown.update(escape(f"{where}: {text}"))

                if isinstance(cell, GrowthCell):
                    grown.append(grow(cell, command, seconds, progress))
                else:
                    rows.append(compare(cell, command, seconds, progress=progress))
        except KeyboardInterrupt:
            console.print("interrupted; what was measured until then:")
            status = INTERRUPTED
    version = mosquitto_version(command) if command else None
    if as_json:
        sys.stdout.write(report.to_json(rows, grown, version, seconds, REPEATS) + "\n")
    else:
        report.show(rows, grown, version)
    return status or int(any(row.problem for row in rows) or any(row.problem for row in grown))


class _InterruptOnSigterm:
    """Makes SIGTERM end like Ctrl-C, so that everything that was started is stopped."""

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGTERM, self._interrupt)

    def __exit__(self, *_: object) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._before)

    @staticmethod
    def _interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt
