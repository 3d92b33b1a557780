"""Coordinates that are wider than float32: an origin is taken off by every reader, and given back by every
writer."""

from __future__ import annotations

import json
import struct
import warnings
import zipfile
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from _glb import read_glb, write_glb
from _gltf_meshes import TRIANGLE
from _gltf_meshes import gltf as mesh_gltf
from _local import shared_data
from _meshes import assert_same, random_mesh
from _splat_encoders import compressed_ply, dot_splat, splat_accessors, spz, streamed_sog
from _splat_encoders import gltf as splat_gltf
from _splat_files import random_splats, splat_table, write_ply

from meshsplats import (
    DataWarning,
    GaussianCloud,
    SplatMesh,
    convert,
    load_base,
    load_gaussians,
    load_mesh,
    orbit,
    render,
    save_gaussians,
    save_mesh,
    stream_gaussians,
)
from meshsplats.cameras.framing import default_up
from meshsplats.errors import FileFormatError, OptionsError
from meshsplats.evaluation.metrics import psnr
from meshsplats.formats._orientation import up_quaternion
from meshsplats.formats.gaussians import save_gaussian_blocks
from meshsplats.formats.gltf.scene import rotation_matrix
from meshsplats.formats.meshes import save_mesh_blocks
from meshsplats.formats.outputs import placed
from meshsplats.formats.tensors import gaussians_from_tensors
from meshsplats.scene.origin import choose_origin, in_words, need_detail
from meshsplats.tiles.building import build_tiles
from meshsplats.tiles.options import TileOptions

FAR = np.array([500_000.0, 4_500_000.0, 100.0])
"""A place in a UTM zone."""
DOUBLES = dict.fromkeys("xyz", "double")


def splats(n=300, seed=0, at=FAR):
    """Stored values of ``n`` splats around ``at``, positions as float64; and their positions around 0."""
    values = random_splats(n, degree=1, seed=seed)
    near = np.stack([values[k].astype(np.float64) for k in "xyz"], axis=1)
    for i, k in enumerate("xyz"):
        values[k] = near[:, i] + at[i]
    return values, near


def places(record):
    """(n, 3) float64 in the world."""
    return record.origin + (record.means if isinstance(record, GaussianCloud) else record.vertices)


def turn_x(points):
    return points * [1, -1, -1]


# -- which origin


@pytest.mark.parametrize("scale", [1e-4, 1.0, 50.0])
def test_scenes_near_zero_have_none(scale):
    points = scale * np.random.default_rng(0).normal(size=(500, 3))
    assert not choose_origin(points).any()
    assert not choose_origin(points + 100 * scale).any()
    far = points + 1e5 * scale
    found = choose_origin(far)
    assert found.any()
    assert np.abs(far - found).max() < 10 * scale


def test_the_distance_in_extents_decides():
    """A city of 20 km in a UTM zone, where a step of float32 is half a metre, has one."""
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    extent = 1.8
    assert not choose_origin(points + np.array([60 * extent, 0, 0])).any()
    assert choose_origin(points + np.array([66 * extent, 0, 0])).any()
    assert choose_origin(10_000 * points + FAR).any()


@pytest.mark.parametrize(
    "middle", [(530_000, 180_000, 20), (5_000, 431_000, 100), (4_206_000, 169_000, 4_776_000)]
)
def test_wide_surveys_have_one(middle):
    """A town of 10 km and a corridor of 100 km, where float32 has steps of centimetres and more."""
    rng = np.random.default_rng(0)
    for size in ([5_000, 5_000, 50], [50_000, 500, 50]):
        points = size * rng.uniform(-1, 1, (2000, 3))
        assert choose_origin(points + middle).any()
        assert not choose_origin(points).any()
        assert not choose_origin(points + 9_000).any()  # nearer than a survey is


