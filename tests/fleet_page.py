"""docs/fleet.md is typed from its beginning to its end: a fleet's broker, two robots, an operator.

Its files are written as the page shows them, and its lines run in the page's order, in an empty
folder. What is changed: ports, which have to be free ones, and mosquitto's user where that is root.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sysconfig
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from appliance_process import free_ports
from pages import PROJECT, Page
from ros_domain import isolated_domain
from waiting import PATIENCE, eventually

__all__ = ["isolated_domain"]

PAGE = Page("docs/fleet.md", (PROJECT / "docs/fleet.md").read_text())

#: They run until they are stopped, and what they say when they serve.
ENDLESS = {
    "cd broker && mosquitto": " running",
    "appliance demo ": "Ctrl-C here ends everything",
    "appliance run ": "connected to mqtts://",
}

#: Ports that the page names; the demo's are in its environment.
PORTS = ("8884", "9883", "9884", "9443")

#: What is another number each time.
VARIES = r"(?<= )\d+(?= s )|(?<=  )\d+$|(?<=[ :'])\d+(\.\d+)?(?= m from| B |\))"


def steps() -> Iterator[tuple[str, str]]:
    """A file's text, or a command line with what the page shows below it; in the page's order."""
    for language, block in re.findall(r"^```(\w+)\n(.*?)^```$", PAGE.text, re.M | re.S):
        if language == "sh":
            yield from ((line, "") for line in block.splitlines())
        elif language == "console":
            for part in re.split(r"^\$ ", block, flags=re.M)[1:]:
                line, _, answer = part.partition("\n")
                yield line, answer
        elif block.startswith("# "):
            yield "", block


class Folder:
    """The folder in which the page is typed."""

    def __init__(self, path: Path) -> None:
        self.path = path
        home = path / "home"
        home.mkdir()
        numbers = [str(port) for port in free_ports(len(PORTS) + 3)]
        self._ports = dict(zip(PORTS, numbers, strict=False))
        demo = dict(
            zip(
                ("APPLIANCE_PORT", "APPLIANCE_PLAIN_PORT", "APPLIANCE_WEB_PORT"),
                numbers[len(PORTS) :],
                strict=True,
            )
        )
        places = (sysconfig.get_path("scripts"), os.environ["PATH"], "/usr/local/sbin:/usr/sbin")
        self._environment = {
            **os.environ,
            **demo,
            "HOME": str(home),
            "PATH": os.pathsep.join(places),
            "NO_COLOR": "1",
            "PYTHONUNBUFFERED": "1",
        }
        self._running: list[subprocess.Popen[bytes]] = []

    def write(self, block: str) -> None:
        """Write a file that the page shows; its first line says which, and where in it."""
        first, _, text = self._with_ports(block).partition("\n")
        name, _, where = first.removeprefix("# ").partition(", ")
        path = self.path / name
        before = ""
        if where.startswith("at the end"):
            before = path.read_text()
        elif where == "in place of upstreams":
            before, found, _ = path.read_text().partition("upstreams:\n")
            assert found, path
        elif name == "broker/mosquitto.conf" and not os.geteuid():
            before = "user root\n"  # else it becomes a user who may not read the files
        path.write_text(before + text)

    def type(self, line: str, answer: str) -> None:
        """Run a line; it has to succeed, and to say what the page shows."""
        shell = self._with_ports(line)
        for beginning, said in ENDLESS.items():
            if line.startswith(beginning):
                self._start(shell, said)
                return
        is_down = "not connected" in answer  # then the exit code is 1
        deadline = time.monotonic() + PATIENCE
        while True:
            done = self._run(shell)
            if _alike(done.stdout, answer, self._ports):
                break
            # How it is may not have come to that yet; nothing else is typed twice.
            if "upstream" not in line or time.monotonic() > deadline:
                break
            time.sleep(0.2)
        assert done.returncode == (1 if is_down else 0), f"{line}\n{done.stdout}"
        if answer:
            assert _alike(done.stdout, answer, self._ports), f"{line}\n{done.stdout}\nnot\n{answer}"

    def _run(self, shell: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            ["bash", "-c", shell],
            cwd=self.path,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=2 * PATIENCE,
            check=False,
        )

    def _start(self, shell: str, said: str) -> None:
        log = self.path / f"{len(self._running)}.log"
        with log.open("w") as out:
            process = subprocess.Popen(
                ["bash", "-c", shell],
                cwd=self.path,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
            )
        self._running.append(process)
        eventually(lambda: said in log.read_text() or process.poll() is not None)
        assert process.poll() is None, log.read_text()
        if said == ENDLESS["appliance demo "]:  # ROS and the link come after the instructions
            for more in (
                "connected to mqtts://",
                "/cmd_vel: geometry_msgs",
                "/reset can be called at",
            ):
                eventually(partial(_says, log, more), f"{more}\n{log.read_text()}")

    def stop(self) -> None:
        """End all that was started."""
        for process in self._running:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
        for process in self._running:
            try:
                process.wait(PATIENCE)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def _with_ports(self, text: str) -> str:
        return re.sub("|".join(PORTS), lambda found: self._ports[found[0]], text)


def _says(log: Path, text: str) -> bool:
    return text in log.read_text()


def _alike(said: str, answer: str, ports: dict[str, str]) -> bool:
    """Whether that is the page's answer; lines in any order, as retained messages come."""
    for page, port in ports.items():
        said = said.replace(port, page)
    parts = [
        sorted(re.sub(r"\s+", " ", re.sub(VARIES, "N", line)) for line in text.splitlines())
        for text in (said, answer)
    ]
    return parts[0] == parts[1]


@pytest.mark.timeout(600)
@pytest.mark.usefixtures("isolated_domain")
def test_the_page_is_typed_from_its_beginning_to_its_end(tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="there is no ROS 2 here")
    if shutil.which("mosquitto_rr") is None:
        pytest.skip("no mosquitto-clients")
    folder = Folder(tmp_path)
    try:
        for line, text in steps():
            if line:
                folder.type(line, text)
            else:
                folder.write(text)
    finally:
        folder.stop()


def test_what_the_page_shows_is_compared() -> None:
    shown = "was 0.9 m from its start\nfleet: dropped of x: 5 late\n"
    assert _alike("was 1.3 m from its start\nfleet: dropped of x: 5 late\n", shown, {})
    assert not _alike(shown.replace("5 late", "4 late"), shown, {})
    assert not _alike(shown.replace("dropped", "taken"), shown, {})
    assert not _alike("", shown, {})
    assert len(list(steps())) > 30
