"""``meshsplats convert``, run in this process on a small cloud."""

from __future__ import annotations

import json
import os
import re
import sys

import numpy as np
import pytest
from _glb import read_glb
from _local import make_link, words_of
from _splats import few_splats
from PIL import Image

import meshsplats
from meshsplats._common import toml
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main
from meshsplats.conversion import convert, simplify
from meshsplats.conversion.merging_views import merging_views
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.comparison import compare
from meshsplats.evaluation.metrics import psnr
from meshsplats.evaluation.viewers import alpha_for_viewers
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.rendering import previews, render
from meshsplats.rendering.looks import draw_splats
from meshsplats.rendering.ordering import drawing_order
from meshsplats.rendering.samples import needed_samples
from meshsplats.scene.mesh import SplatMesh


@pytest.fixture
def splats(tmp_path):
    cloud = few_splats()
    save_gaussians(cloud, tmp_path / "my scene.ply")
    return tmp_path / "my scene.ply"


def run(*arguments) -> int:
    return main(["convert", *map(str, arguments)])


@pytest.mark.parametrize("suffix", ["npz", "ply", "glb"])
def test_mesh_preview_and_configuration(splats, tmp_path, capsys, suffix):
    out = tmp_path / f"mesh.{suffix}"
    assert run(splats, "-o", out, "--preset", "paper") == 0
    expected = convert(load_gaussians(splats), preset="paper")
    mesh = load_mesh(out)
    np.testing.assert_array_equal(mesh.faces, expected.faces)
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    with Image.open(tmp_path / f"mesh.{suffix}.preview.png") as image:
        pixels = np.asarray(image)
    assert pixels.shape == (800, 800, 3)
    assert (pixels[0] == 255).all()
    assert pixels[200:600, 200:600].mean() < 240
    record = toml.load(tmp_path / f"mesh.{suffix}.config.toml")
    assert record["options"]["preset"] == "paper"
    assert (record["resolved"]["sides"], record["resolved"]["rim_radius"]) == (8, 2.7)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith("mesh")) == sorted(
        [f"mesh.{suffix}.config.toml", f"mesh.{suffix}", f"mesh.{suffix}.preview.png"]
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"40 splats -> {len(mesh.faces)} triangles, {len(mesh.vertices)} vertices"
    quote = '"' if sys.platform == "win32" else "'"
    assert lines[-1].startswith(f"next: meshsplats compare {quote}")  # the space in the name is quoted


def test_options_reach_the_conversion(splats, tmp_path):
    options = {"mode": "flat", "sides": 6, "rings": 2, "max_splats": 20, "crop": (-1.0, -1, -1, 1, 1, 1)}
    given = []
    for name, value in options.items():
        text = ",".join(map(str, value)) if isinstance(value, tuple) else value
        given += ["--set", f"{name}={text}"]
    assert run(splats, "-o", tmp_path / "mesh.npz", "--no-preview", *given) == 0
    expected = convert(load_gaussians(splats), **options)
    mesh = load_mesh(tmp_path / "mesh.npz")
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    np.testing.assert_array_equal(mesh.colors, expected.colors)
    stored = toml.load(tmp_path / "mesh.npz.config.toml")["options"]
    assert (stored["sides"], stored["crop"]) == (6, [-1, -1, -1, 1, 1, 1])
    assert "rim_radius" not in stored


def test_cameras_of_a_model_folder_are_used(splats, tmp_path):
    folder = tmp_path / "model" / "point_cloud" / "iteration_1"
    folder.mkdir(parents=True)
    (folder / "point_cloud.ply").write_bytes(splats.read_bytes())
    cameras = orbit(load_gaussians(splats), 3, up=(0, 0, 1), width=100)
    save_cameras(cameras, tmp_path / "model" / "cameras.json")
    assert run(tmp_path / "model", "-o", tmp_path / "mesh.npz", "--no-preview") == 0
    expected = convert(load_gaussians(splats), cameras=cameras)
    mesh = load_mesh(tmp_path / "mesh.npz")
    np.testing.assert_array_equal(mesh.vertices, expected.vertices)
    assert not np.array_equal(mesh.vertices, convert(load_gaussians(splats)).vertices)
    np.testing.assert_allclose(mesh.up, (0, 0, 1), atol=1e-6)


def test_json(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "mesh.npz", "--json", "--no-preview") == 0
    result = json.loads(capsys.readouterr().out)
    mesh = load_mesh(tmp_path / "mesh.npz")
    assert (result["splats"], result["triangles"]) == (40, len(mesh.faces))
    assert result["vertices"] == len(mesh.vertices)
    size = (tmp_path / "mesh.npz").stat().st_size
    assert result["outputs"] == [{"path": str(tmp_path / "mesh.npz"), "bytes": size}]
    assert (result["input"], result["preview"]) == (str(splats), None)
    assert (result["warnings"], result["meshsplats"]) == ([], meshsplats.__version__)
    assert not (tmp_path / "mesh.npz.preview.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "look"),
    [([], "area"), (["--look", "splats"], "splats"), (["--set", "footprint=filter"], "splats")],
)
def test_fidelity_is_that_of_the_look_that_was_chosen(splats, tmp_path, capsys, options, look):
    out = tmp_path / "mesh.npz"
    assert run(splats, "-o", out, "--fidelity", "2", "--no-preview", *options) == 0
    printed = capsys.readouterr().out
    assert f"2 views, look {look}" in printed
    assert (f"--look {look}" in printed) == (look != "area")
    cloud, mesh = load_gaussians(splats), load_mesh(out)
    views = orbit(mesh, 2, elevation=15, width=400, height=400)
    wanted = np.mean([view.psnr for view in compare(cloud, mesh, views, look=look).views])
    assert f"{wanted:.2f} dB" in printed


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.glb", ["--fidelity", 1, "--max-triangles", 16]),
        ("a.glb", ["--alpha", "ordered"]),
        ("a.glb", ["--lit", "--smooth"]),
        ("a.ply", ["--stream"]),
        ("a.spz", ["--max-splats", 2]),
    ],
)
def test_the_command_keeps_to_its_threads(splats, tmp_path, monkeypatch, name, options):
    """Without the option, images ask for the number of processors; the result is the same."""
    asked = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: asked.append(pid) or {0}, raising=False)
    made = tmp_path / name
    assert run(splats, "-o", made, *options, "--threads", 1) == 0
    assert not asked
    first = made.read_bytes()
    assert run(splats, "-o", made, *options, "--force") == 0
    assert bool(asked) == ("--stream" not in options)  # one thread converts block by block
    assert made.read_bytes() == first


