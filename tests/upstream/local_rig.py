"""The real broker with real access rules, and the two sides of a link that touch it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from broker.conftest import FakeStore, Peer

from appliance.access import FileAccess, Rules
from appliance.broker.broker import Broker
from appliance.broker.limits import Features, Limits
from appliance.broker.link import PeerStatus
from appliance.broker.store import Store
from appliance.mqtt.codec import (
    NO_PROPERTIES,
    V5,
    PacketType,
    Properties,
    Property,
    check_properties,
    decode_properties,
    encode_properties,
)
from appliance.mqtt.reason import ReasonCode
from appliance.upstream.answers import Answers
from appliance.upstream.in_session import InCounters, InSession
from appliance.upstream.late import Freshness
from appliance.upstream.link_events import Arrived
from appliance.upstream.out_session import OutSession
from appliance.upstream.readiness import Readiness
from appliance.upstream.rules import LinkRules, OutRule

from .links import link

ACL = """\
user upstream
topic readwrite {robot}/#
topic deny {robot}/secret/#

user user
topic readwrite #
"""

KEYS = """\
user: upstream, out: [{topic: "events/#"}, {topic: "map", keep: latest}],
in: [{topic: cmd_vel, late: 500 ms}, {topic: "mission/#", offline: keep},
     {topic: "calls/#", late: 10 s}, {topic: "secret/#"}]"""


class Offered:
    """What was offered to the backlog."""

    def __init__(
        self, rule: OutRule, topic: str, payload: bytes, qos: int, retain: bool, properties: bytes
    ) -> None:
        self.rule, self.topic, self.payload = rule, topic, payload
        self.qos, self.retain = qos, retain
        self.properties: Properties = (
            decode_properties(properties, 0, len(properties), PacketType.PUBLISH)[0] or {}
        )
        self.expires_in: float | None = None
        self.is_acknowledged = True
        self.user: str | None = None


class FakeBacklog:
    """Takes everything, or nothing when it is full."""

    def __init__(self) -> None:
        self.offers: list[Offered] = []
        self.is_full = False
        self.is_behind_disk = False
        #: Offers that displace so much each, and the pieces in which that is dropped later.
        self.displaced = self.pieces = 0
        self.work = 0
        self.fault: Exception | None = None
        self.staged: Callable[[], None] = lambda: None

    def must_wait(
        self, rule: OutRule, topic: str, qos: int, retain: bool, size: int, user: str | None
    ) -> bool:
        assert user == "user"
        return self.is_behind_disk

    def offer(
        self,
        rule: OutRule,
        topic: str,
        payload: bytes,
        qos: int,
        retain: bool,
        properties_wire: bytes,
        expires_at: float | None,
        now: float,
        *,
        is_acknowledged: bool = True,
        user: str | None = None,
    ) -> str | None:
        if self.fault is not None:
            raise self.fault
        if self.is_full:
            return "it is full"
        offered = Offered(rule, topic, payload, qos, retain, properties_wire)
        offered.is_acknowledged, offered.user = is_acknowledged, user
        offered.expires_in = None if expires_at is None else expires_at - now
        self.offers.append(offered)
        self.work += self.displaced
        self.staged()
        return None

    @property
    def is_owing(self) -> bool:
        return self.pieces > 0

    def drop_more(self) -> None:
        self.pieces -= 1
        self.work += 100

    def taken(self) -> list[tuple[str, bytes]]:
        """What was offered since this was last asked."""
        offers, self.offers = self.offers, []
        return [(each.topic, each.payload) for each in offers]


class FakeConnection:
    """A connection to the fleet's broker; turns are asked for, and the test takes them."""

    def __init__(self, version: int = V5) -> None:
        self.version = version
        self.acknowledged: list[tuple[int, int]] = []
        self.closed: list[tuple[int, str]] = []
        self.turn_in: float | None = None
        self.is_paused = False
        self.probes = 0
        self.silence = 0.0
        self.on_acknowledged: Callable[[], None] = lambda: None
        self.session: InSession | None = None

    def acknowledge(self, packet_id: int, code: int) -> None:
        assert not self.closed
        self.acknowledged.append((packet_id, code))
        self.on_acknowledged()

    def later(self, seconds: float) -> None:
        self.turn_in = seconds if self.turn_in is None else min(seconds, self.turn_in)

    def pause_reading(self) -> None:
        assert not self.is_paused
        self.is_paused = True

    def resume_reading(self) -> None:
        assert self.is_paused
        self.is_paused = False

    def close(self, code: ReasonCode, reason: str) -> None:
        self.closed.append((code, reason))
        if self.session is not None:
            self.session.detach()

    def peer_status(self) -> PeerStatus:
        return PeerStatus(round_trip=0.05, silence=self.silence)

    def probe(self) -> None:
        self.probes += 1

    def codes(self) -> list[tuple[int, int]]:
        """The acknowledgements since this was last asked."""
        acknowledged, self.acknowledged = self.acknowledged, []
        return acknowledged


