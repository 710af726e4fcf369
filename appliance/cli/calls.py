"""The commands `appliance call`, `goal` and `param`, which call a robot over MQTT.

They correspond to `ros2 service call`, `ros2 action send_goal` and `ros2 param`.
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
def _rpc_client(options: CallTarget) -> Iterator[RpcClient]:
    from appliance.cli.mqtt_client import ClientError
    from appliance.cli.rpc_client import RpcClient

    try:
        client = RpcClient(options.target())
        try:
            yield client
        finally:
            client.close()
    except ClientError as error:
        raise CommandError(str(error)) from None


def _payload(text: str) -> bytes:
    """The payload as JSON, from JSON or YAML, which needs fewer quotes; - is standard input."""
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
    options: CallTarget,
    service: Annotated[str, typer.Argument(help="ROS name or MQTT topic.")],
    request: Annotated[
        str, typer.Argument(metavar="JSON", help="The request's fields; - is standard input.")
    ] = "",
    timeout: Annotated[
        float, typer.Option("--timeout", "-W", min=0, help="Seconds to wait for the answer.")
    ] = 10.0,
) -> None:
    """Call a ROS service, and print its answer.

    Fields that are not given have their defaults; YAML works as well as JSON.
    When the call fails, the reason is on standard error and the exit code is 1.

    Example: appliance call -u alice /arm/grip '{"data": true}'
    """
    topic, payload = f"{options.topic(service)}/_call", _payload(request)
    with _rpc_client(options) as client:
        _print(client.call(topic, payload, timeout))


@connecting
def goal(
    options: CallTarget,
    action: Annotated[str, typer.Argument(help="ROS name or MQTT topic.")],
    fields: Annotated[
        str, typer.Argument(metavar="JSON", help="The goal's fields; - is standard input.")
    ] = "",
    feedback: Annotated[
        bool, typer.Option("--feedback/--no-feedback", "-f", help="Print feedback as it comes.")
    ] = True,
    timeout: Annotated[
        float | None,
        typer.Option(
            "--timeout", "-W", min=0, help="Cancel the goal after so many seconds; default: never."
        ),
    ] = None,
) -> None:
    """Send a goal to a ROS action, and print feedback and result; Ctrl-C cancels it.

    Each line begins with its kind: goal, feedback, and at the end
    succeeded, canceled or aborted. The exit code is 0 when the goal succeeded.

    Example: appliance goal -u alice /walk '{"order": 5}'
    """
    topic, payload = options.topic(action), _payload(fields)
    with _rpc_client(options) as client, _stop_signals() as caught:
        outcome = client.goal(
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
    """Collect SIGINT and SIGTERM in a list; a second signal ends the command as usual."""
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


NodeArgument = Annotated[str, typer.Argument(help="ROS name or MQTT topic.")]
ShownTimeout = Annotated[
    float, typer.Option("--timeout", "-W", min=0, help="Seconds to wait for a value.")
]


@param_app.command("get")
@connecting
def param_get(
    options: CallTarget,
    node: NodeArgument,
    name: Annotated[str, typer.Argument(help="The parameter.")],
    timeout: ShownTimeout = 3.0,
) -> None:
    """Print the value of a node's parameter as JSON.

    Example: appliance param get -u alice /controller max_speed
    """
    topic = f"{options.topic(node)}/_param/{name}"
    with _rpc_client(options) as client:
        values = client.parameters(topic, timeout)
    if topic not in values:
        raise CommandError(_not_shown(topic, timeout))
    _print(values[topic])


@param_app.command("list")
@connecting
def param_list(options: CallTarget, node: NodeArgument, timeout: ShownTimeout = 3.0) -> None:
    """Print a node's parameters and their values, one per line.

    Example: appliance param list -u alice /controller
    """
    base = f"{options.topic(node)}/_param"
    with _rpc_client(options) as client:
        values = client.parameters(f"{base}/+", timeout)
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
    options: CallTarget,
    node: NodeArgument,
    name: Annotated[str, typer.Argument(help="The parameter.")],
    value: Annotated[str, typer.Argument(help="The value, as JSON or YAML.")],
    timeout: Annotated[
        float, typer.Option("--timeout", "-W", min=0, help="Seconds to wait for the answer.")
    ] = 10.0,
) -> None:
    """Set a node's parameter; prints the node's reason when it refuses.

    Example: appliance param set -u alice /controller max_speed 0.4
    """
    topic, payload = f"{options.topic(node)}/_param/{name}/set", _payload(value)
    with _rpc_client(options) as client:
        client.call(topic, payload, timeout)
