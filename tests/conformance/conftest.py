"""The broker of tests/broker, driven with bytes, for the tests that name a statement."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
from appliance_process import ApplianceProcess
from broker.conftest import access, broker, join, limits, store, version
from client_v311 import Dial
from raw_client import RawClient

__all__ = ["access", "broker", "join", "limits", "store", "version"]


@pytest.fixture(params=[False, True], ids=["tcp", "tls"])
def dial(
    appliance: ApplianceProcess, version: int, request: pytest.FixtureRequest
) -> Iterator[Dial]:
    """To a running appliance, with each transport."""
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(RawClient(appliance, version, tls=request.param))
