"""`appliance fastdds`: a Fast DDS profile with shared memory large enough for images."""

from __future__ import annotations

from typing import Annotated

import typer

#: Smallest and largest segment in bytes: the default, and the most that shared memory allows.
LEAST, MOST = 512 << 10, 4 << 30
#: Room for several uncompressed images of a usual camera.
DEFAULT = "16 MiB"


def fastdds(
    segment: Annotated[
        str,
        typer.Option(
            metavar="SIZE", help="Shared memory of each node; several messages should fit."
        ),
    ] = DEFAULT,
) -> None:
    """Print a Fast DDS profile with more shared memory, for nodes that publish images."""
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
