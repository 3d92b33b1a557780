"""What to say of photographs that a search for cameras passes over, and of those that it fails with."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from meshsplats._common.words import plural
from meshsplats.datasets.colmap import image_names
from meshsplats.datasets.image_files import ImageIndex
from meshsplats.datasets.layouts import Layout, photographs_beneath
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.outputs import CONFIGURATION
from meshsplats.training.poses import verified_pairs
from meshsplats.training.suspects import shortened

_OTHERS = re.compile(
    r"mask|depth|preview|thumb|confidence|images_\d+$|.*-(frames|evaluation|compare|images|views)$"
    r"|(.*[-_ ])?(masks?|depths?|previews?|thumb\w*|confidence|normals?|alphas?|renders?|renderings?"
    r"|segmentations?|deleted|rejected)$",
    re.IGNORECASE,
)
"""Names of folders whose images are no photographs, are copies, were sorted out, or were made here, for the
most part under names that commands propose."""
_NO_MATCH = (
    "Photographs must overlap by two thirds, be sharp and flat, not panoramas, and show a subject with"
    " texture that does not move"
)
_NO_PARALLAX = (
    "but they show no parallax, as from one place: walk around the subject, do not stand still or turn on the"
    " spot"
)


def warn_of_inner_folders(photographs: Sequence[Path]) -> None:
    """A DataWarning about folders beside ``photographs``, which are all in one, that have more of the same
    kinds and of other names."""
    place = photographs[0].parent
    names, kinds = {path.name for path in photographs}, {path.suffix.lower() for path in photographs}
    passed = []
    for inner, found in photographs_beneath(place).items():
        more = [name for name in found if name not in names and Path(name).suffix.lower() in kinds]
        if more and not _of_results(place, PurePosixPath(inner)):
            passed.append(f"{inner}/ ({len(more):,})")
    if passed:
        warnings.warn(
            f"{place}: there are more photographs in {shortened(passed)}, which are left out, as folders"
            " inside are not searched: if they show the same subject, move them beside the others",
            DataWarning,
            stacklevel=3,
        )


def _of_results(place: Path, inner: PurePosixPath) -> bool:
    """Whether the folder ``inner`` of ``place`` has a name of other images than photographs, or is in the
    result of a command, which has its configuration there."""
    folders = [folder for folder in (inner, *inner.parents) if folder.name]
    return any(_OTHERS.match(folder.name) or (place / folder / CONFIGURATION).is_file() for folder in folders)


def say_what_has_no_camera(layout: Layout, say: Callable[[str], None]) -> None:
    """Says how many photographs beside a model of COLMAP found no camera in it."""
    if layout.name != "COLMAP":
        return
    try:
        known = {
            PurePosixPath(name.replace("\\", "/")).stem.casefold() for name in image_names(layout.source)
        }
    except FileFormatError:
        return  # its reader says so
    there = ImageIndex(layout.root / layout.images).images()
    without = [name for name in there if Path(name).stem.casefold() not in known]
    if without and len(without) < len(there):
        say(
            f"{len(without):,} of {plural(len(there), 'photograph')} have no camera in {layout.source}, and"
            f" are left out: {shortened(without)}"
        )


def matching_images(database: Path) -> int:
    """Number of images in COLMAP's ``database`` that match another one."""
    return len({image for pair in verified_pairs(database) for image in pair})


def why_none(placed: int, matching: int, count: int, fewest: int) -> str:
    """Why so few of ``count`` photographs were ``placed``, fewer than the ``fewest`` that must be, though so
    many match another one."""
    if 2 * matching > count and matching >= fewest:
        return f"{matching} of {count} photographs match each other, {_NO_PARALLAX}"
    return f"{placed} of {count} photographs match each other, at least {fewest} must. {_NO_MATCH}"
