"""Listeners and their TLS, as `broker.listeners` and `broker.tls` of appliance.yaml."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from appliance.broker.limits import Anonymous
from appliance.importing.model import Block, Configuration, Listener
from appliance.importing.notes import ImportProblemsError, Notes
from appliance.importing.options import OPTIONS
from appliance.importing.reading import Statement, locate

_TLS_FILES = {"certfile": "certificate", "keyfile": "key", "cafile": "ca", "crlfile": "crl"}
_VERSIONS = {"tlsv1.2": "1.2", "tlsv1.3": "1.3"}
#: A listener with one of these would let in, or mix up, whom mosquitto keeps apart.
_LEFT_OUT = (
    "psk_hint",
    "mount_point",
    "enable_proxy_protocol",
    "use_subject_as_username",
    "use_username_as_clientid",
)


def carried(configuration: Configuration, notes: Notes) -> list[Listener]:
    """The listeners that have a counterpart; the others are noted."""
    kept = []
    for listener in configuration.listeners:
        protocol = listener.get("protocol")
        reasons = [each for each in listener.named(*_LEFT_OUT) if not _is_off(each)]
        if protocol is not None and protocol.value == "http_api":
            text = f"{listener} is left out: the appliance's HTTP is `protocol: web`, docs/http.md"
            notes.add(protocol.place, "protocol", text)
        elif listener.get("certfile") is None and listener.get("keyfile") is not None:
            text = f"{listener} has a keyfile and no certfile: it is left out"
            notes.add(listener.place, "keyfile", text, to_do=True)
        elif listener.get("keyfile") is None and listener.get("certfile") is not None:
            text = f"{listener} has a certfile and no keyfile: it is left out"
            notes.add(listener.place, "certfile", text, to_do=True)
        elif not reasons and not _is_closed(
            listener, configuration, notes
        ):  # these are noted as all options without a counterpart
            kept.append(listener)
    return [each for each in kept if not _is_apart(each, kept, configuration, notes)]


def _is_off(statement: Statement) -> bool:
    return OPTIONS[statement.name].kind == "flag" and not statement.flag


#: What says whom a certificate lets in, and the files of users and rules: one for all listeners.
_BY_CERTIFICATE = (
    "cafile",
    "capath",
    "crlfile",
    "use_identity_as_username",
)
_BY_FILES = ("password_file", "acl_file")


def _is_apart(
    listener: Listener, kept: list[Listener], configuration: Configuration, notes: Notes
) -> bool:
    """Whether the listener lets in others, or gives them other rights, than one before it. It is
    left out then: with that one's settings it could let in whom mosquitto keeps out."""
    if listener.flag("require_certificate"):
        first = next(each for each in kept if each.flag("require_certificate"))
        for option in _BY_CERTIFICATE:
            if _value(listener, option) != _value(first, option):
                _leave_out(listener, first, option, notes)
                return True
    if not configuration.per_listener:
        return False
    for option in _BY_FILES:
        first = next((each for each in kept if each.get(option) is not None), listener)
        if listener.get(option) is not None and _value(listener, option) != _value(first, option):
            _leave_out(listener, first, option, notes)
            return True
    return False


def _is_closed(listener: Listener, configuration: Configuration, notes: Notes) -> bool:
    """Whether mosquitto lets nobody in there, and here users of other listeners would come in."""
    if listener.names_by_certificate:
        if listener.flag("require_certificate"):
            return False
        why = "it takes the user from a certificate, and asks for none (require_certificate)"
    elif (
        not configuration.per_listener
        or configuration.plugin() is not None
        or listener.get("password_file") is not None
        or configuration.is_anonymous(listener)
        or all(each.get("password_file") is None for each in configuration.listeners)
    ):
        return False
    else:
        why = "it has no users, and lets in nobody without a name"
    text = f"{listener} is left out: {why}, so that mosquitto lets in nobody there"
    notes.add(listener.place, str(listener), text)
    return True


def _value(listener: Listener, option: str) -> str | bool | None:
    statement = listener.get(option)
    if statement is None:
        return None
    if option.startswith("use_"):
        return statement.flag or None
    return statement.value


def _leave_out(listener: Listener, first: Listener, option: str, notes: Notes) -> None:
    statement = listener.get(option) or first.get(option)
    assert statement is not None
    text = (
        f"{listener} is left out: it is not the same for {first}, and the appliance has one for "
        "all listeners; add the listener to broker.listeners if that is what is meant"
    )
    notes.add(
        listener.place if listener.get(option) is None else statement.place,
        option,
        text,
        to_do=True,
    )


#: The versions of MQTT, by the numbers that `accept_protocol_versions` has for them.
_PROTOCOLS = {"3": "3.1", "4": "3.1.1", "5": "5"}


