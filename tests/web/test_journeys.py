"""The console in a real Chromium, against an appliance with the demo robot on the ROS bus."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from appliance_process import ROBOT, ApplianceProcess
from interop.paho_peer import V5, Peer
from visits import DESKTOP, PHONE, Visit, wait_for_change
from waiting import eventually

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")

RIGHTS = json.dumps({"questions": [{"action": "publish", "topic": f"{ROBOT}/cmd_vel"}]})
SPEED = 0.1  # m/s; above it the robot drives, by the console's 50 % of the clamp


class Odometry:
    """What the robot does, as a client of MQTT is told."""

    def __init__(self, appliance: ApplianceProcess) -> None:
        self.peer = Peer(appliance, V5)
        self.speed = 0.0
        self.x = 0.0
        self.count = 0
        self.peer.client.on_message = self._receive

    def _receive(self, client: Any, data: Any, message: Any) -> None:
        odometry = json.loads(message.payload)
        self.speed = odometry["twist"]["twist"]["linear"]["x"]
        self.x = odometry["pose"]["pose"]["position"]["x"]
        self.count += 1

    def stands(self) -> None:
        """Return when a message that is new says so."""
        before = self.count
        eventually(lambda: self.count > before + 1 and self.speed == 0, "the robot stands")


@pytest.fixture(scope="module")
def odometry(appliance: ApplianceProcess) -> Iterator[Odometry]:
    odometry = Odometry(appliance)
    with odometry.peer as peer:
        peer.subscribe(f"{ROBOT}/odom")
        eventually(lambda: odometry.count > 0, "the robot's odometry")
        yield odometry


def hold(page: Any, *, x: float = 0.5, y: float = 0.02) -> None:
    """Press the field, at a part of its width and height."""
    page.wait_for_selector(".pad[aria-disabled=false]")
    page.wait_for_selector("dd:text-is('ready')")
    box = page.locator(".pad").bounding_box()
    page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
    page.mouse.down()


#: Seconds without driving after which what was held is let go and held again.
LET_GO = 3.0


def until_it_drives(
    page: Any, drives: Callable[[], bool], press: Callable[[], None], release: Callable[[], None]
) -> None:
    """Wait until the robot drives, with what is held.

    A page that has stood still for two seconds, as on a busy computer, has let go: then it is held
    again, as a person would.
    """
    idle = page.locator(".hint:text-is('Hold to drive')")
    since = time.monotonic()

    def is_driving() -> bool:
        nonlocal since
        if not idle.count():
            since = time.monotonic()
        elif time.monotonic() - since > LET_GO:
            release()
            press()
            since = time.monotonic()
        return drives()

    eventually(is_driving, "the robot drives")


def drive(page: Any, drives: Callable[[], bool], *, y: float = 0.02) -> None:
    """Hold the field until the robot drives."""
    hold(page, y=y)
    until_it_drives(page, drives, lambda: hold(page, y=y), page.mouse.up)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_sign_in_and_look(visit: Callable[..., Visit], odometry: Odometry, scheme: str) -> None:
    """Journeys 1 and 11: what is loaded is small and ours, and the odometry is there."""
    for kind, options in (("phone", PHONE), ("desktop", DESKTOP)):
        visited = visit(color_scheme=scheme, **options)
        page = visited.page
        page.wait_for_selector(".fingerprint")
        assert len(visited.requests) <= 12, visited.requests
        visited.look(f"{kind}-{scheme}-1-sign-in")
        visited.sign_in()
        page.wait_for_selector(f"td >> text='{ROBOT}/odom'")
        visited.look(f"{kind}-{scheme}-2-overview")
        page.click("nav a:has-text('Topics')")
        wait_for_change(page, f"a[href$='{ROBOT}%2Fodom'] .value")
        visited.look(f"{kind}-{scheme}-3-topics")
        page.click("nav a:has-text('Drive')")
        page.wait_for_selector("dd:text-is('ready')")
        visited.look(f"{kind}-{scheme}-4-drive")
        assert {re.match(r"\w+://[^/]*", url)[0] for url in visited.requests} <= {  # type: ignore[index]
            page.evaluate("location.origin"),
            page.evaluate("location.origin.replace('https', 'wss')"),
            "blob:",
        }
        visited.close()


def test_a_wrong_password(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    page = visit(**PHONE).page
    page.fill("input[name=user]", "alice")
    page.fill("input[name=password]", "wrong")
    page.click("form button")
    page.wait_for_selector("text=User name or password is wrong.")
    assert page.input_value("input[name=password]") == ""


def test_a_phone_drives(visit: Callable[..., Visit], odometry: Odometry) -> None:
    """Journey 2: it drives while the field is held, no faster than the clamp, and then stops."""
    visited = visit(**PHONE)
    page = visited.sign_in(page="Drive")
    drive(page, lambda: odometry.speed > SPEED)
    assert odometry.speed <= 0.25 + 1e-6  # half of the clamp
    page.wait_for_selector(".notice.bad", state="detached")  # the first two may have been old
    page.mouse.up()
    odometry.stands()
    drive(page, lambda: odometry.speed < -SPEED, y=0.98)
    second = visit(**PHONE)
    other = second.sign_in(page="Drive")
    hold(other)
    # The first one drives on. Where a slow computer made it silent for longer than a driver may be,
    # the second one drives now, and it is the first that reads so.
    told = '.notice.bad:has-text("alice\') commands /cmd_vel")'
    eventually(
        lambda: other.query_selector(told) or page.query_selector(told), "who drives, on one page"
    )
    second.look("phone-6-not-driving")
    named = '.quiet:has-text("Commanding now: console-alice-")'
    eventually(
        lambda: other.query_selector(named) or page.query_selector(named), "whose it is, too"
    )
    other.mouse.up()
    back = (lambda: odometry.speed < -SPEED, partial(hold, page, y=0.98), page.mouse.up)
    until_it_drives(page, *back)
    visited.look("phone-5-driving")
    until_it_drives(page, *back)  # and drives on behind axe
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    odometry.stands()
    page.wait_for_selector(".hint:text-is('Hold to drive')")


def test_keys_drive_while_they_are_held(visit: Callable[..., Visit], odometry: Odometry) -> None:
    page = visit(**DESKTOP).sign_in(page="Drive")
    page.wait_for_selector("dd:text-is('ready')")
    page.focus(".pad")
    # A window that has just opened may still be told that it lost the focus, which stops the robot,
    # and a key that is held since before a stop drives no more: press it again, as a person would.
    with contextlib.suppress(AssertionError):
        page.keyboard.down("ArrowUp")
        eventually(lambda: odometry.speed > SPEED, "the robot drives", 5)
    page.keyboard.up("ArrowUp")
    odometry.stands()
    for key in ("ArrowUp", "KeyW"):
        page.wait_for_selector("dd:text-is('ready')")
        keys = partial(page.keyboard.down, key), partial(page.keyboard.up, key)
        page.keyboard.down(key)
        until_it_drives(page, lambda: odometry.speed > SPEED, *keys)
        if key == "ArrowUp":
            page.keyboard.up(key)
            odometry.stands()
    page.evaluate("location.hash = '#/overview'")
    odometry.stands()


def test_a_phone_that_is_turned_or_interrupted(
    visit: Callable[..., Visit], odometry: Odometry
) -> None:
    """The system takes the finger on the field away, or turns the page under it."""
    page = visit(**PHONE).sign_in(page="Drive")
    browser = page.context.new_cdp_session(page)
    page.wait_for_selector(".pad[aria-disabled=false]")

    def touch() -> None:
        page.wait_for_selector("dd:text-is('ready')")
        box = page.locator(".pad").bounding_box()
        at = {"x": box["x"] + 0.5 * box["width"], "y": box["y"] + 0.02 * box["height"]}

        def press() -> None:
            browser.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [at]})

        press()
        told = page.locator(".hint:text-is('Driving by touch')")  # the first may have been old
        until_it_drives(page, lambda: odometry.speed > SPEED and told.count() > 0, press, cancel)

    def cancel() -> None:
        browser.send("Input.dispatchTouchEvent", {"type": "touchCancel", "touchPoints": []})

    touch()
    cancel()
    odometry.stands()
    touch()
    size = page.viewport_size
    metrics = {"deviceScaleFactor": 0, "mobile": True}
    turned = {"type": "landscapePrimary", "angle": 90}
    browser.send(
        "Emulation.setDeviceMetricsOverride",
        {"width": size["height"], "height": size["width"], "screenOrientation": turned, **metrics},
    )
    odometry.stands()
    page.wait_for_selector(".hint:text-is('Hold to drive')")


#: A gamepad, as the browser would tell of it; there is none in CI.
GAMEPAD = """() => {
  const buttons = Array.from({length: 16}, () => ({pressed: false}))
  globalThis.pad = {connected: true, axes: [0, 0], buttons}
  navigator.getGamepads = () => [null, pad]
}"""


def test_a_gamepad_drives_while_its_button_is_held(
    visit: Callable[..., Visit], odometry: Odometry
) -> None:
    page = visit(**DESKTOP).sign_in(page="Drive")
    page.wait_for_selector("dd:text-is('ready')")
    page.evaluate(GAMEPAD)
    page.evaluate("pad.axes = [0, -1]")
    before = odometry.count
    eventually(lambda: odometry.count > before + 5, "odometry")
    assert odometry.speed == 0  # the stick alone moves nothing
    told = page.locator(".hint:text-is('Driving by gamepad')")

    def until_it_does(number: int) -> None:
        def hold(is_held: bool) -> None:
            pressed = f"pad.buttons[{number}].pressed = {json.dumps(is_held)}"
            page.evaluate(f"{pressed}; new Promise(requestAnimationFrame)")

        hold(True)
        drives = lambda: odometry.speed > SPEED and told.count() > 0  # noqa: E731
        until_it_drives(page, drives, partial(hold, True), partial(hold, False))

    until_it_does(5)
    page.evaluate("pad.buttons[5].pressed = false")
    odometry.stands()
    page.wait_for_selector("dd:text-is('ready')")
    until_it_does(4)
    page.evaluate("pad.connected = false")  # its battery is empty, or its cable is out
    odometry.stands()
    page.evaluate("pad.connected = true")
    before = odometry.count
    eventually(lambda: odometry.count > before + 5, "odometry")
    assert odometry.speed == 0  # the button was held all the time
    until_it_does(4)
    page.evaluate("window.dispatchEvent(new Event('blur'))")
    odometry.stands()
    before = odometry.count
    eventually(lambda: odometry.count > before + 5, "odometry")
    assert odometry.speed == 0  # the button is held since before


def test_a_browser_that_hangs(
    visit: Callable[..., Visit], browser: Any, odometry: Odometry, appliance: ApplianceProcess
) -> None:
    """Journey 2: whatever happens to the browser, silence stops the robot."""
    page = visit(**PHONE).sign_in(page="Drive")
    drive(page, lambda: odometry.speed > SPEED)
    processes = [
        each
        for each in psutil.Process().children(recursive=True)
        if each.name().startswith("chrom")
    ]
    assert processes
    for process in processes:
        process.send_signal(signal.SIGSTOP)
    frozen = time.monotonic()
    try:
        odometry.stands()
        eventually(lambda: time.monotonic() > frozen + 2.5, "what no short interruption takes")
    finally:
        for process in processes:
            process.send_signal(signal.SIGCONT)
    page.wait_for_selector(".hint:text-is('Hold to drive')")  # the button is still held
    before = odometry.count
    eventually(lambda: odometry.count > before + 5, "odometry")
    assert odometry.speed == 0
    page.mouse.up()


def test_a_route_that_would_not_stop(visit: Callable[..., Visit], odometry: Odometry) -> None:
    """No driving without `on_silence`; the page says why."""
    page = visit(**PHONE).sign_in(page="Drive")
    page.select_option("select", f"{ROBOT}/other/cmd_vel")
    page.wait_for_selector(".pad[aria-disabled=true]")
    assert "on_silence" in page.inner_text(".notice.bad")


def test_a_viewer_does_not_drive(visit: Callable[..., Visit], odometry: Odometry) -> None:
    """What the access rules refuse is refused by the broker, and the page says so."""
    page = visit(**PHONE).sign_in("viewer", "Drive")
    hold(page)
    page.wait_for_selector(".notice.bad >> text=/not/i")
    page.mouse.up()
    odometry.stands()


def test_inspect(
    visit: Callable[..., Visit], odometry: Odometry, appliance: ApplianceProcess, tmp_path: Path
) -> None:
    """Journey 4: properties, difference, plot, history and export."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Topics")
    topic = f"{ROBOT}/test/value"
    table = {"ContentType": "application/json", "UserProperty": ("ros-type", "a/b")}
    with Peer(appliance, V5) as peer:
        peer.publish(topic, '{"big": 9007199254740993, "n": 1}', retain=True, **table)
        page.click(f"a[href$='{topic.replace('/', '%2F')}']")
        page.wait_for_selector(".leaves bdi:text-is('9007199254740993')")
        assert "a/b" in page.inner_text(".properties")
        page.click("[aria-label='Plot n']")
        for number in range(2, 6):
            peer.publish(topic, json.dumps({"big": 9007199254740993, "n": number}), **table)
            page.wait_for_selector(f"tr.changed bdi:text-is('{number}')")
            assert page.inner_text("tr.changed td:nth-child(3)") == str(number - 1)
        page.wait_for_selector("figcaption:has-text('n: 5 (5 points)')")
        page.wait_for_selector(".plot canvas")
        page.click("summary")
        page.click(".inspector li:last-child button")
        page.wait_for_selector(".leaves bdi:text-is('1')")
        visited.look("desktop-7-inspector")
        with page.expect_download() as download:
            page.click("text=/^Export/")
    path = tmp_path / "history.jsonl"
    download.value.save_as(path)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [json.loads(line["payload"])["n"] for line in lines] == [1, 2, 3, 4, 5]
    assert lines[0]["topic"] == topic and ["ros-type", "a/b"] in lines[0]["properties"]


