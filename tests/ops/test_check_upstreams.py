"""`appliance check` of links: what their brokers cannot carry, missing rights, late commands."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest
import yaml

from appliance import certs, config
from appliance.ops.check import Finding, check
from appliance.ops.init import initialise
from appliance.upstream.credentials import read_credentials
from appliance.upstream.rules import UpstreamLogin

RULES = """\
user alice
topic write {robot}/#
topic write x/#
user upstream
topic read {robot}/events/#
topic write {robot}/cmd_vel
"""


@pytest.fixture
def here(tmp_path: Path) -> Path:
    list(initialise(tmp_path, robot="r2", user="alice"))
    with (tmp_path / "acl.conf").open("a") as file:
        file.write(RULES)
    return tmp_path


def found(
    here: Path, bridge: dict[str, Any] | None = None, robot: str = "r2", **keys: Any
) -> list[Finding]:
    """What is said of the link with these keys, and of links in general."""
    link: dict[str, Any] = {
        "name": "fleet",
        "servers": ["mqtts://broker.example"],
        "out": [{"topic": "events/#"}],
    }
    link.update({"in": keys.pop("in_", []), **keys})
    said = {"robot": robot, "upstreams": [link], "bridge": {"bus": "ros2", **(bridge or {})}}
    (here / "appliance.yaml").write_text(yaml.safe_dump(said))
    told = check(config.load(here / "appliance.yaml"))
    return [each for each in told if each.subject.startswith("upstream")]


def troubles(here: Path, **keys: Any) -> list[str]:
    """The findings that are not ok, as `level text`."""
    told = found(here, **keys)
    return [f"{each.level} {each.text}" for each in told if each.level != "ok"]


def test_a_link_that_is_right(here: Path) -> None:
    (finding,) = found(here)
    assert (finding.level, finding.subject) == ("ok", "upstream fleet")
    assert finding.text == ("mqtts://broker.example:8883, as user 'upstream'; rules: 1 out, 0 in")
    strangers = [
        each.text for each in check(config.load(here / "appliance.yaml")) if "no user" in each.text
    ]
    assert strangers == []  # nobody logs in as the link's user


def test_a_slip_in_the_name_of_the_links_user(here: Path) -> None:
    found(here, user="upstraem")
    told = [each.text for each in check(config.load(here / "appliance.yaml"))]
    (text,) = [each for each in told if "no user" in each]
    assert "'upstream', who is no user, and the user of no link: did you mean 'upstraem'?" in text


def test_files_of_the_fleet_that_are_not_there(here: Path) -> None:
    """`appliance init` cannot make them."""
    tls = {"ca": "nope.crt", "certificate": "no.crt", "key": "no.key"}
    told = troubles(here, tls=tls)
    assert [each.rpartition("; ")[2] for each in told] == [
        "copy the fleet's CA certificate there",
        *["the one that the fleet has made for this robot belongs there"] * 2,
    ]
    assert f"error tls.ca: there is no file {here / 'nope.crt'}" in told[0]


def test_a_folder_that_may_not_be_looked_into_is_told(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root, who runs tests, may look into all."""

    stat = Path.stat

    def closed(path: Path, *, follow_symlinks: bool = True) -> os.stat_result:
        if path.name == "the.key":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, follow_symlinks=follow_symlinks)

    monkeypatch.setattr(Path, "stat", closed)
    told = troubles(here, tls={"certificate": "no.crt", "key": "the.key"})
    assert f"error tls.key: {here / 'the.key'} cannot be read: Permission denied" in told[1]


def test_backlogs_that_the_disk_has_no_room_for(here: Path) -> None:
    assert troubles(here, backlog={"size": "1 MiB"}) == []
    (told,) = troubles(here, backlog={"size": "5000000 GiB"})
    assert told.startswith(
        "warning backlog.size of all links and broker.store.size are 5000001 GiB"
    )
    assert f"{here} has room for " in told


def test_without_links_nothing_is_said(here: Path) -> None:
    assert not [
        each
        for each in check(config.load(here / "appliance.yaml"))
        if each.subject.startswith("upstream")
    ]


def test_a_link_that_carries_nothing(here: Path) -> None:
    assert troubles(here, out=[]) == [
        "warning it carries nothing: it has no rules in `out` and `in`"
    ]