def test_up(splats, tmp_path):
    """From the option, else from the cameras, else y points down."""
    save_cameras(orbit(np.eye(3), 3, up=(0, 0, 1)), tmp_path / "cameras.json")
    plain = (splats, "-o", tmp_path / "mesh.npz", "--no-preview", "--force")
    for options, up in [
        ((), (0, -1, 0)),
        (("--up", "-x"), (-1, 0, 0)),
        (("--cameras", tmp_path / "cameras.json"), (0, 0, 1)),
        (("--cameras", tmp_path / "cameras.json", "--up", "y"), (0, 1, 0)),
    ]:
        assert run(*plain, *options) == 0
        np.testing.assert_allclose(load_mesh(tmp_path / "mesh.npz").up, up, atol=1e-6)


@pytest.mark.parametrize("taken", ["mesh.glb", "mesh.glb.preview.png", "mesh.glb.config.toml"])
def test_nothing_is_overwritten(splats, tmp_path, capsys, taken):
    (tmp_path / taken).write_bytes(b"mine")
    assert run(splats, "-o", tmp_path / "mesh.glb") == 3
    assert taken in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith("mesh")] == [taken]
    assert (tmp_path / taken).read_bytes() == b"mine"
    assert run(splats, "-o", tmp_path / "mesh.glb", "--force") == 0
    assert (tmp_path / taken).read_bytes() != b"mine"


