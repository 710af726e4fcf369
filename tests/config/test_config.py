"""appliance.yaml: defaults, units, environment, and every mistake told at once with its place."""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from appliance import config
from appliance.broker.limits import Limits, UserLimits
from appliance.config import Bind, ConfigError, Settings, reading
from appliance.config.settings import LimitsSection, UserLimitsSection
from appliance.net.listeners import Admission

REFERENCE = Path(__file__).parents[2] / "appliance.yaml"
HERE = Path("/srv/robot/appliance.yaml")


def loads(text: str, **environment: str) -> Settings:
    return config.loads(text, HERE, environment)


def problems(text: str, **environment: str) -> list[str]:
    """Each problem as `line: key: what`."""
    with pytest.raises(ConfigError) as raised:
        loads(text, **environment)
    return [str(problem).removeprefix(f"{HERE}:") for problem in raised.value.problems]


def test_an_empty_file_is_a_secure_broker() -> None:
    broker = loads("").broker
    assert [(str(listener.bind), listener.tls) for listener in broker.listeners] == [
        ("0.0.0.0:8883", True),
        ("127.0.0.1:1883", False),
    ]
    assert not broker.anonymous
    assert broker.users == HERE.parent / "users.passwd"
    assert broker.acl == HERE.parent / "acl.conf"
    assert broker.tls.certificate == HERE.parent / "certs/server.crt"
    assert broker.tls.key == HERE.parent / "certs/server.key"
    assert broker.tls.ca == HERE.parent / "certs/ca.crt"
    assert loads("").file == HERE


def keys(section: type[BaseModel]) -> dict[str, object]:
    """The keys of a section, those of sections inside it included."""
    return {
        name: keys(field.annotation)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        else None
        for name, field in section.model_fields.items()
    }


def test_the_reference_has_every_key_with_its_default() -> None:
    text = REFERENCE.read_text()

    def missing(written: object, expected: dict[str, object], path: str = "") -> list[str]:
        assert isinstance(written, dict), path
        found = [f"{path}{name}" for name in expected if name not in written]
        for name, inner in expected.items():
            if isinstance(inner, dict) and name in written:
                found += missing(written[name], inner, f"{path}{name}.")
        return found

    assert missing(yaml.safe_load(text), keys(Settings)) == []
    assert config.loads(text, HERE).model_dump() == loads("").model_dump()
    for line in text.splitlines():
        if re.match(r" *(- )?\w+:", line) and not line.rstrip().endswith(":"):
            assert " # " in line or "tls: " in line, f"says no why: {line}"


def example_of_the_reference() -> str:
    """The reference with the examples in its comments in place of empty lists."""
    lists = r"(?m)^(  topics|  services|  actions|  parameters|upstreams): \[\].*"
    return re.sub(r"(?m)^  #  ", "    ", re.sub(lists, r"\1:", REFERENCE.read_text()))


def test_the_example_routes_of_the_reference_load() -> None:
    example = example_of_the_reference()
    bridge = config.loads(example, HERE).bridge
    routes = bridge.topics
    assert [(route.ros, route.to) for route in routes] == [
        ("/odom", "mqtt"),
        ("/camera/image_raw", "mqtt"),
        ("/cmd_vel", "ros"),
        (("/camera/**", "!/camera/*/raw"), "mqtt"),
        ("!/secret/**", "mqtt"),
        ("/**", "mqtt"),
    ]
    assert [route.is_exclusion for route in routes] == [False] * 4 + [True, False]
    assert routes[0].mqtt == config.TopicRoute(ros="/a", to="mqtt").mqtt
    assert yaml.safe_load(example)["bridge"]["topics"][0].keys() >= {"ros", "to", "type", "mqtt"}
    for called, model in (
        (bridge.services, config.ServiceRoute),
        (bridge.actions, config.ActionRoute),
        (bridge.parameters, config.ParameterRoute),
    ):
        # Every key is there, and what is its default is told as that.
        assert set().union(*(route.model_fields_set for route in called)) == {*model.model_fields}
        first = called[0]
        defaults = model(ros=first.ros).model_dump()
        assert {k: v for k, v in first.model_dump().items() if k != "type"} == {
            k: v for k, v in defaults.items() if k != "type"
        }