@pytest.mark.parametrize(
    ("server", "kind", "trouble"),
    [
        ("mqtt://broker.example", "generic", "warning mqtt://broker.example:1883: without TLS"),
        ("ws://10.0.0.1", "generic", "warning ws://10.0.0.1:80/mqtt: without TLS"),
        ("mqtt://127.0.0.1", "generic", ""),
        ("mqtt://[::1]", "generic", ""),
        ("mqtt://localhost", "generic", ""),
        ("mqtt://x", "azure-event-grid", "error mqtt://x:1883: azure-event-grid needs TLS: mqtts"),
        ("ws://x", "azure-event-grid", "error ws://x:80/mqtt: azure-event-grid needs TLS: wss"),
    ],
)
def test_without_tls(here: Path, server: str, kind: str, trouble: str) -> None:
    told = [each for each in troubles(here, servers=[server], kind=kind) if "TLS" in each]
    assert len(told) == bool(trouble)
    assert all(each.startswith(trouble) for each in told)


def test_tls_of_a_link_that_has_none(here: Path) -> None:
    told = troubles(here, servers=["mqtt://localhost"], tls={"server_name": "x"})
    assert told == ["warning tls: no server of it is dialled with TLS"]


def test_a_link_by_vda5050(here: Path) -> None:
    profile = {"vda5050": {"manufacturer": "acme"}}
    lines = [
        f"warning {what}: no rule lets the user 'upstream' {access} r2/vda5050/{name}; add to "
        f"acl.conf below the line `user upstream`: topic {access} {{robot}}/vda5050/{name}"
        for what, access, name in (
            ("out state", "read", "state"),
            ("out factsheet", "read", "factsheet"),
            ("out visualization", "read", "visualization"),
            ("in order", "write", "order"),
            ("in instantActions", "write", "instantActions"),
        )
    ]
    assert troubles(here, profile=profile, out=[]) == lines
    with (here / "acl.conf").open("a") as file:
        file.writelines(f"{line.partition('upstream`: ')[2]}\n" for line in lines)
    assert troubles(here, profile=profile, out=[]) == []
    said = "VDA 5050 2.1.0: acme/r2, online and offline at uagv/v2/acme/r2/connection"
    assert said in [each.text for each in found(here, profile=profile, out=[])]
    profile["vda5050"]["manufacturer"] = "acme & sons"
    (trouble,) = troubles(here, profile=profile, out=[])
    assert trouble.startswith("warning profile: the manufacturer 'acme & sons' has other char")
    told = troubles(here, profile=profile, kind="azure-event-grid")
    assert "error profile: VDA 5050 needs uagv/v2/acme & sons/r2/connection retained" in told


def test_a_robot_by_vda5050_that_publishes_nothing(here: Path) -> None:
    (here / "acl.conf").write_text("user upstream\ntopic readwrite {robot}/#\n")
    profile = {"vda5050": {"manufacturer": "acme"}}
    told = [each for each in troubles(here, profile=profile, out=[]) if "nobody publishes" in each]
    # By the standard, `visualization` is up to the robot.
    assert [each.split()[2] for each in told] == ["state:", "factsheet:"]


def test_the_default_name_of_robots(here: Path) -> None:
    told = [each for each in troubles(here, robot="robot") if "robot's name" in each]
    assert len(told) == 1 and told[0].startswith("warning the robot's name is 'robot'")


def test_what_is_not_durable(here: Path) -> None:
    text = "upstreams: [{name: a, servers: [mqtts://a]}]\nbroker: {store: {durability: off}}"
    (here / "appliance.yaml").write_text(text.replace("off", '"off"'))
    told = [each.text for each in check(config.load(here / "appliance.yaml"))]
    assert any("what waits for a link ends with the process" in each for each in told)


def test_files_of_a_link(here: Path) -> None:
    secret = here / "fleet.password"
    keys: dict[str, Any] = {"login": {"username": "a", "password_file": "fleet.password"}}
    assert troubles(here, **keys) == [
        f"error login.password_file: {secret} cannot be read: No such file or directory"
    ]
    secret.touch(mode=0o600)
    assert "has nothing in its first line" in troubles(here, **keys)[0]
    secret.write_text("\nhunter2\n")  # `run` reads the first line as well
    assert "has nothing in its first line" in troubles(here, **keys)[0]
    with pytest.raises(ValueError, match="nothing in its first line"):
        read_credentials(UpstreamLogin("a", secret))
    secret.write_text("hunter2\nand more\n")
    assert troubles(here, **keys) == []
    assert read_credentials(UpstreamLogin("a", secret)).password == b"hunter2"
    secret.chmod(0o640)
    assert troubles(here, **keys) == [
        f"error login.password_file: {secret} is open to others than its owner; close it with: "
        f"chmod go= {secret}"
    ]
    assert "login.token_file" in troubles(here, login={"token_file": "none"})[0]
    assert "cannot be read: Is a directory" in troubles(here, login={"token_file": "certs"})[0] or (
        "is open to others" in troubles(here, login={"token_file": "certs"})[0]
    )


