"""Training on tiny scenes of known truth: quality, budget, near fields, bits, interruption, errors."""

from __future__ import annotations

import json
import signal
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from _balls import ball_view, cameras_around
from _gpu import need_gpu
from _photographs import write_photographs
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from meshsplats._core.kernels import round_fans
from meshsplats.cameras.files import load_cameras
from meshsplats.cli import main
from meshsplats.datasets.points import ScenePoints
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.datasets.views import Dataset, View, ViewImage, check_counting
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning, MissingDependencyError, OtherRunError
from meshsplats.evaluation.report import evaluate
from meshsplats.finetuning import Interrupted, RunOptions, finetune, make_config
from meshsplats.finetuning.config import HARMONICS_RATE
from meshsplats.finetuning.gradients import Gradients
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.phases.phase import Moment
from meshsplats.finetuning.reports import Reports
from meshsplats.finetuning.run import TrainingLoop, run_start
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import (
    BY_SPLAT_SHARE,
    ONE_SAMPLE_SHARE,
    PHOTOGRAPHS_HARMONICS_RATE,
    for_views,
    make_step,
)
from meshsplats.formats.gaussians import load_gaussians
from meshsplats.formats.meshes import load_mesh
from meshsplats.images.reading import load_image
from meshsplats.rendering import render, render_splats
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.rendering.previews import SIDE
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh
from meshsplats.training import growing, starting_fans, train, train_config
from meshsplats.training import run as run_module
from meshsplats.training.as_splats import HALVED, splats_of_fans
from meshsplats.training.exposures import exposures_differ
from meshsplats.training.growth import (
    HALF,
    NearFields,
    Scores,
    colors_at,
    fan_count,
    grow,
    score,
    select_fans,
    split_in_halves,
)
from meshsplats.training.initial import fans_of
from meshsplats.training.patches import Patches, flat_splats
from meshsplats.training.result_cameras import camera_files, save_result_cameras
from meshsplats.training.run import COVERAGE, SO_FAR, check_training_memory
from meshsplats.training.schedule import budget, events_passed, image_factor
from meshsplats.viewpoints.beside import cameras_beside

LAYERS = ("color", "alpha")
SMALL = {"start_splats": 150, "max_splats": 600, "growth_events": 3}


def views_of(count: int, seed: int, backdrop: bool) -> tuple:
    return tuple(ball_view(camera, backdrop=backdrop) for camera in cameras_around(count, seed=seed))


@pytest.fixture(scope="module")
def ball():
    return Dataset(views_of(20, 0, False), views_of(3, 1, False))


@pytest.fixture(scope="module")
def room():
    return Dataset(views_of(20, 0, True), views_of(3, 1, True)).over((0, 0, 0))


@pytest.fixture(scope="module")
def start(ball):
    return starting_fans(ball, train_config(steps=1, **SMALL))


@pytest.fixture(scope="module")
def found_patches():
    """By views and number; with the views, as else other ones could come to have their id."""
    return {}


@pytest.fixture
def start_found_once(found_patches, monkeypatch):
    """For tests of what follows: what photographs show is looked for once, not by each training."""
    from meshsplats.training import run

    look = run.starting_patches

    def patches(views, count, points, threads):
        key = (*map(id, views), count)
        if key not in found_patches:
            found_patches[key] = look(views, count, points, threads), views
        return found_patches[key][0]

    monkeypatch.setattr(run, "starting_patches", patches)


@pytest.fixture(scope="module")
def trained(ball):
    return train(ball, train_config(steps=120, **SMALL))


def same(a: SplatMesh, b: SplatMesh) -> bool:
    return all(
        np.array_equal(getattr(a, n), getattr(b, n))
        for n in ("vertices", "faces", "colors", "face_splat", "harmonics", "plain_colors")
    )


@pytest.fixture
def halted(monkeypatch, start):
    """A training ends with its look at the photographs, whose names the error has."""

    class HaltedError(Exception):
        pass

    def look(views):
        raise HaltedError(" ".join(view.name for view in views))

    monkeypatch.setattr(run_module, "starting_fans", lambda *given: start)
    monkeypatch.setattr(run_module, "find_suspects", look)
    return HaltedError


def test_held_out_photographs_are_looked_at_too(ball, halted):
    with pytest.raises(halted) as found:
        train(ball, steps=1)
    assert str(found.value).split() == [view.name for view in ball.views]


def blurred(layer: np.ndarray | None) -> np.ndarray | None:
    """An image layer (h, w, ...), each pixel the mean of 7 x 7; None for None."""
    if layer is not None:
        for axis in (0, 1):
            layer = np.mean([np.roll(layer, shift, axis) for shift in range(-3, 4)], axis=0)
    return layer


def lit(view: View, gain: float) -> View:
    """``view`` in other light."""
    image = view.load()
    return replace(view, source=replace(image, color=image.color * np.float32(gain)))


def psnr_of(mesh: SplatMesh, dataset: Dataset) -> float:
    return evaluate(mesh, dataset).method("mesh").mean("psnr")


# ---- What it is for


def test_a_ball_is_recovered_from_its_photographs(ball, start, trained):
    """On held-out views."""
    before, after = psnr_of(start, ball), psnr_of(trained, ball)
    assert after > 21.5
    assert after > before + 4


@pytest.mark.nightly
@pytest.mark.usefixtures("start_found_once")
def test_a_scene_without_masks_is_recovered_too(room):
    config = train_config(steps=100, start_splats=1500, max_splats=2000, growth_events=2)
    start, mesh = starting_fans(room, config), train(room, config)
    assert psnr_of(mesh, room) > psnr_of(start, room) + 2
    assert psnr_of(mesh, Dataset((), room.train)) > 17
    assert not mesh.attributes


@pytest.mark.nightly
@pytest.mark.usefixtures("start_found_once")
def test_growth_is_worth_its_fans(ball, trained):
    still = train(ball, train_config(steps=120, **SMALL | {"growth_events": 0}))
    assert fan_count(still) < fan_count(trained)
    assert psnr_of(trained, ball) > psnr_of(still, ball) + 0.5


@pytest.mark.slow
def test_the_budget_holds(ball, trained):
    assert fan_count(trained) == trained.splat_count <= 600
    tight = train(ball, train_config(steps=20, start_splats=600, max_splats=100))
    assert fan_count(tight) <= 100


# ---- Photographs that are not what they should be


def test_the_start_fills_the_budget():
    """But for masked photographs, whose fans growth puts where they are needed."""
    config = train_config(max_splats=1000)
    assert [config.first_splats(masked) for masked in (False, True)] == [1000, 400]
    assert train_config(max_splats=1000, start_splats=300).first_splats(False) == 300
    assert train_config(max_splats=1000, start_splats=3000).first_splats(True) == 1000
    assert train_config(max_splats=1).first_splats(True) == 1


