"""Why a broker could not be connected to, in words for who reads the log."""

from __future__ import annotations

from typing import Literal, TypeAlias

#: The steps of a dial, in order.
DialStep: TypeAlias = Literal["files", "name", "connection", "proxy", "tls", "websocket"]


class DialError(Exception):
    """A broker could not be connected to; `step` is how far it came, the text says why."""

    def __init__(self, step: DialStep, why: str) -> None:
        super().__init__(why)
        self.step = step
