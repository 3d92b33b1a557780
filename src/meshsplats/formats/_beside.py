"""Files that a file names, which must lie in its folder or below."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from meshsplats.errors import DataWarning, FileFormatError


def file_beside(path: Path, name: bytes) -> Path:
    """The file ``name`` in the folder of ``path`` or below. FileFormatError if it lies elsewhere."""
    folder = Path(os.path.realpath(path)).parent
    clean = os.fsdecode(name).replace("\\", "/")
    parts = PurePosixPath(clean).parts
    bad = "\0" in clean or not 0 < len(clean) <= 1000 or clean.startswith("/") or ".." in parts
    target = (
        folder if bad or PureWindowsPath(clean).drive else Path(os.path.realpath(folder.joinpath(*parts)))
    )
    if folder not in target.parents:
        raise FileFormatError(
            f"{path}: refers to {shown_name(name)!r} outside its folder; refused. Put it beside the mesh"
        )
    return target


def shown_name(name: bytes) -> str:
    """``name`` for messages."""
    return name[:80].decode("utf-8", "replace")


def warn_of_missing(path: Path, names: Sequence[str], stacklevel: int) -> None:
    """A DataWarning that ``path`` refers to files of these ``names``, if any, that are not there."""
    if names:
        warnings.warn(
            f"{path}: missing: {', '.join(names[:5])}; faces that need it have no texture",
            DataWarning,
            stacklevel=stacklevel + 1,
        )
