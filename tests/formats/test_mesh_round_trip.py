"""Saved meshes come back as they were."""

import os
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from _meshes import assert_same, random_mesh
from _splats import few_splats
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import (
    DataWarning,
    FileFormatError,
    SplatMesh,
    load_gaussians,
    load_mesh,
    save_gaussians,
    save_mesh,
)
from meshsplats.formats import npz
from meshsplats.formats.gltf import binary_chunk, own, reader
from meshsplats.formats.mesh_formats import mesh_format_to_write
from meshsplats.formats.ply import header
from meshsplats.formats.sniff import identify
from meshsplats.scene.binding import ArrayField, Binding

SUFFIXES = (".npz", ".ply", ".glb")


@pytest.mark.parametrize("suffix", SUFFIXES)
@given(
    seed=st.integers(0, 2**32 - 1),
    extras=st.booleans(),
    blending=st.sampled_from(["display", "linear"]),
    order=st.sampled_from(["fragment", "splat"]),
)
def test_round_trip(tmp_path_factory, suffix, seed, extras, blending, order):
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng, *rng.integers(3, 40, 2), extras=extras, blending=blending)
    mesh = replace(mesh, order=order if extras else "fragment")
    path = tmp_path_factory.mktemp("mesh") / f"mesh{suffix}"
    save_mesh(mesh, path)
    assert_same(load_mesh(path), mesh, 1 / 10_000 if suffix == ".glb" else 0)


@dataclass(frozen=True, eq=False)
class Shining(SplatMesh):
    """With one more array, a row for each splat."""

    shine: np.ndarray | None = None

    FIELDS: ClassVar = (*SplatMesh.FIELDS, ArrayField("shine", np.float32, "splat", 2, optional=True))
    EXTRAS: ClassVar = (*SplatMesh.EXTRAS, FIELDS[-1])


@pytest.mark.parametrize("suffix", [".npz", ".glb"])
def test_an_array_of_splats_that_is_declared_comes_back(tmp_path, monkeypatch, suffix):
    monkeypatch.setattr(npz, "SplatMesh", Shining)
    for module in (reader, own):
        monkeypatch.setattr(module, "SplatMesh", Shining)
    monkeypatch.setitem(npz._NAMES, "shine", "shine")
    mesh = random_mesh(np.random.default_rng(7))
    rows = np.random.default_rng(8).random((mesh.splat_count, 2))
    mesh = Shining(**vars(mesh), shine=rows)
    path = tmp_path / f"m{suffix}"
    save_mesh(mesh, path)
    assert_same(load_mesh(path), mesh, 1 / 10_000)
    fewer = {name: a for name, a in mesh.arrays().items() if name != "face_splat"}
    if suffix == ".npz":
        names = {"colors": "vertex_colors"}
        for cut in (fewer, mesh.arrays() | {"shine": rows[:-1]}):
            np.savez(path, **{names.get(name, name.replace(".", "_", 1)): a for name, a in cut.items()})
            with pytest.raises(FileFormatError, match="shine"):
                load_mesh(path)


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("suffix", [*SUFFIXES, ".usdc", ".usda", ".obj"])
def test_the_filter_of_the_splats_stays(tmp_path, suffix):
    """Programs that draw without it get a warning, and .obj files cannot hold it."""
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr", reason="usd-core is not installed")
    mesh = random_mesh(np.random.default_rng(7))
    mesh = replace(mesh, filter_px2=0.1, colors=np.column_stack([mesh.colors[:, :3], np.ones(9)]))
    path = tmp_path / f"m{suffix}"
    if suffix in (".npz", ".ply"):
        save_mesh(mesh, path)
    else:
        with pytest.warns(DataWarning, match=r"a filter of 0\.1 px\^2, which other programs do not have"):
            save_mesh(mesh, path)
    assert load_mesh(path).filter_px2 == (0 if suffix == ".obj" else 0.1)
    save_mesh(replace(mesh, filter_px2=0), path)
    assert load_mesh(path).filter_px2 == 0