def test_another_format_lies_beside_the_first(splats, tmp_path):
    for suffix in (".npz", ".glb"):
        assert run(splats, "-o", tmp_path / f"mesh{suffix}") == 0
    names = sorted(path.name for path in tmp_path.iterdir() if path.name.startswith("mesh"))
    records = [f"mesh.{s}.{kind}" for s in ("npz", "glb") for kind in ("config.toml", "preview.png")]
    assert names == sorted(["mesh.npz", "mesh.glb", *records])
    assert run(splats, "-o", tmp_path / "mesh.glb") == 3  # the mesh itself is there
    assert run(splats, "-o", tmp_path / "mesh.npz") == 3
    before = (tmp_path / "mesh.npz.config.toml").read_bytes()
    assert run(splats, "-o", tmp_path / "mesh.glb", "--force") == 0
    assert (tmp_path / "mesh.npz.config.toml").read_bytes() == before


def test_the_input_is_never_the_output(splats, tmp_path, capsys):
    before = splats.read_bytes()
    for output in (splats, tmp_path / "link.ply"):
        if output != splats:
            make_link(output, splats)
        assert run(splats, "-o", output, "--force") == 2
        assert "is read by this command: give another name" in capsys.readouterr().err
        assert run(splats, "-o", output, "--as-splats", "--force") == 2
        assert splats.read_bytes() == before
    inner = tmp_path / "model/point_cloud/iteration_7/point_cloud.ply"
    inner.parent.mkdir(parents=True)
    inner.write_bytes(before)
    assert run(tmp_path / "model", "-o", inner, "--as-splats", "--force") == 2
    assert inner.read_bytes() == before


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("options", [[], ["--axes", "y-up"], ["--cameras", "cameras.json"]])
def test_the_next_command_compares_what_was_made(splats, tmp_path, capsys, options, monkeypatch):
    if not options:
        pytest.importorskip("pxr", reason="install meshsplats[usd]")
    monkeypatch.chdir(tmp_path)
    cloud = load_gaussians(splats)
    save_cameras(orbit(cloud, 2, width=40, height=40, elevation=60), tmp_path / "cameras.json")
    assert run(splats, "-o", "made.usdc" if not options else "made.npz", "--preset", "paper", *options) == 0
    command = words_of(re.search(r"next: meshsplats (.*)", capsys.readouterr().out)[1])
    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    axes = options[1] if options[:1] == ["--axes"] else "auto"
    cloud, mesh = load_gaussians(splats, axes=axes), load_mesh(command[2])
    cameras = load_cameras(tmp_path / "made-compare")
    if options[:1] == ["--cameras"]:
        assert [c.world_to_camera.tolist() for c in cameras] == [
            c.world_to_camera.tolist() for c in load_cameras(tmp_path / "cameras.json")
        ]
    drawn = render(mesh, cameras[0], samples=needed_samples(mesh, cameras)).color
    wanted = psnr(drawn, draw_splats(cloud, cameras[0]).color)
    assert printed["views"][0]["psnr"] == pytest.approx(wanted, abs=0.01)


