"""Every command line of README, CONTRIBUTING and docs/ is run as the page has it.

A page's lines are run by a shell, in the page's order, in a new home folder with an appliance and a
robot of its own. `NOT_RUN` and `NO_PROGRAMS` list the lines that are not run, with their
reasons; every other line is run and has to succeed, so that a new line is either run or listed.
`STAND_INS` and `ADDED` are all that is changed in a line.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
from functools import partial
from pathlib import Path
from typing import IO, Any, TypeAlias

import pytest
from appliance_process import free_ports
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID
from pages import PROJECT, Page, pages
from robot_process import Robot
from ros_domain import isolated_domain
from waiting import PATIENCE, eventually

from appliance import config
from appliance.ops.control import ControlError, ask

__all__ = ["isolated_domain"]

#: Lines that no test can run as they stand, and why.
NOT_RUN = {
    "make test": "runs all tests, of which this is one",
    ".venv/bin/python -m pytest tests/broker -q -x": "runs tests, which `make test` does as well",
    "make test-compiled": "compiles, and runs tests for half an hour; some are in `make test`",
    "make compiled": "compiles for minutes; tests/packaging/test_compiled.py does the same",
    "appliance clients kick tablet --user alice --host robot.local --ca ca.crt": "needs another"
    " client; tests/cli/test_clients.py disconnects one",
    "appliance find": "asks the computer's own network; tests/mdns does it in networks of its own",
    "appliance find --ca ca.crt": "the same",
    "make binary": "builds for minutes; tests/packaging/test_binary.py runs what it builds",
    "make deb COMPILE=1": "compiles for minutes; tests/packaging has the parts",
    "sudo apt install mmdebstrap bubblewrap debian-archive-keyring": "changes the system",
    "sudo .venv/bin/python -m appliance.packaging.root --out dist": "builds a Python and needs a"
    " network; tests/packaging/test_root.py has what it refuses and keeps",
    "make deb": "needs what `make binary` builds; tests/ops/test_install.py makes a package",
    'make release RELEASE_OPTIONS="--python python3.11 --python python3.13'
    ' --machine x86_64"': "builds for half an hour; tests/packaging has its parts",
    "apt install git gcc python3-dev python3-venv lintian": "changes the system",
    "apt install mmdebstrap bubblewrap debian-archive-keyring": "changes the system",
    "apt install gcc-aarch64-linux-gnu libc6-dev-arm64-cross"
    " qemu-user-static": "changes the system",
    "apt install mmdebstrap buildah": "changes the system",
    'git tag --annotate v1.2.3 --message "Version 1.2.3"': "makes a release of this repository",
    "git push origin v1.2.3": "needs another computer",
    "gpg --armor --detach-sign dist/SHA256SUMS": "needs a person's key",
    "appliance bench --upstream --messages 1000000": "takes ten minutes; tests/bench has its parts",
    "appliance bench --broker --rounds 3 --peer mosquitto"
    " --peer ./mosquitto-2.1.2": "needs what CONTRIBUTING.md builds; tests/bench has two",
    "appliance bench --broker --rounds 3 --peer ./mosquitto-2.1.2": "the same",
    "sudo apt install cmake g++ libssl-dev libcjson-dev": "changes the system",
    "curl -fO https://deb.debian.org/debian/pool/main/m/mosquitto/"
    "mosquitto_2.1.2.orig.tar.gz": "needs a network",
    "echo a8e37cc4c1d4141e56c5a8729c5fa36b1f0b1ca95378a12131d68f0509de122a"
    " mosquitto_2.1.2.orig.tar.gz | sha256sum -c": "needs what the line before fetches",
    "mkdir source && tar -xf mosquitto_2.1.2.orig.tar.gz -C source"
    " --strip-components=1": "the same",
    "cmake -S source -B out -DCMAKE_BUILD_TYPE=Release -DWITH_WEBSOCKETS=OFF -DWITH_TESTS=OFF"
    " -DWITH_CLIENTS=OFF -DWITH_APPS=OFF -DWITH_PLUGINS=OFF -DWITH_DOCS=OFF": "the same",
    "make -C out mosquitto && cp out/src/mosquitto mosquitto-2.1.2": "the same",
    "scp dist/appliance robot:": "needs another computer",
    "python3.12 -m venv --system-site-packages ~/appliance-venv"
    " && ~/appliance-venv/bin/pip install .": "needs Python 3.12 and a network",
    "apt install python3-rospy python3-diagnostic-msgs python3-geometry-msgs": "changes the system"
    " and needs a network; .ci/run installs these packages",
    "cd src/ros-mqtt-appliance": "is for the next line",
    "python3 -m venv --system-site-packages ~/appliance-venv"
    " && ~/appliance-venv/bin/pip install .": "needs a sourced ROS and a network",
    "cd ~/ros2_ws": "is for the next line",
    "~/appliance-venv/bin/appliance init --dir ~/appliance --robot r2d2": "is in README as well",
    "gunzip --stdout appliance-V-image-x86_64.tgz | docker load": "needs an engine, and a release",
    "cd ~/ros2_ws && rosdep install --from-paths src --ignore-src -y": "changes the system",
    "/usr/bin/python3 -m venv --system-site-packages ~/appliance/venv": "is for the next line",
    "~/appliance/venv/bin/pip install .": "needs a network",
}

#: Programs of which no line is run, and why.
NO_PROGRAMS = {
    "docker": "needs an engine; tests/container runs the image with podman",
    "colcon": "needs a workspace; tests/packaging/test_ros_package.py makes one and builds in it",
    "ros2": "is not to be had without a distribution of ROS",
}

#: What a line says, and what stands for it here; {port}, {user} and {password} are the appliance's.
STAND_INS = (
    # The test may not be root: then it is a trial. Else `DESTDIR` names an image of a system.
    ("sudo appliance ", "single-file "),
    ("appliance bench", "short-bench bench"),
    ("//broker.example", "//127.0.0.1:1"),  # nobody listens there
    ("https://robot.local:8443", "https://localhost:{web_port}"),
    ("--cafile ca.crt -u operator -P PASSWORD ", "--cafile certs/ca.crt -u {user} -P {password} "),
    ("-h localhost -p 8883 ", "-h localhost -p {port} "),
    ("--cacert ca.crt -u operator ", "--cacert ca.crt -u {user}:{password} "),
    ("--host robot.local", "--host localhost --port {port}"),
    (" … ", " -h localhost -p {port} --cafile certs/ca.crt -u {user} -P {password} "),
    # ROS's packages on PyPI have no navigation: the action is a Fibonacci.
    ('\'{"pose": {"header": {"frame_id": "map"}}}\'', "'{\"order\": 2}'"),
)

#: Options that a line gets beside its own: most so that it ends by itself, and soon.
ADDED = (
    (r"^curl ", "-sS --fail-with-body --retry 10 --retry-all-errors"),  # until all is ready
    (r"appliance sub |mosquitto_sub ", "-C 1 -W 30"),
    (r"appliance user (add|passwd) (?!.*--generate)", "--generate"),  # there is no terminal to ask
    (r"short-bench (?!.*growth)", "--seconds 0.2 --rounds 1"),
    (r"short-bench .*growth", "--seconds 1 --rounds 1"),
    *([(r"single-file ", "--dry-run")] if os.geteuid() else []),
)

#: Programs that stand for others. The single file is one, as `install` refuses a folder below /tmp,
#: and needs no file that an image of a system does not have.
PROGRAMS = {
    "single-file": "import sys; sys.frozen, sys.executable = True, __file__",
    # One cell of the broker, one of the bridge, and those that are named, small.
    "short-bench": """\
