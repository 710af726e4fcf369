"""What somebody sees who opens the console for the first time: it fits, and it is said in words."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess
from visits import DESKTOP, PHONE, Visit

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")


def assert_fits(page: Any) -> None:
    """Nothing is beyond the right edge of the screen."""
    width, screen = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert width <= screen


@pytest.mark.parametrize("screen", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_a_long_value_in_an_unfolded_tree(visit: Callable[..., Visit], screen: Any) -> None:
    visited = visit(**screen)
    page = visited.sign_in(page="Topics")
    fold, row = f"button.fold:has-text('{ROBOT}')", f"a.row[href$='{ROBOT}%2Fodom']"
    page.click(fold)  # a tree that nobody has touched is unfolded while it has few topics
    if page.query_selector(f"{fold}[aria-expanded=false]") is not None:
        page.click(fold)
    page.wait_for_selector(f"{row} .value:has-text('frame_id')")
    assert_fits(page)
    visited.look(f"{screen['viewport']['width']}-topics-unfolded")
    page.click(row)
    page.wait_for_selector(".leaves")
    time = page.inner_text("dt:text-is('received') + dd")
    assert re.fullmatch(r"\d+:\d\d:\d\d\.\d{3}(\s[AP]M)?", time)
    assert_fits(page)
    visited.look(f"{screen['viewport']['width']}-topics-inspected")
    focused = "document.activeElement.id || document.activeElement.className"
    # The phone shows either the tree or the topic, and what it shows has the focus.
    assert page.evaluate(focused) == ("inspected" if screen is PHONE else "row")
    page.click("a:text-is('Close')")
    page.wait_for_selector(f"{row}:focus" if screen is PHONE else ".list")
    assert_fits(page)


def test_what_has_a_ring(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """The page's content gets the focus after Enter, without a ring; what a key reaches has one."""
    page = visit(**DESKTOP).page
    page.fill("input[name=user]", "alice")
    page.fill("input[name=password]", appliance.passwords["alice"])
    page.press("input[name=password]", "Enter")
    page.wait_for_selector("main:focus")
    style = "getComputedStyle(document.activeElement).outlineStyle"
    assert page.evaluate(style) == "none"
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.localName") != "main"
    assert page.evaluate(style) == "solid"


def test_who_drives_with_what(visit: Callable[..., Visit]) -> None:
    """It is oneself, with a mouse, and nothing was refused: what each stream begins with is not."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Drive")
    page.wait_for_selector("dd:text-is('ready')")
    page.hover(".pad", position={"x": 200, "y": 20})
    page.mouse.down()
    page.wait_for_selector("strong bdi:text-is('you')")
    assert page.inner_text(".hint") == "Driving by mouse"
    assert page.inner_text("dt:text-is('Refused') + dd") == "0", page.inner_text("main")
    # axe holds the page up. On a busy computer that is long enough for the page to stop the robot,
    # and for a command to be late, which is refused rightly.
    visited.look("desktop-driving-by-mouse")
    page.mouse.up()
    refused = page.inner_text("dt:text-is('Refused') + dd")
    page.keyboard.down("ArrowUp")
    page.wait_for_selector(".hint:text-is('Driving by keys')")
    page.wait_for_selector("strong bdi:text-is('you')")
    page.keyboard.up("ArrowUp")
    assert page.inner_text("dt:text-is('Refused') + dd") == refused, page.inner_text("main")


def test_no_audit_log(visit: Callable[..., Visit]) -> None:
    """It is off unless it is wanted, which is no error; the page says how to turn it on."""
    visited = visit(**PHONE)
    page = visited.sign_in(page="Health")
    page.click("nav a:has-text('Audit')")
    page.wait_for_selector(".notice pre:has-text('audit: {path: audit.log}')")
    assert page.query_selector(".notice.bad") is None
    visited.look("phone-no-audit")


def test_figures_in_words(visit: Callable[..., Visit]) -> None:
    """Whole messages, a time in its units, and why a client that has just come is not there."""
    visited = visit(**PHONE)
    page = visited.sign_in()
    page.wait_for_selector("text='Up'")
    assert re.fullmatch(r"(\d+ min)? ?(\d+ s)?", page.inner_text("dt:text-is('Up') + dd"))
    assert page.inner_text("dt:text-is('Messages out, a minute') + dd").isdigit()
    page.wait_for_selector("text=/who has just come is not counted yet/")
    visited.look("phone-figures")
    page.click("nav a:has-text('Clients')")
    page.wait_for_selector("text=/up to five connections/")
    names = [name.rpartition("-")[0] for name in page.locator("td.main").all_inner_texts()]
    assert len(names) > 1 and len(set(names)) == 1
    visited.look("phone-clients-of-a-window")
