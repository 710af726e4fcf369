"""appliance.yaml: read, checked as a whole, and turned into typed settings.

Every problem is found in one go and told with its file, line and key; nothing is guessed. Sizes and
durations carry their unit, paths are relative to the file, `${NAME}` and `${NAME:-default}` take
environment variables, and values that look like secrets are masked wherever settings are printed.
"""

from __future__ import annotations

import difflib
import ipaddress
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_serializer,
)
from pydantic_core import ErrorDetails, PydanticCustomError

from appliance.document import Document, KeyPath, Problem
from appliance.environment import of_service

SEARCH_PATH = (Path("appliance.yaml"), Path("/etc/appliance/appliance.yaml"))
"""Where the configuration is looked for when no file is named; the first that exists is used."""

PACKET_SIZE_MAX = 255 << 20
"""Less than the largest Remaining Length that MQTT can say (section 1.5.5: four bytes of 7 bits): a
packet may grow by some properties on its way from one client to another."""

SIZE_UNITS = {"B": 1, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
DURATION_UNITS = {"ms": 1, "s": 1000, "min": 60_000, "h": 3_600_000, "d": 86_400_000}  # in ms

_QUANTITY = re.compile(r"(\d+(?:\.\d+)?)\s*([A-Za-z]+)")
_SECRET_KEY = re.compile(r"(?i)pass(word|wd|phrase)?$|secret|token|credential|api_?key|private")
_URL_PASSWORD = re.compile(r"(?<=://)([^/\s:@]*):[^/\s@]+(?=@)")
MASK = "********"

COMMAND_KEYS = (
    "expire",
    "take_retained",
    "exclusive",
    "lease",
    "on_silence",
    "clamp",
    "allow",
)
"""The keys of a route that say when a command may reach ROS, and with what in it."""

OPEN_WITH_SECRETS = (
    "has secrets in it, and every user of this computer can read it: close it with `chmod o=`, or "
    "take them from environment variables, ${NAME}"
)


# Errors


class ConfigError(Exception):
    """The configuration cannot be used; `problems` has everything that is wrong with it."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = problems


# Values with units


def parse_size(value: object) -> int:
    """Bytes from `64 KiB`, `16 MiB` or a plain number of bytes. Raises ValueError."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    return round(_quantity(value, SIZE_UNITS, "a size such as 64 KiB or 16 MiB"))


def parse_duration(value: object) -> float:
    """Seconds from `500 ms`, `10 s`, `5 min`, `1 h` or `7 d`. Raises ValueError."""
    return _quantity(value, DURATION_UNITS, "a duration such as 500 ms, 10 s or 5 min") / 1000


def _quantity(value: object, units: Mapping[str, int], wanted: str) -> float:
    match = _QUANTITY.fullmatch(value.strip()) if isinstance(value, str) else None
    if match is None:
        raise ValueError(f"must be {wanted}")
    number, unit = match.groups()
    if unit not in units:
        raise ValueError(f"unknown unit {unit!r}; use {_either(list(units))}")
    return float(number) * units[unit]


def format_size(value: int) -> str:
    """The shortest exact way to write so many bytes: `16 MiB`."""
    return _in_units(value, SIZE_UNITS)


def format_duration(seconds: float) -> str:
    """The shortest exact way to write so many seconds, to the millisecond: `5 min`."""
    return _in_units(round(seconds * 1000), DURATION_UNITS)


def _in_units(value: int, units: Mapping[str, int]) -> str:
    unit = max((u for u in units if value % units[u] == 0), key=lambda u: units[u] if value else 0)
    return f"{value // units[unit]} {unit}"


class Bind(NamedTuple):
    """An address to listen on. An empty host is every address of this computer; port 0 any port.

    With a `path` it is a Unix socket there, which has neither.
    """

    host: str
    port: int
    path: Path | None = None

    def __str__(self) -> str:
        if self.path is not None:
            return f"unix:{self.path}"
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether only this computer can reach it."""
        if self.path is not None:
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"


def parse_bind(value: object) -> Bind:
    """`host:port`, `[::1]:port`, `:port` or `unix:path`. Raises ValueError."""
    if isinstance(value, Bind):
        return value
    text = value if isinstance(value, str) else ""
    if text.startswith("unix:") and text != "unix:":
        return Bind("", 0, Path(text.removeprefix("unix:")))
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([^\s:\[\]]*)):(\d{1,5})", text)
    if match is None:
        raise ValueError('must be "host:port", "[::1]:port", ":port" or "unix:path"')
    port = int(match[3])
    if port > 65535:
        raise ValueError(f"there is no port {port}")
    return Bind(match[1] or match[2], port)


def _parse_address(value: object, info: ValidationInfo) -> Bind:
    bind = parse_bind(value)
    return bind if bind.path is None else bind._replace(path=_parse_path(bind.path, info))


def _parse_mode(value: object) -> int:
    """A file's mode; YAML reads 0660 as a number in base 8, and in quotes it is text."""
    modes = {"0600": 0o600, "0660": 0o660, "0666": 0o666}
    mode = modes.get(value) if isinstance(value, str) else value
    if mode not in modes.values() or isinstance(mode, bool):
        raise ValueError(f"must be {_either(list(modes))}")
    assert isinstance(mode, int)
    return mode


def _parse_seconds(value: object, info: ValidationInfo) -> float:
    # In a file a duration has a unit; in code, where the type says so, plain seconds do.
    if info.context is None and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    return parse_duration(value)


def _parse_path(value: object, info: ValidationInfo) -> Path:
    if not isinstance(value, (str, Path)) or not str(value):
        raise ValueError("must be a path")
    base: Path = (info.context or {}).get("directory", Path())
    return (base / value).absolute()


def _parse_optional_path(value: object, info: ValidationInfo) -> Path | None:
    return None if value is None else _parse_path(value, info)


def _parse_qos(value: object) -> int | None:
    if value is None or value == "auto":
        return None
    if isinstance(value, int) and not isinstance(value, bool) and value in (0, 1, 2):
        return value
    raise ValueError("must be 0, 1, 2 or auto")


def _parse_retain(value: object) -> bool | None:
    if value is None or value == "auto":
        return None
    if isinstance(value, bool):
        return value
    raise ValueError("must be true, false or auto")


def _parse_keep(value: object) -> int | Literal["latest"]:
    if value == "latest":
        return "latest"
    if isinstance(value, int) and not isinstance(value, bool) and value > 0:
        return value
    raise ValueError("must be latest, or how many messages to keep (1 or more)")


def _check_robot(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", value):
        raise ValueError(
            "must be one level of an MQTT topic: a letter or digit, "
            "then up to 63 letters, digits, '_', '-' or '.'"
        )
    return value


def _check_ros_name(value: str) -> str:
    if not value.startswith("/"):
        raise ValueError("must be a full ROS name that begins with '/'")
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", value):
        raise ValueError(
            "is not a ROS name: each part is a letter or '_', then letters, digits, '_'"
        )
    return value


def _check_ros_pattern(value: str) -> str:
    """A ROS name, or a pattern of names in which `*` is part of a name and `**` of a path."""
    if "*" not in value:
        return _check_ros_name(value)
    _check_ros_name(re.sub(r"\*+", "x", value))
    if "***" in value:
        raise ValueError("knows '*', part of a name, and '**', part of a path, but not '***'")
    return value


class _InListError(ValueError):
    """What is wrong with one entry of a list, and which."""

    def __init__(self, position: int, what: str) -> None:
        super().__init__(what)
        self.position = position


def _parse_ros_names(
    value: object, check: Callable[[str], object] = _check_ros_pattern
) -> str | tuple[str, ...]:
    """A name or pattern, or a list of them; what begins with `!` is left out."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, (list, tuple)) or not names:
        raise ValueError("must be a ROS name, a pattern, or a list of them")
    for position, name in enumerate(names):
        try:
            if not isinstance(name, str):
                raise ValueError("must be a ROS name or a pattern")
            check(name.removeprefix("!"))
        except ValueError as error:
            if isinstance(value, str):
                raise
            raise _InListError(position, str(error)) from None
    return str(names[0]) if len(names) == 1 else tuple(names)


def _parse_parameters(value: object) -> str | tuple[str, ...]:
    """Parameters as `_check_parameter` has them, or a list of them, as `_parse_ros_names`."""
    return _parse_ros_names(value, _check_parameter)


def _check_ros_arguments(value: list[str]) -> list[str]:
    if value[:1] == ["--ros-args"]:
        value = value[1:]
    if "--" in value:
        raise ValueError("must have ROS arguments only, without --")
    return value


def _check_node(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        raise ValueError("must be a letter or '_', then letters, digits or '_'")
    return value


def _check_namespace(value: str) -> str:
    return value if value == "/" else _check_ros_name(value)


def _check_ros_type(value: str) -> str:
    """The name of a message type, or a pattern of such: sensor_msgs/msg/*."""
    if re.fullmatch(r"[A-Za-z*][\w*]*/msg/[A-Za-z*][\w*]*", value) and "**" not in value:
        return value
    short = re.fullmatch(r"([A-Za-z]\w*)/([A-Za-z]\w*)", value)
    hint = f"; did you mean '{short[1]}/msg/{short[2]}'?" if short else ""
    raise ValueError(f"must be package/msg/Type, such as geometry_msgs/msg/Twist{hint}")


def _check_topic_template(value: str, name: str = "{ros}") -> str:
    plain = value.replace("{robot}", "r").replace(name, "/r")
    if not plain or any(char in plain for char in "+#\0"):
        raise ValueError("must be an MQTT topic without '+' and '#'")
    if "{" in plain or "}" in plain:
        raise ValueError(f"knows the placeholders {{robot}} and {name} only")
    if plain.startswith("$"):
        raise ValueError("must not begin with '$': those topics are the broker's own")
    return value


def _check_node_topic(value: str) -> str:
    return _check_topic_template(value, "{node}")


#: How a parameter is named.
OF_NODE = (
    "must be a node's full name, '/', and a parameter's: /arm/speed, /arm/* for all of /arm, /**/* "
    "for all of every node"
)


def _check_parameter(value: str) -> None:
    """The full name of a node, `/`, and the name of a parameter; all may be patterns."""
    node, slash, name = value.rpartition("/")
    if not slash or not re.fullmatch(r"[\w.*-]+", name):
        raise ValueError(OF_NODE)
    if node:  # of ROS 1, /speed is a parameter that is no node's
        _check_ros_pattern(node)


def _check_called_type(value: str, kind: str, example: str) -> str:
    if not re.fullmatch(rf"[A-Za-z*][\w*]*/{kind}/[A-Za-z*][\w*]*", value):
        raise ValueError(f"must be package/{kind}/Type, such as {example}")
    return value


def _check_service_type(value: str) -> str:
    return _check_called_type(value, "srv", "std_srvs/srv/Trigger")


def _check_action_type(value: str) -> str:
    return _check_called_type(value, "action", "nav2_msgs/action/NavigateToPose")


def _check_response(value: object) -> object:
    try:
        json.dumps(value)
    except TypeError:  # a date, most likely, which YAML makes of 2024-01-01
        raise ValueError("has a value that JSON does not know; put text in quotes") from None
    return value


def _from_names(value: object) -> object:
    """A route of which only the names are said."""
    return {"ros": value} if isinstance(value, (str, list, tuple)) else value


def _check_direction(value: object, info: ValidationInfo) -> object:
    names = info.data.get("ros")  # None when they are wrong themselves
    if value is not None:
        return value
    if names is not None and not _leaves_out(names):
        raise PydanticCustomError("missing", "is needed")
    return "mqtt"


def _leaves_out(names: str | tuple[str, ...]) -> bool:
    """Whether nothing is wanted, only left out."""
    return all(name.startswith("!") for name in ([names] if isinstance(names, str) else names))


def _check_response_information(value: str) -> str:
    if not value or any(char in value for char in "+#\0"):
        raise ValueError("must be the beginning of an MQTT topic, without '+' and '#'")
    return value


def _check_field(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*", value, re.ASCII):
        raise ValueError(f"{value!r} is not the path of a field, such as linear.x")
    return value


def _check_clamp(value: object) -> object:
    for path, bounds in value.items() if isinstance(value, dict) else ():
        is_pair = isinstance(bounds, (list, tuple)) and len(bounds) == 2
        if not is_pair or any(
            isinstance(x, bool) or not isinstance(x, (int, float)) for x in bounds
        ):
            raise ValueError(f"{path} must have its least and its most, such as [-0.5, 0.5]")
        if not -math.inf < bounds[0] <= bounds[1] < math.inf:
            raise ValueError(f"{path} must have its least before its most")
    return value


def _check_allow(value: object) -> object:
    for path, values in value.items() if isinstance(value, dict) else ():
        if not isinstance(values, list) or not values:
            raise ValueError(f"{path} must have a list of the values that are allowed")
        if not all(isinstance(x, (bool, int, float, str)) for x in values):
            raise ValueError(f"{path} can have only text, numbers, true and false")
    return value


def _check_message(value: object) -> object:
    try:
        json.dumps(value)
    except TypeError:  # a date, most likely, which YAML makes of 2024-01-01
        raise ValueError("has a value that JSON does not know; put text in quotes") from None
    return value


def _check_plugins(value: object) -> object:
    if not isinstance(value, dict):
        return value
    for name in value:
        if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", name):
            raise ValueError(
                f"{name!r} must be the full path of a plugin class: package.module.Class"
            )
    # A plugin without settings is written with nothing after its colon.
    return {name: {} if settings is None else settings for name, settings in value.items()}


def _unquoted_off(value: object) -> object:
    return "off" if value is False else value  # off is a boolean in YAML 1.1


def _unquoted_version(value: object) -> object:
    return str(value) if isinstance(value, float) else value


def _or_auto(value: object) -> object:
    return "auto" if value is None else value


Size = Annotated[int, BeforeValidator(parse_size), PlainSerializer(format_size, when_used="json")]
Duration = Annotated[
    float, BeforeValidator(_parse_seconds), PlainSerializer(format_duration, when_used="json")
]
Address = Annotated[Bind, PlainValidator(_parse_address), PlainSerializer(str, when_used="json")]
Mode = Annotated[
    int,
    PlainValidator(_parse_mode),
    PlainSerializer(lambda mode: f"{mode:04o}", when_used="json", return_type=str),
]
# Defaults of paths are validated as well: that is what makes them relative to the file.
FilePath = Annotated[Path, PlainValidator(_parse_path), Field(validate_default=True)]
OptionalPath = Annotated[Path | None, PlainValidator(_parse_optional_path)]
Qos = Annotated[int | None, PlainValidator(_parse_qos), PlainSerializer(_or_auto, when_used="json")]
Retain = Annotated[
    bool | None, PlainValidator(_parse_retain), PlainSerializer(_or_auto, when_used="json")
]
Keep = Annotated[int | Literal["latest"], PlainValidator(_parse_keep)]
ClientCertificates = Annotated[
    Literal["off", "optional", "required"], BeforeValidator(_unquoted_off)
]
TlsVersion = Annotated[Literal["1.2", "1.3"], BeforeValidator(_unquoted_version)]
Count = Annotated[int, Field(ge=1)]
_LISTED = PlainSerializer(lambda names: names if isinstance(names, str) else list(names))
RosNames = Annotated[str | tuple[str, ...], PlainValidator(_parse_ros_names), _LISTED]
ParameterNames = Annotated[str | tuple[str, ...], PlainValidator(_parse_parameters), _LISTED]
FieldPath = Annotated[str, AfterValidator(_check_field)]
Encoding = Literal["json", "cbor", "text", "cdr", "ros1", "binary"]
CallEncoding = Literal["json", "cbor", "cdr", "ros1"]
Direction = Literal["mqtt", "ros", "both"]
QueueFull = Literal["refuse", "drop-oldest", "disconnect"]
Level = Literal["debug", "info", "warning", "error"]


# Settings


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


def _section() -> Any:
    # An empty mapping that is validated, and not a ready section: so its paths see the context.
    return Field(default={}, validate_default=True)


class Listener(_Section):
    """One address that clients connect to, with or without TLS; `mode` is for a Unix socket.

    What is None of `client_certificates`, `min_version` and `ciphers` is as `broker.tls` says.
    """

    bind: Address
    tls: bool = False
    protocol: Literal["mqtt", "websocket"] = "mqtt"
    client_certificates: ClientCertificates | None = None
    min_version: TlsVersion | None = None
    ciphers: str | None = None
    mode: Mode = 0o660

    @property
    def is_mqtts(self) -> bool:
        """Whether a plain MQTT client with TLS connects to it."""
        return self.tls and self.protocol == "mqtt"

    @field_validator("tls")
    @classmethod
    def _check_tls(cls, tls: bool, info: ValidationInfo) -> bool:
        bind = info.data.get("bind")  # None when it is wrong itself
        if tls and bind is not None and bind.path is not None:
            raise ValueError("must be false for a Unix socket: nobody can listen in on it")
        return tls


class Tls(_Section):
    """The server's certificate, whose client certificates are accepted, and what they are for.

    Without `crl` it is `ca.crl` beside `ca`, if there is one.
    """

    certificate: FilePath = Path("certs/server.crt")
    key: FilePath = Path("certs/server.key")
    ca: FilePath = Path("certs/ca.crt")
    crl: Annotated[Path, PlainValidator(_parse_path)] | None = None
    client_certificates: ClientCertificates = "optional"
    username_from: Literal["none", "subject", "san"] = "none"
    min_version: TlsVersion = "1.2"
    ciphers: str | None = None


class Limits(_Section):
    """What one client, and all together, may use. Sizes in bytes, times in seconds."""

    connections: Count = 1000
    connections_per_address: Count = 250
    connection_rate: Count = 100
    failed_logins: Count = 30
    packet_size: Annotated[Size, Field(ge=128, le=PACKET_SIZE_MAX)] = 16 << 20
    memory: Annotated[Size, Field(ge=1 << 10)] = 256 << 20
    queue_messages: Count = 1000
    queue_bytes: Annotated[Size, Field(ge=1)] = 16 << 20
    queue_full: QueueFull = "refuse"
    keep: Keep = "latest"
    publish_rate: Count = 100_000
    inflight: Annotated[int, Field(ge=1, le=65535)] = 20
    sessions: Count = 10_000
    subscriptions: Count = 1000
    topic_length: Annotated[Size, Field(ge=1, le=65535)] = 65535
    topic_levels: Annotated[int, Field(ge=1, le=32768)] = 201
    retained_messages: Annotated[int, Field(ge=0)] = 100_000
    retained_bytes: Annotated[Size, Field(ge=0)] = 64 << 20
    connect_timeout: Annotated[Duration, Field(gt=0)] = 10.0
    session_expiry: Annotated[Duration, Field(ge=0, lt=0xFFFF_FFFF)] = 7 * 86400.0
    keep_alive: Annotated[Duration, Field(ge=1, le=65535)] = 65535.0
    topic_alias: Annotated[int, Field(ge=0, le=65535)] = 10


class PluginAnswers(_Section):
    """How long plugins may take, and for how long and how many of their answers hold."""

    timeout: Annotated[Duration, Field(gt=0)] = 5.0
    keep: Annotated[Duration, Field(ge=0)] = 10.0
    keep_refusals: Annotated[Duration, Field(ge=0)] = 2.0
    size: Count = 4096


class AuditLog(_Section):
    """Where is written who connected, was refused and changed what; None for nowhere."""

    path: OptionalPath = None
    size: Annotated[Size, Field(ge=1 << 10)] = 10 << 20
    keep: Annotated[int, Field(ge=1, le=1000)] = 5


class Store(_Section):
    """Where sessions and retained messages are kept; `size` is in bytes, `age` in seconds."""

    path: FilePath = Path("state/store.db")
    durability: Literal["power", "process", "off"] = "power"
    size: Annotated[Size, Field(ge=1 << 20)] = 1 << 30
    age: Annotated[Duration, Field(gt=0)] | None = None


class Broker(_Section):
    """The MQTT broker: where it listens, who may come in, what may be used up."""

    listeners: list[Listener] = Field(
        default=[
            Listener(bind=Bind("0.0.0.0", 8883), tls=True),
            Listener(bind=Bind("127.0.0.1", 1883)),
        ],
        min_length=1,
    )
    users: FilePath = Path("users.passwd")
    acl: FilePath = Path("acl.conf")
    anonymous: bool = False
    tls: Tls = _section()
    limits: Limits = _section()
    audit: AuditLog = _section()
    store: Store = _section()
    check_payload_format: bool = False
    reason_strings: bool = False
    response_information: Annotated[str, AfterValidator(_check_response_information)] | None = None
    sys_interval: Annotated[Duration, Field(ge=0)] = 10.0
    plugins: Annotated[
        dict[str, dict[str, Any]], BeforeValidator(_check_plugins), Field(repr=False)
    ] = {}
    plugin_answers: PluginAnswers = _section()

    def client_certificates(self, listener: Listener) -> Literal["off", "optional", "required"]:
        """Whether that listener asks its clients for one."""
        if listener.client_certificates is not None:
            return listener.client_certificates
        # Asked for a certificate that it does not have, a browser gives a WebSocket up.
        if listener.protocol == "websocket" and self.tls.client_certificates == "optional":
            return "off"
        return self.tls.client_certificates


class RouteDefaults(_Section):
    """What a route does unless it says otherwise: rate in Hz, None for no limit; None is auto.

    `compression` is of payloads, and named to clients in the user property `content-encoding`.
    """

    encoding: Encoding = "json"
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    bytes_per_second: Annotated[Size, Field(gt=0)] | None = None
    compression: Literal["none", "zstd"] = "none"
    qos: Qos = None
    retain: Retain = None
    keep: Keep = "latest"


class OnSilence(_Section):
    """The stop message of a route to ROS, and when it is published; `after` in seconds."""

    after: Annotated[Duration, Field(gt=0)]
    publish: Annotated[dict[str, Any], BeforeValidator(_check_message)] = {}
    disconnect: bool = True


class Route(_Section):
    """What is bridged, by its name on ROS, and where it is on MQTT.

    `ros` is a name, a pattern, or a list of these in which `!` leaves some out again. A route of
    which nothing else is said but what is left out holds for all patterns of its section.
    """

    ros: RosNames
    mqtt: Annotated[str, AfterValidator(_check_topic_template)] = "{robot}{ros}"

    @property
    def names(self) -> tuple[str, ...]:
        """`ros`, as many as there are."""
        return (self.ros,) if isinstance(self.ros, str) else self.ros

    @property
    def is_exclusion(self) -> bool:
        """Whether it only says what the other routes of its section leave out."""
        return _leaves_out(self.ros)

    @property
    def is_pattern(self) -> bool:
        """Whether the route is for many names."""
        return not self.is_exclusion and (len(self.names) > 1 or "*" in self.names[0])

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        every: dict[str, Any] = serialize(self)
        return {"ros": every["ros"]} if self.is_exclusion else every

    def topic(self, robot: str) -> str:
        """The MQTT topic of this route on that robot; that of many names keeps `{ros}` in it."""
        topic = self.mqtt.replace("{robot}", robot)
        return topic if self.is_pattern else topic.replace("{ros}", self.names[0])


class TopicRoute(RouteDefaults, Route):
    """One ROS topic that is carried to MQTT, from MQTT, or both ways; or many of them.

    What is under COMMAND_KEYS holds for what goes to ROS; times in seconds.
    """

    to: Annotated[Direction, BeforeValidator(_check_direction)] = Field(None, validate_default=True)
    type: Annotated[str, AfterValidator(_check_ros_type)] | None = None
    fields: list[FieldPath] = []
    expire: Annotated[Duration, Field(gt=0)] | None = None
    take_retained: bool = False
    exclusive: bool = False
    lease: Annotated[Duration, Field(gt=0)] = 2.0
    on_silence: OnSilence | None = None
    clamp: Annotated[dict[FieldPath, list[float]], BeforeValidator(_check_clamp)] = {}
    allow: Annotated[
        dict[FieldPath, list[bool | int | float | str]], BeforeValidator(_check_allow)
    ] = {}

    @property
    def command_keys(self) -> list[str]:
        """Those of COMMAND_KEYS that say something else than their default."""
        fields = TopicRoute.model_fields
        return [key for key in COMMAND_KEYS if getattr(self, key) != fields[key].default]


class _CalledRoute(Route):
    """What every route has that is called; `timeout` in seconds."""

    timeout: Annotated[Duration, Field(gt=0)] = 5.0


class ServiceRoute(_CalledRoute):
    """ROS services that MQTT clients call, or one that they answer (`to: mqtt`)."""

    to: Literal["ros", "mqtt"] = "ros"
    type: Annotated[str, AfterValidator(_check_service_type)] | None = None
    encoding: CallEncoding = "json"
    on_error: Annotated[dict[str, Any], BeforeValidator(_check_response)] | None = None


class ActionRoute(_CalledRoute):
    """ROS actions for MQTT clients; `keep_result` in seconds."""

    type: Annotated[str, AfterValidator(_check_action_type)] | None = None
    encoding: CallEncoding = "json"
    keep_result: Annotated[Duration, Field(ge=0)] = 60.0
    cancel: Literal["own", "any"] = "own"
    cancel_on_disconnect: bool = False


class ParameterRoute(_CalledRoute):
    """Parameters of ROS nodes, for MQTT clients to read and set: `/node/parameter`."""

    ros: ParameterNames
    mqtt: Annotated[str, AfterValidator(_check_node_topic)] = "{robot}{node}/_param"
    encoding: Literal["json", "cbor"] = "json"

    @property
    def is_pattern(self) -> bool:
        """Whether the route is for many nodes."""
        nodes = {name.rpartition("/")[0] for name in self.names if not name.startswith("!")}
        return len(nodes) > 1 or any("*" in node for node in nodes)

    def topic(self, robot: str) -> str:
        """The MQTT topic on that robot; the node's name is still to be filled in."""
        return self.mqtt.replace("{robot}", robot)


class BridgeLimits(_Section):
    """Calls and goals under way: of one client, and of all together; and what one message for ROS
    may have, in bytes."""

    calls: Count = 500
    calls_per_client: Count = 20
    payload: Annotated[Size, Field(gt=0)] = 1 << 20


class Bridge(_Section):
    """The way between the robot's bus and the broker; `diagnostics` in seconds, 0 for none."""

    bus: Literal["ros2", "ros1", "none"] = "ros2"
    node: Annotated[str, AfterValidator(_check_node)] = "appliance"
    namespace: Annotated[str, AfterValidator(_check_namespace)] = "/"
    domain_id: Annotated[int, Field(ge=0, le=232)] | None = None
    ros_arguments: Annotated[list[str], AfterValidator(_check_ros_arguments)] = []
    use_sim_time: bool = False
    diagnostics: Annotated[Duration, Field(ge=0)] = 1.0
    defaults: RouteDefaults = _section()
    topics: list[Annotated[TopicRoute, BeforeValidator(_from_names)]] = []
    services: list[Annotated[ServiceRoute, BeforeValidator(_from_names)]] = []
    actions: list[Annotated[ActionRoute, BeforeValidator(_from_names)]] = []
    parameters: list[Annotated[ParameterRoute, BeforeValidator(_from_names)]] = []
    limits: BridgeLimits = _section()

    @field_validator("topics")
    @classmethod
    def _take_defaults(cls, topics: list[TopicRoute], info: ValidationInfo) -> list[TopicRoute]:
        defaults = info.data.get("defaults")
        if defaults is None:  # they are wrong themselves, and that is told
            return topics
        shared = {name: getattr(defaults, name) for name in RouteDefaults.model_fields}
        return [
            route
            if route.is_exclusion
            else route.model_copy(
                update={k: v for k, v in shared.items() if k not in route.model_fields_set}
            )
            for route in topics
        ]


class Log(_Section):
    """What is logged and how; `levels` has a level for each logger named, such as appliance.ros."""

    level: Level = "info"
    format: Literal["human", "json"] = "human"
    levels: dict[str, Level] = {}


class Settings(_Section):
    """All of appliance.yaml."""

    robot: Annotated[str, AfterValidator(_check_robot)] = "robot"
    broker: Broker = _section()
    bridge: Bridge = _section()
    log: Log = _section()
    control: FilePath = Path("state/control.sock")
    reload_on_change: bool = True
    crash_reports: OptionalPath = Field(Path("state/crashes"), validate_default=True)
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """The file these settings were read from; None when they were made in code."""
        return self._file


# Reading


def find(path: Path | None = None) -> Path:
    """The configuration file to use: `path`, else the first of SEARCH_PATH. Raises ConfigError."""
    for candidate in (path,) if path else SEARCH_PATH:
        try:
            if candidate.is_file():
                return candidate
        except PermissionError:
            text = "may not be looked at: run this as the appliance's user, or as root"
            raise ConfigError([Problem(candidate, 0, "", text)]) from None
    missing = path or SEARCH_PATH[0]
    places = "no such file" if path else f"not found, nor {SEARCH_PATH[1]}"
    raise ConfigError([Problem(missing, 0, "", f"{places}; `appliance init` writes one")])


def load(path: Path | None = None) -> Settings:
    """The settings of that file, or of the first of SEARCH_PATH. Raises ConfigError.

    Those of the service are read with its variables, too: a shell of its administrator has none.
    """
    file = find(path)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise ConfigError([Problem(file, 0, "", f"cannot be read: {reason}")]) from None
    return loads(text, file, {**of_service(file), **os.environ})


def load_control(path: Path | None = None) -> Settings:
    """The defaults, with nothing but `control` of a file that `load` finds something wrong with.

    The running one goes on with what it has read before, and can still be asked.
    """
    text, file = "", path or SEARCH_PATH[0]
    with suppress(ConfigError, OSError):
        file = find(path)
        found = re.search(r"^control:.*", file.read_text(encoding="utf-8", errors="replace"), re.M)
        text = found[0] if found else ""
        return loads(text, file, {**of_service(file), **os.environ})
    return loads("", file)


def loads(text: str, file: Path, environment: Mapping[str, str] | None = None) -> Settings:
    """The settings in `text`; `file` names it in errors and is what paths are relative to."""
    document = Document(text, file, os.environ if environment is None else environment)
    problems = document.problems
    try:
        settings = Settings.model_validate(
            document.values, context={"directory": file.absolute().parent}
        )
    except ValidationError as error:
        for detail in error.errors(include_url=False):
            if detail["loc"] not in document.faulty:
                path = _place(detail)
                problems.append(document.problem(path, _explain(detail, document.written(path))))
    else:
        problems += [document.problem(path, what) for path, what in _cross_check(settings)]
        settings._file = file.absolute()
    if problems:
        raise ConfigError(sorted(problems, key=lambda problem: problem.line))
    return settings


def _way(route: TopicRoute, robot: str) -> tuple[str | tuple[str, ...], str | None, str]:
    """What two routes must not have in common; patterns may differ in the type alone."""
    return route.ros, route.type if route.is_pattern else None, route.topic(robot)


def _cross_check(settings: Settings) -> Iterator[tuple[KeyPath, str]]:
    seen: dict[Bind, int] = {}
    for number, listener in enumerate(settings.broker.listeners):
        first = seen.setdefault(listener.bind, number)
        if first != number and (listener.bind.port or listener.bind.path):
            path = ("broker", "listeners", number, "bind")
            yield path, f"broker.listeners[{first}] listens there already"
    tls = settings.broker.tls
    if tls.username_from != "none" and not any(
        listener.tls and settings.broker.client_certificates(listener) != "off"
        for listener in settings.broker.listeners
    ):
        problem = "needs a listener with tls: true that asks for client certificates"
        yield ("broker", "tls", "username_from"), problem
    yield from _cross_check_routes(settings.bridge)
    ways: dict[tuple[str | tuple[str, ...], str | None, str], int] = {}
    for number, route in enumerate(settings.bridge.topics):
        if route.is_exclusion:
            continue
        first = ways.setdefault(_way(route, settings.robot), number)
        if route.to == "mqtt":
            for key in route.command_keys:
                yield ("bridge", "topics", number, key), "is for routes to ROS only"
        elif "lease" in route.command_keys and not route.exclusive:
            yield ("bridge", "topics", number, "lease"), "needs exclusive: true beside it"
        if first != number:
            yield ("bridge", "topics", number, "ros"), f"is the same way as bridge.topics[{first}]"
    yield from _cross_check_called(settings.bridge)
    yield from _cross_check_bus(settings.bridge)


def _cross_check_bus(bridge: Bridge) -> Iterator[tuple[KeyPath, str]]:
    """What ROS 1 and ROS 2 do not have in common."""
    is_ros1 = bridge.bus == "ros1"
    foreign, own = ("cdr", "ros1") if is_ros1 else ("ros1", "cdr")
    sections: tuple[tuple[str, Sequence[TopicRoute | ServiceRoute | ActionRoute]], ...] = (
        ("topics", bridge.topics),
        ("services", bridge.services),
        ("actions", bridge.actions),
    )
    for section, routes in sections:
        for number, route in enumerate(routes):
            if route.encoding == foreign and not route.is_exclusion:
                text = f"must be {own}: that is what ROS's own bytes are with bus: {bridge.bus}"
                yield ("bridge", section, number, "encoding"), text
    for number, parameter in enumerate(bridge.parameters):
        if not is_ros1 and any(name.rpartition("/")[0] in ("", "!") for name in parameter.names):
            yield ("bridge", "parameters", number, "ros"), OF_NODE
    ros2_only = {"domain_id": bridge.domain_id is not None, "use_sim_time": bridge.use_sim_time}
    for key, is_set in ros2_only.items():
        if is_ros1 and is_set:
            instead = "ROS_MASTER_URI" if key == "domain_id" else "the parameter /use_sim_time"
            yield ("bridge", key), f"is for ROS 2 only; in ROS 1 it is {instead}"


def _cross_check_routes(bridge: Bridge) -> Iterator[tuple[KeyPath, str]]:
    """What holds for the routes of every section."""
    sections: dict[str, Sequence[Route]] = {
        "topics": bridge.topics,
        "services": bridge.services,
        "actions": bridge.actions,
        "parameters": bridge.parameters,
    }
    for section, routes in sections.items():
        placeholder = "{node}" if section == "parameters" else "{ros}"
        has_pattern = any("*" in name for route in routes for name in route.names if name[0] != "!")
        for number, route in enumerate(routes):
            path: KeyPath = ("bridge", section, number)
            if route.is_exclusion:
                more = sorted(route.model_fields_set - {"ros"})
                for key in more:
                    yield (*path, key), "has no meaning for what is left out"
                if not (more or has_pattern):
                    problem = f"leaves nothing out: there is no pattern in bridge.{section}"
                    yield (*path, "ros"), problem
            elif route.is_pattern and placeholder not in route.mqtt:
                problem = f"needs {placeholder} in it, or all that the route is for would be one"
                yield (*path, "mqtt"), problem


def _cross_check_called(bridge: Bridge) -> Iterator[tuple[KeyPath, str]]:
    sections: dict[str, Sequence[ServiceRoute | ActionRoute | ParameterRoute]] = {
        "services": bridge.services,
        "actions": bridge.actions,
        "parameters": bridge.parameters,
    }
    for section, routes in sections.items():
        seen: dict[str, int] = {}
        topics: dict[str, tuple[str, int]] = {}
        for number, route in enumerate(routes):
            path: KeyPath = ("bridge", section, number)
            for name in route.names:
                base = name.rpartition("/")[0] if section == "parameters" else name
                if name.startswith("!") or "*" in base:
                    continue
                topic = route.mqtt.replace("{node}", base).replace("{ros}", base)
                other, taken = topics.setdefault(topic, (base, number))
                if other != base:
                    yield (*path, "mqtt"), f"is the topic of bridge.{section}[{taken}]"
            for position, name in enumerate(route.names):
                if name.startswith("!") and not route.is_exclusion:
                    continue
                first = seen.setdefault(name, number)
                if first != number:
                    where: KeyPath = () if isinstance(route.ros, str) else (position,)
                    yield (*path, "ros", *where), f"is the same as in bridge.{section}[{first}]"
            kind = None if isinstance(route, ParameterRoute) else route.type
            if kind is not None and "*" in kind and not route.is_pattern:
                yield (*path, "type"), "can be a pattern only when ros is one"
            if isinstance(route, ServiceRoute) and route.to == "mqtt":
                if route.is_pattern:
                    yield (*path, "to"), "must be ros when ros is a pattern or a list"
                elif route.type is None and not route.is_exclusion:
                    yield (*path, "type"), "is needed when to is mqtt"
            elif isinstance(route, ServiceRoute) and route.on_error is not None:
                yield (*path, "on_error"), "is for services that MQTT answers: to: mqtt"


def _place(detail: ErrorDetails) -> KeyPath:
    """The path of what is wrong, down to the entry of a list that was checked as a whole."""
    error = detail.get("ctx", {}).get("error")
    return (*detail["loc"], error.position) if isinstance(error, _InListError) else detail["loc"]


_PLAIN = {
    "missing": "is needed",
    "string_type": "must be text (in quotes, when it looks like a number or a yes or no)",
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "bool_type": "must be true or false",
    "list_type": "must be a list",
    "dict_type": "must be keys with values",
    "model_type": "must be keys with values",
}
_BOUNDS = {
    "greater_than": ("gt", "must be more than"),
    "greater_than_equal": ("ge", "must be at least"),
    "less_than": ("lt", "must be less than"),
    "less_than_equal": ("le", "must be at most"),
}


def _explain(detail: ErrorDetails, written: str | None) -> str:
    """One of pydantic's errors in this project's words, with what was written, masked."""
    kind, path, context = detail["type"], detail["loc"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        known = list(_section_at(path[:-1]).model_fields)
        return f"unknown key{_did_you_mean(str(path[-1]), known) or '; known: ' + ', '.join(known)}"
    if kind == "missing":
        return _PLAIN[kind]
    if kind == "value_error":
        what = str(context["error"])
    elif kind == "literal_error":
        choices = re.findall(r"'([^']*)'", context["expected"])
        what = f"must be {_either(choices)}{_did_you_mean(str(detail['input']), choices)}"
    elif kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        what = f"{words} {_with_unit(context[name], path)}"
    elif kind == "too_short":
        what = f"must have at least {context['min_length']}"
    else:
        what = _PLAIN.get(kind, detail["msg"])
    return what if written is None else f"{what} (it says {mask(path, written)!r})"


def _section_at(path: KeyPath) -> type[BaseModel]:
    """The model that describes the mapping at that path."""

    def models(annotation: Any) -> Iterator[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        for argument in get_args(annotation):
            yield from models(argument)

    section: type[BaseModel] = Settings
    for part in path:
        if isinstance(part, str):
            section = next(models(section.model_fields[part].annotation))
    return section


def _with_unit(value: float, path: KeyPath) -> str:
    *around, name = path
    for item in _section_at(tuple(around)).model_fields[str(name)].metadata:
        if item == BeforeValidator(parse_size):
            return format_size(int(value))
        if item == BeforeValidator(_parse_seconds):
            return format_duration(value)
    return f"{value:g}"


def _did_you_mean(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _either(words: Sequence[str]) -> str:
    return " or ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)


# Printing


def mask(path: KeyPath, value: Any) -> Any:
    """The value as it may be printed: masked when its key or its form says that it is a secret."""
    if isinstance(value, Mapping):
        return {key: mask((*path, key), inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [mask(path, inner) for inner in value]
    if any(isinstance(part, str) and _SECRET_KEY.search(part) for part in path[-1:]) and value:
        return MASK
    return _URL_PASSWORD.sub(rf"\1:{MASK}", value) if isinstance(value, str) else value


def secrets_in(value: Any, path: KeyPath = ()) -> Iterator[str]:
    """All that `mask` hides in a value, to be kept out of what others say about it."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from secrets_in(inner, (*path, key))
    elif isinstance(value, (list, tuple)):
        for inner in value:
            yield from secrets_in(inner, path)
    elif path and isinstance(path[-1], str) and _SECRET_KEY.search(path[-1]):
        if value:
            yield str(value)
    elif isinstance(value, str):
        for match in _URL_PASSWORD.finditer(value):
            yield match[0].partition(":")[2]


def is_open_with_secrets(settings: Settings) -> bool:
    """Whether every user of this computer can read secrets in the file of these settings."""
    if settings.file is None:
        return False
    try:
        if not settings.file.stat().st_mode & 0o004:
            return False
        text = settings.file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    # What an environment variable has put there is not in the file.
    return any(secret in text for secret in secrets_in(settings.broker.plugins))


def describe(settings: Settings) -> dict[str, Any]:
    """Every setting in force as plain values, in the form of appliance.yaml, secrets masked."""
    described: dict[str, Any] = mask((), settings.model_dump(mode="json"))
    return described
