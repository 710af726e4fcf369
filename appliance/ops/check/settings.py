"""Checks what the settings refer to: listeners, users, rules, certificates, store, plugins."""

from __future__ import annotations

import difflib
import importlib.util
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cryptography import x509

from appliance import certs
from appliance.access import AccessFileError, Acl, Passwords
from appliance.certs.settings import tls_files, tls_policies
from appliance.config import OPEN_WITH_SECRETS, Settings, is_open_with_secrets
from appliance.mdns.announcement import label
from appliance.mdns.settings import Listening, announcement
from appliance.ops.check.bridge import bridge
from appliance.ops.check.plugins import plugin_settings
from appliance.ops.check.readable import readable
from appliance.ops.check.rights import rights
from appliance.ops.check.upstreams import upstreams
from appliance.ops.finding import Finding
from appliance.store import StoreError
from appliance.store.inspection import summarise


def check(settings: Settings) -> Iterator[Finding]:
    """Findings about everything that the settings refer to, including those that are ok."""
    yield Finding("ok", str(settings.file or "settings"), f"robot {settings.robot!r}")
    parts = [_listeners, _mdns, _access, _store, _audit, _plugins, bridge, upstreams, readable]
    if any(listener.tls for listener in settings.broker.listeners):
        parts.insert(3, _certificates)
    for part in parts:
        with _warnings() as logged:
            yield from part(settings)
        yield from logged


@contextmanager
def _warnings() -> Iterator[list[Finding]]:
    """Collects warnings that are logged within the block, as findings: `run` would log them too."""
    findings: list[Finding] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: findings.append(  # type: ignore[method-assign]
        Finding("warning", record.name.removeprefix("appliance."), record.getMessage())
    )
    logger = logging.getLogger("appliance")
    propagate, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield findings
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


def _listeners(settings: Settings) -> Iterator[Finding]:
    for listener in settings.broker.listeners:
        subject = f"listener {listener.bind}"
        if listener.protocol == "websocket":
            scheme = "wss" if listener.tls else "ws"
            text = f"for WebSocket only ({scheme}://HOST:PORT/mqtt): plain MQTT is refused here"
            yield Finding("ok", subject, text)
        elif listener.protocol == "web":
            scheme = "https" if listener.tls else "http"
            text = f"for the web ({scheme}://HOST:PORT/, and MQTT over WebSocket at /mqtt)"
            yield Finding("ok", subject, text)
        if listener.tls:
            yield Finding("ok", subject, "TLS")
        elif listener.bind.loopback:
            yield Finding("ok", subject, "without TLS, reached from this computer only")
        else:
            text = "without TLS: everyone on the network can read passwords and messages"
            yield Finding("warning", subject, text)
        if not settings.broker.lets_in_anonymous(listener):
            continue
        if listener.anonymous:
            who = "clients without a user name come in here"
            if listener.anonymous == "always":
                who = "whoever comes is let in here, with any user name, and is anonymous"
            yield Finding("warning", subject, f"{who}, with what the ACL gives to everyone")
        if not listener.tls and not listener.bind.loopback:
            text = "anonymous and without TLS: whoever is on the network is in, and reads along"
            yield Finding("warning", subject, text)
    if settings.broker.anonymous:
        text = "clients without a user name come in, and may do what the ACL gives to everyone"
        yield Finding("warning", "broker.anonymous", text)


def _mdns(settings: Settings) -> Iterator[Finding]:
    listening = [
        Listening(each.bind, each.tls, each.protocol) for each in settings.broker.listeners
    ]
    wanted = announcement(settings, listening, b"", "", os.environ)
    if isinstance(wanted, str):
        yield Finding("ok", "mDNS", f"not announced on the network: {wanted}")
    else:
        ports = ", ".join(f"{each.kind.partition('.')[0]} {each.port}" for each in wanted.services)
        name = label(wanted.robot)
        text = f"announced on the network as {name!r} ({ports}); there `appliance find` lists it"
        yield Finding("ok", "mDNS", text)


