"""1 MB images, 50 a second, both ways between the bridge and a node; the exit code tells.

A program, because Fast DDS reads a profile once in a process, before its first participant: in that
of the tests another one may have been there before.
"""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

from ros2_harness import BYTES, Harness, Peer, route
from waiting import until

from appliance.ros.ros2 import fastdds

IMAGES = 50


def segments() -> list[int]:
    """The sizes of the shared memory segments that Fast DDS has opened in this process."""
    sizes: dict[str, int] = {}
    for line in Path("/proc/self/maps").read_text().splitlines():
        addresses, *_, name = line.split()
        if name.startswith("/dev/shm/fast"):
            start, end = (int(address, 16) for address in addresses.split("-"))
            sizes[name] = sizes.get(name, 0) + end - start
    return list(sizes.values())


async def main() -> None:
    harness = Harness()
    harness.start(
        route("/image", "mqtt", "cdr", keep=100), route("/back", "ros", "cdr", type=BYTES)
    )
    try:
        await until(lambda: harness.bridged(), "the node")
        assert max(segments(), default=0) > 4 << 20, segments()
        profile = {name: os.environ[name] for name in os.environ if "DEFAULT_PROFILES" in name}
        assert list(profile.values()) == [str(fastdds.file_of("default"))]
        peer = await Peer().start("camera", **profile)
        try:
            await both_ways(harness, peer)
        finally:
            await peer.stop()
    finally:
        await harness.bridge.stop()


async def both_ways(harness: Harness, peer: Peer) -> None:
    """None is lost."""
    await peer.do("advertise", "/image", BYTES)
    await peer.do("subscribe", "/back", BYTES)
    await until(lambda: len(harness.bridged()) == 2, "/image")
    await peer.do("matched", "/image")
    await peer.do("publish_image", "/image", 1_000_000, IMAGES, IMAGES)
    await until(lambda: len(harness.payloads("r2d2/image")) == IMAGES, "all images")
    image = harness.payloads("r2d2/image")[0]
    assert len(image) > 1_000_000
    for number in range(20):
        harness.send("r2d2/back", image)
        await until(lambda number=number: len(peer.received) > number - 5, "the images before")
        await asyncio.sleep(0.02)
    await until(lambda: len(peer.received) == 20, "all images on the way back")


if __name__ == "__main__":
    asyncio.run(main())