def test_large_sets_of_photographs_have_more_fans():
    counts = {
        pixels: train_config().for_pixels(pixels).max_splats for pixels in (0, 5 * 10**7, 75 * 10**6, 10**9)
    }
    assert list(counts.values()) == [100_000, 100_000, 150_000, 200_000]
    assert train_config(max_splats=7).for_pixels(10**9).max_splats == 7
    assert train_config().first_splats(masked=False) == 100_000


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "other"), [("ball", 15), ("room", 13)])
def test_a_photograph_with_a_wrong_camera_is_named(scene, other, request):
    """The others still give a mesh, and none of them is named, not even blurred ones."""
    dataset = request.getfixturevalue(scene)
    views = list(dataset.train)
    views[7] = replace(views[7], source=views[other].source)
    for i in (3, 11):
        sharp = views[i].load()
        views[i] = replace(views[i], source=replace(sharp, **{n: blurred(getattr(sharp, n)) for n in LAYERS}))
    views = [view for i, view in enumerate(views) if i != 5]
    size = SMALL if scene == "ball" else {"start_splats": 1500, "max_splats": 2000, "growth_events": 2}
    with pytest.warns(DataWarning) as said:
        mesh = train(Dataset(tuple(views)), train_config(steps=120, **size))
    *early, last = [str(warning.message) for warning in said]
    assert any(line.startswith(f"duplicate photographs: 007 and 0{other}.") for line in early)
    assert last.startswith("1 of 19 photographs do not fit the others: 007.")
    assert psnr_of(mesh, dataset) > (19 if scene == "ball" else 14.5)


@pytest.mark.nightly
@pytest.mark.usefixtures("start_found_once")
def test_changing_light_is_fitted(ball):
    """Each photograph has a gain of its own; held-out views have their mean."""
    gains = np.random.default_rng(5).uniform(0.6, 1.0, len(ball.train))
    dataset = Dataset(
        tuple(lit(view, gain) for view, gain in zip(ball.train, gains, strict=True)),
        tuple(lit(view, gains.mean()) for view in ball.test),
    )
    plain, fitted = (
        train(dataset, train_config(steps=120, exposure=e, sh_degree=0, **SMALL)) for e in (False, True)
    )
    assert psnr_of(fitted, dataset) > psnr_of(plain, dataset) + 0.3


@pytest.mark.nightly
@pytest.mark.usefixtures("start_found_once")
def test_exposures_are_fitted_where_photographs_differ(ball, room):
    rng, size = np.random.default_rng(5), {"start_splats": 1500, "max_splats": 2000}
    for data in (ball, room):
        mesh = starting_fans(data, train_config(steps=1, **size))
        assert not exposures_differ(mesh, data.train)
        warm = [[gain, gain, 0.8] for gain in rng.uniform(0.6, 1.0, len(data.train))]
        for gains in (np.array(warm, np.float32), rng.uniform(0.6, 1.0, len(data.train))):
            changed = [lit(view, gain) for view, gain in zip(data.train, gains, strict=True)]
            assert exposures_differ(mesh, changed)
            assert not exposures_differ(mesh, changed[:2])  # too few to tell
    much = rng.uniform(0.3, 1.0, len(room.train))  # the start has half of it in its colours
    darker = Dataset(tuple(lit(view, gain) for view, gain in zip(room.train, much, strict=True)))
    with pytest.warns(DataWarning, match="differ in exposure or white balance"):
        fitted = train(darker, train_config(steps=3, sh_degree=0, **size))
    asked = train(darker, train_config(steps=3, sh_degree=0, exposure=True, **size))
    assert np.array_equal(fitted.colors, asked.colors)


@pytest.mark.slow
@pytest.mark.usefixtures("start_found_once")
def test_photographs_that_fit_are_not_named(ball, recwarn):
    train(ball, train_config(steps=60, **SMALL))
    assert not recwarn.list


# ---- Growth


@pytest.fixture
def state(ball, start) -> State:
    """Before the first step."""
    return State.begin(start, len(ball.train), train_config(steps=10, **SMALL), None)


def test_growth_halves_where_several_views_see_errors(ball, state):
    n = fan_count(state.mesh)
    found = score(state, ball.train)
    assert fan_count(grow(state, found, n + 50).mesh) == n + 50
    right = found._replace(error=np.zeros(n))  # without an error nothing is halved
    assert fan_count(grow(state, right, n + 50).mesh) == fan_count(grow(state, found, 0).mesh) <= n


def test_exposures_are_judged_as_those_of_photographs(ball, state):
    """Cut-out photographs of one exposure, over white: where it is known, errors are as without."""
    plain, offset = score(state, ball.train).error, np.float32(0.05)
    state.exposures = np.tile(np.array([0.8] * 3 + [offset] * 3, np.float32), (len(ball.train), 1))
    views = []
    for view in ball.train:
        image = view.load()
        color = image.color * np.float32(0.8) + offset * view.alpha[..., None]
        views.append(replace(view, source=replace(image, color=color)))
    assert np.allclose(score(state, views).error, plain * 0.8**2, rtol=1e-2, atol=1e-3 * plain.max())


def test_an_error_in_one_view_alone_halves_nothing(ball, state):
    bright = ball.train[4].load()
    views = list(ball.train)
    clean = score(state, views).error
    broken = replace(bright, color=np.clip(bright.color + 0.7, 0, 1), alpha=np.ones((64, 64), np.float32))
    views[4] = replace(views[4], source=broken)
    # All of it is in the largest term, which does not count: only what this view hides of others changes.
    assert score(state, views).error.sum() < 1.3 * clean.sum()


def test_fans_that_contribute_nothing_are_dropped(state):
    n = fan_count(state.mesh)
    useful = Scores(np.ones(n), np.full(n, 5.0), np.zeros(n), np.ones(n, bool), 64 * 64)
    faint = np.arange(n) < 10
    for worse in (
        useful._replace(most_pixels=np.where(faint, 0.001, 5.0)),
        useful._replace(clear_share=np.where(faint, 0.9, 0.0)),
    ):
        assert fan_count(grow(state, worse, 0).mesh) == n - 10
    unseen = useful._replace(most_pixels=np.zeros(n), in_view=np.zeros(n, bool))
    assert fan_count(grow(state, unseen, 0).mesh) == n
    state.colors[:7, 3] = 0  # all of the first fan
    assert fan_count(grow(state, useful, 0).mesh) == n - 1


