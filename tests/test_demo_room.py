"""The room of splats: closed from within, noise behind its walls, the same everywhere."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats import load_gaussians, render_splats
from meshsplats.cameras.trajectories import look_at
from meshsplats.demo_scene import room
from meshsplats.demo_scene.room import FEWEST, HALF, MIDDLE, SHARES, make_room


def test_count_and_seed():
    small = make_room(FEWEST)
    assert len(small) == FEWEST
    assert small.sh_degree == 3
    for name in ("means", "quaternions", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(small, name), getattr(make_room(FEWEST), name))
    assert not np.array_equal(small.means, make_room(FEWEST, seed=1).means)
    with pytest.raises(ValueError, match=f"count must be at least {FEWEST}"):
        make_room(FEWEST - 1)


def test_noise_is_behind_the_walls_and_nothing_else():
    cloud = make_room(4000)
    noise = int(SHARES["noise"] * 4000)
    beyond = (np.abs(cloud.means - MIDDLE) / HALF).max(axis=1)
    assert beyond[:-noise].max() < 1.01
    assert beyond[-noise:].min() > 1.1


@pytest.mark.parametrize("toward", [(1, 0, 0), (-1, 0, 0), (0, 1, 0.1), (0, -1, 0.1), (0, 0, 1), (0, 0, -1)])
def test_it_is_closed(toward):
    cloud = make_room(20_000)
    camera = look_at(MIDDLE, MIDDLE + toward, width=24, height=24, fov=80, near=0.05)
    assert render_splats(cloud, camera).alpha.min() > 0.9


def test_it_is_written_as_a_file(tmp_path, capsys):
    room.main([str(tmp_path / "room.ply"), "2500"])
    assert len(load_gaussians(tmp_path / "room.ply")) == 2500
    assert "2,500 splats" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="usage:"):
        room.main([str(tmp_path / "room.ply"), "many"])
