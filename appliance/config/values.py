"""Types and validators of other values: ROS names, types and fields, messages, choices."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
)
from pydantic_core import PydanticCustomError

from appliance.mqtt.topics import holds_control


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


#: The largest history depth in ROS, which is a C int.
MAX_DEPTH = 2**31 - 1


def _parse_keep(value: object) -> int | Literal["latest"]:
    if value == "latest":
        return "latest"
    if isinstance(value, int) and not isinstance(value, bool) and value > 0:
        if value > MAX_DEPTH:
            raise ValueError(f"must be at most {MAX_DEPTH}, as far as ROS counts")
        return value
    raise ValueError("must be latest, or how many messages to keep (1 or more)")


def check_robot(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", value):
        raise ValueError(
            "must be one level of an MQTT topic: a letter or digit, "
            "then up to 63 letters, digits, '_', '-' or '.'"
        )
    return value


def _check_robot_only(value: str) -> str:
    plain = value.replace("{robot}", "r")
    if "{" in plain or "}" in plain:
        raise ValueError("knows the placeholder {robot} only")
    if holds_control(plain) or "\0" in plain:
        raise ValueError("must not have control characters in it")
    return plain


def check_client_id(value: str) -> str:
    if not _check_robot_only(value):
        raise ValueError("must not be empty")
    return value


def check_client_id_prefix(value: str) -> str:
    """The beginning of client ids; an empty one would admit every id."""
    if not value:
        raise ValueError("must not be empty: without any prefix every client id will do")
    return value


def check_login_name(value: str) -> str:
    _check_robot_only(value)
    return value


def check_topic_prefix(value: str) -> str:
    """The beginning of topics, which may be empty, and may end within a level."""
    plain = _check_robot_only(value)
    if "+" in plain or "#" in plain:
        raise ValueError("must be the beginning of MQTT topics, without '+' and '#'")
    return value


def check_fleet_prefix(value: str) -> str:
    """The beginning of all topics of a link, of whole levels."""
    check_topic_prefix(value)
    if not value.endswith("/") or value == "/":
        raise ValueError("must be the beginning of MQTT topics that ends with '/'")
    return value


def check_vda5050_version(value: str) -> str:
    if not re.fullmatch(r"[23]\.\d{1,4}(\.\d{1,4})?", value):
        raise ValueError("must be a version of VDA 5050, such as 2.1 or 3.0")
    return value


def check_vda5050_level(value: str) -> str:
    """A level of VDA 5050's topics (2.1 section 6.3, 3.0 section 4.2)."""
    plain = _check_robot_only(value)
    if not plain or set(plain) & set("/+#$"):
        raise ValueError("must be one level of a topic, without '/', '+', '#' and '$'")
    return value


def check_vda5050_serial_number(value: str) -> str:
    """As the level above, with the characters that are left to serial numbers."""
    if not re.fullmatch(r"[A-Za-z0-9_.:-]+", _check_robot_only(value)):
        raise ValueError("must be letters, digits, '_', '.', ':' and '-', by VDA 5050")
    return value


def vda5050_in_full(value: object) -> object:
    """`vda5050` alone is the profile with its defaults."""
    if value == "vda5050":
        return {"vda5050": {}}
    if isinstance(value, str):
        raise ValueError("must be vda5050, the only profile")
    return value


def check_relative_filter(value: str) -> str:
    """A topic filter without its beginning; it is empty where the prefixes are whole topics."""
    if "{" in value or "}" in value:
        raise ValueError("knows no placeholders: it is what follows local_prefix, {robot}/")
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
    """A ROS name, or a pattern: `*` matches within one part of a name, `**` any number of parts."""
    if "*" not in value:
        return _check_ros_name(value)
    _check_ros_name(re.sub(r"\*+", "x", value))
    if "***" in value:
        raise ValueError("knows '*', part of a name, and '**', part of a path, but not '***'")
    return value


class InListError(ValueError):
    """An error in one entry of a list, with the position of the entry."""

    def __init__(self, position: int, what: str) -> None:
        super().__init__(what)
        self.position = position


