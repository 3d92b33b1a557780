"""Scales and opacities as training stores them: logarithms and logits."""

from __future__ import annotations

import numpy as np

MIN_LOG_SCALE = float(np.log(np.finfo(np.float32).tiny))
"""Stored for a scale of 0, whose logarithm is not finite: -87.3."""
MAX_LOG_SCALE = 88.72283
"""Stored for the largest float32, whose logarithm, rounded to float32, is that of infinity."""
MIN_LOGIT, MAX_LOGIT = -30.0, 20.0
"""Stored for opacities of 0 and 1; the float32 sigmoid of 20 is exactly 1."""


def activated_scales(logs: np.ndarray) -> np.ndarray:
    """Standard deviations from their logarithms, in their type; infinite ones give 0 and infinity."""
    with np.errstate(over="ignore"):
        return np.exp(logs)


def activated_opacities(logits: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Opacities from ``logits``, in their type; infinite ones give 0 and 1."""
    with np.errstate(over="ignore"):
        return np.divide(1, 1 + np.exp(-logits), out=out)


def log_scales(scales: np.ndarray) -> np.ndarray:
    """float32 logarithms of ``scales``, from ``MIN_LOG_SCALE`` to ``MAX_LOG_SCALE``."""
    with np.errstate(divide="ignore"):
        return np.clip(np.log(scales), MIN_LOG_SCALE, MAX_LOG_SCALE).astype(np.float32, copy=False)


def logits(opacities: np.ndarray) -> np.ndarray:
    """float32 logits of ``opacities``, from ``MIN_LOGIT`` to ``MAX_LOGIT``."""
    exact = opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        return np.clip(np.log(exact) - np.log1p(-exact), MIN_LOGIT, MAX_LOGIT).astype(np.float32)
