"""An appliance in a container, as docs/container.md starts it, and a client of it."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass

from container.engine import Engine, run

ROBOT = "r2d2"
CONFIGURATION, DATA = "/etc/appliance", "/var/lib/appliance"

#: In the log for each listener that is open.
LISTENING = r"listening .*on \S+:\d+$"
LISTENERS = 3  # of the configuration that `init` writes


def volumes(name: str, configuration: str = "", data: str = "") -> list[str]:
    """Options that mount both volumes, with these options behind them."""
    return [
        *("--volume", f"{name}-configuration:{CONFIGURATION}{configuration}"),
        *("--volume", f"{name}-data:{DATA}{data}"),
    ]


@dataclass
class Container:
    """One appliance, in a container of that name with volumes of its own."""

    engine: Engine
    image: str
    name: str = "first"
    password: str = ""

    def start(self, *options: str, volumes: list[str] | None = None) -> None:
        """Start a container, and return when it answers."""
        self.engine.run(
            *("--detach", "--name", self.name, *(volumes or self.volumes)),
            *("--env", f"APPLIANCE_ROBOT={ROBOT}", *options, self.image),
        )
        self.wait()
        found = re.findall(r"^user operator, password (\w{20})$", self.log, re.MULTILINE)
        self.password = "".join(found) or self.password

    @property
    def volumes(self) -> list[str]:
        return volumes(self.name)

    @property
    def log(self) -> str:
        return self.engine.podman("logs", self.name)

    def wait(self, starts: int = 1) -> None:
        """Return when it has opened its listeners so many times."""
        self.engine.wait_for(self.name, LISTENING, starts * LISTENERS)

    def remove(self) -> None:
        """Remove the container, not the volumes."""
        self.engine.podman("rm", "--force", "--time", "0", self.name)

    def stop(self) -> float:
        """End it by SIGTERM; returns how many seconds that took."""
        before = time.monotonic()
        self.engine.podman("stop", "--time", "60", self.name)
        return time.monotonic() - before

    @property
    def exit_code(self) -> int:
        return int(self.engine.inspect(self.name)["State"]["ExitCode"])

    def mosquitto(self, program: str, *words: str) -> str:
        """mosquitto's client over TLS, as the first user, in the network of the containers."""
        ca = self.engine.folder(f"{self.name}-configuration") / "certs/ca.crt"
        login = ("-h", "localhost", "-p", "8883", "--cafile", ca, "-u", "operator")
        return run(self.engine.command(f"mosquitto_{program}", *login, "-P", self.password, *words))

    def publish(self, topic: str, text: str) -> None:
        """Publish it, and return when it is acknowledged."""
        self.mosquitto("pub", "-q", "1", "-t", f"{ROBOT}/{topic}", "-m", text)

    def kept_through_a_kill(self, messages: int) -> int:
        """How many messages for an absent client are there after SIGKILL and a start."""
        session = ("-i", "absent", "-c", "-q", "1", "-t", f"{ROBOT}/cmd_vel")
        self.mosquitto("sub", *session, "-E")
        sent = [f"{number}" for number in range(messages)]
        for text in sent:
            self.publish("cmd_vel", text)
        starts = len(re.findall(LISTENING, self.log, re.MULTILINE)) // LISTENERS
        self.engine.podman("kill", "--signal", "KILL", self.name)
        self.engine.podman("wait", self.name)
        self.engine.podman("start", self.name)
        self.wait(starts + 1)
        received = self.mosquitto("sub", *session, "-C", f"{messages}", "-W", "30").split()
        return len({*sent} & {*received})
