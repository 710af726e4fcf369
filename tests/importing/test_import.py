"""`appliance import`: what it makes of mosquitto's options, and what it says of the others."""

from __future__ import annotations

import gzip
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import run

from appliance import config
from appliance.access import Acl, Passwords
from appliance.broker.values import Action, Identity
from appliance.config.quantities import parse_size
from appliance.importing import Imported, ImportProblemsError, import_mosquitto
from appliance.importing.options import OPTIONS
from appliance.ops.check import check
from importing.mosquitto_files import SHAPES, write

MANUAL = Path("/usr/share/man/man5/mosquitto.conf.5.gz")
EXAMPLE = Path("/usr/share/doc/mosquitto/examples/mosquitto.conf")
OLD = "$7$101$" + "B" * 16 + "$" + "B" * 86 + "=="
HASH = "$7$101$" + "A" * 16 + "$" + "A" * 86 + "=="
MAIN = "mosquitto.conf"


def convert(directory: Path, text: str, **files: str) -> Imported:
    for name, content in files.items():
        (directory / name).write_text(content)
    (directory / MAIN).write_text(text)
    return import_mosquitto(directory / MAIN, "r2d2")


def file(imported: Imported, name: str) -> str:
    return next(each.text for each in imported.files if each.name == name)


def settings(imported: Imported) -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load(file(imported, "appliance.yaml"))
    return loaded


def told(imported: Imported) -> str:
    return "\n".join(map(str, imported.notes))


def acl(imported: Imported, directory: Path) -> Acl:
    (directory / "acl.conf").write_text(file(imported, "acl.conf"))
    return Acl.load(directory / "acl.conf", "r2d2")


def may(rules: Acl, user: str | None, action: Action, topic: str) -> bool:
    return rules.decide(Identity(user, "c"), action, topic).allowed


# The table of options


@pytest.mark.skipif(not MANUAL.exists(), reason="there is no manual of mosquitto")
def test_no_option_of_the_manual_is_missing() -> None:
    page = gzip.decompress(MANUAL.read_bytes()).decode()
    page = page[page.index("GENERAL OPTIONS") :]
    named = re.findall(r"^\\fB([a-z_][\w.&\\]*)\\fR (?:\\fI|\[)", page, re.M)
    options = {name.replace("\\&", "") for name in named}
    assert len(options) > 100
    assert {"listener", "ciphers_tls1.3", "topic", "bridge_psk", "user"} <= options
    assert options - OPTIONS.keys() - {"auth_opt_"} == set()


@pytest.mark.skipif(not EXAMPLE.exists(), reason="there is no example of mosquitto")
def test_no_option_of_the_example_is_missing() -> None:
    lines = EXAMPLE.read_text().splitlines()
    options = {match[1] for line in lines if (match := re.match(r"#([a-z_0-9.]+)( |$)", line))}
    assert len(options) > 70
    assert options - OPTIONS.keys() == set()


def test_every_option_says_something() -> None:
    for name, option in OPTIONS.items():
        assert option.text, name
        assert option.fate == "none" or not option.same, name


# Listeners


@pytest.mark.parametrize(
    ("text", "bind"),
    [
        ("listener 1883", ":1883"),
        ("listener 1883 10.0.0.1", "10.0.0.1:1883"),
        ("listener 1883 ::1 # here", "[::1]:1883"),
        ("listener 1883\nsocket_domain ipv4", "0.0.0.0:1883"),
        ("listener 1883\nsocket_domain ipv6", "[::]:1883"),
        ("listener 1883\nbind_interface eth0", "127.0.0.1:1883"),
        ("listener 0 /run/m.sock", "unix:/run/m.sock"),
        ("port 1884", ":1884"),
        ("port 1884\nbind_address localhost", "localhost:1884"),
        ("bind_address 10.0.0.1", "10.0.0.1:1883"),
        ("allow_anonymous false", "127.0.0.1:1883"),
        ("", "127.0.0.1:1883"),
    ],
)
def test_a_listener_has_its_address(tmp_path: Path, text: str, bind: str) -> None:
    assert settings(convert(tmp_path, text))["broker"]["listeners"][0]["bind"] == bind


def test_tls_of_a_listener(tmp_path: Path) -> None:
    files = dict.fromkeys(("ca.crt", "server.crt", "server.key", "ca.crl"), "x")
    text = (
        "listener 8883\ncafile /etc/mosquitto/ca.crt\ncertfile server.crt\nkeyfile server.key\n"
        "crlfile ca.crl\nrequire_certificate true\nuse_identity_as_username true\n"
        "tls_version tlsv1.3\nciphers ECDHE\nlistener 8884\ncertfile other.crt\n"
        "keyfile server.key\ntls_version tlsv1.1\n"
    )
    found = convert(tmp_path, text, **files)
    broker = settings(found)["broker"]
    assert broker["listeners"] == [
        {
            "bind": ":8883",
            "tls": True,
            "client_certificates": "required",
            "min_version": "1.3",
            "ciphers": "ECDHE",
        },
        {"bind": ":8884", "tls": True, "client_certificates": "off"},
    ]
    assert broker["tls"] == {
        "certificate": str(tmp_path / "server.crt"),
        "key": str(tmp_path / "server.key"),
        "ca": str(tmp_path / "ca.crt"),
        "crl": str(tmp_path / "ca.crl"),
        "username_from": "subject",
    }
    assert "mosquitto.conf:11: certfile: broker.tls.certificate is one for all" in told(found)
    assert "mosquitto.conf:13: tls_version: TLS before 1.2 is broken" in told(found)


