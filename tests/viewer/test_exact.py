"""The exact image of the page, by WebGPU in headless Chromium, against ``render``."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from _browser import Page
from _needs import lacking
from _pages import HEIGHT, WIDTH, cameras_fixture, cloud_fixture, levels, mesh_fixture  # noqa: F401
from _shared_device import SharedDevice, shared_device

import meshsplats as ms
from meshsplats.conversion.cleaning import cropped
from meshsplats.demo_scene import make_scene
from meshsplats.rendering.looks import image_of
from meshsplats.scene.colors import linear_to_srgb, srgb_to_linear
from meshsplats.viewer.page import _read, make_page
from meshsplats.viewer.quantise import quantise_mesh
from meshsplats.webgpu.settings import DrawSettings, frame_uniform

PATIENCE = 400
"""Seconds for shaders that a busy processor compiles."""


def open_page(device: SharedDevice, name: str, before: str = "") -> Page:
    page = device.page(name, WIDTH, HEIGHT, before)
    page.wait("document.body.dataset.state !== 'loading'", PATIENCE)
    page.run("document.body.classList.add('plain')")
    page.choose("#samples", "1")
    page.still(PATIENCE)
    if page.run("document.body.dataset.renderer") != "exact":
        reason = page.text("#notes")
        page.close()
        if "no graphics device" in reason or "no WebGPU" in reason:
            lacking("browser", f"Chromium draws without WebGPU here: {reason}")
        raise AssertionError(reason)
    return page


@pytest.fixture(scope="module")
def shown(browser, tmp_path_factory):
    """Opens the page of a mesh. test_surface_in_page.py has one with a device of its own, from a file."""
    folder = tmp_path_factory.mktemp("exact")

    def show(mesh: ms.SplatMesh, name: str, before: str = "", **arguments: Any) -> Page:
        (folder / f"{name}.html").write_text(make_page(mesh, **arguments).html, encoding="utf-8")
        return open_page(device, f"{name}.html", before)

    with shared_device(browser, folder) as device:
        yield show


@pytest.fixture(scope="module")
def page(shown, mesh, cloud, cameras):
    opened = shown(mesh, "scene", splats=cloud, cameras=cameras)
    yield opened
    assert opened.problems() == []
    opened.close()


@pytest.fixture(autouse=True)
def _first_view(request):
    if "page" in request.fixturenames:
        page = request.getfixturevalue("page")
        page.choose("#cameras", "0")
        page.choose("#samples", "1")
        page.choose("#background", "#ffffff")
        page.choose("#exposure", "0")
        page.still(PATIENCE)


def assert_within_one_level(page: Page, image: np.ndarray) -> None:
    difference = np.abs(page.screenshot().astype(int) - levels(image))
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.1  # harmonics have 8 bits


@pytest.mark.slow
def test_the_image_is_that_of_render(page, mesh, cameras):
    assert_within_one_level(page, ms.render(mesh, cameras[0]).color)


@pytest.mark.slow
def test_samples_are_those_of_render(page, mesh, cameras):
    page.choose("#samples", "2")
    page.still(PATIENCE)
    assert page.text("#status") == "exact, 4 samples per pixel"
    assert_within_one_level(page, ms.render(mesh, cameras[0], samples=2).color)
    assert np.abs(page.screenshot().astype(int) - levels(ms.render(mesh, cameras[0]).color)).max() > 5


@pytest.mark.slow
def test_cameras_of_the_list_are_reached_exactly(page, mesh, cameras):
    page.choose("#cameras", "2")
    page.still(PATIENCE)
    assert_within_one_level(page, ms.render(mesh, cameras[2]).color)


@pytest.mark.slow
def test_background_and_exposure(page, mesh, cameras):
    page.choose("#background", "#204060")
    page.still(PATIENCE)
    background = np.array([0x20, 0x40, 0x60]) / 255
    drawn = ms.render(mesh, cameras[0], background=background)
    assert_within_one_level(page, drawn.color)
    page.choose("#exposure", "1")
    page.still(PATIENCE)
    alpha = drawn.alpha[..., None]
    own = (drawn.color - (1 - alpha) * background) / np.maximum(alpha, 1e-6)
    brighter = linear_to_srgb(2 * srgb_to_linear(own.clip(0, 1)))
    expected = levels(alpha * brighter + (1 - alpha) * background)
    assert np.abs(page.screenshot().astype(int) - expected).max() <= 2


@pytest.mark.slow
def test_the_crop_box_leaves_the_same_triangles_as_the_option(page, mesh, cameras):
    page.choose("#crop-x0", "90")
    page.still(PATIENCE)
    words = page.text("#cropText").split()
    part = cropped(mesh, tuple(float(word) for word in words[1:]))
    count = len(mesh.faces)
    assert 0 < len(part.faces) < count
    assert page.statistics()["triangles"] == f"{len(part.faces):,} of {count:,}"
    assert_within_one_level(page, ms.render(part, cameras[0]).color)
    page.run("document.getElementById('uncrop').click()")
    page.still(PATIENCE)
    assert page.statistics()["triangles"] == f"{count:,}"


@pytest.mark.slow
def test_splats_stand_left_of_the_divider_and_the_exact_mesh_right_of_it(page, mesh, cloud, cameras):
    page.run("document.querySelector('[value=both]').click()")
    page.still(PATIENCE)
    image = page.screenshot().astype(int)
    half = WIDTH // 2
    assert np.abs(image - levels(ms.render(mesh, cameras[0]).color))[:, half + 1 :].max() <= 1
    splats = levels(ms.render_splats(cloud, cameras[0], sh_degree=0).color)
    assert np.abs(image - splats)[:, : half - 1].mean() < 1
    page.run("document.querySelector('[value=mesh]').click()")


def test_the_page_writes_the_uniform_of_the_python_host(browser, cameras):
    """Bit for bit, with the parts of positions that float32 rounds off."""
    view = cameras[1]
    counts = {"vertices": 70, "faces": 60, "runs": 10, "splats": 9, "groups": 8, "harmonics": 3}
    pinhole = {"rows": view.world_to_camera[:3].tolist(), "center": view.center.tolist()} | {
        name: getattr(view, name) for name in ("fx", "fy", "cx", "cy", "near", "width", "height")
    }
    arguments = (pinhole, counts, 4000, [180, 190, 250], 0.7, 60000)
    page = browser.page("about:blank#uniform", WIDTH, HEIGHT)
    source = re.sub(r"^export |^import .*$", "", _read("arrays.js"), flags=re.MULTILINE)
    written = page.run(f"{source}; [...new Uint32Array(frameUniform(...{json.dumps(arguments)}).buffer)]")
    page.close()
    settings = DrawSettings(filter_px2=0.7, budget=60000)
    expected = frame_uniform(view, settings, counts, 4000, [180, 190, 250])
    assert written == expected.view(np.uint32).tolist()
    rest = expected[[*range(44, 47), *range(48, 51), *range(52, 55), *range(56, 58)]]
    assert (rest != 0).sum() > 5


def layered(cloud: ms.GaussianCloud, camera: ms.Camera) -> ms.SplatMesh:
    """Flat fans, each with another one of other colours just before it, both at the depth of one plane: so
    those behind are drawn in front, as their faces come first."""
    flat = ms.convert(cloud.take(np.arange(0, len(cloud), 2)), preset="paper")
    towards = camera.center - flat.vertices
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    colors = np.concatenate([flat.colors, flat.colors])
    colors[len(flat.colors) :, :3] = 1 - flat.colors[:, :3]
    splat = np.concatenate([flat.face_splat, flat.face_splat])
    order = np.argsort(splat, kind="stable")
    return ms.SplatMesh(
        np.concatenate([flat.vertices, flat.vertices + 1e-3 * towards]),
        np.concatenate([flat.faces, flat.faces + len(flat.vertices)])[order],
        colors,
        face_splat=splat[order],
        depth_group=splat[order],
    )


@pytest.mark.slow
def test_linear_meshes_with_depth_groups_and_a_filter(shown, cloud, cameras):
    odd = replace(layered(cloud, cameras[0]), blending="linear", filter_px2=0.5)
    expected = levels(image_of(odd, cameras[0], (1, 1, 1))[0])
    for plain in (
        replace(odd, depth_group=None),
        replace(odd, filter_px2=0),
        replace(odd, blending="display"),
    ):
        other = levels(image_of(plain, cameras[0], (1, 1, 1))[0])
        assert (np.abs(other - expected) > 1).any(axis=-1).mean() > 0.1
    page = shown(odd, "odd", cameras=cameras)
    difference = np.abs(page.screenshot().astype(int) - expected)
    assert (difference > 1).any(axis=-1).mean() < 0.002
    assert page.problems() == []
    page.close()


@pytest.mark.slow
def test_meshes_in_the_order_of_their_splats(shown, cloud, cameras):
    """With thick splats, whose planes cross, and with depth groups, which have no effect."""
    splats = cloud.take(np.arange(0, len(cloud), 2))
    mesh = replace(ms.convert(splats, mode="3d"), order="splat")
    mesh = replace(mesh, depth_group=mesh.face_splat)
    image = ms.render(mesh, cameras[0])
    exact = levels(ms.render(mesh, cameras[0], order="fragment").color)
    assert (np.abs(exact - levels(image.color)) > 2).any(axis=-1).mean() > 0.1
    page = shown(mesh, "by splat", cameras=cameras)
    assert_within_one_level(page, image.color)
    page.choose("#crop-x0", "90")
    page.still(PATIENCE)
    words = page.text("#cropText").split()
    part = cropped(mesh, tuple(float(word) for word in words[1:]))
    assert 0 < len(part.faces) < len(mesh.faces)
    assert_within_one_level(page, ms.render(part, cameras[0]).color)
    assert page.problems() == []
    page.close()


@pytest.mark.slow
def test_strays_cost_the_others_nothing(shown, cloud, cameras):
    """One splat far away, one of a giant's size that cuts the scene, and the splats beside them."""
    wild = ms.GaussianCloud(
        np.concatenate([cloud.means, [[1e8, 0, 0], cloud.means.mean(axis=0)]]),
        np.concatenate([cloud.quaternions, [[1, 0, 0, 0], [0.8, 0.6, 0, 0]]]),
        np.concatenate([cloud.scales, [[1, 1, 1], [np.exp(40), np.exp(20), 1e-3]]]),
        np.concatenate([cloud.opacities, [0.9, 0.4]]),
        np.concatenate([cloud.sh[:, :1], np.zeros((2, 1, 3))]),
    )
    mesh = ms.convert(wild)
    image = ms.render(mesh, cameras[0]).color
    assert np.abs(image - ms.render(ms.convert(cloud), cameras[0]).color).mean() > 0.02
    page = shown(mesh, "strays", splats=wild, cameras=cameras)
    difference = np.abs(page.screenshot().astype(int) - levels(image))
    assert (difference > 1).any(axis=-1).mean() < 0.005
    assert page.problems() == []
    page.close()


