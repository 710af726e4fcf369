"""What a link carries, and under which topic: the rules of `out` and `in`, and their settings.

A rule has a filter without its beginning, as in the `topic` lines of mosquitto's bridges: behind
`local_prefix` it is the filter here, behind `remote_prefix` the filter at the fleet's broker. A
topic is mapped by replacing one prefix with the other, and so back again. The first rule of a
direction that matches a topic carries it; other rules do not carry it a second time.

Topics that the link uses itself are carried by no rule: see `LinkRules.is_own_local` and
`LinkRules.is_own_remote`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Generic, Literal, TypeAlias, TypeVar

from appliance.config.urls import ServerUrl
from appliance.mqtt.topics import SubscriptionTree, check_topic, matches, overlaps

#: How messages wait: all of a topic, its latest, or none. `auto`: see `OutRule.kept`.
Kept: TypeAlias = Literal["all", "latest", "none"]
KeepRule: TypeAlias = Literal["auto", "all", "latest", "none"]

Priority: TypeAlias = Literal["high", "normal", "low"]

#: The priorities, most urgent first; the position of one is the number of its lane.
PRIORITIES: Final[tuple[Priority, ...]] = ("high", "normal", "low")

#: The kinds of brokers with limits of their own, see `limits`.
BrokerKind: TypeAlias = Literal["generic", "aws-iot", "azure-event-grid", "rabbitmq"]

#: Seconds that a message may be late where no route says how long commands are good.
LATE: Final = 10.0

#: Topics whose rules are remembered; with more, all are looked up anew.
_REMEMBERED: Final = 4096

#: Characters of the longest topic that is: a stranger could fill the memory with others.
_SHORT: Final = 256


@dataclass(frozen=True, slots=True)
class MappedTopics:
    """Topics here and the topics there that are the same."""

    topic: str
    local_prefix: str
    remote_prefix: str

    @property
    def local_filter(self) -> str:
        """The topic filter here."""
        return self.local_prefix + self.topic

    @property
    def remote_filter(self) -> str:
        """The topic filter at the fleet's broker."""
        return self.remote_prefix + self.topic

    def to_remote(self, topic: str) -> str | None:
        """The topic there of a topic here; None when it is not carried.

        A topic there may begin with `$` only where `remote_prefix` does: those are the server's.
        """
        moved = _moved(topic, self.local_filter, self.local_prefix, self.remote_prefix)
        if moved is None or (moved[0] == "$" and self.remote_prefix[:1] != "$"):
            return None
        return moved

    def to_local(self, topic: str) -> str | None:
        """The topic here of a topic there; None when it is not carried.

        A topic here never begins with `$`: those are this broker's.
        """
        moved = _moved(topic, self.remote_filter, self.remote_prefix, self.local_prefix)
        return None if moved is None or moved[0] == "$" else moved


def _moved(topic: str, filter: str, prefix: str, other: str) -> str | None:
    """A valid topic that matches the filter, with `other` for its prefix; None if it is none.

    `a/#` matches the topic `a` as well, which is not below the prefix `a/`.
    """
    if not topic.startswith(prefix) or not matches(filter, topic):
        return None
    moved = other + topic[len(prefix) :]
    try:
        check_topic(moved)  # it may be empty or too long now, and a stranger's was never checked
    except ValueError:
        return None
    return moved


@dataclass(frozen=True, slots=True)
class OutRule(MappedTopics):
    """Carries topics from here to the fleet's broker; `rate` in messages a second.

    `qos` is the most, and `retain` takes the place of what the publisher says; None: as it says.
    """

    keep: KeepRule = "auto"
    priority: Priority = "normal"
    rate: float | None = None
    qos: int | None = None
    retain: bool | None = None

    @property
    def lane(self) -> int:
        """The number of its lane; 0 is the most urgent."""
        return PRIORITIES.index(self.priority)

    def kept(self, qos: int, retain: bool) -> Kept:
        """How a message of this QoS waits.

        With `auto` the latest of a topic where the publisher does not count on each message
        (QoS 0), or where a topic has one value (retained); else all.
        """
        if self.keep != "auto":
            return self.keep
        return "latest" if retain or qos == 0 else "all"


