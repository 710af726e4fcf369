"""The wheel, as pip installs it for each Python, and a first use of it.

Python 3.13 and 3.14 are Debian's, in roots of their own; 3.10, the oldest, is this computer's if it
has one. `APPLIANCE_PYTHONS` names the executables of others, and `APPLIANCE_PYTHONS_ROS=1` has all
of them tried with ROS 2 from PyPI, too:

    APPLIANCE_PYTHONS=/opt/python3.10/bin/python3:/opt/python3.12/bin/python3 \\
        pytest tests/packaging/test_pythons.py
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from appliance_process import ROBOT
from debian_root import debian_root, inside, remove, require
from installed_appliance import START, InstalledAppliance, messages, next_line, subscribed
from pages import PROJECT
from ros_domain import isolated_domain
from waiting import PATIENCE

from appliance.host.environment import for_other_programs

__all__ = ["isolated_domain"]  # a fixture

pytestmark = pytest.mark.timeout(1800)  # pip downloads

#: What keeps its nodes apart from those of others; set by isolated_domain.
DOMAIN = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")
HERE = Path(__file__).parent
ROBOT_SCRIPT, IMPORTS = "ros2_strings.py", "import_all.py"
HELLO = '{"data": "from MQTT"}'
BRIDGE = {
    "topics": [
        {"ros": "/chatter", "to": "mqtt"},
        {"ros": "/hear", "to": "ros", "type": "std_msgs/msg/String"},
    ]
}

#: Debian's releases by their Python; what is in testing fits together, and in sid at times not.
RELEASES = {"3.13": "trixie", "3.14": "forky"}
OLDEST = "3.10"


def others() -> list[str]:
    """The executables of other Pythons, the oldest first: this computer's, or one of pyenv's."""
    given = [path for path in os.environ.get("APPLIANCE_PYTHONS", "").split(os.pathsep) if path]
    pyenv = Path.home().glob(f".pyenv/versions/{OLDEST}.*/bin/python3")
    for path in (shutil.which(f"python{OLDEST}"), *map(str, sorted(pyenv))):
        # A shim of pyenv may be there without its Python.
        if path and subprocess.run([path, "--version"], capture_output=True).returncode == 0:
            return [path, *given]
    return given


#: base-files has the links of the root, such as /lib64; libstdc++6, which ROS 2 needs, is in every
#: installed Debian.
PACKAGES = ("base-files", "libstdc++6", "python3-venv")
#: What configuring the package of certificates would write.
CERTIFICATES = "etc/ssl/certs/ca-certificates.crt"
#: Whether ROS 2 from PyPI is tried, too: a minute more.
WITH_ROS = os.environ.get("APPLIANCE_PYTHONS_ROS") == "1"
#: Of what is installed only the part that is used is compiled, when it is.
PIP = ("pip", "install", "--quiet", "--no-cache-dir", "--no-compile")


@dataclass
class Place:
    """Where a Python is: a root, or None for this computer, and a folder that is seen as `name`."""

    root: Path | None
    folder: Path
    name: str
    python: str
    environment: dict[str, str]

    def command(self, *command: str) -> list[str]:
        if self.root:
            return inside(self.root, *command, **self.environment)
        given = (f"{name}={value}" for name, value in self.environment.items())
        return ["env", "-i", *given, *command]

    def run(self, *command: str) -> str:
        done = subprocess.run(
            self.command(*command),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=1200,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from what is committed, and nothing that lies beside it."""
    folder = tmp_path_factory.mktemp("wheel")
    clone = folder / "clone"
    subprocess.run(["git", "clone", "--quiet", PROJECT, clone], check=True)
    build = ("pip", "wheel", "--quiet", "--use-pep517", "--no-deps", "-w", folder, clone)
    built = subprocess.run([sys.executable, "-m", *build], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    (found,) = folder.glob("ros_mqtt_appliance-*-py3-none-any.whl")
    return found


@pytest.fixture(params=[*RELEASES, *others()])
def place(request: pytest.FixtureRequest, tmp_path: Path, isolated_domain: None) -> Iterator[Place]:
    if request.param not in RELEASES:
        yield Place(None, tmp_path, str(tmp_path), request.param, for_other_programs())
        return
    require(("mmdebstrap", "mmdebstrap"), ("mosquitto_sub", "mosquitto-clients"))
    with debian_root(tmp_path / "root", RELEASES[request.param], *PACKAGES) as root:
        ros = {name: os.environ[name] for name in DOMAIN}
        environment = {"PATH": "/usr/bin:/bin", "HOME": "/tmp", **network(root), **ros}
        yield Place(root, root / "tmp", "/tmp", f"/usr/bin/python{request.param}", environment)


def network(root: Path) -> dict[str, str]:
    """Let a root look up names, and its pip use the index and the CA that pip uses here."""
    shutil.copy("/etc/resolv.conf", root / "etc/resolv.conf")
    settings = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    found = {}
    for line in settings.splitlines():
        name, _, value = line.partition("=")
        found[name.rpartition(".")[2]] = value.strip("'\"")
    (root / CERTIFICATES).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(found.get("cert", f"/{CERTIFICATES}"), root / CERTIFICATES)
    names = ("index-url", "proxy", "trusted-host")
    environment = {name: found[name] for name in names if name in found}
    environment["cert"] = f"/{CERTIFICATES}"
    return {f"PIP_{key.upper()}".replace("-", "_"): value for key, value in environment.items()}


def test_the_wheel_is_installed_and_used(place: Place, wheel: Path) -> None:
    for file in (wheel, PROJECT / "constraints.txt", HERE / ROBOT_SCRIPT, HERE / IMPORTS):
        shutil.copy(file, place.folder)
    place.run(place.python, "-m", "venv", f"{place.name}/venv")
    install(place, wheel)
    house = InstalledAppliance(
        place.folder / "house",
        place.command(f"{place.name}/venv/bin/appliance"),
        BRIDGE,
        inside=f"{place.name}/house",
    )
    assert place.run(f"{place.name}/venv/bin/python", f"{place.name}/{IMPORTS}") == ""
    assert house.call("--version").startswith("appliance 0.")
    assert "there is no ROS 2 here" in house.call("check", "-c", house.config)
    house.start()
    try:
        for version in ("311", "5"):
            options = ("-V", version, "-q", "1")
            listener = house.mosquitto("sub", "-t", f"{ROBOT}/smoke", *options, "-C", "1")
            with subscribed(listener) as process:
                house.publish(f"{ROBOT}/smoke", f"over TLS with {version}", *options)
                assert messages(process) == [f"over TLS with {version}"]
    finally:
        house.stop()  # by SIGTERM, upon which it ends with 0
    if WITH_ROS:
        install(place, wheel, "[ros]")
        check_ros_2(place, house)


def install(place: Place, wheel: Path, extras: str = "") -> None:
    given = ["-c", f"{place.name}/constraints.txt", f"{place.name}/{wheel.name}{extras}"]
    if not extras:  # ROS 2 needs packages that have no wheels
        given.append("--only-binary=:all:")
    place.run(f"{place.name}/venv/bin/python", "-m", *PIP, *given)


def check_ros_2(place: Place, house: InstalledAppliance) -> None:
    """Strings both ways, between MQTT and a node in a process of its own."""
    house.start()
    try:
        house.wait_for_log("on ROS as /appliance", timeout=START)
        script = (f"{place.name}/venv/bin/python", f"{place.name}/{ROBOT_SCRIPT}")
        node = subprocess.Popen(place.command(*script), stdout=subprocess.PIPE, text=True)
        try:
            listener = house.mosquitto("sub", "-t", f"{ROBOT}/chatter", "-C", "1", "-W", "100")
            said = subprocess.run(listener, stdout=subprocess.PIPE, text=True, timeout=2 * PATIENCE)
            assert json.loads(said.stdout) == {"data": "from the robot"}, house.log
            heard = next_line(node, lambda: house.publish(f"{ROBOT}/hear", HELLO))
            assert heard == "from MQTT", house.log
        finally:
            node.kill()
            node.communicate()
    finally:
        house.stop()


def test_a_root_with_a_mount_in_it_is_not_removed(tmp_path: Path) -> None:
    """What is mounted would be emptied with it, and that may be this computer's own /dev."""
    require()
    root = tmp_path / "root"
    (root / "dev").mkdir(parents=True)
    mount = 'mount -t tmpfs none "$0/dev" && touch "$0/dev/null" && "$@"; ls "$0/dev"'
    program = "import debian_root, pathlib, sys; debian_root.remove(pathlib.Path(sys.argv[1]))"
    own = ("unshare", "--mount", "--propagation", "private", "sh", "-c", mount, root)
    done = subprocess.run(
        [*own, sys.executable, "-c", program, root],
        env={**os.environ, "PYTHONPATH": str(PROJECT / "tests")},
        capture_output=True,
        text=True,
    )
    assert "is mounted in" in done.stderr
    assert done.stdout == "null\n"
    remove(root)
    assert not root.exists()
