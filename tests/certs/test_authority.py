from __future__ import annotations

import fcntl
import ipaddress
import os
import re
import shutil
import socket
import ssl
import stat
import subprocess
import threading
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from authorities import ADDRESSES, NAMES, Company
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)
from cryptography.x509.oid import ExtendedKeyUsageOID
from waiting import PATIENCE

from appliance import certs
from appliance.certs import CertificateError, addresses, authority, files, load_key
from appliance.host.clock import RELEASED


def load(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def extension(certificate: x509.Certificate, kind: type[x509.ExtensionType]) -> x509.Extension:  # type: ignore[type-arg]
    return certificate.extensions.get_extension_for_class(kind)


# What is written


def test_files_and_their_modes(made: Path) -> None:
    modes = {
        str(path.relative_to(made)): stat.S_IMODE(path.stat().st_mode)
        for path in made.rglob("*")
        if path.is_file()
    }
    assert modes == {
        "ca.crt": 0o644,
        "ca.key": 0o600,
        "server.crt": 0o644,
        "server.key": 0o600,
        "clients/tablet.crt": 0o644,
        "clients/tablet.key": 0o600,
        "issued.jsonl": 0o644,
    }
    assert stat.S_IMODE(made.stat().st_mode) == 0o755


def test_what_root_makes_is_the_services(made: Path, tmp_path: Path) -> None:
    """`sudo appliance cert …` must leave the service its key, and what it renews by itself."""
    if os.geteuid():
        pytest.skip("gives files to another user, as root only may")
    home = Path(shutil.copytree(made, tmp_path / "certs"))
    for path in (home, *home.rglob("*")):
        os.chown(path, 4321, 4322)
    certs.issue_client(home, "bob")
    (home / "server.key").unlink()
    certs.issue_server(home, NAMES, ADDRESSES)
    assert (home / "clients/bob.key").exists()
    for path in (home, *home.rglob("*")):
        assert (path.stat().st_uid, path.stat().st_gid) == (4321, 4322), path


def test_the_authority(made: Path) -> None:
    authority = load(made / "ca.crt")
    authority.verify_directly_issued_by(authority)
    constraints = extension(authority, x509.BasicConstraints)
    assert constraints.critical
    assert (constraints.value.ca, constraints.value.path_length) == (True, 0)
    usage = extension(authority, x509.KeyUsage)
    assert usage.critical and usage.value.key_cert_sign and usage.value.crl_sign
    assert not usage.value.digital_signature
    [common_name] = authority.subject
    assert str(common_name.value).startswith("r2d2 CA ")
    assert isinstance(authority.public_key(), ec.EllipticCurvePublicKey)
    lifetime = authority.not_valid_after_utc - datetime.now(timezone.utc)
    assert timedelta(days=3649) < lifetime <= timedelta(days=3650)


@pytest.mark.parametrize(
    ("file", "purpose"),
    [
        ("server.crt", ExtendedKeyUsageOID.SERVER_AUTH),
        ("clients/tablet.crt", ExtendedKeyUsageOID.CLIENT_AUTH),
    ],
)
def test_the_certificates(made: Path, file: str, purpose: x509.ObjectIdentifier) -> None:
    certificate, authority = load(made / file), load(made / "ca.crt")
    certificate.verify_directly_issued_by(authority)
    assert not extension(certificate, x509.BasicConstraints).value.ca
    usage = extension(certificate, x509.KeyUsage)
    assert usage.critical and usage.value.digital_signature and not usage.value.key_cert_sign
    assert list(extension(certificate, x509.ExtendedKeyUsage).value) == [purpose]
    issuer = extension(certificate, x509.AuthorityKeyIdentifier).value.key_identifier
    assert issuer == extension(authority, x509.SubjectKeyIdentifier).value.digest
    assert certificate.serial_number.bit_length() > 100
    now = datetime.now(timezone.utc)
    assert certificate.not_valid_before_utc < now - timedelta(hours=23)
    whole = certificate.not_valid_after_utc - certificate.not_valid_before_utc
    assert whole == timedelta(days=825)  # Apple's systems count all of it


def test_the_servers_names(made: Path) -> None:
    alternatives = extension(load(made / "server.crt"), x509.SubjectAlternativeName).value
    assert alternatives.get_values_for_type(x509.DNSName) == NAMES
    assert alternatives.get_values_for_type(x509.IPAddress) == ADDRESSES


def test_two_authorities_have_two_names(made: Path, tmp_path: Path) -> None:
    certs.create_authority(tmp_path, "r2d2")
    assert load(tmp_path / "ca.crt").subject != load(made / "ca.crt").subject


def test_a_long_name_is_cut(tmp_path: Path) -> None:
    certs.create_authority(tmp_path, "x" * 200)
    [common_name] = load(tmp_path / "ca.crt").subject
    assert len(common_name.value) == 64


def test_an_authority_is_never_replaced(own: Path) -> None:
    before = (own / "ca.key").read_bytes()
    with pytest.raises(CertificateError, match=r"ca\.crt exists"):
        certs.create_authority(own)
    (own / "ca.crt").unlink()
    with pytest.raises(CertificateError, match=r"ca\.key exists"):
        certs.create_authority(own)
    assert (own / "ca.key").read_bytes() == before


@pytest.mark.parametrize("file", ["server", "clients/tablet"])
def test_renewing_keeps_the_key(own: Path, file: str) -> None:
    key, certificate = (own / f"{file}.key").read_bytes(), load(own / f"{file}.crt")
    if file == "server":
        certs.issue_server(own, ["c3po.local"], [])
    else:
        certs.issue_client(own, "tablet")
    assert (own / f"{file}.key").read_bytes() == key
    renewed = load(own / f"{file}.crt")
    assert renewed.public_key() == certificate.public_key()
    assert renewed.serial_number != certificate.serial_number
    (own / f"{file}.crt").unlink()
    certs.issue_server(own, NAMES, ADDRESSES)
    certs.issue_client(own, "tablet")
    assert (own / f"{file}.key").read_bytes() == key


def test_a_certificate_of_someone_else_is_not_replaced(own: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    certs.create_authority(other, None, NAMES)
    certs.issue_server(other, NAMES, [])
    shutil.copy(other / "server.crt", own / "server.crt")
    with pytest.raises(CertificateError, match="not of this appliance's authority"):
        certs.issue_server(own, NAMES, [])
    assert load(own / "server.crt") == load(other / "server.crt")


def test_a_certificate_does_not_outlive_its_authority(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(authority, "AUTHORITY_VALID", timedelta(days=100))
    certs.create_authority(tmp_path, None, NAMES)
    certs.issue_server(tmp_path, NAMES, [])
    ca, server = load(tmp_path / "ca.crt"), load(tmp_path / "server.crt")
    assert server.not_valid_after_utc == ca.not_valid_after_utc


def test_an_authority_that_is_not_whole(own: Path, tmp_path: Path) -> None:
    with pytest.raises(CertificateError, match=r"there is no file .*ca\.crt"):
        certs.issue_server(tmp_path / "nowhere", NAMES, [])
    other = tmp_path / "other"
    certs.create_authority(other)
    shutil.copy(other / "ca.key", own / "ca.key")
    with pytest.raises(CertificateError, match=r"ca\.key is not the key of .*ca\.crt"):
        certs.issue_server(own, NAMES, [])


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "-x", "x" * 65, "a b", "ä"])
def test_clients_that_cannot_be_files(made: Path, name: str) -> None:
    with pytest.raises(CertificateError, match="cannot name"):
        certs.issue_client(made, name)


@pytest.mark.parametrize("name", ["", "röbot", "a b", "-x", "*"])
def test_names_that_dns_does_not_have(made: Path, name: str) -> None:
    with pytest.raises(CertificateError, match="no DNS name"):
        certs.issue_server(made, [name], [])


def test_a_server_needs_a_name(made: Path) -> None:
    with pytest.raises(CertificateError, match="needs a name"):
        certs.issue_server(made, [], [])


def test_a_clock_that_was_never_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What is made in 1970 is good when the clock is set, and for as long as any other."""

    class Clock(datetime):
        @classmethod
        def now(cls, tz=None) -> datetime:
            return datetime(1970, 1, 1, tzinfo=tz)

    for module in (authority, files):
        monkeypatch.setattr(module, "datetime", Clock)
    authority._warn_of_unset_clock.cache_clear()
    certs.create_authority(tmp_path, None, NAMES)
    certs.issue_server(tmp_path, NAMES, ADDRESSES)
    monkeypatch.undo()
    [told] = caplog.messages
    assert "clock says 1970-01-01" in told and f"{RELEASED:%Y-%m-%d}" in told
    ca, server = load(tmp_path / "ca.crt"), load(tmp_path / "server.crt")
    for certificate in (ca, server):
        assert certificate.not_valid_before_utc == RELEASED - timedelta(days=1)
    assert server.not_valid_after_utc == RELEASED + timedelta(days=824)
    assert ca.not_valid_after_utc == RELEASED + timedelta(days=3650)


def test_a_write_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        certs.create_authority(tmp_path)
    assert not list(tmp_path.iterdir())


def test_local_names() -> None:
    names, addresses = certs.local_names()
    hostname = socket.gethostname().lower()
    assert {"localhost", hostname.partition(".")[0] + ".local"} <= set(names)
    assert set(ADDRESSES) <= set(addresses)
    assert len(names) == len(set(names)) and len(addresses) == len(set(addresses))
    assert not any(address.version == 6 and address.is_link_local for address in addresses)


def test_a_resolver_that_does_not_answer_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answer = threading.Event()

    def getfqdn(name: str) -> str:
        answer.wait(10)
        return "too.late"

    monkeypatch.setattr(addresses.socket, "getfqdn", getfqdn)
    monkeypatch.setattr(addresses, "_RESOLVER_PATIENCE", 0.01)
    names, _ = certs.local_names()
    answer.set()
    assert "too.late" not in names and "localhost" in names


def test_the_readme_names_every_file(own: Path) -> None:
    certs.write_readme(own)
    text = (own / "README.md").read_text()
    for file in ("ca.crt", "ca.key", "server.crt", "server.key", "clients/NAME.crt", "825 days"):
        assert file in text
    assert stat.S_IMODE((own / "README.md").stat().st_mode) == 0o644


@pytest.mark.skipif(shutil.which("openssl") is None, reason="the openssl command is not installed")
@pytest.mark.parametrize(
    ("file", "purpose"), [("server.crt", "sslserver"), ("clients/tablet.crt", "sslclient")]
)
def test_openssl_accepts_the_chain(made: Path, file: str, purpose: str) -> None:
    command = ["openssl", "verify", "-x509_strict", "-purpose", purpose, "-CAfile", made / "ca.crt"]
    done = subprocess.run([*command, made / file], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    wrong = "sslclient" if purpose == "sslserver" else "sslserver"
    command[command.index(purpose)] = wrong
    done = subprocess.run([*command, made / file], capture_output=True, timeout=PATIENCE)
    assert done.returncode != 0


# Handshakes


def handshake(
    server: ssl.SSLContext, client: ssl.SSLContext, hostname: str = "localhost"
) -> tuple[str | None, dict[str, object] | None]:
    """The TLS version and the client's certificate; raises what either side found wrong."""
    found: list[tuple[str | None, dict[str, object] | None]] = []
    errors: list[Exception] = []

    def serve(listener: socket.socket) -> None:
        try:
            plain, _ = listener.accept()
            with plain:
                plain.settimeout(PATIENCE)
                with server.wrap_socket(plain, server_side=True) as connection:
                    found.append((connection.version(), connection.getpeercert()))
                    connection.sendall(b"x")
        except OSError as error:
            errors.append(error)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE)
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        try:
            with (
                socket.create_connection(listener.getsockname(), timeout=PATIENCE) as plain,
                client.wrap_socket(plain, server_hostname=hostname) as connection,
            ):
                # In TLS 1.3 a client only learns here that its certificate was refused.
                if connection.recv(1) != b"x":
                    raise ConnectionError("closed by the server")
        except OSError as error:
            errors.insert(0, error)
        finally:
            thread.join(2 * PATIENCE)
    if errors:
        raise errors[0]
    return found[0]


