"""What a help text costs: the modules that are imported for it, as seconds depend on the machine."""

from __future__ import annotations

import json
import subprocess
import sys

from meshsplats.cli import COMMANDS

WORKING_ROOMS = (
    *("_core", "cameras", "cluster", "demo_scene", "images", "levels", "viewpoints", "webgpu"),
    *("operations.batches", "operations.chains", "operations.conversion", "operations.edits"),
    *("operations.inspection", "operations.installation", "operations.scoring"),
    *("conversion.converting", "conversion.driver", "datasets.folder", "datasets.views"),
    *("evaluation.comparison", "evaluation.report", "finetuning.plans", "finetuning.run"),
    *("formats.content", "formats.gltf", "formats.meshes", "formats.ply", "prior.laying", "prior.model"),
    *("rendering.api", "rendering.looks", "renders.saving", "tiles.building", "training.run"),
)
"""Rooms and modules that read, draw or optimise. The options of a command are in modules without them."""
LIBRARIES = ("PIL", "bpy", "distributed", "pxr", "scipy", "skimage", "torch", "trimesh", "wgpu", "xatlas")
WITH_THEIR_WORK = ("view", "surface", "blender")
"""Commands whose options are still declared beside what they do."""
PROGRAM = """
import contextlib, io, json, sys
from meshsplats.cli import main
found = {}
for name in sys.argv[1:]:
    with contextlib.redirect_stdout(io.StringIO()):
        assert main([name, "--help"]) == 0
    found[name] = sorted(sys.modules)
print(json.dumps(found))
"""


def loaded_for_help(*commands: str) -> dict[str, list[str]]:
    """Modules that a process has loaded after the help of each of the commands in turn."""
    call = [sys.executable, "-c", PROGRAM, *commands]
    return json.loads(subprocess.run(call, capture_output=True, text=True, check=True).stdout)


def heavy(modules: list[str], names: tuple[str, ...]) -> list[str]:
    return [m for m in modules if any(m == name or m.startswith(f"{name}.") for name in names)]


def test_help_imports_options_and_not_what_they_are_for():
    rooms = tuple(f"meshsplats.{room}" for room in WORKING_ROOMS)
    loaded = loaded_for_help(*(name for name in COMMANDS if name not in WITH_THEIR_WORK))
    names = (*rooms, *LIBRARIES, "numpy")
    assert {name: found for name, all in loaded.items() if (found := heavy(all, names))} == {}


def test_help_of_the_others_imports_no_library_of_an_extra():
    loaded = loaded_for_help(*WITH_THEIR_WORK)
    assert {name: found for name, all in loaded.items() if (found := heavy(all, LIBRARIES))} == {}
