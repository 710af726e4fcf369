"""The image: its first start, what it says when something is in the way, and what outlives a kill.

It is built as docs/container.md has it, but for what takes minutes: nothing is compiled, and ROS is
left out. `python tests/container` does all of it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from waiting import eventually

from container.engine import Engine, engine, obstacle
from container.trial import CONFIGURATION, DATA, Container, volumes

pytestmark = pytest.mark.timeout(900)  # the image is built in the first one's time

IMAGE = "localhost/appliance"


@pytest.fixture(scope="module")
def built() -> Iterator[Engine]:
    if reason := obstacle():
        pytest.skip(reason)
    with engine() as made:
        made.prepare()
        made.build(IMAGE, APPLIANCE_COMPILE="0", EXTRAS="")
        yield made


@pytest.fixture
def podman(built: Engine) -> Iterator[Engine]:
    """Without the containers and volumes of the test before."""
    yield built
    built.podman("rm", "--all", "--force", "--time", "0")
    built.podman("volume", "rm", "--all", "--force")


@pytest.fixture
def container(podman: Engine) -> Container:
    return Container(podman, IMAGE)


def refused(podman: Engine, *options: str) -> str:
    """What it says on one line when it does not start."""
    told = podman.run("--rm", *options, IMAGE, code=1)
    assert told.startswith("appliance: ") and told.count("\n") == 1, told
    return told


def test_the_first_start(container: Container) -> None:
    container.start("--env", "APPLIANCE_NAMES=robot.example gate.example")
    password = container.password
    assert container.log.count(password) == 1
    container.publish("cmd_vel", "x")
    container.engine.podman("healthcheck", "run", container.name)
    certificate = container.engine.folder("first-configuration") / "certs/server.crt"
    found = x509.load_pem_x509_certificate(certificate.read_bytes())
    names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"robot.example", "gate.example"} <= {*names.get_values_for_type(x509.DNSName)}

    # Nothing is made anew by the next start, nor by a container that takes this one's place.
    container.engine.podman("restart", container.name)
    container.wait(2)
    assert container.log.count("password") == 1
    container.remove()
    container.start()
    assert "password" not in container.log
    assert x509.load_pem_x509_certificate(certificate.read_bytes()) == found
    container.publish("cmd_vel", "x")


def test_it_has_no_rights_and_its_first_process_is_one_that_reaps(container: Container) -> None:
    container.start()
    podman = container.engine
    inside = podman.podman("exec", container.name, "cat", "/proc/1/comm", "/proc/1/status")
    assert inside.startswith("tini\n")
    assert re.search(r"^CapEff:\s0{16}$", inside, re.MULTILINE)
    assert re.search(r"^Uid:\s8883\s8883\s8883\s8883$", inside, re.MULTILINE)
    for folder in (podman.folder("first-configuration"), podman.folder("first-data")):
        assert folder.stat().st_mode & 0o007 == 0
        assert {each.lstat().st_uid for each in (folder, *folder.rglob("*"))} == {8883}
    # Who is left behind by a parent that has ended becomes process 1's child.
    podman.podman("exec", container.name, "sh", "-c", "(sleep 0.1 &)")
    left = ("exec", container.name, "sh", "-c", "cat /proc/[0-9]*/stat || true")
    eventually(lambda: "(sleep)" not in podman.podman(*left), "the end of a process left behind")


def test_what_was_acknowledged_outlives_a_kill(container: Container) -> None:
    container.start()
    assert container.kept_through_a_kill(20) == 20


def test_sigterm_ends_it(container: Container) -> None:
    container.start()
    container.stop()
    assert container.exit_code == 0, container.log
    assert re.search(r"app\.main: stopping$", container.log, re.MULTILINE)
    told = container.engine.podman("healthcheck", "run", container.name, code=None)
    assert "not running" in told


def test_sigterm_ends_it_in_its_first_moment(podman: Engine, container: Container) -> None:
    """SIGTERM does not end a process 1 that has set up no handler yet; SIGKILL does, later."""
    podman.run("--detach", "--name", container.name, *container.volumes, IMAGE)
    container.stop()
    assert container.exit_code in (0, 143)  # 137 is SIGKILL's


def test_an_interrupted_first_start_is_completed(podman: Engine, container: Container) -> None:
    container.start()
    container.remove()
    made = podman.folder("first-configuration")
    (made / "users.passwd").unlink()
    told = podman.run("--rm", *container.volumes, IMAGE, code=1)
    assert "users.passwd" in told  # somebody has removed it
    (made / ".first-start").touch()
    (made / ".first-start").chmod(0o666)
    before = container.password
    container.start()
    assert container.password != before
    container.publish("cmd_vel", "x")
    assert not (made / ".first-start").exists()


def test_no_volumes(podman: Engine, container: Container) -> None:
    told = refused(podman)
    assert f"no volume is mounted at {DATA}" in told and f"-data:{DATA}" in told
    assert f"-configuration:{CONFIGURATION}" in told  # both are said at once
    told = refused(podman, *container.volumes[2:])
    assert f"no volume is mounted at {CONFIGURATION}" in told
    # As it advises, to try it.
    container.start(volumes=["--volume", CONFIGURATION, "--volume", DATA])


def test_volumes_that_cannot_be_written_to(podman: Engine, tmp_path: Path) -> None:
    told = refused(podman, *volumes("first", configuration=":ro"))
    assert f"{CONFIGURATION} is mounted read-only" in told and ":ro" in told
    told = refused(podman, *volumes("first", data=":ro"))
    assert f"{DATA} is mounted read-only" in told
    tmp_path.chmod(0o755)
    told = refused(podman, *volumes("first")[2:], "--volume", f"{tmp_path}:{CONFIGURATION}")
    assert "user 8883 " in told and f"belongs to user {os.getuid()}, mode 755" in told
    assert "chown -R 8883:8883 " in told


def test_a_complete_configuration_may_be_read_only(container: Container) -> None:
    container.start()
    container.remove()
    container.start(volumes=volumes("first", configuration=":ro"))
    container.publish("cmd_vel", "x")


def test_a_port_that_is_taken_and_a_store_in_use(podman: Engine, container: Container) -> None:
    container.start()
    told = podman.run("--rm", *volumes("second"), IMAGE, code=1)
    assert "8883" in told and "it is in use already" in told
    told = podman.run("--rm", *container.volumes, IMAGE, code=1)
    assert "store.db is in use by another appliance" in told


def test_other_commands_and_a_ros_of_the_image(podman: Engine, container: Container) -> None:
    assert re.fullmatch(r"appliance \S+, pure Python\n", podman.run("--rm", IMAGE, "--version"))
    assert "No such command 'fly'" in podman.run("--rm", IMAGE, "fly", code=2)
    told = podman.run("--rm", "--env", "ROS_SETUP=/gone/setup.sh", IMAGE, "--version")
    assert told.startswith("appliance: ROS_SETUP cannot be read: /gone/setup.sh\nappliance ")
    told = podman.run("--rm", "--env", "ROS_SETUP=setup.sh", IMAGE, "--version")
    assert "ROS_SETUP has to be the whole path of a file: setup.sh\nappliance " in told
    container.start()
    setup = podman.folder("first-configuration") / "setup.sh"
    setup.write_text("export ROS_DOMAIN_ID=87\necho sourced\n")
    setup.chmod(0o644)
    sourcing = ("--env", f"ROS_SETUP={CONFIGURATION}/setup.sh", *container.volumes)
    told = podman.run("--rm", *sourcing, IMAGE, "--version")
    assert told.startswith("sourced\nappliance ")
    assert "ok " in podman.podman("exec", container.name, "appliance", "check")


def test_what_is_not_to_be_in_an_image_gets_near_none(podman: Engine, tmp_path: Path) -> None:
    ignored = (Path(__file__).parents[2] / ".dockerignore").read_text()
    secret = ("certs/ca.key", "users.passwd", "run/user.password", ".git/config", ".venv/x.py")
    made = ("appliance/__pycache__/x.pyc", "appliance/broker/x.so", "build/x", "state/store.db")
    wanted = ("appliance/x.py", "appliance/web/files/x.js", "pyproject.toml")
    for name in (*secret, *made, *wanted):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / ".dockerignore").write_text(ignored)
    file = tmp_path / "Dockerfile"
    file.write_text("ARG BASE\nFROM $BASE\nCOPY . /context\n")
    podman.build("localhost/context", tmp_path, file)
    found = podman.run("--rm", "localhost/context", "find", "/context", "-type", "f").split()
    assert {*found} == {f"/context/{name}" for name in wanted}
