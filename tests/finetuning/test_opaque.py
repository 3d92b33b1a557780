"""Fine-tuning for programs with a depth buffer."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from _rendering import camera, layers
from _zbuffer import hybrid_image

from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.metrics import psnr
from meshsplats.evaluation.report import evaluate
from meshsplats.finetuning import Interrupted, Progress, RunOptions, finetune, make_config, starting_mesh
from meshsplats.finetuning.clock import Clock
from meshsplats.finetuning.config import learning_rates
from meshsplats.finetuning.gradients import Gradients
from meshsplats.finetuning.hybrid import COLOR_SLOPE, ColorLimits, softness, with_soft_splats
from meshsplats.finetuning.opaque import expected_error, visible_samples
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.phases.cutting import Cutting
from meshsplats.finetuning.phases.hybrid import Hybrid
from meshsplats.finetuning.phases.phase import Moment
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step
from meshsplats.formats.cutting import cut_mesh
from meshsplats.rendering import render
from meshsplats.scene.mesh import SplatMesh, solid_faces


@pytest.fixture(scope="module")
def scene():
    cloud = make_scene(400)
    dataset = splat_dataset(cloud, train=12, test=4, width=48, sh_degree=0)
    return dataset, convert(cloud, cameras=[view.camera for view in dataset.train])


def score(mesh: SplatMesh, dataset: Dataset) -> float:
    return evaluate(mesh, dataset, samples=2).method("mesh").mean("psnr")


@pytest.mark.slow
def test_it_beats_a_blended_mesh_that_is_cut(scene):
    dataset, mesh = scene
    tuned = finetune(mesh, dataset, make_config(steps=96, opacity="cutoff"))
    assert (tuned.colors[:, 3] == 1).all()
    blended = finetune(mesh, dataset, make_config(steps=96))
    best = max(score(cut_mesh(blended, c), dataset) for c in (0.1, 0.2, 0.3, 0.5))
    assert score(tuned, dataset) > best + 2
    assert score(tuned, dataset) > score(cut_mesh(mesh, 0.2), dataset) + 4


def test_the_reported_score_is_that_of_the_cut_mesh(scene):
    dataset, mesh = scene
    seen: list[Progress] = []
    tuned = finetune(mesh, dataset, make_config(steps=8, opacity="cutoff"), on_progress=seen.append)
    # Of images clipped to [0, 1].
    assert seen[-1].held_out == pytest.approx(score(tuned, dataset), abs=0.02)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(("soft_share", "opaque_share"), [(0.0, 1.0), (0.3, 1.0), (0.1, 0.2)])
def test_a_resumed_run_ends_with_the_same_bits(scene, tmp_path, soft_share, opaque_share):
    dataset, mesh = scene
    shares = {"settle_share": 0.5, "soft_share": soft_share, "opaque_share": opaque_share}
    config = make_config(steps=20, opacity="cutoff", **shares)
    whole = finetune(mesh, dataset, config)
    assert is_blended(whole).any() == (soft_share > 0)
    for stop in (6, 13, 17):  # before hidden triangles go, and after; with blended triangles

        def halt(progress: Progress, stop: int = stop) -> None:
            if progress.step == stop:
                raise Interrupted(stop, 2)

        folder = tmp_path / str(stop)
        options = RunOptions(folder, checkpoint_seconds=1e-6)
        with pytest.raises(Interrupted):
            finetune(mesh, dataset, config, run=options, on_progress=halt)
        again = finetune(mesh, dataset, config, run=replace(options, resume=True))
        for name in ("vertices", "faces", "colors"):
            assert getattr(again, name).tobytes() == getattr(whole, name).tobytes()


def test_the_schedule_goes_from_blended_to_cut(scene):
    dataset, mesh = scene
    view = dataset.train[0]
    config = make_config(opacity="cutoff", cutoff=0.3, anneal_share=0.5, expected_share=0.4)
    plans = [Cutting(config, mesh).plan(view, 0, f) for f in (0, 0.25, 0.5, 1)]
    begin, half, end = (plan.ramp for plan in plans[:3])
    assert (begin.height, begin.slope, begin.cutoff) == (0.3, 1, 0.3)
    assert half.height == pytest.approx(0.4)
    assert begin.leak > half.leak > end.leak == 0
    assert (end.height, end.width) == (0.5, 1)
    assert end.slope > 1e5
    assert [plan.expected for plan in plans] == pytest.approx([0, 0.2, 0.4, 0.4])
    assert [plan.edges for plan in plans] == [None, 0.3, 0.3, 0.3]
    blended = Blended(make_config()).plan(view, 0, 0.7)
    assert (blended.ramp, blended.expected, blended.edges) == (None, 0, None)


def test_masked_pixels_do_not_count():
    mask = np.array([[True, False], [True, True]])
    target = np.full((2, 2, 3), 0.5, np.float32)
    target[0, 1] = np.nan
    found = expected_error(target, mask, make_config(l2_weight=18), 0.5)
    assert np.array_equal(found.weight, np.where(mask, np.float32(1), 0))
    assert np.isfinite(found.target).all()


def test_visible_triangles_are_those_in_front():
    view = camera(8, 6)
    mesh = layers([2, 3, 4], [0.1, 0.5, 0.9])
    views = [View(view, ViewImage(np.zeros((6, 8, 3), np.float32)))]
    assert visible_samples(mesh, views, 0.2).tolist() == [0, 4 * 48, 0]
    assert visible_samples(mesh, [*views, *views], 0.6).tolist() == [0, 0, 2 * 4 * 48]


def test_a_run_with_a_budget_settles_earlier():
    config = make_config(opacity="cutoff")
    assert config.settling < replace(config, opaque_share=0.5).settling == 0.5
    assert replace(config, opaque_share=0.5, settle_share=0.3).settling == 0.3


@pytest.mark.parametrize("soft_share", [0.0, 0.1])
def test_a_run_keeps_its_budget(scene, soft_share):
    dataset, mesh = scene
    tuned = finetune(mesh, dataset, steps=40, opacity="cutoff", opaque_share=0.1, soft_share=soft_share)
    solid = solid_faces(tuned).sum()
    assert 0.05 * len(mesh.faces) < solid <= 0.1 * len(mesh.faces)
    assert solid + bool(soft_share) <= len(tuned.faces) <= (0.1 + soft_share) * len(mesh.faces)


@pytest.mark.slow
def test_a_budget_costs_less_than_its_triangles(scene):
    """Polygons in place of fans: a fifth of the triangles for less than a dB."""
    dataset, _ = scene
    mesh = starting_mesh(make_scene(400), [view.camera for view in dataset.train])
    every, fifth = (
        finetune(mesh, dataset, steps=96, opacity="cutoff", opaque_share=share) for share in (1.0, 0.2)
    )
    assert len(fifth.faces) < 0.5 * len(every.faces)
    assert score(fifth, dataset) > score(every, dataset) - 1


def test_a_vertex_with_a_gradient_of_its_colour_alone_moves(scene):
    _, mesh = scene
    for opacity in ("cutoff", "blended"):  # blended: of the colour behind it
        state = State.begin(mesh, 1, make_config(opacity=opacity), 1)
        before = state.colors.copy()
        gradients = Gradients(
            np.zeros((len(before), 3), np.float32), np.zeros_like(before), np.zeros_like(state.harmonics)
        )
        gradients.colors[5, 0] = -1 if before[5, 0] < 0.5 else 1
        state.step(gradients, 0.02, 0.02, 0)
        assert state.colors[5, 0] != before[5, 0]
        assert (np.delete(state.colors, 5, axis=0) == np.delete(before, 5, axis=0)).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exposure": True}, "exposure has no effect without opacity 'blended', got opacity 'cutoff'"),
        ({"opacity_decay": 0.1}, "opacity_decay has no effect without opacity 'blended'"),
        ({"blending": "linear"}, "opaque triangles are not blended"),
        ({"opaque_share": 0.5, "anneal_share": 0.6}, "annealing must end before the mesh settles"),
        ({"l2_weight": 0.0}, "expected_share is a share of l2_weight"),
        ({"cutoff": 1.5}, "cutoff"),
        ({"soft_phase": 0.5}, "soft_phase has no effect without soft_share"),
    ],
)
def test_options_that_need_blending_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_config(opacity="cutoff", **changes)


def test_options_without_effect_are_refused():
    with pytest.raises(ValueError, match="settle_share has no effect without opacity 'cutoff'"):
        make_config(settle_share=0.3)
    with pytest.raises(ValueError, match="soft_share has no effect without opacity 'cutoff'"):
        make_config(soft_share=0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"filter_px2": 0.3}, "without a filter"), ({"blending": "linear"}, "display colours")],
)
def test_meshes_that_cannot_become_opaque_are_refused(scene, changes, message):
    dataset, mesh = scene
    with pytest.raises(ValueError, match=message):
        finetune(replace(mesh, **changes), dataset, steps=1, opacity="cutoff")


def test_blended_triangles_need_splats(scene):
    dataset, mesh = scene
    with pytest.raises(ValueError, match="does not know its own"):
        finetune(
            replace(mesh, face_splat=None, harmonics=None), dataset, steps=1, opacity="cutoff", soft_share=0.1
        )


# Blended triangles beside the opaque ones


@pytest.fixture(scope="module")
def foggy():
    """A solid still life behind faint, large splats."""
    cloud = make_scene(300)
    rng = np.random.default_rng(0)
    center, size = cloud.means.mean(axis=0), cloud.means.std(axis=0)
    n = 15
    fog = replace(
        cloud.take(np.zeros(n, int)),
        means=(center + 2 * size * rng.normal(size=(n, 3))).astype(np.float32),
        scales=np.full((n, 3), 0.6 * size.mean(), np.float32),
        opacities=np.full(n, 0.3, np.float32),
    )
    names = ("means", "quaternions", "scales", "opacities", "sh")
    both = replace(cloud, **{k: np.concatenate([getattr(cloud, k), getattr(fog, k)]) for k in names})
    dataset = splat_dataset(both, train=32, test=4, width=48, sh_degree=0)
    return dataset, starting_mesh(both, [view.camera for view in dataset.train]), len(cloud.means)


def is_blended(mesh: SplatMesh) -> np.ndarray:
    return ~solid_faces(mesh)


@pytest.mark.slow
def test_fog_stays_blended(foggy):
    dataset, mesh, solid_splats = foggy
    config = make_config(steps=96, opacity="cutoff")
    opaque = finetune(mesh, dataset, config)
    hybrid = finetune(mesh, dataset, replace(config, soft_share=0.2))
    blended = is_blended(hybrid)
    assert 0 < blended.sum() <= 0.2 * len(mesh.faces)
    assert (hybrid.face_splat[blended] >= solid_splats).mean() > 0.5
    assert score(hybrid, dataset) > score(opaque, dataset) + 1


@pytest.mark.slow
def test_a_viewer_that_does_not_sort_draws_a_hybrid_mesh(foggy):
    dataset, mesh, _ = foggy
    hybrid = finetune(mesh, dataset, steps=48, opacity="cutoff", soft_share=0.2).of_degree(0)
    blended = is_blended(hybrid)
    solid, soft = hybrid.take(~blended), hybrid.take(blended)
    view = dataset.test[0]
    exact = render(hybrid, view.camera, background=view.background, samples=2).color
    drawn = hybrid_image(solid, soft, view.camera, background=view.background, samples=2)
    assert psnr(drawn.astype(np.float32), exact) > 35


def test_opaque_triangles_of_a_hybrid_mesh_move_only_with_their_edges(foggy):
    dataset, mesh, _ = foggy
    config = make_config(steps=8, opacity="cutoff", soft_share=0.2)
    start = with_soft_splats(cut_mesh(mesh), mesh, dataset.train, 0.2)
    solid = np.isin(np.arange(len(start.vertices)), start.faces[solid_faces(start)])
    assert 0 < solid.sum() < len(solid)
    for step in (6, 7):  # means over pixels, and then values at their centres, which have no edges
        state = State.begin_hybrid(start, config, 1)
        make_step(state, dataset.train, step, step / 8, Hybrid(config))
        end = state.result()
        assert np.array_equal(end.vertices[solid], start.vertices[solid]) == (step == 7)
        assert (end.colors[solid, 3] == 1).all()
        assert (end.colors[solid, :3] != start.colors[solid, :3]).any()
        assert (end.vertices[~solid] != start.vertices[~solid]).any()
        assert (end.colors[~solid, 3] <= np.float32(254 / 255)).all()
        assert np.array_equal(solid_faces(end), solid_faces(start))


def test_the_initial_fraction_with_one_sample_does_not_begin_again_with_blended_triangles(foggy):
    dataset, _, _ = foggy
    photograph = replace(dataset.train[0], source=dataset.train[0].load())
    config = make_config(steps=8, opacity="cutoff", soft_share=0.2, one_sample_share=0.5)
    plans = [Hybrid(config).plan(photograph, step, step / 8) for step in (6, 7)]
    assert [plan.samples for plan in plans] == [2, 1]  # every other step is at the pixel centres


def test_colors_of_small_opaque_triangles_change_slowly_in_the_image():
    """A right triangle in each of four places, parallel to the image."""
    view = camera(64, 32)
    pixel = 4 / np.sqrt(view.fx * view.fy)  # at depth 4
    places = ((-2, 4, 8 * pixel), (0, 4, pixel), (2, 4, pixel), (0, -4, pixel))  # the last one behind it
    corners = [[(x, 0, z), (x + s, 0, z), (x, s, z)] for x, z, s in places]
    colors = np.full((12, 4), 0.5, np.float32)
    colors[::3, 0] = 0.8
    colors[:, 3] = np.repeat([1, 1, 0.9, 1], 3)
    faces = np.arange(12).reshape(4, 3)
    mesh = SplatMesh(np.reshape(corners, (12, 3)), faces, colors)
    changed = mesh.colors.copy()
    ColorLimits.measured(mesh, [View(view, ViewImage(np.zeros((32, 64, 3), np.float32)))]).apply(changed)
    # The second one is small, opaque and in the image. Its least height is 1 / sqrt(2) pixels.
    assert np.flatnonzero((changed != colors).any(axis=1)).tolist() == [3, 4, 5]
    assert changed[3:6].mean(axis=0) == pytest.approx(colors[3:6].mean(axis=0))
    assert np.ptp(changed[3:6, 0]) == pytest.approx(1.5 * COLOR_SLOPE / np.sqrt(2), rel=1e-4)
    assert np.array_equal(changed[4], changed[5])
    assert (changed[:, 1:] == colors[:, 1:]).all()


def test_colors_of_triangles_with_common_corners_come_within_their_limits():
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(6)), axis=-1).reshape(-1, 2)
    vertices = np.concatenate([0.1 * grid, np.full((36, 1), 4)], axis=1)
    a = (np.arange(5)[:, None] * 6 + np.arange(5)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + 6], 1), np.stack([a + 1, a + 7, a + 6], 1)])
    colors = np.concatenate([rng.random((36, 3)), np.ones((36, 1))], axis=1).astype(np.float32)
    view = camera(64, 32)
    limits = ColorLimits.measured(
        SplatMesh(vertices, faces, colors), [View(view, ViewImage(np.zeros((32, 64, 3), np.float32)))]
    )
    mean = colors.mean(axis=0)
    for _ in range(100):
        limits.apply(colors)
    corners = colors[faces, :3]
    most = np.abs(corners - corners.mean(axis=1, keepdims=True)).max()
    height = 0.1 / np.sqrt(2) * np.sqrt(view.fx * view.fy) / 4
    assert 0.5 * COLOR_SLOPE * height < most < 1.01 * COLOR_SLOPE * height
    assert colors.mean(axis=0) == pytest.approx(mean, abs=0.03)


def test_a_run_with_blended_triangles_limits_the_colors_of_opaque_ones(foggy):
    dataset, mesh, _ = foggy

    def beyond(mesh: SplatMesh) -> float:
        """Mean excess over the limits."""
        colors = mesh.colors.copy()
        ColorLimits.measured(mesh, dataset.train).apply(colors)
        return float(np.abs(colors - mesh.colors).mean())

    config = make_config(steps=20, opacity="cutoff", soft_share=0.2)
    opaque, hybrid = finetune(mesh, dataset, replace(config, soft_share=0)), finetune(mesh, dataset, config)
    assert beyond(opaque) > 5 * beyond(hybrid)


def test_limits_of_colors_follow_the_triangles_that_are_left(foggy):
    dataset, mesh, _ = foggy
    views = len(dataset.train)
    config = make_config(steps=8, opacity="cutoff", soft_share=0.2, prune_epochs=2 / views)
    start = with_soft_splats(cut_mesh(mesh), mesh, dataset.train, 0.2)
    moment, state = Moment(Clock(config, views), dataset.train, None), State.begin_hybrid(start, config, 1)
    phase, limits = Hybrid(config), []
    for moment.clock.step in range(1, 5):
        phase, state = phase.after_step(state, moment)
        limits.append(phase.limits)
        state.colors[state.mesh.faces[~solid_faces(state.result())][:9], 3] = 0
    assert len(state.mesh.faces) < len(start.faces)
    changed = [one is not two for one, two in pairwise(limits)]
    assert changed == [True, False, True]  # pruned after every second step


def square(x: float, depth: float, opacity: float) -> SplatMesh:
    """Red, of side 1."""
    corners = [(x + dx, dy, depth) for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    return SplatMesh(corners, [(0, 1, 2), (0, 2, 3)], [(1, 0, 0, opacity)] * 4)


def test_the_phases_of_a_run(scene):
    dataset, mesh = scene
    view = dataset.train[0]
    config = make_config(opacity="cutoff", soft_share=0.1, soft_phase=0.25)
    cutting, hybrid = Cutting(config, mesh), Hybrid(config)
    assert [cutting.share(f) for f in (0, 0.375, 0.75, 0.9)] == pytest.approx([0, 0.5, 1, 1])
    assert [hybrid.share(f) for f in (0.75, 0.875, 1)] == pytest.approx([0, 0.5, 1])
    assert hybrid.share(0.74) < 0
    # Learning rates begin again with the second phase.
    for phase, step, fraction, own in ((cutting, 300, 0.375, 300), (hybrid, 700, 0.875, 100)):
        plan = phase.plan(view, step, fraction)
        assert (plan.color_rate, plan.position_rate) == pytest.approx(learning_rates(config, own, 0.5))
    assert Cutting(make_config(opacity="cutoff"), mesh).share(0.9) == 0.9


def test_only_fans_that_beat_opaque_triangles_stay_blended():
    """Two splats side by side, the left one opaque in truth, the right one half transparent."""
    view = camera(16, 8)
    fans = [square(x, 3, opacity) for x, opacity in ((-1, 1.0), (1, 0.5))]
    start = SplatMesh(
        np.concatenate([f.vertices for f in fans]),
        np.concatenate([fans[0].faces, fans[1].faces + len(fans[0].vertices)]),
        np.concatenate([f.colors for f in fans]),
        face_splat=np.repeat([0, 1], [len(f.faces) for f in fans]),
    )
    target = render(start, view, background=(1, 1, 1))
    views = [View(view, ViewImage(target.color))]
    core = cut_mesh(start)
    scores = softness(core, start, views)
    assert scores[0] == pytest.approx(0, abs=1e-6)
    # Each sample loses (1 - 0.5)^2 in each of the channels that differ from white, and T a (1 - a) is 1/4.
    right = (target.color[:, 8:] < 0.99).any(axis=2).sum()
    assert scores[1] == pytest.approx(right * 0.25 * 2 * 0.25, rel=0.05)
    hybrid = with_soft_splats(core, start, views, 0.5)
    assert hybrid.face_splat[is_blended(hybrid)].tolist() == [1] * len(fans[1].faces)
    assert not is_blended(with_soft_splats(core, start, views, 0.4)).any()
    # Where the opaque triangles are right, none.
    views = [View(view, ViewImage(render(core, view, background=(1, 1, 1)).color))]
    assert softness(core, start, views)[1] < 0
    assert not is_blended(with_soft_splats(core, start, views, 0.5)).any()


@pytest.mark.slow
def test_opaque_triangles_move_to_where_their_edges_belong(monkeypatch):
    view = camera(96, 72, fx=90.0, fy=80.0)
    corners = np.array([(-0.5, -0.4, 2), (0.5, -0.3, 2), (0, 0.5, 2)])

    def triangle(points: np.ndarray) -> SplatMesh:
        return SplatMesh(points, [(0, 1, 2)], [(0.8, 0.1, 0.2, 1)] * 3)

    target = render(triangle(corners), view, samples=8).color
    views = (View(view, ViewImage(target)),)
    start = triangle(corners + np.array([0.06, 0.04, 0]))  # about 3 pixels
    config = make_config(steps=100, opacity="cutoff", anneal_share=0.1)

    def distance(mesh: SplatMesh) -> float:
        screen, truth = (view.project(points)[0] for points in (mesh.vertices, corners))
        return float(np.abs(screen - truth).max())

    moved = finetune(start, Dataset(views, ()), config)
    assert distance(moved) < 0.3
    # Nothing else draws it there.
    monkeypatch.setattr(Cutting, "_follows_edges", lambda *_: False)
    assert distance(finetune(start, Dataset(views, ()), config)) > 1
