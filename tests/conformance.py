"""Which normative statements of MQTT have a test: `python tests/conformance.py [--run]`.

The statements are listed in tests/conformance/statements-VERSION.txt, one a line: its id, who can
show it, and what it says. A test names what it shows:

    @pytest.mark.statement("3.1.1", "MQTT-3.1.0-1", "MQTT-3.1.0-2")

Printed are the statements that a server can show and no test names, and the counts. `--run` also
runs the tests that name one and prints how each statement fares. The exit code is 0 when every
statement that a server can show has a test (with `--run`: has passed, and nothing named it that
did not), 1 when not or when a test names an id that is not listed, and 2 when a list or a
test cannot be read.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

TESTS = Path(__file__).parent

#: Who can show a statement: a server, by what it sends or by how it answers what a client must not
#: send; only a client; only the network between them; or nobody, and the line ends in [the reason].
WHO = ("server", "client", "network", "none")

_LINE = re.compile(rf"(MQTT-\d+(?:[.-]\d+)+) +({'|'.join(WHO)}) +(\S.*)")

#: Values of a test's parameter `version`, and the standard that it then is about.
_PROTOCOL_LEVELS = {4: "3.1.1", 5: "5.0"}

Outcome = Literal["passed", "skipped", "failed"]


@dataclass
class Statement:
    """One normative statement, and the tests that name it with their outcomes (None: not run)."""

    id: str
    who: str
    text: str
    tests: dict[str, Outcome | None] = field(default_factory=dict)

    @property
    def outcome(self) -> str:
        """That of its tests together; a skipped one shows nothing, but does no harm to others."""
        outcomes = set(self.tests.values())
        for outcome in ("failed", None, "passed", "skipped"):
            if outcome in outcomes:
                return outcome or "not run"
        return "no test"


Table = dict[str, dict[str, Statement]]

_WELL = (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)


def read_statements(directory: Path) -> Table:
    """The statements by version and id, in the order of the standard.

    Raises:
        ValueError: a line is none, an id is listed twice, or a reason is missing.
    """
    table: Table = {}
    for path in sorted(directory.glob("statements-*.txt")):
        statements = table.setdefault(path.stem.removeprefix("statements-"), {})
        for number, line in enumerate(path.read_text().splitlines(), 1):
            if not line or line.startswith("#"):
                continue
            match = _LINE.fullmatch(line)
            if match is None:
                raise ValueError(f"{path.name}:{number}: no statement: {line!r}")
            statement = Statement(match[1], match[2], match[3])
            if statement.id in statements:
                raise ValueError(f"{path.name}:{number}: {statement.id} is listed twice")
            if statement.who == "none" and not re.search(r"\[.+\]$", statement.text):
                raise ValueError(f"{path.name}:{number}: why can nobody show {statement.id}?")
            statements[statement.id] = statement
    return table


def named_by(item: pytest.Item) -> Iterator[tuple[str, str]]:
    """Version and id of each statement that the test names.

    One that is run for both versions names those of 3.1.1 in its runs with 3.1.1 only.
    """
    callspec = getattr(item, "callspec", None)
    level = callspec.params.get("version") if callspec is not None else None
    of_run = _PROTOCOL_LEVELS.get(level) if isinstance(level, int) else None
    for marker in item.iter_markers("statement"):
        version, *ids = marker.args
        if of_run in (None, version):
            for statement_id in ids:
                yield version, statement_id


class Plugin:
    """Takes the markers off the tests that pytest finds, and how those tests fared."""

    def __init__(self, table: Table) -> None:
        self.table = table
        #: test, version and id of what is not listed
        self.unknown: list[tuple[str, str, str]] = []
        self._statements: dict[str, list[Statement]] = {}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave only the tests that name a statement."""
        for item in items:
            found = self._statements.setdefault(item.nodeid, [])
            for version, statement_id in named_by(item):
                statement = self.table.get(version, {}).get(statement_id)
                if statement is None:
                    self.unknown.append((item.nodeid, version, statement_id))
                else:
                    statement.tests[item.nodeid] = None
                    found.append(statement)
        items[:] = [item for item in items if self._statements[item.nodeid]]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the worst of a test's three phases."""
        for statement in self._statements.get(report.nodeid, ()):
            before = statement.tests[report.nodeid]
            if report.outcome == "failed" or before in (None, "passed"):
                statement.tests[report.nodeid] = report.outcome


def ask_pytest(plugin: Plugin, tests: Path, *, run: bool) -> str | None:
    """Collect the tests that name statements, and `run` them; returns what went wrong.

    A failed test is not what is meant by wrong.
    """
    candidates = sorted([*tests.glob("test_*.py"), *tests.glob("*/test_*.py")])
    files = [path for path in candidates if "mark.statement" in path.read_text()]
    if not files:
        return None
    arguments = ["-p", "no:cacheprovider", *map(str, files)]
    if run:
        code = pytest.main(arguments, [plugin])
        return None if code in (*_WELL, pytest.ExitCode.TESTS_FAILED) else f"pytest: {code!r}"
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = pytest.main(["--collect-only", *arguments], [plugin])
    return None if code in _WELL else output.getvalue()


def report(plugin: Plugin, *, run: bool) -> tuple[str, bool]:
    """The table as text, and whether all is well."""
    lines: list[str] = []
    well = not plugin.unknown
    for version, statements in plugin.table.items():
        owed = [statement for statement in statements.values() if statement.who == "server"]
        missing = [statement for statement in owed if not statement.tests]
        lines.append(
            f"MQTT {version}: {len(statements)} statements, {len(owed)} that a server can show; "
            f"{len(owed) - len(missing)} of {len(owed)} have a test"
        )
        if run:
            shown = [s for s in statements.values() if s.tests or s.who == "server"]
            lines += _rows(shown, outcomes=True)
            bad = [s for s in shown if s.outcome != "passed"]
            passed = sum(statement.outcome == "passed" for statement in owed)
            lines.append(f"  {passed} of {len(owed)} passed")
            for statement in bad:
                failed = [test for test, outcome in statement.tests.items() if outcome != "passed"]
                lines += [f"  {statement.id} {statement.tests[test]}: {test}" for test in failed]
            well = well and not bad
        elif missing:
            lines.append("  No test names")
            lines += _rows(missing)
        well = well and not missing
        lines.append("")
    if plugin.unknown:
        lines.append("Tests name what is not listed")
        lines += [f"  {version} {name}: {test}" for test, version, name in plugin.unknown]
        lines.append("")
    return "\n".join(lines), well


def _rows(statements: Iterable[Statement], *, outcomes: bool = False) -> Iterator[str]:
    for statement in statements:
        start = f"  {statement.id:<16}"
        if outcomes:
            start += f"{statement.outcome:<8}{len(statement.tests):>4}  "
        yield textwrap.fill(
            statement.text, 100, initial_indent=start, subsequent_indent=" " * len(start)
        )


def main(arguments: list[str] | None = None, tests: Path = TESTS) -> int:
    """Print the table; returns the exit code."""
    parser = argparse.ArgumentParser(description="which statements of the standards have a test")
    parser.add_argument("--run", action="store_true", help="run these tests as well")
    run: bool = parser.parse_args(arguments).run
    try:
        plugin = Plugin(read_statements(tests / "conformance"))
    except ValueError as error:
        print(error)
        return 2
    wrong = ask_pytest(plugin, tests, run=run)
    if wrong is not None:
        print(wrong)
        return 2
    text, well = report(plugin, run=run)
    print(f"\n{text}" if run else text, end="")
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
