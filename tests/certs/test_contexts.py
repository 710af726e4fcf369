"""TLS made of files, ours and a company's, and replaced while it is used."""

from __future__ import annotations

import base64
import contextlib
import random
import ssl
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from authorities import NOW, Company
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from appliance import certs
from appliance.certs import CertificateError, TlsContexts, TlsFiles, TlsPolicy

ASKING = {"here": TlsPolicy("optional")}


def files_of(directory: Path, crl: Path | None = None) -> TlsFiles:
    return TlsFiles(directory / "server.crt", directory / "server.key", directory / "ca.crt", crl)


def shake_hands(
    contexts: TlsContexts, client: ssl.SSLContext, session: ssl.SSLSession | None = None
) -> tuple[ssl.SSLObject, ssl.SSLObject]:
    """Both ends of a connection, the server's first; ssl.SSLError is what either objects to."""
    there, here = ssl.MemoryBIO(), ssl.MemoryBIO()
    server = contexts.context("here").wrap_bio(there, here, server_side=True)
    user = client.wrap_bio(here, there, server_hostname="localhost", session=session)
    for _ in range(4):
        for end in (user, server):
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    server.write(b"x")
    assert user.read(1) == b"x"  # with TLS 1.3 the session's ticket comes with it
    return server, user


def client_of(ca: bytes, path: Path | None = None) -> ssl.SSLContext:
    context = ssl.create_default_context(cadata=ca.decode())
    if path is not None:
        context.load_cert_chain(
            path.with_name(f"{path.name}.crt"), path.with_name(f"{path.name}.key")
        )
    return context


def refusal_of(contexts: TlsContexts, client: ssl.SSLContext) -> str:
    """Why it does not come in, by what OpenSSL says or by what we say; empty when it does."""
    try:
        return contexts.refusal(shake_hands(contexts, client)[0])
    except ssl.SSLCertVerificationError as error:
        return f"its certificate was revoked: {error}" if "revoked" in str(error) else str(error)


@pytest.fixture
def contexts(own: Path) -> TlsContexts:
    return TlsContexts(files_of(own), ASKING)


@pytest.fixture
def tablet(own: Path) -> ssl.SSLContext:
    return client_of((own / "ca.crt").read_bytes(), own / "clients/tablet")


# Revocation


