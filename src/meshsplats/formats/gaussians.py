"""Splat files: the reader is chosen by content, the writer by suffix."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args

import numpy as np

from meshsplats._arrays import checked_array
from meshsplats._foreign import IMAGE_SUFFIXES
from meshsplats._kinds import described, each, need, need_path, require_path
from meshsplats._origin import choose_origin, sampled
from meshsplats.errors import FileFormatError
from meshsplats.formats._display import display_cloud, say_converted
from meshsplats.formats._orientation import HALF_TURN_X, HALF_TURN_Z
from meshsplats.formats._validation import Budget
from meshsplats.formats.gltf.splats import read_splat_gltf
from meshsplats.formats.ply.activated import Activated, checked_activated
from meshsplats.formats.ply.compressed_splats import read_compressed_ply
from meshsplats.formats.ply.motion import VISIBLE
from meshsplats.formats.ply.notes import up_of
from meshsplats.formats.ply.splats import motion_in, read_float_ply, write_float_blocks, write_float_ply
from meshsplats.formats.sniff import Content, SplatFormat, UnreadSplats, identify
from meshsplats.formats.splats._cloud_builder import SplatReader
from meshsplats.formats.splats.dot_splat import read_dot_splat
from meshsplats.formats.splats.sog import read_sog
from meshsplats.formats.splats.spz import open_spz, read_spz
from meshsplats.formats.splats.streamed_sog import read_streamed_sog, streamed_corners, streamed_parts
from meshsplats.gaussians import GaussianCloud, Kernel, shared_up

Axes = Literal["auto", "y-down", "y-up"]
SPLAT_SUFFIXES = (".ply", ".ply.gz", ".splat", ".spz", ".sog", ".glb", ".gltf")
"""How the names of splat files end, wherever names decide: which files of a folder are read."""
_MODEL_FILES = ("point_cloud.ply", "point_cloud.ply.gz")
"""Names of the splats in a model folder; the first that is there counts."""
_OF_PHOTOGRAPHS = (
    *("transforms.json", "transforms_train.json", "sparse", "poses_bounds.npy"),
    *("cameras.bin", "cameras.txt", "dense"),
)
"""Names that tell a data set of photographs."""
_DOUBLE_SUFFIXES = (".compressed.ply", ".compressed.ply.gz", ".ply.gz")


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
    glTF and GLB with KHR_gaussian_splatting. Of the first three, also the only one in a zip archive.

    A folder is a model of the 3D Gaussian Splatting code, read from the highest iteration of
    ``point_cloud/iteration_*/point_cloud.ply``, or an unpacked SOG file. A streamed SOG scene is read at the
    finest level of detail of each of its nodes; its coarser levels are folders inside it that can be read by
    themselves.

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
    reading = _Reading(axes, kernel, time, activated)
    found = splat_file(Path(path))
    content = Content(found)
    kind, stored = content.splat_format(), None
    point = None if origin is None else checked_array("origin", origin, np.float64, (3,))
    own = None if point is None else _to_y_down(kind, axes, None).T @ point
    with content.open() as file:
        reader = reading.reader(content, kind, file, found)
        if reader is not None:
            cloud = reading.finished(reader.read(strict=strict, origin=own), reader)
            if not len(cloud):
                raise FileFormatError(f"{found}: none of its splats is visible at time {reader.instant:.6g}")
        elif kind == "spz":
            cloud, stored = read_spz(file.read(), found, Budget(found), strict=strict)
        elif kind == "streamed sog":
            own = choose_origin(streamed_corners(found)) if own is None else own
            cloud = read_streamed_sog(found, strict=strict, origin=own)
        else:
            cloud = read_splat_gltf(found, strict=strict, origin=own)
    cloud = reading.of_kernel(cloud).transformed(_to_y_down(kind, axes, stored))
    return cloud if point is None else cloud.relative_to(point)


class _Reading:
    """How files are read: checked arguments of ``load_gaussians``."""

    def __init__(
        self,
        axes: Axes,
        kernel: Kernel | None,
        time: float | None,
        activated: Iterable[Activated],
    ) -> None:
        if axes not in get_args(Axes):
            raise ValueError(f"axes must be one of {', '.join(get_args(Axes))}, got {axes!r}")
        if kernel is not None and kernel not in get_args(Kernel):
            raise ValueError(f"kernel must be one of {', '.join(get_args(Kernel))}, got {kernel!r}")
        if time is not None and not np.isfinite(time):
            raise ValueError(f"time must be a finite number, got {time!r}")
        self.kernel = kernel
        self.time = None if time is None else float(time)
        self.activated = checked_activated(activated)

    def reader(self, content: Content, kind: SplatFormat, file: BinaryIO, path: Path) -> SplatReader | None:
        """The reader of the formats that are read in the same way as a whole and in blocks."""
        if kind != "ply" and (self.activated or self.time is not None):
            given = "activated" if self.activated else "time"
            raise ValueError(f"{path}: {given} is for float .ply files, this is {kind}")
        found: SplatReader | None = None
        if kind == "ply":
            found = read_float_ply(file, content.ply_header, path, time=self.time, activated=self.activated)
            if self.time is not None and found.instant is None:
                raise ValueError(f"{path}: its splats do not move: time is for those that do")
        elif kind == "compressed.ply":
            found = read_compressed_ply(file, content.ply_header, path)
        elif kind == "splat":
            found = read_dot_splat(file, path)
        elif kind == "sog":
            found = read_sog(path, Budget(path))
        if found is not None and found.linear:
            say_converted(path)
        return found if found is None or self.kernel is None else replace(found, kernel=self.kernel)

    def finished(self, cloud: GaussianCloud, reader: SplatReader) -> GaussianCloud:
        """Splats of ``reader`` with display colours and up, those that are visible at the instant."""
        if reader.instant is not None:
            cloud = cloud.take(cloud.opacities >= VISIBLE)
        if reader.linear:
            cloud = display_cloud(cloud)
        return cloud if reader.up is None else replace(cloud, up=reader.up)

    def of_kernel(self, cloud: GaussianCloud) -> GaussianCloud:
        """``cloud`` with the kernel that is asked for."""
        if self.kernel is None or self.kernel == cloud.kernel:
            return cloud
        scales = cloud.scales
        if self.kernel == "2dgs":
            scales = scales * np.array([1, 1, 0], np.float32)
        return replace(cloud, kernel=self.kernel, scales=scales)


def _to_y_down(kind: SplatFormat, axes: Axes, stored: np.ndarray | None) -> np.ndarray:
    """(3, 3) from the axes of a file to y down and z forward; ``stored``: what the file says itself."""
    turn = HALF_TURN_Z if kind == "gltf" else HALF_TURN_X
    if axes == "auto" and stored is not None:
        return stored
    return turn if axes == "y-up" or (axes == "auto" and kind == "gltf") else np.eye(3)


class SplatStream:
    """The splats of files in blocks of about ``block`` splats, in the order of the files.

    Each iteration reads the files anew, and memory does not grow with them. SOG and glTF are exceptions:
    images are unpacked as a whole (24 bytes a splat; one part at a time of a streamed scene), and a glTF file
    is read before it is cut into blocks. Blocks of one file have the same degree and kernel.

    Concretely, the blocks of a file together are ``load_gaussians`` of it, to the last bit. Blocks of several
    files have one origin, which suits all of them.
    """

    def __init__(
        self,
        paths: Sequence[str | os.PathLike[str]],
        *,
        block: int = 1 << 16,
        strict: bool = False,
        axes: Axes = "auto",
        kernel: Kernel | None = None,
        time: float | None = None,
        activated: Iterable[Activated] = (),
        origin: Sequence[float] | np.ndarray | None = None,
    ) -> None:
        self._reading = _Reading(axes, kernel, time, activated)
        if isinstance(paths, (str, os.PathLike)):
            what = described(paths)
            raise TypeError(f"paths must be a list of paths, got {what}: stream_gaussians(path) opens one")
        for i, path in enumerate(paths):
            require_path(f"paths[{i}]", path)
        if isinstance(block, bool) or not isinstance(block, (int, np.integer)) or block < 1:
            raise ValueError(f"block must be a number of splats, at least 1, got {block!r}")
        self.paths = tuple(Path(path) for path in paths)
        """The files, in their order."""
        self.block, self.strict, self.axes = int(block), strict, axes
        self._origin = None if origin is None else checked_array("origin", origin, np.float64, (3,))

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64 origin of all blocks. The files are looked at when it is first needed."""
        if self._origin is None:
            if len(self.paths) == 1:
                self._origin = self._looked_at(self.paths[0], alone=True)
            else:
                samples = [self._looked_at(path, alone=False) for path in self.paths]
                self._origin = choose_origin(np.concatenate([np.empty((0, 3)), *samples]))
        return self._origin

    def __iter__(self) -> Iterator[GaussianCloud]:
        for path in self.paths:
            yield from self._of(path)

    def _looked_at(self, path: Path, *, alone: bool) -> np.ndarray:
        """(3,) the origin of the file ``path`` by itself if it is ``alone``, else a sample (k, 3) of its
        positions in the world; with y down."""
        content = Content(path)
        kind, stored = content.splat_format(), None
        reader = whole = None
        with content.open() as file, ExitStack() as opened:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of the file come when it is read
                if kind == "spz" and content.member is not None:
                    whole, stored = read_spz(file.read(), path, Budget(path), strict=self.strict)
                elif kind == "spz":
                    reader, stored, close = open_spz(path)
                    opened.callback(close)
                elif kind == "gltf":
                    whole = read_splat_gltf(path, strict=self.strict)
                else:
                    reader = self._reading.reader(content, kind, file, path)
            if reader is not None:
                found = reader.chosen_origin() if alone else reader.world_sample()
            elif whole is not None:
                found = whole.origin if alone else sampled(whole.means) + whole.origin
            else:
                corners = streamed_corners(path)
                found = choose_origin(corners) if alone else corners
        return found @ _to_y_down(kind, self.axes, stored).T + 0.0

    def _of(self, path: Path) -> Iterator[GaussianCloud]:
        origin = self.origin
        content, reading = Content(path), self._reading
        kind, stored = content.splat_format(), None
        with content.open() as file:
            reader = reading.reader(content, kind, file, path)
            whole: GaussianCloud | None = None
            if kind == "spz" and content.member is not None:  # its streams are not apart there
                whole, stored = read_spz(file.read(), path, Budget(path), strict=self.strict)
            elif kind == "spz":
                reader, stored, _ = open_spz(path)
            readers: Iterable[SplatReader] = () if reader is None else (reader,)
            if kind == "streamed sog":
                readers = (part for _, part, _ in streamed_parts(path))
            to_y_down = _to_y_down(kind, self.axes, stored)
            own = to_y_down.T @ origin
            for reader in readers:
                for block in reader.blocks(self.block, strict=self.strict, origin=own):
                    block = reading.of_kernel(reading.finished(block, reader))
                    if len(block):
                        yield block.transformed(to_y_down)
        if kind == "gltf":
            whole = read_splat_gltf(path, strict=self.strict, origin=own)
        if whole is not None:
            whole = whole.relative_to(own)
            for start in range(0, len(whole), self.block):
                part = np.arange(start, min(start + self.block, len(whole)))
                yield reading.of_kernel(whole.take(part)).transformed(to_y_down)

    @property
    def reading(self) -> list[Any]:
        """What the splats depend on besides the files, for JSON: ``axes``, ``strict``, and what is given of
        ``kernel``, ``time`` and ``activated``."""
        own = self._reading
        given = {"kernel": own.kernel, "time": own.time, "activated": sorted(own.activated) or None}
        changed = {name: value for name, value in given.items() if value is not None}
        return [self.axes, self.strict, *([changed] if changed else [])]

    @cached_property
    def up(self) -> np.ndarray | None:
        """(3,) unit direction that points up, where all of the files say so, and the same."""
        return shared_up([self._up(path) for path in self.paths])

    def _up(self, path: Path) -> np.ndarray | None:
        content = Content(path)
        kind = content.splat_format()
        if kind not in ("ply", "compressed.ply"):
            return None
        with content.open() as file:
            up = up_of(file, content.ply_header, path)
        return None if up is None else _to_y_down(kind, self.axes, None) @ up


