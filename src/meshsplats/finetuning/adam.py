"""Adam on the rows of an array that a view reached. Takes NumPy arrays or torch tensors; needs no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from meshsplats._core.kernels import adam_rows


class RowAdam:
    """Adam (Kingma & Ba 2015) for one array whose gradient reaches few rows a step.

    Follows ``torch.optim.SparseAdam``: rows left out keep their values and their moments, and the bias
    corrections go by the number of all steps. Concretely, in step t, for each chosen row i and column j,

        mean[i, j]   += (1 - beta1) * (gradient[i, j] - mean[i, j])
        square[i, j] += (1 - beta2) * (gradient[i, j]**2 - square[i, j])
        rate[i]       = lr * scale[i] * sqrt(1 - beta2**t) / (1 - beta1**t)
        values[i, j] -= rate[i] * mean[i, j] / (sqrt(square[i, j]) + eps)

    and values end clamped to ``bounds``. A step reads and writes the chosen rows only, once each.

    Args:
        values: (v, k) float32, C-contiguous: a NumPy array, or a torch tensor on the CPU (a leaf that
            requires a gradient, too). It is changed in place by :meth:`step`, which holds no copy.
        lr: learning rate, positive. The attribute of this name may be set between steps.
        betas: decay of the two moments, in [0, 1).
        eps: positive.
        scale: (v,) non-negative factors of the learning rate, None for 1; positions are optimised in units of
            each splat's size in this way.
        bounds: smallest and largest value, for instance (0, 1) for colours.
        threads: at most this many; all processors by default. The result does not depend on it.

    Attributes:
        mean, square: (v, k) float32, the first and second moment.
        steps: number of steps made.

    Raises:
        TypeError: arrays of other types. ValueError: wrong shapes, values out of range, tensors elsewhere
        than on the CPU.
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
        self._array = _shared("values", values, writeable=True)
        if self._array.ndim != 2 or 0 in self._array.shape[1:]:
            raise ValueError(f"values must have shape (v, k), got {self._array.shape}")
        if len(betas) != 2 or not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must be two numbers in [0, 1), got {betas}")
        if not (eps > 0 and math.isfinite(eps)):
            raise ValueError(f"eps must be a positive number, got {eps}")
        low, high = (-math.inf, math.inf) if bounds is None else bounds
        if not low <= high:
            raise ValueError(f"bounds must be (low, high) with low <= high, got {bounds}")
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self.lr = lr
        self.betas, self.eps, self.bounds, self.threads = (betas[0], betas[1]), eps, (low, high), threads
        self.scale = _checked_scale(scale, len(self._array))
        self.mean = np.zeros_like(self._array)
        self.square = np.zeros_like(self._array)
        self.steps = 0

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
        """One step along ``gradient``, (v, k) float32 like the values, of which only chosen rows are read.

        ``rows`` names the rows: int32 row numbers in increasing order, a (v,) mask of bool or uint8 (0: left
        out), or None for every row. NumPy arrays or torch tensors.

        Raises TypeError and ValueError as the class does, and ValueError for row numbers that are out of
        range or do not increase; nothing has changed then.
        """
        array = _shared("gradient", gradient)
        if array.shape != self._array.shape:
            raise ValueError(
                f"gradient must have shape {self._array.shape} like the values, got {array.shape}"
            )
        chosen = _checked_rows(rows, len(self._array))
        steps = self.steps + 1
        step = self.lr * math.sqrt(1 - self.betas[1] ** steps) / (1 - self.betas[0] ** steps)
        adam_rows(
            self._array,
            self.mean,
            self.square,
            array,
            chosen,
            step=step,
            betas=self.betas,
            eps=self.eps,
            scale=self.scale,
            bounds=self.bounds,
            threads=self.threads,
        )
        self.steps = steps
        _mark_changed(self._values)

    def state(self) -> dict[str, np.ndarray]:
        """What a checkpoint has to hold: ``mean``, ``square`` and ``steps``, copied."""
        return {
            "mean": self.mean.copy(),
            "square": self.square.copy(),
            "steps": np.array(self.steps, np.int64),
        }

    def load_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes on from ``state``, made by :meth:`state` for values of the same shape.

        Raises ValueError if something is missing, of another shape, or impossible.
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
        """The optimiser for an array that kept only some rows, as after pruning.

        ``values`` is the new array, ``rows`` the rows of the old one that it holds, as in :meth:`step`
        (numbers in any order here). Moments, scales, steps and options are taken over.

        Raises ValueError if the numbers of rows differ, or row numbers are out of range.
        """
        index = np.asarray(_array(rows))
        if index.dtype in (bool, np.uint8):
            _checked_rows(index, len(self._array))
            index = np.flatnonzero(index)
        if index.ndim != 1 or index.dtype.kind not in "iu":
            raise TypeError(f"rows must be row numbers or a mask, got {index.dtype} of shape {index.shape}")
        if index.size and not (index.min() >= 0 and index.max() < len(self._array)):
            raise ValueError(f"rows must lie in [0, {len(self._array)}), got {index.min()} to {index.max()}")
        wanted = (len(index), self._array.shape[1])
        if np.shape(_array(values)) != wanted:
            raise ValueError(f"values must have shape {wanted}, got {np.shape(_array(values))}")
        result = RowAdam(
            values,
            lr=self.lr,
            betas=self.betas,
            eps=self.eps,
            scale=None if self.scale is None else self.scale[index],
            bounds=self.bounds,
            threads=self.threads,
        )
        result.mean, result.square, result.steps = self.mean[index], self.square[index], self.steps
        return result

    def restart(self, rows: np.ndarray, like: np.ndarray, scale: np.ndarray | None = None) -> None:
        """Rows whose values were set anew forget where they were going; how far they go in a step they take
        from the rows ``like``. Row numbers have any one shape; ``scale`` are new factors of the rate."""
        self.mean[rows] = 0
        self.square[rows] = self.square[like]
        if scale is not None and self.scale is not None:
            self.scale[rows] = scale


def _array(given: Any) -> Any:
    """The NumPy array that shares the memory of a torch tensor; anything else as it is."""
    if hasattr(given, "detach"):
        if given.device.type != "cpu":
            raise ValueError(f"tensors must be on the CPU, got one on {given.device}; use .cpu()")
        return given.detach().numpy()
    return given


def _shared(name: str, given: Any, writeable: bool = False) -> np.ndarray:
    array = _array(given)
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
    array = np.array(_array(scale), np.float32, order="C")
    if array.shape != (length,):
        raise ValueError(f"scale must have shape ({length},), one factor a row, got {array.shape}")
    if not (np.isfinite(array).all() and (array >= 0).all()):
        raise ValueError("scale must be finite and not negative")
    return array


def _checked_rows(rows: Any, length: int) -> np.ndarray | None:
    if rows is None:
        return None
    array = _array(rows)
    if not isinstance(array, np.ndarray) or array.dtype not in (np.int32, np.uint8, bool):
        got = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise TypeError(f"rows must be int32 row numbers or a mask of bool or uint8, got {got}")
    mask = array.dtype != np.int32
    if array.ndim != 1 or (mask and len(array) != length):
        wanted = f"({length},)" if mask else "(n,)"
        raise ValueError(f"rows must have shape {wanted}, got {array.shape}")
    array = np.ascontiguousarray(array)
    return array.view(bool) if array.dtype == np.uint8 else array


def _mark_changed(values: Any) -> None:
    """Tells autograd that a tensor changed, so that a graph made before the step is refused."""
    if hasattr(values, "detach"):
        from torch.autograd.graph import increment_version

        increment_version(values)
