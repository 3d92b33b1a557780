"""make_surface: an ordinary textured mesh of the surface that splats form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from meshsplats._common.kinds import need, need_all
from meshsplats._common.options import check_names
from meshsplats._core.surfaces import Grid
from meshsplats.cameras.framing import guess_up
from meshsplats.conversion import convert
from meshsplats.conversion.merging import simplify_in_blocks
from meshsplats.datasets.views import Dataset, View
from meshsplats.formats.surfaces.solids import warn_of_gaps
from meshsplats.rendering import render
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.binding import Binding
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.surfaces.atlas import cells, cells_side, unwrap
from meshsplats.surfaces.color_projection import colors_from_views
from meshsplats.surfaces.fitting import fit, mean_colors
from meshsplats.surfaces.floor import missing_ground
from meshsplats.surfaces.fusion import (
    collapsed,
    grid_around,
    grid_of,
    isosurface,
    signed_distances,
)
from meshsplats.surfaces.holes import close_holes
from meshsplats.surfaces.images import Surface
from meshsplats.surfaces.manifold import apart, simplified
from meshsplats.surfaces.normal_maps import Relief, normal_map, relief_of
from meshsplats.surfaces.options import (
    CLOSED,
    LEVEL_FACTOR,
    USUAL_RESOLUTION,
    SizedOptions,
    SurfaceOptions,
    level_options,
)
from meshsplats.surfaces.views import Sources, reduced, smaller, sources_of

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from meshsplats.surfaces.options import SurfaceChanges

ProgressOf = Callable[[str, int, int], object]
"""Called with the name of a phase, how much of it is done, and how much there is; once, with 0 and 1, where a
phase is not counted."""

MOST_SPLATS = 1_000_000
"""Splats of which depth images are drawn; more are merged. Their mesh takes about a gigabyte."""
_COARSE = 2
"""The first rounds compare images, and have textures, whose sides are smaller by this factor."""
_FEWER = 0.75
"""Share of the triangles that are left where an atlas of all of them fails."""
_MAP = 4
"""Sides of normal maps are smaller than those of textures by this factor: voxels are coarser than texels."""
_LATER = 0.3
"""Steps of the vertices in the last round, relative to those before."""
_FLOOR = 4
"""New ground has at most as many triangles as the surface divided by this."""
_MARGIN = 2.0
"""Ground counts this far around the cameras, in radii of the ball in which the grid is even: a background
beyond is nothing to walk on."""
_BOX_SIDE = 128
"""Sides of the depth images by which the box of a place is found."""


def make_surface(
    scene: GaussianCloud | SplatMesh,
    data: Dataset | None = None,
    options: SurfaceOptions | None = None,
    *,
    cameras: Sequence[Camera] | None = None,
    threads: int | None = None,
    progress: ProgressOf | None = None,
    **changes: Unpack[SurfaceChanges],
) -> BaseMesh:
    """A light, connected, textured mesh of the surface that splats form.

    The scene is rendered with depth from many sides. The depth images are fused into a truncated signed
    distance function on a grid (Curless and Levoy 1996), whose zero level set marching cubes extract and
    quadric edge collapses simplify (Garland and Heckbert 1997). An atlas of charts gives it a texture. Shape
    and texture are then fitted to images: vertices follow the gradients of visible edges and of the texture,
    in coordinates in which smooth motions are short; texels take the colours of the pixels that show them.
    Needs the extra ``base``.

    Args:
        scene: splats, or a mesh of splats, for instance a fine-tuned one.
        data: photographs to fit to, in place of images of the scene; their training views.
        options: what to make; ``changes`` replace single fields.
        cameras: cameras of the images, in place of those that are placed around an object or found in a
            place.
        threads: at most this many; all processors by default.
        progress: called as the work goes on.

    Returns:
        The mesh in scene units and relative to the scene's origin, with a texture or, with ``texture=0``,
        with vertex colours. Up is as ``convert`` has it for the same scene. A closed one is a solid that
        faces outwards: with vertices at one place joined, each edge has two triangles.

    Raises:
        ValueError: an option out of its range, a scene without extent, images that show nothing solid, or a
            texture that is too small.
        MissingDependencyError: the libraries of the extra ``base`` are missing.
    """
    if not isinstance(scene, SplatMesh):
        need(GaussianCloud, scene=scene)
    need(Dataset, data=data, optional=True)
    need_all(Camera, cameras=cameras, optional=True)
    need(SurfaceOptions, options=options, optional=True)
    check_names("make_surface", changes, [f.name for f in fields(SurfaceOptions)])
    chosen = replace(options or SurfaceOptions(), **changes).checked()
    if data is not None:
        data = data.relative_to(scene.origin)
    sources = sources_of(scene, data, cameras, chosen, threads)
    return surfaces_from(scene, sources, chosen, threads=threads, progress=progress)[0]


def surfaces_from(
    scene: GaussianCloud | SplatMesh,
    sources: Sources,
    chosen: SurfaceOptions,
    count: int = 1,
    *,
    threads: int | None = None,
    progress: ProgressOf | None = None,
) -> list[BaseMesh]:
    """``count`` surfaces from these cameras and images: that of ``make_surface``, and of each the next, with
    a quarter of its triangles, and half the sides of its texture and of its images.

    Raises ValueError as ``make_surface``, and for more levels than triangles, texels or pixels allow.
    """
    levels = level_options(chosen.sized(sources.closed), count)
    said = progress or (lambda *_: None)
    vertices, faces, relief, grid = _fused(scene, sources, levels[0], threads, said)
    result = []
    for number, level in enumerate(levels):
        if number:
            fewer = max(4, len(faces) // LEVEL_FACTOR**2)
            vertices, faces = simplified(grid.contracted(vertices), faces, fewer, closed=sources.closed)
            vertices = grid.in_scene(vertices)
        views = tuple(reduced(view, level.size) for view in sources.views)
        seen = replace(sources, views=views)
        least = 0 if chosen.faces is None else len(faces)
        said("texture coordinates", 0, 1)
        blank = _blank(vertices, faces, grid, level.texture, least=least, closed=sources.closed)
        base, fitted = _surface_of(scene, blank, seen, level, threads, said)
        vertices, faces, uv = blank.vertices, blank.faces, blank.uv
        if level.texture and relief is not None:
            side = -(-level.texture // _MAP)
            base = replace(base, normal_map=normal_map(vertices, faces, uv, side, relief))
        vertices = fitted
        result.append(base)
    return result


def _blank(
    vertices: np.ndarray,
    faces: np.ndarray,
    grid: Grid,
    side: int,
    *,
    least: int = 0,
    closed: bool = False,
) -> Surface:
    """The surface of these triangles with a texture without colours. Its charts are as large as on the
    ``grid``: what is far from all cameras of a place needs few texels. Where they do not fit, or the library
    fails, it has fewer triangles, but not fewer than ``least``."""
    count = len(faces)
    while True:
        try:
            uv, texels = _blank_texture(grid.contracted(vertices), faces, side)
            return Surface(vertices, faces, uv, texels)
        except ValueError:
            count = int(_FEWER * count)
            if count < max(least, CLOSED[0]):
                raise
            points, faces = simplified(grid.contracted(vertices), faces, count, closed=closed)
            vertices = grid.in_scene(points)


def _surface_of(
    scene: GaussianCloud | SplatMesh,
    blank: Surface,
    sources: Sources,
    chosen: SizedOptions,
    threads: int | None,
    progress: ProgressOf,
) -> tuple[BaseMesh, np.ndarray]:
    """The surface with its colours, and where fitting put the vertices of ``blank``."""
    surface, faces = blank, blank.faces
    if chosen.texture or chosen.rounds:
        surface = _fitted(surface, sources, chosen, threads, progress)
    fitted = surface.vertices
    if sources.closed:
        surface = surface._replace(vertices=apart(fitted, faces))
        warn_of_gaps(surface.vertices, faces)
    base = BaseMesh(surface.vertices.astype(np.float32), faces, up=guess_up(scene), origin=scene.origin)
    if not chosen.texture:
        return replace(base, colors=_vertex_colors(base, sources.views, threads)), fitted
    pixels = np.full((*surface.texels.shape[:2], 4), 255, np.uint8)
    pixels[..., :3] = np.rint(255 * surface.texels)
    textured = replace(
        base,
        uv=surface.uv,
        face_texture=np.zeros(len(faces), np.int32),
        textures=(Texture(pixels, ("clamp", "clamp")),),
    )
    return textured, fitted


def _blank_texture(vertices: np.ndarray, faces: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates, and texels without colours; for a ``side`` of 0 those of triangles one by one."""
    if side:
        return unwrap(vertices, faces, side), np.zeros((side, side, 3), np.float32)
    side = cells_side(len(faces))
    return cells(len(faces), side), np.zeros((side, side, 3), np.float32)


