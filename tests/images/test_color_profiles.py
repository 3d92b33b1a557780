"""Colour profiles inside photographs."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
from PIL import Image, ImageCms

from meshsplats.errors import DataWarning
from meshsplats.images import reading
from meshsplats.images.reading import load_image

ADOBE_RGB = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
"""XYZ (D50) of its primaries."""


def tag(kind: bytes, *values: float) -> bytes:
    numbers = [round(value * 65536) for value in values]
    return kind + bytes(4) + struct.pack(f">{len(values)}i", *numbers)


def profile(primaries=ADOBE_RGB, gamma=2.19921875) -> bytes:
    """An ICC profile of three primaries and a gamma."""
    curve = b"curv" + bytes(4) + struct.pack(">IHH", 1, round(gamma * 256), 0)
    tags = {b"wtpt": tag(b"XYZ ", 0.9642, 1.0, 0.8249)}
    for name, primary in zip((b"r", b"g", b"b"), primaries, strict=True):
        tags |= {name + b"XYZ": tag(b"XYZ ", *primary), name + b"TRC": curve}
    start, table, data = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", start + len(data), len(content))
        data += content
    head = struct.pack(">I4sI4s4s4s", start + len(data), bytes(4), 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + tag(b"", 0.9642, 1.0, 0.8249)[4:] + bytes(48)
    return head[:128] + table + data


def colored(path, color, mode="RGB", **options):
    Image.new(mode, (4, 3), color).save(path, **options)
    return path


def test_colours_of_other_profiles_become_srgb(tmp_path):
    path = colored(tmp_path / "a.png", (200, 40, 40), icc_profile=profile())
    assert load_image(path, to_srgb=True)[0, 0].tolist() == pytest.approx([233, 35, 35], abs=2)
    assert load_image(path)[0, 0].tolist() == [200, 40, 40]  # a texture, a mask


def test_alpha_is_kept(tmp_path):
    path = colored(tmp_path / "a.png", (200, 40, 40, 77), "RGBA", icc_profile=profile())
    assert load_image(path, to_srgb=True)[0, 0].tolist() == pytest.approx([233, 35, 35, 77], abs=2)


def test_plain_photographs_and_those_that_are_srgb_stay_exact(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (8, 9, 3)).astype(np.uint8)
    for options in ({}, {"icc_profile": ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()}):
        Image.fromarray(pixels).save(tmp_path / "a.png", **options)
        np.testing.assert_array_equal(load_image(tmp_path / "a.png", to_srgb=True), pixels)


@pytest.mark.parametrize("broken", [b"none", profile()[:200], profile().replace(b"RGB ", b"CMYK")])
def test_broken_profiles_are_ignored(tmp_path, broken):
    path = colored(tmp_path / "a.png", (200, 40, 40), icc_profile=broken)
    with pytest.warns(DataWarning, match=r"a\.png: its colour profile is ignored: "):
        assert load_image(path, to_srgb=True)[0, 0].tolist() == [200, 40, 40]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_image(path)


def test_profiles_that_are_too_large_are_ignored(tmp_path, monkeypatch):
    path = colored(tmp_path / "a.png", (200, 40, 40), icc_profile=profile(gamma=2))
    monkeypatch.setattr(reading, "MAX_PROFILE", 100)
    with pytest.warns(DataWarning, match="bytes are too many"):
        assert load_image(path, to_srgb=True)[0, 0].tolist() == [200, 40, 40]


def test_grey_photographs_with_a_profile_of_colours(tmp_path):
    path = colored(tmp_path / "a.png", 100, "L", icc_profile=profile())
    assert load_image(path, to_srgb=True)[0, 0].tolist() == pytest.approx([99, 99, 99], abs=3)
