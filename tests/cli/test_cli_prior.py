"""``meshsplats prior`` and ``meshsplats deform``, run in this process."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _photographs import write_photographs
from _priors import bumpy

from meshsplats import SplatMesh, load_mesh, orbit, render, save_mesh
from meshsplats._common import toml
from meshsplats.cli import main
from meshsplats.demo_scene import make_scene
from meshsplats.formats.gaussians import save_gaussians
from meshsplats.prior import load_prior
from meshsplats.prior.options import prior_config


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with a base of wrong colours, photographs of it with the right ones, and edited bases."""
    folder = tmp_path_factory.mktemp("prior")
    base = bumpy(5)
    mesh = SplatMesh(base.vertices, base.faces, base.colors, up=base.up)
    truth = SplatMesh(base.vertices, base.faces, base.colors[::-1], up=base.up)
    save_mesh(mesh, folder / "base.obj")
    cameras = orbit(truth, 9, width=32, height=32, elevation=40)
    write_photographs(folder / "photos", cameras, [render(truth, c).color for c in cameras])
    for number in range(3):
        moved = base.vertices + np.float32([0, 0, 0.1 * number]) * base.vertices[:, :1] ** 2
        save_mesh(SplatMesh(moved, base.faces, base.colors), folder / f"moved{number}.obj")
    save_gaussians(make_scene(200), folder / "scene.ply")
    return folder


@pytest.fixture(scope="module")
def trained(scene):
    out = scene / "prior.npz"
    options = ["--steps", "30", "--triangles", "4", "--set", "report_every=10", "--json"]
    options += ["--layers", "2", "--spacing", "0"]
    assert run("prior", scene / "base.obj", "--data", scene / "photos", "-o", out, *options) == 0
    return out


def run(*arguments) -> int:
    return main([*map(str, arguments)])


def test_trained_on_photographs(scene, trained, capsys):
    prior = load_prior(trained)
    assert len(prior.mesh.faces) <= 50 * 8
    assert len(prior.base_faces) == 50
    names = {p.name for p in scene.iterdir()}
    assert {"prior.npz.config.toml", "prior.npz.preview.png", "prior.npz.run"} <= names
    config = toml.load(scene / "prior.npz.config.toml")
    wanted = prior_config(steps=30).to_dict()
    assert config["resolved"] == {name: value for name, value in wanted.items() if value is not None}
    assert config["options"]["layers"] == 2
    lines = (scene / "prior.npz.run" / "metrics.jsonl").read_text().splitlines()
    scores = [json.loads(line)["psnr"] for line in lines]
    assert scores[-1] > scores[0] + 3
    # Nothing is overwritten.
    assert run("prior", scene / "base.obj", "--data", scene / "photos", "-o", trained) == 3
    assert "--resume continues it, --force starts again" in capsys.readouterr().err
    # It is a mesh like any other.
    capsys.readouterr()
    assert run("info", trained) == 0
    assert "36 vertices, 50 faces" in capsys.readouterr().out


def test_trained_on_splats(scene, tmp_path, capsys):
    options = ["--steps", "3", "--views", "3", "--held-out", "1", "--width", "32", "--colors", "views"]
    options += ["--layers", "3", "--spacing", "-0.01"]
    out = tmp_path / "prior.glb"
    assert run("prior", scene / "base.obj", "--splats", scene / "scene.ply", "-o", out, *options) == 0
    printed = capsys.readouterr()
    assert "50 faces carry 150 triangles; 3 training views, 1 held out" in printed.err
    assert "meshsplats deform" in printed.out
    assert load_prior(out).lift == pytest.approx(-0.01)


