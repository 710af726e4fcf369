"""`appliance init --upstream`: a link that `check` takes, with the rights that it needs."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from appliance import config
from appliance.access import Acl
from appliance.broker.values import Action, Identity
from appliance.config import ServerUrl
from appliance.ops.check import check
from appliance.ops.init import InitError, InitStep, NextSteps, initialise
from appliance.upstream.settings import upstreams

URL = "mqtts://broker.example"


def add(directory: Path, url: str = URL) -> dict[str, bool]:
    """What was made (True) or kept, by the name of the file and the text."""
    steps = list(initialise(directory, robot="r2", upstream=url))
    return {
        f"{step.path.name}: {step.text}": step.made for step in steps if isinstance(step, InitStep)
    }


def troubles(directory: Path) -> list[str]:
    """What `check` says of the link that is not ok."""
    findings = list(check(config.load(directory / "appliance.yaml")))
    assert [each for each in findings if each.subject == "upstream fleet"]
    return [
        each.text
        for each in findings
        if each.level != "ok" and (each.subject.startswith("upstream") or "slip?" in each.text)
    ]


def test_a_new_appliance_with_a_link(tmp_path: Path) -> None:
    made = add(tmp_path)
    assert made["appliance.yaml: the link to mqtts://broker.example:8883"]
    assert made["acl.conf: access rules of the link's user, upstream"]
    assert troubles(tmp_path) == []
    (link,) = upstreams(config.load(tmp_path / "appliance.yaml"))
    assert link.servers == (ServerUrl("mqtts", "broker.example", 8883),)
    assert (link.name, link.kind, link.prefix) == ("fleet", "generic", "fleet/r2/")
    acl = Acl.load(tmp_path / "acl.conf", "r2")
    assert acl.decide(Identity("operator", "a"), Action.PUBLISH, "r2/events/test")
    out, inward = (
        Identity("upstream", "_upstream/fleet"),
        Identity("upstream", "_upstream/fleet/in"),
    )
    for rule in link.out:
        assert acl.allows_some(out, Action.RECEIVE, rule.local_filter)
    assert acl.decide(inward, Action.PUBLISH, "r2/_upstream/fleet/0123")
    # Nothing that moves the robot comes from there before somebody has allowed it.
    assert link.inward == ()
    for topic in ("r2/cmd_vel", "r2/events/x", "r2/reset/_call"):
        assert not acl.decide(inward, Action.PUBLISH, topic)


def test_what_the_comments_propose_works(tmp_path: Path) -> None:
    add(tmp_path)
    file, acl = tmp_path / "appliance.yaml", tmp_path / "acl.conf"
    text = file.read_text().replace("    in: []\n", "").replace("    #  in: [", "    in: [")
    file.write_text(text)
    assert any("topic write {robot}/cmd_vel" in each for each in troubles(tmp_path))
    acl.write_text(acl.read_text().replace("#topic write {robot}/cmd", "topic write {robot}/cmd"))
    said = troubles(tmp_path)
    assert said == ["in cmd_vel: late is for commands, and no route to ROS takes its topics"]
    file.write_text(text.replace("topics: []", "topics: [{ros: /cmd_vel, to: ros}]"))
    assert troubles(tmp_path) == []


def test_a_link_is_added_to_what_there_is(tmp_path: Path) -> None:
    list(initialise(tmp_path, robot="r2"))
    file, acl = tmp_path / "appliance.yaml", tmp_path / "acl.conf"
    file.write_text("robot: r2\nlog: {level: debug}")  # without a line end
    acl.write_text("user operator\ntopic read x")
    file.chmod(0o640)
    made = add(tmp_path)
    assert made["appliance.yaml: the link to mqtts://broker.example:8883"]
    assert not made["acl.conf: access rules"]
    assert made["acl.conf: access rules of the link's user, upstream"]
    settings = config.load(file)
    assert settings.log.level == "debug" and len(settings.upstreams) == 1
    assert file.read_text().startswith("robot: r2\nlog: {level: debug}\n")
    assert acl.read_text().startswith("user operator\ntopic read x\n")
    assert Acl.load(acl, "r2").decide(Identity("operator", "b"), Action.RECEIVE, "x")
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    (text,) = troubles(tmp_path)  # in somebody's own rules nobody is given a right
    assert text.endswith("below the line of the user that does: topic write {robot}/events/#")


def test_a_second_time_nothing_is_added(tmp_path: Path) -> None:
    add(tmp_path, "mqtts://alice@broker.example")
    (tmp_path / "fleet.password").write_text("hunter2\n")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert set(add(tmp_path, "mqtts://alice@broker.example").values()) == {False}
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    with pytest.raises(InitError, match="has upstreams already; add mqtts://other:8883 there"):
        add(tmp_path, "mqtts://other")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_rules_of_the_links_user_are_kept(tmp_path: Path) -> None:
    list(initialise(tmp_path, robot="r2"))
    rules = "user operator\ntopic write {robot}/#\nuser upstream\ntopic read {robot}/#\n"
    (tmp_path / "acl.conf").write_text(rules)
    assert not add(tmp_path)["acl.conf: access rules of the link's user, upstream"]
    assert (tmp_path / "acl.conf").read_text() == rules
    assert troubles(tmp_path) == []


def test_a_configuration_that_cannot_be_continued(tmp_path: Path) -> None:
    (tmp_path / "appliance.yaml").write_text("{robot: r2}\n")
    with pytest.raises(InitError, match="cannot be continued; add to it:"):
        add(tmp_path)
    assert (tmp_path / "appliance.yaml").read_text() == "{robot: r2}\n"
    assert "upstream" not in (tmp_path / "acl.conf").read_text()


def test_a_link_with_a_login(tmp_path: Path) -> None:
    made = add(tmp_path, "wss://o'neil@broker.example:443/mqtt")
    assert made["fleet.password: put the password of o'neil at broker.example in its first line"]
    file = tmp_path / "fleet.password"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    (trouble,) = troubles(tmp_path)
    assert "has nothing in its first line" in trouble
    file.write_text("hunter2\n")
    assert troubles(tmp_path) == []
    (link,) = upstreams(config.load(tmp_path / "appliance.yaml"))
    assert (link.login.username, link.login.password_file) == ("o'neil", file)


@pytest.mark.parametrize("manufacturer", ["acme", "o'neil {& sons}"])
def test_a_link_by_vda5050(tmp_path: Path, manufacturer: str) -> None:
    steps = initialise(tmp_path, robot="r2", upstream=URL, manufacturer=manufacturer)
    if "{" in manufacturer:
        with pytest.raises(InitError, match="--vda5050 must be the manufacturer's name"):
            list(steps)
        steps = initialise(tmp_path, robot="r2", upstream=URL, manufacturer="o'neil")
        manufacturer = "o'neil"
    list(steps)
    (link,) = upstreams(config.load(tmp_path / "appliance.yaml"))
    assert link.state_there == f"uagv/v2/{manufacturer}/r2/connection"
    assert [rule.topic for rule in link.inward] == ["order", "instantActions"]
    assert [each for each in troubles(tmp_path) if "recommends" not in each] == []


def test_a_link_by_vda5050_says_what_to_do_next(tmp_path: Path) -> None:
    steps = list(initialise(tmp_path, robot="r2", upstream=URL, manufacturer="acme"))
    (next_steps,) = [each for each in steps if isinstance(each, NextSteps)]
    said = "\n".join(next_steps.texts)
    assert "let this client read and write uagv/v2/acme/r2/# at broker.example" in said
    assert "published at r2/vda5050/state is at uagv/v2/acme/r2/state" in said


@pytest.mark.parametrize("user", ["", "r2@"])
def test_a_broker_with_a_ca_of_its_own(
    user: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the next steps say, typed as it is said, from the folder above."""
    monkeypatch.chdir(tmp_path)
    steps = list(initialise(Path("my r2"), robot="r2", upstream=f"mqtts://{user}broker.example"))
    (said,) = [each.texts for each in steps if isinstance(each, NextSteps)]
    file = Path("my r2/appliance.yaml")
    if user:
        assert said[0] == "put the password into my r2/fleet.password"
        (file.parent / "fleet.password").write_text("hunter2\n")
    step = "where a CA of your own has signed for broker.example: copy its certificate to "
    step += "my r2/fleet-ca.crt, and take the # off the line `tls` in my r2/appliance.yaml"
    assert step in said
    file.write_text(file.read_text().replace("# tls: {ca", "tls: {ca"))
    authority = (file.parent / "certs/ca.crt").read_bytes()
    (file.parent / "fleet-ca.crt").write_bytes(authority)
    assert troubles(file.parent) == []
    (link,) = upstreams(config.load(file))
    assert link.tls.ca == (file.parent / "fleet-ca.crt").absolute()
    commands = [f"appliance {verb} -c 'my r2/appliance.yaml'" for verb in ("check", "run")]
    assert [each for each in said if each in commands] == commands


