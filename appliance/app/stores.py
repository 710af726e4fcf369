"""The store that the settings ask for, apart from `main`: it is opened while that is imported."""

from __future__ import annotations

from appliance.config.settings import StoreSection
from appliance.store import MemoryStore, SessionStore, SqliteStore


def store_of(wanted: StoreSection) -> SessionStore:
    """The store, not opened yet."""
    if wanted.durability == "off":
        return MemoryStore()
    return SqliteStore(wanted.path, wanted.durability, size=wanted.size, age=wanted.age)
