"""Exports a client's key and certificate in the forms that devices import."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, PrivateFormat
from cryptography.hazmat.primitives.serialization.pkcs12 import (
    PBES,
    serialize_key_and_certificates,
)

from appliance.certs.authority import check_client_name
from appliance.certs.files import (
    CertificateError,
    key_pem,
    load_certificates,
    load_key,
    parse_certificates,
    write,
)
from appliance.certs.pkcs12_mac import with_rounds

SHORTEST_PASSWORD: Final = 8
_ROUNDS: Final = 100_000


def check_password(password: str) -> None:
    """CertificateError when the password is too short for a file that is copied around, or holds a
    null character, at which OpenSSL takes it to end."""
    if len(password) < SHORTEST_PASSWORD:
        raise CertificateError(
            f"a password of less than {SHORTEST_PASSWORD} characters can be guessed"
        )
    if "\0" in password:
        raise CertificateError("a password with a null character opens no file")


def write_pkcs12(directory: Path, name: str, password: str) -> Path:
    """Write `clients/NAME.p12`: key, certificate and `ca.crt` (RFC 7292). Returns its path.

    CertificateError when one of them is missing or unfit, and as of `check_password`.
    """
    check_password(password)
    path, key = _key_of(directory, name)
    certificate = load_certificates(path.with_name(f"{name}.crt"))[0]
    authorities = load_certificates(directory / "ca.crt")
    target = path.with_name(f"{name}.p12")
    write(target, _packed(name, key, certificate, authorities, password), 0o600)
    return target


def pkcs12(
    name: str, key: ec.EllipticCurvePrivateKey, certificate: bytes, authority: bytes, password: str
) -> bytes:
    """What `write_pkcs12` writes, of a key that is in no file and of two certificates in PEM.

    CertificateError as of `check_password`.
    """
    check_password(password)
    own = parse_certificates(Path(f"{name}.crt"), certificate)[0]
    authorities = parse_certificates(Path("ca.crt"), authority)
    return _packed(name, key, own, authorities, password)


def _packed(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    certificate: x509.Certificate,
    authorities: Sequence[x509.Certificate],
    password: str,
) -> bytes:
    # Not AES, which iOS before 16, Android before 13 and Windows 10 refuse as a wrong password. The
    # number of rounds and the password's length make up for it: also of the MAC, which the library
    # makes with few.
    encryption = (
        PrivateFormat.PKCS12.encryption_builder()
        .kdf_rounds(_ROUNDS)
        .key_cert_algorithm(PBES.PBESv1SHA1And3KeyTripleDESCBC)
        .hmac_hash(hashes.SHA1())
        .build(password.encode())
    )
    packed = serialize_key_and_certificates(
        name.encode(), key, certificate, authorities, encryption
    )
    return with_rounds(packed, password, _ROUNDS)


def write_bundle(directory: Path, name: str) -> Path:
    """Write `clients/NAME.pem`: key, certificate and `ca.crt` in one. Returns its path."""
    path, key = _key_of(directory, name)
    files = (path.with_name(f"{name}.crt"), directory / "ca.crt")
    certificates = [certificate for file in files for certificate in load_certificates(file)]
    data = key_pem(key) + b"".join(c.public_bytes(Encoding.PEM) for c in certificates)
    target = path.with_name(f"{name}.pem")
    write(target, data, 0o600)
    return target


def _key_of(directory: Path, name: str) -> tuple[Path, ec.EllipticCurvePrivateKey]:
    check_client_name(name)
    path = directory / "clients" / f"{name}.key"
    key = load_key(path)
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CertificateError(f"{path} must be an elliptic curve key, as made here")
    return path, key
