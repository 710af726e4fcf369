"""The command: runs every cell in turn, round after round, and prints the report.

The brokers are started with equal settings on this computer and driven in turn from a separate
process. They are compared by CPU time a delivered message first, as it varies least on a computer
that has other work, then by messages a second and latency. Growth cells have a table of their own
and goals for each broker by itself.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from types import FrameType

from rich.console import Console
from rich.markup import escape

from appliance.bench import report
from appliance.bench.cells import CELLS, Cell
from appliance.bench.comparison import newest, row_of, run_round
from appliance.bench.growth import GROWTH, GrowthCell, GrowthRow, grow
from appliance.bench.links import LEAST_MESSAGES, LINKS, LinkCell
from appliance.bench.peers import Peer, PeerError, find_peer, find_peers

INTERRUPTED = 130  # the exit status that shells use for SIGINT


def main(
    cells: list[str] | None,
    seconds: float,
    peers: list[str] | None,
    as_json: bool,
    messages: int | None,
    rounds: int,
) -> int:
    """See `appliance.bench.main`."""
    console = Console(stderr=True)
    every: tuple[Cell | GrowthCell, ...] = (*CELLS, *LINKS, *GROWTH)
    known = {cell.name: cell for cell in every}
    if problem := _problem(cells, known, seconds, messages, rounds):
        console.print(escape(problem), highlight=False)
        return 2
    found: list[Peer] = []
    try:
        found = find_peers(peers) if peers else [find_peer()]
    except PeerError as error:
        console.print(escape(str(error)), highlight=False)
        if peers:
            return 2
        console.print(
            "without mosquitto (apt install mosquitto, or --peer PATH): measuring the appliance"
            " alone"
        )
    # Those of links only where they are asked for: they take minutes.
    chosen = [known[name] for name in cells or known if cells or known[name] not in LINKS]
    for place, each in enumerate(chosen):
        if isinstance(each, LinkCell):
            chosen[place] = replace(each, fleet=newest(found), messages=messages or each.messages)
    rows = {cell.name: row_of(cell, found) for cell in chosen if isinstance(cell, Cell)}
    grown: list[GrowthRow] = []
    status = 0
    with _InterruptOnSigterm(), console.status("") as shown:
        try:
            for number in range(rounds):
                for place, cell in enumerate(chosen, 1):
                    if number and (isinstance(cell, GrowthCell) or cell.once):
                        continue
                    where = f"{place} of {len(chosen)}: {cell.title}"
                    if rounds > 1:
                        where = f"round {number + 1} of {rounds}, {where}"
                    if not console.is_terminal:
                        console.print(where, highlight=False)

                    def progress(text: str, where: str = where) -> None:
                        shown.update(escape(f"{where}: {text}"))

                    if isinstance(cell, GrowthCell):
                        grown.append(grow(cell, found, seconds, progress))
                    else:
                        run_round(rows[cell.name], found, seconds, number, progress)
        except KeyboardInterrupt:
            console.print("interrupted; what was measured until then:")
            status = INTERRUPTED
    done = [row for row in rows.values() if row.runs or row.problem or row.missing]
    measured = report.Report(done, grown, found, seconds, rounds)
    if as_json:
        sys.stdout.write(report.to_json(measured) + "\n")
    else:
        report.show(measured)
    return status or int(any(row.problem for row in done) or any(row.problem for row in grown))


def _problem(
    cells: list[str] | None,
    known: Mapping[str, object],
    seconds: float,
    messages: int | None,
    rounds: int,
) -> str | None:
    """What is wrong with the arguments."""
    if unknown := [name for name in cells or () if name not in known]:
        return f"no such cell: {', '.join(unknown)}; there are {', '.join(known)}"
    if seconds <= 0:
        return "the seconds to measure must be more than 0"
    if rounds < 1:
        return "there must be one round or more"
    if messages is not None and messages < LEAST_MESSAGES:
        return f"at least {LEAST_MESSAGES} messages have to wait for a link"
    return None


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
