"""The console's files: what is served is small, kept for good, and the libraries are npm's."""

from __future__ import annotations

import gzip
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from appliance_process import ROBOT
from npm_packages import DIRECTORY, install
from waiting import PATIENCE

from appliance.net.http import HttpRequest, HttpResponse
from appliance.web.console import FILES, PATH, Console, takes_gzip

VENDOR = FILES / "vendor"
MANIFEST: dict[str, dict[str, Any]] = json.loads((VENDOR / "manifest.json").read_text())
OWN = sorted(path.name for path in FILES.glob("*.js"))

#: Seconds for node, which tries tens of thousands of payloads.
NODE_PATIENCE = 4 * PATIENCE

#: What the first page may take, see docs/http.md.
FIRST_BYTES = 250 * 1024
FIRST_REQUESTS = 12


async def get(console: Console, path: str, accepted: str = "gzip, br") -> HttpResponse:
    headers = (("accept-encoding", accepted),) if accepted else ()
    request = HttpRequest("GET", path, "", "robot", headers, "[::1]:5", "::1", None, None)
    resource = console.resources["/" if path == "/" else PATH]
    return await resource.respond(request)


def static_imports(module: str) -> list[str]:
    return re.findall(r"""(?:\bfrom|\bimport)\s*["']([^"']+)["']""", module)


async def test_the_first_page_is_small():
    """All that a browser loads before somebody signs in, and with the connection's program."""
    console = Console(ROBOT)
    page = await get(console, "/")
    taken = {"/": len(page.body)}
    waiting = re.findall(r'(?:href|src)="([^"]+)"', gzip.decompress(page.body).decode())
    assert all(path.startswith(PATH) for path in waiting)
    while waiting:
        path = waiting.pop()
        if path in taken:
            continue
        response = await get(console, path)
        assert response.status == 200, path
        taken[path] = len(response.body)
        if path.endswith("js"):
            base = Path(path).parent
            text = gzip.decompress(response.body).decode()
            for name in static_imports(text):
                assert name.startswith("./"), f"{path} imports {name}, which no browser finds"
                waiting.append(str(base / name))
    taken["/readyz"] = taken["/ca.crt"] = 0
    assert len(taken) <= FIRST_REQUESTS, sorted(taken)
    later = Path(next(path for path in taken if path.endswith("main.js"))).parent
    worker = await get(console, str(later / "worker.js"))
    mqtt = await get(console, str(later / "vendor/mqtt.esm.js"))
    assert sum(taken.values()) + len(worker.body) + len(mqtt.body) <= FIRST_BYTES


async def test_the_page_says_which_robot_it_is_of():
    page = gzip.decompress((await get(Console('r<2>"d2'), "/")).body).decode()
    assert '<meta name="robot" content="r&lt;2&gt;&quot;d2">' in page


async def test_files_are_kept_for_good_and_the_page_is_not():
    console = Console(ROBOT)
    page = await get(console, "/")
    assert page.content_type == "text/html; charset=utf-8"
    assert not any(name == "Cache-Control" for name, _ in page.headers)  # then it is no-store
    text = gzip.decompress(page.body).decode()
    style = re.search(r'href="([^"]+style\.css)"', text)
    assert style is not None
    long = "," * 1000 + "gzip"  # a stranger's, and work for each comma
    assert takes_gzip("gzip, deflate, br, zstd") and not takes_gzip(long)
    for accepted in ("gzip", "", "identity", "gzip;q=0", "br, gzip;q=0.5", long):
        file = await get(console, style[1], accepted)
        headers = dict(file.headers)
        assert headers["Cache-Control"].endswith("immutable") and "Vary" in headers
        assert ("Content-Encoding" in headers) == takes_gzip(accepted)
        body = gzip.decompress(file.body) if takes_gzip(accepted) else file.body
        assert body == (FILES / "style.css").read_bytes()
    base = style[1].removesuffix("style.css")
    for path in ("", "nothing.js", "../index.html", "%2e%2e/site.py", "vendor/", "index.html"):
        assert (await get(console, base + path)).status == 404, path
    assert (await get(console, f"{PATH}{'0' * 16}/style.css")).status == 404


