"""`appliance call`, `goal` and `param`, as somebody types them, with a real appliance and robot."""

from __future__ import annotations

import asyncio
import json
import os
import shlex
import signal
import subprocess
import sys

import pytest
import yaml
from appliance_process import ApplianceProcess
from waiting import PATIENCE, eventually

pytest.importorskip("rclpy")
pytest.importorskip("test_msgs.action")

from appliance.cli import main as cli
from appliance.host.environment import for_other_programs
from appliance.ops.init import initialise

BRIDGE = {
    "node": "bridge",
    "services": ["/turtle/*", {"ros": "/turtle/think", "timeout": "3 s"}, "/absent"],
    "actions": [{"ros": "/turtle/walk", "encoding": "cbor"}],
    "parameters": [{"ros": ["/turtle/*", "!/turtle/gains"], "encoding": "cbor"}],
}
ACL = """\
user alice
topic readwrite r2d2/#

user bob
topic write r2d2/turtle/reset/_call/#

user carol
topic write r2d2/turtle/pen/_call/#
pattern read r2d2/turtle/pen/_reply/%c/#
"""


@pytest.fixture(scope="module")
def appliance(domain, robot, tmp_path_factory):
    users = {"bob": "bob's", "carol": "carol's"}
    directory = tmp_path_factory.mktemp("appliance")
    appliance = ApplianceProcess(directory, users=users, acl=ACL, bridge=BRIDGE)
    appliance.start()
    try:
        for name in ("pen", "reset", "think"):
            appliance.wait_for_log(rf"/turtle/{name} can be called")
        appliance.wait_for_log(r"/turtle/walk can be called")
        appliance.wait_for_log(r"parameters of /turtle are at")
        robot.do("followed")
        yield appliance
    finally:
        print(appliance.log)
        appliance.stop()


def typed(appliance, command, *arguments, user):
    """The arguments of `appliance`."""
    if command == "reload":
        return [command, "-c", str(appliance.config)]
    words = 1 if command == "param" else 0
    where = ["-c", str(appliance.config), "-p", str(appliance.port), "-u", user]
    return [command, *arguments[:words], *where, *arguments[words:]]


@pytest.fixture
def run(appliance, monkeypatch, capsys):
    """(exit code, output, errors) of such a command."""

    def run(*arguments, user="alice"):
        monkeypatch.setenv("APPLIANCE_PASSWORD", appliance.passwords[user])
        with pytest.raises(SystemExit) as ended:
            cli.main(typed(appliance, *arguments, user=user))
        return ended.value.code, *capsys.readouterr()

    return run


@pytest.mark.parametrize("version", ["5", "311"])
def test_a_call_prints_its_answer(run, version):
    for request in ('{"data": true}', "{data: yes}", "data: true"):
        code, output, errors = run("call", "/turtle/pen", request, "-V", version)
        assert (code, json.loads(output)) == (0, {"success": True, "message": "down"}), errors
    code, output, _ = run("call", "r2d2/turtle/pen", "-V", version)  # the topic, and no request
    assert (code, json.loads(output)["message"]) == (0, "up")


def test_a_call_that_fails_says_why(run):
    for arguments, what in (
        (("/turtle/think",), "appliance: timeout: no answer from /turtle/think within 3 s"),
        (("/absent",), "appliance: unavailable: there is no /absent on the bus"),
        (("/nowhere",), "appliance: nothing takes calls at r2d2/nowhere/_call: no route is for it"),
        (("/turtle/pen", '{"data": 1}'), "appliance: bad_request: data: expected true or false"),
        (
            ("/turtle/think", "-W", "0.1"),
            "appliance: no answer from r2d2/turtle/think/_call within",
        ),
    ):
        code, output, errors = run("call", *arguments)
        assert (code, output) == (1, "") and errors.startswith(what), errors
    code, _, errors = run("call", "/turtle/pen", "{")
    assert code == 2 and "is neither JSON nor YAML" in " ".join(errors.split())


