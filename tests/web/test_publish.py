"""Journeys 3 and 5 in a real Chromium: publish with a mistake, then rightly; the routes."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import cbor2
import pytest
from appliance_process import ROBOT, ApplianceProcess
from interop.paho_peer import V5, Peer
from ros_domain import DOMAIN
from ros_domain import isolated_domain as isolated_domain
from visits import DESKTOP, PHONE, Visit
from waiting import PATIENCE, eventually

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")
import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import CompressedImage, LaserScan
from std_msgs.msg import Int64MultiArray

BIG = 2**53 + 1
BATTERY = f"{ROBOT}/battery"


@pytest.fixture(scope="module")
def bridge(bridge: dict[str, Any]) -> dict[str, Any]:
    return {
        **bridge,
        "topics": [
            *bridge["topics"],
            {"ros": "/big", "to": "ros", "type": "std_msgs/msg/Int64"},
            {"ros": "/battery", "to": "ros", "type": "sensor_msgs/msg/BatteryState"},
            {
                "ros": "/tensor",
                "to": "ros",
                "type": "std_msgs/msg/Int64MultiArray",
                "encoding": "cbor",
            },
            {
                "ros": "/photo",
                "to": "ros",
                "type": "sensor_msgs/msg/CompressedImage",
                "encoding": "cbor",
                "compression": "zstd",
            },
            {
                "ros": "/laser",
                "to": "ros",
                "type": "sensor_msgs/msg/LaserScan",
                "encoding": "cbor",
            },
            {"ros": "/nothing", "to": "mqtt", "type": "acme_msgs/msg/Nothing"},
        ],
    }


@pytest.fixture(scope="module")
def acl(acl: str) -> str:
    """Alice may also say things that an appliance of another name would say."""
    return acl.replace("user alice\n", "user alice\ntopic readwrite evil/#\n")


def opened(visited: Visit, topic: str, user: str = "alice") -> Any:
    """The form for a topic, as somebody gets there who has signed in."""
    page = visited.sign_in(user, "Publish")
    page.wait_for_selector(f"option[value='{topic}']", state="attached")
    page.select_option("select", topic)
    page.wait_for_selector(".publish .both")
    return page


def send(page: Any, words: str) -> None:
    """Publish, and wait for what the broker answers."""
    page.click("button:text-is('Publish')")
    page.wait_for_selector(f".publish .notice:has-text('{words}')")


def test_publish_with_a_mistake_then_rightly(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """Journey 5: mistakes are told at their field, by the schema and by the appliance."""
    visited = visit(**DESKTOP)
    page = opened(visited, BATTERY)
    with Peer(appliance, V5) as peer:
        peer.subscribe(BATTERY)
        page.fill("#field-power_supply_status", "300")
        page.wait_for_selector("#field-power_supply_status-error:has-text('not within 0 to 255')")
        page.click("button:text-is('Publish')")
        page.wait_for_selector("#field-power_supply_status:focus")
        page.fill("#field-power_supply_status", "2")
        page.wait_for_selector("text=POWER_SUPPLY_STATUS_DISCHARGING")
        page.wait_for_selector("#field-power_supply_status-error", state="detached")
        page.fill("#field-voltage", "1e300")  # which no schema forbids
        send(page, "0x99")
        page.wait_for_selector("#field-voltage-error:has-text('does not fit in float32')")
        sent = peer.message().payload.decode()  # nothing was sent before
        assert json.loads(sent) == {"power_supply_status": 2, "voltage": 1e300}
        visited.look("desktop-publish-1-mistake")
        page.fill("#field-voltage", "12.50")
        page.press("#field-voltage", "Enter")  # publishes nothing
        page.fill("#field-current", "nan")
        page.check("#field-present")
        page.click("summary:has-text('header')")
        page.click("summary:has-text('stamp')")
        page.check("text='now, when the robot gets it'")
        page.click("summary:has-text('cell_voltage')")
        page.click("[aria-label='Add an item to cell_voltage']")
        page.fill("[id='field-cell_voltage%5B0%5D']", "4.2")
        send(page, "0x00")
        sent = peer.message().payload.decode()
        assert "12.50" in sent and json.loads(sent) == {
            "header": {"stamp": "now"},
            "power_supply_status": 2,
            "voltage": 12.5,
            "current": None,
            "present": True,
            "cell_voltage": [4.2],
        }
        visited.look("desktop-publish-2-sent")
        page.fill(".publish textarea", '{"voltage": 1.5, "location": "<b>here"')
        page.wait_for_selector(".raw .bad:has-text('Not JSON: line 1')")
        page.fill(".publish textarea", '{"voltage": 1.5, "location": "<b>here"}')
        page.wait_for_selector("#field-location")
        assert page.input_value("#field-location") == "<b>here"
        page.fill(".publish textarea", '{"volts": 1.5}')
        page.wait_for_selector(".fields .bad:has-text('volts: unknown field')")


def test_large_integers_arrive_exact(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """Journey 5: 2^53 + 1, from the form and from the text; QoS 0, retain and expiry."""
    visited = visit(**PHONE)
    page = opened(visited, f"{ROBOT}/big")
    with Peer(appliance, V5) as peer:
        peer.subscribe(f"{ROBOT}/big")
        page.fill("#field-data", str(BIG))
        assert str(BIG) in page.input_value(".publish textarea")
        send(page, "0x00")
        assert json.loads(peer.message().payload) == {"data": BIG}
        page.fill(".publish textarea", f'{{"data": -{BIG}}}')
        assert page.input_value("#field-data") == f"-{BIG}"
        page.click("summary:has-text('QoS')")
        page.select_option("#qos", "0")
        page.check("#retain")
        page.fill("#expiry", "60")
        visited.look("phone-publish-3-big")
        send(page, "Sent.")
        message = peer.message()
        assert json.loads(message.payload) == {"data": -BIG}
        assert message.properties.MessageExpiryInterval <= 60
        assert message.properties.ContentType == "application/json"
        page.fill("#field-data", "9223372036854775808")
        page.wait_for_selector("#field-data-error:has-text('not within')")


class Listener:
    """A node that hears what comes on topics of ROS; their types by their names."""

    def __init__(self, **types: Any) -> None:
        self._context = rclpy.Context()
        self._context.init(domain_id=int(DOMAIN))
        self._node = rclpy.create_node("listener", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._heard: list[tuple[str, Any]] = []
        for name, kind in types.items():
            topic = self._node.create_subscription(kind, f"/{name}", partial(self._hear, name), 10)
            deadline = time.monotonic() + PATIENCE
            while not topic.get_publisher_count():  # what is sent before they match is lost
                assert time.monotonic() < deadline, f"nobody publishes on /{name}"
                self._executor.spin_once(timeout_sec=0.1)

    def _hear(self, name: str, message: Any) -> None:
        self._heard.append((name, message))

    def hears(self, expected: str) -> Any:
        """The next message, which is of this topic."""
        deadline = time.monotonic() + PATIENCE
        while not self._heard and time.monotonic() < deadline:
            self._executor.spin_once(timeout_sec=0.1)
        name, message = self._heard.pop(0)
        assert name == expected
        return message

    def stop(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()


@pytest.fixture
def listener(appliance: ApplianceProcess, isolated_domain: None) -> Iterator[Listener]:
    listener = Listener(tensor=Int64MultiArray, photo=CompressedImage, laser=LaserScan)
    yield listener
    listener.stop()


def test_a_form_is_sent_as_cbor(
    visit: Callable[..., Visit], appliance: ApplianceProcess, listener: Listener
) -> None:
    """Journey 5 on routes in CBOR: ROS gets 2^53 + 1, floats and bytes as they were entered."""
    visited = visit(**DESKTOP)
    page = opened(visited, f"{ROBOT}/tensor")
    with Peer(appliance, V5) as peer:
        peer.subscribe(f"{ROBOT}/tensor")
        page.fill(".publish textarea", f'{{"data": [0, {-BIG}], "layout": {{"data_offset": 7}}}}')
        page.click("summary:has(bdi:text-is('data'))")
        page.fill("[id='field-data%5B0%5D']", str(BIG))
        send(page, "0x00")
        heard = listener.hears("tensor")
        assert list(heard.data) == [BIG, -BIG] and heard.layout.data_offset == 7
        message = peer.message()
        assert message.properties.ContentType == "application/cbor"
        assert cbor2.loads(message.payload)["data"].tag == 79  # little endian, 64 bits
        visited.look("desktop-publish-5-cbor")
        page.select_option("select", f"{ROBOT}/photo")
        page.wait_for_selector("#field-format")
        page.fill("#field-format", "jpeg; ü")
        page.click("summary:has-text('header')")
        page.click("summary:has-text('stamp')")
        page.check("text='now, when the robot gets it'")
        page.fill("#field-data", "AP8=")
        send(page, "0x00")
        photo = listener.hears("photo")
        assert bytes(photo.data) == b"\x00\xff" and photo.format == "jpeg; ü"
        assert photo.header.stamp.sec > 0
        page.select_option("select", f"{ROBOT}/laser")
        page.wait_for_selector("#field-range_max")
        page.fill(".publish textarea", '{"range_max": 12, "ranges": [1, 0.5, null, 1e300]}')
        send(page, "0x99")  # what no schema forbids, and float32 does
        page.wait_for_selector(".warnings:has-text('ranges[3]')")
        page.fill(".publish textarea", '{"range_max": 12, "ranges": [1, 0.5, null]}')
        send(page, "0x00")
        scan = listener.hears("laser")
        assert scan.range_max == 12.0 and list(scan.ranges[:2]) == [1.0, 0.5]
        assert math.isnan(scan.ranges[2])


def test_a_viewer_may_not(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Journey 3: the button is disabled, and the line of the ACL is named."""
    visited = visit(**PHONE)
    page = opened(visited, BATTERY, "viewer")
    page.wait_for_selector(f".notice:has-text('topic write {BATTERY}')")
    assert page.is_disabled("button:text-is('Publish')")
    visited.look("phone-publish-4-viewer")


