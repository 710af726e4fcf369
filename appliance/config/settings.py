"""The sections of appliance.yaml: each key with its type, range and default."""

from __future__ import annotations

import time
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
)

from appliance.broker.limits import Anonymous, Features, Limits, Terms, UserLimits
from appliance.config.quantities import (
    Address,
    Bind,
    Duration,
    FilePath,
    Mode,
    OptionalPath,
    Size,
    parse_path,
)
from appliance.config.urls import Proxy, Server
from appliance.config.values import (
    CallEncoding,
    ClientCertificates,
    Count,
    Direction,
    Encoding,
    FieldPath,
    Keep,
    Level,
    ParameterNames,
    ProtocolVersion,
    Qos,
    QueueFull,
    Retain,
    RosNames,
    SpokenVersion,
    TlsVersion,
    ValueEncoding,
    Vda5050Version,
    check_action_type,
    check_allow,
    check_clamp,
    check_client_id,
    check_client_id_prefix,
    check_direction,
    check_fleet_prefix,
    check_login_name,
    check_message,
    check_namespace,
    check_node,
    check_node_topic,
    check_plugins,
    check_relative_filter,
    check_response_information,
    check_robot,
    check_ros_arguments,
    check_ros_type,
    check_service_type,
    check_topic_prefix,
    check_topic_template,
    check_vda5050_level,
    check_vda5050_serial_number,
    excludes_only,
    from_names,
    vda5050_in_full,
)
from appliance.mqtt.codec import VERSION_NAMES

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DataclassT = TypeVar("DataclassT", bound="DataclassInstance")

PACKET_SIZE_MAX = 255 << 20
"""Below the largest Remaining Length of MQTT (section 1.5.5: four bytes of 7 bits), because a
packet may grow by some properties on its way from one client to another."""

COMMAND_KEYS = (
    "expire",
    "take_retained",
    "exclusive",
    "lease",
    "on_silence",
    "clamp",
    "allow",
)
"""Keys of a route that restrict when a command may reach ROS, and with which values."""

