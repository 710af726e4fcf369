"""mosquitto_pub and mosquitto_sub, MQTT 3.1.1 and 5, through TLS."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from appliance_process import HOST, ApplianceProcess, BrokerProcess
from waiting import PATIENCE

from appliance import certs

pytestmark = pytest.mark.skipif(
    shutil.which("mosquitto_pub") is None or shutil.which("mosquitto_sub") is None,
    reason="there is no mosquitto_pub and mosquitto_sub: apt-get install mosquitto-clients",
)

QOS = [0, 1, 2]


@pytest.fixture(params=["311", "5"])
def version(request: pytest.FixtureRequest) -> str:
    return str(request.param)


class Mosquitto:
    """How both commands are called for one broker and one version."""

    def __init__(self, broker: BrokerProcess, version: str, user: str = "alice") -> None:
        password = broker.passwords[user]
        self.arguments = ["-h", HOST, "-p", str(broker.port), "--cafile", str(broker.ca)]
        self.arguments += ["-V", version, "-u", user, "-P", password]

    def pub(self, topic: str, *arguments: str, stdin: bytes | None = None) -> None:
        done = subprocess.run(
            ["mosquitto_pub", *self.arguments, "-t", topic, *arguments],
            input=stdin,
            capture_output=True,
            timeout=PATIENCE,
        )
        assert done.returncode == 0, done
        assert not done.stderr, done  # mosquitto_pub warns there when a PUBACK refuses

    def subscribe_once(self, topic: str, client_id: str, qos: int) -> None:
        """Leave a session with this subscription behind."""
        subscribe = ["-c", "-i", client_id, "-t", topic, "-q", str(qos), "-E"]
        command = ["mosquitto_sub", *self.arguments, *subscribe]
        subprocess.run(command, check=True, timeout=PATIENCE)

    @contextlib.contextmanager
    def sub(self, *arguments: str) -> Iterator[Subscriber]:
        """Subscribed, and ended with the block however that ends."""
        # -d says when it has subscribed, but only stdbuf makes it say so at once.
        command = ["stdbuf", "-oL", "mosquitto_sub", *self.arguments, "-d", "-F", "%j"]
        command += ["-W", f"{PATIENCE:.0f}", *arguments]
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            yield Subscriber(process)
        finally:
            process.kill()
            process.wait()
            assert process.stdout
            process.stdout.close()


class Subscriber:
    """A running mosquitto_sub, subscribed."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.printed: list[str] = []
        self._waiting: list[dict[str, Any]] = []
        while not self._line().startswith("Subscribed"):
            pass

    def _line(self) -> str:
        assert self.process.stdout
        line = self.process.stdout.readline()  # -W ends the program, and so what is waited for
        assert line, self.printed
        self.printed.append(line)
        if line.startswith("{"):
            self._waiting.append(json.loads(line))
        return line

    def messages(self, count: int) -> list[dict[str, Any]]:
        """The next messages, as mosquitto_sub prints them in JSON."""
        while len(self._waiting) < count:
            self._line()
        found, self._waiting = self._waiting[:count], self._waiting[count:]
        return found

    def message(self) -> dict[str, Any]:
        return self.messages(1)[0]

    def kill(self) -> None:
        """Gone without a word."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


def brief(message: dict[str, Any]) -> tuple[str, str, int, int]:
    payload = message["payload"] or ""  # mosquitto_sub says null of an empty one
    return message["topic"], payload, message["qos"], message["retain"]


@pytest.mark.statement("3.1.1", "MQTT-7.0.0-2")
@pytest.mark.parametrize("qos", QOS)
def test_publish_and_subscribe(broker: BrokerProcess, version: str, topic: str, qos: int) -> None:
    clients = Mosquitto(broker, version)
    with clients.sub("-t", topic, "-q", str(qos)) as subscriber:
        texts = ["one", "", "zwölf"]
        for text in texts:
            clients.pub(topic, "-q", str(qos), "-m", text)
        received = [brief(message) for message in subscriber.messages(3)]
        assert received == [(topic, text, qos, 0) for text in texts]


def test_the_lower_qos_counts(broker: BrokerProcess, version: str, topic: str) -> None:
    clients = Mosquitto(broker, version)
    with clients.sub("-t", topic, "-q", "1") as subscriber:
        for qos in QOS:
            clients.pub(topic, "-q", str(qos), "-m", str(qos))
        # In that order: QoS 0 goes straight out, and nothing overtakes it.
        assert [message["qos"] for message in subscriber.messages(3)] == [0, 1, 1]


@pytest.mark.parametrize("qos", QOS)
def test_the_version_of_the_other_makes_no_difference(
    appliance: ApplianceProcess, topic: str, qos: int
) -> None:
    old, new = Mosquitto(appliance, "311"), Mosquitto(appliance, "5")
    with (
        old.sub("-t", topic, "-q", str(qos)) as old_subscriber,
        new.sub("-t", topic, "-q", str(qos)) as new_subscriber,
    ):
        new.pub(topic, "-q", str(qos), "-m", "new", "-D", "publish", "content-type", "text/plain")
        old.pub(topic, "-q", str(qos), "-m", "old")
        for subscriber in (old_subscriber, new_subscriber):
            received = [brief(message) for message in subscriber.messages(2)]
            assert received == [(topic, "new", qos, 0), (topic, "old", qos, 0)]


@pytest.mark.parametrize("qos", QOS)
def test_many_at_once(appliance: ApplianceProcess, version: str, topic: str, qos: int) -> None:
    # Not with mosquitto 2.0.11, whose own client it loses here (MQTT 5, QoS 2: "protocol error").
    clients = Mosquitto(appliance, version)
    lines = [f"line {number}" for number in range(200)]
    with clients.sub("-t", topic, "-q", str(qos)) as subscriber:
        clients.pub(topic, "-q", str(qos), "-l", stdin="\n".join(lines).encode() + b"\n")
        assert [message["payload"] for message in subscriber.messages(200)] == lines


@pytest.mark.parametrize("size", [1, 128, 16_384, 1_000_000])
def test_sizes(broker: BrokerProcess, version: str, topic: str, size: int, tmp_path: Path) -> None:
    clients = Mosquitto(broker, version)
    payload = bytes(byte % 251 for byte in range(size))
    (tmp_path / "payload").write_bytes(payload)
    command = ["mosquitto_sub", *clients.arguments, "-t", topic, "-q", "1", "-N", "-C", "1"]
    clients.pub(topic, "-q", "1", "-r", "-f", str(tmp_path / "payload"))
    received = subprocess.run(command, capture_output=True, timeout=PATIENCE, check=True).stdout
    assert received == payload
    clients.pub(topic, "-r", "-n")


def test_wildcards(broker: BrokerProcess, version: str, topic: str) -> None:
    clients = Mosquitto(broker, version)
    with (
        clients.sub("-t", f"{topic}/+/x", "-q", "1") as plus,
        clients.sub("-t", f"{topic}/#", "-q", "1") as hash_,
        clients.sub("-t", f"{topic}/a/x", "-t", f"{topic}/+/y", "-q", "1") as both,
    ):
        published = ["", "/a", "/a/x", "/b/x", "/b/y", "/b/x/c", "//x", "/end/x", "/end/y"]
        for name in published:
            clients.pub(topic + name, "-q", "1", "-m", name)
        expected = {
            plus: ["/a/x", "/b/x", "//x", "/end/x"],
            hash_: published,
            both: ["/a/x", "/b/y", "/end/y"],
        }
        for subscriber, names in expected.items():
            received = [message["topic"] for message in subscriber.messages(len(names))]
            assert received == [topic + name for name in names]


@pytest.mark.parametrize("qos", QOS)
def test_retained(broker: BrokerProcess, version: str, topic: str, qos: int) -> None:
    clients = Mosquitto(broker, version)
    with clients.sub("-t", topic, "-q", str(qos)) as before:
        clients.pub(topic, "-q", str(qos), "-r", "-m", "old")
        clients.pub(topic, "-q", str(qos), "-r", "-m", "new")
        # To a subscription that is there, a retained message is one like any other.
        received = [brief(message) for message in before.messages(2)]
        assert received == [(topic, "old", qos, 0), (topic, "new", qos, 0)]
    for topic_filter in (topic, f"{topic}/#"):
        with clients.sub("-t", topic_filter, "-q", str(qos)) as after:
            assert brief(after.message()) == (topic, "new", qos, 1)

    clients.pub(topic, "-q", str(qos), "-r", "-n")
    with clients.sub("-t", topic, "-q", str(qos)) as cleared:
        clients.pub(topic, "-q", str(qos), "-m", "live")
        assert brief(cleared.message()) == (topic, "live", qos, 0)


def test_remove_retained(broker: BrokerProcess, version: str, topic: str) -> None:
    clients = Mosquitto(broker, version)
    for name in "abc":
        clients.pub(f"{topic}/{name}", "-r", "-m", name)
    with clients.sub("-t", f"{topic}/#", "--remove-retained", "-q", "1") as remover:
        # The deletions come back to it, one for each.
        received = remover.messages(6)
    assert sorted(message["payload"] for message in received if message["retain"]) == list("abc")
    with clients.sub("-t", f"{topic}/#", "-q", "1") as subscriber:
        clients.pub(f"{topic}/live", "-q", "1", "-m", "live")
        assert subscriber.message()["payload"] == "live"


@pytest.mark.parametrize("qos", QOS)
def test_will(broker: BrokerProcess, version: str, topic: str, qos: int) -> None:
    clients = Mosquitto(broker, version)
    will = ["--will-topic", f"{topic}/will", "--will-payload", "gone", "--will-qos", str(qos)]
    with clients.sub("-t", f"{topic}/#", "-q", str(qos)) as watcher:
        with clients.sub("-t", f"{topic}/other", *will, "--will-retain") as killed:
            killed.kill()
            assert brief(watcher.message()) == (f"{topic}/will", "gone", qos, 0)
        with clients.sub("-t", f"{topic}/will", "-q", str(qos)) as late:
            assert brief(late.message()) == (f"{topic}/will", "gone", qos, 1)
        clients.pub(f"{topic}/will", "-r", "-n", "-q", str(qos))
        watcher.message()
        # Who takes leave leaves no will.
        with clients.sub("-t", f"{topic}/other", "-q", str(qos), "-C", "1", *will) as leaving:
            clients.pub(f"{topic}/other", "-m", "enough", "-q", str(qos))
            assert leaving.process.wait(PATIENCE) == 0
        clients.pub(f"{topic}/end", "-m", "end", "-q", str(qos))
        assert [message["payload"] for message in watcher.messages(2)] == ["enough", "end"]


def test_disconnect_with_will(broker: BrokerProcess, topic: str) -> None:
    will = ["--will-topic", f"{topic}/will", "--will-payload", "gone"]
    clients = Mosquitto(broker, "5")
    with clients.sub("-t", f"{topic}/#") as watcher:
        with clients.sub("-t", f"{topic}/other", *will) as leaving:
            leaving.process.terminate()  # it says DISCONNECT 0x04
            leaving.process.wait(PATIENCE)
        assert watcher.message()["payload"] == "gone"


@pytest.mark.parametrize("qos", [1, 2])
def test_a_session_is_continued(broker: BrokerProcess, version: str, topic: str, qos: int) -> None:
    clients = Mosquitto(broker, version)
    client_id = f"session-{topic[-12:]}"
    clients.subscribe_once(topic, client_id, qos)
    for number in range(30):  # more than go out at once
        clients.pub(topic, "-q", str(qos), "-m", str(number))
    # It comes back with another subscription: what it receives is owed to the first.
    session = ["--disable-clean-session", "-i", client_id, "-q", str(qos)]
    with clients.sub(*session, "-t", f"{topic}/other") as continued:
        received = [brief(message) for message in continued.messages(30)]
        assert received == [(topic, str(number), qos, 0) for number in range(30)]
    # Without -c the session begins anew, and what it was subscribed to is forgotten.
    with clients.sub("-i", client_id, "-t", f"{topic}/other", "-q", str(qos)) as fresh:
        clients.pub(topic, "-q", str(qos), "-m", "unheard")
        clients.pub(f"{topic}/other", "-q", str(qos), "-m", "heard")
        assert fresh.message()["payload"] == "heard"


def test_a_killed_client_s_session_is_continued(
    broker: BrokerProcess, version: str, topic: str
) -> None:
    clients = Mosquitto(broker, version)
    session = ["-c", "-i", f"session-{topic[-12:]}", "-t", topic, "-q", "1"]
    with clients.sub(*session) as killed:
        killed.kill()
    for text in ("one", "two"):
        clients.pub(topic, "-q", "1", "-m", text)
    with clients.sub(*session) as continued:
        assert [message["payload"] for message in continued.messages(2)] == ["one", "two"]


def test_properties(broker: BrokerProcess, topic: str) -> None:
    clients = Mosquitto(broker, "5")
    shown = "%C|%R|%D|%P|%F|%E|%S"
    properties = [
        *("-D", "publish", "content-type", "application/json"),
        *("-D", "publish", "response-topic", f"{topic}/answer"),
        *("-D", "publish", "correlation-data", "42"),
        *("-D", "publish", "user-property", "a", "1"),
        *("-D", "publish", "user-property", "a", "2"),
        *("-D", "publish", "payload-format-indicator", "1"),
        *("-D", "publish", "message-expiry-interval", "1000"),
    ]
    clients.pub(topic, "-m", "{}", "-q", "1", "-r", *properties)
    command = ["mosquitto_sub", *clients.arguments, "-t", topic, "-q", "1", "-C", "1", "-F", shown]
    command += ["-D", "subscribe", "subscription-identifier", "7"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    *fields, expiry, identifier = done.stdout.strip().split("|")
    assert fields == ["application/json", f"{topic}/answer", "42", "a:1 a:2", "1"]
    assert 990 <= int(expiry) <= 1000
    assert identifier == "7"
    clients.pub(topic, "-r", "-n")


def test_sys_topics(broker: BrokerProcess, version: str) -> None:
    with Mosquitto(broker, version).sub("-t", "$SYS/broker/version") as subscriber:
        message = subscriber.message()
    assert broker.name in message["payload"]
    assert message["topic"] == "$SYS/broker/version"


@pytest.mark.parametrize(
    ("version", "code", "text"),
    [("311", 5, "Connection Refused: not authorised."), ("5", 135, "Not authorized")],
)
def test_a_wrong_password(broker: BrokerProcess, version: str, code: int, text: str) -> None:
    clients = Mosquitto(broker, version)
    clients.arguments[-1] = "wrong"
    for command in (["mosquitto_sub"], ["mosquitto_pub", "-m", "x"]):
        done = subprocess.run(
            [*command, *clients.arguments, "-t", "r2d2/x"], capture_output=True, timeout=PATIENCE
        )
        assert done.returncode == code
        assert text in done.stderr.decode()


def test_what_the_rules_refuse_is_told(appliance: ApplianceProcess, version: str) -> None:
    clients = Mosquitto(appliance, version)
    arguments = [*clients.arguments, "-t", "elsewhere/x", "-q", "1"]
    subscribe = ["mosquitto_sub", *arguments, "-E"]
    done = subprocess.run(subscribe, capture_output=True, text=True, timeout=PATIENCE)
    assert "All subscription requests were denied." in done.stderr
    publish = ["mosquitto_pub", *arguments, "-m", "x"]
    done = subprocess.run(publish, capture_output=True, text=True, timeout=PATIENCE)
    told = "Publish 1 failed: Not authorized" in done.stderr
    assert told == (version == "5")  # 3.1.1 has no way to say it
    appliance.wait_for_log("may not publish to 'elsewhere/x'")


def test_without_the_authority(broker: BrokerProcess, tmp_path: Path) -> None:
    certs.create_authority(tmp_path, "another")
    clients = Mosquitto(broker, "311")
    clients.arguments[clients.arguments.index("--cafile") + 1] = str(tmp_path / "ca.crt")
    command = ["mosquitto_pub", *clients.arguments, "-t", "r2d2/x", "-m", "x"]
    done = subprocess.run(command, capture_output=True, timeout=PATIENCE)
    assert done.returncode
    assert "A TLS error occurred" in done.stderr.decode()
