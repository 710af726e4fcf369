"""The text format of Prometheus (version 0.0.4), which OpenMetrics' readers take as well.

https://prometheus.io/docs/instrumenting/exposition_formats/
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from itertools import accumulate
from operator import itemgetter
from typing import Final, Literal, TypeAlias

from appliance.broker.histogram import BOUNDS, Histogram

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

#: Every name begins like this, but for those that all programs have.
PREFIX: Final = "appliance_"

_ESCAPED: Final = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})

#: The buckets of a histogram that are shown, by their places in BOUNDS: each is a series of its own
#: for whoever stores them.
SHOWN: Final = (2, 4, 5, 7, 8, 10, 12, 14)

_pick: Final = itemgetter(*SHOWN, len(BOUNDS))

#: Labels as they are written between the braces, and a value.
Sample: TypeAlias = "tuple[str, float]"


@functools.lru_cache(maxsize=4096)
def labels(**values: str) -> str:
    """Labels as they are written between the braces."""
    return ",".join(f'{name}="{value.translate(_ESCAPED)}"' for name, value in values.items())


class Exposition:
    """Metrics, family by family; each name is used once."""

    def __init__(self) -> None:
        self._parts: list[str] = []

    def __bytes__(self) -> bytes:
        return "".join(self._parts).encode()

    def gauge(self, name: str, about: str, value: float) -> None:
        """A value that goes up and down."""
        self.family("gauge", name, about, (("", value),))

    def counter(self, name: str, about: str, value: float) -> None:
        """A value that only grows; its name ends in `_total`."""
        self.family("counter", name, about, (("", value),))

    def family(
        self,
        kind: Literal["gauge", "counter"],
        name: str,
        about: str,
        samples: Iterable[Sample],
        prefix: str = PREFIX,
    ) -> None:
        """All samples of a name, each with other labels."""
        name = prefix + name
        parts = self._parts
        parts.append(f"# HELP {name} {about}\n# TYPE {name} {kind}\n")
        for named, value in samples:
            text = value if type(value) is int else _number(value)
            parts.append(f"{name}{{{named}}} {text}\n" if named else f"{name} {text}\n")

    def counters(
        self, name: str, about: str, named: tuple[str, ...], values: Sequence[int]
    ) -> None:
        """Counters with the same labels each time: of 100 routes in half the time of `family`."""
        name = PREFIX + name
        self._parts.append(f"# HELP {name} {about}\n# TYPE {name} counter\n")
        self._parts.append(_lines(name, named) % tuple(values))

    def histograms(self, name: str, about: str, samples: Iterable[tuple[str, Histogram]]) -> None:
        """All histograms of a name, each with other labels."""
        name = PREFIX + name
        self._parts.append(f"# HELP {name} {about}\n# TYPE {name} histogram\n")
        for named, histogram in samples:
            counts = _pick(list(accumulate(histogram.counts)))
            values = (*counts, histogram.total, counts[-1])
            self._parts.append(_histogram_lines(name, named) % values)


def _number(value: float) -> str:
    if math.isinf(value):
        return "+Inf" if value > 0 else "-Inf"
    return "NaN" if math.isnan(value) else repr(float(value))


@functools.lru_cache(maxsize=256)
def _lines(name: str, named: tuple[str, ...]) -> str:
    """The lines of a family, to be filled in."""
    return "".join(f"{name}{{{each.replace('%', '%%')}}} %d\n" for each in named)


@functools.lru_cache(maxsize=4096)
def _histogram_lines(name: str, named: str) -> str:
    """The lines of a histogram, to be filled in: counts up to each bound, sum, count."""
    named = named.replace("%", "%%")
    before = f"{named}," if named else ""
    of_all = f"{{{named}}}" if named else ""
    bounds = (*(repr(BOUNDS[place]) for place in SHOWN), "+Inf")
    lines = [f'{name}_bucket{{{before}le="{bound}"}} %d\n' for bound in bounds]
    return "".join((*lines, f"{name}_sum{of_all} %r\n", f"{name}_count{of_all} %d\n"))
