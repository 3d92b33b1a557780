"""Images that a surface is made from and fitted to, and the cameras of its depth images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from meshsplats._common.arrays import block_means
from meshsplats.cameras.framing import guess_up
from meshsplats.cameras.placing import SURROUNDED_ELEVATIONS, has_surroundings, outside_cameras
from meshsplats.cameras.trajectories import dome
from meshsplats.conversion.recovery import splats_of
from meshsplats.datasets.splat_targets import HELD_OUT, splat_dataset, splat_views
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.rendering import render
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces.fusion import libraries
from meshsplats.surfaces.images import SAMPLES
from meshsplats.surfaces.options import SurfaceOptions
from meshsplats.viewpoints.finding import FoundCameras, find_cameras

_ONE_SIDE = 0.7
"""Length of the mean of the directions of cameras from which they see one side: 0.5 is that of cameras all
over a hemisphere, 0.7 of those within 66 degrees of one direction."""


@dataclass(frozen=True)
class Sources:
    """Where a surface comes from."""

    depth: tuple[Camera, ...]
    """Cameras of the depth images."""
    views: tuple[View, ...]
    """Images to be fitted to."""
    closed: bool
    """Whether the surface is a solid."""
    found: FoundCameras | None
    """What ``find_cameras`` found in the splats, where it was asked and they are known."""


def sources_of(
    scene: GaussianCloud | SplatMesh,
    data: Dataset | None,
    cameras: Sequence[Camera] | None,
    options: SurfaceOptions,
    threads: int | None,
) -> Sources:
    """The cameras and images for a surface of ``scene``: of an object on all sides of it, else where data
    sets of splats have theirs. A mesh is what the splats are that its fans were; of other triangles nothing
    tells an object from a place, and they count as one.

    Raises ValueError for too few cameras, and MissingDependencyError without the extra ``base``, before the
    work.
    """
    libraries()
    side, shape, own = options.size, options.shape, cameras is None and data is None
    given = None if cameras is None else [camera.within(side) for camera in cameras]
    photos = None if data is None else [reduced(view, side) for view in data.train]
    if [] in (given, photos):
        raise ValueError("a surface needs at least one camera")
    found, surrounded = None, False
    splats = splats_of(scene) if shape != "closed" else None
    if splats is not None:
        surrounded = has_surroundings(splats)
        if own or (shape == "auto" and not surrounded):
            count = HELD_OUT + options.views if own else 1
            found = find_cameras(splats, count, width=side, height=side, threads=threads)
    is_object = not surrounded and (found is None or found.kind == "object")
    closed = shape == "closed" or (shape == "auto" and is_object)
    if photos is None:
        seen = given
        if own and found is not None and found.kind != "object":
            seen = list(found.cameras[HELD_OUT:])
        elif own and surrounded and splats is not None and splats is not scene:
            seen = outside_cameras(
                splats, options.views, elevations=SURROUNDED_ELEVATIONS, width=side, height=side
            )
        photos = _drawn(scene, seen, surrounded and not closed, options, threads)
    if given is None:
        around = closed and not (data is not None and from_one_side([view.camera for view in photos]))
        given = _around(scene, options) if around else [view.camera for view in photos]
    return Sources(tuple(given), tuple(photos), closed, found)


def place_of(scene: GaussianCloud | SplatMesh, sources: Sources) -> FoundCameras | None:
    """What ``find_cameras`` finds in a scene that is no object; None for objects and triangles that are no
    splats."""
    if sources.closed:
        return None
    splats = splats_of(scene) if sources.found is None else None
    found = sources.found if splats is None else find_cameras(splats, 1)
    return None if found is None or found.kind == "object" else found


def from_one_side(cameras: Sequence[Camera]) -> bool:
    """Whether cameras look in about one direction: what photographs show from one side only has a back that
    is made up, and depth images of that would cut into the front."""
    mean = np.mean([camera.world_to_camera[2, :3] for camera in cameras], axis=0)
    return float(np.linalg.norm(mean)) > _ONE_SIDE


def _around(scene: GaussianCloud | SplatMesh, options: SurfaceOptions) -> list[Camera]:
    """Cameras on all sides of a scene, below it, too."""
    side = options.size
    return list(dome(scene, options.views, whole=True, up=guess_up(scene), width=side, height=side))


def _drawn(
    scene: GaussianCloud | SplatMesh,
    cameras: list[Camera] | None,
    surrounded: bool,
    options: SurfaceOptions,
    threads: int | None,
) -> list[View]:
    """Images of the scene from ``cameras``, by default from all around."""
    if isinstance(scene, SplatMesh):
        cameras = _around(scene, options) if cameras is None else cameras
        return [_image_of(scene, camera, threads) for camera in cameras]
    look: dict[str, Any] = {"sh_degree": options.sh_degree, "samples": SAMPLES, "threads": threads}
    if cameras is not None:
        return list(splat_views(scene, cameras, **look))
    data = splat_dataset(
        scene,
        placement="surrounded" if surrounded else "object",
        train=options.views,
        test=0,
        width=options.size,
        below=True,
        zooms=(1,),
        **look,
    )
    return list(data.train)


def _image_of(mesh: SplatMesh, camera: Camera, threads: int | None) -> View:
    drawn = render(mesh, camera, background=(0, 0, 0), samples=SAMPLES, threads=threads)
    color = np.clip(drawn.color, 0, 1).astype(np.float16)
    return View(camera, ViewImage(color, drawn.alpha.astype(np.float16)))


def reduced(view: View, side: int) -> View:
    """``view`` with an image at most ``side`` pixels wide and high, by a whole factor."""
    factor = -(-max(view.camera.width, view.camera.height) // side)
    return view if factor == 1 else smaller(view, factor)


def smaller(view: View, factor: int) -> View:
    """``view`` with the mean of each ``factor`` x ``factor`` pixels, without what is left over at the right
    and at the bottom. A pixel counts if all of them do."""
    camera, image = view.camera, view.load()
    height, width = camera.height // factor, camera.width // factor

    def means(values: np.ndarray) -> np.ndarray:
        mean = block_means(values, factor)
        return np.rint(mean).astype(np.uint8) if values.dtype == np.uint8 else mean.astype(values.dtype)

    small = ViewImage(
        means(image.color),
        None if image.alpha is None else means(image.alpha),
        None if image.mask is None else block_means(image.mask, factor) == 1,
    )
    lens = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}
    return replace(view, camera=replace(camera, width=width, height=height, **lens), source=small)
