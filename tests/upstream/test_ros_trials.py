"""A fleet, a bad line, the appliance and rclpy: nothing late moves the robot, calls are answered.

Short forms of `python tests/upstream --late --ros` and `--calls N --ros`.
"""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from ros_domain import isolated_domain

from upstream import late_commands
from upstream.ros_trials import RosCalls, RosCommands

__all__ = ["isolated_domain"]

pytestmark = pytest.mark.usefixtures("isolated_domain")


def test_no_late_command_reaches_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of QoS 0 and 1, over a line that is silent, and while it is away."""
    for name in ("STEADY", "SETTLING"):
        monkeypatch.setattr(late_commands, name, 0.5)
    trial = RosCommands(tmp_path, silence=1.5, rounds=1)
    report = trial.run()
    # The rest is a matter of times, which a busy computer cannot keep.
    assert [each for each in report.problems if "CAME" in each] == []
    assert report.came and trial.stops


def test_calls_and_goals_of_a_fleet_are_answered(tmp_path: Path) -> None:
    report = RosCalls(tmp_path, count=20, others=2, goals=5).run()
    assert report.problems == []
    assert report.calls == report.answers == 27
