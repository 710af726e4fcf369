"""Revocation lists (RFC 5280, section 5) of our own authority or a company's.

They are evaluated here. OpenSSL refuses every client when a list is outdated, or is missing for one
of several authorities: a robot that is without a network for a week would lock its people out. Here
an outdated list stays in force. OpenSSL is given the lists with which it decides in the same way,
because only OpenSSL can send a client the TLS alert.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.certs.files import MALFORMED, CertificateError

#: Some 400,000 entries.
CRL_SIZE: Final = 16 << 20

_PLAIN: Final = (x509.AuthorityKeyIdentifier, x509.CRLNumber)

#: The most entries of all lists that OpenSSL is given, in each listener's context.
OPENSSL_ENTRIES: Final = 10_000

_PEM: Final = re.compile(rb"-----BEGIN X509 CRL-----.*?-----END X509 CRL-----", re.DOTALL)


@dataclass(frozen=True)
class Revocations:
    """What was revoked and when, by issuer and serial number.

    `ends` has the issuer of each list, and when it is outdated. `for_openssl` are the lists in PEM
    form if OpenSSL decides in the same way while they are fresh, otherwise empty.
    """

    dates: Mapping[x509.Name, Mapping[int, datetime]]
    ends: Sequence[tuple[str, datetime]]
    begins: Sequence[datetime] = ()
    for_openssl: bytes = b""

    def date(self, certificate: x509.Certificate) -> datetime | None:
        """When the certificate was revoked; None when it was not."""
        return self.dates.get(certificate.issuer, {}).get(certificate.serial_number)

    def lists(self, authority: x509.Certificate) -> bool:
        """Whether there is a list of that authority, even an empty one."""
        return authority.subject in self.dates

    def is_fresh(self, now: datetime) -> bool:
        """Whether at that time no list is outdated or from the future."""
        return all(begin <= now for begin in self.begins) and all(
            now <= end for _, end in self.ends
        )

    def __len__(self) -> int:
        return sum(map(len, self.dates.values()))


NOTHING_REVOKED: Final = Revocations({}, ())


def load_revocations(
    path: Path, data: bytes, authorities: Sequence[x509.Certificate]
) -> Revocations:
    """All lists of a file; CertificateError when one is malformed or not of these authorities."""
    dates: dict[x509.Name, dict[int, datetime]] = {}
    ends: list[tuple[str, datetime]] = []
    crls = parse_crls(path, data, authorities)
    for crl in crls:
        by_serial = dates.setdefault(crl.issuer, {})
        for item in crl:
            by_serial[item.serial_number] = item.revocation_date_utc
        if crl.next_update_utc is not None:
            ends.append((crl.issuer.rfc4514_string(), crl.next_update_utc))
    begins = [crl.last_update_utc for crl in crls]
    return Revocations(dates, ends, begins, _for_openssl(crls, authorities))


def _for_openssl(
    crls: Sequence[x509.CertificateRevocationList], authorities: Sequence[x509.Certificate]
) -> bytes:
    """All lists in PEM form if OpenSSL decides with them as we do, otherwise nothing.

    OpenSSL requires a list of every authority that has signed a client's certificate, so no client
    may have a CA that is not in our file. And it obeys extensions that we ignore.
    """
    if not crls or sum(map(len, crls)) > OPENSSL_ENTRIES:
        return b""
    for authority in authorities:
        lists = [crl for crl in crls if crl.issuer == authority.subject]
        if len(lists) != 1 or not _signs_clients_alone(authority):
            return b""
        if not _is_plain(lists[0], authority):
            return b""
    return b"".join(crl.public_bytes(Encoding.PEM) for crl in crls)


def _signs_clients_alone(authority: x509.Certificate) -> bool:
    try:
        constraints = authority.extensions.get_extension_for_class(x509.BasicConstraints).value
        usage = authority.extensions.get_extension_for_class(x509.KeyUsage).value
    except x509.ExtensionNotFound:
        return False
    return constraints.path_length == 0 and usage.crl_sign


def _is_plain(crl: x509.CertificateRevocationList, authority: x509.Certificate) -> bool:
    values = [extension.value for extension in crl.extensions]
    keys = [value for value in values if isinstance(value, x509.AuthorityKeyIdentifier)]
    try:
        own = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    except x509.ExtensionNotFound:
        return False
    return all(isinstance(value, _PLAIN) for value in values) and all(
        (key.key_identifier, key.authority_cert_issuer) == (own.digest, None) for key in keys
    )


def parse_crls(
    path: Path, data: bytes, authorities: Sequence[x509.Certificate]
) -> list[x509.CertificateRevocationList]:
    """The lists in a file, several in PEM or one in DER form, their signatures checked."""
    parts = _PEM.findall(data)
    load = x509.load_pem_x509_crl if parts else x509.load_der_x509_crl
    try:
        crls = [load(part) for part in parts or [data]]
        for crl in crls:
            _check(path, crl, authorities)
    except CertificateError:
        raise
    except MALFORMED as error:
        raise CertificateError(
            f"{path} is not a certificate revocation list in PEM or DER form ({error})"
        ) from None
    return crls


def _check(
    path: Path, crl: x509.CertificateRevocationList, authorities: Sequence[x509.Certificate]
) -> None:
    issuers = [authority for authority in authorities if authority.subject == crl.issuer]
    who = crl.issuer.rfc4514_string()
    if not issuers:
        raise CertificateError(
            f"{path} is of {who}, whose certificate is not in broker.tls.ca; put it there, or take "
            "the list out"
        )
    if not any(crl.is_signature_valid(issuer.public_key()) for issuer in issuers):  # type: ignore[arg-type]
        raise CertificateError(f"{path} is not signed by {who}; get the list anew")
    for extension in crl.extensions:
        if isinstance(extension.value, x509.DeltaCRLIndicator):
            raise CertificateError(f"{path} has only what changed; get the complete list")
        point = extension.value
        if isinstance(point, x509.IssuingDistributionPoint) and point.indirect_crl:
            raise CertificateError(f"{path} speaks of other authorities' certificates, too")
