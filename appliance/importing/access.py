"""Users, access rules, and who may come in without a name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from appliance.access import AccessFileError, check_hash, check_username
from appliance.access.problems import read_text
from appliance.broker.limits import Anonymous
from appliance.importing import rules
from appliance.importing.model import Configuration, Listener
from appliance.importing.notes import Notes, Place
from appliance.importing.reading import Statement, locate

_EVERYTHING = """\
# mosquitto.conf names no acl_file: whoever is let in may read and write every topic.
topic readwrite #
topic read $SYS/#
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
    by_listener: dict[int, Anonymous]


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
        anonymous = {
            index: self._configuration.is_anonymous(each)
            for index, each in enumerate(self._listeners)
        }
        passwords = self._one_of("password_file")
        acl_file = self._one_of("acl_file")
        users, names = self._users(passwords)
        acl = self._acl(acl_file, anonymous)
        if not names and not all(anonymous.values()):
            self._tell_of_nobody()
        for index, listener in enumerate(self._listeners):
            if (
                anonymous[index]
                and not listener.names_by_certificate
                and not self._takes_any_name(listener)
            ):
                self._tell_of_strangers(listener)
        overall = self._configuration.general.flag(
            "allow_anonymous", self._configuration.local_only
        )
        if self._configuration.per_listener:
            overall = False
        if self._configuration.local_only and not overall:
            self._tell_of_local()
        differing: dict[int, Anonymous] = {
            index: each for index, each in anonymous.items() if each != overall
        }
        differing |= {
            index: "always"
            for index, each in enumerate(self._listeners)
            if anonymous[index] and self._takes_any_name(each)
        }
        return Access(users, tuple(names), acl, overall, differing)

    def _takes_any_name(self, listener: Listener) -> bool:
        """Whether clients of that listener, where anonymous ones come in, may give any user name.

        With rules the name decides in mosquitto what they may do, though nobody has checked it.
        """
        security = self._configuration.security(listener)
        return (
            self._plugin is None
            and security.get("password_file") is None
            and security.get("acl_file") is None
            and not listener.names_by_certificate
        )

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
        found = self._text(statement)
        if found is None:
            return _NOTHING
        carried = rules.carry_over(found, Path(statement.value).name, self._notes)
        return self._with_anonymous(carried, statement, anonymous)

    def _with_anonymous(self, text: str, acl_file: Statement, anonymous: dict[int, bool]) -> str:
        """The rules, of which those for anonymous clients are of the listeners that have some."""
        if not self._configuration.per_listener:
            return text
        own: list[int] = []
        free: list[int] = []
        for index, listener in enumerate(self._listeners):
            named = listener.get("acl_file")
            if not anonymous[index]:
                if named is None and listener.get("password_file") is not None:
                    why = (
                        f"{listener} has no acl_file; its users have the rules of {acl_file.place}"
                    )
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
        return _ANONYMOUS + rules.without_anonymous(text)

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
        path = locate(statement, self._directory, self._notes)
        if path is not None:
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
        by_certificate = any(each.names_by_certificate for each in self._listeners)
        if not by_certificate and self._listeners:
            text = "nobody can log in yet: appliance user add NAME"
            self._notes.add(Place("users.passwd", 0), "no user", text, to_do=True)

    def _tell_of_local(self) -> None:
        """mosquitto 2.0 without a listener lets in whoever is on this computer."""
        statement = self._configuration.general.get("allow_anonymous")
        if statement is not None:
            text = "counts here: mosquitto 2.0 takes no notice of it where no listener is named"
            self._notes.add(statement.place, "allow_anonymous", text)

    def _tell_of_strangers(self, listener: Listener) -> None:
        security = self._configuration.security(listener)
        if security.get("password_file") is not None or self._plugin is not None:
            return
        text = (
            "who gives a user name is checked here: mosquitto believes any name where it has no "
            "password_file, and applies that user's rules; such clients have to leave the name "
            "out, or become users"
        )
        found = listener.get("listener_allow_anonymous") or security.get("allow_anonymous")
        place = found.place if found else Place(self._configuration.name, 0)
        self._notes.add(place, "allow_anonymous", text)
