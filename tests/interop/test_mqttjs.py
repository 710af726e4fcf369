"""MQTT.js, MQTT 3.1.1 and 5, through TLS; the exchanges are in mqttjs/exchange.js."""

from __future__ import annotations

import json
import os
import subprocess
from typing import Any

import pytest
from appliance_process import HOST, ApplianceProcess
from npm_packages import DIRECTORY, install
from waiting import PATIENCE

QOS = [0, 1, 2]
VERSIONS = [4, 5]  # as they stand in CONNECT: 3.1.1 and 5


@pytest.fixture(scope="session", autouse=True)
def _installed() -> None:
    install()


def exchange(
    appliance: ApplianceProcess,
    what: str,
    version: int,
    topic: str = "",
    qos: int = 0,
    **options: Any,
) -> dict[str, Any]:
    """What the exchange of that name in exchange.js tells about it."""
    options = {
        "protocol": "mqtts",
        "host": HOST,
        "port": appliance.port,
        "protocolVersion": version,
        "username": "alice",
        "password": appliance.passwords["alice"],
        "reconnectPeriod": 0,
        **options,
    }
    told = {"what": what, "options": options, "topic": topic, "qos": qos}
    done = subprocess.run(
        ["node", "exchange.js"],
        cwd=DIRECTORY,
        env=os.environ | {"EXCHANGE": json.dumps(told), "NODE_EXTRA_CA_CERTS": str(appliance.ca)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def brief(message: dict[str, Any]) -> tuple[str, str, int, bool]:
    return message["topic"], message["payload"], message["qos"], message["retain"]


@pytest.mark.statement("3.1.1", "MQTT-7.0.0-2")
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", QOS)
def test_publish_and_subscribe(
    appliance: ApplianceProcess, version: int, qos: int, topic: str
) -> None:
    result = exchange(appliance, "publish", version, topic, qos)
    assert [(entry["topic"], entry["qos"]) for entry in result["granted"]] == [(f"{topic}/+", qos)]
    received = [brief(message) for message in result["received"]]
    assert received == [(f"{topic}/a", str(number), qos, False) for number in range(30)]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", QOS)
def test_retained(appliance: ApplianceProcess, version: int, qos: int, topic: str) -> None:
    result = exchange(appliance, "retained", version, topic, qos)
    received = [brief(message) for message in result["received"]]
    assert received == [(topic, "retained", qos, True), (topic, "live", qos, False)]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", QOS)
def test_will(appliance: ApplianceProcess, version: int, qos: int, topic: str) -> None:
    result = exchange(appliance, "will", version, topic, qos)
    received = [brief(message) for message in result["received"]]
    assert received == [
        (f"{topic}/will", "gone", qos, False),
        (f"{topic}/end", "end", qos, False),
    ]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("qos", [1, 2])
def test_a_session_is_continued(
    appliance: ApplianceProcess, version: int, qos: int, topic: str
) -> None:
    result = exchange(appliance, "session", version, topic, qos)
    assert result["present"] == [False, True]
    received = [brief(message) for message in result["received"]]
    assert received == [(topic, "one", qos, False), (topic, "two", qos, False)]


def test_properties(appliance: ApplianceProcess, topic: str) -> None:
    (message,) = exchange(appliance, "properties", 5, topic, 1)["received"]
    assert message["properties"].pop("messageExpiryInterval") in range(990, 1001)
    assert message["properties"] == {
        "payloadFormatIndicator": True,
        "contentType": "application/json",
        "responseTopic": f"{topic}/answer",
        "correlationData": "42",
        "userProperties": {"a": ["1", "2"], "b": "3"},
        "subscriptionIdentifier": 7,
    }


@pytest.mark.parametrize(("version", "code"), [(4, 5), (5, 0x87)])
def test_a_wrong_password(appliance: ApplianceProcess, version: int, code: int) -> None:
    result = exchange(appliance, "refused", version, password="wrong")
    assert result == {"code": code, "message": "Connection refused: Not authorized"}
