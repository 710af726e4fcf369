"""URLs in appliance.yaml: of the brokers that a link dials, and of a proxy on the way."""

from __future__ import annotations

import re
from typing import Annotated, NamedTuple
from urllib.parse import unquote, urlsplit

from pydantic import AfterValidator, PlainSerializer, PlainValidator

from appliance.config.quantities import either

#: The schemes of brokers, and their ports where the URL has none.
SCHEMES = {"mqtt": 1883, "mqtts": 8883, "ws": 80, "wss": 443}

#: Other programs' names for the same.
_OTHER_NAMES = {"tcp": "mqtt", "ssl": "mqtts", "tls": "mqtts", "http": "ws", "https": "wss"}

#: Where brokers have MQTT over WebSocket, as the appliance itself.
_WEBSOCKET_PATH = "/mqtt"

_PROXY_PORT = 3128


class ServerUrl(NamedTuple):
    """The address of a broker; `path` is empty unless it is over WebSocket."""

    scheme: str
    host: str
    port: int
    path: str = ""

    def __str__(self) -> str:
        return f"{self.scheme}://{self.authority}{self.path}"

    @property
    def authority(self) -> str:
        """`host:port`; an IPv6 address is in brackets."""
        return _authority(self.host, self.port)

    @property
    def tls(self) -> bool:
        """Whether the connection is encrypted."""
        return self.scheme in ("mqtts", "wss")

    @property
    def websocket(self) -> bool:
        """Whether MQTT is in a WebSocket."""
        return self.scheme in ("ws", "wss")


class ProxyUrl(NamedTuple):
    """An HTTP proxy, with the user and password for it, None for none."""

    host: str
    port: int
    username: str | None = None
    password: str | None = None

    def __repr__(self) -> str:
        return f"ProxyUrl({self.authority})"

    @property
    def authority(self) -> str:
        """`host:port`, without the user and the password."""
        return _authority(self.host, self.port)


def parse_server(value: object) -> ServerUrl:
    """`mqtts://host`, with a port, and `wss://host/path`. Raises ValueError."""
    if isinstance(value, ServerUrl):
        return value
    what = "must be a URL such as mqtts://broker.example:8883 or wss://broker.example/mqtt"
    match = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", value) if isinstance(value, str) else None
    if match is None:
        raise ValueError(what)
    assert isinstance(value, str)
    scheme = match[1].lower()
    if scheme not in SCHEMES:
        other = _OTHER_NAMES.get(scheme)
        hint = f"; did you mean '{other}'?" if other else ""
        raise ValueError(f"knows {either(list(SCHEMES))}, not {scheme!r}{hint}")
    if "@" in value:
        raise ValueError("must not have a user in it: `login` has username and password_file")
    host, port, path = _split(value, what)
    if "?" in value or "#" in value:
        raise ValueError("must end with its path: without '?' and '#'")
    if scheme in ("ws", "wss"):
        path = path or _WEBSOCKET_PATH
    elif path not in ("", "/"):
        raise ValueError(f"has a path, {path}, which only ws and wss have")
    else:
        path = ""
    return ServerUrl(scheme, host, port or SCHEMES[scheme], path)


def parse_proxy(text: str) -> ProxyUrl:
    """`http://host:port`, with `user:password@` where the proxy asks. Raises ValueError."""
    what = "must be a URL such as http://proxy.example:3128"
    if not text.lower().startswith("http://"):
        raise ValueError(f"{what}; other kinds of proxies are not supported")
    credentials, at, _ = text[len("http://") :].rpartition("@")  # a password may have an @ in it
    host, port, path = _split(f"http://{text.rpartition('@')[2]}" if at else text, what)
    if path not in ("", "/") or "?" in text.rpartition("@")[2]:
        raise ValueError("must end with its port")
    username, colon, password = credentials.partition(":")
    return ProxyUrl(
        host,
        port or _PROXY_PORT,
        unquote(username) if at else None,
        unquote(password) if colon else None,
    )


def _split(url: str, what: str) -> tuple[str, int | None, str]:
    """The host, the port if there is one, and the path. Raises ValueError."""
    if not re.fullmatch(r"[!-~]*", url):  # urlsplit would leave line ends out
        raise ValueError("must not have spaces, nor other characters than ASCII has")
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError:  # such as a port that is no number, or an IPv6 address without its end
        raise ValueError(what) from None
    if not re.fullmatch(r"[A-Za-z0-9_.-]+|[0-9A-Fa-f:.]+(%\w+)?", host) or port == 0:
        raise ValueError(what)
    return host, port, parts.path


def _authority(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _check_proxy(value: str) -> str:
    parse_proxy(value)
    return value


Server = Annotated[ServerUrl, PlainValidator(parse_server), PlainSerializer(str, when_used="json")]

Proxy = Annotated[str, AfterValidator(_check_proxy)]
