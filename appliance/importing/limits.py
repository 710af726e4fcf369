"""Limits, store and log: mosquitto's general options as keys of appliance.yaml."""

from __future__ import annotations

import re
from typing import Any

from appliance.broker.limits import USUAL_PACKET_SIZE
from appliance.config import format_duration, format_size
from appliance.config.settings import PACKET_SIZE_MAX
from appliance.importing.model import Configuration, Listener
from appliance.importing.notes import Notes
from appliance.importing.reading import Statement

# What a packet has beside its payload: the topic, at most 65,535 bytes, and some properties.
_PACKET_OVERHEAD = 66 << 10
_PACKET_SIZE_MIN = 128
_INFLIGHT_MAX = 65535
_KEEP_ALIVE_MAX = 65535
_MEMORY_MIN = 1 << 10
_EXPIRY_MAX = 0xFFFF_FFFE
_UNITS = {"s": 1, "h": 3600, "d": 86_400, "w": 7 * 86_400, "m": 30 * 86_400, "y": 365 * 86_400}

_BOUNDED = "0 is no limit there, and here everything that waits is bounded: it is left at {}"


def limits(configuration: Configuration, listeners: list[Listener], notes: Notes) -> dict[str, Any]:
    """The section `broker.limits`, for these of its listeners."""
    found: dict[str, Any] = {}
    last = {statement.name: statement for statement in configuration.general.statements}
    for statement in last.values():
        _limit(statement, found, notes)
    _connections(configuration, listeners, found, notes)
    aliases = [each for block in listeners if (each := block.get("max_topic_alias")) is not None]
    if aliases:
        found["topic_alias"] = min(max(max(each.number for each in aliases), 0), 65535)
        if len({each.number for each in aliases}) > 1:
            text = "one limit holds for all listeners: the largest is taken"
            notes.add(aliases[-1].place, "max_topic_alias", text)
    return found


def _limit(statement: Statement, found: dict[str, Any], notes: Notes) -> None:
    name, place = statement.name, statement.place

    def bounded(default: str) -> bool:
        if statement.number > 0:
            return False
        notes.add(place, name, _BOUNDED.format(default))
        return True

    if name == "max_inflight_messages":
        number = statement.number
        found["inflight"] = number if 0 < number < _INFLIGHT_MAX else _INFLIGHT_MAX
    elif name == "max_queued_messages" and not bounded("1000 messages (limits.queue_messages)"):
        found["queue_messages"] = statement.number
    elif name == "max_queued_bytes" and not bounded("16 MiB (limits.queue_bytes)"):
        found["queue_bytes"] = format_size(statement.number)
    elif name == "max_packet_size":
        size = min(max(statement.number, _PACKET_SIZE_MIN), PACKET_SIZE_MAX)
        found["packet_size"] = format_size(size)
        if size != statement.number:
            notes.add(place, name, f"the nearest that can be set is {format_size(size)}")
    elif name == "message_size_limit" and statement.number > 0:
        found["payload_size"] = format_size(statement.number)
        if statement.number + _PACKET_OVERHEAD > USUAL_PACKET_SIZE:
            size = min(statement.number + _PACKET_OVERHEAD, PACKET_SIZE_MAX)
            found.setdefault("packet_size", format_size(size))
    elif name == "max_keepalive" and 0 < statement.number < _KEEP_ALIVE_MAX:
        found["keep_alive"] = format_duration(statement.number)
        text = "clients of MQTT 3 are refused if they ask for more, as they cannot be told"
        notes.add(place, name, text)
    elif name == "memory_limit" and statement.number >= _MEMORY_MIN:
        found["memory"] = format_size(statement.number)
        text = "limits.memory is what waits for clients, and not the whole process"
        notes.add(place, name, f"{text} (for that: MemoryMax of the systemd unit)")
    elif name == "persistent_client_expiration":
        _expiry(statement, found, notes)
    elif name == "global_max_clients" and statement.number > 0:
        found["sessions"] = statement.number


def _expiry(statement: Statement, found: dict[str, Any], notes: Notes) -> None:
    match = re.fullmatch(r"([0-9]{1,9})([shdwmy])", statement.value)
    if match is None or not int(match[1]):
        text = "is a number with h, d, w, m or y, such as 14d: sessions are kept for 7 days"
        notes.add(statement.place, statement.name, text, to_do=True)
        return
    seconds = min(int(match[1]) * _UNITS[match[2]], _EXPIRY_MAX)
    found["session_expiry"] = format_duration(seconds)


def _connections(
    configuration: Configuration, listeners: list[Listener], found: dict[str, Any], notes: Notes
) -> None:
    each = [listener.get("max_connections") for listener in listeners]
    wanted = [one for one in each if one is not None and one.number > 0]
    whole = configuration.general.get("global_max_connections")
    if whole is not None and whole.number > 0:
        found["connections"] = whole.number
    elif wanted and len(wanted) == len(each):
        found["connections"] = sum(one.number for one in wanted)
    if not wanted or len(each) == 1:
        return
    number = found.get("connections", "1000, the default")
    for one in wanted:
        text = f"connections are counted for all listeners: limits.connections is {number}"
        notes.add(one.place, one.name, text)


def store(configuration: Configuration, notes: Notes) -> dict[str, Any]:
    """The section `broker.store`."""
    persistence = configuration.general.get("persistence", "retained_persistence")
    if persistence is None or persistence.flag:
        return {}
    text = "broker.store.durability is off: sessions and retained messages end with the process"
    notes.add(persistence.place, persistence.name, f"{text}; power keeps them")
    return {"durability": "off"}


def sys_interval(configuration: Configuration) -> dict[str, Any]:
    """The key `broker.sys_interval`, if there is one."""
    found = configuration.general.get("sys_interval")
    return {} if found is None else {"sys_interval": format_duration(max(found.number, 0))}


def log(configuration: Configuration, notes: Notes) -> dict[str, Any]:
    """The section `log`."""
    for statement in configuration.general.named("log_dest"):
        if statement.value.split()[0] not in ("stderr", "stdout", "syslog"):
            text = (
                "the log goes to standard error, which systemd's journal keeps: see "
                "journalctl -u appliance, or appliance log"
            )
            notes.add(statement.place, "log_dest", text)
    types = configuration.general.named("log_type")
    if not types:
        return {}
    said = {each.value for each in types}
    last = types[-1]
    if "none" in said:
        notes.add(last.place, "log_type", "the least that can be logged is errors (log.level)")
    if "debug" in said:
        return {"level": "debug"}
    if "all" in said:
        notes.add(last.place, "log_type", "all is taken as log.level info; debug has every packet")
    if said & {"all", "information", "notice", "subscribe", "unsubscribe"}:
        return {"level": "info"}
    return {"level": "warning" if "warning" in said else "error"}
