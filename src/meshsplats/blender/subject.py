"""Prepares a mesh for Blender: colours in the right space, shading normals, bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats._common.geometry import direction
from meshsplats.blender.background import Background
from meshsplats.blender.layers import PROBE_SIDE, bounce_limit, count_layers, most_layers
from meshsplats.blender.linear import linear_colors
from meshsplats.blender.options import CAREFUL, MAX_LAYERS, Effort, SceneOptions
from meshsplats.blender.stand_in import StandIn, field_around, stand_in
from meshsplats.cameras.framing import Bounds, front_axes, scene_bounds, weighted_quantile
from meshsplats.conversion.normals import shading_normals, surfels_of, typical_spacing
from meshsplats.conversion.recovery import splats_of
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.showing import default_views

VIEWS = 24
"""Views that are looked for within a place, for light on it."""
_FLOOR = 0.002
"""Share of the opacity that may lie below the ground: strays must not lift the subject off it."""

_UPWARD, _TOPS = 0.5, 0.01
"""Cosine to the up direction from which a surface faces up, and the share of such points that may lie below
the ground."""

SELF_SHADOW = 3.0
"""Distance within which layers do not shade each other, in spacings of the splats."""


def count(mesh: SplatMesh, cameras: Sequence[Camera], options: SceneOptions) -> tuple[int, int]:
    """Most layers behind each other, and the limit on transparent bounces that follows."""
    axes = front_axes(mesh.up.astype(np.float64))
    directions = []
    if options.light is not None:
        directions.append(direction(axes, *options.light.sun))
        if options.light.fill > 0:
            directions.append(direction(axes, *options.light.fill_direction))
    layers = most_layers(mesh, cameras, directions, threads=options.threads)
    # Unlit images must be exact, and a high limit costs nothing where there are no layers.
    return layers, MAX_LAYERS if options.light is None else bounce_limit(layers, MAX_LAYERS)


def layer_means(
    mesh: SplatMesh, cameras: Sequence[Camera], threads: int | None = None
) -> tuple[float, float]:
    """Mean and mean square of the number of triangles behind each other in a pixel, over the images."""
    some = [camera.within(PROBE_SIDE) for camera in subsample(cameras, 4)]
    counts = [count_layers(mesh, camera, threads=threads).astype(np.float64) for camera in some]
    if not counts:
        return 0.0, 0.0
    return float(np.mean([c.mean() for c in counts])), float(np.mean([(c**2).mean() for c in counts]))


Announce = Callable[[str], object]
"""Is told the name of each phase, of ``plan.PHASES``, as it begins."""


def prepare(
    mesh: SplatMesh,
    cameras: Sequence[Camera],
    options: SceneOptions,
    layers: int,
    announce: Announce = lambda phase: None,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and facts, the fields of ``inside.scene.Subject``; ``layers`` as from ``count``."""
    mesh = mesh if options.light is None else mesh.plain
    bounds = scene_bounds(mesh)
    up = mesh.up.astype(np.float64)
    facts = {
        "radius": float(bounds.radius),
        "floor": lowest(bounds, up),
        "reach": float(np.linalg.norm(mesh.vertices - bounds.center, axis=1).max()),
        "layers": layers,
        "self_shadow": 0.0,
        "linear": mesh.blending == "linear",
    }
    arrays = {
        "vertices": mesh.vertices,
        "faces": mesh.faces,
        "colors": mesh.colors,
        "up": up,
        "center": bounds.center,
    }
    if mesh.face_splat is not None:
        arrays["face_splat"] = mesh.face_splat
    if (harmonics := vertex_harmonics(mesh)) is not None:
        arrays["harmonics"] = harmonics
    if options.light is not None:
        lit, of_light = lit_subject(
            mesh,
            cameras,
            within=options.within,
            effort=options.effort,
            threads=options.threads,
            announce=announce,
        )
        if "light_points" in lit:
            points, normals = lit["light_points"] @ up, lit["light_normals"] @ up
            facts["floor"] = ground_height(facts["floor"], points, normals, of_light["light_spacing"])
        return arrays | lit, facts | of_light
    return arrays, facts


def vertex_harmonics(mesh: SplatMesh) -> np.ndarray | None:
    """(v, k, 3) float32 harmonics of the splat that each vertex belongs to; None where ``mesh`` has none."""
    if mesh.harmonics is None:
        return None
    owner = mesh.splats.of_vertex
    return np.where((owner >= 0)[:, None, None], mesh.harmonics[owner], np.float32(0))


def lowest(bounds: Bounds, up: np.ndarray) -> float:
    """Height along the unit ``up`` (3,) of the lowest part of a subject, without strays; scene units."""
    heights = bounds.points @ up
    weights = bounds.weights if bounds.weights.sum() > 0 else np.ones(len(heights))
    return weighted_quantile(heights, weights, _FLOOR)


