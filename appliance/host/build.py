"""Which build of the appliance this is: its version, and whether the broker is machine code."""

from __future__ import annotations

from importlib.machinery import ExtensionFileLoader
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec


def build() -> str:
    """Such as `appliance 1.2.3, compiled`; `pure Python` where the broker is not machine code."""
    try:
        text = f"appliance {version('ros-mqtt-appliance')}"
    except PackageNotFoundError:
        text = "appliance, run from its source without being installed"
    broker = find_spec("appliance.broker.broker")
    is_compiled = broker is not None and isinstance(broker.loader, ExtensionFileLoader)
    return f"{text}, {'compiled' if is_compiled else 'pure Python'}"
