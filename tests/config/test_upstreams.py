"""`upstreams` in appliance.yaml: defaults, what cannot be and what to do, and secrets."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from test_config import HERE, example_of_the_reference, loads, problems

from appliance import config
from appliance.config import ProxyUrl, ServerUrl, UpstreamSection
from appliance.config.settings import (
    BacklogSection,
    InSection,
    OutSection,
    UpstreamLoginSection,
    UpstreamTlsSection,
)
from appliance.config.urls import parse_server

ACME = "manufacturer: acme"
VDA5050 = f"profile: {{vda5050: {{{ACME}}}}}"


def link(text: str = "", **environment: str) -> UpstreamSection:
    """The link with these keys beside a name and a server."""
    return loads(f"upstreams: [{{{_with(text)}}}]", **environment).upstreams[0]


def _with(text: str) -> str:
    return ", ".join(filter(None, ["name: fleet", "servers: [mqtts://a]", text]))


def wrong(text: str, **environment: str) -> str:
    """The one problem of a link with these keys."""
    (problem,) = problems(f"upstreams: [{{{_with(text)}}}]", **environment)
    assert problem.startswith("1: upstreams[0].")
    return problem.removeprefix("1: upstreams[0].")


def test_what_a_link_is_that_says_nothing_else() -> None:
    found = link()
    assert found.servers == [ServerUrl("mqtts", "a", 8883)]
    assert (found.kind, found.version, found.client_id, found.user, found.prefix) == (
        "generic",
        "5",
        "{robot}",
        "upstream",
        "fleet/{robot}/",
    )
    assert (found.keep_alive, found.window, found.rate, found.bytes_per_second) == (
        30.0,
        1000,
        None,
        None,
    )
    assert found.backlog == BacklogSection(size=256 << 20, age=None, when_full="drop-oldest")
    assert (found.out, found.inward, found.proxy) == ([], [], None)


def test_the_example_of_the_reference_has_every_key_with_its_default() -> None:
    example = example_of_the_reference()
    (found,) = config.loads(example, HERE).upstreams
    assert found.model_fields_set == {*UpstreamSection.model_fields}
    fleet = link()
    for name in UpstreamSection.model_fields.keys() - {"servers", "out", "inward"}:
        assert getattr(found, name) == getattr(fleet, name), name
    for section, model in (
        (found.login, UpstreamLoginSection),
        (found.tls, UpstreamTlsSection),
        (found.backlog, BacklogSection),
    ):
        assert section.model_fields_set == {*model.model_fields}
    (out,) = found.out
    assert out.model_fields_set == {*OutSection.model_fields}
    assert out == OutSection(topic=out.topic)
    assert [(rule.topic, rule.late, rule.offline) for rule in found.inward] == [
        ("cmd_vel", 0.5, "drop"),
        ("mission/#", None, "keep"),
    ]
    assert set().union(*(r.model_fields_set for r in found.inward)) == {*InSection.model_fields}


def test_what_is_described_loads_again() -> None:
    described = config.describe(config.loads(example_of_the_reference(), HERE))
    assert described["upstreams"][0]["in"][0]["late"] == "500 ms"
    again = config.loads(yaml.safe_dump(described), HERE)
    assert config.describe(again) == described


@pytest.mark.parametrize(
    ("url", "server", "text"),
    [
        ("mqtt://h", ServerUrl("mqtt", "h", 1883), "mqtt://h:1883"),
        ("MQTTS://Broker.Example:1/", ServerUrl("mqtts", "broker.example", 1), ""),
        ("ws://h", ServerUrl("ws", "h", 80, "/mqtt"), "ws://h:80/mqtt"),
        ("wss://h:8443/", ServerUrl("wss", "h", 8443, "/"), "wss://h:8443/"),
        ("mqtts://[::1]:8883", ServerUrl("mqtts", "::1", 8883), "mqtts://[::1]:8883"),
    ],
)
def test_servers(url: str, server: ServerUrl, text: str) -> None:
    assert parse_server(url) == server
    assert parse_server(str(server)) == server
    assert not text or str(server) == text
    assert server.tls is (server.scheme in ("mqtts", "wss"))
    assert server.websocket is (server.scheme in ("ws", "wss"))


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("broker.example", "must be a URL such as mqtts://broker.example:8883"),
        ("", "must be a URL"),
        ("mqtts://", "must be a URL"),
        ("mqtts://:8883", "must be a URL"),
        ("mqtts://a:b", "must be a URL"),
        ("mqtts://a:0", "must be a URL"),
        ("mqtts://a:70000", "must be a URL"),
        ("mqtts://[::1", "must be a URL"),
        ("mqtts://a b", "must not have spaces"),
        ("mqtts://a\n.example", "must not have spaces"),
        ("ssl://a", "knows mqtt, mqtts, ws or wss, not 'ssl'; did you mean 'mqtts'?"),
        ("ftp://a", "not 'ftp'"),
        ("mqtts://alice:hunter2@a", "must not have a user in it"),
        ("mqtts://a/mqtt", "has a path, /mqtt, which only ws and wss have"),
        ("wss://a/mqtt?x=1", "without '?' and '#'"),
    ],
)
def test_what_is_no_server(url: str, problem: str) -> None:
    with pytest.raises(ValueError) as raised:
        parse_server(url)
    assert problem in str(raised.value)
    assert "hunter2" not in str(raised.value)


@pytest.mark.parametrize(
    ("url", "proxy"),
    [
        ("http://proxy", ProxyUrl("proxy", 3128)),
        ("http://proxy:80/", ProxyUrl("proxy", 80)),
        ("http://me@proxy:80", ProxyUrl("proxy", 80, "me")),
        ("http://me:hun%3Ater@p@proxy", ProxyUrl("proxy", 3128, "me", "hun:ter@p")),
    ],
)
def test_proxies(url: str, proxy: ProxyUrl) -> None:
    assert config.parse_proxy(url) == proxy
    assert "hun" not in repr(proxy)


@pytest.mark.parametrize(
    "url", ["proxy:3128", "https://proxy", "socks5://proxy", "http://", "http://p/x", "http://p?x"]
)
def test_what_is_no_proxy(url: str) -> None:
    assert wrong(f"proxy: '{url}'").startswith("proxy: must ")


def test_the_password_of_a_proxy_is_never_shown(tmp_path: Path) -> None:
    text = "proxy: 'http://me:${PW}@proxy:3128'"
    settings = loads(f"upstreams: [{{{_with(text)}}}]", PW="hunter2")
    assert settings.upstreams[0].proxy == "http://me:hunter2@proxy:3128"
    assert "hunter2" not in str(config.describe(settings)) and config.MASK in str(
        config.describe(settings)
    )
    assert "hunter2" not in repr(settings)
    assert [*config.secrets_of(settings)] == ["hunter2"]
    assert "hunter2" not in wrong("proxy: 'https://me:${PW}@proxy'", PW="hunter2")
    assert "hunter2" not in wrong("proxy: 'https://me:hunter2@proxy'")
    file = tmp_path / "appliance.yaml"
    file.write_text(f"upstreams: [{{{_with(text.replace('${PW}', 'hunter2'))}}}]")
    file.chmod(0o644)
    assert config.is_open_with_secrets(config.load(file))
    file.chmod(0o640)
    assert not config.is_open_with_secrets(config.load(file))


def test_files_with_secrets_are_named_and_no_secrets() -> None:
    found = loads(f"upstreams: [{{{_with('login: {token_file: t}')}}}]")
    login = config.describe(found)["upstreams"][0]["login"]
    assert login["token_file"] == str(HERE.parent / "t")


@pytest.mark.parametrize(
    ("text", "version"),
    [("5", "5"), ("5.0", "5"), ("'5'", "5"), ("3.1.1", "3.1.1"), ("'3.1.1'", "3.1.1")],
)
def test_versions(text: str, version: str) -> None:
    assert link(f"version: {text}").version == version


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("version: 4", "version: must be 5 or 3.1.1"),
        ("version: true", "version: must be 5 or 3.1.1"),
        ("kind: aws", "kind: must be generic, aws-iot, azure-event-grid or rabbitmq; did you"),
        ("client_id: ''", "client_id: must not be empty"),
        ("client_id: '{host}'", "client_id: knows the placeholder {robot} only"),
        ("user: ''", "user: must not be empty"),
        ("prefix: fleet", "prefix: must be the beginning of MQTT topics that ends with '/'"),
        ("prefix: /", "prefix: must be the beginning"),
        ("prefix: 'fleet/+/'", "prefix: must be the beginning of MQTT topics, without '+'"),
        ("prefix: $SYS/", "prefix: must not begin with '$'"),
        ("prefix: $aws/things/", "prefix: must not begin with '$'"),
        ("keep_alive: 500 ms", "keep_alive: must be at least 1 s"),
        ("keep_alive: 0 s", "keep_alive: must be at least 1 s"),
        ("window: 0", "window: must be at least 1"),
        ("window: 65536", "window: must be at most 65535"),
        ("rate: 0", "rate: must be more than 0"),
        ("rate: .inf", "rate: "),
        ("bytes_per_second: 0 B", "bytes_per_second: must be more than 0"),
        ("backlog: {size: 1 KiB}", "backlog.size: must be at least 1 MiB"),
        ("backlog: {age: 0 s}", "backlog.age: must be more than 0"),
        ("backlog: {when_full: drop}", "backlog.when_full: must be drop-oldest or refuse"),
        ("login: {password: hunter2}", "login.password: unknown key; did you mean 'password_file'"),
        ("login: {password_file: a, token_file: b}", "login.token_file: is sent as the password"),
        ("login: {method: X}", "login.method: needs token_file"),
        ("version: 3.1.1, login: {token_file: a}", "login.token_file: needs username"),
        ("version: 3.1.1, login: {username: a, method: X, token_file: a}", "login.method: is of"),
        ("login: {username: '{user}'}", "login.username: knows the placeholder {robot} only"),
        ("tls: {certificate: a}", "tls.certificate: needs key beside it"),
        ("tls: {key: a}", "tls.key: needs certificate beside it"),
        ("tls: {alpn: ['']}", "tls.alpn[0]: must not be empty"),
        ("int: []", "int: unknown key; did you mean 'in'?"),
        ("in: {}", "in: must be a list"),
        ("out: [{}]", "out[0].topic: is needed"),
        ("out: [{topic: 'a#'}]", "out[0].topic: makes no topic filter here, 'robot/a#'"),
        ("in: [{topic: 'a', remote_prefix: ''}, {topic: '', remote_prefix: ''}]", "in[1].topic:"),
        ("out: [{topic: /odom}]", "out[0].topic: must not begin with '/' behind {robot}/; did you"),
        ("out: [{topic: '{robot}/odom'}]", "out[0].topic: knows no placeholders"),
        ("out: [{topic: a, local_prefix: '#'}]", "out[0].local_prefix: must be the beginning"),
        ("out: [{topic: a, keep: newest}]", "out[0].keep: must be auto, all, latest or none"),
        ("out: [{topic: a, priority: urgent}]", "out[0].priority: must be high, normal or low"),
        ("out: [{topic: a, rate: -1}]", "out[0].rate: must be more than 0"),
        ("out: [{topic: a}, {topic: a}]", "out[1].topic: is the same as in out[0]"),
        ("out: [{topic: a, remote_prefix: $x/}]", "out[0].remote_prefix: must not begin with '$'"),
        ("out: [{topic: b, local_prefix: $share/a/}]", "out[0].topic: makes a shared subscription"),
        ("in: [{topic: 'x', local_prefix: '$SYS/'}]", "in[0].topic: must not begin with '$' here"),
        ("in: [{topic: a, late: 5}]", "in[0].late: must be a duration"),
        ("in: [{topic: a, late: 5 s, offline: keep}]", "in[0].late: is not for offline: keep"),
        ("in: [{topic: a, offline: queue}]", "in[0].offline: must be drop or keep"),
        ("in: [{topic: a, retained: keep}]", "in[0].retained: must be take or drop"),
        ("out: [{topic: a, qos: 2}]", "out[0].qos: must be at most 1"),
        ("profile: opc", "profile: must be vda5050, the only profile"),
        ("profile: []", "profile: must be keys with values, such as `profile: {vda5050: {manu"),
        ("profile: vda5050", "profile.vda5050.manufacturer: is needed"),
        ("profile: {vda5050: {manufacturer: a/b}}", "profile.vda5050.manufacturer: must be one"),
        ("profile: {vda5050: {manufacturer: ''}}", "profile.vda5050.manufacturer: must be one"),
        (f"profile: {{vda5050: {{{ACME}, interface_name: $x}}}}", "profile.vda5050.interface_name"),
        (f"profile: {{vda5050: {{{ACME}, version: 1.1}}}}", "profile.vda5050.version: must be a"),
        (f"profile: {{vda5050: {{{ACME}, serial_number: a b}}}}", "profile.vda5050.serial_number:"),
        (f"{VDA5050}, in: [{{topic: order}}]", "in[0].topic: is the same as in profile"),
        (f"{VDA5050}, out: [{{topic: 'a#'}}]", "out[0].topic: makes no topic filter here"),
        (f"{VDA5050}, prefix: $x/", "prefix: must not begin with '$'"),
        (
            f"version: 3.1.1, {VDA5050}, in: [{{topic: state}}]",
            "in[0].topic: overlaps profile at the fleet's broker (uagv/v2/acme/robot/state",
        ),
    ],
)
def test_what_cannot_be(text: str, problem: str) -> None:
    assert wrong(text).startswith(problem)


def test_a_profile_is_a_prefix_and_rules() -> None:
    found = link(VDA5050)
    assert found.prefix == "uagv/v2/acme/{robot}/"
    assert [rule.topic for rule in found.out] == ["state", "factsheet", "visualization"]
    assert [rule.topic for rule in found.inward] == ["order", "instantActions"]
    assert {rule.local_prefix for rule in (*found.out, *found.inward)} == {"{robot}/vda5050/"}
    newer = link(f"profile: {{vda5050: {{{ACME}, version: 3.0, serial_number: '7'}}}}")
    assert newer.prefix == "vda5050/v3/acme/7/"
    assert [rule.topic for rule in newer.inward[2:]] == ["zoneSet", "responses"]
    named = link(f"profile: {{vda5050: {{{ACME}, interface_name: fts, local_prefix: agv/}}}}")
    assert named.prefix == "fts/v2/acme/{robot}/" and named.out[0].local_prefix == "agv/"


def test_what_the_file_says_goes_before_a_profile() -> None:
    mine = "{topic: state, local_prefix: '{robot}/vda5050/', qos: 1}"
    found = link(f"{VDA5050}, prefix: cloud/, out: [{{topic: '#'}}, {mine}], in: [{{topic: x}}]")
    assert found.prefix == "cloud/"
    # A filter with wildcards does not take the topics of the profile.
    said = [(rule.topic, rule.is_added) for rule in (*found.out, *found.inward)]
    assert said == [
        ("factsheet", True),
        ("visualization", True),
        ("#", False),
        ("state", False),
        ("order", True),
        ("instantActions", True),
        ("x", False),
    ]
    described = config.describe(loads(f"upstreams: [{{{_with(VDA5050)}}}]"))
    assert config.describe(config.loads(yaml.safe_dump(described), HERE)) == described


def test_names_and_servers() -> None:
    assert problems("upstreams: [{}]") == [
        "1: upstreams[0].name: is needed",
        "1: upstreams[0].servers: is needed",
    ]
    one = "{name: a, servers: [mqtt://x]}"
    assert problems(f"upstreams:\n- {one}\n- {one}") == [
        "3: upstreams[1].name: is the name of upstreams[0]"
    ]
    assert "must have at least 1" in problems("upstreams: [{name: a, servers: []}]")[0]
    assert "one level" in problems("upstreams: [{name: a/b, servers: [mqtt://a]}]")[0]


def test_topics_of_the_server_are_for_aws_only() -> None:
    assert link("kind: aws-iot, prefix: '$aws/things/{robot}/', out: [{topic: a}]")
    assert link("kind: aws-iot, out: [{topic: a, remote_prefix: $aws/x/}]")
    assert link("out: [{topic: '$SYS/#', local_prefix: ''}]")  # there: fleet/{robot}/$SYS/…
    told = wrong("out: [{topic: '$SYS/#', local_prefix: '', remote_prefix: ''}]")
    assert told.startswith("out[0].remote_prefix: must not begin with '$'")


def test_with_3_1_1_no_rules_may_overlap_there() -> None:
    rules = "out: [{topic: '#'}, {topic: b}], in: [{topic: cmd}, {topic: 'c/#', remote_prefix: d/}]"
    assert link(rules)
    told = wrong(f"version: 3.1.1, {rules}")
    assert told.startswith("in[0].topic: overlaps out[0] at the fleet's broker (fleet/robot/cmd")
    assert link("version: 3.1.1, out: [{topic: 'a/#'}], in: [{topic: 'b/#'}]")
    # The same topics here are not the same there.
    assert link("version: 3.1.1, out: [{topic: a}], in: [{topic: a, remote_prefix: x/}]")
