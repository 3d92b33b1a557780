"""Every control of the page, driven in headless Chromium without WebGPU, and what WebGL draws there."""

from __future__ import annotations

import base64
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
import pytest
from _browser import Browser, Page
from _pages import cameras_fixture, cloud_fixture, levels, mesh_fixture  # noqa: F401 - fixtures
from test_page import HOSTILE, block

import meshsplats as ms
from meshsplats.cameras.framing import scene_bounds
from meshsplats.conversion.cleaning import cropped
from meshsplats.demo_scene import make_scene
from meshsplats.viewer.packing import pack_splats
from meshsplats.viewer.page import PageOptions, _read, make_page
from meshsplats.viewer.unpacking import unpack_mesh

NO_WEBGPU = "Object.defineProperty(Navigator.prototype, 'gpu', { get: () => undefined });"
WIDTH, HEIGHT = 200, 160
PATIENCE = 120


def open_page(browser: Browser, url: str, width: int = WIDTH, height: int = HEIGHT, **more) -> Page:
    page = browser.page(url, width, height, before=NO_WEBGPU + more.pop("before", ""), **more)
    page.still(PATIENCE)
    return page


@pytest.fixture(scope="module")
def url(write_page, mesh, cloud, cameras):
    return write_page(
        mesh, "controls", splats=cloud, cameras=cameras, options=PageOptions(title="still life")
    )


@pytest.fixture(scope="module")
def page(browser, url):
    opened = open_page(browser, url)
    yield opened
    assert opened.problems() == []
    assert opened.requests() == [url]
    opened.close()


@pytest.fixture(autouse=True)
def _first_view(request):
    """Each test begins at the first camera, with the first settings and without the panel's cover."""
    if "page" not in request.fixturenames:
        return
    page = request.getfixturevalue("page")
    page.size(WIDTH, HEIGHT)
    page.run(
        "document.body.classList.add('plain'); document.querySelector('#stage').focus();"
        "for (const s of ['[name=content][value=mesh]', '[name=style][value=blended]'])"
        " document.querySelector(s).click(); document.querySelector('#uncrop').click();"
        "if (document.querySelector('#fly').checked) document.querySelector('#fly').click()"
    )
    page.choose("#background", "#ffffff")
    page.choose("#exposure", "0")
    page.run("document.querySelector('#home').click()")
    page.still(PATIENCE)


def pose(page: Page) -> tuple[np.ndarray, np.ndarray]:
    """Position and direction of the camera."""
    page.still(PATIENCE)
    rows = page.statistics()
    position, direction = (
        np.array([float(x) for x in rows[name].split()]) for name in ("position", "direction")
    )
    return position, direction


def turned(before: tuple, after: tuple) -> float:
    """Degrees between two directions."""
    return float(np.degrees(np.arccos(np.clip(before[1] @ after[1], -1, 1))))


def moved(before: tuple, after: tuple) -> float:
    return float(np.linalg.norm(after[0] - before[0]))


# ---- The view


@pytest.mark.slow
def test_dragging_orbits_around_the_pivot(page):
    before = pose(page)
    page.drag(100, 80, 40, 0)
    after = pose(page)
    assert 20 < turned(before, after) < 120
    # The scene follows the hand: the camera goes to its left, and looks at the same point.
    assert (after[0] - before[0]) @ np.cross([0, 1, 0], before[1]) < 0
    lines = np.stack([before[1], -after[1]], axis=1)
    one, other = np.linalg.lstsq(lines, after[0] - before[0], rcond=None)[0]
    assert one == pytest.approx(other, rel=0.01)
    page.drag(100, 80, 0, 500)
    above = pose(page)
    assert above[0][1] < after[0][1] - 0.5  # y points down: the camera rises as the scene's front goes down
    assert above[1][1] == pytest.approx(0.9998, abs=1e-3)  # and does not go over the pole


@pytest.mark.slow
def test_arrow_keys_orbit_and_with_shift_pan(page):
    before = pose(page)
    page.key("ArrowLeft")
    left = pose(page)
    assert 3 < turned(before, left) < 10
    page.key("ArrowRight")
    assert turned(before, pose(page)) < 0.2
    page.key("ArrowUp")
    up = pose(page)
    assert turned(before, up) > 3
    assert up[0][1] < before[0][1]
    page.key("ArrowDown")
    page.key("ArrowRight", shift=True)
    after = pose(page)
    assert turned(before, after) < 0.2
    assert moved(before, after) > 0.01


def test_the_right_button_and_shift_pan(page):
    for button, modifiers in (("right", 0), ("left", 8)):
        before = pose(page)
        page.drag(100, 80, 30, 10, button, modifiers)
        after = pose(page)
        assert turned(before, after) < 0.1
        offset = after[0] - before[0]
        assert abs(offset @ before[1]) < 0.02 * np.linalg.norm(offset)  # across the line of sight
        assert np.linalg.norm(offset) > 0.05


def test_a_pinch_on_a_trackpad_zooms_as_much_as_fingers(page):
    """Browsers report one by the factor 2 as wheel events with Ctrl of 100 ln 2 pixels."""
    places = [pose(page)[0]]
    for _ in range(2):
        page.run(
            "for (let i = 0; i < 10; i++) document.querySelector('#stage').dispatchEvent("
            "new WheelEvent('wheel', {deltaY: -6.93, ctrlKey: true, cancelable: true}))"
        )
        places.append(pose(page)[0])
    near, nearer = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert nearer / near == pytest.approx(0.5, abs=0.02)


