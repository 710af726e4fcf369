"""A few incidents; `python tests/service` has as many as are wanted."""

from __future__ import annotations

from pathlib import Path

from service.trial import ServiceTrial


def test_nothing_acknowledged_is_lost(tmp_path: Path) -> None:
    trial = ServiceTrial(tmp_path, seed=6)
    trial.run(kills=3)
    report = trial.report
    assert not report.problems, f"{report}\n" + "\n".join(report.problems)
    assert dict(trial.happened) == {"killed": 1, "hung": 1, "upgraded": 1}
    assert report.acknowledged > 100, report
    log = trial.broker.log
    assert "did not end by itself: killed, or a power cut" in log
    assert "the last run crashed on" in log and "Fatal Python error: Aborted" in log
