"""The files that an image is built of and run by, as the tools of their kind read them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import yaml

PROJECT = Path(__file__).parents[2]
FOLDER = PROJECT / "appliance/packaging/container"
DOCKERFILE = FOLDER / "Dockerfile"


def tool(name: str, *arguments: str) -> str:
    program = Path(sys.executable).with_name(name)
    done = subprocess.run([program, *arguments], cwd=FOLDER, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_hadolint_has_no_complaints() -> None:
    assert tool("hadolint", "--no-color", "Dockerfile") == ""


def composed(*profiles: str) -> dict[str, dict[str, object]]:
    options = [f"--profile={name}" for name in profiles]
    services: dict[str, dict[str, object]] = yaml.safe_load(
        tool("podman-compose", *options, "config")
    )["services"]
    return services


def test_the_services_of_compose() -> None:
    assert composed().keys() == {"appliance"}
    assert composed("robot").keys() == {"appliance", "robot"}
    assert composed("fleet").keys() == {"appliance", "fleet"}


def test_compose_and_the_dockerfile_agree() -> None:
    services = composed("robot", "fleet")
    appliance, dockerfile = services["appliance"], DOCKERFILE.read_text()
    build = appliance["build"]
    assert isinstance(build, dict)
    assert Path(FOLDER, build["context"], build["dockerfile"]).resolve() == DOCKERFILE
    given = dict(text.split("=", 1) for text in build["args"])
    for name, text in given.items():
        assert f"ARG {name}={text}\n" in dockerfile, "the same default as without compose"
    (folders,) = re.findall(r"install -d .* (/etc/\S+ /var/\S+)$", dockerfile, re.MULTILINE)
    volumes = appliance["volumes"]
    assert isinstance(volumes, list)
    assert [volume.partition(":")[2] for volume in volumes] == folders.split()
    assert appliance["network_mode"] == services["robot"]["network_mode"] == "host"
    fleet = services["fleet"]["volumes"]
    assert isinstance(fleet, list)
    assert (FOLDER / fleet[0].partition(":")[0]).is_file()