def _fused(
    scene: GaussianCloud | SplatMesh,
    sources: Sources,
    options: SizedOptions,
    threads: int | None,
    progress: ProgressOf,
) -> tuple[np.ndarray, np.ndarray, Relief | None, Grid]:
    """The surface in the depth images: vertices (v, 3) float64, triangles (f, 3) int32; with all of its
    triangles, where a normal map wants them; and the grid that it is from."""
    mesh = scene
    progress("converting", 0, 1)
    if isinstance(mesh, GaussianCloud):
        # Voxels are far larger than the splats of so many.
        mesh = simplify_in_blocks(mesh, MOST_SPLATS, cameras=sources.depth, threads=threads)
        # As wide as viewers draw splats: gaps between them would be holes in the surface.
        mesh = convert(mesh, cameras=sources.depth, look="splats", colors="base", threads=threads)
    grid = (
        grid_around(scene, options.resolution or USUAL_RESOLUTION)
        if sources.closed
        else _grid_seen(mesh, sources.depth, options.resolution, threads)
    )
    done = _Counter(progress, "shape", len(sources.depth))
    field = signed_distances(
        mesh,
        sources.depth,
        grid,
        unseen=-1.0 if sources.closed else None,
        median=not sources.closed,
        threads=threads,
        each=lambda *_: done(),
    )
    progress("triangles", 0, 1)
    vertices, faces = isosurface(field, closed=sources.closed)
    if not len(faces):
        raise ValueError(
            "the images show nothing solid: a surface is made of objects and places, not of haze"
        )
    relief = None
    if 0 < options.faces < len(faces) and options.normal_map and options.texture:
        relief = relief_of(grid.in_scene(grid.low + grid.voxel * vertices), faces)
    vertices, faces = simplified(vertices, faces, options.faces, closed=sources.closed)
    if not sources.closed:
        vertices, faces = close_holes(vertices, faces)
    vertices = grid.in_scene(grid.low + grid.voxel * vertices)
    if options.shape == "floor":
        vertices, faces = _floored(scene, vertices, faces, sources, grid)
    return vertices, faces, relief, grid


