"""Which layout a data set's folder has: where its cameras and its images lie."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from meshsplats._common.foreign import what_it_is
from meshsplats.datasets.cameras_of_others import cameras_of_others
from meshsplats.datasets.colmap import MODEL_FILES, find_model, image_names
from meshsplats.datasets.image_files import READABLE, ImageIndex, first_names, is_hidden, is_readable
from meshsplats.errors import FileFormatError

POSES_BOUNDS = "poses_bounds.npy"
"""LLFF's file of cameras."""
IMAGE_FOLDERS = ("images", "input")
"""Names, in letters of any case, of folders of images beside a sparse model; the second is that in which
INRIA's 3DGS expects what it is yet to undistort."""
_SAMPLE = 50
"""How many names of a model are looked for to tell whether a folder holds its images."""
_SEVERAL = 3
"""Photographs from which on a folder is one of them, whatever else is in it."""
_MOST_FOLDERS = 500
"""Folders that are searched for photographs, at most."""
_NAMED = ("transforms_train.json", "transforms.json", POSES_BOUNDS)


class Layout(NamedTuple):
    """How a data set is laid out."""

    name: Literal["COLMAP", "NeRF-synthetic", "nerfstudio", "LLFF"]
    source: Path
    """The sparse model's folder, or the file of the (training) frames."""
    root: Path
    """The data set's folder, which no path in it may leave."""
    images: str = ""
    """COLMAP and LLFF: the folder of the images, relative to ``root``; empty: ``root`` itself."""
    before: tuple[str, ...] = ()
    """COLMAP: models with lower numbers, and their images, which are fewer than those of this one."""
    has_images: bool = True
    """COLMAP: whether some of its images are there, or smaller copies of them."""


def find_layout(path: Path) -> Layout | None:
    """That of the folder or file ``path``, which is there; None for any other.

    Of the models of a folder, those come first whose images are there, and of these the one with the most.
    """
    if path.is_file():
        if path.name in MODEL_FILES:
            return find_layout(path.parent)
        if path.name == POSES_BOUNDS:
            return _llff(path.parent)
        if path.suffix.lower() != ".json":
            return None
        name = "NeRF-synthetic" if path.name == "transforms_train.json" else "nerfstudio"
        return Layout(name, path, path.parent)  # type: ignore[arg-type]
    if (path / "transforms_train.json").is_file():
        return Layout("NeRF-synthetic", path / "transforms_train.json", path)
    usual = _best(_models(path, "sparse", path))
    if usual is not None and usual.has_images:
        return usual
    if (path / "transforms.json").is_file():
        return Layout("nerfstudio", path / "transforms.json", path)
    others = [usual] if usual is not None else []
    for found in _unusual(path):
        if found.has_images:
            return found
        others.append(found)
    if (path / POSES_BOUNDS).is_file():
        return _llff(path)
    beneath = _beneath(path)
    if len(beneath) == 1:
        return beneath[0]
    return others[0] if others else None


def _llff(root: Path) -> Layout:
    folders = [name for name in image_folders(root) if name and ImageIndex(root / name).images()]
    return Layout("LLFF", root / POSES_BOUNDS, root, folders[0] if folders else "")


def _unusual(path: Path) -> Iterator[Layout]:
    """Models elsewhere than in ``path``/sparse: those of nerfstudio, of COLMAP's undistortion and automatic
    reconstruction, of INRIA's conversion; beside the images; and ``path`` itself where it is one inside a
    data set."""
    for place in ("colmap/sparse", "distorted/sparse"):
        if found := _best(_models(path, place, path)):
            yield found
    if model := find_model(path, ("colmap",)):
        yield from _candidates(path, [model])
    dense = [path / "dense" / name for name in _numbered(path / "dense")]
    roots = (*dense, path / "dense")
    if found := _best([found for root in roots for found in _models(root, "sparse", root)]):
        yield found
    if model := find_model(path, (".",)):
        yield from _candidates(path, [model])
        above = path.absolute().parent
        if above.name == "sparse":
            yield from _candidates(above.parent, [model])
        if path.absolute().name == "sparse":
            yield from _candidates(above, [model])


