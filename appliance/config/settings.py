"""The sections of appliance.yaml, each key with its type and default."""

from __future__ import annotations

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

from appliance.broker.ports import Features, Limits, UserLimits
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
    Qos,
    QueueFull,
    Retain,
    RosNames,
    TlsVersion,
    ValueEncoding,
    check_action_type,
    check_allow,
    check_clamp,
    check_direction,
    check_message,
    check_namespace,
    check_node,
    check_node_topic,
    check_plugins,
    check_response_information,
    check_robot,
    check_ros_arguments,
    check_ros_type,
    check_service_type,
    check_topic_template,
    from_names,
    leaves_out,
)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

DataclassT = TypeVar("DataclassT", bound="DataclassInstance")

PACKET_SIZE_MAX = 255 << 20
"""Less than the largest Remaining Length that MQTT can say (section 1.5.5: four bytes of 7 bits): a
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
"""The keys of a route that say when a command may reach ROS, and with what in it."""

MQTT_KEYS = ("fields", "rate", "bytes_per_second", "qos", "retain")
"""Those that say what is published on MQTT, and have no meaning on the way to ROS."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    def build(self, kind: type[DataclassT], **values: Any) -> DataclassT:
        """The dataclass that another part takes its settings in.

        `values` are the fields that differ from this section in name or form; every other field is
        the key of the same name, so that a setting is written down here and there, and not copied
        in a third place.
        """
        named = {each.name for each in fields(kind)} - values.keys()
        return kind(**{name: getattr(self, name) for name in named}, **values)


def _section() -> Any:
    # An empty mapping that is validated, and not a ready section: so its paths see the context.
    return Field(default={}, validate_default=True)


class Listener(_Section):
    """One address that clients connect to, with or without TLS; `mode` is for a Unix socket.

    What is None of `client_certificates`, `min_version` and `ciphers` is as `broker.tls` says, and
    `anonymous` as `broker.anonymous`.
    """

    bind: Address
    tls: bool = False
    protocol: Literal["mqtt", "websocket"] = "mqtt"
    client_certificates: ClientCertificates | None = None
    min_version: TlsVersion | None = None
    ciphers: str | None = None
    mode: Mode = 0o660
    anonymous: bool | None = None

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


class TlsSection(_Section):
    """The server's certificate, whose client certificates are accepted, and what they are for.

    Without `crl` it is `ca.crl` beside `ca`, if there is one.
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
    """What one user may have at most, of what all clients have; None is as others leave room."""

    connections: Count | None = None
    sessions: Count | None = None
    memory: Annotated[Size, Field(ge=1 << 10)] | None = None
    retained_messages: Annotated[int, Field(ge=0)] | None = None
    retained_bytes: Annotated[Size, Field(ge=0)] | None = None
    stored: Annotated[Size, Field(ge=0)] | None = None


#: The broker's own defaults.
_LIMITS = Limits()


class LimitsSection(_Section):
    """What one client, and all together, may use. Sizes in bytes, times in seconds."""

    connections: Count = _LIMITS.connections
    connections_per_address: Count = 250
    connection_rate: Count = 100
    failed_logins: Count = 30
    packet_size: Annotated[Size, Field(ge=128, le=PACKET_SIZE_MAX)] = _LIMITS.packet_size
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
        """Those that the broker enforces; listeners and logins have the others."""
        return self.build(
            Limits,
            keep=0 if self.keep == "latest" else self.keep,
            session_expiry=round(self.session_expiry),
            keep_alive=round(self.keep_alive),
            user=self.user.build(UserLimits),
        )


class PluginAnswersSection(_Section):
    """How long plugins may take, and for how long and how many of their answers hold."""

    timeout: Annotated[Duration, Field(gt=0)] = 5.0
    keep: Annotated[Duration, Field(ge=0)] = 10.0
    keep_refusals: Annotated[Duration, Field(ge=0)] = 2.0
    size: Count = 4096


class AuditSection(_Section):
    """Where is written who connected, was refused and changed what; None for nowhere."""

    path: OptionalPath = None
    size: Annotated[Size, Field(ge=1 << 10)] = 10 << 20
    keep: Annotated[int, Field(ge=1, le=1000)] = 5


class StoreSection(_Section):
    """Where sessions and retained messages are kept; `size` is in bytes, `age` in seconds."""

    path: FilePath = Path("state/store.db")
    durability: Literal["power", "process", "off"] = "power"
    size: Annotated[Size, Field(ge=1 << 20)] = 1 << 30
    age: Annotated[Duration, Field(gt=0)] | None = None


class BrokerSection(_Section):
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
        """Whether clients that give no user name come in by that listener."""
        return self.anonymous if listener.anonymous is None else listener.anonymous

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


class OnSilenceSection(_Section):
    """The stop message of a route to ROS, and when it is published; `after` in seconds."""

    after: Annotated[Duration, Field(gt=0)]
    publish: Annotated[dict[str, Any], BeforeValidator(check_message)] = {}
    disconnect: bool = True


class Route(_Section):
    """What is bridged, by its name on ROS, and where it is on MQTT.

    `ros` is a name, a pattern, or a list of these in which `!` leaves some out again. A route of
    which nothing else is said but what is left out holds for all patterns of its section.
    """

    ros: RosNames
    mqtt: Annotated[str, AfterValidator(check_topic_template)] = "{robot}{ros}"

    @property
    def names(self) -> tuple[str, ...]:
        """`ros`, as many as there are."""
        return (self.ros,) if isinstance(self.ros, str) else self.ros

    @property
    def is_exclusion(self) -> bool:
        """Whether it only says what the other routes of its section leave out."""
        return leaves_out(self.ros)

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

    to: Annotated[Direction, BeforeValidator(check_direction)] = Field(None, validate_default=True)
    type: Annotated[str, AfterValidator(check_ros_type)] | None = None
    fields: list[FieldPath] = []
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
        """Those of COMMAND_KEYS that say something else than their default."""
        return self._said(COMMAND_KEYS)

    @property
    def mqtt_keys(self) -> list[str]:
        """Those of MQTT_KEYS that do."""
        return self._said(MQTT_KEYS)

    def _said(self, keys: tuple[str, ...]) -> list[str]:
        fields = TopicRoute.model_fields
        return [key for key in keys if getattr(self, key) != fields[key].default]


class _CalledRoute(Route):
    """What every route has that is called; `timeout` in seconds."""

    timeout: Annotated[Duration, Field(gt=0)] = 5.0


class ServiceRoute(_CalledRoute):
    """ROS services that MQTT clients call, or one that they answer (`to: mqtt`)."""

    to: Literal["ros", "mqtt"] = "ros"
    type: Annotated[str, AfterValidator(check_service_type)] | None = None
    encoding: CallEncoding = "json"
    on_error: Annotated[dict[str, Any], BeforeValidator(check_message)] | None = None


class ActionRoute(_CalledRoute):
    """ROS actions for MQTT clients; `keep_result` in seconds."""

    type: Annotated[str, AfterValidator(check_action_type)] | None = None
    encoding: CallEncoding = "json"
    keep_result: Annotated[Duration, Field(ge=0)] = 60.0
    cancel: Literal["own", "any"] = "own"
    cancel_on_disconnect: bool = False


class ParameterRoute(_CalledRoute):
    """Parameters of ROS nodes, for MQTT clients to read and set: `/node/parameter`."""

    ros: ParameterNames
    mqtt: Annotated[str, AfterValidator(check_node_topic)] = "{robot}{node}/_param"
    encoding: ValueEncoding = "json"

    @property
    def is_pattern(self) -> bool:
        """Whether the route is for many nodes."""
        nodes = {name.rpartition("/")[0] for name in self.names if not name.startswith("!")}
        return len(nodes) > 1 or any("*" in node for node in nodes)

    def topic(self, robot: str) -> str:
        """The MQTT topic on that robot; the node's name is still to be filled in."""
        return self.mqtt.replace("{robot}", robot)


