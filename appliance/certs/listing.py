"""Lists of certificates and of their expiry, for people."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Final, Literal

from appliance.certs.authority import issued
from appliance.certs.contexts import EXPIRES_SOON, TlsFiles
from appliance.certs.files import CertificateError, load_certificates, read, usable_time
from appliance.certs.registry import Issued, serial_text
from appliance.certs.revocation import CRL_SIZE, load_revocations

State = Literal["valid", "replaced", "expired", "revoked"]

_RANK: Final = {"authority": 0, "server": 1, "client": 2}


@dataclass(frozen=True, slots=True)
class ListedCertificate:
    """One certificate; one that was replaced is valid too, but there is a newer one of its name.

    `file` is None when the certificate's file is not here, or has a newer certificate.
    """

    name: str
    purpose: Literal["authority", "server", "client"]
    state: State
    serial: int
    expires: datetime
    days: int
    revoked: datetime | None
    file: Path | None

    @property
    def usable(self) -> bool:
        """Whether it is valid, and the newest of its name."""
        return self.state == "valid"

    @property
    def ends_soon(self) -> bool:
        """Whether it expires within `EXPIRES_SOON`."""
        return self.usable and self.days < EXPIRES_SOON.days

    @property
    def serial_text(self) -> str:
        """The serial number as openssl prints it."""
        return serial_text(self.serial)

    def as_json(self) -> dict[str, object]:
        """The certificate as plain values for JSON."""
        return {
            "name": self.name,
            "for": self.purpose,
            "state": self.state,
            "serial": self.serial_text,
            "expires": self.expires.isoformat(),
            "days": self.days,
            "revoked": self.revoked and self.revoked.isoformat(),
            "file": self.file and str(self.file),
        }


@dataclass(frozen=True, slots=True)
class Expiry:
    """When something of the listeners' TLS expires; `days` is negative when it has."""

    what: Literal["server", "ca", "crl"]
    file: Path
    ends: datetime
    days: int

    @property
    def is_soon(self) -> bool:
        """Whether it expires within `EXPIRES_SOON`."""
        return self.days < EXPIRES_SOON.days


def expiries(files: TlsFiles) -> list[Expiry]:
    """When the server's certificate, the CA's and the revocation list expire, if they exist.

    CertificateError when one cannot be read.
    """
    now = usable_time()
    found: list[tuple[Literal["server", "ca", "crl"], Path, datetime]] = []
    chain = load_certificates(files.certificate)
    found.append(("server", files.certificate, min(each.not_valid_after_utc for each in chain)))
    if files.ca is not None and files.ca.exists():
        authorities = load_certificates(files.ca)
        found += (("ca", files.ca, each.not_valid_after_utc) for each in authorities)
        crl = files.revocations
        if crl is not None and crl.exists():
            revocations = load_revocations(crl, read(crl, CRL_SIZE), authorities)
            found += (("crl", crl, end) for _, end in revocations.ends)
    return [Expiry(what, file, end, (end - now).days) for what, file, end in found]


def list_certificates(directory: Path) -> list[ListedCertificate]:
    """The authority, the server's certificates and the clients', by name, the newest first."""
    now = datetime.now(timezone.utc)
    path = directory / "ca.crt"
    authority = load_certificates(path)[0]
    end = authority.not_valid_after_utc
    days, state = _left(end, now)
    found = [
        ListedCertificate("ca", "authority", state, authority.serial_number, end, days, None, path)
    ]
    seen: set[tuple[str, str]] = set()
    for entry in reversed(issued(directory)):
        days, state = _left(entry.expires, now)
        if entry.revoked is not None:
            state = "revoked"
        elif (entry.kind, entry.name) in seen and state == "valid":
            state = "replaced"
        seen.add((entry.kind, entry.name))
        file = _file_of(directory, entry)
        serial, end = entry.serial, entry.expires
        found.append(
            ListedCertificate(entry.name, entry.kind, state, serial, end, days, entry.revoked, file)
        )
    return sorted(found, key=lambda item: (_RANK[item.purpose], item.name))


def _left(end: datetime, now: datetime) -> tuple[int, State]:
    return max((end - now).days, 0), "valid" if now <= end else "expired"


def _file_of(directory: Path, entry: Issued) -> Path | None:
    path = directory / "server.crt"
    if entry.kind == "client":
        path = directory / "clients" / f"{entry.name}.crt"
    try:
        there = load_certificates(path)[0].serial_number == entry.serial
    except CertificateError:
        return None
    return path if there else None
