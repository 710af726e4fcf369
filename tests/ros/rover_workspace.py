"""A workspace with an interface package of its own, rover_msgs, built for a test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from appliance.host.environment import for_other_programs

DEFINITIONS = {
    "Wheel": "uint8 LEFT=1\nuint8 side\nfloat32[<=4] slip\n",
    "Drive": """\
std_msgs/Header header
string<=16 mode "idle"
float64[2] speed
Wheel[] wheels
uint8[] blob
""",
}


DRIVE = "rover_msgs/msg/Drive"


#: What it takes beside what CDR says of itself: {"mode": "go", "wheels": [{"side": 1}], …}
VALUE = {
    "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "base"},
    "mode": "go",
    "speed": [0.5, -0.5],
    "wheels": [{"side": 1, "slip": [0.25]}],
    "blob": "AAEC",
}


def build_workspace(folder):
    """Build the package rover_msgs; returns its install prefix."""
    source, prefix = folder / "rover_msgs", folder / "install"
    (source / "msg").mkdir(parents=True)
    for name, text in DEFINITIONS.items():
        (source / f"msg/{name}.msg").write_text(text)
    builder = Path(__file__).parent / "interfaces.py"
    arguments = [source, prefix, "rover_msgs", "std_msgs", "builtin_interfaces"]
    built = subprocess.run(
        [sys.executable, builder, *arguments],
        env=for_other_programs(),
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return prefix
