"""Bindings in files: what comes back, and what is refused."""

from __future__ import annotations

import re
import struct
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _glb import edit_glb, read_glb
from _meshes import assert_same
from _priors import bumpy, cube

from meshsplats import BaseMesh, DataWarning, FileFormatError, SplatMesh, load_mesh, save_mesh
from meshsplats._common.words import parse_up
from meshsplats.demo_scene import make_scene
from meshsplats.prior import MeshPrior, bind, load_prior
from meshsplats.prior.agreement import warn_of_contradictions

CLOUD = make_scene(300)
EXTENT = np.abs(CLOUD.means).max()


@pytest.mark.parametrize(
    ("name", "scale", "shift", "ups", "message"),
    [
        ("b.glb", 1, 0, ("y", "y"), None),
        ("b.obj", 1, 0, ("y", "-y"), None),  # which declares none
        ("b.glb", 1, 0, ("y", None), None),
        ("b.glb", 100, 0, ("y", "y"), r"about \d+ times as large \(scale it by 0\.0\d+\)"),
        ("b.glb", 0.01, 0, ("y", "y"), r"about 0\.0\d+ times as large \(scale it by \d+\)"),
        ("b.obj", 1, 9, ("y", "y"), r"far away from them \(move it by -[\d.]+, [\d.e-]+, [\d.e-]+\)"),
        ("b.usda", 1, 0, ("z", "-y"), r"its z points up, theirs is -y \(turn it by 90 degrees around x\)"),
        ("b.glb", 1, 0, ("y", "-y"), r"its y points up, theirs is -y \(turn it by 180 degrees around x\)"),
    ],
)
def test_a_base_that_contradicts_the_splats_is_told(name, scale, shift, ups, message):
    up, other = (None if text is None else parse_up(text) for text in ups)
    points = (cube().vertices * EXTENT + [shift * EXTENT, 0, 0]) * scale
    base, cloud = BaseMesh(points, cube().faces, up=up), replace(CLOUD, up=other)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_contradictions(base, cloud, Path(name), Path("s.ply"))
    if message is None:
        assert not caught
    else:
        (found,) = (str(each.message) for each in caught)
        assert re.search(f"^{re.escape(name)}: does not fit the splats of s.ply: .*{message}", found)


PARTS = ("base_vertices", "base_faces", "vertex_face", "weights", "layers")


def scattered(spacing=0.0) -> SplatMesh:
    """A prior with random weights and colours."""
    rng = np.random.default_rng(4)
    mesh = bind(bumpy(4), triangles=3, layers=2, spacing=spacing).mesh
    weights = rng.dirichlet((1, 1, 1), len(mesh.vertices))
    binding = replace(mesh.binding, weights=weights)
    return MeshPrior(replace(mesh, colors=rng.random(mesh.colors.shape), binding=binding)).pose()


