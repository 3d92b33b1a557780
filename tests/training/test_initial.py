"""Where a training starts: hulls hold their object, patches lie on surfaces, sizes follow the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _balls import ball_view, cameras_around

from meshsplats.datasets.points import ScenePoints
from meshsplats.datasets.silhouettes import has_alpha, has_silhouettes, with_clear_pixels_masked
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.errors import DataWarning
from meshsplats.rendering import render
from meshsplats.scene.camera import Camera
from meshsplats.training import hull, initial, starting_fans, train_config
from meshsplats.training.hull import carve, in_silhouettes
from meshsplats.training.initial import (
    colored,
    fans_of,
    ranges_of_points,
    shell_patches,
    starting_patches,
)
from meshsplats.training.patches import FILLED_OPACITY, OPACITY, flat_splats


@pytest.fixture(scope="module")
def ball():
    return [ball_view(camera) for camera in cameras_around(24)]


@pytest.fixture(scope="module")
def room():
    return [ball_view(camera, backdrop=True) for camera in cameras_around(24)]


def on_sphere(count: int = 400) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_the_hull_holds_the_ball_and_little_more(ball):
    surface = carve(ball, 1500)
    assert len(surface.points) >= 1500
    radius = np.linalg.norm(surface.points, axis=1)
    # Cells of the surface lie around the sphere; 24 silhouettes leave some room beside it.
    assert radius.min() > 1 - surface.side
    assert np.quantile(radius, 0.9) < 1.08 + surface.side
    for point in on_sphere():  # no part of the ball is carved away
        assert np.linalg.norm(surface.points - point, axis=1).min() < 0.25
    outward = np.einsum("ni,ni->n", surface.normals, surface.points / radius[:, None])
    assert np.median(outward) > 0.9


def test_a_misplaced_view_does_not_cut_the_hull(ball):
    wrong = cameras_around(24, seed=2)[7].world_to_camera.copy()
    wrong[0, 3] += 1.2
    views = list(ball)
    views[7] = replace(views[7], camera=replace(views[7].camera, world_to_camera=wrong))
    surface = carve(views, 1500)
    assert np.linalg.norm(surface.points, axis=1).min() > 1 - surface.side


def views_of_a_column(rows: np.ndarray, half: float, distance: float = 3.0) -> list[View]:
    """Of a column along y around the origin, 1 wide, which ends at +-``half``: eight around it at each of the
    heights ``rows``, a third of ``distance`` to each side in the image."""
    views = []
    for y in rows:
        for angle in np.pi / 4 * np.arange(8):
            back = np.array([np.sin(angle), 0, -np.cos(angle)])
            axes = np.array([[-back[2], 0, back[0]], [0, 1, 0], -back])
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = axes, -axes @ (distance * back + [0, y, 0])
            camera = Camera(matrix, 96, 96, 32, 32, 64, 64)
            across = distance * (np.arange(64) + 0.5 - 32) / 96
            alpha = np.outer(np.abs(across + y) < half, np.abs(across) < 0.5).astype(np.float32)
            views.append(View(camera, ViewImage(0.5 * alpha[..., None].repeat(3, axis=2), alpha)))
    return views


def check_column(views: list[View], half: float) -> None:
    surface = carve(views, 500)
    x, y, z = surface.points.T
    assert np.hypot(x, z).max() < 0.7 + surface.side
    ends = y.min(), y.max()
    assert np.allclose(ends, (-half, half), atol=0.25 * half + surface.side), ends
    # All around it, at each height.
    bins = np.histogram2d(y, np.arctan2(x, z), (6, 4), ((-0.8 * half, 0.8 * half), (-np.pi, np.pi)))[0]
    assert bins.min() > 0


def test_a_subject_may_be_photographed_in_parts():
    rows = np.array([-2.0, 0.0, 2.0])
    check_column(views_of_a_column(rows[1:2], 1.0), 1.0)
    check_column(views_of_a_column(rows, 3.0), 3.0)


def test_ends_of_a_subject_that_few_close_ups_show_stay():
    """With a few photographs of the whole."""
    whole = views_of_a_column(np.zeros(1), 3.0, distance=12.0)
    middle = views_of_a_column(np.array([-0.3, 0.0, 0.3]), 3.0)
    check_column([*whole, *middle], 3.0)


def test_silhouettes_of_nothing_in_common_are_refused(ball):
    views = []
    for i, view in enumerate(ball):
        alpha = np.zeros((64, 64), np.float32)
        alpha[5:9, 5 + 7 * (i % 8) : 9 + 7 * (i % 8)] = 1
        views.append(View(view.camera, ViewImage(alpha[..., None].repeat(3, axis=2), alpha)))
    assert carve(views, 500) is None
    with pytest.raises(ValueError, match="cameras and masks do not fit"):
        starting_patches(views, 500)


def test_up_is_as_the_photographs_were_held(ball):
    """Whichever way they are stored."""

    def on_its_side(view: View) -> View:
        image = view.load()
        turned = ViewImage(*(np.ascontiguousarray(np.rot90(a, -1)) for a in (image.color, image.alpha)))
        return View(replace(view, turn=1).upright, turned, turn=3)

    config = train_config(steps=1, start_splats=50, max_splats=100)
    stored = Dataset(tuple(on_its_side(view) for view in ball))
    assert np.allclose(starting_fans(stored, config).up, [0, 0, 1])


def test_silhouettes_need_alpha_that_leaves_something_out(ball, room):
    assert has_silhouettes(ball)
    assert not has_silhouettes(room)
    assert not has_silhouettes([])
    view = ball[0]
    full = ViewImage(view.load().color, np.ones((64, 64), np.float32))
    assert not has_silhouettes([replace(view, source=full)])


def test_clear_corners_of_a_photograph_are_no_silhouette(room):
    """They do not count; the others stay as they are."""

    def cornered(view: View) -> View:
        image = view.load()
        alpha = np.ones((64, 64), np.float32)
        alpha[:6, :9] = 0
        return replace(view, source=ViewImage(image.color * alpha[..., None], alpha))

    views = [*room[:5], cornered(room[5]), *room[6:]]
    assert not has_silhouettes(views)
    assert not has_silhouettes([*map(cornered, room)])
    with pytest.warns(DataWarning, match="1 of 24 .* have transparent pixels.*: 005. These pixels do not"):
        dataset = with_clear_pixels_masked(Dataset(views[:20], views[20:]))
    odd = dataset.train[5]
    assert odd.alpha is None
    assert not odd.mask[:6, :9].any()
    assert odd.mask.sum() == 64 * 64 - 54
    assert dataset.train[4] is room[4]
    assert not has_alpha(odd)
    assert with_clear_pixels_masked(dataset) is dataset


def test_cut_out_photographs_keep_their_alpha(ball, room):
    dataset = Dataset(tuple(ball[:12]), tuple(ball[12:]))
    assert with_clear_pixels_masked(dataset) is dataset
    assert has_silhouettes([*ball[:12], *room[12:]])
    assert not has_silhouettes([*ball[:11], *room[11:]])


@pytest.mark.slow
def test_photographs_without_alpha_take_no_part_in_silhouettes(ball, room):
    surface = carve([*ball[::2], *room[1::2]], 500)
    assert np.linalg.norm(surface.points, axis=1).min() > 1 - surface.side
    assert np.quantile(np.linalg.norm(surface.points, axis=1), 0.9) < 1.5
    assert in_silhouettes(room, 1.5 * on_sphere(50), np.full(50, 0.01)).all()
    patches, shell = starting_patches([room[0], *ball[1:]], 500)
    assert shell is None
    assert len(patches.points) > 100


def test_large_silhouettes_are_made_smaller(ball, monkeypatch):
    """The hull still holds the ball."""
    whole = carve(ball, 500)
    monkeypatch.setattr(hull, "SILHOUETTE_BYTES", hull.PIXEL_BYTES * len(ball) * 30**2)
    assert hull.silhouette_factor(ball) == pytest.approx(30 / 64)
    assert hull.carving_bytes(ball, 0) == hull.SILHOUETTE_BYTES
    small = carve(ball, 500)
    assert not np.array_equal(small.points, whole.points)
    for surface in (whole, small):
        radius = np.linalg.norm(surface.points, axis=1)
        assert radius.min() > 1 - surface.side
        assert np.quantile(radius, 0.9) < 1.15 + surface.side


@pytest.mark.slow
def test_a_hull_has_a_largest_number_of_cells(ball, monkeypatch):
    fine = carve(ball, 4000)
    monkeypatch.setattr(hull, "MOST_CELLS", 100_000)
    assert len(carve(ball, 4000).points) < 4000 <= len(fine.points)
    monkeypatch.undo()
    monkeypatch.setattr(hull, "CELLS_AT_ONCE", 7000)
    parts = carve(ball, 1500, lambda points: points[:, 2] < 0.5)
    monkeypatch.undo()
    whole = carve(ball, 1500, lambda points: points[:, 2] < 0.5)
    assert np.array_equal(parts.points, whole.points)
    assert np.array_equal(parts.normals, whole.normals)


def test_points_beside_a_silhouette_are_found(ball):
    points = np.concatenate([0.9 * on_sphere(50), 1.5 * on_sphere(50)])
    inside = in_silhouettes(ball, points, np.full(100, 0.01))
    assert inside[:50].all()
    assert not inside[50:].any()


def test_ranges_of_depth_hold_the_points(room):
    points = np.concatenate([on_sphere(300), 8 * on_sphere(300)])
    near, far, _targets = ranges_of_points(room, points)
    for view, low, high in zip(room, near, far, strict=True):
        positions, depth = view.camera.project(points)
        seen = depth[view.camera.in_image(positions)]
        assert low < np.quantile(seen, 0.02)
        assert high > seen.max()
    # Views without a point in their image have the range of the others.
    away = room[0].camera.world_to_camera.copy()
    away[:3] *= np.array([[-1], [1], [-1]])
    turned = replace(room[0], camera=replace(room[0].camera, world_to_camera=away))
    few = on_sphere(300) * 0.5
    assert np.isfinite(ranges_of_points([turned, *room[1:]], few)[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("masked", [True, False])
def test_the_start_has_the_scale_of_the_scene(masked):
    starts = []
    for scale in (1.0, 50.0):
        cameras = cameras_around(16, scale=scale)
        views = [ball_view(camera, scale, backdrop=not masked) for camera in cameras]
        patches, shell = starting_patches(views, 1200)
        assert (shell is None) == masked
        starts.append(patches)
    small, large = starts
    assert len(large.points) == pytest.approx(len(small.points), rel=0.1)
    assert np.median(large.deviations) == pytest.approx(50 * np.median(small.deviations), rel=0.1)
    extent = [np.quantile(np.linalg.norm(p.points, axis=1), 0.5) for p in starts]
    assert extent[1] == pytest.approx(50 * extent[0], rel=0.1)


def test_the_shell_lies_behind_everything(room):
    patches, shell = starting_patches(room, 1500)
    assert 0.8 * 90 < len(shell.points) < 1.5 * 90  # a small share, and a coarse backdrop
    inner = np.quantile(np.linalg.norm(patches.points, axis=1), 0.98)
    assert np.linalg.norm(shell.points, axis=1).min() > inner


def test_a_backdrop_fills_what_views_beside_the_photographs_show(room):
    """Also three times as far from the middle of an image, where the shell in them ends; not behind the
    cameras."""
    ahead = [view for view in room if view.camera.world_to_camera[2, 0] > 0.7]
    assert 2 < len(ahead) < 10
    pieces = shell_patches(ahead, None, 8.0, 800)
    behind = np.linalg.norm(pieces.points, axis=1)
    assert behind.max() > 1.15 * behind.min()
    mesh = fans_of(flat_splats(pieces), 6)
    colors = colored(mesh, ahead, None, 0).colors[:, :3]
    assert np.abs(colors - 0.5).max(axis=1).min() > 0  # from the photographs, or from the nearest piece
    for view in ahead:
        camera, margin = view.camera, round(0.9 * view.camera.width)
        side = camera.width + 2 * margin
        assert render(mesh, camera.window(-margin, -margin, side, side)).alpha.min() > 0.8
    away = np.mean([view.camera.world_to_camera[2, :3] for view in ahead], axis=0)
    assert (pieces.points @ away / behind).min() > -0.9


def test_surfaces_between_matched_depths_start_fainter(room):
    """So that the views decide whether they are there: they may hang in front of a sky."""
    patches, _ = starting_patches(room, 1500)
    assert patches.opacities.max() == pytest.approx(OPACITY)
    assert patches.opacities.min() < 0.5 * (OPACITY + FILLED_OPACITY)
    assert flat_splats(patches).opacities == pytest.approx(patches.opacities)


def test_known_points_are_part_of_the_start(room):
    """Also where no photographs match: there are none of these colours."""
    spot = np.random.default_rng(0).normal([0, 0, 1.4], 0.06, (200, 3))
    points = ScenePoints(
        np.concatenate([spot, on_sphere(200)]),
        np.repeat([[255, 0, 255], [128, 128, 128]], 200, axis=0).astype(np.uint8),
        np.full(400, 3),
    )
    patches, _ = starting_patches(room, 1500, points)
    assert (np.abs(patches.colors - [1, 0, 1]).max(axis=1) < 0.1).sum() >= 2


@pytest.mark.slow
def test_colours_are_those_of_the_photographs(ball):
    patches, _ = starting_patches(ball, 1500)
    mesh = fans_of(flat_splats(patches), 6)
    grey = replace(mesh, colors=np.column_stack([np.full((len(mesh.colors), 3), 0.5), mesh.colors[:, 3]]))
    tinted = colored(grey, ball, None)
    from meshsplats.rendering import render

    view = ball[3]
    error = [np.abs(render(m, view.camera).color - view.image).mean() for m in (grey, tinted)]
    assert error[1] < 0.6 * error[0]
    assert np.array_equal(tinted.colors[:, 3], grey.colors[:, 3])


@pytest.mark.slow
def test_colours_are_corrected_by_their_errors(ball, monkeypatch):
    patches, _ = starting_patches(ball, 1500)
    mesh = fans_of(flat_splats(patches), 6)

    def error() -> float:
        found = colored(mesh, ball, None)
        return float(np.mean([np.square(render(found, v.camera).color - v.image).mean() for v in ball]))

    corrected = error()
    monkeypatch.setattr(initial, "ERROR_PIXELS", 1e9)
    assert corrected < 0.97 * error()