def test_certificates_are_required_and_nobody_says_whose(tmp_path: Path) -> None:
    text = "listener 8883\ncapath .\ncertfile a\nkeyfile b\nrequire_certificate true\n"
    found = convert(tmp_path, text, a="x", b="x")
    said = [str(note) for note in found.notes if note.to_do]
    assert "listener 8883 requires certificates, and no file says whose" in said[0]


def test_names_are_checked_where_mosquitto_takes_any(tmp_path: Path) -> None:
    text = (
        "per_listener_settings true\nlistener 1883\npassword_file pw\n"
        "listener 1884\nallow_anonymous true\n"
    )
    found = convert(tmp_path, f"{text}acl_file acl\n", pw=f"alice:{HASH}\n", acl="topic a\n")
    said = "mosquitto.conf:5: allow_anonymous: who gives a user name is checked here"
    assert said in told(found)
    assert settings(found)["broker"]["listeners"][1] == {"bind": ":1884", "anonymous": True}
    everywhere = text.replace("per_listener_settings true\n", "")
    assert "is checked here" not in told(convert(tmp_path, everywhere, pw=""))


def test_without_a_listener_mosquitto_lets_in_everybody(tmp_path: Path) -> None:
    found = convert(tmp_path, "allow_anonymous false\npassword_file pw\n", pw=f"alice:{HASH}\n")
    assert "mosquitto.conf:1: allow_anonymous: counts here" in told(found)
    assert "anonymous" not in str(settings(found))
    assert "counts here" not in told(convert(tmp_path, "allow_anonymous false\nlistener 1\n"))


def test_without_rules_any_name_is_taken(tmp_path: Path) -> None:
    """As in mosquitto, where it makes no difference who somebody is."""
    text = (
        "per_listener_settings true\nlistener 1883\npassword_file pw\n"
        "listener 1884\nallow_anonymous true\n"
    )
    found = convert(tmp_path, text, pw=f"alice:{HASH}\n")
    listeners = settings(found)["broker"]["listeners"]
    assert listeners == [{"bind": ":1883"}, {"bind": ":1884", "anonymous": "always"}]
    assert "is checked here" not in told(found)
    only = settings(convert(tmp_path, "listener 1883\nallow_anonymous true\n"))["broker"]
    assert only["listeners"] == [{"bind": ":1883", "anonymous": "always"}]
    plugin = "listener 1883\nallow_anonymous true\nplugin /x.so\n"
    assert "always" not in str(settings(convert(tmp_path, plugin)))


@pytest.mark.parametrize(
    "line",
    [
        "psk_hint x",
        "mount_point x/",
        "enable_proxy_protocol 2",
        "use_subject_as_username true",
        "use_username_as_clientid true",
    ],
)
def test_a_listener_that_keeps_clients_apart_is_left_out(tmp_path: Path, line: str) -> None:
    found = convert(tmp_path, f"listener 1883\nlistener 1884\n{line}\n")
    assert settings(found)["broker"]["listeners"] == [{"bind": ":1883"}]
    assert "the listener is left out" in told(found)
    with pytest.raises(ImportProblemsError, match="no listener can be carried over"):
        convert(tmp_path, f"listener 1884\n{line}\n")


def test_an_option_before_all_listeners_is_told(tmp_path: Path) -> None:
    found = convert(tmp_path, "max_connections 5\nlistener 1883\n")
    assert "mosquitto.conf:1: max_connections: is before any `listener`" in told(found)
    assert "limits" not in settings(found)["broker"]


def test_what_a_listener_restricts(tmp_path: Path) -> None:
    text = (
        "retain_available false\nclientid_prefixes arm-\nmessage_size_limit 1024\n"
        "listener 1883\nmax_qos 1\naccept_protocol_versions 5, 4\n"
        "listener 1884\nmaximum_qos 2\naccept_protocol_versions 3,4,5\n"
    )
    found = convert(tmp_path, text)
    everywhere = {"retain": False, "client_id_prefixes": ["arm-"]}
    versions = {"protocol_versions": ["3.1.1", "5"]}
    assert settings(found)["broker"]["listeners"] == [
        {"bind": ":1883", "max_qos": 1, **everywhere, **versions},
        {"bind": ":1884", **everywhere},
    ]
    assert settings(found)["broker"]["limits"] == {"payload_size": "1 KiB"}
    loaded = config.loads(file(found, "appliance.yaml"), tmp_path / "appliance.yaml")
    assert loaded.broker.listeners[0].terms().versions == {4, 5}


def test_a_large_payload_finds_room_in_a_packet(tmp_path: Path) -> None:
    limits = settings(convert(tmp_path, f"listener 1\nmessage_size_limit {20 << 20}\n"))["broker"]
    assert limits["limits"]["payload_size"] == "20 MiB"
    assert parse_size(limits["limits"]["packet_size"]) > 20 << 20


