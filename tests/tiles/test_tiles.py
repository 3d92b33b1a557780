"""Tilesets: taken apart by a reader of their own, built with interruptions, drawn against the whole mesh."""

from __future__ import annotations

import errno
import json
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _cities import COUNT, SMALL, digest, write_city
from _glb import read_glb

from meshsplats import (
    FileFormatError,
    convert,
    load_gaussians,
    load_mesh,
    orbit,
    psnr,
    render,
    save_gaussian_blocks,
    stream_gaussians,
)
from meshsplats.cli import main
from meshsplats.conversion import ConversionOptions
from meshsplats.demo_scene.city import city_blocks
from meshsplats.evaluation.viewers import AlphaChoice
from meshsplats.tiles import buckets, building, making
from meshsplats.tiles import tileset as tilesets
from meshsplats.tiles.building import TileOptions, TilesetSummary, build_tiles
from meshsplats.tiles.drawing import choose_tiles, reaches, render_tiles, screen_error, tiles_mesh
from meshsplats.tiles.journal import Journal
from meshsplats.tiles.tileset import Tileset, is_tile_file


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    return write_city(tmp_path_factory.mktemp("city"))


@pytest.fixture(autouse=True)
def small_buckets(monkeypatch):
    """Cells of few splats and files of few levels, so that a small scene needs several."""
    monkeypatch.setattr(building, "BUCKET", 3000)
    monkeypatch.setattr(tilesets, "LEVELS_PER_FILE", 2)


