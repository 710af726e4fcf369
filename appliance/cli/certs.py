"""The command group `appliance cert`: certificates of clients and of the server."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from appliance.cli.console import (
    CommandError,
    ConfigOption,
    GenerateOption,
    PasswordFileOption,
    load,
    new_password,
    shown,
)

cert_app = typer.Typer(no_args_is_help=True, help="Certificates of clients and of the server.")

CaKeyOption = Annotated[
    Path | None,
    typer.Option("--ca-key", metavar="FILE", help="The CA's key, when it is stored elsewhere."),
]


@cert_app.command("issue")
def cert_issue(
    name: Annotated[str, typer.Argument(help="The client's name.")],
    pkcs12: Annotated[
        bool, typer.Option("--pkcs12", help="Also write NAME.p12, for phones, with a password.")
    ] = False,
    bundle: Annotated[
        bool,
        typer.Option(
            "--bundle", help="Also write NAME.pem: key, certificate and ca.crt in one file."
        ),
    ] = False,
    password_file: PasswordFileOption = None,
    generate: GenerateOption = False,
    ca_key: CaKeyOption = None,
    config: ConfigOption = None,
) -> None:
    """Make a key and a certificate for a client; options also export those that it has."""
    if (password_file or generate) and not pkcs12:
        raise typer.BadParameter("a password is for --pkcs12")
    with _directory(config) as directory:
        from appliance import certs

        certificate = directory / "clients" / f"{name}.crt"
        there = certificate in {e.file for e in certs.list_certificates(directory) if e.usable}
        if there and not (pkcs12 or bundle):
            raise CommandError(
                f"{name} has a certificate, {shown(certificate)}; `appliance cert renew {name}` "
                f"makes it anew, after `appliance cert revoke {name}` this makes one with a new key"
            )
        # Ask for it before anything is written, because the user may cancel.
        password = new_password(f"{name}.p12", password_file, generate) if pkcs12 else None
        if password is not None:
            certs.check_password(password)
        if not there:
            certs.issue_client(directory, name, ca_key)
            typer.echo(f"made  {shown(certificate)}, {shown(certificate.with_suffix('.key'))}")
        if password is not None:
            typer.echo(f"made  {shown(certs.write_pkcs12(directory, name, password))}")
        if bundle:
            typer.echo(f"made  {shown(certs.write_bundle(directory, name))}")
        if generate:
            typer.secho(f"password {password}\nThis is the only time that it is shown.", bold=True)


@cert_app.command("sign")
def cert_sign(
    request: Annotated[str, typer.Argument(metavar="FILE", help="The request; - is stdin.")],
    name: Annotated[
        str | None, typer.Option(help="The client's name; default: the request's common name.")
    ] = None,
    ca_key: CaKeyOption = None,
    config: ConfigOption = None,
) -> None:
    """Make a certificate from a request (PKCS #10); the key stays on the device."""
    with _directory(config) as directory:
        from appliance import certs

        data = _read_request(request, certs.REQUEST_SIZE)
        made = certs.sign(directory, data, name, ca_key)
        typer.echo(f"made  {shown(made)}, for client {made.stem!r}")


def _read_request(file: str, limit: int) -> bytes:
    if file == "-":
        return sys.stdin.buffer.read(limit + 1)
    from appliance.host.owners import acting_as_caller

    with acting_as_caller(), Path(file).open("rb") as opened:
        return opened.read(limit + 1)


@cert_app.command("revoke")
def cert_revoke(
    what: Annotated[
        str, typer.Argument(metavar="NAME|SERIAL|FILE", help="As `cert list` shows them.")
    ],
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before revoking the server's own certificate.")
    ] = False,
    ca_key: CaKeyOption = None,
    config: ConfigOption = None,
) -> None:
    """Revoke a client's certificates; a client that is connected is disconnected."""
    with _directory(config) as directory:
        from appliance import certs

        servers = [each for each in certs.list_certificates(directory) if each.purpose == "server"]
        if not yes and any(what in (e.name, e.serial_text, str(e.file)) for e in servers):
            _ask_about_the_server()
        for entry in certs.revoke(directory, what, ca_key):
            typer.echo(f"revoked  {entry.name}  {entry.serial_text}")
        typer.echo(f"made  {shown(directory / 'ca.crl')}")


