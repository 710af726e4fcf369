"""The control socket: a Unix socket by which commands on the same computer reach the appliance.

A request is one line of JSON, `{"command": "reload"}`, with `"arguments"` where the command has
some. The response is one too: `{"ok": …}` with the command's result, or `{"error": "…"}`. The
socket's mode, 0600, lets only the appliance's own user and root open it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from async_timeout import timeout

from appliance.broker.faults import Faults
from appliance.net.sockets import listen_on_path

log = logging.getLogger(__name__)

#: Runs a command with its arguments, as they are in the request, and returns its result; a
#: ControlError is the response when it was not done.
Command: TypeAlias = Callable[[object], Awaitable[object]]

#: Limits of a request in bytes, and in seconds to send it: it is one line of a local program.
LONGEST_REQUEST = 64 * 1024
REQUEST_TIMEOUT = 10.0

#: The longest path of a Unix socket, in bytes (unix(7)).
LONGEST_PATH = 100


class ControlError(Exception):
    """The appliance did not do what it was asked; the text says why."""


class NotRunningError(ControlError):
    """No appliance answers there."""


class Control:
    """Answers commands on a Unix socket; belongs to the event loop's thread."""

    def __init__(self, path: Path, commands: Mapping[str, Command], faults: Faults) -> None:
        self._path = path
        self._faults = faults
        self._commands = commands
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        """Listen on the socket.

        Raises:
            OSError: another appliance listens there, or the folder cannot be written to.
        """
        with _short(self._path) as path:
            listening = listen_on_path(path, 0o600, "control")
        self._server = await asyncio.start_unix_server(
            self._serve, sock=listening, limit=LONGEST_REQUEST
        )

    async def stop(self) -> None:
        """Stop listening; may be called twice."""
        if self._server is not None:
            self._server.close()
            self._server = None
            self._path.unlink(missing_ok=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            answer = await self._answer(reader)
            writer.write(json.dumps(answer).encode() + b"\n")
            async with timeout(REQUEST_TIMEOUT):
                await writer.drain()
        except (OSError, asyncio.TimeoutError) as error:
            log.debug("the response could not be sent: %s", error)
            writer.transport.abort()  # otherwise its rest would wait for a reader for ever
        except Exception as error:
            self._faults.caught("control.connection", error)
            writer.transport.abort()
        finally:
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader) -> dict[str, object]:
        try:
            async with timeout(REQUEST_TIMEOUT):
                line = await reader.readline()
            request = json.loads(line)
        except asyncio.TimeoutError:
            return {"error": f"no request within {REQUEST_TIMEOUT:g} s"}
        except (ValueError, RecursionError):  # too long, not JSON, too deep, or not UTF-8
            return {"error": "the request must be one line of JSON"}
        name = request.get("command") if isinstance(request, dict) else None
        command = self._commands.get(name) if isinstance(name, str) else None
        if command is None:
            return {"error": f"unknown command; there are {', '.join(sorted(self._commands))}"}
        try:
            return {"ok": await command(request.get("arguments", {}))}
        except ControlError as error:
            return {"error": str(error)}
        except Exception as error:
            self._faults.caught("control.command", error, name)
            return {"error": f"a fault in the appliance, see its log: {type(error).__name__}"}


def ask(
    path: Path, command: str, timeout: float = 30.0, arguments: Mapping[str, Any] | None = None
) -> Any:
    """Send a command to the appliance that listens there, and return its result.

    Raises:
        NotRunningError: no appliance listens there.
        ControlError: it could not do it, or did not respond within `timeout` seconds.
    """
    request = {"command": command, "arguments": arguments or {}}
    try:
        with _short(path) as short, socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(timeout)
            connection.connect(str(short))
            connection.sendall(json.dumps(request).encode() + b"\n")
            answer = json.loads(b"".join(iter(lambda: connection.recv(65536), b"")))
    except (FileNotFoundError, ConnectionRefusedError):
        raise NotRunningError(
            f"no appliance is running (nobody listens on {path}); one with another configuration "
            "is found with --config FILE"
        ) from None
    except PermissionError:
        raise ControlError(
            f"{path} may not be opened: run this as the appliance's user, or as root"
        ) from None
    except TimeoutError:
        raise ControlError(f"the appliance does not answer within {timeout:g} s") from None
    except (OSError, ValueError) as error:
        raise ControlError(f"the appliance did not answer: {error}") from None
    if "error" in answer:
        raise ControlError(answer["error"])
    return answer["ok"]


@contextmanager
def _short(path: Path) -> Iterator[Path]:
    """The same file by a path that is short enough for a Unix socket."""
    if len(os.fsencode(path)) <= LONGEST_PATH:
        yield path
        return
    directory = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield Path(f"/proc/self/fd/{directory}", path.name)
    finally:
        os.close(directory)
