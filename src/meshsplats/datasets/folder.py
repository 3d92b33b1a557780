"""``load_dataset``: which layout a folder has, and which of its views are for testing."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from meshsplats._kinds import need_path
from meshsplats.datasets.colmap import find_model, read_model
from meshsplats.datasets.image_files import Album, Frame, Taken, split
from meshsplats.datasets.transforms import read_transforms
from meshsplats.datasets.views import CACHE_BYTES, WHITE, Dataset, ImageCache, View
from meshsplats.errors import DataWarning, FileFormatError

Views = tuple[list[View], list[View]]
MAX_LIST_BYTES = 16 << 20


def read_folder(path: Path, downscale: int, test_every: int, store: ImageCache) -> Views:
    """Training and test views of the data set at ``path``; see ``load_dataset``."""
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such data set", str(path))
    layout = find_layout(path)
    if layout is None:
        if path.is_file():
            raise FileFormatError(f"{path}: a data set is a folder, or its transforms.json")
        raise FileFormatError(f"{path}: {_what_is_there(path)}")
    album = Album(path.parent if path.is_file() else path, downscale, store)
    if layout.name == "COLMAP":
        return _colmap(layout.source, album, test_every)
    if layout.name == "NeRF-synthetic":
        return _nerf_synthetic(layout.source.parent, album)
    return _nerfstudio(layout.source, album, test_every)


class Layout(NamedTuple):
    """How a data set is laid out."""

    name: Literal["COLMAP", "NeRF-synthetic", "nerfstudio"]
    source: Path
    """The sparse model's folder, or the file of the (training) frames."""


def find_layout(path: Path) -> Layout | None:
    """That of the folder or .json file ``path``, which is there; None for any other."""
    if path.is_file():
        if path.suffix.lower() != ".json":
            return None
        return Layout("NeRF-synthetic" if path.name == "transforms_train.json" else "nerfstudio", path)
    if (path / "transforms_train.json").is_file():
        return Layout("NeRF-synthetic", path / "transforms_train.json")
    model = find_model(path, ("sparse/0", "sparse"))
    if model is None and (path / "transforms.json").is_file():
        return Layout("nerfstudio", path / "transforms.json")
    model = model or find_model(path, ("colmap/sparse/0", "colmap/sparse")) or _other_model(path)
    return None if model is None else Layout("COLMAP", model)


def _other_model(path: Path) -> Path | None:
    """The only numbered model in sparse/, or one beside the folder of its images."""
    if (path / "sparse").is_dir():
        numbers = [name for name in os.listdir(path / "sparse") if name.isdecimal()]
        found = [model for name in numbers if (model := find_model(path / "sparse", (name,)))]
        if len(found) > 1:
            raise FileFormatError(
                f"{path}: sparse/ holds the models {', '.join(sorted(m.name for m in found))} but none named"
                " 0: rename the one to use"
            )
        if found:
            return found[0]
    return find_model(path, (".",)) if (path / "images").is_dir() else None


def _colmap(model: Path, album: Album, test_every: int) -> Views:
    # Cameras of the model have the size of the files in images/; without it, these may lie beside sparse/.
    frames = read_model(model, "images")
    numbered = model.parent.name == "sparse"
    if numbered:
        _warn_of_larger_model(model)
    taken = album.views(frames, str(model))
    album.report(str(model), len(taken))
    chosen = _listed_test(model / "test.txt") if numbered or model.name == "sparse" else None
    if chosen is None:
        return _views(*split(taken, test_every))
    stems = {name.rsplit(".", 1)[0] for name in chosen}
    test = [views for views in taken if _stem(views) in stems]
    return _views([views for views in taken if _stem(views) not in stems], test)


def _stem(views: Taken) -> str:
    return views[0][0].name.rsplit(".", 1)[0]


def _listed_test(path: Path) -> set[str] | None:
    """Names in INRIA's ``sparse/0/test.txt``, one a line; None if there is no such file."""
    if not path.is_file():
        return None
    with open(path, "rb") as file:
        text = file.read(MAX_LIST_BYTES)
    try:
        return {line.strip() for line in text.decode("utf-8").splitlines() if line.strip()}
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: not UTF-8 text") from None


def _warn_of_larger_model(model: Path) -> None:
    """COLMAP cuts what it cannot connect into several models, and the first need not be the largest."""
    if model.name != "0":
        return
    sizes = {
        other.name: file.stat().st_size
        for other in sorted(model.parent.iterdir())
        for file in (other / "images.bin", other / "images.txt")
        if file.is_file()
    }
    largest = max(sizes, key=lambda name: sizes[name])
    if sizes[largest] > 2 * sizes["0"]:
        warnings.warn(
            f"{model.parent}: model {largest} is larger than model 0, which is used; rename {largest} to 0"
            " to use it instead",
            DataWarning,
            stacklevel=2,
        )


def _nerf_synthetic(folder: Path, album: Album) -> Views:
    train = _taken(folder / "transforms_train.json", album)
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            return _views(train, _taken(folder / name, album))
    warnings.warn(
        f"{folder}: neither transforms_test.json nor transforms_val.json: there are no test views",
        DataWarning,
        stacklevel=2,
    )
    return _views(train, [])


def _taken(path: Path, album: Album) -> list[Taken]:
    frames = sorted(read_transforms(path).frames, key=_by_number)
    album.missing.clear()
    album.no_mask.clear()
    taken = album.views(frames, str(path))
    album.report(str(path), len(taken))
    return taken