def test_revoked_after_a_reload(own: Path, contexts: TlsContexts, tablet: ssl.SSLContext) -> None:
    server, _ = shake_hands(contexts, tablet)
    assert contexts.refusal(server) == ""
    [entry] = certs.revoke(own, "tablet")
    assert contexts.refusal(server) == ""
    assert contexts.reload()
    assert f"{entry.serial_text} was revoked on " in contexts.refusal(server)
    assert "was revoked" in refusal_of(contexts, tablet)
    certs.issue_client(own, "other")
    other = client_of((own / "ca.crt").read_bytes(), own / "clients/other")
    assert refusal_of(contexts, other) == ""
    nobody = client_of((own / "ca.crt").read_bytes())
    assert refusal_of(contexts, nobody) == ""


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_session_that_is_resumed_is_looked_at_too(
    own: Path, contexts: TlsContexts, tablet: ssl.SSLContext, version: ssl.TLSVersion
) -> None:
    tablet.maximum_version = tablet.minimum_version = version
    _, user = shake_hands(contexts, tablet)
    server, again = shake_hands(contexts, tablet, user.session)
    assert again.session_reused and contexts.refusal(server) == ""
    certs.revoke(own, "tablet")
    contexts.reload()
    assert "was revoked" in contexts.refusal(server)
    with pytest.raises(ssl.SSLError, match="certificate revoked"):
        shake_hands(contexts, tablet, user.session)


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_certificate_that_has_run_out_is_no_login_by_a_resumed_session(
    own: Path, version: ssl.TLSVersion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each resumption brings a new ticket, so it would go on for ever."""
    company = Company()
    company.issue(own / "short", "short", days=5)
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(ca + company.pem())
    contexts = TlsContexts(files_of(own), ASKING)
    short = client_of(ca, own / "short")
    short.maximum_version = short.minimum_version = version
    first, user = shake_hands(contexts, short)
    for _ in range(3):
        server, user = shake_hands(contexts, short, user.session)
        assert user.session_reused and contexts.refusal(server) == ""
    clock_at(monkeypatch, NOW + timedelta(days=6))
    assert "expired on " in contexts.refusal(first)  # who is connected goes, too
    server, user = shake_hands(contexts, short, user.session)
    assert user.session_reused and "expired on " in contexts.refusal(server)


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
@pytest.mark.parametrize("is_known", [False, True], ids=["sent", "in-our-file"])
def test_an_authority_below_the_root_is_revoked(
    own: Path, version: ssl.TLSVersion, is_known: bool
) -> None:
    """Whether the client sends its certificate, or it stands in broker.tls.ca itself."""
    root = Company()
    issuing, other = root.below(), Company("ACME Other", issuer=root)
    issuing.issue(own / "lost", "lost", chain=True)
    other.issue(own / "kept", "kept", chain=True)
    ca = (own / "ca.crt").read_bytes()
    known = issuing.pem() + other.pem() if is_known else b""
    (own / "ca.crt").write_bytes(ca + root.pem() + known)
    contexts = TlsContexts(files_of(own), ASKING)
    lost, kept = client_of(ca, own / "lost"), client_of(ca, own / "kept")
    lost.maximum_version = lost.minimum_version = version
    first, user = shake_hands(contexts, lost)
    server, user = shake_hands(contexts, lost, user.session)
    assert user.session_reused
    assert contexts.refusal(first) == contexts.refusal(server) == refusal_of(contexts, kept) == ""
    (own / "ca.crl").write_bytes(root.crl(issuing.certificate))
    contexts.reload()
    why = " is of CN=ACME Issuing CA, which was revoked on "
    assert why in contexts.refusal(first) and why in contexts.refusal(server)
    assert why in refusal_of(contexts, lost)
    assert refusal_of(contexts, kept) == ""
    revoked = [text for text in contexts.warnings() if "CN=ACME Issuing CA was revoked on" in text]
    assert len(revoked) == is_known, contexts.warnings()


def test_authorities_without_a_list_are_told(own: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = Company()
    issuing = root.below()
    lost = issuing.issue(own / "lost", "lost", chain=True)
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(root.pem() + issuing.pem())
    (own / "ca.crl").write_bytes(root.crl())
    contexts = TlsContexts(files_of(own), ASKING)
    [warning] = contexts.warnings()
    assert "has no list of CN=ACME Issuing CA" in warning
    (own / "ca.crl").write_bytes(root.crl() + issuing.crl(lost))
    contexts.reload()
    assert contexts.warnings() == []
    assert "was revoked on " in refusal_of(contexts, client_of(ca, own / "lost"))
    # Nor are those that only the clients know.
    company = Company("Other")
    company.below().issue(own / "far", "far", chain=True)
    (own / "ca.crt").write_bytes(company.pem())
    (own / "ca.crl").write_bytes(company.crl())
    contexts.reload()
    for _ in range(3):
        assert refusal_of(contexts, client_of(ca, own / "far")) == ""
    told = [r.getMessage() for r in caplog.records if "CN=Other Issuing CA" in r.getMessage()]
    assert len(told) == 1 and "no revocation list of it" in told[0]


def test_who_is_revoked_is_told_so_in_tls(
    own: Path, contexts: TlsContexts, tablet: ssl.SSLContext
) -> None:
    """Alert 44, and 45 when it has run out (RFC 8446, section 6.2), as far as OpenSSL looks."""
    certs.revoke(own, "tablet")
    contexts.reload()
    with pytest.raises(ssl.SSLError, match="certificate revoked"):
        shake_hands(contexts, tablet)
    certs.issue_client(own, "other")
    assert (
        refusal_of(contexts, client_of((own / "ca.crt").read_bytes(), own / "clients/other")) == ""
    )


def test_a_list_outside_its_time_is_for_us_to_read(
    own: Path, contexts: TlsContexts, tablet: ssl.SSLContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For OpenSSL it would lock everybody out."""
    certs.issue_client(own, "other")
    with pytest.MonkeyPatch.context() as patch:
        clock_at(patch, NOW + timedelta(days=2))
        certs.revoke(own, "tablet")
    contexts.reload()
    other = client_of((own / "ca.crt").read_bytes(), own / "clients/other")
    assert refusal_of(contexts, other) == ""
    with pytest.raises(ssl.SSLError, match="certificate revoked"):
        shake_hands(contexts, tablet)


def test_a_list_that_is_outdated_locks_nobody_out_and_nobody_in(own: Path) -> None:
    company = Company()
    lost = company.issue(own / "lost", "lost")
    company.issue(own / "kept", "kept")
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(ca + company.pem())
    crl = own / "company.crl"
    crl.write_bytes(company.crl(lost, days=-1))
    contexts = TlsContexts(files_of(own, crl), ASKING)
    assert "was revoked" in refusal_of(contexts, client_of(ca, own / "lost"))
    assert refusal_of(contexts, client_of(ca, own / "kept")) == ""
    # The other authority has no list, and its clients come in as well.
    assert refusal_of(contexts, client_of(ca, own / "clients/tablet")) == ""
    missing, warning = contexts.warnings()
    assert "company.crl has no list of CN=r2d2 CA" in missing
    assert "company.crl of CN=ACME CA should have been replaced by " in warning


def test_lists_of_several_authorities_in_one_file_or_in_der(own: Path) -> None:
    companies = [Company("A"), Company("B")]
    lost = [company.issue(own / company.name, company.name) for company in companies]
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(ca + b"".join(company.pem() for company in companies))
    crl = own / "all.crl"
    crl.write_bytes(companies[0].crl(lost[0]) + companies[1].crl(lost[1]))
    contexts = TlsContexts(files_of(own, crl), ASKING)
    for name in ("A", "B"):
        assert "was revoked" in refusal_of(contexts, client_of(ca, own / name))
    der = x509.load_pem_x509_crl(companies[1].crl(lost[1])).public_bytes(Encoding.DER)
    crl.write_bytes(der)
    contexts.reload()
    assert "was revoked" in refusal_of(contexts, client_of(ca, own / "B"))
    assert refusal_of(contexts, client_of(ca, own / "A")) == ""


def test_a_list_that_is_not_there(own: Path) -> None:
    contexts = TlsContexts(files_of(own, own / "missing.crl"), ASKING)
    [warning] = contexts.warnings()
    assert "there is no file" in warning and "no client certificate is revoked" in warning
    assert TlsContexts(files_of(own), ASKING).warnings() == []


def test_a_list_that_vanishes_stays_in_force(
    own: Path, contexts: TlsContexts, tablet: ssl.SSLContext
) -> None:
    certs.revoke(own, "tablet")
    contexts.reload()
    (own / "ca.crl").unlink()
    with pytest.raises(CertificateError, match=r"ca\.crl is gone, by which 1 certificates"):
        contexts.reload()
    assert "was revoked" in refusal_of(contexts, tablet)
    assert certs.write_crl(own) == 1
    contexts.reload()
    assert "was revoked" in refusal_of(contexts, tablet)


# A company's certificates


def test_a_chain_and_a_client_authority_below_a_root(own: Path) -> None:
    root = Company()
    issuing = root.below()
    names: list[x509.GeneralName] = [x509.DNSName("localhost")]
    issuing.issue(own / "server", "robot", server=True, alternatives=names, chain=True)
    issuing.issue(own / "phone", "phone")
    (own / "ca.crt").write_bytes(issuing.pem())  # of clients, and not the root
    contexts = TlsContexts(files_of(own), {"here": TlsPolicy("required")})
    server, _ = shake_hands(contexts, client_of(root.pem(), own / "phone"))
    assert server.getpeercert() and contexts.refusal(server) == ""
    with pytest.raises(ssl.SSLError):
        shake_hands(contexts, client_of(root.pem()))


def test_another_authority_takes_over(
    own: Path, contexts: TlsContexts, tablet: ssl.SSLContext
) -> None:
    """Of the clients that are connected, those stay whose authority does."""
    ca = (own / "ca.crt").read_bytes()
    company = Company()
    issuing = company.below()
    issuing.issue(own / "between", "between", chain=True)
    company.issue(own / "direct", "direct")
    (own / "ca.crt").write_bytes(ca + company.pem())
    contexts.reload()
    direct, _ = shake_hands(contexts, client_of(ca, own / "direct"))
    between, _ = shake_hands(contexts, client_of(ca, own / "between"))
    ours, _ = shake_hands(contexts, tablet)
    nobody, _ = shake_hands(contexts, client_of(ca))
    assert [contexts.refusal(end) for end in (direct, between, ours, nobody)] == [""] * 4
    (own / "ca.crt").write_bytes(company.pem())
    contexts.reload()
    assert contexts.refusal(direct) == contexts.refusal(nobody) == ""
    assert "an authority that is trusted no longer" in contexts.refusal(ours)
    with pytest.raises(ssl.SSLError):
        shake_hands(contexts, tablet)


# All or nothing


def harm_certificate(directory: Path) -> None:
    (directory / "server.crt").write_bytes(b"")


def harm_key(directory: Path) -> None:
    (directory / "server.key").chmod(0o644)


def harm_authority(directory: Path) -> None:
    (directory / "ca.crt").write_bytes(b"-----BEGIN CERTIFICATE-----\n!\n")


def harm_list(directory: Path) -> None:
    (directory / "ca.crl").write_bytes(b"x" * 100)


def huge_list(directory: Path) -> None:
    with (directory / "ca.crl").open("wb") as file:
        file.truncate(17 << 20)


def foreign_list(directory: Path) -> None:
    (directory / "ca.crl").write_bytes(Company().crl())


def forged_list(directory: Path) -> None:
    subject = x509.load_pem_x509_certificate((directory / "ca.crt").read_bytes())
    forger = Company()
    forger.certificate = subject
    (directory / "ca.crl").write_bytes(forger.crl())


def expired(directory: Path) -> None:
    names: list[x509.GeneralName] = [x509.DNSName("localhost")]
    Company().issue(directory / "server", "old", server=True, alternatives=names, days=-1)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (harm_certificate, r"server\.crt is not a certificate in PEM form"),
        (harm_key, r"server\.key is a private key that others .*chmod 600"),
        (harm_authority, r"ca\.crt is not a certificate"),
        (harm_list, r"ca\.crl is not a certificate revocation list"),
        (huge_list, r"ca\.crl is larger than"),
        (foreign_list, r"ca\.crl is of CN=ACME CA, whose certificate is not in broker\.tls\.ca"),
        (forged_list, r"ca\.crl is not signed by CN=r2d2 CA"),
        (expired, r"server\.crt expired on .*; renew it"),
    ],
)
def test_a_reload_is_all_or_nothing(
    own: Path,
    contexts: TlsContexts,
    tablet: ssl.SSLContext,
    harm: Callable[[Path], None],
    message: str,
) -> None:
    before = contexts.context("here")
    certs.issue_server(own, ["localhost", "new.local"], [])
    harm(own)
    with pytest.raises(CertificateError, match=message):
        contexts.reload()
    assert contexts.context("here") is before
    assert refusal_of(contexts, tablet) == ""


