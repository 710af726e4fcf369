"""The brokers that the clients of this folder speak with, each through TLS."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from appliance_process import ACL, MOSQUITTO, ApplianceProcess, BrokerProcess, MosquittoProcess


@pytest.fixture(scope="session")
def mosquitto(
    appliance: ApplianceProcess, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[MosquittoProcess]:
    """A running mosquitto with the appliance's users and rules."""
    if MOSQUITTO is None:
        pytest.skip("there is no mosquitto to compare with: apt-get install mosquitto")
    process = MosquittoProcess(tmp_path_factory.mktemp("mosquitto"), appliance.passwords, ACL)
    process.start()
    yield process
    process.stop()


@pytest.fixture(params=["appliance", "mosquitto"])
def broker(request: pytest.FixtureRequest) -> BrokerProcess:
    """The appliance, and mosquitto, which shows that the test asks for what people are used to."""
    process = request.getfixturevalue(request.param)
    assert isinstance(process, BrokerProcess)
    return process
