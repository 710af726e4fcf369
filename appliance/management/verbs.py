"""A verb: what the appliance can be asked to do, its arguments, and who asks.

A verb is implemented once. `mqtt_calls.py` makes it an MQTT call, and `Verbs.command` a command of
the control socket. Arguments are a stranger's: pydantic checks them strictly, and every string and
list has a limit. A change is in the audit log with its caller, also one that failed. It is finished
also when the time of its call is over: files and what is in force must not differ.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Generic, TypeVar

import orjson
from pydantic import ConfigDict, Field, ValidationError

from appliance.broker.values import Identity
from appliance.management.verb_thread import VerbThread
from appliance.mqtt.codec import quote
from appliance.net.callbacks import Entries
from appliance.ops.control import Command, ControlError
from appliance.ros.calls.dispatcher import CallError

if TYPE_CHECKING:
    from pydantic import TypeAdapter

log = logging.getLogger(__name__)

#: The most bytes of an answer to a client: of some thousand routes or users.
LONGEST_ANSWER: Final = 1024 * 1024

#: Seconds that most verbs have for their answer.
TIMEOUT: Final = 10.0

#: Mistakes in the arguments that an error names, and characters of each.
_MISTAKES: Final = 5
_LONGEST_MISTAKE: Final = 200

#: The longest client id, topic or user name, in characters: MQTT allows 65,535 bytes.
_LONGEST_NAME: Final = 65_535

#: A client id, user name or topic.
Name = Annotated[str, Field(max_length=_LONGEST_NAME)]


@dataclass(eq=False)
class Arguments:
    """The arguments of a verb; those of a verb without any.

    They are dataclasses, as a model of pydantic takes milliseconds when it is defined.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid", strict=True)


A = TypeVar("A", bound=Arguments)


async def _next_iteration() -> None:
    await asyncio.sleep(0)


@dataclass(frozen=True, slots=True)
class Caller:
    """Who asks: a client with its address, or, without an identity, the control socket.

    `turn` waits until the caller may do a piece of work on the event loop, a few milliseconds. A
    verb has one when it is run, and waits for another before each further piece.
    """

    identity: Identity | None = None
    address: str = ""
    turn: Callable[[], Awaitable[None]] = field(default=_next_iteration, compare=False, repr=False)

    def __str__(self) -> str:
        return "the control socket" if self.identity is None else str(self.identity)

    @property
    def user(self) -> str | None:
        """The user that asks; None for the control socket, and for clients without one."""
        return None if self.identity is None else self.identity.username

    def as_json(self) -> dict[str, Any]:
        """As the audit log names it."""
        if self.identity is None:
            return {"by": str(self)}
        by = {"client": self.identity.client_id, "user": self.identity.username}
        return {"by": by, "address": self.address}


#: The one that may open the control socket: the appliance's own user, or root.
LOCAL: Final = Caller()


@dataclass(frozen=True)
class Verb(Generic[A]):
    """A verb. `run` returns JSON values, and raises CallError.

    `changes` says what a verb that changes something has done, for the log and the audit log, and
    with `changed` its details: no password may be among them. `is_local` offers the verb on the
    control socket too.
    """

    name: str
    arguments: type[A]
    run: Callable[[Caller, A], Awaitable[object]]
    timeout: float = TIMEOUT
    changes: str = ""
    changed: Callable[[A], dict[str, Any]] = field(default=lambda arguments: {})
    is_local: bool = True


#: Notes a change, with details: `Audit.changed`.
Note = Callable[..., None]


class Verbs:
    """All verbs by name, and how one is run."""

    def __init__(
        self,
        verbs: Iterable[Verb[Any]],
        entries: Entries,
        thread: VerbThread,
        note: Note | None,
    ) -> None:
        """`note` writes to the audit log; None where there is none."""
        self.by_name: dict[str, Verb[Any]] = {verb.name: verb for verb in verbs}
        self._entries = entries
        self._thread = thread
        self._note = note
        #: The changes under way.
        self._changes: set[asyncio.Task[object]] = set()
        #: What checks the arguments of the verbs that were called.
        self._adapters: dict[str, TypeAdapter[Any]] = {}

    async def run(self, caller: Caller, name: str, given: object) -> object:
        """The result of a verb with these arguments. Raises CallError."""
        verb = self.by_name[name]
        adapter = self._adapters.get(name)
        if adapter is None:  # it takes many milliseconds, once, and most verbs are never called
            make = partial(_adapter, verb.arguments)
            adapter = await self._thread.run(caller.user, make)
            self._adapters[name] = adapter
        arguments = _checked(adapter, given)
        if not verb.changes:
            return await verb.run(caller, arguments)
        change = self._entries.task("management.change", self._change(caller, verb, arguments))
        self._changes.add(change)
        self._entries.when_done("management.changed", change, self._changes.discard, change)
        outcome = await asyncio.shield(change)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    async def _change(self, caller: Caller, verb: Verb[Any], arguments: Any) -> object:
        """Change something and note it; returns the result, or the exception in its place."""
        details = verb.changed(arguments)
        try:
            result = await verb.run(caller, arguments)
        except CallError as error:
            self._changed(caller, f"nothing: {verb.changes}", error=str(error), **details)
            return error
        except BaseException as error:  # a fault, or the appliance stops
            self._changed(caller, f"perhaps: {verb.changes}", error=repr(error), **details)
            if not isinstance(error, Exception):
                raise
            return error
        self._changed(caller, verb.changes, **details)
        return result

    async def stop(self) -> None:
        """Cut off the changes under way; may be called twice."""
        changes = list(self._changes)
        for change in changes:
            change.cancel()
        await asyncio.gather(*changes, return_exceptions=True)

    def _changed(self, caller: Caller, what: str, **details: Any) -> None:
        told = ", ".join(f"{key} {quote(str(value))}" for key, value in details.items())
        log.info("%s, by %s: %s", what, caller, told)
        if self._note is not None:
            self._note(what, **details, **caller.as_json())

    def command(self, name: str) -> Command:
        """The verb as a command of the control socket."""

        async def run(arguments: object) -> object:
            try:
                return await self.run(LOCAL, name, arguments)
            except CallError as error:
                raise ControlError(str(error)) from None

        return run

    @property
    def commands(self) -> Mapping[str, Command]:
        """The commands of the control socket."""
        return {name: self.command(name) for name, verb in self.by_name.items() if verb.is_local}


def _adapter(arguments: type[Arguments]) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(arguments)


def _checked(adapter: TypeAdapter[Any], given: object) -> Any:
    """The arguments. Raises CallError."""
    try:
        # A strict check takes the objects of JSON for dataclasses, and no others.
        return adapter.validate_json(orjson.dumps(given))
    except ValidationError as error:
        raise CallError("bad_request", _mistakes(error)) from None
    except TypeError as error:  # CBOR has more values than JSON
        raise CallError("bad_request", f"not what JSON can express: {error}") from None


def _mistakes(error: ValidationError) -> str:
    """What is wrong with the arguments, and where."""
    found = error.errors(include_url=False, include_context=False, include_input=False)
    texts = []
    for each in found[:_MISTAKES]:
        where = ".".join(map(str, each["loc"]))
        # A key may be as long as the request.
        named = f"{quote(where[:_LONGEST_MISTAKE])}: " if where else ""
        texts.append(f"{named}{each['msg'][:_LONGEST_MISTAKE]}")
    more = len(found) - len(texts)
    return "; ".join(texts) + (f"; and {more} more" if more else "")
