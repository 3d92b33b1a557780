"""Arguments of a wrong kind: every public function says what was given and what to do."""

from __future__ import annotations

import builtins
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from _splats import few_splats

import meshsplats as ms

CLOUD = few_splats()
MESH = ms.convert(CLOUD)
CAMERAS = ms.orbit(CLOUD, 2, width=8, height=8)
IMAGE = np.zeros((8, 8, 3), np.float32)
DATASET = ms.Dataset(tuple(ms.View(camera, ms.ViewImage(IMAGE)) for camera in CAMERAS))
TRIANGLE = np.eye(3, dtype=np.float32)
BASE = ms.BaseMesh(TRIANGLE, np.array([[0, 1, 2]], np.int32))
PRIOR = ms.bind(BASE)

GIVEN: dict[str, Any] = {
    "a path as text": "scene.ply",
    "a path": Path("scene.ply"),
    "splats": CLOUD,
    "a mesh": MESH,
    "a camera": CAMERAS[0],
    "cameras": CAMERAS,
    "a data set": DATASET,
    "a view": DATASET.train[0],
    "a base mesh": BASE,
    "a prior": PRIOR,
    "an image": IMAGE,
    "a list": [[0.0, 1.0, 2.0]],
    "a dict": {"means": TRIANGLE},
    "nothing": None,
    "a number": 3,
    "a class": ms.SplatMesh,
    "a function": ms.convert,
    "a configuration": ms.FinetuneConfig(),
}
"""What people give."""
PATHS = {"a path as text", "a path"}
IMAGES = {"an image", "a list", "a number"}
FITS = {
    "cloud": {"splats"},
    "splats": {"splats", "nothing"},
    "mesh": {"a mesh"},
    "optional mesh": {"a mesh", "nothing"},
    "collider": {"a mesh", "a base mesh", "nothing"},
    "before": {"a mesh", "nothing"},
    "camera": {"a camera"},
    "cameras": {"cameras"},
    "optional cameras": {"cameras", "nothing"},
    "dataset": {"a data set"},
    "optional dataset": {"a data set", "nothing"},
    "base": {"a base mesh"},
    "optional base": {"a base mesh", "nothing"},
    "shown": {"a mesh", "a base mesh"},
    "prior": {"a prior"},
    "path": PATHS,
    "optional path": {*PATHS, "nothing"},
    "source": set(),
    "tileset": set(),
    "scene": {"splats", "a mesh", *IMAGES},
    "options": {"nothing"},
    "config": {"nothing"},
    "finetune config": {"nothing", "a configuration"},
    "array": IMAGES,
    "scenes": set(),
    "cases": set(),
}
"""Which of them fit, for each kind of parameter."""
FUNCTIONS: dict[str, tuple[Callable[..., Any], dict[str, Any], dict[str, str]]] = {
    name: (getattr(ms, name), valid, kinds)
    for name, valid, kinds in [
        ("bake_filter", {"mesh": MESH, "cameras": CAMERAS}, {"mesh": "mesh", "cameras": "optional cameras"}),
        ("bind", {"base": BASE}, {"base": "base"}),
        ("build_tiles", {"source": None, "folder": "t"}, {"source": "source"}),
        (
            "compare",
            {"cloud": CLOUD, "mesh": MESH, "cameras": CAMERAS},
            {"cloud": "cloud", "mesh": "mesh", "cameras": "cameras"},
        ),
        (
            "convert",
            {"cloud": CLOUD},
            {"cloud": "cloud", "cameras": "optional cameras", "options": "options"},
        ),
        ("cut_mesh", {"mesh": MESH}, {"mesh": "mesh"}),
        (
            "plain_colors_of",
            {"mesh": MESH, "cameras": CAMERAS},
            {"mesh": "mesh", "cameras": "cameras"},
        ),
        ("gaussians_to_tensors", {}, {"cloud": "cloud"}),
        ("dome", {"scene": CLOUD}, {"scene": "scene"}),
        ("orbit", {"scene": CLOUD}, {"scene": "scene"}),
        ("look_around", {"scene": CLOUD}, {"scene": "scene"}),
        ("look_at", {"center": (0, 0, 1), "target": (0, 0, 0)}, {"center": "array", "target": "array"}),
        ("draw_splats", {"cloud": CLOUD, "camera": CAMERAS[0]}, {"cloud": "cloud", "camera": "camera"}),
        ("render_splats", {"cloud": CLOUD, "camera": CAMERAS[0]}, {"cloud": "cloud", "camera": "camera"}),
        ("render", {"mesh": MESH, "camera": CAMERAS[0]}, {"mesh": "mesh", "camera": "camera"}),
        ("render_tiles", {"tileset": None, "camera": CAMERAS[0]}, {"tileset": "tileset"}),
        ("tiles_mesh", {"tileset": None, "cameras": CAMERAS}, {"tileset": "tileset"}),
        (
            "evaluate",
            {"mesh": MESH, "dataset": DATASET},
            {"mesh": "before", "dataset": "dataset", "before": "before", "splats": "splats"},
        ),
        (
            "find_background",
            {"dataset": DATASET, "scenes": {"mesh": MESH}},
            {"dataset": "dataset", "scenes": "scenes"},
        ),
        (
            "finetune",
            {"mesh": MESH, "dataset": DATASET},
            {"mesh": "mesh", "dataset": "dataset", "config": "finetune config", "run": "options"},
        ),
        (
            "finetune_ordered",
            {"mesh": MESH, "listing": ms.drawing_order(MESH, CAMERAS), "dataset": DATASET},
            {"mesh": "mesh", "dataset": "dataset", "config": "finetune config", "run": "options"},
        ),
        *(
            (name, {}, {"path": "path"})
            for name in ("load_base", "load_cameras", "load_dataset", "load_mesh", "load_vertex_colored")
        ),
        *((name, {}, {"path": "path"}) for name in ("load_gaussians", "load_points", "load_prior")),
        ("stream_gaussians", {}, {"path": "path"}),
        ("Tileset", {}, {"path": "path"}),
        (
            "make_page",
            {"mesh": MESH},
            {
                "mesh": "shown",
                "splats": "splats",
                "surface": "optional base",
                "cameras": "cameras",
                "options": "options",
            },
        ),
        ("needed_samples", {"mesh": MESH, "cameras": CAMERAS}, {"mesh": "mesh", "cameras": "cameras"}),
        ("psnr", {"a": IMAGE, "b": IMAGE}, {"a": "array", "b": "array"}),
        ("ssim", {"a": IMAGE, "b": IMAGE}, {"a": "array", "b": "array"}),
        ("save_cameras", {"cameras": CAMERAS, "path": "x"}, {"cameras": "cameras", "path": "path"}),
        ("save_gaussians", {"cloud": CLOUD, "path": "x"}, {"cloud": "cloud", "path": "path"}),
        (
            "save_scene",
            {"path": "x.glb", "splats": CLOUD},
            {"path": "path", "splats": "splats", "mesh": "optional mesh", "collider": "collider"},
        ),
        ("save_image", {"path": "x", "image": IMAGE}, {"path": "path", "image": "array"}),
        ("save_mesh", {"mesh": MESH, "path": "x"}, {"mesh": "mesh", "path": "path"}),
        ("draw_surface", {"base": BASE, "camera": CAMERAS[0]}, {"base": "base", "camera": "camera"}),
        (
            "make_surface",
            {"scene": CLOUD},
            {"data": "optional dataset", "cameras": "optional cameras", "options": "options"},
        ),
        ("save_base", {"base": BASE, "path": "x.glb"}, {"base": "base", "path": "path"}),
        ("simplify", {"cloud": CLOUD, "count": 9}, {"cloud": "cloud", "cameras": "optional cameras"}),
        (
            "drawing_order",
            {"mesh": MESH, "cameras": CAMERAS},
            {"mesh": "mesh", "cameras": "optional cameras"},
        ),
        ("find_cameras", {"cloud": CLOUD}, {"cloud": "cloud"}),
        ("splat_dataset", {"cloud": CLOUD}, {"cloud": "cloud", "cameras": "optional cameras"}),
        (
            "starting_mesh",
            {"cloud": CLOUD, "cameras": CAMERAS},
            {"cloud": "cloud", "cameras": "cameras", "options": "options", "config": "finetune config"},
        ),
        ("train", {"dataset": DATASET}, {"dataset": "dataset", "config": "config", "run": "options"}),
        ("train_prior", {"prior": PRIOR, "dataset": DATASET}, {"prior": "prior", "dataset": "dataset"}),
        ("MeshPrior", {}, {"mesh": "mesh"}),
        ("RunOptions", {}, {"folder": "optional path"}),
        ("ViewImage", {}, {"color": "array"}),
    ]
}
"""By the name of a function: arguments that fit, and the kinds of its parameters."""
ELSEWHERE = {
    *("GaussianCloud", "SplatMesh", "Camera", "BaseMesh", "Dataset", "SplatStream", "View"),  # tested below
    *("convert_blocks", "save_gaussian_blocks", "save_mesh_blocks", "rasterize", "open_workers"),
    "gaussians_from_tensors",  # tests/formats/test_tensors.py
    *(
        "ConversionOptions",
        "FinetuneConfig",
        "TrainConfig",
        "TileOptions",
        "PageOptions",
        "SurfaceOptions",
    ),  # plain values
    *("make_config", "train_config"),
    *("Comparison", "FoundCameras", "Interrupted", "Progress", "Rendering", "Report", "Workers"),  # results
    *("ClusterError", "DataWarning", "DeviceError", "DivergenceError", "FileFormatError", "OtherRunError"),
    *("MissingDependencyError", "NoTextureWarning", "__version__"),
}