MQTT_KEYS = ("fields", "rate", "bytes_per_second", "qos", "retain", "quality", "max_width")
"""Keys of a route that apply to what is published on MQTT, and not to ROS."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    def build(self, kind: type[DataclassT], **values: Any) -> DataclassT:
        """The dataclass that another part takes its settings in.

        `values` are the fields that differ from this section in name or type; every other field
        gets the key of the same name. So a setting is declared here and in that dataclass, and not
        copied in a third place.
        """
        named = {each.name for each in fields(kind)} - values.keys()
        return kind(**{name: getattr(self, name) for name in named}, **values)


def _section() -> Any:
    # The default is a mapping that gets validated, so that paths in it see the context.
    return Field(default={}, validate_default=True)


class Listener(_Section):
    """One listening address, with or without TLS; `mode` is that of a Unix socket.

    `client_certificates`, `min_version` and `ciphers` default to those of `broker.tls`, and
    `anonymous` to `broker.anonymous`. Without `client_id_prefixes` any id will do.
    """

    bind: Address
    tls: bool = False
    protocol: Literal["mqtt", "websocket", "web"] = "mqtt"
    client_certificates: ClientCertificates | None = None
    min_version: TlsVersion | None = None
    ciphers: str | None = None
    mode: Mode = 0o660
    anonymous: bool | Literal["always"] | None = None
    max_qos: Annotated[int, Field(ge=0, le=2)] = 2
    retain: bool = True
    protocol_versions: Annotated[list[SpokenVersion], Field(min_length=1)] = ["3.1", "3.1.1", "5"]
    client_id_prefixes: list[Annotated[str, AfterValidator(check_client_id_prefix)]] = []

    def terms(self) -> Terms:
        """What it admits, and whom, as the broker enforces it."""
        numbers = {name: number for number, name in VERSION_NAMES.items()}
        return self.build(
            Terms,
            versions=frozenset(numbers[name] for name in self.protocol_versions),
            client_id_prefixes=tuple(self.client_id_prefixes),
        )

    @property
    def is_mqtts(self) -> bool:
        """Whether it is MQTT over TLS, without WebSocket."""
        return self.tls and self.protocol == "mqtt"

    @property
    def is_web_over_tls(self) -> bool:
        """Whether it has the console, where a browser may ask for a password."""
        return self.tls and self.protocol == "web"

    @field_validator("tls")
    @classmethod
    def _check_tls(cls, tls: bool, info: ValidationInfo) -> bool:
        bind = info.data.get("bind")  # None when `bind` is invalid itself
        if tls and bind is not None and bind.path is not None:
            raise ValueError("must be false for a Unix socket: nobody can listen in on it")
        return tls

    @field_validator("anonymous")
    @classmethod
    def _check_anonymous(cls, anonymous: Anonymous, info: ValidationInfo) -> Anonymous:
        if anonymous == "always" and info.data.get("protocol") == "web":
            raise ValueError("must not be always for the web, where people log in")
        return anonymous


class TlsSection(_Section):
    """The server's certificate, the CA of accepted client certificates, and their use.

    `crl` defaults to `ca.crl` in the directory of `ca`, if that exists.
    """

    certificate: FilePath = Path("certs/server.crt")
    key: FilePath = Path("certs/server.key")
    ca: FilePath = Path("certs/ca.crt")
    crl: Annotated[Path, PlainValidator(parse_path)] | None = None
    client_certificates: ClientCertificates = "optional"
    username_from: Literal["none", "subject", "san"] = "none"
    min_version: TlsVersion = "1.2"
    ciphers: str | None = None


class UserLimitsSection(_Section):
    """Limits of one user within those of all clients; None: as much as others leave free."""

    connections: Count | None = None
    sessions: Count | None = None
    memory: Annotated[Size, Field(ge=1 << 10)] | None = None
    retained_messages: Annotated[int, Field(ge=0)] | None = None
    retained_bytes: Annotated[Size, Field(ge=0)] | None = None
    stored: Annotated[Size, Field(ge=0)] | None = None


#: The broker's own defaults.
_LIMITS = Limits()


class LimitsSection(_Section):
    """Limits of one client and of all together. Sizes in bytes, times in seconds."""

    connections: Count = _LIMITS.connections
    connections_per_address: Count = 250
    connection_rate: Count = 100
    failed_logins: Count = 30
    packet_size: Annotated[Size, Field(ge=128, le=PACKET_SIZE_MAX)] = _LIMITS.packet_size
    payload_size: Annotated[Size, Field(ge=1)] | None = None
    memory: Annotated[Size, Field(ge=1 << 10)] = _LIMITS.memory
    queue_messages: Count = _LIMITS.queue_messages
    queue_bytes: Annotated[Size, Field(ge=1)] = _LIMITS.queue_bytes
    queue_full: QueueFull = "refuse"
    keep: Keep = "latest"
    publish_rate: Count = 100_000
    inflight: Annotated[int, Field(ge=1, le=65535)] = _LIMITS.inflight
    sessions: Count = _LIMITS.sessions
    subscriptions: Count = _LIMITS.subscriptions
    client_id_length: Annotated[Size, Field(ge=23, le=65535)] = _LIMITS.client_id_length
    topic_length: Annotated[Size, Field(ge=1, le=65535)] = _LIMITS.topic_length
    topic_levels: Annotated[int, Field(ge=1, le=32768)] = _LIMITS.topic_levels
    retained_messages: Annotated[int, Field(ge=0)] = _LIMITS.retained_messages
    retained_bytes: Annotated[Size, Field(ge=0)] = _LIMITS.retained_bytes
    connect_timeout: Annotated[Duration, Field(gt=0)] = 10.0
    session_expiry: Annotated[Duration, Field(ge=0, lt=0xFFFF_FFFF)] = float(_LIMITS.session_expiry)
    keep_alive: Annotated[Duration, Field(ge=1, le=65535)] = float(_LIMITS.keep_alive)
    topic_alias: Annotated[int, Field(ge=0, le=65535)] = _LIMITS.topic_alias
    user_properties: Annotated[int, Field(ge=0, le=10_000)] = _LIMITS.user_properties
    user: UserLimitsSection = _section()

    def of_broker(self) -> Limits:
        """The limits that the broker enforces; listeners and the login throttle have the others."""
        return self.build(
            Limits,
            payload_size=self.payload_size or _LIMITS.payload_size,
            keep=0 if self.keep == "latest" else self.keep,
            session_expiry=round(self.session_expiry),
            keep_alive=round(self.keep_alive),
            user=self.user.build(UserLimits),
        )


class PluginAnswersSection(_Section):
    """The timeout of plugins, and for how long and how many of their answers are cached."""

    timeout: Annotated[Duration, Field(gt=0)] = 5.0
    keep: Annotated[Duration, Field(ge=0)] = 10.0
    keep_refusals: Annotated[Duration, Field(ge=0)] = 2.0
    size: Count = 4096


class AuditSection(_Section):
    """The audit log of connections, refusals and changes; without a path there is none."""

    path: OptionalPath = None
    size: Annotated[Size, Field(ge=1 << 10)] = 10 << 20
    keep: Annotated[int, Field(ge=1, le=1000)] = 5


class StoreSection(_Section):
    """The store of sessions and retained messages; `size` in bytes, `age` in seconds."""

    path: FilePath = Path("state/store.db")
    durability: Literal["power", "process", "off"] = "power"
    size: Annotated[Size, Field(ge=1 << 20)] = 1 << 30
    age: Annotated[Duration, Field(gt=0)] | None = None


class BrokerSection(_Section):
    """The MQTT broker: its listeners, access control and limits."""

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
    mdns: bool = True
    tls: TlsSection = _section()
    limits: LimitsSection = _section()
    audit: AuditSection = _section()
    store: StoreSection = _section()
    check_payload_format: bool = False
    reason_strings: bool = False
    response_information: Annotated[str, AfterValidator(check_response_information)] | None = None
    sys_interval: Annotated[Duration, Field(ge=0)] = 10.0
    plugins: Annotated[
        dict[str, dict[str, Any]], BeforeValidator(check_plugins), Field(repr=False)
    ] = {}
    plugin_answers: PluginAnswersSection = _section()

    def features(self) -> Features:
        """What the MQTT standard leaves to the operator."""
        return self.build(Features, response_information=self.response_information or "")

    def lets_in_anonymous(self, listener: Listener) -> bool:
        """Whether that listener accepts clients without a user name."""
        return bool(self.anonymous if listener.anonymous is None else listener.anonymous)

    def client_certificates(self, listener: Listener) -> Literal["off", "optional", "required"]:
        """Whether that listener requests or requires client certificates."""
        if listener.client_certificates is not None:
            return listener.client_certificates
        # A browser without a certificate that is asked for one gives up the WebSocket.
        if listener.protocol != "mqtt" and self.tls.client_certificates == "optional":
            return "off"
        return self.tls.client_certificates


class RouteDefaults(_Section):
    """Defaults of topic routes. `rate` in Hz, None for no limit; `qos` and `retain`: None is auto.

    `compression` is that of payloads; clients see it in the user property `content-encoding`.
    """

    encoding: Encoding = "json"
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    bytes_per_second: Annotated[Size, Field(gt=0)] | None = None
    compression: Literal["none", "zstd"] = "none"
    qos: Qos = None
    retain: Retain = None
    keep: Keep = "latest"


class OnSilenceSection(_Section):
    """The stop message of a route to ROS, published after `after` seconds without a command."""

    after: Annotated[Duration, Field(gt=0)]
    publish: Annotated[dict[str, Any], BeforeValidator(check_message)] = {}
    disconnect: bool = True


class Route(_Section):
    """A route: names on ROS, and the topic on MQTT.

    `ros` is a name, a pattern, or a list of these, in which `!` excludes names again. A route that
    has only exclusions applies to all patterns of its section.
    """

    ros: RosNames
    mqtt: Annotated[str, AfterValidator(check_topic_template)] = "{robot}{ros}"

    @property
    def names(self) -> tuple[str, ...]:
        """`ros` as a tuple."""
        return (self.ros,) if isinstance(self.ros, str) else self.ros

    @property
    def is_exclusion(self) -> bool:
        """Whether it only has exclusions, for the other routes of its section."""
        return excludes_only(self.ros)

    @property
    def is_pattern(self) -> bool:
        """Whether the route can match several names."""
        return not self.is_exclusion and (len(self.names) > 1 or "*" in self.names[0])

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        every: dict[str, Any] = serialize(self)
        return {"ros": every["ros"]} if self.is_exclusion else every

    def topic(self, robot: str) -> str:
        """The MQTT topic of this route on that robot; a pattern's topic keeps `{ros}`."""
        topic = self.mqtt.replace("{robot}", robot)
        return topic if self.is_pattern else topic.replace("{ros}", self.names[0])


