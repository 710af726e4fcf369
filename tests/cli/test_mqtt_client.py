"""`appliance pub` and `sub` against an independent broker: mosquitto, with TLS."""

from __future__ import annotations

import contextlib
import shutil
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import pytest
from waiting import PATIENCE

from appliance import certs
from appliance.cli import main as cli
from appliance.cli import mqtt_client
from appliance.mqtt.codec import Property
from appliance.mqtt.connect import Connack
from appliance.mqtt.packets import Disconnect, Packet, Puback, Pubcomp, Pubrec, Suback

MOSQUITTO = shutil.which("mosquitto", path="/usr/local/sbin:/usr/sbin:/usr/local/bin:/usr/bin")
pytestmark = pytest.mark.skipif(MOSQUITTO is None, reason="mosquitto is not installed")


@dataclass(frozen=True)
class Peer:
    directory: Path
    port: int

    def arguments(self, command: str, *arguments: str, user: str = "alice") -> list[str]:
        login = ["-u", user, "--password-file", str(self.directory / f"{user}.password")]
        where = ["-p", str(self.port), "--ca", str(self.directory / "ca.crt")]
        return [command, *where, *(login if user else []), *arguments]


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    directory = tmp_path_factory.mktemp("peer")
    certs.create_authority(directory)
    certs.issue_server(directory, ["localhost"], [])
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    users = directory / "users"
    users.touch(mode=0o600)
    subprocess.run(["mosquitto_passwd", "-b", users, "alice", "secret"], check=True)
    (directory / "alice.password").write_text("secret\n")
    (directory / "bob.password").write_text("wrong\n")
    (directory / "acl").write_text("user alice\ntopic robot/#\n")
    (directory / "mosquitto.conf").write_text(
        f"user root\nlistener {port} 127.0.0.1\nallow_anonymous false\n"
        f"cafile {directory}/ca.crt\ncertfile {directory}/server.crt\n"
        f"keyfile {directory}/server.key\npassword_file {users}\nacl_file {directory}/acl\n"
    )
    assert MOSQUITTO
    process = subprocess.Popen([MOSQUITTO, "-c", directory / "mosquitto.conf"])
    try:
        _wait_for(port)
        yield Peer(directory, port)
    finally:
        process.terminate()
        process.wait(PATIENCE)


def _wait_for(port: int) -> None:
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except OSError:
            assert time.monotonic() < deadline, "mosquitto does not listen"
            time.sleep(0.02)


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(arguments)
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.mark.parametrize("version", ["5", "311"])
def test_what_is_published_is_printed(
    peer: Peer, version: str, capfd: pytest.CaptureFixture[str]
) -> None:
    topic = f"robot/{version}"
    assert run(peer.arguments("pub", topic, "-m", "hello", "-r", "-V", version)) == 0
    arguments = peer.arguments("sub", topic, "-v", "-C", "1", "-W", "10", "-V", version)
    assert run(arguments) == 0
    assert capfd.readouterr().out == f"{topic} hello\n"


def test_payloads_from_a_file_and_from_lines(
    peer: Peer,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "payload").write_bytes(b"\x00\xff")
    (tmp_path / "lines").write_bytes(b"one\ntwo\n")
    assert run(peer.arguments("pub", "robot/file", "-f", str(tmp_path / "payload"), "-r")) == 0
    with (tmp_path / "lines").open() as lines:
        monkeypatch.setattr("sys.stdin", lines)
        assert run(peer.arguments("pub", "robot/lines", "-l", "-r", "-q", "2")) == 0
    assert run(peer.arguments("sub", "robot/lines", "-C", "1", "-W", "10")) == 0
    assert capfd.readouterr().out == "two\n"