def test_certificates_of_a_link(here: Path) -> None:
    certs.issue_client(here / "certs", "fleet")
    right = {
        "ca": "certs/ca.crt",
        "certificate": "certs/clients/fleet.crt",
        "key": "certs/clients/fleet.key",
    }
    assert troubles(here, tls=right) == []
    told = troubles(here, tls={"ca": "no.crt", "certificate": "acl.conf", "key": "acl.conf"})
    assert len(told) == 3 and all(each.startswith("error tls.") for each in told)
    assert "no.crt" in told[0] and "is not a certificate" in told[1]
    (here / "certs/clients/fleet.key").chmod(0o644)
    assert len(troubles(here, tls=right)) == 1


@pytest.mark.parametrize(
    ("kind", "keys", "expected"),
    [
        ("generic", {}, []),
        (
            "generic",
            {"servers": ["mqtts://x.iot.eu-west-1.amazonaws.com"]},
            ["warning its server seems to be aws-iot, whose limits it would not know; add: kind:"],
        ),
        (
            "aws-iot",
            {"servers": ["mqtts://x.iot.eu-west-1.amazonaws.com"]},
            [
                "warning out events/#: topics there with more than 7 slashes are set aside",
                "warning messages over 128 KiB, as clients may send here",
                "warning aws-iot does not promise the order",
            ],
        ),
        (
            "aws-iot",
            {
                "out": [{"topic": "events/1/2/3/4/5"}, {"topic": "events/1/2/3/4/5/6"}],
                "in_": [{"topic": "cmd_vel"}],
                "keep_alive": "10 s",
                "client_id": "x" * 129,
                "login": {"method": "x", "token_file": "token"},
            },
            [
                "error login.token_file",
                "error login.method: aws-iot knows no enhanced authentication",
                "error client_id has 129 bytes, and 128 is the most there",
                "warning keep_alive is 30 s there, not 10 s",
                "error out events/1/2/3/4/5/6: fleet/r2/events/1/2/3/4/5/6 is a topic with 8",
                "warning messages over",
                "warning aws-iot does not promise",
            ],
        ),
        (
            "aws-iot",
            {"out": [], "in_": [{"topic": "cmd_vel"}], "prefix": f"{'x' * 250}/"},
            ["error prefix: the link's own topic", "error in cmd_vel: "],
        ),
        (
            "azure-event-grid",
            {"keep_alive": "2000 s"},
            [
                "warning keep_alive is 1160 s there, not 2000 s",
                "warning messages over 512 KiB",
                "warning azure-event-grid retains nothing",
            ],
        ),
        (
            "rabbitmq",
            {"in_": [{"topic": "cmd_vel"}, {"topic": "cmd_vel/#"}]},
            ["warning in cmd_vel/#: rabbitmq sends nothing retained for wildcards"],
        ),
    ],
)
def test_what_a_kind_cannot_carry(
    here: Path, kind: str, keys: dict[str, Any], expected: list[str]
) -> None:
    told = troubles(here, kind=kind, **keys)
    assert len(told) == len(expected), told
    for each, start in zip(told, expected, strict=True):
        assert each.startswith(start)


def test_calls_of_3_1_1_need_room_for_a_token(here: Path) -> None:
    rules = [{"topic": topic} for topic in ("a/_call", "b/_call", "b/_call/+", "c/#")]
    told = troubles(here, version="3.1.1", in_=rules, out=[])
    (text,) = [each for each in told if "3.1.1" in each]
    assert text.startswith("warning in a/_call: ") and text.endswith("add: topic: a/_call/+")
    assert not any("3.1.1" in each for each in troubles(here, in_=rules))


def test_the_rates_of_a_kind_are_told(here: Path) -> None:
    told = [each.text for each in found(here, kind="aws-iot") if each.level == "ok"]
    assert "it sends at most 100 messages and 512 KiB a second" in told


