"""The appliance's own certificate authority, and the TLS settings of its listeners.

Keys are on the curve P-256, which every TLS stack has, those of microcontrollers included.
Certificates follow RFC 5280. A key that exists is never replaced, only certified again.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import re
import socket
import ssl
import tempfile
import threading
from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path
from typing import Final, Literal

import psutil
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

Address = IPv4Address | IPv6Address
ClientCertificates = Literal["none", "optional", "required"]

_log = logging.getLogger(__name__)

AUTHORITY_VALID: Final = timedelta(days=3650)
# The longest that Apple's systems accept from a private authority. Shorter would not be safer, as
# the authority's key is on the same computer, and a robot in the field must not fall silent.
CERTIFICATE_VALID: Final = timedelta(days=825)
# Clients whose clock is behind, and time zones taken for UTC.
_BACKDATED: Final = timedelta(days=1)
_EXPIRES_SOON: Final = timedelta(days=30)
# A computer without a battery for its clock starts in 1970 or with the age of its image, and would
# make certificates that have expired when the clock is set.
_NEVER_BEFORE: Final = datetime(2025, 1, 1, tzinfo=timezone.utc)

_MAX_COMMON_NAME: Final = 64  # RFC 5280, appendix A: ub-common-name
_DNS_NAME: Final = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?:\.[A-Za-z0-9_-]{1,63})*\.?")
_FILE_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]*")
_RESOLVER_PATIENCE: Final = 3.0  # seconds

# Ephemeral keys and authenticated encryption only. TLS 1.3 has nothing else.
_TLS12_CIPHERS: Final = "ECDHE+AESGCM:ECDHE+CHACHA20"

_README: Final = """\
# Keys and certificates of this appliance

Made on this computer. None of it belongs into a repository, a chat or a ticket, except `ca.crt`.

- `ca.crt`: the certificate of this appliance's own authority, by which clients know the robot.
  **Everyone** may have it, and every client needs it.
- `ca.key`: its key. Whoever has it can pose as the robot, and as any client. **Nobody** gets it.
  It is only needed to make certificates: you may keep it elsewhere until then.
- `server.crt`: the server's certificate, with the names and addresses of this computer. Clients
  get it when they connect.
- `server.key`: its key, for **the appliance alone**.
- `clients/NAME.crt`, `clients/NAME.key`: a client's certificate and key, for **that client alone**.

The appliance refuses a key file that others can read: `chmod 600 FILE`.

The authority is valid for ten years, the others for {days} days. To make the server's certificate
anew, before it expires or when this computer got another name or address: delete `server.crt`,
run `appliance init`, restart the appliance. The key stays, and clients keep their `ca.crt`.

## Giving `ca.crt` to clients

Check that it arrived as it left: `openssl x509 -in ca.crt -noout -fingerprint -sha256` prints the
same on both sides.

- **mosquitto_sub, mosquitto_pub**: `--cafile ca.crt`. **paho-mqtt**: `client.tls_set("ca.crt")`.
  **MQTT.js**: `ca: fs.readFileSync("ca.crt")`.
- **Android**: Settings → Security → Encryption & credentials → Install a certificate → CA
  certificate. **iPhone, iPad**: open the file, install the profile in Settings, then turn it on
  under General → About → Certificate Trust Settings. MQTT apps often take the file themselves.
- **A browser**: import it as an authority for websites. **Debian, Ubuntu**: copy it to
  `/usr/local/share/ca-certificates/` and run `update-ca-certificates`.
- **A microcontroller**: paste the file into the program: `client.setCACert(ca)` on Arduino-ESP32,
  `.broker.verification.certificate` in ESP-IDF, `mbedtls_x509_crt_parse` (its length counts the
  closing zero byte). It needs ECDSA and P-256, and the time of day, which is what NTP is for.

