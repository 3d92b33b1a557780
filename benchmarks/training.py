"""Training from photographs alone: PSNR on held-out views, and what each choice is worth.

    python benchmarks/training.py --data ../shared/data --scenes lego snowmiku --steps 2800
    python benchmarks/training.py --data ../shared/data --scenes lego --steps 600 --downscale 2 --vary
    python benchmarks/training.py --own --steps 200
    python benchmarks/training.py --data ../shared/data --scenes bonsai saharov --start
    python benchmarks/training.py --data ../shared/data --scenes bonsai saharov --minutes 10

The seconds are processor time of all threads divided by --processors, so that other work on the machine
does not count; reading and matching photographs does. --start: no step, the fans that a training starts
from. --vary trains with one choice changed at a time: no growth, all images at full size, other numbers of
fans at the start and sides. --own trains on 35 images of 128 x 96 pixels of our own scenes: the still life
inside a room, and a house outdoors below a sky, as they are, with photographs that are not what they should
be, and with gains from 0.6 to 1.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from _common import PHOTOGRAPHED, Report, Scene, Stopwatch, arguments

import meshsplats as ms
from meshsplats.datasets.views import ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.demo_scene.city import city_blocks
from meshsplats.training.run import starting_fans

SCENES = {name: PHOTOGRAPHED[name] for name in ("lego", "snowmiku")} | {
    name: Scene(name, "", f"photos/{name}") for name in ("bonsai", "saharov", "dtu65")
}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "no growth": {"growth_events": 0},
    "all images at full size": {"quarter_share": 0.0, "half_share": 0.0},
    "40,000 fans at the start": {"start_splats": 40_000},
    "2 x 2 samples throughout": {"one_sample_share": 0.0},
    "exact order throughout": {"by_splat_share": 0.0},
    "order of the fans to the end": {"order": "splat"},
    "4 sides": {"sides": 4},
    "8 sides": {"sides": 8},
    "position rates of short runs": {"rate_steps": 250},
    "no decay of opacities": {"opacity_decay": 0.0},
    "fans of any shape": {"shape_decay": 0.0},
    "rates and L2 of fine-tuning": {"color_rate": 0.02, "position_rate": 0.02, "l2_weight": 50.0},
}
OWN_VIEWS, OWN_SIZE, OWN_FANS = 40, (128, 96), 5_000
HELD_OUT = 8
"""Every view of this many of our own scenes is held out."""


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--own", action="store_true", help="our own scenes, in place of those of --data")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    length = parser.add_mutually_exclusive_group(required=True)
    length.add_argument("--steps", type=int)
    length.add_argument("--minutes", type=float)
    length.add_argument("--start", action="store_true", help="no step: the fans at the start")
    parser.add_argument("--downscale", type=int, default=1, help="further factor of the images' sides")
    parser.add_argument("--max-splats", type=int, default=100_000)
    parser.add_argument("--start-splats", type=int, help="by default all of --max-splats")
    parser.add_argument("--vary", action="store_true", help="all variants, not the default alone")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--processors", type=int, default=2, help="that processor time is divided by")
    options = parser.parse_args()
    if options.own and not options.steps:
        parser.error("--own needs --steps")
    with Report(options) as report:
        if options.own:
            own_scenes(report, options)
            return
        report.table("scene", "variant", "fans", "seconds", "PSNR (median)", "exposure fitted")
        for name in options.scenes:
            for variant in VARIANTS if options.vary else ("default",):
                report.row(*row(name, variant, options))


def row(name: str, variant: str, options: argparse.Namespace) -> tuple[str, ...]:
    watch = Stopwatch()
    folder = options.data / SCENES[name].photographs
    data = ms.load_dataset(folder, downscale=SCENES[name].downscale * options.downscale)
    if data.train[0].alpha is None:
        data = data.over((0, 0, 0))
    fans_allowed = {"max_splats": options.max_splats, "start_splats": options.start_splats}
    changes = {**fans_allowed, **VARIANTS[variant]}
    length = {"minutes": options.minutes} if options.minutes else {"steps": options.steps or 1}
    config = ms.train_config(**length, **changes)
    train, points = ms.Dataset(data.train), ms.load_points(folder)
    if options.start:
        mesh = starting_fans(train, config, points, options.threads)
    else:
        mesh = ms.train(train, config, points=points, run=ms.RunOptions(threads=options.threads))
    seconds = watch.idle(options.processors)
    method = ms.evaluate(mesh, data, fit_exposure=True, threads=options.threads).method("mesh")
    fans = len(mesh.vertices) // (1 + config.sides)
    psnr = f"{method.mean('psnr'):.2f} ({method.median('psnr'):.2f})"
    return name, variant, f"{fans:,}", f"{seconds:.0f}", psnr, f"{method.mean('psnr_exposure'):.2f}"


# ---- Our own scenes


def own_scenes(report: Report, options: argparse.Namespace) -> None:
    heads = ("photographs", "exposure fit", "seconds", "PSNR (median)", "exposure fitted", "named")
    report.table("scene", *heads)
    for name, views in (("inside a room", room_views()), ("outdoors", street_views())):
        clean = [view for i, view in enumerate(views) if i % HELD_OUT]
        test = tuple(views[::HELD_OUT])
        gains = np.random.default_rng(0).uniform(0.6, 1.0, len(clean))
        darker = [lit(view, float(gain)) for view, gain in zip(clean, gains, strict=True)]
        for kind, train, truth, exposure in (
            ("as they are", clean, test, False),
            ("3 blurred, 1 misplaced, 3 missing", spoiled(clean), test, False),
            ("gains of 0.6 to 1", darker, tuple(lit(view, 0.8) for view in test), False),
            ("gains of 0.6 to 1", darker, tuple(lit(view, 0.8) for view in test), True),
        ):
            data = ms.Dataset(tuple(train), truth).over((0, 0, 0))
            config = ms.train_config(
                steps=options.steps, start_splats=OWN_FANS // 2, max_splats=OWN_FANS, exposure=exposure
            )
            watch = Stopwatch()
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                mesh = ms.train(data, config, run=ms.RunOptions(threads=options.threads))
            seconds = watch.idle(options.processors)
            method = ms.evaluate(mesh, data, fit_exposure=True, threads=options.threads).method("mesh")
            psnr = f"{method.mean('psnr'):.2f} ({method.median('psnr'):.2f})"
            named = "; ".join(str(w.message).split(". Their")[0] for w in said)
            fitted = f"{method.mean('psnr_exposure'):.2f}"
            report.row(name, kind, exposure, f"{seconds:.0f}", psnr, fitted, named)


def room_views() -> list[ms.View]:
    """The still life between walls, from inside: every other camera looks past it to the wall across, the
    others look outwards."""
    cameras = []
    for i in range(OWN_VIEWS):
        turn = np.pi * (1 + np.sqrt(5)) * i
        reach = 2.4 if i % 2 else 1.7
        place = np.array([reach * np.cos(turn), -0.7 - 0.5 * (i % 3), reach * np.sin(turn)])
        target = place * [-1, 0.5, -1] if i % 2 else place * [2, 1, 2] + [0, 0.3, 0]
        cameras.append(own_camera(place, target, i))

    def walls(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        low, high = np.array([-4.0, -2.6, -4.0]), np.array([4.0, 0.9, 4.0])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(rays > 0, (high - origin) / rays, (low - origin) / rays)
        return waves(origin + rays * np.nanmin(reach, axis=-1, keepdims=True))

    return views_of(make_scene(20_000), cameras, walls)


def street_views() -> list[ms.View]:
    """A house with its garden below a sky, from all sides."""
    (cloud,) = city_blocks(20_000)
    cameras = []
    for i in range(OWN_VIEWS):
        turn = np.pi * (1 + np.sqrt(5)) * i
        place = np.array([24 * np.cos(turn), -3.0 - 3 * (i % 3), 24 * np.sin(turn)])
        cameras.append(own_camera(place, np.array([0.0, -5.0, 0.0]), i))

    def sky(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        height = np.clip(-rays[..., 1:2], 0, 1)
        return np.array([0.75, 0.82, 0.9]) * (1 - height) + np.array([0.25, 0.45, 0.85]) * height

    return views_of(cloud, cameras, sky)


def own_camera(place: np.ndarray, target: np.ndarray, index: int) -> ms.Camera:
    width, height = OWN_SIZE
    return ms.look_at(
        place, target, width=width, height=height, fov=60, name=f"{index:02d}.png", up=(0, -1, 0)
    )


def views_of(
    cloud: ms.GaussianCloud, cameras: list[ms.Camera], behind: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> list[ms.View]:
    """Images of ``cloud`` in front of what ``behind`` shows along rays (h, w, 3) from an origin (3,)."""
    found = []
    for camera in cameras:
        front = ms.render_splats(cloud, camera, background=(0, 0, 0), samples=2)
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
        rays = local @ camera.world_to_camera[:3, :3]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        image = front.color + (1 - front.alpha[..., None]) * behind(camera.center, rays)
        found.append(ms.View(camera, ViewImage(np.clip(image, 0, 1).astype(np.float32), None)))
    return found


def waves(points: np.ndarray) -> np.ndarray:
    """(..., 3) RGB of a pattern at ``points`` (..., 3)."""
    rng = np.random.default_rng(1)
    return np.clip(0.55 + np.sin(points @ rng.normal(0, 4, (3, 24))) @ rng.normal(0, 0.05, (24, 3)), 0, 1)


def lit(view: ms.View, gain: float) -> ms.View:
    """``view`` in other light."""
    image = view.load()
    return replace(view, source=replace(image, color=image.color * np.float32(gain)))


def spoiled(views: list[ms.View]) -> list[ms.View]:
    """``views``, of which three are blurred, one has the image of another, and three are missing."""
    result = list(views)
    for i in (4, 15, 26):
        color = result[i].load().color
        for axis in (0, 1):
            color = np.mean([np.roll(color, shift, axis) for shift in range(-3, 4)], axis=0)
        result[i] = replace(result[i], source=ViewImage(color.astype(np.float32), None))
    result[20] = replace(result[20], source=views[9].source)
    return [view for i, view in enumerate(result) if i not in (7, 18, 33)]


if __name__ == "__main__":
    main()