def client_context(authority: Path) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=authority)
    context.verify_flags |= ssl.VERIFY_X509_STRICT  # The default from Python 3.13 on.
    return context


def server_context(
    directory: Path, client_certificates: certs.ClientCertificates = "off"
) -> ssl.SSLContext:
    return certs.server_context(
        directory / "server.crt",
        directory / "server.key",
        directory / "ca.crt",
        client_certificates,
    )


@pytest.mark.parametrize("hostname", [*NAMES, "127.0.0.1", "::1"])
@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_a_client_trusts_the_server(made: Path, hostname: str, version: ssl.TLSVersion) -> None:
    client = client_context(made / "ca.crt")
    client.minimum_version = client.maximum_version = version
    spoken, _ = handshake(server_context(made), client, hostname)
    assert spoken == version.name.replace("_", ".")


def test_a_name_that_is_not_in_the_certificate(made: Path) -> None:
    with pytest.raises(ssl.SSLCertVerificationError, match="Hostname mismatch"):
        handshake(server_context(made), client_context(made / "ca.crt"), "c3po")


def test_a_client_with_another_authority(made: Path, tmp_path: Path) -> None:
    certs.create_authority(tmp_path, "r2d2")
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(server_context(made), client_context(tmp_path / "ca.crt"))
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(server_context(made), ssl.create_default_context())


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_old_tls_is_refused(made: Path) -> None:
    client = client_context(made / "ca.crt")
    client.minimum_version = ssl.TLSVersion.TLSv1
    client.maximum_version = ssl.TLSVersion.TLSv1_1
    client.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.raises((ssl.SSLError, ConnectionError)):
        handshake(server_context(made), client)


