"""The integrity of a PKCS #12 file under as many rounds as its encryption (RFC 7292).

The library that makes the files computes their MAC with 2,048 rounds, whatever it is told. Who has
such a file guesses its password against the MAC, and never pays for the rounds of the encryption.
"""

from __future__ import annotations

import codecs
import hashlib
import hmac
import secrets
from typing import Final

_SEQUENCE: Final = 0x30
_INTEGER: Final = b"\x02"
_OCTETS: Final = b"\x04"
#: AlgorithmIdentifier of SHA-1, which all devices know: 1.3.14.3.2.26, NULL.
_SHA1: Final = bytes.fromhex("300906052b0e03021a0500")
_SALT_SIZE: Final = 8
#: The purpose of a derived key, RFC 7292 appendix B.3: integrity.
_INTEGRITY: Final = b"\x03"


def with_rounds(file: bytes, password: str, rounds: int) -> bytes:
    """The same PFX, with a new MAC (HMAC of SHA-1) of two rounds or more in place of its own.

    ValueError when it is no PFX in DER with password integrity.
    """
    pfx = _content(file, 0, _SEQUENCE)
    version_end = _end(pfx, 0)
    safe_end = _end(pfx, version_end)
    safe = pfx[version_end:safe_end]  # SEQUENCE { data, [0] { OCTET STRING { what is signed } } }
    inside = _content(safe, 0, _SEQUENCE)
    signed = _content(_content(inside, _end(inside, 0), 0xA0), 0, _OCTETS[0])
    salt = secrets.token_bytes(_SALT_SIZE)
    digest = hmac.digest(derived_key(password, salt, rounds), signed, "sha1")
    digest_info = _encoded(b"\x30", _SHA1 + _encoded(_OCTETS, digest))
    count = _encoded(_INTEGER, rounds.to_bytes(rounds.bit_length() // 8 + 1, "big"))
    mac = _encoded(b"\x30", digest_info + _encoded(_OCTETS, salt) + count)
    return _encoded(b"\x30", pfx[:safe_end] + mac)


def derived_key(password: str, salt: bytes, rounds: int) -> bytes:
    """The key of the MAC, RFC 7292 appendix B.2 with SHA-1: one block is all of it."""
    size = hashlib.sha1().block_size
    # Not `encode`, which loads a module: root that acts as the service's user may not find it.
    written = codecs.utf_16_be_encode(password)[0] + b"\0\0"
    digest = hashlib.sha1(_INTEGRITY * size + _filled(salt, size) + _filled(written, size)).digest()
    for _ in range(rounds - 1):
        digest = hashlib.sha1(digest).digest()
    return digest


def _filled(data: bytes, size: int) -> bytes:
    """Repeated up to a multiple of a block."""
    length = -(-len(data) // size) * size
    return (data * (length // len(data) + 1))[:length]


def _encoded(tag: bytes, content: bytes) -> bytes:
    length = len(content)
    if length < 0x80:
        return tag + bytes([length]) + content
    octets = length.to_bytes((length.bit_length() + 7) // 8, "big")
    return tag + bytes([0x80 | len(octets)]) + octets + content


def _content(data: bytes, start: int, tag: int) -> bytes:
    """The content of the element there, which has this tag."""
    if data[start : start + 1] != bytes([tag]):
        raise ValueError("this is no PKCS #12 file")
    return data[_header(data, start) : _end(data, start)]


def _header(data: bytes, start: int) -> int:
    """Where the content of the element begins."""
    if start + 2 > len(data):
        raise ValueError("this PKCS #12 file is cut off")
    first = data[start + 1]
    return start + 2 + (first & 0x7F if first & 0x80 else 0)


def _end(data: bytes, start: int) -> int:
    """Where the element ends."""
    begin = _header(data, start)
    first = data[start + 1]
    length = int.from_bytes(data[start + 2 : begin], "big") if first & 0x80 else first
    if begin + length > len(data):
        raise ValueError("this PKCS #12 file is cut off")
    return begin + length
