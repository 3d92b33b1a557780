"""``load_dataset``: which layout a folder has, and which of its views are for testing."""

from __future__ import annotations

import errno
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from meshsplats._common.choices import Masks, Missing
from meshsplats._common.foreign import what_it_is
from meshsplats._common.kinds import need_path
from meshsplats._common.words import plural
from meshsplats.datasets.colmap import read_model
from meshsplats.datasets.image_files import Frame, PhotoLoader, PhotoViews, first_names, split
from meshsplats.datasets.layouts import Layout, find_layout, what_is_there
from meshsplats.datasets.llff import read_poses_bounds
from meshsplats.datasets.photo_file import PhotoFile
from meshsplats.datasets.transforms import read_transforms
from meshsplats.datasets.views import CACHE_BYTES, WHITE, Dataset, ImageCache, View
from meshsplats.errors import DataWarning, FileFormatError, OptionValueError
from meshsplats.scene.origin import choose_origin

Views = tuple[list[View], list[View]]
MAX_LIST_BYTES = 16 << 20
MOST_DOWNSCALE = 64


def read_folder(
    path: Path, downscale: int, test_every: int, store: ImageCache, missing: Missing, masks: Masks = "count"
) -> Views:
    """Training and test views of the data set at ``path``; see ``load_dataset``."""
    if not path.exists():
        raise FileNotFoundError(errno.ENOENT, "no such data set", str(path))
    layout = find_layout(path)
    if layout is None:
        if path.is_file():
            what = what_it_is(path)
            raise FileFormatError(f"{path}: {what or 'a data set is a folder, or its transforms.json'}")
        raise FileFormatError(f"{path}: {what_is_there(path)}")
    loader = PhotoLoader(layout.root, downscale, store, missing, layout.images, masks)
    if layout.name == "COLMAP":
        return _colmap(layout, loader, test_every)
    if layout.name == "LLFF":
        frames = read_poses_bounds(layout.source, layout.images)
        return _views(*split(_taken(frames, layout.source, loader), test_every))
    if layout.name == "NeRF-synthetic":
        return _nerf_synthetic(layout.source.parent, loader)
    return _nerfstudio(layout.source, loader, test_every)


def _colmap(layout: Layout, loader: PhotoLoader, test_every: int) -> Views:
    model = layout.source
    if layout.before:
        warnings.warn(
            f"{model}: this model is taken, as it has the most images; others are {', '.join(layout.before)}."
            " Give the folder of a model to take that one",
            DataWarning,
            stacklevel=2,
        )
    # Cameras of the model have the size of the files in images/; without it, these may lie beside sparse/.
    frames = read_model(model, layout.images)
    listed = model.parent.name == "sparse" or model.name == "sparse"
    chosen = _listed_test(model / "test.txt") if listed else None
    if chosen is None:
        return _views(*split(_taken(frames, model, loader), test_every))
    stems = [_stem(frame.name) for frame in frames]
    known = set(stems)
    # The 3DGS code lists names without suffixes, which may have dots.
    chosen = {name if name in known else _stem(name) for name in chosen}
    _check_names(model, "test.txt", chosen, stems)
    taken = _taken(frames, model, loader)
    train, test = (_members(taken, [(stem in chosen) is held for stem in stems]) for held in (False, True))
    return _views(train, test)


def _taken(frames: list[Frame], where: Path, loader: PhotoLoader, *, needed: bool = True) -> list[PhotoViews]:
    taken = loader.views(frames, str(where))
    loader.report(str(where), sum(map(bool, taken)), needed=needed)
    return taken


def _stem(name: str) -> str:
    return name.rsplit(".", 1)[0]


def _members(taken: Sequence[PhotoViews], chosen: Sequence[bool]) -> list[PhotoViews]:
    return [views for views, one in zip(taken, chosen, strict=True) if one]


def _check_names(where: Path, place: str, listed: set[str], names: Sequence[str]) -> None:
    """Warns of images that are ``listed`` in a ``place`` and have none of the ``names`` of those that there
    are. FileFormatError if no listed one has."""
    unknown = [repr(name[:60]) for name in sorted(listed.difference(names))]
    if unknown and len(unknown) == len(listed):
        raise FileFormatError(
            f"{where}: none of its images is in {place}, which has {unknown[0]}; their names are such as"
            f" {min(names)[:60]!r}"
        )
    if unknown:
        warnings.warn(
            f"{where}: {len(unknown)} of {len(listed)} names in {place} are of no image and are passed over"
            f" ({first_names(unknown)})",
            DataWarning,
            stacklevel=2,
        )


