"""Titles of the groups of options in help texts, where tyro has the names of fields."""

from __future__ import annotations

import codecs
import io
import re
import sys

TITLES = {
    "chain": "levels of detail",
    "draw": "drawing",
    "files": "output files",
    "laying": "splats on the base",
    "light": "light and surroundings",
    "part": "part of the scene",
    "reading": "reading splats",
    "target": "targets",
    "tuning": "optimisation",
}
"""By the names of fields; where none is here, the name is the title."""


class Captured(io.StringIO):
    """What is printed while it stands for standard output, in its colours and with lines that it can show."""

    def __init__(self) -> None:
        super().__init__()
        self._stream = sys.stdout

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Name of the stream's encoding, in Python's spelling: "utf-8" for all of its names."""
        return codecs.lookup(getattr(self._stream, "encoding", None) or "utf-8").name

    def isatty(self) -> bool:
        return bool(self._stream.isatty())


def titled(text: str) -> str:
    """``text`` with the titles of its groups, "files options" say, in words; lines stay as long."""
    return re.sub(r"(\w+) options(\S*) (─+| +(?=\n -{5}))", _titled, text)


def _titled(found: re.Match[str]) -> str:
    title = TITLES.get(found[1], found[1])
    return f"{title}{found[2]} " + found[3][0] * (len(found[3]) + len(f"{found[1]} options") - len(title))
