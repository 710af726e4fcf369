"""Runs one attack on a real appliance, with a healthy client beside it, and judges the result."""

from __future__ import annotations

import re
import shutil
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from appliance_process import ApplianceProcess
from load import USER, Attack, Attacker
from witness import Over, Report, Target, Witness

MIB = 1 << 20

#: Round trips from which on the 99th percentile means something; some ten seconds of them.
MANY = 500

#: Access rules of both users. The attacker may do everything, so that only limits stop it.
ACL = f"""\
user alice
topic readwrite {{robot}}/#

user {USER}
topic readwrite {{robot}}/#
topic deny {{robot}}/forbidden/#
"""

#: Limits that differ from the defaults: less memory, so that the bound is reached soon, and more
#: connections per address, because all attackers come from one address here.
LIMITS: dict[str, Any] = {
    "memory": "64 MiB",
    "retained_bytes": "16 MiB",
    "connections_per_address": 1000,
    "connection_rate": 100_000,
    "connect_timeout": "1 s",
}

#: Those for WebSocket and for the web come before these: the appliance counts as started when it
#: listens on these two.
LISTENERS: list[dict[str, Any]] = [{"bind": "127.0.0.1:0", "tls": True}, {"bind": "127.0.0.1:0"}]

#: Bytes that the process may use beyond the configured limits: the objects and buffers of a
#: thousand TLS connections, and memory that the allocator does not return at once.
ALLOWANCE = 96 * MIB

#: Lines that the log may grow by, per second and per connection (whose number has limits of its
#: own, which are raised here), and the bytes per line.
LOG_LINES = 100
CONNECTION_LINES = 8
LINE = 500

#: How the problem begins of an attack that did not come so far that it was told of.
NOT_REACHED = "no line of the log matches"

#: Seconds that the healthy client is measured after the attack, whose end is a part of it.
AFTERMATH = 0.3


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one attack did; sizes in bytes. `problems` is empty when the broker withstood it."""

    attack: Attack
    transport: str
    seen: Report
    base: int
    peak: int
    bound: int
    log_lines: int
    matching_lines: int
    seconds: float
    counts: Counter[str]
    problems: list[str]


class Server:
    """An appliance that is restarted for every attack, the attacker's process and the witness's."""

    def __init__(self, directory: Path) -> None:
        self._appliance = ApplianceProcess(
            directory,
            users={USER: "knows the password"},
            acl=ACL,
            broker={
                "audit": {"path": "audit.log", "size": "1 MiB", "keep": 1},
                "listeners": [
                    *({"bind": "127.0.0.1:0", "protocol": kind} for kind in ("websocket", "web")),
                    *LISTENERS,
                ],
            },
        )
        self._audit = directory / "audit.log"
        self._settings: dict[str, Any] = yaml.safe_load(self._appliance.config.read_text())
        self._witness: Witness | None = None
        self._attacker: Attacker | None = None

    def close(self) -> None:
        """End all processes; may be called twice."""
        for process in (self._witness, self._attacker):
            if process is not None:
                process.end()
        self._witness = self._attacker = None

    def run(self, attack: Attack, ways: tuple[Over, ...], seconds: float) -> Outcome:
        """Run the attack; its connections alternate between these `ways`."""
        appliance = self._appliance
        limits = LIMITS | attack.limits
        self._settings["broker"]["limits"] = limits
        appliance.config.write_text(yaml.safe_dump(self._settings))
        logged_before = len(appliance.log)
        self._audit.unlink(missing_ok=True)
        # Start with an empty store.
        shutil.rmtree(appliance.directory / "state", ignore_errors=True)
        problems: list[str] = []
        appliance.start()
        try:
            measured = self._run_attack(attack, ways, max(seconds, attack.at_least))
        except (AssertionError, OSError, EOFError) as error:
            self.close()
            raise AssertionError(f"{attack.name}: {error!r}") from error
        finally:
            try:
                appliance.stop()
            except AssertionError as error:
                problems.append(str(error)[-600:])
        log = appliance.log[logged_before:]
        seen, counts, failure, base, peak, took = measured
        if failure:
            problems.append(f"the attack failed: {failure}")
        if seen.failure:
            problems.append(seen.failure)
        if seen.worst > attack.worst:
            problems.append(f"a round trip took {seen.worst * 1000:.0f} ms")
        # With few round trips the 99th percentile is the worst one, which has a bound of its own.
        part = 0.99 if len(seen.round_trips) >= MANY else 0.9
        if seen.percentile(part) > attack.p99:
            took_most = seen.percentile(part) * 1000
            problems.append(f"{part:.0%} of the round trips take up to {took_most:.0f} ms")
        bound = base + _size(limits["memory"]) + _size(limits["retained_bytes"]) + ALLOWANCE
        if peak > bound:
            problems.append(f"memory: {peak // MIB} MiB, over the bound of {bound // MIB} MiB")
        lines = log.splitlines()
        matching_lines = sum(1 for line in lines if re.search(attack.log_pattern, line))
        if not matching_lines and took >= attack.logged_after:
            problems.append(f"{NOT_REACHED} {attack.log_pattern!r}")
        allowed = LOG_LINES * (1 + took) + CONNECTION_LINES * counts["connections"]
        if len(lines) > allowed:
            problems.append(f"the log was flooded: {len(lines)} lines in {took:.1f} s")
        audited = sum(1 for _ in self._audit.open("rb"))
        if audited > allowed:
            problems.append(f"the audit log was flooded: {audited} lines in {took:.1f} s")
        if len(log) > LINE * allowed:
            problems.append(f"the log was flooded: {len(log)} bytes in {took:.1f} s")
        signs = ("Traceback", "internal error", "never awaited", "Exception in", "a fault in the")
        for sign in signs:
            if sign in log:
                at = log.index(sign)
                problems.append(f"in the log: {log[max(0, at - 300) : at + 1000]}")
                break
        over = "+".join(way.value for way in ways)
        sizes = base, peak, bound
        return Outcome(
            attack, over, seen, *sizes, len(lines), matching_lines, took, counts, problems
        )

    def _run_attack(
        self, attack: Attack, ways: tuple[Over, ...], seconds: float
    ) -> tuple[Report, Counter[str], str, int, int, float]:
        """Returns the witness's report, counts and failure of the attacker, RSS, peak, seconds."""
        appliance = self._appliance
        self._witness = witness = self._witness or Witness()
        self._attacker = attacker = self._attacker or Attacker()
        ports = appliance.port, appliance.plain_port
        web_port, http_port = (
            int(re.findall(rf"listening for {kind} on \S+:(\d+)$", appliance.log, re.M)[-1])
            for kind in ("WebSocket", "the web")
        )
        passwords = dict(appliance.passwords)
        target = Target(*ports, appliance.ca, passwords, web_port, http_port)
        witness.begin(target, ways[0])
        base = _status(appliance.pid, "VmRSS")
        # The peak is counted from here on; see proc(5), clear_refs.
        Path(f"/proc/{appliance.pid}/clear_refs").write_text("5")
        began = time.monotonic()
        counts, failure = attacker.attack(attack.name, target, ways, seconds)
        took = time.monotonic() - began
        time.sleep(AFTERMATH)
        seen = witness.report()
        return seen, counts, failure, base, _status(appliance.pid, "VmHWM"), took


def _size(text: str) -> int:
    number, unit = text.split()
    return int(number) * {"KiB": 1 << 10, "MiB": MIB}[unit]


def _status(pid: int, name: str) -> int:
    found = re.search(rf"^{name}:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.M)
    return int(found[1]) * 1024 if found is not None else 0  # the process has died
