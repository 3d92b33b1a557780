"""Adam on the rows of an array that a view reaches. Takes NumPy arrays or torch tensors; needs no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshsplats._core.kernels import AdamStep, adam_rows
from meshsplats._core.library import check_threads


class RowAdam:
    """Adam (Kingma & Ba 2015) for one array of which each gradient reaches only a few rows.

    Follows ``torch.optim.SparseAdam``: rows left out keep their values and their moments, and the bias
    corrections use the number of all steps. Concretely, in step t, for each selected row i and column j,

        mean[i, j]   += (1 - beta1) * (gradient[i, j] - mean[i, j])
        square[i, j] += (1 - beta2) * (gradient[i, j]**2 - square[i, j])
        rate[i]       = lr * scale[i] * sqrt(1 - beta2**t) / (1 - beta1**t)
        values[i, j] -= rate[i] * mean[i, j] / (sqrt(square[i, j]) + eps)

    after which the values are clamped to ``bounds``. A step reads and writes the selected rows only, once
    each.

    Args:
        values: (v, k) float32, C-contiguous: a NumPy array, or a torch tensor on the CPU (a leaf that
            requires a gradient, too). :meth:`step` changes it in place; no copy is kept. A copy of the
            optimiser has its own, unless both are copied together (``copy.deepcopy((values, optimiser))``).
        lr: learning rate, positive. The attribute of this name may be set between steps.
        betas: decay rates of the two moments, in [0, 1).
        eps: positive.
        scale: (v,) non-negative factors of the learning rate, one per row; None for 1. Positions, for
            instance, are optimised in units of each splat's size.
        bounds: smallest and largest value, for instance (0, 1) for colours.
        threads: maximum number of threads; all processors by default. The result does not depend on it.

    Attributes:
        mean, square: (v, k) float32, the first and second moment.
        steps: number of steps taken.

    Raises:
        TypeError: arrays of other types.
        ValueError: wrong shapes, values out of range, tensors that are not on the CPU.
    """

    def __init__(
        self,
        values: Any,
        *,
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        scale: np.ndarray | None = None,
        bounds: tuple[float, float] | None = None,
        threads: int | None = None,
    ) -> None:
        self._values = values
        array = self._array
        if array.ndim != 2 or 0 in array.shape[1:]:
            raise ValueError(f"values must have shape (v, k), got {array.shape}")
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must be two numbers in [0, 1), got {betas}")
        if not (eps > 0 and math.isfinite(eps)):
            raise ValueError(f"eps must be a positive number, got {eps}")
        low, high = (-math.inf, math.inf) if bounds is None else bounds
        if not low <= high:
            raise ValueError(f"bounds must be (low, high) with low <= high, got {bounds}")
        check_threads(threads)
        self.lr = lr
        self.betas, self.eps, self.bounds, self.threads = (betas[0], betas[1]), eps, (low, high), threads
        self.scale = _checked_scale(scale, len(array))
        self.mean = np.zeros_like(array)
        self.square = np.zeros_like(array)
        self.steps = 0

    @property
    def _array(self) -> np.ndarray:
        """The memory of the values as it is now: a tensor can be given another (``values.data = ...``), and
        a copy of this object has its own."""
        return _float32_array("values", self._values, writeable=True)

    @property
    def lr(self) -> float:
        """Learning rate of the next step."""
        return self._lr

    @lr.setter
    def lr(self, value: float) -> None:
        if not (value > 0 and math.isfinite(value)):
            raise ValueError(f"lr must be a positive number, got {value}")
        self._lr = float(value)

    def step(self, gradient: Any, rows: Any = None) -> None:
        """Takes one step along ``gradient``, (v, k) float32 like the values.

        Args:
            gradient: NumPy array or torch tensor. Only the selected rows are read.
            rows: the selected rows: a (v,) bool mask, int32 indices in increasing order, or None for all
                rows. NumPy array or torch tensor.

        Raises:
            TypeError, ValueError: as the class does, and ValueError for indices that are out of range or do
                not increase. Nothing has changed then.
        """
        values, array = self._array, _float32_array("gradient", gradient)
        if values.shape != self.mean.shape:
            raise ValueError(
                f"values must keep their shape {self.mean.shape}, got {values.shape}; use select"
            )
        if array.shape != values.shape:
            raise ValueError(f"gradient must have shape {values.shape} like the values, got {array.shape}")
        selected = None if rows is None else _mask_or_indices(rows, len(values))
        if selected is not None and selected.dtype not in (bool, np.int32):
            raise TypeError(f"rows must be a bool mask or int32 indices, got {selected.dtype}")
        step = AdamStep(self.next_rate(self.lr), self.betas, self.eps, self.scale, self.bounds)
        adam_rows(values, (self.mean, self.square), array, selected, step, self.threads)
        self.steps += 1
        _bump_version(self._values)

    def next_rate(self, lr: float) -> float:
        """The learning rate ``lr`` with the bias corrections of the next step."""
        steps = self.steps + 1
        return lr * math.sqrt(1 - self.betas[1] ** steps) / (1 - self.betas[0] ** steps)

    def state(self) -> dict[str, np.ndarray]:
        """Copies of ``mean``, ``square`` and ``steps``, for a checkpoint."""
        return {
            "mean": self.mean.copy(),
            "square": self.square.copy(),
            "steps": np.array(self.steps, np.int64),
        }

    def load_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Resumes from ``state``, made by :meth:`state` for values of the same shape.

        Raises ValueError if an entry is missing, has another shape, or is impossible.
        """
        missing = {"mean", "square", "steps"} - set(state)
        if missing:
            raise ValueError(f"the optimiser's state lacks {', '.join(sorted(missing))}")
        mean, square = (np.array(state[name], np.float32, order="C") for name in ("mean", "square"))
        for name, moment in (("mean", mean), ("square", square)):
            if moment.shape != self._array.shape:
                raise ValueError(f"{name} must have shape {self._array.shape}, got {moment.shape}")
            if not np.isfinite(moment).all():
                raise ValueError(f"{name} must be finite")
        if (square < 0).any():
            raise ValueError("square must not be negative")
        steps = np.asarray(state["steps"])
        if steps.shape != () or steps.dtype.kind not in "iu" or steps < 0:
            raise ValueError(f"steps must be a whole number, got {steps}")
        self.mean, self.square, self.steps = mean, square, int(steps)

    def select(self, values: Any, rows: Any) -> RowAdam:
        """The optimiser for an array that keeps only some rows, as after pruning.

        Args:
            values: the new array.
            rows: the rows of the old array that it holds: a (v,) bool mask, or indices in any order.

        Returns:
            An optimiser with the moments and scales of these rows, and the same steps and options.

        Raises:
            TypeError: rows of another type.
            ValueError: another number of rows than ``values`` has, indices out of range.
        """
        selected = _mask_or_indices(rows, len(self._array))
        indices = np.flatnonzero(selected) if selected.dtype == bool else selected
        if indices.size and not (indices.min() >= 0 and indices.max() < len(self._array)):
            raise ValueError(
                f"rows must lie in [0, {len(self._array)}), got {indices.min()} to {indices.max()}"
            )
        expected = (len(indices), self._array.shape[1])
        if np.shape(_as_numpy(values)) != expected:
            raise ValueError(f"values must have shape {expected}, got {np.shape(_as_numpy(values))}")
        result = RowAdam(
            values,
            lr=self.lr,
            betas=self.betas,
            eps=self.eps,
            scale=None if self.scale is None else self.scale[indices],
            bounds=self.bounds,
            threads=self.threads,
        )
        result.mean, result.square, result.steps = self.mean[indices], self.square[indices], self.steps
        return result

    def restart(self, rows: np.ndarray) -> None:
        """Zeroes the first moments of ``rows``, after their values were replaced."""
        self.mean[rows] = 0