def section(
    listener: Listener, anonymous: Anonymous, general: Block, notes: Notes
) -> dict[str, Any]:
    """One entry of `broker.listeners`."""
    found: dict[str, Any] = {"bind": _bind(listener)}
    if listener.is_tls:
        found["tls"] = True
        required = listener.flag("require_certificate")
        found["client_certificates"] = "required" if required else "off"
        version = listener.get("tls_version")
        if version is not None:
            if version.value in _VERSIONS:
                found["min_version"] = _VERSIONS[version.value]
            else:
                text = "TLS before 1.2 is broken, and not spoken: devices that need it stay out"
                notes.add(version.place, version.name, text)
        ciphers = listener.get("ciphers")
        if ciphers is not None:
            found["ciphers"] = ciphers.value
    if listener.is_websocket:
        found["protocol"] = "websocket"
        text = "clients connect to the path /mqtt, where mosquitto takes any path"
        protocol = listener.get("protocol")
        notes.add(protocol.place if protocol else listener.place, "protocol websockets", text)
    if anonymous is not None:
        found["anonymous"] = anonymous
    found |= _terms(listener, general)
    if listener.path:
        text = "who may open the socket is said by its `mode`: 0660 lets its user and group"
        notes.add(listener.place, str(listener), text)
    return found


def _terms(listener: Listener, general: Block) -> dict[str, Any]:
    """What it admits; of `general` what mosquitto has for all listeners."""
    found: dict[str, Any] = {}
    max_qos = listener.get("max_qos", "maximum_qos")
    if max_qos is not None and max_qos.number < 2:
        found["max_qos"] = max_qos.number
    if not general.flag("retain_available", True):
        found["retain"] = False
    prefix = general.get("clientid_prefixes")
    if prefix is not None:
        found["client_id_prefixes"] = [prefix.value]
    versions = listener.get("accept_protocol_versions")
    if versions is not None:
        numbers = [each.strip() for each in versions.value.split(",")]
        wrong = next((each for each in numbers if each not in _PROTOCOLS), None)
        if wrong is not None:
            text = f"accept_protocol_versions has 3, 4 and 5, with commas, not {wrong[:20]!r}"
            raise ImportProblemsError([(versions.place, text)])
        if set(numbers) != set(_PROTOCOLS):
            found["protocol_versions"] = [_PROTOCOLS[each] for each in sorted(set(numbers))]
    return found


def _bind(listener: Listener) -> str:
    if listener.path:
        return f"unix:{listener.path}"
    host = listener.host
    if listener.get("bind_interface") is not None:
        host = "127.0.0.1"
    domain = listener.get("socket_domain")
    if not host and domain is not None:
        host = "0.0.0.0" if domain.value == "ipv4" else "::"
    return f"[{host}]:{listener.port}" if ":" in host else f"{host}:{listener.port}"


def tls(listeners: list[Listener], directory: Path, notes: Notes) -> dict[str, Any]:
    """The section `broker.tls`: of the first listener with TLS, as there is one for all."""
    secure = [listener for listener in listeners if listener.is_tls]
    if not secure:
        return {}
    found: dict[str, Any] = {}
    first = secure[0]
    for option, key in _TLS_FILES.items():
        # Who is trusted matters where certificates are asked for.
        owner = next((each for each in secure if each.flag("require_certificate")), first)
        chosen = (owner if option in ("cafile", "crlfile") else first).get(option)
        if chosen is not None:
            _add_file(chosen, key, found, directory, notes)
        for listener in secure:
            other = listener.get(option)
            if other is None or (chosen is not None and other.value == chosen.value):
                continue
            text = f"{OPTIONS[option].text} is one for all listeners"
            said = f"{text}, that of {chosen.place}" if chosen else text
            notes.add(other.place, option, f"{said}: this one is not carried over")
    required = next((each for each in secure if each.flag("require_certificate")), None)
    if required is not None and "ca" not in found:
        text = (
            f"{required} requires certificates, and no file says whose: name one with the CA's as "
            "broker.tls.ca"
        )
        notes.add(required.place, "require_certificate", text, to_do=True)
    found |= _username(secure, notes)
    return found


def _add_file(
    statement: Statement, key: str, found: dict[str, Any], directory: Path, notes: Notes
) -> None:
    path = locate(statement, directory, notes)
    if path is None:
        made = " (`appliance init` makes one of its own)" if key in ("certificate", "key") else ""
        text = f"there is no file {statement.value} here that can be read: put it there, and name "
        text += f"it as broker.tls.{key}{made}"
        notes.add(statement.place, statement.name, text, to_do=True)
        if key == "crl":  # without the file nothing starts: with it some might be kept out
            found[key] = str((directory / statement.value).absolute())
        return
    found[key] = str(path.absolute())


def _username(secure: list[Listener], notes: Notes) -> dict[str, Any]:
    by_certificate = [each for each in secure if each.names_by_certificate]
    for listener in by_certificate:
        statement = listener.get("use_identity_as_username")
        assert statement is not None
        text = (
            "who gives another user name than its certificate's is refused: mosquitto takes no "
            "notice of it"
        )
        notes.add(statement.place, statement.name, text)
    # All that require certificates say the same, and the others do not say so, see `carried`.
    return {"username_from": "subject"} if by_certificate else {}


def without_counterpart(block: Block, notes: Notes) -> None:
    """Note the options of a block that have none."""
    for statement in block.statements:
        option = OPTIONS.get(statement.name)
        if option is not None and option.fate == "none" and statement.value not in option.same:
            notes.add(statement.place, statement.name, option.text)
