"""A visit to the console in a browser, which journeys make."""

from __future__ import annotations

import os
from typing import Any

from npm_packages import DIRECTORY
from waiting import PATIENCE, eventually

PHONE = {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True}
DESKTOP = {"viewport": {"width": 1280, "height": 800}}
#: Where pictures of the pages go, when somebody wants to look at them.
PICTURES = os.environ.get("CONSOLE_PICTURES")


class Visit:
    """A browser's window at the console, and all that went wrong in it."""

    def __init__(self, browser: Any, origin: str, passwords: dict[str, str], options: Any) -> None:
        self._context = browser.new_context(**options)
        self._context.set_default_timeout(PATIENCE * 1000)
        self._passwords = passwords
        self.page = self._context.new_page()
        self.wrong: list[str] = []
        self.requests: list[str] = []
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("requestfailed", self._failed)
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.wrong.append(dialog.message), dialog.dismiss()))
        self.page.on("console", self._said)
        self.page.goto(origin)

    def _failed(self, request: Any) -> None:
        if request.failure != "net::ERR_ABORTED":  # what a page that is left still asked for
            self.wrong.append(f"failed: {request.url} ({request.failure})")

    def _said(self, message: Any) -> None:
        if message.type == "error":
            self.wrong.append(message.text)

    def sign_in(self, user: str = "alice", page: str = "") -> Any:
        self.page.fill("input[name=user]", user)
        self.page.fill("input[name=password]", self._passwords[user])
        self.page.click("form button")
        self.page.wait_for_selector("nav")
        if page:
            self.page.click(f"nav a:has-text('{page}')")
        return self.page

    def sign_out(self) -> None:
        """Return when the page is there anew."""
        self.page.click("text='Sign out'")
        self.page.wait_for_selector("input[name=user]")

    def look(self, name: str) -> None:
        """Have axe look at the page, and keep a picture where that is wanted."""
        if PICTURES:
            self.page.screenshot(path=f"{PICTURES}/{name}.png", full_page=True)
        axe = (DIRECTORY / "node_modules/axe-core/axe.min.js").read_text()
        self.page.evaluate(axe)
        found = self.page.evaluate(
            "axe.run({runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'wcag22aa']})"
        )
        told = [
            (each["id"], [node["html"] for node in each["nodes"]]) for each in found["violations"]
        ]
        assert told == [], name

    def close(self) -> None:
        """Leave. What the page showed last is told by pytest, where the test failed."""
        if not self.page.is_closed():
            print(self.page.url, self.page.inner_text("body"), sep="\n")
        self._context.close()


def wait_for_change(page: Any, place: str) -> None:
    """Return when there is another text at a place of the page."""
    first = page.inner_text(place)
    eventually(lambda: page.inner_text(place) != first, "another value")
