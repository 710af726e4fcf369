"""Incidents from the command line::

    python tests/service --incidents 60
    python tests/service --incidents 60 --package dist/appliance_0.1.0_amd64.deb --root /tmp/debian

The first lets a supervisor of the tests do what systemd does; the second boots a Debian with real
systemd, as root, and needs systemd-container and, to make the root, debootstrap. The exit code is 1
when anything that was acknowledged is lost, or came twice with QoS 2.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from service.machine import MachineTrial, Service, booted, make_root
from service.trial import ServiceTrial


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python tests/service", description="Kill, hang and upgrade the service under load."
    )
    parser.add_argument("--incidents", type=int, default=60, help="how many (default: 60)")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--package", type=Path, help="the Debian package, for real systemd")
    parser.add_argument("--root", type=Path, help="where its Debian is, or is made")
    options = parser.parse_args()
    if (options.package is None) is not (options.root is None):
        parser.error("--package and --root belong together")
    with tempfile.TemporaryDirectory(prefix="service-") as directory:
        say = lambda line: print(line, flush=True)  # noqa: E731
        if options.package is None:
            trial: ServiceTrial | MachineTrial = ServiceTrial(
                Path(directory), options.seed, say=say
            )
            trial.run(options.incidents)
        else:
            trial = MachineTrial(Path(directory), options.seed, say)
            make_root(options.root)
            with booted(options.root) as machine:
                service = Service(Path(directory), machine, options.root, options.package)
                machine.enter_network()
                trial.run_with(service, options.incidents)
    for problem in trial.report.problems[:20]:
        print(problem)
    print(", ".join(f"{count} {name}" for name, count in trial.happened.items()))
    print(trial.report)
    return 1 if trial.report.problems else 0


if __name__ == "__main__":
    sys.exit(main())
