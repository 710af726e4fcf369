"""Examines the computer: its clock, its disk, its memory, and its limit of open files."""

from __future__ import annotations

import ctypes
import os
import resource
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import psutil

from appliance.config import Settings, format_size
from appliance.host.clock import RELEASED, is_unset
from appliance.net.listeners import OTHER_FILES
from appliance.ops.finding import Finding

#: Bytes that the appliance needs beside `broker.limits.memory`: Python, the libraries, ROS.
BASE_MEMORY = 160 << 20

#: Free bytes and inodes of a disk below which too little can be stored. The database has three
#: files; the other inodes are for logs and for other programs.
LEAST_DISK = 64 << 20
LEAST_FILES = 100

#: The seconds of DDS have 32 bits.
FAST_DDS_ENDS = datetime.fromtimestamp((1 << 31) - 1, timezone.utc)

_MIB = 1 << 20
_UNSYNCHRONISED = 0x40  # STA_UNSYNC, adjtimex(2)
_IN_MEMORY = ("tmpfs", "ramfs")


# --- the clock -----------------------------------------------------------------------------------


def clock(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Whether the clock is set, and whether something keeps it right."""
    now = datetime.now(timezone.utc)
    advice = "timedatectl set-ntp true, or set it by hand: date -s 'YYYY-MM-DD HH:MM'"
    if is_unset(now):
        text = (
            f"it says {now:%Y-%m-%d}, which is before this program was made "
            f"({RELEASED:%Y-%m-%d}): logs have wrong dates, and certificates are not checked "
            "for being too early"
        )
        yield Finding("error", "clock", text, advice)
    elif now > FAST_DDS_ENDS:
        text = f"it says {now:%Y-%m-%d}: after 2038 Fast DDS, and with it ROS 2, publishes nothing"
        yield Finding("error", "clock", text, advice)
    elif is_synchronised() is False:
        text = f"{now:%Y-%m-%d %H:%M} UTC, and nothing keeps it right"
        yield Finding("warning", "clock", text, advice)
    else:
        yield Finding("ok", "clock", f"{now:%Y-%m-%d %H:%M} UTC, kept right by the network")
    if not any(Path("/sys/class/rtc").glob("rtc*")):
        yield Finding(
            "warning",
            "clock",
            "it has no battery: after a start it is wrong until the network tells the time",
            "the appliance works all the same, see docs/operations.md, «A clock that is wrong»",
        )


class _Timex(ctypes.Structure):
    """The first fields of adjtimex(2)'s structure, and room for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 512),
    )


def is_synchronised() -> bool | None:
    """Whether the kernel says that the clock is synchronised; None when it cannot say."""
    timex = _Timex()
    if ctypes.CDLL(None).adjtimex(ctypes.byref(timex)) < 0:
        return None
    return not timex.status & _UNSYNCHRONISED


# --- the disk ------------------------------------------------------------------------------------