def _apart(where: Path, train: list[PhotoViews], test: list[PhotoViews]) -> Views:
    """The views of ``train``, and of ``test`` those of photographs that are not in it, with a DataWarning of
    the others."""
    known = {views[0][1].path for views in train if views}
    learned = [bool(views) and views[0][1].path in known for views in test]
    if any(learned):
        both = [views[0][1].name for views in _members(test, learned)]
        warnings.warn(
            f"{where}: {plural(len(both), 'image')} listed both to train and to test with: trained on, not"
            f" held out ({first_names(both)})",
            DataWarning,
            stacklevel=2,
        )
    return _views(train, _members(test, [not one for one in learned]))


def _listed_test(path: Path) -> set[str] | None:
    """Names in INRIA's ``sparse/0/test.txt``, one a line; None if there is no such file. Warns of one without
    a name."""
    if not path.is_file():
        return None
    with open(path, "rb") as file:
        text = file.read(MAX_LIST_BYTES)
    try:
        names = {line.strip() for line in text.decode("utf-8-sig").splitlines() if line.strip()}
    except UnicodeDecodeError:
        raise FileFormatError(f"{path}: not UTF-8 text") from None
    if not names:
        warnings.warn(f"{path}: lists no image, so no view is held out", DataWarning, stacklevel=2)
    return names


def _nerf_synthetic(folder: Path, loader: PhotoLoader) -> Views:
    train = _numbered(folder / "transforms_train.json", loader)
    for name in ("transforms_test.json", "transforms_val.json"):
        if (folder / name).is_file():
            return _apart(folder / name, train, _numbered(folder / name, loader, needed=False))
    warnings.warn(
        f"{folder}: neither transforms_test.json nor transforms_val.json: there are no test views",
        DataWarning,
        stacklevel=2,
    )
    return _views(train, [])


def _numbered(path: Path, loader: PhotoLoader, *, needed: bool = True) -> list[PhotoViews]:
    return _taken(sorted(read_transforms(path).frames, key=_by_number), path, loader, needed=needed)


def _by_number(frame: Frame) -> tuple[str, int, str]:
    """r_2 before r_10: these names are numbered without leading zeros."""
    stem = frame.name.rsplit(".", 1)[0]
    digits = len(stem) - len(stem.rstrip("0123456789"))
    cut = len(stem) - digits
    return stem[:cut], int(stem[cut:] or 0) if digits < 19 else 0, frame.name


def _nerfstudio(path: Path, loader: PhotoLoader, test_every: int) -> Views:
    content = read_transforms(path)
    frames = _each_once(path, sorted(content.frames, key=lambda frame: frame.name))
    names = [frame.name for frame in frames]
    listed = {
        part: {name.removeprefix("./") for name in some} for part, some in content.splits.items() if some
    }
    out = "test" if "test" in listed else "val"
    for part in ("train", out):
        if part in listed:
            _check_names(path, f"'{part}_filenames'", listed[part], names)
    taken = _taken(frames, path, loader)
    # A list that is missing has what is in no other.
    rest = set(names).difference(*listed.values())
    train, test = listed.get("train", rest), listed.get(out, rest)
    if not listed or not test:
        return _views(*split(taken, test_every))
    return _apart(path, *(_members(taken, [name in part for name in names]) for part in (train, test)))


def _each_once(where: Path, frames: Sequence[Frame]) -> list[Frame]:
    """``frames`` without those of an image that is one before's, with a DataWarning: they would be trained on
    and held out."""
    first: dict[str, Frame] = {}
    for frame in frames:
        first.setdefault(frame.file.removeprefix("./"), frame)
    if len(first) < len(frames):
        kept = list(map(id, first.values()))
        again = [frame.name for frame in frames if id(frame) not in kept]
        warnings.warn(
            f"{where}: {plural(len(again), 'image')} listed more than once, and taken once"
            f" ({first_names(again)})",
            DataWarning,
            stacklevel=2,
        )
    return list(first.values())


def _views(train: list[PhotoViews], test: list[PhotoViews]) -> Views:
    def flat(part: list[PhotoViews]) -> list[View]:
        return [View(camera, photo, turn=photo.turn) for views in part for camera, photo in views]

    return flat(train), flat(test)


def check_reading(downscale: int, test_every: int) -> None:
    """OptionValueError if ``load_dataset`` would refuse one of these."""
    for option, value, least, most in (
        ("downscale", downscale, 1, MOST_DOWNSCALE),
        ("test_every", test_every, 0, 10**9),
    ):
        if int(value) != value or not least <= value <= most:
            raise OptionValueError(f"``{option}`` must be a whole number from {least} to {most}, got {value}")
    if test_every == 1:
        raise OptionValueError(
            "``test_every`` must be 0 (no test views) or at least 2: 1 leaves nothing to train with"
        )