class TopicRoute(RouteDefaults, Route):
    """A route of ROS topics: to MQTT, to ROS, or both ways.

    COMMAND_KEYS apply to messages for ROS; times in seconds. `quality` is JPEG's, `max_width` in
    pixels, None for the width of the image.
    """

    to: Annotated[Direction, BeforeValidator(check_direction)] = Field(None, validate_default=True)
    type: Annotated[str, AfterValidator(check_ros_type)] | None = None
    fields: list[FieldPath] = []
    quality: Annotated[int, Field(ge=1, le=95)] = 80
    max_width: Annotated[int, Field(gt=0)] | None = None
    expire: Annotated[Duration, Field(gt=0)] | None = None
    take_retained: bool = False
    exclusive: bool = False
    lease: Annotated[Duration, Field(gt=0)] = 2.0
    on_silence: OnSilenceSection | None = None
    clamp: Annotated[dict[FieldPath, list[float]], BeforeValidator(check_clamp)] = {}
    allow: Annotated[
        dict[FieldPath, list[bool | int | float | str]], BeforeValidator(check_allow)
    ] = {}

    @property
    def command_keys(self) -> list[str]:
        """The COMMAND_KEYS that differ from their defaults."""
        return self._configured(COMMAND_KEYS)

    @property
    def mqtt_keys(self) -> list[str]:
        """The MQTT_KEYS that differ from their defaults."""
        return self._configured(MQTT_KEYS)

    def _configured(self, keys: tuple[str, ...]) -> list[str]:
        fields = TopicRoute.model_fields
        return [key for key in keys if getattr(self, key) != fields[key].default]


