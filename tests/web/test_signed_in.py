"""Journey 9: a page that is loaded again, an appliance that starts again, and who signs out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess, free_ports
from test_journeys import SPEED, Odometry, hold
from test_journeys import odometry as odometry
from visits import DESKTOP, PHONE, Visit
from waiting import eventually

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")

BACK_WITHIN = 5.0  # seconds after the appliance listens again
STORED = "sessionStorage.getItem('console')"


@pytest.fixture(scope="module")
def web_port() -> int:
    """The appliance can be started again at the same place."""
    return free_ports(1)[0]


def stored(page: Any) -> dict[str, str]:
    """What the page keeps for when it is loaded again, once it does."""
    eventually(lambda: page.evaluate(STORED) is not None, "a token")
    found: dict[str, str] = json.loads(page.evaluate(STORED))
    return found


def reload(visited: Visit, place: str) -> None:
    """Load the page again until that is there."""
    visited.page.reload()
    visited.page.wait_for_selector(place)


def test_a_page_that_is_loaded_again_stays_signed_in(
    visit: Callable[..., Visit], odometry: Odometry, appliance: ApplianceProcess
) -> None:
    visited = visit(**DESKTOP)
    page = visited.sign_in()
    kept = stored(page)
    assert kept["name"] == "alice" and kept["token"].startswith("appliance-token-")
    assert page.evaluate("[localStorage.length, document.cookie]") == [0, ""]
    for _ in range(2):
        reload(visited, "nav")
    assert stored(page) == kept  # no token makes another one
    page.click("nav a:has-text('Drive')")
    hold(page)
    eventually(lambda: odometry.speed > SPEED, "it drives, by a login with the token")
    page.mouse.up()
    odometry.stands()
    hold(page)  # the login after a release
    eventually(lambda: odometry.speed > SPEED, "and again")
    page.mouse.up()
    odometry.stands()
    for secret in (kept["token"], appliance.passwords["alice"]):
        assert secret not in appliance.log


def test_who_signs_out_is_out(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    visited = visit(**PHONE)
    page = visited.sign_in()
    kept = stored(page)
    reload(visited, "nav")
    before = appliance.log.count("token ended")
    visited.sign_out()
    eventually(lambda: appliance.log.count("token ended") > before, "the token ends")
    assert page.evaluate(STORED) is None
    reload(visited, "input[name=password]")
    assert page.is_visible("form button:text-is('Sign in')")
    page.evaluate("text => sessionStorage.setItem('console', text)", json.dumps(kept))
    # With the token that somebody has read here before.
    reload(visited, "text=You were signed out. Sign in again.")
    assert page.evaluate(STORED) is None
    visited.look("phone-9-signed-out")


def test_a_user_without_the_right_to_a_token(visit: Callable[..., Visit]) -> None:
    """As before there were tokens: the password is asked for again."""
    visited = visit(**PHONE)
    visited.sign_in("viewer").wait_for_selector("dl.tiles")
    reload(visited, "input[name=password]")


@pytest.mark.parametrize("kept", ["{", "[]", '{"name": 1, "token": {}}', "null"])
def test_what_is_stored_is_not_ours(visit: Callable[..., Visit], kept: str) -> None:
    visited = visit(**PHONE)
    visited.page.evaluate("text => sessionStorage.setItem('console', text)", kept)
    reload(visited, "input[name=password]")


@pytest.mark.timed
def test_the_appliance_starts_again(
    visit: Callable[..., Visit], odometry: Odometry, appliance: ApplianceProcess
) -> None:
    """The page is back by itself, and what was commanded before is over."""
    visited, second = visit(**PHONE), visit(**PHONE)
    page = visited.sign_in(page="Drive")
    kept = stored(page)
    other = second.sign_in()
    stored(other)
    reload(second, "nav")  # it has only the token
    hold(page)
    eventually(lambda: odometry.speed > SPEED, "it drives")
    appliance.stop()
    page.wait_for_selector("text=The connection is lost; trying again.")
    page.mouse.up()
    appliance.start()
    begun = time.monotonic()
    page.wait_for_selector("text=The connection is lost; trying again.", state="detached")
    back_after = time.monotonic() - begun
    anew = Odometry(appliance)
    with anew.peer as peer:
        peer.subscribe(f"{ROBOT}/odom")
        anew.stands()
        page.wait_for_selector("dd:text-is('ready')")
        anew.stands()
        eventually(lambda: stored(page)["token"] != kept["token"], "a token of the new process")
        other.wait_for_selector("text=You were signed out. Sign in again.")
        hold(page)
        eventually(lambda: anew.speed > SPEED, "it drives again")
        page.mouse.up()
        anew.stands()
    # The browser reports what it could not have meanwhile.
    for each in (visited, second):
        each.wrong = [
            wrong
            for wrong in each.wrong
            if not wrong.endswith("/readyz")
            and "Failed to load" not in wrong
            and "WebSocket connection" not in wrong
        ]
    assert back_after < BACK_WITHIN


def test_a_program_that_could_not_be_loaded_is_loaded_by_the_next_login(
    visit: Callable[..., Visit],
) -> None:
    visited = visit(**DESKTOP)
    page = visited.page
    page.route("**/worker.js", lambda route: route.abort())
    page.fill("input[name=user]", "alice")
    page.fill("input[name=password]", "any")
    page.click("form button")
    page.wait_for_selector("form .notice:has-text('could not be loaded')")
    page.unroute("**/worker.js")
    visited.sign_in()
    visited.wrong.clear()  # which were meant
