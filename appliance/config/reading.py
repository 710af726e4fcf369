"""Loads appliance.yaml, and reports all problems in it with line, key, cause and suggestion."""

from __future__ import annotations

import difflib
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, get_args

from pydantic import (
    BaseModel,
    BeforeValidator,
    ValidationError,
)
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from appliance.config.printing import mask
from appliance.config.quantities import (
    either,
    format_duration,
    format_size,
    parse_seconds,
    parse_size,
)
from appliance.config.settings import (
    ActionRoute,
    BridgeSection,
    InSection,
    MappedTopicsSection,
    ParameterRoute,
    Route,
    ServiceRoute,
    Settings,
    TopicRoute,
    UpstreamSection,
)
from appliance.config.values import (
    OF_NODE,
    InListError,
    PictureEncoding,
    ValueEncoding,
    check_robot,
)
from appliance.config.yaml_document import ConfigProblem, KeyPath, YamlDocument, dotted
from appliance.host.environment import of_service
from appliance.mqtt.topics import check_filter, overlaps

SEARCH_PATH = (Path("appliance.yaml"), Path("/etc/appliance/appliance.yaml"))
"""Default locations of the configuration; the first file that exists is used."""

#: The environment variable that overrides `robot`: one file serves many robots.
ROBOT = "APPLIANCE_ROBOT"

#: The largest configuration file, in characters; a longer one is probably another file.
_MAX_SIZE = 1 << 20


