"""Journey 6 in a real Chromium: services, goals and parameters of a robot with rclpy."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess
from interop.paho_peer import V5, Peer
from ros_domain import DOMAIN
from visits import DESKTOP, PHONE, Visit, wait_for_change
from waiting import eventually

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")
from robot_process import Robot

TURTLE = f"{ROBOT}/turtle"
BIG = 2**53 + 1


@pytest.fixture(scope="module")
def bridge() -> dict[str, Any]:
    return {
        "discovery": "localhost",
        "services": ["/turtle/*"],
        "actions": [{"ros": "/turtle/walk", "keep_result": "10 min"}],
        "parameters": ["/turtle/*"],
    }


@pytest.fixture(scope="module")
def robot(appliance: ApplianceProcess) -> Iterator[Robot]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", DOMAIN)
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        robot = Robot()
    robot.wait()
    yield robot
    robot.stop()


def opened(visited: Visit, name: str, user: str = "alice") -> Any:
    """The page of a call, as somebody gets there who has signed in."""
    page = visited.sign_in(user, "Calls")
    page.fill("input[aria-label='Search calls']", "turtle")
    page.click(f".row:has(bdi:text-is('{name}'))")
    page.wait_for_selector(f"h2:has-text('{name}')")
    return page


def ask(page: Any, request: str, word: str) -> None:
    """Fill in a request, once its form is there, and send it."""
    page.wait_for_selector(".request .both")
    page.fill(".request textarea", request)
    page.click(f"button:text-is('{word}')")


def test_a_service(visit: Callable[..., Visit], robot: Robot) -> None:
    """The form of its type, its answer, its errors, and one that never answers."""
    visited = visit(**PHONE)
    page = opened(visited, "/turtle/pen")
    page.wait_for_selector(".request .both")
    page.click("button:text-is('Call')")
    page.wait_for_selector('[aria-label=Answer]:has-text(\'"message": "up"\')')
    page.check(".request input[type=checkbox]")
    assert json.loads(page.input_value(".request textarea")) == {"data": True}
    page.click("button:text-is('Call')")
    page.wait_for_selector('[aria-label=Answer]:has-text(\'"message": "down"\')')
    assert " ms" in page.inner_text(".call")
    visited.look("phone-calls-1-service")
    ask(page, '{"data": tru}', "Call")
    page.wait_for_selector(".request .bad:has-text('Not JSON')")
    ask(page, '{"data": 1}', "Call")
    page.wait_for_selector(".warnings:has-text('data expected true or false')")
    page.click("text=Close")
    page.click(".row:has(bdi:text-is('/turtle/think'))")
    page.click("button:text-is('Call')")
    page.wait_for_selector(".call .bad:has-text('timeout: ')")


def test_goals(visit: Callable[..., Visit], robot: Robot) -> None:
    """Feedback while it runs, cancelling, results, and all of it after the page came anew."""
    visited = visit(color_scheme="dark", **DESKTOP)
    page = opened(visited, "/turtle/walk")
    ask(page, '{"order": 3}', "Send goal")
    page.wait_for_selector(".call:has(strong:text-is('succeeded')) [aria-label=Result]")
    ask(page, '{"order": -1}', "Send goal")
    page.wait_for_selector(".bad:has-text('does not accept')")
    ask(page, '{"order": 5000}', "Send goal")
    running = ".call:has(strong:text-is('executing'))"
    page.wait_for_selector(f"{running} [aria-label=Feedback]")
    wait_for_change(page, f"{running} [aria-label=Feedback]")
    page.wait_for_selector(f"{running} p:has-text('Hz')")
    visited.look("desktop-calls-2-goal")

    page.reload()  # it stays signed in, and where it was
    page.wait_for_selector("h2:has-text('/turtle/walk')")
    page.wait_for_selector(f"{running} [aria-label=Feedback]")
    wait_for_change(page, f"{running} [aria-label=Feedback]")
    page.wait_for_selector(".call:has(strong:text-is('succeeded')) [aria-label=Result]")
    page.click(f"{running} button:text-is('Cancel')")
    page.wait_for_selector(".call:has(strong:text-is('canceled')) [aria-label=Result]")
    robot.hear("walked")


def test_goals_of_others(
    visit: Callable[..., Visit], robot: Robot, appliance: ApplianceProcess
) -> None:
    """They are listed, and those of the same user are cancelled, wherever they were sent."""
    page = opened(visit(**PHONE), "/turtle/walk")
    with Peer(appliance, V5) as peer:
        peer.publish(f"{TURTLE}/walk/_goal/1", '{"order": 5000}')
        running = ".call:has(button:text-is('Cancel'))"
        page.wait_for_selector(f"{running} [aria-label=Feedback]")
        assert "sent here" not in page.inner_text(running)
        goal = page.get_attribute(running, "aria-label")
        page.click(f"{running} button")
        page.wait_for_selector(f"[aria-label='{goal}']:has(strong:text-is('canceled')) pre")


def value(appliance: ApplianceProcess, name: str) -> str:
    """A parameter's retained value, as it is on MQTT."""
    with Peer(appliance, V5) as peer:
        peer.subscribe(f"{TURTLE}/_param/{name}")
        return str(peer.message().payload.decode())


