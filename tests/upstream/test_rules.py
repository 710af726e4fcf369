"""Rules of a link: topics there and back, which rule carries one, and what none may carry."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from appliance.config import TopicRoute
from appliance.config.settings import (
    BacklogSection,
    InSection,
    OutSection,
    UpstreamLoginSection,
    UpstreamSection,
    UpstreamTlsSection,
    Vda5050Section,
)
from appliance.mqtt.codec import V5, V311
from appliance.mqtt.topics import MAX_TOPIC, check_filter, check_topic, matches
from appliance.upstream.limits import KINDS
from appliance.upstream.rules import (
    LATE,
    CommandTopics,
    InRule,
    LinkRules,
    OutRule,
    RosTopics,
)
from appliance.upstream.settings import command_filters
from upstream.links import link

# The twin: topics and filters are lists of levels, prefixes are taken off character by character.


def naive_match(filter: list[str], topic: list[str]) -> bool:
    if filter == ["#"]:
        return True
    if not filter or not topic:
        return not filter and not topic
    return filter[0] in ("+", topic[0]) and (
        naive_match(filter[1:], topic[1:]) or (filter[1:] == ["#"] and len(topic) == 1)
    )


def naive_move(topic: str, pattern: str, prefix: str, other: str) -> str | None:
    if not naive_match((prefix + pattern).split("/"), topic.split("/")):
        return None
    if topic[0] == "$" and (prefix + pattern)[0] in "+#":
        return None
    rest = topic
    for char in prefix:
        if not rest or rest[0] != char:
            return None
        rest = rest[1:]
    return other + rest or None


LEVELS = st.sampled_from(["", "a", "b", "r2", "$x", "_upstream", "ab"])
TOPICS = st.lists(LEVELS, min_size=1, max_size=4).map("/".join).filter(bool)
PREFIXES = st.sampled_from(["", "a", "a/", "r2/", "fleet/r2/", "$x/", "/", "a/b"])
PATTERNS = st.sampled_from(
    ["", "#", "+", "a", "a/#", "+/b", "a/+", "/#", "/a", "$x/#", "+/#", "a/+/#", "b"]
)


@given(PREFIXES, PREFIXES, PATTERNS, TOPICS)
def test_topics_are_mapped_as_the_twin_maps_them(
    local: str, remote: str, pattern: str, topic: str
) -> None:
    for filter in (local + pattern, remote + pattern):
        try:
            check_filter(filter)
        except ValueError:
            return  # the configuration does not take it
    rule = OutRule(pattern, local, remote)
    there = naive_move(topic, pattern, local, remote)
    if there is not None and there[0] == "$" and remote[:1] != "$":
        there = None
    assert rule.to_remote(topic) == there
    if there is not None:
        check_topic(there)
        assert matches(rule.remote_filter, there)
        # There and back it is the same; only what is the broker's own here does not come back.
        assert rule.to_local(there) == (None if topic[0] == "$" else topic)
    here = naive_move(topic, pattern, remote, local)
    if here is not None and here[0] == "$":
        here = None
    assert rule.to_local(topic) == here
    if here is not None:
        assert matches(rule.local_filter, here)
        assert rule.to_remote(here) == (topic if topic[0] != "$" or remote[:1] == "$" else None)


@pytest.mark.parametrize(
    ("rule", "here", "there"),
    [
        (OutRule("events/#", "r2/", "fleet/r2/"), "r2/events/door", "fleet/r2/events/door"),
        (OutRule("events/#", "r2/", "fleet/r2/"), "r2/events", "fleet/r2/events"),
        (OutRule("events/#", "r2/", "fleet/r2/"), "r2/event", None),
        (OutRule("events/#", "r2/", "fleet/r2/"), "r3/events/door", None),
        (OutRule("#", "r2/", "fleet/r2/"), "r2", None),  # which `r2/#` matches
        (OutRule("", "r2/drive", "vehicles/7/drive"), "r2/drive", "vehicles/7/drive"),
        (OutRule("$SYS/#", "", "fleet/r2/"), "$SYS/broker/uptime", "fleet/r2/$SYS/broker/uptime"),
        (OutRule("#", "", "fleet/"), "$SYS/broker/uptime", None),
        (OutRule("#", "a/", ""), "a/$SYS/x", None),
        (OutRule("x", "r2/", "$aws/things/r2/"), "r2/x", "$aws/things/r2/x"),
    ],
)
def test_where_a_topic_goes(rule: OutRule, here: str, there: str | None) -> None:
    assert rule.to_remote(here) == there


@pytest.mark.parametrize(
    ("rule", "there"),
    [
        (InRule("#", "", "fleet/r2/"), "fleet/r2/$SYS/broker/uptime"),
        (InRule("#", "", "fleet/r2/"), "fleet/r2/$CONTROL/appliance/v1/x"),
        (InRule("#", "", "fleet/r2/"), "fleet/r2/"),
        (InRule("#", "", "fleet/r2/"), "fleet/r2"),
        (InRule("#", "r2/", "f/"), "f/" + "x" * (MAX_TOPIC - 2)),
        (InRule("#", "robot/", "f/"), "f/" + "ü" * (MAX_TOPIC // 2 - 1)),
        (InRule("#", "r2/", "f/"), "f/a\nb"),
        (InRule("#", "r2/", "f/"), "f/+"),
        (InRule("#", "r2/", "f/"), "f/a/#"),
    ],
)
def test_what_comes_in_never_becomes_a_topic_that_it_may_not_be(rule: InRule, there: str) -> None:
    assert matches(rule.remote_filter, there)
    assert rule.to_local(there) is None


def test_the_first_rule_that_matches_carries_a_topic() -> None:
    rules = LinkRules(
        link(
            "out: [{topic: 'a/b', priority: high}, {topic: 'a/#', remote_prefix: x/}, {topic: +/b}]"
        )
    )
    for _ in range(2):  # the second time it is remembered
        found = {topic: rules.out(f"r2/{topic}") for topic in ("a/b", "a/c", "c/b", "c/d")}
        assert {topic: each and (each[0].topic, each[1]) for topic, each in found.items()} == {
            "a/b": ("a/b", "fleet/r2/a/b"),
            "a/c": ("a/#", "x/a/c"),
            "c/b": ("+/b", "fleet/r2/c/b"),
            "c/d": None,
        }
    # A rule that matches and cannot carry it leaves it to the next.
    rules = LinkRules(link("in: [{topic: '#', local_prefix: ''}, {topic: '$x', local_prefix: s/}]"))
    found_in = rules.inward("fleet/r2/$x")
    assert found_in is not None and found_in[1] == "s/$x"


def test_what_is_remembered_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = LinkRules(link("in: [{topic: '#'}]"))
    for number in range(10_000):
        assert rules.inward(f"fleet/r2/{number}") is not None
    long = "x" * 60_000
    assert rules.inward(f"fleet/r2/{long}") is not None
    remembered = rules._in._found
    assert 0 < len(remembered) <= 4096 and all(len(topic) < 1000 for topic in remembered)


def test_no_rule_carries_what_is_the_links_own() -> None:
    everything = LinkRules(link("out: [{topic: '#'}], in: [{topic: '#'}]"))
    carried = {
        "r2/odom",
        "r2/_appliance/routes",
        "r2/_appliance/schema/x/Y",
        "r2/_appliance",
        "r2/_upstream",
        "r2/a/_upstream/b",
    }
    own = {
        "r2/_appliance/state",  # the link says itself whether the appliance is online
        "r2/_appliance/upstream/fleet",  # it changes with every message that is sent
        "r2/_upstream/fleet/0123",  # an answer: it goes where its token says
        "r2/_upstream/other/0123",
        "r2/_answers/0123",
    }
    assert {topic for topic in carried | own if everything.out(topic)} == carried
    coming = {"odom", "a/_appliance/state", "_appliance", "cmd_vel"}
    refused = {
        "_appliance/state",
        "_appliance/routes",
        "_appliance/upstream/fleet",
        "_upstream/fleet/0123",
        "_answers/0123",
    }
    assert {t for t in coming | refused if everything.inward(f"fleet/r2/{t}")} == coming
    # Nor by another way.
    other = LinkRules(
        link("out: [{topic: '#', local_prefix: x/}], in: [{topic: '#', remote_prefix: y/}]")
    )
    elsewhere = LinkRules(link("out: [{topic: '#', remote_prefix: y/}]"))
    assert {topic for topic in carried | own if elsewhere.out(topic)} - {"r2/_answers/0123"} == (
        carried
    )
    assert other.out("x/_answers/0123") is None and other.out("x/_appliance/state") is None
    assert other.inward("y/_upstream/fleet/0123") is None
    assert other.out("x/odom") is not None and other.inward("y/odom") is not None


def test_how_messages_wait() -> None:
    cases = list(itertools.product((0, 1, 2), (False, True)))
    auto = OutRule("a", "r2/", "f/")
    assert {case: auto.kept(*case) for case in cases} == {
        (0, False): "latest",
        (0, True): "latest",
        (1, False): "all",
        (1, True): "latest",
        (2, False): "all",
        (2, True): "latest",
    }
    for keep in ("all", "latest", "none"):
        rule = OutRule("a", "r2/", "f/", keep)
        assert {rule.kept(*case) for case in cases} == {keep}
    lanes = [
        rule.lane
        for rule in link(
            "out: [{topic: a, priority: low}, {topic: b}, {topic: c, priority: high}]"
        ).out
    ]
    assert lanes == [2, 1, 0]


def test_the_filters_to_subscribe_to() -> None:
    rules = LinkRules(
        link(
            "out: [{topic: a}, {topic: 'b/#'}], in: [{topic: c}, {topic: 'd/#', offline: keep}, "
            "{topic: e, remote_prefix: x/}]"
        )
    )
    assert rules.out_filters == ["r2/a", "r2/b/#"]
    assert rules.in_filters("drop") == ["fleet/r2/c", "x/e"]
    assert rules.in_filters("keep") == ["fleet/r2/d/#"]


@pytest.mark.parametrize(
    ("rule", "late"),
    [
        ("{topic: cmd_vel}", 0.5),
        ("{topic: +}", 0.2),  # the least of those that it feeds
        ("{topic: arm/joint}", 0.2),
        ("{topic: arm/joint/x}", LATE),
        ("{topic: light}", LATE),  # a route that says nothing
        ("{topic: odom}", LATE),  # of a route to MQTT
        ("{topic: other}", LATE),
        ("{topic: wheel/left/speed}", 3.0),
        ("{topic: wheel/speed}", 3.0),
        ("{topic: drive, local_prefix: cars/}", 4.0),
        ("{topic: cmd_vel, late: 2 s}", 2.0),
        ("{topic: cmd_vel, offline: keep}", None),
    ],
)
def test_late_is_what_the_routes_say_that_a_rule_feeds(rule: str, late: float | None) -> None:
    bridge = """\
