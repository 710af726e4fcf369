"""The robot's side of a try: the appliance with a link, or mosquitto with its bridge.

Both carry `r2d2/events/#`, `r2d2/state/#` out to `fleet/r2d2/…`, and `r2d2/cmd_vel` and
`r2d2/mission/#` in. The second one is there to see that the programs find what is lost.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import psutil
import yaml
from appliance_process import ROBOT, ApplianceProcess

from upstream.peers import HOST, PASSWORD, USER, MosquittoBridge

HERE = f"{ROBOT}/"
THERE = f"fleet/{ROBOT}/"

#: Of the link in appliance.yaml, and of its identity in the access rules.
LINK = "fleet"
LINK_USER = "upstream"

#: Of the fleet's clients that the link has in its own access rules.
ACL = f"""\
user alice
topic readwrite {{robot}}/#
topic read $SYS/#

user {LINK_USER}
topic readwrite {{robot}}/#
"""

#: Queues that never run full here: what waits for the fleet is what is tried.
LIMITS = {
    "queue_messages": 1_000_000,
    "queue_bytes": "256 MiB",
    "memory": "512 MiB",
    "publish_rate": 1_000_000,
    "connection_rate": 1000,
}

OUT: Sequence[Mapping[str, Any]] = (
    {"topic": "events/#", "keep": "all"},
    {"topic": "alarms/#", "keep": "all", "priority": "high"},
    {"topic": "state/#", "keep": "latest"},
)
IN: Sequence[Mapping[str, Any]] = (
    {"topic": "cmd_vel", "late": "500 ms"},
    {"topic": "mission/#", "offline": "keep"},
    {"topic": "+/_call", "late": "10 s"},
)


def links(config: Path) -> list[dict[str, Any]]:
    """What `appliance upstream` says; AssertionError when it does not answer."""
    command = [sys.executable, "-m", "appliance", "upstream", "--json", "-c", str(config)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    # 1: a link is down.
    assert done.returncode in (0, 1) and done.stdout, f"{' '.join(command)}: {done.stderr}"
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


class Device(ABC):
    """What is tried."""

    name: str
    #: Of its local clients; None where anonymous clients may do everything.
    user: str | None
    password: str | None
    #: The most that it has in flight, and the seconds that it may forget acknowledgements of.
    window: int
    linger: float
    process: ApplianceProcess | MosquittoBridge

    @property
    def port(self) -> int:
        """Of local clients; another one after each start."""
        return self.process.plain_port

    @property
    def log(self) -> str:
        return self.process.log

    def stop(self) -> None:
        self.process.stop()

    @abstractmethod
    def start(self) -> None: ...

    @abstractmethod
    def kill(self) -> None: ...

    @abstractmethod
    def memory(self) -> int:
        """Bytes in memory now."""

    @abstractmethod
    def status(self) -> dict[str, Any] | None:
        """Of the link, as `appliance upstream --json` has it; None where there is no such thing."""


class ApplianceDevice(Device):
    """`appliance run` as a user starts it, with one entry of `upstreams`."""

    name = "appliance"
    linger = 1.0

    def __init__(
        self,
        directory: Path,
        remote: int,
        *,
        window: int = 100,
        link: Mapping[str, Any] | None = None,
        broker: Mapping[str, Any] | None = None,
        bridge: Mapping[str, Any] | None = None,
    ) -> None:
        self.window = window
        self.process = ApplianceProcess(
            directory, acl=ACL, broker={"limits": LIMITS, **(broker or {})}, bridge=bridge
        )
        self.user = "alice"
        self.password = self.process.passwords["alice"]
        secret = directory / "fleet.password"
        secret.touch(0o600)
        secret.write_text(PASSWORD)
        settings = yaml.safe_load(self.process.config.read_text())
        settings["upstreams"] = [
            {
                "name": LINK,
                "servers": [f"mqtt://{HOST}:{remote}"],
                "user": LINK_USER,
                "login": {"username": USER, "password_file": str(secret)},
                "keep_alive": "5 s",
                "window": window,
                "out": [dict(rule) for rule in OUT],
                "in": [dict(rule) for rule in IN],
                **(link or {}),
            }
        ]
        self.process.config.write_text(yaml.safe_dump(settings))
        self.database = directory / "state/store.db"

    def start(self) -> None:
        self.process.start()

    def kill(self) -> None:
        process, self.process._process = self.process._process, None
        if process is not None:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            assert self.process._reader is not None
            self.process._reader.join()

    def memory(self) -> int:
        return psutil.Process(self.process.pid).memory_info().rss

    def status(self) -> dict[str, Any] | None:
        """AssertionError when the command fails: it has to answer whenever the appliance runs."""
        (found,) = [each for each in links(self.process.config) if each["name"] == LINK]
        return found


class BridgeDevice(Device):
    """mosquitto's bridge; what it may lose when it is killed is what it has not saved."""

    name = "mosquitto"
    user = None
    password = None
    linger = 1.0

    def __init__(
        self,
        directory: Path,
        remote: int,
        *,
        window: int = 100,
        version: str = "mqttv50",
        options: str = "",
    ) -> None:
        self.window = window
        topics = [f"{each}# out 1 {HERE} {THERE}" for each in ("events/", "state/", "alarms/")] + [
            f"{each} in 1 {HERE} {THERE}" for each in ("cmd_vel", "mission/#", "+/_call")
        ]
        self.process = MosquittoBridge(
            directory, remote, topics, window=window, version=version, options=options
        )

    def start(self) -> None:
        # A socket of the killed one may still be there, so that its port is not free at once.
        deadline = time.monotonic() + 10
        while True:
            with contextlib.suppress(AssertionError):
                self.process.start()
                return
            assert time.monotonic() < deadline, self.process.log[-2000:]

    def kill(self) -> None:
        self.process.kill()

    def restart(self) -> None:
        """End it so that it saves what it has, and start it again."""
        self.process.stop()
        self.start()

    def memory(self) -> int:
        return self.process.memory()

    def status(self) -> dict[str, Any] | None:
        return None


def count(status: Mapping[str, Any] | None, name: str) -> int | None:
    """`dropped` or `waiting` of a link's status, added up if they are told by rule or lane."""
    value = (status or {}).get(name)
    while isinstance(value, Mapping):
        if "messages" in value:
            value = value["messages"]
        else:
            return sum(count(value, key) or 0 for key in value)
    return int(value) if isinstance(value, (int, float)) else None