def test_every_problem_is_told_at_once_with_line_and_key() -> None:
    text = """\
robot: r2/d2
brokr: {}
broker:
  listeners:
    - bind: 0.0.0.0:88830
      foo: 1
  limits:
    packet_size: 16 MB
    keep_alive: 70000 s
    connect_timeout: 10
    inflight: 0
  users: 3
  users: users.passwd
bridge:
  bus: ros3
  topics:
    - {ros: odom, to: mqt}
    - {to: mqtt, type: std_msgs/String, mqtt: "{foo}/x"}
    - {ros: /a, to: both, expires: 500 ms}
    - ros: /b
      to: ros
      clamp: {linear.x: [1, 0]}
      on_silence: {after: 500}
log: {level: warn}
"""
    found = problems(text)
    expected = [
        "1: robot: must be one level",
        "2: brokr: unknown key; did you mean 'broker'?",
        "5: broker.listeners[0].bind: there is no port 88830",
        "6: broker.listeners[0].foo: unknown key; known: bind, tls",
        "8: broker.limits.packet_size: unknown unit 'MB'; use B, KiB, MiB or GiB (it says '16 MB')",
        "9: broker.limits.keep_alive: must be at most 65535 s",
        "10: broker.limits.connect_timeout: must be a duration such as",
        "11: broker.limits.inflight: must be at least 1",
        "12: broker.users: must be a path",
        "13: broker.users: is given twice; the first is on line 12",
        "15: bridge.bus: must be ros2, ros1 or none; did you mean 'ros2'?",
        "17: bridge.topics[0].ros: must be a full ROS name",
        "17: bridge.topics[0].to: must be mqtt, ros or both; did you mean 'mqtt'?",
        "18: bridge.topics[1].ros: is needed",
        "18: bridge.topics[1].mqtt: knows the placeholders",
        "18: bridge.topics[1].type: must be package/msg/Type",
        "19: bridge.topics[2].expires: unknown key; did you mean 'expire'?",
        "22: bridge.topics[3].clamp: linear.x must have its least before its most",
        "23: bridge.topics[3].on_silence.after: must be a duration such as",
        "24: log.level: must be debug, info, warning or error; did you mean 'warning'?",
    ]
    assert len(found) == len(expected)
    for problem, start in zip(found, expected, strict=True):
        assert problem.startswith(start)


#: Ten lines that stand for ten thousand million values.
_BOMB = "a0: &a0 x\n" + "".join(
    f"a{n + 1}: &a{n + 1} [{','.join([f'*a{n}'] * 10)}]\n" for n in range(10)
)


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("- 1", "must be keys with values"),
        ("a: [", "1: "),
        ("robot: *b", "1: found undefined alias"),
        ("log: &a {levels: *a}", "1: log.levels: is an alias of something that contains it"),
        ("robot: 2024-13-45", "1: robot: month must be in 1..12"),
        ("? [a]\n: b", "1: a key must be text"),
        ("a: 1\n---\nb: 1", "2: "),
        (_BOMB, "more than 100000 values"),
        ("robot: !!python/object:os.system x", "1: could not determine a constructor"),
    ],
)
def test_what_is_not_a_configuration_at_all(text: str, place: str) -> None:
    assert place in problems(text)[0]


@pytest.mark.parametrize(
    ("line", "example"),
    [
        ("on_silence: 500 ms", "on_silence: {after: 500 ms}"),
        ("clamp: [-1, 1]", "clamp: {linear.x: [-0.5, 0.5]}"),
        ("on_silence: {after: 1 s, publish: 0}", "publish: {linear: {x: 0}}"),
    ],
)
def test_a_value_where_keys_belong_is_told_with_an_example(line: str, example: str) -> None:
    (problem,) = problems(f"bridge:\n  topics:\n    - ros: /a\n      to: ros\n      {line}\n")
    assert f"must be keys with values, such as `{example}`" in problem


def test_rules_of_commands() -> None:
    text = """\
bridge:
  topics:
    - ros: /cmd_vel
      to: ros
      type: geometry_msgs/msg/Twist
      expire: 500 ms
      exclusive: true
      lease: 1 s
      on_silence: {after: 250 ms, publish: {linear: {x: 0}}}
      clamp: {linear.x: [-0.5, 1]}
      allow: {linear.z: [0, 1.5], linear.y: [a, true]}
"""
    (route,) = loads(text).bridge.topics
    assert (route.expire, route.exclusive, route.lease) == (0.5, True, 1.0)
    assert route.on_silence == config.OnSilenceSection(after=0.25, publish={"linear": {"x": 0}})
    assert route.clamp == {"linear.x": [-0.5, 1.0]}
    assert route.allow == {"linear.z": [0, 1.5], "linear.y": ["a", True]}
    again = config.loads(yaml.safe_dump(config.describe(loads(text))), HERE)
    assert again.bridge.topics == [route]


