"""An appliance that was installed somewhere else than where the tests run: in another root, for
another Python, on another kind of computer. mosquitto's clients, from here, speak with it."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import yaml
from appliance_process import HOST, ROBOT, BrokerProcess
from waiting import PATIENCE

LISTENING = r"listening on \S+:(\d+)$"

#: Seconds for what takes seconds, on a computer that is slow as `PATIENCE` has it.
START = 4 * PATIENCE


class InstalledAppliance(BrokerProcess):
    """`appliance init` and `appliance run` of an installation, with TLS on loopback.

    `command` is the command line that runs `appliance` there; `inside` is the name that
    `directory` has there. alice may do everything with the robot's topics.
    """

    name = "the installed appliance"

    def __init__(
        self,
        directory: Path,
        command: list[str],
        bridge: Mapping[str, object],
        *,
        inside: str = "",
        environment: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(directory)
        self.environment = dict(environment or {})
        self._command = command
        inside = inside or str(directory)
        self.config = f"{inside}/appliance.yaml"
        told = self.call("init", "--dir", inside, "--robot", ROBOT, "--user", "alice")
        found = re.search(r"user alice, password (\S+)", told)
        assert found is not None, told
        self.passwords = {"alice": found[1]}
        self.configure(bridge)
        (directory / "acl.conf").write_text(f"user alice\ntopic readwrite {ROBOT}/#\n")

    def configure(self, bridge: Mapping[str, object], port: int = 0) -> None:
        """Write the settings for the next start."""
        file = self.directory / "appliance.yaml"
        settings = yaml.safe_load(file.read_text())
        settings["broker"] = {"listeners": [{"bind": f"127.0.0.1:{port}", "tls": True}]}
        settings["bridge"] = dict(bridge)
        settings["reload_on_change"] = False
        file.write_text(yaml.safe_dump(settings))

    def call(self, *arguments: str) -> str:
        """What a command of the installation prints."""
        done = subprocess.run(
            [*self._command, *arguments],
            env={**os.environ, **self.environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=START,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    def start(self) -> None:
        before = len(re.findall(LISTENING, self.log, re.MULTILINE))
        self._run([*self._command, "run", "-c", self.config])
        try:
            self.wait_for_log(LISTENING, before + 1, timeout=START)
        except AssertionError:
            self.stop()
            raise
        self.port = int(re.findall(LISTENING, self.log, re.MULTILINE)[-1])

    def mosquitto(self, program: str, *arguments: str, password: str = "") -> list[str]:
        """The command line of `mosquitto_sub` or `mosquitto_pub`, over TLS."""
        command = shutil.which(f"mosquitto_{program}")
        assert command is not None
        login = ["-h", HOST, "-p", f"{self.port}", "--cafile", str(self.ca), "-u", "alice"]
        return [command, *login, "-P", password or self.passwords["alice"], *arguments]

    def publish(self, topic: str, text: str, *options: str) -> None:
        command = self.mosquitto("pub", "-t", topic, "-m", text, *options)
        subprocess.run(command, check=True, timeout=2 * PATIENCE)


@contextmanager
def subscribed(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    """mosquitto_sub once it has subscribed; `messages` are what it receives from there on."""
    at_once = ("stdbuf", "-oL")  # else what it says stays in its buffer
    options = ("-d", "-W", "100")
    listener = subprocess.Popen([*at_once, *command, *options], stdout=subprocess.PIPE, text=True)
    assert listener.stdout is not None
    try:
        assert any(line.startswith("Subscribed") for line in listener.stdout)
        yield listener
    finally:
        listener.kill()
        listener.communicate()


def messages(listener: subprocess.Popen[str]) -> list[str]:
    """What it receives until it ends, without what `-d` says of packets."""
    said = listener.communicate(timeout=2 * PATIENCE)[0].splitlines()
    return [line for line in said if not line.startswith("Client ")]


def next_line(process: subprocess.Popen[str], again: Callable[[], object]) -> str:
    """The next line that a node prints, while something is done again: it does not tell when it
    has subscribed."""
    lines: list[str] = []
    output = process.stdout
    assert output is not None
    reader = threading.Thread(target=lambda: lines.append(output.readline()), daemon=True)
    reader.start()
    deadline = time.monotonic() + 2 * PATIENCE
    while reader.is_alive():
        assert time.monotonic() < deadline, f"{process.args} hears nothing"
        again()
        reader.join(0.2)
    return lines[0].rstrip("\n")
