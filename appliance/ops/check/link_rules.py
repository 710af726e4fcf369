"""Checks the rules of a link: against each other, and against what there is here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, TypeVar

from appliance.access import Acl
from appliance.access.rules import Permission
from appliance.config import Settings, format_duration
from appliance.mqtt.topics import matches, overlaps
from appliance.ops.finding import Finding
from appliance.ops.init import call_topics
from appliance.upstream.channel import SHORTEST_PING
from appliance.upstream.rules import InRule, LinkRules, OutRule, UpstreamSettings
from appliance.upstream.settings import command_filters, upstreams

RuleT = TypeVar("RuleT", OutRule, InRule)

#: The levels of topics at which clients call what is bridged.
_CALLS: Final = frozenset(("_call", "_goal", "_cancel", "_set"))


def covers(wide: str, narrow: str) -> bool:
    """Whether the filter `wide` matches all topics that the filter `narrow` matches."""
    if not matches(wide, narrow):  # `+` and `#` as names of levels
        return False
    if narrow != "#" and not narrow.endswith("/#"):
        return True
    return wide.endswith("#") and (narrow == "#" or matches(wide, narrow[:-2]))


def link_rules(settings: Settings, link: UpstreamSettings, acl: Acl | None) -> Iterator[Finding]:
    """Findings about the rules of one link."""
    subject = f"upstream {link.name}"
    texts = [*_hidden("out", link.out), *_hidden("in", link.inward), *_twice(link.inward)]
    if link.vehicle is None and _is_twice(link, link.prefix):  # a manufacturer may have that name
        texts.append(
            f"prefix: the robot's name is in it twice: {link.prefix}; leave out one of them"
        )
    for direction, rules in (("out", link.out), ("in", link.inward)):
        for rule in rules:
            texts += _names_the_robot(link, direction, rule)
    texts += _own(link)
    texts += _without_publisher(settings, link, acl)
    texts += _without_call(settings, link)
    texts += _too_short(link)
    texts += _slower_than_its_routes(settings, link)
    for text in texts:
        yield Finding("warning", subject, text)


def _hidden(direction: str, rules: Sequence[RuleT]) -> Iterator[str]:
    """Rules that never carry anything, because an earlier one carries it all."""
    for place, rule in enumerate(rules):
        for earlier in rules[:place]:
            # A rule moves only topics that begin with its prefixes.
            if direction == "out":
                is_covered = covers(earlier.local_filter, rule.local_filter)
                is_covered &= rule.local_prefix.startswith(earlier.local_prefix)
            else:
                is_covered = covers(earlier.remote_filter, rule.remote_filter)
                is_covered &= rule.remote_prefix.startswith(earlier.remote_prefix)
            if is_covered:
                yield (
                    f"{direction} {rule.topic}: never used, as {direction} {earlier.topic} above "
                    "it carries all its topics: the first rule that matches does; put it above"
                )
                break


def _twice(rules: Sequence[InRule]) -> Iterator[str]:
    """Rules on both connections that share topics."""
    for place, rule in enumerate(rules):
        for earlier in rules[:place]:
            shares = overlaps(earlier.remote_filter, rule.remote_filter)
            if shares and earlier.offline != rule.offline:
                yield (
                    f"in {rule.topic}: shares topics with in {earlier.topic}, which has another "
                    "`offline`: their messages come twice, once over each connection"
                )


def names_the_robot(link: UpstreamSettings, rule: OutRule | InRule) -> bool:
    """Whether the robot's name is in the rule's filters twice, so that they are not those meant."""
    return bool(_names_the_robot(link, "", rule))


def _is_twice(link: UpstreamSettings, prefix: str) -> bool:
    return f"/{link.robot}/{link.robot}/" in f"/{prefix}"


def _names_the_robot(link: UpstreamSettings, direction: str, rule: OutRule | InRule) -> list[str]:
    prefixes = [("local_prefix", rule.local_prefix)]
    if rule.remote_prefix != link.prefix:
        prefixes.append(("remote_prefix", rule.remote_prefix))
    for key, prefix in prefixes:
        if _is_twice(link, prefix):
            return [
                f"{direction} {rule.topic}: {key}: the robot's name is in it twice: {prefix}; "
                "leave out one of them"
            ]
    first = rule.topic.partition("/")[0]
    doubled = [
        topic
        for prefix, topic in (
            (rule.local_prefix, rule.local_filter),
            (rule.remote_prefix, rule.remote_filter),
        )
        if f"/{prefix}".endswith(f"/{link.robot}/")
    ]
    if first not in (link.robot, "{robot}") or not doubled:
        return []
    return [
        f"{direction} {rule.topic}: the robot's name is in it twice, as in {doubled[0]}: a rule's "
        f"topic is what follows the prefix; leave out {first}/"
    ]


def _own(link: UpstreamSettings) -> Iterator[str]:
    """Topics that no rule carries."""
    rules = LinkRules(link)
    for out in link.out:
        if _is_topic(out.local_filter) and rules.out(out.local_filter) is None:
            yield f"out {out.topic}: no rule carries {out.local_filter}, which is the appliance's"
    for inward in link.inward:
        topic = inward.remote_filter
        if _is_topic(topic) and rules.inward(topic) is None:
            yield f"in {inward.topic}: no rule carries {topic} to {inward.local_filter}"


def _is_topic(filter: str) -> bool:
    return "+" not in filter and "#" not in filter


def _without_publisher(
    settings: Settings, link: UpstreamSettings, acl: Acl | None
) -> Iterator[str]:
    """What nobody here publishes, as far as the access rules and the routes tell."""
    if acl is None or settings.broker.plugins:
        return
    published = [f"{settings.robot}/_appliance/#", "$SYS/#"]
    for rule in acl.rules:
        if rule.gives(Permission.WRITE) and rule.user != link.user:
            published.append(rule.filter.replace("%u", "+").replace("%c", "+"))
    for other in upstreams(settings):
        if other.name != link.name:
            published += [each.local_filter for each in other.inward]
    bridge = settings.bridge
    if bridge.bus != "none":
        for route in bridge.topics:
            if not route.is_exclusion and route.to != "ros":
                published += command_filters(route, settings.robot)
    for out in link.out:
        if names_the_robot(link, out):
            continue  # which is said
        if any(level.startswith("_") for level in out.topic.split("/")):
            continue  # answers, feedback and states of calls
        if link.vehicle is not None and out.topic == "visualization":
            continue  # which VDA 5050 leaves to the robot
        if not any(overlaps(out.local_filter, each) for each in published):
            line = f"topic write {out.local_filter.replace(f'{settings.robot}/', '{robot}/', 1)}"
            yield (
                f"out {out.topic}: nobody publishes {out.local_filter} here: no route to MQTT "
                f"does, and no user may; add to {settings.broker.acl.name}, below the line of the "
                f"user that does: {line}"
            )


def _without_call(settings: Settings, link: UpstreamSettings) -> Iterator[str]:
    """Calls from the fleet of what is not bridged."""
    calls = [each.replace("{robot}", settings.robot) for each in call_topics(settings.bridge)]
    if settings.bridge.bus == "none":
        calls = []
    for rule in link.inward:
        if not _CALLS.isdisjoint(rule.topic.split("/")) and not any(
            overlaps(rule.local_filter, call) for call in calls
        ):
            yield f"in {rule.topic}: nothing that is bridged is called at {rule.local_filter}"


def _too_short(link: UpstreamSettings) -> Iterator[str]:
    """Times that no connection can keep."""
    for rule in link.inward:
        if rule.offline == "drop" and rule.late is not None and rule.late < 2 * SHORTEST_PING:
            yield (
                f"in {rule.topic}: late {format_duration(rule.late)} cannot be kept, and its "
                "commands are dropped: how old one can be is known from pings, of which there is "
                f"one every {format_duration(SHORTEST_PING)} at most"
            )


def _slower_than_its_routes(settings: Settings, link: UpstreamSettings) -> Iterator[str]:
    """Rules that send less than a route publishes, and keep the rest, which then only grows.

    Without a rate of the route nobody knows how much comes.
    """
    if settings.bridge.bus == "none":
        return
    for route in settings.bridge.topics:
        if route.is_exclusion or route.to == "ros" or route.rate is None:
            continue
        topics = command_filters(route, settings.robot)
        # Without `qos` the publisher on ROS decides: a reliable one has QoS 1.
        qos = 1 if route.qos is None else route.qos
        for out in link.out:
            if any(overlaps(out.local_filter, each) for each in topics):
                is_slower = out.rate is not None and out.rate < route.rate
                if is_slower and out.kept(qos, route.retain is True) == "all":
                    yield (
                        f"out {out.topic}: rate {out.rate:g} is less than the {route.rate:g} a "
                        f"second of the route {route.names[0]}, and with QoS 1 all that is not "
                        "sent waits, longer and longer; add: keep: latest"
                    )
                if all(covers(out.local_filter, each) for each in topics):
                    break
