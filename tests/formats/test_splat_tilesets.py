"""Tilesets of splats: which tiles are read, where they lie, and which files are refused."""

from __future__ import annotations

import json

import _splat_encoders as encode
import numpy as np
import pytest
from _local import linux_names, make_link
from _splat_files import expected_cloud, random_splats
from _splats import refused

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats.gaussians import format_of
from meshsplats.formats.sniff import identify
from meshsplats.operations.inspection import describe
from meshsplats.tiles import is_tileset

BOX = {"boundingVolume": {"box": [0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9]}, "geometricError": 1}
VALUES = [random_splats(4 + i, degree=1, seed=i) for i in range(5)]


def tile(name=None, children=(), **more):
    content = {} if name is None else {"content": {"uri": name}}
    return BOX | content | ({"children": list(children)} if children else {}) | more


def moved(x=0.0, y=0.0, z=0.0):
    return [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1]


def put(folder, root, name="tileset.json", **more):
    """A tileset of ``root`` in ``folder``, and tiles 0.glb to 4.glb of 4 to 8 splats."""
    for i, values in enumerate(VALUES):
        (folder / f"{i}.glb").write_bytes(encode.gltf(encode.splat_accessors(values)))
    document = {"asset": {"version": "1.1"}, "geometricError": 9, "root": {"refine": "REPLACE", **root}}
    (folder / name).write_text(json.dumps(document | more))
    return folder / name


def in_tileset(values):
    """(n, 3) positions in the axes of a tileset: glTF's y is z, its z is -y."""
    x, y, z = expected_cloud(values)["means"].T
    return np.stack([x, -z, y], axis=1)


def at(i, *place):
    """(n, 3) positions of tile ``i`` moved to a place in a tileset."""
    return np.add(in_tileset(VALUES[i]), place)


def same_places(cloud, expected):
    found, wanted = (np.round(p.astype(np.float64), 4) for p in (cloud.means + cloud.origin, expected))
    order = [np.lexsort(p.T) for p in (found, wanted)]
    np.testing.assert_allclose(found[order[0]], wanted[order[1]], atol=2e-4)


