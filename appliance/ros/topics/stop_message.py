"""The stop message of a route with command rules."""

from __future__ import annotations

from appliance.ros.payload.converter import ConversionError, Converter
from appliance.ros.topics.conversions import LITTLE
from appliance.ros.topics.rules import CommandRules, FieldLimits


class StopMessage:
    """The stop message of a route, for one type."""

    def __init__(self, converter: Converter, payload: str) -> None:
        """Raises ConversionError when the type has no such message."""
        self._converter = converter
        self._payload = payload.encode()
        self.example = self.cdr()
        self._says = self._said_by(self.example)

    def cdr(self) -> bytes:
        """The message, made anew each time: it may contain "now"."""
        return self._converter.from_json(self._payload)

    def is_like(self, cdr: bytes) -> bool:
        """Whether a message is equivalent, with another time stamp or frame."""
        if abs(len(cdr) - len(self.example)) > LITTLE:
            return False  # no name of a frame is that long
        try:
            return self._said_by(cdr) == self._says
        except ConversionError:  # of another type, from before a reload or another route
            return False

    def _said_by(self, cdr: bytes) -> dict[str, object]:
        fields = self._converter.to_dict(cdr)
        return {name: value for name, value in fields.items() if name != "header"}


def check_rules(
    rules: CommandRules, converter: Converter
) -> tuple[FieldLimits | None, StopMessage | None]:
    """The limits and the stop message of a route for messages of one type.

    Raises ConversionError when the rules do not fit the type.
    """
    limits = FieldLimits(rules, converter) if rules.clamp or rules.allow else None
    stop = None
    if rules.on_silence is not None:
        try:
            stop = StopMessage(converter, rules.on_silence.publish)
        except ConversionError as error:
            raise ConversionError("on_silence.publish", str(error)) from None
    return limits, stop
