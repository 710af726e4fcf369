"""Changed files are reported, however they change."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path

import pytest

from appliance.host.watch import watch

#: Seconds that a change may take to be told of, and none that are not told of.
SOON = 5.0
NEVER = 1.5


class Watched:
    def __init__(self, *files: Path) -> None:
        self.files = list(files)
        self.calls = 0
        self.called = asyncio.Event()

    async def changed(self) -> None:
        self.calls += 1
        self.called.set()

    async def told(self, timeout: float = SOON) -> bool:
        try:
            await asyncio.wait_for(self.called.wait(), timeout)
        except asyncio.TimeoutError:
            return False
        self.called.clear()
        return True


@contextlib.asynccontextmanager
async def watching(*files: Path, since: float | None = None):
    watched = Watched(*files)
    began = time.time() if since is None else since
    task = asyncio.create_task(watch(lambda: watched.files, lambda: watched.changed(), began))
    await asyncio.sleep(0.5)  # until it has begun
    try:
        yield watched
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def write(path: Path) -> None:
    path.write_text("new")


def replace(path: Path) -> None:
    (path.parent / "other").write_text("new")
    (path.parent / "other").rename(path)


def remove(path: Path) -> None:
    path.unlink()


async def test_what_changed_before_the_watch_began_is_told_of_once(tmp_path: Path):
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_text("as it was read")
    await asyncio.sleep(0.1)
    since = time.time()
    async with watching(old, new, since=since) as watched:
        assert not await watched.told(3 * NEVER)
    new.write_text("while the appliance started")
    async with watching(old, new, since=since) as watched:
        assert await watched.told()
        assert not await watched.told(3 * NEVER)


async def test_a_file_in_a_folder_that_comes_later(tmp_path: Path):
    path = tmp_path / "later" / "file"
    async with watching(tmp_path / "file", path) as watched:
        path.parent.mkdir()
        path.write_text("")
        assert await watched.told()


async def test_what_changes_while_a_change_is_taken(tmp_path: Path):
    """And makes that others are watched: nothing of it is lost."""
    first, second = tmp_path / "first", tmp_path / "more" / "second"
    second.parent.mkdir()
    async with watching(first) as watched:
        taken = watched.changed

        async def changed() -> None:
            await taken()
            if watched.calls == 1:
                watched.files.append(second)
                await asyncio.sleep(0.1)
                first.write_text("again")
                second.write_text("new")

        watched.changed = changed
        first.write_text("names the second")
        assert await watched.told()
        assert await watched.told()
        assert not await watched.told(3 * NEVER)


@pytest.mark.parametrize("change", [write, replace, remove])
async def test_a_change_is_told_of_once(tmp_path: Path, change):
    path = tmp_path / "acl.conf"
    path.write_text("old")
    async with watching(path) as watched:
        change(path)
        assert await watched.told()
        await asyncio.sleep(NEVER)
        assert watched.calls == 1


async def test_a_file_that_comes_and_files_that_are_not_meant(tmp_path: Path):
    async with watching(tmp_path / "crl", tmp_path / "nowhere" / "x") as watched:
        (tmp_path / "crl.swp").write_text("")
        assert not await watched.told(NEVER)
        (tmp_path / "crl").write_text("")
        assert await watched.told()


async def test_the_target_of_a_link(tmp_path: Path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "v1").write_text("1")
    (tmp_path / "link").symlink_to(tmp_path / "real" / "v1")
    async with watching(tmp_path / "link") as watched:
        (tmp_path / "real" / "v1").write_text("2")
        assert await watched.told()
        (tmp_path / "real" / "v2").write_text("3")
        (tmp_path / "new").symlink_to(tmp_path / "real" / "v2")
        (tmp_path / "new").rename(tmp_path / "link")
        assert await watched.told()
        (tmp_path / "real" / "v2").write_text("4")
        assert await watched.told()


async def test_files_that_are_named_later(tmp_path: Path):
    (tmp_path / "more").mkdir()
    first, second = tmp_path / "first", tmp_path / "more" / "second"
    async with watching(first) as watched:
        watched.files.append(second)
        first.write_text("names the second")
        assert await watched.told()
        await asyncio.sleep(0.5)
        second.write_text("")
        assert await watched.told()
