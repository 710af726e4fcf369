"""The listeners' TLS contexts, made from files and replaced while the listeners are open."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import ssl
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Final, Literal

from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance.certs.chains import KNOWN, Chains, is_anchored
from appliance.certs.files import (
    CERTIFICATES_SIZE,
    MALFORMED,
    CertificateError,
    issued_by,
    load_key,
    out_of_time,
    parse_certificates,
    read,
    usable_time,
)
from appliance.certs.identity import UsernameFrom, username_of
from appliance.certs.registry import fingerprint, serial_text
from appliance.certs.revocation import CRL_SIZE, NOTHING_REVOKED, Revocations, load_revocations
from appliance.host.clock import RELEASED

log = logging.getLogger("appliance.certs")

ClientCertificates = Literal["off", "optional", "required"]
TlsVersion = Literal["1.2", "1.3"]

#: How long before its expiry a certificate is warned of, and one of ours is renewed.
EXPIRES_SOON: Final = timedelta(days=30)

# Ephemeral keys and authenticated encryption only. TLS 1.3 has nothing else.
_TLS12_CIPHERS: Final = "ECDHE+AESGCM:ECDHE+CHACHA20"
_LEAST_BITS: Final = 128
# OpenSSL's X509_V_FLAG_NO_CHECK_TIME, which Python has no name for.
_NO_CHECK_TIME: Final = 0x200000
_VERSIONS: Final = {"1.2": ssl.TLSVersion.TLSv1_2, "1.3": ssl.TLSVersion.TLSv1_3}


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """The paths in `broker.tls` of appliance.yaml.

    Without `crl` the revocation list is `ca.crl` beside `ca`, if that exists.
    """

    certificate: Path
    key: Path
    ca: Path | None = None
    crl: Path | None = None

    @property
    def revocations(self) -> Path | None:
        """The file of the revocation list, which may not exist."""
        return self.crl or (self.ca and self.ca.with_name("ca.crl"))


@dataclass(frozen=True, slots=True)
class TlsPolicy:
    """What one listener requires of a connection; `ciphers` are for TLS 1.2, as OpenSSL names them.

    With `client_certificates` "optional" a client that sends a certificate is refused unless the CA
    issued it; with "required" a client that sends none is refused as well.
    """

    client_certificates: ClientCertificates = "off"
    min_version: TlsVersion = "1.2"
    ciphers: str | None = None


@dataclass(frozen=True)
class LoadedTls:
    """Everything that was read from the files, after all of it was found to be valid."""

    files: TlsFiles
    policies: Mapping[str, TlsPolicy]
    username_from: UsernameFrom
    digest: bytes = field(repr=False)
    #: A hash of which clients' certificates are taken: whose, and without which.
    trust: bytes = field(repr=False)
    chain: list[x509.Certificate]
    authorities: list[x509.Certificate]
    revocations: Revocations
    contexts: Mapping[str, ssl.SSLContext]
    #: Contexts that do not check dates, for while the computer's clock is not set or a revocation
    #: list is outdated.
    undated: Mapping[str, ssl.SSLContext]
    #: Increases by one each time that the files are read anew.
    generation: int

    def warnings(self, now: datetime | None = None) -> list[str]:
        """What has expired or will soon, each with what to do."""
        return list(_warnings(self, now or datetime.now(timezone.utc)))

    @functools.cached_property
    def names(self) -> frozenset[str]:
        """The names in the server's certificate, in lower case."""
        try:
            found = self.chain[0].extensions.get_extension_for_class(x509.SubjectAlternativeName)
        except (x509.ExtensionNotFound, *MALFORMED):
            return frozenset()
        return frozenset(name.lower() for name in found.value.get_values_for_type(x509.DNSName))

    @functools.cached_property
    def authority(self) -> bytes:
        """What clients have to trust, see `TlsContexts.authority`; read when it is first wanted."""
        if self.files.ca is None:
            return b""
        try:
            known = parse_certificates(self.files.ca, read(self.files.ca, CERTIFICATES_SIZE))
        except CertificateError:
            return b""
        top = self.chain[-1]
        issuers = [each for each in known if each == top or issued_by(top, each)]
        return b"".join(each.public_bytes(Encoding.PEM) for each in issuers)

    def plausible(self, now: datetime) -> datetime:
        """The clock's time, or the earliest that it can be: this program was released and the
        server's certificate was made before."""
        return max(now, RELEASED, self.chain[0].not_valid_before_utc)

    def context(self, listener: str, now: datetime) -> ssl.SSLContext:
        """The context of a listener for a connection that begins at that time."""
        is_dated = self.plausible(now) == now
        if self.revocations.for_openssl:
            is_dated = is_dated and self.revocations.is_fresh(now)
        return (self.contexts if is_dated else self.undated)[listener]

    def objection(self, chain: list[x509.Certificate], now: datetime) -> str:
        """Why a client with that certificate chain is refused; empty when it is not."""
        client, *signers = chain
        who = f"its certificate {serial_text(client.serial_number)}"
        named = [(client, who), *((each, f"{who} is of {_name(each)}, which") for each in signers)]
        plausible = self.plausible(now)
        for certificate, what in named:
            date = self.revocations.date(certificate)
            start, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
            if date is not None:
                return f"{what} was revoked on {date:%Y-%m-%d}"
            if plausible > end:
                return f"{what} expired on {end:%Y-%m-%d}"
            if plausible == now < start:
                return f"{what} is not valid before {start:%Y-%m-%d %H:%M} UTC"
        if self.authorities and not is_anchored(chain, self.authorities):
            return f"{who} is of an authority that is trusted no longer"
        return ""


