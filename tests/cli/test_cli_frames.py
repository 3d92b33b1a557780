"""All commands place the meshes of one scene alike."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats.cli import main
from meshsplats.demo_scene import make_scene
from meshsplats.formats.gaussians import save_gaussians

SMALL = ("--steps", "2", "--width", "32")
COMMANDS = {
    "tuned.glb": ("finetune", *SMALL, "--views", "40"),
    "tuned41.glb": ("finetune", *SMALL, "--views", "41"),
    "opaque.glb": ("finetune", *SMALL, "--views", "8", "--opacity", "cutoff"),
    "converted/level_1.glb": ("levels", "--levels", "2", "--no-tune", "--width", "32"),
    "chain/level_1.glb": ("levels", "--levels", "2", *SMALL),
    "tiles/root.glb": ("tiles",),
    "base.glb": ("surface", "--texture", "0", "--rounds", "0", "--resolution", "24", "--views", "8"),
}


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames") / "scene.ply"
    save_gaussians(make_scene(300), path)
    return path


@pytest.fixture(scope="module")
def converted(splats):
    path = splats.with_name("plain.glb")
    assert main(["convert", str(splats), "-o", str(path), "--no-preview"]) == 0
    return path


def rotation(path) -> list[float]:
    document = pytest.importorskip("pygltflib").GLTF2().load(str(path))
    (node,) = (node for node in document.nodes if node.mesh is not None)
    return node.rotation


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("name", COMMANDS)
def test_the_root_node_is_that_of_convert(splats, converted, tmp_path, name):
    pytest.importorskip("skimage") if name == "base.glb" else None
    command, *options = COMMANDS[name]
    output = tmp_path / (name.split("/")[0] if "/" in name else name)
    assert main([command, str(splats), "-o", str(output), *options]) == 0
    assert rotation(converted) == [1, 0, 0, 0]
    np.testing.assert_allclose(rotation(tmp_path / name), [1, 0, 0, 0], atol=1e-7)


def test_usd_stands_like_glb(splats, tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    for name, command in ("a.usdc", ("convert", "--no-preview")), ("b.usdc", COMMANDS["tuned.glb"]):
        assert main([command[0], str(splats), "-o", str(tmp_path / name), *command[1:]]) == 0
        stage = Usd.Stage.Open(str(tmp_path / name))
        (mesh,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
        matrix = np.array(UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(0))[:3, :3]
        np.testing.assert_allclose(matrix, np.diag([1, -1, -1]), atol=1e-6)
