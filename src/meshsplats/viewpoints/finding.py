"""find_cameras: the kind of a scene, which way is up, and views of it, from its splats alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from meshsplats._common.choices import MAX_SIDE
from meshsplats._common.kinds import need
from meshsplats._common.words import direction_in_words
from meshsplats.cameras.framing import DEFAULT_UP, guess_up, scene_bounds, unit_up, up_of_survey
from meshsplats.cameras.placing import (
    OBJECT_ELEVATIONS,
    STEPS,
    SURROUNDED_ELEVATIONS,
    has_surroundings,
    outside_cameras,
)
from meshsplats.rendering.layers import fragments
from meshsplats.rendering.previews import FRAGMENTS, preview_camera
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.kind import (
    FEWEST,
    Kind,
    kind_from_inside,
    kind_from_outside,
    surely_object,
    usual_depth,
)
from meshsplats.viewpoints.relief import Relief, find_relief
from meshsplats.viewpoints.sample import SMALL_SAMPLE, Sample
from meshsplats.viewpoints.search import FEW, Places, find_places
from meshsplats.viewpoints.standing import SEEN, find_stance, finer_stance, tips_over
from meshsplats.viewpoints.upright import MEASURED, find_upright
from meshsplats.viewpoints.views import NEARLY, Checked, choose_views, depth_of

MOST = 96
"""Views that are looked for, each checked with all splats; more are variations of these."""
FEWEST_OF_PLACE = 10_000
"""Number of splats, at least, in which level floors are looked for."""
FINGERPRINT = 20_000
"""Number of splats, at most, by which a scene is known again."""
AS_HELD = 0.5
"""How sure up is that of a photograph, where nobody names it: people hold cameras upright."""
SHIFT = 0.1
"""Greatest shift of a variation, as a share of the mean depth of the view."""
TURN = 8.0
"""Greatest turn of a variation, degrees."""
WIDE = 85.0
"""Degrees of every third variation, for what is around the subject, at most..."""
WIDER = 1.5
"""...and how much more it shows, at most, than the view that it is a variation of: a narrow view is one
because there is noise around it."""
BY_STANCE = "as the object stands (likely): with the usual {} it would tip over"
BY_COARSENESS = "as the object was photographed (likely): with the usual {} its coarse side is above"
BY_SURVEY = "as in coordinates of surveys, which these look like"
BY_FLOORS = "as floors or ground are level (likely)"
"""What shows another way up than the usual one."""


@dataclass(frozen=True, eq=False)
class FoundCameras:
    """What ``find_cameras`` found, in the frame of the splats."""

    kind: Kind
    """'object': an isolated object, seen from all around. 'relief': one image with depth (2.5D), seen from
    its camera. 'ring': an unbounded scene around a subject, inward-facing cameras. 'place': indoor or
    outward-facing, seen from within. 'aerial': a landscape from above."""
    confidence: float
    """How sure the kind is, 0 to 1."""
    up: np.ndarray
    """(3,) unit direction."""
    up_confidence: float
    """How sure ``up`` is: 1 where it was given, by the caller or the file, or a large floor shows it; 0 where
    it is the default of the format; more for coordinates of surveys."""
    ground: float
    """Height of the ground along ``up``: ``point @ up`` of points on it."""
    extent: float
    """Mean depth of the views, scene units: about how far one sees."""
    cameras: tuple[Camera, ...]
    """The first is the view to open with; those up to any other are evenly spread."""

    def in_words(self) -> str:
        """One line: the kind, which way is up, how far one sees."""
        sure = "sure" if self.confidence >= 0.6 else "likely" if self.confidence >= 0.4 else "perhaps"
        told = "sure" if self.up_confidence >= 0.6 else "likely" if self.up_confidence > 0 else "the default"
        what = {
            "object": "an object",
            "relief": "a single image with depth (2.5D), seen from its camera",
            "ring": "a subject in its surroundings",
            "place": "a place, seen from within",
            "aerial": "a landscape from above",
        }[self.kind]
        x, y, z = (f"{v:.2f}" for v in self.up + 0.0)
        return f"{what} ({sure}); up {x} {y} {z} ({told}); views {self.extent:.3g} units deep"

    def seen_in_words(self) -> str:
        """``in_words``, and that its views were found."""
        return f"{self.in_words()}: seen from views that were found"


_Key = tuple[bytes, bytes | None]
"""Of splats as they were, and of a given up."""


@dataclass(frozen=True)
class _Search:
    """What a search within a scene found, for images of any size and any smaller number of views."""

    key: _Key
    wanted: int
    """Number of views that were looked for."""
    is_place: bool
    """Whether they are what is shown unless views are looked for anywhere."""
    scene: FoundCameras
    views: list[tuple[Checked, int]]
    """And the numbers of their lenses."""


_searched: WeakKeyDictionary[GaussianCloud, _Search] = WeakKeyDictionary()
"""The last search within each scene that is in use: commands ask for views of several sizes and numbers."""


class _Outside(NamedTuple):
    """What a scene looks like from outside."""

    relief: Relief | None
    """That it is, or else what ``kind_from_outside`` says of it."""
    kind: Kind | None
    confidence: float
    up: np.ndarray
    """(3,) of an object: as it stands, where nobody names it."""
    up_confidence: float


_outsides: WeakKeyDictionary[GaussianCloud, tuple[_Key, _Outside]] = WeakKeyDictionary()
"""And what it looked like from outside, also where it is an object, in which nothing is searched."""


def find_cameras(
    cloud: GaussianCloud,
    count: int = 24,
    *,
    up: Sequence[float] | np.ndarray | None = None,
    width: int = 400,
    height: int | None = None,
    anywhere: bool = False,
    threads: int | None = None,
) -> FoundCameras:
    """Cameras that see a scene as photographs did, found from its splats alone.

    An object is seen from a dome around it, a photograph whose pixels were given depth from where it was
    taken, and from close to there: nothing is known of its sides and its back. Splats that are too faint or
    small to be seen from anywhere count as an object. In any other scene the dome shows walls from behind
    and the noise that no photograph saw, so views are looked for from where splats look small and leave no
    holes. The result has the same bits on every run, with any number of threads.

    Args:
        cloud: the splats.
        count: number of views. More than ``MOST`` are variations of those; in a small or poor scene fewer
            than that are found.
        up: (3,) direction; None: found, where the cloud does not name it.
        width, height: of the images, pixels; ``height`` None: as ``width``.
        anywhere: look for views also where the scene is an object.
        threads: at most this many; all processors by default.

    Raises ValueError for an empty cloud, one that is invisible from within, or a value out of its range."""
    need(GaussianCloud, cloud=cloud)
    if len(cloud) == 0:
        raise ValueError("the scene is empty: there is nothing to look at")
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    height = width if height is None else height
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ValueError(f"width and height must lie between 1 and {MAX_SIDE} pixels")
    given, first_up = _told_up(cloud, up)
    key, wanted = _key(cloud, given), min(count, MOST)
    found = _searched.get(cloud)
    if found is None or found.key != key or found.wanted < wanted or not (anywhere or found.is_place):
        outside = _from_outside(cloud, key, first_up, threads)
        if outside.relief is not None:
            return _before(cloud, outside.relief, given, count, width, height)
        kind, confidence = outside.kind, outside.confidence
        if kind == "object" and not anywhere:
            return _around(cloud, outside, count, width, height)
        if not cloud.opacities.any():
            raise ValueError("no splat has any opacity: there is nothing to look at")
        sample = Sample(cloud, first_up, threads)
        places = find_places(sample)
        if not places.worth.any():
            if anywhere:
                raise ValueError("the splats are so faint or small that nothing can be seen from within")
            return _around(cloud, outside._replace(confidence=0.0), count, width, height)
        scene = _within(sample, places, kind, confidence, given)
        views = choose_views(sample, places, scene.up, wanted, around=scene.kind == "ring")
        found = _searched[cloud] = _Search(key, wanted, kind != "object", scene, views)
    shown = [view.with_lens(lens, width, height) for view, lens in found.views[:count]]
    extent = float(np.median([depth_of(camera) for camera in shown]))
    cameras = [replace(camera, name=f"view_{i:04d}") for i, camera in enumerate(varied(shown, count))]
    return replace(found.scene, extent=extent, cameras=tuple(cameras))


def first_impression(
    cloud: GaussianCloud, *, up: Sequence[float] | np.ndarray | None = None, threads: int | None = None
) -> FoundCameras | None:
    """What ``find_cameras`` says of a scene, without cameras: from a smaller sample and fewer places, in a
    fraction of its time. Where one of the two is not sure, they may differ.

    None for an empty scene, and for splats so large that looking at them takes long.
    """
    if not worth_a_look(cloud):
        return None
    given, first_up = _told_up(cloud, up)
    outside = _from_outside(cloud, _key(cloud, given), first_up, threads)
    if outside.relief is not None:
        return replace(_before(cloud, outside.relief, given, 1, 400, 400), cameras=())
    if outside.kind == "object":
        return replace(_around(cloud, outside, 1, 400, 400), cameras=())
    seen = _glimpse(cloud, first_up, threads)
    if seen is None:
        return replace(_around(cloud, outside._replace(confidence=0.0), 1, 400, 400), cameras=())
    return _within(*seen, outside.kind, outside.confidence, given)


def _glimpse(cloud: GaussianCloud, up: np.ndarray, threads: int | None) -> tuple[Sample, Places] | None:
    """A small sample of a scene, and few places in it; None where nothing can be seen from any of them."""
    sample = Sample(cloud, up, threads, SMALL_SAMPLE)
    places = find_places(sample, FEW)
    return (sample, places) if places.worth.any() else None


class UnusualUp(NamedTuple):
    """A way up that is not that of the format."""

    up: np.ndarray
    """(3,) unit direction."""
    reason: str
    """What shows it."""


def unusual_up(cloud: GaussianCloud, threads: int | None = None) -> UnusualUp | None:
    """Another way up than the usual one of a scene whose file names none: that in which an object stands well
    that would tip over, or along which the floors or the ground of a place are level; else z for the
    coordinates of a survey; else None."""
    if cloud.up is not None:
        return None
    usual = guess_up(cloud)
    if len(cloud) >= FEWEST and worth_a_look(cloud) and (seen := _seen_up(cloud, usual, threads)) is not None:
        return seen
    return None if np.array_equal(usual, DEFAULT_UP) else UnusualUp(usual, BY_SURVEY)


def _seen_up(cloud: GaussianCloud, usual: np.ndarray, threads: int | None) -> UnusualUp | None:
    """Another way up than the ``usual`` one (3,), if splats show it."""
    few = len(cloud) < FEWEST_OF_PLACE
    if not tips_over(cloud) and surely_object(cloud, usual, threads):
        return None
    outside = _from_outside(cloud, _key(cloud, None), usual, threads)
    if outside.kind == "object":
        stands = outside.up_confidence > 0 and not np.array_equal(outside.up, usual)
        reason = BY_STANCE if tips_over(cloud) else BY_COARSENESS
        return UnusualUp(outside.up, reason.format(direction_in_words(usual))) if stands else None
    # A landscape is flat the usual way up, and its ground may slope.
    if outside.kind in ("relief", "aerial") or few or not cloud.opacities.any():
        return None
    seen = _glimpse(cloud, usual, threads)
    if seen is None:
        return None
    upright = find_upright(*seen, usual, exact=up_of_survey(cloud) is not None)
    leans = upright.level and not np.array_equal(upright.up, usual)
    return UnusualUp(upright.up, BY_FLOORS) if leans else None


def _key(cloud: GaussianCloud, given: np.ndarray | None) -> _Key:
    return _fingerprint(cloud), None if given is None else given.tobytes()


def _fingerprint(cloud: GaussianCloud) -> bytes:
    """Digest of some of the splats: those of a cloud that was changed in place have another."""
    step = -(-len(cloud) // FINGERPRINT)
    digest = blake2b(len(cloud).to_bytes(8, "little"), digest_size=16)
    for values in (cloud.means, cloud.quaternions, cloud.scales, cloud.opacities):
        digest.update(np.ascontiguousarray(values[::step]).tobytes())
    return digest.digest()


def worth_a_look(cloud: GaussianCloud) -> bool:
    """Whether there is anything to see, within a reasonable time: not in splats as large as their scene."""
    return len(cloud) > 0 and fragments(cloud, preview_camera(cloud), 1) <= FRAGMENTS


def _told_up(
    cloud: GaussianCloud, up: Sequence[float] | np.ndarray | None
) -> tuple[np.ndarray | None, np.ndarray]:
    """The direction that the caller or the cloud names, or None; and the one to begin with."""
    given = unit_up(up) if up is not None else None if cloud.up is None else guess_up(cloud)
    return given, guess_up(cloud) if given is None else given


def _from_outside(cloud: GaussianCloud, key: _Key, up: np.ndarray, threads: int | None) -> _Outside:
    """What splats look like from outside. It looks once at splats that did not change."""
    known = _outsides.get(cloud)
    if known is None or known[0] != key:
        relief, sure = find_relief(cloud, up), 0.0 if key[1] is None else 1.0
        kind, confidence = ("relief", relief.confidence) if relief else kind_from_outside(cloud, up, threads)
        if kind == "object" and key[1] is None:
            up, sure = find_stance(cloud, threads) if len(cloud) >= FEWEST else (up, 0.0)
        if kind is None and key[1] is None and (stance := finer_stance(cloud, threads)) is not None:
            as_it_stands, surer = kind_from_outside(cloud, stance, threads)
            if as_it_stands == "object":
                kind, confidence, up, sure = as_it_stands, surer, stance, SEEN
        surveyed = up_of_survey(cloud) if key[1] is None else None
        if surveyed is not None and np.array_equal(up, surveyed):
            sure = MEASURED
        seen = _Outside(relief, kind, confidence, up, sure)
        known = _outsides[cloud] = key, seen
    return known[1]


def _around(cloud: GaussianCloud, seen: _Outside, count: int, width: int, height: int) -> FoundCameras:
    """An object and ``count`` cameras of a dome around it."""
    up = seen.up
    elevations = SURROUNDED_ELEVATIONS if has_surroundings(cloud) else OBJECT_ELEVATIONS
    cameras = outside_cameras(cloud, count, elevations=elevations, up=up, width=width, height=height)
    bounds = scene_bounds(cloud)
    ground = float((bounds.points @ up).min())
    extent = float(np.linalg.norm(cameras[0].center - bounds.center))
    return FoundCameras("object", seen.confidence, up, seen.up_confidence, ground, extent, tuple(cameras))


def _before(
    cloud: GaussianCloud, relief: Relief, given: np.ndarray | None, count: int, width: int, height: int
) -> FoundCameras:
    """A photograph with depth and ``count`` cameras near its own."""
    up, sure = (relief.up, AS_HELD) if given is None else (given, 1.0)
    step = -(-len(cloud) // FINGERPRINT)
    ground = float(np.quantile(cloud.means[::step] @ up, 0.01))
    extent = float(np.linalg.norm(relief.target - relief.place))
    cameras = relief.cameras(count, width, height)
    cameras = [replace(camera, name=f"view_{i:04d}") for i, camera in enumerate(cameras)]
    return FoundCameras("relief", relief.confidence, up, sure, ground, extent, tuple(cameras))


def _within(
    sample: Sample, places: Places, kind: Kind | None, confidence: float, given: np.ndarray | None
) -> FoundCameras:
    """A scene that is seen from ``places``, without cameras; ``kind``: as it looks from outside."""
    first_up = guess_up(sample.cloud) if given is None else given
    of_survey = given is None and up_of_survey(sample.cloud) is not None
    upright = find_upright(sample, places, first_up, exact=of_survey)
    up, sure = (upright.up, upright.confidence) if given is None else (given, 1.0)
    if kind is None:
        kind, confidence = kind_from_inside(sample, places, up)
    extent = usual_depth(sample, places, places.worth >= NEARLY * places.worth.max())
    return FoundCameras(kind, confidence, up, sure, upright.ground, extent, ())


def varied(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """``count`` cameras: the given ones, then variations of them from nearby; every third one is wide."""
    views = list(cameras[:count])
    for i in range(len(views), count):
        camera = cameras[i % len(cameras)]
        depth = depth_of(camera)
        x, y, z = 2 * ((0.5 + np.array([*STEPS]) * i) % 1) - 1
        matrix = np.eye(4)
        matrix[:3, :3] = _turned(np.radians(TURN) * x, np.radians(TURN) * y)
        matrix[:3, 3] = SHIFT * depth * np.array([y, 0.5 * z, x])
        focal = camera.fx
        if i % 3 == 2:
            widest = min(camera.width, camera.height) / 2 / np.tan(np.radians(WIDE) / 2)
            focal = min(focal, max(widest, focal / WIDER))
        views.append(replace(camera, world_to_camera=matrix @ camera.world_to_camera, fx=focal, fy=focal))
    return views


def _turned(right: float, down: float) -> np.ndarray:
    """(3, 3) rotation in the frame of a camera."""
    a, b, c, d = np.cos(right), np.sin(right), np.cos(down), np.sin(down)
    level = np.array([[a, 0, -b], [0, 1, 0], [b, 0, a]])
    tilt = np.array([[1, 0, 0], [0, c, -d], [0, d, c]])
    return tilt @ level
