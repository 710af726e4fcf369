"""Access to topics: what the ACL file and all of amqtt's topic plugins allow."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from amqtt.broker import BrokerContext
from amqtt.contexts import Action as AmqttAction
from amqtt.plugins.base import BaseTopicPlugin
from amqtt.plugins.manager import PluginManager
from amqtt.session import Session as AmqttSession

from appliance.broker.broker import Broker
from appliance.broker.ports import Access
from appliance.broker.values import AccessQuery, Action, Decision, Identity
from appliance.config.redaction import redacted
from appliance.net.callbacks import Entries
from appliance.plugins.adapters import SessionViews, UnclaimedIdentity
from appliance.plugins.guard import PluginGuard, plugin_name
from appliance.plugins.logins import CachePolicy
from appliance.plugins.threads import Threads, blocks

log = logging.getLogger(__name__)

#: Seconds for which an expired verdict is used while the plugins are asked anew.
STALE_VERDICT_LIFETIME = 600.0
#: Pending questions to the plugins: in all, and about one client.
MAX_QUERIES = 64
MAX_CLIENT_QUERIES = 8
#: And about all clients of one user.
MAX_USER_QUERIES = 16
#: Seconds after which questions are tried again for which there was no room.
ROOM_CHECK_INTERVAL = 0.25

#: Stands for the answer of a plugin that has to wait first.
_WOULD_BLOCK: Final = object()


class PluginAccess:
    """The broker's `Access`: what the files allow and no topic plugin refuses.

    The broker decides synchronously, and amqtt's topic plugins are coroutines. Plugins that never
    wait for anything (rules in the configuration, a token) are run to the end at once. As soon as
    one has to wait (HTTP, SQL, LDAP), all are asked in the background. The first SUBSCRIBE or
    PUBLISH with a new question, and what its client sends after it, waits for the answer, up to
    `timeout`; then it is refused, and the answer is cached for the next try. A cached answer that
    has expired, or is older than the last reload of the files, is used while the plugins are asked
    anew, for 10 minutes at most.

    Messages that are queued for a client are checked again when such an answer turns to no, or when
    the files are read again.
    """

    def __init__(
        self,
        files: Access,
        broker: Broker,
        plugins: PluginManager[BrokerContext],
        sessions: SessionViews,
        guard: PluginGuard,
        threads: Threads,
        answers: CachePolicy,
    ) -> None:
        self.answers = answers
        self._threads = threads
        self._files = files
        self._broker = broker
        self._plugins = plugins
        self._sessions = sessions
        self._guard = guard
        self._epoch = 0
        self._is_blocking = False
        self._verdicts: OrderedDict[AccessQuery, tuple[Decision, float, int]] = OrderedDict()
        self._asked: dict[AccessQuery, asyncio.Task[None]] = {}
        #: Callbacks that wait for the answer to each question, and those that wait for room to ask.
        self._waiting: dict[AccessQuery, dict[Callable[[], None], None]] = {}
        self._waiting_for_room: dict[Callable[[], None], None] = {}
        self._room_timer: asyncio.TimerHandle | None = None

    @property
    def epoch(self) -> int:
        """Grows with the files' epoch, and when cached decisions become invalid."""
        return self._files.epoch + self._epoch

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._epoch = epoch - self._files.epoch

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """What the files allow and no plugin refuses."""
        if isinstance(identity, UnclaimedIdentity):
            return Decision(True, "a plugin subscribed it; checked again when the client comes")
        decision = self._files.decide(identity, action, topic)
        if not decision or not self._plugins._topic_plugins:
            return decision
        if not self._is_blocking:
            answered, refusing = self._ask_now(identity, action, topic)
            if answered:
                if not refusing:
                    return decision
                return Decision(False, f"refused by {refusing}", cost=decision.cost)
        return replace(self._verdict((identity, action, topic)), cost=decision.cost)

    @property
    def timeout(self) -> float:
        """Seconds that a packet waits for an answer."""
        return self._guard.timeout

    def is_pending(self, query: AccessQuery, wake: Callable[[], None]) -> bool:
        """Whether there is no answer yet; `wake` is then called when there may be one."""
        decision = self.decide(*query)
        self._broker.counters.cost += decision.cost
        if not decision.pending:
            return False
        if query in self._asked:
            self._waiting.setdefault(query, {})[wake] = None
        else:
            self._waiting_for_room[wake] = None
            if self._room_timer is None:
                entries = Entries(asyncio.get_running_loop(), self._broker.faults)
                self._room_timer = entries.later(
                    "plugins.line",
                    ROOM_CHECK_INTERVAL,
                    self._wake_waiting_for_room,
                    failed=self._wake_waiting_for_room,
                )
        return True

    def _wake_waiting_for_room(self) -> None:
        self._room_timer = None
        waiting, self._waiting_for_room = self._waiting_for_room, {}
        for wake in waiting:
            self._broker.faults.run("plugins.wake", wake, otherwise=None)

    def changed(self) -> None:
        """Invalidate decisions that the broker has cached."""
        self._epoch += 1
        self._broker.router.changed()

    def close(self) -> None:
        """Cancel all questions."""
        for asking in self._asked.values():
            asking.cancel()
        self._waiting.clear()
        self._waiting_for_room.clear()
        if self._room_timer is not None:
            self._room_timer.cancel()

    def _ask_now(self, identity: Identity, action: Action, topic: str) -> tuple[bool, str]:
        """Whether all plugins answered without waiting, and the name of the one that refuses."""
        session = self._sessions.of_identity(identity)
        for plugin in self._plugins._topic_plugins:
            try:
                answer = (
                    _WOULD_BLOCK if blocks(plugin) else _answer_now(plugin, session, action, topic)
                )
            except Exception:
                # Whatever it was, perhaps the lack of a task: it is asked again in a task, and what
                # it raises there is logged.
                return False, ""
            if answer is _WOULD_BLOCK:
                self._is_blocking = True
                log.warning(
                    "%s has to wait before it can say whether a topic is allowed: what is asked "
                    "for the first time waits with it, for up to %g s",
                    plugin_name(plugin),
                    self.timeout,
                )
                return False, ""
            if not answer:  # As in amqtt, None is a no.
                return True, plugin_name(plugin)
        return True, ""

    def _verdict(self, query: AccessQuery) -> Decision:
        """The plugins' cached verdict; they are asked anew when it has expired."""
        decision, decided_at, epoch = self._verdicts.get(query, (None, 0.0, 0))
        age = asyncio.get_running_loop().time() - decided_at
        is_old = (
            decision is None
            or age > self.answers.topic_lifetime(allowed=decision.allowed)
            or epoch != self._files.epoch
        )
        if is_old and query not in self._asked:
            if not self._has_room(query[0]):
                return Decision(False, "the topic plugins have too many questions to answer", True)
            self._asked[query] = asyncio.ensure_future(self._ask(query))
        if decision is None or age > STALE_VERDICT_LIFETIME:
            return Decision(False, "the topic plugins were asked; the next try is answered", True)
        self._verdicts.move_to_end(query)
        return decision

    def _has_room(self, identity: Identity) -> bool:
        """Whether one more question about this client is allowed."""
        if len(self._asked) >= MAX_QUERIES:
            return False
        clients = [asked[0] for asked in self._asked if asked[0].username == identity.username]
        return len(clients) < MAX_USER_QUERIES and clients.count(identity) < MAX_CLIENT_QUERIES

    async def _ask(self, query: AccessQuery) -> None:
        """Ask all topic plugins and cache the verdict."""
        identity, action, topic = query
        session = self._sessions.of_identity(identity)
        try:
            answers = await self._guard.run(self._ask_all(session, action, topic))
        except asyncio.TimeoutError:
            reason = f"the topic plugins said nothing within {self._guard.timeout:g} s"
            decision = Decision(False, reason)
        except Exception as error:  # a plugin may raise anything
            self._guard.log_failure("an amqtt topic plugin", error)
            reason = redacted(repr(error), self._guard.secrets)
            decision = Decision(False, f"a topic plugin failed: {reason}")
        else:
            refusing = ", ".join(plugin_name(plugin) for plugin, yes in answers.items() if not yes)
            reason = f"refused by {refusing}" if refusing else "allowed by the topic plugins"
            decision = Decision(not refusing, reason)
        finally:
            del self._asked[query]
        try:
            self._cache(query, decision)
        finally:
            for wake in self._waiting.pop(query, {}):
                self._broker.faults.run("plugins.wake", wake, otherwise=None)

    async def _ask_all(
        self, session: AmqttSession, action: Action, topic: str
    ) -> dict[BaseTopicPlugin, object]:
        arguments = {"session": session, "topic": topic, "action": AmqttAction(action.value)}
        plugins: list[Any] = list(self._plugins._topic_plugins)
        asked = (self._threads.call(plugin, "topic_filtering", arguments) for plugin in plugins)
        return dict(zip(plugins, await asyncio.gather(*asked), strict=True))

    def _cache(self, query: AccessQuery, decision: Decision) -> None:
        before, _, _ = self._verdicts.pop(query, (None, 0.0, 0))
        now = asyncio.get_running_loop().time()
        self._verdicts[query] = decision, now, self._files.epoch
        if len(self._verdicts) > self.answers.size:
            self._verdicts.popitem(last=False)
        was_allowed = before is not None and before.allowed
        if was_allowed and not decision.allowed:
            self._epoch += 1
            self._broker.rules_changed()
        elif decision.allowed and not was_allowed:
            self.changed()


def _answer_now(
    plugin: BaseTopicPlugin, session: AmqttSession, action: Action, topic: str
) -> object:
    """The plugin's answer, or _WAITS when it has none without waiting."""
    asked = plugin.topic_filtering(session=session, topic=topic, action=AmqttAction(action.value))
    try:
        asked.send(None)
    except StopIteration as answer:
        return answer.value
    with contextlib.suppress(RuntimeError):  # it awaits something during its clean-up
        asked.close()
    return _WOULD_BLOCK
