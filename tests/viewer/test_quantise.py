"""Quantised meshes: what comes back, how exactly, and in how many bytes."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import meshsplats as ms
from meshsplats.cameras.framing import scene_bounds
from meshsplats.demo_scene import make_scene
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewer import quantise
from meshsplats.viewer.packing import FINER, Precision, pack_mesh, pack_splats
from meshsplats.viewer.quantise import PRECISIONS, estimated_bytes, quantise_mesh
from meshsplats.viewer.streams import Packer, Unpacker
from meshsplats.viewer.unpacking import unpack_mesh


def in_order_of_use(mesh: SplatMesh) -> SplatMesh:
    """``mesh`` with its vertices in the order in which its triangles use them, without others."""
    order = list(dict.fromkeys(mesh.faces.ravel().tolist()))
    index = np.zeros(len(mesh.vertices), np.int32)
    index[order] = np.arange(len(order))
    return replace(
        mesh, vertices=mesh.vertices[order], colors=mesh.colors[order], faces=index[mesh.faces], normals=None
    )


def assert_same_but_rounded(back: SplatMesh, mesh: SplatMesh, precision: Precision, radius: float) -> None:
    mesh = in_order_of_use(mesh)
    assert np.array_equal(back.faces, mesh.faces)
    for name in ("face_splat", "depth_group"):
        ours, theirs = getattr(back, name), getattr(mesh, name)
        assert (ours is None) == (theirs is None)
        assert ours is None or np.array_equal(ours, theirs)
    assert (back.blending, back.filter_px2) == (mesh.blending, mesh.filter_px2)
    assert back.order == mesh.order
    assert back.sh_degree == mesh.sh_degree
    assert np.allclose(back.up, mesh.up, atol=1e-6)
    step = max(radius * 2.0**-precision.position, np.ptp(mesh.vertices, axis=0).max() * FINER * 2.0**-31)
    size = float(np.abs(mesh.vertices).max())
    assert np.abs(back.vertices - mesh.vertices.astype(np.float64)).max() <= 0.5001 * step + 3e-7 * size
    errors = np.abs(back.colors.astype(np.float64) - mesh.colors).max(axis=0)
    assert errors[:3].max() <= 0.5001 / (2**precision.color - 1)
    assert errors[3] <= 0.5001 / (2**precision.alpha - 1)


@st.composite
def meshes(draw: st.DrawFn) -> SplatMesh:
    """Fans of a few patterns with noise, soups, or shared vertices; strays, groups and filters."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["fans", "soup", "shared"]))
    faces: list[list[int]] = []
    splat: list[int] = []
    vertices: list[np.ndarray] = []
    noise = draw(st.sampled_from([0.0, 1e-4, 0.3]))
    for i in range(draw(st.sampled_from([1, 3, 80, 150])) if kind == "fans" else 0):
        sides = (3, 5, 8)[i % draw(st.integers(1, 3))]
        first, angles = len(vertices), 2 * np.pi * np.arange(sides) / sides
        center, axes = random.normal(0, 3, 3), random.normal(0, 0.3, (2, 3))
        rim = center + np.cos(angles)[:, None] * axes[0] + np.sin(angles)[:, None] * axes[1]
        vertices += list(np.concatenate([center[None], rim]) + random.normal(0, noise, (sides + 1, 3)))
        faces += [[first, first + 1 + k, first + 1 + (k + 1) % sides] for k in range(sides)]
        splat += [2 * i + 1] * sides
    if kind != "fans":
        count = draw(st.integers(1, 40))
        vertices = list(random.normal(0, 1, (3 * count, 3)))
        most = 3 * count if kind == "soup" else max(3, count // 2)
        faces = random.permutation(3 * count).reshape(-1, 3) % most
        splat = sorted(random.integers(0, 9, count).tolist())
    points = np.array(vertices) * draw(st.sampled_from([1e-3, 1.0, 1e4]))
    if draw(st.booleans()):
        points[-1] *= 1e4  # a stray
    f = len(faces)
    known = draw(st.booleans()) or kind == "fans"
    return SplatMesh(
        points,
        np.array(faces, np.int32).reshape(-1, 3),
        random.uniform(0, 1, (len(points), 4)).astype(np.float32),
        face_splat=np.array(splat, np.int32) if known else None,
        depth_group=random.integers(-1, 4, f).astype(np.int32) if draw(st.booleans()) else None,
        up=random.normal(0, 1, 3),
        blending=draw(st.sampled_from(["display", "linear"])),
        filter_px2=0.3 if known and draw(st.booleans()) else 0.0,
        order="splat" if known and draw(st.booleans()) else "fragment",
    )


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(meshes(), st.sampled_from(PRECISIONS))
def test_meshes_come_back_within_half_a_step(mesh, precision):
    radius = scene_bounds(mesh).radius
    back = unpack_mesh(pack_mesh(mesh, precision, radius))
    assert_same_but_rounded(back, mesh, precision, radius)


def test_stated_errors_are_the_largest_ones():
    mesh = in_order_of_use(ms.convert(make_scene(400)))
    packed = quantise_mesh(mesh)
    back = unpack_mesh(packed.data)
    positions = np.abs(back.vertices.astype(np.float64) - mesh.vertices).max()
    colors = 255 * np.abs(back.colors.astype(np.float64) - mesh.colors)
    assert packed.position_error == positions > 0
    assert packed.relative_error == positions / scene_bounds(mesh).radius
    assert packed.color_error == colors[:, :3].max() > 0
    assert packed.alpha_error == colors[:, 3].max() > 0


def test_fans_of_convert_follow_from_a_few_of_their_vertices():
    """Eight triangles with seven vertices in less than 50 bytes: nothing but bases is stored."""
    packed = quantise_mesh(ms.convert(make_scene(3000)))
    assert packed.precision == PRECISIONS[0]
    assert packed.bytes_a_triangle < 6.5


def test_noisy_fans_take_the_finest_precision_within_the_limit(monkeypatch):
    mesh = ms.convert(make_scene(3000)).of_degree(0)
    random = np.random.default_rng(0)
    vertices = mesh.vertices + random.normal(0, 0.01, mesh.vertices.shape).astype(np.float32)
    colors = np.clip(mesh.colors + random.normal(0, 0.05, mesh.colors.shape), 0, 1).astype(np.float32)
    noisy = replace(mesh, vertices=vertices, colors=colors)
    monkeypatch.setattr(quantise, "SMALL", 0)
    packed = quantise_mesh(noisy)
    assert packed.bytes_a_triangle <= 1.05 * quantise.BYTES_A_TRIANGLE
    finer = PRECISIONS[PRECISIONS.index(packed.precision) - 1]
    data = pack_mesh(noisy, finer, scene_bounds(noisy).radius)
    assert len(data) > 0.95 * quantise.BYTES_A_TRIANGLE * len(noisy.faces)


def test_small_meshes_are_exact_whatever_they_cost():
    random = np.random.default_rng(1)
    faces = np.arange(300, dtype=np.int32).reshape(-1, 3)
    mesh = SplatMesh(random.normal(size=(300, 3)), faces, random.uniform(size=(300, 4)))
    packed = quantise_mesh(mesh)
    assert packed.precision == PRECISIONS[0]
    assert packed.bytes_a_triangle > quantise.BYTES_A_TRIANGLE


def test_a_mesh_without_triangles_is_refused():
    with pytest.raises(ValueError, match="no triangles"):
        quantise_mesh(SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 4))))