class _CalledRoute(Route):
    """Keys of every route whose names are called; `timeout` in seconds."""

    timeout: Annotated[Duration, Field(gt=0)] = 5.0


class ServiceRoute(_CalledRoute):
    """ROS services that MQTT clients call, or (`to: mqtt`) one that MQTT clients answer."""

    to: Literal["ros", "mqtt"] = "ros"
    type: Annotated[str, AfterValidator(check_service_type)] | None = None
    encoding: CallEncoding = "json"
    on_error: Annotated[dict[str, Any], BeforeValidator(check_message)] | None = None


class ActionRoute(_CalledRoute):
    """ROS actions that MQTT clients send goals to; `keep_result` in seconds."""

    type: Annotated[str, AfterValidator(check_action_type)] | None = None
    encoding: CallEncoding = "json"
    keep_result: Annotated[Duration, Field(ge=0)] = 60.0
    cancel: Literal["own", "any"] = "own"
    cancel_on_disconnect: bool = False


class ParameterRoute(_CalledRoute):
    """Parameters of ROS nodes that MQTT clients read and set: `/node/parameter`."""

    ros: ParameterNames
    mqtt: Annotated[str, AfterValidator(check_node_topic)] = "{robot}{node}/_param"
    encoding: ValueEncoding = "json"

    @property
    def is_pattern(self) -> bool:
        """Whether the route can match several nodes."""
        nodes = {name.rpartition("/")[0] for name in self.names if not name.startswith("!")}
        return len(nodes) > 1 or any("*" in node for node in nodes)

    def topic(self, robot: str) -> str:
        """The MQTT topic on that robot; it keeps `{node}`."""
        return self.mqtt.replace("{robot}", robot)


