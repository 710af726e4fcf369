"""Every normative statement that a server can show has a test, and the tool that says so."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conformance import TESTS, main
from waiting import PATIENCE


def test_every_statement_that_a_server_can_show_has_a_test() -> None:
    tool = [sys.executable, TESTS / "conformance.py"]
    done = subprocess.run(
        tool, capture_output=True, text=True, cwd=TESTS.parent, timeout=4 * PATIENCE
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stdout.splitlines() if line]
    assert [line.partition(":")[0] for line in lines] == ["MQTT 3.1.1", "MQTT 5.0"]


# --- the tool

STATEMENTS = """\
# Comments and empty lines are none.

MQTT-1.0.0-1   server  the first
MQTT-1.0.0-2   server  the second
MQTT-1.0.0-3   server  the third
MQTT-1.0.0-4   client  the fourth
MQTT-1.0.0-5   none    the fifth [nobody looks]
"""

ELSEWHERE = """\
import sys
from pathlib import Path
from conformance import main
sys.exit(main(sys.argv[2:], Path(sys.argv[1])))
"""


class Suite:
    """A small standard called 9, and tests for it."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        (directory / "conformance").mkdir(parents=True)
        self.list("9", STATEMENTS)

    def list(self, version: str, statements: str) -> None:
        (self.directory / f"conformance/statements-{version}.txt").write_text(statements)

    def write(self, name: str, text: str) -> None:
        (self.directory / name).write_text(f"import pytest\n\n{text}\n")

    def look(self, *arguments: str) -> tuple[int, list[str]]:
        """The tool's exit code and the lines that it prints."""
        done = subprocess.run(
            [sys.executable, "-c", ELSEWHERE, self.directory, *arguments],
            cwd=self.directory.parent,
            env=os.environ | {"PYTHONPATH": str(TESTS), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=100,
        )
        return done.returncode, done.stdout.splitlines()


@pytest.fixture
def tests(tmp_path: Path) -> Suite:
    return Suite(tmp_path / "tests")


def names(*ids: str, version: str = "9") -> str:
    return f"@pytest.mark.statement({', '.join(map(repr, (version, *ids)))})"


def test_what_no_test_names_is_printed(tests: Suite) -> None:
    tests.write("test_one.py", 'pytestmark = pytest.mark.statement("9", "MQTT-1.0.0-1")')
    tests.write("conformance/test_two.py", f"{names('MQTT-1.0.0-3')}\ndef test(): ...")
    assert tests.look() == (
        1,
        [
            "MQTT 9: 5 statements, 3 that a server can show; 1 of 3 have a test",
            "  No test names",
            "  MQTT-1.0.0-1    the first",  # a module without a test shows nothing
            "  MQTT-1.0.0-2    the second",
        ],
    )


def test_all_named_is_well(tests: Suite) -> None:
    tests.write(
        "test_one.py",
        'pytestmark = pytest.mark.statement("9", "MQTT-1.0.0-1")\n'
        f"{names('MQTT-1.0.0-2')}\n{names('MQTT-1.0.0-3', 'MQTT-1.0.0-4')}\ndef test(): ...",
    )
    assert tests.look() == (
        0,
        ["MQTT 9: 5 statements, 3 that a server can show; 3 of 3 have a test"],
    )


def test_what_is_not_listed_is_printed(tests: Suite) -> None:
    tests.list("9", "")
    tests.write(
        "test_one.py",
        f"{names('MQTT-1.0.0-9')}\ndef test_one(): ...\n"
        f"{names('MQTT-1.0.0-1', version='8')}\ndef test_two(): ...",
    )
    code, lines = tests.look()
    assert code == 1
    assert lines[-3:] == [
        "Tests name what is not listed",
        "  9 MQTT-1.0.0-9: tests/test_one.py::test_one",
        "  8 MQTT-1.0.0-1: tests/test_one.py::test_two",
    ]


def test_run_says_how_each_statement_fares(tests: Suite) -> None:
    tests.write(
        "test_one.py",
        f"{names('MQTT-1.0.0-1')}\ndef test_right(): ...\n"
        f"{names('MQTT-1.0.0-1', 'MQTT-1.0.0-2')}\ndef test_wrong(): assert 0\n"
        f"{names('MQTT-1.0.0-3')}\ndef test_not_now(): pytest.skip('not now')\n"
        f"{names('MQTT-1.0.0-4')}\ndef test_client(): ...\n",
    )
    code, lines = tests.look("--run")
    assert code == 1
    start = lines.index("MQTT 9: 5 statements, 3 that a server can show; 3 of 3 have a test")
    assert lines[start + 1 :] == [
        "  MQTT-1.0.0-1    failed     2  the first",
        "  MQTT-1.0.0-2    failed     1  the second",
        "  MQTT-1.0.0-3    skipped    1  the third",
        "  MQTT-1.0.0-4    passed     1  the fourth",
        "  0 of 3 passed",
        "  MQTT-1.0.0-1 failed: tests/test_one.py::test_wrong",
        "  MQTT-1.0.0-2 failed: tests/test_one.py::test_wrong",
        "  MQTT-1.0.0-3 skipped: tests/test_one.py::test_not_now",
    ]


def test_a_run_with_one_version_shows_nothing_of_the_other(tests: Suite) -> None:
    for version in ("3.1.1", "5.0"):
        tests.list(version, "MQTT-1.0.0-1  server  the first\n")
    tests.list("9", "MQTT-1.0.0-1  client  the first\n")
    tests.write(
        "test_one.py",
        f"{names('MQTT-1.0.0-1', version='3.1.1')}\n{names('MQTT-1.0.0-1', version='5.0')}\n"
        '@pytest.mark.parametrize("version", [5])\ndef test_one(version): ...',
    )
    code, lines = tests.look()
    assert code == 1
    heads = [line.partition("; ") for line in lines if line.startswith("MQTT ")]
    assert [head[2].split(" ")[0] for head in heads] == ["0", "1", "0"]


def test_a_test_that_cannot_be_collected_is_told(tests: Suite) -> None:
    tests.write("test_one.py", f"{names('MQTT-1.0.0-1')}\ndef test_one(: ...")
    code, lines = tests.look()
    assert code == 2
    assert any("SyntaxError" in line for line in lines)


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("MQTT-1.0.0-9  server", "no statement"),
        ("MQTT-1.0.0-9  nobody  says so", "no statement"),
        ("1.0.0-9  server  says so", "no statement"),
        ("MQTT-1.0.0-4  client  again", "MQTT-1.0.0-4 is listed twice"),
        ("MQTT-1.0.0-9  none  without a reason", "why can nobody show MQTT-1.0.0-9"),
    ],
)
def test_a_list_that_is_wrong(
    tests: Suite, line: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    tests.list("9", STATEMENTS + line)
    assert main([], tests.directory) == 2
    assert capsys.readouterr().out.startswith(f"statements-9.txt:8: {why}")


def test_no_tests_at_all(tests: Suite, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([], tests.directory) == 1
    assert "0 of 3 have a test" in capsys.readouterr().out
