"""The tests of a module run on asyncio's loop and on uvloop's when it imports this fixture."""

from __future__ import annotations

import asyncio

import pytest
import uvloop


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(asyncio.DefaultEventLoopPolicy(), id="asyncio", marks=pytest.mark.lengthy),
        pytest.param(uvloop.EventLoopPolicy(), id="uvloop"),  # the appliance's own
    ],
)
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    return request.param  # type: ignore[no-any-return]
