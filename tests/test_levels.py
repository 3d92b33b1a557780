"""Levels of detail: the plan by hand, meshes within it, and ``meshsplats levels``."""

from __future__ import annotations

import json
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from _stock_viewer import stock_image

from meshsplats import (
    ConversionOptions,
    convert,
    load_gaussians,
    load_mesh,
    orbit,
    psnr,
    render,
    save_gaussians,
    simplify,
)
from meshsplats.cli import main
from meshsplats.cli.messages import Terminated
from meshsplats.conversion import merging
from meshsplats.conversion.merging import simplify_in_blocks
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.viewers import AlphaChoice
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.formats.gltf.reader import listed_nodes
from meshsplats.levels import (
    FOOTPRINTS_PX2,
    Level,
    level_targets,
    likeness,
    make_level,
    merged,
    plan_levels,
    views_to_score,
)
from meshsplats.operations import chains
from meshsplats.operations.chains import make_chain
from meshsplats.operations.options import ChainOptions


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


@pytest.mark.slow
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


def test_coarse_levels_take_the_filter_that_is_nearest():
    cloud = make_scene(2000)
    finest, *_, coarse = plan_levels(2000, 3, width=80)
    targets = level_targets(cloud, coarse, sh_degree=0)
    cameras = [view.camera for view in targets.views]
    mesh = make_level(cloud, coarse, targets)
    tried = {
        px2: convert(cloud, cameras=cameras, max_splats=125, footprint_px2=px2) for px2 in FOOTPRINTS_PX2
    }
    taken = [px2 for px2, other in tried.items() if np.array_equal(mesh.vertices, other.vertices)]
    assert len(taken) == 1
    views = targets.train[:2]

    def error(mesh) -> float:
        images = [(render(mesh, view.camera, samples=2).color, view.image) for view in views]
        return -np.mean([psnr(a.clip(0, 1), b) for a, b in images])

    errors = {px2: error(mesh) for px2, mesh in tried.items()}
    assert min(errors, key=errors.get) == taken[0]
    # The finest one is that of convert, and so is a level with options.
    targets = level_targets(cloud, finest, sh_degree=0)
    cameras = [view.camera for view in targets.views]
    for made, expected in (
        (make_level(cloud, finest, targets), convert(cloud, cameras=cameras)),
        (
            make_level(cloud, coarse, targets, options=ConversionOptions(mode="flat")),
            convert(cloud, cameras=cameras, max_splats=125, mode="flat"),
        ),
    ):
        np.testing.assert_array_equal(made.vertices, expected.vertices)


def test_fewer_views_score_more_triangles():
    assert [views_to_score(n, 9) for n in (0, 250_000, 400_000, 900_000, 17_000_000)] == [8, 8, 5, 2, 2]
    assert [views_to_score(9, n) for n in (500_000, 1_000_000, 9_000_000)] == [8, 4, 2]


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


@pytest.mark.parametrize("degree", [0, 1, None])
def test_converted_levels_have_the_degree_of_their_images(degree, splats, tmp_path):
    stored = load_gaussians(splats).sh_degree
    assert stored > 1
    asked = () if degree is None else ("--sh-degree", degree)
    assert run(splats, "-o", tmp_path / "chain", *QUICK, "--format", "npz", *asked) == 0
    for number in range(2):
        mesh = load_mesh(tmp_path / "chain" / f"level_{number}.npz")
        assert mesh.sh_degree == (stored if degree is None else degree)


def test_a_chain_without_the_command_line(tmp_path):
    cloud, begun = make_scene(400), []

    @contextmanager
    def began(number, level):
        begun.append((number, level.splats))
        yield

    options = ChainOptions(levels=2, width=64, format="npz")
    table = make_chain(
        cloud,
        tmp_path / "chain",
        options,
        source="scene",
        place=lambda mesh: replace(mesh, up=(0, 0, 1)),
        on_level=began,
    )
    assert begun == [(0, 400), (1, 100)]
    assert json.loads((tmp_path / "chain" / "levels.json").read_text()) == table
    (tmp_path / "chain" / "mine.txt").write_text("mine")
    assert (table["source"], [row["screen_size"] for row in table["levels"]]) == ("scene", [64, 32])
    assert load_mesh(tmp_path / "chain" / "level_1.npz").up[2] == 1
    make_chain(cloud, tmp_path / "chain", replace(options, levels=1))  # in place of the older one
    left = sorted(path.name for path in (tmp_path / "chain").iterdir())
    assert left == ["level_0.npz", "levels.json", "mine.txt"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "levels.json").write_text("{}")
    with pytest.raises(FileExistsError, match=r"not the table .*: give another folder"):
        make_chain(cloud, tmp_path / "other", options)


