"""One colour for each vertex of a mesh whose colours depend on the view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats import convert, orbit, plain_colors_of, render
from meshsplats.demo_scene import make_scene
from meshsplats.rendering.plain_colors import plain_means
from meshsplats.rendering.shading import seen_from


@pytest.fixture(scope="module")
def mesh():
    return convert(make_scene(1500))


def mean_error(shown, mesh, cameras):
    """Mean squared difference of the images of ``shown`` from those of ``mesh``."""
    return np.mean([((render(shown, c).color - render(mesh, c).color) ** 2).mean() for c in cameras])


def test_one_view_gives_its_own_colours(mesh):
    camera = orbit(mesh, 1, width=40, height=40)[0]
    mesh = replace(mesh, colors=mesh.colors * [2, 2, 2, 1])  # some above white
    seen = np.clip(seen_from(mesh, camera).colors[:, :3], 0, 1)
    np.testing.assert_allclose(plain_colors_of(mesh, [camera]), seen, atol=1e-6)


def test_the_colours_are_nearer_to_the_views_than_those_of_the_file(mesh):
    assert mesh.harmonics is not None
    cameras = orbit(mesh, 5, elevation=20, width=60, height=60)
    plain = plain_colors_of(mesh, cameras, threads=1)
    baked = mean_error(replace(mesh, plain_colors=plain).plain, mesh, cameras)
    assert baked < 0.7 * mean_error(mesh.plain, mesh, cameras)
    # And than a mean in which views count alike that hardly show a vertex.
    alike = np.mean([seen_from(mesh, c).colors[:, :3] for c in cameras], axis=0).clip(0, 1)
    assert baked < mean_error(replace(mesh, plain_colors=alike).plain, mesh, cameras)


def test_vertices_that_no_view_shows_have_the_mean_of_all(mesh):
    cameras = orbit(mesh, 2, width=20, height=20)
    away = [replace(c, cx=c.cx + 1e5) for c in cameras]
    alike = np.mean([seen_from(mesh, c).colors[:, :3] for c in cameras], axis=0).clip(0, 1)
    colors, shown = plain_means(mesh, away)
    np.testing.assert_allclose(colors, alike, atol=1e-6)
    assert not shown
    with pytest.raises(
        ValueError, match=r"none of the 2 cameras sees any of the .* triangles: are they of one"
    ):
        plain_colors_of(mesh, away)


def test_colours_of_a_mesh_without_harmonics_stay(mesh):
    plain = mesh.of_degree(0)
    got = plain_colors_of(plain, orbit(plain, 2, width=20, height=20))
    np.testing.assert_array_equal(got, plain.colors[:, :3])


def test_no_view_is_refused(mesh):
    with pytest.raises(ValueError, match="at least one view"):
        plain_colors_of(mesh, [])
