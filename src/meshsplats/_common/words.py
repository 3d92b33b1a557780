"""Directions, colours, times, counts and commands in words: as options have them, and as is printed."""

from __future__ import annotations

import math
import re
import shlex
import sys
import time
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from meshsplats.errors import OptionValueError

if TYPE_CHECKING:
    import numpy as np

NAMED_COLORS: dict[str, tuple[float, float, float]] = {
    "white": (1.0, 1.0, 1.0),
    "black": (0.0, 0.0, 0.0),
    "grey": (0.5, 0.5, 0.5),
    "gray": (0.5, 0.5, 0.5),
}

_NO_CHARACTER = re.compile("[\ud800-\udfff]")
_CONTROL = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")
SOON = 3.0
"""Seconds of a phase before its end is estimated."""


def parse_up(text: str) -> np.ndarray:
    """(3,) direction from ``-y``, ``+z``, ``x`` or ``x,y,z``, the value of an option ``up``.
    OptionValueError for anything else."""
    import numpy as np

    axis = text.lower().lstrip("+-")
    if axis in ("x", "y", "z") and len(text) <= 2:
        direction = np.zeros(3)
        direction["xyz".index(axis)] = -1 if text.startswith("-") else 1
        return direction
    numbers = _numbers(text)
    if numbers is None or not any(numbers):
        raise OptionValueError(
            f"``up`` must be an axis such as -y or z, or three numbers x,y,z, got {text!r}"
        )
    return np.array(numbers)


def optional_up(text: str | None) -> np.ndarray | None:
    """``parse_up`` of an option that may not be given."""
    return None if text is None else parse_up(text)


def direction_in_words(direction: np.ndarray) -> str:
    """An axis, or three numbers, as ``parse_up`` takes them."""
    import numpy as np

    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) > 1 - 1e-6:
        return ("-" if direction[axis] < 0 else "") + "xyz"[axis]
    return ",".join(f"{value:.4g}" for value in direction)


def parse_color(text: str) -> tuple[float, float, float]:
    """RGB in [0, 1] from a name, ``#rrggbb`` or ``r,g,b``, the value of an option ``background``.
    OptionValueError for anything else."""
    if text.lower() in NAMED_COLORS:
        return NAMED_COLORS[text.lower()]
    if text.startswith("#") and len(text) == 7 and all(c in "0123456789abcdefABCDEF" for c in text[1:]):
        red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
        return red, green, blue
    numbers = _numbers(text)
    if numbers is None or not all(0 <= v <= 1 for v in numbers):
        raise OptionValueError(
            f"``background`` must be {', '.join(NAMED_COLORS)}, #rrggbb, or r,g,b from 0 to 1, got {text!r}"
        )
    return numbers


def optional_color(text: str | None) -> tuple[float, float, float] | None:
    """``parse_color`` of an option that may not be given."""
    return None if text is None else parse_color(text)


def _numbers(text: str) -> tuple[float, float, float] | None:
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        return None
    return (x, y, z) if all(map(math.isfinite, (x, y, z))) else None


def legible(text: str) -> str:
    """``text`` with a mark for each byte of a file name that is not UTF-8, which no file of text can hold."""
    return _NO_CHARACTER.sub("\ufffd", text)


def printable(text: str) -> str:
    """``text`` with escapes for what terminals obey and what turns the direction of text, as names in files
    from strangers may have it."""
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], text)


def natural_key(name: str) -> list[int | str]:
    """What names are sorted by for their natural order: ``view_2`` before ``view_10``."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split("([0-9]+)", name))]


def plural(count: int, noun: str, several: str = "") -> str:
    """``1 view``, ``1,200 views``; ``several``: the plural of a noun that has another one."""
    return f"{count:,} {noun if count == 1 else several or f'{noun}s'}"


def naming(text: str, names: Sequence[str]) -> str:
    """A message with the first of ``names`` in front, behind "error:" or "warning:", unless one of them is in
    it."""
    if not names or any(re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text) for name in names):
        return text
    kind = re.match("(error: |warning: )?", text)
    start = kind.end() if kind else 0
    return f"{text[:start]}{names[0]}: {text[start:]}"


def command_line(words: Iterable[object]) -> str:
    """A command as the shell of this system takes it."""
    return " ".join(quoted(str(word)) for word in words)


def quoted(word: str) -> str:
    """An argument of a command, in quotes where the shell of this system needs them. Those of Windows know no
    single quotes, and a backslash is part of a path there; in PowerShell, commas make lists, and @ and ~ have
    meanings at the start of a word."""
    if sys.platform != "win32":
        return shlex.quote(word)
    if re.fullmatch(r"[\w+=:./\\-][\w@+=:./\\~-]*", word):
        return word
    return '"' + re.sub(r"(\\+)$", r"\1\1", word) + '"'


def duration(seconds: float) -> str:
    """A time in words, no more exact than an estimate."""
    if seconds < 90:
        return f"{max(5, 5 * round(seconds / 5))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes / 60:.1f} h"


class Phase:
    """The phase that is shown."""

    def __init__(self) -> None:
        self._name, self._began = "", 0.0

    def begins(self, name: str) -> bool:
        """Whether it is another one than before."""
        if name == self._name:
            return False
        self._name, self._began = name, time.monotonic()
        return True

    def left(self, share: float) -> str:
        """The time left after this ``share`` of it, in words; empty while it is unknown."""
        passed = time.monotonic() - self._began
        return f"{duration(passed * (1 - share) / share)} left" if share and passed > SOON else ""
