"""`appliance doctor`: what is wrong is found and said, with what to do; and nothing is changed."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from appliance_process import ApplianceProcess
from command_line import run
from waiting import eventually

from appliance import certs, config
from appliance.config import Settings
from appliance.ops.doctor import computer, examination, ports, ros, ros1, secrets
from appliance.ops.doctor.examination import Part, examine
from appliance.ops.finding import Finding
from appliance.ros.ros2 import discovery, fastdds


@pytest.fixture
def here(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A folder that was set up, for a broker alone on ports that the system chooses."""
    assert run("init", "--dir", str(tmp_path), "--robot", "r2") == 0
    capsys.readouterr()
    write(tmp_path, broker={"listeners": [{"bind": "127.0.0.1:0", "tls": True}]})
    return tmp_path


def write(directory: Path, **sections: Any) -> Settings:
    settings = {"robot": "r2", "bridge": {"bus": "none"}, **sections}
    file = directory / "appliance.yaml"
    file.write_text(yaml.safe_dump(settings))
    return config.load(file)


def by_subject(findings: Iterator[Finding]) -> dict[str, Finding]:
    return {finding.subject: finding for finding in findings}


def snapshot(directory: Path) -> dict[str, tuple[int, int, int]]:
    found = {}
    for path in directory.rglob("*"):
        state = path.lstat()
        found[str(path)] = (state.st_mode, state.st_size, state.st_mtime_ns)
    return found


# All of it


