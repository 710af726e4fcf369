"""Rules for commands to ROS: the settings of a route, and limits on the fields of messages.

A limit is compiled once per type. A message is changed only if a number is outside a `clamp`; it is
rejected if a value is not one of an `allow`, or if a number to be clamped is NaN or infinite.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from appliance.ros.payload.converter import Converter
from appliance.ros.payload.definitions import (
    Array,
    FieldType,
    Primitive,
    Sequence,
    String,
    TypeDescription,
    WideString,
)
from appliance.ros.payload.fallback import ConversionError

#: Applies a limit to a value: returns it, or another one, or raises ConversionError.
Limit: TypeAlias = Callable[[Any, str], Any]


@dataclass(frozen=True, slots=True)
class OnSilence:
    """The stop message `publish`, in JSON, to be published after `after` seconds without a command.

    With `disconnect`, a client whose last command was not this one is disconnected when it falls
    silent and its computer does not answer. Commands that the network still holds are then lost,
    and cannot move the robot.
    """

    after: float
    publish: str = "{}"
    disconnect: bool = True


@dataclass(frozen=True, slots=True)
class CommandRules:
    """When a message may reach ROS, and with which values; times in seconds.

    `clamp` has the bounds of fields, `allow` their values, by the field's path.
    """

    expire: float | None = None
    take_retained: bool = False
    exclusive: bool = False
    lease: float = 2.0
    on_silence: OnSilence | None = None
    clamp: tuple[tuple[str, float, float], ...] = ()
    allow: tuple[tuple[str, tuple[bool | int | float | str, ...]], ...] = ()

    @property
    def needs_type(self) -> bool:
        """Whether the rules can only be checked against the type of the messages."""
        return bool(self.clamp or self.allow or self.on_silence)

    @property
    def oldest(self) -> float:
        """Messages that are older than this are not published."""
        if self.expire is not None:
            return self.expire
        return math.inf if self.on_silence is None else self.on_silence.after


class FieldLimits:
    """The limits of a route for messages of one type."""

    def __init__(self, rules: CommandRules, converter: Converter) -> None:
        """Raises ConversionError for a field that does not exist, or cannot be limited so."""
        self._converter = converter
        description = converter.description
        self._limits = [
            _compile(description, path.split("."), "clamp", path, _clamp(low, high))
            for path, low, high in rules.clamp
        ] + [
            _compile(description, path.split("."), "allow", path, _allow(values))
            for path, values in rules.allow
        ]

    def apply(self, cdr: bytes) -> tuple[bytes, bool]:
        """Apply the limits; returns the message and whether it has changed. Raises
        ConversionError."""
        value = self._converter.to_dict(cdr)
        has_changed = False
        for limit in self._limits:
            has_changed |= limit(value, "")
        return (self._converter.from_dict(value), True) if has_changed else (cdr, False)


def _compile(
    type_: FieldType,
    names: list[str],
    key: str,
    whole: str,
    make: Callable[[Primitive | String | WideString], Limit],
) -> Callable[[Any, str], bool]:
    """A function that limits the field `names` of a value in place, and returns whether it has
    changed."""
    if isinstance(type_, (Array, Sequence)) and isinstance(type_.item, TypeDescription):
        inside = _compile(type_.item, names, key, whole, make)

        def each(items: list[Any], path: str) -> bool:
            changes = [inside(item, f"{path}[{i}]") for i, item in enumerate(items)]
            return any(changes)

        return each
    assert isinstance(type_, TypeDescription)
    name, *rest = names
    field = next((field for field in type_.fields if field.name == name), None)
    if field is None:
        there = ", ".join(field.name for field in type_.fields) or "none"
        raise ConversionError(
            f"{key}.{whole}", f"{type_.name} has no field {name!r}; there are {there}"
        )
    item = field.type.item if isinstance(field.type, (Array, Sequence)) else field.type
    if rest:
        if not isinstance(item, TypeDescription):
            raise ConversionError(f"{key}.{whole}", f"{name!r} in {type_.name} has no fields")
        inner = _compile(field.type, rest, key, whole, make)
        return lambda value, path: inner(value[name], f"{path}.{name}".lstrip("."))
    is_bytes = item is not field.type and isinstance(item, Primitive) and item.is_octet
    if isinstance(item, TypeDescription) or is_bytes:
        kind = "bytes" if is_bytes else "a message of its own"
        raise ConversionError(f"{key}.{whole}", f"{name!r} in {type_.name} is {kind}")
    try:
        limit = make(item)
    except ValueError as error:
        raise ConversionError(f"{key}.{whole}", str(error)) from None
    is_list = item is not field.type

    def one(value: dict[str, Any], path: str) -> bool:
        before = value[name]
        where = f"{path}.{name}".lstrip(".")
        if is_list:
            after = [limit(x, f"{where}[{i}]") for i, x in enumerate(before)]
        else:
            after = limit(before, where)
        value[name] = after
        return bool(after != before)

    return one


def _clamp(low: float, high: float) -> Callable[[Primitive | String | WideString], Limit]:
    def make(type_: Primitive | String | WideString) -> Limit:
        if not isinstance(type_, Primitive) or type_.name == "bool":
            raise ValueError("is not a number")
        if type_.is_float:
            least, most = _inside(type_, low, upwards=True), _inside(type_, high, upwards=False)
        else:
            least, most = math.ceil(low), math.floor(high)
        if least > most:
            raise ValueError(f"no {type_.name} is between {low:g} and {high:g}")

        def limit(value: Any, path: str) -> Any:
            if not math.isfinite(value):
                raise ConversionError(path, "not a finite number, which a clamped field must be")
            return min(max(value, least), most)

        return limit

    return make


def _inside(type_: Primitive, bound: float, *, upwards: bool) -> float:
    """The bound, or the next number of the type that is within it."""
    if type_.size == 8:
        return bound
    code = f"<{type_.code}"
    try:
        (nearest,) = struct.unpack(code, struct.pack(code, bound))
    except OverflowError:  # larger than any number of the type
        return bound
    assert isinstance(nearest, float)
    if nearest == bound or (nearest > bound) is upwards:
        return nearest
    (bits,) = struct.unpack("<i", struct.pack("<f", nearest))
    away_from_zero = (math.copysign(1, nearest) > 0) is upwards
    step = 1 if away_from_zero else -1
    (neighbour,) = struct.unpack("<f", struct.pack("<i", bits + step))
    assert isinstance(neighbour, float)
    return neighbour


def _allow(values: tuple[Any, ...]) -> Callable[[Primitive | String | WideString], Limit]:
    def make(type_: Primitive | String | WideString) -> Limit:
        wanted: tuple[type, ...]
        if not isinstance(type_, Primitive):
            wanted, name = (str,), "a string"
        elif type_.name == "bool":
            wanted, name = (bool,), "true or false"
        else:
            wanted = (int, float) if type_.is_float else (int,)
            name = "a number" if type_.is_float else "an integer"
        for value in values:
            if not isinstance(value, wanted) or (isinstance(value, bool) and bool not in wanted):
                raise ValueError(f"{value!r} is not {name}")
        allowed = values
        listed = ", ".join(map(str, values))
        if isinstance(type_, Primitive) and type_.code == "f":
            code = f"<{len(values)}f"
            try:
                allowed = struct.unpack(code, struct.pack(code, *values))
            except (OverflowError, struct.error):
                raise ValueError(f"a float32 cannot be {listed}") from None

        def limit(value: Any, path: str) -> Any:
            if value not in allowed:
                raise ConversionError(path, f"{str(value)[:40]!r} is not allowed, only {listed}")
            return value

        return limit

    return make
