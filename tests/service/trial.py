"""The service is killed, hung and upgraded under load; then what was acknowledged is added up."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from appliance_process import ACL
from durability.ordeal import BROKER, Ordeal

from service.supervisor import NotifySocket, Supervised

#: Seconds without a sign of life after which the service is taken for hung.
WATCHDOG = 1.0


class ServiceTrial(Ordeal):
    """Each incident is one of `incidents`, in turn; the clients are those of the ordeal.

    killed: SIGKILL. hung: SIGSTOP, until the watchdog ends it. upgraded: SIGTERM, as a restart by
    `appliance install`.
    """

    least = 100

    def __init__(
        self,
        directory: Path,
        seed: int,
        incidents: tuple[str, ...] = ("killed", "hung", "upgraded"),
        *,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        super().__init__(directory, seed, say=say)
        self.broker = Supervised(directory / "service", acl=ACL, broker=BROKER)
        self.happened: Counter[str] = Counter()
        self._incidents = incidents

    def run(self, kills: int) -> object:
        with NotifySocket() as notify:
            assert isinstance(self.broker, Supervised)
            self.broker.supervise(notify, WATCHDOG)
            return super().run(kills)

    def _kill(self) -> None:
        broker = self.broker
        assert isinstance(broker, Supervised)
        incident = self._incidents[self.report.kills % len(self._incidents)]
        ends = {
            "killed": (broker.kill, [-signal.SIGKILL]),
            # All threads' tracebacks are written while these run on, and may end in the middle.
            "hung": (broker.hang, [-signal.SIGABRT, -signal.SIGSEGV]),
            "upgraded": (broker.terminate, [0]),
        }
        end, codes = ends[incident]
        if (ended := end()) not in codes:
            self.report.problems.append(f"{incident}: it ended with {ended}, not {codes[0]}")
        self.happened[incident] += 1
