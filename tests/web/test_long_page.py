"""A page that stays open while 200 topics change ten times a second: what that costs the browser.

It is short in CI. For the budget of ten minutes: `CONSOLE_MINUTES=10 pytest -s
tests/web/test_long_page.py`, with nothing beside it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable

from appliance_process import ApplianceProcess
from interop.paho_peer import V5, Peer
from visits import PHONE, Visit

#: Minutes in which it is measured; without them for some seconds, and no share of time is judged.
MINUTES = float(os.environ.get("CONSOLE_MINUTES", "0"))
SETTLING, SHORT = 5.0, 10.0  # seconds

TOPICS, RATE = 200, 10
ROUND = 1 / RATE

#: The budget: of the main thread's time, and bytes that the heap may grow.
SHARE = 0.3
GROWTH = 10_000_000


def test_a_page_of_200_topics(visit: Callable[..., Visit], appliance: ApplianceProcess) -> None:
    page = visit(**PHONE).sign_in(page="Topics")
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")
    session.send("HeapProfiler.enable")

    def measured() -> dict[str, float]:
        session.send("HeapProfiler.collectGarbage")
        found = session.send("Performance.getMetrics")["metrics"]
        return {each["name"]: each["value"] for each in found}

    with Peer(appliance, V5, user="stranger") as peer:
        number = 0

        def publish_for(seconds: float) -> None:
            nonlocal number
            end = time.monotonic() + seconds
            while (now := time.monotonic()) < end:
                number += 1
                for topic in range(TOPICS):
                    peer.client.publish(f"other/long/{topic}", b'{"value": %d}' % number)
                # Playwright reads what the browser says only while it waits itself.
                page.wait_for_timeout(max(0.0, now + ROUND - time.monotonic()) * 1000)

        publish_for(1)
        page.click("button.fold[aria-expanded=false]:has-text('other')")
        page.click("button.fold[aria-expanded=false]:has-text('long')")
        page.wait_for_selector("text='199'")
        publish_for(SETTLING)
        first, began = measured(), time.monotonic()
        publish_for(60 * MINUTES or SHORT)
        last, elapsed = measured(), time.monotonic() - began
    share = (last["TaskDuration"] - first["TaskDuration"]) / elapsed
    growth = last["JSHeapUsedSize"] - first["JSHeapUsedSize"]
    told = f"{elapsed:.0f} s: main thread {share:.1%}, heap {growth / 1e6:+.1f} MB"
    print(f"{told}, {last['Nodes']:.0f} nodes (of {first['Nodes']:.0f})")
    assert growth < GROWTH, told
    assert last["Nodes"] < 2 * first["Nodes"], told
    if MINUTES:
        assert share < SHARE, told
