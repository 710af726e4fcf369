"""`broker.tls` of appliance.yaml, and what single listeners override."""

from __future__ import annotations

from pathlib import Path

from appliance.certs.contexts import TlsContexts, TlsFiles, TlsPolicy
from appliance.config import BrokerSection


def listener_name(index: int) -> str:
    """The name of the listener with that number, in errors and for its context."""
    return f"broker.listeners[{index}]"


def tls_files(broker: BrokerSection) -> TlsFiles:
    """The files of all listeners."""
    tls = broker.tls
    return TlsFiles(tls.certificate, tls.key, tls.ca, tls.crl)


def tls_policies(broker: BrokerSection) -> dict[str, TlsPolicy]:
    """The policy of each listener with TLS; empty when none has TLS."""
    return {
        listener_name(index): TlsPolicy(
            broker.client_certificates(listener),
            listener.min_version or broker.tls.min_version,
            listener.ciphers or broker.tls.ciphers,
        )
        for index, listener in enumerate(broker.listeners)
        if listener.tls
    }


def tls_contexts(broker: BrokerSection) -> TlsContexts | None:
    """The TLS contexts of the listeners, by `listener_name`; None when no listener has TLS.

    Raises:
        CertificateError: a file is missing or wrong.
    """
    policies = tls_policies(broker)
    if not policies:
        return None
    return TlsContexts(tls_files(broker), policies, broker.tls.username_from)


def authority_directory(broker: BrokerSection) -> Path | None:
    """The directory of the appliance's own CA; None where the certificates are of another one."""
    tls = broker.tls
    directory = tls.ca.parent
    is_own = tls.ca.name == "ca.crt" and tls.crl in (None, directory / "ca.crl")
    return directory if is_own else None
