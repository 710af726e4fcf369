"""The optional compiled build: it is made as a user makes it, and passes the broker's own tests."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

#: The tests of what is compiled, as far as they run in their own process. Of what is random a few
#: examples are enough, of what is lengthy none, and of two event loops the appliance's own.
TESTS = [
    "tests/broker",
    "tests/mqtt",
    "tests/store",
    "tests/net/test_tls.py",
    "tests/net/test_websocket.py",
]
UPSTREAM = ("backlog", "backlog_random", "link", "publish_properties", "rates", "records", "uplink")
TESTS += [f"tests/upstream/test_{name}.py" for name in UPSTREAM]

#: Prints where some of the compiled modules come from.
WHERE = """
from appliance.broker import client
from appliance.net import tls
from appliance.upstream import backlog
print(client, tls, backlog)
"""

#: The same after the entry point of the one file, whose unpacked files are in the argument.
IN_ONE_FILE = f"""
import sys
from appliance.packaging import entry
entry.INSIDE = sys.argv[1]
entry.use_machine_code()
{WHERE}
"""


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the compiled package, out of its wheel."""
    headers = Path(sysconfig.get_paths()["include"]) / "Python.h"
    if not (shutil.which("cc") and headers.exists()):
        pytest.skip("needs a C compiler and Python's headers: apt install gcc python3-dev")
    directory = tmp_path_factory.mktemp("compiled")
    source = directory / "source"
    # A copy: building leaves files behind.
    shutil.copytree(ROOT / "appliance", source / "appliance")
    for name in ("setup.py", "pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    # By a Python that has nothing installed: mypy would find there what the build has to ask for.
    bare = directory / "bare"
    venv.create(bare, with_pip=False)
    pip = [sys.executable, "-m", "pip", "--python", str(bare / "bin/python"), "wheel", "-q"]
    options = ["--no-deps", "--use-pep517", "--disable-pip-version-check"]
    subprocess.run(
        [*pip, *options, "-w", str(directory), str(source)],
        env={**os.environ, "APPLIANCE_COMPILE": "1", "APPLIANCE_OPTIMIZE": "0"},
        check=True,
        timeout=1800,  # on one core that others share
    )
    (wheel,) = directory.glob("*.whl")
    package = directory / "package"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(package)
    return package


@pytest.mark.timeout(3600)
def test_the_compiled_broker_passes_the_tests_of_the_broker(compiled: Path):
    environment = {**os.environ, "PYTHONPATH": str(compiled), "TEST_EXAMPLES": "0.03"}
    where = [sys.executable, "-c", WHERE]
    used = subprocess.run(where, env=environment, cwd=compiled, check=True, capture_output=True)
    assert used.stdout.count(b".so") == 3
    version = [sys.executable, "-m", "appliance", "--version"]
    told = subprocess.run(version, env=environment, cwd=compiled, check=True, capture_output=True)
    assert told.stdout.endswith(b", compiled\n")
    pytest_command = Path(sys.executable).with_name("pytest")  # `-m pytest` would import from here
    run = subprocess.run(
        [
            *(str(pytest_command), "-x", "-p", "no:cacheprovider"),
            *("-m", "not patches and not timed and not lengthy", *TESTS),
        ],
        env=environment,
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    assert run.returncode == 0, run.stdout[-4000:]
    passed = re.search(r"^(\d+) passed", run.stdout, re.MULTILINE)
    assert passed and int(passed[1]) > 1000, run.stdout[-1000:]


def test_a_folder_without_machine_code_is_named(tmp_path: Path):
    """A relative one is meant from here, and not from the folder of PyInstaller's recipe."""
    options = ["--distpath", tmp_path / "dist", "--workpath", tmp_path / "build"]
    recipe = ROOT / "appliance/packaging/appliance.spec"
    done = subprocess.run(
        [sys.executable, "-m", "PyInstaller", *options, recipe, "--", "--compiled", "none"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode
    assert f"there is no machine code in {tmp_path}/none: " in done.stderr


def test_the_one_file_has_the_pure_modules_behind_the_compiled(compiled: Path, tmp_path: Path):
    def where(unpacked: Path, **environment: str) -> tuple[str, str]:
        done = subprocess.run(
            [sys.executable, "-c", IN_ONE_FILE, unpacked],
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
            cwd=tmp_path,
            check=True,
            capture_output=True,
            text=True,
        )
        return done.stdout, done.stderr

    assert where(compiled)[0].count(f"{compiled}/appliance/") == 3
    pure = f"{ROOT}/appliance/"
    assert where(compiled, APPLIANCE_PURE="1")[0].count(pure) == 3
    assert where(tmp_path) == (where(compiled, APPLIANCE_PURE="1")[0], ""), "none is in the file"
    (library,) = compiled.glob("appliance__mypyc.*")
    (tmp_path / library.name).write_bytes(b"no library" * 1000)
    found, warned = where(tmp_path)
    assert found.count(pure) == 3
    assert warned.startswith("appliance: running without its machine code, which does not load: ")
