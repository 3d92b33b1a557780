"""The views that commands show of a scene where no option names any: given ones first, then found ones."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshsplats._common.json_files import read_json
from meshsplats.cameras.framing import guess_up, unit_up
from meshsplats.cameras.viewer_settings import NAME, start_camera
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.gltf.cameras import cameras_in_gltf, cameras_in_mesh
from meshsplats.formats.splat_formats import splat_suffixes
from meshsplats.formats.splat_paths import files_named
from meshsplats.formats.usd.cameras import cameras_in_usd
from meshsplats.scene.base_mesh import BaseMesh
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.beside import cameras_beside, that_see
from meshsplats.viewpoints.finding import find_cameras, worth_a_look
from meshsplats.viewpoints.kind import kind_from_outside, surely_object
from meshsplats.viewpoints.mesh_splats import splats_to_look_at
from meshsplats.viewpoints.relief import find_relief
from meshsplats.viewpoints.walking import keys_of, walk

_ROUND = 4
"""Fewest cameras of a mesh's file that a round leads through."""


def opening_beside(source: Path | None, origin: Sequence[float] | np.ndarray = (0, 0, 0)) -> Camera | None:
    """The view with which the splats ``source`` are to open, relative to ``origin``; None if none is given,
    or if there is no file or folder of them.

    It is the first camera inside a glTF file, or the start camera of SuperSplat's viewer: that of a
    ``settings.json`` in the folder, which has no other splats, unless nobody chose it. A DataWarning says
    where it cannot be read.
    """
    if source is None:
        return None
    folder = source if source.is_dir() else source.absolute().parent
    path = folder / NAME
    try:
        if source.is_file() and source.suffix.lower() in (".glb", ".gltf"):
            camera = next(iter(cameras_in_gltf(source)), None)
        elif path.is_file() and (folder == source or len(files_named(folder, splat_suffixes())) <= 1):
            camera = start_camera(read_json(path), path, chosen=True)
        else:
            return None
    except FileFormatError as error:
        warnings.warn(f"{error}; the start camera is not used", DataWarning, stacklevel=2)
        return None
    return None if camera is None else camera.relative_to(np.asarray(origin, np.float64))


def opened_with(
    cameras: Sequence[Camera], source: Path | None, origin: np.ndarray, side: tuple[int, int]
) -> list[Camera]:
    """As many cameras, beginning with ``opening_beside`` where there is one, in images of ``side`` pixels."""
    opening = opening_beside(source, origin)
    first = [] if opening is None else [_in_shape(opening, side)]
    return [*first, *cameras][: len(cameras)]