def test_what_only_other_views_show_is_not_dropped(ball, state):
    """As where the judged views look at the back of a wall, which the view of a step has shown."""
    n = fan_count(state.mesh)
    hidden = Scores(np.ones(n), np.zeros(n), np.zeros(n), np.ones(n, bool), 64 * 64)
    left = np.broadcast_to(np.arange(64) < 32, (64, 64))
    white = ViewImage(np.ones((64, 64, 3), np.float32), mask=left)  # wrong everywhere, and nowhere too bright
    view = replace(ball.train[0], source=white)
    pixels = score(state, [view]).most_pixels
    assert make_step(state, [view], 0, 0.0, Blended(state.config)) is not None
    vertices = {tuple(fan[0]) for fan in grow(state, hidden, 0).vertices.reshape(-1, 7, 3)}
    kept = np.array([tuple(fan[0]) in vertices for fan in state.vertices.reshape(-1, 7, 3)])
    assert kept[pixels > 1].all()
    assert not kept[pixels < 0.01].any()
    assert min(np.count_nonzero(pixels > 1), np.count_nonzero(pixels < 0.01)) > 20
    # At the next event it is what later steps have shown that counts: here none.
    again = grow(state, hidden._replace(most_pixels=np.ones(n)), 0)
    n = fan_count(again.mesh)
    shell = np.repeat((np.arange(n) < 5).astype(np.float32), 7)
    again.mesh = replace(again.mesh, attributes=again.mesh.attributes | {"shell": shell})
    later = Scores(np.ones(n), np.zeros(n), np.zeros(n), np.ones(n, bool), 64 * 64)
    assert fan_count(grow(again, later, 0).mesh) == 5


def test_what_steps_show_at_every_event_is_kept_at_every_event(ball, state):
    """However strong its gradients were before: the moments of a step forget soon."""
    n = fan_count(state.mesh)
    hidden = Scores(np.ones(n), np.zeros(n), np.zeros(n), np.ones(n, bool), 64 * 64)
    white = replace(ball.train[0], source=ViewImage(np.ones((64, 64, 3), np.float32)))
    steps = Blended(state.config)
    counts = []
    for _ in range(4):
        for _ in range(12):
            assert make_step(state, [white], 0, 0.0, steps) is not None
        state = grow(state, hidden, 0)
        n = fan_count(state.mesh)
        hidden = Scores(*(part[:n] for part in hidden[:4]), hidden.image_pixels)
        counts.append(n)
    assert min(counts) > 0.9 * counts[0]


