"""The pages Camera and Map in a real Chromium: journey 7, and what strangers may publish."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess
from visits import PHONE, Visit
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
