"""Examines keys, passwords and certificates: who can read them, and when they expire."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from appliance import certs
from appliance.certs.settings import tls_files
from appliance.config import Settings
from appliance.ops.finding import Finding, Level

_WHAT = {"server": "the server's certificate", "ca": "the CA", "crl": "the revocation list"}


def permissions(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Whether others on this computer can read keys and passwords, or change what is trusted."""
    tls, broker = settings.broker.tls, settings.broker
    authority = tls.certificate.parent
    private = [tls.key, authority / "ca.key", broker.users, broker.store.path, settings.control]
    if broker.audit.path is not None:
        private.append(broker.audit.path)
    for upstream in settings.upstreams:
        secrets = upstream.login.password_file, upstream.login.token_file, upstream.tls.key
        private += [path for path in secrets if path is not None]
    trusted = [broker.acl, tls.certificate, authority, broker.users.parent]
    trusted += [path for path in (tls.ca, settings.file) if path is not None]
    open_ones = [
        *((path, 0o077, "others can read it", "chmod go=") for path in dict.fromkeys(private)),
        *((path, 0o022, "others can change it", "chmod go-w") for path in dict.fromkeys(trusted)),
    ]
    found = False
    for path, bits, text, command in open_ones:
        try:
            state = path.stat()
        except OSError:
            continue  # `check` reports missing files
        if state.st_mode & bits and not state.st_mode & 0o1000:
            found = True
            mode = f"mode {state.st_mode & 0o777:04o}"
            yield Finding("error", str(path), f"{text} ({mode})", f"{command} {path}")
        if os.geteuid() not in (0, state.st_uid):
            found = True
            text = "it belongs to another user: run this as the appliance's user, or as root"
            yield Finding("warning", str(path), text)
    if not found:
        yield Finding(
            "ok", "permissions", "keys, passwords and what is stored are closed to others"
        )


def certificates(settings: Settings, running: dict[str, Any] | None) -> Iterator[Finding]:
    """Findings about the expiry of certificates and of the revocation list."""
    files = tls_files(settings.broker)
    if not any(listener.tls for listener in settings.broker.listeners):
        return
    if not files.certificate.exists():
        advice = "appliance init makes what is missing"
        yield Finding("error", str(files.certificate), "it is not there", advice)
        return
    try:
        found = certs.expiries(files)
    except certs.CertificateError as error:
        yield Finding("error", "certificates", str(error))
        return
    directory = files.certificate.parent
    is_ours = (directory / "ca.key").exists()
    for each in found:
        yield _ending(each, is_ours)
    revoked = certs.server_revoked(files)
    if revoked:
        advice = "appliance cert renew server"
        yield Finding("error", "the server's certificate", revoked, advice)
    if (directory / "issued.jsonl").exists():
        yield from _clients(directory)


def _ending(each: certs.Expiry, is_ours: bool) -> Finding:
    subject = _WHAT[each.what]
    text = f"{each.days} days left, until {each.ends:%Y-%m-%d} ({each.file})"
    if each.days < 0:
        text = f"it ran out on {each.ends:%Y-%m-%d} ({each.file})"
    elif not each.is_soon:
        return Finding("ok", subject, text)
    if each.what == "server" and is_ours:
        advice = "the running appliance renews it by itself; appliance cert renew server does, too"
    elif each.what == "crl":
        advice = "get a new one from the CA; what it revokes stays revoked meanwhile"
    elif each.what == "ca":
        advice = "make a new CA in an empty folder, and give its ca.crt to all clients"
    else:
        advice = "get a new one from its CA"
    level: Level = "error" if each.days < 0 and each.what != "crl" else "warning"
    return Finding(level, subject, text, advice)


def _clients(directory: Path) -> Iterator[Finding]:
    try:
        listed = certs.list_certificates(directory)
    except certs.CertificateError as error:
        yield Finding("error", "clients' certificates", str(error))
        return
    clients = [each for each in listed if each.purpose == "client" and each.usable]
    for each in clients:
        if each.ends_soon:
            text = f"{each.days} days left, until {each.expires:%Y-%m-%d}"
            advice = f"appliance cert renew {each.name}, and give it to the client"
            yield Finding("warning", f"certificate of {each.name}", text, advice)
    if clients:
        least = min(each.days for each in clients)
        text = f"{len(clients)}; the first to end has {least} days left"
        yield Finding("ok", "clients' certificates", text)
