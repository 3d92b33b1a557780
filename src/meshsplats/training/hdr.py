"""Frames of HDR videos, as phones record them, in the colours of ordinary images."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear

HLG, PQ = 18, 16
"""FFmpeg's numbers of the transfer functions of HDR (ITU-R BT.2100)..."""
WIDE = 9
"""... and of the primaries of BT.2020."""
WHITE = 203.0
"""Nits of white paper in HDR (ITU-R BT.2408), which is 1 in ordinary images; what is brighter is cut off."""
PEAK, GAMMA = 1000.0, 1.2
"""Nits of the display that HLG is meant for, and its exponent there."""
_LUMINANCE = np.array([0.2627, 0.678, 0.0593], np.float32)
_TO_SRGB = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""From the primaries of BT.2020 to those of sRGB (ITU-R BT.2087)."""


def is_hdr(transfer: int, primaries: int) -> bool:
    """Whether colours with these numbers of FFmpeg differ from sRGB by more than a camera's choice."""
    return transfer in (HLG, PQ) or primaries == WIDE


def as_srgb(values: np.ndarray, transfer: int, primaries: int) -> np.ndarray:
    """(h, w, 3) float32 sRGB in [0, 1] of the uint16 ``values`` (h, w, 3), RGB of these numbers of FFmpeg."""
    light = _light(transfer)[values]
    if transfer == HLG:
        light *= np.maximum(light @ _LUMINANCE, 1e-9)[..., None] ** np.float32(GAMMA - 1) * (PEAK / WHITE)
    if primaries == WIDE:
        light = light @ _TO_SRGB.T
    return linear_to_srgb(light.clip(0, 1)).astype(np.float32)


@lru_cache
def _light(transfer: int) -> np.ndarray:
    """(65536,) float32 light by value: of HLG in the scene, up to 1; else on a display, whose white is 1."""
    values = np.arange(65536) / 65535
    if transfer == HLG:
        bright = (np.exp((values - 0.55991073) / 0.17883277) + 0.28466892) / 12
        light = np.where(values <= 0.5, np.square(values) / 3, bright)
    elif transfer == PQ:
        root = values ** (1 / 78.84375)
        ratio = np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)
        light = 10_000 / WHITE * ratio ** (1 / 0.1593017578125)
    else:
        light = srgb_to_linear(values)
    return light.astype(np.float32)
