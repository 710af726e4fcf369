"""The JSON Schema (2020-12) of a message type, for the JSON that is sent and accepted."""

from __future__ import annotations

from typing import Any

from appliance.ros.payload.definitions import (
    TIME,
    Array,
    FieldType,
    Primitive,
    String,
    TypeDescription,
    WideString,
)
from appliance.ros.payload.fallback import default

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def topic_of(type_name: str) -> str:
    """The topic level of a type's schema: `std_msgs/String` of `std_msgs/msg/String`."""
    return type_name.replace("/msg/", "/", 1)


def json_schema(description: TypeDescription) -> dict[str, Any]:
    """The schema of a type, with those of nested types under `$defs`.

    No field is required: a missing field takes its default. `x-constants` has the constants of a
    type, by their names.
    """
    types: dict[str, Any] = {}
    schema = _structure(description, types)
    if description.name == TIME:
        schema = {"anyOf": [schema, {"const": "now"}]}
    return {
        "$schema": DIALECT,
        "title": description.name,
        **schema,
        **({"$defs": dict(sorted(types.items()))} if types else {}),
    }


def _structure(description: TypeDescription, types: dict[str, Any]) -> dict[str, Any]:
    properties: dict[str, Any] = {}
    for field in description.fields:
        properties[field.name] = _value(field.type, types)
        if field.default is not None and not isinstance(field.default, bytes):
            properties[field.name]["default"] = default(field)
    schema = {"type": "object", "properties": properties, "additionalProperties": False}
    constants = {"x-constants": dict(description.constants)} if description.constants else {}
    return schema | constants


def _value(type_: FieldType, types: dict[str, Any]) -> dict[str, Any]:
    if isinstance(type_, Primitive):
        return _number(type_)
    if isinstance(type_, (String, WideString)):
        # A bound counts bytes of UTF-8 or units of UTF-16; a text has at most as many characters.
        return {"type": "string"} | ({"maxLength": type_.bound} if type_.bound else {})
    if isinstance(type_, TypeDescription):
        if type_.name not in types:
            types[type_.name] = {}  # reserved, as nested types may refer to it
            types[type_.name] = _structure(type_, types)
        reference = {"$ref": "#/$defs/" + type_.name.replace("~", "~0").replace("/", "~1")}
        return {"anyOf": [reference, {"const": "now"}]} if type_.name == TIME else reference
    bounds: dict[str, Any]
    if isinstance(type_, Array):
        bounds = {"minItems": type_.length, "maxItems": type_.length}
    else:
        bounds = {} if type_.bound is None else {"maxItems": type_.bound}
    items = {"type": "array", "items": _value(type_.item, types), **bounds}
    if isinstance(type_.item, Primitive) and type_.item.is_octet:
        return {"anyOf": [{"type": "string", "contentEncoding": "base64"}, items]}
    return items


def _number(primitive: Primitive) -> dict[str, Any]:
    if primitive.name == "bool":
        return {"type": "boolean"}
    if primitive.is_float:
        return {"type": ["number", "null"]}  # NaN and the infinities are null
    bits = primitive.size * 8
    is_signed = primitive.code.islower()
    least = -(2 ** (bits - 1)) if is_signed else 0
    return {"type": "integer", "minimum": least, "maximum": least + 2**bits - 1}
