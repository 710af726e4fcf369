"""MQTT.js in a real Chromium, over WebSocket with and without TLS, MQTT 3.1.1 and 5."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import os
import shutil
import subprocess
import urllib.request
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ACL, ROBOT, ApplianceProcess
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from npm_packages import DIRECTORY
from paho.mqtt.enums import MQTTProtocolVersion
from paho_peer import Peer
from test_mqttjs import _installed  # noqa: F401
from waiting import PATIENCE, eventually
from websockets.sync.client import connect

MQTT_JS = DIRECTORY / "node_modules/mqtt/dist/mqtt.min.js"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)

#: Seconds for Chromium to start, on a computer that is busy with something else.
START_TIMEOUT = 60.0

#: Messages each way; the last has so many bytes, which is more than one WebSocket frame of ours.
COUNT = 30
LARGE = 300_000

PAGE = """\
<!DOCTYPE html>
<meta charset="utf-8">
<script src="%s"></script>
<script>
/** Publish `count` messages with QoS 2 under `topic`/up, receive as many from `topic`/down. */
async function exchange({ url, options, topic, count, large }) {
  const client = mqtt.connect(url, options)
  const received = []
  let all
  const complete = new Promise((resolve) => { all = resolve })
  client.on('message', (name, payload, packet) => {
    const told = payload.length > 100 ? payload.length : payload.toString()
    received.push([told, packet.qos, packet.dup])
    if (received.length === count) all()
  })
  const connack = await new Promise((resolve, reject) => {
    client.once('connect', resolve)
    client.once('error', reject)
    client.once('close', () => reject(new Error('the connection was closed')))
  })
  const granted = await client.subscribeAsync(`${topic}/down`, { qos: 2 })
  await client.publishAsync(`${topic}/ready`, '', { qos: 2 })
  const sent = []
  for (let number = 1; number < count; number++) sent.push(String(number))
  sent.push(new Uint8Array(large))
  while (sent.length) { // no more at a time than the broker's Receive Maximum, which it ignores
    const some = sent.splice(0, 20)
    const publish = (payload) => client.publishAsync(`${topic}/up`, payload, { qos: 2 })
    await Promise.all(some.map(publish))
  }
  await complete
  await client.endAsync()
  return { granted: granted[0].qos, present: connack.sessionPresent, received }
}
</script>
"""


class Browser:
    """A headless Chromium, driven through its DevTools protocol."""

    def __init__(self, directory: Path, certificate: Path) -> None:
        self._profile = directory / "profile"
        page = directory / "page.html"
        page.write_text(PAGE % MQTT_JS.as_uri())
        key = x509.load_pem_x509_certificate(certificate.read_bytes()).public_key()
        digest = hashlib.sha256(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo))
        assert CHROMIUM is not None
        self._process = subprocess.Popen(
            [
                CHROMIUM,
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
                "--no-first-run",
                "--remote-debugging-port=0",
                f"--user-data-dir={self._profile}",
                # The appliance's own authority is in no browser's list.
                "--ignore-certificate-errors-spki-list="
                + base64.b64encode(digest.digest()).decode(),
                page.as_uri(),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"HOME": str(directory)},
        )
        self._numbers = itertools.count(1)
        loaded = "document.readyState === 'complete' && typeof mqtt"
        eventually(lambda: self.evaluate(loaded) == "object", "MQTT.js is loaded", START_TIMEOUT)

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression in the page, of a promise what it is fulfilled with.

        AssertionError says what was thrown.
        """
        with connect(self._page(), max_size=None, open_timeout=START_TIMEOUT) as devtools:
            number = next(self._numbers)
            parameters = {"expression": expression, "awaitPromise": True, "returnByValue": True}
            command = {"id": number, "method": "Runtime.evaluate", "params": parameters}
            devtools.send(json.dumps(command))
            while True:
                answer = json.loads(devtools.recv(START_TIMEOUT))
                if answer.get("id") == number:
                    break
        assert "error" not in answer, answer["error"]
        assert "exceptionDetails" not in answer["result"], answer["result"]["exceptionDetails"]
        return answer["result"]["result"].get("value")

    def _page(self) -> str:
        """Where the DevTools of the page listen, once Chromium is there."""
        file = self._profile / "DevToolsActivePort"
        pages: list[str] = []

        def is_there() -> bool:
            assert self._process.poll() is None, "Chromium has ended"
            if file.exists() and (text := file.read_text()):
                listing = f"http://127.0.0.1:{text.split()[0]}/json"
                with urllib.request.urlopen(listing, timeout=PATIENCE) as response:
                    pages[:] = [
                        entry["webSocketDebuggerUrl"]
                        for entry in json.load(response)
                        if entry["type"] == "page" and entry["url"].startswith("file:")
                    ]
            return bool(pages)

        eventually(is_there, "Chromium shows the page", START_TIMEOUT)
        return pages[0]

    def stop(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    """An appliance that listens for browsers as well."""
    bind = "127.0.0.1:0"
    listeners = [
        {"bind": bind, "tls": True},
        {"bind": bind},
        {"bind": bind, "protocol": "websocket"},
        {"bind": bind, "protocol": "websocket", "tls": True},
    ]
    process = ApplianceProcess(
        tmp_path_factory.mktemp("web"), acl=ACL, broker={"listeners": listeners}
    )
    process.start()
    yield process
    process.stop()


@pytest.fixture(scope="module")
def browser(web: ApplianceProcess, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: apt-get install chromium")
    browser = Browser(tmp_path_factory.mktemp("browser"), web.directory / "certs/server.crt")
    yield browser
    browser.stop()


@pytest.mark.parametrize("version", [4, 5])
@pytest.mark.parametrize("scheme", ["ws", "wss"])
def test_qos_2_both_ways(
    web: ApplianceProcess, browser: Browser, scheme: str, version: int
) -> None:
    """Each message arrives once, in order, at a paho client and from it."""
    lines = web.wait_for_log(r"listening for WebSocket on \S+:(\d+)$", 2)
    ports = [int(line.rpartition(":")[2]) for line in lines]
    topic = f"{ROBOT}/browser-{uuid.uuid4().hex[:12]}"
    told = {
        "url": f"{scheme}://localhost:{ports[scheme == 'wss']}/mqtt",
        "options": {
            "protocolVersion": version,
            "clientId": f"browser-{scheme}-{version}",
            "username": "alice",
            "password": web.passwords["alice"],
            "reconnectPeriod": 0,
        },
        "topic": topic,
        "count": COUNT,
        "large": LARGE,
    }
    with Peer(web, MQTTProtocolVersion.MQTTv5) as peer, ThreadPoolExecutor(1) as beside:
        peer.subscribe(f"{topic}/+", 2)
        exchange = beside.submit(browser.evaluate, f"exchange({json.dumps(told)})")
        first = peer.message() if not exchange.done() else exchange.result()
        assert first.topic == f"{topic}/ready"
        for number in range(1, COUNT):
            peer.publish(f"{topic}/down", str(number), 2)
        peer.publish(f"{topic}/down", bytes(LARGE), 2)
        result = exchange.result(START_TIMEOUT)
        heard = [message for message in peer.receive(2 * COUNT) if message.topic == f"{topic}/up"]
        end = uuid.uuid4().hex
        peer.publish(f"{topic}/up", end, 2)
        assert peer.message().payload.decode() == end  # and nothing twice
    numbers = [str(number) for number in range(1, COUNT)]
    assert [message.payload.decode() for message in heard[:-1]] == numbers
    assert heard[-1].payload == bytes(LARGE)
    assert {(message.qos, message.dup) for message in heard} == {(2, False)}
    assert result == {
        "granted": 2,
        "present": False,
        "received": [[payload, 2, False] for payload in (*numbers, LARGE)],
    }
