"""README, CONTRIBUTING and docs/: their options, configurations and links are true.

test_page_commands.py runs their commands.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from pages import PROJECT, Page, anchor, pages

from appliance import config
from appliance.cli import main as cli

PAGES = pages()
README = PAGES[0]
NAMES = [page.name for page in PAGES]

#: Lines that README may have: more belongs into docs/.
LONGEST_README = 200


def parts(line: str) -> Iterator[list[str]]:
    """The words of each command of a line, of a redirection's file too."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;>")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in lexer:
        if {*word} <= {*"&|;>"}:
            yield words
            words = []
        else:
            words.append(word)
    yield words


def invocations(page: Page) -> Iterator[list[str]]:
    """The words behind `appliance` of each line that calls it."""
    for line in page.commands():
        for words in parts(line):
            while words and (words[0] == "sudo" or re.match(r"[A-Z_]+=", words[0])):
                del words[0]
            if words and Path(words[0]).name == "appliance":
                yield words[1:]


def command_of(words: list[str]) -> tuple[Any, list[str]]:
    """The command that these words name, and what is behind its name."""
    command: Any = typer.main.get_command(cli.app)
    rest, _ = cli._split_ros_arguments(words)
    while rest and rest[0] in getattr(command, "commands", {}):
        command, rest = command.commands[rest[0]], rest[1:]
    return command, rest


def options_of(command: Any) -> set[str]:
    names = {name for param in command.params for name in (*param.opts, *param.secondary_opts)}
    return {name for name in names if name.startswith("-")} | {"-h", "--help"}


def wrong_with(words: list[str]) -> str:
    """What is wrong with a complete command line; nothing if it would be taken."""
    command, rest = command_of(words)
    known = {
        name: param
        for param in command.params
        for name in (*param.opts, *param.secondary_opts)
        if name.startswith("-")
    }
    given = 0
    while rest:
        word, *rest = rest
        if word.startswith("-") and word != "-":
            if word not in known:
                return f"{word} is none of {sorted(known)}"
            if not known[word].is_flag:
                if not rest:
                    return f"{word} has no value"
                del rest[0]
        else:
            given += 1
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    least = sum(param.required for param in arguments)
    most = 1000 if any(param.nargs == -1 for param in arguments) else len(arguments)
    if not least <= given <= most:
        return f"{given} arguments, where it takes {least} to {most}"
    return ""


def test_readme_is_a_first_visit() -> None:
    assert len(README.text.splitlines()) <= LONGEST_README


def test_readme_names_every_command() -> None:
    command: Any = typer.main.get_command(cli.app)
    names = {*command.commands}
    assert len(names) > 15
    assert [name for name in sorted(names) if f"`{name}" not in README.text] == []


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Page) -> None:
    by_path = {each.path: each for each in PAGES}
    broken = []
    for link in page.links():
        file, _, heading = link.partition("#")
        path = (page.path.parent / file).resolve() if file else page.path
        known = by_path[path].anchors() if path in by_path else set()
        if not path.exists() or (heading and heading not in known):
            broken.append(link)
    assert broken == []


#: Pages about the code: what they name is there.
ABOUT_CODE = [page for page in PAGES if page.name in ("docs/architecture.md", "docs/adding.md")]


@pytest.mark.parametrize("page", ABOUT_CODE, ids=[page.name for page in ABOUT_CODE])
def test_files_and_names_of_the_code_are_there(page: Page) -> None:
    """`appliance/net/tls.py`, `net/tls.py`, `Broker.publish_to`; NAME is the reader's own."""
    code = "\n".join(file.read_text() for file in PROJECT.glob("appliance/**/*.py"))
    missing = []
    for quoted in page.quoted():
        is_path = re.fullmatch(r"[\w.-]+(/[\w.-]+)+/?", quoted) and "NAME" not in quoted
        if is_path and not any(
            (root / quoted).exists() for root in (PROJECT, PROJECT / "appliance")
        ):
            missing.append(quoted)
        name = re.fullmatch(r"([A-Z][a-z]\w+)\.(\w+)", quoted)
        if name and not re.search(rf"^class {name[1]}\b.*?^    def {name[2]}\b", code, re.M | re.S):
            missing.append(quoted)
    assert missing == []


@pytest.mark.parametrize("page", PAGES[1:], ids=NAMES[1:])
def test_a_page_begins_with_its_contents(page: Page) -> None:
    start = page.text.partition("\n## ")[0]
    listed = re.findall(r"^- \[(.+?)\]\(#(.+?)\)$", start, re.M)
    assert listed == [(text, anchor(text)) for text in page.headings(2)]


def test_every_page_is_found_from_readme() -> None:
    missing = {*NAMES[1:]} - {link.partition("#")[0] for link in README.links()}
    assert missing == set()


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_are_ones_that_there_are(page: Page) -> None:
    wrong = {" ".join(words): wrong_with(words) for words in invocations(page)}
    assert {line: what for line, what in wrong.items() if what} == {}


def test_it_is_seen_when_a_command_is_wrong() -> None:
    assert wrong_with(["run", "-c", "a.yaml"]) == ""
    assert "--colour" in wrong_with(["run", "--colour"])
    assert "arguments" in wrong_with(["cert", "revoke"])
    assert "no value" in wrong_with(["run", "-c"])
    assert "arguments" in wrong_with(["fly"])
    assert sum(1 for page in PAGES for _ in invocations(page)) > 30


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_commands_in_the_text_are_ones_that_there_are(page: Page) -> None:
    unknown = []
    for text in page.quoted():
        if not text.startswith("appliance "):
            continue
        command, rest = command_of(shlex.split(text)[1:])
        options = [word for word in rest if word.startswith("-")]
        is_group = bool(getattr(command, "commands", None))
        is_unknown = is_group and rest and not options
        if is_unknown or {*options} - options_of(command):
            unknown.append(text)
    assert unknown == []


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_yaml_blocks_are_configurations(page: Page, tmp_path: Path) -> None:
    file = tmp_path / "appliance.yaml"
    for block in page.blocks("yaml"):
        variables = dict.fromkeys(re.findall(r"\$\{(\w+)", block), "x")
        config.loads(block, file, variables)  # raises ConfigError, which names what is wrong


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_targets_of_make_are_there(page: Page) -> None:
    makefile = (PROJECT / "Makefile").read_text()
    lines = [*page.commands(), *page.quoted()]
    named = {line.split()[1] for line in lines if re.match(r"make [a-z]", line)}
    assert {name for name in named if f"\n{name}:" not in makefile} == set()


def test_programs_of_the_tests_run(tmp_path: Path) -> None:
    found = {name for page in PAGES for name in re.findall(r"`python (tests/[\w/.]+)", page.text)}
    assert {"tests/soak", "tests/hostile", "tests/service"} <= found
    processes = {
        name: subprocess.Popen(
            [sys.executable, str(PROJECT / name), "--help"],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for name in sorted(found)
    }
    told = {name: process.communicate()[0] for name, process in processes.items()}
    assert {name: told[name] for name, each in processes.items() if each.returncode != 0} == {}


def test_nobody_is_sent_to_an_index_where_we_are_not() -> None:
    """The name is not taken there: whoever takes it would be installed on robots."""
    asked = re.compile(r"pip install[^.\n]*ros-mqtt-appliance")
    sources = [path.read_text() for path in (PROJECT / "appliance").rglob("*.py")]
    texts = [*sources, *(page.text for page in PAGES), (PROJECT / "appliance.yaml").read_text()]
    assert [found for text in texts for found in asked.findall(text)] == []