def test_a_part_is_shown_not_compared_with_the_whole(splats, tmp_path, capsys):
    box = ["--crop", "-1", "-1", "-1", "1", "1", "1"]
    assert run(splats, "-o", tmp_path / "part.npz", *box) == 0
    out = capsys.readouterr().out
    part = load_mesh(tmp_path / "part.npz").splat_count
    assert f"40 splats, {part} of them converted ({part / 40:.1%}) -> " in out
    assert "next: meshsplats render" in out


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["-o", "mesh.stl"], 2, ".glb"),
        (["-o", "mesh"], 2, ".glb"),
        (["-o", "mesh.npz", "--lit"], 2, "--lit"),
        (["-o", "mesh.npz", "--set", "color_type=float32"], 2, "--set color_type"),
        (["-o", "mesh.npz", "--preset", "best"], 2, "--preset"),
        ([], 2, "output"),
        (["-o", "mesh.npz", "--up", "w"], 2, "--up"),
        (["-o", "mesh.npz", "--set", "sides=2"], 2, "sides"),
        (["-o", "mesh.npz", "--set", "footprint=cameras"], 1, "cameras"),
        (["-o", "mesh.npz", "--cameras", "none.json"], 1, "none.json: No such file"),
        (["-o", "no/such/mesh.npz"], 1, os.path.join("no", "such")),
    ],
)
def test_mistakes(splats, tmp_path, capsys, monkeypatch, options, code, words):
    monkeypatch.chdir(tmp_path)
    assert run(splats, *options) == code
    assert words in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["my scene.ply"]


def test_not_splats(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "mesh.ply") == 0
    assert run(tmp_path / "mesh.ply", "-o", tmp_path / "again.ply", "--as-splats") == 1
    assert "not splats" in capsys.readouterr().err
    save_cameras(orbit(np.eye(3), 2), tmp_path / "cameras.json")
    assert run(tmp_path / "cameras.json", "-o", tmp_path / "again.ply") == 1
    assert "not splats" in capsys.readouterr().err


def test_splats_as_splats(splats, tmp_path, capsys):
    """Cut out, by the limits one after the other, and otherwise unchanged."""
    cloud = load_gaussians(splats)
    box = (-1.0, -1.0, -1.0, 1.0, 1.5, 2.0)
    out = tmp_path / "part.ply"
    assert run(splats, "-o", out, "--as-splats", "--crop", *box, "--set", "min_opacity=0.5") == 0
    kept = (cloud.means >= box[:3]).all(1) & (cloud.means <= box[3:]).all(1) & (cloud.opacities >= 0.5)
    assert 3 < kept.sum() < 37
    part = load_gaussians(out)
    np.testing.assert_array_equal(part.means, cloud.means[kept])
    np.testing.assert_allclose(part.opacities, cloud.opacities[kept], atol=1e-6)
    assert capsys.readouterr().out.startswith(f"{kept.sum()} of 40 splats")
    assert toml.load(tmp_path / "part.ply.config.toml")["options"]["as_splats"] is True
    with Image.open(tmp_path / "part.ply.preview.png") as image:
        assert np.asarray(image)[300:500, 300:500].mean() < 250
    assert (
        run(
            splats,
            "-o",
            tmp_path / "few.ply",
            "--as-splats",
            "--max-splats",
            5,
            "--set",
            "budget=drop",
            "--no-preview",
        )
        == 0
    )
    few = load_gaussians(tmp_path / "few.ply")
    importance = cloud.opacities * np.sqrt(np.prod(cloud.scales.astype(float), axis=1)) ** (4 / 3)
    assert len(few) == 5
    ranks = np.argsort(np.argsort(-importance))[np.isin(cloud.means[:, 0], few.means[:, 0])]
    assert ranks.max() < 12  # a rough measure of size agrees roughly
    assert run(splats, "-o", tmp_path / "merged.ply", "--as-splats", "--max-splats", 5, "--no-preview") == 0
    merged = simplify(cloud, 5, cameras=merging_views(cloud))
    np.testing.assert_allclose(
        load_gaussians(tmp_path / "merged.ply").means, merged.means, rtol=1e-6, atol=1e-7
    )


