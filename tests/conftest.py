"""What holds for every test, in CI nothing is skipped silently; and an appliance that runs."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
import uuid
from collections.abc import Generator, Iterator
from contextlib import suppress
from types import FrameType
from typing import Any

import pytest
import waiting
from appliance_process import ACL, ROBOT, ApplianceProcess
from hypothesis import settings
from xdist.scheduler import LoadFileScheduling

# How long an example takes is the computer's matter.
settings.register_profile("default", deadline=None)
settings.load_profile("default")

IN_CI = os.environ.get("CI") == "true"

# What the tests start is not announced on the network of the computer that they run on.
os.environ["APPLIANCE_MDNS"] = "off"


def _fail_if_skipped(report: pytest.TestReport | pytest.CollectReport) -> None:
    if IN_CI and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped, and CI has everything that is needed: {report.longrepr}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    report = yield
    _fail_if_skipped(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    report = yield
    _fail_if_skipped(report)
    return report


#: Seconds after which a timeout that came to nothing is tried again.
AGAIN = 5.0


@pytest.hookimpl(wrapper=True)
def pytest_timeout_set_timer(settings: Any) -> Generator[None, object, object]:
    """Let a timeout end a test on an event loop too, and ring until it has.

    What its signal raises, uvloop and callbacks of asyncio log and forget; and `wait_for` loses a
    cancellation now and then before Python 3.12.
    """
    done = yield
    fail = signal.getsignal(signal.SIGALRM)
    if not callable(fail):
        return done

    def end(number: int, frame: FrameType | None) -> None:
        with suppress(RuntimeError):
            for task in asyncio.all_tasks():
                task.cancel("timeout of the test")
        fail(number, frame)

    signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, settings.timeout, AGAIN)
    return done


#: The files that take longest, from five minutes to half a one where four run at a time on two
#: cores. They go first, or the other workers end up waiting for the last.
LONG = (
    "test_compiled.py",
    "test_kilted.py",
    "test_uplink.py",
    "test_journeys.py",
    "test_managing.py",
    "test_containment.py",
    "test_page_commands.py",
    "test_image.py",
    "test_bench.py",
    "test_loop_subscription.py",
    "test_binary.py",
    "test_publish.py",
    "test_all_types.py",
    "test_camera_page.py",
    "test_brokers.py",
    "test_dial.py",
    "test_listeners.py",
    "test_websocket.py",
    "test_calls.py",
    "test_peers.py",
    "test_durability.py",
    "test_memory.py",
    "test_first_looks.py",
    "test_programs.py",
    "test_robot.py",
    "test_long_page.py",
)

#: Files whose tests share nothing that takes long to set up: each test is for any worker.
APART = ("test_containment.py", "test_page_commands.py", "test_durability.py", "test_memory.py")


class Scheduling(LoadFileScheduling):
    """A file's tests go to one worker: they share what its fixtures set up, if it is not APART."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return nodeid if file.endswith(APART) else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling | None:
    return Scheduling(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: order.get(item.path.name, len(LONG)))


#: New objects after which the garbage collector runs: with Python's 700 it is a tenth of the work.
GARBAGE = 10_000


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep all that was collected out of the garbage collector's sight.

    These are millions of objects, which are there to the end. To walk them takes a second: whenever
    the collector runs, and each time that a test looks for what is left of a connection.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(GARBAGE)
        gc.enable()


class Escaped(logging.Handler):
    """The faults of the appliance that were caught where they entered, and so fail no test."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.told.append(logging.Formatter().format(record))


@pytest.fixture(autouse=True)
def escaped() -> Iterator[list[str]]:
    """What was caught like that; a test that means it to happen empties the list."""
    handler = Escaped()
    log = logging.getLogger("appliance.broker.faults")
    log.addHandler(handler)
    yield handler.told
    log.removeHandler(handler)
    assert not handler.told, "\n".join(handler.told)


@pytest.fixture
def no_collection() -> Iterator[None]:
    """No garbage is collected, for tests of what reaches the recursion limit.

    Python may do that at any depth; there, finalizers of what earlier tests left behind fail, and
    pytest counts that for a failure of this one.
    """
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(scope="session")
def appliance(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApplianceProcess]:
    """A running appliance for all tests that change nothing about it."""
    process = ApplianceProcess(
        tmp_path_factory.mktemp("appliance"), users={"bob": "bob's"}, acl=ACL
    )
    process.start()
    waiting.eventually(process.is_answering, "it listens on its control socket, too")
    yield process
    process.stop()


@pytest.fixture
def name() -> str:
    """For client ids and topics that no other test uses."""
    return uuid.uuid4().hex[:12]


@pytest.fixture
def topic() -> str:
    """A topic of the robot's that no other test uses."""
    return f"{ROBOT}/test-{uuid.uuid4().hex[:12]}"
