"""Renews the server's certificate, so that it is valid for this computer's names and addresses."""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

from cryptography import x509

from appliance.certs.addresses import Address, local_names
from appliance.certs.authority import issue_server, issued, may_not_sign
from appliance.certs.constraints import outside
from appliance.certs.contexts import EXPIRES_SOON, TlsFiles
from appliance.certs.files import issued_by, load_certificates, usable_time
from appliance.host.clock import is_unset

log = logging.getLogger("appliance.certs")

#: The most names, and the most addresses, in one certificate. Those of the certificate before stay
#: while there is room, because an interface that is down now comes up again.
_MOST: Final = 64


def keep_server_certificate(files: TlsFiles) -> str:
    """Renew the server's certificate if that is due; returns the reason, or nothing.

    It is due 30 days before its expiry, when this computer has a name or an address that is not in
    it, when it was made while the clock was ahead, and, with a new key, when it was revoked. Only
    certificates that `appliance init` makes are renewed; those of another CA are used as they are.
    This may wait for the resolver, see `local_names`.

    Raises:
        CertificateError: it is due and cannot be done, or a file cannot be used.
        OSError: a file cannot be written.
    """
    directory = files.certificate.parent
    if not _is_ours(files, directory):
        return ""
    certificate = load_certificates(files.certificate)[0]
    authority = load_certificates(directory / "ca.crt")[0]
    names, addresses = local_names()
    names, addresses = names[:_MOST], addresses[:_MOST]
    refused = outside(authority, [*names, *addresses])
    if refused:
        _warn_of_names_outside(may_not_sign(directory, refused))
        names = [name for name in names if name not in refused]
        addresses = [address for address in addresses if str(address) not in refused]
    old_names, old_addresses = _subjects(certificate)
    reason = ""
    if any(e.serial == certificate.serial_number and e.revoked for e in issued(directory)):
        reason = "it was revoked"
    elif _begins_later(certificate, authority):
        reason = f"it was not valid before {certificate.not_valid_before_utc:%Y-%m-%d}"
    elif _ends_soon(certificate, authority):
        reason = f"it would have ended on {certificate.not_valid_after_utc:%Y-%m-%d}"
    else:
        new = [str(n) for n in (*names, *addresses) if n not in (*old_names, *old_addresses)]
        if new:
            reason = f"this computer is also {', '.join(new)}"
    if reason:
        issue_server(
            directory,
            list(dict.fromkeys([*names, *old_names]))[:_MOST],
            list(dict.fromkeys([*addresses, *old_addresses]))[:_MOST],
        )
    return reason


def server_outside(files: TlsFiles) -> str:
    """An error text if the CA may not sign for all names and addresses of this computer."""
    directory = files.certificate.parent
    if not _is_ours(files, directory):
        return ""
    names, addresses = local_names()
    refused = outside(load_certificates(directory / "ca.crt")[0], [*names, *addresses])
    return may_not_sign(directory, refused) if refused else ""


def server_revoked(files: TlsFiles) -> str:
    """An error text if the server's certificate is one of ours and was revoked; otherwise empty."""
    directory = files.certificate.parent
    if not _is_ours(files, directory):
        return ""
    serial = load_certificates(files.certificate)[0].serial_number
    if not any(entry.serial == serial and entry.revoked for entry in issued(directory)):
        return ""
    return (
        f"{files.certificate} was revoked: clients that look at ca.crl refuse it. The running "
        "appliance makes one with a new key, if it has ca.key; `appliance cert renew server` does, "
        "too (--ca-key FILE)"
    )


@functools.cache
def _warn_of_names_outside(text: str) -> None:
    log.warning("%s", text)


def _is_ours(files: TlsFiles, directory: Path) -> bool:
    """Whether `appliance init` makes these files, and the certificate is of that authority."""
    if (files.certificate, files.key) != (directory / "server.crt", directory / "server.key"):
        return False
    authority = directory / "ca.crt"
    if not authority.exists():
        return False
    return issued_by(load_certificates(files.certificate)[0], load_certificates(authority)[0])


def _ends_soon(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    end = certificate.not_valid_after_utc
    # A certificate that expires with its CA would not be valid for longer if it were renewed.
    return end - usable_time() < EXPIRES_SOON and end < authority.not_valid_after_utc


def _begins_later(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    now = datetime.now(timezone.utc)
    # If the clock is before the CA was made, the clock is wrong and not the certificate.
    is_right = not is_unset(now) and now >= authority.not_valid_before_utc
    return is_right and now < certificate.not_valid_before_utc


def _subjects(certificate: x509.Certificate) -> tuple[Sequence[str], Sequence[Address]]:
    try:
        found = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return [], []
    addresses = found.get_values_for_type(x509.IPAddress)
    return found.get_values_for_type(x509.DNSName), [a for a in addresses if isinstance(a, Address)]
