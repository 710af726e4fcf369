"""Checks links to fleets' brokers: their files, what their brokers cannot carry, rights, commands.

Nothing is connected to: whether the broker answers is a matter of `appliance doctor`.
"""

from __future__ import annotations

import ipaddress
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from appliance import certs
from appliance.access import AccessFileError, Acl
from appliance.broker.values import Action, Identity
from appliance.config import Settings, TopicRoute, format_duration, format_size
from appliance.mqtt.codec import V5, V311
from appliance.mqtt.topics import overlaps
from appliance.ops.check.link_rules import link_rules, names_the_robot
from appliance.ops.check.rights import written
from appliance.ops.finding import Finding
from appliance.ops.init import call_topics
from appliance.upstream.answers import new_token, reply_filter
from appliance.upstream.credentials import first_line
from appliance.upstream.limits import KINDS, kind_of_host
from appliance.upstream.rules import InRule, UpstreamSettings
from appliance.upstream.sessions import in_client_id, kept_client_id, out_client_id
from appliance.upstream.settings import command_filters
from appliance.upstream.settings import upstreams as links

#: The robot's name where the file has none: that of every appliance that was set up so.
_DEFAULT_ROBOT: str = Settings.model_fields["robot"].default


def upstreams(settings: Settings) -> Iterator[Finding]:
    """Findings about the links."""
    if not settings.upstreams:
        return
    try:
        acl = Acl.load(settings.broker.acl, settings.robot)
    except AccessFileError:  # which is reported where the file is checked
        acl = None
    for link in links(settings):
        yield from _link(settings, link)
        yield from _vehicle(link)
        yield from _files(link)
        yield from _kind(settings, link)
        if acl is not None:
            yield from _rights(settings, link, acl)
        yield from link_rules(settings, link, acl)
        yield from _commands(settings, link)
    if settings.robot == _DEFAULT_ROBOT:
        text = (
            f"the robot's name is {_DEFAULT_ROBOT!r}, as that of every appliance without one: at "
            "the fleet's broker their topics and client ids would be the same; set `robot`"
        )
        yield Finding("warning", "upstreams", text)
    if settings.broker.store.durability == "off":
        text = "broker.store.durability is off: what waits for a link ends with the process"
        yield Finding("warning", "upstreams", text)
    else:
        yield from _disk(settings)


def _disk(settings: Settings) -> Iterator[Finding]:
    """Whether what may wait for all links has room beside what else is stored."""
    store = settings.broker.store
    directory = next(path for path in store.path.parents if path.exists())
    stored = store.path.stat().st_size if store.path.exists() else 0
    room = shutil.disk_usage(directory).free + stored
    wanted = store.size + sum(link.backlog.size for link in settings.upstreams)
    if wanted > room:
        text = (
            f"backlog.size of all links and broker.store.size are {format_size(wanted)}, and "
            f"{directory} has room for {format_size(room)}: when the disk is full nothing is "
            "stored any more, for the clients here either"
        )
        yield Finding("warning", "upstreams", text)


def _link(settings: Settings, link: UpstreamSettings) -> Iterator[Finding]:
    subject = _subject(link)
    rules = f"{len(link.out)} out, {len(link.inward)} in"
    if link.out or link.inward:
        servers = ", ".join(map(str, link.servers))
        yield Finding("ok", subject, f"{servers}, as user {link.user!r}; rules: {rules}")
    else:
        yield Finding("warning", subject, "it carries nothing: it has no rules in `out` and `in`")
    needs_tls = KINDS[link.kind].needs_tls
    for server in link.servers:
        if server.tls:
            continue
        if needs_tls:
            secure = "wss" if server.websocket else "mqtts"
            yield Finding("error", subject, f"{server}: {link.kind} needs TLS: {secure}://")
        elif not _is_loopback(server.host):
            text = f"{server}: without TLS everyone on the way can read and change all of it"
            yield Finding("warning", subject, text)
    tls = link.tls
    has_tls = any(server.tls for server in link.servers)
    if (tls.ca or tls.certificate or tls.alpn or tls.server_name) and not has_tls:
        yield Finding("warning", subject, "tls: no server of it is dialled with TLS")
    for out, inward in link.overlapping() if link.version == V5 else ():
        text = (
            f"out {out.topic} and in {inward.topic} share topics at the fleet's broker: it needs "
            "MQTT 5 (No Local), and does not fall back to 3.1.1"
        )
        yield Finding("ok", subject, text)


#: What VDA 5050 recommends for every name (2.1 section 6.1.2); some names it binds to that.
_RECOMMENDED = re.compile(r"[A-Za-z0-9_.:-]+")


