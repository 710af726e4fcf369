"""`appliance init`: creates everything that a new appliance needs, and replaces no file.

With a URL of a fleet's broker it adds a link to that, and the access rules that the link needs.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import socket
import string
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from appliance import certs, config
from appliance.access import Acl, Passwords, check_username
from appliance.certs.addresses import DNS_NAME
from appliance.config import ConfigError
from appliance.config.settings import Vda5050Section
from appliance.config.values import check_robot
from appliance.host.environment import of_service
from appliance.ops.first_link import (
    LINK_USER,
    FirstLink,
    parse_first_link,
)

PASSWORD_FILE = "user.password"
_PASSWORD_LENGTH = 20  # of 62 characters each: 119 bits

CONFIGURATION = """\
# What is left out has a safe default. `appliance check` names every mistake, and with --show prints
# every setting in force. The project's own appliance.yaml explains each (of the Debian package:
# /usr/share/doc/appliance/examples/appliance.yaml).

robot: {robot}          # the first level of all its MQTT topics

broker:
  listeners:
    - {{bind: "0.0.0.0:8883", tls: true}}
    - {{bind: "127.0.0.1:1883"}}                            # this computer only
    - {{bind: "0.0.0.0:8443", tls: true, protocol: web}}    # the console, for browsers

bridge:
  discovery: localhost   # ROS nodes of this computer only; subnet lets whoever is on the network
                         # command the robot, past the users and rules of MQTT
  topics: []
  # A route each, for example (and services, actions, parameters likewise: services: [/reset]):
  #  - {{ros: /odom, to: mqtt, rate: 10}}
  #  - ros: /cmd_vel
  #    to: ros
  #    type: geometry_msgs/msg/Twist
  #    on_silence: {{after: 500 ms, publish: {{}}}}  # who falls silent is followed by a stop
"""

#: What takes the place of these lines where what the appliance writes has a folder of its own.
_WITH_DATA = {
    "\nbroker:\n": """
broker:
  store: {{path: {store}}}
""",
    "\nbridge:\n": """
control: {control}
crash_reports: {crashes}

bridge:
""",
}

DEMO_CONFIGURATION = """\
# The demo's configuration, made by `appliance init --demo`. What is left out has a safe default.

robot: {robot}

broker:
  listeners:
    - bind: 0.0.0.0:${{APPLIANCE_PORT:-8883}}
      tls: true
    - bind: 127.0.0.1:${{APPLIANCE_PLAIN_PORT:-1883}}
    - bind: 0.0.0.0:${{APPLIANCE_WEB_PORT:-8443}}
      tls: true
      protocol: web

bridge:
  discovery: localhost
  topics:
    - {{ros: /odom, to: mqtt, rate: 10}}
    - {{ros: /battery, to: mqtt}}
    - {{ros: /scan, to: mqtt, rate: 2}}
    - {{ros: /chatter, to: mqtt}}
    - {{ros: /camera/image_raw, to: mqtt, encoding: jpeg, rate: 5}}
    - {{ros: /map, to: mqtt, encoding: cbor}}
    - ros: /cmd_vel
      to: ros
      type: geometry_msgs/msg/Twist
      exclusive: true
      on_silence: {{after: 500 ms, publish: {{}}}}
      clamp: {{linear.x: [-0.5, 0.5], angular.z: [-1, 1]}}
  services: [/reset]
"""

ACCESS = """\
# Who may read and write which topics, in mosquitto's grammar; what nothing here allows is refused.
# {{robot}} stands for the robot's name. Ask why with: appliance acl explain USER TOPIC

# Each client reads the answers to its own calls of the appliance.
pattern read $CONTROL/appliance/v1/+/_reply/%c/#

# A user is in a group by the line that includes it. Each group has the rights of the one before:
# viewers, drivers, admins.
user {user}
include groups/admins.conf
"""

#: The groups, by their files beside the access rules.
GROUPS = {
    "viewers.conf": """\
# Viewers read everything of the robot, and may ask what they may do.

topic read {{robot}}/#
topic read $SYS/#
topic write $CONTROL/appliance/v1/rights/_call/#
topic write $CONTROL/appliance/v1/token/_call/#
topic write $CONTROL/appliance/v1/token_end/_call/#
""",
    "drivers.conf": """\
# Drivers also command the robot.

include viewers.conf
topic write {{robot}}/cmd_vel
{calls}""",
    "admins.conf": """\