def _beneath(path: Path) -> list[Layout]:
    """The best model in each folder of ``path`` that names images of ``path`` itself."""
    images = image_folders(path)
    models = (_models(path, name, path) for name in _folders(path))
    found = (_best([m for m in some if m.has_images and m.images in images]) for some in models)
    return [layout for layout in found if layout is not None]


def _models(path: Path, place: str, root: Path) -> list[Layout]:
    """Those of ``path``/``place``/0, 1 ... and of ``path``/``place`` itself, which comes last."""
    names = [*_numbered(path / place), "."]
    found = [model for name in names if (model := find_model(path / place, (name,)))]
    return _candidates(root, found)


def _candidates(root: Path, models: Sequence[Path]) -> list[Layout]:
    """The layouts with ``models`` in the data set ``root``, each with the first folder that holds some of its
    images, else ``images``."""
    result = []
    for model in models:
        folders = image_folders(root)
        if model.is_relative_to(root) and model != root:
            folders.append(model.relative_to(root).as_posix())
        names = _sample(model)
        holding = next((folder for folder in folders if _holds(root, folder, names)), None)
        found = holding is not None or any(name.startswith("images_") for name in _folders(root))
        images = "images" if holding is None else holding
        result.append(Layout("COLMAP", model, root, images, has_images=found))
    return result


def _best(models: Sequence[Layout]) -> Layout | None:
    """The one with the most images of those whose images are there, else of all."""
    if not models:
        return None
    there = [found for found in models if found.has_images] or list(models)
    sizes = [len(_names(found.source)) if len(there) > 1 else 0 for found in there]
    best = sizes.index(max(sizes))
    before = tuple(f"{there[i].source} ({sizes[i]})" for i in range(best))
    return there[best]._replace(before=before)


def _holds(root: Path, folder: str, names: Sequence[str] | None) -> bool:
    """Whether ``folder`` in ``root`` holds one of ``names``, also in letters of another case or with another
    suffix. True for None, the names of a model that cannot be read: its reader says so."""
    place = root / folder
    if not place.is_dir():
        return False
    if names is None:
        return True
    index = ImageIndex(place)
    return any(index.alike(name) or index.alike(name.replace("\\", "/").split("/")[-1]) for name in names)