def _parse_ros_names(
    value: object, check: Callable[[str], object] = _check_ros_pattern
) -> str | tuple[str, ...]:
    """A name or pattern, or a list of them; one that begins with `!` is excluded."""
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
            raise InListError(position, str(error)) from None
    return str(names[0]) if len(names) == 1 else tuple(names)


def _parse_parameters(value: object) -> str | tuple[str, ...]:
    """A parameter as in `_check_parameter`, or a list, as in `_parse_ros_names`."""
    return _parse_ros_names(value, _check_parameter)


def check_ros_arguments(value: list[str]) -> list[str]:
    if value[:1] == ["--ros-args"]:
        value = value[1:]
    if "--" in value:
        raise ValueError("must have ROS arguments only, without --")
    return value


def check_node(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value):
        raise ValueError("must be a letter or '_', then letters, digits or '_'")
    return value


def check_namespace(value: str) -> str:
    return value if value == "/" else _check_ros_name(value)


def check_ros_type(value: str) -> str:
    """The name of a message type, or a pattern of such: sensor_msgs/msg/*."""
    if re.fullmatch(r"[A-Za-z*][\w*]*/msg/[A-Za-z*][\w*]*", value) and "**" not in value:
        return value
    short = re.fullmatch(r"([A-Za-z]\w*)/([A-Za-z]\w*)", value)
    hint = f"; did you mean '{short[1]}/msg/{short[2]}'?" if short else ""
    raise ValueError(f"must be package/msg/Type, such as geometry_msgs/msg/Twist{hint}")


def check_topic_template(value: str, name: str = "{ros}") -> str:
    plain = value.replace("{robot}", "r").replace(name, "/r")
    if not plain or any(char in plain for char in "+#\0"):
        raise ValueError("must be an MQTT topic without '+' and '#'")
    if "{" in plain or "}" in plain:
        raise ValueError(f"knows the placeholders {{robot}} and {name} only")
    if plain.startswith("$"):
        raise ValueError("must not begin with '$': those topics are the broker's own")
    return value


def check_node_topic(value: str) -> str:
    return check_topic_template(value, "{node}")


#: The syntax of a parameter's name.
OF_NODE = (
    "must be a node's full name, '/', and a parameter's: /arm/speed, /arm/* for all of /arm, /**/* "
    "for all of every node"
)


def _check_parameter(value: str) -> None:
    """The full name of a node, `/`, and the name of a parameter; each may be a pattern."""
    node, slash, name = value.rpartition("/")
    if not slash or not re.fullmatch(r"[\w.*-]+", name):
        raise ValueError(OF_NODE)
    if node:  # in ROS 1, /speed is a parameter without a node
        _check_ros_pattern(node)


def _check_called_type(value: str, kind: str, example: str) -> str:
    if not re.fullmatch(rf"[A-Za-z*][\w*]*/{kind}/[A-Za-z*][\w*]*", value):
        raise ValueError(f"must be package/{kind}/Type, such as {example}")
    return value


def check_service_type(value: str) -> str:
    return _check_called_type(value, "srv", "std_srvs/srv/Trigger")


def check_action_type(value: str) -> str:
    return _check_called_type(value, "action", "nav2_msgs/action/NavigateToPose")


def from_names(value: object) -> object:
    """Expand a route that consists of names only."""
    return {"ros": value} if isinstance(value, (str, list, tuple)) else value


def check_direction(value: object, info: ValidationInfo) -> object:
    names = info.data.get("ros")  # None when `ros` is invalid itself
    if value is not None:
        return value
    if names is not None and not excludes_only(names):
        raise PydanticCustomError("missing", "is needed")
    return "mqtt"


def excludes_only(names: str | tuple[str, ...]) -> bool:
    """Whether all names are exclusions."""
    return all(name.startswith("!") for name in ([names] if isinstance(names, str) else names))


def check_response_information(value: str) -> str:
    if not value or any(char in value for char in "+#\0"):
        raise ValueError("must be the beginning of an MQTT topic, without '+' and '#'")
    return value


def _check_field(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z]\w*(\.[A-Za-z]\w*)*", value, re.ASCII):
        raise ValueError(f"{value!r} is not the path of a field, such as linear.x")
    return value


