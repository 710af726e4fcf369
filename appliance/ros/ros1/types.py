"""Message types of ROS 1, described from their definitions.

A full definition is the text of the message, then those of all nested types, each behind a line
of `=` and a line `MSG: package/Type`. Installed packages have it in `_full_text`. Publishers send
it to each subscriber, so that types that are not installed here can be received as well.

The names of types are those of ROS 2, `std_msgs/msg/String` and `std_srvs/srv/Trigger`, which
distinguish messages from services. `ros1_name` returns the name in ROS 1.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from appliance.ros.payload.definitions import (
    MAX_INLINE_ITEMS,
    PACKED,
    PRIMITIVES,
    TIME,
    Array,
    Field,
    FieldType,
    ItemType,
    Primitive,
    Sequence,
    String,
    TypeDescription,
    UnknownTypeError,
    least_size,
)

#: Limits of a definition: its bytes, its fields with those of nested types, the depth of nesting,
#: and the bytes of its smallest message. Any node can send one, which must not exhaust the memory.
MAX_DEFINITION_SIZE = 1 << 20
MAX_FIELDS = 5_000
MAX_DEPTH = 16  # Python compiles at most 20 nested loops
MAX_MESSAGE_SIZE = 64 << 20

_TYPE_NAME = re.compile(r"([A-Za-z]\w*)/(?:(msg|srv)/)?([A-Za-z]\w*)\Z", re.ASCII)
_FIELD = re.compile(r"([A-Za-z][\w/]*)(?:\[(\d{0,9})\])?\s+([A-Za-z]\w*)\s*(=.*|#.*)?\Z", re.ASCII)
_SEPARATOR = re.compile(r"^={80}$", re.MULTILINE)

# Both are two numbers of four bytes, with other names than in ROS 2.
_TIMES: dict[str, TypeDescription] = {
    name: TypeDescription(
        full_name,
        (Field("sec", PRIMITIVES[number]), Field("nanosec", PRIMITIVES[number])),
        PACKED,
    )
    for name, full_name, number in (
        ("time", TIME, "uint32"),
        ("duration", "builtin_interfaces/msg/Duration", "int32"),
    )
}

#: The type `time`.
STAMP = _TIMES["time"]

#: byte is an old name of int8, and char of uint8.
_BUILT_IN: dict[str, ItemType] = {
    **PRIMITIVES,
    "byte": PRIMITIVES["int8"],
    "char": PRIMITIVES["uint8"],
    "string": String(),
    **_TIMES,
}


@dataclass(frozen=True, slots=True)
class Definition:
    """A message type as nodes exchange it: its name in ROS 1, its MD5 sum, which both sides must
    have in common, and its full text."""

    name: str
    md5sum: str
    text: str


@dataclass(frozen=True, slots=True)
class ServiceDefinition:
    """A service type: its name in ROS 1, its MD5 sum and its two messages."""

    name: str
    md5sum: str
    request: Definition
    response: Definition


def ros1_name(name: str) -> str:
    """`std_msgs/String` of `std_msgs/msg/String`."""
    package, _, rest = name.partition("/")
    return f"{package}/{rest.rpartition('/')[2]}"


def full_name(name: str, kind: str = "msg") -> str:
    """`std_msgs/msg/String` of `std_msgs/String`."""
    return name.replace("/", f"/{kind}/", 1)


def installed(name: str) -> Definition:
    """The definition of an installed message type `std_msgs/msg/String`, or of one half of a
    service, `std_srvs/srv/Trigger_Request`. Raises UnknownTypeError."""
    service, _, half = name.rpartition("_")
    if "/srv/" in name and half in ("Request", "Response"):
        found = _import(service, "srv")
        return _definition(getattr(found, f"_{half.lower()}_class"))
    return _definition(_import(name, "msg"))


def installed_service(name: str) -> ServiceDefinition:
    """The definition of an installed service type `std_srvs/srv/Trigger`. Raises
    UnknownTypeError."""
    found = _import(name, "srv")
    return ServiceDefinition(
        found._type,
        found._md5sum,
        _definition(found._request_class),
        _definition(found._response_class),
    )


def _definition(message_class: Any) -> Definition:
    return Definition(message_class._type, message_class._md5sum, message_class._full_text)


def _import(name: str, kind: str) -> Any:
    match = _TYPE_NAME.match(name)
    if match is None or (match.group(2) or kind) != kind:
        raise UnknownTypeError(f"{name!r} is not a type's name such as std_{kind}s/{kind}/Empty")
    package, type_name = match.group(1), match.group(3)
    try:
        module = import_module(f"{package}.{kind}")
    except ImportError as error:
        raise UnknownTypeError(
            f"no {name}: the package {package} is not installed here (ROS 1 looks in PYTHONPATH)"
        ) from error
    found = getattr(module, type_name, None)
    if not isinstance(found, type) or not hasattr(found, "_md5sum"):
        raise UnknownTypeError(f"no {name}: the package {package} has no such {kind} type")
    return found


def describe(name: str, text: str) -> TypeDescription:
    """The description of a message type `std_msgs/msg/String`, from its full definition.

    Raises UnknownTypeError when the text is no definition, or exceeds a limit.
    """
    if len(text) > MAX_DEFINITION_SIZE:
        raise UnknownTypeError(f"no {name}: its definition has {len(text)} characters")
    own, *others = _SEPARATOR.split(text)
    sections = {}
    for other in others:
        head, _, body = other.lstrip("\n").partition("\n")
        sections[head.removeprefix("MSG:").strip()] = body
    description = _Parser(name, sections).describe(name, ros1_name(name), own, ())
    if least_size(description) > MAX_MESSAGE_SIZE:
        raise UnknownTypeError(f"no {name}: its smallest message has {least_size(description)} B")
    return description


def _constant(type_name: str, text: str) -> bool | int | float | str | None:
    """The value of a constant, None where it cannot be read. A text goes on to the line's end."""
    if type_name == "string":
        return text.strip()
    primitive = _BUILT_IN.get(type_name)
    value = text.partition("#")[0].strip()
    try:
        if not isinstance(primitive, Primitive):
            return None
        if primitive.name == "bool":
            return value.lower() in ("true", "1")
        return float(value) if primitive.is_float else int(value, 0)
    except ValueError:
        return None