def test_rights_that_are_missing_are_named_as_the_rule_that_gives_them(run):
    code, _, errors = run("call", "/turtle/reset", user="bob")
    assert code == 1 and "pattern read r2d2/turtle/reset/_reply/%c/#" in errors
    assert "`topic write r2d2/turtle/reset/_call/#` and" in errors and "below `user bob`" in errors
    assert run("call", "/turtle/pen", user="carol")[0] == 0
    code, _, errors = run("call", "/turtle/pen", user="bob")
    assert code == 1 and "topic write r2d2/turtle/pen/_call/#" in errors
    code, _, errors = run("goal", "/turtle/walk", user="carol")
    assert code == 1 and "topic read r2d2/turtle/walk/#" in errors
    assert "topic write r2d2/turtle/walk/_goal/#" in errors


def test_a_name_without_its_slash_is_no_missing_right(run):
    for command in ("call", "goal"):
        code, _, errors = run(command, "reset", user="carol")
        assert code == 1 and "did you mean /reset?" in errors, errors
        assert "ACL line" not in errors


def test_a_goal_to_its_end(run):
    code, output, errors = run("goal", "/turtle/walk", '{"order": 40}')
    first, *between, last = output.splitlines()
    assert code == 0, errors
    assert len(first.split()[1]) == 32 and first.startswith("goal ")
    # The newest goes to a client that is slow, and the last may be late.
    steps = [0, 1]
    while len(steps) < 42:
        steps.append(steps[-1] + steps[-2])
    every = [json.dumps(steps[at : at + 3], separators=(",", ":")) for at in range(40)]
    told = [line.partition('feedback {"sequence":')[2].removesuffix("}") for line in between]
    assert told and told == [step for step in every if step in told]
    assert last == "succeeded " + json.dumps({"sequence": steps}, separators=(",", ":"))


