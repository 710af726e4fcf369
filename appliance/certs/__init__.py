"""Certificates: the appliance's own authority, and TLS of the listeners, of ours or a company's."""

from __future__ import annotations

from .addresses import Address, local_names
from .authority import (
    create_authority,
    issue_client,
    issue_server,
    issued,
    renew,
    revoke,
    sign,
    write_crl,
    write_readme,
)
from .contexts import (
    ClientCertificates,
    LoadedTls,
    TlsContexts,
    TlsFiles,
    TlsPolicy,
    load_tls,
    server_context,
)
from .export import check_password, write_bundle, write_pkcs12
from .files import CertificateError, issued_by, load_certificates, load_key
from .identity import username_of
from .listing import Ending, Listed, endings, listed
from .registry import Issued
from .renewal import keep_server_certificate, server_outside, server_revoked
from .requests import REQUEST_SIZE

__all__ = [
    "REQUEST_SIZE",
    "Address",
    "CertificateError",
    "ClientCertificates",
    "Ending",
    "Issued",
    "Listed",
    "LoadedTls",
    "TlsContexts",
    "TlsFiles",
    "TlsPolicy",
    "check_password",
    "create_authority",
    "endings",
    "issue_client",
    "issue_server",
    "issued",
    "issued_by",
    "keep_server_certificate",
    "listed",
    "load_certificates",
    "load_key",
    "load_tls",
    "local_names",
    "renew",
    "revoke",
    "server_context",
    "server_outside",
    "server_revoked",
    "sign",
    "username_of",
    "write_bundle",
    "write_crl",
    "write_pkcs12",
    "write_readme",
]