class TlsContexts:
    """The TLS contexts that are in force now, by the name of the listener.

    `prepare` may run in any thread, so that a long revocation list does not block the event loop;
    everything else runs on the event loop.
    """

    def __init__(
        self,
        files: TlsFiles,
        policies: Mapping[str, TlsPolicy],
        username_from: UsernameFrom = "none",
    ) -> None:
        """Read the files. CertificateError lists everything that is wrong with them.

        An expired certificate is used nevertheless, see `warnings`: a robot whose clock is not set
        yet, or whose certificate has expired, can still be reached by clients that do not check
        dates, and on its other listeners.
        """
        self._loaded = _load(files, policies, username_from, None)
        self._chains = Chains()
        #: Authorities that the log has warned of.
        self._logged: set[x509.Certificate] = set()

    def prepare(
        self,
        files: TlsFiles | None = None,
        policies: Mapping[str, TlsPolicy] | None = None,
        username_from: UsernameFrom | None = None,
    ) -> LoadedTls:
        """Read the files as they are now, for `take`, with the present settings unless given.

        CertificateError lists everything that is wrong, including a new server's certificate that
        is not valid now, and a revocation list that was deleted.
        """
        now = self._loaded
        username_from = username_from or now.username_from
        return _load(files or now.files, policies or now.policies, username_from, now)

    def take(self, loaded: LoadedTls) -> bool:
        """Use it for all new connections; returns whether it differs from what was in force.

        `refusal` decides on the open ones. CertificateError when others were taken since these were
        read, as these may lack revocations.
        """
        if loaded is self._loaded:
            return False
        if loaded.generation != self._loaded.generation + 1:
            raise CertificateError("certificates were replaced meanwhile; read them again")
        self._loaded = loaded
        self._logged.clear()
        return True

    def reload(self) -> bool:
        """Use the files as they are now, all of them or none; see `prepare` and `take`."""
        return self.take(self.prepare())

    def context(self, listener: str) -> ssl.SSLContext:
        """The context for a connection that begins now.

        While the computer's clock is not set, no client's certificate is refused for not being
        valid yet; `refusal` finds those that have expired.
        """
        return self._loaded.context(listener, datetime.now(timezone.utc))

    def source(self, listener: str) -> functools.partial[ssl.SSLContext]:
        """A function that returns the `context` of this listener, for each connection."""
        return functools.partial(self.context, listener)

    def refusal(self, tls: ssl.SSLObject) -> str:
        """Why the client is refused with its certificate; empty when it is not.

        To be called at each login, because OpenSSL verifies nothing in a resumed session, and again
        while the client is connected.
        """
        der = tls.getpeercert(binary_form=True)
        if not der:
            return ""
        loaded = self._loaded
        try:
            certificate = x509.load_der_x509_certificate(der)
            chain = self._chains.of(tls, certificate, loaded.authorities)
            reason = loaded.objection(chain, datetime.now(timezone.utc))
        except MALFORMED as error:
            return f"its certificate cannot be read: {error}"
        if not reason and loaded.revocations.dates:
            self._warn_of_unlisted(chain[1:])
        return reason

    def _warn_of_unlisted(self, signers: list[x509.Certificate]) -> None:
        """Warn once of each intermediate CA that a client has sent and that has no list."""
        loaded = self._loaded
        for signer in signers:
            if signer in self._logged or signer in loaded.authorities:
                continue
            self._logged.add(signer)
            if len(self._logged) <= KNOWN and not loaded.revocations.lists(signer):
                log.warning(
                    "a client's certificate is of %s, and there is no revocation list of it: whom "
                    "it revoked is not known; put its certificate into %s and its list into %s",
                    _name(signer),
                    loaded.files.ca,
                    loaded.files.revocations,
                )

    def username(self, tls: ssl.SSLObject) -> str | None:
        """The user that the client's certificate names; None when certificates name no users.

        Raises:
            ValueError: it names none.
        """
        source = self._loaded.username_from
        if source == "none":
            return None
        der = tls.getpeercert(binary_form=True)
        if not der:
            return None
        try:
            return username_of(x509.load_der_x509_certificate(der), source)
        except MALFORMED as error:
            raise ValueError(str(error)) from None

    def warnings(self, now: datetime | None = None) -> list[str]:
        """What has expired or will soon, each with what to do."""
        return self._loaded.warnings(now)

    @property
    def trust(self) -> bytes:
        """See `LoadedTls.trust`."""
        return self._loaded.trust

    @property
    def files(self) -> TlsFiles:
        """The files that are in force."""
        return self._loaded.files

    @property
    def names(self) -> frozenset[str]:
        """The names in the server's certificate, in lower case; `*.` stands for one label."""
        return self._loaded.names

    def authority(self) -> bytes:
        """Those certificates in `ca` that issued the server's, as PEM; empty when none did."""
        return self._loaded.authority


