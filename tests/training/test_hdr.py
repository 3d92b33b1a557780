"""Videos of HDR: colours of surfaces as in an ordinary photograph."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

from meshsplats.training.hdr import HLG, PQ, WIDE, as_srgb, is_hdr
from meshsplats.training.video import save_frames

COLORS = np.array([[200, 40, 40], [40, 180, 60], [30, 60, 200], [128, 128, 128], [250, 250, 250], [0, 0, 0]])
"""sRGB."""
TO_WIDE = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])
LUMINANCE = np.array([0.2627, 0.678, 0.0593])


def nits(colors: np.ndarray) -> np.ndarray:
    """Of surfaces of these colours, primaries of BT.2020, where white has 203."""
    share = colors / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return 203 * light @ TO_WIDE.T


def hlg(light: np.ndarray) -> np.ndarray:
    """The signal of ITU-R BT.2100 for a display of 1,000 nits."""
    shown = light / 1000
    luminance = np.maximum(shown @ LUMINANCE, 1e-12)[..., None]
    scene = shown * luminance ** (1 / 1.2 - 1)
    upper = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3 * np.maximum(scene, 0)), upper)


def pq(light: np.ndarray) -> np.ndarray:
    power = (np.maximum(light, 0) / 10_000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


@pytest.mark.parametrize(("transfer", "encode"), [(HLG, hlg), (PQ, pq)])
def test_surfaces_have_the_colours_of_an_ordinary_photograph(transfer, encode):
    values = np.rint(65535 * encode(nits(COLORS))).astype(np.uint16)[None]
    found = as_srgb(values, transfer, WIDE)
    assert found.dtype == np.float32
    np.testing.assert_allclose(255 * found[0], COLORS, atol=1.0)
    bright = np.rint(65535 * encode(np.full((1, 1, 3), 600.0))).astype(np.uint16)
    assert (as_srgb(bright, transfer, WIDE) == 1).all()  # a lamp


def test_wide_colours_of_an_ordinary_curve():
    light = nits(COLORS) / 203
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)
    found = as_srgb(np.rint(65535 * values.clip(0, 1)).astype(np.uint16)[None], 14, WIDE)
    np.testing.assert_allclose(255 * found[0], COLORS, atol=1.0)
    assert is_hdr(14, WIDE)
    assert not is_hdr(1, 1)
    assert not is_hdr(2, 2)


def test_frames_of_an_hdr_video_are_brought_to_srgb(tmp_path):
    av = pytest.importorskip("av", reason="the library of videos is not installed")
    red, green, blue = hlg(nits(COLORS[0]))
    y = 0.2627 * red + 0.678 * green + 0.0593 * blue
    signal = (y, (blue - y) / (2 * (1 - 0.0593)), (red - y) / (2 * (1 - 0.2627)))
    planes = [round(64 + 876 * signal[0]), *(round(512 + 896 * value) for value in signal[1:])]
    path = tmp_path / "hdr.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p10le"
        context = stream.codec_context
        context.color_primaries, context.color_trc, context.colorspace, context.color_range = WIDE, HLG, 9, 1
        for i in range(3):
            frame = av.VideoFrame(64, 48, "yuv420p10le")
            for plane, value in zip(frame.planes, planes, strict=True):
                plane.update(np.full(plane.buffer_size // 2, value, np.uint16).tobytes())
            frame.colorspace, frame.color_range = 9, 1
            frame.pts, frame.time_base = i, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    said: list[str] = []
    save_frames(path, tmp_path / "frames", 2, said.append)
    seen = np.asarray(Image.open(tmp_path / "frames/images/0001.jpg"))[24, 32].astype(int)
    assert np.abs(seen - COLORS[0]).max() < 6
    assert "the video is HDR: its colours are brought to sRGB" in said
