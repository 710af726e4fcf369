"""Home Assistant's part, played by mosquitto's clients: on the robot's broker, and on one of its
own that a link of the appliance carries everything to."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from appliance_process import HOST, MOSQUITTO, ApplianceProcess, MosquittoProcess
from ros2_harness import Peer
from test_home_assistant import check, rendered
from waiting import PATIENCE, eventually

pytestmark = pytest.mark.usefixtures("isolated_domain")

pytest.importorskip("rclpy")

if MOSQUITTO is None:
    pytest.skip("needs mosquitto", allow_module_level=True)

BATTERY = "sensor_msgs/msg/BatteryState"
ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
BRIDGE = {
    "home_assistant": True,
    "topics": [
        {"ros": "/battery", "to": "mqtt", "retain": True},
        {"ros": "/diagnostics", "to": "mqtt", "retain": True},
    ],
    "services": ["/lamp"],
}
#: As in docs/home-assistant.md.
ACL = """\
user home
topic read homeassistant/#
topic read {robot}/_appliance/state
topic read {robot}/battery
topic read {robot}/diagnostics
topic write {robot}/lamp/_call/#
pattern read {robot}/lamp/_reply/%c/#

user link
topic read homeassistant/#
topic read {robot}/battery
topic read {robot}/diagnostics
topic write {robot}/lamp/_call/#
topic write {robot}/_upstream/home/#
"""


class HomeAssistant:
    """A user at one of the brokers, over MQTT 3.1.1 as Home Assistant has it by default."""

    def __init__(self, broker, user):
        self.options = ["-h", HOST, "-p", str(broker.plain_port), "-V", "311", "-u", user]
        self.options += ["-P", broker.passwords[user]]

    def read(self, *filters: str, seconds: float = PATIENCE, count: int = 1) -> dict[str, bytes]:
        """The first messages, or those of so many seconds, by topic."""
        topics = [word for each in filters for word in ("-t", each)]
        command = ["mosquitto_sub", *self.options, *topics, "-C", str(count), "-F", "%t %x"]
        done = subprocess.run(
            [*command, "-W", str(round(seconds))], capture_output=True, text=True, check=False
        )
        lines = (line.partition(" ") for line in done.stdout.splitlines())
        return {topic: bytes.fromhex(payload) for topic, _, payload in lines}

    def entities(self, count: int) -> dict[str, dict]:
        """The configurations by name, when there are so many: each is as the schema has it."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            messages = self.read("homeassistant/#", seconds=2, count=count)
            if len(messages) == count:
                found = {topic: json.loads(payload) for topic, payload in messages.items()}
                for topic, configuration in found.items():
                    check(topic, configuration)
                return {each["name"]: each for each in found.values()}
        raise AssertionError(f"{count} entities, and there are {messages}")

    def state(self, configuration: dict) -> str:
        (payload,) = self.read(configuration["state_topic"]).values()
        return rendered(configuration, payload)

    def is_available(self, configuration: dict) -> bytes:
        topic = configuration["availability_topic"]
        return self.read(topic)[topic]

    def press(self, configuration: dict, payload: str, *answers: str) -> dict:
        """Publish what a switch does; the answer, which Home Assistant itself does not read."""
        command = ["mosquitto_rr", *self.options, "-t", configuration["command_topic"], *answers]
        command += ["-m", payload, "-W", str(round(PATIENCE))]
        return json.loads(subprocess.run(command, capture_output=True, check=True).stdout)


