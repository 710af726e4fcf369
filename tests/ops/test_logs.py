"""Log lines, for people and for machines."""

from __future__ import annotations

import io
import json
import logging
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from appliance.ops import logs


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    names = ("", "appliance", "appliance.ros", "amqtt")
    root = logging.getLogger()
    levels = {name: logging.getLogger(name).level for name in names}
    handlers = root.handlers[:]
    yield
    root.handlers[:] = handlers
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_level_for_each_logger() -> None:
    stream = io.StringIO()
    logs.setup("info", {"appliance.ros": "debug", "amqtt": "error"}, stream=stream)
    for name in ("appliance.broker", "appliance.ros.bridge", "amqtt.plugins", "other"):
        for level in (logging.DEBUG, logging.INFO, logging.WARNING, logging.ERROR):
            logging.getLogger(name).log(level, name)
    found = [(line.split()[2], line.split()[3]) for line in stream.getvalue().splitlines()]
    assert found == [
        ("INFO", "broker:"),
        ("WARNING", "broker:"),
        ("ERROR", "broker:"),
        ("DEBUG", "ros.bridge:"),
        ("INFO", "ros.bridge:"),
        ("WARNING", "ros.bridge:"),
        ("ERROR", "ros.bridge:"),
        ("ERROR", "amqtt.plugins:"),
        ("WARNING", "other:"),
        ("ERROR", "other:"),
    ]


def test_strangers_cannot_forge_lines_or_command_the_terminal() -> None:
    stream = io.StringIO()
    logs.setup(stream=stream)
    logging.getLogger("appliance.x").info("client %s", "a\nERROR b\x1b[2J\x9b\u2028é")
    assert stream.getvalue().endswith("x: client a\\x0aERROR b\\x1b[2J\\x9b\\u2028é\n")


#: What acts on a terminal, or turns the order of what it shows: C0, DEL, C1, ends of lines, and
#: Unicode's bidirectional control characters (UAX 9).
ACTING = "".join(
    map(chr, (*range(0x20), *range(0x7F, 0xA0), 0x61C, 0x200E, 0x200F, *range(0x2028, 0x202F)))
) + "".join(map(chr, range(0x2066, 0x206A)))


@pytest.mark.parametrize("form", ["human", "json"])
def test_nothing_in_a_line_acts_on_who_reads_it(form: Any) -> None:
    stream = io.StringIO()
    logs.setup(form=form, stream=stream)
    try:
        raise ValueError(f"no client {ACTING}\n2026-01-01 00:00:00.000 INFO forged")
    except ValueError:
        logging.getLogger("appliance.x").exception("client %s é€", ACTING)
    raw = stream.getvalue().rstrip("\n")
    if form == "json":
        assert not set(raw) & set(ACTING)
    else:  # a traceback has several lines, none of which looks like one of the log
        assert not set(raw) & (set(ACTING) - {"\n", "\t"})
        assert not any(line.startswith("2026-01-01") for line in raw.splitlines())
    assert "é€" in raw
    if form == "json":
        assert json.loads(raw)["message"] == f"client {ACTING} é€"
        assert ACTING in json.loads(raw)["exception"]
    else:
        assert "\\u202e" in raw and "ValueError: no client \\x00" in raw


def test_colour_only_on_a_terminal_that_wants_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    for stream, coloured in ((Terminal(), True), (io.StringIO(), False)):
        logs.setup(stream=stream)
        logging.getLogger("appliance").warning("x")
        assert ("\x1b[" in stream.getvalue()) is coloured
    monkeypatch.setenv("NO_COLOR", "1")
    logs.setup(stream=(stream := Terminal()))
    logging.getLogger("appliance").warning("x")
    assert "\x1b[" not in stream.getvalue()


def test_json_is_one_object_a_line() -> None:
    logs.setup(form="json", stream=(stream := io.StringIO()))
    try:
        raise KeyError("x\ny")
    except KeyError:
        logging.getLogger("appliance.broker").exception("two\nlines: %s", "é")
    line, *rest = stream.getvalue().splitlines()
    assert rest == []
    entry = json.loads(line)
    assert entry["level"] == "error"
    assert entry["logger"] == "appliance.broker"
    assert entry["message"] == "two\nlines: é"
    assert "KeyError" in entry["exception"]
    assert entry["time"].endswith("Z")
    assert sys.exc_info() == (None, None, None)
