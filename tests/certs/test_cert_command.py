"""`appliance cert`: what it makes, what it refuses, and what openssl says of that."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import shutil
import ssl
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from authorities import Company
from command_line import run
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import dsa, ec, ed25519, rsa
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import NameOID
from waiting import PATIENCE

from appliance import certs
from appliance.certs.requests import load_request

needs_openssl = pytest.mark.skipif(
    shutil.which("openssl") is None, reason="the openssl command is not installed"
)


def openssl(*arguments: str | Path) -> str:
    done = subprocess.run(["openssl", *arguments], capture_output=True, text=True, timeout=PATIENCE)
    return f"{done.stdout}{done.stderr}\nexit {done.returncode}"


@pytest.fixture
def here(own: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The certificates' directory of an appliance in the current one; it has a client, tablet."""
    monkeypatch.chdir(own.parent)
    monkeypatch.setenv("NO_COLOR", "1")
    (own.parent / "appliance.yaml").write_text("robot: r2d2\n")
    return own


def everything(directory: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in directory.parent.rglob("*") if path.is_file()}


def request_of(key, name: str | None = "esp") -> bytes:
    attributes = [] if name is None else [x509.NameAttribute(NameOID.COMMON_NAME, name)]
    builder = x509.CertificateSigningRequestBuilder().subject_name(x509.Name(attributes))
    algorithm = None if isinstance(key, ed25519.Ed25519PrivateKey) else hashes.SHA256()
    return builder.sign(key, algorithm).public_bytes(Encoding.PEM)


# issue


@needs_openssl
def test_a_certificate_for_a_phone(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("cert", "issue", "phone", "--pkcs12", "--generate") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        "made  certs/clients/phone.crt, certs/clients/phone.key",
        "made  certs/clients/phone.p12",
    ]
    password = lines[2].removeprefix("password ")
    assert len(password) == 20
    file = here / "clients/phone.p12"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    shown = openssl("pkcs12", "-in", file, "-passin", f"pass:{password}", "-nodes", "-info")
    assert shown.endswith("exit 0")
    assert "subject=CN = phone" in shown and "subject=CN = r2d2 CA" in shown
    assert "BEGIN PRIVATE KEY" in shown and "Iteration 100000" in shown
    assert "exit 1" in openssl("pkcs12", "-in", file, "-passin", "pass:wrong password")
    for path, data in everything(here).items():
        assert password.encode() not in data, path


def test_a_password_that_is_given(
    here: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    (tmp_path / "password").write_text("long enough\nmore")
    assert run("cert", "issue", "phone", "--pkcs12", "--password-file", "password") == 0
    assert "long enough" not in capsys.readouterr().out
    before = everything(here)
    monkeypatch.setattr("sys.stdin", io.StringIO("short\n"))
    assert run("cert", "issue", "other", "--pkcs12", "--password-file", "-") == 1
    assert "less than 8 characters" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert run("cert", "issue", "other", "--pkcs12") == 1
    assert "no terminal to ask on; use --generate" in capsys.readouterr().err
    assert run("cert", "issue", "other", "--generate") == 2
    assert everything(here) == before


def test_one_file_for_a_microcontroller(here: Path) -> None:
    assert run("cert", "issue", "tablet", "--bundle") == 0  # of what is there
    file = here / "clients/tablet.pem"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    context = ssl.create_default_context(cafile=file)
    context.load_cert_chain(file)
    text = file.read_text()
    assert (here / "clients/tablet.key").read_text() in text
    assert (here / "clients/tablet.crt").read_text() + (here / "ca.crt").read_text() in text


def test_a_client_that_has_a_certificate(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = everything(here)
    assert run("cert", "issue", "tablet") == 1
    assert "`appliance cert renew tablet` makes it anew" in capsys.readouterr().err
    assert everything(here) == before


HOSTILE = ["../x", "/etc/passwd", "..", "a/b", "", "-", "a b", "a\nb", "server", "all", "x" * 65]


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_reach_no_file(here: Path, name: str, capsys) -> None:
    before = everything(here)
    (here.parent / "r.csr").write_bytes(request_of(ec.generate_private_key(ec.SECP256R1())))
    commands = [["issue", "--"], ["sign", "r.csr", "--name"], ["revoke", "--"], ["renew", "--"]]
    for command in commands:
        if command[0] == "renew" and name in ("server", "all"):
            continue
        if command[0] == "revoke" and name in ("server", "/etc/passwd"):
            continue
        assert run("cert", *command, name) in (1, 2), command
    (here.parent / "r.csr").unlink()
    assert everything(here) == before
    assert "Traceback" not in capsys.readouterr().err


# sign


@pytest.mark.parametrize(
    "key",
    [
        ec.generate_private_key(ec.SECP256R1()),
        ec.generate_private_key(ec.SECP384R1()),
        ed25519.Ed25519PrivateKey.generate(),
        rsa.generate_private_key(65537, 2048),
    ],
    ids=["P-256", "P-384", "Ed25519", "RSA"],
)
def test_a_request(here: Path, key, capsys) -> None:
    file = here.parent / "device.csr"
    file.write_bytes(request_of(key))
    assert run("cert", "sign", "device.csr") == 0
    assert "clients/esp.crt, for client 'esp'" in capsys.readouterr().out
    [certificate] = certs.load_certificates(here / "clients/esp.crt")
    assert certificate.public_key() == key.public_key()
    assert not (here / "clients/esp.key").exists()
    assert certs.issued_by(certificate, certs.load_certificates(here / "ca.crt")[0])
    der = x509.load_pem_x509_csr(file.read_bytes()).public_bytes(Encoding.DER)
    file.write_bytes(der)
    assert run("cert", "sign", "device.csr") == 0  # the same key: a renewal
    assert run("cert", "sign", "device.csr", "--name", "tablet") == 1  # another client's name
    assert run("cert", "sign", "device.csr", "--name", "second") == 0


def test_what_a_request_asks_for_is_not_taken_over(here: Path) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    request = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "esp")]))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    certs.sign(here, request.public_bytes(Encoding.PEM))
    [certificate] = certs.load_certificates(here / "clients/esp.crt")
    extensions = certificate.extensions
    assert not extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    with pytest.raises(x509.ExtensionNotFound):
        extensions.get_extension_for_class(x509.SubjectAlternativeName)