HOSTILE = {
    "markup": ("text/html", b"<img src=x onerror=alert(1)><script>alert(2)</script>"),
    "<img src=x onerror=alert(3)>": ("text/plain", b"in the name"),
    "proto": ("application/json", b'{"__proto__": {"hacked": 1}, "constructor": {"a": 1}}'),
    "vnode": ("application/json", b'{"type": "script", "props": {"children": "alert(4)"}}'),
    "deep": ("application/json", b"[" * 15000 + b"]" * 15000),
    "utf-8": ("application/json", b'"\xff\xfe"'),
    "svg": ("image/svg+xml", b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(5)'/>"),
    "jpeg": ("image/jpeg", b"\xff\xd8\xff\x00 no picture"),
    "cbor": ("application/cbor", bytes([0x81]) * 15000),
    "x" * 5000: ("text/plain", b"a long name"),
    "\u202e control": ("text/plain", b"turned round"),
}


def test_hostile_payloads(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    """Journey 10: no script runs, nothing is asked for, and the page goes on."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Topics")
    with Peer(appliance, V5) as peer:
        # Not ours: what the appliance would say about itself, from somebody else.
        for name, (content_type, payload) in HOSTILE.items():
            topic = f"{ROBOT}/hostile/{name}"
            peer.publish(topic, payload, retain=True, ContentType=content_type)
        peer.publish(f"{ROBOT}/hostile/large", bytes(9 << 20), retain=True)
        page.fill("input[type=search]", "hostile")
        page.wait_for_selector(f"text='{len(HOSTILE)} topics'")  # the large one does not come
        for name in [*HOSTILE, "large"]:
            topic = f"{ROBOT}/hostile/{name}"
            page.evaluate("topic => location.hash = '#/topics/' + encodeURIComponent(topic)", topic)
            page.wait_for_selector(".inspector .properties")
        assert page.evaluate("({}).hacked === undefined")
        for name in [*HOSTILE, "large"]:
            peer.publish(f"{ROBOT}/hostile/{name}", b"", retain=True)
    assert all("hostile" not in url.partition("#")[0] for url in visited.requests)
    page.click("nav a:has-text('Overview')")
    page.wait_for_selector("h1:text-is('Overview')")


def test_calls_of_the_page_over_a_connection_of_their_own(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """An answer, an error of the appliance, a call without the right, and one after the end."""
    visited = visit(**DESKTOP)
    page = visited.sign_in()
    link = page.evaluate(
        "performance.getEntriesByType('resource').map(({ name }) => name)"
        ".find((name) => name.endsWith('/link.js'))"
    )

    def call(topic: str, values: str = "{}") -> str:
        return str(
            page.evaluate(
                "([link, topic, values]) => import(link)"
                ".then(({ request }) => request(topic, values))"
                ".catch((error) => error.message)",
                [link, topic, values],
            )
        )

    verb = "$CONTROL/appliance/v1/{}/_call"
    assert '"allowed":true' in call(verb.format("rights"), RIGHTS).replace(" ", "")
    assert call(verb.format("rights"), '{"question": 1}').startswith("bad_request: ")
    assert call("elsewhere/_call") == (
        "This user may not read its answers: pattern read elsewhere/_reply/%c/#"
    )
    visited.sign_out()
    assert call(verb.format("rights")) == "Nobody is signed in."
