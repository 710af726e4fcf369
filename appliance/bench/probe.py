"""A probe: one client whose round trips show whether the broker stalls for other clients.

It publishes to itself, one message after the other with a pause between. Each line on its standard
input is answered with the round trips since the line before. The program ends with its input::

    python -m appliance.bench.probe --port 1883 --user NAME --password-env VARIABLE
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import select
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing

from appliance.bench.client import LoadClient, LoadError, LoadTarget, publish_packet, reporting
from appliance.bench.load import percentile

PAUSE_SECONDS = 0.002  # between two round trips, so that the probe itself is no load
TIMEOUT_SECONDS = 60.0  # for one round trip


def round_trips(client: LoadClient) -> Iterator[float]:
    """The seconds of each round trip. Raises LoadError when one times out."""
    topic = f"bench/probe/{os.getpid()}"
    packet = publish_packet(topic, bytes(64))
    client.subscribe(topic, 0)
    client.socket.settimeout(TIMEOUT_SECONDS)
    while True:
        began = time.perf_counter()
        client.write(packet)
        try:
            client.expect(packet[0], len(packet))
        except TimeoutError:
            raise LoadError(f"no answer within {TIMEOUT_SECONDS:g} s") from None
        yield time.perf_counter() - began


def watch(client: LoadClient) -> None:
    """Make round trips, and report them for each line of input, until it ends."""
    samples: list[tuple[float, int]] = []
    trips = round_trips(client)
    next(trips)  # the first is slower than the others
    print_answer({"ready": True})
    while True:
        samples.append((next(trips), 1))
        if not select.select([sys.stdin], [], [], PAUSE_SECONDS)[0]:
            continue
        if not sys.stdin.readline():
            return
        print_answer(
            {
                "longest": percentile(samples, 1.0),
                "p99": percentile(samples, 0.99),
                "median": percentile(samples, 0.5),
            }
        )
        samples.clear()


def print_answer(answer: dict[str, object]) -> None:
    """Print an answer for the process at the other end of the pipe, as a line of JSON."""
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m appliance.bench.probe", description="Time an MQTT client's round trips."
    )
    LoadTarget.add_options(parser)
    gc.disable()  # its pauses would be counted as the broker's
    with reporting("probe"):
        target = LoadTarget.of(parser.parse_args(arguments))
        with closing(LoadClient(target, f"bench-probe-{os.getpid()}")) as client:
            client.wait_connected()
            watch(client)
    return 0


if __name__ == "__main__":
    sys.exit(main())
