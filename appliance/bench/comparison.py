"""The comparison: rounds over the cells, and each cell's runs with their medians and goals.

In a round every broker of a cell is newly started and measured once, in an order that changes from
round to round, so that all of them meet the same disturbances. The median of the rounds counts, and
the lowest and the highest say how far it can be trusted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import statistics
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from appliance.bench.cells import Cell, Side
from appliance.bench.load import Result
from appliance.bench.peers import Peer, PeerError, Site

ROUNDS = 3
OURS = "appliance"  # the key of this appliance beside the names of peers

Figures = Result  # of one broker: the median of its runs, for each figure


@dataclass(slots=True)
class Row:
    """The results of one cell so far: for each broker those of its rounds."""

    cell: Cell
    against: str | None = None  # the name of the peer that the goals are about
    runs: dict[str, list[Result]] = field(default_factory=dict)
    note: str | None = None  # what the cell reports beside its figures
    problems: dict[str, str] = field(default_factory=dict)  # of which broker, and what went wrong
    missing: str | None = None  # what this computer lacks to run it

    @property
    def problem(self) -> str | None:
        """What went wrong, of all brokers."""
        return "; ".join(self.problems.values()) or None

    @property
    def ours(self) -> Figures | None:
        """The medians of this appliance; None where it did not run."""
        return self.figures(OURS)

    def figures(self, name: str | None) -> Figures | None:
        """The medians of a broker; None where it did not run."""
        runs = self.runs.get(name) if name else None
        return median(runs) if runs else None

    def spread(self, name: str | None, figure: str) -> tuple[float, float] | None:
        """The lowest and the highest of a broker's rounds; None where there are none."""
        values = [getattr(run, figure) for run in self.runs.get(name or "", ())]
        known = [value for value in values if value is not None]
        return (min(known), max(known)) if known else None

    def ratio(self, figure: str, name: str | None = None) -> float | None:
        """A peer's figure divided by ours, inverted for a rate: above 1 ours is better.

        Without a name it is the ratio to the peer that the goals are about.
        """
        both = (self.ours, self.figures(name or self.against))
        ours, peer = (getattr(each, figure, None) for each in both)
        if figure == "rate":
            ours, peer = peer, ours
        return peer / ours if ours and peer is not None else None

    def meets(self, figure: str) -> bool | None:
        """Whether a figure meets its goals; None when it has none, or one is missing."""
        cell, value, ratio = self.cell, getattr(self.ours, figure, None), self.ratio(figure)
        goal, least, most = (each.get(figure) for each in (cell.goals, cell.at_least, cell.at_most))
        verdicts = [
            None if value is None else value >= least if least is not None else True,
            None if value is None else value <= most if most is not None else True,
            True if goal is None else None if ratio is None else ratio >= goal,
        ]
        if goal is least is most is None or None in verdicts:
            return None
        return all(verdicts)

    @property
    def met(self) -> bool | None:
        """Whether every goal is met; None when a figure is missing."""
        cell = self.cell
        verdicts = [self.meets(each) for each in (*cell.goals, *cell.at_least, *cell.at_most)]
        return None if None in verdicts else all(verdicts)


def median(runs: Sequence[Result]) -> Figures:
    """The median of each figure over the runs; losses are added up, as every loss counts."""
    figures = {}
    for name in (each.name for each in dataclasses.fields(Result)):
        values = [getattr(run, name) for run in runs]
        if name == "lost":
            figures[name] = sum(values)
        elif isinstance(values[0], (str, bool)) or None in values:
            figures[name] = values[0]
        else:
            figures[name] = statistics.median(values)
    return Figures(**figures)


def newest(peers: Iterable[Peer]) -> Peer | None:
    """The peer that the goals are about."""
    return max(peers, key=lambda each: each.version, default=None)


def row_of(cell: Cell, peers: Sequence[Peer]) -> Row:
    """A row without results."""
    anchor = newest(peers)
    return Row(cell, against=(cell.other or anchor.name) if anchor else None)


def run_round(
    row: Row,
    peers: Sequence[Peer],
    seconds: float,
    number: int = 0,
    progress: Callable[[str], object] = lambda text: None,
) -> None:
    """Run a row's cell once on every broker, newly started; a broker that failed is left out."""
    cell = row.cell
    row.missing = cell.missing()
    if row.missing or (number and cell.once):
        return
    with tempfile.TemporaryDirectory(prefix="appliance-bench-") as directory:
        site = Site(Path(directory))
        site.prepare()
        starts = {OURS: cell.ours(site)}
        if cell.other is None:
            starts |= {each.name: cell.peer(site, each) for each in peers}
        elif anchor := newest(peers):
            starts[cell.other] = cell.peer(site, anchor)
        names = [name for name in starts if name not in row.problems]
        try:
            with contextlib.ExitStack() as stack:
                sides: dict[str, Side] = {}
                progress("starting")
                for name in names:
                    try:
                        sides[name] = stack.enter_context(starts[name])
                    except PeerError as error:
                        row.problems[name] = str(error)
                for name in turn(list(sides), number):
                    progress(name)
                    try:
                        result = sides[name].measure(seconds)
                    except PeerError as error:
                        row.problems[name] = f"{name}: {error}"
                    else:
                        row.runs.setdefault(name, []).append(result)
                progress("stopping")
        except PeerError as error:  # a process that should still run at the end has ended before
            row.problems["end"] = str(error)
        row.note = cell.note(site) or row.note


def turn(names: Sequence[str], number: int) -> list[str]:
    """The names in the order of a round: another one begins each time."""
    first = number % len(names) if names else 0
    return [*names[first:], *names[:first]]


def compare(cell: Cell, peers: Sequence[Peer], seconds: float, rounds: int = ROUNDS) -> Row:
    """The row of one cell after some rounds."""
    row = row_of(cell, peers)
    for number in range(rounds):
        run_round(row, peers, seconds, number)
    return row


def spreads(row: Row, name: str, figures: Iterable[str]) -> Mapping[str, tuple[float, float]]:
    """The spread of each figure that a broker has."""
    found = {figure: row.spread(name, figure) for figure in figures}
    return {figure: spread for figure, spread in found.items() if spread is not None}
