"""How many photographs show each part of a scene, as a picture: where more of them are needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshsplats._common.geometry import level_axes
from meshsplats.cameras.trajectories import look_at
from meshsplats.datasets.views import View
from meshsplats.images.writing import strip
from meshsplats.rendering import render
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training.growth import SHELL, corners_of
from meshsplats.training.initial import ranges_of_cameras
from meshsplats.training.references import references

COUNTED = 64
"""Views, at most, that are counted: ``references`` of the fans."""
COUNT_SIDE = 160
"""Longer side of their images, in pixels."""
HIDDEN = 0.05
"""Relative difference of depth from which a place lies behind what a view shows."""
SIDES = 4
"""Images around the subject, or around the middle of the cameras."""
SIDE = 240
"""Pixels along the sides of such an image; the plan has twice as many."""
PLAN_FOV = 6.0
"""Angle of view of the plan in degrees: nearly parallel."""
LOOKS_IN, MOSTLY = 0.8, 0.8
"""Cosine of the angle to the subject up to which a camera looks at it, and share of the cameras that must."""
MOST_AROUND, PLAN_MARGIN = 0.9, 1.15
"""Share of the fans that the plan is wide enough for, and the factor by which it is wider."""
NONE, FAR, ONE, TWO, MORE = (
    *((0.08, 0.08, 0.08), (0.35, 0.55, 0.85)),
    *((0.85, 0.15, 0.1), (0.95, 0.75, 0.15), (0.25, 0.65, 0.25)),
)
"""Colours: no photograph; photographs, but no depth; one, two or more photographs."""
CAMERA = (0.1, 0.1, 0.9)
DOT, LINE = 2, 16
"""Radius of a camera in the plan, and length of the line that it looks along, in pixels."""


def coverage_picture(mesh: SplatMesh, views: Sequence[View], threads: int | None = None) -> np.ndarray:
    """(h, w, 3) float32: the scene from all sides and from above, in its colours, and by how many photographs
    show each place.

    Args:
        mesh: the fans that a training starts from.
        views: the training views.
    """
    known = _counted(mesh, views, threads)
    around = _around(views, mesh.up.astype(np.float64))
    rows = []
    for scene, captions in (
        (mesh, [f"from side {i + 1}" for i in range(SIDES)]),
        (known, ["green: 3 or more photographs", "yellow: 2, red: 1", "blue: far, no depth", "black: none"]),
    ):
        images = [render(scene, camera, background=NONE, threads=threads).color for camera in around]
        rows.append(strip(images, captions))
    plan = _plan(mesh, views)
    images = []
    for scene in (mesh, known):
        images.append(render(_below(scene, views), plan, background=NONE, threads=threads).color.copy())
    _mark(images[1], plan, views)
    rows.append(strip(images, ["from above, without what is higher than the cameras", "blue: the cameras"]))
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=1) for row in rows]
    return np.clip(np.concatenate(rows), 0, 1)


def counts_of_fans(mesh: SplatMesh, views: Sequence[View], threads: int | None = None) -> np.ndarray:
    """(n,) int64: how many of up to ``COUNTED`` of ``views`` show the centre of each fan."""
    centers = mesh.vertices[:: corners_of(mesh)]
    counts = np.zeros(len(centers), np.int64)
    cameras = [view.camera.within(COUNT_SIDE) for view in views]
    for camera in (cameras[i] for i in references(cameras, centers, COUNTED)):
        depths = render(mesh, camera, depth=True, threads=threads).mean_depth(min_alpha=0.5)
        shown, x, y, depth = camera.pixels_of(centers)
        counts[shown] += depth <= (1 + HIDDEN) * depths[y, x]
    return counts


def _counted(mesh: SplatMesh, views: Sequence[View], threads: int | None) -> SplatMesh:
    """``mesh`` in the colours of its counts."""
    counts = counts_of_fans(mesh, views, threads)
    table = np.array([NONE, ONE, TWO, MORE], np.float32)
    fans = table[np.minimum(counts, 3)]
    fans[_in_shell(mesh) & (counts > 0)] = FAR
    colors = mesh.colors.copy()
    colors[:, :3] = np.repeat(fans, corners_of(mesh), axis=0)
    return replace(mesh, colors=colors, harmonics=None)


def _around(views: Sequence[View], up: np.ndarray) -> list[Camera]:
    """Cameras on four sides: outside of what ``views`` look at from around, else amid them."""
    centers = np.array([view.camera.center for view in views])
    axes = np.array([view.camera.world_to_camera[2, :3] for view in views])
    subject = np.median(ranges_of_cameras(views)[2], axis=0)
    inward = subject - centers
    distance = np.linalg.norm(inward, axis=1)
    looks_in = np.einsum("ni,ni->n", inward, axes) > LOOKS_IN * distance
    first, second = level_axes(up)
    turns = 2 * np.pi * np.arange(SIDES) / SIDES
    ways = np.cos(turns)[:, None] * first + np.sin(turns)[:, None] * second
    if np.mean(looks_in) < MOSTLY:
        middle = np.median(centers, axis=0)
        return [look_at(middle, middle + way, up=up, width=SIDE, height=SIDE, fov=90) for way in ways]
    height = float(np.median(-inward @ up))
    reach = float(np.sqrt(np.median(np.square(distance) - np.square(inward @ up))))
    places = subject + max(reach, 1e-3 * float(distance.max())) * ways + height * up
    return [look_at(place, subject, up=up, width=SIDE, height=SIDE, fov=60) for place in places]


def _in_shell(mesh: SplatMesh) -> np.ndarray:
    """(n,) bool: the fans of the shell."""
    corners = corners_of(mesh)
    if SHELL not in mesh.attributes:
        return np.zeros(len(mesh.vertices) // corners, bool)
    return np.asarray(mesh.attributes[SHELL][::corners] > 0)


def _below(mesh: SplatMesh, views: Sequence[View]) -> SplatMesh:
    """``mesh`` without its shell, and without what is higher than all cameras of ``views``: ceilings."""
    up = mesh.up.astype(np.float64)
    low = mesh.vertices[:: corners_of(mesh)] @ up <= max(view.camera.center @ up for view in views)
    low &= ~_in_shell(mesh)
    return mesh.take(low[mesh.face_splat]) if low.any() else mesh


def _plan(mesh: SplatMesh, views: Sequence[View]) -> Camera:
    """A camera far above ``mesh`` and the cameras of ``views``."""
    centers = mesh.vertices[:: corners_of(mesh)].astype(np.float64)
    shell = _in_shell(mesh)
    centers = centers if shell.all() else centers[~shell]
    cameras = np.array([view.camera.center for view in views])
    up = mesh.up.astype(np.float64)
    axes = np.stack(level_axes(up))
    left_out = (1 - MOST_AROUND) / 2
    ends = np.quantile(centers @ axes.T, (left_out, 1 - left_out), axis=0)
    level = cameras @ axes.T
    low, high = np.minimum(ends[0], level.min(axis=0)), np.maximum(ends[1], level.max(axis=0))
    extent = PLAN_MARGIN * float((high - low).max()) / 2
    far = extent / np.tan(np.radians(PLAN_FOV / 2))
    height = float(np.median(cameras @ up))
    middle = (low + high) / 2 @ axes + height * up
    return look_at(middle + far * up, middle, up=axes[0], width=2 * SIDE, height=2 * SIDE, fov=PLAN_FOV)


def _mark(image: np.ndarray, plan: Camera, views: Sequence[View]) -> None:
    """Draws the cameras of ``views`` into the image of ``plan``: dots, and lines that they look along."""
    up = -plan.world_to_camera[2, :3]
    depth = np.median([(plan.center - view.camera.center) @ up for view in views])
    length = LINE * depth / plan.fx
    for view in views:
        ahead = view.camera.world_to_camera[2, :3]
        line = view.camera.center + length * np.linspace(0, 1, LINE)[:, None] * ahead
        for i, place in enumerate(plan.project(line)[0].astype(int)):
            radius = 0 if i else DOT
            low, high = np.maximum(place - radius, 0), np.maximum(place + radius + 1, 0)
            image[low[1] : high[1], low[0] : high[0]] = CAMERA
