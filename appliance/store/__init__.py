"""Where sessions and retained messages are kept: in a SQLite database, or for one run only."""

from appliance.store.memory import MemoryStore
from appliance.store.schema import StoreError
from appliance.store.sqlite import SqliteStore

__all__ = ["MemoryStore", "SqliteStore", "StoreError"]