class BridgeLimitsSection(_Section):
    """Limits of concurrent calls and goals: of all clients, of one user (None: a quarter of these)
    and of one client; and limits of one message for ROS: bytes of JSON or text, and items."""

    calls: Count = 500
    calls_per_user: Count | None = None
    calls_per_client: Count = 20
    payload: Annotated[Size, Field(gt=0)] = 1 << 20
    items: Count = 100_000


class BridgeSection(_Section):
    """The bridge between ROS and the broker; `diagnostics` in seconds, 0 for none."""

    bus: Literal["ros2", "ros1", "none"] = "ros2"
    node: Annotated[str, AfterValidator(check_node)] = "appliance"
    namespace: Annotated[str, AfterValidator(check_namespace)] = "/"
    domain_id: Annotated[int, Field(ge=0, le=232)] | None = None
    discovery: Literal["localhost", "subnet", "environment"] = "environment"
    ros_arguments: Annotated[list[str], AfterValidator(check_ros_arguments)] = []
    use_sim_time: bool = False
    diagnostics: Annotated[Duration, Field(ge=0)] = 1.0
    home_assistant: bool = False
    defaults: RouteDefaults = _section()
    topics: list[Annotated[TopicRoute, BeforeValidator(from_names)]] = []
    services: list[Annotated[ServiceRoute, BeforeValidator(from_names)]] = []
    actions: list[Annotated[ActionRoute, BeforeValidator(from_names)]] = []
    parameters: list[Annotated[ParameterRoute, BeforeValidator(from_names)]] = []
    limits: BridgeLimitsSection = _section()

    @field_validator("topics")
    @classmethod
    def _take_defaults(cls, topics: list[TopicRoute], info: ValidationInfo) -> list[TopicRoute]:
        defaults = info.data.get("defaults")
        if defaults is None:  # they are invalid themselves, which is reported
            return topics
        shared = {name: getattr(defaults, name) for name in RouteDefaults.model_fields}

        def completed(route: TopicRoute) -> TopicRoute:
            own = {*route.model_fields_set, *(MQTT_KEYS if route.to == "ros" else ())}
            return route.model_copy(update={k: v for k, v in shared.items() if k not in own})

        return [route if route.is_exclusion else completed(route) for route in topics]


class UpstreamLoginSection(_Section):
    """How a link authenticates at the fleet's broker; secrets are in files of their own."""

    username: Annotated[str, AfterValidator(check_login_name)] | None = None
    password_file: OptionalPath = None
    token_file: OptionalPath = None
    method: Annotated[str, Field(min_length=1)] | None = None


class UpstreamTlsSection(_Section):
    """TLS of a link: `ca` defaults to the system's, `server_name` to the host in the URL."""

    ca: OptionalPath = None
    certificate: OptionalPath = None
    key: OptionalPath = None
    server_name: Annotated[str, Field(min_length=1)] | None = None
    alpn: list[Annotated[str, Field(min_length=1, max_length=255)]] = []


class BacklogSection(_Section):
    """What waits for a link; `size` in bytes, `age` in seconds."""

    size: Annotated[Size, Field(ge=1 << 20)] = 256 << 20
    age: Annotated[Duration, Field(gt=0)] | None = None
    when_full: Literal["drop-oldest", "refuse"] = "drop-oldest"


