"""`appliance bench`: this broker and mosquittos, side by side, under the same load."""

from __future__ import annotations


def broker_cells() -> list[str]:
    """The names of the cells that compare the broker alone with mosquitto."""
    from appliance.bench.cells import BROKER

    return [cell.name for cell in BROKER]


def bridge_cells() -> list[str]:
    """The names of the cells that measure the bridge."""
    from appliance.bench.cells import CELLS, RosCell

    return [cell.name for cell in CELLS if isinstance(cell, RosCell)]


def upstream_cells() -> list[str]:
    """The names of the cells that measure a link to a fleet's broker."""
    from appliance.bench.links import LINKS

    return [cell.name for cell in LINKS]


def main(
    cells: list[str] | None,
    seconds: float,
    peers: list[str] | None,
    as_json: bool,
    messages: int | None = None,
    rounds: int = 3,
) -> int:
    """Measure and print; returns the exit status, 0 when every cell ran.

    `cells` are names of CELLS (None: all but those of links), `seconds` is the length of one run,
    `peers` are the mosquittos to compare with (None: the one that is installed), and `rounds` is
    how often each cell is measured. `messages` wait for a link in its cells. Unmet goals are no
    failure.
    """
    # Imported here, as the processes of the load import this package too and need none of it.
    from appliance.bench import command

    return command.main(cells, seconds, peers, as_json, messages, rounds)