def stream_gaussians(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    block: int = 1 << 16,
    strict: bool = False,
    axes: Axes = "auto",
    kernel: Kernel | None = None,
    time: float | None = None,
    activated: Iterable[Activated] = (),
    origin: Sequence[float] | np.ndarray | None = None,
) -> SplatStream:
    """Splats of files that are larger than memory, in blocks.

    Args:
        path: a file or folder as for ``load_gaussians``; several of them; or a folder of splat files, which
            are read in the order of their names; meshes among them are left out.
        block: about this many splats at a time.
        strict, axes, kernel, time, activated, origin: as for ``load_gaussians``; one origin for all files.

    Returns:
        A stream of clouds, which can be iterated over several times. Errors and warnings of
        ``load_gaussians`` come while it is read.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: a folder without splats.
    """
    if isinstance(path, (str, os.PathLike)) or not isinstance(path, Sequence):
        need_path(path=path)
        path = [path]
    given = list(path)
    for i, one in enumerate(given):
        require_path(f"path[{i}]", one)
    if not given:
        raise ValueError("name at least one splat file")
    files = [file for one in given for file in _splat_files(Path(one))]
    return SplatStream(
        files,
        block=block,
        strict=strict,
        axes=axes,
        kernel=kernel,
        time=time,
        activated=activated,
        origin=origin,
    )


