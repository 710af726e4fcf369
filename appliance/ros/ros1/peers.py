"""Requests to the Master and to other nodes of ROS 1 without rospy: queries and service calls.

All of them have a timeout and a size limit, unlike those of rospy's own client: a computer that is
switched off never answers, and an abandoned call must not leave a thread waiting.

In TCPROS each side sends a header of `key=value` fields, then messages. The length of each field,
header and message precedes it, in four bytes.
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

#: Seconds within which the Master or a node must answer.
TIMEOUT = 2.0

#: Seconds until a query that failed is repeated.
RETRY_INTERVAL = 5.0

#: Queries that run at the same time, each on a thread.
QUERY_THREADS = 4

#: The most bytes of a header, which contains the definition of a type, and of a response.
MAX_HEADER_SIZE = 4 << 20
MAX_RESPONSE_SIZE = 64 << 20

#: The errors of a malformed answer: the port may belong to another program by now.
_MALFORMED = (
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
    """An XML-RPC client of the Master or of a node; for one thread."""

    def __init__(self, uri: str, caller: str) -> None:
        self.uri = uri
        self.caller = caller
        self._proxy: xmlrpc.client.ServerProxy | None = None

    def _connection(self) -> xmlrpc.client.ServerProxy:
        if self._proxy is None:  # not in __init__: ServerProxy raises for a malformed URI
            self._proxy = xmlrpc.client.ServerProxy(self.uri, _Transport())
        return self._proxy

    def call(self, method: str, *arguments: Any) -> Any:
        """The value of an answer. Raises BusError, also when the answer reports a failure."""
        try:
            return _value(getattr(self._connection(), method)(self.caller, *arguments))
        except _MALFORMED as error:
            raise BusError(f"{self.uri}: {error}") from error

    def call_each(self, method: str, calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        """The values of many answers in one request, None for those that failed. Raises
        BusError."""
        many = [{"methodName": method, "params": (self.caller, *arguments)} for arguments in calls]
        try:
            answers: Any = self._connection().system.multicall(many) if many else []
            return [
                answer[0][2] if isinstance(answer, list) and answer[0][0] == 1 else None
                for answer in answers
            ]
        except xmlrpc.client.Fault:
            if len(calls) == 1:  # XML-RPC cannot express the value, such as a 64-bit integer
                return [None]
            half = len(calls) // 2
            return self.call_each(method, calls[:half]) + self.call_each(method, calls[half:])
        except _MALFORMED as error:
            raise BusError(f"{self.uri}: {error}") from error


def _value(answer: Any) -> Any:
    code, text, value = answer
    if code != 1:
        raise ValueError(text)
    return value


class MasterParameters:
    """A ParameterServer of the Master's parameters."""

    def __init__(self, master: Master) -> None:
        self._master = master

    def names(self) -> list[str]:
        return [str(name) for name in self._master.call("getParamNames")]

    def get(self, names: Sequence[str]) -> dict[str, Any]:
        values = self._master.call_each("getParam", [(name,) for name in names])
        return {
            name: _plain(value)
            for name, value in zip(names, values, strict=True)
            if value is not None  # deleted meanwhile
        }

    def set(self, name: str, value: Any) -> None:
        self._master.call("setParam", name, value)


