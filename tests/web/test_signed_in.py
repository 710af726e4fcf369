"""Journey 9: a page that is loaded again, an appliance that starts again, and who signs out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess, free_ports
from test_journeys import SPEED, Odometry, drive
from test_journeys import odometry as odometry
from visits import DESKTOP, PHONE, Visit
from waiting import eventually

from appliance.access import Passwords

pytest.importorskip("rclpy")
sync_api = pytest.importorskip("playwright.sync_api")

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
    try:
        visited.page.reload()
    except sync_api.Error as error:
        # The browser's own page about an error loads again by itself, now and then just now.
        if "ERR_ABORTED" not in str(error):
            raise
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
    drive(page, lambda: odometry.speed > SPEED)  # by a login with the token
    page.mouse.up()
    odometry.stands()
    drive(page, lambda: odometry.speed > SPEED)  # the login after a release
    page.mouse.up()
    odometry.stands()
    for secret in (kept["token"], appliance.passwords["alice"]):
        assert secret not in appliance.log


def test_who_signs_out_is_out(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    visited = visit(**PHONE)
    page = visited.sign_in()
    kept = stored(page)
    reload(visited, "nav")
    # With a connection for calls: it has three seconds to say that it leaves.
    page.click("nav a:has-text('Clients')")
    page.wait_for_selector("td.main")
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


@contextmanager
def odometry_of(appliance: ApplianceProcess) -> Iterator[Odometry]:
    """What this run of the appliance tells."""
    odometry = Odometry(appliance)
    with odometry.peer as peer:
        peer.subscribe(f"{ROBOT}/odom")
        yield odometry


def lost(visited: Visit) -> None:
    """Wait until the page says so."""
    visited.page.wait_for_selector("text=The connection is lost; trying again.")


def is_back(visited: Visit) -> None:
    """Wait until the page is at its robot again."""
    visited.page.wait_for_selector("text=The connection is lost; trying again.", state="detached")


def forget_the_gap(*visits: Visit) -> None:
    """The browser reports what it could not have meanwhile."""
    gap = ("/readyz", "Failed to load", "WebSocket connection", "ERR_CONNECTION_REFUSED")
    for each in visits:
        each.wrong = [wrong for wrong in each.wrong if not any(part in wrong for part in gap)]


@pytest.mark.timed
@pytest.mark.parametrize("end", [ApplianceProcess.stop, ApplianceProcess.kill])
def test_the_appliance_starts_again(
    visit: Callable[..., Visit],
    appliance: ApplianceProcess,
    end: Callable[[ApplianceProcess], None],
) -> None:
    """The page is back by itself, and what was commanded before is over.

    So is one that was loaded again before, which has only the token, and one that is loaded while
    nobody answers. The token is the one of before.
    """
    visited, reloaded, gone = visit(**PHONE), visit(**PHONE), visit(**PHONE)
    page = visited.sign_in(page="Drive")
    kept = {each: stored(each.sign_in()) for each in (reloaded, gone)}
    kept[visited] = stored(page)
    reload(reloaded, "nav")
    with odometry_of(appliance) as odometry:
        drive(page, lambda: odometry.speed > SPEED)
        end(appliance)
    lost(visited)
    lost(reloaded)
    with pytest.raises(sync_api.Error, match="ERR_CONNECTION_REFUSED"):
        gone.page.reload()
    appliance.start()
    begun = time.monotonic()
    is_back(visited)
    is_back(reloaded)
    back_after = time.monotonic() - begun
    reload(gone, "nav")
    with odometry_of(appliance) as anew:
        anew.stands()
        page.wait_for_selector("dd:text-is('ready')")
        anew.stands()  # although the button is still held
        page.mouse.up()
        drive(page, lambda: anew.speed > SPEED)
        page.mouse.up()
        anew.stands()
    for each, token in kept.items():
        assert stored(each.page) == token
        each.page.wait_for_selector("nav")
    forget_the_gap(*kept)
    assert back_after < BACK_WITHIN


def test_a_password_that_changed_while_the_appliance_was_down(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """The page that has only the token is out; one that has the password asks for the new one."""
    visited, reloaded = visit(**PHONE), visit(**PHONE)
    for each in (visited, reloaded):
        stored(each.sign_in())
    reload(reloaded, "nav")
    path = appliance.directory / "users.passwd"
    before = path.read_text()
    appliance.kill()
    users = Passwords.load(path)
    users.set("alice", "another-password-1")
    users.save()
    appliance.start()
    for each in (visited, reloaded):
        each.page.wait_for_selector("input[name=password]")
        assert each.page.evaluate(STORED) is None
    appliance.kill()
    path.write_text(before)
    appliance.start()
    forget_the_gap(visited, reloaded)


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
