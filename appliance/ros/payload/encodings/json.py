"""`json`: the fields of a message as a JSON object; converter.py has the rules."""

from __future__ import annotations

from typing import Any

import orjson

from appliance.ros.payload.converter import Converter
from appliance.ros.payload.cost import json_cost
from appliance.ros.payload.encodings.base import Decode, Encode, ValueEncoding
from appliance.ros.payload.fallback import ConversionError


class Json(ValueEncoding):
    """JSON. Its conversion is the converter's own, as configurations have messages in JSON, too."""

    name = "json"
    content_type = "application/json"
    is_text = True

    def encoder(self, converter: Converter) -> Encode:
        return converter.to_json

    def decoder(self, converter: Converter, items: int) -> Decode:
        return converter.from_json

    def cost(self, payload: bytes, most: int) -> int:
        return json_cost(payload, most)

    def dumps(self, value: object) -> bytes:
        return orjson.dumps(value)

    def loads(self, payload: bytes) -> Any:
        try:
            return orjson.loads(payload)
        except orjson.JSONDecodeError as error:
            raise ConversionError("", f"not JSON: {error}") from None

    def values(self, converter: Converter, cdr: bytes) -> dict[str, Any]:
        return converter.to_dict(cdr)
