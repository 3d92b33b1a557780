"""Chromium for the tests of this folder, and a small scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from _browser import PROGRAM, Browser

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.viewer.page import PageOptions, make_page

WIDTH, HEIGHT = 120, 96


@pytest.fixture(scope="session")
def cloud() -> ms.GaussianCloud:
    return make_scene(300)


@pytest.fixture(scope="session")
def mesh(cloud) -> ms.SplatMesh:
    return ms.convert(cloud)


@pytest.fixture(scope="session")
def cameras(cloud) -> list[ms.Camera]:
    return ms.orbit(cloud, 3, width=WIDTH, height=HEIGHT, elevation=20, distance=0.9)


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    if PROGRAM is None:
        pytest.skip("Chromium is not installed here (CHROMIUM names it)")
    if not hasattr(os, "posix_spawn"):
        pytest.skip("Chromium is driven through pipes, which needs a POSIX system")
    try:
        running = Browser()
        running.send("Browser.getVersion", timeout=120)
    except (OSError, TimeoutError, ConnectionError) as error:
        pytest.skip(f"Chromium does not start here: {error}")
    yield running
    running.close()


@pytest.fixture(scope="session")
def write_page(tmp_path_factory) -> Callable[..., str]:
    """Writes a page and returns its address on the disk."""
    folder = tmp_path_factory.mktemp("pages")

    def write(mesh: ms.SplatMesh, name: str = "scene", **arguments) -> str:
        path: Path = folder / f"{name}.html"
        arguments.setdefault("options", PageOptions(title="still life"))
        path.write_text(make_page(mesh, **arguments).html, encoding="utf-8")
        return path.as_uri()

    return write


def levels(image: np.ndarray) -> np.ndarray:
    """A rendered image as a screenshot has it."""
    return np.rint(255 * image.clip(0, 1)).astype(int)
