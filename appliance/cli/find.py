"""`appliance find`: the appliances on the network, as they announce themselves."""

from __future__ import annotations

import sys
import unicodedata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from appliance.cli.console import CommandError, print_table, warn

if TYPE_CHECKING:
    from appliance.mdns.search import Answers, FoundAppliance

#: What to do when none was found, or not the one that was looked for.
ADVICE = """\
Is it on, and in the same network? Multicast is not routed to others, and some Wi-Fi keeps it back.
Does it announce itself? On the robot, `appliance status` says so in its line mDNS.
Does a firewall, there or here, let UDP port 5353 in?
Its address does as well: appliance sub --host ADDRESS --ca ca.crt …"""

_LONGEST = 40  # characters of a robot's name in the table
_ON_OTHERS = ("Mn", "Me")  # categories of what is written upon the character before
#: Characters that count as printable and show nothing: behind them a name could forge a column.
_BLANKS = "\u115f\u1160\u2800\u3164\uffa0"


def find(
    ca: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Compare the fingerprints with this CA's."),
    ] = None,
    timeout: Annotated[
        float, typer.Option(min=0.5, max=60, metavar="SECONDS", help="How long to listen.")
    ] = 3.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON per appliance.")
    ] = False,
) -> None:
    """List the appliances on the network: robot, addresses, ports and the CA's fingerprint.

    The exit code is 1 when there is none or, with --ca, none of that CA. What is
    listed is what they say of themselves: only a connection with --ca proves it.
    """
    from appliance.host.interfaces import multicast_interfaces
    from appliance.mdns.search import search

    trusted = _fingerprints(ca)
    interfaces = multicast_interfaces()
    if not interfaces:
        raise CommandError("this computer is in no network: no interface with an address")
    progress = _Progress(", ".join(each.name for each in interfaces), timeout)
    try:
        answers = search(interfaces, timeout, progress)
    except OSError as error:
        raise CommandError(f"UDP port 5353 cannot be used: {error.strerror or error}") from None
    finally:
        progress.end()
    found = answers.appliances()
    _print(found, trusted, as_json)
    if answers.is_full:
        warn("more was answered than is read: the list is not complete, and somebody may be")
        warn("flooding this network with forged services")
    if not found:
        raise CommandError(f"no appliance was found within {timeout:g} s\n{ADVICE}")
    if trusted and not any(each.ca in trusted for each in found):
        raise CommandError(f"none of them says that it has the CA of {ca}\n{ADVICE}")


def _fingerprints(ca: Path | None) -> set[str]:
    if ca is None:
        return set()
    from appliance import certs

    try:
        return {each.replace(":", "") for each in certs.fingerprints(ca)}
    except certs.CertificateError as error:
        raise CommandError(str(error)) from None


def _print(found: list[FoundAppliance], trusted: set[str], as_json: bool) -> None:
    if as_json:
        from appliance.ops.logs import json_text

        for each in found:
            entry: dict[str, object] = {
                "robot": each.robot,
                "name": each.name,
                "addresses": [str(address) for address in each.addresses],
                "mqtt": list(each.mqtt),
                "console": list(each.console),
                "ca": each.ca or None,
            }
            if trusted:
                entry["trusted"] = each.ca in trusted
            typer.echo(json_text(entry))
        return
    if not found:
        return
    heads = ("ROBOT", "ADDRESS", "MQTT", "CONSOLE", "CA")
    print_table([heads, *(_row(each, trusted) for each in found)])


def _row(each: FoundAppliance, trusted: set[str]) -> tuple[str, ...]:
    pairs = [each.ca[at : at + 2] for at in range(0, len(each.ca), 2)]
    half = len(pairs) // 2
    ca = (
        f"{':'.join(pairs[:half])} {':'.join(pairs[half:])}" if pairs else "-"
    )  # for narrow screens
    if trusted:
        ca = "the same" if each.ca in trusted else f"ANOTHER: {ca}"
    return (
        _short(one_word(each.robot)),
        ",".join(map(str, each.addresses)),
        ",".join(map(str, each.mqtt)) or "-",
        ",".join(map(str, each.console)) or "-",
        ca,
    )


def _short(text: str) -> str:
    """Cut where it would make all rows too wide to be read."""
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def one_word(text: str) -> str:
    """A stranger's text as one word of a table: what is blank, or not to be seen, is escaped."""
    return "".join(each if _is_seen(each) else _escaped(each) for each in text)


def _is_seen(character: str) -> bool:
    if not character.isprintable() or character == " " or character in _BLANKS:
        return False
    return unicodedata.category(character) not in _ON_OTHERS


def _escaped(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


class _Progress:
    """One line on a terminal, while it goes on."""

    def __init__(self, where: str, seconds: float) -> None:
        self._text = f"listening on {where} for {seconds:g} s"
        self._shown = ""
        self._is_seen = sys.stderr.isatty()

    def __call__(self, answers: Answers) -> None:
        text = f"{self._text}: {len(answers.services)} services"
        if self._is_seen and text != self._shown:
            self._shown = text
            typer.echo(f"\r\x1b[K{text}", nl=False, err=True)

    def end(self) -> None:
        """Remove it."""
        if self._shown:
            typer.echo("\r\x1b[K", nl=False, err=True)
