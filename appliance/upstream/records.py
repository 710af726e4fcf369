"""Records: messages on their way to the fleet's broker, as bytes that a backlog stores.

A record is a header of fixed length, the texts, the properties and the payload. What a backlog asks
of waiting records (their order, age and expiry) is read from the header without decoding the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from struct import Struct
from typing import Final

from appliance.mqtt.codec import NO_PROPERTIES

#: The first byte of a record. A newer layout gets another one.
VERSION: Final = 1

#: The version, the sequence number, when it was stored and when it expires, the flags; then the
#: lengths of rule, topic, properties and payload, which follow in this order. A message that does
#: not expire does so at infinity.
_HEADER: Final = Struct(">BQddBHHII")
_LENGTH: Final = _HEADER.size

#: The part of the header that a waiting record is asked for.
_TIMES: Final = Struct(">xQdd")
#: The part of the header with the lengths of the texts.
_TEXTS: Final = Struct(">26xHH")

_QOS: Final = 0x03
_RETAIN: Final = 0x04


@dataclass(init=False, slots=True)
class Record:
    """A message as it will be sent; times are in seconds of the journal's clock.

    `number` grows with each message of a link and is the same each time the message is sent. `rule`
    is the filter, here, of the rule that carries it, `topic` is the topic there. `qos` is that of
    its publisher. `properties_wire` is as in `broker.message.Message`.
    """

    number: int
    rule: str
    topic: str
    payload: bytes
    qos: int
    retain: bool
    stored_at: float
    expires_at: float | None
    properties_wire: bytes

    # Not the dataclass's own, which stays interpreted in the compiled build: it took a tenth of the
    # time in which a backlog drains.
    def __init__(
        self,
        number: int,
        rule: str,
        topic: str,
        payload: bytes,
        qos: int,
        retain: bool,
        stored_at: float,
        expires_at: float | None = None,
        properties_wire: bytes = NO_PROPERTIES,
    ) -> None:
        self.number = number
        self.rule = rule
        self.topic = topic
        self.payload = payload
        self.qos = qos
        self.retain = retain
        self.stored_at = stored_at
        self.expires_at = expires_at
        self.properties_wire = properties_wire

    def encode(self) -> bytes:
        """The bytes to be stored."""
        return encode_record(
            self.number,
            self.rule.encode(),
            self.topic,
            self.payload,
            self.qos,
            self.retain,
            self.stored_at,
            self.expires_at,
            self.properties_wire,
        )

    @staticmethod
    def decode(data: bytes) -> Record:
        """The record of these bytes, all of which it must be.

        Raises:
            ValueError: these bytes are no record, or of another version of the appliance.
        """
        return RecordDecoder().decode(data)


class RecordDecoder:
    """Decodes records; rule and topic only where they differ from those of the record before."""

    def __init__(self) -> None:
        self._texts = b""
        self._rule_size = 0
        self._rule = ""
        self._topic = ""

    def decode(self, data: bytes) -> Record:
        """See `Record.decode`."""
        if len(data) < _LENGTH or data[0] != VERSION:
            raise ValueError("no record, or one of another version")
        number: int
        stored_at: float
        expires_at: float
        flags: int
        rule_size: int
        topic_size: int
        properties: int
        payload: int
        _, number, stored_at, expires_at, flags, rule_size, topic_size, properties, payload = (
            _HEADER.unpack_from(data)
        )
        properties_at = _LENGTH + rule_size + topic_size
        payload_at = properties_at + properties
        if payload_at + payload != len(data):
            raise ValueError(f"a record of {payload_at + payload} bytes in {len(data)}")
        if flags > (_QOS | _RETAIN) or flags & _QOS == _QOS or not topic_size or not properties:
            raise ValueError("a record with invalid fields")
        if not (-math.inf < stored_at < math.inf and expires_at > -math.inf):  # nor NaN
            raise ValueError("a record of no time")
        texts = data[_LENGTH:properties_at]
        if texts != self._texts or rule_size != self._rule_size:
            rule, topic = texts[:rule_size].decode(), texts[rule_size:].decode()
            self._texts, self._rule_size, self._rule, self._topic = texts, rule_size, rule, topic
        return Record(
            number,
            self._rule,
            self._topic,
            data[payload_at:],
            flags & _QOS,
            flags > _QOS,
            stored_at,
            None if expires_at == math.inf else expires_at,
            data[properties_at:payload_at],
        )


def encode_record(
    number: int,
    rule: bytes,
    topic: str,
    payload: bytes,
    qos: int,
    retain: bool,
    stored_at: float,
    expires_at: float | None,
    properties_wire: bytes,
) -> bytes:
    """`Record.encode` without a `Record`, for the way of each message; `rule` is encoded."""
    name = topic.encode()
    header = _HEADER.pack(
        VERSION,
        number,
        stored_at,
        math.inf if expires_at is None else expires_at,
        qos | _RETAIN if retain else qos,
        len(rule),
        len(name),
        len(properties_wire),
        len(payload),
    )
    return b"".join((header, rule, name, properties_wire, payload))


def record_head(data: bytes) -> bytes:
    """The record without its properties and payload: one that says what it is and its times."""
    fields = _HEADER.unpack_from(data)
    rule_size, topic_size = fields[5:7]
    header = _HEADER.pack(*fields[:7], len(NO_PROPERTIES), 0)
    return header + data[_LENGTH : _LENGTH + rule_size + topic_size] + NO_PROPERTIES


def record_topic(data: bytes) -> str:
    """A record's topic. Raises ValueError."""
    if len(data) < _LENGTH:
        raise ValueError("no record")
    rule_size, topic_size = _TEXTS.unpack_from(data)
    start = _LENGTH + rule_size
    return data[start : start + topic_size].decode()


def record_times(data: bytes) -> tuple[int, float, float]:
    """A record's number, when it was stored, and when it expires: infinity when it does not."""
    number, stored_at, expires_at = _TIMES.unpack_from(data)
    return number, stored_at, expires_at