def test_zooming_out_ends_where_the_scene_is_still_seen(page, mesh):
    before, radius = pose(page), scene_bounds(mesh).radius
    page.run(
        "for (let i = 0; i < 40; i++) document.querySelector('#stage').dispatchEvent("
        "new WheelEvent('wheel', {deltaY: 300, cancelable: true}))"
    )
    far = pose(page)
    assert 10 * radius < moved(before, far) < 100 * radius
    for _ in range(3):
        page.key("+")
    assert (pose(page)[0] - far[0]) @ far[1] > 0.3 * moved(before, far)


def test_the_wheel_and_plus_and_minus_zoom(page):
    before = pose(page)
    page.mouse("mouseWheel", 100, 80, deltaX=0, deltaY=-200)
    near = pose(page)
    assert (near[0] - before[0]) @ before[1] > 0.1
    page.mouse("mouseWheel", 100, 80, deltaX=0, deltaY=200)
    assert moved(before, pose(page)) < 0.02
    page.key("+")
    assert (pose(page)[0] - before[0]) @ before[1] > 0.1
    page.key("-")
    assert moved(before, pose(page)) < 0.02


@pytest.mark.slow
def test_letters_fly_and_shift_flies_faster(page):
    directions = {
        "w": (0, 0, 1),
        "s": (0, 0, -1),
        "a": (-1, 0, 0),
        "d": (1, 0, 0),
        "q": (0, 1, 0),
        "e": (0, -1, 0),
    }
    for key, (x, y, z) in directions.items():
        before = pose(page)
        page.key(key, hold=0.25)
        after = pose(page)
        right = np.cross([0, 1, 0], before[1])
        right /= np.linalg.norm(right)
        axis = x * right + y * np.cross(before[1], right) + z * before[1]
        offset = after[0] - before[0]
        assert offset @ axis > 0.9 * np.linalg.norm(offset) > 0
        assert turned(before, after) < 0.1


def test_in_fly_mode_the_camera_turns_where_it_stands(page):
    page.run("document.querySelector('#fly').click()")
    before = pose(page)
    page.drag(100, 80, 40, 0)
    after = pose(page)
    assert moved(before, after) < 1e-3
    assert turned(before, after) > 5
    page.key("ArrowLeft")
    assert moved(before, pose(page)) < 1e-3


def test_turning_goes_on_until_it_is_switched_off(page):
    before = pose(page)
    page.run("document.querySelector('#spin').click()")
    page.wait("document.body.dataset.state === 'moving'")
    page.run("new Promise(done => setTimeout(done, 400))")
    page.run("document.querySelector('#spin').click()")
    assert turned(before, pose(page)) > 2


@pytest.mark.slow
def test_touch_orbits_pans_and_pinches(page):
    page.send("Emulation.setTouchEmulationEnabled", enabled=True)
    before = pose(page)
    page.touch("touchStart", [(100, 80)])
    page.touch("touchMove", [(120, 80)])
    page.touch("touchMove", [(140, 80)])
    page.touch("touchEnd", [])
    after = pose(page)
    assert turned(before, after) > 10
    page.touch("touchStart", [(80, 80), (120, 80)])
    for apart in (25, 30, 40):
        page.touch("touchMove", [(100 - apart, 80), (100 + apart, 80)])
    page.touch("touchEnd", [])
    near = pose(page)
    assert (near[0] - after[0]) @ after[1] > 0.1
    assert turned(after, near) < 1
    page.touch("touchStart", [(80, 80), (120, 80)])
    for shift in (5, 10, 20):
        page.touch("touchMove", [(80, 80 + shift), (120, 80 + shift)])
    page.touch("touchEnd", [])
    panned = pose(page)
    assert moved(near, panned) > 0.02
    assert abs((panned[0] - near[0]) @ near[1]) < 0.2 * moved(near, panned)
    page.send("Emulation.setTouchEmulationEnabled", enabled=False)


def test_a_double_click_centres_what_is_there(page, mesh, cameras):
    before = pose(page)
    page.run(
        "document.querySelector('#stage').dispatchEvent(new MouseEvent('dblclick',"
        " {clientX: 70, clientY: 90, bubbles: true}))"
    )
    after = pose(page)
    assert moved(before, after) > 0.05
    # Some vertex that was there lies on the new line of sight.
    scale = HEIGHT / cameras[0].height
    seen, depth = cameras[0].project(mesh.vertices)
    at = np.abs(seen * scale + [(WIDTH - cameras[0].width * scale) / 2, 0] - [70, 90]).max(axis=1) < 8.5
    rays = mesh.vertices[at & (depth > 0)] - after[0]
    along = rays @ after[1]
    assert np.linalg.norm(rays - along[:, None] * after[1], axis=1).min() < 0.02


def test_a_double_click_centres_nothing_that_is_cropped_away(page):
    page.choose("#crop-y0", "199")
    before = pose(page)
    page.run(
        "document.querySelector('#stage').dispatchEvent(new MouseEvent('dblclick',"
        " {clientX: 70, clientY: 90, bubbles: true}))"
    )
    after = pose(page)
    assert moved(before, after) == 0


def test_keys_work_after_a_control_was_used(page):
    """But for those that the control uses itself."""

    def style() -> str:
        return page.run("document.querySelector('[name=style]:checked').value")

    page.run("document.body.classList.remove('plain'); document.querySelector('#toggle').click()")
    for selector in ("#home", "[name=content][value=both]", "#exposure", "#fly", "#help summary"):
        page.run(f"document.querySelector({selector!r}).focus()")
        assert page.run(f"document.activeElement.matches({selector!r})")
        for key, chosen in (("x", "wireframe"), ("b", "blended")):
            page.key(key)
            assert style() == chosen, selector
    page.run("document.querySelector('#exposure').focus()")
    before = pose(page)
    page.key("ArrowRight")
    page.key("Home")
    page.run("document.querySelector('#cameras').focus()")
    page.key("x")
    assert style() == "blended"
    assert moved(before, pose(page)) == 0
    page.run(  # the list by mouse
        "(list => { list.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}));"
        " list.dispatchEvent(new Event('change', {bubbles: true})); })(document.querySelector('#cameras'))"
    )
    page.key("x")
    assert style() == "wireframe"
    page.run("document.querySelector('#toggle').click()")