def test_ciphers_without_forward_secrecy_or_authentication_are_refused(made: Path) -> None:
    client = client_context(made / "ca.crt")
    client.maximum_version = ssl.TLSVersion.TLSv1_2
    client.set_ciphers("ECDHE-ECDSA-AES128-SHA256")
    with pytest.raises((ssl.SSLError, ConnectionError)):
        handshake(server_context(made), client)


@pytest.mark.parametrize("wanted", ["optional", "required"])
@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_client_certificates(
    made: Path, tmp_path: Path, wanted: certs.ClientCertificates, version: ssl.TLSVersion
) -> None:
    server = server_context(made, wanted)

    def context(directory: Path | None) -> ssl.SSLContext:
        client = client_context(made / "ca.crt")
        client.maximum_version = version
        if directory is not None:
            path = directory / "clients" / "tablet"
            client.load_cert_chain(path.with_suffix(".crt"), path.with_suffix(".key"))
        return client

    _, certificate = handshake(server, context(made))
    assert certificate is not None and certificate["subject"] == ((("commonName", "tablet"),),)

    other = tmp_path / "other"
    certs.create_authority(other, "r2d2")
    certs.issue_client(other, "tablet")
    with pytest.raises((ssl.SSLError, ConnectionError)):
        handshake(server, context(other))

    if wanted == "required":
        with pytest.raises((ssl.SSLError, ConnectionError)):
            handshake(server, context(None))
    else:
        _, certificate = handshake(server, context(None))
        assert not certificate


