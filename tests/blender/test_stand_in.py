"""The surface that takes the place of lit splats, and colours for linear light; NumPy alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _blender_scenes import ball_splats

from meshsplats import GaussianCloud, convert, orbit, render, save_gaussians, save_mesh
from meshsplats._common.geometry import vertex_normals
from meshsplats._core.surfaces import Grid
from meshsplats.blender import subject
from meshsplats.blender.files import PictureOptions, PictureRun
from meshsplats.blender.linear import linear_colors
from meshsplats.blender.options import LightOptions, SceneOptions
from meshsplats.blender.stand_in import _Feet, field_around, stand_in, surface_net
from meshsplats.blender.subject import ground_height, prepare
from meshsplats.conversion.normals import shading_normals
from meshsplats.datasets.scene_views import SceneViews
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.viewpoints.finding import FoundCameras


@pytest.mark.slow
def test_lit_scenes_have_plain_colours():
    mesh = convert(make_scene(400))
    rng = np.random.default_rng(0)
    mesh = replace(mesh, plain_colors=rng.random((len(mesh.vertices), 3)))
    unlit, lit = (prepare(mesh, [], SceneOptions(light=light), 8)[0] for light in (None, LightOptions()))
    assert unlit["harmonics"].shape == (len(mesh.vertices), 15, 3)
    np.testing.assert_array_equal(unlit["colors"], mesh.colors)
    assert "harmonics" not in lit
    np.testing.assert_array_equal(lit["display"][:, :3], mesh.plain_colors)


def test_places_are_lit_by_what_is_seen_from_within(monkeypatch):
    """Colours, normals and stand-in also have the views that are found in a place; objects and meshes that
    know no splats have none."""
    seen, colored = [], []

    def shape(mesh, cameras, *options):
        seen.append(list(cameras))
        return {"n": len(cameras)}, {}, None

    def colors(mesh, cameras, **options):
        colored.append(list(cameras))
        return mesh.colors

    mesh = convert(ball_splats(300)[0])
    given, found = orbit(mesh, 3)[:1], orbit(mesh, 2)
    views = iter([(found, "a place"), None])
    monkeypatch.setattr(subject, "shape_for_light", shape)
    monkeypatch.setattr(subject, "linear_colors", colors)
    monkeypatch.setattr(subject, "default_views", lambda cloud, *_, **__: next(views))
    counts = [subject.lit_subject(part, given)[0]["n"] for part in (mesh, mesh)]
    assert counts == [3, 1]
    assert seen[0] == colored[0] == [*given, *found]
    assert subject.lit_subject(replace(mesh, face_splat=None, filter_px2=0), given)[0]["n"] == 1
    options = SceneOptions(light=LightOptions(), within=tuple(orbit(mesh, 5)))
    assert prepare(mesh, given, options, 8)[0]["n"] == 6, "views are not looked for where they are known"


def test_a_place_is_searched_once_for_its_images_and_the_light_on_it(tmp_path, monkeypatch):
    """In the splats of the file, not in what was made of them, and first for the most views."""
    cloud = ball_splats(300)[0]
    save_gaussians(cloud, tmp_path / "place.ply")
    asked, drawn = [], []

    def find_cameras(cloud, count, **options):
        asked.append((cloud, count, options["up"]))
        cameras = tuple(orbit(cloud, count, width=options["width"]))
        return FoundCameras("place", 1.0, np.array([0, -1.0, 0]), 1.0, 0.0, 1.0, cameras)

    def draw(mesh, cameras, *, options, images, **_):
        drawn.append((cameras, options.within))
        for image in images:
            image.touch()
        return {}

    monkeypatch.setattr("meshsplats.viewpoints.showing.find_cameras", find_cameras)
    monkeypatch.setattr("meshsplats.blender.files.draw", draw)
    monkeypatch.setattr("meshsplats.blender.files.command", lambda executable: None)
    for options, counts in (
        (PictureOptions(lit=True), [24, 1]),
        (PictureOptions(fast=True, views=SceneViews(up="z")), [24, 1]),
        (PictureOptions(fast=True, views=SceneViews(azimuth=10)), [24]),
        (PictureOptions(), [1]),
        (PictureOptions(max_splats=100, lit=True, views=SceneViews(up="z")), [32, 24, 1, 32]),
        (PictureOptions(max_splats=100), [32, 1, 32]),
    ):
        asked.clear()
        PictureRun(tmp_path / "place.ply", tmp_path / "image.png", options).save(force=True)
        assert [count for _, count, _ in asked] == counts
        assert all(scene is asked[0][0] and len(scene) == 300 for scene, *_ in asked)
        assert len({str(up) for *_, up in asked}) == 1
        assert (0 if drawn[-1][1] is None else len(drawn[-1][1])) == (24 if options.is_lit else 0)
    save_mesh(convert(cloud), tmp_path / "object.npz")
    monkeypatch.setattr(subject, "default_views", lambda *_, **__: None)
    PictureRun(tmp_path / "object.npz", tmp_path / "image.png", PictureOptions(lit=True)).save(force=True)
    assert drawn[-1][1] == (), "it was looked at"


def ball_field(count: int = 24, radius: float = 8.0) -> np.ndarray:
    steps = np.arange(count) - (count - 1) / 2
    return np.sqrt(sum(s**2 for s in np.meshgrid(steps, steps, steps, indexing="ij"))) - radius


def volume(vertices, faces) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_surface_net_is_closed_faces_out_and_has_the_volume_of_the_field():
    vertices, faces, cells = surface_net(ball_field())
    assert np.abs(np.linalg.norm(vertices - 11.5, axis=1) - 8).max() < 0.15
    assert np.isclose(volume(vertices, faces), 4 / 3 * np.pi * 8**3, rtol=0.02)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward, backward = (np.unique(e, axis=0, return_counts=True) for e in (edges, edges[:, ::-1]))
    assert (forward[0] == backward[0]).all()
    assert (forward[1] == backward[1]).all(), "each edge is passed as often one way as the other"
    assert (np.abs(vertices - cells - 0.5) <= 0.5).all(), "a vertex lies in its cell"


def test_surface_net_leaves_small_parts_out():
    field = ball_field()
    field[1, 1, 1] = -0.2
    alone = surface_net(ball_field())
    assert len(surface_net(field)[0]) == len(alone[0])
    assert len(surface_net(np.ones((4, 4, 4)))[1]) == 0


@pytest.fixture(scope="module")
def ball():
    """A ball of splats with a floater and a stray hair: a column of splats that stands out of it."""
    cloud, _ = ball_splats(3000)
    hair = np.column_stack([np.zeros((40, 2)), np.linspace(1.02, 1.6, 40)])
    added = np.concatenate([hair, [[0.0, -2.6, 0]]])
    more = GaussianCloud(
        np.concatenate([cloud.means, added]),
        np.concatenate([cloud.quaternions, np.tile([1.0, 0, 0, 0], (41, 1))]),
        np.concatenate([cloud.scales, np.full((41, 3), 0.006)]),
        np.concatenate([cloud.opacities, np.full(41, 0.9)]),
        np.concatenate([cloud.sh, np.zeros((41, 1, 3))]),
    )
    mesh = convert(more, mode="flat")
    normals = shading_normals(mesh)
    colors = np.column_stack([srgb_to_linear(mesh.colors[:, :3]), mesh.colors[:, 3]])
    return mesh, stand_in(mesh, normals, field_around(mesh, resolution=48)), colors


def test_stand_in_is_the_surface_that_the_splats_form(ball):
    _, made, own = ball
    colors = made.colors(own)
    radii = np.linalg.norm(made.vertices, axis=1)
    assert np.abs(radii - 1).max() < 0.03
    assert 0.95 < volume(made.vertices, made.faces) / (4 / 3 * np.pi) < 1.05
    red = made.vertices[:, 1] < -0.65
    assert colors[red, 0].mean() > 3 * colors[red, 2].mean()
    grey = colors[(made.vertices[:, 1] > -0.3) & (made.vertices[:, 2] < 0.8)]
    assert np.abs(grey - srgb_to_linear(np.float32(0.7))).max() < 0.01


def test_splats_take_the_light_at_their_foot(ball):
    mesh, made, _ = ball
    near = np.linalg.norm(mesh.vertices, axis=1) < 1.01
    points, normals = made.points[made.point_of[near]], made.normals[made.point_of[near]]
    assert np.linalg.norm(points - mesh.vertices[near], axis=1).max() < 0.2
    assert np.abs(np.linalg.norm(points, axis=1) - 1).max() < 0.03
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", outward, normals).min() > 0.9


def test_thin_parts_cast_their_own_shadow_and_floaters_none(ball):
    mesh, made, _ = ball
    centers = np.zeros((mesh.face_splat.max() + 1, 3))
    for k in range(3):
        corners = mesh.vertices[mesh.faces].mean(axis=1)[:, k]
        centers[:, k] = np.bincount(mesh.face_splat, corners) / np.bincount(mesh.face_splat)
    fine = np.unique(mesh.face_splat[made.fine])
    hair = np.flatnonzero(centers[:, 2] > 1.25)
    assert np.isin(hair, fine).all()
    assert (np.linalg.norm(centers[fine], axis=1) > 1.02).all(), "not those of the ball"
    assert centers[fine][:, 1].min() > -2, "not the floater"


@pytest.mark.parametrize(("low", "high"), [(10.4, 11.2), (10.4, 12.1)])
def test_splats_at_the_underside_of_a_slab_that_face_up_are_lit_from_above(low, high):
    """A street that the images show a little too thick is no thicker than two voxels."""
    steps = np.arange(24.0)
    square = np.maximum.reduce(
        np.broadcast_arrays(*np.meshgrid(*2 * [np.abs(steps - 11.5) - 8], indexing="ij"))
    )
    height = np.maximum(low - steps, steps - high)
    field = np.maximum(square[:, :, None], height)
    vertices, faces, cells = surface_net(field)
    grid = Grid(np.zeros(3), 1.0, field.shape)
    feet = _Feet(grid, field, vertices, vertex_normals(vertices, faces), cells)
    place = np.random.default_rng(0).uniform([6, 6, low], [17, 17, low + 0.1], (100, 3))
    up = np.tile([0.0, 0, 1], (100, 1))
    index, found = feet.of(place, up)
    assert found.all()
    assert (feet.facing(index, up)[:, 2] > 0.9).all()
    assert (feet.projected(place, index)[:, 2] > high - 0.9).all()


def test_a_ground_below_a_scene_with_a_street_leaves_the_street_in_the_light():
    """The highest that the ground may be is below all but stray points that face up."""
    rng = np.random.default_rng(0)
    heights = np.concatenate([rng.uniform(0.0, 0.1, 500), rng.uniform(0, 5, 500)])
    facing = np.concatenate([np.ones(500), np.full(500, 0.1)])
    assert -0.31 < ground_height(0.05, heights, facing, 0.3) < -0.2
    assert ground_height(-1.0, heights, facing, 0.3) == -1.0, "an object that stands on feet"
    assert ground_height(0.05, heights, -facing, 0.3) == 0.05, "undersides do not count"


@pytest.mark.slow
def test_nothing_solid_has_no_stand_in():
    cloud, _ = ball_splats(200)
    mesh = convert(replace(cloud, opacities=np.full(200, 0.05)), mode="flat")
    assert stand_in(mesh, shading_normals(mesh), field_around(mesh, resolution=16)) is None


@pytest.mark.slow
def test_linear_colors_show_in_linear_light_what_display_blending_shows():
    rng = np.random.default_rng(0)
    cloud, _ = ball_splats(800)
    colors = rng.uniform(0.05, 0.95, (800, 1, 3))
    mesh = convert(
        replace(cloud, opacities=rng.uniform(0.2, 0.8, 800), sh=(colors - 0.5) / 0.28209479), mode="flat"
    )
    view = orbit(mesh, 1, azimuth=50, width=96, height=96)[0]
    target = render(mesh, view, samples=2)

    def error(linear):
        drawn = render(replace(mesh, colors=linear), view, samples=2).color
        return psnr(np.clip(linear_to_srgb(drawn), 0, 1), target.color)

    before = error(linear_colors(mesh, steps=0))
    assert error(linear_colors(mesh, steps=36)) > before + 3
    assert error(linear_colors(mesh, [view], steps=36)) > before + 5
    kept = replace(mesh, blending="linear")
    assert linear_colors(kept) is kept.colors