@pytest.mark.slow
def test_cameras_by_list_buttons_and_keys(page, cameras):
    assert page.run("[...document.querySelectorAll('#cameras option')].map(o => o.textContent)") == [
        camera.name for camera in cameras
    ]

    def at(index: int) -> None:
        position, direction = pose(page)
        assert np.allclose(position, cameras[index].center, rtol=2e-3, atol=2e-3)
        assert np.allclose(direction, cameras[index].world_to_camera[2, :3], atol=2e-3)
        assert page.run("document.querySelector('#cameras').value") == str(index)

    at(0)
    page.choose("#cameras", "2")
    at(2)
    page.key("]")
    at(0)
    page.key("[")
    at(2)
    page.run("document.querySelector('#previous').click()")
    at(1)
    page.run("document.querySelector('#next').click()")
    at(2)
    page.key("Home")
    at(0)
    page.drag(100, 80, 30, 10)
    page.run("document.querySelector('#home').click()")
    at(0)


# ---- The image


def layered_splats(camera: ms.Camera) -> ms.SplatMesh:
    """Splats of two quads, one behind the other, that cover the image, among them some at one depth: in their
    own order quite another picture than sorted by triangles."""
    rng = np.random.default_rng(0)
    near = np.array([2, 2.5, 2.2, 2.2, 1.8, 2.5])
    depths = np.stack([near, near + 0.6], axis=1).ravel()
    corners = np.array([(-4, -4), (12, -4), (-4, 12)])
    points = np.stack([np.column_stack([corners * z, [z] * 3]) for z in depths])
    matrix = camera.world_to_camera
    points = (points - matrix[:3, 3]) @ matrix[:3, :3]
    colors = np.repeat(np.column_stack([rng.random((12, 3)), np.full(12, 0.4)]), 3, axis=0)
    return ms.SplatMesh(
        points.reshape(-1, 3),
        np.arange(36).reshape(-1, 3),
        colors,
        face_splat=np.arange(12) // 2,
        order="splat",
    )


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True], ids=["fans", "shared vertices"])
def test_webgl_draws_meshes_in_the_order_of_their_splats(browser, write_page, cameras, shared):
    mesh = layered_splats(cameras[0])
    if shared:  # by a triangle without area: stored as a mesh without fans
        faces, splats = np.append(mesh.faces, [[0, 1, 1]], axis=0), np.append(mesh.face_splat, 6)
        mesh = replace(mesh, faces=faces, face_splat=splats)
    camera = replace(cameras[0], width=WIDTH, height=HEIGHT)
    image = levels(ms.render(mesh, camera).color)
    assert np.ptp(image[:, :, 0]) == 0  # all see the same layers
    exact = levels(ms.render(mesh, camera, order="fragment").color)
    assert np.abs(image - exact).max() > 20
    page = open_page(browser, write_page(mesh, "by splat", cameras=cameras[:1]))
    assert page.run("document.body.dataset.renderer") == "sorted"
    assert "WebGL draws whole splats sorted by their centres" in page.text("#notes")
    page.run("document.body.classList.add('plain')")
    page.still(PATIENCE)
    assert np.abs(page.screenshot().astype(int) - image).max() <= 2
    page.close()


def test_sorted_triangles_are_close_to_the_exact_image(page, mesh, cameras):
    page.size(cameras[0].width, cameras[0].height)
    page.still(PATIENCE)
    image = page.screenshot().astype(int)
    assert ms.psnr(image / 255, ms.render(mesh, cameras[0], samples=2).color) > 26
    assert "this browser has no WebGPU" in page.text("#notes")
    assert page.run("document.querySelector('#message').hidden")  # nothing over the subject
    assert page.run("document.querySelector('#renderer').value") == "sorted"
    assert page.run("document.querySelector('#renderer option').disabled")
    assert page.run("document.querySelector('#samples').disabled")


def test_opaque_triangles_are_those_of_a_depth_buffer(page, mesh, cameras):
    page.size(cameras[0].width, cameras[0].height)
    page.key("o")
    page.still(PATIENCE)
    image = page.screenshot() / 255
    solid = ms.render(mesh, cameras[0], samples=2, cutoff=0).color
    assert ms.psnr(image, solid) > 24
    assert ms.psnr(image, ms.render(mesh, cameras[0], samples=2).color) < 20
    page.key("b")
    page.still(PATIENCE)
    assert ms.psnr(page.screenshot() / 255, solid) < 20


def test_the_wireframe_shows_edges_and_what_is_between_them(page):
    solid = page.screenshot().astype(int)
    page.key("x")
    page.still(PATIENCE)
    wires = page.screenshot().astype(int)
    drawn = np.abs(wires - 255).max(axis=-1) > 8
    assert 0.02 < drawn.mean() < 0.9
    assert np.abs(wires - solid).mean() > 2


