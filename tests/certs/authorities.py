"""An authority of a company, in a few lines, and what the tests know of ours."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from appliance import certs
from appliance.certs.files import key_pem, write

NAMES = ["r2d2", "r2d2.local", "localhost"]
ADDRESSES: list[certs.Address] = [
    ipaddress.IPv4Address("127.0.0.1"),
    ipaddress.IPv6Address("::1"),
]
NOW = datetime.now(timezone.utc).replace(microsecond=0)


@dataclass
class Company:
    """A root, and one below it that issues."""

    name: str = "ACME"
    key: ec.EllipticCurvePrivateKey = field(
        default_factory=lambda: ec.generate_private_key(ec.SECP256R1())
    )
    issuer: Company | None = None

    def __post_init__(self) -> None:
        self.certificate = self._certify(
            f"{self.name} CA", self.key, self.issuer or self, is_authority=True
        )

    def below(self) -> Company:
        return Company(f"{self.name} Issuing", issuer=self)

    def _certify(
        self,
        common_name: str | None,
        key: ec.EllipticCurvePrivateKey,
        issuer: Company,
        *,
        is_authority: bool = False,
        alternatives: list[x509.GeneralName] | None = None,
        purpose: x509.ObjectIdentifier | None = None,
        days: float = 90,
    ) -> x509.Certificate:
        subject = [] if common_name is None else [(NameOID.COMMON_NAME, common_name)]
        name = x509.Name([x509.NameAttribute(oid, value) for oid, value in subject])
        authority = name if issuer is self and is_authority else issuer.certificate.subject
        builder = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(authority)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(NOW - timedelta(days=400))
            .not_valid_after(NOW + timedelta(days=days))
            .add_extension(x509.BasicConstraints(is_authority, None), critical=True)
        )
        if alternatives:
            builder = builder.add_extension(
                x509.SubjectAlternativeName(alternatives), critical=False
            )
        if purpose is not None:
            builder = builder.add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
        return builder.sign(issuer.key, hashes.SHA256())

    def issue(
        self,
        path: Path,
        common_name: str | None,
        *,
        server: bool = False,
        alternatives: list[x509.GeneralName] | None = None,
        chain: bool = False,
        days: float = 90,
    ) -> x509.Certificate:
        """`path`.crt, with the intermediate behind it when `chain`, and `path`.key."""
        key = ec.generate_private_key(ec.SECP256R1())
        purpose = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
        certificate = self._certify(
            common_name, key, self, alternatives=alternatives, purpose=purpose, days=days
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        pem = certificate.public_bytes(Encoding.PEM)
        if chain:
            pem += self.certificate.public_bytes(Encoding.PEM)
        write(path.with_name(f"{path.name}.crt"), pem, 0o644)
        write(path.with_name(f"{path.name}.key"), key_pem(key), 0o600)
        return certificate

    def crl(self, *revoked: x509.Certificate, days: int = 7) -> bytes:
        """A list that is to be replaced in so many days, in PEM form."""
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(self.certificate.subject)
            .last_update(NOW - timedelta(days=30))
            .next_update(NOW + timedelta(days=days))
        )
        for certificate in revoked:
            builder = builder.add_revoked_certificate(
                x509.RevokedCertificateBuilder()
                .serial_number(certificate.serial_number)
                .revocation_date(NOW - timedelta(days=31))
                .build()
            )
        return builder.sign(self.key, hashes.SHA256()).public_bytes(Encoding.PEM)

    def pem(self) -> bytes:
        return self.certificate.public_bytes(Encoding.PEM)
