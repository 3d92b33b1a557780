"""Levels of detail: the plan by hand, meshes within it, and ``meshsplats levels``."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from meshsplats import convert, load_mesh, orbit, save_gaussians
from meshsplats.cli import main
from meshsplats.demo_scene import make_scene
from meshsplats.levels import Level, level_targets, likeness, make_level, plan_levels


def test_plan():
    assert plan_levels(1000, 3) == [Level(1000, 800, 1000), Level(250, 400, 1000), Level(62, 200, 1000)]
    assert plan_levels(1000, 3, factor=2, width=100) == [
        Level(1000, 100, 1000),
        Level(500, 71, 1000),
        Level(250, 50, 1000),
    ]
    with pytest.raises(ValueError, match=r"9 levels are too many for 1000 splats .* at most 5 fit"):
        plan_levels(1000, 9)
    with pytest.raises(ValueError, match="the last would have 62 splats and 12 pixels; at most 2 fit"):
        plan_levels(1000, 3, width=48)
    with pytest.raises(ValueError, match="must be a splat, a level and a factor"):
        plan_levels(10, 0)


def test_likeness_is_that_of_the_means():
    """A mesh that shows nothing, over white: by hand from the images of the splats."""
    from meshsplats import psnr, render_splats

    cloud = make_scene(300)
    mesh = convert(cloud)
    empty = replace(mesh, colors=mesh.colors * np.array([1, 1, 1, 0], np.float32))
    (camera,) = orbit(cloud, 1, width=40, height=30)
    large = render_splats(cloud, camera.scaled(4)).color.clip(0, 1)
    mean = np.mean([large[i::4, j::4] for i in range(4) for j in range(4)], axis=0)
    assert likeness(empty, cloud, [camera]) == pytest.approx(psnr(np.ones_like(mean), mean), abs=1e-3)
    assert likeness(mesh, cloud, [camera]) > likeness(empty, cloud, [camera]) + 10


def test_tuning_makes_a_level_better():
    pytest.importorskip("torch")
    pytest.importorskip("safetensors")
    from meshsplats.finetuning import make_config

    cloud = make_scene(600)
    level = Level(150, 40, 600)
    config = make_config("default", steps=60)
    targets = level_targets(cloud, level, config, sh_degree=0)
    plain, tuned = make_level(cloud, level, targets), make_level(cloud, level, targets, config)
    assert plain.splat_count <= 150
    assert tuned.splat_count <= 150
    cameras = [view.camera for view in targets.test]
    assert likeness(tuned, cloud, cameras, sh_degree=0) > likeness(plain, cloud, cameras, sh_degree=0)


def test_all_levels_have_the_triangles_of_a_splat_of_the_finest(monkeypatch):
    from meshsplats.finetuning import initial, make_config

    monkeypatch.setattr(initial, "MANY_TRIANGLES", 6000)
    cloud = make_scene(600)
    level = Level(150, 40, 600)
    config = make_config("default", steps=1)
    mesh = make_level(cloud, level, level_targets(cloud, level, config, sh_degree=0), config)
    assert 9 * mesh.splat_count < len(mesh.faces) <= 10 * 150


def test_the_finest_level_counts_the_splats_it_may_have(monkeypatch):
    """Not those of the whole cloud."""
    from meshsplats.finetuning import initial, make_config

    monkeypatch.setattr(initial, "MANY_TRIANGLES", 1500)
    cloud = make_scene(600)
    (level,) = plan_levels(150, 1, width=40)
    config = make_config("default", steps=1)
    mesh = make_level(cloud, level, level_targets(cloud, level, config, sh_degree=0), config)
    assert 9 * mesh.splat_count < len(mesh.faces) <= 10 * 150


def test_every_sixth_view_is_a_window():
    from meshsplats.finetuning import make_config

    cloud, level = make_scene(200), Level(200, 40, 200)
    targets = level_targets(cloud, level, make_config("default", steps=10), sh_degree=0)
    focal = np.array([view.camera.fx for view in targets.train])
    assert np.mean(focal > 1.5 * np.median(focal)) == 33 / 200


@pytest.fixture
def splats(tmp_path):
    save_gaussians(make_scene(400), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def run(*arguments) -> int:
    return main(["levels", *map(str, arguments)])


QUICK = ("--no-tune", "--width", 64, "--levels", 2)


def test_a_chain(splats, tmp_path, capsys):
    out = tmp_path / "chain"
    assert run(splats, "-o", out, *QUICK, "--format", "npz", "--json") == 0
    message = json.loads(capsys.readouterr().out)
    table = json.loads((out / "levels.json").read_text())
    assert message == table | {"folder": str(out)}
    assert [row["screen_size"] for row in table["levels"]] == [64, 32]
    assert sorted(p.name for p in out.iterdir()) == [
        "config.toml",
        "level_0.npz",
        "level_1.npz",
        "levels.json",
    ]
    for row, most in zip(table["levels"], (400, 100), strict=True):
        mesh = load_mesh(out / row["file"])
        assert (len(mesh.faces), mesh.splat_count) == (row["triangles"], row["splats"])
        assert 0.8 * most < mesh.splat_count <= most
        assert row["bytes"] == (out / row["file"]).stat().st_size
        assert row["psnr"] > 15
    assert not (tmp_path / "chain.partial").exists()

    assert run(splats, "-o", out, *QUICK) == 3  # not overwritten
    assert (out / "level_0.npz").exists()
    assert run(splats, "-o", out, *QUICK, "--force", "--format", "ply", "--max-splats", 300) == 0
    shown = capsys.readouterr().out
    assert "level_1.ply" in shown
    assert sorted(p.suffix for p in out.iterdir()) == [".json", ".ply", ".ply", ".toml"]
    assert not list(tmp_path.glob(".chain*"))


def test_an_interrupted_chain_goes_on(splats, tmp_path, capsys, monkeypatch):
    import meshsplats.cli.levels as command
    from meshsplats.finetuning import Interrupted

    out = tmp_path / "chain"
    make = command.make_level
    made = []

    def stops(cloud, level, *arguments, **options):
        if level.width == 32 and not made:
            made.append(level)
            raise Interrupted(0, None)
        return make(cloud, level, *arguments, **options)

    monkeypatch.setattr(command, "make_level", stops)
    assert run(splats, "-o", out, *QUICK) == 130
    assert "--resume continues" in capsys.readouterr().err
    assert not out.exists()
    first = (tmp_path / "chain.partial" / "level_0.glb").stat().st_mtime_ns
    assert run(splats, "-o", out, *QUICK) == 3
    assert "--resume continues it, --force starts again" in capsys.readouterr().err
    assert run(splats, "-o", out, "--no-tune", "--width", 80, "--levels", 2, "--resume") == 2
    assert "was started with --width 64, not 80" in capsys.readouterr().err
    assert run(splats, "-o", out, *QUICK, "--resume") == 0
    assert (out / "level_0.glb").stat().st_mtime_ns == first
    assert (out / "level_1.glb").is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--levels", "0"], "--levels must be at least 1, got 0"),
        (["--no-tune", "--minutes", "1"], "no effect with --no-tune"),
        (["--steps", "9", "--minutes", "1"], "give --minutes or --steps, not both"),
        (["--resume", "--force"], "give one of them"),
        (["--max-splats", "0"], "--max-splats must be at least 1, got 0"),
    ],
)
def test_wrong_options(splats, tmp_path, capsys, options, message):
    assert run(splats, "-o", tmp_path / "chain", *options) == 2
    assert message in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene.ply"]


def test_folders_that_are_in_the_way(splats, tmp_path, capsys):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "diary.txt").write_text("dear diary")
    assert run(splats, "-o", out, *QUICK, "--force") == 3
    assert "holds no levels.json" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "new", *QUICK, "--resume") == 1
    assert "nothing to resume in" in capsys.readouterr().err
    partial = tmp_path / "other.partial"
    partial.mkdir()
    assert run(splats, "-o", tmp_path / "other", *QUICK, "--force") == 3
    assert "not of this command" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "chain", *QUICK, "--levels", 5) == 1
    assert "5 levels are too many" in capsys.readouterr().err
    assert not (tmp_path / "chain.partial").exists()