@pytest.mark.slow
def test_splats_and_the_divider(page, cloud, cameras):
    page.size(cameras[0].width, cameras[0].height)
    page.still(PATIENCE)
    mesh_only = page.screenshot().astype(int)
    page.key("3")
    page.still(PATIENCE)
    splats_only = page.screenshot().astype(int)
    expected = ms.render_splats(cloud, cameras[0], sh_degree=0).color
    assert ms.psnr(splats_only / 255, expected) > 45
    page.key("2")
    page.still(PATIENCE)
    both = page.screenshot().astype(int)
    half = cameras[0].width // 2
    assert np.array_equal(both[:, : half - 1], splats_only[:, : half - 1])
    assert np.array_equal(both[:, half + 1 :], mesh_only[:, half + 1 :])
    page.run("document.body.classList.remove('plain'); document.querySelector('#divider').focus()")
    for key, value in (("ArrowRight", 52), ("PageUp", 62), ("ArrowLeft", 60), ("PageDown", 50), ("Home", 0)):
        page.key(key)
        assert page.run("document.querySelector('#divider').getAttribute('aria-valuenow')") == str(value)
    page.key("End")
    page.run("document.body.classList.add('plain')")
    page.still(PATIENCE)
    assert np.array_equal(page.screenshot(), splats_only)
    page.size(WIDTH, HEIGHT)
    page.run("document.body.classList.remove('plain')")
    page.run(
        "const toggle = document.querySelector('#toggle');"
        " if (toggle.getAttribute('aria-expanded') === 'true') toggle.click()"
    )
    page.still(PATIENCE)
    page.drag(WIDTH - 3, 60, -60, 0)
    assert page.run("document.querySelector('#divider').getAttribute('aria-valuenow')") == str(
        int(100 * (WIDTH - 63) / WIDTH + 0.5)
    )
    assert moved((np.array(cameras[0].center),), pose(page)) < 0.01
    page.key("1")


def test_background_and_exposure(page):
    page.choose("#background", "#3366cc")
    page.still(PATIENCE)
    blue = page.screenshot().astype(int)
    assert blue[2, 2].tolist() == [0x33, 0x66, 0xCC]
    page.choose("#exposure", "2")
    page.still(PATIENCE)
    bright = page.screenshot().astype(int)
    assert bright[2, 2].tolist() == [0x33, 0x66, 0xCC]
    assert page.text("#exposureText") == "+2 EV"
    drawn = np.abs(blue - [0x33, 0x66, 0xCC]).max(axis=-1) > 60
    assert (bright[drawn].mean(axis=0) > blue[drawn].mean(axis=0) + 20).all()


@pytest.mark.slow
def test_the_crop_box_hides_what_is_outside_and_shows_its_edges(page, mesh):
    whole = page.screenshot().astype(int)
    count = len(mesh.faces)
    for axis in "xyz":
        parts = []
        for end in (0, 1):
            page.choose(f"#crop-{axis}{end}", "100")
            page.still(PATIENCE)
            parts.append(int(page.statistics()["triangles"].split(" of ")[0].replace(",", "")))
            page.run("document.querySelector('#uncrop').click()")
        assert min(parts) > 0
        assert sum(parts) == count  # each splat is on one side
    page.choose("#crop-x0", "90")
    page.choose("#crop-x1", "120")
    page.still(PATIENCE)
    assert np.abs(page.screenshot().astype(int) - whole).mean() > 1
    words = page.text("#cropText").split()
    assert words[0] == "--crop"
    low, high = np.array([float(word) for word in words[1:]]).reshape(2, 3)
    assert (low < high).all()
    page.choose("#crop-x0", "190")  # not beyond the other end
    assert page.run("document.querySelector('#crop-x0').value") == "119"
    assert page.run(
        "!document.querySelector('#box').hidden"
        " && document.querySelector('#box path').getAttribute('d').length > 50"
    )
    page.run("document.querySelector('#uncrop').click()")
    page.still(PATIENCE)
    assert np.array_equal(page.screenshot(), whole)
    assert page.text("#cropText") == ""


def test_the_crop_line_is_that_of_the_commands(browser, write_page):
    """In the coordinates of the world, and without a bound where a slider is at its end."""
    cloud = make_scene(300)
    means = cloud.means.copy()
    means[0] = means.max(axis=0) + np.array([90, 0, 90])  # far beyond the sliders' ends
    cloud = replace(cloud, means=means, origin=np.array([500_000.0, 4_500_000.0, 100.0]))
    address = write_page(ms.convert(cloud), "crop-line", splats=cloud)
    page = open_page(browser, address)
    for end, mark in ((0, "60"), (1, "150")):
        page.choose(f"#crop-y{end}", mark)
        page.still(PATIENCE)
        option, *box = page.text("#cropText").split()
        assert option == "--crop"
        left = len(cropped(cloud, [float(number) for number in box]))
        assert 0 < left < len(cloud)
        assert page.statistics()["splats"] == f"{left} of {len(cloud)}"
    assert page.run("document.querySelector('#crop-x0').getAttribute('aria-valuetext')") == "no bound"
    assert float(page.run("document.querySelector('#crop-y0').getAttribute('aria-valuetext')")) > 4_499_000
    assert float(page.statistics()["position"].split()[0]) > 499_000
    page.close()


# ---- The page around the image


def test_statistics_say_what_is_drawn(page, mesh, cloud):
    rows = page.statistics()
    assert rows["triangles"] == f"{len(mesh.faces):,}"
    assert rows["vertices"] == f"{len(mesh.vertices):,}"
    assert rows["splats"] == f"{len(cloud):,}"
    assert rows["image"] == f"{WIDTH} × {HEIGHT}"
    assert re.fullmatch(r"[\d.]+ bytes a triangle", rows["data"])


@pytest.mark.slow
def test_the_panel_closes_and_everything_can_be_hidden(browser, url):
    page = open_page(browser, url, 1000, 700)
    shown = "getComputedStyle(document.querySelector('#{}')).display !== 'none'"
    assert page.run(shown.format("panel"))
    page.click("#toggle")
    assert not page.run(shown.format("panel"))
    assert page.run("document.querySelector('#toggle').getAttribute('aria-expanded')") == "false"
    page.click("#toggle")
    page.run("document.querySelector('#background').focus()")
    page.key("Escape")
    assert not page.run(shown.format("panel"))
    assert page.run("document.activeElement.id") == "toggle"
    page.run("document.activeElement.blur()")
    page.key("h")
    for name in ("bar", "panel"):
        assert not page.run(shown.format(name))
    page.key("h")
    assert page.run(shown.format("bar"))
    page.click("#toggle")
    for summary in ("#crop", "#statistics", "#help"):
        page.click(f"{summary} summary")
        assert page.run(f"document.querySelector('{summary}').open")
    page.still(PATIENCE)
    assert page.problems() == []
    page.close()


