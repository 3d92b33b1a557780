"""Every command on a scene and on the same scene moved to a UTM zone: the same results, but for the place."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from _balls import ball_view, cameras_around, texture
from _datasets import save, write_colmap
from _photographs import write_photographs
from _splat_files import splat_table, write_ply

from meshsplats import (
    GaussianCloud,
    SplatMesh,
    Tileset,
    load_cameras,
    load_dataset,
    load_gaussians,
    load_mesh,
    load_points,
    save_cameras,
)
from meshsplats.cli import main
from meshsplats.finetuning.checkpoint import dataset_fingerprint, mesh_fingerprint
from meshsplats.formats.sniff import identify
from meshsplats.images.reading import load_image
from meshsplats.scene.gaussians import SH_C0
from meshsplats.tiles.drawing import join_tiles
from meshsplats.viewer import page
from meshsplats.viewer.page import Page, make_page

MOVE = np.array([500_000.5, 4_500_000.375, 100.0])
ORIGIN = np.array([500_000.0, 4_500_000.0, 100.0])
"""Of the splats: their middle is that of the ball. That of the cameras is more to the north."""
STEP = np.array([1.0, 2.0, 3.0])
VIEWS = 10


class Scene(NamedTuple):
    folder: Path
    move: np.ndarray

    def run(self, command: str) -> int:
        """Runs ``command``, in which names with a dot or a slash are files of the scene's folder, and X, Y, Z
        coordinates of the unmoved scene."""
        words = []
        for word in command.split():
            if match := re.fullmatch(r"([xyz])=(.*)", word):
                words.append(repr(float(match[2]) + float(self.move["xyz".index(match[1])])))
            else:
                words.append(str(self.folder / word) if re.search(r"\w/|\w\.[a-z]", word) else word)
        return main(words)


def write_scene(folder: Path, move: np.ndarray) -> Scene:
    """Splats and a base as files of doubles and decimals, cameras, and photographs in two layouts, all of one
    ball at ``move``."""
    folder.mkdir()
    n = 300
    i = np.arange(n) + 0.5
    z, turn = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    points = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    points = np.round(points * 2**16) / 2**16  # exact after the move, too
    rows = [*(points + move).T, *((texture(points) - 0.5) / SH_C0).T, np.full(n, 3.0)]
    rng = np.random.default_rng(0)
    rows += [*np.log(rng.uniform(0.03, 0.09, (3, n))), *rng.normal(size=(4, n))]
    names = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3)), "opacity", *(f"scale_{k}" for k in range(3))]
    names += [f"rot_{k}" for k in range(4)]
    values = dict(zip(names, rows, strict=True))
    table = splat_table(values, dict.fromkeys("xyz", "double"))
    write_ply(folder / "splats.ply", [table], comments=["Vertical axis: y"])  # which means -y
    box = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.4, 0.8) for z in (-0.6, 0.6)])
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    for name, corners in (("base.obj", box), ("edited.obj", box + np.array([0.75, 0, 0]))):
        lines = ["v {!r} {!r} {!r} 0.5 0.5 0.5".format(*map(float, p)) for p in corners + move]
        (folder / name).write_text("\n".join([*lines, *("f {} {} {} {}".format(*q) for q in quads)]))
    views = [ball_view(camera) for camera in cameras_around(VIEWS, side=32)]
    cameras = [view.camera.relative_to(-move) for view in views]
    save_cameras(cameras, folder / "cameras.json")
    images = [np.dstack([view.load().color, view.load().alpha]) for view in views]
    write_photographs(folder / "photos", cameras, images)
    entries = []
    backed = [ball_view(view.camera, backdrop=True).load().color for view in views]
    for k, (camera, image) in enumerate(zip(cameras, backed, strict=True)):
        save(folder / "colmap" / "images" / f"{k}.png", image)
        pose = camera.world_to_camera
        entries.append((f"{k}.png", quaternion(pose[:3, :3]), pose[:3, 3], 1))
    lens = (views[0].camera.fx, views[0].camera.fy, 16.0, 16.0)
    write_colmap(folder / "colmap", [(1, "PINHOLE", 32, 32, lens)], entries, text=True)
    spots = [
        "{} {!r} {!r} {!r} 128 128 128 0.5 1 1 2 2 3 3".format(k, *map(float, p))
        for k, p in enumerate(points + move)
    ]
    (folder / "colmap" / "sparse" / "0" / "points3D.txt").write_text("\n".join(spots))
    scene = Scene(folder, move)
    scene.run("convert splats.ply -o mesh.npz --set footprint=filter --no-sidecar")
    tuning = "--steps 1 --layers 1 --views 4 --held-out 1 --width 24"
    scene.run(f"prior base.obj --splats splats.ply -o prior.npz {tuning}")
    return scene


def quaternion(matrix: np.ndarray) -> np.ndarray:
    """w x y z of a rotation matrix, from the eigenvector of a symmetric matrix of its entries."""
    m = matrix
    k = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0, m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2]],
            [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    return np.linalg.eigh(k + np.triu(k, 1).T)[1][:, -1]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> tuple[Scene, Scene]:
    folder = tmp_path_factory.mktemp("worlds")
    return write_scene(folder / "near", np.zeros(3)), write_scene(folder / "far", MOVE)


def load(path: Path) -> GaussianCloud | SplatMesh:
    return load_gaussians(path) if identify(path) == "splats" else load_mesh(path)


def places(scene: GaussianCloud | SplatMesh) -> np.ndarray:
    return scene.origin + (scene.means if isinstance(scene, GaussianCloud) else scene.vertices)


TARGETS = "--views 6 --held-out 2 --width 32"
COMMANDS = {
    "out.glb": "convert splats.ply -o out.glb",
    "cameras.glb": "convert splats.ply -o cameras.glb --cameras cameras.json",
    "data.npz": "convert splats.ply -o data.npz --data photos/",
    "stream.ply": "convert splats.ply -o stream.ply --stream --cameras cameras.json",
    "part.npz": "convert splats.ply -o part.npz --crop x=-2 y=-2 z=-2 x=2 y=2 z=0",
    "again.usdc": "convert mesh.npz -o again.usdc",
    "splats_again.ply": "convert splats.ply -o splats_again.ply --as-splats --max-splats 100"
    " --cameras cameras.json",
    "streamed.ply": "convert splats.ply -o streamed.ply --as-splats --stream",
    "simple.ply": "simplify splats.ply -o simple.ply --share 0.5 --cameras cameras.json",
    "simpler.ply": "simplify splats.ply -o simpler.ply --share 0.5 --data colmap/",
    "clean.ply": "clean splats.ply -o clean.ply --crop x=-2 y=-2 z=-2 x=2 y=2 z=0.5",
    "clean.glb": "clean mesh.npz -o clean.glb --min-opacity 0.01",
    "baked.glb": "bake mesh.npz -o baked.glb --cameras cameras.json",
    "levels/level_1.npz": "levels splats.ply -o levels/ --levels 2 --no-tune --format npz --width 64",
    "levels_glb/level_0.glb": "levels splats.ply -o levels_glb/ --levels 1 --steps 2 --width 32",
    "base.ply": "surface splats.ply -o base.ply --resolution 24 --views 12 --size 96 --texture 0 --rounds 0",
    "posed.glb": "deform prior.npz --base edited.obj -o posed.glb",
    "tuned.glb": f"finetune splats.ply -o tuned.glb --steps 6 {TARGETS}",
    "tuned_cameras.npz": "finetune splats.ply -o tuned_cameras.npz --steps 4 --views 6 --held-out 2"
    " --cameras cameras.json --width 32",
    "tuned_data.npz": "finetune splats.ply -o tuned_data.npz --steps 6 --data photos/",
    "tuned_mesh.npz": "finetune mesh.npz -o tuned_mesh.npz --steps 6 --data colmap/",
    "cells.npz": f"finetune splats.ply -o cells.npz --steps 3 --cell-splats 150 {TARGETS}",
    "trained.npz": "train photos/ -o trained.npz --steps 6 --start-splats 300 --max-splats 300"
    " --as-splats fans.ply",
    "trained_colmap.glb": "train colmap/ -o trained_colmap.glb --steps 6 --start-splats 300 --max-splats 300",
    "prior_data.npz": "prior base.obj --data photos/ -o prior_data.npz --steps 2 --layers 1",
}
SCORE = ("scenes", 0, "methods", "mesh", "mean", "psnr")
CHOSEN = ("baked", "base", "levels", "simpl", "splats_again")
MATCHED = ("trained",)
"""Results that begin with photographs that are matched with each other."""
TRAINED = ("trained", "tuned", "levels_glb", "prior", "cells")


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("output", COMMANDS)
def test_results_stand_where_the_input_does(scenes, output):
    """All vertices and splats of the result are those of the unmoved scene, moved. Roundings to float32
    differ in the last bit; where something is chosen or trained by them, few differ by more."""
    if output.endswith("usdc"):
        pytest.importorskip("pxr.Usd")
    if COMMANDS[output].startswith("surface "):
        pytest.importorskip("skimage", reason="surface needs its extra: pip install 'meshsplats[base]'")
    near, far = scenes
    for scene in scenes:
        assert scene.run(COMMANDS[output]) == 0
    one, other = load(near.folder / output), load(far.folder / output)
    assert other.origin.any()
    assert not one.origin.any()
    trained, chosen = output.startswith(TRAINED), output.startswith(CHOSEN)
    assert len(places(one)) == len(places(other))
    if output.startswith(MATCHED):
        # Where matching decides otherwise by rounding, the fans behind have other numbers.
        apart = places(other)[:, None] - MOVE - places(one)
        assert np.median(np.abs(apart).max(axis=2).min(axis=1)) < 0.05
        return
    away = np.abs(places(other) - MOVE - places(one)).max(axis=1)
    assert np.quantile(away, 0.98 if trained or chosen else 1) < (5e-3 if trained else 2e-6)
    if isinstance(one, SplatMesh) and isinstance(other, SplatMesh):
        np.testing.assert_array_equal(one.faces, other.faces)
        off = np.abs(one.colors - other.colors).max(axis=1)
        assert np.quantile(off, 0.98 if trained or chosen else 1) < (2e-2 if trained else 1e-3)
    held_out = [scene.folder / f"{output}.run" / "held_out.cameras.json" for scene in scenes]
    if held_out[0].exists():
        for a, b in zip(*map(load_cameras, held_out), strict=True):
            np.testing.assert_allclose(b.center - MOVE, a.center, atol=1e-5)
    fans = [scene.folder / "fans.ply" for scene in scenes]
    if "fans.ply" in COMMANDS[output]:
        one, other = map(load, fans)
        np.testing.assert_allclose(np.median(places(other) - MOVE - places(one), axis=0), 0, atol=1e-3)


@pytest.mark.parametrize(
    "command",
    [
        "render splats.ply -o X.png --width 48",
        "render splats.ply -o X.png --width 48 --as-splats --look-at x=0 y=0 z=0.5",
        "render splats.ply -o images_a/ --cameras cameras.json",
        "render mesh.npz -o images_b/ --data colmap/",
        "render splats.ply -o images_c/ --data photos/ --crop x=-2 y=-2 z=-2 x=2 y=2 z=0",
    ],
)
def test_images_are_the_same(scenes, command):
    """And the cameras that are written beside them stand in the world."""
    for scene in scenes:
        assert scene.run(command.replace("X.png", f"x{len(command)}.png")) == 0
    target = re.search(r"-o (\S+)", command)[1].replace("X.png", f"x{len(command)}.png")
    folders = [scene.folder / target for scene in scenes]
    names = [sorted(f.glob("view_*.png")) if f.is_dir() else [f] for f in folders]
    assert len(names[0]) in (1, 2, VIEWS)
    for one, other in zip(*names, strict=True):
        first, second = load_image(one).astype(int), load_image(other).astype(int)
        assert first.std() > 10
        assert np.abs(first - second).max() <= 1
    files = [f / "cameras.json" if f.is_dir() else f.with_name(f.name + ".cameras.json") for f in folders]
    for one, other in zip(*map(load_cameras, files), strict=True):
        np.testing.assert_allclose(other.center - MOVE, one.center, atol=1e-6)


@pytest.mark.parametrize(
    ("command", "key"),
    [
        ("compare splats.ply mesh.npz -o compared/ --cameras cameras.json --json", ("mean", "psnr")),
        ("compare splats.ply -o compared_data/ --data photos/ --json", ("mean", "psnr")),
        (
            "evaluate mesh.npz -o evaluated/ --data colmap/ --json --strips 0",
            SCORE,
        ),
        (
            "evaluate mesh.npz -o evaluated_splats/ --splats splats.ply --data photos/ --json --strips 0",
            SCORE,
        ),
        (
            "evaluate mesh.npz -o evaluated_cameras/ --splats splats.ply --cameras cameras.json --json"
            " --strips 0",
            SCORE,
        ),
    ],
)
def test_scores_are_the_same(scenes, capsys, command, key):
    found = []
    for scene in scenes:
        assert scene.run(command) == 0
        value = json.loads(capsys.readouterr().out)
        found.append(value)
    if "compared" in command:
        folders = [scene.folder / re.search(r"-o (\S+)", command)[1] for scene in scenes]
        for one, other in zip(*(load_cameras(folder) for folder in folders), strict=True):
            np.testing.assert_allclose(other.center - MOVE, one.center, atol=1e-6)
    scores = []
    for value in found:
        for part in key:
            value = value[part]
        scores.append(value)
    assert scores[0] == pytest.approx(scores[1], abs=0.01)
    assert scores[0] > 7


def test_tilesets_stand_in_the_world(scenes, capsys):
    near, far = scenes
    for scene in scenes:
        assert scene.run("tiles splats.ply -o tiles/ --max-triangles 500") == 0
        assert scene.run("render tiles/ -o tiles.png --width 48") == 0
    first, second = (load_image(scene.folder / "tiles.png").astype(int) for scene in scenes)
    assert np.abs(first - second).max() <= 1
    one, other = (Tileset(scene.folder / "tiles") for scene in scenes)
    np.testing.assert_array_equal(other.origin, ORIGIN)
    np.testing.assert_array_equal(join_tiles(other, [other.root]).origin, ORIGIN)
    np.testing.assert_allclose(one.root.center, other.root.center + ORIGIN - MOVE, atol=1e-6)
    document = json.loads((far.folder / "tiles" / "tileset.json").read_text())
    matrix = np.array(document["root"]["transform"]).reshape(4, 4).T
    seen = matrix[:3, :3] @ document["root"]["boundingVolume"]["box"][:3] + matrix[:3, 3]
    # Splats have y down; tiles have z up: (x, y, z) becomes (x, z, -y).
    np.testing.assert_allclose(seen, [MOVE[0], MOVE[2], -MOVE[1]], atol=0.2)
    assert "transform" not in json.loads((near.folder / "tiles" / "tileset.json").read_text())["root"]
    capsys.readouterr()
    assert main(["info", str(far.folder / "tiles"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["origin"] == ORIGIN.tolist()


def test_a_tileset_is_resumed_where_it_stands(scenes, tmp_path, monkeypatch):
    """The journal names the origin: with another one, the parts would not fit."""
    from meshsplats.formats.streaming import stream_gaussians
    from meshsplats.tiles.building import JOURNAL, TileOptions, build_tiles, partial_folder

    source = stream_gaussians(scenes[1].folder / "splats.ply")
    options = TileOptions(max_triangles=500, alpha="blend")

    def stop(phase: str, share: float | None) -> None:
        if phase == "making the tiles":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build_tiles(source, tmp_path / "t", options, on_progress=stop)
    assert (partial_folder(tmp_path / "t") / JOURNAL).is_file()
    moved = stream_gaussians(scenes[1].folder / "splats.ply", origin=ORIGIN + 1)
    with pytest.raises(ValueError, match="started with other origin"):
        build_tiles(moved, tmp_path / "t", options, resume=True)
    build_tiles(source, tmp_path / "t", options, resume=True)
    np.testing.assert_array_equal(Tileset(tmp_path / "t").origin, ORIGIN)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".glb", ".npz", ".ply"])
def test_origin_options(scenes, capsys, suffix):
    """keep, local, and a point that several scenes can share."""
    _, far = scenes
    point = ORIGIN - np.array([10, 20, 0])
    given = " ".join(repr(float(x)) for x in point)
    for name, option in (("keep", "keep"), ("local", "local"), ("shared", given)):
        assert far.run(f"convert splats.ply -o {name}.x{suffix} --origin {option} --no-sidecar --force") == 0
    keep, local, shared = (
        load_mesh(far.folder / f"{name}.x{suffix}") for name in ("keep", "local", "shared")
    )
    np.testing.assert_array_equal(keep.origin, ORIGIN)
    np.testing.assert_array_equal(local.vertices, keep.vertices)
    np.testing.assert_allclose(shared.vertices, keep.vertices + np.array([10, 20, 0]), atol=3e-6)
    assert not local.origin.any()
    assert not shared.origin.any()
    told = capsys.readouterr().err
    assert "origin: 500000 4500000 100; --origin local leaves it out" in told
    assert "origin: left out; coordinates are relative to 500000 4500000 100" in told
    assert "origin: coordinates are relative to 499990 4499980 100" in told
    assert far.run(f"convert splats.ply -o bad{suffix} --origin 0 0 0 --no-sidecar") == 2
    assert "too far from the scene" in capsys.readouterr().err
    assert not (far.folder / f"bad{suffix}").exists()


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize(
    "command",
    [
        "convert splats.ply -o o1.ply --as-splats --origin local",
        "convert splats.ply -o o2.ply --stream --origin local",
        "convert splats.ply -o o3.ply --stream --as-splats --origin x=-1 y=0 z=0",
        "convert mesh.npz -o o4.glb --origin local",
        "simplify splats.ply -o o5.ply --share 0.5 --origin local",
        "clean splats.ply -o o6.ply --min-opacity 0.1 --origin x=-1 y=0 z=0",
        "bake mesh.npz -o o7.glb --origin local",
        "surface splats.ply -o o8.obj --resolution 24 --views 8 --size 64 --texture 0 --origin local",
        "deform prior.npz --base base.obj -o o9.npz --origin local",
        "finetune splats.ply -o o10.npz --steps 1 --views 4 --held-out 0 --width 24 --origin x=-1 y=0 z=0",
        "train photos/ -o o11.npz --steps 1 --start-splats 100 --max-splats 100 --as-splats o11.ply"
        " --origin local",
        "prior base.obj --data photos/ -o o12.npz --steps 1 --layers 1 --origin local",
    ],
)
def test_every_command_that_writes_can_leave_it_out(scenes, command):
    _, far = scenes
    if command.startswith("surface "):
        pytest.importorskip("skimage", reason="surface needs its extra: pip install 'meshsplats[base]'")
    assert far.run(command) == 0
    written = load(far.folder / re.search(r"-o (\S+)", command)[1])
    assert not written.origin.any()
    assert 0.3 < np.abs(places(written)).max() < 20
    if "x=-1" in command:
        assert np.median(places(written)[:, 0]) == pytest.approx(1, abs=0.3)
    if "o11" in command:
        assert not load_gaussians(far.folder / "o11.ply").origin.any()


def test_levels_and_tiles_without_an_origin(scenes):
    _, far = scenes
    assert far.run("levels splats.ply -o levels_o/ --levels 1 --no-tune --width 32 --origin local") == 0
    assert not load_mesh(far.folder / "levels_o" / "level_0.glb").origin.any()
    assert far.run("tiles splats.ply -o tiles_o/ --origin local") == 0
    assert not Tileset(far.folder / "tiles_o").origin.any()
    assert far.run("tiles splats.ply -o tiles_p/ --origin x=-3 y=0 z=0") == 0
    tileset = Tileset(far.folder / "tiles_p")
    assert not tileset.origin.any()
    assert tileset.root.center[0] == pytest.approx(3, abs=0.1)


def test_splats_say_what_other_programs_see(scenes, capsys):
    _, far = scenes
    assert far.run("convert splats.ply -o note.ply --as-splats --no-sidecar") == 0
    assert (
        "in a note of the file: other programs see the splats of .ply and .sog around 0 0 0"
        in capsys.readouterr().err
    )


def test_info_is_in_the_world(scenes, capsys):
    far = scenes[1]
    for name in ("splats.ply", "mesh.npz", "base.obj", "cameras.json", "photos", "colmap"):
        found = []
        for scene in scenes:
            assert main(["info", str(scene.folder / name), "--json"]) == 0
            found.append(json.loads(capsys.readouterr().out))
        for key in ("lower", "upper"):
            np.testing.assert_allclose(np.array(found[1][key]) - MOVE, found[0][key], atol=1e-5)
        assert "origin" not in found[0]
        np.testing.assert_allclose(found[1]["origin"], MOVE, atol=2)
        assert main(["info", str(far.folder / name)]) == 0
        assert re.search(r"upper +50000\d\S* +450000\d\S* +10", capsys.readouterr().out)


def test_a_page_is_relative_to_the_origin(scenes, monkeypatch):
    made = []

    def keep(mesh: SplatMesh, **options: Any) -> Page:
        made.append((mesh, options["cameras"]))
        return make_page(mesh, **options)

    monkeypatch.setattr(page, "make_page", keep)
    for scene, source in zip(
        (*scenes, scenes[1]), ("--cameras cameras.json",) * 2 + ("--data photos/",), strict=True
    ):
        assert scene.run(f"view splats.ply -o page.html --force {source}") == 0
    for mesh, cameras in made:
        away = [np.linalg.norm(camera.center - np.median(mesh.vertices, axis=0)) for camera in cameras]
        np.testing.assert_allclose(away, 3, atol=0.2)


def test_data_sets_and_points_are_relative_to_one_origin(scenes):
    near, far = scenes
    for name in ("photos", "colmap"):
        one, other = load_dataset(near.folder / name), load_dataset(far.folder / name)
        np.testing.assert_array_equal(other.origin, ORIGIN + np.array([0, 1, 0]))
        assert "origin 500000 4500001 100" in repr(other)
        given = load_dataset(far.folder / name, origin=MOVE + STEP)
        for a, b, c in zip(one.views, other.views, given.views, strict=True):
            np.testing.assert_allclose(b.camera.center + other.origin - MOVE, a.camera.center, atol=1e-6)
            np.testing.assert_allclose(b.camera.up, a.camera.up, atol=1e-6)
            np.testing.assert_allclose(c.camera.center, a.camera.center - STEP, atol=1e-6)
    one, other = load_points(near.folder / "colmap"), load_points(far.folder / "colmap", origin=MOVE)
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(other.positions, one.positions, atol=1e-8)


def test_inria_cameras_of_the_world(tmp_path):
    entry = {"img_name": "a", "width": 9, "height": 9, "fx": 9, "fy": 9, "rotation": np.eye(3).tolist()}
    (tmp_path / "cameras.json").write_text(json.dumps([entry | {"position": (MOVE + STEP).tolist()}]))
    (camera,) = load_cameras(tmp_path, origin=MOVE)
    np.testing.assert_allclose(camera.center, STEP, atol=1e-8)
    save_cameras([camera], tmp_path / "b.json", origin=MOVE)
    (again,) = load_cameras(tmp_path / "b.json")
    np.testing.assert_allclose(again.center, MOVE + STEP, atol=1e-8)


def test_a_run_is_resumed_with_its_origin(scenes):
    _, far = scenes
    command = "finetune splats.ply -o resumed.npz --views 4 --held-out 0 --width 24"
    assert far.run(f"{command} --steps 2") == 0
    assert far.run(f"{command} --steps 4 --resume --force") == 0
    mesh = load_mesh(far.folder / "resumed.npz")
    np.testing.assert_array_equal(mesh.origin, ORIGIN)
    elsewhere = replace(mesh, origin=ORIGIN + 1)
    assert mesh_fingerprint(mesh) != mesh_fingerprint(elsewhere)
    data = load_dataset(far.folder / "photos")
    assert dataset_fingerprint(data) != dataset_fingerprint(replace(data, origin=ORIGIN + 1))


def test_records_of_different_origins_are_refused(scenes):
    """In Python, where nothing rebases them: a wrong picture would say nothing."""
    from meshsplats import compare, evaluate, finetune

    far = scenes[1].folder
    cloud, mesh, data = (
        load_gaussians(far / "splats.ply"),
        load_mesh(far / "mesh.npz"),
        load_dataset(far / "photos"),
    )
    assert (data.origin != mesh.origin).any()
    for wrong in (
        lambda: finetune(mesh, data, steps=1),
        lambda: evaluate(mesh, data),
        lambda: compare(cloud, mesh.relative_to(data.origin), [data.train[0].camera]),
    ):
        with pytest.raises(ValueError, match=r"is relative to .*relative_to\("):
            wrong()
    evaluate(mesh, data.relative_to(mesh.origin))
