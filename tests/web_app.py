"""The appliance with listeners for the web, in the event loop of a test."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from pathlib import Path
from typing import Any

import yaml
from harness import Peer, make_contexts
from http_client import ask
from waiting import PATIENCE

from appliance import config
from appliance.app.main import App

SETTINGS: dict[str, Any] = {
    "robot": "r2d2",
    "reload_on_change": False,
    "broker": {
        "listeners": [
            {"bind": "127.0.0.1:0", "protocol": "web"},
            {"bind": "127.0.0.1:0", "protocol": "web", "tls": True},
        ],
        # However slow the computer is: a password is hashed meanwhile.
        "limits": {"connect_timeout": f"{PATIENCE:g} s"},
        "tls": {"certificate": "certs/server.crt", "key": "certs/server.key", "ca": "certs/ca.crt"},
    },
    "bridge": {"bus": "none"},
}


class WebApp:
    """The appliance with two listeners for the web: plain, and with TLS."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        _, self.client = make_contexts(directory / "certs")
        self.file = directory / "appliance.yaml"
        self.file.write_text(yaml.safe_dump(SETTINGS))
        (directory / "acl.conf").touch()
        (directory / "users.passwd").touch(0o600)
        self.app = App(config.load(self.file))
        self._stack = contextlib.AsyncExitStack()

    async def dial(self, tls: bool = False) -> Peer:
        host, port = self.app.addresses[tls]
        secure: dict[str, ssl.SSLContext | str]
        secure = {"ssl": self.client, "server_hostname": "localhost"} if tls else {}
        peer = Peer(*await asyncio.open_connection(host, port, **secure))  # type: ignore[arg-type]
        self._stack.callback(peer.hang_up)
        return peer

    async def get(
        self, path: str, tls: bool = False, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        return await ask(await self.dial(tls), f"GET {path}", **headers)

    async def stop(self) -> None:
        await self._stack.aclose()
        await self.app.stop()