# Admins also manage the appliance: docs/management.md lists what can be called.

include drivers.conf
topic write $CONTROL/appliance/v1/+/_call/#
""",
}

NO_CALLS = """\
# To call what is bridged takes lines such as these, one for each:
#topic write {robot}/reset/_call/#
#topic write {robot}/navigate_to_pose/_goal/#
#topic write {robot}/navigate_to_pose/_cancel/#
#topic write {robot}/controller/_param/+/set/#
"""

#: The most levels that the access rules allow for `**` in a pattern, one line for each number. The
#: rules' only wildcard for several levels is `#`, which would also allow what is no call.
_DEPTH = 3


class InitError(Exception):
    """Something could not be created; the message says what, and what to do."""


@dataclass(frozen=True)
class InitStep:
    """One file: whether it was created now or existed before, and what it is."""

    path: Path
    made: bool
    text: str


@dataclass(frozen=True)
class NextSteps:
    """What a person does next."""

    texts: list[str]


@dataclass(frozen=True)
class Credentials:
    """The first user, with the password, which is shown only once."""

    user: str
    password: str


def robot_name(text: str) -> str:
    """The text as a name that is valid as one topic level: `r2 d2!` becomes `r2-d2`."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("-_.")[:64].rstrip("-_.")
    return name or "robot"


def generate_password() -> str:
    """A random password of letters and digits, which need no quoting in shells and URLs."""
    alphabet = string.ascii_letters + string.digits
    return "".join(secrets.choice(alphabet) for _ in range(_PASSWORD_LENGTH))


def with_data(template: str, data: Path, control: Path) -> str:
    """A first configuration with what the appliance writes in the folder `data`, absolute, and the
    socket for its commands at `control`."""
    paths = {"store": data / "store.db", "control": control, "crashes": data / "crashes"}
    # Quoted for YAML, and with its braces doubled: what comes out is a template, too.
    quoted = {name: json.dumps(str(path)) for name, path in paths.items()}
    for line, text in _WITH_DATA.items():
        more = text.format(**quoted).replace("{", "{{").replace("}", "}}")
        template = template.replace(line, more, 1)
    return template


def initialise(
    directory: Path,
    *,
    robot: str | None = None,
    user: str = "operator",
    demo: bool = False,
    data: Path | None = None,
    control: Path | None = None,
    names: Sequence[str] = (),
    upstream: str | None = None,
    manufacturer: str | None = None,
) -> Iterator[InitStep | Credentials | NextSteps]:
    """Create what is missing in `directory`, and yield each step when it is done.

    A new appliance.yaml keeps what the appliance writes in the folder `data`, else in one beside
    itself, and its `control` socket there, too, unless that has another path. `names` are DNS names
    for the server's certificate, in addition to those that this computer knows. `upstream`
    is the URL of a fleet's broker to add a link to, which speaks VDA 5050 as a robot of that
    `manufacturer` if there is one.

    Raises InitError, or ConfigError, AccessFileError or CertificateError of the parts; what was
    created until then is complete and stays.
    """
    try:
        check_username(user)
    except ValueError as error:
        raise InitError(str(error)) from None
    for each in names:
        if not DNS_NAME.fullmatch(each):
            raise InitError(f"--name {each!r} is not a DNS name, such as robot.example.com")
    if named := os.environ.get("APPLIANCE_ROBOT"):
        try:
            check_robot(named)
        except ValueError as error:
            raise InitError(f"APPLIANCE_ROBOT is {named!r}: the robot's name {error}") from None
    if manufacturer is not None and upstream is None:
        raise InitError("--vda5050 needs --upstream: the URL of the fleet's broker")
    try:
        vda5050 = None if manufacturer is None else Vda5050Section(manufacturer=manufacturer)
    except ValueError:
        raise InitError(
            "--vda5050 must be the manufacturer's name, without '/', '+', '#' and '$'"
        ) from None
    try:
        first = None if upstream is None else parse_first_link(upstream, vda5050)
    except ValueError as error:
        raise InitError(f"--upstream {error}") from None
    directory.mkdir(parents=True, exist_ok=True)
    file = directory / "appliance.yaml"
    name = robot_name(robot or ("demo" if demo else socket.gethostname().partition(".")[0]))
    template = DEMO_CONFIGURATION if demo else CONFIGURATION
    if data is not None:
        data = data.absolute()
        template = with_data(template, data, control or data / "control.sock")
    made_file = write_new(file, template.format(robot=name))
    settings = config.load(file)
    if robot and not made_file and settings.robot != name:
        raise InitError(f"{file} has robot: {settings.robot}; change it there")
    yield InitStep(file, made_file, f"configuration of robot {settings.robot!r}")
    yield from _certificates(settings, names)
    calls = "".join(f"topic write {topic}\n" for topic in call_topics(settings.bridge))
    rules = ACCESS.format(user=user) + (first.user_rules if first else "")
    yield from _rules(settings.broker.acl, rules, calls or NO_CALLS)
    if first is not None:
        yield from _link(settings, file, first)
    # The users come last, so that the password is the last thing shown.
    is_told = made_file and not demo and data is None and first is None
    for step in _users(settings, user, directory / PASSWORD_FILE if demo else None):
        if is_told and isinstance(step, Credentials):
            yield NextSteps(_next_steps(settings, file, user))
        yield step
    if first is not None:
        yield NextSteps(first.next_steps(settings.robot, file, demo=demo))


