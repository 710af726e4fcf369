"""Reports measurements: as tables for people, as JSON for machines."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from appliance.bench.cells import CPU, Cell
from appliance.bench.comparison import OURS, Row, newest, spreads
from appliance.bench.growth import Figures, GrowthRow, Statement
from appliance.bench.peers import LIMITS, Peer
from appliance.host.build import build

HEADINGS = {
    CPU: "CPU µs a delivered message",
    "rate": "messages/s",
    "p50_us": "p50 µs",
    "p99_us": "p99 µs",
    "beside_us": "p99 µs of another client",
    "memory_kib": "KiB",
}
OTHER_FIGURES = [figure for figure in HEADINGS if figure != CPU]
GOALS_FOR = (2, 1, 0)  # the mosquitto that goals were set for
WIDTH_ELSEWHERE = 240  # where the output is no terminal: lines are not wrapped
RATIO_NOTE = "mosquitto's figure to ours, for a rate ours to mosquitto's: above 1 ours is better."
LIMITS_NOTE = (
    "Limits of this broker that mosquitto has not, or does not meet here, were raised out of reach "
    f"(broker.limits: {', '.join(LIMITS)})."
)


@dataclass(frozen=True, slots=True)
class Report:
    """What was measured, and how."""

    rows: Sequence[Row]
    grown: Sequence[GrowthRow]
    peers: Sequence[Peer]
    seconds: float
    rounds: int

    @property
    def anchor(self) -> Peer | None:
        """The peer that the goals are about."""
        return newest(self.peers)

    def shown_for(self, row: Row, peer: Peer) -> str | None:
        """Whose figures stand in a peer's column: its own, or those of what replaces it."""
        if row.cell.other is None:
            return peer.name
        return row.cell.other if peer == self.anchor else None