def tampered() -> bytes:
    pem = request_of(ec.generate_private_key(ec.SECP256R1()))
    der = x509.load_pem_x509_csr(pem).public_bytes(Encoding.DER)
    return der.replace(b"esp", b"tab")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the request is empty"),
        (b"\n\n", "the request is empty"),
        (b"\0" * 100, "not a certificate request"),
        (b"-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n", "not a certificate request"),
        (b"x" * 70_000, "more than 65536 bytes"),
        (tampered(), "not signed with its own key"),
        (request_of(ec.generate_private_key(ec.SECP256K1())), "a key on the curve secp256k1"),
        (request_of(rsa.generate_private_key(65537, 1024)), "an RSA key of 1024 bits"),
        (request_of(dsa.generate_private_key(1024)), "a kind of key that TLS clients"),
        (request_of(ec.generate_private_key(ec.SECP256R1()), None), "no common name"),
        (request_of(ec.generate_private_key(ec.SECP256R1()), "../../x"), "cannot name a client"),
    ],
)
def test_requests_that_are_refused(here: Path, data: bytes, message: str, capsys) -> None:
    (here.parent / "device.csr").write_bytes(data)
    before = everything(here)
    assert run("cert", "sign", "device.csr") == 1
    assert message in capsys.readouterr().err
    assert everything(here) == before


def test_requests_with_damage_are_refused_in_words() -> None:
    original = bytearray(
        x509.load_pem_x509_csr(request_of(ec.generate_private_key(ec.SECP256R1()))).public_bytes(
            Encoding.DER
        )
    )
    randomly = random.Random(7)
    for _ in range(1000):
        data = original.copy()
        for _ in range(randomly.randint(1, 4)):
            data[randomly.randrange(len(data))] = randomly.randrange(256)
        with contextlib.suppress(certs.CertificateError):
            load_request(bytes(data))