bridge:
  topics:
    - {ros: /cmd_vel, to: ros, expire: 1 s, on_silence: {after: 500 ms}}
    - {ros: /other_vel, to: both, on_silence: {after: 200 ms}, mqtt: "{robot}/x"}
    - {ros: "/arm/*", to: ros, expire: 200 ms}
    - {ros: /light, to: ros}
    - {ros: /odom, to: mqtt}
    - {ros: ["/wheel/**", "!/wheel/x"], to: ros, expire: 3 s}
    - {ros: /drive, to: ros, expire: 4 s, mqtt: "cars{ros}"}
    - "!/secret/**"
"""
    (found,) = link(f"in: [{rule}]", bridge).inward
    assert found.late == late
    assert link("in: [{topic: cmd_vel}]", "bridge: {bus: none}").inward[0].late == LATE


@pytest.mark.parametrize(
    ("route", "filters"),
    [
        ({"ros": "/cmd_vel"}, ["r2/cmd_vel"]),
        ({"ros": "/cmd_vel", "mqtt": "cars/{robot}/drive"}, ["cars/r2/drive"]),
        ({"ros": "/arm/*/cmd"}, ["r2/arm/+/cmd"]),
        ({"ros": "/arm/left_*"}, ["r2/arm/+"]),
        ({"ros": "/arm/**", "mqtt": "{robot}{ros}/set"}, ["r2/arm/#"]),
        ({"ros": "/arm/x**/y"}, ["r2/arm/#"]),
        ({"ros": ["/a/*", "/b", "!/a/x"]}, ["r2/a/+", "r2/b"]),
    ],
)
def test_the_topics_that_a_route_takes(route: dict[str, object], filters: list[str]) -> None:
    assert command_filters(TopicRoute.model_validate({"to": "ros", **route}), "r2") == filters
    assert [check_filter(each) for each in filters]


def test_late_of_overlapping_filters() -> None:
    ros = RosTopics((CommandTopics("r2/a", 3.0, 2.0), CommandTopics("r2/+", None, 5.0)))
    assert (ros.default_late("r2/#"), ros.judged_by("r2/#")) == (2.0, 3.0)
    assert (ros.default_late("r2/b"), ros.judged_by("r2/b")) == (5.0, 5.0)
    assert (ros.default_late("r2/a/b"), ros.judged_by("r2/a/b")) == (LATE, None)


CALLS = """\
bridge:
  services: [{ros: /reset, timeout: 2 s}, {ros: "/arm/*", timeout: 1 min}]
  actions: [{ros: /walk}]
  parameters: [{ros: "/controller/*", timeout: 3 s}]
  topics: [{ros: /cmd_vel, to: ros, expire: 400 ms}]"""


@pytest.mark.parametrize(
    ("rule", "late", "least"),
    [
        # A late call is answered that it is late, so that it is taken; but its age has to be known.
        ("{topic: reset/_call}", LATE, 2.0),
        ("{topic: +/_goal}", LATE, 5.0),
        ("{topic: +/_cancel}", LATE, LATE),
        ("{topic: arm/grip/_call}", 60.0, 60.0),
        ("{topic: controller/_param/+/set}", LATE, 3.0),
        ("{topic: reset/_call, late: 8 s}", 8.0, 2.0),
        ("{topic: reset/_call, late: 1 s}", 1.0, 1.0),
        ('{topic: "#"}', 0.4, 0.4),
        ("{topic: cmd_vel, late: 5 s}", 5.0, 0.4),
        ("{topic: reset/_call, offline: keep}", None, 2.0),
        ("{topic: other}", LATE, LATE),
    ],
)
def test_late_of_calls(rule: str, late: float | None, least: float) -> None:
    settings = link(f"in: [{rule}]", CALLS)
    (found,) = settings.inward
    assert (found.late, found.least_age) == (late, least)
    (found,) = link(f"in: [{rule}]", "bridge: {bus: none}").inward
    assert found.judged_by is None


def test_a_link_is_what_the_file_says() -> None:
    found = link(
        "version: 3.1.1, client_id: 'x-{robot}', login: {username: '{robot}', password_file: p}, "
        "keep_alive: 1500 ms, prefix: 'f/{robot}/', tls: {alpn: [mqtt]}, "
        "out: [{topic: a, local_prefix: 'l/{robot}/', remote_prefix: 'r/{robot}/'}]"
    )
    assert (found.version, found.client_id, found.login.username) == (V311, "x-r2", "r2")
    assert found.login.password_file == Path("/srv/p")
    assert (found.keep_alive, found.prefix, found.tls.alpn) == (2, "f/r2/", ("mqtt",))
    assert found.out == (OutRule("a", "l/r2/", "r/r2/"),)
    assert found.answers_here == "r2/_upstream/fleet/"
    assert found.answers_there == "f/r2/_answers/"
    assert found.state_there == "f/r2/_appliance/state"
    assert found.status_here == "r2/_appliance/upstream/fleet"
    assert link("").version == V5
    assert "hunter2" not in repr(link("proxy: 'http://me:hunter2@p'"))


def test_overlapping_rules_are_named() -> None:
    found = link("out: [{topic: 'a/#'}, {topic: b}], in: [{topic: +/x}, {topic: b}, {topic: c}]")
    assert [(out.topic, inward.topic) for out, inward in found.overlapping()] == [
        ("a/#", "+/x"),
        ("b", "b"),
    ]


PAGE = (Path(__file__).parents[2] / "docs/upstream.md").read_text()


def test_the_examples_of_the_page_are_mapped_so() -> None:
    rows = re.findall(r"^\| `(\{topic.+?\})` \| `(.+?)` \| `(.+?)` \|$", PAGE, re.M)
    assert len(rows) >= 5
    for rule, here, there in rows:
        settings = link(f"out: [{rule}]", robot="r2d2")
        found = LinkRules(settings).out(here)
        assert found is not None and found[1] == there, rule
        if here[0] != "$":
            back = LinkRules(link(f"in: [{rule}]", robot="r2d2")).inward(there)
            assert back is not None and back[1] == here, rule


def test_the_page_has_every_key() -> None:
    sections = (
        UpstreamSection,
        UpstreamLoginSection,
        UpstreamTlsSection,
        BacklogSection,
        OutSection,
        InSection,
    )
    keys = {field.alias or name for each in sections for name, field in each.model_fields.items()}
    assert {key for key in keys if f"`{key}`" not in PAGE} == set()
    assert {kind for kind in KINDS if f"`{kind}`" not in PAGE} == set()


VDA5050 = (Path(__file__).parents[2] / "docs/vda5050.md").read_text()


def test_the_topics_of_the_page_of_vda5050_are_mapped_so() -> None:
    rows = re.findall(r"^\| `(.+?)` \| `(.+?)` \| (in|out) \|", VDA5050, re.M)
    assert len(rows) == 7
    for here, there, direction in rows:
        version = "3.0" if "/v3/" in there else "2.1"
        for each in {version, "3.0"}:
            keys = f"profile: {{vda5050: {{manufacturer: acme, version: {each}}}}}"
            rules = LinkRules(link(keys, robot="r2d2"))
            moved = there.replace("uagv/v2", "vda5050/v3") if each == "3.0" else there
            found = rules.out(here) if direction == "out" else rules.inward(moved)
            assert found is not None and found[1] == (moved if direction == "out" else here)
    assert not re.search(r"connection` \| (in|out)", VDA5050)


def test_the_connection_of_vda5050_is_the_links_own() -> None:
    keys = "profile: {vda5050: {manufacturer: acme}}, out: [{topic: '#'}], in: [{topic: '#'}]"
    rules = LinkRules(link(keys))
    assert rules.inward("uagv/v2/acme/r2/connection") is None and rules.out("r2/connection") is None
    assert rules.out("r2/x") is not None and rules.inward("uagv/v2/acme/r2/x") is not None


def test_the_page_of_vda5050_has_every_key() -> None:
    for key, field in Vda5050Section.model_fields.items():
        shown = f'`"{field.default}"`' if isinstance(field.default, str) else ""
        assert f"| `{key}` | {shown}" in VDA5050
