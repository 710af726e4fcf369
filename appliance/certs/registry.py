"""The register of issued certificates: `issued.jsonl`, one JSON object on each line.

It outlives the files of a client, so that the certificate of a lost device can be revoked by its
name. It also has the keys that must not be certified again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, Literal, get_args

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric.types import PublicKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from appliance.certs.files import CertificateError, read, write

Kind = Literal["client", "server"]

_FILE: Final = "issued.jsonl"
_SIZE: Final = 64 << 20  # some 200,000 certificates


@dataclass(frozen=True, slots=True)
class Issued:
    """One certificate; `key` and `authority` are fingerprints of public keys, see `fingerprint`."""

    serial: int
    name: str
    kind: Kind
    starts: datetime
    expires: datetime
    key: str
    authority: str
    revoked: datetime | None = None

    @property
    def serial_text(self) -> str:
        """The serial number as openssl prints it."""
        return serial_text(self.serial)


def serial_text(serial: int) -> str:
    """A serial number as openssl prints it."""
    digits = f"{serial:X}"
    return digits.zfill(len(digits) + len(digits) % 2)


def fingerprint(key: PublicKeyTypes) -> str:
    """SHA-256 over the SubjectPublicKeyInfo, in hexadecimal."""
    der = key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    return hashlib.sha256(der).hexdigest()


def record(
    certificate: x509.Certificate, authority: x509.Certificate, name: str, kind: Kind
) -> Issued:
    """The entry of a certificate."""
    return Issued(
        certificate.serial_number,
        name,
        kind,
        certificate.not_valid_before_utc,
        certificate.not_valid_after_utc,
        fingerprint(certificate.public_key()),
        fingerprint(authority.public_key()),
    )


def load(directory: Path) -> list[Issued]:
    """All entries, the oldest first; none when there is no such file yet.

    CertificateError names the line that is wrong.
    """
    path = directory / _FILE
    if not path.exists():
        return []
    return list(_decode(path, read(path, _SIZE)))


def save(directory: Path, entries: Sequence[Issued]) -> None:
    """Replace the file."""
    lines = (json.dumps(_encode(entry), ensure_ascii=False) for entry in entries)
    write(directory / _FILE, "".join(f"{line}\n" for line in lines).encode(), 0o644)


def _encode(entry: Issued) -> dict[str, str]:
    values = {field.name: getattr(entry, field.name) for field in dataclasses.fields(entry)}
    values |= {"serial": entry.serial_text}
    return {
        name: value.isoformat() if isinstance(value, datetime) else value
        for name, value in values.items()
        if value is not None
    }


def _decode(path: Path, data: bytes) -> Iterator[Issued]:
    for number, line in enumerate(data.splitlines(), 1):
        if not line.strip():
            continue
        try:
            yield _entry(json.loads(line))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            what = f"{type(error).__name__}: {error}"
            raise CertificateError(
                f"{path}:{number}: not an entry as this program writes it ({what}); mend the line "
                "from a copy, or take it out: that certificate is then not known by its name"
            ) from None


def _entry(values: dict[str, Any]) -> Issued:
    if values["kind"] not in get_args(Kind):
        raise ValueError(f"kind {values['kind']!r}")
    starts, expires = (datetime.fromisoformat(values[name]) for name in ("starts", "expires"))
    revoked = datetime.fromisoformat(values["revoked"]) if "revoked" in values else None
    if any(time is not None and time.tzinfo is None for time in (starts, expires, revoked)):
        raise ValueError("a time without its zone")
    texts = [values[name] for name in ("name", "key", "authority")]
    if not all(isinstance(text, str) for text in texts):
        raise ValueError("name, key and authority must be texts")
    name, key, authority = texts
    serial = int(values["serial"], 16)
    return Issued(serial, name, values["kind"], starts, expires, key, authority, revoked)