@pytest.mark.parametrize("suffix", [".npz", ".ply"])
@pytest.mark.parametrize("vertices", [0, 5])
def test_meshes_without_triangles(tmp_path, suffix, vertices):
    empty = np.empty((0, 3))
    mesh = SplatMesh(np.ones((vertices, 3)), empty.astype(int), np.ones((vertices, 4)))
    save_mesh(mesh, tmp_path / f"m{suffix}")
    assert_same(load_mesh(tmp_path / f"m{suffix}"), mesh)


@pytest.mark.parametrize("suffix", [".npz", ".ply", ".usda"])
def test_nothing_of_splats_without_triangles_is_lost(tmp_path, recwarn, suffix):
    if suffix == ".usda":
        pytest.importorskip("pxr")
    empty = SplatMesh(
        np.empty((0, 3)),
        np.empty((0, 3), int),
        np.empty((0, 4)),
        face_splat=np.empty(0, int),
        depth_group=np.empty(0, int),
        harmonics=np.empty((0, 3, 3)),
        order="splat",
    )
    save_mesh(empty, tmp_path / f"m{suffix}")
    assert_same(load_mesh(tmp_path / f"m{suffix}"), empty)
    assert not [str(each.message) for each in recwarn]


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_formats_that_cannot_hold_a_mesh_without_triangles_say_so(tmp_path, suffix):
    mesh = SplatMesh(np.ones((2, 3)), np.empty((0, 3), int), np.ones((2, 4)))
    with pytest.raises(ValueError, match=r"without triangles.*\.npz"):
        save_mesh(mesh, tmp_path / f"m{suffix}")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("vertices", [0xFFFF, 0x10000])
def test_glb_at_the_limit_of_16_bit_indices(tmp_path, vertices):
    rng = np.random.default_rng(0)
    mesh = random_mesh(rng, vertices, 10, extras=False)
    mesh = replace(mesh, faces=np.array([[0, 1, vertices - 1], [vertices - 1, 0, vertices - 2]]))
    save_mesh(mesh, tmp_path / "m.glb")
    assert_same(load_mesh(tmp_path / "m.glb"), mesh, 1 / 10_000)


def test_glb_with_float_colors_is_exact_to_rounding(tmp_path):
    mesh = random_mesh(np.random.default_rng(1))
    save_mesh(mesh, tmp_path / "m.glb", color_type="float32")
    assert_same(load_mesh(tmp_path / "m.glb"), mesh, 1e-6)


def test_normals_made_for_a_lit_glb_are_not_taken_for_the_meshs_own(tmp_path):
    mesh = random_mesh(np.random.default_rng(2), extras=False)
    save_mesh(mesh, tmp_path / "m.glb", lit=True)
    assert load_mesh(tmp_path / "m.glb").normals is None


