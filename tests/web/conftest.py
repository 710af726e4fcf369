"""For journeys: an appliance with the console and the demo robot, and a real Chromium.

A file of journeys has its own; it may have fixtures `bridge` and `acl`, with its own bridge and
access rules, and `web_port`.
"""

from __future__ import annotations

import base64
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from appliance_process import ApplianceProcess
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from npm_packages import install
from ros_domain import DOMAIN
from visits import Visit
from waiting import PATIENCE

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)

ACL = """\
pattern read $CONTROL/appliance/v1/+/_reply/%c/#

user alice
topic readwrite {robot}/#
topic read $SYS/#
topic write $CONTROL/appliance/v1/+/_call/#
topic read other/#

user viewer
topic read {robot}/#
topic write $CONTROL/appliance/v1/rights/_call

user stranger
topic readwrite other/#
"""
PASSWORD = "only-to-look-at-1"

BRIDGE: dict[str, Any] = {
    "discovery": "localhost",
    "topics": [
        {"ros": "/odom", "to": "mqtt", "rate": 10},
        {
            "ros": "/cmd_vel",
            "to": "ros",
            "type": "geometry_msgs/msg/Twist",
            "exclusive": True,
            "on_silence": {"after": "500 ms", "publish": {}},
            "clamp": {"linear.x": [-0.25, 0.5], "angular.z": [-1, 1]},
        },
        {"ros": "/other/cmd_vel", "to": "ros", "type": "geometry_msgs/msg/TwistStamped"},
    ],
}


@pytest.fixture(scope="module")
def bridge() -> dict[str, Any]:
    """The section `bridge` of the appliance's configuration."""
    return BRIDGE


@pytest.fixture(scope="module")
def web_port() -> int:
    """The port of the console; 0 for one that the system chooses anew at each start."""
    return 0


@pytest.fixture(scope="module")
def acl() -> str:
    """The access rules."""
    return ACL


@pytest.fixture(scope="module")
def appliance(
    tmp_path_factory: pytest.TempPathFactory, bridge: dict[str, Any], acl: str, web_port: int
) -> Iterator[ApplianceProcess]:
    bind = "127.0.0.1:0"
    web = {"bind": bind, "protocol": "web"}
    secure = {"bind": f"127.0.0.1:{web_port}", "protocol": "web", "tls": True}
    listeners = [{"bind": bind, "tls": True}, {"bind": bind}, secure, web]
    process = ApplianceProcess(
        tmp_path_factory.mktemp("console"),
        users={"viewer": PASSWORD, "stranger": PASSWORD},
        acl=acl,
        broker={"listeners": listeners},
        bridge=bridge,
    )
    bus = {"ROS_DOMAIN_ID": DOMAIN, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    process.environment = bus
    process.start()
    robot = subprocess.Popen(
        [sys.executable, "-m", "appliance.cli.demo_robot"], env={**os.environ, **bus}
    )
    yield process
    robot.terminate()
    robot.wait(PATIENCE)
    process.stop()


@pytest.fixture(scope="module")
def origin(appliance: ApplianceProcess) -> str:
    lines = appliance.wait_for_log(r"listening for the web on \S+:(\d+)$", 2)
    return f"https://localhost:{lines[0].rpartition(':')[2]}"


@pytest.fixture(scope="module")
def browser(appliance: ApplianceProcess) -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    certificate = (appliance.directory / "certs/server.crt").read_bytes()
    key = x509.load_pem_x509_certificate(certificate).public_key()
    digest = hashlib.sha256(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo))
    trusted = base64.b64encode(digest.digest()).decode()
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM,
            timeout=PATIENCE * 1000,
            args=[
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                f"--ignore-certificate-errors-spki-list={trusted}",
            ],
        )
        yield browser
        browser.close()


@pytest.fixture
def visit(browser: Any, origin: str, appliance: ApplianceProcess) -> Iterator[Callable[..., Visit]]:
    install()
    visits: list[Visit] = []

    def begin(**options: Any) -> Visit:
        visits.append(Visit(browser, origin, appliance.passwords, options))
        return visits[-1]

    yield begin
    for each in visits:
        each.close()
    assert [wrong for each in visits for wrong in each.wrong] == []
