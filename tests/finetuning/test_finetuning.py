"""Fine-tuning small scenes: it gets better by a stated amount, is repeatable to the last bit, and can be
stopped."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from dataclasses import replace
from datetime import datetime, timezone
from itertools import count as numbers
from types import SimpleNamespace

import numpy as np
import pytest

from meshsplats.cameras.trajectories import orbit
from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset, splat_views
from meshsplats.datasets.views import Dataset, View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DivergenceError, FileFormatError, OtherRunError
from meshsplats.evaluation.report import evaluate
from meshsplats.finetuning import Interrupted, RunOptions, clock, finetune, make_config, reports
from meshsplats.finetuning import run as run_module
from meshsplats.finetuning.checkpoint import load_checkpoint
from meshsplats.finetuning.journal import Journal
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import (
    TRAINING_MIN_TRANSMITTANCE,
    dropout_factors,
    dropout_share,
    exposed,
    for_views,
    kept_faces,
    make_step,
    target_of,
    view_of_step,
)
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import MAX_COLOR, SplatMesh


@pytest.fixture(scope="module")
def scene():
    """Splats, a data set of their images, and their mesh."""
    cloud = make_scene(400)
    dataset = splat_dataset(cloud, train=12, test=4, width=48, sh_degree=0)
    return cloud, dataset, convert(cloud, cameras=[view.camera for view in dataset.train])


def same(a: SplatMesh, b: SplatMesh) -> bool:
    return all(
        np.array_equal(getattr(a, n), getattr(b, n))
        for n in ("vertices", "faces", "colors", "face_splat", "harmonics", "plain_colors")
    )


def score(mesh: SplatMesh, dataset: Dataset) -> float:
    return evaluate(mesh, dataset).method("mesh").mean("psnr")


# ---- What it is for


def test_vertices_of_large_splats_move_as_far_as_pixels(scene):
    """The first step of Adam is of the whole rate: a share of the splat's size, or of pixels."""
    cloud, dataset, _ = scene
    mesh = convert(replace(cloud, scales=cloud.scales * 8))
    rates = {"steps": 1, "position_rate": 0.1, "final_share": 1, "rate_steps": 0}
    free, few = (finetune(mesh, dataset, position_pixels=pixels, **rates) for pixels in (0, 0.5))
    far, near = (np.linalg.norm(tuned.vertices - mesh.vertices, axis=1) for tuned in (free, few))
    pixel = max(np.linalg.norm(v.camera.center) / v.camera.fx for v in dataset.train)
    assert np.quantile(far, 0.9) > 0.3 * pixel
    assert 0 < near.max() < 0.1 * pixel


def test_held_out_images_get_better_and_the_loss_falls(scene):
    """At least 1 dB on views that it never saw, and 3 dB on those that it did, in ten epochs."""
    _, dataset, mesh = scene
    losses = []
    tuned = finetune(mesh, dataset, make_config(epochs=10), on_progress=lambda p: losses.append(p.loss))
    assert score(tuned, dataset) > score(mesh, dataset) + 1
    seen = Dataset((), dataset.train)
    assert score(tuned, seen) > score(mesh, seen) + 3
    assert np.mean(losses[-12:]) < 0.6 * np.mean(losses[:12])
    assert len(tuned.faces) <= len(mesh.faces)
    assert set(tuned.face_splat) <= set(mesh.face_splat)


def test_soft_edges_stay_soft(scene):
    """Rims keep the opacity 0 while all else moves; without the rule they drift up."""
    _, dataset, mesh = scene
    clear = mesh.colors[:, 3] == 0
    assert clear.any()
    held = finetune(mesh, dataset, make_config(epochs=2, prune_epochs=0))
    assert (held.colors[clear, 3] == 0).all()
    assert (held.colors[clear, :3] != mesh.colors[clear, :3]).any()
    assert (held.vertices[clear] != mesh.vertices[clear]).any()
    free = finetune(mesh, dataset, make_config(epochs=2, prune_epochs=0, soft_edges=False))
    assert (free.colors[clear, 3] > 0).mean() > 0.2


