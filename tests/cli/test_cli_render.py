"""``meshsplats render``, run in this process on a small cloud."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from meshsplats._common import toml
from meshsplats.cameras.files import load_cameras, save_cameras
from meshsplats.cameras.trajectories import look_at, orbit
from meshsplats.cli import main
from meshsplats.formats.gaussians import load_gaussians, save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh
from meshsplats.images.writing import to_bytes
from meshsplats.rendering import render, render_splats
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh


@pytest.fixture
def splats(tmp_path):
    rng = np.random.default_rng(0)
    n = 40
    quaternions = rng.normal(size=(n, 4))
    cloud = GaussianCloud(
        rng.normal(size=(n, 3)),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        rng.uniform(0.05, 0.3, (n, 3)),
        rng.uniform(0.2, 0.95, n),
        rng.normal(size=(n, 4, 3)),
    )
    save_gaussians(cloud, tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


@pytest.fixture
def triangle(tmp_path):
    """One half-opaque triangle, red, in the plane z = 0, larger than any image."""
    corners = np.array([[-50, -50, 0], [50, -50, 0], [0, 80, 0]])
    mesh = SplatMesh(corners, np.array([[0, 1, 2]]), np.array([[1, 0, 0, 0.5]] * 3))
    save_mesh(mesh, tmp_path / "triangle.npz")
    save_cameras([look_at((0, 0, -4), (0, 0, 0), width=12, height=8)], tmp_path / "one.json")
    return tmp_path / "triangle.npz"


def run(*arguments) -> int:
    return main(["render", *map(str, arguments)])


def pixels(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


def test_one_picture_of_a_mesh(triangle, tmp_path, capsys):
    out = tmp_path / "a.png"
    assert run(triangle, "-o", out, "--cameras", tmp_path / "one.json", "--background", "0,0,1") == 0
    np.testing.assert_array_equal(pixels(out), np.full((8, 12, 3), (128, 0, 128)))
    assert "1 image of 12 x 8" in capsys.readouterr().out
    config = toml.load(tmp_path / "a.png.config.toml")
    assert config["command"] == "render"
    assert config["options"]["background"] == "0,0,1"
    assert len(load_cameras(tmp_path / "a.png.cameras.json")) == 1


def test_a_picture_beside_the_files_of_its_mesh(triangle, tmp_path):
    """A mesh has its own configuration beside it, which is neither in the way nor lost."""
    ours = tmp_path / "triangle.npz.config.toml"
    ours.write_text("")
    assert run(triangle, "-o", tmp_path / "triangle.png", "--cameras", tmp_path / "one.json") == 0
    assert ours.read_text() == ""


def test_linear_meshes_are_blended_in_linear_light_and_encoded(triangle, tmp_path):
    mesh = load_mesh(triangle)
    save_mesh(replace(mesh, colors=mesh.colors * [0.5, 1, 1, 1], blending="linear"), tmp_path / "l.npz")
    places = ["--cameras", tmp_path / "one.json"]
    out = tmp_path / "a.png"
    assert run(tmp_path / "l.npz", "-o", out, *places, "--background", "0,0,1") == 0
    # Half of red 0.5 and half of blue 1: linear light 0.25 and 0.5, which sRGB encodes as 0.5371 and 0.7354.
    np.testing.assert_array_equal(pixels(out), np.full((8, 12, 3), (137, 0, 188)))
    assert run(tmp_path / "l.npz", "-o", tmp_path / "t.png", *places, "--transparent") == 0
    np.testing.assert_array_equal(pixels(tmp_path / "t.png"), np.full((8, 12, 4), (188, 0, 0, 128)))


def test_transparent_and_depth(triangle, tmp_path):
    out = tmp_path / "a.png"
    cameras = ("--cameras", tmp_path / "one.json", "--width", "24")
    assert run(triangle, "-o", out, *cameras, "--transparent", "--depth", "npy") == 0
    np.testing.assert_array_equal(pixels(out), np.full((16, 24, 4), (255, 0, 0, 128)))
    depth = np.load(tmp_path / "a.depth.npy", allow_pickle=False)
    np.testing.assert_allclose(depth, np.full((16, 24), 4.0), rtol=1e-5)
    assert run(triangle, "-o", out, *cameras, "--transparent", "--depth", "png", "--force") == 0
    unit = toml.load(tmp_path / "a.png.config.toml")["result"]["depth_unit"]
    np.testing.assert_allclose(pixels(tmp_path / "a.depth.png") * unit, np.full((16, 24), 4.0), atol=unit)


def test_orbit_of_splats(splats, tmp_path, capsys):
    """The images are those of the library from the recorded cameras, and the turntable has them all."""
    out = tmp_path / "out"
    size = ("--width", "20", "--height", "16", "--elevation", "30", "--up", "-z", "--samples", "1")
    assert run(splats, "-o", out, "--as-splats", "--orbit", "3", *size, "--sh-degree", "0", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    views = [f"view_000{i}.png" for i in range(3)]
    assert sorted(p.name for p in out.iterdir()) == [
        "cameras.json",
        "config.toml",
        "turntable.webp",
        *views,
    ]
    assert result["images"] == [str(out / name) for name in views]
    cloud = load_gaussians(splats)
    expected = orbit(cloud, 3, elevation=30, up=(0, 0, -1), width=20, height=16)
    for name, camera, wanted in zip(views, load_cameras(out / "cameras.json"), expected, strict=True):
        np.testing.assert_array_equal(camera.world_to_camera, wanted.world_to_camera)
        drawn = render_splats(cloud, camera, sh_degree=0)
        np.testing.assert_array_equal(pixels(out / name), to_bytes(drawn.color))
    with Image.open(out / "turntable.webp") as image:
        assert (image.n_frames, image.size) == (3, (20, 16))


def test_no_picture_of_an_earlier_orbit_is_left(splats, tmp_path):
    out = tmp_path / "out"
    assert run(splats, "-o", out, "--orbit", "4", "--width", "8", "--depth", "png") == 0
    (out / "view_0009.png").write_bytes(b"mine")  # no earlier run of four views made this
    none = ("--animation", "none")
    assert run(splats, "-o", out, "--orbit", "2", "--width", "8", "--force", *none) == 0
    assert not (out / "turntable.webp").exists()
    names = {path.name for path in out.iterdir() if path.suffix == ".png"}
    assert names == {"view_0000.png", "view_0001.png", "view_0009.png"}


def test_splats_become_a_mesh_unless_asked(splats, tmp_path):
    from meshsplats.conversion import convert

    assert run(splats, "-o", tmp_path / "a.png", "--width", "20", "--samples", "1") == 0
    (camera,) = load_cameras(tmp_path / "a.png.cameras.json")
    drawn = render(convert(load_gaussians(splats)), camera)
    np.testing.assert_array_equal(pixels(tmp_path / "a.png"), to_bytes(drawn.color))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--dome", "4"], {"view_0003.png"}),
        (["--look-around", "4", "--animation", "gif"], {"view_0003.png", "turntable.gif"}),
        (["--orbit", "4", "--animation", "none", "--depth", "png"], {"view_0003.png", "depth_0003.png"}),
    ],
)
def test_other_placements(splats, tmp_path, options, expected):
    out = tmp_path / "out"
    assert run(splats, "-o", out, *options, "--width", "8") == 0
    names = {p.name for p in out.iterdir()}
    assert expected <= names
    assert ("turntable.gif" in names) == ("turntable.gif" in expected)
    assert len([n for n in names if n.startswith("view")]) == 4
    assert "turntable.webp" not in names


def test_nothing_is_overwritten(triangle, tmp_path, capsys):
    out = tmp_path / "a.png"
    out.write_bytes(b"mine")
    arguments = (triangle, "-o", out, "--cameras", tmp_path / "one.json")
    assert run(*arguments) == 3
    assert out.read_bytes() == b"mine"
    assert "--force" in capsys.readouterr().err
    assert run(*arguments, "--force") == 0
    assert out.read_bytes() != b"mine"
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "view_0000.png").write_bytes(b"mine")
    assert run(triangle, "-o", folder, "--cameras", tmp_path / "one.json") == 3
    assert [p.name for p in folder.iterdir()] == ["view_0000.png"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--orbit", "2", "--dome", "2"], "--orbit, --dome"),
        (["--dome", "2", "--elevation", "10"], "--elevation has no effect with --dome"),
        (["--look-around", "2", "--distance", "2"], "--distance has no effect"),
        (["--cameras", "x.json", "--up", "-y"], "--up has no effect"),
        (["--sh-degree", "0"], "--sh-degree limits the harmonics of splats"),
        (["--as-splats", "--depth", "png"], "--depth is that of a mesh"),
        (["--as-splats", "--max-layers", "2"], "--max-layers"),
        (["--transparent", "--background", "black"], "exclude"),
        (["--transparent", "--animation", "gif"], "GIF"),
        (["--orbit", "x"], "--orbit"),
        (["--unknown"], "--unknown"),
    ],
)
def test_wrong_usage(splats, tmp_path, capsys, options, words):
    assert run(splats, "-o", tmp_path / "out", *options) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--background", "mauve"], "--background must be white"),
        (["--background", "2,0,0"], "from 0 to 1"),
        (["--up", "1,2"], "--up must be an axis"),
        (["--up", "0,0,0"], "--up must be an axis"),
        (["--orbit", "0"], "count"),
        (["--fov", "0"], "fov"),
        (["--samples", "0"], "samples"),
        (["--width", "0"], "width"),
        (["--cameras", "missing.json"], "missing.json: No such file"),
    ],
)
def test_bad_values(splats, tmp_path, capsys, options, words):
    of_the_library = options[0] in ("--orbit", "--fov", "--samples", "--cameras")
    assert run(splats, "-o", tmp_path / "out", *options) == (1 if of_the_library else 2)
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_outputs_and_inputs_that_cannot_be(splats, triangle, tmp_path, capsys):
    assert run(splats, "-o", tmp_path / "a.jpg") == 2
    assert run(splats, "-o", tmp_path / "a.png", "--orbit", "3") == 2
    assert run(triangle, "-o", tmp_path / "b", "--as-splats") == 2
    assert run(splats, "-o", tmp_path / "no" / "such", "--width", "8") == 1
    assert run(tmp_path / "one.json", "-o", tmp_path / "b") == 1
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 5
    for words, line in zip(
        ["end in .png", "do not fit", "is a mesh", "no: this folder", "JSON"], errors, strict=True
    ):
        assert words in line


def test_a_part_is_drawn(splats, tmp_path):
    """Of splats and of their mesh: what is outside of the box is not there."""
    cloud = load_gaussians(splats)
    box = (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    inside = np.all((cloud.means >= box[:3]) & (cloud.means <= box[3:]), axis=1)
    camera = orbit(cloud, 1, width=40, height=40)[0]
    save_cameras([camera], tmp_path / "camera.json")
    options = ["--cameras", tmp_path / "camera.json", "--crop", *box, "--as-splats"]
    assert run(splats, "-o", tmp_path / "part.png", *options) == 0
    part = cloud.take(np.flatnonzero(inside))
    drawn = render_splats(part, camera, background=(1, 1, 1)).color
    with Image.open(tmp_path / "part.png") as image:
        np.testing.assert_array_equal(np.asarray(image), to_bytes(drawn))
    assert 0 < inside.sum() < len(cloud)


def test_aim_and_lens(splats, tmp_path):
    cloud = load_gaussians(splats)
    size = ["--width", 60, "--height", 40]
    aimed = ["--look-at", -1, 0.5, 2, "--focal-length", 50, "--azimuth", 0]
    assert run(splats, "-o", tmp_path / "a.png", "--as-splats", *size, *aimed) == 0
    (camera,) = load_cameras(tmp_path / "a.png.cameras.json")
    x, y, z = camera.world_to_camera[:3] @ [-1, 0.5, 2, 1]
    assert (x, y) == (pytest.approx(0, abs=1e-6), pytest.approx(0, abs=1e-6))
    assert camera.fx == pytest.approx(50 / 36 * 60)
    own = orbit(cloud, 1, elevation=15, width=60, height=40, fov=2 * np.degrees(np.arctan(12 / 50)))[0]
    assert z == pytest.approx(np.linalg.norm(camera.center - [-1, 0.5, 2]))
    np.testing.assert_allclose(own.world_to_camera[:3, :3], camera.world_to_camera[:3, :3], atol=1e-9)
    for mistake in (["--fov", "30"], ["--look-around", "3"]):
        assert run(splats, "-o", tmp_path / "b", *aimed, *mistake) == 2
    assert run(splats, "-o", tmp_path / "b.png", "--focal-length", 0) == 2


def test_a_cutoff_draws_solid_triangles_or_none(triangle, tmp_path):
    out = tmp_path / "a.png"
    options = ("--cameras", tmp_path / "one.json", "--background", "0,0,1", "--force")
    assert run(triangle, "-o", out, "--cutoff", "0.5", *options) == 0
    assert (pixels(out) == (255, 0, 0)).all()
    assert run(triangle, "-o", out, "--cutoff", "0.6", *options) == 0
    assert (pixels(out) == (0, 0, 255)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cutoff", "1.5"), "cutoff must be an opacity from 0 to 1"),
        (("--cutoff", "0.5", "--max-layers", "3"), "--max-layers has no effect with --cutoff"),
        (("--cutoff", "0.5", "--as-splats"), "--cutoff is for a mesh"),
        (("--cutoff", "0.5", "--order", "splat"), "order='splat' blends splats, and a cutoff"),
        (("--order", "splat", "--as-splats"), "--order is that of a mesh: leave out --as-splats"),
    ],
)
def test_a_cutoff_that_says_nothing_is_refused(splats, tmp_path, capsys, options, message):
    assert run(splats, "-o", tmp_path / "a.png", *options) != 0
    assert message in capsys.readouterr().err
