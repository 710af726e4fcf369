"""python tests/memory [SHAPE …]: prints the growth of memory, and what the limits allow."""

from __future__ import annotations

import argparse
import json
import logging
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from memory.shapes import MIB, MOST, SHAPES, run


def measure(name: str) -> tuple[int, int, int]:
    """`run`, in a process of its own."""
    said = subprocess.run(
        [sys.executable, Path(__file__).parent, "--one", name],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    grown, counted, allowed = json.loads(said)
    return grown, counted, allowed


def main() -> int:
    parser = argparse.ArgumentParser("python tests/memory", description=__doc__)
    parser.add_argument("shapes", nargs="*", metavar="SHAPE", help=f"of: {', '.join(SHAPES)}")
    parser.add_argument("--one", action="store_true", help="in this process, and for machines")
    arguments = parser.parse_args()
    if unknown := set(arguments.shapes) - set(SHAPES):
        parser.error(f"no such shape: {', '.join(sorted(unknown))}; there are {', '.join(SHAPES)}")
    if arguments.one and len(arguments.shapes) != 1:
        parser.error("--one takes one shape")
    if arguments.one:
        logging.disable(logging.CRITICAL)
        print(json.dumps(run(arguments.shapes[0])))
        return 0
    failed = False
    print(f"{'shape':<46} {'grown':>7} {'counted':>8} {'allowed':>8}  (MiB)")
    for name in arguments.shapes or SHAPES:
        grown, counted, allowed = measure(name)
        bad = grown > MOST * allowed
        failed |= bad
        print(
            f"{name:<46} {grown / MIB:>7.1f} {counted / MIB:>8.1f} {allowed / MIB:>8.1f}"
            f"  {grown / max(counted, 1):>6.2f}  {'TOO MUCH' if bad else ''}",
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