def test_the_papers_preset_improves_its_conversion(scene):
    cloud, dataset, _ = scene
    mesh = convert(cloud, preset="paper")
    tuned = finetune(mesh, dataset, make_config("paper", epochs=6))
    assert score(tuned, dataset) > score(mesh, dataset) + 1


def test_linear_light(scene):
    """Blended in linear light the mesh is at first too light; its colours become right for that."""
    _, dataset, mesh = scene
    tuned = finetune(mesh, dataset, make_config(epochs=6, blending="linear"))
    assert tuned.blending == "linear"
    begun = finetune(mesh, dataset, make_config(steps=0, blending="linear"))
    seen = Dataset((), dataset.train)
    assert score(tuned, seen) > score(begun, seen) + 2
    assert score(tuned, dataset) > score(begun, dataset)
    with pytest.raises(ValueError, match="linear light"):
        finetune(tuned, dataset, make_config(blending="display"))


def test_the_slope_of_the_encoding_is_finite():
    from meshsplats.scene.colors import encoding_slope, linear_to_srgb

    values = np.linspace(0.01, 1, 100)
    step = 1e-3
    differences = (linear_to_srgb(values + step).astype(float) - linear_to_srgb(values - step)) / (2 * step)
    assert np.allclose(encoding_slope(values.astype(np.float32)), differences, rtol=2e-3)
    assert encoding_slope(np.float32([-1, 0, 0.003])).tolist() == pytest.approx([12.92] * 3)


@pytest.mark.parametrize("blending", ["display", "linear"])
@pytest.mark.parametrize("masked", [False, True])
def test_gradients_of_a_step_are_those_of_torch(scene, blending, masked, monkeypatch):
    """Loss, and its gradients by positions, colours and exposure, against autograd through rasterize."""
    torch = pytest.importorskip("torch", reason="torch's gradients are the model here")
    from meshsplats.finetuning.losses import photometric_loss
    from meshsplats.rendering.autograd import rasterize
    from meshsplats.scene.colors import srgb_to_linear

    _, dataset, mesh = scene
    mesh = mesh.of_degree(0) if blending == "linear" else mesh
    state = State.begin(
        replace(mesh, blending=blending), 1, make_config(ssim_weight=0.3, l2_weight=7.0, exposure=True), None
    )
    assert state.exposures is not None
    gain, offset = np.float32([1.1, 0.9, 1.2]), np.float32([0.05, -0.1, 0.02])
    state.exposures[0] = [*gain, *offset]
    mask = np.random.default_rng(0).random((48, 48)) < 0.6 if masked else None
    image, background = dataset.train[0].load().over((0.2, 0.9, 0.4)), (0.3, 0.1, 0.8)
    view = View(dataset.train[0].camera, ViewImage(image, None, mask), background)
    found = []
    monkeypatch.setattr(State, "step", lambda state, gradients, *rest, **more: found.extend(gradients))
    loss = make_step(state, [view], 0, 0.0, Blended(state.config))

    assert (state.harmonics is None) == (blending == "linear")
    arrays = [a for a in (state.vertices, state.colors, state.harmonics) if a is not None]
    leaves = [torch.from_numpy(a.copy()).requires_grad_() for a in arrays]
    exposure = torch.tensor([*gain, *offset], requires_grad=True)
    behind = srgb_to_linear(np.float32(background)) if blending == "linear" else np.float32(background)
    options = dict(
        face_splat=mesh.face_splat, min_transmittance=TRAINING_MIN_TRANSMITTANCE[blending], samples=2
    )
    options["harmonics"] = leaves[2] if len(leaves) > 2 else None
    rendered = rasterize(leaves[0], mesh.faces, leaves[1], view.camera, background=behind, **options).color
    if blending == "linear":
        curve = 1.055 * rendered.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
        rendered = torch.where(rendered <= 0.0031308, 12.92 * rendered, curve)
    rendered = rendered * exposure[:3] + exposure[3:]
    truth, inside = torch.from_numpy(image), None if mask is None else torch.from_numpy(mask)
    square = (rendered - truth).square()
    expected = photometric_loss(rendered, truth, ssim_weight=0.3, mask=inside)
    expected = expected + 7 * (square if mask is None else square[inside]).mean()
    expected.backward()
    assert loss == pytest.approx(float(expected.detach()), rel=1e-5)
    found = [part for part in found if part is not None]
    for ours, theirs in zip(found, (*leaves, exposure), strict=True):
        assert np.allclose(ours, theirs.grad, rtol=1e-3, atol=1e-5 * float(theirs.grad.abs().max()))