def _access(settings: Settings) -> Iterator[Finding]:
    broker = settings.broker
    users = rules = None
    try:
        users = Passwords.load(broker.users).users()
    except AccessFileError as error:
        yield from (Finding("error", "users", str(problem)) for problem in error.problems)
    try:
        rules = Acl.load(broker.acl, settings.robot)
    except AccessFileError as error:
        yield from (Finding("error", "acl", str(problem)) for problem in error.problems)
    if users:
        yield Finding("ok", str(broker.users), f"users: {', '.join(users)}")
    elif users is not None:
        text = "no users; add one with: appliance user add NAME"
        yield Finding("warning", str(broker.users), text)
    if rules is not None:
        yield Finding("ok", str(broker.acl), f"rules: {len(rules.rules)}")
    if rules is not None:
        yield from rights(settings, rules, users)
    others = broker.plugins or broker.tls.username_from != "none"  # these may know more users
    if rules is not None and users is not None and not others:
        known = {*users, *(upstream.user for upstream in settings.upstreams)}
        strangers = {rule.user: rule for rule in reversed(rules.rules) if rule.user not in known}
        for name, first in strangers.items():
            if name:
                near = difflib.get_close_matches(name, known, 1)
                slip = f"did you mean {near[0]!r}? Else " if near else ""
                text = (
                    f"rules for {name!r}, who is no user, and the user of no link: {slip}remove "
                    f"them, or: appliance user add {name}"
                )
                yield Finding("warning", f"{first.file}:{first.line}", text)


def _store(settings: Settings) -> Iterator[Finding]:
    store = settings.broker.store
    directory = next(path for path in store.path.parents if path.exists())
    if store.durability == "off":
        yield Finding("ok", "broker.store", "off: sessions and messages end with the process")
    elif not directory.is_dir() or not os.access(directory, os.W_OK):
        text = f"{directory} is no directory that can be written; the appliance's user must own it"
        yield Finding("error", "broker.store.path", text)
    elif not store.path.exists():
        yield Finding("ok", str(store.path), "not there yet; the first start makes it")
    else:
        try:
            stored = summarise(store.path)
        except StoreError as error:
            text = f"{error}; what can be read is kept at the next start, the file set aside"
            yield Finding("warning", "broker.store.path", text)
        else:
            text = f"kept: sessions {len(stored.sessions)}, retained messages {stored.retained}"
            yield Finding("ok", str(store.path), text)


def _audit(settings: Settings) -> Iterator[Finding]:
    path = settings.broker.audit.path
    if path is None:
        return
    directory = path.parent
    if path.exists() and not path.is_file():
        yield Finding("error", "broker.audit.path", f"{path} is not a regular file")
    elif not directory.is_dir() or not os.access(directory, os.W_OK):
        text = f"{directory} is no directory that can be written; the appliance's user must own it"
        yield Finding("error", "broker.audit.path", text)
    elif path.exists() and path.stat().st_mode & 0o077:
        yield Finding("warning", str(path), "others than its owner can read it; chmod 600")
    else:
        yield Finding("ok", str(path), "the audit log: who connected, was refused, changed what")


def _certificates(settings: Settings) -> Iterator[Finding]:
    tls = settings.broker.tls
    try:
        loaded = certs.load_tls(tls_files(settings.broker), tls_policies(settings.broker))
    except certs.CertificateError as error:
        yield from (Finding("error", "tls", problem) for problem in error.problems)
        return
    certificate = loaded.chain[0]
    text = f"valid until {certificate.not_valid_after_utc:%Y-%m-%d}, for {_names(certificate)}"
    yield Finding("ok", str(tls.certificate), text)
    yield from (Finding("warning", "tls", text) for text in loaded.warnings())
    revoked = len(loaded.revocations)
    if revoked:
        yield Finding("ok", str(loaded.files.revocations), f"revoked certificates: {revoked}")
    outside = certs.server_outside(loaded.files)
    if outside:
        yield Finding("warning", "tls", outside)
    yield from _own_authority(tls.ca, certificate, str(tls.certificate))


def _own_authority(path: Path, certificate: x509.Certificate, name: str) -> Iterator[Finding]:
    """Findings about the CA that clients are given, and about its key."""
    try:
        is_issuer = certs.issued_by(certificate, certs.load_certificates(path)[0])
    except certs.CertificateError:
        is_issuer = False
    if not is_issuer:
        yield Finding("warning", str(path), f"did not sign {name}: clients need the CA that did")
    key = path.with_name("ca.key")
    if key.exists():
        try:
            certs.load_key(key)
        except certs.CertificateError as error:
            yield Finding("error", "tls", str(error))


def _names(certificate: x509.Certificate) -> str:
    try:
        extension = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return "no name"
    return ", ".join(str(name.value) for name in extension.value)


def _plugins(settings: Settings) -> Iterator[Finding]:
    if is_open_with_secrets(settings):
        yield Finding("warning", str(settings.file), OPEN_WITH_SECRETS)
    for name in settings.broker.plugins:
        module = name.rpartition(".")[0]
        try:
            found = importlib.util.find_spec(module) is not None
        except ImportError:
            found = False
        if found:
            yield plugin_settings(name, settings.broker.plugins[name])
        else:
            yield Finding("error", f"plugin {name}", f"there is no Python module {module}")