def _sample(model: Path) -> Sequence[str] | None:
    """Some of the names of the images of ``model``; None if it cannot be read."""
    try:
        names = image_names(model)
    except FileFormatError:
        return None
    return names[:: -(-len(names) // _SAMPLE)] if names else None


def _names(model: Path) -> Sequence[str]:
    try:
        return image_names(model)
    except FileFormatError:
        return ()


def image_folders(root: Path) -> list[str]:
    """The folders in ``root`` where images usually lie, and ``root`` itself, which is last."""
    found = _folders(root)
    named = [name for wanted in IMAGE_FOLDERS for name in found if name.casefold() == wanted]
    return [*sorted(named, key=lambda name: IMAGE_FOLDERS.index(name.casefold())), ""]


def _folders(root: Path) -> list[str]:
    """The names of the folders in ``root``, sorted; lower case comes first."""
    try:
        with os.scandir(root) as entries:
            found = [entry.name for entry in entries if entry.is_dir() and not is_hidden(entry.name)]
    except OSError:
        return []
    return sorted(found, key=lambda name: (name.casefold(), name.swapcase()))


def _numbered(folder: Path) -> list[str]:
    return sorted((name for name in _folders(folder) if name.isdecimal()), key=lambda name: (int(name), name))


def what_is_there(path: Path) -> str:
    """Why the folder ``path`` is no data set, for people: what is close to one."""
    names = sorted(name for name in os.listdir(path) if not is_hidden(name))[:10_000]
    wanted = (
        "no data set of a known layout: expected transforms_train.json, transforms.json, poses_bounds.npy, or"
        " cameras and images, .bin or .txt, in sparse/0/ or beside the images"
    )
    if beneath := _beneath(path):
        places = " and ".join(f"{layout.source.relative_to(path).as_posix()}/" for layout in beneath)
        return f"{places} hold cameras of COLMAP for its images: move all but one elsewhere"
    inner = [name for name in names if _looks_like_one(path / name)]
    if inner:
        return f"{wanted}. {inner[0]}/ in it looks like one"
    if foreign := cameras_of_others(path):
        return foreign
    if "sparse" in names:
        return "sparse/ holds no cameras and images, .bin or .txt: was the reconstruction finished?"
    if "database.db" in names:
        return "a COLMAP database without a sparse model: run the mapper first (colmap mapper)"
    if any(name.startswith("point_cloud") for name in names):
        return "a trained model, not the photographs it was trained on"
    if path.name.casefold() in IMAGE_FOLDERS and _looks_like_one(path.absolute().parent):
        return f"the images alone; give the folder above it, {path.absolute().parent}, which has the cameras"
    photographs = max(len(ImageIndex(path / name).images()) for name in image_folders(path))
    bare = f"{wanted}; of photographs without, 'meshsplats train' finds the cameras"
    if photographs >= _SEVERAL:  # phones put videos among them
        return bare
    kinds = ((name, what_it_is(path / name)) for name in names[:_SAMPLE] if (path / name).is_file())
    if known := next(((name, what) for name, what in kinds if what and not is_readable(name)), None):
        return f"{known[0]} in it is {known[1]}; {wanted}"
    if photographs:
        return bare
    for name in image_folders(path):
        if unread := ImageIndex(path / name).unread():
            kind = f"images of kinds that are not read ({first_names(unread)}): convert them to JPEG"
            return f"{name or 'it'}{'/' * bool(name)} holds {kind}; {wanted}"
    if deeper := photographs_beneath(path):
        one = "give that folder" if len(deeper) == 1 else "give one of these, or move all into one"
        inner = [f"{place}/" for place in deeper]
        shown = " and ".join(inner) if len(inner) < 3 else first_names(inner)
        return f"there are photographs in {shown}: {one}; {wanted}"
    kinds_read = " ".join(READABLE)
    return f"no photographs in it ({kinds_read}): it holds {', '.join(names[:6]) or 'nothing'}; {wanted}"


def photographs_beneath(path: Path) -> dict[str, list[str]]:
    """The names of the photographs in each folder that has some, up to two below ``path``, by the folder's
    path relative to it. Of very many folders, not all are looked into."""
    firsts = _folders(path)[:_MOST_FOLDERS]
    places = [
        place for first in firsts for place in (first, *(f"{first}/{s}" for s in _folders(path / first)))
    ]
    found = {place: ImageIndex(path / place).images() for place in places[:_MOST_FOLDERS]}
    return {place: names for place, names in found.items() if names}


def unread_cameras(path: Path) -> str:
    """What tells that cameras belong to the folder ``path`` of photographs, though none of a known layout is
    there; empty if nothing does."""
    names = [name for name in os.listdir(path) if not is_hidden(name)]
    alone = path.name.casefold() in IMAGE_FOLDERS and _looks_like_one(path.absolute().parent)
    inner = any(_looks_like_one(path / name) for name in names)
    sparse = any(name.casefold().startswith("sparse") and (path / name).is_dir() for name in names)
    if alone or inner or sparse or len(_beneath(path)) > 1:
        return what_is_there(path)
    return cameras_of_others(path)


def _looks_like_one(path: Path) -> bool:
    if any((path / name).is_file() for name in _NAMED):
        return True
    places = (".", "sparse", *_numbered(path), *(f"sparse/{name}" for name in _numbered(path / "sparse")))
    return find_model(path, places) is not None
