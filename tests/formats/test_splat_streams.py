"""Splat files read in blocks: the same splats as read whole, in memory that does not grow with the file."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from _splat_encoders import (
    bundle,
    compressed_ply,
    dot_splat,
    gltf,
    sog,
    splat_accessors,
    spz,
    spz4,
    streamed_sog,
)
from _splat_files import random_splats, splat_table, write_ply

from meshsplats import (
    DataWarning,
    FileFormatError,
    GaussianCloud,
    load_gaussians,
    save_gaussian_blocks,
    save_gaussians,
    stream_gaussians,
)
from meshsplats.conversion import convert
from meshsplats.demo_scene import make_scene
from meshsplats.evaluation.benchmarks import find_input
from meshsplats.formats import _validation
from meshsplats.formats.meshes import save_mesh
from meshsplats.formats.ply import compressed_splats, table
from meshsplats.formats.splat_paths import splat_file, subject_name
from meshsplats.formats.splats import _spz_streams
from meshsplats.formats.splats import dot_splat as dot_splat_module
from meshsplats.formats.splats import sog as sog_module
from meshsplats.formats.splats import spz as spz_module
from meshsplats.operations.batches import sources

FIELDS = ("means", "quaternions", "scales", "opacities", "sh")
VALUES = random_splats(n=600, degree=1)


def ply(encoding):
    def write(path):
        write_ply(path, [splat_table(VALUES)], encoding)

    return write


def gzipped(path):
    write_ply(path, [splat_table(VALUES)])
    path.write_bytes(gzip.compress(path.read_bytes(), mtime=0))


def whole(make):
    return lambda path: path.write_bytes(make())


def spz_version_4() -> bytes:
    zstandard = pytest.importorskip("zstandard", reason="install meshsplats[formats]")
    return spz4(VALUES, zstandard.ZstdCompressor(write_checksum=True).compress)


FILES = {
    "float.ply": ply("binary_little_endian"),
    "big.ply": ply("binary_big_endian"),
    "ascii.ply": ply("ascii"),
    "gzipped.ply.gz": gzipped,
    "compressed.ply": whole(lambda: compressed_ply(VALUES)),
    "a.splat": whole(lambda: dot_splat(VALUES)),
    "version1.spz": whole(lambda: spz(VALUES, 1)),
    "version2.spz": whole(lambda: spz(VALUES, 2)),
    "version3.spz": whole(lambda: spz(VALUES, 3)),
    "version4.spz": whole(spz_version_4),
    "version1.sog": whole(lambda: bundle(sog(VALUES, 1))),
    "version2.sog": whole(lambda: bundle(sog(VALUES))),
    "a.glb": whole(lambda: gltf(splat_accessors(VALUES))),
}


@pytest.fixture
def small_chunks(monkeypatch):
    """Readers take a few splats at a time."""
    for module in (dot_splat_module, sog_module, spz_module):
        monkeypatch.setattr(module, "_AT_ONCE", 70)
    monkeypatch.setattr(_spz_streams, "_PIECE", 100)
    monkeypatch.setattr(compressed_splats, "_CHUNKS_AT_ONCE", 1)
    monkeypatch.setattr(table, "CHUNK_BYTES", 8000)


def assert_same(blocks, cloud):
    for name in FIELDS:
        np.testing.assert_array_equal(
            np.concatenate([getattr(b, name) for b in blocks]), getattr(cloud, name)
        )
    assert {b.kernel for b in blocks} == {cloud.kernel}


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("name", FILES)
def test_blocks_are_the_splats_of_the_file(tmp_path, small_chunks, name):
    FILES[name](tmp_path / name)
    cloud = load_gaussians(tmp_path / name)
    assert len(cloud) == 600
    stream = stream_gaussians(tmp_path / name, block=100)
    blocks = list(stream)
    assert len(blocks) >= 3
    assert max(map(len, blocks)) <= 256  # of compressed .ply, whose chunks are not divided
    assert_same(blocks, cloud)
    assert_same(list(stream), cloud)  # again
    turned = list(stream_gaussians(tmp_path / name, block=100, axes="y-up"))
    assert_same(turned, load_gaussians(tmp_path / name, axes="y-up"))


@pytest.mark.parametrize("name", FILES)
def test_blocks_are_the_splats_of_the_file_for_any_origin(tmp_path, name):
    FILES[name](tmp_path / name)
    origin = [1000.1, -2000.3, 0.7]
    cloud = load_gaussians(tmp_path / name, origin=origin)
    np.testing.assert_array_equal(cloud.origin, origin)
    assert_same(list(stream_gaussians(tmp_path / name, block=100, origin=origin)), cloud)


def test_a_streamed_scene_comes_part_by_part(tmp_path, small_chunks):
    parts = {name: random_splats(n=150, degree=0, seed=i) for i, name in enumerate("ab")}
    leaves = [{0: ("a", 10, 120)}, {0: ("b", 0, 150)}]
    for name, data in streamed_sog(parts, leaves).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    cloud = load_gaussians(tmp_path)
    assert len(cloud) == 270
    blocks = list(stream_gaussians(tmp_path, block=100))
    assert len(blocks) >= 4
    assert_same(blocks, cloud)


@pytest.mark.parametrize("name", [*FILES, "LOUD.PLY.GZ"])
def test_what_is_read_when_named_is_found_in_a_folder(tmp_path, name):
    """By everything that takes folders."""
    if name == "LOUD.PLY.GZ":
        gzipped(tmp_path / name)
    else:
        FILES[name](tmp_path / name)
    for other in (".hidden.ply", "notes.txt.gz", "notes.txt"):
        (tmp_path / other).write_bytes(gzip.compress(b"no splats"))
    assert sources([tmp_path]) == [tmp_path / name]
    assert stream_gaussians(tmp_path).paths == (tmp_path / name,)
    if name.islower():
        stem = name.partition(".")[0]
        assert find_input(tmp_path, stem) == tmp_path / name


def test_meshes_in_a_folder_are_no_splats_and_broken_files_are_not_passed_over(tmp_path):
    write_ply(tmp_path / "a.ply", [splat_table(VALUES)])
    mesh = convert(load_gaussians(tmp_path / "a.ply"))
    for name in ("a.glb", "b.ply"):
        save_mesh(mesh, tmp_path / name)
    assert stream_gaussians(tmp_path).paths == (tmp_path / "a.ply",)
    for name, content in (("c.ply", b""), ("d.spz", b"version https://git-lfs"), ("e.glb", b"glTF")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(FileFormatError, match=name):
            list(stream_gaussians(tmp_path))
        (tmp_path / name).unlink()


def test_a_model_may_be_gzipped(tmp_path):
    for step in (7, 30):
        folder = tmp_path / "chair" / "point_cloud" / f"iteration_{step}"
        folder.mkdir(parents=True)
        gzipped(folder / "point_cloud.ply.gz")
    assert splat_file(tmp_path / "chair") == folder / "point_cloud.ply.gz"
    assert subject_name(splat_file(tmp_path / "chair")) == "chair"
    assert sources([tmp_path]) == [tmp_path / "chair"]
    assert len(load_gaussians(tmp_path / "chair")) == 600


def test_several_files_and_folders(tmp_path):
    for name, n in (("b.ply", 30), ("a.splat", 20), ("c.ply", 10)):
        values = random_splats(n=n, degree=0, seed=n)
        if name.endswith(".splat"):
            (tmp_path / name).write_bytes(dot_splat(values))
        else:
            write_ply(tmp_path / name, [splat_table(values)])
    (tmp_path / "notes.txt").write_text("no splats")
    assert [len(block) for block in stream_gaussians(tmp_path)] == [20, 30, 10]
    assert [len(block) for block in stream_gaussians([tmp_path / "c.ply", tmp_path / "b.ply"])] == [10, 30]
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileFormatError, match="a folder without splats"):
        stream_gaussians(tmp_path / "empty")
    with pytest.raises(FileNotFoundError):
        stream_gaussians(tmp_path / "none.ply")
    with pytest.raises(ValueError, match="block must be a number of splats"):
        stream_gaussians(tmp_path, block=0)
    with pytest.raises(ValueError, match="axes must be one of"):
        stream_gaussians(tmp_path, axes="z-up")
    with pytest.raises(ValueError, match="at least one"):
        stream_gaussians([])


def test_unusable_splats_are_counted_once(tmp_path, small_chunks):
    values = random_splats(n=400, degree=0)
    values["x"][[5, 390]] = np.nan
    for i in range(4):
        values[f"rot_{i}"][200] = 0
    write_ply(tmp_path / "a.ply", [splat_table(values)])
    with pytest.warns(DataWarning, match=r"3 of 400 splats are unusable: 2 .* first is splat 5 ") as caught:
        blocks = list(stream_gaussians(tmp_path / "a.ply", block=50))
    assert len(caught) == 1
    with pytest.warns(DataWarning):
        assert_same(blocks, load_gaussians(tmp_path / "a.ply"))
    stream = iter(stream_gaussians(tmp_path / "a.ply", block=50, strict=True))
    with pytest.raises(FileFormatError, match="unusable"):
        next(stream)
    values["y"][:] = np.inf
    write_ply(tmp_path / "b.ply", [splat_table(values)])
    with pytest.raises(FileFormatError, match="no usable splats"):
        list(stream_gaussians(tmp_path / "b.ply", block=50))


@pytest.mark.slow(keep=4)
@pytest.mark.parametrize("name", [name for name in FILES if not name.endswith((".splat", ".sog", ".glb"))])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_truncated_files_are_refused(tmp_path, small_chunks, name, share):
    path = tmp_path / name
    FILES[name](path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(FileFormatError) as caught:
        list(stream_gaussians(path, block=100))
    assert str(caught.value).startswith(str(path))


def test_broken_streams_are_refused(tmp_path, small_chunks):
    """Bytes changed in the middle: the checksums of gzip and Zstandard notice at the latest."""
    for name in ("gzipped.ply.gz", "version3.spz", "version4.spz"):
        path = tmp_path / name
        FILES[name](path)
        data = bytearray(path.read_bytes())
        for i in range(len(data) // 2, len(data) // 2 + 40):
            data[i] ^= 0x5A
        path.write_bytes(bytes(data))
        with pytest.raises(FileFormatError, match=r"broken|truncated|longer"):
            list(stream_gaussians(path, block=100))


def test_a_gzip_bomb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(_validation, "_BASE_BYTES", 1 << 20)
    write_ply(tmp_path / "a.ply", [splat_table(random_splats(n=3, degree=0))], tail=bytes(60 << 20))
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress((tmp_path / "a.ply").read_bytes(), 1))
    with pytest.raises(FileFormatError, match="decompression bomb"):
        list(stream_gaussians(tmp_path / "a.ply.gz"))


@pytest.mark.parametrize("kind", ["ply", "splat", "spz"])
def test_memory_does_not_grow_with_the_file(tmp_path, kind):
    n = 60_000
    rng = np.random.default_rng(0)
    path = tmp_path / f"a.{kind}"
    if kind == "ply":
        cloud = make_scene(1000)
        save_gaussian_blocks([cloud] * 150, path, 150_000, degree=3)  # 35 MB of arrays
    elif kind == "splat":
        record = np.zeros(10 * n, dot_splat_module._RECORD)
        record["position"], record["rotation"][:, 0] = rng.normal(size=(10 * n, 3)), 255
        record["rotation"][:, 1:] = 128
        path.write_bytes(record.tobytes())
    else:
        body = b"".join(rng.integers(0, 256, size * 10 * n, np.uint8).tobytes() for size in (9, 1, 3, 3, 4))
        header = struct.pack("<4sIIBBBB", b"NGSP", 3, 10 * n, 0, 12, 0, 0)
        path.write_bytes(gzip.compress(header + body, 1, mtime=0))
    warnings.simplefilter("ignore", DataWarning)
    tracemalloc.start()
    count = sum(len(block) for block in stream_gaussians(path, block=4096))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count >= n
    assert peak < 24 << 20  # arrays of 600,000 splats have 34 MB


def test_blocks_are_written_as_the_whole(tmp_path):
    cloud = make_scene(500)
    parts = [cloud.take(np.arange(i, min(i + 120, 500))) for i in range(0, 500, 120)]
    save_gaussians(cloud, tmp_path / "whole.ply")
    save_gaussian_blocks(iter(parts), tmp_path / "parts.ply", 500, degree=3)
    assert (tmp_path / "parts.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    flat = GaussianCloud(
        *(getattr(cloud, name) for name in FIELDS[:2]),
        cloud.scales * [1, 1, 0],
        cloud.opacities,
        cloud.sh[:, :1],
        "2dgs",
    )
    save_gaussians(flat, tmp_path / "flat.ply")
    save_gaussian_blocks([flat], tmp_path / "flat2.ply", 500, kernel="2dgs")
    assert (tmp_path / "flat2.ply").read_bytes() == (tmp_path / "flat.ply").read_bytes()
    save_gaussian_blocks([flat], tmp_path / "wide.ply", 500, degree=1)  # harmonics that are missing are 0
    assert not load_gaussians(tmp_path / "wide.ply").sh[:, 1:].any()
    for count in (499, 501):
        with pytest.raises(ValueError, match=f"500 splats came for a file of {count}"):
            save_gaussian_blocks(parts, tmp_path / "new.ply", count, degree=3)
    assert not (tmp_path / "new.ply").exists()
    with pytest.raises(ValueError, match=r"written as float \.ply"):
        save_gaussian_blocks(parts, tmp_path / "new.spz", 500)
    with pytest.raises(ValueError, match="degree 0 to 3"):
        save_gaussian_blocks(parts, tmp_path / "new.ply", 500, degree=4)


def test_blocks_of_too_high_a_degree_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"a\.ply: splats of degree 2 for a file of degree 1: give degree=2"):
        save_gaussian_blocks([make_scene(200).of_degree(2)], tmp_path / "a.ply", 200, degree=1)
    assert not list(tmp_path.iterdir())