def test_a_sign_before_a_street_is_in_no_near_field():
    """Its fans fill the photographs taken of it. Those of sixty fronts behind it are far more."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 8)]), axis=-1).reshape(-1, 2)
    walls = [(1, 0.45), *((12 + 2 * k, 5) for k in range(60))]
    points = np.concatenate([np.column_stack([half * grid, np.full(64, z)]) for z, half in walls])
    facing = np.tile([0.0, 0, -1], (len(points), 1))
    mesh = fans_of(flat_splats(Patches.squares(points, facing, 0.15, 0.95)), 6)
    views = [View(Camera(np.eye(4), 40, 40, 20, 20, 40, 40), ViewImage(np.zeros((40, 40, 3), np.float32)))]
    near = NearFields.around(views, mesh)
    assert near.depths == pytest.approx([0.3], rel=1e-3)
    assert not near.contain(mesh).any()


def test_halves_have_the_place_and_colours_of_their_fan(state):
    n = fan_count(state.mesh)
    halved = select_fans(state, np.arange(n), np.array([3, 8]))
    k = 7
    before = state.vertices.reshape(n, k, 3)
    after = halved.vertices.reshape(n + 2, k, 3)
    rest = np.setdiff1d(np.arange(n), [3, 8])
    assert np.array_equal(after[rest], before[rest])
    for fan, other in ((3, n), (8, n + 1)):
        pair = after[[fan, other]]
        assert np.allclose(pair.reshape(-1, 3).mean(axis=0), before[fan].mean(axis=0), atol=1e-6)
        assert np.linalg.norm(pair[0, 0] - pair[1, 0]) > 0
        opacities = halved.colors.reshape(n + 2, k, 4)[other, :, 3]
        assert np.array_equal(opacities, state.colors.reshape(n, k, 4)[fan, :, 3])
    assert (halved.sizes.reshape(n + 2, k)[[3, n]] < state.sizes.reshape(n, k)[3]).all()


def test_halves_show_what_their_fan_showed_in_their_place():
    """A fan whose colours are a linear function of the place: its halves have the same function."""
    turn = 2 * np.pi * np.arange(6) / 6
    rim = np.stack([2 * np.cos(turn), np.sin(turn), 0.5 * np.cos(turn)], axis=1)
    fan = np.concatenate([[[0.0, 0, 0]], rim])[None] + [3.0, 1, 2]
    inside = np.random.default_rng(0).uniform(-0.4, 0.4, (1, 20, 2))
    points = fan[:, :1] + inside[..., :1] * rim[0] + inside[..., 1:] * rim[2]
    slope = np.array([[0.1, 0.0, 0.2], [0.3, -0.1, 0.0], [0.0, 0.05, -0.1]])
    found = colors_at(fan, fan @ slope, points)
    assert found == pytest.approx(points @ slope, abs=1e-6)
    # Beside the fan: those of the nearest place on its edge, never beyond the range of its corners.
    outside = colors_at(fan, fan @ slope, fan[:, :1] + 5 * (points - fan[:, :1]))
    assert (outside.max(axis=1) <= (fan @ slope).max(axis=1) + 1e-6).all()


def test_the_shell_is_never_dropped(state):
    n = fan_count(state.mesh)
    hidden = Scores(np.ones(n), np.zeros(n), np.zeros(n), np.ones(n, bool), 64 * 64)
    shell = np.repeat((np.arange(n) < 5).astype(np.float32), 7)
    state.mesh = replace(state.mesh, attributes={"shell": shell})
    kept = grow(state, hidden, 0)
    assert fan_count(kept.mesh) == 5
    assert kept.mesh.attributes["shell"].all()


def test_no_fan_is_in_a_near_field(ball, start, trained):
    near = NearFields.around(ball.train, start)
    assert (near.depths > 0.3).all()
    assert (near.depths < 2).all()
    assert not near.contain(trained).any()
    # One that is put there is found, even right in front of the lens.
    camera = ball.train[2].camera
    for share in (0.9, 0.01):
        stray = start.vertices.copy()
        place = camera.center + share * near.depths[2] * camera.world_to_camera[2, :3]
        stray[:7] += (place - stray[0]).astype(np.float32)
        assert near.contain(replace(start, vertices=stray)).nonzero()[0].tolist() == [0]


def test_a_stray_in_a_near_field_does_not_survive(ball, start, monkeypatch):
    """Wherever it starts: it is gone from the result."""
    from meshsplats.training import run

    camera = ball.train[2].camera
    stray = start.vertices.copy()
    place = camera.center + 0.3 * camera.world_to_camera[2, :3]
    stray[:7] += (place - stray[0]).astype(np.float32)
    monkeypatch.setattr(run, "starting_fans", lambda *_: replace(start, vertices=stray))
    mesh = train(ball, train_config(steps=3, **SMALL | {"growth_events": 0}))
    assert fan_count(mesh) == fan_count(start) - 1


# ---- Opacities


def test_opacities_decay_where_a_view_reaches_them(ball, start):
    """By their share, in proportion to the learning rate."""
    reached = np.arange(len(start.vertices)) % 3 == 1
    colors = np.zeros((len(reached), 4), np.float32)
    colors[reached] = [1e-3, 0, 0, -1e-3]
    start = start.of_degree(0)
    after = []
    for decay in (0.0, 0.2):
        config = train_config(steps=10, opacity_decay=decay, soft_edges=False)
        state = State.begin(start, len(ball.train), config, None)
        state.step(Gradients(np.zeros_like(start.vertices), colors.copy()), 0.5 * config.color_rate, 0.0, 0)
        after.append(state.colors)
    whole, decayed = after
    assert np.array_equal(decayed[~reached], start.colors[~reached])
    assert np.array_equal(decayed[:, :3], whole[:, :3])
    np.testing.assert_allclose(decayed[reached, 3], 0.9 * whole[reached, 3], rtol=1e-6)
    assert (whole[reached, 3] > 0).any()


# ---- Shapes


def rims(sides: int) -> np.ndarray:
    """(sides, 3) float64: a constant, cosines and sines of a regular polygon; affine images combine them."""
    angle = 2 * np.pi * np.arange(sides) / sides
    return np.stack([np.ones(sides), np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("sides", [3, 4, 6, 9, 16])
def test_fans_move_to_the_nearest_ellipse(sides):
    """By a share of the distance; the nearest affine image of a regular polygon is that of least squares."""
    rng = np.random.default_rng(sides)
    fans = (rng.normal(size=(50, 1 + sides, 3)) + 10 * rng.normal(size=(50, 1, 3))).astype(np.float32)
    rim = fans[:, 1:].astype(np.float64)
    found = np.linalg.lstsq(rims(sides), rim.transpose(1, 0, 2).reshape(sides, -1), rcond=None)[0]
    nearest = (rims(sides) @ found).reshape(sides, 50, 3).transpose(1, 0, 2)
    expected = np.concatenate([rim.mean(axis=1, keepdims=True), nearest], axis=1)
    for share in (0.0, 0.25, 1.0):
        moved = fans.copy()
        round_fans(moved, share)
        np.testing.assert_allclose(moved, fans + share * (expected - fans), rtol=0, atol=1e-5)


@given(
    arrays(np.float64, (3, 3), elements=st.floats(-100, 100)),
    st.integers(3, 16),
    st.floats(0, 1),
    st.floats(-3, 3),
)
def test_ellipses_stay_whatever_their_affine_map_and_phase(affine, sides, share, phase):
    turned = np.array([[1, 0, 0], [0, np.cos(phase), -np.sin(phase)], [0, np.sin(phase), np.cos(phase)]])
    rim = rims(sides) @ turned @ affine
    fan = np.concatenate([affine[:1], rim])[None].astype(np.float32)
    moved = fan.copy()
    round_fans(moved, share)
    np.testing.assert_allclose(moved, fan, rtol=0, atol=1e-6 * (1 + np.abs(affine).sum()))


def test_rounding_has_the_same_bits_with_any_number_of_threads():
    fans = np.random.default_rng(0).normal(size=(10_000, 7, 3)).astype(np.float32)
    results = [fans.copy() for _ in range(3)]
    for threads, result in zip((1, 2, 5), results, strict=True):
        round_fans(result, 0.3, threads)
    assert not np.array_equal(results[0], fans)
    assert all(np.array_equal(results[0], other) for other in results[1:])


def test_shapes_decay_in_each_step_as_the_learning_rate_falls(ball, start):
    """Steps without gradients of positions: each takes its share of the distance."""
    bent = start.vertices.copy()
    bent += 0.1 * np.random.default_rng(3).normal(size=bent.shape).astype(np.float32)
    bent = replace(start, vertices=bent)
    options = {"position_rate": 0.0, "rate_steps": 0, "shape_decay": 0.4, "final_share": 0.25}
    config = train_config(steps=4, **SMALL | {"growth_events": 0}, **options)
    run = RunOptions(report_every=0)
    begun = run_start(bent, ball, config, run, None)
    phase = growing.Growing(config, bent, begun.dataset.train, 0.0, 0)
    mesh = TrainingLoop(begun, begun.clock(run), phase, run).run()
    ellipses = bent.vertices.reshape(-1, 7, 3).copy()
    round_fans(ellipses, 1.0)
    left = np.prod([1 - 0.4 * 0.25 ** (step / 4) for step in range(1, 5)])
    distance = bent.vertices - ellipses.reshape(-1, 3)
    assert len(mesh.vertices) == len(bent.vertices)
    np.testing.assert_allclose(mesh.vertices, ellipses.reshape(-1, 3) + left * distance, rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.usefixtures("start_found_once")
def test_fans_of_a_training_are_nearly_ellipses(trained, ball):
    def distance(mesh: SplatMesh) -> float:
        fans = mesh.vertices.reshape(-1, 7, 3)
        ellipses = fans.copy()
        round_fans(ellipses, 1.0)
        extent = np.square(fans - fans.mean(axis=1, keepdims=True)).sum()
        return float(np.square(fans - ellipses).sum() / extent)

    free = train(ball, train_config(steps=120, shape_decay=0.0, **SMALL))
    assert distance(trained) < 0.01 < 0.05 < distance(free)


# ---- Schedule


def test_photographs_have_one_sample_a_pixel_at_first(ball, start, monkeypatch):
    drawn = []

    def noted(state, camera, options, *rest):
        drawn.append(options.samples)
        return real(state, camera, options, *rest)

    real = State.tape
    monkeypatch.setattr(State, "tape", noted)
    finetune(start, ball, make_config(steps=4, one_sample_share=0.5), run=RunOptions(report_every=0))
    finetune(
        start, ball, make_config(steps=2, one_sample_share=0.5, samples=3), run=RunOptions(report_every=0)
    )
    assert drawn == [1, 1, 2, 2, 3, 3]


def test_what_follows_from_the_kind_of_views(ball, room):
    """Photographs with and without alpha, and images of splats."""
    drawn = splat_dataset(make_scene(200), train=2, test=1, width=16, placement="object")
    for data, one_sample, by_splat, rate in (
        (ball, 0.0, BY_SPLAT_SHARE, PHOTOGRAPHS_HARMONICS_RATE),
        (room, ONE_SAMPLE_SHARE, BY_SPLAT_SHARE, PHOTOGRAPHS_HARMONICS_RATE),
        (drawn, 0.0, 0.0, HARMONICS_RATE),
    ):
        for config in (train_config(), make_config()):
            found = for_views(config, data.train)
            assert (found.one_sample_share, found.by_splat_share) == (one_sample, by_splat)
        assert found.harmonics_rate == rate
        assert for_views(train_config(), data.train).harmonics_rate == HARMONICS_RATE
        assert for_views(make_config("paper"), data.train) == make_config("paper")
        cut = for_views(make_config(opacity="cutoff"), data.train)
        assert (cut.one_sample_share, cut.by_splat_share) == (0.0, None)
        given = train_config(one_sample_share=0.3, by_splat_share=0.2, dropout=0.1)
        assert for_views(given, data.train) == given


@pytest.mark.usefixtures("start_found_once")
def test_steps_and_growth_draw_as_many_samples(room, monkeypatch):
    drawn = []

    def noted(self, *arguments, **options):
        if len(arguments) > 2:  # the first colours are found without options
            drawn.append(arguments[2].samples)
        return tape(self, *arguments, **options)

    tape = CpuEngine.tape
    changes = {**SMALL, "steps": 10, "growth_events": 1, "growth_end": 0.5, "sh_degree": 0}
    monkeypatch.setattr(CpuEngine, "tape", noted)
    train(Dataset(room.train), train_config(**changes))
    judged = len(room.train)
    assert drawn == [1] * (9 + judged) + [2]


@pytest.mark.usefixtures("start_found_once")
@pytest.mark.parametrize("order", ["mesh", "splat"])
def test_fans_are_blended_whole_at_first_and_in_their_final_order_then(room, monkeypatch, order):
    drawn, scored = [], []

    def noted(self, triangles, *more, **options):
        if more[1:]:
            drawn.append(triangles.order)
        return tape(self, triangles, *more, **options)

    def noted_scores(self, mesh, *more):
        scored.append(mesh.order)
        return scores(self, mesh, *more)

    tape, scores = CpuEngine.tape, Reports.scores
    monkeypatch.setattr(CpuEngine, "tape", noted)
    monkeypatch.setattr(Reports, "scores", noted_scores)
    changes = {
        **SMALL,
        "steps": 10,
        "growth_events": 0,
        "sh_degree": 0,
        "by_splat_share": 0.6,
        "order": order,
    }
    mesh = train(room, train_config(**changes), run=RunOptions(report_every=5))
    last = "splat" if order == "splat" else "fragment"
    assert drawn == ["splat"] * 6 + [last] * 4
    assert scored == [last] * 3
    assert mesh.order == last


def test_fine_tuning_on_photographs_blends_fans_whole_at_first_too(start, ball, monkeypatch):
    drawn = []

    def noted(self, triangles, *more, **options):
        drawn.append(triangles.order)
        return tape(self, triangles, *more, **options)

    tape = CpuEngine.tape
    monkeypatch.setattr(CpuEngine, "tape", noted)
    frozen = np.zeros(len(start.vertices), bool)
    frozen[::2] = True
    for changes, first in (({}, 6), ({"by_splat_share": 0.0}, 0), ({"order": "splat"}, 10)):
        drawn.clear()
        config = make_config(steps=10, prune_epochs=0.1, **changes)
        mesh = finetune(start, ball, config, run=RunOptions(report_every=0), frozen=frozen)
        assert drawn[:10] == ["splat"] * first + ["fragment"] * (10 - first)  # then plain colours
        assert mesh.order == ("splat" if first == 10 else "fragment")
        kept = np.flatnonzero(frozen)
        assert np.isin(start.vertices[kept][:20], mesh.vertices).all()


def test_the_unit_of_the_scene_does_not_matter(start):
    """Neither Adam's epsilon nor a rate has the dimension of a length."""
    config, moved = make_config(steps=12, epsilon=train_config().epsilon), []
    for scale in (1.0, 1024.0):
        cameras = cameras_around(6, scale=scale)
        views = tuple(ball_view(camera, scale) for camera in cameras)
        mesh = replace(start, vertices=start.vertices * np.float32(scale))
        tuned = finetune(mesh, Dataset(views), config)
        moved.append((tuned.vertices - mesh.vertices) / np.float32(scale))
    size = np.abs(moved[0]).mean()
    assert size > 1e-3
    assert np.abs(moved[1] - moved[0]).mean() < 0.05 * size