@pytest.mark.parametrize("size", [0.3, 0.7])
def test_splats_that_are_smaller_than_the_steps_of_their_file_are_named(tmp_path, size):
    """20 km of splats in a UTM zone, where float32 has steps of 0.5 m: enough across them, not for each."""
    values, _ = splats()
    rng = np.random.default_rng(5)
    for axis, middle in zip("xyz", FAR, strict=True):
        values[axis] = middle + rng.uniform(-10_000, 10_000, 300) * (axis != "z")
        values[f"scale_{'xyz'.index(axis)}"] = np.full(300, np.log(size))
    for name, types, said in (("single.ply", {}, size < 0.5), ("double.ply", DOUBLES, False)):
        path = write_ply(tmp_path / name, [splat_table(values, types)])
        for read in (load_gaussians, lambda path: list(stream_gaussians(path, block=64))):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                read(path)
            text = "in steps of 0.5, of what is 0.3 large: precision is lost"
            assert sum(text in str(each.message) for each in caught) == said
    placed(load_gaussians(tmp_path / "double.ply"), FAR)
    with pytest.warns(DataWarning, match="in steps of 0.5") if size < 0.5 else nullcontext():
        placed(load_gaussians(tmp_path / "double.ply"), (0, 0, 0))


def test_points_near_zero_have_lost_nothing(tmp_path):
    """Splats of programs that give points no size: no origin would be of use."""
    values, _ = splats(at=(0, 0, 0))
    for axis in "xyz":
        values[f"scale_{'xyz'.index(axis)}"] = np.full(300, -20.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values, {})]))


def test_up_is_away_from_the_ground_for_coordinates_from_the_middle_of_the_earth():
    """48.79 north, 2.3 east by the formulas of WGS 84, and a place in a UTM zone that is as far from zero."""
    north, east, height = np.radians(48.79), np.radians(2.3), 120.0
    normal = np.array([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)])
    squared = 0.00669437999014
    bend = 6_378_137 / np.sqrt(1 - squared * np.sin(north) ** 2)
    place = (bend + height) * normal - [0, 0, squared * bend * np.sin(north)]
    np.testing.assert_allclose(default_up(np.round(place)), normal, atol=1e-6)
    assert default_up(np.array([500_000, 6_350_000, 120])).tolist() == [0, 0, 1]
    for survey in ([500_000, -120, 6_350_000], [770_000, 120, -6_280_000]):  # turned to y up, or y down
        assert default_up(np.array(survey)).tolist() == [0, -1, 0]
    assert default_up(2 * place).tolist() == [0, -1, 0]


def test_an_extent_below_the_rounding_of_doubles_is_none():
    """Found by the fuzzer: the unit of the origin was 0."""
    points = np.array([[0, 0, 1.0], [0, 0, 1.0], [5e-324, 0, 1.0], [1e-310, 0, 1.0]])
    assert not choose_origin(points).any()
    assert choose_origin(np.array([[1e9, 0, 0], [1e9 + 1e-5, 0, 0]])).any()


def test_positions_beyond_float32_have_none():
    """Differences of the largest doubles overflow; found by the fuzzer, in a data set's camera."""
    assert not choose_origin(np.array([[0, 0, 1.7e308], [0, 0, -1.7e308], [np.nan, 0, 0]])).any()
    assert choose_origin(np.array([[5e6, 0, 0], [5e6, 1, 0], [0, 0, 1.7e308]])).any()


def test_an_origin_is_short_and_exact():
    points = np.random.default_rng(1).normal(size=(500, 3)) + np.array([500_123.4, 4_512_345.6, 87.3])
    found = choose_origin(points)
    assert in_words(found) == "500123 4512346 87"
    assert in_words(choose_origin(300 * points)) == "150037000 1353704000 26000"
    small = choose_origin(points * 2.0**-20)
    np.testing.assert_array_equal([float(word) for word in in_words(small).split()], small)
    assert (small == small.astype(np.float32)).all()