def _as_numpy(array: Any) -> Any:
    """The NumPy array that shares the memory of a torch tensor; anything else unchanged."""
    if hasattr(array, "detach"):
        if array.device.type != "cpu":
            raise ValueError(f"tensors must be on the CPU, got one on {array.device}; use .cpu()")
        return array.detach().numpy()
    return array


def _float32_array(name: str, value: Any, writeable: bool = False) -> np.ndarray:
    array = _as_numpy(value)
    if not isinstance(array, np.ndarray) or array.dtype != np.float32:
        got = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise TypeError(f"{name} must be a float32 array or tensor, got {got}")
    if writeable and not (array.flags.c_contiguous and array.flags.writeable):
        raise ValueError(
            f"{name} must be C-contiguous and writeable, since steps change it in place; copy it first"
        )
    return np.ascontiguousarray(array)


def _checked_scale(scale: Any, length: int) -> np.ndarray | None:
    if scale is None:
        return None
    array = np.array(_as_numpy(scale), np.float32, order="C")
    if array.shape != (length,):
        raise ValueError(f"scale must have shape ({length},), one factor per row, got {array.shape}")
    if not (np.isfinite(array).all() and (array >= 0).all()):
        raise ValueError("scale must be finite and not negative")
    return array


def _mask_or_indices(rows: Any, length: int) -> np.ndarray:
    """``rows`` as a contiguous array: a (length,) bool mask or (n,) integers."""
    array = _as_numpy(rows)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "bi":
        got = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise TypeError(f"rows must be a bool mask or int32 indices, got {got}")
    is_mask = array.dtype == bool
    if array.ndim != 1 or (is_mask and len(array) != length):
        expected = f"({length},)" if is_mask else "(n,)"
        raise ValueError(f"rows must have shape {expected}, got {array.shape}")
    return np.ascontiguousarray(array)


def _bump_version(values: Any) -> None:
    """Marks a tensor as changed in place, so that autograd refuses graphs recorded before the step."""
    if hasattr(values, "detach"):
        from torch.autograd.graph import increment_version

        increment_version(values)
