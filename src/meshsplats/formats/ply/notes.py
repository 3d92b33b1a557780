"""What a .ply says about its splats in comments and small elements: kernel, up, colour space.

Comments and elements of these writers are known, with the sign that their code gives them:

- nerfstudio: ``Vertical Axis: z``, +z of its world.
- Brush: ``Vertical axis: y``, which means -y, or three numbers, whose z has the other sign (its estimate of
  up negates it); ``SplatRenderMode: mip``, ``2dgs`` or ``default``.
- Postshot: ``antialiased 1``.
- Adobe: the elements ``up_axis`` (0 x, 1 y, 2 z) and ``chirality`` (0 left-handed, 1 right-handed).
- SHARP: the element ``color_space`` (0 sRGB, 1 linear).
- This project: ``meshsplats up X Y Z``.
"""

from __future__ import annotations

import re
import warnings
from typing import BinaryIO

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.formats.content import Content
from meshsplats.formats.ply.header import PlyHeader
from meshsplats.formats.ply.table import FloatTable
from meshsplats.scene.gaussians import Kernel

_UP = re.compile(r"(meshsplats up|vertical axis|up[ _-]?axis|up|world[ _-]up) ?[:= ] ?(.+)", re.IGNORECASE)
_AXIS = re.compile(r"([+-]?)([xyz])(?![a-z])", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?", re.IGNORECASE)


def note_comments(kernel: Kernel, up: np.ndarray | None) -> list[str]:
    """Header lines that name a kernel other than '3dgs' that no property tells, and ``up``."""
    lines = ["comment SplatRenderMode: mip"] if kernel == "antialiased" else []
    if up is None:
        return lines
    lines.append("comment meshsplats up " + " ".join(repr(float(u)) for u in up))
    if (np.asarray(up) == (0, 0, 1)).all():
        lines.append("comment Vertical Axis: z")  # as nerfstudio, which others read
    return lines


def kernel_of_comments(comments: tuple[str, ...]) -> Kernel:
    """The kernel that a .ply names in its comments; the last one counts, '3dgs' if there is none."""
    spelt: dict[str, Kernel] = {
        "splatrendermode mip": "antialiased",
        "splatrendermode 2dgs": "2dgs",
        "splatrendermode default": "3dgs",
        "antialiased 1": "antialiased",
        "antialiased 0": "3dgs",
    }
    found = [
        spelt[words] for c in comments if (words := " ".join(c.lower().replace(":", " ").split())) in spelt
    ]
    return found[-1] if found else "3dgs"


def up_in(content: Content) -> np.ndarray | None:
    """``up_of`` the file ``content``."""
    with content.open() as file:
        return up_of(file, content.ply_header, content.path)


def up_of(file: BinaryIO, header: PlyHeader, where: object) -> np.ndarray | None:
    """(3,) float64 direction that points up in the axes of the file, None if it does not say so. Warns where
    a file calls its axes left-handed."""
    if _value(file, header, "chirality", where) == 0:
        warnings.warn(
            f"{where}: its header says that its axes are left-handed; they are read as right-handed, so the"
            " scene may be mirrored",
            DataWarning,
            stacklevel=4,
        )
    axis = _value(file, header, "up_axis", where)
    if axis in (0, 1, 2):
        return np.eye(3)[int(axis)]
    notes = [*header.comments, *header.obj_info]
    by_brush = any(note.lower().startswith("exported from brush") for note in notes)
    found = [up for note in notes if (up := _up_of_note(note, by_brush)) is not None]
    return found[-1] if found else None


def is_linear(file: BinaryIO, header: PlyHeader, where: object) -> bool:
    """Whether the colours are linear, not display values."""
    return _value(file, header, "color_space", where) == 1


def _up_of_note(note: str, by_brush: bool) -> np.ndarray | None:
    said = _UP.fullmatch(" ".join(note.split()))  # without runs of blanks, which it would divide in all ways
    if said is None:
        return None
    if axis := _AXIS.match(said[2]):
        # The very words of Brush, which writes nothing else for scenes with y down.
        downward = axis[0] == "y" and (by_brush or said[1] == "Vertical axis")
        sign = -1.0 if axis[1] == "-" or downward else 1.0
        return sign * np.eye(3)["xyz".index(axis[2].lower())]
    numbers = np.array([float(word) for word in _NUMBER.findall(said[2])])
    if len(numbers) != 3 or not np.isfinite(numbers).all() or not numbers.any():
        return None
    if by_brush and said[1].lower() == "vertical axis":
        numbers[2] = -numbers[2]
    return numbers / np.linalg.norm(numbers)


def _value(file: BinaryIO, header: PlyHeader, name: str, where: object) -> float | None:
    """The value of an element ``name`` of one row and one property, None without such an element."""
    element = header.element(name)
    if element is None or element.count != 1 or len(element.properties) != 1 or element.has_lists:
        return None
    for chunk in FloatTable(file, header, element, element.names, where).chunks():
        return float(chunk[0, 0])
    return None