def test_a_message_again_and_again(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    repeated = ("--repeat", "3", "--repeat-delay", "0.1")
    assert run(peer.arguments("pub", "robot/drive", "-m", "subscribed", "-r")) == 0
    command = [sys.executable, "-m", "appliance", *peer.arguments("sub", "robot/drive", "-C", "4")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline() == "subscribed\n"
        begun = time.monotonic()
        assert run(peer.arguments("pub", "robot/drive", "-m", "go", "-q", "0", *repeated)) == 0
        assert time.monotonic() - begun >= 0.2
        assert process.stdout.read() == "go\n" * 3
    assert run(peer.arguments("pub", "robot/drive", "-l", *repeated)) == 2
    assert "exclude each other" in capfd.readouterr().err


def test_too_few_messages_in_time(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(peer.arguments("sub", "robot/none", "-W", "0.1")) == 0
    assert run(peer.arguments("sub", "robot/none", "-W", "0.1", "-C", "1")) == 1
    assert "0 of 1 messages came within 0.1 s" in capfd.readouterr().err


def test_silence_is_told_once_and_at_a_terminal(
    peer: Peer, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(mqtt_client, "SILENCE", 0.05)
    assert run(peer.arguments("sub", "robot/none", "-W", "0.3")) == 0
    assert capfd.readouterr().err == ""
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert run(peer.arguments("sub", "robot/none", "-W", "0.3")) == 0
    assert capfd.readouterr().err.count("nothing came yet") == 1


@pytest.mark.parametrize("version", ["5", "311"])
def test_a_wrong_password(peer: Peer, version: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(peer.arguments("sub", "robot/a", "-V", version, user="bob")) == 1
    error = capfd.readouterr().err
    assert f"localhost:{peer.port} refused user 'bob': Not authorized" in error
    assert "Traceback" not in error


def test_no_user(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(peer.arguments("sub", "robot/a", user="")) == 1
    assert "refused a client without user name" in capfd.readouterr().err


def test_a_publish_that_the_acl_refuses(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(peer.arguments("pub", "other", "-m", "x")) == 1
    error = capfd.readouterr().err
    assert "'other' was refused: Not authorized" in error
    assert "The ACL line that allows it: `topic write other`, below `user alice` or in" in error


@pytest.mark.parametrize(
    ("version", "said"),
    [
        ("5", "nothing takes calls at robot/reset/_call: "),
        ("311", "may alice read robot/reset/_reply/phone/#? mosquitto does not say that"),
    ],
)
def test_a_call_through_a_fleets_broker_that_no_robot_answers(
    peer: Peer, version: str, said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    options = ("-V", version, "-W", "0.2", "-i", "phone", "--robot", "robot", "/reset")
    with pytest.raises(SystemExit, match="1"):
        cli.main(peer.arguments("call", *options))
    told = capfd.readouterr().err
    assert said in told and "Through a fleet's broker: " in told


def test_a_port_alone_leaves_the_rest_to_the_configuration(
    peer: Peer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("appliance.yaml").write_text(f"broker: {{tls: {{ca: {peer.directory / 'ca.crt'}}}}}\n")
    login = ["-u", "alice", "--password-file", str(peer.directory / "alice.password")]
    command = ["pub", "robot/a", "-m", "x", "-p", str(peer.port), *login]
    assert run(command) == 0
    assert run([*command, "-H", "127.0.0.1"]) == 1
    assert "is not trusted by this computer's own list of CAs" in capfd.readouterr().err


def test_a_certificate_of_another_authority(
    peer: Peer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    certs.create_authority(tmp_path)
    other = ["--ca", str(tmp_path / "ca.crt")]
    assert run(peer.arguments("pub", "robot/a", "-m", "x", *other)) == 1
    error = capfd.readouterr().err
    assert f"is not trusted by {tmp_path / 'ca.crt'}" in error
    assert "--ca" in error
    assert run(peer.arguments("pub", "robot/a", "-m", "x", *other, "--insecure")) == 0
    assert run(peer.arguments("pub", "robot/a", "-m", "x", "-H", "127.0.0.1")) == 1
    error = capfd.readouterr().err
    assert "IP address mismatch" in error and ".." not in error


def test_a_ca_that_is_none(peer: Peer, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(peer.arguments("pub", "robot/a", "-m", "x", "--ca", str(tmp_path / "none"))) == 1
    assert "none cannot be read: No such file" in capfd.readouterr().err
    (tmp_path / "ca").write_text("nothing")
    assert run(peer.arguments("pub", "robot/a", "-m", "x", "--ca", str(tmp_path / "ca"))) == 1
    assert "is not a CA certificate in PEM form" in capfd.readouterr().err


def test_nobody_there(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        assert run(peer.arguments("pub", "a", "-m", "x", "-p", str(port))) == 1
    assert f"localhost:{port} cannot be reached: connection refused" in capfd.readouterr().err
    assert run(peer.arguments("pub", "a", "-m", "x", "-H", "no-such-host.invalid")) == 1
    assert "there is no computer called 'no-such-host.invalid'" in capfd.readouterr().err


def test_a_server_that_speaks_no_tls(peer: Peer, capfd: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def answer() -> None:
            client, _ = server.accept()
            with client:
                client.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        thread = Thread(target=answer)
        thread.start()
        assert run(peer.arguments("pub", "a", "-m", "x", "-p", str(port))) == 1
        thread.join(PATIENCE)
    error = capfd.readouterr().err
    assert f"no TLS with localhost:{port}" in error
    assert "is this the port of a listener with tls: true?" in error


WORDS = {Property.REASON_STRING: "linear.x is\x1b no number"}
ACCEPTED = Connack()
ADVICE = "appliance acl explain"
NO_RULE = "acl.conf: no rule lets user 'alice' subscribe to 'a'"


@pytest.mark.parametrize(
    ("command", "answers", "told", "is_advised"),
    [
        (
            ["pub", "a", "-m", "x"],
            [ACCEPTED, Puback(1, 0x99, WORDS)],
            r"'a' was refused: Payload format invalid: linear.x is\x1b no number",
            False,
        ),
        (
            ["pub", "a", "-m", "x", "-q", "2"],
            [ACCEPTED, Pubrec(1, 0x97, WORDS), Pubcomp(1, 0x92)],
            "'a' was refused: Packet identifier not found (--qos 1 tells why)",
            False,
        ),
        (
            ["pub", "a", "-m", "x"],
            [ACCEPTED, Puback(1, 0x87, {Property.REASON_STRING: "no rule allows it"})],
            "'a' was refused: Not authorized: no rule allows it. On the robot, `" + ADVICE,
            True,
        ),
        (
            ["sub", "a", "b"],
            [ACCEPTED, Suback(1, [0, 0x97], {Property.REASON_STRING: "'b': no room for it"})],
            "'b' was refused: Quota exceeded: 'b': no room for it",
            False,
        ),
        (
            ["sub", "a", "$share/g/b"],
            [ACCEPTED, Suback(1, [0x87, 0x87], {Property.REASON_STRING: f"'a': {NO_RULE}"})],
            "The ACL lines that allow it: `topic read a` and `topic read b`, below `user alice`",
            False,
        ),
        (
            ["sub", "a"],
            [Connack(False, 0x97, {Property.REASON_STRING: "user 'alice' has 3 sessions"})],
            "refused user 'alice': Quota exceeded: user 'alice' has 3 sessions\n",
            False,
        ),
        (["sub", "a"], [Connack(False, 0x97)], "Quota exceeded (its log says why)", False),
        (
            ["sub", "a"],
            [ACCEPTED, Disconnect(0x93, {Property.REASON_STRING: "more than 20"})],
            "ended the connection: Receive maximum exceeded: more than 20",
            False,
        ),
    ],
    ids=[
        "puback",
        "pubrec",
        "puback-acl",
        "suback",
        "suback-acl",
        "connack",
        "connack-silent",
        "disconnect",
    ],
)
def test_the_servers_reason_is_told(
    peer: Peer,
    command: list[str],
    answers: list[Packet],
    told: str,
    is_advised: bool,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """And the access rules are named only where they may be the reason."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(peer.directory / "server.crt", peer.directory / "server.key")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)

        def answer() -> None:
            client, _ = server.accept()
            client.settimeout(PATIENCE)
            with context.wrap_socket(client, server_side=True) as secured:
                for packet in answers:
                    if secured.recv(65536):
                        secured.sendall(packet.encode(5))
                while secured.recv(65536):
                    pass

        thread = Thread(target=answer)
        thread.start()
        name, *rest = command
        port = ["-p", str(server.getsockname()[1])]
        assert run(peer.arguments(name, *rest, *port)) == 1
        thread.join(PATIENCE)
    error = capfd.readouterr().err
    assert told in error
    assert (ADVICE in error) is is_advised


def test_the_alert_of_a_client_certificate_that_is_refused(
    peer: Peer, capfd: pytest.CaptureFixture[str]
) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(peer.directory / "server.crt", peer.directory / "server.key")
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED  # and the client has none
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(PATIENCE)

        def refuse() -> None:
            client, _ = server.accept()
            client.settimeout(PATIENCE)
            # Open until the client has read: a reset would overtake the alert.
            with client.dup() as kept:
                with contextlib.suppress(ssl.SSLError):
                    context.wrap_socket(client, server_side=True)
                while kept.recv(65536):
                    pass

        thread = Thread(target=refuse)
        thread.start()
        assert run(peer.arguments("sub", "a", "-p", str(server.getsockname()[1]))) == 1
        thread.join(PATIENCE)
    assert "ended the connection: TLS says: " in (error := capfd.readouterr().err)
    assert "certificate required" in error


def test_a_certificate_without_its_key(
    peer: Peer, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    certificate = ["--cert", str(peer.directory / "ca.crt")]
    assert run(peer.arguments("pub", "a", "-m", "x", *certificate)) == 1
    error = capfd.readouterr().err
    assert "(without --key): no certificate with its key: " in error and "ssl.c" not in error


@pytest.mark.parametrize("command", [["pub", "a/#", "-m", "x"], ["sub", "a/#/b"]])
def test_what_is_no_topic(
    peer: Peer, command: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(peer.arguments(*command)) == 1
    assert "Traceback" not in capfd.readouterr().err
