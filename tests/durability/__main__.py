"""Kills from the command line::

    python tests/durability --kills 500

The exit code is 1 when anything that was acknowledged is lost, or came twice with QoS 2, or when
the appliance did not start. The random moments follow from the seed that is printed.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from durability.harm import HARMS
from durability.ordeal import Ordeal


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python tests/durability", description="Kill the appliance, and see what it keeps."
    )
    parser.add_argument("--kills", type=int, default=500, help="how often (default: 500)")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument(
        "--harm",
        choices=sorted(HARMS),
        help="what is done to the database after each kill: then it only has to start",
    )
    parser.add_argument("--durability", choices=("power", "process"), default="power")
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="durability-") as directory:
        ordeal = Ordeal(
            Path(directory),
            options.seed,
            harm=HARMS[options.harm] if options.harm else None,
            store={"durability": options.durability},
            say=lambda line: print(line, flush=True),
        )
        report = ordeal.run(options.kills)
    for problem in report.problems[:20]:
        print(problem)
    print(report)
    return 1 if report.problems else 0


if __name__ == "__main__":
    sys.exit(main())
