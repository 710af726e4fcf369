"""Topics: what the ACL file and all of amqtt's topic plugins allow."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import OrderedDict
from typing import Final, TypeAlias

from amqtt.broker import BrokerContext
from amqtt.contexts import Action as AmqttAction
from amqtt.plugins.base import BaseTopicPlugin
from amqtt.plugins.manager import PluginManager
from amqtt.session import Session as AmqttSession

from appliance.broker.broker import Broker
from appliance.broker.ports import Access, Action, Decision, Identity

from .guard import Guard, name
from .views import Sessions, Unclaimed

log = logging.getLogger(__name__)

#: Seconds after which topic plugins are asked again, as they may have changed their mind.
VERDICT_AGE = 10.0
#: Seconds for which an older verdict holds while they are asked.
VERDICT_USE = 600.0
#: Verdicts of plugins that have to wait for something, kept in all.
VERDICTS = 4096
#: Questions to such plugins at one time.
QUESTIONS = 64

#: Who wants to do what with which topic.
Question: TypeAlias = "tuple[Identity, Action, str]"

#: The answer of a plugin that has none without waiting.
_WAITS: Final = object()


class PluginAccess:
    """The broker's `Access`: what the files and all topic plugins allow.

    The broker decides at once, and amqtt's topic plugins are coroutines. Those that never wait
    for anything (the rules of `TopicAccessControlListPlugin` or a token) are run on the spot. From
    the first time that one has to wait (for HTTP, SQL), all are asked in the background: what is
    asked for the first time is refused meanwhile, a SUBSCRIBE too, and the answer holds for the
    next try. An answer older than 10 s holds while they are asked again, for 10 minutes at most.
    Messages that already wait for a client are checked again when such an answer turns to no,
    or the files are read again.
    """

    def __init__(
        self,
        files: Access,
        broker: Broker,
        plugins: _Plugins,
        sessions: Sessions,
        failures: _Failures,
    ) -> None:
        self._files = files
        self._broker = broker
        self._plugins = plugins
        self._sessions = sessions
        self._failures = failures
        self._epoch = 0
        self._waits = False
        self._verdicts: OrderedDict[tuple[Identity, Action, str], tuple[Decision, float]] = (
            OrderedDict()
        )
        self._questions: dict[tuple[Identity, Action, str], asyncio.Task[None]] = {}

    @property
    def epoch(self) -> int:
        """Grows with the files' epoch, and when plugins have to be asked again."""
        return self._files.epoch + self._epoch

    @epoch.setter
    def epoch(self, epoch: int) -> None:
        self._epoch = epoch - self._files.epoch

    def decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        """What the files allow and no plugin refuses."""
        if isinstance(identity, Unclaimed):
            return Decision(True, "its plugin subscribed it; checked again when its client comes")
        decision = self._files.decide(identity, action, topic)
        plugins = self._plugins._topic_plugins
        if not decision or not plugins:
            return decision
        if not self._waits:
            session = self._sessions.of_identity(identity)
            for plugin in plugins:
                try:
                    allowed = self._ask_now(plugin, session, action, topic)
                except Exception:  # a plugin may raise anything, here also for want of a task
                    break
                if allowed is _WAITS:
                    self._waits = True
                    log.warning(
                        "%s has to wait before it can say whether a topic is allowed: what is "
                        "asked for the first time is refused meanwhile",
                        type(plugin).__name__,
                    )
                    break
                if not allowed:
                    return Decision(False, f"refused by {type(plugin).__name__}")
            else:
                return decision
        return self._verdict(identity, action, topic)

    def ask_again(self) -> None:
        """Let what was decided be decided again."""
        self._change()

    def close(self) -> None:
        """Ask no more."""
        for question in self._questions.values():
            question.cancel()

    def _ask_now(
        self, plugin: BaseTopicPlugin, session: AmqttSession, action: Action, topic: str
    ) -> object:
        """The plugin's answer, or _WAITS when there is none without waiting."""
        question = plugin.topic_filtering(
            session=session, topic=topic, action=AmqttAction(action.value)
        )
        try:
            question.send(None)
        except StopIteration as answer:
            return answer.value
        with contextlib.suppress(RuntimeError):  # it went on waiting while it was cleaning up
            question.close()
        return _WAITS

    def _verdict(self, identity: Identity, action: Action, topic: str) -> Decision:
        key = identity, action, topic
        now = asyncio.get_running_loop().time()
        decision, asked_at = self._verdicts.get(key, (None, 0.0))
        if decision is None or now - asked_at > VERDICT_AGE:
            if key not in self._questions:
                if len(self._questions) >= QUESTIONS:
                    return decision or Decision(False, f"{QUESTIONS} questions wait for plugins")
                self._questions[key] = asyncio.ensure_future(self._ask(key))
            if decision is None or now - asked_at > VERDICT_USE:
                return Decision(False, "the topic plugins have been asked; the next try will tell")
        self._verdicts.move_to_end(key)
        return decision

    async def _ask(self, key: tuple[Identity, Action, str]) -> None:
        """Ask all topic plugins, and keep what they say."""
        identity, action, topic = key
        loop = asyncio.get_running_loop()
        try:
            answers = await _within(
                PLUGIN_TIMEOUT,
                self._plugins.map_plugin_topic(
                    session=self._sessions.of_identity(identity),
                    topic=topic,
                    action=AmqttAction(action.value),
                ),
            )
        except asyncio.TimeoutError:
            decision = Decision(
                False, f"the topic plugins said nothing within {PLUGIN_TIMEOUT:g} s"
            )
        except Exception as error:  # a plugin may raise anything
            self._failures.tell("an amqtt topic plugin", error)
            decision = Decision(False, f"a topic plugin failed: {type(error).__name__}: {error}")
        else:
            # As amqtt does it, None is a no.
            refusing = [type(plugin).__name__ for plugin, yes in answers.items() if not yes]
            decision = Decision(not refusing, f"decided by plugins: {', '.join(refusing) or 'yes'}")
        finally:
            self._questions.pop(key, None)
        before, _ = self._verdicts.pop(key, (None, 0.0))
        self._verdicts[key] = decision, loop.time()
        if len(self._verdicts) > VERDICTS:
            self._verdicts.popitem(last=False)
        if before is not None and before.allowed and not decision.allowed:
            self._epoch += 1
            self._broker.rules_changed()
        elif decision.allowed != (before is not None and before.allowed):
            self._change()

    def _change(self) -> None:
        self._epoch += 1
        self._broker.epoch += 1


