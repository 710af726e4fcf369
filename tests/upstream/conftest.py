"""The fleet's brokers that tests share: each takes seconds to start, so nobody stops or fills one.

A test that stops, kills or configures its broker makes one of its own (peers.py).
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from upstream.peers import Ejabberd, FleetMosquitto, RabbitMQ


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetMosquitto]:
    """mosquitto: starts at once."""
    with FleetMosquitto(tmp_path_factory.mktemp("mosquitto")) as broker:
        yield broker


@pytest.fixture(scope="session")
def rabbitmq(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RabbitMQ]:
    """RabbitMQ, one node: takes 10 s."""
    with RabbitMQ(tmp_path_factory.mktemp("rabbitmq")) as broker:
        yield broker


@pytest.fixture(scope="session")
def ejabberd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ejabberd]:
    """ejabberd: takes 2 s."""
    with Ejabberd(tmp_path_factory.mktemp("ejabberd")) as broker:
        yield broker
