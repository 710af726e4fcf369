"""The first link to a fleet's broker: its section of appliance.yaml, and its access rules."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from appliance.config import ServerUrl, UpstreamSection
from appliance.config.settings import Vda5050Section
from appliance.config.urls import parse_server
from appliance.upstream.limits import KINDS, kind_of_host

LINK_NAME = "fleet"
CA_FILE = "fleet-ca.crt"
LINK_USER: str = UpstreamSection.model_fields["user"].default

_SECTION = """
# The link to the fleet's broker: {{robot}}/… here is fleet/{{robot}}/… there. See docs/upstream.md;
# `appliance check` says what is missing.
upstreams:
  - name: {name}
    servers: ["{server}"]
{login}    out:
      - {{topic: "events/#"}}              # {{robot}}/events/… here: whoever publishes them needs
                                         # a line such as: topic write {{robot}}/events/#
      - {{topic: _appliance/routes}}       # what is bridged
    in: []
    # What may come from there; for this, the access rules need: topic write {{robot}}/cmd_vel
    #  in: [{{topic: cmd_vel, late: 500 ms}}]
"""

_VDA5050_SECTION = """
# The link to the fleet's broker, which speaks VDA 5050: {{robot}}/vda5050/… here. See
# docs/vda5050.md; `appliance check` says what is missing.
upstreams:
  - name: {name}
    servers: ["{server}"]
{login}    profile:
      vda5050:
        version: "{vda5050.version}"             # as the fleet control expects it
        manufacturer: '{manufacturer}'
        serial_number: "{vda5050.serial_number}"   # the robot's name
"""

_VDA5050_RULES = """
# The link to the fleet's broker. Nobody logs in as this user: `read` is what goes there, `write`
# is what may come from there.
user {user}
{lines}
"""

_RULES = """
# The link to the fleet's broker. Nobody logs in as this user: `read` is what goes there, `write`
# is what may come from there.
user {user}
topic read {{robot}}/events/#
topic read {{robot}}/_appliance/routes
# A call from there is answered below this; which calls and commands may come takes such lines:
topic write {{robot}}/_upstream/{name}/#
#topic write {{robot}}/reset/_call/#
#topic write {{robot}}/cmd_vel
"""


#: What the first user may do, so that there is something to send from the first minute.
_FIRST_USER_RULES = """# What the link to the fleet's broker sends.
{lines}
"""


@dataclass(frozen=True, slots=True)
class FirstLink:
    """A link to be added: the text of its section, and of the rules of its user.

    `user_rules` are for the first user, who may publish what the link sends. `prefix` is that of
    the link; what is published at the first topic of `example` is at the second one there.
    `password_file` is relative to appliance.yaml; it is None without a `username`. `is_generic`:
    the broker is none of a cloud, whose certificate every computer trusts.
    """

    server: ServerUrl
    section: str
    rules: str
    user_rules: str
    prefix: str
    example: tuple[str, str]
    username: str | None = None
    password_file: str | None = None
    is_generic: bool = True

    def next_steps(self, robot: str, file: Path, *, demo: bool = False) -> list[str]:
        """What is to be done before the first message arrives there.

        `file` is the appliance.yaml, as the person named it: the commands are to be copied.
        """
        steps = []
        if self.password_file is not None:
            steps.append(f"put the password into {file.parent / self.password_file}")
        if self.server.tls and self.is_generic:
            steps.append(
                f"where a CA of your own has signed for {self.server.host}: copy its certificate "
                f"to {file.parent / CA_FILE}, and take the # off the line `tls` in {file}"
            )
        who = "this client" if self.username is None else f"the user {self.username}"
        here, there = (each.replace("{robot}", robot) for each in self.example)
        prefix = self.prefix.replace("{robot}", robot)
        steps.append(f"let {who} read and write {prefix}# at {self.server.host}")
        with_file = f"-c {shlex.quote(str(file))}"
        for command in ("check", "demo" if demo else "run", "upstream"):
            steps.append(f"appliance {command} {with_file}")
        steps.append(f"what is published at {here} is at {there}")
        return steps


def parse_first_link(url: str, vda5050: Vda5050Section | None = None) -> FirstLink:
    """The link to `mqtts://broker.example`, or, with a user, `mqtts://alice@broker.example`.

    With `vda5050` it speaks that.

    Raises:
        ValueError: it is no such URL, or a password is in it.
    """
    scheme, slashes, rest = url.partition("://")
    login, at, _ = rest.partition("/")[0].rpartition("@")
    if ":" in login:
        raise ValueError(
            "must have no password: every user of this computer can read a command line; this "
            "command makes a file for it"
        )
    server = parse_server(f"{scheme}{slashes}{rest[len(login) + len(at) :]}")
    kind = kind_of_host(server.host) or "generic"
    if KINDS[kind].needs_tls and not server.tls:
        raise ValueError(f"must be mqtts:// or wss://: {server.host} takes nothing without TLS")
    username = unquote(login) if login else None
    password_file = None if username is None else f"{LINK_NAME}.password"
    lines = [] if kind == "generic" else [f"kind: {kind}"]
    if username is not None:
        quoted = username.replace("'", "''")
        lines.append(f"login: {{username: '{quoted}', password_file: {password_file}}}")
    elif kind != "generic":
        lines.append("tls: {certificate: fleet.crt, key: fleet.key}  # put them there")
    if server.tls and kind == "generic":
        lines.append(
            f"# tls: {{ca: {CA_FILE}}}          # where this computer does not trust it yet"
        )
    values: dict[str, object] = {"name": LINK_NAME, "server": server, "user": LINK_USER}
    values["login"] = "".join(f"    {line}\n" for line in lines)
    section, rules, sent, prefix = _SECTION, _RULES, ["{robot}/events/#"], "fleet/{robot}/"
    example = "{robot}/events/test", "fleet/{robot}/events/test"
    if vda5050 is not None:
        section, rules = _VDA5050_SECTION, _VDA5050_RULES
        values["vda5050"] = vda5050
        values["manufacturer"] = vda5050.manufacturer.replace("'", "''")
        here, prefix = vda5050.local_prefix, vda5050.prefix
        example = f"{here}state", f"{prefix}state"
        sent = [here + rule.topic for rule in vda5050.out()]
        values["lines"] = "\n".join(
            [f"topic read {each}" for each in sent]
            + [f"topic write {here}{rule.topic}" for rule in vda5050.inward()]
        )
    return FirstLink(
        server,
        section.format(**values),
        rules.format(**values),
        _FIRST_USER_RULES.format(lines="\n".join(f"topic write {each}" for each in sent)),
        prefix,
        example,
        username,
        password_file,
        kind == "generic",
    )
