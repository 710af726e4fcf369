"""What has to hold of messages that went through a link: pure functions, each returns problems.

Messages of a stream are numbered from 1 by their publisher, which never publishes a number twice.
Times are of one monotonic clock, in seconds.
"""

from __future__ import annotations

import bisect
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

#: How many numbers a problem names.
SHOWN = 10


@dataclass(frozen=True)
class Receipt:
    """A message came."""

    time: float
    number: int


def spans(numbers: Iterable[int]) -> str:
    """As `3-5, 9 and 2 more`: at most `SHOWN` spans."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    texts = [f"{low}-{high}" if high > low else str(low) for low, high in runs[:SHOWN]]
    more = f" and {len(runs) - SHOWN} more" if len(runs) > SHOWN else ""
    return ", ".join(texts) + more


def loss(stream: str, acknowledged: Collection[int], received: Collection[int]) -> list[str]:
    """Whatever was acknowledged has come."""
    missing = set(acknowledged) - set(received)
    if not missing:
        return []
    return [f"{stream}: LOST {len(missing)} of {len(acknowledged)}: {spans(missing)}"]


def inventions(stream: str, sent: int, received: Collection[int]) -> list[str]:
    """What has come was sent: numbers from 1 to `sent`."""
    wrong = [number for number in set(received) if not 1 <= number <= sent]
    return [f"{stream}: {len(wrong)} came that were never sent: {spans(wrong)}"] if wrong else []


def order(stream: str, received: Sequence[int], reconnects: int) -> list[str]:
    """Each message comes for the first time in order, and only a reconnect begins again.

    Sent again after a reconnect is a run that begins earlier and is in order itself.
    """
    problems = []
    newest = 0
    again: list[tuple[int, int]] = []
    before = 0
    seen: set[int] = set()
    for number in received:
        if number not in seen and number < newest:
            problems.append(f"{stream}: {number} for the first time after {newest}")
        if number <= before:
            again.append((before, number))
        seen.add(number)
        newest = max(newest, number)
        before = number
    if len(again) > reconnects:
        places = ", ".join(f"{a} → {b}" for a, b in again[:SHOWN])
        problems.append(
            f"{stream}: goes back {len(again)} times, {reconnects} reconnects: {places}"
        )
    if len(problems) > SHOWN:
        problems[SHOWN:] = [f"{stream}: {len(problems) - SHOWN} more out of order"]
    return problems


def repetition(
    stream: str,
    receipts: Sequence[Receipt],
    interruptions: Sequence[float],
    window: int,
    linger: float,
) -> list[str]:
    """No more is repeated than was in flight or acknowledged in the last `linger` seconds.

    A message that comes again was, at the last interruption before, among the `window` newest ones
    that had come, or had come at most `linger` seconds before it. `interruptions` are the times at
    which a connection or a process ended, ascending.
    """
    last: dict[int, Receipt] = {}
    arrivals: list[float] = []  # of numbers for the first time
    ranks: dict[int, int] = {}
    wrong: list[int] = []
    causeless: list[int] = []
    for receipt in receipts:
        earlier = last.get(receipt.number)
        if earlier is None:
            ranks[receipt.number] = len(arrivals)
            arrivals.append(receipt.time)
        else:
            index = bisect.bisect_right(interruptions, receipt.time) - 1
            if index < 0:
                causeless.append(receipt.number)
            else:
                when = interruptions[index]
                come = bisect.bisect_right(arrivals, when)
                in_flight = ranks[receipt.number] >= come - window
                if not in_flight and earlier.time < when - linger:
                    wrong.append(receipt.number)
        last[receipt.number] = receipt
    problems = []
    if wrong:
        problems.append(
            f"{stream}: {len(wrong)} REPEATED that were acknowledged more than {linger:g} s before"
            f" the end, and not among the last {window}: {spans(wrong)}"
        )
    if causeless:
        problems.append(f"{stream}: repeated without an interruption: {spans(causeless)}")
    return problems


def repeated(received: Sequence[int]) -> int:
    """How many of them had come before."""
    return len(received) - len(set(received))


def newest_kept(
    stream: str, published: int, received: Collection[int], dropped: int | None
) -> list[str]:
    """After an outage: exactly the newest were kept, and kept + dropped = published.

    `dropped` is what the link has counted, None if it does not say.
    """
    kept = set(received)
    problems = inventions(stream, published, kept)
    if published and not kept:
        problems.append(f"{stream}: NOTHING of {published} was kept")
    first = min(kept, default=published + 1)
    missing = set(range(first, published + 1)) - kept
    if missing:
        problems.append(
            f"{stream}: {len(missing)} are missing behind the oldest kept ({first}):"
            f" {spans(missing)}"
        )
    if dropped is not None and len(kept) + dropped != published:
        problems.append(
            f"{stream}: {len(kept)} kept + {dropped} dropped = {len(kept) + dropped},"
            f" and {published} were published"
        )
    return problems


def latest_only(
    published: Mapping[str, Sequence[bytes]], received: Mapping[str, Sequence[bytes]]
) -> list[str]:
    """After an outage each `latest` topic brings one message, the last that was published.

    By topic, what was published during the outage and what came after it; empty bytes are a
    deletion, which comes as any other.
    """
    problems = []
    for topic, payloads in published.items():
        came = list(received.get(topic, ()))
        if not payloads:
            expected: list[bytes] = []
        else:
            expected = [payloads[-1]]
        if came != expected:
            problems.append(
                f"{topic}: {len(came)} came, the last {came[-1][:20] if came else b''!r};"
                f" expected {[each[:20] for each in expected]}"
            )
    for topic in received.keys() - published.keys():
        problems.append(f"{topic} came, and was not published")
    return problems


@dataclass(frozen=True)
class Command:
    """A command: when it was sent there, and when it came here."""

    number: int
    sent: float
    came: float


def lateness(commands: Iterable[Command], late: float, slack: float) -> list[str]:
    """No command is older than `late` when it comes; `slack` is for the way behind the link."""
    old = [each for each in commands if each.came - each.sent > late + slack]
    if not old:
        return []
    worst = max(old, key=lambda each: each.came - each.sent)
    return [
        f"{len(old)} LATE commands: {spans(each.number for each in old)}; {worst.number} was"
        f" {worst.came - worst.sent:.3f} s old, and {late:g} s is the limit"
    ]


def answers(
    calls: Mapping[str, str], came: Iterable[tuple[str, str]], client_topics: Collection[str]
) -> list[str]:
    """Each call is answered once, at its caller's own topic.

    `calls` are response topics by correlation, `came` (topic, correlation) of all answers.
    """
    problems = []
    seen: dict[str, int] = {}
    for topic, correlation in came:
        if correlation not in calls:
            problems.append(f"an answer to nothing: {correlation} at {topic}")
        elif calls[correlation] != topic:
            problems.append(f"{correlation} is answered at {topic}, not at {calls[correlation]}")
        if topic not in client_topics:
            problems.append(f"an answer at {topic}, where nobody waits")
        seen[correlation] = seen.get(correlation, 0) + 1
    unanswered = [each for each in calls if each not in seen]
    twice = [each for each, count in seen.items() if count > 1]
    if unanswered:
        problems.append(f"{len(unanswered)} of {len(calls)} calls UNANSWERED: {unanswered[:SHOWN]}")
    if twice:
        problems.append(f"{len(twice)} calls are answered more than once: {twice[:SHOWN]}")
    if len(problems) > SHOWN:
        problems[SHOWN:] = [f"{len(problems) - SHOWN} more"]
    return problems


def growth(samples: Sequence[tuple[float, int]], limit: int) -> list[str]:
    """Memory, (time, bytes): the end is at most `limit` bytes above the beginning.

    Both are medians of a tenth of the samples, as single ones say little.
    """
    if len(samples) < 2:
        return []
    count = max(1, len(samples) // 10)
    first = sorted(size for _, size in samples[:count])[count // 2]
    end = sorted(size for _, size in samples[-count:])[count // 2]
    if end - first <= limit:
        return []
    mib = 1 << 20
    return [f"memory GREW from {first / mib:.1f} to {end / mib:.1f} MiB; {limit / mib:.0f} allowed"]


@dataclass(frozen=True)
class State:
    """What the fleet's broker said about the robot from `time` on: `online` or `offline`."""

    time: float
    value: str


def truth(
    states: Sequence[State], carried: Sequence[tuple[float, float, bool]], grace: float
) -> list[str]:
    """`online` and `offline` are true at the latest `grace` seconds after it has changed.

    `carried` are spans (from, to, whether the line carried); in each, from `grace` on until its
    end, the state is the right one. Spans shorter than that say nothing.
    """
    problems = []
    times = [state.time for state in states]
    for start, end, works in carried:
        wanted = "online" if works else "offline"
        if end - start <= grace:
            continue
        index = bisect.bisect_right(times, start + grace) - 1
        # The first value comes from before the span, or from its beginning.
        during = [states[index]] if index >= 0 else []
        during += [each for each in states if start + grace < each.time < end]
        wrong = [each for each in during if each.value != wanted]
        if wrong or not during:
            value = wrong[0].value if wrong else "nothing"
            problems.append(
                f"{grace:.1f} s after the line {'works' if works else 'is dead'} the fleet's broker"
                f" says {value} (at {start + grace:.1f} s)"
            )
    return problems
