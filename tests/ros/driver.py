"""A client that drives: `python driver.py PORT CA USER PASSWORD VERSION QOS`.

It publishes 25 numbered commands a second and connects again when its connection ends. Each time
that it is connected it writes the number of its next command to stdout.
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


def connected(*_):
    print(number + 1, flush=True)


client.on_connect = connected
client.username_pw_set(user, password)
client.tls_set(ca)
client.reconnect_delay_set(1, 1)
client.connect("localhost", int(port), keepalive=60)
client.loop_start()
while True:
    if client.is_connected():
        number += 1
        client.publish("r2d2/cmd_vel", json.dumps({"linear": {"x": number}}), int(qos))
    time.sleep(1 / RATE)