def test_goals_that_do_not_succeed(run):
    code, output, errors = run("goal", "/turtle/walk", '{"order": -1}')
    assert (code, output) == (1, "")
    assert errors == "appliance: rejected: /turtle/walk does not accept the goal\n"
    code, output, _ = run("goal", "/turtle/walk", '{"order": 99}', "--no-feedback")
    assert code == 1 and output.splitlines()[1:] == ['aborted {"sequence":[0,1,1,2]}']
    code, output, _ = run("goal", "/turtle/walk", '{"order": 300}', "-W", "0.3")
    assert code == 1 and output.splitlines()[-1].startswith("canceled {")
    code, _, errors = run("goal", "/turtle/walk", '{"order": 113}', "-W", "0.1", "--no-feedback")
    assert code == 1 and "goes on: rejected: the action's server does not cancel it" in errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_cancels_the_goal(appliance, robot, number):
    arguments = typed(appliance, "goal", "/turtle/walk", '{"order": 4000}', user="alice")
    process = subprocess.Popen(
        [sys.executable, "-m", "appliance", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=for_other_programs() | {"APPLIANCE_PASSWORD": appliance.passwords["alice"]},
    )
    try:
        assert process.stdout.readline().startswith("goal ")
        assert process.stdout.readline().startswith("feedback ")
        process.send_signal(number)
        output, errors = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
        process.communicate()
    assert output.splitlines()[-1].startswith("canceled {"), errors
    assert process.returncode == 128 + number
    while (told := robot.told.get(timeout=PATIENCE))[2:] != [4000]:
        pass
    assert told[0] == "walked" and told[1] < 100


def test_what_has_no_json_is_named(run, appliance):
    before = appliance.config.read_text()
    settings = yaml.safe_load(before)
    settings["bridge"]["actions"][0]["encoding"] = "cdr"
    try:
        for text in (yaml.safe_dump(settings), before):
            appliance.config.write_text(text)
            assert run("reload")[0] == 0
            # So many steps that feedback is left when ROS has found the route's new subscription.
            code, output, errors = run("goal", "/turtle/walk", '{"order": 118}', "-V", "5")
            assert code == 0, errors
            _, *between, last = output.splitlines()
            if text is not before:
                assert last == "succeeded (application/cdr, 492 bytes)"
                assert set(between) == {"feedback (application/cdr, 20 bytes)"}  # three numbers
            else:
                assert last.startswith('succeeded {"sequence":[0,1,1,2,3,')
            code, _, errors = run("goal", "/turtle/walk", '{"order": 2}', "-V", "311")
            assert code == 1 and "MQTT 3.1.1 cannot say that this is JSON" in errors
    finally:
        appliance.config.write_text(before)


def test_parameters_are_read_and_set(run):
    assert run("param", "get", "/turtle", "mode") == (0, '"calm"\n', "")
    code, output, _ = run("param", "list", "/turtle")
    listed = dict(line.split(" ", 1) for line in output.splitlines())
    assert code == 0 and listed["serial"] == '"T-800"' and listed["speed"] == "0.5"
    assert "gains" not in listed
    done = run("param", "set", "/turtle", "mode", "wild")
    for _ in range(2):  # of two services, whose first answers may be dropped, see test_robot.py
        if "timeout: " in done[2]:
            done = run("param", "set", "/turtle", "mode", "wild")
    assert done == (0, "", "")
    eventually(
        lambda: run("param", "get", "/turtle", "mode") == (0, '"wild"\n', ""), "it has changed"
    )
    for arguments, what in (
        (("mode", "mad"), "/turtle does not set mode: there is no mode mad"),
        (("serial", "x"), "rejected: serial is read-only"),
        (("speed", "[1]"), "bad_request: speed: expected a double, got [1]"),
        (("gains", "[1]"), "not_authorized: the parameter /turtle/gains is not among"),
    ):
        code, output, errors = run("param", "set", "/turtle", *arguments)
        assert (code, output) == (1, "") and what in errors, errors
    code, _, errors = run("param", "get", "/turtle", "nothing", "-W", "0.2")
    assert code == 1 and "nothing is retained at r2d2/turtle/_param/nothing" in errors


async def test_the_demo_s_line_can_be_typed(tmp_path, domain, monkeypatch):
    """From nothing to a service that was called, as somebody new to it does it."""
    monkeypatch.chdir(tmp_path)
    environment = for_other_programs() | {
        "APPLIANCE_PORT": "0",
        "APPLIANCE_PLAIN_PORT": "0",
        "APPLIANCE_WEB_PORT": "0",
        "ROS_DOMAIN_ID": str(1 + (os.getpid() + 50) % 101),  # another robot's than the other tests'
    }

    async def start(*arguments):
        return await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "appliance", *arguments),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment,
        )

    async def output(process):
        out, errors = await asyncio.wait_for(process.communicate(), PATIENCE)
        return process.returncode, out.decode(), errors.decode()

    list(initialise(tmp_path / "run", demo=True))
    demo = await start("demo", "-c", "run/appliance.yaml")
    try:
        line = b""
        while b" call " not in line:
            line = await asyncio.wait_for(demo.stdout.readline(), PATIENCE)
            assert line, (await demo.stderr.read()).decode()
            if b" pub " in line:
                drive = shlex.split(line.decode())[1:]
        words = shlex.split(line.decode())[1:]
        code, answer, errors = await output(await start(*words))
        # The robot has not come yet, or not discovered who asks it.
        while "there is no /reset on the bus" in errors or "no answer from /reset" in errors:
            code, answer, errors = await output(await start(*words))
        assert code == 0, errors
        assert json.loads(answer)["message"] == "was 0.0 m from its start"
        for _ in range(5):  # what comes late of two seconds of commands does not drive
            assert await output(await start(*drive)) == (0, "", "")
            code, answer, errors = await output(await start(*words))
            if code == 0 and json.loads(answer)["message"] > "was 0.3 m":
                break
        else:
            pytest.fail(f"it has not driven: {answer} {errors}")
    finally:
        demo.terminate()
        await output(demo)
