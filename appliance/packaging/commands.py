"""The commands of `appliance`, as data: what man pages and shell completion are made of.

Read from the commands themselves, as their `--help` is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from inspect import cleandoc
from typing import Any

import typer

from appliance.cli import main as cli

NAME = "appliance"


@dataclass(frozen=True, slots=True)
class Option:
    """`names` with their dashes, short ones first; `value` is empty for a flag."""

    names: tuple[str, ...]
    value: str
    help: str

    @property
    def choices(self) -> list[str]:
        """The values that it can have, when these are few: of `<human|json>`."""
        return self.value.strip("<>").split("|") if "|" in self.value else []

    @property
    def is_file(self) -> bool:
        return self.value in ("FILE", "DIR")


@dataclass(frozen=True, slots=True)
class Command:
    """`path` is how it is called: `appliance`, or `appliance cert issue`."""

    path: str
    help: str
    usage: str
    options: tuple[Option, ...]
    arguments: tuple[tuple[str, str], ...]
    commands: tuple[Command, ...]

    @property
    def name(self) -> str:
        return self.path.rpartition(" ")[2]

    @property
    def summary(self) -> str:
        return " ".join(self.help.partition("\n\n")[0].split())

    def walk(self) -> Iterator[Command]:
        """It, and all below it."""
        yield self
        for command in self.commands:
            yield from command.walk()


def tree() -> Command:
    """`appliance`, with all its commands."""
    return _command(typer.main.get_command(cli.app), NAME, None)


def _command(command: Any, name: str, parent: Any) -> Command:
    context = command.make_context(name, [], parent=parent, resilient_parsing=True)
    options, arguments = [], []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is None:  # hidden
            continue
        called, explained = record[0], " ".join(record[1].split())
        if parameter.param_type_name == "argument":
            arguments.append((called.partition(" ")[0], explained))
            continue
        # A flag and its opposite have a stroke between them: `--start / --no-start`.
        words = called.replace(",", "").replace(" / ", " ").split()
        names = tuple(word for word in words if word.startswith("-"))
        options.append(Option(names, " ".join(words[len(names) :]), explained))
    below = [(each, found) for each, found in getattr(command, "commands", {}).items()]
    return Command(
        context.command_path,
        cleandoc(command.help or ""),
        " ".join(command.collect_usage_pieces(context)),
        tuple(options),
        tuple(arguments),
        tuple(_command(found, each, context) for each, found in below if not found.hidden),
    )