def ground_height(floor: float, heights: np.ndarray, upward: np.ndarray, size: float) -> float:
    """Height of a ground for a lit subject: ``floor``, its lowest part, or less where the subject is a scene
    with a ground of its own, such as a street, which a plane at its height would cover.

    Args:
        floor: height of the lowest part of the subject.
        heights: (n,) of the points at which light on it is gathered.
        upward: (n,) cosines between the normals there and the up direction.
        size: distance of neighbouring points.
    """
    tops = heights[upward > _UPWARD]
    return min(floor, float(np.quantile(tops, _TOPS)) - size) if len(tops) else floor


def lit_subject(
    mesh: SplatMesh,
    cameras: Sequence[Camera] = (),
    *,
    within: Sequence[Camera] | None = None,
    effort: Effort = CAREFUL,
    threads: int | None = None,
    announce: Announce = lambda phase: None,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Arrays and facts that a lit mesh has besides or instead of those of an unlit one, by the names of
    ``inside.scene.Subject``. A mesh prior, whose shape changes, has no stand-in. They are made of images from
    around the mesh and from ``cameras``; of a place, also from views ``within`` it, which are looked for
    where they are None; an object has none."""
    mesh = mesh.plain
    announce("colours")
    cameras = [*cameras, *(views_within(mesh, threads=threads) if within is None else within)]
    # Each of the two leaves processors idle.
    shape = Background(partial(shape_for_light, mesh, cameras, effort, threads))
    colors = linear_colors(mesh, cameras, steps=effort.steps, views=effort.fit_views, threads=threads)
    if mesh.binding is None:
        announce("surface")
    arrays, facts, surface = shape.result()
    arrays |= {"colors": colors, "display": mesh.colors}
    if surface is not None:
        arrays["surface_colors"] = surface.colors(colors)
    return arrays, facts


def views_within(
    scene: GaussianCloud | SplatMesh,
    source: Path | None = None,
    *,
    up: np.ndarray | None = None,
    threads: int | None = None,
) -> list[Camera]:
    """Views of a place from within, those of its folder ``source`` or found in its splats; none of an object,
    or without splats. From around it, one sees walls from behind, and the noise that no photograph saw.
    ``up``: (3,) direction, where the user names it."""
    cloud = splats_of(scene)
    views = cloud and default_views(cloud, source, VIEWS, side=(400, 400), up=up, threads=threads)
    return views[0] if views else []


def shape_for_light(
    mesh: SplatMesh, cameras: Sequence[Camera] = (), effort: Effort = CAREFUL, threads: int | None = None
) -> tuple[dict[str, np.ndarray], dict[str, float], StandIn | None]:
    """What of ``lit_subject`` does not depend on colours, and the stand-in, where there is one.

    ``normals`` (v, 3), and ``faces`` (f, 3) wound to face outwards; ``self_shadow``: the distance, scene
    units, within which layers must not shade each other; of a stand-in also its arrays, and
    ``light_spacing``: the distance of its points.
    """
    surfels, field, side = surfels_of(mesh), None, effort.resolution
    if mesh.binding is None:
        field = field_around(mesh, cameras, resolution=side, views=effort.views, threads=threads)
    depth_images = None if field is None else field.depth_images
    normals = shading_normals(
        mesh, cameras, views=effort.views, surfels=surfels, depth_images=depth_images, threads=threads
    )
    arrays = {"normals": normals, "faces": _facing_out(mesh, normals)}
    facts = {"self_shadow": SELF_SHADOW * typical_spacing(mesh, surfels.centers)}
    surface = None if field is None else stand_in(mesh, normals, field, threads)
    if surface is not None:
        facts["light_spacing"] = surface.size
        arrays |= {
            "surface_vertices": surface.vertices,
            "surface_faces": surface.faces,
            "fine_faces": surface.fine,
            "light_points": surface.points,
            "light_normals": surface.normals,
            "light_point_of": surface.point_of,
        }
    return arrays, facts, surface


def _facing_out(mesh: SplatMesh, normals: np.ndarray) -> np.ndarray:
    """(f, 3) the faces of ``mesh``, wound so that their fronts agree with the shading normals."""
    a, b, c = mesh.faces.T
    own = np.cross(mesh.vertices[b] - mesh.vertices[a], mesh.vertices[c] - mesh.vertices[a])
    back = np.einsum("ij,ij->i", own, normals[a] + normals[b] + normals[c]) < 0
    return np.where(back[:, None], mesh.faces[:, [0, 2, 1]], mesh.faces)