@dataclass(frozen=True, slots=True)
class InRule(MappedTopics):
    """Carries topics from the fleet's broker to here.

    A message that may be older than `late` seconds is dropped; None: none is. With `offline` keep
    the fleet's broker queues messages while the link is down, so that they are late on purpose.
    What is `retained` there is of unknown age: no command, or, with `drop`, nothing at all.

    `judged_by` is the least age, in seconds, for which a route that the rule feeds refuses a
    message, None without such a route: ages have to be known more exactly than that.
    """

    late: float | None = LATE
    offline: Literal["drop", "keep"] = "drop"
    retained: Literal["take", "drop"] = "take"
    judged_by: float | None = None

    @property
    def least_age(self) -> float | None:
        """The least age for which a message is refused, here or by a route; None: none is."""
        ages = [age for age in (self.late, self.judged_by) if age is not None]
        return min(ages, default=None)


@dataclass(frozen=True, slots=True)
class CommandTopics:
    """The topics of a route to ROS, and after which times, in seconds, it rejects a command or
    publishes its stop message; None where it does not."""

    filter: str
    expire: float | None = None
    silence: float | None = None

    @property
    def oldest(self) -> float | None:
        """The age from which on the route rejects a command; see `CommandRules.oldest`."""
        return self.silence if self.expire is None else self.expire


@dataclass(frozen=True, slots=True)
class CallTopics:
    """The topics of calls to ROS, and the age in seconds from which on a call has expired."""

    filter: str
    timeout: float


@dataclass(frozen=True, slots=True)
class RosTopics:
    """What routes to ROS take."""

    commands: tuple[CommandTopics, ...] = ()
    calls: tuple[CallTopics, ...] = ()

    def default_late(self, local_filter: str) -> float:
        """The `late` of a rule that does not say it.

        The least time of the routes for commands that it feeds. A call that is older than its
        timeout is answered, with an error: it is dropped only when it is later than all of them.
        """
        timeouts = [each.timeout for each in self._calls(local_filter)]
        return min(self._times(local_filter), default=max([LATE, *timeouts]))

    def judged_by(self, local_filter: str) -> float | None:
        """See `InRule.judged_by`."""
        oldest = [route.oldest for route in self._commands(local_filter)]
        timeouts = [each.timeout for each in self._calls(local_filter)]
        return min([*filter(None, oldest), *timeouts], default=None)

    def _times(self, local_filter: str) -> list[float]:
        fed = self._commands(local_filter)
        return [time for route in fed for time in (route.expire, route.silence) if time is not None]

    def _commands(self, local_filter: str) -> list[CommandTopics]:
        return [each for each in self.commands if overlaps(each.filter, local_filter)]

    def _calls(self, local_filter: str) -> list[CallTopics]:
        return [each for each in self.calls if overlaps(each.filter, local_filter)]


@dataclass(frozen=True, slots=True)
class UpstreamLogin:
    """How the link authenticates. Files are read at each connection.

    With a `method` (MQTT 5) the token is the Authentication Data, else it is the password.
    """

    username: str | None = None
    password_file: Path | None = None
    token_file: Path | None = None
    method: str | None = None


@dataclass(frozen=True, slots=True)
class UpstreamTls:
    """TLS of the link; files are read at each connection. `ca` None: those of the system."""

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    server_name: str | None = None
    alpn: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class BacklogLimits:
    """The most that waits: `size` in bytes, `age` in seconds; and what happens when it is full."""

    size: int = 256 << 20
    age: float | None = None
    when_full: Literal["drop-oldest", "refuse"] = "drop-oldest"


@dataclass(frozen=True, slots=True)
class Vehicle:
    """Who the robot is by VDA 5050, as the header of each message says it (2.1 section 6.4)."""

    version: str
    manufacturer: str
    serial_number: str


@dataclass(frozen=True, slots=True)
class UpstreamSettings:
    """A link: an entry of `upstreams` in appliance.yaml, with its placeholders replaced.

    `version` is the protocol level, see `mqtt.codec`; `keep_alive` is in seconds, `rate` in
    messages a second. `prefix` ends with `/`. A link with a `vehicle` speaks VDA 5050.
    """

    name: str
    robot: str
    servers: tuple[ServerUrl, ...]
    kind: BrokerKind
    version: int
    client_id: str
    user: str
    prefix: str
    login: UpstreamLogin
    tls: UpstreamTls
    proxy: str | None = field(repr=False)  # a password may be in it
    keep_alive: int
    window: int
    rate: float | None
    bytes_per_second: int | None
    backlog: BacklogLimits
    out: tuple[OutRule, ...]
    inward: tuple[InRule, ...]
    vehicle: Vehicle | None = None

    @property
    def answers_here(self) -> str:
        """The beginning of the topics here that stand for Response Topics there."""
        return f"{self.robot}/_upstream/{self.name}/"

    @property
    def answers_there(self) -> str:
        """The beginning of the topics there that stand for Response Topics here."""
        return f"{self.prefix}_answers/"

    @property
    def state_there(self) -> str:
        """The topic there at which the link says whether the robot is online, see `presence`."""
        return self.prefix + ("_appliance/state" if self.vehicle is None else "connection")

    @property
    def status_here(self) -> str:
        """The topic here of the link's status, retained."""
        return f"{self.robot}/_appliance/upstream/{self.name}"

    def overlapping(self) -> list[tuple[OutRule, InRule]]:
        """Rules of both directions that share topics there: with MQTT 3.1.1, which has no No Local,
        the link would receive what it has sent."""
        return [
            (out, inward)
            for out in self.out
            for inward in self.inward
            if overlaps(out.remote_filter, inward.remote_filter)
        ]


