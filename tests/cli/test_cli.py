"""The command `appliance`: what it prints, how it ends, and that nobody sees a traceback."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
import typer
import yaml
from command_line import run, set_up
from waiting import PATIENCE, eventually

from appliance import config
from appliance.access import Passwords, groups
from appliance.cli import connection
from appliance.cli import main as cli
from appliance.ops.check import check
from appliance.store import database


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that was set up with `init`, as the current one."""
    return set_up(tmp_path, monkeypatch)


@pytest.fixture
def output(here: Path, capsys: pytest.CaptureFixture[str]) -> pytest.CaptureFixture[str]:
    capsys.readouterr()
    return capsys


def typed(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))


def test_help_is_there_at_once_and_for_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    text = capsys.readouterr().out
    for command in ("init", "run", "check", "user", "cert", "acl", "pub", "sub", "bench", "demo"):
        assert f" {command} " in text
        assert run(command, "--help") == 0


def test_no_help_is_cut_off_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """There it is 80 columns wide."""

    def texts(command: object, *path: str) -> Iterator[tuple[tuple[str, ...], str]]:
        assert run(*path, "--help") == 0
        yield path, capsys.readouterr().out
        for name, each in getattr(command, "commands", {}).items():
            yield from texts(each, *path, name)

    told = dict(texts(typer.main.get_command(cli.app)))
    assert len(told) > 30
    assert {path: text for path, text in told.items() if "…" in text} == {}


def test_a_command_loads_only_what_it_needs() -> None:
    code = """
import sys
from appliance.cli import main as cli
try: cli.main(["--help"])
except SystemExit: pass
heavy = {"amqtt", "asyncio", "cryptography", "paho", "pydantic", "rclpy", "uvloop", "yaml"}
print(*sorted(heavy & set(sys.modules)), file=sys.stderr)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stderr.strip() == ""


def test_wrong_usage_is_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("rnu") == 2
    assert run("run", "--log-format", "xml") == 2
    assert run("pub", "a", "-m", "x", "-f", "y") == 2
    assert run("sub") == 2


def test_a_new_user_has_its_groups_or_is_told_that_it_may_do_nothing(
    here: Path, output: pytest.CaptureFixture[str]
) -> None:
    assert run("user", "add", "bob", "--generate", "--group", "pilots") == 1
    assert "no group 'pilots'; there are admins, drivers, viewers" in output.readouterr().err
    assert "bob" not in Passwords.load(here / "users.passwd").users()
    assert run("user", "add", "bob", "--generate") == 0
    text = output.readouterr().out
    assert "It may do nothing yet" in text and "a group: admins, drivers, viewers" in text
    members = ["--group", "viewers", "--group", "drivers"]
    assert run("user", "add", "carol", "--generate", *members) == 0
    assert "nothing yet" not in output.readouterr().out
    assert groups.members(here / "acl.conf")["carol"] == ["viewers", "drivers"]


@pytest.mark.parametrize("content", [bytes(range(128, 256)), b"a" * 100_000])
def test_a_password_file_that_is_something_else(
    here: Path, output: pytest.CaptureFixture[str], content: bytes
) -> None:
    before = (here / "users.passwd").read_bytes()
    (here / "other.file").write_bytes(content)
    assert run("user", "add", "bob", "--password-file", "other.file") == 1
    assert "other.file: " in output.readouterr().err
    assert (here / "users.passwd").read_bytes() == before


def test_nothing_gets_the_numbers_of_closed_standard_streams(here: Path) -> None:
    """A C library's complaint on number 2 would be written into the database."""
    settings = yaml.safe_load((here / "appliance.yaml").read_text())
    settings |= {"broker": {"listeners": [{"bind": "127.0.0.1:0"}]}, "bridge": {"bus": "none"}}
    (here / "appliance.yaml").write_text(yaml.safe_dump(settings))
    command = [sys.executable, "-m", "appliance", "run"]
    process = subprocess.Popen(command, preexec_fn=lambda: os.closerange(0, 3))
    try:
        eventually(lambda: (here / "state/control.sock").exists(), "it runs")
        links = [str(Path(f"/proc/{process.pid}/fd/{number}").readlink()) for number in range(3)]
    finally:
        process.terminate()
        process.wait(PATIENCE)
    assert links == ["/dev/null"] * 3
    assert process.returncode == 0


def test_init_tells_the_password_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    directory = str(tmp_path / "x")
    assert run("init", "--dir", directory, "--user", "alice") == 0
    text = capsys.readouterr().out
    password = text.partition("user alice, password ")[2].split()[0]
    assert Passwords.load(tmp_path / "x/users.passwd").verify("alice", password.encode())
    assert text.index("password ") > text.rindex("made ")
    assert run("init", "--dir", directory) == 0
    text = capsys.readouterr().out
    assert "user alice, password" not in text
    assert "made" not in text


def test_init_in_a_place_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert run("init", "--dir", str(tmp_path / "file/x")) == 1
    assert "Not a directory" in capsys.readouterr().err


def test_check_of_what_init_made(output: pytest.CaptureFixture[str]) -> None:
    assert run("check") == 0
    text = output.readouterr().out
    assert "error" not in text
    assert "users: alice" in text
    assert "rules: 8" in text