def test_the_servers_certificate_is_no_clients(made: Path) -> None:
    client = client_context(made / "ca.crt")
    client.load_cert_chain(made / "server.crt", made / "server.key")
    with pytest.raises((ssl.SSLError, ConnectionError)):
        handshake(server_context(made, "optional"), client)


# Files that cannot be used


def overwrite(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def pem_of(key: rsa.RSAPrivateKey | ec.EllipticCurvePrivateKey, password: bytes | None) -> bytes:
    encryption = BestAvailableEncryption(password) if password else NoEncryption()
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption)


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (
            lambda d: (d / "server.crt").unlink(),
            r"there is no file .*server\.crt; `appliance init`",
        ),
        (lambda d: (d / "server.key").unlink(), r"there is no file .*server\.key"),
        (lambda d: (d / "ca.crt").unlink(), r"there is no file .*ca\.crt"),
        (lambda d: overwrite(d / "server.crt", b"x"), r"server\.crt is not a certificate"),
        (lambda d: overwrite(d / "server.key", b"x"), r"server\.key is not a private key"),
        (lambda d: overwrite(d / "ca.crt", b""), r"ca\.crt is not a certificate"),
        (lambda d: (d / "server.key").chmod(0o640), r"mode 0640\); close it with: chmod 600 /"),
        (lambda d: (d / "server.key").chmod(0o604), r"mode 0604\)"),
        (
            lambda d: overwrite(d / "server.key", (d / "clients" / "tablet.key").read_bytes()),
            r"server\.key is not the key of .*server\.crt",
        ),
        (
            lambda d: overwrite(
                d / "server.key", pem_of(ec.generate_private_key(ec.SECP256R1()), b"secret")
            ),
            r"server\.key is encrypted",
        ),
        (
            lambda d: ((d / "server.crt").unlink(), (d / "server.crt").mkdir()),
            r"server\.crt cannot be read \(Is a directory\)",
        ),
    ],
)
def test_files_that_cannot_be_used(own: Path, harm: Callable[[Path], object], message: str) -> None:
    harm(own)
    with pytest.raises(CertificateError, match=message):
        server_context(own, "optional")


