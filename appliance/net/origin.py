"""Whether a page of another site has a browser ask: its `Origin` (RFC 6454) tells.

No browser adds a password of MQTT by itself, but it shows a client's certificate, whichever page
has opened the connection.
"""

from __future__ import annotations

import ssl
from collections.abc import Callable, Iterable
from typing import TypeAlias

#: The user that a client's certificate names, None for none. ValueError refuses the client.
CertificateUser: TypeAlias = Callable[[ssl.SSLObject], "str | None"]

#: What such a page is told.
REFUSAL = "a page of another site may not use this client's certificate"


def is_foreign(origins: Iterable[str], host: str, *, tls: bool) -> bool:
    """Whether a page of another site asks; who is no browser sends no Origin.

    On a listener without TLS a proxy may have added that, and its page's Origin says https.
    """
    given = [origin.lower() for origin in origins]
    schemes = ("https",) if tls else ("http", "https")
    return bool(given) and given not in [[f"{scheme}://{host}".lower()] for scheme in schemes]


def misuses_certificate(
    origins: Iterable[str], host: str, tls: ssl.SSLObject | None, certificate_user: CertificateUser
) -> bool:
    """Whether such a page would be logged in by the certificate that the browser shows."""
    if tls is None or not is_foreign(origins, host, tls=True):
        return False
    try:
        return certificate_user(tls) is not None
    except ValueError:  # its login will be refused
        return False
