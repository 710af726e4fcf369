"""A client that drives: `python driver.py PORT CA USER PASSWORD VERSION QOS`.

It publishes 25 numbered commands a second, also while it has no connection, and connects again when
that ends. In a command is when it was made, by the clock that all processes of a computer share.
"""

from __future__ import annotations

import json
import sys
import time

import paho.mqtt.client as paho

RATE = 25

port, ca, user, password, version, qos = sys.argv[1:]
client = paho.Client(
    paho.CallbackAPIVersion.VERSION2,
    f"driver-{version}-{qos}",
    clean_session=None if version == "5" else False,
    protocol=paho.MQTTv5 if version == "5" else paho.MQTTv311,
)
number = 0


client.username_pw_set(user, password)
client.tls_set(ca)
client.reconnect_delay_set(1, 1)
client.connect("localhost", int(port), keepalive=60)
client.loop_start()
while True:
    number += 1
    command = {"linear": {"x": number, "y": time.monotonic()}}
    client.publish("r2d2/cmd_vel", json.dumps(command), int(qos))
    time.sleep(1 / RATE)
