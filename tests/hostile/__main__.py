"""python tests/hostile [--seconds 20] [--only NAME …] [--plain|--tls|--websocket|--both] [--list]

Each attack on a new appliance, over plain TCP, TLS and WebSocket, with a healthy client beside it
that is connected the same way. Prints a table and what is wrong; the exit code is 1 when something
is.
"""

from __future__ import annotations

import argparse
import contextlib
import fnmatch
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from attacks import ATTACKS
from load import BOTH
from server import MIB, Outcome, Server
from witness import Over

_HEAD = (
    f"{'attack':<26} {'over':<9} {'round trip: p50':>15} {'p99':>7} {'max':>7}  "
    f"{'RSS before':>10} {'max':>6} {'bound':>6}  {'log lines':>9} {'on it':>6}"
)


def row(outcome: Outcome) -> str:
    """One line of the table: milliseconds and MiB."""
    seen = outcome.seen
    times = [seen.percentile(0.5) * 1000, seen.percentile(0.99) * 1000, seen.worst * 1000]
    return (
        f"{outcome.attack.name:<26} {outcome.transport:<9} {times[0]:>15.1f} {times[1]:>7.1f} "
        f"{times[2]:>7.1f}  {outcome.base // MIB:>10} {outcome.peak // MIB:>6} "
        f"{outcome.bound // MIB:>6}  {outcome.log_lines:>9} {outcome.matching_lines:>6}"
        f"  {'FAILED' if outcome.problems else 'ok'}"
    )


def main() -> int:
    parser = argparse.ArgumentParser("python tests/hostile", description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each attack")
    parser.add_argument("--only", action="append", metavar="NAME", help="may hold * and ?")
    parser.add_argument("--list", action="store_true", help="what there is, and do nothing")
    ways = parser.add_mutually_exclusive_group()
    for over in Over:
        name = over.name.lower()
        ways.add_argument(f"--{name}", dest="ways", action="store_const", const=[(over,)])
    ways.add_argument("--both", dest="ways", action="store_const", const=[BOTH], help="TLS, plain")
    parser.set_defaults(ways=[(over,) for over in Over])
    arguments = parser.parse_args()
    wanted = arguments.only or ["*"]
    chosen = [
        attack
        for name, attack in ATTACKS.items()
        if any(fnmatch.fnmatch(name, one) for one in wanted)
    ]
    if not chosen:
        parser.error(f"no such attack; there are {', '.join(ATTACKS)}")
    if arguments.list:
        for attack in chosen:
            print(f"{attack.name:<26} {attack.what}")
        return 0
    failed = 0
    print("round trips in ms, memory in MiB")
    print(_HEAD)
    with (
        tempfile.TemporaryDirectory() as directory,
        contextlib.closing(Server(Path(directory))) as server,
    ):
        for attack in chosen:
            for ways in arguments.ways:
                if attack.over is not None and attack.over not in ways:
                    continue
                try:
                    outcome = server.run(attack, ways, arguments.seconds)
                except AssertionError as error:
                    print(f"{error}  FAILED", flush=True)
                    failed += 1
                    continue
                print(row(outcome), flush=True)
                counted = ", ".join(f"{count} {what}" for what, count in outcome.counts.items())
                print(f"    {counted or 'nothing'} in {outcome.seconds:.1f} s")
                for problem in outcome.problems:
                    print("    " + problem.replace("\n", "\n    "), flush=True)
                failed += bool(outcome.problems)
    print(f"{failed} failed" if failed else "all withstood")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