def test_outliers_do_not_decide():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(1000, 3))
    strays = points.copy()
    strays[:40] = 1e8 * rng.normal(size=(40, 3))
    assert not choose_origin(strays).any()
    np.testing.assert_array_equal(choose_origin(strays + FAR), choose_origin(points + FAR))
    strays[:40] = np.inf
    np.testing.assert_array_equal(choose_origin(strays + FAR), choose_origin(points + FAR))
    assert not choose_origin(np.full((5, 3), 7.0)).any()
    assert not choose_origin(np.empty((0, 3))).any()


# -- records


def test_joined_clouds_have_one_origin(tmp_path):
    values, near = splats()
    far = load_gaussians(write_ply(tmp_path / "far.ply", [splat_table(values, DOUBLES)]))
    other = far.relative_to(far.origin + np.array([3, 0, -2]))
    assert (other.origin != far.origin).any()
    both = GaussianCloud.joined([replace(far.take(np.arange(0)), origin=np.zeros(3)), far, other])
    np.testing.assert_array_equal(both.origin, far.origin)
    np.testing.assert_allclose(places(both), np.tile(near + FAR, (2, 1)), atol=1e-6)
    assert "origin 500000 4500000 100" in repr(far)
    with pytest.warns(DataWarning, match="means near 500000 4500000 1.. are stored as float32"):
        assert "origin" not in repr(far.relative_to([0, 0, 0]))


@pytest.mark.parametrize("bad", [[0, 0], [0, 0, np.nan], "here"])
def test_an_origin_is_three_finite_numbers(bad):
    with pytest.raises((ValueError, TypeError), match="origin"):
        SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 4)), origin=bad)


def test_a_base_moves_with_its_splats():
    from _priors import cube

    from meshsplats import bind

    prior = bind(replace(cube(), origin=FAR), layers=1)
    np.testing.assert_array_equal(prior.mesh.origin, FAR)
    moved = prior.mesh.relative_to(FAR - [1, 2, 3])
    assert moved.binding is not None
    np.testing.assert_allclose(moved.binding.positions(), moved.vertices, atol=1e-6)
    np.testing.assert_allclose(places(moved), places(prior.mesh), atol=1e-6)


# -- splats


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("types", [DOUBLES, None])
def test_ply(tmp_path, encoding, types):
    """Doubles: as near zero. Floats: what they hold, relative to the same origin, and a word about it."""
    values, near = splats()
    if types is None and encoding != "ascii":
        stored = np.stack([values[k].astype(np.float32) for k in "xyz"], axis=1) - FAR
    else:
        stored = near
    if types is not None and encoding != "ascii":
        types = dict.fromkeys(values, "double")  # all columns of one type take another path
    path = write_ply(tmp_path / "a.ply", [splat_table(values, types)], encoding)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cloud = load_gaussians(path)
    lost = types is None and encoding != "ascii"
    told = [str(w.message).partition(": ")[2].partition(" are")[0] for w in caught]
    assert told == (["positions near 500000 4500000 100"] if lost else [])
    np.testing.assert_array_equal(cloud.origin, FAR)
    np.testing.assert_allclose(cloud.means, stored, atol=0 if lost else 1e-9)  # floats: no bit is lost
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        blocks = list(stream_gaussians(path, block=64))
    np.testing.assert_array_equal(np.concatenate([b.means for b in blocks]), cloud.means)
    assert all((b.origin == FAR).all() for b in blocks)
    there = FAR + np.array([5, 0, 0])
    np.testing.assert_allclose(load_gaussians(path, origin=there).means, stored - [5, 0, 0], atol=1e-6)


