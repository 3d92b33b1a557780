"""``--device gpu`` and what is said where there is no GPU."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from _gpu import need_gpu
from _rendering import soup

import meshsplats
from meshsplats import render, save_mesh
from meshsplats.cameras.files import load_cameras
from meshsplats.cli import main
from meshsplats.errors import MissingDependencyError
from meshsplats.formats.outputs import CAMERAS, beside
from meshsplats.images.reading import load_image


@pytest.fixture
def mesh_file(tmp_path):
    save_mesh(soup(1), tmp_path / "mesh.npz")
    return str(tmp_path / "mesh.npz")


@pytest.fixture
def no_wgpu(monkeypatch):
    from meshsplats.webgpu.device import open_device

    open_device.cache_clear()
    monkeypatch.setitem(sys.modules, "wgpu", None)
    yield
    open_device.cache_clear()


def test_render_on_the_gpu(tmp_path, mesh_file):
    need_gpu()
    out = tmp_path / "gpu.png"
    assert (
        main(["render", mesh_file, "-o", str(out), "--width", "60", "--samples", "1", "--device", "gpu"]) == 0
    )
    view = load_cameras(beside(out, CAMERAS))[0]
    expected = render(meshsplats.load_mesh(mesh_file), view).color
    assert np.abs(load_image(out).astype(float) - 255 * np.clip(expected, 0, 1)).max() <= 1


def test_without_wgpu_commands_say_so_before_any_work(tmp_path, capsys, mesh_file, no_wgpu):
    for command in (
        ["render", mesh_file, "-o", str(tmp_path / "a.png"), "--device", "gpu"],
        ["compare", str(tmp_path / "missing.ply"), mesh_file, "-o", str(tmp_path / "b"), "--device", "gpu"],
    ):
        assert main(command) == 5
        assert 'pip install "meshsplats[gpu]"' in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mesh.npz"]
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["gpu"]
    assert not found["works"]
    assert "wgpu" in found["problem"]


def test_without_wgpu_render_never_falls_back(no_wgpu):
    from _rendering import camera

    with pytest.raises(MissingDependencyError, match="the GPU needs wgpu"):
        render(soup(1), camera(), device="gpu")


def test_devices_are_checked():
    from _rendering import camera

    with pytest.raises(ValueError, match="device must be 'cpu' or 'gpu', got 'cuda'"):
        render(soup(1), camera(), device="cuda")  # type: ignore[arg-type]


def test_splats_are_not_drawn_on_the_gpu(tmp_path, capsys):
    assert main(["render", "x.ply", "-o", str(tmp_path / "a.png"), "--as-splats", "--device", "gpu"]) == 2
    assert "leave out --as-splats" in capsys.readouterr().err
