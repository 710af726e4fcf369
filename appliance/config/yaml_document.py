"""A YAML parser that records the line of each value.

Extensions: `${NAME}` and `${NAME:-default}` are replaced by environment variables (`$${NAME}` is
the text itself), and a duplicate key is an error instead of a silent replacement.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

KeyPath = tuple["str | int", ...]
"""The keys and list positions that lead to a value, from the top of the file."""

#: Limit on values, aliases expanded: a few lines of nested aliases can expand to billions.
_MAX_VALUES = 100_000

_VARIABLE = re.compile(r"\$?\$\{([A-Za-z_][A-Za-z0-9_]*)(?::-([^}]*))?\}")


@dataclass(frozen=True)
class ConfigProblem:
    """One problem: its file, line (0: the file as a whole) and key, and what is wrong."""

    file: Path
    line: int
    key: str
    what: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else str(self.file)
        return f"{place}: {self.key}: {self.what}" if self.key else f"{place}: {self.what}"


def dotted(path: KeyPath) -> str:
    """The path in dotted form: `bridge.topics[0].rate`."""
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in path)
    return "".join(parts).removeprefix(".")


class YamlDocument:
    """One YAML document: its values, and its syntax problems (`faulty`: the keys that have one)."""

    def __init__(self, text: str, file: Path, environment: Mapping[str, str]) -> None:
        self.file = file
        self.problems: list[ConfigProblem] = []
        self.faulty: set[KeyPath] = set()
        self._environment = environment
        self._lines: dict[KeyPath, int] = {}
        self._written: dict[KeyPath, str] = {}
        self._count = 0
        self.values = self._read(text)

    def line(self, path: KeyPath) -> int:
        """The line of that key, or of the nearest key above it in the tree; 0 for none."""
        while path and path not in self._lines:
            path = path[:-1]
        return self._lines.get(path, 0)

    def written(self, path: KeyPath) -> str | None:
        """The value as written, before substitution; None for a list or a mapping."""
        return self._written.get(path)

    def problem(self, path: KeyPath, what: str) -> ConfigProblem:
        """A problem at that key, with its line; the caller collects it."""
        return ConfigProblem(self.file, self.line(path), dotted(path), what)

    def _report(self, path: KeyPath, what: str) -> None:
        self.faulty.add(path)
        self.problems.append(self.problem(path, what))

    def _read(self, text: str) -> dict[str, Any]:
        try:
            loader = yaml.SafeLoader(text)
            root = loader.get_single_node()
            if root is None:
                return {}
            if isinstance(root, yaml.MappingNode):
                return self._mapping(loader, root, (), (root,))
            self._report((), "must be keys with values, such as `robot: r2d2`")
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            what = ", ".join(part for part in (error.problem, error.context) if part)
            self.problems.append(ConfigProblem(self.file, mark.line + 1 if mark else 0, "", what))
            self.faulty.add(())
        except (yaml.YAMLError, RecursionError) as error:
            self._report((), str(error).splitlines()[0])
        return {}

    def _value(
        self, loader: yaml.SafeLoader, node: yaml.Node, path: KeyPath, around: tuple[yaml.Node, ...]
    ) -> Any:
        self._count += 1
        if self._count > _MAX_VALUES:
            raise yaml.YAMLError(f"more than {_MAX_VALUES} values, those of aliases among them")
        self._lines.setdefault(path, node.start_mark.line + 1)
        if node in around:
            self._report(path, "is an alias of something that contains it")
            return None
        if isinstance(node, yaml.MappingNode):
            return self._mapping(loader, node, path, (*around, node))
        if isinstance(node, yaml.SequenceNode):
            return [
                self._value(loader, item, (*path, position), (*around, node))
                for position, item in enumerate(node.value)
            ]
        assert isinstance(node, yaml.ScalarNode)
        return self._scalar(loader, node, path)

    def _mapping(
        self,
        loader: yaml.SafeLoader,
        node: yaml.MappingNode,
        path: KeyPath,
        around: tuple[yaml.Node, ...],
    ) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                self.problems.append(
                    ConfigProblem(self.file, line, dotted(path), "a key must be text")
                )
                continue
            inner = (*path, key_node.value)
            if key_node.value in values:
                what = f"is given twice; the first is on line {self._lines[inner]}"
                self.problems.append(ConfigProblem(self.file, line, dotted(inner), what))
                continue
            self._lines[inner] = line
            values[key_node.value] = self._value(loader, value_node, inner, around)
        return values

    def _scalar(self, loader: yaml.SafeLoader, node: yaml.ScalarNode, path: KeyPath) -> Any:
        self._written[path] = node.value
        text, tag = node.value, node.tag
        if "${" in text:
            text = _VARIABLE.sub(lambda match: self._variable(match, path), text)
            if node.style is None:  # unquoted: a variable may hold a number
                tag = loader.resolve(yaml.ScalarNode, text, (True, False))  # type: ignore[no-untyped-call]
        try:
            return loader.construct_object(yaml.ScalarNode(tag, text, node.start_mark))
        except ValueError as error:  # such as a date that no calendar has
            self._report(path, str(error))
            return None

    def _variable(self, match: re.Match[str], path: KeyPath) -> str:
        if match[0].startswith("$$"):
            return match[0][1:]
        name, default = match[1], match[2]
        value = self._environment.get(name)
        if default is not None:  # as in a shell, the default also replaces an empty value
            return value or default
        if value is None:
            self._report(path, f"the environment variable {name} is not set")
            return ""
        return value
