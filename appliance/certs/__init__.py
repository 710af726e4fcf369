"""Certificates: the appliance's own authority, and TLS of the listeners, of ours or a company's."""

from __future__ import annotations

from appliance.certs.addresses import Address, local_names
from appliance.certs.authority import (
    check_client_name,
    check_new_client,
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
from appliance.certs.contexts import (
    ClientCertificates,
    LoadedTls,
    TlsContexts,
    TlsFiles,
    TlsPolicy,
    load_tls,
    server_context,
)
from appliance.certs.export import check_password, write_bundle, write_pkcs12
from appliance.certs.files import (
    CertificateError,
    fingerprints,
    issued_by,
    load_certificates,
    load_key,
)
from appliance.certs.identity import username_of
from appliance.certs.listing import Expiry, ListedCertificate, expiries, list_certificates
from appliance.certs.registry import Issued
from appliance.certs.renewal import keep_server_certificate, server_outside, server_revoked
from appliance.certs.requests import REQUEST_SIZE, new_request

__all__ = [
    "REQUEST_SIZE",
    "Address",
    "CertificateError",
    "ClientCertificates",
    "Expiry",
    "Issued",
    "ListedCertificate",
    "LoadedTls",
    "TlsContexts",
    "TlsFiles",
    "TlsPolicy",
    "check_client_name",
    "check_new_client",
    "check_password",
    "create_authority",
    "expiries",
    "fingerprints",
    "issue_client",
    "issue_server",
    "issued",
    "issued_by",
    "keep_server_certificate",
    "list_certificates",
    "load_certificates",
    "load_key",
    "load_tls",
    "local_names",
    "new_request",
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
