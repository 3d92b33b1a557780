"""take, with_faces, joined, moved: they carry every array of a mesh, or say what does not fit."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from _priors import bumpy
from _rendering import splats

from meshsplats import Camera, SplatMesh, convert, look_at, render
from meshsplats.errors import DataWarning
from meshsplats.prior.laying import bind
from meshsplats.prior.model import MeshPrior
from meshsplats.scene.binding import ArrayField, Binding

LENGTHS = (2, 3, 1, 4)
"""Triangles of four splats."""


@dataclass(frozen=True, eq=False)
class Shining(SplatMesh):
    """A mesh with one more array, a row for each splat: a declaration is all that it takes."""

    shine: np.ndarray | None = None

    FIELDS: ClassVar[tuple[ArrayField, ...]] = (
        *SplatMesh.FIELDS,
        ArrayField("shine", np.float32, "splat", 2, optional=True),
    )


def fans(seed: int = 0, **changed) -> Shining:
    """Four fans with everything that a mesh can have, but a binding; splats 3, 4, 8 and 11."""
    rng = np.random.default_rng(seed)
    faces, first = [], 0
    for n in LENGTHS:
        faces += [(first, first + k + 1, first + k + 2) for k in range(n)]
        first += n + 2
    given = {
        "vertices": rng.normal((0, 0, 6), size=(first, 3)),
        "faces": np.array(faces),
        "colors": rng.random((first, 4)),
        "face_splat": np.repeat([3, 4, 8, 11], LENGTHS),
        "normals": unit(rng.normal(size=(first, 3))),
        "depth_group": np.repeat([2, -1, 0, 1], LENGTHS),
        "attributes": {"heat": rng.random(first), "flow": rng.random((first, 2))},
        "shine": rng.random((len(LENGTHS), 2)),
        "filter_px2": 0.3,
    }
    return Shining(**(given | changed))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def by_corner(mesh: SplatMesh) -> dict[str, np.ndarray]:
    """What each triangle has, at its corners and as a whole; vertices may be numbered in any way."""
    owner = mesh.splats.of_face
    found = {f.name: getattr(mesh, f.name) for f in mesh.FIELDS if f.name not in ("faces", "up")}
    rows = {
        f.name: {"vertex": mesh.faces, "face": slice(None), "splat": owner}.get(f.per) for f in mesh.FIELDS
    }
    arrays = {name: value[rows[name]] for name, value in found.items() if value is not None}
    return arrays | {name: value[mesh.faces] for name, value in mesh.attributes.items()}


def assert_same(one: dict[str, np.ndarray], two: dict[str, np.ndarray], but: tuple[str, ...] = ()) -> None:
    assert one.keys() == two.keys()
    for name in one.keys() - set(but):
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def turn(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.linalg.det(q)


def view() -> Camera:
    return Camera(np.eye(4), 60, 60, 24, 20, 48, 40, 0.1)


# ---- take


@pytest.mark.parametrize(
    "chosen",
    [
        np.array([0, 0, 1, 0, 1, 1, 0, 0, 0, 1], bool),
        np.array([1, 0, 3, 5, 9, 6]),
        np.array([-1, -2]),
        slice(2, 7),
        slice(0),
    ],
    ids=["mask", "indices", "from the end", "slice", "nothing"],
)
def test_take_carries_everything_of_the_chosen_triangles(chosen):
    mesh = fans()
    taken = mesh.take(chosen)
    assert_same(by_corner(taken), {name: value[chosen] for name, value in by_corner(mesh).items()})
    assert len(np.unique(taken.faces)) == len(taken.vertices)
    assert (taken.filter_px2, taken.blending) == (mesh.filter_px2, mesh.blending)
    assert replace(mesh, order="splat").take(chosen).order == "splat"


def test_take_of_all_has_the_same_bits_and_drops_unused_vertices():
    mesh = fans()
    for chosen in (slice(None), np.ones(10, bool), np.arange(10)):
        taken = mesh.take(chosen)
        for name, value in mesh.arrays().items():
            np.testing.assert_array_equal(taken.arrays()[name], value)
    lonely = replace(mesh, **mesh.rows(vertex=np.append(np.arange(len(mesh.vertices)), [0, 0])))
    assert len(lonely.vertices) == len(mesh.vertices) + 2
    assert len(lonely.take(slice(None)).vertices) == len(mesh.vertices)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (np.ones(9, bool), r"a mask of triangles must have shape \(10,\), got \(9,\)"),
        (np.array([0, 10]), "indices of 10 triangles, got 0 to 10"),
        (np.array([0.0]), "chosen by a mask, a slice or indices"),
        (np.array([9, 0]), "face_splat must be ascending"),
    ],
)
def test_what_take_cannot_do(chosen, message):
    with pytest.raises(ValueError, match=message):
        fans(shine=None).take(chosen)


def test_a_mesh_without_splats_is_taken_in_any_order():
    mesh = fans(face_splat=None, filter_px2=0, shine=None)
    assert_same(
        by_corner(mesh.take([9, 0])), {name: value[[9, 0]] for name, value in by_corner(mesh).items()}
    )


def test_other_triangles_have_the_splats_of_those_that_they_come_from():
    mesh = fans()
    source = np.array([0, 2, 2, 9])
    changed = mesh.with_faces(mesh.faces[source][:, [1, 0, 2]], source)
    assert changed.face_splat.tolist() == [3, 4, 4, 11]
    assert changed.depth_group.tolist() == [2, -1, -1, 1]
    np.testing.assert_array_equal(changed.shine, mesh.shine[[0, 1, 3]])
    np.testing.assert_array_equal(
        changed.vertices[changed.faces], mesh.vertices[mesh.faces[source]][:, [1, 0, 2]]
    )
    assert mesh.vertices_of(source).sum() == len(changed.vertices)


# ---- an array for each splat


def test_an_array_of_splats_that_an_edit_forgets_is_refused():
    mesh = fans()
    with pytest.raises(ValueError, match=r"shine must have shape \(3, 2\), got \(4, 2\)"):
        replace(mesh, face_splat=np.repeat([3, 4, 8], [5, 1, 4]))
    with pytest.raises(ValueError, match="shine has a row for each splat: give face_splat, too"):
        replace(mesh, face_splat=None, filter_px2=0)
    assert mesh.take(mesh.face_splat != 4).shine.tolist() == mesh.shine[[0, 2, 3]].tolist()
    assert Shining.from_arrays(mesh.arrays()).shine is mesh.shine


# ---- joined


def test_joined_meshes_have_all_triangles_and_splats_of_their_own():
    one, two = fans(0), fans(1)
    both = SplatMesh.joined([one, two])
    parts = [by_corner(one), by_corner(two)]
    assert_same(
        by_corner(both),
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        but=("face_splat", "depth_group"),
    )
    assert both.face_splat.tolist() == np.repeat(np.arange(8), LENGTHS * 2).tolist()
    assert both.depth_group.tolist() == np.repeat([2, -1, 0, 1, 5, -1, 3, 4], LENGTHS * 2).tolist()
    np.testing.assert_array_equal(both.shine, np.concatenate([one.shine, two.shine]))


@pytest.mark.parametrize("same_splats", [False, True])
def test_a_mesh_that_is_divided_and_joined_is_drawn_as_before(same_splats):
    mesh = fans(depth_group=None)
    odd = np.isin(mesh.face_splat, [4, 11])
    both = SplatMesh.joined([mesh.take(odd), mesh.take(~odd)], same_splats=same_splats)
    if same_splats:
        assert_same(by_corner(both), by_corner(mesh))
    one, two = (render(m, view(), samples=2, depth=True, attributes=("heat",)) for m in (mesh, both))
    np.testing.assert_allclose(one.color, two.color, atol=1e-6)
    np.testing.assert_allclose(one.attributes["heat"], two.attributes["heat"], atol=1e-6)
    assert np.ptp(one.color) > 0.1


def test_triangles_of_one_splat_in_two_parts_come_together():
    mesh = fans()
    halves = [mesh.take(slice(0, None, 2)), mesh.take(slice(1, None, 2))]
    both = SplatMesh.joined(halves, same_splats=True)
    order = np.lexsort([np.arange(10) // 2, np.arange(10) % 2, mesh.face_splat])
    assert_same(
        by_corner(both), {name: value[order] for name, value in by_corner(mesh).items()}, but=("depth_group",)
    )


def test_joined_meshes_far_apart_keep_their_detail():
    one, two = fans(0, origin=(4e6, 0, 0)), fans(1, origin=(4e6 + 64, 0, 0))
    both = SplatMesh.joined([one, two])
    assert both.origin.tolist() == [4e6, 0, 0]
    np.testing.assert_array_equal(both.vertices[len(one.vertices) :], two.vertices + np.float32([64, 0, 0]))
    with pytest.warns(DataWarning, match="vertices near -4000000 0 .* steps of 0.25 .* precision is lost"):
        assert SplatMesh.joined([fans(), one]).origin.tolist() == [4e6, 0, 0]


def test_a_far_move_goes_to_the_origin():
    mesh, far, matrix = fans(), np.array([5e5, 4.5e6, 100]), np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn(0), far
    moved = mesh.transformed(matrix)
    assert_same(by_corner(moved), by_corner(mesh.transformed(turn(0))))
    np.testing.assert_array_equal(moved.origin, far)
    nearby = mesh.transformed(matrix, origin=far + np.array([1, 0, 0]))
    np.testing.assert_allclose(nearby.vertices, moved.vertices - np.float32([1, 0, 0]), atol=1e-5)
    back = moved.transformed(np.linalg.inv(matrix), origin=[0, 0, 0])
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-5)
    with pytest.warns(DataWarning, match="vertices near 499994 4500002 .* \\(origin\\), they keep it"):
        mesh.transformed(matrix, origin=[0, 0, 0])
    with pytest.warns(DataWarning, match="vertices near 500000 4500000 .* steps of 0.5"):
        mesh.moved(mesh.vertices + far)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"blending": "linear"}, "the same blending: 'display' first, 'linear' in parts.1."),
        ({"filter_px2": 0.0}, "the same filter_px2: 0.3 first, 0.0 in parts.1."),
        ({"order": "splat"}, "the same order: 'fragment' first, 'splat' in parts.1."),
        ({"up": (0, 0, 1)}, r"about the same up: .* in parts.1."),
        ({"normals": None}, "normals is 3 numbers wide first, missing in parts.1."),
        ({"attributes": {}}, "attribute 'flow' is 2 numbers wide first, missing in parts.1."),
        ({"shine": None}, "shine is 2 numbers wide first, missing in parts.1."),
    ],
)
def test_meshes_that_differ_are_not_joined(changed, message):
    with pytest.raises(ValueError, match=message):
        SplatMesh.joined([fans(), fans(**changed)])


def test_joined_meshes_may_be_tilted_and_of_other_degrees():
    tilted = fans(up=(np.sin(0.3), -np.cos(0.3), 0))
    np.testing.assert_array_equal(SplatMesh.joined([fans(), tilted]).up, fans().up)
    harmonics = np.random.default_rng(0).random((len(fans().splats), 8, 3), np.float32)
    parts = fans(), fans(harmonics=harmonics[:, :3]), fans(harmonics=harmonics)
    joined = SplatMesh.joined(parts).harmonics
    n = len(harmonics)
    assert joined.shape == (3 * n, 8, 3)
    assert not joined[:n].any()
    np.testing.assert_array_equal(joined[n : 2 * n, :3], harmonics[:, :3])
    assert not joined[n : 2 * n, 3:].any()
    np.testing.assert_array_equal(joined[2 * n :], harmonics)


def test_nothing_cannot_be_joined_and_one_mesh_is_itself():
    with pytest.raises(ValueError, match="at least one mesh"):
        SplatMesh.joined([])
    mesh = fans()
    alone = SplatMesh.joined([mesh], same_splats=True)
    for name, value in mesh.arrays().items():
        np.testing.assert_array_equal(alone.arrays()[name], value)
    assert SplatMesh.joined([mesh]).face_splat.tolist() == mesh.splats.of_face.tolist()


def test_a_part_without_depth_groups_has_none():
    both = SplatMesh.joined([fans(depth_group=None), fans()])
    assert both.depth_group.tolist() == [-1] * 10 + fans().depth_group.tolist()


def bound() -> SplatMesh:
    return bind(bumpy(3), triangles=2, layers=2).mesh


def test_meshes_on_one_base_stay_bound_to_it():
    mesh = bound()
    rest = mesh.face_splat > mesh.face_splat[-1] // 2
    both = SplatMesh.joined([mesh.take(~rest), mesh.take(rest)], same_splats=True)
    assert_same(by_corner(both), by_corner(mesh), but=("depth_group",))
    np.testing.assert_array_equal(both.binding.positions()[both.faces], mesh.binding.positions()[mesh.faces])
    assert isinstance(both.binding, Binding)
    moved = replace(mesh, binding=mesh.binding.moved(mesh.binding.base_vertices + 1, 0.0))
    with pytest.raises(ValueError, match="bases that differ"):
        SplatMesh.joined([mesh, moved])


# ---- moved


def test_normals_turn_with_their_splats():
    mesh, rotation = fans(), turn(3)
    moved = mesh.moved((mesh.vertices - 1) @ rotation.T + 5)
    np.testing.assert_allclose(moved.normals, mesh.normals @ rotation.T, atol=1e-5)
    np.testing.assert_array_equal(moved.shine, mesh.shine)


def test_each_splat_turns_on_its_own():
    mesh = fans()
    vertices, normals = mesh.vertices.copy(), mesh.normals.copy()
    own = mesh.splats.of_vertex == 1
    vertices[own] = vertices[own] @ turn(1).T
    normals[own] = normals[own] @ turn(1).T
    moved = mesh.moved(vertices)
    np.testing.assert_allclose(moved.normals, normals, atol=1e-5)
    assert np.abs(normals - mesh.normals).max() > 0.1


def test_a_vertex_of_two_triangles_takes_the_mean_of_their_turns():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0]], float)
    flat = SplatMesh(corners, [[0, 1, 2], [0, 2, 3]], np.ones((4, 4)), normals=np.tile([0, 0, 1.0], (4, 1)))
    folded = corners.copy()
    folded[3] = [0, 0, -1]  # a quarter turn about y
    found = flat.moved(folded).normals
    half = np.sqrt(0.5)
    np.testing.assert_allclose(found, [[-half, 0, half], [0, 0, 1], [-half, 0, half], [-1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_splats_on_a_line_turn_no_more_than_they_must(seed):
    rng = np.random.default_rng(seed)
    (a, b), normals = unit(rng.normal(size=(2, 3))), rng.normal(size=(4, 3))
    along = np.array([0, 1, 3, 7.0])[:, None]
    line = SplatMesh(along * a, [[0, 1, 2]], np.ones((4, 4)), normals=normals)
    axis = np.cross(a, b)
    # The shortest rotation from a to b, of Rodrigues' formula; the last vertex has no triangle.
    wanted = normals * (a @ b) + np.cross(axis, normals) + np.outer(normals @ axis, axis) / (1 + a @ b)
    np.testing.assert_allclose(line.moved(along * b).normals[:3], wanted[:3], atol=1e-4)
    np.testing.assert_allclose(line.moved(along * b).normals[3], normals[3], atol=1e-6)
    np.testing.assert_allclose(line.moved(np.zeros((4, 3))).normals, normals, atol=1e-6)


def test_moved_checks_positions_and_leaves_the_base():
    mesh = bound()
    assert mesh.moved(mesh.vertices + 1).binding is None
    posed = mesh.moved(mesh.vertices, binding=mesh.binding, normals=mesh.normals)
    assert posed.binding is mesh.binding
    assert posed.normals is mesh.normals
    for wrong in (mesh.vertices[1:], np.zeros(3), np.full_like(mesh.vertices, np.nan)):
        with pytest.raises(ValueError, match="vertices must"):
            mesh.moved(wrong)


@pytest.mark.parametrize("seed", range(4))
def test_a_rigid_motion_of_mesh_and_camera_changes_nothing(seed):
    mesh, rotation = fans(seed), turn(seed)
    shift = np.array([1.0, -2, 0.5])
    moved = mesh.moved(mesh.vertices @ rotation.T + shift)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ shift
    camera = replace(view(), world_to_camera=matrix)
    before = render(mesh, view(), samples=2, normals=True)
    after = render(moved, camera, samples=2, normals=True)
    assert np.quantile(np.abs(before.color - after.color), 0.99) < 1e-3
    turned = before.normals @ rotation.T
    assert np.quantile(np.abs(turned - after.normals), 0.99) < 1e-3


@pytest.mark.parametrize("mirror", [1, -1])
def test_a_transformed_mesh_is_seen_as_its_transformed_splats_are(mirror):
    """A turn, a scale, a shift and a mirror, of splats whose colours depend on the view."""
    cloud = splats(3, 12, sizes=(0.1, 0.4), z=6)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = 2 * turn(5) @ np.diag([mirror, 1, 1]), (1, -2, 0.5)
    mesh = convert(cloud)
    moved = mesh.transformed(matrix)
    towards = cloud.transformed(matrix)
    middle = towards.means.mean(axis=0)
    camera = look_at(middle - np.array([0, 0, 10]), middle, width=48, height=40)
    expected = render(convert(towards), camera, samples=2).color
    assert np.quantile(np.abs(render(moved, camera, samples=2).color - expected), 0.98) < 2e-3
    np.testing.assert_allclose(moved.up, matrix[:3, :3] @ mesh.up / 2, atol=1e-6)
    twice = moved.transformed(np.linalg.inv(matrix))
    np.testing.assert_allclose(twice.vertices, mesh.vertices, atol=1e-5)
    np.testing.assert_allclose(twice.harmonics, mesh.harmonics, atol=1e-5)


def test_normals_base_and_corners_of_a_mirrored_mesh_stay_outside():
    mesh = bind(bumpy(), triangles=1, layers=2, spacing=0.1).mesh
    moved = mesh.transformed(np.diag([-2.0, 2, 2]))
    np.testing.assert_allclose(moved.normals, mesh.normals * (-1, 1, 1), atol=1e-6)
    np.testing.assert_allclose(moved.binding.positions(), moved.vertices, atol=1e-5)

    def across(of: SplatMesh) -> np.ndarray:
        a, b, c = (of.vertices[of.faces[:, k]] for k in range(3))
        return unit(np.cross(b - a, c - a))

    np.testing.assert_allclose(across(moved), across(mesh) * (-1, 1, 1), atol=1e-4)
    with pytest.warns(DataWarning, match=r"binding to a base is left out.*pose\(\)"):
        assert mesh.transformed(np.diag([1.0, 2, 1])).binding is None
    flattened = mesh.binding.base_vertices * np.float32([-1, 2, 1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert MeshPrior(mesh).pose(flattened).binding is not None


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(2), "shape"),
        (np.diag([1.0, 1, 0]), "singular"),
        (np.full((3, 3), np.nan), "not finite"),
        (np.ones((4, 4)), "last row"),
    ],
)
def test_maps_that_are_none_are_refused(matrix, message):
    with pytest.raises(ValueError, match=message):
        fans().transformed(matrix)


def test_centres_are_weighted_by_opacity():
    mesh = fans()
    splats = mesh.splats
    centers = splats.centers(mesh.vertices, mesh.colors[:, 3])
    corners = mesh.faces[splats.of_face == 1].ravel()
    weight = mesh.colors[corners, 3].astype(float)
    expected = (weight[:, None] * mesh.vertices[corners]).sum(axis=0) / weight.sum()
    np.testing.assert_allclose(centers[1], expected, atol=1e-5)
