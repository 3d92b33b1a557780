"""Files that a file names, which must lie in its folder or below."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from meshsplats._common.json_files import can_be_named
from meshsplats.errors import DataWarning, FileFormatError


def file_beside(path: Path, name: bytes) -> Path:
    """The file ``name``, also a whole path, in the folder of ``path`` or below. Of a name that leads
    elsewhere, as on the machine of whoever made the file, the last part counts; FileFormatError if no such
    file is there."""
    clean = os.fsdecode(name).replace("\\", "/")
    if "\0" not in clean and 0 < len(clean) <= 1000:
        folder = Path(os.path.realpath(path)).parent
        clean = _below(clean, Path(os.path.abspath(path)).parent, folder)
        parts = PurePosixPath(clean).parts
        leads_out = clean.startswith("/") or ".." in parts or bool(PureWindowsPath(clean).drive)
        named = folder.joinpath(*(parts[-1:] if leads_out else parts))
        if not can_be_named(named):
            raise FileFormatError(f"{path}: refers to {shown_name(name)!r}, which is no name of a file")
        target = Path(os.path.realpath(named))
        if folder in target.parents and (not leads_out or target.is_file()):
            return target
    raise FileFormatError(
        f"{path}: refers to {shown_name(name)!r} outside its folder; refused. Put it beside the mesh"
    )


def _below(name: str, *folders: Path) -> str:
    """``name``, relative to the first of the ``folders`` that it begins with; by the text alone."""
    for folder in folders:
        if Path(name).is_absolute() and Path(name).is_relative_to(folder):
            return Path(name).relative_to(folder).as_posix()
    return name


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