def limited(most: int) -> str:
    """A script by which storage bindings have at most ``most`` bytes, and that notes the largest."""
    return f"""
    window.largest = 0;
    const limits = Object.getOwnPropertyDescriptor(GPUAdapter.prototype, 'limits').get;
    Object.defineProperty(GPUAdapter.prototype, 'limits', {{ get() {{
      const own = limits.call(this);
      return {{ maxBufferSize: own.maxBufferSize, maxStorageBufferBindingSize: {most} }};
    }} }});
    const request = GPUAdapter.prototype.requestDevice;
    GPUAdapter.prototype.requestDevice = function () {{ return request.call(this); }};
    owner.onbuffer = what => {{
      if (what.usage & GPUBufferUsage.STORAGE) window.largest = Math.max(window.largest, what.size);
    }};
    """


@pytest.mark.slow
def test_bindings_never_exceed_the_limit_of_the_device_and_the_image_is_the_same(shown, mesh, cloud, cameras):
    """The image is drawn in strips where samples and tile lists do not fit."""
    most = 16 * WIDTH * HEIGHT  # half of what the samples of the image take
    assert 16 * len(mesh.vertices) < most
    page = shown(mesh, "strips", limited(most), cameras=cameras)
    assert page.run("document.querySelector('#message').hidden")
    assert 0.5 * most < page.run("largest") <= most
    assert_within_one_level(page, ms.render(mesh, cameras[0]).color)
    assert page.problems() == []
    page.close()


