"""python tests/fuzz [--minutes 10] [--seed N] [--only codec|states|sessions|strangers] [--cases N]

The minutes are shared among the four. Findings are printed, and saved as hex with the seed;
`--only KIND --seed SEED --cases 1` repeats a case of the codec and the states.
"""

from __future__ import annotations

import argparse
import logging
import math
import random
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

import codec
import sessions
import states
import strangers
from codec import Found

#: Seconds between two lines of progress.
PROGRESS = 10.0

IN_PROCESS = {"codec": codec.one_case, "states": states.one_case}
LIVE = {"sessions": sessions.Siege, "strangers": strangers.Strangers}

#: Seconds that an appliance is under siege before another one is, so that what is found can be
#: found again; for strangers all the time, as who cannot come in leaves nothing behind.
AT_ONCE = {"sessions": 60.0, "strangers": math.inf}


def run_cases(
    name: str, one_case: Callable[[random.Random], None], seed: int, seconds: float, cases: int
) -> int:
    """One case a seed, from `seed` on; returns how many found something."""
    end = time.monotonic() + seconds
    told = time.monotonic()
    begin = seed
    found_something = 0
    while time.monotonic() < end and seed - begin < cases:
        try:
            one_case(random.Random(seed))
        except Found as found:
            found_something += 1
            save(name, seed, found)
            if found_something == 10:
                break
        seed += 1
        if time.monotonic() - told > PROGRESS:
            told = time.monotonic()
            print(f"{name}: {seed - begin} cases, {found_something} found", flush=True)
    print(f"{name}: {seed - begin} cases, {found_something} found")
    return found_something


def run_live(name: str, seed: int, seconds: float) -> int:
    """Sessions against a live appliance; returns how often something was found."""
    end = time.monotonic() + seconds
    found_something = 0
    count = 0
    while (left := end - time.monotonic()) > 1 and found_something < 10:
        with tempfile.TemporaryDirectory() as directory:
            siege = LIVE[name](Path(directory))
            try:
                siege.run(random.Random(seed), min(left, AT_ONCE[name]))
            except Found as found:
                found_something += 1
                save(name, seed, found)
            count += siege.count
            heard = siege.canary.heard
        seed += 1
        print(
            f"{name}: {count} sessions, the canary was heard {heard} times, memory "
            f"{siege.base >> 20} MiB soon after the start and {siege.memory >> 20} MiB at the end, "
            f"{found_something} found",
            flush=True,
        )
    return found_something


def save(name: str, seed: int, found: Found) -> None:
    """Print what was found, and write it into a file."""
    directory = Path(tempfile.gettempdir()) / "appliance-fuzz"
    directory.mkdir(exist_ok=True)
    path = directory / f"{name}-{seed}.txt"
    error = found.__cause__
    told = error is None or isinstance(error, Found)
    cause = "" if told else "".join(traceback.format_exception(error))
    said = [data.decode() if name != "codec" else data.hex() for data in found.data]
    path.write_text("\n\n".join([str(found), cause, *said]) + "\n")
    print(f"FOUND {name}, seed {seed}: {found}\n{cause}saved as {path}")
    for data in found.data[-1:]:
        print(f"    {data.hex() if name == 'codec' else data.decode()}"[:5000], flush=True)


def main() -> int:
    parser = argparse.ArgumentParser("python tests/fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--only", action="append", choices=[*IN_PROCESS, *LIVE])
    parser.add_argument("--cases", type=int, default=sys.maxsize, help="of codec and states")
    arguments = parser.parse_args()
    seed = random.SystemRandom().randrange(10**9) if arguments.seed is None else arguments.seed
    print(f"seed {seed}", flush=True)
    logging.disable(logging.CRITICAL)
    wanted = arguments.only or [*IN_PROCESS, *LIVE]
    seconds = arguments.minutes * 60 / len(wanted)
    found = 0
    for name in wanted:
        if name in LIVE:
            found += run_live(name, seed, seconds)
        else:
            found += run_cases(name, IN_PROCESS[name], seed, seconds, arguments.cases)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
