"""Adapters for the benchmarks of others, against stand-ins for their few classes."""

from __future__ import annotations

import importlib
import runpy
import sys
import types
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _splats import few_splats

import meshsplats as ms

ROOT = Path(__file__).resolve().parents[1] / "integrations"
MESH = ms.convert(few_splats())
CAMERA = ms.orbit(MESH, 1, elevation=20, width=24, height=16)[0]


def module(monkeypatch, name, **contents):
    found = types.ModuleType(name)
    vars(found).update(contents)
    monkeypatch.setitem(sys.modules, name, found)


@pytest.fixture
def imported(monkeypatch):
    def load(folder, name):
        monkeypatch.syspath_prepend(str(ROOT / folder))
        monkeypatch.delitem(sys.modules, name, raising=False)
        return importlib.import_module(name)

    return load


def test_nerfbaselines_draws_a_checkpoint_as_render_does(monkeypatch, imported, tmp_path):
    registered = []
    module(monkeypatch, "nerfbaselines", Method=object, register=registered.append)
    method = imported("nerfbaselines", "meshsplats_method").MeshSplats
    imported("nerfbaselines", "meshsplats_spec")
    (spec,) = registered
    assert spec["method_class"] == "meshsplats_method:MeshSplats"
    trained = method(train_dataset={}, config_overrides={"samples": "1"})
    trained.mesh = MESH
    trained.save(str(tmp_path / "saved"))
    loaded = method(checkpoint=str(tmp_path / "saved"))
    k = CAMERA
    camera = SimpleNamespace(
        poses=np.linalg.inv(k.world_to_camera)[:3],
        intrinsics=np.array([k.fx, k.fy, k.cx, k.cy]),
        image_sizes=np.array([k.width, k.height]),
    )
    drawn = loaded.render(camera)
    expected = ms.render(MESH, CAMERA, background=(0, 0, 0))
    np.testing.assert_allclose(drawn["color"], np.clip(expected.color, 0, 1), atol=1e-5)
    np.testing.assert_allclose(drawn["accumulation"], expected.alpha, atol=1e-5)
    assert loaded.get_info()["num_iterations"] == 1
    with pytest.raises(ValueError, match="no option 'steps'"):
        method(train_dataset={}, config_overrides={"steps": 3})


def test_nerfbaselines_gives_its_images_and_points_to_train(monkeypatch, imported):
    module(monkeypatch, "nerfbaselines", Method=object, register=print)
    adapter = imported("nerfbaselines", "meshsplats_method")
    given = {}

    def train(dataset, *, points, **options):
        given.update(dataset=dataset, points=points, options=options)
        return MESH

    monkeypatch.setattr(ms, "train", train)
    camera = SimpleNamespace(
        poses=np.eye(4)[:3], intrinsics=np.array([9.0, 9, 4, 3]), image_sizes=np.array([8, 6])
    )
    rgba = np.full((6, 8, 4), 128, np.uint8)
    data = {
        "cameras": [camera, camera],
        "images": [np.full((6, 8, 3), 0.5, np.float32), rgba],
        "points3D_xyz": np.ones((2, 3)),
        "points3D_rgb": None,
    }
    method = adapter.MeshSplats(train_dataset=data, config_overrides={"minutes": 2})
    assert method.train_iteration(0) == {"triangles": len(MESH.faces)}
    photograph, masked = (view.load() for view in given["dataset"].train)
    assert (photograph.color == 128).all()
    assert photograph.alpha is None
    assert (masked.color == 64).all(), "colours are to be those on black"
    assert (masked.alpha == 128).all()
    assert given["options"] == {"minutes": 2.0, "max_splats": 200_000}
    assert given["points"].positions.shape == (2, 3)


