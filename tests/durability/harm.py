"""What a power cut, or a worn-out memory card, does to the files of a database."""

from __future__ import annotations

import random
from pathlib import Path

from durability.ordeal import Harm


def _log(database: Path) -> Path:
    return database.with_name(database.name + "-wal")


def _cut(path: Path, dice: random.Random, least: int = 0) -> None:
    if path.exists() and (size := path.stat().st_size):
        with path.open("r+b") as file:
            file.truncate(dice.randrange(min(least, size), size))


def _flip(path: Path, dice: random.Random, count: int) -> None:
    if not path.exists():
        return
    data = bytearray(path.read_bytes())
    for _ in range(count if data else 0):
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
    path.write_bytes(data)


def tear(database: Path, dice: random.Random) -> None:
    """The last bytes of the write-ahead log did not reach the disk."""
    _cut(_log(database), dice)


def garble(database: Path, dice: random.Random) -> None:
    """The end of the write-ahead log is something else."""
    log = _log(database)
    if log.exists() and (size := log.stat().st_size):
        with log.open("r+b") as file:
            file.seek(dice.randrange(size))
            file.write(dice.randbytes(dice.randrange(1, 8192)))


def truncate(database: Path, dice: random.Random) -> None:
    """The database ends early."""
    _cut(database, dice)
    if dice.random() < 0.5:
        _cut(_log(database), dice)


def flip(database: Path, dice: random.Random) -> None:
    """Bits flipped in either file."""
    _flip(database, dice, dice.choice((1, 10, 100)))
    _flip(_log(database), dice, dice.choice((0, 1, 10)))


def wipe(database: Path, dice: random.Random) -> None:
    """A file is full of zeros, empty, or gone."""
    path = dice.choice((database, _log(database)))
    if path.exists():
        kind = dice.randrange(3)
        if kind == 0:
            path.write_bytes(bytes(path.stat().st_size))
        elif kind == 1:
            path.write_bytes(b"")
        else:
            path.unlink()


def anything(database: Path, dice: random.Random) -> None:
    """One of all these."""
    dice.choice((tear, garble, truncate, flip, wipe))(database, dice)


HARMS: dict[str, Harm] = {
    harm.__name__: harm for harm in (tear, garble, truncate, flip, wipe, anything)
}
