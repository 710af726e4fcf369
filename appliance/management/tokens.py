"""The verbs about tokens, with which the caller itself stays signed in (`access/tokens.py`).

A token is given for the password alone, whoever is connected: one that was stolen makes no others.
There is none for a user that only a plugin knows, as nobody tells the appliance that its password
has changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, Final

from pydantic import Field

from appliance.access import TOKEN_LIFETIME, FileAccess
from appliance.broker.broker import Broker
from appliance.broker.values import WRONG_LOGIN, Refusal
from appliance.management.users import LONGEST_PASSWORD
from appliance.management.verbs import Arguments, Caller, Verb
from appliance.ros.calls.dispatcher import CallError

_LONGEST_TOKEN: Final = 128


@dataclass(eq=False)
class OwnPassword(Arguments):
    """The caller's password."""

    password: Annotated[str, Field(min_length=1, max_length=LONGEST_PASSWORD)] = field(repr=False)


@dataclass(eq=False)
class OwnToken(Arguments):
    """One of the caller's tokens; None for all."""

    token: Annotated[str, Field(max_length=_LONGEST_TOKEN)] | None = field(repr=False)


class TokenVerbs:
    """The verbs about the caller's own tokens; passwords are hashed in threads."""

    def __init__(self, broker: Broker, access: FileAccess) -> None:
        self._broker = broker
        self._access = access

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        # On the control socket nobody is signed in.
        yield Verb("token", OwnPassword, self._issue, changes="token issued", is_local=False)
        yield Verb("token_end", OwnToken, self._end, changes="token ended", is_local=False)

    async def _issue(self, caller: Caller, wanted: OwnPassword) -> dict[str, Any]:
        user, access = _user(caller), self._access
        if not access.knows(user):
            raise CallError("rejected", "only users of the users file stay signed in by a token")
        found = await access.issue_token(user, wanted.password.encode(), caller.address)
        if not isinstance(found, Refusal):
            return {"token": found, "user": user, "seconds": round(TOKEN_LIFETIME)}
        if found.code in WRONG_LOGIN:
            self._broker.counters.logins_failed += 1
            raise CallError("not_authorized", "this is not the password of the caller")
        raise CallError("too_many", found.reason)

    async def _end(self, caller: Caller, wanted: OwnToken) -> dict[str, Any]:
        user, access = _user(caller), self._access
        if wanted.token is None:
            return {"ended": await access.end_tokens(user)}
        return {"ended": int(await access.end_token(user, wanted.token.encode()))}


def _user(caller: Caller) -> str:
    """The caller's name. Raises CallError."""
    name = caller.identity.username if caller.identity is not None else None
    if name is None:
        raise CallError("rejected", "the caller has no user name")
    return name
