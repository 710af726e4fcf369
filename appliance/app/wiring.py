"""What each part is told of appliance.yaml."""

from __future__ import annotations

from pathlib import Path

from appliance.broker.ports import Features, Limits, UserLimits
from appliance.certs import TlsContexts
from appliance.certs.settings import listener_name, tls_files, tls_policies
from appliance.config import Settings
from appliance.net.listeners import Admission, ListenerSettings
from appliance.plugins import plugin_kinds


def access_files(settings: Settings) -> tuple[Path | None, Path | None]:
    """The users file and the ACL file; None where plugins do its work and it is missing."""
    broker = settings.broker
    authenticating, ruling = plugin_kinds(broker.plugins)
    return (
        None if authenticating and not broker.users.exists() else broker.users,
        None if ruling and not broker.acl.exists() else broker.acl,
    )


def broker_limits(settings: Settings) -> Limits:
    """What a client can make grow."""
    limits = settings.broker.limits
    return Limits(
        connections=limits.connections,
        packet_size=limits.packet_size,
        memory=limits.memory,
        queue_messages=limits.queue_messages,
        queue_bytes=limits.queue_bytes,
        queue_full=limits.queue_full,
        keep=0 if limits.keep == "latest" else limits.keep,
        inflight=limits.inflight,
        sessions=limits.sessions,
        subscriptions=limits.subscriptions,
        client_id_length=limits.client_id_length,
        topic_length=limits.topic_length,
        topic_levels=limits.topic_levels,
        retained_messages=limits.retained_messages,
        retained_bytes=limits.retained_bytes,
        session_expiry=round(limits.session_expiry),
        topic_alias=limits.topic_alias,
        user_properties=limits.user_properties,
        keep_alive=round(limits.keep_alive),
        user=UserLimits(**dict(limits.user)),
    )


def features(settings: Settings) -> Features:
    """What the standard leaves to the operator."""
    return Features(
        check_payload_format=settings.broker.check_payload_format,
        reason_strings=settings.broker.reason_strings,
        response_information=settings.broker.response_information or "",
    )


def admission(settings: Settings) -> Admission:
    """How many clients may come, and how fast."""
    limits = settings.broker.limits
    return Admission(
        limits.connections,
        limits.connect_timeout,
        limits.connections_per_address,
        limits.connection_rate,
        limits.publish_rate,
    )


def tls(settings: Settings) -> TlsContexts | None:
    """The TLS of the listeners, by their place in the configuration; None when none has it.

    Raises:
        CertificateError: a file is missing or wrong.
    """
    broker = settings.broker
    policies = tls_policies(broker)
    if not policies:
        return None
    return TlsContexts(tls_files(broker), policies, broker.tls.username_from)


def listener_settings(settings: Settings, tls: TlsContexts | None) -> list[ListenerSettings]:
    """Where is listened, with the TLS that holds when a client comes."""
    return [
        ListenerSettings(
            listener.bind.host,
            listener.bind.port,
            tls.source(listener_name(index)) if listener.tls and tls else None,
            listener.protocol,
            listener.bind.path,
            listener.mode,
            listener.anonymous,
        )
        for index, listener in enumerate(settings.broker.listeners)
    ]
