"""mosquitto.conf becomes appliance.yaml, users.passwd, acl.conf, and a list of differences."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from appliance.importing import access, bridges, limits, listeners, rules
from appliance.importing.model import Block, Configuration, assemble
from appliance.importing.notes import ImportProblemsError, Note, Notes, Place
from appliance.importing.options import option_of
from appliance.importing.reading import Reader

_HEAD = """\
# Made from {name} by `appliance import`. What is left out has a safe default; every key,
# its default and why it is there: the appliance.yaml of the project, or `appliance check --show`.

"""

#: As `appliance init` writes it: nodes of this computer only.
_BRIDGE = {"discovery": "localhost", "topics": []}


@dataclass(frozen=True, slots=True)
class NewFile:
    """A file to be written; `is_secret` when nobody else may read it."""

    name: str
    text: str
    what: str
    is_secret: bool = False


@dataclass(frozen=True, slots=True)
class Imported:
    """What to write, in this order, and what is different. `carried` options are so here now, of
    `options` that the file has."""

    files: tuple[NewFile, ...]
    notes: tuple[Note, ...]
    carried: int
    options: int


def import_mosquitto(path: Path, robot: str) -> Imported:
    """Read the file and those that it names, and convert them; nothing is written.

    Raises ImportProblemsError when the configuration has mistakes, which it lists.
    """
    notes = Notes()
    configuration = assemble(Reader(path, notes).read(), path.name, notes)
    directory = path.parent
    blocks: list[Block] = [
        configuration.general,
        *configuration.listeners,
        *configuration.bridges,
    ]
    for block in blocks:
        listeners.without_counterpart(block, notes)
    kept = listeners.carried(configuration, notes)
    if not kept:
        place = Place(path.name, 0)
        raise ImportProblemsError(
            [(place, "no listener can be carried over"), *((n.place, n.text) for n in notes.found)]
        )
    who = access.convert(configuration, kept, directory, notes)
    users = {*who.names, *rules.named_in(who.acl)}
    links = bridges.convert(configuration.bridges, robot, directory, notes, users)
    broker: dict[str, Any] = {
        "listeners": [
            listeners.section(listener, who.by_listener.get(index), configuration.general, notes)
            for index, listener in enumerate(kept)
        ],
        **({"anonymous": True} if who.anonymous else {}),
    }
    parts = {
        "tls": listeners.tls(kept, directory, notes),
        "limits": limits.limits(configuration, kept, notes),
        "store": limits.store(configuration, notes),
        "log": limits.log(configuration, notes),
    }
    log = parts.pop("log")
    broker |= {key: part for key, part in parts.items() if part}
    broker |= limits.sys_interval(configuration)
    settings: dict[str, Any] = {"robot": robot, "broker": broker, "bridge": _BRIDGE}
    if links:
        settings["upstreams"] = [link.section for link in links]
    if log:
        settings["log"] = log
    secrets = [NewFile(*link.secret, "a password", True) for link in links if link.secret]
    files = (
        NewFile("users.passwd", who.users, _users(who.names), True),
        NewFile("acl.conf", who.acl + "".join(link.rules for link in links), "access rules"),
        *secrets,
        NewFile("appliance.yaml", _text(path.name, settings), f"configuration of {robot}"),
    )
    return Imported(files, _sorted(notes), *_count(configuration, notes))


def _users(names: tuple[str, ...]) -> str:
    return f"users: {', '.join(names)}" if names else "no users"


def _text(name: str, settings: dict[str, Any]) -> str:
    text = yaml.safe_dump(
        settings, sort_keys=False, allow_unicode=True, width=100, default_flow_style=None
    )
    return _HEAD.format(name=name if name.isprintable() else repr(name)) + text


def _sorted(notes: Notes) -> tuple[Note, ...]:
    """By file, in the order of their first mention, and by line."""
    files = {note.place.file: None for note in notes.found}
    order = {file: index for index, file in enumerate(files)}
    return tuple(sorted(notes.found, key=lambda note: (order[note.place.file], note.place.line)))


def _count(configuration: Configuration, notes: Notes) -> tuple[int, int]:
    statements = [
        each
        for block in (configuration.general, *configuration.listeners, *configuration.bridges)
        for each in block.statements
    ]
    noted = {note.place for note in notes.found}
    carried = 0
    for each in statements:
        option = option_of(each.name)
        carried += option is not None and option.fate == "carried" and each.place not in noted
    return carried, len(statements)
