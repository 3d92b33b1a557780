"""Splats in every format that is written, read back here and by readers of others."""

from __future__ import annotations

import subprocess
import warnings
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from _glb import read_glb, write_glb
from _local import shared_data

import meshsplats as ms
from meshsplats._common.geometry import rotation_rows
from meshsplats.cli import main
from meshsplats.errors import DataWarning, MissingDependencyError
from meshsplats.formats.splat_formats import format_to_write, written_ending
from meshsplats.formats.splats import _quantising
from meshsplats.formats.splats._palette import palette
from meshsplats.formats.splats._quantising import (
    codebook,
    nearest_axes,
    nearest_entry,
    sorted_in_space,
)

QUANTISED = (".compressed.ply", ".splat", ".spz", ".sog")
USD = (".usdc", ".usda", ".usdz")
UP = np.array([0.6, 0.0, 0.8], np.float32)


def cloud_of(n=700, degree=3, seed=1, **more):
    """Splats in a ball, as trained ones: small, most of them flat, none invisible."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    return ms.GaussianCloud(
        rng.normal(size=(n, 3)),
        q / np.linalg.norm(q, axis=1, keepdims=True),
        np.exp(rng.normal(-3.5, 0.6, (n, 3))),
        rng.uniform(0.05, 1, n),
        np.concatenate([rng.normal(0, 1, (n, 1, 3)), rng.normal(0, 0.15, (n, (degree + 1) ** 2 - 1, 3))], 1),
        **more,
    )


def written(cloud, path, **options):
    """``cloud``, written and read again, without a word."""
    if path.name.endswith(USD):
        pytest.importorskip("pxr")
    ms.save_gaussians(cloud, path, **options)
    return ms.load_gaussians(path)


def paired(cloud, other):
    """``other`` in the order of ``cloud``: each splat's nearest, which must be another one each."""
    distance = ((cloud.means[:, None].astype(float) - other.means[None]) ** 2).sum(axis=2)
    place = distance.argmin(axis=1)
    assert len(np.unique(place)) == len(cloud) == len(other)
    return other.take(place)


def covariances(cloud):
    axes = cloud.rotations.astype(float) * cloud.scales[:, None]
    return axes @ axes.transpose(0, 2, 1)


def loss(cloud, other):
    """PSNR of images of ``other`` against those of ``cloud``, in dB."""
    cameras = ms.orbit(cloud, 3, elevation=20, width=200, height=200)
    images = [[ms.draw_splats(c, camera).color for camera in cameras] for c in (cloud, other)]
    error = np.mean([(a - b) ** 2 for a, b in zip(*images, strict=True)])
    return -10 * np.log10(error)