def test_a_base_in_other_units_than_the_splats_is_told_before_training(scene, tmp_path, capsys):
    base = load_mesh(scene / "base.obj")
    save_mesh(replace(base, vertices=100 * base.vertices), tmp_path / "cm.obj")
    options = ["--steps", "1", "--views", "1", "--held-out", "1", "--width", "16", "--colors", "grey"]
    arguments = ("--splats", scene / "scene.ply", "-o", tmp_path / "p.npz", *options)
    assert run("prior", tmp_path / "cm.obj", *arguments) == 0
    printed = capsys.readouterr().err
    assert "cm.obj: does not fit the splats of" in printed
    assert printed.index("does not fit") < printed.index("faces carry")


def test_a_prior_is_no_base(scene, trained, tmp_path, capsys):
    arguments = ("--splats", scene / "scene.ply", "-o", tmp_path / "p.npz")
    assert run("prior", trained, *arguments) == 1
    assert "bound to a mesh, not the mesh that carries them" in capsys.readouterr().err


def test_deform_follows_the_base(scene, trained, tmp_path, capsys):
    prior = load_prior(trained)
    out = tmp_path / "edited.npz"
    assert run("deform", trained, "--base", scene / "moved1.obj", "-o", out, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["files"] == [str(out)]
    moved = load_mesh(scene / "moved1.obj")
    with np.load(out) as file:
        corners = moved.vertices[file["binding_base_faces"][file["binding_vertex_face"]]]
        wanted = (file["binding_weights"][..., None].astype(float) * corners).sum(axis=1)
        assert np.abs(file["vertices"] - wanted).max() < 1e-6
    np.testing.assert_array_equal(load_mesh(out).colors, prior.mesh.colors)
    # What was moved can be moved again, and back.
    assert run("deform", out, "--base", scene / "moved0.obj", "-o", tmp_path / "back.npz") == 0
    np.testing.assert_array_equal(load_mesh(tmp_path / "back.npz").vertices, prior.mesh.vertices)


def test_exports_set_coplanar_layers_apart(scene, trained, tmp_path):
    prior = load_prior(trained)
    for name in ("edited.glb", "edited.ply"):
        assert run("deform", trained, "--base", scene / "moved0.obj", "-o", tmp_path / name) == 0
        mesh = load_mesh(tmp_path / name)
        np.testing.assert_allclose(mesh.vertices, prior.pose(lift=prior.export_lift).vertices, atol=1e-7)
        assert np.abs(mesh.vertices - prior.mesh.vertices).max() > 1e-5
        np.testing.assert_allclose(mesh.normals, prior.mesh.normals, atol=1e-6)
    out = tmp_path / "flat.glb"
    assert run("deform", trained, "--base", scene / "moved0.obj", "-o", out, "--lift", "0") == 0
    np.testing.assert_array_equal(load_mesh(out).vertices, prior.mesh.vertices)


def test_a_sequence_of_bases(scene, trained, tmp_path, capsys):
    bases = [scene / f"moved{number}.obj" for number in range(3)]
    assert run("deform", trained, "--base", *bases, "-o", tmp_path / "walk.glb") == 0
    assert "3 poses" in capsys.readouterr().out
    names = [f"walk_{number:04d}.glb" for number in (1, 2, 3)]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    heights = [load_mesh(tmp_path / name).vertices[:, 2].max() for name in names]
    assert heights[0] < heights[1] < heights[2]
    assert run("deform", trained, "--base", *bases, "-o", tmp_path / "walk.glb") == 3
    assert "walk_0001.glb" in capsys.readouterr().err


def test_frames_are_in_the_order_of_their_numbers(scene, trained, tmp_path, capsys):
    bases = [tmp_path / f"walk_{number}.obj" for number in (1, 10, 2)]
    for source, path in zip((0, 2, 1), bases, strict=True):
        shutil.copy(scene / f"moved{source}.obj", path)
    assert run("deform", trained, "--base", *bases, "-o", tmp_path / "walk.npz", "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert [Path(base).name for base in printed["bases"]] == ["walk_1.obj", "walk_2.obj", "walk_10.obj"]
    heights = [load_mesh(path).vertices[:, 2].max() for path in printed["files"]]
    assert heights[0] < heights[1] < heights[2]
    assert run("deform", trained, "--base", bases[1], bases[0], "-o", tmp_path / "w.npz", "--json") == 0
    assert json.loads(capsys.readouterr().out)["bases"] == [str(bases[1]), str(bases[0])]


def test_axes_of_another_program(scene, trained, tmp_path, capsys):
    prior, base = load_prior(trained), load_mesh(scene / "moved0.obj")
    turned = replace(base, vertices=base.vertices[:, [0, 2, 1]] * np.float32([1, -1, 1]))
    turned = replace(turned, up=prior.mesh.up[[0, 2, 1]] * np.float32([1, -1, 1]))
    other = (tmp_path / "stated.ply", turned), (tmp_path / "bare.ply", replace(turned, up=prior.mesh.up))
    for path, mesh in other:
        save_mesh(mesh, path)
        assert run("deform", trained, "--base", path, "-o", path.with_suffix(".npz")) == 0
    said = capsys.readouterr().err
    assert "its x, y, z are x, -z, y of the base" in said
    assert "it is turned back" in said
    assert "export it with the axes and units of its import" in said
    assert "scaled:" not in said
    save_mesh(replace(turned, vertices=100 * turned.vertices), tmp_path / "large.ply")
    assert run("deform", trained, "--base", tmp_path / "large.ply", "-o", tmp_path / "large.npz") == 0
    assert "it is turned back, but not scaled: export it with the units" in capsys.readouterr().err
    found = load_mesh(tmp_path / "stated.npz")
    np.testing.assert_allclose(found.vertices, prior.mesh.vertices, atol=1e-6)
    kept = load_mesh(tmp_path / "bare.npz").vertices
    np.testing.assert_allclose(kept[:, [0, 2, 1]] * (1, 1, -1), prior.mesh.vertices, atol=1e-6)


def test_another_topology_writes_nothing(scene, trained, tmp_path, capsys):
    base = bumpy(4)
    save_mesh(SplatMesh(base.vertices, base.faces, base.colors), tmp_path / "other.obj")
    bases = [scene / "moved0.obj", tmp_path / "other.obj"]
    assert run("deform", trained, "--base", *bases, "-o", tmp_path / "out.glb") == 1
    assert "other.obj: the edited base has 25 vertices" in capsys.readouterr().err
    assert run("deform", scene / "base.obj", "--base", scene / "moved0.obj", "-o", tmp_path / "out.glb") == 1
    assert "bound to no base" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["other.obj"]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ([], 2, "give photographs with --data, or splats with --splats"),
        (["--data", "d", "--splats", "s.ply"], 2, "give --data or --splats, not both"),
        (["--data", "d", "--layers", "1", "--spacing", "0.1"], 2, "--spacing has no effect with one layer"),
        (["--data", "d", "--texture", "t.png", "--colors", "grey"], 2, "--texture has no effect"),
        (["--data", "d", "--steps", "1", "--epochs", "1"], 2, "give only one of --epochs"),
        (["--data", "nowhere"], 1, "no such data set"),
        (["--data", "d", "--resume"], 1, "no checkpoint at"),
    ],
)
def test_wrong_usage_writes_nothing(scene, tmp_path, capsys, arguments, code, message):
    assert run("prior", scene / "base.obj", "-o", tmp_path / "p.npz", *arguments) == code
    assert message in capsys.readouterr().err
    assert run("prior", scene / "base.obj", "-o", tmp_path / "p.ply", "--data", "d") == 2
    assert "must end in .npz or .glb" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_options_are_checked_before_the_work(scene, tmp_path, capsys):
    out = tmp_path / "p.npz"
    assert run("prior", scene / "base.obj", "--data", scene / "photos", "-o", out, "--triangles", "0") == 1
    assert "triangles must be a number from 1 to 256" in capsys.readouterr().err
    assert run("prior", scene / "base.obj", "--data", scene / "photos", "-o", out, "--colors", "texture") == 1
    assert "no texture" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