@pytest.mark.parametrize(
    ("name", "options", "printed"),
    [
        ("a.obj", [], "splats are written as .ply"),
        ("a.ply", ["--lit"], "--lit: for a mesh"),
        ("a.ply", ["--data", "nowhere"], "--data: for a mesh"),
        ("a.ply", ["--data", "nowhere", "--max-splats", "3", "--set", "budget=drop"], "--data: for a mesh"),
        ("a.ply", ["--preset", "paper", "--set", "rings=2"], "--preset, --set rings: for a mesh"),
    ],
)
def test_options_that_splats_do_not_have(splats, tmp_path, capsys, name, options, printed):
    assert run(splats, "-o", tmp_path / name, "--as-splats", *options) == 2
    assert printed in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_the_command_that_keeps_colours_of_views_works(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_gaussians(make_scene(200), tmp_path / "scene.ply")
    assert run("scene.ply", "-o", "mesh.npz", "--no-sidecar") == 0
    capsys.readouterr()
    assert run("scene.ply", "-o", "flat.obj", "--no-sidecar") == 0
    advised = re.search("'meshsplats (bake .*?)'", capsys.readouterr().err)
    words = advised[1].replace("MESH.npz", "mesh.npz").replace("NEW.obj", "baked.obj")
    assert main([*words_of(words), "--width", "64"]) == 0
    assert "harmonics" not in capsys.readouterr().err
    assert len(load_mesh("baked.obj").faces) == len(load_mesh("mesh.npz").faces)


def test_no_splats_left(splats, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "a.ply", "--as-splats", "--set", "min_opacity=0.99") == 1
    assert "all are fainter than 0.99" in capsys.readouterr().err
    assert not (tmp_path / "a.ply").exists()


def test_alpha_reaches_the_file(splats, tmp_path, capsys):
    out = tmp_path / "m.glb"
    assert run(splats, "-o", out, "--alpha", "mask", "--no-preview") == 0
    document, _ = read_glb(out)
    assert document["materials"][0]["alphaMode"] == "MASK"
    assert document["materials"][0]["alphaCutoff"] == 0.2
    assert run(splats, "-o", tmp_path / "m.npz", "--alpha", "mask") == 2
    assert (
        "mask, hybrid or ordered, --compression and --set color_type are for .glb" in capsys.readouterr().err
    )


def test_previews_of_large_meshes_are_quick(splats, tmp_path, monkeypatch):
    mesh = convert(load_gaussians(splats))
    camera = orbit(mesh, 1, azimuth=30, width=800, height=800)[0]
    assert needed_samples(mesh, [camera.scaled(0.5)]) >= 2
    for most, side in ((len(mesh.faces), 800), (len(mesh.faces) - 1, 400)):
        monkeypatch.setattr(previews, "TRIANGLES", most)
        assert previews.save_preview(mesh, tmp_path / "a.png")
        with Image.open(tmp_path / "a.png") as image:
            pixels = np.asarray(image) / 255
        assert pixels.shape == (side, side, 3)
    expected = render(mesh, camera.scaled(0.5), samples=2).color
    assert np.abs(pixels - expected).max() < 1 / 255


def nested_balls(opacity: float) -> meshsplats.GaussianCloud:
    """A blue ball, and a red one inside it, which comes later in the file."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    inside = np.arange(600) >= 300
    rgb = np.where(inside[:, None], (2.0, -1, -1), (-1, -1, 2.0))
    return meshsplats.GaussianCloud(
        directions * np.where(inside, 0.7, 1)[:, None],
        np.tile([1.0, 0, 0, 0], (600, 1)),
        np.full((600, 3), 0.13),
        np.full(600, opacity),
        rgb[:, None],
    )


def material(path) -> dict:
    return GltfDocument(path).json["materials"][0]


def test_a_file_that_no_viewer_opens_says_so(tmp_path, capsys, monkeypatch):
    source = tmp_path / "balls.ply"
    save_gaussians(few_splats(), source)
    for limit, said in ((10**6, False), (1000, True)):
        monkeypatch.setattr("meshsplats.operations.conversion.LARGE_BYTES", limit)
        assert run(source, "-o", tmp_path / "m.glb", "--no-preview", "--force") == 0
        err = capsys.readouterr().err
        assert ("too large for viewers" in err) == ("--max-triangles 2000000 merges" in err) == said
    assert run(source, "-o", tmp_path / "m.npz", "--no-preview") == 0
    assert "too large" not in capsys.readouterr().err


def test_the_size_is_said_before_anything_is_written(tmp_path, capsys, monkeypatch):
    source, out = tmp_path / "balls.ply", tmp_path / "m.glb"
    save_gaussians(nested_balls(0.95), source)
    monkeypatch.setattr("meshsplats.operations.conversion.LARGE_BYTES", 1000)
    monkeypatch.setattr(
        "meshsplats.evaluation.mesh_files.MeshFileOptions.save", lambda *_: pytest.fail("stop")
    )
    with pytest.raises(pytest.fail.Exception):
        run(source, "-o", out, "--no-preview")
    said = re.search(r"about ([\d.]+) kB", capsys.readouterr().err)
    assert not out.exists()
    monkeypatch.undo()
    assert run(source, "-o", out, "--no-preview") == 0
    assert float(said[1]) == pytest.approx(out.stat().st_size / 1000, rel=0.25)  # 16-bit indices


def test_alpha_is_chosen_by_what_viewers_show(tmp_path, capsys):
    source, out = tmp_path / "balls.ply", tmp_path / "m.glb"
    save_gaussians(nested_balls(0.95), source)
    assert run(source, "-o", out, "--no-preview") == 0
    assert material(out)["alphaMode"] == "MASK"
    lines = capsys.readouterr().out.splitlines()
    chosen = next(line for line in lines if line.startswith("alpha: "))
    figures = re.fullmatch(
        r"alpha: mask with cutoff (0\.\d), (.*) dB from the sorted image in viewers that do not sort,"
        r" seen from afar; blend: (.*) dB \(--alpha blend for ray tracers and Blender's own importer\)",
        chosen,
    )
    assert figures is not None
    assert float(figures[1]) == material(out)["alphaCutoff"]
    assert float(figures[2]) > float(figures[3])
    better = lines[lines.index(chosen) + 1]
    assert better.startswith("better there: an order in the file, --alpha ordered ")
    solid = lines[lines.index(better) + 1]
    words = words_of(solid.partition("or solid triangles: meshsplats ")[2].rpartition(" (")[0])
    assert words[-4:] == ["--opacity", "cutoff", "--soft-share", "0.05"]
    # A mesh gets the same choice, and what was asked for counts.
    assert run(source, "-o", tmp_path / "m.npz", "--json", "--no-preview") == 0
    assert json.loads(capsys.readouterr().out)["alpha"] is None
    assert run(tmp_path / "m.npz", "-o", tmp_path / "again.glb", "--json", "--no-preview") == 0
    assert material(tmp_path / "again.glb") == material(out)
    assert json.loads(capsys.readouterr().out)["alpha"]["mask"] == pytest.approx(float(figures[2]), abs=0.06)
    assert run(source, "-o", tmp_path / "b.glb", "--alpha", "blend", "--no-preview") == 0
    assert material(tmp_path / "b.glb")["alphaMode"] == "BLEND"
    assert "better there" not in capsys.readouterr().out
    save_gaussians(nested_balls(0.05), source)
    assert run(source, "-o", tmp_path / "faint.glb", "--no-preview") == 0
    assert material(tmp_path / "faint.glb")["alphaMode"] == "BLEND"
    assert "alpha: blend, " in capsys.readouterr().out
    (tmp_path / "folder").mkdir()
    source.rename(tmp_path / "folder" / "balls.ply")
    assert run(tmp_path / "folder", "-o", tmp_path / "all", "--no-preview") == 0
    assert "balls.glb (" in (line := capsys.readouterr().out)
    assert ", alpha blend" in line


def test_an_order_is_solved_for_views_that_are_found_in_a_place(splats, tmp_path, monkeypatch):
    found, solved = orbit(load_gaussians(splats), 5, width=40, height=40), []

    def solve(mesh, cameras=None, **options):
        solved.append(cameras)
        return drawing_order(mesh, cameras, **options)

    monkeypatch.setattr("meshsplats.operations.conversion.default_views", lambda *_, **__: (found, "a room"))
    monkeypatch.setattr("meshsplats.rendering.ordering.drawing_order", solve)
    words = (splats, "-o", tmp_path / "a.glb", "--alpha", "ordered", "--no-preview", "--force")
    assert run(*words) == 0
    monkeypatch.setattr("meshsplats.operations.conversion.default_views", lambda *_, **__: None)
    assert run(*words) == 0
    assert solved == [found, None]


def test_an_order_for_viewers_that_cull(tmp_path, capsys):
    """Solved for views all around, or for those given; the mesh comes back as it was."""
    source, out, plain = tmp_path / "balls.ply", tmp_path / "m.glb", tmp_path / "plain.npz"
    save_gaussians(nested_balls(0.95), source)
    mesh = convert(nested_balls(0.95))
    save_mesh(mesh, plain)
    for name, count in (("three", 3), ("two", 2)):
        save_cameras(orbit(mesh, count, width=64, height=64), tmp_path / f"{name}.json")
    options = ("--alpha", "ordered", "--no-sidecar", "--force", "-o", out)
    three = ("--cameras", tmp_path / "three.json")
    assert run(source, *options, *three, "--set", "nodes=3") == 0
    assert ", solved the order " in capsys.readouterr().out
    assert not material(out)["doubleSided"]
    assert main(["info", str(out)]) == 0
    assert "for viewers that cull: every triangle twice, in 3 nodes" in capsys.readouterr().out
    assert run(out, "--scale", 0.01, "--no-sidecar", "--no-preview", "-o", tmp_path / "small.glb") == 0
    assert main(["info", str(tmp_path / "small.glb")]) == 0
    assert "every triangle twice, in 3 nodes" in capsys.readouterr().out
    solved = load_mesh(out)
    np.testing.assert_array_equal(
        solved.faces, convert(nested_balls(0.95), cameras=load_cameras(three[1])).faces
    )
    made = []
    for views in (three, three, ("--cameras", tmp_path / "two.json"), ("--set", "quick=True")):
        assert run(plain, *options, *views, "--set", "nodes=1") == 0
        made.append(out.read_bytes())
    assert made[0] == made[1]
    assert len(set(made)) == 3
    capsys.readouterr()
    assert main(["info", str(out)]) == 0
    assert "every triangle twice, in 1 node" in capsys.readouterr().out
    save_mesh(mesh, tmp_path / "plain.glb")
    assert main(["info", str(tmp_path / "plain.glb")]) == 0
    assert "cull" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--set", "nodes=2"), "nodes and quick are for --alpha ordered"),
        (("--alpha", "ordered", "--lit"), "neither --lit nor --compression"),
        (
            ("--alpha", "ordered", "--set", "nodes=0"),
            "nodes must be a number from 1 to 256, or 'auto', got 0",
        ),
    ],
)
def test_what_an_order_does_not_go_with_is_said_before_the_input_is_read(tmp_path, capsys, options, message):
    (tmp_path / "balls.ply").write_bytes(b"not splats")
    assert run(tmp_path / "balls.ply", "-o", tmp_path / "m.glb", *options) != 0
    assert message in capsys.readouterr().err
    assert not (tmp_path / "m.glb").exists()


@pytest.mark.slow
def test_other_commands_choose_alpha_too(tmp_path):
    mesh = convert(nested_balls(0.95))
    assert alpha_for_viewers(mesh, tmp_path / "a.npz") == {}
    options = alpha_for_viewers(mesh, tmp_path / "a.GLB")
    assert options["alpha"] == "mask"
    save_mesh(mesh, tmp_path / "m.npz")
    assert main(["clean", str(tmp_path / "m.npz"), "-o", str(tmp_path / "c.glb")]) == 0
    assert material(tmp_path / "c.glb")["alphaMode"] == "MASK"
    filtered = convert(nested_balls(0.95), footprint="filter")
    save_mesh(filtered, tmp_path / "f.npz")
    assert main(["bake", str(tmp_path / "f.npz"), "-o", str(tmp_path / "b.glb")]) == 0
    assert material(tmp_path / "b.glb")["alphaMode"] == "MASK"


def test_smooth_normals_are_those_of_the_surface(tmp_path, capsys):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(600, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turns = np.column_stack([1 + directions[:, 2], -directions[:, 1], directions[:, 0], np.zeros(600)])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    tilted = turns + 0.3 * rng.normal(size=turns.shape)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    ball = meshsplats.GaussianCloud(
        directions, tilted, np.tile([0.1, 0.1, 0.01], (600, 1)), np.full(600, 0.9), np.zeros((600, 1, 3))
    )
    save_gaussians(ball, tmp_path / "ball.ply")
    out = tmp_path / "m.glb"
    agreement = []
    for options in ((), ("--smooth",)):
        command = ("--alpha", "opaque", "--lit", *options, "--no-sidecar", "--force")
        assert run(tmp_path / "ball.ply", "-o", out, *command) == 0
        document = GltfDocument(out)
        normals = document.floats(
            document.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"], "NORMAL"
        )
        outward = load_mesh(out).vertices
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        agreement.append(np.median(np.einsum("ij,ij->i", normals, outward)))
    assert agreement[1] > 0.97 > abs(agreement[0])
    capsys.readouterr()
    assert run(tmp_path / "ball.ply", "-o", tmp_path / "b.glb", "--smooth") == 2
    assert "--smooth has no effect without --lit" in capsys.readouterr().err


def test_hybrid_is_for_meshes_with_solid_triangles(splats, tmp_path, capsys):
    source, out = tmp_path / "m.npz", tmp_path / "m.glb"
    colors = [(1, 0, 0, 1)] * 3 + [(0, 1, 0, 0.5)]
    mesh = SplatMesh([(0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)], [(0, 1, 2), (1, 3, 2)], colors)
    save_mesh(mesh, source)
    assert run(source, "-o", out, "--alpha", "hybrid", "--no-preview") == 0
    document, _ = read_glb(out)
    assert [m["alphaMode"] for m in document["materials"]] == ["OPAQUE", "BLEND"]
    capsys.readouterr()
    assert run(splats, "-o", tmp_path / "b.glb", "--alpha", "hybrid") == 2
    assert "holds splats" in capsys.readouterr().err
    assert run(source, "-o", tmp_path / "b.npz", "--alpha", "hybrid") == 2
    assert "are for .glb" in capsys.readouterr().err
    assert run(source, "-o", tmp_path / "b.glb", "--alpha", "hybrid", "--set", "cutoff=0.3") == 2
    assert not (tmp_path / "b.glb").exists()


def test_opaque_triangles_in_every_format(splats, tmp_path, capsys):
    for name in ("m.glb", "m.ply"):
        out = tmp_path / name
        assert run(splats, "-o", out, "--alpha", "opaque", "--set", "cutoff=0.3", "--no-preview") == 0
        assert (load_mesh(out).colors[:, 3] == 1).all()
        assert f"{len(load_mesh(out).faces):,} triangles" in capsys.readouterr().out
    assert run(tmp_path / "m.ply", "-o", tmp_path / "a.npz", "--alpha", "opaque", "--no-preview") == 0
    assert len(load_mesh(tmp_path / "a.npz").faces) == len(load_mesh(tmp_path / "m.ply").faces)
    capsys.readouterr()
    assert run(splats, "-o", tmp_path / "b.glb", "--set", "cutoff=0.3") == 2
    assert "--set cutoff is for --alpha opaque or mask" in capsys.readouterr().err
