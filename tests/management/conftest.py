"""The appliance that is managed."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from management.managed import Site


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    site = Site(tmp_path)
    await site.app.start()
    yield site
    await site.stop()
