"""The client ids of the sessions that a link has in this broker; no client can take one.

Each is one level of a topic: an id that is not would fit no pattern of the access rules, and a
pattern that denies then denies everything.
"""

from __future__ import annotations


def out_client_id(name: str) -> str:
    """The session for what the link of that name sends."""
    return f"_upstream.{name}"


def in_client_id(name: str) -> str:
    """The session for what it receives on the connection with a clean session there."""
    return f"_upstream_in.{name}"


def kept_client_id(name: str) -> str:
    """The session for what it receives on the connection with a session that is kept there."""
    return f"_upstream_kept.{name}"


def answers_client_id(name: str) -> str:
    """The link's own session, which has all rights, for answers both ways."""
    return f"_upstream_answers.{name}"
