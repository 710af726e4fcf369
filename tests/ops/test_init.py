"""`appliance init`: makes what is missing, keeps what is there, and what it makes is good."""

from __future__ import annotations

import shutil
import ssl
import stat
import subprocess
from pathlib import Path

import pytest

from appliance import certs, config
from appliance.access import Acl, Passwords
from appliance.broker.values import Action, Identity
from appliance.ops.check import check
from appliance.ops.init import (
    Credentials,
    InitError,
    InitStep,
    NextSteps,
    initialise,
    robot_name,
)


def made(steps: list[InitStep | Credentials]) -> set[str]:
    return {step.path.name for step in steps if isinstance(step, InitStep) and step.made}


def credentials(steps: list[InitStep | Credentials]) -> Credentials:
    assert isinstance(steps[-1], Credentials)
    return steps[-1]


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_robot_of_the_environment_is_checked_before_anything_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("APPLIANCE_ROBOT", "r2/d2")
    with pytest.raises(InitError, match=r"APPLIANCE_ROBOT is 'r2/d2': the robot's name must be"):
        list(initialise(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_everything_is_made_and_good(tmp_path: Path) -> None:
    directory = tmp_path / "new" / "robot"
    steps = list(initialise(directory, robot="R2 D2!"))
    assert made(steps) == {
        "appliance.yaml",
        "ca.crt",
        "server.crt",
        "README.md",
        "acl.conf",
        "users.passwd",
    }
    settings = config.load(directory / "appliance.yaml")
    assert settings.robot == "R2-D2"
    default, web = config.loads("", directory / "x.yaml", {}), settings.broker.listeners[-1]
    assert settings.broker.listeners[:-1] == default.broker.listeners
    assert web.is_web_over_tls and str(web.bind) == "0.0.0.0:8443"
    assert [finding for finding in check(settings) if finding.level == "error"] == []
    first = credentials(steps)
    assert Passwords.load(settings.broker.users).verify(first.user, first.password.encode())
    assert mode(settings.broker.users) == 0o600
    assert mode(settings.broker.tls.key) == 0o600
    assert mode(settings.broker.tls.ca.with_name("ca.key")) == 0o600
    assert not list(directory.glob(".*"))
    # Only those who have the CA's certificate trust the server's.
    ssl.create_default_context(cafile=str(settings.broker.tls.ca))


def test_the_first_user_reads_all_of_the_robot_and_writes_what_is_listed(tmp_path: Path) -> None:
    list(initialise(tmp_path, robot="r2", user="alice"))
    acl = Acl.load(tmp_path / "acl.conf", "r2")
    expected = {
        (Action.RECEIVE, "r2/odom"): True,
        (Action.SUBSCRIBE, "r2/#"): True,
        (Action.SUBSCRIBE, "$SYS/#"): True,
        (Action.PUBLISH, "r2/cmd_vel"): True,
        (Action.PUBLISH, "r2/odom"): False,
        (Action.RECEIVE, "other/odom"): False,
        (Action.PUBLISH, "$SYS/broker/uptime"): False,
    }
    alice = Identity("alice", "client")
    decisions = {key: acl.decide(alice, *key).allowed for key in expected}
    assert decisions == expected
    for nobody in (Identity("bob", "client"), Identity(None, "client")):
        assert not any(acl.decide(nobody, *key).allowed for key in expected)


def test_the_groups_that_are_made(tmp_path: Path) -> None:
    list(initialise(tmp_path, robot="r2", user="alice"))
    more = "user bob\ninclude groups/drivers.conf\nuser carol\ninclude groups/viewers.conf\n"
    with (tmp_path / "acl.conf").open("a") as file:
        file.write(more)
    acl = Acl.load(tmp_path / "acl.conf", "r2")
    verbs = "$CONTROL/appliance/v1"
    for user, may in {"alice": (1, 1, 1, 1), "bob": (0, 1, 1, 1), "carol": (0, 0, 1, 1)}.items():
        one = Identity(user, "tablet")
        calls = (f"{verbs}/disconnect/_call", "r2/cmd_vel", f"{verbs}/rights/_call/1")
        decided = [acl.decide(one, Action.PUBLISH, topic).allowed for topic in calls]
        decided.append(acl.decide(one, Action.RECEIVE, f"{verbs}/rights/_reply/tablet/1").allowed)
        assert tuple(map(int, decided)) == may
        assert not acl.decide(one, Action.RECEIVE, f"{verbs}/rights/_reply/other/1").allowed


CALLS = """\
robot: r2
bridge:
  services:
    - /reset
    - ["/arm/**", "!/arm/off"]
    - {ros: "/gripper/*", mqtt: "{robot}/hand{ros}"}
    - {ros: /ask, to: mqtt, type: std_srvs/srv/SetBool}
  actions: [/navigate]
  parameters: [/controller/max_speed, "/**/use_*", "!/secret/use_key"]
"""


def test_the_first_user_may_call_what_is_bridged_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "appliance.yaml").write_text(CALLS)
    list(initialise(tmp_path, user="alice"))
    lines = (tmp_path / "groups/drivers.conf").read_text().splitlines()
    assert [line for line in lines if line.startswith("topic write")] == [
        "topic write {robot}/cmd_vel",
        "topic write {robot}/reset/_call/#",
        "topic write {robot}/arm/+/_call/#",
        "topic write {robot}/arm/+/+/_call/#",
        "topic write {robot}/arm/+/+/+/_call/#",
        "topic write {robot}/hand/gripper/+/_call/#",
        "topic write {robot}/navigate/_goal/#",
        "topic write {robot}/navigate/_cancel/#",
        "topic write {robot}/controller/_param/max_speed/set/#",
        "topic write {robot}/controller/_param/_set/#",
        "topic write {robot}/+/_param/+/set/#",
        "topic write {robot}/+/_param/_set/#",
        "topic write {robot}/+/+/_param/+/set/#",
        "topic write {robot}/+/+/_param/_set/#",
        "topic write {robot}/+/+/+/_param/+/set/#",
        "topic write {robot}/+/+/+/_param/_set/#",
    ]
    acl = Acl.load(tmp_path / "acl.conf", "r2")
    alice = Identity("alice", "tablet")
    for topic, may in {
        "r2/reset/_call": True,
        "r2/reset/_call/42": True,
        "r2/arm/left/grip/_call": True,
        "r2/navigate/_goal": True,
        "r2/navigate/_cancel/1": True,
        "r2/node/_param/use_sim_time/set": True,
        "r2/controller/_param/max_speed": False,
        "r2/navigate/_cancel_any": False,
        "r2/navigate/_result/1": False,
        "r2/stop/_call": False,
        "r2/ask/_response/1": False,
        "r2/arm/joint": False,
        "r2/reset": False,
    }.items():
        assert acl.decide(alice, Action.PUBLISH, topic).allowed is may, topic
    assert acl.decide(alice, Action.RECEIVE, "r2/reset/_reply/tablet/42").allowed
    assert [f for f in check(config.load(tmp_path / "appliance.yaml")) if f.level == "error"] == []


def test_parameters_of_ros_1_may_be_at_the_top(tmp_path: Path) -> None:
    (tmp_path / "appliance.yaml").write_text("bridge: {bus: ros1, parameters: [/speed]}")
    list(initialise(tmp_path, user="alice"))
    lines = (tmp_path / "groups/drivers.conf").read_text().splitlines()
    assert "topic write {robot}/_param/speed/set/#" in lines
    assert "topic write {robot}/_param/_set/#" in lines


def test_where_nothing_is_called_yet_the_lines_are_shown(tmp_path: Path) -> None:
    list(initialise(tmp_path, robot="r2", user="alice"))
    drivers = tmp_path / "groups/drivers.conf"
    text = drivers.read_text()
    assert (
        not Acl.load(tmp_path / "acl.conf", "r2")
        .decide(Identity("alice", "tablet"), Action.PUBLISH, "r2/reset/_call")
        .allowed
    )
    drivers.write_text(text.replace("\n#topic", "\ntopic"))
    acl = Acl.load(tmp_path / "acl.conf", "r2")
    assert acl.decide(Identity("alice", "tablet"), Action.PUBLISH, "r2/reset/_call").allowed


def test_a_second_time_everything_is_kept(tmp_path: Path) -> None:
    list(initialise(tmp_path))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    steps = list(initialise(tmp_path))
    assert made(steps) == set()
    assert not any(isinstance(step, Credentials) for step in steps)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_only_what_is_missing_is_made(tmp_path: Path) -> None:
    list(initialise(tmp_path))
    authority = (tmp_path / "certs/ca.crt").read_bytes()
    (tmp_path / "certs/server.crt").unlink()
    (tmp_path / "acl.conf").unlink()
    assert made(list(initialise(tmp_path))) == {"server.crt", "acl.conf"}
    assert (tmp_path / "certs/ca.crt").read_bytes() == authority
    findings = list(check(config.load(tmp_path / "appliance.yaml")))
    assert {finding.level for finding in findings} <= {"ok", "warning"}


def test_what_comes_next_is_said_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder, start in ((tmp_path, "appliance run"), (Path("x"), "appliance run -c x/")):
        (told,) = (step for step in initialise(folder, robot="r2") if isinstance(step, NextSteps))
        assert told.texts[0].startswith(f"start it: {start}")
        assert "operator may read everything of r2, and write r2/cmd_vel; acl.conf" in told.texts[1]
        assert not any(isinstance(step, NextSteps) for step in initialise(folder))
    for options in ({"demo": True}, {"data": tmp_path / "data"}):
        steps = initialise(tmp_path / next(iter(options)), **options)  # type: ignore[arg-type]
        assert not any(isinstance(step, NextSteps) for step in steps)


def test_a_group_that_is_missing_is_made_where_groups_are_used(tmp_path: Path) -> None:
    list(initialise(tmp_path))
    rules = (tmp_path / "acl.conf").read_bytes()
    viewers = tmp_path / "groups/viewers.conf"
    content = viewers.read_bytes()
    viewers.unlink()
    assert made(list(initialise(tmp_path))) == {"viewers.conf"}
    assert viewers.read_bytes() == content and (tmp_path / "acl.conf").read_bytes() == rules
    (tmp_path / "acl.conf").write_text("user operator\ntopic readwrite #\n")
    viewers.unlink()
    list(initialise(tmp_path))
    assert not viewers.exists()
    (tmp_path / "acl.conf").unlink()
    (tmp_path / "acl.conf").mkdir()  # as good as one that may not be read
    assert made(list(initialise(tmp_path))) == set()


PROJECT = Path(__file__).parents[2]


def test_the_repository_has_the_page_that_init_writes(tmp_path: Path) -> None:
    certs.write_readme(tmp_path)
    assert (PROJECT / "certs/README.md").read_text() == (tmp_path / "README.md").read_text()


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_clone_of_the_repository_is_filled_and_stays_clean(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        command = [
            "git",
            "-C",
            str(tmp_path),
            "-c",
            "user.name=x",
            "-c",
            "user.email=x",
            *arguments,
        ]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    for name in (".gitignore", "appliance.yaml", "certs/README.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(PROJECT / name, tmp_path / name)
    (tmp_path / "certs").chmod(0o775)
    git("init", "-q")
    git("add", "-A")
    git("commit", "-q", "-m", "a clone")
    steps = list(initialise(tmp_path, robot="robot"))
    assert made(steps) == {"ca.crt", "server.crt", "acl.conf", "users.passwd"}
    assert (tmp_path / "certs/ca.key").exists() and (tmp_path / "certs/server.key").exists()
    assert mode(tmp_path / "certs") == 0o755
    assert git("status", "--porcelain") == ""
    assert git("ls-files").split() == [".gitignore", "appliance.yaml", "certs/README.md"]


def test_a_configuration_that_names_other_files(tmp_path: Path) -> None:
    (tmp_path / "appliance.yaml").write_text(
        "robot: r2\nbroker: {users: etc/u, acl: etc/a, tls: {certificate: x.crt, key: x.key}}"
    )
    with pytest.raises(InitError, match=r"x\.crt"):
        list(initialise(tmp_path))
    certs.create_authority(tmp_path)
    certs.issue_server(tmp_path, ["localhost"], [])
    (tmp_path / "server.crt").rename(tmp_path / "x.crt")
    (tmp_path / "server.key").rename(tmp_path / "x.key")
    assert made(list(initialise(tmp_path))) == {"a", "u"}


def test_the_demo_keeps_its_password_in_a_file(tmp_path: Path) -> None:
    steps = list(initialise(tmp_path, demo=True))
    file = tmp_path / "user.password"
    assert file.read_text() == credentials(steps).password + "\n"
    assert mode(file) == 0o600
    settings = config.loads(
        (tmp_path / "appliance.yaml").read_text(),
        tmp_path / "appliance.yaml",
        {"APPLIANCE_PORT": "0", "APPLIANCE_PLAIN_PORT": "1", "APPLIANCE_WEB_PORT": "2"},
    )
    assert settings.robot == "demo"
    assert [listener.bind.port for listener in settings.broker.listeners] == [0, 1, 2]
    assert settings.broker.listeners[2].is_web_over_tls
    (drive,) = (route for route in settings.bridge.topics if route.to == "ros")
    assert drive.on_silence is not None, "the console drives no other route"
    assert {(route.ros, route.to) for route in settings.bridge.topics} == {
        ("/odom", "mqtt"),
        ("/battery", "mqtt"),
        ("/scan", "mqtt"),
        ("/camera/image_raw", "mqtt"),
        ("/map", "mqtt"),
        ("/chatter", "mqtt"),
        ("/cmd_vel", "ros"),
    }
    assert [route.ros for route in settings.bridge.services] == ["/reset"]
    assert "topic write {robot}/reset/_call/#\n" in (tmp_path / "groups/drivers.conf").read_text()


@pytest.mark.parametrize("demo", [False, True])
def test_what_it_stores_has_a_folder_of_its_own(tmp_path: Path, demo: bool) -> None:
    data = tmp_path / "kept {here}: #1"
    list(initialise(tmp_path / "files", robot="r2d2", demo=demo, data=data))
    settings = config.load(tmp_path / "files/appliance.yaml")
    assert settings.robot == "r2d2"
    assert settings.broker.store.path == data / "store.db"
    assert settings.crash_reports == data / "crashes"
    assert settings.control == data / "control.sock"
    assert len(settings.broker.listeners) == 3, "the rest is as it is elsewhere"
    assert settings.bridge.discovery == "localhost"


def test_a_service_has_its_socket_elsewhere(tmp_path: Path) -> None:
    socket = tmp_path / "run/control.sock"
    list(initialise(tmp_path, data=tmp_path / "data", control=socket))
    settings = config.load(tmp_path / "appliance.yaml")
    assert settings.control == socket
    assert settings.broker.store.path == tmp_path / "data/store.db"


def test_what_cannot_be(tmp_path: Path) -> None:
    for name in ("*", "*.example", "robot_at home", "", "-x"):
        with pytest.raises(InitError, match="not a DNS name"):
            list(initialise(tmp_path, names=["robot.example", name]))
    assert not list(tmp_path.iterdir())
    with pytest.raises(InitError, match="user name"):
        list(initialise(tmp_path, user="a:b"))
    assert list(tmp_path.iterdir()) == []
    list(initialise(tmp_path, robot="r2"))
    with pytest.raises(InitError, match="robot: r2"):
        list(initialise(tmp_path, robot="c3po"))


@pytest.mark.parametrize(
    ("text", "name"),
    [("r2d2", "r2d2"), ("R2 D2!", "R2-D2"), ("_x/+#", "x"), ("Zoë", "Zo"), ("漢", "robot")],
)
def test_robot_names(text: str, name: str) -> None:
    assert robot_name(text) == name
    assert config.loads(f"robot: '{name}'", Path("x.yaml"), {}).robot == name


def test_a_long_robot_name() -> None:
    config.loads(f"robot: {robot_name('r' * 99)}", Path("x.yaml"), {})


@pytest.mark.parametrize("demo", [False, True])
def test_ros_stays_on_this_computer_unless_the_file_says_otherwise(
    tmp_path: Path, demo: bool
) -> None:
    list(initialise(tmp_path, demo=demo))
    assert config.load(tmp_path / "appliance.yaml").bridge.discovery == "localhost"


def test_a_folder_of_somebodys_own_keeps_its_mode(tmp_path: Path) -> None:
    """Certificates may be beside appliance.yaml, in a folder that a group shares."""
    shared = tmp_path / "shared"
    shared.mkdir()
    (shared / "notes.txt").touch()
    (shared / "appliance.yaml").write_text(
        "robot: r2d2\nbridge: {bus: none}\n"
        "broker: {tls: {certificate: server.crt, key: server.key, ca: ca.crt}}\n"
    )
    shared.chmod(0o2775)
    list(initialise(shared))
    assert (shared / "ca.crt").exists()
    assert mode(shared) == 0o2775
