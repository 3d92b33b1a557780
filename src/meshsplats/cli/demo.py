"""``meshsplats demo``: the first commands, on a scene that needs no file."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command

STEPS = (
    "convert scene.ply -o scene.glb",
    "compare scene.ply scene.glb -o compare",
    "render scene.glb -o turntable --orbit 24 --width 480",
    "view scene.ply -o scene.html",
)
"""What is run in the folder, after the splats were made."""
_RUN = "import sys; sys.path = [p for p in sys.path if p]; import meshsplats.cli as m; sys.exit(m.main())"
"""As ``python -m meshsplats``, but importing nothing from the folder, in which a stranger's files may lie."""
MADE = ("scene.ply", "scene.glb", "compare", "turntable", "scene.html")


@dataclass(frozen=True)
class Demo(Command):
    """Makes a still life of splats and runs the first commands on it: convert, compare, render, view.

    They are printed as they would be typed. A page with the scene opens in the browser.
    """

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("meshsplats-demo")
    """Folder for all files."""
    no_open: bool = False
    """Open no browser."""
    force: option.Force = False

    def execute(self) -> int:
        from meshsplats.demo_scene import make_scene
        from meshsplats.formats.gaussians import save_gaussians
        from meshsplats.formats.outputs import check_outputs
        from meshsplats.viewer.server import open_page

        folder = self.output
        check_outputs([folder / name for name in MADE], self.force, folder)
        folder.mkdir(exist_ok=True)
        splats = make_scene()
        save_gaussians(splats, folder / "scene.ply")
        print(f"A still life of {len(splats):,} splats: {folder / 'scene.ply'}", flush=True)
        for step in STEPS:
            print(f"\n$ meshsplats {step}", flush=True)
            words = [*step.split(), *(["--force"] if self.force else [])]
            done = subprocess.run([sys.executable, "-c", _RUN, *words], cwd=folder, check=False)
            if done.returncode:
                return done.returncode
        page = folder / "scene.html"
        opened = not self.no_open and open_page(page.resolve().as_uri())
        print(_ending(folder, page, opened))
        return 0


def _ending(folder: Path, page: Path, opened: bool) -> str:
    state = "is open in the browser" if opened else "opens in any browser"
    return (
        f"\n{page} {state}: the mesh, beside its splats."
        f"\n{folder / 'compare'} has splats, mesh and error side by side;"
        f"\n{folder / 'turntable'} has images from all sides and an animation;"
        f"\n{folder / 'scene.glb'} opens in any glTF viewer.\n"
        "\nNext, with a splat file of yours:"
        "\n  meshsplats view yours.ply                                in the browser"
        "\n  meshsplats convert yours.ply -o mesh.glb                 as a mesh"
        "\n  meshsplats finetune yours.ply -o tuned.npz --minutes 5   as a mesh, much closer"
        "\n  meshsplats --help                                        more"
    )