def load_dataset(
    path: str | os.PathLike[str],
    *,
    downscale: int = 1,
    test_every: int = 8,
    background: Sequence[float] = WHITE,
    cache_bytes: int = CACHE_BYTES,
    missing: Missing = "few",
    masks: Masks = "count",
    origin: Sequence[float] | np.ndarray | None = None,
) -> Dataset:
    """The photographs and cameras in a folder.

    Layouts, tried in this order (``docs/datasets.md`` shows them):

    - NeRF-synthetic: ``transforms_train.json``, with ``transforms_test.json`` (else ``transforms_val.json``)
      as the test views;
    - COLMAP, as INRIA's 3DGS and Mip-NeRF 360 use it: ``images/`` and ``sparse/0/`` or ``sparse/``, binary or
      text, any camera model. Of several models the one with the most images;
    - nerfstudio: ``transforms.json``, also named itself as ``path``;
    - COLMAP in other places: ``colmap/sparse/0/``, ``dense/0/`` or ``dense/``, which undistortion writes, the
      model beside the images, as RealityCapture exports it, or the folder of a model itself;
    - LLFF: ``poses_bounds.npy``;
    - COLMAP in a folder of any name, or ``0/`` in it, if no other one has a model of the images, too.

    ``masks/``, or the masks that a file names, say which pixels count. Photographs of lenses that are not
    pinholes are undistorted when they are read; pixels that the lens did not see are black and masked. Only
    the headers of images are read here: cameras are scaled to the size of the images.

    Args:
        path: the folder, or ``transforms.json`` itself.
        downscale: whole factor of the images' sides, 1 to 64. ``images_2/``, ``images_4/`` and so on are used
            where they exist; else each pixel is the mean of those that it covers.
        test_every: views 0, n, 2n ... by name are held out, missing ones counted, unless the data set has a
            split of its own; 0: none.
        background: RGB in [0, 1] over which ``View.image`` shows images with alpha. ``ViewImage.over`` takes
            another.
        cache_bytes: images are kept up to this many bytes after their first use; the others are read anew
            each time.
        missing: views of missing images are left out with a DataWarning if they are fewer than half
            (``'few'``, as where blurred ones were thrown away) or any (``'skip'``); else they are an
            ``'error'``.
        masks: what masks say: which pixels ``'count'``, or what the ``'subject'`` is: pixels outside are then
            clear, as in photographs that were cut out.
        origin: (3,) point of the world that cameras shall be relative to, such as that of splats or a mesh of
            the same scene. By default one that suits their positions, zero wherever float32, in which
            everything is that is made of them, is fine enough.

    Raises:
        FileFormatError: a folder of no known layout, a broken file in it, a missing image, one whose shape
            does not fit its camera, a list of test images that has none of them, or a path that leaves the
            folder.
        FileNotFoundError: nothing at ``path``.
        ValueError: an option out of its range.

    Warns with a DataWarning where masks are missing, which leaves all pixels of those views to count, where
    an image has another suffix than the file gives it, or is written in letters of another case: it is taken
    if no other can be meant, and where a split of the data set's own names what is not there, or images to
    train with as test images, which are then not held out.
    """
    need_path(path=path)
    check_reading(downscale, test_every)
    color = np.asarray(background, np.float64)
    if color.shape != (3,) or not ((color >= 0) & (color <= 1)).all():
        raise ValueError(f"background must be three numbers in [0, 1], got {background!r}")
    if missing not in get_args(Missing):
        raise ValueError(f"missing must be 'few', 'error' or 'skip', got {missing!r}")
    if masks not in get_args(Masks):
        raise ValueError(f"masks must be 'count' or 'subject', got {masks!r}")
    store = ImageCache(cache_bytes)
    train, test = read_folder(Path(path), int(downscale), int(test_every), store, missing, masks)
    photographs = [view.source for view in (*train, *test) if isinstance(view.source, PhotoFile)]
    if masks == "subject" and not any(photograph.cut_out for photograph in photographs):
        raise FileFormatError(f"{path}: no masks, so none of a subject: leave out masks='subject'")
    dataset = Dataset(tuple(train), tuple(test), Path(os.path.abspath(path)).name).over(color.tolist())
    if origin is None:
        origin = choose_origin(np.array([view.camera.center for view in dataset.views]))
    return dataset.relative_to(origin)