def test_a_request_that_is_not_there(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("cert", "sign", "nowhere.csr") == 1
    assert "nowhere.csr: No such file" in capsys.readouterr().err


# revoke


@needs_openssl
def test_a_lost_device_is_revoked_by_its_name(here: Path, capsys) -> None:
    """Its files are gone, and every certificate that it ever had is meant."""
    first = shutil.copy(here / "clients/tablet.crt", here.parent / "first.crt")
    assert run("cert", "renew", "tablet") == 0
    second = shutil.copy(here / "clients/tablet.crt", here.parent / "second.crt")
    shutil.rmtree(here / "clients")
    certs.issue_client(here, "other")
    capsys.readouterr()
    assert run("cert", "revoke", "tablet") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 and lines[2] == "made  certs/ca.crl"
    check = ["verify", "-CAfile", here / "ca.crt", "-CRLfile", here / "ca.crl", "-crl_check"]
    for file in (first, second):
        assert "certificate revoked" in openssl(*check, file)
    assert openssl(*check, here / "clients/other.crt").endswith("exit 0")
    assert stat.S_IMODE((here / "ca.crl").stat().st_mode) == 0o644
    assert run("cert", "revoke", "tablet") == 1
    assert "tablet was revoked on 20" in capsys.readouterr().err


def test_revoked_by_serial_number_and_by_file(here: Path, capsys) -> None:
    for name in ("a", "b"):
        certs.issue_client(here, name)
    serial = {entry.name: entry.serial_text for entry in certs.issued(here)}
    colons = ":".join(serial["a"][i : i + 2] for i in range(0, 40, 2)).lower()
    assert run("cert", "revoke", colons) == 0
    assert run("cert", "revoke", "certs/clients/b.crt") == 0
    revoked = {entry.name for entry in certs.issued(here) if entry.revoked}
    assert revoked == {"a", "b"}
    Company().issue(here.parent / "foreign", "foreign")
    for wrong in ("nobody", "AB" * 20, "foreign.crt", "appliance.yaml"):
        assert run("cert", "revoke", wrong) == 1, wrong
    assert "Traceback" not in capsys.readouterr().err
    assert {entry.name for entry in certs.issued(here) if entry.revoked} == revoked


def crl_of(directory: Path) -> x509.CertificateRevocationList:
    return x509.load_pem_x509_crl((directory / "ca.crl").read_bytes())


def number_of(crl: x509.CertificateRevocationList) -> int:
    return crl.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number


def test_what_was_revoked_stays_so_without_the_list_of_what_was_issued(here: Path) -> None:
    certs.revoke(here, "tablet")
    before = crl_of(here)
    (here / "issued.jsonl").unlink()
    certs.issue_client(here, "other")
    certs.revoke(here, "other")
    after = crl_of(here)
    assert {item.serial_number for item in before} < {item.serial_number for item in after}
    assert number_of(after) > number_of(before)
    (here / "ca.crl").unlink()
    assert run("cert", "crl") == 0
    assert len(crl_of(here)) == 1 and number_of(crl_of(here)) >= number_of(before)


def test_a_key_that_was_revoked_is_not_certified_again(here: Path, capsys) -> None:
    key = (here / "clients/tablet.key").read_bytes()
    device = request_of(ec.generate_private_key(ec.SECP256R1()))
    certs.sign(here, device)
    certs.revoke(here, "tablet")
    certs.revoke(here, "esp")
    assert run("cert", "renew", "tablet") == 1
    assert "was revoked with its certificate; a new key" in capsys.readouterr().err
    with pytest.raises(certs.CertificateError, match="was revoked with its certificate"):
        certs.sign(here, device, "other")
    assert run("cert", "issue", "tablet") == 0
    assert (here / "clients/tablet.key").read_bytes() != key
    certs.sign(here, request_of(ec.generate_private_key(ec.SECP256R1())))  # esp, with a new key
    assert [e.name for e in certs.list_certificates(here) if e.usable] == [
        "ca",
        "server",
        "esp",
        "tablet",
    ]


# renew and list


def test_everything_is_renewed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    certs.sign(here, request_of(ec.generate_private_key(ec.SECP256R1())))
    certs.issue_client(here, "lost")
    certs.write_bundle(here, "tablet")
    certs.revoke(here, "lost")
    keys = {path: path.read_bytes() for path in here.rglob("*.key")}
    serials = {entry.serial for entry in certs.issued(here)}
    assert run("cert", "renew", "all") == 0
    assert sorted(capsys.readouterr().out.split("renewed")) == [
        "", "  esp\n", "  server\n", "  tablet\n"
    ]  # fmt: skip
    assert {path: path.read_bytes() for path in here.rglob("*.key")} == keys
    assert len({entry.serial for entry in certs.issued(here)} - serials) == 3
    assert not (here / "clients/tablet.pem").exists()  # it has the certificate before


def test_the_list(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    certs.issue_client(here, "lost")
    certs.revoke(here, "lost")
    certs.renew(here, "tablet")
    assert run("cert", "list") == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [row[:3] for row in rows] == [
        ["ca", "authority", "3649"],
        ["server", "server", "823"],
        ["lost", "client", "revoked"],
        ["tablet", "client", "823"],
    ]
    assert run("cert", "list", "--all", "--json") == 0
    entries = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    states = [(e["name"], e["for"], e["state"]) for e in entries if e["name"] == "tablet"]
    assert states == [("tablet", "client", "valid"), ("tablet", "client", "replaced")]
    assert entries[3]["file"] == str(here / "clients/tablet.crt") and entries[4]["file"] is None


# What can be wrong


@needs_openssl
def test_fingerprints_are_those_that_devices_show(here: Path, capsys) -> None:
    assert run("cert", "fingerprint") == 0
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    assert printed.keys() == {"server.crt", "ca.crt"}
    for name, text in printed.items():
        said = openssl("x509", "-in", here / name, "-noout", "-fingerprint", "-sha256")
        assert said.splitlines()[0].endswith(f"Fingerprint={text}")
    assert run("cert", "fingerprint", "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {Path(line["file"]).name: line["sha256"] for line in lines} == printed
    (here / "ca.crt").write_text("nothing")
    assert run("cert", "fingerprint") == 1
    assert "ca.crt" in capsys.readouterr().err


def test_the_authoritys_key_is_kept_elsewhere(here: Path, tmp_path: Path, capsys) -> None:
    stick = tmp_path / "stick.key"
    (here / "ca.key").rename(stick)
    assert run("cert", "issue", "new") == 1
    assert "only with the authority's key are certificates made" in capsys.readouterr().err
    assert run("cert", "list") == 0
    for command in (["issue", "new"], ["renew", "new"], ["revoke", "new"], ["crl"]):
        assert run("cert", *command, "--ca-key", "stick.key") == 0
    stick.chmod(0o640)
    assert run("cert", "issue", "late", "--ca-key", "stick.key") == 1
    assert "stick.key is a private key that others" in capsys.readouterr().err
    assert not (here / "ca.key").exists() and not (here / "clients/late.key").exists()


def test_a_line_of_the_list_that_is_broken(here: Path, capsys) -> None:
    path = here / "issued.jsonl"
    good = path.read_bytes()
    for bad in (b"{", b"[]", b'{"serial": "x"}', b"\xff", b'"' + b"[" * 100_000):
        path.write_bytes(good + bad + b"\n")
        assert run("cert", "issue", "new") == 1
        assert "issued.jsonl:3: not an entry" in capsys.readouterr().err
        assert path.read_bytes() == good + bad + b"\n"


def test_a_file_that_is_none(here: Path, capsys) -> None:
    (here / "ca.crt").unlink()
    os.mkfifo(here / "ca.crt")
    assert run("cert", "list") == 1
    assert "ca.crt is not a file" in capsys.readouterr().err


def test_somebody_elses_authority(here: Path, capsys) -> None:
    tls = "broker: {tls: {ca: certs/company.crt}}\n"
    (here.parent / "appliance.yaml").write_text(tls)
    assert run("cert", "list") == 1
    assert "not a file of this appliance's own authority" in capsys.readouterr().err


def test_two_at_a_time(here: Path) -> None:
    names = [f"client{number}" for number in range(8)]
    threads = [threading.Thread(target=certs.issue_client, args=(here, name)) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert {*names, "tablet", "server"} == {entry.name for entry in certs.issued(here)}


def test_nothing_secret_in_ps(here: Path) -> None:
    """There is no option that takes a password itself."""
    help_text = subprocess.run(
        [sys.executable, "-m", "appliance", "cert", "issue", "--help"],
        capture_output=True,
        text=True,
        timeout=30,
    ).stdout
    assert "--password-file" in help_text and "--password " not in help_text


# The server's own


def test_the_servers_own_is_not_revoked_without_a_question(here: Path, capsys) -> None:
    before = everything(here)
    [serial] = [
        each.serial_text for each in certs.list_certificates(here) if each.purpose == "server"
    ]
    for what in ("server", serial, str(here / "server.crt")):
        assert run("cert", "revoke", what) == 1
        assert "cert renew server" in (said := capsys.readouterr().err) and "--yes" in said
    assert everything(here) == before
    assert run("cert", "revoke", "server", "--yes") == 0
    key = (here / "server.key").read_bytes()
    assert run("cert", "renew", "server") == 0
    assert (here / "server.key").read_bytes() != key
    capsys.readouterr()


def test_names_are_given_when_the_authority_is_made(tmp_path: Path, capsys) -> None:
    home = tmp_path / "robot"
    assert run("init", "--dir", str(home), "--name", "r2d2.acme.example") == 0
    capsys.readouterr()
    [certificate] = certs.load_certificates(home / "certs/server.crt")
    found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "r2d2.acme.example" in found.get_values_for_type(x509.DNSName)
