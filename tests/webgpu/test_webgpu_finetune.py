"""Fine-tuning on the GPU: the steps of the CPU, but for rounding."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from _gpu import need_gpu
from _priors import bumpy

from meshsplats import Dataset, SplatMesh, orbit, render
from meshsplats._core.kernels import round_fans
from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.datasets.views import View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DeviceError, DivergenceError, FileFormatError, MissingDependencyError
from meshsplats.finetuning import RunOptions, finetune, make_config
from meshsplats.finetuning.gradients import Rates, StepImage
from meshsplats.finetuning.loss import DefaultLoss, LossWeights
from meshsplats.finetuning.phases.blended import Blended
from meshsplats.finetuning.state import State
from meshsplats.finetuning.step import make_step, view_of_step
from meshsplats.prior import bind
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.gpu import gpu_engine
from meshsplats.rendering.shading import seen_from
from meshsplats.webgpu import gradients
from meshsplats.webgpu.device import CORE_BINDING, open_device
from meshsplats.webgpu.frames import WINDOW_SAMPLES
from meshsplats.webgpu.training import Trainer

GPU = RunOptions(device="gpu")
TOLERANCE = 1e-4
"""Of losses, relative."""
CHANGES = 1e-3
"""Of the changes of colours and positions after a few steps, relative."""
DECIDED_BY_ROUNDING = 4
"""Values that may differ by a step: Adam divides by the size of a gradient; where that is next to nothing,
rounding decides."""


@pytest.fixture(scope="module")
def scene():
    """A data set of images of splats, and their mesh."""
    cloud = make_scene(200)
    dataset = splat_dataset(cloud, train=6, test=2, width=40, sh_degree=0)
    return dataset, convert(cloud, cameras=[view.camera for view in dataset.train], colors="base")


def steps(scene, device, count: int = 5, **options) -> tuple[list[float], State]:
    """The losses of the first steps, and the state after them."""
    dataset, mesh = scene
    config = make_config(steps=count, **options)
    state = State.begin(mesh, len(dataset.train), config, None, device=device)
    phase = Blended(config)
    losses = [make_step(state, dataset.train, i, i / count, phase) for i in range(count)]
    assert None not in losses
    return [loss for loss in losses if loss is not None], state


OPTIONS = [
    {},
    {"background": "random"},
    {"samples": 1, "l2_weight": 0.0},
    {"ssim_weight": 0.0},
    {"soft_edges": False, "position_unit": "scene", "position_rate": 1e-3},
    {"position_rate": 0.0},
    {"epsilon": 1e-3},
    {"epsilon": 1e-3, "position_unit": "scene"},
    {"blending": "linear"},
    {"exposure": True},
    {"opacity_decay": 0.05},
    {"opacity_decay": 0.05, "soft_edges": False},
]


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: ", ".join(options) or "default")
def test_steps_are_those_of_the_cpu(scene, options):
    need_gpu()
    assert_same_steps(scene, **options)


def assert_same_steps(scene, **options) -> State:
    """Compares steps of the GPU with those of the core, whose state it returns."""
    losses, state = steps(scene, "gpu", **options)
    expected, known = steps(scene, "cpu", **options)
    assert np.allclose(losses, expected, rtol=TOLERANCE)
    fixed = {"vertices": options.get("position_rate") == 0, "harmonics": options.get("harmonics_rate") == 0}
    for name in ("vertices", "colors", "harmonics"):
        before, after = getattr(known.mesh, name), getattr(known, name)
        if before is None:
            continue
        change = np.linalg.norm(after - before)
        assert (change > 0) != fixed.get(name, False)
        difference = np.sort(np.abs(getattr(state, name) - after), axis=None)[:-DECIDED_BY_ROUNDING]
        assert np.linalg.norm(difference) <= CHANGES * change
    return known


def dark_with_harmonics(mesh, terms: int):
    """The mesh with strong harmonics, which hold many colours at 0 in a view."""
    harmonics = np.random.default_rng(terms).normal(0, 0.2, (len(mesh.splats), terms, 3)).astype(np.float32)
    return replace(mesh, colors=mesh.colors * np.array([0.5, 0.5, 0.5, 1], np.float32), harmonics=harmonics)


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("terms", [3, 8, 15])
@pytest.mark.parametrize("options", [{}, {"harmonics_rate": 0.0}, {"position_rate": 0.0, "epsilon": 1e-3}])
def test_steps_with_harmonics_are_those_of_the_cpu(scene, terms, options):
    need_gpu()
    dataset, mesh = scene
    mesh = dark_with_harmonics(mesh, terms)
    held = [(seen_from(mesh, view.camera).colors[:, :3] == 0).mean() for view in dataset.train]
    assert 0.03 < np.mean(held) < 0.5
    assert_same_steps((dataset, mesh), **options)


def test_colors_above_1_with_harmonics_are_not_cut(scene):
    need_gpu()
    dataset, mesh = scene
    bright = dark_with_harmonics(mesh, 3)
    bright = replace(bright, colors=bright.colors * np.array([4, 4, 4, 1], np.float32))
    assert assert_same_steps((dataset, bright)).colors[:, :3].max() > 1.5


@pytest.mark.parametrize("sides", [3, 6, 9])
def test_fans_are_rounded_between_steps_as_on_the_cpu(sides):
    need_gpu()
    rng = np.random.default_rng(sides)
    places = rng.normal(0, 0.3, (60, 1, 3)) + np.array([0, 0, 100])
    fans = (places + rng.normal(0, 0.05, (60, 1 + sides, 3))).astype(np.float32)
    around = np.arange(sides)
    fan = np.stack([np.zeros(sides), 1 + around, 1 + (around + 1) % sides], axis=1)
    faces = (fan + (1 + sides) * np.arange(60)[:, None, None]).reshape(-1, 3).astype(np.int32)
    colors = rng.random((fans[..., 0].size, 4)).astype(np.float32)
    mesh = SplatMesh(fans.reshape(-1, 3), faces, colors, np.repeat(np.arange(60), sides))
    cameras = orbit(mesh, 2, width=40, height=40)
    views = [View(camera, ViewImage(render(mesh, camera).color[::-1].copy())) for camera in cameras]
    config, found = make_config(steps=4), []
    for device in ("gpu", "cpu"):
        state = State.begin(mesh, len(views), config, None, device=device)
        fetches = []
        plain = state._fetch
        state._fetch = lambda fetches=fetches, plain=plain: (fetches.append(1), plain())[1]
        for i in range(4):
            make_step(state, views, i, i / 4, Blended(config))
            state.round_fans(1 + sides, 0.4)
        assert bool(fetches) == (device == "cpu")  # all of it stays there
        found.append(state.vertices)
    change = np.linalg.norm(found[1] - mesh.vertices)
    assert np.linalg.norm(found[0] - found[1]) <= CHANGES * change
    rounded = fans.copy()
    round_fans(rounded, 1.0)
    rest = found[1].reshape(fans.shape).copy()
    round_fans(rest, 1.0)
    left = np.linalg.norm(rest.reshape(-1, 3) - found[1]) / np.linalg.norm(rounded - fans)
    assert sides == 3 or left < 0.5  # a triangle is an ellipse already, but for its centre


def test_steps_in_the_order_of_the_splats_are_those_of_the_cpu(scene):
    need_gpu()
    dataset, mesh = scene
    known = assert_same_steps((dataset, replace(mesh, order="splat")))
    exact = steps(scene, "cpu")[1]
    change = np.linalg.norm(known.colors - mesh.colors)
    assert np.linalg.norm(known.colors - exact.colors) > 20 * CHANGES * change  # the order matters here


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("options", [{}, {"exposure": True}], ids=["default", "exposure"])
def test_the_default_loss_as_a_function_has_the_steps_of_the_gpus_own(scene, options):
    need_gpu()
    dataset, mesh = scene
    config = make_config(steps=5, **options)
    default = DefaultLoss.of(config)
    own, known = (
        finetune(mesh, dataset, config, run=replace(GPU, report_every=0), loss=loss)
        for loss in (lambda image, target: default(image, target), None)
    )
    change = np.linalg.norm(known.vertices - mesh.vertices)
    assert np.linalg.norm(own.vertices - known.vertices) <= CHANGES * change


def test_black_fans_on_black_take_on_the_colors_of_the_cpu(scene):
    """Their opacities have no gradient."""
    need_gpu()
    dataset, mesh = scene
    views = [replace(v, source=ViewImage(v.image), background=(0.0, 0.0, 0.0)) for v in dataset.train]
    black = replace(mesh, colors=mesh.colors * np.array([0, 0, 0, 1], np.float32))
    found, known = (steps((replace(dataset, train=tuple(views)), black), d, 1)[1] for d in ("gpu", "cpu"))
    assert (known.colors[:, :3] > 0).any()
    change = np.linalg.norm(known.colors - black.colors)
    assert np.linalg.norm(found.colors - known.colors) <= CHANGES * change


def test_a_mesh_on_a_base_with_depth_groups():
    need_gpu()
    base = bumpy(4)
    mesh = bind(base, triangles=4).mesh
    assert mesh.binding is not None
    assert mesh.depth_group is not None
    views = []
    for camera in orbit(mesh, 3, width=32, height=32):
        image = render(replace(mesh, colors=mesh.colors[::-1]), camera)
        views.append(View(camera, ViewImage(image.color)))
    scene = Dataset(tuple(views), ()), mesh
    losses, state = steps(scene, "gpu", 3)
    expected, known = steps(scene, "cpu", 3)
    assert np.allclose(losses, expected, rtol=TOLERANCE)
    change = np.linalg.norm(known.vertices - mesh.vertices)
    assert change > 0
    assert np.linalg.norm(state.vertices - known.vertices) <= CHANGES * change


def test_arrays_stay_on_the_gpu_where_all_of_a_step_runs_there(scene, monkeypatch):
    need_gpu()
    dataset, _ = scene
    camera = dataset.train[0].camera
    state = steps(scene, "gpu")[1]
    assert state.fused_steps(camera, ())
    shaded = steps((scene[0], dark_with_harmonics(scene[1], 15)), "gpu", 0)[1]
    assert shaded.fused_steps(camera, ())
    monkeypatch.setattr(open_device(), "binding_limit", shaded.harmonics.nbytes - 1)
    assert shaded.fused_steps(camera, ()) is None
    monkeypatch.undo()
    assert steps(scene, "cpu", 0)[1].fused_steps(camera, ()) is None
    for options in ({"blending": "linear"}, {"exposure": True}):
        assert steps(scene, "gpu", 0, **options)[1].fused_steps(camera, ()) is None
    monkeypatch.setattr(open_device(), "binding_limit", CORE_BINDING)
    assert state.fused_steps(replace(camera, width=2000, height=2000), ()) is None
    assert state.fused_steps(camera, ("loss",)) is None


@pytest.mark.slow
@pytest.mark.parametrize("terms", [0, 8])
def test_nothing_is_fetched_between_steps(scene, monkeypatch, terms):
    need_gpu()
    fetched, taken = [], []
    plain = Trainer.fetch
    monkeypatch.setattr(Trainer, "fetch", lambda self, into: (fetched.append(len(taken)), plain(self, into)))
    dataset, mesh = scene
    mesh = dark_with_harmonics(mesh, terms) if terms else mesh
    config = make_config(steps=4, prune_epochs=0)
    run = replace(GPU, report_every=0)
    finetune(mesh, dataset, config, run=run, on_progress=lambda progress: taken.append(progress.step))
    assert fetched == [4]


@pytest.mark.slow
def test_steps_here_and_on_the_gpu_take_turns(scene, monkeypatch):
    need_gpu()
    from meshsplats.rendering import gpu as module

    dataset, mesh = scene
    expected, known = steps(scene, "gpu")
    config = make_config(steps=5)
    state = State.begin(mesh, len(dataset.train), config, None, device="gpu")
    losses = []
    for i in range(5):
        most = 0 if i in (1, 3) else 1 << 20
        monkeypatch.setattr(module, "most_pixels", lambda device, most=most: most)
        losses.append(make_step(state, dataset.train, i, i / 5, Blended(config)))
    assert np.allclose(losses, expected, rtol=3 * TOLERANCE)
    change = np.linalg.norm(known.vertices - mesh.vertices)
    assert np.linalg.norm(state.vertices - known.vertices) <= CHANGES * change


@pytest.mark.slow
def test_steps_in_windows_where_a_tape_does_not_fit(scene, monkeypatch):
    need_gpu()
    expected, known = steps(scene, "gpu")
    monkeypatch.setattr(open_device(), "binding_limit", CORE_BINDING)
    monkeypatch.setattr(gradients, "FRAGMENT_BYTES", 10_000)  # as if there were more fragments
    losses, state = steps(scene, "gpu")
    assert state.fused_steps(scene[0].train[0].camera, ())
    assert state.arrays()["window_samples"] < 1 << 22
    assert np.allclose(losses, expected, rtol=TOLERANCE)
    change = np.linalg.norm(known.vertices - known.mesh.vertices)
    assert np.linalg.norm(state.vertices - known.vertices) <= CHANGES * change


def test_nothing_changes_if_the_loss_or_a_gradient_is_not_finite(scene):
    need_gpu()
    dataset, mesh = scene
    config = make_config(steps=5)
    state = State.begin(mesh, len(dataset.train), config, None, device="gpu")
    make_step(state, dataset.train, 0, 0.0, Blended(config))
    before = {name: array.copy() for name, array in state.arrays().items()}
    image = dataset.train[0].load()
    color = image.color.astype(np.float32)
    color[3, 4, 1] = np.nan
    alpha = None if image.alpha is None else image.alpha.astype(np.float32)
    broken = replace(image, color=color, alpha=alpha)
    views = [replace(view, source=broken) for view in dataset.train]
    with pytest.raises(DivergenceError, match="the loss is not finite"):
        make_step(state, views, 1, 0.2, Blended(config))
    target, camera = dataset.train[0].image, dataset.train[0].camera
    loss = LossWeights(0.0, 0.0, 3e38, 0.0)  # the sums are finite, the gradients are not
    steps, image = state.fused_steps(camera, ()), StepImage(camera, TapeOptions((0, 0, 0)), target, None)
    assert steps is not None
    sums = state.fused_step(steps, image, loss, Rates(0.02, 0.02))
    assert np.isfinite(sums[:3]).all()
    assert not sums.finite
    after = state.arrays()
    assert all(np.array_equal(before[name], after[name]) for name in before)


def test_masked_pixels_do_not_count(scene):
    need_gpu()
    dataset, mesh = scene
    rng = np.random.default_rng(0)
    views = []
    for view in dataset.train:
        image = view.load()
        mask = rng.random(image.color.shape[:2]) < 0.7
        views.append(replace(view, source=replace(image, mask=mask)))
    masked = replace(dataset, train=tuple(views))
    losses, _ = steps((masked, mesh), "gpu")
    expected, _ = steps((masked, mesh), "cpu")
    assert np.allclose(losses, expected, rtol=TOLERANCE)
    assert not np.allclose(losses, steps(scene, "cpu")[0], rtol=0.01)


def test_the_same_bits_every_time(scene):
    need_gpu()
    one, two = (steps(scene, "gpu")[1] for _ in range(2))
    assert one.vertices.tobytes() == two.vertices.tobytes()
    assert one.colors.tobytes() == two.colors.tobytes()


@pytest.mark.nightly
def test_a_resumed_run_in_windows_has_the_same_bits(scene, tmp_path, monkeypatch):
    """Also where it stops between an image that has too many fragments and one that has not."""
    need_gpu()
    dataset, mesh = scene
    config = make_config(steps=8, opacity_decay=0.01)
    next_view = view_of_step(config, 3, len(dataset.train))
    views = list(dataset.train)
    camera = views[next_view].camera
    far = replace(camera, fx=camera.fx / 8, fy=camera.fy / 8)
    views[next_view] = replace(views[next_view], camera=far, source=views[next_view].load())
    dataset = replace(dataset, train=tuple(views))
    monkeypatch.setattr(open_device(), "binding_limit", CORE_BINDING)
    monkeypatch.setattr(gradients, "FRAGMENT_BYTES", 20_000)  # as if there were more fragments

    def fits(number: int) -> bool:
        state = State.begin(mesh, len(views), config, None, device="gpu")
        make_step(state, [views[view_of_step(config, number, len(views))]], 0, 0.0, Blended(config))
        return state.arrays()["window_samples"] == WINDOW_SAMPLES

    assert (fits(2), fits(3)) == (False, True)
    check_resumed(dataset, mesh, config, tmp_path)


BROKEN = [np.int64(0), np.int64(WINDOW_SAMPLES + 1), np.zeros(2, np.int64), np.float32(9)]


@pytest.mark.parametrize("value", BROKEN, ids=str)
def test_a_broken_limit_of_windows_is_refused(scene, value):
    need_gpu()
    _, mesh = scene
    config = make_config(steps=8)
    arrays = State.begin(mesh, 6, config, None, device="gpu").arrays()
    with pytest.raises(FileFormatError, match="window_samples must be a whole number"):
        State.resume(
            arrays | {"window_samples": np.asarray(value)}, "display", "fragment", 6, config, None, "gpu"
        )


@pytest.mark.slow
@pytest.mark.parametrize("terms", [0, 15])
def test_a_resumed_run_has_the_same_bits(scene, tmp_path, terms):
    need_gpu()
    dataset, mesh = scene
    mesh = dark_with_harmonics(mesh, terms) if terms else mesh
    check_resumed(dataset, mesh, make_config(steps=6), tmp_path)


def check_resumed(dataset, mesh, config, tmp_path):
    """A run that is stopped after three steps, and resumed by a process that has rendered nothing before."""
    whole = finetune(mesh, dataset, config, run=replace(GPU, report_every=0))
    folder = tmp_path / "run"

    class Stop(Exception):
        pass

    def after(progress) -> None:
        if progress.step == 3:
            raise Stop

    run = RunOptions(folder, device="gpu", report_every=0, preview_every=0, checkpoint_seconds=1e-9)
    with pytest.raises(Stop):
        finetune(mesh, dataset, config, run=run, on_progress=after)
    gpu_engine().forget()
    tuned = finetune(mesh, dataset, config, run=replace(run, resume=True))
    assert tuned.vertices.tobytes() == whole.vertices.tobytes()
    assert tuned.colors.tobytes() == whole.colors.tobytes()
    assert np.array_equal(tuned.harmonics, whole.harmonics)
    assert np.array_equal(tuned.faces, whole.faces)


@pytest.mark.slow
def test_a_run_gets_better_and_is_scored_and_pruned(scene, tmp_path):
    need_gpu()
    dataset, mesh = scene
    losses = []
    tuned = finetune(
        mesh,
        dataset,
        make_config(epochs=4, prune_epochs=2, prune_opacity=0.3),
        run=RunOptions(tmp_path / "run", device="gpu", report_every=10),
        on_progress=lambda progress: losses.append(progress.loss),
    )
    assert np.mean(losses[-6:]) < 0.7 * np.mean(losses[:6])
    assert 0 < len(tuned.faces) < len(mesh.faces)


def test_what_needs_the_cpu_is_an_error_before_anything_is_written(scene, tmp_path):
    dataset, mesh = scene
    run = RunOptions(tmp_path / "run", device="gpu")
    with pytest.raises(ValueError, match="opacity 'cutoff' needs device 'cpu'"):
        finetune(mesh, dataset, make_config(steps=1, opacity="cutoff"), run=run)
    with pytest.raises(ValueError, match="device must be one of cpu, gpu, got 'cuda'"):
        RunOptions(device="cuda")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_what_the_gpu_cannot_hold_is_an_error_before_anything_is_written(scene, tmp_path, monkeypatch):
    """An earlier run of that name is not lost."""
    need_gpu()
    dataset, mesh = scene[0], replace(scene[1], filter_px2=0.3)
    run = RunOptions(tmp_path / "run", device="gpu", preview_every=0)
    finetune(mesh, dataset, make_config(steps=1), run=replace(run, device="cpu"))
    before = {path: path.read_bytes() for path in sorted(run.folder.iterdir())}
    assert run.folder / "checkpoint.safetensors" in before
    limits = [
        (gradients, "MAX_VALENCE", 3, DeviceError, "up to 3 triangles; one has"),
        (gradients, "MAX_FAN", 3, DeviceError, "splats of up to 3 triangles; one has"),
        (open_device(), "binding_limit", 32 * len(mesh.vertices) - 1, MemoryError, "too many vertices for"),
        (open_device(), "binding_limit", 64 * len(mesh.faces) - 1, MemoryError, "too many triangles for"),
    ]
    for where, name, value, error, message in limits:
        for resume in (False, True):
            with monkeypatch.context() as patch:
                patch.setattr(where, name, value)
                again = replace(run, resume=resume, replace_old=not resume)
                with pytest.raises(error, match=message):
                    finetune(mesh, dataset, make_config(steps=1), run=again)
            assert {path: path.read_bytes() for path in sorted(run.folder.iterdir())} == before


def test_moments_that_start_again_are_those_after_the_last_step(scene):
    need_gpu()
    dataset, mesh = scene
    (one, two) = (
        State.begin(mesh, 6, make_config(steps=5), None, device=device) for device in ("gpu", "cpu")
    )
    rows = np.arange(0, len(mesh.vertices), 3)
    for state in (one, two):
        make_step(state, dataset.train, 0, 0.0, Blended(state.config))
        state.restart(rows)
        make_step(state, dataset.train, 1, 0.2, Blended(state.config))
    for name in ("vertices", "colors"):
        change = np.linalg.norm(getattr(two, name) - getattr(mesh, name))
        assert np.linalg.norm(getattr(one, name) - getattr(two, name)) <= CHANGES * change


def test_without_wgpu_there_is_an_error_and_nothing_is_written(scene, tmp_path, monkeypatch, capsys):
    from meshsplats import save_mesh
    from meshsplats.cli import main

    dataset, mesh = scene
    save_mesh(mesh, tmp_path / "mesh.npz")
    open_device.cache_clear()
    monkeypatch.setitem(sys.modules, "wgpu", None)
    try:
        with pytest.raises(MissingDependencyError, match="the GPU needs wgpu"):
            finetune(mesh, dataset, make_config(steps=1), run=RunOptions(tmp_path / "run", device="gpu"))
        words = [
            "finetune",
            str(tmp_path / "missing.ply"),
            "-o",
            str(tmp_path / "tuned.npz"),
            "--device",
            "gpu",
        ]
        assert main(words) == 5
        assert 'pip install "meshsplats[gpu]"' in capsys.readouterr().err
        assert main([*words, "--tuning.opacity", "cutoff"]) == 2
    finally:
        open_device.cache_clear()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.npz"]


@pytest.mark.slow
def test_the_command(tmp_path):
    need_gpu()
    from meshsplats import load_mesh, save_gaussians
    from meshsplats.cli import main

    save_gaussians(make_scene(200), tmp_path / "scene.ply")
    out = tmp_path / "tuned.npz"
    words = [str(tmp_path / "scene.ply"), "-o", str(out), "--device", "gpu", "--width", "32", "--steps", "3"]
    words += ["--views", "6", "--held-out", "2"]
    assert main(["finetune", *words]) == 0
    assert len(load_mesh(out).faces)
    assert main(["finetune", *words, "--steps", "5", "--resume", "--force"]) == 0
