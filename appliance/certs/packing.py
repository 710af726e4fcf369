"""`python -m appliance.certs.packing`: makes a PKCS #12 file out of what its standard input says.

A program of its own: the rounds that make guesses of the password dear hold the interpreter's lock
for a quarter of a second, in which the appliance would serve nobody.
"""

from __future__ import annotations

import json
import sys
from typing import Final

from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from appliance.certs.export import pkcs12
from appliance.certs.files import key_pem

#: The most bytes of a file: far more than a key and two certificates take.
LONGEST: Final = 64 * 1024

COMMAND: Final = (sys.executable, "-m", "appliance.certs.packing")


def given(
    name: str, key: ec.EllipticCurvePrivateKey, certificate: str, authority: str, password: str
) -> bytes:
    """The input for a key that is in no file, and two certificates in PEM."""
    values = {
        "name": name,
        "key": key_pem(key).decode(),
        "certificate": certificate,
        "authority": authority,
        "password": password,
    }
    return json.dumps(values).encode()


def main() -> None:
    """Make it."""
    values = json.load(sys.stdin)
    key = load_pem_private_key(values["key"].encode(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    certificate, authority = values["certificate"].encode(), values["authority"].encode()
    packed = pkcs12(values["name"], key, certificate, authority, values["password"])
    sys.stdout.buffer.write(packed)


if __name__ == "__main__":
    main()
