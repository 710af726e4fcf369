"""Runs programs of another kind of computer here: qemu interprets them.

Linux is told of qemu in a namespace of its own (binfmt_misc, which has one for each user namespace
since Linux 6.7), so that nothing changes for the rest of the computer. Compilers need not be
emulated: one of this computer's kind that makes code for the other is many times faster.
"""

from __future__ import annotations

import os
from pathlib import Path

#: Debian's names of the kinds of computers that there are executables for.
ARCHITECTURES = {"x86_64": "amd64", "aarch64": "arm64"}
#: What systemd tells Linux at the start, where it runs: the interpreter of a kind of programs.
RULES = Path("/usr/lib/binfmt.d")

# Where Linux is older, only the rules of the whole computer count. Debian's package sets them.
_ENTER = """
files=/proc/sys/fs/binfmt_misc
rule=$0
if mount -t binfmt_misc none $files 2>/dev/null; then cat "$rule" >$files/register; fi
exec "$@"
"""

# A namespace's users are written from outside of it: by a process that is left behind here, for the
# one that goes on as the command. All users are known in there, under their own numbers.
_WITH_USERS = """
namespace=/proc/$$/ns/user
here=$(readlink $namespace)
( (
    tries=500
    while [ "$(readlink $namespace)" = "$here" ] && [ $((tries -= 1)) -gt 0 ]; do sleep 0.01; done
    for kind in gid uid; do
        map=$(
            while read -r inside _ count; do
                echo "$inside $inside $count"
            done </proc/self/${kind}_map
        )
        echo "$map" >/proc/$$/${kind}_map
    done
) </dev/null >/dev/null 2>&1 & )
exec unshare --user --mount --propagation private sh -c '
    tries=500
    until [ "$(id -u)" = 0 ]; do
        tries=$((tries - 1))
        if [ $tries = 0 ]; then echo "users cannot be mapped into a namespace" >&2; exit 125; fi
        sleep 0.01
    done
    exec sh -c "$@"
' sh "$@"
"""


def is_foreign(machine: str) -> bool:
    """Whether that (`x86_64`, `aarch64`) is another kind than this computer."""
    return machine != os.uname().machine


def prefix(machine: str) -> list[str]:
    """What to put before a command that runs programs of that kind, or starts some that do.

    The command is root in a user namespace. Root's own has all users, another's only that one.
    """
    if not is_foreign(machine):
        return []
    enter = [
        "unshare",
        "--user",
        "--map-root-user",
        "--mount",
        "--propagation",
        "private",
        "sh",
        "-c",
    ]
    if os.geteuid() == 0:
        enter = ["sh", "-c", _WITH_USERS, "sh"]
    return [*enter, _ENTER, str(RULES / f"qemu-{machine}.conf")]


def missing(machine: str) -> list[str]:
    """Debian's packages that emulation of it needs and this computer lacks."""
    if not is_foreign(machine) or (RULES / f"qemu-{machine}.conf").exists():
        return []
    return ["qemu-user-static"]
