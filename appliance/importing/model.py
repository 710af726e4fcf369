"""A mosquitto configuration as it is meant: general options, listeners, and bridges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from appliance.importing.notes import ImportProblemsError, Notes, Place
from appliance.importing.options import PLUGINS, option_of
from appliance.importing.reading import Statement, words

DEFAULT_PORT = 1883

# Of listeners, and of bridges: with more the file was made by mistake.
_MAX_BLOCKS = 1000
_MAX_HOST = 255

_NOWHERE = Place("", 0)


@dataclass
class Block:
    """Statements that belong together; of an option that is there twice the last counts."""

    statements: list[Statement] = field(default_factory=list)

    def named(self, *names: str) -> list[Statement]:
        """All statements of these names."""
        return [each for each in self.statements if each.name in names]

    def get(self, *names: str) -> Statement | None:
        """The last statement of these names."""
        found = self.named(*names)
        return found[-1] if found else None

    def flag(self, name: str, default: bool = False) -> bool:
        """The value of a flag."""
        statement = self.get(name)
        return default if statement is None else statement.flag


@dataclass
class Listener(Block):
    """A listener; `host` is empty for all addresses, and `path` is that of a Unix socket."""

    place: Place = _NOWHERE
    port: int = DEFAULT_PORT
    host: str = ""
    path: str = ""

    @property
    def is_tls(self) -> bool:
        """Whether it has a certificate."""
        return self.get("certfile") is not None and self.get("keyfile") is not None

    @property
    def names_by_certificate(self) -> bool:
        """Whether the common name of a certificate is the user; without TLS it never is."""
        return self.is_tls and self.flag("use_identity_as_username")

    @property
    def is_websocket(self) -> bool:
        """Whether it takes MQTT over WebSocket."""
        protocol = self.get("protocol")
        return protocol is not None and protocol.value == "websockets"

    def __str__(self) -> str:
        return f"listener {self.path or self.port}"


@dataclass
class Bridge(Block):
    """A connection to another broker."""

    place: Place = _NOWHERE
    name: str = ""


@dataclass
class Configuration:
    """All of the main file `name`; `local_only`: it names no listener, and has one on loopback."""

    name: str
    general: Block
    listeners: list[Listener]
    bridges: list[Bridge]
    per_listener: bool
    local_only: bool

    def security(self, listener: Listener) -> Block:
        """Where the options of access of that listener are."""
        return listener if self.per_listener else self.general

    def is_anonymous(self, listener: Listener) -> bool:
        """Whether that listener lets in clients without a user name."""
        own = listener.get("listener_allow_anonymous")
        if own is not None:
            return own.flag
        return self.security(listener).flag("allow_anonymous", self.local_only)

    def plugin(self) -> Statement | None:
        """A plugin, if there is one."""
        blocks = (self.general, *self.listeners)
        return next((found for block in blocks for found in block.named(*PLUGINS)), None)


def assemble(statements: Iterable[Statement], name: str, notes: Notes) -> Configuration:
    """Sort the statements of the main file `name` into blocks. Raises ImportProblemsError."""
    sorter = _Sorter(notes)
    for statement in statements:
        sorter.add(statement)
    return sorter.finish(name)


class _Sorter:
    """Takes one statement after the other. Each file has its own current listener and bridge."""

    def __init__(self, notes: Notes) -> None:
        self._general = Block()
        self._default = Listener()
        self._named: list[Listener] = []
        self._bridges: list[Bridge] = []
        self._listener: dict[str, Listener] = {}
        self._bridge: dict[str, Bridge] = {}
        self._per_listener = False
        self._is_security_seen = False
        self._problems: list[tuple[Place, str]] = []
        self._notes = notes

    def add(self, statement: Statement) -> None:
        name, place = statement.name, statement.place
        option = option_of(name)
        assert option is not None  # the reader has refused others
        if name == "listener":
            self._open_listener(statement)
        elif name == "connection":
            self._open_bridge(statement)
        elif name == "per_listener_settings":
            if statement.flag and self._is_security_seen and not self._per_listener:
                self._problems.append((place, f"{name} has to be before all options of access"))
            if self._per_listener and not statement.flag:
                text = f"{name} is true before: what is between would count for other listeners"
                self._problems.append((place, text))
            self._per_listener = self._per_listener or statement.flag
            self._general.statements.append(statement)
        elif option.scope == "bridge":
            bridge = self._bridge.get(place.file)
            if bridge is None:
                self._problems.append((place, f"{name} is before any `connection` in this file"))
            else:
                bridge.statements.append(statement)
        elif option.scope == "listener" or (option.scope == "security" and self._per_listener):
            self._listener.get(place.file, self._default).statements.append(statement)
        else:
            self._is_security_seen = self._is_security_seen or option.scope == "security"
            self._general.statements.append(statement)

    def finish(self, name: str) -> Configuration:
        has_default = self._default.get("port", "bind_address") is not None
        local_only = not has_default and not self._named
        if has_default:
            self._set_default_address()
        elif not local_only:
            self._tell_of_lost()
        if self._problems:
            raise ImportProblemsError(self._problems)
        listeners = [*([self._default] if has_default or local_only else []), *self._named]
        if local_only:
            self._default.host = "127.0.0.1"
        return Configuration(
            name, self._general, listeners, self._bridges, self._per_listener, local_only
        )

    def _open_listener(self, statement: Statement) -> None:
        place = statement.place
        if len(self._named) >= _MAX_BLOCKS:
            self._problems.append((place, f"there are more than {_MAX_BLOCKS} listeners"))
            return
        port, *rest = words(statement.value) or [""]
        listener = Listener(place=place)
        if not port.isdecimal() or not port.isascii() or len(port) > 5 or int(port) > 65535:
            self._problems.append((place, f"listener begins with a port, not {port[:20]!r}"))
        elif int(port) == 0 and not rest:
            self._problems.append((place, "listener 0 needs the path of a Unix socket"))
        elif int(port) == 0:
            listener.port, listener.path = 0, rest[0]
        else:
            listener.port, listener.host = int(port), rest[0] if rest else ""
            if len(listener.host) > _MAX_HOST:
                text = f"listener has an address of {len(listener.host)} characters"
                self._problems.append((place, text))
        self._named.append(listener)
        self._listener[place.file] = listener

    def _open_bridge(self, statement: Statement) -> None:
        if len(self._bridges) >= _MAX_BLOCKS:
            text = f"there are more than {_MAX_BLOCKS} connections"
            self._problems.append((statement.place, text))
            return
        if any(bridge.name == statement.value for bridge in self._bridges):
            text = f"there are two connections {statement.value}"
            self._problems.append((statement.place, text))
        bridge = Bridge(place=statement.place, name=statement.value)
        self._bridges.append(bridge)
        self._bridge[statement.place.file] = bridge

    def _set_default_address(self) -> None:
        default = self._default
        for statement in default.named("port", "bind_address"):
            default.place = statement.place
            if statement.name == "bind_address":
                default.host = statement.value
            elif 1 <= statement.number <= 65535:
                default.port = statement.number
            else:
                self._problems.append((statement.place, f"there is no port {statement.value}"))

    def _tell_of_lost(self) -> None:
        """Options before the first listener: of a default listener that nobody has asked for."""
        for statement in self._default.statements:
            text = (
                "is before any `listener`, and so counts for none of them: put it below the "
                "`listener` that is meant"
            )
            self._notes.add(statement.place, statement.name, text, to_do=True)
