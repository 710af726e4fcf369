"""A broker and a bridge with calls, and MQTT clients of both versions that record messages."""

from __future__ import annotations

import asyncio
import json
import time

from waiting import until

from appliance.broker.broker import Broker
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.values import Action, Decision, Identity
from appliance.mqtt.codec import Property
from appliance.mqtt.packets import Subscription
from appliance.ros.bridge import Bridge
from appliance.ros.calls.routes import (
    ActionSettings,
    CallRoutes,
    ParameterSettings,
    ServiceSettings,
)
from appliance.ros.node import BusError
from appliance.ros.payload.definitions import import_message
from appliance.store import MemoryStore


class AllTypes:
    """Every installed type, for FakeNode."""

    def __contains__(self, name):
        try:
            import_message(name)
        except LookupError:
            return False
        return True

    def __getitem__(self, name):
        return import_message(name)


class Rules:
    """Allows everything except `denied`: (user, action, beginning of a topic)."""

    def __init__(self):
        self.epoch = 0
        self.denied = set()

    def decide(self, identity, action, topic):
        for user, what, start in self.denied:
            if user == identity.username and what == action.value and topic.startswith(start):
                return Decision(False, f"{user} may not {what} {start}")
        return Decision(True, "the rest is allowed")

    def deny(self, user, action, start):
        self.denied.add((user, Action(action).value, start))
        self.epoch += 1


class RecordingClient(InsideLink):
    """An MQTT client; `calls` are answered as MQTT 5 does, `calls_311` by tokens."""

    def __init__(self, broker, name, *subscriptions, user=None):
        self.broker = broker
        self.name = name
        self.received = []
        self.session, _ = broker.connect(
            self, Identity(user or name, name), clean_start=True, expiry=0, will=None
        )
        for topic in (f"answers/{name}", *subscriptions):
            self.subscribe(topic)
        self._number = 0

    def subscribe(self, topic):
        subscription = Subscription(topic, 1)
        self.broker.subscribe(self.session, subscription)
        self.broker.send_retained(self.session, subscription, True)

    def publish(self, message, qos, packet_id, dup, retain, subscription_ids):
        self.received.append(message)
        if qos:  # in a later round of the loop, as through a network
            asyncio.get_running_loop().call_soon(self.session.puback, packet_id)

    def close(self, reason, message):
        raise AssertionError

    def send(self, topic, payload=b"", retain=False, **properties):
        if not isinstance(payload, bytes):
            payload = json.dumps(payload).encode()
        named = {Property[name.upper()]: value for name, value in properties.items()}
        message = Message(topic, payload, 1, retain, named or None)
        return self.broker.publish(message, self.session)

    def leave(self):
        self.broker.disconnect(self.session, self, publish_will=True)

    def on(self, topic):
        return [message for message in self.received if message.topic == topic]

    def payloads(self, topic):
        return [json.loads(m.payload) if m.payload else None for m in self.on(topic)]

    async def call(self, topic, payload=b"", response_topic=None):
        """(status, JSON of the answer), by MQTT 5."""
        await asyncio.sleep(0)  # as through a network: what was set up before is there
        self._number += 1
        correlation = f"{self.name} {self._number}".encode()
        response_topic = response_topic or f"answers/{self.name}"
        self.send(topic, payload, response_topic=response_topic, correlation_data=correlation)

        def found():
            return [
                m
                for m in self.received
                if m.topic == response_topic
                and (m.properties or {}).get(Property.CORRELATION_DATA) == correlation
            ]

        await until(found, f"the answer to {topic}")
        (message,) = found()
        user_properties = dict(message.properties[Property.USER_PROPERTY])
        return user_properties["status"], json.loads(message.payload)

    async def call_311(self, topic, payload=b""):
        """The JSON of the answer, by a token."""
        await asyncio.sleep(0)
        self._number += 1
        reply = f"{topic.rpartition('/')[0]}/_reply/{self.name}/{self._number}"
        self.subscribe(reply)
        self.send(f"{topic}/{self._number}", payload)
        await until(lambda: self.on(reply), f"the answer to {topic}")
        return self.payloads(reply)[0]

    async def error(self, topic, payload=b"", **kw):
        """(code, message) of a call that must fail."""
        status, answer = await self.call(topic, payload, **kw)
        assert status == "error", answer
        assert set(answer) == {"error"}
        assert set(answer["error"]) == {"code", "message"}
        return answer["error"]["code"], answer["error"]["message"]


class CallHarness:
    def __init__(self, node):
        self.node = node
        self.rules = Rules()
        self.broker = Broker(self.rules, MemoryStore())
        self.broker.accounting.now = time.monotonic()
        self.bridge = None

    def start(self, *routes, topics=(), **limits):
        loop = asyncio.get_running_loop()
        self.bridge = Bridge(self.node, self.broker, topics, loop, "r2d2", call_routes(*routes))
        self.bridge.start()
        return self.bridge

    def client(self, name, *subscriptions, user=None):
        return RecordingClient(self.broker, name, *subscriptions, user=user)

    def counters(self, index=0):
        return self.bridge.calls.status()[index].counters

    def replace_while_the_node_joins(self, monkeypatch, *routes):
        """Replace the routes when there is no node yet; it joins and polls before that is done."""
        node = self.node
        node.running = False

        def call_soon(callback):
            monkeypatch.undo()
            node.running = True
            node.spin()
            raise BusError("ROS is not ready")

        monkeypatch.setattr(node, "call_soon", call_soon)
        self.bridge.calls.replace(call_routes(*routes))
        assert node.running

    def retained(self, topic):
        message = self.broker.retained.get(topic)
        return None if message is None else json.loads(message.payload)

    async def stop(self):
        if self.bridge is not None:
            await self.bridge.stop()
            assert "_calls" not in self.broker.sessions
            assert self.broker.departures == []


def call_routes(*routes, **more):
    return CallRoutes(
        tuple(route for route in routes if isinstance(route, ServiceSettings)),
        tuple(route for route in routes if isinstance(route, ActionSettings)),
        tuple(route for route in routes if isinstance(route, ParameterSettings)),
        **more,
    )


def service(ros, **kw):
    return ServiceSettings(names(ros), kw.pop("mqtt", "r2d2{ros}"), **kw)


def action(ros, **kw):
    return ActionSettings(names(ros), kw.pop("mqtt", "r2d2{ros}"), **kw)


def parameters(ros, **kw):
    return ParameterSettings(names(ros), kw.pop("mqtt", "r2d2{node}/_param"), **kw)


def names(ros):
    return (ros,) if isinstance(ros, str) else tuple(ros)