@pytest.mark.slow
def test_windows_that_the_settings_would_fill_begin_without_them(browser, url):
    page = open_page(browser, url, 700, 500)
    assert page.run("document.querySelector('#panel').classList.contains('closed')")
    assert page.run("document.querySelector('#toggle').ariaExpanded") == "false"
    page.close()


@pytest.mark.slow
def test_a_page_without_controls_shows_the_scene_alone_until_h(browser, write_page, mesh, tmp_path):
    address = write_page(mesh, "without-controls", options=PageOptions(controls=False))
    page = open_page(browser, address, 360, 240)
    over = "['bar', 'panel', 'message'].filter(id => document.getElementById(id).offsetWidth)"
    assert page.run(over) == []
    page.run("document.querySelector('#stage').focus()")
    page.key("h")
    assert page.run(over) == ["bar"]
    page.close()
    damaged = damage(address, "mesh", tmp_path)
    page = browser.page(damaged, 360, 240)
    page.wait("document.body.dataset.state === 'failed'", PATIENCE)
    assert page.run(over) == ["message"]
    page.close()


@pytest.mark.slow
def test_every_control_has_a_name_and_is_reached_by_tab(browser, url):
    page = open_page(browser, url, 1000, 700)
    page.run("for (const d of document.querySelectorAll('details')) d.open = true")
    page.send("Accessibility.enable")
    nodes = page.send("Accessibility.getFullAXTree")["nodes"]
    roles = {
        "button",
        "checkbox",
        "radio",
        "slider",
        "combobox",
        "ColorWell",
        "application",
        "DisclosureTriangle",
    }
    controls = [node for node in nodes if not node.get("ignored") and node["role"]["value"] in roles]
    names = [node.get("name", {}).get("value", "") for node in controls]
    assert len(controls) >= 24
    assert [node["role"] for node, name in zip(controls, names, strict=True) if not name.strip()] == []
    reached = set()
    for _ in range(40):
        page.send("Input.dispatchKeyEvent", type="keyDown", key="Tab", code="Tab", windowsVirtualKeyCode=9)
        page.send("Input.dispatchKeyEvent", type="keyUp", key="Tab", code="Tab", windowsVirtualKeyCode=9)
        reached.add(page.run("document.activeElement.id || document.activeElement.name"))
    wanted = {"stage", "toggle", "cameras", "previous", "next", "home", "fly", "spin", "content", "style"}
    assert reached >= wanted | {"background", "exposure", "renderer", "crop-x0", "crop-z1", "uncrop"}
    page.close()


@pytest.mark.slow
def test_a_phone_gets_the_scene_first_and_large_controls(browser, url):
    page = open_page(browser, url, 390, 844, mobile=True, ratio=2)
    assert page.run("document.querySelector('#panel').classList.contains('closed')")
    assert page.run("document.querySelector('#sorted').width") == 780
    page.run("document.querySelector('#toggle').click()")
    assert page.run("document.documentElement.scrollWidth") <= 390
    heights = page.run(
        "[...document.querySelectorAll('#panel button, #panel select, .choices label, #toggle')]"
        ".map(e => e.getBoundingClientRect()).filter(r => r.width).map(r => r.height)"
    )
    assert len(heights) > 8
    assert min(heights) >= 40
    panel = page.run("document.querySelector('#panel').getBoundingClientRect().top")
    assert panel > 300  # the scene stays in view
    page.close()


@pytest.mark.slow
def test_cameras_are_flown_to_unless_motion_is_unwelcome(browser, url):
    page = open_page(browser, url, reduced_motion=False)
    page.run("document.querySelector('#statistics').open = true")
    for reduced in (False, True):
        if reduced:
            wish = {"name": "prefers-reduced-motion", "value": "reduce"}
            page.send("Emulation.setEmulatedMedia", features=[wish])
        between = 0
        for index in (1, 0):
            seen = page.run(
                "new Promise(async done => { const seen = []; const place = () => seen.push("
                "[...document.querySelectorAll('#statistics dt')].find(t => t.textContent === 'position')"
                ".nextElementSibling.textContent); place(); const list = document.querySelector('#cameras');"
                f" list.value = '{index}'; list.dispatchEvent(new Event('change'));"
                " do { await new Promise(requestAnimationFrame); place(); }"
                " while (document.body.dataset.state !== 'still'); done(seen); })"
            )
            between += len(set(seen) - {seen[0], seen[-1]})
        assert (between > 0) == (not reduced)
    page.close()


@pytest.mark.slow
def test_hostile_names_are_shown_and_do_nothing(browser, write_page, mesh, cameras):
    named = [replace(camera, name=HOSTILE) for camera in cameras]
    address = write_page(mesh, "hostile", cameras=named, options=PageOptions(title=HOSTILE))
    page = open_page(browser, address)
    assert page.text("h1") == HOSTILE
    assert page.run("document.querySelector('#cameras option').textContent") == HOSTILE
    assert page.run("document.title") == HOSTILE
    assert page.run("document.querySelectorAll('img, iframe').length") == 0
    assert page.problems() == []
    assert page.requests() == [address]
    # The policy stops what would be injected, and all connections.
    page.run("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.bad = 1\">')")
    page.run(
        "const s = document.createElement('script'); s.textContent = 'window.bad = 2';"
        " document.body.append(s)"
    )
    assert page.run("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'stopped')") == "stopped"
    assert page.run("window.bad === undefined")
    page.close()


