"""An MQTT client of either version that drives the demo robot."""

from __future__ import annotations

import json
import socket
import threading
import uuid

import cbor2
import paho.mqtt.client as paho
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from waiting import PATIENCE

V5, V311 = paho.MQTTv5, paho.MQTTv311
TURTLE = "r2d2/turtle"


class Client:
    """An MQTT client that calls as its version of MQTT does."""

    def __init__(self, appliance, version, user="alice", name=None, *, keeps=False):
        self.version = version
        self.name = name or f"{user}-{uuid.uuid4().hex[:6]}"
        self.received = []
        self._changed = threading.Condition()
        self._waiting = {}
        how = {} if version == V5 else {"clean_session": not keeps}
        self.paho = paho.Client(
            paho.CallbackAPIVersion.VERSION2,
            self.name,
            protocol=version,
            reconnect_on_failure=False,
            **how,
        )
        self.paho.username_pw_set(user, appliance.passwords[user])
        self.paho.on_message = self._on_message
        self.paho.on_publish = lambda c, u, mid, code, p: self._put(("published", mid, code))
        self.paho.on_subscribe = lambda c, u, mid, codes, p: self._put(("subscribed", mid))
        self.paho.on_connect = lambda c, u, flags, code, p: self._put(("connected", code))
        properties = None
        if version == V5 and keeps:
            properties = Properties(PacketTypes.CONNECT)
            properties.SessionExpiryInterval = 60
        more = {"clean_start": not keeps, "properties": properties} if version == V5 else {}
        self.paho.connect("127.0.0.1", appliance.plain_port, **more)
        self.paho.loop_start()
        (code,) = self._take("connected")
        assert code == 0
        self._number = 0
        self.subscribe(f"answers/{self.name}")

    def _put(self, what):
        with self._changed:
            self.received.append(what)
            self._changed.notify_all()

    def _on_message(self, client, userdata, message):
        about = message.properties if self.version == V5 else None
        is_cbor = getattr(about, "ContentType", None) == "application/cbor"
        loads = cbor2.loads if is_cbor else json.loads
        payload = loads(message.payload) if message.payload else None
        self._put(("message", message.topic, payload, message.retain, about))

    def _wait(self, condition, what):
        with self._changed:
            if not self._changed.wait_for(condition, PATIENCE):
                raise AssertionError(f"{self.name}: not within {PATIENCE} s: {what}")

    def _take(self, kind, *beginning):
        found = []

        def is_there():
            wanted = (kind, *beginning)
            found[:] = [one for one in self.received if one[: len(wanted)] == wanted]
            return found

        self._wait(is_there, (kind, *beginning))
        with self._changed:
            self.received.remove(found[0])
        return found[0][1 + len(beginning) :]

    def subscribe(self, *topics):
        _, mid = self.paho.subscribe([(topic, 1) for topic in topics])
        self._take("subscribed", mid)

    def payloads(self, topic):
        with self._changed:
            return [one[2] for one in self.received if one[:2] == ("message", topic)]

    def next(self, topic):
        """The payload of the next message there."""
        return self._take("message", topic)[0]

    def until(self, topic, payload):
        """Wait for that payload, with others before it."""
        self._wait(lambda: payload in self.payloads(topic), f"{topic} {payload}")

    def publish(self, topic, payload=None, **named):
        """The reason code with which the broker acknowledges."""
        properties = None
        if named:
            properties = Properties(PacketTypes.PUBLISH)
            for name, value in named.items():
                setattr(properties, name, value)
        payload = payload if isinstance(payload, bytes) else json.dumps(payload)
        info = self.paho.publish(topic, payload, 1, properties=properties)
        return self._take("published", info.mid)[0]

    def send(self, topic, payload=b""):
        """Begin a call; returns what its answer is waited for with."""
        self._number += 1
        if self.version == V5:
            number = f"{self._number}".encode()
            named = {"ResponseTopic": f"answers/{self.name}", "CorrelationData": number}
            assert self.publish(topic, payload, **named) == 0
            return number
        reply = f"{topic.rpartition('/')[0]}/_reply/{self.name}/{self._number}"
        self.subscribe(reply)
        self.publish(f"{topic}/{self._number}", payload)
        return reply

    def answer(self, ticket):
        if self.version != V5:
            return self.next(ticket)
        found = []

        def is_there():
            found[:] = [
                one
                for one in self.received
                if one[:2] == ("message", f"answers/{self.name}")
                and one[4].CorrelationData == ticket
            ]
            return found

        self._wait(is_there, f"the answer to {ticket!r}")
        _, _, payload, _, about = found[0]
        assert about.ContentType == "application/json"
        status = dict(about.UserProperty)["status"]
        assert status == ("error" if "error" in payload else "ok")
        return payload

    def call(self, topic, payload=b""):
        return self.answer(self.send(topic, payload))

    def error(self, topic, payload=b""):
        """(code, message)"""
        error = self.call(topic, payload)["error"]
        return error["code"], error["message"]

    def drop(self):
        """The network takes the connection away."""
        self.paho.socket().shutdown(socket.SHUT_RDWR)
        self.paho.loop_stop()

    def leave(self):
        self.paho.disconnect()
        self.paho.loop_stop()