# Who may do what


def test_users_are_carried_over_or_named(tmp_path: Path) -> None:
    text = f"# ours\nalice:{OLD}\nbob:secret word\ncarol\nalice:{HASH}\n ops:{HASH}\n"
    found = convert(tmp_path, "listener 1883\npassword_file pw\n", pw=text)
    assert file(found, "users.passwd") == f"alice:{HASH}\n"
    (tmp_path / "users").write_text(file(found, "users.passwd"))
    assert Passwords.load(tmp_path / "users").users() == ["alice"]
    assert "pw:3: user 'bob': needs a new password (a plain password" in told(found)
    assert "appliance user add carol" in told(found)
    assert "pw:5: user 'alice': is there twice" in told(found)
    assert "pw:6: a user: left out" in told(found)
    assert "secret word" not in told(found)
    assert {each.name for each in found.files if each.is_secret} == {"users.passwd"}


def test_rules_are_carried_over(tmp_path: Path) -> None:
    text = "topic read public/#\nuser alice\ntopic a/#\npattern write dev/%u/#\n"
    found = convert(tmp_path, "listener 1883\nacl_file x.acl\n", **{"x.acl": text})
    assert file(found, "acl.conf") == text


def test_without_rules_everything_is_allowed_but_management(tmp_path: Path) -> None:
    rules = acl(convert(tmp_path, "listener 1883\nallow_anonymous true\n"), tmp_path)
    for user in (None, "alice"):
        assert may(rules, user, Action.PUBLISH, "a/b")
        assert may(rules, user, Action.RECEIVE, "$SYS/broker/uptime")
        assert not may(rules, user, Action.PUBLISH, "$SYS/broker/uptime")
        assert not may(rules, user, Action.PUBLISH, "$CONTROL/appliance/v1/users/_call")


@pytest.mark.parametrize("line", ["acl_file none.acl", "plugin /x.so", "auth_plugin /x.so"])
def test_what_is_unknown_allows_nothing(tmp_path: Path, line: str) -> None:
    found = convert(tmp_path, f"listener 1883\n{line}\nallow_anonymous true\n")
    assert not may(acl(found, tmp_path), "alice", Action.PUBLISH, "a")
    assert [note for note in found.notes if note.to_do]


def test_a_wrong_acl_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ImportProblemsError, match=r"x\.acl:2: .*tpoic"):
        convert(tmp_path, "acl_file x.acl\n", **{"x.acl": "topic a\ntpoic b\n"})


def test_anonymous_in_general_and_of_a_listener(tmp_path: Path) -> None:
    text = "allow_anonymous true\nlistener 1883\nlistener 1884\nlistener_allow_anonymous false\n"
    broker = settings(convert(tmp_path, text))["broker"]
    assert broker["anonymous"] is True
    assert broker["listeners"] == [
        {"bind": ":1883", "anonymous": "always"},
        {"bind": ":1884", "anonymous": False},
    ]


def test_anonymous_of_a_listener_without_rules(tmp_path: Path) -> None:
    text = (
        "per_listener_settings true\nlistener 1883\nallow_anonymous true\n"
        "listener 1884\nallow_anonymous false\npassword_file pw\nacl_file acl\n"
    )
    rules = "topic read only/this\nuser alice\ntopic read a\n"
    found = convert(tmp_path, text, pw=f"alice:{HASH}\n", acl=rules)
    assert settings(found)["broker"]["listeners"][0]["anonymous"] == "always"
    decided = acl(found, tmp_path)
    assert may(decided, None, Action.PUBLISH, "b")
    assert not may(decided, "alice", Action.PUBLISH, "b")
    assert may(decided, "alice", Action.RECEIVE, "a")
    assert "only/this" not in file(found, "acl.conf")


def test_listeners_with_other_rules_let_nobody_in_by_mistake(tmp_path: Path) -> None:
    text = (
        "per_listener_settings true\nlistener 1883\nacl_file one\npassword_file pw\n"
        "listener 1884\nallow_anonymous true\nacl_file two\npassword_file other\n"
    )
    found = convert(
        tmp_path, text, one="topic #\n", two="topic read a\n", pw="", other=f"eve:{HASH}\n"
    )
    assert [each["bind"] for each in settings(found)["broker"]["listeners"]] == [":1883"]
    assert "eve" not in file(found, "users.passwd")
    assert "mosquitto.conf:8: password_file: listener 1884 is left out" in told(found)