def test_the_schedule_grows_images_and_budget():
    config = train_config(steps=100, max_splats=1000, growth_events=5, growth_end=0.5, half_share=0.4)
    assert [image_factor(config, f) for f in (0, 0.0999, 0.1, 0.3999, 0.4, 1)] == [
        *(0.25, 0.25, 0.5),
        *(0.5, 1.0, 1.0),
    ]
    passed = [events_passed(config, step / 100) for step in range(101)]
    assert [passed.index(i) for i in range(1, 6)] == [10, 20, 30, 40, 50]
    assert max(passed) == 5
    budgets = [budget(config, event, 100) for event in range(1, 6)]
    assert budgets == sorted(budgets)
    assert budgets[-1] == 1000
    assert max(budget(config, event, 3000) for event in range(1, 6)) <= 1000


# ---- Runs


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_with_any_number_of_threads(ball, request):
    config = train_config(steps=12, **SMALL)
    meshes = [train(ball, config, run=RunOptions(threads=n)) for n in (1, 2)]
    assert same(*meshes)
    request.getfixturevalue("start_found_once")  # by another test: only the steps are of another seed
    assert not same(meshes[0], train(ball, replace(config, seed=1)))


@pytest.mark.slow
@pytest.mark.usefixtures("start_found_once")
def test_a_resumed_run_ends_with_the_same_bits(ball, tmp_path):
    """Stopped before, between and after growth, with exposures; each time the mesh so far is there."""
    config = train_config(steps=24, exposure=True, **SMALL)
    whole = train(ball, config, run=RunOptions(tmp_path / "whole"))
    folder = tmp_path / "run"
    for stop in (2, 7, 20):

        def after(progress, stop=stop):
            if progress.step == stop:
                signal.raise_signal(signal.SIGINT)

        resume = folder.exists()
        with pytest.raises(Interrupted):
            train(ball, config, run=RunOptions(folder, resume), on_progress=after)
        so_far = load_mesh(folder / SO_FAR)
        assert 0 < fan_count(so_far) <= 600
    assert same(train(ball, config, run=RunOptions(folder, resume=True)), whole)
    assert not (folder / SO_FAR).exists()  # it would be that of the last interruption
    with pytest.raises(OtherRunError, match="max_splats was 600 and is 700"):
        train(ball, replace(config, max_splats=700), run=RunOptions(folder, resume=True))


