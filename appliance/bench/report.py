"""Reports measurements: as tables for people, as JSON for machines."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from appliance.bench.cells import Cell, Row
from appliance.bench.growth import Figures, GrowthRow, Statement
from appliance.bench.peers import LIMITS

HEADINGS = {
    "cpu_us": "CPU µs a message",
    "rate": "messages/s",
    "p50_us": "p50 µs",
    "p99_us": "p99 µs",
    "beside_us": "p99 µs of another client",
    "memory_kib": "KiB",
}
WIDTH_ELSEWHERE = 200  # where the output is no terminal: lines are not wrapped
LIMITS_NOTE = (
    "Limits of this broker that mosquitto has not, or does not meet here, were raised out of reach "
    f"(broker.limits: {', '.join(LIMITS)})."
)


def to_json(
    rows: Sequence[Row],
    grown: Sequence[GrowthRow],
    peer: str | None,
    seconds: float,
    repeats: int,
) -> str:
    """All figures, ratios and goals, with where and how they were measured."""
    return json.dumps(
        {
            "peer": peer,
            "seconds": seconds,
            "repeats": repeats,
            "cores": os.cpu_count(),
            "machine": platform.machine(),
            "python": platform.python_version(),
            "limits": LIMITS,
            "rows": [
                {
                    "cell": row.cell.name,
                    "title": row.cell.title,
                    "ours": asdict(row.ours) if row.ours else None,
                    "peer": asdict(row.peer) if row.peer else None,
                    "ratios": {figure: row.ratio(figure) for figure in HEADINGS},
                    "goals": dict(row.cell.goals),
                    "at_least": dict(row.cell.at_least),
                    "at_most": dict(row.cell.at_most),
                    "met": row.met,
                    "note": row.note,
                    "problem": row.problem,
                    "missing": row.missing,
                }
                for row in rows
            ],
            "growth": [
                {
                    "cell": row.cell.name,
                    "title": row.cell.title,
                    "size": row.cell.size,
                    "ours": row.ours,
                    "peer": row.peer,
                    "statements": [
                        {
                            "figure": each.figure,
                            "title": each.title,
                            "unit": each.unit,
                            "at_most": each.most,
                            "reached": each.reached(row.ours),
                            "reached_by_peer": each.reached(row.peer),
                        }
                        for each in row.cell.statements
                    ],
                    "reached": row.reached,
                    "problem": row.problem,
                    "missing": row.missing,
                }
                for row in grown
            ],
        },
        indent=2,
    )


def number(value: float | None) -> str:
    """A number with a sensible count of digits."""
    if value is None:
        return ""
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}"


def table(rows: Sequence[Row], peer: str | None) -> Table:
    """One line a figure: ours, the peer's, the ratio, the goal. CPU time first: it varies least."""
    result = Table(title=f"appliance and {peer}" if peer else "appliance")
    result.add_column("cell")
    result.add_column("figure")
    result.add_column("appliance", justify="right")
    if peer:
        result.add_column(peer.partition(" ")[0], justify="right")
        result.add_column("ratio", justify="right")
        result.add_column("goal", justify="right")
        result.add_column("")
    for row in rows:
        title = row.cell.title
        for figure, heading in HEADINGS.items():
            ours, theirs = (getattr(each, figure, None) for each in (row.ours, row.peer))
            if ours is None and theirs is None:
                continue
            ratio = row.ratio(figure)
            cells = [title, heading, number(ours)]
            if peer:
                cells += [number(theirs), f"{ratio:.2f}" if ratio is not None else ""]
                cells += [goals(row.cell, figure), verdict(row.meets(figure))]
            result.add_row(*cells)
            title = ""
        for name, figures in (("appliance", row.ours), (peer or "", row.peer)):
            if figures and figures.lost:
                what = f"{figures.lost} of {figures.messages + figures.lost}"
                result.add_row(title, f"[red]lost by {name.partition(' ')[0]}[/red]", what)
                title = ""
        if row.note:
            result.add_row(title, escape(row.note))
        for note in (row.problem, row.missing):
            if note:
                result.add_row(title, f"[red]{escape(note)}[/red]")
        result.add_section()
    return result


def growth_table(rows: Sequence[GrowthRow], peer: str | None) -> Table:
    """One line a statement: ours, the peer's, the goal, and whether ours has reached it."""
    result = Table(title="what must not grow, and how long others wait")
    result.add_column("")
    result.add_column("appliance", justify="right")
    if peer:
        result.add_column(peer.partition(" ")[0], justify="right")
    result.add_column("goal", justify="right")
    result.add_column("")
    for row in rows:
        result.add_row(f"[bold]{escape(row.cell.title)}[/bold]")
        for each in row.cell.statements:
            cells = [f"· {each.title}", growth_figure(each, row.ours)]
            cells += [growth_figure(each, row.peer)] if peer else []
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


def show(rows: Sequence[Row], grown: Sequence[GrowthRow], peer: str | None) -> None:
    """Print the tables: on a terminal in its width, elsewhere as Markdown without colours."""
    console = Console()
    tables = [table(rows, peer)] if rows else []
    tables += [growth_table(grown, peer)] if grown else []
    if not console.is_terminal:
        console = Console(width=WIDTH_ELSEWHERE, no_color=True)
        for each in tables:
            each.box = box.MARKDOWN
    for each in tables:
        console.print(each)
    if peer:
        console.print(LIMITS_NOTE, highlight=False)
