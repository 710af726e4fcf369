"""Types of values with a syntax of their own: sizes, durations, addresses, file modes, paths."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
)

SIZE_UNITS = {"B": 1, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
DURATION_UNITS = {"ms": 1, "s": 1000, "min": 60_000, "h": 3_600_000, "d": 86_400_000}  # in ms

_QUANTITY = re.compile(r"(\d+(?:\.\d+)?)\s*([A-Za-z]+)")


def parse_size(value: object) -> int:
    """Bytes from `64 KiB`, `16 MiB` or a plain number of bytes. Raises ValueError."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    return round(_quantity(value, SIZE_UNITS, "a size such as 64 KiB or 16 MiB"))


def parse_duration(value: object) -> float:
    """Seconds from `500 ms`, `10 s`, `5 min`, `1 h` or `7 d`. Raises ValueError."""
    return _quantity(value, DURATION_UNITS, "a duration such as 500 ms, 10 s or 5 min") / 1000


def _quantity(value: object, units: Mapping[str, int], wanted: str) -> float:
    match = _QUANTITY.fullmatch(value.strip()) if isinstance(value, str) else None
    if match is None:
        raise ValueError(f"must be {wanted}")
    number, unit = match.groups()
    if unit not in units:
        raise ValueError(f"unknown unit {unit!r}; use {either(list(units))}")
    return float(number) * units[unit]


def format_size(value: int) -> str:
    """A size in the largest unit that is exact: `16 MiB`."""
    return _in_units(value, SIZE_UNITS)


def about_size(value: float) -> str:
    """A size rounded to three digits: `1.5 MiB`."""
    for unit in ("B", "KiB", "MiB"):
        if value < 1024:
            return f"{value:.3g} {unit}"
        value /= 1024
    return f"{value:.3g} GiB"


def format_duration(seconds: float) -> str:
    """A duration, rounded to milliseconds, in the largest unit that is exact: `5 min`."""
    return _in_units(round(seconds * 1000), DURATION_UNITS)


def _in_units(value: int, units: Mapping[str, int]) -> str:
    unit = max((u for u in units if value % units[u] == 0), key=lambda u: units[u] if value else 0)
    return f"{value // units[unit]} {unit}"


def either(words: Sequence[str]) -> str:
    """An enumeration: `a, b or c`."""
    return " or ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)


class Bind(NamedTuple):
    """An address to listen on. An empty host means all addresses of this computer, port 0 any port.

    With a `path` it is a Unix socket, which has no host and port.
    """

    host: str
    port: int
    path: Path | None = None

    def __str__(self) -> str:
        if self.path is not None:
            return f"unix:{self.path}"
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @property
    def loopback(self) -> bool:
        """Whether it is reachable from this computer only."""
        if self.path is not None:
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def collides(self, other: Bind) -> bool:
        """Whether two sockets cannot listen on both; one of the two may be all addresses."""
        if self.path is not None or other.path is not None:
            return self.path == other.path
        if self.port != other.port or not self.port:
            return False
        hosts = {self.host, other.host}
        six = [":" in host for host in hosts]
        return (
            len(hosts) == 1
            or "" in hosts
            or ("0.0.0.0" in hosts and not any(six))
            or ("::" in hosts and all(six))
        )


def parse_bind(value: object) -> Bind:
    """`host:port`, `[::1]:port`, `:port` or `unix:path`. Raises ValueError."""
    if isinstance(value, Bind):
        return value
    text = value if isinstance(value, str) else ""
    if text.startswith("unix:") and text != "unix:":
        return Bind("", 0, Path(text.removeprefix("unix:")))
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([^\s:\[\]]*)):(\d{1,5})", text)
    if match is None:
        raise ValueError('must be "host:port", "[::1]:port", ":port" or "unix:path"')
    port = int(match[3])
    if port > 65535:
        raise ValueError(f"there is no port {port}")
    return Bind(match[1] or match[2], port)


def _parse_address(value: object, info: ValidationInfo) -> Bind:
    bind = parse_bind(value)
    return bind if bind.path is None else bind._replace(path=parse_path(bind.path, info))


def _parse_mode(value: object) -> int:
    """A file mode. YAML parses 0660 as an octal number, and "0660" in quotes as text."""
    modes = {"0600": 0o600, "0660": 0o660, "0666": 0o666}
    mode = modes.get(value) if isinstance(value, str) else value
    if mode not in modes.values() or isinstance(mode, bool):
        raise ValueError(f"must be {either(list(modes))}")
    assert isinstance(mode, int)
    return mode


def parse_seconds(value: object, info: ValidationInfo) -> float:
    # A duration needs a unit in a file; code, which has no context, may pass plain seconds.
    if info.context is None and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    return parse_duration(value)


def parse_path(value: object, info: ValidationInfo) -> Path:
    if not isinstance(value, (str, Path)) or not str(value):
        raise ValueError("must be a path")
    base: Path = (info.context or {}).get("directory", Path())
    return (base / value).absolute()


def _parse_optional_path(value: object, info: ValidationInfo) -> Path | None:
    return None if value is None else parse_path(value, info)


Size = Annotated[int, BeforeValidator(parse_size), PlainSerializer(format_size, when_used="json")]


Duration = Annotated[
    float, BeforeValidator(parse_seconds), PlainSerializer(format_duration, when_used="json")
]


Address = Annotated[Bind, PlainValidator(_parse_address), PlainSerializer(str, when_used="json")]


Mode = Annotated[
    int,
    PlainValidator(_parse_mode),
    PlainSerializer(lambda mode: f"{mode:04o}", when_used="json", return_type=str),
]


# Defaults of paths are validated as well, which resolves them relative to the file.
FilePath = Annotated[Path, PlainValidator(parse_path), Field(validate_default=True)]


OptionalPath = Annotated[Path | None, PlainValidator(_parse_optional_path)]