class BridgeLimitsSection(_Section):
    """Calls and goals under way: of all together, of one user (None: a quarter of these) and of
    one client; and what one message for ROS may have: bytes of JSON or text, and items."""

    calls: Count = 500
    calls_per_user: Count | None = None
    calls_per_client: Count = 20
    payload: Annotated[Size, Field(gt=0)] = 1 << 20
    items: Count = 100_000


class BridgeSection(_Section):
    """The way between the robot's bus and the broker; `diagnostics` in seconds, 0 for none."""

    bus: Literal["ros2", "ros1", "none"] = "ros2"
    node: Annotated[str, AfterValidator(check_node)] = "appliance"
    namespace: Annotated[str, AfterValidator(check_namespace)] = "/"
    domain_id: Annotated[int, Field(ge=0, le=232)] | None = None
    discovery: Literal["localhost", "subnet", "environment"] = "environment"
    ros_arguments: Annotated[list[str], AfterValidator(check_ros_arguments)] = []
    use_sim_time: bool = False
    diagnostics: Annotated[Duration, Field(ge=0)] = 1.0
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
        if defaults is None:  # they are wrong themselves, and that is told
            return topics
        shared = {name: getattr(defaults, name) for name in RouteDefaults.model_fields}

        def completed(route: TopicRoute) -> TopicRoute:
            own = {*route.model_fields_set, *(MQTT_KEYS if route.to == "ros" else ())}
            return route.model_copy(update={k: v for k, v in shared.items() if k not in own})

        return [route if route.is_exclusion else completed(route) for route in topics]


class LogSection(_Section):
    """What is logged and how; `levels` has a level for each logger named, such as appliance.ros."""

    level: Level = "info"
    format: Literal["human", "json"] = "human"
    levels: dict[str, Level] = {}


class Settings(_Section):
    """All of appliance.yaml."""

    robot: Annotated[str, AfterValidator(check_robot)] = "robot"
    broker: BrokerSection = _section()
    bridge: BridgeSection = _section()
    log: LogSection = _section()
    control: FilePath = Path("state/control.sock")
    reload_on_change: bool = True
    crash_reports: OptionalPath = Field(Path("state/crashes"), validate_default=True)
    _file: Path | None = PrivateAttr(default=None)

    @property
    def file(self) -> Path | None:
        """The file these settings were read from; None when they were made in code."""
        return self._file
