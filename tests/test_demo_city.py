"""The city of splats: any count and degree, the same everywhere, one lot at a time."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats import load_gaussians
from meshsplats.demo_scene import city
from meshsplats.demo_scene.city import LOT, LOT_SPLATS, city_blocks

FIELDS = ("means", "quaternions", "scales", "opacities", "sh")


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_count_and_degree(degree):
    blocks = list(city_blocks(LOT_SPLATS + 501, degree=degree))
    assert [len(block) for block in blocks] == [LOT_SPLATS, 501]
    assert {block.sh_degree for block in blocks} == {degree}
    assert blocks[0].means[:, 1].max() <= 0.011  # y points down: nothing below the ground


def test_lots_are_the_same_in_every_degree_and_size():
    """Only the place of a lot depends on the size of the city, and only its gloss on the degree."""
    small = next(city_blocks(300, degree=0))
    for name in FIELDS[1:4]:
        np.testing.assert_array_equal(getattr(small, name), getattr(next(city_blocks(300)), name))
    again = next(city_blocks(300, degree=0))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(again, name), getattr(small, name))
    assert not np.array_equal(next(city_blocks(300, seed=1)).means, small.means)


def test_the_density_does_not_depend_on_the_count(monkeypatch):
    monkeypatch.setattr(city, "LOT_SPLATS", 300)
    for lots in (1, 4, 9):
        means = np.concatenate([block.means for block in city_blocks(300 * lots, degree=0)])
        side = LOT * np.sqrt(lots)
        np.testing.assert_allclose(np.ptp(means[:, [0, 2]], axis=0), side, rtol=0.02)


def test_what_it_refuses():
    with pytest.raises(ValueError, match="count must be at least 200"):
        next(city_blocks(199))
    with pytest.raises(ValueError, match="degree must be"):
        next(city_blocks(300, degree=4))


def test_it_is_written_as_a_file(tmp_path, capsys):
    city.main([str(tmp_path / "city.ply"), "450", "1"])
    cloud = load_gaussians(tmp_path / "city.ply")
    assert (len(cloud), cloud.sh_degree) == (450, 1)
    assert "450 splats" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="usage:"):
        city.main([str(tmp_path / "city.ply"), "many"])