@pytest.mark.parametrize(
    ("route", "problem"),
    [
        ("to: mqtt, expire: 1 s", ".expire: is for routes to ROS only"),
        ("to: ros, rate: 10", ".rate: is for routes to MQTT only"),
        ("to: ros, bytes_per_second: 1 KiB", ".bytes_per_second: is for routes to MQTT only"),
        ("to: ros, qos: 0", ".qos: is for routes to MQTT only"),
        ("to: ros, retain: false", ".retain: is for routes to MQTT only"),
        ("to: ros, fields: [x]", ".fields: is for routes to MQTT only"),
        ("to: mqtt, fields: [x], encoding: cdr", ".fields: is for json and cbor only"),
        ("to: both, fields: [data], encoding: text", ".fields: is for json and cbor only"),
        ("to: mqtt, keep: 1000000000000", ".keep: must be at most 2147483647"),
        ("to: ros, lease: 1 s", ".lease: needs exclusive: true"),
        ("to: ros, clamp: {x: 3}", ".clamp: x must have its least and its most"),
        ("to: ros, clamp: {x: [.nan, 1]}", ".clamp: x must have its least before its most"),
        ("to: ros, clamp: {x: [true, 1]}", ".clamp: x must have its least and its most"),
        ("to: ros, clamp: {a..b: [0, 1]}", "'a..b' is not the path of a field"),
        ("to: ros, allow: {x: []}", ".allow: x must have a list"),
        ("to: ros, allow: {x: [{}]}", ".allow: x can have only text"),
        ("to: ros, on_silence: {publish: {}}", ".on_silence.after: is needed"),
        ("to: ros, on_silence: {after: 1 s, publish: {x: 2024-01-01}}", "JSON does not know"),
        ("to: ros, on_silence: {after: 1 s, publish: {x: .nan}}", "NaN is written null"),
        ("to: ros, on_silence: {after: 1 s, publish: {x: -.inf}}", "JSON does not know"),
    ],
)
def test_routes_that_cannot_be(route: str, problem: str) -> None:
    (found,) = problems(f"bridge: {{topics: [{{ros: /a, {route}}}]}}")
    assert problem in found


def test_routes_take_what_they_do_not_say_from_the_defaults() -> None:
    routes = loads(
        "bridge: {defaults: {rate: 5, encoding: cdr, qos: 1}, topics: ["
        "{ros: /a, to: mqtt, encoding: json}, {ros: /b, to: both, rate: null, qos: auto, keep: 3}]}"
    ).bridge.topics
    assert [(r.encoding, r.rate, r.qos, r.keep) for r in routes] == [
        ("json", 5, 1, "latest"),
        ("cdr", None, None, 3),
    ]
    assert routes[0].topic("r2d2") == "r2d2/a"


def test_routes_to_ros_take_nothing_that_is_of_mqtt() -> None:
    text = (
        "bridge: {defaults: {rate: 5, encoding: cdr, retain: true, keep: 7}, "
        "topics: [{ros: /a, to: ros, qos: auto}]}"
    )
    (route,) = loads(text).bridge.topics
    assert (route.encoding, route.keep, route.rate, route.retain) == ("cdr", 7, None, None)
    again = config.loads(yaml.safe_dump(config.describe(loads(text))), HERE)
    assert again.bridge.topics == [route]


def test_the_same_way_twice_is_a_mistake() -> None:
    route = "{ros: /a, to: mqtt}"
    found = problems(f"bridge:\n  topics:\n  - {route}\n  - {route}")
    assert found == ["4: bridge.topics[1].ros: is the same way as bridge.topics[0]"]
    found = problems("broker: {listeners: [{bind: ':1883'}, {bind: ':1883'}]}")
    assert found == ["1: broker.listeners[1].bind: broker.listeners[0] listens there already"]
    loads("broker: {listeners: [{bind: ':0'}, {bind: ':0'}]}")


