"""The tests of a module run on asyncio's loop and on uvloop's when it imports this fixture."""

from __future__ import annotations

import asyncio

import pytest
import uvloop


@pytest.fixture(
    scope="module",
    params=[asyncio.DefaultEventLoopPolicy(), uvloop.EventLoopPolicy()],
    ids=["asyncio", "uvloop"],
)
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    return request.param  # type: ignore[no-any-return]
