"""What cleaning takes away, what framing leaves out, and the command."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from meshsplats._common.cells import Cells
from meshsplats._core import library
from meshsplats.cameras.framing import scene_bounds
from meshsplats.cameras.trajectories import orbit
from meshsplats.cli import main
from meshsplats.conversion import convert
from meshsplats.conversion.cleaning import cropped, find, remove
from meshsplats.conversion.cleaning_rules import CleaningRules
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.images.reading import load_image
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


def splats(
    means: np.ndarray, scales: np.ndarray | float, opacities: np.ndarray | float = 0.8
) -> GaussianCloud:
    n = len(means)
    return GaussianCloud(
        means,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.broadcast_to(np.asarray(scales, float).reshape(-1, 1), (n, 3)) * [1, 1, 0.1],
        np.broadcast_to(opacities, n),
        np.zeros((n, 1, 3)),
    )


def plate(seed: int = 0) -> np.ndarray:
    """2000 points on a square of side 2, at z = 0."""
    flat = np.random.default_rng(seed).uniform(-1, 1, (2000, 2))
    return np.column_stack([flat, np.zeros(2000)])


def scene() -> tuple[GaussianCloud, np.ndarray]:
    """A plate; five single floaters; a clump of twelve in the air; what of it is the plate."""
    rng = np.random.default_rng(1)
    single = rng.uniform(-1, 1, (5, 3)) * [3, 3, 0.1] + [0, 0, 2]
    clump = rng.normal((0.5, 0.5, -1), 0.02, (12, 3))
    means = np.concatenate([plate(), single, clump])
    return splats(means, 0.03), np.arange(len(means)) < 2000


def test_floaters_go_and_the_rest_stays():
    cloud, subject = scene()
    found = find(cloud)
    np.testing.assert_array_equal(found.kept, subject)
    assert set(np.flatnonzero(found.gone["sparse"])) >= set(range(2000, 2005))
    np.testing.assert_array_equal(~found.gone["min_part"], subject)
    counts = found.counts()
    assert counts["all"]["splats"] == 17
    assert counts["all"]["opacity"] == pytest.approx(17 / 2017)
    assert len(remove(cloud, found)) == 2000


def test_the_mesh_of_the_splats_loses_the_same():
    cloud, subject = scene()
    mesh = convert(cloud)
    found = find(mesh)
    np.testing.assert_array_equal(found.kept, subject)
    left = remove(mesh, found)
    np.testing.assert_array_equal(np.unique(left.face_splat), np.flatnonzero(subject))
    assert left.vertices[:, 2].max() < 0.5


def test_a_mesh_without_splats_counts_triangles():
    cloud, _ = scene()
    mesh = replace(convert(cloud, mode="flat"), face_splat=None)
    found = find(mesh, CleaningRules(max_distance=1.5))
    assert len(found.opacities) == len(mesh.faces)
    assert abs(remove(mesh, found).vertices[:, 2]).max() < 1.6


def test_each_rule_by_itself():
    cloud, _ = scene()
    faint = replace(cloud, opacities=np.where(np.arange(len(cloud)) % 10 == 0, 0.01, 0.8).astype(np.float32))
    assert find(faint, CleaningRules(min_opacity=0.05)).counts()["min_opacity"]["splats"] == 202
    far = find(cloud, CleaningRules(max_distance=3)).gone["max_distance"]
    bounds = scene_bounds(cloud)
    away = np.linalg.norm(cloud.means - bounds.center, axis=1)
    np.testing.assert_array_equal(far, away > 3 * bounds.radius)
    assert far.any()
    box = (-0.5, -0.5, -0.1, 0.5, 0.5, 0.1)
    part = cropped(cloud, box)
    assert np.all((part.means >= box[:3]) & (part.means <= box[3:]))
    assert cropped(cloud, None) is cloud
    kept = np.flatnonzero(~find(cloud, CleaningRules(crop=box)).gone["crop"])
    np.testing.assert_array_equal(np.unique(cropped(convert(cloud), box).face_splat), kept)


def test_large_splats_are_no_floaters():
    """A wall of few large splats beside a plate of many small ones, which it touches at the edge."""
    y, z = np.meshgrid(np.linspace(-1, 1, 6), np.linspace(0.2, 2, 6))
    wall = np.column_stack([np.full(36, 1.0), y.ravel(), z.ravel()])
    quaternion = np.array([np.sqrt(0.5), 0, np.sqrt(0.5), 0])  # turned so that it lies in y and z
    small = splats(plate(), 0.03)
    cloud = GaussianCloud(
        np.concatenate([small.means, wall]),
        np.concatenate([small.quaternions, np.tile(quaternion, (36, 1))]),
        np.concatenate([small.scales, np.tile([0.25, 0.25, 0.02], (36, 1))]),
        np.full(2036, 0.8),
        np.zeros((2036, 1, 3)),
    )
    assert find(cloud).kept.all()
    assert find(convert(cloud)).kept.all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 99), scale=st.floats(1e-3, 1e3), shift=st.tuples(*[st.floats(-10, 10)] * 3))
def test_neither_units_nor_place_nor_order_matter(seed, scale, shift):
    cloud, _ = scene()
    order = np.random.default_rng(seed).permutation(len(cloud))
    moved = splats((cloud.means[order] + shift) * scale, 0.03 * scale)
    # Cells lie elsewhere, so a splat at the edge of a rule may change sides; floaters do not.
    kept = find(moved).kept
    wanted = find(cloud).kept[order]
    assert (kept != wanted).mean() < 0.003
    assert not kept[order >= 2000].any()


def test_rules_that_make_no_sense():
    cloud, _ = scene()
    with pytest.raises(ValueError, match="no rule"):
        find(cloud, CleaningRules())
    with pytest.raises(ValueError, match=r"none of the 2,017 splats would be left \(min_opacity 2,017\)"):
        find(cloud, CleaningRules(min_opacity=0.9))
    for name, value in [("min_opacity", 2), ("sparse", -0.1), ("min_part", np.nan), ("max_distance", -1)]:
        with pytest.raises(ValueError, match=f"{name} must be a number"):
            CleaningRules(**{name: value})
    with pytest.raises(ValueError, match="x0 < x1"):
        CleaningRules(crop=(1, 0, 0, 0, 1, 1))
    with pytest.raises(ValueError, match="no triangles"):
        find(SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 4))))


def test_parts_by_hand():
    line = np.array([[x, 0.0, 0.0] for x in (0.5, 1.5, 2.9, 5.1, 6.0, 9.5)])
    np.testing.assert_array_equal(Cells(line, 1.0).parts(), [0, 0, 0, 1, 1, 2])
    np.testing.assert_array_equal(Cells(line, 1.0).near(), [2, 3, 2, 2, 2, 1])
    # A point and its ends are connected, however far apart.
    ends = np.zeros((6, 1, 3))
    ends[2, 0, 0] = 2.2
    np.testing.assert_array_equal(Cells(line, 1.0, ends).parts(), [0, 0, 0, 0, 0, 1])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999), count=st.integers(1, 60), side=st.floats(0.02, 2))
def test_parts_are_those_of_a_search(seed, count, side):
    points = np.random.default_rng(seed).random((count, 3))
    cell = np.floor((points - points.min(axis=0)) / side)
    touching = (abs(cell[:, None] - cell[None]) <= 1).all(axis=2)
    part = np.full(count, -1)
    for start in range(count):
        if part[start] < 0:
            front = [start]
            while front:
                at = front.pop()
                part[at] = start
                front += [k for k in np.flatnonzero(touching[at]) if part[k] < 0]
    found = Cells(points, side).parts()
    np.testing.assert_array_equal(found[:, None] == found, part[:, None] == part)
    np.testing.assert_array_equal(Cells(points, side).near(), touching.sum(axis=1))


def test_framing_ignores_floaters():
    rng = np.random.default_rng(2)
    ball = rng.normal(size=(3000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    # 3 % of single points around it, near enough to count as part of the subject.
    around = rng.normal(size=(90, 3))
    around *= (rng.uniform(1.8, 3.8, 90) / np.linalg.norm(around, axis=1))[:, None]
    plain, with_floaters = orbit(ball, 1)[0], orbit(np.concatenate([ball, around]), 1)[0]
    near = np.linalg.norm(plain.center - ball.mean(axis=0))
    assert np.linalg.norm(with_floaters.center - ball.mean(axis=0)) < 1.05 * near
    # A second object, small but no speck, is no floater; nor is anything where all is scattered.
    pair = np.concatenate([ball, 0.2 * ball[:100] + [3, 0, 0]])
    assert scene_bounds(pair).points[:, 0].max() > 3
    scattered = rng.uniform(-1, 1, (60, 3))
    assert len(scene_bounds(scattered).points) == 60


@pytest.fixture
def file(tmp_path):
    save_gaussians(scene()[0], tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def test_the_command_says_what_goes_and_draws_it(file, tmp_path, capsys):
    assert main(["clean", str(file), "-o", str(tmp_path / "clean.ply")]) == 0
    out = capsys.readouterr().out
    assert "together" in out
    assert "17 of 2,017 splats, 0.84% of the opacity" in out
    assert len(load_gaussians(tmp_path / "clean.ply")) == 2000
    image = load_image(tmp_path / "clean.ply.preview.png").astype(int)
    red = (image[..., 0] > 150) & (image[..., 1:].max(axis=2) < 100)
    third = image.shape[1] // 3
    assert red[:, third : 2 * third].sum() > 50
    assert red[:, :third].sum() == red[:, 2 * third :].sum() == 0


@pytest.mark.slow(keep=1)
@pytest.mark.parametrize("kind", ["splats", "mesh"])
def test_the_command_keeps_to_its_threads(file, tmp_path, monkeypatch, kind):
    """Without the option, images ask for the number of processors."""
    if kind == "mesh":
        save_mesh(convert(scene()[0]), tmp_path / "scene.ply")
    asked = []
    monkeypatch.setattr(library, "processors", lambda: asked.append(1) or 1)
    assert main(["clean", str(file), "-o", str(tmp_path / "clean.ply"), "--threads", "1"]) == 0
    assert not asked
    assert main(["clean", str(file), "-o", str(tmp_path / "clean.ply"), "--force"]) == 0
    assert asked


@pytest.mark.parametrize("command", ["clean", "convert", "simplify", "render", "view"])
def test_threads_are_checked_before_the_work(file, tmp_path, capsys, command):
    more = ["--share", "0.5"] if command == "simplify" else []
    output = str(tmp_path / "out.ply")
    assert main([command, str(file), "-o", output, "--threads", "0", *more]) == 2
    said = f"--threads must be at least 1, got 0 (see meshsplats {command} --help)"
    assert capsys.readouterr().err == f"meshsplats: error: {said}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_the_command_on_a_mesh_in_json(tmp_path, capsys):
    save_mesh(convert(scene()[0]), tmp_path / "scene.npz")
    arguments = ["clean", str(tmp_path / "scene.npz"), "-o", str(tmp_path / "clean.glb"), "--json"]
    assert main([*arguments, "--max-distance", "1.8", "--preview-only"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["output"] is None
    assert not (tmp_path / "clean.glb").exists()
    assert main([*arguments, "--max-distance", "1.8", "--force"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["removed"] == result["removed"]
    mesh = load_mesh(tmp_path / "clean.glb")
    assert len(np.unique(mesh.face_splat)) == again["kept"] < 2017
    np.testing.assert_allclose(again["upper"], mesh.vertices.max(axis=0), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["-o", "clean.obj"], 2, "splats are written as .ply"),
        (["-o", "clean.txt"], 2, "splats are written as"),
        (["-o", "clean.ply", "--min-opacity", "0.9"], 1, "none of the 2,017 splats would be left"),
        (["-o", "clean.ply", "--sparse", "2"], 2, "--sparse must be a number from 0 to 1"),
        (["-o", "scene.ply", "--force"], 2, "is read by this command"),
    ],
)
def test_mistakes(file, tmp_path, capsys, monkeypatch, options, code, words):
    monkeypatch.chdir(tmp_path)
    assert main(["clean", "scene.ply", *options]) == code
    assert words in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_memory_is_a_third_of_a_kilobyte_a_splat():
    rng = np.random.default_rng(4)
    count = 100_000
    cloud = splats(rng.random((count, 3)), rng.uniform(0.001, 0.02, count))
    tracemalloc.start()
    find(cloud)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400 * count


def test_coarser_cells_are_those_of_twice_the_side():
    points = np.random.default_rng(5).normal(size=(500, 3))
    far = np.concatenate([points, [[1e9, 0, 0], [1e9, 1, 0]]])
    for some in (points, far):
        cells = Cells(some, 0.05)
        for doublings in (0, 1, 3, 6):
            coarse = Cells(some, 0.05 * 2**doublings)
            np.testing.assert_array_equal(cells.coarser(doublings).near(), coarse.near())
            np.testing.assert_array_equal(cells.coarser(doublings).parts(), coarse.parts())
