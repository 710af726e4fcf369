"""Message types without compiled support, from their definitions.

The one file needs this: its Python and ROS are hardly ever those that a robot's workspace was built
with, so that the compiled support of the workspace does not load. rclpy requires a type support
even for messages that it carries as bytes. Fast DDS then uses only the name and the hash of the
type, so that the support of an installed type can serve for another type under that type's name.
Up to Jazzy it also asks for the type's members, for filters by content, which are not used here:
they go nowhere, and are those of the installed type.

Services cannot be bridged this way, as rclpy does not accept or return serialized requests.
"""

from __future__ import annotations

import ctypes
import functools
import json
import os
from collections.abc import Callable
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple

from appliance.ros.payload.definitions import (
    PRIMITIVES,
    Array,
    Field,
    FieldType,
    ItemType,
    Primitive,
    Sequence,
    String,
    TypeDescription,
    UnknownTypeError,
    WideString,
    describe,
    import_message,
)

#: The type whose support serves for others. Its size is unbounded, as that of others may be.
MODEL = "std_msgs/msg/String"
#: The longest fixed-length array, of which a default value is created.
MAX_ARRAY_ITEMS = 1 << 24

#: The types whose definitions are being read, outermost first, to detect types in themselves.
_being_read: ContextVar[tuple[str, ...]] = ContextVar("_being_read", default=())
_IDENTIFIER = b"rosidl_typesupport_fastrtps_c"


def find_definition(name: str) -> Path | None:
    """The `.msg`, `.srv` or `.action` file of a type, or of the service or action that it is part
    of, in the workspaces of AMENT_PREFIX_PATH."""
    package, _, rest = name.partition("/")
    kind, _, type_name = rest.partition("/")
    file = f"{type_name.partition('_')[0]}.{kind}"
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        path = Path(prefix, "share", package, kind, file)
        if prefix and f"{package}{type_name}".isidentifier() and path.is_file():
            return path
    return None


def message_class(name: str, definition: Path, load: Callable[[str], type]) -> type[Any]:
    """A class that rclpy accepts as a message class, to subscribe and publish serialized messages.

    `describe` returns its description. `load` returns the classes of nested types. Raises
    UnknownTypeError when the definition cannot be read, or the middleware is not Fast DDS.
    """
    description = _read(name, definition, load)
    namespace, _, type_name = name.replace("/msg/", "::msg/").partition("/")
    support = _Support(namespace, type_name, _hash(name, definition.with_suffix(".json")))
    # rclpy requires functions that convert messages to objects and back, but never calls these.
    conversions = dict.fromkeys(
        ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE"), name
    )
    kind = type(
        f"Metaclass_{type_name}", (type,), {"_TYPE_SUPPORT": support.capsule, **conversions}
    )
    found: type[Any] = kind(type_name, (), {"DESCRIPTION": description, "SUPPORT": support})
    return found


def _read(name: str, definition: Path, load: Callable[[str], type]) -> TypeDescription:
    from rosidl_adapter.parser import parse_message_string

    package, _, type_name = name.partition("/msg/")
    outside = _being_read.get()
    if name in outside:
        raise UnknownTypeError(f"no {name}: {definition} contains itself")
    try:
        message = parse_message_string(package, type_name, definition.read_text("utf-8"))
    except Exception as error:  # the parser raises many kinds, NameError and AssertionError too
        raise UnknownTypeError(f"no {name}: {definition} cannot be read: {error}") from error
    token = _being_read.set((*outside, name))
    try:
        return TypeDescription(
            name,
            tuple(_field(field, load) for field in message.fields),
            constants=tuple((each.name, each.value) for each in message.constants),
        )
    finally:
        _being_read.reset(token)


def _field(field: Any, load: Callable[[str], type]) -> Field:
    item = _item(field.type, load)
    type_: FieldType = item
    if field.type.is_array:
        size = field.type.array_size
        is_fixed = size is not None and not field.type.is_upper_bound
        if is_fixed and size > MAX_ARRAY_ITEMS:
            raise UnknownTypeError(f"{field.name} has {size} items, the most is {MAX_ARRAY_ITEMS}")
        type_ = Array(item, size) if is_fixed else Sequence(item, size)
    default = field.default_value
    if default is None:
        default = _zero(type_)
    elif isinstance(default, (list, tuple)):
        default = _values(item, list(default))
    return Field(field.name, type_, default)


def _zero(type_: FieldType) -> Any:
    """The default of a field whose definition has none, as in a compiled type; None for
    messages."""
    if isinstance(type_, Array):
        zero = _zero(type_.item)
        return None if zero is None else _values(type_.item, [zero] * type_.length)
    if isinstance(type_, Sequence):
        return None if isinstance(type_.item, TypeDescription) else _values(type_.item, [])
    if isinstance(type_, Primitive):
        return False if type_.code == "?" else 0.0 if type_.is_float else 0
    return None if isinstance(type_, TypeDescription) else ""


