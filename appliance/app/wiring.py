"""The access files and the listeners that appliance.yaml asks for."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING

from appliance.access import FileAccess
from appliance.broker.broker import Broker
from appliance.certs import TlsContexts
from appliance.certs.settings import listener_name
from appliance.config import Settings, secrets_in
from appliance.net.listeners import ListenerSettings

if TYPE_CHECKING:
    from appliance.plugins import ApplianceBroker


def access_files(settings: Settings) -> tuple[Path | None, Path | None]:
    """The users file and the ACL file; None for one that is missing and that plugins replace."""
    broker = settings.broker
    if not broker.plugins:
        return broker.users, broker.acl
    from appliance.plugins import plugin_kinds

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
            terms=listener.terms(),
        )
        for index, listener in enumerate(settings.broker.listeners)
    ]


def plugins(
    settings: Settings,
    broker: Broker,
    access: FileAccess,
    listen: Callable[[], Awaitable[None]],
    hang_up: Callable[[], Awaitable[None]],
) -> ApplianceBroker | None:
    """amqtt's frame with the plugins, which starts and stops the listeners; None without plugins.

    Nothing of amqtt is imported where no plugin is configured: it takes time and memory.

    Raises:
        PluginSettingsError: one of them cannot be loaded.
    """
    wanted = settings.broker.plugins
    if not wanted:
        return None
    from appliance.plugins import ApplianceBroker, CachePolicy, configuration

    limits, answers = settings.broker.limits, settings.broker.plugin_answers
    listeners = [(str(listener.bind), listener.tls) for listener in settings.broker.listeners]
    return ApplianceBroker(
        broker,
        access,
        configuration(listeners, limits.connections, wanted),
        listen,
        hang_up,
        # In less than the listeners' time limit, so that a client gets an answer when plugins hang.
        min(answers.timeout, 0.8 * limits.connect_timeout),
        answers=CachePolicy(answers.keep, answers.keep_refusals, answers.size),
        secrets=secrets_in(wanted),
        max_wait=0.2 * limits.connect_timeout,
    )
