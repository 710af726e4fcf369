"""Response Topics across a link: a topic at one side stands for a topic at the other.

A request that comes in with the Response Topic `answers/alice` gets
`{robot}/_upstream/{link}/{token}` here; what is published there goes to `answers/alice`. A request
that goes out gets `{prefix}_answers/{token}`. Correlation Data stays in the messages.

MQTT 3.1.1 has no Response Topic. There a call has a token of the caller's as one more level, as
with the appliance's own calls, and is answered beside the call, without the caller's client id,
which nobody knows behind a broker:

    {prefix}reset/_call/42  →  {prefix}reset/_reply/42

A request that goes out gets a token of the link's in the same place.

Answers go out with the link's login, which may be allowed more than the caller: a Response Topic
there must not be one of the robot's own, whose messages would be taken for the robot's, or for
commands to it. What answers the call itself is excepted (`reset/_reply/...` for `reset/_call`).

Tokens are random, so that who may write below `_upstream` or `_answers` cannot guess one. They end
`LIFETIME` after the last request with that Response Topic. When there are too many, the oldest of
the user here who has the most end, so that nobody's requests take away the answers of others.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable
from typing import Final

from appliance.mqtt.codec import text_size
from appliance.mqtt.topics import MAX_TOPIC, SubscriptionTree, check_topic
from appliance.upstream.rules import UpstreamSettings

#: Seconds after which nobody waits for an answer: longer than every timeout of calls.
LIFETIME: Final = 300.0

#: The most tokens in each direction.
MOST_TOKENS: Final = 10_000

#: The most bytes of memory of the topics that the tokens of a direction stand for; one may have
#: 256 KiB.
MOST_BYTES: Final = 8 << 20

#: Levels of a Response Topic: looking for its rules costs time for each.
MOST_LEVELS: Final = 200

#: The last level of a topic of calls, see docs/conventions.md; a token is one more level.
_CALLS: Final = ("_call", "_goal", "_cancel")


def new_token() -> str:
    """A token of 128 random bits that is valid as one level of a topic."""
    return secrets.token_hex(16)


class _Owned:
    """The tokens of one user: the oldest comes first."""

    __slots__ = ("bytes", "tokens")

    def __init__(self) -> None:
        self.tokens: dict[str, None] = {}
        self.bytes = 0

    def share(self) -> float:
        """The part of what all may have."""
        return max(len(self.tokens) / MOST_TOKENS, self.bytes / MOST_BYTES)


class _Tokens:
    """Tokens of one direction, each of a topic at the other side."""

    def __init__(self, new: Callable[[], str]) -> None:
        self._new = new
        #: By token: the topic, its owner, and when it ends; by topic and owner: the token. The
        #: oldest come first.
        self._topics: dict[str, tuple[str, str | None, float]] = {}
        self._tokens: dict[tuple[str, str | None], str] = {}
        #: By user: who asks here; None for anonymous clients, and for all who ask there.
        self._owned: dict[str | None, _Owned] = {}
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._topics)

    def issue(self, topic: str, now: float, user: str | None = None) -> str:
        """The token of a topic, which holds for `LIFETIME` from now; `user` is who asks."""
        self._end_old(now)
        token = self._tokens.get((topic, user))
        if token is None:
            token = self._new()
        else:
            self._end(token)
        size = text_size(topic)
        owned = self._owned.setdefault(user, _Owned())
        owned.tokens[token] = None
        owned.bytes += size
        self._topics[token] = topic, user, now + LIFETIME
        self._tokens[topic, user] = token
        self._bytes += size
        while len(self._topics) > MOST_TOKENS or self._bytes > MOST_BYTES:
            self._end(next(iter(self._largest(owned).tokens)))
        return token

    def _largest(self, asking: _Owned) -> _Owned:
        """Whose oldest token ends: who asks, if that is an equal share; else who has the most."""
        if len(asking.tokens) > 1 and asking.share() * len(self._owned) >= 1:
            return asking
        return max(self._owned.values(), key=_Owned.share)

    def topic(self, token: str, now: float) -> str | None:
        """The topic of a token; None when there is none, or it has ended."""
        self._end_old(now)
        found = self._topics.get(token)
        return None if found is None else found[0]

    def _end_old(self, now: float) -> None:
        while self._topics:
            token, (_, _, ends) = next(iter(self._topics.items()))
            if ends > now:
                return
            self._end(token)

    def _end(self, token: str) -> None:
        topic, user, _ = self._topics.pop(token)
        del self._tokens[topic, user]
        size = text_size(topic)
        self._bytes -= size
        owned = self._owned[user]
        del owned.tokens[token]
        owned.bytes -= size
        if not owned.tokens:
            del self._owned[user]


class Answers:
    """The Response Topics of one link, both ways. Times in seconds of any clock."""

    def __init__(self, settings: UpstreamSettings, new: Callable[[], str] = new_token) -> None:
        self.use(settings)
        self._here = settings.answers_here
        self._there = settings.answers_there
        self._coming = _Tokens(new)
        self._going = _Tokens(new)

    def use(self, settings: UpstreamSettings) -> None:
        """Go on with the rules of a link that was loaded again; its answer topics are the same."""
        self._prefix = settings.prefix
        #: The filters there of what is the robot's own: its state, and all that a rule carries.
        self._own: SubscriptionTree[None] = SubscriptionTree()
        rules = (*settings.out, *settings.inward)
        for filter in (
            settings.state_there,
            f"{settings.answers_there}#",
            *(rule.remote_filter for rule in rules),
        ):
            self._own.add(filter, None, None)

    def __len__(self) -> int:
        """The tokens in use, of both directions."""
        return len(self._coming) + len(self._going)

    def for_request_in(self, topic: str, response_topic: str | None, now: float) -> str | None:
        """The Response Topic here of a request that came in on `topic`, as it is there.

        Without one it is that of MQTT 3.1.1's calls with a token. None: there is no way to answer,
        or the Response Topic is none that a client may publish to, or one of the robot's own.
        """
        wanted = reply_topic(topic) if response_topic is None else response_topic
        if wanted is None or not _may_be_answered(wanted):
            return None
        if not self._is_answer_of(topic, wanted) and self._is_the_robots(wanted):
            return None
        return self._here + self._coming.issue(wanted, now)

    @staticmethod
    def _is_answer_of(called: str, topic: str) -> bool:
        """Whether calls of that topic there, with or without a token, are answered at the other."""
        if not _is_call(called):
            called = called.rpartition("/")[0]
        return _is_call(called) and topic.startswith(f"{called.rpartition('/')[0]}/_reply/")

    def _is_the_robots(self, topic: str) -> bool:
        """Whether an answer at a topic there would be taken for a message of the robot, for a
        command to it, or for the answer of another call of it."""
        if topic.startswith(self._prefix) and "/_reply/" in topic:
            return True
        if self._own.match(topic):
            return True
        # A rule may have a prefix of its own for calls.
        above, found, token = topic.partition("/_reply/")
        if not found:
            return False
        called = (f"{above}/{last}" for last in (*_CALLS, "_set", "set"))
        last = token.rpartition("/")[2]  # with MQTT 5 there may be more levels before it
        return any(
            self._own.match(each)
            or self._own.match(f"{each}/{token}")
            or self._own.match(f"{each}/{last}")
            for each in called
            if _is_call(each)
        )

    def for_answer_out(self, topic: str, now: float) -> str | None:
        """The topic there of an answer that was published here; None when it is for nobody."""
        found = self._topic(self._coming, self._here, topic, now)
        if found is None or "/_reply/" in found:
            return found
        return None if self._is_the_robots(found) else found  # by rules that came after the call

    def for_request_out(self, response_topic: str, now: float, user: str | None) -> str | None:
        """The Response Topic there of a user's request that goes out; None when it is invalid.

        Whoever calls this has checked that the requester itself may publish to its Response Topic:
        the answer is published by the link's user.
        """
        if not _may_be_answered(response_topic):
            return None
        return self._there + self._going.issue(response_topic, now, user)

    def for_call_out(
        self, topic: str, response_topic: str, now: float, user: str | None
    ) -> str | None:
        """With MQTT 3.1.1, the topic there of a request that goes out: with a token of its own.

        `topic` is the topic there without it. None: it is no call, and cannot say where to answer.
        """
        if not _is_call(topic) or not _may_be_answered(response_topic):
            return None
        called = f"{topic}/{self._going.issue(response_topic, now, user)}"
        return called if len(called.encode()) <= MAX_TOPIC else None

    def for_answer_in(self, topic: str, now: float) -> str | None:
        """The topic here of an answer that came in on `topic`; None when it is for nobody."""
        found = self._topic(self._going, self._there, topic, now)
        if found is None:
            above, _, token = topic.rpartition("/")
            if above.endswith("/_reply"):
                found = self._going.topic(token, now)
        return found

    @staticmethod
    def _topic(tokens: _Tokens, beginning: str, topic: str, now: float) -> str | None:
        if not topic.startswith(beginning):
            return None
        return tokens.topic(topic[len(beginning) :], now)


def reply_topic(topic: str) -> str | None:
    """Where a call with a token as its last level is answered; None for another topic."""
    called, _, token = topic.rpartition("/")
    if not token or not _is_call(called):
        return None
    return f"{called.rpartition('/')[0]}/_reply/{token}"


def reply_filter(filter: str) -> str | None:
    """With MQTT 3.1.1, the filter of the answers to requests that an `out` rule with this filter
    there carries; None when it is not one of calls by its last level."""
    if not _is_call(filter):
        return None
    return f"{filter.rpartition('/')[0]}/_reply/+"


def _is_call(topic: str) -> bool:
    """Whether calls are sent to that topic: of services, actions, or to set parameters."""
    *above, last = topic.rsplit("/", 3)
    if last == "_set":
        return above[-1:] == ["_param"]
    if last == "set":
        return above[-2:-1] == ["_param"]
    return bool(above) and last in _CALLS


def _may_be_answered(topic: str) -> bool:
    """Whether a stranger may have an answer published to that topic at all."""
    try:
        check_topic(topic)
    except ValueError:
        return False
    return topic[0] != "$" and topic.count("/") < MOST_LEVELS
