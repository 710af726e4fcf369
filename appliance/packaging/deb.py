"""Builds the Debian package of the single executable: `make deb`.

The package does what `appliance install` does, with the same code: dpkg owns the command, the unit
and /etc/default/appliance, and `postinst` lets the command make the rest. Keys and users are made
on the robot, and are never in the package.
"""

from __future__ import annotations

import argparse
import gzip
import os
import re
import shutil
import subprocess
import sys
import tempfile
from datetime import datetime, timezone
from email.utils import formatdate
from importlib.metadata import metadata, version
from pathlib import Path

from appliance.cli.fastdds import DEFAULT as SEGMENT
from appliance.config import parse_size
from appliance.host.libraries import machine_of
from appliance.ops.install import PACKAGED_COMMAND, PACKAGED_UNIT, systemd_version
from appliance.ops.unit import ENVIRONMENT, VARIABLES, Unit
from appliance.packaging import completion, manual
from appliance.packaging.symbols import UnreadableError, examine
from appliance.ros.ros2 import fastdds

PACKAGE = "appliance"
DOCUMENTS = Path("/usr/share/doc", PACKAGE)
PROJECT = Path(__file__).resolve().parents[2]
SCRIPTS = Path(__file__).parent / "debian"
#: The pages that README leads to, beside those of docs/.
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "certs/README.md")
#: Debian's names for the kinds of computers that executables are made for.
ARCHITECTURES = {"x86-64": "amd64", "arm64": "arm64"}
#: What lintian is told to let pass, each with the reason.
OVERRIDES = Path("/usr/share/lintian/overrides", PACKAGE)

DESCRIPTION = """\
 One process on the robot's computer: an MQTT 3.1.1 and 5 broker with the bridge
 to ROS 2 inside it. It needs no Python and no ROS; a sourced ROS is used where
 there is one. Certificates, a first user and access rules are made when it is
 installed."""


def build(command: Path, directory: Path) -> Path:
    """Build the package of that executable in the directory; returns its path.

    It is for the kind of computer that the executable is for, whichever this one is.

    Raises:
        UnreadableError: that is no executable, or one for another kind.
    """
    machine = machine_of(command)
    if machine not in ARCHITECTURES:
        made_for = f"is made for {machine}" if machine else "is no executable of Linux"
        raise UnreadableError(f"{command} {made_for}; packages are for {', '.join(ARCHITECTURES)}")
    architecture = ARCHITECTURES[machine]
    release = debian_version(version("ros-mqtt-appliance"))
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        root.chmod(0o755)
        _stage(root, command)
        _documents(root, release)
        _reference(root, release)
        (root / "DEBIAN").mkdir()
        for script in ("postinst", "postrm", "prerm"):
            _write(root, Path("/DEBIAN", script), (SCRIPTS / script).read_text(), 0o755)
        _write(root, OVERRIDES, (SCRIPTS / "lintian-overrides").read_text())
        _write(root, Path("/DEBIAN/conffiles"), f"{ENVIRONMENT}\n")
        libc = examine(command).least_glibc()
        _write(root, Path("/DEBIAN/control"), _control(root, release, architecture, libc))
        directory.mkdir(exist_ok=True)
        package = directory / f"{PACKAGE}_{release}_{architecture}.deb"
        # The executable is compressed already: fast gzip is enough.
        options = ("--root-owner-group", "-Zgzip", "-z1", "--build")
        subprocess.run(["dpkg-deb", *options, root, package], check=True, stdout=sys.stderr)
    return package


def debian_version(version: str) -> str:
    """A version of Python's (PEP 440) as Debian orders them: what comes before 1.0 has a tilde."""
    return re.sub(r"(a|b|rc)(?=\d)", r"~\1", version).replace(".dev", "~~dev")


def _stage(root: Path, command: Path) -> None:
    place = root / PACKAGED_COMMAND.relative_to("/")
    place.parent.mkdir(parents=True)
    shutil.copyfile(command, place)
    place.chmod(0o755)
    unit = Unit(PACKAGED_COMMAND, single_file=True, systemd=systemd_version())
    _write(root, PACKAGED_UNIT, str(unit).replace("`appliance install`, which", "a package that"))
    _write(root, ENVIRONMENT, VARIABLES.format(settings=""), 0o640)