def test_anonymous_clients_have_the_rules_of_no_other_listener(tmp_path: Path) -> None:
    text = (
        "per_listener_settings true\nlistener 1883\nallow_anonymous true\nacl_file one\n"
        "listener 1884\nallow_anonymous true\n"
    )
    found = convert(tmp_path, text, one="topic read a\n")
    assert not may(acl(found, tmp_path), None, Action.PUBLISH, "r2d2/cmd_vel")
    assert may(acl(found, tmp_path), None, Action.RECEIVE, "a")
    broker = settings(found)["broker"]
    terms = {
        each["bind"]: each.get("anonymous", broker.get("anonymous")) for each in broker["listeners"]
    }
    assert terms[":1883"] and not terms[":1884"]
    assert "it lets none in" in told(found)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("", "use_identity_as_username true"),
        ("use_identity_as_username true", ""),
        ("", "crlfile crl.pem"),
        ("crlfile crl.pem", "crlfile other.pem"),
    ],
)
def test_listeners_that_ask_for_other_certificates_are_left_out(
    tmp_path: Path, first: str, second: str
) -> None:
    """With the settings of another one a certificate could stand for a password, or a revoked one
    come in."""
    tls = "cafile ca.pem\ncertfile a.pem\nkeyfile a.key\nrequire_certificate true\n"
    text = f"listener 8883\n{tls}{first}\nlistener 8884\n{tls}{second}\n"
    files = dict.fromkeys(("ca.pem", "a.pem", "a.key", "crl.pem", "other.pem"), "x")
    found = convert(tmp_path, text, **files)
    broker = settings(found)["broker"]
    assert [each["bind"] for each in broker["listeners"]] == [":8883"]
    assert ("username_from" in broker["tls"]) == ("identity" in first)
    assert ("crl" in broker["tls"]) == ("crl" in first)
    assert "listener 8884 is left out" in told(found)


def test_files_that_keep_somebody_out_are_named_where_they_are_not_there(tmp_path: Path) -> None:
    tls = "cafile ca.pem\ncertfile a.pem\nkeyfile a.key\nrequire_certificate true\n"
    bridge = "connection b\naddress h:8883\ntopic a out\nbridge_cafile gone.pem\n"
    found = convert(tmp_path, f"listener 8883\n{tls}crlfile crl.pem\n{bridge}", **{"ca.pem": "x"})
    assert settings(found)["broker"]["tls"]["crl"] == str(tmp_path / "crl.pem")
    assert settings(found)["upstreams"][0]["tls"]["ca"] == str(tmp_path / "gone.pem")


def test_the_user_of_a_link_is_nobody_elses(tmp_path: Path) -> None:
    text = (
        "listener 1883\npassword_file pw\nacl_file acl\n"
        "connection cloud\naddress h\ntopic a out\nconnection other\naddress h\ntopic a out\n"
    )
    acl = "user upstream-other\ntopic read b\n"
    found = convert(tmp_path, text, pw=f"upstream-cloud:{HASH}\n", acl=acl)
    links = [each["user"] for each in settings(found)["upstreams"]]
    assert links == ["upstream-cloud-link", "upstream-other-link"]
    assert "user upstream-cloud-link\ntopic read a" in file(found, "acl.conf")


def test_rules_on_control_are_left_out(tmp_path: Path) -> None:
    lines = "user admin\ntopic readwrite $CONTROL/#\ntopic read a\npattern write $CONTROL/%u\n"
    found = convert(tmp_path, "listener 1883\nacl_file acl\n", acl=lines)
    kept = [line for line in file(found, "acl.conf").splitlines() if not line.startswith("#")]
    assert [line for line in kept if line] == ["user admin", "topic read a"]
    assert "acl:2: topic readwrite $CONTROL/#: is left out" in told(found)
    for blank in "\t\v\f":
        line = f"topic readwrite {blank}$CONTROL/#"
        found = convert(tmp_path, "listener 1883\nacl_file acl\n", acl=f"user a\n{line}\n")
        assert not may(acl(found, tmp_path), "a", Action.PUBLISH, "$CONTROL/appliance/x")


def test_a_denial_that_cannot_be_kept_is_an_error(tmp_path: Path) -> None:
    """A user may be called $dev: + is no level that begins with $."""
    for denied in ("$x%u/a", "%u-x/a", "%c.x/a"):
        lines = f"topic readwrite #\npattern deny {denied}\n"
        with pytest.raises(ImportProblemsError, match=r"acl:2: pattern deny .* is no whole level"):
            convert(tmp_path, "listener 1883\nacl_file acl\n", acl=lines)


@pytest.mark.parametrize(
    ("line", "carried"),
    [
        ("pattern read dev-%u/#", None),
        ("pattern write a/x%c", None),
        ("topic read {robot}/a", None),
        ("pattern deny dev-%u/%c/#", "pattern deny +/%c/#"),
        ("topic deny a/{robot}/b", "topic deny a/+/b"),
        ("topic deny \ta/{robot}/b", "topic deny \ta/+/b"),
        ("pattern deny \t a/u%u/b", "pattern deny \t a/+/b"),
        ("pattern deny \u00a0a%u/b", "pattern deny +/b"),
        ("topic read %u/dev-%c", "topic read %u/dev-%c"),
        ("pattern read %u/%c/#", "pattern read %u/%c/#"),
    ],
)
def test_a_rule_that_would_mean_something_else(
    tmp_path: Path, line: str, carried: str | None
) -> None:
    """It gives no more than in mosquitto, and denies no less."""
    found = convert(tmp_path, "listener 1\nacl_file acl\n", acl=f"user a\ntopic b\n{line}\n")
    lines = file(found, "acl.conf").splitlines()
    assert lines[:2] == ["user a", "topic b"]
    assert lines[2] == (carried or f"# {line}")
    assert (f"acl:3: {line}: " in told(found)) == (carried != line)