def test_environment_variables() -> None:
    text = "robot: ${NAME}\nbroker: {limits: {inflight: '${N:-7}'}}"
    assert problems("robot: ${NAME}") == ["1: robot: the environment variable NAME is not set"]
    assert "must be a whole number" in problems(text, NAME="r2")[0]  # in quotes it stays text
    text = "robot: ${NAME:-c3po}\nbroker:\n  limits:\n    inflight: ${N:-7}"
    assert loads(text).robot == "c3po"
    assert loads(text).broker.limits.inflight == 7
    assert loads(text, NAME="r2", N="9").broker.limits.inflight == 9
    assert loads(text, NAME="").robot == "c3po"
    assert loads("broker: {users: '$${HOME}'}", HOME="/").broker.users.name == "${HOME}"


def test_secrets_are_masked_in_every_print() -> None:
    settings = loads(
        "broker: {plugins: {a.b.C: {password: hunter2, url: 'sql://me:hunter2@db/x', n: [1]}}}"
    )
    shown = config.describe(settings)["broker"]["plugins"]["a.b.C"]
    assert shown == {"password": config.MASK, "url": f"sql://me:{config.MASK}@db/x", "n": [1]}
    assert settings.broker.plugins["a.b.C"]["password"] == "hunter2"
    assert "hunter2" not in repr(settings)
    for plugin in (
        "{url: 'sql://me:hun/ter2@db/x'}",
        "{url: 'sql://me:hun@ter2@db/x'}",
        "{urls: ['sql://me:hunter2@db/x', 1]}",
        "{tokens: {alice: hunter2}, credentials: {user: me, value: [hunter2]}}",
    ):
        settings = loads(f"broker: {{plugins: {{my.token.Plugin: {plugin}, b.C: {{n: 1}}}}}}")
        said = str(config.describe(settings)["broker"]["plugins"])
        assert "ter2" not in said and config.MASK in said and "'b.C': {'n': 1}" in said
    settings = loads("broker: {plugins: {my.token.Plugin: {path: /a, n: 1}}}")
    assert config.describe(settings)["broker"]["plugins"] == settings.broker.plugins
    found = problems("broker: {listeners: [{bind: '${SECRET}'}]}", SECRET="hunter2")
    assert "hunter2" not in "".join(found)


def test_what_is_described_loads_again() -> None:
    settings = loads(
        "robot: r2\nbroker: {limits: {queue_bytes: 65 KiB, connect_timeout: 1500 ms}}\n"
        "bridge: {topics: [{ros: /a, to: mqtt, qos: 1, retain: true, rate: 0.5}]}"
    )
    again = loads(yaml.safe_dump(config.describe(settings)))
    assert again.model_dump() == settings.model_dump()


@given(st.integers(0, 1 << 50))
def test_sizes_are_written_as_they_are_read(size: int) -> None:
    assert config.parse_size(config.format_size(size)) == size


@given(st.integers(0, 10**12))
def test_durations_are_written_as_they_are_read(milliseconds: int) -> None:
    text = config.format_duration(milliseconds / 1000)
    assert config.parse_duration(text) == milliseconds / 1000


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("500 ms", 0.5), ("10s", 10), ("1.5 min", 90), ("2 h", 7200), ("7 d", 604800)],
)
def test_durations(text: str, seconds: float) -> None:
    assert config.parse_duration(text) == seconds


@pytest.mark.parametrize("text", ["", "10", "ms", "-1 s", "1e3 s", "1 S", "10 seconds", None, 10])
def test_what_is_no_duration(text: object) -> None:
    with pytest.raises(ValueError):
        config.parse_duration(text)


@pytest.mark.parametrize(
    ("text", "bind", "loopback"),
    [
        ("0.0.0.0:8883", Bind("0.0.0.0", 8883), False),
        ("127.0.0.1:0", Bind("127.0.0.1", 0), True),
        ("localhost:1883", Bind("localhost", 1883), True),
        ("[::1]:1883", Bind("::1", 1883), True),
        (":1883", Bind("", 1883), False),
        ("127.evil.example:1883", Bind("127.evil.example", 1883), False),
    ],
)
def test_binds(text: str, bind: Bind, loopback: bool) -> None:
    assert config.parse_bind(text) == bind
    assert bind.loopback is loopback
    assert str(bind) == text


