"""The pages Camera and Map in a real Chromium: journey 7, and what strangers may publish."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from functools import partial
from typing import Any

import cbor2
import pytest
from appliance_process import ROBOT, ApplianceProcess
from interop.paho_peer import V5, Peer
from visits import DESKTOP, PHONE, Visit
from waiting import eventually

from appliance import config
from appliance.ops.control import ask

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")
pytest.importorskip("PIL")

CAMERA = f"{ROBOT}/camera/image_raw"

#: A picture of one pixel.
PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


@pytest.fixture(scope="module")
def bridge() -> dict[str, Any]:
    return {
        "discovery": "localhost",
        "topics": [
            {"ros": "/camera/image_raw", "to": "mqtt", "encoding": "jpeg"},
            {"ros": "/odom", "to": "mqtt", "rate": 10},
            {"ros": "/scan", "to": "mqtt"},
            {"ros": "/map", "to": "mqtt", "encoding": "cbor"},
        ],
    }


def rates(appliance: ApplianceProcess, topic: str) -> list[float]:
    """The rates of all subscriptions to exactly this topic, which the console's pages have."""
    clients = ask(config.load(appliance.config).control, "clients", arguments={"user": "alice"})
    return [
        subscription["max_rate"]
        for client in clients["clients"]
        for subscription in client["subscriptions"]
        if subscription["filter"] == topic
    ]


def pixels(page: Any) -> str:
    """What the canvas shows."""
    return str(page.evaluate("document.querySelector('canvas').toDataURL()"))


def wait_for_other_pixels(page: Any, act: Callable[[], Any]) -> None:
    before = pixels(page)
    act()
    eventually(lambda: pixels(page) != before, f"the canvas changes after {act}")