def text_of(address: str) -> str:
    """The page at an address on the disk."""
    return Path(unquote(urlparse(address).path)).read_text(encoding="utf-8")


def damage(address: str, name: str, folder: Path) -> str:
    """The address of that page with some other data in the block ``name``."""
    whole = text_of(address)
    data = block(whole, name)
    file = folder / "damaged.html"
    file.write_text(whole.replace(data, data[:400] + "AAAA" + data[404:]), encoding="utf-8")
    return file.as_uri()


def test_a_damaged_page_says_so(browser, write_page, mesh, tmp_path):
    page = browser.page(damage(write_page(mesh, "whole"), "mesh", tmp_path), WIDTH, HEIGHT)
    page.wait("document.body.dataset.state === 'failed'", PATIENCE)
    assert len(page.text("#messageText")) > 10
    page.close()


@contextmanager
def served(send: Callable[[BaseHTTPRequestHandler], None]) -> Iterator[str]:
    """The address of a server that answers with ``send``: headers, their end and text."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            send(self)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_page_whose_script_does_not_run_says_so(browser, write_page, mesh):
    def spoken(page: Page) -> str:
        page.run("document.getAnimations().forEach(each => each.finish())")
        words = page.run("document.querySelector('#loading').innerText")
        page.close()
        return words

    address = write_page(mesh, "without-script")
    text = text_of(address)

    def send(handler: BaseHTTPRequestHandler) -> None:
        handler.send_header("Content-Security-Policy", "script-src 'self'")
        handler.end_headers()
        handler.wfile.write(text.encode())

    with served(send) as there:
        page = browser.page(there, WIDTH, HEIGHT)
        assert page.run("getComputedStyle(document.querySelector('#blocked')).opacity") == "0"  # not at once
        assert "the server forbids scripts" in spoken(page)
    page = browser.page("about:blank#off", WIDTH, HEIGHT)
    page.send("Emulation.setScriptExecutionDisabled", value=True)
    page.send("Page.navigate", url=address)
    page.wait("location.protocol === 'file:' && document.readyState === 'complete'")
    words = spoken(page)
    assert words.startswith("This page draws its scene with JavaScript, which does not run here: previews")
    assert words.endswith("with JavaScript switched on.")


@pytest.mark.parametrize("name", ["settings", "mesh", "splats"])
def test_a_page_of_which_the_end_is_missing_says_so(browser, url, tmp_path, name):
    text = text_of(url)
    file = tmp_path / "cut.html"
    file.write_text(text[: text.index(block(text, name)) + 100], encoding="utf-8")
    page = browser.page(file.as_uri(), WIDTH, HEIGHT)
    page.wait("document.body.dataset.state === 'failed'", PATIENCE)
    assert page.text("#messageText") == "This page is incomplete: its download was cut off. Load it again."
    page.close()


@pytest.mark.slow
def test_a_page_that_comes_slowly_says_that_it_is_loading(browser, write_page, mesh):
    text, rest = text_of(write_page(mesh, "slow")), threading.Event()
    half = text.index(block(text, "mesh")) + 1000

    def send(handler: BaseHTTPRequestHandler) -> None:
        handler.send_header("Content-Type", "text/html; charset=utf-8")
        handler.end_headers()
        handler.wfile.write(text[:half].encode())
        rest.wait(PATIENCE)
        handler.wfile.write(text[half:].encode())

    with served(send) as there:
        page = browser.page("about:blank#slow", WIDTH, HEIGHT, before=NO_WEBGPU)
        page.send("Page.navigate", url=there)
        page.wait("document.querySelector('#mesh')")
        assert page.run("document.readyState") == "loading"
        words = page.run("document.querySelector('#loading').innerText")
        rest.set()
        page.still(PATIENCE)
        page.close()
    assert words == "Loading the scene"


def test_a_lost_graphics_device_is_waited_for(page):
    image = page.screenshot()
    page.run(
        "window.loss = document.querySelector('#sorted').getContext('webgl2')"
        ".getExtension('WEBGL_lose_context'); loss.loseContext()"
    )
    page.wait("document.body.dataset.state === 'lost'")
    page.drag(100, 20, 40, 0)
    page.wait("document.body.dataset.state === 'lost'")
    assert page.run("document.querySelector('#message').offsetWidth > 0")
    assert "The graphics device was lost" in page.text("#messageText")
    page.run("loss.restoreContext()")
    page.still(PATIENCE)
    assert page.run("document.querySelector('#message').hidden")
    assert not np.array_equal(page.screenshot(), image)  # as the view was turned meanwhile
    page.run("document.querySelector('#home').click()")
    page.still(PATIENCE)
    assert np.array_equal(page.screenshot(), image)


@pytest.mark.slow
def test_a_device_that_is_lost_before_the_first_image_is_waited_for(browser, url):
    """And one that is lost again as soon as it is back."""
    losing = """
    const get = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (...words) {
      const context = get.apply(this, words);
      window.times = (window.times ?? 0) + 1;
      window.loss ??= context.getExtension("WEBGL_lose_context");
      if (times <= 2) loss.loseContext();
      return context;
    };
    """
    page = browser.page(url, WIDTH, HEIGHT, before=NO_WEBGPU + losing)
    for times in (1, 2):
        page.wait(f"window.times === {times} && document.body.dataset.state === 'lost'", PATIENCE)
        page.run("new Promise(done => setTimeout(done, 100)).then(() => loss.restoreContext())")
    page.wait("window.times === 3")
    page.still(PATIENCE)
    assert page.run("document.querySelector('#message').hidden")
    assert np.ptp(page.screenshot()[:, : WIDTH // 2]) > 100  # a scene
    assert page.problems() == []
    page.close()


def test_the_page_decodes_what_python_decodes(browser, mesh, cloud):
    """Meshes bit for bit, with and without fans; splats nearly."""
    page = browser.page("about:blank#decoding", WIDTH, HEIGHT)
    source = re.sub(r"^export ", "", _read("scene.js"), flags=re.MULTILINE)
    page.run(
        source + "; window.decode = async text => { const m = decodeMesh(await unpack(text));"
        " const harmonics = m.harmonics && Float32Array.from(m.harmonics.values, v => v * m.harmonics.step);"
        " return [m.vertices, m.colors, m.faces, m.splat, m.group, harmonics].map(a => a && [...a]); }; 0"
    )
    groups = np.arange(len(mesh.faces), dtype=np.int32) % 7 - 1
    assert mesh.harmonics is not None
    for each in (mesh, replace(mesh, face_splat=None, harmonics=None, depth_group=groups)):
        data = make_page(each).mesh.data
        found = page.run(f"decode('{base64.b64encode(data).decode()}')")
        vertices, colors, faces, splat, group, harmonics = found
        back = unpack_mesh(data)
        assert np.array_equal(np.array(vertices, np.float32), back.vertices.ravel())
        assert np.array_equal(np.array(colors, np.float32), back.colors.ravel())
        assert faces == back.faces.ravel().tolist()
        assert splat == (None if back.face_splat is None else back.face_splat.tolist())
        assert group == (None if back.depth_group is None else back.depth_group.tolist())
        assert harmonics == (None if back.harmonics is None else back.harmonics.ravel().tolist())

    page.run(
        "window.splats = async text => { const s = decodeSplats(await unpack(text));"
        " return [s.means, s.covariances, s.colors].map(a => [...a]); }; 0"
    )
    found = page.run(f"splats('{base64.b64encode(pack_splats(cloud)).decode()}')")
    means, upper, colors = (np.array(values).reshape(len(cloud), -1) for values in found)
    assert np.abs(means - cloud.means).max() < 1e-3
    axes = cloud.rotations * cloud.scales[:, None]
    covariances = axes @ axes.transpose(0, 2, 1)
    rows, columns = np.triu_indices(3)
    size = covariances.trace(axis1=1, axis2=2)[:, None]
    assert (np.abs(upper - covariances[:, rows, columns]) / size).max() < 0.02
    assert np.abs(colors[:, :3] - 255 * cloud.colors).max() <= 0.501
    assert np.abs(colors[:, 3] - 255 * cloud.opacities).max() <= 0.501
    page.close()


def test_levels_round_as_screenshots_do():
    assert levels(np.array([0.5, -1, 2])).tolist() == [128, 0, 255]


# ---- Large scenes

COUNTING = """
window.drawn = [];
for (const name of ['drawElements', 'drawArrays', 'drawArraysInstanced']) {
  const before = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...words) {
    before.apply(this, words);
    window.drawn.push([name, name === 'drawElements' ? words[1] : words[2]]);
    window.after?.();
  };
}
"""


PART = 1 << 18
"""Triangles of a draw call."""


def with_many_triangles(mesh: ms.SplatMesh, camera: ms.Camera) -> ms.SplatMesh:
    """The mesh, of no harmonics, with so many triangles without area in the middle of its depths that a draw
    call ends among its nearest ones. They cost a driver in software next to nothing."""
    middle = np.argsort(camera.project(mesh.vertices)[1])[len(mesh.vertices) // 2]
    flat = np.full((PART - len(mesh.faces) * 3 // 4, 3), middle)
    splats = np.full(len(flat), mesh.face_splat.max() + 1)
    return ms.SplatMesh(
        mesh.vertices,
        np.concatenate([mesh.faces, flat]),
        mesh.colors,
        face_splat=np.append(mesh.face_splat, splats),
    )


@pytest.fixture(scope="module")
def large_page(browser, write_page):
    """More triangles than one draw call takes."""
    cloud = make_scene(2000)
    cameras = ms.orbit(cloud, 1, width=WIDTH, height=HEIGHT, elevation=20, distance=0.9)
    mesh = with_many_triangles(ms.convert(cloud, colors="base"), cameras[0])
    page = open_page(browser, write_page(mesh, "large", cameras=cameras), before=COUNTING)
    page.run("document.body.classList.add('plain')")
    page.still(PATIENCE)
    yield page, mesh, cameras[0]
    assert page.problems() == []
    page.close()


def drawn_at_rest(page: Page) -> list[list]:
    page.run("document.querySelector('#home').click()")
    page.wait("document.body.dataset.state === 'moving'")
    page.run("window.drawn = []; 0")
    page.still(PATIENCE)
    return page.run("window.drawn")


@pytest.mark.slow
def test_many_triangles_are_drawn_in_parts_by_their_indices(large_page):
    page, mesh, camera = large_page
    counts = [count for name, count in drawn_at_rest(page) if name == "drawElements"]
    part, whole = 3 * PART, 3 * len(mesh.faces)
    assert counts[-2:] == [part, whole - part]
    assert not any(name == "drawArraysInstanced" for name, _ in page.run("window.drawn"))
    image = page.screenshot() / 255
    expected = ms.render(mesh, camera, samples=2).color
    assert ms.psnr(image, expected) > 26
    # Each part has much to show.
    depths = camera.project(mesh.vertices[mesh.faces].mean(axis=1))[1]
    nearest = np.isin(np.arange(len(depths)), np.argsort(depths)[: len(depths) - PART])
    for one in (nearest, ~nearest):
        assert ms.psnr(ms.render(mesh.take(one), camera, samples=2).color, expected) < 20


@pytest.mark.slow
def test_a_movement_ends_the_drawing_of_what_is_no_longer_wanted(large_page):
    page, mesh, _ = large_page
    drawn_at_rest(page)
    part, whole = 3 * PART, 3 * len(mesh.faces)
    # Changes the view again after the first part of the image at rest, which is the second large one.
    page.run(
        "window.drawn = []; window.after = () => {"
        f" if (drawn.filter(one => one[1] === {part}).length < 2) return;"
        " delete window.after; document.querySelector('#home').click(); };"
        " document.querySelector('#home').click()"
    )
    page.still(PATIENCE)
    counts = [count for name, count in page.run("window.drawn") if name == "drawElements"]
    assert counts == [part, whole - part, part, part, whole - part, part, whole - part]


@pytest.fixture(scope="module")
def two_levels(write_page, mesh, cloud, cameras):
    """The address of a page with a coarse level, and that level."""
    coarse = ms.convert(ms.simplify(cloud, 60))
    return write_page(mesh, "levels", splats=cloud, coarse=coarse, cameras=cameras), coarse


LEVELS = """
window.levels = [];
new MutationObserver(() => {
  const { level, state } = document.body.dataset, found = `${state} ${level}`;
  if (level && levels.at(-1) !== found) levels.push(found);
}).observe(document, { attributes: true, subtree: true, attributeFilter: ['data-level'] });
"""


@pytest.mark.slow
def test_the_coarse_level_comes_first_and_moves_and_the_fine_one_rests(browser, two_levels, mesh, cameras):
    address, coarse = two_levels
    page = open_page(browser, address, cameras[0].width, cameras[0].height, before=COUNTING + LEVELS)
    page.run("document.body.classList.add('plain')")
    page.still(PATIENCE)
    seen = page.run("levels")
    assert seen[0] == "moving coarse"
    assert "preparing coarse" in seen
    assert seen[-1] == "still fine"
    page.run("levels.length = drawn.length = 0; document.querySelector('#next').click()")
    page.still(PATIENCE)
    assert page.run("levels") == ["moving coarse", "still fine"]
    counts = [count for name, count in page.run("drawn") if name == "drawElements"]
    assert set(counts[:-1]) == {3 * len(coarse.faces)}
    assert counts[-1] == 3 * len(mesh.faces)
    rest = page.screenshot() / 255
    fine, other = (ms.render(each, cameras[1], samples=2).color for each in (mesh, coarse))
    assert ms.psnr(rest, fine) > 26 > ms.psnr(other, fine)
    assert page.statistics()["triangles"] == f"{len(mesh.faces):,}"
    assert page.problems() == []
    page.close()


@pytest.mark.slow
def test_the_crop_box_crops_both_levels(browser, two_levels, mesh):
    address, coarse = two_levels
    page = open_page(browser, address, before=COUNTING)
    page.run("drawn.length = 0; 0")
    page.choose("#crop-x0", "100")
    page.still(PATIENCE)
    counts = [count for name, count in page.run("drawn") if name == "drawElements"]
    box = tuple(float(word) for word in page.text("#cropText").split()[1:])
    few, many = (len(cropped(each, box).faces) for each in (coarse, mesh))
    assert (counts[0], counts[-1]) == (3 * few, 3 * many)
    assert 0 < few < len(coarse.faces)
    page.close()


@pytest.mark.slow
def test_a_phone_draws_the_coarse_level_and_unpacks_the_fine_one_when_asked(browser, two_levels, mesh):
    address, coarse = two_levels
    page = open_page(browser, address, mobile=True)
    few, many = f"{len(coarse.faces):,}", f"{len(mesh.faces):,}"
    assert page.run("document.body.dataset.level") == "coarse"
    assert page.statistics()["triangles"] == few
    assert page.run("document.querySelector('#mesh') !== null")  # still packed
    assert page.run("[...document.querySelectorAll('#detail option')].map(o => o.textContent)") == [
        f"{many} triangles",
        f"{few} triangles",
    ]
    page.choose("#detail", "fine")
    page.wait("document.body.dataset.level === 'fine'", PATIENCE)
    page.still(PATIENCE)
    assert page.statistics()["triangles"] == many
    assert page.run("document.querySelector('#mesh') === null")
    page.choose("#detail", "coarse")
    page.still(PATIENCE)
    assert page.statistics()["triangles"] == few
    assert page.problems() == []
    page.close()


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize(("width", "height", "mobile"), [(390, 844, False), (820, 1180, True)])
def test_small_screens_and_tablets_are_no_phones(browser, two_levels, width, height, mobile):
    screen = f"for (const [k, v] of [['width', {width}], ['height', {height}]])"
    screen += " Object.defineProperty(Screen.prototype, k, { get: () => v });"
    page = open_page(browser, two_levels[0], mobile=mobile, before=screen)
    assert page.run("document.body.dataset.level") == "fine"
    page.close()


@pytest.mark.slow
def test_a_page_without_a_coarse_level_has_no_choice_of_levels(browser, url):
    page = open_page(browser, url, mobile=True)
    assert page.run("document.querySelector('#detailLine').hidden")
    assert page.run("document.body.dataset.level") == "fine"
    page.close()


SHORT_MOMENTS = """
const later = window.setTimeout;
window.setTimeout = (call, time, ...words) => later(call, time > 5000 ? 500 : time, ...words);
"""


@pytest.mark.slow
def test_a_damaged_fine_level_leaves_the_coarse_one(browser, two_levels, tmp_path):
    page = open_page(browser, damage(two_levels[0], "mesh", tmp_path), before=SHORT_MOMENTS)
    assert page.run("document.body.dataset.level") == "coarse"
    assert "Only the coarse mesh is shown" in page.text("#messageText")
    page.wait("document.querySelector('#message').hidden")  # over the scene for a moment
    assert "Only the coarse mesh is shown" in page.text("#notes")
    page.close()
