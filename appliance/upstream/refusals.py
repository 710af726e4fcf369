"""What a fleet's broker refuses, in words, and what a person can do about it.

A reason code alone says little: mosquitto answers Not authorized to a wrong password, and to a
publication that its access rules do not allow. Which key of the section it is about depends on what
was refused. What the broker's answer leaves open is said as open.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from appliance.config.urls import ServerUrl
from appliance.mqtt.codec import V5, quote
from appliance.mqtt.reason import ReasonCode, connack_v311
from appliance.upstream.agreement import EndedBy, Ending
from appliance.upstream.rules import UpstreamSettings

#: Topic filters that a text names, at most.
SHOWN_FILTERS: Final = 8

#: Where only the broker knows why.
_ITS_LOG: Final = "the log of the fleet's broker says why"

#: What to do about a code, whatever was refused: of CONNACK and DISCONNECT.
_ADVICE: Final = {
    ReasonCode.UNSPECIFIED_ERROR: _ITS_LOG,
    ReasonCode.MALFORMED_PACKET: f'{_ITS_LOG}; does `version: "3.1.1"` help?',
    ReasonCode.PROTOCOL_ERROR: f'{_ITS_LOG}; does `version: "3.1.1"` help?',
    ReasonCode.IMPLEMENTATION_SPECIFIC_ERROR: _ITS_LOG,
    ReasonCode.SERVER_UNAVAILABLE: "it is dialled again",
    ReasonCode.SERVER_BUSY: "it is dialled again",
    ReasonCode.BANNED: "it has banned this client: ask who runs it",
    ReasonCode.SERVER_SHUTTING_DOWN: "it is dialled again",
    ReasonCode.KEEP_ALIVE_TIMEOUT: "nothing reached it for 1.5 keep_alive: is the network up?",
    ReasonCode.RECEIVE_MAXIMUM_EXCEEDED: "try a smaller window",
    ReasonCode.MESSAGE_RATE_TOO_HIGH: "it takes fewer messages a second: set rate",
    ReasonCode.QUOTA_EXCEEDED: "it allows no more of this user, or of all: ask who runs it",
    ReasonCode.ADMINISTRATIVE_ACTION: "somebody has disconnected it there",
    ReasonCode.USE_ANOTHER_SERVER: "servers names another one for now",
    ReasonCode.SERVER_MOVED: "write the new one to servers",
    ReasonCode.CONNECTION_RATE_EXCEEDED: "it is dialled again later",
    ReasonCode.MAXIMUM_CONNECT_TIME: "it is dialled again",
    ReasonCode.TOPIC_ALIAS_INVALID: _ITS_LOG,
}


def reason_words(code: int, version: int = V5) -> str:
    """A reason code as the standard names it; in 3.1.1 CONNACK has return codes of its own."""
    try:
        name = ReasonCode(code).name.replace("_", " ").capitalize().replace("Qos", "QoS")
    except ValueError:
        return f"0x{code:02x}"
    if version != V5:
        return f"{name} (return code {connack_v311(code)})"
    return f"0x{code:02x} {name}"


def ending_advice(
    ending: Ending, settings: UpstreamSettings, server: ServerUrl, client_id: str
) -> str:
    """What a person can do after a connection has ended so; empty where there is nothing."""
    if ending.by is EndedBy.US:
        return ""
    if ending.by is EndedBy.NETWORK:
        # TLS 1.3 refuses a certificate after the handshake, and has said so.
        is_said = not ending.is_new or "certificate" in ending.text
        return "" if is_said else _unanswered(settings, server)
    code = ending.code
    if ending.refused:
        advice = _login_advice(code, settings, client_id)
    else:
        advice = _disconnect_advice(code, settings, client_id)
    return advice or _ADVICE.get(code, _ITS_LOG)


def unanswered_filters(filters: Sequence[str]) -> str:
    """The broker has closed the connection in place of an answer to SUBSCRIBE.

    RabbitMQ does that to a login that may not subscribe to one of the filters.
    """
    shown = ", ".join(map(quote, filters[:SHOWN_FILTERS]))
    return f"it has answered nothing to SUBSCRIBE: may this login subscribe to {shown}?"


def unanswered_state(settings: UpstreamSettings) -> str:
    """The broker has closed the connection in place of an answer to the state of the robot."""
    topic = quote(settings.state_there)
    return f"it has answered nothing to the robot's state: may this login publish to {topic}?"


def _unanswered(settings: UpstreamSettings, server: ServerUrl) -> str:
    """The connection has ended, and nothing has answered CONNECT."""
    if server.websocket:
        return "it has answered nothing to the login; is MQTT at this path?"
    text = "it has answered nothing to the login; is the port one for "
    text += "a WebSocket (wss://)?" if server.tls else "TLS (mqtts://) or a WebSocket (ws://)?"
    if server.tls and settings.tls.certificate is None:
        text += " Does it want a client certificate (tls.certificate and tls.key)?"
    if settings.version == V5:
        text += ' Some brokers that do not know MQTT 5 close so: then set version: "3.1.1"'
    return text


def _login_advice(code: int, settings: UpstreamSettings, client_id: str) -> str:
    """About a refusal in CONNACK."""
    login = settings.login
    named = quote(client_id)
    if code in (ReasonCode.BAD_USER_NAME_OR_PASSWORD, ReasonCode.NOT_AUTHORIZED):
        shown = _credentials(settings)
        if not shown:
            return "the section has no login: set login.username and login.password_file"
        if code == ReasonCode.BAD_USER_NAME_OR_PASSWORD:
            return f"it does not know {shown}"
        return f"it does not know {shown}, or does not let this login use the client id {named}"
    if code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID:
        return f"it does not take the client id {named}: set client_id to one that it allows"
    if code == ReasonCode.UNSUPPORTED_PROTOCOL_VERSION:
        other = "5" if settings.version != V5 else "3.1.1"
        return f'set version: "{other}"'
    if code == ReasonCode.BAD_AUTHENTICATION_METHOD:
        if login.method is None:
            return "it wants another kind of login: login.method and login.token_file"
        return f"it does not take login.method {quote(login.method)}"
    will = f"of the will, {quote(settings.state_there)} (prefix)"
    if code == ReasonCode.TOPIC_NAME_INVALID:
        return f"it does not allow the topic {will}"
    if code in (ReasonCode.RETAIN_NOT_SUPPORTED, ReasonCode.QOS_NOT_SUPPORTED):
        return "it does not take the will; does it need another `kind`?"
    if code == ReasonCode.PACKET_TOO_LARGE:
        return "it takes no CONNECT of this size: are the login's files too long?"
    return ""


def _credentials(settings: UpstreamSettings) -> str:
    """What the link has logged in with, and the keys that say so; empty if with nothing."""
    login, tls = settings.login, settings.tls
    if login.username is None and login.token_file is None:
        if tls.certificate is None:
            return ""
        return f"the certificate in {tls.certificate} (tls.certificate) without a login"
    parts = []
    if login.username is not None:
        parts.append(f"the user {quote(login.username)} (login.username)")
    if login.token_file is not None:
        parts.append(f"the token in {login.token_file} (login.token_file)")
    elif login.password_file is not None:
        parts.append(f"the password in {login.password_file} (login.password_file)")
    else:
        parts.append("no password (login.password_file)")
    return " and ".join(parts)


def _disconnect_advice(code: int, settings: UpstreamSettings, client_id: str) -> str:
    """About a DISCONNECT."""
    if code == ReasonCode.SESSION_TAKEN_OVER:
        return (
            f"another client has logged in as {quote(client_id)}: each needs a client_id of its own"
        )
    if code == ReasonCode.NOT_AUTHORIZED:
        return (
            "its access rules do not allow what the link sends or subscribes to below "
            f"{quote(settings.prefix)} (prefix), or the login is not valid any more"
        )
    if code == ReasonCode.PACKET_TOO_LARGE:
        return "it does not take messages of this size"
    return ""


def subscription_advice(code: int, settings: UpstreamSettings, topic_filter: str) -> str:
    """What a person can do about a refused subscription."""
    if topic_filter.startswith(settings.answers_there):
        what = "calls of the robot are not answered from there"
    else:
        what = "its rule in `in` receives nothing"
    if code in (ReasonCode.NOT_AUTHORIZED, ReasonCode.UNSPECIFIED_ERROR):  # the latter: 3.1.1
        return f"{what}: the access rules there have to let {_who(settings)} read it"
    if code == ReasonCode.QUOTA_EXCEEDED:
        return f"{what}: it allows this client no more subscriptions"
    if code == ReasonCode.WILDCARD_SUBSCRIPTIONS_NOT_SUPPORTED:
        return f"{what}: it knows no wildcards, so name each topic"
    if code == ReasonCode.TOPIC_FILTER_INVALID:
        return f"{what}: it does not allow such a topic; see prefix and remote_prefix"
    return f"{what}: {_ITS_LOG}"


def message_advice(code: int, settings: UpstreamSettings, topic: str) -> str:
    """What a person can do about a refused message; empty where there is nothing."""
    if code == ReasonCode.NOT_AUTHORIZED:
        return f"let {_who(settings)} write {quote(topic)} there"
    if code == ReasonCode.TOPIC_NAME_INVALID:
        return "it does not allow this topic; see prefix and remote_prefix"
    return ""


def state_advice(code: int, settings: UpstreamSettings) -> str:
    """What a person can do when the link may not say that the robot is online."""
    what = "the fleet does not see that the robot is online"
    if code == ReasonCode.NOT_AUTHORIZED:
        return f"{what}: the access rules there have to let {_who(settings)} write it (prefix)"
    if code == ReasonCode.PACKET_TOO_LARGE:
        return f"{what}: the fleet's broker has to take larger packets"
    return f"{what}: {_ITS_LOG}"


def _who(settings: UpstreamSettings) -> str:
    username = settings.login.username
    return "this client" if username is None else f"the user {quote(username)}"
