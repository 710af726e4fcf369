"""Callbacks of the event loop, each an entry with a name, whose exceptions are contained.

No part of the appliance hands a callback to the loop itself; it uses `Entries` or `contained`. An
exception that escapes from a callback is caught, counted and reported (`Faults`). Only what the
callback served is ended, by `failed`, and nothing else. `tests/net/test_callbacks.py` finds
callbacks that bypass this module.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, cast

from appliance.broker.faults import Faults

P = ParamSpec("P")
T = TypeVar("T")

#: Ends what a failed callback served.
Failed = Callable[[], object]


class Entries:
    """The entries of one event loop. `served` is what a callback serves, as the log names it."""

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
        """Call it; catch what escapes, and end what it served."""
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
        """Call it periodically, also after it has failed; the first time after `delay` seconds.

        It returns when to call it next, by the loop's clock; None means after `interval`.
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
        """Call it in the loop's next round; may be called from any thread.

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
        """Run it as a task; its exception is caught, whether or not somebody awaits the task."""
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
        """Call it whenever the file is readable.

        `failed` has to remove the reader, or it would be called again at once.
        """
        self.loop.add_reader(file, self.run, entry, served, failed, callback, ())

    def signal(self, entry: str, number: int, callback: Callable[[], object]) -> None:
        """Call it when the process gets the signal."""
        self.loop.add_signal_handler(number, self.run, entry, "", None, callback, ())


class PeriodicCallback:
    """A callback that is called periodically, see `Entries.every`."""

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
        """Stop calling it; may be called twice."""
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()


class FaultHandler(Protocol):
    """A connection, which a fault in one of its callbacks ends."""

    def fault(self, entry: str, error: Exception) -> None:
        """Count the fault and end the connection; never raises."""


HandlerT = TypeVar("HandlerT", bound=FaultHandler)


def contained(
    entry: str,
) -> Callable[
    [Callable[Concatenate[HandlerT, P], T]], Callable[Concatenate[HandlerT, P], T | None]
]:
    """Decorate a connection's callback: an exception that escapes ends that connection."""

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
    """`contained` for `connection_made`: it also aborts the transport, which nobody else knows.

    Otherwise a connection that was set up halfway would receive bytes.
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


def contained_proxy(entry: str, faults: Faults, observer: T) -> T:
    """A proxy whose methods never raise, so that an observer's faults do not reach its caller."""
    return cast(T, _ContainedProxy(entry, faults, observer))


class _ContainedProxy:
    def __init__(self, entry: str, faults: Faults, observer: object) -> None:
        self._entry = entry
        self._faults = faults
        self._observer = observer

    def __getattr__(self, name: str) -> object:
        method = getattr(self._observer, name)

        def call(*args: Any, **kwargs: Any) -> object:
            try:
                return method(*args, **kwargs)
            except Exception as error:
                self._faults.caught(self._entry, error)
                return None

        setattr(self, name, call)  # the next look-up does not come here
        return call