@pytest.mark.slow
def test_exposures_of_photographs_are_found(scene):
    """Every second image is darker and tinted. Fitting that gives a better mesh than painting it in."""
    _, dataset, mesh = scene
    gains = np.array([[1.2, 1.15, 1.2], [0.8, 0.85, 0.8]], np.float32)
    train = []
    for i, view in enumerate(dataset.train):
        train.append(View(view.camera, ViewImage(np.clip(view.image * gains[i % 2], 0, 3))))
    test = [View(view.camera, ViewImage(view.image)) for view in dataset.test]
    photographs = Dataset(tuple(train), tuple(test))
    plain = finetune(mesh, photographs, make_config(epochs=8))
    fitted = finetune(mesh, photographs, make_config(epochs=8, exposure=True, exposure_rate=0.02))
    seen = Dataset((), dataset.train)  # as they were before
    assert score(fitted, seen) > score(plain, seen) + 1
    assert score(fitted, photographs) > score(plain, photographs)


def test_a_flat_wall_stays_as_even_as_the_splats_image():
    """The paper's stated weakness. Sigma of the pixels inside the wall, against that of the splats'
    image."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 14), np.linspace(-1, 1, 14)), -1).reshape(-1, 2)
    n = len(grid)
    means = np.concatenate([grid + rng.normal(0, 0.02, grid.shape), np.zeros((n, 1))], axis=1)
    sh = np.tile((np.array([0.6, 0.55, 0.5]) - 0.5) / 0.28209479, (n, 1, 1)) + rng.normal(0, 0.02, (n, 1, 3))
    scales = np.tile([0.14, 0.14, 0.002], (n, 1))
    wall = GaussianCloud(means, np.tile([1.0, 0, 0, 0], (n, 1)), scales, np.full(n, 0.9), sh)
    cameras = orbit(wall, 6, width=48, height=48, elevation=30)
    cameras += orbit(wall, 5, width=48, height=48, elevation=-10, azimuth=20)
    front = Camera(
        np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0], [0, 0, 0, 1]]), 60, 60, 24, 24, 48, 48
    )
    views = splat_views(wall, [*cameras, front])
    dataset = Dataset(views[:-1], views[-1:])
    mesh = convert(wall, cameras=cameras)
    tuned = finetune(mesh, dataset, make_config(epochs=12))

    def sigma(image) -> float:
        return float(image[12:36, 12:36].std(axis=(0, 1)).mean())

    from meshsplats.rendering.looks import image_of

    truth = sigma(views[-1].image)
    assert sigma(image_of(tuned, front, (1, 1, 1))[0]) < 1.2 * truth


# ---- Repeatable


def test_the_same_seed_gives_the_same_bits_with_any_number_of_threads(scene):
    _, dataset, mesh = scene
    config = make_config(steps=12, l2_weight=0.5, exposure=True)
    one = finetune(mesh, dataset, config, run=RunOptions(threads=1))
    two = finetune(mesh, dataset, config, run=RunOptions(threads=2))
    other = finetune(mesh, dataset, replace(config, seed=1), run=RunOptions(threads=1))
    assert same(one, two)
    assert not same(one, other)


def test_a_resumed_run_ends_with_the_same_bits(scene, tmp_path):
    """Pruned on the way, and stopped three times."""
    _, dataset, mesh = scene
    config = make_config(
        epochs=4,
        prune_epochs=1,
        prune_opacity=0.05,
        exposure=True,
    )
    unstopped = tmp_path / "unstopped"
    whole = finetune(mesh, dataset, config, run=RunOptions(unstopped))
    assert len(whole.faces) < len(mesh.faces)
    folder = tmp_path / "run"
    for stop in (7, 8, 19):

        def after(progress, stop=stop):
            if progress.step == stop:
                signal.raise_signal(signal.SIGINT)

        resume = folder.exists()
        with pytest.raises(Interrupted) as caught:
            finetune(mesh, dataset, config, run=RunOptions(folder, resume), on_progress=after)
        assert (caught.value.step, caught.value.signal) == (stop, signal.SIGINT)
    tuned = finetune(mesh, dataset, config, run=RunOptions(folder, resume=True))
    assert same(tuned, whole)
    again = finetune(mesh, dataset, config, run=RunOptions(folder, resume=True))
    assert same(again, whole)
    metrics = [Journal(f).metrics() for f in (folder, unstopped)]
    assert [line["step"] for line in metrics[0]] == [0, 48]
    for name in ("loss", "psnr", "triangles"):
        assert [line[name] for line in metrics[0]] == [line[name] for line in metrics[1]]


def test_nothing_is_shown_after_a_signal(scene, tmp_path):
    """As the terminal may be lost: an error of it would take the place of what says that all is saved."""
    _, dataset, mesh = scene
    seen = []

    def after(progress):
        seen.append(progress.step)
        if progress.step == 2:
            signal.raise_signal(signal.SIGTERM)

    folder = tmp_path / "run"
    with pytest.raises(Interrupted):
        finetune(mesh, dataset, make_config(steps=2), run=RunOptions(folder), on_progress=after)
    assert seen == [1, 2]
    assert load_checkpoint(Journal(folder).checkpoint_path).step == 2


def test_resuming_with_other_inputs_is_refused(scene, tmp_path):
    _, dataset, mesh = scene
    run = RunOptions(tmp_path / "run")
    finetune(mesh, dataset, make_config(steps=2), run=run)
    again = replace(run, resume=True)
    with pytest.raises(OtherRunError, match="seed was 0 and is 3"):
        finetune(mesh, dataset, make_config(steps=2, seed=3), run=again)
    with pytest.raises(OtherRunError, match="has taken 2 steps already, 1 were requested"):
        finetune(mesh, dataset, make_config(steps=1), run=again)
    with pytest.raises(OtherRunError, match="another mesh"):
        finetune(mesh.prune(0.5), dataset, make_config(steps=2), run=again)
    with pytest.raises(OtherRunError, match="other views"):
        finetune(mesh, dataset.over((0, 0, 0)), make_config(steps=2), run=again)
    with pytest.raises(OtherRunError, match="other views"):
        finetune(mesh, replace(dataset, test=dataset.test[:-1]), make_config(steps=2), run=again)


def test_a_run_can_be_made_longer(scene, tmp_path):
    """From where it ended, with the rates of a run of the new length; what came before is kept."""
    _, dataset, mesh = scene
    run = RunOptions(tmp_path / "run")
    short = finetune(mesh, dataset, make_config(steps=6), run=run)
    longer = make_config(steps=18)
    tuned = finetune(mesh, dataset, longer, run=replace(run, resume=True))
    assert score(tuned, Dataset((), dataset.train)) > score(short, Dataset((), dataset.train)) + 0.5
    assert [line["step"] for line in Journal(run.folder).metrics()] == [0, 6, 18]
    assert json.loads((run.folder / "config.json").read_text()) == for_views(longer, dataset.train).to_dict()
    assert [int(p.stem[5:]) for p in sorted((run.folder / "previews").iterdir())] == [
        *(0, 2, 3, 5, 6),  # quarters of 6
        *(9, 14, 18),  # those of 18 that were to come
    ]


def test_no_preview_where_none_is_wanted(scene, tmp_path):
    _, dataset, mesh = scene
    finetune(mesh, dataset, make_config(steps=4), run=RunOptions(tmp_path / "run", preview_every=0))
    assert not (tmp_path / "run" / "previews").exists()


def test_a_checkpoint_with_arrays_that_do_not_fit_is_refused(scene, tmp_path):
    from meshsplats.finetuning.checkpoint import load_checkpoint, save_checkpoint

    _, dataset, mesh = scene
    run = RunOptions(tmp_path / "run")
    finetune(mesh, dataset, make_config(steps=2), run=run)
    path = Journal(run.folder).checkpoint_path
    good = load_checkpoint(path)
    for name, array in [
        ("mesh.faces", good.arrays["mesh.faces"] + 10**6),
        ("positions.square", -np.ones_like(good.arrays["positions.square"])),
        ("colors.mean", good.arrays["colors.mean"][:-1]),
        ("sizes", good.arrays["sizes"].astype(np.float64)),
        ("colors.steps", None),
    ]:
        arrays = {key: value for key, value in good.arrays.items() if key != name}
        save_checkpoint(replace(good, arrays=arrays if array is None else arrays | {name: array}), path)
        with pytest.raises(FileFormatError, match="checkpoint"):
            finetune(mesh, dataset, make_config(steps=2), run=replace(run, resume=True))
    for seconds in (10**400, -1.0, float("nan")):
        save_checkpoint(replace(good, seconds=seconds), path)
        with pytest.raises(FileFormatError, match="broken: step 2, seconds"):
            load_checkpoint(path)


def test_every_epoch_shows_every_view_once_in_another_order():
    config = make_config()
    epochs = [[view_of_step(config, 10 * e + i, 10) for i in range(10)] for e in range(3)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 3


# ---- Steps


def test_an_exposure_is_that_of_the_photograph_not_of_the_background():
    """A photograph of a half transparent subject, with a gain and an offset, over any background: the mesh's
    image, exposed as a whole, is exactly its target."""
    rng = np.random.default_rng(3)
    color, alpha = rng.random((6, 5, 3)).astype(np.float32), rng.random((6, 5)).astype(np.float32)
    exposure = np.array([0.7, 1.2, 0.9, 0.1, -0.05, 0.02], np.float32)
    camera = Camera(np.eye(4), 5, 5, 2.5, 3, 5, 6)
    photograph = View(camera, ViewImage(alpha[..., None] * exposed(color, exposure), alpha), (1, 1, 1))
    subject = ViewImage(alpha[..., None] * color, alpha)
    for step, background in enumerate(("white", "black", "random", "mixed")):
        target = target_of(photograph, make_config(background=background), step, exposure=exposure)
        assert np.allclose(exposed(subject.over(target.background), exposure), target.color, atol=1e-6)
    opaque = View(camera, ViewImage(color))  # all of it is the photograph's
    assert np.array_equal(target_of(opaque, make_config(), 0, exposure=exposure).color, color)


def test_backgrounds_are_random_only_where_alpha_is_known(scene):
    _, dataset, _ = scene
    drawn, photo = dataset.train[0], View(dataset.train[0].camera, ViewImage(dataset.train[0].image))
    random, mixed, white = (make_config(background=name) for name in ("random", "mixed", "white"))
    colors = {target_of(drawn, random, step).background for step in range(5)}
    assert len(colors) == 5
    assert target_of(drawn, random, 3).background == target_of(drawn, random, 3).background
    assert target_of(photo, random, 3).background == (1, 1, 1)
    assert target_of(drawn, white, 3).background == (1, 1, 1)
    on_black = View(drawn.camera, drawn.load(), (0, 0, 0))
    for step in range(6):
        wanted = target_of(drawn, random, step).background if step % 4 == 1 else (0, 0, 0)
        assert target_of(on_black, mixed, step).background == wanted
    target = target_of(drawn, random, 3)
    assert np.allclose(target.color, drawn.load().over(target.background))


def test_a_step_changes_only_what_its_view_shows(scene):
    _, dataset, mesh = scene
    near = dataset.train[view_of_step(make_config(), 0, len(dataset.train))]
    state = State.begin(mesh, len(dataset.train), make_config(), None)
    make_step(state, dataset.train, 0, 0.0, Blended(state.config))
    moved = (state.result().colors != mesh.colors).any(axis=1)
    assert 0.05 < moved.mean() < 1
    assert near.camera.sees(mesh.vertices[moved]).mean() > 0.8
    far = np.full((1, 3), 1e3, np.float32)
    assert not near.camera.sees(far).any()


def test_dropout_leaves_splats_out_and_thickens_the_others(scene, monkeypatch):
    """A step is that of the mesh without them: image, loss and gradients."""
    _, dataset, mesh = scene
    view, found = dataset.train[0], []
    monkeypatch.setattr(State, "step", lambda state, gradients, *rest, **more: found.append(gradients))

    def step(mesh, dropout):
        state = State.begin(mesh, 1, make_config(dropout=dropout), None)
        return make_step(state, [view], 40, 0.5, Blended(state.config)), state

    loss, state = step(mesh, 0.4)
    factors = dropout_factors(state, 0.4, 40)
    faint = mesh.colors[:, 3] < 0.6
    assert set(factors[faint]) == {0, np.float32(1 / np.float32(0.6))}
    assert np.abs((factors == 0).mean() - 0.4) < 0.1
    kept = replace(mesh, colors=mesh.colors * np.column_stack([np.ones((len(factors), 3), "f4"), factors]))
    assert kept.colors[~faint & (factors > 0), 3] == pytest.approx(1)
    assert loss == step(kept, 0.0)[0]
    dropped, alone = found
    assert not dropped.vertices[factors == 0].any()
    np.testing.assert_array_equal(dropped.vertices, alone.vertices)
    np.testing.assert_array_equal(dropped.colors[:, :3], alone.colors[:, :3])
    np.testing.assert_array_equal(dropped.colors[:, 3], alone.colors[:, 3] * factors)
    assert step(mesh, 0.0)[0] != loss


def test_dropout_grows_with_the_passes():
    config = make_config(dropout=0.2)
    shares = [dropout_share(config, passes) for passes in (0, 10, 25, 40, 100)]
    assert shares == pytest.approx([0, 0, 0.1, 0.2, 0.2])


def test_dropout_is_for_few_photographs(scene):
    _, dataset, _ = scene
    photos = [replace(view, source=ViewImage(view.load().color)) for view in dataset.train]
    for count, share in ((2, 0.15), (30, 0.15), (45, 0.075), (60, 0), (100, 0)):
        views = [photos[i % len(photos)] for i in range(count)]
        assert for_views(make_config(dropout=None), views).dropout == pytest.approx(share)
        assert for_views(make_config(dropout=0.3), views).dropout == 0.3
    assert for_views(make_config(dropout=None), dataset.train).dropout == 0
    assert for_views(make_config(), photos[:2]).dropout == 0


def test_positions_move_by_the_size_of_their_splats(scene):
    """Adam's first step is the rate, in units of the splat's size."""
    _, dataset, mesh = scene
    state = State.begin(mesh, len(dataset.train), make_config(position_rate=0.05), None)
    make_step(state, dataset.train, 0, 0.0, Blended(state.config))
    step = np.abs(state.result().vertices - mesh.vertices)
    moved = step.max(axis=1) > 0
    share = step[moved].max(axis=1) / state.sizes[moved]
    assert np.median(share) == pytest.approx(0.05, rel=0.02)


def test_black_fans_on_black_take_on_colors(scene):
    """Their opacities have no gradient."""
    _, dataset, mesh = scene
    colors = mesh.colors * np.array([0, 0, 0, 1], np.float32)
    view = replace(dataset.train[0], source=ViewImage(dataset.train[0].image), background=(0.0, 0.0, 0.0))
    state = State.begin(replace(mesh, colors=colors), 1, make_config(steps=10), None)
    make_step(state, [view], 0, 0.0, Blended(state.config))
    assert (state.colors[:, :3] > 0).any()


def test_colors_stay_in_range(scene):
    _, dataset, mesh = scene
    assert mesh.harmonics is not None
    for start, brightest in ((mesh, MAX_COLOR), (mesh.of_degree(0), 1)):
        tuned = finetune(start, dataset, make_config(steps=20, color_rate=0.9))
        assert tuned.colors.min() >= 0
        assert tuned.colors[:, :3].max() <= brightest
        assert tuned.colors[:, 3].max() <= 1


def test_plain_colours_are_those_of_the_result(scene):
    """Those of the start, which is another mesh, are forgotten; without harmonics there are none."""
    _, dataset, mesh = scene
    old = replace(mesh, plain_colors=np.zeros((len(mesh.vertices), 3), np.float32))
    config = make_config(steps=3)
    assert same(finetune(old, dataset, config), finetune(mesh, dataset, config))
    flat = replace(mesh.of_degree(0), plain_colors=old.plain_colors)
    for more in ({}, {"blending": "linear"}, {"steps": 16, "opacity": "cutoff", "soft_share": 0.1}):
        assert finetune(flat, dataset, config, **more).plain_colors is None


def test_masked_pixels_have_no_say(scene):
    _, dataset, mesh = scene
    view = dataset.train[0]
    mask = np.zeros((48, 48), bool)
    mask[:, 20:] = True

    def tuned(wrong):
        image = view.image.copy()
        image[:, :20] = wrong
        masked = Dataset((View(view.camera, ViewImage(image, None, mask)),))
        return finetune(mesh, masked, make_config(steps=3, l2_weight=1.0))

    assert same(tuned(0.0), tuned(1.0))
    none = Dataset((View(view.camera, ViewImage(view.image, None, np.zeros((48, 48), bool))),))
    untouched = finetune(mesh, none, make_config(steps=3, prune_epochs=0))
    assert same(replace(untouched, plain_colors=None), mesh)


def test_values_that_are_not_finite_name_their_view(scene, tmp_path):
    _, dataset, mesh = scene
    bad = View(
        replace(dataset.train[2].camera, name="broken.png"),
        ViewImage(np.full((48, 48, 3), np.nan, np.float32)),
    )
    spoilt = Dataset((*dataset.train[:2], bad), dataset.test)
    run = RunOptions(tmp_path / "run")
    with pytest.raises(DivergenceError, match=r"step \d, view 'broken\.png': the loss is not finite"):
        finetune(mesh, spoilt, make_config(epochs=1), run=run)
    kept = load_checkpoint(Journal(run.folder).checkpoint_path)
    assert np.isfinite(kept.arrays["mesh.vertices"]).all()


# ---- Pruning


def test_faint_triangles_are_dropped_with_their_vertices_and_moments(scene):
    _, dataset, mesh = scene
    config = make_config(prune_opacity=0.3, prune_epochs=1)
    state = State.begin(mesh, len(dataset.train), config, None)
    for step in range(3):
        make_step(state, dataset.train, step, 0.0, Blended(config))
    keep = kept_faces(state)
    assert 0 < keep.sum() < len(keep)
    expected = state.result().prune(0.3)
    used = np.unique(mesh.faces[keep])
    smaller = state.prune(keep)
    assert same(smaller.result(), expected)
    for name in ("positions", "colors"):
        for key in ("mean", "square"):
            assert np.array_equal(smaller.arrays()[f"{name}.{key}"], state.arrays()[f"{name}.{key}"][used])
    assert np.array_equal(smaller.sizes, state.sizes[used])


# ---- Runs


def test_files_of_a_run(scene, tmp_path):
    _, dataset, mesh = scene
    folder = tmp_path / "run"
    progress = []
    run = RunOptions(folder, report_every=4, preview_every=5)
    config, began = make_config(steps=10), datetime.now(timezone.utc)
    finetune(mesh, dataset, config, run=run, on_progress=progress.append)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 4, 8, 10]
    assert lines[0]["loss"] is None
    assert lines[-1]["psnr"] > lines[0]["psnr"]
    assert lines[-1]["ssim"] > lines[0]["ssim"]
    tuned = State.resume(
        load_checkpoint(Journal(folder).checkpoint_path).arrays, "display", "fragment", 12, config, None
    )
    scores = evaluate(tuned.result(), dataset).method("mesh")
    assert lines[-1]["psnr"] == pytest.approx(scores.mean("psnr"))
    assert lines[-1]["ssim"] == pytest.approx(scores.mean("ssim"))
    times = [datetime.fromisoformat(line["time"]) for line in lines]
    moments = [began.replace(microsecond=0), *times, datetime.now(timezone.utc)]
    assert moments == sorted(moments)
    previews = [int(p.stem.removeprefix("step_")) for p in sorted((folder / "previews").iterdir())]
    assert previews == [0, 3, 5, 8, 10]  # after each quarter, and every five steps
    assert json.loads((folder / "config.json").read_text())["steps"] == 10
    assert [p.step for p in progress[:3]] == [1, 2, 3]
    assert progress[0].steps == 10
    assert progress[4].seconds_left > 0
    assert progress[-1].fraction == 1


def test_a_length_in_minutes_is_kept(scene, monkeypatch):
    """By a clock that each look at it puts forward."""
    _, dataset, mesh = scene
    looks, progress = numbers(), []
    for module in (clock, reports, run_module):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: 0.25 * next(looks)))
    finetune(mesh, dataset, make_config(minutes=1.0), on_progress=progress.append)
    assert 50 < 0.25 * next(looks) < 60
    assert progress[-1].step > 10
    spent, progress = RunOptions(spent=60.0), []
    finetune(mesh, dataset, make_config(minutes=1.0), run=spent, on_progress=progress.append)
    assert [moment.step for moment in progress] == [0]


def test_what_cannot_be_tuned(scene):
    _, dataset, mesh = scene
    with pytest.raises(ValueError, match="no training views"):
        finetune(mesh, Dataset(()), make_config(steps=1))
    with pytest.raises(ValueError, match="no triangles"):
        finetune(mesh.take(np.zeros(len(mesh.faces), bool)), dataset, make_config(steps=1))
    with pytest.raises(ValueError, match="resume needs the folder"):
        RunOptions(resume=True)


PROGRAM = """
import math
import os
import signal
import sys
from pathlib import Path
from threading import Timer
from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.demo_scene import make_scene
from meshsplats.finetuning import RunOptions, finetune, make_config, run as module
module.CHECKPOINT_SHARE = math.inf  # a checkpoint after each step
cloud = make_scene(400)
dataset = splat_dataset(cloud, train=8, test=0, width=48, sh_degree=0)
run = RunOptions(Path(sys.argv[1]), resume=sys.argv[2] == "resume", checkpoint_seconds=0)