def test_everything_is_examined_and_nothing_changed(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = snapshot(here)
    code = run("doctor", "--json", "-c", str(here / "appliance.yaml"))
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert snapshot(here) == before
    assert code == any(each["level"] == "problem" for each in found)
    subjects = {each["subject"] for each in found}
    assert {
        *("appliance", "port 127.0.0.1:0", "clock", "the server's certificate", "the CA"),
        *("permissions", "disk of the store", "memory", "open files", "ROS"),
        str(here / "acl.conf"),  # what `check` finds
    } <= subjects
    for each in found:
        assert each["level"] == "ok" or each["advice"] or each["text"]


def test_it_is_told_to_people_too(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "certs/server.key").chmod(0o644)
    assert run("doctor", "-c", str(here / "appliance.yaml")) == 1
    lines = capsys.readouterr().out.splitlines()
    key = here / "certs/server.key"
    place = lines.index(f"problem {key}: others can read it (mode 0644)")
    assert lines[place + 1] == f"        what to do: chmod go= {key}"
    assert lines[-1].startswith("problems: ")


@pytest.mark.parametrize("text", [None, "", "robbot: r2", "\tx: {", "broker: []", "\0"])
def test_a_configuration_that_is_missing_or_broken(tmp_path: Path, text: str | None) -> None:
    file = tmp_path / "appliance.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(examination, "ros", lambda settings, running: iter(()))
        findings = list(examine(file))
    assert {"clock", "memory", "port 0.0.0.0:8883"} <= {each.subject for each in findings}
    problems = [each for each in findings if each.subject == "configuration"]
    assert (problems == []) is (text == "")
    if text is None:
        assert "appliance init" in problems[0].text


def test_one_part_that_fails_leaves_the_others_their_say(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def clock(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
        yield Finding("ok", "clock", "ticks")
        raise RuntimeError("a gear broke")

    monkeypatch.setattr(examination, "clock", clock)
    found = list(examine(here / "appliance.yaml"))
    texts = [each.text for each in found if each.subject == "clock"]
    assert texts == ["ticks", "could not be examined: RuntimeError: a gear broke"]
    assert found[-1].subject == "ROS"


# The running one, and ports


def test_ports_of_the_running_one_are_its_own(appliance: ApplianceProcess, tmp_path: Path) -> None:
    binds = [f"127.0.0.1:{port}" for port in (appliance.port, appliance.plain_port)]
    settings = write(tmp_path, broker={"listeners": [{"bind": bind} for bind in binds]})
    found = by_subject(ports.ports(settings, {"pid": appliance.pid, "listeners": []}))
    for port in (appliance.port, appliance.plain_port):
        finding = found[f"port 127.0.0.1:{port}"]
        assert finding.level == "ok" and f"pid {appliance.pid}" in finding.text
    told = by_subject(examine(appliance.config))
    assert f"is running, pid {appliance.pid}" in told["appliance"].text


def test_a_port_of_a_program_that_cannot_be_seen(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a container: the program has no number there, nor has an appliance that is off."""
    settings = write(here, broker={"listeners": [{"bind": "127.0.0.1:8883"}]})
    monkeypatch.setattr(ports, "_listening", lambda: [("127.0.0.1", 8883, None)])
    for running in (None, {"pid": 5, "listeners": []}):
        [finding] = ports.ports(settings, running)
        assert finding.level == "error" and "outside of this container" in finding.text
        assert "ss -ltnp 'sport = :8883'" in finding.advice


def test_a_port_that_another_program_has(here: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        settings = write(here, broker={"listeners": [{"bind": f"0.0.0.0:{port}"}]})
        [finding] = ports.ports(settings, None)
        assert finding.level == "error" and f"(pid {os.getpid()})" in finding.text
        assert "broker.listeners" in finding.advice
    [finding] = ports.ports(settings, None)
    assert (finding.level, finding.text) == ("ok", "free")


def test_places_where_nobody_can_listen(here: Path) -> None:
    (here / "file").touch()
    binds = ["203.0.113.7:18883", f"unix:{here}/none/mqtt.sock", f"unix:{here}/file"]
    settings = write(here, broker={"listeners": [{"bind": bind} for bind in binds]})
    texts = [(each.level, each.text) for each in ports.ports(settings, None)]
    assert texts == [
        ("error", "this computer does not have the address 203.0.113.7 now"),
        ("error", f"{here}/none is no folder that can be written"),
        ("error", "there is another file"),
    ]


# The computer


def test_a_port_for_root_alone(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service is not root, also when root asks."""
    monkeypatch.setattr(ports, "_UNPRIVILEGED", here / "none")
    settings = write(here, broker={"listeners": [{"bind": "127.0.0.1:799"}]})
    assert settings.file is not None
    if os.geteuid() == 0:
        assert by_subject(ports.ports(settings, None))["port 127.0.0.1:799"].level == "ok"
        os.chown(settings.file, 4321, 4321)
    finding = by_subject(ports.ports(settings, None))["port 127.0.0.1:799"]
    assert finding.level == "warning" and "CapabilityBoundingSet=" in finding.advice


def test_a_clock_that_is_not_set(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = write(here)
    assert computer.is_synchronised() in (True, False)
    monkeypatch.setattr(computer, "is_unset", lambda now: True)
    first = next(computer.clock(settings, None))
    assert first.level == "error" and "timedatectl" in first.advice
    monkeypatch.undo()
    monkeypatch.setattr(computer, "is_synchronised", lambda: False)
    assert next(computer.clock(settings, None)).level == "warning"


@pytest.mark.parametrize(
    ("changed", "level", "text"),
    [
        ({"f_flag": os.ST_RDONLY}, "error", "is read-only"),
        ({"f_bavail": 10}, "error", "MiB free"),
        ({"f_bavail": 100_000}, "warning", "it may grow to 1 GiB"),
        ({"f_favail": 3}, "error", r"room for 3 more files"),
        ({"f_files": 0, "f_favail": 0}, "ok", "MiB free"),  # as btrfs has it
    ],
)
def test_a_disk_without_room(
    here: Path, monkeypatch: pytest.MonkeyPatch, changed: dict[str, int], level: str, text: str
) -> None:
    values = {"f_flag": 0, "f_frsize": 4096, "f_bavail": 10**9, "f_files": 10**6, "f_favail": 10**6}
    monkeypatch.setattr(computer.os, "statvfs", lambda path: SimpleNamespace(**(values | changed)))
    monkeypatch.setattr(computer, "_kind", lambda folder: "ext4")
    found = list(computer.disk(write(here), None))
    assert found[-1].level == level and text in found[-1].text


def test_a_disk_in_memory(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mounts = [
        SimpleNamespace(mountpoint="/", fstype="ext4"),
        SimpleNamespace(mountpoint=str(here), fstype="tmpfs"),
    ]
    monkeypatch.setattr(computer.psutil, "disk_partitions", lambda all: mounts)
    *_, last = computer.disk(write(here), None)
    assert last.level == "warning" and "is in memory (tmpfs)" in last.text


def test_a_control_group_that_is_too_small(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = here / "cgroup"
    for line in Path("/proc/self/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers in ("", "memory"):
            group = root / controllers / path.lstrip("/")
            group.mkdir(parents=True, exist_ok=True)
            name = "memory.limit_in_bytes" if controllers else "memory.max"
            for folder in (group, root / controllers):  # what holds one may hold it tighter
                (folder / name).write_text("max\n" if folder is group else "134217728\n")
    limit = computer.group_limit(os.getpid(), root)
    assert limit == 128 << 20
    assert computer.group_limit(os.getpid(), here / "nothing") is None
    monkeypatch.setattr(computer, "group_limit", lambda pid: limit)
    *_, last = computer.memory(write(here), None)
    assert last.level == "error" and "MemoryMax" in last.advice


def test_too_few_open_files(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computer.resource, "getrlimit", lambda which: (100, 1024))
    [finding] = computer.files(write(here), None)
    assert finding.level == "error" and "LimitNOFILE=" in finding.advice
    [finding] = computer.files(write(here), {"pid": os.getpid()})  # of the running one, its own
    assert "1024" not in finding.text


# Secrets


def test_what_others_can_read_or_change(here: Path) -> None:
    settings = write(here)
    assert [each.level for each in secrets.permissions(settings, None)] == ["ok"]
    (here / "certs/ca.key").chmod(0o640)
    (here / "users.passwd").chmod(0o604)
    (here / "acl.conf").chmod(0o666)
    found = by_subject(secrets.permissions(settings, None))
    assert {Path(subject).name: each.advice.split()[:2] for subject, each in found.items()} == {
        "ca.key": ["chmod", "go="],
        "users.passwd": ["chmod", "go="],
        "acl.conf": ["chmod", "go-w"],
    }


def test_secrets_of_links_that_others_can_read(here: Path) -> None:
    write(here)
    with (here / "appliance.yaml").open("a") as file:
        file.write(
            "\nupstreams: [{name: fleet, servers: [mqtts://a], "
            "login: {username: a, password_file: fleet.password}, "
            "tls: {certificate: fleet.crt, key: fleet.key}}]\n"
        )
    for name in ("fleet.password", "fleet.key", "fleet.crt"):
        (here / name).touch()
        (here / name).chmod(0o644)
    found = by_subject(secrets.permissions(config.load(here / "appliance.yaml"), None))
    assert {Path(subject).name for subject in found} == {"fleet.password", "fleet.key"}


def test_days_that_are_left(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = here / "certs"
    certs.issue_client(directory, "lost")
    certs.revoke(directory, "lost")
    monkeypatch.setattr(certs.authority, "CERTIFICATE_VALID", timedelta(days=20))
    certs.issue_client(directory, "tablet")
    certs.renew(directory, "server")
    found = by_subject(secrets.certificates(config.load(here / "appliance.yaml"), None))
    assert "18 days left" in found["the server's certificate"].text
    assert "by itself" in found["the server's certificate"].advice
    assert found["the CA"].level == found["the revocation list"].level == "ok"
    assert "cert renew tablet" in found["certificate of tablet"].advice
    monkeypatch.setattr(certs.authority, "_now", lambda: certs.files.RELEASED - timedelta(days=40))
    monkeypatch.setattr(certs.authority, "out_of_time", lambda *_: "")
    certs.renew(directory, "server")
    found = by_subject(secrets.certificates(config.load(here / "appliance.yaml"), None))
    assert found["the server's certificate"].level == "error"
    assert "it ran out on " in found["the server's certificate"].text


# ROS


def test_without_ros(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros, "available", lambda: (False, "there is no ROS 2 here. Source one"))
    finding = ros.which_ros(is_needed=True)
    assert finding == Finding("error", "ROS", "there is no ROS 2 here", "Source one")
    assert ros.which_ros(is_needed=False).level == "warning"
    subjects = [each.subject for each in ros.ros(write(here, bridge={}), None)]
    assert "ROS nodes" not in subjects and "shared memory" in subjects


@pytest.mark.parametrize(("domain", "level"), [("7", "ok"), ("150", "warning"), ("x", "error")])
def test_domains(here: Path, monkeypatch: pytest.MonkeyPatch, domain: str, level: str) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    [finding] = ros._discovery(write(here, bridge={}))
    assert finding.level == level and "nodes of this computer only" in finding.text


def test_it_has_the_environment_of_the_running_one(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A domain of its own, which is in /etc/default/appliance, is not in root's shell."""
    for name in ros._DISCOVERY:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROS_DOMAIN_ID", "1")
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    settings = config.load(here / "appliance.yaml")
    assert ros.adopt_environment(settings, None) == []
    environment = {"ROS_DOMAIN_ID": "42", "ROS_LOCALHOST_ONLY": "1", "HOME": "/nowhere"}
    with subprocess.Popen(["sleep", "60"], env=environment) as running:
        try:
            environ = Path(f"/proc/{running.pid}/environ")
            eventually(environ.read_bytes, "its environment, a moment after it has begun")
            adopted = ros.adopt_environment(settings, {"pid": running.pid})
        finally:
            running.kill()
    assert adopted == ["no RMW_IMPLEMENTATION", "ROS_DOMAIN_ID=42"]
    assert os.environ["ROS_DOMAIN_ID"] == "42" and "RMW_IMPLEMENTATION" not in os.environ
    assert os.environ["HOME"] != "/nowhere"


def test_the_running_one_may_be_seen_after_others(here: Path) -> None:
    """That it was not seen at first is no reason to say that nodes do not find each other."""
    seen_by = SimpleNamespace(
        name="/me", nodes=lambda: ["/me", "/peer"], topics=dict, elsewhere=set
    )
    seen = ros._Discovered(seen_by, "/appliance")  # type: ignore[arg-type]
    seen.update()
    assert not seen._is_done.is_set()
    seen_by.nodes = lambda: ["/me", "/appliance", "/peer"]
    seen.update()
    assert seen._is_done.is_set()


def test_another_node_of_the_same_name() -> None:
    seen_by = SimpleNamespace(
        name="/me", nodes=lambda: ["/me", "/appliance"], topics=dict, elsewhere=set
    )
    seen = ros._Discovered(seen_by, "/appliance")  # type: ignore[arg-type]
    seen.update()
    assert not seen.has_twin
    seen_by.nodes = lambda: ["/me", "/appliance", "/appliance"]
    seen.update()
    assert seen.has_twin


def test_shared_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = SimpleNamespace(free=1 << 30)
    monkeypatch.setattr(ros.shutil, "disk_usage", lambda folder: usage)
    assert [each.level for each in ros.shared_memory(tmp_path)] == ["ok"]
    usage.free = 1 << 20
    [finding] = ros.shared_memory(tmp_path)
    assert finding.level == "warning" and "--shm-size" in finding.advice
    [finding] = ros.shared_memory(tmp_path / "none")
    assert finding.level == "warning"


def test_a_bus_that_is_not_ros_2_is_left_alone(here: Path) -> None:
    parts: list[Part] = [ros.ros]
    [finding] = parts[0](write(here), None)
    assert finding.text == "bridge.bus is none"


def test_ros_1_that_is_not_here(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    monkeypatch.setattr(ros1, "available", lambda: (False, "it is not here. Install it"))
    routes = {"topics": [{"ros": "/odom", "to": "mqtt"}]}
    for bridge, level in ((routes, "error"), ({}, "warning")):
        found = by_subject(ros.ros(write(here, bridge={"bus": "ros1", **bridge}), None))
        assert found["ROS"] == Finding(level, "ROS", "it is not here", "Install it")
        master = found["ROS Master"]
        assert (master.level, "start roscore" in master.advice) == (level, True)
        assert "http://127.0.0.1:1: [Errno 111]" in master.text
        assert found["ROS network"].level == "ok"
    far = ros1._address("http://192.0.2.1:11311")
    assert far.level == "warning" and "which other computers take for themselves" in far.text


def test_what_ros_lost_is_told_with_what_to_do() -> None:
    sick = [
        {"route": "/image → r2/image", "problem": "messages lost: 88", "lost": 88},
        {"route": "/odom → r2/odom", "problem": "messages dropped: 1", "lost": 0},
    ]
    told = {"version": "1", "pid": 1, "clients": 0, "warnings": [], "routes": {"sick": sick}}
    found = by_subject(examination._running(told))
    assert "appliance fastdds" in found["route /image → r2/image"].advice
    assert not found["route /odom → r2/odom"].advice


def test_a_link_that_does_not_work_is_a_problem_and_told_once() -> None:
    links = [
        {"name": "a", "connected": True, "problem": None},
        {"name": "b", "connected": False, "problem": "refused"},
        {"name": "c", "connected": False, "problem": None},
    ]
    warnings = ["upstream a: state", "upstream b: refused"]
    told = {"version": "1", "pid": 1, "clients": 0, "warnings": warnings, "routes": {"sick": []}}
    found = [(f.level, f.text) for f in examination._running({**told, "upstreams": links})][1:]
    assert found == [
        ("warning", "upstream a: state"),
        ("error", "the running link is not connected: refused"),
        ("error", "the running link is not connected: it is being dialled"),
    ]


def test_an_open_bus_is_warned_of(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*ros._DISCOVERY, "ROS_SECURITY_ENABLE", *fastdds.VARIABLES):
        monkeypatch.setenv(name, "")  # what is set below is undone
        monkeypatch.delenv(name)
    [_, finding] = ros._discovery(write(here, bridge={}))
    assert finding.level == "warning" and "publish commands" in finding.text
    assert "bridge.discovery: localhost" in finding.advice
    monkeypatch.setenv("ROS_SECURITY_ENABLE", "true")
    monkeypatch.setenv("ROS_SECURITY_STRATEGY", "Enforce")
    assert len(list(ros._discovery(write(here, bridge={})))) == 1
    monkeypatch.delenv("ROS_SECURITY_ENABLE")
    settings = write(here, bridge={"discovery": "localhost"})
    discovery.use(settings.bridge.discovery, os.environ)
    [finding] = ros._discovery(settings)
    assert "nodes of this computer only" in finding.text


def test_nodes_of_other_computers_are_named(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def node(*_: object) -> SimpleNamespace:
        return SimpleNamespace(
            name="/me",
            start=lambda look, failed: look(),
            stop=lambda: None,
            nodes=lambda: ["/me", "/near", "/far"],
            topics=dict,
            elsewhere=lambda: {"/far"},
        )

    monkeypatch.setattr(ros, "Ros2Node", node)
    monkeypatch.setattr(ros, "LEAST_PATIENCE", 0.0)
    seen, elsewhere = ros._discover(write(here, bridge={}), None)
    assert seen.level == "ok" and "2 (/far, /near)" in seen.text
    assert elsewhere.level == "warning" and "1 (/far)" in elsewhere.text