def test_everything_that_is_wrong_is_told_at_once(own: Path, contexts: TlsContexts) -> None:
    harm_key(own)
    harm_list(own)
    policies = {"one": TlsPolicy("optional", ciphers="FOO"), "two": TlsPolicy(ciphers="NULL")}
    with pytest.raises(CertificateError) as refused:
        contexts.prepare(policies=policies)
    key, crl, one, two = refused.value.problems
    assert "server.key" in key and "ca.crl" in crl
    assert one.startswith("one: ciphers: OpenSSL knows none of 'FOO'")
    assert two.startswith("two: ciphers: ") and "is not safe" in two


def test_what_did_not_change_is_not_replaced(own: Path, contexts: TlsContexts) -> None:
    """So that clients can go on to resume their sessions."""
    before = contexts.context("here")
    assert not contexts.reload() and contexts.context("here") is before
    certs.issue_server(own, ["localhost"], [])
    assert contexts.reload() and contexts.context("here") is not before


def test_what_was_read_before_others_were_taken_is_not_taken(
    own: Path, contexts: TlsContexts, tablet: ssl.SSLContext
) -> None:
    certs.issue_server(own, ["localhost"], [])
    early = contexts.prepare()
    certs.revoke(own, "tablet")
    contexts.reload()
    with pytest.raises(CertificateError, match="replaced meanwhile"):
        contexts.take(early)
    assert "was revoked" in refusal_of(contexts, tablet)


