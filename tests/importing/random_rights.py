"""mosquitto and the imported appliance, side by side, with random configurations and clients::

    .venv/bin/python tests/importing/random_rights.py --seeds 500

Each seed is a configuration with users, rules, certificates and listeners (see random_files.py).
Both brokers get it, and the same clients log in, subscribe and publish. Whatever the appliance
allows and mosquitto does not is a fault; what it allows less has to be explained by the import's
report, or by a difference that docs/import.md names.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import re
import shutil
import ssl
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

sys.path.insert(0, str(Path(__file__).parent.parent))

import yaml
from appliance_process import MOSQUITTO, free_ports

from appliance import config
from appliance.app.main import App
from appliance.config import ConfigError
from appliance.importing import Imported, ImportProblemsError, import_mosquitto
from appliance.mqtt.codec import decode_varint
from appliance.mqtt.packets import (
    Connack,
    Connect,
    Disconnect,
    Packet,
    Pingreq,
    Pingresp,
    Puback,
    Pubcomp,
    Publish,
    Pubrec,
    Pubrel,
    Suback,
    Subscribe,
    Subscription,
    Will,
    decode_packet,
)
from importing.random_files import ROBOT, Case, Login, Sent, make, make_certificates

#: Seconds for one answer. A broker that gives none has failed.
PATIENCE = 60.0

#: The most listeners of a case.
LISTENERS = 3

#: A login that was let in, and one whose listener or TLS did not even answer.
LET_IN, NO_ANSWER = 0, -1


P = TypeVar("P", bound=Packet)


_ACKNOWLEDGEMENTS: dict[int, type[Puback] | type[Pubrec]] = {0x40: Puback, 0x50: Pubrec}


class EndedError(Exception):
    """The broker has closed the connection."""


class Client:
    """A connection to one of the brokers; `heard` is what has come, topic and payload."""

    def __init__(self, login: Login, pki: Path) -> None:
        self.login = login
        self.heard: set[tuple[str, bytes]] = set()
        self.code = NO_ANSWER
        self._pki = pki
        self._version = 5 if login.version == 5 else 4
        self._packet_id = 0
        self._writer: asyncio.StreamWriter | None = None
        self._arrived: asyncio.Queue[Packet | None] = asyncio.Queue()
        self._reading: asyncio.Task[None] | None = None

    async def log_in(self, will: Sent | None = None) -> int:
        """The code of CONNACK, or NO_ANSWER."""
        login = self.login
        connect = Connect(
            login.client_id,
            version=login.version,
            username=login.username,
            password=None if login.password is None else login.password.encode(),
            keep_alive=60,
            will=_will(will, login),
        )
        if login.version != 5 and login.username is None:
            connect.password = None
        try:
            await self._open()
            assert self._writer is not None
            self._writer.write(connect.encode())
            answer = await self._next(Connack)
            self.code = answer.reason_code
        except (OSError, EndedError):
            self.code = NO_ANSWER
        return self.code

    async def _open(self) -> None:
        context = None
        if self.login.tls:
            context = ssl.create_default_context(cafile=self._pki / "ca.crt")
            context.check_hostname = False
            shown = self.login.certificate
            if shown is not None:
                folder, _, name = shown.rpartition("/")
                clients = self._pki / folder / "clients"
                context.load_cert_chain(clients / f"{name}.crt", clients / f"{name}.key")
        self._reader, self._writer = await asyncio.open_connection(
            "127.0.0.1", self.login.port, ssl=context
        )
        self._reading = asyncio.ensure_future(self._read())

    async def subscribe(self, *filters: tuple[str, int]) -> list[int]:
        """The codes of SUBACK."""
        self._packet_id += 1
        wanted = [Subscription(name, qos) for name, qos in filters]
        self._send(Subscribe(self._packet_id, wanted))
        return list((await self._next(Suback)).reason_codes)

    async def publish(self, sent: Sent, payload: bytes) -> str:
        """What the broker said: taken, refused; or nothing, with QoS 0 or before MQTT 5."""
        self._packet_id += 1
        packet_id = self._packet_id if sent.qos else None
        self._send(Publish(sent.topic, payload, sent.qos, sent.retain, packet_id=packet_id))
        code = 0
        if sent.qos == 0:
            await self.ping()
        elif sent.qos == 1:
            code = (await self._next(Puback)).reason_code
        else:
            code = (await self._next(Pubrec)).reason_code
            if code < 0x80:
                self._send(Pubrel(self._packet_id))
                code = (await self._next(Pubcomp)).reason_code
        if sent.qos == 0 or self._version != 5:
            return "unknown"
        return "taken" if code < 0x80 else "refused"

    async def ping(self) -> None:
        """Until everything has come that the broker had for this client."""
        known = -1
        while len(self.heard) > known:  # acknowledgements may bring more
            known = len(self.heard)
            self._send(Pingreq())
            await self._next(Pingresp)

    async def offend(self) -> None:
        """Send a packet that does not exist: the connection ends, and the will is published."""
        assert self._writer is not None
        with contextlib.suppress(EndedError, OSError):
            self._writer.write(b"\0\0")
            while True:
                await self._next(Disconnect)

    def close(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
        if self._writer is not None:
            self._writer.transport.abort()

    def _send(self, packet: Packet) -> None:
        assert self._writer is not None
        self._writer.write(packet.encode(self._version))

    async def _next(self, kind: type[P]) -> P:
        while True:
            packet = await asyncio.wait_for(self._arrived.get(), PATIENCE)
            if packet is None or isinstance(packet, Disconnect):
                self._arrived.put_nowait(None)  # for who asks again
                raise EndedError
            if isinstance(packet, kind):
                return packet

    async def _read(self) -> None:
        """Take messages at once, or they would wait for room with the broker."""
        try:
            while True:
                packet = await self._receive()
                if isinstance(packet, Publish):
                    self._take(packet)
                elif isinstance(packet, Pubrel):
                    self._send(Pubcomp(packet.packet_id))
                else:
                    self._arrived.put_nowait(packet)
        except EndedError:
            self._arrived.put_nowait(None)

    def _take(self, packet: Publish) -> None:
        self.heard.add((packet.topic, packet.payload))
        if packet.qos == 1:
            self._send(Puback(packet.packet_id or 0))
        elif packet.qos == 2:
            self._send(Pubrec(packet.packet_id or 0))

    async def _receive(self) -> Packet:
        try:
            header = await self._reader.readexactly(2)
            while header[-1] & 0x80:
                header += await self._reader.readexactly(1)
            length, _ = decode_varint(header, 1)
            body = await self._reader.readexactly(length)
        except (OSError, asyncio.IncompleteReadError):
            raise EndedError from None
        kind = _ACKNOWLEDGEMENTS.get(header[0])
        if kind is not None and len(body) > 2:
            # mosquitto's 0x95 is none that these packets can have.
            return kind(int.from_bytes(body[:2], "big"), body[2])
        return decode_packet(header[0], body, self._version)


def _will(will: Sent | None, login: Login) -> Will | None:
    if will is None:
        return None
    return Will(will.topic, _payload("will", will, login), will.qos, will.retain)


def _payload(name: str, sent: Sent, login: Login) -> bytes:
    return f"{name} of {login}: ".encode().ljust(sent.size, b".")


@dataclass
class Seen:
    """What the clients of a case have seen of one broker; by the number of the login."""

    codes: dict[int, int] = field(default_factory=dict)
    #: Let in, and gone before it could do anything: another client has its id.
    gone: set[int] = field(default_factory=set)
    granted: dict[tuple[int, str], int] = field(default_factory=dict)
    #: By login and topic: taken, refused, unknown, or ended.
    answers: dict[tuple[int, str], str] = field(default_factory=dict)
    heard: dict[int, set[tuple[str, bytes]]] = field(default_factory=dict)
    retained: dict[int, set[tuple[str, bytes]]] = field(default_factory=dict)


async def observe(case: Case, pki: Path) -> Seen:
    """Let all clients of a case try what they want."""
    seen = Seen()
    clients = [Client(login, pki) for login in case.logins]
    try:
        for number, client in enumerate(clients):
            seen.codes[number] = await client.log_in(case.wills[number])
        present = {n: client for n, client in enumerate(clients) if client.code == LET_IN}
        for number, client in list(present.items()):
            try:
                for each in (*case.filters[number], ("#", 0)):
                    (seen.granted[number, each[0]],) = await client.subscribe(each)
            except EndedError:
                seen.gone.add(number)
                del present[number]
        for number in present:
            await _publish_all(case, number, present, seen, pki)
        for number, client in list(present.items()):
            if case.wills[number] is not None:
                await client.offend()
                seen.heard[number] = _without_own(client.heard)
                del present[number]
        for number, client in present.items():
            with contextlib.suppress(EndedError):
                await client.ping()
            seen.heard[number] = _without_own(client.heard)
            client.heard.clear()
            with contextlib.suppress(EndedError):
                await client.subscribe(("#", 0))
                await client.ping()
            seen.retained[number] = _without_own(client.heard)
        return seen
    finally:
        for client in clients:
            client.close()


async def _publish_all(
    case: Case, number: int, present: dict[int, Client], seen: Seen, pki: Path
) -> None:
    for sent in case.sent[number]:
        client = present[number]
        payload = _payload("message", sent, client.login)
        try:
            seen.answers[number, sent.topic] = await client.publish(sent, payload)
        except EndedError:
            seen.answers[number, sent.topic] = "ended"
            client.close()
            again = Client(client.login, pki)
            again.heard = client.heard
            await again.log_in(case.wills[number])
            with contextlib.suppress(EndedError, AssertionError):
                for each in (*case.filters[number], ("#", 0)):
                    await again.subscribe(each)
            present[number] = again


def _without_own(heard: set[tuple[str, bytes]]) -> set[tuple[str, bytes]]:
    """Without what the brokers themselves publish: their state."""
    return {
        each
        for each in heard
        if not each[0].startswith((f"{ROBOT}/_appliance", "$SYS/broker", "$SYS/appliance"))
    }


# The brokers


@contextlib.asynccontextmanager
async def mosquitto(path: Path) -> AsyncIterator[bool]:
    """mosquitto; False when it does not start with that."""
    assert MOSQUITTO is not None
    process = await asyncio.create_subprocess_exec(
        MOSQUITTO, "-c", path, cwd=path.parent, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    said = b""
    try:
        while True:
            line = await asyncio.wait_for(process.stderr.readline(), PATIENCE)
            said += line
            if not line or re.search(rb"mosquitto version \S+ running", line):
                break
        reading = asyncio.ensure_future(process.stderr.read())  # or it would wait for a reader
        if not line:
            (path.parent / "refused.log").write_bytes(said)
        yield bool(line)
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()
        (path.parent / "mosquitto.log").write_bytes(said + await reading)


@contextlib.asynccontextmanager
async def appliance(imported: Imported, directory: Path) -> AsyncIterator[None]:
    """The appliance with what was imported, without ROS and links, and patient with guesses."""
    app = App(_write(imported, directory))
    await app.start()
    try:
        yield
    finally:
        await app.stop()


def _write(imported: Imported, directory: Path) -> config.Settings:
    directory.mkdir()
    for file in imported.files:
        (directory / file.name).write_text(file.text)
        (directory / file.name).chmod(0o600)
    path = directory / "appliance.yaml"
    config.load(path)  # as it was imported
    settings = yaml.safe_load(path.read_text())
    settings["bridge"] = {"bus": "none"}
    settings.pop("upstreams", None)
    limits = {"failed_logins": 1000, "connect_timeout": f"{PATIENCE:.0f} s"}
    settings["broker"].setdefault("limits", {}).update(limits)
    path.write_text(yaml.safe_dump(settings))
    return config.load(path)


# The comparison


@dataclass
class Result:
    """Of one seed: faults, and what is less with its reason; `skipped` when there is nothing."""

    faults: list[str] = field(default_factory=list)
    less: Counter[str] = field(default_factory=Counter)
    skipped: str = ""
    same: int = 0


async def compare(seed: int, directory: Path, pki: Path) -> Result:
    """Run both brokers with the case of that number."""
    result = Result()
    case = make(seed, free_ports(LISTENERS), pki)
    path = case.write(directory)
    async with mosquitto(path) as runs:
        if not runs:
            result.skipped = "mosquitto does not start with it"
            return result
        theirs = await observe(case, pki)
    try:
        imported = import_mosquitto(path, ROBOT)
    except ImportProblemsError as error:
        result.less["nothing imported"] += 1
        if "no listener can be carried over" not in str(error):
            result.faults.append(f"mosquitto starts with it, the import does not: {error}")
        return result
    try:
        async with appliance(imported, directory / "imported"):
            ours = await observe(case, pki)
    except ConfigError as error:
        result.faults.append(f"the appliance does not start with what was imported: {error}")
        return result
    return judge(case, theirs, ours, imported)


def judge(case: Case, theirs: Seen, ours: Seen, imported: Imported) -> Result:
    """Compare what the clients have seen of mosquitto with what they have seen here."""
    comparison = _Comparison(case, theirs, ours, imported)
    comparison.run()
    return comparison.result


class _Comparison:
    def __init__(self, case: Case, theirs: Seen, ours: Seen, imported: Imported) -> None:
        self._case = case
        self._theirs = theirs
        self._ours = ours
        self.result = Result()
        self._report = "\n".join(map(str, imported.notes))
        broker = yaml.safe_load(imported.files[-1].text)["broker"]
        self._ports = {int(each["bind"].rpartition(":")[2]) for each in broker["listeners"]}

    def run(self) -> None:
        self._connects()
        self._both = [
            number
            for number, code in self._ours.codes.items()
            if code == LET_IN == self._theirs.codes[number]
        ]
        self._both = [n for n in self._both if n not in self._theirs.gone | self._ours.gone]
        self._grants()
        self._answers()
        for what in ("heard", "retained"):
            self._deliveries(what, getattr(self._theirs, what), getattr(self._ours, what))

    def _more(self, text: str) -> None:
        self.result.faults.append(f"allowed here alone: {text}")

    def _less(self, text: str, reason: str) -> None:
        if reason:
            self.result.less[reason] += 1
        else:
            self.result.faults.append(f"refused here, and nothing says so: {text}")

    def _said(self, text: str) -> bool:
        return text in self._report

    def _connects(self) -> None:
        for number, login in enumerate(self._case.logins):
            theirs, ours = self._theirs.codes[number], self._ours.codes[number]
            said = f"{login}: 0x{theirs:X} of mosquitto, 0x{ours:X} here"
            if ours == LET_IN and theirs != LET_IN:
                if not login.client_id and self._said("allow_zero_length_clientid: clients with"):
                    self.result.less["let in without a client id, as the report says"] += 1
                else:
                    self._more(said)
            elif theirs == LET_IN and ours != LET_IN:
                self._less(said, self._why_out(login))
            else:
                self.result.same += 1

    def _why_out(self, login: Login) -> str:
        """Why a client is not let in here."""
        is_named = login.username is not None
        reasons = {
            "its listener is left out": login.port not in self._ports and self._said("left out"),
            "its listener lets in users alone": self._said("it lets none in"),
            "names are checked": is_named and self._said("who gives a user name is checked here"),
            "an empty user name is nobody's": login.username == "",
            "its name is not that of its certificate": is_named
            and login.certificate is not None
            and self._said("another user name than its certificate's"),
            "it needs a new password": self._said(f"appliance user add {login.username}"),
            "its keep alive is too long": login.version != 5
            and self._said("are refused if they ask for more"),
        }
        return next((reason for reason, holds in reasons.items() if holds), "")

    def _why_without_right(self, number: int, topic: str) -> str:
        """Why a client has no right to a topic here."""
        login = self._case.logins[number]
        wild = re.search(r"[+#]", f"{login.client_id}{login.username or ''}")
        reasons = {
            "+ or # is in its name, and patterns give it nothing": wild is not None,
            "a name with / is not put into a pattern": re.search(
                "/", f"{login.client_id}{login.username or ''}"
            ),
            "its listener had no rules": self._said("has no acl_file; its users have the rules of"),
            "a rule is left out": re.search(r"acl\d:\d+: .* is left out", self._report),
            "a rule denies more": self._said("denies more than it did"),
        }
        return next((reason for reason, holds in reasons.items() if holds), "")

    def _grants(self) -> None:
        for (number, name), ours in self._ours.granted.items():
            theirs = self._theirs.granted.get((number, name))
            if number not in self._both or theirs is None:
                continue
            said = f"{self._case.logins[number]}: {name}: 0x{theirs:X} of mosquitto, 0x{ours:X}"
            if ours < 0x80 and (theirs >= 0x80 or ours > theirs):
                self._more(said)
            elif ours >= 0x80 > theirs:
                self.result.less["SUBSCRIBE to what may not be read is refused"] += 1
            elif ours < theirs:
                self._less(said, "")
            else:
                self.result.same += 1

    def _answers(self) -> None:
        for (number, topic), ours in self._ours.answers.items():
            theirs = self._theirs.answers.get((number, topic))
            if number not in self._both or theirs is None:
                continue
            said = f"{self._case.logins[number]}: PUBLISH {topic}: {theirs} by mosquitto, {ours}"
            good = ("taken", "unknown")
            if ours in good and theirs not in good:
                self._more(said)
            elif theirs in good and ours not in good:
                self._less(said, self._why_without_right(number, topic))
            else:
                self.result.same += 1

    def _deliveries(
        self,
        what: str,
        theirs: dict[int, set[tuple[str, bytes]]],
        ours: dict[int, set[tuple[str, bytes]]],
    ) -> None:
        for number in self._both:
            mine, other = ours.get(number, set()), theirs.get(number, set())
            self.result.same += len(mine & other)
            login = self._case.logins[number]
            more = mine - other
            if what == "retained":
                # Of a topic the last counts: there another one's, who is not let in here.
                more = {each for each in more if each[0] not in dict(other)}
            for topic, payload in sorted(more):
                self._more(f"{login}: {what} {topic!r} ({payload[:90]!r})")
            for topic, payload in sorted(other - mine):
                said = f"{login}: not {what} {topic!r} ({payload[:90]!r})"
                self._less(said, self._why_unheard(number, topic, payload))

    def _why_unheard(self, number: int, topic: str, payload: bytes) -> str:
        sender = next(
            n for n, login in enumerate(self._case.logins) if f" of {login}: ".encode() in payload
        )
        if sender not in self._both:
            return "its sender is not let in"
        if self._ours.answers.get((sender, topic)) in ("refused", "ended"):
            return "its sender may not publish it"
        return self._why_without_right(number, topic) or self._why_without_right(sender, topic)


def run(seeds: Iterable[int], say: Callable[[str], None]) -> tuple[list[str], Counter[str], int]:
    """The faults of all seeds, what is less by reason, and how much was the same."""
    faults: list[str] = []
    less: Counter[str] = Counter()
    same = 0
    with tempfile.TemporaryDirectory(prefix="rights-") as name:
        pki = Path(name, "pki")
        make_certificates(pki)
        for seed in seeds:
            directory = Path(name, str(seed))
            directory.mkdir()
            result = asyncio.run(compare(seed, directory, pki))
            faults += [f"seed {seed}: {fault}" for fault in result.faults]
            less += result.less
            if result.skipped:
                less[f"skipped: {result.skipped}"] += 1
            same += result.same
            for fault in result.faults[:5]:
                say(f"seed {seed}: {fault}")
            shutil.rmtree(directory)
    return faults, less, same


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python tests/importing/random_rights.py",
        description="mosquitto and the imported appliance, with random configurations.",
    )
    parser.add_argument("--seeds", type=int, default=100, help="how many (default: 100)")
    parser.add_argument("--first", type=int, default=1, help="the first of them (default: 1)")
    parser.add_argument("--show", action="store_true", help="the configuration of --first")
    options = parser.parse_args()
    if options.show:
        case = make(options.first, free_ports(LISTENERS), Path("PKI"))
        for name, text in case.files.items():
            print(f"--- {name}\n{text}")
        return 0
    logging.disable(logging.CRITICAL)
    began = time.monotonic()
    faults, less, same = run(range(options.first, options.first + options.seeds), print)
    for reason, count in less.most_common():
        print(f"{count:7} {reason}")
    print(f"{same:7} the same")
    print(f"{len(faults)} faults in {options.seeds} seeds, {time.monotonic() - began:.0f} s")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