@pytest.mark.parametrize("text", ["", "8883", 8883, "::1:8883", "a:b", "a:99999", "a b:1", "[a:1"])
def test_what_is_no_bind(text: object) -> None:
    with pytest.raises(ValueError):
        config.parse_bind(text)


def test_the_file_to_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(reading, "SEARCH_PATH", (Path("appliance.yaml"), tmp_path / "etc.yaml"))
    with pytest.raises(ConfigError, match="`appliance init` writes one"):
        config.load()
    with pytest.raises(ConfigError, match="no such file"):
        config.load(tmp_path / "other.yaml")
    (tmp_path / "etc.yaml").write_text("robot: etc")
    assert config.load().robot == "etc"
    (tmp_path / "appliance.yaml").write_text("robot: here")
    assert config.load().robot == "here"
    assert config.load().broker.users == tmp_path / "users.passwd"
    (tmp_path / "appliance.yaml").write_bytes(b"robot: \xff")
    with pytest.raises(ConfigError, match="not UTF-8"):
        config.load()


def test_a_pattern_names_many_topics() -> None:
    settings = loads("robot: r2\nbridge: {topics: [{ros: '/camera/**', to: mqtt}]}")
    route = settings.bridge.topics[0]
    assert route.is_pattern
    assert route.topic("r2") == "r2{ros}"

    assert any(
        "needs {ros} in it" in problem
        for problem in problems("bridge: {topics: [{ros: '/a/*', to: mqtt, mqtt: '{robot}/a'}]}")
    )
    assert any(
        "***" in problem for problem in problems("bridge: {topics: [{ros: /a/***, to: mqtt}]}")
    )


def test_lists_of_names_and_patterns() -> None:
    def route(ros: str, more: str = "") -> config.TopicRoute:
        return loads(f"bridge: {{topics: [{{ros: {ros}, to: both{more}}}]}}").bridge.topics[0]

    some = route("['/camera/**', '!/camera/raw']")
    assert some.ros == ("/camera/**", "!/camera/raw")
    assert some.is_pattern
    assert some.topic("r2") == "r2{ros}"
    assert route("[/odom]").ros == "/odom"
    assert route("'/**'", ", type: sensor_msgs/msg/*Image").type == "sensor_msgs/msg/*Image"
    twice = "bridge: {topics: [{ros: '/**', to: mqtt, type: a/msg/*}, "
    loads(twice + "{ros: '/**', to: mqtt, type: b/msg/*}]}")
    assert any("same way" in p for p in problems(twice + "{ros: '/**', to: mqtt, type: a/msg/*}]}"))
    for wrong, what in {
        "'!/a'": "to: has no meaning for what is left out",
        "['!/a', '!/b']": "to: has no meaning for what is left out",
        "[]": "must be a ROS name",
        "[/a, 7]": "ros[1]: must be a ROS name",
        "[/a, camera]": "ros[1]: must be a full ROS name",
        "['/a', '!/b c']": "ros[1]: is not a ROS name",
    }.items():
        assert any(what in p for p in problems(f"bridge: {{topics: [{{ros: {wrong}, to: mqtt}}]}}"))
    text = config.describe(loads("bridge: {topics: [{ros: ['/a/*', '!/a/b'], to: mqtt}]}"))
    assert config.loads(yaml.safe_dump(text), HERE).bridge.topics[0].ros == ("/a/*", "!/a/b")


