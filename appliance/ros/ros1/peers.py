"""What is said to the Master and other nodes of ROS 1 beside rospy: questions, service calls.

Everything has a time limit and a largest size, which rospy's own client has not: a computer that is
switched off answers nothing, and a call that is given up must not leave a thread waiting.

TCPROS is a header of `key=value` fields each way, then messages, everything behind its length in
four bytes.
"""

from __future__ import annotations

import queue
import socket
import struct
import threading
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from http.client import HTTPException
from time import monotonic
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError

from appliance.ros.node import BusError
from appliance.ros.ros1.types import Definition, ServiceDefinition

#: Seconds that the Master or a node may take to say something.
TIMEOUT = 2.0

#: Seconds until a question is asked again that was not answered.
RETRY_INTERVAL = 5.0

#: Questions that are asked at a time.
QUERY_THREADS = 4

#: Bytes of a header, which has a type's definition in it, and of a response.
MAX_HEADER_SIZE = 4 << 20
MAX_RESPONSE_SIZE = 64 << 20

#: What comes of an answer that is none: a port may be another program's by now.
_WRONG = (
    OSError,
    HTTPException,
    xmlrpc.client.Error,
    ExpatError,
    LookupError,
    TypeError,
    ValueError,
)

_Result = TypeVar("_Result")


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host: Any) -> Any:
        connection = super().make_connection(host)
        connection.timeout = TIMEOUT
        return connection


