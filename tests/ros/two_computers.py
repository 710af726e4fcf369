"""A robot and another computer on its network, for real: two network namespaces and a cable.

`unshare -n python two_computers.py`, as root; on stdout, as JSON, what the bridge's node hears on
/cmd_vel and which nodes it says are elsewhere, for each of `bridge.discovery`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

#: Seconds that something may take to be heard; and that nothing must be for it to count as none.
PATIENCE = 30.0
SILENCE = 4.0

STRING = "std_msgs/msg/String"


def ip(*arguments, inside=None):
    before = [] if inside is None else ["nsenter", "-t", str(inside), "-n"]
    subprocess.run([*before, "ip", *arguments], check=True)


def talker(name, inside=None):
    """Another node, which says its name on /cmd_vel until its stdin ends."""
    before = [] if inside is None else ["nsenter", "-t", str(inside), "-n"]
    program = [sys.executable, str(Path(__file__).with_name("peer.py")), name]
    process = subprocess.Popen([*before, *program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    data = name.encode() + b"\0"
    cdr = b"\0\1\0\0" + len(data).to_bytes(4, "little") + data
    for command in (["advertise", "/cmd_vel", STRING], ["publish", "/cmd_vel", cdr.hex(), 9000]):
        process.stdin.write(json.dumps(command).encode() + b"\n")
    process.stdin.flush()
    return process


def listen(discovery):
    from appliance.ros.node import QosProfile
    from appliance.ros.ros2 import discovery as discoveries
    from appliance.ros.ros2.node import Ros2Node

    discoveries.use(discovery, os.environ)
    node = Ros2Node("bridge")
    heard, elsewhere, failed = set(), set(), threading.Event()
    subscription = []
    sockets = Path("/proc/self/net/udp")
    began = sockets.read_text()

    def look():
        if not subscription:
            take = lambda cdr: heard.add(cdr[8:-1].split(b"\0")[0].decode())  # noqa: E731
            subscription.append(node.subscribe_raw("/cmd_vel", STRING, QosProfile(), take))
        elsewhere.update(node.elsewhere())

    node.start(look, lambda reason: failed.set())
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until and not failed.is_set() and "near" not in heard:
        time.sleep(0.05)
    time.sleep(SILENCE)
    known = {line.split()[-4] for line in began.splitlines()}
    own = [line.split() for line in sockets.read_text().splitlines()[1:]]
    is_open = any(each[1].startswith("00000000:") and each[-4] not in known for each in own)
    node.stop()
    print(json.dumps({"heard": sorted(heard), "elsewhere": sorted(elsewhere), "open": is_open}))


def main():
    ip("link", "set", "lo", "up")
    with subprocess.Popen(["unshare", "-n", "sleep", "600"]) as other:
        talkers = []
        try:
            own = Path("/proc/self/ns/net").readlink()
            while Path(f"/proc/{other.pid}/ns/net").readlink() == own:
                time.sleep(0.05)
            ip("link", "add", "here", "type", "veth", "peer", "name", "there")
            ip("link", "set", "there", "netns", str(other.pid))
            for device, address, inside in (
                ("here", "10.9.0.1/24", None),
                ("there", "10.9.0.2/24", other.pid),
            ):
                ip("link", "set", "lo", "up", inside=inside)
                ip("addr", "add", address, "dev", device, inside=inside)
                ip("link", "set", device, "up", inside=inside)
            talkers = [talker("near"), talker("far", other.pid)]
            for discovery in ("subnet", "localhost"):
                subprocess.run([sys.executable, __file__, discovery], check=True)
        finally:
            for process in talkers:
                process.kill()
                process.wait()
            other.kill()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        listen(sys.argv[1])
    else:
        main()