RuleT = TypeVar("RuleT", OutRule, InRule)


class _Lookup(Generic[RuleT]):
    """Finds the first rule that carries a topic, and its topic at the other side."""

    def __init__(
        self,
        rules: Sequence[RuleT],
        filter: Callable[[RuleT], str],
        move: Callable[[RuleT, str], str | None],
    ) -> None:
        self._rules: Sequence[RuleT] = rules
        self._move: Callable[[RuleT, str], str | None] = move
        self._tree: SubscriptionTree[int] = SubscriptionTree()
        for position, rule in enumerate(rules):
            self._tree.add(filter(rule), position, position)
        self._found: dict[str, tuple[RuleT, str] | None] = {}

    def find(self, topic: str) -> tuple[RuleT, str] | None:
        try:
            return self._found[topic]
        except KeyError:
            pass
        found = self._search(topic)
        if len(topic) <= _SHORT:
            if len(self._found) >= _REMEMBERED:
                self._found.clear()
            self._found[topic] = found
        return found

    def _search(self, topic: str) -> tuple[RuleT, str] | None:
        for position in sorted(self._tree.match(topic)):
            rule = self._rules[position]
            moved = self._move(rule, topic)
            if moved is not None:
                return rule, moved
        return None


class LinkRules:
    """The rules of one link, for each topic that comes."""

    def __init__(self, settings: UpstreamSettings) -> None:
        self._settings = settings
        #: Of answers to requests from there: they go before all else, and none replaces another.
        self.answers = OutRule("+", settings.answers_here, "", "all", "high")
        self._out = _Lookup(settings.out, lambda rule: rule.local_filter, self._to_remote)
        self._in = _Lookup(settings.inward, lambda rule: rule.remote_filter, self._to_local)

    def out(self, topic: str) -> tuple[OutRule, str] | None:
        """The rule that carries a topic from here, and the topic there; None when none does."""
        return self._out.find(topic)

    def inward(self, topic: str) -> tuple[InRule, str] | None:
        """The rule that carries a topic from there, and the topic here; None when none does."""
        return self._in.find(topic)

    @property
    def out_filters(self) -> list[str]:
        """The filters to subscribe to here, each once; answers are at `answers_here`."""
        return list(dict.fromkeys(rule.local_filter for rule in self._settings.out))

    def in_filters(self, offline: Literal["drop", "keep"]) -> list[str]:
        """The filters to subscribe to there, each once, on one of the two connections."""
        rules = (rule for rule in self._settings.inward if rule.offline == offline)
        return list(dict.fromkeys(rule.remote_filter for rule in rules))

    def is_own_local(self, topic: str) -> bool:
        """Whether a topic here is not to go there: those of links (their answers and their status,
        which changes with each message), and the appliance's state, which the link reports."""
        below = topic.removeprefix(f"{self._settings.robot}/")
        return below != topic and (
            below.startswith(("_upstream/", "_appliance/upstream/")) or below == "_appliance/state"
        )

    def is_own_remote(self, topic: str) -> bool:
        """Whether a topic there is the link's own: its state, and answers to requests."""
        settings = self._settings
        return topic == settings.state_there or topic.startswith(settings.answers_there)

    def _to_remote(self, rule: OutRule, topic: str) -> str | None:
        if self.is_own_local(topic):
            return None
        moved = rule.to_remote(topic)
        return None if moved is None or self.is_own_remote(moved) else moved

    def _to_local(self, rule: InRule, topic: str) -> str | None:
        if self.is_own_remote(topic):
            return None
        moved = rule.to_local(topic)
        return None if moved is None or self._is_appliances(moved) else moved

    def _is_appliances(self, topic: str) -> bool:
        """Whether only this appliance says anything at a topic here."""
        below = topic.removeprefix(f"{self._settings.robot}/")
        return below != topic and below.startswith(("_upstream/", "_appliance/"))
