"""The Debian package's man pages, completion and documents; tests/ops has its service."""

from __future__ import annotations

import gzip
import itertools
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from pages import Page

from appliance.cli import main as cli
from appliance.packaging import completion, deb, manual
from appliance.packaging.commands import Command, Option, tree
from appliance.packaging.symbols import UnreadableError

PROJECT = Path(__file__).parents[2]


def installed(program: str, package: str = "") -> str:
    found = shutil.which(program)
    if found is None:
        pytest.skip(f"needs {program}: apt install {package or program}")
    return found


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package whose command is Debian's `true`: an executable, stripped and hardened."""
    directory = tmp_path_factory.mktemp("package")
    command = [sys.executable, "-m", "appliance.packaging.deb", installed("true", "coreutils")]
    built = subprocess.run(
        [*command, "--directory", directory],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert built.returncode == 0, built.stderr
    return Path(built.stdout.strip())


@pytest.fixture(scope="module")
def root(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the package brings to a robot."""
    root = tmp_path_factory.mktemp("root")
    subprocess.run(["dpkg-deb", "--extract", package, root], check=True)
    return root


def made_for(machine: int, file: Path) -> Path:
    """A copy of Debian's `true` that says it is for another kind of computer (ELF, e_machine)."""
    content = bytearray(Path(installed("true", "coreutils")).read_bytes())
    content[18:20] = machine.to_bytes(2, "little")
    file.write_bytes(content)
    return file


def test_the_package_is_for_the_computers_that_its_command_is_for(tmp_path: Path) -> None:
    built = deb.build(made_for(183, tmp_path / "appliance"), tmp_path)
    assert built.name.endswith("_arm64.deb")
    shown = subprocess.run(
        ["dpkg-deb", "--field", built, "Architecture"], capture_output=True, text=True, check=True
    )
    assert shown.stdout == "arm64\n"


@pytest.mark.parametrize(
    ("machine", "said"), [(243, "is made for RISC-V"), (None, "is no executable of Linux")]
)
def test_a_command_for_other_computers_is_refused(
    machine: int | None, said: str, tmp_path: Path
) -> None:
    command = tmp_path / "appliance"
    if machine is None:
        command.write_text("#!/bin/sh\n")
    else:
        made_for(machine, command)
    with pytest.raises(UnreadableError, match=f"appliance {said}; packages are for x86-64, arm64"):
        deb.build(command, tmp_path)


def commands() -> dict[str, Any]:
    """Every command of `appliance` by how it is called."""
    found: dict[str, Any] = {}

    def add(name: str, command: Any) -> None:
        found[name] = command
        for each, below in getattr(command, "commands", {}).items():
            if not below.hidden:
                add(f"{name} {each}", below)

    add("appliance", typer.main.get_command(cli.app))
    return found


def options_of(command: Any) -> set[str]:
    shown = [each for each in command.params if not getattr(each, "hidden", False)]
    names = {name for each in shown for name in each.opts if name.startswith("-")}
    return names | {"-h", "--help"}


def test_lintian_has_no_word_against_it(package: Path) -> None:
    lintian = [installed("lintian"), "--fail-on", "error,warning"]
    if os.geteuid() == 0:
        lintian += ["--allow-root"]
    done = subprocess.run([*lintian, package], capture_output=True, text=True, timeout=240)
    assert (done.returncode, done.stdout) == (0, ""), done.stdout + done.stderr


def test_links_of_the_pages_lead_somewhere(root: Path) -> None:
    documents = root / "usr/share/doc/appliance"
    pages = sorted(documents.rglob("*.md"))
    assert {"README.md", "CHANGELOG.md", "security.md"} <= {page.name for page in pages}
    missing = [
        (page.name, link)
        for page in pages
        for link in Page(page.name, page.read_text()).links()
        if link.split("#")[0] not in ("", "LICENSE")
        and not (page.parent / link.split("#")[0]).exists()
    ]
    assert missing == []
    # The licence's text is in every Debian, and not in the package.
    licence = str((documents / "LICENSE").readlink())
    assert os.path.normpath(f"/usr/share/doc/appliance/{licence}") == (
        "/usr/share/common-licenses/Apache-2.0"
    )


def test_everybody_may_read_what_is_for_reading(root: Path) -> None:
    files = [path for path in root.glob("usr/share/**/*") if path.is_file()]
    assert len(files) > 50
    assert {stat.S_IMODE(path.stat().st_mode) for path in files} == {0o644}


def test_the_reference_configuration_and_the_profile_of_fast_dds(root: Path) -> None:
    documents = root / "usr/share/doc/appliance"
    for name in ("examples/appliance.yaml", "appliance.yaml"):
        assert (documents / name).read_bytes() == (PROJECT / "appliance.yaml").read_bytes()
    printed = subprocess.run(
        [sys.executable, "-m", "appliance", "fastdds"], capture_output=True, text=True, check=True
    )
    assert (root / "usr/share/appliance/fastdds.xml").read_text() == printed.stdout


def test_every_command_and_option_is_in_the_manual(root: Path) -> None:
    missing, pages = [], {}
    for file in (root / "usr/share/man/man1").iterdir():
        pages[file.name] = gzip.decompress(file.read_bytes()).decode().replace("\\-", "-")
    for called, command in commands().items():
        name = "-".join(called.split()[:2])
        page = pages.get(f"{name}.1.gz", "")
        start = page.find(f'.SS "{called}"') if called.count(" ") > 1 else 0
        section = page[start:].partition("\n.SS ")[0] if start >= 0 else ""
        listed = set(re.findall(r"\\fB(-[\w-]+)\\fP", section))
        missing += [(called, option) for option in options_of(command) - listed]
    assert missing == []
    assert len(pages) == 1 + len(commands()["appliance"].commands)


def test_a_flag_takes_no_value() -> None:
    """Nor does one with an opposite, `--start / --no-start`: completion goes on behind both."""
    options = [each for command in tree().walk() for each in command.options]
    assert not [each for each in options if each.value.startswith("-")]
    opposites = {each.names: each.value for each in options if "--no-start" in each.names}
    assert opposites == {("--start", "--no-start"): ""}


def test_what_comes_before_a_release_is_older_for_debian_too() -> None:
    versions = ["1.0.dev3", "1.0a1", "1.0b2", "1.0rc1", "1.0", "1.0.1"]
    for older, newer in itertools.pairwise(map(deb.debian_version, versions)):
        done = subprocess.run(["dpkg", "--compare-versions", older, "lt", newer])
        assert done.returncode == 0, (older, newer)


def test_a_page_says_what_its_command_says() -> None:
    """Whatever roff takes for its own: a dot and a quote at a line's start, backslashes, dashes."""
    text = ".conf is \\n no 'macro' of a-b\n\n'quoted' `code` \"x\" -- at the start"
    option = Option(("-c", "--colour"), "FILE", ".yaml, or C:\\new")
    command = Command("appliance try", text, "[OPTIONS]", (option,), (("name", "'s value"),), ())
    page = manual._head("appliance-try", command, "1.0", "2026-01-01")
    page += manual._description(command) + manual._options(command)
    roff = [installed("groff", "groff-base"), "-man", "-Tascii", "-P-c", "-P-b", "-P-u", "-ww"]
    done = subprocess.run(roff, input=page, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    shown = " ".join(done.stdout.split())
    assert ".conf is \\n no 'macro' of a-b" in shown
    assert "'quoted' code \"x\" -- at the start" in shown
    assert "name 's value -c, --colour FILE .yaml, or C:\\new" in shown


#: What is typed, and what is offered for its last word.
TYPED = {
    "appliance cer": ["cert"],
    "appliance cert ": ["issue", "sign", "revoke", "renew", "list", "fingerprint", "crl"],
    "appliance cert issue --p": ["--pkcs12", "--password-file"],
    "appliance pub -V ": ["5", "311"],
    "appliance run --log-format h": ["human"],
    "appliance store -c x ex": ["export"],
    "appliance pub cert --mq": ["--mqtt-version"],
    "appliance init --dir ": [],  # files, which the shell offers by itself
}
BASH = """
. {script}
for line in {lines}; do
    read -ra COMP_WORDS <<< "$line"
    [[ $line == *' ' ]] && COMP_WORDS+=('')
    COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
    _appliance
    echo "${{COMPREPLY[*]}}"
done
"""
#: The functions of zsh's completion only work within its line editor: these print instead.
ZSH = """
_describe() {{ local each; for each in "${{(@P)2}}"; do print -rn -- "${{each%%:*}} "; done }}
compadd() {{ print -rn -- "$* " }}
_files _message() {{ :; }}
for line in {lines}; do
    words=(${{(s: :)line}})
    [[ $line == *' ' ]] && words+=('')
    CURRENT=$#words
    . {script}
    print
done
"""
FISH = """
source {script}
for line in {lines}
    echo (complete -C $line | string replace -r '\\t.*' '' | string join ' ')
end
"""


@pytest.mark.parametrize(("shell", "program"), [("bash", BASH), ("zsh", ZSH), ("fish", FISH)])
def test_completion(shell: str, program: str, root: Path, tmp_path: Path) -> None:
    interpreter = installed(shell)
    script = next(
        root / path.relative_to("/") for path in completion.scripts() if shell in str(path)
    )
    lines = " ".join(shlex.quote(line) for line in TYPED)
    told = subprocess.run(
        [interpreter, "-c", program.format(script=script, lines=lines)],
        cwd=tmp_path,  # an empty folder: no file is offered
        env={"HOME": str(tmp_path), "PATH": os.environ["PATH"], "TERM": "dumb"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (told.returncode, told.stderr) == (0, "")
    offered = dict(zip(TYPED, (line.split() for line in told.stdout.split("\n")), strict=False))
    for line, wanted in TYPED.items():
        # zsh chooses among them by itself.
        typed = line.rpartition(" ")[2]
        chosen = [word for word in offered[line] if word.startswith(typed)]
        assert sorted(chosen) == sorted(wanted), (line, offered[line])


def test_completion_knows_every_command_and_option(root: Path) -> None:
    for path in completion.scripts():
        text = (root / path.relative_to("/")).read_text()
        for called, command in commands().items():
            assert called in text, (path, called)
            for option in options_of(command):
                assert option.lstrip("-") in text, (path, called, option)


def test_fish_takes_every_character_in_an_explanation() -> None:
    quoted = completion._fish_quoted("the robot's \\n `x` $y")
    fish = [installed("fish"), "-c", f"echo -n {quoted}"]
    assert subprocess.run(fish, capture_output=True, text=True).stdout == "the robot's \\n `x` $y"