def _by_number(frame: Frame) -> tuple[str, int, str]:
    """r_2 before r_10: these names are numbered without leading zeros."""
    stem = frame.name.rsplit(".", 1)[0]
    digits = len(stem) - len(stem.rstrip("0123456789"))
    cut = len(stem) - digits
    return stem[:cut], int(stem[cut:] or 0) if digits < 19 else 0, frame.name


def _nerfstudio(path: Path, album: Album, test_every: int) -> Views:
    content = read_transforms(path)
    frames = sorted(content.frames, key=lambda frame: frame.name)
    taken = album.views(frames, str(path))
    album.report(str(path), len(taken))
    held = {key: {name.removeprefix("./") for name in names} for key, names in content.splits.items()}
    out = held.get("test") or held.get("val")
    if not held.get("train") or not out:
        return _views(*split(taken, test_every))

    def members(names: set[str]) -> list[Taken]:
        return [views for views in taken if views[0][1].name in names]

    train, test = members(held["train"]), members(out)
    if not train:
        raise FileFormatError(f"{path}: none of its images is in 'train_filenames'")
    return _views(train, test)


def _views(train: list[Taken], test: list[Taken]) -> Views:
    flat = ([View(c, source) for views in part for c, source in views] for part in (train, test))
    return next(flat), next(flat)


def _what_is_there(path: Path) -> str:
    """Why this is no data set, for people: what is close to one."""
    names = sorted(os.listdir(path))[:10_000]
    wanted = (
        "no data set of a known layout: expected transforms_train.json, transforms.json, or images/ beside"
        " sparse/0/ with cameras and images, .bin or .txt"
    )
    inner = [name for name in names if _looks_like_one(path / name)]
    if (path / "cameras.bin").is_file() or (path / "cameras.txt").is_file():
        return "a sparse model by itself; give the folder above it that holds images/ too"
    if "sparse" in names:
        return "sparse/ holds no cameras and images, .bin or .txt: was the reconstruction finished?"
    if "database.db" in names:
        return "COLMAP's data base without a sparse model: run its mapper first"
    if inner:
        return f"{wanted}. {inner[0]}/ in it looks like one"
    if any(name.startswith("point_cloud") for name in names):
        return "a trained model, not the photographs it was trained on"
    return f"{wanted}; it holds {', '.join(names[:6]) or 'nothing'}"


def _looks_like_one(path: Path) -> bool:
    named = ("transforms_train.json", "transforms.json")
    return (
        any((path / name).is_file() for name in named) or find_model(path, ("sparse/0", "sparse")) is not None
    )


def load_dataset(
    path: str | os.PathLike[str],
    *,
    downscale: int = 1,
    test_every: int = 8,
    background: Sequence[float] = WHITE,
    cache_bytes: int = CACHE_BYTES,
) -> Dataset:
    """The photographs and cameras in a folder.

    Layouts, tried in this order (``docs/datasets.md`` shows them):

    - NeRF-synthetic: ``transforms_train.json``, with ``transforms_test.json`` (else ``transforms_val.json``)
      as the test views;
    - COLMAP, as INRIA's 3DGS and Mip-NeRF 360 use it: ``images/`` and ``sparse/0/`` or ``sparse/``, binary or
      text, any camera model;
    - nerfstudio: ``transforms.json``, also named itself as ``path``;
    - COLMAP with ``colmap/sparse/0/`` or ``colmap/sparse/``, with the only model in ``sparse/``, or with the
      model beside ``images/``.

    ``masks/``, or the masks that a file names, say which pixels count. Photographs of lenses that are not
    pinholes are undistorted when they are read; pixels that the lens did not see are black and masked. Only
    the headers of images are read here: cameras are scaled to the size of the images.

    Args:
        path: the folder, or ``transforms.json`` itself.
        downscale: whole factor of the images' sides, 1 to 64. ``images_2/``, ``images_4/`` and so on are used
            where they exist; else each pixel is the mean of those that it covers.
        test_every: views 0, n, 2n ... by name are held out, unless the data set has a split of its own; 0:
            none.
        background: RGB in [0, 1] over which ``View.image`` shows images with alpha. ``ViewImage.over`` takes
            another.
        cache_bytes: images are kept up to this many bytes after their first use; the others are read anew
            each time.

    Raises:
        FileFormatError: a folder of no known layout, a broken file in it, an image whose shape does not fit
            its camera, a path that leaves the folder, or a folder without any image.
        FileNotFoundError: nothing at ``path``.
        ValueError: an option out of its range.

    Warns with a DataWarning if images or masks are missing: views without an image are left out, all pixels
    of those without a mask count.
    """
    need_path(path=path)
    for option, value, least, most in (("downscale", downscale, 1, 64), ("test_every", test_every, 0, 10**9)):
        if int(value) != value or not least <= value <= most:
            raise ValueError(f"{option} must be a whole number from {least} to {most}, got {value}")
    color = np.asarray(background, np.float64)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise ValueError(f"background must be three numbers in [0, 1], got {background!r}")
    if test_every == 1:
        raise ValueError("test_every must be 0 (no test views) or at least 2: 1 leaves nothing to train with")
    store = ImageCache(cache_bytes)
    train, test = read_folder(Path(path), int(downscale), int(test_every), store)
    return Dataset(tuple(train), tuple(test), Path(os.path.abspath(path)).name).over(color.tolist())