def test_client_certificates_need_an_authority(made: Path) -> None:
    with pytest.raises(CertificateError, match="need the CA"):
        certs.server_context(made / "server.crt", made / "server.key", None, "required")


@pytest.mark.parametrize(
    ("offset", "message"),
    [
        (timedelta(days=-900), r"server\.crt expired on "),
        (timedelta(days=3), r"server\.crt is not valid before .*clock"),
    ],
)
def test_certificates_out_of_their_time(
    own: Path, monkeypatch: pytest.MonkeyPatch, offset: timedelta, message: str
) -> None:
    monkeypatch.setattr(authority, "out_of_time", lambda *_: "")
    now = datetime.now(timezone.utc).replace(microsecond=0)
    monkeypatch.setattr(authority, "_now", lambda: now + offset)
    certs.issue_server(own, NAMES, ADDRESSES)
    monkeypatch.undo()
    with pytest.raises(CertificateError, match=message):
        server_context(own)


def test_a_certificate_that_expires_soon_is_told(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(authority, "CERTIFICATE_VALID", timedelta(days=20))
    certs.issue_server(own, NAMES, ADDRESSES)
    tls_files = certs.TlsFiles(own / "server.crt", own / "server.key")
    [warning] = certs.load_tls(tls_files, {}).warnings()
    assert "server.crt expires on " in warning


def test_a_certificate_of_ones_own_with_an_rsa_key(own: Path) -> None:
    key = rsa.generate_private_key(65537, 2048)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "bought")])
    now = datetime.now(timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now)
        .not_valid_after(now + timedelta(days=90))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    (own / "server.crt").write_bytes(certificate.public_bytes(Encoding.PEM))
    (own / "server.key").write_bytes(pem_of(key, None))
    client = ssl.create_default_context(cafile=own / "server.crt")
    client.verify_flags &= ~ssl.VERIFY_X509_STRICT
    assert handshake(server_context(own), client)[0] == "TLSv1.3"


# For which names it may sign


def verified(directory: Path, leaf: Path, *options: str) -> str:
    """What OpenSSL says of a certificate of the authority; empty when it is good."""
    found = subprocess.run(
        ["openssl", "verify", *options, "-CAfile", directory / "ca.crt", leaf],
        capture_output=True,
        text=True,
    )
    return found.stdout + found.stderr if found.returncode else ""


def forged(directory: Path, alternatives: list[x509.GeneralName]) -> Path:
    """A server's certificate that was made with the authority's key, and without our checks."""
    company = Company()
    company.key = load_key(directory / "ca.key")  # type: ignore[assignment]
    company.certificate = load(directory / "ca.crt")
    path = directory / "forged"
    company.issue(path, "forged", server=True, alternatives=alternatives)
    return path.with_name("forged.crt")


