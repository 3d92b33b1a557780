"""The optimiser's step against those of torch, a float64 twin, and by its laws."""

from __future__ import annotations

import copy
import hashlib
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats.finetuning.adam import RowAdam


def problem(seed: int, rows: int, columns: int, steps: int, share: float = 0.3):
    """Starting values, and for each step a gradient and the rows it reaches (indices, increasing)."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(rows, columns)).astype(np.float32)
    path = []
    for _ in range(steps):
        chosen = np.flatnonzero(rng.random(rows) < share).astype(np.int32)
        gradient = np.zeros((rows, columns), np.float32)
        gradient[chosen] = rng.normal(size=(len(chosen), columns)) * 10.0 ** rng.uniform(-6, 2)
        path.append((gradient, chosen))
    return values, path


def as_mask(chosen: np.ndarray, rows: int) -> np.ndarray:
    mask = np.zeros(rows, bool)
    mask[chosen] = True
    return mask


def twin(values, path, *, lr, betas=(0.9, 0.999), eps=1e-8, scale=None, bounds=(-math.inf, math.inf)):
    """The step as its formula, in float64."""
    values, mean, square = values.astype(np.float64), np.zeros(values.shape), np.zeros(values.shape)
    scale = np.ones(len(values)) if scale is None else scale.astype(np.float64)
    for t, (gradient, r) in enumerate(path, 1):
        g = gradient[r].astype(np.float64)
        mean[r] = betas[0] * mean[r] + (1 - betas[0]) * g
        square[r] = betas[1] * square[r] + (1 - betas[1]) * g * g
        rate = lr * math.sqrt(1 - betas[1] ** t) / (1 - betas[0] ** t)
        moved = values[r] - rate * scale[r, None] * mean[r] / (np.sqrt(square[r]) + eps)
        values[r] = np.clip(moved, *bounds)
    return values, mean, square


@pytest.mark.parametrize("columns", [1, 3, 4, 7, 300])
def test_steps_are_the_formula(columns):
    rows = 400 if columns < 300 else 12
    values, path = problem(1, rows, columns, 12)
    scale = np.random.default_rng(2).uniform(0, 5, rows).astype(np.float32)
    options = dict(lr=0.03, betas=(0.8, 0.99), eps=1e-6, scale=scale, bounds=(-0.5, 1.5))
    expected, mean, square = twin(values, path, **options)
    adam = RowAdam(values, **options)
    for gradient, chosen in path:
        adam.step(gradient, chosen)
    assert adam.steps == 12
    assert np.allclose(values, expected, rtol=1e-5, atol=2e-6)
    assert np.allclose(adam.mean, mean, rtol=1e-4, atol=1e-6 * abs(mean).max())
    assert np.allclose(adam.square, square, rtol=1e-4, atol=1e-6 * abs(square).max())
    reached = values[np.unique(np.concatenate([chosen for _, chosen in path]))]
    assert reached.min() == -0.5
    assert reached.max() == 1.5


@pytest.mark.slow(keep=1)
@pytest.mark.filterwarnings("ignore:Sparse invariant checks")
@pytest.mark.parametrize("columns", [3, 4])
def test_steps_are_those_of_sparse_adam(columns):
    torch = pytest.importorskip("torch", reason="torch's optimiser is the model here")
    values, path = problem(3, 500, columns, 25)
    ours = torch.from_numpy(values.copy())
    theirs = torch.from_numpy(values.copy()).requires_grad_()
    adam = RowAdam(ours, lr=0.02)
    model = torch.optim.SparseAdam([theirs], lr=0.02)
    for gradient, chosen in path:
        index, full = torch.from_numpy(chosen).long(), torch.from_numpy(gradient)
        theirs.grad = torch.sparse_coo_tensor(index[None], full[index], full.shape)
        model.step()
        adam.step(full, torch.from_numpy(chosen))
    state = model.state[theirs]
    # Within the last digits of 25 additions.
    assert np.allclose(ours.numpy(), theirs.detach().numpy(), rtol=3e-7, atol=3e-7)
    assert np.allclose(adam.mean, state["exp_avg"].numpy(), rtol=1e-6, atol=1e-7)
    assert np.allclose(adam.square, state["exp_avg_sq"].numpy(), rtol=1e-6, atol=1e-7)
    assert adam.steps == state["step"]


def test_a_step_on_all_rows_is_adam_but_for_epsilon():
    torch = pytest.importorskip("torch", reason="torch's optimiser is the model here")
    values, path = problem(4, 200, 3, 20, share=1)
    theirs = torch.from_numpy(values.copy()).requires_grad_()
    # Adam adds eps after the correction of the second moment, SparseAdam before: equal without eps.
    model = torch.optim.Adam([theirs], lr=0.02, eps=1e-30)
    adam = RowAdam(values, lr=0.02, eps=1e-30)
    for gradient, _ in path:
        theirs.grad = torch.from_numpy(gradient)
        model.step()
        adam.step(gradient)
    assert np.allclose(values, theirs.detach().numpy(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["deepcopy", "pickle"])
def test_a_copy_of_the_optimiser_moves_the_values_copied_with_it(kind):
    values = np.ones((2, 3), np.float32)
    both = values, RowAdam(values, lr=0.1)
    copied, adam = copy.deepcopy(both) if kind == "deepcopy" else pickle.loads(pickle.dumps(both))
    adam.step(np.ones_like(values))
    assert np.allclose(copied, 0.9)
    assert (values == 1).all()


def test_a_tensor_with_other_memory_is_stepped_there():
    torch = pytest.importorskip("torch", reason="the values are a tensor")
    values = torch.ones(2, 3, requires_grad=True)
    adam = RowAdam(values, lr=0.1)
    values.data = torch.full((2, 3), 5.0)
    adam.step(torch.ones(2, 3))
    assert torch.allclose(values, torch.full((2, 3), 4.9))
    values.data = torch.ones(3, 3)
    with pytest.raises(ValueError, match=r"must keep their shape \(2, 3\), got \(3, 3\)"):
        adam.step(torch.ones(3, 3))


def test_first_steps_by_hand():
    values = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], np.float32)
    adam = RowAdam(values, lr=0.1)
    gradient = np.array([[8.0, -8.0], [np.nan, np.nan], [0.5, 0.0]], np.float32)
    adam.step(gradient, np.array([0, 2], np.int32))
    # In the first step every value moves by lr against the sign of its gradient; rows left out are not read.
    assert np.allclose(values, [[0.9, 2.1], [3.0, 4.0], [4.9, 6.0]], atol=1e-6)
    assert np.allclose(adam.mean, [[0.8, -0.8], [0, 0], [0.05, 0]], atol=1e-7)
    assert np.allclose(adam.square, [[0.064, 0.064], [0, 0], [0.00025, 0]], atol=1e-7)
    # A row that joins in step 2 gets the corrections of step 2.
    adam.step(np.ones_like(values), np.array([1], np.int32))
    moved = 0.1 * math.sqrt(1 - 0.999**2) / (1 - 0.9**2) * 0.1 / math.sqrt(0.001)
    assert values[1] == pytest.approx([3 - moved, 4 - moved], abs=1e-6)
    assert np.allclose(values[[0, 2]], [[0.9, 2.1], [4.9, 6.0]], atol=1e-6)


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), rows=st.integers(1, 200), share=st.sampled_from([0, 0.05, 0.5, 0.95, 1]))
def test_masks_indices_and_parts_agree(seed, rows, share):
    values, path = problem(seed, rows, 3, 3, share)
    kinds = {
        "indices": lambda r: r,
        "mask": lambda r: as_mask(r, rows),
        # Row by row: no row looks at another one.
        "one by one": None,
    }
    results = []
    for name, kind in kinds.items():
        array = values.copy()
        adam = RowAdam(array, lr=0.1, bounds=(-1, 1))
        for gradient, chosen in path:
            if kind is not None:
                adam.step(gradient, kind(chosen))
                continue
            adam.step(gradient, chosen[:0])
            for row in chosen:
                adam.steps -= 1
                adam.step(gradient, np.array([row], np.int32))
        results.append((name, array, adam.mean, adam.square))
        untouched = np.setdiff1d(np.arange(rows), np.concatenate([r for _, r in path]))
        assert np.array_equal(array[untouched], values[untouched])
    for _, *arrays in results[1:]:
        for a, b in zip(arrays, results[0][1:], strict=True):
            assert np.array_equal(a, b)


def digest(threads: int | None) -> str:
    total = hashlib.sha256()
    for columns in (3, 4, 7):
        values, path = problem(5, 40_000, columns, 3, 0.4)
        scale = np.random.default_rng(6).random(40_000).astype(np.float32)
        adam = RowAdam(values, lr=0.1, scale=scale, bounds=(-1, 1), threads=threads)
        for gradient, chosen in path:
            adam.step(gradient, chosen)
            adam.step(gradient, as_mask(chosen, 40_000))
            adam.step(gradient)
        total.update(values.tobytes() + adam.mean.tobytes() + adam.square.tobytes())
    return total.hexdigest()


@pytest.mark.slow
def test_threads_and_variants_do_not_change_a_bit():
    from test_rendering_variants import in_another_process

    from meshsplats._core import library

    expected = digest(None)
    for threads in (1, 2, 7, 100):
        assert digest(threads) == expected
    for variant in library.available_variants()[1:]:
        code = "import test_adam; print(test_adam.digest(2))"
        assert in_another_process(code, MESHSPLATS_VARIANT=variant) == expected


def test_what_was_saved_goes_on():
    values, path = problem(7, 50, 4, 6)
    whole = values.copy()
    adam = RowAdam(whole, lr=0.1)
    for gradient, chosen in path:
        adam.step(gradient, chosen)
    first = RowAdam(values, lr=0.1)
    for gradient, chosen in path[:3]:
        first.step(gradient, chosen)
    state = first.state()
    first.step(path[0][0])  # what is saved is a copy
    values[:] = 0
    again, _ = problem(7, 50, 4, 6)
    resumed = RowAdam(again, lr=0.1)
    for gradient, chosen in path[:3]:
        resumed.step(gradient, chosen)
    resumed.mean[:], resumed.square[:], resumed.steps = 9, 9, 99
    resumed.load_state(state)
    for gradient, chosen in path[3:]:
        resumed.step(gradient, chosen)
    assert np.array_equal(again, whole)


def test_rows_that_stay_keep_their_moments():
    values, path = problem(8, 60, 3, 4)
    scale = np.linspace(0.5, 2, 60, dtype=np.float32)
    adam = RowAdam(values, lr=0.1, scale=scale, bounds=(-2, 2), eps=1e-6, betas=(0.7, 0.9))
    for gradient, chosen in path:
        adam.step(gradient, chosen)
    kept = np.random.default_rng(9).random(60) < 0.5
    for rows in (kept, np.flatnonzero(kept)):
        part = values[kept].copy()
        pruned = adam.select(part, rows)
        whole = values.copy()
        full = adam.select(whole, np.arange(60))
        gradient = np.random.default_rng(10).normal(size=(60, 3)).astype(np.float32)
        full.step(gradient)
        pruned.step(gradient[kept])
        assert np.array_equal(part, whole[kept])
        assert pruned.steps == 5
    with pytest.raises(ValueError, match=r"values must have shape \(2, 3\), got \(3, 3\)"):
        adam.select(values[:3].copy(), np.array([0, 1]))
    with pytest.raises(ValueError, match=r"rows must lie in \[0, 60\), got -1 to 4"):
        adam.select(values[:2].copy(), np.array([-1, 4]))
    for bad in ([0, 1], np.array([0.0, 1.0]), kept.astype(np.uint8)):
        with pytest.raises(TypeError, match="rows must be a bool mask or int32 indices"):
            adam.select(values[:2].copy(), bad)


def test_the_learning_rate_can_change():
    values = np.zeros((1, 1), np.float32)
    adam = RowAdam(values, lr=0.1)
    gradient = np.ones((1, 1), np.float32)
    adam.step(gradient)
    adam.lr = 0.01
    adam.step(gradient)
    assert values[0, 0] == pytest.approx(-0.11, abs=1e-6)
    with pytest.raises(ValueError, match="lr must be a positive number, got 0"):
        adam.lr = 0


def test_autograd_notices_the_change():
    torch = pytest.importorskip("torch", reason="about torch tensors")
    leaf = torch.ones(4, 3, requires_grad=True)
    adam = RowAdam(leaf, lr=0.1)
    loss = (leaf * leaf).sum()
    loss.backward(retain_graph=True)
    adam.step(leaf.grad)
    assert torch.allclose(leaf, torch.full((4, 3), 0.9))
    # The graph was made for the old values.
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_bad_arguments_are_refused():
    values = np.zeros((5, 3), np.float32)
    for bad, error, match in [
        ([[1.0]], TypeError, "values must be a float32 array or tensor, got list"),
        (values.astype(np.float64), TypeError, "got float64"),
        (values[0], ValueError, r"shape \(v, k\), got \(3,\)"),
        (values[:, :0].copy(), ValueError, r"shape \(v, k\), got \(5, 0\)"),
        (values[:, :2], ValueError, "C-contiguous and writeable"),
    ]:
        with pytest.raises(error, match=match):
            RowAdam(bad, lr=0.1)
    frozen = values.copy()
    frozen.flags.writeable = False
    with pytest.raises(ValueError, match="writeable"):
        RowAdam(frozen, lr=0.1)
    for options, match in [
        (dict(lr=0), "lr must be a positive number"),
        (dict(lr=math.nan), "lr must be a positive number"),
        (dict(betas=(1, 0.9)), r"betas must be two numbers in \[0, 1\)"),
        (dict(betas=(0.9,)), "betas must be two numbers"),
        (dict(eps=0), "eps must be a positive number"),
        (dict(bounds=(1, 0)), "low <= high"),
        (dict(bounds=(0, math.nan)), "low <= high"),
        (dict(scale=np.ones(4)), r"scale must have shape \(5,\)"),
        (dict(scale=-np.ones(5)), "not negative"),
        (dict(scale=np.full(5, np.inf)), "finite"),
        (dict(threads=0), "threads must be at least 1"),
    ]:
        with pytest.raises(ValueError, match=match):
            RowAdam(values, **{"lr": 0.1, **options})


def test_bad_steps_change_nothing():
    values = np.zeros((5, 3), np.float32)
    adam = RowAdam(values, lr=0.1)
    gradient = np.ones((5, 3), np.float32)
    for rows, error, match in [
        ([0, 1], TypeError, "rows must be a bool mask or int32 indices, got list"),
        (np.array([0, 1], np.int64), TypeError, "got int64"),
        (np.ones(5, np.uint8), TypeError, "got uint8"),
        (np.zeros(4, bool), ValueError, r"shape \(5,\), got \(4,\)"),
        (np.zeros((1, 1), np.int32), ValueError, r"shape \(n,\), got \(1, 1\)"),
        (np.array([0, 1, 5], np.int32), ValueError, r"lie in \[0, 5\), got 5 at index 2"),
        (np.array([-1, 1], np.int32), ValueError, r"got -1 at index 0"),
        (np.array([0, 2, 2], np.int32), ValueError, r"must increase .* got 2 at index 2"),
        (np.array([3, 1], np.int32), ValueError, r"got 1 at index 1"),
    ]:
        with pytest.raises(error, match=match):
            adam.step(gradient, rows)
    with pytest.raises(ValueError, match=r"gradient must have shape \(5, 3\)"):
        adam.step(gradient[:4])
    with pytest.raises(TypeError, match="gradient must be a float32 array"):
        adam.step(gradient.astype(np.float64))
    assert adam.steps == 0
    assert not values.any()
    assert not adam.mean.any()


def test_bad_states_are_refused():
    adam = RowAdam(np.zeros((5, 3), np.float32), lr=0.1)
    good = adam.state()
    for change, match in [
        (dict(mean=np.zeros((4, 3))), r"mean must have shape \(5, 3\)"),
        (dict(square=np.full((5, 3), np.nan)), "square must be finite"),
        (dict(square=-np.ones((5, 3))), "square must not be negative"),
        (dict(steps=np.array(-1)), "steps must be a whole number"),
        (dict(steps=np.array(1.5)), "steps must be a whole number"),
    ]:
        with pytest.raises(ValueError, match=match):
            adam.load_state({**good, **change})
    del good["mean"], good["steps"]
    with pytest.raises(ValueError, match="lacks mean, steps"):
        adam.load_state(good)