def _values(item: ItemType, values: list[Any]) -> Any:
    return bytes(values) if isinstance(item, Primitive) and item.is_octet else values


def _item(type_: Any, load: Callable[[str], type]) -> ItemType:
    if not type_.is_primitive_type():
        return describe(load(f"{type_.pkg_name}/msg/{type_.type}"), load)
    if type_.type == "string":
        return String(type_.string_upper_bound)
    if type_.type == "wstring":
        return WideString(type_.string_upper_bound)
    return PRIMITIVES["uint8" if type_.type == "char" else type_.type]


def _hash(name: str, file: Path) -> bytes | None:
    """The type's hash (REP 2011), which is generated beside its definition from ROS 2 Iron on."""
    try:
        for entry in json.loads(file.read_bytes())["type_hashes"]:
            version, _, value = entry["hash_string"].partition("_")
            if entry["type_name"] == name and version == "RIHS01" and len(value) == 64:
                return bytes.fromhex(value)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        pass  # the type is then announced without a hash
    return None


class _Handle(ctypes.Structure):
    """`rosidl_message_type_support_t`; the members from `get_hash` on exist since ROS 2 Iron."""

    _fields_ = (
        ("identifier", ctypes.c_char_p),
        ("data", ctypes.c_void_p),
        ("find", ctypes.c_void_p),
        ("get_hash", ctypes.c_void_p),
        ("get_description", ctypes.c_void_p),
        ("get_sources", ctypes.c_void_p),
    )


class _Callbacks(ctypes.Structure):
    """`message_type_support_callbacks_t` of rosidl_typesupport_fastrtps_cpp."""

    _fields_ = (
        ("namespace", ctypes.c_char_p),
        ("name", ctypes.c_char_p),
        ("functions", ctypes.c_void_p * 5),
    )


class _Hash(ctypes.Structure):
    """`rosidl_type_hash_t`; version 0 means no hash."""

    _fields_ = (("version", ctypes.c_uint8), ("value", ctypes.c_uint8 * 32))


_GET_HASH = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_FIND = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)


class _Support:
    """The support of a type, in a capsule as rclpy expects it. The middleware has pointers into
    this object."""

    def __init__(self, namespace: str, name: str, type_hash: bytes | None) -> None:
        """Raises UnknownTypeError when the middleware is not Fast DDS."""
        model = _model()
        self._callbacks = _Callbacks(namespace.encode(), name.encode(), model.callbacks.functions)
        self._hash = _Hash(1, (ctypes.c_uint8 * 32)(*type_hash)) if type_hash else _Hash()
        self._get_hash = _GET_HASH(lambda _: ctypes.addressof(self._hash))
        self._find = _FIND(
            lambda _, identifier: (
                ctypes.addressof(self._handle)
                if identifier == _IDENTIFIER
                else ctypes.cast(model.find(identifier), ctypes.c_void_p).value
            )
        )
        self._handle: _Handle = _Handle(
            _IDENTIFIER,
            ctypes.addressof(self._callbacks),
            ctypes.cast(self._find, ctypes.c_void_p),
        )
        if model.has_hash:
            self._handle.get_hash = ctypes.cast(self._get_hash, ctypes.c_void_p)
            self._handle.get_description = model.handle.get_description
            self._handle.get_sources = model.handle.get_sources
        new_capsule = ctypes.pythonapi.PyCapsule_New
        new_capsule.restype = ctypes.py_object
        new_capsule.argtypes = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
        self.capsule = new_capsule(ctypes.addressof(self._handle), None, None)


class _Model(NamedTuple):
    find: Callable[[bytes], Any]  # the support that has this identifier
    handle: _Handle
    callbacks: _Callbacks
    has_hash: bool


@functools.cache
def _model() -> _Model:
    """The support of MODEL. Raises UnknownTypeError when its layout is not the one expected."""
    model = import_message(MODEL)
    kind: Any = model.__class__
    kind.__import_type_support__()
    pointer_in = ctypes.pythonapi.PyCapsule_GetPointer
    pointer_in.restype = ctypes.c_void_p
    pointer_in.argtypes = (ctypes.py_object, ctypes.c_void_p)
    runtime = ctypes.CDLL("librosidl_runtime_c.so")
    get = runtime.get_message_typesupport_handle
    get.restype = ctypes.POINTER(_Handle)
    get.argtypes = (ctypes.c_void_p, ctypes.c_char_p)
    find = functools.partial(get, pointer_in(kind._TYPE_SUPPORT, None))
    handle = find(_IDENTIFIER)
    if handle and handle.contents.identifier == _IDENTIFIER and handle.contents.data:
        callbacks = _Callbacks.from_address(handle.contents.data)
        if (callbacks.namespace, callbacks.name) == (b"std_msgs::msg", b"String"):
            has_hash = hasattr(runtime, "rosidl_parse_type_hash_string")
            return _Model(find, handle.contents, callbacks, has_hash)
    raise UnknownTypeError("only Fast DDS carries types without their compiled support")
