"""What a page shows, without a browser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.viewer import content
from meshsplats.viewer.content import TooManyTrianglesError, content_of_mesh, content_of_splats


def test_splats_within_the_limit_are_not_merged():
    cloud = make_scene(200)
    found = content_of_splats(cloud, max_triangles=1600)
    assert (len(found.mesh.faces), found.kept, found.merged_from) == (1600, 200, None)
    found = content_of_splats(cloud, max_triangles=800, shown=False)
    assert (len(found.mesh.faces), found.kept, found.merged_from, found.splats) == (800, 100, 200, None)
    assert 10 < found.merging_psnr < 45


def test_only_the_colours_that_a_page_shows_are_kept():
    cloud = make_scene(200)
    assert cloud.sh_degree > 0
    found = content_of_mesh(convert(cloud), cloud)
    assert found.splats is not None
    np.testing.assert_array_equal(found.splats.sh, cloud.sh[:, :1])


def test_both_levels_keep_colours_that_depend_on_the_view_and_splats_beside_them_do_not(monkeypatch):
    monkeypatch.setattr("meshsplats.viewer.content.COARSE_TRIANGLES", 8000)
    cloud = make_scene(1500).of_degree(2)
    for found in (content_of_splats(cloud), content_of_mesh(convert(cloud), cloud)):
        assert (found.mesh.sh_degree, found.coarse.sh_degree, found.splats.sh_degree) == (2, 2, 0)
    plain = content_of_mesh(convert(cloud.of_degree(0)), cloud)
    assert (plain.mesh.sh_degree, plain.coarse.sh_degree) == (0, 0)


def moved(mesh):
    return replace(mesh, vertices=mesh.vertices + np.float32([1, 0, 0]))


def test_the_coarse_level_shows_the_mesh_that_was_edited(monkeypatch):
    monkeypatch.setattr("meshsplats.viewer.content.COARSE_TRIANGLES", 8000)
    cloud, lines = make_scene(1500), []
    mesh = convert(cloud)
    shown = content_of_mesh(moved(mesh), cloud, say=lines.append).coarse
    assert len(shown.faces) == 8000
    assert shown.vertices[:, 0].mean() == pytest.approx(moved(mesh).vertices[:, 0].mean(), abs=0.1)
    red = replace(mesh, colors=mesh.colors * np.float32([1, 0.2, 0.2, 1]))
    shown = content_of_mesh(red, cloud, say=lines.append).coarse
    np.testing.assert_allclose(shown.colors.mean(axis=0), red.colors.mean(axis=0), atol=0.05)
    assert lines == []


def test_splats_that_show_something_else_than_the_mesh_make_no_coarse_level(monkeypatch):
    """A mesh that is not known to be fans, as of another program."""
    monkeypatch.setattr("meshsplats.viewer.content.COARSE_TRIANGLES", 8000)
    cloud, lines = make_scene(1500).of_degree(0), []
    mesh = replace(convert(cloud), face_splat=None)
    assert len(content_of_mesh(mesh, cloud, say=lines.append).coarse.faces) == 8000
    assert lines == []
    found = content_of_mesh(moved(mesh), cloud, say=lines.append)
    assert found.coarse is None
    assert found.splats is not None
    assert lines == [
        "no coarse level: the splats do not look like the mesh, which is drawn whole while it moves and on"
        " phones"
    ]


def test_a_page_has_a_limit_for_meshes_and_splats(monkeypatch):
    monkeypatch.setattr(content, "MOST_TRIANGLES", 1000)
    cloud = make_scene(200)
    for call in (lambda: content_of_splats(cloud), lambda: content_of_mesh(convert(cloud))):
        with pytest.raises(TooManyTrianglesError, match="at most 1,000 triangles, and these would be 1,600"):
            call()
