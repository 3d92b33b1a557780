"""Textured surfaces in the page: alone, and beside mesh and splats."""

from __future__ import annotations

from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from _needs import lacking
from _pages import cameras_fixture, cloud_fixture, levels, mesh_fixture  # noqa: F401 - fixtures
from test_controls import open_page
from test_page import block

import meshsplats as ms
from meshsplats.images.reading import load_image
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.colors import linear_to_srgb
from meshsplats.viewer.page import PageOptions, estimated_size
from meshsplats.viewer.streams import Unpacker
from meshsplats.viewer.surface import STEPS, pack_surface
from meshsplats.viewer.unpacking import unpack_mesh

SIDE = 160
COLORS = np.array([[230, 30, 20], [20, 200, 40], [30, 60, 220], [240, 220, 10]], np.uint8)


def box(split: float = 0.5) -> BaseMesh:
    """A box, 2 x 2 x 2, every side of which has four colours, in quadrants of the same texture."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([f for a, b, c, d in sides for f in ((a, b, c), (a, c, d))], np.int32)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    uv = np.array([square[[0, 1, 2]], square[[0, 2, 3]]] * 6)
    pixels = np.full((64, 64, 4), 255, np.uint8)
    cut = round(64 * split)
    for k, part in enumerate((np.s_[:cut, :cut], np.s_[:cut, cut:], np.s_[cut:, :cut], np.s_[cut:, cut:])):
        pixels[(*part, slice(3))] = COLORS[k]
    texture = Texture(pixels, ("clamp", "clamp"))
    return BaseMesh(corners, faces, uv=uv, face_texture=np.zeros(12, np.int32), textures=(texture,))


def camera() -> ms.Camera:
    return ms.look_at([2.0, -2.5, 4.0], [0, 0, 0], up=(0, -1, 0), width=SIDE, height=SIDE, fov=50)


def plain(page) -> None:
    page.run("document.body.classList.add('plain')")
    page.still(400)


def expected(base: BaseMesh, view: ms.Camera) -> np.ndarray:
    return levels(ms.draw_surface(base, view, background=(1, 1, 1)))


def same(found: np.ndarray, wanted: np.ndarray) -> None:
    """Within two levels, but for pixels at edges, where samples lie elsewhere."""
    off = np.abs(found.astype(int) - wanted).max(axis=2) > 2
    assert off.mean() < 0.06
    assert (wanted < 250).any(axis=2).mean() > 0.1


def test_a_surface_alone_is_the_image_of_the_core(browser, write_page):
    url = write_page(box(), "box", cameras=[camera()])
    page = open_page(browser, url, SIDE, SIDE)
    plain(page)
    same(page.screenshot(), expected(box(), camera()))
    assert page.statistics()["triangles"] == "12"
    for hidden in ("#content", "#pairLine", "#detailLine", "#message", "[name=style][value=blended]"):
        assert page.run(f"document.querySelector('{hidden}').checkVisibility()") is False
    page.key("x")
    page.still()
    wires = page.screenshot()
    assert 0.01 < (wires < 250).any(axis=2).mean() < 0.3 * (page.screenshot() < 256).mean()
    assert page.problems() == []
    assert page.requests() == [url]
    page.close()


def test_the_colours_of_vertices_beside_a_texture_are_in_the_page():
    tints = np.tile(np.float32([0.5, 1, 0.25, 1]), (8, 1))
    packed = pack_surface(replace(box(), tints=tints))
    assert packed.picture == pack_surface(box()).picture
    colors = unpack_mesh(packed.mesh.data).colors
    np.testing.assert_allclose(colors[:, :3], linear_to_srgb(tints[:1, :3]).repeat(len(colors), 0), atol=0.01)


def test_a_tinted_texture_is_the_image_of_the_core(browser, write_page):
    """Dark times dark, where products of display values are far from those of light, and gradients, which
    are, too."""
    tints = np.tile(np.float32([0.05, 0.4, 0.02, 1]), (8, 1))
    tints[:4] = 1
    tinted = replace(box(), tints=tints)
    page = open_page(browser, write_page(tinted, "box", cameras=[camera()]), SIDE, SIDE)
    plain(page)
    same(page.screenshot(), expected(tinted, camera()))
    assert page.problems() == []
    page.close()


def press(page, kind: str) -> np.ndarray:
    """The screen with that content."""
    page.run(f"document.querySelector('[name=content][value={kind}]').click()")
    page.still(400)
    return page.screenshot()


def beside(page, pairs: list[str]) -> None:
    """Every pair of contents has the image of each on its side of the boundary."""
    half = SIDE // 2 - 22  # without the boundary's grip
    single = {kind: press(page, kind) for kind in ("mesh", "splats", "surface")}
    assert page.run("[...document.querySelector('#pair').options].map(o => o.textContent)") == pairs
    assert page.run("document.querySelector('#pairLine').hidden") is False
    press(page, "both")
    for number, pair in enumerate(pairs):
        page.choose("#pair", str(number))
        page.still(400)
        left, right = pair.split(", ")
        found = page.screenshot()
        assert (found[:, :half] == single[left][:, :half]).all()
        assert (found[:, -half:] == single[right][:, -half:]).all()
        assert (single[left][:, :half] != single[right][:, :half]).any()
        assert page.text("#divider .left") == left
        assert page.text("#divider .right") == right
    page.run("document.activeElement.blur(); document.querySelector('#stage').focus()")
    page.key("4")
    page.still(400)
    assert (page.screenshot() == single["surface"]).all()


PAIRS = ["splats, mesh", "surface, mesh", "splats, surface"]


@pytest.fixture(scope="module", name="url")
def url_fixture(write_page, mesh, cloud):
    surface = replace(box(), vertices=0.4 * box().vertices)
    view = ms.orbit(cloud, 1, width=SIDE, height=SIDE)[0]
    return write_page(mesh, "three", splats=cloud, surface=surface, cameras=[view])


def test_surface_mesh_and_splats_stand_side_by_side(browser, url):
    page = open_page(browser, url, SIDE, SIDE)
    plain(page)
    beside(page, PAIRS)
    assert page.text("#status") == "surface"
    page.choose("#crop-x0", "90")
    page.still()
    kept, of_all = page.statistics()["triangles"].split(" of ")
    assert 0 < int(kept) < int(of_all) == 12
    assert page.problems() == []
    page.close()


@pytest.mark.nightly
def test_the_exact_mesh_stands_beside_a_surface(browser, url):
    page = browser.page(url, SIDE, SIDE)
    page.wait("document.body.dataset.state !== 'loading'", 400)
    plain(page)
    page.choose("#samples", "1")
    page.still(400)
    if page.run("document.body.dataset.renderer") != "exact":
        page.close()
        lacking("browser", "Chromium draws without WebGPU here")
    beside(page, PAIRS)
    assert page.run("document.querySelector('#exact').style.visibility") == "hidden"
    assert page.problems() == []
    page.close()


def test_a_surface_beside_splats_needs_no_mesh(browser, write_page, cloud):
    page = open_page(browser, write_page(box(), "two", splats=cloud, cameras=[camera()]), SIDE, SIDE)
    plain(page)
    alone = press(page, "surface")
    same(alone, expected(box(), camera()))
    assert (press(page, "splats") != alone).any()
    assert page.text("#status") == "splats"
    assert page.run("document.querySelector('[name=content][value=mesh]').disabled")
    assert page.problems() == []
    page.close()


def test_vertex_colours_do_where_there_is_no_texture(browser, write_page):
    base = box()
    colors = np.column_stack([(base.vertices + 1) / 2, np.ones(8)]).astype(np.float32)
    base = BaseMesh(base.vertices, base.faces, colors)
    page = open_page(browser, write_page(base, "colours", cameras=[camera()]), SIDE, SIDE)
    plain(page)
    same(page.screenshot(), expected(base, camera()))
    page.close()


def test_texture_coordinates_and_the_picture_come_back():
    base = box(0.25)
    packed = pack_surface(base)
    assert packed.coordinates is not None
    source = Unpacker(packed.coordinates)
    uv = source.columns(source.header["row"], 2) / STEPS
    faces = packed.mesh.decoded.faces
    np.testing.assert_allclose(uv[faces], base.uv, atol=0.5 / STEPS)
    np.testing.assert_allclose(
        packed.mesh.decoded.vertices[faces], base.vertices[base.faces], atol=packed.mesh.position_error
    )
    picture = load_image("a.png", packed.picture)
    np.testing.assert_array_equal(picture[..., :3], base.textures[0].pixels[..., :3])
    assert (source.header["wrap"], source.header["type"]) == (["clamp", "clamp"], "image/png")


def test_the_factor_of_a_texture_is_in_its_picture():
    base = box()
    texture = replace(base.textures[0], factor=(0.5, 1.0, 0.25, 1.0))
    picture = load_image("a.png", pack_surface(replace(base, textures=(texture,))).picture)
    middle = (np.array([[8, 8], [40, 40]]) + 0.5) / 64
    np.testing.assert_allclose(
        picture[[8, 40], [8, 40]] / 255, texture.at(middle)[:, :3], atol=0.5 / 255 + 1e-6
    )


def test_what_a_surface_is_not():
    base, mesh = box(), ms.SplatMesh(box().vertices, box().faces, np.ones((8, 4), np.float32))
    several = replace(base, textures=base.textures * 2)
    for call in (lambda: ms.make_page(several), lambda: ms.make_page(mesh, surface=several)):
        with pytest.raises(ValueError, match="one texture on all faces, this mesh has 2"):
            call()
    for more in ({"surface": base}, {"coarse": mesh}):
        with pytest.raises(ValueError, match="surface alone has no other surface and no coarse level"):
            ms.make_page(base, **more)


def test_the_size_of_a_page_is_known_before(mesh, cloud):
    for main, splats, surface in ((mesh, cloud, box()), (box(), cloud, None), (box(), None, None)):
        made = ms.make_page(main, splats=splats, surface=surface, options=PageOptions(title="x"))
        parts = (None, splats, None, box()) if main is not mesh else (mesh, splats, None, surface)
        assert estimated_size(*parts) == pytest.approx(len(made.html), rel=0.05)
        assert ('id="kernels">' in made.html) == (main is mesh)


def test_surfaces_are_relative_to_the_origin_of_the_mesh(mesh):
    moved = replace(mesh, origin=np.array([100.0, 0, 0]))
    there = ms.make_page(moved, surface=replace(box(), origin=np.array([101.0, 0, 0]))).html
    decoded = unpack_mesh(b64decode(block(there, "surface")))
    np.testing.assert_allclose(decoded.vertices.mean(axis=0), [1, 0, 0], atol=1e-4)