def test_what_a_cloud_or_the_demo_does_next(tmp_path: Path) -> None:
    steps = list(initialise(tmp_path, upstream="mqtts://x.iot.eu-west-1.amazonaws.com", demo=True))
    (said,) = [each.texts for each in steps if isinstance(each, NextSteps)]
    assert not [each for each in said if "CA of your own" in each]
    assert f"appliance demo -c {tmp_path / 'appliance.yaml'}" in said


def test_vda5050_is_of_a_link(tmp_path: Path) -> None:
    with pytest.raises(InitError, match="--vda5050 needs --upstream"):
        list(initialise(tmp_path / "new", manufacturer="acme"))
    assert not (tmp_path / "new").exists()


def test_brokers_of_a_kind(tmp_path: Path) -> None:
    add(tmp_path, "mqtts://x.iot.eu-west-1.amazonaws.com")
    (link,) = upstreams(config.load(tmp_path / "appliance.yaml"))
    assert link.kind == "aws-iot"
    assert (link.tls.certificate, link.tls.key) == (tmp_path / "fleet.crt", tmp_path / "fleet.key")
    errors = [text for text in troubles(tmp_path) if text.startswith("tls.")]
    assert len(errors) == 2 and str(tmp_path / "fleet.crt") in errors[0]


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("broker.example", "--upstream must be a URL such as"),
        ("mqtts://alice:hunter2@broker.example", "must have no password"),
        ("mqtt://x.iot.eu-west-1.amazonaws.com", "must be mqtts:// or wss://"),
        ("http://broker.example", "did you mean 'ws'?"),
    ],
)
def test_what_is_no_url_of_a_broker(tmp_path: Path, url: str, problem: str) -> None:
    with pytest.raises(InitError) as raised:
        add(tmp_path / "new", url)
    assert problem in str(raised.value) and "hunter2" not in str(raised.value)
    assert not (tmp_path / "new").exists()


def test_it_is_an_option_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from appliance.cli import main as cli

    arguments = ["init", "--dir", str(tmp_path), "--robot", "r2", "--upstream"]
    with pytest.raises(SystemExit) as ended:
        cli.main([*arguments, URL])
    assert ended.value.code == 0
    told = capsys.readouterr().out
    assert "the link to mqtts://broker.example:8883" in told
    assert "published at r2/events/test is at fleet/r2/events/test" in told
    with pytest.raises(SystemExit) as ended:
        cli.main([*arguments, "foo"])
    assert ended.value.code == 1
    assert "--upstream must be a URL" in capsys.readouterr().err
