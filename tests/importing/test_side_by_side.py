"""mosquitto, and the appliance with what `appliance import` has made of its configuration: clients
are let in and refused alike, and hear the same."""

from __future__ import annotations

import contextlib
import os
import queue
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import paho.mqtt.client as paho
import pytest
import yaml
from appliance_process import MOSQUITTO, BrokerProcess, free_ports
from command_line import run
from waiting import PATIENCE

from appliance import certs, config
from appliance.ops.check import check

EXAMPLE = Path("/usr/share/doc/mosquitto/examples/mosquitto.conf")
NEEDED = (MOSQUITTO, *map(shutil.which, ("mosquitto_pub", "mosquitto_sub", "mosquitto_passwd")))

pytestmark = pytest.mark.skipif(
    None in NEEDED, reason="there is no mosquitto: apt-get install mosquitto mosquitto-clients"
)

#: A broker that is told a directory with a configuration of mosquitto in it.
Start = Callable[[Path], contextlib.AbstractContextManager[None]]


class Process(BrokerProcess):
    """A broker that is ready when `count` lines of its log match."""

    def __init__(self, name: str, command: list[str | Path], ready: str, count: int = 1) -> None:
        super().__init__(Path())
        self.name = name
        self._how = command, ready, count

    def start(self) -> None:
        command, ready, count = self._how
        self._run(command)
        try:
            self.wait_for_log(ready, count)
        except AssertionError:
            self.stop()
            raise


@contextlib.contextmanager
def running(process: Process) -> Iterator[None]:
    process.start()
    try:
        yield
    finally:
        process.stop()


def mosquitto(directory: Path) -> contextlib.AbstractContextManager[None]:
    path = directory / "mosquitto.conf"
    assert MOSQUITTO is not None
    return running(Process("mosquitto", [MOSQUITTO, "-c", path], r"mosquitto version \S+ running"))


def appliance(directory: Path) -> contextlib.AbstractContextManager[None]:
    """Imported, found valid, and without ROS."""
    made = directory / "imported"
    path = made / "appliance.yaml"
    assert run("import", str(directory / "mosquitto.conf"), "--dir", str(made)) == 0
    loaded = config.load(path)
    assert [str(each) for each in check(loaded) if each.level == "error"] == []
    settings = yaml.safe_load(path.read_text())
    settings["bridge"] = {"bus": "none"}
    path.write_text(yaml.safe_dump(settings))
    command: list[str | Path] = [sys.executable, "-m", "appliance", "run", "-c", path]
    return running(
        Process("appliance", command, r"listening (for \w+ )?on ", len(loaded.broker.listeners))
    )


@pytest.fixture(params=[mosquitto, appliance])
def start(request: pytest.FixtureRequest) -> Start:
    found: Start = request.param
    return found


@dataclass(frozen=True)
class Client:
    """How mosquitto's clients are called."""

    port: int
    arguments: tuple[str, ...] = ()

    def __call__(self, *more: str) -> Client:
        return Client(self.port, (*self.arguments, *more))

    def _command(self, program: str, *arguments: str) -> list[str]:
        return [program, "-h", "localhost", "-p", str(self.port), *self.arguments, *arguments]

    def pub(self, topic: str, *arguments: str) -> str:
        """Published; refused, the message; or not let in."""
        command = self._command("mosquitto_pub", "-V", "5", "-q", "1", "-t", topic, "-m", topic)
        done = subprocess.run(
            [*command, *arguments], capture_output=True, text=True, timeout=PATIENCE
        )
        if done.returncode:
            return "not let in"
        return "refused" if "failed" in done.stderr else "published"

    @contextlib.contextmanager
    def sub(self, *filters: str) -> Iterator[Callable[[str], list[str]]]:
        """Subscribed. The function returns what came until the given topic."""
        topics = [argument for each in filters for argument in ("-t", each)]
        command = self._command("mosquitto_sub", "-V", "5", "-q", "1", "-d", "-F", "got %t")
        command = ["stdbuf", "-oL", *command, *topics, "-W", f"{PATIENCE:.0f}"]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        assert process.stdout is not None
        lines = iter(process.stdout.readline, "")  # -W ends it
        try:
            if not any(line.startswith("Subscribed") for line in lines):
                raise AssertionError("it has not subscribed")

            def until(last: str) -> list[str]:
                found: list[str] = []
                for line in lines:
                    if line.startswith("got ") and "/_appliance/" not in line:  # its own state
                        found.append(line.removeprefix("got ").strip())
                        if found[-1] == last:
                            return found
                raise AssertionError(f"{last} did not come, but {found}")

            yield until
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


