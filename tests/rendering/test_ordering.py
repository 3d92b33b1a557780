"""Orders of blending: by hand, against an independent viewer, and never worse than where the search began."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _rendering import camera
from _splats import few_splats
from _stock_viewer import stock_image

from meshsplats import SplatMesh, convert, drawing_order, load_mesh, look_at, orbit, psnr, render, save_mesh
from meshsplats.rendering import ordering
from meshsplats.rendering.ordering import default_views, pieces_of, solve
from meshsplats.rendering.viewers import ordered_image, viewer_images
from meshsplats.scene.draw_order import DrawOrder

SQUARE = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
RED, BLUE = (1, 0, 0, 0.9), (0, 0, 1, 0.9)


def squares(*depths: float) -> SplatMesh:
    """Squares across the z axis, red and blue in turn."""
    vertices = np.concatenate([SQUARE + np.array([0, 0, z]) for z in depths])
    faces = np.concatenate([np.array([(0, 1, 2), (0, 2, 3)]) + 4 * k for k in range(len(depths))])
    colors = np.repeat([(RED, BLUE)[k % 2] for k in range(len(depths))], 4, axis=0)
    return SplatMesh(vertices, faces, colors, np.repeat(np.arange(len(depths)), 2))


def both_ends() -> list:
    """A view along the z axis from each end."""
    lens = {"up": (0, 1, 0), "width": 32, "height": 32}
    return [look_at((0.1, 0.2, z), (0, 0, 0), **lens) for z in (-6, 6)]


@pytest.mark.parametrize("depths", [(-0.5, 0.5), (0.5, -0.5), (3.0, 3.4), (3.4, 3.0), (0.2, -0.6, 0.7)])
def test_each_side_shows_what_is_in_front(depths):
    """Two orders in one file: from one end the first square covers the second, from the other end the second
    the first. The squares lie on one side of the middle, too, in nodes of one."""
    mesh = squares(*depths)
    order = drawing_order(mesh, both_ends(), nodes=1)
    assert sorted(order.copies) == list(range(4 * len(depths)))
    for view in both_ends():
        exact = render(mesh, view).color
        np.testing.assert_allclose(ordered_image(mesh, order, view, multisample=False), exact, atol=2 / 255)
    # A list without copies is wrong from one end.
    errors = [np.abs(viewer_images(mesh, view)[0] - render(mesh, view).color).max() for view in both_ends()]
    assert max(errors) > 0.5


def test_the_file_holds_a_triangle_where_each_side_needs_it():
    """The copies that face the eye at z < 0 come with the nearer square last, and so do those at z > 0."""
    order = drawing_order(squares(-0.5, 0.5), both_ends(), nodes=1)
    winding = order.copies // 4  # 0: as in the mesh, counter-clockwise from z > 0
    square = order.copies % 4 // 2
    assert square[winding == 0].tolist() == [0, 0, 1, 1]
    assert square[winding == 1].tolist() == [1, 1, 0, 0]


@pytest.fixture(scope="module", name="mesh")
def mesh_fixture() -> SplatMesh:
    return convert(few_splats())


@pytest.mark.slow
def test_solving_never_loses_against_the_formula(mesh):
    pieces = pieces_of(mesh)
    node = np.zeros(len(pieces.splat), np.int64)
    start = np.random.default_rng(0).permutation(2 * len(node)).astype(np.int32)
    for rank in (start, solve(mesh, pieces, node, start, default_views(mesh)).rank):
        found = solve(mesh, pieces, node, rank, default_views(mesh))
        assert found.pairs > 100
        assert 0 <= found.after <= found.before <= found.weight
        assert sorted(found.rank) == list(range(len(start)))
    again = solve(mesh, pieces, node, found.rank, default_views(mesh))
    assert again.before == pytest.approx(found.after)


def test_a_stack_is_put_in_order_from_any_start():
    """Every pair of a hundred layers wants one order, which single moves reach but for pairs of no weight."""
    rng = np.random.default_rng(0)
    mesh = squares(*np.linspace(-1, 1, 100))
    colors = np.concatenate([rng.integers(0, 2, (100, 3)), np.full((100, 1), 0.04)], axis=1)
    mesh = replace(mesh, colors=np.repeat(colors, 4, axis=0))
    start = rng.permutation(200).astype(np.int32)
    found = solve(mesh, pieces_of(mesh), np.zeros(100, np.int64), start, both_ends())
    assert found.before > 0.3 * found.weight
    assert found.after < 1e-4 * found.before


@pytest.mark.slow
def test_the_order_does_not_depend_on_threads(mesh):
    orders = [drawing_order(mesh, nodes=3, threads=threads) for threads in (1, 2, 5)]
    assert len({order.copies.tobytes() for order in orders}) == 1


def test_few_pairs_are_kept_alike_by_all_threads(mesh, monkeypatch):
    whole = drawing_order(mesh, nodes=1)
    monkeypatch.setattr(ordering, "MAX_PAIRS", 256)
    orders = [drawing_order(mesh, nodes=1, threads=threads) for threads in (1, 3)]
    assert orders[0].copies.tobytes() == orders[1].copies.tobytes() != whole.copies.tobytes()


def test_the_heaviest_pairs_are_kept(mesh, monkeypatch):
    pieces, views = pieces_of(mesh), default_views(mesh)[::4]
    node = np.zeros(len(pieces.splat), np.int64)
    start = np.arange(2 * len(node), dtype=np.int32)
    whole = solve(mesh, pieces, node, start, views)
    for share, weight in (2, 1), (0.5, 0.95):
        monkeypatch.setattr(ordering, "MAX_PAIRS", int(share * whole.pairs))
        found = solve(mesh, pieces, node, start, views)
        assert found.pairs == pytest.approx(min(share, 1) * whole.pairs, rel=0.15)
        assert found.pairs <= min(share, 1) * whole.pairs + 256
        assert weight * whole.weight <= found.weight <= whole.weight


def test_solved_is_better_than_quick_and_quick_than_the_index(mesh):
    views = orbit(mesh, 3, elevation=25, azimuth=7, width=96, height=96)

    def score(images):
        return np.mean(
            [psnr(a, render(mesh, v, samples=2).color) for a, v in zip(images, views, strict=True)]
        )

    solved, quick = (drawing_order(mesh, nodes=1, quick=quick) for quick in (False, True))
    scores = [score([ordered_image(mesh, order, view) for view in views]) for order in (solved, quick)]
    index = score([viewer_images(mesh, view)[0] for view in views])
    assert scores[0] > scores[1] + 1 > index + 1, (scores, index)


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [1, 4])
def test_an_independent_viewer_draws_the_file_alike(mesh, tmp_path, nodes):
    order = drawing_order(mesh, nodes=nodes)
    assert order.node_count == nodes
    save_mesh(mesh, tmp_path / "ordered.glb", order=order)
    stored = load_mesh(tmp_path / "ordered.glb")
    for view in orbit(mesh, 2, elevation=25, azimuth=7, width=48, height=48):
        near = view.with_near_plane(mesh.vertices)
        shown = stock_image(tmp_path / "ordered.glb", near)
        np.testing.assert_allclose(ordered_image(stored, order, near, multisample=False), shown, atol=0.04)
        assert psnr(shown, ordered_image(stored, order, near, multisample=False)) > 45


@pytest.mark.slow
def test_as_few_nodes_as_are_enough(mesh, monkeypatch):
    views = default_views(mesh)[::8]
    counts = []
    for loss in (0.0, 2.0, 100.0):
        monkeypatch.setattr(ordering, "NODE_LOSS", loss)
        order = drawing_order(mesh, views, nodes="auto")
        counts.append(order.node_count)
        alone = drawing_order(mesh, views, nodes=order.node_count)
        assert order.copies.tobytes() == alone.copies.tobytes()
    assert counts[0] > counts[-1] == 1
    assert counts == sorted(counts, reverse=True)


def test_wrong_arguments_are_named(mesh):
    with pytest.raises(ValueError, match="nodes must be a number from 1 to 256, or 'auto', got 0"):
        drawing_order(mesh, nodes=0)
    with pytest.raises(ValueError, match="threads must be at least 1"):
        drawing_order(mesh, threads=0)
    with pytest.raises(ValueError, match="a mesh without triangles has no order"):
        drawing_order(SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 4))))
    with pytest.raises(ValueError, match="cameras must hold a camera"):
        drawing_order(mesh, [])
    with pytest.raises(ValueError, match="the order is of 2 triangles, the mesh has"):
        ordered_image(mesh, DrawOrder(np.arange(4), np.array([0, 4])), camera())


@pytest.mark.parametrize(
    ("copies", "starts", "message"),
    [
        ([0, 1, 2], [0, 3], "each index from 0 to 2 f - 1"),
        ([0, 1, 1, 2], [0, 4], "each index from 0 to 2 f - 1"),
        ([0, 1, 2, 3], [0, 2], "starts must ascend from 0 to 4"),
        ([0, 1, 2, 3], [0, 2, 2, 4], "starts must ascend from 0 to 4"),
        ([0, 1, 2, 3], [0, 2, 4], "both copies of a triangle must lie in one node"),
    ],
)
def test_broken_orders_are_refused(copies, starts, message):
    with pytest.raises(ValueError, match=message):
        DrawOrder(np.array(copies), np.array(starts))
