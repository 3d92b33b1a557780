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

GROWTH = 1.4
"""All cameras are adjusted together again when there are so many times as many, or as many points."""
REFINEMENTS = 2
"""Times that they are, at most. With COLMAP's defaults, 1.1 and 5, poses take a third longer, or several
times as long, and are not more exact."""
STRONG = 100
"""Matches that make a pair of photographs a strong one."""
SHARED = 0.1
"""A strong pair whose photographs see fewer common points than this share of its matches contradicts the
poses. Where these are right, no pair has less than 0.5."""
TOLERATED = 0.01
"""Share of the strong pairs that may contradict them. Of a phone's 50 photographs, none do; of 116 of a room,
where a repeated pattern has put five in a wrong place, 0.026, and half of them, 0.09."""
MANY = 60
"""Photographs from which on poses are first found all together: of 292 of a room in 51 s, all right, where
one after the other took 108 s and placed none, with contradictions that were tolerated; of 50 of a phone, one
after the other is right, and all together are two wrong."""
FEWEST_APART = 3
"""Photographs that are named as a group of their own if they have poses together, but not with the rest."""
_MAX_IMAGES = 2**31 - 1


def pair_of(number: int) -> tuple[int, int]:
    """The two images of which COLMAP's database makes one ``number``."""
    return divmod(number, _MAX_IMAGES)


@dataclass(frozen=True)
class Poses:
    """A model of pycolmap, and what strong pairs say of it."""

    model: Any
    agreeing: int
    """Strong pairs that agree with it..."""
    contradicting: tuple[tuple[int, int], ...]
    """... and the image numbers of those that do not. Pairs with a photograph that has no pose do neither."""
    apart: tuple[tuple[str, ...], ...] = ()
    """Names of photographs that have poses together, but not with these, in groups."""

    @property
    def doubtful(self) -> bool:
        """Whether more contradict it than may."""
        return len(self.contradicting) > TOLERATED * (self.agreeing + len(self.contradicting))

    def suspects(self) -> list[str]:
        """Names of the photographs in contradicting pairs, those in most of them first."""
        counts = Counter(image for pair in self.contradicting for image in pair)
        return [self.model.images[image].name for image, _ in counts.most_common()]


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
    follow with it. If strong pairs contradict the poses, they are found once more in the other way, and
    those are kept with which more of the pairs agree.
    """
    pairs = strong_pairs(database)
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
        return one_by_one()
    many = count >= MANY
    first, second, way = (
        (together, one_by_one, "one after the other") if many else (one_by_one, together, "all together")
    )
    best = first()
    if best is not None and not best.doubtful:
        return best
    if best is None:
        if not many:  # too few match
            return None
        say(f"finding the cameras: poses, {way}")
        return second()
    say(
        f"finding the cameras: {len(best.contradicting):,} of {len(pairs):,} pairs contradict the poses:"
        f" once more, {way}"
    )
    other = second()
    return other if other is not None and other.agreeing > best.agreeing else best


def strong_pairs(database: Path) -> dict[tuple[int, int], int]:
    """The matches of each strong pair of images in COLMAP's ``database``, by their numbers."""
    query = "select pair_id, rows from two_view_geometries where rows >= ?"
    with closing(sqlite3.connect(database)) as connection:
        rows = connection.execute(query, (STRONG,)).fetchall()
    return {pair_of(number): int(count) for number, count in rows}


def judge(model: Any, pairs: Mapping[tuple[int, int], int]) -> Poses:
    """What ``pairs``, from ``strong_pairs``, say of the poses of ``model``."""
    seen: dict[int, list[int]] = defaultdict(list)
    for number, point in model.points3D.items():
        for element in point.track.elements:
            seen[element.image_id].append(number)
    points = {image: np.unique(numbers) for image, numbers in seen.items()}
    placed = {number for number, image in model.images.items() if image.has_pose}
    none = np.zeros(0, np.int64)
    agreeing, contradicting = 0, []
    for (one, other), matches in pairs.items():
        if one in placed and other in placed:
            common = np.intersect1d(points.get(one, none), points.get(other, none), assume_unique=True)
            if len(common) < SHARED * matches:
                contradicting.append((one, other))
            else:
                agreeing += 1
    return Poses(model, agreeing, tuple(contradicting))


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
