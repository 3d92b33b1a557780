"""Poses of matched photographs by pycolmap, and whether they agree with the matches."""

from __future__ import annotations

import sqlite3
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.words import plural

GROWTH = 1.4
"""Growth of cameras or points that triggers the next global bundle adjustment (COLMAP: ba_global_*_ratio)."""
REFINEMENTS = 2
"""Times that they are, at most. With COLMAP's defaults, 1.1 and 5, poses take a third longer, or several
times as long, and are not more exact."""
LEAST = 15
"""Matches of a verified pair of photographs, at least: COLMAP's own minimum. Pairs of 100 and more are too
few to tell a wrong solution from a right one."""
SHARED = 0.1
"""A verified pair whose photographs see fewer common points than this share of its matches contradicts the
poses."""
TOLERATED = 0.08
"""Share of the verified pairs that may contradict the poses. Of 30 and more photographs in right places, 0 to
0.076 do, most where a room is seen in wide steps; with 2 to 17 in wrong ones, 0.11 to 0.31. Of fewer, it
tells less: 0.083 both of 7 right ones and of 8 with 5 wrong."""
FEWEST_AGAINST = 2
"""Pairs that must contradict a photograph for it to be left out: of a single one, either may be wrong."""
OUTVOTED = 0.2
"""Share of the photographs, at most, that are left out because more pairs contradict than agree with them.
Where they are more, it is not told which part of the photographs is wrong."""
MANY = 30
"""Photographs from which on poses are first found all together. In 11 sets of 32 to 49 photographs, all were
right so, in up to 6 s more, where one after the other put 2 to 17 in wrong places in 4 sets; of 292 of a
room, all were right in 51 s, where one after the other took 108 s and placed none. But of 50 of a
phone, two were wrong so, before weaker pairs were asked. Of 11 to 29, too far apart, one after the other
places fewer, but fewer in wrong places, too."""
FEWEST_APART = 3
"""Photographs that are named as a group of their own if they have poses together, but not with the rest."""
_MAX_IMAGES = 2**31 - 1


def pair_of(number: int) -> tuple[int, int]:
    """The two images of which COLMAP's database makes one ``number``."""
    return divmod(number, _MAX_IMAGES)


