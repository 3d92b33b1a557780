"""Tilesets of splats: taken apart by a reader of their own, and read back as splats."""

from __future__ import annotations

import json
import struct
import subprocess
import zlib
from dataclasses import replace

import numpy as np
import pytest
from _cities import digest

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.merging import merge
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.tiles import building, is_tileset, making
from meshsplats.tiles.building import build_tiles
from meshsplats.tiles.options import TileOptions
from meshsplats.tiles.tileset import Tileset

UP = np.array([0.6, 0.0, 0.8])
ORIGIN = [500_000.0, 4_500_000.0, 120.0]
CROP = tuple(x + d for d in (-2, 2) for x in ORIGIN)
OPTIONS = TileOptions(max_triangles=400, as_splats=True)


def splats(count=900, degree=2, seed=0):
    """Small splats far from each other, none of them faint."""
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return ms.GaussianCloud(
        means=rng.uniform(-4, 4, (count, 3)).astype(np.float32),
        quaternions=quaternions.astype(np.float32),
        scales=rng.uniform(0.02, 0.1, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.3, 0.9, count).astype(np.float32),
        sh=rng.uniform(-0.8, 0.8, size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        up=UP,
        origin=np.array(ORIGIN),
    )


@pytest.fixture(scope="module")
def cloud():
    return splats()


@pytest.fixture(scope="module")
def tileset(cloud, tmp_path_factory):
    folder = tmp_path_factory.mktemp("splat_tiles")
    ms.save_gaussians(cloud, folder / "a.ply")
    build_tiles(ms.stream_gaussians(folder / "a.ply"), folder / "tiles", OPTIONS)
    return folder / "tiles"


def nearest(cloud, to):
    """Of each splat of ``to``, the row in ``cloud`` of the nearest centre in the world."""
    offset = cloud.origin - to.origin
    away = (cloud.means[None] + offset) - to.means[:, None]
    return np.square(away).sum(axis=2).argmin(axis=1)


def covariances(cloud):
    axes = cloud.rotations.astype(np.float64) * cloud.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def glb(path):
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def positions(path):
    """Centres in the frame of the tileset, unpacked by hand: 24 bits of SPZ in the axes of the glTF file,
    which the matrix of the node and then the turn from y up to z up move."""
    document, binary = glb(path)
    extension = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    view = document["bufferViews"][
        extension["extensions"]["KHR_gaussian_splatting_compression_spz_2"]["bufferView"]
    ]
    start = view["byteOffset"]
    spz = zlib.decompress(binary[start : start + view["byteLength"]], 31)
    magic, version, count, _, bits = struct.unpack_from("<4sIIBB", spz)
    assert (magic, version) == (b"NGSP", 3)
    numbers = np.frombuffer(spz, np.uint8, 9 * count, 16).astype(np.int64).reshape(-1, 3)
    fixed = numbers @ [1, 256, 65536]
    points = (fixed - (fixed >= 1 << 23) * (1 << 24)).reshape(-1, 3) / 2.0**bits
    matrix = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    x, y, z = (points @ matrix[:3, :3].T + matrix[:3, 3]).T
    return np.stack([x, -z, y], axis=1), 2.0**-bits


def tiles_of(file):
    """Every tile of a tileset file and of those inside: its entry and the path of its content."""
    document = json.loads(file.read_text())
    todo = [document["root"]]
    while todo:
        tile = todo.pop()
        content = file.parent / tile["content"]["uri"]
        if content.suffix == ".json":
            yield from tiles_of(content)
            continue
        yield tile, content
        todo += tile.get("children", [])


def test_the_finest_tiles_are_the_splats_in_their_world(cloud, tileset):
    back = ms.load_gaussians(tileset)
    assert len(back) == len(cloud)
    np.testing.assert_allclose(back.up, UP, atol=1e-12)
    rows = nearest(cloud, back)
    assert len(set(rows)) == len(rows)
    mine = cloud.take(rows)
    step = max(positions(content)[1] for tile, content in tiles_of(tileset / "tileset.json"))
    # Half a step along each axis of the tile, turned, and float32 around the origin that is chosen anew.
    np.testing.assert_allclose(back.means + back.origin - mine.origin, mine.means, atol=step * 0.87 + 1e-6)
    np.testing.assert_allclose(back.opacities, mine.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(back.sh[:, 0], mine.sh[:, 0], atol=0.51 / 255 / 0.15)
    # SPZ keeps 5 bits of degree 1 and 4 bits of others; they are turned by the frame of the tileset.
    assert np.abs(back.sh[:, 1:] - mine.sh[:, 1:]).max() < 0.15
    np.testing.assert_allclose(covariances(back), covariances(mine), atol=0.15 * 0.1**2)
    stream = ms.stream_gaussians(tileset, block=300)
    np.testing.assert_allclose(stream.up, UP, atol=1e-12)
    found = np.concatenate([block.means + block.origin for block in stream])
    np.testing.assert_allclose(found, back.means + back.origin, atol=1e-6)


def test_boxes_hold_the_splats_below_and_errors_grow_upwards(tileset):
    root = json.loads((tileset / "tileset.json").read_text())
    pending = [(root["root"], np.inf)]
    count = 0
    while pending:
        tile, error = pending.pop()
        points, _ = positions(tileset / tile["content"]["uri"])
        assert len(points) == tile["extras"]["splats"] <= OPTIONS.max_triangles // 2
        box = tile["boundingVolume"]["box"]
        reach = np.diag(np.reshape(box[3:], (3, 3)))
        assert (np.abs(points - box[:3]) < reach - 0.02).all()  # with some of their size
        assert tile["geometricError"] <= error
        children = tile.get("children", [])
        assert (tile["geometricError"] > 0) == bool(children)
        pending += [(child, tile["geometricError"]) for child in children]
        count += 1
    assert count > 5


def test_files_say_what_viewers_choose_by(tileset):
    """CesiumJS tells a tileset of splats by the extensions of tileset.json, and reads matrices only."""
    names = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    document = json.loads((tileset / "tileset.json").read_text())
    assert document["extensionsUsed"] == ["3DTILES_content_gltf"]
    assert document["extensions"]["3DTILES_content_gltf"]["extensionsRequired"] == names
    content, _ = glb(tileset / "root.glb")
    assert content["extensionsRequired"] == names == content["extensionsUsed"]
    (primitive,) = content["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert set(primitive["extensions"]["KHR_gaussian_splatting"]) == {"extensions"}
    harmonics = [name for name in primitive["attributes"] if "SH_DEGREE" in name]
    assert len(harmonics) == 8
    assert {accessor["count"] for accessor in content["accessors"]} == {document["root"]["extras"]["splats"]}
    assert set(content["nodes"][0]) == {"mesh", "matrix"}


def test_the_same_bits_with_any_number_of_threads_and_after_an_interruption(
    tileset, cloud, tmp_path, monkeypatch
):
    ms.save_gaussians(cloud, tmp_path / "a.ply")
    source = ms.stream_gaussians(tmp_path / "a.ply")

    def stopped(*_args, **_more):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(building, "write_tilesets", stopped)
        with pytest.raises(KeyboardInterrupt):
            build_tiles(source, tmp_path / "tiles", OPTIONS, threads=1)
    summary = build_tiles(source, tmp_path / "tiles", OPTIONS, resume=True, threads=2)
    assert digest(tmp_path / "tiles") == digest(tileset)
    assert (summary.splats, summary.triangles, summary.alpha) == (len(cloud), 0, None)


def test_a_kernel_that_spz_does_not_know_is_said_once(cloud, tmp_path):
    flat = replace(cloud, kernel="2dgs", scales=cloud.scales * np.array([1, 1, 0], np.float32))
    ms.save_gaussians(flat, tmp_path / "a.ply")
    with pytest.warns(DataWarning, match="SPZ leaves out the kernel '2dgs'") as found:
        build_tiles(ms.stream_gaussians(tmp_path / "a.ply"), tmp_path / "tiles", OPTIONS)
    assert len(found) == 1


@pytest.mark.filterwarnings("ignore:.*SPZ leaves out the kernel")
@pytest.mark.parametrize(("kernel", "variance"), [("3dgs", 0.3), ("2dgs", 0.5)])
def test_merging_widens_splats_as_their_kernel_does(cloud, tmp_path, monkeypatch, kernel, variance):
    """By pixels as large as the error of the finer tiles."""
    flat = replace(cloud, kernel=kernel, scales=cloud.scales * np.array([1, 1, 0], np.float32))
    ms.save_gaussians(flat, tmp_path / "a.ply")
    widths = []

    def watched(cloud, count, low_pass, threads):
        widths.append(low_pass)
        return merge(cloud, count, low_pass, threads)

    monkeypatch.setattr(making, "merge", watched)
    options = replace(OPTIONS, max_triangles=60)
    build_tiles(ms.stream_gaussians(tmp_path / "a.ply"), tmp_path / "tiles", options, threads=1)
    root = json.loads((tmp_path / "tiles/tileset.json").read_text())["root"]
    finest = max(child["geometricError"] for child in root["children"])
    assert finest > 0
    np.testing.assert_allclose(widths[-1], np.sqrt(variance) * finest, rtol=1e-6)


def test_harmonics_are_kept_as_asked(cloud, tmp_path):
    ms.save_gaussians(cloud, tmp_path / "a.ply")
    source = ms.stream_gaussians(tmp_path / "a.ply")
    for changes, degree in (({"colors": "base"}, 0), ({"color_degree": 1}, 1), ({"crop": CROP}, 2)):
        folder = tmp_path / str(degree)
        options = replace(OPTIONS, conversion=ConversionOptions(**changes))
        build_tiles(source, folder, options)
        back = ms.load_gaussians(folder)
        assert back.sh_degree == degree
        inside = (np.abs(cloud.means) <= 2).all(axis=1).sum() if "crop" in changes else len(cloud)
        assert len(back) == inside


@pytest.mark.parametrize(
    "changes",
    [{"lit": True}, {"alpha": "mask"}, {"preset": "paper"}, {"conversion": ConversionOptions(look="splats")}],
)
def test_options_of_meshes_are_refused(changes):
    name = "look" if "conversion" in changes else next(iter(changes))
    with pytest.raises(ValueError, match=f"{name}: of meshes; tiles of splats have only crop"):
        replace(OPTIONS, **changes).resolved()


def test_commands_take_it_as_splats(cloud, tileset, tmp_path, capsys):
    ms.save_gaussians(cloud, tmp_path / "a.ply")
    out = tmp_path / "tiles"
    words = ["tiles", str(tmp_path / "a.ply"), "-o", str(out), "--as-splats", "--max-triangles", "400"]
    assert main([*words, "--lit"]) == 1
    assert main(words) == 0
    assert "900 splats in " in capsys.readouterr().out
    assert digest(out) == digest(tileset)
    assert not is_tileset(out)
    assert main(["info", str(out)]) == 0
    assert "900" in capsys.readouterr().out
    assert main(["convert", str(out), "-o", str(tmp_path / "b.spz"), "--as-splats"]) == 0
    with pytest.raises(FileFormatError, match="a tileset of splats, not of meshes"):
        Tileset(out)


@pytest.mark.parametrize("up", [None, [0, 0, 0], [1, 2], "y"])
def test_a_broken_note_is_refused(tileset, tmp_path, up):
    document = json.loads((tileset / "tileset.json").read_text())
    document["extras"]["meshsplats"]["up"] = up
    (tmp_path / "tileset.json").write_text(json.dumps(document))
    with pytest.raises(FileFormatError, match="the up direction must"):
        ms.load_gaussians(tmp_path)


def test_the_validator_of_khronos_finds_nothing_but_the_names_of_the_extension(tileset, node_package):
    folder = node_package("gltf-validator")
    script = (
        "const v = require('gltf-validator'), fs = require('fs');"
        "v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))"
        ".then(r => console.log(JSON.stringify(r.issues)))"
    )
    words = ["node", "-e", script, str(tileset / "root.glb")]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True, timeout=120)
    # Its release of 2024 knows neither extension, nor names of attributes, nor that SPZ is in the buffer.
    messages = json.loads(done.stdout)["messages"]
    known = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNUSED_OBJECT"}
    assert [m for m in messages if m["code"] not in known] == []
    unused = [m["pointer"] for m in messages if m["code"] == "UNUSED_OBJECT"]
    assert unused in ([], ["/bufferViews/0"])


@pytest.mark.parametrize("as_splats", [True, False])
def test_tiles_of_a_globe_are_at_their_place_on_it(tmp_path, as_splats):
    """Splats of Munich, in the axes of the globe, as the first tileset says and the second one, too."""
    longitude, latitude = np.radians([11.5, 48.2])
    up = np.array(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    )
    east = np.array([-np.sin(longitude), np.cos(longitude), 0])
    place = np.stack([east, np.cross(up, east), up], axis=1)
    radius = 6378137.0 / np.sqrt(1 - 0.00669437999 * np.sin(latitude) ** 2)
    ecef = radius * up * [1, 1, 1 - 0.00669437999]
    local = replace(splats(60), up=np.array([0.0, 0, 1]), origin=np.zeros(3))
    ms.save_gaussians(local, tmp_path / "a.ply")
    build_tiles(ms.stream_gaussians(tmp_path / "a.ply"), tmp_path / "first", replace(OPTIONS, up=(0, 0, 1)))
    table = tmp_path / "first" / "tileset.json"
    document = json.loads(table.read_text())
    del document["extras"]  # of another program
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([place, ecef])
    document["root"]["transform"] = matrix.T.ravel().tolist()
    table.write_text(json.dumps(document))

    source = ms.stream_gaussians(table)
    build_tiles(source, tmp_path / "second", TileOptions(max_triangles=400, as_splats=as_splats))
    root = json.loads((tmp_path / "second" / "tileset.json").read_text())["root"]
    found = np.array(root["transform"]).reshape(4, 4).T
    center = found @ [*root["boundingVolume"]["box"][:3], 1]
    middle = place @ ((local.means.min(axis=0) + local.means.max(axis=0)) / 2) + ecef
    np.testing.assert_allclose(center[:3], middle, atol=0.5)
    np.testing.assert_allclose(found[:3, 2], up, atol=1e-9)
    if as_splats:
        again, before = ms.load_gaussians(tmp_path / "second"), ms.load_gaussians(table)
        rows = nearest(before, again)
        assert len(set(rows)) == len(rows) == len(before)
        offset = again.origin - before.origin
        np.testing.assert_allclose(again.means + offset, before.means[rows], atol=0.01)
        np.testing.assert_allclose(again.up, before.up, atol=1e-9)
    else:
        tileset = Tileset(tmp_path / "second")
        np.testing.assert_allclose(tileset.origin, source.origin)