@pytest.fixture(scope="module")
def tileset(splats, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles") / "tileset"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(building, "BUCKET", 3000)
        patch.setattr(tilesets, "LEVELS_PER_FILE", 2)
        build_tiles(stream_gaussians(splats, block=1000), folder, SMALL)
    return folder


# ---- A reader by the letter of the specifications, without any of ours


def positions(path):
    """Vertices in the frame of the tileset: turned by the node of the file, then from y up to z up."""
    document, binary = read_glb(path)
    (node,) = document["nodes"]
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    view = document["bufferViews"][accessor["bufferView"]]
    points = np.frombuffer(binary, "<f4", 3 * accessor["count"], view["byteOffset"]).reshape(-1, 3)
    x, y, z, w = node["rotation"]
    axis = np.array([x, y, z])
    turned = points + 2 * np.cross(axis, np.cross(axis, points) + w * points)
    return np.stack([turned[:, 0], -turned[:, 2], turned[:, 1]], axis=1)


def splat_rows(path):
    document, binary = read_glb(path)
    view = document["bufferViews"][document["meshes"][0]["extras"]["meshsplats"]["face_splat"]["bufferView"]]
    return np.unique(np.frombuffer(binary, "<i4", view["byteLength"] // 4, view["byteOffset"]))


def inside(points, box):
    """Whether ``points`` lie in a box of 12 numbers: its axes span it from its centre."""
    axes = np.array(box[3:]).reshape(3, 3)
    along = np.linalg.solve(axes.T, (points - np.array(box[:3])).T)
    return bool((np.abs(along) <= 1).all())


def corners(box):
    axes = np.array(box[3:]).reshape(3, 3)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return np.array(box[:3]) + signs @ axes


def walk(file, most_error):
    """Every tile of a tileset file and of those inside: file, entry and depth; checks their relations."""
    document = json.loads(file.read_text())
    assert document["asset"]["version"] == "1.1"
    assert document["geometricError"] >= document["root"]["geometricError"]
    assert document["geometricError"] <= most_error
    todo = [(document["root"], 0)]
    while todo:
        tile, depth = todo.pop()
        assert tile.get("refine", "REPLACE") == "REPLACE"
        target = file.parent / tile["content"]["uri"]
        assert target.is_file()
        if target.name == "tileset.json":
            assert "children" not in tile
            inner = json.loads(target.read_text())["root"]
            assert inner["geometricError"] <= tile["geometricError"]
            assert inner["boundingVolume"] == tile["boundingVolume"]
            yield from walk(target, tile["geometricError"])
            continue
        yield file, tile, target
        for child in tile.get("children", []):
            assert child["geometricError"] <= tile["geometricError"]
            shrunk = np.array(child["boundingVolume"]["box"])
            shrunk[3:] *= 1 - 1e-5  # each box is a little larger than what it holds
            assert inside(corners(shrunk), tile["boundingVolume"]["box"])
            todo.append((child, depth + 1))


@pytest.mark.slow
def test_every_splat_is_in_one_leaf_and_every_box_holds_its_tiles(splats, tileset):
    tiles = list(walk(tileset / "tileset.json", np.inf))
    assert len(tiles) > 20
    assert len({file for file, _, _ in tiles}) > 2  # several tileset files
    leaves = [target for _, tile, target in tiles if not tile.get("children")]
    inner = [tile for _, tile, _ in tiles if tile.get("children")]
    assert all(tile["geometricError"] > 0 for tile in inner)
    rows = np.concatenate([splat_rows(path) for path in leaves])
    np.testing.assert_array_equal(np.sort(rows), np.arange(COUNT))
    for _, tile, target in tiles:
        document, _ = read_glb(target)
        primitive = document["meshes"][0]["primitives"][0]
        triangles = document["accessors"][primitive["indices"]]["count"] // 3
        assert triangles == tile["extras"]["triangles"] <= 4096
        assert inside(positions(target), tile["boundingVolume"]["box"])
    written = {target for _, _, target in tiles} | {file for file, _, _ in tiles}
    assert written == {path for path in tileset.rglob("*") if path.is_file()}


def test_leaves_hold_the_triangles_of_the_whole_mesh(splats, tileset):
    """Of each splat those that ``convert`` makes of the whole scene."""
    mesh = convert(load_gaussians(splats))
    starts, held = np.searchsorted(mesh.face_splat, np.arange(COUNT + 1)), 0
    for tile, _ in Tileset(tileset).tiles():
        if tile.children:
            continue
        part = load_mesh(tile.content)
        own = np.unique(part.face_splat)
        faces = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in own])
        assert len(faces) == len(part.faces)
        held += len(faces)
        expected = mesh.vertices[mesh.faces[faces]]
        np.testing.assert_allclose(part.vertices[part.faces], expected, rtol=0, atol=2e-5)
    assert held == len(mesh.faces)


def test_the_coarsest_tile_looks_like_the_scene_from_afar(splats, tileset):
    root = Tileset(tileset).root.load()
    assert root.splat_count < COUNT / 8
    camera = orbit(root, 1, elevation=30, width=64, height=48, distance=4)[0]
    coarse, fine = (render(m, camera, samples=4) for m in (root, convert(load_gaussians(splats))))
    empty = np.ones_like(fine.color)
    assert psnr(coarse.color, fine.color) > psnr(empty, fine.color) + 8


def test_the_geometric_error_is_how_far_splats_are_moved(splats, tmp_path):
    """By hand, on two rows of splats that merge in pairs: each centre moves by half their distance."""
    rng = np.random.default_rng(0)
    n = 1024
    place = np.repeat(np.arange(n // 2), 2)
    means = np.stack([place * 10.0, np.tile([0, 0.5], n // 2), np.zeros(n)], axis=1)
    cloud = next(city_blocks(n, degree=0))
    fields = {name: getattr(cloud, name) for name in ("quaternions", "opacities", "sh")}
    cloud = type(cloud)(means, scales=np.full((n, 3), 0.5), **fields | {"opacities": np.full(n, 0.9)})
    order = rng.permutation(n)
    save_gaussian_blocks([cloud.take(order)], tmp_path / "rows.ply", n)
    conversion = ConversionOptions(footprint="none")
    options = TileOptions(max_triangles=8 * 512, alpha="mask", conversion=conversion)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "SHARE", 2)
        build_tiles(stream_gaussians(tmp_path / "rows.ply"), tmp_path / "tiles", options)
    root = Tileset(tmp_path / "tiles").root
    assert root.splats == n // 2
    assert root.error == pytest.approx(0.25, rel=1e-3)


# ---- Determinism, interruptions


@pytest.mark.slow
def test_threads_and_blocks_do_not_matter(splats, tileset, tmp_path):
    for i, (threads, block) in enumerate([(1, 777), (2, 50_000)]):
        build_tiles(stream_gaussians(splats, block=block), tmp_path / str(i), SMALL, threads=threads)
        assert digest(tmp_path / str(i)) == digest(tileset)


@pytest.mark.slow
def test_a_run_that_fails_anywhere_is_resumed(splats, tileset, tmp_path, monkeypatch):
    """An error at one file after the other, until a run comes to its end."""
    out = tmp_path / "tiles"
    save = making.save_mesh
    add = Journal.add
    left = [0]

    def counted(function):
        def run(*arguments, **options):
            left[0] -= 1
            if left[0] == 0:
                raise OSError(errno.ENOSPC, "no space left", str(out))
            return function(*arguments, **options)

        return run

    monkeypatch.setattr(making, "save_mesh", counted(save))
    monkeypatch.setattr(Journal, "add", counted(add))
    runs, errors = 0, []
    while not out.exists():
        left[0] = 17 + runs % 5
        runs += 1
        assert runs < 40
        try:
            build_tiles(stream_gaussians(splats), out, SMALL, resume=runs > 1)
        except OSError as error:
            errors.append(error.errno)
            assert not out.exists()
            for path in (tmp_path / "tiles.partial" / "tileset").rglob("*.glb"):
                load_mesh(path)  # whole
    assert runs > 3
    assert errors == [errno.ENOSPC] * (runs - 1)
    assert digest(out) == digest(tileset)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiles"]


def materials(folder):
    return [read_glb(path)[0]["materials"][0] for path in sorted(folder.rglob("*.glb"))]


@pytest.mark.slow
@pytest.mark.parametrize("alpha", ["blend", "mask"])
def test_one_alpha_mode_is_chosen_for_all_tiles(splats, tmp_path, monkeypatch, alpha):
    chosen = AlphaChoice(alpha, 0.3, 20.0, 19.0 if alpha == "blend" else 21.0)
    drawn = []

    def choose(views, threads=None):
        drawn.extend(views)
        return chosen

    monkeypatch.setattr(building, "choose_by_views", choose)
    change, left = building.change_alpha, [3]

    def fails(*arguments, **options):
        left[0] -= 1
        if not left[0]:
            raise OSError(errno.EIO, "broken", "disk")
        change(*arguments, **options)

    monkeypatch.setattr(building, "change_alpha", fails)
    with pytest.raises(OSError, match="broken"):
        build_tiles(stream_gaussians(splats), tmp_path / "a", SMALL)
    assert len({str(material) for material in materials(tmp_path / "a.partial")}) == 2
    # It is chosen once: a resumed run goes on with it.
    count = len(drawn)
    found = build_tiles(stream_gaussians(splats), tmp_path / "a", SMALL, resume=True)
    assert (found.alpha, len(drawn)) == (chosen, count)
    wanted = {"alphaMode": alpha.upper()} | ({"alphaCutoff": 0.3} if alpha == "mask" else {})
    for material in materials(tmp_path / "a"):
        assert {name: value for name, value in material.items() if name.startswith("alpha")} == wanted
    assert len(materials(tmp_path / "a")) == found.tiles
    # The views are of the tiles that a viewer loads, the far ones first.
    tileset = Tileset(tmp_path / "a")
    for mesh, camera in drawn:
        tiles = choose_tiles(tileset, [camera])[0]
        assert len(mesh.faces) == sum(tile.triangles for tile in tiles)
        depth = [camera.world_to_camera[2, :3] @ tile.center for tile in tiles]
        farthest = tiles[int(np.argmax(depth))].load()
        np.testing.assert_array_equal(mesh.vertices[: len(farthest.vertices)], farthest.vertices)


@pytest.mark.slow
def test_alpha_modes_that_are_asked_for(splats, tmp_path, monkeypatch):
    monkeypatch.setattr(building, "choose_by_views", None)
    for alpha in ("blend", "mask", "opaque"):
        options = replace(SMALL, alpha=alpha)
        found = build_tiles(stream_gaussians(splats), tmp_path / alpha, options)
        assert found.alpha == AlphaChoice(alpha)
        assert {material["alphaMode"] for material in materials(tmp_path / alpha)} == {alpha.upper()}
    whole, cut = (
        tiles_mesh(Tileset(tmp_path / a), orbit(Tileset(tmp_path / a).root.corners(), 1))[0]
        for a in ("mask", "opaque")
    )
    assert (cut.colors[:, 3] == 1).all()
    camera = orbit(whole, 1, width=64, height=64)[0]
    difference = np.abs(render(whole, camera, cutoff=0.2).color - render(cut, camera).color).max(axis=2)
    assert (difference > 0.01).mean() < 0.01
    with pytest.raises(ValueError, match="alpha must be one of auto, blend, mask, opaque"):
        build_tiles(stream_gaussians(splats), tmp_path / "x", replace(SMALL, alpha="hybrid"))


RUN = """
import sys
from meshsplats import stream_gaussians
from meshsplats.tiles import building, tileset
building.BUCKET, tileset.LEVELS_PER_FILE = 3000, 2
source, out, resume = sys.argv[1:]
building.build_tiles(
    stream_gaussians(source), out, building.TileOptions(max_triangles=4096), resume=resume == "resume"
)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_a_killed_run_is_resumed(splats, tileset, tmp_path):
    out = tmp_path / "tiles"
    made = tmp_path / "tiles.partial" / "tileset"
    for wanted, mode in ((4, "new"), (14, "resume")):
        process = subprocess.Popen([sys.executable, "-c", RUN, splats, out, mode])
        while len(list(made.rglob("*.glb"))) < wanted and process.poll() is None:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not out.exists()
        for path in made.rglob("*.glb"):
            if not path.name.startswith("."):
                load_mesh(path)
    subprocess.run([sys.executable, "-c", RUN, splats, out, "resume"], check=True)
    assert digest(out) == digest(tileset)


def test_a_full_disk_is_reported(splats, tmp_path, monkeypatch):
    """While the splats are sorted: a device that is always full."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    path = buckets.Buckets._path
    monkeypatch.setattr(
        buckets.Buckets, "_path", lambda self, key: Path("/dev/full") if key == "00" else path(self, key)
    )
    with pytest.raises(OSError, match="no space left for the splats on their way into tiles") as caught:
        build_tiles(stream_gaussians(splats), tmp_path / "tiles", SMALL)
    assert caught.value.errno == errno.ENOSPC
    assert not (tmp_path / "tiles").exists()


def test_what_a_run_refuses(splats, tileset, tmp_path):
    source = stream_gaussians(splats)
    with pytest.raises(FileNotFoundError, match=r"nothing to resume .* leave out resume"):
        build_tiles(source, tmp_path / "tiles", SMALL, resume=True)
    with pytest.raises(FileNotFoundError, match="replace_old, not resume, replaces"):
        build_tiles(source, tileset, SMALL, resume=True)
    with pytest.raises(FileExistsError, match="exists: give another folder, or replace_old to replace it"):
        build_tiles(source, tileset, SMALL)
    diary = tmp_path / "diary"
    diary.mkdir()
    (diary / "monday.txt").write_text("dear diary")
    with pytest.raises(FileExistsError, match=r"holds no tileset\.json"):
        build_tiles(source, diary, SMALL, replace_old=True)
    (tmp_path / "other.partial").mkdir()
    with pytest.raises(FileExistsError, match="not of this command"):
        build_tiles(source, tmp_path / "other", SMALL, replace_old=True)
    with pytest.raises(FileExistsError, match="not of this command: remove it"):
        build_tiles(source, tmp_path / "other", SMALL)
    with pytest.raises(FileNotFoundError, match=r"nothing to resume .*: remove it"):
        build_tiles(source, tmp_path / "other", SMALL, resume=True)
    for options, message in [
        (TileOptions(max_triangles=10), "max_triangles of a tile must be at least 64"),
        (TileOptions(conversion=ConversionOptions(max_splats=10)), "limits on splats"),
        (TileOptions(conversion=ConversionOptions(footprint="filter")), "for this project's renderer"),
        (
            TileOptions(conversion=ConversionOptions(crop=(90, 90, 90, 91, 91, 91))),
            "none of the 12,000 splats",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            build_tiles(source, tmp_path / "new", options, replace_old=True)


def test_files_of_others_beside_the_tiles_stay(splats, tmp_path, monkeypatch):
    out, page = tmp_path / "site", "<!doctype html>"
    build_tiles(stream_gaussians(splats), out, SMALL)
    ours = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert all(map(is_tile_file, ours))
    below = next(name for name in sorted(ours) if "/" in name and name.endswith(".glb"))
    mine = {"index.html", "js/app.js", below.replace(".glb", ".txt")}
    for name in mine:
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text(page)
    monkeypatch.setattr(building, "BUCKET", 1 << 20)
    coarse = TileOptions(max_triangles=1 << 20)
    assert build_tiles(stream_gaussians(splats), out, coarse, replace_old=True).tiles == 1
    left = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert left == {"tileset.json", "root.glb"} | mine
    assert {(out / name).read_text() for name in mine} == {page}
    assert [path.name for path in tmp_path.iterdir()] == ["site"]


def test_a_tileset_of_another_program_is_not_replaced(splats, tmp_path):
    (tmp_path / "tileset.json").write_text(json.dumps({"asset": {"version": "1.1"}, "geometricError": 1}))
    (tmp_path / "data.b3dm").write_text("b3dm")
    with pytest.raises(FileExistsError, match="a tileset of another program: give another folder"):
        build_tiles(stream_gaussians(splats), tmp_path, SMALL, replace_old=True)
    assert len(list(tmp_path.iterdir())) == 2


def test_what_cannot_begin_leaves_nothing(splats, tmp_path):
    out = tmp_path / "tiles"
    with pytest.raises(ValueError, match="threads must be at least 1"):
        build_tiles(stream_gaussians(splats), out, SMALL, threads=0)
    nowhere = replace(SMALL, conversion=ConversionOptions(crop=(90, 90, 90, 91, 91, 91)))
    with pytest.raises(ValueError, match="crop"):
        build_tiles(stream_gaussians(splats), out, nowhere)
    assert not list(tmp_path.iterdir())


def test_one_is_no_plural():
    one = TilesetSummary(1, 8, 1, 1, 2_000_000, 0.0, AlphaChoice("blend"))
    assert one.in_words() == "1 splat -> 8 triangles in 1 tile of 1 level, 2.0 MB"


def test_another_scene_or_other_options_are_not_mixed(splats, tmp_path, monkeypatch):
    out = tmp_path / "tiles"
    save = making.save_mesh
    monkeypatch.setattr(making, "save_mesh", lambda *a, **o: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        build_tiles(stream_gaussians(splats), out, SMALL)
    monkeypatch.setattr(making, "save_mesh", save)
    with pytest.raises(FileExistsError, match="run: resume continues it, replace_old starts again"):
        build_tiles(stream_gaussians(splats), out, SMALL)
    with pytest.raises(ValueError, match="started with other options"):
        build_tiles(stream_gaussians(splats), out, TileOptions(max_triangles=8192), resume=True)
    other = tmp_path / "other.ply"
    shutil.copy(splats, other)
    with pytest.raises(ValueError, match="started with other files"):
        build_tiles(stream_gaussians(other), out, SMALL, resume=True)
    with pytest.raises(ValueError, match="started with other reading"):
        build_tiles(stream_gaussians(splats, axes="y-up"), out, SMALL, resume=True)
    for more in ({"kernel": "antialiased"}, {"activated": ["scales"]}):
        with pytest.raises(ValueError, match="started with other reading"):
            build_tiles(stream_gaussians(splats, **more), out, SMALL, resume=True)


def test_a_torn_line_of_the_journal_does_not_count(tmp_path):
    path = tmp_path / "journal.jsonl"
    journal = Journal(path)
    journal.add("cell", key="01", splats=5)
    journal.add("cell", key="02", splats=6)
    whole = path.read_bytes()
    for cut in (1, 10, 30):
        path.write_bytes(whole[:-cut])
        again = Journal(path)
        assert again.keys("cell") == {"01"}
        again.add("cell", key="03")
        assert Journal(path).keys("cell") == {"01", "03"}
    for line in (b"nonsense", b"7", b'{"step": 1}', b'{"step": "cell", "key": []}', b"[" * 100_000):
        path.write_bytes(line + b"\n")
        with pytest.raises(FileFormatError, match="not a journal"):
            Journal(path)
    path.write_bytes(b'{"step": "cell"}\n')
    with pytest.raises(FileFormatError, match="'cell' has no key"):
        Journal(path).keys("cell")


@pytest.mark.slow
def test_splats_in_one_spot_are_parted_by_their_order(tmp_path):
    cloud = next(city_blocks(1000, degree=0))
    means = np.zeros((1000, 3))
    means[-1] = 1
    fields = {name: getattr(cloud, name) for name in ("quaternions", "scales", "opacities", "sh")}
    save_gaussian_blocks([type(cloud)(means, **fields)], tmp_path / "spot.ply", 1000)
    build_tiles(stream_gaussians(tmp_path / "spot.ply"), tmp_path / "tiles", SMALL)
    tiles = list(walk(tmp_path / "tiles" / "tileset.json", np.inf))
    rows = np.concatenate([splat_rows(path) for _, tile, path in tiles if not tile.get("children")])
    np.testing.assert_array_equal(np.sort(rows), np.arange(1000))
    assert max(tile["extras"]["triangles"] for _, tile, _ in tiles) <= 4096


# ---- Drawing


@pytest.mark.slow
def test_the_image_is_that_of_the_whole_mesh(splats, tileset):
    found = Tileset(tileset)
    mesh = convert(load_gaussians(splats))
    views = orbit(mesh, 2, elevation=20, width=120, height=90)
    views += orbit(mesh, 1, elevation=10, width=120, height=90, distance=0.3)
    for camera in views:
        whole = render(mesh, camera, samples=2, depth=True)
        fine = render_tiles(found, camera, max_error=0, samples=2, depth=True)
        assert psnr(fine.color, whole.color) > 60
        np.testing.assert_allclose(fine.mean_depth(empty=0), whole.mean_depth(empty=0), rtol=0.02)
        assert psnr(render_tiles(found, camera, samples=2).color, whole.color) > 40
    far = orbit(mesh, 1, elevation=20, width=120, height=90, distance=8)[0]
    tiles, worst = choose_tiles(found, [far])
    assert worst <= 1
    assert sum(tile.triangles for tile in tiles) < 0.3 * len(mesh.faces)
    assert psnr(render_tiles(found, far, samples=4).color, render(mesh, far, samples=4).color) > 40


def test_an_image_in_parts_is_the_same(tileset):
    """With memory for few triangles the image is divided; its background, too."""
    found = Tileset(tileset)
    camera = orbit(found.root.load(), 1, elevation=15, width=200, height=130)[0]
    background = np.random.default_rng(0).random((130, 200, 3)).astype(np.float32)
    options = {"max_error": 0, "background": background, "depth": True, "median_depth": True}
    whole = render_tiles(found, camera, **options)
    most = sum(tile.triangles for tile in choose_tiles(found, [camera], max_error=0)[0]) - 1
    loaded = []
    with pytest.MonkeyPatch.context() as patch:
        import meshsplats.tiles.drawing as drawing

        join = drawing.join_tiles
        patch.setattr(drawing, "join_tiles", lambda t, tiles: loaded.append(tiles) or join(t, tiles))
        parts = render_tiles(found, camera, max_triangles=most, **options)
    assert len(loaded) > 1
    assert max(sum(tile.triangles for tile in tiles) for tiles in loaded) <= most
    assert psnr(parts.color, whole.color) > 80
    np.testing.assert_allclose(parts.depth, whole.depth, atol=1e-3)
    same = np.isclose(parts.median_depth, whole.median_depth, atol=1e-3)
    assert same.mean() > 0.999


def test_the_tiles_that_a_camera_needs(tileset):
    found = Tileset(tileset)
    camera = orbit(found.root.load(), 1, elevation=15, width=200, height=130)[0]
    everything = [tile for tile, _ in found.tiles()]
    for most_error in (0.5, 2.0, 8.0):
        tiles, worst = choose_tiles(found, [camera], max_error=most_error)
        assert worst <= most_error
        assert all(screen_error(camera, tile) <= most_error or not tile.children for tile in tiles)
    for tile in everything:  # a box with a corner in the image is never left out
        if camera.sees(tile.corners()).any():
            assert reaches(camera, tile)
    away = orbit(found.root.load(), 1, elevation=15, width=200, height=130, target=(500, 0, 0))[0]
    assert choose_tiles(found, [away])[0] == []
    assert render_tiles(found, away, samples=1).alpha.max() == 0
    tiles, worst = choose_tiles(found, [camera], max_error=0, most=20_000)
    assert sum(tile.triangles for tile in tiles) <= 20_000
    assert worst > 0
    with pytest.raises(ValueError, match="max_error must be"):
        choose_tiles(found, [camera], max_error=-1)


def test_one_mesh_has_the_tiles_that_several_cameras_need(splats, tileset):
    """Each image is as good as with the tiles of its camera alone; a limit makes it coarser, not larger."""
    found = Tileset(tileset)
    whole = convert(load_gaussians(splats))
    options = {"elevation": 10, "width": 120, "height": 90}
    cameras = [orbit(whole, 1, distance=distance, **options)[0] for distance in (0.3, 4)]
    near, far = (tiles_mesh(found, [camera])[0] for camera in cameras)
    assert len(far.faces) < 0.3 * len(whole.faces)
    both, error = tiles_mesh(found, cameras)
    assert error <= 1
    assert len(near.faces) <= len(both.faces) < len(whole.faces)
    for camera in cameras:
        truth = render(whole, camera, samples=3).color
        assert psnr(render(both, camera, samples=3).color, truth) > 40
    limited, error = tiles_mesh(found, cameras, max_triangles=len(both.faces) // 2)
    assert len(limited.faces) <= len(both.faces) // 2
    assert error > 1
    away = orbit(whole, 1, target=(500, 0, 0), **options)
    with pytest.raises(ValueError, match="none of the cameras sees"):
        tiles_mesh(found, away)


# ---- Files from strangers


def broken(tileset, tmp_path, change):
    shutil.copytree(tileset, tmp_path / "copy")
    path = tmp_path / "copy" / "tileset.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return tmp_path / "copy"


def set_(*keys, value):
    def change(document):
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_("asset", "version", value="1.0"), "of version '1.0'; 1.1 is read"),
        (set_("extras", value={}), "another program"),
        (set_("extras", "meshsplats", "up", value=[0, 0, 0]), "must not be 0"),
        (set_("extras", "meshsplats", "splats", value=-1), "count of splats"),
        (set_("geometricError", value="big"), "geometricError must be"),
        (set_("root", "geometricError", value=1e-9), "below one of"),
        (set_("root", "boundingVolume", value={"sphere": [0, 0, 0, 1]}), "bounding box must be 12"),
        (set_("root", "boundingVolume", "box", value=[1e400] * 12), "bounding box must be 12"),
        (set_("root", "boundingVolume", "box", value=[10**400] * 12), "bounding box must be 12"),
        (set_("root", "transform", value=[1] * 16), "another program has moved it"),
        (set_("root", "refine", value="ADD"), "only explicit tiles"),
        (set_("root", "content", "uri", value="../secret.glb"), "no path below its folder"),
        (set_("root", "content", "uri", value="/etc/passwd"), "no path below its folder"),
        (set_("root", "content", "uri", value="%2e%2e/x.glb"), "no path below its folder"),
        (set_("root", "content", "uri", value="https://x.org/a.glb"), "no path below its folder"),
        (set_("root", "content", "uri", value="root.b3dm"), r"must be \.glb files"),
        (set_("root", "children", value=3), "children of a tile"),
        (set_("root", "extras", "triangles", value=1.5), "count of triangles"),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),  # not the address of a function
)
def test_broken_tilesets_are_refused(tileset, tmp_path, change, message):
    with pytest.raises(FileFormatError, match=message):
        Tileset(broken(tileset, tmp_path, change))


def test_tiles_that_are_not_what_the_tileset_says(tileset, tmp_path):
    copy = broken(tileset, tmp_path, set_("root", "extras", "triangles", value=7))
    with pytest.raises(FileFormatError, match="the tileset says 7"):
        Tileset(copy).root.load()
    (copy / "tileset.json").write_bytes(b"[" * 10)
    with pytest.raises(FileFormatError, match="not a JSON file"):
        Tileset(copy)


def test_a_tileset_inside_itself_ends(tileset, tmp_path):
    def loop(document):
        document["root"]["children"][0] = {
            key: document["root"][key] for key in ("boundingVolume", "geometricError")
        } | {"content": {"uri": "tileset.json"}}

    found = Tileset(broken(tileset, tmp_path, loop))
    for _ in range(2):
        with pytest.raises(
            FileFormatError, match=r"names 'tileset\.json' twice; a tileset file is read once"
        ):
            list(found.tiles())


def test_a_tileset_file_that_was_missing_may_come(tileset, tmp_path):
    def split(document):
        inner = document["root"]["children"][0]
        (tmp_path / "inner.json").write_text(json.dumps(document | {"root": inner}))
        document["root"]["children"][0] = {
            key: inner[key] for key in ("boundingVolume", "geometricError")
        } | {"content": {"uri": "inner.json"}}

    copy = broken(tileset, tmp_path, split)
    found = Tileset(copy)
    with pytest.raises(FileNotFoundError):
        list(found.tiles())
    (tmp_path / "inner.json").rename(copy / "inner.json")
    assert len(list(found.tiles())) == len(list(Tileset(tileset).tiles()))


def test_files_of_a_tileset_share_its_limits(tileset, tmp_path, monkeypatch):
    copy = broken(tileset, tmp_path, lambda document: None)
    levels = max(level for _, level in Tileset(copy).tiles())
    monkeypatch.setattr("meshsplats.formats.gltf.tileset_file.MAX_DEPTH", levels - 2)
    with pytest.raises(FileFormatError, match=f"nested too deeply, or too many: {levels - 2} levels"):
        list(Tileset(copy).tiles())


def test_a_tileset_file_is_read_once(tileset, monkeypatch):
    """However often tiles are chosen: many images must not exhaust the limit on tiles."""
    load = tilesets._load
    read: list[Path] = []
    monkeypatch.setattr(tilesets, "_load", lambda path: read.append(path) or load(path))
    found = Tileset(tileset)
    first = [tile.content for tile, _ in found.tiles()]
    assert len(read) > 1
    count = found._count
    assert [tile.content for tile, _ in found.tiles()] == first
    assert len(read) == len(set(read))
    assert found._count == count


# ---- Commands


@pytest.mark.slow
def test_commands(splats, tileset, tmp_path, capsys):
    out = tmp_path / "tileset"
    assert main(["tiles", str(splats), "-o", str(out), "--max-triangles", "4096", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert digest(out) == digest(tileset)
    assert (result["splats"], result["tileset"]) == (COUNT, str(out / "tileset.json"))
    assert main(["info", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "tileset"
    for key in ("splats", "tiles", "levels", "triangles", "bytes"):
        assert found[key] == result[key]
    assert found["largest_tile"] <= 4096
    size = ["--width", "64", "--height", "48"]
    assert main(["render", str(out), "-o", str(tmp_path / "a.png"), *size, "--max-error", "0"]) == 0
    assert main(["render", str(out), "-o", str(tmp_path / "b.png"), *size, "--depth", "png"]) == 0
    assert main(["render", str(out), "-o", str(tmp_path / "many"), *size, "--orbit", "2"]) == 0
    assert len(list((tmp_path / "many").glob("view_*.png"))) == 2
    assert main(["tiles", str(splats), "-o", str(out)]) == 3
    assert main(["tiles", str(splats), "-o", str(out), "--resume"]) == 1
    assert main(["tiles", str(splats), "-o", str(out), "--resume", "--force"]) == 2
    assert main(["tiles", str(splats), "-o", str(tmp_path / "a.json")]) == 2
    assert main(["render", str(splats), "-o", str(tmp_path / "c.png"), "--max-error", "2"]) == 2
    assert main(["render", str(out), "-o", str(tmp_path / "c.png"), "--crop", *"000111"]) == 2
    assert main(["simplify", str(out), "-o", str(tmp_path / "c.ply"), "--share", "0.5"]) == 1
    assert "a tileset, not splats; render and info take it" in capsys.readouterr().err


def test_the_validator_of_khronos_accepts_the_tiles(tileset, gltf_issues):
    files = sorted(tileset.rglob("*.glb"))
    for file, issues in zip(files, gltf_issues(*files), strict=True):
        assert issues["numErrors"] == issues["numWarnings"] == 0, (file, issues["messages"])
