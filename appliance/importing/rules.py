"""The lines of mosquitto's ACL file: the few that would mean something else here are rewritten."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path

from appliance.access import AccessFileError, Acl
from appliance.access.rules import BLANK
from appliance.importing.notes import ImportProblemsError, Notes, Place

#: As both brokers read a line: spaces between the words, and any blanks around the filter.
_CLAUSE = re.compile(
    r"(?P<head> *(?P<keyword>topic|pattern) +(?:(?P<access>read|write|readwrite|deny) +)?"
    rf"[{BLANK}]*)(?P<filter>[^{BLANK}].*)"
)
_NAMES = ("%c", "%u")
_ROBOT = "{robot}"  # which is replaced here


def carry_over(text: str, name: str, notes: Notes) -> str:
    """The rules as they mean the same here, line by line. Raises ImportProblemsError."""
    lines = []
    for number, line in enumerate(_lines(text), 1):
        if line.split()[:1] == ["include"]:
            problem = "mosquitto's rules have no `include`"
            raise ImportProblemsError([(Place(name, number), problem)])
        lines.append(_carried(line, Place(name, number), notes))
    carried = "\n".join(lines)
    _check(carried, name)
    return carried if carried.endswith("\n") else f"{carried}\n"


def _lines(text: str) -> list[str]:
    return text.split("\n")


def _check(text: str, name: str) -> None:
    with tempfile.TemporaryDirectory(prefix="appliance-import-") as directory:
        path = Path(directory, "acl.conf")
        path.write_text(text, encoding="utf-8")
        try:
            Acl.load(path, "robot")
        except AccessFileError as error:
            problems = [
                (Place(name, each.line), each.message.replace(directory, "").replace("/acl", "acl"))
                for each in error.problems
            ]
            raise ImportProblemsError(problems) from None


def _carried(line: str, place: Place, notes: Notes) -> str:
    found = _CLAUSE.fullmatch(line.rstrip(BLANK))
    if found is None:
        return line
    levels = found["filter"].split("/")
    if levels[0].upper() == "$CONTROL":
        why = "is left out: on $CONTROL the appliance is managed, docs/management.md"
        notes.add(place, line.strip(), why)
        return f"# {line}"
    odd = [level for level in levels if _is_odd(level, found["keyword"] == "pattern")]
    if not odd:
        return line
    what = "stands for the robot's name here" if odd[0].find(_ROBOT) >= 0 else "is no whole level"
    if found["access"] != "deny":
        text = f"is left out: {odd[0]!r} {what}; write what is meant for each client"
        notes.add(place, line.strip(), text, to_do=True)
        return f"# {line}"
    # + stands for no first level with $, which a name may have at its beginning, too.
    if levels[0] in odd and levels[0].startswith(("$", *_NAMES)):
        problem = f"{line.strip()}: {odd[0]!r} {what}; write what is denied to each client"
        raise ImportProblemsError([(place, problem)])
    text = f"denies more than it did: {odd[0]!r} {what}, and all that can be there is meant"
    notes.add(place, line.strip(), text, to_do=True)
    return found["head"] + "/".join("+" if level in odd else level for level in levels)


def _is_odd(level: str, pattern: bool) -> bool:
    """Whether the level of a filter means something else in mosquitto."""
    has_name = pattern and level not in _NAMES and any(name in level for name in _NAMES)
    return has_name or _ROBOT in level


def without_anonymous(text: str) -> str:
    """The rules without `topic` lines before the first user, which have applied to nobody."""
    kept: list[str] = []
    is_before = True
    for line in _lines(text):
        words = line.split()
        is_before = is_before and words[:1] != ["user"]
        if not (is_before and words[:1] == ["topic"]):
            kept.append(line)
    return "\n".join(kept)


def named_in(text: str) -> set[str]:
    """The users that the rules name."""
    words = (line.split(None, 1) for line in _lines(text))
    return {each[1].strip() for each in words if len(each) == 2 and each[0] == "user"}
