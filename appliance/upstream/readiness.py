"""How long a message that the fleet's broker has kept waits for ROS.

A mission that was sent while the robot was off comes as soon as the link is up, which is before
rclpy has started and the robot's nodes have subscribed. It waits, unacknowledged, and what is
behind it too. But a node that is never started must not hold up the others for ever.
"""

from __future__ import annotations

from typing import Final

#: Seconds for which the messages to a topic wait for ROS: a robot's nodes have started by then.
PATIENCE: Final = 30.0

#: Topics that are remembered as waited for in vain; more are not waited for.
MOST_TOPICS: Final = 1000

WAITS: Final = "waits for ROS"
GIVES_UP: Final = "is published although ROS is not ready"


class Readiness:
    """Judges messages one after the other; times are in seconds of one clock."""

    def __init__(self) -> None:
        self._topic = ""
        self._since: float | None = None
        self._given_up: set[str] = set()

    def judge(self, topic: str, obstacle: str, now: float) -> tuple[bool, str]:
        """Whether a message waits, and what is new about that, for the log.

        `obstacle` is why ROS would not get it now, empty when it would.
        """
        if self._topic != topic:
            self._topic, self._since = topic, None
        if not obstacle:
            self._since = None
            self._given_up.discard(topic)
            return False, ""
        if topic in self._given_up or len(self._given_up) >= MOST_TOPICS:
            return False, ""
        if self._since is None:
            self._since = now
            return True, WAITS
        if now - self._since < PATIENCE:
            return True, ""
        self._since = None
        self._given_up.add(topic)
        return False, GIVES_UP