# ---- What is kept


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize(
    ("degree", "suffix"),
    # Files of USD take seconds, and all kinds are written by the same lines.
    [*product([0, 3], [".ply", ".glb"]), (0, ".usdc"), (3, ".usdc"), (3, ".usda"), (0, ".usdz")],
)
def test_float_formats_keep_everything(tmp_path, suffix, degree):
    cloud = cloud_of(degree=degree, up=UP, origin=[5e5, 4.5e6, -70.25], kernel="antialiased")
    back = written(cloud, tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(back.means, cloud.means)
    np.testing.assert_array_equal(back.sh, cloud.sh)
    np.testing.assert_allclose(back.quaternions, cloud.quaternions, atol=2e-7)
    np.testing.assert_allclose(back.scales, cloud.scales, rtol=1e-6)
    np.testing.assert_allclose(back.opacities, cloud.opacities, atol=1e-6)
    np.testing.assert_allclose(back.up, cloud.up, atol=1e-6)
    assert back.kernel == "antialiased"
    np.testing.assert_array_equal(back.origin, cloud.origin)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog"])
def test_quantised_formats_keep_up_origin_and_kernel(tmp_path, suffix):
    cloud = cloud_of(100, up=UP, origin=[5e5, 4.5e6, 0], kernel="antialiased")
    back = written(cloud, tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.up, UP, atol=1e-6)
    np.testing.assert_array_equal(back.origin, cloud.origin)
    assert back.kernel == "antialiased"


def test_dot_splat_has_the_largest_first_and_bytes_as_others_write_them(tmp_path):
    """Viewers show what they have loaded so far."""
    size, opacity = np.array([0.1, 0.4, 0.2, 0.4]), np.array([0.9, 0.2, 0.9, 0.8])
    cloud = ms.GaussianCloud(
        np.arange(12).reshape(4, 3), np.full((4, 4), 0.5), np.tile(size[:, None], 3), opacity,
        np.zeros((4, 1, 3)),
    )  # fmt: skip
    ms.save_gaussians(cloud, tmp_path / "a.splat")
    records = np.fromfile(tmp_path / "a.splat", [("x", "<f4"), ("more", "V24"), ("rotation", "u1", 4)])
    assert records["x"].tolist() == [9, 3, 6, 0]
    assert (records["rotation"] == 128 + 64).all()


@pytest.mark.parametrize(
    ("suffix", "lost"), [(".splat", "degree 0.*origin.*up.*kernel"), (".spz", "origin.*up")]
)
def test_what_a_format_cannot_say_is_told(tmp_path, suffix, lost):
    cloud = cloud_of(20, up=UP, origin=[5e5, 4.5e6, 0], kernel="antialiased")
    with pytest.warns(DataWarning, match=f"a{suffix}: the format leaves out .*{lost}"):
        ms.save_gaussians(cloud, tmp_path / f"a{suffix}")
    assert ms.load_gaussians(tmp_path / f"a{suffix}").kernel == (
        "antialiased" if suffix == ".spz" else "3dgs"
    )


def test_two_scales_come_back_where_the_format_names_the_kernel(tmp_path):
    cloud = cloud_of(50)
    flat = replace(cloud, kernel="2dgs", scales=cloud.scales * [1, 1, 0])
    for suffix in (".ply", ".sog", ".glb"):
        back = written(flat, tmp_path / f"a{suffix}")
        assert back.kernel == "2dgs", suffix
        assert (back.scales[:, 2] == 0).all(), suffix


def test_a_node_that_was_moved_counts_and_the_note_does_not(tmp_path):
    cloud = cloud_of(30, degree=1, up=UP, origin=[5e5, 4.5e6, 0])
    ms.save_gaussians(cloud, tmp_path / "a.glb")
    document, binary = read_glb(tmp_path / "a.glb")
    document["nodes"][0]["translation"][1] += 1e3
    write_glb(tmp_path / "b.glb", document, binary)
    moved = ms.load_gaussians(tmp_path / "b.glb")
    place = np.median(moved.means + moved.origin, axis=0) - np.median(cloud.means + cloud.origin, axis=0)
    assert np.linalg.norm(place) > 1e3
    assert moved.up is None


# ---- Quantisation


def test_positions_of_spz_are_within_half_a_step(tmp_path):
    pytest.importorskip("zstandard", reason="SPZ 4 needs the extra 'formats'")
    cloud = cloud_of()
    for version in (3, 4):
        back = paired(cloud, written(cloud, tmp_path / "a.spz", spz_version=version))
        step = 2.0**-12
        assert 0.4 * step < np.abs(back.means - cloud.means).max() <= 0.5 * step + 1e-7


@pytest.mark.filterwarnings("ignore:.*SPZ stores scales:meshsplats.errors.DataWarning")
@pytest.mark.parametrize("unit", [1e-3, 1.0, 100.0])
def test_spz_is_as_fine_as_its_splats_in_any_unit(tmp_path, unit):
    cloud = cloud_of(degree=0)
    scaled = cloud.transformed(np.eye(3) * unit)
    # Scales have a floor of e^-10, which small units reach: positions alone are compared.
    back = paired(scaled, written(scaled, tmp_path / "a.spz"))
    error = np.abs(back.means - scaled.means).max() / unit
    assert error <= float(np.median(np.sort(cloud.scales, axis=1)[:, 1])) / 12


def test_far_splats_that_leave_spz_too_few_steps_are_told(tmp_path):
    cloud = cloud_of(50)
    far = replace(cloud, means=np.concatenate([cloud.means[:-1], [[3e6, 0, 0]]]))
    with pytest.warns(DataWarning, match="24 bits; with splats as far as 3e\\+06 their step is 0.5"):
        ms.save_gaussians(far, tmp_path / "a.spz")
    back = ms.load_gaussians(tmp_path / "a.spz")
    assert abs(float(back.means.max()) - 3e6) <= 0.25


def test_scales_out_of_the_range_of_spz_are_told(tmp_path, recwarn):
    cloud = cloud_of(50)
    count = len(cloud)
    for unit, words in (
        (1e-6, f"{count} visible splats become larger and 0 smaller"),
        (1e6, rf"0 .*{count} smaller"),
    ):
        with pytest.warns(DataWarning, match=rf"a.spz: SPZ stores scales .*{words}"):
            ms.save_gaussians(cloud.transformed(np.eye(3) * unit), tmp_path / "a.spz")
    recwarn.clear()
    unseen = np.where(np.arange(count)[:, None] == 0, np.float32(1e3), cloud.scales)
    flat = np.where(np.arange(3) == 2, np.float32(0), unseen)
    opacities = np.where(np.arange(count) == 0, np.float32(1e-3), cloud.opacities)
    ms.save_gaussians(replace(cloud, scales=flat, opacities=opacities), tmp_path / "a.spz")
    assert not [w for w in recwarn if "deviations" in str(w.message)]


def test_spz_keeps_an_order_in_which_splats_repeat_each_other(tmp_path):
    """Divided splats: sorting would scatter what the stream repeats. Others are sorted."""
    cloud = cloud_of(500, degree=1)
    divided = cloud.take(np.repeat(np.arange(500), 8))
    rng = np.random.default_rng(4)
    divided = replace(divided, means=divided.means + rng.normal(0, 0.5, (4000, 3)).astype(np.float32))
    back = written(divided, tmp_path / "a.spz")
    assert np.abs(back.means - divided.means).max() < 0.01
    shuffled = divided.take(rng.permutation(4000))
    assert np.abs(written(shuffled, tmp_path / "b.spz").means - shuffled.means).max() > 1
    assert 1.5 * (tmp_path / "a.spz").stat().st_size < (tmp_path / "b.spz").stat().st_size


@pytest.mark.parametrize("suffix", QUANTISED)
def test_quantised_splats_are_the_same_ellipsoids(tmp_path, suffix):
    cloud = cloud_of(degree=0)
    back = paired(cloud, written(cloud, tmp_path / f"a{suffix}"))
    size = np.sqrt(np.trace(covariances(cloud), axis1=1, axis2=2))[:, None, None] ** 2
    limit = {".compressed.ply": 0.02, ".splat": 0.02, ".spz": 0.08, ".sog": 0.06}[suffix]
    assert np.abs((covariances(back) - covariances(cloud)) / size).max() < limit
    assert np.abs(back.opacities - cloud.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(back.colors - cloud.colors).max() < 0.012


@pytest.mark.parametrize(
    ("suffix", "least"), [(".compressed.ply", 48), (".splat", 48), (".spz", 45), (".sog", 48)]
)
def test_images_of_quantised_splats_differ_little(tmp_path, suffix, least):
    cloud = cloud_of(3000, degree=0)
    assert loss(cloud, written(cloud, tmp_path / f"a{suffix}")) > least


def test_harmonics_keep_what_their_format_has_bits_for(tmp_path):
    cloud = cloud_of(900, degree=3)
    limits = {".compressed.ply": 1 / 64, ".spz": 1 / 16}
    for suffix, limit in limits.items():
        back = paired(cloud, written(cloud, tmp_path / f"a{suffix}"))
        assert np.abs(back.sh[:, 1:] - cloud.sh[:, 1:]).max() <= limit + 1e-6, suffix
    back = paired(cloud, written(cloud, tmp_path / "a.sog"))  # fewer splats than a palette has entries
    error = np.abs(back.sh[:, 1:] - cloud.sh[:, 1:])
    assert error.mean() < 0.001
    assert error.max() < 0.05


@pytest.mark.slow(keep=6)
@pytest.mark.parametrize(
    ("n", "suffix"),
    [
        *product([1, 2, 257], [".ply", ".glb", *QUANTISED]),
        *((1, ".usdc"), (257, ".usdc"), (1, ".usda"), (2, ".usdz")),
    ],
)
def test_any_number_of_splats_and_the_ends_of_ranges(tmp_path, suffix, n):
    cloud = cloud_of(n)
    opacities, scales = cloud.opacities.copy(), cloud.scales.copy()
    opacities[0], scales[0] = 1, 0
    sh = cloud.sh * 100
    hard = replace(cloud, opacities=opacities, scales=scales, sh=sh)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        back = written(hard, tmp_path / f"a{suffix}")
    assert len(back) == n
    assert back.opacities.max() == 1


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("suffix", [".sog", ".ply"])
@pytest.mark.parametrize(("n", "degree", "exploded"), [(1, 0, 1), (3000, 1, 1), (20, 0, 20)])
def test_splats_whose_size_has_exploded_are_read_again(tmp_path, suffix, n, degree, exploded):
    cloud = cloud_of(n, degree)
    for size in (3e19, float(np.finfo(np.float32).max)):
        cloud.scales[:exploded] = size
        again = written(cloud, tmp_path / f"splats{suffix}")
        assert len(again) == n
        np.testing.assert_allclose(again.scales.max(), size, rtol=1e-3)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_harmonics_that_have_exploded_are_clipped_in_sog(tmp_path):
    cloud = cloud_of(3000, 1)
    cloud.sh[0, 1:] = 1e30
    with pytest.warns(DataWarning, match="harmonics of 1 splats are beyond 1e\\+09"):
        again = written(cloud, tmp_path / "splats.sog")
    assert len(again) == len(cloud)
    assert again.sh[:, 1:].max() == 1e9


def test_the_same_splats_give_the_same_bytes(tmp_path):
    cloud = cloud_of(5000, degree=1)
    for suffix in (".compressed.ply", ".splat", ".spz", ".sog", ".glb"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            for name in "ab":
                ms.save_gaussians(cloud, tmp_path / f"{name}{suffix}")
        assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes(), suffix


def test_the_smallest_rotation_names_the_same_ellipsoid():
    cloud = cloud_of(2000, degree=0)
    quaternions, scales = nearest_axes(cloud.quaternions, cloud.scales)
    same = replace(cloud, quaternions=quaternions, scales=scales)
    np.testing.assert_allclose(covariances(same), covariances(cloud), rtol=1e-4, atol=1e-7)
    # The farthest rotation from all 24 of a cube is by 62.8 degrees.
    assert quaternions[:, 0].min() > np.cos(np.radians(62.9) / 2)
    assert np.abs(quaternions[:, 1:]).max() < 0.39


def test_a_codebook_is_near_the_best_one():
    """For a uniform density it is the middles of equal steps."""
    values = np.linspace(0, 1, 200_001)
    book = codebook(values)
    np.testing.assert_allclose(book, (np.arange(256) + 0.5) / 256, atol=2e-4)
    assert (codebook(np.full(9, 3.5)) == 3.5).all()
    normal = np.random.default_rng(0).normal(size=200_000)
    error = np.mean((codebook(normal)[nearest_entry(normal, codebook(normal))] - normal) ** 2)
    # Panter and Dite: (1/12) (integral of the cube root of the density)^3 / 256^2 = 2.72 / 256^2.
    assert error < 1.03 * 2.72 / 256**2


def test_a_palette_with_room_for_all_rows_keeps_them():
    rows = np.random.default_rng(0).normal(size=(500, 9)).astype(np.float32)
    rows = np.concatenate([rows, rows[:200]])
    entries, labels = palette(rows, 512, np.ones(700, np.float32))
    np.testing.assert_array_equal(entries[labels], rows)


def test_a_palette_is_better_than_rows_at_random():
    rng = np.random.default_rng(0)
    rows = (rng.normal(size=(20_000, 3)) @ rng.normal(size=(3, 24))).astype(np.float32)
    entries, labels = palette(rows, 2048, np.ones(len(rows), np.float32))
    assert len(entries) <= 2048
    some = rows[rng.choice(len(rows), 2048, replace=False)]
    nearest = ((rows[:500, None] - some[None]) ** 2).sum(axis=2).min(axis=1)
    assert ((entries[labels] - rows) ** 2).sum(axis=1).mean() < 0.75 * nearest.mean()


def test_neighbours_in_the_order_are_neighbours_in_space():
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    points[0] = 1e6
    placed = points[sorted_in_space(points)]
    step = np.linalg.norm(np.diff(placed, axis=0), axis=1)
    assert np.median(step) < 0.2


@pytest.mark.filterwarnings("error")
def test_an_order_of_splats_on_a_line():
    """Most coordinates are 0."""
    points = np.zeros((500, 3), np.float32)
    points[:, 0] = np.random.default_rng(0).uniform(-1000, 1000, 500)
    placed = points[sorted_in_space(points), 0]
    assert np.abs(np.diff(placed)).max() < 30
    assert placed[-1] - placed[0] > 1900


# ---- Arguments


def test_names_decide_by_their_longest_ending():
    assert format_to_write("A.COMPRESSED.PLY").name == "compressed.ply"
    assert format_to_write("a.b.ply").name == "ply"
    assert format_to_write("a.obj") is None
    assert [written_ending(name) for name in ("a.Compressed.ply", "a.b.spz", "a.tar.xyz")] == [
        "compressed.ply",
        "spz",
        "xyz",
    ]


def test_options_and_names_that_do_not_fit_are_refused_before_anything_is_written(tmp_path):
    cloud = cloud_of(5)
    for name, options, message in [
        ("a.obj", {}, r"'a.obj' does not name a splat format; .* \.spz"),
        ("a.sog", {"spz_version": 4}, r"spz_version is for \.spz, not for 'a.sog'"),
        ("a.spz", {"spz_version": 2}, "spz_version must be 3 or 4, got 2"),
        ("a.ply", {"linear": True}, r"linear is for \.usdc, \.usda, \.usd or \.usdz, not"),
    ]:
        with pytest.raises(ValueError, match=message):
            ms.save_gaussians(cloud, tmp_path / name, **options)
    with pytest.raises(ValueError, match=r"blocks are written as float \.ply, got 'a.compressed.ply'"):
        ms.save_gaussian_blocks([cloud], tmp_path / "a.compressed.ply", 5, degree=3)
    with pytest.raises(ValueError, match="the cloud is empty"):
        ms.save_gaussians(cloud.take(slice(0, 0)), tmp_path / "a.spz")
    assert list(tmp_path.iterdir()) == []


def test_version_4_needs_zstandard(tmp_path, monkeypatch):
    from meshsplats.formats.splats import _spz_layout

    def missing(name):
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(_spz_layout.importlib, "import_module", missing)
    with pytest.raises(MissingDependencyError, match=r"a\.spz: SPZ version 4 needs the extra 'formats'"):
        ms.save_gaussians(cloud_of(5), tmp_path / "a.spz", spz_version=4)
    assert list(tmp_path.iterdir()) == []


# ---- The commands


def test_a_name_of_splats_alone_makes_splats(tmp_path):
    pytest.importorskip("zstandard", reason="SPZ 4 needs the extra 'formats'")
    ms.save_gaussians(cloud_of(60, degree=1), tmp_path / "a.ply")
    out = ["--no-preview", "--no-sidecar"]
    assert main(["convert", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.spz"), *out]) == 0
    assert len(ms.load_gaussians(tmp_path / "b.spz")) == 60
    many = [str(tmp_path / "a.ply"), "-o", str(tmp_path / "many"), "--formats", "spz", "compressed.ply"]
    assert main(["convert", *many, "--set", "spz_version=4", *out]) == 0
    assert (tmp_path / "many" / "a.spz").read_bytes()[:8] == b"NGSP\4\0\0\0"
    assert {path.name for path in (tmp_path / "many").iterdir()} == {"a.spz", "a.compressed.ply"}
    for command in (["simplify", "--share", "0.5", "--no-preview"], ["clean"]):
        path = tmp_path / f"{command[0]}.sog"
        assert main([command[0], str(tmp_path / "a.ply"), "-o", str(path), *command[1:]]) == 0
        assert 0 < len(ms.load_gaussians(path)) <= 60


def test_commands_refuse_names_that_are_of_no_splats(tmp_path, capsys):
    ms.save_gaussians(cloud_of(60, degree=0), tmp_path / "a.ply")
    for words in (
        ["convert", "-o", "b.obj", "--as-splats"],
        ["simplify", "-o", "b.obj", "--share", "0.5"],
        ["clean", "-o", "b.obj"],
    ):
        given = [str(tmp_path / w) if "b.obj" in w else w for w in words]
        assert main([given[0], str(tmp_path / "a.ply"), *given[1:]]) == 2
        assert "splats are written as .ply, .compressed.ply, .splat" in capsys.readouterr().err
    words = ["convert", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.glb"), "--set", "spz_version=4"]
    assert main(words) == 2
    assert "are for splats" in capsys.readouterr().err
    assert not (tmp_path / "b.obj").exists()


# ---- Readers of others


def node(folder, *words):
    """What node prints, run in the ``folder`` of its packages."""
    words = ["node", *map(str, words)]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_the_khronos_validator_finds_nothing_but_the_names_of_the_extension(tmp_path, gltf_issues, degree):
    ms.save_gaussians(cloud_of(50, degree, up=UP, origin=[5e5, 4.5e6, 0]), tmp_path / "a.glb")
    (issues,) = gltf_issues(tmp_path / "a.glb")
    # Its release of 2024 does not know the extension, nor the names of attributes that it prescribes.
    known = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    others = [issue for issue in issues["messages"] if issue["code"] not in known]
    named = [
        issue["pointer"] for issue in issues["messages"] if issue["code"] not in {"UNSUPPORTED_EXTENSION"}
    ]
    assert others == []
    assert all("/attributes/KHR_gaussian_splatting:" in pointer for pointer in named), named


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("name", ["a.compressed.ply", "a.splat", "a.spz", "b.spz", "a.sog"])
@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_what_is_written(tmp_path, node_package, name, degree):
    folder = node_package("@playcanvas/splat-transform")
    cloud = cloud_of(500, degree)
    options = {"spz_version": 4} if name == "b.spz" else {}
    if options:
        pytest.importorskip("zstandard")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # .splat leaves out harmonics
        mine = written(cloud, tmp_path / name, **options)
    node(
        folder,
        "node_modules/@playcanvas/splat-transform/bin/cli.mjs",
        "-q",
        tmp_path / name,
        tmp_path / "theirs.ply",
    )
    theirs = paired(mine, ms.load_gaussians(tmp_path / "theirs.ply"))
    np.testing.assert_allclose(theirs.means, mine.means, atol=2e-6)
    np.testing.assert_allclose(theirs.opacities, mine.opacities, atol=1e-5)
    np.testing.assert_allclose(theirs.sh, mine.sh, atol=1e-5)
    size = np.trace(covariances(mine), axis1=1, axis2=2)[:, None, None]
    # .splat: they take bytes of rotations for the lower ends of their steps, we for the middles.
    limit = 0.02 if name == "a.splat" else 1e-4
    assert np.abs((covariances(theirs) - covariances(mine)) / size).max() < limit


@pytest.mark.parametrize("suffix", USD)
def test_openusd_knows_the_field(tmp_path, suffix):
    pxr = pytest.importorskip("pxr", reason="extra usd")
    from pxr import Usd, UsdGeom

    vol = pytest.importorskip("pxr.UsdVol")
    if not hasattr(vol, "ParticleField3DGaussianSplat"):
        pytest.skip(f"usd-core before 26.03 has no ParticleField3DGaussianSplat ({pxr.__file__})")
    cloud = cloud_of(40, 2, up=UP, origin=[5e5, 4.5e6, 0])
    ms.save_gaussians(cloud, tmp_path / f"a{suffix}")
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    (prim,) = [p for p in stage.Traverse() if p.IsA(vol.ParticleField3DGaussianSplat)]
    field = vol.ParticleField3DGaussianSplat(prim)
    assert (field.GetSortingModeHintAttr().Get(), field.GetProjectionModeHintAttr().Get()) == (
        "zDepth",
        "perspective",
    )
    assert Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Get() == "srgb_rec709_scene"
    get = lambda name: prim.GetAttribute(name).Get()  # noqa: E731
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
    # In the stage, the cloud's up is +y and world coordinates are turned likewise.
    world = np.array(get("positions"), float) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(world[:, 1], (cloud.means + cloud.origin) @ cloud.up.astype(float), atol=0.05)
    quaternion = get("orientations")[0]
    w, (x, y, z) = quaternion.GetReal(), quaternion.GetImaginary()
    turn = matrix[:3, :3] @ np.array(list(rotation_rows(w, x, y, z)))
    scale = np.array(get("scales")[0])
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-5)
    axes = turn * scale
    np.testing.assert_allclose(
        np.linalg.eigvalsh(axes @ axes.T), np.linalg.eigvalsh(covariances(cloud)[0]), atol=1e-6
    )
    assert get("radiance:sphericalHarmonicsDegree") == 2
    assert len(get("radiance:sphericalHarmonicsCoefficients")) == 9 * 40
    np.testing.assert_array_equal(
        np.array(get("radiance:sphericalHarmonicsCoefficients"))[::9], cloud.sh[:, 0]
    )
    low, high = np.array(get("extent"))
    assert (np.array(get("positions")) > low).all()
    assert (np.array(get("positions")) < high).all()


def test_the_checks_of_openusd_find_nothing(tmp_path):
    pytest.importorskip("pxr", reason="extra usd")
    validation = pytest.importorskip("pxr.UsdValidation", reason="usd-core 25.05 or newer")
    from pxr import Usd

    for suffix in (".usdc", ".usdz"):
        ms.save_gaussians(cloud_of(40, 3), tmp_path / f"a{suffix}")
        registry = validation.ValidationRegistry()
        context = validation.ValidationContext(registry.GetOrLoadAllValidators())
        found = context.Validate(Usd.Stage.Open(str(tmp_path / f"a{suffix}")))
        assert [error.GetErrorAsString() for error in found] == []


def test_linear_usd_has_linear_colours(tmp_path):
    pytest.importorskip("pxr", reason="extra usd")
    from pxr import Usd

    cloud = cloud_of(40, 0)
    cloud = replace(cloud, sh=np.clip(cloud.sh, -1.5, 1.5))
    ms.save_gaussians(cloud, tmp_path / "a.usdc", linear=True)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    prim = stage.GetPrimAtPath("/Splats/Field")
    assert prim.GetAttribute("colorSpace:name").Get() == "lin_rec709_scene"
    stored = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    display = 0.5 + 0.28209479177387814 * cloud.sh[:, 0]
    np.testing.assert_allclose(
        0.5 + 0.28209479177387814 * stored, ((display + 0.055) / 1.055) ** 2.4, atol=1e-5
    )
    with pytest.warns(DataWarning, match="its colours are linear"):
        back = ms.load_gaussians(tmp_path / "a.usdc")
    np.testing.assert_allclose(back.sh, cloud.sh, atol=1e-5)


# ---- Real splats


@pytest.mark.slow
@pytest.mark.parametrize("name", ["playbot_lod3_31k_sh2.ply", "guitar_sh0.ply"])
def test_real_splats_lose_little(tmp_path, name):
    cloud = ms.load_gaussians(shared_data(f"splats/{name}"))
    least = {".ply": 100, ".glb": 100, ".compressed.ply": 45, ".spz": 45, ".sog": 50}
    for suffix, limit in least.items():
        assert loss(cloud, written(cloud, tmp_path / f"a{suffix}")) > limit, suffix


def test_the_nearest_turn_of_a_cube_is_that_of_the_largest_product():
    """Of any rotation, and of those that two or more turns are as near to."""
    turns, _ = _quantising._cube()
    rng = np.random.default_rng(0)
    ties = rng.integers(-2, 3, (2000, 4)).astype(float)
    q = np.concatenate([rng.normal(size=(2000, 4)), ties[ties.any(axis=1)], turns, -turns])
    q = (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)
    products = np.abs(turns @ q.T)
    found = products[_quantising._nearest_turn(q, turns), np.arange(len(q))]
    np.testing.assert_allclose(found, products.max(axis=0), rtol=1e-6)


@pytest.mark.parametrize("suffix", [".sog", ".compressed.ply"])
def test_flat_splats_stay_flat(tmp_path, suffix):
    """The axis without extent is the third one, whose scale readers of '2dgs' drop."""
    cloud = cloud_of(500, degree=0)
    flat = replace(cloud, kernel="2dgs", scales=cloud.scales * np.array([1, 1, 0], np.float32))
    back = paired(flat, written(flat, tmp_path / f"a{suffix}"))
    assert back.kernel == "2dgs"
    assert not back.scales[:, 2].any()
    size = np.square(flat.scales).max(axis=1)[:, None, None]
    np.testing.assert_allclose(covariances(back) / size, covariances(flat) / size, atol=0.1)
