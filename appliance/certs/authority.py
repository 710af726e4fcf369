"""The appliance's own certificate authority (CA): issues, renews and revokes certificates.

Keys are on the curve P-256, which every TLS stack supports, including those of microcontrollers.
Certificates and revocation lists follow RFC 5280. An existing key is certified again and not
replaced, unless a certificate of it was revoked.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import re
import socket
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from appliance.certs import readme, registry
from appliance.certs.addresses import DNS_NAME, Address
from appliance.certs.constraints import constraints, misleading, outside
from appliance.certs.files import (
    CertificateError,
    issued_by,
    load_certificates,
    load_key,
    locked,
    make_directory,
    out_of_time,
    read,
    usable_time,
    write,
    write_certificate,
    write_key,
)
from appliance.certs.registry import Issued, Kind, fingerprint
from appliance.certs.requests import load_request
from appliance.certs.revocation import CRL_SIZE, parse_crls
from appliance.host.owners import acting_as_caller

log = logging.getLogger("appliance.certs")

AUTHORITY_VALID: Final = timedelta(days=3650)
# The longest validity that Apple's systems accept from a private CA. A shorter one would not be
# safer, because the CA's key is on the same computer, and would cut off a robot in the field.
CERTIFICATE_VALID: Final = timedelta(days=825)
# For clients whose clock is behind, or is set to local time as UTC.
_BACKDATED: Final = timedelta(days=1)

_MAX_COMMON_NAME: Final = 64  # RFC 5280, appendix A: ub-common-name
_FILE_NAME: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.@+-]*")
#: Names that are no client's for `renew`.
_RESERVED: Final = ("server", "all", "ca")
_SERIAL: Final = re.compile(r"(?:0x)?((?:[0-9A-Fa-f]{2}:?){8,20})")


def create_authority(
    directory: Path,
    name: str | None = None,
    names: Sequence[str] = (),
    addresses: Sequence[Address] = (),
) -> None:
    """Make `ca.crt` and `ca.key`. `name`, by default the host's, is shown to people.

    The CA may sign for private names and addresses, and for those given, see `constraints`.
    CertificateError when either file exists.
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
    # Clients confuse two CAs of the same name, so the name has a part of the key's identifier.
    suffix = f" CA {identifier.digest[:4].hex()}"
    common_name = (name or socket.gethostname())[: _MAX_COMMON_NAME - len(suffix)] + suffix
    subject = _name(common_name)
    certificate = (
        _builder(subject, subject, key.public_key(), now, now + AUTHORITY_VALID)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .add_extension(constraints(names, addresses), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier),
            critical=False,
        )
        .sign(key, hashes.SHA256())
    )
    make_directory(directory)
    write_key(key_file, key)
    write_certificate(certificate_file, certificate)


def issue_server(
    directory: Path,
    names: Sequence[str],
    addresses: Sequence[Address],
    ca_key: Path | None = None,
) -> None:
    """Make `server.crt` for these DNS names and addresses, and `server.key` if it does not exist.

    An existing `server.crt` of this CA is replaced, and so renewed. `ca_key` is the path of the
    CA's key, if that is not beside its certificate. CertificateError when the CA is missing or
    unusable, or the existing certificate is of another CA.
    """
    alternatives: list[x509.GeneralName] = []
    for name in dict.fromkeys(names):
        if not DNS_NAME.fullmatch(name):
            raise CertificateError(f"{name!r} is no DNS name; write it in ASCII (xn--…)")
        alternatives.append(x509.DNSName(name.rstrip(".")))
    alternatives += [x509.IPAddress(address) for address in dict.fromkeys(addresses)]
    if not alternatives:
        raise CertificateError("a server's certificate needs a name or an address")
    # An address as the common name would be taken for a DNS name.
    first = names[0] if names else "server"
    with _opened(directory, ca_key) as authority:
        refused = outside(authority.certificate, [*names, *addresses])
        if refused:
            raise CertificateError(may_not_sign(directory, refused))
        authority.certify(
            directory / "server",
            first[:_MAX_COMMON_NAME],
            "server",
            x509.SubjectAlternativeName(alternatives),
        )


def may_not_sign(directory: Path, subjects: Sequence[str]) -> str:
    """The error text for names and addresses outside of the CA's constraints."""
    return (
        f"{directory / 'ca.crt'} may sign for private names and addresses, and those that this "
        f"computer had when it was made; not for {', '.join(subjects)}. For these make a new "
        f"authority: move ca.crt, ca.key, server.crt and server.key away, `appliance init --name "
        f"{subjects[0]}`, and give the new ca.crt to all clients"
    )


