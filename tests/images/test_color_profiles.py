"""Colour profiles inside photographs."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from _profiles import profile
from PIL import Image, ImageCms

from meshsplats.errors import DataWarning
from meshsplats.images import reading
from meshsplats.images.reading import converted_profile, load_image


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


def test_profiles_that_change_colours_have_a_name(tmp_path):
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    cases = {"other": profile(), "srgb": srgb, "broken": b"no profile"}
    paths = {name: colored(tmp_path / f"{name}.png", (9, 9, 9), icc_profile=p) for name, p in cases.items()}
    assert converted_profile(paths["other"]) == "another colour profile"  # it has no name
    assert converted_profile(paths["srgb"]) == converted_profile(paths["broken"]) == ""
    assert converted_profile(colored(tmp_path / "plain.png", (9, 9, 9))) == ""