def default_views(
    scene: GaussianCloud | SplatMesh | BaseMesh,
    source: Path | None,
    count: int,
    *,
    side: tuple[int, int] = (800, 800),
    up: np.ndarray | None = None,
    film: bool = False,
    given: Sequence[Camera] | None = None,
    threads: int | None = None,
) -> tuple[list[Camera], str] | None:
    """Up to ``count`` views of a scene that is no object, and a line that says where they come from. None for
    objects, which are seen from all around, and for meshes that do not know their splats and have no cameras.

    The cameras inside a glTF or USD file of a mesh come first, then those of ``cameras_beside``, then those
    that ``find_cameras`` finds in the splats, or in those that a mesh was made of. A start camera
    (``opening_beside``) is the first of these, and of an object, too, where one view of splats is asked for.

    Args:
        source: the file or folder of the scene; None: it has none that could give cameras.
        side: width and height of the images, pixels.
        up: (3,) direction, where the user names it.
        film: the views are on a smooth round.
        given: cameras relative to the scene's origin, in place of those of ``cameras_beside``.
        threads: at most this many; all processors by default.
    """
    cloud: GaussianCloud | None
    if isinstance(scene, GaussianCloud):
        cloud = scene
        if not len(cloud):
            return None
        if count == 1 and not film and (opening := opening_beside(source, cloud.origin)) is not None:
            return [_in_shape(opening, side)], "seen as the start camera beside or inside the file does"
    else:
        if (inside := _of_mesh(scene, source, count, side, film)) is not None:
            return inside
        cloud = splats_to_look_at(scene) if isinstance(scene, SplatMesh) else None
        if cloud is not None and surely_object(cloud, scene.up if up is None else up, threads):
            return None  # at a glance, as most meshes are
        source = source if source is not None and source.is_file() else None
    if given is None and source is not None:
        given = cameras_beside(source, scene.origin)
    given = that_see(given, scene)
    if cloud is None:
        toward = guess_up(None, given) if up is None else unit_up(up)
        return _of_given(scene, given, count, side, toward, film) if given else None
    if not worth_a_look(cloud):
        return None
    if given:
        toward = guess_up(cloud, given) if up is None else unit_up(up)
        around = kind_from_outside(cloud, toward, threads)[0] == "object"
        if around and find_relief(cloud, toward) is None:
            return None
        return _of_given(scene, given, count, side, toward, film)
    number = keys_of(count) if film else count
    found = find_cameras(cloud, number, up=up, width=side[0], height=side[1], threads=threads)
    if found.kind == "object":
        return None
    if film:
        words = f"seen along a closed camera path through {len(found.cameras)} of the views found"
        return walk(found.cameras, count, found.up), f"{found.in_words()}: {words}"
    start = source if cloud is scene else None
    return opened_with(found.cameras, start, cloud.origin, side), found.seen_in_words()


def _of_given(
    scene: GaussianCloud | SplatMesh | BaseMesh,
    given: Sequence[Camera],
    count: int,
    side: tuple[int, int],
    up: np.ndarray,
    film: bool,
) -> tuple[list[Camera], str]:
    """As ``default_views``, by ``given`` cameras."""
    some = _spread(given, keys_of(count) if film else count)
    points = scene.means if isinstance(scene, GaussianCloud) else scene.vertices
    views = [_in_shape(camera.with_near_plane(points), side) for camera in some]
    words = f"{len(views)} of its {len(given)} cameras"
    if film:
        return walk(views, count, up), f"seen on a round through {words}"
    return views, f"seen from {words}"


def _of_mesh(
    mesh: SplatMesh | BaseMesh, source: Path | None, count: int, side: tuple[int, int], film: bool
) -> tuple[list[Camera], str] | None:
    """As ``default_views``, by the cameras inside the file of a mesh. A DataWarning says where they cannot be
    read."""
    if source is None or not source.is_file():
        return None
    try:
        given = [camera.relative_to(mesh.origin) for camera in _cameras_inside(source)]
    except FileFormatError as error:
        warnings.warn(f"{error}; the cameras of the file are not used", DataWarning, stacklevel=3)
        return None
    if not given or (film and len(given) < _ROUND):
        return None
    some = _spread(given, keys_of(count) if film else count)
    views = [_in_shape(camera.with_near_plane(mesh.vertices), side) for camera in some]
    words = f"{len(views)} of the {len(given)} cameras in its file"
    if film:
        return walk(views, count, mesh.up), f"seen on a round through {words}"
    return views, f"seen from {words}"


def _cameras_inside(mesh: Path) -> list[Camera]:
    """The cameras in the file of a mesh, in its world. Raises FileFormatError."""
    suffix = mesh.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return cameras_in_mesh(mesh)
    return cameras_in_usd(mesh) if suffix in (".usdc", ".usda", ".usd", ".usdz") else []


def _spread(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """Up to ``count`` of the cameras, from all over their list."""
    count = min(count, len(cameras))
    return [cameras[i * len(cameras) // count] for i in range(count)]


def _in_shape(camera: Camera, side: tuple[int, int]) -> Camera:
    """The view in an image of another size, whose shorter side spans the same angle."""
    (width, height), now = side, min(camera.width, camera.height)
    focal = camera.fx * min(side) / now, camera.fy * min(side) / now
    return replace(camera, fx=focal[0], fy=focal[1], cx=width / 2, cy=height / 2, width=width, height=height)
