"""Checks, for root, that the appliance's user can read the files that root has just read."""

from __future__ import annotations

import os
import pwd
from collections.abc import Iterator
from pathlib import Path

from appliance.config import Settings
from appliance.host.owners import OwnerError, acting_for
from appliance.ops.finding import Finding


def readable(settings: Settings) -> Iterator[Finding]:
    """An error for each file that is there and that the appliance may not read.

    The appliance's user is who controls its database, its control socket or its configuration.
    Nothing is said to others than root: they read with their own rights.
    """
    if os.geteuid() != 0:
        return
    try:
        with acting_for(settings.broker.store.path, settings.control, settings.file):
            user = os.geteuid()
            closed = [path for path in dict.fromkeys(_files(settings)) if _is_closed(path)]
    except OwnerError:  # which the commands that write say
        return
    for path in closed:
        try:
            owner = _name(path.stat().st_uid)
        except OSError:
            continue
        text = (
            f"it belongs to {owner}; the appliance runs as {_name(user)} and cannot read it: "
            f"chown {_name(user)} {path}"
        )
        yield Finding("error", str(path), text)


def _files(settings: Settings) -> Iterator[Path]:
    broker = settings.broker
    found = [settings.file, broker.users, broker.acl]
    if any(listener.tls for listener in broker.listeners):
        found += [broker.tls.certificate, broker.tls.key, broker.tls.ca]
    for link in settings.upstreams:
        tls, login = link.tls, link.login
        found += [login.password_file, login.token_file, tls.ca, tls.certificate, tls.key]
    return (path for path in found if path is not None)


def _is_closed(path: Path) -> bool:
    try:
        path.open("rb").close()
    except PermissionError:
        return True
    except OSError:  # what is not there is said by who wants it
        return False
    return False


def _name(user: int) -> str:
    try:
        return pwd.getpwuid(user).pw_name
    except KeyError:
        return str(user)
