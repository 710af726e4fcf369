"""Bridges as links to a fleet's broker: `upstreams` of appliance.yaml, with their access rules."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from appliance.config import UpstreamSection, format_duration
from appliance.importing.model import Bridge
from appliance.importing.notes import ImportProblemsError, Notes
from appliance.importing.reading import Statement, locate, words
from appliance.upstream.limits import kind_of_host

_KEEP_ALIVE = 60  # mosquitto's default, in seconds
_PORT = 1883
_FILES = {"bridge_cafile": "ca", "bridge_certfile": "certificate", "bridge_keyfile": "key"}
_EMPTY = '""'
_LEFT_OUT = ("bridge_psk", "bridge_identity")


@dataclass(frozen=True, slots=True)
class Link:
    """An entry of `upstreams`, the lines for acl.conf, and the password with its file's name."""

    section: dict[str, Any]
    rules: str
    secret: tuple[str, str] | None


@dataclass(frozen=True, slots=True)
class _Rule:
    """A `topic` line: the filter, where it is carried, and what is in front of it."""

    topic: str
    out: bool
    inward: bool
    qos: int
    local: str
    remote: str


def convert(
    bridges: list[Bridge], robot: str, directory: Path, notes: Notes, users: Collection[str]
) -> list[Link]:
    """The links; their users are none of these.

    Raises ImportProblemsError for bridges that mosquitto refuses as well.
    """
    links = []
    names: set[str] = set()
    for bridge in bridges:
        name = re.sub(r"[^A-Za-z0-9_.-]+", "-", bridge.name)[:60].strip("-_.") or "bridge"
        while name in names:
            name += "-2"
        names.add(name)
        if bridge.named(*_LEFT_OUT):
            continue
        user = f"upstream-{name}"
        while user in users:
            user += "-link"
        link = _link(bridge, name, user, robot, directory, notes)
        if link is not None:
            links.append(link)
    return links


def _link(
    bridge: Bridge, name: str, user: str, robot: str, directory: Path, notes: Notes
) -> Link | None:
    rules = [_parse(statement) for statement in bridge.named("topic")]
    found: dict[str, Any] = {"name": name, "servers": _servers(bridge)}
    kind = kind_of_host(_hosts(bridge)[0][0])
    if kind is not None:
        found["kind"] = kind
    found |= _version(bridge, rules, notes)
    found["client_id"] = _client_id(bridge, name, robot, notes)
    found["user"] = user
    login, secret = _login(bridge, name, notes)
    found |= login
    found |= _tls(bridge, directory, notes)
    keep_alive = bridge.get("keepalive_interval")
    seconds = _KEEP_ALIVE if keep_alive is None else min(max(keep_alive.number, 5), 65535)
    found["keep_alive"] = format_duration(seconds)
    found |= _rules(bridge, rules)
    _tell_of_user(bridge, user, notes)
    try:
        UpstreamSection.model_validate(found, context={"directory": directory})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        text = f"left out: {where} {first['msg'].removeprefix('Value error, ')}"
        notes.add(bridge.place, f"connection {bridge.name}", text, to_do=True)
        return None
    return Link(found, _access_rules(bridge, user, rules), secret)


def _hosts(bridge: Bridge) -> list[tuple[str, int]]:
    statement = bridge.get("address", "addresses")
    if statement is None:
        raise ImportProblemsError([(bridge.place, f"connection {bridge.name} has no address")])
    hosts = []
    for word in words(statement.value):
        host, colon, port = word.rpartition(":")
        if not colon or word.endswith("]"):  # a name, an IPv4 address, or [::1]
            host, port = word, str(_PORT)
        if not re.fullmatch(r"[0-9]{1,5}", port) or not 1 <= int(port) <= 65535 or not host:
            raise ImportProblemsError([(statement.place, "address is HOST or HOST:PORT")])
        hosts.append((host.strip("[]"), int(port)))
    if not hosts:
        raise ImportProblemsError([(statement.place, "address has no value")])
    return hosts


def _is_tls(bridge: Bridge) -> bool:
    has_file = bridge.get("bridge_cafile", "bridge_capath") is not None
    return has_file or bridge.flag("bridge_tls_use_os_certs")


def _servers(bridge: Bridge) -> list[str]:
    scheme = "mqtts" if _is_tls(bridge) else "mqtt"
    return [
        f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
        for host, port in _hosts(bridge)
    ]