def server_context(
    certificate: Path,
    key: Path,
    ca: Path | None = None,
    client_certificates: ClientCertificates = "off",
) -> ssl.SSLContext:
    """The TLS context of one listener; CertificateError also when a certificate has expired."""
    loaded = load_tls(TlsFiles(certificate, key, ca), {"listener": TlsPolicy(client_certificates)})
    return loaded.contexts["listener"]


def load_tls(files: TlsFiles, policies: Mapping[str, TlsPolicy]) -> LoadedTls:
    """Read and check everything, including dates; CertificateError lists all that is wrong."""
    loaded = _load(files, policies, "none", None)
    problems = list(_out_of_time(loaded, usable_time()))
    if problems:
        raise CertificateError(*problems)
    return loaded


def _load(
    files: TlsFiles,
    policies: Mapping[str, TlsPolicy],
    username_from: UsernameFrom,
    before: LoadedTls | None,
) -> LoadedTls:
    """What is in the files; `before` itself when that has not changed."""
    problems: list[str] = []
    hashed, trusted = hashlib.sha256(), hashlib.sha256()
    chain: list[x509.Certificate] = []
    authorities: list[x509.Certificate] = []
    revocations = NOTHING_REVOKED
    with _collected(problems):
        chain = _server_chain(files, hashed)
    with _collected(problems):
        if any(policy.client_certificates != "off" for policy in policies.values()):
            authorities = _client_authorities(files, trusted)
            revocations = _revocations(files, authorities, trusted, before)
    hashed.update(trusted.digest())
    digest = hashed.digest()
    if before is not None and not problems:
        wanted = (files, policies, username_from, digest)
        if wanted == (before.files, before.policies, before.username_from, before.digest):
            return before
        if chain[0] != before.chain[0]:
            problem = out_of_time(files.certificate, chain[0], usable_time())
            problems += [problem] if problem else []
    made: dict[TlsPolicy, tuple[ssl.SSLContext, ssl.SSLContext]] = {}
    readable = not problems
    for name, policy in policies.items():
        with _collected(problems, f"{name}: "):
            if policy not in made:
                made[policy] = dated, undated = _context(policy), _context(policy)
                undated.verify_flags = ssl.VerifyFlags(undated.verify_flags | _NO_CHECK_TIME)
                for context in (dated, undated) if readable else ():
                    _add_certificates(context, files, policy, authorities)
                    if policy.client_certificates != "off" and revocations.for_openssl:
                        _load_lists(context, revocations.for_openssl)
    if problems:
        raise CertificateError(*problems)
    contexts = {name: made[policy][0] for name, policy in policies.items()}
    undated_contexts = {name: made[policy][1] for name, policy in policies.items()}
    generation = 0 if before is None else before.generation + 1
    return LoadedTls(
        files,
        policies,
        username_from,
        digest,
        trusted.digest(),
        chain,
        authorities,
        revocations,
        contexts,
        undated_contexts,
        generation,
    )


