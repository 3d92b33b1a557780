"""The page as a whole, on a desktop and on a phone: a layout that falls apart passes every other test."""

from __future__ import annotations

import numpy as np
import pytest
from _screens import REFERENCES, SCREENS, font, take, write_page
from PIL import Image

MOST_MEAN = 1.0
"""Levels by which blocks may differ on average. Two runs on one machine: 0.00."""
MOST_OFF = 0.004
"""Share of the blocks of which a channel may differ by more than ``OFF`` levels."""
OFF = 30


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    if not font():
        pytest.skip("Pillow has no font inside: the letters would be others than those of the references")
    return write_page(tmp_path_factory.mktemp("screens"))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", SCREENS)
def test_the_screen_is_that_of_the_reference(browser, address, name):
    with Image.open(REFERENCES / f"{name}.png") as image:
        reference = np.asarray(image.convert("RGB")).astype(int)
    found = take(browser, address, name).astype(int)
    assert found.shape == reference.shape
    difference = np.abs(found - reference)
    off = float((difference.max(axis=2) > OFF).mean())
    said = f"{difference.mean():.2f} levels on average, {off:.2%} of the blocks differ"
    good = difference.mean() <= MOST_MEAN and off <= MOST_OFF
    assert good, f"{said}; where that is meant, python tests/viewer/_screens.py draws the references anew"