def killed_soon(progress):
    if progress.step == int(sys.argv[3]):
        Timer(float(sys.argv[4]), os.kill, (os.getpid(), signal.SIGKILL)).start()


finetune(convert(cloud), dataset, make_config(steps=40), run=run, on_progress=killed_soon)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_killed_at_random_moments_nothing_is_lost(tmp_path):
    """SIGKILL, which no program can answer; then the run goes on from its checkpoint to the same bits."""
    cloud = make_scene(400)
    dataset = splat_dataset(cloud, train=8, test=0, width=48, sh_degree=0)
    mesh = convert(cloud)
    whole = finetune(mesh, dataset, make_config(steps=40))
    folder = tmp_path / "run"
    rng, steps = np.random.default_rng(0), [0]
    for mode, step in (("anew", 3), ("resume", 10), ("resume", 20)):
        words = [str(folder), mode, str(max(step, steps[-1] + 1)), str(rng.uniform(0, 0.02))]
        assert subprocess.run([sys.executable, "-c", PROGRAM, *words]).returncode == -signal.SIGKILL
        steps.append(load_checkpoint(Journal(folder).checkpoint_path).step)
    assert steps == sorted(set(steps))
    assert steps[-1] < 40
    tuned = finetune(mesh, dataset, make_config(steps=40), run=RunOptions(folder, resume=True))
    assert same(tuned, whole)


def test_a_mesh_keeps_its_order_unless_another_is_asked_for():
    exact = convert(make_scene(200))
    by_splat = replace(exact, order="splat")
    for mesh, asked, expected in (
        (exact, "mesh", "fragment"),
        (exact, "splat", "splat"),
        (by_splat, "mesh", "splat"),
        (by_splat, "fragment", "fragment"),
    ):
        state = State.begin(mesh, 2, make_config(steps=1, order=asked), None)
        assert (state.triangles.order, state.result().order) == (expected, expected)
    cut = make_config(steps=1, opacity="cutoff")
    assert State.begin(by_splat, 2, cut, None).triangles.order == "fragment"
    with pytest.raises(ValueError, match="order='splat' blends whole splats, but the mesh has no face_splat"):
        State.begin(
            replace(exact, face_splat=None, harmonics=None), 2, make_config(steps=1, order="splat"), None
        )
