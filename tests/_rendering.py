"""Scenes and comparisons for the tests of the compiled renderer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshsplats import Camera, GaussianCloud, SplatMesh
from meshsplats.rendering import api, reference, reference_splats

TOLERANCE = 2e-5
"""Largest difference between the core (float32 in a pixel) and the reference (float64), of values near 1."""

FLIPS = 1e-3
"""Share of the pixels that may differ by more: where a sample lies within rounding of an edge, two triangles
within rounding of one depth, or a splat within rounding of its cut at 1/255."""

EXTRAS = {"depth": True, "normals": True, "attributes": ("heat", "flow")}


def camera(width: int = 37, height: int = 29, *, near: float = 0.5, **changes) -> Camera:
    """Off-centre, with unequal focal lengths, and no side a multiple of a tile."""
    view = Camera(np.eye(4), 31.0, 27.0, 0.47 * width, 0.55 * height, width, height, near)
    return replace(view, **changes)


def turned(view: Camera, seed: int) -> Camera:
    """The camera turned and moved about."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, rng.normal(size=3)
    return replace(view, world_to_camera=matrix)


def seen_by(view: Camera, points: np.ndarray) -> np.ndarray:
    """World points of points in the camera's frame."""
    return (points - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]


def soup(seed: int, faces: int = 60, *, spread=(1.2, 1.2, 1.5), z: float = 2.5, view: Camera | None = None):
    """Triangles that share vertices at random: many sizes, some across or behind the near plane."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(faces, 3)) * spread + [0, 0, z]
    return SplatMesh(
        points if view is None else seen_by(view, points),
        [rng.permutation(faces)[:3] for _ in range(faces)],
        rng.random((faces, 4)),
        attributes={"heat": rng.normal(size=faces), "flow": rng.normal(size=(faces, 2))},
    )


def layers(depths, alpha, colors=None) -> SplatMesh:
    """Triangles of their own vertices that face ``camera`` and cover its image, one at each depth."""
    depths = np.asarray(depths, float)
    corners = np.array([(-4, -4, 1), (12, -4, 1), (-4, 12, 1)])
    colors = np.random.default_rng(1).random((len(depths), 3)) if colors is None else colors
    rgba = np.column_stack([colors, np.broadcast_to(alpha, len(depths))])
    return SplatMesh(
        (depths[:, None, None] * corners).reshape(-1, 3),
        np.arange(3 * len(depths)).reshape(-1, 3),
        np.repeat(rgba, 3, axis=0),
    )


def fan(seed: int, triangles: int, alpha: float) -> SplatMesh:
    """A closed convex fan that is tilted, of one opacity."""
    rng = np.random.default_rng(seed)
    # Less than half a turn apart, also of three: else the centre is outside.
    angles = np.sort(0.49 * rng.random(triangles)) + np.arange(triangles)
    angles *= 2 * np.pi / triangles
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rim = np.cos(angles)[:, None] * axes[0] + np.sin(angles)[:, None] * 0.8 * axes[1]
    vertices = np.vstack([np.zeros(3), rim]) + np.array([0.1, 0, 2.5])
    faces = [(0, 1 + i, 1 + (i + 1) % triangles) for i in range(triangles)]
    colors = rng.random((triangles + 1, 4))
    colors[:, 3] = alpha
    return SplatMesh(vertices, faces, colors)


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles between the vertices of a grid, two a cell."""
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    return np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)


def splats(
    seed: int, n: int = 30, *, kernel="3dgs", degree=3, sizes=(0.02, 0.6), spread=1.5, z=3.0, opacity=None
) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(n, 4))
    return GaussianCloud(
        rng.normal(size=(n, 3)) * spread + [0, 0, z],
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        np.exp(rng.uniform(*np.log(sizes), (n, 3))),
        rng.random(n) if opacity is None else np.full(n, opacity),
        rng.normal(size=(n, (degree + 1) ** 2, 3)) * 0.3,
        kernel,
    )


def outputs(image: api.Rendering) -> dict[str, np.ndarray]:
    found = {
        "color": image.color,
        "alpha": image.alpha,
        "depth": image.depth,
        "normals": image.normals,
    }
    return {name: value for name, value in (found | dict(image.attributes)).items() if value is not None}


def assert_close(one: api.Rendering, two: api.Rendering, *, tolerance=TOLERANCE, flips=FLIPS) -> None:
    """All outputs within ``tolerance``, times the largest value if above 1, but for some pixels."""
    assert outputs(one).keys() == outputs(two).keys()
    for name, value in outputs(one).items():
        expected = outputs(two)[name]
        assert value.shape == expected.shape
        assert np.isfinite(value).all(), name
        scale = max(1.0, float(np.abs(expected).max(initial=0)))
        wrong = ~(np.abs(value - expected) <= tolerance * scale)
        pixels = wrong.reshape(*value.shape[:2], -1).any(axis=2)
        worst = float(np.abs(value - expected).max())
        assert pixels.sum() <= flips * pixels.size, (
            f"{name}: {pixels.sum()} pixels differ, by up to {worst:.2e}"
        )


def assert_same_bits(one: api.Rendering, two: api.Rendering) -> None:
    assert outputs(one).keys() == outputs(two).keys()
    for name, value in outputs(one).items():
        assert value.tobytes() == outputs(two)[name].tobytes(), name
    assert one.fragments == two.fragments


def assert_mesh_is_exact(
    mesh: SplatMesh, view: Camera, *, tolerance=TOLERANCE, flips=FLIPS, **options
) -> api.Rendering:
    """The core's image, after comparing it with the reference."""
    image = api.render(mesh, view, **options)
    assert image.color.dtype == image.alpha.dtype == np.float32
    options.setdefault("min_transmittance", api.MIN_TRANSMITTANCE)
    truth = reference.render(mesh, view, **options)
    assert_close(image, truth, tolerance=tolerance, flips=flips)
    if not options.get("max_layers"):
        samples = view.width * view.height * options.get("samples", 1) ** 2
        assert abs(image.fragments - truth.fragments) <= max(1, flips * samples)
    return image


def assert_splats_are_exact(
    cloud: GaussianCloud, view: Camera, *, tolerance=TOLERANCE, **options
) -> api.Rendering:
    image = api.render_splats(cloud, view, **options)
    truth = reference_splats.render_splats(cloud, view, **options)
    assert_close(image, truth, tolerance=tolerance)
    samples = view.width * view.height * options.get("samples", 1) ** 2
    assert abs(image.fragments - truth.fragments) <= max(1, FLIPS * samples)
    return image
