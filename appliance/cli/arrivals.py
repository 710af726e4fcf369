"""When messages come, and how many a second: the columns of `appliance sub --rate`."""

from __future__ import annotations

import time
from collections import OrderedDict, deque
from collections.abc import Callable
from datetime import datetime
from typing import Final

#: Messages of a topic over which its rate is measured, and topics that are remembered.
MESSAGES: Final = 50
TOPICS: Final = 10_000


class Arrivals:
    """Notes arrivals by topic; the topic that was silent for longest is forgotten first."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._times: OrderedDict[str, deque[float]] = OrderedDict()

    def note(self, topic: str) -> str:
        """The local time and the topic's messages a second, now that one of it has come; of the
        first there is no rate."""
        times = self._times.setdefault(topic, deque(maxlen=MESSAGES))
        self._times.move_to_end(topic)
        if len(self._times) > TOPICS:
            self._times.popitem(last=False)
        times.append(self._clock())
        took = times[-1] - times[0]
        rate = f"{(len(times) - 1) / took:.1f}" if took > 0 else "-"
        return f"{datetime.now().astimezone():%H:%M:%S.%f}"[:-3] + f" {rate:>7} Hz"
