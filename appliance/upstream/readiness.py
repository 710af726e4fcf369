"""How long a message that the fleet's broker has kept waits for ROS.

A mission that was sent while the robot was off comes as soon as the link is up, which is before
rclpy has started and the robot's nodes have subscribed. It waits, unacknowledged, and what is
behind it too. But a node that is never started must not hold up the others for ever.
"""

from __future__ import annotations

import math
from typing import Final

#: Seconds for which messages wait for ROS: a robot's nodes have started by then.
PATIENCE: Final = 30.0

#: Seconds after which a wait that a connection's end has interrupted begins anew.
FORGOTTEN: Final = 300.0

#: Topics that are remembered as waited for in vain; more are not waited for.
MOST_TOPICS: Final = 1000

WAITS: Final = "waits for ROS"
GIVES_UP: Final = "is published although ROS is not ready"


class Readiness:
    """Judges the messages of a link one after the other; times are in seconds of one clock.

    It outlives connections, and the time of a wait is that of all topics: what waits behind the
    first message has waited as well. After a wait in vain no other one begins for as long, unless a
    node has come after all.
    """

    def __init__(self) -> None:
        self._topic = ""
        #: Until when messages wait, and from when on another wait may begin.
        self._until = self._again_at = -math.inf
        self._waited_at = -math.inf  # the last time, if that was for the message before
        self._given_up: set[str] = set()

    def judge(self, topic: str, obstacle: str, now: float) -> tuple[bool, str]:
        """Whether a message waits, and what is new about that, for the log.

        `obstacle` is why ROS would not get it now, empty when it would.
        """
        waited, before = now < self._waited_at + FORGOTTEN, self._topic
        self._topic, self._waited_at = topic, -math.inf
        if not obstacle:
            if topic in self._given_up:  # its node is there after all, and may come back
                self._given_up.remove(topic)
                self._again_at = -math.inf
            return False, ""
        if topic in self._given_up or len(self._given_up) >= MOST_TOPICS:
            return False, ""
        if not waited and now >= max(self._until, self._again_at):
            self._until = now + PATIENCE
        if now < self._until:
            self._waited_at = now
            return True, "" if waited and topic == before else WAITS
        self._given_up.add(topic)
        self._again_at = now + PATIENCE
        return False, GIVES_UP
