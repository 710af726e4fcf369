"""The queues of a link's rules, in their lanes, and which journal each of them has."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from appliance.broker.backlogs import Backlogs, LatestRecords
from appliance.upstream.rates import TokenBucket
from appliance.upstream.rule_queue import RuleQueue
from appliance.upstream.rules import PRIORITIES, OutRule, Priority
from appliance.upstream.stored_rows import numbers_row

#: The name of the queue of messages that are too large for now; no filter has such a character.
HELD: Final = "\0too large"


class RuleQueues:
    """The queues of a link: those of its rules, and of former rules whose messages still wait."""

    def __init__(self, name: str, backlogs: Backlogs, latest: LatestRecords) -> None:
        self._name = name
        self._backlogs = backlogs
        self._latest = latest
        self.by_name: dict[str, RuleQueue] = {}
        #: By priority, the most urgent first; see `sort`.
        self.lanes: list[list[RuleQueue]] = [[] for _ in PRIORITIES]
        #: By the identity of each of these rules, which is faster than the value.
        self._rules: list[OutRule] = []
        self._of_rule: dict[int, RuleQueue] = {}
        #: By rule: the number of its journal; and the key of the row that says so.
        self._numbers: dict[str, int] = {}
        self._numbers_key: int | None = None

    def follow(self, rules: Iterable[OutRule], last_number: int, now: float) -> None:
        """Use these rules from now on. Messages up to `last_number` came before."""
        for queue in self.by_name.values():
            queue.configured = False
        self._rules = list(rules)
        self._of_rule.clear()
        for rule in self._rules:
            self._of_rule[id(rule)] = self.configure(rule, last_number, now)

    def configure(self, rule: OutRule, last_number: int, now: float) -> RuleQueue:
        """The queue of a rule, which follows it from now on; `sort` has to follow."""
        name = rule.local_filter
        queue = self.by_name.get(name)
        if queue is None:
            queue = self.by_name[name] = RuleQueue(rule)
        elif not queue.configured:
            if not queue.mixed and queue.stored:
                queue.note_restored(last_number)  # their topics were not noted
            queue.use(rule)
        queue.configured = True
        queue.bucket = bucket_of(queue.bucket, queue.rule.rate, now)
        return queue

    def of(self, rule: OutRule) -> RuleQueue | None:
        """The queue of one of the rules, if it is among those that `follow` was given."""
        return self._of_rule.get(id(rule))

    def orphaned(self, name: str) -> RuleQueue:
        """The queue of a rule that may not be in the configuration any more."""
        queue = self.by_name.get(name)
        if queue is None:
            # What cannot be sent now is the first to be dropped.
            priority: Priority = "low" if name == HELD else "normal"
            queue = self.by_name[name] = RuleQueue(OutRule(name, "", "", priority=priority))
            queue.configured = False
        return queue

    def sort(self) -> None:
        """Put each queue into its lane."""
        for queues in self.lanes:
            queues.clear()
        for queue in self.by_name.values():
            self.lanes[queue.lane].append(queue)

    def forget_drained(self) -> bool:
        """Forget rules that are no more and for which nothing waits; if there were any, `sort` has
        to follow."""
        drained = [
            each for each in self.by_name.values() if not each.configured and not each.messages
        ]
        for queue in drained:
            del self.by_name[queue.name]
            self._numbers.pop(queue.name, None)
        if any(queue.number >= 0 for queue in drained):
            self._put_numbers()
        return bool(drained)

    # --- the journals ---------------------------------------------------------------------------

    def restore(self, numbers: dict[str, int], key: int | None) -> list[RuleQueue]:
        """Open the journals with these numbers, which are in the row of that key."""
        self._numbers, self._numbers_key = numbers, key
        queues = [self.orphaned(name) for name in numbers]
        for queue in queues:
            self.open_journal(queue)
        return queues

    def open_journal(self, queue: RuleQueue) -> None:
        """Give the rule a journal; the number of it is stored before the first record."""
        number = self._numbers.get(queue.name)
        if number is None:
            number = 1 + max(self._numbers.values(), default=-1)
            self._numbers[queue.name] = number
            self._put_numbers()
        queue.number = number
        queue.journal = self._backlogs.journal(self._name, number)

    def _put_numbers(self) -> None:
        row = numbers_row(self._numbers)
        self._numbers_key = self._latest.put(self._numbers_key, row, awaited=False)


def bucket_of(bucket: TokenBucket | None, rate: float | None, now: float) -> TokenBucket | None:
    """The bucket of a rate: the same one if the rate has not changed."""
    if rate is None or (bucket is not None and bucket.rate == rate):
        return None if rate is None else bucket
    return TokenBucket(rate, now)
