"""Logging: one line an event for people, or one JSON object an event for machines."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections import deque
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import Literal, TextIO

from appliance.config import Level

_COLOURS = {"DEBUG": "\x1b[2m", "WARNING": "\x1b[33m", "ERROR": "\x1b[31m", "CRITICAL": "\x1b[31m"}
_RESET = "\x1b[0m"

# Client ids, user names and topics come from strangers and end up in log lines: without this they
# could forge lines, send commands to the terminal that shows them, or turn the order of what it
# shows. C0, DEL and C1; ends of lines and the bidirectional controls of Unicode (UAX 9).
_BIDIRECTIONAL = (0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
VISIBLE = {code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0))}
VISIBLE |= {code: f"\\u{code:04x}" for code in (0x2028, 0x2029, *_BIDIRECTIONAL)}
#: The same of texts that have several lines.
VISIBLE_IN_LINES = {code: text for code, text in VISIBLE.items() if code not in (0x09, 0x0A)}
# JSON escapes the first of them itself.
_VISIBLE_IN_JSON = {code: f"\\u{code:04x}" for code in VISIBLE if code >= 0x7F}

#: The last lines that were logged, for a crash's report.
recent: deque[str] = deque(maxlen=100)
_LONGEST_RECENT = 2000


def setup(
    level: Level = "info",
    levels: Mapping[str, Level] | None = None,
    form: Literal["human", "json"] = "human",
    stream: TextIO | None = None,
) -> None:
    """Sends all logging to `stream` (standard error), in place of what was set up before.

    `level` is this project's own; other packages' loggers speak from warning on. `levels` sets
    single loggers, whoever's they are: `{"appliance.ros": "debug", "amqtt": "info"}`.
    """
    stream = stream or sys.stderr
    handler = _Handler(stream)
    colour = stream.isatty() and "NO_COLOR" not in os.environ
    handler.setFormatter(JsonFormatter() if form == "json" else HumanFormatter(colour=colour))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)
    for name, own in {"appliance": level, **(levels or {})}.items():
        logging.getLogger(name).setLevel(own.upper())


class _Handler(logging.StreamHandler[TextIO]):
    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        recent.append(line[:_LONGEST_RECENT])
        return line


class HumanFormatter(logging.Formatter):
    """`2026-01-31 12:34:56.789 INFO    listeners: …`, local time; colour when asked for."""

    def __init__(self, *, colour: bool = False) -> None:
        super().__init__()
        self._colour = colour

    def format(self, record: logging.LogRecord) -> str:
        clock = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.created))
        name = record.name.removeprefix("appliance.")
        message = record.getMessage().translate(VISIBLE)
        line = f"{clock}.{int(record.msecs):03d} {record.levelname:<7} {name}: {message}"
        if self._colour and record.levelname in _COLOURS:
            line = f"{_COLOURS[record.levelname]}{line}{_RESET}"
        if record.exc_info:
            traceback = self.formatException(record.exc_info).translate(VISIBLE_IN_LINES)
            line += "\n" + traceback.replace("\n", "\n  ")  # an exception's text forges no line
        return line


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time (UTC, ISO 8601), level, logger, message, exception if any."""

    def format(self, record: logging.LogRecord) -> str:
        moment = datetime.fromtimestamp(record.created, timezone.utc)
        entry = {
            "time": moment.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json_text(entry)


def json_text(value: object, indent: int | None = None) -> str:
    """JSON for people and machines: what would act on a terminal is escaped, and only that."""
    text = json.dumps(value, ensure_ascii=False, indent=indent)
    return text.translate(_VISIBLE_IN_JSON)
