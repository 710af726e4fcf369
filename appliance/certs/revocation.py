"""Revocation lists (RFC 5280, section 5) of our own authority or a company's.

They are looked through here, and not by OpenSSL. For that one a list whose time is over, or that is
missing for one authority of several, means that nobody comes in any more: a robot whose network is
gone for a week would lock its people out. Here what a list says stays said, however old it is.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

from cryptography import x509

from .files import MALFORMED, CertificateError

#: Some 400,000 entries.
CRL_SIZE: Final = 16 << 20

_PEM: Final = re.compile(rb"-----BEGIN X509 CRL-----.*?-----END X509 CRL-----", re.DOTALL)


@dataclass(frozen=True)
class Revocations:
    """What was revoked and when, by issuer and serial number.

    `ends` says of each list by whom it is and when it is outdated.
    """

    dates: Mapping[x509.Name, Mapping[int, datetime]]
    ends: Sequence[tuple[str, datetime]]

    def date(self, certificate: x509.Certificate) -> datetime | None:
        """When the certificate was revoked; None when it was not."""
        return self.dates.get(certificate.issuer, {}).get(certificate.serial_number)

    def __len__(self) -> int:
        return sum(map(len, self.dates.values()))


NOTHING_REVOKED: Final = Revocations({}, ())


def load_revocations(
    path: Path, data: bytes, authorities: Sequence[x509.Certificate]
) -> Revocations:
    """All lists of a file; CertificateError when one is not whole or not of these authorities."""
    dates: dict[x509.Name, dict[int, datetime]] = {}
    ends: list[tuple[str, datetime]] = []
    for crl in parse_crls(path, data, authorities):
        by_serial = dates.setdefault(crl.issuer, {})
        for item in crl:
            by_serial[item.serial_number] = item.revocation_date_utc
        if crl.next_update_utc is not None:
            ends.append((crl.issuer.rfc4514_string(), crl.next_update_utc))
    return Revocations(dates, ends)


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