def test_check_changes_nothing(here: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in here.rglob("*")}
    run("check", "--show")
    assert {path: path.stat().st_mtime_ns for path in here.rglob("*")} == before


def test_check_reads_the_store_and_leaves_nothing_beside_it(
    here: Path, output: pytest.CaptureFixture[str]
) -> None:
    path = here / "state/store.db"
    path.parent.mkdir()
    contents = database.read(path, "power")
    assert contents.connection is not None
    contents.connection.close()
    files = sorted(path.parent.iterdir())
    assert run("check") == 0
    assert f"{path}: kept: sessions 0, retained messages 0" in output.readouterr().out
    assert sorted(path.parent.iterdir()) == files
    path.write_bytes(b"nonsense" * 1000)
    assert run("check") == 0
    assert f"warning broker.store.path: {path} cannot be read" in output.readouterr().out


@pytest.mark.parametrize(
    ("file", "content", "finding"),
    [
        ("users.passwd", "alice:secret\n", "users.passwd:1:7: a plain password is not accepted"),
        ("users.passwd", None, "users.passwd: there is no such file"),
        ("acl.conf", "user alice\ntopci read #\n", "acl.conf:2:1: "),
        ("certs/server.crt", "nothing", "server.crt is not a certificate in PEM form"),
        ("certs/server.key", None, "server.key"),
    ],
)
def test_check_finds(
    here: Path,
    output: pytest.CaptureFixture[str],
    file: str,
    content: str | None,
    finding: str,
) -> None:
    (here / file).unlink()
    if content is not None:
        (here / file).write_text(content)
    assert run("check") == 1
    errors = [line for line in output.readouterr().out.splitlines() if line.startswith("error")]
    assert len(errors) == 1
    assert finding in errors[0]


def test_check_of_a_key_of_another_certificate(
    here: Path, output: pytest.CaptureFixture[str]
) -> None:
    other = here / "other"
    assert run("init", "--dir", str(other)) == 0
    (here / "certs/server.key").write_bytes((other / "certs/server.key").read_bytes())
    output.readouterr()
    assert run("check") == 1
    assert "is not the key of" in output.readouterr().out


def test_check_warns(here: Path, output: pytest.CaptureFixture[str]) -> None:
    (here / "appliance.yaml").write_text(
        "robot: r2\nbroker: {anonymous: true, listeners: [{bind: ':1883'}],"
        " plugins: {no_such.module.Plugin: {password: hunter2}}}"
    )
    with (here / "acl.conf").open("a") as acl:
        acl.write("user bob\ntopic #\n")
    (here / "users.passwd").chmod(0o644)
    assert run("check", "--show") == 1
    text = output.readouterr().out
    assert "warning listener :1883: without TLS: everyone" in text
    assert "warning broker.anonymous" in text
    assert "is open to every user of this computer" in text
    assert "error   plugin no_such.module.Plugin: there is no Python module" in text
    assert "hunter2" not in text


def test_a_wrong_configuration_is_told_as_a_whole(
    here: Path, output: pytest.CaptureFixture[str]
) -> None:
    (here / "appliance.yaml").write_text("robt: r2\nlog: {level: loud}\n")
    for command in (["check"], ["run"], ["user", "list"], ["acl", "explain", "a", "b"]):
        assert run(*command) == 1
        error = output.readouterr().err
        assert "appliance.yaml:1: robt: unknown key; did you mean 'robot'?" in error
        assert "appliance.yaml:2: log.level: must be debug" in error


def test_no_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("run", "-c", "none.yaml") == 1
    assert "none.yaml: no such file; `appliance init` writes one" in capsys.readouterr().err


def test_users(
    here: Path, output: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "password").write_text("first\nnot this line\n")
    assert run("user", "add", "bob", "--password-file", "password") == 0
    assert Passwords.load(here / "users.passwd").verify("bob", b"first")
    assert run("user", "add", "bob", "--generate") == 1
    assert "there is a user 'bob' already" in output.readouterr().err

    typed(monkeypatch, "second\r\n")
    assert run("user", "passwd", "bob", "--password-file", "-") == 0
    assert Passwords.load(here / "users.passwd").verify("bob", b"second")

    output.readouterr()
    assert run("user", "passwd", "bob", "--generate") == 0
    password = output.readouterr().out.split()[1]
    assert Passwords.load(here / "users.passwd").verify("bob", password.encode())

    assert run("user", "list") == 0
    assert output.readouterr().out == "alice  argon2id\nbob    argon2id\n"
    acl = here / "acl.conf"
    before = groups.members(acl)
    groups.join(acl, "r2", "bob", ["drivers"])
    output.readouterr()
    assert run("user", "remove", "bob") == 0
    assert groups.members(acl) == before
    assert output.readouterr().out == "user bob removed\n"

    assert run("user", "add", "carol", "--generate", "--group", "viewers") == 0
    line = acl.read_text().count("\n")
    acl.write_text(acl.read_text() + "# hers\ntopic read {robot}/lab/#\n")
    output.readouterr()
    assert run("user", "remove", "carol") == 0
    told = f"its own rules stay in acl.conf (line {line + 1}): a new user of that name"
    assert told in output.readouterr().out
    for command in ("remove", "passwd"):
        assert run("user", command, "bob") == 1
        assert "there is no user 'bob' in users.passwd" in output.readouterr().err


