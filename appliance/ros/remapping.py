"""The graph's names as a node with remappings uses them.

With `/reset:=/base/reset` a node that calls `/reset` calls `/base/reset`. Routes are like the names
in a node's code: so that they find `/reset`, what the graph calls `/base/reset` is `/reset` here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TypeVar

T = TypeVar("T")

#: What is between the name of a ROS 2 action and those of its services and topics.
OF_ACTION = "/_action/"


def remapped_names(arguments: Iterable[str]) -> Iterator[str]:
    """The names that remappings among ROS arguments are for, `/reset` of `-r /reset:=/base/reset`.

    Without the prefix that restricts one to a node, or to topics or services.
    """
    before = ""
    for argument in arguments:
        name, separator, _ = argument.partition(":=")
        if separator and before not in ("-p", "--param"):
            name = name.rpartition("://" if "://" in name else ":")[2]
            if not name.startswith("__"):  # `__node` and `__ns` name the node itself
                yield name
        before = argument


def with_own_names(
    found: Mapping[str, T], remapped: Mapping[str, str], actions: Mapping[str, str]
) -> dict[str, T]:
    """What was `found` on the graph, by the names that this node uses.

    `remapped` has the name on the graph of each remapped name, and `actions` of each action. What
    the graph calls by a name that is remapped to another cannot be reached, and is left out.
    """
    parts = {f"{own}{OF_ACTION}": f"{target}{OF_ACTION}" for own, target in actions.items()}
    others = {*remapped, *remapped.values()}
    parts_of_others = (*parts, *parts.values())
    own_names = {}
    for name, value in found.items():
        for own, target in remapped.items():
            if name == target:
                own_names[own] = value
        for own, target in parts.items():
            if name.startswith(target):
                own_names[f"{own}{name.removeprefix(target)}"] = value
        if name not in others and not name.startswith(parts_of_others):
            own_names[name] = value
    return own_names