def test_a_certificate_out_of_its_time_is_better_than_none(own: Path, tablet) -> None:
    expired(own)
    contexts = TlsContexts(files_of(own), ASKING)
    assert "server.crt expired on " in contexts.warnings()[0]
    certs.revoke(own, "tablet")
    assert contexts.reload()  # which does not become worse by it
    tablet.check_hostname, tablet.verify_mode = False, ssl.CERT_NONE
    assert "was revoked" in refusal_of(contexts, tablet)
    with pytest.raises(CertificateError, match="expired on"):
        certs.load_tls(files_of(own), ASKING)


# Policies


def test_each_listener_has_its_own_policy(own: Path) -> None:
    policies = {
        "new": TlsPolicy("required", "1.3"),
        "here": TlsPolicy("off", "1.2", "ECDHE-ECDSA-AES256-GCM-SHA384"),
    }
    contexts = TlsContexts(files_of(own), policies)
    assert contexts.context("new").verify_mode == ssl.CERT_REQUIRED
    assert contexts.context("new").minimum_version == ssl.TLSVersion.TLSv1_3
    assert contexts.context("here").verify_mode == ssl.CERT_NONE
    client = client_of((own / "ca.crt").read_bytes())
    client.maximum_version = ssl.TLSVersion.TLSv1_2
    server, _ = shake_hands(contexts, client)
    cipher = server.cipher()
    assert cipher is not None and cipher[0] == "ECDHE-ECDSA-AES256-GCM-SHA384"
    client.set_ciphers("ECDHE-ECDSA-AES128-GCM-SHA256")
    with pytest.raises(ssl.SSLError):
        shake_hands(contexts, client)