def test_missing_rights_are_told_with_the_line_to_add(here: Path) -> None:
    keys: dict[str, Any] = {
        "out": [{"topic": "events/#"}, {"topic": "odom"}, {"topic": "#", "local_prefix": "x/"}],
        "in_": [{"topic": "cmd_vel"}, {"topic": "mission/#"}, {"topic": "reset/_call"}],
        "bridge": {"services": ["/reset"], "discovery": "localhost"},
    }
    told = troubles(here, **keys)
    lines = [each.partition("below the line `user upstream`: ")[2] for each in told]
    assert lines == [
        "topic read {robot}/odom",
        "topic read x/#",
        "topic write {robot}/mission/#",
        "topic write {robot}/reset/_call",
        "topic write {robot}/_upstream/fleet/#",
    ]
    assert told[2].startswith(
        "warning in mission/#: no rule lets the user 'upstream' write r2/mission/#; add to acl.conf"
    )
    # These lines do it, and one that gives a part of a filter is enough.
    lines[2] = "topic write {robot}/mission/a"
    with (here / "acl.conf").open("a") as file:
        file.write("\n".join(lines) + "\n")
    assert troubles(here, **keys) == []


def test_rights_that_are_denied(here: Path) -> None:
    (here / "acl.conf").write_text(
        "user alice\ntopic {robot}/#\nuser upstream\ntopic {robot}/#\ntopic deny {robot}/events/#\n"
    )
    (told,) = troubles(here)
    assert "out events/#: no rule lets the user 'upstream' read r2/events/#" in told
    assert troubles(here, out=[{"topic": "#"}]) == []


def test_a_pattern_that_denies_and_names_clients(here: Path) -> None:
    """The link's client ids are levels of topics: such a pattern is about other topics."""
    with (here / "acl.conf").open("a") as file:
        file.write("pattern deny {robot}/private/%c/#\npattern read {robot}/%u/#\n")
    assert troubles(here, out=[{"topic": "upstream/x"}]) == []
    assert len(troubles(here, out=[{"topic": "private/_upstream.fleet/x"}])) == 1


DRIVE = {"ros": "/cmd_vel", "to": "ros", "expire": "1 s", "on_silence": {"after": "300 ms"}}


def test_what_the_fleet_commands_is_told(here: Path) -> None:
    in_ = [{"topic": "cmd_vel"}]
    told = [each.text for each in found(here, {"topics": [DRIVE]}, in_=in_)]
    assert (
        "in cmd_vel: the fleet commands /cmd_vel; what may be older than 300 ms is dropped" in told
    )
    plain = {"ros": "/cmd_vel", "to": "ros"}
    told = [each.text for each in found(here, {"topics": [plain]}, in_=in_)]
    assert (
        "in cmd_vel: the fleet commands /cmd_vel; what may be older than 10 s is dropped, as no "
        "route has expire or on_silence"
    ) in told


def test_late_where_nothing_is_commanded(here: Path) -> None:
    in_ = [{"topic": "cmd_vel", "late": "1 s"}]
    assert troubles(here, bridge={"topics": [DRIVE]}, in_=in_) == []
    assert troubles(here, in_=in_) == [
        "warning in cmd_vel: late is for commands, and no route to ROS takes its topics"
    ]
    assert troubles(here, in_=[{"topic": "cmd_vel"}]) == []


def test_calls_may_be_late_as_well(here: Path) -> None:
    keys = {"in_": [{"topic": "reset/_call", "late": "2 s"}], "bridge": {"services": ["/reset"]}}
    assert not any("late is for commands" in each for each in troubles(here, **keys))


def test_commands_that_the_fleets_broker_would_queue(here: Path) -> None:
    in_ = [{"topic": "cmd_vel", "offline": "keep"}]
    (told,) = troubles(here, bridge={"topics": [DRIVE]}, in_=in_)
    assert "the fleet's broker queues commands for /cmd_vel while the link is down" in told
    assert troubles(here, in_=in_) == []


def test_rules_that_need_mqtt_5(here: Path) -> None:
    keys: dict[str, Any] = {"out": [{"topic": "events/#"}], "in_": [{"topic": "events/x"}]}
    told = [each.text for each in found(here, **keys)]
    assert any("does not fall back to 3.1.1" in each for each in told)