class MappedTopicsSection(_Section):
    """A filter, and what is in front of it here and at the fleet's broker.

    `remote_prefix` defaults to the `prefix` of the link.
    """

    topic: Annotated[str, AfterValidator(check_relative_filter)]
    local_prefix: Annotated[str, AfterValidator(check_topic_prefix)] = "{robot}/"
    remote_prefix: Annotated[str, AfterValidator(check_topic_prefix)] | None = None
    _is_added: bool = PrivateAttr(default=False)

    @property
    def is_added(self) -> bool:
        """Whether the profile of the link has added it, and the file does not have it."""
        return self._is_added

    def local_filter(self, robot: str) -> str:
        """The topic filter here."""
        return self.local_prefix.replace("{robot}", robot) + self.topic

    def remote_filter(self, robot: str, prefix: str) -> str:
        """The topic filter at the fleet's broker; `prefix` is that of the link."""
        return self.prefix_there(robot, prefix) + self.topic

    def prefix_there(self, robot: str, prefix: str) -> str:
        """What is in front of the topic at the fleet's broker."""
        own = prefix if self.remote_prefix is None else self.remote_prefix
        return own.replace("{robot}", robot)


MappedT = TypeVar("MappedT", bound=MappedTopicsSection)


class OutSection(MappedTopicsSection):
    """Topics that a link carries to the fleet's broker; `rate` in messages a second.

    `qos` is the most, and `retain` takes the place of what the publisher says; None: as it says.
    """

    keep: Literal["auto", "all", "latest", "none"] = "auto"
    priority: Literal["high", "normal", "low"] = "normal"
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    qos: Annotated[int, Field(ge=0, le=1)] | None = None
    retain: bool | None = None


class InSection(MappedTopicsSection):
    """Topics that a link carries from the fleet's broker; `late` in seconds, None for auto."""

    late: Annotated[Duration, Field(gt=0)] | None = None
    offline: Literal["drop", "keep"] = "drop"
    retained: Literal["take", "drop"] = "take"


class Vda5050Section(_Section):
    """The robot as VDA 5050 names it; `local_prefix` is what its topics have in front here.

    `interface_name` defaults to that of the standard's examples: `uagv`, since 3.0 `vda5050`.
    """

    version: Vda5050Version = "2.1"
    manufacturer: Annotated[str, AfterValidator(check_vda5050_level)]
    serial_number: Annotated[str, AfterValidator(check_vda5050_serial_number)] = "{robot}"
    interface_name: Annotated[str, AfterValidator(check_vda5050_level)] | None = None
    local_prefix: Annotated[str, AfterValidator(check_topic_prefix)] = "{robot}/vda5050/"

    @property
    def major(self) -> int:
        """The major version, on which topics and states depend."""
        return int(self.version.partition(".")[0])

    @property
    def prefix(self) -> str:
        """What its topics have in front there (2.1 section 6.3, 3.0 section 4.2)."""
        interface = self.interface_name or ("uagv" if self.major < 3 else "vda5050")
        return f"{interface}/v{self.major}/{self.manufacturer}/{self.serial_number}/"

    def out(self) -> list[OutSection]:
        """What the robot says, with QoS 0 (2.1 section 6.2, 3.0 section 4.1).

        Each message says all, so that the latest is enough.
        """
        here = self.local_prefix
        return [
            OutSection(topic="state", local_prefix=here, keep="latest", qos=0, priority="high"),
            OutSection(topic="factsheet", local_prefix=here, keep="latest", qos=0, retain=True),
            OutSection(
                topic="visualization", local_prefix=here, keep="latest", qos=0, priority="low"
            ),
        ]

    def inward(self) -> list[InSection]:
        """What the robot is told. A retained order would be an old one, and is dropped."""
        names = ["order", "instantActions", *(["zoneSet", "responses"] if self.major >= 3 else [])]
        return [
            InSection(topic=each, local_prefix=self.local_prefix, retained="drop") for each in names
        ]


class ProfileSection(_Section):
    """A standard that a link speaks: its topics, and how it says that the robot is online."""

    vda5050: Vda5050Section


