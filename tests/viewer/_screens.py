"""Small screenshots of the page, with which those of later versions are compared.

python tests/viewer/_screens.py      draws the references in screens/ anew: look at them, then commit them
"""

from __future__ import annotations

import base64
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageFont

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent))
from _browser import Browser, Page
from _pages import still_life

from meshsplats.viewer.page import PageOptions, make_page

REFERENCES = Path(__file__).with_name("screens")
SCREENS: dict[str, dict[str, Any]] = {
    "desktop": {"width": 1280, "height": 720},
    "phone": {"width": 390, "height": 844, "ratio": 2, "mobile": True},
    "phone-settings": {"width": 390, "height": 844, "ratio": 2, "mobile": True},
}
BLOCK = 4
"""Pixels along a side whose mean is compared: programs smooth letters differently."""
WITHOUT_WEBGPU = "Object.defineProperty(navigator, 'gpu', {value: undefined});"
"""Triangles are sorted by WebGL, which draws in moments; the exact image has tests of its own."""


def font() -> bytes:
    """The same letters everywhere: the font that Pillow has inside, since 10.1 and with FreeType."""
    try:
        found = ImageFont.load_default(16)
    except TypeError:  # before 10.1
        return b""
    return found.font_bytes if isinstance(found, ImageFont.FreeTypeFont) else b""


def set_up(page: Page) -> None:
    """Our font, and no numbers that depend on the machine."""
    page.run(
        f"""(async () => {{
          const bytes = Uint8Array.from(atob("{base64.b64encode(font()).decode()}"), c => c.charCodeAt(0));
          document.fonts.add(await new FontFace("ours", bytes.buffer).load());
          for (const element of [document.documentElement, ...document.querySelectorAll(".code")])
            element.style.fontFamily = "ours";
          document.getElementById("status").hidden = true;
          document.getElementById("statistics").style.color = "transparent";
          document.getElementById("message").hidden = document.getElementById("notes").hidden = true;
        }})()"""
    )


def write_page(folder: Path) -> str:
    """The address of a page of the still life: its mesh beside its splats, with cameras."""
    cloud, mesh, cameras = still_life()
    path = folder / "screens.html"
    made = make_page(mesh, splats=cloud, cameras=cameras, options=PageOptions(title="A still life"))
    path.write_text(made.html, encoding="utf-8")
    return path.as_uri()


def take(browser: Browser, url: str, name: str) -> np.ndarray:
    """(h, w, 3) uint8: that screen of the page, means over blocks of pixels."""
    page = browser.page(url, before=WITHOUT_WEBGPU, **SCREENS[name])
    page.still()
    set_up(page)
    if name == "desktop":
        page.click("input[value=both]")
    shown = page.run("document.querySelector('#toggle').ariaExpanded") == "true"
    if shown != (name != "phone"):
        page.click("#toggle")
    page.run("document.activeElement.blur()")
    page.still()
    image = page.screenshot()
    page.close()
    h, w = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    blocks = image[: h * BLOCK, : w * BLOCK].reshape(h, BLOCK, w, BLOCK, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)


def main() -> None:
    REFERENCES.mkdir(exist_ok=True)
    running = Browser()
    with tempfile.TemporaryDirectory() as folder:
        url = write_page(Path(folder))
        for name in SCREENS:
            path = REFERENCES / f"{name}.png"
            Image.fromarray(take(running, url, name)).save(path, optimize=True)
            print(f"{path}: {path.stat().st_size // 1024} KB")
    running.close()


if __name__ == "__main__":
    main()