def test_passwords_that_cannot_be(
    here: Path, output: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    typed(monkeypatch, "\n")
    assert run("user", "add", "bob") == 1
    assert "no terminal to ask on" in output.readouterr().err
    assert run("user", "add", "bob", "--password-file", "-") == 1
    assert "must not be empty" in output.readouterr().err
    assert run("user", "add", "b:b", "--generate") == 1
    assert run("user", "add", "bob", "--generate", "--password-file", "x") == 2
    assert run("user", "add", "bob", "--password-file", "none") == 1
    assert Passwords.load(here / "users.passwd").users() == ["alice"]


def test_the_first_user_of_a_new_file(here: Path) -> None:
    (here / "users.passwd").unlink()
    assert run("user", "list") == 1
    assert run("user", "add", "bob", "--generate") == 0
    assert Passwords.load(here / "users.passwd").users() == ["bob"]


def test_acl_explain(output: pytest.CaptureFixture[str]) -> None:
    assert run("acl", "explain", "alice", "r2/odom") == 0
    text = output.readouterr().out
    assert "read       allowed  groups/viewers.conf:3: topic read r2/#" in text
    assert "write      refused" in text
    assert run("acl", "explain", "", "r2/#") == 0
    assert "subscribe  refused" in output.readouterr().out
    assert run("acl", "explain", "alice", "r2/#/x") == 2
    assert "no user" not in output.readouterr().err
    assert run("acl", "explain", "alcie", "r2/odom") == 0
    assert "note: there is no user 'alcie' in users.passwd" in output.readouterr().err
    assert run("acl", "explain", "alice", "r2/_appliance/state") == 0
    assert "note: nobody may publish there" in output.readouterr().err


def test_the_client_needs_a_password(
    output: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("APPLIANCE_PASSWORD", raising=False)
    typed(monkeypatch, "")
    assert run("sub", "r2/#", "-u", "alice") == 1
    assert "no password; use --password-file or APPLIANCE_PASSWORD" in output.readouterr().err


def test_the_client_takes_what_is_not_said_from_the_configuration(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (here / "appliance.yaml").write_text(
        "broker: {listeners: [{bind: ':1'}, {bind: ':2', tls: true}]}"
    )
    monkeypatch.setenv("APPLIANCE_PASSWORD", "secret")

    def target(**options: str | int | Path | None) -> object:
        return connection.ConnectionOptions(host="h", user="alice", **options).target()  # type: ignore[arg-type]

    from appliance.cli.mqtt_client import ConnectionSettings

    assert target() == ConnectionSettings("h", 2, here / "certs/ca.crt", "alice", "secret")
    assert target(port=3) == ConnectionSettings("h", 3, None, "alice", "secret")
    config = here / "appliance.yaml"
    assert target(port=3, config=config) == ConnectionSettings(
        "h", 3, here / "certs/ca.crt", "alice", "secret"
    )


def test_ros_arguments_stand_behind_ros_args() -> None:
    given = ["run", "--ros-args", "-r", "/a:=/b", "--", "-c", "x.yaml", "--ros-args", "-p", "p:=1"]
    ours, ros = cli._split_ros_arguments(given)
    assert ours == ["run", "-c", "x.yaml"]
    assert ros == ["-r", "/a:=/b", "-p", "p:=1"]
    assert cli._split_ros_arguments(["pub", "--", "-x"]) == (["pub", "--", "-x"], [])


def test_the_file_for_fast_dds(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("fastdds") == 0
    printed = capsys.readouterr()
    root = ElementTree.fromstring(printed.out)
    sizes = [each.text for each in root.iter() if each.tag.endswith("segment_size")]
    assert sizes == [str(16 << 20)]
    assert "FASTDDS_DEFAULT_PROFILES_FILE" in printed.err
    assert run("fastdds", "--segment", "64 MiB") == 0
    assert str(64 << 20) in capsys.readouterr().out
    for wrong in ("64", "1 KiB", "1 TiB", "much"):
        assert run("fastdds", "--segment", wrong) == 2, wrong


@pytest.mark.parametrize(
    ("said", "variable", "level", "text"),
    [
        ("localhost", "SUBNET", "ok", "this computer only"),
        ("environment", "LOCALHOST", "ok", "this computer only"),
        ("environment", "SUBNET", "warning", "publish commands"),
        ("subnet", "LOCALHOST", "warning", "publish commands"),
    ],
)
def test_check_says_who_is_on_the_robots_bus(
    here: Path, monkeypatch: pytest.MonkeyPatch, said: str, variable: str, level: str, text: str
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", variable)
    file = here / "appliance.yaml"
    file.write_text(file.read_text().replace("discovery: localhost", f"discovery: {said}"))
    found = {each.subject: each for each in check(config.load(file))}
    assert found["bridge.discovery"].level == level
    assert text in found["bridge.discovery"].text