def test_the_environment_overrides_the_robot(tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    for text in ("robot: r2d2\n", "", "robot: not valid\n"):
        found = config.loads(text, file, {"APPLIANCE_ROBOT": "r3d3"})
        assert found.robot == "r3d3"
    assert config.loads("robot: r2d2", file, {"APPLIANCE_ROBOT": ""}).robot == "r2d2"
    with pytest.raises(config.ConfigError, match="of APPLIANCE_ROBOT, 'a/b', must be one level"):
        config.loads("robot: r2d2", file, {"APPLIANCE_ROBOT": "a/b"})


def test_ros_arguments() -> None:
    text = 'bridge: {ros_arguments: [--ros-args, -r, "/a:=/b"]}'
    assert loads(text).bridge.ros_arguments == ["-r", "/a:=/b"]
    assert any("without --" in p for p in problems("bridge: {ros_arguments: [-r, 'a:=b', --]}"))


# TLS


def test_what_yaml_takes_for_something_else() -> None:
    text = """\
broker:
  tls: {client_certificates: off, min_version: 1.3}
  listeners:
    - {bind: ":1", tls: true}
    - {bind: ":2", tls: true, client_certificates: optional, protocol: websocket}
    - {bind: ":3", tls: true, protocol: websocket}
    - {bind: ":4", tls: true, protocol: web}
"""
    broker = loads(text).broker
    assert (broker.tls.client_certificates, broker.tls.min_version) == ("off", "1.3")
    asked = [broker.client_certificates(listener) for listener in broker.listeners]
    assert asked == ["off", "optional", "off", "off"]
    assert config.loads(yaml.safe_dump(config.describe(loads(text))), HERE).broker == broker


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{client_certificates: none}", "client_certificates: must be off, optional or required"),
        ("{client_certificates: on}", "client_certificates: must be off, optional or required"),
        ("{min_version: 1.1}", "min_version: must be 1.2 or 1.3"),
        ("{username_from: cn}", "username_from: must be none, subject or san"),
        (
            "{username_from: subject, client_certificates: off}",
            "username_from: needs a listener with tls: true that asks for client certificates",
        ),
    ],
)
def test_tls_that_cannot_be(text: str, problem: str) -> None:
    [found] = problems(f"broker:\n  tls: {text}\n")
    assert found.startswith(f"2: broker.tls.{problem}")


def test_what_is_called_can_be_named_or_described() -> None:
    bridge = loads(
        "robot: r2\nbridge:\n"
        "  services: [/reset, {ros: '/arm/**', type: 'std_srvs/srv/*'}, '!/arm/off']\n"
        "  actions: [{ros: /walk, keep_result: 1 min, cancel_on_disconnect: true}]\n"
        "  parameters: [/arm/*, '/**/use_*', '!/arm/key']\n"
        "  limits: {calls: 9, calls_per_user: 5, calls_per_client: 3, payload: 2 MiB, items: 500}"
    ).bridge
    assert [
        (r.ros, r.is_pattern, r.topic("r2")) for r in bridge.services if not r.is_exclusion
    ] == [
        ("/reset", False, "r2/reset"),
        ("/arm/**", True, "r2{ros}"),
    ]
    assert [r.is_exclusion for r in bridge.services] == [False, False, True]
    assert bridge.actions[0].keep_result == 60
    assert [(r.ros, r.is_pattern, r.is_exclusion) for r in bridge.parameters] == [
        ("/arm/*", False, False),
        ("/**/use_*", True, False),
        ("!/arm/key", False, True),
    ]
    assert bridge.limits == config.BridgeLimitsSection(
        calls=9, calls_per_user=5, calls_per_client=3, payload=2 << 20, items=500
    )


@pytest.mark.parametrize(
    ("section", "route", "problem"),
    [
        ("services", "reset", "ros: must be a full ROS name that begins with '/'"),
        ("services", "'!/a/'", "ros: is not a ROS name"),
        ("services", "{ros: /a, type: std_srvs/Trigger}", "type: must be package/srv/Type"),
        ("services", "{ros: /a, type: 'a/srv/*'}", "type: can be a pattern only when ros is one"),
        ("services", "{ros: /a, to: mqtt}", "type: is needed when to is mqtt"),
        ("services", "{ros: '/a/*', to: mqtt, type: a/srv/B}", "to: must be ros when ros is a"),
        ("services", "{ros: /a, on_error: {}}", "on_error: is for services that MQTT answers"),
        ("services", "{ros: '!/a', timeout: 1 s}", "timeout: has no meaning for what is left out"),
        ("services", "{ros: '/a/*', mqtt: 'x'}", "mqtt: needs {ros} in it"),
        ("services", "{ros: /a, timeout: 0 s}", "timeout: must be more than 0 ms"),
        ("services", "{ros: /a, on_error: {a: 2024-01-01}, to: mqtt}", "on_error: has a value"),
        ("actions", "{ros: /a, type: a/srv/B}", "type: must be package/action/Type"),
        ("actions", "{ros: /a, keep: 1 s}", "keep: unknown key"),
        ("parameters", "/a", "ros: must be a node's full name"),
        ("parameters", "/a/b c", "ros: must be a node's full name"),
        ("parameters", "{ros: '/*/b', mqtt: 'x'}", "mqtt: needs {node} in it"),
        ("parameters", "{ros: /a/b, mqtt: 'x{ros}'}", "mqtt: knows the placeholders {robot} and"),
    ],
)
def test_mistakes_in_what_is_called(section: str, route: str, problem: str) -> None:
    (found,) = problems(f"bridge:\n  {section}:\n  - {route}")
    assert found.startswith(f"3: bridge.{section}[0].{problem}"), found


