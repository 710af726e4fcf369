"""`$SYS`: the broker's metrics under mosquitto's topic names, which tools know."""

from __future__ import annotations

from collections.abc import Callable

from appliance.broker.broker import Broker

PREFIX = "$SYS/broker/"

#: Minutes of the moving averages under load/.
_WINDOWS = (1, 5, 15)


class LoadAverage:
    """Moving averages of a counter's rate per minute, over 1, 5 and 15 minutes, as in `uptime`."""

    def __init__(self) -> None:
        self._last = 0
        self._averages = [0.0] * len(_WINDOWS)

    def update(self, value: int, seconds: float) -> None:
        """Add the counter's value, `seconds` after the previous one."""
        rate = (value - self._last) * 60 / seconds
        self._last = value
        for index, minutes in enumerate(_WINDOWS):
            weight = min(1.0, seconds / (minutes * 60))
            self._averages[index] += weight * (rate - self._averages[index])

    def values(self) -> list[tuple[str, str]]:
        """The averages with the last level of their topic."""
        return [
            (f"{minutes}min", f"{average:.2f}")
            for minutes, average in zip(_WINDOWS, self._averages, strict=True)
        ]


class SysTopics:
    """Computes the values; `update` returns those that have changed since its last call."""

    def __init__(self, broker: Broker, version: str, heap: Callable[[], int]) -> None:
        """`heap` returns the memory of the process, in bytes."""
        self._broker = broker
        self._heap = heap
        self._version = version
        self._started_at = broker.now
        self._updated_at = broker.now
        self._loads: dict[str, LoadAverage] = {}
        self._sent: dict[str, str] = {}

    def update(self) -> list[tuple[str, bytes]]:
        """The topics whose payloads have changed since the last call, with these."""
        changed = []
        for name, value in self._values().items():
            if self._sent.get(name) != value:
                self._sent[name] = value
                changed.append((PREFIX + name, value.encode()))
        return changed

    def _values(self) -> dict[str, str]:
        broker = self._broker
        counters = broker.counters
        connected = len(broker.clients)
        total = sum(1 for session in broker.sessions.values() if not session.is_inside)
        stored = len(broker.retained) + sum(
            session.waiting + sum(delivery is not None for delivery in session.inflight.values())
            for session in broker.sessions.values()
        )
        values: dict[str, str | int] = {
            "version": f"appliance version {self._version}",
            "uptime": f"{broker.now - self._started_at:.0f} seconds",
            "clients/connected": connected,
            "clients/disconnected": total - connected,
            "clients/expired": counters.sessions_expired,
            "clients/maximum": counters.clients_maximum,
            "clients/total": total,
            "messages/received": counters.messages_received,
            "messages/sent": counters.messages_sent,
            "messages/stored": stored,
            "publish/messages/received": counters.publish_received,
            "publish/messages/sent": counters.publish_sent,
            "publish/messages/dropped": counters.publish_dropped,
            "publish/bytes/received": counters.publish_bytes_received,
            "publish/bytes/sent": counters.publish_bytes_sent,
            "bytes/received": counters.bytes_received,
            "bytes/sent": counters.bytes_sent,
            "subscriptions/count": broker.subscription_count,
            "shared_subscriptions/count": broker.shared_subscription_count,
            "retained messages/count": len(broker.retained),
            "store/messages/count": stored,
            "heap/current": self._heap(),
            "errors": broker.faults.count,
            "store/messages/bytes": broker.retained.bytes + broker.accounting.queued_bytes,
        }
        return {name: str(value) for name, value in values.items()} | self._load()

    def _load(self) -> dict[str, str]:
        counters = self._broker.counters
        seconds = self._broker.now - self._updated_at
        self._updated_at = self._broker.now
        values: dict[str, str] = {}
        for name, value in {
            "messages/received": counters.messages_received,
            "messages/sent": counters.messages_sent,
            "publish/received": counters.publish_received,
            "publish/sent": counters.publish_sent,
            "publish/dropped": counters.publish_dropped,
            "bytes/received": counters.bytes_received,
            "bytes/sent": counters.bytes_sent,
            "connections": counters.connects,
            "sockets": counters.sockets,
        }.items():
            load = self._loads.setdefault(name, LoadAverage())
            if seconds > 0:
                load.update(value, seconds)
            values |= {f"load/{name}/{minutes}": text for minutes, text in load.values()}
        return values
