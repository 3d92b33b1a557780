"""Splat files: the reader is chosen by content, the writer by suffix."""

from __future__ import annotations

import os
import re
from pathlib import Path

from meshsplats.errors import FileFormatError
from meshsplats.formats.ply_header import read_header
from meshsplats.formats.splat_ply import read_float_ply, write_float_ply
from meshsplats.gaussians import GaussianCloud


def load_gaussians(path: str | os.PathLike[str], *, strict: bool = False) -> GaussianCloud:
    """Splats of a file or of a model folder, after activation.

    A folder is a model of the 3D Gaussian Splatting code: the ``point_cloud/iteration_*/point_cloud.ply`` of
    the highest iteration is read.

    Splats with values that are not finite after activation (an infinite opacity logit is finite: 0 or 1), or
    with a zero quaternion, are left out with a DataWarning that counts them; with ``strict`` they are an
    error.

    Raises FileNotFoundError, or FileFormatError for a file that is broken, of another kind, or without a
    single usable splat; the message says what is wrong and where.
    """
    file_path = _splat_file(Path(path))
    with file_path.open("rb") as file:
        magic = file.read(8)
        file.seek(0)
        if not magic:
            raise FileFormatError(f"{file_path}: the file is empty")
        if re.match(rb"ply[ \t]*[\r\n]", magic):
            header = read_header(file, file_path)
            return read_float_ply(file, header, file_path, strict=strict)
    raise FileFormatError(
        f"{file_path}: not a splat file that is known here, it begins with {magic!r}; expected a .ply with"
        " splats"
    )


def save_gaussians(cloud: GaussianCloud, path: str | os.PathLike[str]) -> None:
    """Writes ``cloud`` as a float .ply laid out as by the 3D Gaussian Splatting code, whole or not at all.

    Opacities of 0 and 1 and scales of 0, whose logits and logarithms are infinite, are stored as
    sigmoid(-30), sigmoid(20) and 1.2e-38. A '2dgs' cloud is written with its first two scales, as 2DGS files
    have it, an 'antialiased' one with the comment ``SplatRenderMode: mip``, so that both read back as what
    they are. A '2dgs' cloud whose third scales are not 0 does not fit two scales: it is written with three,
    with a DataWarning, and reads back as '3dgs'.

    Raises ValueError for another suffix than .ply or for a cloud without splats.
    """
    target = Path(path)
    if target.suffix.lower() != ".ply":
        raise ValueError(f"splats are written as .ply, got {target.name!r}: choose a name that ends in .ply")
    if not len(cloud):
        raise ValueError("no splats to write: the cloud is empty, and no reader takes such a file")
    write_float_ply(cloud, target)


def _splat_file(path: Path) -> Path:
    """The file that ``path`` stands for: itself, or the newest one of a model folder."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_file():
        return path
    if not path.is_dir():
        raise FileFormatError(f"{path}: neither a file nor a folder")
    for folder in (path / "point_cloud", path):
        iterations = [
            (int(match[1]), found)
            for found in folder.glob("iteration_*/point_cloud.ply")
            if (match := re.fullmatch(r"iteration_([0-9]{1,15})", found.parent.name)) and found.is_file()
        ]
        if iterations:
            return max(iterations)[1]
        if (folder / "point_cloud.ply").is_file():
            return folder / "point_cloud.ply"
    raise FileFormatError(
        f"{path}: a folder without splats; expected a model folder with"
        " point_cloud/iteration_*/point_cloud.ply"
    )
