"""Small good files of every splat format, from which the fuzzer starts."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from _splat_files import Table, random_splats, splat_table, write_ply

from meshsplats import load_gaussians

Change = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Seed:
    """A splat or mesh file, or a folder of files."""

    name: str
    files: dict[str, bytes]
    opened: str
    """The path given to the reader, relative to the folder of the files."""
    inside: Callable[[bytes, Change], bytes] | None = None
    """Applies a change to the data inside a compressed file."""
    load: Callable[[Path], object] = load_gaussians
    """The reader under test."""


def _ply(name: str, encoding: str, degree: int, tables: bool) -> Seed:
    faces = [Table("face", [("uchar", "int", "v")], [[[0, 1, 2]], [[0, 1, 2, 3]], [[]]])] if tables else []
    values = random_splats(5, degree=degree)
    types = {"x": "double", "opacity": "double"} if tables else {}
    with tempfile.TemporaryDirectory() as folder:
        path = write_ply(Path(folder) / "a.ply", [*faces, splat_table(values, types)], encoding)
        return Seed(name, {"a.ply": path.read_bytes()}, "a.ply")


SEEDS = [
    _ply("ply", "binary_little_endian", 1, False),
    _ply("ply-lists", "binary_big_endian", 0, True),
    _ply("ply-ascii", "ascii", 0, True),
]
