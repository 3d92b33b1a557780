"""Losses of one's own in fine-tuning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats.conversion import convert
from meshsplats.datasets.splat_targets import splat_dataset
from meshsplats.datasets.views import Dataset, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DivergenceError, OtherRunError
from meshsplats.finetuning import Interrupted, RunOptions, finetune, make_config
from meshsplats.finetuning.loss import DefaultLoss, Target, loss_name
from meshsplats.scene.mesh import SplatMesh

QUIET = RunOptions(report_every=0)


@pytest.fixture(scope="module")
def scene():
    """A data set of images of splats, and their mesh."""
    cloud = make_scene(200)
    dataset = splat_dataset(cloud, train=6, test=2, width=32, sh_degree=0)
    return dataset, convert(cloud, cameras=[view.camera for view in dataset.train])


def bits(mesh: SplatMesh) -> bytes:
    return b"".join(array.tobytes() for array in (mesh.vertices, mesh.faces, mesh.colors))


def reds(image: np.ndarray, target: Target) -> tuple[float, np.ndarray]:
    """Mean squared difference of the red channel alone."""
    difference = (image - target.color) * np.float32([1, 0, 0])
    return float(np.square(difference).mean()), 2 * difference / difference.size


@pytest.mark.parametrize(
    "options",
    [{}, {"exposure": True}, {"blending": "linear"}, {"opacity": "cutoff", "soft_share": 0.2}],
    ids=lambda options: ", ".join(options) or "default",
)
def test_the_default_loss_as_a_function_has_the_same_bits(scene, options):
    dataset, mesh = scene
    config = make_config(steps=10, **options)
    default = DefaultLoss.of(config)
    calls = []

    def same(image, target):
        calls.append(image.shape)
        return default(image, target)

    tuned, known = (finetune(mesh, dataset, config, run=QUIET, loss=loss) for loss in (same, None))
    assert calls == [(32, 32, 3)] * 10
    assert bits(tuned) == bits(known) != bits(mesh)


def test_a_loss_decides_what_is_learned(scene):
    dataset, mesh = scene
    tuned = finetune(mesh, dataset, steps=6, position_rate=0, run=QUIET, loss=reds)
    changed = (tuned.colors != mesh.colors).any(axis=0)
    assert changed[0]
    assert not changed[1:3].any()


def test_masked_pixels_come_with_their_mask(scene):
    dataset, mesh = scene
    mask = np.zeros((32, 32), bool)
    mask[:9] = True
    views = [replace(view, source=replace(view.load(), mask=mask)) for view in dataset.train]
    found = []

    def noted(image, target):
        found.append(target.mask)
        return reds(image, target)

    finetune(mesh, replace(dataset, train=tuple(views)), steps=1, run=QUIET, loss=noted)
    assert np.array_equal(found[0], mask)


def test_a_loss_may_change_what_it_is_given(scene):
    """The mask is that of later steps, the target that of the expected error."""
    dataset, mesh = scene
    mask = np.arange(32 * 32).reshape(32, 32) % 3 > 0
    views = tuple(replace(view, source=ViewImage(view.image, None, mask)) for view in dataset.train)

    def careful(image, target):
        difference = np.where(target.mask[..., None], image - target.color, 0)
        return float(np.square(difference).mean()), 2 * difference / difference.size

    def careless(image, target):
        found = careful(image, target)
        image[:], target.color[:], target.mask[:] = np.nan, np.nan, False
        return found

    one, two = (
        finetune(mesh, Dataset(views, ()), steps=12, opacity="cutoff", anneal_share=0.1, run=QUIET, loss=loss)
        for loss in (careful, careless)
    )
    assert bits(one) == bits(two)


WRONG = [
    (lambda image, target: 1.0, TypeError, "must return its value and its gradient, got 1.0, a float"),
    (lambda image, target: ("1", image), TypeError, "must return a number as its value, got the text '1'"),
    (lambda image, target: (image, image), TypeError, "must return a number as its value, got a NumPy array"),
    (lambda image, target: (1.0, image.astype(int)), TypeError, "must be floats, got int64"),
    (
        lambda image, target: (1.0, image[..., 0]),
        ValueError,
        r"shape of the image, \(32, 32, 3\), got \(32, 32\)",
    ),
    (lambda image, target: (np.nan, image), DivergenceError, "step 1, view '.*': the loss is not finite"),
    (
        lambda image, target: (1.0, image * np.inf),
        DivergenceError,
        "gradient of the loss .*lambda> is not finite",
    ),
    (7, TypeError, "loss must be a function of an image and its target, got 7"),
]


@pytest.mark.parametrize(("loss", "error", "message"), WRONG)
def test_what_is_wrong_with_a_loss_is_said(scene, loss, error, message):
    dataset, mesh = scene
    with pytest.raises(error, match=message):
        finetune(mesh, dataset, steps=2, run=QUIET, loss=loss)


def test_weights_of_the_default_loss_are_refused_beside_another(scene, tmp_path):
    dataset, mesh = scene
    run = RunOptions(tmp_path / "run")
    cut = {"opacity": "cutoff"}
    for options in (
        {"ssim_weight": 0.1},
        {"l2_weight": 1.0},
        {"ssim_weight": 0.1, **cut},
        {"l2_weight": 1.0, "expected_share": 0.0, **cut},
    ):
        with pytest.raises(ValueError, match="is a weight of the default loss: leave out"):
            finetune(mesh, dataset, steps=1, run=run, loss=reds, **options)
    assert not run.folder.exists()
    # There, it weighs the expected error, too.
    finetune(mesh, dataset, steps=1, run=QUIET, loss=reds, l2_weight=1.0, **cut)


def test_a_run_is_resumed_with_the_loss_of_that_name(scene, tmp_path):
    dataset, mesh = scene
    whole = finetune(mesh, dataset, steps=8, run=QUIET, loss=reds)
    run = RunOptions(tmp_path / "run", report_every=0, preview_every=0, checkpoint_seconds=1e-9)

    def halt(progress):
        if progress.step == 3:
            raise Interrupted(3, 2)

    with pytest.raises(Interrupted):
        finetune(mesh, dataset, steps=8, run=run, loss=reds, on_progress=halt)
    again = replace(run, resume=True)
    with pytest.raises(OtherRunError, match=r"with the loss .*test_loss\.reds, this run has default: give"):
        finetune(mesh, dataset, steps=8, run=again)
    assert bits(finetune(mesh, dataset, steps=8, run=again, loss=reds)) == bits(whole)


def test_names_of_losses():
    class Robust:
        def __call__(self, image, target):
            return reds(image, target)

    assert loss_name(None) == loss_name(DefaultLoss(0.4, 10.0)) == "default"
    assert loss_name(reds) == f"{__name__}.reds"
    assert loss_name(Robust()).endswith(".Robust")


def test_a_loss_in_torch(scene):
    torch = pytest.importorskip("torch")
    from meshsplats.finetuning.losses import from_torch, photometric_loss

    dataset, mesh = scene
    config = make_config(steps=8, l2_weight=0.0)

    def similar(image, target, mask):
        assert target.dtype == torch.float32
        return photometric_loss(image, target, mask=mask)

    loss = from_torch(similar)
    assert loss_name(loss) == loss_name(similar)
    tuned, known = (finetune(mesh, dataset, config, run=QUIET, loss=one) for one in (loss, None))
    change = np.linalg.norm(known.vertices - mesh.vertices)
    assert np.linalg.norm(tuned.vertices - known.vertices) < 1e-3 * change
    with pytest.raises(TypeError, match="must return a tensor with one number that depends on the image"):
        finetune(mesh, dataset, config, run=QUIET, loss=from_torch(lambda image, target, mask: image))
