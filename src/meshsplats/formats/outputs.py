"""Outputs of a command or program: checked before the work; and the records beside them."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from meshsplats._files.atomic import may_write_in, refuse_existing
from meshsplats.errors import (
    DataWarning,
    EarlierRunError,
    FileFormatError,
    NothingToResumeError,
    OptionsError,
    OptionValueError,
    OverwritingError,
)
from meshsplats.formats.mesh_formats import mesh_format_to_write, written_mesh_suffixes
from meshsplats.formats.splat_formats import format_to_write, listed, taken_by, written_suffixes
from meshsplats.formats.splat_paths import splat_file

Scene = TypeVar("Scene", "GaussianCloud", "SplatMesh", "BaseMesh", "GaussianCloud | SplatMesh")
WantedOrigin = Literal["keep", "local"] | Sequence[float]
"""Where outputs of scenes stand: see ``placed``."""

CONFIGURATION, CAMERAS, PREVIEW = "config.toml", "cameras.json", "preview.png"
"""Records. In a folder of results they have these names; ``beside`` a single file, its name before."""

if TYPE_CHECKING:
    from meshsplats.scene.base_mesh import BaseMesh
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh

    MeshEnding = str
    Ending = str
else:
    # The default of the commands comes first.
    _MESHES = sorted((s[1:] for s in written_mesh_suffixes()), key=lambda ending: ending != "glb")
    _SPLATS = [s[1:] for s in written_suffixes() if s not in written_mesh_suffixes()]
    MeshEnding = Literal[tuple(_MESHES)]
    """Of meshes that are written, without the dot."""
    Ending = Literal[tuple(_MESHES + _SPLATS)]
    """Of files that are written, meshes and splats, without the first dot."""


def beside(output: Path, record: str) -> Path:
    """Name of a record of the file ``output``: with the whole name of that, so that records of ``mesh.glb``
    and ``mesh.png`` are different files."""
    return output.with_name(f"{output.name}.{record}")


def view_names(count: int, prefix: str = "view", suffix: str = ".png") -> Sequence[str]:
    """File names of ``count`` views, numbered for video tools; names from camera files never become paths."""
    return [f"{prefix}_{i:04d}{suffix}" for i in range(count)]


def means_splats(kinds: Sequence[str]) -> bool:
    """Whether files with these endings, without a dot, can only be splats, not meshes."""
    return bool(kinds) and all(
        f".{k}" in written_suffixes() and f".{k}" not in written_mesh_suffixes() for k in kinds
    )


def splat_options(kinds: Sequence[str], **given: Any) -> list[dict[str, Any]]:
    """Of the options of ``save_gaussians`` that are ``given``, not None, those that files with these endings
    take. ValueError for one that none of them takes."""
    given = {name: value for name, value in given.items() if value is not None}
    formats = [format_to_write(f".{kind}") for kind in kinds]
    taken = [{n: v for n, v in given.items() if f and n in f.writer.takes} for f in formats]
    for name in given:
        if not any(name in options for options in taken):
            raise ValueError(f"{name} is for splats as {taken_by(name)}")
    return taken


def scaled(scene: Scene, factor: float | None) -> Scene:
    """``scene`` with all lengths, from the origin of the world on, times ``factor``; None: as it is.
    ValueError for a mesh that is bound to a base mesh, whose lengths are those of the base."""
    import numpy as np

    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh

    if factor is None:
        return scene
    if isinstance(scene, GaussianCloud):
        return scene.transformed(np.eye(3) * factor)
    if isinstance(scene, SplatMesh) and scene.binding is not None:
        raise ValueError("a mesh prior has the lengths of its base mesh: scale the base and bind to that")
    return replace(scene, vertices=scene.vertices * np.float32(factor), origin=scene.origin * factor)


def placed(scene: Scene, origin: WantedOrigin) -> Scene:
    """``scene`` as it is to be written: with its origin ("keep"), without any ("local"), or relative to this
    point of the world. OptionsError for a point that is too far away for float32, a DataWarning where only
    details are lost there, OptionValueError for any other word."""
    import numpy as np

    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.origin import lost_between, lost_detail, sampled

    check_origin(origin)
    if isinstance(origin, str):
        return scene if origin == "keep" else replace(scene, origin=np.zeros(3))
    places = scene.means if isinstance(scene, GaussianCloud) else scene.vertices
    there = sampled(places) + (scene.origin - origin)
    if lost := lost_detail(there):
        raise OptionsError(f"``origin``: too far from the scene; relative to that point, {lost}")
    if lost := lost_between(there, _size_of(scene)):
        warnings.warn(f"``origin``: relative to that point, {lost}", DataWarning, stacklevel=2)
    return replace(scene.relative_to(origin), origin=np.zeros(3))


def _size_of(scene: GaussianCloud | SplatMesh | BaseMesh) -> float:
    """Usual size of a splat or a triangle, scene units; of a sample of them."""
    import numpy as np

    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.origin import sampled, usual_size

    if isinstance(scene, GaussianCloud):
        return usual_size(scene.scales) if len(scene) else 0.0
    if not len(scene.faces):
        return 0.0
    a, b, _ = sampled(scene.faces).astype(int).T
    return float(np.median(np.linalg.norm(scene.vertices[a] - scene.vertices[b], axis=1)))


def check_origin(origin: WantedOrigin) -> None:
    """OptionValueError for a word that ``placed`` does not know."""
    if isinstance(origin, str) and origin not in ("keep", "local"):
        raise OptionValueError(f"``origin`` must be 'keep', 'local' or three numbers, got {origin!r}")


def check_mesh_suffix(path: Path, remedy: str = "") -> None:
    """OptionsError, which ends with the ``remedy``, if no mesh can be written under this name."""
    if mesh_format_to_write(path) is None:
        known = ", ".join(written_mesh_suffixes())
        if path.suffix.lower() in (".stl", ".3mf"):
            remedy = f"; 'meshsplats surface' makes solids for printing, as {path.suffix}"
        raise OptionsError(f"``output`` must end in {known}, got {path.name!r}{remedy}")


def check_splat_endings(*kinds: str) -> None:
    """OptionsError if no splats can be written to files that end in ``kinds``, without a dot."""
    for kind in kinds:
        if f".{kind}" not in written_suffixes():
            raise OptionsError(f"splats are written as {listed(written_suffixes())}, not as .{kind}")


def check_mesh_endings(*kinds: str) -> None:
    """OptionsError if one of the files that end in ``kinds``, without a dot, cannot be a mesh."""
    known, endings = written_mesh_suffixes(), tuple(f".{kind}" for kind in kinds)
    if not (others := tuple(ending for ending in endings if ending not in known)):
        return
    if not set(others) <= set(written_suffixes()):
        raise OptionsError(f"meshes are written as {listed(known)}, not as {listed(others)}")
    meshes = tuple(ending for ending in endings if ending in known)
    way = "``as_splats``" if set(meshes) <= set(written_suffixes()) else ""
    if meshes:
        way = "write one of the two by a second command" + (way and f", or all as splats: {way}")
        raise OptionsError(f"{listed(meshes, 'and')} would be meshes, {listed(others, 'and')} splats: {way}")
    raise OptionsError(f"{listed(others, 'and')} files hold splats: {way}")


def recorded_options(path: Path, name: str | None = None) -> dict[str, Any] | None:
    """The options in the configuration file at ``path``; None if there is none, or of another command than
    ``name``."""
    from meshsplats._common import toml  # Python 3.10 has no parser of its own

    try:
        record = toml.load(path)
        return dict(record["options"]) if name in (None, record["command"]) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def check_folder_name(path: Path) -> None:
    """OptionsError if ``path``, which is to be a folder, is named as a file of splats or of a mesh."""
    if path.suffix.lower() in (*written_mesh_suffixes(), *written_suffixes(), ".json"):
        raise OptionsError(f"``output`` must name a folder, got {path.name!r}")


def check_outputs(
    paths: Sequence[Path], force: bool, folder: Path | None = None, *, inputs: Sequence[Path] = ()
) -> None:
    """Checks outputs before the work. ``folder`` holds all of them and is made later, but not the one above
    it: a misspelt path must not make a tree of folders.

    Raises:
        OSError: an output exists already (unless ``force``) or cannot be written.
        OverwritingError: an output is one of ``inputs``, with ``force``, too.
    """
    read = [file_of(source) for source in inputs if source.exists()]
    for path in paths:
        if path.exists() and any(path.samefile(source) for source in read):
            raise OverwritingError(f"{path} is read by this command: give another name for the output")
    refuse_existing(paths, force)
    if folder is not None and folder.exists() and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "must be a folder, this is a file", str(folder))
    exists = folder is not None and folder.exists()
    places = {folder} if exists else {(folder or path).absolute().parent for path in paths}
    for above in filter(None, places):
        if not above.is_dir():
            raise FileNotFoundError(errno.ENOENT, "this folder for the output does not exist", str(above))
        if not may_write_in(above):
            if hasattr(os, "statvfs") and os.statvfs(above).f_flag & os.ST_RDONLY:
                raise OSError(errno.EROFS, "this folder is on a read-only file system", str(above))
            raise PermissionError(errno.EACCES, "no permission to write in this folder", str(above))


def check_resumption(
    folder: Path, unfinished: Path, record: str | Path, *, resume: bool, replace_old: bool
) -> None:
    """Checks what is left of an earlier run that was to make ``folder``: the folder ``unfinished``, which is
    of that command if it holds a ``record``.

    Raises:
        FileNotFoundError: there is nothing to ``resume``.
        FileExistsError: something is left, and is neither to be resumed nor replaced, or of another origin.
    """
    known = (unfinished / record).is_file()
    if resume and not known:
        way = "leave out ``resume`` to start"
        if unfinished.exists():
            way = "it is not of this command: remove it, and leave out ``resume``"
        elif folder.exists():
            way = f"``replace_old``, not ``resume``, replaces {folder}"
        raise NothingToResumeError(f"nothing to resume in {unfinished}: {way}")
    if unfinished.exists() and not known:
        raise FileExistsError(
            f"{unfinished} exists and is not of this command: remove it, or give another folder"
        )
    if known and not (resume or replace_old):
        raise EarlierRunError(
            f"{unfinished} is left from an earlier run: ``resume`` continues it, ``replace_old`` starts again"
        )


def file_of(source: Path) -> Path:
    """The file that is read where ``source`` is a folder."""
    try:
        return splat_file(source) if source.is_dir() else source
    except FileFormatError:
        return source
