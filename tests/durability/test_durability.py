"""A few kills and a full disk; `python tests/durability` has as many as are wanted."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from appliance_process import ACL, ApplianceProcess
from raw_client import RawClient

from appliance.mqtt.packets import Puback, Publish, Subscribe, Subscription
from durability.harm import HARMS
from durability.ordeal import Ordeal


def test_nothing_acknowledged_is_lost_by_kills(tmp_path: Path) -> None:
    ordeal = Ordeal(tmp_path, seed=1)
    ordeal.least = 100
    report = ordeal.run(kills=5)
    assert not report.problems, f"{report}\n" + "\n".join(report.problems)
    assert report.acknowledged > 100, report


def test_it_starts_whatever_was_done_to_its_files(tmp_path: Path) -> None:
    report = Ordeal(tmp_path, seed=2, harm=HARMS["anything"]).run(kills=5)
    assert not report.problems, f"{report}\n" + "\n".join(report.problems)
    assert report.starts == 6


@contextlib.contextmanager
def small_disk(path: Path) -> Iterator[Path]:
    path.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m,mode=700", "tmpfs", str(path)]
    if os.geteuid() or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small disk")
    try:
        yield path
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


@pytest.mark.parametrize("killed", [False, True], ids=["runs on", "killed while full"])
def test_a_full_disk_loses_nothing(tmp_path: Path, killed: bool) -> None:
    """Refused while it is full, goes on by itself when it is not, and keeps all that it took."""
    with small_disk(tmp_path / "disk") as disk:
        ordeal = FullDisk(tmp_path / "home", disk, killed)
        report = ordeal.run(0)
        assert not report.problems, f"{report}\n" + "\n".join(report.problems)
        log = ordeal.broker.log
    assert report.refused > 0, "MQTT 5 was told 0x97"
    assert "CANNOT BE WRITTEN" in log
    if not killed:
        assert report.starts == 1 and "can be written again" in log


def test_it_starts_on_a_disk_that_was_mounted_read_only(tmp_path: Path) -> None:
    """As the system does with one that has errors: what was kept is there, and is delivered."""
    with small_disk(tmp_path / "disk") as disk:
        process = ApplianceProcess(
            tmp_path / "home", acl=ACL, broker={"store": {"path": str(disk / "state/store.db")}}
        )
        settings = yaml.safe_load(process.config.read_text())
        settings["control"] = str(disk / "state/control.sock")
        process.config.write_text(yaml.safe_dump(settings))
        process.start()
        try:
            with RawClient(process, 5, tls=True) as client:
                client.connect("first")
                client.send(Publish("r2d2/a", b"kept", 1, retain=True, packet_id=1))
                assert isinstance(client.decode(client.receive()), Puback)
            process.stop()
            subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
            process.start()
            with RawClient(process, 5, tls=True) as client:
                client.connect("second")
                client.send(Subscribe(1, [Subscription("r2d2/#", 1)]))
                received = [p for p in client.drain() if isinstance(p, Publish)]
            process.wait_for_log("status`, `reload` and `routes` are not answered: .*control.sock")
        finally:
            process.stop()
    assert ("r2d2/a", b"kept") in [(p.topic, p.payload) for p in received]


class FullDisk(Ordeal):
    """Something else fills the disk under load, and makes room again."""

    def __init__(self, directory: Path, disk: Path, killed: bool) -> None:
        directory.mkdir()
        super().__init__(directory, seed=3, store={"path": str(disk / "state/store.db")})
        self._disk = disk
        self._killed = killed

    async def settle(self) -> None:
        for subscriber in self.subscribers:
            subscriber.leaves = False
        for publisher in self.publishers:
            publisher.pause = 0.01
        await self._until(lambda: all(len(p.acknowledged) > 20 for p in self.publishers), "a start")
        for _ in range(2):
            self._fill()
            refused = sum(self.world.refused.values())
            await self._until(lambda: sum(self.world.refused.values()) > refused + 20, "refusals")  # noqa: B023
            await asyncio.sleep(0.5)
            if self._killed:
                self.world.up.clear()
                await asyncio.to_thread(self._kill)
                await asyncio.to_thread(self._start)
                self.world.up.set()
                await asyncio.sleep(0.5)
            (self._disk / "other").unlink()
            acknowledged = {p: len(p.acknowledged) for p in self.publishers}
            await self._until(
                lambda: all(len(p.acknowledged) > n for p, n in acknowledged.items()),  # noqa: B023
                "it goes on",
            )
        await super().settle()

    def _fill(self) -> None:
        with (self._disk / "other").open("wb", buffering=0) as file, contextlib.suppress(OSError):
            for size in (65536, 4096, 1):
                with contextlib.suppress(OSError):
                    while True:
                        file.write(bytes(size))
