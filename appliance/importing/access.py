"""Users, access rules, and who may come in without a name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from appliance.access import AccessFileError, Acl, check_hash, check_username
from appliance.access.problems import read_text
from appliance.importing.model import Configuration, Listener
from appliance.importing.notes import ImportProblemsError, Notes, Place
from appliance.importing.reading import Statement, locate

_EVERYTHING = """\
# mosquitto.conf names no acl_file: whoever is let in may read and write every topic.
pattern readwrite #
pattern read $SYS/#
"""

_NOTHING = """\
# Nothing is allowed yet. What nothing here allows is refused.
# docs/conventions.md has the grammar, which is mosquitto's. For example:
#user alice
#topic read {robot}/#
"""

_ANONYMOUS = """\
# Clients without a name: they come in at listeners for which mosquitto.conf names no acl_file.
topic readwrite #
topic read $SYS/#

"""


@dataclass(frozen=True, slots=True)
class Access:
    """The text of both files, and whether anonymous clients come in: in general, and by listener.

    In `by_listener` only those are listed that differ from `anonymous`.
    """

    users: str
    names: tuple[str, ...]
    acl: str
    anonymous: bool
    by_listener: dict[int, bool]


def convert(
    configuration: Configuration, listeners: list[Listener], directory: Path, notes: Notes
) -> Access:
    """The access of these listeners. Raises ImportProblemsError for a wrong ACL file."""
    return _Converter(configuration, listeners, directory, notes).convert()


class _Converter:
    def __init__(
        self, configuration: Configuration, listeners: list[Listener], directory: Path, notes: Notes
    ) -> None:
        self._configuration = configuration
        self._listeners = listeners
        self._directory = directory
        self._notes = notes
        self._plugin = configuration.plugin()

    def convert(self) -> Access:
        anonymous = {index: self._is_anonymous(each) for index, each in enumerate(self._listeners)}
        passwords = self._one_of("password_file")
        rules = self._one_of("acl_file")
        users, names = self._users(passwords)
        acl = self._acl(rules, anonymous)
        if not names and not all(anonymous.values()):
            self._tell_of_nobody()
        securities = [self._configuration.security(each) for each in self._listeners]
        if any(
            anonymous[index] and each.get("password_file") is None
            for index, each in enumerate(securities)
        ):
            self._tell_of_strangers()
        overall = self._configuration.general.flag(
            "allow_anonymous", self._configuration.local_only
        )
        if self._configuration.per_listener:
            overall = False
        differing = {index: each for index, each in anonymous.items() if each != overall}
        return Access(users, tuple(names), acl, overall, differing)

    def _is_anonymous(self, listener: Listener) -> bool:
        own = listener.get("listener_allow_anonymous")
        if own is not None:
            return own.flag
        security = self._configuration.security(listener)
        return security.flag("allow_anonymous", self._configuration.local_only)

    def _one_of(self, option: str) -> Statement | None:
        """The file that counts; listeners that name another one are not among these."""
        blocks = [self._configuration.security(each) for each in self._listeners]
        return next((named for each in blocks if (named := each.get(option)) is not None), None)

    def _users(self, statement: Statement | None) -> tuple[str, list[str]]:
        if statement is None:
            return "# Users, user:hash, one a line: appliance user add NAME\n", []
        file = self._text(statement) or ""
        name = Path(statement.value).name
        lines: dict[str, str] = {}
        for number, line in enumerate(file.split("\n"), 1):
            line = line.rstrip(" \t\r")
            if not line or line.startswith("#"):
                continue
            user, _, stored = line.partition(":")
            place = Place(name, number)
            try:
                check_username(user)
            except ValueError as error:
                self._notes.add(place, "a user", f"left out: {error}", to_do=True)
                continue
            if lines.pop(user, None) is not None:
                self._notes.add(place, f"user {user!r}", "is there twice: the last one counts")
            try:
                check_hash(stored, user)
            except ValueError as error:
                why = str(error).partition(";")[0]
                text = f"needs a new password ({why}): appliance user add {user}"
                self._notes.add(place, f"user {user!r}", text, to_do=True)
                continue
            lines[user] = f"{line}\n"
        return "".join(lines.values()) or "# appliance user add NAME\n", list(lines)

    def _acl(self, statement: Statement | None, anonymous: dict[int, bool]) -> str:
        if statement is None:
            if self._plugin is not None:
                text = "decided who may do what: nothing is allowed until acl.conf says so"
                self._notes.add(self._plugin.place, self._plugin.name, text, to_do=True)
                return _NOTHING
            text = "whoever is let in may write every topic, those that command ROS too"
            self._notes.add(Place(self._configuration.name, 0), "no acl_file", text)
            return _EVERYTHING
        path = locate(statement.value, self._directory)
        rules = self._text(statement)
        if path is None or rules is None:
            return _NOTHING
        try:
            Acl.load(path, "robot")
        except AccessFileError as error:
            raise ImportProblemsError(
                [(Place(path.name, each.line), each.message) for each in error.problems]
            ) from None
        rules = rules if rules.endswith("\n") else f"{rules}\n"
        rules = self._without_control(rules, path.name)
        return self._with_anonymous(rules, statement, anonymous)

    def _without_control(self, text: str, name: str) -> str:
        """The rules without those on $CONTROL, which were about mosquitto's plugins.

        Here they would give the right to manage the appliance.
        """
        kept: list[str] = []
        for number, line in enumerate(text.splitlines(keepends=True), 1):
            words = line.split()
            if words[:1] in (["topic"], ["pattern"]) and words[-1].upper().startswith("$CONTROL"):
                why = "is left out: on $CONTROL the appliance is managed, docs/management.md"
                self._notes.add(Place(name, number), line.strip(), why)
                line = f"# {line}"
            kept.append(line)
        return "".join(kept)

    def _with_anonymous(self, text: str, rules: Statement, anonymous: dict[int, bool]) -> str:
        """The rules, of which those for anonymous clients are of the listeners that have some."""
        if not self._configuration.per_listener:
            return text
        own: list[int] = []
        free: list[int] = []
        for index, listener in enumerate(self._listeners):
            named = listener.get("acl_file")
            if not anonymous[index]:
                if named is None and listener.get("password_file") is not None:
                    why = f"{listener} has no acl_file; its users have the rules of {rules.place}"
                    self._notes.add(listener.place, "acl_file", why)
                continue
            if named is None:
                free.append(index)
            else:
                own.append(index)
        if not free:
            return text
        if own or self._plugin is not None:
            for index in free:
                self._refuse(index, anonymous, "has no acl_file, and other listeners have")
            return text
        return _ANONYMOUS + _without_anonymous(text)

    def _refuse(self, index: int, anonymous: dict[int, bool], why: str) -> None:
        listener = self._listeners[index]
        text = (
            f"{listener} {why}: as anonymous clients have the same rules everywhere here, it lets "
            "none in; give them a user"
        )
        self._notes.add(listener.place, "allow_anonymous", text, to_do=True)
        anonymous[index] = False

    def _text(self, statement: Statement) -> str | None:
        """The text of a file; None, with a note, where it cannot be read."""
        path = locate(statement.value, self._directory)
        if path is not None and path.is_file():
            try:
                return read_text(path, "")
            except AccessFileError as error:
                why = error.problems[0].message.partition(";")[0]
        else:
            why = "there is no such file here"
        text = f"{statement.value} is not carried over: {why}; put it there, and import again"
        self._notes.add(statement.place, statement.name, text, to_do=True)
        return None

    def _tell_of_nobody(self) -> None:
        by_certificate = any(each.flag("use_identity_as_username") for each in self._listeners)
        if not by_certificate and self._listeners:
            text = "nobody can log in yet: appliance user add NAME"
            self._notes.add(Place("users.passwd", 0), "no user", text, to_do=True)

    def _tell_of_strangers(self) -> None:
        text = (
            "who gives a user name is checked here: mosquitto lets every name in where it has no "
            "password_file; such clients have to leave the name out, or become users"
        )
        blocks = (self._configuration.general, *self._listeners)
        found = (each.get("allow_anonymous", "listener_allow_anonymous") for each in blocks)
        place = next((each.place for each in found if each), Place(self._configuration.name, 0))
        self._notes.add(place, "allow_anonymous", text)


def _without_anonymous(text: str) -> str:
    """The rules without `topic` lines before the first user, which have applied to nobody."""
    kept: list[str] = []
    is_before = True
    for line in text.splitlines(keepends=True):
        words = line.split()
        is_before = is_before and words[:1] != ["user"]
        if not (is_before and words[:1] == ["topic"]):
            kept.append(line)
    return "".join(kept)


def named_in(acl: str) -> set[str]:
    """The users that the rules name."""
    lines = (line.split(None, 1) for line in acl.splitlines())
    return {words[1].strip() for words in lines if len(words) == 2 and words[0] == "user"}