# ---- The container


@settings(max_examples=80, deadline=None)
@given(
    st.lists(
        st.lists(st.one_of(st.integers(-3, 3), st.integers(-(2**31) + 1, 2**31 - 1)), max_size=20), max_size=4
    )
)
def test_rows_come_back(rows):
    packer = Packer()
    indices = [packer.add(np.array(row, np.int64)) for row in rows]
    source = Unpacker(packer.finish({"kind": "test"}))
    assert source.header["kind"] == "test"
    assert [source.row(index).tolist() for index in indices] == rows


def test_numbers_beyond_31_bits_are_refused():
    with pytest.raises(ValueError, match="must lie within"):
        Packer().add(np.array([2**31]))


def test_steadily_growing_rows_are_stored_as_differences():
    packer = Packer()
    packer.add(1000 * np.arange(5000))
    assert len(packer.finish({})) < 200


def test_damaged_data_is_refused():
    data = pack_mesh(ms.convert(make_scene(200)), PRECISIONS[0], 1.0)
    body = gzip.decompress(data)
    for broken in (data[:-20], b"nothing", gzip.compress(b"MSplat02" + body[8:]), gzip.compress(body[:-1])):
        with pytest.raises(ValueError, match=r"packed data"):
            unpack_mesh(broken)
    packer = Packer()
    with pytest.raises(ValueError, match="not a mesh"):
        unpack_mesh(packer.finish({"kind": "splats"}))
    with pytest.raises(ValueError, match="cut off"):
        Unpacker(data, most=100)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": [[1, 2]]}, "table of rows"),
        ({"rows": [[1 << 40, 0, 0]]}, "table of rows"),
        ({"rows": None}, "table of rows"),
        ({"vertices": 1 << 40}, "vertices"),
        ({"vertices": None}, "TypeError"),
        ({"patterns": [{"size": 1 << 40, "faces": []}] * 64}, "than there are data"),
        ({"step": None}, "TypeError"),
    ],
)
def test_wrong_headers_are_refused(change, message):
    body = gzip.decompress(pack_mesh(ms.convert(make_scene(200)), PRECISIONS[0], 1.0))
    end = 12 + int.from_bytes(body[8:12], "little")
    text = json.dumps(json.loads(body[12:end]) | change).encode()
    with pytest.raises(ValueError, match=message):
        unpack_mesh(gzip.compress(body[:8] + len(text).to_bytes(4, "little") + text + body[end:]))


