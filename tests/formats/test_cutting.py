"""Triangles cut where their opacity crosses a cutoff, and the files that hold them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from _glb import read_glb
from _meshes import assert_same, random_mesh
from _rendering import FLIPS, camera, grid_faces, soup, turned
from _zbuffer import zbuffer
from hypothesis import given, settings
from hypothesis import strategies as st
from test_mesh_bytes import SQUARE, values

from meshsplats import SplatMesh, cut_mesh, load_mesh, save_mesh
from meshsplats.rendering import render

FEW = settings(max_examples=12)
seeds = st.integers(0, 10_000)
cutoffs = st.sampled_from([0.0, 0.05, 0.2, 0.5, 0.95, 1.0])


def triangle(*opacities: float, **more) -> SplatMesh:
    """The corners (0, 0), (4, 0) and (0, 4), with red, green and blue."""
    colors = np.column_stack([np.eye(3), opacities])
    return SplatMesh([(0, 0, 1), (4, 0, 1), (0, 4, 1)], [(0, 1, 2)], colors, **more)


def bumpy(seed: int, *, shared: bool = True) -> SplatMesh:
    """A grid of triangles with opacities that go up and down."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-1, 1, 14), np.linspace(-1, 1, 12))
    points = np.stack([x, y, 3 + 0.2 * rng.normal(size=x.shape)], axis=-1).reshape(-1, 3)
    colors = rng.random((len(points), 4))
    mesh = SplatMesh(points, grid_faces(12, 14), colors)
    if shared:
        return mesh
    own = np.random.default_rng(seed).permutation(mesh.faces.size)  # each corner its own vertex, in any order
    corners = mesh.faces.ravel()[own]
    return SplatMesh(mesh.vertices[corners], np.argsort(own).reshape(-1, 3), mesh.colors[corners])


def corner_sets(mesh: SplatMesh) -> set[frozenset[tuple[float, ...]]]:
    return {frozenset(map(tuple, mesh.vertices[face].tolist())) for face in mesh.faces}


