"""A session inside the appliance that has an identity: the rights of a user, and none of a client's
limits, dangers or places."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from appliance.broker.broker import Broker
from appliance.broker.limits import Limits, UserLimits
from appliance.broker.link import InsideLink
from appliance.broker.message import Message
from appliance.broker.session import Session
from appliance.broker.sys_topics import SysTopics
from appliance.broker.values import Action, Decision, Identity
from appliance.mqtt.packets import Subscription
from appliance.mqtt.reason import ProtocolError, ReasonCode

from .conftest import FakeAccess, FakeStore, Join, Peer, lasting

NAME = "_upstream.fleet"


class Ear(InsideLink):
    """Keeps what it receives, and counts what it is told."""

    def __init__(self) -> None:
        self.received: list[tuple[str, bytes]] = []
        self.told = 0
        self.closed = 0

    def publish(
        self,
        message: Message,
        qos: int,
        packet_id: int,
        dup: bool,
        retain: bool,
        subscription_ids: list[int] | None,
    ) -> None:
        self.received.append((message.topic, message.payload))

    def rules_changed(self) -> None:
        self.told += 1

    def close(self, reason: ReasonCode, message: str) -> None:
        self.closed += 1


@pytest.fixture
def ear() -> Ear:
    return Ear()


@pytest.fixture
def inside(broker: Broker, ear: Ear) -> Iterator[Session]:
    session = broker.attach(NAME, ear, Identity("user", NAME))
    yield session
    if broker.sessions.get(NAME) is session:
        broker.detach(session)


class Audit:
    """Keeps the refusals that it is told."""

    def __init__(self) -> None:
        self.refusals: list[tuple[str, str, str]] = []

    def denied(self, session: Session, action: Action, topic: str, reason: str) -> None:
        self.refusals.append((str(session), action.value, topic))

    def connected(self, *args: object) -> None: ...

    def disconnected(self, *args: object) -> None: ...


@pytest.mark.parametrize("is_attached", [True, False])
def test_no_client_can_have_its_id(broker: Broker, ear: Ear, version: int, is_attached: bool):
    """Neither another user's nor one of the same user, and not while its link is down either."""
    session = broker.attach(NAME, ear, Identity("user", NAME))
    if not is_attached:
        broker.detach(session)
    for user in ("user", "mallory", None):
        answer = Peer(broker, version).connect(NAME, user=user)
        assert answer.reason_code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID
        assert not ear.closed
    assert broker.sessions == ({NAME: session} if is_attached else {})


def test_not_even_a_plugin_can_take_its_session(broker: Broker, inside: Session, ear: Ear):
    with pytest.raises(ProtocolError, match="is the appliance's own") as error:
        broker.connect(Ear(), Identity("user", NAME), clean_start=True, expiry=9, will=None)
    assert error.value.code == ReasonCode.CLIENT_IDENTIFIER_NOT_VALID
    assert broker.sessions[NAME] is inside and inside.link is ear and not ear.closed


def test_its_id_must_be_one_that_no_client_can_have(broker: Broker, inside: Session):
    for client_id, own in (("fleet", "fleet"), (NAME, "_other"), ("_other", NAME)):
        with pytest.raises(ValueError, match="client id"):
            broker.attach(client_id, Ear(), Identity("user", own))
    with pytest.raises(ValueError, match="already"):
        broker.attach(NAME, Ear(), Identity("user", NAME))
    assert set(broker.sessions) == {NAME}


def test_the_rules_hold_for_it(broker: Broker, join: Join, inside: Session, access: FakeAccess):
    """PUBLISH and SUBSCRIBE are refused, told in the audit log, and counted."""
    audit = broker.audit_log = Audit()  # type: ignore[assignment]
    access.deny("user", Action.PUBLISH, "secret/#")
    access.deny("user", Action.SUBSCRIBE, "secret/#")
    reader = join("reader", user="reader")
    reader.subscribe("#")
    assert broker.subscribe(inside, Subscription("open/#"))[0] == ReasonCode.SUCCESS
    code, reason = broker.subscribe(inside, Subscription("secret/x"))
    assert code == ReasonCode.NOT_AUTHORIZED and "is denied" in reason
    assert broker.publish(Message("secret/x", b"x"), inside) == ReasonCode.NOT_AUTHORIZED
    assert broker.publish(Message("$SYS/x", b"x"), inside) == ReasonCode.NOT_AUTHORIZED
    assert broker.publish(Message("open/x", b"x"), inside) == ReasonCode.SUCCESS
    broker.flush()
    assert [message.topic for message in reader.messages()] == ["open/x"]
    who = f"client '{NAME}' (user 'user')"
    assert audit.refusals == [
        (who, "subscribe", "secret/x"),
        (who, "publish", "secret/x"),
        (who, "publish", "$SYS/x"),
    ]
    assert broker.counters.publish_refused == 2