class _Parser:
    def __init__(self, root: str, sections: dict[str, str]) -> None:
        self._root = root
        self._sections = sections
        self._known: dict[str, tuple[TypeDescription, int]] = {}

    def describe(self, name: str, ros1: str, text: str, above: tuple[str, ...]) -> TypeDescription:
        if ros1 in above:
            raise self._error(f"{ros1} contains itself")
        if len(above) > MAX_DEPTH:
            raise self._error(f"it is too deep: more than {MAX_DEPTH} types in types")
        fields: list[Field] = []
        constants: list[tuple[str, bool | int | float | str]] = []
        count = 1
        for line in text.split("\n"):
            line = line.strip()
            if not line or line.startswith("#"):
                continue
            match = _FIELD.match(line)
            if match is None:
                raise self._error(f"{ros1} has the line {line[:60]!r}")
            type_name, length, field_name, rest = match.groups()
            if rest and rest.startswith("="):
                constant = _constant(type_name, rest[1:])
                if constant is not None:
                    constants.append((field_name, constant))
                continue
            item = self._item(type_name, ros1, (*above, ros1))
            type_: FieldType = item
            if length is not None:
                # Items without bytes cannot be counted: a few bytes could stand for any number.
                if least_size(item) == 0 or length == "0":
                    raise self._error(f"{ros1}.{field_name} is an array of nothing")
                type_ = Array(item, int(length)) if length else Sequence(item)
            fields.append(Field(field_name, type_))
            if isinstance(item, TypeDescription):
                count += self._known[item.name][1]
            else:
                # Generated code reads short arrays inline, a variable an item.
                count += min(int(length), MAX_INLINE_ITEMS) if length else 1
            if count > MAX_FIELDS:
                raise self._error(f"it has more than {MAX_FIELDS} fields")
        description = TypeDescription(name, tuple(fields), PACKED, tuple(constants))
        self._known[name] = description, count
        return description

    def _item(self, type_name: str, ros1: str, above: tuple[str, ...]) -> ItemType:
        built_in = _BUILT_IN.get(type_name)
        if built_in is not None:
            if isinstance(built_in, TypeDescription):
                self._known[built_in.name] = built_in, 2
            return built_in
        if type_name == "Header":
            type_name = "std_msgs/Header"
        elif "/" not in type_name:
            type_name = f"{ros1.partition('/')[0]}/{type_name}"
        name = full_name(type_name)
        if name in self._known:
            return self._known[name][0]
        text = self._sections.get(type_name)
        if text is None:
            raise self._error(f"it does not define {type_name}")
        return self.describe(name, type_name, text, above)

    def _error(self, problem: str) -> UnknownTypeError:
        return UnknownTypeError(f"no {self._root}: its definition cannot be read: {problem}")
