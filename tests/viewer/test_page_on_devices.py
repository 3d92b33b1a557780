"""Screens, keyboards and graphics devices of many kinds: what the page makes of them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from _browser import Browser, Page
from _fake_webgpu import FAKE_WEBGPU
from _pages import cameras_fixture, cloud_fixture, mesh_fixture  # noqa: F401 - fixtures
from test_controls import HEIGHT, PATIENCE, WIDTH, moved, open_page, pose, text_of, turned
from test_surface_in_page import SIDE, box, camera, expected, plain, press, same

import meshsplats as ms
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.viewer import page as pages
from meshsplats.webgpu import frames

SHORT_TIMES = """
const later = window.setTimeout;
window.setTimeout = (call, time, ...words) => later(call, time > 1000 ? 20 : time, ...words);
"""


@pytest.fixture
def other_numbers(monkeypatch) -> Callable[..., None]:
    """Writes other numbers for those of a module of the page: constants of smaller scenes."""

    def write(module: str, **numbers: str) -> None:
        read = pages._read

        def changed(name: str) -> str:
            text = read(name)
            for constant, number in numbers.items() if name == module else ():
                text, count = re.subn(rf"\b{constant} = [^;,\n]+", f"{constant} = {number}", text, count=1)
                assert count == 1
            return text

        monkeypatch.setattr(pages, "_read", changed)

    return write


@pytest.fixture(scope="module")
def url(write_page, mesh, cloud, cameras):
    return write_page(mesh, "devices", splats=cloud, cameras=cameras)


def width(page: Page) -> int:
    return page.run("document.querySelector('#sorted').width")


# ---- The near plane


def test_the_near_plane_is_that_of_the_camera_until_one_comes_nearer(browser):
    source = re.sub(r"^export ", "", pages._read("camera.js"), flags=re.MULTILINE)
    page = browser.page("about:blank#near", WIDTH, HEIGHT)
    lens = {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 10], "fx": 500, "fy": 500, "cx": 250, "cy": 250}
    lens |= {"width": 500, "height": 500}

    def planes(near: float, *steps: str) -> list[float]:
        """After each of the steps, one after the other; the scene has the radius 5."""
        text = ", ".join(f"({step}, view.pinhole(9, 9).near)" for step in steps)
        given = json.dumps(lens | {"near": near})
        return page.run(
            f"(() => {{ {source}; const view = new View({given}, [0, -1, 0], 10);"
            f" const zoom = (by, n = 1) => {{ while (n--) view.zoom(by, 5); }}; return [{text}]; }})()"
        )

    zooming = planes(0.1, "view.orbit(1, 1)", "zoom(0.8)", "zoom(0.8, 60)", "zoom(1.25, 60)")
    assert zooming == pytest.approx([0.1, 0.1, 0.1 * 5e-3, 0.1])
    # A near plane that cuts the scene open.
    cutting = planes(8, "view.orbit(1, 1)", "view.pan(9, 9, 9, 9)", "zoom(0.8)", "zoom(0.5)")
    assert cutting == pytest.approx([8, 8, 0.8, 0.4])
    flying = planes(0.1, "view.move(0, 0, 1, 5)", "zoom(1.25)", "view.orbit(1, 1)")
    assert flying == pytest.approx([5e-3] * 3)
    assert planes(0.1, "view.move(0, 0, 1, 5)", "zoom(0.5, 60)")[1] == pytest.approx(0.1 * 5e-3)
    assert planes(1e-5, "view.move(0, 0, 1, 5)", "zoom(0.8)") == pytest.approx([1e-5] * 2)
    page.close()


def test_what_one_zooms_at_does_not_vanish(browser, write_page):
    """A square through the pivot, as triangles and as a surface, to the end of zooming."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces, red = np.array([[0, 1, 2], [0, 2, 3]]), np.tile(np.float32([1, 0, 0, 1]), (4, 1))
    view = ms.look_at([0, 0, 4.0], [0, 0, 0], up=(0, -1, 0), width=SIDE, height=SIDE, near=0.04)
    address = write_page(
        ms.SplatMesh(square, faces, red), "zoom", surface=BaseMesh(square, faces, red), cameras=[view]
    )
    page = open_page(browser, address, SIDE, SIDE)
    plain(page)
    page.run(
        "for (let i = 0; i < 60; i++)"
        " document.body.dispatchEvent(new KeyboardEvent('keydown', {key: '+', bubbles: true}))"
    )
    page.still(PATIENCE)
    for kind in ("mesh", "surface"):
        assert np.ptp(press(page, kind) - np.uint8([255, 0, 0])) == 0
    page.close()