def _plain(value: Any) -> Any:
    """A value of XML-RPC in Python's own types; a date becomes its text."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, xmlrpc.client.Binary):
        return value.data
    return str(value) if isinstance(value, xmlrpc.client.DateTime) else value


class QueryCache(Generic[_Result]):
    """Runs blocking queries on threads of its own and caches their results; for one thread.

    An executor would not do: Python waits for its threads when the process ends, and a query may
    take long.
    """

    def __init__(self) -> None:
        self._threads: list[threading.Thread] = []
        self._queue: queue.SimpleQueue[tuple[Future[_Result], Callable[[], _Result]] | None]
        self._queue = queue.SimpleQueue()
        #: The result of each query, and when the query may be repeated if it failed.
        self._results: dict[Any, tuple[Future[_Result], float]] = {}
        #: Invalidated results, which hold until the query has been repeated.
        self._stale: dict[Any, _Result] = {}

    def get(self, key: Any, query: Callable[[], _Result]) -> _Result | None:
        """The result of `query`; None while it is not known yet. Raises BusError as `query` did."""
        cached = self._results.get(key)
        if cached is None or (
            cached[1] < monotonic() and cached[0].done() and cached[0].exception()
        ):
            cached = self._results[key] = (self._submit(query), monotonic() + RETRY_INTERVAL)
        if not cached[0].done():
            return self._stale.get(key)
        self._stale.pop(key, None)
        return cached[0].result()

    def _submit(self, query: Callable[[], _Result]) -> Future[_Result]:
        result: Future[_Result] = Future()
        self._queue.put((result, query))
        if len(self._threads) < QUERY_THREADS:
            thread = threading.Thread(target=self._run, name="ros-query", daemon=True)
            self._threads.append(thread)
            thread.start()
        return result

    def _run(self) -> None:
        while (queued := self._queue.get()) is not None:
            result, query = queued
            if not result.set_running_or_notify_cancel():
                continue
            try:
                result.set_result(query())
            except Exception as error:  # `get` raises it, as with an executor
                result.set_exception(error)

    def invalidate(self, key: Any) -> None:
        """Repeat the query at the next `get`; the present result holds until then."""
        cached = self._results.get(key)
        if cached is not None and cached[0].done() and cached[0].exception() is None:
            self._stale[key] = cached[0].result()
            del self._results[key]

    def evict_others(self, keys: set[Any]) -> None:
        """Remove all results but those of `keys`."""
        for key in self._results.keys() - keys:
            self._results.pop(key)[0].cancel()
        for key in self._stale.keys() - keys:
            del self._stale[key]

    def close(self) -> None:
        """End the threads once their present queries are done."""
        self.evict_others(set())
        for _ in self._threads:
            self._queue.put(None)


def fetch_definition(master_uri: str, caller: str, node: str, topic: str) -> Definition:
    """The definition of a topic's type, from one of its publishers. Raises BusError."""
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
        raise BusError(f"{node} does not send the {error.args[0]} of {topic}") from None


def fetch_service_type(master_uri: str, caller: str, service: str) -> str:
    """The type of a service, as ROS 1 calls it. Raises BusError."""
    address = _address(Master(master_uri, caller).call("lookupService", service), service)
    fields = {"callerid": caller, "service": service, "md5sum": "*", "probe": "1"}
    with _connect(address, service) as peer:
        header = _shake_hands(peer, fields, service)
    if "type" not in header:
        raise BusError(f"{service} does not send its type")
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
        """`done` is called with the response, on that thread, unless the call was abandoned."""
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
        """Abandon the call: `done` is not called any more."""
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
                # How long a service may work is up to its caller.
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
    with suppress(ValueError):  # the Master does not check what nodes register
        parts = urlsplit(str(uri))
        if parts.scheme == "rosrpc" and parts.hostname is not None and parts.port is not None:
            return parts.hostname, parts.port
    raise BusError(f"{service} is at {uri!r}, which is no address of a service")


def _connect(address: tuple[str, Any], name: str) -> socket.socket:
    host, port = address
    try:
        peer = socket.create_connection((host, int(port)), TIMEOUT)
        peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    # A node may register a port that is no number or too large, or no valid name (UnicodeError).
    except (OSError, ValueError, TypeError, OverflowError) as error:
        raise BusError(
            f"{name} cannot be reached at {host}:{port}: {error} (a node registers the address "
            "in its ROS_HOSTNAME or ROS_IP)"
        ) from error
    return peer


def _shake_hands(peer: socket.socket, fields: Mapping[str, str], name: str) -> dict[str, str]:
    """Send a header, and read that of the peer.

    Raises BusError, also when the peer's header reports an error, or is not complete within
    TIMEOUT.
    """
    until = monotonic() + TIMEOUT
    lines = [f"{key}={value}".encode() for key, value in fields.items()]
    header = b"".join(struct.pack("<I", len(line)) + line for line in lines)
    try:
        peer.sendall(struct.pack("<I", len(header)) + header)
    except OSError as error:
        raise BusError(f"{name}: {error}") from error
    found = parse_header(_read_sized(peer, MAX_HEADER_SIZE, name, until))
    peer.settimeout(TIMEOUT)
    if "error" in found:
        raise BusError(f"{name} says: {found['error'][:500]}")
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


def _read_sized(peer: socket.socket, largest: int, name: str, until: float | None = None) -> bytes:
    size = int.from_bytes(_read(peer, 4, name, until), "little")
    if size > largest:
        raise BusError(f"{name} sends {size} bytes, at most {largest} are accepted")
    return _read(peer, size, name, until)


def _read(peer: socket.socket, size: int, name: str, until: float | None = None) -> bytes:
    """Read `size` bytes; when `until` is given, before that time."""
    data = bytearray()
    while len(data) < size:
        try:
            if until is not None:
                peer.settimeout(max(0.001, until - monotonic()))
            chunk = peer.recv(min(size - len(data), 1 << 20))
        except OSError as error:
            raise BusError(f"{name}: {error}") from error
        if not chunk:
            raise BusError(f"{name} closed the connection before it had answered")
        data += chunk
    return bytes(data)
