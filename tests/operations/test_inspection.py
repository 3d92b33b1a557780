"""Findings about files and the installation, without the command line."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from _meshes import fan_mesh
from _splats import few_splats

from meshsplats import convert
from meshsplats.errors import FileFormatError
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.formats.meshes import save_mesh
from meshsplats.operations.inspection import describe, in_words
from meshsplats.operations.installation import examine


def test_findings_about_splats_follow_the_arguments_of_the_reader(tmp_path):
    cloud = few_splats()
    save_gaussians(cloud, tmp_path / "scene.ply")
    found = describe(tmp_path / "scene.ply")
    assert (found["kind"], found["splats"]) == ("splats", len(cloud))
    upside_down = describe(tmp_path / "scene.ply", {"axes": "y-up"})
    assert upside_down["lower"][1] == pytest.approx(-found["upper"][1], rel=1e-5)
    json.dumps(found, allow_nan=False)


def test_what_kind_of_scene_splats_show(tmp_path, monkeypatch):
    save_gaussians(few_splats(), tmp_path / "scene.ply")
    found = describe(tmp_path / "scene.ply")
    assert (found["scene"], found["scene_confidence"]) == ("object", 1.0)
    assert (found["up_found"], found["up_confidence"]) == ([0.0, -1.0, 0.0], 0.0)
    assert found["view_depth"] > 0
    told = save_named_up(tmp_path)
    assert told["up"] == pytest.approx([0, 0, 1])
    assert "up_found" not in told
    monkeypatch.setattr("meshsplats.viewpoints.finding.first_impression", lambda cloud, **_: None)
    assert "scene" not in describe(tmp_path / "scene.ply")


def save_named_up(folder):
    """What is found in a file that names its up."""
    save_gaussians(replace(few_splats(), up=np.array([0.0, 0, 1])), folder / "up.ply")
    return describe(folder / "up.ply")


def test_findings_about_a_mesh(tmp_path):
    mesh = convert(few_splats())
    save_mesh(mesh, tmp_path / "mesh.npz")
    found = describe(tmp_path / "mesh.npz")
    assert (found["kind"], found["triangles"]) == ("mesh", len(mesh.faces))


def save_chain(folder):
    levels = [
        {"splats": 40 >> 2 * number, "triangles": 320 >> 2 * number, "screen_size": 64 >> number}
        | {"file": f"level_{number}.npz", "bytes": 7, "psnr": 30.5, "views": 8, "seconds": 0.1, "alpha": None}
        for number in range(2)
    ]
    table = {"source": "a.ply", "splats": 40, "factor": 4, "look": "area", "samples": 2, "levels": levels}
    folder.mkdir()
    for row in levels:
        (folder / row["file"]).write_bytes(b"content")
    (folder / "levels.json").write_text(json.dumps(table))
    return table


def test_levels_of_detail_are_their_table(tmp_path):
    table = save_chain(tmp_path / "chain")
    found = describe(tmp_path / "chain")
    assert found == {"kind": "levels", "bytes": 14} | table
    assert describe(tmp_path / "chain" / "levels.json") == found
    lines = in_words(found)
    assert lines[0].split() == ["kind", "levels", "of", "detail"]
    assert [line.split()[:3] for line in lines[-3:-1]] == [
        ["level_0.npz", "40", "320"],
        ["level_1.npz", "10", "80"],
    ]
    assert lines[-1].endswith("; 8 views")
    (tmp_path / "chain" / "level_1.npz").unlink()
    assert describe(tmp_path / "chain")["missing"] == ["level_1.npz"]


@pytest.mark.parametrize("text", ["[]", "{}", '{"levels": []}', '{"levels": [{"file": 1}]}', '{"levels": 3}'])
def test_other_tables_are_told_apart(tmp_path, text):
    (tmp_path / "levels.json").write_text(text)
    with pytest.raises(FileFormatError, match=r"levels\.json: not the table"):
        describe(tmp_path / "levels.json")
    with pytest.raises(FileFormatError, match="a folder without splats"):
        describe(tmp_path)
    save_gaussians(few_splats(), tmp_path / "point_cloud.ply")
    assert describe(tmp_path)["kind"] == "splats"


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "text.ply").write_text("hello")
    with pytest.raises(FileFormatError, match=r"text\.ply"):
        describe(tmp_path / "text.ply")


def test_missing_libraries_are_named_as_pip_takes_them(monkeypatch):
    monkeypatch.setattr(
        "meshsplats.operations.installation._version", lambda name: None if name == "wgpu" else "1.0"
    )
    found = examine()
    assert found["core"]["works"]
    missing = found["to_install"]
    assert "gpu" in missing
    assert {name[:4] for names in missing.values() for name in names} == {"wgpu"}
    json.dumps(found)


def test_what_draws_colours_that_depend_on_the_view_here(monkeypatch):
    monkeypatch.setattr(
        "meshsplats.operations.installation._version", lambda name: "4.5" if name == "bpy" else None
    )
    found = examine()
    working = [name for name in ("core", "gpu") if found[name]["works"]]
    assert found["harmonics_drawn_by"] == [*working, "Blender (bpy 4.5), unlit"]
    # A core that shades wrongly draws wrongly.
    monkeypatch.setattr("meshsplats.rendering.cpu.shaded", lambda triangles, *_, **__: triangles)
    assert not examine()["core"]["works"]


def test_a_mesh_says_whether_its_colours_depend_on_the_view(tmp_path):
    mesh = fan_mesh(np.random.default_rng(0), degree=2)
    save_mesh(mesh, tmp_path / "m.glb")
    found = describe(tmp_path / "m.glb")
    assert (found["sh_degree"], found["plain_colors"], found["colors_above_white"]) == (2, True, True)
    assert "Blender unlit" in found["harmonics_drawn_by"]
    assert found["others_show"] == "plain colours, the mean of views"
    save_mesh(replace(mesh, plain_colors=None), tmp_path / "m.glb")
    assert "degree 0; meshsplats bake" in describe(tmp_path / "m.glb")["others_show"]
    save_mesh(mesh.of_degree(0), tmp_path / "m.glb")
    found = describe(tmp_path / "m.glb")
    assert (found["sh_degree"], found["plain_colors"], found["colors_above_white"]) == (0, False, False)
    assert not {"harmonics_drawn_by", "others_show"} & found.keys()