def _floored(
    scene: GaussianCloud | SplatMesh,
    vertices: np.ndarray,
    faces: np.ndarray,
    sources: Sources,
    grid: Grid,
) -> tuple[np.ndarray, np.ndarray]:
    """The surface with the ground that it lacks."""
    found, cameras = sources.found, sources.depth
    up = guess_up(scene, cameras) if found is None else found.up
    margin = _MARGIN * grid.radius or np.inf
    points, ground = missing_ground(vertices, faces, cameras, up.astype(np.float64), grid.voxel, margin)
    if len(ground) > len(faces) // _FLOOR:
        points, ground = collapsed(points, ground, max(2, len(faces) // _FLOOR))
    return np.concatenate([vertices, points]), np.concatenate([faces, ground + np.int32(len(vertices))])


def _grid_seen(
    mesh: SplatMesh, cameras: Sequence[Camera], resolution: int | None, threads: int | None
) -> Grid:
    """The grid around what the cameras see."""
    points, depths = [], []
    for camera in cameras:
        small = camera.scaled(_BOX_SIDE / max(camera.width, camera.height)).with_near_plane(mesh.vertices)
        depth = render(mesh, small, median_depth=True, threads=threads).median_depth
        assert depth is not None
        rows, columns = np.nonzero(np.isfinite(depth))
        away = depth[rows, columns].astype(np.float64)
        x = (columns + 0.5 - small.cx) / small.fx * away
        y = (rows + 0.5 - small.cy) / small.fy * away
        depths.append(away)
        matrix = small.world_to_camera
        points.append((np.stack([x, y, away], axis=1) - matrix[:3, 3]) @ matrix[:3, :3])
    every = np.concatenate(points)
    if not len(every):
        raise ValueError(
            "the images show nothing solid: a surface is made of objects and places, not of haze"
        )
    return grid_of(every, cameras, resolution, float(np.median(np.concatenate(depths))))


def _fitted(
    surface: Surface, sources: Sources, options: SurfaceOptions, threads: int | None, progress: ProgressOf
) -> Surface:
    """``surface`` with a texture, and fitted to the images."""
    side = len(surface.texels)
    views = [replace(v, camera=v.camera.with_near_plane(surface.vertices)) for v in sources.views]
    if not options.rounds:
        return mean_colors(
            surface, views, threads=threads, progress=_Counter(progress, "texture", len(views))
        )
    small: list[View] = []
    reading = _Counter(progress, "images", len(views))
    for view in views:
        small.append(smaller(view, _COARSE))
        reading()
    coarse = -(-side // _COARSE)
    surface = surface._replace(texels=np.zeros((coarse, coarse, 3), np.float32))
    surface = mean_colors(surface, small, threads=threads, progress=_Counter(progress, "colors", len(views)))
    fitting = partial(fit, stiffness=options.stiffness, threads=threads)
    done = _Counter(progress, "fit", options.rounds * len(views))
    surface = fitting(surface, small, rounds=options.rounds, move=options.move, progress=done)
    texels = surface.texels.repeat(_COARSE, axis=0).repeat(_COARSE, axis=1)[:side, :side]
    done = _Counter(progress, "texture", len(views))
    return fitting(
        surface._replace(texels=texels), views, rounds=1, move=_LATER * options.move, progress=done
    )


def _vertex_colors(base: BaseMesh, views: Sequence[View], threads: int | None) -> np.ndarray:
    """(v, 4) float32 display RGBA of the vertices, projected from the images."""
    points, faces = base.vertices, base.faces
    # Every vertex is bound to itself, in one of its faces.
    face = np.zeros(len(points), np.int32)
    face[faces.ravel()] = np.repeat(np.arange(len(faces), dtype=np.int32), 3)
    corner = (faces[face] == np.arange(len(points))[:, None]).argmax(axis=1)
    weights = np.eye(3, dtype=np.float32)[corner]
    binding = Binding(points, faces, face, weights, np.zeros(len(points), np.int32))
    colors = np.ones((len(points), 4), np.float32)
    colors[:, :3] = colors_from_views(binding, views, threads=threads)
    return colors


class _Counter:
    """Counts the steps of a phase for ``progress``."""

    def __init__(self, progress: ProgressOf, name: str, total: int) -> None:
        self._progress, self._name, self._total, self._done = progress, name, total, 0

    def __call__(self) -> None:
        self._done += 1
        self._progress(self._name, self._done, self._total)