@pytest.mark.parametrize(
    ("source", "common_name", "alternatives", "expected"),
    [
        ("none", "ann", [], None),
        ("subject", "ann", [x509.DNSName("dns")], "ann"),
        ("san", "ann", [x509.DNSName("dns")], "dns"),
        (
            "san",
            None,
            [x509.DNSName("dns"), x509.RFC822Name("ann@acme.example")],
            "ann@acme.example",
        ),
        (
            "san",
            None,
            [x509.DNSName("d"), x509.UniformResourceIdentifier("spiffe://a/b")],
            "spiffe://a/b",
        ),
    ],
)
def test_the_user_that_a_certificate_names(
    own: Path, source, common_name, alternatives, expected
) -> None:
    company = Company()
    company.issue(own / "ann", common_name, alternatives=alternatives)
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(ca + company.pem())
    contexts = TlsContexts(files_of(own), ASKING, source)
    server, _ = shake_hands(contexts, client_of(ca, own / "ann"))
    assert contexts.username(server) == expected
    nobody, _ = shake_hands(contexts, client_of(ca))
    assert contexts.username(nobody) is None


@pytest.mark.parametrize(
    ("source", "common_name", "message"),
    [
        ("subject", None, "0 common names"),
        ("subject", "a\nb", "cannot be a user name"),
        ("san", "ann", "no e-mail address, URI or DNS name"),
    ],
)
def test_certificates_that_name_nobody(own: Path, source, common_name, message) -> None:
    company = Company()
    company.issue(own / "ann", common_name)
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(ca + company.pem())
    contexts = TlsContexts(files_of(own), ASKING, source)
    server, _ = shake_hands(contexts, client_of(ca, own / "ann"))
    with pytest.raises(ValueError, match=message):
        contexts.username(server)


# The server's own


def test_the_servers_certificate_renews_itself(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = files_of(own)
    key = files.key.read_bytes()
    names, addresses = certs.local_names()
    assert certs.keep_server_certificate(files).startswith("this computer is also ")
    assert certs.keep_server_certificate(files) == ""
    monkeypatch.setattr(certs.renewal, "local_names", lambda: ([*names, "new.local"], addresses))
    assert certs.keep_server_certificate(files) == "this computer is also new.local"
    [certificate] = certs.load_certificates(files.certificate)
    found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    known = found.get_values_for_type(x509.DNSName)
    assert {"new.local", "r2d2.local", *names} <= set(known)  # those of before stay
    assert certs.keep_server_certificate(files) == ""
    monkeypatch.setattr(certs.authority, "CERTIFICATE_VALID", timedelta(days=20))
    certs.renew(own, "server")
    monkeypatch.undo()
    assert certs.keep_server_certificate(files).startswith("it would have ended on ")
    [certificate] = certs.load_certificates(files.certificate)
    assert certificate.not_valid_after_utc > NOW + timedelta(days=800)
    assert files.key.read_bytes() == key
    certs.revoke(own, "server")
    assert certs.keep_server_certificate(files) == "it was revoked"
    assert files.key.read_bytes() != key
    assert certs.keep_server_certificate(files) == ""


def test_a_companys_certificate_is_used_as_it_is(own: Path) -> None:
    names: list[x509.GeneralName] = [x509.DNSName("localhost")]
    Company().issue(own / "server", "robot", server=True, alternatives=names, days=5)
    before = (own / "server.crt").read_bytes()
    assert certs.keep_server_certificate(files_of(own)) == ""
    assert (own / "server.crt").read_bytes() == before
    [warning] = TlsContexts(files_of(own), ASKING).warnings()
    assert "server.crt expires on " in warning


def test_renewal_without_the_authoritys_key_is_told(own: Path) -> None:
    (own / "ca.key").unlink()
    with pytest.raises(CertificateError, match=r"there is no .*ca\.key: only with"):
        certs.keep_server_certificate(files_of(own))


# A clock that is not set yet, or was ahead


def clock_at(monkeypatch: pytest.MonkeyPatch, moment: datetime) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, tz=None) -> datetime:
            return moment.astimezone(tz)

    for module in (certs.authority, certs.contexts, certs.files, certs.renewal):
        monkeypatch.setattr(module, "datetime", Clock)