Clients connect to a name or address that is in the certificate; to see which:
`openssl x509 -in server.crt -noout -ext subjectAltName`. A name such as `robot.local` stays right
when the address changes.
"""


class CertificateError(ValueError):
    """A certificate or key cannot be made or used; the message says why and what to do."""


# Making certificates


def create_authority(directory: Path, name: str | None = None) -> None:
    """Makes `ca.crt` and `ca.key`. `name`, by default the host's, is for people who look at it.

    CertificateError when either file is there.
    """
    certificate_file, key_file = directory / "ca.crt", directory / "ca.key"
    for path in (certificate_file, key_file):
        if path.exists():
            raise CertificateError(
                f"{path} exists; clients trust it. For a new authority move it away first"
            )
    now = _now()
    key = ec.generate_private_key(ec.SECP256R1())
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    # Two authorities must not have one name, or clients that have both get confused.
    suffix = f" CA {identifier.digest[:4].hex()}"
    common_name = (name or socket.gethostname())[: _MAX_COMMON_NAME - len(suffix)] + suffix
    subject = _name(common_name)
    certificate = (
        _builder(subject, subject, key.public_key(), now, now + AUTHORITY_VALID)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier),
            critical=False,
        )
        .sign(key, hashes.SHA256())
    )
    _make_directory(directory)
    _write_key(key_file, key)
    _write_certificate(certificate_file, certificate)


def issue_server(directory: Path, names: Sequence[str], addresses: Sequence[Address]) -> None:
    """Makes `server.crt` for these DNS names and addresses, and `server.key` if it is not there.

    A `server.crt` of this authority is replaced, so this is how one is renewed. CertificateError
    when the authority is missing or unfit, or the certificate that is there is someone else's.
    """
    alternatives: list[x509.GeneralName] = []
    for name in dict.fromkeys(names):
        if not _DNS_NAME.fullmatch(name):
            raise CertificateError(f"{name!r} is no DNS name; write it in ASCII (xn--…)")
        alternatives.append(x509.DNSName(name.rstrip(".")))
    alternatives += [x509.IPAddress(address) for address in dict.fromkeys(addresses)]
    if not alternatives:
        raise CertificateError("a server's certificate needs a name or an address")
    first = names[0] if names else str(addresses[0])
    _issue(
        directory,
        directory / "server",
        first[:_MAX_COMMON_NAME],
        ExtendedKeyUsageOID.SERVER_AUTH,
        x509.SubjectAlternativeName(alternatives),
    )


def issue_client(directory: Path, name: str) -> None:
    """Makes `clients/NAME.crt`, whose common name is `name`, and its key if it is not there.

    CertificateError as for `issue_server`, and when `name` cannot be a file's name.
    """
    if not _FILE_NAME.fullmatch(name) or len(name) > _MAX_COMMON_NAME:
        raise CertificateError(
            f"{name!r} cannot name a client's certificate; use up to {_MAX_COMMON_NAME} letters, "
            "digits and _ . @ + -, and begin with a letter or digit"
        )
    path = directory / "clients" / name
    _make_directory(path.parent)
    _issue(directory, path, name, ExtendedKeyUsageOID.CLIENT_AUTH, None)


def write_readme(directory: Path) -> None:
    """Writes `README.md`: what each file is, who may have it, how clients get `ca.crt`."""
    _make_directory(directory)
    text = _README.format(days=CERTIFICATE_VALID.days)
    _write(directory / "README.md", text.encode(), 0o644)


def local_names() -> tuple[list[str], list[Address]]:
    """The names and addresses under which clients reach this computer, for `issue_server`.

    The names are the host's, the one that the resolver has for it (waiting at most 3 s), the
    multicast DNS name and `localhost`; the addresses those of all interfaces except link-local
    IPv6, which is of no use without the name of the client's interface.
    """
    hostname = socket.gethostname()
    short = hostname.partition(".")[0]
    names = [hostname, _full_name(hostname), f"{short}.local", "localhost"]
    names = [name.lower() for name in names if _DNS_NAME.fullmatch(name)]
    addresses: set[Address] = {IPv4Address("127.0.0.1"), IPv6Address("::1")}
    for entries in psutil.net_if_addrs().values():
        for entry in entries:
            if entry.family in (socket.AF_INET, socket.AF_INET6):
                address = ipaddress.ip_address(entry.address.partition("%")[0])
                if address.version == 4 or not address.is_link_local:
                    addresses.add(address)
    return list(dict.fromkeys(names)), sorted(addresses, key=lambda a: (a.version, a.packed))


def _full_name(hostname: str) -> str:
    """The fully qualified name; `hostname` when DNS does not answer soon, as in a field."""
    found = [hostname]
    # getfqdn() has no timeout of its own, and a daemon thread keeps nothing from ending.
    thread = threading.Thread(target=lambda: found.append(socket.getfqdn(hostname)), daemon=True)
    thread.start()
    thread.join(_RESOLVER_PATIENCE)
    return found[-1] if not found[-1].endswith(".arpa") else hostname


def _issue(
    directory: Path,
    path: Path,
    common_name: str,
    purpose: x509.ObjectIdentifier,
    alternatives: x509.SubjectAlternativeName | None,
) -> None:
    """Makes `path`.crt, and `path`.key unless it is there."""
    now = _now()
    certificate_file = path.with_name(f"{path.name}.crt")
    key_file = path.with_name(f"{path.name}.key")
    authority = _load_certificates(directory / "ca.crt")[0]
    authority_key = _load_key(directory / "ca.key")
    if authority.public_key() != authority_key.public_key():
        raise CertificateError(
            f"{directory / 'ca.key'} is not the key of {directory / 'ca.crt'}; put back the right "
            "one, or make a new authority in an empty directory"
        )
    _check_validity(directory / "ca.crt", authority, now)
    if certificate_file.exists():
        try:
            _load_certificates(certificate_file)[0].verify_directly_issued_by(authority)
        except (ValueError, TypeError, InvalidSignature):
            raise CertificateError(
                f"{certificate_file} is not of this appliance's authority; move it away first"
            ) from None
    key = _load_key(key_file) if key_file.exists() else ec.generate_private_key(ec.SECP256R1())
    if not isinstance(key, ec.EllipticCurvePrivateKey) or not isinstance(
        authority_key, ec.EllipticCurvePrivateKey
    ):
        raise CertificateError(f"{key_file} and ca.key must be elliptic curve keys, as made here")
    end = min(now + CERTIFICATE_VALID, authority.not_valid_after_utc)
    issuer = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    builder = (
        _builder(_name(common_name), authority.subject, key.public_key(), now, end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(issuer), critical=False
        )
    )
    if alternatives is not None:
        builder = builder.add_extension(alternatives, critical=False)
    certificate = builder.sign(authority_key, hashes.SHA256())
    if not key_file.exists():
        _write_key(key_file, key)
    _write_certificate(certificate_file, certificate)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    now: datetime,
    end: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _now() -> datetime:
    now = datetime.now(timezone.utc).replace(microsecond=0)
    if now < _NEVER_BEFORE:
        raise CertificateError(
            f"this computer's clock says {now:%Y-%m-%d}; set it first, or clients will find that "
            "the certificates are not valid"
        )
    return now


# Using certificates


def server_context(
    certificate: Path,
    key: Path,
    ca: Path | None = None,
    client_certificates: ClientCertificates = "none",
) -> ssl.SSLContext:
    """The TLS settings of a listener: TLS 1.2 and 1.3.

    With `client_certificates` "optional" a client that shows a certificate is refused unless `ca`
    issued it, with "required" also one that shows none. CertificateError says what is wrong with
    a file: missing, unreadable, expired, not a pair, a key that others can read.
    """
    now = datetime.now(timezone.utc)
    chain = _load_certificates(certificate)
    _check_validity(certificate, chain[0], now)
    if chain[0].public_key() != _load_key(key).public_key():
        raise CertificateError(f"{key} is not the key of {certificate}; put the pair together")
    end = chain[0].not_valid_after_utc
    if end - now < _EXPIRES_SOON:
        _log.warning("%s expires on %s; renew it", certificate, f"{end:%Y-%m-%d}")

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.set_ciphers(_TLS12_CIPHERS)
    context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_COMPRESSION
    try:
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        raise CertificateError(f"{certificate} cannot be used: {error.reason}") from error
    if client_certificates != "none":
        if ca is None:
            raise CertificateError("client certificates need the CA that issued them (tls.ca)")
        for authority in _load_certificates(ca):
            _check_validity(ca, authority, now)
        context.load_verify_locations(ca)
        required = client_certificates == "required"
        context.verify_mode = ssl.CERT_REQUIRED if required else ssl.CERT_OPTIONAL
    return context


def check_key_file(path: Path) -> None:
    """CertificateError when the private key at `path` is missing or others can read or write it."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise _unreadable(path, error) from error
    if mode & 0o077:
        raise CertificateError(
            f"{path} is a private key that others on this computer can use (mode "
            f"{mode & 0o777:04o}); close it with: chmod 600 {path}"
        )


