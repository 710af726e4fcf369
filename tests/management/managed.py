"""An appliance with users, and clients of both versions that call its verbs."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import json
from pathlib import Path
from typing import Any

import yaml
from harness import Peer, make_contexts
from waiting import PATIENCE

from appliance import config
from appliance.access import Passwords
from appliance.app.main import App
from appliance.management.topics import TOPICS, topic_of
from appliance.mqtt.codec import V5, V311, Property
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Packet,
    Puback,
    Publish,
    Suback,
    Subscribe,
    Subscription,
)

SETTINGS: dict[str, Any] = {
    "robot": "r2d2",
    "reload_on_change": False,
    "broker": {
        "listeners": [{"bind": "127.0.0.1:0"}],
        "audit": {"path": "audit.log"},
        "sys_interval": "0 s",
        "limits": {"connect_timeout": f"{PATIENCE:g} s"},  # however slow the computer is
    },
    "bridge": {"bus": "none"},
}

RULES = f"""\
pattern read {TOPICS}/+/_reply/%c/#
user admin
topic write {TOPICS}/+/_call/#
topic read {TOPICS}/#
topic readwrite r2d2/#
user viewer
topic write {TOPICS}/rights/_call/#
topic read r2d2/#
topic deny r2d2/secret
"""

PASSWORD = "opensesame"


class CallError(Exception):
    """The error of an answer."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class Caller:
    """A client on a raw socket, of either version, that calls verbs."""

    def __init__(self, name: str, version: int) -> None:
        self.name = name
        self.version = version
        self._numbers = iter(range(1, 60_000))

    async def connect(self, address: tuple[str, int], user: str | None, **options: Any) -> None:
        self._peer = Peer(*await asyncio.open_connection(*address), self.version)
        options = {"password": PASSWORD.encode(), **options}
        await self.send(Connect(self.name, version=self.version, username=user, **options))
        connack = await self.receive()
        assert isinstance(connack, Connack) and not connack.reason_code, connack

    async def send(self, packet: Packet) -> None:
        await self._peer.send(packet)

    async def receive(self) -> Packet:
        return await self._peer.receive()

    async def subscribe(self, topic_filter: str, qos: int = 0) -> int:
        await self.send(Subscribe(next(self._numbers), [Subscription(topic_filter, qos)]))
        return (await self.wait_for(Suback)).reason_codes[0]

    async def wait_for(self, kind: type[Any]) -> Any:
        while not isinstance(packet := await self.receive(), kind):
            pass
        return packet

    async def listen(self, verb: str) -> None:
        """Subscribe to the verb's answers."""
        granted = await self.subscribe(f"{TOPICS}/{verb}/_reply/{self.name}/#", 1)
        assert granted == 1, granted

    async def post(self, verb: str, arguments: object = None, **more: Any) -> Puback:
        """Send a call, and return what acknowledges it."""
        number = next(self._numbers)
        payload = arguments if isinstance(arguments, bytes) else json.dumps(arguments).encode()
        topic = topic_of(verb)
        properties = {}
        if self.version == V5:
            reply = f"{TOPICS}/{verb}/_reply/{self.name}/{number}"
            properties = {Property.RESPONSE_TOPIC: reply, Property.CORRELATION_DATA: b"%d" % number}
            properties |= more.pop("properties", {})
        else:
            topic = f"{topic}/{number}"
        await self.send(
            Publish(topic, payload, 1, packet_id=number, properties=properties or None, **more)
        )
        return await self.wait_for(Puback)

    async def call(self, verb: str, arguments: object = b"", **more: Any) -> Any:
        """The answer to a call. Raises CallError."""
        await self.listen(verb)
        acknowledged = await self.post(verb, arguments, **more)
        assert not acknowledged.reason_code, acknowledged
        answer = json.loads((await self.wait_for(Publish)).payload)
        if isinstance(answer, dict) and "error" in answer:
            raise CallError(answer["error"]["code"], answer["error"]["message"])
        return answer

    def hang_up(self) -> None:
        self._peer.hang_up()


class Site:
    """The appliance, with the users admin and viewer, and its clients."""

    def __init__(self, directory: Path, *, tls: bool = False) -> None:
        """With `tls`, there is a second listener, with TLS."""
        self.directory = directory
        self.file = directory / "appliance.yaml"
        settings = copy.deepcopy(SETTINGS)
        if tls:
            make_contexts(directory / "certs")
            files = {"certificate": "server.crt", "key": "server.key", "ca": "ca.crt"}
            settings["broker"]["tls"] = {key: f"certs/{name}" for key, name in files.items()}
            settings["broker"]["listeners"].append({"bind": "127.0.0.1:0", "tls": True})
        self.file.write_text(yaml.safe_dump(settings))
        self.rules(RULES)
        users = Passwords(directory / "users.passwd")
        for name in ("admin", "viewer"):
            users.set(name, PASSWORD)
        users.save()
        self.app = App(config.load(self.file))
        self._stack = contextlib.AsyncExitStack()

    def rules(self, text: str) -> None:
        (self.directory / "acl.conf").write_text(text)

    async def join(
        self, name: str, user: str = "admin", version: int = V5, **options: Any
    ) -> Caller:
        caller = Caller(name, version)
        await caller.connect(self.app.addresses[0], user, **options)
        self._stack.callback(caller.hang_up)
        return caller

    def audited(self) -> list[dict[str, Any]]:
        """The lines of the audit log about changes."""
        lines = (self.directory / "audit.log").read_text().splitlines()
        found = [json.loads(line) for line in lines]
        return [each for each in found if each["event"] == "changed"]

    async def stop(self) -> None:
        await self._stack.aclose()
        await self.app.stop()


BOTH = (V311, V5)