def write(directory: Path, text: str, **files: str) -> None:
    for name, content in files.items():
        (directory / name).write_text(content)
    root = "user root\n" if os.geteuid() == 0 else ""  # else it cannot read the files
    (directory / "mosquitto.conf").write_text(root + text)


def passwords(path: Path, **users: str) -> None:
    path.touch(0o600)
    for user, password in users.items():
        subprocess.run(["mosquitto_passwd", "-b", path, user, password], check=True)


@pytest.mark.skipif(not EXAMPLE.exists(), reason="there is no example of mosquitto")
def test_the_example(tmp_path: Path, start: Start) -> None:
    (port,) = free_ports(1)
    more = f"\nlistener {port} 127.0.0.1\nallow_anonymous true\n"
    write(tmp_path, EXAMPLE.read_text() + more)
    client = Client(port)
    with start(tmp_path), client.sub("#") as until:
        assert client.pub("a/b") == "published"
        assert client.pub("a/c", "-r") == "published"
        assert client.pub("end") == "published"
        assert until("end") == ["a/b", "a/c", "end"]
        with client.sub("a/+") as retained:
            assert retained("a/c") == ["a/c"]


def test_users_and_rules(tmp_path: Path, start: Start) -> None:
    (port,) = free_ports(1)
    passwords(tmp_path / "pw", alice="one", bob="two")
    write(
        tmp_path,
        f"allow_anonymous true\npassword_file {tmp_path}/pw\nacl_file {tmp_path}/rules\n"
        f"listener {port} 127.0.0.1\n",
        rules="topic read public/#\n\nuser alice\ntopic readwrite #\ntopic deny secret/#\n\n"
        "user bob\ntopic write bob/in\ntopic read end\npattern readwrite own/%u/%c/#\n",
    )
    client = Client(port)
    alice, bob = client("-u", "alice", "-P", "one"), client("-u", "bob", "-P", "two")
    with start(tmp_path):
        with alice("-i", "reader").sub("#") as until:
            said = {
                (name, topic): who.pub(topic, *more)
                for name, who, topic, *more in (
                    ("alice", alice, "x/y"),
                    ("alice", alice, "secret/a"),
                    ("bob", bob, "bob/in"),
                    ("bob", bob, "bob/out"),
                    ("bob", bob, "own/bob/b1/x", "-i", "b1"),
                    ("bob", bob, "own/bob/b2/x", "-i", "b1"),
                    ("bob", bob, "own/alice/b1/x", "-i", "b1"),
                    ("nobody", client, "public/a"),
                    ("stranger", client("-u", "eve", "-P", "x"), "x/y"),
                    ("wrong", client("-u", "alice", "-P", "two"), "x/y"),
                )
            }
            alice.pub("end")
            heard = until("end")
        with bob.sub("#", "end") as until, client.sub("#", "public/end") as anonymous:
            for topic in ("bob/in", "public/a", "end", "public/end"):
                alice.pub(topic)
            assert until("end") == ["end"]
            assert anonymous("public/end") == ["public/a", "public/end"]
    assert heard == ["x/y", "bob/in", "own/bob/b1/x", "end"]
    assert said == {
        ("alice", "x/y"): "published",
        ("alice", "secret/a"): "refused",
        ("bob", "bob/in"): "published",
        ("bob", "bob/out"): "refused",
        ("bob", "own/bob/b1/x"): "published",
        ("bob", "own/bob/b2/x"): "refused",
        ("bob", "own/alice/b1/x"): "refused",
        ("nobody", "public/a"): "refused",
        ("stranger", "x/y"): "not let in",
        ("wrong", "x/y"): "not let in",
    }


