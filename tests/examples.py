"""How many random examples a property test tries: a part of its full number, others each time.

`TEST_EXAMPLES=1 pytest …` tries the full number, and `TEST_EXAMPLES=10` ten times as many.
"""

from __future__ import annotations

import os
from typing import Any

from hypothesis import settings

#: The part of the full number.
SHARE = float(os.environ.get("TEST_EXAMPLES", "0.25"))


def examples(count: int, **others: Any) -> settings:
    """Hypothesis's settings for a test whose full number of examples is `count`."""
    return settings(max_examples=max(10, round(count * SHARE)), deadline=None, **others)