def _vehicle(link: UpstreamSettings) -> Iterator[Finding]:
    """Who the robot is by VDA 5050, and what the fleet may not understand of it."""
    vehicle = link.vehicle
    if vehicle is None:
        return
    who = f"{vehicle.manufacturer}/{vehicle.serial_number}"
    text = f"VDA 5050 {vehicle.version}: {who}, online and offline at {link.state_there}"
    yield Finding("ok", _subject(link), text)
    if not _RECOMMENDED.fullmatch(vehicle.manufacturer):
        text = (
            f"profile: the manufacturer {vehicle.manufacturer!r} has other characters than "
            "letters, digits, '_', '.', ':' and '-', which are all that VDA 5050 recommends"
        )
        yield Finding("warning", _subject(link), text)
    if not KINDS[link.kind].retain:
        text = f"profile: VDA 5050 needs {link.state_there} retained"
        yield Finding("error", _subject(link), text)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return host == "localhost"


def _files(link: UpstreamSettings) -> Iterator[Finding]:
    subject = _subject(link)
    for key, path in (
        ("login.password_file", link.login.password_file),
        ("login.token_file", link.login.token_file),
    ):
        if path is not None:
            problem = _secret(path)
            if problem:
                yield Finding("error", subject, f"{key}: {path} {problem}")
    own = "the one that the fleet has made for this robot belongs there"
    for key, path, load, what in (
        ("tls.ca", link.tls.ca, certs.load_certificates, "copy the fleet's CA certificate there"),
        ("tls.certificate", link.tls.certificate, certs.load_certificates, own),
        ("tls.key", link.tls.key, certs.load_key, own),
    ):
        if path is None:
            continue
        try:
            path.stat()
            load(path)
        except FileNotFoundError:
            yield Finding("error", subject, f"{key}: there is no file {path}; {what}")
        except OSError as error:
            yield Finding("error", subject, f"{key}: {path} cannot be read: {_reason(error)}")
        except certs.CertificateError as error:
            yield Finding("error", subject, f"{key}: {error}")


def _secret(path: Path) -> str:
    """What is wrong with a file that has a secret in its first line; empty when nothing is."""
    try:
        if path.stat().st_mode & 0o077:
            return f"is open to others than its owner; close it with: chmod go= {path}"
        if not first_line(path):
            return "has nothing in its first line, where the secret is to be"
    except OSError as error:
        return f"cannot be read: {_reason(error)}"
    return ""


def _reason(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)


def _kind(settings: Settings, link: UpstreamSettings) -> Iterator[Finding]:
    """What the kind of broker cannot carry."""
    subject, limits = _subject(link), KINDS[link.kind]
    for kind in {kind_of_host(server.host) for server in link.servers} - {None, link.kind}:
        text = f"its server seems to be {kind}, whose limits it would not know; add: kind: {kind}"
        yield Finding("warning", subject, text)

    if link.login.method is not None and not limits.auth:
        text = f"login.method: {link.kind} knows no enhanced authentication; leave it out"
        yield Finding("error", subject, text)
    client_id = len(link.client_id.encode())
    if client_id > limits.client_id_size:
        text = f"client_id has {client_id} bytes, and {limits.client_id_size} is the most there"
        yield Finding("error", subject, text)
    used = limits.keep_alive(link.keep_alive)
    if used != link.keep_alive:
        text = f"keep_alive is {used} s there, not {link.keep_alive} s"
        yield Finding("warning", subject, text)
    yield from _too_long(link)

    largest = settings.broker.limits.packet_size
    if link.out and largest > limits.packet_size:
        text = (
            f"messages over {format_size(limits.packet_size)}, as clients may send here "
            f"(broker.limits.packet_size is {format_size(largest)}), are set aside"
        )
        yield Finding("warning", subject, text)
    if not limits.retain:
        text = f"{link.kind} retains nothing: who subscribes later does not get the last message"
        yield Finding("warning", subject, text)
    elif not limits.retained_for_wildcards:
        wild = [rule.topic for rule in link.inward if "#" in rule.topic or "+" in rule.topic]
        if wild:
            text = f"in {', '.join(wild)}: {link.kind} sends nothing retained for wildcards"
            yield Finding("warning", subject, text)
    if link.out and not limits.ordered:
        text = f"{link.kind} does not promise the order of a topic's messages"
        yield Finding("warning", subject, text)
    yield from _calls(link)
    rate, volume = limits.rates(link.rate, link.bytes_per_second)
    if (rate, volume) != (link.rate, link.bytes_per_second) and rate and volume:
        text = f"it sends at most {rate:g} messages and {format_size(int(volume))} a second"
        yield Finding("ok", subject, text)


def _calls(link: UpstreamSettings) -> Iterator[Finding]:
    """Rules of calls that carry none in MQTT 3.1.1, where a call has a token as its last level."""
    if link.version != V311:
        return
    filters = [rule.remote_filter for rule in link.inward]
    for rule in link.inward:
        with_token = f"{rule.remote_filter}/+"
        is_call = reply_filter(rule.remote_filter) is not None
        if is_call and not any(overlaps(each, with_token) for each in filters):
            text = (
                f"in {rule.topic}: with MQTT 3.1.1 a caller there appends a token, to be answered "
                f"at _reply; add: topic: {rule.topic}/+"
            )
            yield Finding("warning", _subject(link), text)


