"""Checks the access rules: what nobody can have meant, and who may send to routes to ROS."""

from __future__ import annotations

import re
from collections.abc import Iterator

from appliance.access import Acl
from appliance.access.rules import Permission, Rule
from appliance.broker.values import Action, Identity
from appliance.config import Settings
from appliance.ops.finding import Finding
from appliance.ros.home_assistant import PREFIX

_PLACEHOLDER = re.compile(r"\{[^/]*\}|%[A-Za-z]")

#: Names in one finding.
_SHOWN = 5


def rights(settings: Settings, acl: Acl, users: list[str] | None) -> Iterator[Finding]:
    """Findings about the rules; `users` is None when the users file cannot be read."""
    for rule in acl.rules:
        text = _mistake(rule)
        if text:
            yield Finding("warning", f"{rule.file}:{rule.line}", text)
    broker = settings.broker
    # Plugins and certificates may know users of their own, and rules for them.
    if users and not broker.plugins and broker.tls.username_from == "none":
        for route in settings.bridge.topics:
            if not (route.is_exclusion or route.is_pattern) and route.to != "mqtt":
                yield _writers(acl, users, route.names[0], route.topic(settings.robot), settings)
        if settings.bridge.home_assistant and settings.bridge.bus != "none":
            links = [
                link.user for link in settings.upstreams
            ]  # Home Assistant's broker may be there
            yield _told(acl, [*users, *links], f"{PREFIX}/#", settings)


def _mistake(rule: Rule) -> str:
    """Why a placeholder in the rule's filter has no effect; empty when there is none like that."""
    for level in rule.filter.split("/"):
        if rule.pattern and level in ("%c", "%u"):
            continue
        found = _PLACEHOLDER.search(level)
        if found is None:
            continue
        if found[0].startswith("{"):
            return f"{found[0]!r} stands for nothing, only {{robot}} does; did you mean that?"
        if found[0] in ("%c", "%u"):
            return f"{found[0]} stands for a name in `pattern` lines only, not in `topic` lines"
        if rule.pattern:
            return f"{found[0]!r} stands for nothing; %c is the client id, %u the user name"
    return ""


def _writers(acl: Acl, users: list[str], ros: str, topic: str, settings: Settings) -> Finding:
    may = [name for name in users if acl.decide(Identity(name, name), Action.PUBLISH, topic)]
    others = [name for name in users if name not in may]
    subject = f"{ros} ← {topic}"
    line = f"topic {Permission.WRITE.name.lower()} {written(topic, settings.robot)}"
    who = _named(may) if may else "no user"
    text = f"{who} may send to it"
    if others:
        text += (
            f"{f'; {_named(others)} may not' if may else ''}. To let {others[0]} send to it, add "
        )
        text += f"to {settings.broker.acl.name} below the line `user {others[0]}`: {line}"
    return Finding("ok" if may else "warning", subject, text)


def _told(acl: Acl, users: list[str], topics: str, settings: Settings) -> Finding:
    """Who may read what Home Assistant is told."""
    may = [name for name in users if acl.allows_some(Identity(name, name), Action.RECEIVE, topics)]
    if may:
        return Finding("ok", "bridge.home_assistant", f"{_named(may)} may read of {topics}")
    text = f"no user may read {topics}: Home Assistant is told of nothing. Add to "
    text += f"{settings.broker.acl.name} below the line `user` of its user: topic read {topics}"
    return Finding("warning", "bridge.home_assistant", text)


def written(topic: str, robot: str) -> str:
    """The topic as a line of the rules has it, with `{robot}` for the robot's name."""
    return "{robot}" + topic.removeprefix(robot) if topic.startswith(f"{robot}/") else topic


def _named(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (", …" if len(names) > _SHOWN else "")