def _next_steps(settings: config.Settings, file: Path, user: str) -> list[str]:
    robot, rules = settings.robot, settings.broker.acl.name
    option = "" if file.absolute().parent == Path.cwd() else f" -c {file}"
    return [
        f"start it: appliance run{option}",
        f"{user} may read everything of {robot}, and write {robot}/cmd_vel; {rules} says who may "
        "write what else, and what is not allowed there is refused",
        f"bridge topics of ROS: {file.name} has examples",
    ]


def call_topics(bridge: config.BridgeSection) -> list[str]:
    """The topic filters, in the ACL file's syntax, for calls of what is bridged, and for nothing
    else. Clients cancel only their own goals, and read answers with the rest of the robot."""
    found: list[str] = []
    for service in bridge.services:
        if service.to == "ros":
            found += _below(service.mqtt, _filters(service.names), "_call")
    for action in bridge.actions:
        found += _below(action.mqtt, _filters(action.names), "_goal", "_cancel")
    for route in bridge.parameters:
        for name in route.names:
            node, _, parameter = name.rpartition("/")
            if not name.startswith("!"):
                calls = (f"{_filter(parameter)}/set", "_set")
                found += _below(route.mqtt, _filters([node]), *calls)
    return list(dict.fromkeys(found))


def _below(template: str, filters: list[str], *calls: str) -> list[str]:
    """Filters for each call below each name, and for the token that MQTT 3.1.1 clients append."""
    bases = [template.replace("{ros}", one).replace("{node}", one) for one in filters]
    return [f"{base}/{call}/#" for base in bases for call in calls]


def _filters(names: Iterable[str]) -> list[str]:
    """ROS names and patterns as topic filters: a part with a `*` becomes a `+`."""
    found: list[str] = []
    for name in names:
        if name.startswith("!"):
            continue
        before, deep, after = name.partition("**")
        depths = range(1, _DEPTH + 1) if deep else [0]
        # "/arm/**" is everything below /arm; `before` and `after` may end or begin within a part.
        middles = ["*" + "/*" * (depth - 1) if depth else "" for depth in depths]
        found += ["/".join(map(_filter, f"{before}{m}{after}".split("/"))) for m in middles]
    return found


def _filter(part: str) -> str:
    return "+" if "*" in part else part


def _rules(path: Path, rules: str, calls: str) -> Iterator[InitStep]:
    """Write the groups and the access rules; to rules that are there already, groups that they
    include and that are missing."""
    there = path.exists()
    found = rules if not there else ""
    with contextlib.suppress(OSError):  # of rules that cannot be read, others see to the groups
        found = path.read_text(errors="replace")
    for name, text in GROUPS.items():
        group = path.parent / "groups" / name
        made = "include groups/" in found and write_new(group, text.format(calls=calls))
        if made and there:
            yield InitStep(group, made, "a group that the access rules include")
    yield InitStep(path, write_new(path, rules), "access rules")