def test_from_the_inspector(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """A topic without a route: text as it is, and bytes as base64."""
    page = visit(**PHONE).sign_in(page="Topics")
    topic = f"{ROBOT}/plain"
    with Peer(appliance, V5) as peer:
        peer.publish(topic, "before", retain=True)
        page.fill("input[type=search]", topic)
        page.click(f"a[href$='{topic.replace('/', '%2F')}']")
        page.click(".inspector a:text-is('Publish')")
        page.select_option(".publish select", "text")
        peer.subscribe(topic)
        assert peer.message().payload == b"before"
        page.fill(".publish textarea", "after <b>")
        send(page, "0x00")
        assert peer.message().payload == b"after <b>"
        page.select_option(".publish select", "base64")
        page.fill(".publish textarea", "no base64!")
        send(page, "This is not base64.")
        page.fill(".publish textarea", "AP8=")
        send(page, "0x00")
        assert peer.message().payload == b"\x00\xff"
        peer.publish(topic, b"", retain=True)


def test_routes(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """The figures move, the list is searched and sorted, and what is not bridged says why."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Routes")
    rate = f"tr:has(bdi:text-is('{ROBOT}/odom')) [data-label=Hz]"
    page.wait_for_selector(rate)
    eventually(lambda: float(page.inner_text(rate)) > 1, "the rate of a second ago")
    page.wait_for_selector("li:has-text('acme_msgs')")
    page.click("th button:has-text('Hz')")
    page.wait_for_selector("tbody tr:first-child:has-text('/odom')")
    visited.look("desktop-routes-1-list")
    page.fill("input[type=search]", "cmd_vel")
    page.wait_for_selector("text='2 routes'")
    page.click("tbody bdi:text-is('/cmd_vel')")
    told = page.inner_text(".properties")
    assert "-0.25 to 0.5" in told and "the stop message after 0.5 s" in told and "nobody" in told
    visited.look("desktop-routes-2-details")
    page.click(".inspector a:text-is('Publish')")
    page.wait_for_selector(".publish .fields")
    phone = visit(**PHONE, color_scheme="dark")
    phone.sign_in("viewer", page="Routes").wait_for_selector(rate)
    phone.look("phone-routes-3-list")


MANY = {"type": "object", "properties": {f"f{n}": {} for n in range(10_000)}}
SCHEMAS = {
    "a/Deep": "[" * 15000,
    "a/Many": json.dumps(MANY),
    "a/Self": '{"type": "object", "properties": {"inner": {"$ref": "#"}, "__proto__": '
    '{"$ref": "#"}}}',
    "a/Loop": '{"$ref": "#"}',
    "a/Types": '{"type": "object", "properties": {"<img src=x onerror=alert(1)>": 5, '
    '"constructor": {"type": ["a"], "anyOf": 3, "default": {"a": []}}, '
    '"n": {"type": "integer", "minimum": {}}}}',
    "a/None": "\x01",
}


def test_hostile_schemas(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Whatever stands where a schema should: the page goes on, and publishes."""
    visited = visit(**DESKTOP)
    page = visited.sign_in()
    route: dict[str, Any] = {"ros": "/x", "encoding": "json", "direction": "to_ros"}
    route |= {"rules": 5, "rate": "x", "latency_ms": [1], "lost": {"toString": 5}}
    routes = [
        {**route, "mqtt": f"evil/{name}", "type": name.replace("/", "/msg/")} for name in SCHEMAS
    ]
    with Peer(appliance, V5) as peer:
        for name, schema in SCHEMAS.items():
            topic = f"evil/_appliance/schema/{name}"
            peer.publish(topic, schema, retain=True, ContentType="application/schema+json")
        listed: list[Any] = [
            *routes,
            None,
            5,
            {"direction": "to_ros"},
            {"direction": "__proto__", "mqtt": {}},
        ]
        peer.publish("evil/_appliance/routes", json.dumps(listed), retain=True)
        live = {"routes": [None, {"mqtt": {}, "direction": 5}, {**routes[0], "rate": "<b>"}]}
        peer.publish("evil/_appliance/live", json.dumps(live), retain=True)
        peer.publish("evil/_appliance/skipped", '{"skipped": [null, {"ros": {}}]}', retain=True)
        page.click("nav a:has-text('Publish')")
        for name in SCHEMAS:
            page.wait_for_selector(f"option[value='evil/{name}']", state="attached")
            page.select_option("select", f"evil/{name}")
            page.wait_for_selector(f"h2:has-text('evil/{name}')")
            page.fill(".publish textarea", "{}")
            if name == "a/Many":
                page.click("button:text-is('9950 more fields')")
            if name == "a/Self":
                page.click("summary:has-text('inner')")
                page.click("summary:has-text('inner') >> nth=1")
                page.fill(".publish textarea", '{"__proto__": {"hacked": 1}}')
                page.wait_for_selector(".bad:has-text('hacked')")
                page.fill(".publish textarea", "{}")
            send(page, "0x00")
        assert page.evaluate("({}).hacked === undefined")
        page.click("nav a:has-text('Routes')")
        page.wait_for_selector("td:has-text('evil/a/Many')")
        page.click("tbody bdi:text-is('/x') >> nth=0")
        page.wait_for_selector(".properties")
        for name in [*(f"schema/{name}" for name in SCHEMAS), "routes", "live", "skipped"]:
            peer.publish(f"evil/_appliance/{name}", b"", retain=True)
    assert all("evil" not in url.partition("#")[0] for url in visited.requests)
