"""The wheel, as pip installs it for each Python, and a first use of it.

Python 3.13 and 3.14 are Debian's, in roots of their own. `APPLIANCE_PYTHONS` names the executables
of others on this computer:

    APPLIANCE_PYTHONS=/opt/python3.10/bin/python3:/opt/python3.12/bin/python3 \\
        pytest tests/packaging/test_pythons.py
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from appliance_process import ROBOT
from debian_root import debian_root, inside, require
from installed_appliance import InstalledAppliance, messages, subscribed
from pages import PROJECT

pytestmark = pytest.mark.timeout(600)

#: Debian's releases by their Python; what is in testing fits together, and in sid at times not.
RELEASES = {"3.13": "trixie", "3.14": "forky"}
OTHERS = [path for path in os.environ.get("APPLIANCE_PYTHONS", "").split(os.pathsep) if path]

#: base-files has the links of the root, such as /lib64.
PACKAGES = ("base-files", "python3-venv")
#: What configuring the package of certificates would write.
CERTIFICATES = "etc/ssl/certs/ca-certificates.crt"
PIP = ("pip", "install", "--quiet", "--only-binary=:all:", "--no-cache-dir")


@dataclass
class Place:
    """Where a Python is: a root, or None for this computer, and a folder that is seen as `name`."""

    root: Path | None
    folder: Path
    name: str
    environment: dict[str, str]

    def command(self, *command: str) -> list[str]:
        return inside(self.root, *command, **self.environment) if self.root else [*command]

    def run(self, *command: str) -> str:
        done = subprocess.run(
            self.command(*command),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=600,
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


@pytest.fixture(params=[*RELEASES, *OTHERS])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Place]:
    if request.param not in RELEASES:
        yield Place(None, tmp_path, str(tmp_path), {})
        return
    require(("mmdebstrap", "mmdebstrap"), ("mosquitto_sub", "mosquitto-clients"))
    with debian_root(tmp_path / "root", RELEASES[request.param], *PACKAGES) as root:
        yield Place(root, root / "tmp", "/tmp", {"PATH": "/usr/bin:/bin", **network(root)})


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


def test_the_wheel_is_installed_and_used(place: Place, wheel: Path, request) -> None:
    asked = request.node.callspec.params["place"]
    python = "/usr/bin/python3" if place.root else asked
    for file in (wheel, PROJECT / "constraints.txt"):
        shutil.copy(file, place.folder)
    venv = f"{place.name}/venv"
    place.run(python, "-m", "venv", venv)
    given = ("-c", f"{place.name}/constraints.txt", f"{place.name}/{wheel.name}")
    place.run(f"{venv}/bin/python", "-m", *PIP, *given)
    version = place.run(f"{venv}/bin/python", "-c", "import sys; print(*sys.version_info[:2])")
    if place.root:
        assert version.split() == asked.split(".")
    appliance = InstalledAppliance(
        place.folder / "house",
        place.command(f"{venv}/bin/appliance"),
        {"topics": [{"ros": "/chatter", "to": "mqtt"}]},
        inside=f"{place.name}/house",
    )
    assert appliance.call("--version").startswith("appliance 0.")
    assert "there is no ROS 2 here" in appliance.call("check", "-c", appliance.config)
    appliance.start()
    try:
        topic = f"{ROBOT}/smoke"
        for version in ("311", "5"):
            options = ("-V", version, "-q", "1")
            listener = appliance.mosquitto("sub", "-t", topic, *options, "-C", "1")
            with subscribed(listener) as process:
                appliance.publish(topic, f"over TLS with {version}", *options)
                assert messages(process) == [f"over TLS with {version}"]
    finally:
        appliance.stop()  # by SIGTERM, upon which it ends with 0
