"""The console: the page at `/`, and its files below a path that is their content's hash.

A browser keeps the files for good, as another content has another path; the page itself it asks for
each time. All is read and compressed in a thread when the first browser asks: the files need no
build, and who has no browser does not pay for them.
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import html
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from appliance.net.http import Headers, HttpRequest, HttpResponse, text
from appliance.web.site import Resource

FILES: Final = Path(__file__).parent / "files"

#: Where the files are: below it comes the hash.
PATH: Final = "/console/"

#: What the page has in place of PATH and the hash.
_PLACE: Final = b"{{files}}/"

#: And in place of the robot's name.
_ROBOT: Final = b"{{robot}}"

_PAGE: Final = "index.html"

#: The libraries, with what their modules call each other and where that is here.
_MANIFEST: Final = "vendor/manifest.json"

_TYPES: Final = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".mjs": "text/javascript; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
}

#: The most characters of an Accept-Encoding: a browser sends thirty.
_LONGEST_ACCEPTED: Final = 256

#: For a year, and not asked about meanwhile (RFC 8246).
_FOR_GOOD: Final = ("Cache-Control", "public, max-age=31536000, immutable")

#: A module's name in its import, where that is not a path.
_IMPORT: Final = re.compile(rb"""(\bfrom|\bimport)(\s*)(["'])([^"'./][^"']*)\3""")


@dataclass(frozen=True, slots=True)
class _File:
    """A file as it is sent: compressed, where that is wanted. Both are there already, as strangers
    decide which they ask for."""

    content: bytes
    compressed: bytes
    content_type: str

    def answer(self, request: HttpRequest, caching: Headers) -> HttpResponse:
        headers = (("Vary", "Accept-Encoding"), *caching)
        if takes_gzip(request.get("accept-encoding") or ""):
            headers = (("Content-Encoding", "gzip"), *headers)
            return HttpResponse(200, self.compressed, self.content_type, headers, is_shared=True)
        return HttpResponse(200, self.content, self.content_type, headers, is_shared=True)


class Console:
    """The console's files, from a folder; the page says which robot it is of."""

    def __init__(self, robot: str, folder: Path = FILES) -> None:
        self._robot = html.escape(robot).encode()
        self._folder = folder
        self._found: dict[str, _File] | None = None
        self._reading = asyncio.Lock()

    @property
    def resources(self) -> dict[str, Resource]:
        """What is at which path."""
        return {"/": Resource(self._page), PATH: Resource(self._file)}

    async def _page(self, request: HttpRequest) -> HttpResponse:
        return (await self._files())["/"].answer(request, ())

    async def _file(self, request: HttpRequest) -> HttpResponse:
        file = (await self._files()).get(request.path)
        if file is None:
            return text(404, "nothing is here")
        return file.answer(request, (_FOR_GOOD,))

    async def _files(self) -> dict[str, _File]:
        """The files by their paths; read once, and again where that has failed. Raises OSError."""
        async with self._reading:
            if self._found is None:
                self._found = await asyncio.to_thread(_read, self._folder, self._robot)
            return self._found


def takes_gzip(accepted: str) -> bool:
    """Whether an Accept-Encoding allows gzip (RFC 9110, section 12.5.3).

    Strangers send it, so a long one is not read.
    """
    if len(accepted) > _LONGEST_ACCEPTED:
        return False
    for part in accepted.lower().split(","):
        name, *parameters = (word.strip() for word in part.split(";"))
        if name in ("gzip", "x-gzip", "*"):
            return not any(re.fullmatch(r"q=0(\.0*)?", word) for word in parameters)
    return False


def _read(folder: Path, robot: bytes) -> dict[str, _File]:
    """All files, by the paths at which they are. Raises OSError."""
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix in _TYPES and path.is_file()
    )
    contents = {name: (folder / name).read_bytes() for name in names}
    page = contents.pop(_PAGE).replace(_ROBOT, robot)
    for name, imports in _imports(contents[_MANIFEST]).items():
        contents[name] = _with_paths(contents[name], imports)
    digest = hashlib.sha256()
    for name, content in contents.items():
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    base = f"{PATH}{digest.hexdigest()[:16]}/"
    files = {base + name: _file(name, content) for name, content in contents.items()}
    files["/"] = _file(_PAGE, page.replace(_PLACE, base.encode()))
    return files


def _file(name: str, content: bytes) -> _File:
    return _File(content, gzip.compress(content, mtime=0), _TYPES[Path(name).suffix])


def _imports(manifest: bytes) -> dict[str, Mapping[str, str]]:
    """Of each module that imports another package by its name: where that is, by the name."""
    packages = json.loads(manifest)
    return {
        f"vendor/{file}": package["imports"]
        for package in packages.values()
        if "imports" in package
        for file in package["files"]
        if file.endswith(".mjs")
    }


def _with_paths(module: bytes, imports: Mapping[str, str]) -> bytes:
    """The module with paths where it imports by name: a browser resolves names by a map that
    stands in the page, which its policy forbids, and not in a worker at all."""

    def path(match: re.Match[bytes]) -> bytes:
        begin, space, quote, name = match.groups()
        found = imports.get(name.decode())
        return match[0] if found is None else begin + space + quote + found.encode() + quote

    return _IMPORT.sub(path, module)
