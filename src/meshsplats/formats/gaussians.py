"""Splat files: the reader is chosen by content, the writer by suffix."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import get_args

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.kinds import each, need, need_path
from meshsplats._files.atomic import atomic_path
from meshsplats.errors import FileFormatError
from meshsplats.formats.opening import open_splats, to_y_down
from meshsplats.formats.ply.activated import Activated
from meshsplats.formats.ply.splats import write_float_blocks
from meshsplats.formats.reading import Axes, Reading
from meshsplats.formats.sniff import UnreadSplats, content_of, splat_format
from meshsplats.formats.splat_formats import format_to_write, listed, taken_by, written_suffixes
from meshsplats.formats.splat_paths import splat_file
from meshsplats.formats.writing import SpzVersion, Writing
from meshsplats.scene.gaussians import GaussianCloud, Kernel


def load_gaussians(
    path: str | os.PathLike[str],
    *,
    strict: bool = False,
    axes: Axes = "auto",
    kernel: Kernel | None = None,
    time: float | None = None,
    activated: Iterable[Activated] = (),
    origin: Sequence[float] | np.ndarray | None = None,
) -> GaussianCloud:
    """Splats of a file or folder, after activation.

    The content decides the format, not the name: `.ply` (float or PlayCanvas compressed, also gzipped),
    `.splat`, SPZ 1 to 4, SOG (archive, folder or its meta.json), streamed SOG (folder or its lod-meta.json),
    3D Tiles of splats (folder or its tileset.json), glTF and GLB with KHR_gaussian_splatting, USD. Of the
    first three, also the only one in a zip archive.

    A folder is a model of the 3D Gaussian Splatting code, read from the highest iteration of
    ``point_cloud/iteration_*/point_cloud.ply``, or an unpacked SOG file. A streamed SOG scene is read at the
    finest level of detail of each of its nodes; its coarser levels are folders inside it that can be read by
    themselves. Likewise the finest tiles of a tileset; one on the globe has up away from the ground.

    The cloud has y down and z forward, as float .ply files have. Splats with values that are not finite after
    activation (an infinite opacity logit gives 0 or 1, which is finite) or with a zero quaternion are left
    out, with a DataWarning that counts them. What the file says besides its splats counts: the kernel, which
    direction is up (``GaussianCloud.up``), and whether colours are linear; these are converted, with a
    DataWarning.

    Where float32 is too coarse for the coordinates of the file, as for georeferenced scenes, a point near the
    splats is subtracted from them in float64: ``GaussianCloud.origin``. Cameras and meshes of the scene must
    be given relative to it, too: ``load_mesh(path, origin=cloud.origin)``, likewise ``load_cameras`` and
    ``load_dataset``. A DataWarning names files that store such coordinates as float32.

    Args:
        path: the file or folder.
        strict: raise an error for unusable splats instead of the warning.
        axes: the axes of the file. 'auto' follows its format ('y-up' for SPZ and glTF, 'y-down' for the
            others). Some programs write SPZ with y down, which the file does not say. A 'y-up' file is
            rotated by half a turn, about z if it is glTF, about x otherwise.
        kernel: that the splats were trained with, in place of the one that the file names. Third scales of
            '2dgs' splats are 0.
        time: of splats that move in time (Spacetime Gaussians and 4D Gaussian Splatting in a .ply): the
            instant to show, in the file's unit. None: one in the middle, which a DataWarning names.
        activated: of a float .ply: which of 'scales', 'opacities' and 'colors' it stores as they are, not as
            logarithms, logits and harmonics. A DataWarning says where values look so.
        origin: (3,) point of the world (with y down) that ``means`` shall be relative to; by default one that
            suits the splats, zero wherever float32 is fine enough.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: the file is broken, of another kind, or without a single usable splat; the message
            says what is wrong and where.
        ValueError: ``time`` or ``activated`` for a file that has no use for it.
        MissingDependencyError: SPZ 4 without Zstandard.
    """
    need_path(path=path)
    reading = Reading.checked(axes, kernel, time, activated, in_blocks=False)
    point = None if origin is None else checked_array("origin", origin, np.float64, (3,))
    with content_of(splat_file(Path(path))) as content:
        kind = splat_format(content)
        with content.open() as file, closing(open_splats(content, kind, file, reading)) as splats:
            turn = to_y_down(kind, axes, splats.to_y_down)
            own = None if point is None else turn.T @ point
            cloud = reading.finished(splats.read(strict=strict, origin=own), splats)
    if splats.instant is not None and not len(cloud):
        raise FileFormatError(f"{content.path}: none of its splats is visible at time {splats.instant:.6g}")
    cloud = cloud.transformed(turn)
    return cloud if point is None else cloud.relative_to(point)


def format_of(path: str | os.PathLike[str]) -> str | None:
    """Name of the splat format of a file or folder by its first bytes, None if it has none.

    Some containers hold meshes, too: a 'ply', 'gltf' or 'sog' (zip) file may turn out to be one, and any file
    may be broken.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadSplats: the kind is known, but not read.
    """
    try:
        with content_of(splat_file(Path(path))) as content:
            return splat_format(content).name
    except UnreadSplats:
        raise
    except FileFormatError:
        return None


def moving_splats(path: str | os.PathLike[str]) -> tuple[str, float, float] | None:
    """Name of the layout, first and last time of splats that move in time; None for splats at rest.

    Raises FileFormatError for those that move by a formula that is not known.
    """
    with content_of(splat_file(Path(path))) as content:
        return splat_format(content).reader.motion(content)


def save_gaussians(
    cloud: GaussianCloud,
    path: str | os.PathLike[str],
    *,
    spz_version: SpzVersion | None = None,
    linear: bool | None = None,
) -> None:
    """Writes ``cloud`` in the format that the suffix of ``path`` names, whole or not at all.

    - `.ply`: floats, in the layout of the 3D Gaussian Splatting code.
    - `.compressed.ply`: PlayCanvas, 16 bytes a splat and one for each harmonic.
    - `.splat`: 32 bytes a splat, without view-dependent colour.
    - `.spz`: about 15 bytes a splat, 30 with all harmonics. Positions have 24 bits in all, of which as many
      are behind the point as the splats need.
    - `.sog`: about 13 bytes a splat, 20 with all harmonics.
    - `.glb`: floats, with KHR_gaussian_splatting.
    - `.usdc`, `.usda`, `.usd`, `.usdz`: floats, as ParticleField3DGaussianSplat. They need the extra ``usd``.

    All formats but `.ply`, `.glb` and USD quantise: docs/files.md says what is lost of images. They list
    splats in another order, and name ellipsoids by other rotations and scales that mean the same.

    `.ply`, `.compressed.ply`, `.sog`, `.glb` and USD keep the kernel, ``up`` and ``origin``; what another
    format leaves out, a DataWarning says. Other programs see the splats of all formats but `.glb` and USD
    around (0, 0, 0), and with y down where these have y up.
    In `.ply` files, a '2dgs' cloud has two scales; one whose third scales are not 0 gives a DataWarning, and
    is read back as '3dgs'. Opacities of 0 and 1 and scales of 0, whose logits and logarithms are infinite,
    are stored as sigmoid(-30), sigmoid(20) and 1.2e-38.

    Args:
        cloud: the splats.
        path: the file; its suffix decides the format.
        spz_version: (`.spz`; default 3) 4 is read by newer programs only and needs the extra ``formats``.
        linear: (USD; default False) write linear colours, not the display values that splats are trained on.
            The file says which it has; some renderers take all colours as linear all the same. Where splats
            are translucent, images differ.

    Raises:
        ValueError: the suffix is unknown, an option is for another format, or the cloud has no splats.
        MissingDependencyError: a package is missing.
        OSError: the file cannot be written.
    """
    need(GaussianCloud, cloud=cloud, instead={"SplatMesh": "save_mesh writes meshes"})
    need_path(path=path)
    target = Path(path)
    kind = format_to_write(target.name)
    if kind is None:
        known = listed(written_suffixes())
        raise ValueError(f"{target.name!r} does not name a splat format; choose a name that ends in {known}")
    if spz_version not in (None, *get_args(SpzVersion)):
        raise ValueError(f"spz_version must be 3 or 4, got {spz_version!r}")
    writing = Writing(target, spz_version, linear)
    for name in writing.options():
        if name not in kind.writer.takes:
            raise ValueError(f"the option {name} is for {taken_by(name)}, not for {target.name!r}")
    if not len(cloud):
        raise ValueError("no splats to write: the cloud is empty, and no reader takes such a file")
    size = int(kind.writer.bytes_a_splat(cloud.sh.shape[1]) * len(cloud))
    with atomic_path(target, needs=size) as temporary:
        kind.writer.write(cloud, temporary, writing)


def save_gaussian_blocks(
    blocks: Iterable[GaussianCloud],
    path: str | os.PathLike[str],
    count: int,
    *,
    degree: int = 0,
    kernel: Kernel = "3dgs",
    up: np.ndarray | None = None,
) -> None:
    """Writes splats that come in ``blocks`` as a .ply; in memory there is one block at a time.

    The file is that of ``save_gaussians`` for all of them together; positions are relative to the origin of
    the first block.

    Args:
        blocks: clouds whose degree is at most ``degree``; what they lack of it is 0.
        path: the file, whose name ends in .ply.
        count: of all splats together, at least 1.
        degree: of the spherical harmonics, 0 to 3.
        kernel: of the splats. Third scales of '2dgs' splats are left out.
        up: (3,) direction that points up, for a comment; None if it is not known.

    Raises:
        ValueError: the suffix is not .ply, a count or degree out of range, or blocks of another count.
    """
    blocks = each(GaussianCloud, "blocks", blocks)
    need_path(path=path)
    target = Path(path)
    kind = format_to_write(target.name)
    if kind is None or kind.name != "ply":
        raise ValueError(f"blocks are written as float .ply, got {target.name!r}: choose a name that ends so")
    if count < 1 or degree not in (0, 1, 2, 3):
        raise ValueError(f"count must be at least 1 and degree 0 to 3, got {count} and {degree}")
    write_float_blocks(blocks, target, count, (degree + 1) ** 2, kernel, flat=kernel == "2dgs", up=up)