@pytest.mark.parametrize("shift", [(0, 0, 0), (4.5e5, 5.1e6, 90.0), (0, 1e5, 0)])
def test_points_beside_the_scene_are_named(ball, monkeypatch, recwarn, shift):
    """Of georeferenced photographs, for instance, loaded without the origin of the data set."""
    from meshsplats.training import run

    def begin(*_):
        raise RuntimeError("began")

    monkeypatch.setattr(run, "starting_fans", begin)
    rng = np.random.default_rng(0)
    colors, shown = np.full((500, 3), 128, np.uint8), np.full(500, 3)
    positions = rng.normal(scale=0.2, size=(500, 3)) + shift
    with pytest.raises(RuntimeError, match="began"):
        train(ball, train_config(steps=1, **SMALL), points=ScenePoints(positions, colors, shown))
    said = [str(one.message) for one in recwarn if "of the points" in str(one.message)]
    assert [text[:39] for text in said] == ["100% of the points lie where no photogr"] * any(shift)
    positions[7, 1] = np.nan
    with pytest.raises(ValueError, match="points must be finite, 1 of 500 are not"):
        train(ball, train_config(steps=1, **SMALL), points=ScenePoints(positions, colors, shown))


def test_bad_input_is_refused_before_the_work(ball, tmp_path):
    with pytest.raises(ValueError, match="at least 2 training views"):
        train(Dataset(ball.train[:1]), train_config(steps=1))
    with pytest.raises(ValueError, match="sides must be a whole number from 3 to 16"):
        train_config(sides=2)
    with pytest.raises(ValueError, match="opacity must be 'blended'"):
        train_config(opacity="cutoff")
    with pytest.raises(ValueError, match="blending must be 'mesh' while training"):
        train_config(blending="linear")
    for name, value in (("prune_opacity", 0.1), ("prune_epochs", 2)):
        with pytest.raises(ValueError, match=f"{name} must be"):
            train_config(**{name: value})
    with pytest.raises(ValueError, match=r"point_share must be 0\.4"):
        train_config(point_share=0.1)
    with pytest.raises(TypeError, match="did you mean 'max_splats'"):
        train_config(max_splat=3)
    with pytest.raises(FileNotFoundError, match=r"no .*start\.npz: leave out ``resume``"):
        train(ball, train_config(steps=1), run=RunOptions(tmp_path / "none", resume=True))


def test_halves_lie_side_by_side_along_the_longest_axis():
    rim = [(2, 0, 0), (0, 1, 0), (-2, 0, 0), (0, -1, 0)]
    fan = np.float32([[(0, 0, 0), *rim]]) + np.float32([3, 1, 2])
    right, left = split_in_halves(fan)
    if right[0, :, 0].mean() < left[0, :, 0].mean():
        right, left = left, right
    reach = lambda half, axis: (half[0, :, axis].min(), half[0, :, axis].max())  # noqa: E731
    assert reach(right, 0) == pytest.approx((3 - 0.4, 5), abs=1e-5)
    assert reach(left, 0) == pytest.approx((1, 3 + 0.4), abs=1e-5)
    for half in (right, left):
        assert reach(half, 1) == pytest.approx((0, 2), abs=1e-5)
        assert half[0, :, 2] == pytest.approx(2, abs=1e-5)
    assert pytest.approx(0.6) == HALF


def test_a_missing_gpu_is_found_before_the_work(ball, tmp_path, monkeypatch):
    """And before files of an earlier run are deleted."""
    from meshsplats.rendering import gpu
    from meshsplats.training import run

    def fail(*_):
        raise AssertionError

    def no_gpu():
        raise MissingDependencyError("no GPU was found")

    monkeypatch.setattr(run, "starting_fans", fail)
    monkeypatch.setattr(gpu, "open_device", no_gpu)
    with pytest.raises(MissingDependencyError, match="no GPU"):
        train(ball, train_config(steps=1), run=RunOptions(tmp_path / "run", device="gpu"))
    assert not (tmp_path / "run").exists()


@pytest.mark.nightly
def test_training_on_the_gpu_is_that_of_the_processor(ball, monkeypatch):
    """Steps stay there: arrays come back when fans grow, and at the end."""
    need_gpu()
    from meshsplats.webgpu.training import Trainer

    fetched = []
    plain = Trainer.fetch
    monkeypatch.setattr(Trainer, "fetch", lambda self, into: (fetched.append(1), plain(self, into)))
    config = train_config(steps=4, **SMALL | {"growth_events": 1})
    found = {
        device: train(ball, config, run=RunOptions(device=device, report_every=0))
        for device in ("gpu", "cpu")
    }
    assert 1 <= len(fetched) <= 4
    images = {device: render(mesh, ball.test[0].camera).color for device, mesh in found.items()}
    start = render(starting_fans(ball, config), ball.test[0].camera).color
    apart = np.linalg.norm(images["gpu"] - images["cpu"])
    assert apart < 0.02 * np.linalg.norm(images["cpu"] - start)


def test_no_growth_event_happens_twice(ball, start, monkeypatch):
    """In a run by minutes, the share that is over may fall."""
    config, options = train_config(steps=60, **SMALL), RunOptions()
    begun = run_start(start, ball, config, options, None)
    views, clock, state = begun.dataset.train, begun.clock(options), begun.state
    phase, grown = growing.Growing(config, start, views, 0.0, 0), []
    monkeypatch.setattr(growing, "grow", lambda state, *_: grown.append(clock.step) or state)
    for clock.step in (9, 11, 9, 11, 21):
        _, state = phase.after_step(state, Moment(clock, views, None))
    assert grown == [11, 21]


def test_a_long_search_for_cameras_leaves_the_whole_schedule(ball, start, monkeypatch):
    """Growth, small images and high rates come first, whatever came before."""
    config, phases = train_config(minutes=10, **SMALL), []
    monkeypatch.setattr(run_module, "starting_fans", lambda *_: start)

    def begun(*given):
        phases.append((growing.Growing(*given), given[3]))
        raise InterruptedError

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "Growing", begun)
        with pytest.warns(DataWarning, match="before the first step"), suppress(InterruptedError):
            train(ball, config, run=RunOptions(spent=420))
    ((phase, fraction),) = phases
    assert fraction < 0.1
    assert phase._events == 0
    late = RunOptions(spent=480, report_every=0)
    with pytest.warns(DataWarning, match=r"8\.\d of 8 minutes were spent before the first step: allow more"):
        train(ball, replace(config, minutes=8), run=late)


def test_masks_that_are_dark_throughout_are_refused(ball):
    none = np.zeros((64, 64), bool)
    views = [replace(view, source=replace(view.load(), mask=none)) for view in ball.train]
    with pytest.raises(ValueError, match=r"all pixels of the 20 training views are masked out"):
        train(Dataset(tuple(views)), train_config(steps=1, **SMALL))
    views[7] = ball.train[7]
    check_counting(views)