def test_the_finest_tiles_are_read_where_they_lie(tmp_path):
    """REPLACE: leaves only. ADD: a tile as well. Transforms apply from the root down."""
    added = tile("1.glb", [tile("2.glb", transform=moved(z=3))], refine="ADD", transform=moved(x=20))
    path = put(tmp_path, tile("0.glb", [added, tile("4.glb")], transform=moved(y=100)))
    expected = np.concatenate(
        [
            at(1, 20, 100, 0),
            at(2, 20, 100, 3),
            at(4, 0, 100, 0),
        ]
    )
    same_places(ms.load_gaussians(path, axes="y-down"), expected)
    whole = ms.load_gaussians(tmp_path)
    same_places(whole, expected @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    np.testing.assert_array_equal(whole.up, [0, -1, 0])
    blocks = list(ms.stream_gaussians(path, block=3))
    np.testing.assert_array_equal(np.concatenate([b.means for b in blocks]), whole.means)
    np.testing.assert_array_equal(ms.stream_gaussians(path).up, [0, -1, 0])


def test_colours_and_shapes_turn_with_the_tiles(tmp_path):
    """As the same glTF file read alone, whose axes are turned in another way."""
    path = put(tmp_path, tile("0.glb"))
    alone, tiled = ms.load_gaussians(tmp_path / "0.glb"), ms.load_gaussians(path)
    # glTF has x to the left; of z up, this project has x to the right: half a turn about the vertical.
    turned = tiled.transformed(np.diag([-1.0, 1, -1]))
    np.testing.assert_allclose(alone.means, turned.means, atol=1e-6)
    np.testing.assert_allclose(alone.sh, turned.sh, atol=1e-5)
    alone_axes, axes = (c.rotations * c.scales[:, None] for c in (alone, turned))
    covariances = axes @ axes.transpose(0, 2, 1)
    np.testing.assert_allclose(alone_axes @ alone_axes.transpose(0, 2, 1), covariances, atol=1e-6)


def test_a_tile_may_be_another_tileset(tmp_path):
    (tmp_path / "in").mkdir()
    put(tmp_path / "in", tile("3.glb", transform=moved(x=1)), "sub.json")
    path = put(tmp_path, tile(None, [tile("in/sub.json", transform=moved(y=2)), tile("./2.glb")]))
    expected = np.concatenate([at(3, 1, 2, 0), at(2, 0, 0, 0)])
    same_places(ms.load_gaussians(path, axes="y-down"), expected)


def test_several_contents_and_tiles_without_any(tmp_path):
    """A tile of which nothing below has content is the finest one there."""
    root = tile(None, [tile(None, [tile()], contents=[{"uri": "0.glb"}, {"uri": "1.glb"}])])
    assert len(ms.load_gaussians(put(tmp_path, root))) == 9


def test_a_tileset_on_the_globe_keeps_its_detail(tmp_path):
    """Metres from the centre of the Earth: an origin, and up away from the ground."""
    latitude = np.radians(40)
    place = 6.37e6 * np.array([np.cos(latitude), 0, np.sin(latitude)])
    path = put(tmp_path, tile("0.glb", transform=moved(*place)))
    cloud = ms.load_gaussians(path, axes="y-down")
    assert np.linalg.norm(cloud.origin - place) < 10
    same_places(cloud, at(0, *place))
    geodetic = np.arctan(1.0067394967 * np.tan(latitude))
    np.testing.assert_allclose(cloud.up, [np.cos(geodetic), 0, np.sin(geodetic)], atol=1e-6)
    region = {"boundingVolume": {"region": [-0.1, 0.4, 0.1, 0.6, 0, 9]}}
    up = ms.load_gaussians(put(tmp_path, tile("0.glb") | region), axes="y-down").up
    np.testing.assert_allclose(up, [np.cos(0.5), 0, np.sin(0.5)], atol=1e-6)


@pytest.mark.parametrize("ratified", [True, False])
def test_spz_of_drafts_is_in_the_axes_of_gltf(tmp_path, ratified):
    """KHR_gaussian_splatting requires a kernel and a colour space; drafts, as CesiumJS reads them, have none
    and no axes of their own. What has them holds SPZ as other SPZ files."""
    content = encode.gltf(spz_data=encode.spz(VALUES[0]))
    if not ratified:
        for key, value in (("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")):
            old = f'"{key}": "{value}", '.encode()
            assert old in content
            content = content.replace(old, b" " * len(old))
    path = put(tmp_path, tile("0.glb"))
    (tmp_path / "0.glb").write_bytes(content)
    expected = in_tileset(VALUES[0]) * ([-1, -1, 1] if ratified else [1, 1, 1])  # x and z of glTF
    cloud = ms.load_gaussians(path, axes="y-down")
    found, wanted = np.sort(cloud.means, axis=0), np.sort(expected, axis=0)
    np.testing.assert_allclose(found, wanted, atol=1e-3)


def test_tiles_without_splats_are_told(tmp_path):
    mesh = ms.SplatMesh(np.eye(3), [[0, 1, 2]], np.full((3, 4), 0.5))
    path = put(tmp_path, tile(None, [tile("0.glb"), tile("mesh.glb")]))
    ms.save_mesh(mesh, tmp_path / "mesh.glb")
    with pytest.warns(DataWarning, match="1 of 2 tiles have no splats"):
        assert len(ms.load_gaussians(path)) == 4
    only = put(tmp_path, tile("mesh.glb"), "only.json")
    with pytest.raises(FileFormatError, match="a tileset without splats"):
        ms.load_gaussians(only)
    assert identify(only) == "mesh"


def test_commands_tell_tilesets_of_splats_from_those_of_meshes(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    path = put(folder, tile("0.glb"))
    assert not is_tileset(path)
    assert not is_tileset(folder)
    assert format_of(folder) == "3d tiles"
    found = describe(folder)
    assert (found["kind"], found["format"], found["splats"]) == ("splats", "3d tiles", 4)
    assert main(["convert", str(folder), "-o", str(tmp_path / "a.npz"), "--no-sidecar"]) == 0
    made = tmp_path / "made"
    assert main(["tiles", str(folder), "-o", str(made)]) == 0
    assert is_tileset(made)
    assert describe(made)["kind"] == "tileset"
    with pytest.raises(FileFormatError, match="a tileset, not splats; render and info take it"):
        ms.load_gaussians(made)


DEEP = tile("0.glb")
for _ in range(70):
    DEEP = tile(None, [DEEP])


@pytest.mark.parametrize(
    ("root", "message"),
    [
        (tile("../0.glb"), "no path below its folder"),
        (tile("https://example.com/0.glb"), "no path below its folder"),
        (tile("%2e%2e/0.glb"), "no path below its folder"),
        (tile("/etc/passwd"), "no path below its folder"),
        pytest.param(tile("\ud800.glb"), "no path below its folder", marks=linux_names),
        pytest.param(tile("\u00e9" * 200 + ".glb"), "no path below its folder", marks=linux_names),
        (tile("9.glb"), "'9.glb' that it names is missing"),
        (tile(None, [tile("0.glb"), tile("0.glb")]), "names '0.glb' twice"),
        (tile("tileset.json"), "names 'tileset.json' twice"),
        (DEEP, "nested too deeply, or too many: 64 levels"),
        (tile("0.glb", refine="SUBTRACT"), "refine must be ADD or REPLACE, got 'SUBTRACT'"),
        (tile("0.glb", implicitTiling={}), "implicit tiling is not read"),
        (tile("0.glb", transform=[1, 2]), "a transform must be 16 numbers"),
        (tile("0.glb", transform=[True] * 16), "a transform must be 16 numbers"),
        (tile("0.glb", transform=[1e40] * 16), "a transform must be 16 numbers"),
        (tile("0.glb", transform=[1.0] * 16), "a transform must end in 0 0 0 1"),
        (tile("0.glb", transform=[0] * 15 + [1]), "flattens space"),
        (tile("0.glb", children=[3]), "children of a tile must be a list of objects"),
        (tile("0.glb") | {"content": 3}, "'content' must be an object"),
        (tile("0.glb") | {"content": {"uri": 3}}, "'uri' must be a text"),
        (tile("0.glb") | {"boundingVolume": {}}, "a box must be 12 numbers"),
        (tile("old.b3dm"), "the tile 'old.b3dm' is of the kind b3dm"),
        (tile(), "a tileset without splats"),
    ],
)
def test_broken_tilesets_are_refused(tmp_path, root, message):
    (tmp_path / "old.b3dm").write_bytes(b"b3dm" + bytes(24))
    refused(put(tmp_path, root), message, 96 << 20)


def test_other_versions_are_refused(tmp_path):
    refused(put(tmp_path, tile("0.glb"), asset={"version": "2.0"}), "3D Tiles of version '2.0'", 96 << 20)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ([[10**400] * 3] * 3, "a row of the axes must be 3 numbers"),
        ([[1, 0], [0, 1]], "a row of the axes must be 3 numbers"),
        ([[1, 0, 0]] * 3, "the axes must be a rotation"),
        ([], "the axes must be a rotation"),
        (3, "the axes must be a rotation"),
    ],
)
def test_axes_that_are_none(tmp_path, axes, message):
    note = {"contents": "splats", "up": [0, 0, 1], "axes": axes}
    refused(put(tmp_path, tile("0.glb"), extras={"meshsplats": note}), message, 96 << 20)


def test_tiles_may_be_links_to_one_file(tmp_path):
    """Caches of downloads keep files that are alike once."""
    path = put(tmp_path, tile(None, [tile("0.glb"), tile("copy.glb", transform=moved(5))]))
    make_link(tmp_path / "copy.glb", tmp_path / "0.glb")
    same_places(ms.load_gaussians(path, axes="y-down"), np.concatenate([at(0, 0, 0, 0), at(0, 5, 0, 0)]))


def test_links_make_no_other_tiles(tmp_path):
    make_link(tmp_path / "again", tmp_path)
    refused(put(tmp_path, tile("again/tileset.json")), "names 'tileset.json' twice", 96 << 20)
