"""``meshsplats doctor``: installed libraries, and missing ones."""

from __future__ import annotations

import json
import platform
import re
import sys
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from meshsplats.cli.arguments import Command
from meshsplats.cli.messages import quoted

if TYPE_CHECKING:
    from meshsplats.camera import Camera
    from meshsplats.mesh import SplatMesh
    from meshsplats.rendering.engine import Device


@dataclass(frozen=True)
class Doctor(Command):
    """Lists installed and missing libraries, the instruction set in use and the GPU. Exit code 1 if rendering
    on the CPU fails."""

    json: bool = False
    """Print the findings as JSON."""

    def execute(self) -> int:
        findings = examine()
        if self.json:
            print(json.dumps(findings, indent=1))
        else:
            print(_text(findings))
        return 0 if findings["core"]["works"] else 1


def examine() -> dict[str, Any]:
    """The findings, ready for JSON."""
    import meshsplats
    from meshsplats._core.library import processors

    needed = _requirements()
    libraries = {e: {name: _version(name) for name in names} for e, names in needed.items()}
    return {
        "meshsplats": meshsplats.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": processors(),
        "core": _core(),
        "gpu": _gpu(),
        "required": libraries.pop("", {}),
        "extras": libraries,
        "to_install": {
            extra: " ".join(quoted(needed[extra][name]) for name, version in found.items() if not version)
            for extra, found in libraries.items()
            if None in found.values()
        },
    }


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
    from meshsplats.mesh import SplatMesh

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
    from meshsplats.rendering import render

    mesh, camera = _triangle()
    middle = render(mesh, camera, background=(0, 0, 1), device=device).color[1, 1]
    return bool(abs(middle - [0.5, 0.25, 0.5]).max() < 1e-5)


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


def _text(findings: dict[str, Any]) -> str:
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
    lines.append("libraries: " + _listed(findings["required"]))
    for extra, libraries in findings["extras"].items():
        missing = findings["to_install"].get(extra)
        advice = f"; to install: pip install {missing}" if missing else ""
        if missing and extra == "blender":
            where = "in an environment of its own with Python 3.11 or 3.13"
            advice = f"; to install, {where}: pip install {missing}"
        lines.append(f"extra {extra!r}: {_listed(libraries)}{advice}")
    return "\n".join(lines)


def _listed(libraries: dict[str, str | None]) -> str:
    return ", ".join(f"{name} {version or 'MISSING'}" for name, version in libraries.items()) or "unknown"
