"""Chains of levels of detail are read as ``meshsplats levels`` writes them, and refused in words."""

from __future__ import annotations

import json

import pytest
from _blender_scenes import ball_splats, cameras, random_mesh

from meshsplats import FileFormatError, save_gaussians, save_mesh
from meshsplats.blender import LevelMeshes, draw
from meshsplats.blender.levels import is_chain, read_chain
from meshsplats.cli import main


def chain_folder(folder, rows):
    folder.mkdir(exist_ok=True)
    (folder / "levels.json").write_text(json.dumps({"levels": rows}))
    return folder


def test_the_folder_that_the_command_writes_is_a_chain(tmp_path):
    save_gaussians(ball_splats(400)[0], tmp_path / "ball.ply")
    folder = tmp_path / "chain"
    command = ["levels", str(tmp_path / "ball.ply"), "-o", str(folder), "--no-tune", "--levels", "2"]
    assert main([*command, "--width", "64", "--format", "npz"]) == 0
    for path in (folder, folder / "levels.json"):
        assert is_chain(path)
        chain = read_chain(path)
        assert chain.name == "chain"
        assert [level.path.name for level in chain.levels] == ["level_0.npz", "level_1.npz"]
        assert [level.screen_size for level in chain.levels] == [64, 32]
    assert not is_chain(tmp_path)
    assert not is_chain(tmp_path / "ball.ply")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not a JSON file"),
        ("[" * 100_000, "not a JSON file"),
        (" " * (17 << 20), "larger than 16 MiB"),
        ("[1]", "expected a table of levels"),
        ('{"levels": []}', "expected a table of levels"),
        ('{"levels": [3]}', "level 0: expected the name of a file beside it, got None"),
        ('{"levels": [{"file": "../a.npz", "screen_size": 8}]}', "beside it, got '../a.npz'"),
        (
            '{"levels": [{"file": "a.npz", "screen_size": 0}]}',
            "screen_size must be a number of pixels, got 0",
        ),
        ('{"levels": [{"file": "a.npz"}]}', "screen_size must be a number of pixels, got None"),
    ],
)
def test_a_broken_table_is_refused(tmp_path, text, words):
    (tmp_path / "levels.json").write_text(text)
    with pytest.raises(FileFormatError, match=words):
        read_chain(tmp_path)


def test_a_missing_mesh_is_named(tmp_path):
    folder = chain_folder(tmp_path / "chain", [{"file": "a.npz", "screen_size": 8}])
    with pytest.raises(FileNotFoundError, match=r"a\.npz: named in levels\.json, but missing"):
        read_chain(folder)


def test_a_chain_makes_no_image(tmp_path, capsys):
    save_mesh(random_mesh(3), tmp_path / "a.npz")
    folder = chain_folder(tmp_path / "chain", [{"file": "a.npz", "screen_size": 8}])
    assert main(["blender", str(folder), "-o", str(tmp_path / "a.png")]) == 2
    assert "a chain of levels of detail makes a .blend" in " ".join(capsys.readouterr().err.split())
    chain = LevelMeshes("a", (random_mesh(3),) * 2, (8, 4))
    with pytest.raises(ValueError, match=r"makes a \.blend"):
        draw(chain, cameras()[:1], images=[tmp_path / "a.png"])
    with pytest.raises(ValueError, match="a screen size for each, got 2 meshes and 1 screen sizes"):
        LevelMeshes("a", (random_mesh(3),) * 2, (8,))
    assert not (tmp_path / "a.png").exists()
