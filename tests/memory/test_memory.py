"""Memory follows what the limits allow, whatever is sent; each shape in a process of its own."""

from __future__ import annotations

import pytest

from memory.__main__ import measure
from memory.shapes import MIB, MOST, SHAPES


@pytest.mark.parametrize("name", SHAPES)
def test_memory_grows_by_what_the_limits_allow(name: str) -> None:
    grown, counted, allowed = measure(name)
    assert grown <= MOST * allowed, (
        f"{name}: {grown / MIB:.1f} MiB more, of which {counted / MIB:.1f} are counted and "
        f"{allowed / MIB:.1f} allowed"
    )
