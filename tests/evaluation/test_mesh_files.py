"""How meshes are saved for other programs, without the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from _splats import few_splats

from meshsplats import convert, load_mesh
from meshsplats.evaluation.mesh_files import MeshFileOptions
from meshsplats.formats.gltf.document import GltfDocument
from meshsplats.scene.mesh import solid_faces


def test_solid_triangles_are_cut_before_they_are_saved():
    mesh = convert(few_splats())
    solid = MeshFileOptions(alpha="opaque", cutoff=0.5).prepared(mesh)
    assert solid_faces(solid).all()
    assert not solid_faces(mesh).all()
    assert MeshFileOptions().prepared(mesh) is mesh


def test_normals_are_those_of_the_surface():
    mesh = convert(few_splats())
    assert mesh.normals is None
    assert MeshFileOptions(lit=True, smooth=True).prepared(mesh).normals is not None


def test_only_a_glb_needs_a_choice_of_its_alpha_mode(tmp_path):
    mesh = convert(few_splats())
    paths = [tmp_path / "a.npz", tmp_path / "a.GLB"]
    assert MeshFileOptions().choice(mesh, paths[:1]) is None
    assert MeshFileOptions(alpha="blend").choice(mesh, paths) is None
    assert MeshFileOptions().choice(mesh, paths) is not None


def test_each_format_gets_what_it_has(tmp_path):
    mesh, paths = convert(few_splats()), [tmp_path / "a.npz", tmp_path / "a.glb"]
    options = MeshFileOptions(alpha="mask", cutoff=0.25, lit=True, color_type="float32")
    options.save(options.prepared(mesh), paths)
    assert len(load_mesh(paths[0]).faces) == len(mesh.faces)
    material = GltfDocument(paths[1]).json["materials"][0]
    assert (material["alphaMode"], material["alphaCutoff"]) == ("MASK", 0.25)
    assert "KHR_materials_unlit" not in material.get("extensions", {})


def test_a_file_takes_what_its_format_has():
    lit = MeshFileOptions(lit=True, smooth=True)
    asked = replace(lit, alpha="ordered", nodes=3, quick=True, compression="meshopt")
    assert asked.taken_by(Path("a.glb")) == asked
    assert asked.taken_by(Path("a.usda")) == lit
    assert asked.taken_by(Path("a.npz")) == MeshFileOptions()
    assert MeshFileOptions(alpha="opaque", cutoff=0.3).taken_by(Path("a.obj")).cutoff == 0.3
