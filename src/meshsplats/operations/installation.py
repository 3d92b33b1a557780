"""The installation: libraries, the compiled core, the GPU."""

from __future__ import annotations

import platform
import re
import sys
from dataclasses import replace
from importlib import metadata
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from meshsplats.errors import PACKAGE

if TYPE_CHECKING:
    from meshsplats._common.choices import Device
    from meshsplats.scene.camera import Camera
    from meshsplats.scene.mesh import SplatMesh


def examine() -> dict[str, Any]:
    """Findings, ready for JSON: versions, threads, whether the core and the GPU draw a triangle and have its
    gradient, what draws view-dependent colours here, the libraries of each extra, and the
    requirements that are missing, in pip's form."""
    import meshsplats
    from meshsplats._core.library import processors

    needed = _requirements()
    libraries = {e: {name: _version(name) for name in names} for e, names in needed.items()}
    core, gpu, blender = _core(), _gpu(), _version("bpy")
    drawing = {"core": core["works"], "gpu": gpu["works"], f"Blender (bpy {blender}), unlit": blender}
    return {
        "meshsplats": meshsplats.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": processors(),
        "core": core,
        "gpu": gpu,
        "harmonics_drawn_by": [name for name, there in drawing.items() if there],
        "required": libraries.pop("", {}),
        "extras": libraries,
        "to_install": {
            extra: [needed[extra][name] for name, version in found.items() if not version]
            for extra, found in libraries.items()
            if None in found.values()
        },
    }


def in_words(findings: dict[str, Any]) -> list[str]:
    """Lines about the findings of ``examine``, with the requirements of each extra in one text."""
    core = findings["core"]
    lines = [
        f"MeshSplats {findings['meshsplats']}, Python {findings['python']}, {findings['platform']}",
        f"threads: {findings['threads']}",
    ]
    if core["works"]:
        lines.append(
            f"core: {core['in_use']} in use; runs here: {', '.join(core['available'])}; renders correctly"
        )
    else:
        lines.append(f"core: DOES NOT WORK: {core['problem']}")
    gpu = findings["gpu"]
    state = "renders and differentiates correctly" if gpu["works"] else gpu["problem"]
    lines.append("gpu: " + "; ".join(filter(None, (gpu["adapter"], state))))
    drawing = ", ".join(findings["harmonics_drawn_by"]) or "nothing"
    lines.append(f"view-dependent colours: drawn by {drawing}; other programs show plain ones")
    lines.append("libraries: " + _listed(findings["required"]))
    for extra, libraries in findings["extras"].items():
        missing = findings["to_install"].get(extra)
        advice = f"; to install: pip install {missing}" if missing else ""
        if missing and extra == "blender":
            where = "in an environment of its own with Python 3.11 or 3.13, from a clone or a wheel"
            advice = f'; to install, {where}: pip install "{PACKAGE}[blender]"'
        lines.append(f"extra {extra!r}: {_listed(libraries)}{advice}")
    return lines


def _listed(libraries: dict[str, str | None]) -> str:
    return ", ".join(f"{name} {version or 'MISSING'}" for name, version in libraries.items()) or "unknown"


def _core() -> dict[str, Any]:
    """Variants of the compiled core, and whether the one in use draws a triangle."""
    from meshsplats._core import library

    result: dict[str, Any] = {"works": False, "in_use": None, "available": [], "problem": None}
    try:
        result["available"] = library.available_variants()
        result["in_use"] = library.load_core().ms_variant().decode()
        result["works"] = _draws()
        if not result["works"]:
            result["problem"] = "the image of one triangle is wrong"
    except (ImportError, OSError, ValueError, RuntimeError) as error:
        result["problem"] = " ".join(str(error).split())
    return result


def _gpu() -> dict[str, Any]:
    """The adapter that ``device="gpu"`` uses, and whether it draws a triangle and has its gradient."""
    from meshsplats.errors import DeviceError, MissingDependencyError
    from meshsplats.webgpu.device import open_device

    result: dict[str, Any] = {"works": False, "adapter": None, "problem": None}
    try:
        result["adapter"] = open_device().name
        if not _draws("gpu"):
            result["problem"] = "the image of one triangle is wrong"
        elif not _has_gradient():
            result["problem"] = "the gradient of one triangle is wrong"
        result["works"] = result["problem"] is None
    except (MissingDependencyError, DeviceError) as error:
        result["problem"] = " ".join(str(error).split())
    return result


def _triangle() -> tuple[SplatMesh, Camera]:
    from meshsplats.cameras.trajectories import look_at
    from meshsplats.scene.mesh import SplatMesh

    corners = np.array([[-9, -9, 0], [9, -9, 0], [0, 9, 0]])
    mesh = SplatMesh(corners, np.array([[0, 1, 2]]), np.array([[1, 0.5, 0, 0.5]] * 3))
    return mesh, look_at((0, 0, -5), (0, 0, 0), width=3, height=3)


def _has_gradient() -> bool:
    """Whether the GPU has the gradients of the core, of the mean over the image."""
    from meshsplats.rendering.devices import engine

    mesh, camera = _triangle()
    ones, found = np.ones((3, 3, 3), np.float32), []
    devices: tuple[Device, ...] = ("cpu", "gpu")
    for device in devices:
        rendering = engine(device).tape(mesh.triangles, camera)
        found.append((np.zeros((3, 3), np.float32), np.zeros((3, 4), np.float32)))
        rendering.backward(ones, None, None, vertices=found[-1][0], colors=found[-1][1])
    return all(bool(np.allclose(a, b, rtol=1e-4, atol=1e-4)) for a, b in zip(*found, strict=True))


def _draws(device: Literal["cpu", "gpu"] = "cpu") -> bool:
    """Whether ``device`` draws a triangle, of one colour and of one that depends on the view."""
    from meshsplats.rendering import render
    from meshsplats.scene.spherical_harmonics import sh_basis

    mesh, camera = _triangle()
    harmonics = np.array([[[0, 0.2, 0], [-0.4, 0, 0], [0, 0, 0]]], np.float32)
    shaded = replace(mesh, face_splat=np.zeros(1, np.int32), harmonics=harmonics)
    away = mesh.vertices - camera.center
    basis = sh_basis(away / np.linalg.norm(away, axis=1, keepdims=True), 1)[:, 1:]
    there = np.array([0.25, 0.25, 0.5]) @ basis @ harmonics[0]  # weights of the corners in the middle
    for part, more in ((mesh, 0), (shaded, there)):
        middle = render(part, camera, background=(0, 0, 1), device=device).color[1, 1]
        if abs(middle - (0.5, 0.25, 0.5) - 0.5 * more).max() > 1e-5:
            return False
    return True


def _requirements() -> dict[str, dict[str, str]]:
    """The libraries that the package needs here, by extra and name, in pip's form; those that are always
    needed under ''."""
    try:
        lines = metadata.requires("meshsplats") or []
    except metadata.PackageNotFoundError:
        lines = []
    found: dict[str, dict[str, str]] = {"": {}}
    for line in lines:
        name = re.match(r"[A-Za-z0-9._-]+", line)
        extra = re.search(r"extra\s*==\s*['\"]([^'\"]+)['\"]", line)
        older_python = re.search(r"python_version\s*<\s*['\"]3\.(\d+)['\"]", line)
        if name and not (older_python and sys.version_info >= (3, int(older_python[1]))):
            wanted = found.setdefault(extra[1] if extra else "", {})
            wanted[name[0]] = line.partition(";")[0].strip()
    return found


def _version(name: str) -> str | None:
    """Version of an installed library that can be imported, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
