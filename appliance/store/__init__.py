"""Where sessions and retained messages are stored: in a SQLite database, or for one run only."""

from appliance.store.interface import SessionStore
from appliance.store.memory import MemoryStore
from appliance.store.schema import StoreError
from appliance.store.sqlite import SqliteStore

__all__ = ["MemoryStore", "SessionStore", "SqliteStore", "StoreError"]