def test_narrowed_rules_end_what_it_receives_at_once(
    broker: Broker, join: Join, inside: Session, ear: Ear, access: FakeAccess
):
    broker.subscribe(inside, Subscription("a/#"))
    publisher = join("publisher")
    publisher.publish("a/b", b"1")
    assert (ear.received, ear.told) == ([("a/b", b"1")], 0)
    access.deny("user", Action.RECEIVE, "a/b")
    broker.rules_changed()
    publisher.publish("a/b", b"2")
    publisher.publish("a/c", b"3")
    assert ear.received == [("a/b", b"1"), ("a/c", b"3")]
    assert ear.told == 1  # so that it can ask anew whether it may subscribe


def test_a_fault_in_what_is_told_of_the_rules_ends_nothing_else(
    broker: Broker, ear: Ear, escaped: list[str]
):
    class Broken(InsideLink):
        def rules_changed(self) -> None:
            raise RuntimeError("by the test")

    broker.attach("_broken", Broken())
    broker.attach(NAME, ear, Identity("user", NAME))
    broker.rules_changed()
    assert ear.told == 1 and broker.faults.by_entry == {"broker.rules": 1}
    escaped.clear()


@pytest.mark.parametrize(
    "limits",
    [
        Limits(
            connections=1, sessions=1, subscriptions=1, user=UserLimits(connections=1, sessions=1)
        )
    ],
)
def test_it_takes_nobodys_place_and_nobody_takes_its(broker: Broker, join: Join, ear: Ear):
    sessions = [broker.attach(name, ear, Identity("user", name)) for name in ("_a", "_b", NAME)]
    for session in sessions:
        for number in range(3):
            assert broker.subscribe(session, Subscription(f"a/{number}"))[0] == 0
    account = broker.accounting.accounts.of_user("user")
    assert (account.connections, account.sessions, account.bytes) == (0, 0, 0)
    first = join("first", **lasting(5))
    first.lose()
    join("second")  # for whom the first one's session is evicted, and none of these
    assert set(broker.sessions) == {"_a", "_b", NAME, "second"} and not ear.closed
    for session in sessions:
        broker.detach(session)
    assert broker.subscription_count == 0


def test_nothing_of_it_is_stored(broker: Broker, store: FakeStore, inside: Session):
    broker.subscribe(inside, Subscription("a", 1))
    broker.tick(broker.now + 1)
    broker.detach(inside)
    assert (store.sessions, store.subscriptions) == (set(), {})
    broker.tick(broker.now + 10 * broker.limits.session_expiry)


@pytest.mark.parametrize("limits", [Limits(user=UserLimits(retained_messages=2))])
def test_what_it_retains_is_its_users(broker: Broker, join: Join, inside: Session):
    """A fleet must not fill the retained messages of all; and what a fleet sent is no remainder of
    the bridge, which removes messages of the appliance."""
    accounts = broker.accounting.accounts
    codes = [broker.publish(Message(f"a/{n}", b"x", 1, True), inside) for n in range(3)]
    assert codes == [0x10, 0x10, ReasonCode.QUOTA_EXCEEDED]
    assert broker.retained.owner("a/0") is accounts.of_user("user")
    route = broker.route(inside, Message("a/2", b"").topic_wire)
    assert "retained_messages" in broker.shortage(route, Message("a/2", b"x", 1, True), inside)
    assert join("other", user="user").publish("a/9", b"x", 1, retain=True) == 0x97
    assert join("else", user="else").publish("a/9", b"x", 1, retain=True) == 0x10


def test_guards_and_departures_know_it(broker: Broker, inside: Session):
    asked: list[Session] = []

    class Guard:
        def decide(self, session: Session) -> Decision:
            asked.append(session)
            return Decision(False, "by the guard")

        def refused(self, session: Session) -> None: ...

    broker.guards["cmd"] = [Guard()]  # type: ignore[list-item]
    broker.guards_changed()
    departed: list[Session] = []
    broker.departures.append(departed.append)
    assert broker.publish(Message("cmd", b"x"), inside) == ReasonCode.NOT_AUTHORIZED
    assert asked == [inside] and not departed
    broker.detach(inside)
    assert departed == [inside] and not inside.ended_well


def test_it_is_no_client(broker: Broker, join: Join, inside: Session, ear: Ear):
    join("client")
    figures = dict(SysTopics(broker, "1", lambda: 0).update())
    assert figures["$SYS/broker/clients/total"] == b"1"
    assert figures["$SYS/broker/clients/disconnected"] == b"0"
    closed: list[str] = []
    broker.close(lambda session: closed.append(session.client_id))
    assert closed == ["client"] and not ear.closed


def test_nobody_waits_for_it(broker: Broker, join: Join, inside: Session, ear: Ear):
    """Its queue is elsewhere: it is never crowded, also not with a subscription of QoS 1."""
    broker.subscribe(inside, Subscription("a", 1))
    publisher = join("publisher")
    for number in range(broker.limits.inflight + broker.limits.queue_messages):
        assert publisher.publish("a", b"%d" % number, 1) == 0
    assert inside.congestion is None
