"""Images that three.js and Babylon.js draw in a headless Chromium, through viewers.mjs."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image


def draw_jobs(jobs: list[dict[str, Any]], folder: Path, node_folder: Path) -> list[str]:
    """Runs ``jobs``, as viewers.mjs takes them, and returns the lines that it prints. ``node_folder``: where
    node_modules lies."""
    (folder / "jobs.json").write_text(json.dumps(jobs))
    command = ["node", Path(__file__).with_name("viewers.mjs").resolve(), (folder / "jobs.json").resolve()]
    done = subprocess.run(command, cwd=node_folder, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout.splitlines()


def job(viewer: str, glb: Path, cameras: Path, out: Path, reach: float, **more: Any) -> dict[str, Any]:
    """A job of ``draw_jobs`` for a scene within ``reach`` of the origin."""
    places = {"glb": glb, "cameras": cameras, "out": out}
    lens = {"near": reach / 1000, "far": reach * 2}
    return {"viewer": viewer, **{name: str(path.resolve()) for name, path in places.items()}, **lens, **more}


def drawn_images(folder: Path, count: int) -> list[np.ndarray]:
    """The images (h, w, 3) that a job wrote into its folder ``out``."""
    files = (Image.open(folder / f"{i}.png").convert("RGB") for i in range(count))
    return [np.asarray(image, np.float32) / 255 for image in files]