def _too_long(link: UpstreamSettings) -> Iterator[Finding]:
    """Filters that the broker cannot take, and filters of topics some of which it cannot."""
    subject, limits = _subject(link), KINDS[link.kind]
    takes_few_levels = limits.topic_slashes < KINDS["generic"].topic_slashes
    own = max(link.state_there, f"{link.answers_there}{new_token()}", key=limits.unusable)
    if limits.unusable(own):
        text = f"prefix: the link's own topic {own} is {limits.unusable(own)} there"
        yield Finding("error", subject, text)
    for direction, rules in (("out", link.out), ("in", link.inward)):
        for rule in rules:
            problem = limits.unusable(rule.remote_filter)
            if problem:
                text = f"{direction} {rule.topic}: {rule.remote_filter} is {problem} there"
                yield Finding("error", subject, text)
            elif direction == "out" and takes_few_levels and rule.topic.endswith("#"):
                text = (
                    f"out {rule.topic}: topics there with more than {limits.topic_slashes} "
                    "slashes are set aside"
                )
                yield Finding("warning", subject, text)


def _rights(settings: Settings, link: UpstreamSettings, acl: Acl) -> Iterator[Finding]:
    """The lines that the access rules lack for what the link is to carry."""
    reader = Identity(link.user, out_client_id(link.name))
    writers = {
        "drop": Identity(link.user, in_client_id(link.name)),
        "keep": Identity(link.user, kept_client_id(link.name)),
    }
    lacking = [
        (f"out {rule.topic}", "read", rule.local_filter)
        for rule in link.out
        if not names_the_robot(link, rule)
        and not acl.allows_some(reader, Action.RECEIVE, rule.local_filter)
    ]
    lacking += [
        (f"in {rule.topic}", "write", rule.local_filter)
        for rule in link.inward
        if not names_the_robot(link, rule)
        and not acl.allows_some(writers[rule.offline], Action.PUBLISH, rule.local_filter)
    ]
    # Who calls names where to be answered, and may do so only where it may publish itself.
    answers = f"{link.answers_here}#"
    calling = [rule for rule in link.inward if _carries_calls(settings, rule)]
    if not all(acl.allows_some(writers[r.offline], Action.PUBLISH, answers) for r in calling):
        lacking.append(("answers to calls", "write", answers))
    for what, access, filter in lacking:
        line = f"topic {access} {written(filter, settings.robot)}"
        text = (
            f"{what}: no rule lets the user {link.user!r} {access} {filter}; add to "
            f"{settings.broker.acl.name} below the line `user {link.user}`: {line}"
        )
        yield Finding("warning", _subject(link), text)


def _carries_calls(settings: Settings, rule: InRule) -> bool:
    calls = (topic.replace("{robot}", settings.robot) for topic in call_topics(settings.bridge))
    return any(overlaps(rule.local_filter, call) for call in calls)


def _commands(settings: Settings, link: UpstreamSettings) -> Iterator[Finding]:
    """Who is commanded by the fleet, and how late commands may be."""
    subject = _subject(link)
    for rule, said in zip(link.inward, _sections(settings, link), strict=True):
        fed = [route for route in _routes_to_ros(settings) if _feeds(settings, rule, route)]
        names = ", ".join(
            route.ros if isinstance(route.ros, str) else route.ros[0] for route in fed
        )
        if fed and rule.offline == "keep":
            text = (
                f"in {rule.topic}: the fleet's broker queues commands for {names} while the link "
                "is down, and they come when it is up again; leave out: offline: keep"
            )
            yield Finding("warning", subject, text)
        elif fed and rule.late is not None:
            text = f"in {rule.topic}: the fleet commands {names}; what may be older than "
            text += f"{format_duration(rule.late)} is dropped"
            if not said and not any(route.expire or route.on_silence for route in fed):
                text += ", as no route has expire or on_silence"
            yield Finding("ok", subject, text)
        elif said and not _carries_calls(settings, rule):
            text = f"in {rule.topic}: late is for commands, and no route to ROS takes its topics"
            yield Finding("warning", subject, text)


def _sections(settings: Settings, link: UpstreamSettings) -> list[bool]:
    """For each rule of `in`, whether the file says `late`."""
    (section,) = (each for each in settings.upstreams if each.name == link.name)
    return [rule.late is not None for rule in section.inward]


def _routes_to_ros(settings: Settings) -> list[TopicRoute]:
    if settings.bridge.bus == "none":
        return []
    topics = settings.bridge.topics
    return [route for route in topics if not route.is_exclusion and route.to != "mqtt"]


def _feeds(settings: Settings, rule: InRule, route: TopicRoute) -> bool:
    filters = command_filters(route, settings.robot)
    return any(overlaps(filter, rule.local_filter) for filter in filters)


def _subject(link: UpstreamSettings) -> str:
    return f"upstream {link.name}"