def test_certificates_are_required_and_name_the_user(tmp_path: Path, start: Start) -> None:
    secure, open_port = free_ports(2)
    folder = tmp_path / "certs"
    certs.create_authority(folder, "cell", *certs.local_names())
    certs.issue_server(folder, *certs.local_names())
    certs.issue_client(folder, "robot-7")
    write(
        tmp_path,
        f"per_listener_settings true\nlistener {secure} 127.0.0.1\nacl_file {tmp_path}/rules\n"
        f"cafile {folder}/ca.crt\ncertfile {folder}/server.crt\nkeyfile {folder}/server.key\n"
        "require_certificate true\nuse_identity_as_username true\ntls_version tlsv1.2\n"
        f"listener {open_port} 127.0.0.1\nallow_anonymous true\n",
        rules="user robot-7\ntopic write up/#\n",
    )
    tls = Client(secure)("--cafile", str(folder / "ca.crt"))
    own = folder / "clients"
    robot = tls("--cert", str(own / "robot-7.crt"), "--key", str(own / "robot-7.key"))
    with start(tmp_path), Client(open_port).sub("#") as until:
        assert robot.pub("up/a") == "published"
        assert robot.pub("down/a") == "refused"
        assert tls.pub("up/b") == "not let in"
        assert tls("-u", "robot-7", "-P", "x").pub("up/b") == "not let in"
        assert Client(secure).pub("up/b") == "not let in"
        assert Client(open_port).pub("end") == "published"
        assert until("end") == ["up/a", "end"]


def test_websockets(tmp_path: Path, start: Start) -> None:
    port, web = free_ports(2)
    passwords(tmp_path / "pw", alice="one")
    write(
        tmp_path,
        f"allow_anonymous false\npassword_file {tmp_path}/pw\nlistener {port} 127.0.0.1\n"
        f"listener {web} 127.0.0.1\nprotocol websockets\n",
    )
    heard: queue.Queue[str] = queue.Queue()

    def connected(password: str) -> str:
        client = paho.Client(paho.CallbackAPIVersion.VERSION2, transport="websockets")
        client.ws_set_options(path="/mqtt")
        client.username_pw_set("alice", password)
        client.on_connect = lambda _c, _u, _f, code, _p: heard.put(str(code))
        client.on_subscribe = lambda *_: heard.put("subscribed")
        client.on_message = lambda _c, _u, message: heard.put(message.topic)
        client.connect("127.0.0.1", web)
        client.loop_start()
        try:
            answer = heard.get(timeout=PATIENCE)
            if answer != "Success":
                return answer
            client.subscribe("a/#")
            assert heard.get(timeout=PATIENCE) == "subscribed"
            assert Client(port)("-u", "alice", "-P", "one").pub("a/b") == "published"
            return heard.get(timeout=PATIENCE)
        finally:
            client.loop_stop()
            client.disconnect()

    with start(tmp_path):
        assert connected("one") == "a/b"
        assert connected("two") == "Not authorized"


def wait_for_bridge(near: Client, far: Client) -> None:
    """Until it has subscribed there: a retained message comes then, at once or later."""
    assert far.pub("site/ready", "-r") == "published"
    with near.sub("ready") as until:
        until("ready")


def test_a_bridge(tmp_path: Path, start: Start) -> None:
    port, far_port = free_ports(2)
    far_directory = tmp_path / "far"
    far_directory.mkdir()
    passwords(far_directory / "pw", site="three", ops="four")
    write(
        far_directory,
        f"listener {far_port} 127.0.0.1\nallow_anonymous false\npassword_file {far_directory}/pw\n",
    )
    write(
        tmp_path,
        f"listener {port} 127.0.0.1\nallow_anonymous true\nconnection center\n"
        f"address localhost:{far_port}\nremote_username site\nremote_password three\n"
        'topic up/# out 1 "" site/\ntopic cmd/# in 1 "" site/\ntopic ready in 1 "" site/\n',
    )
    near, far = Client(port), Client(far_port)("-u", "ops", "-P", "four")
    with mosquitto(far_directory), start(tmp_path):
        wait_for_bridge(near, far)
        with far.sub("site/#") as until:
            assert near.pub("other/a") == "published"
            assert near.pub("up/a") == "published"
            assert near.pub("up/end") == "published"
            assert [each for each in until("site/up/end") if "ready" not in each] == [
                "site/up/a",
                "site/up/end",
            ]
        with near.sub("#") as until:
            assert far.pub("site/other/a") == "published"
            assert far.pub("site/cmd/a") == "published"
            assert far.pub("site/cmd/end") == "published"
            assert [each for each in until("cmd/end") if each != "ready"] == ["cmd/a", "cmd/end"]
