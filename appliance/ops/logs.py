"""Logging: each event is one line for people, or one JSON object for machines."""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections import deque
from collections.abc import Mapping
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Literal, TextIO

from appliance.config import Level

_COLOURS = {"DEBUG": "\x1b[2m", "WARNING": "\x1b[33m", "ERROR": "\x1b[31m", "CRITICAL": "\x1b[31m"}
_RESET = "\x1b[0m"

# Client ids, user names and topics come from strangers and are logged. Unescaped they could forge
# log lines, send commands to the terminal that shows them, or reorder what it shows. Escaped are
# C0, DEL and C1, and Unicode's line separators and bidirectional controls (UAX 9).
_BIDIRECTIONAL = (0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
VISIBLE = {code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0))}
VISIBLE |= {code: f"\\u{code:04x}" for code in (0x2028, 0x2029, *_BIDIRECTIONAL)}
#: The same for texts of several lines.
VISIBLE_IN_LINES = {code: text for code, text in VISIBLE.items() if code not in (0x09, 0x0A)}
# json.dumps escapes C0 itself.
_VISIBLE_IN_JSON = {code: f"\\u{code:04x}" for code in VISIBLE if code >= 0x7F}

#: The last lines that were logged, for crash reports and for who manages the appliance.
recent: deque[str] = deque(maxlen=1000)
_LONGEST_RECENT = 2000


def setup(
    level: Level = "info",
    levels: Mapping[str, Level] | None = None,
    form: Literal["human", "json"] = "human",
    stream: TextIO | None = None,
) -> None:
    """Send all logging to `stream` (standard error), replacing the previous set-up.

    `level` is that of the project's own loggers; those of other packages log warnings and errors.
    `levels` sets single loggers of any package: `{"appliance.ros": "debug", "amqtt": "info"}`.
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


if TYPE_CHECKING:
    _StreamHandler = logging.StreamHandler[TextIO]
else:  # Python 3.10 takes no type there
    _StreamHandler = logging.StreamHandler


class _Handler(_StreamHandler):
    def format(self, record: logging.LogRecord) -> str:
        line = super().format(record)
        recent.append(line[:_LONGEST_RECENT])
        return line


class HumanFormatter(logging.Formatter):
    """`2026-01-31 12:34:56.789 INFO    listeners: …`, in local time, with or without colour."""

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
            line += "\n" + traceback.replace("\n", "\n  ")  # indented, so it forges no line
        return line


class JsonFormatter(logging.Formatter):
    """One JSON object on each line: time (UTC, ISO 8601), level, logger, message, exception."""

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
    """JSON for people and machines: only characters that would control a terminal are escaped."""
    text = json.dumps(value, ensure_ascii=False, indent=indent)
    return text.translate(_VISIBLE_IN_JSON)