def test_the_same_mesh_gives_the_same_bytes():
    mesh = ms.convert(make_scene(200))
    assert quantise_mesh(mesh).data == quantise_mesh(mesh).data


@pytest.mark.slow
def test_the_size_is_estimated_from_a_part():
    cloud = make_scene(40_000)
    mesh = ms.convert(cloud)
    size, beside = len(quantise_mesh(mesh).data), len(pack_splats(cloud))
    assert estimated_bytes(mesh) == pytest.approx(size, rel=0.1)
    assert estimated_bytes(mesh, cloud) == pytest.approx(size + beside, rel=0.1)
    alone = replace(mesh, face_splat=None, harmonics=None)
    assert estimated_bytes(alone) == pytest.approx(len(quantise_mesh(alone).data), rel=0.1)
    assert quantise._in_runs(np.arange(len(cloud))).mean() < 0.4


# Spherical harmonics


def shiny(degree: int) -> SplatMesh:
    """Splats with harmonics of very different sizes, and colours above 1."""
    cloud = make_scene(400)
    random = np.random.default_rng(degree)
    sh = random.normal(0, 0.1, (len(cloud), (degree + 1) ** 2, 3))
    sh[:, 0] = random.normal(0, 1, (len(cloud), 3)) + 1
    sh[0, 1, 0] = 8
    mesh = ms.convert(replace(cloud, sh=sh))
    assert mesh.sh_degree == degree
    assert mesh.colors.max() > 1.5
    return mesh


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_have_eight_bits_and_large_ones_stay(degree):
    mesh = shiny(degree)
    precision, radius = PRECISIONS[2], scene_bounds(mesh).radius
    back = unpack_mesh(pack_mesh(mesh, precision, radius))
    assert_same_but_rounded(back, mesh, precision, radius)
    usual = np.quantile(np.abs(mesh.harmonics), 0.999)
    assert np.abs(back.harmonics - mesh.harmonics).max() <= 0.5001 * usual / 127
    assert usual < 3 < np.abs(back.harmonics).max()


def test_harmonics_neither_change_what_else_is_stored_nor_cost_more_than_a_byte():
    mesh = shiny(2)
    with_them, without = quantise_mesh(mesh), quantise_mesh(replace(mesh, harmonics=None))
    assert with_them.precision == without.precision
    for name in ("vertices", "colors", "faces", "face_splat"):
        assert np.array_equal(getattr(with_them.decoded, name), getattr(without.decoded, name))
    assert b"harmonics" not in gzip.decompress(without.data)
    added = len(with_them.data) - len(without.data)
    assert 0.5 * mesh.harmonics.size < added < 1.05 * mesh.harmonics.size
    assert estimated_bytes(mesh) > estimated_bytes(replace(mesh, harmonics=None)) + 0.5 * mesh.harmonics.size


def test_harmonics_of_zero_and_of_a_single_splat():
    mesh = shiny(1).take(slice(8))
    for harmonics in (np.zeros((1, 3, 3)), np.full((1, 3, 3), -2.5)):
        back = quantise_mesh(replace(mesh, harmonics=harmonics)).decoded
        assert np.abs(back.harmonics - harmonics).max() <= 0.5001 * 2.5 / 127