def test_saving_twice_changes_nothing(tmp_path):
    """Values rounded to 16 bits once are not rounded again."""
    mesh = random_mesh(np.random.default_rng(3), 2000, 3000)
    for name in ("a", "b"):
        save_mesh(mesh, tmp_path / f"{name}.glb")
        mesh = load_mesh(tmp_path / f"{name}.glb")
    one, two = ((tmp_path / f"{name}.glb").read_bytes() for name in "ab")
    assert len(one) == len(two)
    assert sum(a != b for a, b in zip(one, two, strict=True)) < 40  # the last digits of the up direction


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_writer_that_fails_leaves_the_old_file(tmp_path, monkeypatch, suffix):
    def half(mesh, path, **options):
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    path = tmp_path / f"m{suffix}"
    path.write_bytes(b"old")
    kind = mesh_format_to_write(path)
    monkeypatch.setitem(kind.__dict__, "codec", replace(kind.codec, write=half))
    with pytest.raises(KeyboardInterrupt):
        save_mesh(random_mesh(np.random.default_rng(0)), path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == [path.name]


def test_what_save_mesh_refuses(tmp_path):
    mesh = random_mesh(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"\.npz, \.ply, \.glb"):
        save_mesh(mesh, tmp_path / "m.stl")
    with pytest.raises(ValueError, match=r"color_type applies to \.glb only, not to \.ply"):
        save_mesh(mesh, tmp_path / "m.ply", color_type="uint16")
    with pytest.raises(ValueError, match=r"lit applies to \.glb, \.usdc, \.usda, \.usd only, not to \.ply"):
        save_mesh(mesh, tmp_path / "m.ply", lit=True)
    with pytest.raises(ValueError, match="color_type must be one of uint16, float32, got 'uint8'"):
        save_mesh(mesh, tmp_path / "m.glb", color_type="uint8")
    with pytest.raises(FileNotFoundError, match="create the folder"):
        save_mesh(mesh, tmp_path / "missing" / "m.ply")
    long = replace(mesh, normals=mesh.normals * 2)
    with pytest.raises(ValueError, match="normals of unit length, that of vertex 0 has 2"):
        save_mesh(long, tmp_path / "m.glb")
    for name in ("a\0b", "x" * 201, "\ud800"):
        odd = replace(mesh, attributes={name: np.zeros(9)})
        for suffix in SUFFIXES:
            with pytest.raises(ValueError, match="cannot be stored"):
                save_mesh(odd, tmp_path / f"m{suffix}")
    many = replace(mesh, attributes={"a": np.zeros((9, 5000))})
    with pytest.raises(ValueError, match="5013 columns"):
        save_mesh(many, tmp_path / "m.ply")
    assert os.listdir(tmp_path) == []


def test_a_glb_beyond_what_32_bits_can_say_is_refused_before_writing(tmp_path, monkeypatch):
    assert binary_chunk._MAX_BYTES == 2**32 - 1
    mesh = random_mesh(np.random.default_rng(0), 1000, 10)
    monkeypatch.setattr(binary_chunk, "_MAX_BYTES", 40_000)
    with pytest.raises(ValueError, match=r"would take \d+,\d+ bytes, a \.glb file can hold 40,000"):
        save_mesh(mesh, tmp_path / "m.glb")
    assert os.listdir(tmp_path) == []


def test_files_are_recognised_by_content(tmp_path):
    mesh = random_mesh(np.random.default_rng(4))
    for suffix in SUFFIXES:
        save_mesh(mesh, tmp_path / f"m{suffix}")
        (tmp_path / f"m{suffix}").replace(tmp_path / "mesh.dat")
        assert_same(load_mesh(tmp_path / "mesh.dat"), mesh, 1e-4)


@pytest.mark.parametrize("extras", [True, False])
def test_a_mesh_comes_back_from_its_arrays(extras):
    mesh = random_mesh(np.random.default_rng(5), 9, 3, extras=extras)
    mesh = replace(mesh, filter_px2=0.5 if extras else 0)
    if extras:
        corners = np.tile(np.eye(3), (3, 1))
        of_face = np.repeat([1, 0, 1], 3)
        bound = Binding(mesh.vertices, [[0, 1, 2], [2, 3, 4]], of_face, corners, np.arange(9), 0.25)
        mesh = replace(mesh, faces=np.arange(9).reshape(3, 3), binding=bound)
    again = SplatMesh.from_arrays(mesh.arrays())
    assert_same(again, mesh)
    assert list(again.arrays()) == list(mesh.arrays())
    for name, values in mesh.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], values)
    for name in mesh.arrays():
        if name in ("vertices", "faces", "colors", "up", "blending") or name.startswith("binding."):
            with pytest.raises(KeyError, match=name):
                SplatMesh.from_arrays({n: a for n, a in mesh.arrays().items() if n != name})


def test_a_ply_header_is_parsed_once(tmp_path, monkeypatch):
    save_mesh(random_mesh(np.random.default_rng(6)), tmp_path / "mesh.ply")
    save_gaussians(few_splats(), tmp_path / "splats.ply")
    parsed = []
    parse = header.parse_header
    monkeypatch.setattr(header, "parse_header", lambda *args: parsed.append(args[1]) or parse(*args))
    readers = {"mesh.ply": (load_mesh, identify), "splats.ply": (load_gaussians, identify)}
    for name, functions in readers.items():
        for read in functions:
            parsed.clear()
            read(tmp_path / name)
            assert parsed == [tmp_path / name]
