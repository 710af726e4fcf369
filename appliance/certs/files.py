"""Files of certificates and keys: read with a limit and checked, written whole or not at all."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

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

from appliance.host.clock import RELEASED

#: What the library raises for a malformed certificate, request or list, sometimes only when a part
#: of it is accessed.
MALFORMED: Final = (
    ValueError,
    TypeError,
    InvalidSignature,
    UnsupportedAlgorithm,
    x509.DuplicateExtension,
    x509.InvalidVersion,
    x509.UnsupportedGeneralNameType,
)

# A bundle of all authorities of the Web is a quarter of this.
CERTIFICATES_SIZE: Final = 1 << 20
KEY_SIZE: Final = 64 << 10


class CertificateError(ValueError):
    """Certificates or keys cannot be made or used; `problems` lists all reasons.

    Each says where, why and what to do.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems: Sequence[str] = problems


def read(path: Path, limit: int = CERTIFICATES_SIZE, *, private: bool = False) -> bytes:
    """The bytes of a file; CertificateError when it is missing, unreadable, or larger than `limit`.

    So it is when the file is to be `private`, and others can read or write it.
    """
    try:
        if not (path.is_file() or path.is_dir() or not path.exists()):  # a pipe would be waited for
            raise CertificateError(f"{path} is not a file")
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            if private and mode & 0o077:
                raise CertificateError(
                    f"{path} is a private key that others on this computer can use (mode "
                    f"{mode & 0o777:04o}); close it with: chmod 600 {path}"
                )
            data = file.read(limit + 1)
    except OSError as error:
        raise unreadable(path, error) from error
    if len(data) > limit:
        raise CertificateError(f"{path} is larger than {limit} bytes: that is something else")
    return data


def unreadable(path: Path, error: OSError) -> CertificateError:
    """The error for a file that cannot be read."""
    if isinstance(error, FileNotFoundError):
        return CertificateError(f"there is no file {path}; `appliance init` makes what is missing")
    return CertificateError(
        f"{path} cannot be read ({error.strerror}); give it to the user that runs the appliance"
    )


def load_certificates(path: Path) -> list[x509.Certificate]:
    """All certificates of a file in PEM form, one at least; CertificateError."""
    return parse_certificates(path, read(path))


def parse_certificates(path: Path, data: bytes) -> list[x509.Certificate]:
    """All certificates in `data`, which was read from `path`; see `load_certificates`."""
    try:
        certificates = x509.load_pem_x509_certificates(data)
        for certificate in certificates:
            _ = certificate.public_key(), certificate.subject, certificate.extensions
    except MALFORMED:
        raise CertificateError(f"{path} is not a certificate in PEM form") from None
    return certificates


def fingerprints(path: Path) -> list[str]:
    """SHA-256 of each certificate of a file, as browsers and OpenSSL write it."""
    found = load_certificates(path)
    return [each.fingerprint(hashes.SHA256()).hex(":").upper() for each in found]


def load_key(path: Path) -> PrivateKeyTypes:
    """The private key of a file in PEM form that only its owner can use; CertificateError."""
    data = read(path, KEY_SIZE, private=True)
    try:
        return load_pem_private_key(data, password=None)
    except TypeError:
        raise CertificateError(
            f"{path} is encrypted, and nobody is there to type its password; take it off with: "
            f"openssl pkey -in {path} -out NEW"
        ) from None
    except (ValueError, UnsupportedAlgorithm):
        raise CertificateError(f"{path} is not a private key in PEM form") from None


def issued_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Whether the authority signed the certificate with its own key."""
    try:
        certificate.verify_directly_issued_by(authority)
    except MALFORMED:
        return False
    return True


def usable_time() -> datetime:
    """Now, or the time of this program's release while the computer's clock says less.

    A computer without a battery for its clock starts in 1970, or at the time of its image, and
    would make certificates that have expired as soon as the clock is set.
    """
    return max(datetime.now(timezone.utc), RELEASED)


def out_of_time(path: Path, certificate: x509.Certificate, now: datetime) -> str:
    """Why the certificate is not valid at that time; empty when it is."""
    start, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > end:
        return f"{path} expired on {end:%Y-%m-%d}; renew it"
    if now < start:
        return (
            f"{path} is not valid before {start:%Y-%m-%d %H:%M} UTC; is the computer's clock right?"
        )
    return ""


def make_directory(directory: Path) -> None:
    """Make the directory readable by others, who need `ca.crt`; the keys in it are not."""
    if directory.is_dir():
        return
    directory.mkdir(mode=0o755, parents=True, exist_ok=True)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        _hand_over(descriptor)
    finally:
        os.close(descriptor)


def write_key(path: Path, key: ec.EllipticCurvePrivateKey, *, replace: bool = False) -> None:
    """Write a private key; without `replace` FileExistsError when there is one."""
    write(path, key_pem(key), 0o600, replace=replace)


def key_pem(key: PrivateKeyTypes) -> bytes:
    """The key in the form of its file."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def write_certificate(path: Path, certificate: x509.Certificate) -> None:
    """Write a certificate, replacing the one before."""
    write(path, certificate.public_bytes(Encoding.PEM), 0o644)


def write(path: Path, data: bytes, mode: int, *, replace: bool = True) -> None:
    """Write a file whole or not at all; without `replace` FileExistsError when it is there."""
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            os.fchmod(descriptor, mode)
            _hand_over(descriptor)
            file.flush()
            os.fsync(descriptor)
        if replace:
            temporary.replace(path)
        else:
            os.link(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync_directory(path.parent)


def _hand_over(descriptor: int) -> None:
    """Give what root makes to the folder's owner, so that the service can read it."""
    if os.geteuid() == 0:
        # The path may have become a link to elsewhere meanwhile, so ask the descriptor.
        with contextlib.suppress(FileNotFoundError):  # an image without /proc has no service yet
            folder = Path(f"/proc/self/fd/{descriptor}").readlink().parent.stat()
            os.fchown(descriptor, folder.st_uid, folder.st_gid)


def _sync_directory(directory: Path) -> None:
    """Make the new name of a file outlive a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock out other commands, and the appliance itself, that lock this file or directory."""
    try:
        descriptor = _open_to_lock(path)
    except OSError as error:
        raise unreadable(path, error) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _open_to_lock(path: Path) -> int:
    """Over NFS only what is open for writing can be locked; folders and read-only media cannot."""
    with contextlib.suppress(OSError):
        return os.open(path, os.O_RDWR)
    return os.open(path, os.O_RDONLY)
