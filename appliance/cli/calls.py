"""`appliance call`, `goal` and `param`: what MQTT clients can ask of a robot.

They are what `ros2 service call`, `ros2 action send_goal` and `ros2 param` are on the robot.
"""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from appliance.cli.connection import CallTarget, connecting
from appliance.cli.console import CommandError

if TYPE_CHECKING:
    from appliance.cli.rpc_client import RpcClient

param_app = typer.Typer(no_args_is_help=True, help="Parameters of the robot's nodes, over MQTT.")


@contextmanager
def _caller(reach: CallTarget) -> Iterator[RpcClient]:
    from appliance.cli.mqtt_client import ClientError
    from appliance.cli.rpc_client import RpcClient

    try:
        caller = RpcClient(reach.target())
        try:
            yield caller
        finally:
            caller.close()
    except ClientError as error:
        raise CommandError(str(error)) from None


def _payload(text: str) -> bytes:
    """The JSON that somebody typed, or YAML, which needs fewer quotes; - is standard input."""
    if text == "-":
        text = sys.stdin.read()
    if not text.strip():
        return b""
    try:
        json.loads(text)
    except ValueError:
        import yaml

        try:
            return json.dumps(yaml.safe_load(text)).encode()
        except (yaml.YAMLError, TypeError) as error:
            what = str(error).replace("\n", " ")
            raise typer.BadParameter(f"{text!r} is neither JSON nor YAML: {what}") from None
    return text.encode()


def _print(line: bytes) -> None:
    from appliance.cli.mqtt_client import write_line

    write_line(sys.stdout.buffer, line)


@connecting
def call(
    reach: CallTarget,
    service: Annotated[str, typer.Argument(help="Its ROS name, or its MQTT topic.")],
    request: Annotated[
        str, typer.Argument(metavar="JSON", help="The request's fields; - is standard input.")
    ] = "",
    timeout: Annotated[
        float, typer.Option("--timeout", "-W", min=0, help="Longest wait for the answer, in s.")
    ] = 10.0,
) -> None:
    """Call a ROS service, and print its answer.

    Fields that are left out have their default; YAML will do as well as JSON.
    When it fails, the reason is on standard error and the exit code is 1.

    Example: appliance call -u alice /arm/grip '{"data": true}'
    """
    topic, payload = f"{reach.topic(service)}/_call", _payload(request)
    with _caller(reach) as caller:
        _print(caller.call(topic, payload, timeout))


@connecting
def goal(
    reach: CallTarget,
    action: Annotated[str, typer.Argument(help="Its ROS name, or its MQTT topic.")],
    fields: Annotated[
        str, typer.Argument(metavar="JSON", help="The goal's fields; - is standard input.")
    ] = "",
    feedback: Annotated[
        bool, typer.Option("--feedback/--no-feedback", "-f", help="Print feedback as it comes.")
    ] = True,
    timeout: Annotated[
        float | None,
        typer.Option("--timeout", "-W", min=0, help="Cancel it after so many seconds; else never."),
    ] = None,
) -> None:
    """Send a goal to a ROS action, and print feedback and result; Ctrl-C cancels it.

    Each line begins with what it is: goal, feedback, and at the end
    succeeded, canceled or aborted. The exit code is 0 when it has succeeded.

    Example: appliance goal -u alice /walk '{"order": 5}'
    """
    topic, payload = reach.topic(action), _payload(fields)
    with _caller(reach) as caller, _stop_signals() as caught:
        outcome = caller.goal(
            topic,
            payload,
            accepted=lambda id_: _print(f"goal {id_}".encode()),
            feedback=(lambda line: _print(b"feedback " + line)) if feedback else None,
            is_over=lambda: bool(caught),
            timeout=timeout,
        )
    _print(outcome.status.encode() + b" " + outcome.result)
    if caught:
        raise typer.Exit(128 + caught[0])
    if outcome.status != "succeeded":
        raise typer.Exit(1)


@contextmanager
def _stop_signals() -> Iterator[list[int]]:
    """SIGINT and SIGTERM are put in the list; a second one ends the command as ever."""
    caught: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        caught.append(number)
        restore()

    for number in before:
        signal.signal(number, note)
    try:
        yield caught
    finally:
        restore()


NodeArgument = Annotated[str, typer.Argument(help="Its ROS name, or its MQTT topic.")]
ShownTimeout = Annotated[
    float, typer.Option("--timeout", "-W", min=0, help="Longest wait for a value, in s.")
]


@param_app.command("get")
@connecting
def param_get(
    reach: CallTarget,
    node: NodeArgument,
    name: Annotated[str, typer.Argument(help="The parameter.")],
    timeout: ShownTimeout = 3.0,
) -> None:
    """Print the value of a node's parameter as JSON.

    Example: appliance param get -u alice /controller max_speed
    """
    topic = f"{reach.topic(node)}/_param/{name}"
    with _caller(reach) as caller:
        values = caller.parameters(topic, timeout)
    if topic not in values:
        raise CommandError(_not_shown(topic, timeout))
    _print(values[topic])


@param_app.command("list")
@connecting
def param_list(reach: CallTarget, node: NodeArgument, timeout: ShownTimeout = 3.0) -> None:
    """Print a node's parameters and their values, one a line.

    Example: appliance param list -u alice /controller
    """
    base = f"{reach.topic(node)}/_param"
    with _caller(reach) as caller:
        values = caller.parameters(f"{base}/+", timeout)
    if not values:
        raise CommandError(_not_shown(f"{base}/+", timeout))
    for topic, value in sorted(values.items()):
        _print(topic.removeprefix(f"{base}/").encode() + b" " + value)


def _not_shown(topic: str, timeout: float) -> str:
    return (
        f"nothing is retained at {topic} within {timeout:g} s: there is no such node or parameter, "
        "or no route of bridge.parameters is for it"
    )


@param_app.command("set")
@connecting
def param_set(
    reach: CallTarget,
    node: NodeArgument,
    name: Annotated[str, typer.Argument(help="The parameter.")],
    value: Annotated[str, typer.Argument(help="Its value, as JSON or YAML.")],
    timeout: Annotated[
        float, typer.Option("--timeout", "-W", min=0, help="Longest wait for the answer, in s.")
    ] = 10.0,
) -> None:
    """Set a node's parameter; the node's reason is told when it does not.

    Example: appliance param set -u alice /controller max_speed 0.4
    """
    topic, payload = f"{reach.topic(node)}/_param/{name}/set", _payload(value)
    with _caller(reach) as caller:
        caller.call(topic, payload, timeout)