def test_no_public_function_is_forgotten():
    assert FUNCTIONS.keys() | ELSEWHERE == set(ms.__all__)
    assert not FUNCTIONS.keys() & ELSEWHERE
    for function, valid, kinds in FUNCTIONS.values():
        assert valid.keys() | kinds.keys() <= inspect.signature(function).parameters.keys()


@pytest.mark.parametrize("name", ms.__all__)
def test_errors_that_are_documented_can_be_caught_by_public_names(name):
    public = getattr(ms, name)
    members = vars(public).values() if inspect.isclass(public) else ()
    text = " ".join(inspect.getdoc(part) or "" for part in (public, *members))
    for error in set(re.findall(r"\b[A-Z]\w*(?:Error|Warning)\b", text)):
        assert hasattr(builtins, error) or error in ms.__all__, error


@pytest.mark.parametrize(
    ("name", "parameter"), [(name, parameter) for name in FUNCTIONS for parameter in FUNCTIONS[name][2]]
)
def test_a_wrong_kind_is_named_with_what_to_do(name, parameter, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, valid, kinds = FUNCTIONS[name]
    for what, value in GIVEN.items():
        if what in FITS[kinds[parameter]]:
            continue
        with pytest.raises(TypeError) as caught:
            function(**{**valid, parameter: value})
        message = str(caught.value)
        assert re.match(rf"{parameter}(\[.+\])? must be (an? |splats|one)", message), f"{what}: {message}"
        _, _, rest = message.partition(", got ")
        given, _, todo = rest.partition(": ")
        assert len(todo) > 8, f"{what}: {message}"
        if not isinstance(value, (str, Path, list, dict, type)) and value is not None and not callable(value):
            kind = "NumPy array" if isinstance(value, np.ndarray) else type(value).__name__
            assert kind in given, message
        if what in PATHS:
            assert "scene.ply" in given
    assert list(tmp_path.iterdir()) == []


FIRST_MISTAKES = {
    "convert a path": (
        lambda: ms.convert("a.ply"),
        r"cloud .* the text 'a.ply': load_gaussians\(path\) reads",
    ),
    "render splats": (
        lambda: ms.render(CLOUD, CAMERAS[0]),
        "got a GaussianCloud: render_splats draws splats",
    ),
    "splats of a mesh": (lambda: ms.render_splats(MESH, CAMERAS[0]), "got a SplatMesh: render draws meshes"),
    "all cameras": (lambda: ms.render(MESH, CAMERAS), r"a list of 2 Camera: give one of them, camera\[0\]"),
    "one camera": (lambda: ms.compare(CLOUD, MESH, CAMERAS[0]), r"got a Camera: give \[cameras\]"),
    "save splats": (lambda: ms.save_mesh(CLOUD, "a.glb"), "a GaussianCloud: save_gaussians writes splats"),
    "save a mesh": (lambda: ms.save_gaussians(MESH, "a.ply"), "got a SplatMesh: save_mesh writes meshes"),
    "image first": (lambda: ms.save_image(IMAGE, "a.png"), r"shape \(8, 8, 3\): the path comes first"),
    "no image": (lambda: ms.psnr(ms.render(MESH, CAMERAS[0]), IMAGE), "got a Rendering: rendering.color is"),
    "load twice": (lambda: ms.load_gaussians(CLOUD), "it is loaded already"),
    "a data set for cameras": (
        lambda: ms.convert(CLOUD, cameras=DATASET),
        "view.camera for view in dataset.views",
    ),
    "splats for images": (lambda: ms.finetune(MESH, CLOUD), r"splat_dataset\(cloud\) makes images of it"),
    "a prior to save": (lambda: ms.save_mesh(PRIOR, "a.glb"), "prior.mesh is its mesh"),
    "options by position": (lambda: ms.convert(CLOUD, {"sides": 6}), r"convert\(cloud, sides=6\)"),
    "a call left out": (lambda: ms.render(ms.convert, CAMERAS[0]), "got the function convert"),
    "characters": (
        lambda: ms.SplatStream("a.ply"),
        r"paths must be a list of paths.*stream_gaussians\(path\)",
    ),
    "cameras of a view": (lambda: ms.render(MESH, DATASET.train[0]), "view.camera is its camera"),
    "one view": (
        lambda: ms.Dataset(DATASET.train[0]),
        r"train must be a list of View, got a View: give \[train\]",
    ),
    "cloud as array": (
        lambda: ms.GaussianCloud(CLOUD, 1, 1, 1, 1),
        "means must hold numbers, got a GaussianCloud",
    ),
    "text as array": (lambda: ms.SplatMesh("a.glb", 1, 1), "'?vertices'? must hold numbers, got a str"),
    "blocks of one": (
        lambda: list(ms.convert_blocks(CLOUD)),
        r"source must be an iterable .*give \[source\]",
    ),
    "a path to blocks": (
        lambda: list(ms.convert_blocks("a.ply")),
        "source must be an iterable of GaussianCloud",
    ),
    "blocks once": (
        lambda: list(ms.convert_blocks(iter([CLOUD]))),
        r"several times.*list\(source\) makes one",
    ),
    "meshes for blocks": (
        lambda: ms.save_gaussian_blocks([MESH], "a.ply", 1),
        r"blocks\[0\] must be a Gauss",
    ),
    "a misspelt option of a surface": (
        lambda: ms.make_surface(CLOUD, face=40),
        "make_surface has no option 'face'; did you mean 'faces'",
    ),
    "splats to join": (
        lambda: ms.SplatMesh.joined([MESH, CLOUD]),
        r"parts\[1\] must be a SplatMesh, got a GaussianCloud: convert\(cloud\) makes a mesh of it",
    ),
    "one mesh to join": (lambda: ms.SplatMesh.joined(MESH), r"a list of SplatMesh.*give \[parts\] or more"),
    "one cloud to join": (lambda: ms.GaussianCloud.joined(CLOUD), r"got a GaussianCloud: give \[clouds\]"),
    "a number of cameras as text": (
        lambda: ms.orbit(MESH, "3"),
        r"count must be a whole number, got the text '3': int\(count\) makes one",
    ),
    "an angle as text": (
        lambda: ms.orbit(MESH, elevation="20"),
        r"elevation must be a number, got the text '20': float\(elevation\) makes one",
    ),
    "no angle": (lambda: ms.look_around(MESH, fov=None), "fov must be a number, got None: give one"),
    "a side as text": (lambda: ms.dome(MESH, width="800"), "width must be a number, got the text '800'"),
    "one attribute": (
        lambda: ms.render(MESH, CAMERAS[0], attributes="height"),
        r"attributes must be .* got the text 'height': give \[attributes\] or more of them",
    ),
    "a background by name": (
        lambda: ms.render(MESH, CAMERAS[0], background="white"),
        r"background must be RGB from 0 to 1, .* got the text 'white': white is \(1, 1, 1\)",
    ),
    "a background of splats by name": (
        lambda: ms.draw_splats(CLOUD, CAMERAS[0], background="#ffffff"),
        "background must be RGB from 0 to 1",
    ),
    "parts of one": (lambda: ms.save_mesh_blocks(MESH, "a.ply"), r"give \[parts\] or more of them"),
}


@pytest.mark.parametrize("case", FIRST_MISTAKES)
def test_first_mistakes(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, message = FIRST_MISTAKES[case]
    with pytest.raises(TypeError, match=message):
        call()
    assert list(tmp_path.iterdir()) == []


def test_tensors_in_place_of_arrays():
    torch = pytest.importorskip("torch", reason="pip install 'meshsplats[torch]'")
    with_gradients = torch.zeros(3, 3, requires_grad=True)
    with pytest.raises(TypeError, match=r"means must hold numbers, got a Tensor.*means\.detach\(\)\.cpu\(\)"):
        ms.GaussianCloud(with_gradients, 1, 1, 1, 1)
    with pytest.raises(TypeError, match=r"torch.Tensor of shape \(3, 3\): scene\.detach\(\)\.cpu\(\)\.numpy"):
        ms.orbit(with_gradients)
    assert len(ms.orbit(torch.eye(3), 1)) == 1


def test_arrays_in_place_of_tensors():
    torch = pytest.importorskip("torch", reason="pip install 'meshsplats[torch]'")
    vertices, colors = torch.from_numpy(MESH.vertices), torch.from_numpy(MESH.colors)
    with pytest.raises(
        TypeError, match=r"vertices must be a torch.Tensor, got a NumPy.*torch.from_numpy\(vertices"
    ):
        ms.rasterize(MESH.vertices, MESH.faces, colors, CAMERAS)
    with pytest.raises(TypeError, match=r"attributes must be .*a list of .*torch.as_tensor\(attributes\)"):
        ms.rasterize(vertices, MESH.faces, MESH.colors.tolist(), CAMERAS)
    with pytest.raises(TypeError, match=r"vertices must be a torch.Tensor, got a SplatMesh"):
        ms.rasterize(MESH, MESH.faces, colors, CAMERAS)
    with pytest.raises(TypeError, match=r"world_to_camera must be a torch.Tensor, got a NumPy array"):
        ms.rasterize(vertices, MESH.faces, colors, CAMERAS[0], world_to_camera=np.eye(4))
    with pytest.raises(TypeError, match=r"cameras\[0\] must be a Camera, got a GaussianCloud"):
        ms.rasterize(vertices, MESH.faces, colors, [CLOUD])


def test_a_folder_may_be_text(tmp_path):
    assert ms.RunOptions(folder=str(tmp_path)).folder == tmp_path
