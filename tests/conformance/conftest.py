"""The broker of tests/broker, driven with bytes, for the tests that name a statement."""

from __future__ import annotations

from broker.conftest import access, broker, join, limits, store, version

__all__ = ["access", "broker", "join", "limits", "store", "version"]
