"""A paho-mqtt client as the tests use it: every call waits for the answer, under a time limit."""

from __future__ import annotations

import queue
import socket
import threading
from pathlib import Path
from typing import Any

from appliance_process import HOST, BrokerProcess
from paho.mqtt.client import Client, DisconnectFlags, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions
from waiting import PATIENCE

V311 = MQTTProtocolVersion.MQTTv311
V5 = MQTTProtocolVersion.MQTTv5


def properties(packet: int, **values: Any) -> Properties:
    """paho's property table of a packet type, filled."""
    table = Properties(packet)
    for name, value in values.items():
        setattr(table, name, value)
    return table


class Peer:
    """A client of one broker through TLS; `start` connects it.

    `expiry` is how many seconds the session is kept; 0 ends it with the connection. In MQTT 3.1.1
    any other value stands for "not clean". `certificate` names the files of certificate and key.
    """

    def __init__(
        self,
        broker: BrokerProcess,
        version: MQTTProtocolVersion,
        client_id: str = "",
        *,
        user: str = "alice",
        certificate: tuple[Path, Path] | None = None,
        clean: bool = True,
        expiry: int = 0,
        receive_maximum: int | None = None,
        manual_ack: bool = False,
    ) -> None:
        self.broker = broker
        self.version = version
        self.clean = clean
        self.connect_properties: Properties | None = None
        keeping: dict[str, Any] = {}
        if version == V5:
            self.connect_properties = properties(
                PacketTypes.CONNECT, SessionExpiryInterval=expiry, MaximumPacketSize=16 << 20
            )
            if receive_maximum is not None:
                self.connect_properties.ReceiveMaximum = receive_maximum
        else:
            keeping["clean_session"] = clean and not expiry
        self.client = Client(
            CallbackAPIVersion.VERSION2,
            client_id,
            protocol=version,
            reconnect_on_failure=False,
            manual_ack=manual_ack,
            **keeping,
        )
        context = broker.tls_context()
        if certificate is not None:
            context.load_cert_chain(*certificate)
        self.client.tls_set_context(context)
        self.client.username_pw_set(user, broker.passwords[user])
        self.client.on_connect = self._on_connect
        self.client.on_disconnect = self._on_disconnect
        self.client.on_message = self._on_message
        self.client.on_subscribe = self._on_subscribe
        self.client.on_unsubscribe = self._on_unsubscribe
        self.client.on_publish = self._on_publish
        self.session_present = False
        self.connack: Properties | None = None
        self._messages: queue.Queue[MQTTMessage] = queue.Queue()
        self._answers: queue.Queue[Any] = queue.Queue()
        self._published: dict[int, ReasonCode] = {}
        self._changed = threading.Condition()
        self.disconnected: queue.Queue[ReasonCode] = queue.Queue()

    def _on_connect(
        self, client: Client, data: Any, flags: Any, code: ReasonCode, connack: Properties | None
    ) -> None:
        self.session_present = flags.session_present
        self.connack = connack
        self._answers.put(code)

    def _on_disconnect(
        self,
        client: Client,
        data: Any,
        flags: DisconnectFlags,
        code: ReasonCode,
        disconnect: Properties | None,
    ) -> None:
        self.disconnected.put(code)

    def _on_message(self, client: Client, data: Any, message: MQTTMessage) -> None:
        self._messages.put(message)

    def _on_subscribe(
        self, client: Client, data: Any, mid: int, codes: list[ReasonCode], suback: Any
    ) -> None:
        self._answers.put([code.value for code in codes])

    _on_unsubscribe = _on_subscribe

    def _on_publish(
        self, client: Client, data: Any, mid: int, code: ReasonCode, puback: Any
    ) -> None:
        with self._changed:
            self._published[mid] = code
            self._changed.notify_all()

    def start(self) -> Peer:
        """Connect; AssertionError when it is refused."""
        options: dict[str, Any] = {}
        if self.version == V5:
            options = {"clean_start": self.clean, "properties": self.connect_properties}
        self.client.connect(HOST, self.broker.port, **options)
        self.client.loop_start()
        code = self._answers.get(timeout=PATIENCE)
        assert not code.is_failure, code
        return self

    def __enter__(self) -> Peer:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Take leave; may be called twice."""
        self.client.disconnect()
        self.client.loop_stop()

    def kill(self) -> None:
        """Be gone without a word."""
        sock = self.client.socket()
        assert sock is not None
        # Not the TLS socket's own, behind which paho would read on, and without decrypting.
        socket.socket.shutdown(sock, socket.SHUT_RDWR)
        self.disconnected.get(timeout=PATIENCE)
        self.client.loop_stop()

    def subscribe(
        self, topic: str, options: int | SubscribeOptions = 1, identifier: int = 0
    ) -> int:
        """Subscribe, and return the code in SUBACK once it is there."""
        if self.version == V5:
            if isinstance(options, int):
                options = SubscribeOptions(qos=options)
            table = None
            if identifier:
                table = properties(PacketTypes.SUBSCRIBE, SubscriptionIdentifier=identifier)
            self.client.subscribe(topic, options=options, properties=table)
        else:
            assert isinstance(options, int)
            self.client.subscribe(topic, options)
        (code,) = self._answers.get(timeout=PATIENCE)
        return int(code)

    def unsubscribe(self, topic: str) -> None:
        self.client.unsubscribe(topic)
        self._answers.get(timeout=PATIENCE)

    def publish(
        self,
        topic: str,
        payload: bytes | str = b"",
        qos: int = 1,
        retain: bool = False,
        **table: Any,
    ) -> ReasonCode:
        """Publish, and return the code in PUBACK or PUBCOMP once it is there."""
        packed = properties(PacketTypes.PUBLISH, **table) if table else None
        mid = self.client.publish(topic, payload, qos, retain, packed).mid
        with self._changed:
            assert self._changed.wait_for(lambda: mid in self._published, PATIENCE), topic
            return self._published.pop(mid)

    def receive(self, count: int) -> list[MQTTMessage]:
        """The next messages."""
        return [self._messages.get(timeout=PATIENCE) for _ in range(count)]

    def message(self) -> MQTTMessage:
        return self.receive(1)[0]

    def payloads(self, count: int) -> list[str]:
        return [message.payload.decode() for message in self.receive(count)]


def brief(message: MQTTMessage) -> tuple[str, str, int, bool]:
    """topic, payload, QoS, retain."""
    return message.topic, message.payload.decode(), message.qos, message.retain