import dataclasses, sys
from appliance.bench import cells, command, growth
kept = [each for each in cells.CELLS if each.name in ("qos0-pair", "ros-to-mqtt")]
cells.CELLS = command.CELLS = tuple(kept)
cells.BROKER = tuple(kept[:1])
growth.RUNS, growth.SETTLE_SECONDS = 1, 0.1
command.GROWTH = tuple(
    dataclasses.replace(each, size=40) for each in growth.GROWTH
    if each.name in sys.argv)""",
}

#: Commands that are for a running appliance, and those that want it stopped; others do not mind.
NEED_RUNNING = re.compile(
    r"appliance (status|top|reload|routes|clients|upstream|doctor|pub|sub|call|goal|param) "
    r"|mosquitto_"
    r"|curl "
)
NEED_STOPPED = re.compile(r"appliance (run|store) |make run ")
#: They run until they are stopped.
ENDLESS = re.compile(r"appliance run |make run ")
#: They are answered by the robot.
NEED_ROBOT = re.compile(r"appliance (call|goal|param) |make run |mosquitto_|-v demo/")

#: Their answer is the one that the page shows.
SAME_ANSWER = re.compile(r"mosquitto_rr |appliance (call -u alice|param get) ")

HAS_ROS = importlib.util.find_spec("rclpy") is not None
#: fleet_page.py types the page of a fleet, on demand: two appliances, and minutes.
PAGES = [page for page in pages() if page.name != "docs/fleet.md"]

#: A page's bus and its first user.
BUS = {"docs/ros1.md": "ros1"}
USER = {"docs/calls.md": "alice", "docs/management.md": "alice"}
#: Pages that command page_robot.py, and what of it has to be on the bus before.
ROBOT = {"docs/calls.md": {"/reset", "/arm/grip", "/navigate_to_pose", "/controller"}}
BRIDGE = """\
  discovery: localhost
  topics:
    - {ros: /odom, to: mqtt}
    - {ros: /cmd_vel, to: ros, type: geometry_msgs/msg/Twist}
  services: [/reset, /arm/grip]
  actions: [/navigate_to_pose]
  parameters: [/controller/*]
"""
CONFIGURATION = """\
robot: r2d2
broker:
  listeners:
    - {{bind: "127.0.0.1:${{APPLIANCE_PORT}}", tls: true}}
    - {{bind: "127.0.0.1:${{WEB_PORT}}", tls: true, protocol: web}}
bridge:
  bus: {bus}
"""

#: What a reader has typed before a page that does not begin with it.
INIT = "appliance init --dir ~/appliance --robot r2d2 --user {user}"

Popen: TypeAlias = "subprocess.Popen[str]"


def lines(page: Page) -> list[str]:
    """The page's command lines, without their comments, and with single spaces."""
    found = (re.sub(r"(^|\s+)#.*$", "", line) for line in page.commands())
    return [" ".join(line.split()) for line in found if line.strip()]


def answers(page: Page) -> dict[str, str]:
    """What the page shows below each command line of its terminals."""
    found: dict[str, str] = {}
    for block in page.blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.M)[1:]:
            line, _, answer = part.partition("\n")
            found[line] = f"{answer.rstrip()}\n"
    return found


def needs(pattern: re.Pattern[str], line: str) -> bool:
    return pattern.search(f"{line} ") is not None


class Site:
    """A home folder, in which a page's lines are typed, and the appliance that runs there."""

    def __init__(self, page: Page, folder: Path) -> None:
        self.home = folder / "home"
        self.folder = self.home / "appliance"
        self.clone = self.home / "clone"
        self.port, plain_port, self.web_port = free_ports(3)
        self.user = USER.get(page.name, "operator")
        self.password = ""
        self.log = folder / "log"
        self.bus = BUS.get(page.name, "ros2") if HAS_ROS else "none"
        self.answers = answers(page)
        self.robot = ROBOT.get(page.name, set())
        self._file = self.folder / "appliance.yaml"
        self._endless: Popen | None = None
        self._shell = ""  # what started it
        self._background: list[tuple[Popen, str]] = []
        programs, image = folder / "programs", folder / "image"
        scripts = sysconfig.get_path("scripts")
        self._environment = {
            **os.environ,
            "HOME": str(self.home),
            "PATH": os.pathsep.join([str(programs), scripts, os.environ["PATH"]]),
            "NO_COLOR": "1",
            "PYTHONUNBUFFERED": "1",
            "DESTDIR": str(image),
            "PORT": str(self.port),  # of `make run`
            "PLAIN_PORT": str(plain_port),
            "WEB_PORT": str(self.web_port),
            "APPLIANCE_PORT": str(self.port),
        }
        for each in (programs, self.folder, self.clone / ".venv"):
            each.mkdir(parents=True)
        bridge = BRIDGE if self.bus == "ros2" else ""
        self._file.write_text(CONFIGURATION.format(bus=self.bus) + bridge)
        (self.folder / "device.csr").write_bytes(signing_request())
        (self.folder / "venv").mkdir()
        for link, target in (
            (self.folder / "ca.crt", self.folder / "certs/ca.crt"),
            (self.folder / "venv/bin", scripts),
            (self.folder / "appliance", Path(scripts, "appliance")),  # for the single file
            (self.clone / ".venv/bin", scripts),
            *((self.clone / name, PROJECT / name) for name in ("Makefile", "pyproject.toml")),
            (self.clone / "constraints.txt", PROJECT / "constraints.txt"),
        ):
            link.symlink_to(target)
        (self.clone / ".venv/run.stamp").touch()  # `make run` finds its environment set up
        for name, code in PROGRAMS.items():
            text = f"#!{sys.executable}\n{code}\nfrom appliance.cli.main import main\nmain()\n"
            (programs / name).write_text(text)
            (programs / name).chmod(0o755)
        (image / "etc").mkdir(parents=True)
        for name in ("passwd", "group", "shadow", "gshadow"):
            (image / "etc" / name).touch()

    # Lines

    def type(self, line: str) -> None:
        """Run a line as the page has it; AssertionError when it fails."""
        if needs(NEED_STOPPED, line):
            self.stop()
        elif needs(NEED_RUNNING, line) and self._endless is None:
            self._start("appliance run -c ~/appliance/appliance.yaml")
        shell = self.translated(line)
        if needs(ENDLESS, line):
            self._start(shell)
        elif shell.endswith("&"):
            self._background.append((self._popen(shell.removesuffix("&")), line))
            eventually(lambda: self._ask("status")["subscriptions"] > 0)
        else:
            process = self._popen(shell)
            self._check(process, line)
            while self._background:
                self._check(*self._background.pop())

    def translated(self, line: str) -> str:
        """The line with its stand-ins and additions."""
        for words, stand_in in STAND_INS:
            line = line.replace(words, stand_in)
        names = {
            "port": self.port,
            "web_port": self.web_port,
            "user": self.user,
            "password": self.password,
        }
        for name, value in names.items():
            line = line.replace(f"{{{name}}}", str(value))
        for pattern, more in ADDED:
            if re.search(pattern, line):
                line = f"{line[:-1]}{more} &" if line.endswith("&") else f"{line} {more}"
        return line

    def _popen(self, shell: str, output: IO[str] | int = subprocess.PIPE) -> Popen:
        in_clone = re.match(r"make |\.venv/", shell)
        return subprocess.Popen(
            ["bash", "-c", shell],
            cwd=self.clone if in_clone else self.folder,
            env={**self._environment, "APPLIANCE_PASSWORD": self.password},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            # It is ignored where the tests were started in the background, and that is inherited.
            preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
        )

    def _check(self, process: Popen, line: str) -> None:
        patience = PATIENCE * (5 if "appliance bench" in line else 1)
        try:
            output, _ = process.communicate(timeout=patience)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            output += f"\nhas not ended within {patience:g} s"
        # `doctor` ends with 1 when it has found a problem of this computer.
        is_examined = "appliance doctor" in line and "\nproblems: " in output
        # `upstream` does when a link is not connected, as that of a page that nobody runs.
        is_examined |= "appliance upstream" in line and " not connected " in output
        assert process.returncode == 0 or is_examined, f"{line}\n{output}"
        if needs(SAME_ANSWER, line):
            assert output == self.answers[line], line
        elif re.search(r"appliance sub |mosquitto_sub ", line):
            assert output, f"{line}\nreceived nothing"
        if shown := re.search(rf"^user {self.user}, password (\S+)$", output, re.M):
            self.password = shown[1]

    # The appliance

    def _start(self, shell: str) -> None:
        """Start what runs until it is stopped, and wait until it serves."""
        is_demo = shell.startswith("make run")
        self._shell = shell
        with self.log.open("w") as log:
            self._endless = self._popen(shell, log)
        self._wait_for("Ctrl-C here ends everything" if is_demo else "listening on")
        self._file = (self.clone / "run" if is_demo else self.folder) / "appliance.yaml"
        eventually(self._is_answering)
        if self.bus != "ros2":
            return
        self._wait_for("on ROS as /")
        expected = {"/odom", "/reset"} if is_demo else {*self.robot}
        eventually(lambda: expected <= self._bridged(), f"{expected} on the bus")

    def _wait_for(self, text: str) -> None:
        process = self._endless
        assert process is not None
        eventually(lambda: text in self.log.read_text() or process.poll() is not None)
        assert process.poll() is None, self.log.read_text()

    def _ask(self, question: str) -> Any:
        return ask(config.load_control(self._file).control, question)

    def _is_answering(self) -> bool:
        try:
            return bool(self._ask("status"))
        except ControlError:
            return False

    def _bridged(self) -> set[str]:
        return {route["ros"] for route in self._ask("routes")}

    def stop(self) -> None:
        """Ctrl-C, when something runs."""
        process, self._endless = self._endless, None
        if process is None:
            return
        os.killpg(process.pid, signal.SIGINT)
        try:
            code = process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise AssertionError(f"does not end on Ctrl-C:\n{self.log.read_text()}") from None
        text = self.log.read_text()
        assert "INFO    app.main: stopping" in text and "Traceback" not in text, text
        is_make = self._shell.startswith("make ")
        assert code == (-signal.SIGINT if is_make else 0), f"{code}\n{text}"


def signing_request() -> bytes:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "device")])
    request = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA256())
    return request.public_bytes(Encoding.PEM)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
@pytest.mark.usefixtures("isolated_domain")
def test_every_command_of_a_page_does_what_it_says(page: Page, tmp_path: Path) -> None:
    typed = [line for line in lines(page) if line not in NOT_RUN]
    typed = [line for line in typed if line.split()[0] not in NO_PROGRAMS]
    if not HAS_ROS and any(needs(NEED_ROBOT, line) for line in typed):
        pytest.skip("there is no ROS 2 here")
    if shutil.which("mosquitto_rr") is None and any("mosquitto_" in line for line in typed):
        pytest.skip("no mosquitto-clients")
    if not typed:
        return
    if page.name in ROBOT:
        pytest.importorskip("test_msgs.action")
    site = Site(page, tmp_path)
    robot = Robot("page_robot.py") if page.name in ROBOT else None
    try:
        if robot is not None:
            robot.wait()
        if not any("appliance init " in line for line in typed):
            site.type(INIT.format(user=site.user))
        for line in typed:
            site.type(line)
    finally:
        try:
            site.stop()
        finally:
            if robot is not None:
                robot.stop()


@pytest.mark.parametrize("line", ["appliance fly", "no-such-program", "appliance check -c no.yaml"])
def test_a_command_that_fails_is_noticed(line: str, tmp_path: Path) -> None:
    site = Site(Page("a.md", f"```sh\n{line}\n```\n"), tmp_path)
    with pytest.raises(AssertionError, match=re.escape(line)):
        site.type(line)


@pytest.mark.usefixtures("isolated_domain")
def test_another_answer_than_the_page_shows_is_noticed(tmp_path: Path) -> None:
    line = "appliance param get --help"
    site = Site(Page("a.md", f"```console\n$ {line}\n0.5\n```\n"), tmp_path)
    site.type(INIT.format(user=site.user))
    try:
        with pytest.raises(AssertionError, match=r"0\.5"):
            site.type(line)
    finally:
        site.stop()


def test_what_is_not_run_is_in_a_page() -> None:
    every = {line for page in PAGES for line in lines(page)}
    assert len(every) > 50
    assert {*NOT_RUN} - every == set()
    assert {*NO_PROGRAMS} - {line.split()[0] for line in every} == set()


def test_what_stands_for_something_is_needed() -> None:
    every = "\n".join(line for page in PAGES for line in lines(page))
    assert [words for words, _ in STAND_INS if words not in every] == []
