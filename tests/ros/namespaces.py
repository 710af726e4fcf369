"""Networks of a test's own."""

from __future__ import annotations

import subprocess


def has_namespaces() -> bool:
    """Whether network namespaces with interfaces can be made here."""
    try:
        trial = [
            "unshare",
            "-n",
            "ip",
            "link",
            "add",
            "veth1",
            "type",
            "veth",
            "peer",
            "name",
            "veth2",
        ]
        return subprocess.run(trial, capture_output=True).returncode == 0
    except OSError:
        return False
