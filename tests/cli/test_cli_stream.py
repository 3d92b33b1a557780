"""``convert --stream``: the files of a conversion of the whole, byte for byte."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from meshsplats import convert, save_gaussians, save_mesh, save_mesh_blocks
from meshsplats.cli import main
from meshsplats.demo_scene import make_scene
from meshsplats.scene.mesh import SplatMesh


@pytest.fixture
def splats(tmp_path):
    save_gaussians(make_scene(900), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def run(*arguments) -> int:
    return main(["convert", *map(str, arguments)])


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(
    "options",
    [
        (),
        ("--preset", "paper"),
        ("--crop", -0.5, -2, -2, 2, 2, 2),
        ("--as-splats", "--set", "min_opacity=0.9"),
    ],
    ids=str,
)
def test_the_file_is_the_same(splats, tmp_path, capsys, options):
    whole, parts = tmp_path / "whole.ply", tmp_path / "parts.ply"
    assert run(splats, "-o", whole, *options, "--json") == 0
    expected = json.loads(capsys.readouterr().out)
    assert run(splats, "-o", parts, *options, "--stream", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert parts.read_bytes() == whole.read_bytes()
    for key in ("splats", "converted", "triangles", "vertices", "read", "written"):
        assert found.get(key) == expected.get(key)
    assert found["preview"] is None
    assert (tmp_path / "parts.ply.config.toml").is_file()
    assert run(splats, "-o", parts, *options, "--stream") == 3
    assert run(splats, "-o", parts, *options, "--stream", "--force") == 0


def test_a_warning_about_the_splats_comes_once(tmp_path, capsys):
    cloud = make_scene(900)
    save_gaussians(cloud, tmp_path / "scene.ply")
    data = bytearray((tmp_path / "scene.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start : start + 4] = np.float32(np.nan).tobytes()
    (tmp_path / "scene.ply").write_bytes(data)
    assert run(tmp_path / "scene.ply", "-o", tmp_path / "mesh.ply", "--stream") == 0
    assert capsys.readouterr().err.count("1 of 900 splats are unusable") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "a.glb"], "--stream writes .ply"),
        (["-o", "a.ply", "--fidelity", "2"], "need all in memory"),
        (["-o", "a.ply", "--alpha", "opaque"], "need all in memory"),
        (["-o", "a.ply", "--max-triangles", "900"], "limits on splats or triangles"),
        (["-o", "a.ply", "--as-splats", "--max-splats", "9"], "limits on splats or triangles"),
    ],
    ids=str,
)
def test_what_needs_the_whole_is_refused(splats, tmp_path, capsys, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert run(splats, *options, "--stream") in (1, 2)
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("a.*"))


def test_parts_are_written_as_the_whole(tmp_path):
    """Of a mesh with normals and attributes, cut between splats."""
    mesh = convert(make_scene(300))
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(len(mesh.vertices), 3))
    mesh = SplatMesh(
        mesh.vertices,
        mesh.faces,
        mesh.colors,
        face_splat=mesh.face_splat,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        attributes={"two words": rng.random((len(mesh.vertices), 2)), "one": rng.random(len(mesh.vertices))},
    )
    save_mesh(mesh, tmp_path / "whole.ply")
    half = mesh.face_splat < 120
    counts = save_mesh_blocks([mesh.take(half), mesh.take(~half)], tmp_path / "parts.ply")
    assert counts == (len(mesh.vertices), len(mesh.faces), mesh.splat_count)
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    with pytest.raises(ValueError, match=r"written as \.ply"):
        save_mesh_blocks([mesh], tmp_path / "parts.glb")
    for wrong, message in (
        (replace(mesh, normals=None), r"normals is 3 numbers wide first, missing in parts\[1\]"),
        (replace(mesh, depth_group=np.zeros(len(mesh.faces), int)), "depth groups of parts"),
    ):
        with pytest.raises(ValueError, match=message):
            save_mesh_blocks([mesh, wrong], tmp_path / "none.ply")
    with pytest.raises(ValueError, match=rf"^{re.escape(str(tmp_path / 'none.ply'))}: no mesh to write"):
        save_mesh_blocks([], tmp_path / "none.ply")
    assert not (tmp_path / "none.ply").exists()
