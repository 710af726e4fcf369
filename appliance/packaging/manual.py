"""The man pages: appliance(1), and one for each of its commands, such as appliance-cert(1)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from appliance.packaging.commands import Command, tree

_FILES = """\
.SH FILES
.TP
.I /etc/appliance/appliance.yaml
The service's configuration; users, access rules and certificates are beside it.
.TP
.I /etc/default/appliance
Environment variables of the service.
.TP
.I /var/lib/appliance
Sessions and messages that outlive a restart.
.TP
.I /usr/share/doc/appliance/examples/appliance.yaml
Every key of the configuration, with its default.
.TP
.I /usr/share/doc/appliance/README.md
The first steps; the reference is in
.I docs
beside it.
.TP
.I /usr/share/appliance/fastdds.xml
What \\fBappliance fastdds\\fP prints, for ROS nodes that publish images.
"""
_EXIT = """\
.SH EXIT STATUS
.TP
.B 0
Success.
.TP
.B 1
Refused or failed; the reason is on standard error.
.TP
.B 2
Wrong usage.
"""


def pages(version: str, day: str) -> Iterator[tuple[str, str]]:
    """The name of each page's file, and its text. `day` is the date in its foot, as 2026-11-26."""
    whole = tree()
    names = [f"{whole.name}-{each.name}" for each in whole.commands]
    yield f"{whole.name}.1", _main_page(whole, version, day)
    for command, name in zip(whole.commands, names, strict=True):
        # Groups have their commands on their own page: `man appliance-cert` says all of them.
        body = "".join(_section(each) for each in command.commands)
        text = _head(name, command, version, day) + _description(command) + _options(command)
        also = ".SH SEE ALSO\n.BR appliance (1)\n"
        yield f"{name}.1", text + (f".SH COMMANDS\n{body}" if body else "") + _EXIT + also


def _main_page(whole: Command, version: str, day: str) -> str:
    listed = "".join(
        f".TP\n.BR {_escaped(f'{whole.name}-{each.name}')} (1)\n{_escaped(each.summary)}\n"
        for each in whole.commands
    )
    return (
        _head(whole.name, whole, version, day)
        + _description(whole)
        + _options(whole)
        + f".SH COMMANDS\n{listed}"
        + _FILES
        + _EXIT
    )


def _head(name: str, command: Command, version: str, day: str) -> str:
    summary = command.summary[:1].lower() + command.summary[1:].rstrip(".")
    return (
        f'.TH "{_escaped(name.upper())}" "1" "{day}" "appliance {version}" "User Commands"\n'
        f".SH NAME\n{_escaped(name)} \\- {_escaped(summary)}\n"
        f".SH SYNOPSIS\n{_synopsis(command)}"
    )


def _synopsis(command: Command) -> str:
    return f".B {_escaped(command.path)}\n{_escaped(command.usage)}\n"


def _description(command: Command) -> str:
    return f".SH DESCRIPTION\n{_paragraphs(command.help)}"


def _options(command: Command) -> str:
    return f".SH OPTIONS\n{_parameters(command)}"


def _section(command: Command) -> str:
    return (
        f'.SS "{_escaped(command.path)}"\n{_synopsis(command)}.PP\n'
        f"{_paragraphs(command.help)}{_parameters(command)}"
    )


def _parameters(command: Command) -> str:
    text = ""
    for name, explained in command.arguments:
        text += f".TP\n.I {_escaped(name)}\n{_escaped(explained)}\n"
    for option in command.options:
        names = ", ".join(f"\\fB{_escaped(name)}\\fP" for name in option.names)
        value = f" \\fI{_escaped(option.value)}\\fP" if option.value else ""
        text += f".TP\n{names}{value}\n{_escaped(option.help)}\n"
    return text


def _paragraphs(text: str) -> str:
    paragraphs = (" ".join(each.split()) for each in text.split("\n\n"))
    return ".PP\n".join(f"{_escaped(each)}\n" for each in paragraphs)


def _escaped(text: str) -> str:
    """For roff: a backslash, a dash that can be copied, and a line that looks like a request."""
    text = text.replace("\\", "\\e").replace("-", "\\-").replace('"', "\\(dq")
    text = re.sub(r"`([^`]+)`", r"\\fB\1\\fP", text)
    return f"\\&{text}" if text[:1] in (".", "'") else text