def test_client_certificates_in_1970(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until the clock is set, nobody is too early; who is too late, still is."""
    company = Company()
    company.issue(own / "late", "late", days=-30)
    company.issue(own / "stranger", "stranger")
    clock_at(monkeypatch, NOW + timedelta(days=3))
    certs.issue_client(own, "early")
    monkeypatch.undo()
    ca = (own / "ca.crt").read_bytes()
    (own / "ca.crt").write_bytes(ca + company.pem())
    contexts = TlsContexts(files_of(own), ASKING)
    early, late = client_of(ca, own / "clients/early"), client_of(ca, own / "late")
    for client, why in ((early, "not yet valid"), (late, "expired")):
        with pytest.raises(ssl.SSLError, match=why):
            shake_hands(contexts, client)
    clock_at(monkeypatch, datetime(1970, 1, 1, tzinfo=timezone.utc))
    server, _ = shake_hands(contexts, early)
    assert contexts.refusal(server) == ""
    assert "expired on " in refusal_of(contexts, late)
    other = Company("Other")
    other.issue(own / "other", "other")
    with pytest.raises(ssl.SSLError, match="certificate verify failed"):
        shake_hands(contexts, client_of(ca, own / "other"))
    clock_at(monkeypatch, NOW)
    assert "is not valid before " in contexts.refusal(server)
    clock_at(monkeypatch, NOW + timedelta(days=4))
    assert contexts.refusal(server) == ""


def test_a_certificate_made_by_a_clock_that_was_ahead(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = files_of(own)
    certs.keep_server_certificate(files)
    clock_at(monkeypatch, NOW + timedelta(days=1000))
    assert certs.keep_server_certificate(files).startswith("it would have ended on ")
    clock_at(monkeypatch, datetime(1970, 1, 1, tzinfo=timezone.utc))
    assert certs.keep_server_certificate(files) == ""  # what is wrong is the clock
    monkeypatch.undo()
    assert certs.keep_server_certificate(files).startswith("it was not valid before ")
    [certificate] = certs.load_certificates(files.certificate)
    assert certificate.not_valid_before_utc < NOW < certificate.not_valid_after_utc
    assert certs.keep_server_certificate(files) == ""


# Bytes that nobody meant


def test_damaged_files_are_refused_in_words(own: Path) -> None:
    """Whatever is in a file, the error is ours."""
    company = Company()
    revoked = company.issue(own / "x", "x", alternatives=[x509.DNSName("x")])
    ca = company.pem()
    (own / "ca.crt").write_bytes(ca)
    originals = {
        "server.crt": (own / "server.crt").read_bytes(),
        "ca.crt": ca,
        "ca.crl": company.crl(revoked),
        "server.key": (own / "server.key").read_bytes(),
    }
    (own / "ca.crl").write_bytes(originals["ca.crl"])
    contexts = TlsContexts(files_of(own), ASKING)
    randomly = random.Random(7)
    for name, original in originals.items():
        for number in range(60):
            data = bytearray(base64_of(original) if number % 2 else original)
            for _ in range(randomly.randint(1, 4)):
                data[randomly.randrange(len(data))] = randomly.randrange(256)
            if number % 2:  # in the DER under the PEM
                data = bytearray(pem_of(bytes(data), original))
            if number % 5 == 0:
                del data[randomly.randrange(len(data)) :]
            (own / name).write_bytes(data)
            with contextlib.suppress(CertificateError):
                contexts.prepare()
            (own / name).write_bytes(original)
    assert not contexts.reload()


def base64_of(pem: bytes) -> bytes:
    return base64.b64decode(b"".join(pem.splitlines()[1:-1]))


def pem_of(der: bytes, like: bytes) -> bytes:
    first, *_, last = like.splitlines()
    return b"\n".join([first, base64.encodebytes(der).strip(), last, b""])