def test_a_listener_at_which_nobody_can_come_in_is_left_out(tmp_path: Path) -> None:
    text = (
        "per_listener_settings true\nlistener 1883\npassword_file pw\n"
        "listener 1884\nallow_anonymous false\n"
    )
    found = convert(tmp_path, text, pw=f"alice:{HASH}\n")
    assert [each["bind"] for each in settings(found)["broker"]["listeners"]] == [":1883"]
    assert "listener 1884 is left out: it has no users" in told(found)
    tls = "listener 8883\ncertfile c\nkeyfile c\ncafile c\nuse_identity_as_username true\n"
    found = convert(tmp_path, f"allow_anonymous true\nlistener 1883\n{tls}", c="x")
    assert [each["bind"] for each in settings(found)["broker"]["listeners"]] == [":1883"]
    assert "listener 8883 is left out: it takes the user from a certificate" in told(found)


# General options


@pytest.mark.parametrize(
    ("option", "key"),
    [
        ("max_queued_messages", "queue_messages"),
        ("max_queued_bytes", "queue_bytes"),
        ("message_size_limit", "payload_size"),
        ("max_keepalive", "keep_alive"),
        ("memory_limit", "memory"),
        ("global_max_clients", "sessions"),
    ],
)
def test_the_last_value_of_a_limit_counts(tmp_path: Path, option: str, key: str) -> None:
    twice = f"listener 1883\n{option} 5000\n{option} 6000\n"
    once = convert(tmp_path, f"listener 1883\n{option} 6000\n")
    assert settings(convert(tmp_path, twice)) == settings(once)
    assert key in settings(once)["broker"]["limits"]
    none = convert(tmp_path, f"listener 1883\n{option} 5000\n{option} 0\n")
    assert key not in settings(none)["broker"].get("limits", {})


def test_limits_of_a_listener_that_is_left_out_do_not_count(tmp_path: Path) -> None:
    text = (
        "listener 1883\nmax_connections 5\n"
        "listener 1884\nmount_point x/\nmax_connections 7\nmax_topic_alias 100\n"
    )
    limits = settings(convert(tmp_path, text))["broker"]["limits"]
    assert limits == {"connections": 5}


def test_limits_and_the_rest(tmp_path: Path) -> None:
    text = (
        "max_inflight_messages 0\nmax_queued_messages 50\nmax_queued_bytes 2048\n"
        "max_packet_size 1048576\nmax_keepalive 60\nmemory_limit 1048576\n"
        "persistent_client_expiration 2w\nsys_interval 0\npersistence false\nlog_type warning\n"
        "log_type error\nlistener 1883\nmax_connections 7\nmax_topic_alias 3\n"
    )
    found = settings(convert(tmp_path, text))
    assert found["broker"]["limits"] == {
        "inflight": 65535,
        "queue_messages": 50,
        "queue_bytes": "2 KiB",
        "packet_size": "1 MiB",
        "keep_alive": "1 min",
        "memory": "1 MiB",
        "session_expiry": "14 d",
        "connections": 7,
        "topic_alias": 3,
    }
    assert found["broker"]["sys_interval"] == "0 ms"
    assert found["broker"]["store"] == {"durability": "off"}
    assert found["log"] == {"level": "warning"}


def test_what_has_no_counterpart_is_told_with_its_line(tmp_path: Path) -> None:
    for name, option in OPTIONS.items():
        if option.fate != "none" or option.scope == "bridge":
            continue
        wrong = {"flag": "true", "number": "1", "word": "engine"}.get(option.kind, "x")
        values = [value for value in ("true", "false") if value not in option.same]
        value = values[0] if option.kind == "flag" else wrong
        found = convert(tmp_path, f"listener 1\nlistener 2\n{name} {value}\n")
        assert f"mosquitto.conf:3: {name}: " in told(found), name
        for same in option.same:
            found = convert(tmp_path, f"listener 1\nlistener 2\n{name} {same}\n")
            assert f" {name}: " not in told(found), name


# Bridges


def test_the_ca_that_counts_is_the_one_of_those_who_ask_for_certificates(tmp_path: Path) -> None:
    files = dict.fromkeys(("c", "first.pem", "second.pem"), "x")
    listener = "certfile c\nkeyfile c\n"
    text = (
        f"allow_anonymous true\nlistener 8883\n{listener}cafile first.pem\ncrlfile first.pem\n"
        f"listener 8884\n{listener}cafile second.pem\ncrlfile second.pem\n"
        "require_certificate true\n"
    )
    found = settings(convert(tmp_path, text, **files))["broker"]
    assert found["tls"]["ca"].endswith("second.pem")
    assert found["tls"]["crl"].endswith("second.pem")


BRIDGE = "listener 1\nconnection c\naddress h\ntopic a out 1\n"


def link_of(directory: Path, text: str, **files: str) -> dict[str, Any]:
    (link,) = settings(convert(directory, text, **files))["upstreams"]
    return dict(link)


def test_a_link_with_any_cas_is_encrypted(tmp_path: Path) -> None:
    """Or its password would go in plain text."""
    assert link_of(tmp_path, BRIDGE)["servers"] == ["mqtt://h:1883"]
    for line in ("bridge_capath /etc/ssl/certs", "bridge_tls_use_os_certs true", "bridge_cafile c"):
        assert link_of(tmp_path, f"{BRIDGE}{line}\n", c="x")["servers"] == ["mqtts://h:1883"]


