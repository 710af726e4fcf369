"""Does an old command move the robot? Real clients, a real appliance, a real node of ROS.

    python tests/ros/old_commands.py [--clients paho,mqttjs,bridge] [--only SCENARIO …]

The clients are paho, MQTT.js and the bridge of a mosquitto with a paho client behind it, each in
MQTT 3.1.1 and 5 and with QoS 0 and 1, with the defaults of their libraries: a new client id, no
session that outlives a connection, and a queue for what is published without one. They command
`/cmd_vel` all at once, on a route with `expire` and `on_silence`. A table tells, for each scenario
and client, how many of its commands moved the robot, how old the oldest of them was, and whether
that is right. Ages are from the client's call of `publish` to here, by a clock that all processes
of a computer share.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import yaml

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent), str(HERE.parent.parent)]

from appliance_process import HOST, MOSQUITTO, ROBOT, ApplianceProcess, free_ports  # noqa: E402
from ros_domain import DOMAIN  # noqa: E402
from upstream.relay import Relay  # noqa: E402
from waiting import PATIENCE, until  # noqa: E402

from appliance.host.environment import for_other_programs  # noqa: E402

TWIST = "geometry_msgs/msg/Twist"

#: Seconds: `expire` of the route, and what a busy computer may add to an age.
EXPIRE = 0.5
TOLERANCE = 0.4

#: Commands a second of a stream, and the last that may be the first to move the robot: it is the
#: third to come at this pace, and an interpreter that warms up sends some in one go before.
RATE = 20
FIRST_OF_A_STREAM = 4

#: How often it is tried whether new commands move the robot.
TRIES = 4

#: Seconds that clients steer on without a connection, and from then until there is one.
STEERED_ON, AWAY = 1.5, 3.0


@dataclass
class Moved:
    """A command that moved the robot: its number, and seconds."""

    number: int
    made_at: float
    at: float

    @property
    def age(self) -> float:
        return self.at - self.made_at


@dataclass
class Outcome:
    """A line of the table."""

    scenario: str
    client: str
    version: str
    qos: int
    sent: int
    moved: int
    #: Seconds.
    oldest: float | None
    #: What is wrong; empty when all is well.
    problem: str


class Robot:
    """The appliance, the network before it, and a node that is moved."""

    def __init__(self, directory):
        self.directory = directory
        self.appliance = ApplianceProcess(directory, acl=f"user alice\ntopic {ROBOT}/#\n")
        config = self.appliance.config
        settings = yaml.safe_load(config.read_text())
        self.ports = free_ports(2)
        settings["broker"]["listeners"] = [
            {"bind": f"127.0.0.1:{self.ports[0]}", "tls": True},
            {"bind": f"127.0.0.1:{self.ports[1]}"},
        ]
        route = {
            "ros": "/cmd_vel",
            "to": "ros",
            "type": TWIST,
            "expire": f"{EXPIRE * 1000:.0f} ms",
            "on_silence": {"after": f"{EXPIRE * 1000:.0f} ms"},
        }
        settings["bridge"] = {"topics": [route]}
        config.write_text(yaml.safe_dump(settings))
        self.network = Relay(self.ports[1])
        (self.network.port,) = free_ports(1)
        #: By client.
        self.moved: dict[int, list[Moved]] = {}
        self.stops = 0

    async def start(self, *, is_reached):
        """`is_reached`: there is a network before it."""
        from ros2_harness import Peer

        await asyncio.to_thread(self.appliance.start)
        self.peer = Peer()
        self.peer.received = self
        await self.peer.start("robot")
        await self.peer.do("subscribe", "/cmd_vel", TWIST)
        await until(lambda: self.stops, "the stop message of the start")
        if is_reached:
            await self.network.start()

    def append(self, received):
        """The node has received a message."""
        now = time.monotonic()
        number, made_at, index = struct.unpack_from("<3d", bytes.fromhex(received[1]), 4)
        if number:
            moved = Moved(int(number), made_at, now)
            self.moved.setdefault(int(index), []).append(moved)
        else:
            self.stops += 1

    async def end(self, how):
        """End the appliance, by SIGTERM or SIGKILL."""
        process = self.appliance._process
        process.send_signal(how)
        code = await asyncio.to_thread(process.wait, PATIENCE)
        assert code == (0 if how == signal.SIGTERM else -how), self.appliance.log
        self.appliance._process = None

    async def start_again(self):
        stops = self.stops
        await asyncio.to_thread(self.appliance.start)
        return stops

    @property
    def connections(self):
        """How many clients have ever connected."""
        return self.appliance.log.count(" connected: MQTT ")

    async def stop(self):
        await self.network.stop()
        await self.peer.stop()
        await asyncio.to_thread(self.appliance.stop)


@dataclass
class Client:
    """One of the programs, as a subprocess."""

    kind: str
    version: str
    qos: int
    index: int
    robot: Robot
    connected: int = 0
    done: int = 0
    sent: int = 0
    broker: subprocess.Popen[bytes] | None = None
    tasks: set[asyncio.Task[None]] = field(default_factory=set)

    async def start(self):
        appliance, port = self.robot.appliance, self.robot.network.port
        login = ["alice", appliance.passwords["alice"]]
        version = {"3.1.1": 4, "5": 5}[self.version]
        if self.kind == "bridge":
            port = self._start_broker(*login)
            login = ["", ""]
        if self.kind == "mqttjs":
            program = ["node", str(HERE.parent / "interop/mqttjs/commander.js")]
        else:
            program = [sys.executable, str(HERE / "commander.py")]
        arguments = [HOST, port, version, self.qos, *login, self.index]
        self.process = await asyncio.create_subprocess_exec(
            *program,
            *map(str, arguments),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=for_other_programs(),
        )
        self.tasks.add(asyncio.create_task(self._read()))

    def _start_broker(self, user, password):
        directory = self.robot.directory / f"mosquitto-{self.index}"
        directory.mkdir()
        (port,) = free_ports(1)
        version = {"3.1.1": "mqttv311", "5": "mqttv50"}[self.version]
        config = directory / "mosquitto.conf"
        config.write_text(
            f"listener {port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\n"
            f"connection robot-{self.index}\naddress 127.0.0.1:{self.robot.network.port}\n"
            f"topic {ROBOT}/cmd_vel out {self.qos}\nbridge_protocol_version {version}\n"
            f"remote_username {user}\nremote_password {password}\ntry_private false\n"
            "notifications false\nrestart_timeout 1\ncleansession true\n"
        )
        self.broker = subprocess.Popen(
            [MOSQUITTO, "-c", config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        return port

    async def _read(self):
        async for line in self.process.stdout:
            word = line.decode().strip()
            self.connected += word == "connected"
            self.done += word == "done"

    def do(self, *what):
        if what[0] == "drive" or (what[0] == "connect" and what[1:]):
            self.sent += what[-2]
        self.process.stdin.write(json.dumps(what).encode() + b"\n")

    async def stop(self):
        self.process.stdin.close()
        try:
            await asyncio.wait_for(self.process.wait(), 5)
        except asyncio.TimeoutError:
            self.process.kill()
            await self.process.wait()
        await asyncio.gather(*self.tasks)
        if self.broker is not None:
            self.broker.terminate()
            self.broker.wait()

    @property
    def moved(self) -> list[Moved]:
        return self.robot.moved.get(self.index, [])

    def outcome(self, scenario, problem="") -> Outcome:
        oldest = max((moved.age for moved in self.moved), default=None)
        if oldest is not None and oldest > EXPIRE + TOLERANCE:
            problem = f"moved by a command of {oldest:.1f} s ago"
        return Outcome(
            *(scenario, self.kind, self.version, self.qos),
            *(self.sent, len(self.moved), oldest, problem),
        )


class Scenarios:
    """What may happen, with these clients at once. Each gives a line for each of them."""

    def __init__(self, robot, clients):
        self.robot = robot
        self.clients = clients

    async def _all_connected(self, times=1):
        await until(
            lambda: all(client.connected >= times for client in self.clients),
            f"{times} connections of each: {[client.connected for client in self.clients]}",
        )

    async def _all_back(self, before):
        """A bridge is not asked: the appliance knows when all are there again."""
        await until(
            lambda: self.robot.connections >= before + len(self.clients),
            f"{len(self.clients)} connections in the log",
        )

    async def _connect(self, *then):
        for client in self.clients:
            client.do("connect", *then)
        await self._all_connected()

    async def _all_done(self, done):
        await until(
            lambda: all(client.done >= done for client in self.clients),
            f"{done} times done: {[client.done for client in self.clients]}",
        )

    async def _steer_again(self, scenario):
        """Nothing old has come; now the clients steer anew, one after the other."""
        await asyncio.sleep(2 * EXPIRE)
        problems = {}
        for client in self.clients:
            before, done = len(client.moved), client.done
            for _ in range(TRIES):  # a bridge of QoS 0 may have no connection yet
                client.do("drive", RATE // 2, RATE)
                done += 1
                await until(lambda: client.done == done, "its commands")  # noqa: B023
                await asyncio.sleep(EXPIRE / 2)
                if len(client.moved) > before:
                    break
            else:
                problems[client.index] = "what is new does not move it"
        return [client.outcome(scenario, problems.get(client.index, "")) for client in self.clients]

    async def _steer(self):
        """Clients connect and move the robot, and steer on for STEERED_ON seconds more."""
        await self._connect()
        for client in self.clients:
            client.do("drive", int(RATE * (1 + STEERED_ON)), RATE)
        await until(lambda: all(client.moved for client in self.clients), "the robot is moved")
        await asyncio.sleep(0.5)

    async def restart(self, how):
        """The appliance is started anew, while its clients steer on and stop then."""
        await self._steer()
        await self.robot.end(how)
        await self._all_done(1)
        await asyncio.sleep(AWAY)
        before = self.robot.connections
        stops = await self.robot.start_again()
        await self._all_back(before)
        # The appliance finds the node again while clients flush their queues.
        await until(lambda: self.robot.stops > stops, "the stop message of the start")
        return await self._steer_again(f"restart, {how.name}")

    async def restart_by_sigterm(self):
        return await self.restart(signal.SIGTERM)

    async def restart_by_sigkill(self):
        return await self.restart(signal.SIGKILL)

    async def network_gone(self):
        """Connections are lost, and for a time there are none."""
        await self._steer()
        await self.robot.network.stop()
        await self._all_done(1)
        await asyncio.sleep(AWAY)
        before = self.robot.connections
        await self.robot.network.start()
        await self._all_back(before)
        return await self._steer_again("network gone")

    async def network_stalls(self):
        """Connections live, and nothing gets through for a time."""
        await self._steer()
        self.robot.network.silence()
        await self._all_done(1)
        await asyncio.sleep(AWAY / 2)
        self.robot.network.release()
        return await self._steer_again("network stalls")

    async def never_seen(self):
        """They steer before their first connection."""
        before = self.robot.connections
        for client in self.clients:
            client.do("connect")
            client.do("drive", int(RATE * STEERED_ON), RATE)
        await self._all_done(1)
        await asyncio.sleep(AWAY)
        await self.robot.network.start()
        await self._all_back(before)
        return await self._steer_again("never seen before")

    async def single(self):
        """One command right behind CONNECT."""
        await self._connect(1, 1)
        with contextlib.suppress(AssertionError):
            await until(lambda: all(client.moved for client in self.clients), "each", 5)
        return [
            client.outcome("single", "" if len(client.moved) == 1 else "not carried out")
            for client in self.clients
        ]

    async def stream(self):
        """A stream from CONNECT on."""
        await self._connect(2 * RATE, RATE)
        await self._all_done(1)
        await asyncio.sleep(EXPIRE)
        outcomes = []
        for client in self.clients:
            first = min((moved.number for moved in client.moved), default=0)
            # Of QoS 0 a bridge passes on what comes once it is connected.
            late = client.kind != "bridge" and not 0 < first <= FIRST_OF_A_STREAM
            problem = f"the first was number {first}" if late else ""
            outcomes.append(client.outcome(f"stream, {RATE} Hz", problem))
        return outcomes

    async def button(self):
        """A command now and then: each moves the robot, and nobody is disconnected."""
        await self._connect()
        before = self.robot.connections
        presses = 3
        for press in range(presses):
            for client in self.clients:
                client.do("drive", 1, 1)
            await self._all_done(press + 1)
            await asyncio.sleep(4)  # more than the time that is left to answer
        problem = "disconnected" if self.robot.connections != before else ""
        return [
            client.outcome(
                "button", problem if len(client.moved) == presses else "not each was carried out"
            )
            for client in self.clients
        ]


SCENARIOS = [
    "never_seen",
    "network_gone",
    "network_stalls",
    "restart_by_sigterm",
    "restart_by_sigkill",
    "single",
    "stream",
    "button",
]


async def run(scenario, kinds, versions=("3.1.1", "5"), qualities=(0, 1)) -> list[Outcome]:
    """One scenario, on a robot of its own."""
    with tempfile.TemporaryDirectory() as directory:
        robot = Robot(Path(directory))
        each = itertools.product(kinds, versions, qualities)
        clients = [Client(*what, index + 1, robot) for index, what in enumerate(each)]
        try:
            is_reached = scenario != "never_seen"
            await robot.start(is_reached=is_reached)
            for client in clients:
                await client.start()
            if is_reached:  # what a bridge queues before, alone, has no age
                bridges = sum(client.kind == "bridge" for client in clients)
                await until(lambda: robot.connections >= bridges, "the bridges' connections")
            return await getattr(Scenarios(robot, clients), scenario)()
        finally:
            for client in clients:
                if hasattr(client, "process"):
                    await client.stop()
            await robot.stop()


async def mosquitto_pub(version: str, qos: int) -> Outcome:
    """CONNECT, a command and DISCONNECT in one go."""
    with tempfile.TemporaryDirectory() as directory:
        robot = Robot(Path(directory))
        try:
            await robot.start(is_reached=False)
            payload = json.dumps({"linear": {"x": 1, "y": time.monotonic(), "z": 1}})
            process = await asyncio.create_subprocess_exec(
                *("mosquitto_pub", "-h", HOST, "-p", str(robot.ports[1]), "-q", str(qos)),
                *("-V", {"3.1.1": "311"}.get(version, version), "-t", f"{ROBOT}/cmd_vel"),
                *("-u", "alice", "-P", robot.appliance.passwords["alice"], "-m", payload),
            )
            assert await process.wait() == 0
            with contextlib.suppress(AssertionError):
                await until(lambda: robot.moved, "the command", 5)
            client = Client("mosquitto_pub", version, qos, 1, robot, sent=1)
            return client.outcome("single", "" if client.moved else "not carried out")
        finally:
            await robot.stop()


def row(outcome: Outcome) -> str:
    oldest = "-" if outcome.oldest is None else f"{outcome.oldest * 1000:.0f}"
    return (
        f"{outcome.scenario:20} {outcome.client:14} {outcome.version:6} {outcome.qos:3} "
        f"{outcome.sent:5} {outcome.moved:6} {oldest:>10}  {outcome.problem or 'right'}"
    )


async def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clients", default="paho,mqttjs,bridge")
    parser.add_argument("--only", nargs="*", default=SCENARIOS, choices=SCENARIOS)
    arguments = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", DOMAIN)
    kinds = arguments.clients.split(",")
    print("SCENARIO             CLIENT         MQTT   QOS  SENT  MOVED  OLDEST MS  VERDICT")
    wrong = 0
    for scenario in arguments.only:
        for kind in kinds:  # one library after the other: their processes share this computer
            for outcome in await run(scenario, [kind]):
                print(row(outcome), flush=True)
                wrong += bool(outcome.problem)
    if "single" in arguments.only:
        for version, qos in itertools.product(("3.1.1", "5"), (0, 1, 2)):
            outcome = await mosquitto_pub(version, qos)
            print(row(outcome), flush=True)
            wrong += bool(outcome.problem)
    print(f"\n{wrong} wrong" if wrong else "\nall right")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    asyncio.run(main())