def test_a_depth_buffer_sorts_after_a_flight(browser, write_page):
    """A red square close before a blue one, at two radii of the scene."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    red, blue = (np.tile(np.float32([*rgb, 1]), (4, 1)) for rgb in ((1, 0, 0), (0, 0, 1)))
    places = np.concatenate([square - np.float32([0, 0, 0.004]), square])
    both = BaseMesh(places, np.concatenate([faces, faces + 4]), np.concatenate([blue, red]))
    view = ms.look_at([0, 3, 6.0], [0, 0, 0], up=(0, -1, 0), width=SIDE, height=SIDE, fov=30)
    page = open_page(browser, write_page(both, "flight", cameras=[view]), SIDE, SIDE)
    plain(page)
    page.key("d")
    page.key("a")
    page.still(PATIENCE)
    image = page.screenshot()
    assert (image[..., 0] > 250).all()
    assert (image[..., 1] < 50).sum() > 5000
    page.close()


# ---- Screens


def test_the_image_at_rest_has_all_pixels_of_the_screen(browser, url):
    asking = """
    const ask = window.matchMedia, queries = [];
    window.matchMedia = text => queries[queries.push(ask.call(window, text)) - 1];
    """
    page = open_page(browser, url, ratio=3, before=asking)
    assert width(page) == 3 * WIDTH
    assert page.text("#status") == "sorted"
    for ratio in (1, 2):  # on another screen, of which an emulated one does not tell
        page.size(WIDTH, HEIGHT, ratio=ratio)
        page.run(
            "queries.filter(({ media }) => media.includes('resolution')).at(-1)"
            ".dispatchEvent(new MediaQueryListEvent('change'))"
        )
        page.still(PATIENCE)
        assert width(page) == ratio * WIDTH
    page.close()


NOTING = """
window.sizes = [];
const store = WebGL2RenderingContext.prototype.texStorage2D;
WebGL2RenderingContext.prototype.texStorage2D = function (target, levels, format, ...size) {
  if (format === 0x881A) sizes.push(size); // RGBA16F: frames
  store.call(this, target, levels, format, ...size);
};
for (const name of ['drawElements', 'drawArraysInstanced']) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...words) {
    draw.apply(this, words);
    window.drawn?.(this);
  };
}
"""


def test_large_images_are_drawn_in_strips_and_given_up_when_something_moves(
    browser, url, write_page, mesh, cloud, cameras, other_numbers
):
    other_numbers("sorted.js", FILL=str(WIDTH * 25))
    striped = write_page(mesh, "strips", splats=cloud, cameras=cameras)
    images = []
    for address in (url, striped):
        page = open_page(browser, address, before=NOTING)
        plain(page)
        images.append([press(page, "mesh"), press(page, "splats")])
        page.key("1")
        for key in "ox":
            page.key(key)
            page.still(PATIENCE)
            images[-1].append(page.screenshot())
    for whole, strips in zip(*images, strict=True):
        assert (whole != 255).any()
        assert (whole == strips).all()
    page.key("b")
    page.still(PATIENCE)
    # Moves again after the third strip at rest; what moves is smaller.
    page.run(
        "window.strips = 0; window.drawn = gl => {"
        " if (gl.getParameter(gl.VIEWPORT)[2] === gl.canvas.width && ++strips === 3)"
        " document.querySelector('#home').click(); }; document.querySelector('#home').click()"
    )
    page.still(PATIENCE)
    assert page.run("strips") == 3 + -(-HEIGHT // 25)
    assert page.problems() == []
    page.close()


def test_drafts_of_large_images_are_small_and_limits_are_said(
    browser, write_page, mesh, cameras, other_numbers
):
    most = WIDTH * HEIGHT // 4
    other_numbers("app.js", DRAFT_PIXELS=str(most), MOST_PIXELS="4 * 4 * 4e3")
    page = open_page(browser, write_page(mesh, "drafts", cameras=cameras), ratio=4, before=NOTING)
    assert page.text("#status") == "sorted, 0.1 of 0.5 million pixels"
    assert 63_000 < width(page) * page.run("document.querySelector('#sorted').height") <= 64_000
    page.run("sizes.length = 0; document.querySelector('#spin').click()")
    page.run("new Promise(done => setTimeout(done, 500))")
    drafts = page.run("sizes")
    page.run("document.querySelector('#spin').click()")
    assert drafts
    assert max(w * h for w, h in drafts) < 1.1 * most
    page.close()


def test_nothing_lies_under_a_notch(browser, url):
    page = open_page(browser, url, 800, 360)
    insets = {"left": 50, "right": 40, "top": 0, "bottom": 21}
    page.send("Emulation.setSafeAreaInsetsOverride", insets=insets)
    page.run("document.querySelector('#toggle').click(); document.querySelector('#message').hidden = false")
    bounds = "(e => { const r = e.getBoundingClientRect(); return [r.left, innerWidth - r.right]; })"
    for selector, side, inset in (("h1", 0, 50), ("#toggle", 1, 40), ("#panel", 1, 40), ("#message", 0, 50)):
        assert page.run(f"{bounds}(document.querySelector('{selector}'))")[side] == inset
    page.close()


def test_lists_do_not_make_phones_enlarge_the_page(browser, url):
    for mobile, size in ((False, "14px"), (True, "16px")):
        page = open_page(browser, url, 800, 360, mobile=mobile)
        assert page.run("getComputedStyle(document.querySelector('#renderer')).fontSize") == size
        page.close()


# ---- Keys


def strike(page: Page, key: str, code: str, kind: str = "keydown", **more: bool) -> None:
    words = {"key": key, "code": code, "bubbles": True, **more}
    page.run(f"document.body.dispatchEvent(new KeyboardEvent('{kind}', {json.dumps(words)})); 0")


@pytest.fixture(scope="module")
def keyboard(browser, url):
    page = open_page(browser, url)
    plain(page)
    yield page
    assert page.problems() == []
    page.close()


@pytest.mark.parametrize(
    ("keys", "style"),
    [
        ([("ч", "KeyX")], "wireframe"),  # Russian
        ([("x", "KeyX")], "wireframe"),
        ([("x", "KeyB")], "wireframe"),  # Dvorak: as it is written on the key
        ([("x", ""), ("b", "")], "blended"),  # a keyboard on the screen
    ],
)
def test_letters_work_on_any_keyboard(keyboard, keys, style):
    strike(keyboard, "b", "KeyB")
    for key, code in keys:
        strike(keyboard, key, code)
    assert keyboard.run("document.querySelector('[name=style]:checked').value") == style


def test_flying_is_by_the_places_of_the_keys(keyboard):
    for key, code, axis in (("z", "KeyW", 1), ("ц", "KeyW", 1), ("o", "KeyS", -1), ("w", "", 1)):
        before = pose(keyboard)
        strike(keyboard, key, code)
        strike(keyboard, key.upper(), code, "keyup")  # as Shift was pressed meanwhile
        after = pose(keyboard)
        assert axis * (after[0] - before[0]) @ before[1] > 0.9 * moved(before, after) > 0
    assert keyboard.run("document.querySelector('[name=style]:checked').value") != "opaque"


def test_brackets_may_need_alt(keyboard):
    chosen = "document.querySelector('#cameras').value"
    keyboard.run("document.querySelector('#home').click()")
    strike(keyboard, "]", "Digit6", altKey=True)  # a German keyboard of a Mac
    assert keyboard.run(chosen) == "1"
    strike(keyboard, "[", "Digit5", altKey=True)
    assert keyboard.run(chosen) == "0"
    strike(keyboard, "x", "KeyX", altKey=True)
    strike(keyboard, "]", "BracketRight", ctrlKey=True)
    assert keyboard.run(chosen) == "0"
    for key, code, content in (('"', "Digit3", "splats"), ("&", "Digit1", "mesh")):  # a French one
        strike(keyboard, key, code)
        assert keyboard.run("document.querySelector('[name=content]:checked').value") == content


def test_a_plus_at_the_place_of_a_digit_zooms(keyboard):
    """That of Czech keyboards is at 1, that of Swiss ones is Shift + 1, of Hungarian ones Shift + 3."""
    chosen = keyboard.run("document.querySelector('[name=content]:checked').value")
    for code in ("Digit1", "Digit3"):
        before = pose(keyboard)
        strike(keyboard, "+", code, shiftKey=True)
        assert moved(before, pose(keyboard)) > 0
        assert keyboard.run("document.querySelector('[name=content]:checked').value") == chosen


def test_the_command_key_ends_a_flight_by_letters(keyboard):
    """macOS does not tell that W goes up while it is down."""
    strike(keyboard, "w", "KeyW")
    keyboard.run("new Promise(done => setTimeout(done, 50))")
    strike(keyboard, "Meta", "MetaLeft", metaKey=True)
    strike(keyboard, "w", "KeyW", metaKey=True, repeat=True)
    strike(keyboard, "Meta", "MetaLeft", "keyup")
    keyboard.still(10)


def test_the_link_to_the_settings_opens_them(browser, url):
    page = open_page(browser, url)
    page.run("document.querySelector('.skip').focus()")
    page.key("Enter")
    assert page.run("document.activeElement.id") == "panel"
    assert page.run("document.querySelector('#panel').checkVisibility()")
    assert page.run("document.querySelector('#toggle').ariaExpanded") == "true"
    assert page.run("location.hash") == ""
    page.close()


def test_a_hand_ends_the_flight_to_another_camera(browser, url, cameras):
    page = open_page(browser, url, reduced_motion=False)
    plain(page)
    wheel = "new WheelEvent('wheel', {deltaY: 50, cancelable: true})"
    press_s = "new KeyboardEvent('keydown', {key: 's', code: 'KeyS', bubbles: true})"
    release_s = "new KeyboardEvent('keyup', {key: 's', code: 'KeyS', bubbles: true})"
    for hands in ([wheel], [press_s, release_s]):
        page.run("document.querySelector('#cameras').value = '0'; document.querySelector('#home').click()")
        page.still(PATIENCE)
        moving = " ".join(f"stage.dispatchEvent({hand});" for hand in hands)
        page.run(
            "(async () => { const stage = document.querySelector('#stage');"
            " document.querySelector('#next').click();"
            " await new Promise(done => setTimeout(done, 150));"
            f" {moving} }})()"
        )
        before, after = (cameras[i].world_to_camera[2, :3] for i in (0, 1))
        found = pose(page)
        assert turned((0, after), found) > 1
        assert turned((0, before), found) > 0.1
    page.close()


# ---- Graphics devices

LIMITED = """
const parameter = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  return name === 0x0D33 ? 256 : parameter.call(this, name); // MAX_TEXTURE_SIZE
};
"""


def test_textures_that_are_too_large_for_webgl_are_made_smaller(browser, write_page):
    base = box()
    pixels = base.textures[0].pixels.repeat(8, axis=0).repeat(8, axis=1)
    base = replace(base, textures=(Texture(pixels, ("clamp", "clamp")),))
    page = open_page(browser, write_page(base, "512", cameras=[camera()]), SIDE, SIDE, before=LIMITED)
    plain(page)
    same(page.screenshot(), expected(base, camera()))
    assert "takes textures of 256 texels here: that of the surface, of 512, is made smaller" in page.text(
        "#notes"
    )
    assert page.problems() == []
    page.close()


def test_colours_of_the_view_that_do_not_fit_into_a_texture_are_left_out(
    browser, write_page, mesh, cameras, other_numbers
):
    other_numbers("sorted.js", WIDTH="1")
    address = write_page(mesh, "many colours", cameras=cameras)
    page = open_page(browser, address, cameras[0].width, cameras[0].height, before=LIMITED)
    plain(page)
    assert "WebGL draws without view-dependent colour" in page.text("#notes")
    wanted = ms.render(replace(mesh, harmonics=None), cameras[0], samples=2).color
    assert ms.psnr(page.screenshot() / 255, wanted) > 26
    assert page.problems() == []
    page.close()


WITHOUT_FLOATS = """
const extension = WebGL2RenderingContext.prototype.getExtension;
WebGL2RenderingContext.prototype.getExtension = function (name) {
  return LACKING.includes(name) ? null : extension.call(this, name);
};
"""


@pytest.mark.parametrize("half", [True, False], ids=["half floats", "none"])
def test_half_floats_suffice_for_webgl(browser, url, half):
    lacking = ["EXT_color_buffer_float"] + ["EXT_color_buffer_half_float"] * (not half)
    script = WITHOUT_FLOATS.replace("LACKING", json.dumps(lacking))
    page = open_page(browser, url, before=script + NOTING)
    assert bool(page.run("sizes.length")) == half
    assert ("faint layers are lost" in page.text("#notes")) != half
    assert np.ptp(page.screenshot()[:, : WIDTH // 2]) > 100  # a scene
    assert page.problems() == []
    page.close()


NO_SPLATS = """
const storage = WebGL2RenderingContext.prototype.texStorage2D;
WebGL2RenderingContext.prototype.texStorage2D = function (target, levels, format, ...size) {
  if (format === 0x8814) throw new Error('too much'); // RGBA32F: splats
  storage.call(this, target, levels, format, ...size);
};
"""


def test_what_webgl_cannot_draw_leaves_the_other_contents(browser, url):
    page = open_page(browser, url, before=NO_SPLATS)
    plain(page)
    image = page.screenshot()
    page.key("2")
    page.still(PATIENCE)
    assert page.text("#messageText") == "The splats cannot be drawn here: too much"
    assert page.run("[...document.querySelectorAll('[name=content]:enabled')].map(e => e.value)") == ["mesh"]
    assert page.run("document.querySelector('#divider').hidden")
    assert (page.screenshot() == image).all()
    assert page.problems() == []
    page.close()


DYING = """
const ask = WebGL2RenderingContext.prototype.getProgramParameter;
WebGL2RenderingContext.prototype.getProgramParameter = function (...words) {
  if (!window.dying) return ask.apply(this, words);
  const loss = this.getExtension('WEBGL_lose_context');
  for (const [call, time] of [['loseContext', 50], ['restoreContext', 400]])
    setTimeout(() => { window.dying = false; loss[call](); window.called = call; }, time);
  return false;
};
"""


def test_nothing_is_withdrawn_as_a_device_of_webgl_goes(browser, url):
    page = open_page(browser, url, before=DYING)
    page.run("window.dying = true")
    page.key("3")
    page.wait("window.called === 'restoreContext'", PATIENCE)
    page.still(PATIENCE)
    assert page.text("#status") == "splats"
    assert page.run("document.querySelectorAll('[name=content]:enabled').length") == 3
    assert page.problems() == []
    page.close()


FULL_FOR_MESHES = """
const create = FakeDevice.prototype.createBuffer;
FakeDevice.prototype.createBuffer = function (words) {
  gpu.full = words.size > 1 << 16; // larger than those of a renderer without a mesh
  return create.call(this, words);
};
"""


def fake_page(browser: Browser, url: str, before: str = "", **more: bool) -> Page:
    page = browser.page(url, WIDTH, HEIGHT, before=FAKE_WEBGPU + SHORT_TIMES + before, **more)
    page.wait("document.body.dataset.renderer === 'exact'", PATIENCE)
    page.still(PATIENCE)
    return page


def test_a_device_of_webgpu_that_is_lost_is_asked_for_again_a_few_times(browser, url):
    page = fake_page(browser, url)
    for devices in (2, 3, 4):
        page.run("gpu.lose('asleep')")
        page.wait(f"gpu.devices === {devices} && document.body.dataset.renderer === 'exact'")
        page.still(PATIENCE)
        assert "was lost (asleep); triangles are drawn by WebGL until it is back." in page.text("#notes")
        assert not page.run("document.querySelector('#renderer option').disabled")
    page.run("gpu.lose('for good')")
    page.wait("document.querySelector('#renderer option').disabled")
    page.still(PATIENCE)
    assert page.run("[gpu.asked, gpu.devices]") == [4, 4]
    assert page.text("#messageText") == (
        "The graphics device was lost (for good); triangles are drawn by WebGL now."
    )
    assert page.run("document.body.dataset.renderer") == "sorted"
    assert page.problems() == []
    page.close()


def test_a_device_that_is_not_back_is_not_asked_for_without_end(browser, url):
    page = fake_page(browser, url)
    page.run("gpu.refuses = true; gpu.lose('driver')")
    page.wait("document.querySelector('#renderer option').disabled")
    page.run("new Promise(done => setTimeout(done, 200))")
    assert page.run("[gpu.asked, gpu.devices]") == [4, 1]
    page.close()


def test_a_device_of_webgpu_that_does_not_draw_is_given_back(browser, url):
    page = fake_page(browser, url)
    page.run("gpu.wait = () => { throw new Error('broken'); }; document.querySelector('#home').click()")
    page.wait("document.querySelector('#renderer option').disabled")
    page.still(PATIENCE)
    assert page.text("#messageText").startswith("The exact image failed (broken)")
    assert page.run("[gpu.devices, gpu.destroyed]") == [1, 1]
    page.close()
    page = browser.page(url, WIDTH, HEIGHT, before=FAKE_WEBGPU + FULL_FOR_MESHES)
    page.wait("document.querySelector('#renderer option').disabled")
    assert page.run("[gpu.devices, gpu.destroyed]") == [1, 1]
    page.close()


def test_without_webgl_a_lost_device_of_webgpu_is_waited_for(browser, url):
    no_webgl = """
    const other = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, ...words) {
      return kind === 'webgl2' ? null : other.call(this, kind, ...words);
    };
    """
    page = fake_page(browser, url, no_webgl)
    page.run("gpu.lose('asleep')")
    page.wait("document.body.dataset.state === 'lost'")
    page.still(PATIENCE)
    assert page.run("document.querySelector('#message').hidden")
    assert page.run("document.body.dataset.renderer") == "exact"
    page.run("gpu.refuses = true; gpu.lose('for good')")
    page.wait("document.querySelector('#renderer option').disabled")
    page.wait("document.body.dataset.state === 'lost'")
    assert page.text("#messageText").startswith("The graphics device was lost.")
    assert page.run("document.querySelector('#message').checkVisibility()")
    page.close()


NO_TRIANGLES = "WebGL2RenderingContext.prototype.vertexAttribPointer = () => { throw new Error('no room'); };"


def test_a_mesh_that_webgl_cannot_draw_is_drawn_by_webgpu(browser, url):
    page = fake_page(browser, url, NO_TRIANGLES)
    page.key("o")
    page.still(PATIENCE)
    assert page.run("document.querySelector('#exact').style.visibility") == "visible"
    assert page.run("document.querySelectorAll('[name=style]:enabled, #renderer:enabled').length") == 0
    assert "WebGL does not draw the mesh here: no room" in page.text("#notes")
    page.key("3")
    page.still(PATIENCE)
    page.key("1")
    page.run("gpu.refuses = true; gpu.lose('for good')")
    page.wait("document.querySelector('#renderer option').disabled")
    page.still(PATIENCE)  # without either, the splats are left
    assert page.text("#messageText") == "The mesh cannot be drawn here: no room"
    assert page.text("#status") == "splats"
    assert page.run("document.querySelectorAll('[name=style]:disabled, #renderer:disabled').length") == 0
    assert page.problems() == []
    page.close()


def test_an_exact_image_in_strips_is_given_up_when_something_moves(browser, write_page, mesh, monkeypatch):
    monkeypatch.setattr(frames, "WINDOW_SAMPLES", WIDTH * 16)
    page = fake_page(browser, write_page(mesh, "exact strips"))
    strips = HEIGHT // 16
    counts = []
    # In the end, something moves at the third strip of the second sample.
    for wait in (
        "null",
        "null",
        "() => { if (document.body.dataset.state !== 'refining') return; count++;"
        " if (count === 3) { gpu.wait = null; document.querySelector('#home').click(); } }",
    ):
        page.run(
            f"window.count = 0; gpu.frames = []; gpu.wait = {wait}; document.querySelector('#home').click()"
        )
        page.still(PATIENCE)
        counts.append(page.run("gpu.frames.length"))
    assert counts[1] == 5 * strips  # the one that moves, and four samples
    assert counts[2] == counts[1] + 2 * strips + 3
    page.close()


def test_a_fine_level_that_webgpu_has_no_room_for_is_forgotten(browser, write_page, mesh, cloud, cameras):
    coarse = ms.convert(ms.simplify(cloud, 60))
    address = write_page(mesh, "no room", splats=cloud, coarse=coarse, cameras=cameras)
    page = fake_page(browser, address, mobile=True)
    page.run("gpu.full = true")
    page.choose("#detail", "fine")
    page.wait(
        "document.querySelector('#messageText').textContent.startsWith('Only the coarse mesh is shown')"
    )
    page.run("gpu.full = false")
    page.choose("#crop-x0", "100")
    page.still(PATIENCE)
    assert page.run("document.body.dataset.renderer") == "exact"
    assert page.run("document.body.dataset.level") == "coarse"
    assert page.problems() == []
    page.close()


# ---- The file


def test_a_copy_that_a_browser_saved_says_that_the_scene_is_not_in_it(browser, url, tmp_path):
    page = open_page(browser, url)
    saved = tmp_path / "saved.html"
    saved.write_text("<!doctype html>" + page.run("document.documentElement.outerHTML"), encoding="utf-8")
    page.close()
    assert len(saved.read_text(encoding="utf-8")) < len(text_of(url))
    page = browser.page(saved.as_uri(), WIDTH, HEIGHT)
    page.wait("document.body.dataset.state === 'failed'", PATIENCE)
    assert "saved by a browser, without its scene" in page.text("#messageText")
    assert page.run("document.querySelector('#message').checkVisibility()")
    page.close()