@pytest.mark.slow
def test_of_a_mesh_too_large_for_the_device_the_exact_image_has_what_shows_most(shown, cameras):
    many = ms.convert(make_scene(3000).of_degree(2))
    most = 16 * WIDTH * HEIGHT
    share = most / 16 / len(many.vertices)
    assert share < 0.7
    page = shown(many, "parts", limited(most), cameras=cameras)
    said = re.search(
        r"the exact image leaves out (\d+) % of the triangles",
        page.text("#messageText"),
    )
    assert said is not None
    assert 1 - int(said[1]) / 100 == pytest.approx(share, abs=0.06)
    assert page.run("largest") <= most
    corners = many.vertices[many.faces]
    areas = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ) * many.colors[many.faces][..., 3].sum(axis=1)
    shows = np.bincount(many.face_splat, areas)
    order = np.argsort(-shows)
    vertices = np.bincount(np.repeat(many.face_splat, 3)[np.unique(many.faces, return_index=True)[1]])
    kept = np.zeros(len(shows), bool)
    kept[order[np.cumsum(vertices[order]) <= most / 16]] = True
    image = page.screenshot() / 255
    expected = ms.render(many.take(kept[many.face_splat]), cameras[0]).color
    assert ms.psnr(image, expected) > 30
    assert ms.psnr(image, ms.render(many, cameras[0]).color) < 25
    # The crop box works on that part.
    page.choose("#crop-x0", "90")
    page.still(PATIENCE)
    assert page.text("#status").startswith("exact")
    box = tuple(float(word) for word in page.text("#cropText").split()[1:])
    part = cropped(many.take(kept[many.face_splat]), box)
    assert ms.psnr(page.screenshot() / 255, ms.render(part, cameras[0]).color) > 30
    assert ms.psnr(page.screenshot() / 255, ms.render(cropped(many, box), cameras[0]).color) < 25
    assert page.problems() == []
    page.close()