@pytest.fixture
async def peer():
    """A node with a battery, a lamp, and bad news."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import BatteryState

    peer = await Peer().start("peer")
    await peer.do("advertise", "/battery", BATTERY, "reliable", "transient_local")
    await peer.do("publish", "/battery", serialize_message(BatteryState(percentage=0.42)).hex())
    trouble = DiagnosticArray(status=[DiagnosticStatus(name="arm", level=b"\2")])
    await peer.do("advertise", "/diagnostics", ARRAY, "reliable", "transient_local")
    await peer.do("publish", "/diagnostics", serialize_message(trouble).hex())
    await peer.do("gather", "/lamp", 1)
    yield peer
    await peer.stop()


def appliance_in(directory: Path, **bridge) -> ApplianceProcess:
    users = {"home": "home's", "link": "link's"}
    return ApplianceProcess(directory, users=users, acl=ACL, bridge=BRIDGE | bridge)


def reload(appliance: ApplianceProcess) -> None:
    command = [sys.executable, "-m", "appliance", "reload", "-c", str(appliance.config)]
    subprocess.run(command, check=True)


async def test_at_the_robots_broker(peer, tmp_path):
    appliance = appliance_in(tmp_path, diagnostics="0 s")
    appliance.start()
    try:
        home = HomeAssistant(appliance, "home")
        found = home.entities(5)
        assert found["battery"]["device_class"] == "battery"
        assert home.state(found["battery"]) == "42.0"
        assert home.state(found["diagnostics"]) == "ON"
        assert home.is_available(found["battery"]) == b"online"
        # The service is called: `_reply/{client id}` has its answer, which is true for a true.
        lamp = found["lamp"]
        answers = ["-i", "home", "-e", "r2d2/lamp/_reply/home/homeassistant"]
        assert home.press(lamp, lamp["payload_on"], *answers) == {"success": True, "message": ""}
        # Without the key they are gone.
        settings = yaml.safe_load(appliance.config.read_text())
        settings["bridge"]["home_assistant"] = False
        appliance.config.write_text(yaml.safe_dump(settings))
        reload(appliance)
        assert home.read("homeassistant/#", seconds=1, count=9) == {}
    finally:
        print(appliance.log)
        appliance.stop()


async def test_without_a_bridge_nothing_is_left(peer, tmp_path):
    appliance = appliance_in(tmp_path)
    appliance.start()
    try:
        before = HomeAssistant(appliance, "home").entities(5)
        appliance.stop()
        await peer.stop()
        appliance.start()
        assert HomeAssistant(appliance, "home").entities(5) == before, "also without the node"
        appliance.stop()
        settings = yaml.safe_load(appliance.config.read_text())
        settings["bridge"]["bus"] = "none"
        appliance.config.write_text(yaml.safe_dump(settings))
        appliance.start()
        home = HomeAssistant(appliance, "home")
        assert home.is_available(before["battery"]) == b"online"
        assert home.read("homeassistant/#", seconds=1, count=9) == {}
    finally:
        print(appliance.log)
        appliance.stop()


async def test_through_a_link_to_home_assistants_broker(peer, tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "robot").mkdir()
    rights = "user home\ntopic readwrite #\n\nuser r2d2\ntopic readwrite #\n"
    broker = MosquittoProcess(tmp_path / "home", {"home": "home's", "r2d2": "r2d2's"}, rights)
    broker.start()
    appliance = appliance_in(tmp_path / "robot", diagnostics="0 s")
    secret = tmp_path / "robot/home.password"
    secret.touch(0o600)
    secret.write_text("r2d2's")
    settings = yaml.safe_load(appliance.config.read_text())
    settings["upstreams"] = [
        {
            "name": "home",
            "servers": [f"mqtt://{HOST}:{broker.plain_port}"],
            "login": {"username": "r2d2", "password_file": str(secret)},
            "user": "link",
            "prefix": "{robot}/",
            "out": [
                {"topic": "#", "local_prefix": "homeassistant/", "remote_prefix": "homeassistant/"},
                {"topic": "battery"},
                {"topic": "diagnostics"},
            ],
            "in": [{"topic": "lamp/_call/+"}],
        }
    ]
    appliance.config.write_text(yaml.safe_dump(settings))
    try:
        appliance.start()
        home = HomeAssistant(broker, "home")
        found = home.entities(5)
        assert home.state(found["battery"]) == "42.0"
        assert home.is_available(found["battery"]) == b"online"
        lamp = found["lamp"]
        answers = ["-e", "r2d2/lamp/_reply/homeassistant"]
        assert home.press(lamp, lamp["payload_off"], *answers) == {"success": False, "message": ""}
        # Without a bridge nothing is left there either.
        appliance.stop()
        settings["bridge"]["bus"] = "none"
        appliance.config.write_text(yaml.safe_dump(settings))
        appliance.start()
        eventually(lambda: home.read("homeassistant/#", seconds=1, count=9) == {}, "none there")
    finally:
        print(appliance.log)
        appliance.stop()
        broker.stop()
