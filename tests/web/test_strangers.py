"""What somebody publishes in the name of another robot misleads nobody in the console."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from appliance_process import ROBOT, ApplianceProcess
from interop.paho_peer import V5, Peer
from visits import DESKTOP, Visit
from waiting import eventually

pytest.importorskip("rclpy")
pytest.importorskip("playwright.sync_api")

#: As the appliance describes routes; of the second one it says itself that it has no on_silence.
FORGED: list[dict[str, Any]] = [
    {
        "ros": "/cmd_vel",
        "mqtt": topic,
        "direction": "to_ros",
        "type": "geometry_msgs/msg/Twist",
        "encoding": "json",
        "rules": {"on_silence": 0.5, "clamp": {"linear.x": [-9, 9], "angular.z": [-9, 9]}},
    }
    for topic in ("other/cmd_vel", f"{ROBOT}/other/cmd_vel")
]


@pytest.fixture
def stranger(appliance: ApplianceProcess) -> Iterator[Peer]:
    """It publishes the forged routes, which are there until the end."""
    with Peer(appliance, V5, user="stranger") as peer:
        peer.publish("other/_appliance/routes", json.dumps(FORGED), retain=True)
        yield peer
        peer.publish("other/_appliance/routes", b"", retain=True)


def test_only_this_robot_is_driven(visit: Callable[..., Visit], stranger: Peer) -> None:
    page = visit(**DESKTOP).sign_in(page="Topics")
    page.fill("input[type=search]", "other/_app")
    page.wait_for_selector("text='other/_appliance/routes'")  # it has come, and can be read
    page.click("nav a:has-text('Drive')")
    page.wait_for_selector("option >> nth=1", state="attached")
    topics = page.locator("option").all_inner_texts()
    assert topics == [f"{ROBOT}/cmd_vel", f"{ROBOT}/other/cmd_vel"]
    page.select_option("select", topics[1])
    page.wait_for_selector(".pad[aria-disabled=true]")  # that it has on_silence, a stranger says
    page.click("nav a:has-text('Overview')")
    page.wait_for_selector("h2:has-text('other')")  # as what it is, another robot's
    assert page.inner_text("header .robot") == ROBOT


def test_nothing_of_a_user_is_left_for_the_next(visit: Callable[..., Visit]) -> None:
    """Neither what was shown, nor what waited while it was paused."""
    visited = visit(**DESKTOP)
    page = visited.sign_in(page="Topics")
    page.fill("input[type=search]", "odom")
    page.click(".list button:has-text('Pause')")
    page.wait_for_selector(".list button:has-text('Continue')")
    page.evaluate("globalThis.ofAlice = true")
    visited.sign_out()
    page.go_back()
    page.wait_for_selector("input[name=user]")
    assert page.evaluate("globalThis.ofAlice") is None
    visited.sign_in("viewer", page="Topics")
    page.wait_for_selector(".list button:has-text('Pause')")
    assert page.input_value("input[type=search]") == ""


def test_a_filter_is_not_a_topic(visit: Callable[..., Visit]) -> None:
    """A link must not make a page subscribe to everything at the rate of one topic."""
    page = visit(**DESKTOP).sign_in()
    for place in ("topics/%23", "topics/a%2F%2B", "camera/%23", "publish/%23", "topics/%00"):
        page.evaluate(f"location.hash = '#/{place}'")
        page.wait_for_selector("main > .notice:has-text('not the name of a topic')")
        page.click("main >> text='Choose one'")
        page.wait_for_selector("main h1")
    page.click("nav a:has-text('Publish')")
    page.fill("input[name=topic]", "a/#")
    page.click("button:has-text('Open')")
    assert page.evaluate("document.querySelector('input[name=topic]').validity.patternMismatch")
    assert page.evaluate("location.hash") == "#/publish"


def test_what_is_being_typed_stays(visit: Callable[..., Visit], stranger: Peer) -> None:
    """The page is drawn anew when a robot says something of its routes."""
    page = visit(**DESKTOP).sign_in(page="Publish")
    page.fill("input[name=topic]", "half/of/a/na")
    told = [*FORGED[:1], {**FORGED[0], "mqtt": "other/new"}]
    stranger.publish("other/_appliance/routes", json.dumps(told), retain=True)
    page.wait_for_selector("option[value='other/new']", state="attached")
    assert page.input_value("input[name=topic]") == "half/of/a/na"


#: Keep the longest time between two frames, in ms.
MEASURE_FRAMES = """() => {
  let last = performance.now()
  globalThis.longest = 0
  const frame = (now) => {
    longest = Math.max(longest, now - last)
    last = now
    requestAnimationFrame(frame)
  }
  requestAnimationFrame(frame)
}"""


def test_a_hundred_thousand_topics(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """The page keeps 20,000 of them, says so, and works on; the appliance as well."""
    count = 100_000
    page = visit(**DESKTOP).sign_in(page="Topics")
    page.evaluate(MEASURE_FRAMES)
    with Peer(appliance, V5, user="stranger") as peer:
        for number in range(count):
            sent = peer.client.publish(f"other/{number}/many", b"1", qos=1)
            if (number + 1) % 1000 == 0:  # paho keeps 65,535
                eventually(sent.is_published, f"{number} to be taken")
        page.wait_for_selector("[role=status]:has-text('more than can be kept')")
        page.click("button.fold[aria-expanded=false]:has-text('other')")
        peer.publish("other/0/many", b"2", qos=1)
        page.fill("input[type=search]", "other/0/many")
        page.wait_for_selector("[role=status]:has-text('1 topic')")
    page.click("text='other/0/many'")
    page.wait_for_selector("#inspected:has-text('other/0/many')")
    assert page.evaluate("longest") < 5000  # 100 on one core
    page.click("nav a:has-text('Overview')")
    page.wait_for_selector("h1:has-text('Overview')")


#: Count what the page is told of these topics.
COUNT_TOLD = """() => {
  globalThis.told = new Set()
  globalThis.Worker = class extends Worker {
    constructor(...values) {
      super(...values)
      this.addEventListener('message', ({ data }) => {
        for (const [topic] of data.answer?.rows ?? []) {
          if (topic.startsWith('other/once/')) told.add(topic)
        }
      })
    }
  }
}"""


def test_what_comes_while_a_page_is_paused_is_there_afterwards(
    visit: Callable[..., Visit], appliance: ApplianceProcess
) -> None:
    """All of it, though each topic came once; and no other page is paused."""
    count = 6000
    visited = visit(**DESKTOP)
    visited.page.evaluate(COUNT_TOLD)
    page = visited.sign_in(page="Topics")
    page.click(".list button:has-text('Pause')")
    page.wait_for_selector(".list button:has-text('Continue')")
    with Peer(appliance, V5, user="stranger") as peer:
        for number in range(count):
            peer.client.publish(f"other/once/{number}", b"1", retain=True)
        eventually(lambda: page.evaluate("told.size") == count, "all to have come")
        page.fill("input[type=search]", "other/once/")
        page.wait_for_selector("[role=status]:text-is('0 topics')")
        page.click("nav a:has-text('Health')")
        page.wait_for_selector("h1:has-text('Health')")
        page.click("nav a:has-text('Topics')")
        page.wait_for_selector(".list button:has-text('Pause')")
        page.wait_for_selector(f"[role=status]:text-is('{count} topics')")
        for number in range(count):
            peer.client.publish(f"other/once/{number}", b"", retain=True)
        peer.publish("other/last", b"", qos=1)