class ConfigError(Exception):
    """The configuration cannot be used; `problems` has all of its problems."""

    def __init__(self, problems: list[ConfigProblem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = problems


def find(path: Path | None = None) -> Path:
    """The configuration file to use: `path`, else the first of SEARCH_PATH. Raises ConfigError."""
    for candidate in (path,) if path else SEARCH_PATH:
        try:
            if candidate.is_file():
                return candidate
            if candidate.exists():
                raise ConfigError([ConfigProblem(candidate, 0, "", "is not a file")])
        except PermissionError:
            text = "may not be looked at: run this as the appliance's user, or as root"
            raise ConfigError([ConfigProblem(candidate, 0, "", text)]) from None
    missing = path or SEARCH_PATH[0]
    places = "no such file" if path else f"not found, nor {SEARCH_PATH[1]}"
    raise ConfigError([ConfigProblem(missing, 0, "", f"{places}; `appliance init` writes one")])


def load(path: Path | None = None) -> Settings:
    """The settings of that file, or of the first of SEARCH_PATH. Raises ConfigError.

    For the file of the systemd service, the service's environment variables apply too: the shell of
    an administrator does not have them.
    """
    file = find(path)
    began = time.time()
    try:
        with file.open(encoding="utf-8") as opened:
            text = opened.read(_MAX_SIZE + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
        raise ConfigError([ConfigProblem(file, 0, "", f"cannot be read: {reason}")]) from None
    if len(text) > _MAX_SIZE:
        what = f"longer than {_MAX_SIZE >> 20} Mi characters: is it the right file?"
        raise ConfigError([ConfigProblem(file, 0, "", what)])
    settings = loads(text, file, {**of_service(file), **os.environ})
    settings._read_at = began
    return settings


def load_control(path: Path | None = None) -> Settings:
    """Default settings with only `control` taken from a file that `load` rejects.

    A running appliance keeps the settings that it has loaded before, and can still be queried.
    """
    text, file = "", path or SEARCH_PATH[0]
    with suppress(ConfigError, OSError):
        file = find(path)
        found = re.search(r"^control:.*", file.read_text(encoding="utf-8", errors="replace"), re.M)
        text = found[0] if found else ""
        return loads(text, file, {**of_service(file), **os.environ})
    return loads("", file)


def loads(text: str, file: Path, environment: Mapping[str, str] | None = None) -> Settings:
    """The settings in `text`; `file` is named in errors; paths are relative to its directory."""
    environment = os.environ if environment is None else environment
    document = YamlDocument(text, file, environment)
    problems = document.problems
    if robot := environment.get(ROBOT):
        try:
            document.values["robot"] = check_robot(robot)
        except ValueError as error:
            problems.append(document.problem(("robot",), f"of {ROBOT}, {robot!r}, {error}"))
    try:
        settings = Settings.model_validate(
            document.values, context={"directory": file.absolute().parent}
        )
    except ValidationError as error:
        for detail in error.errors(include_url=False):
            if detail["loc"] not in document.faulty:
                path = _place(detail)
                problems.append(document.problem(path, _explain(detail, document.written(path))))
    else:
        problems += [document.problem(path, what) for path, what in _cross_check(settings)]
        settings._file = file.absolute()
    if problems:
        raise ConfigError(sorted(problems, key=lambda problem: problem.line))
    return settings


def _route_key(route: TopicRoute, robot: str) -> tuple[str | tuple[str, ...], str | None, str]:
    """The key that must be unique among routes; patterns may differ in the type only."""
    return route.ros, route.type if route.is_pattern else None, route.topic(robot)


def _cross_check(settings: Settings) -> Iterator[tuple[KeyPath, str]]:
    binds = [listener.bind for listener in settings.broker.listeners]
    for number, bind in enumerate(binds):
        first = next((n for n, other in enumerate(binds[:number]) if bind.collides(other)), None)
        if first is not None:
            path = ("broker", "listeners", number, "bind")
            yield path, f"broker.listeners[{first}] listens there already"
    tls = settings.broker.tls
    if tls.username_from != "none" and not any(
        listener.tls and settings.broker.client_certificates(listener) != "off"
        for listener in settings.broker.listeners
    ):
        problem = "needs a listener with tls: true that asks for client certificates"
        yield ("broker", "tls", "username_from"), problem
    yield from _cross_check_routes(settings.bridge)
    keys: dict[tuple[str | tuple[str, ...], str | None, str], int] = {}
    for number, route in enumerate(settings.bridge.topics):
        if route.is_exclusion:
            continue
        first = keys.setdefault(_route_key(route, settings.robot), number)
        if route.to == "mqtt":
            for key in route.command_keys:
                yield ("bridge", "topics", number, key), "is for routes to ROS only"
        elif "lease" in route.command_keys and not route.exclusive:
            yield ("bridge", "topics", number, "lease"), "needs exclusive: true beside it"
        if route.to == "ros":
            for key in route.mqtt_keys:
                yield ("bridge", "topics", number, key), "is for routes to MQTT only"
        elif route.fields and route.encoding not in (known := get_args(ValueEncoding)):
            problem = f"is for {' and '.join(known)} only, and the encoding is {route.encoding}"
            yield ("bridge", "topics", number, "fields"), problem
        for key, problem in _cross_check_picture(route):
            yield ("bridge", "topics", number, key), problem
        if first != number:
            yield ("bridge", "topics", number, "ros"), f"is the same way as bridge.topics[{first}]"
    yield from _cross_check_called(settings.bridge)
    yield from _cross_check_bus(settings.bridge)
    for number, upstream in enumerate(settings.upstreams):
        for inside, problem in _cross_check_upstream(settings, number, upstream):
            yield ("upstreams", number, *inside), problem


def _cross_check_picture(route: TopicRoute) -> Iterator[tuple[str, str]]:
    """Keys of a route that its encoding does not fit, and what is wrong."""
    if route.encoding in get_args(PictureEncoding):
        if route.to != "mqtt":
            yield "encoding", f"{route.encoding} is for routes to MQTT only"
    elif "max_width" in route.mqtt_keys:
        yield "max_width", f"is for jpeg and png only, and the encoding is {route.encoding}"
    if route.encoding != "jpeg" and "quality" in route.mqtt_keys:
        yield "quality", f"is for jpeg only, and the encoding is {route.encoding}"


def _cross_check_upstream(
    settings: Settings, number: int, upstream: UpstreamSection
) -> Iterator[tuple[KeyPath, str]]:
    """Settings of a link that do not fit each other; paths are those within it."""
    first = [each.name for each in settings.upstreams].index(upstream.name)
    if first != number:
        yield ("name",), f"is the name of upstreams[{first}]"
    if upstream.prefix.startswith("$") and not _is_of_aws(upstream, upstream.prefix):
        yield ("prefix",), _DOLLAR
    yield from _cross_check_login(upstream)
    tls = upstream.tls
    if (tls.certificate is None) is not (tls.key is None):
        here, other = ("key", "certificate") if tls.key else ("certificate", "key")
        yield ("tls", here), f"needs {other} beside it"
    yield from _cross_check_mapped(settings.robot, upstream)


#: The place of the rules that a link's profile adds.
_PROFILE: KeyPath = ("profile",)


#: Why topics at the fleet's broker do not begin with `$`.
_DOLLAR = "must not begin with '$': those topics are the server's own ($aws/ with kind: aws-iot)"


def _is_of_aws(upstream: UpstreamSection, prefix: str) -> bool:
    return upstream.kind == "aws-iot" and prefix.startswith("$aws/")


def _cross_check_login(upstream: UpstreamSection) -> Iterator[tuple[KeyPath, str]]:
    login, is_old = upstream.login, upstream.version == "3.1.1"
    if login.password_file is not None and login.token_file is not None:
        yield ("login", "token_file"), "is sent as the password: leave password_file out"
    if login.method is not None:
        if login.token_file is None:
            yield ("login", "method"), "needs token_file, which it authenticates with"
        if is_old:
            yield ("login", "method"), 'is of MQTT 5: it needs version: "5"'
    secret = "password_file" if login.password_file is not None else "token_file"
    if is_old and login.username is None and getattr(login, secret) is not None:
        yield ("login", secret), "needs username: MQTT 3.1.1 has no password without one"


def _cross_check_mapped(robot: str, upstream: UpstreamSection) -> Iterator[tuple[KeyPath, str]]:
    """The filters of rules, which are valid with their prefixes only."""
    directions: dict[str, Sequence[MappedTopicsSection]] = {
        "out": upstream.out,
        "in": upstream.inward,
    }
    there: dict[str, list[tuple[KeyPath, str]]] = {"out": [], "in": []}
    for direction, rules in directions.items():
        seen: dict[str, KeyPath] = {}
        added = sum(rule.is_added for rule in rules)
        for number, rule in enumerate(rules, -added):  # as the file numbers them
            path: KeyPath = (direction, number) if number >= 0 else _PROFILE
            if isinstance(rule, InSection) and rule.offline == "keep" and rule.late is not None:
                text = "is not for offline: keep: how long the server has queued it nobody says"
                yield (*path, "late"), text
            filters = rule.local_filter(robot), rule.remote_filter(robot, upstream.prefix)
            there[direction].append((path, filters[1]))
            problem = _mistake_in_filters(rule, *filters)
            if problem:
                yield (*path, "topic"), problem
                continue
            if direction == "in" and filters[0].startswith("$"):
                yield (
                    (*path, "topic"),
                    "must not begin with '$' here: those topics are the broker's",
                )
            remote = rule.prefix_there(robot, upstream.prefix)
            if filters[1].startswith("$") and not _is_of_aws(upstream, remote):
                key = "topic" if rule.remote_prefix is None else "remote_prefix"
                if rule.remote_prefix is not None or not upstream.prefix.startswith("$"):
                    yield (*path, key), _DOLLAR
            read = filters[direction == "in"]
            first = seen.setdefault(read, path)
            if first != path:
                yield (*path, "topic"), f"is the same as in {dotted(first)}, which carries it"
    if upstream.version == "3.1.1":
        yield from _cross_check_loops(there["out"], there["in"])


def _mistake_in_filters(rule: MappedTopicsSection, local: str, remote: str) -> str:
    if rule.topic.startswith("/") and local != rule.topic and "//" in local + remote:
        return (
            f"must not begin with '/' behind {rule.local_prefix}; did you mean {rule.topic[1:]!r}?"
        )
    for filter, side in ((local, "here"), (remote, "at the fleet's broker")):
        try:
            check_filter(filter)
        except ValueError as error:
            return f"makes no topic filter {side}, {filter!r}: {error}"
        if filter.startswith("$share/"):
            return f"makes a shared subscription {side}, {filter!r}, which is not carried"
    return ""


def _cross_check_loops(
    out: list[tuple[KeyPath, str]], inward: list[tuple[KeyPath, str]]
) -> Iterator[tuple[KeyPath, str]]:
    for path, filter in inward:
        for position, other in out:
            if _is_filter(filter) and _is_filter(other) and overlaps(filter, other):
                text = (
                    f"overlaps {dotted(position)} at the fleet's broker ({filter} and {other}): "
                    "what is sent would come back, as MQTT 3.1.1 has no No Local; use "
                    'version: "5", or topics that share nothing'
                )
                yield (path if path == _PROFILE else (*path, "topic")), text


def _is_filter(text: str) -> bool:
    try:
        check_filter(text)
    except ValueError:
        return False
    return True


def _cross_check_bus(bridge: BridgeSection) -> Iterator[tuple[KeyPath, str]]:
    """Settings that only one of ROS 1 and ROS 2 has."""
    is_ros1 = bridge.bus == "ros1"
    foreign, own = ("cdr", "ros1") if is_ros1 else ("ros1", "cdr")
    sections: tuple[tuple[str, Sequence[TopicRoute | ServiceRoute | ActionRoute]], ...] = (
        ("topics", bridge.topics),
        ("services", bridge.services),
        ("actions", bridge.actions),
    )
    for section, routes in sections:
        for number, route in enumerate(routes):
            if route.encoding == foreign and not route.is_exclusion:
                text = f"must be {own}: that is what ROS's own bytes are with bus: {bridge.bus}"
                yield ("bridge", section, number, "encoding"), text
    for number, parameter in enumerate(bridge.parameters):
        if not is_ros1 and any(name.rpartition("/")[0] in ("", "!") for name in parameter.names):
            yield ("bridge", "parameters", number, "ros"), OF_NODE
    ros2_only = {"domain_id": bridge.domain_id is not None, "use_sim_time": bridge.use_sim_time}
    for key, is_set in ros2_only.items():
        if is_ros1 and is_set:
            instead = "ROS_MASTER_URI" if key == "domain_id" else "the parameter /use_sim_time"
            yield ("bridge", key), f"is for ROS 2 only; in ROS 1 it is {instead}"


def _cross_check_routes(bridge: BridgeSection) -> Iterator[tuple[KeyPath, str]]:
    """Checks for the routes of every section."""
    sections: dict[str, Sequence[Route]] = {
        "topics": bridge.topics,
        "services": bridge.services,
        "actions": bridge.actions,
        "parameters": bridge.parameters,
    }
    for section, routes in sections.items():
        placeholder = "{node}" if section == "parameters" else "{ros}"
        has_pattern = any("*" in name for route in routes for name in route.names if name[0] != "!")
        for number, route in enumerate(routes):
            path: KeyPath = ("bridge", section, number)
            if route.is_exclusion:
                more = sorted(route.model_fields_set - {"ros"})
                for key in more:
                    yield (*path, key), "has no meaning for what is left out"
                if not (more or has_pattern):
                    problem = f"leaves nothing out: there is no pattern in bridge.{section}"
                    yield (*path, "ros"), problem
            elif route.is_pattern and placeholder not in route.mqtt:
                problem = f"needs {placeholder} in it, or all that the route is for would be one"
                yield (*path, "mqtt"), problem


def _cross_check_called(bridge: BridgeSection) -> Iterator[tuple[KeyPath, str]]:
    sections: dict[str, Sequence[ServiceRoute | ActionRoute | ParameterRoute]] = {
        "services": bridge.services,
        "actions": bridge.actions,
        "parameters": bridge.parameters,
    }
    for section, routes in sections.items():
        seen: dict[str, int] = {}
        topics: dict[str, tuple[str, int]] = {}
        for number, route in enumerate(routes):
            path: KeyPath = ("bridge", section, number)
            for name in route.names:
                base = name.rpartition("/")[0] if section == "parameters" else name
                if name.startswith("!") or "*" in base:
                    continue
                topic = route.mqtt.replace("{node}", base).replace("{ros}", base)
                other, taken = topics.setdefault(topic, (base, number))
                if other != base:
                    yield (*path, "mqtt"), f"is the topic of bridge.{section}[{taken}]"
            for position, name in enumerate(route.names):
                if name.startswith("!") and not route.is_exclusion:
                    continue
                first = seen.setdefault(name, number)
                if first != number:
                    where: KeyPath = () if isinstance(route.ros, str) else (position,)
                    yield (*path, "ros", *where), f"is the same as in bridge.{section}[{first}]"
            kind = None if isinstance(route, ParameterRoute) else route.type
            if kind is not None and "*" in kind and not route.is_pattern:
                yield (*path, "type"), "can be a pattern only when ros is one"
            if isinstance(route, ServiceRoute) and route.to == "mqtt":
                if route.is_pattern:
                    yield (*path, "to"), "must be ros when ros is a pattern or a list"
                elif route.type is None and not route.is_exclusion:
                    yield (*path, "type"), "is needed when to is mqtt"
            elif isinstance(route, ServiceRoute) and route.on_error is not None:
                yield (*path, "on_error"), "is for services that MQTT answers: to: mqtt"


def _place(detail: ErrorDetails) -> KeyPath:
    """The path of the error, including the entry of a list that was validated as a whole."""
    error = detail.get("ctx", {}).get("error")
    return (*detail["loc"], error.position) if isinstance(error, InListError) else detail["loc"]


_PLAIN = {
    "missing": "is needed",
    "string_type": "must be text (in quotes, when it looks like a number or a yes or no)",
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "bool_type": "must be true or false",
    "list_type": "must be a list",
    "dict_type": "must be keys with values",
    "model_type": "must be keys with values",
    "string_too_short": "must not be empty",
}


#: Examples for sections that are easily mistaken for plain values.
_EXAMPLES = {
    "allow": "{linear.z: [0]}",
    "clamp": "{linear.x: [-0.5, 0.5]}",
    "on_error": "{success: false}",
    "on_silence": "{after: 500 ms}",
    "profile": "{vda5050: {manufacturer: acme}}",
    "publish": "{linear: {x: 0}}",
}


_BOUNDS = {
    "greater_than": ("gt", "must be more than"),
    "greater_than_equal": ("ge", "must be at least"),
    "less_than": ("lt", "must be less than"),
    "less_than_equal": ("le", "must be at most"),
}


def _explain(detail: ErrorDetails, written: str | None) -> str:
    """The text for one of pydantic's errors, with the value as written in the file, masked."""
    kind, path, context = detail["type"], detail["loc"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        known = list(_keys(_section_at(path[:-1])))
        return f"unknown key{_did_you_mean(str(path[-1]), known) or '; known: ' + ', '.join(known)}"
    if kind == "missing":
        return _PLAIN[kind]
    if kind == "value_error":
        what = str(context["error"])
    elif kind == "literal_error":
        choices = re.findall(r"'([^']*)'", context["expected"])
        what = f"must be {either(choices)}{_did_you_mean(str(detail['input']), choices)}"
    elif kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        what = f"{words} {_with_unit(context[name], path)}"
    elif kind == "too_short":
        what = f"must have at least {context['min_length']}"
    else:
        what = _PLAIN.get(kind, detail["msg"])
        if kind in ("dict_type", "model_type") and path[-1] in _EXAMPLES:
            what += f", such as `{path[-1]}: {_EXAMPLES[str(path[-1])]}`"
    return what if written is None else f"{what} (it says {mask(path, written)!r})"


def _section_at(path: KeyPath) -> type[BaseModel]:
    """The model of the mapping at that path."""

    def models(annotation: Any) -> Iterator[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        for argument in get_args(annotation):
            yield from models(argument)

    section: type[BaseModel] = Settings
    for part in path:
        if isinstance(part, str):
            section = next(models(_keys(section)[part].annotation))
    return section


def _keys(section: type[BaseModel]) -> dict[str, FieldInfo]:
    """The keys of a section as they are in the file."""
    return {field.alias or name: field for name, field in section.model_fields.items()}


def _with_unit(value: float, path: KeyPath) -> str:
    *around, name = path
    for item in _keys(_section_at(tuple(around)))[str(name)].metadata:
        if item == BeforeValidator(parse_size):
            return format_size(int(value))
        if item == BeforeValidator(parse_seconds):
            return format_duration(value)
    return f"{value:g}"


def _did_you_mean(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""