def _splat_files(path: Path) -> list[Path]:
    """The file of a model or the splat files of a folder, by name."""
    try:
        return [splat_file(path)]
    except FileFormatError:
        if not path.is_dir():
            raise
        found = [part for part in files_named(path, SPLAT_SUFFIXES) if not _is_mesh(part)]
        if not found:
            raise
        return found


def files_named(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The files of ``folder`` whose names end in one of ``suffixes``, by name; hidden ones are left out."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.name.lower().endswith(tuple(suffixes)) and not path.name.startswith(".") and path.is_file()
    )


def _is_mesh(path: Path) -> bool:
    try:
        return identify(path) == "mesh"
    except FileFormatError:  # broken, or a download that failed: its reader says so
        return False


def splat_format(path: str | os.PathLike[str]) -> SplatFormat | None:
    """The splat format of a file or folder by its first bytes, None if it has none.

    Some containers hold meshes, too: a 'ply', 'gltf' or 'sog' (zip) file may turn out to be one, and any file
    may be broken.

    Raises:
        FileNotFoundError: there is no such file.
        UnreadSplats: the kind is known, but not read.
    """
    try:
        return Content(splat_file(Path(path))).splat_format()
    except UnreadSplats:
        raise
    except FileFormatError:
        return None


def moving_splats(path: str | os.PathLike[str]) -> tuple[str, float, float] | None:
    """Name of the layout, first and last time of splats that move in time; None for splats at rest.

    Raises FileFormatError for those that move by a formula that is not known.
    """
    content = Content(splat_file(Path(path)))
    if content.splat_format() != "ply":
        return None
    with content.open() as file:
        return motion_in(file, content.ply_header, content.path)