def two_fingers(page: Any) -> None:
    """Put two fingers on the canvas, and move them apart."""
    box = page.locator("canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)
    for apart, kind in ((20, "touchStart"), (60, "touchMove"), (100, "touchMove"), (0, "touchEnd")):
        points = [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
        event = {"type": kind, "touchPoints": points if apart else []}
        touch.send("Input.dispatchTouchEvent", event)


def show_as(page: Any, *, hidden: bool) -> None:
    """Hide the tab, or show it: a browser without a screen has no other tab to put before it."""
    page.evaluate(
        """hidden => {
            Object.defineProperty(document, 'hidden', {value: hidden, configurable: true})
            document.dispatchEvent(new Event('visibilitychange'))
        }""",
        hidden,
    )


def test_a_camera(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Journey 7: a raw Image is seen as jpeg, moves, and is not sent to a hidden tab."""
    visited = visit(**PHONE)
    page = visited.sign_in(page="Camera")
    page.wait_for_selector("dd:text-is('320 × 240')")
    first = pixels(page)
    eventually(lambda: pixels(page) != first, "the picture moves")
    visited.look("phone-camera")
    with page.expect_download() as download:
        page.click("text=Save the picture")
    assert download.value.path().read_bytes().startswith(b"\x89PNG")
    assert rates(appliance, CAMERA) == [5]
    show_as(page, hidden=True)
    eventually(lambda: rates(appliance, CAMERA) == [], "the subscription has ended")
    last = pixels(page)
    show_as(page, hidden=False)
    eventually(lambda: pixels(page) != last, "the picture moves again")
    page.select_option("label:has-text('second') select", "2")
    eventually(lambda: rates(appliance, CAMERA) == [2], "another rate")
    page.click("text=Pause")
    eventually(lambda: rates(appliance, CAMERA) == [], "the subscription has ended")
    page.click("text=Continue")
    eventually(lambda: rates(appliance, CAMERA) == [2], "it is there again")
    page.click("nav a:has-text('Overview')")
    eventually(lambda: rates(appliance, CAMERA) == [], "the page is left")


#: What may come in place of a picture, and what the page says then.
NO_PICTURES = [
    ("image/jpeg", b"", "empty"),
    ("image/jpeg", b"\xff\xd8\xff\x00 no picture", "without a size"),
    ("image/png", PIXEL[:45], "cannot be read"),
    ("image/png", PIXEL[:16] + bytes([0, 0, 255, 255] * 2) + PIXEL[24:], "are shown"),
    ("image/svg+xml", b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>", "no picture"),
    ("application/json", b'{"data": "<img src=x onerror=alert(2)>"}', "base64"),
    ("application/json", b"[" * 100000, "JSON"),
    ("application/cbor", bytes([0x81]) * 100000, "could not be shown"),
    ("application/cdr", bytes([0, 1, 0, 0]) + b"\xff" * 20, "CompressedImage"),
    ("text/html", b"<script>alert(3)</script>", "no picture"),
]


def test_pictures_that_are_none(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Each says what is wrong with it, and the next picture is shown."""
    topic = f"{ROBOT}/hostile/<b>camera"
    visited = visit(color_scheme="dark", **DESKTOP)
    page = visited.sign_in(page="Camera")
    page.evaluate("topic => location.hash = '#/camera/' + encodeURIComponent(topic)", topic)
    eventually(lambda: rates(appliance, topic) == [5], "the page subscribes")
    with Peer(appliance, V5) as peer:
        for content_type, payload, words in NO_PICTURES:
            peer.publish(topic, payload, ContentType=content_type)
            page.wait_for_selector(f".notice.bad:has-text('{words}')")
            if content_type == "text/html":
                visited.look("desktop-camera-bad")
            peer.publish(topic, PIXEL, ContentType="image/png")
            page.wait_for_selector(".notice.bad", state="detached")
        page.wait_for_selector("dd:text-is('1 × 1')")


def test_a_camera_that_may_not_be_read(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    page = visit(**PHONE).sign_in("viewer", "Camera")
    page.evaluate("location.hash = '#/camera/other%2Fcamera'")
    page.wait_for_selector(".notice.bad:has-text('topic read other/camera')")


@pytest.mark.parametrize(("kind", "options"), [("phone", PHONE), ("desktop", DESKTOP)])
def test_a_map(
    visit: Callable[..., Visit], appliance: ApplianceProcess, kind: str, options: dict[str, Any]
) -> None:
    """The robot on its map, with what its scanner sees; not sent to a hidden tab."""
    visited = visit(**options)
    page = visited.sign_in(page="Map")
    page.wait_for_selector("dd:text-is('240 × 240, 0.05 m')")
    page.wait_for_selector("dd:text-is('360 points')")
    page.wait_for_selector("dd:text-is('0.00, 0.00 m')")
    assert page.locator(".notice").count() == 0
    visited.look(f"{kind}-map")
    page.hover("canvas")
    wait_for_other_pixels(page, lambda: page.mouse.wheel(0, -300))
    drag = {"source_position": {"x": 90, "y": 90}, "target_position": {"x": 120, "y": 50}}
    wait_for_other_pixels(page, lambda: page.drag_and_drop("canvas", "canvas", **drag))
    wait_for_other_pixels(page, lambda: two_fingers(page))
    for name in ("Follow", "+", "Show all"):
        wait_for_other_pixels(page, partial(page.click, f"button:text-is('{name}')"))
    for key in ("ArrowLeft", "+", "0"):
        wait_for_other_pixels(page, partial(page.press, "canvas", key))
    visited.look(f"{kind}-map-moved")
    show_as(page, hidden=True)
    eventually(lambda: rates(appliance, f"{ROBOT}/odom") == [], "the subscriptions end")
    show_as(page, hidden=False)
    eventually(lambda: rates(appliance, f"{ROBOT}/odom") == [10], "and are there again")


def test_maps_that_are_none(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Each says what is wrong with it; the last good one stays."""
    page = visit(**DESKTOP).sign_in(page="Map")
    page.wait_for_selector("dd:text-is('240 × 240, 0.05 m')")
    info = {"resolution": 0.1, "width": 2, "height": 2, "origin": {"position": {"x": 0, "y": 0}}}
    grids = [
        ({"info": info, "data": [0]}, "2 × 2 cells, and 1"),
        ({"info": {**info, "resolution": -1}, "data": [0] * 4}, "resolution of -1"),
        ({"info": {**info, "resolution": None}, "data": [0] * 4}, "resolution of NaN"),
        ({"info": {**info, "width": 1e9, "height": 1e9}, "data": [0] * 4}, "at most"),
        ({"info": {**info, "origin": None}, "data": [0] * 4}, "a position of"),
        ([[]], "no cells"),
    ]
    with Peer(appliance, V5) as peer:
        for grid, words in grids:
            content = {"ContentType": "application/json"}
            peer.publish(f"{ROBOT}/map", json.dumps(grid), **content)
            page.wait_for_selector(f".notice.bad:has-text('{words}')")
        page.wait_for_selector("dd:text-is('240 × 240, 0.05 m')")
        for part in ("odom", "scan"):  # the robot's next one is drawn again
            peer.publish(f"{ROBOT}/{part}", "{}", **content)


def test_a_large_map(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """One of 4000 × 4000 cells, which is retained."""
    side = 4000
    info = {"resolution": 0.05, "width": side, "height": side}
    info["origin"] = {"position": {"x": 0, "y": 0}}
    large = cbor2.dumps({"info": info, "data": cbor2.CBORTag(72, bytes(side * side))})
    with Peer(appliance, V5) as peer:
        peer.publish(f"{ROBOT}/map", large, retain=True, ContentType="application/cbor")
        page = visit(**DESKTOP).sign_in(page="Map")
        page.wait_for_selector(f"dd:text-is('{side} × {side}, 0.05 m')")
        page.click("button[aria-label=Enlarge]")
        peer.publish(f"{ROBOT}/map", b"", retain=True)
