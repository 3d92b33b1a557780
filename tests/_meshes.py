"""Meshes made up for tests, and how to compare two."""

from __future__ import annotations

import numpy as np

from meshsplats import SplatMesh


def random_mesh(rng, vertices=9, faces=12, *, extras=True, blending="display"):
    more = {}
    if extras:
        normals = rng.normal(size=(vertices, 3))
        more = {
            "face_splat": np.sort(rng.integers(0, 5, faces)),
            "depth_group": rng.integers(-1, 3, faces),
            "plain_colors": rng.random((vertices, 3)),
            "normals": normals / np.linalg.norm(normals, axis=1, keepdims=True),
            "attributes": {
                "flat": rng.normal(size=vertices),
                "one column": rng.normal(size=(vertices, 1)),
                "FLAT": rng.normal(size=(vertices, 3)),
                "größe/%20:0": rng.normal(size=(vertices, 4)),
                "wide": rng.normal(size=(vertices, 7)),
                "none": np.empty((vertices, 0)),
                "": rng.normal(size=(vertices, 2)),
            },
        }
    mesh = SplatMesh(
        rng.normal(size=(vertices, 3)) * 100,
        rng.integers(0, vertices, (faces, 3)),
        rng.random((vertices, 4)),
        up=rng.normal(size=3),
        blending=blending,
        **more,
    )
    # So that every format is asked for every array that a mesh can have, but the one that forbids splats to
    # share vertices.
    wanted = [field.name for field in mesh.FIELDS if field.name != "harmonics"]
    assert not extras or all(getattr(mesh, name) is not None for name in wanted)
    return mesh


def fan_mesh(rng, splats=7, degree=2, *, plain=True, extras=True):
    """Splats of two triangles each, some with colours above white, and a vertex that none uses: with
    harmonics unless ``degree`` is 0."""
    v = 4 * splats + 1
    corners = 4 * np.arange(splats)[:, None, None] + [[0, 1, 2], [0, 2, 3]]
    rgb = rng.random((v, 3)) * 1.6
    more = {}
    if degree:
        more["harmonics"] = rng.normal(size=(splats, (degree + 1) ** 2 - 1, 3)) / 4
    if plain:
        more["plain_colors"] = rng.random((v, 3))
    if extras:
        more["attributes"] = {"flat": rng.normal(size=v)}
    return SplatMesh(
        rng.normal(size=(v, 3)),
        corners.reshape(-1, 3),
        np.column_stack([rgb, rng.random(v)]),
        face_splat=np.repeat(3 * np.arange(splats) + 2, 2),
        up=rng.normal(size=3),
        **more,
    )


def assert_same(got, mesh, color_error=0.0, harmonic_error=0.0):
    """All arrays equal, bit by bit; colours within ``color_error``, harmonics within ``harmonic_error``."""
    np.testing.assert_array_equal(got.vertices, mesh.vertices)
    np.testing.assert_array_equal(got.faces, mesh.faces)
    assert np.abs(got.colors - mesh.colors).max(initial=0) <= color_error
    for name in (field.name for field in mesh.FIELDS if field.optional):
        if getattr(mesh, name) is None:
            assert getattr(got, name) is None
        else:
            within = {"plain_colors": color_error, "harmonics": harmonic_error}.get(name, 0)
            np.testing.assert_allclose(getattr(got, name), getattr(mesh, name), rtol=0, atol=within)
    np.testing.assert_allclose(got.up, mesh.up, atol=1e-6)  # the mesh scales it to unit length again
    assert (got.blending, got.filter_px2) == (mesh.blending, mesh.filter_px2)
    assert got.order == mesh.order
    np.testing.assert_array_equal(got.origin, mesh.origin)
    assert list(got.attributes) == list(mesh.attributes)
    for name, values in mesh.attributes.items():
        assert got.attributes[name].shape == values.shape
        np.testing.assert_array_equal(got.attributes[name], values)


def unit_ball(times: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A ball: an octahedron whose triangles are cut in four ``times`` times, closed, facing out."""
    points = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(times):
        ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, index = np.unique(ends, axis=0, return_inverse=True)
        a, b, c = len(points) + index.reshape(3, -1)
        points = np.concatenate([points, points[edges].mean(axis=1)])
        x, y, z = faces.T
        faces = np.concatenate([np.stack(t, 1) for t in ((x, a, c), (a, y, b), (c, b, z), (a, b, c))])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points, faces.astype(np.int32)
