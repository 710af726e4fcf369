"""The client's side of TLS: a context from the files as they are now, and its errors in words."""

from __future__ import annotations

import ssl
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from appliance.config.urls import ServerUrl
from appliance.upstream.dial_error import DialError
from appliance.upstream.rules import UpstreamTls

#: OpenSSL's codes for a certificate of another name (X509_V_ERR_HOSTNAME_MISMATCH, and of an
#: e-mail and an IP address).
_MISMATCH = (62, 63, 64)

#: Its codes for a chain that does not lead to a trusted CA.
_UNTRUSTED = (2, 18, 19, 20, 21)

_NOT_YET_VALID, _EXPIRED, _REVOKED = 9, 10, 23


def expected_name(server: ServerUrl, tls: UpstreamTls) -> str:
    """Whom the server's certificate has to be for: a name, or an IP address without its zone."""
    return tls.server_name or server.host.partition("%")[0]


def make_context(tls: UpstreamTls, *, check_name: bool = True) -> ssl.SSLContext:
    """The context for one connection; reads files, so not in the event loop. Raises DialError."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_COMPRESSION
    context.check_hostname = check_name
    if tls.alpn:
        context.set_alpn_protocols(list(tls.alpn))
    if tls.ca is None:
        context.load_default_certs()
        if not context.cert_store_stats()["x509"] and not _has_directory():
            text = "this computer has no CA certificates (ca-certificates): name one with tls.ca"
            raise DialError("files", text)
    else:
        # A company's CA is often an intermediate one, or the broker's certificate itself.
        context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
        _load("tls.ca", tls.ca, lambda path: context.load_verify_locations(path))
    if tls.certificate is not None:
        _load_pair(context, tls.certificate, tls.key)
    return context


def _has_directory() -> bool:
    """Whether there is a directory of CAs, which OpenSSL reads when it needs one."""
    path = ssl.get_default_verify_paths().capath
    return path is not None and any(Path(path).iterdir())


def _load(key: str, path: Path, load: Any) -> None:
    try:
        path.read_bytes()  # its errors say more than OpenSSL's
        load(path)
    except ssl.SSLError:
        raise DialError("files", f"{path} ({key}) has no certificate in PEM format") from None
    except OSError as error:
        text = f"{path} ({key}) cannot be read: {error.strerror or error}"
        raise DialError("files", text) from None


def _load_pair(context: ssl.SSLContext, certificate: Path, key: Path | None) -> None:
    def locked() -> str:
        raise ValueError  # else OpenSSL would ask on the terminal

    for name, path in (("tls.certificate", certificate), ("tls.key", key)):
        if path is not None:
            _load(name, path, lambda path: None)
    try:
        context.load_cert_chain(certificate, key, password=locked)
    except ValueError:
        text = f"{key or certificate} is encrypted with a password; it has to be without one"
        raise DialError("files", text) from None
    except ssl.SSLError as error:
        pair = f"{certificate} and {key}" if key is not None else str(certificate)
        why = str(error.reason or error).replace("_", " ").lower()
        text = f"{pair} are not a certificate and its key in PEM format ({why})"
        raise DialError("files", text) from None


def names_in(certificate: Mapping[str, Any] | None) -> list[str]:
    """The names and addresses that a verified certificate (`getpeercert`) is for."""
    if not certificate:
        return []
    kinds = ("DNS", "IP Address")
    return [str(name) for kind, name in certificate.get("subjectAltName", ()) if kind in kinds]


def is_other_name(error: BaseException) -> bool:
    """Whether a handshake failed because the certificate is valid, but for another name."""
    return isinstance(error, ssl.SSLCertVerificationError) and error.verify_code in _MISMATCH


def name_refusal(wanted: str, names: list[str]) -> str:
    """Why a certificate of other names is refused."""
    has = f"is for {_listed(names)}" if names else "has no name in it (subjectAltName)"
    return (
        f"the broker's certificate {has}, not for {wanted}: dial it by that name, or write the "
        "name that is in the certificate to tls.server_name"
    )


def _listed(names: list[str]) -> str:
    shown = ", ".join(f"{name:.80}" for name in names[:5])
    return f"{shown} and {len(names) - 5} others" if len(names) > 5 else shown


def tls_refusal(error: BaseException, server: ServerUrl, tls: UpstreamTls) -> str:
    """Why a handshake failed, or a TLS connection ended, in words."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return _verify_refusal(error, server, tls)
    detail = getattr(error, "reason", None) or str(error) or type(error).__name__
    text = str(detail).replace("_", " ").lower()
    name = expected_name(server, tls)
    plain = "ws:// or mqtt" if server.websocket else "mqtt:// or ws"
    if any(
        part in text
        for part in ("wrong version", "http request", "packet length", "unknown protocol")
    ):
        at = server.authority
        return f"what answers at {at} is not TLS; is the port one for {plain}://? ({text})"
    if "protocol version" in text or "unsupported protocol" in text:
        return f"the broker does not know TLS 1.2 or 1.3, and older ones are not safe ({text})"
    if "application protocol" in text:
        return f"the broker knows none of the protocols in tls.alpn: {', '.join(tls.alpn)} ({text})"
    if "unrecognized name" in text:
        return f"the broker does not know the name {name}; see tls.server_name ({text})"
    alert = any(part in text for part in ("certificate", "unknown ca", "access denied"))
    if (alert or "handshake failure" in text) and tls.certificate is None:
        return f"the broker may want a client certificate: tls.certificate and tls.key ({text})"
    if alert or "handshake failure" in text:
        return f"the broker does not accept the certificate {tls.certificate} ({text})"
    if isinstance(error, ConnectionError) or "eof" in text:
        return (
            f"the broker closed the connection during the TLS handshake; is the port one for "
            f"{plain}://? ({text})"
        )
    return f"TLS: {text}"


def _verify_refusal(
    error: ssl.SSLCertVerificationError, server: ServerUrl, tls: UpstreamTls
) -> str:
    code = error.verify_code
    today = f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M} UTC"
    clock = f"by this computer's clock it is {today}"
    if code in _MISMATCH:
        return name_refusal(expected_name(server, tls), [])
    if code == _EXPIRED:
        return f"the broker's certificate, or one of those that vouch for it, has expired; {clock}"
    if code == _NOT_YET_VALID:
        return f"the broker's certificate is not valid yet; {clock}: is it right?"
    if code == _REVOKED:
        return "the broker's certificate was revoked"
    if code in _UNTRUSTED:
        whom = "this computer trusts; name the broker's CA with tls.ca" if tls.ca is None else ""
        whom = whom or f"{tls.ca} (tls.ca) has"
        return f"the broker's certificate is of no authority that {whom} ({error.verify_message})"
    return f"the broker's certificate is not accepted: {error.verify_message}"