def test_commands_are_kept_where_the_session_is(tmp_path: Path) -> None:
    text = "listener 1\nconnection c\naddress [::1]\ntopic a in 1\n"
    link = link_of(tmp_path, text)
    assert link["in"][0]["offline"] == "keep" and link["servers"] == ["mqtt://[::1]:1883"]
    assert "offline" not in link_of(tmp_path, f"{text}cleansession true\n")["in"][0]


def test_the_version_of_a_link(tmp_path: Path) -> None:
    assert "version" not in link_of(tmp_path, BRIDGE)
    old = f"{BRIDGE}bridge_protocol_version mqttv311\n"
    assert link_of(tmp_path, old)["version"] == "3.1.1"
    both = convert(tmp_path, f"{old}topic b in 1\n")
    assert "version" not in settings(both)["upstreams"][0]


def test_a_certificate_and_its_key_go_together(tmp_path: Path) -> None:
    tls = f"{BRIDGE}bridge_cafile c\nbridge_certfile c\n"
    assert "certificate" not in link_of(tmp_path, tls, c="x")["tls"]
    assert {"certificate", "key"} <= {*link_of(tmp_path, f"{tls}bridge_keyfile c\n", c="x")["tls"]}


def test_a_bridge_is_a_link(tmp_path: Path) -> None:
    text = (
        "listener 1883\nacl_file acl\nconnection to cloud\naddress a.example:8884 b.example\n"
        "bridge_cafile ca.crt\nremote_username robot\nremote_password pass # word\n"
        "remote_clientid robot-7\ntopic # out 1 local/ far/\ntopic cmd in 2\n"
        'topic "" both 0 here there\nkeepalive_interval 30\nbridge_outgoing_retain false\n'
    )
    found = convert(tmp_path, text, acl="user alice\n", **{"ca.crt": "x"})
    retain = {"retain": False}
    assert settings(found)["upstreams"] == [
        {
            "name": "to",
            "servers": ["mqtts://a.example:8884", "mqtts://b.example:1883"],
            "client_id": "robot-7",
            "user": "upstream-to",
            "login": {"username": "robot", "password_file": "to.password"},
            "tls": {"ca": str(tmp_path / "ca.crt")},
            "keep_alive": "30 s",
            "out": [
                {"topic": "#", "local_prefix": "local/", "remote_prefix": "far/", **retain},
                {"topic": "", "local_prefix": "here", "remote_prefix": "there", "qos": 0, **retain},
            ],
            "in": [
                {"topic": "cmd", "local_prefix": "", "remote_prefix": "", "offline": "keep"},
                {"topic": "", "local_prefix": "here", "remote_prefix": "there"},
            ],
        }
    ]
    assert file(found, "to.password") == "pass # word\n"
    assert next(each for each in found.files if each.name == "to.password").is_secret
    assert "pass # word" not in file(found, "appliance.yaml") + told(found)
    rules = acl(found, tmp_path)
    assert may(rules, "upstream-to", Action.RECEIVE, "local/a")
    assert not may(rules, "upstream-to", Action.PUBLISH, "local/a")
    assert may(rules, "upstream-to", Action.PUBLISH, "cmd")
    config.loads(file(found, "appliance.yaml"), tmp_path / "appliance.yaml")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("bridge_psk ab\nbridge_identity x", "the link is left out"),
        ("topic a{b} out", "left out: out.0.topic"),
        ("remote_clientid a{b}", "left out: client_id"),
    ],
)
def test_a_bridge_that_cannot_be_is_left_out(tmp_path: Path, line: str, said: str) -> None:
    found = convert(tmp_path, f"listener 1883\nconnection a\naddress h\n{line}\n")
    assert "upstreams" not in settings(found)
    assert said in told(found)
    assert "upstream-a" not in file(found, "acl.conf")


# Bad input


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\nlistner 1883", "mosquitto.conf:2: mosquitto has no option listner; did you mean list"),
        ("{% if x %}", "mosquitto.conf:1: mosquitto has no option {%"),
        ("  # indented", "a comment has its # in the first column"),
        ("listener", "listener has no value"),
        ("listener x", "listener begins with a port, not 'x'"),
        ("listener 70000", "listener begins with a port"),
        ("listener # none", "listener begins with a port"),
        ("listener 0", "needs the path of a Unix socket"),
        ("port 0", "there is no port 0"),
        ("max_queued_messages lots", "max_queued_messages is a number, not 'lots'"),
        ("max_queued_messages " + "9" * 5000, "is too large a number"),
        ("allow_anonymous maybe", "allow_anonymous is true or false, not 'maybe'"),
        ("listener 1\nprotocol mqttsn", "protocol is one of mqtt, websockets, http_api"),
        ("topic a", "topic is before any `connection`"),
        ("connection a", "connection a has no address"),
        ("connection a\naddress h\nconnection a\naddress h", "there are two connections a"),
        ("connection a\naddress h:0", "address is HOST or HOST:PORT"),
        ("connection a\naddress h\ntopic a sideways", "topic goes in, out or both"),
        ("connection a\naddress h\ntopic a in 3", "topic has QoS 0, 1 or 2"),
        ('connection a\naddress h\ntopic ""', "needs a local and a remote prefix"),
        ("acl_file x\nper_listener_settings true", "has to be before all options of access"),
        ("\0\1\2", "is a binary file"),
        ("listener 1\nmax_qos 3", "mosquitto.conf:2: max_qos is one of 0, 1, 2"),
        ("listener 1\naccept_protocol_versions 3,6", "has 3, 4 and 5, with commas, not '6'"),
        ("listener 1 " + "x" * 300, "listener has an address of 300 characters"),
        ("listener 1\nacl_file " + "x" * 900_000, "mosquitto.conf:2: the line has 900009 charact"),
        ("listener 1\n" * 1001, "mosquitto.conf:1001: there are more than 1000 listeners"),
        ("#" * (2 << 20), "larger than 1 MiB"),
    ],
)
def test_mistakes_are_told_with_their_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ImportProblemsError, match=re.escape(said)) as raised:
        convert(tmp_path, text)
    assert len(str(raised.value)) < 300