def to_json(report: Report) -> str:
    """All figures, spreads, ratios and goals, with where and how they were measured."""
    anchor = report.anchor
    return json.dumps(
        {
            "appliance": build(),
            "peers": [
                {"name": each.name, "version": each.version, "command": each.command}
                for each in report.peers
            ],
            "goals_against": anchor.name if anchor else None,
            "seconds": report.seconds,
            "rounds": report.rounds,
            "cores": os.cpu_count(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "limits": LIMITS,
            "rows": [
                {
                    "cell": row.cell.name,
                    "title": row.cell.title,
                    "ours": _measured(row, OURS),
                    "peers": {
                        name: {
                            **_measured(row, name),
                            "ratios": {figure: row.ratio(figure, name) for figure in HEADINGS},
                        }
                        for name in row.runs
                        if name != OURS
                    },
                    "goals": dict(row.cell.goals),
                    "goals_against": row.against,
                    "at_least": dict(row.cell.at_least),
                    "at_most": dict(row.cell.at_most),
                    "met": row.met,
                    "note": row.note,
                    "problem": row.problem,
                    "missing": row.missing,
                }
                for row in report.rows
            ],
            "growth": [
                {
                    "cell": row.cell.name,
                    "title": row.cell.title,
                    "size": row.cell.size,
                    "ours": row.ours,
                    "peers": dict(row.peers),
                    "statements": [
                        {
                            "figure": each.figure,
                            "title": each.title,
                            "unit": each.unit,
                            "at_most": each.most,
                            "reached": each.reached(row.ours),
                            "reached_by_peers": {
                                name: each.reached(figures) for name, figures in row.peers.items()
                            },
                        }
                        for each in row.cell.statements
                    ],
                    "reached": row.reached,
                    "problem": row.problem,
                    "missing": row.missing,
                }
                for row in report.grown
            ],
        },
        indent=2,
    )


def _measured(row: Row, name: str) -> dict[str, object]:
    """A broker's medians, the lowest and highest of its rounds, and how many rounds it had."""
    figures = row.figures(name)
    return {
        "median": asdict(figures) if figures else None,
        "spread": spreads(row, name, HEADINGS),
        "rounds": len(row.runs.get(name, ())),
    }


def number(value: float | None) -> str:
    """A number with a sensible count of digits."""
    if value is None:
        return ""
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def with_spread(row: Row, name: str | None, figure: str) -> str:
    """A median with the lowest and the highest of the rounds in brackets, if there are several."""
    figures, spread = row.figures(name), row.spread(name, figure)
    shown = number(getattr(figures, figure, None))
    if not shown or spread is None or len(row.runs[name or ""]) == 1:
        return shown
    return f"{shown} ({number(spread[0])}–{number(spread[1])})"


def cpu_table(report: Report) -> Table:
    """One line a cell with the CPU time of a delivered message: the figure that counts."""
    rounds = f"median of {report.rounds} rounds (lowest–highest)"
    heading = HEADINGS[CPU] + (f", {rounds}" if report.rounds > 1 else "")
    result = Table(title=heading)
    result.add_column("cell")
    _add_broker_columns(result, report)
    for row in report.rows:
        if line := _figure_line(report, row, CPU):
            result.add_row(escape(row.cell.title), *line)
    return result


def table(report: Report) -> Table:
    """One line for each of the other figures of a cell, and what is to be said about the cell."""
    result = Table(title="rate, latency and memory")
    result.add_column("cell")
    result.add_column("figure")
    _add_broker_columns(result, report)
    for row in report.rows:
        title = escape(row.cell.title)
        for figure in OTHER_FIGURES:
            if line := _figure_line(report, row, figure):
                result.add_row(title, HEADINGS[figure], *line)
                title = ""
        for name in row.runs:
            figures = row.figures(name)
            if figures and figures.lost:
                what = f"{figures.lost} of {figures.messages + figures.lost}"
                result.add_row(title, f"[red]lost by {escape(name)}[/red]", what)
                title = ""
        if row.note:
            result.add_row(title, escape(row.note))
            title = ""
        for note in (row.problem, row.missing):
            if note:
                result.add_row(title, f"[red]{escape(note)}[/red]")
                title = ""
        result.add_section()
    return result


def _add_broker_columns(result: Table, report: Report) -> None:
    result.add_column(OURS, justify="right")
    for peer in report.peers:
        result.add_column(escape(peer.name), justify="right")
        result.add_column("ratio", justify="right")
    if report.peers:
        result.add_column("goal", justify="right")
        result.add_column("")


def _figure_line(report: Report, row: Row, figure: str) -> list[str] | None:
    """The cells of a figure's line: ours, each peer's with the ratio, goal, verdict."""
    line = [with_spread(row, OURS, figure)]
    for peer in report.peers:
        name = report.shown_for(row, peer)
        ratio = row.ratio(figure, name) if name else None
        line += [with_spread(row, name, figure), f"{ratio:.2f}" if ratio is not None else ""]
    if not any(line):
        return None
    if report.peers:
        line += [goals(row.cell, figure), verdict(row.meets(figure))]
    return line


def growth_table(report: Report) -> Table:
    """One line a statement: ours, the peers', the goal, and whether ours has reached it."""
    result = Table(title="what must not grow, and how long others wait")
    result.add_column("")
    result.add_column(OURS, justify="right")
    for peer in report.peers:
        result.add_column(escape(peer.name), justify="right")
    result.add_column("goal", justify="right")
    result.add_column("")
    for row in report.grown:
        result.add_row(f"[bold]{escape(row.cell.title)}[/bold]")
        for each in row.cell.statements:
            cells = [f"· {each.title}", growth_figure(each, row.ours)]
            cells += [growth_figure(each, row.peers.get(peer.name)) for peer in report.peers]
            cells += [
                "" if each.most is None else f"≤ {each.most:g} {each.unit}" if each.most else "0"
            ]
            result.add_row(*cells, reached(each.reached(row.ours)))
        for note in (row.problem, row.missing):
            if note:
                result.add_row(f"[red]{escape(note)}[/red]")
        result.add_section()
    return result


def growth_figure(statement: Statement, figures: Figures | None) -> str:
    """A figure with its unit, and its note in brackets."""
    if figures is None or statement.figure not in figures:
        return ""
    value = figures[statement.figure]
    shown = number(value) if statement.unit not in ("×", "s", "") else f"{value:.2f}"
    note = f" ({statement.note.format_map(figures)})" if statement.note else ""
    return (f"{shown} {statement.unit}" if statement.unit else f"{value:,.0f}") + note


def reached(verdict: bool | None) -> str:
    """Whether a statement's goal is reached, in words."""
    if verdict is None:
        return ""
    return "[green]reached[/green]" if verdict else "[red]not reached[/red]"


def goals(cell: Cell, figure: str) -> str:
    """The goals of a figure: of the ratio, and of ours."""
    texts = [
        f"{sign} {text}"
        for sign, text in (
            ("≥", f"{cell.goals.get(figure, 0):.3g}"),
            ("appliance ≥", number(cell.at_least.get(figure))),
            ("appliance ≤", number(cell.at_most.get(figure))),
        )
        if text not in ("", "0")
    ]
    return ", ".join(texts)


def verdict(met: bool | None) -> str:
    """Whether a figure meets its goals, in words."""
    if met is None:
        return ""
    return "[green]met[/green]" if met else "[red]not met[/red]"


def show(report: Report) -> None:
    """Print the tables: on a terminal in its width, elsewhere as Markdown without colours."""
    console = Console()
    tables = [each for each in (cpu_table(report), table(report)) if each.row_count]
    tables += [growth_table(report)] if report.grown else []
    if not console.is_terminal:
        console = Console(width=WIDTH_ELSEWHERE, no_color=True)
        for each in tables:
            each.box = box.MARKDOWN
    for each in tables:
        console.print(each)
    console.print(f"Measured: {build()}.", highlight=False)
    if (anchor := report.anchor) is None:
        return
    console.print(f"Ratio: {RATIO_NOTE}", highlight=False)
    if anchor.version < GOALS_FOR:
        wanted = ".".join(map(str, GOALS_FOR[:2]))
        console.print(
            f"The goals are those against mosquitto {wanted}, built with optimisation;"
            f" {anchor.name} is older, and slower in most of them.",
            highlight=False,
            markup=False,
        )
    elif len(report.peers) > 1:
        console.print(f"The goals are against {anchor.name}.", highlight=False, markup=False)
    console.print(LIMITS_NOTE, highlight=False)