@contextlib.contextmanager
def _collected(problems: list[str], prefix: str = "") -> Iterator[None]:
    try:
        yield
    except CertificateError as error:
        problems += (prefix + problem for problem in error.problems)


def _read(path: Path, limit: int, hashed: hashlib._Hash) -> bytes:
    data = read(path, limit)
    hashed.update(len(data).to_bytes(8, "big") + data)
    return data


def _server_chain(files: TlsFiles, hashed: hashlib._Hash) -> list[x509.Certificate]:
    data = _read(files.certificate, CERTIFICATES_SIZE, hashed)
    chain = parse_certificates(files.certificate, data)
    key = load_key(files.key)
    hashed.update(fingerprint(key.public_key()).encode())
    if chain[0].public_key() != key.public_key():
        raise CertificateError(
            f"{files.key} is not the key of {files.certificate}; put the pair together"
        )
    return chain


def _client_authorities(files: TlsFiles, hashed: hashlib._Hash) -> list[x509.Certificate]:
    if files.ca is None:
        raise CertificateError("client certificates need the CA that issued them (broker.tls.ca)")
    return parse_certificates(files.ca, _read(files.ca, CERTIFICATES_SIZE, hashed))


def _revocations(
    files: TlsFiles,
    authorities: list[x509.Certificate],
    hashed: hashlib._Hash,
    before: LoadedTls | None,
) -> Revocations:
    path = files.revocations
    if path is not None and path.exists():
        return load_revocations(path, _read(path, CRL_SIZE, hashed), authorities)
    if before is not None and before.files == files and before.revocations:
        raise CertificateError(
            f"{path} is gone, by which {len(before.revocations)} certificates were revoked; "
            "put it back (`appliance cert crl` makes ours anew), or start the appliance anew"
        )
    return NOTHING_REVOKED


def _context(policy: TlsPolicy) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = _VERSIONS[policy.min_version]
    context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_COMPRESSION
    _set_ciphers(context, policy.ciphers)
    return context


