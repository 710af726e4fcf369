"""Views of sessions and retained messages for amqtt's plugins, created on access."""

from __future__ import annotations

import ssl
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from typing import cast

from amqtt.broker import RetainedApplicationMessage
from amqtt.session import Session as AmqttSession

from appliance.broker.broker import Broker
from appliance.broker.client import ClientHandler
from appliance.broker.message import Message
from appliance.broker.output import Output
from appliance.broker.session import Session
from appliance.broker.values import Identity
from appliance.mqtt.codec import V5, Property
from appliance.mqtt.packets import Connect


class UnclaimedIdentity(Identity):
    """The owner of a session that a plugin has created for a client that is not there.

    The first client that logs in with its id becomes its owner.
    """

    __slots__ = ()


def _split(address: str) -> tuple[str, int]:
    """The host and port of a connection; of a Unix socket the path and the connection's number."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def view_of_login(
    connect: Connect, address: str, password: str | None, ssl_object: ssl.SSLObject | None
) -> AmqttSession:
    """The session object that plugins are shown for a login that is not decided yet."""
    login = AmqttSession()
    login.client_id = connect.client_id
    login.username = connect.username
    login.password = password
    login.remote_address, login.remote_port = _split(address)
    login.ssl_object = ssl_object
    login.keep_alive = connect.keep_alive
    login.clean_session = connect.clean_start
    if connect.version == V5:  # amqtt means 3.1.1's: nothing is stored
        login.clean_session = not (connect.properties or {}).get(Property.SESSION_EXPIRY_INTERVAL)
    login.will_qos, login.will_retain = 0, False
    if connect.will is not None:
        will = connect.will
        login.will_flag, login.will_topic, login.will_message = True, will.topic, will.payload
        login.will_qos, login.will_retain = will.qos, will.retain
    return login


def _view_of(session: Session) -> AmqttSession:
    """The view of a session whose login plugins have not seen."""
    view = AmqttSession()
    view.client_id = session.client_id
    view.username = session.identity.username if session.identity else None
    view.is_anonymous = view.username is None
    view.clean_session = not session.persistent
    if isinstance(session.link, Output):
        view.remote_address, view.remote_port = _split(session.link.transport.address)
    if session.will is not None:
        will = session.will.message
        view.will_flag, view.will_topic, view.will_message = True, will.topic, will.payload
        view.will_qos, view.will_retain = will.qos, will.retain
    return view


class SessionViews(Mapping[str, tuple[AmqttSession, None]]):
    """The sessions of all network clients by client id, each without a protocol handler.

    amqtt's objects are large (24 KB), so they are created on access.
    """

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self._known: dict[str, tuple[Session, AmqttSession]] = {}
        self._logins: dict[str, AmqttSession] = {}

    def __getitem__(self, client_id: str) -> tuple[AmqttSession, None]:
        session = self._broker.sessions[client_id]
        if session.is_inside:
            raise KeyError(client_id)
        return self.of(session), None

    def __setitem__(self, client_id: str, session: object) -> None:
        """Ignored: BrokerContext sets what `create_offline_session` has created here already."""

    def __iter__(self) -> Iterator[str]:
        for client_id in list(self._broker.sessions):
            if client_id in self:  # sessions may end during the iteration
                yield client_id

    def __contains__(self, client_id: object) -> bool:
        session = self._broker.sessions.get(cast(str, client_id))
        return session is not None and not session.is_inside

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def of(self, session: Session) -> AmqttSession:
        """amqtt's object of the session: the last login that plugins saw, updated."""
        known = self._known.get(session.client_id)
        before = known[1] if known is not None and known[0] is session else None
        view = self._claim_login(session) or before or _view_of(session)
        if view is not before:
            if before is not None:  # the session is resumed: the plugins' attributes stay
                view.parent = 1
                view.attributes = before.attributes | view.attributes
            self._known[session.client_id] = session, view
        state = view.transitions.state
        if session.link is not None and state != "connected":
            view.transitions.connect()
        elif session.link is None and state != "disconnected":
            view.transitions.disconnect()
        return view

    def _claim_login(self, session: Session) -> AmqttSession | None:
        """Take the stored login of the session's connection, if there is one."""
        link, identity = session.link, session.identity
        login = self._logins.pop(link.transport.address, None) if isinstance(link, Output) else None
        # An address may have been reused by another client.
        if (
            login is None
            or identity is None
            or login.client_id not in ("", session.client_id)
            or identity.username not in (None, login.username)
        ):
            return None
        login.client_id = session.client_id
        return login

    def of_identity(self, identity: Identity) -> AmqttSession:
        """amqtt's object of the client's session, also while it is ending."""
        session = self._broker.sessions.get(identity.client_id)
        if session is not None and session.identity == identity:
            return self.of(session)
        known = self._known.get(identity.client_id)
        if known is not None and known[0].identity == identity:
            return known[1]
        view = AmqttSession()
        view.client_id, view.username = identity.client_id, identity.username
        return view

    def remember_login(self, address: str, login: AmqttSession) -> None:
        """Store what plugins saw of the login of the client at this address."""
        self._logins[address] = login

    def purge(self) -> None:
        """Remove the objects of sessions and connections that have ended."""
        for client_id, (session, _) in list(self._known.items()):
            if self._broker.sessions.get(client_id) is not session:
                del self._known[client_id]
        clients = (client for client in self._broker.clients if isinstance(client, ClientHandler))
        addresses = {client.transport.address for client in clients}
        for address in self._logins.keys() - addresses:
            del self._logins[address]


def retained_message(source: AmqttSession | None, message: Message) -> RetainedApplicationMessage:
    """amqtt's object of a retained message, with the publisher's session if known."""
    return RetainedApplicationMessage(source, message.topic, message.payload, message.qos)


class RetainedMessageViews(MutableMapping[str, RetainedApplicationMessage]):
    """The retained messages by topic. Changes made here fire no events."""

    def __init__(self, broker: Broker, retain: Callable[[str, bytes, int | None], None]) -> None:
        self._broker = broker
        self._retain = retain

    def __getitem__(self, topic: str) -> RetainedApplicationMessage:
        message = self._broker.retained.get(topic)
        if message is None:
            raise KeyError(topic)
        return retained_message(None, message)

    def __setitem__(self, topic: str, message: RetainedApplicationMessage) -> None:
        self._retain(topic, bytes(message.data), message.qos)

    def __delitem__(self, topic: str) -> None:
        if self._broker.retained.get(topic) is None:
            raise KeyError(topic)
        self._retain(topic, b"", 0)

    def __iter__(self) -> Iterator[str]:
        for topic_filter in ("#", "$SYS/#"):
            for topic, _ in list(self._broker.retained.find(topic_filter)):
                yield topic

    def __len__(self) -> int:
        return sum(1 for _ in self)
