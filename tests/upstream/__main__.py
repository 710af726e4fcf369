"""The link to a fleet's broker, for as long as you like::

    python tests/upstream --kills 200                     # mosquitto behind a bad line
    python tests/upstream --kills 50 --fleet rabbitmq --both
    python tests/upstream --kills 50 --fleet appliance --both
    python tests/upstream --outage                        # 8 h at 1 kHz, scaled 1:10, into 64 MiB
    python tests/upstream --outage --size "1 GiB" --messages 9000000 --restarts
    python tests/upstream --late
    python tests/upstream --calls 10000
    python tests/upstream --late --ros --version 3.1.1    # with a real node of ROS
    python tests/upstream --calls 1000 --ros              # and 100 goals
    python tests/upstream --faults 10
    python tests/upstream --faults 10 --fleet appliance   # which looks each second who is silent
    python tests/upstream --hostile 5                     # a fleet's broker that does anything
    python tests/upstream --links 200                     # one RabbitMQ is killed and started

The exit code is 1 when anything is wrong, 2 when a program is missing. The seed that is printed
determines what is done, but not its timing. With `--device mosquitto` mosquitto's bridge is tried
in place of the appliance, which shows that the programs find what is lost.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from upstream.calls import Calls
from upstream.faults import Faults
from upstream.hostile_fleet import HostileFleet
from upstream.kills import FLEETS, Kills
from upstream.late_commands import LateCommands
from upstream.outage import Outage
from upstream.reconnects import Reconnects

#: Problems that are told in full.
SHOWN = 20

#: What is tried.
DEVICES = ("appliance", "mosquitto", "mosquitto311")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python tests/upstream",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--kills", type=int, metavar="N", help="kill at random so often, under load")
    what.add_argument("--outage", action="store_true", help="fill the backlog, then drain it")
    what.add_argument("--faults", type=float, metavar="MINUTES", help="random faults of the line")
    what.add_argument("--hostile", type=float, metavar="MINUTES", help="a hostile fleet's broker")
    what.add_argument("--late", action="store_true", help="commands over a line that is silent")
    what.add_argument("--calls", type=int, metavar="N", help="calls from the fleet")
    what.add_argument("--links", type=int, metavar="N", help="so many reconnect at once")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--device", choices=DEVICES, default="appliance")
    parser.add_argument(
        "--fleet",
        choices=FLEETS,
        help="with --kills, --faults, --links (default: mosquitto; with --links, rabbitmq)",
    )
    kills = parser.add_argument_group("with --kills")
    who = kills.add_mutually_exclusive_group()
    who.add_argument("--both", action="store_true", help="kill the fleet's broker, too")
    who.add_argument("--nobody", action="store_true", help="only cut the line")
    outage = parser.add_argument_group("with --outage")
    outage.add_argument("--messages", type=int, default=2_880_000, help="(default: 2,880,000)")
    outage.add_argument("--payload", type=int, default=100, help="bytes (default: 100)")
    outage.add_argument("--size", default="64 MiB", help="of the backlog (default: 64 MiB)")
    outage.add_argument("--rate", type=float, help="messages a second (default: what it takes)")
    outage.add_argument(
        "--restarts", action="store_true", help="kill it with all that waiting: CONNECT within 1 s"
    )
    outage.add_argument("--queue", type=int, default=0, help="messages of mosquitto's bridge")
    late = parser.add_argument_group("with --late")
    late.add_argument("--silence", type=float, default=10.0, help="seconds (default: 10)")
    late.add_argument("--version", choices=("5", "3.1.1"), default="5", help="of MQTT, with --ros")
    parser.add_argument("--ros", action="store_true", help="--late, --calls: with nodes of rclpy")
    return parser.parse_args(arguments)


def program(options: argparse.Namespace, directory: Path, say: Callable[[str], None]) -> Any:
    """What is to be run: `run()` returns its report."""
    common: dict[str, Any] = {"device": options.device, "say": say}
    if options.kills is not None:
        victims = "both" if options.both else "nobody" if options.nobody else "device"
        fleet = options.fleet or "mosquitto"
        kills = Kills(directory, options.seed, fleet=fleet, victims=victims, **common)
        return lambda: kills.run(options.kills)
    if options.links is not None:
        fleet = options.fleet or "rabbitmq"
        return Reconnects(directory, links=options.links, fleet=fleet, say=say).run
    if options.outage:
        return Outage(
            directory,
            messages=options.messages,
            payload=options.payload,
            size=options.size,
            rate=options.rate,
            restarts=options.restarts,
            queue=options.queue,
            **common,
        ).run
    if options.faults is not None:
        fleet = options.fleet or "mosquitto"
        seconds = options.faults * 60
        return Faults(directory, options.seed, seconds=seconds, fleet=fleet, **common).run
    if options.hostile is not None:
        seconds = options.hostile * 60
        return HostileFleet(directory, options.seed, seconds=seconds, say=say).run
    if options.ros:
        return ros_program(options, directory, common)
    if options.late:
        return LateCommands(directory, silence=options.silence, **common).run
    return Calls(directory, count=options.calls, **common).run


def ros_program(options: argparse.Namespace, directory: Path, common: dict[str, Any]) -> Any:
    """The same where the robot's side is in ROS, which is imported only then."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "ros"))
    from upstream.ros_trials import RosCalls, RosCommands

    if options.calls is not None:
        return RosCalls(directory, count=options.calls, **common).run
    late = RosCommands(directory, silence=options.silence, version=options.version, **common)
    return late.run


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    print(f"seed {options.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="upstream-") as directory:
        try:
            run = program(options, Path(directory), lambda line: print(line, flush=True))
            report = run()
        except pytest.skip.Exception as missing:
            print(missing)
            return 2
    for problem in report.problems[:SHOWN]:
        print(problem)
    print(report)
    return 1 if report.problems else 0


if __name__ == "__main__":
    sys.exit(main())