def test_the_estimate_of_memory_holds_reduced_images_and_silhouettes(ball, room):
    """Reduced images have more bytes a pixel than photographs."""
    config = train_config(start_splats=2, max_splats=2)
    pixels = 64 * 64 * len(room.train)

    photographs = Dataset(tuple(replace(view, source=Photograph(view)) for view in room.train))
    most, least = (check_training_memory(photographs, config, cache_bytes=n) for n in (10**9, 0))
    assert most - least >= (3 + 8 * (1 / 4 + 1 / 16)) * pixels
    many = train_config(start_splats=10**6, max_splats=10**6)
    bare, masked = (check_training_memory(data, many, cache_bytes=0) for data in (room, ball))
    assert masked > bare + 10**9


class Photograph:
    """An image of 8 bits a value."""

    def __init__(self, view) -> None:
        self.image = ViewImage((255 * view.load().color).astype(np.uint8))
        self.nbytes = self.image.nbytes

    def load(self) -> ViewImage:
        return self.image


def test_memory_is_estimated_up_front(ball, monkeypatch):
    from meshsplats.finetuning import memory

    monkeypatch.setattr(memory, "available_memory", lambda: 10**8)
    with pytest.raises(MemoryError, match=r"training 100,000 fans on 23 images needs about .*``max_splats``"):
        train(ball, train_config(steps=1))


@pytest.mark.usefixtures("start_found_once")
def test_a_resumed_run_keeps_its_shell(room, tmp_path, monkeypatch):
    """The same bits as without a stop, where fans of the shell would be dropped."""
    from meshsplats.training import run

    room = Dataset(room.train[:8])
    config = train_config(steps=10, start_splats=300, max_splats=400, growth_events=2, exposure=False)
    start = starting_fans(room, config)
    fans = start.vertices.reshape(-1, 7, 3).copy()
    shell = start.attributes["shell"].reshape(-1, 7)[:, 0] > 0
    fans[shell] = fans[shell, :1] + np.float32(1e-4) * (fans[shell] - fans[shell, :1])  # no pixel shows them
    start = replace(start, vertices=fans.reshape(-1, 3))
    monkeypatch.setattr(run, "starting_fans", lambda *_: start)
    whole = train(room, config)

    def stop(progress):
        if progress.step == 1:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        train(room, config, run=RunOptions(tmp_path / "run"), on_progress=stop)
    assert same(train(room, config, run=RunOptions(tmp_path / "run", resume=True)), whole)


def test_a_new_run_removes_the_mesh_of_an_earlier_one(ball, start, tmp_path, monkeypatch):
    from meshsplats.training import run

    monkeypatch.setattr(run, "starting_fans", lambda *_: start)
    tmp_path.joinpath(SO_FAR).write_bytes(b"")
    tmp_path.joinpath("mesh.npz").write_bytes(b"mine")

    def fail(_progress):
        raise RuntimeError("crashed")

    config = train_config(steps=2, **SMALL)
    with pytest.raises(FileExistsError, match=f"{SO_FAR} is not of an earlier run and would be replaced"):
        train(ball, config, run=RunOptions(tmp_path), on_progress=fail)
    tmp_path.joinpath("config.json").write_text(json.dumps(config.to_dict()))
    with pytest.raises(RuntimeError, match="crashed"):
        train(ball, config, run=RunOptions(tmp_path), on_progress=fail)
    assert not (tmp_path / SO_FAR).exists()
    assert load_image(tmp_path / COVERAGE).shape[2] == 3
    assert tmp_path.joinpath("mesh.npz").read_bytes() == b"mine"


# ---- As splats


def test_fans_become_the_splats_that_they_were_made_of(trained):
    rng = np.random.default_rng(0)
    cloud = splats_of_fans(trained)
    assert len(cloud) == fan_count(trained)
    flat = replace(
        cloud,
        scales=np.sort(rng.uniform(0.05, 0.3, cloud.scales.shape), axis=1) * [0, 1, 1],
        opacities=rng.uniform(0.1, 0.7, len(cloud)),
        kernel="2dgs",
    ).take(np.arange(100))
    # Fans drop the smallest axis, whichever it is.
    flat = replace(flat, kernel="3dgs")
    again = splats_of_fans(fans_of(flat, 8))
    assert np.allclose(again.means, flat.means, atol=1e-5)
    assert np.allclose(again.colors, flat.colors, atol=1e-5)
    assert np.allclose(again.scales[:, 1:], flat.scales[:, 1:], rtol=1e-3)

    def spread(c):
        return np.einsum("nij,nj,nkj->nik", c.rotations, np.square(c.scales * [0, 1, 1]), c.rotations)

    assert np.allclose(spread(again), spread(flat), atol=1e-5)


def test_splats_of_a_training_look_like_it(ball, trained):
    view = ball.test[0]
    image = render_splats(splats_of_fans(trained), view.camera, dilation=0.02, samples=2).color
    assert -10 * np.log10(np.square(image - view.image).mean()) > 16


def test_other_meshes_do_not_become_splats(trained):
    for mesh in (
        replace(trained, face_splat=None, harmonics=None),
        trained.take(np.arange(len(trained.faces)) != 5),
    ):
        with pytest.raises(ValueError, match="not a mesh of equal fans"):
            splats_of_fans(mesh)


# ---- The command


@pytest.mark.slow
def test_the_command_trains_and_writes_splats(ball, tmp_path, capsys):
    views = ball.train[:12]
    images = [straight(view) for view in views]
    folder = write_photographs(tmp_path / "photos", [view.camera for view in views], images)
    out, splats = tmp_path / "mesh.npz", tmp_path / "splats.ply"
    words = ["train", str(folder), "-o", str(out), "--steps", "12", "--start-splats", "300"]
    words += ["--max-splats", "500", "--as-splats", str(splats), "--json"]
    assert main(words) == 0
    mesh = load_mesh(out)
    assert fan_count(mesh) <= 500
    assert len(load_gaussians(splats)) == fan_count(mesh) + int(HALVED * fan_count(mesh))
    for name in ("config.toml", "preview.png"):
        assert (tmp_path / f"mesh.npz.{name}").is_file()
    records = [str(path) + ".cameras.json" for path in (out, splats)]
    assert json.loads(capsys.readouterr().out)["cameras"] == records
    with Image.open(tmp_path / "mesh.npz.preview.png") as preview:  # from the first held-out photograph
        seen = views[0].camera
        large = seen.scaled(SIDE / max(seen.width, seen.height))
        assert preview.size == (large.width, large.height)
    np.testing.assert_allclose(mesh.up, [0, 0, 1], atol=0.1)  # as the cameras are held
    assert main(words) == 3  # what is there is not overwritten
    assert main(["train", str(folder), "-o", str(tmp_path / "b.npz"), "--as-splats", "b.obj"]) == 2
    for option in ("--blending", "--prune-opacity", "--point-share", "--cutoff", "--soft-share"):
        assert main([*words, "--force", option, "0.5"]) == 2  # options without effect do not exist
    capsys.readouterr()


