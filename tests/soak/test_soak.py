"""A short soak; `python -m soak` is the long one."""

from __future__ import annotations

from pathlib import Path

import pytest

from soak.run import Report, Soak


@pytest.mark.timeout(180)
def test_random_clients_get_what_they_are_owed(tmp_path: Path) -> None:
    report = Soak(tmp_path, seconds=15, clients=40, rate=60, seed=20260101).run()
    wrong = [str(violation) for violation in report.model.violations[:5]]
    assert report.ok, "\n".join([*wrong, *report.problems, report.table()])
    counts = report.model.counts
    never = [name for name in EXERCISED if not counts[name]]
    assert not never, f"the clients have not done all that they should: {never}\n{report.table()}"


EXERCISED = (
    *("connects", "sessions continued", "cuts", "take-overs", "disconnects", "pauses"),
    *("published 0", "published 1", "published 2", "acknowledged 1", "acknowledged 2"),
    *("delivered 0", "delivered 1", "delivered 2", "delivered again"),
)


def test_memory_that_grows_without_end_is_told() -> None:
    def report(values: list[int]) -> Report:
        made = Report(0, 400, 1, None)  # type: ignore[arg-type]
        made.memory = [(float(second), value << 20) for second, value in enumerate(values)]
        made.check_memory()
        return made

    assert not report([50] * 100 + [100] * 200 + [110] * 100).problems
    assert report([50] * 100 + [100] * 200 + [140] * 100).problems
