"""A client with paho's defaults that commands when it is told to, see old_commands.py.

    python commander.py HOST PORT VERSION QOS USER PASSWORD INDEX

A line of its input is a JSON list, see `Commander`; one of its output `connected` or `done`. Each
command has its number, when it was made (by the clock that all processes of a computer share) and
the index of its client in `linear`. commander.js is the same with MQTT.js.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time

import paho.mqtt.client as paho

TOPIC = "r2d2/cmd_vel"


class Commander:
    def __init__(self, host, port, version, qos, user, password, index):
        self.qos, self.index = int(qos), int(index)
        self.number = 0
        #: What to do right behind CONNECT.
        self.then = None
        self.client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=int(version))
        if user:
            self.client.username_pw_set(user, password)
        self.client.reconnect_delay_set(1, 1)
        self.client.on_connect = self._on_connect
        self.address = host, int(port)

    def _on_connect(self, *_):
        then, self.then = self.then, None
        if then is not None:
            threading.Thread(target=self.drive, args=then).start()
        os.write(1, b"connected\n")

    def connect(self, *then):
        """Connect, and again whenever that ends; then `drive`, if that is said."""
        self.then = then or None
        self.client.connect_async(*self.address)
        self.client.loop_start()

    def drive(self, count, rate):
        """So many commands, so many a second."""
        begun = time.monotonic()
        for number in range(count):
            time.sleep(max(0, begun + number / rate - time.monotonic()))
            self.number += 1
            where = {"x": self.number, "y": time.monotonic(), "z": self.index}
            self.client.publish(TOPIC, json.dumps({"linear": where}), self.qos)
        os.write(1, b"done\n")  # print would not do it in one go, and there are two threads

    def leave(self):
        """The end of the connection."""
        self.client.disconnect()


commander = Commander(*sys.argv[1:])
for line in sys.stdin:
    name, *arguments = json.loads(line)
    getattr(commander, name)(*arguments)
