"""Opens the splats of any file."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from meshsplats.formats._display import say_converted
from meshsplats.formats._orientation import HALF_TURN_X, HALF_TURN_Z
from meshsplats.formats.content import Content
from meshsplats.formats.opened import Splats
from meshsplats.formats.reading import Axes, Reading
from meshsplats.formats.splat_formats import SplatFormat


def open_splats(content: Content, kind: SplatFormat, file: BinaryIO, reading: Reading) -> Splats:
    """The splats of ``content``, of the format ``kind``, which is opened as ``file``. ValueError for options
    that it has no use for."""
    for name in ("activated", "time"):
        if getattr(reading, name) not in (None, ()) and name not in kind.takes:
            raise ValueError(f"{content.path}: {name} is for float .ply files, this is {kind.name}")
    found = kind.reader.open(content, file, reading)
    if reading.time is not None and found.instant is None:
        raise ValueError(f"{content.path}: its splats do not move: time is for those that do")
    if found.linear:
        say_converted(content.path)
    return found if reading.kernel is None else found.with_kernel(reading.kernel)


def to_y_down(kind: SplatFormat, axes: Axes, stored: np.ndarray | None = None) -> np.ndarray:
    """(3, 3) from the axes of a file to y down and z forward; ``stored``: what the file says itself."""
    stored = kind.reader.to_y_down if stored is None else stored
    if axes == "auto" and stored is not None:
        return stored
    if axes == "y-down" or (axes == "auto" and not kind.y_up):
        return np.eye(3)
    return HALF_TURN_Z if kind.half_turn == "z" else HALF_TURN_X