@pytest.mark.parametrize("suffix", [".npz", ".glb"])
@pytest.mark.parametrize("spacing", [0.0, -0.01])
def test_a_binding_comes_back_to_the_bit(tmp_path, suffix, spacing):
    mesh = scattered(spacing)
    path = tmp_path / f"prior{suffix}"
    save_mesh(mesh, path)
    found = load_mesh(path)
    assert_same(found, mesh, 0 if suffix == ".npz" else 1 / 2000)
    for name in PARTS:
        np.testing.assert_array_equal(getattr(found.binding, name), getattr(mesh.binding, name))
    assert found.binding.lift == mesh.binding.lift
    # What is posed from the file is what is posed from memory.
    moved = mesh.binding.base_vertices * (1, 2, 0.5) + 1
    posed = load_prior(path).pose(moved)
    np.testing.assert_array_equal(posed.vertices, MeshPrior(mesh).pose(moved).vertices)
    save_mesh(posed, path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = load_mesh(path)
    np.testing.assert_array_equal(again.binding.positions(), posed.binding.positions())
    assert (again.binding.stretch is None) == (spacing == 0)


def test_vertices_recomputed_from_the_archive_alone(tmp_path):
    save_mesh(scattered(), tmp_path / "prior.npz")
    with np.load(tmp_path / "prior.npz") as file:
        corners = file["binding_base_vertices"][file["binding_base_faces"][file["binding_vertex_face"]]]
        wanted = (file["binding_weights"][..., None].astype(float) * corners).sum(axis=1)
        assert np.abs(wanted - file["vertices"]).max() < 1e-6
        assert file["binding_weights"].min() >= 0
        assert np.abs(file["binding_weights"].sum(axis=1, dtype=float) - 1).max() < 1e-6


def test_vertices_recomputed_from_the_glb_alone(tmp_path):
    mesh = MeshPrior(scattered()).pose()
    save_mesh(mesh, tmp_path / "prior.glb")
    document, binary = read_glb(tmp_path / "prior.glb")
    note = document["meshes"][0]["extras"]["meshsplats"]["binding"]

    def array(entry, dtype):
        view = document["bufferViews"][entry["bufferView"]]
        start = view.get("byteOffset", 0)
        return np.frombuffer(binary[start : start + view["byteLength"]], dtype)

    base, faces = array(note["baseVertices"], "<f4"), array(note["baseFaces"], "<i4")
    corners = base.reshape(-1, 3)[faces.reshape(-1, 3)[array(note["vertexFace"], "<i4")]]
    wanted = (array(note["weights"], "<f4").reshape(-1, 3, 1).astype(float) * corners).sum(axis=1)
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    assert np.abs(wanted - array(accessor, "<f4").reshape(-1, 3)).max() < 1e-6
    assert note["lift"] == 0
    assert (note["baseVertexCount"], note["baseFaceCount"]) == (25, 32)


def test_formats_without_a_place_for_it_say_so(tmp_path):
    for suffix in (".ply", ".obj"):
        with pytest.warns(DataWarning, match=r"binding to a base mesh is left out.*\.npz or \.glb"):
            save_mesh(bind(cube(), layers=1).mesh, tmp_path / f"prior{suffix}")
        with pytest.raises(ValueError, match="bound to no base"):
            load_prior(tmp_path / f"prior{suffix}")


def archive(path, changes) -> None:
    """``path``, an .npz, with arrays put in place of others; None leaves one out."""
    with np.load(path) as file:
        arrays = dict(file)
    for name, value in changes.items():
        if value is None:
            del arrays[name]
        else:
            arrays[name] = value(arrays[name])
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"binding_weights": None}, "not whole: binding_weights is missing"),
        ({"binding_lift": None}, "not whole: binding_lift is missing"),
        ({"binding_weights": lambda w: w[:-1]}, "array 'binding_weights' has shape"),
        ({"binding_weights": lambda w: w * 2}, "the binding to a base: .*sum 1"),
        ({"binding_weights": lambda w: w - 0.5}, "must not be negative"),
        ({"binding_weights": lambda w: w * np.nan}, "must be finite"),
        ({"binding_base_vertices": lambda x: x[:-1]}, "base_faces must be indices"),
        ({"binding_base_faces": lambda x: x - 1}, "base_faces must be indices"),
        ({"binding_vertex_face": lambda x: x + 32}, "vertex_face must be indices"),
        ({"binding_vertex_face": lambda x: (x + np.arange(len(x)) % 2) % 32}, "bound to one face"),
        ({"binding_vertex_face": lambda x: x.astype(float)}, "must hold integers"),
        ({"binding_layers": lambda x: x - 1}, "layers must be"),
        ({"binding_lift": lambda x: np.array(np.inf)}, "lift must be"),
        ({"binding_lift": lambda x: np.array([0.0])}, "array 'binding_lift' has shape"),
    ],
)
def test_npz_with_a_broken_binding(tmp_path, changes, message):
    path = tmp_path / "prior.npz"
    save_mesh(scattered(), path)
    archive(path, changes)
    with pytest.raises(FileFormatError, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path))


def test_an_npz_that_claims_a_huge_base(tmp_path):
    path = tmp_path / "prior.npz"
    save_mesh(scattered(), path)
    header = b"\x93NUMPY\x01\x00"
    text = b"{'descr': '<f4', 'fortran_order': False, 'shape': (100000000000, 3), }"
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    with zipfile.ZipFile(path) as old:
        members = {n: old.read(n) for n in old.namelist()}
    members["binding_base_vertices.npy"] = header + struct.pack("<H", len(text)) + text
    with zipfile.ZipFile(path, "w") as new:
        for name, data in members.items():
            new.writestr(name, data)
    with pytest.raises(FileFormatError, match="should take"):
        load_mesh(path)


def note_of(document):
    return document["meshes"][0]["extras"]["meshsplats"]["binding"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: note_of(d).update(baseVertexCount=10**9), None),
        (lambda d: note_of(d)["weights"].update(crc32=1), None),
        (lambda d: note_of(d)["layers"].update(bufferView=10**6), None),
        (lambda d: note_of(d).pop("vertexFace"), None),
        (lambda d: note_of(d).update(baseVertexCount=-1), "needs a whole number 'baseVertexCount'"),
        (lambda d: note_of(d).update(lift="high"), "lift of a binding must be 1 numbers"),
        (lambda d: note_of(d).pop("lift"), "lift of a binding must be 1 numbers"),
        (lambda d: note_of(d).update(lift=0.5), "moved vertices"),
    ],
)
def test_glb_with_a_broken_binding(tmp_path, change, message):
    """What another program has dropped is left out with a warning; what cannot be is refused."""
    path = tmp_path / "prior.glb"
    save_mesh(scattered(), path)
    edit_glb(path, change)
    if message is None or message == "moved vertices":
        with pytest.warns(DataWarning, match=message or "ignored: the binding to a base mesh"):
            assert load_mesh(path).binding is None
    else:
        with pytest.raises(FileFormatError, match=message):
            load_mesh(path)


def test_compressed_files_are_for_viewers(tmp_path):
    """Only what this project reads back has the binding; ``write_glb`` without extras does not."""
    from meshsplats.formats.gltf.writer import write_glb

    write_glb(scattered(), tmp_path / "plain.glb", extras=False)
    assert load_mesh(tmp_path / "plain.glb").binding is None
