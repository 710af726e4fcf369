"""What the event loop calls back: each an entry with a name, contained and always set up anew.

The parts of the appliance never hand a callback to the loop itself, but here. What escapes from one
is caught, counted and reported (`Faults`), what it served is ended by `failed`, and nothing else
is. `tests/net/test_callbacks.py` finds callbacks that pass this by.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, cast

from appliance.broker.faults import Faults

P = ParamSpec("P")
T = TypeVar("T")

#: Ends what a callback served that has failed.
Failed = Callable[[], object]


class Entries:
    """A loop's entries. `served` is what a callback is for, in the words of the log."""

    def __init__(self, loop: asyncio.AbstractEventLoop, faults: Faults) -> None:
        self.loop = loop
        self.faults = faults
        self.time = loop.time
        self._tasks: set[asyncio.Task[Any]] = set()

    def run(
        self,
        entry: str,
        served: object,
        failed: Failed | None,
        callback: Callable[..., object],
        args: tuple[Any, ...],
    ) -> None:
        """Call it; what escapes is caught, and what it served ended."""
        try:
            callback(*args)
        except Exception as error:
            self._failed(entry, error, served, failed)

    def _failed(
        self, entry: str, error: BaseException, served: object, failed: Failed | None
    ) -> None:
        self.faults.caught(entry, error, served)
        if failed is not None:
            self.faults.run(f"{entry}, at its end", failed, otherwise=None)

    def soon(
        self,
        entry: str,
        callback: Callable[..., object],
        *args: object,
        served: object = "",
        failed: Failed | None = None,
    ) -> asyncio.Handle:
        """Call it in the loop's next round."""
        return self.loop.call_soon(self.run, entry, served, failed, callback, args)

    def later(
        self,
        entry: str,
        delay: float,
        callback: Callable[..., object],
        *args: object,
        served: object = "",
        failed: Failed | None = None,
    ) -> asyncio.TimerHandle:
        """Call it after so many seconds."""
        return self.loop.call_later(delay, self.run, entry, served, failed, callback, args)

    def at(
        self,
        entry: str,
        when: float,
        callback: Callable[..., object],
        *args: object,
        served: object = "",
        failed: Failed | None = None,
    ) -> asyncio.TimerHandle:
        """Call it at a time of the loop's clock."""
        return self.loop.call_at(when, self.run, entry, served, failed, callback, args)

    def every(
        self, entry: str, interval: float, callback: Callable[[], float | None], delay: float = -1
    ) -> PeriodicCallback:
        """Call it again and again, also when it fails; for the first time after `delay`.

        It returns when it is to be called next, by the loop's clock, or None: after `interval`.
        """
        return PeriodicCallback(self, entry, interval, callback, interval if delay < 0 else delay)

    def from_thread(
        self,
        entry: str,
        callback: Callable[..., object],
        *args: object,
        served: object = "",
        failed: Failed | None = None,
    ) -> None:
        """Call it in the loop's next round; to be called from any thread.

        Raises:
            RuntimeError: the loop is closed.
        """
        self.loop.call_soon_threadsafe(self.run, entry, served, failed, callback, args)

    def task(
        self,
        entry: str,
        work: Coroutine[Any, Any, T],
        *,
        served: object = "",
        failed: Failed | None = None,
    ) -> asyncio.Task[T]:
        """Run it beside everything else; what it fails with is caught, whoever waits for it."""
        task = self.loop.create_task(work)
        self._tasks.add(task)

        def ended(task: asyncio.Task[T]) -> None:
            self._tasks.discard(task)
            error = None if task.cancelled() else task.exception()
            if error is not None:
                self._failed(entry, error, served, failed)

        task.add_done_callback(ended)
        return task

    def when_done(
        self,
        entry: str,
        future: asyncio.Future[Any],
        callback: Callable[..., object],
        *args: object,
    ) -> None:
        """Call it when the future is done."""
        future.add_done_callback(lambda _: self.run(entry, "", None, callback, args))

    def reader(
        self,
        entry: str,
        file: Any,
        callback: Callable[..., object],
        *,
        served: object = "",
        failed: Failed | None = None,
    ) -> None:
        """Call it whenever the file can be read.

        `failed` has to see to it that it no longer can: it would be called again at once.
        """
        self.loop.add_reader(file, self.run, entry, served, failed, callback, ())

    def signal(self, entry: str, number: int, callback: Callable[[], object]) -> None:
        """Call it when the process gets the signal."""
        self.loop.add_signal_handler(number, self.run, entry, "", None, callback, ())


class PeriodicCallback:
    """A callback that is called again and again, see `Entries.every`."""

    def __init__(
        self,
        entries: Entries,
        entry: str,
        interval: float,
        callback: Callable[[], float | None],
        delay: float,
    ) -> None:
        self._entries = entries
        self._entry = entry
        self._interval = interval
        self._callback = callback
        self._timer: asyncio.TimerHandle | None = entries.loop.call_later(delay, self._turn)

    def _turn(self) -> None:
        due: float | None = None
        try:
            due = self._callback()
        except Exception as error:
            self._entries.faults.caught(self._entry, error)
        finally:
            if self._timer is not None:
                loop = self._entries.loop
                self._timer = loop.call_at(
                    loop.time() + self._interval if due is None else due, self._turn
                )

    def cancel(self) -> None:
        """Call it no more; may be called twice."""
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()


class FaultHandler(Protocol):
    """A connection, which a fault ends."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count the fault and end the connection; never raises."""


HandlerT = TypeVar("HandlerT", bound=FaultHandler)


def contained(
    entry: str,
) -> Callable[
    [Callable[Concatenate[HandlerT, P], T]], Callable[Concatenate[HandlerT, P], T | None]
]:
    """For what the loop calls of a connection: what escapes ends that connection."""

    def decorate(
        method: Callable[Concatenate[HandlerT, P], T],
    ) -> Callable[Concatenate[HandlerT, P], T | None]:
        @functools.wraps(method)
        def run(self: HandlerT, /, *args: P.args, **kwargs: P.kwargs) -> T | None:
            try:
                return method(self, *args, **kwargs)
            except Exception as error:
                self.fault(entry, error)
                return None

        return run

    return decorate


def contained_made(
    entry: str,
) -> Callable[
    [Callable[[HandlerT, asyncio.BaseTransport], None]],
    Callable[[HandlerT, asyncio.BaseTransport], None],
]:
    """`contained`, for `connection_made`: it also cuts the transport, of which nobody else knows.

    So no bytes come to what was not made to the end.
    """

    def decorate(
        method: Callable[[HandlerT, asyncio.BaseTransport], None],
    ) -> Callable[[HandlerT, asyncio.BaseTransport], None]:
        @functools.wraps(method)
        def run(self: HandlerT, transport: asyncio.BaseTransport) -> None:
            try:
                method(self, transport)
            except Exception as error:
                self.fault(entry, error)
                cast(asyncio.WriteTransport, transport).abort()

        return run

    return decorate


def contained_proxy(entry: str, faults: Faults, told: T) -> T:
    """A part that is told of what happens, so that its faults are not those of who tells it."""
    return cast(T, _ContainedProxy(entry, faults, told))


class _ContainedProxy:
    def __init__(self, entry: str, faults: Faults, told: object) -> None:
        self._entry = entry
        self._faults = faults
        self._told = told

    def __getattr__(self, name: str) -> object:
        method = getattr(self._told, name)

        def tell(*args: Any, **kwargs: Any) -> object:
            try:
                return method(*args, **kwargs)
            except Exception as error:
                self._faults.caught(self._entry, error)
                return None

        setattr(self, name, tell)  # it is not asked for again
        return tell
