"""Where the verbs are called; without imports, as the command line needs it."""

from __future__ import annotations

from typing import Final

#: What the topics of all verbs begin with; `v1` changes when a verb does so that a client must.
TOPICS: Final = "$CONTROL/appliance/v1"


def topic_of(verb: str) -> str:
    """Where a verb is called."""
    return f"{TOPICS}/{verb}/_call"
