"""The user that a client's certificate names."""

from __future__ import annotations

from typing import Final, Literal

from cryptography import x509
from cryptography.x509.oid import NameOID

UsernameFrom = Literal["none", "subject", "san"]

_KINDS: Final = (x509.RFC822Name, x509.UniformResourceIdentifier, x509.DNSName)


def username_of(certificate: x509.Certificate, source: Literal["subject", "san"]) -> str:
    """The user name: the subject's one common name, or the first e-mail address among the
    subject's alternative names, else the first URI, else the first DNS name.

    Raises:
        ValueError: there is none, or it cannot be a user name.
    """
    if source == "subject":
        names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
        if len(names) != 1:
            raise ValueError(f"its certificate has {len(names)} common names, and not one")
        name = str(names[0].value)
    else:
        name = _alternative_name(certificate)
    if not name or not name.isprintable():
        raise ValueError("the name in its certificate cannot be a user name")
    return name


def _alternative_name(certificate: x509.Certificate) -> str:
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        found = x509.SubjectAlternativeName([])
    for kind in _KINDS:
        names = found.get_values_for_type(kind)
        if names:
            return str(names[0])
    raise ValueError("its certificate has no e-mail address, URI or DNS name as alternative name")
