"""Files that list triangles twice, for viewers that cull: the mesh comes back without copies."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from _glb import read_glb, write_glb
from _meshes import assert_same, random_mesh
from hypothesis import given
from hypothesis import strategies as st

from meshsplats import DataWarning, FileFormatError, SplatMesh, load_mesh, save_mesh
from meshsplats.formats.gltf import copies
from meshsplats.formats.gltf.reader import listed_order
from meshsplats.formats.meshes import expected_bytes
from meshsplats.scene.draw_order import DrawOrder


def random_order(rng, f: int, nodes: int) -> DrawOrder:
    node = np.unique(rng.integers(0, nodes, f), return_inverse=True)[1].reshape(-1)
    of_copy = np.tile(node, 2)
    listed = np.lexsort((rng.random(2 * f), of_copy))
    return DrawOrder(listed, np.searchsorted(of_copy[listed], np.arange(node.max() + 2)))


@given(seed=st.integers(0, 2**32 - 1), nodes=st.integers(1, 5), extras=st.booleans())
def test_the_mesh_is_that_of_a_file_without_copies(tmp_path_factory, seed, nodes, extras):
    """Among random triangles are some without area, some twice, and vertices that no triangle has."""
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng, *rng.integers(3, 40, 2), extras=extras)
    folder = tmp_path_factory.mktemp("ordered")
    order = random_order(rng, len(mesh.faces), nodes)
    save_mesh(mesh, folder / "ordered.glb", order=order)
    found = listed_order(folder / "ordered.glb", mesh)
    if found is not None:  # a triangle that is there twice may be in two nodes
        np.testing.assert_array_equal(found.listed(mesh.faces), order.listed(mesh.faces))
        np.testing.assert_array_equal(found.starts, order.starts)
    save_mesh(mesh, folder / "blend.glb", alpha="blend")
    got, plain = load_mesh(folder / "ordered.glb"), load_mesh(folder / "blend.glb")
    assert_same(got, plain)
    assert_same(got, mesh, 1 / 10_000)
    save_mesh(got, folder / "again.glb", alpha="blend")
    assert (folder / "again.glb").read_bytes() == (folder / "blend.glb").read_bytes()


def test_the_origin_stays(tmp_path):
    rng = np.random.default_rng(1)
    mesh = random_mesh(rng, 12, 20)
    far = SplatMesh(mesh.vertices, mesh.faces, mesh.colors, up=mesh.up, origin=(3e6, -2e5, 7))
    for nodes in (1, 3):
        save_mesh(far, tmp_path / "far.glb", order=random_order(rng, 20, nodes))
        assert_same(load_mesh(tmp_path / "far.glb"), far, 1 / 10_000)


@pytest.fixture(name="ordered", params=[1, 3])
def ordered_fixture(request, tmp_path):
    rng = np.random.default_rng(2)
    mesh = random_mesh(rng, 30, 40)
    save_mesh(mesh, tmp_path / "ordered.glb", order=random_order(rng, 40, request.param))
    return mesh, tmp_path / "ordered.glb"


def test_the_order_is_read_again(ordered, tmp_path):
    mesh, path = ordered
    order = listed_order(path, load_mesh(path))
    assert order is not None
    save_mesh(load_mesh(path), tmp_path / "again.glb", order=order)
    assert (tmp_path / "again.glb").read_bytes() == path.read_bytes()
    save_mesh(mesh, tmp_path / "blend.glb", alpha="blend")
    assert listed_order(tmp_path / "blend.glb", mesh) is None


def test_every_triangle_is_there_with_both_windings(ordered):
    mesh, path = ordered
    document, rest = read_glb(path)
    assert [m["doubleSided"] for m in document["materials"]] == [False]
    count = sum(document["accessors"][m["primitives"][0]["indices"]]["count"] for m in document["meshes"])
    assert count == 2 * 3 * len(mesh.faces)
    nodes = document["meshes"][0]["extras"]["meshsplats"]["copies"]["nodes"]
    assert nodes == len(document["meshes"])
    assert len(rest) > 0


ALTERED = ["indices", "turned", "offset", "vertex", "one primitive less", "nodes"]


@pytest.mark.parametrize("what", ALTERED)
def test_copies_that_do_not_match_are_an_error(ordered, what):
    """Any altered byte of what tells them apart, or a triangle that has no partner."""
    _, path = ordered
    document, rest = read_glb(path)
    note = document["meshes"][0]["extras"]["meshsplats"]["copies"]
    binary = bytearray(rest)
    message = "each triangle is there twice"
    if what == "indices":
        accessor = document["accessors"][document["meshes"][-1]["primitives"][0]["indices"]]
        at = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        binary[at : at + 2], binary[at + 2 : at + 4] = binary[at + 2 : at + 4], binary[at : at + 2]
        if binary == rest:
            pytest.skip("the first two corners are one vertex")
    elif what in ("turned", "offset", "vertex"):
        if what not in note:
            pytest.skip("one node has no list of vertices")
        binary[document["bufferViews"][note[what]["bufferView"]]["byteOffset"]] ^= 1
    elif what == "nodes":
        note["nodes"] = "many"
        if len(document["meshes"]) > 1:
            pytest.skip("read as the file of another program")
    else:
        accessor = document["accessors"][document["meshes"][0]["primitives"][0]["indices"]]
        accessor["count"] -= 3
    write_glb(path, document, bytes(binary))
    if what == "nodes":
        assert_same(load_mesh(path), ordered[0], 1 / 10_000)
        return
    with pytest.raises(FileFormatError, match=message):
        load_mesh(path)


def test_a_mesh_that_was_moved_has_no_copies_either(ordered):
    """Another program may place the nodes elsewhere."""
    mesh, path = ordered
    document, rest = read_glb(path)
    document["nodes"][0]["scale"] = [2, 2, 2]
    write_glb(path, document, rest)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        moved = load_mesh(path)
    assert len(moved.faces) == len(mesh.faces)
    sides = [np.linalg.norm(m.vertices - m.vertices[0], axis=1) for m in (moved, mesh)]
    np.testing.assert_allclose(sides[0], 2 * sides[1], rtol=1e-4)


def test_fans_need_a_byte_a_triangle_and_one_bit():
    ring = [(0, 1 + i, 1 + (i + 1) % 8) for i in range(8)]
    faces = np.concatenate([np.array(ring) + 9 * k for k in range(50)]).astype(np.int32)
    own = copies.own_triangles(faces)
    assert (own.offset.dtype, own.turned.nbytes) == (np.int8, 50)
    assert not own.offset.any()
    shuffled = faces[np.random.default_rng(0).permutation(len(faces))]
    assert copies.own_triangles(shuffled).offset.dtype == np.int32


def test_what_copies_do_not_go_with(tmp_path):
    mesh = random_mesh(np.random.default_rng(3), 9, 12)
    order = random_order(np.random.default_rng(3), 12, 1)
    path = tmp_path / "m.glb"
    for options in ({"alpha": "mask"}, {"alpha": "hybrid"}, {"lit": True}):
        with pytest.raises(ValueError, match="for alpha='blend' and an unlit material"):
            save_mesh(mesh, path, order=order, **options)
    with pytest.raises(ValueError, match="leave out order or compression"):
        save_mesh(mesh, path, order=order, compression="meshopt")
    with pytest.raises(ValueError, match=r"order applies to \.glb only"):
        save_mesh(mesh, path.with_suffix(".npz"), order=order)
    with pytest.raises(ValueError, match="the order is of 11 triangles, the mesh has 12"):
        save_mesh(mesh, path, order=random_order(np.random.default_rng(3), 11, 1))
    assert not path.exists()


def test_the_size_is_expected(tmp_path):
    rng = np.random.default_rng(4)
    mesh = random_mesh(rng, 30_000, 30_000, extras=False)
    save_mesh(mesh, tmp_path / "m.glb", order=random_order(rng, 30_000, 1))
    size = (tmp_path / "m.glb").stat().st_size
    assert abs(expected_bytes(mesh, ".glb", copies=True) - size) < 0.15 * size
