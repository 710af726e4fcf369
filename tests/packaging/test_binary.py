"""The one file that `make binary` makes, in a root file system that has nothing else but glibc.

Built once for all tests, which takes a minute, and kept in `build/` until something is newer;
`APPLIANCE_BINARY=dist/appliance` takes one that is there. `APPLIANCE_BARE_ROOT` names a root file
system for it, as debootstrap makes one:

    debootstrap --variant=minbase bookworm /tmp/bare
    export APPLIANCE_BARE_ROOT=/tmp/bare APPLIANCE_BINARY=dist/appliance
    pytest tests/packaging/test_binary.py
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import sysconfig
from pathlib import Path

import psutil
import pytest
import yaml
from appliance_process import HOST, ROBOT, BrokerProcess
from waiting import eventually, until

pytest.importorskip("rclpy")
pytest.importorskip("test_msgs.action")
pytest.importorskip("PyInstaller")
from rclpy.serialization import serialize_message
from robot_client import TURTLE, V5, Client
from robot_process import Robot
from ros2_harness import Peer, string
from ros_domain import isolated_domain
from rover_workspace import DRIVE, VALUE, build_workspace
from sensor_msgs.msg import Image, LaserScan

__all__ = ["isolated_domain"]  # a fixture

pytestmark = [
    pytest.mark.timeout(1800),
    pytest.mark.usefixtures("isolated_domain"),
]  # it may have to be built

PROJECT = Path(__file__).parent.parent.parent
MIB = 1 << 20
CONNECT = bytes.fromhex("10 10 0004 4d515454 05 02 003c 00 0003 616263")
LISTENING = r"listening on \S+:(\d+)$"

#: Run as root of a mount namespace of its own, and leaves nothing of itself in between.
ENTER = 'mount --rbind /dev "$0/dev" && mount --rbind /proc "$0/proc" && exec env -i "$@"'


@pytest.fixture(scope="session")
def binary():
    if given := os.environ.get("APPLIANCE_BINARY"):
        return Path(given).absolute()
    build = PROJECT / "build"
    found = build / "tested/appliance"
    sources = [PROJECT / "pyproject.toml", Path(sysconfig.get_path("purelib"))]
    for kind in ("py", "spec", "xml"):
        sources += (PROJECT / "appliance").rglob(f"*.{kind}")
    sources += (each for each in (PROJECT / "appliance/web/files").rglob("*") if each.is_file())
    if found.exists() and found.stat().st_mtime > max(each.stat().st_mtime for each in sources):
        return found
    built = subprocess.run(
        [
            *(sys.executable, "-m", "PyInstaller", "--noconfirm", "--distpath", found.parent),
            *("--workpath", build, PROJECT / "appliance/packaging/appliance.spec"),
        ],
        env={**os.environ, "PYINSTALLER_ZLIB_COMPRESSION_LEVEL": "1"},  # its size is no matter here
        capture_output=True,
        text=True,
        timeout=1800,
    )
    assert built.returncode == 0, built.stderr[-4000:]
    return found


@pytest.fixture(scope="session")
def bare_root(binary, tmp_path_factory):
    """A folder with the one file, the libraries that it asks for, and nothing else."""
    if given := os.environ.get("APPLIANCE_BARE_ROOT"):
        shutil.copy(binary, Path(given, "appliance"))
        return Path(given)
    root = tmp_path_factory.mktemp("root")
    for folder in ("dev", "proc", "tmp"):
        (root / folder).mkdir()
    shutil.copy(binary, root / "appliance")
    # What a minimal Debian has of glibc, some of which only its extension modules ask for.
    asked_for = subprocess.run(["ldd", binary], capture_output=True, text=True, check=True).stdout
    found = [Path(path) for path in re.findall(r"(/\S+) \(0x", asked_for)]
    glibc = next(path.parent for path in found if path.name == "libc.so.6")
    found += [glibc / name for name in ("libm.so.6", "librt.so.1", "libutil.so.1")]
    for path in found:
        (root / path.parent.relative_to("/")).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, root / path.relative_to("/"))
    return root


class Box(BrokerProcess):
    """The one file in the bare root, with an environment that has nothing but what is given."""

    name = "the one file"

    def __init__(self, root, name, bridge, *given, **environment):
        super().__init__(root / name)
        shutil.rmtree(self.directory, ignore_errors=True)
        self.root = root
        self.inside = f"/{name}"
        self.config = f"{self.inside}/appliance.yaml"
        self.environment = environment | {
            variable: os.environ[variable]
            for variable in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")
        }
        told = self.call("init", "--dir", self.inside, "--robot", ROBOT, "--user", "alice").stdout
        self.passwords = {"alice": re.search(r"user alice, password (\S+)", told)[1]}
        (self.directory / "password").write_text(self.passwords["alice"])
        settings = yaml.safe_load((self.directory / "appliance.yaml").read_text())
        settings["broker"] = {
            "listeners": [{"bind": "127.0.0.1:0", "tls": True}, {"bind": "127.0.0.1:0"}]
        }
        settings["bridge"] = bridge
        (self.directory / "appliance.yaml").write_text(yaml.safe_dump(settings))
        (self.directory / "acl.conf").write_text(f"user alice\ntopic {ROBOT}/#\ntopic answers/#\n")

    def command(self, *arguments):
        user = [] if os.geteuid() == 0 else ["--map-root-user"]
        given = [f"{name}={value}" for name, value in self.environment.items()]
        chroot = shutil.which("chroot", path=f"{os.environ['PATH']}:/usr/sbin")
        return [
            *("unshare", "--mount", *user, "sh", "-c", ENTER, self.root, *given),
            *(chroot, self.root, "/appliance", *arguments),
        ]

    def call(self, *arguments, code=0):
        done = subprocess.run(self.command(*arguments), capture_output=True, text=True, timeout=60)
        assert done.returncode == code, done.stdout + done.stderr
        return done

    def start(self):
        self._run(self.command("run", "-c", self.config))
        try:
            ports = [line.rpartition(":")[2] for line in self.wait_for_log(LISTENING, 2)]
        except AssertionError:
            self.stop()
            raise
        self.port, self.plain_port = map(int, ports)

    def publish(self, topic, text):
        """Publish it once a second until it is told to stop."""
        command = [*self._mosquitto("pub"), "-t", topic, "-m", text, "--repeat", "60"]
        return subprocess.Popen([*command, "--repeat-delay", "1"])

    def listen(self, topic, *options):
        """mosquitto_sub, which prints what comes."""
        command = [*self._mosquitto("sub"), "-W", "120", "-t", topic, *options]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def _mosquitto(self, program):
        login = ["-h", HOST, "-p", f"{self.port}", "--cafile", self.ca, "-u", "alice"]
        return [f"mosquitto_{program}", *login, "-P", self.passwords["alice"]]


@pytest.fixture
def box(bare_root, request, tmp_path):
    """Makes a Box, started; it ends with the test, and leaves nothing in the root."""
    made = []

    def make(bridge, **environment):
        made.append(Box(bare_root, f"house-{os.getpid()}", bridge, **environment))
        made[0].start()
        return made[0]

    yield make
    for each in made:
        try:
            each.stop()
        finally:
            shutil.rmtree(each.directory, ignore_errors=True)


@pytest.mark.timed
def test_size_and_time_until_the_first_client_is_answered(binary, box):
    assert binary.stat().st_size < 100 * MIB
    house = box({"bus": "none"})
    context = house.tls_context()
    port = house.port
    house.stop()
    settings = house.directory / "appliance.yaml"
    settings.write_text(settings.read_text().replace("127.0.0.1:0", f"127.0.0.1:{port}", 1))

    def seconds(*command):
        return _seconds_until_answered(house, command, context, port)

    # A start in two seconds is meant for a computer where one from a fresh checkout, without its
    # bytecode, takes one. The least of several counts: what else runs there is not to be counted.
    checkout = house.directory / "checkout"
    shutil.copytree(
        PROJECT / "appliance", checkout / "appliance", ignore=shutil.ignore_patterns("__pycache__")
    )
    from_source = (
        *("env", "-C", checkout, f"PYTHONPATH={checkout}", "PYTHONDONTWRITEBYTECODE=1"),
        *(sys.executable, "-m", "appliance", "run", "-c", settings),
    )
    alone, installed = [], []
    while len(alone) < 6 and (not alone or min(alone) >= max(2, 2 * min(installed))):
        installed.append(seconds(*from_source))
        alone.append(seconds(*house.command("run", "-c", house.config)))
    assert min(alone) < max(2, 2 * min(installed)), (alone, installed)


def _seconds_until_answered(house, command, context, port):
    """The CPU time of the boot loader and of what it starts; one works after the other."""
    house._run(command)
    try:
        eventually(lambda: _answers(house, context, port), "an answer to CONNECT", timeout=60)
        loader = psutil.Process(house.pid)
        return sum(sum(one.cpu_times()[:2]) for one in [loader, *loader.children(recursive=True)])
    finally:
        house.stop()


def _answers(house, context, port):
    try:
        connection = socket.create_connection((HOST, port), 10)
    except ConnectionRefusedError:
        return False
    with context.wrap_socket(connection, server_hostname=HOST) as secured:
        secured.sendall(CONNECT)
        return secured.recv(1) == b"\x20"  # CONNACK, be it that nobody may come in like that


def test_what_is_unpacked_stays_while_it_runs(binary, tmp_path):
    """A computer that runs for weeks has what is old in its /tmp deleted, libraries not yet
    loaded among it."""
    unpacked = tmp_path / "unpacked"
    unpacked.mkdir()
    (unpacked / "old").touch()
    house = tmp_path / "house"
    environment = {"TMPDIR": str(unpacked)}
    subprocess.run([binary, "init", "--dir", house], env=environment, check=True)
    ports = "broker: {listeners: [{bind: '127.0.0.1:0'}]}\nbridge: {bus: none}\n"
    (house / "appliance.yaml").write_text(ports)
    command = [binary, "run", "-c", house / "appliance.yaml"]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        assert any("listening on" in line for line in process.stderr)
        (inside,) = unpacked.glob("_MEI*")
        before = sorted(inside.rglob("*"))
        assert len(before) > 100
        rule = tmp_path / "tmp.conf"
        rule.write_text(f"d {unpacked} - - - 0\n")  # whatever is there is old
        subprocess.run(["systemd-tmpfiles", "--clean", rule], check=True)
        assert sorted(inside.rglob("*")) == before
        assert not (unpacked / "old").exists()
    finally:
        process.terminate()
        process.communicate(timeout=60)
    assert not inside.exists()


def test_the_commands(box):
    house = box({})
    config = ("-c", house.config)
    login = (*config, "-H", "127.0.0.1", "-p", f"{house.port}", "-u", "alice")
    login += ("--password-file", f"{house.inside}/password")
    assert "without TLS, reached from this computer only" in house.call("check", *config).stdout
    house.call("pub", *login, "--retain", f"{ROBOT}/note", "-m", "kept")
    assert house.call("sub", *login, "-C", "1", f"{ROBOT}/note").stdout == "kept\n"
    assert house.call("routes", *config).stdout == "nothing is bridged now\n"
    house.call("cert", "issue", "phone", *config)
    assert "phone" in house.call("cert", "list", *config).stdout
    assert "r2d2/note" in house.call("store", "export", *config).stdout
    assert "appliance, run from" not in house.call("--version").stdout


def test_programs_that_it_starts_run_in_it_too(box, bare_root):
    house = box({"bus": "none"})
    measured = house.call("bench", "--cell", "qos1-inflight50", "--seconds", "0.3", "--json")
    assert json.loads(measured.stdout)
    house.stop()
    settings = yaml.safe_load((house.directory / "appliance.yaml").read_text())
    chatter = {"ros": "/chatter", "to": "mqtt", "encoding": "text"}
    settings["bridge"] = {"topics": [chatter, {"ros": "/odom", "to": "mqtt"}]}
    (house.directory / "appliance.yaml").write_text(yaml.safe_dump(settings))
    house._run(house.command("demo", "-c", house.config))
    house.port = int(house.wait_for_log(LISTENING, 4)[-2].rpartition(":")[2])
    listener = house.listen(f"{ROBOT}/chatter", "-C", "1")
    assert listener.communicate()[0].startswith("Hello World"), house.log
    assert "appliance sub -c" in house.log


def test_nobody_on_the_network_reaches_its_ros(box):
    """With `discovery: localhost`, as `init` writes it: all sockets of DDS are on the loopback."""
    house = box({"discovery": "localhost", "topics": [{"ros": "/odom", "to": "mqtt"}]})
    house.wait_for_log("on ROS as")
    process = psutil.Process(house.pid)
    places = [
        connection.laddr
        for each in (process, *process.children(recursive=True))
        for connection in each.net_connections("udp")
    ]
    # Those of groups are joined on the loopback alone.
    assert {at.ip.partition(".")[0] for at in places} == {"127", "239"}


async def test_types_without_compiled_support(box, bare_root, tmp_path):
    """A workspace that is built for another Python: its definitions are all that can be used."""
    built = build_workspace(tmp_path)
    workspace = bare_root / "rover"
    shutil.copytree(built / "share", workspace / "share", dirs_exist_ok=True)
    services = workspace / "share/rover_msgs/srv"
    services.mkdir(exist_ok=True)
    (services / "Park.srv").write_text("---\nbool parked\n")
    house = box(
        {
            "topics": [
                {"ros": "/state", "to": "mqtt"},
                {"ros": "/raw", "to": "mqtt", "encoding": "cdr"},
                {"ros": "/drive", "to": "ros", "type": DRIVE},
            ],
            "services": [{"ros": "/park", "to": "mqtt", "type": "rover_msgs/srv/Park"}],
        },
        AMENT_PREFIX_PATH="/rover",
    )
    peer = Peer()
    try:
        await peer.start("rover", PYTHONPATH=f"{next(built.glob('lib/python*/site-packages'))}")
        await peer.do("subscribe", "/drive", DRIVE)
        house.wait_for_log(f"{DRIVE} is read from /rover/share/rover_msgs/msg/Drive.msg")
        house.wait_for_log(
            r"/park.*rover_msgs.*Park.srv is not enough: rclpy makes calls only with"
        )
        more = ("-t", f"{ROBOT}/raw", "-V", "5", "-C", "2", "-F", "%t %P %x")
        listener = house.listen(f"{ROBOT}/state", *more)
        publisher = house.publish(f"{ROBOT}/drive", json.dumps(VALUE))
        await until(lambda: peer.received, "the message on /drive")
        publisher.kill()
        publisher.wait()
        cdr = peer.received[0][1]
        heard = {}
        for topic in ("/state", "/raw"):
            await peer.do("advertise", topic, DRIVE)
            await peer.do("matched", topic)
            await peer.do("publish", topic, cdr)
            name, *properties, payload = listener.stdout.readline().split()
            assert f"ros-type:{DRIVE}" in properties
            assert any(each.startswith("ros-type-hash:RIHS01_") for each in properties)
            heard[name] = bytes.fromhex(payload)
        assert json.loads(heard[f"{ROBOT}/state"]) == VALUE
        assert heard[f"{ROBOT}/raw"].hex() == cdr
        assert listener.wait(20) == 0
        listener.stdout.close()
    finally:
        await peer.stop()


def test_a_sourced_ros_that_fits_is_used(box, bare_root):
    """Here that is a copy of the packages from PyPI, as sourcing a setup file would name it."""
    sourced = bare_root / "sourced"
    for name in ("rclpy", "test_msgs"):
        overlay(bare_root, "sourced", name)
    site = next(sourced.glob("lib/python*/site-packages"))
    environment = {
        "PYTHONPATH": f"/{site.relative_to(bare_root)}",
        "AMENT_PREFIX_PATH": "/sourced",
        "LD_LIBRARY_PATH": "/sourced/lib",
        "ROS_DISTRO": "kilted",
        "ROS_FROM": "system",
    }
    house = box({"topics": [{"ros": "/x", "to": "mqtt"}]}, **environment)
    house.wait_for_log("on ROS as /appliance")
    found = re.search("bridge: (.*)", house.call("check", "-c", house.config).stdout)[1]
    assert found.startswith(f"ROS 2 kilted in /{site.relative_to(bare_root)} (Python ")
    maps = Path(f"/proc/{psutil.Process(house.pid).children()[0].pid}/maps").read_text()
    assert "/sourced/lib/python" in maps and "_rclpy_pybind11" in maps

    fitting = f"cpython-{sys.version_info[0]}{sys.version_info[1]}"
    for library in site.glob("rclpy/_rclpy_pybind11.*"):
        library.rename(library.with_name(library.name.replace(fitting, "cpython-399")))
    try:
        told = house.call("check", "-c", house.config).stdout
    finally:
        shutil.rmtree(sourced)
    assert "cannot be used by this appliance, which has Python" in told
    assert "python3.99 -m venv --system-site-packages" in told


async def test_topics_services_and_actions_with_other_nodes(box, bare_root):
    # No package in the one file has an action: it is taken from a workspace with compiled support.
    overlay(bare_root, "ws", "test_msgs")
    house = box(
        {
            "topics": [
                {"ros": "/chatter", "to": "mqtt", "encoding": "text"},
                {"ros": "/said", "to": "ros", "type": "std_msgs/msg/String"},
            ],
            "services": ["/turtle/*"],
            "actions": ["/turtle/walk"],
        },
        AMENT_PREFIX_PATH="/ws",
        LD_LIBRARY_PATH="/ws/lib",
    )
    peer, robot = Peer(), Robot()
    try:
        await peer.start()
        await peer.do("subscribe", "/said", "std_msgs/msg/String")
        await peer.do("advertise", "/chatter", "std_msgs/msg/String")
        await peer.do("matched", "/chatter")
        listener = house.listen(f"{ROBOT}/chatter", "-C", "1")
        while listener.poll() is None:
            await peer.do("publish", "/chatter", string("hello from ROS").hex())
        assert listener.communicate()[0] == "hello from ROS\n"

        publisher = house.publish(f"{ROBOT}/said", '{"data": "hello"}')
        await until(lambda: peer.received, "the message on /said")
        publisher.kill()
        publisher.wait()
        assert bytes.fromhex(peer.received[0][1]).startswith(string("hello"))

        robot.wait()
        house.wait_for_log("/turtle/pen can be called")
        house.wait_for_log("/turtle/walk can be called")
        client = Client(house, V5)
        assert client.call(f"{TURTLE}/pen/_call", {"data": True})["success"]
        goal = client.call(f"{TURTLE}/walk/_goal", {"order": 3})
        client.subscribe(f"{TURTLE}/walk/_result/{goal['goal_id']}")
        assert client.next(f"{TURTLE}/walk/_result/{goal['goal_id']}")["result"]
        client.leave()
    finally:
        await peer.stop()
        robot.stop()


async def test_every_encoding(box):
    """Some libraries import a module when they first encode a value that wants it."""
    scan = LaserScan(ranges=[1.0, 2.0])
    image = Image(height=2, width=2, encoding="rgb8", step=6, data=bytes(12))
    said = {
        "/chatter": ("std_msgs/msg/String", string("hello")),
        "/image": ("sensor_msgs/msg/Image", serialize_message(image)),
        "/scan": ("sensor_msgs/msg/LaserScan", serialize_message(scan)),
    }
    #: Of each topic on MQTT its source, its encoding, and what is in each message.
    told = {
        "json": ("/chatter", {"encoding": "json"}, b'{"data":"hello"}'),
        "cbor": ("/chatter", {"encoding": "cbor"}, b"\xa1ddataehello"),
        "cdr": ("/chatter", {"encoding": "cdr"}, string("hello")),
        "text": ("/chatter", {"encoding": "text"}, b"hello"),
        "zstd": ("/chatter", {"compression": "zstd"}, bytes.fromhex("28b52ffd")),
        "jpeg": ("/image", {"encoding": "jpeg"}, b"\xff\xd8\xff"),
        "png": ("/image", {"encoding": "png"}, b"\x89PNG"),
        "numbers": ("/scan", {"encoding": "cbor"}, b"franges\xd8\x55\x48"),  # RFC 8746
    }
    routes = [
        {"ros": source, "to": "mqtt", "mqtt": f"{ROBOT}/as/{name}", **options}
        for name, (source, options, _) in told.items()
    ]
    back = {"ros": "/said", "to": "ros", "type": "std_msgs/msg/String", "encoding": "cbor"}
    house = box({"topics": [*routes, back]})
    peer = Peer()
    try:
        await peer.start()
        await peer.do("subscribe", "/said", "std_msgs/msg/String")
        for topic, (kind, _) in said.items():
            await peer.do("advertise", topic, kind)
            await peer.do("matched", topic)
        for name, (source, _, part) in told.items():
            listener = house.listen(f"{ROBOT}/as/{name}", "-C", "1", "-F", "%x")
            while listener.poll() is None:
                await peer.do("publish", source, said[source][1].hex())
                assert "a fault in the appliance" not in house.log
            assert part in bytes.fromhex(listener.communicate()[0]), name
        publisher = house.publish(f"{ROBOT}/said", b"\xa1ddataehello")
        await until(lambda: peer.received, "the message on /said")
        publisher.kill()
        publisher.wait()
        assert bytes.fromhex(peer.received[0][1]).startswith(string("hello"))
    finally:
        await peer.stop()
    assert "a fault in the appliance" not in house.log


def overlay(root, name, package):
    """Put an installed package into the root as a workspace would have it."""
    prefix, site = (
        root / name,
        f"lib/python{sys.version_info[0]}.{sys.version_info[1]}/site-packages",
    )
    if prefix.exists():
        return
    for folder in (f"share/{package}", f"{site}/{package}"):
        shutil.copytree(Path(sys.prefix, folder), prefix / folder)
    for library in Path(sys.prefix, "lib").glob(f"lib{package}__*.so"):
        shutil.copy(library, prefix / "lib")