def test_a_program_is_no_configuration(tmp_path: Path) -> None:
    (tmp_path / MAIN).write_bytes(b"\x7fELF\0\0\xff\xfe" * 100)
    with pytest.raises(ImportProblemsError, match=r"^mosquitto\.conf: is a binary file"):
        import_mosquitto(tmp_path / MAIN, "r2d2")


def test_rules_that_mosquitto_does_not_have(tmp_path: Path) -> None:
    with pytest.raises(ImportProblemsError, match="acl:2: mosquitto's rules have no `include`"):
        convert(tmp_path, "listener 1\nacl_file acl\n", acl="user a\ninclude other\n")


def test_a_report_stays_short(tmp_path: Path) -> None:
    """However long what it is about, and however much."""
    users = "".join(f"user{number}:plain\n" for number in range(20_000))
    text = f"listener 1\npassword_file pw\nacl_file {'x' * 60_000}\n"
    found = convert(tmp_path, text, pw=users)
    assert len(found.notes) > 20_000
    assert max(map(len, map(str, found.notes))) < 500
    with pytest.raises(ImportProblemsError) as raised:
        convert(tmp_path, "listener 1\nacl_file acl\n", acl="topic " + "a/" * 60_000)
    assert len(str(raised.value)) < 500


def test_all_mistakes_are_told_and_not_too_many(tmp_path: Path) -> None:
    with pytest.raises(ImportProblemsError) as raised:
        convert(tmp_path, "wrong x\n" * 1000)
    assert len(str(raised.value).splitlines()) == 51


def test_text_that_is_not_utf8(tmp_path: Path) -> None:
    (tmp_path / MAIN).write_bytes(b"# x\nuser \xff\n")
    with pytest.raises(ImportProblemsError, match=r"mosquitto\.conf:2: not UTF-8"):
        import_mosquitto(tmp_path / MAIN, "r2d2")


def test_included_files_in_mosquittos_order(tmp_path: Path) -> None:
    folder = tmp_path / "conf.d"
    folder.mkdir()
    for number, name in enumerate(("b.conf", "A.conf", "a.conf", "1.conf", "B.conf", "no.txt")):
        (folder / name).write_text(f"listener {number + 1}\n")
    found = convert(tmp_path, "include_dir /opt/other/conf.d\nlistener 99\n")
    ports = [each["bind"] for each in settings(found)["broker"]["listeners"]]
    assert ports == [":4", ":2", ":3", ":5", ":1", ":99"]


def test_what_this_computer_has_is_not_taken_for_what_lies_beside(tmp_path: Path) -> None:
    """Of a stock mosquitto here, the empty conf.d would stand for the robot's, which has rules."""
    here, copy = tmp_path / "etc/mosquitto", tmp_path / "copy"
    for folder in (here / "conf.d", copy / "conf.d"):
        folder.mkdir(parents=True)
    (here / "conf.d/README").touch()
    (copy / "conf.d/own.conf").write_text("listener 1883\nallow_anonymous false\n")
    text = f"persistence true\ninclude_dir {here}/conf.d\n"
    with pytest.raises(ImportProblemsError) as raised:
        convert(copy, text)
    assert "mosquitto.conf:2: include_dir names" in str(raised.value)
    assert f"{here}/conf.d" in str(raised.value) and f"{copy}/conf.d" in str(raised.value)
    # In its own place it is no question.
    found = convert(here, text)
    assert f"{here}/conf.d has no file that ends in .conf" in told(found)
    for option in ("acl_file", "password_file"):
        (here / "pw").write_text("alice:x\n")
        with pytest.raises(ImportProblemsError, match=f"mosquitto.conf:2: {option} names"):
            convert(copy, f"listener 1883\n{option} {here}/pw\n", pw="")
    lines = f"listener 8883\ncertfile {here}/c.pem\nkeyfile {here}/c.pem\n"
    (here / "c.pem").touch()
    with pytest.raises(ImportProblemsError, match="certfile names"):
        convert(copy, lines, **{"c.pem": ""})