def _ask_about_the_server() -> None:
    question = (
        "This is the server's own certificate: clients that look at ca.crl will not connect until "
        "there is one with a new key. The running appliance makes it by itself if it has ca.key, "
        "else `appliance cert renew server --ca-key FILE` does."
    )
    if not sys.stdin.isatty():
        raise CommandError(f"{question} To revoke it, give the option --yes")
    typer.echo(question)
    typer.confirm("Revoke it?", abort=True)


@cert_app.command("renew")
def cert_renew(
    what: Annotated[
        str, typer.Argument(metavar="NAME|server|all", help="A client, the server, or all.")
    ],
    ca_key: CaKeyOption = None,
    config: ConfigOption = None,
) -> None:
    """Renew a certificate, with the same key and names."""
    with _directory(config) as directory:
        from appliance import certs

        names = [what]
        if what == "all":
            entries = certs.list_certificates(directory)
            names = [e.name for e in entries if e.purpose != "authority" and e.usable and e.file]
        for name in names:
            certs.renew(directory, name, ca_key)
            typer.echo(f"renewed  {name}")


@cert_app.command("list")
def cert_list(
    every: Annotated[
        bool, typer.Option("--all", help="Also expired and replaced certificates.")
    ] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON per certificate.")
    ] = False,
    config: ConfigOption = None,
) -> None:
    """List the certificates, their purposes, and for how many days they are valid."""
    with _directory(config) as directory:
        from appliance import certs

        shown_states = ("valid", "revoked")
        entries = [
            e for e in certs.list_certificates(directory) if every or e.state in shown_states
        ]
    if as_json:
        for entry in entries:
            typer.echo(json.dumps(entry.as_json()))
        return
    width = max(len(entry.name) for entry in entries)
    for entry in entries:
        state = f"{entry.days} days left" if entry.usable else entry.state
        colour = "yellow" if entry.ends_soon else None if entry.usable else "red"
        typer.echo(f"{entry.name:{width}}  {entry.purpose:<9}  ", nl=False)
        typer.secho(f"{state:<14}", fg=colour, nl=False)
        typer.echo(f"  {entry.expires:%Y-%m-%d}  {entry.serial_text}")


@cert_app.command("fingerprint")
def cert_fingerprint(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON per certificate.")
    ] = False,
    config: ConfigOption = None,
) -> None:
    """SHA-256 of the server's certificate and of its CA's, to compare with what devices show."""
    settings = load(config)
    from appliance import certs

    tls = settings.broker.tls
    try:
        found = [
            (tls.certificate, certs.fingerprints(tls.certificate)[0]),
            *((tls.ca, text) for text in certs.fingerprints(tls.ca)),
        ]
    except certs.CertificateError as error:
        raise CommandError(str(error)) from None
    width = max(len(file.name) for file, _ in found)
    for file, text in found:
        if as_json:
            typer.echo(json.dumps({"file": str(file), "sha256": text}))
        else:
            typer.echo(f"{file.name:{width}}  {text}")


@cert_app.command("crl")
def cert_crl(ca_key: CaKeyOption = None, config: ConfigOption = None) -> None:
    """Renew ca.crl, the revocation list, for programs that require a recent one."""
    with _directory(config) as directory:
        from appliance import certs

        count = certs.write_crl(directory, ca_key)
        typer.echo(f"made  {shown(directory / 'ca.crl')}, which revokes {count}")


@contextmanager
def _directory(config: Path | None) -> Iterator[Path]:
    """The directory of the CA; errors in it, or in the request, become a CommandError."""
    settings = load(config)
    from appliance.certs import CertificateError
    from appliance.certs.settings import authority_directory
    from appliance.host.owners import OwnerError, acting_for

    try:
        directory = authority_directory(settings.broker)
        if directory is None:
            raise CommandError(
                "broker.tls.ca or broker.tls.crl is not a file of this appliance's own authority "
                "(ca.crt, ca.crl): clients get their certificates where these files come from"
            )
        with acting_for(settings.file, directory / "ca.crt"):
            yield directory
    except (CertificateError, OwnerError) as error:
        raise CommandError(str(error)) from None