def test_meshsplatbench_draws_what_render_draws(monkeypatch, imported, tmp_path):
    torch = pytest.importorskip("torch")

    def keep(name):
        return lambda cls: cls

    output = type("RenderOutput", (SimpleNamespace,), {})
    primitive = lambda vertices, faces, **more: SimpleNamespace(vertices=vertices, faces=faces, **more)  # noqa: E731
    for name in ("msbench", "msbench.core", "msbench.primitives", "msbench.renderers"):
        module(monkeypatch, name)
    module(monkeypatch, "msbench.core.registry", register=keep)
    module(monkeypatch, "msbench.primitives.mesh_triangle", IndexedMeshTriangle=primitive)
    module(monkeypatch, "msbench.renderers.base", RendererAdapter=object, RenderOutput=output)
    adapter = imported("meshsplatbench", "meshsplats_adapter").MeshSplatsAdapter(samples=1)
    with pytest.raises(RuntimeError, match="load_checkpoint"):
        adapter.model_stats()
    ms.save_mesh(MESH, tmp_path / "m.npz")
    adapter.load_checkpoint(str(tmp_path / "m.npz"))
    lens = [[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]]
    cameras = SimpleNamespace(
        viewmats=torch.tensor(CAMERA.world_to_camera)[None],
        Ks=torch.tensor(lens)[None],
        width=CAMERA.width,
        height=CAMERA.height,
    )
    drawn, expected = adapter.render(cameras), ms.render(MESH, CAMERA, background=(0, 0, 0))
    np.testing.assert_allclose(drawn.rgb.numpy(), np.clip(expected.color, 0, 1), atol=1e-5)
    np.testing.assert_allclose(drawn.alpha.numpy(), expected.alpha, atol=1e-5)
    assert adapter.model_stats()["primitive_count"] == len(MESH.faces)
    soup = adapter.to_primitive()
    shown = soup.sh_coeffs.numpy() * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(shown, MESH.plain.colors[:, :3], atol=1e-6)


class Attributes:
    """Stands in for the classes and values of a module of an engine: any attribute is its own name."""

    def __getattr__(self, name):
        return name


@pytest.fixture
def unreal(monkeypatch):
    """A stand-in for Unreal's module: what it holds afterwards are ``assets`` and ``errors``."""

    class StaticMesh:
        def __init__(self, names):
            self.static_materials = [SimpleNamespace(imported_material_slot_name=name) for name in names]
            self.given = {}

        def set_material(self, slot, material):
            self.given[slot] = material

    class Material:
        def __init__(self):
            self.properties, self.connected = {}, {}

        def set_editor_property(self, name, value):
            self.properties[name] = value

    assets, errors, made = {}, [], []

    def create_asset(name, folder, kind, factory):
        assert f"{folder}/{name}" not in assets, "the editor returns None for a name that is taken"
        made.append(name)
        return assets.setdefault(f"{folder}/{name}", kind())

    def import_asset_tasks(tasks):
        (task,) = tasks
        task.imported_object_paths = [f"{task.destination_path}/scene"]
        assets[f"{task.destination_path}/scene"] = StaticMesh(["splats", "splats_1", "surface", "invisible"])

    tools = SimpleNamespace(create_asset=create_asset, import_asset_tasks=import_asset_tasks)
    library = SimpleNamespace(does_asset_exist=assets.__contains__, save_loaded_asset=lambda asset: None)
    editing = SimpleNamespace(
        create_material_expression=lambda material, kind, x, y: (material, kind),
        connect_material_property=lambda color, output, name: color[0].connected.update({name: output}),
        recompile_material=lambda material: None,
    )
    module(
        monkeypatch,
        "unreal",
        **{"StaticMesh": StaticMesh, "Material": Material, "MaterialFactoryNew": SimpleNamespace},
        AssetImportTask=SimpleNamespace,
        AssetToolsHelpers=SimpleNamespace(get_asset_tools=lambda: tools),
        EditorAssetLibrary=library,
        MaterialEditingLibrary=editing,
        MaterialExpressionVertexColor="VertexColor",
        **dict.fromkeys(("BlendMode", "MaterialProperty", "MaterialShadingModel"), Attributes()),
        load_asset=assets.get,
        log_error=errors.append,
    )
    return SimpleNamespace(assets=assets, errors=errors, made=made)


def test_unreal_imports_the_solid_and_the_blended_triangles_of_a_file_twice(monkeypatch, unreal, tmp_path):
    script, mesh = ROOT / "engines/unreal/import_meshsplats.py", ms.convert(few_splats())
    colors = mesh.colors.copy()
    colors[mesh.faces[: len(mesh.faces) // 2].ravel(), 3] = 1
    ms.save_mesh(replace(mesh, colors=colors), tmp_path / "engine.glb", alpha="hybrid")
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "engine.glb")])
    for _ in range(2):
        runpy.run_path(str(script), run_name="__main__")
    solid, blended = (unreal.assets[f"/Game/MeshSplats/M_MeshSplats_{mode}"] for mode in ("Opaque", "Blend"))
    assert unreal.assets["/Game/MeshSplats/scene"].given == {0: solid, 1: blended}
    assert solid.connected == {"MP_EMISSIVE_COLOR": ""}
    assert blended.connected == {"MP_EMISSIVE_COLOR": "", "MP_OPACITY": "A"}
    assert blended.properties["blend_mode"] == "BLEND_TRANSLUCENT"
    assert blended.properties["two_sided"] is True
    assert len(unreal.made) == 2
    monkeypatch.setattr(sys, "argv", [str(script)])
    runpy.run_path(str(script), run_name="__main__")
    assert "no file" in unreal.errors[0]