def test_parameters(visit: Callable[..., Visit], robot: Robot, appliance: ApplianceProcess) -> None:
    """One, several all or none, a refusal in the node's words, and 64 bits."""
    robot.do("declare", "big", BIG)
    visited = visit(**PHONE)
    page = opened(visited, "/turtle")
    field = ".parameter:has(bdi:text-is('{}')) input"
    page.wait_for_selector(field.format("big"))
    assert page.input_value(field.format("big")) == str(BIG)
    page.fill(field.format("big"), str(BIG + 2))
    page.click("button:text-is('Set')")
    page.wait_for_selector("text='big is set.'")
    eventually(lambda: value(appliance, "big") == str(BIG + 2), "the exact value")
    page.fill(field.format("steps"), "many")
    page.wait_for_selector("text='An integer is wanted.'")
    page.fill(field.format("steps"), "20")
    page.fill(field.format("mode"), "furious")
    page.evaluate("scrollTo(0, 0)")  # the header covers nothing there
    visited.look("phone-calls-3-parameters")
    page.click("button:text-is('Set 2, all or none')")
    page.wait_for_selector(".notice.bad:has-text('there is no mode furious')")
    assert value(appliance, "steps") == "10"
    page.fill(field.format("mode"), "wild")
    page.click("button:text-is('Set 2, all or none')")
    page.wait_for_selector("text='2 parameters are set.'")
    eventually(lambda: value(appliance, "steps") == "20", "the other value")
    page.fill(field.format("serial"), "T-1000")
    page.click("button:text-is('Set')")
    page.wait_for_selector(".notice.bad:has-text('read-only')")
    page.click("button:text-is('Undo')")
    assert page.input_value(field.format("serial")) == "T-800"


def test_a_viewer_is_told_which_lines_are_missing(
    visit: Callable[..., Visit], robot: Robot, appliance: ApplianceProcess
) -> None:
    """Every control is disabled, with the line of the ACL that would allow it."""
    visited = visit(color_scheme="dark", **PHONE)
    page = opened(visited, "/turtle/pen", "viewer")
    page.wait_for_selector(f".notice code:text-is('topic write {TURTLE}/pen/_call')")
    assert page.is_disabled("button:text-is('Call')")
    visited.look("phone-calls-4-viewer")
    page.click("text=Close")
    visited.look("phone-calls-5-list")
    page.click(".row:has(bdi:text-is('/turtle/walk'))")
    for right in ("_goal", "_cancel"):
        page.wait_for_selector(f".notice code:text-is('topic write {TURTLE}/walk/{right}')")
    assert page.is_disabled("button:text-is('Send goal')")
    page.click("text=Close")
    page.click(".row:has(bdi:text-is('/turtle'))")
    page.wait_for_selector(f".notice code:text-is('topic write {TURTLE}/_param/_set')")
    page.wait_for_selector(".parameter:has(bdi:text-is('mode')) input:disabled")


HOSTILE = {
    "_param/<img src=x onerror=alert(1)>": '"<script>alert(2)</script>"',
    "_param/__proto__": '{"__proto__": {"hacked": 1}}',
    "_param/deep": "[" * 15000 + "]" * 15000,
    "_param/large": json.dumps("x" * 1_000_000),
    "walk/_feedback/<b>id": "[" * 15000,
    "walk/_feedback/__proto__": '{"__proto__": 1}',
    "walk/_result/text": "\x01 no JSON",
    "walk/_status": '[null, 1, {"goal_id": {}}, {"goal_id": "<b>", "status": {}, "stamp": "x"}]',
}


def test_hostile_messages(
    visit: Callable[..., Visit], robot: Robot, appliance: ApplianceProcess
) -> None:
    """No script runs, and the page goes on."""
    visited = visit(**DESKTOP)
    with Peer(appliance, V5) as peer:
        for topic, payload in HOSTILE.items():
            peer.publish(f"{TURTLE}/{topic}", payload, retain=True)
        page = opened(visited, "/turtle")
        page.wait_for_selector(".parameter:has(bdi:text-is('deep'))")
        page.wait_for_selector(".parameter:has(bdi:text-is('large'))")
        page.click("text=Close")
        page.click(".row:has(bdi:text-is('/turtle/walk'))")
        page.wait_for_selector("[aria-label='Goal <b>']")
        page.wait_for_selector("[aria-label='Goal __proto__'] [aria-label=Feedback]")
        page.wait_for_selector("[aria-label='Goal <b>id'] [aria-label=Feedback]")
        assert page.evaluate("({}).hacked === undefined")
        for topic in HOSTILE:
            peer.publish(f"{TURTLE}/{topic}", b"", retain=True)
        page.wait_for_selector("[aria-label='Goal __proto__']", state="detached")
    ask(page, '{"order": 1}', "Send goal")
    page.wait_for_selector(".call:has(strong:text-is('succeeded')) [aria-label=Result]")
