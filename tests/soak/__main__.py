"""The soak from the command line, in the environment that `make test` sets up::

    .venv/bin/python tests/soak --minutes 10 --clients 200

It prints a table. When the broker did anything wrong, the exit code is 1, and each wrong delivery
is reported with all that is known about the message and the session. The printed seed determines
the clients' choices, but not their timing.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from soak.run import Report, Soak

#: Violations that are told in full.
_SHOWN = 10

#: Seconds from which on the memory of a run says something.
_LONG = 240


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python tests/soak",
        description="Random clients against the broker, checked by a model.",
    )
    parser.add_argument("--minutes", type=float, default=10.0, help="how long (default: 10)")
    parser.add_argument("--clients", type=int, default=200, help="how many (default: 200)")
    parser.add_argument(
        "--rate", type=float, default=250.0, help="messages published a second (default: 250)"
    )
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument(
        "--shared",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="shared subscriptions (default: if the broker has them)",
    )
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="soak-") as directory:
        report = Soak(
            Path(directory),
            seconds=options.minutes * 60,
            clients=options.clients,
            rate=options.rate,
            seed=options.seed,
            shared=options.shared,
            say=lambda line: print(line, flush=True),
        ).run()
    if report.seconds >= _LONG:
        report.check_memory()
    return tell(report)


def tell(report: Report) -> int:
    """Print how it went; returns the exit code."""
    print()
    for violation in report.model.violations[:_SHOWN]:
        print(f"{violation}\n")
    for problem in report.problems:
        print(f"{problem}\n")
    print(report.table())
    return 0 if report.ok else 1


if __name__ == "__main__":
    sys.exit(main())
