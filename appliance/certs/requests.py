"""Certificate requests (PKCS #10, RFC 2986), made where the key is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID

from appliance.certs.files import MALFORMED, CertificateError

REQUEST_SIZE: Final = 64 << 10
_CURVES: Final = (ec.SECP256R1, ec.SECP384R1, ec.SECP521R1)
# Smaller ones can be broken, and each handshake with a larger one takes the broker's time.
_RSA_BITS: Final = (2048, 4096)


@dataclass(frozen=True, slots=True)
class Request:
    """What a request asks for, as far as it is taken over."""

    key: CertificatePublicKeyTypes
    name: str | None


def new_request(name: str) -> tuple[ec.EllipticCurvePrivateKey, bytes]:
    """A new key, in memory only, and the request in PEM for a certificate of it."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = x509.CertificateSigningRequestBuilder().subject_name(subject)
    return key, builder.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)


def load_request(data: bytes) -> Request:
    """A request in PEM or DER form; CertificateError says what is wrong with it."""
    if len(data) > REQUEST_SIZE:
        raise CertificateError(f"a request of more than {REQUEST_SIZE} bytes is something else")
    if not data.strip():
        raise CertificateError("the request is empty")
    try:
        is_pem = b"-----BEGIN" in data
        load = x509.load_pem_x509_csr if is_pem else x509.load_der_x509_csr
        request = load(data)
        key = request.public_key()
        signed = request.is_signature_valid
        names = request.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    except MALFORMED as error:
        raise CertificateError(
            "not a certificate request (PKCS #10) in PEM or DER form, as `openssl req -new` makes "
            f"it ({error or type(error).__name__})"
        ) from None
    if not signed:
        raise CertificateError(
            "the request is not signed with its own key: it was changed on its way, or someone "
            "asks for a certificate of a key that is not theirs"
        )
    problem = _unfit(key)
    if problem:
        raise CertificateError(f"{problem}; make one on the curve P-256 (prime256v1)")
    return Request(key, str(names[0].value) if len(names) == 1 else None)


def _unfit(key: object) -> str:
    """Why a key is not certified; empty when it is."""
    if isinstance(key, ec.EllipticCurvePublicKey):
        return "" if isinstance(key.curve, _CURVES) else f"a key on the curve {key.curve.name}"
    if isinstance(key, rsa.RSAPublicKey):
        smallest, largest = _RSA_BITS
        fits = smallest <= key.key_size <= largest
        return "" if fits else f"an RSA key of {key.key_size} bits, not of {smallest} to {largest}"
    if isinstance(key, ed25519.Ed25519PublicKey):
        return ""
    return "a kind of key that TLS clients do not use"
