"""The MQTT client of the command line, for `appliance pub`, `sub` and calls: paho-mqtt over TLS."""

from __future__ import annotations

import re
import socket
import ssl
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode, MQTTProtocolVersion
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from appliance.cli.arrivals import Arrivals
from appliance.mqtt.topics import parse_shared
from appliance.ops.logs import VISIBLE, VISIBLE_IN_LINES

ANSWER_TIMEOUT = 10.0  # seconds to wait for an acknowledgement

#: Seconds without a message after which who subscribes may wonder.
SILENCE = 5.0

#: In the reason of the appliance's broker, where no line denies but one is missing.
_NO_RULE: Final = ": no rule lets "

#: Python's text for an alert of the other end, such as SSLV3_ALERT_CERTIFICATE_REVOKED.
_ALERT: Final = re.compile(r"\[SSL: \w*ALERT_(\w+)\]")


class ClientError(Exception):
    """The broker is unreachable or refused a request; the message says what and why."""


class RefusedError(ClientError):
    """The broker refused a request; the message has the broker's reason, if it gave one.

    `by_rules`: its access rules may be the reason. `lines`: those that would allow it, as far as
    the broker's reason says so: none helps against a line that denies.
    """

    def __init__(self, message: str, *, by_rules: bool, lines: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.by_rules = by_rules
        self.lines = lines

    def advised(self, advice: str) -> RefusedError:
        """The same error, with advice on access rules if these may be the reason."""
        return RefusedError(f"{self}. {advice}", by_rules=True) if self.by_rules else self


def lines_needed(user: str | None, lines: Sequence[str]) -> str:
    """Which lines of the access rules the user lacks, and where they belong."""
    quoted = " and ".join(f"`{line}`" for line in lines)
    owner = f"below `user {user}`" if user else "below its `user` line"
    what = "line that allows" if len(lines) == 1 else "lines that allow"
    return f"The ACL {what} it: {quoted}, {owner} or in a group's file (groups/drivers.conf)"


@dataclass(frozen=True)
class BrokerReply:
    """The broker's answer to a packet: a reason code and, in MQTT 5, perhaps a reason string."""

    code: ReasonCode
    properties: Properties | None

    def __str__(self) -> str:
        """As text, without control characters for a terminal."""
        return f"{self.code}: {self.why}" if self.why else str(self.code)

    @property
    def why(self) -> str:
        """The reason string, or an empty string."""
        return str(getattr(self.properties, "ReasonString", "")).translate(VISIBLE)

    @property
    def may_be_rules(self) -> bool:
        """Whether access rules may be the reason; MQTT 3.1.1 has one code for all refusals."""
        return self.code.value in (0x80, 0x87)

    @property
    def may_lack_line(self) -> bool:
        """Whether one more access rule may help."""
        return self.may_be_rules and (not self.why or _NO_RULE in self.why)


@dataclass(frozen=True)
class ConnectionSettings:
    """The broker's address, how its certificate is verified, and the client's credentials.

    `certificate` is the client's own; its key is in the same file or in `key`.
    """

    host: str
    port: int
    ca: Path | None
    username: str | None
    password: str | None
    client_id: str = ""
    version: MQTTProtocolVersion = MQTTProtocolVersion.MQTTv5
    insecure: bool = False
    certificate: Path | None = None
    key: Path | None = None

    @property
    def address(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def publish(
    target: ConnectionSettings,
    topic: str,
    payloads: Iterable[bytes],
    qos: int,
    retain: bool,
    *,
    delay: float = 0.0,
) -> None:
    """Publish each payload, wait for its acknowledgement, and between two of them for `delay`
    seconds. Raises ClientError."""
    connection = MqttClient(target)
    try:
        for number, payload in enumerate(payloads):
            if number and delay:
                connection.run(lambda: False, time.monotonic() + delay)
            connection.publish(topic, payload, qos, retain)
    finally:
        connection.close()


def subscribe(
    target: ConnectionSettings,
    filters: list[str],
    qos: int,
    output: BinaryIO,
    *,
    verbose: bool = False,
    rate: bool = False,
    count: int | None = None,
    timeout: float | None = None,
    on_silence: Callable[[], None] | None = None,
) -> int:
    """Write received messages to `output`, one per line; returns their number.

    A line begins with the topic if `verbose`, and before that with `Arrivals.note` if `rate`.
    `on_silence` is called once if nothing comes in the first seconds.
    Ends after `count` messages or `timeout` seconds, whichever is first; without either it runs
    until interrupted. Raises ClientError, also when the broker ends the connection.
    """
    received = 0
    arrivals = Arrivals()

    def show(message: paho.MQTTMessage) -> None:
        nonlocal received
        if count is not None and received >= count:
            return
        received += 1
        line = bytes(message.payload)
        if verbose:
            line = message.topic.encode() + b" " + line
        if rate:
            line = arrivals.note(message.topic).encode() + b"  " + line
        write_line(output, line)

    connection = MqttClient(target, show)
    try:
        connection.subscribe(filters, qos)
        deadline = None if timeout is None else time.monotonic() + timeout
        if on_silence is not None:
            until = time.monotonic() + SILENCE
            is_early = deadline is None or until < deadline
            if is_early and not connection.run(lambda: received > 0, until):
                on_silence()
        connection.run(lambda: count is not None and received >= count, deadline)
    finally:
        connection.close()
    return received


def write_line(output: BinaryIO, line: bytes) -> None:
    """Write a line unchanged, except to a terminal, where control characters are escaped."""
    if output.isatty():
        line = line.decode(errors="backslashreplace").translate(VISIBLE_IN_LINES).encode()
    output.write(line + b"\n")
    output.flush()


class MqttClient:
    """One connection, driven by the calling thread; every failure is a ClientError."""

    def __init__(
        self,
        target: ConnectionSettings,
        on_message: Callable[[paho.MQTTMessage], None] = lambda message: None,
    ) -> None:
        self._target = target
        self._answer: BrokerReply | None = None
        self._granted: dict[int | None, list[BrokerReply]] = {}
        self._published: dict[int, BrokerReply] = {}
        self._ended: BrokerReply | None = None
        self._alert = ""
        self._client = client = paho.Client(
            CallbackAPIVersion.VERSION2, target.client_id, protocol=target.version
        )
        client.username_pw_set(target.username, target.password)
        client.on_connect = lambda c, u, flags, code, p: setattr(
            self, "_answer", BrokerReply(code, p)
        )
        client.on_disconnect = lambda c, u, flags, code, p: setattr(
            self, "_ended", BrokerReply(code, p)
        )
        client.on_subscribe = lambda c, u, mid, codes, p: self._granted.update(
            {mid: [BrokerReply(code, p) for code in codes]}
        )
        client.on_publish = lambda c, u, mid, code, p: self._published.update(
            {mid: BrokerReply(code, p)}
        )
        client.on_message = lambda c, u, message: on_message(message)
        client.on_log = self._note_alert
        context = _tls(target)
        if target.certificate is not None:
            _load_certificate(context, target.certificate, target.key)
        client.tls_set_context(context)
        client.tls_insecure_set(target.insecure)
        self._connect()

    def _connect(self) -> None:
        target = self._target
        try:
            self._client.connect(target.host, target.port, keepalive=60)
        except ssl.SSLCertVerificationError as error:
            trusted = f"by {target.ca}" if target.ca else "by this computer's own list of CAs"
            raise ClientError(
                f"the certificate of {target.address} is not trusted {trusted}: "
                f"{error.verify_message.rstrip('.')}. Name the ca.crt that this appliance's "
                "`init` made with --ca, and connect by a name that the certificate has."
            ) from None
        except socket.gaierror:
            raise ClientError(f"there is no computer called {target.host!r}") from None
        except ssl.SSLError as error:
            raise ClientError(
                f"no TLS with {target.address}: {_reason(error)}; is this the port of a listener "
                "with tls: true?"
            ) from None
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise ClientError(f"{target.address} cannot be reached: {reason}") from None
        self._wait(lambda: self._answer is not None, "the login")
        answer = self._answer
        if answer is not None and answer.code.is_failure:
            who = f"user {target.username!r}" if target.username else "a client without user name"
            hint = "" if answer.why else " (its log says why)"
            raise ClientError(f"{target.address} refused {who}: {answer}{hint}")

    def publish(
        self,
        topic: str,
        payload: bytes,
        qos: int,
        retain: bool,
        properties: Properties | None = None,
    ) -> ReasonCode:
        """Publish, and return the reason code of the acknowledgement (QoS 0: return when it was
        sent). Raises RefusedError."""
        try:
            message = self._client.publish(topic, payload, qos, retain, properties)
        except ValueError as error:
            raise ClientError(f"{topic!r} cannot be published: {error}") from None
        self._wait(lambda: message.mid in self._published, "a message")
        answer = self._published.pop(message.mid)
        if answer.code.is_failure:
            # For QoS 2, paho reports only the end, and not the PUBREC with the reason string.
            hint = " (--qos 1 tells why)" if qos == 2 and not answer.why else ""
            text = f"{topic!r} was refused: {answer}{hint}"
            lines = [f"topic write {topic}"] if answer.may_lack_line else []
            raise RefusedError(text, by_rules=answer.may_be_rules, lines=lines)
        return answer.code

    def subscribe(self, filters: list[str], qos: int, *, retained: bool = True) -> None:
        """Subscribe to all filters; `retained=False` skips retained messages, in MQTT 5 only.

        Raises RefusedError that names the refused filters.
        """
        handling = SubscribeOptions.RETAIN_SEND_ON_SUBSCRIBE
        if not retained:
            handling = SubscribeOptions.RETAIN_DO_NOT_SEND
        options = [(name, SubscribeOptions(qos, retainHandling=handling)) for name in filters]
        try:
            if self._target.version == MQTTProtocolVersion.MQTTv5:
                _, mid = self._client.subscribe(options)
            else:
                _, mid = self._client.subscribe([(name, qos) for name in filters])
        except ValueError as error:
            raise ClientError(f"{', '.join(filters)}: {error}") from None
        self._wait(lambda: mid in self._granted, "the subscription")
        refused = [
            (name, answer)
            for name, answer in zip(filters, self._granted[mid], strict=False)
            if answer.code.is_failure
        ]
        if refused:
            text = "; ".join(f"{name!r} was refused: {answer.code}" for name, answer in refused)
            why = refused[0][1].why  # one for all of them
            by_rules = any(answer.may_be_rules for _, answer in refused)
            # The one reason is about the first.
            is_told = refused[0][1].may_lack_line
            lacking = [name for name, reply in refused if is_told and reply.may_be_rules]
            lines = [f"topic read {(parse_shared(name) or ('', name))[1]}" for name in lacking]
            raise RefusedError(f"{text}: {why}" if why else text, by_rules=by_rules, lines=lines)

    def run(
        self, done: Callable[[], bool], deadline: float | None = None, step: float = 1.0
    ) -> bool:
        """Run the network loop until `done()` or the deadline (monotonic clock); returns `done()`,
        which is called after received data and every `step` seconds."""
        while not done():
            left = step if deadline is None else min(step, deadline - time.monotonic())
            if left <= 0:
                return False
            code = self._client.loop(left)
            if done():
                break
            if self._ended is not None or code != MQTTErrorCode.MQTT_ERR_SUCCESS:
                known = self._ended is not None and self._ended.code.value >= 0x80
                why = str(self._ended) if known else "without giving a reason"
                if self._alert:
                    why = f"TLS says: {self._alert}"
                raise ClientError(f"{self._target.address} ended the connection: {why}")
        return True

    def _note_alert(self, client: paho.Client, data: object, level: int, text: str) -> None:
        """Under TLS 1.3 a client's certificate is refused behind the handshake, at the first read:
        paho tells that error to its log alone."""
        if found := _ALERT.search(text):
            self._alert = found[1].lower().replace("_", " ")

    def _wait(self, done: Callable[[], bool], what: str) -> None:
        if not self.run(done, time.monotonic() + ANSWER_TIMEOUT):
            raise ClientError(f"{self._target.address} gave no answer to {what}")

    def close(self) -> None:
        """Send DISCONNECT and close; does nothing when the connection is closed already."""
        self._client.disconnect()


def _reason(error: ssl.SSLError) -> str:
    """OpenSSL's reason, without the position in Python's source."""
    reason = error.reason or re.sub(r"^\[SSL\] | \(_ssl\.c:\d+\)$", "", str(error.args[-1]))
    return reason.lower().replace("_", " ")


def _tls(target: ConnectionSettings) -> ssl.SSLContext:
    if target.insecure:
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        return context
    try:
        # A given CA is the only trusted one: a public CA must not vouch for a robot.
        return ssl.create_default_context(cafile=str(target.ca) if target.ca else None)
    except ssl.SSLError:
        raise ClientError(f"{target.ca} is not a CA certificate in PEM form") from None
    except OSError as error:
        raise ClientError(f"{target.ca} cannot be read: {error.strerror}") from None


def _load_certificate(context: ssl.SSLContext, certificate: Path, key: Path | None) -> None:
    def no_password() -> str:
        raise ClientError(f"{key or certificate} is encrypted; take its password off first")

    try:
        context.load_cert_chain(certificate, key, no_password)
    except ssl.SSLError as error:
        files = f"{certificate} and {key}" if key else f"{certificate} (without --key)"
        raise ClientError(f"{files}: no certificate with its key: {_reason(error)}") from None
    except OSError as error:
        files = f"{certificate} or {key}" if key else str(certificate)
        raise ClientError(f"{files} cannot be read: {error.strerror}") from None
