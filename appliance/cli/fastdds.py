"""`appliance fastdds`: the file that gives ROS nodes the memory that images take."""

from __future__ import annotations

from typing import Annotated

import typer

#: Bytes that a segment may have: no less than is the default, and no more than a shared memory has.
LEAST, MOST = 512 << 10, 4 << 30


def fastdds(
    segment: Annotated[
        str,
        typer.Option(metavar="SIZE", help="Memory for what a node publishes: several messages."),
    ] = "16 MiB",
) -> None:
    """Print the file by which nodes share more memory, for those that publish images."""
    from appliance.config import parse_size
    from appliance.ros.ros2.fastdds import VARIABLES, profile

    try:
        size = parse_size(segment)
    except ValueError as error:
        raise typer.BadParameter(f"--segment {error}") from None
    if not LEAST <= size <= MOST:
        raise typer.BadParameter("--segment is from 512 KiB to 4 GiB")
    typer.echo(profile(size), nl=False)
    new, old = VARIABLES
    typer.echo(
        "For each node that publishes images, before it starts, with the file's full path:\n"
        f"  export {new}=/PATH/fastdds.xml\n"
        f"up to ROS 2 Jazzy, where it has another name:\n"
        f"  export {old}=/PATH/fastdds.xml\n"
        "The memory is taken by each of them; /dev/shm has to have room for all.",
        err=True,
    )