class Rig:
    """One broker, one link."""

    def __init__(
        self,
        folder: Path,
        acl: str = ACL,
        keys: str = KEYS,
        store: Store | None = None,
        limits: Limits | None = None,
        features: Features | None = None,
        robot: str = "r2",
    ) -> None:
        self.robot = robot
        self.acl = folder / "acl.conf"
        self.acl.write_text(acl)
        self.access = FileAccess(None, self.acl, robot, True)
        self.store = store or FakeStore()
        self.broker = Broker(self.access, self.store, limits, features)
        self.now = 1000.0
        self.broker.tick(self.now)
        self.settings = link(" ".join(keys.split()), robot=robot)
        self.rules = LinkRules(self.settings)
        self.answers = Answers(self.settings)
        self.backlog = FakeBacklog()
        self.turns = 0
        self.out = OutSession(
            self.broker,
            self.settings,
            self.rules,
            self.answers,
            self.backlog,
            lambda: self.now + 5e8,  # another clock than the broker's
            self._later,
        )
        self.counters = InCounters()
        self._packet_id = 0

    def _later(self) -> None:
        self.turns += 1

    def begin(self) -> None:
        """The process starts."""
        self.out.attach()
        self.broker.flush()

    def turn(self) -> None:
        """Take the turn that the out session has asked for."""
        assert self.turns
        self.turns = 0
        self.out.take_turn()
        self.broker.flush()

    def reload(self, acl: str) -> None:
        self.acl.write_text(acl)
        self.access.adopt(Rules.read(None, self.acl, self.robot, True))
        self.broker.rules_changed()
        self.broker.flush()

    def join(self, name: str = "client", user: str = "user", **options: object) -> Peer:
        peer = Peer(self.broker)
        assert not peer.connect(name, user=user, **options).reason_code
        return peer

    def connect(self, version: int = V5, **options: bool) -> Fleet:
        """The connection to the fleet's broker is up."""
        return Fleet(self, version, **options)


class Fleet:
    """What the fleet's broker sends on one connection."""

    def __init__(self, rig: Rig, version: int, **options: bool) -> None:
        self.rig = rig
        self.connection = FakeConnection(version)
        answering = rig.out.answering
        assert answering is not None
        self.session = self.connection.session = InSession(
            rig.broker,
            rig.settings,
            rig.rules,
            rig.answers,
            answering,
            self.connection,
            rig.counters,
            Readiness(),
            **options,
        )
        self._packet_id = 0
        #: As the link has it.
        self.freshness = Freshness()
        self._pings: list[float] = []
        self.connection.on_acknowledged = self.freshness.message_acknowledged
        if not options.get("is_kept"):
            self.freshness.session_began(rig.now)

    def ask(self, at: float | None = None) -> None:
        """A PINGREQ."""
        self._pings.append(self.rig.now if at is None else at)
        self.freshness.ping_sent()

    def answer(self) -> None:
        """A PINGRESP."""
        self.freshness.ping_answered(self._pings.pop(0))

    def ping(self) -> None:
        """A PINGREQ that is answered at once."""
        self.ask()
        self.answer()

    def put(
        self,
        topic: str,
        payload: bytes = b"x",
        qos: int = 1,
        retain: bool = False,
        dup: bool = False,
        properties: Properties | None = None,
    ) -> int:
        """A PUBLISH, without a flush; returns its packet id."""
        packet_id = 0
        not_before = self.freshness.left_after(qos)
        if qos:
            packet_id = self._packet_id = self._packet_id + 1
            self.freshness.message_received()
        packet = Arrived(
            topic, payload, qos, retain, dup, packet_id, None, NO_PROPERTIES, not_before
        )
        if properties:
            wire = encode_properties(properties)
            checked, _ = check_properties(wire, 0, len(wire), PacketType.PUBLISH, 1000)
            assert checked is not None
            packet.properties, packet.properties_wire = checked.values, checked.passed_on
        self.session.receive(packet, self.rig.now)
        return packet_id

    def send(self, topic: str, payload: bytes = b"x", qos: int = 1, **how: object) -> int:
        """A PUBLISH alone; returns the code of its PUBACK, -1 for none."""
        packet_id = self.put(topic, payload, qos, **how)  # type: ignore[arg-type]
        self.rig.broker.flush()
        codes = dict(self.connection.codes())
        return codes.get(packet_id, -1)

    def turn(self, seconds: float = 0.0) -> None:
        """Take the turn that was asked for."""
        assert self.connection.turn_in is not None
        self.connection.turn_in = None
        self.rig.now += seconds
        self.session.take_turn(self.rig.now)
        self.rig.broker.flush()


def user_properties(properties: Properties | None) -> list[tuple[str, str]]:
    pairs = (properties or {}).get(Property.USER_PROPERTY, [])
    assert isinstance(pairs, list)
    return pairs  # type: ignore[return-value]