async def test_another_content_has_another_path(tmp_path: Path):
    async def path() -> str:
        (tmp_path / "vendor").mkdir(exist_ok=True)
        (tmp_path / "vendor/manifest.json").write_text("{}")
        (tmp_path / "index.html").write_text("{{files}}/")
        return gzip.decompress((await get(Console(ROBOT, tmp_path), "/")).body).decode()

    (tmp_path / "a.js").write_text("1")
    first = await path()
    assert first == await path()
    (tmp_path / "a.js").write_text("2")
    assert await path() != first


async def test_files_that_could_not_be_read_are_read_again(tmp_path: Path):
    console = Console(ROBOT, tmp_path)
    with pytest.raises(KeyError):
        await get(console, "/")
    (tmp_path / "vendor").mkdir()
    (tmp_path / "vendor/manifest.json").write_text("{}")
    (tmp_path / "index.html").write_text("there")
    assert (await get(console, "/")).status == 200


def test_nothing_is_inline_and_nothing_is_markup():
    """What the page's policy forbids, and what would make markup of a payload."""
    page = (FILES / "index.html").read_text()
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*src=)|https?:", page)
    for name in OWN:
        text = (FILES / name).read_text()
        for word in (
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "dangerously",
            "eval(",
            "http:",
        ):
            assert word not in text, name
        assert not re.search(r"document\.write|new Function|https://", text), name
        assert "localStorage" not in text, name
        # What a window keeps of a sign-in is in one place: a token, and no password.
        assert "sessionStorage" not in text or name == "link.js", name


def test_the_libraries_are_listed_with_their_licences():
    listed = [file for package in MANIFEST.values() for file in package["files"]]
    there = [path.relative_to(VENDOR).as_posix() for path in VENDOR.rglob("*") if path.is_file()]
    assert sorted(listed) == sorted(set(there) - {"manifest.json"})
    for name, package in MANIFEST.items():
        assert f"licences/{name.rpartition('/')[2]}.txt" in package["files"], name
        assert package["licence"] in ("MIT", "Apache-2.0", "(Apache-2.0 AND MIT)"), name


def test_the_libraries_are_those_of_npm():
    """The versions, npm's integrity of each package, and each file byte by byte."""
    install()
    lock = json.loads((DIRECTORY / "package-lock.json").read_text())["packages"]
    for name, package in MANIFEST.items():
        locked = lock[f"node_modules/{name}"]
        assert locked["version"] == package["version"]
        assert locked["integrity"] == package["integrity"]
        assert locked["license"] == package["licence"]
        for here, there in package["files"].items():
            original = DIRECTORY / "node_modules" / name / there
            assert (VENDOR / here).read_bytes() == original.read_bytes(), here


@pytest.mark.parametrize("name", OWN)
def test_a_module_has_no_error_of_syntax(name: str):
    """Before a browser is started: a page whose modules do not load says nothing."""
    with (FILES / name).open() as module:
        command = ["node", "--input-type=module", "--check", "-"]
        done = subprocess.run(command, stdin=module, capture_output=True, timeout=NODE_PATIENCE)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize(
    "name",
    [
        "about",
        "bounds",
        "cbor",
        "formats",
        "camera",
        "map",
        "calls",
        "schema",
        "signing",
        "driving",
    ],
)
def test_hostile_payloads(name: str):
    """What reads payloads, in node: exact, bounded, and no key becomes one of an object."""
    install()
    tested = FILES / "formats.js" if name == "formats" else FILES
    done = subprocess.run(
        ["node", str(Path(__file__).parent / f"{name}.js"), tested.as_uri()],
        capture_output=True,
        text=True,
        timeout=NODE_PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "ok\n"