def test_an_interrupted_chain_goes_on(splats, tmp_path, capsys, monkeypatch):
    import meshsplats.operations.chains as command
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
    assert "--resume to continue" in capsys.readouterr().err
    assert not out.exists()
    first = (tmp_path / "chain.partial" / "level_0.glb").stat().st_mtime_ns
    assert run(splats, "-o", out, *QUICK) == 3
    assert "--resume continues it, --force starts again" in capsys.readouterr().err
    assert run(splats, "-o", out, "--no-tune", "--width", 80, "--levels", 2, "--resume") == 2
    assert "was started with --width 64, not 80" in capsys.readouterr().err
    record = tmp_path / "chain.partial" / "config.toml"
    kept = record.read_text()
    record.write_text(kept.replace('command = "levels"', 'command = "tiles"'))
    assert run(splats, "-o", out, *QUICK, "--resume") == 2
    assert "is not of this command" in capsys.readouterr().err
    record.write_text(kept)
    assert run(splats, "-o", out, *QUICK, "--resume") == 0
    assert (out / "level_0.glb").stat().st_mtime_ns == first
    assert (out / "level_1.glb").is_file()


def test_levels_of_another_scene_do_not_go_on(splats, tmp_path, capsys, monkeypatch):
    """The file has another content under the same name."""
    out, write, kept = tmp_path / "chain", chains.write_json, splats.read_bytes()

    def stops(path, content):
        write(path, content)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(chains, "write_json", stops)
        assert run(splats, "-o", out, *QUICK) == 130
    save_gaussians(make_scene(400, seed=9), splats)
    assert run(splats, "-o", out, *QUICK, "--resume") == 1
    assert "level 0 was made of other splats: --resume with the same" in capsys.readouterr().err
    splats.write_bytes(kept)
    assert run(splats, "-o", out, *QUICK, "--resume") == 0
    assert "scene" not in json.loads((out / "levels.json").read_text())["levels"][0]


@pytest.mark.parametrize("end", ["levels.json", "name", "records"])
def test_finished_levels_are_not_made_again(splats, tmp_path, monkeypatch, end):
    """Whenever the last moments of a chain are cut off."""
    out, write = tmp_path / "chain", chains.write_json

    def full(*_):
        raise OSError(28, "full", str(out))

    with monkeypatch.context() as patch:
        if end == "name":
            patch.setattr(chains, "replace_folder", full)
        elif end == "records":
            patch.setattr(chains.Path, "unlink", full)
        else:
            patch.setattr(chains, "write_json", lambda p, c: (full if p.name == end else write)(p, c))
        assert run(splats, "-o", out, *QUICK) == 4
    monkeypatch.setattr(chains, "make_level", None)
    if end != "records":
        assert run(splats, "-o", out, *QUICK, "--resume") == 0
    assert len(json.loads((out / "levels.json").read_text())["levels"]) == 2
    left = {path.name for path in out.iterdir()} - {"level_0.json", "level_1.json"}
    assert left == {"config.toml", "level_0.glb", "level_1.glb", "levels.json"}


@pytest.mark.slow
@pytest.mark.parametrize("least", [50, 10**6])
def test_levels_are_merged_from_those_above(splats, tmp_path, monkeypatch, least):
    import meshsplats.levels as module

    monkeypatch.setattr(module, "MERGED_FROM", least)
    sizes = []

    def counts(cloud, count, cameras, threads):
        if count < len(cloud):
            sizes.append((len(cloud), count))
        return simplify(cloud, count, cameras=cameras, threads=threads)

    monkeypatch.setattr(module, "simplify_large", counts)
    three = ("--no-tune", "--width", 64, "--levels", 3)
    assert run(splats, "-o", tmp_path / "chain", *three) == 0
    assert sizes == ([(400, 100), (100, 25)] if least == 50 else [(400, 100), (400, 25)])
    # Resumed before the last level, it is the same.
    (tmp_path / "chain").rename(tmp_path / "other.partial")
    table = json.loads((tmp_path / "other.partial" / "levels.json").read_text())
    for number, row in enumerate(table["levels"][:2]):
        (tmp_path / "other.partial" / f"level_{number}.json").write_text(json.dumps(row))
    last = tmp_path / "other.partial" / "level_2.glb"
    expected = last.read_bytes()
    last.unlink()
    assert run(splats, "-o", tmp_path / "other", *three, "--resume") == 0
    assert (tmp_path / "other" / "level_2.glb").read_bytes() == expected


def test_levels_of_many_splats_are_merged_in_blocks(monkeypatch):
    monkeypatch.setattr(merging, "LARGE", 1000)
    monkeypatch.setitem(merging.simplify_in_blocks.__kwdefaults__, "block", 500)
    cloud = make_scene(2000)
    cameras = orbit(cloud, 4, width=60, height=60)
    made = merged(cloud, Level(400, 60, 2000), cameras)
    np.testing.assert_array_equal(made.means, simplify_in_blocks(cloud, 400, cameras=cameras).means)
    assert not np.array_equal(made.means, simplify(cloud, 400, cameras=cameras).means)