def area(mesh: SplatMesh) -> float:
    a, b, c = mesh.vertices.astype(np.float64)[mesh.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def side(mesh: SplatMesh) -> np.ndarray:
    a, b, c = mesh.vertices.astype(np.float64)[mesh.faces].transpose(1, 0, 2)
    return np.sign(np.cross(b - a, c - a)[:, 2])


# Worked out by hand


def test_one_opaque_corner_leaves_a_triangle():
    cut = cut_mesh(triangle(1, 0, 0.5), 0.75)
    assert corner_sets(cut) == {frozenset({(0, 0, 1), (1, 0, 1), (0, 2, 1)})}
    by_place = {tuple(p): tuple(c) for p, c in zip(cut.vertices.tolist(), cut.colors.tolist(), strict=True)}
    assert by_place == {
        (0, 0, 1): (1, 0, 0, 1),
        (1, 0, 1): (0.75, 0.25, 0, 1),
        (0, 2, 1): (0.5, 0, 0.5, 1),
    }


def test_two_opaque_corners_leave_a_quadrilateral():
    cut = cut_mesh(triangle(0, 1, 1), 0.5)
    assert len(cut.faces) == 2
    assert {tuple(p) for p in cut.vertices.tolist()} == {(2, 0, 1), (4, 0, 1), (0, 4, 1), (0, 2, 1)}
    assert area(cut) == 6
    assert (side(cut) > 0).all()


def test_whole_triangles_stay_and_faint_ones_go():
    cut = cut_mesh(triangle(0.5, 0.6, 0.7), 0.5)
    assert corner_sets(cut) == corner_sets(triangle(1, 1, 1))
    assert len(cut_mesh(triangle(0.4, 0.3, 0.2), 0.5).faces) == 0
    assert len(cut_mesh(triangle(0, 0, 0), 0).faces) == 1


@pytest.mark.parametrize("opacities", [(0.5, 0.1, 0.2), (0.5, 0.5, 0.2)])
def test_touching_the_cutoff_leaves_no_sliver(opacities):
    assert len(cut_mesh(triangle(*opacities), 0.5).faces) == 0


def test_a_cut_through_a_corner_leaves_one_triangle():
    cut = cut_mesh(triangle(0, 0.5, 1), 0.5)
    assert corner_sets(cut) == {frozenset({(4, 0, 1), (0, 4, 1), (0, 2, 1)})}


def test_further_arrays_follow():
    normals = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    mesh = triangle(1, 0, 0, normals=normals, face_splat=[7], depth_group=[3], attributes={"u": [0, 4, 8]})
    cut = cut_mesh(mesh, 0.5)
    found = {tuple(p): i for i, p in enumerate(cut.vertices.tolist())}
    assert cut.attributes["u"][[found[0, 0, 1], found[2, 0, 1], found[0, 2, 1]]].tolist() == [0, 2, 4]
    np.testing.assert_allclose(cut.normals[found[2, 0, 1]], np.array([1, 1, 0]) / np.sqrt(2), atol=1e-6)
    assert cut.face_splat.tolist() == [7]
    assert cut.depth_group.tolist() == [3]
    quad = cut_mesh(replace(mesh, colors=triangle(0, 1, 1).colors), 0.5)
    assert quad.face_splat.tolist() == [7, 7]


# Laws


@FEW
@given(seed=seeds, cutoff=cutoffs)
def test_the_cut_mesh_is_the_image_with_the_cutoff(seed, cutoff):
    view = turned(camera(), seed)
    mesh = soup(seed, view=view)
    cut = cut_mesh(mesh, cutoff)
    assert (cut.colors[:, 3] == 1).all()
    one, two = (
        render(cut, view, samples=2, depth=True),
        render(mesh, view, samples=2, depth=True, cutoff=cutoff),
    )
    wrong = np.abs(one.color - two.color).max(axis=2) > 1e-4
    wrong |= np.abs(one.alpha - two.alpha) > 1e-6
    assert wrong.mean() <= 10 * FLIPS


@FEW
@given(seed=seeds, cutoff=cutoffs, shared=st.booleans())
def test_cuts_meet_along_shared_edges(seed, cutoff, shared):
    mesh = bumpy(seed, shared=shared)
    cut = cut_mesh(mesh, cutoff)
    level = np.float32(cutoff)
    opacities = {tuple(p): a for p, a in zip(mesh.vertices.tolist(), mesh.colors[:, 3], strict=True)}
    edges: Counter[tuple[tuple[float, ...], tuple[float, ...]]] = Counter()
    for face in cut.faces:
        corners = [tuple(p) for p in cut.vertices[face].tolist()]
        for k in range(3):
            edges[corners[k], corners[(k + 1) % 3]] += 1
    assert set(edges.values()) <= {1}
    for a, b in edges:
        if (b, a) in edges:
            continue
        # An open edge lies along the cut, or on the border of the grid.
        on_cut = all(p not in opacities or opacities[p] == level for p in (a, b))
        on_border = (abs(a[0]) == 1 and a[0] == b[0]) or (abs(a[1]) == 1 and a[1] == b[1])
        assert on_cut or on_border


@FEW
@given(seed=seeds, cutoff=cutoffs)
def test_areas_and_winding_are_those_of_the_opaque_part(seed, cutoff):
    mesh = bumpy(seed)
    a = mesh.colors.astype(np.float64)
    a[:, 3] = 1 - a[:, 3]
    rest = replace(mesh, colors=a)
    if 0 < cutoff < 1:
        # What is at least as opaque as the cutoff, and what is less, make the whole.
        both = area(cut_mesh(mesh, cutoff)) + area(cut_mesh(rest, 1 - cutoff))
        assert both == pytest.approx(area(mesh), rel=1e-5)
    assert set(side(cut_mesh(mesh, cutoff))) <= set(side(mesh))


@FEW
@given(seed=seeds, cutoff=cutoffs)
def test_a_cut_mesh_stays_as_it_is(seed, cutoff):
    cut = cut_mesh(soup(seed), cutoff)
    assert_same(cut_mesh(cut, 0.5), cut)


def test_every_extra_array_survives():
    mesh = random_mesh(np.random.default_rng(4), 30, 60)
    cut = cut_mesh(mesh, 0.4)
    assert len(cut.faces) > 20
    assert cut.attributes.keys() == mesh.attributes.keys()
    whole = replace(mesh, colors=np.column_stack([mesh.colors[:, :3], np.ones(30)]))
    assert_same(cut_mesh(whole, 0.4), whole.take(np.ones(60, bool)))


@pytest.mark.parametrize("cutoff", [-0.1, 1.5, np.nan])
def test_a_cutoff_is_an_opacity(cutoff):
    with pytest.raises(ValueError, match="cutoff must be an opacity from 0 to 1"):
        cut_mesh(SQUARE, cutoff)


def test_a_mesh_with_a_filter_is_refused():
    with pytest.raises(ValueError, match="bake_filter"):
        cut_mesh(replace(SQUARE, filter_px2=0.3), 0.5)


# Files


@pytest.mark.parametrize("suffix", ["glb", "ply", "npz", "obj", "usdc"])
def test_a_z_buffer_draws_the_file_as_the_cutoff_says(tmp_path, suffix, recwarn):
    if suffix == "usdc":
        pytest.importorskip("pxr")
    view = camera()
    mesh = soup(8, spread=(1.0, 1.0, 0.4), z=3)
    path = tmp_path / f"m.{suffix}"
    save_mesh(mesh, path, alpha="opaque", cutoff=0.4)
    assert not recwarn.list
    again = load_mesh(path)
    assert (again.colors[:, 3] == 1).all()
    color, alpha, _ = zbuffer(again, view, samples=2)
    expected = render(mesh, view, cutoff=0.4, samples=2)
    wrong = np.abs(color - expected.color).max(axis=2) > 2e-3
    assert (wrong | (np.abs(alpha - expected.alpha) > 1e-6)).mean() <= 10 * FLIPS


def test_an_opaque_glb_has_a_plain_material(tmp_path):
    save_mesh(SQUARE, tmp_path / "m.glb", alpha="opaque", cutoff=0.25)
    document, binary = read_glb(tmp_path / "m.glb")
    (material,) = document["materials"]
    assert material["alphaMode"] == "OPAQUE"
    assert "alphaCutoff" not in material
    colors = values(document, binary, document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    assert {c[3] for c in colors} == {65535}
    save_mesh(SQUARE, tmp_path / "m.glb", alpha="mask", cutoff=0.35)
    assert read_glb(tmp_path / "m.glb")[0]["materials"][0]["alphaCutoff"] == 0.35


def test_an_opaque_usd_surface_has_no_opacity(tmp_path):
    usd = pytest.importorskip("pxr.Usd")
    for alpha, connected in ((None, True), ("opaque", False)):
        save_mesh(SQUARE, tmp_path / f"{alpha}.usda", alpha=alpha)
        stage = usd.Stage.Open(str(tmp_path / f"{alpha}.usda"))
        assert stage.GetPrimAtPath("/Splats/Material/Surface").HasAttribute("inputs:opacity") == connected


def test_cutoffs_without_effect_are_refused(tmp_path):
    for alpha in (None, "blend"):
        with pytest.raises(ValueError, match="cutoff needs alpha"):
            save_mesh(SQUARE, tmp_path / "m.glb", alpha=alpha, cutoff=0.3)
    with pytest.raises(ValueError, match="cutoff must be an opacity"):
        save_mesh(SQUARE, tmp_path / "m.glb", alpha="mask", cutoff=2)
    assert not list(tmp_path.iterdir())


def test_a_mesh_without_translucency_needs_no_option(tmp_path):
    save_mesh(cut_mesh(SQUARE, 0.25), tmp_path / "m.glb")
    assert read_glb(tmp_path / "m.glb")[0]["materials"][0]["alphaMode"] == "OPAQUE"
    save_mesh(cut_mesh(SQUARE, 0.25), tmp_path / "m.glb", alpha="blend")
    assert read_glb(tmp_path / "m.glb")[0]["materials"][0]["alphaMode"] == "BLEND"