def _documents(root: Path, release: str) -> None:
    license_file = "/usr/share/common-licenses/Apache-2.0"
    _write(
        root,
        DOCUMENTS / "copyright",
        "Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/\n"
        f"Upstream-Name: {metadata('ros-mqtt-appliance')['Name']}\n\n"
        "Files: *\nCopyright: 2026 the authors of ros-mqtt-appliance\nLicense: Apache-2.0\n"
        f" The licence's text is in {license_file}.\n",
    )
    entry = (
        f"{PACKAGE} ({release}) unstable; urgency=medium\n\n"
        "  * See CHANGELOG.md.\n\n"
        f" -- {_maintainer()}  {formatdate(_moment())}\n"
    )
    _compress(root, DOCUMENTS / "changelog.gz", entry)
    # As they are, and beside each other as in the repository: README leads to the pages.
    pages = [PROJECT / name for name in PAGES] + sorted(PROJECT.glob("docs/**/*.*"))
    for page in pages:
        _write(root, DOCUMENTS / page.relative_to(PROJECT), page.read_text())
    (root / DOCUMENTS.relative_to("/") / "LICENSE").symlink_to("../../common-licenses/Apache-2.0")


def _reference(root: Path, release: str) -> None:
    """What is looked up at the robot: man pages, completion, the reference configuration."""
    day = datetime.fromtimestamp(_moment(), timezone.utc).date().isoformat()
    for name, text in manual.pages(release, day):
        _compress(root, Path("/usr/share/man/man1", f"{name}.gz"), text)
    for path, text in completion.scripts().items():
        _write(root, path, text)
    configuration = (PROJECT / "appliance.yaml").read_text()
    _write(root, DOCUMENTS / "examples/appliance.yaml", configuration)
    (root / DOCUMENTS.relative_to("/") / "appliance.yaml").symlink_to("examples/appliance.yaml")
    profile = fastdds.profile(parse_size(SEGMENT))
    _write(root, Path("/usr/share", PACKAGE, "fastdds.xml"), profile)


def _control(root: Path, release: str, architecture: str, libc: str) -> str:
    size = sum(path.stat().st_size for path in root.rglob("*") if path.is_file()) // 1024
    return (
        f"Package: {PACKAGE}\nVersion: {release}\nArchitecture: {architecture}\n"
        f"Maintainer: {_maintainer()}\nInstalled-Size: {size}\n"
        f"Depends: libc6 (>= {libc}), zlib1g, passwd, init-system-helpers (>= 1.54)\n"
        "Recommends: systemd\nSection: net\nPriority: optional\n"
        f"Description: MQTT broker of a robot, with the bridge to ROS\n{DESCRIPTION}\n"
    )


def _maintainer() -> str:
    name = os.environ.get("DEBFULLNAME", "ros-mqtt-appliance")
    return f"{name} <{os.environ.get('DEBEMAIL', 'maintainers@ros-mqtt-appliance.invalid')}>"


def _moment() -> float:
    """The time of the newest commit, so that the same sources give the same package."""
    try:
        if given := os.environ.get("SOURCE_DATE_EPOCH"):
            return float(given)
        return float(_output_of("git", "-C", str(PROJECT), "log", "-1", "--format=%ct"))
    except (OSError, ValueError, subprocess.CalledProcessError):
        return (PROJECT / "CHANGELOG.md").stat().st_mtime


def _compress(root: Path, path: Path, text: str) -> None:
    _write(root, path, "")
    (root / path.relative_to("/")).write_bytes(gzip.compress(text.encode(), mtime=0))


def _output_of(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def _write(root: Path, path: Path, text: str, mode: int = 0o644) -> None:
    place = root / path.relative_to("/")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(text)
    place.chmod(mode)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("command", type=Path, help="the executable, dist/appliance")
    parser.add_argument("--directory", type=Path, default=PROJECT / "dist", help="default: dist")
    options = parser.parse_args()
    if not options.command.is_file():
        parser.error(f"there is no {options.command}: `make binary` makes it")
    os.umask(0o022)
    try:
        print(build(options.command, options.directory))
    except UnreadableError as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    sys.exit(main())
