"""Views for a number of cameras: each shows what the others do not, as photographs would."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshsplats.cameras.trajectories import look_at
from meshsplats.scene.camera import Camera
from meshsplats.viewpoints.sample import CONE, LEVELS, Sample, merit
from meshsplats.viewpoints.search import BEST, FINER, Places

TARGETS = 2000
"""Splats whose coverage is counted."""
CANDIDATES = 4000
"""Places and directions among which views are chosen, at most."""
NEARLY = 0.65
"""Least worth of a candidate, as a share of that of the best."""
LEVEL = 0.85
"""Greatest cosine between the gaze and the vertical."""
TILTED = 0.4
"""How much less worth a vertical view has than a level one."""
STRAY = 4.0
"""Places farther from the middle of the best ones than this many median distances are not used."""
SHOWN_FINER = 1.6
"""Tolerance below the natural angle of splats that count as shown, in its logarithm."""
STEPS = 8
"""Steps in which the merit of a splat in a view is counted."""
RICH = 0.3
"""Least number of splats that a view shows, as a share of what good views show: noise has few."""
UNCOMMON = 0.4
"""Least weight of a splat that few of the best places show."""
NEARBY = 0.7
"""Distance, in spreads of the places and units of direction, within which views show much the same..."""
ALIKE = 0.12
"""...that within which they are as bad as each other..."""
LIKELY = 0.5
"""...and that within which they are likely both good pictures, or neither."""
TRUST = 4.0
"""So many views that are no good pictures halve what one like them is worth."""
SIDE = 56
"""Pixels of a side of the images in which views are checked."""
WIDEST, WIDE, NARROWEST = 84.0, 60.0, 40.0
"""Degrees: the widest field of view, that by which scenes are judged, and the narrowest."""
POOR = 0.25
"""Merit below which a pixel is poor."""
MAX_POOR = 0.2
"""Greatest share of poor pixels in a view."""
POOL = 24
"""Views whose fog tells what is usual in the scene."""
PATIENCE = 40
"""So many views in a row that are no good pictures, and no more are looked for."""
NEAR_SHARE = 0.02
"""Near plane as a share of the mean depth of the view, which ``depth_of`` has from it again."""
STEPS_BACK = (1.3, 1.15, 1.0)
"""Distances to a subject from which a scene may open, as multiples of that of the view that is turned to it:
the whole subject is to be in the image, where photographs may show a part."""
TURNED = 0.8
"""Least cosine between that view and the direction to the subject."""
POOR_BESIDE = 0.35
"""Greatest share of poor pixels in an opening view of a subject, beside which they lie."""
CROSSINGS = 8
"""Rounds in which the point is found that most lines of sight pass."""


def depth_of(camera: Camera) -> float:
    """Mean depth, scene units, of a view that was found."""
    assert camera.near is not None
    return camera.near / NEAR_SHARE


@dataclass(frozen=True, eq=False)
class Checked:
    """A view as all splats show it, at several fields of view, widest first."""

    camera: Camera
    """The widest."""
    focal: np.ndarray
    """(k,) focal lengths as multiples of that of ``camera``."""
    poor: np.ndarray
    """(k,) shares of pixels without a surface of fine splats."""
    fog: np.ndarray
    """(k,) how much the view is like fog: holes, and splats in front of each other."""

    def widest(self, limit: float) -> int | None:
        """The widest field of view that is a good picture."""
        fine = np.flatnonzero((self.poor <= MAX_POOR) & (self.fog <= limit))
        return int(fine[0]) if len(fine) else None

    def with_lens(self, k: int, width: int, height: int) -> Camera:
        focal = self.camera.fx * self.focal[k] * min(width, height) / self.camera.width
        return replace(
            self.camera, fx=focal, fy=focal, cx=width / 2, cy=height / 2, width=width, height=height
        )


def check(
    sample: Sample, place: np.ndarray, gaze: np.ndarray, depth: float, up: np.ndarray, natural: float
) -> Checked:
    """The view from ``place`` along ``gaze``, drawn of all splats."""
    camera = look_at(
        place,
        place + gaze * depth,
        up=up,
        width=SIDE,
        height=SIDE,
        fov=WIDEST,
        near=NEAR_SHARE * depth,
    )
    log_angle, alpha, spread = sample.whole.look(camera)
    poor = (alpha < 0.9) | (merit(log_angle, natural, FINER) < POOR)
    half = SIDE // 2
    cuts = np.arange(int(half * (1 - np.tan(np.radians(NARROWEST / 2)) / np.tan(np.radians(WIDEST / 2)))) + 1)
    shares, fogs = [], []
    for cut in cuts:
        inner = (slice(cut, SIDE - cut),) * 2
        shares.append(poor[inner].mean())
        fogs.append((1 - alpha[inner]).mean() / 0.03 + np.quantile(spread[inner], 0.8) / 0.15)
    return Checked(camera, half / (half - cuts), np.array(shares), np.array(fogs))


class Chooser:
    """Chooses views among places and directions of much worth."""

    def __init__(self, sample: Sample, places: Places, up: np.ndarray) -> None:
        self.sample, self.places, self.up = sample, places, up
        tilt = np.abs(sample.gaze @ up)
        away = np.linalg.norm(places.places - np.median(places.places[:BEST], axis=0), axis=1)
        among = away <= STRAY * np.median(away[:BEST])
        worth = places.worth * (tilt < LEVEL) * (1 - TILTED * tilt * tilt) * among[:, None]
        best = float(np.quantile(worth[:BEST].max(axis=1), 0.75))
        self.all_worth = worth
        self.place, self.gaze = np.nonzero(worth >= NEARLY * best)
        if not len(self.place):
            self.place, self.gaze = (np.array([k]) for k in np.unravel_index(worth.argmax(), worth.shape))
        step = -(-len(self.place) // CANDIDATES)
        self.place, self.gaze = self.place[::step], self.gaze[::step]
        self.worth = worth[self.place, self.gaze] / max(best, 1e-9)
        top = places.places[:BEST]
        self.spread = float(np.linalg.norm(top.std(axis=0))) or sample.radius
        self.spots = np.concatenate(
            [places.places[self.place] / self.spread * 1.2, sample.gaze[self.gaze]], 1
        )
        self.shown = self._shown()
        # What only a few of the best places show is noise, likely.
        common = np.zeros(self.shown.shape[1])
        for k in np.unique(self.place[self.place < BEST]):
            common += (self.shown[self.place == k] > 0.25 * STEPS).any(axis=0)
        self.weight = np.clip(common / max(float(np.quantile(common, 0.8)), 1.0), UNCOMMON, 1)
        total = self.shown @ np.round(LEVELS * self.weight).astype(np.float32)
        self.rich = total >= RICH * np.quantile(total, 0.9)
        self._checked: dict[int, Checked] = {}
        self.pool = self.in_order(None, POOL, np.inf)
        """The best candidates, whether they are good pictures or not."""

    def _shown(self) -> np.ndarray:
        """(candidates, TARGETS) float32 whole numbers up to STEPS: how well each shows each splat."""
        sample, places = self.sample, self.places
        rng = np.random.default_rng(1)
        rows = np.sort(rng.choice(len(sample.means), min(TARGETS, len(sample.means)), replace=False))
        opacity = sample.thin.opacities[rows].astype(np.float64)
        shown = np.zeros((len(self.place), len(rows)), np.float32)
        for k in np.unique(self.place):
            seen, toward = sample.seen_at(places.depth[k], places.places[k], rows)
            away = np.linalg.norm(sample.means[rows] - places.places[k], axis=1)
            angle = sample.size[rows] / away
            value = seen * opacity * merit(np.log(angle), places.natural, SHOWN_FINER)
            value *= np.minimum(angle / places.natural, 1)  # far views show everything, but small
            these = np.flatnonzero(self.place == k)
            inside = sample.gaze[self.gaze[these]] @ toward.T > np.cos(np.radians(CONE))
            shown[these] = np.round(STEPS * value * inside)
        return shown

    def checked(self, k: int) -> Checked:
        """Candidate ``k`` as all splats show it."""
        if k not in self._checked:
            place, gaze = self.place[k], self.gaze[k]
            q, all_gaze = self.all_worth[place], self.sample.gaze
            near = all_gaze @ all_gaze[gaze] > 0.9
            mean = (np.maximum(q - 0.8 * q[gaze], 0) * near) @ all_gaze  # between the directions
            direction = mean / np.linalg.norm(mean)
            depth = self.sample.depth_along(self.places.depth[place], direction)
            self._checked[k] = check(
                self.sample, self.places.places[place], direction, depth, self.up, self.places.natural
            )
        return self._checked[k]

    def in_order(self, first: int | None, count: int, limit: float) -> list[int]:
        """Up to ``count`` candidates that are good pictures: each shows what those before it do not."""
        chosen: list[int] = []
        need = np.round(LEVELS * self.weight).astype(np.float32)
        count_shown = np.zeros(self.shown.shape[1])
        open_ones = self.rich.copy()
        nearest = np.full(len(self.place), np.inf)
        good, bad = np.full(len(self.place), TRUST), np.zeros(len(self.place))
        failed = 0  # in a row: what is chosen does not depend on how many are wanted
        while len(chosen) < count and open_ones.any() and failed < PATIENCE:
            if first is not None and not chosen:
                k = first
            else:
                gain = (self.shown @ need).astype(np.float64) * self.worth
                gain *= 1 - np.exp(-nearest / NEARBY**2)
                gain *= good / (good + bad)
                k = int(np.argmax(np.where(open_ones, gain, -1)))
            open_ones[k] = False
            apart = ((self.spots - self.spots[k]) ** 2).sum(axis=1)
            alike = np.exp(-apart / LIKELY**2)
            if np.isfinite(limit) and self.checked(k).widest(limit) is None:
                open_ones &= apart > ALIKE**2
                bad += alike
                failed += 1
                continue
            chosen.append(k)
            failed = 0
            good += alike
            count_shown += self.shown[k] / STEPS
            need = np.round(LEVELS * self.weight / (1 + count_shown)).astype(np.float32)
            nearest = np.minimum(nearest, apart)
        return chosen

    def fog_limit(self) -> float:
        """The most fog of a good picture: as much as usual for the scene's better views."""
        fog = []
        for k in self.pool:
            found = self.checked(k)
            judged = np.tan(np.radians(WIDEST / 2)) / found.focal >= np.tan(np.radians(WIDE / 2)) * 0.98
            fog.append(found.fog[judged][-1])
        return float(np.clip(2 * np.quantile(fog, 0.2), 1.5, 3.5))

    def opening(self, limit: float) -> int | None:
        """The candidate to open with: much worth, level or a little down, amid the places."""
        places = self.places.places
        middle = np.median(places[:BEST], axis=0)
        amid = np.linalg.norm(places[self.place] - middle, axis=1) / self.spread
        level = np.abs(self.sample.gaze[self.gaze] @ self.up + 0.2)
        shown = self.shown.sum(axis=1)
        value = self.worth + 0.5 * shown / max(shown.max(), 1) - 0.5 * level - 0.2 * amid
        for k in np.argsort(np.where(self.rich, -value, np.inf), kind="stable")[: 2 * POOL]:
            if self.checked(int(k)).widest(limit) is not None:
                return int(k)
        return None

    def subject(self) -> np.ndarray:
        """(3,) the point that the views of ``pool`` look at: that of the least sum of distances to lines."""
        views = [self.checked(k).camera for k in self.pool]
        start = np.array([view.center for view in views])
        gaze = np.array([view.world_to_camera[2, :3] for view in views])
        across = np.eye(3) - gaze[:, :, None] * gaze[:, None, :]
        middle, weight = start.mean(axis=0), np.ones(len(views))
        for _ in range(CROSSINGS):
            total = np.einsum("n,nij->ij", weight, across) + 1e-9 * weight.sum() * np.eye(3)
            point = middle + np.linalg.solve(total, np.einsum("n,nij,nj->i", weight, across, start - middle))
            missed = np.linalg.norm(np.einsum("nij,nj->ni", across, point - start), axis=1)
            weight = 1 / (missed + 0.05 * np.median(np.linalg.norm(point - start, axis=1)))
        return point

    def of_subject(self, view: Checked, lens: int, limit: float) -> Checked:
        """``view``, turned to the subject and from further back, if that is as good a picture with ``lens``:
        but for its edges, where photographs show less."""
        place, gaze = view.camera.center, view.camera.world_to_camera[2, :3]
        away = self.subject() - place
        distance = float(np.linalg.norm(away))
        if away @ gaze <= TURNED * distance:
            return view
        for back in STEPS_BACK:
            stand = place + (1 - back) * away
            seen = check(self.sample, stand, away / distance, back * distance, self.up, self.places.natural)
            if seen.widest(limit) is not None and seen.poor[lens] <= POOR_BESIDE:
                return seen
        return view


def choose_views(
    sample: Sample, places: Places, up: np.ndarray, count: int, *, around: bool = False
) -> list[tuple[Checked, int]]:
    """Up to ``count`` views, the opening one first, each with the number of its lens. ``around``: they stand
    around a subject, which the first of them shows as a whole."""
    chooser = Chooser(sample, places, up)
    limit = chooser.fog_limit()
    chosen = [chooser.checked(k) for k in chooser.in_order(chooser.opening(limit), count, limit)]
    if not chosen:  # none is good: the narrowest of the best there are
        best = [chooser.checked(k) for k in chooser.pool[:count]]
        return [(view, len(view.focal) - 1) for view in best]
    lenses = [view.widest(limit) for view in chosen]
    views = [(view, lens) for view, lens in zip(chosen, lenses, strict=True) if lens is not None]
    if around:
        views[0] = chooser.of_subject(*views[0], limit), views[0][1]
    return views
