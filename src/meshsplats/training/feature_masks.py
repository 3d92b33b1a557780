"""Masks of bare photographs while their cameras are found: where features count."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.datasets.image_files import PhotoLoader
from meshsplats.datasets.photo_file import light_of_mask
from meshsplats.datasets.views import ImageCache
from meshsplats.errors import DataWarning
from meshsplats.training.poses import pair_of

MOST_LEFT_OUT = 0.5
"""Masks that leave out less of the photographs than this are of what passed by. Others are of a subject, and
what is around it helps to find the cameras, unless it stands still while the subject turns."""
LOOKED_AT = 16
"""Masks that tell, at most and evenly spread."""
STILL = 0.004
"""Features stand still that move by less than this share of the longest side between photographs."""
FEWEST_STILL = 100
"""Matches that must do so, and be more than the others outside of the masks."""


class FeatureMasks:
    """The masks of photographs, read one after the other as they are needed.

    Args:
        folder: of the data set.
        names: of the photographs in it.
        sizes: width and height of each.

    Raises FileFormatError for masks that do not fit their photographs.
    """

    def __init__(self, folder: Path, names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # which load_dataset gives
            self._found = PhotoLoader(folder, 1, ImageCache(0)).masks_of(names, sizes, str(folder))
        self._sizes = sizes

    def __bool__(self) -> bool:
        """Whether there are any."""
        return any(found is not None for found in self._found)

    def are_of_a_subject(self) -> bool:
        """Whether they leave out ``MOST_LEFT_OUT`` of the photographs that have one."""
        masks = subsample([found for found in self._found if found is not None], LOOKED_AT)
        return 1 - float(np.mean([light_of_mask(*found).mean() for found in masks])) >= MOST_LEFT_OUT

    def counts(self, place: int) -> np.ndarray | None:
        """(h, w) bool, True where the pixels of a photograph count; None: all of them."""
        from PIL import Image

        found = self._found[place]
        if found is None:
            return None
        light = Image.fromarray(light_of_mask(*found) > 0)
        return np.asarray(light.resize(self._sizes[place], Image.Resampling.NEAREST))

    def write(self, folder: Path, images: Sequence[Path]) -> None:
        """Writes them to ``folder`` for COLMAP, which knows the photographs as ``images``, and takes none
        without a mask: those that have none get a light one."""
        from PIL import Image

        folder.mkdir()
        for place, image in enumerate(images):
            counts = self.counts(place)
            if counts is None:
                counts = np.ones(self._sizes[place][::-1], bool)
            Image.fromarray(counts).convert("L").save(folder / f"{image.name}.png", compress_level=1)

    def surroundings_stand_still(self, database: Path, images: Sequence[Path]) -> bool:
        """Whether most matches outside of the masks, in COLMAP's ``database`` of ``images``, stand still:
        those of what is behind a subject on a turntable."""
        places = {image.name: place for place, image in enumerate(images)}
        points: dict[int, np.ndarray] = {}
        outside: dict[int, np.ndarray] = {}
        with closing(sqlite3.connect(database)) as connection:
            query = "select image_id, name, rows, cols, data from keypoints join images using (image_id)"
            for image, name, rows, columns, data in connection.execute(query):
                at = np.frombuffer(data or b"", np.float32).reshape(rows, columns)[:, :2]
                counts = self.counts(places[name])
                points[image], outside[image] = at, np.zeros(rows, bool)
                if counts is not None:
                    x, y = np.clip(at.astype(int), 0, np.array(counts.shape[::-1]) - 1).T
                    outside[image] = ~counts[y, x]
            query = "select pair_id, data from two_view_geometries where rows > 0"
            pairs = {
                pair_of(number): np.frombuffer(data, np.uint32).reshape(-1, 2)
                for number, data in connection.execute(query)
            }
        ways = np.concatenate([np.zeros(0), *(_ways(points, outside, *pair) for pair in pairs.items())])
        still = int(np.count_nonzero(ways < STILL * max(map(max, self._sizes))))
        return still >= FEWEST_STILL and 2 * still > len(ways)


def _ways(
    points: Mapping[int, np.ndarray],
    outside: Mapping[int, np.ndarray],
    pair: tuple[int, int],
    matches: np.ndarray,
) -> np.ndarray:
    """How far features go from one image of a ``pair`` to the other, pixels, of those outside in both."""
    (one, other), (i, j) = pair, matches.T
    both = outside[one][i] & outside[other][j]
    return np.asarray(np.linalg.norm(points[one][i[both]] - points[other][j[both]], axis=1))