@pytest.mark.parametrize(
    ("rules", "words"),
    [
        ({"out": [{"topic": "#"}, {"topic": "events/#"}]}, "out events/#: never used, as out #"),
        ({"out": [{"topic": "a/#"}, {"topic": "a"}]}, "out a: never used"),
        ({"in_": [{"topic": "+"}, {"topic": "cmd_vel"}]}, "in cmd_vel: never used, as in +"),
        (
            {"in_": [{"topic": "cmd_vel"}, {"topic": "#", "offline": "keep"}]},
            "their messages come twice",
        ),
        ({"out": [{"topic": "r2/events/#"}]}, "twice, as in r2/r2/events/#"),
        ({"prefix": "fleet/r2/{robot}/"}, "prefix: the robot's name is in it twice: fleet/r2/r2/"),
        (
            {"out": [{"topic": "a", "remote_prefix": "x/{robot}/{robot}/"}]},
            "out a: remote_prefix: the robot's name is in it twice: x/r2/r2/",
        ),
        (
            {"in_": [{"topic": "a", "local_prefix": "{robot}/r2/"}]},
            "in a: local_prefix: the robot's name is in it twice: r2/r2/",
        ),
        ({"out": [{"topic": "_appliance/state"}]}, "no rule carries r2/_appliance/state"),
        ({"in_": [{"topic": "_appliance/x"}]}, "no rule carries fleet/r2/_appliance/x"),
        ({"out": [{"topic": "lamp", "local_prefix": "cell/"}]}, "nobody publishes cell/lamp here"),
        (
            {"in_": [{"topic": "reset/_call"}]},
            "nothing that is bridged is called at r2/reset/_call",
        ),
        ({"in_": [{"topic": "cmd_vel", "late": "80 ms"}]}, "late 80 ms cannot be kept"),
    ],
)
def test_rules_that_cannot_do_what_they_say(here: Path, rules: dict[str, Any], words: str) -> None:
    with (here / "acl.conf").open("a") as file:
        file.write("topic readwrite {robot}/#\ntopic readwrite cell/#\n")
    told = [each for each in troubles(here, **rules) if words in each]
    assert len(told) == 1


def test_of_a_rule_that_names_the_robot_twice_only_that_is_said(here: Path) -> None:
    rules = {"out": [{"topic": "r2/other/#"}], "in_": [{"topic": "r2/other", "late": None}]}
    told = troubles(here, **rules)
    assert [("leave out r2/" in each, "add to" in each) for each in told] == [(True, False)] * 2


def test_rules_that_share_topics_in_a_useful_order(here: Path) -> None:
    with (here / "acl.conf").open("a") as file:
        file.write("topic readwrite {robot}/#\n")
    rules = [{"topic": "events/door", "keep": "latest"}, {"topic": "events/+"}, {"topic": "#"}]
    moved = {"topic": "#", "local_prefix": "", "remote_prefix": "all/"}
    assert troubles(here, out=[*rules, moved]) == []


@pytest.mark.parametrize(
    ("rule", "route", "is_told"),
    [
        ({"rate": 2}, {"rate": 10}, True),
        ({"rate": 2, "keep": "all"}, {"rate": 10, "qos": 0}, True),
        ({"rate": 2}, {"rate": 10, "qos": 0}, False),
        ({"rate": 2}, {"rate": 10, "retain": True}, False),
        ({"rate": 2, "keep": "latest"}, {"rate": 10}, False),
        ({"rate": 10}, {"rate": 10}, False),
        ({"rate": 2}, {}, False),
        ({}, {"rate": 10}, False),
    ],
)
def test_a_rule_that_sends_less_than_comes_and_keeps_the_rest(
    here: Path, rule: dict[str, Any], route: dict[str, Any], is_told: bool
) -> None:
    with (here / "acl.conf").open("a") as file:
        file.write("topic read {robot}/odom\n")
    bridge = {"topics": [{"ros": "/odom", "to": "mqtt", **route}]}
    told = troubles(here, bridge=bridge, out=[{"topic": "odom", **rule}])
    expected = (
        "warning out odom: rate 2 is less than the 10 a second of the route /odom, and with QoS 1 "
        "all that is not sent waits, longer and longer; add: keep: latest"
    )
    assert told == ([expected] if is_told else [])


def test_a_slower_rule_behind_one_for_a_part(here: Path) -> None:
    with (here / "acl.conf").open("a") as file:
        file.write("topic read {robot}/#\n")
    bridge = {"topics": [{"ros": "/**", "to": "mqtt", "rate": 10}]}
    told = troubles(here, bridge=bridge, out=[{"topic": "battery"}, {"topic": "#", "rate": 2}])
    assert len(told) == 1 and "out #: rate 2 is less than the 10 a second" in told[0]