def save_gaussians(cloud: GaussianCloud, path: str | os.PathLike[str]) -> None:
    """Writes ``cloud`` as a float .ply in the layout of the 3D Gaussian Splatting code, whole or not at all.

    Opacities of 0 and 1 and scales of 0, whose logits and logarithms are infinite, are stored as
    sigmoid(-30), sigmoid(20) and 1.2e-38. A '2dgs' cloud is written with its first two scales, as in 2DGS
    files, and an 'antialiased' one with the comment ``SplatRenderMode: mip``, so that both kernels are read
    back. A '2dgs' cloud whose third scales are not 0 does not fit two scales: it is written with three, with
    a DataWarning, and is read back as '3dgs'. ``up`` becomes the comment ``meshsplats up X Y Z``, and
    ``Vertical Axis: z``, too, if it is +z.

    Positions are written relative to the cloud's ``origin``, which a comment names: other programs see such
    splats around (0, 0, 0), this one puts them back into the world.

    Raises:
        ValueError: the suffix is not .ply, or the cloud has no splats.
    """
    need(GaussianCloud, cloud=cloud, instead={"SplatMesh": "save_mesh writes meshes"})
    need_path(path=path)
    target = Path(path)
    if target.suffix.lower() != ".ply":
        raise ValueError(f"splats are written as .ply, got {target.name!r}: choose a name that ends in .ply")
    if not len(cloud):
        raise ValueError("no splats to write: the cloud is empty, and no reader takes such a file")
    write_float_ply(cloud, target)


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
    if target.suffix.lower() != ".ply":
        raise ValueError(f"splats are written as .ply, got {target.name!r}: choose a name that ends in .ply")
    if count < 1 or degree not in (0, 1, 2, 3):
        raise ValueError(f"count must be at least 1 and degree 0 to 3, got {count} and {degree}")
    write_float_blocks(blocks, target, count, (degree + 1) ** 2, kernel, flat=kernel == "2dgs", up=up)


