"""Names of splat files: which file of a folder is meant, what the subject is called."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from meshsplats._common.foreign import IMAGE_SUFFIXES
from meshsplats.errors import FileFormatError
from meshsplats.formats.splat_formats import double_suffixes, folder_files

_MODEL_FILES = ("point_cloud.ply", "point_cloud.ply.gz")
"""Names of the splats in a model folder; the first that is there counts."""
_OF_PHOTOGRAPHS = (
    *("transforms.json", "transforms_train.json", "sparse", "poses_bounds.npy"),
    *("cameras.bin", "cameras.txt", "dense"),
)
"""Names that tell a data set of photographs."""


def subject_name(path: Path, *, ending: bool = False) -> str:
    """A name for the contents of ``path``: the file's without its suffix, or the folder's where all such
    files have one name (``point_cloud.ply`` of a model, ``meta.json`` of SOG). With its ``ending``, if that
    is asked for."""
    if path.name in (*_MODEL_FILES, *folder_files()):
        folder = path.absolute().parent
        if re.fullmatch(r"iteration_[0-9]+", folder.name):
            folder = folder.parent
        if folder.name == "point_cloud":
            folder = folder.parent
        return (folder.name or path.stem) + ("".join(path.suffixes) if ending else "")
    if path.is_dir():
        return path.absolute().name or "scene"
    name = path.name
    suffixes = [
        end for end in (*double_suffixes(), path.suffix) if end and name.lower().endswith(end.lower())
    ]
    longest = 0 if ending else max(map(len, suffixes), default=0)
    return name[: len(name) - longest] or name


def _model_file(folder: Path) -> Path | None:
    return next((folder / name for name in _MODEL_FILES if (folder / name).is_file()), None)


def splat_file(path: Path) -> Path:
    """The file to read for ``path``: itself, or the latest one in a model folder."""
    if path.is_file():
        return path
    if not path.is_dir():
        from meshsplats.formats.content import refuse_stream

        refuse_stream(path)
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
        raise FileFormatError(f"{path}: neither a file nor a folder")
    for name in folder_files():
        if (path / name).is_file():
            return path / name
    if len(scenes := files_named(path, (".lcc",))) == 1:  # by the name of its project
        return scenes[0]
    if scenes := files_named(path, (".lcc2",)):  # whose refusal says how to convert them
        return scenes[0]
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
    photographs = [name for name in _OF_PHOTOGRAPHS if (path / name).exists()]
    if photographs:
        raise FileFormatError(
            f"{path}: photographs, not splats ({photographs[0]} is there); commands take them with"
            " ``data``, load_dataset reads them"
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


def files_named(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """The files of ``folder`` whose names end in one of ``suffixes``, by name; hidden ones are left out.
    Links that lead nowhere and pipes are among them: whoever reads one says so."""
    return sorted(
        path
        for path in folder.iterdir()
        if path.name.lower().endswith(tuple(suffixes)) and not path.name.startswith(".") and not path.is_dir()
    )