def _certificates(settings: config.Settings, more_names: Sequence[str]) -> Iterator[InitStep]:
    tls = settings.broker.tls
    directory = tls.certificate.parent
    authority, readme = directory / "ca.crt", directory / "README.md"
    ours = (directory / "server.crt", directory / "server.key", authority)
    if tls.certificate.exists() and tls.key.exists():
        yield InitStep(tls.certificate, False, "the server's certificate")
        return
    if (tls.certificate, tls.key, tls.ca) != ours:
        raise InitError(
            f"{tls.certificate} and {tls.key} are not both there, and broker.tls does not name the "
            "files that this command makes (server.crt, server.key, ca.crt in one directory)"
        )
    made = not authority.exists()
    if made and directory.is_dir() and {file.name for file in directory.iterdir()} == {readme.name}:
        # As a clone of the repository has it: git creates folders as open as the umask allows, and
        # nobody else may put a CA in its place. A folder with more in it is somebody's own.
        with contextlib.suppress(PermissionError):  # another user's folder
            directory.chmod(directory.stat().st_mode & ~0o022)
    names, addresses = certs.local_names()
    names += [name for name in more_names if name not in names]
    if made:
        certs.create_authority(directory, settings.robot, names, addresses)
    yield InitStep(authority, made, "this appliance's own CA, for every client")
    certs.issue_server(directory, names, addresses)
    known = ", ".join([*names, *map(str, addresses)])
    yield InitStep(tls.certificate, True, f"the server's certificate, for {known}")
    made = not readme.exists()  # a clone of the project's repository has it
    if made:
        certs.write_readme(directory)
    yield InitStep(readme, made, "what each of these files is, and who may have it")


def _link(settings: config.Settings, file: Path, first: FirstLink) -> Iterator[InitStep]:
    """Add the link to the configuration, and rules for its user where there are none."""
    server = first.server
    if settings.upstreams:
        if not any(server in upstream.servers for upstream in settings.upstreams):
            raise InitError(f"{file} has upstreams already; add {server} there:\n\n{first.section}")
        yield InitStep(file, False, f"the link to {server}")
        return
    before = _ending_a_line(file)
    try:
        config.loads(before + first.section, file, {**of_service(file), **os.environ})
    except ConfigError:  # it is written in another style, such as one line in braces
        raise InitError(f"{file} cannot be continued; add to it:\n\n{first.section}") from None
    rules = Acl.load(settings.broker.acl, settings.robot).rules
    made = not any(rule.user == LINK_USER for rule in rules)
    if made:  # before the link, which could carry nothing without them
        _append(settings.broker.acl, first.rules)
    yield InitStep(settings.broker.acl, made, f"access rules of the link's user, {LINK_USER}")
    if first.password_file is not None:
        made = write_new(file.parent / first.password_file, "", mode=0o600)
        text = f"put the password of {first.username} at {server.host} in its first line"
        yield InitStep(file.parent / first.password_file, made, text)
    _append(file, first.section)
    yield InitStep(file, True, f"the link to {server}")


def _ending_a_line(path: Path) -> str:
    """The text of the file, with a line end behind its last line."""
    text = path.read_text(encoding="utf-8")
    return text if text.endswith("\n") or not text else f"{text}\n"


def _append(path: Path, text: str) -> None:
    """Write the text behind that of the file, in one go, and sync it."""
    is_ended = _ending_a_line(path) == path.read_text(encoding="utf-8")
    with path.open("ab", buffering=0) as file:
        file.write(f"{'' if is_ended else chr(10)}{text}".encode())
        os.fsync(file.fileno())


def _users(
    settings: config.Settings, user: str, password_file: Path | None
) -> Iterator[InitStep | Credentials]:
    path = settings.broker.users
    if path.exists():
        yield InitStep(path, False, f"users: {', '.join(Passwords.load(path).users())}")
        return
    password = generate_password()
    users = Passwords(path)
    users.set(user, password)
    if password_file is not None:  # before the users file: an interruption must not lose it
        password_file.unlink(missing_ok=True)
        write_new(password_file, password + "\n", mode=0o600)
    users.save()
    yield InitStep(path, True, f"users: {user}")
    if password_file is not None:
        yield InitStep(password_file, True, f"the password of {user}, for the demo")
    yield Credentials(user, password)


def write_new(path: Path, text: str, mode: int = 0o644) -> bool:
    """Write the file and sync it, unless it exists; returns whether it was written."""
    if path.exists():
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    # Whole or not at all: the next run would not replace half a file of an interrupted one.
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with os.fdopen(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode), "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        # Unlike a rename, this never replaces a file that was created meanwhile.
        os.link(draft, path)
    except FileExistsError:
        return False
    finally:
        draft.unlink(missing_ok=True)
    return True
