"""The verbs about clients: who is there, disconnect one, delete its session."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Annotated, Any, Final

from pydantic import Field

from appliance.broker.broker import Broker
from appliance.broker.output import Output
from appliance.broker.session import Session
from appliance.management.verbs import Arguments, Caller, Name, Verb
from appliance.mqtt.codec import VERSION_NAMES, quote
from appliance.mqtt.reason import ReasonCode
from appliance.ros.calls.dispatcher import CallError

#: The most clients of one answer, and the size in bytes from which on the rest is another page.
MOST_CLIENTS: Final = 500
PAGE_SIZE: Final = 256 * 1024

#: The most subscriptions that are listed of one client, among others and where it is asked for
#: alone.
MOST_SUBSCRIPTIONS: Final = 20
MOST_OF_ONE: Final = 1000

#: The most characters of a text that is searched: each session is compared with it.
LONGEST_SEARCH: Final = 256

#: The bytes of an entry beside its names, about.
_ENTRY_SIZE: Final = 400

#: Sessions that are looked through for one unit of cost, without and with a text that is searched.
_LOOKED_PER_COST_UNIT: Final = 16
_SEARCHED_PER_COST_UNIT: Final = 4

#: Sessions that are looked through in one turn: about a millisecond.
_LOOKED_PER_TURN: Final = 1000


@dataclass(eq=False)
class ListClients(Arguments):
    """Which clients: all, of one user, one by its id; connected ones or absent ones alone.

    `search` is a part of the id, the user or the address, in any case. `after` is the last one of
    the page before.
    """

    client: Name | None = None
    user: Name | None = None
    connected: bool | None = None
    search: Annotated[str, Field(max_length=LONGEST_SEARCH)] | None = None
    after: Name | None = None
    limit: Annotated[int, Field(ge=1, le=MOST_CLIENTS)] = 100


@dataclass(eq=False)
class OneClient(Arguments):
    """A client by its id."""

    client: Name


class ClientVerbs:
    """The verbs about clients; on the event loop, as the broker is."""

    def __init__(self, broker: Broker) -> None:
        self._broker = broker

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        yield Verb("clients", ListClients, self._list)
        yield Verb(
            "disconnect",
            OneClient,
            self._disconnect,
            changes="client disconnected",
            changed=_named,
        )
        yield Verb(
            "delete_session", OneClient, self._delete, changes="session deleted", changed=_named
        )

    async def _list(self, caller: Caller, wanted: ListClients) -> dict[str, Any]:
        sessions = self._broker.sessions
        searched = (wanted.search or "").lower()
        looked = _LOOKED_PER_COST_UNIT if not searched else _SEARCHED_PER_COST_UNIT
        self._broker.counters.cost += len(sessions) // looked
        if wanted.client is not None:
            one = sessions.get(wanted.client)
            found = [one] if one is not None and _matches(one, wanted, searched) else []
        else:
            found = await self._found(caller, wanted, searched)
        most = MOST_SUBSCRIPTIONS if wanted.client is None else MOST_OF_ONE
        page: list[dict[str, Any]] = []
        size = 0
        for session in found[: wanted.limit]:
            entry, grown = _entry(session, most, PAGE_SIZE - size)
            if page and size + grown > PAGE_SIZE:
                break
            page.append(entry)
            size += grown
        # The last id is where to go on, also behind a client that leaves meanwhile.
        more = page[-1]["client"] if len(page) < len(found) else None
        return {"clients": page, "next": more}

    async def _found(self, caller: Caller, wanted: ListClients, searched: str) -> list[Session]:
        """The first ones that are wanted, one more than a page has; looked for in several turns.
        One that ends meanwhile may still be among them."""
        found: list[Session] = []
        every = list(self._broker.sessions.values())
        for begin in range(0, len(every), _LOOKED_PER_TURN):
            if begin:
                await caller.turn()
            looked = every[begin : begin + _LOOKED_PER_TURN]
            matching = (each for each in looked if _matches(each, wanted, searched))
            found = heapq.nsmallest(
                wanted.limit + 1, chain(found, matching), key=lambda each: each.client_id
            )
        return found

    async def _disconnect(self, caller: Caller, wanted: OneClient) -> dict[str, Any]:
        session = self._session(wanted.client)
        was_connected = session.link is not None
        session.close_link(ReasonCode.ADMINISTRATIVE_ACTION, f"disconnected by {caller}")
        self._broker.flush()
        return {"client": wanted.client, "disconnected": was_connected}

    async def _delete(self, caller: Caller, wanted: OneClient) -> dict[str, Any]:
        session = self._session(wanted.client)
        was_connected = session.link is not None
        self._broker.delete(session, f"its session was deleted by {caller}")
        self._broker.flush()
        return {"client": wanted.client, "disconnected": was_connected}

    def _session(self, client_id: str) -> Session:
        session = self._broker.sessions.get(client_id)
        if session is None or session.is_inside:
            raise CallError("not_found", f"there is no client {quote(client_id[:200])}")
        return session


def _named(wanted: OneClient) -> dict[str, Any]:
    return {"of": wanted.client}


def _matches(session: Session, wanted: ListClients, searched: str) -> bool:
    """Whether a session is wanted; `searched` is the text that is searched, in lower case."""
    if session.is_inside:
        return False
    if wanted.after is not None and session.client_id <= wanted.after:
        return False
    if wanted.connected is not None and wanted.connected is not (session.link is not None):
        return False
    username = session.identity.username if session.identity is not None else None
    if wanted.user is not None and username != wanted.user:
        return False
    return not searched or searched in _named_by(session, username).lower()


def _named_by(session: Session, username: str | None) -> str:
    """What a client is found by."""
    link = session.link
    address = link.transport.address if isinstance(link, Output) else ""
    return f"{session.client_id}\n{username or ''}\n{address}"


def _entry(session: Session, most: int, room: int) -> tuple[dict[str, Any], int]:
    """A client as JSON values, with no more subscriptions than have room, and its size."""
    identity, link, now = session.identity, session.link, session.accounting.now
    entry: dict[str, Any] = {
        "client": session.client_id,
        "user": identity.username if identity is not None else None,
        "connected": link is not None,
        "queued": session.waiting + len(session.latest) + len(session.large),
        "queued_bytes": session.bytes,
        "inflight": len(session.inflight),
        "will": session.will is not None,
        "session_expiry": session.expiry,
    }
    if isinstance(link, Output):
        transport = link.transport
        tls = transport.tls_info()
        entry |= {
            "address": transport.address,
            "tls": tls.version or None,
            "certificate": tls.certificate or None,
            "mqtt": VERSION_NAMES[link.version],
            "connected_for": round(session.age, 3),
        }
    elif session.ends_at is not None:
        entry["ends_in"] = round(max(0.0, session.ends_at - now), 3)
    size = _ENTRY_SIZE + 2 * len(session.client_id)
    listed: list[dict[str, Any]] = []
    for topic_filter, subscription in session.subscriptions.items():
        size += len(topic_filter) + 40
        if len(listed) >= most or size > room:
            break
        one: dict[str, Any] = {"filter": topic_filter, "qos": subscription.qos}
        if subscription.max_rate:
            one["max_rate"] = subscription.max_rate
        listed.append(one)
    return {
        **entry,
        "subscription_count": len(session.subscriptions),
        "subscriptions": listed,
    }, size
