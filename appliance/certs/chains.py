"""Certificate chains: from a client's certificate up to an authority that is trusted."""

from __future__ import annotations

import ssl
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, Final

from cryptography import x509

from appliance.certs.files import issued_by

#: Intermediate CAs that are cached, and the most in one chain. Clients send them, and each was
#: verified, so that a stranger cannot fill the cache.
KNOWN: Final = 256
LONGEST: Final = 8


class Chains:
    """Finds the chain of each connection, including those that resume a TLS session.

    A resumed session has only the client's own certificate, without its chain, and OpenSSL verifies
    nothing again. But the session began here, with these authorities: session tickets do not
    outlive the context that has issued them.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[bytes, x509.Certificate] = OrderedDict()

    def of(
        self,
        tls: ssl.SSLObject,
        certificate: x509.Certificate,
        authorities: Sequence[x509.Certificate],
    ) -> list[x509.Certificate]:
        """The client's certificate and the signer of each; the certificate alone when these are not
        known. The last one is trusted, or was when the connection was made."""
        verified = _verified(tls)
        if verified:
            return [certificate, *map(self._remember, verified[1:])]
        return _search(certificate, (*authorities, *self._known.values()), authorities)

    def _remember(self, der: bytes) -> x509.Certificate:
        found = self._known.get(der)
        if found is None:
            found = self._known[der] = x509.load_der_x509_certificate(der)
            if len(self._known) > KNOWN:
                self._known.popitem(last=False)
        else:
            self._known.move_to_end(der)
        return found


def is_anchored(chain: Sequence[x509.Certificate], authorities: Sequence[x509.Certificate]) -> bool:
    """Whether one of the chain is trusted, or signed by one that is."""
    return any(each in authorities for each in chain) or any(
        issued_by(each, authority) for each in chain for authority in authorities
    )


def _verified(tls: ssl.SSLObject) -> list[bytes]:
    """The chain that OpenSSL has verified, in DER; empty in a resumed session."""
    public: Any = getattr(tls, "get_verified_chain", None)  # from Python 3.13 on
    if public is not None:
        return list(public())
    found = tls._sslobj.get_verified_chain()  # type: ignore[attr-defined]
    return [ssl.PEM_cert_to_DER_cert(each.public_bytes()) for each in found or ()]


def _search(
    certificate: x509.Certificate,
    candidates: Sequence[x509.Certificate],
    authorities: Sequence[x509.Certificate],
    left: int = LONGEST,
) -> list[x509.Certificate]:
    """The chain by signatures; the certificate alone when none leads to an authority."""
    if certificate in authorities or not left:
        return [certificate]
    for issuer in candidates:
        if issuer.subject == certificate.issuer and issued_by(certificate, issuer):
            behind = _search(issuer, candidates, authorities, left - 1)
            if behind[-1] in authorities:
                return [certificate, *behind]
    return [certificate]