def issue_client(directory: Path, name: str, ca_key: Path | None = None) -> None:
    """Make `clients/NAME.crt` with the common name `name`, and its key if that does not exist.

    After a revocation the key is a new one. CertificateError as for `issue_server`, and when `name`
    is no valid file name.
    """
    check_client_name(name)
    path = directory / "clients" / name
    with _opened(directory, ca_key) as authority:
        make_directory(path.parent)
        authority.certify(path, name, "client")


def sign(
    directory: Path, request: bytes, name: str | None = None, ca_key: Path | None = None
) -> Path:
    """Make `clients/NAME.crt` from a request (PKCS #10, PEM or DER) that was made with the key.

    The certificate has the request's key, and its common name unless `name` is given; everything
    else in the request is ignored. Returns the certificate's path. CertificateError when the
    request is malformed, its signature is wrong or its key unsuitable, or when there is a
    certificate of another key under this name.
    """
    wanted = load_request(request)
    name = wanted.name if name is None else name
    if not name:
        raise CertificateError("the request has no common name to name the client by; give a name")
    check_client_name(name)
    path = directory / "clients" / name
    with _opened(directory, ca_key) as authority:
        make_directory(path.parent)
        authority.certify(path, name, "client", key=wanted.key)
    return path.with_name(f"{name}.crt")


def check_new_client(directory: Path, name: str) -> None:
    """CertificateError when a client of this name cannot get its first certificate here and now:
    for its name, because it has one, or because the CA or its key cannot be used."""
    check_client_name(name)
    with _opened(directory, None) as authority:
        authority.check_subject(name)
        now = _now()
        if any(
            entry.name == name and entry.revoked is None and entry.expires > now
            for entry in authority.entries
        ):
            raise CertificateError(f"{name!r} has a certificate, of another key: revoke that first")
        authority.check_file(directory / "clients" / f"{name}.crt", None)


def renew(directory: Path, name: str, ca_key: Path | None = None) -> None:
    """Renew `server.crt` or `clients/NAME.crt`, with the same key and names.

    A revoked server certificate gets a new key. CertificateError when the certificate does not
    exist, is a client's that was revoked, or is of another CA.
    """
    if name == "server":
        path = directory / "server"
    else:
        check_client_name(name)
        path = directory / "clients" / name
    certificate_file = path.with_name(f"{path.name}.crt")
    if not certificate_file.exists():
        raise CertificateError(
            f"there is no {certificate_file} to be renewed; `appliance cert issue` makes one"
        )
    with _opened(directory, ca_key) as authority:
        before = load_certificates(certificate_file)[0]
        kind: Kind = "server" if name == "server" else "client"
        key: CertificatePublicKeyTypes | None = before.public_key()
        if name == "server" and authority.is_compromised(before.public_key()):
            key = None  # the key is here, so a new one is made
        authority.certify(path, common_name(before) or name, kind, _alternatives(before), key)


def revoke(directory: Path, what: str, ca_key: Path | None = None) -> list[Issued]:
    """Revoke by a name, a serial number or a certificate's file, and write `ca.crl`.

    A name stands for all certificates of the client that have not expired, because a renewed
    certificate stays valid. Returns those that were revoked now. CertificateError when none is.
    """
    with _opened(directory, ca_key) as authority:
        chosen = authority.find(what)
        fresh = [entry for entry in chosen if entry.revoked is None]
        if not fresh:
            raise CertificateError(f"{what} was revoked on {chosen[0].revoked:%Y-%m-%d} already")
        now = _now()
        revoked = [dataclasses.replace(entry, revoked=now) for entry in fresh]
        # The CRL first, because it takes effect; if the rest fails, the command can be repeated.
        authority.write_crl([*authority.entries, *revoked])
        serials = {entry.serial: entry for entry in revoked}
        known = [serials.pop(entry.serial, entry) for entry in authority.entries]
        authority.save([*known, *serials.values()])
        return revoked


def write_crl(directory: Path, ca_key: Path | None = None) -> int:
    """Write `ca.crl` anew, even if it is empty; returns how many certificates it revokes."""
    with _opened(directory, ca_key) as authority:
        return authority.write_crl(authority.entries)


def issued(directory: Path) -> list[Issued]:
    """All certificates of the present CA, the oldest first.

    Certificates from before there was a register are found by their files.
    """
    certificate = load_certificates(directory / "ca.crt")[0]
    return _entries(directory, certificate)


def write_readme(directory: Path) -> None:
    """Write `README.md`: what each file is, who may have it, how clients get `ca.crt`."""
    readme.write_readme(directory, CERTIFICATE_VALID)


def check_client_name(name: str) -> None:
    """CertificateError when a client's certificate cannot have this name."""
    if not _FILE_NAME.fullmatch(name) or len(name) > _MAX_COMMON_NAME:
        raise CertificateError(
            f"{name!r} cannot name a client's certificate; use up to {_MAX_COMMON_NAME} letters, "
            "digits and _ . @ + -, and begin with a letter or digit"
        )
    if name in _RESERVED:
        raise CertificateError(f"{name!r} cannot name a client's certificate: it means another one")