def test_all_levels_have_the_alpha_mode_of_the_first(splats, tmp_path, monkeypatch):
    choices = iter([AlphaChoice("mask", 0.1, 20.0, 25.0), AlphaChoice("blend", 0.3, 24.0, 23.0)])
    monkeypatch.setattr(chains, "choose_alpha", lambda *args, **options: next(choices))
    assert run(splats, "-o", tmp_path / "chain", *QUICK) == 0
    rows = json.loads((tmp_path / "chain" / "levels.json").read_text())["levels"]
    assert [(row["alpha"]["alpha"], row["alpha"]["cutoff"]) for row in rows] == [("mask", 0.1), ("mask", 0.3)]


@pytest.mark.slow
def test_alpha_modes(splats, tmp_path, capsys):
    def modes(name):
        return [GltfDocument(tmp_path / name / f"level_{i}.glb").json["materials"][0] for i in range(2)]

    for alpha in ("blend", "mask", "opaque"):
        assert run(splats, "-o", tmp_path / alpha, *QUICK, "--alpha", alpha) == 0
        assert [mode["alphaMode"] for mode in modes(alpha)] == [alpha.upper()] * 2
    capsys.readouterr()
    assert run(splats, "-o", tmp_path / "auto", *QUICK) == 0
    table = json.loads((tmp_path / "auto" / "levels.json").read_text())
    for row, mode in zip(table["levels"], modes("auto"), strict=True):
        assert row["alpha"]["alpha"].upper() == mode["alphaMode"]
        assert row["alpha"]["blend"] > 10
        assert row["views"] == 8
    assert f"  {table['levels'][0]['alpha']['alpha']}\n" in capsys.readouterr().out
    assert run(splats, "-o", tmp_path / "x", *QUICK, "--alpha", "mask", "--format", "ply") == 2
    assert "--alpha mask is for .glb files, not .ply" in capsys.readouterr().err


@pytest.mark.nightly
def test_levels_with_an_order(splats, tmp_path, capsys, monkeypatch):
    """Tuned through it and converted alone: what an independent viewer shows is what the table says."""
    import meshsplats.levels as module
    from meshsplats import load_gaussians
    from meshsplats.finetuning import make_config

    def few(*arguments, **options):  # the viewer is slow
        targets = module.level_targets(*arguments, **options)
        return replace(targets, test=targets.test[:1])

    monkeypatch.setattr(chains, "level_targets", few)
    for length in (("--steps", 12), ("--no-tune",)):
        out = tmp_path / str(length[0])
        assert run(splats, "-o", out, "--alpha", "ordered", "--width", 48, "--levels", 2, *length) == 0
        cloud = load_gaussians(splats)
        table = json.loads((out / "levels.json").read_text())
        for row, level in zip(table["levels"], module.plan_levels(len(cloud), 2, width=48), strict=True):
            assert (row["alpha"], row["views"]) == ({"alpha": "ordered"}, 1)
            assert listed_nodes(out / row["file"]) > 1
            views = module.level_targets(cloud, level, make_config(steps=12)).test[: row["views"]]
            mesh = load_mesh(out / row["file"])
            cameras = [view.camera.with_near_plane(mesh.vertices) for view in views]
            shown = [stock_image(out / row["file"], camera, samples=2) for camera in cameras]
            scores = [psnr(a, v.image.clip(0, 1)) for a, v in zip(shown, views, strict=True)]
            assert row["psnr"] == pytest.approx(np.mean(scores), abs=0.15)
    tuned = json.loads((tmp_path / "--steps" / "levels.json").read_text())["levels"][0]["psnr"]
    assert tuned > table["levels"][0]["psnr"]
    assert run(splats, "-o", tmp_path / "x", *QUICK, "--alpha", "ordered", "--order", "splat") != 0
    assert "has an order of its own: leave out order" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt, Terminated(signal.SIGTERM), OSError(28, "full", "level_0.glb")]
)
def test_a_chain_that_ends_anywhere_says_how_it_goes_on(splats, tmp_path, capsys, monkeypatch, error):
    import meshsplats.operations.chains as command

    def stops(*_, **__):
        raise error

    out = tmp_path / "chain"
    assert run(splats, "-o", out, *QUICK) == 0
    for options, way in ((["--force"], "--resume in place of --force"), (["--resume"], "--resume")):
        with monkeypatch.context() as patch:
            patch.setattr(command, "likeness", stops)
            assert run(splats, "-o", out, *QUICK, *options) in (4, 130, 143)
        assert f"run the same command with {way} to continue\n" in capsys.readouterr().err
    capsys.readouterr()
    assert run(splats, "-o", out, *QUICK, "--resume") == 0  # in place of the older chain
    assert capsys.readouterr().out.endswith(f"{out}/: levels.json has this table\n")
    assert not out.with_name("chain.partial").exists()


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


def test_only_known_endings_are_no_folders(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "chain.glb", *QUICK) == 2
    assert "-o must name a folder, got 'chain.glb'" in capsys.readouterr().err
    assert run(splats, "-o", tmp_path / "chain_1.1", *QUICK, "--max-splats", 200) == 0
    assert (tmp_path / "chain_1.1" / "levels.json").is_file()


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