class Master:
    """The Master, or a node, by its URI and XML-RPC; for one thread."""

    def __init__(self, uri: str, caller: str) -> None:
        self.uri = uri
        self.caller = caller
        self._proxy: xmlrpc.client.ServerProxy | None = None

    def _connection(self) -> xmlrpc.client.ServerProxy:
        if self._proxy is None:  # which does not take all that may be called a URI
            self._proxy = xmlrpc.client.ServerProxy(self.uri, _Transport())
        return self._proxy

    def call(self, method: str, *arguments: Any) -> Any:
        """The value of an answer. Raises BusError, also when it says that it failed."""
        try:
            return _value(getattr(self._connection(), method)(self.caller, *arguments))
        except _WRONG as error:
            raise BusError(f"{self.uri}: {error}") from error

    def call_each(self, method: str, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        """The values of many answers at once, None for what failed. Raises BusError."""
        many = [{"methodName": method, "params": (self.caller, *arguments)} for arguments in calls]
        try:
            answers: Any = self._connection().system.multicall(many) if many else []
            return [
                answer[0][2] if isinstance(answer, list) and answer[0][0] == 1 else None
                for answer in answers
            ]
        except xmlrpc.client.Fault:
            if len(calls) == 1:  # there is no telling it, such as a number of 64 bits
                return [None]
            half = len(calls) // 2
            return self.call_each(method, calls[:half]) + self.call_each(method, calls[half:])
        except _WRONG as error:
            raise BusError(f"{self.uri}: {error}") from error


def _value(answer: Any) -> Any:
    code, text, value = answer
    if code != 1:
        raise ValueError(text)
    return value


class MasterParameters:
    """The Master's parameters; a ParameterServer."""

    def __init__(self, master: Master) -> None:
        self._master = master

    def names(self) -> list[str]:
        return [str(name) for name in self._master.call("getParamNames")]

    def get(self, names: Sequence[str]) -> dict[str, Any]:
        values = self._master.call_each("getParam", [(name,) for name in names])
        return {
            name: _plain(value)
            for name, value in zip(names, values, strict=True)
            if value is not None  # it has gone meanwhile
        }

    def set(self, name: str, value: Any) -> None:
        self._master.call("setParam", name, value)


def _plain(value: Any) -> Any:
    """A value of XML-RPC in Python's own types: dates as their text."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, xmlrpc.client.Binary):
        return value.data
    return str(value) if isinstance(value, xmlrpc.client.DateTime) else value


class QueryCache(Generic[_Result]):
    """Answers to questions, which are asked on threads of their own; for one thread.

    An executor's threads would be waited for at the end of the process, and who is asked may take
    its time.
    """

    def __init__(self) -> None:
        self._askers: list[threading.Thread] = []
        self._questions: queue.SimpleQueue[tuple[Future[_Result], Callable[[], _Result]] | None]
        self._questions = queue.SimpleQueue()
        self._asked: dict[Any, tuple[Future[_Result], float]] = {}
        #: What was answered before, until it is answered anew.
        self._before: dict[Any, _Result] = {}

    def get(self, key: Any, ask: Callable[[], _Result]) -> _Result | None:
        """The answer of `ask`; None when it is not there yet. Raises BusError as `ask` did."""
        asked = self._asked.get(key)
        if asked is None or (asked[1] < monotonic() and asked[0].done() and asked[0].exception()):
            asked = self._asked[key] = (self._ask(ask), monotonic() + RETRY_INTERVAL)
        if not asked[0].done():
            return self._before.get(key)
        self._before.pop(key, None)
        return asked[0].result()

    def _ask(self, ask: Callable[[], _Result]) -> Future[_Result]:
        answer: Future[_Result] = Future()
        self._questions.put((answer, ask))
        if len(self._askers) < QUERY_THREADS:
            asker = threading.Thread(target=self._run, name="ros-ask", daemon=True)
            self._askers.append(asker)
            asker.start()
        return answer

    def _run(self) -> None:
        while (question := self._questions.get()) is not None:
            answer, ask = question
            if not answer.set_running_or_notify_cancel():
                continue
            try:
                answer.set_result(ask())
            except Exception as error:  # as an executor does: it is raised where it is asked for
                answer.set_exception(error)

    def doubt(self, key: Any) -> None:
        """Ask anew; what was answered holds until then."""
        asked = self._asked.get(key)
        if asked is not None and asked[0].done() and asked[0].exception() is None:
            self._before[key] = asked[0].result()
            del self._asked[key]

    def keep(self, keys: set[Any]) -> None:
        """Forget all others."""
        for key in self._asked.keys() - keys:
            self._asked.pop(key)[0].cancel()
        for key in self._before.keys() - keys:
            del self._before[key]

    def close(self) -> None:
        """Ask nothing more."""
        self.keep(set())
        for _ in self._askers:
            self._questions.put(None)


def fetch_definition(master_uri: str, caller: str, node: str, topic: str) -> Definition:
    """The definition of a topic's type, as one of its publishers has it. Raises BusError."""
    uri = Master(master_uri, caller).call("lookupNode", node)
    protocol = Master(uri, caller).call("requestTopic", topic, [["TCPROS"]])
    if not isinstance(protocol, list) or len(protocol) != 3:
        raise BusError(f"{node} does not publish {topic} over TCP")
    fields = {"callerid": caller, "topic": topic, "md5sum": "*", "type": "*"}
    with _connect((str(protocol[1]), protocol[2]), node) as peer:
        header = _shake_hands(peer, fields, node)
    try:
        return Definition(header["type"], header["md5sum"], header["message_definition"])
    except KeyError as error:
        raise BusError(f"{node} does not tell the {error.args[0]} of {topic}") from None


def fetch_service_type(master_uri: str, caller: str, service: str) -> str:
    """The type of a service, as ROS 1 calls it. Raises BusError."""
    address = _address(Master(master_uri, caller).call("lookupService", service), service)
    fields = {"callerid": caller, "service": service, "md5sum": "*", "probe": "1"}
    with _connect(address, service) as peer:
        header = _shake_hands(peer, fields, service)
    if "type" not in header:
        raise BusError(f"{service} does not tell its type")
    return header["type"]


class ServiceCall:
    """One call of a service, on a thread of its own."""

    def __init__(
        self,
        master_uri: str,
        caller: str,
        service: str,
        definition: ServiceDefinition,
        request: bytes,
        done: Callable[[bytes | BusError], None],
    ) -> None:
        """`done` is called with the response, on that thread, unless the call was given up."""
        self._master_uri = master_uri
        self._caller = caller
        self._service = service
        self._definition = definition
        self._request = request
        self._done = done
        self._lock = threading.Lock()
        self._peer: socket.socket | None = None
        self._is_over = False
        threading.Thread(target=self._run, name="ros-call", daemon=True).start()

    def give_up(self) -> None:
        """End it: nobody waits for the response any more."""
        with self._lock:
            self._is_over = True
            if self._peer is not None:
                with suppress(OSError):
                    self._peer.shutdown(socket.SHUT_RDWR)

    def _run(self) -> None:
        try:
            result: bytes | BusError = self._call()
        except BusError as error:
            result = error
        except OSError as error:
            result = BusError(f"{self._service}: {error}")
        with self._lock:
            if self._is_over:
                return
            self._is_over = True
        self._done(result)

    def _call(self) -> bytes:
        service = self._service
        uri = Master(self._master_uri, self._caller).call("lookupService", service)
        fields = {
            "callerid": self._caller,
            "service": service,
            "md5sum": self._definition.md5sum,
            "type": self._definition.name,
        }
        with _connect(_address(uri, service), service) as peer:
            with self._lock:
                if self._is_over:
                    raise BusError("it was given up")
                self._peer = peer
            try:
                _shake_hands(peer, fields, service)
                peer.sendall(struct.pack("<I", len(self._request)) + self._request)
                # How long a service may work is for who called it to decide.
                peer.settimeout(None)
                is_ok = _read(peer, 1, service) != b"\0"
                response = _read_sized(peer, MAX_RESPONSE_SIZE, service)
            finally:
                with self._lock:
                    self._peer = None
        if not is_ok:
            raise BusError(f"{service} says: {response.decode(errors='replace')[:500]}")
        return response


def _address(uri: object, service: str) -> tuple[str, int]:
    with suppress(ValueError):  # what a node registers nobody checks
        parts = urlsplit(str(uri))
        if parts.scheme == "rosrpc" and parts.hostname is not None and parts.port is not None:
            return parts.hostname, parts.port
    raise BusError(f"{service} is at {uri!r}, which is no address of a service")


def _connect(address: tuple[str, Any], who: str) -> socket.socket:
    host, port = address
    try:
        peer = socket.create_connection((host, int(port)), TIMEOUT)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # What it tells may be no number, too large a one, or no name of a computer (UnicodeError).
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise BusError(
            f"{who} cannot be reached at {host}:{port}: {error} (it tells the address that its "
            "ROS_HOSTNAME or ROS_IP says)"
        ) from error
    return peer


def _shake_hands(peer: socket.socket, fields: Mapping[str, str], who: str) -> dict[str, str]:
    """Send a header, and read the other's. Raises BusError, also for an error in it, and when the
    other takes longer than PATIENCE for all of it."""
    until = monotonic() + TIMEOUT
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    header = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    try:
        peer.sendall(struct.pack("<I", len(header)) + header)
    except OSError as error:
        raise BusError(f"{who}: {error}") from error
    found = parse_header(_read_sized(peer, MAX_HEADER_SIZE, who, until))
    peer.settimeout(TIMEOUT)
    if "error" in found:
        raise BusError(f"{who} says: {found['error'][:500]}")
    return found


def parse_header(data: bytes) -> dict[str, str]:
    """The fields of a TCPROS header, without its length. Raises BusError."""
    fields: dict[str, str] = {}
    position = 0
    while position < len(data):
        start = position + 4
        if start > len(data):
            raise BusError("a TCPROS header is cut off")
        position = start + int.from_bytes(data[position:start], "little")
        line = data[start:position]
        if position > len(data) or b"=" not in line:
            raise BusError("a TCPROS header is malformed")
        key, _, value = line.decode(errors="replace").partition("=")
        fields[key] = value
    return fields


def _read_sized(peer: socket.socket, largest: int, who: str, until: float | None = None) -> bytes:
    size = int.from_bytes(_read(peer, 4, who, until), "little")
    if size > largest:
        raise BusError(f"{who} sends {size} bytes, more than the {largest} that are taken")
    return _read(peer, size, who, until)


def _read(peer: socket.socket, size: int, who: str, until: float | None = None) -> bytes:
    """So many bytes; with `until` before that time."""
    data = bytearray()
    while len(data) < size:
        try:
            if until is not None:
                peer.settimeout(max(0.001, until - monotonic()))
            chunk = peer.recv(min(size - len(data), 1 << 20))
        except OSError as error:
            raise BusError(f"{who}: {error}") from error
        if not chunk:
            raise BusError(f"{who} closed the connection before it had answered")
        data += chunk
    return bytes(data)