def common_name(certificate: x509.Certificate) -> str | None:
    """The one common name of the subject; None when there is none, or several."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if len(names) == 1 else None


@dataclass(frozen=True)
class _Authority:
    """The CA with its key, while the directory is locked."""

    directory: Path
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey
    entries: list[Issued]

    def certify(
        self,
        path: Path,
        common_name: str,
        kind: Kind,
        alternatives: x509.SubjectAlternativeName | None = None,
        key: CertificatePublicKeyTypes | None = None,
    ) -> None:
        """Make `path`.crt for this public key, or for that of `path`.key, made if needed."""
        certificate_file = path.with_name(f"{path.name}.crt")
        key_file = path.with_name(f"{path.name}.key")
        self.check_file(certificate_file, key)
        if kind == "client":
            self.check_subject(common_name)
        new: ec.EllipticCurvePrivateKey | None = None
        if key is None:
            own = self._own_key(key_file)
            if own is None:
                own = new = ec.generate_private_key(ec.SECP256R1())
            key = own.public_key()
        elif self.is_compromised(key):
            raise CertificateError(
                f"the key of {path.name!r} was revoked with its certificate; a new key is needed"
            )
        certificate = self._sign(key, common_name, kind, alternatives)
        if new is not None:
            write_key(key_file, new, replace=True)
        for suffix in (".p12", ".pem"):  # exports of the previous certificate
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        # The register first: a certificate that is not in it could not be revoked by its name.
        entry = registry.record(certificate, self.certificate, path.name, kind)
        self.save([*self.entries, entry])
        write_certificate(certificate_file, certificate)

    def check_subject(self, common_name: str) -> None:
        """CertificateError when a client's certificate may not be made out to it."""
        if misleading(self.certificate, common_name):
            raise CertificateError(
                f"{common_name!r} looks like a DNS name, for which this authority may not sign; "
                f"write {common_name.replace('.', '-')}"
            )

    def check_file(self, file: Path, key: CertificatePublicKeyTypes | None) -> None:
        """CertificateError when a certificate of this key may not take the place of what is there;
        None for the key of that."""
        if not file.exists():
            return
        before = load_certificates(file)[0]
        if not issued_by(before, self.certificate):
            raise CertificateError(
                f"{file} is not of this appliance's authority; move it away first"
            )
        is_over = before.not_valid_after_utc < _now()
        known = before.public_key()
        if not (key is None or key == known or is_over or self.is_compromised(known)):
            raise CertificateError(
                f"{file} is of another key; revoke it first, or give this client another name"
            )

    def _own_key(self, file: Path) -> ec.EllipticCurvePrivateKey | None:
        """The key of that file; None when a new one is needed."""
        if not file.exists():
            return None
        key = load_key(file)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise CertificateError(f"{file} must be an elliptic curve key, as made here")
        return None if self.is_compromised(key.public_key()) else key

    def is_compromised(self, key: CertificatePublicKeyTypes) -> bool:
        """Whether a certificate of this key was revoked: a thief of the device has the key."""
        revoked = {entry.key for entry in self.entries if entry.revoked is not None}
        return fingerprint(key) in revoked

    def _sign(
        self,
        key: CertificatePublicKeyTypes,
        common_name: str,
        kind: Kind,
        alternatives: x509.SubjectAlternativeName | None,
    ) -> x509.Certificate:
        now = _now()
        end = min(now - _BACKDATED + CERTIFICATE_VALID, self.certificate.not_valid_after_utc)
        purpose = {
            "server": ExtendedKeyUsageOID.SERVER_AUTH,
            "client": ExtendedKeyUsageOID.CLIENT_AUTH,
        }[kind]
        builder = (
            _builder(_name(common_name), self.certificate.subject, key, now, end)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
            .add_extension(self._key_identifier(), critical=False)
        )
        if alternatives is not None:
            builder = builder.add_extension(alternatives, critical=False)
        return builder.sign(self.key, hashes.SHA256())

    def _key_identifier(self) -> x509.AuthorityKeyIdentifier:
        extensions = self.certificate.extensions
        identifier = extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
        return x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier)

    def save(self, entries: Sequence[Issued]) -> None:
        """Write the register, and keep its entries of earlier CAs."""
        own = fingerprint(self.certificate.public_key())
        others = [entry for entry in registry.load(self.directory) if entry.authority != own]
        registry.save(self.directory, [*others, *entries])

    def write_crl(self, entries: Sequence[Issued]) -> int:
        """Write `ca.crl` with these entries and those of the existing list."""
        path = self.directory / "ca.crl"
        now = _now()
        number = int(now.timestamp())  # increases even if the file was lost
        dates: dict[int, datetime] = {}
        if path.exists():
            for before in parse_crls(path, read(path, CRL_SIZE), [self.certificate]):
                dates |= {item.serial_number: item.revocation_date_utc for item in before}
                for extension in before.extensions:
                    if isinstance(extension.value, x509.CRLNumber):
                        number = max(number, extension.value.crl_number + 1)
        dates |= {e.serial: e.revoked for e in entries if e.revoked and e.serial not in dates}
        builder = (
            x509.CertificateRevocationListBuilder()
            .issuer_name(self.certificate.subject)
            .last_update(now)
            # In the field nobody renews the list, and a revocation writes it anew in any case.
            .next_update(self.certificate.not_valid_after_utc)
            .add_extension(x509.CRLNumber(number), critical=False)
            .add_extension(self._key_identifier(), critical=False)
        )
        for serial, date in dates.items():
            builder = builder.add_revoked_certificate(
                x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(date).build()
            )
        crl = builder.sign(self.key, hashes.SHA256())
        write(path, crl.public_bytes(Encoding.PEM), 0o644)
        return len(dates)

    def find(self, what: str) -> list[Issued]:
        """The certificates that a name, a file or a serial number stands for, at least one."""
        now = _now()
        found = [e for e in self.entries if e.name == what and (e.expires > now or e.revoked)]
        if found:
            return found
        if Path(what).is_file():
            certificate = load_certificates(Path(what))[0]
            if not issued_by(certificate, self.certificate):
                raise CertificateError(f"{what} is not of this appliance's authority")
            name = common_name(certificate) or "unnamed"
            entry = registry.record(certificate, self.certificate, name, "client")
            return [e for e in self.entries if e.serial == entry.serial] or [entry]
        match = _SERIAL.fullmatch(what)
        serial = int(match[1].replace(":", ""), 16) if match else None
        found = [e for e in self.entries if e.serial == serial]
        if not found:
            known = {e.name for e in self.entries if e.expires > now and e.kind == "client"}
            raise CertificateError(
                f"there is no certificate {what!r}, neither by its name nor by its serial number, "
                f"and no such file; valid ones: {', '.join(sorted(known)) or 'none'}"
            )
        return found


