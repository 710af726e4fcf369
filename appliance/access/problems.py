"""Errors in a users file or an ACL file, with file, line and column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

#: The most bytes of a file: a hundred thousand users. A larger one is the wrong file.
MAX_SIZE: Final = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class FileProblem:
    """One error in one file; lines and columns count from 1, and line 0 means the whole file."""

    file: Path
    line: int
    column: int
    message: str

    def __str__(self) -> str:
        if not self.line:
            return f"{self.file}: {self.message}"
        return f"{self.file}:{self.line}:{self.column}: {self.message}"


class AccessFileError(ValueError):
    """A users file or an ACL file cannot be used; `problems` lists all errors."""

    def __init__(self, problems: Sequence[FileProblem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = list(problems)


def read_text(path: Path, advice: str, limit: int = MAX_SIZE) -> str:
    """The text of a file of `limit` bytes at most.

    AccessFileError when it is missing (then with `advice`), too large or not UTF-8.
    """
    try:
        if path.is_fifo():  # reading it would wait for a writer
            raise AccessFileError([FileProblem(path, 0, 0, "is no file, but a pipe")])
        with path.open("rb") as file:
            data = file.read(limit + 1)
    except FileNotFoundError:
        raise AccessFileError(
            [FileProblem(path, 0, 0, f"there is no such file; {advice}")]
        ) from None
    except OSError as error:
        message = f"cannot be read ({error.strerror}); let the user that runs the appliance read it"
        raise AccessFileError([FileProblem(path, 0, 0, message)]) from error
    if len(data) > limit:
        message = f"larger than {limit >> 20} MiB; is it the right file?"
        raise AccessFileError([FileProblem(path, 0, 0, message)])
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        line = before.count(b"\n") + 1
        column = len(before.rpartition(b"\n")[2].decode("utf-8", "replace")) + 1
        message = "not UTF-8; save the file in that encoding"
        raise AccessFileError([FileProblem(path, line, column, message)]) from None
