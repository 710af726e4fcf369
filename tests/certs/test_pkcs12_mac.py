"""The MAC of a PKCS #12 file, of as many rounds as its encryption."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    pkcs12,
)

from appliance import certs
from appliance.certs import export
from appliance.certs.pkcs12_mac import with_rounds


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    certs.create_authority(tmp_path, "robot")
    certs.issue_client(tmp_path, "carol")
    return tmp_path


@pytest.mark.parametrize("password", ["long enough", "", "ä€\u8a8d\U0001f916" * 40])
@pytest.mark.parametrize("rounds", [2, 127, 128, 2048, 70_000])
def test_another_number_of_rounds(directory: Path, password: str, rounds: int):
    """OpenSSL, which the library reads with, is the oracle: it looks at the MAC first."""
    key = certs.load_key(directory / "clients/carol.key")
    encryption = BestAvailableEncryption(password.encode() or b"other")
    (certificate,) = certs.load_certificates(directory / "clients/carol.crt")
    file = pkcs12.serialize_key_and_certificates(b"carol", key, certificate, None, encryption)
    again = with_rounds(file, password or "other", rounds)
    assert again != file
    opened = pkcs12.load_pkcs12(again, password.encode() or b"other")
    assert opened.cert is not None and opened.cert.certificate == certificate
    with pytest.raises(ValueError):
        pkcs12.load_pkcs12(again, b"another one")
    with pytest.raises(ValueError):
        pkcs12.load_pkcs12(with_rounds(file, "another one", rounds), password.encode() or b"other")


def test_what_devices_get(directory: Path):
    """A guess of the password costs as many rounds at the MAC as at the key."""
    path = certs.write_pkcs12(directory, "carol", "long enough")
    told = subprocess.run(
        [
            "openssl",
            "pkcs12",
            "-legacy",
            "-info",
            "-in",
            path,
            "-noout",
            "-passin",
            "pass:long enough",
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stderr
    rounds = [int(number) for number in re.findall(r"Iteration (\d+)", told)]
    assert len(rounds) == 3 and set(rounds) == {export._ROUNDS}, told
    assert "MAC: sha1" in told


@pytest.mark.parametrize("file", [b"", b"0", b"0\0", b"0\x82", b"0\x03\x02\x01\x03", b"\x31\x00"])
def test_what_is_no_such_file(file: bytes):
    with pytest.raises(ValueError):
        with_rounds(file, "long enough", 1)