def test_ros1_and_ros2_have_words_of_their_own() -> None:
    bridge = """\
bridge:
  bus: {bus}
  domain_id: 3
  use_sim_time: true
  topics:
  - {{ros: /a, to: mqtt, encoding: cdr}}
  - {{ros: /b, to: mqtt, encoding: ros1}}
  services: [{{ros: /c, encoding: cdr}}, {{ros: /d, encoding: ros1}}]
  actions: [{{ros: /e, encoding: ros1}}]
  parameters: [/e, "!/f", /g/*]
"""
    text = "must be {}: that is what ROS's own bytes are with bus: {}"
    assert problems(bridge.format(bus="ros1")) == [
        "3: bridge.domain_id: is for ROS 2 only; in ROS 1 it is ROS_MASTER_URI",
        "4: bridge.use_sim_time: is for ROS 2 only; in ROS 1 it is the parameter /use_sim_time",
        f"6: bridge.topics[0].encoding: {text.format('ros1', 'ros1')}",
        f"8: bridge.services[0].encoding: {text.format('ros1', 'ros1')}",
    ]
    found = problems(bridge.format(bus="ros2"))
    assert found[:3] == [
        f"7: bridge.topics[1].encoding: {text.format('cdr', 'ros2')}",
        f"8: bridge.services[1].encoding: {text.format('cdr', 'ros2')}",
        f"9: bridge.actions[0].encoding: {text.format('cdr', 'ros2')}",
    ]
    assert [line.partition(" must be")[0] for line in found[3:]] == [
        "10: bridge.parameters[0].ros:",
        "10: bridge.parameters[1].ros:",
    ]


def test_what_is_called_twice_is_told() -> None:
    assert problems("bridge: {actions: [/a, {ros: /a, timeout: 1 s}]}") == [
        "1: bridge.actions[1].ros: is the same as in bridge.actions[0]"
    ]


def test_what_would_be_called_at_one_topic_is_told() -> None:
    assert problems("bridge: {services: [{ros: /a, mqtt: x}, {ros: /b, mqtt: x}]}") == [
        "1: bridge.services[1].mqtt: is the topic of bridge.services[0]"
    ]
    assert problems("bridge: {parameters: [/a/b, /a/c, {ros: /c/b, mqtt: '{robot}/a/_param'}]}")


SECTIONS = {"topics": ", to: mqtt", "services": "", "actions": "", "parameters": ""}


@pytest.mark.parametrize("section", SECTIONS)
def test_all_routes_are_listed_in_the_same_words(section: str) -> None:
    more = SECTIONS[section]
    lists = loads(
        f"bridge:\n  {section}:\n"
        f"  - {{ros: /odom/x{more}}}\n"
        f"  - {{ros: ['/arm/**', /leg/x, '!/arm/off/x']{more}}}\n"
        "  - '!/arm/raw/*'\n"
        "  - ros: ['!/a/b', '!/a/c']\n"
    )
    first, many, *left_out = getattr(lists.bridge, section)
    assert first.names == ("/odom/x",) and not first.is_pattern and not first.is_exclusion
    assert many.names == ("/arm/**", "/leg/x", "!/arm/off/x") and many.is_pattern
    assert [one.names for one in left_out] == [("!/arm/raw/*",), ("!/a/b", "!/a/c")]
    assert all(one.is_exclusion and not one.is_pattern for one in left_out)
    again = config.loads(yaml.safe_dump(config.describe(lists)), HERE)
    assert [one.names for one in getattr(again.bridge, section)] == [
        one.names for one in getattr(lists.bridge, section)
    ]