def _parse(statement: Statement) -> _Rule:
    def wrong(text: str) -> ImportProblemsError:
        return ImportProblemsError([(statement.place, f"topic {text}")])

    quoted = re.match(r'"([^"]+)"(?:\s+(.*))?$', statement.value)
    if quoted:
        topic, rest = quoted[1], quoted[2] or ""
    else:
        topic, _, rest = statement.value.partition(" ")
    said = words(rest)
    defaults = ("out", "0", _EMPTY, _EMPTY)
    direction, qos, local, remote = (*said[:4], *defaults[len(said) :])
    if direction.lower() not in ("in", "out", "both"):
        raise wrong(f"goes in, out or both, not {direction[:20]!r}")
    if qos == _EMPTY:  # which mosquitto takes for 0
        qos = "0"
    if qos not in ("0", "1", "2"):
        raise wrong(f"has QoS 0, 1 or 2, not {qos[:20]!r}")
    topic, local, remote = (each.replace(_EMPTY, "") for each in (topic, local, remote))
    if not topic and not (local and remote):
        raise wrong('"" needs a local and a remote prefix')
    way = direction.lower()
    return _Rule(topic, way != "in", way != "out", int(qos), local, remote)


def _version(bridge: Bridge, rules: list[_Rule], notes: Notes) -> dict[str, Any]:
    statement = bridge.get("bridge_protocol_version")
    if statement is None or statement.value == "mqttv50":
        return {}
    if statement.value == "mqttv31":
        text = "a link speaks MQTT 5, and 3.1.1 where the server refuses that; not 3.1"
        notes.add(statement.place, statement.name, text)
        return {}
    if any(rule.out for rule in rules) and any(rule.inward for rule in rules):
        text = (
            "MQTT 5 is tried first, because 3.1.1 has nothing against loops of what goes both ways"
        )
        notes.add(statement.place, statement.name, text)
        return {}
    return {"version": "3.1.1"}


def _client_id(bridge: Bridge, name: str, robot: str, notes: Notes) -> str:
    statement = bridge.get("remote_clientid", "clientid")
    if statement is not None:
        return statement.value
    # mosquitto's is the computer's name and that of the connection.
    notes.add(
        bridge.place,
        f"connection {bridge.name}",
        f"the client id there is {robot}.{name}: no other client there may have it",
    )
    return f"{{robot}}.{name}"


def _login(
    bridge: Bridge, name: str, notes: Notes
) -> tuple[dict[str, Any], tuple[str, str] | None]:
    username = bridge.get("remote_username", "username")
    password = bridge.get("remote_password", "password")
    if username is None:
        if password is not None:
            text = "counts only with remote_username, as in mosquitto: it is left out"
            notes.add(password.place, password.name, text)
        return {}, None
    if password is None:
        return {"login": {"username": username.value}}, None
    file = f"{name}.password"
    login = {"username": username.value, "password_file": file}
    return {"login": login}, (file, f"{password.value}\n")


def _tls(bridge: Bridge, directory: Path, notes: Notes) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for option, key in _FILES.items():
        statement = bridge.get(option)
        if statement is None:
            continue
        path = locate(statement, directory, notes)
        if path is None:
            text = f"there is no file {statement.value} here that can be read: put it there, and "
            text += f"name it as tls.{key} of the link"
            notes.add(statement.place, option, text, to_do=True)
            if key == "ca":  # without it any certificate of the public CAs would do
                found[key] = str((directory / statement.value).absolute())
        else:
            found[key] = str(path.absolute())
    alpn = bridge.get("bridge_alpn")
    if alpn is not None:
        found["alpn"] = [alpn.value]
    if ("certificate" in found) != ("key" in found):
        found.pop("certificate", None)
        found.pop("key", None)
    return {"tls": found} if found else {}


def _rules(bridge: Bridge, rules: list[_Rule]) -> dict[str, Any]:
    out, inward = [], []
    retains = bridge.flag("bridge_outgoing_retain", default=True)
    is_kept = not bridge.flag("cleansession")
    for rule in rules:
        mapped: dict[str, Any] = {
            "topic": rule.topic,
            "local_prefix": rule.local,
            "remote_prefix": rule.remote,
        }
        if rule.out:
            qos = {"qos": 0} if rule.qos == 0 else {}
            out.append({**mapped, **qos, **({} if retains else {"retain": False})})
        if rule.inward:
            kept = {"offline": "keep"} if is_kept and rule.qos else {}
            inward.append({**mapped, **kept})
    return {**({"out": out} if out else {}), **({"in": inward} if inward else {})}


def _tell_of_user(bridge: Bridge, user: str, notes: Notes) -> None:
    local = bridge.get("local_username")
    if local is not None:
        text = f"the link is the user {user} here, who may do what its rules need (acl.conf)"
        notes.add(local.place, local.name, text)
    notifications = bridge.get("notifications")
    if notifications is not None and not notifications.flag:
        text = "the link's state is published, at PREFIX_appliance/state there: docs/upstream.md"
        notes.add(notifications.place, notifications.name, text)


def _access_rules(bridge: Bridge, user: str, rules: list[_Rule]) -> str:
    """`read` is what goes to the fleet, `write` what comes from there."""
    lines = [
        f"topic {'read' if is_out else 'write'} {rule.local}{rule.topic}"
        for rule in rules
        for is_out in (True, False)
        if (rule.out if is_out else rule.inward)
    ]
    head = f"\n# The link {bridge.name}: nobody logs in as this user."
    return "\n".join([head, f"user {user}", *dict.fromkeys(lines), ""])
