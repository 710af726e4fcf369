"""No secret is told: not in a log, an error or the audit log, and not to other users by `ps`."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from appliance_process import ApplianceProcess
from raw_client import RawClient
from waiting import eventually

from appliance.access import Passwords
from appliance.cli import main as cli
from appliance.mqtt.packets import Connack, Connect

BIND = "bind-password-of-a-directory"
WRONG = "wrong passwörd of a stranger"
SCRAM = "kept for scram, and long enough"
HTTP = "a-token-for-the-other-server"


class Talkative:
    """What may be said, gathered."""

    def __init__(self) -> None:
        self.text = ""

    def command(self, *arguments: str, **more: Any) -> int:
        done = subprocess.run(
            [sys.executable, "-m", "appliance", *arguments],
            capture_output=True,
            text=True,
            timeout=60,
            stdin=more.pop("stdin", subprocess.DEVNULL),
            **more,
        )
        self.text += done.stdout + done.stderr
        return done.returncode


def test_no_output_of_a_run_has_a_secret_in_it(tmp_path: Path) -> None:
    said = Talkative()
    process = ApplianceProcess(
        tmp_path,
        users={"bob": "bob's own password"},
        broker={
            "audit": {"path": "audit.log"},
            "plugins": {
                "test_secrets_plugin.Failing": {"bind_password": BIND, "url": f"http://u:{HTTP}@h"}
            },
        },
    )
    settings = yaml.safe_load(process.config.read_text())
    settings["log"] = {"level": "debug", "levels": {"amqtt": "debug"}}
    process.config.write_text(yaml.safe_dump(settings))
    users = Passwords.load(tmp_path / "users.passwd")
    users.set("sally", SCRAM, for_scram=True)
    users.save()
    hashes = [users.hash_of(name) or "" for name in users.users()]
    (tmp_path / "test_secrets_plugin.py").write_text(PLUGIN)
    before = os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = f"{tmp_path}{os.pathsep}{before}"
    try:
        process.start()
        config = str(process.config)
        for user, password in [("alice", WRONG), ("stranger", WRONG), ("sally", WRONG)]:
            for version in (4, 5):
                with RawClient(process, version, tls=version == 5) as client:
                    answer = client.decode(client.connect("c", user, password))
                    assert isinstance(answer, Connack) and answer.reason_code
        for user in ("alice", "bob"):
            with RawClient(process, 5, tls=True) as client:
                client.connect(user, user)
        with RawClient(process, 5) as client:  # a packet that is broken behind the password
            packet = Connect("c", username="x", password=WRONG.encode()).encode()
            client.socket.sendall(packet + b"\xff\xff\xff\xff\xff")
            client.socket.recv(100)
        password_file = tmp_path / "password"
        password_file.write_text("another password, from a file\n")
        assert (
            said.command(
                "user", "passwd", "bob", "--password-file", str(password_file), "-c", config
            )
            == 0
        )
        said.command("user", "list", "-c", config)
        said.command("check", "--show", "-c", config)
        said.command(
            "pub",
            "r2d2/x",
            "-m",
            "x",
            "-u",
            "bob",
            "-p",
            str(process.port),
            "--ca",
            str(process.ca),
            "--password-file",
            str(password_file),
        )
        process.stop()
        broken = settings["broker"]["plugins"]["test_secrets_plugin.Failing"]
        broken["bind_password"] = [BIND]
        process.config.write_text(yaml.safe_dump(settings))
        assert said.command("run", "-c", config) == 1
        (tmp_path / "users.passwd").write_text(f"bob:{WRONG}\n")
        assert said.command("check", "-c", config) == 1
    finally:
        process.stop()
        os.environ["PYTHONPATH"] = before
    told = said.text + process.log + (tmp_path / "audit.log").read_text()
    assert "the directory is away" in told  # the plugin did fail, and said why
    assert "Failing" in said.text
    secrets = [WRONG, SCRAM, BIND, HTTP, "another password, from a file", *hashes]
    secrets += process.passwords.values()
    keys = [path.read_text().splitlines()[1] for path in (tmp_path / "certs").glob("*.key")]
    assert keys
    for secret in filter(None, [*secrets, *keys]):
        assert secret not in told, told[max(0, told.index(secret) - 300) :][:600]
        assert repr(secret)[1:-1] not in told


PLUGIN = """\
from dataclasses import dataclass

from amqtt.plugins.base import BaseAuthPlugin


class Failing(BaseAuthPlugin):
    async def authenticate(self, *, session):
        raise RuntimeError(
            f"the directory is away: {self.config!r} as {session.username} {session.password!r}"
        )

    @dataclass
    class Config:
        bind_password: str
        url: str
"""


@pytest.mark.parametrize("command", ["pub", "sub", "user add", "user passwd", "init"])
def test_no_command_takes_a_password_as_an_argument(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    options = re.findall(r"--?[a-zA-Z][\w-]*", capsys.readouterr().out)
    assert "--config" in options or command == "init"
    assert not {"--password", "--pass", "-P", "--pw"} & set(options)


def test_ps_shows_no_password(appliance: ApplianceProcess, tmp_path: Path) -> None:
    password = appliance.passwords["bob"]
    command = ["sub", "r2d2/#", "-u", "bob", "-p", str(appliance.port), "--ca", str(appliance.ca)]
    environment = os.environ | {"APPLIANCE_PASSWORD": password}
    count = appliance.log.count("client 'shown'")
    process = subprocess.Popen(
        [sys.executable, "-m", "appliance", *command, "--id", "shown"], env=environment
    )
    try:
        eventually(lambda: appliance.log.count("client 'shown'") > count, "it is connected")
        shown = Path(f"/proc/{process.pid}/cmdline").read_bytes()
        title = Path(f"/proc/{process.pid}/comm").read_bytes()
        assert b"r2d2/#" in shown and password.encode() not in shown + title
        mode = Path(f"/proc/{process.pid}/environ").stat().st_mode
        assert not mode & 0o077  # it has the password, and is its owner's alone
    finally:
        process.kill()
        process.wait()


def test_a_configuration_with_secrets_that_all_can_read_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plugins = {"amqtt.plugins.sys.broker.BrokerSysPlugin": {"api_key": "sesame"}}
    process = ApplianceProcess(tmp_path, broker={"plugins": plugins})

    def check() -> str:
        with pytest.raises(SystemExit):
            cli.main(["check", "-c", str(process.config)])
        return capsys.readouterr().out

    process.config.chmod(0o644)
    assert "has secrets in it" in check()
    process.config.chmod(0o640)
    assert "has secrets in it" not in check()
    process.config.chmod(0o644)
    process.config.write_text(process.config.read_text().replace("sesame", "${SESAME:-}"))
    assert "has secrets in it" not in check()
