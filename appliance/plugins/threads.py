"""Threads for plugins that block: each is called in its own thread, not on the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Coroutine
from typing import Any, Final, TypeAlias

#: Plugins of amqtt that block: they hash passwords, or talk to a server, without `await`.
_BLOCKING: Final = ("amqtt.plugins.authentication.FileAuthPlugin", "amqtt.contrib.ldap.")

_Call: TypeAlias = "tuple[asyncio.Future[Any], Coroutine[Any, Any, Any]]"


def blocks(plugin: object) -> bool:
    """Whether calling the plugin would block the event loop."""
    kind = type(plugin)
    return f"{kind.__module__}.{kind.__qualname__}".startswith(_BLOCKING)


class Threads:
    """Calls plugins; a blocking plugin is called in its own thread, one call at a time.

    A plugin that never returns blocks only its own callers, who have time limits, and not the end
    of the process.
    """

    def __init__(self) -> None:
        self._threads: dict[object, _Thread] = {}

    async def call(self, plugin: object, method: str, arguments: dict[str, Any]) -> Any:
        """What the plugin's method returns."""
        work = getattr(plugin, method)(**arguments)
        if not blocks(plugin):
            return await work
        thread = self._threads.get(plugin)
        if thread is None:
            thread = self._threads[plugin] = _Thread(type(plugin).__name__)
        return await thread.run(work)

    def close(self) -> None:
        """End each thread after its current call."""
        for thread in self._threads.values():
            thread.close()
        self._threads.clear()


class _Thread:
    """One thread and its queue of calls."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.get_running_loop()
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        # A daemon: a call to a server that is gone must not keep the process from ending.
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def run(self, work: Coroutine[Any, Any, Any]) -> asyncio.Future[Any]:
        future: asyncio.Future[Any] = self._loop.create_future()
        self._calls.put((future, work))
        return future

    def close(self) -> None:
        self._calls.put(None)

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            future, work = call
            if future.cancelled():
                work.close()
                continue
            result, error = _run(work)
            with contextlib.suppress(RuntimeError):  # the event loop has ended meanwhile
                self._loop.call_soon_threadsafe(_settle, future, result, error)


def _run(work: Coroutine[Any, Any, Any]) -> tuple[Any, Exception | None]:
    try:
        work.send(None)
    except StopIteration as answer:
        return answer.value, None
    except Exception as error:  # a plugin may raise anything
        return None, error
    work.close()
    return None, RuntimeError("it waits with `await` as well, and is called in a thread")


def _settle(future: asyncio.Future[Any], result: Any, error: Exception | None) -> None:
    if future.done():
        return
    if error is not None:
        future.set_exception(error)
    else:
        future.set_result(result)