def subject_name(path: Path, *, ending: bool = False) -> str:
    """A name for the contents of ``path``: the file's without its suffix, or the folder's where all such
    files have one name (``point_cloud.ply`` of a model, ``meta.json`` of SOG). With its ``ending``, if that
    is asked for."""
    if path.name in (*_MODEL_FILES, "meta.json", "lod-meta.json"):
        folder = path.absolute().parent
        if re.fullmatch(r"iteration_[0-9]+", folder.name):
            folder = folder.parent
        if folder.name == "point_cloud":
            folder = folder.parent
        return (folder.name or path.stem) + ("".join(path.suffixes) if ending else "")
    if path.is_dir():
        return path.absolute().name or "scene"
    name = path.name
    suffixes = [end for end in (*_DOUBLE_SUFFIXES, path.suffix) if end and name.lower().endswith(end.lower())]
    longest = 0 if ending else max(map(len, suffixes), default=0)
    return name[: len(name) - longest] or name


def _model_file(folder: Path) -> Path | None:
    return next((folder / name for name in _MODEL_FILES if (folder / name).is_file()), None)


def splat_file(path: Path) -> Path:
    """The file to read for ``path``: itself, or the latest one in a model folder."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_file():
        return path
    if not path.is_dir():
        raise FileFormatError(f"{path}: neither a file nor a folder")
    if (path / "meta.json").is_file():
        return path / "meta.json"
    if (path / "lod-meta.json").is_file():
        return path / "lod-meta.json"
    for folder in (path / "point_cloud", path):
        iterations = [
            (int(match[1]), found)
            for place in folder.glob("iteration_*")
            if (match := re.fullmatch(r"iteration_([0-9]{1,15})", place.name))
            and (found := _model_file(place))
        ]
        if iterations:
            return max(iterations)[1]
        if found := _model_file(folder):
            return found
    if (path / "tileset.json").is_file():
        raise FileFormatError(f"{path}: a tileset, not splats; render and info take it")
    photographs = [name for name in _OF_PHOTOGRAPHS if (path / name).exists()]
    if photographs:
        raise FileFormatError(
            f"{path}: photographs, not splats ({photographs[0]} is there); commands take them with --data,"
            " load_dataset reads them"
        )
    if images := files_named(path, IMAGE_SUFFIXES):
        raise FileFormatError(
            f"{path}: a folder of images ({images[0].name} is there), not splats; 'meshsplats train' makes a"
            " mesh of photographs"
        )
    raise FileFormatError(
        f"{path}: a folder without splats; expected a model folder with"
        " point_cloud/iteration_*/point_cloud.ply"
    )