@pytest.mark.parametrize(("minutes", "takes_steps"), [("0.05", True), ("0.0001", False)])
def test_the_command_takes_steps_while_there_is_time(
    ball, start, tmp_path, monkeypatch, capsys, minutes, takes_steps
):
    monkeypatch.setattr("meshsplats.training.run.starting_fans", lambda *_: start)
    views = ball.train[:4]
    folder = write_photographs(
        tmp_path / "photos", [view.camera for view in views], [straight(view) for view in views]
    )
    words = ["train", str(folder), "-o", str(tmp_path / "mesh.npz"), "--minutes", minutes]
    assert main([*words, "--test-every", "0", "--sh-degree", "0"]) == 0
    lines = (tmp_path / "mesh.npz.run" / "metrics.jsonl").read_text().splitlines()
    assert (json.loads(lines[-1])["step"] > 0) == takes_steps
    assert ("there was no time for steps" in capsys.readouterr().out) != takes_steps


def test_masks_of_an_object_are_noticed_and_cut_it_out(ball, room, tmp_path, capsys):
    views = list(zip(ball.train[:6], room.train[:6], strict=True))
    folder = write_photographs(
        tmp_path / "photos", [ball_view.camera for ball_view, _ in views], [view.image for _, view in views]
    )
    (folder / "masks").mkdir()
    for name, (view, _) in zip(sorted(p.name for p in (folder / "images").iterdir()), views, strict=True):
        inside = view.alpha > 0.5
        inside[:20] = False  # less than half of the pixels
        Image.fromarray(np.uint8(255 * inside)).save(folder / "masks" / name)
    words = ["train", str(folder), "-o", str(tmp_path / "mesh.npz"), "--steps", "1", "--start-splats", "100"]
    words += ["--max-splats", "100", "--test-every", "0", "--force"]
    assert main(words) == 0
    assert "--masks subject cuts out an object" in capsys.readouterr().err
    assert main([*words, "--masks", "subject"]) == 0
    assert "masks leave" not in capsys.readouterr().err
    mesh = load_mesh(tmp_path / "mesh.npz")
    corner = render(mesh, views[0][0].camera, background=(1, 1, 1)).alpha[:4, :4]
    assert corner.max() < 0.1, "nothing is around the object"


def test_a_trained_mesh_outlives_a_failure_to_write_its_splats(ball, tmp_path, monkeypatch):
    from meshsplats.formats import gaussians

    def full(*_args, **_more):
        raise OSError(28, "No space left on device", "splats.ply")

    monkeypatch.setattr(gaussians, "save_gaussians", full)
    views = ball.train[:4]
    folder = write_photographs(
        tmp_path / "photos", [view.camera for view in views], [straight(view) for view in views]
    )
    words = ["train", str(folder), "-o", str(tmp_path / "mesh.npz"), "--steps", "1", "--start-splats", "100"]
    words += ["--max-splats", "100", "--test-every", "0", "--as-splats", str(tmp_path / "splats.ply")]
    assert main(words) != 0
    assert fan_count(load_mesh(tmp_path / "mesh.npz")) <= 100


def test_the_result_opens_from_where_it_was_photographed(ball, start, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("meshsplats.training.run.starting_fans", lambda *_: start)
    views, out = ball.train[:4], tmp_path / "mesh.npz"
    folder = write_photographs(
        tmp_path / "photos", [view.camera for view in views], [straight(view) for view in views]
    )
    words = ["train", str(folder), "-o", str(out), "--steps", "1", "--max-splats", "100", "--test-every", "0"]
    record = tmp_path / "mesh.npz.cameras.json"
    record.write_text("mine")
    assert main(words) == 3  # before the work
    assert record.read_text() == "mine"
    assert not out.exists()
    capsys.readouterr()
    assert main([*words, "--force"]) == 0
    told = capsys.readouterr()
    assert f"next: meshsplats view {out}" in told.out
    assert "4 photographs to train on" in told.err
    shown, given = load_cameras(record), [view.camera for view in views]
    np.testing.assert_allclose([c.center for c in shown], [c.center for c in given], atol=1e-6)
    assert [c.name for c in cameras_beside(out)] == [c.name for c in shown]


@pytest.mark.parametrize(
    ("origin", "moved"), [("keep", (10, 20, 30)), ("local", (0, 0, 0)), ((8, 20, 30), (2, 0, 0))]
)
def test_cameras_beside_a_result_are_in_its_world(ball, tmp_path, origin, moved):
    far = replace(ball, origin=np.array([10.0, 20.0, 30.0]))
    save_result_cameras(far, tmp_path / "mesh.npz", origin)
    (path,) = camera_files(tmp_path / "mesh.npz")
    shown = load_cameras(path)
    assert len(shown) == min(len(ball.train), 60)
    np.testing.assert_allclose(shown[0].center, ball.train[0].camera.center + moved, atol=1e-9)


def test_splats_are_made_up_for_after_ctrl_c_while_they_were_fitted(ball, tmp_path, monkeypatch, capsys):
    from meshsplats.training import as_splats

    fit = as_splats.fit_splats

    def stopped(*_args, **_more):
        raise Interrupted(3, signal.SIGINT)

    monkeypatch.setattr(as_splats, "fit_splats", stopped)
    views, splats = ball.train[:4], tmp_path / "splats.ply"
    folder = write_photographs(
        tmp_path / "photos", [view.camera for view in views], [straight(view) for view in views]
    )
    words = ["train", str(folder), "-o", str(tmp_path / "mesh.npz"), "--steps", "1", "--start-splats", "100"]
    words += ["--max-splats", "100", "--test-every", "0", "--as-splats", str(splats)]
    assert main(words) == 128 + signal.SIGINT
    assert "add --resume --force to write it" in capsys.readouterr().err
    assert not splats.exists()
    mesh = load_mesh(tmp_path / "mesh.npz")
    monkeypatch.setattr(as_splats, "fit_splats", fit)
    assert main([*words, "--resume", "--force"]) == 0
    assert same(load_mesh(tmp_path / "mesh.npz"), mesh)
    assert len(load_gaussians(splats)) > fan_count(mesh)


def straight(view) -> np.ndarray:
    """(h, w, 4) image with straight colours, as .png files have them."""
    image = view.load()
    alpha = image.alpha[..., None]
    color = np.divide(image.color, alpha, out=np.zeros_like(image.color), where=alpha > 0)
    return np.concatenate([color, alpha], axis=2)