@contextlib.contextmanager
def _opened(directory: Path, ca_key: Path | None) -> Iterator[_Authority]:
    """The CA with its key; the directory is locked meanwhile."""
    certificate_file = directory / "ca.crt"
    key_file = ca_key or directory / "ca.key"
    certificate = load_certificates(certificate_file)[0]
    with acting_as_caller() if ca_key is not None else contextlib.nullcontext():
        if not key_file.exists():
            raise CertificateError(
                f"there is no {key_file}: only with the authority's key are certificates made and "
                "revoked; put it back for as long, or say where it is (--ca-key FILE)"
            )
        key = load_key(key_file)
    if certificate.public_key() != key.public_key():
        raise CertificateError(
            f"{key_file} is not the key of {certificate_file}; put back the right one, or make a "
            "new authority in an empty directory"
        )
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise CertificateError(f"{key_file} must be an elliptic curve key, as made here")
    problem = out_of_time(certificate_file, certificate, _now())
    if problem:
        raise CertificateError(problem)
    # Whoever may read the directory could lock that, for as long as they like; not so the key. It
    # is locked also for a key that is stored elsewhere: the register is the same.
    own = directory / "ca.key"
    with locked(own if own.exists() else directory):
        yield _Authority(directory, certificate, key, _entries(directory, certificate))


def _entries(directory: Path, authority: x509.Certificate) -> list[Issued]:
    own = fingerprint(authority.public_key())
    entries = [entry for entry in registry.load(directory) if entry.authority == own]
    known = {entry.serial for entry in entries}
    for file in (directory / "server.crt", *sorted((directory / "clients").glob("*.crt"))):
        with contextlib.suppress(CertificateError):  # a file that is no certificate is not ours
            certificate = load_certificates(file)[0]
            if certificate.serial_number not in known and issued_by(certificate, authority):
                kind: Kind = "server" if file.parent == directory else "client"
                entries.append(registry.record(certificate, authority, file.stem, kind))
    return entries


def _alternatives(certificate: x509.Certificate) -> x509.SubjectAlternativeName | None:
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound:
        return None
    return found.value


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: CertificatePublicKeyTypes,
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
    """The time for new certificates; see `usable_time`."""
    now = usable_time().replace(microsecond=0)
    clock = datetime.now(timezone.utc)
    if clock < now:
        _warn_of_unset_clock(f"{clock:%Y-%m-%d}", f"{now:%Y-%m-%d}")
    return now


@functools.cache
def _warn_of_unset_clock(clock: str, now: str) -> None:
    log.warning(
        "this computer's clock says %s, which is before this program was made: certificates are "
        "made and checked as if it were %s",
        clock,
        now,
    )