def _load_certificates(path: Path) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(path.read_bytes())
    except OSError as error:
        raise _unreadable(path, error) from error
    except ValueError:
        raise CertificateError(f"{path} is not a certificate in PEM form") from None


def _load_key(path: Path) -> PrivateKeyTypes:
    check_key_file(path)
    try:
        return load_pem_private_key(path.read_bytes(), password=None)
    except OSError as error:
        raise _unreadable(path, error) from error
    except TypeError:
        raise CertificateError(
            f"{path} is encrypted, and nobody is there to type its password; take it off with: "
            f"openssl pkey -in {path} -out NEW"
        ) from None
    except (ValueError, UnsupportedAlgorithm):
        raise CertificateError(f"{path} is not a private key in PEM form") from None


def _check_validity(path: Path, certificate: x509.Certificate, now: datetime) -> None:
    start, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > end:
        raise CertificateError(f"{path} expired on {end:%Y-%m-%d}; renew it")
    if now < start:
        raise CertificateError(
            f"{path} is not valid before {start:%Y-%m-%d %H:%M} UTC; is the computer's clock right?"
        )


def _unreadable(path: Path, error: OSError) -> CertificateError:
    if isinstance(error, FileNotFoundError):
        return CertificateError(f"there is no file {path}; `appliance init` makes what is missing")
    return CertificateError(
        f"{path} cannot be read ({error.strerror}); give it to the user that runs the appliance"
    )


# Writing files


def _make_directory(directory: Path) -> None:
    """Open to others, who need `ca.crt`; the keys in it are not."""
    directory.mkdir(mode=0o755, parents=True, exist_ok=True)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    _write(path, pem, 0o600, replace=False)


def _write_certificate(path: Path, certificate: x509.Certificate) -> None:
    _write(path, certificate.public_bytes(Encoding.PEM), 0o644)


def _write(path: Path, data: bytes, mode: int, replace: bool = True) -> None:
    """Writes a file whole or not at all; without `replace` FileExistsError when it is there."""
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            os.fchmod(descriptor, mode)
            file.flush()
            os.fsync(descriptor)
        if replace:
            temporary.replace(path)
        else:
            os.link(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