def test_what_only_this_computer_has_is_a_question(tmp_path: Path) -> None:
    here, copy = tmp_path / "etc/mosquitto", tmp_path / "copy"
    for folder in (here / "conf.d", copy):
        folder.mkdir(parents=True)
    with pytest.raises(ImportProblemsError, match=r"conf.d has no file that ends in \.conf"):
        convert(copy, f"listener 1883\ninclude_dir {here}/conf.d\n")
    (here / "acl").write_text("topic read a\n")
    (here / "pw").write_text("")
    text = f"listener 1883\nacl_file {here}/acl\npassword_file {here}/pw\n"
    found = convert(copy, text)
    for line, option in ((2, "acl_file"), (3, "password_file")):
        assert f"mosquitto.conf:{line}: {option}: is {here}/" in told(found)
    assert "of this computer" not in told(convert(here, text))


def test_only_whole_paths_are_looked_for_beside(tmp_path: Path) -> None:
    """A relative one is the broker's own: mosquitto would not start without the file."""
    text = "listener 1883\nallow_anonymous true\nacl_file {}/acl\n"
    found = convert(tmp_path, text.format("strict"), acl="topic readwrite #\n")
    assert not may(acl(found, tmp_path), None, Action.PUBLISH, "a")
    (tmp_path / "rules/acl").mkdir(parents=True)  # of another kind than the file that is meant
    found = convert(tmp_path, text.format("/srv/rules"), acl="topic readwrite #\n")
    assert may(acl(found, tmp_path), None, Action.PUBLISH, "a")


def test_links_that_lead_nowhere(tmp_path: Path) -> None:
    folder = tmp_path / "d"
    folder.mkdir()
    (folder / "loop.conf").symlink_to("loop.conf")
    with pytest.raises(ImportProblemsError, match=r"d/loop\.conf"):
        convert(tmp_path, "listener 1\ninclude_dir d\n")


def test_a_name_of_the_file_is_no_text_of_the_result(tmp_path: Path) -> None:
    name = "x\ncontrol: evil.sock\n# y.conf"
    (tmp_path / name).write_text("listener 1883\n")
    found = import_mosquitto(tmp_path / name, "r2d2")
    assert "control" not in settings(found)


def test_settings_of_listeners_cannot_be_taken_back(tmp_path: Path) -> None:
    text = "per_listener_settings true\nlistener 1883\nallow_anonymous false\n"
    with pytest.raises(ImportProblemsError, match=r"conf:4: per_listener_settings is true before"):
        convert(tmp_path, f"{text}per_listener_settings false\n")


def test_includes_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(ImportProblemsError, match="conf:2: include_dir: there is no folder nowhe"):
        convert(tmp_path, "listener 1\ninclude_dir nowhere\n")
    with pytest.raises(ImportProblemsError, match="would include itself"):
        convert(tmp_path, "include_dir .\n")
    folder = tmp_path / "d"
    folder.mkdir()
    (folder / "a.conf").write_text("include_dir .\ntopic x\n")
    with pytest.raises(ImportProblemsError, match=r"d/a\.conf:2: topic is before any"):
        convert(tmp_path, "include_dir d\nconnection a\naddress h\n")
    (folder / "a.conf").write_text("include_dir .\nlistener 1883\n")
    found = convert(tmp_path, "include_dir d\n")
    assert "d/a.conf:1: include_dir: mosquitto 2.0 does not read it here" in told(found)
    with pytest.raises(ImportProblemsError, match="is included a second time"):
        convert(tmp_path, "include_dir d\ninclude_dir d\n")


# The command


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_that_people_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = write(name, tmp_path)
    assert run("import", str(path), "--dir", str(tmp_path / "new"), "--robot", "r2d2") == 0
    output = capsys.readouterr().out
    assert "to be shown" not in output
    loaded = config.load(tmp_path / "new/appliance.yaml")
    wrong = [each for each in check(loaded) if each.level == "error"]
    # Certificates are those of another computer.
    assert [str(each) for each in wrong if not re.search(r"cert|there is no file", str(each))] == []
    assert bool(wrong) <= ("there is no file" in output)
    for secret in ("users.passwd", *(each.name for each in tmp_path.glob("new/*.password"))):
        assert (tmp_path / "new" / secret).stat().st_mode & 0o077 == 0


def test_no_file_is_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write("local", tmp_path)
    (tmp_path / "acl.conf").write_text("mine")
    assert run("import", str(path), "--dir", str(tmp_path)) == 1
    assert "acl.conf is there already, and no file is replaced" in capsys.readouterr().err
    assert (tmp_path / "acl.conf").read_text() == "mine"
    assert not (tmp_path / "appliance.yaml").exists()


def test_what_could_not_be_started_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / MAIN).write_text("listener 1883\nlistener 1883\n")
    assert run("import", str(tmp_path / MAIN), "--dir", str(tmp_path / "new")) == 1
    said = capsys.readouterr().err
    assert "nothing is imported" in said and "listens there already" in said
    assert not (tmp_path / "new").exists()


def test_files_that_are_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, said in (("", "is a directory; name the file in it"), ("none", "no such file")):
        assert run("import", str(tmp_path / name), "--dir", str(tmp_path / "new")) == 1
        assert said in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