@pytest.mark.parametrize("section", SECTIONS)
def test_mistakes_in_a_list_are_told_with_their_line(section: str) -> None:
    more = SECTIONS[section].replace(", ", "\n    ")
    found = problems(
        f"bridge:\n  {section}:\n  - ros:\n    - /arm/**\n    - '!/arm off/x'{more}\n"
        "  - '!/a/b'\n  - leg\n"
    )
    assert len(found) == 2, found
    assert found[0].startswith(f"5: bridge.{section}[0].ros[1]: is not a ROS name"), found
    line = 7 + bool(more)
    assert found[1].startswith(f"{line}: bridge.{section}[2].ros: must be a"), found
    (found_here,) = problems(f"bridge:\n  {section}: ['!/a/b']")
    assert found_here == (
        f"2: bridge.{section}[0].ros: leaves nothing out: there is no pattern in bridge.{section}"
    )


def test_what_is_said_beside_names() -> None:
    assert problems("bridge: {topics: [/odom]}") == ["1: bridge.topics[0].to: is needed"]
    short = loads("bridge: {services: [[/a, /b]], parameters: [[/a/x, '/b/*', '!/b/y']]}").bridge
    assert short.services[0].names == ("/a", "/b") and short.services[0].topic("r") == "r{ros}"
    assert short.parameters[0].is_pattern
    assert problems("bridge: {actions: [/a, [/b, /a]]}") == [
        "1: bridge.actions[1].ros[1]: is the same as in bridge.actions[0]"
    ]
    (found,) = problems("bridge: {services: [{ros: [/a, /b], to: mqtt, type: a/srv/B}]}")
    assert "to: must be ros when ros is a pattern or a list" in found


@pytest.mark.parametrize(
    ("one", "other", "collide"),
    [
        ("127.0.0.1:1883", "127.0.0.1:1883", True),
        ("127.0.0.1:1883", "0.0.0.0:1883", True),
        ("[::]:1883", "[::1]:1883", True),
        (":1883", "127.0.0.1:1883", True),
        (":1883", "[::1]:1883", True),
        ("0.0.0.0:1883", "[::]:1883", False),
        ("0.0.0.0:1883", "[::1]:1883", False),
        ("127.0.0.1:1883", "127.0.0.2:1883", False),
        ("0.0.0.0:1883", "127.0.0.1:8883", False),
        (":0", "127.0.0.1:0", False),
        ("unix:/a", ":1883", False),
    ],
)
def test_listeners_that_keep_each_other_out(one: str, other: str, collide: bool) -> None:
    for binds in ((one, other), (other, one)):
        text = "".join(f"{{bind: '{bind}'}}, " for bind in binds)
        text = f"broker: {{listeners: [{text}]}}"
        if collide:
            assert "listens there already" in problems(text)[0]
        else:
            loads(text)


def test_what_is_no_file_or_too_large_for_one(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("folder.yaml", "pipe.yaml"):
        with pytest.raises(ConfigError, match=rf"{name}: is not a file"):
            config.load(tmp_path / name)
    with (tmp_path / "huge.yaml").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ConfigError, match=r"huge\.yaml: longer than 1 Mi characters"):
        config.load(tmp_path / "huge.yaml")


def test_a_file_that_may_not_be_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as that of the service, for most users of the robot."""

    def is_file(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "is_file", is_file)
    with pytest.raises(ConfigError, match="run this as the appliance's user, or as root"):
        config.load(tmp_path / "appliance.yaml")


def test_the_limits_of_a_user_reach_the_broker() -> None:
    assert loads("robot: r2").broker.limits.of_broker().user == UserLimits()
    text = "robot: r2\nbroker: {limits: {user: {connections: 7, memory: 3 MiB, stored: 0 B}}}"
    settings = loads(text)
    assert settings.broker.limits.of_broker().user == UserLimits(
        connections=7, memory=3 << 20, stored=0
    )
    assert loads(yaml.safe_dump(config.describe(settings))).model_dump() == settings.model_dump()
    with pytest.raises(ConfigError, match=r"broker\.limits\.user\.sessions.*at least 1"):
        loads("robot: r2\nbroker: {limits: {user: {sessions: 0}}}")


def test_every_limit_has_a_part_that_enforces_it() -> None:
    """A key that is added to the file alone would have no effect."""
    taken = {field.name for kind in (Limits, Admission) for field in dataclasses.fields(kind)}
    # The login throttle takes this one.
    assert set(LimitsSection.model_fields) == taken | {"failed_logins"}
    assert set(UserLimitsSection.model_fields) == {f.name for f in dataclasses.fields(UserLimits)}
