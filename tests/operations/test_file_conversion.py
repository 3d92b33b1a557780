"""A program of one's own makes the files of a job, as the command does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from _splats import few_splats

import meshsplats as ms
from meshsplats.errors import OptionsError
from meshsplats.evaluation import viewers
from meshsplats.evaluation.mesh_files import MeshFileOptions
from meshsplats.operations import conversion as file_conversion
from meshsplats.operations.batches import jobs
from meshsplats.operations.conversion import ConversionCallbacks, Converter, counts_in_words, seen_from
from meshsplats.operations.product import Product


def record(job):
    for path in job.configs:
        path.write_text("noted")


PLAIN = ConversionCallbacks(
    load=ms.load_gaussians,
    stream=ms.stream_gaussians,
    place=lambda scene: scene,
    record=record,
    preview=lambda scene, path, camera=None: path.write_bytes(b"drawn"),
    opening=lambda cloud, source, seen: None,
)


@pytest.fixture
def job(tmp_path):
    ms.save_gaussians(few_splats(), tmp_path / "a.ply")
    (found,) = jobs([tmp_path / "a.ply"], tmp_path, ["npz", "ply"], preview=True, sidecars=True, shown=str)
    return replace(found, outputs=(tmp_path / "b.npz", tmp_path / "b.ply"))


def test_a_mesh_appears_in_every_format_with_its_record_and_preview(job, tmp_path):
    result = Converter(Product(scale=2.0), PLAIN).made(job, [])
    mesh = ms.convert(ms.load_gaussians(job.source))
    assert (result["converted"], result["triangles"]) == (mesh.splat_count, len(mesh.faces))
    for path in job.outputs:
        np.testing.assert_array_equal(ms.load_mesh(path).vertices, mesh.vertices * np.float32(2))
    assert [path.read_text() for path in job.configs] == ["noted"] * 2
    assert job.preview.read_bytes() == b"drawn"


def test_blocks_give_the_mesh_of_the_whole(job):
    one = replace(job, outputs=job.outputs[1:], configs=job.configs[1:])
    files = MeshFileOptions(alpha="blend")
    Converter(Product(files=files), PLAIN).made(one, None)
    whole = one.outputs[0].read_bytes()
    result = Converter(Product(stream=True), PLAIN).made(one, None)
    assert one.outputs[0].read_bytes() == whole
    assert result["splats"] == len(few_splats())


@pytest.mark.parametrize("budget", ["merge", "drop"])
def test_splats_are_chosen_and_a_mesh_is_none(job, tmp_path, budget):
    product = Product(as_splats=True, conversion=ms.ConversionOptions(max_splats=3, budget=budget))
    assert product.merges == (budget == "merge")
    splats = replace(job, outputs=(tmp_path / "c.splat",), configs=())
    assert Converter(product, PLAIN).made(splats, [])["written"] == 3
    ms.save_mesh(ms.convert(few_splats()), tmp_path / "m.npz")
    with pytest.raises(ms.FileFormatError, match="not splats"):
        Converter(product, PLAIN).made(replace(splats, source=tmp_path / "m.npz"), [])


@pytest.mark.parametrize("as_splats", [False, True])
def test_a_preview_is_seen_from_where_the_file_opens(job, tmp_path, as_splats):
    camera, asked, drawn = ms.Camera(np.eye(4), 50, 50, 32, 32, 64, 64), [], []

    def opening(cloud, source, seen):
        asked.append((len(cloud), source, seen))
        return camera

    own = replace(PLAIN, opening=opening, preview=lambda scene, path, camera=None: drawn.append(camera))
    files = replace(job, outputs=(tmp_path / ("c.splat" if as_splats else "c.npz"),), configs=())
    Converter(Product(as_splats=as_splats), own).made(files, [camera])
    assert drawn == [camera]
    assert asked == [(len(few_splats()), job.source, [camera])]


@pytest.mark.parametrize("preview", [True, False])
def test_the_alpha_mode_of_a_place_is_measured_from_within(job, tmp_path, monkeypatch, preview):
    """By given cameras, else by views that are found; with a preview or without, it is the same file. An
    object is seen from around."""
    views = [ms.Camera(np.eye(4), 50, 50, 32, 32, 64, 64)] * 4
    found, measured = [], []
    monkeypatch.setattr(viewers, "choose_alpha", lambda mesh, cameras, **more: measured.append(cameras))
    files = replace(job, outputs=(tmp_path / "c.glb",), configs=())
    if not preview:
        files = replace(files, preview=None)
    converter = Converter(Product(), PLAIN)
    converter.made(files, [])  # an object
    monkeypatch.setattr(
        file_conversion, "default_views", lambda *given, **more: found.append(more) or (views, "found")
    )
    converter.made(files, [])
    converter.made(files, views[:1])
    assert measured == [[], views, views[:1]]
    assert len(found) == 1
    # Nothing is looked for where nothing is measured.
    npz = replace(files, outputs=(tmp_path / "c.npz",))
    converter.made(npz, [])
    Converter(Product(files=MeshFileOptions(alpha="mask")), PLAIN).made(files, [])
    assert len(found) == 1


def test_an_error_in_one_format_leaves_no_file_of_another(job, tmp_path):
    wrong = replace(job, outputs=(job.outputs[0], tmp_path / "b.none"))
    with pytest.raises(ValueError, match="does not name a mesh format"):
        Converter(Product(), PLAIN).made(wrong, [])
    assert not job.outputs[0].exists()


def test_cameras_are_in_the_world(tmp_path):
    camera = ms.Camera(np.eye(4), 50, 50, 32, 32, 64, 64)
    (moved,) = seen_from([camera], tmp_path, np.array([1.0, 2, 3]))
    np.testing.assert_allclose(moved.world_to_camera[:3, 3], [1, 2, 3])
    assert seen_from(None, tmp_path, np.zeros(3)) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "m.usdz",
            r"m\.npz: a mesh, not splats: convert writes \.usdz of splats only; .* \.glb.*save_scene\(",
        ),
        ("m.compressed.ply", r"convert writes \.compressed\.ply of splats only"),
        ("m.glb", r"no splats are made of it; without as_splats it can become \.npz, "),
    ],
)
def test_what_a_mesh_can_become_is_said_where_it_is_to_become_splats(job, tmp_path, name, message):
    ms.save_mesh(ms.convert(few_splats()), tmp_path / "m.npz")
    wrong = replace(job, source=tmp_path / "m.npz", outputs=(tmp_path / name,))
    with pytest.raises(ms.FileFormatError, match=message):
        Converter(Product(as_splats=True), PLAIN).made(wrong, [])


def test_files_are_all_meshes_or_all_splats(tmp_path):
    """Also where a name ends in that of a mesh."""
    for kinds, as_splats in ((["glb", "ply"], False), (["usdz", "spz", "compressed.ply", "ply"], True)):
        Product(as_splats=as_splats).check(kinds, [], tmp_path)
    for kinds, message in (
        (
            ["glb", "compressed.ply"],
            "glb would be meshes, .compressed.ply splats: .* all as splats: as_splats",
        ),
        (["npz", "sog"], "a second command$"),
        (["usdz"], "hold splats: as_splats"),
        (["stl"], "meshes are written as .*, not as .stl"),
    ):
        with pytest.raises(OptionsError, match=message):
            Product().check(kinds, [], tmp_path)


def test_one_is_no_plural():
    counts = {"triangles": 8, "vertices": 7, "splats": 1, "converted": 1, "fidelity": None}
    assert counts_in_words(counts) == "1 splat -> 8 triangles, 7 vertices"
    assert counts_in_words({"triangles": 1, "vertices": 1, "fidelity": None}) == "1 triangle, 1 vertex"