def _add_certificates(
    context: ssl.SSLContext,
    files: TlsFiles,
    policy: TlsPolicy,
    authorities: list[x509.Certificate],
) -> None:
    try:
        context.load_cert_chain(files.certificate, files.key)
    except ssl.SSLError as error:
        raise CertificateError(f"{files.certificate} cannot be used: {error.reason}") from error
    if policy.client_certificates != "off":
        # A company's CA for clients is often an intermediate one.
        context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
        pem = b"".join(authority.public_bytes(Encoding.PEM) for authority in authorities)
        context.load_verify_locations(cadata=pem.decode())
        required = policy.client_certificates == "required"
        context.verify_mode = ssl.CERT_REQUIRED if required else ssl.CERT_OPTIONAL


def _load_lists(context: ssl.SSLContext, lists: bytes) -> None:
    """Let OpenSSL refuse revoked clients with the alert that says so (RFC 8446, section 6.2)."""
    with tempfile.NamedTemporaryFile() as file:  # Python loads lists from files only
        file.write(lists)
        file.flush()
        context.load_verify_locations(cafile=file.name)
    context.verify_flags |= ssl.VERIFY_CRL_CHECK_LEAF


def _name(certificate: x509.Certificate) -> str:
    return certificate.subject.rfc4514_string()


def _set_ciphers(context: ssl.SSLContext, wanted: str | None) -> None:
    try:
        context.set_ciphers(wanted or _TLS12_CIPHERS)
    except ssl.SSLError:
        raise CertificateError(
            f"ciphers: OpenSSL knows none of {wanted!r}; `openssl ciphers -v` shows those there are"
        ) from None
    for cipher in context.get_ciphers():
        if cipher["strength_bits"] < _LEAST_BITS or cipher["auth"] == "auth-null":
            raise CertificateError(f"ciphers: {cipher['name']} is not safe; take it out")


def _out_of_time(loaded: LoadedTls, now: datetime) -> Iterator[str]:
    certificates = [(loaded.files.certificate, loaded.chain[0])]
    if loaded.files.ca is not None:
        certificates += [(loaded.files.ca, authority) for authority in loaded.authorities]
    for path, certificate in certificates:
        problem = out_of_time(path, certificate, now)
        if problem:
            yield problem


def _warnings(loaded: LoadedTls, now: datetime) -> Iterator[str]:
    yield from _out_of_time(loaded, now)
    files = loaded.files
    end = min(certificate.not_valid_after_utc for certificate in loaded.chain)
    if now <= end < now + EXPIRES_SOON:
        yield f"{files.certificate} expires on {end:%Y-%m-%d}; renew it"
    date = loaded.revocations.date(loaded.chain[0])
    if date is not None:
        yield (
            f"{files.certificate} was revoked on {date:%Y-%m-%d}: clients that look at the list "
            "refuse it; `appliance cert renew server` makes one with a new key"
        )
    for authority in loaded.authorities:
        end = authority.not_valid_after_utc
        if now <= end < now + EXPIRES_SOON:
            yield f"{files.ca} expires on {end:%Y-%m-%d}, and all client certificates with it"
        date = loaded.revocations.date(authority)
        if date is not None:
            yield (
                f"{_name(authority)} was revoked on {date:%Y-%m-%d}, and its clients are refused; "
                f"take it out of {files.ca}"
            )
        elif loaded.revocations.dates and not loaded.revocations.lists(authority):
            yield (
                f"{files.revocations} has no list of {_name(authority)}: whom it revoked is not "
                "known; put its list there"
            )
    for who, end in loaded.revocations.ends:
        if end < now:
            yield (
                f"{files.revocations} of {who} should have been replaced by {end:%Y-%m-%d}: what "
                "it revokes stays revoked, what was revoked later is not known"
            )
    if loaded.authorities and files.crl is not None and not files.crl.exists():
        yield f"there is no file {files.crl} (broker.tls.crl): no client certificate is revoked"