def check_clamp(value: object) -> object:
    for path, bounds in value.items() if isinstance(value, dict) else ():
        is_pair = isinstance(bounds, (list, tuple)) and len(bounds) == 2
        if not is_pair or any(
            isinstance(x, bool) or not isinstance(x, (int, float)) for x in bounds
        ):
            raise ValueError(f"{path} must have its least and its most, such as [-0.5, 0.5]")
        if not -math.inf < bounds[0] <= bounds[1] < math.inf:
            raise ValueError(f"{path} must have its least before its most")
    return value


def check_allow(value: object) -> object:
    for path, values in value.items() if isinstance(value, dict) else ():
        if not isinstance(values, list) or not values:
            raise ValueError(f"{path} must have a list of the values that are allowed")
        if not all(isinstance(x, (bool, int, float, str)) for x in values):
            raise ValueError(f"{path} can have only text, numbers, true and false")
    return value


def check_message(value: object) -> object:
    try:
        json.dumps(value, allow_nan=False)
    except TypeError:  # most likely a date: YAML parses 2024-01-01 as one
        raise ValueError("has a value that JSON does not know; put text in quotes") from None
    except ValueError:
        raise ValueError("has a number that JSON does not know; NaN is written null") from None
    return value


def check_plugins(value: object) -> object:
    if not isinstance(value, dict):
        return value
    for name in value:
        if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", name):
            raise ValueError(
                f"{name!r} must be the full path of a plugin class: package.module.Class"
            )
    # A plugin without settings has nothing after its colon.
    return {name: {} if settings is None else settings for name, settings in value.items()}


def _unquoted_off(value: object) -> object:
    return "off" if value is False else value  # off is a boolean in YAML 1.1


def _unquoted_protocol(value: object) -> object:
    return "5" if value in (5, "5.0") and not isinstance(value, bool) else value


def _unquoted_version(value: object) -> object:
    return str(value) if isinstance(value, float) else value


def _or_auto(value: object) -> object:
    return "auto" if value is None else value


Qos = Annotated[int | None, PlainValidator(_parse_qos), PlainSerializer(_or_auto, when_used="json")]


Retain = Annotated[
    bool | None, PlainValidator(_parse_retain), PlainSerializer(_or_auto, when_used="json")
]


Keep = Annotated[int | Literal["latest"], PlainValidator(_parse_keep)]


ClientCertificates = Annotated[
    Literal["off", "optional", "required"], BeforeValidator(_unquoted_off)
]


ProtocolVersion = Annotated[Literal["5", "3.1.1"], BeforeValidator(_unquoted_protocol)]


SpokenVersion = Annotated[
    Literal["3.1", "3.1.1", "5"],
    BeforeValidator(_unquoted_version),
    BeforeValidator(_unquoted_protocol),
]


Vda5050Version = Annotated[
    str, BeforeValidator(_unquoted_version), AfterValidator(check_vda5050_version)
]


TlsVersion = Annotated[Literal["1.2", "1.3"], BeforeValidator(_unquoted_version)]


Count = Annotated[int, Field(ge=1)]


_LISTED = PlainSerializer(lambda names: names if isinstance(names, str) else list(names))


RosNames = Annotated[str | tuple[str, ...], PlainValidator(_parse_ros_names), _LISTED]


ParameterNames = Annotated[str | tuple[str, ...], PlainValidator(_parse_parameters), _LISTED]


FieldPath = Annotated[str, AfterValidator(_check_field)]


#: Nothing of ROS is imported here, and so the encodings that `appliance.ros.payload.encodings` has
#: are listed once more; tests/ros/payload/test_encodings.py holds the lists equal.
Encoding = Literal["json", "cbor", "text", "cdr", "ros1", "binary", "jpeg", "png"]


#: Those that make pictures of images, for MQTT only.
PictureEncoding = Literal["jpeg", "png"]


#: Those of services and actions.
CallEncoding = Literal["json", "cbor", "cdr", "ros1"]


#: Those of any value: of parameters, and of some of a message's fields.
ValueEncoding = Literal["json", "cbor"]


Direction = Literal["mqtt", "ros", "both"]


QueueFull = Literal["refuse", "drop-oldest", "disconnect"]


Level = Literal["debug", "info", "warning", "error"]
