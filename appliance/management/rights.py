"""The verbs about rights: what the caller may do, and why a user may or may not."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from appliance.access import ActionVerdict, FileAccess
from appliance.broker.broker import Broker
from appliance.broker.values import Action, Decision, Identity
from appliance.management.verb_thread import VerbThread
from appliance.management.verbs import Arguments, Caller, Name, Verb
from appliance.mqtt.codec import quote
from appliance.mqtt.topics import check_filter, check_topic, parse_shared
from appliance.ros.calls.dispatcher import CallError

#: The most questions of one call: a page of a console has some dozens of controls.
MOST_QUESTIONS: Final = 200

#: The most rules that an explanation lists because they do not apply.
_MOST_PASSED: Final = 100

#: The cost of a decision about a topic that was not asked about before.
_COST: Final = 10

#: Seconds after which the other questions of a call wait for the caller's next turn: to decide
#: about a wide filter takes a hundredth of a millisecond for each rule below it.
_ROUND: Final = 0.005

_ACTIONS: Final = {
    "publish": Action.PUBLISH,
    "subscribe": Action.SUBSCRIBE,
    "receive": Action.RECEIVE,
}
_ACCESS: Final = {Action.PUBLISH: "write", Action.SUBSCRIBE: "read", Action.RECEIVE: "read"}


@dataclass(eq=False)
class Question(Arguments):
    """May I do this? `topic` is a filter for a subscription."""

    action: Literal["publish", "subscribe", "receive"]
    topic: Name


@dataclass(eq=False)
class Questions(Arguments):
    """What the caller wants to know of itself."""

    questions: Annotated[list[Question], Field(max_length=MOST_QUESTIONS)]


@dataclass(eq=False)
class Explain(Arguments):
    """A user, None for clients without one, and a topic or filter."""

    user: Name | None
    topic: Name
    client: Name = ""


class RightsVerbs:
    """The verbs about rights; on the event loop, as the rules are."""

    def __init__(self, broker: Broker, access: FileAccess, thread: VerbThread) -> None:
        self._broker = broker
        self._access = access
        self._thread = thread

    def verbs(self) -> Iterator[Verb[Any]]:
        """All of them."""
        # On the control socket nobody has rights.
        yield Verb("rights", Questions, self._rights, is_local=False)
        yield Verb("explain", Explain, self._explain)

    async def _rights(self, caller: Caller, wanted: Questions) -> dict[str, Any]:
        assert caller.identity is not None
        identity = caller.identity
        clock = asyncio.get_running_loop().time
        rights: list[dict[str, Any]] = []
        began = clock()
        for question in wanted.questions:
            if clock() - began > _ROUND:
                await caller.turn()
                began = clock()
            self._broker.counters.cost += _COST
            rights.append(self._right(identity, question))
        return {"rights": rights}

    def _right(self, identity: Identity, question: Question) -> dict[str, Any]:
        action, topic = _ACTIONS[question.action], question.topic
        decision = self._decide(identity, action, topic)
        answer: dict[str, Any] = {
            "action": question.action,
            "topic": topic,
            "allowed": decision.allowed,
            "reason": decision.reason,
        }
        acl = self._access.acl
        if acl is None or decision.allowed:
            return answer
        return answer | self._line(acl.verdict(identity, action, topic), topic)

    def _decide(self, identity: Identity, action: Action, topic: str) -> Decision:
        router = self._broker.router
        try:
            if action is not Action.SUBSCRIBE:
                check_topic(topic)
            elif parse_shared(topic) is None:
                check_filter(topic)
            excess = router.excess(topic)
            if excess:
                raise ValueError(f"it has {excess}")
        except ValueError as error:
            raise CallError("bad_request", f"{quote(topic[:200])}: {error}") from None
        if action is Action.PUBLISH:
            return router.may_publish(identity, topic)
        return router.decide(identity, action, topic)

    def _line(self, verdict: ActionVerdict, topic: str) -> dict[str, str]:
        """The `line` that would allow it where a rule is missing: none helps against one that
        denies, or where nobody may publish."""
        if verdict.allowed or verdict.rule is not None:
            return {}
        if verdict.action is Action.PUBLISH and self._broker.router.reserved_for(topic):
            return {}
        return {"line": f"topic {_ACCESS[verdict.action]} {_filter(topic)}"}

    async def _explain(self, caller: Caller, wanted: Explain) -> dict[str, Any]:
        acl, identity = self._access.acl, Identity(wanted.user, wanted.client)
        if acl is None:
            raise CallError("rejected", "there is no ACL file")
        try:
            # In a thread: it names all rules that do not apply, and there may be 100,000.
            explain = partial(acl.explain, identity, wanted.topic)
            explanation = await self._thread.run(caller.user, explain)
        except ValueError as error:
            raise CallError("bad_request", f"{quote(wanted.topic[:200])}: {error}") from None
        verdicts = [
            _verdict(each) | self._line(each, wanted.topic) for each in explanation.verdicts
        ]
        return {"user": wanted.user, "topic": wanted.topic, "verdicts": verdicts}


def _verdict(verdict: ActionVerdict) -> dict[str, Any]:
    passed = [f"{rule} ({why})" for rule, why in verdict.passed_over[:_MOST_PASSED]]
    return {
        "action": verdict.action.value,
        "allowed": verdict.allowed,
        "reason": verdict.reason,
        "included_by": list(verdict.rule.via) if verdict.rule is not None else [],
        "passed_over": passed,
        "passed_over_count": len(verdict.passed_over),
    }


def _filter(topic: str) -> str:
    """The filter for a rule: of a group's subscription the filter alone."""
    shared = parse_shared(topic)
    return topic if shared is None else shared[1]
