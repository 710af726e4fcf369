"""Descriptions of message types, from which converters are generated.

Converters need only a `TypeDescription`, whichever bus it comes from. `describe` makes one from a
ROS 2 message class (Humble, Jazzy, Kilted), and uses only its `SLOT_TYPES`,
`get_fields_and_field_types()` and a fresh instance, which has the defaults of the fields. For ROS 1
ros1/types.py parses definitions. Tests write descriptions by hand.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeAlias

# Names of fields end up in generated source (codegen.py), so only identifiers may pass.
_FIELD_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
_TYPE_NAME = re.compile(r"([A-Za-z]\w*)/(?:(msg|srv|action)/)?([A-Za-z]\w*)\Z", re.ASCII)

TIME = "builtin_interfaces/msg/Time"

#: Generated code reads fixed-length arrays up to this many items inline, one variable an item.
MAX_INLINE_ITEMS = 64


class UnknownTypeError(LookupError):
    """A message type is not installed here, or has a field that ROS or its route cannot carry."""


@dataclass(frozen=True)
class Primitive:
    """A bool, number, byte or char: `code` is its `struct` code, `size` its bytes."""

    name: str
    code: str
    size: int

    @property
    def is_octet(self) -> bool:
        """uint8, byte and char: arrays of them are base64 in JSON."""
        return self.code == "B"

    @property
    def is_float(self) -> bool:
        return self.code in "fd"


PRIMITIVES = {
    name: Primitive(name, code, size)
    for name, code, size in (
        ("bool", "?", 1),
        ("byte", "B", 1),
        ("char", "B", 1),
        ("int8", "b", 1),
        ("uint8", "B", 1),
        ("int16", "h", 2),
        ("uint16", "H", 2),
        ("int32", "i", 4),
        ("uint32", "I", 4),
        ("int64", "q", 8),
        ("uint64", "Q", 8),
        ("float32", "f", 4),
        ("float64", "d", 8),
    )
}


@dataclass(frozen=True)
class String:
    """UTF-8; `bound` counts bytes, as IDL does."""

    bound: int | None = None


@dataclass(frozen=True)
class WideString:
    """UTF-16; `bound` counts its 16-bit units."""

    bound: int | None = None


@dataclass(frozen=True)
class Array:
    """Exactly `length` items."""

    item: ItemType
    length: int


@dataclass(frozen=True)
class Sequence:
    """Any number of items, at most `bound`."""

    item: ItemType
    bound: int | None = None


@dataclass(frozen=True)
class Field:
    """A field. `default` is its value in a new message: None for the type's zero, else a bool,
    number, str, list of these, or bytes for arrays of uint8, byte and char."""

    name: str
    type: FieldType
    default: Any = None

    def __post_init__(self) -> None:
        if not _FIELD_NAME.match(self.name):
            raise UnknownTypeError(f"{self.name!r} cannot be the name of a field")


@dataclass(frozen=True)
class Serialization:
    """How a bus serializes messages.

    `encoding` is its name on MQTT. Messages begin with `header`. Numbers are aligned to their size,
    at most to `alignment` (MAXALIGN of DDS-XTypes), counted from the end of the header.
    `terminator` ends a string and is part of its length. `empty` stands for a structure without
    fields.
    """

    encoding: Literal["cdr", "ros1"]
    header: bytes
    alignment: int
    terminator: bytes
    empty: bytes


#: ROS 2: plain CDR, little endian, no options.
CDR = Serialization("cdr", b"\x00\x01\x00\x00", 8, b"\0", b"\0")

#: ROS 1: always little endian, the values without any padding.
PACKED = Serialization("ros1", b"", 1, b"", b"")


@dataclass(frozen=True)
class TypeDescription:
    """A message type: its full name (`geometry_msgs/msg/Twist`), its fields in the order in which
    they are serialized, how it and the types in it are serialized, and its constants."""

    name: str
    fields: tuple[Field, ...]
    serialization: Serialization = CDR
    constants: tuple[tuple[str, bool | int | float | str], ...] = ()


ItemType = Primitive | String | WideString | TypeDescription
FieldType = ItemType | Array | Sequence


class Bulk(IntEnum):
    """What can make messages of a type large: sequences of numbers, as in a scan or the states of
    joints, or of bytes, as in a picture, a point cloud or a map."""

    NOTHING = 0
    NUMBERS = 1
    BYTES = 2


def bulk(type_: FieldType) -> Bulk:
    """What can make values of the type large."""
    if isinstance(type_, TypeDescription):
        return max((bulk(field.type) for field in type_.fields), default=Bulk.NOTHING)
    if isinstance(type_, Sequence) and type_.bound is None and isinstance(type_.item, Primitive):
        return Bulk.BYTES if type_.item.size == 1 else Bulk.NUMBERS
    return bulk(type_.item) if isinstance(type_, (Array, Sequence)) else Bulk.NOTHING


#: Selected fields of a type by name: None selects the whole field, a dict some of its own fields.
Selection: TypeAlias = "dict[str, Selection | None]"


def select(description: TypeDescription, paths: Iterable[str]) -> Selection:
    """The selection of fields by their paths, such as `pose.position`.

    The path of an array's item fields has no index: it goes on as for a single message. Raises
    UnknownTypeError for a field that the type does not have.
    """
    chosen: Selection = {}
    for path in paths:
        type_: FieldType = description
        inside: Selection | None = chosen
        *parents, last = path.split(".")
        for depth, name in enumerate((*parents, last)):
            item = type_.item if isinstance(type_, (Array, Sequence)) else type_
            fields = item.fields if isinstance(item, TypeDescription) else ()
            field = next((field for field in fields if field.name == name), None)
            if field is None or not isinstance(item, TypeDescription):
                there = ", ".join(field.name for field in fields) or "none"
                raise UnknownTypeError(
                    f"{description.name} has no field {path!r}: no {name!r}, there are {there}"
                )
            type_ = field.type
            if inside is None:  # another path has selected the whole field
                continue
            if depth == len(parents):
                inside[name] = None
            else:
                inside = inside.setdefault(name, {})
    return chosen


def least_size(type_: FieldType) -> int:
    """The fewest bytes of a serialized value, without padding: in CDR at least 1.

    The count of a sequence is checked against it before anything is allocated, as a hostile message
    can announce any count.
    """
    if isinstance(type_, Primitive):
        return type_.size
    if isinstance(type_, Array):
        return type_.length * least_size(type_.item)
    if isinstance(type_, TypeDescription):
        return sum(least_size(field.type) for field in type_.fields) or len(
            type_.serialization.empty
        )
    return 4


# --- ROS 2 message classes ------------------------------------------------------------------

# IDL's names of basic types. rosidl has replaced ROS 2's `char` by uint8 already.
_BASIC_TYPES = {
    "boolean": "bool",
    "octet": "byte",
    "float": "float32",
    "double": "float64",
    "short": "int16",
    "unsigned short": "uint16",
    "long": "int32",
    "unsigned long": "uint32",
    "long long": "int64",
    "unsigned long long": "uint64",
}


def describe(message_class: type, load: Callable[[str], type]) -> TypeDescription:
    """The description of a ROS 2 message class. `load` returns the classes of nested types.

    Raises UnknownTypeError for a field of a type that rclpy has no support for (wchar, long
    double), and whatever `load` raises.
    """
    if isinstance(read := getattr(message_class, "DESCRIPTION", None), TypeDescription):
        return read  # a class that uncompiled.py made from a definition
    package, kind = message_class.__module__.split(".")[:2]
    name = f"{package}/{kind}/{message_class.__name__}"
    names = message_class.get_fields_and_field_types()  # type: ignore[attr-defined]
    example = message_class()
    fields = []
    slots = message_class.SLOT_TYPES  # type: ignore[attr-defined]
    for field_name, slot in zip(names, slots, strict=True):
        type_ = _field_type(slot, load, f"{name}.{field_name}")
        fields.append(Field(field_name, type_, _plain(type_, getattr(example, field_name))))
    return TypeDescription(name, tuple(fields), constants=_constants(message_class))


def _constants(message_class: type) -> tuple[tuple[str, bool | int | float | str], ...]:
    """The constants of a class that rosidl has generated: private to the class of the class."""
    kind = type(message_class)
    found = getattr(kind, f"_{kind.__name__}__constants", {})
    # A byte is bytes of length one.
    return tuple((key, ord(v) if isinstance(v, bytes) else v) for key, v in found.items())


def _field_type(slot: Any, load: Callable[[str], type], where: str) -> FieldType:
    """The FieldType of a `rosidl_parser.definition` type. The name of its class identifies it, so
    that rosidl_parser need not be imported."""
    kind = type(slot).__name__
    if kind == "Array":
        return Array(_item_type(slot.value_type, load, where), slot.size)
    if kind == "BoundedSequence":
        return Sequence(_item_type(slot.value_type, load, where), slot.maximum_size)
    if kind == "UnboundedSequence":
        return Sequence(_item_type(slot.value_type, load, where))
    return _item_type(slot, load, where)


def _item_type(slot: Any, load: Callable[[str], type], where: str) -> ItemType:
    kind = type(slot).__name__
    if kind == "BasicType":
        primitive = PRIMITIVES.get(_BASIC_TYPES.get(slot.typename, slot.typename))
        if primitive is None:
            raise UnknownTypeError(f"{where} has the type {slot.typename}, which is not supported")
        return primitive
    if kind == "NamespacedType":
        return describe(load("/".join(slot.namespaced_name())), load)
    if kind in ("UnboundedString", "BoundedString"):
        return String(getattr(slot, "maximum_size", None))
    if kind in ("UnboundedWString", "BoundedWString"):
        return WideString(getattr(slot, "maximum_size", None))
    raise UnknownTypeError(f"{where} has the type {kind}, which is not supported")


def _plain(type_: FieldType, value: Any) -> Any:
    """The `Field.default` of a default value as rclpy represents it."""
    if isinstance(type_, (Array, Sequence)):
        if isinstance(type_.item, TypeDescription):
            return None
        if isinstance(type_.item, Primitive) and type_.item.is_octet:
            # rclpy has byte[] as a list of bytes of length one, and uint8[] as an array.
            return b"".join(value) if isinstance(value, list) else value.tobytes()
        return value if isinstance(value, list) else value.tolist()
    if isinstance(type_, TypeDescription):
        return None
    if isinstance(type_, Primitive) and type_.is_octet and not isinstance(value, int):
        return ord(value)
    return value


def import_message(name: str) -> type:
    """The message class of a name: `std_msgs/msg/String`, `std_msgs/String`, and the parts of
    services and actions, `std_srvs/srv/Trigger_Request`, `pkg/action/Fibonacci_Goal`.

    Raises UnknownTypeError, which names what is missing.
    """
    match = _TYPE_NAME.match(name)
    if match is None:
        raise UnknownTypeError(f"{name!r} is not a type's name such as std_msgs/msg/String")
    package, kind, type_name = match.group(1), match.group(2) or "msg", match.group(3)
    # Any node can make up the name of a type: never import a module of Python's own for it.
    if package in sys.stdlib_module_names:
        raise UnknownTypeError(f"no {name}: {package} is not a package of messages")
    if package not in sys.modules:
        _add_workspace_path(package)
    try:
        module = import_module(f"{package}.{kind}")
    except ImportError as error:
        raise UnknownTypeError(f"no {name}: the package {package} is not installed here") from error
    except Exception as error:  # the import of a package runs its code, which may raise anything
        raise UnknownTypeError(f"no {name}: the package {package} is broken: {error!r}") from error
    found = getattr(module, type_name, None)
    if found is None and "_" in type_name:
        # Packages export an action, but not its Goal, Result and Feedback, of the same module.
        owner = getattr(module, type_name.partition("_")[0], None)
        found = getattr(sys.modules.get(getattr(owner, "__module__", "")), type_name, None)
    if not isinstance(found, type) or not hasattr(found, "SLOT_TYPES"):
        raise UnknownTypeError(f"no {name}: the package {package} has no such {kind} type")
    return found


def _add_workspace_path(package: str) -> None:
    """Add a workspace of AMENT_PREFIX_PATH that has the package to Python's search path.

    A shell that sources a workspace has its Python packages in PYTHONPATH as well; a service often
    does not.
    """
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        for place in (f"lib/{version}/site-packages", f"local/lib/{version}/dist-packages"):
            folder = Path(prefix, place)
            if prefix and str(folder) not in sys.path and (folder / package).is_dir():
                sys.path.append(str(folder))


def load_description(name: str) -> TypeDescription:
    """The description of an installed ROS 2 type. Raises UnknownTypeError."""
    return describe(import_message(name), import_message)
