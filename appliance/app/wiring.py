"""The access files and the listeners that appliance.yaml asks for."""

from __future__ import annotations

from pathlib import Path

from appliance.certs import TlsContexts
from appliance.certs.settings import listener_name
from appliance.config import Settings
from appliance.net.listeners import ListenerSettings
from appliance.plugins import plugin_kinds


def access_files(settings: Settings) -> tuple[Path | None, Path | None]:
    """The users file and the ACL file; None for one that is missing and that plugins replace."""
    broker = settings.broker
    authenticating, ruling = plugin_kinds(broker.plugins)
    return (
        None if authenticating and not broker.users.exists() else broker.users,
        None if ruling and not broker.acl.exists() else broker.acl,
    )


def listener_settings(settings: Settings, tls: TlsContexts | None) -> list[ListenerSettings]:
    """What the listeners are opened with; TLS contexts are looked up for each connection."""
    return [
        listener.build(
            ListenerSettings,
            host=listener.bind.host,
            port=listener.bind.port,
            path=listener.bind.path,
            context=tls.source(listener_name(index)) if listener.tls and tls else None,
        )
        for index, listener in enumerate(settings.broker.listeners)
    ]