@dataclass(frozen=True)
class Poses:
    """A model of pycolmap, and what verified pairs say of it."""

    model: Any
    agreeing: tuple[tuple[int, int], ...]
    """Image numbers of the verified pairs that agree with it..."""
    contradicting: tuple[tuple[int, int], ...]
    """... and of those that do not. Pairs with a photograph that has no pose do neither."""
    apart: tuple[tuple[str, ...], ...] = ()
    """Names of photographs that have poses together, but not with these, in groups."""
    outvoted: tuple[str, ...] = ()
    """Names of photographs whose poses were taken away, as more pairs contradicted than agreed with them."""

    @property
    def doubtful(self) -> bool:
        """Whether more pairs contradict it than may, in all or of one photograph."""
        found = len(self.agreeing) + len(self.contradicting)
        return len(self.contradicting) > TOLERATED * found or max(self._shares().values(), default=0) > 0.5

    def suspects(self) -> list[str]:
        """Names of the photographs in contradicting pairs, those with the greatest share of such first."""
        shares = self._shares()
        counts = Counter(image for pair in self.contradicting for image in pair)
        images = sorted(shares, key=lambda image: (-shares[image], -counts[image]))
        return [self.model.images[image].name for image in images]

    def without_outvoted(self) -> Poses:
        """These poses without those that more pairs contradict than agree with, unless they are too many;
        ``model`` is changed."""
        against = Counter(image for pair in self.contradicting for image in pair)
        images = [i for i, share in self._shares().items() if share > 0.5 and against[i] >= FEWEST_AGAINST]
        if not 0 < len(images) <= OUTVOTED * self.model.num_reg_images():
            return self
        names = tuple(sorted(self.model.images[image].name for image in images))
        for image in images:
            _take_pose(self.model, image)

        def left(pairs: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
            return tuple(pair for pair in pairs if not {*pair} & {*images})

        return replace(
            self, agreeing=left(self.agreeing), contradicting=left(self.contradicting), outvoted=names
        )

    def _shares(self) -> dict[int, float]:
        """The share of its pairs that contradict, for each image that has such."""
        against = Counter(image for pair in self.contradicting for image in pair)
        for_it = Counter(image for pair in self.agreeing for image in pair)
        return {image: count / (count + for_it[image]) for image, count in against.items()}

    def _rank(self) -> tuple[int, int, int]:
        """The greater, the better."""
        return len(self.agreeing), -len(self.contradicting), self.model.num_reg_images()


def find_poses(
    pycolmap: Any,
    database: Path,
    images: Path,
    work: Path,
    count: int,
    say: Callable[[str], None] = lambda text: None,
    threads: int | None = None,
) -> Poses | None:
    """The poses of the ``count`` photographs in the folder ``images`` by the matches in COLMAP's
    ``database``; None if too few match.

    Few are found one after the other (incremental structure from motion), ``MANY`` all together (GLOMAP: Pan
    et al. 2024): a photograph that is put in a wrong place, by a pattern that repeats itself, takes all that
    follow with it. If verified pairs contradict the poses, they are found once more in the other way, and
    those are kept with which more of the pairs agree; then those that contradict fewer, or are more. Poses
    that more pairs contradict than agree with are taken away: of 18 such, 14 were wrong.
    """
    pairs = verified_pairs(database)
    say("finding the cameras: poses")

    def one_by_one() -> Poses | None:
        options = _incremental_options(pycolmap, threads)
        return _judged(pycolmap.incremental_mapping(database, images, work, options=options).values(), pairs)

    def together() -> Poses | None:
        (work / "together").mkdir()
        options = _global_options(pycolmap, threads)
        return _judged(
            pycolmap.global_mapping(database, images, work / "together", **options).values(), pairs
        )

    if not hasattr(pycolmap, "global_mapping"):  # an older version
        best = one_by_one()
        return best and best.without_outvoted()
    many = count >= MANY
    first, second, way = (together, one_by_one, "incremental") if many else (one_by_one, together, "global")
    best = first()
    if best is not None and not best.doubtful:
        return best
    if best is None:
        if not many:  # too few match
            return None
        say(f"finding the cameras: poses, {way}")
        best = second()
        return best and best.without_outvoted()
    say(
        f"finding the cameras: {len(best.contradicting):,} of {plural(len(pairs), 'pair')} contradict the"
        f" poses: once more, {way}"
    )
    other = second()
    if other is not None and other._rank() > best._rank():
        best = other
    return best.without_outvoted()


def verified_pairs(database: Path) -> dict[tuple[int, int], int]:
    """The matches of each verified pair of images in COLMAP's ``database``, by their numbers."""
    query = "select pair_id, rows from two_view_geometries where rows >= ?"
    with closing(sqlite3.connect(database)) as connection:
        rows = connection.execute(query, (LEAST,)).fetchall()
    return {pair_of(number): int(count) for number, count in rows}


def judge(model: Any, pairs: Mapping[tuple[int, int], int]) -> Poses:
    """What ``pairs``, from ``verified_pairs``, say of the poses of ``model``."""
    seen: dict[int, list[int]] = defaultdict(list)
    for number, point in model.points3D.items():
        for element in point.track.elements:
            seen[element.image_id].append(number)
    points = {image: np.unique(numbers) for image, numbers in seen.items()}
    placed = {number for number, image in model.images.items() if image.has_pose}
    none = np.zeros(0, np.int64)
    agreeing: list[tuple[int, int]] = []
    contradicting: list[tuple[int, int]] = []
    for (one, other), matches in pairs.items():
        if one in placed and other in placed:
            common = np.intersect1d(points.get(one, none), points.get(other, none), assume_unique=True)
            (contradicting if len(common) < SHARED * matches else agreeing).append((one, other))
    return Poses(model, tuple(agreeing), tuple(contradicting))


def _judged(models: Iterable[Any], pairs: Mapping[tuple[int, int], int]) -> Poses | None:
    """The largest of ``models``; None if there is none."""
    found = sorted(models, key=lambda model: model.num_reg_images(), reverse=True)
    if not found:
        return None
    taken = set(_placed(found[0]))
    apart = []
    for model in found[1:]:
        group = [name for name in _placed(model) if name not in taken]
        taken.update(group)
        if len(group) >= FEWEST_APART:
            apart.append(tuple(sorted(group)))
    return replace(judge(found[0], pairs), apart=tuple(apart))


def _take_pose(model: Any, image: int) -> None:
    """Takes its pose from an image of ``model``, and the points that no two others see."""
    if hasattr(model, "deregister_frame"):
        model.deregister_frame(model.images[image].frame_id)
    else:  # an older version
        model.deregister_image(image)


def _placed(model: Any) -> list[str]:
    """Names of the photographs that have a pose in ``model``."""
    return [image.name for image in model.images.values() if image.has_pose]


def _global_options(pycolmap: Any, threads: int | None) -> dict[str, Any]:
    """Options of ``global_mapping``."""
    if threads is None:
        return {}
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = threads
    return {"options": options}


def _incremental_options(pycolmap: Any, threads: int | None) -> Any:
    """Options of ``incremental_mapping``, with the names of the library's version."""
    options = pycolmap.IncrementalPipelineOptions()
    if threads is not None:
        options.num_threads = threads
    options.min_model_size = FEWEST_APART
    options.ba_global_max_refinements = REFINEMENTS
    options.ba_global_points_ratio = GROWTH
    frames = "ba_global_frames_ratio"
    setattr(options, frames if hasattr(options, frames) else "ba_global_images_ratio", GROWTH)
    return options