def disk(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Whether the disks have room for the store and the audit log."""
    store = settings.broker.store
    places = [("store", store.path, store.size)] if store.durability != "off" else []
    audit = settings.broker.audit
    if audit.path is not None:
        places.append(("audit log", audit.path, audit.size * (audit.keep + 1)))
    for subject, path, size in places:
        yield from _room(f"disk of the {subject}", path, size)


def _room(subject: str, path: Path, most: int) -> Iterator[Finding]:
    folder = next(each for each in path.absolute().parents if each.is_dir())
    found = os.statvfs(folder)
    if found.f_flag & os.ST_RDONLY:
        advice = "mount it for writing (mount -o remount,rw), or set another path"
        yield Finding("error", subject, f"{folder} is read-only", advice)
        return
    free = found.f_bavail * found.f_frsize
    used = path.stat().st_size if path.is_file() else 0
    text = f"{folder}: {free // _MIB} MiB free"
    if free < LEAST_DISK:
        yield Finding("error", subject, text, "make room; what is full refuses messages")
    elif free + used < most:
        text += f", and it may grow to {format_size(most)}"
        yield Finding("warning", subject, text, "make room, or set a smaller size")
    else:
        yield Finding("ok", subject, text)
    if found.f_files and found.f_favail < LEAST_FILES:
        text = f"{folder}: room for {found.f_favail} more files (inodes)"
        yield Finding("error", subject, text, "delete files; df -i shows where they are")
    kind = _kind(folder)
    if kind in _IN_MEMORY:
        text = f"{folder} is in memory ({kind}): nothing there outlives a restart of the computer"
        yield Finding("warning", subject, text, "set a path on a disk")


def _kind(folder: Path) -> str:
    """The type of the file system that a folder is on."""
    mounts = [(Path(each.mountpoint), each.fstype) for each in psutil.disk_partitions(all=True)]
    around = [(len(mount.parts), kind) for mount, kind in mounts if folder.is_relative_to(mount)]
    return str(max(around, default=(0, ""))[1])


# --- memory and files ----------------------------------------------------------------------------


def memory(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Whether there is as much memory as `broker.limits.memory` allows the broker to use."""
    wanted = settings.broker.limits.memory + BASE_MEMORY
    share = f"{format_size(settings.broker.limits.memory)} of broker.limits.memory"
    available = int(psutil.virtual_memory().available)
    if running is not None:
        available += running["memory"]["process"]  # which is a part of what it needs
    text = f"{available // _MIB} MiB available; the appliance may use {wanted // _MIB} ({share})"
    if available < wanted:
        yield Finding("warning", "memory", text, "a smaller broker.limits.memory")
    else:
        yield Finding("ok", "memory", text)
    limit = group_limit(running["pid"] if running is not None else os.getpid())
    if limit is not None:
        whose = "the appliance's" if running is not None else "this shell's"
        text = f"{whose} control group may use {limit // _MIB} MiB"
        if limit < wanted:
            advice = "a smaller broker.limits.memory, or a larger MemoryMax"
            text += f", the appliance {wanted // _MIB}: the kernel would kill it"
            yield Finding("error", "memory limit", text, advice)
        else:
            yield Finding("ok", "memory limit", text)


def group_limit(pid: int, root: Path = Path("/sys/fs/cgroup")) -> int | None:
    """The least memory limit of the control groups of a process; None when there is none."""
    limits = []
    for line in Path(f"/proc/{pid}/cgroup").read_text().splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        top = root / controllers
        name = "memory.limit_in_bytes" if controllers else "memory.max"
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            if (folder / name).is_file():
                text = (folder / name).read_text().strip()
                limits += [int(text)] if text.isdigit() else []
            if folder == top:
                break
    real = [limit for limit in limits if limit < psutil.virtual_memory().total]
    return min(real, default=None)


def files(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Whether the process may open as many files as there may be connections."""
    wanted = settings.broker.limits.connections + OTHER_FILES
    if running is not None:
        hard = _limit_of(running["pid"])
    else:
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if hard == resource.RLIM_INFINITY or hard >= wanted:
        most = "any number" if hard == resource.RLIM_INFINITY else str(hard)
        yield Finding("ok", "open files", f"{most} allowed, {wanted} needed")
        return
    yield Finding(
        "error",
        "open files",
        f"{hard} allowed, {wanted} needed for broker.limits.connections",
        f"LimitNOFILE={wanted} in the systemd unit, --ulimit nofile={wanted} for a container, or a "
        "smaller broker.limits.connections",
    )


def _limit_of(pid: int) -> int:
    """The hard limit of another process, from a file that only its user and root may read."""
    for line in Path(f"/proc/{pid}/limits").read_text().splitlines():
        if line.startswith("Max open files"):
            hard = line.split()[4]
            return int(hard) if hard.isdigit() else resource.RLIM_INFINITY
    return resource.RLIM_INFINITY