def test_a_real_scene_in_a_zone(tmp_path):
    """As doubles there: the same splats, and the same picture."""
    source = shared_data("splats/playbot_lod6_2k_sh2.ply")
    head, _, data = source.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    rows = np.frombuffer(data, [(name, "<f4") for name in names])
    wide = np.empty(len(rows), [(name, "<f8" if name in "xyz" else "<f4") for name in names])
    for name in names:
        wide[name] = rows[name]
    for i, name in enumerate("xyz"):
        wide[name] += FAR[i]
        head = head.replace(f"float {name}\n".encode(), f"double {name}\n".encode())
    (tmp_path / "far.ply").write_bytes(head + b"end_header\n" + wide.tobytes())
    one, other = load_gaussians(source), load_gaussians(tmp_path / "far.ply")
    assert not one.origin.any()
    np.testing.assert_allclose(places(other) - FAR, one.means, atol=1e-6)
    np.testing.assert_array_equal(other.sh, one.sh)
    views = [orbit(cloud, 1, up=(0, -1, 0), width=80, height=80)[0] for cloud in (one, other)]
    images = [render(convert(cloud), view).color for cloud, view in zip((one, other), views, strict=True)]
    assert psnr(*images) > 50


def test_the_case_of_the_field(tmp_path):
    """Of 400 splats around (500000, 4500000, 0), all have places of their own."""
    values, near = splats(400, at=np.array([500_000, 4_500_000, 0.0]))
    cloud = load_gaussians(write_ply(tmp_path / "utm.ply", [splat_table(values, DOUBLES)]))
    assert len(np.unique(cloud.means[:, 1])) == 400
    np.testing.assert_allclose(cloud.means, near, atol=1e-9)


def test_sog_and_streams_of_it(tmp_path):
    """16 bits between the least and the greatest logarithm, which are doubles."""
    values, near = splats()
    others, there = splats(200, seed=5)
    files = streamed_sog({"a": values, "b": others}, [{0: ("a", 0, 300)}, {0: ("b", 0, 200)}])
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    cloud = load_gaussians(tmp_path / "a" / "meta.json")
    np.testing.assert_array_equal(cloud.origin, FAR)
    np.testing.assert_allclose(cloud.means, near, atol=2e-4)
    both = load_gaussians(tmp_path)
    np.testing.assert_allclose(places(both), FAR + np.concatenate([near, there]), atol=2e-4)
    assert both.origin.any()
    blocks = list(stream_gaussians(tmp_path, block=64))
    np.testing.assert_array_equal(np.concatenate([b.means for b in blocks]), both.means)