def public(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
@pytest.mark.parametrize(
    ("name", "may"),
    [
        ("robot.local", True),
        ("a.b.home.arpa", True),
        ("localhost", True),
        ("r2d2", True),
        ("r2d2.acme.example", True),
        ("x.r2d2.acme.example", True),
        ("10.1.2.3", True),
        ("192.168.7.8", True),
        ("169.254.1.1", True),
        ("fe80::1", True),
        ("fd12::1", True),
        ("127.0.0.1", True),
        ("203.0.113.7", True),
        ("2001:db8:1:2::77", True),
        ("acme.example", False),
        ("www.example.com", False),
        ("notlocal", False),
        ("8.8.8.8", False),
        ("203.0.113.8", False),
        ("2001:db8:1:3::1", False),
        ("172.32.0.1", False),
    ],
)
def test_the_authority_may_sign_for_its_own_alone(tmp_path: Path, name: str, may: bool) -> None:
    names = ["r2d2", "r2d2.acme.example"]
    addresses: list[certs.Address] = [
        ipaddress.IPv4Address("203.0.113.7"),
        ipaddress.IPv6Address("2001:db8:1:2::5"),
    ]
    certs.create_authority(tmp_path, "r2d2", names, addresses)
    said = verified(tmp_path, forged(tmp_path, [public(name)]), "-purpose", "sslserver")
    assert (said == "") is may, said
    assert "permitted subtree violation" in said or may
    subject = public(name).value
    given = ([subject], []) if isinstance(subject, str) else ([], [subject])
    if may:
        certs.issue_server(tmp_path, *given)
        assert verified(tmp_path, tmp_path / "server.crt", "-purpose", "sslserver") == ""
    else:
        with pytest.raises(CertificateError, match=f"not for {re.escape(name)}.*new authority"):
            certs.issue_server(tmp_path, *given)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_clients_that_are_called_as_hosts_are(tmp_path: Path) -> None:
    """OpenSSL takes a common name with a dot for a DNS name, where no other is said."""
    certs.create_authority(tmp_path, "r2d2")
    for name in ("tablet", "bob@acme.example", "tablet.local"):
        certs.issue_client(tmp_path, name)
        assert verified(tmp_path, tmp_path / f"clients/{name}.crt") == ""
    with pytest.raises(CertificateError, match=r"looks like a DNS name.*write bob-smith"):
        certs.issue_client(tmp_path, "bob.smith")


def test_an_authority_of_before_signs_for_all(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        add = x509.CertificateBuilder.add_extension

        def without(self, value, critical):
            is_one = isinstance(value, x509.NameConstraints)
            return self if is_one else add(self, value, critical)

        patch.setattr(x509.CertificateBuilder, "add_extension", without)
        certs.create_authority(tmp_path, "r2d2")
    certs.issue_server(tmp_path, ["www.example.com"], [])
    certs.issue_client(tmp_path, "bob.smith")


def test_a_server_that_was_revoked_is_renewed_with_a_new_key(own: Path) -> None:
    before = (own / "server.key").read_bytes()
    certs.revoke(own, "server")
    files = certs.TlsFiles(own / "server.crt", own / "server.key", own / "ca.crt")
    assert "was revoked" in certs.server_revoked(files)
    [warning] = certs.TlsContexts(files, {"x": certs.TlsPolicy("optional")}).warnings()
    assert "server.crt was revoked on " in warning
    certs.renew(own, "server")
    assert (own / "server.key").read_bytes() != before
    assert certs.server_revoked(files) == ""


def test_a_certificate_that_is_over_makes_room(own: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody logs in with it any more, and it cannot be revoked by its name."""
    _, first = certs.new_request("phone")
    _, second = certs.new_request("phone")
    certs.sign(own, first, "phone")
    with pytest.raises(CertificateError, match="has a certificate, of another key"):
        certs.check_new_client(own, "phone")
    with pytest.raises(CertificateError, match="is of another key; revoke it first"):
        certs.sign(own, second, "phone")
    later = authority._now() + authority.CERTIFICATE_VALID
    monkeypatch.setattr(authority, "_now", lambda: later)
    certs.check_new_client(own, "phone")
    certs.sign(own, second, "phone")


def test_who_may_only_read_the_directory_does_not_hold_it_up(own: Path) -> None:
    descriptor = os.open(own, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        certs.issue_client(own, "phone")
    finally:
        os.close(descriptor)


def test_a_key_that_is_stored_elsewhere_waits_for_the_one_here(own: Path, tmp_path: Path) -> None:
    """They write the same register."""
    elsewhere = tmp_path / "stick.key"
    shutil.copy(own / "ca.key", elsewhere)
    done = threading.Event()

    def issue() -> None:
        certs.issue_client(own, "phone", elsewhere)
        done.set()

    with files.locked(own / "ca.key"):
        thread = threading.Thread(target=issue)
        thread.start()
        assert not done.wait(0.2)
    assert done.wait(60)
    thread.join()