def _vda5050_of(info: ValidationInfo) -> Vda5050Section | None:
    """The profile of the link whose later keys are validated; None too where it is invalid."""
    profile = info.data.get("profile")
    return None if profile is None else profile.vda5050


def _default_prefix(value: object, info: ValidationInfo) -> object:
    if value is not None:
        return value
    vda5050 = _vda5050_of(info)
    return "fleet/{robot}/" if vda5050 is None else vda5050.prefix


class UpstreamSection(_Section):
    """A link to a fleet's broker; `rate` in messages a second, `keep_alive` in seconds.

    A profile is the default of `prefix`, and adds rules before those of `out` and `in`.
    """

    name: Annotated[str, AfterValidator(check_robot)]
    servers: list[Server] = Field(min_length=1)
    kind: Literal["generic", "aws-iot", "azure-event-grid", "rabbitmq"] = "generic"
    version: ProtocolVersion = "5"
    client_id: Annotated[str, AfterValidator(check_client_id)] = "{robot}"
    user: Annotated[str, Field(min_length=1)] = "upstream"
    profile: Annotated[ProfileSection, BeforeValidator(vda5050_in_full)] | None = None
    prefix: Annotated[str, BeforeValidator(_default_prefix), AfterValidator(check_fleet_prefix)] = (
        Field(None, validate_default=True)
    )
    login: UpstreamLoginSection = _section()
    tls: UpstreamTlsSection = _section()
    proxy: Annotated[Proxy | None, Field(repr=False)] = None
    keep_alive: Annotated[Duration, Field(ge=1, le=65535)] = 30.0
    window: Annotated[int, Field(ge=1, le=65535)] = 1000
    rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    bytes_per_second: Annotated[Size, Field(gt=0)] | None = None
    backlog: BacklogSection = _section()
    out: list[OutSection] = Field(default=[], validate_default=True)
    inward: list[InSection] = Field(  # `in` is a word of Python's
        default=[], alias="in", validate_default=True
    )

    @field_validator("out")
    @classmethod
    def _add_out(cls, rules: list[OutSection], info: ValidationInfo) -> list[OutSection]:
        vda5050 = _vda5050_of(info)
        return rules if vda5050 is None else _with_rules(rules, vda5050.out())

    @field_validator("inward")
    @classmethod
    def _add_inward(cls, rules: list[InSection], info: ValidationInfo) -> list[InSection]:
        vda5050 = _vda5050_of(info)
        return rules if vda5050 is None else _with_rules(rules, vda5050.inward())


def _with_rules(rules: list[MappedT], more: list[MappedT]) -> list[MappedT]:
    """The rules, and before them those of `more` in whose place none of them stands."""
    said = {rule.local_prefix + rule.topic for rule in rules}
    added = [rule for rule in more if rule.local_prefix + rule.topic not in said]
    for rule in added:
        rule._is_added = True
    return [*added, *rules]


class LogSection(_Section):
    """Level and format of the log; `levels` has levels of single loggers, such as appliance.ros."""

    level: Level = "info"
    format: Literal["human", "json"] = "human"
    levels: dict[str, Level] = {}


class Settings(_Section):
    """All of appliance.yaml."""

    robot: Annotated[str, AfterValidator(check_robot)] = "robot"
    broker: BrokerSection = _section()
    bridge: BridgeSection = _section()
    upstreams: list[UpstreamSection] = []
    log: LogSection = _section()
    control: FilePath = Path("state/control.sock")
    reload_on_change: bool = True
    crash_reports: OptionalPath = Field(Path("state/crashes"), validate_default=True)
    _file: Path | None = PrivateAttr(default=None)
    _read_at: float = PrivateAttr(default_factory=time.time)

    @property
    def file(self) -> Path | None:
        """The file that these settings were read from; None when they were made in code."""
        return self._file

    @property
    def read_at(self) -> float:
        """When the file was read, in seconds of `time.time`: what it says now may be newer."""
        return self._read_at