def test_spz(tmp_path):
    """24 bits: the fraction of 12 bits reaches to 2048, where float32 is too coarse for a small subject."""
    values, near = splats()
    for i, k in enumerate("xyz"):
        values[k] = [2000, -1990, 1][i] + 0.05 * near[:, i]
    (tmp_path / "a.spz").write_bytes(spz(values))
    cloud = load_gaussians(tmp_path / "a.spz")
    assert cloud.origin[0] > 1999
    stored = np.stack([values[k] for k in "xyz"], axis=1)
    np.testing.assert_allclose(places(cloud), turn_x(stored), atol=2**-12)
    blocks = list(stream_gaussians(tmp_path / "a.spz", block=64))
    np.testing.assert_array_equal(np.concatenate([b.means for b in blocks]), cloud.means)
    moved = load_gaussians(tmp_path / "a.spz", origin=cloud.origin + np.array([0, 0, 1]))
    np.testing.assert_allclose(moved.means, cloud.means - [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("kind", ["compressed.ply", "splat"])
def test_formats_of_float32(tmp_path, kind):
    """What the file holds, exactly, relative to an origin; and a word about what it does not."""
    values, near = splats(600)
    encode = {"compressed.ply": compressed_ply, "splat": dot_splat}[kind]
    path = tmp_path / f"a.{kind}"
    path.write_bytes(encode({k: v.astype(np.float32) for k, v in values.items()}))
    with pytest.warns(DataWarning, match="precision is lost"):
        cloud = load_gaussians(path)
    assert np.abs(cloud.means).max() < 10
    np.testing.assert_allclose(places(cloud), near + FAR, atol=0.5)
    with pytest.warns(DataWarning):
        blocks = list(stream_gaussians(path, block=256))
    np.testing.assert_array_equal(np.concatenate([b.means for b in blocks]), cloud.means)


def test_splats_of_gltf_nodes(tmp_path):
    """The node's translation is added in float64, after its scale."""
    values, near = splats(at=np.zeros(3))
    node = {"mesh": 0, "translation": FAR.tolist(), "scale": [2, 2, 2]}
    (tmp_path / "a.glb").write_bytes(splat_gltf(splat_accessors(values), nodes=[node]))
    cloud = load_gaussians(tmp_path / "a.glb")
    np.testing.assert_allclose(places(cloud), (2 * near + FAR) * [-1, -1, 1], atol=1e-6)
    assert np.abs(cloud.means).max() < 20
    blocks = list(stream_gaussians(tmp_path / "a.glb", block=64))
    np.testing.assert_array_equal(np.concatenate([b.means for b in blocks]), cloud.means)


def test_several_files_share_an_origin(tmp_path):
    values, near = splats()
    others, there = splats(seed=1, at=FAR + np.array([10, 0, 0]))
    paths = [
        write_ply(tmp_path / f"{i}.ply", [splat_table(v, DOUBLES)]) for i, v in enumerate((values, others))
    ]
    blocks = list(stream_gaussians(paths, block=64))
    assert len({tuple(block.origin) for block in blocks}) == 1
    found = np.concatenate([places(block) for block in blocks])
    np.testing.assert_allclose(
        found, np.concatenate([near + FAR, there + FAR + np.array([10, 0, 0])]), atol=1e-6
    )


@pytest.mark.parametrize("given", [None, FAR])
def test_a_file_that_would_lose_its_detail_beside_others_is_refused(tmp_path, given):
    paths = [
        write_ply(tmp_path / f"{name}.ply", [splat_table(splats(at=at)[0], DOUBLES)])
        for name, at in (("local", np.zeros(3)), ("utm", FAR))
    ]
    lost = "utm" if given is None else "local"
    message = f"{lost}.ply, around .* would be in steps of 0.5 across an extent of .*; take each file by"
    with pytest.raises(ValueError, match=message) as refused:
        next(iter(stream_gaussians(paths, origin=given)))
    assert "utm.ply, around 500000 4500000 100" in str(refused.value)
    assert "local.ply, around 0 0 0" in str(refused.value)
    with pytest.raises(ValueError, match=message):
        build_tiles(stream_gaussians(paths, origin=given), tmp_path / "tiles", TileOptions(up=(0, 0, 1)))
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_a_small_file_far_from_a_large_one_is_taken(tmp_path):
    """1.5 m at 3 km, where steps are a quarter of a millimetre."""
    rng = np.random.default_rng(0)
    low = rng.uniform(-0.75, 0.75, (400, 3))
    need_detail({"large": 1000 * low, "small": low + np.array([3000, 0, 0])}, np.zeros(3))
    turns, sh = np.tile([1, 0, 0, 0], (400, 1)), np.zeros((400, 1, 3))
    cloud = GaussianCloud(low, turns, np.full((400, 3), 0.01), np.ones(400), sh)
    placed(cloud, (-3000, 0, 0))
    with pytest.raises(OptionsError, match="too far from the scene"):
        placed(cloud, (-300_000, 0, 0))


def test_files_side_by_side_are_refused_far_from_the_origin_that_is_given(tmp_path):
    paths = [
        write_ply(tmp_path / f"{name}.ply", [splat_table(splats(at=at)[0], DOUBLES)])
        for name, at in (("one", FAR), ("other", FAR + 50))
    ]
    stream = stream_gaussians(paths, origin=(0, 0, 0))
    with pytest.raises(ValueError, match=r"one.ply, around .*, is too far from the origin that is given"):
        next(iter(stream))
    assert next(iter(stream_gaussians(paths))).origin.any()


def test_our_splats_come_back_exactly(tmp_path):
    values, _ = splats()
    cloud = load_gaussians(write_ply(tmp_path / "a.ply", [splat_table(values, DOUBLES)]))
    cloud = cloud.relative_to(cloud.origin + 0.1)  # an origin of 17 digits
    save_gaussians(cloud, tmp_path / "b.ply")
    again = load_gaussians(tmp_path / "b.ply")
    np.testing.assert_array_equal(again.origin, cloud.origin)
    np.testing.assert_array_equal(again.means, cloud.means)
    parts = [cloud.take(np.arange(100)), cloud.take(np.arange(100, 300)).relative_to(FAR)]
    save_gaussian_blocks(parts, tmp_path / "c.ply", 300, degree=1)
    np.testing.assert_allclose(places(load_gaussians(tmp_path / "c.ply")), places(cloud), atol=1e-6)
    text = (tmp_path / "b.ply").read_bytes().replace(b"meshsplats origin 500000.1", b"meshsplats origin here")
    (tmp_path / "d.ply").write_bytes(text)
    with pytest.raises(FileFormatError, match="an origin must be 3 finite numbers"):
        load_gaussians(tmp_path / "d.ply")


def test_tensors_of_doubles():
    _, near = splats()
    n = len(near)
    tensors = {"means": near + FAR, "quats": np.ones((n, 4)), "scales": np.zeros((n, 3))}
    tensors |= {"opacities": np.zeros(n), "sh0": np.zeros((n, 1, 3)), "shN": np.zeros((n, 0, 3))}
    cloud = gaussians_from_tensors(tensors)
    np.testing.assert_array_equal(cloud.origin, FAR)
    np.testing.assert_allclose(cloud.means, near, atol=1e-9)


# -- meshes


def triangles(n=40, seed=3):
    """(3 n, 3) float64 corners around 0 and (n, 3) faces."""
    corners = np.random.default_rng(seed).normal(size=(3 * n, 3)).astype(np.float32).astype(np.float64)
    return corners, np.arange(3 * n).reshape(-1, 3)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_meshes_of_doubles(tmp_path, encoding):
    from _splat_files import Table

    corners, faces = triangles()
    rows = [[*map(float, p), 255, 0, 0] for p in corners + FAR]
    columns = [("double", "x"), ("double", "y"), ("double", "z")]
    columns += [("uchar", name) for name in ("red", "green", "blue")]
    vertex = Table("vertex", columns, rows)
    face = Table("face", [("uchar", "int", "vertex_indices")], [[f.tolist()] for f in faces])
    mesh = load_mesh(write_ply(tmp_path / "a.ply", [vertex, face], encoding))
    np.testing.assert_array_equal(mesh.origin, FAR)
    np.testing.assert_allclose(mesh.vertices, corners, atol=1e-9)


def test_obj_decimals(tmp_path):
    corners, faces = triangles()
    lines = ["v {!r} {!r} {!r} 1 0 0".format(*map(float, p)) for p in corners + FAR]
    lines += ["f {} {} {}".format(*(f + 1)) for f in faces]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh = load_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(mesh.origin, FAR)
    np.testing.assert_allclose(mesh.vertices, corners, atol=1e-9)
    base = load_base(tmp_path / "a.obj", origin=FAR - 1)
    np.testing.assert_allclose(base.vertices, corners + 1, atol=1e-6)


def test_gltf_nodes(tmp_path):
    """A triangle of a tenth of a unit, 4.5 million units away, below a node that turns it."""
    s = np.sqrt(0.5)
    nodes = [
        {"children": [1], "translation": FAR.tolist()},
        {"mesh": 0, "rotation": [s, 0, 0, s], "scale": [0.1, 0.1, 0.1], "translation": [0.25, 0, 0]},
    ]
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(mesh_gltf([(TRIANGLE, "VEC3", False)], nodes=nodes)))
    mesh = load_mesh(path)
    expected = 0.1 * TRIANGLE[:, [0, 2, 1]] * [1, -1, 1] + np.array([0.25, 0, 0])
    np.testing.assert_allclose(places(mesh) - FAR, expected, atol=1e-8)
    there = load_mesh(path, origin=FAR)
    np.testing.assert_allclose(there.vertices, expected, atol=1e-8)


def test_usd_transforms(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import Gf, UsdGeom, Vt

    corners, faces = triangles()
    stage = usd.Stage.CreateNew(str(tmp_path / "a.usdc"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.Xform.Define(stage, "/World").AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*FAR))
    shape = UsdGeom.Mesh.Define(stage, "/World/Mesh")
    shape.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
    shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([(1, 0, 0)])
    stage.GetRootLayer().Save()
    mesh = load_mesh(tmp_path / "a.usdc")
    np.testing.assert_array_equal(mesh.origin, FAR)
    np.testing.assert_allclose(mesh.vertices, 2 * corners, atol=1e-6)
    np.testing.assert_allclose(
        load_mesh(tmp_path / "a.usdc", origin=FAR + 1).vertices, 2 * corners - 1, atol=1e-6
    )


def test_gltf_of_float32(tmp_path):
    """What the file has lost is gone; what it holds is read exactly, with a word about it."""
    stored = (TRIANGLE + FAR).astype("<f4")
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(mesh_gltf([(stored, "VEC3", False)])))
    with pytest.warns(DataWarning, match="precision is lost"):
        mesh = load_mesh(path)
    assert mesh.origin.any()
    np.testing.assert_array_equal(places(mesh), stored.astype(np.float64))


def test_npz_of_the_published_code(tmp_path):
    corners, faces = triangles()
    np.savez(tmp_path / "a.npz", vertices=corners + FAR, faces=faces, vertex_colors=np.ones((120, 3)))
    mesh = load_mesh(tmp_path / "a.npz")
    np.testing.assert_array_equal(mesh.origin, FAR)
    np.testing.assert_allclose(mesh.vertices, corners, atol=1e-9)


# -- our own files, and what others read in them


def our_mesh(extras=True):
    mesh = random_mesh(np.random.default_rng(7), 60, 90, extras=extras)
    return replace(mesh, vertices=mesh.vertices / 100, origin=FAR + 0.1, up=(0.1, -0.9, 0.3))


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("suffix", [".npz", ".ply", ".glb", ".usdc", ".usda"])
def test_our_meshes_come_back_exactly(tmp_path, suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr.Usd")
    mesh = our_mesh()
    save_mesh(mesh, tmp_path / f"a{suffix}")
    again = load_mesh(tmp_path / f"a{suffix}")
    assert_same(again, mesh, {".glb": 1e-3, ".usdc": 1e-5, ".usda": 1e-5}.get(suffix, 0))
    moved = load_mesh(tmp_path / f"a{suffix}", origin=FAR)
    np.testing.assert_array_equal(moved.origin, FAR)
    np.testing.assert_allclose(moved.vertices, mesh.vertices + 0.1, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.obj files have no opacity")
def test_our_obj_comes_back_but_for_the_last_digits(tmp_path):
    mesh = our_mesh(extras=False)
    save_mesh(mesh, tmp_path / "a.obj")
    again = load_mesh(tmp_path / "a.obj")
    np.testing.assert_array_equal(again.origin, mesh.origin)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-8)


def test_meshes_without_an_origin_are_written_as_before(tmp_path):
    """And keep the coordinates that they have, however far away."""
    mesh = replace(our_mesh(), origin=np.zeros(3), vertices=our_mesh().vertices + np.float32(4e6))
    for suffix in (".npz", ".ply", ".glb"):
        save_mesh(mesh, tmp_path / f"a{suffix}")
        content = (tmp_path / f"a{suffix}").read_bytes()
        assert b"origin" not in content
        assert b"translation" not in content
        assert_same(load_mesh(tmp_path / f"a{suffix}"), mesh, 1e-3)


def test_blocks_of_a_mesh(tmp_path):
    whole = our_mesh(extras=False)
    save_mesh_blocks([whole, whole.relative_to(FAR)], tmp_path / "a.ply")
    mesh = load_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.origin, whole.origin)
    np.testing.assert_allclose(places(mesh), np.tile(places(whole), (2, 1)), atol=1e-6)


def test_a_ply_whose_vertices_were_moved(tmp_path):
    """Another program moves x y z and keeps the rest: they count."""
    mesh = our_mesh(extras=False)
    save_mesh(mesh, tmp_path / "a.ply")
    data = bytearray((tmp_path / "a.ply").read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    (x,) = struct.unpack_from("<d", data, start)
    struct.pack_into("<d", data, start, x + 2)
    (tmp_path / "a.ply").write_bytes(data)
    found = load_mesh(tmp_path / "a.ply")
    np.testing.assert_allclose(found.vertices[0], mesh.vertices[0] + np.array([2, 0, 0]), atol=1e-6)
    np.testing.assert_allclose(found.vertices[1:], mesh.vertices[1:], atol=1e-6)


def test_a_glb_that_another_program_has_moved(tmp_path):
    mesh = replace(our_mesh(extras=False), up=(0, 1, 0))
    save_mesh(mesh, tmp_path / "a.glb")
    document, binary = read_glb(tmp_path / "a.glb")
    document["nodes"][0]["translation"][0] += 7
    write_glb(tmp_path / "a.glb", document, binary)
    found = load_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(places(found), places(mesh) + np.array([7, 0, 0]), atol=1e-6)


def upright(mesh):
    """(v, 3) float64 places in a frame whose +y is the mesh's up, as other programs show it."""
    return places(mesh) @ rotation_matrix(up_quaternion(mesh.up))[:3, :3].T


def test_other_programs_see_the_place(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = our_mesh(extras=False)
    save_mesh(mesh, tmp_path / "a.glb")
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    (name,) = scene.graph.nodes_geometry
    matrix, geometry = scene.graph[name]
    seen = scene.geometry[geometry].vertices @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(seen, upright(mesh), atol=1e-6)
    save_mesh(mesh, tmp_path / "a.ply")
    seen = trimesh.load(tmp_path / "a.ply", process=False).vertices
    np.testing.assert_allclose(seen, places(mesh), atol=1e-8)


def test_pygltflib_sees_the_place(tmp_path):
    pygltflib = pytest.importorskip("pygltflib")
    mesh = replace(our_mesh(extras=False), up=(0, -1, 0))
    save_mesh(mesh, tmp_path / "a.glb")
    (node,) = pygltflib.GLTF2().load(str(tmp_path / "a.glb")).nodes
    assert node.rotation == [1, 0, 0, 0]  # half a turn about x: y and z change their signs
    np.testing.assert_array_equal(node.translation, mesh.origin * [1, -1, -1])


def test_usd_sees_the_place(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom

    mesh = our_mesh(extras=False)
    save_mesh(mesh, tmp_path / "a.usdc")
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/Splats/Mesh"))
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(shape.GetPrim()))
    seen = np.array(shape.GetPointsAttr().Get(), np.float64) @ matrix[:3, :3] + matrix[3, :3]
    np.testing.assert_allclose(seen, upright(mesh), atol=1e-6)


def test_npz_has_an_array(tmp_path):
    mesh = our_mesh(extras=False)
    save_mesh(mesh, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as arrays:
        np.testing.assert_array_equal(arrays["origin"], mesh.origin)
        np.testing.assert_array_equal(arrays["vertices"], mesh.vertices)
    assert "origin.npy" in zipfile.ZipFile(tmp_path / "a.npz").namelist()