@pytest.mark.slow
def test_levels_in_the_exact_image(shown, mesh, cloud, cameras):
    coarse = ms.convert(ms.simplify(cloud, 60))
    page = shown(mesh, "exact-levels", coarse=coarse, cameras=cameras)
    assert page.run("document.body.dataset.level") == "fine"
    assert_within_one_level(page, ms.render(mesh, cameras[0]).color)
    page.choose("#detail", "coarse")
    page.still(PATIENCE)
    assert_within_one_level(page, ms.render(quantise_mesh(coarse).decoded, cameras[0]).color)
    page.choose("#detail", "fine")
    page.still(PATIENCE)
    assert_within_one_level(page, ms.render(mesh, cameras[0]).color)
    assert page.problems() == []
    page.close()


# View-dependent colours


def glowing(cloud: ms.GaussianCloud, terms: int) -> ms.SplatMesh:
    """The mesh of ``cloud`` with strong harmonics, brighter than white in places."""
    mesh = ms.convert(cloud.of_degree(0))
    random = np.random.default_rng(terms)
    harmonics = random.normal(0, 0.5, (len(mesh.splats), terms, 3))
    return replace(mesh, colors=mesh.colors * [1.5, 1.5, 1.5, 1], harmonics=harmonics)


@pytest.mark.slow
@pytest.mark.parametrize("terms", [3, 8, 15])
def test_colours_depend_on_the_view(shown, cloud, cameras, terms):
    """In the order of the splats, WebGL draws all but the exact image, too."""
    mesh = replace(glowing(cloud, terms), order="splat")
    page = shown(mesh, f"glowing{terms}", cameras=cameras)
    decoded = quantise_mesh(mesh).decoded
    for renderer in ("exact", "sorted"):
        page.choose("#renderer", renderer)
        for index in (0, 1):
            page.choose("#cameras", str(index))
            page.still(PATIENCE)
            assert page.run("document.body.dataset.renderer") == renderer
            image = ms.render(decoded, cameras[index]).color
            if renderer == "exact":
                assert_within_one_level(page, image)
            else:  # other samples at the edges
                image = ms.render(decoded, cameras[index], samples=2).color
                difference = np.abs(page.screenshot().astype(int) - levels(image))
                assert np.median(difference) <= 1
                assert ms.psnr(page.screenshot() / 255, image.clip(0, 1)) > 33
        plain = ms.render(replace(decoded, harmonics=None), cameras[1]).color
        assert ms.psnr(page.screenshot() / 255, plain.clip(0, 1)) < 25
    assert page.problems() == []
    page.close()
